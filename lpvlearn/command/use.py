"""``lpvlearn predict`` and ``lpvlearn report``: what a model's file serves for."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from .. import LocalLPVPipeline, fit_report, load
from .judgement import (
    Course,
    course,
    measured_signals,
    signals_of,
    simulation_text,
    telling_apart,
)
from .output import whole_output
from .tables import check_table, read_tables, with_times, write_table


def predict(options: argparse.Namespace) -> None:
    """Run the command: the table of the simulation, and its fit where it is known."""
    estimate = options.initial_state == "estimate"
    if options.output is not None:
        check_table(options.output)
    with course() as told:
        pipeline, table, name, rows = _model_and_table(options, told)
        with told.step("simulation"):
            X, y = signals_of(pipeline, table, name)
            if estimate:
                X, y = measured_signals(pipeline, table, name)
                found = pipeline.predict_with_initial_state(X, y)
            else:
                found = np.asarray(pipeline.predict(X))
            text = [*told.said]
            if y is not None:
                report = fit_report(pipeline, X, y, initial_state=options.initial_state)
                text.append(simulation_text(report, name, options.initial_state))
    kept = [n for n in (pipeline.experiment, pipeline.time) if n is not None]
    simulated = pd.DataFrame(
        np.reshape(found, (len(X), -1)), X.index, list(pipeline.output_names_)
    )
    simulated = pd.concat([rows[list(dict.fromkeys(kept))], simulated], axis=1)
    if options.output is None:
        write_table(simulated, None, options.format)
    else:
        with whole_output(options.output) as part:
            write_table(simulated, part, options.format)
    if told.warned:
        text.append(told.text())
    if text:  # beside the table, not in it
        print("\n\n".join(text), file=sys.stderr)


def report(options: argparse.Namespace) -> None:
    """Run the command: what the fit found, and the simulation of a table."""
    with course() as told:
        pipeline, table, name, _ = _model_and_table(options, told)
        told.add("fit", pipeline.warnings_)
        text, X, y = [pipeline.summary(), *told.said], None, None
        if table is not None:
            with told.step("simulation"):
                X, y = measured_signals(pipeline, table, name)
                found = fit_report(pipeline, X, y, initial_state=options.initial_state)
                text.append(simulation_text(found, name, options.initial_state))
        if options.output is not None:
            with told.step("report", bar=True), whole_output(options.output) as part:
                pipeline.to_html_report(part, X, y, initial_state=options.initial_state)
    print("\n\n".join([*text, told.text()]))


class _Given(NamedTuple):
    """A fitted pipeline, and a table to simulate, if any."""

    pipeline: LocalLPVPipeline
    table: pd.DataFrame | None
    name: str = ""
    rows: Any = None  # with the times as they stand in the file


def _model_and_table(options: argparse.Namespace, told: Course) -> _Given:
    for path in options.table or ():
        check_table(path)
    if not Path(options.model).is_file():
        raise ValueError(f"{options.model}: there is no such file.")
    pipeline = load(options.model)
    if not isinstance(pipeline, LocalLPVPipeline) or not hasattr(pipeline, "lpv_"):
        raise ValueError(
            f"{options.model.name} must hold a fitted LocalLPVPipeline, as lpvlearn "
            f"fit writes. It holds a {type(pipeline).__name__}."
        )
    if options.table is None:
        return _Given(pipeline, None)
    form = options.format
    with told.step("reading of the table"):
        found = read_tables(options.table, form, pipeline.experiment, label=True)
        times = with_times(found.rows, pipeline.time, form.time_unit, found.units)
        told.say(times.told)
    pipeline = telling_apart(pipeline, found.experiment)
    return _Given(pipeline, times.rows, found.name, found.rows)
