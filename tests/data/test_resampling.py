"""Even grids through uneven records: exact where they can be, honest elsewhere."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import LocalLPVPipeline, SubspaceLTI, resample
from lpvlearn.data.experiments import read_experiments

from ..conftest import ROLES, spring_lpv, spring_pipeline, spring_tables, spring_truth

STEP = 0.1


def uneven(n=200, share=0.2, seed=0):
    """Stamps off an even grid by up to a share of the step, its ends on it."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) + share * rng.uniform(-1, 1, n)
    t[[0, -1]] = 0, n - 1
    return STEP * t


def table(t, **columns):
    return pd.DataFrame({"t": t, **columns})


# ------------------------------------------------------------------------ exact cases


@pytest.mark.parametrize("method", ["linear", "cubic"])
@pytest.mark.parametrize("hold", ["auto", [], ["u"]])
def test_an_even_record_comes_back(method, hold):
    rng = np.random.default_rng(0)
    t, u, y = STEP * np.arange(50), rng.choice([-1.0, 1.0], 50), rng.normal(size=50)
    X, found = resample(table(t, u=u), y, time="t", method=method, hold=hold)
    assert_allclose(X["t"], t, atol=1e-12)
    assert_allclose(X["u"], u, atol=1e-12)
    assert_allclose(found, y, atol=1e-12)
    if hold != []:
        assert_array_equal(X["u"], u)


@pytest.mark.parametrize(("method", "degree"), [("linear", 1), ("cubic", 3)])
def test_polynomials_are_met_exactly(method, degree):
    t = uneven()
    line = np.polynomial.Polynomial(np.arange(1.0, degree + 2), domain=[0, t[-1]])
    _, y = resample(
        table(t, u=t**2), line(t), time="t", method=method, sampling_time=STEP
    )
    assert_allclose(y, line(STEP * np.arange(200)), rtol=1e-9)


def test_held_inputs_keep_their_integral():
    """The mean over an interval moves a slow system as far as the signal itself."""
    t, u = uneven(), np.random.default_rng(1).choice([-1.0, 0.0, 2.0], 200)
    X, _ = resample(table(t, u=u), time="t", sampling_time=STEP)
    moved = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
    assert_allclose(STEP * np.cumsum(X["u"])[:-1], np.interp(X["t"][1:], t, moved))
    assert X["u"].between(-1.0 - 1e-9, 2.0 + 1e-9).all()


@pytest.mark.parametrize("ratio", [2, 5])
def test_coarser_grids_smooth_all_signals_alike(ratio):
    """A static gain, and a delay of one coarse sample, stay what they are."""
    rng = np.random.default_rng(2)
    t, u = STEP * np.arange(1000), rng.standard_normal(1000)
    y = np.column_stack([3.0 * u, np.roll(u, ratio)])
    options = {"time": "t", "sampling_time": ratio * STEP, "hold": None}
    X, Y = resample(table(t, u=u), y, **options)
    assert len(X) == 1000 // ratio
    assert_allclose(Y[:, 0], 3.0 * X["u"], atol=1e-12)
    assert_allclose(Y[3:-3, 1], X["u"][2:-4], atol=1e-12)
    # White noise of the record: what the coarse grid cannot show is gone.
    assert X["u"].std() < 1.1 * np.sqrt(0.75 / ratio)
    plain, _ = resample(table(t, u=u), y, antialias=False, **options)
    assert_array_equal(plain["u"], u[::ratio])


def test_a_sine_beyond_the_coarse_grid_is_thirty_decibels_down():
    t = 0.01 * np.arange(5000)
    for frequency, low, high in ((0.3, 0.99, 1.01), (9.3, 0.0, 0.032)):
        y = np.sin(2 * np.pi * frequency * t)
        _, found = resample(table(t, u=t), y, time="t", sampling_time=0.1)
        amplitude = np.sqrt(2) * found[20:-20].std()
        assert low <= amplitude <= high


# ------------------------------------------------------------------- gaps, experiments


def test_long_gaps_become_rows_without_values():
    t = STEP * np.arange(100)
    kept = np.ones(100, dtype=bool)
    kept[[20, 50, 51, 52, 53]] = False
    y = np.sin(t)
    X, Y = resample(table(t, u=t)[kept], y[kept], time="t", max_gap=3)
    assert_allclose(X["t"], t, atol=1e-12)
    lost = np.isin(np.arange(100), [50, 51, 52, 53])
    assert_array_equal(np.isnan(Y), lost)
    assert_array_equal(X["u"].isna(), lost)
    _, bridged = resample(table(t, u=t)[kept], y[kept], time="t", max_gap=5)
    assert_allclose(bridged, y, atol=(5 * STEP) ** 2 / 8)  # of a straight line


def test_missing_values_of_one_channel_leave_the_others_alone():
    t = uneven()
    y = np.column_stack([t, 2 * t])
    y[50, 0], y[80:90, 1], y[190:, 1] = np.nan, np.nan, np.nan
    _, Y = resample(table(t, u=t), y, time="t", sampling_time=STEP)
    assert_allclose(Y[:, 0], STEP * np.arange(200), atol=1e-12)
    lost = np.flatnonzero(np.isnan(Y[:, 1]))
    assert set(range(80, 90)) <= set(lost) <= {*range(79, 91), *range(189, 200)}
    assert set(range(191, 200)) <= set(lost)


def test_experiments_have_grids_of_their_own_and_keep_their_labels():
    X, y = spring_tables(n_samples=60)
    rng = np.random.default_rng(0)
    late = X["run"].map({f"p{k}r0": 0.007 * k for k in range(4)})
    X["time"] += late + 0.004 * rng.uniform(-1, 1, len(X))
    X["run"] = X["run"].astype("category")
    X["phase"] = np.where(X["time"] < 0.5, "early", "late")
    order = rng.permutation(len(X))
    even, Y = resample(
        X.iloc[order], y.iloc[order], time="time", experiment="run", sampling_time=0.02
    )
    assert list(even) == list(X) and list(Y) == ["position"]
    assert even.index.equals(Y.index) and even["run"].dtype == X["run"].dtype
    assert set(even.loc[even["time"] < 0.49, "phase"]) == {"early"}
    for label, part in even.groupby("run", observed=True):
        given = X[X["run"] == label]
        assert part["kappa"].nunique() == 1
        assert part["time"].iloc[0] == given["time"].min()
        assert given["time"].max() - part["time"].iloc[-1] < 0.02
    runs = read_experiments(
        LocalLPVPipeline(**ROLES, inputs="force"), even, Y, sampling_time=0.02
    )
    assert max(run.jitter for run in runs) < 1e-9


# --------------------------------------------------------------------- kinds of tables


@pytest.mark.parametrize("dates", [False, True])
def test_levels_of_the_index_and_dates_stay_what_they_are(dates):
    t = uneven(100)
    stamps = pd.Timestamp("2024-03-31 00:59", tz="Europe/Paris") + pd.to_timedelta(
        t, unit="s"
    )
    X = table(stamps if dates else t, u=t, run="a").set_index(["run", "t"])
    y = pd.Series(2 * t, X.index, name="angle")
    even, Y = resample(X, y, time="t", experiment="run", sampling_time=STEP)
    assert even.index.names == ["run", "t"] and even.index.equals(Y.index)
    assert list(even) == ["u"] and Y.name == "angle"
    times = even.index.get_level_values("t")
    if dates:
        assert times.dtype.tz is not None
        times = (times - times[0]).total_seconds()
    assert_allclose(times, STEP * np.arange(100), atol=1e-9)
    assert_allclose(Y, 2 * STEP * np.arange(100), atol=1e-8)


def test_arrays_and_lists_come_back_as_arrays():
    t = uneven(30)
    X = np.column_stack([t, t])
    for given in (X, X.tolist()):
        even, y = resample(given, 2 * t, time=0, sampling_time=STEP)
        assert isinstance(even, np.ndarray) and even.shape == (30, 2)
        assert_allclose(y, 2 * even[:, 1], atol=1e-12)
    assert resample(X, time=0)[1] is None


@pytest.mark.parametrize("dtype", ["float32", "Int64", "int8", object, "Float64"])
def test_numbers_of_any_type_are_resampled(dtype):
    t = STEP * np.arange(20)
    X = table(t, u=np.arange(20.0)).astype({"u": dtype})
    even, _ = resample(X, time="t", sampling_time=STEP / 2)
    assert_allclose(even["u"][::2], np.arange(20))
    assert_allclose(even["u"][1::2], np.arange(19) + 0.5, rtol=1e-6)


# -------------------------------------------------------------- on to identification


def test_a_jittering_loop_is_identified_after_it():
    """An input switched, and an output read, at stamps off by a fifth of a step."""
    rng = np.random.default_rng(0)
    ticks = np.cumsum(20 + rng.integers(-4, 5, 1500))
    ticks -= ticks[0]
    u = rng.choice([-1.0, 1.0], 300).repeat(5)
    truth = spring_lpv().at(0.0)
    held = u[np.searchsorted(ticks, np.arange(ticks[-1] + 1), "right") - 1]
    y = truth.simulate(held, sampling_time=1e-3)[ticks, 0]
    X, model = (
        table(1e-3 * ticks, u=u),
        SubspaceLTI(2, horizon=10, time="t", feedthrough=False),
    )
    with pytest.raises(ValueError, match="lpvlearn.resample"):
        model.fit(X, y)
    errors = {}
    for hold in ("auto", []):
        found = model.fit(*resample(X, y, time="t", hold=hold)).lti_.to_continuous()
        errors[str(hold)] = (found - truth).hinf_norm() / truth.hinf_norm()
        assert model.time_jitter_ < 1e-9
    assert errors["auto"] < 0.001
    assert errors["auto"] < 0.2 * errors["[]"]


@pytest.mark.slow
def test_gaps_go_on_to_a_fit_that_splits():
    X, y = spring_tables(n_samples=400)
    kept = ~X["time"].between(2.0, 2.6).to_numpy()
    roles = {"time": "time", "experiment": "run"}
    even, Y = resample(X[kept], y[kept], **roles)
    assert even["force"].isna().any() and len(even) == len(X)
    local = SubspaceLTI(2, horizon=10, missing="split")
    found = spring_pipeline(local=local).fit(even, Y).parameters_
    assert_allclose(found, spring_truth(found.index), rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "nearest"}, "`method` must be 'linear' or 'cubic'. Got 'nearest'"),
        ({"max_gap": 0.5}, "`max_gap` must be at least 1 step. Got 0.5"),
        ({"sampling_time": -1}, "`sampling_time` must be a positive number"),
        ({"time": "tt"}, "`time` must name a column"),
        ({"time": None}, "`time` must name the column of sample times"),
        ({"time": "u"}, "must hold every time once in an experiment. Got 0 s twice"),
        ({"hold": "v"}, "`hold` must name a column"),
        ({"experiment": "t"}, "records of at least 2 samples apart. Got 1"),
        ({"y": np.ones(3)}, "inconsistent numbers of samples"),
    ],
)
def test_bad_calls_teach(options, message):
    X = table(STEP * np.arange(9), u=np.arange(9) // 2)
    with pytest.raises(ValueError, match=message):
        resample(X, **{"time": "t", **options})
