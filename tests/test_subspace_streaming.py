"""partial_fit: the model of a stream is that of one table, in bounded memory."""

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import block_diag
from sklearn.exceptions import NotFittedError

from lpvlearn import subspace_streaming
from lpvlearn.numerics.hankel import data_factor
from lpvlearn.numerics.realization import METHODS
from lpvlearn.numerics.simulation import lti_response
from lpvlearn.numerics.simulationfit import freedom
from lpvlearn.numerics.streaming import (
    extend_hankel_sum,
    factor_input_matrices,
    start_hankel_sum,
)
from lpvlearn.subspace import SubspaceLTI

OMEGA = np.linspace(0.05, 3.0, 40)


def modes(*poles):
    blocks = [
        [[p.real, p.imag], [-p.imag, p.real]] if np.imag(p) else [[np.real(p)]]
        for p in poles
    ]
    return block_diag(*blocks)


@pytest.fixture
def system():
    rng = np.random.default_rng(5)
    A = modes(0.95 * np.exp(0.5j), 0.9 * np.exp(1.4j), 0.8)
    shapes = (5, 2), (2, 5), (2, 2)
    return (A, *(rng.standard_normal(s) for s in shapes))


def record(system, n_samples, seed=0, noise=0.1):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, system[1].shape[1]))
    y = lti_response(*system, u)
    return u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape)


def fed(model, u, y, sizes):
    start = 0
    for size in sizes:
        model.partial_fit(u[start : start + size], y[start : start + size])
        start += size
    assert start == len(u)
    return model


@pytest.fixture
def short_buffer(monkeypatch):
    """Summaries from 1000 samples on, so that tests stay small."""
    monkeypatch.setattr(subspace_streaming, "BUFFER", 1000)


def response(model):
    return model.lti_.frequency_response(OMEGA)


@pytest.mark.parametrize("refine", [True, False])
def test_batches_that_are_still_kept_give_the_model_of_fit(system, refine):
    u, y = record(system, 900)
    options = {"order": 5, "horizon": 8, "refine": refine}
    stream = fed(SubspaceLTI(**options), u, y, [100, 300, 1, 499])
    whole = SubspaceLTI(**options).fit(u, y)
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_subspace_step_of_summaries_is_that_of_the_whole_table(
    system, short_buffer, method
):
    u, y = record(system, 6000)
    options = {"order": 5, "horizon": 8, "method": method, "refine": False}
    stream = fed(SubspaceLTI(**options), u, y, [700, 800, 3, 1497, 3000])
    whole = SubspaceLTI(**options).fit(u, y)
    np.testing.assert_allclose(
        stream.singular_values_, whole.singular_values_, rtol=1e-7
    )
    np.testing.assert_allclose(stream.lti_.poles(), whole.lti_.poles(), atol=1e-9)
    # B and D follow from the summaries, in another way.
    error = np.abs(response(stream) - response(whole)).max()
    assert error < 0.05 * np.abs(response(whole)).max()


def test_refined_stream_agrees_within_a_fraction_of_its_standard_deviation(
    system, short_buffer
):
    u, y = record(system, 40_000)
    options = {"order": 5, "horizon": 8}
    stream = fed(SubspaceLTI(**options), u, y, [10_000] * 4)
    whole = SubspaceLTI(**options).fit(u, y)
    std = np.abs(whole.frequency_response_std(OMEGA))
    gap = np.abs(response(stream) - response(whole))
    assert np.median(gap / std) < 0.1
    np.testing.assert_allclose(stream.residual_, whole.residual_, rtol=1e-3)
    np.testing.assert_allclose(
        np.abs(stream.frequency_response_std(OMEGA)), std, rtol=0.2
    )


def test_noise_free_stream_is_exact(system, short_buffer):
    u, y = record(system, 4000, noise=0.0)
    stream = fed(SubspaceLTI(5, horizon=8), u, y, [1500, 500, 2000])
    truth = np.array(
        [
            system[2]
            @ np.linalg.solve(np.exp(1j * w) * np.eye(5) - system[0], system[1])
            + system[3]
            for w in OMEGA
        ]
    )
    np.testing.assert_allclose(response(stream), truth, atol=1e-7)


def test_experiments_continue_over_batches_by_their_label(system, short_buffer):
    runs = [record(system, n, seed) for seed, n in enumerate((1200, 900, 1400))]
    X = pd.DataFrame(np.vstack([u for u, _ in runs]), columns=["u1", "u2"])
    X["run"] = np.repeat(["a", "b", "c"], [1200, 900, 1400])
    y = np.vstack([y for _, y in runs])
    options = {"order": 5, "horizon": 8, "experiment": "run", "refine": False}
    stream = fed(SubspaceLTI(**options), X, y, [500, 600, 900, 1500])
    whole = SubspaceLTI(**options).fit(X, y)
    np.testing.assert_allclose(stream.lti_.poles(), whole.lti_.poles(), atol=1e-9)
    # Without the labels windows cross the borders, which is another model.
    other = SubspaceLTI(5, horizon=8, refine=False).fit(X[["u1", "u2"]], y)
    assert abs(other.lti_.poles() - whole.lti_.poles()).max() > 1e-7


@pytest.mark.parametrize("noise", [0.1, 0.0])
def test_hankel_sum_is_the_factor_of_the_pooled_experiments(system, noise):
    records = [np.hstack(record(system, n, n, noise)) for n in (300, 250)]
    state = start_hankel_sum([records[0][:100]], 2, 6)
    state = extend_hankel_sum(state, records[0][100:105], starts=False)
    state = extend_hankel_sum(state, records[0][105:], starts=False)
    state = extend_hankel_sum(state, records[1], starts=True)
    whole = data_factor(records, 2, 6)
    assert (state.gram is None) == (noise == 0.0)
    # Factors of singular data agree up to a rotation of their null space.
    np.testing.assert_allclose(
        state.triangular() @ state.triangular().T, whole @ whole.T, atol=1e-8
    )
    if noise:
        np.testing.assert_allclose(state.triangular(), whole, atol=1e-9)


def test_input_matrices_from_the_factor_are_exact_without_noise(system):
    u, y = record(system, 500, noise=0.0)
    factor = data_factor([np.hstack([u, y])], 2, 6)
    A, B, C, D = system
    found = factor_input_matrices(factor, A, C, freedom(2, 2), 6)
    np.testing.assert_allclose(found[0], B, atol=1e-7)
    np.testing.assert_allclose(found[1], D, atol=1e-7)


def test_first_batch_may_be_too_small_for_a_model(system):
    u, y = record(system, 300)
    model = SubspaceLTI(5, horizon=8).partial_fit(u[:1], y[:1])
    with pytest.raises(NotFittedError):
        model.predict(u)
    model.partial_fit(u[1:], y[1:])
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    np.testing.assert_allclose(response(model), response(whole), rtol=1e-9)


def test_fit_forgets_the_stream(system):
    u, y = record(system, 600)
    model = SubspaceLTI(5, horizon=8).partial_fit(u[:300], y[:300])
    model.fit(u[300:], y[300:]).partial_fit(u[:300], y[:300])
    other = SubspaceLTI(5, horizon=8).fit(u[:300], y[:300])
    np.testing.assert_array_equal(response(model), response(other))


def test_trends_cannot_be_removed_from_a_stream(system):
    u, y = record(system, 100)
    with pytest.raises(ValueError, match="`detrend` must be None in partial_fit"):
        SubspaceLTI(detrend="constant").partial_fit(u, y)


def test_memory_does_not_grow_with_the_stream(system, short_buffer):
    model, sizes = SubspaceLTI(5, horizon=8), []
    for seed in range(6):
        model.partial_fit(*record(system, 2000, seed))
        summary = model._stream._summary
        sizes.append(
            summary._waiting.size
            + summary._recursion.information.size
            + summary._sum.gram.size
            + summary._sum.tail.size
            + sum(r.u.size + r.y.size for r in model._evidence.records)
        )
    # A stretch that waits for the next batch is all that comes and goes.
    assert max(sizes) <= sizes[0] + 4 * 8192


def test_gaps_at_the_borders_of_batches_split_the_stream(system):
    u, y = record(system, 800)
    X = u.copy()
    X[[99, 100, 250, 400], 0] = np.nan
    options = {"order": 5, "horizon": 8, "missing": "split"}
    stream = fed(SubspaceLTI(**options), X, y, [100, 300, 1 + 99, 300])
    whole = SubspaceLTI(**options).fit(X, y)
    assert whole.initial_states_.shape == stream.initial_states_.shape == (4, 5)
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)
    # A batch may be nothing but a gap.
    stream.partial_fit(np.full((50, 2), np.nan), y[:50]).partial_fit(u, y)
    assert stream.initial_states_.shape == (5, 5)
