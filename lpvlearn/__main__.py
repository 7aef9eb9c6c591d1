"""The command ``lpvlearn``, or ``python -m lpvlearn``: own tables, and the paper's."""

from __future__ import annotations

import argparse
import atexit
import gc
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import joblib

from .command import __version__
from .command.ending import status_of
from .command.output import whole_folder

if TYPE_CHECKING:
    import pandas as pd

    from .paper import PaperExperiment

_MAX_JOBS = 7  # one for each operating point of the paper

_ABOUT = ("-h", "--help", "--version")  # of the command, not of the paper's

_PAPER = (
    "The flexible-arm experiment of the paper: Tables 1-4 beside the published ones, "
    "and Figures 2-10."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or (given[0].startswith("-") and given[0] not in _ABOUT):
        given.insert(0, "paper")
    parser = argparse.ArgumentParser(
        prog="lpvlearn",
        description="Local linear parameter-varying (LPV) identification.",
        epilog="Without a word it is paper. 'lpvlearn fit --help' shows examples.",
    )
    parser.add_argument(
        "--version", action="version", version=f"%(prog)s {__version__}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    if given[0] != "paper":  # which has processes to wake first
        from .command.parsers import add_commands

        add_commands(commands)
    _add_paper(
        commands.add_parser("paper", help="the paper's experiment", description=_PAPER)
    )
    options = parser.parse_args(given)
    atexit.register(gc.freeze)  # no cycles are looked for in what ends anyway
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
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with a run into that directory which did not end: the operating "
        "points that it had done are not done again",
    )
    parser.set_defaults(run=lambda options: status_of("paper", lambda: _paper(options)))


def _paper(options: argparse.Namespace) -> None:
    n_jobs = min(options.jobs or joblib.cpu_count(), _MAX_JOBS)
    with (
        whole_folder(options.output, overwrite=True) as folder,
        _points_done(options.output, options.resume) as memory,
        _woken(n_jobs),
    ):
        _enter("lpvlearn.paper")
        from .command.judgement import course
        from .paper import run_paper_experiment, save_figures, tables_text

        def save(experiment: PaperExperiment) -> None:
            _save_tables(experiment.tables, folder)
            with experiment.watch.step("figures"):
                import matplotlib

                matplotlib.use("agg")  # there may be no screen
                save_figures(experiment, folder)

        with course() as told, told.step("experiment", bar=True):
            experiment = run_paper_experiment(
                options.realizations,
                options.degree,
                method=options.method,
                random_state=options.seed,
                n_jobs=n_jobs,
                memory=memory,
                verbose=1,
                meanwhile=save,
            )
        _save_tables(experiment.tables, folder)
        n_figures = len(list(folder.glob("*.png")))
    print(tables_text(experiment))
    if told.warned:
        print(f"\n{told.text()}")
    print(
        f"\n{len(experiment.tables)} tables (csv) and {n_figures} figures (png) are in "
        f"{options.output}/"
    )


@contextmanager
def _woken(n_jobs: int) -> Iterator[None]:
    """Other processes enter the library while this one does, one core for each."""
    wake = joblib.delayed(_enter)("lpvlearn.pipeline")
    awake = joblib.Parallel(n_jobs, return_as="generator")((n_jobs - 1) * [wake])
    try:
        yield
    finally:
        list(awake)


def _enter(room: str) -> None:
    """Import a room; none of it is garbage that need be looked for, then or later."""
    gc.disable()
    import_module(room)
    gc.freeze()
    gc.enable()


def _save_tables(tables: dict[str, pd.DataFrame], folder: Path) -> None:
    for name, table in tables.items():
        table.to_csv(folder / f"{name}.csv", index=False)


@contextmanager
def _points_done(output: Path, resume: bool) -> Iterator[Path]:
    """A folder beside the output for the operating points done, until all are."""
    folder = output.with_name(f".{output.name}.done")
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    try:
        yield folder
    except BaseException:
        if folder.is_dir():
            print(
                f"The operating points done are in {folder}: go on by the same command "
                "with --resume.",
                file=sys.stderr,
            )
        raise
    shutil.rmtree(folder, ignore_errors=True)


def _positive(text: str) -> int:
    if not text.strip().isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be an integer, at least 1. Got {text}.")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
