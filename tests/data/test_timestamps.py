"""Time stamps: even however they are stored, or refused."""

import re
from datetime import date, time

import numpy as np
import pandas as pd
import pytest

from lpvlearn import SubspaceLTI
from lpvlearn.data.timestamps import (
    UNTIMED,
    check_time_tol,
    read_clock,
    time_in_seconds,
)


@pytest.mark.parametrize(
    "stamps",
    [
        np.arange(3000) / 1000,
        np.arange(3000) / 300,
        np.round(np.arange(3000) / 300, 3),
        np.round(5.1234 + np.arange(3000) / 440.0, 3),
        (np.arange(3000) * 1e-3).astype(np.float32),
        (np.arange(3000) * 1e-3).astype(np.float32).astype(float),
        1e6 + np.arange(3000) / 1000,
        np.cumsum(np.full(3000, 1e-3)),
        np.arange(3000),
        pd.date_range("2024-05-01", periods=3000, freq="10ms"),
        pd.date_range("2024-05-01", periods=3000, freq="10ms", tz="Europe/Paris"),
        pd.to_timedelta(np.arange(3000) * 100, unit="us"),
    ],
    ids=[
        "exact", "thirds", "3 decimals", "3 decimals, offset", "float32",
        "float32 as double", "large offset", "summed", "integers", "datetime",
        "time zone", "timedelta",
    ],
)  # fmt: skip
def test_even_time_passes_however_it_is_stored(stamps):
    seconds = time_in_seconds(stamps, "t")
    step = read_clock(seconds, column="t", experiment=0).step
    expected = float(seconds[-1] - seconds[0]) / 2999
    np.testing.assert_allclose(step, expected, rtol=1e-6)
    # One sample lost is seen in all of them.
    lost = np.delete(seconds, 1500)
    with pytest.raises(ValueError, match=r"1 row\(s\) are missing, at 1 place"):
        read_clock(lost, column="t", experiment=0)
    clock = read_clock(lost, column="t", experiment=0, allow_missing=True)
    np.testing.assert_allclose(clock.step, expected, rtol=1e-4)
    assert clock.breaks.tolist() == [1500]


@pytest.mark.parametrize(
    ("stamps", "remedy"),
    [
        ([0, 1, 2, 4], "missing='split'.*resample"),
        ([0.0, 0.1, 0.25, 0.3], "`time_tol`.*resample"),
        ([0.0, 0.1, 0.1, 0.2, 0.3, 0.4, 0.5], "Drop rows that stand twice"),
        ([0.3, 0.2, 0.1], r"sort_values\(.t.\).*Do not shuffle"),
        (np.r_[np.arange(100) / 10, 9.9 + 0.11 * np.arange(1, 100)], "`time_tol`"),
        (np.round(np.cumsum(np.repeat([1.00, 1.06], 500)), 1), "`time_tol`"),
    ],
    ids=["gap", "jitter", "repeat", "reversed", "two paces", "two rounded paces"],
)
def test_uneven_time_raises_and_says_what_to_use(stamps, remedy):
    with pytest.raises(ValueError, match="GroupKFold.*TimeSeriesSplit") as raised:
        read_clock(np.asarray(stamps, float), column="t", experiment=0)
    assert re.search(remedy, str(raised.value))


@pytest.mark.parametrize("hour", [3600.0, -3600.0])
def test_a_jump_by_an_hour_is_that_of_a_clock_without_its_zone(hour):
    since = pd.Timestamp("2024-05-01")

    def told(jump, **zone):
        stamps = 0.1 * np.arange(400) + jump * (np.arange(400) >= 200)
        dates = (since + pd.to_timedelta(stamps, unit="s")).tz_localize(**zone)
        X = pd.DataFrame({"u": np.arange(400.0), "t": dates})
        with pytest.raises(ValueError, match="must (increase|be evenly)") as raised:
            SubspaceLTI(2, time="t").fit(X, np.arange(400.0))
        return "summer time: give times with their zone" in str(raised.value)

    assert told(hour, tz=None)
    assert not told(hour, tz="UTC")
    assert not told(0.9 * hour, tz=None)


@pytest.mark.parametrize("step", [60, 600, 900, 1500])
def test_lost_rows_are_no_change_of_a_clock(step):
    for n_lost in range(1, 8):
        stamps = np.delete(float(step) * np.arange(400), range(100, 100 + n_lost))
        for local in (False, True):
            with pytest.raises(ValueError, match="row.s. are missing") as raised:
                read_clock(stamps, column="t", experiment=0, local=local)
            an_hour = local and step * n_lost == 3600
            assert ("summer time" in str(raised.value)) == an_hour


def test_stamps_that_are_rounded_too_coarsely_are_no_rows_that_stand_twice():
    stamps = np.round(0.05 * np.arange(100), 1)
    with pytest.raises(ValueError, match="rounded more coarsely.*`sampling_time`"):
        read_clock(stamps, column="t", experiment=0)


def test_a_few_lost_rows_do_not_look_shuffled():
    t = np.delete(np.arange(200.0), [50, 120])
    with pytest.raises(ValueError, match="missing='split'.*resample") as raised:
        read_clock(t, column="t", experiment=0)
    assert "shuffle" not in str(raised.value)


# ------------------------------------------------------------------- jitter and gaps


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
@pytest.mark.parametrize("share", [0.002, 0.0095])
def test_jitter_within_the_tolerance_is_accepted_and_measured(scale, share):
    off = np.random.default_rng(1).uniform(-1, 1, 2000)
    t = scale * (np.arange(2000) + share * off)
    clock = read_clock(t, column="t", experiment=0, time_tol=0.01)
    rest = off - np.polyval(np.polyfit(np.arange(2000), off, 1), np.arange(2000))
    np.testing.assert_allclose(clock.jitter, share * abs(rest).max(), rtol=1e-4)
    np.testing.assert_allclose(clock.step, scale, rtol=2 * share / 1999)
    with pytest.raises(ValueError, match="largest deviation .* of the step"):
        read_clock(t, column="t", experiment=0, time_tol=share / 2)


def test_the_largest_deviation_and_its_place_are_told():
    t = np.arange(500) * 0.1
    t[321] += 0.004
    with pytest.raises(ValueError, match="0.00399 s at sample 321, 0.04 of the step"):
        read_clock(t, column="t", experiment=0, time_tol=0.01)
    clock = read_clock(t, column="t", experiment=0, time_tol=0.05)
    np.testing.assert_allclose(clock.jitter, 0.04, rtol=0.01)


@pytest.mark.parametrize("share", [0.0, 0.009])
@pytest.mark.parametrize("shift", [0.0, 0.37])
def test_gaps_are_found_whatever_the_phase_after_them(share, shift):
    """A logger that lost rows, or was stopped and started again."""
    rng = np.random.default_rng(1)
    t = np.arange(1000) + share * rng.uniform(-1, 1, 1000)
    t[400:] += shift
    kept = np.ones(1000, dtype=bool)
    kept[[100, 101, 399, 700]] = False
    clock = read_clock(
        t[kept], column="t", experiment=0, time_tol=0.01, allow_missing=True
    )
    assert clock.breaks.tolist() == [100, 397, 697]
    np.testing.assert_allclose(clock.step, 1.0, rtol=1e-4)
    assert clock.jitter <= 1.05 * share + 1e-9


@pytest.mark.parametrize("power", [-2, -1, 1, 2, 3])
def test_another_unit_of_time_is_recognised(power):
    t = np.arange(20) * 0.05 * 1000.0**power
    for step, words in ((0.05, "milliseconds by 1000"), (0.02, "times are in seconds")):
        expected = [(UNTIMED._replace(step=step), "the rule")]
        with pytest.raises(ValueError, match=f"the rule. Got {step} s.*{words}"):
            read_clock(t, column="t", experiment=0, expected=expected)


def test_steps_agree_as_far_as_jitter_lets_them_be_known():
    off = 0.009 * np.random.default_rng(2).uniform(-1, 1, 500)
    options = {"column": "t", "experiment": 0, "time_tol": 0.01}
    long = read_clock(np.arange(500) + off, **options)
    for n in (2, 3, 10, 100):
        short = read_clock(np.arange(n) + off[:n], **options)
        read_clock(np.arange(n) + off[:n], expected=[(long, "rule")], **options)
        read_clock(np.arange(500) + off, expected=[(short, "rule")], **options)
    with pytest.raises(ValueError, match="rule. Got"):
        read_clock(1.01 * np.arange(100), expected=[(long, "rule")], **options)


@pytest.mark.parametrize("tol", [-0.1, 0.25, np.nan, "1 %", True])
def test_a_tolerance_is_a_share_of_the_step(tol):
    with pytest.raises(ValueError, match="`time_tol` must be a share"):
        check_time_tol(tol)


@pytest.mark.parametrize("unit, parts", [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_parts_of_seconds_since_1970_are_told(unit, parts):
    seconds = 1.7726e9 + 0.05 * np.arange(5)
    with pytest.warns(UserWarning, match=rf"X\['t'\], unit='{unit}'"):
        time_in_seconds(parts * seconds, "t")
    assert time_in_seconds(seconds, "t")[0] > 1e9  # seconds since 1970 are fine


@pytest.mark.parametrize(
    ("stamps", "remedy"),
    [
        (["0,0", "0,1"], r"read_csv\(decimal=','\)"),
        (["0.00", "1,500.00"], r"'1,500.00' at row 1.*read_csv\(thousands=','\)"),
        (pd.Categorical([0.5, "0,5"]), r"'0,5' at row 1.*read_csv\(decimal"),
        (["0.0 s", "0.1 s"], "dates with pandas.to_datetime, of numbers with"),
        (pd.period_range("2026-01-01", periods=2, freq="s"), r"to_timestamp\(\)"),
        ([date(2026, 1, 1), date(2026, 1, 2)], "Convert dates with pandas.to_datetime"),
        ([0.0, np.inf], r"inf\)? at row 1. Drop rows without a time below 1e\+30 s"),
        ([0.0, 1e308], r"1e\+308\)? at row 1. Drop rows without a time below"),
        ([0.0, pd.NaT], "no time at row 1. Drop rows without a time"),
        ([0.0, 1j], "Give seconds as real numbers"),
        ([time(9), time(10)], r"pandas.to_timedelta\(column.astype\(str\)\)"),
    ],
)
def test_what_is_no_time_is_told_its_own_remedy(stamps, remedy):
    with pytest.raises(ValueError, match=f"^Time column 't' must hold.*{remedy}"):
        time_in_seconds(stamps, "t")


@pytest.mark.parametrize("times", ["", "%H", "%H%M", "%H%M%S"])
def test_dates_that_are_written_as_numbers_are_refused_with_their_format(times):
    written = f"%Y%m%d{times}"
    stamps = pd.date_range("2012-12-30", periods=40, freq="D").strftime(written)
    with pytest.raises(ValueError, match=rf"digits are those of a date.*{written!r}"):
        time_in_seconds(stamps.astype("int64"), "day")
    with pytest.raises(ValueError, match="digits are those of a date"):
        time_in_seconds(stamps.astype(float), "day")


def test_seconds_that_begin_like_a_date_go_on_like_none():
    time_in_seconds(20121230 + 10.0 * np.arange(100), "t")
