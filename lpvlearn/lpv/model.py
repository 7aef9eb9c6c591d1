"""Linear parameter-varying models: matrices that follow the scheduling variables."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exceptions import DivergenceError, finite_simulation
from ..models.statespace import StateSpace, sorted_poles, split_delay
from ..models.system_matrix import blocks
from ..structures.structure import GrayBoxStructure
from ..systems.sampling import sample_zoh
from ..systems.simulation import delayed, state_trajectory
from ..systems.tabulation import tabulate
from ..validation import (
    finite_samples,
    input_delays,
    positive_time,
    real_array,
    state_vector,
)

Array = NDArray[np.float64]

# Samples whose matrices are held at once: for 6 states, 2 inputs and outputs 17 MB.
_BLOCK = 32_768


@dataclass(frozen=True, eq=False, repr=False)
class LPVStateSpace:
    """A continuous-time state-space model scheduled by measured variables, Eq. (1).

    ``dx/dt = A(kappa) x + B(kappa) u``, ``y = C(kappa) x + D(kappa) u`` with static
    dependence on the scheduling variables kappa, which act at once; an input may act
    late, ``u_j(t - input_delay[j])`` in the place of ``u_j(t)``.

    Parameters
    ----------
    structure : GrayBoxStructure
        From parameters to matrices.
    interpolator : fitted regressor
        From scheduling values (n_points, n_scheduling) to parameters (n_points,
        n_params). Says itself what it makes of values outside of the range.
    scheduling_range : array-like of shape (2, n_scheduling)
        Smallest and largest scheduling values that the model was identified on.
    input_delay : float or array-like of shape (n_inputs,), default=0
        Seconds, whole samples of every simulation. As attribute, an array.

    Attributes
    ----------
    order, n_inputs, n_outputs, n_scheduling : int
        Numbers of states, inputs, outputs and scheduling variables.

    Raises
    ------
    ValueError
        If `scheduling_range` is not two rows of finite numbers, the first not above
        the second, or a delay is negative.

    Examples
    --------
    A spring that stiffens with the scheduling variable:

    >>> import numpy as np
    >>> from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV
    >>> structure = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", -0.5]], B=[[0], [1]], C=[[1, 0]])
    >>> kappa = np.array([[0.0], [1.0]])
    >>> stiffness = PolynomialLPV(degree=1).fit(kappa, [[4.0], [9.0]])
    >>> lpv = LPVStateSpace(structure, stiffness, kappa)
    >>> lpv.at(0.5).A
    array([[ 0. ,  1. ],
           [-6.5, -0.5]])
    >>> lpv.parameters([0.0, 0.5]).round(9).ravel()
    array([4. , 6.5])
    >>> np.abs(lpv.frozen_poles([0.0, 1.0])).round(9)
    array([[2., 2.],
           [3., 3.]])

    A simulation along a trajectory, and the part that an initial state adds:

    >>> trajectory = np.linspace(0, 1, 500)
    >>> y = lpv.simulate(np.ones(500), trajectory, sampling_time=0.1)
    >>> moved = lpv.simulate(np.ones(500), trajectory, 0.1, initial_state=[1, 0])
    >>> free = lpv.free_responses(trajectory, sampling_time=0.1)
    >>> np.allclose(moved - y, free @ [1, 0])
    True
    """

    structure: GrayBoxStructure
    interpolator: Any
    scheduling_range: Array
    input_delay: Any = 0
    order: int = field(init=False)
    n_inputs: int = field(init=False)
    n_outputs: int = field(init=False)
    n_scheduling: int = field(init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.structure, GrayBoxStructure):
            raise ValueError(
                "`structure` must be a GrayBoxStructure. Got "
                f"{type(self.structure).__name__}."
            )
        if not hasattr(self.interpolator, "predict"):
            raise ValueError(
                "`interpolator` must be a fitted regressor, such as PolynomialLPV. Got "
                f"{type(self.interpolator).__name__}."
            )
        bounds = real_array("scheduling_range", self.scheduling_range)
        if bounds.ndim != 2 or len(bounds) != 2 or not (bounds[0] <= bounds[1]).all():
            raise ValueError(
                "`scheduling_range` must have shape (2, n_scheduling), smallest values "
                f"first. Got {bounds.tolist()}."
            )
        bounds.setflags(write=False)
        object.__setattr__(self, "scheduling_range", bounds)
        object.__setattr__(self, "n_scheduling", bounds.shape[1])
        for name in ("order", "n_inputs", "n_outputs"):
            object.__setattr__(self, name, getattr(self.structure, name))
        delay = input_delays(self.input_delay, self.n_inputs, samples=False)
        object.__setattr__(self, "input_delay", delay)

    def __repr__(self) -> str:
        each = ", ".join(f"{d:g}" for d in self.input_delay)
        return (
            f"LPVStateSpace(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, n_scheduling={self.n_scheduling}"
            f"{f', input_delay=[{each}] s' if self.input_delay.any() else ''})"
        )

    def parameters(self, kappa: ArrayLike) -> Array:
        """Parameters at scheduling values.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling), or (n_points,) for one
            scheduling variable

        Returns
        -------
        ndarray of shape (n_points, n_params)

        Raises
        ------
        ValueError
            If `kappa` has another shape or is not finite.
        """
        kappa = self._scheduling(kappa)
        values = np.asarray(self.interpolator.predict(kappa), dtype=float)
        n_params = self.structure.n_params
        if values.size != len(kappa) * n_params:
            raise ValueError(
                f"`interpolator` must predict the {n_params} parameters of the "
                f"structure. Got shape {values.shape} for {len(kappa)} point(s)."
            )
        return values.reshape(len(kappa), n_params)

    def at(self, kappa: ArrayLike) -> StateSpace:
        """The frozen model at one scheduling value, Eq. (2).

        Parameters
        ----------
        kappa : float or array-like of shape (n_scheduling,)

        Returns
        -------
        StateSpace
            In continuous time.

        Raises
        ------
        ValueError
            If `kappa` is not one finite value of every scheduling variable.
        """
        theta = self.parameters(np.reshape(kappa, (1, -1)))[0]
        return self.structure.model(theta).with_input_delay(self.input_delay)

    def frozen_poles(self, kappa: ArrayLike) -> NDArray[np.complex128]:
        """Poles (rad/s) of the frozen models, each row by modulus.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling) or (n_points,)

        Returns
        -------
        ndarray of shape (n_points, order)

        Raises
        ------
        ValueError
            If `kappa` has another shape or is not finite.
        """
        return sorted_poles(self.structure.matrices(self.parameters(kappa))[0])

    def simulate(
        self,
        u: ArrayLike,
        scheduling: ArrayLike,
        sampling_time: float,
        initial_state: ArrayLike | None = None,
    ) -> Array:
        """Simulate along a measured scheduling trajectory.

        Input and scheduling are held over each sampling period, so that a constant
        scheduling gives exactly the sampled LTI model.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        scheduling : array-like of shape (n_samples, n_scheduling) or (n_samples,)
        sampling_time : float
            Seconds.
        initial_state : array-like of shape (order,), default=None
            None is rest. The inputs before the first sample are zero; those in transit
            may follow the state, as `StateSpace.estimate_initial_state` has them.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs)

        Raises
        ------
        ValueError
            If shapes do not fit, a value is not finite, a delay is no whole number of
            samples, or the structure gives no finite matrices at a scheduling value.
        DivergenceError
            If the outputs overflow; the first sample and value are told.
        """
        u = finite_samples("u", u, self.n_inputs)
        delay, n = self._samples_of_delay(sampling_time), self.order
        x = np.zeros(n) if initial_state is None else initial_state
        x, before = np.split(state_vector(x, n, int(delay.sum())), [n])
        late = delayed(u, delay, before)[:, :, None]
        kappa = self._scheduling(scheduling)
        return self._response(late, kappa, sampling_time, x[:, None])[:, :, 0]

    def free_responses(self, scheduling: ArrayLike, sampling_time: float) -> Array:
        """Outputs that each unit initial state, and input in transit, causes.

        Parameters
        ----------
        scheduling : array-like of shape (n_samples, n_scheduling) or (n_samples,)
        sampling_time : float
            Seconds.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs, order + n_in_transit)
            ``y = free_responses @ x0`` for ``u = 0``: regressors of an initial state,
            with one entry for each sample of delay after it.

        Raises
        ------
        ValueError
            As `simulate`.
        """
        kappa, n = self._scheduling(scheduling), self.order
        delay = self._samples_of_delay(sampling_time)
        unit = np.eye(n + delay.sum())
        if not delay.any():  # which spares the inputs
            return self._response(
                np.zeros((len(kappa), 0, n)), kappa, sampling_time, unit
            )
        none = np.zeros((len(kappa), self.n_inputs, len(unit)))
        late = delayed(none, delay, unit[n:])
        return self._response(late, kappa, sampling_time, unit[:n])

    def _samples_of_delay(self, sampling_time: float) -> NDArray[np.intp]:
        """Delays in samples, which they must be a whole number of."""
        dt = positive_time("sampling_time", sampling_time)
        whole, rest = split_delay(self.input_delay, dt)
        if rest.any():
            raise ValueError(
                "`sampling_time` must divide the input delay of "
                f"{self.input_delay.tolist()} s. Got {dt:g} s. Resample the record, or "
                "round the delay: dataclasses.replace(model, input_delay=...)."
            )
        return whole

    def silenced(self) -> LPVStateSpace:
        """The model whose interpolator extrapolates without a warning."""
        known: dict[str, Any] = getattr(self.interpolator, "get_params", dict)()
        loud = [
            name
            for name, value in known.items()
            if name.split("__")[-1] == "extrapolation" and value == "warn"
        ]
        quiet = copy.deepcopy(self.interpolator) if loud else self.interpolator
        for name in loud:
            quiet.set_params(**{name: "ignore"})
        return replace(self, interpolator=quiet)

    def _response(self, u: Array, kappa: Array, dt: float, x: Array) -> Array:
        """Outputs of runs along one trajectory: inputs (n_samples, n_inputs, n_runs).

        ``x[k+1] = A(kappa_k) x[k] + B(kappa_k) u[k]`` with the zero-order-hold matrices
        at every sample, a block of samples at a time. Inputs left out are zero.
        """
        dt = positive_time("sampling_time", dt)
        if len(kappa) != len(u):
            raise ValueError(
                f"`scheduling` must have one row for each of the {len(u)} samples of "
                f"`u`. Got {len(kappa)}."
            )
        low, high = self.scheduling_range
        model = self
        if ((kappa < low) | (kappa > high)).any():
            self.interpolator.predict(kappa)  # which says how far out the samples are
            model = self.silenced()  # not once more, of the nodes of the table
        y = np.empty((len(u), self.n_outputs, u.shape[2]))
        for start in range(0, len(u), _BLOCK):
            rows = slice(start, start + _BLOCK)
            S = model._held_matrices(kappa[rows], dt)
            A, B, C, D = blocks(S[:, :, : self.order + u.shape[1]], self.order)
            forcing = B @ u[rows]
            with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
                states = state_trajectory(A, forcing, x)
                y[rows] = C @ states + D @ u[rows]
                x = A[-1] @ states[-1] + forcing[-1]
        return finite_simulation(y, lambda: model._why_it_diverges(kappa))

    def _why_it_diverges(self, kappa: Array) -> str:
        """The worst of the frozen models along a trajectory, and what may be wrong."""
        poles = self.frozen_poles(kappa).real.max(axis=1, initial=-np.inf)
        worst = int(poles.argmax())
        if poles[worst] < 0:
            return "All frozen models along `scheduling` are stable: look at the input."
        low, high = self.scheduling_range
        beyond = ((kappa[worst] < low) | (kappa[worst] > high)).any()
        cause = (
            "It is outside of the identified range: identify a model there too, or "
            "hold the border's by PolynomialLPV(extrapolation='clip')."
            if beyond
            else "Look at the parameters of the local models: inputs or outputs about "
            "an offset, shuffled rows, or times in another unit spoil them. If they "
            "are right, lower the degree of the polynomial."
        )
        return (
            f"The frozen model at scheduling {kappa[worst].round(6).tolist()} is "
            f"unstable: a pole has real part {poles[worst]:.4g} 1/s. {cause}"
        )

    def _held_matrices(self, kappa: Array, dt: float) -> Array:
        """``[[Ad, Bd], [C, D]]`` at every row of `kappa`."""

        def held(points: Array) -> Array:
            points = points.reshape(-1, self.n_scheduling)
            A, B, C, D = self.structure.matrices(self.parameters(points))
            finite = np.isfinite(A).all((1, 2)) & np.isfinite(B).all((1, 2))
            if not finite.all():
                raise ValueError(
                    "`structure` must give finite matrices along `scheduling`. Got a "
                    f"NaN or infinity at {points[~finite][0]}."
                )
            try:
                Ad, Bd = sample_zoh(A, B, dt)
            except ValueError:  # it overflows within a sample
                raise DivergenceError(
                    f"the simulation diverges within one sample of {dt:g} s. "
                    f"{self._why_it_diverges(points)}"
                ) from None
            upper, lower = np.concatenate([Ad, Bd], 2), np.concatenate([C, D], 2)
            return np.concatenate([upper, lower], 1)

        if self.n_scheduling == 1:
            return tabulate(held, kappa[:, 0])
        if (kappa == kappa[0]).all():
            S = held(kappa[:1])
            return np.broadcast_to(S[0], (len(kappa), *S.shape[1:]))
        return held(kappa)

    def _scheduling(self, kappa: ArrayLike) -> Array:
        values = real_array("scheduling", kappa)
        if values.ndim < 2:
            values = values.reshape(-1, 1)
        if values.ndim != 2 or values.shape[1] != self.n_scheduling:
            raise ValueError(
                f"`scheduling` must have {self.n_scheduling} columns. Got shape "
                f"{np.shape(kappa)}."
            )
        if not np.isfinite(values).all():
            k = int(np.argwhere(~np.isfinite(values))[0, 0])
            raise ValueError(
                f"`scheduling` must be finite. Got {values[k]} in row {k}."
            )
        return values
