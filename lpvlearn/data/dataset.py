"""A data set larger than memory: read by experiment, its numbers kept on disk."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .experiments import Experiment

_ROWS = 65_536  # that are read at once: a few MB

_VALUES = ("inputs", "outputs", "scheduling")

_NOTHING = np.zeros((0, 0))

_NO_PYARROW = (
    "`dataset` is read by pyarrow, which is not installed. Got {!r}. Install it: pip "
    "install 'lpvlearn[tables]', or load the table and use `fit`."
)


def open_dataset(dataset: Any) -> Any:
    """A pyarrow dataset, from the path of a file or folder."""
    try:
        from pyarrow import ArrowException
        from pyarrow import dataset as arrow
    except ImportError as error:
        raise ImportError(_NO_PYARROW.format(dataset)) from error
    if isinstance(dataset, arrow.Dataset):
        return dataset
    if not isinstance(dataset, str | PathLike):
        raise ValueError(
            "`dataset` must be a pyarrow.dataset.Dataset, or the path of a file or "
            f"folder of parquet files. Got {type(dataset).__name__}."
        )
    try:
        return arrow.dataset(str(dataset), partitioning="hive")
    except ArrowException as error:
        raise ValueError(
            "`dataset` must be the path of a file or folder of parquet files. Got "
            f"{str(dataset)!r}: {error}"
        ) from error


def tables_by_experiment(dataset: Any, experiment: Hashable) -> Iterator[pd.DataFrame]:
    """The rows of every experiment, one after another; of all, where none is named.

    A ValueError where one goes on after another has begun.
    """
    names = dataset.schema.names
    if experiment is not None and experiment not in names:
        raise ValueError(
            f"`experiment` must name a column of the dataset. Got {experiment!r}; it "
            f"has {', '.join(map(repr, names))}."
        )
    parts: list[pd.DataFrame] = []
    label, seen = None, set()
    for rows in _tables_of(dataset):
        column = [None] * len(rows) if experiment is None else rows[experiment]
        labels = np.asarray(column, object)
        changes = np.flatnonzero(labels[1:] != labels[:-1]) + 1
        for start, stop in zip([0, *changes], [*changes, len(rows)], strict=True):
            if parts and labels[start] != label:
                yield pd.concat(parts, ignore_index=True)
                parts = []
            if not parts:
                label = labels[start]
                if label in seen:
                    raise ValueError(
                        "`dataset` must hold the rows of an experiment one after "
                        f"another. Got more of {label!r} in column {experiment!r} "
                        "after others. Sort it by experiment and time, or partition "
                        "it by experiment."
                    )
                seen.add(label)
            parts.append(rows.iloc[start:stop])
    if not parts:
        raise ValueError("`dataset` must hold at least one row. Got none.")
    yield pd.concat(parts, ignore_index=True)


def _tables_of(dataset: Any) -> Iterator[pd.DataFrame]:
    """Tables of some rows each, in their order."""
    for fragment in dataset.get_fragments():
        # reading a whole file goes ahead of us, and holds what it has read
        groups = getattr(fragment, "split_by_row_group", lambda one=fragment: [one])
        for group in groups():
            for batch in group.to_batches(
                schema=dataset.schema, batch_size=_ROWS, batch_readahead=1
            ):
                if len(batch):
                    yield batch.to_pandas()


def kept_on_disk(
    experiments: Iterable[Experiment], path: str | PathLike[str]
) -> list[Experiment]:
    """The same experiments, whose numbers are read from a file when they are used."""
    kept: list[tuple[Experiment, list[tuple[int, ...] | None]]] = []
    with Path(path).open("wb") as file:
        for e in experiments:
            shapes: list[tuple[int, ...] | None] = []
            for name in _VALUES:
                values = getattr(e, name)
                shapes.append(None if values is None else values.shape)
                if values is not None:
                    np.ascontiguousarray(values, np.float64).tofile(file)
            rows = np.broadcast_to(np.intp(0), len(e.rows))
            known = replace(
                e, rows=rows, inputs=_NOTHING, outputs=None, scheduling=None
            )
            kept.append((known, shapes))
    whole: NDArray[np.float64] = np.memmap(path, np.float64, "r")
    found, place = [], 0
    for e, shapes in kept:
        numbers: dict[str, Any] = {}
        for name, shape in zip(_VALUES, shapes, strict=True):
            if shape is not None:
                stop = place + int(np.prod(shape))
                numbers[name], place = whole[place:stop].reshape(shape), stop
        found.append(replace(e, **numbers))
    return found
