"""One record of several levels: where the scheduling variables are held."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..validation import whole_number
from .experiments import group_rows
from .operating_points import tolerances
from .tables import Table

Array = NDArray[np.float64]

Indices = NDArray[np.intp]

_HELD = 0.05  # share of its range within which a variable counts as held
_BETWEEN = -1  # label of what belongs to no level


def split_levels(
    X: Any,
    scheduling: Any,
    *,
    experiment: Any = None,
    tol: ArrayLike | None = None,
    min_samples: int = 100,
) -> Indices:
    """Number the stretches of a record along which the scheduling variables are held.

    For a record in which these were set to one level after another: every stretch at a
    level is an experiment, for `LocalLPVPipeline` to find operating points among.

    Parameters
    ----------
    X : DataFrame or array-like of shape (n_samples, n_features)
        Rows in the order of time.
    scheduling : column name, position or list of them
        Columns of the scheduling variables. At missing values (NaN) stretches end.
    experiment : column name, index level or position, default=None
        Column that tells records apart, across which no stretch goes.
    tol : float or array-like of shape (n_scheduling,), default=None
        How far a variable may range along a stretch, largest minus smallest value, with
        its noise. None: 5 % of its range in the table.
    min_samples : int, default=100
        Rows of the shortest stretch. Shorter ones tell too little of the dynamics.

    Returns
    -------
    ndarray of shape (n_samples,)
        0, 1, 2, ... in the order of the rows; -1 for what is between the levels: of use
        to test a model, or to refine it (`OutputErrorLPV`).

    Raises
    ------
    ValueError
        If a role names no column, an option is out of its bounds, or nothing is held.

    Notes
    -----
    The longest stretch within `tol` is taken first, then the longest one of what is
    left on both sides. A slow ramp is cut into pieces along which it moves by `tol`.

    Examples
    --------
    A fan at two speeds, changed in five rows, and its last rows in one:

    >>> import numpy as np
    >>> import pandas as pd
    >>> from lpvlearn import split_levels
    >>> speed = np.concatenate([np.full(8, 0.2), np.linspace(0.2, 0.6, 7)[1:-1],
    ...                         np.full(6, 0.6), [0.3] * 4])
    >>> log = pd.DataFrame({"speed": speed})
    >>> log["record"] = split_levels(log, "speed", min_samples=4)
    >>> log[log["record"] >= 0].groupby("record")["speed"].agg(["mean", "size"])
            mean  size
    record
    0        0.2     8
    1        0.6     6
    2        0.3     4
    """
    table = Table(X)
    columns = table.several(scheduling, "scheduling")
    if not columns:
        raise ValueError(
            "`scheduling` must name the columns that are held at levels. Got None."
        )
    min_samples = whole_number("min_samples", min_samples, 2)
    values = np.column_stack([column.numbers("X") for column in columns])
    limits = _limits(tol, values)
    numbers = np.full(table.n_rows, _BETWEEN, dtype=np.intp)
    n_levels = longest = 0
    groups = group_rows(table.one(experiment, "experiment"), table.n_rows)[1]
    for rows in groups:
        pairs = zip(values[rows].T, limits, strict=True)
        ends = np.min([_ends(*pair) for pair in pairs], axis=0)
        longest = max(longest, int((ends - np.arange(len(rows))).max()))
        for start, end in _longest_first(ends, min_samples):
            numbers[rows[start:end]] = n_levels
            n_levels += 1
    if not n_levels:
        told = ", ".join(f"{limit:.4g}" for limit in limits)
        raise ValueError(
            f"`tol` must leave stretches of `min_samples`={min_samples} rows along "
            f"which the scheduling variables are held. Got {told}, "
            f"within which they stay for {longest} rows at most. Raise `tol` above "
            "their noise, lower `min_samples`, or fit a model to what moves: "
            "OutputErrorLPV()."
        )
    return numbers


def _limits(tol: ArrayLike | None, values: Array) -> Array:
    n = values.shape[1]
    if tol is None:
        known = np.isfinite(values)
        lowest = values.min(axis=0, initial=np.inf, where=known)
        highest = values.max(axis=0, initial=-np.inf, where=known)
        return np.where(known.any(axis=0), _HELD * (highest - lowest), 0.0)
    return tolerances("tol", tol, n)


def _ends(x: Array, tol: float) -> Indices:
    """For every row, the first one by which x has ranged over more than `tol`."""
    signal, n = x.tolist(), len(x)
    highest: deque[int] = deque()  # rows of falling, and of rising values: the first
    lowest: deque[int] = deque()  # of each is the extreme of those from start to end
    ends, end = np.empty(n, dtype=np.intp), 0
    for start in range(n):
        end = max(end, start)
        while end < n:
            value = signal[end]
            top = max(value, signal[highest[0]] if highest else value)
            bottom = min(value, signal[lowest[0]] if lowest else value)
            if not top - bottom <= tol:  # or it is missing
                break
            while highest and signal[highest[-1]] <= value:
                highest.pop()
            while lowest and signal[lowest[-1]] >= value:
                lowest.pop()
            highest.append(end)
            lowest.append(end)
            end += 1
        ends[start] = end
        for rows in (highest, lowest):
            if rows and rows[0] == start:
                rows.popleft()
    return ends


def _longest_first(ends: Indices, min_samples: int) -> list[tuple[int, int]]:
    """Stretches, start and end, in order; the longest is chosen, then beside it."""
    found, left = [], [(0, len(ends))]
    while left:
        first, last = left.pop()
        if last - first < min_samples:
            continue
        length = np.minimum(ends[first:last], last) - np.arange(first, last)
        longest = int(np.argmax(length))
        start, end = first + longest, first + longest + int(length[longest])
        if end - start >= min_samples:
            found.append((start, end))
            left += [(first, start), (end, last)]
    return sorted(found)
