"""A horizon that was given is questioned where it ends in a poor model."""

import numpy as np
import pytest

from lpvlearn import SubspaceLTI
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes


@pytest.mark.slow
def test_a_given_horizon_that_ends_in_a_poor_model_warns():
    """A pole a hundred times slower than the horizon, past inputs as instruments."""
    poles = np.exp(1e-3 * np.array([-0.7, -45.0, -3.8 + 52.6j, -46.0 + 121.0j]))
    A = modes(*poles)
    B = np.array([[0.3, 0.2], [20, 12], [2, -3], [1, 2], [9, 6], [-8, 9.0]]) * 1e-3
    C = np.array([[1, 0.6, 1, 0.5, 0.7, 0.4], [-0.8, 1, 0.7, -1, 0.5, -0.6]])
    rng = np.random.default_rng(0)
    u = 0.1 * np.repeat(rng.choice([-1.0, 1.0], (300, 2)), 10, axis=0)
    y = lti_response(A, B, C, np.zeros((2, 2)), u)
    y = y + 0.03 * y.std(axis=0) * rng.standard_normal(y.shape)
    options = {"method": "pi-moesp", "feedthrough": False}
    with pytest.warns(UserWarning, match="ends in a poor model"):
        SubspaceLTI(6, horizon=6, refine=False, **options).fit(u, y)
    SubspaceLTI(6, **options).fit(u, y)  # the automatic one is silent
