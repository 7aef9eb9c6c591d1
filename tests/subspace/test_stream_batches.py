"""partial_fit: what a batch must be, and what it leaves behind where it is not."""

import warnings

import numpy as np
import pytest
from scipy.linalg import block_diag

from lpvlearn import SubspaceLTI
from lpvlearn.exceptions import RankWarning
from lpvlearn.subspace import stream as stream_module
from lpvlearn.systems.simulation import lti_response

OMEGA = np.linspace(0.05, 3.0, 40)


@pytest.fixture
def system():
    rng = np.random.default_rng(5)
    poles = 0.95 * np.exp(0.5j), 0.9 * np.exp(1.4j)
    blocks = [[[p.real, p.imag], [-p.imag, p.real]] for p in poles]
    shapes = (5, 2), (2, 5), (2, 2)
    return (block_diag(*blocks, 0.8), *(rng.standard_normal(s) for s in shapes))


def record(system, n_samples, noise=0.1):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((n_samples, 2))
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
    return model.lti_.frequency_response(OMEGA * model.lti_.sampling_time)


def truth(system):
    A, B, C, D = system
    z = np.exp(1j * OMEGA)[:, None, None]
    return C @ np.linalg.solve(z * np.eye(len(A)) - A, B + 0j * z) + D


def assert_same_model(stream, whole):
    np.testing.assert_allclose(response(stream), response(whole), rtol=1e-9)
    np.testing.assert_allclose(
        stream.singular_values_, whole.singular_values_, rtol=1e-9
    )
    assert stream.residual_ == pytest.approx(whole.residual_, rel=1e-9)


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("gap", [997, 998, 999])
def test_gap_at_the_end_of_the_buffer_keeps_experiments_apart(
    system, short_buffer, gap, refine
):
    u, y = record(system, 4000, noise=0.0)
    X = u.copy()
    X[gap] = np.nan
    options = {"order": 5, "horizon": 8, "missing": "split", "refine": refine}
    whole = SubspaceLTI(**options).fit(X, y)
    assert whole.initial_states_.shape == (2, 5)
    for sizes in ([4000], [1000, 3000], [999, 1, 3000], [998, 1, 1, 1, 2999]):
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
def test_refused_batch_leaves_no_trace(system, short_buffer, n_first):
    u, y = record(system, 30_000)
    X = np.column_stack([u, 0.1 * np.arange(30_000)])
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
    system, short_buffer
):
    """A stretch of the refused batch is complete before inputs differ in the next."""
    u, y = record(system, 60_000)
    u[:, 1] = u[:, 0]
    stray = u[2000:42_000].copy()
    stray[30_000:, 1] *= 2.0
    model = SubspaceLTI(5, horizon=8)
    with pytest.warns(RankWarning, match="collinear"):
        model.partial_fit(u[:2000], y[:2000])
    refused(model, stray, y[2000:42_000], "collinear in the first samples")
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
    model = SubspaceLTI(5, horizon=8).partial_fit(u[:300], y[:300])
    with monkeypatch.context() as patched:
        patched.setattr("lpvlearn.subspace.fit.identify", diverge)
        refused(model, u[300:], y[300:], "did not converge")
    model.partial_fit(u[300:], y[300:])
    whole = SubspaceLTI(5, horizon=8).fit(u, y)
    np.testing.assert_allclose(response(model), response(whole), rtol=1e-9)


def test_stream_that_begins_with_a_constant_input_waits_for_its_change(
    system, short_buffer
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
    model.set_params(order=5, method="po-moesp", feedthrough=free.copy())
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
