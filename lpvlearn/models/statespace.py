"""Linear state-space models as small immutable value objects."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..exceptions import (
    WRITTEN_BY,
    VersionedPickle,
    finite_simulation,
    version,
    warn,
)
from ..systems.balancing import Balancing, align_signs, balancing_transformations
from ..systems.hinf_norm import hinf_norm
from ..systems.response import frequency_response
from ..systems.sampling import (
    c2d_foh,
    c2d_tustin,
    d2c_held,
    d2c_tustin,
    sample_zoh_late,
)
from ..systems.simulation import (
    beside_transit,
    delayed,
    estimate_initial_state,
    free_responses,
    lti_response,
    spread_of,
)
from ..validation import (
    finite_samples,
    frequencies,
    input_delays,
    matrix,
    measured_samples,
    names_of,
    one_of,
    optional_module,
    positive_time,
    squarable,
    state_vector,
    units_by_name,
    whole_number,
)

Array = NDArray[np.float64]

# Sampling times that agree to this are one: times come from columns of tables, whose
# differences carry rounding (1e-9 s at 1000 s, beside steps of a millisecond).
_SAME_TIME = 1e-6

_SINGULAR = 1e14  # a change of basis worse conditioned, once scaled, leaves two digits

_METHODS = ("zoh", "foh", "tustin")


@dataclass(frozen=True, eq=False, repr=False, init=False)
class StateSpace(VersionedPickle):
    """A linear time-invariant model in state-space form.

    Continuous time, ``dx/dt = A x + B u, y = C x + D u``, or discrete time,
    ``x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k]``; every input may act late,
    ``u_j(t - input_delay[j])`` in the place of ``u_j(t)``.

    Parameters
    ----------
    A : array-like of shape (order, order)
    B : array-like of shape (order, n_inputs)
    C : array-like of shape (n_outputs, order)
    D : array-like of shape (n_outputs, n_inputs), default=None
        None is no feedthrough.
    sampling_time : float or True, default=None
        Seconds between samples; None is continuous time. True is discrete time with a
        step that is not known: time is counted in samples, frequencies in radians per
        sample, and there is no way to continuous time.
    input_delay : number or array-like of shape (n_inputs,), default=0
        Delay of the inputs, beyond what the matrices make: samples in discrete time,
        seconds in continuous time. As attribute, an array with one of each input.
    input_names, output_names : sequence, default=None
        Names of the signals; None: they are numbered. Conversions keep them.
    units : dict of str to str, default=None
        Units of the signals, by name.

    Attributes
    ----------
    order, n_inputs, n_outputs : int
        Numbers of states, inputs and outputs.

    Raises
    ------
    ValueError
        If the shapes do not fit together, an entry is not a finite real number, or a
        delay is negative or, in discrete time, not a whole number.

    Notes
    -----
    A pure gain has order 0: ``StateSpace([], [], [], D)``. The arrays of a model are
    read-only; a change makes a new model.

    A delay stands beside the matrices. It is in the responses of a model, and does
    nothing to its poles and norms, nor to Hankel singular values and balancing, which
    are those of the matrices. `absorb_delay` makes states of it.

    Examples
    --------
    >>> from lpvlearn import StateSpace
    >>> lag = StateSpace([[-2.0]], [[2.0]], [[1.0]])
    >>> lag.poles()
    array([-2.+0.j])
    >>> lag.to_discrete(0.1).dc_gain()
    array([[1.]])
    """

    A: Array
    B: Array
    C: Array
    D: Array
    sampling_time: float | None
    input_delay: NDArray[Any]
    input_names: Sequence[Hashable] | None
    output_names: Sequence[Hashable] | None
    units: Mapping[str, str] | None
    order: int = field(init=False)
    n_inputs: int = field(init=False)
    n_outputs: int = field(init=False)

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike | None = None,
        sampling_time: float | None = None,
        input_delay: ArrayLike = 0,
        input_names: Sequence[Hashable] | None = None,
        output_names: Sequence[Hashable] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        A, B, C = matrix("A", A), matrix("B", B), matrix("C", C)
        n = len(A)
        if A.shape != (n, n):
            raise ValueError(f"`A` must be square. Got shape {A.shape}.")
        if D is not None:
            D = matrix("D", D)
            if n == 0:  # a pure gain: `[]` for B and C takes its shape from D
                B = np.zeros((0, D.shape[1])) if B.shape == (0, 0) else B
                C = np.zeros((D.shape[0], 0)) if C.shape == (0, 0) else C
        if B.shape[0] != n or C.shape[1] != n:
            raise ValueError(
                f"`B` needs {n} rows and `C` {n} columns to fit `A` of shape "
                f"{A.shape}. Got B {B.shape}, C {C.shape}."
            )
        shape = (C.shape[0], B.shape[1])
        D = np.zeros(shape) if D is None else D
        if D.shape != shape:
            raise ValueError(
                f"`D` must have shape {shape} to fit B and C. Got {D.shape}."
            )
        if 0 in shape:
            raise ValueError(
                "a model needs at least one input and one output; a pure gain takes "
                f"them from `D`. Got {shape[1]} inputs and {shape[0]} outputs."
            )
        for name, value in zip("ABCD", (A, B, C, D), strict=True):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        dt = sampling_time
        if dt is not None and dt is not True:
            dt = positive_time("sampling_time", dt)
        delay = input_delays(input_delay, shape[1], samples=dt is not None)
        names = ("sampling_time", "input_delay", "order", "n_outputs", "n_inputs")
        for name, number in zip(names, (dt, delay, n, *shape), strict=True):
            object.__setattr__(self, name, number)
        for name, given, n in (
            ("input_names", input_names, self.n_inputs),
            ("output_names", output_names, self.n_outputs),
        ):
            listed = given
            if given is not None:
                listed = names_of(name, given, n, of_columns=True)
            object.__setattr__(self, name, listed)
        object.__setattr__(self, "units", units_by_name(units))

    def _of(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike,
        sampling_time: float | None = None,
        input_delay: ArrayLike = 0,
    ) -> StateSpace:
        """Another model of the same signals."""
        names = self.input_names, self.output_names, self.units
        return StateSpace(A, B, C, D, sampling_time, input_delay, *names)

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles are built anew, so that their arrays are read-only too.
        matrices = self.A, self.B, self.C, self.D
        names = self.input_names, self.output_names, self.units
        given = (*matrices, self.sampling_time, self.input_delay, *names)
        return type(self), given, {WRITTEN_BY: version()}

    def __repr__(self) -> str:
        dt = self.sampling_time
        named = {None: "continuous time", True: "time in samples"}
        time = f"sampling_time={dt:g}" if isinstance(dt, float) else named[dt]
        if self.input_delay.any():
            each = ", ".join(f"{d:g}" for d in self.input_delay)
            time += f", input_delay=[{each}]{' s' if dt is None else ''}"
        return (
            f"{type(self).__name__}(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, {time})"
        )

    @property
    def is_continuous(self) -> bool:
        """True for a continuous-time model."""
        return self.sampling_time is None

    @property
    def is_stable(self) -> bool:
        """True if all poles are strictly inside the stability region, however near.

        Nearer than 1e-13 of its size a pole counts as on the border to `hinf_norm`.
        """
        return bool((self._growth(self.poles()) < 0).all())

    def _growth(self, poles: NDArray[np.complex128]) -> Array:
        """Signed distance of poles from the border of the stability region."""
        return poles.real if self.is_continuous else np.abs(poles) - 1.0

    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A (rad/s in continuous time), by increasing modulus.

        Examples
        --------
        >>> StateSpace([[0, 1], [-4, 0]], [[0], [1]], [[1, 0]]).poles()
        array([0.-2.j, 0.+2.j])
        """
        return sorted_poles(self.A)

    def frequency_response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Response ``C (s I - A)^-1 B + D`` on the imaginary axis or unit circle.

        An input with a delay d turns its column by ``exp(-j omega d)``.

        Parameters
        ----------
        omega : array-like of shape (n_freq,)
            Angular frequencies, rad/s; may hold infinity in continuous time.

        Returns
        -------
        ndarray of shape (n_freq, n_outputs, n_inputs)
            Infinite at a pole. At infinite frequency without the turn of a delay, which
            has no limit there.

        Raises
        ------
        ValueError
            If `omega` is not a vector of real numbers, or is infinite for a
            discrete-time model.

        Examples
        --------
        >>> StateSpace(-2, 2, 1).frequency_response([0.0, 2.0])[:, 0, 0]
        array([1. +0.j , 0.5-0.5j])
        """
        omega, dt = frequencies(omega), self.sampling_time
        with np.errstate(over="ignore", invalid="ignore"):  # of no number: infinite
            G = frequency_response(self.A, self.B, self.C, self.D, omega, dt=dt)
        if self.input_delay.any():
            turn = np.where(np.isfinite(omega), omega, 0.0)[:, None, None]
            late = np.exp(-1j * turn * self.input_delay * (dt or 1.0))
            np.multiply(G, late, out=G, where=np.isfinite(G))
        return G

    def dc_gain(self) -> Array:
        """Gain at zero frequency, shape (n_outputs, n_inputs); infinite at a pole.

        Examples
        --------
        >>> StateSpace(-2, 1, 1).dc_gain()
        array([[0.5]])
        """
        return np.real(self.frequency_response([0.0])[0])

    def hinf_norm(self) -> float:
        """H-infinity norm: the largest singular value over all frequencies.

        Infinite for an unstable model. Computed from Hamiltonian eigenvalues (level
        sets), Eq. (15)-(17), to a relative accuracy of 1e-10, or of what one unit in
        the last place of the matrices makes: beside a pole at the relative distance d
        from the border of stability some 1e-16 / d. At d below 1e-13 the pole counts as
        on the border, and the norm is infinite. Delays do not change it.

        Examples
        --------
        >>> StateSpace(-2, 1, 1).hinf_norm()
        0.5
        """
        dt = self.sampling_time
        with np.errstate(over="ignore", invalid="ignore"):
            return hinf_norm(self.A, self.B, self.C, self.D, dt=dt).norm

    def simulate(
        self,
        u: ArrayLike,
        *,
        sampling_time: float | None = None,
        initial_state: ArrayLike | None = None,
    ) -> Array:
        """Simulate the response to a sampled input.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs) or (n_samples,)
        sampling_time : float, default=None
            Seconds between the samples of `u`; needed by a continuous-time model, whose
            input is held between samples (zero-order hold, exact).
        initial_state : array-like of shape (order,), default=None
            None is rest. The inputs before the first sample are zero; of a
            discrete-time model those in transit may follow the state, as
            `estimate_initial_state` returns them.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs)

        Raises
        ------
        ValueError
            If a shape does not fit, a value is not finite, or `sampling_time` is
            missing or not that of the discrete-time model.
        DivergenceError
            If the outputs overflow; the first sample and value are told.

        Examples
        --------
        >>> StateSpace(0.5, 1, 1, sampling_time=1.0).simulate([1, 1, 1]).ravel()
        array([0. , 1. , 1.5])
        """
        u = finite_samples("u", u, self.n_inputs)
        model, dt = self, self.sampling_time
        if dt is None or sampling_time is not None:
            held = positive_time("sampling_time", sampling_time)
            if dt is None:
                model = self.to_discrete(held)
            elif not _same_time(held, dt):
                raise ValueError(
                    f"`sampling_time` must be {dt} s, the model's own. "
                    f"Got {sampling_time}. Convert with to_continuous() first."
                )
        n, delay = model.order, model.input_delay
        x0 = before = None
        if initial_state is not None:
            n_more = n - self.order + int(delay.sum())
            x0, before = np.split(state_vector(initial_state, self.order, n_more), [n])
        u = delayed(u, delay, before)
        with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
            y = lti_response(model.A, model.B, model.C, model.D, u, x0)
        return finite_simulation(y, self._why_it_diverges)

    def _why_it_diverges(self) -> str:
        if self.is_stable:
            return "The model is stable: scale `u` or `initial_state` down."
        poles = self.poles()
        worst = poles[self._growth(poles).argmax()]
        return (
            f"The model is unstable (a pole at {worst:.6g}): use stability='enforce' "
            "of SubspaceLTI, or a shorter record."
        )

    def estimate_initial_state(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Initial state of a discrete-time model with which it fits a record best.

        The least-squares solution over all samples, in which outputs count by how far
        they move; of minimum norm where the record does not determine it. With delays
        the inputs in transit, sent before the record began, are estimated as well.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs) or (n_samples,)
        y : array-like of shape (n_samples, n_outputs) or (n_samples,)
            Missing values (NaN) are left out.

        Returns
        -------
        ndarray of shape (order + sum(input_delay),)
            To be given to `simulate` as `initial_state`: the state, then for one input
            after another those that arrive with sample 0, 1, ...; it is the state of
            the model that `absorb_delay` returns.

        Raises
        ------
        ValueError
            If the model is in continuous time, a shape does not fit, or another value
            is not finite.

        Examples
        --------
        >>> model = StateSpace(0.5, 1, 2, sampling_time=1.0)
        >>> y = model.simulate([1, 1, 1], initial_state=[3])
        >>> model.estimate_initial_state([1, 1, 1], y)
        array([3.])
        """
        if self.is_continuous:
            raise ValueError(
                "`estimate_initial_state` needs a discrete-time model. Got "
                f"{self}. Convert with to_discrete(sampling_time) first."
            )
        u = squarable("u", finite_samples("u", u, self.n_inputs))
        y = measured_samples(y, len(u), self.n_outputs)
        error = y - self.simulate(u)
        with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
            free = unknown_responses(self, len(y))
        finite_simulation(free, self._why_it_diverges)
        return estimate_initial_state(free, error, spread_of(y))

    def with_input_delay(self, input_delay: ArrayLike) -> StateSpace:
        """The model with other delays: `input_delay` as of the class, 0 for none.

        Examples
        --------
        >>> late = StateSpace(0.5, 1, 1, sampling_time=1.0).with_input_delay(2)
        >>> late.simulate([1, 1, 1, 1]).ravel()
        array([0., 0., 0., 1.])
        """
        dt = self.sampling_time
        return self._of(self.A, self.B, self.C, self.D, dt, input_delay)

    def with_names(
        self,
        input_names: Sequence[Hashable] | None = None,
        output_names: Sequence[Hashable] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> StateSpace:
        """The model with other names and units of its signals, as of the class.

        Examples
        --------
        >>> StateSpace(-1, 1, 1).with_names(["force"], ["speed"]).output_names
        ['speed']
        """
        matrices = self.A, self.B, self.C, self.D
        names = input_names, output_names, units
        return StateSpace(*matrices, self.sampling_time, self.input_delay, *names)

    def absorb_delay(self) -> StateSpace:
        """The same discrete-time model with its delays as states, poles at the origin.

        Returns
        -------
        StateSpace
            Of order ``order + sum(input_delay)``: the states, then for one input after
            another the values in transit, the next to arrive first.

        Raises
        ------
        ValueError
            If the model is in continuous time: a delay there is no finite number of
            states.

        Examples
        --------
        >>> late = StateSpace(0.5, 1, 1, sampling_time=1.0, input_delay=2)
        >>> late.absorb_delay()
        StateSpace(order=3, n_inputs=1, n_outputs=1, sampling_time=1)
        """
        if not self.input_delay.any():
            return self
        if self.is_continuous:
            raise ValueError(
                "`absorb_delay` needs a discrete-time model: no finite number of "
                f"states is a delay in continuous time. Got {self}. Sample it with "
                "to_discrete(sampling_time) first, or leave the delay out by "
                "with_input_delay(0)."
            )
        n, delay = self.order, self.input_delay
        size = n + int(delay.sum())
        A, B = np.zeros((size, size)), np.zeros((size, self.n_inputs))
        C, D = np.zeros((self.n_outputs, size)), self.D.copy()
        A[:n, :n], B[:n], C[:, :n] = self.A, self.B, self.C
        first = n
        for j, d in enumerate(delay):
            if d == 0:
                continue
            last = first + d
            A[:n, first], C[:, first] = self.B[:, j], self.D[:, j]
            A[first : last - 1, first + 1 : last] = np.eye(d - 1)
            B[:, j], D[:, j] = 0.0, 0.0
            B[last - 1, j] = 1.0
            first = last
        return self._of(A, B, C, D, self.sampling_time)

    def transform(self, T: ArrayLike) -> StateSpace:
        """Change the state basis: ``(T A T^-1, T B, C T^-1, D)``.

        Parameters
        ----------
        T : array-like of shape (order, order)
            Invertible; the new state is ``T x``.

        Raises
        ------
        ValueError
            If T has another shape or is singular.

        Examples
        --------
        >>> StateSpace(-1, 2, 3).transform(2).B
        array([[4.]])
        """
        T = matrix("T", T)
        if T.shape != self.A.shape:
            raise ValueError(f"`T` must have shape {self.A.shape}. Got {T.shape}.")
        # Units may differ by any factor: only directions tell that T is singular.
        tiny = np.finfo(float).tiny  # a row or column of zeros stays one
        scaled = T / np.maximum(np.abs(T).max(1, keepdims=True, initial=0), tiny)
        scaled /= np.maximum(np.abs(scaled).max(0, initial=0), tiny)
        if self.order and not np.linalg.cond(scaled) < _SINGULAR:
            raise ValueError("`T` must be invertible. Got a singular matrix.")
        A, C = (np.linalg.solve(T.T, M.T).T for M in (T @ self.A, self.C))
        dt = self.sampling_time
        return self._of(A, T @ self.B, C, self.D, dt, self.input_delay)

    def __sub__(self, other: StateSpace) -> StateSpace:
        """The error system ``G - G_other``, whose norms are distances (Eq. (8))."""
        if not isinstance(other, StateSpace):
            return NotImplemented
        same_time = _same_time(other.sampling_time, self.sampling_time)
        if other.D.shape != self.D.shape or not same_time:
            raise ValueError(
                "models to subtract must have the same inputs, outputs and sampling "
                f"time. Got {self} and {other}."
            )
        dt = other.sampling_time if self.sampling_time is True else self.sampling_time
        delay = self.input_delay
        if not np.allclose(other.input_delay, delay, rtol=_SAME_TIME, atol=0.0):
            raise ValueError(
                "models to subtract must have the same `input_delay`: their difference "
                f"is no state-space model otherwise. Got {self} and {other}. Make "
                "states of the delays of discrete-time models by absorb_delay(), or "
                "compare what is left of them by with_input_delay(0)."
            )
        n, k = self.order, other.order
        A = np.zeros((n + k, n + k))
        A[:n, :n], A[n:, n:] = self.A, other.A
        B, C = np.vstack([self.B, other.B]), np.hstack([self.C, -other.C])
        return self._of(A, B, C, self.D - other.D, dt, delay)

    def hankel_singular_values(self) -> Array:
        """Hankel singular values of a stable model, descending, shape (order,).

        Examples
        --------
        >>> StateSpace(-2, 2, 1).hankel_singular_values()
        array([0.5])
        """
        return _balancings("hankel_singular_values", [self])[0].hankel

    def balance(self, order: int | None = None) -> StateSpace:
        """Balanced realisation: both Gramians equal and diagonal.

        Parameters
        ----------
        order : int, default=None
            Keep at most that many states (balanced truncation). States that are not
            controllable or not observable to rounding are never kept.

        Raises
        ------
        ValueError
            If the model is unstable (its Gramians do not exist).

        Examples
        --------
        >>> model = StateSpace([[-1, 0], [0, -5]], [[1], [1]], [[1, 1e-3]])
        >>> model.balance(order=1)
        StateSpace(order=1, n_inputs=1, n_outputs=1, continuous time)
        """
        own = _balancings("balance", [self])[0]
        if order is not None:
            order = whole_number("order", order, 0, self.order)
        return self._projected(own.left[:order], own.right[:, :order])

    def _projected(self, left: Array, right: Array) -> StateSpace:
        """What is left of the states, with signs by which inputs push them up."""
        A, B, C = left @ self.A @ right, left @ self.B, self.C @ right
        signs = np.where(B.sum(1) < 0, -1.0, 1.0)
        A, B, C = signs[:, None] * A * signs, signs[:, None] * B, C * signs
        return self._of(A, B, C, self.D, self.sampling_time, self.input_delay)

    def to_discrete(self, sampling_time: float, method: str = "zoh") -> StateSpace:
        """Sample a continuous-time model.

        Parameters
        ----------
        sampling_time : float
            Seconds.
        method : {"zoh", "foh", "tustin"}, default="zoh"
            The hold of order zero is exact for inputs held between samples, that of
            order one for inputs that go on linearly from sample to sample, as smooth
            ones nearly do (its state is ``x - B1 u``); Tustin is the bilinear
            approximation. A delay that is no whole number of samples stays exact with
            "zoh" by one state more for its input.

        Raises
        ------
        ValueError
            If the model is discrete, a pole is at 2 / sampling_time for "tustin", a
            delay no whole number of samples for another than "zoh", or the sampled
            model overflows.

        Examples
        --------
        >>> StateSpace(0, 1, 1).to_discrete(0.5).B
        array([[0.5]])
        """
        if not self.is_continuous:
            raise ValueError(
                f"`to_discrete` needs a continuous-time model. Got {self}. Convert "
                "with to_continuous() first."
            )
        dt = positive_time("sampling_time", sampling_time)
        one_of("method", method, _METHODS)
        delay, late = split_delay(self.input_delay, dt)
        matrices = self.A, self.B, self.C, self.D
        if method == "zoh":
            return self._of(*sample_zoh_late(*matrices, dt, late), dt, delay)
        if late.any():
            raise ValueError(
                f"`method={method!r}` needs delays that are whole numbers of samples "
                f"of {dt:g} s. Got {self}. Use `method='zoh'`, which is exact."
            )
        sample = c2d_foh if method == "foh" else c2d_tustin
        return self._of(*sample(*matrices, dt), dt, delay)

    def to_continuous(self, method: str = "zoh") -> StateSpace:
        """Convert a discrete-time model to continuous time.

        Parameters
        ----------
        method : {"zoh", "foh", "tustin"}, default="zoh"
            "zoh" is the matrix logarithm, exact for inputs held between samples, "foh"
            the same for inputs that go on linearly from sample to sample; "tustin" is
            the bilinear approximation, which warps frequencies.

        Raises
        ------
        ValueError
            If a pole has no continuous equivalent (at -1 for "tustin", else at 0), or
            the sampling time is not known.

        Warns
        -----
        RuntimeWarning
            If a pole on the negative real axis becomes a pair (but for "tustin").

        Examples
        --------
        >>> StateSpace(1, 0.5, 1, sampling_time=0.5).to_continuous().B
        array([[1.]])
        """
        one_of("method", method, _METHODS)
        if self.sampling_time is None:
            return self
        dt = self.sampling_time
        if dt is True:
            raise ValueError(
                "`sampling_time` must be known for continuous time. Got a model that "
                "counts time in samples. Identify it with `time=` (a column of X) or "
                "`sampling_time=` (seconds; 1 where a sample is the unit of time)."
            )
        if method == "tustin":
            matrices = d2c_tustin(self.A, self.B, self.C, self.D, dt)
            return self._of(*matrices, input_delay=dt * self.input_delay)
        A, B, C, D, doubled = d2c_held(self.A, self.B, self.C, self.D, dt, method)
        if len(doubled):
            warn(
                f"{len(doubled)} pole(s) on the negative real axis "
                f"({', '.join(f'{p:.3g}' for p in doubled)}) have no real "
                "logarithm; each becomes a pair at the Nyquist frequency and the order "
                "grows by one. A shorter sampling time or a lower order avoids it.",
                RuntimeWarning,
            )
        return self._of(A, B, C, D, input_delay=dt * self.input_delay)

    def _refuse_delay(self, asked_by: str, other: str) -> None:
        """Refuse a delay, which the models of another library do not have."""
        if self.input_delay.any():
            raise ValueError(
                f"`{asked_by}` needs a model without delay, which {other} does not "
                f"know. Got {self}. Make states of it by absorb_delay() (in continuous "
                "time after to_discrete(sampling_time)), or leave it out by "
                "with_input_delay(0)."
            )

    def to_control(self, **names: Any) -> Any:
        """The model as a ``control.StateSpace`` (needs python-control).

        Parameters
        ----------
        **names : str or list of str
            `name`, `inputs`, `outputs` and `states` of ``control.ss``; inputs and
            outputs are by default the names of the model, with ``_`` for a dot, which
            may not stand there.

        Raises
        ------
        ValueError
            If the model has a delay, which python-control does not know.
        """
        self._refuse_delay("to_control", "python-control")
        control = optional_module("control", "to_control", "control")
        for key in ("inputs", "outputs"):
            own = getattr(self, f"{key[:-1]}_names")
            if own is not None:
                names.setdefault(key, [str(name).replace(".", "_") for name in own])
        dt = 0 if self.is_continuous else self.sampling_time
        return control.ss(self.A, self.B, self.C, self.D, dt, **names)

    def to_scipy(self) -> Any:
        """The model as a ``scipy.signal.StateSpace``, with or without ``dt``.

        What that knows of one input and output: ``step()`` and ``impulse()``,
        ``to_zpk()`` and ``to_tf()``. Of several it has no zeros; python-control does.

        Raises
        ------
        ValueError
            If the model has a delay, which SciPy does not know.

        Examples
        --------
        >>> lag = StateSpace(-2.0, 1.0, 6.0)
        >>> time, response = lag.to_scipy().step(T=np.array([0.0, 10.0]))
        >>> response.round(3)
        array([0., 3.])
        """
        self._refuse_delay("to_scipy", "SciPy")
        from scipy import signal

        options = {} if self.is_continuous else {"dt": self.sampling_time}
        return signal.StateSpace(self.A, self.B, self.C, self.D, **options)

    @classmethod
    def from_control(cls, model: Any) -> StateSpace:
        """Copy a python-control state-space model.

        Raises
        ------
        ValueError
            If `model` is not in state space, or its sampling time is not known.
        """
        if not all(hasattr(model, name) for name in ("A", "B", "C", "D", "dt")):
            raise ValueError(
                "`model` must be a control.StateSpace (convert with control.ss). Got "
                f"{type(model).__name__}."
            )
        dt = model.dt
        if dt is None:
            raise ValueError(
                "`model.dt` must be 0 (continuous time), a sampling time in seconds or "
                "True (discrete time, in samples). Got None."
            )
        names = (
            getattr(model, "input_labels", None),
            getattr(model, "output_labels", None),
        )
        step = dt if dt > 0 else None
        return cls(model.A, model.B, model.C, model.D, step, 0, *names)


# The uncertainty of a model, told by models to either side of it along independent
# directions, which every conversion carries along. Their distance from the estimate, in
# standard deviations, is small enough for what follows from them to be linear, and
# large against rounding.
ModelPair = tuple[StateSpace, StateSpace]
DEVIATION = 1e-2


def unknown_responses(
    model: StateSpace, n_samples: int, trend: Array | None = None
) -> Array:
    """Outputs of a run to what is unknown of it, (n_samples, n_outputs, n_unknowns).

    As `free_responses` has them, with inputs in transit after the states: what
    `StateSpace.estimate_initial_state` returns, and multiples of trends.
    """
    free = free_responses(model.A, model.C, n_samples, trend)
    matrices = model.A, model.B, model.C, model.D
    return beside_transit(free, *matrices, model.input_delay)


def balanced_models(models: Sequence[StateSpace]) -> list[StateSpace]:
    """`StateSpace.balance` of models of one size, in continuous or in discrete time."""
    found = _balancings("balance", models)
    return [
        model._projected(own.left, own.right)
        for model, own in zip(models, found, strict=True)
    ]


def _balancings(what: str, models: Sequence[StateSpace]) -> list[Balancing]:
    """Hankel singular values and projections of stable models, for `what`."""
    for model in models:
        poles = model.poles()
        growth = model._growth(poles)
        if not (growth < 0).all():
            raise ValueError(
                f"`{what}` needs a stable model. Got a pole at "
                f"{poles[growth.argmax()]:.4g}."
            )
    A, B, C = (np.array([getattr(model, M) for model in models]) for M in "ABC")
    return balancing_transformations(A, B, C, not models[0].is_continuous)


def forgetting(model: StateSpace, rate: float) -> StateSpace:
    """The model ``A - rate I``, in any basis: its response at ``j omega + rate``.

    In continuous time.
    """
    if not rate:
        return model
    A = model.A - rate * np.eye(model.order)
    return model._of(A, model.B, model.C, model.D, None, model.input_delay)


def with_free_states(model: StateSpace, A: Array, C: Array) -> StateSpace:
    """The model with further states that no input moves, after its own."""
    B = np.vstack([model.B, np.zeros((len(A), model.n_inputs))])
    both = block_diag(model.A, A), B, np.hstack([model.C, C]), model.D
    return model._of(*both, model.sampling_time, model.input_delay)


def scaled(model: StateSpace, u: Array, y: Array) -> StateSpace:
    """The model of inputs in units of `u` and outputs in units of `y`."""
    C, D, dt = model.C / y[:, None], model.D * u / y[:, None], model.sampling_time
    return StateSpace(model.A, model.B * u, C, D, dt, input_delay=model.input_delay)


def with_signs_of(reference: StateSpace, model: StateSpace) -> StateSpace:
    """A balanced model with the signs of its states turned to those of another."""
    signs = align_signs(model.B, model.C, reference.B, reference.C)
    return model.transform(np.diag(signs))


def split_delay(seconds: Array, dt: float) -> tuple[NDArray[np.intp], Array]:
    """Delays as whole samples, and the share of another one that is left of each."""
    samples = seconds / dt
    whole = np.round(samples)
    near = np.abs(samples - whole) <= _SAME_TIME * np.maximum(whole, 1.0)
    whole = np.where(near, whole, np.floor(samples))
    return whole.astype(np.intp), np.where(near, 0.0, samples - whole)


def sorted_poles(A: Array) -> NDArray[np.complex128]:
    """Eigenvalues of (..., n, n) matrices, by modulus, real part, imaginary part."""
    poles = np.linalg.eigvals(A).astype(complex)
    order = np.lexsort((poles.imag, poles.real, np.abs(poles)), axis=-1)
    return np.take_along_axis(poles, order, axis=-1)


def _same_time(one: float | None, other: float | None) -> bool:
    """Whether two sampling times agree; None is continuous time, True any step."""
    if one is None or other is None:
        return one is other
    if one is True or other is True:
        return True
    return abs(one - other) <= _SAME_TIME * other
