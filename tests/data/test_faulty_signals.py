"""Signs of sensors and loggers in a signal."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.data.faulty_signals import (
    far_out,
    line_length,
    repeated_in_bursts,
    wraps,
)


@pytest.mark.parametrize(
    ("signal", "found"),
    [
        (np.sign(np.random.default_rng(0).standard_normal(200)), []),
        (np.eye(200)[70], []),  # an impulse, beside which nothing moves
        (np.random.default_rng(0).standard_normal(5000), []),
        (np.full(20, 1.0), []),
        (np.linspace(-1, 1, 200) + 40.0 * np.eye(200)[33], [33]),
        (np.linspace(-1, 1, 200) + 40.0 * np.eye(200)[[33, 34]].sum(axis=0), []),
    ],
    ids=["two values", "impulse", "noise", "short", "one", "two that are neighbours"],
)
def test_single_samples_stand_far_out(signal, found):
    assert np.flatnonzero(far_out(signal[:, None])).tolist() == found


def _record(seed, n_samples=1200, hold=1, noise=0.01):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((n_samples // hold, 1)), hold, axis=0)
    system = StateSpace(
        [[1.7, -0.8], [1.0, 0.0]], [[1.0], [0.0]], [[0.1, 0.1]], None, 1
    )
    y = system.simulate(u)
    return u, y + noise * y.std() * rng.standard_normal(y.shape)


def _told(u, y, **options):
    options = options or {"order": 2, "method": "po-moesp", "horizon": 10}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        SubspaceLTI(**options).fit(u, y)
    return "\n".join(str(one.message) for one in told)


@pytest.mark.parametrize("length", [2, 4, 10])
def test_an_output_that_was_interpolated_is_told(length):
    u, y = _record(0)
    time, known = np.arange(len(y)), np.arange(0, len(y), length)
    lines = np.interp(time, known, y[known, 0])[:, None]
    assert line_length([lines[:, 0]]) == length
    assert f"lines for {length} samples" in _told(u, lines)


def test_lines_that_a_linear_system_draws_are_none_of_a_logger():
    u, _ = _record(1, hold=5)
    assert line_length([_record(1)[1][:, 0]]) == 1
    y = lfilter([0.0, 1.0], [1.0, -1.0], u, axis=0)
    assert line_length([y[:, 0]]) == 5
    assert "lines" not in _told(u, y)


def test_bursts_of_repeated_samples_are_told():
    u, y = _record(2)
    for start in (100, 400, 401, 700, 1000):
        y[start : start + 6] = y[start]
    assert len(repeated_in_bursts([y[:, 0]])) == 4
    assert "repeats its last value in 21 samples, 4 time" in _told(u, y)


def test_rests_and_coarse_sensors_are_no_bursts():
    u, y = _record(3, noise=0.0)
    moves = np.arange(len(u)) % 300 < 100
    u = np.where(moves[:, None], u, 0.0)
    system = StateSpace([[0.5]], [[1.0]], [[1.0]], None, 1.0)
    assert not repeated_in_bursts([np.round(system.simulate(u)[:, 0], 9)])
    assert not repeated_in_bursts([np.round(y[:, 0], 1)])
    assert not repeated_in_bursts([np.repeat(y[:, 0], 3)])
    place, places = 0.0, []
    for value in y[:, 0]:
        place = min(max(place, value - 0.3), value + 0.3)
        places.append(place)
    assert not repeated_in_bursts([np.array(places)])  # but play


def test_an_angle_that_is_turned_back_is_told():
    u, _ = _record(4)
    angle = np.cumsum(0.3 + 0.1 * u, axis=0)
    wrapped = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    assert "jumps back by nearly its whole range" in _told(u, wrapped)
    slow = lfilter([0.1], [1.0, -0.9], u, axis=0)
    assert wraps([wrapped[:, 0]], [slow]) > 50
    squares = np.sign(np.sin(0.05 * np.arange(1200.0)))
    for signal in (angle[:, 0], squares, u[:, 0]):
        assert wraps([signal], [u]) == 0
    assert wraps([wrapped[:, 0]], [wrapped]) == 0


def test_inputs_and_outputs_that_are_exchanged_are_told():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 200), 4)[:, None]
    system = StateSpace([[1.6, -0.7], [1, 0]], [[1], [0]], [[0.1, 0]], None, 1)
    y = system.simulate(u)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    told = _told(y, u, order="auto")
    assert told.startswith("Output 1 takes 2 values only, as a command does")
    assert "\n" not in told  # what else may be said comes of that
    assert not _told(u, y, order="auto")
    coarse = _told(u, np.round(y / y.std()), order="auto")
    assert "exchanged" not in coarse  # a sensor of few steps
