"""Errors and warnings of this library, and the one way to give a warning."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Method = TypeVar("Method", bound=Callable[..., Any])

LIBRARY = Path(__file__).parent  # the folder of all that is ours
_HERE = str(LIBRARY) + os.sep


class ExtrapolationWarning(UserWarning):
    """A model was evaluated outside the scheduling range it was identified on."""


class RankWarning(UserWarning):
    """The data do not determine the model: a minimum-norm solution was taken."""


class VersionWarning(UserWarning):
    """A pickle is of another version of this library, and may not fit this one."""


class DivergenceError(ValueError):
    """A simulation left the range of the floating-point numbers."""


def finite_simulation(
    outputs: NDArray[np.float64], cause: Callable[[], str]
) -> NDArray[np.float64]:
    """Simulated outputs, or a DivergenceError that tells where they end, and why."""
    finite = np.isfinite(outputs)
    if finite.all():
        return outputs
    sample, *place = (int(i) for i in np.argwhere(~finite)[0])
    before = f"{outputs[sample - 1, *place]:.4g} at sample {sample - 1}, and "
    raise DivergenceError(
        f"the simulation diverges: output {place[0]} is {before if sample else ''}"
        f"beyond all numbers at sample {sample}. {cause()}"
    )


class Told(NamedTuple):
    """A warning that was not given yet."""

    message: str
    category: type[Warning]
    kind: str = ""  # of what may be taken back


_COLLECTING: ContextVar[list[Told] | None] = ContextVar("collecting", default=None)


@contextmanager
def collected() -> Iterator[list[Told]]:
    """Collect what the block warns of by `warn`, instead of giving the warnings.

    In this thread alone, where the filters of `warnings` are those of all threads.
    """
    told: list[Told] = []
    token = _COLLECTING.set(told)
    try:
        yield told
    finally:
        _COLLECTING.reset(token)


@contextmanager
def retold() -> Iterator[list[Told]]:
    """Collect what the block warns of, and give it when the block ends, or fails."""
    told: list[Told] = []
    try:
        with collected() as told:
            yield told
    finally:
        repeat(told)


def repeat(told: Iterable[Told]) -> None:
    """Give warnings that were collected."""
    for message, category, kind in told:
        warn(message, category, kind)


@contextmanager
def only_of(kind: str) -> Iterator[None]:
    """Drop what the block warns of, but for a kind."""
    with collected() as told:
        yield
    repeat(one for one in told if one.kind == kind)


def take_back(kind: str) -> None:
    """Drop warnings of a kind, of those that were not given yet."""
    collecting = _COLLECTING.get()
    if collecting is not None:
        collecting[:] = [told for told in collecting if told.kind != kind]


def warn(message: str, category: type[Warning] = UserWarning, kind: str = "") -> None:
    """Give a warning that points to the user's line, however deep it arises.

    That line is the one which called the outermost function of this library: what
    lies between (joblib, a pipeline of scikit-learn) is passed over. Of a `kind` it may
    be taken back where more is known.
    """
    collecting = _COLLECTING.get()
    if collecting is not None:
        collecting.append(Told(message, category, kind))
        return
    level, frame = 1, sys._getframe(1)
    outermost = 1
    while frame.f_back is not None:
        if frame.f_code.co_filename.startswith(_HERE):
            outermost = level
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=outermost + 2)


def all_or_nothing(method: Method) -> Method:
    """A method that leaves the attributes as they were where it fails, or is stopped.

    What an attribute refers to must not be changed in its place.
    """

    @wraps(method)
    def careful(self: Any, *args: Any, **options: Any) -> Any:
        before = self.__dict__.copy()
        try:
            return method(self, *args, **options)
        except BaseException:  # an interruption, too
            self.__dict__.clear()
            self.__dict__.update(before)
            raise

    return cast(Method, careful)


def version() -> str:
    """That of this library, which stands on its public face."""
    return str(sys.modules[__name__.split(".")[0]].__version__)


# Of columns and labels: what lists, texts and arrays of NumPy give back as it was.
PLAIN_DTYPES = ("object", "str", "float64", "int64", "bool")


class _Labels(NamedTuple):
    """Those of the rows or columns of a table."""

    values: list[Any]
    names: list[Any]
    dtype: str

    @classmethod
    def of(cls, index: pd.Index) -> _Labels:
        return cls(index.tolist(), [*index.names], str(index.dtype))

    def built(self) -> pd.Index:
        if len(self.names) > 1:
            return pd.MultiIndex.from_tuples(self.values, names=self.names)
        known = pd.Index(self.values, dtype=self.dtype, tupleize_cols=False)
        return known.set_names(self.names)


class _PlainTable(NamedTuple):
    """A table of pandas as lists, texts and arrays, which formats without code hold."""

    rows: _Labels
    columns: _Labels
    dtypes: list[str]
    values: list[NDArray[Any]]

    @classmethod
    def of(cls, value: Any) -> Any:
        """What stands for a value: for a table of numbers and text its parts."""
        if not isinstance(value, pd.DataFrame):
            return value
        rows, columns = _Labels.of(value.index), _Labels.of(value.columns)
        dtypes = [str(dtype) for dtype in value.dtypes]
        if not {rows.dtype, columns.dtype, *dtypes} <= {*PLAIN_DTYPES}:
            return value
        arrays = [value.iloc[:, k].to_numpy() for k in range(len(dtypes))]
        return cls(rows, columns, dtypes, arrays)

    def table(self) -> pd.DataFrame:
        index, parts = self.rows.built(), zip(self.values, self.dtypes, strict=True)
        columns = [pd.Series(v, index, dtype) for v, dtype in parts]
        found = pd.DataFrame(dict(enumerate(columns)), index)
        return found.set_axis(self.columns.built(), axis=1)


WRITTEN_BY = "_lpvlearn_version"  # the entry of a pickled state that tells it


class VersionedPickle:
    """What the pickle of a public object tells: the version that wrote it.

    Scikit-learn's estimators tell theirs; what others inherit from it does not. Tables
    are taken apart, so that skops holds an estimator as well.
    """

    def __getstate__(self) -> dict[str, Any]:
        state: dict[str, Any] = super().__getstate__()  # type: ignore[assignment]
        plain = {name: _PlainTable.of(value) for name, value in state.items()}
        return plain | {WRITTEN_BY: version()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        own = {
            name: value.table() if isinstance(value, _PlainTable) else value
            for name, value in state.items()
            if name != WRITTEN_BY
        }
        written = state.get(WRITTEN_BY, "0.1.0 or before")
        if written != version():
            warn(
                f"A pickled {type(self).__name__} was written by lpvlearn {written}, "
                f"this is {version()}: what it tells may be wrong. Make it anew, or "
                "keep models by lpvlearn.save(), whose files later versions read.",
                VersionWarning,
            )
        getattr(super(), "__setstate__", self.__dict__.update)(own)
