"""The tables of the paper's experiment as text."""

from __future__ import annotations

import pandas as pd

from .experiment import PaperExperiment

Pairs = dict[str, tuple[list[str], list[str]]]  # title -> ours, the paper's


def tables_text(
    experiment: PaperExperiment, tables: dict[str, pd.DataFrame] | None = None
) -> str:
    """The tables of the paper as text, ours beside the published ones.

    Parameters
    ----------
    experiment : PaperExperiment
    tables : dict of str to DataFrame, default=None
        None: those of the experiment.

    Returns
    -------
    str
    """
    tables = experiment.tables if tables is None else tables
    n_points = len(experiment.data.theta2)
    n = experiment.n_realizations
    local = f"{n} noise realization{'s' * (n > 1)} averaged at each angle"
    parts = [
        "Two-link flexible arm, scheduled by cos(theta2). "
        "Left of each pair: this library.\n"
        "Right: the paper, whose arm has other (unpublished) parameters.",
        f"Table 1. Local models by {experiment.method.upper()} on new noise-free data, "
        f"in percent\n({local})\n\n" + _local_text(tables["table1"], n_points),
        f"Table 1, the same by {experiment.other_method.upper()}\n\n"
        + _local_text(tables["table1_other"], n_points),
        "Table 2. H-infinity error of the restructuring, relative to the analytic "
        "model\n(the structure fixes the gain at standstill; the floor is the part of "
        "the error\nthat is due to it, which no parameter can lower)\n\n"
        + _restructuring_text(tables["table2"], n_points),
        "Table 3. FIT of the interpolated matrices, in percent "
        "(d: degree of the polynomial)\n\n" + _interpolation_text(tables["table3"]),
        "Table 4. LPV models along the sweep of theta2, simulated from rest, in percent"
        f"\n(degree {experiment.degree}; the paper's is 2)\n\n"
        + _validation_text(tables["table4"]),
        "Computation time in seconds\n\n" + _timing_text(tables["timing"]),
    ]
    return "\n" + "\n\n\n".join(parts)


def _local_text(table: pd.DataFrame, n_points: int) -> str:
    """Table 1: a row for each angle, each figure beside the paper's."""
    # A VAF of 100.00 would hide that the fit is not perfect.
    pairs = _pairs(table, ["metric", "output"], {"VAF": "{:.4f}"}, "{:.2f}")
    return _paired_text("theta2", _angles(n_points), pairs)


def _restructuring_text(table: pd.DataFrame, n_points: int) -> str:
    """Table 2: a row for each angle."""
    columns = {"theta2": _angles(n_points)} | {
        title: _cells(table[name], "{:.2e}")
        for title, name in (
            ("ours", "relative_error"),
            ("floor", "floor"),
            ("paper", "paper"),
        )
    }
    return aligned_text([[name, *cells] for name, cells in columns.items()])


def _interpolation_text(table: pd.DataFrame) -> str:
    """Table 3: a row for each model and degree."""
    labels = table[["model", "degree"]].drop_duplicates().itertuples(index=False)
    pairs = _pairs(table, ["matrix"], {}, "{:.1f}")
    return _paired_text("model", [f"{m}, d = {d}" for m, d in labels], pairs)


def _validation_text(table: pd.DataFrame) -> str:
    """Table 4: a row for each model."""
    pairs = _pairs(table, ["metric", "output"], {}, "{:.1f}")
    return _paired_text("model", table["model"].unique().tolist(), pairs)


def _timing_text(table: pd.DataFrame) -> str:
    """A row for each step."""
    return aligned_text(
        [["step", *table["step"]], ["seconds", *_cells(table["seconds"], "{:.1f}")]]
    )


def _pairs(
    table: pd.DataFrame, keys: list[str], ours: dict[str, str], form: str
) -> Pairs:
    """Cells of ours and of the paper, by the values of the keys.

    Numbers have the form `form`, ours that of `ours` where it has the first key.
    """
    return {
        " ".join(key): (
            _cells(rows["ours"], ours.get(key[0], form)),
            _cells(rows["paper"], form),
        )
        for key, rows in table.groupby(keys, sort=False)
    }


def _paired_text(heading: str, labels: list[str], pairs: Pairs) -> str:
    """Lines with ours and the paper's side by side under a common title."""
    columns = [["", heading, *labels]]
    for title, (ours, paper) in pairs.items():
        columns += [["", "ours", *ours], [title, "paper", *paper]]
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


def _angles(n_points: int) -> list[str]:
    return [f"{i + 1} pi/{n_points + 1}" for i in range(n_points)]
