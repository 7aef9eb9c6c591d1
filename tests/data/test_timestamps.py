"""Time stamps: even however they are stored, or refused."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn.data.timestamps import check_uniform_time, time_in_seconds


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
    step = check_uniform_time(seconds, column="t", experiment=0)
    expected = float(seconds[-1] - seconds[0]) / 2999
    np.testing.assert_allclose(step, expected, rtol=1e-6)
    # One sample lost is seen in all of them.
    with pytest.raises(ValueError, match="evenly spaced"):
        check_uniform_time(np.delete(seconds, 1500), column="t", experiment=0)


@pytest.mark.parametrize(
    "stamps",
    [
        [0, 1, 2, 4],
        [0.0, 0.1, 0.25, 0.3],
        [0.0, 0.1, 0.1, 0.2],
        [0.3, 0.2, 0.1],
        np.concatenate([np.arange(100) / 10, 9.9 + 0.11 * np.arange(1, 100)]),
        np.round(np.cumsum(np.r_[np.full(500, 1.00), np.full(500, 1.06)]), 1),
    ],
    ids=["gap", "jitter", "repeat", "reversed", "two paces", "two rounded paces"],
)
def test_uneven_time_raises_and_says_what_to_use(stamps):
    with pytest.raises(ValueError, match="GroupKFold.*TimeSeriesSplit.*resample"):
        check_uniform_time(np.asarray(stamps, float), column="t", experiment=0)
