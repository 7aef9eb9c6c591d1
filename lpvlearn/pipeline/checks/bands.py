"""How uncertain the outputs are that an estimator predicts, and why."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...data.containers import row_labels
from ...data.experiments import Experiment, naming
from ...data.tables import n_rows_of
from ...lpv.bands import Levels, simulation_std
from ...lpv.model import LPVStateSpace

Array = NDArray[np.float64]


def output_errors(names: Sequence[Hashable], levels: Levels) -> pd.DataFrame:
    """Columns model_error and noise, a row per output."""
    index = pd.Index(list(names), name="output", tupleize_cols=False)
    return pd.DataFrame(levels._asdict(), index)


def prediction_std(
    model: LPVStateSpace,
    levels: pd.DataFrame,
    experiments: Sequence[Experiment],
    sampling_time: float,
    X: Any,
) -> pd.DataFrame:
    """The parts of the standard deviations of outputs, and their sums, by output."""
    n_samples = n_rows_of(X)
    by_parameters = np.full((n_samples, model.n_outputs), np.nan)
    for e in experiments:
        dt = e.sampling_time or sampling_time
        with naming(e):
            by_parameters[e.rows] = simulation_std(model, e.inputs, e.kappa, dt)
    names = ("parameters", "model_error", "total", "measurement")
    model_error, noise = levels.to_numpy().T
    total = np.hypot(by_parameters, model_error)
    alone = np.where(np.isnan(by_parameters), np.nan, model_error)
    parts = [by_parameters, alone, total, np.hypot(total, noise)]
    found = np.stack(parts, axis=2)
    columns = pd.MultiIndex.from_product(
        [levels.index, names], names=["output", "part"]
    )
    return pd.DataFrame(found.reshape(n_samples, -1), row_labels(X), columns)
