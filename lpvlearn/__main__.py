"""``python -m lpvlearn``: the paper's experiment, its tables and figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from .paper.experiment import PaperExperiment, Stopwatch, run_paper_experiment
from .paper.figures import save_figures
from .paper.text import tables_text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m lpvlearn",
        description="The flexible-arm experiment of the paper: Tables 1-4 beside the "
        "published ones, and Figures 2-10.",
    )
    parser.add_argument(
        "--realizations",
        type=_positive,
        default=100,
        metavar="N",
        help="noise realizations at each operating point (default 100)",
    )
    parser.add_argument(
        "--degree",
        type=_positive,
        default=2,
        metavar="D",
        help="degree of the interpolating polynomial (default 2)",
    )
    parser.add_argument(
        "--method",
        choices=("po-moesp", "pi-moesp"),
        default="po-moesp",
        help="subspace method of the local models (default po-moesp)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="S", help="random seed (default 0)"
    )
    parser.add_argument(
        "--jobs",
        type=_positive,
        default=None,
        metavar="J",
        help="processes (default: one for each core, at most 7)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="directory for the tables and figures (default results/)",
    )
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    experiment = run_paper_experiment(
        options.realizations,
        options.degree,
        method=options.method,
        random_state=options.seed,
        n_jobs=options.jobs or min(7, _cores()),
        verbose=1,
    )
    watch = Stopwatch()
    with watch.step("figures"):
        figures = _without_windows(experiment, options.output)
    tables = experiment.tables | {
        "timing": with_step(experiment.tables["timing"], watch.seconds)
    }
    for name, table in tables.items():
        table.to_csv(options.output / f"{name}.csv", index=False)
    print(tables_text(experiment, tables))
    print(
        f"\n{len(tables)} tables (csv) and {len(figures)} figures (png) are in "
        f"{options.output}/"
    )
    return 0


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1. Got {value}.")
    return value


def _cores() -> int:
    import joblib

    return int(joblib.cpu_count())


def _without_windows(experiment: PaperExperiment, directory: Path) -> list[Path]:
    """The figures, drawn where there may be no screen."""
    import matplotlib

    matplotlib.use("agg")
    return save_figures(experiment, directory)


def with_step(timing: pd.DataFrame, seconds: dict[str, float]) -> pd.DataFrame:
    """The table of step times with further steps before the total."""
    steps = timing[timing["step"] != "total"]
    more = pd.DataFrame(list(seconds.items()), columns=["step", "seconds"])
    rows = pd.concat([steps, more], ignore_index=True)
    total = pd.DataFrame([("total", rows["seconds"].sum())], columns=rows.columns)
    return pd.concat([rows, total], ignore_index=True)


# -- the printed report ----------------------------------------------------------------


if __name__ == "__main__":
    sys.exit(main())
