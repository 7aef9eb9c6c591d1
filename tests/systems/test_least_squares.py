"""Levenberg-Marquardt from a stack of starts."""

import numpy as np
import pytest

from lpvlearn.systems.least_squares import levenberg_marquardt, thin_svd


def rosenbrock(x, _):
    r = np.stack([10.0 * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], axis=1)

    def jacobian(kept):
        J = np.zeros((len(kept), 2, 2))
        J[:, 0, 0], J[:, 0, 1], J[:, 1, 0] = -20.0 * x[kept, 0], 10.0, -1.0
        return J

    r[x[:, 0] < -1.5] = np.nan  # not admissible
    return r, jacobian


def test_every_start_reaches_the_minimum_as_it_does_alone():
    starts = np.array([[-1.2, 1.0], [0.0, 0.0], [3.0, -2.0], [-2.0, 0.0]])
    x, cost = levenberg_marquardt(rosenbrock, starts, max_iter=200, tol=1e-12)
    assert np.allclose(x[:3], 1.0, atol=1e-8)
    assert cost[:3].max() < 1e-16
    assert cost[3] == np.inf and (x[3] == starts[3]).all()
    for k, start in enumerate(starts):
        alone = levenberg_marquardt(rosenbrock, start[None], max_iter=200, tol=1e-12)
        assert np.allclose(alone.x[0], x[k], rtol=1e-12)


def test_bounds_hold_and_the_gradient_presses_against_them():
    x, cost = levenberg_marquardt(
        rosenbrock, np.zeros((1, 2)), upper=np.array([0.5, 9.0]), max_iter=200
    )
    assert np.allclose(x, [[0.5, 0.25]], atol=1e-6)
    assert np.isclose(cost[0], 0.25)


@pytest.mark.parametrize("enough", [1, 2])
def test_enough_exact_starts_end_all(enough):
    starts = np.array([[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    x, cost = levenberg_marquardt(rosenbrock, starts, exact=1e-20, enough=enough)
    assert (x[2] == 0.0).all() and cost[2] == 1.0


def test_parameters_without_effect_stay():
    def residuals(x, _):
        return x[:, :1] - 2.0, lambda kept: np.tile([[[1.0, 0.0]]], (len(kept), 1, 1))

    x, _ = levenberg_marquardt(residuals, np.array([[0.0, 7.0]]), max_iter=50)
    assert np.allclose(x, [[2.0, 7.0]])


def test_bent_steps_follow_a_curved_valley():
    def valley(x, _):
        """A valley along a parabola, a hundred times steeper across."""
        r = np.stack([1e2 * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], axis=1)

        def jacobian(kept):
            J = np.zeros((len(kept), 2, 2))
            J[:, 0, 0], J[:, 0, 1], J[:, 1, 0] = -2e2 * x[kept, 0], 1e2, -1.0
            return J

        return r, jacobian

    start = np.array([[-3.0, 9.0]])
    costs = [
        levenberg_marquardt(valley, start, max_iter=30, tol=1e-12, geodesic=bent).cost
        for bent in (False, True)
    ]
    assert costs[0] > 1e-2
    assert costs[1] < 1e-20


def test_bent_steps_keep_bounds_and_what_is_admissible():
    starts = np.array([[-1.2, 1.0], [0.0, 0.0], [3.0, -2.0], [-2.0, 0.0]])
    options = {"max_iter": 200, "tol": 1e-12, "geodesic": True}
    x, cost = levenberg_marquardt(rosenbrock, starts, **options)
    assert np.allclose(x[:3], 1.0, atol=1e-8)
    assert cost[3] == np.inf
    upper = np.array([0.5, 9.0])
    x, cost = levenberg_marquardt(rosenbrock, np.zeros((1, 2)), upper=upper, **options)
    assert np.allclose(x, [[0.5, 0.25]], atol=1e-6)


def test_a_search_that_is_stopped_keeps_its_best():
    looks = iter([False, False, True])
    start = np.array([[-1.2, 1.0]])
    x, cost = levenberg_marquardt(rosenbrock, start, stop=lambda: next(looks))
    assert 0.0 < cost[0] < np.sum(rosenbrock(start, None)[0] ** 2)


def test_a_point_whose_squared_derivatives_overflow_is_none():
    def residuals(x, rows):
        jacobian = np.full((len(x), 1, 1), 1e200)
        return x.copy(), lambda better: jacobian[better]

    reached, cost = levenberg_marquardt(residuals, np.array([[2.0]]))
    assert reached.item() == 2.0 and cost.item() == np.inf


@pytest.mark.parametrize("stacked", [False, True])
def test_an_svd_that_does_not_converge_is_found_by_another_way(monkeypatch, stacked):
    M = np.random.default_rng(0).standard_normal((6, 3))
    M = np.column_stack([M, M[:, 0] - 2.0 * M[:, 1]])
    M = np.stack([M, 2.0 * M]) if stacked else M

    def fails(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(np.linalg, "svd", fails)
    U, s, Vt = thin_svd(M)
    assert U.shape == M.shape and s.shape == M.shape[:-2] + (4,)
    np.testing.assert_allclose((U * s[..., None, :]) @ Vt, M, atol=1e-13)
    np.testing.assert_allclose(s[..., 3], 0.0, atol=1e-13)
