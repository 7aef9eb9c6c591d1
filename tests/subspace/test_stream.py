"""partial_fit: the model of a stream is that of one table, in bounded memory."""

import pickle

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import block_diag
from sklearn.exceptions import NotFittedError

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.exceptions import RankWarning
from lpvlearn.subspace import stream as stream_module
from lpvlearn.subspace.hankel import data_factor, extend_hankel_sum, start_hankel_sum
from lpvlearn.subspace.identification import identify
from lpvlearn.subspace.realization import METHODS, factor_input_matrices
from lpvlearn.subspace.recursive_refinement import (
    _aligned_pair,
    input_matrices,
    start_recursion,
)
from lpvlearn.subspace.refinement import experiment_regressions, in_sections
from lpvlearn.subspace.signals import Record
from lpvlearn.subspace.simulation_fit import freedom, simulation_fit
from lpvlearn.subspace.stream_summary import STRETCH
from lpvlearn.systems.simulation import lti_response

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
    monkeypatch.setattr(stream_module, "BUFFER", 1000)


def response(model):
    return model.lti_.frequency_response(OMEGA)


def truth(system):
    A, B, C, D = system
    z = np.exp(1j * OMEGA)[:, None, None]
    return C @ np.linalg.solve(z * np.eye(len(A)) - A, B + 0j * z) + D


@pytest.mark.parametrize("refine", [True, False])
def test_batches_that_are_still_kept_give_the_model_of_fit(system, refine):
    u, y = record(system, 900)
    options = {"order": 5, "horizon": 8, "refine": refine}
    stream = fed(SubspaceLTI(**options), u, y, [100, 300, 1, 499])
    whole = SubspaceLTI(**options).fit(u, y)
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)


def assert_same_model(stream, whole):
    """To the last digit in any state basis: the same one."""
    for name in "ABCD":
        first, other = getattr(stream.lti_, name), getattr(whole.lti_, name)
        np.testing.assert_allclose(first, other, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        stream.singular_values_, whole.singular_values_, rtol=1e-9
    )
    assert stream.residual_ == pytest.approx(whole.residual_, rel=1e-9)
    assert stream.stability_loss_ == whole.stability_loss_


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"refine": False},
        {"refine": False, "n_noise_states": 2},
        {"refine": False, "method": "pi-moesp", "horizon": 12},
        {"refine": False, "method": "n4sid", "feedthrough": False},
        {"method": "cva", "stability": "enforce"},
        {"refine": False, "initial_state": "rest"},
        {"horizon": "auto"},
        {"order": "auto"},
    ],
)
def test_summaries_give_the_model_of_fit_on_the_whole_table(
    system, short_buffer, options
):
    u, y = record(system, 40_000)
    options = {"order": 5, "horizon": 8, **options}
    sizes = [700, 800, 3, 1497, 3000, 17_000, 17_000]
    whole = SubspaceLTI(**options).fit(u, y)
    assert_same_model(fed(SubspaceLTI(**options), u, y, sizes), whole)
    assert_same_model(fed(SubspaceLTI(**options), u, y, [40_000]), whole)


@pytest.mark.parametrize("method", METHODS)
def test_unrefined_summaries_are_as_good_as_all_samples(system, short_buffer, method):
    """Against the simulation least squares on all samples at once."""
    u, y = record(system, 20_000)
    stream = fed(
        SubspaceLTI(5, horizon=8, method=method, refine=False), u, y, [10_000] * 2
    )
    found = identify([(u, y)], 5, 8, method=method, refine=False)
    whole = StateSpace(*found[:4], 1.0)
    np.testing.assert_allclose(stream.lti_.poles(), whole.poles(), atol=1e-9)
    np.testing.assert_allclose(
        stream.singular_values_, found.singular_values, rtol=1e-7
    )
    error = np.linalg.norm(whole.frequency_response(OMEGA) - truth(system))
    gap = np.linalg.norm(response(stream) - whole.frequency_response(OMEGA))
    assert gap < 0.1 * error


def test_refined_summaries_are_as_good_as_all_samples(system, short_buffer):
    u, y = record(system, 40_000)
    stream = fed(SubspaceLTI(5, horizon=8), u, y, [10_000] * 4)
    found = identify([(u, y)], 5, 8)
    std = np.abs(stream.frequency_response_std(OMEGA))
    G = StateSpace(*found[:4], 1.0).frequency_response(OMEGA)
    assert np.median(np.abs(response(stream) - G) / std) < 0.1
    assert stream.residual_ == pytest.approx(found.residual, rel=1e-3)


def test_superfluous_states_do_not_wander(system, monkeypatch):
    """What the first samples hardly determine stays until more data tell."""
    monkeypatch.setattr(stream_module, "BUFFER", 4000)
    u, y = record(system, 30_000)
    stream = fed(SubspaceLTI(7, horizon=8), u, y, [10_000] * 3)
    assert stream.lti_.is_stable
    assert_same_model(stream, SubspaceLTI(7, horizon=8).fit(u, y))
    assert stream.residual_ == pytest.approx(
        identify([(u, y)], 7, 8).residual, rel=1e-3
    )


def test_fit_goes_back_to_the_samples_where_the_first_ones_say_too_little(
    system, short_buffer
):
    u, y = record(system, 6000)
    for size in (0.0, 1e-3):  # constant, hardly excited
        v = u.copy()
        v[:1200, 1] *= size
        z = lti_response(*system, v) + y - lti_response(*system, u)
        model = SubspaceLTI(5, horizon=8).fit(v, z)
        whole = StateSpace(*identify([(v, z)], 5, 8)[:4], 1.0)
        np.testing.assert_allclose(
            response(model), whole.frequency_response(OMEGA), rtol=1e-9
        )


def test_inputs_must_stay_as_collinear_as_they_begin(system, short_buffer):
    u, y = record(system, 3000)
    v = u.copy()
    v[:1500, 1] = v[:1500, 0]
    z = lti_response(*system, v) + y - lti_response(*system, u)
    whole = StateSpace(*identify([(v, z)], 5, 8)[:4], 1.0)
    model = SubspaceLTI(5, horizon=8).fit(v, z)
    np.testing.assert_allclose(
        response(model), whole.frequency_response(OMEGA), rtol=1e-9
    )
    with (
        pytest.warns(RankWarning, match="collinear"),
        pytest.raises(ValueError, match="collinear in the first samples"),
    ):
        SubspaceLTI(5, horizon=8).partial_fit(v, z)


def test_initial_states_of_a_long_table_are_those_of_its_experiments(
    system, short_buffer
):
    runs = []
    for seed, n in enumerate((900, 2000, 1500)):
        u, y = record(system, n, seed, noise=0.0)
        runs.append((u[100:], y[100:]))
    X = np.vstack(
        [np.column_stack([u, np.full(len(u), k)]) for k, (u, _) in enumerate(runs)]
    )
    y = np.vstack([y for _, y in runs])
    model = SubspaceLTI(5, horizon=8, experiment=2).fit(X, y)
    for (u, z), x0 in zip(runs, model.initial_states_, strict=True):
        fitted = model.lti_.simulate(u, initial_state=x0)
        np.testing.assert_allclose(fitted, z, atol=1e-7)


def test_detrended_long_table_is_that_without_its_means(system, short_buffer):
    u, y = record(system, 5000)
    level = np.array([3.0, -4.0])
    model = SubspaceLTI(5, horizon=8, detrend="constant").fit(u + 1.0, y + level)
    plain = SubspaceLTI(5, horizon=8).fit(u - u.mean(axis=0), y - y.mean(axis=0))
    np.testing.assert_allclose(response(model), response(plain), rtol=1e-9)
    np.testing.assert_allclose(model.output_offset_, (y + level).mean(axis=0))


def test_pure_gain_streams(short_buffer):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((4000, 2))
    D = np.array([[1.0, -2.0]])
    y = u @ D.T + 0.1 * rng.standard_normal((4000, 1))
    stream = fed(SubspaceLTI(0, horizon=3), u, y, [1500, 2500])
    expected = np.linalg.lstsq(u, y)[0].T
    np.testing.assert_allclose(stream.lti_.D, expected, rtol=1e-9)
    nothing = SubspaceLTI(0, horizon=3, feedthrough=False)
    with pytest.warns(UserWarning, match="next to nothing"):
        nothing.fit(u, y)
    assert not nothing.lti_.D.any()


def test_enforced_stability_of_a_stream_is_guaranteed(short_buffer):
    rng = np.random.default_rng(1)
    u = rng.standard_normal((6000, 1))
    one = np.ones((1, 1))
    y = lti_response(1.00005 * one, one, one, 0 * one, u)
    y += rng.standard_normal(y.shape)
    for refine in (True, False):
        options = {"horizon": 10, "stability": "enforce", "refine": refine}
        stream = fed(SubspaceLTI(1, **options), u, y, [2000] * 3)
        assert stream.lti_.is_stable


def test_noise_free_stream_is_exact(system, short_buffer):
    u, y = record(system, 4000, noise=0.0)
    stream = fed(SubspaceLTI(5, horizon=8), u, y, [1500, 500, 2000])
    np.testing.assert_allclose(response(stream), truth(system), atol=1e-7)


def test_experiments_continue_over_batches_by_their_label(system, short_buffer):
    runs = [record(system, n, seed) for seed, n in enumerate((1200, 900, 1400))]
    X = pd.DataFrame(np.vstack([u for u, _ in runs]), columns=["u1", "u2"])
    X["run"] = np.repeat(["a", "b", "c"], [1200, 900, 1400])
    y = np.vstack([y for _, y in runs])
    options = {"order": 5, "horizon": 8, "experiment": "run", "refine": False}
    stream = fed(SubspaceLTI(**options), X, y, [500, 600, 900, 1500])
    assert_same_model(stream, SubspaceLTI(**options).fit(X, y))
    # Without the labels windows cross the borders, which is another model.
    other = SubspaceLTI(5, horizon=8, refine=False).fit(X[["u1", "u2"]], y)
    assert abs(other.lti_.poles() - stream.lti_.poles()).max() > 1e-7


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
        kept = sum(r.u.size + r.y.size for r in model._evidence.records)
        sizes.append(len(pickle.dumps(model)) // 8)
    # A stretch that waits for the next batch is all that comes and goes.
    assert max(sizes) <= sizes[0] + 5 * STRETCH


def test_gaps_of_a_summarised_stream_split_it(system, short_buffer):
    u, y = record(system, 5000)
    X = u.copy()
    X[[99, 1499, 1501, 2500, 2502, 3999], 0] = np.nan
    options = {"order": 5, "horizon": 8, "missing": "split"}
    sizes = [500, 1001, 1000, 1, 1498, 1000]
    stream = fed(SubspaceLTI(**options), X, y, sizes)
    assert_same_model(stream, SubspaceLTI(**options).fit(X, y))


def test_a_pair_is_brought_to_the_blocks_of_another_model(system):
    u, y = record(system, 400, noise=0.0)
    pilot = in_sections(simulation_fit(system[0], system[2], [Record(u.T, y.T)]))
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
    pilot = in_sections(simulation_fit(system[0], system[2], records))
    parts = experiment_regressions(pilot, records, free)
    recursion = start_recursion(pilot, parts, free)
    T = np.random.default_rng(1).standard_normal((5, 5))
    A, C = np.linalg.solve(T, system[0] @ T), system[2] @ T
    found = input_matrices(recursion, A, C)
    G = StateSpace(*found[:4], 1.0).frequency_response(OMEGA)
    whole = StateSpace(*pilot[:4], 1.0).frequency_response(OMEGA)
    np.testing.assert_allclose(G, whole, atol=1e-8)
    assert found.loss == pytest.approx(pilot.loss, rel=1e-9)


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
