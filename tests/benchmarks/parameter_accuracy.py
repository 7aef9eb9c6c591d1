"""How near the restructured parameters of the flexible arm are to the true ones.

    python tests/benchmarks/parameter_accuracy.py [first] [last seed] [realizations]

Seven operating points, local experiments of 3 s at 30 dB, pooled at each point. Per
operating point: FIT of the sixteen parameters, Eq. (36), the median of their relative
errors, and how many of them are within 1.96 of the standard deviations that the
pipeline reports (95 % if those are right).
"""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI, parameter_fit
from lpvlearn.datasets import make_flexible_arm


def accuracy(seed: int, n_realizations: int) -> pd.DataFrame:
    """A row for each operating point of one seed."""
    data = make_flexible_arm(n_realizations=n_realizations, random_state=seed)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(feedthrough=False),
        GrayBoxRestructurer(data.structure),
        scheduling="kappa",
        experiment="experiment",
        time="time",
    ).fit(data.X, data.y)
    rows = []
    for k, kappa in enumerate(pipeline.operating_points_[:, 0]):
        truth = np.asarray(data.arm.parameters(np.arccos(kappa)))
        found = pipeline.parameters_.iloc[k].to_numpy()
        std = pipeline.parameters_std_.iloc[k].to_numpy()
        error = np.abs(found - truth)
        rows.append(
            {
                "theta2 / pi": round(float(np.arccos(kappa)) / np.pi * 8) / 8,
                "FIT (%)": parameter_fit(truth, found),
                "median error (%)": 100 * np.median(error / np.abs(truth)),
                "within 1.96 std (%)": 100 * np.mean(error <= 1.96 * std),
            }
        )
    return pd.DataFrame(rows)


def main(first: int = 0, last: int = 9, n_realizations: int = 1) -> None:
    """Print the table."""
    runs = pd.concat(accuracy(s, n_realizations) for s in range(first, last + 1))
    points = runs.groupby("theta2 / pi")
    table = points.mean()
    table.insert(1, "lowest FIT", points["FIT (%)"].min())
    table.loc["all"] = table.mean()
    table.loc["all", "lowest FIT"] = runs["FIT (%)"].min()
    print(f"seeds {first} to {last}, {n_realizations} realization(s) at each point")
    print(table.round(2).to_string())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
