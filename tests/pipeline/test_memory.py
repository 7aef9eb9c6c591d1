"""What a memory keeps, and by what it tells results apart."""

import importlib
import itertools
import pickle
import sys
import warnings
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
    PolynomialLPV,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.exceptions import warn
from lpvlearn.pipeline.running.memory import fingerprint
from lpvlearn.pipeline.running.runner import PointRunner

from ..conftest import spring_pipeline, spring_structure, spring_tables

CALLS = []

line_pipeline = partial(
    spring_pipeline, local=SubspaceLTI(2, horizon=8), interpolator=PolynomialLPV(1)
)


def square(x, note=None):
    CALLS.append(x)
    return np.square(x)


@pytest.fixture
def calls():
    CALLS.clear()
    return CALLS


def runner(memory):
    return PointRunner(n_jobs=None, verbose=0, on_error="raise", memory=memory)


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


@pytest.mark.parametrize("content", [b"cut", pickle.dumps({"k": 20.0})])
def test_a_damaged_or_foreign_entry_is_told_and_replaced(tmp_path, calls, content):
    memory = Memory(tmp_path, verbose=0)
    kept = partial(runner(memory).call, square)
    kept(3)
    (file,) = tmp_path.rglob("output.pkl")
    file.write_bytes(content)
    with pytest.warns(UserWarning, match="damaged or not its own.*computed anew"):
        assert kept(3) == 9
    assert kept(3) == 9 and len(calls) == 2


def test_a_cleared_memory_begins_anew(tmp_path, calls):
    memory = Memory(tmp_path, verbose=0)
    kept = partial(runner(memory).call, square)
    kept(3)
    memory.clear(warn=False)
    assert kept(3) == 9 and len(calls) == 2


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
        return lambda x: (
            results[x] if x in results else results.setdefault(x, function(x))
        )

    for _ in range(2):
        assert runner(SimpleNamespace(cache=cache)).call(square, 4) == 16
        with pytest.warns(UserWarning, match="Square -1"):
            assert runner(SimpleNamespace(cache=cache)).call(told_square, -1) == 1
    assert calls == [4, -1]


def told_square(x):
    warn(f"Square {x} instead.")
    return square(x)


def told_failure(x):
    warn(f"Square {x} instead.")
    raise ValueError("It fails.")


def test_what_was_told_before_a_failure_is_not_lost(tmp_path):
    elsewhere = SimpleNamespace(cache=lambda function, ignore=None: function)
    for memory in (Memory(tmp_path, verbose=0), elsewhere):
        with (
            pytest.warns(UserWarning, match="Square 3 instead"),
            pytest.raises(ValueError, match="It fails"),
        ):
            runner(memory).call(told_failure, 3)


def test_what_was_told_comes_with_what_is_kept(tmp_path, calls):
    for _ in range(2):
        with pytest.warns(UserWarning, match="Square 3 instead"):
            assert runner(Memory(tmp_path, verbose=0)).call(told_square, 3) == 9
    assert calls == [3]


@pytest.mark.slow
@pytest.mark.parametrize("restructurer", ["passthrough", None])
def test_the_second_fit_is_the_first_one(tmp_path, restructurer):
    """Inputs come late, which the chain finds by what its models told."""
    rng = np.random.default_rng(0)
    spring, runs = spring_structure(), []
    for kappa in (0.0, 0.5, 1.0, 1.5, 2.0):
        u = np.repeat(np.sign(rng.standard_normal((300, 1))), 2, axis=0)
        late = np.vstack([np.zeros((3, 1)), u[:-3]])
        plant = spring.model({"k": 4.0 + kappa**2, "c": 1.0, "b": 1.0})
        y = plant.simulate(late, sampling_time=0.1)
        runs.append((u, kappa, y + 0.01 * y.std() * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=0.1)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    restructurer = restructurer or GrayBoxRestructurer(spring)
    fits = []
    for memory in (None, tmp_path, tmp_path):
        pipeline = LocalLPVPipeline(restructurer=restructurer, memory=memory, **roles)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            pipeline.fit(X, y)
        fits.append((pipeline, [str(one.message) for one in told]))
    for pipeline, told in fits:
        np.testing.assert_array_equal(pipeline.input_delay_, [3])
        assert told == fits[0][1]
        assert pipeline.warnings_ == fits[0][0].warnings_
        pd.testing.assert_frame_equal(pipeline.report_, fits[0][0].report_)


def test_slow_writing_of_the_memory_is_not_told_to_the_user(tmp_path, monkeypatch):
    """Under load joblib warns of half a second for the record of the arguments."""
    ticks = itertools.count()
    slow = SimpleNamespace(**{**vars(joblib.memory.time), "time": ticks.__next__})
    monkeypatch.setattr(joblib.memory, "time", slow)  # every look takes a second
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    for _ in range(2):  # a warning would be an error
        line_pipeline(memory=tmp_path).fit(X, y)


@pytest.mark.slow
def test_memory_is_a_folder_a_path_or_a_joblib_memory(tmp_path):
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    expected = line_pipeline().fit(X, y)
    for memory in (
        str(tmp_path / "a"),
        tmp_path / "b",
        Memory(tmp_path / "c", verbose=0),
    ):
        for _ in range(2):
            pipeline = line_pipeline(memory=memory).fit(X, y)
            pd.testing.assert_frame_equal(pipeline.parameters_, expected.parameters_)
            pd.testing.assert_frame_equal(pipeline.report_, expected.report_)


def test_memory_teaches_what_it_cannot_be(tmp_path):
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    with pytest.raises(
        ValueError, match="`memory` must be None, a folder, or a joblib"
    ):
        line_pipeline(memory=3).fit(X, y)
    file = tmp_path / "file"
    file.touch()
    for place in (file, file / "below"):
        with pytest.raises(NotADirectoryError, match="`memory` must be a folder. Got"):
            line_pipeline(memory=place).fit(X, y)


@pytest.mark.slow
def test_steps_that_cannot_be_pickled_are_not_kept_and_said(tmp_path):
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    truth = spring_structure()
    structure = GrayBoxStructure.from_function(
        lambda theta: truth.matrices(theta), [30.0, 1.2, 50.0]
    )
    pipeline = line_pipeline(restructurer=GrayBoxRestructurer(structure))
    expected = pipeline.fit(X, y).parameters_
    with pytest.warns(UserWarning, match="keeps nothing .* `restructurer`") as told:
        pipeline.set_params(memory=tmp_path).fit(X, y)
    assert len(told) == 1 and not list(tmp_path.rglob("output.pkl"))
    pd.testing.assert_frame_equal(pipeline.parameters_, expected)


# -- code ------------------------------------------------------------------------------

PLANT = """
from functools import partial
import numpy as np
import {helpers}
from {helpers} import damping

MASS = {mass}


class Plant:
    length = {length}

    def matrices(self, theta):
        return stiffness(theta) / self.length


def stiffness(theta):
    def scaled(x):
        return {factor} * x
    return scaled(theta) / MASS + damping(theta) + {helpers}.offset() + np.abs(theta)
"""

HELPERS = """
def damping(theta):
    return {damping} * theta

def offset():
    return {offset}
"""


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Imports modules of a user, written with some values, under the same names."""
    monkeypatch.syspath_prepend(tmp_path)
    # Bytecode is known by the second and the size of its source, which may not differ.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    usual = {"mass": 2, "factor": 40, "length": 3, "damping": 0.5, "offset": 1}

    def write(comment="", **values):
        values = {**usual, **values}
        for name, text in (("users_helpers", HELPERS), ("users_plant", PLANT)):
            lines = comment + text.format(helpers="users_helpers", **values)
            (tmp_path / f"{name}.py").write_text(lines)
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        return importlib.import_module("users_plant")

    yield write
    for name in ("users_helpers", "users_plant"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    "change",
    [{"mass": 3}, {"factor": 20}, {"length": 4}, {"damping": 0.4}, {"offset": 2}],
)
def test_a_change_of_code_or_of_what_it_uses_is_seen(written, change):
    def told():
        module = written()
        plant = module.Plant()
        return fingerprint([plant, plant.matrices, partial(module.stiffness)])

    first = told()
    assert first == told()
    module = written(**change)
    plant = module.Plant()
    assert first != fingerprint([plant, plant.matrices, partial(module.stiffness)])


def test_lines_elsewhere_in_a_module_do_not_matter(written):
    before = fingerprint(written().stiffness)
    assert before != fingerprint(written(factor=41).stiffness)
    sys.modules.pop("users_helpers")
    same = written()
    same.unused = 3
    assert before == fingerprint(same.stiffness)


def test_what_a_function_closes_over_tells_it():
    def power(n):
        return lambda x: x**n

    assert fingerprint(power(1)) == fingerprint(power(1)) != fingerprint(power(2))


def test_functions_that_call_each_other_are_told():
    def even(n):
        return n == 0 or odd(n - 1)

    def odd(n):
        return n != 0 and even(n - 1)

    assert fingerprint(even) == fingerprint(even) != fingerprint(odd)


def test_what_cannot_be_told_apart_is_not_kept_and_said(tmp_path, calls):
    kept = partial(runner(Memory(tmp_path, verbose=0)).call, square)
    stream = (n for n in range(3))
    with pytest.warns(UserWarning, match="keeps no result that depends on.*generator"):
        assert kept(2, stream) == 4
    with pytest.warns(UserWarning, match="keeps no result"):
        kept(2, stream)
    assert len(calls) == 2


@pytest.mark.slow
def test_a_structure_whose_function_was_edited_is_restructured_anew(written, tmp_path):
    text = """
def matrices(theta):
    k, c, b = theta
    return [[0, 1], [-k * {factor} / 40, -c]], [[0], [b]], [[1, 0]], [[0]]
"""
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    found = []
    for factor in (40, 20, 40):
        (tmp_path / "users_plant.py").write_text(text.format(factor=factor))
        sys.modules.pop("users_plant", None)
        importlib.invalidate_caches()
        function = importlib.import_module("users_plant").matrices
        structure = GrayBoxStructure.from_function(function, [30.0, 1.2, 50.0])
        pipeline = line_pipeline(
            restructurer=GrayBoxRestructurer(structure), memory=tmp_path / "kept"
        )
        found.append(pipeline.fit(X, y).parameters_.to_numpy())
    np.testing.assert_allclose(found[1] / found[0], [[2, 1, 1]] * 2, rtol=1e-5)
    np.testing.assert_array_equal(found[0], found[2])


def test_equal_values_have_one_fingerprint():
    """However they lie in memory, are shared, ordered in a set, or hold each other."""
    x = np.arange(6.0).reshape(2, 3)
    assert fingerprint(x) == fingerprint(np.asfortranarray(x)) != fingerprint(x.T)
    assert fingerprint([x, x]) == fingerprint([x, x.copy()])
    assert fingerprint({"b", "a"}) == fingerprint({"a", "b"}) != fingerprint({"a"})
    assert fingerprint(x) != fingerprint(x.astype(np.float32))
    rings = [[1], [1], [2]]
    for ring in rings:
        ring.append(ring)
    first, same, other = map(fingerprint, rings)
    assert first == same != other
