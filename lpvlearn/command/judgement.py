"""How good a model is, as text: what the fit found, and a simulation of a table."""

from __future__ import annotations

import sys
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from typing import NamedTuple

import numpy as np
import pandas as pd

from .. import LocalLPVPipeline, readable_report
from ..pipeline.running.stopwatch import Stopwatch
from .ending import in_options

_LINE = 88  # characters


class Signals(NamedTuple):
    """A table as a pipeline takes it."""

    X: pd.DataFrame
    y: pd.DataFrame | None  # where the outputs were measured


def telling_apart(pipeline: LocalLPVPipeline, column: str | None) -> LocalLPVPipeline:
    """A fitted pipeline, to which `column` tells the experiments of tables apart.

    One that was fitted to a single record has no such column, and simulates several as
    one record.
    """
    if column is None or column == pipeline.experiment:
        return pipeline
    found = copy(pipeline).set_params(experiment=column)
    found.feature_names_in_ = np.append(pipeline.feature_names_in_, column)
    found.n_features_in_ += 1
    return found


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


class Course:
    """The steps of a command: what lasts is told at once, warnings at the end."""

    def __init__(self, verbose: bool) -> None:
        self._watch = Stopwatch(verbose=verbose)
        self._told: dict[str, list[str]] = {}  # by step
        self.said: list[str] = []  # what is no warning, each once

    @contextmanager
    def step(self, name: str, *, bar: bool = False) -> Iterator[None]:
        """Collect what the block warns of; `bar` as of `Stopwatch.step`."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                with self._watch.step(name, bar=bar):
                    yield
            finally:
                self.add(name, [str(warning.message) for warning in caught])

    def add(self, name: str, messages: Sequence[str]) -> None:
        """Let the step have warned of these; each counts once."""
        known = [message for told in self._told.values() for message in told]
        new = [m for m in dict.fromkeys(messages) if m not in known]
        if new:
            self._told.setdefault(name, []).extend(new)

    def say(self, text: str) -> None:
        """Keep a text, if it is one, that stands before a simulation."""
        if text and text not in self.said:
            self.said.append(text)

    @property
    def warned(self) -> bool:
        """Whether a step did."""
        return bool(self._told)

    def text(self) -> str:
        """The warnings as lists, under the step that gave them."""
        lines = []
        for name, messages in self._told.items():
            lines += ["", f"Warnings of the {name}", ""]
            lines += [
                textwrap.fill(
                    in_options(message),
                    _LINE,
                    initial_indent="- ",
                    subsequent_indent="  ",
                )
                for message in messages
            ]
        return "\n".join(lines[1:]) or "No warnings."


@contextmanager
def course(*, verbose: bool = True) -> Iterator[Course]:
    """The course of a command, whose warnings are printed here where it fails."""
    found = Course(verbose)
    try:
        yield found
    except Exception:
        if found.warned:
            print(found.text(), file=sys.stderr)
        raise
