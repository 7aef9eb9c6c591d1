"""Chebyshev tables of functions along a trajectory."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn.systems.sampling import sample_zoh
from lpvlearn.systems.tabulation import tabulate


class Counted:
    """A function that counts the points it was asked for."""

    def __init__(self, f):
        self.f, self.points = f, 0

    def __call__(self, x):
        self.points += len(x)
        return self.f(x)


def matrices(x):
    A = np.array([[0.0, 1.0], [-4.0, -0.3]]) + np.multiply.outer(
        x, np.array([[0.0, 0.0], [-3.0, 0.1]])
    )
    return sample_zoh(A, np.ones((len(x), 2, 1)), 1.0)[0]


@pytest.mark.parametrize(
    "f",
    [
        np.sin,
        matrices,
        lambda x: np.ones_like(x),
        lambda x: np.zeros((len(x), 2, 3)),
        lambda x: x[:, None] ** np.arange(6),
        lambda x: np.exp(3 * x)[:, None, None] * np.array([[1.0, 1e-9], [1e9, 1.0]]),
    ],
)
@pytest.mark.parametrize("noisy", [False, True])
def test_table_is_the_function_to_1e_12(f, noisy):
    x = np.linspace(-1.0, 2.0, 3000)
    if noisy:
        x = x + 0.2 * np.random.default_rng(0).normal(size=len(x))
    counted = Counted(f)
    found, expected = tabulate(counted, x), f(x)
    assert found.shape == expected.shape
    scale = np.abs(expected).max(0)
    assert (np.abs(found - expected) <= 1e-12 * scale).all()
    assert counted.points < len(x) // 10


def test_constant_trajectory_needs_one_point():
    counted, x = Counted(matrices), np.full(500, 0.7)
    assert_array_equal(tabulate(counted, x), matrices(x))
    assert counted.points == 1


@pytest.mark.parametrize(
    "f",
    [
        np.abs,
        np.sign,
        lambda x: np.clip(x, -0.995, 0.995),  # a kink beside the ends
        lambda x: np.round(3 * x),
        lambda x: np.where((x > 0.305) & (x < 0.345), 1.0, 0.0),  # between nodes
        lambda x: np.sin(200 * x),
        lambda x: np.stack([x, 1e-3 * np.abs(x - 0.1)], 1)[:, :, None],
    ],
)
def test_functions_that_are_not_smooth_are_evaluated_themselves(f):
    x = np.linspace(-1.0, 1.0, 2001)
    assert_allclose(tabulate(f, x), f(x), atol=1e-12)


@pytest.mark.parametrize("units", [1.0, 1e8])
def test_rounding_noise_does_not_forbid_a_table(units):
    noise = np.random.default_rng(0)
    scale = np.array([[1.0, units], [1 / units, 1.0]])

    def f(x):
        values = np.stack([np.cos(x), np.sin(x), np.zeros_like(x), x], 1)
        values = values.reshape(-1, 2, 2)
        return scale * (values + 1e-17 * noise.normal(size=values.shape))

    counted = Counted(f)
    tabulate(counted, np.linspace(0, 2, 4000))
    assert counted.points < 400


def test_few_points_are_evaluated_themselves():
    x = np.linspace(0, 1, 20)
    assert_array_equal(tabulate(np.sin, x), np.sin(x))
    assert tabulate(np.sin, np.zeros(0)).shape == (0,)
