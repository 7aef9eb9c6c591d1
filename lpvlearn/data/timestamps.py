"""Time columns: seconds from numbers or datetimes, and the guard on even sampling."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from contextlib import suppress
from datetime import date, time
from numbers import Complex, Real
from typing import Any, NamedTuple, NoReturn

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..exceptions import warn
from ..validation import first_not_a_number, shown
from .text_numbers import reading_of

Indices = NDArray[np.intp]

# Relative tolerance on a single time step (beyond the rounding of its stamps), and on
# the mean step against a declared one, which may be a rounded number itself.
_STEP_RTOL, _SAMPLING_TIME_RTOL = 1e-6, 1e-4

# Steps beyond so many typical ones leave out a sample. Stamps may be off the grid by
# less than half of what is left to that: then no jitter looks like a gap.
_GAP, _LARGEST_TOL = 1.6, 0.25

TIME_TOL = 0.01  # of the estimators: what a clock's jitter costs is far below noise

# Decimals that stamps are tried for, down to nanoseconds. A stamp counts as a multiple
# of the unit within the first slop, or its own rounding if that is larger; beyond the
# second every number is one.
_MAX_DECIMALS = 9
_SLOP, _LARGEST_SLOP = 1e-6, 0.01

_LATEST = 1e30  # seconds: single precision holds them too

_HOUR = 3600.0  # s
_OF_A_ZONE = (
    "A jump by an hour is that of a clock to or from summer time: give times with "
    "their zone (pandas.Series.dt.tz_localize, with ambiguous='infer'), or in UTC."
)
_USE_INSTEAD = (
    "A dynamic model needs the samples of an experiment complete and in the order of "
    "time. Do not shuffle rows: split by experiment with ExperimentSplit, GroupKFold "
    "or LeaveOneGroupOut, or in time with BlockedTimeSeriesSplit or TimeSeriesSplit."
)

_CUT_THERE = (
    "Identify with missing='split' (of SubspaceLTI), which cuts the record there, or "
    "fill short gaps with lpvlearn.resample. Predictions past a gap need an initial "
    "state: predict_with_initial_state, or a scorer with initial_state='estimate'. In "
    "cross-validation split by experiment with ExperimentSplit, or in time with "
    "BlockedTimeSeriesSplit: blocks of rows leave others with a hole."
)

_RESTARTS = (
    "Where a table holds several experiments, `experiment` must name the column that "
    "tells them apart. "
)

# Stamps beyond are no seconds since 1970, but parts of them: the year 5138.
_SINCE_1970 = 1e11
_UNITS_SINCE_1970 = (
    ("ms", "milliseconds", 1e14),
    ("us", "microseconds", 1e17),
    ("ns", "nanoseconds", np.inf),
)

# Numbers whose digits are those of a date, by how many they are; years that are meant,
# and how many numbers are looked at, of so many at least.
_WRITTEN = {8: "%Y%m%d", 10: "%Y%m%d%H", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}
_YEARS = 1900, 2100
_FEWEST, _LOOKED_AT = 3, 1000

# Share of the steps up to which a table does not look shuffled: those that go back in
# time, where experiments follow each other, or leave rows out, as a logger does.
_FEW = 0.05
_OFTEN = 0.2  # share of equal stamps from which rounding makes them


def _series(values: Any) -> pd.Series:
    series = pd.Series(values)
    with suppress(OverflowError):  # of integers beyond floats, in older versions
        series = series.infer_objects()
    return series


def are_local_times(values: Any) -> bool:
    """Whether times are dates without a zone, which summer time may shift.

    >>> dates = pd.date_range("2024-10-27", periods=3, freq="s")
    >>> are_local_times(dates), are_local_times(dates.tz_localize("UTC"))
    (True, False)
    """
    dtype = _series(values).dtype
    return getattr(dtype, "kind", "O") == "M" and getattr(dtype, "tz", None) is None


def time_in_seconds(values: Any, column: Hashable) -> NDArray[np.floating]:
    """Seconds from numbers (seconds already), or datetimes (from the earliest).

    A float32 column stays float32: its rounding is part of the guard's tolerance.
    Raises a ValueError on what is neither a finite number nor a date, naming `column`.
    """
    series = _series(values)
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
        if kind == "O":
            text = np.array([isinstance(value, str | bytes) for value in series])
            if text.any():  # which NumPy reads, and nothing else adds to
                row = first_not_a_number(series.astype(object).where(text, 0.0))
                row = int(np.argmax(text)) if row is None else row
                _raise_bad_time(column, row, series)
        try:
            seconds = series.to_numpy(dtype=np.float64, na_value=np.nan)
        except (TypeError, ValueError, ArithmeticError):
            _raise_bad_time(column, first_not_a_number(series) or 0, series)
    finite = np.abs(seconds) < _LATEST
    if not finite.all():
        _raise_bad_time(column, int(np.argmin(finite)), series)
    written = _format_of_dates(seconds)
    if written is not None:
        raise ValueError(
            f"Time column {column!r} must hold seconds or dates. Got numbers like "
            f"{seconds[0]:.0f}, whose digits are those of a date. Give dates: "
            f"pandas.to_datetime(X[{column!r}].astype('int64').astype(str), "
            f"format={written!r}); or subtract the first, if they are seconds."
        )
    if len(seconds) and seconds.min() > _SINCE_1970:
        unit, name = next(
            (unit, name)
            for unit, name, most in _UNITS_SINCE_1970
            if seconds.min() < most
        )
        warn(
            f"Time column {column!r} begins at {seconds.min():.4g}. Numbers are read "
            f"as seconds; if these are {name} since 1970, give dates instead: "
            f"pandas.to_datetime(X[{column!r}], unit={unit!r})."
        )
    return seconds


def _format_of_dates(numbers: NDArray[np.floating]) -> str | None:
    """The format of dates, where numbers are written like that: 20240131."""
    if len(numbers) < _FEWEST or not numbers.min() > 10.0**7:
        return None
    written = _WRITTEN.get(len(f"{numbers.min():.0f}"))
    some = numbers[:: max(len(numbers) // _LOOKED_AT, 1)]
    if written is None or (some != np.rint(some)).any():
        return None
    texts = pd.Series(some).map("{:.0f}".format)
    years = pd.to_datetime(texts, format=written, errors="coerce").dt.year
    return written if years.between(*_YEARS).all() else None


class Clock(NamedTuple):
    """What the stamps of one experiment tell."""

    step: float | None  # seconds; None for a single sample
    jitter: float  # largest deviation from the even grid, relative to the step
    breaks: Indices  # samples before which others are missing
    slack: float = 0.0  # seconds, by which the step may be wrong


UNTIMED = Clock(None, 0.0, np.empty(0, dtype=np.intp))  # a table without stamps


def check_time_tol(time_tol: Any) -> float:
    """The argument `time_tol` as a float, or a ValueError that names its limits."""
    number = isinstance(time_tol, Real)
    number &= not isinstance(time_tol, bool | np.timedelta64)
    if not number or not 0.0 <= time_tol < _LARGEST_TOL:
        raise ValueError(
            "`time_tol` must be a share of the time step, at least 0 and less than "
            f"{_LARGEST_TOL}. Got {time_tol!r}. For worse use lpvlearn.resample."
        )
    return float(time_tol)


def _is_clock_change(steps: NDArray[Any], k: int) -> bool:
    """Whether a step is an hour longer, or shorter, than the others."""
    typical = float(np.median(steps))
    off = abs(abs(steps[k] - typical) - _HOUR)
    return typical < 0.5 * _HOUR and off <= _LARGEST_TOL * typical


def read_clock(
    seconds: NDArray[Any],
    *,
    column: Hashable,
    experiment: Hashable,
    time_tol: float = 0.0,
    allow_missing: bool = False,
    local: bool = False,
    expected: Sequence[tuple[Clock, str]] = (),
) -> Clock:
    """Read the stamps of an experiment, which must increase on an even grid.

    They may deviate from it by `time_tol` times the step, and by their rounding (to a
    number of decimals or to single precision: by one unit of the last place, as long
    as that is less than half the step). With `allow_missing` samples may be missing;
    the grid after them need not be that before. Of `local` times a jump by an hour is
    told to be that of a clock. Raises a ValueError where time is
    otherwise, or its step not the one `expected`: pairs of a clock and of the rule that
    the message begins with.

    >>> clock = read_clock(np.array([0, 1, 2, 5, 6, 7]), column="t", experiment=0,
    ...                    allow_missing=True)
    >>> clock.step, clock.breaks
    (1.0, array([3]))
    """
    if len(seconds) < 2:
        return UNTIMED
    precision = _float_precision(seconds) * float(np.abs(seconds).max())
    t = seconds.astype(np.float64, copy=False)
    steps = np.diff(t)
    where = f"Time column {column!r} of experiment {experiment!r}"
    _check_increasing(t, steps, where, column, local)
    missing = missing_after(steps)
    kept = steps[~missing] if missing.any() else steps
    step, off = float(kept.mean()), _off_grid(t, missing)
    unit = _decimal_unit(t)
    # A step is the difference of two rounded stamps: off by one unit of their decimals,
    # and by twice their precision, as long as these are well below the step itself.
    rounding = (unit if unit < 0.5 * step else 0.0) + min(2 * precision, 0.25 * step)
    single = _STEP_RTOL * step + rounding + 2 * time_tol * step
    # The second condition tells a scatter around one even grid from a clock that
    # changes its pace within the record.
    drift = rounding + len(t) * (_STEP_RTOL * step + 2 * precision) + time_tol * step
    uneven = max(kept.max() - step, step - kept.min()) > single
    if uneven or np.abs(off).max() > drift:
        if uneven and missing.any():  # then it is rather one grid that nothing keeps to
            off = _off_grid(t, np.zeros_like(missing))
        typical, k = float(np.median(steps)), int(np.argmax(np.abs(off)))
        j = int(np.argmax(np.abs(steps - typical)))
        raise ValueError(
            f"{where} must be evenly spaced. Got a step of {steps[j]:.9g} s after its "
            f"sample {j}, against {typical:.9g} s elsewhere. The largest deviation "
            f"from an even grid is {abs(off[k]):.3g} s at sample {k}, "
            f"{abs(off[k]) / typical:.2g} of the step; `time_tol` accepts a share of "
            f"the step (here {time_tol:g}). For more, lpvlearn.resample puts the "
            f"record on an even grid. {_USE_INSTEAD}"
        )
    if not allow_missing:
        _check_complete(steps, missing, step, where, local)
    slack = 2 * (rounding + time_tol * step) / (len(t) - 1 - missing.sum())
    for clock, rule in expected:
        known = step if clock.step is None else clock.step
        if abs(step - known) <= _SAMPLING_TIME_RTOL * known + slack + clock.slack:
            continue
        raise ValueError(
            f"{rule}. Got {known:.9g} s, and {step:.9g} s in column {column!r} of "
            f"experiment {experiment!r}; {_about_units(step / known)}."
        )
    jitter = float(np.abs(off).max()) / step
    return Clock(step, jitter, np.flatnonzero(missing) + 1, slack)


def _check_increasing(
    t: NDArray[np.float64],
    steps: NDArray[np.float64],
    where: str,
    column: Hashable,
    local: bool,
) -> None:
    """Refuse stamps that stay or go back, with the remedy for what they look like."""
    if not steps.min() <= 0:
        return
    k = int(np.argmin(steps > 0))
    remedy = _USE_INSTEAD
    if steps.min() == 0 and np.mean(steps == 0) > _OFTEN:
        remedy = (
            "Many stamps stand twice: they are rounded more coarsely than samples "
            "come. Leave `time` out and give the step, `sampling_time`. If it is "
            "the rows that stand twice, drop these (drop_duplicates of pandas)."
        )
    elif steps[k] == 0:
        remedy = "Drop rows that stand twice (drop_duplicates of pandas). " + remedy
    elif local and _is_clock_change(steps, k):
        remedy = _OF_A_ZONE
    elif np.sum(steps <= 0) <= _FEW * len(t):
        remedy = _RESTARTS + remedy
    else:
        remedy = (
            "Rows of a log that are only out of order are to be sorted, those of y "
            f"with them: table.sort_values({column!r}) before it is taken apart. "
        ) + remedy
    raise ValueError(
        f"{where} must increase. Got {t[k]:.9g} s followed by {t[k + 1]:.9g} s at "
        f"its samples {k} and {k + 1}. {remedy}"
    )


def _check_complete(
    steps: NDArray[np.float64],
    missing: NDArray[np.bool_],
    step: float,
    where: str,
    local: bool,
) -> None:
    """Refuse missing samples, with the remedy for what they look like."""
    if not missing.any():
        return
    k = int(np.argmax(missing))
    remedy = _CUT_THERE
    if local and _is_clock_change(steps, k):
        remedy = f"{_OF_A_ZONE} Where the logger rested: {remedy}"
    if missing.sum() > _FEW * (len(steps) + 1):
        remedy = (
            f"{_USE_INSTEAD} If a logger lost them: {remedy[0].lower()}{remedy[1:]}"
        )
        if np.sum(missing[1:] & missing[:-1]) > missing.sum() // 2:
            longest = np.quantile(steps[missing], 0.9)
            remedy = (
                "If the logger changed its rate, lpvlearn.resample with "
                f"sampling_time={longest:.3g} puts all of it on one grid. {remedy}"
            )
    n_missing = np.maximum(1, np.rint(steps[missing] / step) - 1).sum()
    raise ValueError(
        f"{where} must be evenly spaced. Got a step of {steps[k]:.9g} s after its "
        f"sample {k}, against {step:.9g} s elsewhere: about {n_missing:.0f} row(s) "
        f"are missing, at {missing.sum()} place(s). {remedy}"
    )


def missing_after(
    steps: NDArray[np.float64], typical: float | None = None
) -> NDArray[np.bool_]:
    """Steps so long that samples must be missing within; `typical` is their median."""
    return steps > _GAP * (np.median(steps) if typical is None else typical)


def _off_grid(
    t: NDArray[np.float64], missing: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Stamps about even grids of one step, the best (least squares) through all runs.

    Runs are what is between missing samples.
    """
    first = np.concatenate([[0], np.flatnonzero(missing) + 1])
    lengths = np.diff(first, append=len(t))
    number = np.arange(len(t), dtype=float)
    elapsed = t - (np.repeat(t[first], lengths) if len(first) > 1 else t[0])
    for x in (number, elapsed):  # in place: records may be long
        mean = np.add.reduceat(x, first) / lengths
        x -= np.repeat(mean, lengths) if len(mean) > 1 else mean
    number *= (number @ elapsed) / (number @ number)
    elapsed -= number
    return elapsed


def check_unit(step: float | None, fitted: float, column: Hashable) -> None:
    """Refuse a step that is that of the fit in another unit of time."""
    if step is not None and _power_of_1000(step / fitted):
        raise ValueError(
            f"X must have the unit of time of the fit. Got a step of {step:.9g} s in "
            f"column {column!r}, and {fitted:.9g} s in the fit; "
            f"{_about_units(step / fitted)}."
        )


def _power_of_1000(ratio: float) -> bool:
    power = np.log(ratio) / np.log(1000.0)
    return abs(power) > 0.5 and abs(power - round(power)) < _SAMPLING_TIME_RTOL


def _about_units(ratio: float) -> str:
    """What a step that is so many times another may come from."""
    if not _power_of_1000(ratio):
        return (
            "times are in seconds, and lpvlearn.resample puts records on the grid of "
            "another step"
        )
    return (
        f"{max(ratio, 1 / ratio):.0f} times {'as long' if ratio > 1 else 'shorter'}: "
        "numbers are read as seconds. Divide a column of milliseconds by 1000, or give "
        "dates or time differences, which tell their unit"
    )


def _float_precision(seconds: NDArray[Any]) -> float:
    """Relative rounding of stamps, single even when stored as double."""
    is_single = (seconds.astype(np.float32) == seconds).all()
    return float(np.finfo(np.float32 if is_single else np.float64).eps)


def _decimal_unit(seconds: NDArray[np.float64]) -> float:
    """Unit of the last decimal place that the stamps use, 0 if none."""
    for decimals in range(_MAX_DECIMALS + 1):
        scaled = seconds * 10.0**decimals
        largest = max(float(scaled.max()), -float(scaled.min()))
        slop = max(_SLOP, 4 * np.finfo(float).eps * largest)
        if slop > _LARGEST_SLOP:
            break
        scaled -= np.round(scaled)
        if max(scaled.max(), -scaled.min()) <= slop:
            return 10.0**-decimals
    return 0.0


def _raise_bad_time(column: Hashable, row: int, series: pd.Series) -> NoReturn:
    value = series.iloc[row]
    missing = pd.api.types.is_scalar(value) and pd.isna(value)
    raise ValueError(
        f"Time column {column!r} must hold finite numbers (seconds) or datetimes. Got "
        f"{'no time' if missing else shown(value)} at row {row}. {_remedy(value)}"
    )


def _remedy(value: Any) -> str:
    """What to do about what is no time."""
    if isinstance(value, str | bytes):
        return reading_of(value) or (
            "Convert text of dates with pandas.to_datetime, of numbers with "
            "pandas.to_numeric."
        )
    if isinstance(value, pd.Period):
        return "Convert periods with their to_timestamp()."
    if isinstance(value, date) and value is not pd.NaT:
        return "Convert dates with pandas.to_datetime."
    if isinstance(value, time):
        return "Convert times of day with pandas.to_timedelta(column.astype(str))."
    if isinstance(value, Complex) and not isinstance(value, Real):
        return "Give seconds as real numbers."
    return (
        f"Drop rows without a time below {_LATEST:g} s: with missing='split' they are "
        "a gap."
    )
