"""How good a model is, as text: what the fit found, and a simulation of a table."""

from __future__ import annotations

import sys
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import pandas as pd

from .. import LocalLPVPipeline, readable_report
from .ending import in_options

_LINE = 88  # characters


class Signals(NamedTuple):
    """A table as a pipeline takes it."""

    X: pd.DataFrame
    y: pd.DataFrame | None  # where the outputs were measured


def signals_of(pipeline: LocalLPVPipeline, table: pd.DataFrame, name: str) -> Signals:
    """The columns of a fitted pipeline, from the table of that name."""
    wanted = [str(column) for column in pipeline.feature_names_in_]
    missing = [column for column in wanted if column not in table.columns]
    if missing:
        raise ValueError(
            f"{name} lacks the column(s) {', '.join(map(repr, missing))} of the fit. "
            f"It has {', '.join(map(repr, table.columns))}."
        )
    outputs = [str(column) for column in pipeline.output_names_]
    measured = set(outputs) <= set(table.columns)
    return Signals(table[wanted], table[outputs] if measured else None)


def measured_signals(
    pipeline: LocalLPVPipeline, table: pd.DataFrame, name: str
) -> Signals:
    """Those of a table that must have the outputs, too."""
    found = signals_of(pipeline, table, name)
    if found.y is None:
        shown = ", ".join(map(repr, pipeline.output_names_))
        raise ValueError(f"{name} lacks outputs to compare with: {shown}.")
    return found


def simulation_text(report: pd.DataFrame, name: str, initial_state: str) -> str:
    """A report of `fit_report` under a heading."""
    start = "from rest" if initial_state == "rest" else "from estimated states"
    return (
        f"Simulation of {name}, {start} (BFT and VAF in percent)\n\n"
        + readable_report(report).to_string(index=False)
    )


@contextmanager
def told_warnings() -> Iterator[list[str]]:
    """What the block warns of, each once; printed only where the block fails."""
    messages: list[str] = []
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            yield messages
        finally:
            messages += dict.fromkeys(str(warning.message) for warning in told)
            if messages and sys.exc_info()[0] is not None:
                print(warnings_text(messages), file=sys.stderr)


def warnings_text(messages: Sequence[str]) -> str:
    """Warnings as a list under a heading."""
    items = [
        textwrap.fill(
            in_options(message), _LINE, initial_indent="- ", subsequent_indent="  "
        )
        for message in messages
    ]
    return "\n".join(["Warnings", "", *items]) if items else "No warnings."
