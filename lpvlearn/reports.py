"""Reports of a fitted pipeline as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .experiments import Experiment
from .local_models import LocalModel
from .lpv import LPVStateSpace
from .numerics.simulationfit import estimate_initial_state
from .scores import bft_score
from .statespace import StateSpace

Array = NDArray[np.float64]


def operating_point_report(
    groups: Sequence[Sequence[Experiment]],
    models: Sequence[LocalModel],
    structured: Sequence[StateSpace],
    restructurers: Sequence[Any],
    lpv: LPVStateSpace,
    kappa: Array,
    sampling_time: float,
) -> pd.DataFrame:
    """One row per operating point: how good each step was.

    Parameters
    ----------
    groups : sequence of sequences of Experiment
        Estimation experiments of every point.
    models : sequence of LocalModel
    structured : sequence of StateSpace
        Gray-box models.
    restructurers : sequence
        Fitted restructurers; empty without that step.
    lpv : LPVStateSpace
    kappa : ndarray of shape (n_points, n_scheduling)
    sampling_time : float

    Returns
    -------
    DataFrame
        Columns as in `LocalLPVPipeline.report_`.
    """
    rows = []
    for k, (group, model) in enumerate(zip(groups, models, strict=True)):
        gray_box = structured[k]
        row: dict[str, Any] = {
            "operating_point": point_label(kappa[k]),
            "n_experiments": len(group),
            "n_samples": sum(len(e.rows) for e in group),
            "order": model.order,
            "horizon": model.horizon,
            "local_BFT": fit_of(model.lti, group, sampling_time),
        }
        if restructurers:
            r = restructurers[k]
            size = r.error_ / r.relative_error_ if r.relative_error_ > 0 else np.inf
            row |= {
                "structured_BFT": fit_of(gray_box, group, sampling_time),
                "relative_error": r.relative_error_,
                "relative_floor": r.structural_floor_ / size,
                "active_frequency": r.active_frequencies_.max(initial=0.0),
                "stationarity": r.stationarity_,
            }
        distance = (gray_box - lpv.at(kappa[k])).hinf_norm()
        size = gray_box.hinf_norm()
        row["interpolation_error"] = distance / size if size > 0 else np.nan
        rows.append(row)
    return pd.DataFrame(rows).set_index("operating_point")


def point_label(kappa: Array) -> float | tuple[float, ...]:
    """A scheduling value as an index entry: a number, or a tuple of several."""
    values = tuple(kappa.tolist())
    return values[0] if len(values) == 1 else values


def fit_of(
    model: StateSpace, group: Sequence[Experiment], sampling_time: float
) -> float:
    """BFT (percent, mean over the outputs) of a continuous model on experiments.

    The initial state of every experiment is estimated by least squares.
    """
    sampled = model.to_discrete(sampling_time)
    true, simulated = [], []
    for experiment in group:
        assert experiment.outputs is not None
        free = experiment.outputs - sampled.simulate(experiment.inputs)
        x0 = estimate_initial_state(sampled.A, sampled.C, free)
        true.append(experiment.outputs)
        simulated.append(sampled.simulate(experiment.inputs, initial_state=x0))
    return float(bft_score(np.vstack(true), np.vstack(simulated)))
