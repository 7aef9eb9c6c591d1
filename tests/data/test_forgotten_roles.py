"""Columns that look as if their role was forgotten, and rows out of order."""

import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, RegressorMixin

from lpvlearn import SubspaceLTI
from lpvlearn.data.experiments import read_experiments


class Reader(RegressorMixin, BaseEstimator):
    """A stand-in for the estimators that call `read_experiments`."""


N, RUNS = 40, 3


def table(**columns):
    """Three experiments of an input, and further columns."""
    rng = np.random.default_rng(0)
    X = pd.DataFrame({"u": rng.normal(size=N * RUNS)})
    return X.assign(run=np.repeat([f"r{k}" for k in range(RUNS)], N), **columns)


def warned(X, **roles):
    """Messages of the warnings that reading a table for a fit gives."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_experiments(Reader(), X, np.ones(len(X)), **roles)
    return [str(w.message) for w in caught]


TIME = 0.01 * np.arange(N)
RNG = np.random.default_rng(1)

# A column, and what makes it suspicious within three experiments.
CLOCKS = {
    "time": np.tile(TIME, RUNS),
    "time that goes on": 0.01 * np.arange(N * RUNS),
    "rounded time": np.tile(TIME / 3, RUNS).round(4),
    "jittering time": np.tile(
        TIME + 0.003 * np.random.default_rng(5).uniform(-1.0, 1.0, N), RUNS
    ),
    "late time": 1.7e9 + np.tile(TIME, RUNS),
    "row number": np.arange(N * RUNS),
    "time with rows left out": 0.01 * np.delete(np.arange(N * RUNS + 3), [9, 50, 99]),
    "single precision": np.tile(TIME, RUNS).astype(np.float32),
}

INPUTS = {
    "noise": RNG.normal(size=N * RUNS),
    "random walk upwards": np.cumsum(RNG.uniform(0.5, 1.5, N * RUNS)),
    "binary noise": RNG.choice([-1.0, 1.0], N * RUNS),
    "falling walk": -np.cumsum(RNG.uniform(0.5, 1.5, N * RUNS)),
    "a step": np.tile(np.arange(N) >= N // 2, RUNS).astype(float),
    "stair": np.tile(np.arange(N) // 4, RUNS),
    "sawtooth": np.arange(N * RUNS) % 8,
    "sine": np.sin(np.arange(N * RUNS)),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_an_evenly_rising_input_may_be_the_time(name):
    X = table(clock=CLOCKS[name])
    (message,) = warned(X, experiment="run")
    assert message.startswith("Input column 'clock' rises by the same 0.0") or (
        name == "row number" and "rises by the same 1 " in message
    )
    assert "time='clock'" in message and "`inputs`" in message
    # as one experiment, where the clock restarts now and then, too
    assert any("time='clock'" in m for m in warned(X.drop(columns="run")))


@pytest.mark.parametrize("jitter", [0.0, 0.003])
def test_an_evenly_falling_input_may_be_the_time_of_the_latest_row_first(jitter):
    time = 0.01 * np.arange(N * RUNS) + jitter * RNG.uniform(-1.0, 1.0, N * RUNS)
    (message,) = warned(table(clock=time[::-1]), experiment="run")
    assert message.startswith("Input column 'clock' falls by the same 0.0")
    assert "the latest row comes first" in message and "sort_values" in message


@pytest.mark.parametrize("name", INPUTS)
def test_other_inputs_are_not_suspected(name):
    assert warned(table(v=INPUTS[name]), experiment="run") == []
    assert warned(table(v=INPUTS[name]).drop(columns="run")) == []


@pytest.mark.parametrize("rows", [30, 125, 200])
@pytest.mark.parametrize("low", [-1.0, 0.0])
def test_a_sawtooth_is_an_input(rows, low):
    teeth = low + np.arange(1500) % rows / rows
    for column in (teeth, -teeth, teeth + 0.001 * np.arange(1500) / rows):
        assert warned(pd.DataFrame({"u": column})) == []
    if low < 0.0:
        beside = pd.DataFrame({"u": teeth, "v": np.sin(np.arange(1500.0) ** 1.5)})
        assert warned(beside) == []


def test_who_names_the_inputs_is_not_doubted():
    X = table(clock=CLOCKS["time"])
    assert warned(X, experiment="run", inputs=["u", "clock"]) == []
    assert warned(X, experiment="run", time="clock") == []


def test_a_few_rows_prove_nothing():
    X = pd.DataFrame({"u": [0.0, 2.0, 1.0, 4.0], "v": [1.0, 2.0, 3.0, 4.0]})
    assert warned(X) == []


def test_a_column_that_no_experiment_changes_may_be_the_operating_point():
    X = table(kappa=np.repeat([0.0, 0.3, 0.4], N))
    (message,) = warned(X, experiment="run")
    for word in ("'kappa' does not change", "scheduling='kappa'", "`inputs`"):
        assert word in message
    assert warned(X, experiment="run", scheduling="kappa") == []
    # step tests of several heights: nothing else moves
    assert warned(X.drop(columns="u"), experiment="run") == []


def test_a_count_in_blocks_may_be_the_number_of_the_experiment():
    X = table(number=np.repeat(np.arange(RUNS) + 5, N)).drop(columns="run")
    (message,) = warned(X)
    assert "counts from 5 to 7" in message and "experiment='number'" in message
    assert warned(X[X["number"] < 7]) == []  # a step


def test_columns_of_arrays_are_named_by_position():
    X = table(clock=CLOCKS["time"]).drop(columns="run").to_numpy()
    (message,) = warned(X)
    assert "Input column 1" in message and "time=1" in message


@pytest.mark.parametrize(
    "index",
    [
        np.arange(N * RUNS),
        pd.date_range("2024-01-01", periods=N * RUNS, freq="s"),
        pd.to_timedelta(np.arange(N * RUNS), unit="s"),
    ],
)
def test_shuffled_rows_are_told_by_the_index(index):
    X = table().set_index(pd.Index(index))
    assert warned(X, experiment="run") == []
    (message,) = warned(X.sample(frac=1, random_state=0), experiment="run")
    for word in ("not in the order of its index", "comes after", "ExperimentSplit"):
        assert word in message
    # whole experiments may come in any order, their labels may stand twice or be words
    parts = [part for _, part in X.groupby("run")]
    assert warned(pd.concat(parts[::-1]), experiment="run") == []
    again = pd.concat([X.iloc[:N], X.iloc[:N]])
    assert warned(again.assign(run=np.repeat([0, 1], N)), experiment="run") == []
    (message,) = warned(again.drop(columns="run"))
    assert f"begins anew at row {N}" in message and "`experiment`" in message
    words = X.set_index(np.array([f"row {k % 7}, {k}" for k in range(len(X))]))
    assert warned(words, experiment="run") == []


def test_shuffled_rows_are_told_in_predictions_too():
    X = table().drop(columns="run")
    y = np.convolve(X["u"], [0.0, 1.0, 0.5])[: len(X)]
    model = SubspaceLTI(2, horizon=5).fit(X, y)
    with pytest.warns(UserWarning, match="not in the order of its index"):
        model.predict(X.sample(frac=1, random_state=0))


OF_INDEX = [
    np.arange(300),
    0.1 * np.arange(300),
    pd.date_range("2025-03-29", periods=300, freq="h", tz="Europe/Berlin"),
    pd.to_timedelta(np.arange(300), unit="D"),
]


@pytest.mark.parametrize("index", OF_INDEX, ids=["numbers", "floats", "dates", "days"])
def test_rows_that_are_missing_are_told(index):
    u = pd.DataFrame({"u": np.arange(300.0) ** 2 % 7}, index=pd.Index(index))

    def torn(rows, **roles):
        told = warned(rows, inputs=["u"], reset=True, **roles)
        return [message for message in told if "missing within" in message]

    parts = u.iloc[np.r_[0:100, 200:300]]
    (message,) = torn(parts)
    assert f"from {u.index[99]} to {u.index[200]}" in message
    assert "ExperimentSplit" in message
    for rows in (slice(100, 300), slice(0, 300, 3)):
        assert torn(u.iloc[rows]) == []
    runs = np.repeat([0, 1], 100)
    assert torn(parts.assign(run=runs), experiment="run") == []
    # a tenth or a half at random, as dropna leaves them; of every third row, too
    rng = np.random.default_rng(0)
    for share in (0.1, 0.5):
        assert torn(u[rng.random(300) > share])
        assert torn(u[::3][rng.random(100) > share])
    # rows of two experiments that take turns, and numbers that mean nothing
    turns = u.assign(run=rng.integers(2, size=300))
    assert torn(turns, experiment="run") == []


def test_numbers_of_an_index_that_mean_nothing_tell_nothing():
    rng = np.random.default_rng(0)
    for index in (np.cumsum(rng.integers(1, 100, size=300)), rng.normal(size=300)):
        assert warned(pd.DataFrame({"u": rng.normal(size=300)}, index=index)) == []


def test_dates_of_an_index_tell_the_step():
    u = pd.DataFrame({"u": np.arange(300.0) ** 2 % 7}, index=OF_INDEX[2])
    y, step = np.roll(u["u"].to_numpy(), 1), 3600.0
    model = SubspaceLTI(1, horizon=3, sampling_time=step).fit(u, y)
    model.predict(u)
    with pytest.warns(UserWarning, match="goes on by 3600 s, and `sampling_time` is 1"):
        SubspaceLTI(1, horizon=3, sampling_time=1.0).fit(u, y)
    with pytest.warns(UserWarning, match="goes on by 7200 s.*`sampling_time` is 3600"):
        model.predict(u[::2])
    with pytest.raises(ValueError, match=r"without a name gets one by X.rename_axis"):
        SubspaceLTI(1, time="index").fit(u, y)


def test_an_output_left_in_the_table_is_refused():
    X = table(position=np.random.default_rng(1).normal(size=N * RUNS))
    y, reader = X["position"], Reader()
    roles = dict.fromkeys(("scheduling", "time", "operating_point"))
    with pytest.raises(ValueError, match="must not hold an output. Got column 'pos"):
        read_experiments(reader, X, y, inputs=None, experiment="run", **roles)
    read_experiments(reader, X, y, inputs="u", experiment="run", **roles)
    with pytest.raises(ValueError, match="column 'position' of X with the values of"):
        read_experiments(
            reader, X, y.to_numpy(), inputs=None, experiment="run", **roles
        )
