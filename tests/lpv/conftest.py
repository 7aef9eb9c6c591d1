"""LPV models of any form that several rooms test with."""

import numpy as np
from numpy.testing import assert_allclose
from sklearn.base import clone

from lpvlearn import GrayBoxStructure, LPVStateSpace


def lpv_model(form, n_scheduling):
    """A random model of order 3, entries of sizes 1e-3 to 1e3, and some places."""
    rng = np.random.default_rng(n_scheduling)
    structure = GrayBoxStructure.full(3, 2, 2)
    kappa = rng.uniform(0, 1, size=(40, n_scheduling)) * 3.0 ** np.arange(n_scheduling)
    theta = rng.normal(size=(40, structure.n_params))
    theta *= 10.0 ** rng.uniform(-3, 3, structure.n_params)
    fitted = clone(form).fit(kappa, theta)
    lpv = LPVStateSpace(structure, fitted, [kappa.min(axis=0), kappa.max(axis=0)])
    return lpv, kappa[:4]


def assert_same_matrices(found, expected, rtol):
    """Equal but for rounding, entries relative to the largest of their matrix."""
    for name in "ABCD":
        M = getattr(expected, name)
        atol = rtol * np.abs(M).max(initial=0.0) + (rtol > 0) * 1e-15
        assert_allclose(getattr(found, name), M, rtol=0, atol=atol)
