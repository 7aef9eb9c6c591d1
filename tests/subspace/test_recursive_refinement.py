"""Gauss-Newton steps on a stream: local coordinates around a pilot model."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from lpvlearn import StateSpace
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.simulation_fit import simulation_fit
from lpvlearn.subspace.streams.recursive_refinement import (
    _aligned_pair,
    input_matrices,
    start_recursion,
)

from .conftest import freedom, record

OMEGA = np.linspace(0.05, 3.0, 40)


def test_a_pair_is_brought_to_the_blocks_of_another_model(system):
    u, y = record(system, 400, noise=0.0)
    free = freedom(2, 2)
    pilot = simulation_fit(system[0], system[2], [Record(u.T, y.T)], free)
    T = np.random.default_rng(1).standard_normal((5, 5))
    A = system[0] + 0.01 * np.random.default_rng(2).standard_normal((5, 5))
    A, C = np.linalg.solve(T, A @ T), 1.02 * system[2] @ T
    blocks, C_aligned = _aligned_pair(A, C, pilot)
    assert [b.shape for b in blocks] == [b.shape for b in pilot.blocks]
    aligned = block_diag(*blocks)

    def seen(A, C):
        return np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(8)])

    # The same subspace of observable signals, with nothing left over.
    back = np.linalg.lstsq(seen(A, C), seen(aligned, C_aligned))[0]
    np.testing.assert_allclose(seen(A, C) @ back, seen(aligned, C_aligned), atol=1e-9)
    np.testing.assert_allclose(A @ back, back @ aligned, atol=1e-9)
    assert np.abs(aligned - pilot.A).max() < 0.1


def test_input_matrices_of_a_given_pair_solve_the_linearised_problem(system):
    """With the pilot's own A and C it is the simulation least squares."""
    u, y = record(system, 3000)
    records, free = [Record(u.T, y.T)], freedom(2, 2)
    pilot = simulation_fit(system[0], system[2], records, free)
    recursion = start_recursion(pilot, records, free)
    T = np.random.default_rng(1).standard_normal((5, 5))
    A, C = np.linalg.solve(T, system[0] @ T), system[2] @ T
    found = input_matrices(recursion, A, C)
    G = StateSpace(*found[:4], 1.0).frequency_response(OMEGA)
    whole = StateSpace(*pilot[:4], 1.0).frequency_response(OMEGA)
    np.testing.assert_allclose(G, whole, atol=1e-8)
    assert found.loss == pytest.approx(pilot.loss, rel=1e-9)
