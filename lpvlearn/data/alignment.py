"""Outputs beside the rows of X and the columns of a fit, by their labels."""

from __future__ import annotations

from typing import Any

import pandas as pd
from sklearn.utils.validation import check_consistent_length

from ..exceptions import warn
from ..validation import naming_argument


def align_outputs(
    X: Any, y: Any, estimator: Any = None, *, names: tuple[str, str] = ("X", "y")
) -> Any:
    """`y` in the order of the rows of `X`, its columns in that of a fitted estimator.

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
    if y is None or isinstance(y, str) or not hasattr(y, "__len__"):
        return y  # where outputs are read, it is said what they must be
    y = in_columns(y, getattr(estimator, "_output_names", None))
    first, second = names  # in messages
    positions = f"{second}.to_numpy() if the rows belong together as they stand"
    rule = f"have as many rows as {first}"
    with naming_argument(second, rule, y):
        try:
            check_consistent_length(X, y)
        except ValueError as error:
            raise ValueError(
                f"`{second}` must {rule}: select the same rows of both. {error}."
            ) from error
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
                f"`{second}` has the row labels of {first} in another order: its rows "
                f"are put into the order of {first}, by label. Give {positions}, as "
                "where they were shuffled on purpose (permutation_test_score)."
            )
            return y.loc[own]
        # Numbers of rows say nothing, nor do labels of another kind.
        numbered = given.equals(pd.RangeIndex(len(y))) or own.dtype != given.dtype
        if numbered or own.names != given.names or not shared.any():
            return y
        other = given[~shared].tolist()[0]
        raise ValueError(
            f"`{second}` must have the row labels of {first}. Got {(~shared).sum()} "
            f"label(s) that {first} does not have, the first {other!r}, and "
            f"{shared.sum()} that it has. Select the same rows of both, or give "
            f"{positions}."
        )
    if not same:
        return y
    twice = own[own.duplicated()].tolist()[0]
    raise ValueError(
        f"`{second}` must have the row labels of {first} in the same order, where some "
        f"are repeated. Got {twice!r} several times. Sort both alike, or give "
        f"{positions}."
    )


def beside(
    y_true: Any, y_pred: Any, names: tuple[str, str] = ("y_true", "y_pred")
) -> Any:
    """`y_pred` in the rows and columns of `y_true`, by the labels of two tables."""
    tables = pd.DataFrame, pd.Series
    if not isinstance(y_true, tables) or not isinstance(y_pred, tables):
        return y_pred
    y_pred = in_columns(y_pred, getattr(y_true, "columns", None), names[1])
    if len(y_true) != len(y_pred):
        return y_pred
    return align_outputs(y_true, y_pred, names=names)


def in_columns(y: Any, names: Any, argument: str = "y") -> Any:
    """`y` with its columns in the order of `names`, where it has the same ones.

    Those of other names belong together as they stand, as those of arrays do; a
    ValueError where only some are the same.

    Examples
    --------
    >>> in_columns(pd.DataFrame({"a": [1], "b": [2]}), ["b", "a"]).columns.tolist()
    ['b', 'a']
    """
    own = list(getattr(y, "columns", ()))
    names = [] if names is None else list(names)
    if own == names or len(own) != len(names) or len(set(own)) < len(own):
        return y
    others = [name for name in own if name not in names]
    if len(others) == len(own):
        return y
    if others:
        raise ValueError(
            f"`{argument}` must have the outputs {names}, in any order, or names of "
            f"its own. Got {own}: {others[0]!r} is none of them. Name the columns "
            f"alike, or give {argument}.to_numpy() if they belong together as they "
            "stand."
        )
    return y[names]
