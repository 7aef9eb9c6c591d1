"""Gauss-Newton steps on the simulation error."""

import numpy as np

from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.refinement import refine_simulation
from lpvlearn.subspace.simulation_error.simulation_fit import simulation_fit
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes
from .conftest import example, experiment, freedom, identify


def test_refinement_is_efficient_where_the_subspace_step_is_not():
    """A pole much slower than the horizon, as on the arm."""
    A = modes(0.998, 0.95 * np.exp(0.05j))
    gains = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        system = (A, np.eye(3), np.ones((1, 3)), np.zeros((1, 3)))
        u, y = experiment(rng, system, 2000, noise=0.05)
        truth = lti_response(*system, u)
        errors = [
            np.linalg.norm(
                lti_response(*identify([(u, y)], 3, 15, refine=r)[:4], u) - truth
            )
            for r in (True, False)
        ]
        gains.append(errors[0] / errors[1])
    assert np.median(gains) < 0.9


def test_refinement_stops_at_a_stationary_point_of_the_simulation_error(rng):
    system = example(rng, modes(0.9 * np.exp(0.5j), 0.8), 1, 1)
    u, y = experiment(rng, system, 200, noise=0.2)
    records = [Record(u.T.copy(), y.T.copy())]
    free = freedom(1, 1)
    start = simulation_fit(system[0], system[2], records, free)
    model = refine_simulation(start, records, free)
    assert model.loss < start.loss

    def loss(A, C):
        return simulation_fit(A, C, records, free).loss

    for _ in range(10):
        dA, dC = rng.standard_normal(model.A.shape), rng.standard_normal((1, 3))
        h = 1e-5
        slope = loss(model.A + h * dA, model.C + h * dC) - loss(
            model.A - h * dA, model.C - h * dC
        )
        start_slope = loss(start.A + h * dA, start.C + h * dC) - loss(
            start.A - h * dA, start.C - h * dC
        )
        assert abs(slope) < max(0.1 * abs(start_slope), 1e-4 * model.loss)


def test_steps_go_on_along_the_valley_of_lags_that_are_hardly_told_apart():
    """From a pole that no lag has to the minimum near the true model."""
    poles = [0.58, 0.85, 0.936, 0.956]
    C, free = np.eye(1, 4, 3), freedom(1, 1)
    lags = np.diag(poles) + np.diag(1.0 - np.array(poles[1:]), -1)
    system = lags, (1.0 - poles[0]) * np.eye(4, 1), C, np.zeros((1, 1))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = rng.choice([-1.0, 1.0], (200, 1)).repeat(4, axis=0)
        u = u + 0.5 * rng.standard_normal(u.shape)
        y = lti_response(*system, u)
        y = y / y.std() + 0.01 * rng.standard_normal(y.shape)
        records = [Record(u.T.copy(), y.T.copy())]
        starts = (lags, C), (modes(-0.5, 0.87, 0.93, 0.958), np.ones((1, 4)))
        near, far = (
            refine_simulation(
                simulation_fit(*start, records, free), records, free, patient=True
            )
            for start in starts
        )
        assert far.loss < 1.001 * near.loss


def test_a_valley_is_followed_with_the_damping_that_it_needs():
    """Of two close pairs of poles; from lags, which must meet to become such pairs."""
    A, free = modes(0.70 + 0.045j, 0.85 + 0.046j), freedom(2, 2)
    starts = modes(0.55, 0.92, 0.843 + 0.0487j), modes(0.3, 0.5, 0.9, 0.95)
    for seed, used in ((0, starts), (5, starts[:1])):
        rng = np.random.default_rng(seed)
        B, C = rng.standard_normal((4, 2)), rng.standard_normal((2, 4))
        system = A, B, C, np.zeros((2, 2))
        u = rng.standard_normal((3000, 2))
        y = lti_response(*system, u)
        y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
        records = [Record(u.T.copy(), y.T.copy())]
        near, *far = (
            refine_simulation(
                simulation_fit(*start, records, free), records, free, patient=True
            )
            for start in (
                (A, C),
                *((A0, rng.standard_normal((2, 4))) for A0 in used),
            )
        )
        for model in far:
            assert model.loss < (1.0 + 1e-4) * near.loss
