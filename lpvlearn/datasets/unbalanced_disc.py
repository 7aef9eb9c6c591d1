"""A disc with an eccentric mass on a motor: a system that stands about offsets."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
from numpy.random import Generator, RandomState
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import Bunch

from ..models.statespace import StateSpace
from ..structures.structure import GrayBoxStructure
from ..validation import (
    naming_argument,
    number,
    positive_time,
    real_array,
    shown,
    squarable,
)
from .excitation import (
    check_count,
    check_rows,
    check_size,
    decibels,
    experiment_tables,
    prbs,
    samples_of,
    spawn_generators,
    steps_of,
)

Array = NDArray[np.float64]

# Speed (rad/s) beyond which dry friction has all of its size, as published.
_SLIDING = 1e-3

# Largest step of the integration times the fastest rate: Runge-Kutta 4 is stable up to
# 2.78, and beyond 2 it is also useless.
_LONGEST_STEP = 2.0

# The large run: a sine that would hold the disc at this share of the reach, in rad/s,
# and bits of that many times the amplitude.
_SINE_REACH, _SINE_RATE, _SINE_BITS = 0.7, 0.6, 5.0

DESCR = """\
Unbalanced disc: simulated local experiments
--------------------------------------------
{n_points} operating points, angles from {low:.4g} to {high:.4g} rad, \
{n_realizations} realization(s) of the noise at {snr_db} dB,
{duration} s sampled at {sampling_time} s.

X: voltage (V, about what holds the disc at the angle), kappa (the angle, rad, without
noise, the scheduling variable), experiment (label), time (s). y: angle (rad). X_local,
y_local: one new noise-free experiment at each operating point. X_large, y_large: one
noise-free experiment that swings through the range, from rest at angle zero.
"""


@dataclass(frozen=True)
class UnbalancedDisc:
    """Disc on a DC motor, with an eccentric mass that gravity pulls down.

    ``theta'' = -omega0^2 sin(theta) - gamma theta' - Fc tanh(theta' / 0.001) + Ku u``
    with the angle theta (rad, zero hanging down) and the voltage u of the motor.

    Parameters
    ----------
    omega0 : float
        Frequency of small swings, rad/s.
    gamma : float
        Viscous friction and back electromotive force, 1/s.
    Fc : float
        Dry friction, rad/s2. Below ``Fc / Ku`` (0.2 V) the disc sticks.
    Ku : float
        Acceleration by the voltage, rad/(s2 V).

    Raises
    ------
    ValueError
        If a parameter is not finite and positive (gamma and Fc may be 0).

    References
    ----------
    The set-up is that of B. Kulcsar, J. Dong, J.-W. van Wingerden and M. Verhaegen,
    "LPV subspace identification of a DC motor with unbalanced disc", 15th IFAC
    Symposium on System Identification, 2009. Equation and constants are those that
    G. I. Beintema publishes for the one of Eindhoven University of Technology,
    https://github.com/GerbenBeintema/gym-unbalanced-disk (its motor takes 3 V at most).

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn.datasets import UnbalancedDisc
    >>> disc = UnbalancedDisc(Fc=0)
    >>> held = disc.holding_voltage(1.0)
    >>> round(float(held), 3)
    3.846
    >>> angle, rate = disc.simulate(np.full(50, held), 1.0, sampling_time=0.01)
    >>> bool(np.abs(angle - 1.0).max() < 1e-12)
    True
    """

    omega0: float = 11.339847
    gamma: float = 1.332834
    Fc: float = 6.062730
    Ku: float = 28.136158

    def __post_init__(self) -> None:
        for field in fields(self):
            may_be_zero = field.name in ("gamma", "Fc")
            check_size(field.name, getattr(self, field.name), may_be_zero)

    def acceleration(self, theta: ArrayLike, rate: ArrayLike, u: ArrayLike) -> Array:
        """The right-hand side of the equation, rad/s2; arguments are broadcast."""
        given = {"theta": theta, "rate": rate, "u": u}
        x, v, voltage = (_finite(name, value) for name, value in given.items())
        with naming_argument("theta", "have a shape that `rate` and `u` fit", theta):
            np.broadcast_shapes(x.shape, v.shape, voltage.shape)
        return self._acceleration(x, v, voltage)

    def _acceleration(self, theta: Array, rate: Array, u: Array) -> Array:
        friction = self.gamma * rate
        if self.Fc:
            friction = friction + self.Fc * np.tanh(rate / _SLIDING)
        return np.asarray(self.Ku * u - self.omega0**2 * np.sin(theta) - friction)

    def holding_voltage(self, theta: ArrayLike) -> Array:
        """Voltage (V) of the equilibrium at an angle (rad), of any shape."""
        return np.asarray(self.omega0**2 * np.sin(_finite("theta", theta)) / self.Ku)

    def linearize(self, theta: float) -> StateSpace:
        """Linear model about the equilibrium at an angle.

        Parameters
        ----------
        theta : float
            Angle in rad; unstable beyond a right angle.

        Returns
        -------
        model : StateSpace
            Continuous, from the voltage to the angle, in the state (angle, rate), all
            about the equilibrium. With dry friction, the disc is stuck.
        """
        return self.structure().model(self.parameters(theta))

    def structure(self) -> GrayBoxStructure:
        """Gray-box structure of `linearize`: damping, gain and stiffness."""
        return GrayBoxStructure.from_template(
            A=[[0, 1], ["-stiffness", "-damping"]], B=[[0], ["gain"]], C=[[1, 0]]
        )

    def parameters(self, theta: float) -> Array:
        """True values of the parameters of `structure` at an angle (rad).

        Examples
        --------
        >>> UnbalancedDisc(Fc=0).parameters(0.0).round(2)
        array([  1.33,  28.14, 128.59])
        """
        theta = number("theta", theta, "one finite angle in rad")
        damping = self.gamma + self.Fc / _SLIDING
        return np.array([damping, self.Ku, self.omega0**2 * np.cos(theta)])

    def simulate(
        self,
        voltage: ArrayLike,
        theta: ArrayLike,
        sampling_time: float,
        *,
        integration_step: float = 2e-3,
    ) -> tuple[Array, Array]:
        """Integrate the equation from rest, by Runge-Kutta 4 with a fixed step.

        Parameters
        ----------
        voltage : array-like of shape (n_samples,) or (n_experiments, n_samples)
            In V, held over each sampling period.
        theta : float or array-like of shape (n_experiments,)
            Initial angles in rad.
        sampling_time : float
            In s.
        integration_step : float, default=2e-3
            Largest integration step in s; the sampling period is divided into equal
            steps of at most this length, shorter where dry friction needs it.

        Returns
        -------
        angle, rate : ndarray
            At the sampling instants, in rad and rad/s; of the shape of `voltage` (with
            a leading axis for several angles).

        Raises
        ------
        ValueError
            If shapes do not fit or a number is out of its range.
        """
        u = squarable("voltage", real_array("voltage", voltage))
        start = _finite("theta", theta)
        if u.ndim not in (1, 2) or start.ndim > 1 or not np.isfinite(u).all():
            raise ValueError(
                "`voltage` must be finite, of shape (n_samples,) or (n_experiments, "
                f"n_samples), with angles (n_experiments,). Got {u.shape} and "
                f"{start.shape}."
            )
        try:
            shape = np.broadcast_shapes(u.shape[:-1], start.shape)
        except ValueError:
            raise ValueError(
                "`theta` must be one angle for each experiment of `voltage`. Got "
                f"{start.shape} for {u.shape}."
            ) from None
        fastest = self.omega0 + self.gamma + self.Fc / _SLIDING
        n_steps = steps_of(sampling_time, integration_step, _LONGEST_STEP / fastest)
        h = float(sampling_time) / n_steps
        x, v = np.broadcast_to(start, shape).astype(float), np.zeros(shape)
        angle, rate = np.empty((2, *shape, u.shape[-1]))
        for k in range(u.shape[-1]):
            angle[..., k], rate[..., k] = x, v
            held = u[..., k]
            for _ in range(n_steps):
                a1 = self._acceleration(x, v, held)
                v2 = v + h / 2 * a1
                a2 = self._acceleration(x + h / 2 * v, v2, held)
                v3 = v + h / 2 * a2
                a3 = self._acceleration(x + h / 2 * v2, v3, held)
                v4 = v + h * a3
                a4 = self._acceleration(x + h * v3, v4, held)
                x = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
                v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return angle, rate


def _finite(name: str, value: ArrayLike) -> Array:
    array = squarable(name, real_array(name, value))
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite. Got {shown(value)}.")
    return array


def make_unbalanced_disc(
    n_operating_points: int = 7,
    n_realizations: int = 1,
    snr_db: float = 30.0,
    duration: float = 15.0,
    sampling_time: float = 0.01,
    random_state: int | RandomState | None = None,
    *,
    reach: float = 1.3,
    amplitude: float = 0.05,
    clock: float = 0.08,
    large_duration: float = 30.0,
    disc: UnbalancedDisc | None = None,
) -> Bunch:
    """Simulate local experiments on the unbalanced disc, which stand about offsets.

    At each operating point the disc is at rest at an angle, held there by a voltage,
    and a binary pseudo-random voltage is added to that. The angle is output and
    scheduling variable at once.

    Parameters
    ----------
    n_operating_points : int, default=7
        Number of angles, evenly from ``-reach`` to ``reach``.
    n_realizations : int, default=1
        Noise realizations of each experiment, each with its own label.
    snr_db : float, default=30.0
        ``10 log10(cov(y) / cov(v))``; infinity is no noise.
    duration : float, default=15.0
        Length of each local experiment in s.
    sampling_time : float, default=0.01
        Sampling period in s.
    random_state : int, RandomState or None, default=None
        Seed of voltages and noise.
    reach : float, default=1.3
        Largest angle of an operating point in rad, less than a right angle.
    amplitude : float, default=0.05
        Amplitude of the voltage about its mean in V. At the outermost points the disc
        then moves by 0.2 rad in all, and its stiffness changes by half: more would not
        be local.
    clock : float, default=0.08
        Time in s for which each bit is held, rounded to samples.
    large_duration : float, default=30.0
        Length in s of the validation run: a sine of the voltage that would hold the
        disc at 0.7 of the reach, and bits of 5 times the amplitude.
    disc : UnbalancedDisc or None, default=None
        The disc; None takes the published constants without dry friction: with it, the
        disc sticks at voltages as small as these, and no linear model is right.

    Returns
    -------
    data : Bunch
        X, y : DataFrame
            Estimation data: columns ``voltage, kappa, experiment, time`` and ``angle``.
            `kappa` is the angle without noise. `time` restarts in each experiment.
        X_local, y_local : DataFrame
            New noise-free experiments, one at each operating point.
        X_large, y_large : DataFrame
            Noise-free experiment through the range, from rest at angle zero.
        structure : GrayBoxStructure
            ``disc.structure()``.
        disc : UnbalancedDisc
            The simulated disc.
        sampling_time : float
            Sampling period in s.
        operating_points : ndarray of shape (n_operating_points,)
            Angles of the points in rad.
        holding_voltages : ndarray of shape (n_operating_points,)
            Voltages there, about which the experiments are.
        analytic_models : list of StateSpace
            ``disc.linearize`` at each point (continuous time).
        DESCR : str
            What the data are.

    Raises
    ------
    ValueError
        If a number is out of its range.

    Examples
    --------
    >>> from lpvlearn.datasets import make_unbalanced_disc
    >>> data = make_unbalanced_disc(3, duration=2.0, large_duration=1.0, random_state=0)
    >>> data.X.shape, data.y.shape, data.X_large.shape
    ((600, 4), (600, 1), (100, 4))
    >>> data.holding_voltages.round(2)
    array([-4.4,  0. ,  4.4])
    """
    n_points = check_count("n_operating_points", n_operating_points)
    n_repeats = check_count("n_realizations", n_realizations)
    check_size("amplitude", amplitude)
    snr_db = decibels("snr_db", snr_db)
    rule = "positive and less than pi / 2: the disc is unstable beyond"
    reach = number("reach", reach, rule, above=0.0, high=np.nextafter(np.pi / 2, 0))
    disc = UnbalancedDisc(Fc=0.0) if disc is None else disc
    if not isinstance(disc, UnbalancedDisc):
        raise ValueError(
            f"`disc` must be an UnbalancedDisc or None. Got {shown(disc)}."
        )
    sampling_time = positive_time("sampling_time", sampling_time)
    n_samples = samples_of("duration", duration, sampling_time)
    n_large = samples_of("large_duration", large_duration, sampling_time)
    bit = samples_of("clock", clock, sampling_time)
    check_rows(
        n_operating_points=n_points, n_realizations=n_repeats, duration=n_samples
    )
    check_rows(large_duration=n_large)
    angles = np.linspace(-reach, reach, n_points) if n_points > 1 else np.zeros(1)
    voltages = disc.holding_voltage(angles)
    input_rng, noise_rng, local_rng, large_rng = spawn_generators(random_state, 4)

    def bits(n: int, rng: Generator) -> Array:
        return prbs(n, amplitude=amplitude, clock=bit, balance=20, random_state=rng).T

    def tables(
        u: Array, start: ArrayLike, n_repeats: int = 1, snr: float = np.inf
    ) -> tuple[pd.DataFrame, pd.DataFrame]:
        angle, _ = disc.simulate(u, start, sampling_time)
        X, y, dt = {"voltage": u, "kappa": angle}, angle[..., None], sampling_time
        return experiment_tables(X, y, ["angle"], dt, snr, n_repeats, noise_rng)

    def about_points(rng: Generator) -> Array:
        moved = [bits(n_samples, rng)[0] for _ in range(n_points)]
        return voltages[:, None] + np.array(moved)

    X, y = tables(about_points(input_rng), angles, n_repeats, snr_db)
    X_local, y_local = tables(about_points(local_rng), angles)
    t = np.arange(n_large) * sampling_time
    swing = disc.holding_voltage(_SINE_REACH * reach) * np.sin(_SINE_RATE * t)
    X_large, y_large = tables(
        swing + _SINE_BITS * bits(n_large, large_rng), np.zeros(1)
    )
    return Bunch(
        X=X,
        y=y,
        X_local=X_local,
        y_local=y_local,
        X_large=X_large,
        y_large=y_large,
        structure=disc.structure(),
        disc=disc,
        sampling_time=sampling_time,
        operating_points=angles,
        holding_voltages=voltages,
        analytic_models=[disc.linearize(angle) for angle in angles],
        DESCR=DESCR.format(
            n_points=n_points,
            low=angles[0],
            high=angles[-1],
            n_realizations=n_repeats,
            snr_db=snr_db,
            duration=duration,
            sampling_time=sampling_time,
        ),
    )
