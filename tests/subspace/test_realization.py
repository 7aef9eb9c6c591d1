"""State matrices from subspaces."""

import numpy as np
import pytest
from scipy import linalg

from lpvlearn.subspace.orders.realization import (
    observability_subspace,
    reflect_unstable,
    shift_invariant_pair,
)
from lpvlearn.subspace.samples.hankel import data_factors

from ..conftest import modes
from .conftest import POLES, example, experiment, sorted_poles


def test_result_does_not_depend_on_the_basis_of_the_subspace(rng):
    system = example(rng, modes(*POLES))
    observability = np.vstack(
        [system[2] @ np.linalg.matrix_power(system[0], k) for k in range(8)]
    )
    observability = observability + 0.01 * rng.standard_normal(observability.shape)
    A, C = shift_invariant_pair(observability, 2, 6)
    T = rng.standard_normal((6, 6))
    A2, C2 = shift_invariant_pair(observability @ T, 2, 6)
    np.testing.assert_allclose(T @ A2, A @ T, atol=1e-9)
    np.testing.assert_allclose(C2, C @ T, atol=1e-12)


def test_reflection_inverts_unstable_poles_and_keeps_the_others(rng):
    T = rng.standard_normal((5, 5))
    A = T @ modes(1.2 * np.exp(0.7j), 0.5, -1.25, 0.9) @ np.linalg.inv(T)
    expected = modes(np.exp(0.7j) / 1.2, 0.5, -0.8, 0.9)
    np.testing.assert_allclose(
        sorted_poles(reflect_unstable(A)), sorted_poles(expected), atol=1e-9
    )


@pytest.mark.parametrize("method", ["po-moesp", "pi-moesp"])
def test_weights_of_outputs_need_no_samples(rng, method):
    u, y = experiment(rng, example(rng, modes(*POLES)), noise=0.1)
    weight, past_outputs = rng.standard_normal((2, 2)), method == "po-moesp"

    def space(y):
        z = np.hstack([u, y])
        (factor,) = data_factors([z], 2, [6], past_outputs=past_outputs)
        return observability_subspace(factor, 2, 2, 6, 5, method)

    found, expected = space(y).weighted(weight), space(y @ weight.T)
    np.testing.assert_allclose(found.singular_values, expected.singular_values)
    assert linalg.subspace_angles(found.basis, expected.basis).max() < 1e-9
