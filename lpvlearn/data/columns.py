"""Columns of a table by name, index level or position, whatever holds the table."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from numbers import Integral
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

# The arguments of the estimators that give columns a role.
ROLES = ("inputs", "scheduling", "experiment", "time", "operating_point")

Role = str | int | None

Roles = str | int | Sequence[str | int] | None

_ALIKE = 0.6  # likeness (difflib's, its default) from which a name may have been meant
_N_SHOWN = 10  # names in an error message, lest a wide table fills the screen


def roles_of(estimator: Any) -> dict[str, Any]:
    """The roles that an estimator gives to columns, by argument; None without one."""
    return {name: getattr(estimator, name, None) for name in ROLES}


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
        if kind not in "mM":  # which numpy would turn into nanoseconds
            try:
                return series.to_numpy(dtype=np.float64, na_value=np.nan)
            except (TypeError, ValueError):
                pass
        first = 0 if kind in "mM" else _first_not_a_number(series)
        raise ValueError(
            f"Column {self.name!r} of {argument} must hold numbers. Got "
            f"{series.iloc[first]!r} at row {first}. Give a column of labels or times "
            "its role, or list the numeric columns in `inputs`."
        )

    def labels(self, rows: Sequence[int]) -> list[Hashable]:
        """Values at some rows as plain Python objects."""
        return [as_scalar(value) for value in pd.Series(self.values).iloc[list(rows)]]


def as_scalar(value: Any) -> Hashable:
    """A NumPy scalar as a plain Python one."""
    return value.item() if isinstance(value, np.generic) else value


def _did_you_mean(key: Any, names: Sequence[Any]) -> str:
    """A suggestion for a misspelt name, or nothing."""
    lower = {str(name).lower(): name for name in names if name is not None}
    close = get_close_matches(str(key).lower(), lower, n=1, cutoff=_ALIKE)
    return f" Did you mean {lower[close[0]]!r}?" if close else ""


def _first_not_a_number(series: pd.Series) -> int:
    for row, value in enumerate(series):
        try:
            float(value)
        except (TypeError, ValueError):
            if value is not pd.NA and value is not None:
                return row
    return 0


def as_list(keys: Any) -> list[Any]:
    """The columns with a role, as a list; empty for None."""
    if keys is None:
        return []
    many = isinstance(keys, (list, tuple, np.ndarray, pd.Index))
    return list(keys) if many else [keys]


def is_table(X: Any) -> bool:
    """Whether `X` has named columns, as a pandas or polars DataFrame has."""
    return hasattr(X, "columns") and hasattr(X, "__getitem__") and hasattr(X, "shape")


class Table:
    """Columns of a DataFrame (pandas or polars) or of a two-dimensional array.

    A list is read as objects, lest numpy turns its numbers into text. `argument` names
    the table in errors: a ValueError when two columns have the same name.
    """

    def __init__(self, X: Any, argument: str = "X") -> None:
        X = X if is_table(X) or hasattr(X, "dtype") else np.asarray(X, object)
        self.X = X
        self.n_rows: int = X.shape[0]
        self.named = is_table(X)
        self.names: list[Any] = list(X.columns if self.named else range(X.shape[1]))
        if len(set(self.names)) < len(self.names):
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
        if self.named and key in self.names:
            return self.at(self.names.index(key))
        if key is not None and key in self.levels:
            return Column(key, self.X.index.get_level_values(key))
        n_columns = len(self.names)
        is_position = isinstance(key, Integral) and not isinstance(key, bool)
        if is_position and -n_columns <= key < n_columns:
            return self.at(int(key) % n_columns)
        if is_position:
            rule = f"be a position among the {n_columns} columns of X"
        elif not self.named:
            rule = "be an integer position, as X is an array without column names"
        else:
            shown = ", ".join(map(repr, self.names[:_N_SHOWN]))
            shown += ", ..." if n_columns > _N_SHOWN else ""
            named = [repr(level) for level in self.levels if level is not None]
            shown += f"; index levels: {', '.join(named)}" if named else ""
            rule = f"name a column or an index level of X ({shown})"
        hint = _did_you_mean(key, [*self.names, *self.levels])
        raise ValueError(f"`{role}` must {rule}. Got {key!r}.{hint}")

    def one(self, key: Role, role: str) -> Column | None:
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
        found = [self._find(key, role) for key in as_list(keys)]
        names = [column.name for column in found]
        if not found or len(set(names)) < len(names):
            raise ValueError(
                f"`{role}` must list at least one column, each once. Got {keys!r}."
            )
        return found
