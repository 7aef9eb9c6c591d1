"""The quadratic program, the certificate, and what both solvers must do."""

import numpy as np
import pytest

from lpvlearn.minimax import problem as problem_room
from lpvlearn.minimax.bundle import proximal_bundle
from lpvlearn.minimax.problem import (
    NO_STEP,
    MinimaxProblem,
    epigraph_step,
    shortest_in_hull,
)
from lpvlearn.minimax.sqp import minimax_sqp

from .conftest import charalambous_bandler, problem_of

SOLVERS = [minimax_sqp, proximal_bundle]


@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_reach_the_known_optimum(solver):
    result = solver(charalambous_bandler(), np.array([1.0, -0.1]))
    assert np.isclose(result.peaks.top, 1.9522244939, rtol=1e-8)
    assert result.stationarity < 1e-4
    assert result.converged


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_constraint_is_respected(solver):
    # min (y - 3)^2 + 1 with y <= 1
    problem = problem_of(
        [lambda y: (y[0] - 3) ** 2 + 1],
        [lambda y: np.array([2 * (y[0] - 3)])],
        [lambda y: np.array([[2.0]])],
        constraint=lambda y: (y[0] - 1.0, np.array([1.0])),
    )
    result = solver(problem, np.array([-2.0]))
    assert np.isclose(result.y[0], 1.0, atol=1e-6)
    assert result.stationarity < 1e-6


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_saddle_is_left(solver):
    # f = 2 + x^4/4 - x^2 + y^2 has a saddle at the origin, minima at x = +-sqrt(2)
    problem = problem_of(
        [lambda y: 2 + y[0] ** 4 / 4 - y[0] ** 2 + y[1] ** 2],
        [lambda y: np.array([y[0] ** 3 - 2 * y[0], 2 * y[1]])],
        [lambda y: np.diag([3 * y[0] ** 2 - 2, 2.0])],
    )
    result = solver(problem, np.array([0.05, 1.0]))
    assert np.isclose(abs(result.y[0]), np.sqrt(2), atol=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_rounding_noise_is_not_minimised(solver):
    problem = problem_of(
        [lambda y: 1e-13 + 1e-13 * float(y @ y)],
        [lambda y: 2e-13 * y],
        [lambda y: 2e-13 * np.eye(2)],
    )
    result = solver(problem, np.ones(2), negligible=1e-11)
    assert result.converged and result.n_iter == 0


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_inadmissible_start_is_refused(solver):
    problem = MinimaxProblem(lambda y: None, None, None, None, None)
    with pytest.raises(ValueError, match="not admissible"):
        solver(problem, np.zeros(2))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_failed_quadratic_program_is_named(solver, monkeypatch):
    """Not an optimum: the start is kept, and the result says why."""

    def infeasible(P, *_, **__):
        return np.full(len(P), np.nan), np.nan, -1, {"lam": np.zeros(0)}

    monkeypatch.setattr(problem_room.daqp, "solve", infeasible)
    y0 = np.array([1.0, -0.1])
    result = solver(charalambous_bandler(), y0)
    assert not result.converged
    assert result.cause == NO_STEP
    np.testing.assert_array_equal(result.y, y0)
    assert result.stationarity > 0.1


def test_epigraph_step_solves_its_optimality_conditions():
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, k = 5, 7
        H = np.eye(q) + 0.1 * np.diag(rng.uniform(size=q))
        values, G = rng.normal(size=k), rng.normal(size=(k, q))
        d, weights, _ = epigraph_step(
            H, values, G, np.zeros(0), np.zeros((0, q)), radius=1e3
        )
        np.testing.assert_allclose(H @ d, -G.T @ weights, atol=1e-8)
        heights = values + G @ d
        active = weights > 1e-8
        np.testing.assert_allclose(heights[active], heights.max(), atol=1e-8)


def test_shortest_vector_in_a_hull():
    distance, weights = shortest_in_hull(np.array([[2.0, 1.0], [2.0, -3.0]]))
    assert np.isclose(distance, 2.0)
    np.testing.assert_allclose(weights, [0.75, 0.25])
    triangle = np.array([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]])
    assert shortest_in_hull(triangle)[0] < 1e-12
    assert shortest_in_hull(1e-9 * triangle)[0] < 1e-20
    assert np.isclose(shortest_in_hull(np.array([[3.0, 4.0]]))[0], 5.0)


def test_a_peak_out_of_reach_changes_no_step():
    rng = np.random.default_rng(0)
    H, values, G = np.eye(3), -rng.random(4) / 10, rng.normal(size=(4, 3))
    none = np.zeros(0), np.zeros((0, 3))
    d, multipliers, _ = epigraph_step(H, values, G, *none, 0.1)
    low = np.append(values, values.min() - 0.2 * np.abs(G).sum(1).max())
    again, more, _ = epigraph_step(H, low, np.vstack([G, G[:1]]), *none, 0.1)
    np.testing.assert_array_equal(again, d)
    np.testing.assert_array_equal(more, np.append(multipliers, 0.0))
