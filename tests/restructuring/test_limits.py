"""Stability margin, speed and bounds as constraints."""

import numpy as np
import pytest

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.error_system import ErrorSystem, Target
from lpvlearn.restructuring.limits import Limits, growth


def system_of(dt=None):
    model = StateSpace([[0, 1], [-4, -0.5]], [[0], [1]], [[1, 0]])
    structure = GrayBoxStructure.full(2, 1, 1, feedthrough=False)
    if dt is not None:
        model = model.to_discrete(dt)
    theta = np.concatenate([M.ravel() for M in (model.A, model.B, model.C)])
    target = Target(model.A, model.B, model.C, model.D, dt)
    return ErrorSystem(structure, target), theta, model


def mass(theta):
    m, k, c = theta
    A = np.array([[0 * m, 1 + 0 * m], [-k / m, -c / m]])
    return A, np.array([[0 * m], [1 / m]]), np.array([[1.0, 0.0]])


@pytest.mark.parametrize("dt", [None, 0.1])
def test_gradients_are_those_of_the_rows(dt):
    system, theta, _ = system_of(dt)
    limits = Limits(system, 0.05)
    theta = theta + 0.01 * np.random.default_rng(0).normal(size=len(theta))
    c, dc, _ = limits.rows(theta)
    h = 1e-6
    for j, e in enumerate(np.eye(len(theta))):
        up, down = limits.rows(theta + h * e)[0], limits.rows(theta - h * e)[0]
        slope = (up - down) / (2 * h)
        assert np.allclose(dc[:, j], slope, rtol=1e-5, atol=1e-8 * np.abs(dc).max())


def test_growth_is_the_same_in_both_time_domains():
    continuous, discrete = system_of()[2], system_of(0.1)[2]
    assert np.allclose(
        np.sort(growth(discrete.poles(), 0.1)),
        np.sort(growth(continuous.poles(), None)),
    )
    rows = Limits(system_of()[0], 0.05).rows(system_of()[1])
    sampled = Limits(system_of(0.1)[0], 0.05).rows(system_of(0.1)[1])
    # relative to their sizes: the rate is over |pole|, or over itself
    assert np.allclose(rows[0][:2], sampled[0])
    assert np.allclose(sampled[2], np.abs(growth(discrete.poles(), 0.1)))


def test_admissible_up_to_most_of_the_margin():
    system, theta, model = system_of()
    rate = -model.poles().real.max()
    assert Limits(system, rate).admissible(theta)
    assert not Limits(system, rate).strict(theta)
    assert Limits(system, 0.99 * rate).strict(theta)
    assert not Limits(system, 2.0 * rate).admissible(theta)


def test_a_vanishing_mass_is_stopped():
    structure = GrayBoxStructure.from_function(mass, {"m": 1.0, "k": 4.0, "c": 0.5})
    model = StateSpace([[-8.0]], [[2.0]], [[1.0]])
    target = Target(model.A, model.B, model.C, model.D)
    system = ErrorSystem(structure, target)
    limits = Limits(system, 0.0)
    assert limits.admissible(np.array([1e-6, 4.0, 0.5]))
    # the fast pole is at c / m
    assert not limits.admissible(np.array([0.4 / 8e6, 4.0, 0.5]))
    c, dc, _ = limits.rows(np.array([1e-3, 4.0, 0.5]))
    fast = np.argmax(c[2:4])
    assert np.isclose(c[2 + fast], 1e-6 - 8.0 / (0.5 / 1e-3), rtol=0.03)
    assert dc[2 + fast, 0] < 0  # more mass, slower


def test_inside_moves_off_the_bounds_only():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]]).with_bounds(
        {"a": (1, 2), "b": (0, None)}
    )
    target = Target(*(np.array([[v]]) for v in (-1.0, 1.0, 1.0, 0.0)))
    limits = Limits(ErrorSystem(structure, target), 0.0)
    moved = limits.inside(np.array([2.0, 0.0]))
    assert 1 < moved[0] < 2 and 0 < moved[1] < 0.01
    kept = np.array([1.5, 3.0])
    assert (limits.inside(kept) == kept).all()


def test_a_pole_at_rest_has_finite_constraints():
    system, theta, _ = system_of()
    c, dc, _ = Limits(system, 0.05).rows(np.zeros_like(theta))
    assert np.isfinite(c).all() and np.isfinite(dc).all()
