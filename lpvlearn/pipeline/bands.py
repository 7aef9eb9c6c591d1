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
    index = pd.Index(list(names), name="output", tupleize_cols=False)
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
    names = ("parameters", "model_error", "total", "measurement")
    found = np.empty((n_samples, model.n_outputs, len(names)))
    for k, (model_error, noise) in enumerate(levels.to_numpy()):
        own = by_parameters[:, k]
        total = np.hypot(own, model_error)
        found[:, k, 0], found[:, k, 1], found[:, k, 2] = own, model_error, total
        found[:, k, 3] = np.hypot(total, noise)
    found[np.isnan(by_parameters)] = np.nan
    columns = pd.MultiIndex.from_product(
        [levels.index, names], names=["output", "part"]
    )
    return pd.DataFrame(
        found.reshape(n_samples, -1), getattr(X, "index", None), columns
    )
