"""Gaps, trends, known zeros, stability, poor horizons, and what must hold."""

import warnings
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter, tf2ss

from lpvlearn import StateSpace, SubspaceLTI, bft_score
from lpvlearn.data.faulty_signals import drops_out, stays_put
from lpvlearn.data.preparation import remove_trends
from lpvlearn.exceptions import RankWarning
from lpvlearn.subspace.diagnosis.fit_warnings import warn_about
from lpvlearn.subspace.fit import fit_samples
from lpvlearn.subspace.fits.one_fit import Samples
from lpvlearn.subspace.fits.options import Choices, check_options
from lpvlearn.subspace.telling import Telling, unheard
from lpvlearn.systems.simulation import lti_response

A = 0.9 * np.array([[np.cos(0.6), np.sin(0.6)], [-np.sin(0.6), np.cos(0.6)]])
SYSTEM = (
    A,
    np.array([[1.0, 0.3], [0.4, -1.0]]),
    np.array([[1.0, 0.5], [0.2, -1.0]]),
    np.array([[0.3, 0.0], [0.0, 0.7]]),
)
POLES = np.sort_complex(np.linalg.eigvals(A))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def record(rng, n_samples=400, x0=None):
    u = rng.standard_normal((n_samples, 2))
    return u, lti_response(*SYSTEM, u, x0)


def poles_of(model):
    return np.sort_complex(model.lti_.poles())


def test_gaps_split_an_experiment_where_asked_for(rng):
    u, y = record(rng)
    X, Y = u.copy(), y.copy()
    X[100, 0], Y[200:215, 1], X[300, 1] = np.nan, np.nan, np.nan
    with pytest.raises(ValueError, match="contains NaN"):
        SubspaceLTI(2, horizon=5).fit(X, Y)
    model = SubspaceLTI(2, horizon=5, missing="split").fit(X, Y)
    np.testing.assert_allclose(poles_of(model), POLES, atol=1e-9)
    assert model.initial_states_.shape == (4, 2)
    fitted = model.predict_with_initial_state(X, Y)
    complete = np.isfinite(X).all(axis=1) & np.isfinite(Y).all(axis=1)
    np.testing.assert_allclose(fitted[complete], y[complete], atol=1e-8)
    # Outputs need not be there to be simulated; inputs must.
    unknown = np.isnan(X).any(axis=1)
    np.testing.assert_allclose(fitted[~unknown], y[~unknown], atol=1e-8)
    assert np.isnan(fitted[unknown]).all()
    # A simulation from rest needs every input.
    with pytest.raises(ValueError, match="contains NaN"):
        model.predict(X)
    np.testing.assert_allclose(model.predict(u), y, atol=1e-8)


def test_infinity_is_refused_even_where_gaps_split(rng):
    u, y = record(rng)
    u[3, 0] = np.inf
    with pytest.raises(ValueError, match="infinity"):
        SubspaceLTI(missing="split").fit(u, y)
    with pytest.raises(ValueError, match="consecutive complete samples"):
        SubspaceLTI(missing="split").fit(np.full((20, 1), np.nan), np.zeros(20))


@pytest.mark.parametrize("detrend, drift", [("constant", 0.0), ("linear", 0.05)])
def test_offsets_and_drifts_are_removed_experiment_by_experiment(rng, detrend, drift):
    parts, t = [], np.arange(3000.0)[:, None]
    for run, level in enumerate((5.0, -20.0)):
        u, y = record(rng, 3000)
        y = y + level + drift * t
        parts.append(pd.DataFrame(u, columns=["u1", "u2"]).assign(run=run, y1=y[:, 0]))
    data = pd.concat(parts)
    X, y = data[["u1", "u2", "run"]], data["y1"]
    options = {"experiment": "run", "horizon": 8}
    model = SubspaceLTI(2, detrend=detrend, **options).fit(X, y)
    np.testing.assert_allclose(poles_of(model), POLES, atol=5e-3)
    assert model.output_offset_.mean() == pytest.approx(y.mean())
    assert model.predict(X).mean() == pytest.approx(y.mean(), abs=1.0)


def test_detrending_subtracts_the_least_squares_line(rng):
    pairs = [record(rng, n) for n in (50, 80)]
    cleaned, u0, _ = remove_trends(pairs, "linear")
    for (u, _), (v, _) in zip(pairs, cleaned, strict=True):
        t = np.arange(len(u))
        line = np.polyfit(t, u, 1)
        np.testing.assert_allclose(v, u - np.outer(t, line[0]) - line[1], atol=1e-12)
    np.testing.assert_allclose(u0, [u.mean(axis=0) for u, _ in pairs])


@pytest.mark.parametrize("refine", [True, False])
def test_known_zeros_of_D_stay_zero(rng, refine):
    u, y = record(rng, 2000)
    y = y + 0.05 * rng.standard_normal(y.shape)
    known = np.array([[True, False], [False, True]])
    model = SubspaceLTI(2, horizon=8, feedthrough=known, refine=refine).fit(u, y)
    assert not model.lti_.D[~known].any()
    np.testing.assert_allclose(model.lti_.D[known], [0.3, 0.7], atol=0.02)
    with pytest.raises(ValueError, match=r"\(n_outputs, n_inputs\) = \(2, 2\)"):
        SubspaceLTI(2, feedthrough=[True, False]).fit(u, y)


@pytest.mark.filterwarnings("ignore:Output 1 is .* in all samples")
def test_enforced_stability_is_guaranteed_and_its_price_reported(rng):
    u = rng.standard_normal((300, 1))
    unstable = tuple(np.array([[v]]) for v in (1.02, 1.0, 1.0, 0.0))
    y = lti_response(*unstable, u)
    model = SubspaceLTI(1, horizon=5, stability="enforce").fit(u, y)
    assert model.lti_.is_stable
    with pytest.warns(UserWarning, match="unstable"):
        free = SubspaceLTI(1, horizon=5).fit(u, y)
    assert model.stability_loss_ == pytest.approx(model.residual_ - free.residual_)
    assert model.stability_loss_ > 0.01
    u, y = record(rng)
    assert SubspaceLTI(2, horizon=5, stability="enforce").fit(u, y).stability_loss_ == 0


@pytest.mark.parametrize("refine", [True, False])
def test_enforced_stability_keeps_the_order_of_an_unstable_system(rng, refine):
    u = rng.standard_normal((500, 1))
    unstable = tuple(np.array([[v]]) for v in (1.05, 1.0, 1.0, 0.0))
    y = lti_response(*unstable, u)
    model = SubspaceLTI(stability="enforce", refine=refine)
    with pytest.warns(UserWarning, match="seems to be unstable"):
        model.fit(u, y)
    assert model.order_ == 1
    assert model.lti_.is_stable
    assert model.stability_loss_ == pytest.approx(model.residual_, abs=1e-6)
    chosen = model.selection_[model.selection_["chosen"]]
    assert len(chosen) == 1
    assert chosen["order"].item() == 1


def test_experiments_that_start_at_rest_have_zero_initial_states(rng):
    """B and D minimise the simulation error from rest: it is orthogonal to them."""
    u, y = record(rng, 300)
    y = y + 0.3 * rng.standard_normal(y.shape)
    model = SubspaceLTI(2, horizon=6, refine=False, initial_state="rest").fit(u, y)
    assert not model.initial_states_.any()
    error, lti = y - model.predict(u), model.lti_
    weight = 1.0 / np.mean(y**2, axis=0)
    for shape, name in ((lti.B.shape, "B"), (lti.D.shape, "D")):
        for entry in np.ndindex(shape):
            part = {"B": np.zeros_like(lti.B), "D": np.zeros_like(lti.D)}
            part[name][entry] = 1.0
            effect = lti_response(lti.A, part["B"], lti.C, part["D"], u)
            cosine = (weight * effect * error).sum()
            cosine /= np.sqrt((weight * effect**2).sum() * (weight * error**2).sum())
            assert abs(cosine) < 1e-9
    refined = SubspaceLTI(2, horizon=6, initial_state="rest").fit(u, y)
    assert refined.residual_ <= model.residual_
    assert not refined.initial_states_.any()
    assert np.isfinite(refined.poles_std_).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Output 2 drifts along a line")  # of four samples
def test_knowing_that_short_experiments_start_at_rest_helps(rng):
    errors = {"rest": [], "estimate": []}
    truth, omega = StateSpace(*SYSTEM, 1.0), np.linspace(0.05, 3.0, 20)
    for _ in range(4):
        runs = [record(rng, 4) for _ in range(60)]
        X = np.vstack(
            [np.column_stack([u, np.full(4, k)]) for k, (u, _) in enumerate(runs)]
        )
        y = np.vstack([y for _, y in runs])
        y = y + 0.5 * rng.standard_normal(y.shape)
        for start, found in errors.items():
            model = SubspaceLTI(2, horizon=2, experiment=2, initial_state=start)
            gap = model.fit(X, y).lti_.frequency_response(omega)
            found.append(np.linalg.norm(gap - truth.frequency_response(omega)))
    assert np.mean(errors["rest"]) < 0.9 * np.mean(errors["estimate"])


def test_what_follows_a_gap_does_not_start_at_rest():
    model = SubspaceLTI(missing="split", initial_state="rest")
    with pytest.raises(ValueError, match="`initial_state` must be 'estimate' with"):
        model.fit(np.zeros((9, 1)), np.zeros(9))
    with pytest.raises(ValueError, match="must be 'estimate' or 'rest'. Got 'zero'"):
        SubspaceLTI(initial_state="zero").fit(np.zeros((9, 1)), np.zeros(9))


def test_constant_inputs_are_called_by_their_names(rng):
    u, y = record(rng, 50)
    X = pd.DataFrame({"t": 0.1 * np.arange(50), "pump": u[:, 0], "valve": 2.0})
    with pytest.raises(ValueError, match="Got input 'valve' constant at 2:"):
        SubspaceLTI(time="t").fit(X, y)
    with pytest.raises(ValueError, match="Got input 'valve' constant at 2:"):
        SubspaceLTI(inputs=["valve", "pump"]).fit(X, y)
    with pytest.raises(ValueError, match="Got input 2 constant at 2:"):
        SubspaceLTI(time=0).fit(X.to_numpy(), y)
    with pytest.raises(ValueError, match="Got input 7 constant at 2:"):
        SubspaceLTI(time=3).fit(X.set_axis([3, 5, 7], axis=1), y)


def test_inputs_and_outputs_of_negative_zeros_are_zero(rng):
    u, y = record(rng, 50)
    with pytest.raises(ValueError, match="Got input 2 constant at 0:"):
        SubspaceLTI().fit(np.column_stack([u[:, 0], np.full(50, -0.0)]), y)
    with pytest.warns(UserWarning, match="Output 2 is 0 in all samples"):
        SubspaceLTI(2, horizon=5).fit(u, np.column_stack([y[:, 0], np.full(50, -0.0)]))


@pytest.mark.parametrize("unit", [1e-290, 1e-308, 1e-310])
def test_inputs_that_are_next_to_nothing_are_named(unit):
    rng = np.random.default_rng(0)
    X = pd.DataFrame(rng.normal(size=(100, 2)), columns=["valve", "fan"])
    y = X.to_numpy().sum(axis=1)
    with pytest.raises(ValueError, match="Got input 'fan' of at most .* smaller unit"):
        SubspaceLTI(1).fit(X * [1.0, unit], y)
    SubspaceLTI(1).fit(X * [1.0, 1e-149], y)


def test_selection_is_readable_as_text(rng):
    u, y = record(rng, 300)
    model = SubspaceLTI().fit(u, y + 0.1 * rng.standard_normal(y.shape))
    lines = model.selection_text().splitlines()
    best = model.selection_.dropna(subset="criterion")
    assert len(lines) == len(best) + 1
    marked = [line for line in lines if line.endswith("<- chosen")]
    assert len(marked) == 1
    assert marked[0].split()[:2] == [str(model.order_), str(model.horizon_)]


def test_outputs_on_very_different_scales_are_treated_alike(rng):
    u, y = record(rng, 1000)
    y = y + 0.1 * rng.standard_normal(y.shape)
    su, sy = np.array([1e9, 1e-9]), np.array([1e-9, 1e9])
    first, other = SubspaceLTI(2).fit(u, y), SubspaceLTI(2).fit(u * su, y * sy)
    np.testing.assert_allclose(
        other.predict(u * su) / sy, first.predict(u), rtol=1e-4, atol=1e-4
    )


def test_integer_object_and_nullable_columns_are_numbers(rng):
    u = rng.integers(-3, 4, (200, 2))
    y = lti_response(*SYSTEM, u.astype(float))
    expected = SubspaceLTI(2, horizon=5).fit(u.astype(float), y).predict(u)
    for X in (u, u.astype(object), pd.DataFrame(u, columns=["a", "b"]).astype("Int64")):
        model = SubspaceLTI(2, horizon=5).fit(X, y)
        np.testing.assert_allclose(model.predict(X), expected, atol=1e-9)


def test_more_channels_than_samples_teaches_or_fits(rng):
    X, y = rng.standard_normal((6, 8)), rng.standard_normal((6, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert SubspaceLTI().fit(X, y).predict(X).shape == (6, 3)
    with pytest.raises(ValueError, match="`horizon` must be at most 1 for 6 samples"):
        SubspaceLTI(2, horizon=4).fit(X, y)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_chains_of_integrators_are_identified_and_told(rng, order):
    u = rng.standard_normal((400, 1))
    y = u
    for _ in range(order):
        y = np.vstack([[0.0], np.cumsum(y, axis=0)[:-1]])
    # rounding decides on which side of the unit circle the poles lie
    border = "The identified model is (unstable|on the border of stability)"
    with pytest.warns(UserWarning, match=border):
        model = SubspaceLTI(order, horizon=6).fit(u, y)
    np.testing.assert_allclose(model.lti_.poles(), 1.0, atol=1e-3)
    error = model.predict(u) - y
    assert np.linalg.norm(error) < 1e-3 * np.linalg.norm(y)


@pytest.mark.parametrize("delay", [1, 5])
def test_pure_delay_is_identified(rng, delay):
    u = rng.standard_normal((400, 1))
    y = np.vstack([np.zeros((delay, 1)), u[:-delay]])
    late = pytest.warns(UserWarning, match=f"only after {delay} samples.* order 0 does")
    with late if delay > 1 else nullcontext():
        model = SubspaceLTI(method="po-moesp").fit(u, y)
    assert model.order_ == delay
    np.testing.assert_allclose(model.predict(u), y, atol=1e-6)


@pytest.mark.parametrize("method", ["po-moesp", "pi-moesp", "n4sid", "cva"])
def test_time_shifted_starts_and_lengths_do_not_matter(rng, method):
    """Pieces of one long record, each from where the state happened to be."""
    u, y = record(rng, 900)
    cuts = [(0, 150), (160, 500), (505, 900)]
    X = np.vstack(
        [np.column_stack([u[a:b], np.full(b - a, k)]) for k, (a, b) in enumerate(cuts)]
    )
    Y = np.vstack([y[a:b] for a, b in cuts])
    model = SubspaceLTI(2, horizon=6, method=method, experiment=2).fit(X, Y)
    np.testing.assert_allclose(poles_of(model), POLES, atol=1e-8)
    np.testing.assert_allclose(model.predict_with_initial_state(X, Y), Y, atol=1e-7)


def test_repeated_inputs_warn_once_and_fit(rng):
    u, y = record(rng)
    with pytest.warns(RankWarning, match="collinear"):
        model = SubspaceLTI(2, horizon=5).fit(np.hstack([u, u[:, :1]]), y)
    np.testing.assert_allclose(model.predict(np.hstack([u, u[:, :1]])), y, atol=1e-8)
    std = model.frequency_response_std([0.5])
    assert std.shape == (1, 2, 3)


def slow_in_slow_noise(seed):
    """A slow mode that inputs of high frequency hardly reach, in slow noise."""
    rng = np.random.default_rng(seed)
    u = np.diff(rng.standard_normal((400, 1)), axis=0)
    y = lfilter([0.0, 1.0], [1.0, 0.3], u, axis=0)
    y += lfilter([0.0, 0.1], [1.0, -0.97], u, axis=0)
    return u, y + lfilter([0.3], [1.0, -0.97], rng.standard_normal(u.shape), axis=0)


@pytest.mark.slow
def test_a_static_gain_that_is_not_known_is_told():
    n_told = 0
    for seed in range(10):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            model = SubspaceLTI(2, offset=None).fit(*slow_in_slow_noise(seed))
        gain = model._evidence.static_gain()
        if gain is None:  # with a mode as slow as the record
            assert any("does not decay" in str(w.message) for w in told)
            continue
        response = model.lti_.frequency_response([0.0])[0].real
        np.testing.assert_allclose(gain.value, response, rtol=1e-9)
        unknown = gain.std.item() > abs(gain.value.item())
        said = any("static gain (from input 1" in str(w.message) for w in told)
        assert said == unknown
        n_told += said
    assert 0 < n_told < 10


@pytest.mark.parametrize(
    "third, match",
    [
        pytest.param(lambda e: 0.0 * e + 3.0, "Output 3 is 3", marks=pytest.mark.slow),
        (lambda e: e, r"of output\(s\) 3"),
    ],
)
def test_nobody_asks_for_the_response_of_an_output_that_does_not_answer(third, match):
    rng = np.random.default_rng(201)
    u, y = record(rng, 1_000)
    y += 0.05 * y.std(axis=0) * rng.standard_normal(y.shape)
    with pytest.warns(UserWarning, match=match) as told:
        SubspaceLTI().fit(u, np.column_stack([y, third(rng.standard_normal(len(y)))]))
    assert len(told) == 1


@pytest.mark.parametrize("n_outputs", [1, 2])
def test_a_method_is_named_where_noise_may_move_the_states(rng, n_outputs):
    u, y = rng.standard_normal((300, 1)), rng.standard_normal((300, n_outputs))
    with pytest.warns(UserWarning, match="explains next to nothing") as told:
        SubspaceLTI(2, horizon=5).fit(u, y)
    assert ("method='pbsid'" in str(told[0].message)) == (n_outputs > 1)


def test_inputs_that_do_not_reach_an_output_need_no_static_gain():
    n_unknown = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u = rng.choice([-1.0, 1.0], (500, 2))
        y = np.column_stack(
            [
                lfilter([0.0, 0.5], [1.0, -0.9], u[:, 0]),
                lfilter([0.0, 0.3], [1.0, 0.7], u[:, 1]),
            ]
        )
        y += 0.1 * rng.standard_normal(y.shape)
        model = SubspaceLTI(2, offset=None).fit(u, y)  # silently
        gain = model._evidence.static_gain()
        across = gain.std > np.abs(gain.value)
        assert not across.diagonal().any()
        n_unknown += across.sum()
    assert n_unknown > 0


def test_a_fit_that_nobody_hears_is_the_same(rng):
    u, y = record(rng)
    y = y + 0.1 * rng.standard_normal(y.shape)
    y[100] = y[200] = 50.0  # which `fit` tells of
    with pytest.warns(UserWarning):
        heard = SubspaceLTI(2).fit(u, y)
    with unheard():
        silent = SubspaceLTI(2).fit(u, y)
    for matrix in "ABCD":
        expected = getattr(heard.lti_, matrix)
        np.testing.assert_array_equal(getattr(silent.lti_, matrix), expected)


def swinging(seed, decay):
    """Two steps and two periods of an oscillation, in noise."""
    rng, pole = np.random.default_rng(seed), (1.0 - decay) * np.exp(0.05j)
    u = np.repeat([0.0, 1.0, 0.0], [60, 100, 100])[:, None] + 0.0
    y = lfilter([0.0, 0.003], np.poly([pole, pole.conj()]).real, u, axis=0)
    return u, y + 0.3 * rng.standard_normal(u.shape)


def test_outputs_sampled_more_slowly_than_the_table_are_told():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal((150, 1)), 4, axis=0)
    y = lfilter([0.0, 0.2], [1.0, -0.8], u, axis=0)
    SubspaceLTI().fit(u, np.round(y * 20.0) / 20.0)  # silently: coarse, not held
    SubspaceLTI().fit(u, 2.0 * u)  # of no memory: held as its input is
    with pytest.warns(UserWarning, match="Output 1 keeps its values for 3 samples"):
        SubspaceLTI().fit(u, np.repeat(y[::3], 3, axis=0))


@pytest.mark.slow
def test_an_output_at_its_limit_is_told():
    rng = np.random.default_rng(0)
    u = lfilter([0.3], [1.0, -0.9], rng.standard_normal((600, 1)), axis=0)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
    y += 0.01 * rng.standard_normal(y.shape)
    SubspaceLTI().fit(u, y)
    low, high = np.quantile(y, [0.2, 0.9])
    for detrend in (None, "linear"):
        for least in (low, -np.inf):
            with pytest.warns(UserWarning, match=f"Output 1 stays at .*{high:.6g} for"):
                SubspaceLTI(detrend=detrend).fit(u, np.clip(y, least, high))
    y[y > high] = np.nan
    SubspaceLTI(missing="split").fit(u, y)


def test_a_sensor_that_hangs_is_told():
    rng = np.random.default_rng(0)
    u = lfilter([0.3], [1.0, -0.9], rng.standard_normal((600, 1)), axis=0)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
    y += 0.01 * rng.standard_normal(y.shape)
    for start in (100, 300):
        y[start : start + 30] = y[start]
    with pytest.warns(UserWarning, match="Output 1 stays at .* for 60 samples"):
        SubspaceLTI(1, offset=None).fit(u, y)
    X, named = pd.DataFrame(u, columns=["pump"]), pd.Series(y[:, 0], name="level")
    with pytest.warns(UserWarning, match="Output 'level' stays at .* for 60 samples"):
        SubspaceLTI(1, offset=None).fit(X, named)
    y[100:130] = y[300:330] = np.nan
    SubspaceLTI(1, missing="estimate").fit(u, y)


@pytest.mark.slow
@pytest.mark.parametrize("fallen, length", [(0.0, 3), (-5.0, 1), (-999.0, 1)])
def test_a_sensor_that_drops_out_is_told(fallen, length):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (100, 1)), 6, axis=0)
    y = 5.0 + lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
    y += 0.01 * rng.standard_normal(y.shape)
    SubspaceLTI().fit(u, y)
    at = [slice(k, k + length) for k in (77, 180, 333, 501)]
    for part in at:
        y[part] = fallen
    n = 4 * length
    told = rf"'level' falls to {fallen:.6g} in {n} sample\(s\), 4 time.*sample 77,"
    if fallen == -999.0:
        told = "Output 'level' is -999 in 4 sample.*nothing was measured.* sample 77,"
    named = pd.Series(y[:, 0], name="level")
    with pytest.warns(UserWarning, match=told) as warned:
        SubspaceLTI().fit(pd.DataFrame(u, columns=["pump"]), named)
    assert len(warned) == 1
    for part in at:
        y[part] = np.nan
    model = SubspaceLTI(missing="estimate").fit(u, y)
    assert abs(model.lti_.poles() - 0.9).max() < 0.01


def test_what_a_logger_writes_where_nothing_was_measured_is_told():
    """Once, and alone: what it makes of the model is no other fault."""
    rng = np.random.default_rng(0)
    u = 20.0 + 5.0 * rng.standard_normal((1000, 1))
    y = lfilter([0.0, 0.02], [1.0, -0.9], u - 20.0, axis=0)
    y += 0.05 * rng.standard_normal(y.shape)

    def told(rows, value, *tables):
        X = pd.DataFrame(u.copy(), columns=["flow"])
        measured = pd.Series(y[:, 0].copy(), name="T")
        if "flow" in tables:
            X.loc[rows, "flow"] = value
        if "T" in tables:
            measured.loc[rows] = value
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            SubspaceLTI(1).fit(X, measured)
        return [str(one.message) for one in warned]

    assert told([], 0.0) == []
    (message,) = told([500], -9999.0, "flow", "T")
    assert "Input 'flow' is -9999 in 1 sample(s), far from" in message
    assert "where other channels are, too" in message
    (message,) = told([200, 201, 500], -9999.0, "flow")
    assert "Input 'flow' is -9999 in 3 sample(s), far from" in message
    assert "sample 200" in message and "missing='split'" in message
    (message,) = told([77], 32767.0, "T")
    assert "Output 'T' is 32767 in 1 sample(s)" in message
    (message,) = told([77, 80], -4000.0, "flow", "T")  # no code, but in both
    assert "where other channels are, too" in message


@pytest.mark.parametrize("size", [20.0, 1e3])
def test_a_sample_far_from_all_others_is_told(size):
    """However far: a model that it hides must not be blamed."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((500, 1))
    y = lfilter([0.0, 0.2], [1.0, -0.8], u, axis=0) + 0.01 * rng.standard_normal(
        u.shape
    )
    y[200] = size
    with pytest.warns(UserWarning, match="1 sample.* stand far .*sample 200") as warned:
        SubspaceLTI().fit(u, y)
    assert len(warned) == 1


def test_inputs_that_stand_still_tell_no_constants():
    rng = np.random.default_rng(0)
    level = np.repeat([1.0, 2.0, 3.0], 200)
    X, y = np.column_stack([level, level]), rng.standard_normal(600).cumsum()
    with pytest.raises(ValueError, match="An input must move within an experiment"):
        SubspaceLTI(offset="constant", experiment=1).fit(X, y)
    assert SubspaceLTI(experiment=1).fit(X, y).offset_ is None


@pytest.mark.parametrize("rest", [0.0, 0.01])
def test_pulses_are_no_dropouts(rest):
    """Of an output that answers its input at once, at rest in between or with noise."""
    rng = np.random.default_rng(0)
    pulses = np.zeros(600)
    pulses[np.arange(20, 600, 40)] = 5.0
    y = pulses + lfilter([0.0, 0.1], [1.0, -0.9], pulses)
    y += rest * rng.standard_normal(600)
    assert drops_out([y], [pulses[:, None]]) is None
    assert drops_out([np.sign(np.sin(np.arange(600.0)))]) is None


def test_an_output_at_rest_is_at_no_limit():
    """Though its sensor is coarse, and inputs move that do not drive it."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.integers(0, 2, (200, 2)), 5, axis=0).astype(float)
    u[500:, 0], u[:500, 1] = 0.0, 0.0
    y = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0).round(2)
    assert len(stays_put([y[:, 0]])[0]) == 1
    SubspaceLTI().fit(u, y)


def test_a_coarse_sensor_whose_model_moves_within_a_step_is_at_no_limit():
    rng = np.random.default_rng(4)
    u = np.repeat(rng.standard_normal((60, 1)), 10, axis=0)
    u[300:400] = 2.5 + 0.1 * u[300:400]
    y = 0.4 * np.round(lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0) / 0.4)
    assert len(stays_put([y[:, 0]])[0]) == 1
    SubspaceLTI().fit(u, y)  # silently


@pytest.mark.slow
def test_a_decay_that_is_not_known_is_told():
    n_told = 0
    for seed in range(2):
        for decay in (1e-4, 0.1):
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                model = SubspaceLTI().fit(*swinging(seed, decay))
            said = any("does not decay" in str(w.message) for w in told)
            poles = model.lti_.poles()
            doubtful = 1.0 - np.abs(poles) < 2.0 * np.abs(model.poles_std_)
            assert said == (doubtful & (poles.imag != 0) & model.lti_.is_stable).any()
            assert not said or decay < 0.1
            n_told += said
    assert n_told > 0


def test_a_fit_that_parts_held_out_do_not_confirm_is_told(rng):
    u, y = record(rng, 300)
    y = y + 0.1 * rng.standard_normal(y.shape)
    choices = check_options(SubspaceLTI().get_params())
    fitted, _ = fit_samples(Samples([(u, y)], choices, Telling()))
    for residual, expected in ((0.05, 0), (0.4, 0), (0.6, 1)):
        held_out = fitted.selection.held_out._replace(residual=residual)
        poor = fitted._replace(selection=replace(fitted.selection, held_out=held_out))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            warn_about(poor, Telling())
        assert sum("far worse" in str(w.message) for w in told) == expected


@pytest.mark.slow
def test_a_mode_whose_decay_is_not_known_is_told():
    """Beside noise that drifts; a slow pole that is known is none of these."""
    told = []
    for seed, drift in ((1, 0.0), (3, 0.3), (7, 0.3), (9, 0.3)):
        rng = np.random.default_rng(seed)
        u, e = rng.standard_normal((2, 400, 1))
        y = lfilter([0.0, 1.1, -0.8], np.poly([0.9999, 0.7]), u, axis=0)
        y += drift * np.cumsum(e, axis=0) + 0.003 * e
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model = SubspaceLTI(offset=None).fit(u, y)
        decay = 1.0 - np.abs(model.lti_.poles())
        spread = np.abs(model.poles_std_)
        lasts = (decay >= 0.0) & (decay * 400 < 1.0)
        unknown = lasts & (decay < 2.0 * spread) & (spread * 400 > 0.1)
        told.append(any("A mode of the model" in str(w.message) for w in caught))
        assert told[-1] == unknown.any() and (drift or lasts.any())
    assert any(told) and not told[0]


def test_an_order_that_the_likelihood_disputes_is_told(rng):
    """By more than 30: of a chance of 1e-7."""
    u, e = rng.standard_normal((2, 300, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.7], u, axis=0) + 0.1 * e
    fitted, _ = fit_samples(
        Samples([(u, y)], check_options(SubspaceLTI().get_params()), Telling())
    )
    chosen = fitted.selection.order, fitted.selection.horizon
    for excess in (29.0, 31.0):
        rows = [
            row._replace(criterion=excess / 300) if row[:2] == chosen else row
            for row in fitted.selection.rows
        ]
        disputed = fitted._replace(selection=replace(fitted.selection, rows=rows))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            warn_about(disputed, Telling())
        assert [str(w.message)[:14] for w in told] == ["Parts held out"] * (excess > 30)


def test_some_of_several_inputs_may_be_collinear(rng):
    a, b = rng.standard_normal((2, 500))
    y = StateSpace(0.8, [[1.0, 2.0]], 1, None, 1.0).simulate(np.column_stack([a, b]))
    for third in (a + b, b, -b):
        u = np.column_stack([a, b, third])
        with pytest.warns(RankWarning, match=r"3 inputs are collinear \(rank 2\)"):
            model = SubspaceLTI(sampling_time=1.0).fit(u, y)
        assert model.score(u, y) > 1.0 - 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("gains", [(1.0, -1.0), (1.0, 1.0)])
def test_experiments_that_contradict_one_another_are_told(gains):
    """A sensor that changes its sign; equal ones, as noisy, are silent."""
    system = StateSpace([[0.6, 0.5], [-0.5, 0.6]], [[1], [0]], [[1, 0]], None, 1.0)
    n_told = 0
    for rng in map(np.random.default_rng, range(10)):
        pairs = []
        for gain in gains:
            u = rng.standard_normal((400, 1))
            y = gain * system.simulate(u)
            pairs.append((u, y + 0.3 * y.std() * rng.standard_normal(y.shape)))
        told = Telling()
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            fit_samples(Samples(pairs, Choices(order=2), told))
        n_told += "contradiction" in told
        assert any("contradict" in str(w.message) for w in said) == (
            "contradiction" in told
        )
    assert n_told >= 8 if gains[0] != gains[1] else n_told == 0


@pytest.mark.slow
def test_experiments_of_another_system_are_named():
    """Of two the outputs were exchanged; where none were, as noisy, all is silent."""
    system = StateSpace([[0.6, 0.5], [-0.5, 0.6]], [[1], [0]], [[1, 0]], None, 1.0)
    rng = np.random.default_rng(5)
    u = rng.standard_normal((5, 300, 1))
    y = np.array([system.simulate(one) for one in u])
    y += 0.1 * y.std() * rng.standard_normal(y.shape)
    exchanged = y[[0, 3, 2, 1, 4]]
    with pytest.warns(
        UserWarning, match=r"Experiment\(s\) 1, 3, counted from 0, do not"
    ):
        fit_samples(
            Samples(list(zip(u, exchanged, strict=True)), Choices(order=2), Telling())
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pairs = list(zip(u, y, strict=True))
        fit_samples(Samples(pairs, Choices(order=2), Telling()))


def test_experiments_whose_inputs_rest_contradict_none(rng):
    """Alone they tell nothing of a model."""
    u = np.repeat(rng.standard_normal((3, 60)), 5, axis=1)
    u[1] = 0.3
    e = lfilter([1.0], [1.0, -0.9], rng.standard_normal(u.shape))
    y = 10.0 + lfilter([0.0, 0.3], [1.0, -0.7], u) + e
    table = np.column_stack([u.ravel(), np.repeat([0, 1, 2], 300)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = SubspaceLTI(1, experiment=1).fit(table, y.ravel())
    assert model.order_ == 1


# -- what is wrong with channels, or not excited ---------------------------------------


def test_inputs_that_were_logged_wrongly_are_told(rng):
    u, y = record(rng, 800)
    noisy = y + 0.01 * rng.standard_normal(y.shape)
    wrong = u.copy()
    wrong[[100, 350, 600], 1] = 60.0
    told = r"3 sample\(s\) of the inputs .* first is sample 100 of input 2, .*='split'"
    with pytest.warns(UserWarning, match=told):
        SubspaceLTI().fit(wrong, noisy)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # pulses that were sent
        sent = lti_response(*SYSTEM, wrong) + 0.01 * rng.standard_normal(y.shape)
        model = SubspaceLTI().fit(wrong, sent)
    np.testing.assert_allclose(poles_of(model), POLES, atol=1e-2)


@pytest.mark.broad
@pytest.mark.parametrize("level", [0.0, 5.0])
def test_an_output_that_never_changes_is_told(rng, level):
    u, y = record(rng, 800)
    y = np.column_stack([y + 0.01 * rng.standard_normal(y.shape), np.full(800, level)])
    with pytest.warns(UserWarning) as caught:
        model = SubspaceLTI().fit(u, y)
    assert any(f"Output 3 is {level:g} in all" in str(w.message) for w in caught)
    assert not [w for w in caught if issubclass(w.category, RuntimeWarning)]
    np.testing.assert_allclose(model.lti_.frequency_response([0.3])[0, 2], 0, atol=1e-9)


def test_a_response_that_inputs_hardly_excite_is_told():
    """By a chirp up to a tenth of the sampling frequency; white noise tells it."""
    plant = lti_of([1, 0.1, 1], [1, 0.3, 9], [1, 0.3])
    t, rng = np.arange(150), np.random.default_rng(0)
    chirp = np.cos(2.0 * np.pi * (5e-4 + 0.05 * t / 150) * t)
    for u, told in ((chirp, True), (rng.standard_normal(150), False)):
        y = plant.simulate(u).ravel()
        y = y + 0.03 * y.std() * rng.standard_normal(150)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            SubspaceLTI().fit(u[:, None], y)
        said = " ".join(str(w.message) for w in caught)
        assert told == ("the record hardly excites" in said)


def lti_of(*factors):
    """``(2 s^2 + 5 s + 10) / (product of the factors)``, sampled at 5 Hz."""
    denominator = np.array([1.0])
    for factor in factors:
        denominator = np.polymul(denominator, factor)
    A, B, C, D = tf2ss([2.0, 5.0, 10.0], denominator)
    return StateSpace(A, B, C, D).to_discrete(0.2)


@pytest.mark.filterwarnings("ignore:The response is hardly known")
def test_an_output_that_is_noise_beside_others_is_named():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal((60, 1)), 8, axis=0)
    y = StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0).simulate(u)
    y = y + 0.01 * rng.standard_normal(y.shape)
    with pytest.warns(UserWarning, match=r"next to nothing of output\(s\) 2: what"):
        SubspaceLTI().fit(u, np.column_stack([y, rng.standard_normal(len(y))]))


@pytest.mark.parametrize("bft, told", [(0.0, 1), (50.0, 0)])
def test_parts_that_only_means_explain_are_told(bft, told, rng):
    """Without a constant; the level is many times the motion."""
    u = np.repeat(rng.standard_normal((30, 1)), 10, axis=0)
    y = 20.0 + StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0).simulate(u)
    y = y + 0.01 * rng.standard_normal(y.shape)
    fitted, _ = fit_samples(Samples([(u + 10.0, y)], Choices(), Telling()))
    held_out = fitted.selection.held_out._replace(bft=bft)
    selection = replace(fitted.selection, held_out=held_out)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_about(fitted._replace(selection=selection), Telling())
    heard = [w for w in caught if "explains where the outputs stay" in str(w.message)]
    assert len(heard) == told


@pytest.mark.parametrize("offset", ["auto", "constant", None])
def test_what_only_rounding_tells_apart_is_not_told_apart(offset):
    """Shares of a whole: their sum ripples by the last digit, of which D made 66."""
    rng = np.random.default_rng(1)
    X, fresh = (
        pd.DataFrame(rng.dirichlet([1, 1, 1], 30).repeat(10, axis=0), columns=[*"abc"])
        for _ in range(2)
    )

    def outputs(X):
        y = lfilter([0.0, 0.2], [1.0, -0.8], 3.0 * X["a"] - X["b"])
        return y + 0.02 * rng.standard_normal(len(X))

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI(1, offset=offset).fit(X.round(4), outputs(X))
    (told,) = (w for w in caught if "The inputs 'a', 'b', 'c' add up" in str(w.message))
    assert told.category is RankWarning
    assert np.abs(model.lti_.D).max() < 1.0 and np.abs(model.lti_.B).max() < 3.0
    fresh, y = fresh.round(4), outputs(fresh)
    assert bft_score(y, model.predict_with_initial_state(fresh, y)) > 95.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("error", RankWarning)
        u = X.assign(c=X["c"] + 0.02 * rng.standard_normal(len(X))).round(4)
        SubspaceLTI(1, offset=offset).fit(u, outputs(X))  # that is not rounding


@pytest.mark.parametrize("gains", [(3.0, -1.0), (1.0, -1.0)])
def test_a_count_that_is_excitation_is_not_rounding(gains):
    """Two counters that stand apart by one, for what moves the output: that is told."""
    rng = np.random.default_rng(0)
    common = rng.integers(0, 2000, (60, 1)).repeat(10, axis=0)
    u = np.hstack([common, common + rng.integers(0, 2, (60, 1)).repeat(10, axis=0)])
    y = lfilter([0.0, 0.3], [1.0, -0.7], u @ gains) + 0.05 * rng.standard_normal(600)
    model = SubspaceLTI(1).fit(u, y)
    assert model.lti_.dc_gain()[0] == pytest.approx(gains, abs=0.05)


def test_inputs_that_are_alike_but_for_a_constant_are_told():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 1))
    y = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
    y += 0.01 * rng.standard_normal((300, 1))
    with pytest.warns(RankWarning, match="the same but for constants and factors"):
        SubspaceLTI().fit(np.hstack([u, 2.0 * u + 1.0]), y)
