"""Records with uneven time put on an even grid."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import convolve1d

from ..validation import SQUARED, flag, number, one_of, positive_time
from .alignment import align_outputs
from .experiments import group_rows
from .tables import Column, Table, as_list, is_table
from .timestamps import missing_after, time_in_seconds

Array = NDArray[np.float64]

Indices = NDArray[np.intp]

# Share of the steps over which a signal does not change, from which it counts as held:
# white noise of two values stays at half of them, a measured signal at hardly any.
_HELD = 0.25

_DIGITS = 3  # of a step that is taken from the data
_SAME = 1e-6  # of a step: stamps closer than that are one
_MOST_POINTS = 10**8  # of all grids: more is a mistake in a time
_FINEST = 1000  # points of a grid for each sample: more is a mistake of units

_AS_FINE = 1.05  # steps of the grid per mean step of the record that need no smoothing


def resample(
    X: Any,
    y: Any = None,
    *,
    time: Any,
    sampling_time: float | None = None,
    experiment: Any = None,
    method: str = "linear",
    hold: Any = "auto",
    max_gap: float = 3.0,
    antialias: bool = True,
) -> tuple[Any, Any]:
    r"""Put records with uneven time stamps on an even grid.

    Parameters
    ----------
    X : DataFrame or array-like of shape (n_samples, n_features)
        Inputs, and columns with other roles.
    y : DataFrame, Series or array-like, default=None
        Outputs, with the same rows.
    time : column name, index level or position
        Column of sample times: seconds, dates or time differences. Rows of an
        experiment are put into their order.
    sampling_time : float, default=None
        Step of the grid, seconds. None: the mean step of the records where no sample is
        missing, to three digits.
    experiment : column name, index level or position, default=None
        Column that tells experiments apart, each of which has a grid of its own, from
        its first sample on.
    method : {"linear", "cubic"}, default="linear"
        Interpolation of what is not held: straight lines, or cubic splines, which are
        better for smooth signals sampled densely, and worse for noisy ones.
    hold : "auto", column name, position or list of them, default="auto"
        Inputs that keep their value from one sample to the next, as those of a computer
        do: they take their mean over every interval of the grid, which moves the system
        as far. "auto": columns of X that do not change over a quarter of the steps.
    max_gap : float, default=3.0
        Longest gap that is bridged, in steps (of the grid or of the record, whichever
        is longer); in longer ones values are NaN. Identify with ``missing="split"``.
    antialias : bool, default=True
        Whether to smooth all signals alike where the grid is coarser than the record.

    Returns
    -------
    X, y
        Tables like those given, with the columns, dtypes of labels and the levels of
        the index that have a role; their other labels give way to numbers. Columns that
        are constant within an experiment stay as they are; others that are not numbers
        take the value of the sample before. `y` is None if it was.

    Raises
    ------
    ValueError
        If an option is unknown, a role names no column, a time is repeated, an
        experiment has a single sample, or a value is infinite.

    Notes
    -----
    Where one step of the grid is m > 1 steps of the record, the record is brought to a
    grid m times as fine. All its signals pass the same filter without delay, a
    raised-cosine window (Hann) over two steps of the coarse grid, and every m-th sample
    is kept. What a linear system makes of a filtered input is the filtered output: the
    model stays the same. Above the sampling frequency of the coarse grid everything is
    30 dB down; from half of it on, by 6 dB and more, what is left folds back, in inputs
    and outputs alike. Longer filters are steeper there, and lose more beside gaps.

    Interpolation smooths noise, and noise that was white is so no longer: resample
    where `time_tol` does not do, not always.

    Examples
    --------
    >>> import pandas as pd
    >>> from lpvlearn import resample
    >>> t = [0.0, 0.11, 0.2, 0.29, 0.8, 0.9]
    >>> X, y = pd.DataFrame({"t": t, "u": [0, 0, 1, 1, 1, 0]}), pd.Series(t)
    >>> X_even, y_even = resample(X, y, time="t", sampling_time=0.1, max_gap=2)
    >>> X_even.assign(y=y_even)
         t    u    y
    0  0.0  0.0  0.0
    1  0.1  0.0  0.1
    2  0.2  1.0  0.2
    3  0.3  NaN  NaN
    4  0.4  NaN  NaN
    5  0.5  NaN  NaN
    6  0.6  NaN  NaN
    7  0.7  NaN  NaN
    8  0.8  1.0  0.8
    9  0.9  0.0  0.9
    """
    one_of("method", method, ("linear", "cubic"))
    max_gap = number("max_gap", max_gap, "at least 1 step", low=1.0)
    antialias = flag("antialias", antialias)
    y = align_outputs(X, y)
    table = Table(_as_frame(X))
    stamps, by_label = table.one(time, "time"), table.one(experiment, "experiment")
    if stamps is None:
        raise ValueError("`time` must name the column of sample times. Got None.")
    seconds = np.asarray(time_in_seconds(stamps.values, stamps.name), dtype=float)
    records = []
    for label, rows in zip(*group_rows(by_label, table.n_rows), strict=True):
        rows = rows[np.argsort(seconds[rows], kind="stable")]
        _check_stamps(seconds[rows], label, stamps.name)
        records.append(_Record(rows, seconds[rows]))
    own = np.concatenate([r.steps[~missing_after(r.steps)] for r in records]).mean()
    step = float(f"{own:.{_DIGITS}g}")
    if sampling_time is not None:
        step = positive_time("sampling_time", sampling_time)
        longest = max(record.seconds[-1] - record.seconds[0] for record in records)
        if not own / _FINEST <= step <= longest:
            raise ValueError(
                f"`sampling_time` must be {own / _FINEST:.3g} s ({_FINEST} points for "
                f"each sample) to {longest:.6g} s, the longest record. Got {step} s."
            )
    # As many points of a finer grid to each point as the record has samples.
    n_fine = int(np.ceil(step / (_AS_FINE * own))) if antialias else 1
    gap = max_gap * max(step, float(own))
    grids = [_Grid(record, step, n_fine, gap, method) for record in records]
    n_points = sum(float(r.seconds[-1] - r.seconds[0]) / step for r in records)
    if n_points > _MOST_POINTS:
        raise ValueError(
            f"Column {stamps.name!r} must not span more than {_MOST_POINTS:,} steps in "
            f"all. Got {n_points:.4g} of {step:.4g} s. Check its first and last "
            "times, or give a longer `sampling_time`."
        )

    roles = [stamps.name] + ([] if by_label is None else [by_label.name])
    levels = [
        name for name in table.levels if name in roles and name not in table.names
    ]
    frame = table.X.reset_index(levels) if levels else table.X
    if isinstance(hold, str) and hold == "auto" and "auto" not in table.names:
        held = [
            c.name
            for c in map(table.at, range(len(table.names)))
            if _looks_held(c, records)
        ]
    else:
        keys = as_list(hold, table.names)
        held = [c.name for c in table.several(keys or None, "hold")]
    even = _on_grids(frame.drop(columns=stamps.name), grids, held)
    place = list(frame).index(stamps.name)
    even.insert(place, stamps.name, _even_stamps(stamps, grids))
    even = even.set_index(levels) if levels else even
    if y is None:
        return _like(X, even), None
    outputs = _on_grids(_as_frame(y), grids, []).set_index(even.index)
    return _like(X, even), _like(y, outputs)


class _Record(NamedTuple):
    """Rows of the samples of an experiment, in the order of time, and their times."""

    rows: Indices
    seconds: Array

    @property
    def steps(self) -> Array:
        return np.diff(self.seconds)


class _Grid(NamedTuple):
    """The even grid of a record, and how its signals come to it."""

    record: _Record
    step: float  # seconds
    n_fine: int  # points of a finer grid to each of this one: 1 does not smooth
    gap: float  # seconds, of the longest gap that is bridged
    method: str

    def __len__(self) -> int:
        length = self.record.seconds[-1] - self.record.seconds[0]
        return 1 + int(length / self.step + _SAME)

    @property
    def before(self) -> Indices:
        """For every point of the grid, the row of the sample before (or there)."""
        t, n = self.record.seconds, len(self)
        points = t[0] + self.step * (np.arange(n) + _SAME)
        return self.record.rows[np.searchsorted(t, points, "right") - 1]

    def signal(self, values: Array, held: bool) -> Array:
        """A signal of all rows of the table at the points of the grid."""
        own, n = values[self.record.rows], len(self)
        known = ~np.isnan(own)
        if not known.any():
            return np.full(n, np.nan)
        t, own, h = self.record.seconds[known], own[known], self.step / self.n_fine
        points = self.record.seconds[0] + h * np.arange(n * self.n_fine)
        if held:
            fine = _mean_of_held(t, own, points, h)
        elif self.method == "linear" or len(t) < 2:
            fine = np.interp(points, t, own)
        else:
            fine = CubicSpline(t, own)(np.clip(points, t[0], t[-1]))
        fine[self._unknown(points, t, bool(known[-1]))] = np.nan
        if self.n_fine > 1:
            window = np.hanning(2 * self.n_fine + 1)
            fine = convolve1d(fine, window / window.sum(), mode="nearest")
        by_point = fine.reshape(n, self.n_fine)
        return by_point.mean(axis=1) if held else by_point[:, 0]

    def _unknown(self, points: Array, t: Array, to_the_end: bool) -> NDArray[np.bool_]:
        """Points in long gaps between the times of a signal, or outside of them."""
        slop = _SAME * self.step
        before = np.searchsorted(t, points + slop, "right") - 1
        long = np.append(np.diff(t) > self.gap, not to_the_end)
        return (before < 0) | (long[before] & (points > t[before] + slop))


def _mean_of_held(t: Array, values: Array, points: Array, h: float) -> Array:
    """Mean of a signal over ``points`` to ``points + h`` that is held from t on."""
    integral = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(t))])

    def up_to(x: Array) -> Array:
        k = np.clip(np.searchsorted(t, x, "right") - 1, 0, None)
        return integral[k] + values[k] * (x - t[k])

    # Where it does not change the value itself, without the rounding of the integral.
    first, last = (
        np.clip(np.searchsorted(t, x, "right") - 1, 0, None)
        for x in (points + _SAME * h, points + (1 - _SAME) * h)
    )
    mean = (up_to(points + h) - up_to(points)) / h
    return np.where(first == last, values[first], mean)


def _looks_held(column: Column, records: Sequence[_Record]) -> bool:
    """Whether a column of numbers keeps its value over many of the steps."""
    values = _numbers(column)
    if values is None:
        return False
    steps = np.concatenate([np.diff(values[record.rows]) for record in records])
    steps = steps[~np.isnan(steps)]
    return bool(np.mean(steps == 0) >= _HELD) if len(steps) else False


def _numbers(column: Column) -> Array | None:
    """Values of a column as floats; None of labels and dates."""
    try:
        values = column.numbers("X")
    except ValueError:
        return None
    huge = ~(np.abs(values) < SQUARED) & ~np.isnan(values)
    if huge.any():
        raise ValueError(
            f"Column {column.name!r} must hold numbers below {SQUARED:g}, or NaN where "
            f"one is missing. Got {values[huge][0]} at row {int(np.argmax(huge))}; "
            "what is no measurement should be missing."
        )
    return values


def _on_grids(
    frame: pd.DataFrame, grids: Sequence[_Grid], held: Sequence[Hashable]
) -> pd.DataFrame:
    """A table at the points of the grids, its rows numbered."""
    table = Table(frame)
    out = frame.iloc[np.concatenate([grid.before for grid in grids])]
    out = out.reset_index(drop=True)
    for position, name in enumerate(table.names):
        column = table.at(position)
        values = _numbers(column)
        if values is None or all(np.ptp(values[g.record.rows]) == 0 for g in grids):
            continue  # labels and constants
        even = [grid.signal(values, name in held) for grid in grids]
        out[name] = np.concatenate(even)
    return out


def _even_stamps(column: Column, grids: Sequence[_Grid]) -> Any:
    """Times of the points of the grids, in the unit of the column."""
    series, parts = pd.Series(column.values).infer_objects(), []
    for grid in grids:
        elapsed: Any = grid.step * np.arange(len(grid))
        if series.dtype.kind in "mM":
            elapsed = pd.to_timedelta(elapsed, unit="s")
        parts.append(pd.Series(series.iloc[grid.record.rows[0]] + elapsed))
    return pd.concat(parts, ignore_index=True)


def _check_stamps(seconds: Array, label: Hashable, name: Hashable) -> None:
    if len(seconds) < 2:
        raise ValueError(
            "`experiment` must tell records of at least 2 samples apart. Got 1 in "
            f"experiment {label!r}; leave it out."
        )
    if np.diff(seconds).min() <= 0:
        k = int(np.argmin(np.diff(seconds)))
        raise ValueError(
            f"Time column {name!r} must hold every time once in an experiment. Got "
            f"{seconds[k]:.9g} s twice in experiment {label!r}. Drop rows that stand "
            "twice (drop_duplicates of pandas), or name the column `experiment`."
        )


def _as_frame(X: Any) -> pd.DataFrame:
    """A table as one of pandas, of which every column has its own type."""
    if isinstance(X, pd.DataFrame):
        return X
    if isinstance(X, pd.Series):
        return X.to_frame(0 if X.name is None else X.name)
    if is_table(X):
        return pd.DataFrame({name: np.asarray(X[name]) for name in X.columns})
    if np.ndim(X) not in (1, 2):
        raise ValueError(
            "X and `y` must be tables or arrays, (n_samples, n_columns). Got "
            f"{type(X).__name__}."
        )
    return pd.DataFrame(X if hasattr(X, "dtype") else list(X)).infer_objects()


def _like(given: Any, even: pd.DataFrame) -> Any:
    """A resampled table in the form of the one that was given."""
    if isinstance(given, pd.Series):
        return even.iloc[:, 0].rename(given.name)
    if is_table(given):
        return even
    return even.to_numpy()[:, 0] if np.ndim(given) == 1 else even.to_numpy()
