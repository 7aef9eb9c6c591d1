"""States beside others, for what a model leaves of the outputs."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.orders.further_states import FurtherStates
from lpvlearn.subspace.orders.identification import Settings
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.simulation_fit import Freedom, simulation_fit


def test_what_one_pole_of_the_grid_leaves_out_is_found_exactly():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 2))
    settings = Settings(Freedom(np.zeros((2, 2), bool), initial_states=False))
    further = FurtherStates([Record.of(u, u)], settings)
    pole = further._poles[4]
    B, C = rng.standard_normal((2, 2)), rng.standard_normal((2, 2))
    y = StateSpace(np.diag([0.2, pole]), B, C, np.zeros((2, 2)), 1.0).simulate(u)
    records = [Record.of(u, y)]
    below = simulation_fit(np.diag([0.2]), C[:, :1], records, settings.free)
    first, second = FurtherStates(records, settings).beside(below)
    assert first.loss <= second.loss < below.loss
    assert np.isclose(np.linalg.eigvals(first.A), pole).any()
    # The first output's share of `below` is not yet that of the plant, which refinement
    # is for: of exactly that model all is explained.
    exact = below._replace(B=B[:1])
    assert FurtherStates(records, settings).beside(exact)[0].loss < 1e-18 * np.sum(y**2)


def of_steps(seed, gains, constants, noise=0.02):
    """Each input steps up in one experiment, and down in another."""
    rng = np.random.default_rng(seed)
    gains, constants = np.array(gains), np.array(constants)
    ny, m = gains.shape
    A = np.exp(-1.0 / constants.ravel())
    B = np.tile(np.eye(m), (ny, 1)) * (gains.ravel() * (1.0 - A))[:, None]
    plant = StateSpace(np.diag(A), B, np.kron(np.eye(ny), np.ones((1, m))), None, 1.0)
    inputs = []
    for k in range(2 * m):
        u = np.zeros((200, m))
        u[20:, k % m] = 1.0 if k < m else -1.0
        inputs.append(u)
    y = np.vstack([plant.simulate(u) for u in inputs])
    X = pd.DataFrame(np.vstack(inputs)).add_prefix("u")
    X["test"] = np.repeat(np.arange(2 * m), 200)
    return plant, X, y + noise * rng.standard_normal(y.shape)


@pytest.mark.slow
def test_step_tests_show_the_states_of_their_plant():
    gains, constants = [[2.0, 1.0], [-0.5, 1.5]], [[30.0, 8.0], [20.0, 50.0]]
    plant, X, y = of_steps(9, gains, constants)
    model = SubspaceLTI(experiment="test").fit(X, y)
    omega = np.geomspace(1e-3, 0.3, 20)
    found, true = (m.frequency_response(omega) for m in (model.lti_, plant))
    assert model.order_ == 4
    assert np.abs(found - true).max() < 0.015 * np.abs(true).max()
