"""Recursions without a loop per sample, and initial states."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn.systems import simulation
from lpvlearn.systems.simulation import lti_response, state_trajectory


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


@pytest.mark.parametrize("n_runs", [1, 11, 12, 40])
def test_many_runs_share_the_matrices_of_all_samples(n_runs):
    rng = np.random.default_rng(5)
    A = np.array([stable(rng, 3) for _ in range(70)])
    f, x0 = rng.normal(size=(70, 3, n_runs)), rng.normal(size=(3, n_runs))
    x = state_trajectory(A, f, x0)
    assert_array_equal(x[0], x0)
    assert_allclose(x[1:], A[:-1] @ x[:-1] + f[:-1], atol=1e-12)


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
