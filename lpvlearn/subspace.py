"""Subspace identification of a linear time-invariant model: step 3 of the paper."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from .exceptions import RankWarning
from .excitation import check_excitation, check_size, reduce_inputs
from .experiments import Experiment, read_experiments
from .numerics.identification import (
    Identified,
    identify,
    scale_records,
)
from .numerics.realization import METHODS
from .numerics.selection import Candidate, Selection, select
from .numerics.simulationfit import estimate_initial_state
from .statespace import StateSpace

Array = NDArray[np.float64]

# A model that explains less than this share of the outputs' size is reported.
_USELESS_FIT = 0.1


class SubspaceLTI(MultiOutputMixin, RegressorMixin, BaseEstimator):
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
    sampling_time : float, default=1.0
        Seconds between samples. With a `time` column the default stands for the
        column's own step; any other value must agree with it.
    feedthrough : bool, default=True
        Whether the input acts on the output at once; False fixes ``D = 0``.
    refine : bool, default=True
        Whether to minimise the simulation error after the subspace step.
    stability : {"warn", "enforce"}, default="warn"
        "warn" keeps an unstable model, with a warning, where a stable one fits
        clearly worse; "enforce" reflects unstable poles into the unit circle.
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
        Initial state of every experiment, in the order of first appearance.
    selection_ : DataFrame
        What was tried: columns order, horizon, criterion (relative simulation error
        before refinement on the estimation part), validation_bft (percent, on
        the held-out part; NaN for horizons that lost within their order), chosen.
    residual_ : float
        Simulation error on the data relative to the outputs, root mean square.
    n_outputs_ : int
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Notes
    -----
    `predict` simulates from rest; `predict_with_initial_state` estimates the
    initial state from outputs first, as a split in the middle of an experiment
    needs. Models of different fits do not share a state basis.

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
        sampling_time: float = 1.0,
        feedthrough: bool = True,
        refine: bool = True,
        stability: str = "warn",
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
        order, horizon = self._check_options()
        experiments = self._read(X, y, reset=True)
        pairs = [(e.inputs, _outputs(e)) for e in experiments]
        check_excitation(pairs)
        pairs, basis = reduce_inputs(pairs)
        check_size(pairs, order, horizon, self.method)
        options: dict[str, Any] = {
            "method": self.method,
            "feedthrough": self.feedthrough,
            "refine": self.refine,
            "enforce_stability": self.stability == "enforce",
        }
        if order is None or horizon is None:
            chosen = select(scale_records(pairs).records, order, horizon, **options)
            found = identify(pairs, chosen.order, chosen.horizon, **options)
        else:
            found = identify(pairs, order, horizon, **options)
            only = Candidate(order, horizon, found.residual, np.nan)
            chosen = Selection(order, horizon, [only])

        step = next((e.sampling_time for e in experiments if e.sampling_time), None)
        self.lti_ = StateSpace(
            found.A,
            found.B @ basis.T,
            found.C,
            found.D @ basis.T,
            float(self.sampling_time) if step is None else step,
        )
        self.order_, self.horizon_ = chosen.order, chosen.horizon
        self.singular_values_ = found.singular_values
        self.initial_states_ = found.initial_states
        self.residual_ = found.residual
        self.selection_ = _selection_table(chosen)
        self.n_outputs_ = pairs[0][1].shape[1]
        self._single_output = np.asarray(y).ndim == 1
        self._warn_about(found)
        return self

    def predict(self, X: Any) -> Array:
        """Simulate the outputs of every experiment from rest.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
        """
        check_is_fitted(self)
        experiments = self._read(X, None, reset=False)
        return self._simulate(experiments, [None] * len(experiments))

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
        check_is_fitted(self)
        experiments = self._read(X, y, reset=False)
        states: list[Array | None] = []
        for experiment in experiments:
            forced = self.lti_.simulate(experiment.inputs)
            free = _outputs(experiment) - forced
            states.append(estimate_initial_state(self.lti_.A, self.lti_.C, free))
        return self._simulate(experiments, states)

    def split_experiments(self, X: Any) -> list[NDArray[np.intp]]:
        """Rows of every experiment of a table, in the order of time.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)

        Returns
        -------
        list of ndarray of int
        """
        check_is_fitted(self)
        return [e.rows for e in self._read(X, None, reset=False)]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        # Tables of independent samples, as in the common tests, have no dynamics.
        tags.regressor_tags.poor_score = True
        return tags

    def _read(self, X: Any, y: Any, *, reset: bool) -> list[Experiment]:
        declared = self.sampling_time if self.sampling_time != 1.0 else None
        return read_experiments(
            self,
            X,
            y,
            inputs=self.inputs,
            scheduling=self.scheduling,
            experiment=self.experiment,
            time=self.time,
            operating_point=self.operating_point,
            sampling_time=declared,
            reset=reset,
        )

    def _simulate(
        self, experiments: Sequence[Experiment], states: Sequence[Array | None]
    ) -> Array:
        n_samples = sum(len(e.rows) for e in experiments)
        out = np.empty((n_samples, self.n_outputs_))
        for experiment, x0 in zip(experiments, states, strict=True):
            out[experiment.rows] = self.lti_.simulate(
                experiment.inputs, initial_state=x0
            )
        return out[:, 0] if self._single_output else out

    def _check_options(self) -> tuple[int | None, int | None]:
        """Order and horizon as integers, None for "auto"."""
        if self.method not in METHODS:
            raise ValueError(
                f"`method` must be one of {', '.join(METHODS)}. Got {self.method!r}."
            )
        if self.stability not in ("warn", "enforce"):
            raise ValueError(
                f"`stability` must be 'warn' or 'enforce'. Got {self.stability!r}."
            )
        if not self.sampling_time > 0.0:
            raise ValueError(
                "`sampling_time` must be a positive number of seconds. Got "
                f"{self.sampling_time}."
            )
        order = _integer_or_auto("order", self.order, 0)
        return order, _integer_or_auto("horizon", self.horizon, 1)

    def _warn_about(self, found: Identified) -> None:
        if found.rank_deficit:
            warnings.warn(
                f"The data leave {found.rank_deficit} directions of B and D "
                "undetermined; the smallest solution was taken. Excite the inputs "
                "more richly, or lower `order`.",
                RankWarning,
                stacklevel=3,
            )
        radius = float(np.abs(self.lti_.poles()).max(initial=0.0))
        if radius > 1.0:
            warnings.warn(
                f"The identified model is unstable: a pole has modulus {radius:.6g}. "
                "Use stability='enforce' for a stable one, another `order`, or a "
                "longer `horizon`.",
                UserWarning,
                stacklevel=3,
            )
        if found.residual > 1.0 - _USELESS_FIT:
            warnings.warn(
                "The model explains next to nothing of the outputs: its simulation "
                f"error is {100.0 * found.residual:.0f} % of their size. Try a longer "
                "`horizon` or order='auto', and check that inputs and outputs belong "
                "together and in the order of time.",
                UserWarning,
                stacklevel=3,
            )


def _outputs(experiment: Experiment) -> Array:
    if experiment.outputs is None:
        raise ValueError("`y` must hold the measured outputs. Got None.")
    return experiment.outputs


def _integer_or_auto(name: str, value: Any, lowest: int) -> int | None:
    if isinstance(value, str) and value == "auto":
        return None
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_integer or value < lowest:
        raise ValueError(
            f"`{name}` must be 'auto' or an integer of at least {lowest}. "
            f"Got {value!r}."
        )
    return int(value)


def _selection_table(selection: Selection) -> pd.DataFrame:
    table = pd.DataFrame(selection.candidates, columns=Candidate._fields)
    table["chosen"] = (table["order"] == selection.order) & (
        table["horizon"] == selection.horizon
    )
    return table
