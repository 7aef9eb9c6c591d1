"""Time columns: seconds from numbers or datetimes, and the guard on even sampling."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, NoReturn

import numpy as np
import pandas as pd
from numpy.typing import NDArray

# Relative tolerance on a single time step (beyond the rounding of its stamps), and on
# the mean step against a declared one, which may be a rounded number itself.
_STEP_RTOL, _SAMPLING_TIME_RTOL = 1e-6, 1e-4

# Decimals that stamps are tried for, down to nanoseconds. A stamp counts as a multiple
# of the unit within the first slop, or its own rounding if that is larger; beyond the
# second every number is one.
_MAX_DECIMALS = 9
_SLOP, _LARGEST_SLOP = 1e-6, 0.01

_USE_INSTEAD = (
    "A dynamic model needs the samples of an experiment complete and in the order of "
    "time. Do not shuffle rows: split by experiment with ExperimentSplit, GroupKFold "
    "or LeaveOneGroupOut, or in time with BlockedTimeSeriesSplit or TimeSeriesSplit; "
    "resample a record that was taken unevenly."
)

_RESTARTS = (
    "Where a table holds several experiments, `experiment` must name the column that "
    "tells them apart. "
)

# Share of the steps that go back in time, up to which a table looks like experiments
# one after the other rather than shuffled.
_FEW = 0.05


def time_in_seconds(values: Any, column: Hashable) -> NDArray[np.floating]:
    """Seconds from numbers (seconds already), or datetimes (from the earliest).

    A float32 column stays float32: its rounding is part of the guard's tolerance.
    Raises a ValueError on what is neither a finite number nor a date, naming `column`.
    """
    series = pd.Series(values).infer_objects()
    kind = getattr(series.dtype, "kind", "O")
    if kind in "mM":
        if series.isna().any():
            _raise_bad_time(column, int(np.argmax(series.isna())), series)
        # Differences of integers: a float of today's date in seconds has no digits left
        # for microseconds.
        elapsed = pd.Series(series - series.min()).to_numpy("timedelta64[ns]")
        return elapsed.astype(np.int64) * 1e-9
    if series.dtype == np.float32:
        seconds = series.to_numpy()
    else:
        if kind == "c":
            _raise_bad_time(column, 0, series)
        try:
            seconds = series.to_numpy(dtype=np.float64, na_value=np.nan)
        except (TypeError, ValueError):
            numbers = pd.to_numeric(series, errors="coerce")
            _raise_bad_time(column, int(np.argmax(numbers.isna())), series)
    finite = np.isfinite(seconds)
    if not finite.all():
        _raise_bad_time(column, int(np.argmin(finite)), series)
    return seconds


def check_uniform_time(
    seconds: NDArray[Any],
    *,
    column: Hashable,
    experiment: Hashable,
    sampling_time: float | None = None,
    other_step: float | None = None,
) -> float | None:
    """Check that time increases evenly; its mean step (None for a single sample).

    Stamps may be rounded, to a number of decimals or to single precision: they then
    scatter around an even grid by one unit of the last place, which is accepted as
    long as that unit is less than half the step. Raises a ValueError when time does
    not increase, is uneven, or has another step than declared to the estimator
    (`sampling_time`) or found in the other experiments (`other_step`).
    """
    n_samples = len(seconds)
    if n_samples < 2:
        return None
    precision = _float_precision(seconds) * float(np.abs(seconds).max())
    t = seconds.astype(np.float64)
    steps = np.diff(t)
    where = f"Time column {column!r} of experiment {experiment!r}"
    if steps.min() <= 0:
        k = int(np.argmin(steps > 0))
        remedy = _USE_INSTEAD
        if steps[k] == 0:
            remedy = "Drop rows that stand twice (drop_duplicates of pandas). " + remedy
        elif np.sum(steps <= 0) <= _FEW * n_samples:
            remedy = _RESTARTS + remedy
        raise ValueError(
            f"{where} must increase. Got {t[k]:.9g} s followed by {t[k + 1]:.9g} s at "
            f"its samples {k} and {k + 1}. {remedy}"
        )
    step = float(t[-1] - t[0]) / (n_samples - 1)
    unit = _decimal_unit(t)
    # A step is the difference of two rounded stamps: off by one unit of their decimals,
    # and by twice their precision, as long as these are well below the step itself.
    rounding = (unit if unit < 0.5 * step else 0.0) + min(2 * precision, 0.25 * step)
    tolerance = _STEP_RTOL * step + rounding
    # The second condition only bites on rounded stamps: it tells a scatter around one
    # even grid from a clock that changes its pace within the record.
    grid = t[0] + step * np.arange(n_samples)
    drift = rounding + n_samples * (_STEP_RTOL * step + 2 * precision)
    deviation = np.abs(steps - step)
    if deviation.max() > tolerance or np.abs(t - grid).max() > drift:
        typical = float(np.median(steps))
        k = int(np.argmax(np.abs(steps - typical)))
        raise ValueError(
            f"{where} must be evenly spaced. Got a step of {steps[k]:.9g} s after its "
            f"sample {k}, against {typical:.9g} s elsewhere. {_USE_INSTEAD}"
        )
    slack = 2 * rounding / (n_samples - 1)
    for expected, source in (
        (sampling_time, "`sampling_time` must be the step of the time column"),
        (other_step, "All experiments must have the same time step"),
    ):
        if expected is None:
            continue
        if abs(step - expected) > _SAMPLING_TIME_RTOL * expected + slack:
            raise ValueError(
                f"{source}. Got {expected:.9g} s, and {step:.9g} s in column "
                f"{column!r} of experiment {experiment!r}; times are in seconds."
            )
    return step


def _float_precision(seconds: NDArray[Any]) -> float:
    """Relative rounding of stamps, single even when stored as double."""
    is_single = (seconds.astype(np.float32) == seconds).all()
    return float(np.finfo(np.float32 if is_single else np.float64).eps)


def _decimal_unit(seconds: NDArray[np.float64]) -> float:
    """Unit of the last decimal place that the stamps use, 0 if none."""
    for decimals in range(_MAX_DECIMALS + 1):
        scaled = seconds * 10.0**decimals
        slop = max(_SLOP, 4 * np.finfo(float).eps * float(np.abs(scaled).max()))
        if slop > _LARGEST_SLOP:
            break
        if np.abs(scaled - np.round(scaled)).max() <= slop:
            return 10.0**-decimals
    return 0.0


def _raise_bad_time(column: Hashable, row: int, series: pd.Series) -> NoReturn:
    raise ValueError(
        f"Time column {column!r} must hold finite numbers (seconds) or datetimes. Got "
        f"{series.iloc[row]!r} at row {row}; convert text with pandas.to_datetime."
    )
