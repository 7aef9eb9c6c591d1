"""A system of three modes, and records of it."""

import numpy as np
import pytest

from lpvlearn.systems.simulation import lti_response

from ..conftest import modes


@pytest.fixture(scope="session")
def system():
    """A, B, C and D of order 5, two inputs, two outputs."""
    rng = np.random.default_rng(5)
    A = modes(0.95 * np.exp(0.5j), 0.9 * np.exp(1.4j), 0.8)
    shapes = (5, 2), (2, 5), (2, 2)
    return (A, *(rng.standard_normal(s) for s in shapes))


def record(system, n_samples, seed=0, noise=0.1):
    """Inputs and noisy outputs of a system from rest."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, system[1].shape[1]))
    y = lti_response(*system, u)
    return u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
