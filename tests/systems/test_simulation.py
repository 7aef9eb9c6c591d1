"""Recursions and matrix exponentials without a loop per sample."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from lpvlearn.systems import simulation
from lpvlearn.systems.simulation import (
    expm_batch,
    lti_response,
    sample_zoh,
    state_trajectory,
    tabulate,
)


def loop(A, f, x0):
    """The recursion, sample by sample."""
    states, x = [], x0
    for k in range(len(f)):
        states.append(x)
        x = (A[k] if A.ndim == 3 else A) @ x + f[k]
    return np.array(states)


def stable(rng, n, *lead):
    A = rng.normal(size=(*lead, n, n))
    return A / (1.05 * np.abs(np.linalg.eigvals(A)).max(initial=0.1))


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(0, 5),
    n_samples=st.integers(0, 40),
    varying=st.booleans(),
    n_runs=st.sampled_from([None, 1, 3]),
    chunk=st.sampled_from([1, 60, 200, 10**6]),
)
def test_trajectory_is_the_loop(seed, n, n_samples, varying, n_runs, chunk):
    rng = np.random.default_rng(seed)
    A = stable(rng, n, n_samples) if varying and n_samples and n else stable(rng, n)
    tail = () if n_runs is None else (n_runs,)
    f, x0 = rng.normal(size=(n_samples, n, *tail)), rng.normal(size=(n, *tail))
    whole = simulation._CHUNK_ENTRIES
    try:  # short chunks, so that trajectories cross many of them
        simulation._CHUNK_ENTRIES = chunk
        x = state_trajectory(A, f, x0)
        rest = state_trajectory(A, f)
    finally:
        simulation._CHUNK_ENTRIES = whole
    assert x.shape == rest.shape == f.shape
    if n_samples:
        assert_allclose(x, loop(A, f, x0), atol=1e-11)
        assert_allclose(rest, loop(A, f, np.zeros_like(x0)), atol=1e-11)


def test_more_samples_than_one_chunk_holds():
    rng = np.random.default_rng(0)
    n, n_samples = 6, 80_000
    assert 2 * n * n * n_samples > 2 * simulation._CHUNK_ENTRIES
    A, f = stable(rng, n), rng.normal(size=(n_samples, n))
    x = state_trajectory(A, f, np.ones(n))
    # the recursion itself, at every sample
    assert_allclose(x[1:], x[:-1] @ A.T + f[:-1], atol=1e-11 * np.abs(x).max())
    assert_array_equal(x[0], np.ones(n))


def test_lti_response_is_the_loop():
    rng = np.random.default_rng(1)
    A, B = stable(rng, 4), rng.normal(size=(4, 2))
    C, D = rng.normal(size=(3, 4)), rng.normal(size=(3, 2))
    u, x0 = rng.normal(size=(300, 2)), rng.normal(size=4)
    y = lti_response(A, B, C, D, u, x0)
    assert_allclose(y, loop(A, u @ B.T, x0) @ C.T + u @ D.T, atol=1e-11)


def test_unstable_response_is_the_loop():
    rng = np.random.default_rng(2)
    A = 1.5 * stable(rng, 3)
    f = rng.normal(size=(100, 3))
    x, expected = state_trajectory(A, f), loop(A, f, np.zeros(3))
    assert np.abs(expected).max() > 1e10
    size = np.linalg.norm(expected, axis=1, keepdims=True)
    assert (np.linalg.norm(x - expected, axis=1)[1:] <= 1e-11 * size[1:, 0]).all()


def test_time_reversal_returns_to_the_start():
    rng = np.random.default_rng(3)
    A = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    f, x0 = rng.normal(size=(200, 4)), rng.normal(size=4)
    x = state_trajectory(A, f, x0)
    # z[j] = x[N - 1 - j] follows z[j + 1] = A^-1 (z[j] - f[N - 2 - j])
    back = state_trajectory(A.T, -f[-2::-1] @ A, x[-1])
    assert_allclose(back, x[:0:-1], atol=1e-11)


def test_no_states_give_the_feedthrough():
    u, D = np.arange(6.0).reshape(3, 2), np.array([[1.0, 2.0]])
    y = lti_response(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), D, u)
    assert_array_equal(y, u @ D.T)


# -- exponentials ----------------------------------------------------------------


def normwise(found, expected):
    return np.abs(found - expected).max() / max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-3, 0.2, 0.3, 1.0, 10.0, 60.0])
def test_exponentials_are_those_of_scipy(size):
    M = size * np.random.default_rng(0).normal(size=(20, 5, 5))
    expected = np.array([expm(m) for m in M])
    for found, other in zip(expm_batch(M), expected, strict=True):
        assert normwise(found, other) <= 1e-13 * max(1.0, 10 * size)


def test_exponentials_in_one_batch_may_differ_in_size():
    rng = np.random.default_rng(1)
    M = rng.normal(size=(9, 4, 4)) * np.logspace(-6, 1, 9)[:, None, None]
    single = np.array([expm_batch(m) for m in M])
    assert_allclose(expm_batch(M), single, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("fast", [1e3, 1e6, 1e9])
def test_slow_modes_keep_their_digits_beside_fast_ones(fast):
    slow = np.array([-1e-3, -0.5, 0.2])
    V = np.array([[1.0, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 0, 1]])
    M = V @ np.diag([*slow, -fast]) @ np.linalg.inv(V)
    expected = V @ np.diag([*np.exp(slow), 0.0]) @ np.linalg.inv(V)
    assert_allclose(expm_batch(M), expected, atol=2e-13)


def test_semigroup_property():
    M = np.random.default_rng(2).normal(size=(4, 4))
    assert_allclose(expm_batch(M) @ expm_batch(-M), np.eye(4), atol=1e-12)
    assert_allclose(expm_batch(2 * M), expm_batch(M) @ expm_batch(M), rtol=1e-11)


def test_empty_batches_have_empty_exponentials():
    assert expm_batch(np.zeros((0, 3, 3))).shape == (0, 3, 3)
    assert expm_batch(np.zeros((2, 0, 0))).shape == (2, 0, 0)


def test_zoh_of_a_stack_is_the_integral():
    rng = np.random.default_rng(3)
    A, B, dt = rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3, 2)), 0.3
    Ad, Bd = sample_zoh(A, B, dt)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for k in range(7):
        assert_allclose(Ad[k], expm(A[k] * dt), atol=1e-13)
        times = 0.5 * dt * (nodes + 1)
        held = sum(
            0.5 * dt * w * expm(A[k] * t) for w, t in zip(weights, times, strict=True)
        )
        assert_allclose(Bd[k], held @ B[k], atol=1e-13)


def test_overflow_is_told():
    with pytest.raises(ValueError, match="unstable pole.*1e\\+06 rad/s.*Shorten"):
        sample_zoh(np.array([[1e6]]), np.ones((1, 1)), 1.0)


# -- tables ----------------------------------------------------------------------


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
    return expm_batch(A)


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
