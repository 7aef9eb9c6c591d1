"""The time column of a stream: batches go on evenly where the one before ended."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn import SubspaceLTI
from lpvlearn.systems.simulation import lti_response

OMEGA = np.linspace(0.05, 3.0, 20)
SYSTEM = ([[0.9]], [[1.0, -0.5]], [[1.0], [0.5]], np.zeros((2, 2)))


def record(n_samples):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((n_samples, 2))
    y = lti_response(*map(np.asarray, SYSTEM), u)
    return u, y + 0.1 * rng.standard_normal(y.shape)


def response(model):
    return model.lti_.frequency_response(OMEGA * model.lti_.sampling_time)


def test_batches_go_on_evenly_in_time():
    u, y = record(400)
    X = pd.DataFrame(u, columns=["u1", "u2"])
    X["t"] = (1000 + np.arange(400) / 30.0).round(3)  # rounded stamps
    options = {"order": 1, "horizon": 5, "time": "t"}
    batches = [slice(0, 1), slice(1, 150), slice(150, 153), slice(153, 400)]
    stream = SubspaceLTI(**options)
    for rows in batches:
        stream.partial_fit(X[rows], y[rows])
    whole = SubspaceLTI(**options).fit(X, y)
    assert stream.lti_.sampling_time == pytest.approx(whole.lti_.sampling_time)
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)


@pytest.mark.parametrize(
    "first, step, match",
    [
        (0.0, 0.1, "repeats samples"),
        (19.0, 0.1, "repeats samples"),
        (20.0, 0.1, None),
        (20.1, 0.1, "does not continue"),
        (20.0, 0.2, "does not continue where that ended"),
    ],
)
@pytest.mark.parametrize("dates", [False, True])
def test_repeated_missing_or_slower_batches_are_refused(first, step, match, dates):
    u, y = record(400)
    X = pd.DataFrame(u, columns=["u1", "u2"])
    X["t"] = np.r_[0.1 * np.arange(200), first + step * np.arange(200)]
    if dates:
        X["t"] = pd.Timestamp("2024-02-28 23:59:50") + pd.to_timedelta(X["t"], "s")
    stream = SubspaceLTI(1, horizon=5, time="t").partial_fit(X[:200], y[:200])
    before = response(stream)
    if match is None:
        stream.partial_fit(X[200:], y[200:])
        return
    with pytest.raises(ValueError, match=match):
        stream.partial_fit(X[200:], y[200:])
    # Nothing has changed: the right batch may follow.
    np.testing.assert_array_equal(response(stream), before)
    X.loc[200:, "t"] = X["t"][199] + (X["t"][199] - X["t"][198]) * np.arange(1, 201)
    stream.partial_fit(X[200:], y[200:])


def test_experiments_of_a_stream_have_one_time_step():
    u, y = record(400)
    X = pd.DataFrame(u, columns=["u1", "u2"]).assign(run=np.repeat([0, 1], 200))
    X["t"] = np.r_[0.1 * np.arange(200), 0.2 * np.arange(200)]
    model = SubspaceLTI(1, horizon=5, time="t", experiment="run")
    model.partial_fit(X[:200], y[:200])
    with pytest.raises(ValueError, match="same time step. Got 0.1 s first, and 0.2 s"):
        model.partial_fit(X[200:], y[200:])
