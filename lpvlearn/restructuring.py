"""Step 4 of the method: a black-box model in the user's gray-box form.

The parameters minimise the H-infinity norm of the difference of the two transfer
functions, Eq. (6): no similarity transformation is involved, and the orders may
differ.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from .exceptions import RankWarning
from .frequency_data import read_frequency_data, stack_response
from .identifiability import Identifiability
from .numerics.certificates import ACTIVE_PEAK
from .numerics.frf_realization import realize_response
from .numerics.leastsquares import (
    LeastSquaresResult,
    fit_frequency_response,
    frequency_grid,
)
from .numerics.matching import ErrorSystem, MeasuredErrorSystem
from .numerics.restructure import SOLVERS, decay_rates, growth, minimise_hinf
from .numerics.starts import best_fits, perturbed_candidates, similarity_candidates
from .numerics.transfer import Target
from .statespace import StateSpace
from .structures import GrayBoxStructure

__all__ = ["GrayBoxRestructurer"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_MARGIN = 0.02  # stability margin, relative to the slowest decay of the black box
_N_FITS = 3  # least-squares fits from the best candidates
_GOOD_FIT = 3e-3  # relative least-squares error that needs no further starts
_POOR_FIT = 2e-2  # relative least-squares error that is warned about
_ROUNDS = 3
_ROUNDING = 1e-11  # an error of that size, relative to the black box, is exact


class GrayBoxRestructurer(RegressorMixin, BaseEstimator):
    r"""Find the gray-box parameters whose model is closest to a black box.

    Minimises :math:`\|G(\vartheta) - \mathfrak{G}\|_\infty`, Eq. (6), over the
    parameters of a structure, without an initial guess. A sample of the estimator is a
    frequency; :meth:`fit_model` takes a state-space model instead and works with the
    exact norm.

    Parameters
    ----------
    structure : GrayBoxStructure, default=None
        None is the observable canonical form of the model's order (`fit_model` only).
    norm : {"hinf"}, default="hinf"
        The norm of the error that is minimised.
    solver : {"sqp", "bundle"}, default="sqp"
        Minimax sequential quadratic programming with exact second derivatives, or the
        paper's proximity control with cutting planes, Eq. (18)-(21).
    init : "similarity" or array-like of shape (n_params,), default="similarity"
        Where the search begins: from nothing, by similarity transformations of the black
        box, or from a physical guess.
    n_starts : int, default=16
        Random starts at each of two time scales.
    max_iter : int, default=300
        Iterations of the solver.
    tol : float, default=1e-10
        Relative decrease of the norm below which the solver stops.
    random_state : int, RandomState instance or None, default=0
        Randomness of the starts.

    Attributes
    ----------
    structure_ : GrayBoxStructure
    params_ : ndarray of shape (n_params,)
        The parameters, in the order of ``structure_.parameter_names``.
    lti_ : StateSpace
        The gray-box model at `params_`.
    error_ : float
        H-infinity norm of the error (its maximum over the frequencies, after `fit`).
    relative_error_ : float
        `error_` divided by the norm of the black box.
    active_frequencies_ : ndarray
        Frequencies, rad/s, of the peaks that support the optimum.
    structural_floor_ : float
        Highest peak of the error that no parameter changes (a gain fixed by the
        structure); 0 where there is none. It is set aside, and the remaining peaks are
        minimised.
    remaining_error_ : float
        Highest peak of the error apart from the floor; equal to `error_` where there is
        no floor, or a lower one.
    stationarity_ : float
        Shortest vector in the convex hull of the active gradients, relative to the
        error and in the coordinates of the least-squares fit; 0 is stationary.
    second_order_ : float
        Smallest eigenvalue of the reduced Hessian; positive certifies a strict
        local minimum.
    identifiability_ : Identifiability
        Rank and condition of the derivative of the response to the parameters.
    dropped_feedthrough_ : ndarray of shape (n_outputs, n_inputs)
        What the black box has in D where the structure has no parameter: left out of
        the comparison, as in Eq. (4).
    fit_error_ : float
        Relative root-mean-square error over frequency of the least-squares fit that the
        solver started from.
    starts_ : DataFrame
        Relative error of the least-squares fits that the solver could start from.
    n_iter_ : int
    history_ : DataFrame
        Objective, predicted decrease, step bound and number of active peaks by
        iteration.

    Notes
    -----
    Candidates come from similarity transformations that solve the equations without
    parameters exactly (Eq. (34)); the best, judged by their frequency response, start a
    least-squares fit of the response, and that starts the minimax.

    References
    ----------
    .. [1] "Combining analytic and experimental information for linear
       parameter-varying model identification", Sections 2.2-2.6.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import GrayBoxRestructurer, GrayBoxStructure
    >>> structure = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]])
    >>> black_box = structure.model({"k": 4.0, "c": 0.5, "b": 2.0}).balance()
    >>> restructurer = GrayBoxRestructurer(structure).fit_model(black_box)
    >>> dict(zip(structure.parameter_names, restructurer.params_.round(6).tolist()))
    {'b': 2.0, 'c': 0.5, 'k': 4.0}
    """

    def __init__(
        self,
        structure: GrayBoxStructure | None = None,
        *,
        norm: str = "hinf",
        solver: str = "sqp",
        init: str | ArrayLike = "similarity",
        n_starts: int = 16,
        max_iter: int = 300,
        tol: float = 1e-10,
        random_state: Any = 0,
    ) -> None:
        self.structure = structure
        self.norm = norm
        self.solver = solver
        self.init = init
        self.n_starts = n_starts
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state

    # -- fitting -------------------------------------------------------------------

    def fit_model(
        self, model: StateSpace, *, starts: Sequence[ArrayLike] = ()
    ) -> GrayBoxRestructurer:
        """Restructure a black-box state-space model with the exact H-infinity norm.

        Parameters
        ----------
        model : StateSpace
            Stable; its time domain (continuous, or discrete with its sampling time) is
            that of the gray-box model.
        starts : sequence of array-like of shape (n_params,), default=()
            Further candidates, e.g. the parameters of neighbouring operating points.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If the model is unstable, or the structure has other inputs or outputs.
        """
        self._check_options()
        system = self._error_system(model)
        target = system.target
        self.dropped_feedthrough_ = model.D - target.D
        omega, margin = _grid_and_margin(target)
        self._solve(system, omega, margin, target, starts)
        reference = StateSpace(target.A, target.B, target.C, target.D, target.dt)
        self._finish(system, omega, reference.hinf_norm())
        return self

    def start_error(self, model: StateSpace, params: ArrayLike) -> float:
        """Error of the least-squares fit that begins at given parameters.

        Comparable with `fit_error_`: a smaller one tells that the parameters lie in a
        better basin.

        Parameters
        ----------
        model : StateSpace
        params : array-like of shape (n_params,)

        Returns
        -------
        float
            Root-mean-square error over frequency, relative to the black box; infinite
            where the parameters give an unstable model.
        """
        system = self._error_system(model)
        omega, margin = _grid_and_margin(system.target)
        G0 = system.target_response(omega)
        fit = fit_frequency_response(
            system,
            system.structure.check_params(params),
            omega,
            G0,
            admissible=_stability_test(system, margin),
        )
        return np.inf if fit is None else float(np.sqrt(fit.cost)) / _rms(G0)

    def fit(self, omega: ArrayLike, frf: ArrayLike) -> GrayBoxRestructurer:
        """Restructure a measured frequency response.

        Parameters
        ----------
        omega : array-like of shape (n_freq,) or (n_freq, 1)
            Angular frequencies, rad/s, positive or zero, each once.
        frf : array-like of shape (n_freq, 2 * n_outputs * n_inputs)
            Real parts of the entries of the response, row by row, then the imaginary
            parts; a complex array of shape (n_freq, n_outputs, n_inputs) is accepted.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If `structure` is None (a response does not tell the order), or shapes do
            not fit.
        """
        self._check_options()
        if self.structure is None:
            raise ValueError(
                "`structure` must be given to fit a frequency response, which does not "
                "tell the order. Got None. Use a GrayBoxStructure, or fit_model()."
            )
        structure = self.structure
        grid, G = read_frequency_data(
            omega, frf, structure.n_outputs, structure.n_inputs
        )
        self.n_features_in_ = 1
        self.dropped_feedthrough_ = np.zeros(G.shape[1:])
        system = MeasuredErrorSystem(structure, grid, G)
        margin = 1e-4 * float(system.omega[system.omega > 0][0])
        target = realize_response(system.omega, system.G, structure.order)
        self._solve(system, system.omega, margin, target, ())
        reference = float(np.linalg.norm(system.G, 2, axis=(1, 2)).max())
        self._finish(system, system.omega, reference)
        return self

    def _solve(
        self,
        system: ErrorSystem,
        omega: Array,
        margin: float,
        target: Target | None,
        starts: Sequence[ArrayLike],
    ) -> None:
        """Candidates, least-squares fits, and the minimax from the best of them."""
        structure = self.structure_ = system.structure  # type: ignore[assignment]
        rng = np.random.default_rng(
            check_random_state(self.random_state).randint(2**31)
        )
        G0 = system.target_response(omega)
        size = _rms(G0)
        given = [structure.check_params(start) for start in starts]

        fits: list[LeastSquaresResult] = []
        for round_number in range(_ROUNDS):
            candidates = self._candidates(structure, target, rng, given, round_number)
            fits += best_fits(
                system,
                candidates,
                omega,
                G0,
                admissible=_stability_test(system, margin),
                n_fits=_N_FITS + len(given),
            )
            fits.sort(key=lambda fit: fit.cost)
            if fits and np.sqrt(fits[0].cost) <= _GOOD_FIT * size:
                break
        if not fits:
            raise ValueError(
                "no stable starting point was found for `structure`. Give `init`, a "
                "vector of parameters of a stable model, or raise `n_starts` "
                f"(Got {self.n_starts})."
            )
        relative = np.sqrt([fit.cost for fit in fits]) / size
        self.starts_ = pd.DataFrame({"relative_error": relative})
        self.fit_error_ = float(relative[0])
        best = fits[0]
        theta, result, floor = minimise_hinf(
            system,
            best.x,
            best.R,
            margin,
            SOLVERS[self.solver],
            max_iter=self.max_iter,
            tol=self.tol,
            negligible=_ROUNDING * float(np.linalg.norm(G0, 2, axis=(1, 2)).max()),
        )
        self.params_ = theta
        self.structural_floor_ = floor
        self.remaining_error_ = result.peaks.top
        self.stationarity_ = result.stationarity
        self.second_order_ = result.second_order
        self.n_iter_ = result.n_iter
        self.history_ = pd.DataFrame(result.history)
        peaks = result.peaks
        active = peaks.values >= peaks.top * (1.0 - ACTIVE_PEAK)
        self.active_frequencies_ = np.sort(peaks.frequencies[active])
        if not result.converged:
            warnings.warn(
                f"`max_iter`={self.max_iter} iterations ended before the solver "
                f"converged to `tol`={self.tol}; the best point is kept. Raise `max_iter`.",
                ConvergenceWarning,
                stacklevel=3,
            )
        beyond_floor = relative[0] - floor / np.linalg.norm(G0, 2, axis=(1, 2)).max()
        if beyond_floor > _POOR_FIT:
            warnings.warn(
                f"the structure comes no nearer than {100 * relative[0]:.2g} % (root mean "
                f"square over frequency) to the black box in {len(fits)} fits: either it "
                "cannot represent the model, or the search ended in a wrong basin. Give "
                "`init`, or raise `n_starts`.",
                ConvergenceWarning,
                stacklevel=3,
            )

    def _candidates(
        self,
        structure: GrayBoxStructure,
        target: Target | None,
        rng: np.random.Generator,
        given: list[Array],
        round_number: int,
    ) -> Array:
        n_starts = self.n_starts * (1 + round_number)
        rows = [np.zeros((0, structure.n_params))]
        if round_number == 0 and given:
            rows.append(np.array(given))
        if structure.order == 0:  # a gain: linear in the parameters
            rows.append(np.zeros((1, structure.n_params)))
        elif not isinstance(self.init, str):
            guess = structure.check_params(self.init)
            rows.append(perturbed_candidates(guess, n_starts, rng))
        elif structure.is_affine and target is not None:
            assert structure.offset is not None and structure.basis is not None
            rows.append(
                similarity_candidates(
                    target,
                    structure.offset,
                    structure.basis,
                    structure.order,
                    n_starts,
                    rng,
                )
            )
        elif structure.initial is not None:
            rows.append(perturbed_candidates(structure.initial, n_starts, rng))
        return np.vstack(rows)

    def _finish(self, system: ErrorSystem, omega: Array, reference: float) -> None:
        """Attributes that describe the result."""
        structure = self.structure_
        self.lti_ = structure.model(self.params_, system.dt)
        self.error_ = system.peaks(self.params_).norm
        self.relative_error_ = self.error_ / reference if reference > 0 else np.nan
        J = system.response_jacobian(self.params_, omega)[1]
        self.identifiability_ = Identifiability.from_jacobian(
            J, structure.parameter_names
        )
        if self.identifiability_.rank < structure.n_params:
            warnings.warn(str(self.identifiability_), RankWarning, stacklevel=3)

    def _error_system(self, model: StateSpace) -> ErrorSystem:
        """The error system of a black box, without the D that the structure lacks."""
        structure = self._structure_for(model)
        fixed = structure.matrices(_reference_point(structure))[3]
        D = np.where(_free_feedthrough(structure), model.D, fixed)
        target = Target(model.A, model.B, model.C, D, model.sampling_time)
        return ErrorSystem(structure, target)

    def _structure_for(self, model: StateSpace) -> GrayBoxStructure:
        if not isinstance(model, StateSpace):
            raise ValueError(
                f"`model` must be a StateSpace. Got {type(model).__name__}."
            )
        if not model.is_stable:
            worst = model.poles()[np.argmax(growth(model.poles(), model.sampling_time))]
            raise ValueError(
                "`model` must be stable: its distance to a gray-box model is infinite "
                f"otherwise. Got a pole at {worst:.4g}."
            )
        if self.structure is None:
            feedthrough = bool(model.D.any())
            return GrayBoxStructure.observable_canonical(
                model.order, model.n_inputs, model.n_outputs, feedthrough
            )
        if not isinstance(self.structure, GrayBoxStructure):
            raise ValueError(
                "`structure` must be a GrayBoxStructure or None. Got "
                f"{type(self.structure).__name__}."
            )
        own = (self.structure.n_outputs, self.structure.n_inputs)
        if own != (model.n_outputs, model.n_inputs):
            raise ValueError(
                f"`structure` has {own[0]} outputs and {own[1]} inputs, `model` has "
                f"{model.n_outputs} and {model.n_inputs}. They must agree."
            )
        return self.structure

    def _check_options(self) -> None:
        for name, value, allowed in (
            ("norm", self.norm, ("hinf",)),
            ("solver", self.solver, tuple(SOLVERS)),
        ):
            if value not in allowed:
                raise ValueError(f"`{name}` must be one of {allowed}. Got {value!r}.")
        if isinstance(self.init, str) and self.init != "similarity":
            raise ValueError(
                "`init` must be 'similarity' or a vector of parameters. "
                f"Got {self.init!r}."
            )
        if self.n_starts < 1 or self.max_iter < 0:
            raise ValueError(
                "`n_starts` must be at least 1 and `max_iter` at least 0. Got "
                f"{self.n_starts} and {self.max_iter}."
            )

    # -- use -----------------------------------------------------------------------

    def predict(self, omega: ArrayLike) -> Array:
        """Frequency response of the gray-box model.

        Parameters
        ----------
        omega : array-like of shape (n_freq,) or (n_freq, 1)
            Angular frequencies, rad/s.

        Returns
        -------
        ndarray of shape (n_freq, 2 * n_outputs * n_inputs)
            Real parts of the entries, row by row, then the imaginary parts.
        """
        check_is_fitted(self, "lti_")
        grid = np.asarray(omega, dtype=float).reshape(-1)
        return stack_response(self.lti_.frequency_response(grid))

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.one_d_array = True
        tags.input_tags.two_d_array = False
        tags.target_tags.multi_output = True
        tags.target_tags.single_output = False
        return tags


def _grid_and_margin(target: Target) -> tuple[Array, float]:
    """Frequencies of the least-squares fit, and the stability margin (1/s)."""
    poles = np.linalg.eigvals(target.A).astype(complex)
    slowest = np.abs(growth(poles, target.dt)).min(initial=np.inf)
    margin = _MARGIN * float(slowest) if np.isfinite(slowest) else 0.0
    return frequency_grid(poles, target.dt), margin


def _stability_test(system: ErrorSystem, margin: float) -> Callable[[Array], bool]:
    def stable(theta: Array) -> bool:
        rate = decay_rates(system, theta)[0]
        return bool(np.isfinite(rate).all() and rate.max(initial=-np.inf) <= -margin)

    return stable


def _rms(G: Complex) -> float:
    """Root mean square over frequency of the Frobenius norm, not zero."""
    mean = np.mean(np.sum(np.abs(G) ** 2, axis=(1, 2)))
    return max(float(np.sqrt(mean)), 1e-300)


def _free_feedthrough(structure: GrayBoxStructure) -> NDArray[np.bool_]:
    n = structure.order
    J = structure.jacobian(_reference_point(structure))
    return (J[:, n:, n:] != 0).any(0)


def _reference_point(structure: GrayBoxStructure) -> Array:
    if structure.initial is not None:
        return structure.initial
    return np.zeros(structure.n_params)
