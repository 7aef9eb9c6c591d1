"""Models, and estimators, simulated along the experiments of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from ..data.alignment import align_outputs
from ..data.experiments import (
    NO_TIME,
    ROLES,
    Experiment,
    check_inputs,
    fitted_roles,
    naming,
    read_experiments,
)
from ..data.preparation import read_runs
from ..data.scoring import warn_of_motion
from ..data.tables import Table, n_rows_of, read_outputs
from ..data.timestamps import TIME_TOL
from ..models.statespace import StateSpace

Array = NDArray[np.float64]


@runtime_checkable
class ScheduledModel(Protocol):
    """What a table asks of a model that follows scheduling variables: LPVStateSpace."""

    @property
    def n_inputs(self) -> int: ...

    @property
    def n_outputs(self) -> int: ...

    @property
    def n_scheduling(self) -> int: ...

    @property
    def scheduling_range(self) -> Array: ...

    def simulate(
        self,
        u: Any,
        scheduling: Any,
        sampling_time: float,
        initial_state: Any = None,
    ) -> Array: ...

    def estimate_initial_state(
        self, u: Any, scheduling: Any, y: Any, sampling_time: float
    ) -> Array: ...


def simulate_experiments(
    model: StateSpace | ScheduledModel,
    experiments: Sequence[Experiment],
    sampling_time: float | None,
    n_samples: int,
    *,
    estimate: bool,
) -> Array:
    """Outputs (n_samples, n_outputs) of a model along the experiments of a table.

    Rows stand where they do in the table, NaN in those of no experiment;
    `sampling_time` is that of experiments that do not tell it, None where it is not
    known. From rest, or from initial states estimated on the outputs.
    """
    table = np.full((n_samples, model.n_outputs), np.nan)
    for e in experiments:
        dt = e.sampling_time or sampling_time
        with naming(e):
            table[e.rows] = _simulate(model, e, dt, estimate)
    return table


def _simulate(
    model: StateSpace | ScheduledModel, e: Experiment, dt: float | None, estimate: bool
) -> Array:
    x0 = None
    if isinstance(model, StateSpace) and not model.is_continuous:
        if estimate:
            y = _outputs(e, model.n_outputs)
            x0 = model.estimate_initial_state(e.inputs, y)
        known = e.sampling_time is None and model.sampling_time is not True
        held = dt if known else None
        return model.simulate(e.inputs, sampling_time=held, initial_state=x0)
    if dt is None:
        raise ValueError(NO_TIME.format("the model is"))
    if isinstance(model, ScheduledModel):
        if estimate:
            y = _outputs(e, model.n_outputs)
            x0 = model.estimate_initial_state(e.inputs, e.kappa, y, dt)
        return model.simulate(e.inputs, e.kappa, dt, x0)
    return _simulate(model.to_discrete(dt), e, dt, estimate)


def _outputs(experiment: Experiment, n_outputs: int) -> Array:
    if experiment.outputs is None or experiment.outputs.shape[1] != n_outputs:
        got = 0 if experiment.outputs is None else experiment.outputs.shape[1]
        raise ValueError(
            f"`y` must have the {n_outputs} output(s) of the model. Got {got}."
        )
    return experiment.outputs


class TableSimulator(BaseEstimator):
    """A state-space model that simulates tables, with their roles of columns."""

    def __init__(
        self,
        model: Any,
        sampling_time: float | None = None,
        inputs: Any = None,
        scheduling: Any = None,
        experiment: Any = None,
        time: Any = None,
        operating_point: Any = None,
        time_tol: float = TIME_TOL,
    ) -> None:
        self.model = model
        self.sampling_time = sampling_time
        self.inputs = inputs
        self.scheduling = scheduling
        self.experiment = experiment
        self.time = time
        self.operating_point = operating_point
        self.time_tol = time_tol

    @property
    def _output_names(self) -> Any:
        return self.model.output_names

    def predict(self, X: Any) -> Array:
        """Simulate from rest."""
        return self._simulate(self._read(X, None), n_rows_of(X), estimate=False)

    def predict_with_initial_state(self, X: Any, y: Any) -> Array:
        """Simulate from initial states estimated on the outputs."""
        return self._simulate(
            self._read(X, y, outputs=False), n_rows_of(X), estimate=True
        )

    def split_experiments(self, X: Any) -> list[NDArray[np.intp]]:
        """Rows of every experiment."""
        return [e.rows for e in read_experiments(self, X, allow_missing="Xy")]

    def _read(self, X: Any, y: Any, **options: Any) -> list[Experiment]:
        is_lpv = isinstance(self.model, ScheduledModel)
        if is_lpv and self.scheduling is None and self.model.scheduling_range.any():
            raise ValueError(
                f"`scheduling` must name the {self.model.n_scheduling} column(s) of X "
                "that the LPV model follows. Got None."
            )
        own = getattr(self.model, "sampling_time", None)
        options |= {
            "split": True,
            "sampling_time": self.sampling_time,
            "fitted_step": None if own is True else own,
        }
        found = read_runs(self, X, y, **options)
        check_inputs(found, self.model.n_inputs)
        return found

    def _simulate(
        self, experiments: list[Experiment], n_samples: int, *, estimate: bool
    ) -> Array:
        return simulate_experiments(
            self.model, experiments, self.sampling_time, n_samples, estimate=estimate
        )


def wrapped_by(estimator: Any) -> Any:
    """What a fitted search found best, or the last step of a chain; None of others."""
    from sklearn.pipeline import Pipeline  # slow to import

    if isinstance(estimator, Pipeline):
        return estimator[-1]
    return getattr(estimator, "best_estimator_", None)


def unwrapped(estimator: Any) -> Any:
    """The estimator within searches and chains, whose models can be shown."""
    while (inner := wrapped_by(estimator)) is not None:
        estimator = inner
    return estimator


def unwrap(estimator: Any, X: Any) -> tuple[Any, Any]:
    """The simulating estimator within searches and chains, and its input."""
    while (inner := wrapped_by(estimator)) is not None:
        if len(getattr(estimator, "steps", ())) > 1:
            X = estimator[:-1].transform(X)
        estimator = inner
    return estimator, X


def owner_of_experiments(estimator: Any) -> Any:
    """Who knows the experiments: the estimator, or what it wraps; else None."""
    while estimator is not None and not hasattr(estimator, "split_experiments"):
        inner = wrapped_by(estimator)
        estimator = getattr(estimator, "regressor_", None) if inner is None else inner
    return estimator


@dataclass(frozen=True)
class Simulated:
    """Measured outputs of a table, NaN where missing, and simulated ones."""

    y: Any  # like the table in length and order
    measured: NDArray[np.float64]  # (n_samples, n_outputs)
    names: list[Any]
    simulated: NDArray[np.float64]
    from_rest: bool

    def warn_of_motion(self, estimator: Any, X: Any) -> None:
        """Warn where a simulation from rest misses how an experiment starts."""
        if self.from_rest:
            warn_of_motion(estimator, X, self.y, self.simulated)


def simulate(estimator: Any, X: Any, y: Any, initial_state: str) -> Simulated:
    """Measured and simulated outputs of a table.

    What lacks an input, and is not simulated therefore, counts as not measured.
    """
    if not hasattr(estimator, "predict"):
        raise ValueError(
            "`estimator` must be a fitted estimator with the method predict(X). Got "
            f"{type(estimator).__name__}; compare_models takes state-space models."
        )
    y = align_outputs(X, y, estimator)
    measured, names = read_outputs(y)
    if initial_state == "rest":
        found = read_outputs(estimator.predict(X))[0]
    elif not hasattr(estimator, "predict_with_initial_state"):
        raise TypeError(
            "`initial_state='estimate'` needs an estimator with the method "
            f"predict_with_initial_state(X, y). Got {type(estimator).__name__}; use "
            "`initial_state='rest'`, with `burn_in` to leave out the transient."
        )
    else:
        found = read_outputs(estimator.predict_with_initial_state(X, y))[0]
        if np.isnan(found).any():
            measured = np.where(_lacks_inputs(estimator, X)[:, None], np.nan, measured)
    if found.shape != measured.shape:
        raise ValueError(
            "`y` and the outputs of the estimator must have the same shape. Got "
            f"{measured.shape} and {found.shape}."
        )
    return Simulated(y, measured, names, found, initial_state == "rest")


def _lacks_inputs(estimator: Any, X: Any) -> NDArray[np.bool_]:
    """Rows of which an input or a scheduling value is missing."""
    table = Table(X)
    roles = fitted_roles(estimator, table, optional=ROLES)
    single = ("experiment", "time", "operating_point")
    kappa = table.several(roles["scheduling"], "scheduling")
    others = [*(table.one(roles[name], name) for name in single), *kappa]
    columns = [*table.inputs(roles["inputs"], others), *kappa]
    return np.any([np.isnan(column.numbers("X")) for column in columns], axis=0)


def split(estimator: Any, X: Any) -> list[NDArray[np.intp]]:
    """Rows of each experiment."""
    owner = owner_of_experiments(estimator)
    if owner is None:
        raise TypeError(
            "`burn_in` and `average='experiment'` need an estimator with the method "
            f"split_experiments(X). Got {type(estimator).__name__}; use `burn_in=0` "
            "and `average='pool'`."
        )
    return list(owner.split_experiments(X))


def drop_start(
    groups: Sequence[NDArray[np.intp]], burn_in: int
) -> list[NDArray[np.intp]]:
    """Rows of the experiments without their first `burn_in` samples."""
    shortest = min(len(rows) for rows in groups)
    if burn_in >= shortest:
        raise ValueError(
            "`burn_in` must be less than the number of samples of each experiment, "
            f"{shortest} in the shortest. Got {burn_in}."
        )
    return [rows[burn_in:] for rows in groups]
