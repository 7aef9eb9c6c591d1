"""Refinement of an LPV model on data whose scheduling variables move."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.experiments import NO_TIME, Experiment, are_beginnings
from ..data.operating_points import check_outputs, without_spikes
from ..data.timestamps import TIME_TOL
from ..exceptions import all_or_nothing, retold
from ..lpv.bands import left_out_errors, levels_of
from ..lpv.interpolator import Interpolator
from ..lpv.model import LPVStateSpace
from ..lpv.polynomial import PolynomialLPV
from ..lpv.refinement import Own, Prior, Record, coefficients_of, refine_with_rates
from ..lpv.weighting import covariance_of
from ..metrics.scores import best_fit
from ..models.scheduling_range import grid_over
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
from .checks.error_warnings import tell_of_errors
from .checks.stability import growth_rates
from .refining.coefficients import NO_COEFFICIENTS
from .refining.errors import (
    errors_along,
    follow_ramps,
    own_of,
    record_of,
    records_begin_held,
)
from .refining.starts import Wanted, best_start
from .running.workers import check_jobs, results_of
from .scheduled import ScheduledEstimator
from .steps import check_step

Array = NDArray[np.float64]

_UNSEEN = "Where no experiment stays, nothing tells what the model does in the end."


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
        The refined model. Its inputs go on linearly between samples (``hold="foh"``)
        where those of `start` do, or without an LPV model to start from where smooth
        inputs are far likelier so. Signals that `start` gives no names have those of
        the table. Its `steady_start` is True where all experiments together begin
        nearer to where their first inputs hold it than to rest.
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
        names = list(experiments[0].output_names)
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
        with retold() as told:
            self._refine(start, experiments, dt, own)
            records = [record_of(e, dt) for e in experiments]
            known = isinstance(self.start, LPVStateSpace)  # which says what inputs do
            if not known and follow_ramps(self.lpv_, records, own):
                told.clear()
                self._refine(replace(start, hold="foh"), experiments, dt, own)
        if own.constant and start.offsets is None:
            self.lpv_ = replace(self.lpv_, offsets=self._mean_offset())
        levels = grid_over(self.lpv_.scheduling_range, 3)
        longest = dt * max(len(e.rows) for e in experiments)
        growth = growth_rates(self.lpv_, levels, longest, _UNSEEN)
        # what grows, or hardly decays, no inputs hold
        if not self.lpv_.steady_start and (growth < 0.0).all():
            begun = compress(experiments, are_beginnings(experiments))
            records = [record_of(e, dt) for e in begun]
            steady = records_begin_held(self.lpv_, records, own)
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
        own = own_of(self)
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
        records = [record_of(e, sampling_time) for e in experiments]
        prior, factor = None, 1.0 if self.prior == "local" else self.prior
        if known is not None and factor is not None:
            more = np.zeros(len(coefficients_of(start)) - len(known.centre))
            weighed = known._replace(information=factor * known.information)
            prior = weighed.widened(more)
        labels = [e.label for e in experiments]
        groups = pd.factorize(pd.Series(labels, dtype=object))[0].tolist()
        before = [*errors_along(start, experiments, records, own)]
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
        after = [*errors_along(self.lpv_, experiments, records, own)]
        self.report_ = _report(labels, records, before, after)
        tell_of_errors(self.lpv_, records, after, own, start, prior, self.max_iter)
        self.output_errors_ = output_errors(
            start.output_names or range(1, start.n_outputs + 1),
            levels_of(after, left_out_errors(found, records, own, run=run)),
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
                raise ValueError(NO_COEFFICIENTS.format("start", got))
            return model, own_of(self)
        local = self.local
        if local is None:
            local = SubspaceLTI(stability="enforce")
        return best_start(
            Wanted(self.start, local, self.interpolator),
            experiments,
            dt,
            own_of(self),
            may_be_constant=self.offset == "auto",
            n_jobs=self.n_jobs,
        )

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
            raise ValueError(NO_COEFFICIENTS.format("interpolator", got))
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
