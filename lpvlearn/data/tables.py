"""Tables, whatever holds them: their columns, found by name, and their numbers.

A table is a DataFrame of pandas or polars, or an array, of one row per sample. A column
is named by its name, else by a level of the index, else by its position.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.utils.validation import check_array

from ..validation import (
    all_finite,
    complex_array,
    first_not_a_number,
    is_whole,
    real_array,
    shown,
    squarable,
)
from .text_numbers import reading_of

Array = NDArray[np.float64]

_ALIKE = 0.6  # likeness (difflib's, its default) from which a name may have been meant

# What to do about an array of so many dimensions
_RESHAPED = {
    1: "Reshape your data: `.reshape(-1, 1)` makes a single column of it, "
    "`.reshape(1, -1)` a single sample.",
    3: "Several experiments stand below each other in one table, with a column that "
    "tells them apart: name it as `experiment`.",
}

_N_SHOWN = 10  # names in an error message, lest a wide table fills the screen


@dataclass(frozen=True)
class Column:
    """One column of a table, or one level of its index."""

    name: Hashable  # its position in an array without names
    values: Any  # as they stand in the table
    position: int | None = None  # None for a level of the index

    def numbers(self, argument: str) -> NDArray[np.float64]:
        """Values as floats, missing ones as NaN; `argument` names the table in errors.

        Raises a ValueError where one is not a real number.
        """
        series = self.values
        if not isinstance(series, pd.Series):
            series = pd.Series(np.asarray(series))
        kind = getattr(series.dtype, "kind", "O")
        if kind == "c":
            raise ValueError(
                f"Complex data not supported: column {self.name!r} of {argument}."
            )
        imaginary = kind == "O" and any(map(np.iscomplexobj, series))
        if kind not in "mM" and not imaginary:  # dates would be nanoseconds
            try:
                return series.to_numpy(dtype=np.float64, na_value=np.nan)
            except (TypeError, ValueError, ArithmeticError):
                pass
        first = 0 if kind in "mM" else first_not_a_number(series) or 0
        remedy = "Mend the value, or leave the column out."
        if argument == "X":
            remedy = (
                "Give a column of labels or times its role, or list the numeric "
                "columns in `inputs`."
            )
        got = series.iloc[first]
        raise ValueError(
            f"Column {self.name!r} of {argument} must hold numbers. Got {shown(got)} "
            f"at row {first}. {reading_of(got) or remedy}"
        )

    def labels(self, rows: Sequence[int]) -> list[Hashable]:
        """Values at some rows as plain Python objects."""
        return [as_scalar(value) for value in pd.Series(self.values).iloc[list(rows)]]


def as_scalar(value: Any) -> Hashable:
    """A NumPy scalar as a plain Python one."""
    return value.item() if isinstance(value, np.generic) else value


def did_you_mean(key: Any, names: Sequence[Any]) -> str:
    """A suggestion for a misspelt name, or nothing."""
    lower = {str(name).lower(): name for name in names if name is not None}
    close = get_close_matches(str(key).lower(), lower, n=1, cutoff=_ALIKE)
    return f" Did you mean {lower[close[0]]!r}?" if close else ""


def listed_names(names: Sequence[Any]) -> str:
    """The first of the names, for a message."""
    return ", ".join(map(repr, names[:_N_SHOWN])) + ", ..." * (len(names) > _N_SHOWN)


def as_list(keys: Any, names: Collection[Hashable] = ()) -> list[Any]:
    """The columns with a role, as a list; empty for None.

    A tuple that is one of the `names` is one, as those of a MultiIndex are.

    >>> as_list(("force", "N")), as_list(("force", "N"), [("force", "N"), "time"])
    (['force', 'N'], [('force', 'N')])
    """
    if keys is None:
        return []
    if isinstance(keys, (np.ndarray, pd.Index, pd.Series, pd.DataFrame)):
        return np.ravel(keys).tolist()
    if isinstance(keys, tuple):
        with suppress(TypeError):  # of an array in it, which is no name
            keys = [keys] if keys in {*names} else keys
    return list(keys) if isinstance(keys, (list, tuple)) else [keys]


def is_table(X: Any) -> bool:
    """Whether `X` has named columns, as a pandas or polars DataFrame has.

    A ValueError for a table or record batch of pyarrow.
    """
    if hasattr(X, "column_names") and hasattr(X, "to_pandas"):
        raise ValueError(
            "tables must be DataFrames of pandas or polars, or arrays. Got a "
            f"{type(X).__name__} of pyarrow: use its to_pandas()."
        )
    return hasattr(X, "columns") and hasattr(X, "__getitem__") and hasattr(X, "shape")


def n_rows_of(X: Any) -> int:
    """Number of samples of a table of any kind."""
    return X.shape[0] if hasattr(X, "shape") else np.asarray(X, dtype=object).shape[0]


class Table:
    """Columns of a DataFrame (pandas or polars) or of a two-dimensional array.

    A list is read as objects, lest numpy turns its numbers into text. `argument` names
    the table in errors: a ValueError when two columns have the same name.
    """

    def __init__(self, X: Any, argument: str = "X") -> None:
        if isinstance(X, np.matrix):  # of which a column is a matrix again
            X = np.asarray(X)
        X = X if is_table(X) or hasattr(X, "dtype") else np.asarray(X, object)
        if len(X.shape) != 2:
            raise ValueError(
                f"{argument} must have shape (n_samples, n_features). Got {X.shape}; "
                "reshape(-1, 1) makes a column."
            )
        self.X = X
        self.n_rows: int = X.shape[0]
        self.named = is_table(X)
        self.names: list[Any] = list(X.columns if self.named else range(X.shape[1]))
        self._positions = {name: k for k, name in enumerate(self.names)}
        if len(self._positions) < len(self.names):
            name = max(self.names, key=self.names.count)
            raise ValueError(
                f"{argument} must have distinct column names. Got {name!r} "
                f"{self.names.count(name)} times; rename these columns."
            )
        indexed = isinstance(X, pd.DataFrame)
        self.levels: list[Any] = list(X.index.names) if indexed else []

    def at(self, position: int) -> Column:
        """The column at a position."""
        name = self.names[position]
        if isinstance(self.X, pd.DataFrame):
            return Column(name, self.X.iloc[:, position], position)
        values = self.X[name] if self.named else self.X[:, position]
        return Column(name, values, position)

    def _find(self, key: Any, role: str) -> Column:
        """The column of a name, else a level of the index, else that of a position.

        Raises a ValueError about the argument `role` when `key` is none of these.
        """
        try:
            position = self._positions.get(key)
        except TypeError:  # an array or a table, which is no name
            raise ValueError(
                f"`{role}` must name a column of X. Got {shown(key)}."
            ) from None
        if self.named and position is not None:
            return self.at(position)
        if key is not None and key in self.levels:
            return Column(key, self.X.index.get_level_values(key))
        n_columns = len(self.names)
        is_position = is_whole(key)
        if is_position and -n_columns <= key < n_columns:
            return self.at(int(key) % n_columns)
        if is_position:
            rule = f"be a position among the {n_columns} columns of X"
        elif not self.named:
            rule = "be an integer position, as X is an array without column names"
        else:
            known = listed_names(self.names)
            named = [repr(level) for level in self.levels if level is not None]
            known += f"; index levels: {', '.join(named)}" if named else ""
            rule = f"name a column or an index level of X ({known})"
        hint = did_you_mean(key, [*self.names, *self.levels])
        if role == "time" and None in self.levels and not is_position:
            hint += " An index without a name gets one by X.rename_axis('time')."
        raise ValueError(f"`{role}` must {rule}. Got {shown(key)}.{hint}")

    def one(self, key: Any, role: str) -> Column | None:
        """The column that has a role; None for `key=None`."""
        return None if key is None else self._find(key, role)

    def inputs(self, keys: Any, others: Sequence[Column | None]) -> list[Column]:
        """The inputs: the columns named, else those that are none of the `others`."""
        if keys is not None:
            return self.several(keys, "inputs")
        taken = {column.position for column in others if column is not None}
        free = [p for p in range(len(self.names)) if p not in taken]
        if taken and not free:
            raise ValueError(
                "`inputs` must leave or name at least one column of X. Got None, and "
                "every column has another role."
            )
        return [self.at(p) for p in free]

    def several(self, keys: Any, role: str) -> list[Column]:
        """The columns that share a role; none for `keys=None`."""
        if keys is None:
            return []
        known = [*self.names, *self.levels]
        found = [self._find(key, role) for key in as_list(keys, known)]
        names = [column.name for column in found]
        if not found or len(set(names)) < len(names):
            raise ValueError(
                f"`{role}` must list at least one column, each once. Got {keys!r}."
            )
        return found


def checked_array(argument: str, values: Any, **options: Any) -> NDArray[Any]:
    """An array by `check_array`; values that are no numbers are named."""
    array = any(hasattr(values, name) for name in ("__len__", "__array__"))
    other = isinstance(values, str | bytes | dict | set) and not hasattr(
        values, "shape"
    )
    if other or not array:
        got = repr(values) if isinstance(values, str) else type(values).__name__
        raise ValueError(
            f"`{argument}` must be a table (a pandas.DataFrame) or an array of "
            f"numbers. Got {got}."
        )
    kind = getattr(getattr(values, "dtype", None), "kind", "")
    if kind in ("m", "M") and options.get("dtype") is not None:
        raise ValueError(
            f"`{argument}` must hold numbers. Got dates or time differences, which are "
            "a `time` column beside inputs at best."
        )
    if kind == "O" and any(map(np.iscomplexobj, np.ravel(values))):
        raise ValueError(f"Complex data not supported: `{argument}` holds some.")
    if np.ma.isMaskedArray(values):
        values = np.ma.filled(values.astype(float), np.nan)  # masked ones are missing
    try:
        return check_array(
            values, ensure_all_finite=False, input_name=argument, **options
        )
    except (TypeError, ValueError, ArithmeticError) as error:
        try:
            entries = np.asarray(values)
        except ValueError:
            tables = all(np.ndim(part) == 2 for part in values)
            raise ValueError(
                f"`{argument}` must have rows of one length. Got "
                + (f"several tables. {_RESHAPED[3]}" if tables else "rows that differ.")
            ) from error
        kind = ValueError if isinstance(error, ArithmeticError) else type(error)
        flat = entries.ravel()
        k = first_not_a_number(flat) if entries.dtype.kind in "OSU" else None
        if k is not None and 0 < entries.ndim <= 2:  # a sparse matrix has none
            at = zip(
                ("row", "column"), np.unravel_index(k, entries.shape), strict=False
            )
            cause = "." if isinstance(flat[k], str) else f": {error}."
            cause = f"{cause} {reading_of(flat[k])}".rstrip()
            raise kind(
                f"`{argument}` must hold numbers. Got {shown(as_scalar(flat[k]))} at "
                f"{', '.join(f'{axis} {i}' for axis, i in at)}{cause}"
            ) from error
        if entries.ndim in _RESHAPED:
            raise ValueError(
                f"`{argument}` must be a table with a row for each sample, shape "
                f"(n_samples, n_columns). Got shape {entries.shape}. "
                f"{_RESHAPED[entries.ndim]}"
            ) from None
        raise kind(
            f"`{argument}` must be a table of real numbers. Got {shown(values)}: "
            f"{error}"
        ) from error


def as_numbers(
    argument: str, values: Any, *, imaginary: bool = False, finite: bool = False
) -> NDArray[Any]:
    """Numbers in an array of any shape, a single one in a vector.

    Raises a ValueError about the `argument` where one is not a real number, or where it
    may be `imaginary`, no number, or too large for its square to be one, or where all
    have to be, not `finite`.
    """
    read = complex_array if imaginary else real_array
    array = squarable(argument, np.atleast_1d(read(argument, values)))
    return all_finite(argument, array, "row {}") if finite else array


def numbers_of(columns: Sequence[Column], n_rows: int, argument: str) -> Array:
    matrix = np.empty((n_rows, len(columns)), order="F")
    for k, column in enumerate(columns):
        matrix[:, k] = column.numbers(argument)
    return matrix


def read_outputs(y: Any, argument: str = "y") -> tuple[Array, list[Hashable]]:
    """Outputs as a matrix (n_samples, n_outputs), and their names (y1, y2, ...).

    From a DataFrame, a Series or an array-like, not checked for missing values. Raises
    a ValueError about the `argument` when a column does not hold real numbers.
    """
    if isinstance(y, pd.Series):
        y = y.to_frame("y1" if y.name is None or y.name == "" else y.name)
    if is_table(y):
        table = Table(y, argument)
        columns = [table.at(position) for position in range(len(table.names))]
        if not columns:
            raise ValueError(
                f"`{argument}` must have at least one column. Got shape {y.shape}."
            )
        return numbers_of(columns, table.n_rows, argument), table.names
    name = getattr(y, "name", None)
    Y = checked_array(argument, y, dtype=np.float64, ensure_2d=False)
    if Y.ndim == 1:
        return Y[:, None], ["y1" if name is None or name == "" else name]
    return Y, [f"y{k + 1}" for k in range(Y.shape[1])]
