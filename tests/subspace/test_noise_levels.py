"""Experiments of unequal noise count by their own, of linear systems."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from lpvlearn import StateSpace, SubspaceLTI

from ..conftest import modes

SYSTEM = StateSpace(
    modes(0.97 * np.exp(0.3j), 0.9), [[1.0], [0.5], [0.3]], [[0.2, 0.3, 0.5]], None, 1.0
)


def _tables(seed, noises, sizes, bend=lambda y: y):
    rng = np.random.default_rng(seed)
    X, y = [], []
    for run, (noise, size) in enumerate(zip(noises, sizes, strict=True)):
        u = size * np.repeat(rng.choice([-1.0, 1.0], 150), 4)[:, None]
        answer = bend(SYSTEM.simulate(u))
        answer += noise * rng.standard_normal(u.shape) + 3.0 * run
        X.append(pd.DataFrame({"u": u[:, 0], "run": run}))
        y.append(pd.DataFrame(answer, columns=["y"]))
    return pd.concat(X, ignore_index=True), pd.concat(y, ignore_index=True)


def _error(model):
    u = np.repeat(np.random.default_rng(99).choice([-1.0, 1.0], 200), 4)[:, None]
    exact = SYSTEM.simulate(u)
    return np.linalg.norm(model.lti_.simulate(u) - exact) / np.linalg.norm(exact)


def test_collinear_inputs_and_a_short_experiment_are_no_obstacle():
    X, y = _tables(1, [0.05, 2.0, 0.05], [1, 1, 1])
    X, y = X[:1230].assign(v=-2.0 * X["u"]), y[:1230]
    with pytest.warns(UserWarning, match="collinear"):
        model = SubspaceLTI(3, method="po-moesp", experiment="run").fit(X, y)
    u = np.repeat(np.random.default_rng(9).choice([-1.0, 1.0], 200), 4)[:, None]
    exact = SYSTEM.simulate(u)
    error = model.lti_.simulate(np.hstack([u, -2.0 * u])) - exact
    assert np.linalg.norm(error) < 5e-3 * np.linalg.norm(exact)


@pytest.mark.broad
@pytest.mark.parametrize("noises, sizes", [([0.05, 2.0], [1, 1]), ([0.1, 2], [1, 20])])
def test_a_noisy_experiment_spoils_nothing(noises, sizes):
    """A scaled experiment is one of a linear system as well: the model is the same."""
    X, y = _tables(0, noises, sizes)
    model = SubspaceLTI(3, experiment="run").fit(X, y)
    scale = 1.0 / np.array(noises)[X["run"]]
    by_hand = SubspaceLTI(3, experiment="run")
    by_hand.fit(X.assign(u=X["u"] * scale), y.mul(scale, axis=0))
    assert _error(model) < 1.2 * _error(by_hand)
    omega = np.linspace(0.01, 3.0, 50)
    assert_allclose(
        model.lti_.frequency_response(omega),
        by_hand.lti_.frequency_response(omega),
        atol=1e-3 * np.abs(SYSTEM.frequency_response(omega)).max(),
    )
    offset = np.diff(by_hand.output_offset_[:, 0] * noises)
    assert_allclose(model.poles_std_, by_hand.poles_std_, rtol=0.1)
    assert_allclose(np.diff(model.output_offset_[:, 0]), offset, atol=0.5)
    for run, noise in enumerate(noises):  # the states are those of the samples
        rows = (X["run"] == run).to_numpy()
        moved = X["u"].to_numpy()[rows, None] - model.input_offset_[run]
        begun = model.lti_.simulate(moved, initial_state=model.initial_states_[run])
        left = y.to_numpy()[rows] - begun - model.output_offset_[run]
        assert np.sqrt(np.mean(left**2)) < 1.2 * noise


def test_errors_of_a_bend_are_no_noise():
    """The model is that of both motions, not that of the small one."""
    X, y = _tables(0, [0.02, 0.02], [0.5, 2.0], lambda y: 3.0 * np.tanh(y / 3.0))
    with pytest.warns(UserWarning, match="squares or cubes"):
        model = SubspaceLTI(3, method="po-moesp", experiment="run").fit(X, y)
    large = (X["run"] == 1).to_numpy()
    y = y[large]
    error = model.predict_with_initial_state(X[large], y) - y.to_numpy()
    assert np.linalg.norm(error) < 0.4 * np.linalg.norm(y - y.mean())
