"""The whole method: local experiments to a validated LPV model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.utils.validation import check_is_fitted

from ..data.dataset import kept_on_disk, open_dataset, tables_by_experiment
from ..data.experiments import NO_TIME, ROLES, Experiment
from ..data.forgotten_roles import DISORDER
from ..data.motion import channel_sizes
from ..data.operating_points import (
    OperatingPoints,
    check_outputs,
    local_experiments,
    moving_experiments,
    tell_of_joint_scheduling,
    without_spikes,
)
from ..data.preparation import has_gaps, split_at_gaps
from ..data.tables import as_list
from ..data.timestamps import TIME_TOL
from ..exceptions import (
    Told,
    all_or_nothing,
    collected,
    only_of,
    retold,
    take_back,
    warn,
)
from ..lpv.auto import AutoLPV
from ..lpv.equilibria import interpolated
from ..lpv.extrapolation import warn_outside_hull
from ..lpv.model import LPVStateSpace
from ..lpv.polynomial import PolynomialLPV
from ..lpv.rational import RationalLPV
from ..lpv.spline import SplineLPV
from ..metrics.reports import readable_report
from ..metrics.scorers import InitialState
from ..restructuring.estimator import GrayBoxRestructurer
from ..structures.structure import GrayBoxStructure
from ..subspace.diagnosis.faulty_outputs import LINE
from ..subspace.estimator import SubspaceLTI
from ..subspace.fits.integrating import integrating_flags
from ..subspace.telling import SPOILING
from ..systems.threads import one_blas_thread
from ..systems.whole_files import whole_file
from ..validation import (
    file_name,
    one_of,
    positive_time,
    shown,
    units_by_name,
    verbosity,
)
from .checks.stability import GROWS, growth_rates
from .one_basis.between_samples import restructured_by_hold
from .one_basis.black_boxes import foreseen_order
from .one_basis.foreseen_parameters import with_foreseen
from .one_basis.in_motion import tell_of_other_states
from .one_basis.mirror_images import mirror_images, tell_of_mirror_images
from .one_basis.structured_models import (
    StructuredModels,
    local_ones_begin_held,
    offsets_of_points,
    over_points,
    restructure_points,
    without_structure,
)
from .one_basis.together import through_black_boxes
from .points.common_choices import identify_points, of_structure
from .points.common_delay import common_delay
from .points.continuous_time import Integrates
from .points.fitting import estimates_outputs, is_left
from .points.held_scheduling import identified_as_held, tell_of_held
from .points.integrators import integrated
from .points.late_inputs import with_delays
from .points.left_out import tell_of_two_points, tell_unforeseen
from .points.local_models import LocalModel
from .points.mislabelled import tell_of_mislabelled, tell_of_wrong_values
from .refining.coefficients import known_coefficients, local_covariance, refine_model
from .refining.errors import local_output_errors, tell_of_missed
from .refining.starts import best_along, through
from .reports.html_report import html_report
from .reports.tables import Summary, Tables, summarise, tables
from .running.memory import checked_memory
from .running.runner import PointRunner
from .running.stopwatch import Stopwatch
from .running.workers import check_jobs
from .scheduled import ScheduledEstimator
from .steps import STEPS, WITHOUT, check_step

Array = NDArray[np.float64]

_DEFAULTS = {
    "local": SubspaceLTI,
    "restructurer": GrayBoxRestructurer,
    "interpolator": AutoLPV,
}


class LocalLPVPipeline(ScheduledEstimator):
    """Local LPV identification: experiments at operating points to one LPV model.

    Identifies a black-box model at every operating point, brings each into the
    gray-box structure, so that all share one state basis, and interpolates the
    parameters over the scheduling variables. A row of the table is a time instant.

    Parameters
    ----------
    local : estimator, default=None
        Step 3, a black-box model per operating point; None is ``SubspaceLTI()``. Its
        column roles are set by the pipeline. ``order="auto"`` becomes the order of the
        restructurer's structure where it has one, less where a state would but follow
        the noise, with a pole on the negative real axis; else one order for all points:
        that of most evidence, all their records together, or a lower one, with a
        warning, where points left out are foreseen by that alone. Without a structure
        outputs that integrate at all points are found, with a warning that names them;
        so are, where `local` is left at no delay, inputs that arrive late, by as many
        samples at all points.
    restructurer : GrayBoxRestructurer, "aligned", "passthrough" or None, default=None
        Step 4, which gives all local models the same states, so that their entries may
        be interpolated:

        - ``GrayBoxRestructurer(structure)``: those of your equations of motion;
          physical parameters are interpolated.
        - ``GrayBoxRestructurer()``: those of the observable canonical form.
        - "aligned": those of the neighbour, to which each model is turned by the
          rotation that brings their matrices nearest: of balanced models, or, where
          points left out are clearly better foreseen, of such whose inputs move all
          states alike, or whose outputs show them alike.
        - "passthrough": those of balanced models, signs agreed: the paper's baseline.
        - None: without a structure, the canonical form where `AutoLPV` finds its
          parameters on a polynomial of degree 2 at most, or a fraction of degrees 3
          together, which foresees points left out as well as "aligned" does; else that.
          With a `refiner`, what follows the experiments that move better.
    interpolator : regressor, default=None
        Step 5, from scheduling values (n_points, n_scheduling) to parameters
        (n_points, n_params); None is ``AutoLPV()``, which chooses by the covariances
        of the parameters. Any scikit-learn regressor with several outputs serves; one
        whose `fit` takes a `covariance` gets these (n_points, n_params, n_params). One
        operating point makes a constant, whatever the interpolator.
    refiner : OutputErrorLPV, default=None
        A fourth step, which fits the coefficients of the interpolation to experiments
        of the table along which the scheduling variables move, with what is known from
        the local ones. None: all experiments must be local.
    inputs, scheduling, experiment, time, operating_point : column name, position or \
list, default=None
        Roles of the columns of X. Inputs None: every column without another role.
        Experiment None: the table is one experiment. Scheduling None: the model is
        time-invariant. Operating point None: experiments are grouped by their mean
        scheduling value.
    scheduling_tol : float, default=None
        Distance below which experiments belong to one operating point; None chooses it
        from the data.
    sampling_time : float, default=None
        Seconds between samples. None reads it from the time column, else takes that of
        `local`. One of them must tell it where there is a structure or a scheduling
        variable, for the model is in continuous time; 1 counts time in samples.
    time_tol : float, default=0.01
        Largest deviation of a time stamp from an even grid, relative to the step. For
        more, see `resample`. Where samples are missing, ``local=SubspaceLTI(
        missing="split")`` cuts the records.
    combine : {"pool", "average"}, default="pool"
        Several experiments at one operating point enter one fit, or are identified
        one by one and their balanced models averaged (the paper's Monte Carlo).
    discretization : {"auto", "zoh", "foh", "tustin"}, default="auto"
        From discrete to continuous time; "zoh" is exact for inputs that are held
        between samples, "foh" for those that all go on linearly to the next one, as
        smooth inputs that were measured nearly do (`local` needs its feedthrough then).
        "auto" is "zoh", or "foh" where there is a structure, inputs are smooth, the
        noise does not explain how far it is from most of the local models, and explains
        what "foh" leaves, a quarter or less (or "foh" leaves a twenty-fifth);
        `lpv_.hold` tells. Models of single points are in continuous time: sample them
        likewise, by ``to_discrete(dt, "foh")``.
    offsets : {"auto", None}, default="auto"
        Experiments stand about points of work, inputs u0 and outputs y0: where the
        local models have constants (`SubspaceLTI.offset_`, `detrend`), the LPV model
        follows these, interpolated by a cubic spline through the points (see Notes),
        with the slopes that the models' gains tell where they are of one system.
        None: its outputs are zero at rest at input zero, with a warning where the
        experiments speak against it; and what outputs at rest do as scheduling
        variables move within experiments is left in these.
    efficient : bool, default=True
        Weigh by the noise: the outputs in the local models, and in step 4 the response
        by the covariance of the black box, begun at the H-infinity optimum, as
        ``GrayBoxRestructurer(norm="covariance")`` does. The parameters are then
        statistically efficient, those of gray-box maximum likelihood to first order.
        False keeps the paper's H-infinity optimum; so does a point whose covariance is
        not known, and a restructurer with another norm or a frequency weight what it
        minimises.
    units : dict of str to str, default=None
        Units of columns and parameters, by name: ``{"angle": "rad", "k": "1/s2"}``.
        They stand in `lpv_` and its frozen models, displays, reports and files.
    on_error : {"raise", "skip"}, default="raise"
        What a failure at one operating point does: raise an error that names it, or
        leave the point out with a warning.
    max_time : float, default=None
        Seconds that step 4 may take, in equal shares for the operating points: where
        one is up, the best parameters so far are kept, with a warning. None takes the
        time it needs (``restructurer__max_time`` bounds every point by itself).
    memory : str, path or joblib.Memory, default=None
        Where local and gray-box models are kept, as in scikit-learn's ``Pipeline``: a
        search over the interpolator then identifies and restructures nothing twice,
        nor do splits that share operating points. Results are known by the values of
        the arguments, and by the code of the library and of the user's functions and
        classes; a fit with steps that cannot be pickled, such as lambda, is not kept,
        with a warning. Entries are pickles, which may run code: use a folder that you
        trust.
    n_jobs : int, default=None
        Operating points worked on at the same time.
    verbose : int, default=0
        1 shows progress on the standard error: a bar, or a line for other steps that
        take more than two seconds. 0 prints nothing.

    Attributes
    ----------
    operating_points_ : ndarray of shape (n_points, n_scheduling)
    local_models_ : list of StateSpace
        Black-box models, continuous time, balanced.
    structured_models_ : list of StateSpace
        Gray-box models (without a structure, the balanced ones).
    restructurers_ : list
        The fitted restructurers, empty without one.
    parameters_ : DataFrame of shape (n_points, n_params)
        Gray-box parameters, one row per operating point: the efficient ones, where
        `efficient` applies. Of those that the record of a point does not tell, as where
        a mode vanishes, what the other points foresee, with a warning.
    hinf_parameters_ : DataFrame of shape (n_points, n_params)
        Those of the H-infinity optimum; equal to `parameters_` where that is kept.
    parameters_covariance_ : ndarray of shape (n_points, n_params, n_params)
        Their covariances, of use to the interpolator.
    parameters_std_ : DataFrame of shape (n_points, n_params)
        Their standard deviations, to first order: from the covariance of the pooled
        black box, or with ``combine="average"`` and ``efficient=False`` from the spread
        of the realizations. NaN where that is not known: a local model that does not
        minimise the simulation error (``refine=False``, a stability that had to be
        enforced), collinear inputs, or aligned black boxes.
    interpolator_ : fitted regressor
        Of `lpv_`: with a `refiner`, that with the refined coefficients.
    refiner_ : fitted refiner or None
        Its `report_` tells of the experiments that move.
    lpv_ : LPVStateSpace
        Knows the names of the scheduling variables: ``lpv_.at({"kappa": 0.5})``.
    input_delay_ : ndarray of shape (n_inputs,)
        Of `lpv_`, in samples.
    report_ : DataFrame
        One row per operating point: experiments, samples, order, BFT of the local model
        ("local_BFT"), of the gray-box model ("structured_BFT") and of `lpv_` there
        ("lpv_BFT", NaN where it is unstable) on the estimation data (percent, mean over
        the outputs, from estimated initial states), restructuring error, its structural
        floor and what remains apart from that, all relative to the black box's norm,
        the active frequency (rad/s) of what remains, stationarity; with `efficient`,
        the error of the H-infinity optimum ("relative_hinf_error"; floor, remainder and
        stationarity are its own), and "chi2", "degrees_of_freedom" and "p_value" of the
        gray-box model's distance in standard deviations of the black box; the delays of
        the inputs in samples ("delay_"), where there are any; the point of work, where
        `lpv_` has offsets ("u0_" of every input, "y0_" of every output); the distance
        from the gray-box model to the interpolated one (H-infinity norm, relative), and
        the FIT of its parameters (percent, Eq. (36) of parameters divided by their RMS
        over the points: each counts alike, as it does not in Table 3); the largest real
        part (1/s) of the poles of `lpv_` from there half-way to the neighbours
        ("growth_rate", above zero unstable); the parameters ("param_"), and their
        standard deviations ("std_") where known.
    parameter_report_ : DataFrame
        One row per parameter: lowest and highest value over the points, median
        standard deviation, RMSE and FIT (percent) of the interpolation.
    output_errors_ : DataFrame
        One row per output: standard deviations of the "model_error" and of the "noise"
        in what `lpv_` leaves of the outputs of the local experiments (four of each
        operating point), or with a `refiner` of those that move. Noise is what is white
        of it. NaN where `lpv_` diverges.
    step_times_ : dict of str to float
        Seconds that each step took.
    warnings_ : list of str
        What the fit warned of, with the remedies.
    scheduling_range_ : ndarray of shape (2, n_scheduling)
        Beyond which `predict` warns: the operating points, widened by how far the
        scheduling variables moved within an experiment.
    sampling_time_ : float
    time_jitter_ : float
        Largest deviation of a time stamp from an even grid, relative to the step.
    output_names_, scheduling_names_ : list
    n_outputs_, n_features_in_ : int
    feature_names_in_ : ndarray of str

    See Also
    --------
    SubspaceLTI, GrayBoxRestructurer, AutoLPV : The three steps.

    Notes
    -----
    Experiments at a point tell an equilibrium (u0, y0), the model's nearest to their
    means, but not the state x0 there, which matters while the scheduling variable
    moves. It is that of ``y0 = G(0) (u0 - w)``: what holds the system there comes
    through its inputs. Where the equilibria of the points follow one another by the
    models' static gains, ``dy0 = G(0) du0``, as where an output schedules the system,
    x0 moves likewise, by ``A dx0 + B du0 = 0``. Else constants that are the same
    everywhere are those of the sensors, and so is that of an output which does not
    answer at rest, ``G(0) = 0``. Outputs that measure all states, by one C everywhere,
    tell x0 themselves. `lpv_` is linear about these points, which its
    `input_offset`, `output_offset` and `state_offset` tell; `predict` begins at rest at
    that of the first sample, or, where the local experiments do so, where its first
    inputs hold the model (`lpv_.steady_start`). See :ref:`guide_points_of_work`.

    Examples
    --------
    A spring that stiffens with the scheduling variable, excited at three values of it:

    >>> import numpy as np
    >>> from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, LocalLPVPipeline
    >>> from lpvlearn import from_trajectories
    >>> spring = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0]])
    >>> u = np.sign(np.random.default_rng(0).standard_normal(400))
    >>> X, y = from_trajectories(
    ...     [(u, kappa, spring.model({"k": 4 + kappa**2, "c": 1}).simulate(
    ...         u, sampling_time=0.1)) for kappa in (0.0, 1.0, 2.0)], sampling_time=0.1)
    >>> pipeline = LocalLPVPipeline(
    ...     restructurer=GrayBoxRestructurer(spring),
    ...     scheduling="kappa", experiment="experiment", time="time").fit(X, y)
    >>> pipeline.parameters_.round(4)
                       c    k
    operating_point
    0.0              1.0  4.0
    1.0              1.0  5.0
    2.0              1.0  8.0
    >>> bool(pipeline.score(X, y) > 0.999)
    True
    """

    def __init__(
        self,
        local: Any = None,
        restructurer: Any = None,
        interpolator: Any = None,
        refiner: Any = None,
        *,
        inputs: Any = None,
        scheduling: Any = None,
        experiment: Any = None,
        time: Any = None,
        operating_point: Any = None,
        scheduling_tol: float | None = None,
        sampling_time: float | None = None,
        time_tol: float = TIME_TOL,
        combine: str = "pool",
        discretization: str = "auto",
        offsets: str | None = "auto",
        efficient: bool = True,
        units: Mapping[str, str] | None = None,
        on_error: str = "raise",
        max_time: float | None = None,
        memory: Any = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ) -> None:
        self.local = local
        self.restructurer = restructurer
        self.interpolator = interpolator
        self.refiner = refiner
        self.inputs = inputs
        self.scheduling = scheduling
        self.experiment = experiment
        self.time = time
        self.operating_point = operating_point
        self.scheduling_tol = scheduling_tol
        self.sampling_time = sampling_time
        self.time_tol = time_tol
        self.combine = combine
        self.discretization = discretization
        self.offsets = offsets
        self.efficient = efficient
        self.units = units
        self.on_error = on_error
        self.max_time = max_time
        self.memory = memory
        self.n_jobs = n_jobs
        self.verbose = verbose

    def set_params(self, **params: Any) -> LocalLPVPipeline:
        """Set parameters, also ``step__name`` of a step left None.

        That becomes `SubspaceLTI`, `GrayBoxRestructurer` (of a canonical form, where
        None chooses among what needs no structure) or `AutoLPV`.
        """
        for step, default in _DEFAULTS.items():
            nested = any(name.startswith(step + "__") for name in params)
            if nested and params.get(step, getattr(self, step)) is None:
                params[step] = default()
        return super().set_params(**params)

    # -- fitting -------------------------------------------------------------------

    @all_or_nothing
    def fit(self, X: Any, y: Any) -> LocalLPVPipeline:
        """Identify the LPV model from local experiments.

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
            If a role names no column, an experiment is not local (with a `refiner`:
            none is), or a step fails at an operating point (which the message names).

        Warns
        -----
        UserWarning
            If the delays of the inputs (``local=SubspaceLTI(input_delay=...)``) differ
            between operating points: `lpv_` has their median, the models of the points
            their own. If `lpv_` is unstable at values between the points. If there are
            two of these, with different models. If there is a `refiner`, and no
            experiment moves. The warnings of the steps name the
            point. They come when the fit ends, and stay in `warnings_`.
        """
        with retold() as told:
            self._fit(lambda: self._table(X, y))
        self.warnings_ = [warning.message for warning in told]
        return self

    @all_or_nothing
    def fit_dataset(self, dataset: Any, outputs: str | Sequence[str]) -> Self:
        """Identify the LPV model from a data set that may be larger than memory.

        Parameters
        ----------
        dataset : path or pyarrow.dataset.Dataset
            Parquet files of one table, or a folder of them, which may be partitioned
            (``run=3/part.parquet``). The rows of an experiment follow each other.
        outputs : str or list of str
            Columns of the outputs. The others are those of `X` in `fit`.

        Returns
        -------
        self
            As `fit` of the whole table leaves it. What was read lies in a file in the
            temporary folder (`TMPDIR`) meanwhile, as large as the table in memory.

        Raises
        ------
        ValueError
            As `fit`, and if the data set is empty, has not the columns, or the rows of
            an experiment do not follow each other.
        ImportError
            If pyarrow is not installed.

        Notes
        -----
        Memory is that of the largest experiment, and of 131,072 rows, times `n_jobs`.
        It is that of the largest operating point in a closed loop, where the first rows
        of a point tell too little of the others (see `SubspaceLTI.partial_fit`), with
        `integrating` or `detrend`, and for local estimators of other classes.

        Examples
        --------
        >>> from lpvlearn import LocalLPVPipeline
        >>> pipeline = LocalLPVPipeline(
        ...     restructurer="passthrough", scheduling="kappa", experiment="experiment"
        ... )
        >>> pipeline.fit_dataset("runs/", outputs="angle")  # doctest: +SKIP
        """
        opened, names = open_dataset(dataset), as_list(outputs)
        known = set(opened.schema.names)
        if not names or not all(isinstance(n, str) and n in known for n in names):
            raise ValueError(
                "`outputs` must name columns of the dataset, which has "
                f"{', '.join(map(repr, opened.schema.names))}. Got {outputs!r}."
            )
        with TemporaryDirectory(prefix="lpvlearn-") as folder, retold() as told:
            path = Path(folder) / "numbers"
            y = outputs if isinstance(outputs, str) else names
            self._fit(lambda: kept_on_disk(self._read_by_part(opened, y), path))
        self.warnings_ = [warning.message for warning in told]
        return self

    def _table(self, X: Any, y: Any, **options: Any) -> list[Experiment]:
        """The experiments of a table to be fitted."""
        cut_at_outputs = not estimates_outputs(self.local)
        experiments = self._read(X, y, reset=True, outputs=cut_at_outputs, **options)
        self.output_names_ = list(experiments[0].output_names)
        self._remember_shape(y)
        return experiments

    def _read_by_part(self, dataset: Any, outputs: Any) -> Iterator[Experiment]:
        """The experiments of a data set, which all have the step of the first."""
        step = None
        for table in tables_by_experiment(dataset, self.experiment):
            X, y = table.drop(columns=outputs), table[outputs]
            for e in self._table(X, y, fitted_step=step):
                step = e.sampling_time if step is None else step
                yield e

    @one_blas_thread
    def _fit(self, read: Callable[[], list[Experiment]]) -> None:
        self._check_options()
        steps = {"local": self.local, "restructurer": self.restructurer}
        if self.refiner is not None:  # whose result holds the interpolation
            steps |= {"interpolator": self.interpolator, "refiner": self.refiner}
        memory = checked_memory(self.memory, steps)
        runner = PointRunner(self.n_jobs, self.verbose, self.on_error, memory)
        watch = Stopwatch(verbose=self.verbose)

        # steps 1 and 2, and their groups
        with watch.step("reading of the table"), retold() as said:
            experiments = without_spikes(read())
            self.n_outputs_ = len(self.output_names_)
            check_outputs(experiments, self.output_names_)
            self.time_jitter_ = max(e.jitter for e in experiments)
            structure = getattr(self.restructurer, "structure", None)
            _check_channels(
                structure, experiments[0].input_names, self.output_names_, self.inputs
            )
            moving: list[Experiment] = []
            if self.refiner is not None:
                experiments, moving = _told_apart(experiments)
                if any(map(has_gaps, moving)):
                    moving = split_at_gaps(moving)
            points = local_experiments(experiments, self.scheduling_tol)
            self.sampling_time_ = self._sampling_time(experiments, structure)

        with watch.step("local models", bar=True), retold() as told:  # step 3
            first = experiments[0]
            local, points = self._identified(points, structure, first, runner, told)
            # of samples that are none of the system's nothing else need be said
            causes = [one for one in told if one.kind in SPOILING]
            disorder = any(one.kind == DISORDER for one in said)
            spoilt = disorder or bool(causes)
            told[:] = causes if spoilt else told

        with only_of(GROWS) if spoilt else nullcontext():
            self._interpolate(local, points, first, moving, runner, watch)
        self.step_times_ = watch.seconds

    def _interpolate(
        self,
        local: list[LocalModel],
        points: OperatingPoints,
        first: Experiment,
        moving: list[Experiment],
        runner: PointRunner,
        watch: Stopwatch,
    ) -> None:
        """Steps 4 and 5, and refinement on experiments that are `moving`."""
        with watch.step("restructuring", bar=True):  # step 4
            form = self._interpolator(len(points))
            ways = self._structured(local, points, form, runner, bool(moving))
            found = ways[0]
            if moving:  # which tells what no point does
                found = best_along(ways, form, moving, self.sampling_time_)
            self.restructurers_ = found.restructurers

        with watch.step("interpolation and report"):  # step 5: parameters over kappa
            kappa = self.operating_points_ = found.points.kappa
            self.interpolator_ = over_points(self._interpolator(len(kappa)), found)
            covariance = local_covariance(self.interpolator_, found)
            models = found  # those whose points of work are the LPV model's
            together = through_black_boxes(self.interpolator_, found)
            if together is not None:
                self.interpolator_, covariance, models = together
            self.scheduling_range_ = found.points.identified_range
            self.scheduling_names_ = list(first.scheduling_names)
            tell_of_joint_scheduling(kappa, self.scheduling_names_)
            self.lpv_ = LPVStateSpace(
                found.structure,
                self.interpolator_,
                found.points.span,
                covariance=covariance,
                scheduling_names=self.scheduling_names_ or None,
                identified_range=self.scheduling_range_,
                input_delay=common_delay(found.local, kappa, self.sampling_time_),
                input_names=first.input_names,
                output_names=self.output_names_,
                units=self.units,
                hold=found.local[0].hold,
            )
            offsets = self._fit_offsets(self.lpv_, models, not moving)
            self.lpv_ = replace(self.lpv_, offsets=offsets)
            frozen = self.lpv_.silenced().at(kappa[0])
            names = frozen.input_names, frozen.output_names, frozen.units
            self.local_models_ = [m.lti.with_names(*names) for m in found.local]
            self.structured_models_ = [m.with_names(*names) for m in found.models]
            late = self.lpv_.input_delay / self.sampling_time_
            self.input_delay_ = np.round(late).astype(int)
            self.parameters_covariance_ = found.covariance
            if not moving:
                tell_of_mirror_images(found, self.lpv_)
            if not moving and len(ways) > 1:
                self._tell_of_states(ways[1], form)

        self.refiner_ = None
        if moving:
            with watch.step("refinement", bar=True):  # on data that moves
                self._refine(moving, found, runner)
        steady = local_ones_begin_held(self.lpv_, found.points, self.sampling_time_)
        self.lpv_ = replace(self.lpv_, steady_start=steady)

        with watch.step("interpolation and report"):
            self.output_errors_ = (
                local_output_errors(self.lpv_, found, self.sampling_time_)
                if self.refiner_ is None
                else self.refiner_.output_errors_
            )
            longest = self.sampling_time_ * found.points.n_longest
            growth = growth_rates(self.lpv_, kappa, longest)
            self._tell_between(found, longest, bool(moving))
            report = tables(found, self.lpv_, self.sampling_time_, growth)
            self.parameters_ = report.parameters
            self.parameters_std_ = report.deviations
            self.report_, self.parameter_report_ = report.points, report.by_parameter
            self.hinf_parameters_ = report.parameters.copy()
            for row, fitted in enumerate(found.restructurers):
                self.hinf_parameters_.iloc[row] = getattr(
                    fitted, "hinf_params_", fitted.params_
                )

    def _structured(
        self,
        local: list[LocalModel],
        points: OperatingPoints,
        form: Any,
        runner: PointRunner,
        every: bool,
    ) -> list[StructuredModels]:
        """The models of all points in one structure, or one basis: the best first.

        And `every` one that only experiments which move tell from it.
        """
        known = local, points, runner, self.sampling_time_
        if self.restructurer is None:
            return without_structure(*known, form, every=every)
        restructure = restructure_points
        if self._hold_is_chosen_last:
            certain = self.discretization == "foh"
            restructure = partial(restructured_by_hold, certain=certain)
        limit = None if self.max_time is None else float(self.max_time)
        found = with_foreseen(restructure(self.restructurer, *known, limit))
        return mirror_images(found) if every else [found]

    def summary(self) -> str:
        """What was identified and how well, as text: ``print(pipeline.summary())``."""
        return self._summarised().text

    def to_html_report(
        self,
        path: str | PathLike[str],
        X: Any = None,
        y: Any = None,
        *,
        initial_state: InitialState = "rest",
        title: str | None = None,
        units: Mapping[str, str] | None = None,
        figures: str | PathLike[str] | None = None,
    ) -> None:
        """Write what was identified and how good it is as one HTML page.

        The page needs no other file, no network and no script: tables, pictures (SVG),
        the warnings of the fit, versions, and the code that makes the model again.

        Parameters
        ----------
        path : str or path
            Replaced, when the page is complete.
        X, y : as for `fit`, default=None
            A table to simulate: measured against simulated outputs, their fit and tests
            of the errors join the page. Best one that was not in the fit.
        initial_state : {"rest", "estimate"}, default="rest"
            Of the simulation, as in `fit_report`; "estimate" for records that start in
            mid-motion.
        title : str, default=None
        units : dict of str to str, default=None
            Units of columns and parameters, by name; None: those of the pipeline.
        figures : str or path, default=None
            A folder, made where there is none, that gets every figure as an SVG file.

        Raises
        ------
        ValueError
            If the pipeline is not fitted, X comes without y, or they do not fit it.
        OSError
            If the file cannot be written.

        Notes
        -----
        What the simulation of X warns of stands on the page and is not warned of here.
        The figures of parameters and poles need one scheduling variable, or two.
        """
        by_name = self.units if units is None else units_by_name(units)
        folder = None if figures is None else file_name(figures, "figures", "folder")
        place = file_name(path)
        with Stopwatch(verbose=self.verbose).step("figures of the report"):
            page = html_report(
                self,
                self._summarised(),
                X,
                y,
                initial_state=initial_state,
                title=title,
                units=by_name or {},
                figures=folder,
            )
        with whole_file(place) as file:
            file.write(page.encode())

    def _summarised(self) -> Summary:
        check_is_fitted(self, "lpv_")
        found = summarise(
            Tables(
                self.parameters_,
                self.parameters_std_,
                self.report_,
                self.parameter_report_,
            ),
            self.lpv_,
            sampling_time=self.sampling_time_,
            jitter=self.time_jitter_,
            scheduling=self.scheduling_names_,
            local=type(self._local()).__name__,
            restructurer=self._way(),
        )
        if self.refiner_ is None:
            return found
        known = "with" if self.lpv_.rate_terms is not None else "without"
        return found._replace(
            refinement=f"Refinement: {type(self.refiner_).__name__}, {known} rate "
            "terms; simulation fit (BFT) on experiments that move:\n"
            f"{readable_report(self.refiner_.report_).to_string()}"
        )

    # -- helpers -------------------------------------------------------------------

    def _way(self) -> str:
        """How the points came to one structure, or one basis."""
        if isinstance(self.restructurer, str):
            return self.restructurer
        if self.restructurer is None:
            known = np.isfinite(self.parameters_covariance_).any()
            return "canonical" if known else WITHOUT[0]
        return type(self.restructurer).__name__

    @property
    def _splits(self) -> bool:
        return getattr(self.local, "missing", None) in ("split", "estimate")

    def _tell_extrapolation(self, kappa: Array) -> None:
        super()._tell_extrapolation(kappa)
        if self.refiner_ is None:  # which has seen where they move between the points
            warn_outside_hull(
                kappa,
                self.operating_points_,
                self.scheduling_range_,
                self.scheduling_names_,
            )

    def _sampling_time(self, experiments: list[Experiment], structure: Any) -> float:
        steps = [e.sampling_time for e in experiments if e.sampling_time is not None]
        if steps:
            return float(np.median(steps))
        for owner in (self, self.local):
            given = getattr(owner, "sampling_time", None)
            if given is not None:
                return positive_time("sampling_time", given)
        if self.time is not None or (structure is None and self.scheduling is None):
            # Single samples, which are refused later; or a black box of one operating
            # point, whose time is in samples.
            return 1.0
        needed = "an LPV model is" if structure is None else "the structure is"
        raise ValueError(NO_TIME.format(needed))

    def _refine(
        self, moving: list[Experiment], found: StructuredModels, runner: PointRunner
    ) -> None:
        """Fit the coefficients of `lpv_` to experiments that move."""
        dt = self.sampling_time_
        known = known_coefficients(self.lpv_, found, dt)
        arguments = (self.refiner, self.lpv_, moving, dt, known)
        with retold() as told:
            refined = self.refiner_ = runner.call(refine_model, *arguments)
        if not told:
            tell_of_missed(refined, moving, self.lpv_, found, dt)
        self.lpv_, self.interpolator_ = refined.lpv_, refined.lpv_.interpolator
        self.scheduling_range_ = np.asarray(self.lpv_.identified_range)

    def _local(self) -> Any:
        """The local estimator, which knows no names of outputs, but their places."""
        local = SubspaceLTI() if self.local is None else self.local
        integrating = getattr(local, "integrating", None)
        if integrating is None or integrating is True:
            return local
        flags = integrating_flags(integrating, self.output_names_)
        places = np.flatnonzero(flags).tolist()
        return clone(local).set_params(integrating=places)

    def _needs_deviations(self) -> bool:
        """Whether covariances of parameters are asked for, or choose the states."""
        if self.restructurer is None:
            return self.interpolator is None or isinstance(self.interpolator, AutoLPV)
        return not isinstance(self.restructurer, str)

    @property
    def _hold_is_chosen_last(self) -> bool:
        """Whether inputs count as held until there are parameters of a structure."""
        begins_anywhere = isinstance(self.restructurer, GrayBoxRestructurer)
        ramps = self.discretization == "foh" and begins_anywhere
        return self.discretization == "auto" or ramps

    def _interpolator(self, n_points: int) -> Any:
        if n_points == 1:
            return PolynomialLPV(degree=0)
        return AutoLPV() if self.interpolator is None else clone(self.interpolator)

    def _identified(
        self,
        points: OperatingPoints,
        structure: GrayBoxStructure | None,
        first: Experiment,
        runner: PointRunner,
        told: list[Told],
    ) -> tuple[list[LocalModel], OperatingPoints]:
        """Local models of the points that have one, and these points.

        What was `told` of models is taken back where others are taken for them.
        """
        efficient = getattr(self.restructurer, "norm", None) == "covariance"
        identify = partial(
            identify_points,
            structure=structure,
            sampling_time=self.sampling_time_,
            combine=self.combine,
            discretization=(
                "zoh" if self._hold_is_chosen_last else self.discretization
            ),
            efficient=self.efficient or efficient,
            deviate=self._needs_deviations(),
        )
        whole, estimator = points, self._local()
        given = of_structure(estimator, structure)[0].get_params(deep=False)

        def as_held(identify: Any) -> Any:
            if self.offsets != "auto":
                return identify(estimator, whole, runner), whole, estimator
            order = given.get("order", "auto")
            return identified_as_held(estimator, whole, identify, runner, order)

        black_boxes, refused = self.restructurer in (None, "aligned"), None
        try:
            (local, kept), points, estimator = as_held(identify)
        except ValueError as error:
            if not (black_boxes and isinstance(error.__cause__, Integrates)):
                raise
            refused = error
            identify = partial(identify, n_at_zero=2 * self.n_outputs_)
            try:
                with collected():
                    (local, kept), points, estimator = as_held(identify)
            except ValueError:
                raise refused from None
        longest = self.sampling_time_ * kept.n_longest
        channels = first.input_names, self.output_names_
        wrong = tell_of_mislabelled(local, kept.kappa, longest, *channels)
        again = partial(identify, points=kept, runner=replace(runner, verbose=0))
        known = again, self.sampling_time_, told
        if not wrong:
            estimator, local = with_delays(
                estimator, local, kept, *known, first.input_names
            )
        if black_boxes and not wrong:
            estimator, local = integrated(
                estimator,
                local,
                kept,
                *known,
                self.output_names_,
                growing=refused is not None,
            )
        if refused is not None and not local[0].integrating:
            raise refused
        if black_boxes and not wrong:
            said = len(told)
            order = _foreseen_order(estimator, local, kept, longest, again)
            if order is not None:
                del told[:said]  # of the models of more states
                estimator = clone(estimator).set_params(order=order)
                local, kept = identify(estimator, points, runner)
        take_back(LINE)  # the LPV model rests where it begins
        if points is not whole:
            tell_of_held(first.scheduling_names)
        return local, kept

    def _tell_between(
        self, found: StructuredModels, longest: float, moving: bool
    ) -> None:
        """Tell of points that the others do not foresee, or are too few to."""
        kappa = found.points.kappa
        form = getattr(self.interpolator_, "best_estimator_", None)
        if form is not None:
            tell_of_two_points(self.structured_models_, kappa, longest)
        n_places = len(np.unique(kappa, axis=0))
        repeated = (len(kappa) - n_places) * found.theta.shape[1]
        dof = getattr(form, "degrees_of_freedom_", np.inf)
        saturated = not moving and dof <= repeated
        if isinstance(form, SplineLPV | RationalLPV) and self.restructurers_:
            known = found.theta, found.covariance, self.scheduling_names_
            if tell_of_wrong_values(kappa, *known):
                return
        if isinstance(form, SplineLPV) or (saturated and n_places > 2):
            tell_unforeseen(
                self.lpv_,
                self.structured_models_,
                SplineLPV() if saturated else form,
                kappa,
                found.theta,
                longest,
                saturated=saturated,
            )

    def _tell_of_states(self, aligned: StructuredModels, form: Any) -> None:
        """Tell where other states make another model in motion."""
        dt = self.sampling_time_
        with suppress(ValueError):
            with collected():  # it is not taken
                other = through(form, aligned, dt)
                offsets = self._fit_offsets(other, aligned, False)
            other = replace(other, offsets=offsets)
            tell_of_other_states(self.lpv_, other, aligned.points, dt)

    def _fit_offsets(
        self, model: LPVStateSpace, found: StructuredModels, tell: bool
    ) -> Any:
        """Interpolation of inputs, outputs and states at rest; None for none."""
        known = offsets_of_points(found) if self.offsets == "auto" else None
        if known is None:
            return None
        held = getattr(self.interpolator_, "extrapolation", None) == "clip"
        beyond = "clip" if held else "ignore"
        spline = partial(SplineLPV, "cubic", extrapolation=beyond)
        values, scales = known
        frozen = model.silenced().at
        kappa = found.points.kappa
        return interpolated(spline, kappa, values, frozen, scales, tell=tell)

    def _check_options(self) -> None:
        one_of("combine", self.combine, ("pool", "average"))
        ways = "auto", "zoh", "foh", "tustin"
        one_of("discretization", self.discretization, ways)
        one_of("on_error", self.on_error, ("raise", "skip"))
        for role in ROLES:
            given = getattr(self.local, role, None)
            if given is not None and getattr(self, role) is None:
                raise ValueError(
                    f"`{role}` must be given to LocalLPVPipeline, which reads the "
                    f"table. Got it as an option of `local` alone: {shown(given)}."
                )
        one_of("offsets", self.offsets, ("auto", None))
        one_of("efficient", self.efficient, (True, False))
        units_by_name(self.units)
        if self.refiner is not None and self.scheduling is None:
            raise ValueError(
                "`refiner` needs `scheduling`, the columns that move. Got None."
            )
        if self.max_time is not None:
            positive_time("max_time", self.max_time)
        verbosity(self.verbose)
        check_jobs(self.n_jobs)
        for name in STEPS:
            check_step(name, getattr(self, name))


def _told_apart(
    experiments: list[Experiment],
) -> tuple[list[Experiment], list[Experiment]]:
    """Local experiments, and those that a refiner takes."""
    local, moving = moving_experiments(experiments)
    if not local:
        raise ValueError(
            "`refiner` refines what local experiments tell: some must stay at an "
            f"operating point each. Got {len(moving)} that move. Of such data alone: "
            "OutputErrorLPV().fit(X, y)."
        )
    if not moving:
        warn(
            "`refiner` has nothing to do: no experiment moves between operating "
            "points. The model is that of the local experiments. Where these are "
            "sweeps to and fro, leave local models out: OutputErrorLPV().fit(X, y)."
        )
    return local, moving


def _foreseen_order(
    estimator: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    longest: float,
    identify: Callable[[Any], tuple[list[LocalModel], OperatingPoints]],
) -> int | None:
    """As `foreseen_order`; None where the estimator has no order to choose."""
    if not is_left(estimator, "order"):
        return None

    chosen, methods = {}, {model.method for model in local}
    if len(methods) == 1 and is_left(estimator, "method"):
        chosen["method"] = methods.pop()  # looked for once

    def identified(order: int) -> list[LocalModel]:
        with collected(), suppress(ValueError):
            found, kept = identify(clone(estimator).set_params(order=order, **chosen))
            return found if len(kept) == len(points) else []
        return []

    sizes = channel_sizes(points.experiments)
    return foreseen_order(local, points.kappa, *sizes, longest, identified)


def _check_channels(
    structure: Any, inputs: Sequence[Any], outputs: Sequence[Any], named: Any
) -> None:
    """Refuse columns that a structure has no inputs or outputs for, naming them."""
    if not isinstance(structure, GrayBoxStructure):
        return
    has = f"`structure` has {structure.n_outputs} outputs and {structure.n_inputs} "
    if structure.n_inputs != len(inputs):
        found = ", ".join(map(repr, inputs))
        how = (
            "as named in `inputs`"
            if named is not None
            else (
                "all without another role. Is one of them the time, the scheduling "
                "variable or the experiment? Name it by `time=`, `scheduling=` or "
                "`experiment=`"
            )
        )
        raise ValueError(
            f"{has}inputs; `X` has {len(inputs)} input column(s), {found}, {how}. They "
            "must agree: list the inputs of the structure in `inputs`."
        )
    if structure.n_outputs != len(outputs):
        found = ", ".join(map(repr, outputs))
        raise ValueError(
            f"{has}inputs; `y` has {len(outputs)} column(s), {found}. They must agree: "
            "give the outputs of the structure alone, in its order."
        )
