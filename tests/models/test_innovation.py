"""Prediction from past outputs, some of which are missing."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn.models.innovation import InnovationModel, NoiseModel

from ..conftest import stable_model


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
