"""Prediction by the innovation form, with a joint gain and with missing outputs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import InnovationModel, StateSpace
from lpvlearn.models import NoiseModel
from lpvlearn.systems.simulation import trend_signals

from ..conftest import stable_model

A = np.array([[1.05, 0.3], [0.0, 0.6]])
LTI = StateSpace(A, [[1.0], [0.5]], [[0.5, 0.2]], [[0.3]], 1.0)
NOISE = NoiseModel(
    np.array([[0.9]]), np.array([[0.4]]), np.array([[0.5]]), np.array([[2.0]])
)
GAIN = np.array([[1.0], [0.1]])


def simulated(model, n_samples, x0, seed=0):
    """Inputs, outputs, innovations and states, sample by sample."""
    rng = np.random.default_rng(seed)
    u, e = rng.standard_normal((2, n_samples, 1))
    x, y, states = np.array(x0, dtype=float), np.zeros((n_samples, 1)), []
    for t in range(n_samples):
        states.append(x)
        y[t] = model.C @ x + model.D @ u[t] + e[t]
        x = model.A @ x + model.B @ u[t] + model.K @ e[t]
    return u, y, e, np.array(states)


@pytest.fixture
def joint():
    model = InnovationModel(LTI, NOISE, GAIN)
    inner = model.A - model.K @ model.C
    assert (
        np.abs(np.linalg.eigvals(inner)).max() < 1.0
    )  # where that of the plant is not
    return model


def test_one_step_errors_are_the_innovations(joint):
    x0 = [1.0, -2.0, 0.5]
    u, y, e, _ = simulated(joint, 400, x0)
    assert_allclose(y - joint.predict(u, y, initial_state=x0), e, atol=1e-7)
    assert_allclose(joint.estimate_initial_state(u[:30], y[:30]), x0, atol=8.0)
    far = y - joint.predict(u, y)  # from rest: what the start does dies out
    assert_allclose(far[300:], e[300:], atol=1e-6)


def test_an_initial_state_is_found_where_there_is_no_noise(joint):
    x0 = np.array([1.0, -2.0, 0.5])
    u = np.random.default_rng(0).standard_normal((40, 1))
    whole = StateSpace(joint.A, joint.B, joint.C, joint.D, 1.0)
    y = whole.simulate(u, initial_state=x0)
    assert_allclose(joint.estimate_initial_state(u, y), x0, atol=1e-8)
    plant = LTI.simulate(u, initial_state=x0[:2])
    assert_allclose(joint.predict(u, plant, initial_state=x0[:2]), plant, atol=1e-8)


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_later_steps_are_the_model_without_later_outputs(joint, steps):
    x0 = np.zeros(3)
    u, y, _, states = simulated(joint, 60, x0)
    found = joint.predict(u, y, steps=steps)
    for t in range(steps, 60):
        x = states[t - steps + 1]  # known from the outputs up to t - steps
        for k in range(t - steps + 1, t):
            x = joint.A @ x + joint.B @ u[k]
        assert_allclose(found[t], joint.C @ x + joint.D @ u[t], atol=1e-7)
    # Rows before know no output: a simulation from the initial state.
    first = LTI.simulate(u[:steps])
    assert_allclose(found[: steps - 1], first[: steps - 1], atol=1e-9)


def test_missing_outputs_correct_nothing(joint):
    u, y, _, states = simulated(joint, 60, np.zeros(3))
    lost = y.copy()
    lost[30:33] = np.nan
    found = joint.predict(u, lost)
    assert_allclose(found[:31], joint.predict(u, y)[:31], atol=1e-9)
    for row, steps in ((31, 2), (32, 3), (33, 4)):
        ahead = joint.predict(u, y, steps=steps)
        assert_allclose(found[row], ahead[row], atol=1e-9)
    nothing = joint.predict(u, np.full_like(y, np.nan))
    assert_allclose(nothing, LTI.simulate(u), atol=1e-8)


def test_a_missing_output_is_expected_from_the_other():
    rng = np.random.default_rng(0)
    lti = stable_model(rng, 3, 1, 2, sampling_time=1.0)
    noise = NoiseModel.white(np.array([[1.0, 2.0], [2.0, 4.0]]))
    model = InnovationModel(lti, noise, 0.1 * rng.standard_normal((3, 2)))
    u, e = rng.standard_normal((2, 60, 1))
    e, x, y = e * [1.0, 2.0], np.zeros(3), np.zeros((60, 2))
    for t in range(60):
        y[t] = model.C @ x + model.D @ u[t] + e[t]
        x = model.A @ x + model.B @ u[t] + model.K @ e[t]
    lost = y.copy()
    lost[10:40, 1] = np.nan
    assert_allclose(y - model.predict(u, lost), e, atol=1e-9)


def test_trends_are_found_beside_the_initial_state(joint):
    x0, level = np.array([1.0, -2.0, 0.5]), np.array([3.0, -1.0])
    u = np.random.default_rng(0).standard_normal((40, 1))
    trend = trend_signals(40, 2)
    whole = StateSpace(joint.A, joint.B, joint.C, joint.D, 1.0)
    y = whole.simulate(u, initial_state=x0) + (trend.T @ level)[:, None]
    y[5:9] = np.nan
    own = joint.estimate_initial_state(u, y, trend)
    assert_allclose(own, [*x0, *level], atol=1e-7)


def test_a_gain_of_zero_is_none():
    stable = StateSpace(0.5 * A, LTI.B, LTI.C, LTI.D, 1.0)
    plain, zero = (InnovationModel(stable, NOISE, g) for g in (None, np.zeros((2, 1))))
    u, y, *_ = simulated(plain, 50, np.zeros(3))
    assert_allclose(zero.K, plain.K)
    for steps in (1, 3):
        assert_allclose(
            zero.predict(u, y, steps=steps),
            plain.predict(u, y, steps=steps),
            atol=1e-10,
        )
    assert plain.estimate_initial_state(u, y).shape == (2,)


def predictor(covariance, seed=0):
    """Two outputs with three noise states."""
    rng = np.random.default_rng(seed)
    lti = stable_model(rng, 3, 1, 2, sampling_time=1.0)
    noise = stable_model(rng, 3, 2, 2, sampling_time=1.0)
    K = 0.2 * noise.B
    return InnovationModel(lti, NoiseModel(noise.A, noise.C, K, covariance))


@pytest.fixture
def record():
    rng = np.random.default_rng(1)
    return rng.standard_normal((60, 1)), rng.standard_normal((60, 2))


def test_after_missing_samples_prediction_is_that_of_more_steps(record):
    u, y = record
    model = predictor(np.eye(2))
    lost = y.copy()
    lost[30:33] = np.nan
    found = model.predict(u, lost)
    assert_allclose(found[:31], model.predict(u, y)[:31], atol=1e-12)
    for row, steps in ((31, 2), (32, 3), (33, 4)):
        assert_allclose(found[row], model.predict(u, y, steps=steps)[row], atol=1e-12)
    nothing = model.predict(u, np.full_like(y, np.nan))
    assert_allclose(nothing, model.lti.simulate(u), atol=1e-12)


def test_one_missing_output_is_expected_from_the_other(record):
    """Innovations e2 = 2 e1: nothing is lost. Independent ones: that one counts 0."""
    u, _ = record
    model = predictor(np.array([[1.0, 2.0], [2.0, 4.0]]))
    e = np.random.default_rng(2).standard_normal((60, 1)) * [1.0, 2.0]
    state, y = np.zeros(3), model.lti.simulate(u)
    for t in range(60):
        y[t] += model.noise.C @ state + e[t]
        state = model.noise.A @ state + model.noise.K @ e[t]
    lost = y.copy()
    lost[10:40, 1] = np.nan
    assert_allclose(model.predict(u, lost), model.predict(u, y), atol=1e-9)
    assert_allclose(y - model.predict(u, lost), e, atol=1e-9)

    alone = predictor(np.diag([1.0, 4.0]))
    one = alone.noise.K.copy()
    one[:, 1] = 0.0
    same = InnovationModel(alone.lti, alone.noise._replace(K=one))
    lost[:, 1], y[:, 1] = np.nan, 0.0
    assert_allclose(alone.predict(u, lost), same.predict(u, y), atol=1e-12)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"lti": StateSpace(-1, 1, 1)}, "`lti` must be a StateSpace in discrete time"),
        ({"noise": NoiseModel(*np.ones((4, 2, 2)))}, "`noise` must have A .2, 2., C"),
        ({"noise": None}, "`noise` must be a NoiseModel"),
        ({"gain": np.ones((2, 1))}, "`gain` must have shape .1, 1."),
        ({"gain": [["a"]]}, "`gain` must hold real numbers"),
    ],
)
def test_parts_that_do_not_fit_are_told(wrong, words):
    one = np.ones((1, 1))
    parts = {
        "lti": StateSpace(0.5, 1, 1, sampling_time=1.0),
        "noise": NoiseModel(0.5 * one, one, one, one),
    }
    with pytest.raises(ValueError, match=words):
        InnovationModel(**parts | wrong)
