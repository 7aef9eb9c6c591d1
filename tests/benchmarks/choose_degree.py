"""Which degree does leave-one-operating-point-out choose, and is the sweep of one mind?

    python tests/benchmarks/choose_degree.py [first] [last seed] [n_points] [snr_db]

A grid search over the degree on the flexible arm, scored in three ways with one
operating point left out, beside the simulation of a sweep that no fit has seen. Local
models are identified and restructured once for each seed (`memory`). What was measured
stands in the documentation, "How good is it".
"""

from __future__ import annotations

import sys
import tempfile
import warnings

import numpy as np
import pandas as pd
from sklearn.model_selection import GridSearchCV

from lpvlearn import (
    ExperimentSplit,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_scorer,
    make_bft_scorer,
)
from lpvlearn.datasets import make_flexible_arm
from lpvlearn.exceptions import ExtrapolationWarning

SPLITS = {
    "every point, scored there": {"interior": False},
    "interior point, scored there": {"interior": True},
    "interior point, scored on all": {"interior": True, "test_on": "all"},
}
# Every experiment counts alike, whatever the size of its outputs.
SCORER = make_bft_scorer(average="experiment")


def scores_by_degree(seed: int, n_points: int, snr_db: float) -> pd.DataFrame:
    """BFT in percent: a row for each degree, a column for each way to score it."""
    arm = make_flexible_arm(n_points, 2, snr_db, random_state=seed)
    columns = {"scheduling": "kappa", "experiment": "experiment"}
    degrees = pd.RangeIndex(1, n_points - 1, name="degree")
    table = pd.DataFrame(index=degrees)
    with tempfile.TemporaryDirectory() as folder:
        pipeline = LocalLPVPipeline(
            SubspaceLTI(feedthrough=False),
            GrayBoxRestructurer(arm.structure),
            PolynomialLPV(),
            time="time",
            memory=folder,
            **columns,
        )
        for name, options in SPLITS.items():
            cv = ExperimentSplit(
                "all", hold_out="operating_point", **columns, **options
            )
            search = GridSearchCV(
                pipeline, {"interpolator__degree": list(degrees)}, scoring=SCORER, cv=cv
            ).fit(arm.X, arm.y)
            table[name] = search.cv_results_["mean_test_score"]
        table["sweep"] = [
            bft_scorer(
                pipeline.set_params(interpolator__degree=degree).fit(arm.X, arm.y),
                arm.X_sweep,
                arm.y_sweep,
            )
            for degree in degrees
        ]
    return table


def main(
    first: int = 0, last: int = 9, n_points: int = 7, snr_db: float = 30.0
) -> None:
    """Print the choices of every seed, and what they cost on the sweep."""
    warnings.simplefilter("ignore", ExtrapolationWarning)
    chosen, cost = [], []
    for seed in range(first, last + 1):
        table = scores_by_degree(seed, n_points, snr_db)
        print(f"seed {seed}\n{table.round(2).to_string()}", flush=True)
        choice = table.idxmax()
        chosen.append(choice)
        cost.append(
            table["sweep"].max() - table["sweep"][choice].set_axis(choice.index)
        )
    loss = pd.DataFrame(cost)
    summary = pd.DataFrame(
        {
            "chosen": pd.DataFrame(chosen).agg(lambda c: str(np.bincount(c).tolist())),
            "best on the sweep": (loss == 0).sum(),
            "mean loss": loss.mean().round(2),
            "largest loss": loss.max().round(2),
        }
    )
    print(f"\n{n_points} points, {snr_db:g} dB, seeds {first} to {last}; loss in BFT")
    print(summary.to_string())


if __name__ == "__main__":
    whole = [int(argument) for argument in sys.argv[1:4]]
    main(*whole, *map(float, sys.argv[4:5]))
