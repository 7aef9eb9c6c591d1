"""partial_fit: the model of a stream is that of one table, in bounded memory."""

import copy
import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.exceptions import NotFittedError

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.exceptions import RankWarning
from lpvlearn.subspace.orders.realization import METHODS, factor_input_matrices
from lpvlearn.subspace.samples.hankel import (
    data_factors,
    extend_hankel_sum,
    start_hankel_sum,
)
from lpvlearn.subspace.streams import stream as stream_module
from lpvlearn.systems.simulation import lti_response

from .conftest import fed, freedom, identify, record

OMEGA = np.linspace(0.05, 3.0, 40)


def response(model):
    return model.lti_.frequency_response(OMEGA / model.lti_.sampling_time)


def truth(system):
    return StateSpace(*system, 1.0).frequency_response(OMEGA)


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


@pytest.mark.broad
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
    system, short_stream, options
):
    u, y = record(system, 8000)
    options = {"order": 5, "horizon": 8, **options}
    sizes = [700, 800, 3, 497, 1000, 2500, 2500]
    whole = SubspaceLTI(**options).fit(u, y)
    assert_same_model(fed(SubspaceLTI(**options), u, y, sizes), whole)
    assert_same_model(fed(SubspaceLTI(**options), u, y, [8000]), whole)


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
    np.testing.assert_allclose(model.output_offset_[0], (y + level).mean(axis=0))


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
    (whole,) = data_factors(records, 2, [6])
    assert (state.gram is None) == (noise == 0.0)
    # Factors of singular data agree up to a rotation of their null space.
    np.testing.assert_allclose(
        state.triangular() @ state.triangular().T, whole @ whole.T, atol=1e-8
    )
    if noise:
        np.testing.assert_allclose(state.triangular(), whole, atol=1e-9)


def test_input_matrices_from_the_factor_are_exact_without_noise(system):
    u, y = record(system, 500, noise=0.0)
    (factor,) = data_factors([np.hstack([u, y])], 2, [6])
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


def test_a_stream_waits_for_no_input_longer_than_it_keeps_samples(system):
    model = SubspaceLTI(3, horizon=10, input_delay=10**9)
    with pytest.raises(ValueError, match="below 131072 samples.*Got 1000000000"):
        model.partial_fit(*record(system, 100))


def test_memory_does_not_grow_with_the_stream(system, short_stream):
    model, sizes = SubspaceLTI(5, horizon=8), []
    for seed in range(6):
        model.partial_fit(*record(system, 1700, seed))
        sizes.append(len(pickle.dumps(model)))
    # A stretch that waits for the next batch, and its view, are all that come and go.
    stretch = 2000 * 4 * 8
    assert max(sizes) <= sizes[0] + 2.1 * stretch


def test_gaps_of_a_summarised_stream_split_it(system, short_buffer):
    u, y = record(system, 5000)
    X = u.copy()
    X[[99, 1499, 1501, 2500, 2502, 3999], 0] = np.nan
    options = {"order": 5, "horizon": 8, "missing": "split"}
    sizes = [500, 1001, 1000, 1, 1498, 1000]
    stream = fed(SubspaceLTI(**options), X, y, sizes)
    assert_same_model(stream, SubspaceLTI(**options).fit(X, y))


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


@pytest.mark.broad
@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("gap", [997, 998, 999])
def test_gap_at_the_end_of_the_buffer_keeps_experiments_apart(
    system, short_stream, gap, refine
):
    u, y = record(system, 2500, noise=0.0)
    X = u.copy()
    X[gap] = np.nan
    options = {"order": 5, "horizon": 8, "missing": "split", "refine": refine}
    whole = SubspaceLTI(**options).fit(X, y)
    assert whole.initial_states_.shape == (2, 5)
    for sizes in ([2500], [1000, 1500], [999, 1, 1500], [998, 1, 1, 1, 1499]):
        stream = fed(SubspaceLTI(**options), X, y, sizes)
        # Windows across the gap would show as another direction of the states.
        assert stream.singular_values_[5] < 1e-6 * stream.singular_values_[0]
        assert stream.residual_ < 1e-9
        np.testing.assert_allclose(response(stream), response(whole), atol=1e-9)
        np.testing.assert_allclose(response(stream), truth(system), atol=1e-7)


def test_single_sample_at_the_end_of_the_buffer_is_left_out_however_cut(
    system, short_buffer
):
    u, y = record(system, 4000)
    X = u.copy()
    X[[997, 999, 1001, 1002]] = np.nan  # 998 and 1000 stand alone
    options = {"order": 5, "horizon": 8, "missing": "split", "refine": False}
    whole = SubspaceLTI(**options).fit(X, y)
    for sizes in ([4000], [999, 3001], [1000, 3000], [1001, 2999], [1002, 1, 2997]):
        assert_same_model(fed(SubspaceLTI(**options), X, y, sizes), whole)


def refused(model, X, y, match):
    """Refuse a batch and leave everything as it was."""
    before = dict(vars(model))
    with pytest.raises(ValueError, match=match):
        model.partial_fit(X, y)
    assert vars(model).keys() == before.keys()
    assert all(vars(model)[name] is value for name, value in before.items())


@pytest.mark.parametrize("n_first", [600, 3000])  # kept, summarised
def test_refused_batch_leaves_no_trace(system, short_stream, n_first):
    u, y = record(system, 7000)
    X = np.column_stack([u, 0.1 * np.arange(7000)])
    options = {"order": 5, "horizon": 8, "time": 2}
    first, rest = slice(0, n_first), slice(n_first, None)
    model = SubspaceLTI(**options).partial_fit(X[first], y[first])
    refused(model, X[rest], y[rest, :1], "`y` must have the same columns.*Got 1")
    late = X[rest].copy()
    late[:, 2] += 0.1
    refused(model, late, y[rest], "does not continue")
    refused(model, X[rest, 1:], y[rest], "features")
    whole = SubspaceLTI(**options).fit(X, y)
    assert_same_model(model.partial_fit(X[rest], y[rest]), whole)


def test_new_experiment_with_other_outputs_does_not_stop_the_stream(system):
    u, y = record(system, 900)
    X = np.column_stack([u, np.repeat([0.0, 1.0, 2.0], 300)])
    options = {"order": 5, "horizon": 8, "experiment": 2}
    model = SubspaceLTI(**options).partial_fit(X[:300], y[:300])
    refused(model, X[300:600], np.hstack([y, y])[300:600], "Got 4 output.s., after 2")
    model.partial_fit(X[300:], y[300:])
    whole = SubspaceLTI(**options).fit(X, y)
    np.testing.assert_allclose(response(model), response(whole), rtol=1e-9)


def test_later_independence_of_collinear_inputs_is_refused_as_a_whole(
    system, short_stream
):
    """A stretch of the refused batch is complete before inputs differ in the next."""
    u, y = record(system, 9000)
    u[:, 1] = u[:, 0]
    stray = u[2000:7000].copy()
    stray[3500:, 1] *= 2.0
    model = SubspaceLTI(5, horizon=8)
    with pytest.warns(RankWarning, match="collinear"):
        model.partial_fit(u[:2000], y[:2000])
    refused(model, stray, y[2000:7000], "collinear in the first samples")
    model.partial_fit(u[2000:], y[2000:])
    with pytest.warns(RankWarning, match="collinear"):
        other = SubspaceLTI(5, horizon=8).partial_fit(u, y)
    assert_same_model(model, other)


@pytest.mark.parametrize(
    "options, match",
    [
        ({"order": 2, "feedthrough": np.ones((3, 3), bool)}, "`feedthrough` must be"),
        ({"order": 200, "horizon": 10}, "`order` must be at most 18"),
        ({"order": 2, "horizon": 400}, "`horizon` must be at most"),
        ({"order": 17, "horizon": 8, "method": "pi-moesp"}, "at most 14"),
    ],
)
def test_what_more_samples_do_not_mend_is_refused_at_once(
    system, short_buffer, options, match
):
    u, y = record(system, 20)
    model = SubspaceLTI(**options)
    refused(model, u[:1], y[:1], match)
    assert not hasattr(model, "n_features_in_")


def test_errors_of_the_linear_algebra_are_not_taken_for_few_samples(
    system, monkeypatch
):
    def diverge(*args, **kwargs):
        raise np.linalg.LinAlgError("SVD did not converge")

    u, y = record(system, 900)
    model = SubspaceLTI(5, horizon=8)
    with monkeypatch.context() as patched:
        patched.setattr("lpvlearn.subspace.fits.one_fit.identify", diverge)
        refused(model, u[:300], y[:300], "did not converge")
    model.partial_fit(u[:300], y[:300]).partial_fit(u[300:], y[300:])
    with monkeypatch.context() as patched:
        patched.setattr("lpvlearn.subspace.fits.one_fit.identify", diverge)
        for _ in range(2):  # whoever asks is told, and may ask again
            with pytest.raises(ValueError, match="did not converge"):
                model.predict(u)
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    np.testing.assert_allclose(response(model), response(whole), rtol=1e-9)


def test_stream_that_begins_with_a_constant_input_waits_for_its_change(
    system, short_stream
):
    u, y = record(system, 8000, noise=0.0)
    u[:3300, 1] = 2.0
    y = lti_response(*system, u)
    streams = []
    for sizes in ([8000], [700, 2700, 600, 4000], [1000] * 8):
        model, kept = SubspaceLTI(5, horizon=8), []
        with pytest.warns(UserWarning, match="1,000 samples .* Every input must") as w:
            for k, size in zip(np.cumsum([0, *sizes]), sizes, strict=False):
                model.partial_fit(u[k : k + size], y[k : k + size])
                kept.append(sum(len(u) for u, _ in model._stream._buffer.pairs))
        assert len(w) == 1 and max(kept) <= 1000
        np.testing.assert_allclose(response(model), truth(system), atol=1e-7)
        streams.append(model)
    for other in streams[1:]:
        assert_same_model(other, streams[0])


def test_samples_from_rest_are_not_left_out(system, short_buffer):
    u, y = record(system, 1500)
    u[:1200, 1] = 2.0
    model = SubspaceLTI(5, horizon=8, initial_state="rest")
    model.partial_fit(u[:900], y[:900])
    refused(model, u[900:], y[900:], "Every input must vary")


@pytest.mark.parametrize("size", [1e-6, 1.0])
def test_stream_warns_once_where_its_linearisation_fails(system, short_buffer, size):
    u, _ = record(system, 9000)
    u[:1000] *= size
    noise = np.random.default_rng(3).standard_normal((9000, 2))
    y = lti_response(*system, u) + 0.1 * noise
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = fed(SubspaceLTI(5, horizon=8), u, y, [1000, 4000, 4000])
    found = [str(w.message) for w in caught if "error of the stream" in str(w.message)]
    true = np.linalg.norm(y - model.predict(u)) / np.linalg.norm(y)
    assert len(found) == (true > 0.5) == (size < 1.0)


@pytest.mark.broad
@pytest.mark.filterwarnings("ignore:The simulation error depends on past")
@pytest.mark.parametrize("n_first", [600, 3000])
@pytest.mark.parametrize(
    "changed", [{"order": 4}, {"method": "cva"}, {"feedthrough": [[True, False]] * 2}]
)
def test_options_must_stay_within_a_stream(system, short_buffer, n_first, changed):
    u, y = record(system, 6000)
    free = np.ones((2, 2), dtype=bool)
    model = SubspaceLTI(5, horizon=8, feedthrough=free)
    model.partial_fit(u[:n_first], y[:n_first])
    model.set_params(**changed)
    (name,) = changed
    refused(model, u[n_first:], y[n_first:], f"`{name}` must stay as it was")
    model.set_params(order=5, method="auto", feedthrough=free.copy())
    model.partial_fit(u[n_first:], y[n_first:])
    model.set_params(**changed).fit(u, y).partial_fit(u, y)


def test_array_options_that_are_changed_in_place_are_noticed(system):
    u, y = record(system, 600)
    free = np.ones((2, 2), dtype=bool)
    model = SubspaceLTI(5, horizon=8, feedthrough=free).partial_fit(u[:300], y[:300])
    free[0, 1] = False
    refused(model, u[300:], y[300:], "`feedthrough` must stay")


def test_warnings_are_given_once_per_stream(system, short_buffer):
    u, y = record(system, 4000)
    u[:, 1] = u[:, 0]
    y = np.random.default_rng(1).standard_normal(y.shape)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fed(SubspaceLTI(2, horizon=8), u, y, [300, 300, 1400, 2000])
    heads = [str(w.message)[:20] for w in caught]
    assert sorted(heads) == sorted(set(heads))
    assert any("collinear" in str(w.message) for w in caught)
    assert any("next to nothing" in str(w.message) for w in caught)


@pytest.fixture(scope="module")
def timed():
    """A lag of the first order, its record in a table."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((400, 2))
    lag = [[0.9]], [[1.0, -0.5]], [[1.0], [0.5]], np.zeros((2, 2))
    y = lti_response(*map(np.array, lag), u)
    X = pd.DataFrame(u, columns=["u1", "u2"])
    return X, y + 0.1 * rng.standard_normal(y.shape)


def test_batches_go_on_evenly_in_time(timed):
    X, y = timed[0].copy(), timed[1]
    X["t"] = (1000 + np.arange(400) / 30.0).round(3)  # rounded stamps
    options = {"order": 1, "horizon": 5, "time": "t"}
    batches = [slice(0, 1), slice(1, 150), slice(150, 153), slice(153, 400)]
    stream = SubspaceLTI(**options)
    for rows in batches:
        stream.partial_fit(X[rows], y[rows])
    whole = SubspaceLTI(**options).fit(X, y)
    assert stream.lti_.sampling_time == pytest.approx(whole.lti_.sampling_time)
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)


@pytest.mark.parametrize(
    "first, step, match",
    [
        (0.0, 0.1, "repeats samples"),
        (19.0, 0.1, "repeats samples"),
        (20.0, 0.1, None),
        (20.1, 0.1, "does not continue"),
        (20.0, 0.2, "does not continue where that ended"),
    ],
)
@pytest.mark.parametrize("dates", [False, True])
def test_repeated_missing_or_slower_batches_are_refused(
    timed, first, step, match, dates
):
    X, y = timed[0].copy(), timed[1]
    X["t"] = np.r_[0.1 * np.arange(200), first + step * np.arange(200)]
    if dates:
        X["t"] = pd.Timestamp("2024-02-28 23:59:50") + pd.to_timedelta(X["t"], "s")
    stream = SubspaceLTI(1, horizon=5, time="t").partial_fit(X[:200], y[:200])
    before = response(stream)
    if match is None:
        stream.partial_fit(X[200:], y[200:])
        return
    with pytest.raises(ValueError, match=match):
        stream.partial_fit(X[200:], y[200:])
    # Nothing has changed: the right batch may follow.
    np.testing.assert_array_equal(response(stream), before)
    X.loc[200:, "t"] = X["t"][199] + (X["t"][199] - X["t"][198]) * np.arange(1, 201)
    stream.partial_fit(X[200:], y[200:])


def test_experiments_of_a_stream_have_one_time_step(timed):
    X, y = timed[0].assign(run=np.repeat([0, 1], 200)), timed[1]
    X["t"] = np.r_[0.1 * np.arange(200), 0.2 * np.arange(200)]
    model = SubspaceLTI(1, horizon=5, time="t", experiment="run")
    model.partial_fit(X[:200], y[:200])
    with pytest.raises(ValueError, match="same time step. Got 0.1 s first, and 0.2 s"):
        model.partial_fit(X[200:], y[200:])


@pytest.mark.parametrize("dates", [False, True])
def test_dropped_rows_and_jitter_of_a_stream_are_those_of_its_table(timed, dates):
    """Rows are missing within batches and between them; stamps are off by 0.8 %."""
    rng = np.random.default_rng(1)
    t = 0.1 * (np.arange(400) + 0.008 * rng.uniform(-1, 1, 400))
    if dates:
        t = pd.Timestamp("2024-02-28 23:59:50") + pd.to_timedelta(t, unit="s")
    kept = ~np.isin(np.arange(400), [70, 71, 150, 201, 202, 300])
    X, y = timed[0].assign(t=t)[kept], timed[1][kept]
    options = {"order": 1, "horizon": 5, "time": "t", "missing": "split"}
    whole, stream = SubspaceLTI(**options).fit(X, y), SubspaceLTI(**options)
    assert len(whole.initial_states_) == 5
    for start, stop in [(0, 60), (60, 148), (148, 149), (149, 250), (250, 394)]:
        stream.partial_fit(X[start:stop], y[start:stop])
    assert stream.lti_.sampling_time == pytest.approx(whole.lti_.sampling_time)
    assert 0.006 < stream.time_jitter_ < 0.01
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)
    with pytest.raises(ValueError, match=r"row\(s\) are missing|does not continue"):
        strict = SubspaceLTI(**{**options, "missing": "raise"})
        strict.partial_fit(X[:60], y[:60]).partial_fit(X[60:148], y[60:148])


def test_small_batches_make_few_models_and_the_same(system, monkeypatch):
    made, fit = [], stream_module.fit_samples
    monkeypatch.setattr(
        stream_module, "fit_samples", lambda *a, **k: made.append(1) or fit(*a, **k)
    )
    u, y = record(system, 900)
    model = fed(SubspaceLTI(5, horizon=8), u, y, [5] * 180)
    assert len(made) <= 6  # doublings of 5 samples, until there is a model
    copies = pickle.loads(pickle.dumps(model)), model
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    for one in copies:
        np.testing.assert_allclose(response(one), response(whole), rtol=1e-9)
    assert len(made) <= 8 and not hasattr(model, "no_such_attribute_")


def test_branches_of_a_stream_leave_each_other_alone(system):
    u, y = record(system, 600)
    first = SubspaceLTI(5, horizon=8).partial_fit(u[:300], y[:300])
    other = copy.copy(first)
    first.partial_fit(u[300:], y[300:])
    other.partial_fit(u[300:400], 2 * y[300:400])
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    np.testing.assert_allclose(response(first), response(whole), rtol=1e-9)
    assert abs(response(other) - response(whole)).max() > 1e-3


@pytest.mark.filterwarnings("ignore")  # of a few samples
def test_single_rows_are_the_stream_of_their_table(system, short_stream):
    u, y = record(system, 2600)
    model, row = SubspaceLTI(5, horizon=8), (np.empty((1, 2)), np.empty((1, 2)))
    for k in range(2600):
        row[0][:], row[1][:] = u[k], y[k]  # in the same memory every time
        model.partial_fit(*row)
        if k in (700, 1700):  # kept and asked, summarised and asked
            whole = SubspaceLTI(5, horizon=8).fit(u[: k + 1], y[: k + 1])
            assert_same_model(model, whole)
    assert_same_model(model, SubspaceLTI(5, horizon=8).fit(u, y))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_single_rows_of_tables_wait_where_their_labels_tell_nothing(system):
    u, y = record(system, 300)
    X = pd.DataFrame(u, columns=["a", "b"])
    model, series = SubspaceLTI(3, horizon=4), pd.Series(y[:, 0], name="p")
    for k in range(300):
        model.partial_fit(X[k : k + 1], series[k : k + 1])
    assert model._stream._n_waiting >= 300 - 32  # the first model is of fewer
    refused(model, X[["a"]][:1], series[:1], "must have the columns")
    refused(model, X[:2], series[1:3].set_axis([0, 7]), "must have the row labels")
    model.partial_fit(X[["b", "a"]], series)
    twice = pd.concat([X, X], ignore_index=True)
    whole = SubspaceLTI(3, horizon=4).fit(twice, np.tile(series, 2))
    assert_same_model(model, whole)
    assert list(model.lti_.input_names) == ["a", "b"]


def test_rows_that_wait_are_checked_and_belong_to_their_branch(system):
    u, y = record(system, 800)
    first = SubspaceLTI(5, horizon=8).partial_fit(u[:400], y[:400])
    first.partial_fit(u[400:401], y[400:401])
    other, kept = copy.copy(first), pickle.loads(pickle.dumps(first))
    bad = np.array([[np.nan, 0.0]])
    refused(first, bad, y[401:402], "Input X contains NaN")
    refused(first, u[401:402], bad, "Input y contains NaN")
    refused(first, u[401:402], np.full((1, 2), 1e200), "too large to be squared")
    refused(first, u[401:402], y[401:402, 0], "Got 1 output.s., after 2")
    refused(first, u[401:402], y[401:403], "as many rows")
    refused(first, u[401:402], y[401:403].ravel()[:2], "as many rows")
    refused(first, u[401:402, :1], y[401:402], "features")
    refused(first, np.empty((0, 2)), np.empty((0, 2)), "sample")
    first.horizon = 9
    refused(first, u[401:402], y[401:402], "`horizon` must stay")
    first.horizon = 8
    for k in range(401, 800):
        first.partial_fit(u[k : k + 1], y[k : k + 1])
        other.partial_fit(u[k : k + 1], 2 * y[k : k + 1])
    kept.partial_fit(u[401:].tolist(), y[401:])
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    for one in (first, kept):
        np.testing.assert_allclose(response(one), response(whole), rtol=1e-9)
    assert abs(response(other) - response(whole)).max() > 1e-3


def test_batches_of_an_iterable_are_a_stream(system):
    u, y = record(system, 900)
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    one = SubspaceLTI(5, horizon=8)
    for _ in range(2):  # every time from the beginning
        one.fit_batches((u[k : k + 50], y[k : k + 50]) for k in range(0, 900, 50))
        np.testing.assert_allclose(response(one), response(whole), rtol=1e-9)
    before = one.lti_
    for batches, told in [
        ([], "enough samples for a model. Got 0"),
        ([(u[:3], y[:3])], "enough samples for a model. Got 3"),
        ([u], "pairs .X, y.. Got ndarray as number 0"),
    ]:
        with pytest.raises(ValueError, match=told):
            one.fit_batches(batches)
    assert one.lti_ is before


def test_a_stream_after_a_fit_has_no_model_of_that():
    u, y = np.random.default_rng(0).standard_normal((2, 300))
    fitted = SubspaceLTI(1).fit(np.column_stack([u, y]), np.roll(u + y, 1))
    fitted.partial_fit(u[:3, None], y[:3])
    assert not hasattr(fitted, "lti_")
    with pytest.raises(NotFittedError):
        fitted.predict(u[:10, None])


def test_a_model_is_fed_all_of_its_inputs():
    table = pd.DataFrame(np.random.default_rng(0).standard_normal((300, 2)))
    table.columns = ["a", "b"]
    fitted = SubspaceLTI(1, inputs=["a", "b"]).fit(table, np.roll(table["a"], 1))
    with pytest.raises(ValueError, match=r"must name the 2 input\(s\).* Got \['a'\]"):
        fitted.set_params(inputs=["a"]).predict(table)
