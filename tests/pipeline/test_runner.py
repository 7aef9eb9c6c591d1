"""Steps at every operating point: what is kept, what is timed, what fails."""

import itertools
from functools import partial
from types import SimpleNamespace

import joblib
import numpy as np
import pandas as pd
import pytest
from joblib import Memory

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, SubspaceLTI
from lpvlearn.pipeline.estimator import Stopwatch
from lpvlearn.pipeline.points import PointRunner

from ..conftest import spring_pipeline, spring_structure, spring_tables

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


# -- time ------------------------------------------------------------------------------


def test_a_stopwatch_adds_up_the_times_of_the_steps():
    watch = Stopwatch({"a": 1.0})
    for name in ("b", "a", "b"):
        with watch.step(name):
            pass
    table = watch.table()
    assert table["step"].tolist() == ["a", "b", "total"]
    assert watch.seconds["a"] > 1.0 and watch.seconds["b"] > 0.0
    assert table["seconds"].tolist()[-1] == sum(watch.seconds.values())


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
