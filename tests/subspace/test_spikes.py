"""Spikes: single errors of a sensor are told, others are not."""

import re
import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI

from .test_residuals import coloured


def test_spikes_that_follow_moves_of_the_input_are_no_sensors():
    u = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 20), 40)[:, None]
    late = np.vstack([np.zeros((3, 1)), u[:-3]])
    y = lfilter([0.5], [1.0, -0.5], late, axis=0)
    y += 0.002 * np.random.default_rng(1).standard_normal(y.shape)
    told = "stand far out .* Most come right after inputs move: .* `input_delay`"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        SubspaceLTI(1, refine="simulation").fit(u, y)
    assert any(re.search(told, str(w.message)) for w in caught)


def test_spikes_are_told_and_where_the_farthest_is():
    rng = np.random.default_rng(3)
    u = rng.standard_normal((600, 2))
    y = lfilter([0.0, 1.0], [1.0, -0.8], u, axis=0)
    for noise in (coloured(rng, 1200, 0.9), rng.laplace(size=1200)):
        SubspaceLTI(2, horizon=8).fit(u, y + 0.1 * noise.reshape(y.shape))  # silently
    y += 0.1 * rng.standard_normal(y.shape)
    y[[50, 350, 431], 1] += [3.0, -2.0, 4.0]
    runs = np.repeat([0.0, 1.0], 300)[:, None]
    expected = (
        r"3 sample.* of output 2 .*sample 131 of experiment 1,.*missing='estimate'"
    )
    with pytest.warns(UserWarning, match=expected):
        SubspaceLTI(2, horizon=8, experiment=2).fit(np.hstack([u, runs]), y)
    y[[50, 350, 431], 1] = np.nan
    for missing in ("split", "estimate"):
        SubspaceLTI(2, horizon=8, missing=missing).fit(u, y)  # silently
