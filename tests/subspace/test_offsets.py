"""Constants and drifts of the experiments, estimated with the model."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI, make_bft_scorer
from lpvlearn.metrics import bft_score
from lpvlearn.subspace.alternatives import trends
from lpvlearn.subspace.evidence import constants
from lpvlearn.subspace.evidence.constants import (
    _tail,
    stands_by_chance,
    without_slow_modes,
)
from lpvlearn.subspace.evidence.offsets import (
    _as_they_begin,
    attributed,
    far_off,
)
from lpvlearn.subspace.samples import hankel
from lpvlearn.subspace.samples.records import Record, centred
from lpvlearn.subspace.simulation_error.simulation_fit import (
    Freedom,
    Realization,
    _general_regression,
    block_fit,
)
from lpvlearn.systems.simulation import lti_response, trend_signals

from ..benchmarks.offsets import random_system, relative_error
from ..benchmarks.offsets import table as offsets_table
from ..conftest import modes
from .conftest import fed, record

OMEGA = np.geomspace(0.01, 3.0, 40)
A = modes(0.9 * np.exp(0.4j), 0.7)
B = np.array([[1.0, 0.3], [-0.5, 1.0], [0.4, -0.8]])
C = np.array([[1.0, -0.4, 0.7], [0.2, 0.9, -1.0]])
SYSTEM = StateSpace(A, B, C, sampling_time=1.0)
LEVELS = (3.0, -7.0, 100.0)


def table(rng, *, levels=LEVELS, n=200, noise=0.0, pole=0.0, drift=0.0, u0=0.0):
    """Experiments of `SYSTEM` about a level each, from any state."""
    X, Y = [], []
    for run, level in enumerate(levels):
        u, t = rng.standard_normal((n, 2)), np.linspace(-1.0, 1.0, n)[:, None]
        y = lti_response(A, B, C, np.zeros((2, 2)), u, rng.standard_normal(3))
        e = lfilter(
            [np.sqrt(1 - pole**2)], [1.0, -pole], rng.standard_normal(y.shape).T
        )
        y = y + noise * e.T + (level + drift * t) * np.array([1.0, -2.0])
        X.append(np.column_stack([u + u0, np.full(n, run)]))
        Y.append(y)
    return np.vstack(X), np.vstack(Y)


def error_of(model, truth=SYSTEM):
    G = truth.frequency_response(OMEGA)
    return np.abs(model.lti_.frequency_response(OMEGA) - G).max() / np.abs(G).max()


def options(**others):
    return {"experiment": 2, **others}


# -- exact cases -----------------------------------------------------------------------


@pytest.mark.parametrize("method", ["po-moesp", "pi-moesp", "n4sid", "cva"])
@pytest.mark.parametrize("refine", [True, False])
def test_without_noise_constants_are_exact(rng, method, refine):
    X, y = table(rng)
    settings = options(horizon=6, method=method, refine=refine)
    model = SubspaceLTI(3, offset="constant", **settings).fit(X, y)
    assert error_of(model) < 1e-9
    np.testing.assert_allclose(model.predict_with_initial_state(X, y), y, atol=1e-8)


def test_offsets_tell_where_the_outputs_rest_at_the_mean_inputs(rng):
    X, y = table(rng, u0=2.0)
    model = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
    assert model.offset_ == "constant"
    means = np.array([X[X[:, 2] == run, :2].mean(axis=0) for run in range(3)])
    np.testing.assert_allclose(model.input_offset_, means)
    level = np.outer(LEVELS, [1.0, -2.0])
    gain = SYSTEM.C @ np.linalg.solve(np.eye(3) - A, B)
    np.testing.assert_allclose(model.output_offset_, level + (means - 2.0) @ gain.T)
    assert not model.output_drift_.any()


def test_the_resting_point_is_the_mean_over_the_samples(rng):
    X, y = table(rng, u0=2.0)
    kept = np.r_[0:100, 200:600]  # half of the first experiment
    model = SubspaceLTI(3, horizon=6, **options()).fit(X[kept], y[kept])
    u0, y0 = model.resting_point()
    np.testing.assert_allclose(u0, X[kept, :2].mean(axis=0))
    weighed = np.array([0.2, 0.4, 0.4]) @ model.output_offset_
    np.testing.assert_allclose(y0, weighed)
    assert model.offsets_differ_
    same = SubspaceLTI(3, horizon=6, **options()).fit(*table(rng, levels=(3.0,)))
    assert not same.offsets_differ_


def test_drifts_are_exact_and_told_per_second(rng):
    X, y = table(rng, drift=4.0)
    settings = options(horizon=6, sampling_time=0.5)
    model = SubspaceLTI(3, offset="linear", **settings).fit(X, y)
    poles = SYSTEM.poles()
    np.testing.assert_allclose(model.lti_.poles(), poles, atol=1e-10)
    drift = 4.0 * 2.0 / (199 * 0.5) * np.array([1.0, -2.0])
    np.testing.assert_allclose(model.output_drift_, np.tile(drift, (3, 1)))
    np.testing.assert_allclose(model.predict_with_initial_state(X, y), y, atol=1e-8)


def test_the_resting_point_may_be_where_drifts_begin(rng):
    X, y = table(rng, levels=(3.0, 3.0), drift=4.0)
    model = SubspaceLTI(3, horizon=6, offset="linear", **options()).fit(X, y)
    (_, middle), (_, begun) = model.resting_point(), model.resting_point(begun=True)
    np.testing.assert_allclose(middle - begun, 4.0 * np.array([1.0, -2.0]))


@pytest.mark.slow
def test_a_drift_that_a_simulation_misses_is_told(rng):
    u = np.repeat(rng.choice([-1.0, 1.0], 50), 10)[:, None]
    plant = StateSpace([[0.8]], [[0.2]], [[1.0]], sampling_time=1.0)
    y = plant.simulate(u)[:, 0] + 0.02 * rng.standard_normal(500)
    SubspaceLTI(sampling_time=1.0).fit(u, y + np.linspace(0.0, 0.05, 500))
    with pytest.warns(UserWarning, match="Output 1 drifts.* by 2 .*predict_with"):
        model = SubspaceLTI(sampling_time=1.0).fit(u, y + np.linspace(0.0, 2.0, 500))
    assert model.offset_ == "linear"
    SubspaceLTI(offset="linear", sampling_time=1.0).fit(
        u, y + np.linspace(0.0, 2.0, 500)
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Output . drifts along a line")
@pytest.mark.parametrize("size", [0.1, 1.0])
def test_a_given_order_does_not_hide_a_drift(rng, size):
    """It has no state left to follow it."""
    X, y = table(rng, levels=(0.0,), n=600, noise=0.1, drift=size * 3.0)
    free, given = (SubspaceLTI(order, **options()).fit(X, y) for order in ("auto", 3))
    assert free.offset_ == given.offset_ == "linear"
    assert error_of(given) < 0.05


def test_what_constants_gain_beside_a_given_order_is_no_drift(rng, monkeypatch):
    """Where constants were not suspected, and drifts are."""
    u = np.repeat(rng.standard_normal((40, 1)), 10, axis=0)
    y = 2.0 + lfilter([0.0, 0.2], [1.0, -0.8], u, axis=0)
    y += 0.02 * rng.standard_normal(y.shape)
    monkeypatch.setattr(trends, "may_have_constants", lambda *_, **__: False)
    monkeypatch.setattr(trends, "_drifts_off", lambda *_: True)
    model = SubspaceLTI(1).fit(u, y)
    assert model.offset_ == "constant"
    assert not model.output_drift_.any()


@pytest.mark.filterwarnings("ignore:Output . drifts along a line")
@pytest.mark.parametrize("order", ["auto", 3])
def test_a_drift_is_no_integrator_that_the_level_of_an_input_moves(rng, order):
    X, y = table(rng, levels=(5.0,), n=600, noise=0.1, drift=3.0, u0=4.0)
    model = SubspaceLTI(order, **options()).fit(X, y)
    assert (model.offset_, model.order_) == ("linear", 3)
    assert error_of(model) < 0.05


@pytest.mark.parametrize("offset, degree", [("constant", 0), ("linear", 1)])
def test_what_is_estimated_may_be_added_to_the_outputs(rng, offset, degree):
    """Also with noise: the model is the same to rounding."""
    X, y = table(rng, noise=0.2)
    t = np.tile(np.linspace(0, 1, 200), 3)[:, None]
    moved = y + 30.0 * (1 + X[:, 2:]) + 50.0 * degree * t
    first, other = (
        SubspaceLTI(3, horizon=6, offset=offset, **options()).fit(X, outputs)
        for outputs in (y, moved)
    )
    assert error_of(first, other.lti_) < 1e-9


@pytest.mark.parametrize("u0", [0.0, 1e6])
def test_a_millionth_of_the_level_is_enough(rng, u0):
    X, y = table(rng, levels=(1e6, -1e6, 3e5), u0=u0)
    model = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
    assert error_of(model) < 1e-9


def test_constants_are_free_where_experiments_start_at_rest(rng):
    u = rng.standard_normal((100, 2))
    y = SYSTEM.simulate(u) + [4.0, -1.0]
    model = SubspaceLTI(3, horizon=6, offset="constant", initial_state="rest")
    model.fit(u, y)
    assert error_of(model) < 1e-10
    assert not model.initial_states_.any()
    np.testing.assert_allclose(model.predict(u), y, atol=1e-8)


def test_runs_between_gaps_have_constants_of_their_own(rng):
    X, y = table(rng)
    y[250] = np.nan
    y[250:400] += 5.0
    model = SubspaceLTI(3, horizon=6, missing="split", **options()).fit(X, y)
    assert error_of(model) < 1e-9
    assert model.output_offset_.shape == (4, 2)


def test_a_gain_has_a_constant(rng):
    u = rng.standard_normal((50, 1))
    model = SubspaceLTI(0, offset="constant").fit(u, 3.0 * u + 2.0)
    np.testing.assert_allclose(model.predict(u), 3.0 * u + 2.0)


@pytest.mark.broad
@pytest.mark.parametrize("seed", range(3))
def test_a_constant_is_cheaper_than_an_integrator(seed):
    """In slow noise a pole at one follows that as well, and simulates nothing."""
    rng = np.random.default_rng(seed)
    u = lfilter([0.3], [1.0, -0.95], rng.standard_normal((300, 1)), axis=0)
    e = 0.06 * rng.standard_normal((800, 1))
    v = lfilter([1.0], [1.0, -1.6, 0.62], e, axis=0)[500:]
    y = 50.0 + lfilter([0.0, 0.0, -0.4, -0.2], [1.0, -1.0, 0.3], u, axis=0) + v
    model = SubspaceLTI().fit(u, y)
    assert model.offset_ == "constant" and model.order_ == 3
    assert np.abs(model.lti_.poles()).max() < 0.9


def test_detrending_may_be_followed_by_constants(rng):
    """What transients add to the mean is an error without them."""
    X, y = table(rng)
    settings = options(horizon=6, detrend="constant")
    centred_only = SubspaceLTI(3, **settings).fit(X, y)
    both = SubspaceLTI(3, offset="constant", **settings).fit(X, y)
    assert centred_only.offset_ is None
    assert error_of(both) < 1e-9 < 1e-7 < error_of(centred_only)
    np.testing.assert_allclose(both.predict_with_initial_state(X, y), y, atol=1e-8)


# -- the pieces ------------------------------------------------------------------------


@pytest.mark.parametrize("n_trend", [1, 2])
def test_trends_are_projected_out_of_the_hankel_columns(rng, n_trend):
    records = [rng.standard_normal((n, 3)) for n in (80, 50)]
    parts = []
    for z in records:
        H = np.array([z[k : len(z) - 5 + k] for k in range(6)])
        H = H.transpose(0, 2, 1).reshape(18, -1)
        Q = np.linalg.qr(trend_signals(H.shape[1], n_trend).T)[0]
        parts.append(H - H @ Q @ Q.T)
    rows = hankel._past_future_rows(2, 1, 3)
    expected = np.hstack(parts)[rows]
    moved = [
        z + 7.0 * (1 + np.arange(len(z))[:, None] * (n_trend - 1)) for z in records
    ]
    by_gram = hankel.hankel_factor(moved, 6, rows, n_trend)
    by_qr = hankel._qr_factor(moved, 6, rows, n_trend)
    for L in (by_gram, by_qr):
        np.testing.assert_allclose(L @ L.T, expected @ expected.T, atol=1e-8)


def test_both_regressions_know_trends(rng):
    X, y = table(rng, noise=0.1)
    pairs = [(X[X[:, 2] == run, :2], y[X[:, 2] == run]) for run in range(3)]
    moved, _ = centred(pairs, 2, True)
    records = [Record.of(*pair, n_trend=2) for pair in moved]
    free = Freedom(np.ones((2, 2), bool), n_trend=2)
    states = [2, 0, 1]  # a section of one comes first
    sections, seen = A[np.ix_(states, states)], C[:, states]
    blocks = (sections[:1, :1], sections[1:, 1:])
    model = block_fit(blocks, seen, records, free)
    for k, (r, x0) in enumerate(zip(records, model.initial_states, strict=True)):
        M = _general_regression(sections, seen, r, free)
        own = np.concatenate([x0, model.trends[k].ravel()])
        known = np.concatenate([own, model.B.ravel(), model.D.ravel()])
        loss = np.sum((M[:, -1] - M[:, :-1] @ known) ** 2)
        direct = np.sum((r.y.T - model.outputs(r, k)) ** 2)
        assert loss == pytest.approx(direct)


# -- "auto" ----------------------------------------------------------------------------


def test_order_and_constants_are_found_together_without_noise(rng):
    X, y = table(rng)
    model = SubspaceLTI(**options()).fit(X, y)
    assert (model.order_, model.offset_) == (3, "constant")
    assert error_of(model) < 1e-9


def test_data_about_zero_stay_as_they_are(rng):
    X, y = table(rng, levels=(0.0, 0.0, 0.0))
    model = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
    assert model.offset_ is None
    assert not model.output_offset_.any()
    assert error_of(model) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_constants_that_are_not_there_are_hardly_ever_found(pole):
    found = 0
    for seed in range(30):
        X, y = table(
            np.random.default_rng(seed), levels=(0.0,) * 3, noise=0.5, pole=pole
        )
        auto, none = (
            SubspaceLTI(3, horizon=6, offset=offset, **options()).fit(X, y)
            for offset in ("auto", None)
        )
        found += auto.offset_ is not None
        # whether noise drifts is asked beside a constant, if there may be one
        drifts = none._evidence.whitening.of_differences
        if auto.offset_ is None and not drifts:
            np.testing.assert_array_equal(auto.lti_.A, none.lti_.A)
    assert found <= 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The simulation error depends on past inputs")
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_constants_of_the_size_of_the_noise_are_found(pole):
    errors = {"auto": [], "constant": [], None: []}
    for seed in range(4):
        X, y = table(
            np.random.default_rng(seed), levels=(2.0, -2.0, 3.0), noise=0.5, pole=pole
        )
        for offset, found in errors.items():
            # without constants noise with a slow mode of its own may stand for them
            method = "auto" if offset else "po-moesp"
            model = SubspaceLTI(3, method=method, horizon=6, offset=offset, **options())
            found.append(error_of(model.fit(X, y)))
    np.testing.assert_allclose(errors["auto"], errors["constant"])
    assert np.mean(errors["auto"]) < 0.7 * np.mean(errors[None])


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "offset"), [(0, "constant"), (2, "linear")])
def test_constants_are_seen_through_noise_of_long_memory(seed, offset):
    """Of another output, too: they are many times what that noise moves."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-3.0, 3.0, 20), 20)[:, None]
    y = lfilter([0.0, 0.2], [1.0, -0.7], u, axis=0) * [0.05, 1.0]
    slow = lfilter([0.1], [1.0, -0.995], rng.standard_normal((400, 2)), axis=0)
    y += slow * [1.0, 3.0] + 0.1 * rng.standard_normal((400, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the gain is hardly known
        model = SubspaceLTI().fit(u + 100.0, y + [1.0, 180.0])
    # Where the noise looks like a line, no state follows it.
    assert (model.order_, model.offset_) == (1, offset)


@pytest.mark.broad
@pytest.mark.parametrize("level", [0.3, 5.0, -300.0])
def test_a_level_is_no_drift(rng, level):
    u = rng.choice([-1.0, 1.0], (150, 1)).repeat(10, axis=0)
    y = StateSpace([[0.9]], [[0.1]], [[1.0]], sampling_time=1.0).simulate(u)
    y = y + 0.03 * rng.standard_normal(y.shape)
    known = SubspaceLTI(1).fit(u, y + level)._evidence
    assert known.free.n_trend == 1 and constants.chance_of_trend(known) < 1e-6
    assert not constants.drifts_off(known.one_step)
    drift = np.linspace(-0.1, 0.1, len(y))[:, None]
    options = {"offset": "constant", "method": "po-moesp"}
    slow = SubspaceLTI(1, **options).fit(u, y + level + drift)._evidence
    assert constants.drifts_off(slow.one_step)


def test_a_model_that_grows_beyond_all_squares_has_no_beginning(rng):
    u = rng.standard_normal((400, 1))
    y = lti_response(*(np.eye(1) * k for k in (0.9, 1.0, 1.0, 0.0)), u, np.zeros(1))
    known = SubspaceLTI(1).fit(u, y)._evidence
    grows = known.model._replace(
        A=np.array([[4.0]]), initial_states=np.ones((1, 1)), blocks=None
    )
    found = _as_they_begin(
        replace(known, model=grows), np.ones((1, 1, 1)), np.array([400])
    )
    assert found is None


def test_an_offset_of_an_integrators_input_is_a_line(rng):
    u = rng.standard_normal((300, 1))
    y = np.vstack([[0.0], np.cumsum(u, axis=0)[:-1]]) + 5.0
    with pytest.warns(UserWarning, match="on the border of stability"):
        model = SubspaceLTI(1, horizon=5).fit(u, y)
    assert model.offset_ is None  # the initial state has it
    np.testing.assert_allclose(model.lti_.poles(), 1.0, atol=1e-6)
    with pytest.warns(UserWarning, match="on the border of stability"):
        biased = SubspaceLTI(1, horizon=5, offset="linear").fit(u + 0.3, y)
    np.testing.assert_allclose(biased.lti_.poles(), 1.0, atol=1e-6)
    np.testing.assert_allclose(biased.lti_.B @ biased.lti_.C, 1.0, atol=1e-6)
    np.testing.assert_allclose(biased.input_offset_, 0.3, atol=1e-6)
    np.testing.assert_allclose(biased.output_drift_, 0.0)


def driven(u, pole=0.9, slow=1.0, bias=0.3):
    """A lag behind an integrator (or a slow lag), from rest, of an offset input."""
    x = lfilter([0.0, 1.0 - pole], [1.0, -pole], u + bias, axis=0)
    return lfilter([0.0, 0.1], [1.0, -slow], x, axis=0)


def held(rng, n, every=10):
    return np.repeat(rng.choice([-1.0, 1.0], (-(-n // every), 1)), every, axis=0)[:n]


def fit_of(model, X, y):
    left = np.linalg.norm(y - model.predict(X).reshape(y.shape))
    return 1.0 - left / np.linalg.norm(y - y.mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"order": 2}, {"order": 1, "integrating": True}]
)
def test_an_offset_of_a_motors_input_is_found_and_predicted(options):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u, fresh = held(rng, 1500), held(rng, 1000)
        y = driven(u) + 0.01 * rng.standard_normal(u.shape)
        model = SubspaceLTI(**options).fit(u, y)
        assert model.order_ == 2
        np.testing.assert_allclose(model.input_offset_, -0.3, atol=5e-3)
        np.testing.assert_allclose(model.output_drift_, 0.0)
        assert fit_of(model, fresh, driven(fresh)) > 0.98


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Output 1 drifts along a line")
@pytest.mark.parametrize("size", [0.5, 10.0])
@pytest.mark.parametrize("every", [1, 10])
def test_a_drift_is_not_followed_by_a_state(size, every):
    """A mode that does not decay would follow it, and go on where inputs drive it."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u, fresh = held(rng, 1000, every), held(rng, 500, every)
        y, there = (
            lfilter([0.0, 0.2, 0.1], [1.0, -1.5, 0.7], v, 0) for v in (u, fresh)
        )
        drift = size * y.std() * np.linspace(-1.0, 1.0, len(y))[:, None]
        noisy = y + drift + 0.05 * y.std() * rng.standard_normal(y.shape)
        model = SubspaceLTI(sampling_time=0.5).fit(u, noisy)
        assert model.order_ == 2 and model.offset_ == "linear"
        found = model.output_drift_.item() * 0.5 * (len(y) - 1)
        assert found == pytest.approx(np.ptp(drift), rel=0.05)
        assert fit_of(model, fresh, there) > 0.95


@pytest.mark.slow
def test_a_ramp_that_an_early_step_makes_of_an_integrator_is_no_drift():
    """As a line it would be as likely: inputs that explain it have the first word."""
    f = np.sign(np.sin(6 * np.pi * np.arange(300) / 300 + 1e-9))[:, None]
    u = (np.arange(300) >= 15).astype(float)[:, None]
    for seed in range(1, 3):
        rng = np.random.default_rng(seed)
        y = driven(u, bias=0.0)
        noisy = y + 0.03 * y.std() * rng.standard_normal(y.shape)
        model = SubspaceLTI(sampling_time=1.0).fit(u, noisy)
        assert model.offset_ is None
        assert np.abs(model.lti_.poles()).max() == pytest.approx(1.0, abs=2e-3)
        assert fit_of(model, f, driven(f, bias=0.0)) > 0.8


def test_offsets_of_the_input_of_several_experiments_differ():
    rng = np.random.default_rng(0)
    u, biases = held(rng, 2400), (0.3, -0.1, 0.2)
    y = [driven(part, bias=b) for part, b in zip(np.split(u, 3), biases, strict=True)]
    y = np.vstack(y) + 0.01 * rng.standard_normal(u.shape)
    X = np.column_stack([u, np.repeat(range(3), 800)])
    model = SubspaceLTI(experiment=1).fit(X, y)
    np.testing.assert_allclose(-model.input_offset_[:, 0], biases, atol=5e-3)


@pytest.mark.slow
def test_a_slow_plant_that_begins_at_rest_is_predicted_from_there():
    """The constant alone does not tell where it rests: far from all it has reached."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u, fresh = held(rng, 1500), held(rng, 1000)
        y = driven(u, slow=1.0 - 1.0 / 3000)
        y = y + 0.01 * rng.standard_normal(u.shape)
        model = SubspaceLTI().fit(u, y)
        assert fit_of(model, fresh, driven(fresh, slow=1.0 - 1.0 / 3000)) > 0.95


@pytest.mark.slow
def test_a_slow_plant_rests_where_it_began_not_at_the_means_of_its_inputs():
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u, fresh = held(rng, 4000), held(rng, 1000)
        y = 20.0 + driven(u, slow=0.999, bias=0.0)
        model = SubspaceLTI().fit(u + 3.0, y + 0.01 * rng.standard_normal(u.shape))
        there = 20.0 + driven(fresh, slow=0.999, bias=0.0)
        assert model.offset_ == "constant"
        assert fit_of(model, fresh + 3.0, there) > 0.95


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The response is hardly known")
@pytest.mark.parametrize("seed", [7, 13])
def test_a_step_from_rest_at_a_level_has_a_constant(seed):
    """Without it, three lags or more balance each other until the step comes."""
    rng = np.random.default_rng(seed)
    u = 40.0 * (np.arange(200) >= 30)
    y = u
    for pole in np.exp(-1.0 / (200 * rng.uniform(0.05, 0.2, 3))):
        y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y)
    y = 25.0 + 0.5 * y + 0.05 * rng.standard_normal(200)
    model = SubspaceLTI().fit(u[:, None], y)
    assert model.offset_ == "constant"
    assert model.lti_.dc_gain().item() == pytest.approx(0.5, rel=0.3)  # without: 1.1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # of searches that end elsewhere
def test_what_stands_still_is_at_rest_in_a_model_that_explains_it():
    """A start at a level, for which a model without constants needs a coincidence.

    None is to begin at rest, be it before a step that three lags have yet to follow.
    """
    u = np.zeros((200, 1))
    u[20:] = 1.0
    A = 0.95 * np.eye(3) + 0.05 * np.eye(3, k=-1)
    plant = StateSpace(A, 0.05 * np.eye(3)[:, :1], np.eye(3)[2:], None, 1.0)
    rng, told = np.random.default_rng(0), []
    for level, signal in ((0.0, u), (0.0, 1.0 - u), *[(5.0, u)] * 3):
        y = plant.simulate(signal) + level + 1e-3 * rng.standard_normal(u.shape)
        found = SubspaceLTI(3, offset=None).fit(signal, y)
        if found.residual_ * np.sqrt(np.mean(y**2)) < 5e-3:
            told.append((level, stands_by_chance(found._evidence.one_step)))
    assert told.count((0.0, False)) == 2
    assert told.count((5.0, True)) == len(told) - 2 > 0


@pytest.mark.parametrize("better, taken", [(29.0, False), (31.0, True)])
def test_where_slow_modes_hide_constants_the_criterion_decides(
    better, taken, monkeypatch
):
    u = np.repeat(np.random.default_rng(0).standard_normal((50, 1)), 8, axis=0)
    y = StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0).simulate(u)
    y = y + 0.01 * np.random.default_rng(1).standard_normal(y.shape)
    without, other = (
        SubspaceLTI(1, offset=offset).fit(u, y)._evidence.one_step
        for offset in (None, "constant")
    )
    monkeypatch.setattr(constants, "chance_of_trend", lambda *_, **__: 1.0)
    without.__dict__["criterion"], other.__dict__["criterion"] = better, 0.0
    assert constants.constants_matter(without, other) == taken


def test_short_step_responses_are_not_spoilt():
    """All windows of the input are constant: a constant would take the gain."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        X, Y = [], []
        for run in range(6):
            u = np.full((40, 1), rng.choice([-1.0, 1.0]) * (1 + run % 3))
            y = lfilter([0.0, 0.2], [1.0, -0.8], u[:, 0])
            X.append(np.column_stack([u, np.full(40, run)]))
            Y.append(y + 0.05 * rng.standard_normal(40))
        data = np.vstack(X), np.concatenate(Y)
        model = SubspaceLTI(1, horizon=4, experiment=1, initial_state="rest")
        assert model.fit(*data).offset_ is None
        assert model.lti_.frequency_response([1e-3])[0, 0, 0].real == pytest.approx(
            1.0, abs=0.05
        )


@pytest.mark.broad
@pytest.mark.parametrize("seed", [5, 9, 40])
def test_a_step_test_about_a_level_has_a_constant(seed):
    """Slow lags, of which the record does not tell whether their line meets zero."""
    rng = np.random.default_rng(5000 + seed)
    n = int(rng.choice([200, 300, 500]))
    slow = n / float(rng.choice([1, 2, 4, 8])) * rng.uniform(0.3, 0.7)
    gain, at, level = rng.uniform(1, 20), rng.uniform(1, 60), rng.uniform(10, 400)
    fast, step = n - slow, at * rng.uniform(0.05, 0.15)
    A = [[-1 / slow, 0.0], [1 / fast, -1 / fast]]
    plant = StateSpace(A, [[gain / slow], [0.0]], [[0.0, 1.0]])

    def record(first, second):
        moved = step * (np.arange(n) >= 20) * first
        moved[n // 2 :] = step * second
        return plant.simulate(moved[:, None], sampling_time=1.0), at + moved[:, None]

    y, u = record(1.0, -0.7)
    noisy = y + level + 0.01 * np.ptp(y) * rng.standard_normal(y.shape)
    model = SubspaceLTI(sampling_time=1.0).fit(u, noisy)
    fresh, inputs = record(0.6, -0.4)
    assert model.offset_ == "constant"
    assert fit_of(model, inputs, fresh + level) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_level_of_an_integrators_input_is_no_second_integrator(seed):
    """Beside a pole next to one its constant is far beyond all outputs."""
    rng = np.random.default_rng(seed)
    plant = StateSpace(
        [[1.0, 0.1], [0.0, 0.96]], [[0.0], [0.4]], [[1.0, 0.0]], None, 1.0
    )
    X, y = [], []
    for run in range(4):
        u = rng.standard_normal((420, 1))
        X.append(np.hstack([u + 30.0, np.full((420, 1), run)]))
        y.append(plant.simulate(u))
    y = np.vstack(y)
    noisy = np.round(y + 0.02 * y.std() * rng.standard_normal(y.shape), 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it may be on the border
        model = SubspaceLTI(experiment=1).fit(np.vstack(X), noisy)
    assert (model.order_, model.offset_) == (2, "constant")
    assert fit_of(model, np.vstack(X), y) > 0.9


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_simulations_of_far_signals_begin_there(seed):
    """Whether or not the line of rest meets zero, as it does here."""
    rng = np.random.default_rng(seed)
    plant = StateSpace([[0.98]], [[0.3]], [[1.0]], None, 1.0)
    u = 30.0 + rng.standard_normal((2, 400, 1))
    y = [plant.simulate(one - 30.0) + 450.0 for one in u]
    noisy = y[0] + 0.02 * y[0].std() * rng.standard_normal(y[0].shape)
    model = SubspaceLTI().fit(u[0], noisy)
    assert model.offset_ == "constant"
    assert fit_of(model, u[1], y[1]) > 0.7  # it begins at the mean of the inputs


# -- use -------------------------------------------------------------------------------


def test_prediction_rests_at_the_common_offset(rng):
    """An experiment that stands at rest before its first sample."""
    u = np.vstack([np.zeros((20, 2)), rng.standard_normal((300, 2))])
    y = SYSTEM.simulate(u) + [50.0, -20.0]
    model = SubspaceLTI(3, horizon=6).fit(u + [4.0, 1.0], y)
    u0, y0 = model.input_offset_[0], model.output_offset_[0]
    still = model.predict(np.tile(u0, (5, 1)))
    np.testing.assert_allclose(still, np.tile(y0, (5, 1)))
    found = model.predict(u + u0)
    np.testing.assert_allclose(found - y0, SYSTEM.simulate(u), atol=1e-8)


@pytest.mark.parametrize("levels", [(0.0, 0.0, 0.0), (5.0, -3.0, 0.4)])
def test_levels_of_other_records_are_estimated(rng, levels):
    """Whether the samples of the fit had any, unless they are known to be zero."""
    X, y = table(rng, levels=levels)
    model = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
    assert (model.offset_ is None) == (not any(levels))
    other = y + [7.0, -2.0]
    simulated = model.predict_with_initial_state(X, other)
    np.testing.assert_allclose(simulated, other, atol=1e-8)
    ahead = model.predict_ahead(X, other, steps=50)
    np.testing.assert_allclose(ahead, other, atol=1e-8)


@pytest.mark.parametrize("n_known", [5, 20])
def test_few_known_samples_tell_no_level_from_a_slow_state(n_known):
    rng, pole = np.random.default_rng(3), np.exp(-1.0 / 400.0)
    plant = StateSpace([[pole]], [[0.1]], [[1.0]], None, 1.0)
    u, fresh = (rng.standard_normal((40, 1)).repeat(20, axis=0) for _ in range(2))
    y, target = plant.simulate(u), plant.simulate(fresh, initial_state=[3.0])
    noise = 0.05 * y.std() * rng.standard_normal((2, *y.shape))
    model = SubspaceLTI(sampling_time=1.0, missing="split").fit(u, y + noise[0])
    assert model.offset_ is None
    known = target + noise[1]
    known[n_known:] = np.nan
    error = (model.predict_with_initial_state(fresh, known) - target)[n_known:]
    assert error.std() < 0.03 * y.std()


def test_levels_that_are_known_to_be_zero_are_not_estimated(rng):
    X, y = table(rng, levels=(0.0, 0.0, 0.0))
    model = SubspaceLTI(3, horizon=6, offset=None, **options()).fit(X, y)
    np.testing.assert_allclose(model.predict_with_initial_state(X, y), y, atol=1e-8)
    found = model.predict_with_initial_state(X, y + 7.0)
    assert (np.abs(np.mean(y + 7.0 - found, axis=0)) > 5.0).all()


@pytest.mark.parametrize("level", [1e2, 1e4, 1e6])
def test_constants_are_found_far_from_zero(rng, level):
    u = rng.standard_normal((400, 2))
    y = SYSTEM.simulate(u) + 0.1 * rng.standard_normal((400, 2))
    model = SubspaceLTI(3, horizon=6).fit(u + level, y + 0.1 * level)
    assert model.offset_ == "constant"
    assert error_of(model) < 0.1


@pytest.mark.broad
@pytest.mark.parametrize("level", [6.0, None])
def test_constants_of_what_stays_far_from_zero_are_taken_in_slow_noise(level):
    """The gain explains means as well, at 1.5 instead of 2: the noise hides that.

    From rest at zero there are none, and zero is a point of the answer.
    """
    taken, gains = 0, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.standard_normal(50), 8)
        y = 0.5 * lfilter([0.44], [1.0, -0.9], rng.standard_normal(400))
        if level is None:
            y += lfilter([0.0, 0.2], [1.0, -0.9], u + 4.0)
        else:
            y += lfilter([0.0, 0.2], [1.0, -0.9], u) + level
        model = SubspaceLTI(1, horizon=6).fit(u[:, None] + 4.0, y)
        taken += model.offset_ is not None
        gains.append(model.lti_.dc_gain().item())
    assert taken == (0 if level is None else 6)
    np.testing.assert_allclose(np.mean(gains), 2.0, atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_drift_does_not_hide_constants_far_from_zero(seed):
    rng = np.random.default_rng(seed)
    A, B, C = [[0.97, 0.0], [0.18, 0.82]], [[0.07], [0.0]], [[0.0, 1.0]]
    plant = StateSpace(A, B, C, None, 1.0)
    u = np.repeat(rng.uniform(-1.0, 1.0, (9, 1)), 100, axis=0)
    y = plant.simulate(u)
    drift = 0.01 * np.cumsum(rng.standard_normal(y.shape), axis=0)
    noise = 0.02 * rng.standard_normal(y.shape)
    model = SubspaceLTI(2).fit(u + 6.0, y + y.std() * (drift + noise) + 10.0)
    fresh = np.repeat(rng.choice([-1.0, 1.0], (160, 1)), 5, axis=0)
    assert model.offset_ == "constant"
    assert bft_score(plant.simulate(fresh), model.lti_.simulate(fresh)) > 93.0


def test_prediction_warns_where_inputs_stay_about_another_level(rng):
    plant = StateSpace([[-0.05]], [[0.15]], [[1.0]])
    u = np.repeat(rng.choice([-1.0, 1.0], (200, 1)), 8, axis=0)
    u[800:] += 5.0
    halves = [plant.simulate(half, sampling_time=0.5) for half in np.split(u, 2)]
    halves[1] = 15.0 + plant.simulate(u[800:] - 5.0, sampling_time=0.5)
    y = 20.0 + np.vstack(halves) + 0.02 * rng.standard_normal((1600, 1))
    run = np.repeat([0.0, 1.0], 800)
    model = SubspaceLTI(1, experiment=1, sampling_time=0.5)
    model.fit(np.column_stack([u, run]), y)
    told = r"experiment 0.0 stay about .* begins at rest .*\(`input_offset_`\)"
    X = np.column_stack([u[:800], run[:800]])
    with pytest.warns(UserWarning, match=told):
        outputs = model.predict(X)
    assert abs(outputs[0, 0] - 27.5) < 1.0  # between 20 and 35
    assert bft_score(y[:800], model.predict_with_initial_state(X, y[:800])) > 98.0
    X[:, 0] += 2.5
    model.predict(X)


def test_prediction_warns_where_constants_differ(rng):
    X, y = table(rng, noise=0.1)
    model = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
    with pytest.warns(UserWarning, match="have different constants in their outputs"):
        model.predict(X)
    score = make_bft_scorer(initial_state="estimate")(model, X, y)
    assert score > 99.0
    ahead = model.predict_ahead(X, y, steps=2)
    assert np.abs(ahead - y).std() < 0.15
    same = SubspaceLTI(3, horizon=6, **options())
    X, y = table(rng, levels=(5.0, 5.0, 5.0), noise=0.1)
    assert same.fit(X, y).offset_ == "constant"
    with pytest.warns(UserWarning, match="mid-motion"):  # at rest, not about the mean
        assert same.score(X, y) > 0.97


@pytest.mark.slow
def test_residual_tests_allow_for_constants():
    passed = []
    for seed in range(4):
        X, y = table(np.random.default_rng(seed), n=400, noise=0.3, u0=3.0)
        model = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
        passed += list(model.residual_tests(X, y)["passed"])
        passed += list(model.residual_tests(X, y, errors="prediction")["passed"])
    assert np.mean(passed) > 0.97


def test_labels_of_dataframes_do_not_matter(rng):
    X, y = table(rng, noise=0.1)
    named = pd.DataFrame(X, columns=["a", "b", "run"]).astype({"run": int})
    named["run"] = named["run"].map({0: "x", 1: "z", 2: "y"})
    first = SubspaceLTI(3, horizon=6, experiment="run").fit(named, y)
    other = SubspaceLTI(3, horizon=6, **options()).fit(X, y)
    np.testing.assert_array_equal(first.output_offset_, other.output_offset_)


def test_options_teach():
    with pytest.raises(ValueError, match="`offset` must be 'auto', None, 'constant'"):
        SubspaceLTI(offset="mean").fit(np.zeros((9, 1)), np.zeros(9))


@pytest.mark.parametrize("shape", [(10, 3), (15, 4), (5, 1), (3, 1)])
@pytest.mark.parametrize("offset", ["auto", "constant", "linear"])
def test_tiny_tables_are_fitted(rng, shape, offset):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        X, y = rng.standard_normal(shape), rng.standard_normal(shape[0])
        assert SubspaceLTI(offset=offset).fit(X, y).predict(X).shape == y.shape


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_deviations_cover_the_truth_with_constants(pole):
    """95 % of the poles and responses within 1.96 standard deviations."""
    inside = []
    truth = SYSTEM.frequency_response([0.05, 0.5, 2.0])
    for seed in range(50):
        rng = np.random.default_rng(seed)
        X, y = table(rng, levels=(3.0, -2.0), n=500, noise=0.5, pole=pole)
        model = SubspaceLTI(3, horizon=6, offset="constant", **options()).fit(X, y)
        std = model.frequency_response_std([0.05, 0.5, 2.0])
        error = model.lti_.frequency_response([0.05, 0.5, 2.0]) - truth
        inside.append(np.abs(error.real) < 1.96 * std.real)
        inside.append(np.abs(error.imag) < 1.96 * std.imag)
    assert 0.92 < np.mean(inside) < 0.975


# -- streams ---------------------------------------------------------------------------


@pytest.mark.broad
@pytest.mark.parametrize("offset", ["auto", "constant", "linear"])
def test_long_tables_and_streams_have_constants(system, short_stream, offset):
    u, y = record(system, 9000)
    y = y + [40.0, -300.0]
    stream = fed(SubspaceLTI(5, horizon=8, offset=offset), u, y, [2500, 3500, 3000])
    whole = SubspaceLTI(5, horizon=8, offset=offset).fit(u, y)
    plain = SubspaceLTI(5, horizon=8, offset=None).fit(u, y - [40.0, -300.0])
    G = plain.lti_.frequency_response(OMEGA)
    for model in (stream, whole):
        assert model.offset_ == ("linear" if offset == "linear" else "constant")
        gap = np.abs(model.lti_.frequency_response(OMEGA) - G).max()
        assert gap < 0.02 * np.abs(G).max()
        rest = model.lti_.D + model.lti_.C @ np.linalg.solve(
            np.eye(5) - model.lti_.A, model.lti_.B
        )
        constant = model.output_offset_[0] - rest @ model.input_offset_[0]
        np.testing.assert_allclose(constant, [40.0, -300.0], rtol=0.01)
    np.testing.assert_allclose(
        stream.lti_.frequency_response(OMEGA), whole.lti_.frequency_response(OMEGA)
    )


def test_experiments_of_a_long_table_have_their_own_constants(system, short_stream):
    u, y = record(system, 9000)
    run = np.repeat([0, 1, 2], 3000)
    levels = np.array([5.0, -80.0, 30.0])[:, None] * [1.0, 2.0]
    X = np.column_stack([u, run])
    model = SubspaceLTI(5, horizon=8, experiment=2).fit(X, y + levels[run])
    assert model.output_offset_.shape == (3, 2)
    np.testing.assert_allclose(model.output_offset_, levels, rtol=0.2, atol=3.0)


@pytest.mark.parametrize("seed", range(4))
def test_constants_that_bend_a_slow_pole_are_found(seed):
    """Errors that a constant explains are no coloured noise."""
    rng, step = np.random.default_rng(seed), 2.0
    heater = StateSpace(-0.014, 0.004, 1.0)
    u = 500.0 + 300.0 * rng.choice([-1.0, 1.0], 30).repeat(20)
    y = heater.simulate(u, sampling_time=step, initial_state=[140.0])[:, 0] + 21.0
    y += 0.3 * rng.standard_normal(len(u))
    model = SubspaceLTI(1, feedthrough=False, sampling_time=step).fit(u[:, None], y)
    assert model.offset_ == "constant"
    pole = model.lti_.to_continuous().poles().real
    np.testing.assert_allclose(pole, -0.014, rtol=0.02)


@pytest.mark.parametrize(
    "choice", [{"refine": False}, {"refine": False, "initial_state": "rest"}]
)
def test_rough_models_do_not_hide_constants(choice):
    """Without constants a slow mode would stand for them."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u = rng.choice([-1.0, 1.0], (250, 2))
        y = SYSTEM.simulate(u)
        y = y + 0.1 * y.std(axis=0) * rng.standard_normal(y.shape)
        y = y + 3.0 * y.std(axis=0)
        model = SubspaceLTI(3, horizon=10, feedthrough=False, **choice).fit(u, y)
        assert model.offset_ == "constant"
        assert error_of(model) < 0.1


@pytest.mark.broad
@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_too_few_states_do_not_follow_the_level(seed):
    """Of a record far from zero, a state that stands for it is not there to move."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.97], rng.standard_normal((300, 1)), axis=0)
    y = 53.0 - lfilter([0.0, 0.0, 0.0, 0.5, 0.4], [1.0, -0.6], u, axis=0)
    y += lfilter([0.3], [1.0, -1.5, 0.6], rng.standard_normal((300, 1)), axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of lacking states
        model = SubspaceLTI(1).fit(u, y)
    assert model.offset_ == "constant"
    assert np.std(y - model.predict_with_initial_state(u, y)) < 0.3 * np.std(y)
    if seed == 0:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            SubspaceLTI(1, offset=None).fit(u, y)
        assert any("nothing of how they move" in str(w.message) for w in told)


@pytest.mark.slow
def test_a_step_from_rest_tells_that_there_is_no_constant():
    """The input is far from zero nearly all the time, and began at it."""
    u = (np.arange(500) >= 20).astype(float)[:, None]
    for rng in map(np.random.default_rng, range(4)):
        y = lfilter([0.0, 0.01], [1.0, -0.99], u, axis=0)
        y += 0.003 * rng.standard_normal(y.shape)
        model = SubspaceLTI().fit(u, y)
        assert model.offset_ is None
        assert model.score(u, y) > 0.95


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # of the integrator
def test_a_constant_and_an_integrator_do_not_stand_for_a_drift():
    """An offset of the input behind an integrator is a ramp of the output."""
    for rng in map(np.random.default_rng, range(4)):
        u = np.repeat(np.sign(rng.standard_normal((200, 1))), 5, axis=0)
        y = lfilter([0.0, 0.01], [1.0, -1.0], u, axis=0)
        y += 1e-3 * y.std() * rng.standard_normal(y.shape)
        model = SubspaceLTI().fit(u + 0.5, y)
        assert np.abs(model.output_offset_).max() < 10.0 * np.abs(y).max()
        assert np.abs(model.predict(u + 0.5)).max() < 20.0 * np.abs(y).max()


@pytest.mark.slow
def test_a_given_order_has_no_state_that_stands_for_the_constants():
    """Its initial values may be those of a state that does not decay."""
    for rng in map(np.random.default_rng, range(6)):
        system = random_system(rng, rng.uniform(1.0, 60.0))
        model = SubspaceLTI(3, horizon=10, experiment="run")
        model.fit(*offsets_table(rng, system, 10.0))
        assert model.offset_ == "constant"
        assert relative_error(model, system) < 0.07  # .11 to .15 without constants


@pytest.mark.parametrize("order", ["auto", 2])
def test_a_step_is_no_shift_of_the_output(order):
    """Of parts about it every one has an input that rests."""
    p, q = np.exp([-0.01 * 2.0236432494005134, -0.01 * 14.554173266933418])
    u = (np.arange(500) >= 50).astype(float)[:, None]
    y = (1.0 - p) / 2.0236 * lfilter([0.0, 1.0], [1.0, -p], u, axis=0)
    y += 0.459487 * (1.0 - q) / 14.554 * lfilter([0.0, 1.0], [1.0, -q], u, axis=0)
    model = SubspaceLTI(order).fit(u, y)
    assert model.offset_ is None
    np.testing.assert_allclose(np.sort(model.lti_.poles()), [q, p], atol=1e-6)


def test_signals_without_any_noise_tell_of_no_constants():
    """Two outputs that are one signal leave a direction without errors."""
    nothing = np.zeros((1, 2, 3, 1))
    assert _tail(np.zeros(1), nothing, np.eye(2), 10.0) == 1.0


def test_a_mode_that_inputs_hardly_move_is_no_better_than_a_constant():
    """Beside slow noise it seems as likely."""
    rng = np.random.default_rng(24)
    n_samples, hold = int(rng.integers(200, 900)), int(rng.integers(5, 40))
    u = np.repeat(rng.uniform(0.0, 1.0, n_samples // hold + 1), hold)[:n_samples]
    pole = np.exp(-rng.uniform(0.3, 2.0) / hold)
    y = lfilter([0.0, 1.0 - pole], [1.0, -pole], u)
    colour, size = rng.uniform(0.0, 0.95), y.std()
    v = lfilter([1.0], [1.0, -colour], rng.standard_normal(n_samples))
    y += rng.uniform(0.03, 0.4) * size * v / v.std()
    y += rng.uniform(0.3, 2.0) * size * rng.choice([-1.0, 1.0])
    model = SubspaceLTI(sampling_time=1.0).fit(u[:, None], y)
    assert (model.order_, model.offset_) == (1, "constant")
    assert model.lti_.poles().item().real == pytest.approx(pole, abs=0.002)
    assert model.lti_.dc_gain().item() == pytest.approx(1.0, abs=0.01)


def test_a_slow_mode_less_leaves_what_is_seen_of_the_others(rng):
    A = modes(0.9 * np.exp(0.4j), 0.7, 0.9999)
    B, C = rng.standard_normal((4, 1)), rng.standard_normal((2, 4))
    u = rng.standard_normal((1000, 1))
    y = StateSpace(A, B, C, None, 1.0).simulate(u)
    evidence = SubspaceLTI(4, horizon=10, offset=None).fit(u, y)._evidence
    ((found, seen),) = without_slow_modes(evidence)
    values, vectors = np.linalg.eig(found)
    poles, states = np.linalg.eig(evidence.model.A)
    assert len(values) == 3
    for value, vector in zip(values, (seen @ vectors).T, strict=True):
        k = np.abs(poles - value).argmin()
        assert poles[k] == pytest.approx(value, rel=1e-9) and poles[k].real < 0.99
        other = evidence.model.C @ states[:, k]
        ratio = vector / other
        assert ratio[0] == pytest.approx(ratio[1], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_a_mode_slower_than_the_record_is_told_from_a_constant(size):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        A, B = modes(0.7, 1.0 - 1e-4), np.array([[0.7], [0.014]])
        u = rng.standard_normal((3000, 1))
        y = StateSpace(A[:1, :1], B[:1], [[1.0]], None, 1.0).simulate(u)
        if size == 0.0:
            y = StateSpace(A, B, [[1.0, 1.0]], None, 1.0).simulate(u)
        noise = 0.3 * y.std() * rng.standard_normal(y.shape)
        model = SubspaceLTI().fit(u, y + size + noise)
        assert model.offset_ == (None if size == 0.0 else "constant")
        assert model.order_ == (2 if size == 0.0 else 1)


def test_an_output_far_off_its_range_is_no_place_to_rest():
    y = np.array([[2.0], [10.0], [4.0]])
    assert not far_off(np.array([[-5.0], [18.0]]), [y, y + 1.0])
    assert far_off(np.array([[-24.0], [5.0]]), [y, y + 1.0])


def _tanks(rng, n=1024):
    """Two tanks in a row: pump voltages (n, 1) and the lower level.

    They flow out by the root of their levels, and over at the rim.
    """
    k = np.arange(1, 40)
    phases = 2.0 * np.pi * np.outer(np.arange(n), k) / n + rng.uniform(0, 6.28, k.size)
    u = (np.sin(phases) / np.sqrt(k)).sum(axis=1)
    u = np.maximum(2.8 + 1.1 * u / u.std(), 0.3)
    x, y = np.array([4.0, 5.0]), np.empty((n, 1))
    for t in range(n):
        y[t] = x[1]
        for _ in range(4):
            upper, lower = np.sqrt(np.maximum(x, 0.0))
            flows = 0.05 * u[t] - 0.06 * upper, 0.06 * upper - 0.05 * lower
            x = np.minimum(x + flows, [12.0, 10.0])
    return u[:, None], y + 0.02 * rng.standard_normal(y.shape)


@pytest.mark.filterwarnings("ignore")  # of limits, and of what is not linear
def test_a_given_order_has_constants_where_channels_are_off_zero():
    """Two and a half standard deviations: slow states took their place."""
    u, y = _tanks(np.random.default_rng(2))
    model = SubspaceLTI(2).fit(u, y)
    assert model.offset_ == "constant"
    others, measured = _tanks(np.random.default_rng(102))
    assert bft_score(measured, model.predict(others)) > 70.0


def test_poles_far_outside_leave_outputs_where_they_are():
    """Of two that nearly cancel each other the static gain may overflow."""
    model = Realization(
        np.diag([470.0, -470.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)),
        np.zeros((1, 2)), 1.0, trends=np.zeros((1, 1, 1)),
    )  # fmt: skip
    evidence = SimpleNamespace(
        model=model,
        output_scale=np.ones(1),
        free=Freedom(np.ones((1, 1), bool), True, 1),
        state_space=lambda *_: SimpleNamespace(dc_gain=lambda: np.full((1, 1), np.inf)),
    )
    centres = SimpleNamespace(trends=np.full((1, 1, 1), 3.0), inputs=np.ones((1, 1)))
    u = np.random.default_rng(0).standard_normal((50, 1))
    found = attributed(evidence, centres, [(u, u)])
    assert np.isfinite(found.outputs).all() and np.isfinite(found.constants).all()


def test_signals_far_from_zero_are_chosen_for_with_their_constants(rng):
    """As where these are asked for: none without them comes near."""
    X, y = table(rng, levels=(50.0, 100.0), noise=0.1, u0=10.0)
    found, asked = (
        SubspaceLTI(experiment=2, sampling_time=1.0, offset=offset).fit(X, y)
        for offset in ("auto", "constant")
    )
    assert found.offset_ == "constant"
    assert found.selection_.equals(asked.selection_)
    np.testing.assert_array_equal(found.lti_.A, asked.lti_.A)
