"""Subspace identification of a linear time-invariant model: step 3 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from ..data.experiments import Experiment, read_experiments
from ..data.preparation import split_at_gaps
from ..systems.simulation import estimate_initial_state, free_responses
from .fit import LocalFit, find_better_horizon, fit_pairs
from .options import (
    Choices,
    check_options,
    selection_table,
    selection_text,
    warn_about,
    warn_about_horizon,
)
from .statistics import SimulationErrorStatistics, outputs_of
from .stream import StreamedFit

Array = NDArray[np.float64]

Pairs = list[tuple[Array, Array]]


class SubspaceLTI(
    StreamedFit,
    SimulationErrorStatistics,
    MultiOutputMixin,
    RegressorMixin,
    BaseEstimator,
):
    """Linear time-invariant state-space model by subspace identification.

    The observability matrix is estimated from compressed block-Hankel data by one of
    the MOESP family; B, D and the initial state of every experiment follow by least
    squares on the simulated outputs, and a few Gauss-Newton steps on the simulation
    error polish the result. Order and horizon are chosen by what validates.

    Parameters
    ----------
    order : int or "auto", default="auto"
        Number of states. "auto" takes the smallest order whose simulation of held-out
        samples is not significantly worse than the best. 0 is a pure gain.
    method : {"po-moesp", "pi-moesp", "n4sid", "cva"}, default="po-moesp"
        "pi-moesp" uses past inputs only as instruments: consistent under coloured
        measurement noise, but it needs long horizons. The others use past inputs and
        outputs and differ in the weighting.
    horizon : int or "auto", default="auto"
        Past and future horizon in samples. "auto" tries a geometric grid and takes
        one whose model simulates the data as well as any. Of more than 12,000
        samples "auto" looks at that many, spread over the experiments.
    sampling_time : float, default=None
        Seconds between samples, which must agree with the `time` column. None: the
        step of that column; without one, 1 s.
    feedthrough : bool or array-like of bool, default=True
        Whether an input acts on an output at once; False fixes ``D = 0``, a table of
        shape (n_outputs, n_inputs) single entries of D.
    refine : bool, default=True
        Whether to minimise the simulation error after the subspace step.
    stability : {"warn", "enforce"}, default="warn"
        "warn" keeps an unstable model, with a warning, where a stable one fits
        clearly worse; "enforce" returns a stable one and reports in
        `stability_loss_` what that cost.
    n_noise_states : int or "auto", default="auto"
        States of the noise model in `predictor_`. A number also raises the order of
        the subspace step by that much, which makes "po-moesp" consistent under
        coloured noise without refinement; only states that the inputs reach are
        kept in `lti_`.
    initial_state : {"estimate", "rest"}, default="estimate"
        State in which every experiment of `fit` starts: estimated along with B and D,
        or zero, which is worth knowing of short experiments that start at rest.
    detrend : {None, "constant", "linear"}, default=None
        Subtract its mean or straight line from every channel of every experiment.
        Predictions are then about the means of all training samples.
    missing : {"raise", "split"}, default="raise"
        "split" ends an experiment before a sample with NaN and starts another after
        it, with an initial state of its own.
    inputs : str, int or list of them, default=None
        Input columns of X. None: all columns without another role.
    experiment : str or int, default=None
        Column that tells experiments apart. None: the table is one experiment.
    time : str or int, default=None
        Column of sample times, checked for even steps.
    scheduling, operating_point : str, int or list of them, default=None
        Columns with these roles are read and left alone: the model is time-invariant.

    Attributes
    ----------
    lti_ : StateSpace
        Discrete-time model.
    order_, horizon_ : int
        As chosen or given.
    singular_values_ : ndarray of shape (horizon_ * n_outputs,)
        Of the estimated observability subspace, descending.
    initial_states_ : ndarray of shape (n_experiments, order_)
        Initial state of every experiment, in the order of first appearance; after
        `partial_fit` of a long stream, of its last stretch only.
    selection_ : DataFrame
        What was tried: columns order, horizon, criterion (relative simulation error
        before refinement on the estimation part), validation_bft (percent, on
        the held-out part; NaN for horizons that lost within their order), chosen.
    residual_ : float
        Simulation error on the data relative to the outputs, root mean square.
    stability_loss_ : float
        Increase of `residual_` that enforced stability cost; 0 where it cost nothing.
    predictor_ : InnovationModel
        `lti_` with a noise model, Kalman gain and innovation covariance.
    poles_std_ : ndarray of complex, shape (order_,)
        Standard deviations of the real and imaginary parts of ``lti_.poles()``.
    input_offset_, output_offset_ : ndarray
        Means subtracted with `detrend`, else zero.
    n_outputs_ : int
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Notes
    -----
    `predict` simulates from rest; `predict_with_initial_state` estimates the
    initial state from outputs first, as a split in the middle of an experiment
    needs. Models of different fits do not share a state basis.

    Without refinement, "po-moesp" with as many noise states as the noise has and
    "pi-moesp" at the order of the system are consistent under coloured noise, others
    under white noise only. Their error falls as ``1 / sqrt(n_samples)`` once the
    horizon resolves the modes, and faster before: at a signal-to-noise ratio of 10 dB
    under strongly coloured noise some ten thousand samples may be needed. The refined
    error does so from the start, under any noise.

    Of a table of more than 131,072 samples the first ones choose order and horizon;
    the others are added in one pass, as `partial_fit` does.

    `fit` keeps its samples for the attributes and methods that are statistics of the
    simulation error, which are computed when first asked for.

    References
    ----------
    M. Verhaegen, "Identification of the deterministic part of MIMO state space
    models given in innovations form from input-output data", Automatica 30, 1994.

    M. Verhaegen and V. Verdult, *Filtering and System Identification*, Cambridge
    University Press, 2007.

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
        order: int | str = "auto",
        *,
        method: str = "po-moesp",
        horizon: int | str = "auto",
        sampling_time: float | None = None,
        feedthrough: Any = True,
        refine: bool = True,
        stability: str = "warn",
        n_noise_states: int | str = "auto",
        initial_state: str = "estimate",
        detrend: str | None = None,
        missing: str = "raise",
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
        self.refine = refine
        self.stability = stability
        self.n_noise_states = n_noise_states
        self.initial_state = initial_state
        self.detrend = detrend
        self.missing = missing
        self.inputs = inputs
        self.experiment = experiment
        self.time = time
        self.scheduling = scheduling
        self.operating_point = operating_point

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
            If the model is unstable or explains next to nothing of the outputs.
        """
        choices = check_options(self)
        experiments, _ = self._read(X, y, reset=True)
        self._stream = None
        self._single_output = np.asarray(y).ndim == 1
        self._set_step(experiments)
        pairs = [(e.inputs, outputs_of(e)) for e in experiments]
        fitted = self._fit_in_one_pass(pairs, choices)
        if fitted is None:
            fitted = self._fit_pairs(pairs, choices, self.detrend)
        warn_about(fitted.found)
        if choices.order is not None and choices.horizon is not None:
            better = find_better_horizon(fitted, self._fit_options())
            warn_about_horizon(fitted.found.residual, choices.horizon, better)
        return self

    def _fit_pairs(
        self,
        pairs: Pairs,
        choices: Choices,
        detrend: str | None,
        told: set[str] | None = None,
    ) -> LocalFit:
        """Identify on experiments and set the fitted attributes."""
        fitted = fit_pairs(
            pairs,
            choices,
            feedthrough=self.feedthrough,
            initial_states=self.initial_state == "estimate",
            detrend=detrend,
            names=self._input_names,
            options=self._fit_options(),
            told=told,
        )
        self.order_ = fitted.selection.order
        self.horizon_ = fitted.selection.horizon
        self.selection_ = selection_table(fitted.selection)
        self.n_outputs_ = pairs[0][1].shape[1]
        self.input_offset_ = fitted.input_offset
        self.output_offset_ = fitted.output_offset
        self.stability_loss_ = fitted.found.stability_loss
        self._keep_evidence(fitted.evidence)
        found = fitted.found
        self._set_model(found.scaled_model, found.singular_values, found.residual)
        return fitted

    def _fit_options(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "refine": self.refine,
            "enforce_stability": self.stability == "enforce",
        }

    def _set_step(self, experiments: Sequence[Experiment]) -> None:
        step = next((e.sampling_time for e in experiments if e.sampling_time), None)
        given = 1.0 if self.sampling_time is None else float(self.sampling_time)
        self._step = given if step is None else step

    def predict(self, X: Any) -> Array:
        """Simulate the outputs of every experiment from rest.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
        """
        check_is_fitted(self, "lti_")
        experiments, n_samples = self._read(X, None, reset=False)
        return self._simulate(experiments, [None] * len(experiments), n_samples)

    def predict_with_initial_state(self, X: Any, y: Any) -> Array:
        """Simulate the outputs from initial states estimated on measured outputs.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Measured outputs, used for the initial state of every experiment only
            (least squares over the whole experiment).

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
        """
        check_is_fitted(self, "lti_")
        experiments, n_samples = self._read(X, y, reset=False)
        states = [self._initial_state(e) for e in experiments]
        return self._simulate(experiments, states, n_samples)

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
        return [e.rows for e in self._read(X, None, reset=False)[0]]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        # Tables of independent samples, as in the common tests, have no dynamics.
        tags.regressor_tags.poor_score = True
        tags.input_tags.allow_nan = self.missing == "split"
        return tags

    def _read(
        self, X: Any, y: Any, *, reset: bool, split: bool = True
    ) -> tuple[list[Experiment], int]:
        # A simulation needs every input; gaps are for what has outputs beside them.
        gaps = self.missing == "split" and y is not None
        experiments = read_experiments(
            self,
            X,
            y,
            inputs=self.inputs,
            scheduling=self.scheduling,
            experiment=self.experiment,
            time=self.time,
            operating_point=self.operating_point,
            sampling_time=self.sampling_time,
            reset=reset,
            allow_missing=gaps,
        )
        if reset:
            self._input_names = experiments[0].input_names
        n_samples = sum(len(e.rows) for e in experiments)
        if gaps and split:
            experiments = split_at_gaps(experiments)
        return experiments, n_samples

    def _initial_state(self, experiment: Experiment) -> Array:
        forced = self.lti_.simulate(experiment.inputs - self.input_offset_)
        error = outputs_of(experiment) - self.output_offset_ - forced
        free = free_responses(self.lti_.A, self.lti_.C, len(error))
        return estimate_initial_state(free, error)

    def _simulate(
        self,
        experiments: Sequence[Experiment],
        states: Sequence[Array | None],
        n_samples: int,
    ) -> Array:
        out = np.full((n_samples, self.n_outputs_), np.nan)
        for experiment, x0 in zip(experiments, states, strict=True):
            u = experiment.inputs - self.input_offset_
            simulated = self.lti_.simulate(u, initial_state=x0)
            out[experiment.rows] = simulated + self.output_offset_
        return out[:, 0] if self._single_output else out
