"""Step 4 of the method: a black-box model in the user's gray-box form.

The parameters minimise the H-infinity norm of the difference of the two transfer
functions, Eq. (6): no similarity transformation is involved, and the orders may
differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.metadata_routing import UNUSED
from sklearn.utils.validation import check_is_fitted

from ..exceptions import VersionedPickle, all_or_nothing, warn
from ..minimax.problem import ACTIVE_PEAK, MinimaxResult
from ..models.statespace import StateSpace
from ..structures.structure import GrayBoxStructure
from ..systems.hinf_norm import PeakSet
from ..systems.threads import one_blas_thread
from ..validation import (
    flag,
    naming_argument,
    number,
    one_of,
    positive_time,
    real_array,
    share,
    shown,
    squarable,
    weights,
    whole_number,
)
from .deadline import bounded, time_is_up
from .fit_warnings import (
    tell_of_misfit,
    tell_of_negative_masses,
    tell_of_nonlinear,
    tell_of_open_parameters,
    tell_of_others,
    tell_of_poor_fit,
    tell_of_search,
)
from .frequency_weight import FrequencyWeight
from .least_squares import LeastSquaresResult
from .measured import stack_response
from .minimise_covariance import (
    IMPLAUSIBLE,
    Estimate,
    efficient_parameters,
    measured_response,
    minimise_covariance,
)
from .minimise_h2 import minimise_h2
from .minimise_hinf import SOLVERS, is_saddle, minimise_hinf, promising
from .problem import (
    CLEAN_FIT,
    RestructuringProblem,
    problem_from_models,
    problem_from_response,
)
from .similarity import minimise_bilinear
from .starts import search as starts_of
from .uncertainty import ParameterUncertainty

Array = NDArray[np.float64]

_MOST_STARTS = 100_000  # all are drawn at once

_OPTIMAL = 1e-5  # stationarity from which an optimum is known nearly only

# Of the H-infinity norm's own, and of the black box: an error that is larger by both is
# none that weighing by the uncertainty of the black box should lead to.
_ASTRAY, _FAR = 10.0, 0.5

_ABSENT_ELSEWHERE = (  # attributes that not every fit has
    "params_covariance_",
    "covariance_degrees_of_freedom_",
    "hinf_params_",
    "hinf_error_",
    "chi2_",
    "degrees_of_freedom_",
    "p_value_",
)

_DRAWS = 32  # of the noise: standard deviations to an eighth
_EFFORT = 512  # realizations times parameters, of which more are left out beyond these

_SEARCH_SHARE = 0.7  # of `max_time`, for the starts: the rest is the minimisation's


class GrayBoxRestructurer(VersionedPickle, RegressorMixin, BaseEstimator):
    r"""Find the gray-box parameters whose model is closest to a black box.

    Minimises :math:`\|G(\vartheta) - \mathfrak{G}\|_\infty`, Eq. (6), over the
    parameters of a structure, without an initial guess. A sample of the estimator is a
    frequency; :meth:`fit_model` takes a state-space model instead and works with the
    exact norm.

    Parameters
    ----------
    structure : GrayBoxStructure, default=None
        None is the observable canonical form of the model's order (`fit_model` only).
    norm : {"hinf", "h2", "covariance", "similarity"}, default="hinf"
        What is minimised: the largest singular value of the error over frequency,
        Eq. (6); its mean square over frequency and entries; the error g of the response
        (real and imaginary parts of all frequencies and entries) in the standard
        deviations of the identified black box, :math:`g^\mathsf{T} \Sigma^+ g` with
        its covariance :math:`\Sigma`, begun at the H-infinity optimum: statistically
        efficient; or, for comparison, the bilinear equations of a similarity
        transformation, Eq. (7), for affine structures of the black box's order.
    solver : {"sqp", "bundle"}, default="sqp"
        What ends the search: minimax sequential quadratic programming with exact
        second derivatives, or the paper's proximity control with cutting planes,
        Eq. (18)-(21).
    init : "similarity" or array-like of shape (n_params,), default="similarity"
        Where the search begins: from nothing, by similarity transformations of the
        black box, or from a physical guess.
    n_starts : int, default=16
        Random starts at each of two time scales.
    frequency_weight : StateSpace, (low, high) or None, default=None
        Weight W of the error, ``W (G - G0)``: a stable model with one output for all
        outputs alike, or a square one; or a band in rad/s, None leaving a side open.
    known_poles : array-like of float or complex, default=None
        Poles on the axis or beyond that black box and structure share, in 1/s: the zero
        of an integrator, the pair ``[1j * w0, -1j * w0]`` of an oscillator without
        damping (of a discrete-time model 1, and ``exp`` of ``1j * w0 * dt`` and its
        conjugate). None are those that the structure has for all parameters, by fixed
        entries. They are divided out of both: the error is weighted by ``(s - p) / (s -
        q)`` on every output that shows the pole p, with q the mirror image of p, or,
        on the axis, ``p - c``, c being the distance to the nearest of the black box's
        other poles, and ``|p|`` at most where p is not zero. See Notes.
    max_iter : int, default=1000
        Newton steps on the central path and iterations of the solver, in all.
    max_time : float, default=None
        Seconds after which a fit ends at the best point it has, with a warning where
        more time might have brought a better one. None takes the time it needs.
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
        H-infinity norm of the weighted error (its maximum over the frequencies, after
        `fit`), whatever norm was minimised.
    relative_error_ : float
        `error_` divided by the norm of the weighted black box.
    objective_ : float
        The norm that was minimised.
    lower_bound_ : float
        No parameters have a smaller H-infinity error: the structural floor, or the
        Hankel singular value that a model of the structure's order leaves.
    active_frequencies_ : ndarray
        Frequencies, rad/s, of the peaks that support the optimum.
    hinf_params_, hinf_error_ : ndarray of shape (n_params,), float
        With ``norm="covariance"``: the H-infinity optimum, and its error. The bounds,
        peaks and certificates below and above are those of that optimum; `params_`,
        `lti_`, `error_` and `relative_error_` those of the efficient parameters, which
        are the same where the uncertainty is nil.
    chi2_, degrees_of_freedom_, p_value_ : float
        With ``norm="covariance"``: the minimum, which is a chi-square of that many
        degrees of freedom if the structure is true, and the probability of such a value
        or a higher one; NaN where the uncertainty is nil.
    structural_floor_ : float
        Highest peak of the error that no parameter changes (a gain fixed by the
        structure); 0 where there is none. It is set aside, and the remaining peaks are
        minimised.
    remaining_error_ : float
        Highest peak of the error apart from the floor: what is minimised where the
        floor is above it. A local maximum over frequency that the error dips before,
        coming from the floor, by 1 % at least; 0 where the error only falls from the
        floor; equal to `error_` where there is no floor, or a lower one.
    stationarity_, second_order_ : float
        Shortest vector in the convex hull of the active gradients (0: stationary, or
        proven optimal by `lower_bound_`), and smallest eigenvalue of the reduced
        Hessian (positive: a strict local minimum), relative to the error, in the metric
        of the response.
    convergence_ : {"optimal", "nearly", "saddle", "no"}
        What the certificates make of the result: stationary to 1e-5, or to 1e-3 only; a
        saddle that no step along its negative curvature led out of; or neither, and the
        best point met was kept. The last two are warned of; "no" not where
        `params_` are efficient ones, found, whose error the noise explains.
    identifiability_ : Identifiability
        Which parameters the response determines, and how far its errors grow into
        them.
    dropped_feedthrough_ : ndarray of shape (n_outputs, n_inputs)
        What the black box has in D where the structure has no parameter: left out of
        the comparison, as in Eq. (4).
    fit_error_ : float
        Relative root-mean-square error over frequency of the best least-squares fit.
    params_covariance_ : ndarray of shape (n_params, n_params)
        Covariance of `params_`, the parameters that minimise `norm`, from the spread of
        the `realizations`, or that of the `estimates`, given to `fit_model`, or the
        `noise` given to `fit`; absent without them. Infinite variances where these do
        not determine a parameter, none at its bound. Linear: a warning names the
        parameters in whose intervals the response bends by half of what it moves.
    covariance_degrees_of_freedom_ : float
        What the covariance is known from: one less than the realizations (for the
        H-infinity norm some of them, where there are many for many parameters), or
        than the draws of the noise; infinite for
        ``norm="covariance"``; see :meth:`confidence_intervals`.
    start_params_ : ndarray of shape (n_params,)
        Least-squares fit that the search started from.
    starts_ : DataFrame
        Relative error of the least-squares fits that the search could start from.
    n_iter_ : int
    history_ : DataFrame
        Objective, and mu and Newton steps for each stage of the central path;
        predicted decrease, step bound and number of active peaks by iteration of the
        solver. No rows where the start was the optimum.

    Notes
    -----
    Candidates come from similarity transformations that solve the equations without
    parameters exactly (Eq. (34)); the best ones in frequency response start
    least-squares fits. The best one is trusted where its error is the black box's own
    (rounding, or the uncertainty that is given), or where the next round, of other
    starts, ends there, too. From there a smooth path of minimisers leads to the least
    maximum over frequency (:mod:`~lpvlearn.restructuring.central_path`); the solver
    ends it.

    A motor's position has an integrator, and the distance of two integrators of
    different gains is infinite. With s / (s + c) in front it is that of the gains at
    low frequencies, and Eq. (6) above c; with (s^2 + w0^2) / ((s + c)^2 + w0^2) that of
    the residues of two oscillators at w0, and Eq. (6) away from it. All errors, bounds
    and certificates are then those of the weighted error; `lti_` has the pole. A pole
    of the black box that is nearer to p than c / 20 is an estimate of it, and moved
    there; one that is farther off is weighted alike, not divided.

    Parts that may change places, two lags in series, give one response with either's
    values. Which are whose is told by bounds, ranges, or `init`; where nothing tells
    it, and names that differ by more than digits show that it matters, a warning does.

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

    # Data under names of their own, which scikit-learn would route as metadata.
    __metadata_request__fit = {"omega": UNUSED, "frf": UNUSED}
    __metadata_request__predict = {"omega": UNUSED}

    def __init__(
        self,
        structure: GrayBoxStructure | None = None,
        *,
        norm: str = "hinf",
        solver: str = "sqp",
        init: str | ArrayLike = "similarity",
        n_starts: int = 16,
        frequency_weight: FrequencyWeight = None,
        known_poles: ArrayLike | None = None,
        max_iter: int = 1000,
        max_time: float | None = None,
        tol: float = 1e-10,
        random_state: Any = 0,
    ) -> None:
        self.structure = structure
        self.norm = norm
        self.solver = solver
        self.init = init
        self.n_starts = n_starts
        self.frequency_weight = frequency_weight
        self.known_poles = known_poles
        self.max_iter = max_iter
        self.max_time = max_time
        self.tol = tol
        self.random_state = random_state

    # -- fitting -------------------------------------------------------------------

    @one_blas_thread
    def fit_model(
        self,
        model: StateSpace | Sequence[StateSpace],
        *,
        starts: Sequence[ArrayLike] = (),
        realizations: Sequence[StateSpace] = (),
        estimates: Sequence[Estimate] = (),
        search: bool = True,
    ) -> GrayBoxRestructurer:
        """Restructure a black-box state-space model with the exact H-infinity norm.

        Parameters
        ----------
        model : StateSpace or sequence of StateSpace
            Stable; its time domain (continuous, or discrete with its sampling time) is
            that of the gray-box model. Several models of one operating point are
            matched together: the norm is that of their errors stacked. An
            `input_delay` is left out of the comparison, and put into `lti_`.
        starts : sequence of array-like of shape (n_params,), default=()
            Further candidates, e.g. the parameters of neighbouring operating points.
        realizations : sequence of StateSpace, default=()
            Models from single realizations of the noise, of which `model` is the
            average; their spread gives `params_covariance_`.
        estimates : sequence of (StateSpace, pairs), default=()
            For ``norm="covariance"``: independent estimates of the system (`model`
            itself, or one of each realization), each with its uncertainty: pairs of
            models 0.01 standard deviations to either side of it, along independent
            directions. In the time domain of `model`, or in discrete time with inputs
            that are held.
        search : bool, default=True
            False begins from the given `starts` alone, and so stays in their basins.

        Raises
        ------
        ValueError
            If a model is unstable, the structure has other inputs or outputs, or
            ``norm="covariance"`` has no estimates.
        """
        self._check_options()
        estimates = () if estimates is None else estimates
        lists = {"starts": starts, "realizations": realizations, "estimates": estimates}
        for name, value in lists.items():
            listed = isinstance(value, Sequence) and not isinstance(value, str)
            if not listed and not (isinstance(value, np.ndarray) and value.ndim):
                raise ValueError(
                    f"`{name}` must be a list. Got {type(value).__name__}; put a "
                    "single one in brackets."
                )
        if self.norm == "covariance" and not len(estimates):
            raise ValueError(
                "`norm='covariance'` needs `estimates`: an identified model with its "
                "uncertainty, as LocalLPVPipeline gives it. Got none."
            )
        for estimate in estimates:
            pair = isinstance(estimate, tuple | list) and len(estimate) == 2
            if not pair or not isinstance(estimate[0], StateSpace):
                raise ValueError(
                    "`estimates` must hold pairs of a StateSpace and a list of models "
                    f"to either side of it. Got {type(estimate).__name__}."
                )
        problem = self._problem(model)
        given = [problem.structure.check_params(s, name="starts") for s in starts]
        if not flag("search", search) and not given:
            raise ValueError(
                "`starts` must hold parameters where `search` is False: nothing else "
                "is begun from. Got none."
            )
        if len(realizations):
            problem.check_realizations(realizations)
        problem = problem.with_deviations(realizations, estimates)
        at = self._restructure(problem, given, estimates, only_given=not search)
        if hasattr(self, "params_covariance_"):
            self.covariance_degrees_of_freedom_ = np.inf
        elif len(realizations):
            norm = "hinf" if self.norm == "covariance" else self.norm  # no uncertainty
            # of the maximum each is a minimisation: some tell the spread of all
            few = max(_DRAWS, _EFFORT // len(self.params_))
            seen = realizations[:few] if norm == "hinf" else realizations
            spread = at.covariance_of_runs(seen, norm)
            self.params_covariance_ = spread * (len(seen) / len(realizations))
            self.covariance_degrees_of_freedom_ = len(seen) - 1.0
        tell_of_nonlinear(self, at)
        return self

    @one_blas_thread
    def fit(
        self,
        omega: ArrayLike,
        frf: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        noise: ArrayLike | None = None,
        coherence: ArrayLike | None = None,
        n_averages: int | None = None,
    ) -> GrayBoxRestructurer:
        """Restructure a measured frequency response.

        Parameters
        ----------
        omega : array-like of shape (n_freq,) or (n_freq, 1)
            Angular frequencies, rad/s, positive or zero, each once.
        frf : array-like of shape (n_freq, 2 * n_outputs * n_inputs)
            Real parts of the entries of the response, row by row, then the imaginary
            parts; a complex array of shape (n_freq, n_outputs, n_inputs) is accepted.
        sample_weight : array-like of shape (n_freq,), default=None
            Weight of the error at every frequency.
        noise : array-like of shape (n_freq,), or that of complex `frf`, default=None
            Standard deviation of the error of the response, ``sqrt(E|e|^2)``, at every
            frequency, or of every entry; independent. Errors then count in standard
            deviations (those of an output's entries together), and the covariance of
            the parameters is told.
        coherence : array-like of those shapes, default=None
            In place of `noise`: the squared coherence c of inputs and outputs, above 0
            and at most 1, whose ``|G| sqrt((1 - c) / (c n_averages))`` it is.
        n_averages : int, default=None
            How many independent spectra were averaged for the coherence.

        Raises
        ------
        ValueError
            If `structure` is None (a response does not tell the order), shapes do not
            fit, `frf` is zero, or ``norm="covariance"`` has no noise.

        Examples
        --------
        >>> lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
        >>> omega, rng = np.geomspace(0.1, 10, 40), np.random.default_rng(0)
        >>> errors = 0.05 * rng.normal(size=(40, 2)) @ [1, 1j] / np.sqrt(2)
        >>> restructurer = GrayBoxRestructurer(lag, norm="covariance")
        >>> frf = 3 / (1j * omega + 2) + errors
        >>> found = restructurer.fit(omega, frf, noise=np.full(40, 0.05))
        >>> found.confidence_intervals().round(2)
           value  lower  upper
        a   2.07   2.01   2.12
        b   3.07   3.00   3.14
        """
        self._check_options()
        if self.norm not in ("hinf", "covariance"):
            raise ValueError(
                "`norm` must be 'hinf' or 'covariance' to fit a frequency response. "
                f"Got {self.norm!r}; identify a model first and use fit_model()."
            )
        problem = problem_from_response(
            self.structure,
            omega,
            frf,
            self.frequency_weight,
            sample_weight,
            noise,
            coherence,
            n_averages,
            self.known_poles,
        )
        if self.norm == "covariance" and problem.noise is None:
            raise ValueError(
                "`norm='covariance'` needs the `noise` of the response, or its "
                "`coherence`. Got neither."
            )
        if self.norm == "covariance" and sample_weight is not None:
            raise ValueError(
                "`sample_weight` must be None with norm='covariance', which weighs the "
                "error by its `noise`: put a larger one where the response is doubted."
            )
        at = self._restructure(problem.with_deviations([], []), [])
        if hasattr(self, "params_covariance_"):
            self.covariance_degrees_of_freedom_ = np.inf
        elif problem.noise is not None:
            seed = check_random_state(self.random_state).randint(2**31)
            self.params_covariance_ = at.covariance_of_noise(_DRAWS, seed)
            self.covariance_degrees_of_freedom_ = _DRAWS - 1.0
        tell_of_nonlinear(self, at)
        tell_of_others(self, problem)
        self.n_features_in_ = 1
        return self

    def start_error(self, model: StateSpace, params: ArrayLike) -> float:
        """Error of the least-squares fit from given parameters, as `fit_error_`.

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
        self._check_options()
        problem = self._problem(model)
        fit = problem.fit(problem.structure.check_params(params, name="params"))
        return np.inf if fit is None else fit.relative_error

    def interchanged(self, places: ArrayLike) -> GrayBoxRestructurer:
        """The same fit with its parameters in other places.

        Parameters
        ----------
        places : array-like of shape (n_params,)
            Parameter j becomes the one that is at ``places[j]``: an interchange of
            parts, as of two modes, that leaves the response as it is.

        Returns
        -------
        GrayBoxRestructurer
            A new one; its errors, bounds and certificates are the same.

        Raises
        ------
        ValueError
            If `places` is no permutation.
        """
        check_is_fitted(self, "params_")
        names = self.structure_.parameter_names
        given = real_array("places", places)
        if not np.array_equal(np.sort(given, axis=None), np.arange(given.size)) or (
            given.shape != (len(names),)
        ):
            raise ValueError(
                f"`places` must hold every index from 0 to {len(names) - 1} once. Got "
                f"{shown(places)}."
            )
        pi = given.astype(np.intp)
        other = copy(self)
        for name in ("params_", "hinf_params_", "start_params_"):
            if hasattr(self, name):
                setattr(other, name, getattr(self, name)[pi])
        if hasattr(self, "params_covariance_"):
            other.params_covariance_ = self.params_covariance_[np.ix_(pi, pi)]
        model = self.structure_.model(other.params_, self.lti_.sampling_time)
        other.lti_ = model.with_input_delay(self.lti_.input_delay)
        now = {names[j]: names[i] for i, j in enumerate(pi)}
        directions = tuple(
            {now[name]: value for name, value in direction.items()}
            for direction in self.identifiability_.directions
        )
        gains = self.identifiability_.sensitivities
        other.identifiability_ = replace(
            self.identifiability_,
            directions=directions,
            sensitivities={now[name]: gain for name, gain in gains.items()},
        )
        return other

    def confidence_intervals(self, confidence: float = 0.95) -> pd.DataFrame:
        """Where the parameters are, by their covariance and Student's distribution.

        Parameters
        ----------
        confidence : float, default=0.95
            Probability that an interval holds the true value of its parameter, where
            the structure is true.

        Returns
        -------
        DataFrame of shape (n_params, 3)
            ``value``, ``lower`` and ``upper`` of every parameter.

        Raises
        ------
        ValueError
            If `confidence` is not between 0 and 1, or no covariance is known.

        Examples
        --------
        >>> lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
        >>> runs = [StateSpace(-2, 3 + error, 1) for error in (-0.1, 0.0, 0.1)]
        >>> fitted = GrayBoxRestructurer(lag).fit_model(runs[1], realizations=runs)
        >>> fitted.confidence_intervals().round(3)
           value  lower  upper
        a    2.0  2.000  2.000
        b    3.0  2.752  3.248
        """
        check_is_fitted(self, "params_")
        confidence = share("confidence", confidence)
        if not hasattr(self, "params_covariance_"):
            raise ValueError(
                "confidence intervals need the covariance of the parameters. Got a fit "
                "without: give fit_model() `realizations` or `estimates`, or fit() the "
                "`noise`."
            )
        std = np.sqrt(np.diag(self.params_covariance_))
        freedom = self.covariance_degrees_of_freedom_
        reach = std * student.ppf(0.5 + 0.5 * confidence, freedom)
        value, names = self.params_, list(self.structure_.parameter_names)
        columns = {"value": value, "lower": value - reach, "upper": value + reach}
        return pd.DataFrame(columns, index=names)

    def perturbation_check(
        self, model: StateSpace, n_restarts: int = 10, size: float = 0.05
    ) -> pd.DataFrame:
        """The paper's empirical check of identifiability, Section 3.3.2: restarts.

        Parameters
        ----------
        model : StateSpace
            The model that was restructured.
        n_restarts : int, default=10
        size : float, default=0.05
            Relative standard deviation of the perturbations; of a parameter that is
            zero, their own.

        Returns
        -------
        DataFrame of shape (n_restarts, n_params + 1)
            Relative deviation of every parameter from `params_`, of one that is zero
            the deviation, and `error_`.
        """
        check_is_fitted(self, "params_")
        whole_number("n_restarts", n_restarts, 1, _MOST_STARTS)
        size = number("size", size, "from 0 to 1", low=0.0, high=1.0)
        rng = np.random.default_rng(0)
        rows, norm, params = [], self.norm, self.params_
        if norm == "covariance":
            norm, params = "hinf", self.hinf_params_
        unit = np.where(params == 0.0, 1.0, params)
        for _ in range(n_restarts):
            start = params + size * unit * rng.normal(size=params.shape)
            again = clone(self).set_params(norm=norm, init=start, n_starts=1)
            again.fit_model(model)
            rows.append([*((again.params_ - params) / unit), again.error_])
        names = [*self.structure_.parameter_names, "error_"]
        return pd.DataFrame(rows, columns=names)

    def _check_options(self) -> None:
        one_of("norm", self.norm, ("hinf", "h2", "covariance", "similarity"))
        if self.norm == "covariance" and self.frequency_weight is not None:
            raise ValueError(
                "`frequency_weight` must be None with norm='covariance', which weighs "
                f"the error by its uncertainty. Got {self.frequency_weight!r}."
            )
        one_of("solver", self.solver, tuple(SOLVERS))
        if isinstance(self.init, str) and self.init != "similarity":
            raise ValueError(
                "`init` must be 'similarity' or a vector of parameters. Got "
                f"{self.init!r}."
            )
        whole_number("n_starts", self.n_starts, 1, _MOST_STARTS)
        whole_number("max_iter", self.max_iter, 0)
        if self.max_time is not None:
            positive_time("max_time", self.max_time)
        rule = "a relative decrease, at least 0 and below 1"
        number("tol", self.tol, rule, low=0.0, high=float(np.nextafter(1.0, 0.0)))

    def _problem(
        self, model: StateSpace | Sequence[StateSpace]
    ) -> RestructuringProblem:
        """What is minimised: the distance of the structure to one or several models."""
        models = list(model) if isinstance(model, Sequence) and model else [model]
        return problem_from_models(
            self.structure, models, self.frequency_weight, self.known_poles
        )

    @all_or_nothing
    def _restructure(
        self,
        problem: RestructuringProblem,
        given: list[Array],
        estimates: Sequence[Estimate] = (),
        only_given: bool = False,
    ) -> ParameterUncertainty:
        """Starts and their least-squares fits, minimisation, certificates, warnings.

        All attributes are those of this fit, or, where it fails, of the one before.
        """
        for name in _ABSENT_ELSEWHERE:  # of an earlier fit
            self.__dict__.pop(name, None)
        rule = "be a whole number from 0 to 2**32 - 1, or None"
        with naming_argument("random_state", rule, self.random_state):
            seed = check_random_state(self.random_state).randint(2**31)
        seconds = np.inf if self.max_time is None else float(self.max_time)
        with bounded(seconds):
            with bounded(_SEARCH_SHARE * seconds):
                found = starts_of(
                    problem, self.init, self.n_starts, given, seed, only_given
                )
                hurried = time_is_up()
            problem, fits = found.problem, found.fits
            errors = [fit.relative_error for fit in fits]
            self.starts_ = pd.DataFrame({"relative_error": errors})
            self.fit_error_, self.start_params_ = errors[0], fits[0].x
            self.params_, result, floor = self._minimise(problem, fits)
            self._describe(problem, result, floor)
            settled = False
            if self.norm == "covariance":
                others = [*(fit.x for fit in promising(fits)), *given]
                settled = self._weigh(problem, estimates, others)
            at = ParameterUncertainty(problem, self.params_)
            self.identifiability_ = at.identifiability()
            guessed = not isinstance(self.init, str) or only_given
            doubted = not (guessed or found.certain)
            tell_of_search(
                self,
                problem,
                result,
                doubted=doubted,
                hurried=hurried,
                settled=settled,
            )
            tell_of_poor_fit(self, problem)
            tell_of_negative_masses(self)
            tell_of_open_parameters(self)
        return at

    def _minimise(
        self, problem: RestructuringProblem, fits: list[LeastSquaresResult]
    ) -> tuple[Array, MinimaxResult, float]:
        """Parameters of the least norm, their certificate, and the structural floor."""
        system, margin = problem.system, problem.margin
        if self.norm == "similarity":
            found = minimise_bilinear(
                problem.structure, problem.box, fits[0].x, self.max_iter
            )
            return *found, 0.0
        rounding = max(CLEAN_FIT, problem.rounding(fits[0].x))
        options: dict[str, Any] = {
            "max_iter": self.max_iter,
            "tol": self.tol,
            "negligible": problem.reference * rounding,
        }
        if self.norm == "h2":
            runs = [minimise_h2(system, f, margin, **options) for f in promising(fits)]
            return *min(runs, key=lambda run: run[1].peaks.top), 0.0
        theta, result, floor = minimise_hinf(
            system, fits, margin, SOLVERS[self.solver], **options
        )
        if problem.is_least(result.peaks.top):
            # no model is nearer; where the error is equally high everywhere, its peaks
            # could not tell
            bend = max(result.second_order, 0.0)
            result = replace(
                result, stationarity=0.0, second_order=bend, converged=True
            )
        return theta, result, floor

    def _stand_at(self, problem: RestructuringProblem) -> PeakSet:
        """The model of `params_` and its errors, whose peaks are returned."""
        peaks = problem.system.peaks(self.params_)
        self.lti_, self.error_ = problem.model(self.params_), peaks.norm
        self.relative_error_ = self.error_ / problem.reference
        return peaks

    def _describe(
        self, problem: RestructuringProblem, result: MinimaxResult, floor: float
    ) -> None:
        """Attributes that describe the result."""
        self.structure_ = problem.whole
        peaks = self._stand_at(problem)
        self.dropped_feedthrough_ = problem.dropped_feedthrough
        self.structural_floor_ = floor
        self.lower_bound_ = max(floor, problem.lower_bound)
        self.stationarity_ = result.stationarity
        self.second_order_ = result.second_order
        self.convergence_ = "optimal"
        if not result.converged:
            self.convergence_ = "no"
        elif is_saddle(result):
            self.convergence_ = "saddle"
        elif result.stationarity > _OPTIMAL:
            self.convergence_ = "nearly"
        self.n_iter_ = result.n_iter
        self.history_ = pd.DataFrame(result.history)
        minimax = self.norm in ("hinf", "covariance")
        self.objective_ = self.error_ if minimax else result.peaks.top
        if minimax:
            found = result.peaks
            active = found.values >= found.top * (1.0 - ACTIVE_PEAK)
            self.active_frequencies_ = np.sort(found.frequencies[active])
            self.remaining_error_ = found.top
        else:
            self.active_frequencies_ = np.sort(peaks.frequencies)
            self.remaining_error_ = self.error_

    def _weigh(
        self,
        problem: RestructuringProblem,
        estimates: Sequence[Estimate],
        others: Sequence[Array],
    ) -> bool:
        """From the H-infinity optimum to the parameters weighed by the uncertainty.

        Or from `others`, least-squares fits of several basins. Returns whether the
        search for them converged where the noise explains the error that they leave.
        """
        self.hinf_params_, self.hinf_error_ = self.params_, self.error_
        self.chi2_ = self.degrees_of_freedom_ = self.p_value_ = np.nan
        admissible = None if problem.division is None else problem.is_stable
        if problem.noise is None:
            found = efficient_parameters(
                problem.whole,
                estimates,
                self.params_,
                others=others,
                sampling_time=problem.system.dt,
                admissible=admissible,
                astray=lambda theta: (
                    problem.system.peaks(theta).norm
                    > max(_ASTRAY * self.hinf_error_, _FAR * problem.reference)
                ),
            )
        else:
            box = measured_response(problem.omega, problem.response, problem.noise)
            found = minimise_covariance(
                problem.system, self.params_, problem.margin, [box]
            )
        if found is None:
            return False
        self.params_, self.params_covariance_ = found.theta, found.covariance
        self._stand_at(problem)
        self.chi2_, self.objective_ = found.cost, np.sqrt(found.cost)
        self.degrees_of_freedom_ = found.degrees_of_freedom
        self.p_value_ = found.p_value
        if not found.converged:
            warn(
                "the search for the parameters weighed by the uncertainty of the black "
                "box did not end: the data may not determine them all. Take a "
                "structure of fewer parameters, or norm='hinf'.",
                ConvergenceWarning,
            )
        if not found.is_plausible:
            tell_of_misfit(self, found, estimates)
        return found.converged and found.p_value > IMPLAUSIBLE

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
        grid = real_array("omega", omega).reshape(-1)
        return stack_response(self.lti_.frequency_response(grid))

    def score(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> float:
        """Coefficient of determination of `predict`, as scikit-learn's regressors.

        Parameters
        ----------
        X : array-like of shape (n_freq,) or (n_freq, 1)
            Angular frequencies, rad/s.
        y : array-like of shape (n_freq, 2 * n_outputs * n_inputs)
            The response there, as `predict` gives it; a complex array of shape (n_freq,
            n_outputs, n_inputs) is accepted, as by `fit`.
        sample_weight : array-like of shape (n_freq,), default=None
            Weights of the frequencies.

        Returns
        -------
        float
            1 for an equal response.

        Raises
        ------
        ValueError
            When a value is too large to be squared, or shapes do not fit.
        """
        if isinstance(y, np.ndarray) and y.dtype.kind == "c" and y.ndim == 3:
            y = stack_response(y)
        y = squarable("y", real_array("y", y))
        if y.size == 0:
            raise ValueError("`y` must hold a row for each frequency. Got none.")
        if sample_weight is not None:
            sample_weight = weights(sample_weight, len(np.atleast_1d(y)), "frequency")
        return float(super().score(X, y, sample_weight))

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.one_d_array = True
        tags.input_tags.two_d_array = False
        tags.target_tags.multi_output = True
        tags.target_tags.single_output = False
        return tags
