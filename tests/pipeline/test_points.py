"""Steps 3 and 4 at the operating points: deviations, what is kept, what fails."""

import itertools
from functools import partial
from types import SimpleNamespace

import joblib
import numpy as np
import pandas as pd
import pytest
from joblib import Memory

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.data.experiments import Experiment
from lpvlearn.pipeline.points import (
    PointRunner,
    covariance_of_parameters,
    identify_point,
)
from lpvlearn.subspace.statistics import deviated_models

from ..conftest import spring_pipeline, spring_structure, spring_tables

# -- standard deviations of gray-box parameters ---------------------------------------

LAG = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
STEP = 0.1


def lag_record(seed, n_samples=300, noise=0.05):
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (n_samples // 3, 1)).repeat(3, axis=0)
    y = LAG.model({"a": 0.8, "b": 1.5}).simulate(u, sampling_time=STEP)
    return u, y + noise * rng.standard_normal(y.shape)


def simulated(theta, u, x0):
    model = LAG.model(theta)
    return model.simulate(u, sampling_time=STEP, initial_state=[x0])[:, 0]


def test_covariance_is_that_of_nonlinear_least_squares_in_the_parameters():
    """Black box and gray box have as many parameters here: the formula is known."""
    u, y = lag_record(0)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(order=1, horizon=8, feedthrough=False, sampling_time=STEP),
        GrayBoxRestructurer(LAG),
    ).fit(u, y)
    theta = pipeline.parameters_.to_numpy()[0]
    h = 1e-6
    J = np.column_stack(
        [
            (simulated(theta + h * e, u, 0.0) - simulated(theta - h * e, u, 0.0))
            / (2 * h)
            for e in np.eye(2)
        ]
        + [simulated(theta, u, 1.0) - simulated(theta, u, 0.0)]
    )
    error = y[:, 0] - simulated(theta, u, 0.0)
    error = error - J[:, 2:] @ np.linalg.lstsq(J[:, 2:], error, rcond=None)[0]
    variance = error @ error / (len(y) - 3)
    expected = np.sqrt(variance * np.diag(np.linalg.inv(J.T @ J))[:2])
    # The noise may have been taken for a faintly coloured one.
    np.testing.assert_allclose(pipeline.parameters_std_.iloc[0], expected, rtol=0.15)


@pytest.fixture(scope="module")
def short_springs():
    """Noisy local experiments on the spring, and the deviations that they tell."""
    X, y = spring_tables(0.05, n_samples=300)
    return X, y, spring_pipeline().fit(X, y).parameters_std_


def test_more_experiments_tell_more(short_springs):
    X, y = spring_tables(0.05, n_samples=300, n_repeats=4)
    ratio = short_springs[2] / spring_pipeline().fit(X, y).parameters_std_
    assert ratio.median().between(1.5, 2.7).all()  # the root of 4


def test_deviations_are_the_spread_over_new_noise():
    found, told = [], []
    for seed in range(20):
        pipeline = LocalLPVPipeline(
            SubspaceLTI(order=1, horizon=8, feedthrough=False, sampling_time=STEP),
            GrayBoxRestructurer(LAG, n_starts=2),
        ).fit(*lag_record(seed))
        found.append(pipeline.parameters_.iloc[0])
        told.append(pipeline.parameters_std_.iloc[0])
    ratio = pd.DataFrame(told).mean() / pd.DataFrame(found).std()
    assert ratio.between(0.65, 1.5).all()


def test_deviations_follow_the_units(short_springs):
    X, y, one = short_springs
    other = spring_pipeline().fit(X, 1000.0 * y).parameters_std_
    np.testing.assert_allclose(other["b"], 1000.0 * one["b"], rtol=1e-3)
    np.testing.assert_allclose(other["k"], one["k"], rtol=1e-3)


@pytest.mark.filterwarnings("ignore:The model explains next to nothing")
@pytest.mark.parametrize("options", [{"refine": False}, {"order": 0}])
def test_nothing_is_claimed_where_the_covariance_is_not_known(options):
    u, y = lag_record(2)
    point = identify_point(
        SubspaceLTI(**{"order": 1, "horizon": 8, **options}),
        [Experiment("a", np.arange(len(u)), u, y)],
        sampling_time=STEP,
        combine="pool",
        discretization="zoh",
    )
    assert point.deviated == []


def test_a_frequency_weight_enters_the_covariance():
    u, y = lag_record(3)
    fitted = SubspaceLTI(1, horizon=8, feedthrough=False, sampling_time=STEP).fit(u, y)
    pairs = deviated_models(fitted.lti_, [(u, y)], StateSpace.to_continuous)
    box = fitted.lti_.to_continuous()
    theta = GrayBoxRestructurer(LAG).fit_model(box).params_
    plain, weighted = (
        covariance_of_parameters(LAG, theta, weight, box, pairs)
        for weight in (None, (None, 2.0))
    )
    # A structure that meets the black box exactly leaves a weight nothing to choose.
    np.testing.assert_allclose(weighted, plain, rtol=0.05)


def test_average_tells_its_own_spread_and_a_single_experiment_that_of_its_fit():
    X, y = spring_tables(0.05, n_samples=300, n_repeats=3)
    average = spring_pipeline(combine="average").fit(X, y)
    first = X["run"].str.endswith("r0")
    single = spring_pipeline(combine="average").fit(X[first], y[first])
    pooled = spring_pipeline(combine="pool").fit(X[first], y[first])
    assert average.restructurers_[0].params_covariance_.shape == (3, 3)
    pd.testing.assert_frame_equal(single.parameters_std_, pooled.parameters_std_)


def test_memory_tells_the_same_deviations(tmp_path):
    u, y = lag_record(4)
    X, Y = from_trajectories([(u, 0.3, y)], sampling_time=STEP)
    options = {"experiment": "experiment", "time": "time", "inputs": "u1"}
    fits = [
        LocalLPVPipeline(
            SubspaceLTI(1, horizon=8),
            GrayBoxRestructurer(LAG),
            memory=memory,
            **options,
        ).fit(X, Y)
        for memory in (None, tmp_path, tmp_path)
    ]
    for other in fits[1:]:
        pd.testing.assert_frame_equal(fits[0].parameters_std_, other.parameters_std_)


# -- the runner -----------------------------------------------------------------------

CALLS = []


def square(x, note=None):
    CALLS.append(x)
    return np.square(x)


@pytest.fixture
def calls():
    CALLS.clear()
    return CALLS


def runner(memory, **options):
    return PointRunner(**{"n_jobs": None, "verbose": 0, "on_error": "raise", **options},
                       memory=memory)  # fmt: skip


# -- memory ----------------------------------------------------------------------------


def test_results_are_kept_by_the_values_of_the_arguments(tmp_path, calls):
    for _ in range(2):
        call = partial(runner(Memory(tmp_path, verbose=0)).call, square)
        assert call(3) == 9
        assert call(3, "of no influence", ignore=["note"]) == 9
        np.testing.assert_array_equal(call(np.arange(3)), [0, 1, 4])
    assert len(calls) == 2


def test_nothing_is_kept_without_a_folder(calls):
    kept = partial(runner(Memory(None)).call, square)
    assert [kept(2), kept(2)] == [4, 4] and len(calls) == 2


def test_a_damaged_or_cleared_result_is_made_again(tmp_path, calls):
    memory = Memory(tmp_path, verbose=0)
    kept = partial(runner(memory).call, square)
    kept(3)
    (file,) = tmp_path.rglob("output.pkl")
    file.write_bytes(b"cut")
    assert kept(3) == 9 and len(calls) == 2
    memory.clear(warn=False)
    assert kept(3) == 9 and len(calls) == 3


def test_the_size_of_the_memory_can_be_reduced(tmp_path):
    memory = Memory(tmp_path, verbose=0)
    kept = partial(runner(memory).call, square)
    for x in range(3):
        kept(x)
    memory.reduce_size(items_limit=1)
    assert len(list(tmp_path.rglob("output.pkl"))) == 1


def test_an_object_with_the_interface_of_a_memory_serves(calls):
    results = {}

    def cache(function, ignore=None):
        return lambda x: results.setdefault(x, function(x))

    assert runner(SimpleNamespace(cache=cache)).call(square, 4) == 16
    assert results == {4: 16}


def test_slow_writing_of_the_memory_is_not_told_to_the_user(tmp_path, monkeypatch):
    """Under load joblib warns of half a second for the record of the arguments."""
    ticks = itertools.count()
    slow = SimpleNamespace(**{**vars(joblib.memory.time), "time": ticks.__next__})
    monkeypatch.setattr(joblib.memory, "time", slow)  # every look takes a second
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    for _ in range(2):  # a warning would be an error
        spring_pipeline(memory=tmp_path).fit(X, y)


def test_memory_is_a_folder_a_path_or_a_joblib_memory(tmp_path):
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    expected = spring_pipeline().fit(X, y)
    for memory in (
        str(tmp_path / "a"),
        tmp_path / "b",
        Memory(tmp_path / "c", verbose=0),
    ):
        for _ in range(2):
            pipeline = spring_pipeline(memory=memory).fit(X, y)
            pd.testing.assert_frame_equal(pipeline.parameters_, expected.parameters_)
            pd.testing.assert_frame_equal(pipeline.report_, expected.report_)


def test_memory_teaches_what_it_cannot_keep(tmp_path):
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    with pytest.raises(
        ValueError, match="`memory` must be None, a folder, or a joblib"
    ):
        spring_pipeline(memory=3).fit(X, y)
    truth = spring_structure()
    structure = GrayBoxStructure.from_function(
        lambda theta: truth.matrices(theta), [30.0, 1.2, 50.0]
    )
    pipeline = spring_pipeline(restructurer=GrayBoxRestructurer(structure))
    with pytest.raises(ValueError, match="pickled. Got a `restructurer`.*lambda"):
        pipeline.set_params(memory=tmp_path).fit(X, y)


# -- failures --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("on_error", "n_jobs"),
    [("raise", None), ("skip", None), pytest.param("raise", 2, marks=pytest.mark.slow)],
)
def test_a_failure_that_all_points_share_names_none(spring, on_error, n_jobs):
    pipeline = spring_pipeline(
        local=SubspaceLTI(order=400), on_error=on_error, n_jobs=n_jobs
    )
    with pytest.raises(ValueError, match="^`order` must be at most .*400"):
        pipeline.fit(*spring[:2])


def test_different_failures_everywhere_tell_the_first(spring):
    X, y, _, _ = spring
    unequal = (X["kappa"] < 0.2) | (X["time"] < 4 + X["kappa"])
    pipeline = spring_pipeline(local=SubspaceLTI(order=400), on_error="skip")
    with pytest.raises(
        ValueError, match="every .* failed. First operating point 0 .*400"
    ):
        pipeline.fit(X[unequal], y[unequal])
