"""Least maxima of linear errors."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import linprog, minimize

from lpvlearn.restructuring.least_squares import least_maximum


@pytest.mark.parametrize("seed", range(4))
def test_the_least_maximum_is_that_of_a_linear_program(seed):
    rng = np.random.default_rng(seed)
    E, J = rng.normal(size=30), rng.normal(size=(30, 4))
    rows = np.vstack([J, -J])
    A = np.column_stack([rows, -np.ones(60)])
    exact = linprog(np.eye(5)[4], A, np.r_[-E, E], bounds=(None, None)).fun
    d = least_maximum(E[:, None, None] + 0j, J[:, None, None] + 0j)
    assert exact <= np.abs(E + J @ d).max() <= 1.05 * exact


def test_it_is_that_of_singular_values():
    rng = np.random.default_rng(0)
    E = rng.normal(size=(12, 3, 2)) + 1j * rng.normal(size=(12, 3, 2))
    J = rng.normal(size=(12, 3, 2, 3)) + 1j * rng.normal(size=(12, 3, 2, 3))

    def norm(d):
        return np.linalg.norm(E + J @ d, 2, axis=(1, 2)).max()

    d = least_maximum(E, J)
    found = minimize(norm, d, method="Nelder-Mead", options={"xatol": 1e-8})
    assert norm(d) <= 1.05 * found.fun
    assert_allclose(least_maximum(1e-9 * E, J), 1e-9 * d, rtol=1e-6)


def test_nothing_is_left_where_nothing_is_there():
    J = np.ones((3, 2, 1, 2), complex)
    assert not least_maximum(np.zeros((3, 2, 1), complex), J).any()
