"""The command ``lpvlearn``, or ``python -m lpvlearn``: own tables, and the paper's."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import joblib

from .command import add_commands
from .paper import run_paper_experiment, save_figures, tables_text

_MAX_JOBS = 7  # one for each operating point of the paper

_PAPER = (
    "The flexible-arm experiment of the paper: Tables 1-4 beside the published ones, "
    "and Figures 2-10."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or (given[0].startswith("-") and given[0] not in ("-h", "--help")):
        given.insert(0, "paper")
    parser = argparse.ArgumentParser(
        prog="lpvlearn",
        description="Local linear parameter-varying (LPV) identification.",
        epilog="Without a word it is paper. 'lpvlearn fit --help' shows examples.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    add_commands(commands)
    _add_paper(
        commands.add_parser("paper", help="the paper's experiment", description=_PAPER)
    )
    options = parser.parse_args(given)
    status: int = options.run(options)
    return status


def _add_paper(parser: argparse.ArgumentParser) -> None:
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
    parser.set_defaults(run=_paper)


def _paper(options: argparse.Namespace) -> int:
    options.output.mkdir(parents=True, exist_ok=True)
    experiment = run_paper_experiment(
        options.realizations,
        options.degree,
        method=options.method,
        random_state=options.seed,
        n_jobs=options.jobs or min(_MAX_JOBS, joblib.cpu_count()),
        verbose=1,
    )
    with experiment.watch.step("figures"):
        import matplotlib

        matplotlib.use("agg")  # there may be no screen
        figures = save_figures(experiment, options.output)
    tables = experiment.tables | {"timing": experiment.watch.table()}
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


if __name__ == "__main__":
    sys.exit(main())
