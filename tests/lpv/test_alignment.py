"""Alignment of black boxes: bases that are known are found again."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import solve_continuous_lyapunov

from lpvlearn import StateSpace
from lpvlearn.lpv.alignment import (
    STATES,
    _Distance,
    aligned_models,
    rotations_to,
    spanning_tree,
)

from ..conftest import modes, stable_model


def turned(models, seed):
    """Each in another orthogonal basis, as balancing may leave it."""
    rng = np.random.default_rng(seed)
    return [
        model.transform(np.linalg.qr(rng.normal(size=2 * (model.order,)))[0])
        for model in models
    ]


def family(points):
    """Balanced at the first point, smooth entries over one or two variables."""
    start = stable_model(3, feedthrough=True).balance()
    slopes = np.random.default_rng(4).normal(size=(2, 4, 4))
    return [
        StateSpace(
            start.A + 0.05 * np.tensordot(np.r_[k, 0.0][:2], slopes, 1),
            start.B,
            start.C,
            start.D,
        )
        for k in points
    ]


@pytest.mark.parametrize("order", [1, 2, 5])
def test_a_model_and_itself_turned_agree(order):
    model = stable_model(order, order).balance()
    other = turned([model], 1)[0]
    (T,) = rotations_to([other], model)
    assert_allclose(T @ T.T, np.eye(order), atol=1e-10)
    back = other.transform(T.T)
    for block in "ABC":
        assert_allclose(getattr(back, block), getattr(model, block), atol=1e-8)


def test_the_derivatives_are_those_of_the_residuals():
    model, reference = (stable_model(seed, 4).balance() for seed in (1, 2))
    distance = _Distance([model], reference, stable_model(3, 4).A)
    rng = np.random.default_rng(0)
    start = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    k, step = rng.normal(size=(1, 6)), 1e-6

    def turned(k):
        return distance.turned([0], start @ distance.turn(k)[0])

    changes = [
        distance.residuals(*turned(k + e)) - distance.residuals(*turned(k - e))
        for e in step * np.eye(6)[:, None]
    ]
    J = distance.jacobian(*turned(k), distance.turn(k)[1])
    expected = np.array(changes).transpose(1, 2, 0) / (2 * step)
    assert_allclose(J, expected, atol=1e-8)


@pytest.mark.parametrize("damping", [0.1, 0.01, 0.001])
def test_modes_whose_frequency_moves_by_more_than_they_decay(damping):
    """Between neighbours the matrices of one physical basis are as near as in it."""
    points = np.linspace(0.0, 1.0, 4)[:, None]
    models = []
    for x in points[:, 0]:
        A = modes(*[(-damping + 1j) * w for w in (5.0 + 5.0 * x, 20.0 - 6.0 * x)])
        B, C = [[0.0], [1.0], [0.0], [0.6 + x]], [[1.0, 0.0, -0.7, 0.0]]
        models.append(StateSpace(A, B, C).balance())
    A = np.array([model.A for model in aligned_models(turned(models, 8), points)])
    middle = np.linalg.eigvals((A[1:] + A[:-1]) / 2.0)
    x = (points[1:] + points[:-1]) / 2.0
    slow, fast = 5.0 + 5.0 * x, 20.0 - 6.0 * x
    found = np.sort(np.abs(middle.imag), axis=1)
    assert_allclose(found, np.hstack([slow, slow, fast, fast]), rtol=0.02)


@pytest.mark.parametrize(("states", "name"), [*zip(STATES[1:], "BC", strict=True)])
def test_one_gramian_of_normal_states_is_the_identity(states, name):
    """In units of the largest Hankel singular value, whatever these are."""
    points = np.array([[0.0], [1.0]])
    models = [StateSpace(m.A, 1e6 * m.B, m.C) for m in family(points)]
    models = [model.balance() for model in models]
    size = max(m.hankel_singular_values().max() for m in models)
    for model in aligned_models(models, points, states):
        A, F = (model.A, model.B) if name == "B" else (model.A.T, model.C.T)
        gramian = solve_continuous_lyapunov(A, -F @ F.T)
        assert_allclose(gramian / size, np.eye(4), atol=1e-9)


def test_models_without_states_have_nothing_to_turn():
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]])
    assert aligned_models([gain, gain], np.array([[0.0], [1.0]]))[1].order == 0


def test_equal_singular_values_leave_nothing_open():
    """Two alike modes: balanced up to any rotation, which signs cannot undo."""
    A = modes(-0.5 + 2j, -0.5 + 2j)
    model = StateSpace(A, np.eye(4), np.eye(4)).balance()
    back = turned([model], 2)[0]
    back = back.transform(rotations_to([back], model)[0].T)
    assert_allclose(back.A, model.A, atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [
        np.random.default_rng(0).uniform([0, 10], [1, 30], (12, 2)) / [1, 30],
        np.array([[0.0], [1.0], [0.0]]),
        np.array([[2.0]]),
    ],
)
def test_the_models_stay_what_they_are(points):
    truth = family(points)
    omega = np.geomspace(0.1, 10, 9)
    found = aligned_models(turned(truth, 5), points)
    for model, true in zip(found, truth, strict=True):
        assert_allclose(model.frequency_response(omega), true.frequency_response(omega))


def test_a_smooth_family_is_smooth_again():
    """The jump from point to point goes to zero with their distance."""

    def jump(n_points):
        points = np.linspace(0, 1, n_points)[:, None]
        models = [model.balance() for model in family(points)]
        A = np.array([m.A for m in aligned_models(turned(models, 5), points)])
        return np.abs(np.diff(A, axis=0)).max()

    assert jump(41) < 0.35 * jump(11)


def test_the_order_of_the_points_does_not_matter():
    points = np.random.default_rng(1).uniform(size=(9, 2))
    models = turned(family(points), 6)
    found = aligned_models(models, points)
    mixed = np.random.default_rng(2).permutation(9)
    again = aligned_models([models[k] for k in mixed], points[mixed])
    for k, model in zip(mixed, again, strict=True):
        assert_allclose(model.A, found[k].A, atol=1e-9)


def test_units_of_the_scheduling_variables_do_not_matter():
    points = np.random.default_rng(3).uniform(size=(9, 2))
    models = turned(family(points), 7)
    found = aligned_models(models, points)
    again = aligned_models(models, points * [1e-6, 1e6])
    for one, other in zip(found, again, strict=True):
        assert_allclose(one.A, other.A, atol=1e-9)


def test_of_two_points_in_the_middle_units_choose_none():
    kappa = np.array([1.0, 2.0, 3.3, 4.0, 6.0, 9.0])[:, None]
    roots = {
        int(spanning_tree(kappa * c)[0][0]) for c in (1, 1e-6, 1 / 3, 2.54, 1 / 60)
    }
    assert len(roots) == 1
