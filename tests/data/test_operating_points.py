"""Operating points: experiments grouped, and refused where they are not local."""

import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest

from lpvlearn.data.experiments import Experiment
from lpvlearn.data.operating_points import (
    _check_local,
    check_outputs,
    group_operating_points,
    local_experiments,
    moving_experiments,
    without_spikes,
)


def _runs(values, spread=0.0, points=None):
    wiggle = spread * np.array([-0.5, 0.5, 0.0])[:, None]
    return [
        Experiment(
            label=k,
            rows=np.arange(3 * k, 3 * k + 3),
            inputs=np.ones((3, 1)),
            scheduling=np.atleast_1d(value) + wiggle,
            operating_point=None if points is None else points[k],
        )
        for k, value in enumerate(values)
    ]


def test_realizations_of_a_point_are_grouped_whatever_their_order():
    rng = np.random.default_rng(1)
    truth = np.repeat([-0.9, 0.1, 0.8], 10)
    order = rng.permutation(30)
    values = truth + rng.uniform(-2e-3, 2e-3, 30)
    index, kappa = group_operating_points(_runs(values[order], spread=0.01))
    np.testing.assert_array_equal(index, np.repeat([0, 1, 2], 10)[order])
    np.testing.assert_allclose(kappa.ravel(), values.reshape(3, 10).mean(axis=1))


@pytest.mark.parametrize("n_samples", [300, 400])
def test_points_of_constant_experiments_are_at_these_very_values(n_samples):
    values = [0.1, 0.4, 0.7]
    runs = [
        replace(run, scheduling=np.full((n_samples, 1), run.scheduling[0]))
        for run in _runs(3 * values)
    ]
    index, kappa = group_operating_points(runs)
    assert kappa.ravel().tolist() == values
    np.testing.assert_array_equal(index, 3 * [0, 1, 2])


def test_points_are_as_far_apart_as_their_own_records_move():
    """Of a level that moves by a part of itself: the lowest points are the nearest."""
    levels = np.array([1.0, 2.5, 4.0, 6.0, 8.5, 11.0, 13.5, 16.0])
    runs = [_runs([level], spread=0.15 * level)[0] for level in [*levels, 16.2]]
    index, kappa = group_operating_points(runs)
    np.testing.assert_array_equal(index, [*range(8), 7])
    np.testing.assert_allclose(kappa.ravel(), [*levels[:-1], 16.1])


def test_points_of_two_scheduling_variables_need_both_to_agree():
    values = [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]]
    index, kappa = group_operating_points(_runs(values))
    np.testing.assert_array_equal(kappa, [[0, 0], [0, 1], [1, 0]])
    np.testing.assert_array_equal(index, [0, 1, 2, 1])


def test_labels_of_operating_points_come_before_scheduling_values():
    index, kappa = group_operating_points(
        _runs([0.5, 0.2, 0.2], points=["hot", "cold", "hot"])
    )
    np.testing.assert_array_equal(index, [1, 0, 1])
    np.testing.assert_allclose(kappa, [[0.2], [0.35]])


def test_a_tolerance_is_in_units_of_the_scheduling_variable():
    values = [0.0, 0.3, 1.0]
    assert group_operating_points(_runs(values), tol=0.29)[1].shape == (3, 1)
    assert group_operating_points(_runs(values), tol=0.31)[1].shape == (2, 1)
    assert group_operating_points(_runs([1.0, 1.0]), tol=0)[1].shape == (1, 1)


def test_without_scheduling_there_is_one_point():
    runs = [replace(run, scheduling=None) for run in _runs([0.1, 0.2, 0.3])]
    index, kappa = group_operating_points(runs)
    np.testing.assert_array_equal(index, [0, 0, 0])
    assert kappa.shape == (1, 0)


@pytest.mark.parametrize(
    "values", [[1, 10, 100, 1e3, 1e4], [0, 1, 2, 100], [5e3, 1e4, 1e5, 1e6]]
)
def test_values_that_stand_still_are_points_where_they_differ_by_their_size(values):
    index, kappa = group_operating_points(_runs(values))
    np.testing.assert_array_equal(kappa[index, 0], values)
    index, kappa = group_operating_points(_runs([300.1, 300.2, 350.0, 350.1]))
    np.testing.assert_allclose(kappa[:, 0], [300.15, 350.05])


@pytest.mark.parametrize(
    ("values", "tol", "words"),
    [
        (np.linspace(1, 2, 200), None, ["200 experiments", "chain", "scheduling_tol"]),
        ([0.0, 1.0], -1, ["scheduling_tol", "Got -1"]),
        ([0.0, 1.0], [0.1, 0.1], ["scheduling_tol", "variable (1)"]),
    ],
)
def test_unclear_groups_raise(values, tol, words):
    with pytest.raises(ValueError) as raised:
        group_operating_points(_runs(values), tol=tol)
    for word in words:
        assert word in str(raised.value)


def test_local_experiments_pass_and_sweeps_raise():
    runs = _runs([0.0, 1.0, 2.0], spread=0.1)
    _, kappa = group_operating_points(runs)
    _check_local(runs, kappa)
    sweep = _runs([0.0, 1.0, 2.0], spread=1.5)
    with pytest.raises(ValueError, match=r"Experiment 0 must be local.*1\.5.*\(2\)"):
        _check_local(sweep, kappa)


def test_a_step_to_another_point_is_not_local_however_near_it_is():
    runs = _runs([0.0, 1.0, 2.0])
    stepping = np.repeat([0.0, 0.2], 50)[:, None]
    drifting = np.repeat([0.0, 0.02], 50)[:, None]
    for scheduling, is_local in ((stepping, False), (drifting, True)):
        first = replace(runs[0], scheduling=scheduling, rows=np.arange(100))
        changed = [first, *runs[1:]]
        _, kappa = group_operating_points(changed)
        if is_local:
            _check_local(changed, kappa)
        else:
            with pytest.raises(ValueError, match="steps from 0 to 0.2.*split_levels"):
                _check_local(changed, kappa)


def test_a_single_sweep_is_not_local():
    (run,) = runs = _runs([1.0], spread=1.0)
    with pytest.raises(ValueError, match="must be local"):
        _check_local(runs, run.scheduling.mean(axis=0, keepdims=True))


def _record(signal, label=0):
    signal = np.asarray(signal, float).reshape(len(signal), -1)
    rows = np.arange(len(signal))
    return Experiment(label, rows, np.ones((len(rows), 1)), scheduling=signal)


@pytest.mark.parametrize(
    ("points", "noise"),
    [
        (np.linspace(0.0, 2.0, 12), 0.06),
        (np.repeat(np.linspace(0.0, 2.0, 8), 2), 0.05),
        ([0.0, 0.15, 1.0, 1.15, 2.0, 2.15], 0.06),
        ([0.0, 0.1, 0.2, 1.0, 1.1, 1.2, 2.0], 0.1),
        ([0.0, 0.2], 0.05),
    ],
)
def test_white_noise_of_a_sensor_joins_no_points(points, noise):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        runs = [
            _record(value + noise * rng.standard_normal(400), k)
            for k, value in enumerate(points)
        ]
        found = local_experiments(runs)
        np.testing.assert_allclose(found.kappa[:, 0], np.unique(points), atol=0.02)
        assert moving_experiments(runs) == (runs, [])


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("turns", [0.25, 1.0, 3.0, 20.0])
def test_what_moves_is_no_noise(turns, noise):
    rng = np.random.default_rng(int(turns))
    motion = 0.3 * np.sin(2.0 * np.pi * turns * np.linspace(0.0, 1.0, 400))
    signals = [k + noise * rng.standard_normal(400) for k in (0.0, 0.5, 1.0)]
    runs = [_record(signal, k) for k, signal in enumerate(signals)]
    runs[1] = _record(signals[1] + motion, 1)
    with pytest.raises(ValueError, match="Experiment 1 must be local"):
        local_experiments(runs)
    assert moving_experiments(runs)[1] == [runs[1]]


def test_a_variable_that_tells_no_points_apart_is_to_be_left_out():
    rng = np.random.default_rng(0)
    drift = np.linspace(-0.005, 0.005, 400)
    runs = [
        _record(np.column_stack([np.full(400, k), h + drift]), k)
        for k, h in enumerate(5.0 + 0.003 * rng.standard_normal(6))
    ]
    with pytest.raises(ValueError, match="Variable 2 hardly differs.*leave it out"):
        local_experiments(runs)
    drifting = replace(
        runs[0], scheduling=runs[0].scheduling + [100.0, 0.0] * drift[:, None]
    )
    with pytest.raises(ValueError, match="must be local") as raised:
        _check_local([drifting, *runs[1:]], np.array([[0.0, 0.0], [1.0, 9.0]]))
    assert "leave it out" not in str(raised.value)


def test_spikes_of_scheduling_variables_are_replaced_and_told():
    rng = np.random.default_rng(0)
    clean = [k + 0.01 * rng.standard_normal(300) for k in (0.0, 0.5, 1.0)]
    spiky = [signal.copy() for signal in clean]
    spiky[1][77], spiky[2][100:103] = 0.0, -999.0
    with pytest.warns(
        UserWarning, match=r"experiment 1: 0 at sample 77, 2: -999 at sam"
    ):
        found = without_spikes([_record(x, k) for k, x in enumerate(spiky)])
    for run, signal in zip(found, clean, strict=True):
        np.testing.assert_allclose(run.scheduling[:, 0], signal, atol=0.05)


@pytest.mark.parametrize(
    "signal",
    [
        np.sign(np.sin(0.1 * np.arange(300.0))),
        np.sin(np.arange(300.0)),
        np.repeat([0.0, 1.0, 0.5, 2.0, 0.0], 60),
        np.linspace(0.0, 1.0, 300),
        np.full(300, 3.0),
        np.random.default_rng(0).standard_normal(300),
        np.r_[[0.0] * 5, 1.0],
    ],
)
def test_what_moves_has_no_spikes(signal):
    run = _record(signal)
    assert without_spikes([run])[0] is run


def test_measured_outputs_are_looked_at_one_experiment_at_a_time():
    runs = [
        Experiment(k, np.arange(20_000), np.zeros((20_000, 1)), np.full((20_000, 1), k))
        for k in range(50)
    ]
    tracemalloc.start()
    check_outputs(runs, ["y"])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 50 * 20_000 * 8 / 4


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("n", [40, 300, 3000])
def test_what_one_record_alone_has_is_no_noise_of_the_sensor(n, noise):
    """Levels that are new in every sample look like white noise."""
    rng = np.random.default_rng(0)
    new = rng.uniform(-1, 1, n), np.sign(rng.standard_normal(n))
    for moving in (*new, np.sin(2.1 * np.arange(n))):
        values = [np.full(n, place) for place in (-1.0, -0.3, 0.3, 1.0)] + [moving]
        noisy = [x + noise * rng.standard_normal(n) for x in values]
        runs = [_record(signal, k) for k, signal in enumerate(noisy)]
        assert moving_experiments(runs)[1] == [runs[-1]]


@pytest.mark.parametrize(
    "labels, told",
    [
        ("aaa", "operating point 'a' are at scheduling 0 to 2, as far apart"),
        ("abb", "operating point 'b' are at scheduling 1 to 2, as far apart"),
        ("abc", None),
    ],
)
def test_labels_that_scheduling_variables_contradict_are_told(labels, told):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        local_experiments(_runs([0.0, 1.0, 2.0], points=labels))
        local_experiments(_runs([0.0, 0.01, 2.0], points="aab"))
    said = [str(w.message) for w in warned if "Check the labels" in str(w.message)]
    assert len(said) == (told is not None) and all(told in one for one in said)
