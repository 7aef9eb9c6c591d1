"""Column roles: tables of samples read as a list of experiments.

A table has one row per sample. Some of its columns are inputs; others may say which
experiment a row belongs to, at what time it was taken, and where the scheduling
variable stood.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_array, check_consistent_length, validate_data

from .columns import Column, Role, Roles, Table, as_scalar, is_table
from .timestamps import check_uniform_time, time_in_seconds

Array = NDArray[np.float64]

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Experiment:
    """The samples of one experiment, in the order of time."""

    label: Hashable  # of the experiment column; 0 where the table is one experiment
    rows: Indices  # (n_samples,), positions of the samples in the table
    inputs: Array  # (n_samples, n_inputs)
    outputs: Array | None = None  # (n_samples, n_outputs); None when read without `y`
    scheduling: Array | None = None  # (n_samples, n_scheduling)
    operating_point: Hashable = None  # label of the column with that role
    sampling_time: float | None = None  # seconds, of the time column; None without
    input_names: tuple[Hashable, ...] = ()  # of the columns, or their positions


def read_experiments(
    estimator: Any,
    X: Any,
    y: Any = None,
    *,
    inputs: Roles = None,
    scheduling: Roles = None,
    experiment: Role = None,
    time: Role = None,
    operating_point: Role = None,
    sampling_time: float | None = None,
    reset: bool = True,
    allow_missing: bool = False,
) -> list[Experiment]:
    """Read a table as a list of experiments, in the order of first appearance.

    Rows of an experiment must be in the order of time but need not be adjacent. Roles
    are names of columns of `X`, else of levels of its index, else positions; without
    `inputs`, every column without another role is one. `n_features_in_` and
    `feature_names_in_` of the estimator are set when `reset` (fitting), else checked.
    The declared `sampling_time` is compared with the time column.

    Raises a ValueError when a role names no column, a value is missing (inputs and
    outputs with `allow_missing` excepted), infinite or not a number, time within an
    experiment does not increase evenly or disagrees with `sampling_time`, or an
    operating point changes within an experiment.

    Examples
    --------
    >>> import pandas as pd
    >>> from sklearn.base import BaseEstimator
    >>> from lpvlearn.data.experiments import read_experiments
    >>> X = pd.DataFrame({"u": [1.0, 0.0, 2.0, 1.0], "run": ["a", "b", "a", "b"]})
    >>> for run in read_experiments(BaseEstimator(), X, experiment="run"):
    ...     print(run.label, run.rows, run.inputs.ravel())
    a [0 2] [1. 2.]
    b [1 3] [0. 1.]
    """
    roles = (inputs, scheduling, experiment, time, operating_point)
    if not is_table(X):
        X = _as_matrix(estimator, X, numeric=all(role is None for role in roles))
    table = Table(X)
    if y is None and not reset:
        validate_data(estimator, X, reset=False, skip_check_array=True)
    else:
        validate_data(estimator, X, y, reset=reset, skip_check_array=True)

    by_label = table.one(experiment, "experiment")
    by_time = table.one(time, "time")
    by_point = table.one(operating_point, "operating_point")
    kappa = table.several(scheduling, "scheduling")
    u = table.inputs(inputs, [by_label, by_time, by_point, *kappa])
    U = _numbers(u, table.n_rows, "X")
    check_array(U, ensure_all_finite=False, estimator=estimator, input_name="X")
    K = _numbers(kappa, table.n_rows, "X") if kappa else None
    Y, y_names = (None, []) if y is None else read_outputs(y)
    if Y is not None:
        check_consistent_length(U, Y)
    labels, groups = group_rows(by_label, table.n_rows)
    _check_finite(U, [c.name for c in u], "X", labels, groups, allow_missing)
    if K is not None:
        _check_finite(K, [c.name for c in kappa], "X", labels, groups)
    if Y is not None:
        _check_finite(Y, y_names, "y", labels, groups, allow_missing)
    steps = _sampling_times(by_time, labels, groups, sampling_time)
    return [
        Experiment(
            label=label,
            rows=rows,
            inputs=U[rows],
            outputs=None if Y is None else Y[rows],
            scheduling=None if K is None else K[rows],
            operating_point=operating_point_of(by_point, rows, label),
            sampling_time=step,
            input_names=tuple(column.name for column in u),
        )
        for label, rows, step in zip(labels, groups, steps, strict=True)
    ]


def _as_matrix(estimator: Any, X: Any, *, numeric: bool) -> NDArray[Any]:
    """Check an array; with labels among its columns, their type is kept."""
    # A list is read as objects, lest numpy turns its numbers into text.
    dtype = np.float64 if numeric else None if hasattr(X, "dtype") else object
    return check_array(
        X, dtype=dtype, ensure_all_finite=False, estimator=estimator, input_name="X"
    )


def _numbers(columns: Sequence[Column], n_rows: int, argument: str) -> Array:
    matrix = np.empty((n_rows, len(columns)))
    for k, column in enumerate(columns):
        matrix[:, k] = column.numbers(argument)
    return matrix


def _check_finite(
    matrix: Array,
    names: Sequence[Hashable],
    argument: str,
    labels: Sequence[Hashable],
    groups: Sequence[Indices],
    allow_missing: bool = False,
) -> None:
    """Refuse infinity, and NaN where it may not be, naming the first."""
    finite = np.isfinite(matrix) | (allow_missing & np.isnan(matrix))
    if finite.all():
        return
    column = int(np.argmin(finite.all(axis=0)))
    row = int(np.argmin(finite[:, column]))
    where = next(k for k, rows in enumerate(groups) if row in rows)
    missing = np.isnan(matrix[row, column])
    what = "NaN" if missing else "infinity or a value too large for dtype('float64')"
    raise ValueError(
        f"Input {argument} contains {what}. First in column {names[column]!r} of "
        f"experiment {labels[where]!r}, at row {row}: fill the gap (interpolate) or "
        "leave the experiment out; dropping single rows breaks the record."
    )


def _sampling_times(
    column: Column | None,
    labels: Sequence[Hashable],
    groups: Sequence[Indices],
    sampling_time: float | None,
) -> list[float | None]:
    """Check the time column, and return each experiment's step."""
    if column is None:
        return [None] * len(labels)
    seconds = time_in_seconds(column.values, column.name)
    steps: list[float | None] = []
    common = None
    for label, rows in zip(labels, groups, strict=True):
        step = check_uniform_time(
            seconds[rows],
            column=column.name,
            experiment=label,
            sampling_time=sampling_time,
            other_step=common,
        )
        common = step if common is None else common
        steps.append(step)
    return steps


def group_rows(
    column: Column | None, n_rows: int
) -> tuple[list[Hashable], list[Indices]]:
    """Labels of experiments in the order of first appearance, and the rows of each."""
    if column is None:
        return [0], [np.arange(n_rows)]
    codes, uniques = pd.factorize(pd.Series(column.values))
    if (codes < 0).any():
        raise ValueError(
            f"`experiment` column {column.name!r} must label every row. Got a missing "
            f"value at row {int(np.argmin(codes))}."
        )
    order = np.argsort(codes, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(codes))[:-1])
    return [as_scalar(label) for label in uniques], groups


def operating_point_of(
    column: Column | None, rows: Indices, label: Hashable
) -> Hashable:
    """The one value that the operating-point column has in an experiment."""
    if column is None:
        return None
    values = pd.unique(pd.Series(column.values).iloc[rows])
    if len(values) > 1 or pd.isna(values[0]):
        raise ValueError(
            f"`operating_point` column {column.name!r} must hold one value per "
            f"experiment. Got {[as_scalar(v) for v in values[:3]]} in experiment "
            f"{label!r}; give the experiments a column with the role `experiment`, and "
            "continuous variables the role `scheduling`."
        )
    return as_scalar(values[0])


def read_outputs(y: Any) -> tuple[Array, list[Hashable]]:
    """Outputs as a matrix (n_samples, n_outputs), and their names (y1, y2, ...).

    From a DataFrame, a Series or an array-like, not checked for missing values. Raises
    a ValueError when a column does not hold real numbers.

    Examples
    --------
    >>> read_outputs([0.5, 1.5])
    (array([[0.5],
           [1.5]]), ['y1'])
    """
    if is_table(y):
        table = Table(y, "y")
        columns = [table.at(position) for position in range(len(table.names))]
        return _numbers(columns, table.n_rows, "y"), table.names
    name = getattr(y, "name", None)
    Y = check_array(
        y, dtype=np.float64, ensure_2d=False, ensure_all_finite=False, input_name="y"
    )
    if Y.ndim == 1:
        return Y[:, None], ["y1" if name is None or name == "" else name]
    return Y, [f"y{k + 1}" for k in range(Y.shape[1])]


def from_trajectories(
    trajectories: Sequence[tuple[ArrayLike, ...]],
    *,
    sampling_time: float | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Convert a list of trajectories to the tables that estimators take.

    Parameters
    ----------
    trajectories : list of tuples (u, kappa, y) or (u, y)
        One per experiment: inputs (n_samples,) or (n_samples, n_inputs); the scheduling
        variable, likewise or constant (a number, or shaped (1, n_scheduling)); outputs.
    sampling_time : float, optional
        In seconds; adds a time column.

    Returns
    -------
    X : DataFrame
        Columns `u1, u2, ...`, `kappa` (or `kappa1, kappa2, ...`), `experiment` (0, 1,
        ...) and `time`.
    y : DataFrame
        Columns `y1, y2, ...`.

    Raises
    ------
    ValueError
        When lengths or numbers of columns disagree.

    Examples
    --------
    >>> from lpvlearn import from_trajectories
    >>> X, y = from_trajectories([([1.0, 0.0], 0.3, [0.0, 0.5])], sampling_time=0.1)
    >>> X
        u1  kappa  experiment  time
    0  1.0    0.3           0   0.0
    1  0.0    0.3           0   0.1
    """
    if len(trajectories) == 0:
        raise ValueError("`trajectories` must hold at least one tuple. Got 0.")
    parts = [_trajectory(k, item) for k, item in enumerate(trajectories)]
    widths = [tuple(None if a is None else a.shape[1] for a in part) for part in parts]
    for k, width in enumerate(widths):
        if width != widths[0]:
            raise ValueError(
                "`trajectories` must all have the same numbers of inputs, scheduling "
                f"variables and outputs. Got {widths[0]} in trajectory 0 and "
                f"{width} in trajectory {k}."
            )
    u, kappa, y = zip(*parts, strict=True)
    counts = [len(part) for part in u]
    X = pd.DataFrame(np.vstack(u)).rename(columns=lambda k: f"u{k + 1}")
    if kappa[0] is not None:
        K = np.vstack(kappa)
        single = K.shape[1] == 1
        for k in range(K.shape[1]):
            X["kappa" if single else f"kappa{k + 1}"] = K[:, k]
    X["experiment"] = np.repeat(np.arange(len(counts)), counts)
    if sampling_time is not None:
        X["time"] = np.concatenate([sampling_time * np.arange(n) for n in counts])
    return X, pd.DataFrame(np.vstack(y)).rename(columns=lambda k: f"y{k + 1}")


def _trajectory(
    k: int, item: tuple[ArrayLike, ...]
) -> tuple[NDArray[Any], NDArray[Any] | None, NDArray[Any]]:
    """Return u, kappa, y of a tuple as matrices of equal length."""
    if not isinstance(item, (tuple, list)) or len(item) not in (2, 3):
        got = len(item) if isinstance(item, (tuple, list)) else type(item).__name__
        raise ValueError(
            "`trajectories` must be a list of tuples (u, kappa, y) or (u, y). Got "
            f"{got} instead of 2 or 3 arrays in trajectory {k}."
        )
    u, y = _as_columns(item[0]), _as_columns(item[-1])
    kappa = _as_columns(item[1]) if len(item) == 3 else None
    if kappa is not None and len(kappa) == 1:
        kappa = np.repeat(kappa, len(u), axis=0)
    lengths = [len(a) for a in (u, kappa, y) if a is not None]
    if len(set(lengths)) > 1:
        raise ValueError(
            f"`trajectories` must hold arrays of equal length. Got {lengths} in "
            f"trajectory {k}."
        )
    return u, kappa, y


def _as_columns(values: ArrayLike) -> Array:
    array = np.asarray(values, dtype=np.float64)
    return array if array.ndim == 2 else array.reshape(-1, 1)
