"""``lpvlearn fit``: a table to a model, a report, tables and figures."""

from __future__ import annotations

import argparse
from typing import Any

import pandas as pd

from .. import (
    AutoLPV,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    SubspaceLTI,
    fit_report,
    save,
    split_levels,
)
from .judgement import course, measured_signals, simulation_text, telling_apart
from .output import whole_folder
from .structure_file import read_structure
from .tables import EXPERIMENT, check_table, columns_of, read_tables, with_times

INTERPOLATIONS = {
    "auto": AutoLPV,
    "polynomial": PolynomialLPV,
    "rational": RationalLPV,
    "spline": SplineLPV,
}

_SEVERAL = ("inputs", "scheduling")  # roles of several columns
_SINGLE = ("experiment", "time", "operating_point")


def fit(options: argparse.Namespace) -> None:
    """Run the command."""
    if options.degree is not None and options.interpolation != "polynomial":
        raise ValueError("--degree is that of --interpolation polynomial.")
    for path in [*options.table, *(options.validation or ())]:
        check_table(path)
    form, start = options.format, options.initial_state
    with (
        whole_folder(options.output, options.overwrite) as folder,
        course(verbose=not options.quiet) as told,
    ):
        with told.step("reading of the table"):
            label = options.experiment is None
            judged = found = read_tables(
                options.table, form, options.experiment, label=label
            )
            options.experiment, table = found.experiment, found.rows
            outputs = columns_of("--outputs", options.outputs, table)
            roles = _roles(options, table, outputs)
            if options.levels is not None:
                table = _held(table, roles, options.levels)
                judged = found = found._replace(
                    rows=table, experiment=roles["experiment"]
                )
            features = _features(table, roles, outputs)
            structure, units = None, found.units
            if options.structure is not None:
                given = _all_of(roles, but="inputs")
                inputs = roles["inputs"] or [f for f in features if f not in given]
                structure, own = read_structure(
                    options.structure, len(inputs), len(outputs)
                )
                units = units | own
            units = {name: u for name, u in units.items() if name != roles["time"]}
            pipeline = _pipeline(options, roles, structure).set_params(
                units=units or None
            )
            time, unit = roles["time"], form.time_unit
            table, said = with_times(table, time, unit, found.units)
            told.say(said)
        with told.step("fit", bar=True):
            pipeline.fit(table[features], table[outputs])
        if options.validation is not None:
            with told.step("reading of the validation"):
                judged = read_tables(
                    options.validation, form, found.experiment, label=True
                )
                table, said = with_times(judged.rows, time, unit, judged.units)
                told.say(said)
        simulator = telling_apart(pipeline, judged.experiment)
        with told.step("simulation"):
            X, y = measured_signals(simulator, table, judged.name)
            report = fit_report(simulator, X, y, initial_state=start)
        with told.step("report", bar=True):
            pipeline.report_.to_csv(folder / "points.csv")
            pipeline.parameter_report_.to_csv(folder / "parameters.csv")
            report.to_csv(folder / "fit.csv", index=False)
            simulator.to_html_report(
                folder / "report.html",
                X,
                y,
                initial_state=start,
                title=f"LPV model of {found.name}",
                figures=folder / "figures",
            )
            save(pipeline, folder / "model.zip")
        simulated = simulation_text(report, judged.name, start)
        text = "\n\n".join([pipeline.summary(), *told.said, simulated, told.text()])
        (folder / "report.txt").write_text(text + "\n", encoding="utf-8")
    if not options.quiet:
        print(
            f"{text}\n\nThe report, tables, figures and model are in {options.output}"
        )


def _roles(
    options: argparse.Namespace, table: pd.DataFrame, outputs: list[str]
) -> dict[str, Any]:
    """Columns by role, each of one role; None where a role has none."""
    roles: dict[str, Any] = {}
    taken = dict.fromkeys(outputs, "--outputs")
    for role in (*_SEVERAL, *_SINGLE):
        option = "--" + role.replace("_", "-")
        names = columns_of(option, getattr(options, role), table)
        if role in _SINGLE and len(names) > 1:
            raise ValueError(f"{option} must name one column. Got {len(names)}.")
        for name in names:
            # one column may be the experiment, the scheduling variable and the point
            if role in ("inputs", "time") and name in taken or name in outputs:
                raise ValueError(f"{option}: column {name!r} is in {taken[name]}, too.")
            taken[name] = option
        roles[role] = None if not names else names if role in _SEVERAL else names[0]
    return roles


def _held(
    table: pd.DataFrame, roles: dict[str, Any], tol: float | bool
) -> pd.DataFrame:
    """The rows at levels, each level an experiment; its column joins the roles."""
    if roles["scheduling"] is None:
        raise ValueError(
            "--levels are those of --scheduling, which names nothing: name the column "
            "that was held at levels, or leave --levels out."
        )
    numbers = split_levels(
        table,
        roles["scheduling"],
        experiment=roles["experiment"],
        tol=None if tol is True else tol,
    )
    labels = pd.Series(numbers, table.index).map("level {}".format)
    if roles["experiment"] is not None:
        labels = table[roles["experiment"]].astype(str) + ", " + labels
    others = _all_of(roles | {"experiment": None})
    if roles["experiment"] in (None, *others):  # whose values have to stay
        roles["experiment"] = EXPERIMENT
        while roles["experiment"] in table.columns:
            roles["experiment"] += "_"
    return table.assign(**{roles["experiment"]: labels})[numbers >= 0]


def _all_of(roles: dict[str, Any], but: str = "") -> list[str]:
    """The columns of all roles."""
    found: list[str] = []
    for role, names in roles.items():
        if names is not None and role != but:
            found += names if role in _SEVERAL else [names]
    return found


def _features(
    table: pd.DataFrame, roles: dict[str, Any], outputs: list[str]
) -> list[str]:
    """Columns of X: those with a role; where no inputs are named, the others, too."""
    named = _all_of(roles)
    return [
        name
        for name in table.columns
        if name not in outputs and (roles["inputs"] is None or name in named)
    ]


def _pipeline(
    options: argparse.Namespace, roles: dict[str, Any], structure: Any
) -> LocalLPVPipeline:
    form = INTERPOLATIONS[options.interpolation]
    order = "auto" if options.order is None else options.order
    return LocalLPVPipeline(
        SubspaceLTI(order, missing=options.missing),
        None if structure is None else GrayBoxRestructurer(structure),
        form() if options.degree is None else PolynomialLPV(options.degree),
        sampling_time=options.sampling_time,
        efficient=not options.hinf,
        n_jobs=options.jobs,
        verbose=0 if options.quiet else 1,
        **roles,
    )
