"""Subspace identification of a linear time-invariant model: step 3 of the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from numbers import Integral
from typing import Any, Literal, Self, cast

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from sklearn.utils.validation import check_is_fitted

from ..data.alignment import align_outputs
from ..data.experiments import (
    OPTIONAL_ROLES,
    Experiment,
    as_table,
    check_inputs,
    naming,
    read_experiments,
)
from ..data.preparation import DETRENDS, has_gaps, read_runs, remove_trends
from ..data.scoring import ScoredFromRest
from ..data.tables import Table, n_rows_of
from ..data.timestamps import TIME_TOL
from ..exceptions import all_or_nothing, collected, repeat, warn
from ..models.innovation import InnovationModel
from ..models.statespace import ModelPair, StateSpace
from ..systems.threads import one_blas_thread
from ..validation import frequencies, naming_argument, one_of, shown
from .completion import completed, completed_by
from .diagnosis.cross_checks import tell_of_delay
from .diagnosis.fit_warnings import TESTS, warn_about, warn_beside_faults
from .diagnosis.horizons import warn_about_horizon
from .evidence.offsets import Offsets, of_rates
from .evidence.residuals import (
    Residuals,
    check_kind,
    input_labels,
    model_residuals,
    residual_tests,
)
from .fit import fit_samples
from .fits.delay import Delay, delays_of, with_late_inputs
from .fits.integrating import (
    ACTS,
    Direct,
    RateEvidence,
    direct_of,
    integrated,
    integrating_flags,
    is_poorer,
    options_of_rates,
    rates_of,
    sums_of,
    warn_if_useless,
    warn_of_direct,
    without_direct,
    without_direct_terms,
)
from .fits.local_fit import LocalFit
from .fits.one_fit import Samples
from .fits.options import (
    Choices,
    check_for_completion,
    check_for_rates,
    check_options,
    choices_of_each,
    choices_of_stream,
)
from .fits.simulator import Simulator
from .missing_outputs import warn_of_many_pieces
from .orders.selection import selection_text
from .streams.stream import SampleStream, fit_as_stream
from .telling import Telling

Array = NDArray[np.float64]


# Fitted attributes that follow from the samples so far.
_TAKEN = (
    "_evidence",
    "lti_",
    "input_delay_",
    "order_",
    "horizon_",
    "method_",
    "selection_",
    "n_outputs_",
    "initial_states_",
    "singular_values_",
    "residual_",
    "stability_loss_",
    "_offsets",
    "offset_",
    "input_offset_",
    "output_offset_",
    "output_drift_",
    "offsets_differ_",
    "steady_start_",
    "begun_state_",
)


class SubspaceLTI(ScoredFromRest):
    """Linear time-invariant state-space model by subspace identification.

    The observability matrix is estimated from compressed block-Hankel data by one of
    the MOESP family; B, D and the initial state of every experiment follow by least
    squares on the simulated outputs, and a few Gauss-Newton steps on the simulation
    error, weighed by the noise that is found in it, polish the result. Order and
    horizon are chosen by evidence.

    Parameters
    ----------
    order : int, "auto" or sequence of int, default="auto"
        Number of states. "auto" takes the order with the best criterion (minus
        twice the logarithm of the likelihood, and 4 for each parameter), or a lower one
        that simulates parts held out clearly better, of at most 30. Of several orders,
        as ``range(2, 7)``, the choice is among those that the samples can carry; with
        "pbsid" it is the first that has as many states as "auto" would take, or the
        highest. 0 is a pure gain.
    method : {"auto", "po-moesp", "pi-moesp", "n4sid", "cva", "pbsid"}, default="auto"
        "auto" is "po-moesp", or "pbsid" where the data come from a closed loop, with a
        warning, and where noise that moves the states of the plant is likelier than
        one that is added to its outputs (of up to 20,000 samples). "pi-moesp" uses
        past inputs only as instruments: consistent under coloured measurement noise,
        but it needs long horizons. "n4sid" and "cva" use past inputs and outputs, as
        "po-moesp", and differ in the weighting. "pbsid" minimises the error of
        prediction instead of simulation: feedback does not bias it, and the plant may
        be unstable.
    horizon : int or "auto", default="auto"
        Past and future horizon in samples; for "pbsid" the past that its first
        regression needs, by Akaike's criterion. "auto" tries a geometric grid and takes
        one whose model simulates the data as well as any. Of more than 12,000
        samples "auto" looks at that many, spread over the experiments. Where samples
        fill a horizon of two, which states need, of each output alone but not of all
        together (as 31 samples of eight channels), it is that of each output.
    sampling_time : float, default=None
        Seconds between samples, which must agree with the `time` column. None: the
        step of that column; without one the model counts time in samples, and is
        refused where continuous time is asked of it.
    feedthrough : bool or array-like of bool, default=True
        Whether an input acts on an output at once; False fixes ``D = 0``, a table of
        shape (n_outputs, n_inputs) single entries of D. A feedthrough in a closed loop
        can be told from a controller that answers within the sample only where
        signals are not Gaussian, as held references are: else method="auto" takes
        ``D = 0`` instead of True where something acts within the sample, unless parts
        held out refute it.
    input_delay : int, array-like of shape (n_inputs,) or "auto", default=0
        Samples by which the inputs, or each of them, act late: ``y[t]`` depends on
        ``u[t - input_delay]`` through D, on earlier inputs through the state. A sampled
        system without feedthrough has a delay of 0: its first answer, a sample after
        the input, is in the state. "auto" looks for delays of up to 300 samples by
        the number of inputs, 30 where that is more, and a fifth of the longest
        experiment at most, and takes those that are certain.
    refine : {"auto", "simulation", "prediction", True, False}, default="auto"
        What is minimised after the subspace step: "simulation" the simulation error,
        "prediction" that error whitened by an autoregression of itself and weighted by
        the inverse covariance of its innovations, which has the least variance
        under coloured or unequal noise. "auto" is "prediction" unless the other one, or
        none, simulates parts held out clearly better. True: as "auto". "pbsid"
        minimises the error of prediction whatever is said, but for False.
    stability : {"warn", "enforce"}, default="warn"
        "warn" keeps an unstable model, with a warning, where a stable one fits
        clearly worse; "enforce" returns a stable one and reports in
        `stability_loss_` what that cost. "pbsid" keeps what it finds, or, enforced,
        reflects poles into the unit circle and fits B and D to the simulation error.
    n_noise_states : int or "auto", default="auto"
        States of the noise model in `predictor_`. A number also raises the order of
        the subspace step by that much, which makes "po-moesp" consistent under
        coloured noise without refinement; only states that the inputs reach are
        kept in `lti_`. "pbsid" has plant and noise share their states; what only the
        noise drives is told from that, or a number of states besides `order`.
    initial_state : {"estimate", "rest"}, default="estimate"
        State in which every experiment of `fit` starts: estimated along with B and D,
        or zero, which is worth knowing of short experiments that start at rest: at
        inputs of zero, or, with constants (`offset`), at their first inputs where that
        is likelier. Where all experiments begin at a stand, as step tests do,
        "estimate" has them start at rest at their first inputs, unless likelihood
        refutes it; and where they begin with an impact or a dose, at the inputs that
        they come back to.
    detrend : {None, "constant", "linear"}, default=None
        Subtract its mean or straight line from every channel of every experiment
        beforehand. A mean is not where a system rests: what transients add to it stays
        as an error, which `offset` does not have.
    offset : {"auto", None, "constant", "linear"}, default="auto"
        Unknowns of every output and experiment, estimated with B, D and the initial
        state: a constant, as signals have that are not measured from a point of rest,
        or a constant and a drift. None: the outputs are zero at rest at input zero.
        "auto" takes constants of all experiments where the criterion of `order` is the
        better for them and they are significant, or save states, and where signals that
        stay three standard deviations or more from zero do not refute them; else (and
        with `detrend`, which has dealt with them) none. It takes drifts that stand for
        a mode which does not decay and inputs do not move, that spare such a mode
        beside slow ones, or that are beyond doubt; of a given order, where its model is
        poor or does not decay without. Where levels shift within an experiment, by a
        load or a sensor that moved, "auto" ends it there and begins another, with a
        warning, if the criterion is clearly better for that.
    missing : {"raise", "split", "estimate"}, default="raise"
        "split" ends an experiment before a sample with NaN, or a row that the `time`
        column misses, and starts another after it, with an initial state of its own.
        "estimate" does so where inputs are missing; outputs are estimated by the model
        and its noise, and the model by what is known of them, in turn (algorithm of
        expectation and maximisation): take it where many are, each for a short time,
        or one of several, or where outputs come slower than inputs. Levels that shift
        are not looked for beside them; nor, where an output is there at less than six
        of ten samples, is feedback.
    integrating : True, str, int or list of them, default=None
        Outputs with an integrator, as the position of a motor: by the columns of y or
        their positions, True for all. Their rates ``(y[k+1] - y[k]) / dt`` are
        identified in their place (`rates_`), and integrated: `lti_` has a pole at one
        for each, beside the `order` states of the model of the rates. What inputs do
        to these outputs at once (D) is found before, and taken from them. Where all
        outputs integrate it is fitted to these, by sums of the inputs: differences
        have more of the noise. Levels of these outputs are initial states; a constant
        rate, which `offset` finds, is that of an offset of the inputs.
    time_tol : float, default=0.01
        Largest deviation of a time stamp from an even grid, relative to the step. For
        more, see `resample`.
    inputs : str, int or list of them, default=None
        Input columns of X. None: all columns without another role.
    experiment : str or int, default=None
        Column that tells experiments apart. None: the table is one experiment.
    time : str or int, default=None
        Column of sample times (seconds, dates or time differences), checked for even
        steps.
    scheduling, operating_point : str, int or list of them, default=None
        Columns with these roles are read and left alone: the model is time-invariant.

    Attributes
    ----------
    lti_ : StateSpace
        Discrete-time model.
    method_ : str
        As chosen or given.
    order_, horizon_ : int
        As chosen or given; with `integrating` the order of `lti_`, which has a state
        more for each of these outputs than the model of the rates.
    singular_values_ : ndarray of shape (horizon_ * n_outputs,)
        Of the estimated observability subspace, descending.
    initial_states_ : ndarray of shape (n_experiments, order_)
        Initial state of every experiment, in the order of first appearance (a run
        between two gaps, or two shifts of level, is one); after `partial_fit` of a long
        stream, of its last stretch only. With delays and ``initial_state="estimate"``,
        that of the first sample with known inputs, number ``max(input_delay_)``. Not
        with `integrating`: `rates_` has those of the rates.
    input_delay_ : ndarray of shape (n_inputs,)
        Samples, as found or given; also that of `lti_`.
    selection_ : DataFrame
        What was tried, of every order no horizon beyond one that leaves the noise
        alone: columns order, horizon, error (relative, whitened, before refinement),
        criterion (per value, above the best; NaN for horizons that
        lost within their order), validation_bft (percent, on parts held out; NaN
        where that was not looked at), chosen. Of "pbsid" orders are those of plant and
        noise together, error that of the regression on their states, and further ones
        are chosen where refinement shows that they are worth it.
    rates_ : SubspaceLTI
        With `integrating`, fitted to the rates of these outputs: `selection_`,
        `residual_`, `predictor_`, `poles_std_` and methods that need the noise are its
        own.
    residual_ : float
        Simulation error on the data relative to the outputs, root mean square; of
        "pbsid" the error of one-step prediction.
    stability_loss_ : float
        Increase of `residual_` that enforced stability cost; 0 where it cost nothing.
    predictor_ : InnovationModel
        `lti_` with a noise model, Kalman gain and innovation covariance. That of
        "pbsid" predicts unstable plants, too. Sinusoids that no input moves are
        further states of its `lti`.
    poles_std_ : ndarray of complex, shape (order_,)
        Standard deviations of the real and imaginary parts of ``lti_.poles()``. Not
        there with ``refine=False``, of which none are known.
    offset_ : {None, "constant", "linear"}
        What was estimated.
    input_offset_ : ndarray of shape (n_experiments, n_inputs)
        Mean of the inputs of every experiment, as of `initial_states_`. Of a plant
        whose slowest mode takes a tenth of the longest experiment, or does not decay:
        where the experiment begins nearest to rest. What they begin with, where the
        experiments begin at a stand (what they come back to, where that is with an
        impact). Zero without `offset_` and `detrend`, and with
        ``initial_state="rest"``.
    output_offset_ : ndarray of shape (n_experiments, n_outputs)
        Where the outputs rest at these inputs: but for transients and drifts
        ``y - output_offset_ = G (u - input_offset_)``. With `detrend` their means, to
        which `offset` adds. After `partial_fit` of a long stream there is one row, the
        mean of all.
    offsets_differ_ : bool
        Whether the constants of the experiments do, by more than their uncertainty.
    steady_start_ : bool
        Whether the experiments begin where their first inputs hold the model, as step
        tests do, and not at rest at `input_offset_`: told by those whose inputs stand
        still at first and move later, half of all at least. `predict` begins likewise
        where they do. False of batches.
    begun_state_ : ndarray of shape (order,) or None
        None, as nearly always: experiments begin near rest, and so does `predict`.
        Else the mean of the states in which they begin, for a mode that does not decay
        over them and is farther from rest than the outputs range, as of a tank that no
        experiment empties: `predict` begins there. With `integrating`, wherever that
        is, as such outputs rest anywhere. None of batches.
    output_drift_ : ndarray of shape (n_experiments, n_outputs)
        Change per second (per sample where no time is known), about the middle of
        the experiment; zero unless `offset_` is "linear", and where an offset of the
        inputs makes it.
    time_jitter_ : float
        Largest deviation of a time stamp of `fit` from an even grid, relative to the
        step; 0 without a `time` column.
    n_outputs_ : int
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Notes
    -----
    `predict` simulates from rest; `predict_with_initial_state` estimates the
    initial state from outputs first, as a split in the middle of an experiment
    needs. Models of different fits do not share a state basis.

    Signals about a point (u0, y0) are ``y = G u + c`` with ``c = y0 - G(1) u0``, but
    for a transient that the initial state takes. So one unknown for each output stands
    for all offsets. Of a system that integrates, an offset of the input makes a
    straight line, ``offset="linear"``, which "auto" takes where it saves a state; it is
    an `input_offset_`, as far as steps of the inputs explain it. `predict` begins at
    rest at the mean of `input_offset_`, the outputs at that of `output_offset_` (of
    drifts it knows nothing); where the constants of the experiments differ by more than
    their uncertainty it warns, as inputs alone cannot tell which one it will be. What
    is given outputs estimates constant (and drift) of every experiment anew:
    `predict_with_initial_state`, `residual_tests` and, from estimated initial states,
    `predict_ahead`. The first and the last do so too where "auto" took none and an
    experiment stands elsewhere.

    Without refinement, "po-moesp" with as many noise states as the noise has and
    "pi-moesp" at the order of the system are consistent under coloured noise, others
    under white noise only. Refined on the simulation error every method is, and
    refined on the prediction error it has the least variance that the noise allows
    (the bound of Cramer and Rao).

    Experiments whose noise differs by a factor of two or more count by their own, as a
    linear system allows (both signals of each are divided by it), unless that is
    refuted, as where errors grow with the motion of a system that is not linear.

    Of a table of more than 131,072 samples the first ones choose order and horizon;
    the others are added in one pass, as `partial_fit` does, which refines on the
    simulation error.

    With delays, what arrives in the first samples of an experiment was sent before it
    began. These samples are left out of the fit, unless ``initial_state="rest"`` takes
    those inputs as zero, which is what `predict` does. `predict_with_initial_state`
    estimates them beside the state. ``input_delay="auto"`` compares models of several
    orders and delays, with feedthrough and without, by Schwarz's criterion, with the
    noise whitened; a delay is none where a model without it does as well with a state
    more, or on samples held out. Where the first answers of a system are fainter than
    the noise, its delay may come out a sample off.

    Data are taken for those of a closed loop where future inputs tell of the errors
    of a long regression of the outputs on the past, with a p-value below 1e-4, and
    nonlinear terms of the past do not tell more; and of one whose controller answers
    within the sample where errors of a straight line from what inputs do to what
    outputs do within it depend on nonlinear functions of the inputs, with a p-value
    below 1e-8, and the other way round they do not. What minimises the simulation error
    has then a bias that no number of samples removes. A loop through which nothing but
    Gaussian white noise of the sensors goes does not show; it does no harm with
    ``feedthrough=False``. Channels that are not sampled at once look like a loop. So
    "auto" compares the plant of "pbsid" with other models on parts held out (growing
    modes are simulated backward), unless inputs follow from the past, as a few sines
    do. Another one is taken in its place, and that is said:

    - a plant with D free, or the model of "po-moesp", that leaves less than half of the
      squared errors there, or is stable where the plant is unstable only within its
      uncertainty. Not that of "po-moesp" where it explains less than a best fit of
      50 % and predicts worse: noise then moves the loop more than its reference does.
    - "po-moesp" with D free that leaves less than a tenth, where outputs seem to know
      later inputs, as filtered ones do; or less than a quarter, where nothing but
      answers within the sample shows a loop, as noise of measured inputs makes them.

    `fit` keeps its samples for the attributes and methods that are statistics of the
    simulation error, which are computed when first asked for.

    References
    ----------
    M. Verhaegen, "Identification of the deterministic part of MIMO state space
    models given in innovations form from input-output data", Automatica 30, 1994.

    M. Verhaegen and V. Verdult, *Filtering and System Identification*, Cambridge
    University Press, 2007.

    A. Chiuso, "The role of vector autoregressive modeling in predictor-based subspace
    identification", Automatica 43, 2007.

    S. Shimizu, P. O. Hoyer, A. Hyvarinen and A. Kerminen, "A linear non-Gaussian
    acyclic model for causal discovery", Journal of Machine Learning Research 7, 2006.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import SubspaceLTI
    >>> rng = np.random.default_rng(0)
    >>> u = rng.standard_normal((500, 1))
    >>> y = np.zeros(500)
    >>> for k in range(499):
    ...     y[k + 1] = 0.9 * y[k] + 0.2 * u[k, 0]
    >>> model = SubspaceLTI().fit(u, y + 0.01 * rng.standard_normal(500))
    >>> model.order_
    1
    >>> model.lti_.poles().round(2)
    array([0.9+0.j])
    """

    def __init__(
        self,
        order: int | str | Sequence[int] = "auto",
        *,
        method: str = "auto",
        horizon: int | str = "auto",
        sampling_time: float | None = None,
        feedthrough: Any = True,
        input_delay: Any = 0,
        refine: str | bool = "auto",
        stability: str = "warn",
        n_noise_states: int | str = "auto",
        initial_state: str = "estimate",
        detrend: str | None = None,
        offset: str | None = "auto",
        missing: str = "raise",
        integrating: Any = None,
        time_tol: float = TIME_TOL,
        inputs: Any = None,
        experiment: Any = None,
        time: Any = None,
        scheduling: Any = None,
        operating_point: Any = None,
    ) -> None:
        self.order = order
        self.method = method
        self.horizon = horizon
        self.sampling_time = sampling_time
        self.feedthrough = feedthrough
        self.input_delay = input_delay
        self.refine = refine
        self.stability = stability
        self.n_noise_states = n_noise_states
        self.initial_state = initial_state
        self.detrend = detrend
        self.offset = offset
        self.missing = missing
        self.integrating = integrating
        self.time_tol = time_tol
        self.inputs = inputs
        self.experiment = experiment
        self.time = time
        self.scheduling = scheduling
        self.operating_point = operating_point

    @all_or_nothing
    def fit(self, X: Any, y: Any) -> Self:
        """Identify the model.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            Inputs, and columns with other roles; a row is a time instant.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Outputs.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If an option is unknown, an input is constant, or the samples are too few
            for the order or horizon.

        Warns
        -----
        RankWarning
            If inputs are collinear or do not excite the system sufficiently.
        UserWarning
            If the model is unstable or explains next to nothing of the outputs, if
            the data come from a closed loop, and if more than 3 % of the errors depend
            on past inputs (beyond chance, and .3 % of the outputs): the model lacks
            states, a delay or a nonlinearity. If squares and cubes of the inputs, or of
            what these do, explain errors of more than 3 % of an output (in open loop,
            beyond chance), or measured ones most of what is new in a sample of an
            unexplained output: the system is not linear over the range of the record.
        """
        self._forget()
        if self.integrating is not None:
            return self._fit_rates(X, y)
        return self._fit_table(X, y)

    def _forget(self) -> None:
        """Leave what an earlier fit or stream told."""
        self._stream: SampleStream | None = None
        for name in (*_TAKEN, "_stale", "rates_"):
            self.__dict__.pop(name, None)

    def _fit_table(
        self, X: Any, y: Any, *, names: tuple[Any, Any] | None = None
    ) -> Self:
        """As `fit`, or of rates, most of which may be noise that was differenced.

        These have the `names` of the inputs and of the outputs whose rates they are.
        """
        choices = check_options(self.get_params(deep=False))
        choices = choices._replace(differences=names is not None)
        experiments = self._read(X, y, reset=True, cut=False)
        self._remember_shape(y)
        telling = Telling(*(names or _labels_of(X, experiments, y)))
        if names:
            telling = telling.aside("noisy output", "useless", "dropouts")
        self._fit_whole(experiments, choices, telling, _names_of(experiments, y))
        return self

    @all_or_nothing
    def fit_experiments(self, experiments: Sequence[Experiment]) -> Self:
        """As `fit`, of experiments that have been read.

        Parameters
        ----------
        experiments : sequence of lpvlearn.data.experiments.Experiment
            Which say what the columns of a table are: roles are not looked at. None of
            their signals is copied as a whole where `fit` takes a table for a stream:
            they may lie in a file (`numpy.memmap`).

        Returns
        -------
        self

        Raises
        ------
        ValueError
            As `fit`, and with `integrating`, which needs a table.
        """
        self._forget()
        if self.integrating is not None:
            raise ValueError(
                "`integrating` must be None in fit_experiments. Got "
                f"{shown(self.integrating)}. Use `fit`."
            )
        choices = check_options(self.get_params(deep=False))
        names = _names_read(experiments)
        self._single_output = False
        self._fit_whole([*experiments], choices, Telling(*names), names)
        return self

    def _fit_whole(
        self,
        experiments: list[Experiment],
        choices: Choices,
        telling: Telling,
        names: tuple[Any, Any],
    ) -> None:
        """Identify the model of experiments in which samples may be missing."""
        if self.missing == "estimate" and any(map(has_gaps, experiments)):
            check_for_completion(self.detrend)
            experiments, choices = completed(
                experiments, choices, telling, self._delay_of, self._learn
            )
        elif self.missing == "split":
            warn_of_many_pieces(experiments)
        delay = self._delay_of(experiments, choices)
        self._identify(experiments, choices, delay, telling)
        self._name(*names)

    def _learn(
        self,
        experiments: list[Experiment],
        choices: Choices,
        delay: Delay,
        known: LocalFit | None,
    ) -> tuple[LocalFit, Simulator]:
        """The model of samples some of which are estimates: nothing is told of it."""
        with collected():
            silence = Telling(silent=True)
            fitted = self._identify(experiments, choices, delay, silence, known)
        return fitted, self._simulator()

    def fit_each(self, X: Any, y: Any) -> list[Self]:
        """Fit one model to every experiment, as the first one chooses.

        For many experiments of one kind, such as realizations of the noise (a Monte
        Carlo): what `fit` chooses (order, horizon, method, delay, whether there are
        constants) it chooses for the first, whose data it tests for feedback and lack
        of states, too. The others follow, in a fraction of the time.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            As in `fit`.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)

        Returns
        -------
        list of SubspaceLTI
            Fitted clones, in the order of the experiments.

        Raises
        ------
        ValueError
            As `fit`, and if `integrating` is set.

        Warns
        -----
        RankWarning, UserWarning
            As `fit`, each kind once.

        Examples
        --------
        >>> import numpy as np
        >>> from lpvlearn import StateSpace, SubspaceLTI, from_trajectories
        >>> rng, true = np.random.default_rng(0), StateSpace(0.9, 1, 1, None, True)
        >>> u = rng.standard_normal(500)
        >>> y = true.simulate(u).ravel()
        >>> X, y = from_trajectories(
        ...     [(u, 0.0, y + 0.3 * rng.standard_normal(500)) for _ in range(20)])
        >>> roles = {"experiment": "experiment", "scheduling": "kappa"}
        >>> models = SubspaceLTI(1, **roles).fit_each(X, y)
        >>> poles = [model.lti_.poles()[0].real for model in models]
        >>> print(f"{np.mean(poles):.3f}, {np.std(poles):.4f}")
        0.899, 0.0009
        """
        choices = choices_of_each(self.get_params(deep=False))
        first = clone(self)
        experiments = first._read(X, y, reset=True, cut=False)
        first._remember_shape(y)
        telling = Telling(*_labels_of(X, experiments, y))
        names = _names_of(experiments, y)
        return first._fit_apart(experiments, choices, telling, names)

    def fit_each_experiment(self, experiments: Sequence[Experiment]) -> list[Self]:
        """As `fit_each`, of experiments that have been read, as `fit_experiments`.

        Parameters
        ----------
        experiments : sequence of lpvlearn.data.experiments.Experiment

        Returns
        -------
        list of SubspaceLTI
            Fitted clones, in the order of the experiments.

        Raises
        ------
        ValueError
            As `fit_each`.
        """
        choices = choices_of_each(self.get_params(deep=False))
        first, names = clone(self), _names_read(experiments)
        first._single_output = False
        return first._fit_apart([*experiments], choices, Telling(*names), names)

    def _fit_apart(
        self,
        experiments: list[Experiment],
        choices: Choices,
        telling: Telling,
        names: tuple[Any, Any],
    ) -> list[Self]:
        """This one, fitted to the first experiment, and copies for the others."""
        others = [copy(self) for _ in experiments[1:]]
        delay = self._delay_of(experiments[:1], choices)
        known = self._identify(experiments[:1], choices, delay, telling)
        telling.kinds |= TESTS  # once is enough
        for other, experiment in zip(others, experiments[1:], strict=True):
            other._identify([experiment], choices, delay, telling, known)
        for model in (self, *others):
            model._name(*names)
        return [self, *others]

    @one_blas_thread
    def _identify(
        self,
        experiments: list[Experiment],
        choices: Choices,
        delay: Delay,
        telling: Telling,
        known: LocalFit | None = None,
    ) -> LocalFit:
        """Identify the model of experiments, by what is `known` of others like them."""
        self.time_jitter_ = max(e.jitter for e in experiments)
        gaps = self.missing != "raise"
        experiments = self._with_late_inputs(experiments, delay, gaps)
        pairs = [(e.inputs, e.measured) for e in experiments]
        estimated = [e.estimated for e in experiments if e.estimated is not None]
        if estimated and np.vstack(estimated).all(axis=0).any():
            raise ValueError(
                "missing='estimate' needs some samples of every output after inputs "
                f"have come with their delay ({delay.max()} samples). Got none: take "
                "a longer record."
            )
        choices = choices._replace(estimated=estimated)
        gaps |= bool(delay.any()) and choices.initial_states
        if known is not None:
            choices = known.chosen(choices)
        samples = Samples(pairs, choices, telling)
        fitted = fit_as_stream(samples, detrend=self.detrend, gaps=gaps)
        if fitted is None:
            fitted, samples = fit_samples(samples, detrend=self.detrend, like=known)
        else:
            samples = samples._replace(pairs=remove_trends(pairs, self.detrend)[0])
        self._take(fitted, self._step_of(experiments), delay)
        asked = choices.initial_states or bool(fitted.offsets.inputs.any())
        self.steady_start_ = asked and self._simulator().begins_held_in(experiments)
        self._take_beginning(experiments)
        if telling.silent:
            return fitted
        if telling.spoilt:
            warn_beside_faults(fitted, telling)
            return fitted
        warn_about(fitted, telling)
        if known is None and None not in (choices.order, choices.horizon):
            warn_about_horizon(fitted, choices)
        if known is None and not isinstance(self.input_delay, str) and not delay.any():
            tell_of_delay(samples, fitted)
        return fitted

    def _fit_rates(self, X: Any, y: Any) -> Self:
        """Identify the rates of integrating outputs, and integrate their model."""
        check_for_rates(self.get_params(deep=False))
        experiments = self._read(X, y, reset=True)
        self.time_jitter_ = max(e.jitter for e in experiments)
        self._remember_shape(y)
        flags = integrating_flags(self.integrating, experiments[0].output_names)
        step = self._step_of(experiments)
        names = _labels_of(X, experiments, y), _names_of(experiments, y)
        known = experiments, flags, step, *names
        none = Direct(np.zeros((len(flags), experiments[0].inputs.shape[1])))
        found = none
        if isinstance(self.input_delay, str) or not np.any(self.input_delay):
            found = direct_of(experiments, flags, self.feedthrough) or none
        if found.sure:
            self._integrate(*known, found)
            return self
        other = copy(self)
        with collected() as told:
            self._integrate(*known, none)
        with collected() as of_other:
            other._integrate(*known, found)

        def error(model: Self) -> float:
            found = np.asarray(model.predict_with_initial_state(X, y))
            found = found.reshape(len(found), -1)
            left = [e.measured - found[e.rows] for e in experiments]
            return float(np.sum(np.square(np.vstack(left))))

        acts = error(other) < ACTS * error(self)
        if acts:
            self.__dict__.update(other.__dict__)
        if acts or flags.all():  # of others a controller is told of
            warn_of_direct(acts)
        repeat(of_other if acts else told)
        return self

    def _integrate(
        self,
        experiments: list[Experiment],
        flags: NDArray[np.bool_],
        step: float | Literal[True],
        labels: tuple[Any, Any],
        names: tuple[Any, Any],
        known: Direct,
    ) -> None:
        """Identify the rates, and integrate them; what acts at once is `known`."""
        given, experiments = experiments, without_direct_terms(experiments, known.D)
        moved = rates_of(experiments, flags, float(step))
        table, rates = as_table(moved)
        direct = self.feedthrough
        if direct is True and self.method == "auto" and not flags.all():
            direct = not without_direct(experiments, moved)
        options = options_of_rates(table, flags, direct, step)
        if known.D.any():  # what acts at once is not late
            options["input_delay"] = 0
        rate_model = clone(self).set_params(**options)
        self.rates_ = inner = rate_model._fit_table(table, rates, names=labels)
        best = inner
        if flags.all() and inner.method_ != "pbsid":
            best = self._of_sums(experiments, inner)
        warn_if_useless(best.residual_, of_rates=best is inner)
        self.lti_: StateSpace = integrated(best.lti_, flags, known.D)
        self._name(*names)
        around = [model for pair in best.deviated_models() for model in pair]
        self._evidence: Any = RateEvidence(around, flags, self.lti_.n_inputs, known.std)
        self.input_delay_, self.order_ = self.lti_.input_delay, self.lti_.order
        self.horizon_, self.method_ = inner.horizon_, inner.method_
        self.selection_, self.residual_ = inner.selection_, inner.residual_
        self.singular_values_ = inner.singular_values_
        self.stability_loss_, self.n_outputs_ = inner.stability_loss_, len(flags)
        self.offset_ = inner.offset_
        offsets = of_rates(inner._offsets, inner.lti_.dc_gain(), flags)
        self._take_offsets(offsets, step)
        self._take_beginning(given)

    def _of_sums(self, experiments: Sequence[Experiment], rates: Self) -> Self:
        """The model of the rates from the outputs themselves, by sums of the inputs.

        Their differences have noise that no autoregression describes: the estimates
        would be poorer, and their deviations too large. If the model simulates the
        outputs worse for all that, `rates` is returned.
        """
        step = float(rates.lti_.sampling_time or 1.0)
        table, y = as_table(sums_of(experiments, step))
        sums = clone(rates).set_params(
            order=rates.order_,
            offset="linear" if rates.offset_ else "constant",
            method=rates.method_,
        )
        try:
            with collected():  # said of the rates
                sums.fit(table, y)
        except ValueError:  # too few samples for a constant
            return rates
        return rates if is_poorer(sums._evidence, sums.lti_, rates.lti_) else sums

    def partial_fit(self, X: Any, y: Any) -> Self:
        """Go on with the next batch of a stream, in memory independent of its length.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            As in `fit`. Without an `experiment` column all batches are one
            experiment. With one, a batch whose first label is the last one of
            the batch before continues that experiment; every other label starts one.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)

        Returns
        -------
        self
            Without a model (`lti_`) as long as the samples are too few for one. After
            `fit` a new stream begins.

        Raises
        ------
        ValueError
            If an option is unknown or not the one that the stream began with, the
            method is "pbsid", or `detrend` is set: a trend needs the whole experiment.
            If the `time` column repeats or leaves out samples between two batches of
            an experiment, or its step changes. If a batch has other columns than the
            first one.
            Everything is then as before the batch, and the right one may follow.

        Warns
        -----
        UserWarning, RankWarning
            As `fit`, once per stream. If the first 131,072 samples are too few for a
            model, such as with a constant input, and if the simulation error grows
            far above that of the first samples.

        Notes
        -----
        The model is the one that `fit` finds from all batches as one table, however
        they are cut. It is made as soon as there are samples enough, then when somebody
        asks for it (``model.lti_``), and may warn, or fail, then: batches may be small.
        The first 131,072 samples are kept (the last ones where the first do not make a
        model). Then order and horizon stay, and only summaries grow: the compressed
        Hankel data, and
        the simulation error linearised around the model of the moment, each sample
        once. Of a longer table `fit` makes the same summaries in the same order. It
        alone can go back to the samples, and does so where the linearisation turns out
        to be poor: the first 131,072 samples hardly excite what comes later, outputs
        drift, or (``refine=False``) the order is higher than the data support.

        ``offset="auto"`` decides from the samples that are kept. From then on every
        16,384 samples have constants (and drifts) of their own, so that a level that
        wanders slowly does no harm.

        Examples
        --------
        >>> import numpy as np
        >>> from lpvlearn import SubspaceLTI
        >>> rng = np.random.default_rng(0)
        >>> model, last = SubspaceLTI(1, horizon=5), 0.0
        >>> for _ in range(3):
        ...     u, y = rng.standard_normal((200, 1)), np.empty(200)
        ...     for k in range(200):
        ...         y[k] = last
        ...         last = 0.9 * y[k] + u[k, 0]
        ...     model = model.partial_fit(u, y)
        >>> model.lti_.poles().round(6)
        array([0.9+0.j])
        """
        own = self.__dict__
        stream = own.get("_stream")
        if stream is None or not stream.takes(X, y, own):
            return self._read_batch(X, y, stream)
        if "lti_" in own:
            self._forget_for_now()
        return self

    @all_or_nothing
    def _read_batch(self, X: Any, y: Any, before: SampleStream | None) -> Self:
        """As `partial_fit`, of a batch in which something may be to be told."""
        if before is not None:
            before.check_options(self.__dict__)
        options = self.get_params(deep=False)
        choices: Any = choices_of_stream(options) if before is None else None
        if y is None:
            raise ValueError(
                "SubspaceLTI requires y to be passed, but the target y is None: `y` "
                "must hold the outputs of every batch."
            )
        experiments = read_experiments(
            self,
            X,
            y,
            sampling_time=self.sampling_time,
            reset=before is None,
            allow_missing="Xy" if self.missing == "split" else "",
        )
        jitter = 0.0 if before is None else self.time_jitter_
        self.time_jitter_ = max(jitter, *(e.jitter for e in experiments))
        if before is None:
            self._forget()
            stream = SampleStream(
                choices,
                options,
                experiments,
                self._step_of(experiments),
                _names_of(experiments, y),
                Telling(*_labels_of(X, experiments, y)),
            )
            self._remember_shape(y)
        else:
            stream = before.branch()
        fitted = stream.add(experiments, Table(X).one(self.time, "time"))
        if fitted is not None:
            self._take_up(fitted, stream)
        self._stream = stream
        if stream.waits and "lti_" in self.__dict__:
            self._forget_for_now()
        return self

    def _forget_for_now(self) -> None:
        """Have what the stream does not tell yet wait for someone to ask for it."""
        known = [name for name in _TAKEN if name in self.__dict__]
        stale = {name: self.__dict__.pop(name) for name in known}
        self._stale = self.__dict__.get("_stale", {}) | stale  # see __getattr__

    def __copy__(self) -> Self:
        """As of any object, but for the stream, to which batches are added in place."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        if other.__dict__.get("_stream") is not None:
            other._stream = cast(SampleStream, self._stream).branch()
        return other

    @all_or_nothing
    def fit_batches(self, batches: Iterable[tuple[Any, Any]]) -> Self:
        """Fit a stream of batches from its beginning, of which one is held at a time.

        Parameters
        ----------
        batches : iterable of (X, y)
            Tables as in `partial_fit`: of a generator, say, or of a database.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            As `partial_fit`, and if the batches are none, are no pairs, or are too few
            samples for a model.

        Examples
        --------
        >>> import numpy as np
        >>> from lpvlearn import StateSpace, SubspaceLTI
        >>> def batches(n):
        ...     rng, truth = np.random.default_rng(0), StateSpace(0.9, 1, 1, 0, 1.0)
        ...     for _ in range(n):
        ...         u = rng.standard_normal((200, 1))
        ...         yield u, truth.simulate(u)
        >>> SubspaceLTI(1, horizon=5).fit_batches(batches(1)).lti_.poles().round(6)
        array([0.9+0.j])
        """
        self._forget()
        with naming_argument("batches", "be an iterable of pairs (X, y)", batches):
            numbered = enumerate(batches)
        for number, batch in numbered:
            if not isinstance(batch, tuple | list) or len(batch) != 2:
                raise ValueError(
                    "`batches` must be an iterable of pairs (X, y). Got "
                    f"{type(batch).__name__} as number {number}."
                )
            self.partial_fit(*batch)
        if not hasattr(self, "lti_"):
            raise ValueError(
                "`batches` must hold enough samples for a model. Got "
                f"{0 if self._stream is None else self._stream.n_samples}."
            )
        return self

    def __getattr__(self, name: str) -> Any:
        """What a stream has not told yet, where small batches wait for it."""
        if name in _TAKEN and "_stale" in self.__dict__:
            stream = cast(SampleStream, self._stream).branch()
            stale = self.__dict__.pop("_stale")
            try:
                fitted = stream.fit()
            except BaseException:
                self._stale = stale
                raise
            self._stream = stream
            if fitted is None:  # too few samples still
                self.__dict__.update(stale)
            else:
                self._take_up(fitted, stream)
        return self.__getattribute__(name)

    def _take_up(self, fitted: LocalFit, stream: SampleStream) -> None:
        self._take(fitted, stream.step, stream.delay)
        self._name(*stream.names)

    @one_blas_thread
    def _delay_of(self, experiments: list[Experiment], choices: Choices) -> Delay:
        """Delays in samples, given or found."""
        gaps = self.missing == "split"
        return delays_of(
            experiments, self.input_delay, choices, detrend=self.detrend, gaps=gaps
        )

    def _with_late_inputs(
        self, experiments: list[Experiment], delay: Delay, gaps: bool
    ) -> list[Experiment]:
        rest, at_mean = self.initial_state == "rest", self.detrend is not None
        return with_late_inputs(
            experiments, delay, rest=rest, gaps=gaps, at_mean=at_mean
        )

    def _take(self, fitted: LocalFit, step: float, delay: Delay) -> None:
        """Set the fitted attributes."""
        self.__dict__.pop("_stale", None)
        self._evidence = fitted.evidence.beside(input_delay=delay)
        self.lti_ = self._evidence.state_space(fitted.model, step)
        self.input_delay_ = self.lti_.input_delay
        self.order_ = fitted.selection.order
        self.horizon_ = fitted.selection.horizon
        self.method_ = fitted.method
        self.selection_ = fitted.selection.table
        self.n_outputs_ = len(fitted.evidence.output_scale)
        self.initial_states_ = fitted.model.initial_states
        self.singular_values_ = fitted.singular_values
        self.residual_ = fitted.residual
        self.stability_loss_ = fitted.stability_loss
        self.offset_ = DETRENDS[fitted.evidence.free.n_trend]
        self._take_offsets(fitted.offsets, step)

    def _take_offsets(self, offsets: Offsets, step: float) -> None:
        self._offsets, self.offsets_differ_ = offsets, offsets.differ
        self.input_offset_, self.output_offset_ = offsets.inputs, offsets.outputs
        self.output_drift_ = offsets.drifts / step
        # But for experiments that are all there
        self.steady_start_ = False
        self.begun_state_: Array | None = None

    def _take_beginning(self, experiments: Sequence[Experiment]) -> None:
        """Where experiments begin, if that is far from rest."""
        here = self._simulator()._replace(lti=self.lti_.with_input_delay(0))
        self.begun_state_ = here.begun_state(experiments)

    def _name(self, inputs: Any, outputs: Any) -> None:
        """Let the model know the names of the columns, where they have some."""
        self.lti_ = self.lti_.with_names(inputs, outputs)

    @property
    def _output_names(self) -> Any:
        """Names of the outputs of the fit or stream; None where they had none.

        A stream is not asked for the model that it has not made yet.
        """
        stream = self.__dict__.get("_stream")
        return self.lti_.output_names if stream is None else stream.names[1]

    def _step_of(self, experiments: Sequence[Experiment]) -> float:
        """Seconds between the samples of a table; True where nothing tells them."""
        for e in experiments:
            if e.sampling_time:
                return e.sampling_time
        return True if self.sampling_time is None else float(self.sampling_time)

    def predict(self, X: Any) -> Array:
        """Simulate the outputs of every experiment from rest, inputs before it zero.

        With offsets these are about `input_offset_`. Where the experiments of `fit`
        stood still at first (`steady_start_`) so do those whose first inputs do: at
        rest at these.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
            A table after ``set_output(transform="pandas")``.

        Raises
        ------
        DivergenceError
            If the outputs of an unstable model overflow.

        Warns
        -----
        UserWarning
            If the constants of the experiments of `fit` differ: the outputs are about
            their mean. If inputs move about another level than `input_offset_`, the
            mean of those of `fit`, at which the simulation begins.
        """
        check_is_fitted(self, "lti_")
        if self.offsets_differ_:
            warn(
                "The experiments of `fit` have different constants in their outputs "
                "(`output_offset_`): predictions are about their mean. Where outputs "
                "are known, predict_with_initial_state(X, y) and "
                "initial_state='estimate' of scores estimate those of every experiment."
            )
        experiments, simulator = self._read(X, None), self._simulator()
        away = next((e for e in experiments if simulator.begins_away_from(e)), None)
        if away is not None:
            u0 = simulator.resting_point()[0]
            levels = ", ".join(f"{u:.4g}" for u in away.inputs.mean(axis=0))
            warn(
                f"Inputs of experiment {away.label!r} stay about {levels}, and the "
                "simulation begins at rest where those of `fit` were in the mean, "
                f"{', '.join(f'{u:.4g}' for u in u0)} (`input_offset_`): at first it "
                "moves from there. Where outputs are known, use "
                "predict_with_initial_state(X, y)."
            )
        return self._in_table(experiments, X, simulator.simulated)

    @one_blas_thread
    def predict_with_initial_state(self, X: Any, y: Any) -> Array:
        """Simulate the outputs from initial states estimated on measured outputs.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Measured outputs, used for the initial state of every experiment (and of a
            model with `offset_` for the constant and drift) only: least squares over
            the whole experiment. Where "auto" took no constants an experiment has one
            nevertheless if that explains most of its errors, beyond chance. Missing
            ones (NaN) are left out. Where inputs act late, those in transit are
            estimated too: the first samples are then met more or less exactly.

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
            With ``missing="split"`` or "estimate" NaN where an input is missing; the
            simulation begins anew after that.
        """
        check_is_fitted(self, "lti_")
        experiments = self._read(X, y, outputs=False)
        return self._in_table(experiments, X, self._simulator().from_own_beginning)

    @one_blas_thread
    def predict_ahead(
        self, X: Any, y: Any, steps: int = 1, *, initial_state: str = "estimate"
    ) -> Array:
        """Predict every sample from the outputs up to `steps` samples before it.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Measured outputs. Missing ones (NaN) correct nothing.
        steps : int, default=1
            Prediction horizon in samples.
        initial_state : {"estimate", "rest"}, default="estimate"
            "estimate" takes the deterministic initial state, and constants, from the
            whole experiment, as `predict_with_initial_state` does (with "pbsid" that of
            plant and noise, from the errors of prediction); "rest" uses no later
            output.

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
            By `predictor_`; for white noise the simulation.
        """
        check_is_fitted(self, "lti_")
        one_of("initial_state", initial_state, ("estimate", "rest"))
        experiments = self._read(X, y, outputs=False)
        predictor = self._predictor(self.lti_)
        model = self._simulator()

        def predicted(e: Experiment) -> Array:
            u0, level = model.resting_point()
            x0 = None
            if initial_state == "estimate":
                x0, level = model.own_part(e, predictor)
            elif predictor.gain is None:
                x0 = model.beginning(e)
            u, y = e.inputs - u0, e.measured - level
            return level + predictor.predict(u, y, steps=steps, initial_state=x0)

        return self._in_table(experiments, X, predicted)

    @one_blas_thread
    def residual_tests(
        self,
        X: Any,
        y: Any,
        *,
        errors: str = "simulation",
        n_lags: int | None = None,
        level: float = 0.01,
    ) -> pd.DataFrame:
        r"""Test whether the errors are white, and independent of the inputs.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Measured outputs. Initial states and trends of `offset_` are estimated from
            them, `detrend` acts as in `fit`. Records are cut where samples are missing.
        errors : {"simulation", "prediction"}, default="simulation"
            Of `predict_with_initial_state`, or of `predict_ahead`, with no other trends
            than those of `offset_`. Only the latter should be white: they test the
            noise model too.
        n_lags : int, default=None
            Samples to the past and to the future that are looked at. None: 25, fewer
            where experiments are short. Experiments of ``4 * n_lags`` samples or fewer
            are left out.
        level : float, default=0.01
            Share of the correct models that each test refuses.

        Returns
        -------
        DataFrame
            For every output the tests "whiteness", "past inputs", "present input" and
            "future inputs", the latter three for every input. Columns:

            - output, test, input (empty for whiteness);
            - statistic, dof : chi-squared with that many degrees of freedom, about,
              where there is nothing to be found (for inputs ``dof * F``);
            - p_value : probability of such a statistic by chance;
            - passed : whether the p-value is not below `level`;
            - n_missing : samples of the output that are missing (NaN), or of which an
              input is.

        Raises
        ------
        ValueError
            If an option is out of range, or no experiment is long enough.

        Warns
        -----
        UserWarning
            If the errors of an output are rounding: its tests then pass.

        Notes
        -----
        Errors that depend on *past* inputs tell of a model that lacks states, a delay
        or a nonlinearity; on the *present* input, of a lacking feedthrough; on *future*
        inputs, of feedback, where errors of prediction are the ones to look at. An
        input with a delay is present when it arrives. The errors are whitened by an
        autoregression before they are regressed on the inputs, so that coloured noise
        raises no alarm.

        On the samples of the fit, the errors have lost what the parameters could
        explain: sensitivities of the errors to the parameters join the regressions, and
        the p-values are right there as well, as far as the model is close to the truth
        (weakly excited modes in coloured noise may not be). A table is taken for
        that where one of its experiments begins with the same outputs as one of the
        fit. On other samples the model is tested as it is, with the errors that its
        parameters have.

        References
        ----------
        G. M. Ljung and G. E. P. Box, "On a measure of lack of fit in time series
        models", Biometrika 65, 1978.

        L. D. Haugh, "Checking the independence of two covariance-stationary time
        series", Journal of the American Statistical Association 71, 1976.

        L. Ljung, *System Identification: Theory for the User*, Prentice Hall, 1999,
        Section 16.6.

        Examples
        --------
        >>> import numpy as np
        >>> from scipy.signal import lfilter
        >>> from lpvlearn import SubspaceLTI
        >>> u, e = np.random.default_rng(0).standard_normal((2, 600))
        >>> y = lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.8], u) + 0.1 * e
        >>> model = SubspaceLTI(2, horizon=10).fit(u[:, None], y)
        >>> model.residual_tests(u[:, None], y)[["test", "passed"]]
                    test  passed
        0      whiteness    True
        1    past inputs    True
        2  present input    True
        3  future inputs    True
        """
        residuals = self._residuals(X, y, errors)
        return residual_tests(residuals, n_lags=n_lags, level=level)

    def _residuals(self, X: Any, y: Any, errors: str) -> Residuals:
        """What is tested; `ResidualDisplay` draws it."""
        check_is_fitted(self, "lti_")
        check_kind(errors)
        y = align_outputs(X, y, self)
        experiments = self._read(X, y, split=True, cut=False)
        names = list(experiments[0].output_names)
        if y is not None and len(names) != self.n_outputs_:
            raise ValueError(
                f"`y` must hold the {self.n_outputs_} output(s) of the model. Got "
                f"{len(names)}."
            )
        lost = (
            np.isnan(e.measured) | ~np.isfinite(e.inputs).all(axis=1, keepdims=True)
            for e in experiments
        )
        n_missing = sum(part.sum(axis=0) for part in lost)
        if self.missing == "estimate" and any(map(has_gaps, experiments)):
            at_rest = self.initial_state == "rest"
            experiments = completed_by(self._simulator(), experiments, at_rest=at_rest)
        experiments = self._with_late_inputs(experiments, self.input_delay_, True)
        undelayed = self.lti_.with_input_delay(0)
        found = model_residuals(
            undelayed,
            self._predictor(undelayed) if errors == "prediction" else None,
            [(e.inputs, e.measured) for e in experiments],
            self._evidence,
            names,
            input_labels(experiments[0].input_names),
            self.detrend,
        )
        return found._replace(n_missing=n_missing)

    @property
    def predictor_(self) -> InnovationModel:
        """Innovation model: `lti_`, the noise model, K and innovation covariance."""
        check_is_fitted(self, "lti_")
        try:
            return self._predictor(self.lti_)
        except ValueError as error:
            raise AttributeError(str(error)) from None

    def _predictor(self, lti: StateSpace) -> InnovationModel:
        n_states = None if self.n_noise_states == "auto" else int(self.n_noise_states)
        return self._evidence.predictor(lti, n_states)

    @property
    def poles_std_(self) -> NDArray[np.complex128]:
        """Standard deviations of the poles, in the order of ``lti_.poles()``.

        The real part is that of a pole's real part, the imaginary part that of its
        imaginary part.
        """
        check_is_fitted(self, "lti_")
        try:
            return self._evidence.poles_std()
        except ValueError as error:
            raise AttributeError(str(error)) from None

    def deviated_models(self) -> list[ModelPair]:
        """Models to either side of `lti_`, along its directions of uncertainty.

        Returns
        -------
        list of pairs of StateSpace
            Both models of a pair lie a hundredth of a standard deviation from `lti_`,
            in directions that are independent: to first order the variance of anything
            computed from the model is the sum over the pairs of
            ``((above - below) / 0.02)**2``. Empty where that is not known: without
            refinement, with enforced stability, collinear inputs, errors that are
            rounding, or poles of multiplicity three.
        """
        check_is_fitted(self, "lti_")
        return self._evidence.deviated_models(self.lti_)

    def frequency_response_covariance(self, omega: ArrayLike) -> Array:
        """Covariance of the frequency response at every frequency.

        Asymptotic, from the Gauss-Newton Jacobian of the simulation error; valid for
        coloured noise and outputs of different quality.

        Parameters
        ----------
        omega : array-like of shape (n_freq,)
            Angular frequencies, rad/s.

        Returns
        -------
        ndarray of shape (n_freq, k, k), ``k = 2 n_outputs n_inputs``
            Of the real parts of all entries, output by output, then of the imaginary
            parts: the columns of the frequency-response tables of
            `GrayBoxRestructurer`.

        Raises
        ------
        ValueError
            If the model does not minimise the simulation error, with "pbsid" the
            prediction error (``refine=False``).
        """
        check_is_fitted(self, "lti_")
        return self._evidence.frequency_response_covariance(self._per_sample(omega))

    def frequency_response_std(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Standard deviation of the frequency response.

        Parameters
        ----------
        omega : array-like of shape (n_freq,)
            Angular frequencies, rad/s.

        Returns
        -------
        ndarray of complex, shape (n_freq, n_outputs, n_inputs)
            The real part is the standard deviation of the real part of the response,
            the imaginary part that of the imaginary part. Its modulus is the root mean
            square of the complex error.

        Raises
        ------
        ValueError
            As `frequency_response_covariance`.

        Notes
        -----
        A 95 % band of a real part is 1.96 standard deviations to both sides.
        """
        check_is_fitted(self, "lti_")
        return self._evidence.frequency_response_std(self._per_sample(omega))

    def _per_sample(self, omega: ArrayLike) -> Array:
        """Angular frequencies in radians per sample."""
        step = self.lti_.sampling_time or 1.0
        found = frequencies(omega) * step
        if not np.isfinite(found).all():
            raise ValueError(f"`omega` must be finite. Got {found.max()} per sample.")
        return found

    def criterion(self) -> float:
        """How likely the model makes its samples, and what its parameters cost.

        Of models of the same samples the one with the least value is to be preferred,
        as by Akaike's criterion; each of them has its own noise.

        Returns
        -------
        float
            Minus twice the logarithm of the likelihood but for a constant, and four
            for every parameter and every unknown of the experiments. Minus infinity
            where nothing is left of an output; NaN with `integrating`, where the errors
            are those of the rates, and of a model from a file, which has no samples.
            Of a long table or a stream, that of its first samples.
        """
        check_is_fitted(self, "lti_")
        evidence = self._evidence
        if isinstance(evidence, RateEvidence) or not evidence.records:
            return np.nan
        return float(evidence.one_step.criterion)

    def resting_point(self, *, begun: bool = False) -> tuple[Array, Array]:
        """Inputs and outputs at rest: `input_offset_` and `output_offset_` pooled.

        Parameters
        ----------
        begun : bool, default=False
            Outputs are those where a drift (`output_drift_`) begins with the
            experiments, not in the middle of it.

        Returns
        -------
        u0 : ndarray of shape (n_inputs,)
            Mean over the samples of all experiments.
        y0 : ndarray of shape (n_outputs,)
        """
        check_is_fitted(self, "lti_")
        return self._simulator().resting_point(begun=begun)

    def selection_text(self) -> str:
        """`selection_` as a text table, the choice marked."""
        check_is_fitted(self, "lti_")
        return selection_text(self.selection_)

    def split_experiments(self, X: Any) -> list[NDArray[np.intp]]:
        """Rows of every experiment of a table, in the order of time.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        list of ndarray of int
        """
        check_is_fitted(self, "lti_")
        gaps = "Xy" if self.missing != "raise" else ""
        optional = (*OPTIONAL_ROLES, "scheduling")
        options: dict[str, Any] = {"reset": False, "optional": optional}
        found = read_experiments(self, X, allow_missing=gaps, **options)
        return [e.rows for e in found]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        # Tables of independent samples, as in the common tests, have no dynamics.
        tags.regressor_tags.poor_score = True
        tags.input_tags.allow_nan = self.missing != "raise"
        return tags

    def _read(self, X: Any, y: Any, **options: Any) -> list[Experiment]:
        """Experiments of a table; options as in `read_runs`."""
        options = {"split": self.missing != "raise", "reset": False} | options
        known = options["reset"] or self.time is None
        found = read_runs(
            self,
            X,
            y,
            sampling_time=self.sampling_time,
            fitted_step=None if known else self.lti_.sampling_time,
            optional=(*OPTIONAL_ROLES, "scheduling"),
            **options,
        )
        if not options["reset"]:
            check_inputs(found, self.lti_.n_inputs)
        return found

    def _simulator(self) -> Simulator:
        """The model with what is known of its experiments."""
        known = self.lti_, self._evidence, self._offsets, self.offset is not None
        held = getattr(self, "steady_start_", False)
        return Simulator(*known, held, getattr(self, "begun_state_", None))

    def _in_table(
        self,
        experiments: Sequence[Experiment],
        X: Any,
        outputs: Callable[[Experiment], Array],
    ) -> Any:
        """Outputs in the rows of their samples, NaN elsewhere."""
        out = np.full((n_rows_of(X), self.n_outputs_), np.nan)
        for e in experiments:
            with naming(e):
                out[e.rows] = outputs(e)
        return self._contained(out, X, self.lti_.output_names)


def _names_of(experiments: Sequence[Experiment], y: Any) -> tuple[Any, Any]:
    """Names of inputs and outputs, as columns have them; None for those of arrays."""
    inputs = experiments[0].input_names
    numbered = any(isinstance(name, Integral) for name in inputs)
    named = hasattr(y, "columns") or getattr(y, "name", None) is not None
    outputs = list(experiments[0].output_names) if named else None
    return None if numbered else inputs, outputs


def _names_read(experiments: Sequence[Experiment]) -> tuple[Any, Any]:
    """Names of inputs and outputs, which experiments that were made may not have."""
    listed = isinstance(experiments, list | tuple) and len(experiments)
    if not listed or not all(isinstance(e, Experiment) for e in experiments):
        raise ValueError(
            "`experiments` must be what `read_experiments` returns, one at least. Got "
            f"{shown(experiments)}. Use `fit`, which takes tables."
        )
    first = experiments[0]
    return list(first.input_names) or None, list(first.output_names) or None


def _labels_of(X: Any, experiments: Sequence[Experiment], y: Any) -> tuple[Any, Any]:
    """What messages call the columns, numbers too; None for those of arrays."""
    inputs = experiments[0].input_names if hasattr(X, "columns") else None
    return inputs, _names_of(experiments, y)[1]
