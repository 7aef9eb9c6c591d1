"""Tables of samples read as a list of experiments, by the roles of their columns.

A table has one row per sample. Some of its columns are inputs; others may say which
experiment a row belongs to, at what time it was taken, and where the scheduling
variable stood.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_array, check_consistent_length, validate_data

from ..exceptions import DivergenceError
from ..validation import SQUARED, naming_argument, positive_time
from .alignment import align_outputs
from .forgotten_roles import (
    refuse_outputs_among_inputs,
    warn_of_disorder,
    warn_of_forgotten_roles,
)
from .tables import (
    Column,
    Table,
    as_list,
    as_numbers,
    as_scalar,
    checked_array,
    did_you_mean,
    is_table,
    listed_names,
    numbers_of,
    read_outputs,
)
from .timestamps import (
    TIME_TOL,
    UNTIMED,
    Clock,
    are_local_times,
    check_time_tol,
    read_clock,
    time_in_seconds,
)

Array = NDArray[np.float64]

Indices = NDArray[np.intp]

# The arguments of the estimators that give columns a role.
ROLES = ("inputs", "scheduling", "experiment", "time", "operating_point")

OPTIONAL_ROLES = ("time", "operating_point")  # not needed after a fit

_SEVERAL = ("inputs", "scheduling")  # roles of more than one column
NO_TIME = (  # what a message says where seconds are needed and nothing tells them
    "`time` or `sampling_time` must tell the seconds between samples: {} in continuous "
    "time. Got neither. Name the column of times by `time=`, or give `sampling_time=`; "
    "sampling_time=1 counts time in samples."
)

# What else to do about a missing value, in a fit and in a simulation.
_IDENTIFIED = (
    ", or identify with missing='split' (of SubspaceLTI), which cuts the record there, "
    "or 'estimate', which estimates outputs; dropping single rows breaks it."
)
_SIMULATED = (
    ". A simulation needs every sample; predict_with_initial_state(X, y) begins anew "
    "after a gap with missing='split' (of SubspaceLTI)."
)


def roles_of(estimator: Any) -> dict[str, Any]:
    """The roles that an estimator gives to columns, by argument; None without one."""
    return {name: getattr(estimator, name, None) for name in ROLES}


def _keys(role: str, value: Any, names: Collection[Hashable]) -> list[Any]:
    """The columns with a role, which only some roles may share."""
    return as_list(value, names) if role in _SEVERAL or value is None else [value]


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
    output_names: tuple[Hashable, ...] = ()  # likewise; y1, y2, ... of arrays
    scheduling_names: tuple[Hashable, ...] = ()  # likewise
    breaks: tuple[int, ...] = ()  # samples before which time says that some are missing
    jitter: float = 0.0  # largest deviation from even time, relative to the step
    # (n_samples, n_outputs): outputs that were missing, and are estimates; None: none
    estimated: NDArray[np.bool_] | None = None

    @property
    def kappa(self) -> Array:
        """The scheduling values; zeros, (n_samples, 1), without any."""
        known = self.scheduling
        return np.zeros((len(self.rows), 1)) if known is None else known

    @property
    def measured(self) -> Array:
        """The outputs, of a table that was read with them."""
        if self.outputs is None:
            raise ValueError("`y` must hold the measured outputs. Got None.")
        return self.outputs


@contextmanager
def naming(experiment: Experiment) -> Iterator[None]:
    """Name the experiment in which a simulation diverges."""
    try:
        yield
    except DivergenceError as error:
        raise DivergenceError(f"Experiment {experiment.label!r}: {error}") from error


def read_experiments(
    estimator: Any,
    X: Any,
    y: Any = None,
    *,
    sampling_time: float | None = None,
    fitted_step: float | None = None,
    reset: bool = True,
    allow_missing: str = "",
    optional: Sequence[str] = OPTIONAL_ROLES,
    **roles: Any,
) -> list[Experiment]:
    """Read a table as a list of experiments, in the order of first appearance.

    Rows of an experiment must be in the order of time but need not be adjacent. Roles
    are those of the estimator, unless given; without `inputs`, every column without
    another role is one. `n_features_in_` and `feature_names_in_` of the estimator are
    set when `reset` (fitting). Afterwards the columns of a table are found by name:
    those with a role in the fit must be there, the `optional` roles excepted, and
    others are left alone. The time column is compared with the declared
    `sampling_time`, and with the step of the fit.

    `allow_missing` names the tables in which samples may be missing: "", "y" or "Xy"
    (inputs, scheduling variables, and whole rows that the time column misses). Outputs
    with the labels of X in another order are put into that of X.

    Raises a ValueError when a role names no column, a value is missing, infinite or not
    a number, time within an experiment does not increase evenly (up to the `time_tol`
    of the estimator) or has another step than it should, or an operating point changes
    within an experiment.
    """
    roles = roles_of(estimator) | roles
    if sampling_time is not None:
        sampling_time = positive_time("sampling_time", sampling_time)
    if not is_table(X):
        numeric = all(role is None for role in roles.values())
        X = _as_matrix(estimator, X, numeric=numeric)
    table = Table(X)
    y = align_outputs(X, y, None if reset else estimator)
    if not reset and table.named and hasattr(estimator, "feature_names_in_"):
        roles = fitted_roles(estimator, table, roles, optional)
    elif y is None and not reset:
        validate_data(estimator, X, reset=False, skip_check_array=True)
    else:
        validate_data(estimator, X, y, reset=reset, skip_check_array=True)

    single = ("experiment", "time", "operating_point")
    by_label, by_time, by_point = (table.one(roles[name], name) for name in single)
    kappa = table.several(roles["scheduling"], "scheduling")
    u = table.inputs(roles["inputs"], [by_label, by_time, by_point, *kappa])
    _check_apart({"experiment": by_label, "time": by_time}, u)
    U = numbers_of(u, table.n_rows, "X")
    check_array(U, ensure_all_finite=False, estimator=estimator, input_name="X")
    K = numbers_of(kappa, table.n_rows, "X") if kappa else None
    Y, y_names = (None, []) if y is None else read_outputs(y)
    if Y is not None:
        check_consistent_length(U, Y)
    labels, groups = group_rows(by_label, table.n_rows)
    names = [c.name for c in u]
    gaps, remedy = "X" in allow_missing, _SIMULATED if Y is None else _IDENTIFIED
    for values, columns, argument in (
        (U, names, "X"),
        (K, [c.name for c in kappa], "X"),
        (Y, y_names, "y"),
    ):
        if values is not None:
            allow = argument in allow_missing
            _check_finite(values, columns, argument, labels, groups, allow, remedy)
    clocks = _clocks(
        by_time,
        labels,
        groups,
        time_tol=check_time_tol(getattr(estimator, "time_tol", TIME_TOL)),
        allow_missing=gaps,
        expected=[
            (
                UNTIMED._replace(step=sampling_time),
                "`sampling_time` must be the step of the time column",
            ),
            (
                UNTIMED._replace(step=fitted_step),
                "X must have the time step of the model",
            ),
        ],
    )
    if by_time is None:
        warn_of_disorder(X, groups, sampling_time or fitted_step)
    if reset and roles["inputs"] is None:
        warn_of_forgotten_roles(U, names, groups, roles)
    if reset and table.named and Y is not None:
        refuse_outputs_among_inputs(U, names, Y, y_names)
    return [
        Experiment(
            label=label,
            rows=rows,
            inputs=_by_channel(U, rows),
            outputs=None if Y is None else _by_channel(Y, rows),
            scheduling=None if K is None else _by_channel(K, rows),
            operating_point=operating_point_of(by_point, rows, label),
            sampling_time=clock.step,
            input_names=tuple(names),
            output_names=tuple(y_names),
            scheduling_names=tuple(c.name for c in kappa),
            breaks=tuple(clock.breaks.tolist()),
            jitter=clock.jitter,
        )
        for label, rows, clock in zip(labels, groups, clocks, strict=True)
    ]


def _by_channel(values: Array, rows: Indices) -> Array:
    """Rows of a table, channel after channel in memory, as sums and maxima want it."""
    return np.take(values.T, rows, axis=1).T


def are_beginnings(experiments: Sequence[Experiment]) -> list[bool]:
    """Which of them are no part of an experiment that comes after a gap.

    Parts have the label of their experiment, and are in the order of time.
    """
    first: dict[Hashable, int] = {}
    return [first.setdefault(e.label, k) == k for k, e in enumerate(experiments)]


def as_table(experiments: Sequence[Experiment]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Inputs with a last column that tells the experiments apart, and outputs."""
    u = np.vstack([e.inputs for e in experiments])
    y = np.vstack([e.measured for e in experiments])
    names = [str(name) for name in experiments[0].input_names or range(u.shape[1])]
    label = "experiment"
    while label in names:
        label += "_"
    table = pd.DataFrame(u, columns=names)
    table[label] = np.repeat(
        np.arange(len(experiments)), [len(e.rows) for e in experiments]
    )
    return table, pd.DataFrame(y, columns=list(experiments[0].output_names) or None)


def check_inputs(experiments: Sequence[Experiment], n_inputs: int) -> None:
    """Refuse experiments of a table that do not have the inputs of a model."""
    names = experiments[0].input_names
    if len(names) != n_inputs:
        raise ValueError(
            f"`inputs` must name the {n_inputs} input(s) of the model among the "
            f"columns of X. Got {list(names)}."
        )


def _check_apart(single: Mapping[str, Column | None], inputs: Sequence[Column]) -> None:
    """Refuse a column that tells time or experiments and something else besides."""
    taken: dict[Hashable, str] = {}
    for role, columns in [
        *((role, [column]) for role, column in single.items() if column is not None),
        ("inputs", inputs),
    ]:
        for column in columns:
            if column.name in taken:
                raise ValueError(
                    f"`{role}` must not name a column that is the "
                    f"`{taken[column.name]}` column already. Got {column.name!r}."
                )
        taken |= {column.name: role for column in columns}


def fitted_roles(
    estimator: Any,
    table: Table,
    roles: Mapping[str, Any] | None = None,
    optional: Sequence[str] = (),
) -> dict[str, Any]:
    """The roles of a fit by names that are in the table; inputs are all named.

    An `optional` role becomes None where the table lacks its columns; a ValueError
    names what else is missing. Where fit or table had no names, roles stay as they are:
    those of the estimator, unless given.
    """
    roles = roles_of(estimator) if roles is None else roles
    if not table.named or not hasattr(estimator, "feature_names_in_"):
        return dict(roles)
    seen, found = list(estimator.feature_names_in_), dict.fromkeys(ROLES)
    there, lacking = {*table.names, *table.levels}, []
    known = {*seen, *there}

    def name_of(key: Any) -> Any:
        is_position = isinstance(key, Integral) and key not in seen
        return seen[key] if is_position and -len(seen) <= key < len(seen) else key

    others = {name_of(k) for r in ROLES[1:] for k in _keys(r, roles[r], known)}
    for role in ROLES:
        names = [name_of(key) for key in _keys(role, roles[role], known)]
        if role == "inputs":
            names = names or [name for name in seen if name not in others]
        absent = [name for name in names if name not in there]
        if names and not absent:
            found[role] = names if role in _SEVERAL else names[0]
        elif absent and role not in optional:
            lacking += [f"{name!r} ({role})" for name in absent]
            hint = did_you_mean(absent[0], table.names)
    if lacking:
        raise ValueError(
            "X must have the columns that the fit read. Got none of name "
            f"{', '.join(lacking)} among {listed_names(table.names)}.{hint}"
        )
    return found


def _as_matrix(estimator: Any, X: Any, *, numeric: bool) -> NDArray[Any]:
    """Check an array; with labels among its columns, their type is kept."""
    # A list is read as objects, lest numpy turns its numbers into text.
    dtype = np.float64 if numeric else None if hasattr(X, "dtype") else object
    return checked_array("X", X, dtype=dtype, estimator=estimator)


def _check_finite(
    matrix: Array,
    names: Sequence[Hashable],
    argument: str,
    labels: Sequence[Hashable],
    groups: Sequence[Indices],
    allow_missing: bool,
    remedy: str,
) -> None:
    """Refuse infinity, and NaN where it may not be, naming the first."""
    if matrix.max(initial=0.0) < SQUARED and matrix.min(initial=0.0) > -SQUARED:
        return
    finite = (np.abs(matrix) < SQUARED) | (allow_missing & np.isnan(matrix))
    if finite.all():
        return
    column = int(np.argmin(finite.all(axis=0)))
    row = int(np.argmin(finite[:, column]))
    where = next(k for k, rows in enumerate(groups) if row in rows)
    missing = np.isnan(matrix[row, column])
    what = "NaN" if missing else "infinity or a value too large to be squared"
    first = "" if missing else "put NaN where nothing was measured, then "
    raise ValueError(
        f"Input {argument} contains {what}. First in column {names[column]!r} of "
        f"experiment {labels[where]!r}, at row {row}: {first}fill the gap "
        f"(interpolate){remedy}"
    )


def _clocks(
    column: Column | None,
    labels: Sequence[Hashable],
    groups: Sequence[Indices],
    *,
    expected: Sequence[tuple[Clock, str]],
    **options: Any,
) -> list[Clock]:
    """Read the time column in every experiment; options as in `read_clock`."""
    if column is None:
        return [UNTIMED] * len(labels)
    seconds = time_in_seconds(column.values, column.name)
    local = are_local_times(column.values)
    clocks: list[Clock] = []
    rule, last = "All experiments must have the same time step", seconds[:0]
    for label, rows in zip(labels, groups, strict=True):
        stamps = seconds[rows]
        if clocks and np.array_equal(stamps, last):
            clocks.append(clocks[-1])
            continue
        last = stamps
        common = next((c for c in clocks if c.step is not None), UNTIMED)
        clock = read_clock(
            stamps,
            column=column.name,
            experiment=label,
            local=local,
            expected=[*expected, (common, rule)],
            **options,
        )
        clocks.append(clock)
    return clocks


def group_rows(
    column: Column | None, n_rows: int
) -> tuple[list[Hashable], list[Indices]]:
    """Labels of experiments in the order of first appearance, and the rows of each."""
    if n_rows == 0:
        raise ValueError("X must hold at least one sample. Got 0.")
    if column is None:
        return [0], [np.arange(n_rows)]
    rule = "hold one label in each row"
    with naming_argument(str(column.name), rule, column.values):
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
    rule = "hold one label in each row"
    with naming_argument(str(column.name), rule, column.values):
        values = pd.unique(pd.Series(column.values).iloc[rows])
    if len(values) > 1 or pd.isna(values[0]):
        raise ValueError(
            f"`operating_point` column {column.name!r} must hold one value per "
            f"experiment. Got {[as_scalar(v) for v in values[:3]]} in experiment "
            f"{label!r}; give the experiments a column with the role `experiment`, and "
            "continuous variables the role `scheduling`."
        )
    return as_scalar(values[0])


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
    if not isinstance(trajectories, Sequence) or isinstance(trajectories, str):
        raise ValueError(
            "`trajectories` must be a list of tuples (u, kappa, y) or (u, y). Got "
            f"{type(trajectories).__name__}."
        )
    if sampling_time is not None:
        sampling_time = positive_time("sampling_time", sampling_time)
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
    names = ("u", "y") if len(item) == 2 else ("u", "kappa", "y")
    arrays = {
        name: _as_columns(f"trajectories[{k}]: {name}", values)
        for name, values in zip(names, item, strict=True)
    }
    u, y, kappa = arrays["u"], arrays["y"], arrays.get("kappa")
    if kappa is not None and len(kappa) == 1:
        kappa = np.repeat(kappa, len(u), axis=0)
    lengths = [len(a) for a in (u, kappa, y) if a is not None]
    if len(set(lengths)) > 1:
        raise ValueError(
            f"`trajectories` must hold arrays of equal length. Got {lengths} in "
            f"trajectory {k}."
        )
    return u, kappa, y


def _as_columns(name: str, values: ArrayLike) -> Array:
    array = as_numbers(name, values)
    if array.ndim > 2:
        raise ValueError(
            f"`{name}` must have shape (n_samples, n_channels). Got {array.shape}."
        )
    return array if array.ndim == 2 else array.reshape(-1, 1)
