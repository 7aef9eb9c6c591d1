"""Linear parameter-varying models: matrices that follow the scheduling variables."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exceptions import DivergenceError, VersionedPickle, finite_simulation
from ..models.scheduling_range import domains
from ..models.statespace import StateSpace, sorted_poles, split_delay
from ..models.system_matrix import blocks
from ..structures.map import numerical_jacobian
from ..structures.structure import GrayBoxStructure
from ..systems.beginnings import first_inputs, held_state, standing
from ..systems.sampling import sample_foh, sample_zoh
from ..systems.simulation import (
    delayed,
    estimate_initial_state,
    spread_of,
    state_trajectory,
)
from ..systems.tabulation import tabulate
from ..systems.threads import one_blas_thread
from ..validation import (
    finite_samples,
    flag,
    frequencies,
    input_delays,
    matrix,
    measured_samples,
    names_of,
    one_of,
    place,
    positive_time,
    real_array,
    shown,
    state_vector,
    units_by_name,
)
from .coefficients import MatrixCoefficients, matrix_coefficients
from .export import Grid, as_dataset, control_models, write_mat
from .extrapolation import warn_extrapolation
from .lfr import LinearFractionalModel, linear_fractional
from .weighting import covariance_factor

Array = NDArray[np.float64]

_Basis = Callable[[Array], ArrayLike] | ArrayLike

# Samples whose matrices are held at once: for 6 states, 2 inputs and outputs 17 MB.
_BLOCK = 32_768

_ENTRIES = 1_000_000  # of derivatives that are held at once: 8 MB


@dataclass(frozen=True, eq=False, repr=False)
class LPVStateSpace(VersionedPickle):
    """A continuous-time state-space model scheduled by measured variables, Eq. (1).

    ``dx/dt = A(kappa) x + B(kappa) u``, ``y = C(kappa) x + D(kappa) u`` with static
    dependence on the scheduling variables kappa, which act at once; an input may act
    late, ``u_j(t - input_delay[j])`` in the place of ``u_j(t)``. With `offsets` the
    signals stand about a point of work that follows kappa:
    ``dx/dt = A (x - x0) + B (u - u0)``, ``y = y0 + C (x - x0) + D (u - u0)``. With
    `rate_terms` A follows the rates of change too, ``A(kappa) + sum_j N_j(kappa)
    dkappa_j/dt``.

    Parameters
    ----------
    structure : GrayBoxStructure
        From parameters to matrices.
    interpolator : fitted regressor
        From scheduling values (n_points, n_scheduling) to parameters (n_points,
        n_params). Says itself what it makes of values outside of the range.
    scheduling_range : array-like of shape (2, n_scheduling)
        Smallest and largest scheduling values that the model was identified on.
    scheduling_names : sequence, default=None
        Names of the scheduling variables, to give their values by; None is numbers.
    identified_range : array-like of shape (2, n_scheduling), default=None
        Beyond which `at` and `simulate` warn, whatever the interpolator does but for
        holding the border's value. A pipeline's is `scheduling_range`, widened by how
        far the variables moved within an experiment. None leaves it to the
        interpolator.
    bases : tuple of callables or arrays of shape (order, order), default=()
        Changes of the structure's state basis, see :meth:`change_basis`.
    input_delay : float or array-like of shape (n_inputs,), default=0
        Seconds, whole samples of every simulation. As attribute, an array.
    offsets : fitted regressor, default=None
        From scheduling values to ``[u0, y0, x0]``, (n_points, n_inputs + n_outputs +
        order), x0 in the state of the structure; see :ref:`guide_points_of_work`. None:
        all are zero.
    input_names, output_names : sequence, default=None
        Names of the signals, for other programs; None is u1, u2, ... and y1, y2, ...
    rate_terms : fitted regressor, default=None
        From scheduling values to the entries of ``N_1, N_2, ...``, row by row,
        (n_points, n_scheduling * order * order), in the state of the structure. Rates
        along a trajectory are differences between its samples. Frozen models, and all
        that other programs take, are those at rest: without.
    covariance : array-like of shape (n_coefficients, n_coefficients), default=None
        Of the coefficients of `interpolator`, then of `rate_terms`, which both have
        them (`AutoLPV` and its like). None: not known.
    units : dict of str to str, default=None
        Units of signals, scheduling variables and parameters, by name: those of
        displays, reports and files of MATLAB.
    steady_start : bool, default=False
        Where a simulation begins whose inputs stand still at first and move later: at
        rest at the point of work, or, as step tests do, where its first inputs hold the
        model at the first scheduling value.
    hold : {"zoh", "foh"}, default="zoh"
        What inputs do between the samples of a simulation: they stay, or they go on
        linearly to the next one. Scheduling and points of work stay.

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

    The momentum of a mass 1 + kappa in place of the rate: the same system.

    >>> momentum = lpv.change_basis(lambda kappa: np.diag([1, 1 + kappa[0]]))
    >>> momentum.at(0.5).A[0].round(9), momentum.at(0.5, rate=3.0).A[1].round(9)
    (array([0.        , 0.66666667]), array([-9.75,  1.5 ]))
    >>> np.allclose(momentum.simulate(np.ones(500), trajectory, 0.1), y)
    True
    """

    structure: GrayBoxStructure
    interpolator: Any
    scheduling_range: Array
    scheduling_names: Sequence[Hashable] | None = None
    identified_range: ArrayLike | None = None
    bases: tuple[_Basis, ...] = ()
    input_delay: Any = 0
    offsets: Any = None
    input_names: Sequence[Hashable] | None = None
    output_names: Sequence[Hashable] | None = None
    rate_terms: Any = None
    covariance: ArrayLike | None = None
    units: Mapping[str, str] | None = None
    steady_start: bool = False
    hold: str = "zoh"
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
        for name in ("interpolator", "offsets", "rate_terms"):
            regressor = getattr(self, name)
            wanted = name == "interpolator" or regressor is not None
            if wanted and not hasattr(regressor, "predict"):
                raise ValueError(
                    f"`{name}` must be a fitted regressor, such as PolynomialLPV. Got "
                    f"{type(regressor).__name__}."
                )
        bounds = real_array("scheduling_range", self.scheduling_range)
        rows = bounds.ndim == 2 and len(bounds) == 2 and np.isfinite(bounds).all()
        if not rows or not (bounds[0] <= bounds[1]).all():
            raise ValueError(
                "`scheduling_range` must be finite, of shape (2, n_scheduling), "
                f"smallest values first. Got {bounds.tolist()}."
            )
        if self.identified_range is not None:
            limits = real_array("identified_range", self.identified_range)
            if limits.shape != bounds.shape:
                raise ValueError(
                    "`identified_range` must have the shape of `scheduling_range`, "
                    f"{bounds.shape}. Got {limits.shape}."
                )
        bounds.setflags(write=False)
        object.__setattr__(self, "scheduling_range", bounds)
        object.__setattr__(self, "n_scheduling", bounds.shape[1])
        for name in ("order", "n_inputs", "n_outputs"):
            object.__setattr__(self, name, getattr(self.structure, name))
        n_names = (self.n_scheduling, self.n_inputs, self.n_outputs)
        of = ("scheduling_names", "input_names", "output_names")
        for argument, n in zip(of, n_names, strict=True):
            if (names := getattr(self, argument)) is not None:
                listed = names_of(argument, names, n, of_columns=True)
                object.__setattr__(self, argument, listed)
        object.__setattr__(self, "units", units_by_name(self.units))
        steady = flag("steady_start", self.steady_start)
        object.__setattr__(self, "steady_start", steady)
        one_of("hold", self.hold, ("zoh", "foh"))
        delay = input_delays(self.input_delay, self.n_inputs, samples=False)
        object.__setattr__(self, "input_delay", delay)
        for T in self.bases:
            if not callable(T):
                self._checked_basis(T)
        if self.covariance is not None:
            object.__setattr__(self, "covariance", self._checked_covariance())

    def _checked_covariance(self) -> Array:
        found = real_array("covariance", self.covariance)
        parts = [r for r in (self.interpolator, self.rate_terms) if r is not None]
        for part in parts:
            if not hasattr(part, "sensitivities"):
                raise ValueError(
                    "`covariance` needs regressors with coefficients, such as AutoLPV. "
                    f"Got {type(part).__name__}."
                )
        n = sum(len(part.coefficients()) for part in parts)
        if found.shape != (n, n) or not np.isfinite(found).all():
            raise ValueError(
                f"`covariance` must be a finite matrix of shape {(n, n)}, of the "
                f"coefficients. Got shape {found.shape}."
            )
        found.setflags(write=False)
        return found

    def __repr__(self) -> str:
        each = ", ".join(f"{d:g}" for d in self.input_delay)
        return (
            f"LPVStateSpace(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, n_scheduling={self.n_scheduling}"
            f"{f', input_delay=[{each}] s' if self.input_delay.any() else ''}"
            f"{', with offsets' if self.offsets is not None else ''}"
            f"{', hold=' + repr(self.hold) if self.hold != 'zoh' else ''}"
            f"{', with rate terms' if self.rate_terms is not None else ''})"
        )

    @overload
    def parameters(
        self, kappa: ArrayLike, *, return_std: Literal[False] = ...
    ) -> Array: ...

    @overload
    def parameters(
        self, kappa: ArrayLike, *, return_std: Literal[True]
    ) -> tuple[Array, Array]: ...

    def parameters(
        self, kappa: ArrayLike, *, return_std: bool = False
    ) -> Array | tuple[Array, Array]:
        """Parameters at scheduling values.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling), or (n_points,) for one
            scheduling variable
        return_std : bool, default=False
            Whether to return their standard deviations too, to first order.

        Returns
        -------
        ndarray of shape (n_points, n_params)
        std : ndarray of shape (n_points, n_params)
            With `return_std`.

        Raises
        ------
        ValueError
            If `kappa` has another shape or is not finite, or `return_std` asks for what
            is not known: `covariance` is None.
        """
        return_std = flag("return_std", return_std)
        n_params, kappa = self.structure.n_params, self._scheduling(kappa)
        wanted = f"`interpolator` must predict the {n_params} parameters"
        values = _predicted(self.interpolator, kappa, n_params, wanted)
        if not return_std:
            return values
        return values, np.linalg.norm(self.parameter_deviations(kappa), axis=2)

    def parameter_deviations(self, kappa: ArrayLike) -> Array:
        """Standard deviations of the parameters along independent directions.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling) or (n_points,)

        Returns
        -------
        ndarray of shape (n_points, n_params, n_directions)
            ``F[i] @ F[j].T`` is the covariance of the parameters at points i and j, to
            first order.

        Raises
        ------
        ValueError
            If `covariance` is None.
        """
        root, kappa = self.covariance_root(), self._scheduling(kappa)
        form = _quiet(self.interpolator)
        root = root[: len(form.coefficients())]
        found = np.empty((len(kappa), self.structure.n_params, root.shape[1]))
        size = max(1, _ENTRIES // (len(root) * self.structure.n_params))
        for start in range(0, len(kappa), size):
            rows = slice(start, start + size)
            found[rows] = form.sensitivities(kappa[rows]) @ root
        return found

    def covariance_root(self) -> Array:
        """F with ``F F^T = covariance``, of as few columns as this has directions."""
        if self.covariance is None:
            raise ValueError(
                "The uncertainty of this model is not known: `covariance` is None. A "
                "pipeline knows it of an interpolation with coefficients (AutoLPV, "
                "PolynomialLPV, RationalLPV, SplineLPV), where the covariances of the "
                "local parameters are known, which needs a structure, or where "
                "refiner=OutputErrorLPV() has data that move."
            )
        return covariance_factor(np.asarray(self.covariance))

    def frequency_response_std(
        self, kappa: ArrayLike | Mapping[Any, float], omega: ArrayLike
    ) -> NDArray[np.complex128]:
        """Standard deviation of the frequency response of a frozen model.

        That of the coefficients alone, to first order.

        Parameters
        ----------
        kappa : float, array-like of shape (n_scheduling,) or mapping
            As `at` takes it.
        omega : array-like of shape (n_freq,)
            Angular frequencies, rad/s.

        Returns
        -------
        ndarray of complex, shape (n_freq, n_outputs, n_inputs)
            The real part is the standard deviation of the real part of the response,
            the imaginary part that of the imaginary part, as
            `SubspaceLTI.frequency_response_std` has them.

        Raises
        ------
        ValueError
            If `covariance` is None, `kappa` is not one finite value of every scheduling
            variable, or a frequency is that of a pole.
        """
        place, w = self._place(kappa), frequencies(omega)
        if not np.isfinite(w).all():
            raise ValueError(f"`omega` must be finite. Got {shown(omega)}.")
        model, n = self.silenced(), self.order
        theta = model.parameters(place[None])[0]
        A, B, C, _ = (M[0] for M in self.structure.matrices(theta[None]))
        resolvent = 1j * w[:, None, None] * np.eye(n) - A
        eye_y = np.broadcast_to(np.eye(self.n_outputs), (len(w), *[self.n_outputs] * 2))
        eye_u = np.broadcast_to(np.eye(self.n_inputs), (len(w), *[self.n_inputs] * 2))
        try:
            states = np.linalg.solve(resolvent, np.broadcast_to(B, (len(w), *B.shape)))
        except np.linalg.LinAlgError:
            raise ValueError(
                "`omega` must be off the poles of the model, where the response and "
                f"its deviation are infinite. Got {shown(omega)}; take frequencies "
                "beside it."
            ) from None
        left = np.linalg.solve(resolvent.mT, np.broadcast_to(C.T, (len(w), *C.T.shape)))
        left = np.concatenate([left.mT, eye_y], axis=2)  # [C (jw - A)^-1, I]
        late = np.exp(-1j * np.outer(w, self.input_delay))
        right = np.concatenate([states, eye_u], axis=1) * late[:, None, :]
        deviations = model.parameter_deviations(place[None])[0]
        directions = np.tensordot(
            deviations.T, np.asarray(self.structure.jacobian(theta)), 1
        )
        slopes = left[:, None] @ directions @ right[:, None]
        std = np.linalg.norm(slopes.real, axis=1) + 1j * np.linalg.norm(
            slopes.imag, axis=1
        )
        return np.asarray(std)

    def input_offset(self, kappa: ArrayLike) -> Array:
        """Inputs u0 of the point of work at scheduling values.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling) or (n_points,)

        Returns
        -------
        ndarray of shape (n_points, n_inputs)
            Zero without `offsets`.

        Raises
        ------
        ValueError
            If `kappa` has another shape or is not finite.
        """
        return self._point_of_work(self._scheduling(kappa))[0]

    def output_offset(self, kappa: ArrayLike) -> Array:
        """Outputs y0 at rest at `input_offset`.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling) or (n_points,)

        Returns
        -------
        ndarray of shape (n_points, n_outputs)
            Zero without `offsets`.

        Raises
        ------
        ValueError
            If `kappa` has another shape or is not finite.
        """
        return self._point_of_work(self._scheduling(kappa))[1]

    def state_offset(self, kappa: ArrayLike) -> Array:
        """State x0 at rest at `input_offset`, in the basis of this model.

        Parameters
        ----------
        kappa : array-like of shape (n_points, n_scheduling) or (n_points,)

        Returns
        -------
        ndarray of shape (n_points, order)
            Zero without `offsets`.

        Raises
        ------
        ValueError
            If `kappa` has another shape or is not finite.
        """
        kappa = self._scheduling(kappa)
        x0 = self._point_of_work(kappa)[2]
        if not self.bases:
            return x0
        moved = [self._basis_at(k) @ x for k, x in zip(kappa, x0, strict=True)]
        return np.reshape(moved, x0.shape)

    def _point_of_work(self, kappa: Array) -> list[Array]:
        """u0, y0, x0 at checked scheduling values, in the state of the structure."""
        sizes = (self.n_inputs, self.n_outputs, self.order)
        total = sum(sizes)
        if self.offsets is None:
            values = np.zeros((len(kappa), total))
        else:
            wanted = f"`offsets` must predict the {total} values of u0, y0 and x0"
            values = _predicted(self.offsets, kappa, total, wanted)
        return np.split(values, np.cumsum(sizes)[:2], axis=1)

    def at(
        self,
        kappa: ArrayLike | Mapping[Any, float],
        rate: ArrayLike | Mapping[Any, float] | None = None,
    ) -> StateSpace:
        """The frozen model at one scheduling value, Eq. (2).

        Parameters
        ----------
        kappa : float, array-like of shape (n_scheduling,) or mapping
            By position, or by the names of the variables:
            ``{"mass": 150, "speed": 25}``.
        rate : float, array-like of shape (n_scheduling,) or mapping, default=None
            Rate of change of `kappa` (1/s), which A depends on by rate terms, or after
            a change of basis that follows kappa; None is rest.

        Returns
        -------
        StateSpace
            In continuous time; of deviations from the point of work, with `offsets`.

        Raises
        ------
        ValueError
            If `kappa` is not one finite value of every scheduling variable.

        Warns
        -----
        ExtrapolationWarning
            Outside of `identified_range`.
        """
        place = self._place(kappa)
        self._tell_extrapolation(place[None])
        return self.silenced()._at(place, rate)

    def _at(self, place: Array, rate: Any = None) -> StateSpace:
        model = self.structure.model(self.parameters(place[None])[0])
        speed = None if rate is None else self._place(rate)
        if speed is not None and self.rate_terms is not None:
            A = model.A + self.rate_part(place[None], speed[None])[0]
            model = StateSpace(A, model.B, model.C, model.D)
        model = model.with_input_delay(self.input_delay)
        inputs, outputs = (
            names if _are_names(names) else None
            for names in (self.input_names, self.output_names)
        )
        model = model.with_names(inputs, outputs, self.units)
        if not self.bases:
            return model
        T = self._basis_at(place)
        model = model.transform(T)
        if speed is None:
            return model
        width = np.ptp(domains(self.scheduling_range), axis=0)  # the unit of slopes
        slopes = numerical_jacobian(
            lambda ahead: self._basis_at(place + width * (ahead - 1.0)),
            np.ones_like(place),
            np.ones_like(place),
        )
        term = np.tensordot(speed / width, slopes, 1) @ np.linalg.inv(T)
        return replace(model, A=model.A + term)

    def change_basis(self, T: _Basis) -> LPVStateSpace:
        """The same system in the state ``z = T(kappa) x``.

        Parameters
        ----------
        T : callable or array-like of shape (order, order)
            Invertible; a function gets the scheduling values, shape (n_scheduling,).

        Returns
        -------
        LPVStateSpace
            Of the same outputs along any trajectory. Its states, and the frozen models
            of :meth:`at`, are those of the new basis.

        Raises
        ------
        ValueError
            If T has another shape or is singular in the middle of the range.

        Notes
        -----
        While kappa moves, T does:
        ``z' = (T A T^-1 + T' T^-1) z + T B u``, ``T' = sum_j dT/dkappa_j kappa_j'``.
        The term ``T' T^-1`` is that of `at` with a `rate`. Models that are interpolated
        in the new basis leave it out and are another system: that choice is the
        structure's, see :ref:`guide_state_basis`.
        """
        changed = replace(self, bases=(*self.bases, T))
        changed._at(self.scheduling_range.mean(axis=0))  # refuses what is no basis
        return changed

    def rate_part(self, kappa: Array, rate: Array) -> Array:
        """What the rate terms add to A, in the state of the structure.

        Parameters
        ----------
        kappa, rate : ndarray of shape (n_points, n_scheduling)
            Values and their rates of change (1/s).

        Returns
        -------
        ndarray of shape (n_points, order, order)
        """
        n, n_rates = self.order, self.n_scheduling
        if self.rate_terms is None:
            return np.zeros((len(kappa), n, n))
        wanted = f"`rate_terms` must predict the {n_rates} matrices of order {n}"
        terms = _predicted(self.rate_terms, kappa, n_rates * n * n, wanted)
        return np.einsum("kj,kjab->kab", rate, terms.reshape(-1, n_rates, n, n))

    def _basis_at(self, kappa: Array) -> Array:
        """T from the structure's state to this one's."""
        T = np.eye(self.order)
        for basis in self.bases:
            T = self._checked_basis(basis(kappa) if callable(basis) else basis) @ T
        return T

    def _checked_basis(self, T: ArrayLike) -> Array:
        own, wanted = matrix("T", T), (self.order, self.order)
        if own.shape != wanted:
            raise ValueError(f"`T` must have shape {wanted}. Got {own.shape}.")
        return own

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

    @one_blas_thread
    def simulate(
        self,
        u: ArrayLike,
        scheduling: ArrayLike | Mapping[Any, ArrayLike],
        sampling_time: float,
        initial_state: ArrayLike | None = None,
    ) -> Array:
        """Simulate along a measured scheduling trajectory.

        Input (with ``hold="zoh"``) and scheduling are held over each sampling period,
        so that a constant scheduling gives exactly the sampled LTI model. With
        ``hold="foh"`` a run begins with its first inputs, not on the way to them.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        scheduling : array-like of shape (n_samples, n_scheduling) or (n_samples,)
            Or a mapping from the names of the variables to (n_samples,), or a table
            with such columns.
        sampling_time : float
            Seconds.
        initial_state : array-like of shape (order,), default=None
            None is rest: zero, or the `state_offset` of the first sample, or with
            `steady_start` where the first inputs hold the model. The inputs before that
            sample are zero, or its `input_offset`, or the first ones; those in transit
            may follow the state, as `estimate_initial_state` has them.

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

        Warns
        -----
        ExtrapolationWarning
            Outside of `identified_range`.
        """
        u, kappa, delay, start = self._started(
            u, scheduling, sampling_time, initial_state
        )
        late, x = self._driving(u, delay, start), start[: self.order, None]
        return self._response(late, kappa, sampling_time, x)[:, :, 0]

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
            ``y = free_responses @ x0`` for ``u = 0`` without offsets: regressors of an
            initial state, with one entry for each sample of delay after it.

        Raises
        ------
        ValueError
            As `simulate`.
        """
        kappa = self._scheduling(scheduling)
        late, x = self._unit_runs(kappa, self._samples_of_delay(sampling_time))
        return self._response(late, kappa, sampling_time, x)

    def rest_and_free_responses(
        self,
        u: ArrayLike,
        scheduling: ArrayLike | Mapping[Any, ArrayLike],
        sampling_time: float,
    ) -> tuple[Array, Array]:
        """`simulate` from rest and `free_responses`, by half the effort of the two.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        scheduling : array-like of shape (n_samples, n_scheduling) or (n_samples,)
        sampling_time : float
            Seconds.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs)
        ndarray of shape (n_samples, n_outputs, order + n_in_transit)

        Raises
        ------
        ValueError
            As `simulate`.
        """
        run = self._started(u, scheduling, sampling_time, None)
        return self._rest_and_free(*run, sampling_time)

    def _rest_and_free(
        self, u: Array, kappa: Array, delay: NDArray[np.intp], start: Array, dt: float
    ) -> tuple[Array, Array]:
        own = self._driving(u, delay, start)
        units, states = self._unit_runs(kappa, delay)
        still = np.zeros((len(u), own.shape[1] - units.shape[1], units.shape[2]))
        late = np.concatenate([own, np.concatenate([units, still], axis=1)], axis=2)
        x = np.column_stack([start[: self.order], states])
        y = self._response(late, kappa, dt, x)
        return y[:, :, 0], y[:, :, 1:]

    def estimate_initial_state(
        self,
        u: ArrayLike,
        scheduling: ArrayLike | Mapping[Any, ArrayLike],
        y: ArrayLike,
        sampling_time: float,
    ) -> Array:
        """Initial state with which the model fits a record best.

        The least-squares solution over all samples, in which outputs count by how far
        they move; what the record does not determine is at rest.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        scheduling : array-like of shape (n_samples, n_scheduling) or (n_samples,)
            As of `simulate`.
        y : array-like of shape (n_samples, n_outputs) or (n_samples,)
            Missing values (NaN) are left out.
        sampling_time : float
            Seconds.

        Returns
        -------
        ndarray of shape (order + n_in_transit,)
            To be given to `simulate` as `initial_state`: the state, then for one input
            after another those that arrive with sample 0, 1, ....

        Raises
        ------
        ValueError
            As `simulate`, or if `y` does not fit `u`.
        DivergenceError
            If a response overflows.
        """
        u, kappa, delay, start = self._started(u, scheduling, sampling_time, None)
        y = measured_samples(y, len(u), self.n_outputs)
        rest, free = self._rest_and_free(u, kappa, delay, start, sampling_time)
        basis = self._basis_at(kappa[0])
        start[: self.order] = basis @ start[: self.order]
        return start + estimate_initial_state(free, y - rest, spread_of(y))

    def _driving(self, u: Array, delay: NDArray[np.intp], start: Array) -> Array:
        """What drives the states of a run, (n_samples, n_driving, 1)."""
        late = delayed(u, delay, start[self.order :])
        if self.offsets is not None:
            late = np.column_stack([late, np.ones(len(u))])
        return late[:, :, None]

    def _started(
        self, u: Any, scheduling: Any, dt: float, initial_state: Any
    ) -> tuple[Array, Array, NDArray[np.intp], Array]:
        """Inputs, scheduling, delay in samples, and the start of a run, checked.

        The start is the state of the structure, then the inputs in transit.
        """
        u = finite_samples("u", u, self.n_inputs)
        delay, n = self._samples_of_delay(dt), self.order
        kappa = self._scheduling(scheduling)
        if len(kappa) != len(u):
            raise ValueError(
                f"`scheduling` must have one row for each of the {len(u)} samples of "
                f"`u`. Got {len(kappa)}."
            )
        x, first = self.beginning(u, kappa)
        before = np.asarray(np.repeat(first, delay), dtype=float)
        if initial_state is not None:
            given = state_vector(initial_state, n, int(delay.sum()))
            x = given[:n]
            if self.bases and len(kappa):
                x = np.asarray(np.linalg.solve(self._basis_at(kappa[0]), x), float)
            if np.size(initial_state) > n:
                before = given[n:]
        return u, kappa, delay, np.concatenate([x, before])

    def beginning(self, u: Array, kappa: Array) -> tuple[Array, Array]:
        """State of the structure where a run begins by itself, and inputs before it.

        Of checked inputs and scheduling, a row for every sample.
        """
        quiet = self.silenced()
        u0, _, x0 = (np.sum(p, axis=0) for p in quiet._point_of_work(kappa[:1]))
        if self.steady_start and standing(u):
            A, B, *_ = self.structure.matrices(quiet.parameters(kappa[:1])[0])
            first = first_inputs(u)
            held = held_state(A, B, first - u0, discrete=False)
            if held is not None:
                return x0 + held, first
        return x0, u0

    def _unit_runs(self, kappa: Array, delay: NDArray[np.intp]) -> tuple[Array, Array]:
        """What drives runs from unit initial states, and units in transit."""
        n = self.order
        unit = np.eye(n + delay.sum())
        n_driving = self.n_inputs if delay.any() else 0
        x: Array = unit[:n]
        if self.bases and len(kappa):
            x = np.linalg.inv(self._basis_at(kappa[0])) @ x
        none = np.zeros((len(kappa), n_driving, len(unit)))
        return delayed(none, delay, unit[n:]), x

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

    # -- what other programs take --------------------------------------------------

    def grid(self, points: ArrayLike | Mapping[Any, ArrayLike]) -> list[StateSpace]:
        """The frozen models at several scheduling values.

        Parameters
        ----------
        points : array-like of shape (n_points, n_scheduling) or (n_points,), mapping
            Or the values by the names of the variables, as `simulate` takes them.

        Returns
        -------
        list of StateSpace
            In continuous time; of deviations from the point of work, with `offsets`.

        Raises
        ------
        ValueError
            If `points` has another shape or is not finite.

        Warns
        -----
        ExtrapolationWarning
            Outside of `identified_range`.
        """
        return list(self._grid(points).models)

    def to_control(self, points: ArrayLike | Mapping[Any, ArrayLike]) -> list[Any]:
        """The frozen models as ``control.StateSpace`` (needs python-control).

        Parameters
        ----------
        points : array-like of shape (n_points, n_scheduling) or (n_points,), mapping
            As in :meth:`grid`.

        Returns
        -------
        list of control.StateSpace
            With the names of the signals, and the scheduling values as `name`: a
            decimal point is a p there, ``kappa=0p5``. Without the offsets.

        Raises
        ------
        ValueError
            If the model has a delay, which python-control does not know, or as `grid`.
        """
        return control_models(self._grid(points))

    def to_mat(
        self,
        path: str | os.PathLike[str],
        points: ArrayLike | Mapping[Any, ArrayLike],
    ) -> None:
        """Write the frozen models for MATLAB's ``ssInterpolant``.

        In MATLAB (R2023a, Control System Toolbox)::

            m = load("model.mat"); g = ss(m.A, m.B, m.C, m.D, InputDelay=m.InputDelay);
            g.SamplingGrid = m.SamplingGrid; lpv = ssInterpolant(g, m.offsets);

        and, for the names, ``lpv.InputName = m.InputName``, ``lpv.OutputName =
        m.OutputName``, and likewise ``InputUnit`` and ``OutputUnit``.

        Parameters
        ----------
        path : str or path
            A file there is replaced, when the new one is complete.
        points : array-like of shape (n_points, n_scheduling) or (n_points,), mapping
            As in :meth:`grid`. MATLAB interpolates the matrices between them, linearly
            by default: take them close enough. All combinations of some values of each
            variable become a rectangular grid, other points a column of scattered ones.

        Raises
        ------
        ValueError
            As `grid`.

        Notes
        -----
        The file holds the arrays ``A``, ``B``, ``C``, ``D`` with the axes of the grid
        behind those of the matrices, ``SamplingGrid`` (a structure with a field for
        each scheduling variable), ``offsets`` (an array of structures ``dx``, ``x``,
        ``u``, ``y``, over the grid), ``Ts`` (0: continuous time), ``InputDelay`` (s),
        ``InputName``, ``OutputName``, ``InputUnit`` and ``OutputUnit``. Names of
        scheduling variables are changed to such as MATLAB takes.
        """
        write_mat(path, self._grid(points))

    def to_xarray(self, points: ArrayLike | Mapping[Any, ArrayLike]) -> Any:
        """The frozen models as an ``xarray.Dataset`` (needs xarray).

        Parameters
        ----------
        points : array-like of shape (n_points, n_scheduling) or (n_points,), mapping
            As in :meth:`grid`. All combinations of some values of each variable become
            a rectangular grid, other points a dimension "point".

        Returns
        -------
        xarray.Dataset
            ``A``, ``B``, ``C``, ``D`` and the offsets ``u0``, ``y0``, ``x0``, over the
            scheduling variables and the dimensions "state", "input" and "output"; with
            the names and units of the signals, and ``input_delay`` (s).

        Raises
        ------
        ValueError
            As `grid`.
        """
        return as_dataset(self._grid(points))

    def _grid(self, points: Any) -> Grid:
        places = self._scheduling(points)
        if not len(places):
            raise ValueError("`points` must have at least one row. Got none.")
        self._tell_extrapolation(places)
        model = self.silenced()
        return Grid(
            [model._at(place) for place in places],
            places,
            {
                "u": model.input_offset(places),
                "y": model.output_offset(places),
                "x": model.state_offset(places),
            },
            self._names("scheduling", "kappa"),
            self._names("input", "u"),
            self._names("output", "y"),
            self.units or {},
        )

    def _names(self, which: str, letter: str) -> tuple[Hashable, ...]:
        """Names of the signals; numbered ones where they have none, or bare numbers."""
        names = getattr(self, f"{which}_names")
        if not _are_names(names):
            n = getattr(self, "n_scheduling" if letter == "kappa" else f"n_{which}s")
            one = which == "scheduling" and n == 1
            return (letter,) if one else tuple(f"{letter}{k + 1}" for k in range(n))
        return tuple(names)

    def coefficients(self, *, normalized: bool = False) -> MatrixCoefficients:
        """The matrices as polynomials, or fractions, of the scheduling variables.

        Parameters
        ----------
        normalized : bool, default=False
            Powers of the variables mapped linearly from the range of the operating
            points to [-1, 1], whose coefficients are well conditioned. Those of the
            variables as they are lose digits where a range is narrow beside its
            distance from zero.

        Returns
        -------
        MatrixCoefficients
            Arrays ``A``, ``B``, ``C``, ``D`` of shape (n_terms, rows, columns), the
            coefficients of a common ``denominator``, ``table()`` and ``at(kappa)``.

        Raises
        ------
        ValueError
            If the structure is not affine in its parameters, the interpolation has no
            coefficients (a spline, another regressor), or the state basis follows the
            scheduling variables.

        Examples
        --------
        >>> from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV
        >>> structure = GrayBoxStructure.from_template(
        ...     A=[[0, 1], ["-k", -0.5]], B=[[0], [1]], C=[[1, 0]])
        >>> stiffness = PolynomialLPV(degree=1).fit([[0.0], [1.0]], [[4.0], [9.0]])
        >>> lpv = LPVStateSpace(structure, stiffness, [[0.0], [1.0]])
        >>> lpv.coefficients().A[1].round(9) + 0.0
        array([[ 0.,  0.],
               [-5.,  0.]])
        >>> lpv.coefficients().table().round(9) + 0.0
                             1  kappa
        matrix row column
        A      0   1       1.0    0.0
               1   0      -4.0   -5.0
                   1      -0.5    0.0
        B      1   0       1.0    0.0
        C      0   0       1.0    0.0
        """
        T = None
        if not any(map(callable, self.bases)):
            T = self._basis_at(self.scheduling_range[0])
        return matrix_coefficients(
            self.structure,
            self.interpolator,
            T,
            self._names("scheduling", "kappa"),
            self.input_delay,
            normalized=normalized,
        )

    def lfr(self, *, normalized: bool = False) -> LinearFractionalModel:
        """The model as a linear-fractional transformation, as robust control takes it.

        Parameters
        ----------
        normalized : bool, default=False
            The scheduling variables on the diagonal of Delta as they are, or mapped
            linearly from the range of the operating points to [-1, 1]: the norm of
            Delta is then 1 at most.

        Returns
        -------
        LinearFractionalModel
            Exact at every scheduling value, to rounding. Each variable is repeated as
            little as reduction one variable after another finds: of a single one, the
            least possible.

        Raises
        ------
        ValueError
            As `coefficients`; or if variables as they are would lose the digits.

        Examples
        --------
        >>> from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV
        >>> structure = GrayBoxStructure.from_template(
        ...     A=[[0, 1], ["-k", -0.5]], B=[[0], [1]], C=[[1, 0]])
        >>> stiffness = PolynomialLPV(degree=1).fit([[0.0], [1.0]], [[4.0], [9.0]])
        >>> lfr = LPVStateSpace(structure, stiffness, [[0.0], [1.0]]).lfr()
        >>> lfr
        LinearFractionalModel(order=2, n_inputs=1, n_outputs=1, repetitions={kappa: 1})
        >>> lfr.at(0.5).A.round(9)
        array([[ 0. ,  1. ],
               [-6.5, -0.5]])
        """
        return linear_fractional(
            self.coefficients(normalized=True), normalized=normalized
        )

    def silenced(self) -> LPVStateSpace:
        """The model that extrapolates without a warning."""
        regressors = {
            name: _quiet(getattr(self, name))
            for name in ("interpolator", "offsets", "rate_terms")
        }
        return replace(self, **regressors, identified_range=None)

    def _tell_extrapolation(self, kappa: Array) -> None:
        """Warn of values out of the range, or have the interpolator tell of them."""
        extrapolation = getattr(self.interpolator, "extrapolation", None)
        if self.identified_range is None or extrapolation == "error":
            low, high = self.scheduling_range
            if ((kappa < low) | (kappa > high)).any():
                self.interpolator.predict(kappa)
        elif extrapolation != "clip":
            names = self.scheduling_names or range(1, self.n_scheduling + 1)
            warn_extrapolation(kappa, np.asarray(self.identified_range), list(names))

    def _response(self, u: Array, kappa: Array, dt: float, x: Array) -> Array:
        """Outputs of runs along one trajectory: inputs (n_samples, n_inputs, n_runs).

        ``x[k+1] = A(kappa_k) x[k] + B(kappa_k) u[k]`` with the zero-order-hold matrices
        at every sample, and with the first-order hold ``+ G(kappa_k) u[k+1]``, a block
        of samples at a time. Inputs left out are zero; one more than the model has is
        the part that the offsets have.
        """
        dt = positive_time("sampling_time", dt)
        self._tell_extrapolation(kappa)
        model = self.silenced()  # not once more, of the nodes of the table
        path = kappa
        if self.rate_terms is not None:
            path = np.hstack([kappa, rates_of_change(kappa, dt)])
        y = np.empty((len(u), self.n_outputs, u.shape[2]))
        n, n_driving = self.order, u.shape[1]
        n_held = self.n_inputs + (self.offsets is not None)
        for start in range(0, len(u), _BLOCK):
            rows = slice(start, start + _BLOCK)
            S = model._held_matrices(path[rows], dt)
            A, B, C, D = blocks(S[:, :, : n + n_driving], n)
            forcing = B @ u[rows]
            if self.hold == "foh":
                ahead = slice(n + n_held, n + n_held + n_driving)
                coming = np.concatenate([u[rows][1:], u[rows.stop :][:1]])
                forcing[: len(coming)] += S[: len(coming), :n, ahead] @ coming
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
            "hold the border's by AutoLPV(extrapolation='clip')."
            if beyond
            else "Look at the parameters of the local models: inputs or outputs about "
            "an offset, shuffled rows, or times in another unit spoil them. If they "
            "are right, lower the degree of the polynomial."
        )
        return (
            f"The frozen model at scheduling {kappa[worst].round(6).tolist()} is "
            f"unstable: a pole has real part {poles[worst]:.4g} 1/s. {cause}"
        )

    def _held_matrices(self, path: Array, dt: float) -> Array:
        """``[[Ad, Bd], [C, D]]`` at scheduling values and, with rate terms, rates.

        Offsets are an input that is one: ``f = -A x0 - B u0``, ``y0 - C x0 - D u0``.
        With a hold of order one the columns of the next sample's inputs follow.
        """

        def held(points: Array) -> Array:
            points = points.reshape(-1, path.shape[1])
            points, rates = np.split(points, [self.n_scheduling], axis=1)
            A, B, C, D = self.structure.matrices(self.parameters(points))
            if rates.size:
                A = A + self.rate_part(points, rates)
            finite = np.isfinite(A).all((1, 2)) & np.isfinite(B).all((1, 2))
            if not finite.all():
                raise ValueError(
                    "`structure` must give finite matrices along `scheduling`. Got a "
                    f"NaN or infinity at {points[~finite][0]}."
                )
            if self.offsets is not None:
                u0, y0, x0 = (v[:, :, None] for v in self._point_of_work(points))
                B, D = (
                    np.concatenate([B, -A @ x0 - B @ u0], 2),
                    np.concatenate([D, y0 - C @ x0 - D @ u0], 2),
                )
            ahead = np.zeros_like(B[:, :, :0])
            try:
                if self.hold == "zoh":
                    Ad, Bd = sample_zoh(A, B, dt)
                else:
                    Ad, Bd, ahead = sample_foh(A, B, dt)
                    Bd = Bd - ahead
            except ValueError:  # it overflows within a sample
                raise DivergenceError(
                    f"the simulation diverges within one sample of {dt:g} s. "
                    f"{self._why_it_diverges(points)}"
                ) from None
            none = np.zeros((*D.shape[:2], ahead.shape[2]))
            upper, lower = [Ad, Bd, ahead], [C, D, none]
            return np.concatenate(
                [np.concatenate(upper, 2), np.concatenate(lower, 2)], 1
            )

        if path.shape[1] == 1:
            return tabulate(held, path[:, 0])
        if (path == path[0]).all():
            S = held(path[:1])
            return np.broadcast_to(S[0], (len(path), *S.shape[1:]))
        return held(path)

    def _place(self, kappa: Any) -> Array:
        """One value of every scheduling variable."""
        if not isinstance(kappa, Mapping):
            return place("kappa", kappa, self.n_scheduling)
        values = self._scheduling(kappa)
        if len(values) != 1:
            raise ValueError(
                "`kappa` must be one value of every scheduling variable. Got "
                f"{len(values)}."
            )
        return values[0]

    def _scheduling(self, kappa: Any) -> Array:
        names = self.scheduling_names
        if isinstance(kappa, Mapping):
            if names is None or set(kappa) != set(names):
                known = "no names" if names is None else list(names)
                raise ValueError(
                    "`scheduling` by name must have a value for each scheduling "
                    f"variable; the model knows {known}. Got {list(kappa)}."
                )
            columns = [real_array(str(name), kappa[name]).ravel() for name in names]
            if len({len(column) for column in columns}) > 1:
                raise ValueError(
                    "`scheduling` must have as many values of each variable. Got "
                    f"{[len(column) for column in columns]}."
                )
            kappa = np.column_stack(columns)
        elif names and set(names) <= set(getattr(kappa, "columns", ())):
            kappa = kappa[list(names)]
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


def rates_of_change(kappa: Array, dt: float) -> Array:
    """Rates (1/s) of a trajectory (n_samples, n_scheduling), by central differences."""
    return np.gradient(kappa, dt, axis=0) if len(kappa) > 1 else np.zeros_like(kappa)


def _are_names(names: Sequence[Hashable] | None) -> bool:
    """Whether columns had names, where arrays have numbers."""
    return names is not None and not any(isinstance(name, Integral) for name in names)


def _predicted(regressor: Any, kappa: Array, n_values: int, wanted: str) -> Array:
    """Values (n_points, n_values) of a regressor; `wanted` says which they must be."""
    with np.errstate(over="ignore", invalid="ignore"):  # which is told instead
        values = np.asarray(regressor.predict(kappa), dtype=float)
    if not np.isfinite(values).all():
        far = kappa[np.argwhere(~np.isfinite(values))[0][0]]
        raise ValueError(
            f"{wanted} by finite values. Got none at scheduling {far}, where they are "
            "beyond all numbers."
        )
    if values.size != len(kappa) * n_values:
        raise ValueError(
            f"{wanted}. Got shape {values.shape} for {len(kappa)} point(s)."
        )
    return values.reshape(len(kappa), n_values)


def _quiet(regressor: Any) -> Any:
    """The regressor, or where it warns of extrapolation a copy that does not."""
    known: dict[str, Any] = getattr(regressor, "get_params", dict)()
    loud = [
        name
        for name, value in known.items()
        if name.split("__")[-1] == "extrapolation" and value == "warn"
    ]
    quiet = copy.deepcopy(regressor) if loud else regressor
    for name in loud:
        quiet.set_params(**{name: "ignore"})
    return quiet
