"""Refinement of an LPV model on data whose scheduling variables move."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from joblib import Memory
from numpy.typing import NDArray
from sklearn.base import clone

from ..data.experiments import NO_TIME, Experiment, naming
from ..data.operating_points import (
    check_outputs,
    local_experiments,
    moving_experiments,
    without_spikes,
)
from ..data.preparation import complete_runs, part_of
from ..data.tables import read_outputs
from ..data.timestamps import TIME_TOL
from ..exceptions import all_or_nothing, collected, warn
from ..lpv.auto import AutoLPV
from ..lpv.bands import left_out_errors, levels_of
from ..lpv.interpolator import Interpolator
from ..lpv.model import LPVStateSpace
from ..lpv.polynomial import PolynomialLPV
from ..lpv.refinement import (
    Own,
    Prior,
    Record,
    coefficients_of,
    local_prior,
    refine,
    refine_with_rates,
    simulated,
    squares,
    weights_of,
)
from ..lpv.weighting import covariance_of, is_chance
from ..metrics.scores import best_fit
from ..models.scheduling_range import grid_over
from ..restructuring.estimator import GrayBoxRestructurer
from ..structures.structure import GrayBoxStructure
from ..subspace.estimator import SubspaceLTI
from ..systems.threads import one_blas_thread
from ..validation import (
    number,
    one_of,
    positive_time,
    units_by_name,
    verbosity,
    whole_number,
)
from .checks.bands import output_errors
from .checks.error_warnings import CONSTANT, tell_of_errors, tell_of_noisy_scheduling
from .checks.stability import grows, growth_rates
from .one_basis.black_boxes import balanced_entries
from .one_basis.structured_models import (
    StructuredModels,
    mirror_images,
    over_points,
    restructure_points,
    without_structure,
)
from .points.common_choices import common_delay, identify_points, of_structure
from .points.local_models import LocalModel, balanced_by_motion, identify_point, is_left
from .running.runner import PointRunner
from .running.workers import check_jobs, results_of
from .scheduled import ScheduledEstimator
from .steps import check_step

Array = NDArray[np.float64]

_NO_COEFFICIENTS = (
    "`{}` needs an interpolator with coefficients to fit: AutoLPV, PolynomialLPV, "
    "RationalLPV or SplineLPV. Got {}."
)

_UNSEEN = "Where no experiment stays, nothing tells what the model does in the end."

# Parts of an experiment, each nearer to an operating point than the whole, of which
# time-invariant models are made, too; how many of these are tried, by so many steps.
_PARTS, _N_STARTS, _FIRST_STEPS = 5, 3, 15

# Of starts with several orders: squared errors, in the least ones, and errors relative
# to the outputs, that are alike after steps that do not reach the end of a valley; and
# orders that are tried beyond one that is as good, as a resonance has two states
_ALIKE, _NEGLIGIBLE, _FURTHER = 1.1, 1e-3, 2

# Part of what a beginning at rest misses that one held by the first inputs may miss,
# and of its squares what is rounding
_NEARER, _ROUNDING = 0.5, 1e-12

_LOOKED_AT = 4  # experiments of an operating point: more tell the same of the errors

_FEWEST_POINTS = 3  # at which experiments stay, of a model through these

# Errors of a refined model along its own experiments that are told: relative to the
# outputs, and to those of the start along the local ones
_MISSED, _MORE = 0.2, 3.0

_LEVELS = 5  # of every scheduling variable, where a form begins as a constant


class OutputErrorLPV(ScheduledEstimator):
    """An LPV model fitted to experiments along which the scheduling variables move.

    Minimises the simulation error over the coefficients of the interpolation, from a
    model that is known, or from a time-invariant one of the table. As the `refiner` of
    a `LocalLPVPipeline` it refines the model of the local experiments. A row of the
    table is a time instant.

    Parameters
    ----------
    start : LPVStateSpace, GrayBoxStructure or None, default=None
        Where the search begins: an LPV model, or one with constant matrices, identified
        from the table, or a part of an experiment, as if it were time-invariant, or one
        through the operating points at which experiments stay: in a structure, or
        without one (None) balanced, every entry of its matrices free; the one whose
        first steps come farthest. Without a structure, and an order of `local`, the
        lowest that does as well as any. A pipeline gives its own.
    rate : {"auto", True, False}, default="auto"
        Whether A follows the rates of change of the scheduling variables too, by terms
        ``N_j(kappa) dkappa_j/dt`` in every row of A that holds parameters, quadratic
        polynomials, drawn to zero as strongly as is best for pieces of the experiments
        that they were not fitted to. "auto": where they lower the errors of these; not
        where a single experiment moves.
    prior : {"local"}, float or None, default="local"
        What a pipeline knows of the coefficients, from the covariances of the local
        parameters (without these, from the local experiments), pulls to the start:
        with its own weight, times a factor, or not at all. Alone there is none.
    interpolator : PolynomialLPV, RationalLPV or SplineLPV, default=None
        The form of the parameters where `start` is no LPV model. None is the one that
        `AutoLPV` takes through three or more operating points at which experiments
        stay, or ``PolynomialLPV(2)``, without a structure ``PolynomialLPV(1)``.
    local : estimator, default=None
        The time-invariant model to start from; None is
        ``SubspaceLTI(stability="enforce")``. ``order="auto"`` becomes the order of the
        structure, as in `LocalLPVPipeline`.
    initial_state : {"estimate", "rest"}, default="estimate"
        Whether the initial state of every experiment is unknown.
    offset : {"auto", None, "constant"}, default="auto"
        "constant": every output of every experiment has an unknown constant. The model
        that `fit` gives has their mean as its `output_offset`, unless `start` has
        offsets; that of a pipeline, where they are the sensors', leaves them out.
        "auto" takes constants where `start` is no LPV model, the time-invariant model
        of the table has them, and they leave less than half of the errors; else none,
        and none in a pipeline.
    inputs, scheduling, experiment, time : column name, position or list, default=None
        Roles of the columns of X, as in `LocalLPVPipeline`.
    sampling_time : float, default=None
        Seconds between samples; None reads it from the time column.
    time_tol : float, default=0.01
        Largest deviation of a time stamp from an even grid, relative to the step.
    missing : {"raise", "split"}, default="raise"
        What a missing value (NaN), or a hole in time, does: raise an error, or cut the
        experiment there into runs with initial states of their own.
    units : dict of str to str, default=None
        Units of columns and parameters, by name, as in `LocalLPVPipeline`, which gives
        its own. They join those of `start`.
    max_iter : int, default=200
        Largest number of steps tried.
    n_jobs : int, default=None
        Experiments simulated at the same time.
    verbose : int, default=0
        1 shows a progress bar.

    Attributes
    ----------
    lpv_ : LPVStateSpace
        The refined model. Signals that `start` gives no names have those of the table.
        Its `steady_start` is True where all experiments together begin nearer to where
        their first inputs hold it than to rest.
    rate_ : bool
        Whether it has rate terms.
    coefficients_ : ndarray of shape (n_coefficients,)
        Of ``lpv_.interpolator``, then of ``lpv_.rate_terms``.
    coefficients_covariance_ : ndarray of shape (n_coefficients, n_coefficients)
        To first order, for errors that are white: inverse of the information of
        records and prior. Zero for coefficients that were held.
    deviation_ : ndarray of shape (n_outputs,)
        Standard deviations of what is left of the outputs: the weights.
    initial_states_, offsets_ : ndarray of shape (n_runs, order) and \
(n_runs, n_outputs)
        Of every run (the state of the structure, about rest), zero where not estimated.
        Without gaps a run is an experiment.
    report_ : DataFrame
        One row per experiment: samples, BFT (percent, mean over the outputs) of the
        start and of the refined model, from the initial states that fit best.
    n_iter_ : int
        Number of steps tried, of the last search.
    history_ : DataFrame
        One row per step taken: round of the variances, cost.
    output_errors_ : DataFrame
        One row per output: standard deviations of the "model_error" and of the "noise"
        in what the refined model leaves of the outputs, as `prediction_std` has them.
    sampling_time_ : float
    output_names_, scheduling_names_ : list
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    See Also
    --------
    LocalLPVPipeline : From local experiments, with this estimator as `refiner`.

    Notes
    -----
    With the coefficients c, and the inverse variances W of what is left, estimated
    anew until they settle,

    .. math:: \\min_c \\sum_k \\|y_k - y_k(c)\\|_W^2
              + (c - c_0)^T \\Lambda (c - c_0)

    by Levenberg and Marquardt's method; the derivatives follow the recursion of the
    simulation, and are exact. Initial states and constants are projected out. The
    effort, and the memory for the outputs, are linear in the number of samples.

    Local experiments say nothing of the rates of change of the scheduling variables;
    data that move do. One record in one direction fits as well with coefficients that
    fail in the other: keep the prior, and record both.

    References
    ----------
    L. H. Lee, K. Poolla, Identification of linear parameter-varying systems using
    nonlinear programming. Journal of Dynamic Systems, Measurement, and Control 121,
    1999.

    Examples
    --------
    A spring that stiffens, along one sweep of the scheduling variable:

    >>> import numpy as np
    >>> from lpvlearn import GrayBoxStructure, LPVStateSpace, OutputErrorLPV
    >>> from lpvlearn import PolynomialLPV, from_trajectories
    >>> spring = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", -1]], B=[[0], [1]], C=[[1, 0]])
    >>> kappa = np.linspace(0, 1, 500)
    >>> ends = np.array([[0.0], [1.0]])
    >>> truth = LPVStateSpace(spring, PolynomialLPV(1).fit(ends, [[4.0], [9.0]]), ends)
    >>> u = np.sign(np.random.default_rng(0).standard_normal(500))
    >>> X, y = from_trajectories([(u, kappa, truth.simulate(u, kappa, 0.1))],
    ...                          sampling_time=0.1)
    >>> rough = LPVStateSpace(spring, PolynomialLPV(1).fit(ends, [[5.0], [7.0]]), ends)
    >>> model = OutputErrorLPV(rough, scheduling="kappa", experiment="experiment",
    ...                        time="time").fit(X, y)
    >>> model.lpv_.parameters([0.0, 1.0]).round(4).ravel()
    array([4., 9.])
    """

    def __init__(
        self,
        start: Any = None,
        *,
        rate: bool | str = "auto",
        prior: Any = "local",
        interpolator: Any = None,
        local: Any = None,
        initial_state: str = "estimate",
        offset: str | None = "auto",
        inputs: Any = None,
        scheduling: Any = None,
        experiment: Any = None,
        time: Any = None,
        sampling_time: float | None = None,
        time_tol: float = TIME_TOL,
        missing: str = "raise",
        units: Mapping[str, str] | None = None,
        max_iter: int = 200,
        n_jobs: int | None = None,
        verbose: int = 0,
    ) -> None:
        self.start = start
        self.rate = rate
        self.prior = prior
        self.interpolator = interpolator
        self.local = local
        self.initial_state = initial_state
        self.offset = offset
        self.inputs = inputs
        self.scheduling = scheduling
        self.experiment = experiment
        self.time = time
        self.sampling_time = sampling_time
        self.time_tol = time_tol
        self.missing = missing
        self.units = units
        self.max_iter = max_iter
        self.n_jobs = n_jobs
        self.verbose = verbose

    @all_or_nothing
    @one_blas_thread
    def fit(self, X: Any, y: Any) -> OutputErrorLPV:
        """Fit the model to the experiments of a table.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            Inputs, scheduling variables and columns with other roles.
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If a role names no column, the table does not fit the start, or an option
            is not one of those above.
        DivergenceError
            If the start diverges on an experiment.

        Warns
        -----
        UserWarning
            If the model is unstable at values within its range; if its errors are more
            than a tenth of an output and constants would halve them, or that
            much of them follows from the inputs and scheduling variables.
        """
        self._check_options()
        experiments = without_spikes(self._read(X, y, reset=True))
        names = read_outputs(y)[1]
        check_outputs(experiments, names)
        self._remember_shape(y)
        self.output_names_, self.n_outputs_ = names, len(names)
        dt = self._sampling_time(experiments)
        (start, own), first = self._start(experiments, dt), experiments[0]
        start = replace(
            start,
            scheduling_names=start.scheduling_names or first.scheduling_names or None,
            input_names=start.input_names or first.input_names,
            output_names=start.output_names or names,
            units={**(start.units or {}), **(self.units or {})} or None,
        )
        self._refine(start, experiments, dt, own)
        if own.constant and start.offsets is None:
            self.lpv_ = replace(self.lpv_, offsets=self._mean_offset())
        levels = grid_over(self.lpv_.scheduling_range, 3)
        longest = dt * max(len(e.rows) for e in experiments)
        growth = growth_rates(self.lpv_, levels, longest, _UNSEEN)
        # what grows, or hardly decays, no inputs hold
        if not self.lpv_.steady_start and (growth < 0.0).all():
            records = [_record(e, dt) for e in experiments]
            steady = _begin_held(self.lpv_, records, own)
            self.lpv_ = replace(self.lpv_, steady_start=steady)
        return self

    def refine(
        self,
        start: LPVStateSpace,
        experiments: Sequence[Experiment],
        sampling_time: float,
        known: Prior | None = None,
    ) -> OutputErrorLPV:
        """Fit the model to experiments that were read already.

        Parameters
        ----------
        start : LPVStateSpace
        experiments : list of Experiment
            Without missing values.
        sampling_time : float
            Seconds, of experiments that do not tell it.
        known : Prior, default=None
            What is known of the coefficients of the interpolator: `centre`
            (n_coefficients,), and its `information`, an inverse covariance.

        Returns
        -------
        self

        Raises
        ------
        DivergenceError
            If the start diverges on an experiment.
        """
        self._check_options()
        own = _own_of(self)
        return self._refine(start, experiments, sampling_time, own, known)

    # -- helpers -------------------------------------------------------------------

    def _refine(
        self,
        start: LPVStateSpace,
        experiments: Sequence[Experiment],
        sampling_time: float,
        own: Own,
        known: Prior | None = None,
    ) -> OutputErrorLPV:
        """As `refine`, with unknowns of every experiment that are decided."""
        start = replace(start, covariance=None)  # of coefficients that will be others
        records = [_record(e, sampling_time) for e in experiments]
        prior, factor = None, 1.0 if self.prior == "local" else self.prior
        if known is not None and factor is not None:
            more = np.zeros(len(coefficients_of(start)) - len(known.centre))
            weighed = known._replace(information=factor * known.information)
            prior = weighed.widened(more)
        labels = [e.label for e in experiments]
        groups = pd.factorize(pd.Series(labels, dtype=object))[0].tolist()
        before = _errors(start, experiments, records, own)
        run = partial(results_of, n_jobs=self.n_jobs)
        with _progress(self.verbose) as tell:
            found = refine_with_rates(
                start,
                records,
                own,
                prior,
                rate=self.rate,
                groups=groups,
                max_iter=self.max_iter,
                run=run,
                tell=tell,
            )
        seen = np.vstack([record.kappa for record in records])
        inner = _union(start.scheduling_range, seen)
        identified = inner
        if start.identified_range is not None:
            identified = _union(inner, np.asarray(start.identified_range))
        self.coefficients_ = coefficients_of(found.model)
        self.coefficients_covariance_ = np.zeros((len(self.coefficients_),) * 2)
        free = np.flatnonzero(found.free)
        covariance = covariance_of(found.information)
        self.coefficients_covariance_[np.ix_(free, free)] = covariance
        self.lpv_ = replace(
            found.model,
            scheduling_range=inner,
            identified_range=identified,
            covariance=self.coefficients_covariance_,
        )
        self.scheduling_range_, self.sampling_time_ = identified, sampling_time
        names = list(experiments[0].scheduling_names or start.scheduling_names or ())
        self.scheduling_names_ = names or [*range(1, start.n_scheduling + 1)]
        self.rate_ = self.lpv_.rate_terms is not None
        self.deviation_, self.n_iter_ = found.deviation, found.n_iter
        n = start.order if own.initial_state else 0
        self.initial_states_ = np.zeros((len(records), start.order))
        self.offsets_ = np.zeros((len(records), start.n_outputs))
        for k, values in enumerate(found.own):
            self.initial_states_[k, :n] = values[:n]
            if own.constant:
                self.offsets_[k] = values[n:]
        after = _errors(self.lpv_, experiments, records, own)
        self.report_ = _report(labels, records, before, after)
        tell_of_errors(self.lpv_, records, after, own, start, prior, self.max_iter)
        self.output_errors_ = output_errors(
            start.output_names or range(1, start.n_outputs + 1),
            after,
            left_out_errors(found, records, own, run=run),
        )
        self.history_ = pd.DataFrame(found.costs, columns=["round", "cost"])
        return self

    @property
    def _splits(self) -> bool:
        return self.missing == "split"

    def _mean_offset(self) -> PolynomialLPV:
        """The constants of the outputs, as the offsets of a model over its range."""
        lpv = self.lpv_
        mean = self.offsets_.mean(axis=0)
        values = np.concatenate([np.zeros(lpv.n_inputs), mean, np.zeros(lpv.order)])
        ends = np.asarray(lpv.scheduling_range)
        form = PolynomialLPV(0, extrapolation="ignore")
        return form.fit(ends, np.tile(values, (len(ends), 1)))

    def _sampling_time(self, experiments: Sequence[Experiment]) -> float:
        steps = [e.sampling_time for e in experiments if e.sampling_time is not None]
        if steps:
            return float(np.median(steps))
        if self.sampling_time is None:
            raise ValueError(NO_TIME.format("an LPV model is"))
        return positive_time("sampling_time", self.sampling_time)

    def _start(
        self, experiments: Sequence[Experiment], dt: float
    ) -> tuple[LPVStateSpace, Own]:
        """The model given, or a time-invariant one in the form of an LPV model.

        And the unknowns of every experiment that go with it.
        """
        names = experiments[0].scheduling_names
        if isinstance(self.start, LPVStateSpace):
            model = self.start
            sizes = (
                len(experiments[0].input_names),
                self.n_outputs_,
                max(len(names), 1),
            )
            if sizes != (model.n_inputs, model.n_outputs, model.n_scheduling):
                raise ValueError(
                    f"`start` has {model.n_inputs} input(s), {model.n_outputs} "
                    f"output(s) and {model.n_scheduling} scheduling variable(s). Got "
                    f"a table with {sizes[0]}, {sizes[1]} and {len(names)}."
                )
            if not isinstance(model.interpolator, Interpolator):
                got = type(model.interpolator).__name__
                raise ValueError(_NO_COEFFICIENTS.format("start", got))
            return model, _own_of(self)
        records = [_record(e, dt) for e in experiments]
        seen = np.vstack([r.kappa for r in records]) if names else np.zeros((1, 1))
        bounds = np.array([seen.min(axis=0), seen.max(axis=0)])
        with collected():  # where a search begins, nobody needs to hear of
            local, most = of_structure(self._local(), self.start)
            whole = _time_invariant(local, experiments, dt, most)
            models = self._constant_models(whole, experiments, bounds)
            plainer = _plainer(local, whole.order_of_rates)
            for part in [part for e in experiments for part in _parts_of(e)]:
                with suppress(ValueError):  # it tells too little
                    found = _time_invariant(plainer, [part], dt, most)
                    models += self._constant_models(found, [part], bounds)
            with suppress(ValueError):
                models += self._through_points(experiments, dt, bounds)
        own = _own_of(self)
        if self.offset == "auto" and whole.n_trend:
            with_constants = own._replace(constant=True)
            tried = _promising(models, records, with_constants)
            # slow states of a higher order would stand for constants
            fewest = _of_fewest_states(tried, records, 1.0 / CONSTANT)
            if _asks_for_constants(fewest, records, own):
                return _of_fewest_states(tried, records), with_constants
        return _of_fewest_states(_promising(models, records, own), records), own

    def _through_points(
        self, experiments: Sequence[Experiment], dt: float, bounds: Array
    ) -> list[LPVStateSpace]:
        """The model through the operating points at which experiments stay, if any."""
        points = local_experiments(moving_experiments(experiments)[0])
        if len(points) < _FEWEST_POINTS:
            return []
        runner = PointRunner(self.n_jobs, 0, "raise", Memory(None))
        structure = self.start
        local, points = identify_points(
            self._local(),
            points,
            runner,
            structure=structure,
            sampling_time=dt,
            combine="pool",
            discretization="zoh",
            efficient=True,
        )
        form = AutoLPV() if self.interpolator is None else clone(self.interpolator)
        known = local, points, runner, dt
        if structure is None:
            ways = without_structure(*known, form, every=True)
        else:
            known_points = restructure_points(GrayBoxRestructurer(structure), *known)
            ways = mirror_images(known_points)
        found = [_through(form, way, dt) for way in ways]
        return [replace(model, scheduling_range=bounds) for model in found]

    def _local(self) -> Any:
        return SubspaceLTI(stability="enforce") if self.local is None else self.local

    def _constant_models(
        self, found: LocalModel, experiments: Sequence[Experiment], bounds: Array
    ) -> list[LPVStateSpace]:
        """The time-invariant model of some experiments, in the form of an LPV model.

        And where the order is free what has fewer states: what moves looks like states
        to a time-invariant model, but not along the scheduling variables.
        """
        structure, delay = self.start, found.lti.input_delay
        form = self.interpolator
        if form is None:
            form = PolynomialLPV(1 if structure is None else 2)
        if not experiments[0].scheduling_names:
            form = PolynomialLPV(0)
        grid = grid_over(bounds, _LEVELS)
        if structure is None:
            free = is_left(self._local(), "order") and found.lti.is_stable
            orders = [*range(1, found.lti.order)] if free else []
            entries = [
                balanced_entries([balanced_by_motion(found.lti, experiments, order)])
                for order in [*orders, None]
            ]
        else:
            theta = GrayBoxRestructurer(structure).fit_model(found.lti).params_
            entries = [(structure, theta[None])]
        models = []
        for structure, theta in entries:
            constant = clone(form).fit(grid, np.tile(theta, (len(grid), 1)))
            models.append(LPVStateSpace(structure, constant, bounds, input_delay=delay))
        return models

    def _check_options(self) -> None:
        one_of("rate", self.rate, ("auto", True, False))
        one_of("initial_state", self.initial_state, ("estimate", "rest"))
        one_of("offset", self.offset, ("auto", None, "constant"))
        one_of("missing", self.missing, ("raise", "split"))
        units_by_name(self.units)
        verbosity(self.verbose)
        whole_number("max_iter", self.max_iter, 1)
        check_jobs(self.n_jobs)
        check_step("local", self.local)
        check_step("interpolator", self.interpolator)
        form = self.interpolator
        if not (form is None or isinstance(form, Interpolator)):
            got = type(form).__name__
            raise ValueError(_NO_COEFFICIENTS.format("interpolator", got))
        if not (self.prior is None or isinstance(self.prior, str)):
            number(
                "prior", self.prior, "'local', a factor of 0 or more, or None", low=0
            )
        elif self.prior is not None:
            one_of("prior", self.prior, ("local", None))
        if not (
            self.start is None
            or isinstance(self.start, LPVStateSpace | GrayBoxStructure)
        ):
            raise ValueError(
                "`start` must be an LPVStateSpace (of a fitted pipeline, its `lpv_`), "
                f"a GrayBoxStructure, or None. Got {type(self.start).__name__}."
            )


def refine_model(
    refiner: Any,
    model: LPVStateSpace,
    experiments: Sequence[Experiment],
    sampling_time: float,
    known: Prior,
) -> Any:
    """A clone of the refiner, with the refined model."""
    return clone(refiner).refine(model, experiments, sampling_time, known)


def known_coefficients(
    model: LPVStateSpace, found: StructuredModels, sampling_time: float
) -> Prior:
    """What the operating points tell of the coefficients.

    By the covariances of the parameters; without these, from the local experiments,
    where nothing of them is missing.
    """
    form = model.interpolator
    if not isinstance(form, Interpolator):
        raise ValueError(_NO_COEFFICIENTS.format("refiner", type(form).__name__))
    points = found.points
    information = form.information(points.kappa, found.covariance)
    if information is not None:
        return Prior(form.coefficients(), information)
    runs = [[run for e in g for run in complete_runs(e)] for g in points.experiments]
    groups = [[_record(e, sampling_time) for e in g] for g in runs]
    own = _own_of_local(found)
    return local_prior(model, points.kappa, found.theta, groups, own)


def _parts_of(e: Experiment) -> list[Experiment]:
    """Parts of an experiment, along which the scheduling variables move less."""
    ends = np.linspace(0, len(e.rows), _PARTS + 1).astype(int)
    return [part_of(e, slice(a, b)) for a, b in pairwise(ends) if b > a + 1]


def _time_invariant(
    local: Any, experiments: Sequence[Experiment], dt: float, most: bool
) -> LocalModel:
    """A model of experiments as if they did not move; options as `identify_point`."""
    return identify_point(
        local,
        experiments,
        sampling_time=dt,
        combine="pool",
        discretization="zoh",
        deviate=False,
        most=most,
    )


def _plainer(local: Any, order: int) -> Any:
    """The estimator for parts of experiments, where these only make more starts.

    What was left to it, it need not weigh there: what each does along all of the
    experiments tells.
    """
    if type(local) is not SubspaceLTI:
        return local
    plain = {"order": order, "method": "po-moesp", "offset": "constant"}
    chosen = {name: v for name, v in plain.items() if is_left(local, name)}
    return clone(local).set_params(refine=False, **chosen)


_Tried = list[tuple[float, LPVStateSpace]]  # errors of first steps, and start


def _promising(
    models: Sequence[LPVStateSpace], records: Sequence[Record], own: Own
) -> _Tried:
    """The start of every order whose first steps come farthest, and how far.

    From few states up, to some more than are as good as any.
    """
    if len(models) == 1:
        return [(0.0, models[0])]
    weight = weights_of(records)

    def loss(model: LPVStateSpace) -> float:
        return squares(model, records, own, weight)

    def soon(model: LPVStateSpace) -> tuple[float, LPVStateSpace]:
        try:
            found = refine(model, records, own, max_iter=_FIRST_STEPS).model
        except ValueError:  # it diverges, or has states too fast for its samples
            return np.inf, model
        return loss(found), found

    longest = max(len(record.u) * record.dt for record in records)
    orders = sorted({model.order for model in models})
    tried: _Tried = []
    for n in orders:
        best = sorted((m for m in models if m.order == n), key=loss)[:_N_STARTS]
        ends = [(*soon(model), model) for model in best]
        least, found, model = min(ends, key=lambda one: one[0])
        if len(orders) > 1:
            least, found = soon(found)
            # free initial states allow that: simulations from elsewhere pay for it
            if grows(found, grid_over(found.scheduling_range, 3), longest):
                least /= CONSTANT
        tried.append((least, model))
        if _of_fewest_states(tried, records).order <= n - _FURTHER:
            break
    return tried


def _of_fewest_states(
    tried: _Tried, records: Sequence[Record], alike: float = _ALIKE
) -> LPVStateSpace:
    """The start of the lowest order that comes about as far as any.

    What more states gain is noise, and part of a way that a longer search goes.
    """
    negligible = _NEGLIGIBLE**2 * sum(record.y.size for record in records)
    enough = alike * min(left for left, _ in tried) + negligible
    return next(model for left, model in tried if left <= enough)


def _asks_for_constants(
    model: LPVStateSpace, records: Sequence[Record], own: Own
) -> bool:
    """Whether constants of the outputs leave little of the errors without them."""
    weight, left = weights_of(records), []
    for constant in (False, True):
        each = own._replace(constant=constant)
        found = model
        with suppress(ValueError):  # it diverges
            found = refine(model, records, each, max_iter=_FIRST_STEPS).model
        left.append(squares(found, records, each, weight))
    return left[1] < CONSTANT * left[0]


def _begin_held(model: LPVStateSpace, records: Sequence[Record], own: Own) -> bool:
    """Whether records begin where their first inputs hold the model, not at rest.

    By the squared errors of both beginnings, above those of the initial states that
    fit best.
    """
    if not own.initial_state:
        return False
    weight, known = weights_of(records), own._replace(initial_state=False)
    at_rest, held = (
        squares(replace(model.silenced(), steady_start=steady), records, known, weight)
        for steady in (False, True)
    )
    least = squares(model.silenced(), records, own, weight)
    if not held - least < _NEARER * (at_rest - least):
        return False
    variance = max(least, _ROUNDING * at_rest) / sum(r.y.size for r in records)
    return not is_chance((at_rest - least) / variance, model.order * len(records))


def _through(form: Any, found: StructuredModels, dt: float) -> LPVStateSpace:
    """The LPV model through operating points, by a clone of a form."""
    delay = common_delay(found.local, found.points.kappa, dt)
    form = over_points(clone(form), found)
    return LPVStateSpace(found.structure, form, found.points.span, input_delay=delay)


def best_along(
    ways: Sequence[StructuredModels],
    form: Any,
    experiments: Sequence[Experiment],
    sampling_time: float,
) -> StructuredModels:
    """The structured models through which a form simulates experiments best.

    Of those that move, whatever their levels: what tells how states should be chosen.
    """
    if len(ways) == 1:
        return ways[0]
    records = [_record(e, sampling_time) for e in experiments]
    own, weight = Own(initial_state=True, constant=True), weights_of(records)

    def loss(found: StructuredModels) -> float:
        with collected():  # is told of what is taken
            model = _through(form, found, sampling_time)
        try:
            return squares(model, records, own, weight)
        except ValueError:  # it diverges: told of the best, if all do
            return np.inf

    return min(ways, key=loss)


def local_covariance(form: Any, found: StructuredModels) -> Array | None:
    """Of the coefficients of a form through operating points; None: not known."""
    if not isinstance(form, Interpolator):
        return None
    information = form.information(found.points.kappa, found.covariance)
    return None if information is None else covariance_of(information)


def local_output_errors(
    model: LPVStateSpace, found: StructuredModels, sampling_time: float
) -> pd.DataFrame:
    """`output_errors` of an LPV model along some local experiments of each point.

    Tells of scheduling variables whose noise the model takes for motion.
    """
    runs = [e for group in found.points.experiments for e in group[:_LOOKED_AT]]
    records = [_record(e, sampling_time) for e in runs]
    quiet, own = model.silenced(), _own_of_local(found)
    names = model.output_names or range(1, model.n_outputs + 1)

    try:
        errors = _errors(quiet, runs, records, own)
        if any(np.ptp(r.kappa, axis=0).any() for r in records):
            still = _errors(quiet, runs, [_held(record) for record in records], own)
            tell_of_noisy_scheduling(model, records, errors, still, names)
    except ValueError:  # it diverges, or has no matrices there
        errors = [np.full((1, model.n_outputs), np.nan)]
    return output_errors(names, errors)


def tell_of_missed(
    refined: Any,
    experiments: Sequence[Experiment],
    start: LPVStateSpace,
    found: StructuredModels,
    sampling_time: float,
) -> None:
    """Tell of a refined model that misses what it was refined on, but not the points.

    By the part of its errors that is no white noise, relative to how far outputs move,
    and by that of the `start` along the local experiments.
    """
    some = [e for group in found.points.experiments for e in group[:_LOOKED_AT]]
    try:
        missed = _missed(refined.lpv_, experiments, _own_of(refined), sampling_time)
        there = _missed(start, some, _own_of_local(found), sampling_time)
    except ValueError:  # it diverges: told elsewhere
        return
    bad = (missed > _MISSED) & (missed > _MORE * there)
    if bad.any():
        i = int(np.argmax(np.where(bad, missed, 0.0)))
        names = start.output_names or range(1, start.n_outputs + 1)
        warn(
            f"the refined model misses {100.0 * missed[i]:.2g} % of output "
            f"{names[i]!r} in the experiments that move, on which it was refined; of "
            f"the local ones that of the points misses {100.0 * there[i]:.2g} %. "
            "Either parts of the structure stand in each other's place, which no "
            "frozen model shows, or it lacks what moves with the scheduling variables, "
            "or these experiments have another disturbance. Check bounds and guesses "
            "(`init`), what the experiments were, and the fit of each, "
            "`refiner_.report_`; give a `restructurer` of another structure, or "
            "rate=True."
        )


def _missed(
    model: LPVStateSpace, experiments: Sequence[Experiment], own: Own, dt: float
) -> Array:
    """Errors that are no white noise, relative to how far outputs move."""
    records = [_record(e, dt) for e in experiments]
    errors = _errors(model.silenced(), experiments, records, own)
    return np.asarray(levels_of(errors).model_error * weights_of(records))


def _held(record: Record) -> Record:
    """The record with its scheduling variables held at their means."""
    kappa = record.kappa
    return record._replace(kappa=np.broadcast_to(kappa.mean(axis=0), kappa.shape))


def _own_of(refiner: Any) -> Own:
    """Unknowns of every experiment of a refiner, as `OutputErrorLPV` has them."""
    return Own(
        getattr(refiner, "initial_state", "estimate") == "estimate",
        getattr(refiner, "offset", None) == "constant",
    )


def _own_of_local(found: StructuredModels) -> Own:
    return Own(True, any(model.n_trend > 0 for model in found.local))


def _record(e: Experiment, sampling_time: float) -> Record:
    return Record(e.inputs, e.measured, e.kappa, e.sampling_time or sampling_time)


def _errors(
    model: LPVStateSpace,
    experiments: Sequence[Experiment],
    records: Sequence[Record],
    own: Own,
) -> list[Array]:
    """Simulation errors of runs, each with the unknowns of its own that fit best."""
    errors = []
    for e, record in zip(experiments, records, strict=True):
        with naming(e):
            errors.append(simulated(model, record, own)[0])
    return errors


def _report(
    labels: Sequence[Hashable],
    records: Sequence[Record],
    before: Sequence[Array],
    after: Sequence[Array],
) -> pd.DataFrame:
    """BFT by experiment, before and after: errors of all of its runs."""
    rows = {}
    for label in dict.fromkeys(labels):
        runs = [k for k, other in enumerate(labels) if other == label]
        y = np.vstack([records[k].y for k in runs])
        old, new = (np.vstack([errors[k] for k in runs]) for errors in (before, after))
        rows[label] = {
            "n_samples": len(y),
            "start_BFT": float(best_fit(y, y + old, "uniform_average")),
            "BFT": float(best_fit(y, y + new, "uniform_average")),
        }
    report = pd.DataFrame.from_dict(rows, orient="index")
    return report.rename_axis("experiment")


def _union(bounds: Any, values: Array) -> Array:
    """Smallest and largest values of a range and of rows of others."""
    stacked = np.vstack([bounds, values])
    return np.array([stacked.min(axis=0), stacked.max(axis=0)])


@contextmanager
def _progress(verbose: int) -> Iterator[Callable[[float], None]]:
    """What hears the costs, and tells them by a progress bar where wanted."""
    if not verbose:
        yield lambda cost: None
        return
    from tqdm import tqdm  # slow to import

    with tqdm(desc="refinement", unit=" steps") as bar:

        def tell(cost: float) -> None:
            bar.set_postfix(cost=f"{cost:.6g}")
            bar.update()

        yield tell
