"""How uncertain the outputs are that an estimator predicts, and why."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.experiments import Experiment, n_rows_of, naming
from ..lpv.bands import levels_of, simulation_std
from ..lpv.model import LPVStateSpace

Array = NDArray[np.float64]


def output_errors(
    names: Sequence[Hashable], errors: Sequence[Array], left_out: Sequence[Array] = ()
) -> pd.DataFrame:
    """Columns model_error and noise, a row per output, as `levels_of` has them."""
    index = pd.Index(list(names), name="output")
    return pd.DataFrame(levels_of(errors, left_out)._asdict(), index)


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
        kappa = np.zeros((len(e.rows), 1)) if e.scheduling is None else e.scheduling
        dt = e.sampling_time or sampling_time
        with naming(e):
            by_parameters[e.rows] = simulation_std(model, e.inputs, kappa, dt)
    found: dict[tuple[Hashable, str], Array] = {}
    for name, own in zip(levels.index, by_parameters.T, strict=True):
        model_error, noise = levels.loc[name, ["model_error", "noise"]].to_numpy()
        total = np.hypot(own, model_error)
        parts = {
            "parameters": own,
            "model_error": np.where(np.isnan(own), np.nan, model_error),
            "total": total,
            "measurement": np.hypot(total, noise),
        }
        found |= {(name, part): values for part, values in parts.items()}
    table = pd.DataFrame(found, getattr(X, "index", None))
    return table.rename_axis(columns=["output", "part"])
