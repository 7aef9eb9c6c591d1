"""Tables 1 to 4: this library's figures beside those that the paper published."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import Bunch

from .. import (
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
    bft_score,
    parameter_fit,
    vaf_score,
)

Array = NDArray[np.float64]

# Rows are theta_2 = i pi / 8, i = 1, ..., 7.
TABLE_1: dict[tuple[str, str], tuple[float, ...]] = {
    ("BFT", "y1"): (85.83, 91.23, 90.23, 92.09, 89.65, 88.42, 91.01),
    ("BFT", "y2"): (67.42, 98.18, 85.07, 97.83, 88.97, 89.82, 97.23),
    ("VAF", "y1"): (97.98, 99.23, 99.04, 99.37, 98.93, 98.66, 99.2),
    ("VAF", "y2"): (89.39, 99.96, 97.77, 99.9, 98.78, 98.96, 99.9),
}

TABLE_2 = (4.03e-3, 2.1e-3, 1.48e-3, 1.25e-3, 1.03e-3, 7.28e-4, 4.79e-4)

NOT_DETERMINED = float("nan")

# (model, degree) -> FIT of A, B, C, D
TABLE_3: dict[tuple[str, int], tuple[float, float, float, float]] = {
    ("restructured", 1): (84.7, 78.1, 97.9, NOT_DETERMINED),
    ("restructured", 2): (96.6, 88.8, 98.9, NOT_DETERMINED),
    ("analytic", 1): (88.2, 82.7, 100.0, NOT_DETERMINED),
    ("analytic", 2): (94.5, 91.5, 100.0, NOT_DETERMINED),
    ("balanced", 1): (92.0, 86.6, 84.7, 94.8),
    ("balanced", 2): (94.8, 90.1, 91.1, 98.4),
}

# (model, output) -> BFT, VAF
TABLE_4: dict[tuple[str, str], tuple[float, float]] = {
    ("restructured", "y1"): (76.2, 94.4),
    ("restructured", "y2"): (83.0, 97.1),
    ("analytic", "y1"): (78.6, 95.5),
    ("analytic", "y2"): (88.4, 98.7),
    ("balanced", "y1"): (52.7, 77.7),
    ("balanced", "y2"): (79.7, 95.9),
}

OUTPUTS = ("y1", "y2")


@dataclass(frozen=True)
class ParameterSet:
    """Parameters of one kind of model at every operating point."""

    structure: GrayBoxStructure
    theta: Array


def local_experiments(
    data: Bunch,
) -> Iterator[tuple[float, pd.DataFrame, pd.DataFrame]]:
    """Noise-free validation experiments: mean scheduling value, X and y."""
    for _, X in data.X_local.groupby("experiment", sort=False):
        yield float(X["kappa"].mean()), X, data.y_local.loc[X.index]


def nearest_model(pipeline: LocalLPVPipeline, kappa: float) -> StateSpace:
    """The local black-box model whose operating point is nearest."""
    return pipeline.local_models_[_nearest(pipeline, kappa)]


def _nearest(pipeline: LocalLPVPipeline, kappa: float) -> int:
    return int(np.argmin(np.abs(pipeline.operating_points_[:, 0] - kappa)))


def _fits(y: ArrayLike, simulated: ArrayLike) -> Iterator[tuple[str, str, float]]:
    """Metric, output and percent of both outputs by both metrics."""
    for metric, score in (("BFT", bft_score), ("VAF", vaf_score)):
        values = score(y, simulated, multioutput="raw_values")
        for output, value in zip(OUTPUTS, values, strict=True):
            yield metric, output, float(value)


def local_table(models: Sequence[StateSpace], data: Bunch) -> pd.DataFrame:
    """Table 1: fit of the local models, angle by angle, on new noise-free data."""
    rows = []
    for i, (_, X, y) in enumerate(local_experiments(data)):
        model = models[i]
        simulated = model.simulate(
            X[["u1", "u2"]].to_numpy(), sampling_time=data.sampling_time
        )
        for metric, output, value in _fits(y, simulated):
            paper = TABLE_1[metric, output][i]
            rows.append((data.theta2[i], metric, output, value, paper))
    return pd.DataFrame(rows, columns=["theta2", "metric", "output", "ours", "paper"])


def restructuring_table(pipeline: LocalLPVPipeline, data: Bunch) -> pd.DataFrame:
    """Table 2: H-infinity error of restructuring, relative to the analytic model.

    The floor is ``|I - G_0(0)|``: the arm's structure fixes the static gain, and no
    parameter can lower the black box's error there.
    """
    rows = []
    for i, theta2 in enumerate(data.theta2):
        k = _nearest(pipeline, np.cos(theta2))
        size = data.analytic_models[i].hinf_norm()
        gain = pipeline.local_models_[k].dc_gain()
        floor = float(np.linalg.norm(np.eye(len(gain)) - gain, 2))
        error = pipeline.restructurers_[k].error_
        rows.append((theta2, error / size, floor / size, TABLE_2[i]))
    return pd.DataFrame(rows, columns=["theta2", "relative_error", "floor", "paper"])


def interpolation_table(
    parameters: dict[str, ParameterSet], kappa: Array
) -> pd.DataFrame:
    """Table 3: FIT (36) of the interpolated matrices, d = 1 and 2."""
    rows = []
    for name, found in parameters.items():
        local = found.structure.matrices(found.theta)
        for degree in (1, 2):
            smooth = PolynomialLPV(degree).fit(kappa, found.theta).predict(kappa)
            fitted = found.structure.matrices(smooth)
            paper = TABLE_3[name, degree]
            for k, matrix in enumerate("ABCD"):
                true, ours = local[k].ravel(), NOT_DETERMINED
                if true.any():
                    ours = parameter_fit(true, fitted[k].ravel())
                rows.append((name, degree, matrix, ours, paper[k]))
    return pd.DataFrame(rows, columns=["model", "degree", "matrix", "ours", "paper"])


def validation_table(lpv: dict[str, LPVStateSpace], data: Bunch) -> pd.DataFrame:
    """Table 4: fit of the LPV models on the sweep, simulated from rest."""
    rows = []
    for name, model in lpv.items():
        for metric, output, value in _fits(data.y_sweep, simulate_sweep(model, data)):
            paper = TABLE_4[name, output][metric == "VAF"]
            rows.append((name, output, metric, value, paper))
    return pd.DataFrame(rows, columns=["model", "output", "metric", "ours", "paper"])


def sweeps_table(model: LPVStateSpace, data: Bunch) -> pd.DataFrame:
    """Fit of an LPV model on the sweep and on the one the other way, from rest."""
    sweeps = {
        "up": (data.X_sweep, data.y_sweep),
        "down": (data.X_sweep_down, data.y_sweep_down),
    }
    rows = [
        (name, output, metric, value)
        for name, (X, y) in sweeps.items()
        for metric, output, value in _fits(y, simulate_sweep(model, data, X))
    ]
    return pd.DataFrame(rows, columns=["sweep", "output", "metric", "ours"])


def simulate_sweep(
    model: LPVStateSpace, data: Bunch, X: pd.DataFrame | None = None
) -> Array:
    """Outputs of an LPV model along a sweep, the validation's if none is given."""
    X = data.X_sweep if X is None else X
    return model.simulate(
        X[["u1", "u2"]].to_numpy(), X["kappa"].to_numpy(), data.sampling_time
    )
