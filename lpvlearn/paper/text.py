"""The tables of the paper's experiment as text."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from .experiment import PaperExperiment


def tables_text(experiment: PaperExperiment) -> str:
    """The tables of the paper as text, ours beside the published ones."""
    tables = experiment.tables
    n_points = len(experiment.data.theta2)
    angles = [f"{i + 1} pi/{n_points + 1}" for i in range(n_points)]
    n = experiment.n_realizations
    local = f"{n} noise realization{'s' * (n > 1)} averaged at each angle"
    fits = ["metric", "output"]
    interpolated = tables["table3"][["model", "degree"]].drop_duplicates()
    parts = [
        "Two-link flexible arm, scheduled by cos(theta2). "
        "Left of each pair: this library.\n"
        "Right: the paper, whose arm has other (unpublished) parameters.",
        f"Table 1. Local models by {experiment.method.upper()} on new noise-free data, "
        f"in percent\n({local})\n\n"
        + _paired_text(tables["table1"], "theta2", angles, fits, "{:.2f}"),
        f"Table 1, the same by {experiment.other_method.upper()}\n\n"
        + _paired_text(tables["table1_other"], "theta2", angles, fits, "{:.2f}"),
        "Table 2. H-infinity error of the restructuring, relative to the analytic "
        "model\n(the structure fixes the gain at standstill; the floor is the part of "
        "the error\nthat is due to it, which no parameter can lower)\n\n"
        + _restructuring_text(tables["table2"], angles),
        "Table 3. FIT of the interpolated matrices, in percent "
        "(d: degree of the polynomial)\n\n"
        + _paired_text(
            tables["table3"],
            "model",
            [f"{m}, d = {d}" for m, d in interpolated.itertuples(index=False)],
            ["matrix"],
        ),
        "Table 4. LPV models along the sweep of theta2, simulated from rest, in percent"
        f"\n(degree {experiment.degree}; the paper's is 2)\n\n"
        + _paired_text(
            tables["table4"], "model", tables["table4"]["model"].unique(), fits
        ),
        "Beyond the paper: the same local models in the momentum basis, interpolated "
        "by AutoLPV,\nalong sweeps of theta2, simulated from rest, in percent\n\n"
        + _momentum_text(tables["momentum"]),
        "Computation time in seconds\n\n" + _timing_text(tables["timing"]),
    ]
    return "\n" + "\n\n\n".join(parts)


def _restructuring_text(table: pd.DataFrame, angles: list[str]) -> str:
    """Table 2: a row for each angle."""
    titles = {"ours": "relative_error", "floor": "floor", "paper": "paper"}
    columns = [
        [title, *_cells(table[name], "{:.2e}")] for title, name in titles.items()
    ]
    return aligned_text([["theta2", *angles], *columns])


def _momentum_text(table: pd.DataFrame) -> str:
    """A row for each sweep."""
    wide = table.pivot(index="sweep", columns=["metric", "output"], values="ours")
    wide = wide.loc[table["sweep"].unique()]
    columns = [[" ".join(key), *_cells(wide[key], "{:.1f}")] for key in wide]
    return aligned_text([["sweep", *wide.index], *columns])


def _timing_text(table: pd.DataFrame) -> str:
    """A row for each step."""
    return aligned_text(
        [["step", *table["step"]], ["seconds", *_cells(table["seconds"], "{:.1f}")]]
    )


def _paired_text(
    table: pd.DataFrame,
    heading: str,
    labels: Sequence[str],
    keys: list[str],
    form: str = "{:.1f}",
) -> str:
    """A row for each label; ours and the paper's by the keys, under a common title."""
    columns = [["", heading, *labels]]
    for key, rows in table.groupby(keys, sort=False):
        # With two digits, a VAF of 100.00 would hide that the fit is not perfect.
        fine = form == "{:.2f}" and key[0] == "VAF"
        columns += [
            ["", "ours", *_cells(rows["ours"], "{:.4f}" if fine else form)],
            [" ".join(key), "paper", *_cells(rows["paper"], form)],
        ]
    return aligned_text(columns)


def aligned_text(columns: list[list[str]]) -> str:
    """Lines of columns: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in columns]
    lines = []
    for row in zip(*columns, strict=True):
        cells = [row[0].ljust(widths[0])]
        cells += [c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _cells(values: pd.Series, form: str) -> list[str]:
    return ["-" if pd.isna(value) else form.format(value) for value in values]
