"""The options of ``lpvlearn fit``, ``predict`` and ``report``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .ending import status_of
from .fit import INTERPOLATIONS, fit
from .tables import TIME_UNITS, Format
from .use import predict, report

_FIT = """\
examples:
  lpvlearn fit runs.csv --inputs force --outputs position --scheduling kappa \\
      --experiment run --time time --output spring
  lpvlearn fit runs.csv --inputs force --outputs position --scheduling kappa \\
      --experiment run --time time --structure spring.toml \\
      --validation sweep.csv --output spring
  lpvlearn fit run_*.csv --outputs position --scheduling kappa --time time \\
      --output spring                    (each file is one experiment)

spring.toml, the structure as a template; names in its cells are the parameters:
  A = [[0, 1], ["-k", "-c"]]
  B = [[0], ["b"]]
  C = [[1, 0]]
  [bounds]
  k = [0, inf]
  [units]
  position = "m"
  k = "1/s2"
or `form = "mechanical"` with M, D, K and F, "modal" with n_modes,
"observable_canonical" or "full" with order. JSON serves too.

written into the folder: report.html, report.txt, model.zip, points.csv,
parameters.csv, fit.csv (measured against simulated), figures/*.svg
"""

_PREDICT = """\
examples:
  lpvlearn predict spring/model.zip sweep.csv --output simulated.csv
  lpvlearn predict spring/model.zip sweep.csv > simulated.csv

The table needs the columns of the fit, by name. Where it holds the measured
outputs too, the fit of the simulation is told.
"""

_REPORT = """\
examples:
  lpvlearn report spring/model.zip
  lpvlearn report spring/model.zip --table sweep.csv --output sweep.html
"""


def add_commands(commands: Any) -> None:
    """Add the three to the subparsers of a parser.

    Each leaves `run`, a function of the options.
    """
    _add_fit(_command(commands, "fit", "identify a model from a table", _FIT, fit))
    parser = _command(
        commands, "predict", "simulate a model along a table", _PREDICT, predict
    )
    _add_model(parser)
    _add_tables(parser, "table")
    _add_start(parser)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="table of the simulated outputs (default: csv on the standard output)",
    )
    _add_format(parser)
    parser = _command(commands, "report", "tell how good a model is", _REPORT, report)
    _add_model(parser)
    _add_tables(parser, "--table", "measured, to be compared with the simulation")
    _add_start(parser)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE.html",
        help="HTML page (default: text on the standard output alone)",
    )
    _add_format(parser)


_TABLE = (
    "a .csv, .txt, .parquet or .xlsx file with one row per sample; several files, or "
    "sheets of a workbook, are as many experiments"
)


def _command(
    commands: Any, name: str, about: str, examples: str, run: Callable[..., None]
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=about,
        description=f"{about[0].upper()}{about[1:]}.",
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=lambda options: _run(run, options))
    return parser


def _run(command: Callable[..., None], options: argparse.Namespace) -> int:
    options.format = Format(
        options.separator, options.decimal, options.encoding, options.time_unit
    )
    return status_of(options.command, lambda: command(options))


def _add_fit(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _add_tables(parser, "table")
    roles = parser.add_argument_group("columns, by name; several with commas between")
    for name, what in (
        ("inputs", "what drives the system (default: all without another role)"),
        ("outputs", "what answers (required)"),
        ("scheduling", "what the dynamics depend on (default: nothing)"),
        ("experiment", "which run a row belongs to (default: each file is one)"),
        ("time", "numbers or dates; see --time-unit"),
        ("operating-point", "labels of the operating points (default: found)"),
    ):
        required = name == "outputs"
        roles.add_argument(f"--{name}", metavar="NAMES", help=what, required=required)
    add(
        "--sampling-time",
        type=float,
        metavar="S",
        help="seconds between rows, where no column tells the time",
    )
    add(
        "--levels",
        type=float,
        nargs="?",
        const=True,
        metavar="TOL",
        help="cut records into experiments where the scheduling variables are held, "
        "within TOL (default 5 %% of their range); what is between is left out",
    )
    add(
        "--missing",
        choices=("raise", "split", "estimate"),
        default="raise",
        help="samples: refuse them, end a record there and begin another, or estimate "
        "outputs and end it where inputs are missing (default raise)",
    )
    model = parser.add_argument_group("the model")
    add = model.add_argument
    add("--structure", type=Path, metavar="FILE", help="gray-box structure, see below")
    add("--order", type=int, metavar="N", help="of the local models (default: found)")
    add(
        "--interpolation",
        choices=INTERPOLATIONS,
        default="auto",
        help="of the parameters over the scheduling variables (default auto)",
    )
    add("--degree", type=int, metavar="D", help="of --interpolation polynomial")
    add(
        "--hinf",
        action="store_true",
        help="keep the H-infinity optimum, do not weigh by the noise",
    )
    add = parser.add_argument
    _add_tables(
        parser, "--validation", "to judge the model by (default: that of the fit)"
    )
    _add_start(parser)
    add("--jobs", type=int, metavar="J", help="operating points at the same time")
    add(
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="new folder; it appears when all is in it",
    )
    add(
        "--overwrite",
        action="store_true",
        help="replace files of the same names in a folder that is there",
    )
    add("--quiet", action="store_true", help="print errors only")
    _add_format(parser)


def _add_tables(parser: argparse.ArgumentParser, name: str, text: str = _TABLE) -> None:
    parser.add_argument(name, type=Path, metavar="TABLE", nargs="+", help=text)


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "model", type=Path, metavar="MODEL", help="model.zip of lpvlearn fit"
    )


def _add_start(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--initial-state",
        choices=("rest", "estimate"),
        default="rest",
        help="of simulations; estimate it for records that start in mid-motion "
        "(default rest)",
    )


def _add_format(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("how a file is written, where that is not found")
    add = group.add_argument
    add("--separator", metavar="C", help="between columns of a file of text")
    add("--decimal", metavar="C", help="decimal mark")
    add("--encoding", metavar="NAME", help="of the characters, such as cp1252")
    add(
        "--time-unit",
        choices=TIME_UNITS,
        help="of numbers in the column of the time (default: as the table tells, or s)",
    )
