"""Tables in files, as loggers and spreadsheets write them, to one table of rows."""

from __future__ import annotations

import csv
import difflib
import gzip
import itertools
import re
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

# What reads and writes a file, by the end of its name; the packages that serve
_PACKAGES = {".parquet": "pyarrow", ".xlsx": "openpyxl"}

_ENDS = (".csv", ".csv.gz", ".txt", ".tsv", ".dat", ".log", *_PACKAGES)

_SHOWN = 20  # columns that a message lists

_HEAD = 200  # lines that are looked at for the layout of a file

# Share of these that have as many cells as most, where a separator is right
_EVEN = 0.8

_BLANKS = r"\s+"

# In this order: a file with semicolons has decimal commas, one with commas has blanks
# in its names.
_SEPARATORS = ("\t", ";", ",", "|", _BLANKS)

_COMMA_NUMBER = r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*"

_NO_UNIT = ("", "-", "1")

_NOTHING = ("", "nan", "na", "n/a", "null", "none", "-nan", "inf", "-inf")

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}

# Other words for them, as tables have them
_UNIT_WORDS = {
    **dict.fromkeys(("sec", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("μs", "usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours"), "h"),
}

_UNIT_IN_NAME = r"(?:[\[(/]\s*|_)([^\W_]+)\s*[\])]?$"  # t [ms], t (ms), t/ms, t_ms

_LATEST = 1e11  # numbers above are seconds beyond the year 5000: rather parts of them

# Parts of seconds since 1970 where they make dates from 1990 until tomorrow: others
# are those of a clock that began when it was switched on, as clocks of computers do.
_SINCE_1970 = ("ms", "us", "ns")
_YEAR_1990, _DAY = 631152000.0, 86400.0  # s

_HOURS = 24.0  # of a day

EXPERIMENT = "experiment"  # column that tells the tables apart, where none is named


class Format(NamedTuple):
    """How the text of a file is to be read; None is found in the file."""

    separator: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    time_unit: str | None = None  # of numbers; None: seconds


class Header(NamedTuple):
    """What stands above the samples."""

    names: list[str]
    units: dict[str, str]
    first: int  # row of the first sample


class Record(NamedTuple):
    """What stands in one file or sheet."""

    label: str
    rows: pd.DataFrame
    units: dict[str, str]


class Tables(NamedTuple):
    """What stands in all of them."""

    rows: pd.DataFrame
    units: dict[str, str]
    experiment: str | None  # column that tells experiments apart, where there is one
    name: str


class Times(NamedTuple):
    """A table with seconds or dates in its column of the time."""

    rows: pd.DataFrame
    told: str = ""  # what they were taken for, where nobody said so


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


def read_tables(
    paths: Sequence[Path], form: Format, experiment: str | None, *, label: bool
) -> Tables:
    """The rows of several files, with text as names of the columns.

    More than one file, or sheet of a workbook, are as many experiments. Their names
    stand in the column `experiment`, before its own values where it has some; where
    it is not there, it is made of them if `label` allows.
    """
    records = [record for path in paths for record in _records(path, form)]
    if experiment is None and label and len(records) > 1:
        experiment = EXPERIMENT
    shared = list(records[0].rows.columns)
    for record in records[1:]:
        shared = [name for name in shared if name in record.rows.columns]
    left = {name for r in records for name in r.rows.columns} - set(shared)
    if left:
        shown = ", ".join(map(repr, sorted(left)))
        warnings.warn(
            f"Columns are left out that not every table has: {shown}. Add them to the "
            "others where they are needed.",
            stacklevel=2,
        )
    rows, units = [], dict[str, str]()
    labels = _different([record.label for record in records])
    for name, record in zip(labels, records, strict=True):
        part, units = record.rows[shared], record.units | units
        if experiment is not None and len(records) > 1 and experiment in shared:
            values = name + ": " + part[experiment].astype(str)
            part = part.assign(**{experiment: values})
        elif experiment is not None and label and experiment not in shared:
            part = part.assign(**{experiment: name})
        rows.append(part)
    name = paths[0].name if len(paths) == 1 else f"{len(paths)} tables"
    return Tables(pd.concat(rows, ignore_index=True), units, experiment, name)


def _records(path: Path, form: Format) -> list[Record]:
    check_table(path)
    end = _end_of(path)
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file.")
    try:
        if end == ".parquet":
            rows = pd.read_parquet(path)
            if rows.index.names != [None]:
                rows = rows.reset_index()
            found = [Record(path.name, rows, {})]
        elif end == ".xlsx":
            found = _sheets(path)
        else:
            found = [_text_table(path, form)]
    except (ValueError, LookupError, pd.errors.ParserError, csv.Error) as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from None
    stem = path.name[: -len(end)]
    named = []
    for label, rows, units in found:
        rows = rows.set_axis([str(name).strip() for name in rows.columns], axis=1)
        label = stem if len(found) == 1 else f"{stem} {label}"
        named.append(Record(label, _without_counters(rows), units))
    if not named or any(record.rows.empty for record in named):
        raise ValueError(f"{path.name} holds no rows.")
    return named


def _without_counters(rows: pd.DataFrame) -> pd.DataFrame:
    """Without columns that have no name and are empty, or number the rows."""
    left = []
    for place, (name, column) in enumerate(rows.items()):
        nameless = str(name) in ("", f"Unnamed: {place}")
        if nameless and (
            column.isna().all()
            or (
                pd.api.types.is_integer_dtype(column) and (column.diff()[1:] == 1).all()
            )
        ):
            left.append(place)
    return rows.iloc[:, [k for k in range(rows.shape[1]) if k not in left]]


def _different(labels: Sequence[str]) -> list[str]:
    """Labels, numbered where they are equal."""
    counts = {label: 0 for label in labels}
    found = []
    for label in labels:
        counts[label] += 1
        found.append(label if counts[label] == 1 else f"{label} ({counts[label]})")
    return found


# -- the layout of a file ----------------------------------------------------------


def _text_table(path: Path, form: Format) -> Record:
    """A file of text: its encoding, separator, header and decimal mark are found."""
    encoding = form.encoding or _encoding(path)
    with _opened(path, encoding) as file:
        lines = list(itertools.islice(file, _HEAD))
    separator, cells = _separated(lines, form.separator)
    names, units, first = _header(cells, commas=separator != ",")
    options: dict[str, Any] = {
        "sep": separator,
        "header": None,
        "names": names,
        "index_col": False,
        "skiprows": first,
        "encoding": encoding,
        "skipinitialspace": True,
    }
    rows = pd.read_csv(path, decimal=form.decimal or ".", **options)
    if form.decimal is None and separator != "," and _has_commas(rows):
        rows = pd.read_csv(path, decimal=",", **options)
    return Record(path.name, rows, units)


def _has_commas(rows: pd.DataFrame) -> bool:
    text = rows.select_dtypes(exclude="number")
    return any(
        column.astype(str).str.fullmatch(_COMMA_NUMBER).any()
        for _, column in text.items()
    )


def _opened(path: Path, encoding: str) -> Any:
    if path.name.lower().endswith(".gz"):
        return gzip.open(path, "rt", encoding=encoding, newline="")
    return path.open(encoding=encoding, newline="")


def _encoding(path: Path) -> str:
    opened = gzip.open if path.name.lower().endswith(".gz") else open
    with opened(path, "rb") as file:
        start = file.read(2)
    if start in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        with _opened(path, "utf-8-sig") as file:
            for _ in file:
                pass
    except UnicodeDecodeError:
        return "cp1252"  # Windows of Western Europe and America
    return "utf-8-sig"


def _separated(
    lines: Sequence[str], separator: str | None
) -> tuple[str, list[list[str]]]:
    """The separator, given or the first that makes a table of lines; its cells."""
    for mark in (separator,) if separator else _SEPARATORS:
        cells = _cells(lines, mark)
        counts = [len(row) for row in cells[len(cells) // 2 :] if row]
        width = _width(cells)
        if width > 1 and counts.count(width) >= _EVEN * len(counts):
            return mark, cells
    return separator or ",", _cells(lines, separator or ",")


def _cells(lines: Sequence[str], separator: str) -> list[list[str]]:
    if separator == _BLANKS:
        lines, separator = [line.strip() for line in lines], " "
    if len(separator) > 1:
        return [re.split(separator, line) for line in lines]
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    return [[cell.strip() for cell in row] for row in reader]


def _width(cells: Sequence[Sequence[Any]]) -> int:
    """Cells of most rows: of the later half, where no title stands any more."""
    counts = [len(row) for row in cells[len(cells) // 2 :] if row]
    return max(set(counts), key=counts.count, default=0)


def _header(cells: Sequence[Sequence[Any]], *, commas: bool) -> Header:
    """Where names, units and samples stand; `commas` may be decimal marks."""
    width, kinds = _width(cells), [[_kind(c, commas) for c in row] for row in cells]
    full = [k for k, row in enumerate(kinds) if len(row) == width]
    place = next((k for k in full if 2 * kinds[k].count("") < width), None)
    if place is None:
        raise ValueError("it must hold a table with names above its columns.")
    row, below = cells[place], [k for k in full if k > place][:2]
    if kinds[place].count("number") > kinds[place].count("text"):
        names = [f"c{k + 1}" for k in range(width)]
        warnings.warn(
            f"The columns have no names: use {names[0]} to {names[-1]}, or give them "
            "names in the first line of the file.",
            stacklevel=2,
        )
        return Header(names, {}, place)
    plain = ["" if cell is None else str(cell) for cell in row]
    plain[0] = plain[0].lstrip("#% ")  # a comment for other programs
    plain = [name or f"Unnamed: {k}" for k, name in enumerate(plain)]
    names = [  # as pandas calls those of one name
        f"{name}.{plain[:k].count(name)}" if name in plain[:k] else name
        for k, name in enumerate(plain)
    ]
    if len(below) == 2:
        one, two = (kinds[k] for k in below)
        told = [str(cell or "").strip("[]() ") for cell in cells[below[0]]]
        pairs = zip(names, told, strict=True)
        units = {name: unit for name, unit in pairs if unit not in _NO_UNIT}
        numbers = {unit for unit, k in zip(told, one, strict=True) if k == "number"}
        if (
            ("text", "number") in zip(one, two, strict=True)
            and numbers <= {"1"}  # unless they are a sample
            and one.count("number") <= len(units)
        ):
            return Header(names, units, below[0] + 1)
    return Header(names, {}, place + 1)


def _kind(cell: Any, commas: bool) -> str:
    """What a cell holds: a "number" (or a date of a workbook), "text" or nothing."""
    if not isinstance(cell, str):
        return "" if cell is None else "number"
    if cell.lower() in _NOTHING:
        return ""
    try:
        float(cell.replace(",", ".") if commas else cell)
    except ValueError:
        return "text"
    return "number"


def _sheets(path: Path) -> list[Record]:
    """The sheets with the columns of the largest; others hold something else."""
    found = []
    for sheet, raw in pd.read_excel(path, sheet_name=None, header=None).items():
        raw = raw.dropna(axis=0, how="all").dropna(axis=1, how="all")
        cells = raw.head(_HEAD).astype(object).where(raw.head(_HEAD).notna(), None)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a sheet without names is no table
            try:
                names, units, first = _header(cells.values.tolist(), commas=False)
            except (ValueError, UserWarning):
                continue
        rows = raw.iloc[first:].set_axis(names, axis=1).infer_objects()
        found.append(Record(str(sheet), rows, units))
    if not found:
        raise ValueError("a sheet must hold a table with names above its columns.")
    largest = max(found, key=lambda record: record.rows.size)
    kept = [r for r in found if set(r.rows.columns) == set(largest.rows.columns)]
    left = [r.label for r in found if set(r.rows.columns) != set(largest.rows.columns)]
    if left:
        warnings.warn(
            f"Sheets of {path.name} are left out: {', '.join(map(repr, left))}. Give "
            f"them the columns of {largest.label!r} to have them read as experiments.",
            stacklevel=2,
        )
    return kept


# -- what stands in a table --------------------------------------------------------


def with_times(
    table: pd.DataFrame,
    column: str | None,
    unit: str | None,
    units: Mapping[str, str],
) -> Times:
    """The times of a table, in the column of that name: numbers of a unit, or dates.

    The unit is the one given, else that of `units`, by name, or of the column's name.
    """
    if column is None or column not in table.columns:
        return Times(table)
    values, told = table[column], ""
    if pd.api.types.is_numeric_dtype(values):
        own = None if unit is not None else _unit_of(column, units)
        if own not in (None, "s"):
            told = f"Times in column {column!r} are taken as {own}, as the table tells."
        unit, since = unit or own, _unit_since_1970(values)
        if since is not None and unit in (None, since):
            values = pd.to_datetime(values, unit=since)
            if own is not None or unit is None:
                told = (
                    f"Times in column {column!r} are taken as {since} since 1970, "
                    f"from {values.min()}; --time-unit tells otherwise."
                )
        elif unit is not None:
            values = values * TIME_UNITS[unit]
        elif _LATEST <= values.abs().max() < np.inf:
            raise ValueError(
                f"Times in column {column!r} must have a unit: they reach "
                f"{values.abs().max():.4g}, which as seconds is beyond the year 5000, "
                f"and as {', '.join(_SINCE_1970)} since 1970 is no date from 1990 "
                "until now. Give it as --time-unit."
            )
    else:
        with suppress(ValueError, TypeError, OverflowError):  # the library tells why
            values = _dates(values)
    return Times(table.assign(**{column: values}), told)


def _unit_of(column: str, units: Mapping[str, str]) -> str | None:
    """The unit of time that a row of units tells, or the end of the column's name."""
    in_name = re.search(_UNIT_IN_NAME, column)
    text = units.get(column, in_name[1] if in_name else "")
    unit = text.casefold().strip(".")
    unit = _UNIT_WORDS.get(unit, unit)
    if unit in TIME_UNITS:
        return unit
    if column in units:
        warnings.warn(
            f"Times in column {column!r} are read as seconds: their unit {text!r} is "
            f"none of {', '.join(TIME_UNITS)}. Give --time-unit if they are others.",
            stacklevel=3,
        )
    return None


def _unit_since_1970(values: pd.Series) -> str | None:
    """Of what numbers make dates since 1970; None where these cannot be."""
    first, last = float(values.min()), float(values.max())
    for unit in _SINCE_1970:
        if (
            first * TIME_UNITS[unit] > _YEAR_1990
            and last * TIME_UNITS[unit] < time.time() + _DAY
        ):
            return unit
    return None


def _dates(values: pd.Series) -> pd.Series:
    """Dates of text: 2026-03-04, 04.03.2026 and, where the days tell, 25/03/2026."""
    if pd.api.types.is_datetime64_any_dtype(values):
        return values
    text = (
        values.astype(str)
        .str.strip()
        .str.replace(r"(:\d\d),(\d)", r"\1.\2", regex=True)
    )
    # with a decimal, two fields are minutes and seconds
    short = text.str.fullmatch(r"\d+:\d\d(\.\d+)?") | values.isna()
    if short.all() and text.str.contains(".", regex=False).any():
        fields = text.where(values.notna()).str.split(":", expand=True).astype(float)
        return pd.to_datetime(60.0 * fields[0] + fields[1], unit="s")
    if short.all() and values.notna().any():
        warnings.warn(
            f"Times as {text[values.notna()].iloc[0]!r} are read as hours and minutes. "
            "If they are minutes and seconds, give hours as well: 00:00:07.",
            stacklevel=2,
        )
    clock = text.str.fullmatch(r"\d+(:\d\d){1,2}(\.\d+)?") | values.isna()
    hours = text.str.extract(r"^(\d+):", expand=False).astype(float)
    if clock.all() and (hours >= _HOURS).any():  # what has elapsed, no time of day
        text = (text + ":00" if short.all() else text).where(values.notna())
        return pd.Timestamp(0) + pd.to_timedelta(text)
    first = text.str.extract(r"^(\d{1,2})[./]", expand=False).astype(float)
    by_day = bool(text.str.match(r"^\d+\.\d+\.").any() or (first > 12).any())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of formats that are guessed
        for form in (None, "ISO8601"):
            with suppress(ValueError):
                return _utc(text, form, by_day)
        return _utc(text, "mixed", by_day)


def _utc(text: pd.Series, form: str | None, by_day: bool) -> pd.Series:
    dates = pd.to_datetime(text, format=form, dayfirst=by_day, utc=True)
    return dates.dt.tz_localize(None)


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
            near = _nearest(name, list(table.columns))
            hint = f" Is it {near!r}?" if near else ""
            if len(table.columns) == 1:
                hint = " If that is a whole line, tell --separator."
            raise ValueError(
                f"{option}: the table has no column {name!r}. Its columns are {known}"
                f"{more}.{hint}"
            )
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"{option} must name each column once. Got {text!r}.")
    return names


def _nearest(name: str, columns: Sequence[str]) -> str | None:
    """The column that was meant: it holds the name, or is written nearly so."""
    holding = [c for c in columns if name.lower() in c.lower()]
    return next(iter(holding or difflib.get_close_matches(name, columns, 1)), None)


# -- writing -----------------------------------------------------------------------


def write_table(table: pd.DataFrame, path: Path | None, form: Format) -> None:
    """Write a table as the end of the file's name tells, None to standard output."""
    end = ".csv" if path is None else _end_of(path)
    if end == ".parquet":
        table.to_parquet(path, index=False)
    elif end == ".xlsx":
        table.to_excel(path, index=False)
    else:
        separator = form.separator or ("\t" if end == ".tsv" else ",")
        table.to_csv(
            path or sys.stdout, index=False, sep=separator, decimal=form.decimal or "."
        )


def _end_of(path: Path) -> str:
    for end in _ENDS:
        if path.name.lower().endswith(end):
            return end
    raise ValueError(
        f"{path.name}: the end of the name must be one of {', '.join(_ENDS)}, which "
        "tells what the file holds."
    )
