"""Outputs beside the rows of X: as many, and under the same labels."""

from __future__ import annotations

from typing import Any

import pandas as pd
from sklearn.utils.validation import check_consistent_length

from ..exceptions import warn
from ..validation import naming_argument

_POSITIONS = "y.to_numpy() if the rows belong together as they stand"


def align_outputs(X: Any, y: Any) -> Any:
    """`y` in the order of the rows of `X`.

    Rows belong together as they stand, unless both tables bear the same labels in
    another order: those of `y` are then put into that of `X`, with a warning. A
    ValueError where that is ambiguous, where only a part of the labels agrees (rows of
    one table and others of it), or the lengths differ.

    Examples
    --------
    >>> X, y = pd.DataFrame({"u": [1, 2]}), pd.Series([3, 4])
    >>> align_outputs(X, y) is y
    True
    """
    if y is None or not hasattr(y, "__len__"):
        return y  # where outputs are read, it is said what they must be
    with naming_argument("y", "have as many rows as X", y):
        check_consistent_length(X, y)
    own, given = getattr(X, "index", None), getattr(y, "index", None)
    if not isinstance(own, pd.Index) or not isinstance(given, pd.Index):
        return y
    if own.equals(given) or own.nlevels != given.nlevels:
        return y
    shared = given.isin(own)
    same = shared.all() and own.isin(given).all()
    if own.is_unique and given.is_unique:
        if same:
            warn(
                "`y` has the row labels of X in another order: its rows are put into "
                f"the order of X, by label. Give {_POSITIONS}."
            )
            return y.loc[own]
        # Numbers of rows say nothing, nor do labels of another kind.
        numbered = given.equals(pd.RangeIndex(len(y))) or own.dtype != given.dtype
        if numbered or own.names != given.names or not shared.any():
            return y
        first = given[~shared].tolist()[0]
        raise ValueError(
            f"`y` must have the row labels of X. Got {(~shared).sum()} label(s) that X "
            f"does not have, the first {first!r}, and {shared.sum()} that "
            f"it has. Select the same rows of both, or give {_POSITIONS}."
        )
    if not same:
        return y
    twice = own[own.duplicated()].tolist()[0]
    raise ValueError(
        "`y` must have the row labels of X in the same order, where some are repeated. "
        f"Got {twice!r} several times. Sort both alike, or give {_POSITIONS}."
    )
