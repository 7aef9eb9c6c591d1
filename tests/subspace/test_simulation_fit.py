"""B, D and initial states by least squares on the simulation error."""

import numpy as np

from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.signals import block_sections, signal_factor
from lpvlearn.subspace.simulation_error.simulation_fit import (
    _general_regression,
    _solve_regressions,
    linear_regression,
    simulation_fit,
)
from lpvlearn.systems.simulation import (
    estimate_initial_state,
    free_responses,
    lti_response,
)

from ..conftest import modes
from .conftest import POLES, example, experiment, freedom


def test_both_regressions_give_the_same_B_D_and_initial_state(rng):
    system = example(rng, modes(*POLES))
    A, _, C, _ = system
    u, y = experiment(rng, system, 100, rng.standard_normal(6), noise=0.1)
    record = Record(u.T.copy(), y.T.copy())
    sections = block_sections(A)
    T = sections.transform
    free, blocks = freedom(2, 2), sections.blocks
    R = signal_factor(blocks, record)
    fast, slow = (
        _solve_regressions([(np.zeros(1, int), M[None])], 6)
        for M in (
            linear_regression(R, blocks, C @ T, free),
            _general_regression(A, C, record, free),
        )
    )
    np.testing.assert_allclose(T @ fast[1][0], slow[1][0], atol=1e-9)
    np.testing.assert_allclose(
        T @ fast[0][:12].reshape(6, 2), slow[0][:12].reshape(6, 2), atol=1e-9
    )
    np.testing.assert_allclose(fast[0][12:], slow[0][12:], atol=1e-9)
    np.testing.assert_allclose(fast[2], slow[2], rtol=1e-9)


def test_simulation_least_squares_loss_is_the_simulation_error(rng):
    system = example(rng, modes(*POLES))
    runs = [experiment(rng, system, n, noise=0.2) for n in (100, 140)]
    records = [Record(u.T.copy(), y.T.copy()) for u, y in runs]
    model = simulation_fit(system[0], system[2], records, freedom(2, 2))
    error = sum(
        ((y - lti_response(*model[:4], u, x0)) ** 2).sum()
        for (u, y), x0 in zip(runs, model.initial_states, strict=True)
    )
    np.testing.assert_allclose(model.loss, error, rtol=1e-9)


def test_overflowing_simulation_has_infinite_loss(rng):
    record = Record(rng.standard_normal((1, 3000)), rng.standard_normal((1, 3000)))
    model = simulation_fit(np.array([[2.0]]), np.ones((1, 1)), [record], freedom(1, 1))
    assert np.isinf(model.loss)


def test_initial_state_of_a_free_response_is_exact(rng):
    A, B, C, D = example(rng, modes(*POLES))
    x0 = rng.standard_normal(6)
    free = lti_response(A, B, C, D, np.zeros((50, 2)), x0)
    found = estimate_initial_state(free_responses(A, C, 50), free)
    np.testing.assert_allclose(found, x0, atol=1e-9)
