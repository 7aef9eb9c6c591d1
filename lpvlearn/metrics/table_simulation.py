"""Models simulated along the experiments of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from ..data.experiments import (
    NO_TIME,
    Experiment,
    check_inputs,
    naming,
    read_experiments,
)
from ..data.preparation import read_runs
from ..data.tables import n_rows_of
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
