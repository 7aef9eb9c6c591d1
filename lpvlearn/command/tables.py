"""Tables in files: csv, parquet and xlsx, and the columns that options name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pandas as pd

# What reads and writes a file, by the end of its name; the packages that serve
_PACKAGES = {".parquet": "pyarrow", ".xlsx": "openpyxl"}

_ENDS = (".csv", ".csv.gz", ".txt", ".tsv", *_PACKAGES)

_SHOWN = 20  # columns that a message lists


class Format(NamedTuple):
    """How the text of a csv file is to be read."""

    separator: str | None = None  # None: a comma, of .tsv a tab
    decimal: str = "."


def check_table(path: Path) -> None:
    """Refuse a file that no reader knows, or whose reader is not installed."""
    end = _end_of(path)
    if end in _PACKAGES:
        try:
            import_module(_PACKAGES[end])
        except ImportError:
            raise ValueError(
                f"{path.name}: files {end} need the package {_PACKAGES[end]}, which is "
                f"not installed. Install it (pip install {_PACKAGES[end]}, or "
                "'lpvlearn[tables]' for all of them), or take a .csv file."
            ) from None


def read_table(path: Path, form: Format) -> pd.DataFrame:
    """A table with text as names of its columns."""
    check_table(path)
    end = _end_of(path)
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file.")
    try:
        if end == ".parquet":
            table = pd.read_parquet(path)
        elif end == ".xlsx":
            table = pd.read_excel(path)
        else:
            separator = _separator(path, form)
            table = pd.read_csv(path, sep=separator, decimal=form.decimal)
    except (ValueError, pd.errors.ParserError, KeyError) as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from None
    if table.empty:
        raise ValueError(f"{path.name} holds no rows.")
    return table.set_axis([str(name).strip() for name in table.columns], axis=1)


def with_times(table: pd.DataFrame, column: str | None) -> pd.DataFrame:
    """The table with dates where its column of the time holds their text."""
    if column in table.columns and not pd.api.types.is_numeric_dtype(table[column]):
        try:
            return table.assign(**{str(column): pd.to_datetime(table[column])})
        except (ValueError, TypeError):
            pass  # the library tells what it is
    return table


def write_table(table: pd.DataFrame, path: Path, form: Format) -> None:
    """Write a table as the end of the file's name tells."""
    end = _end_of(path)
    if end == ".parquet":
        table.to_parquet(path, index=False)
    elif end == ".xlsx":
        table.to_excel(path, index=False)
    else:
        separator = _separator(path, form)
        table.to_csv(path, index=False, sep=separator, decimal=form.decimal)


def columns_of(option: str, text: str | None, table: pd.DataFrame) -> list[str]:
    """The columns that an option names: one, or several with commas between."""
    if text is None:
        return []
    if text in table.columns:  # its name may hold a comma
        return [text]
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in table.columns:
            known = ", ".join(map(repr, table.columns[:_SHOWN]))
            more = ", ..." if len(table.columns) > _SHOWN else ""
            hint = ""
            if len(table.columns) == 1:
                hint = " If that is a whole line, tell --separator."
            raise ValueError(
                f"{option}: the table has no column {name!r}. Its columns are {known}"
                f"{more}.{hint}"
            )
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"{option} must name each column once. Got {text!r}.")
    return names


def _end_of(path: Path) -> str:
    for end in _ENDS:
        if path.name.lower().endswith(end):
            return end
    raise ValueError(
        f"{path.name}: the end of the name must be one of {', '.join(_ENDS)}, which "
        "tells what the file holds."
    )


def _separator(path: Path, form: Format) -> str:
    return form.separator or ("\t" if _end_of(path) == ".tsv" else ",")
