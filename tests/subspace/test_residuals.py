"""Residual tests: exact regressions, uniform p-values, and the power to see."""

from functools import cache

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.signal.windows import tukey

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.evidence.regressions import whitening_filters
from lpvlearn.subspace.evidence.residuals import (
    Fitted,
    Residuals,
    _sensitivities,
    autocorrelations,
    cross_correlations,
    input_tests,
    residual_tests,
    whiteness_tests,
    with_windows,
)
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes


def held(rng, n_samples, n_inputs=1):
    """A random binary signal, each value held for five samples."""
    steps = rng.choice([-1.0, 1.0], (n_samples // 5 + 1, n_inputs))
    return np.repeat(steps, 5, axis=0)[:n_samples]


def coloured(rng, n_samples, pole, n_channels=1):
    """AR(1) noise without a transient."""
    white = rng.standard_normal((n_samples + 100, n_channels))
    return lfilter([1.0], [1.0, -pole], white, axis=0)[100:]


def table_of(errors, inputs, **options):
    """Tests of errors and inputs as they are, indexed by test."""
    names = [
        [f"{c}{k + 1}" for k in range(x[0].shape[1])]
        for c, x in (("y", errors), ("u", inputs))
    ]
    return residual_tests(Residuals(errors, inputs, *names), **options).set_index(
        "test"
    )


# -- correlations ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_experiments():
    rng = np.random.default_rng(0)
    sizes = (40, 3)
    return (
        [rng.standard_normal((n, 2)) for n in sizes],
        [rng.standard_normal((n, 3)) for n in sizes],
    )


def test_autocorrelations_are_sums_within_experiments(two_experiments):
    errors, _ = two_experiments
    r = autocorrelations(errors, 6)
    for i, k in np.ndindex(2, 7):
        products = sum(e[k:, i] @ e[: len(e) - k, i] for e in errors if len(e) > k)
        assert_allclose(r[k, i], products / sum(e[:, i] @ e[:, i] for e in errors))
    assert_array_equal(autocorrelations([np.zeros((5, 1))], 2), 0.0)


def test_cross_correlations_are_sums_within_experiments(two_experiments):
    errors, inputs = two_experiments
    filters = whitening_filters(errors) + whitening_filters(inputs)
    assert all(len(a) == 1 for a in filters)  # they are white
    found = cross_correlations(errors, inputs, 6)
    assert_allclose(found.deviation, 43**-0.5)
    assert_array_equal(found.lags, np.arange(-6, 7))
    for row, i, j in np.ndindex(found.values.shape):
        lag, total = found.lags[row], 0.0
        for e, u in zip(errors, inputs, strict=True):
            times = [t for t in range(len(e)) if 0 <= t - lag < len(e)]
            total += sum(e[t, i] * u[t - lag, j] for t in times)
        size = [
            sum(np.sum(v**2) for v in part)
            for part in ([e[:, i] for e in errors], [u[:, j] for u in inputs])
        ]
        assert_allclose(found.values[row, i, j], total / np.sqrt(np.prod(size)))


def test_cross_correlations_of_coloured_strangers_stay_in_their_band():
    rng, runs = np.random.default_rng(2), []
    for _ in range(12):
        found = cross_correlations([coloured(rng, 600, 0.9)], [held(rng, 600)], 12)
        runs.append(found.values[:, 0, 0] / found.deviation)
    assert 0.85 < np.std(runs) < 1.15  # of 300 values; without whitening 2


def test_cross_correlations_show_what_follows_what():
    """A white input acts three samples later, on an error that is coloured besides."""
    rng = np.random.default_rng(2)
    u, v = rng.standard_normal((900, 1)), coloured(rng, 900, 0.9)
    e = lfilter([0.0, 0.0, 0.0, 0.5], [1.0, -0.9], u, axis=0) + v
    found = cross_correlations([e], [u], 10)
    beyond = np.abs(found.values[:, 0, 0]) > 5.0 * found.deviation
    assert_array_equal(found.lags[beyond], [3])


@pytest.mark.parametrize("n_experiments", [1, 3])
def test_errors_are_whitened_by_their_autoregression(n_experiments):
    """Of the order with the smallest value of Schwarz's criterion."""
    rng = np.random.default_rng(3)
    poles = np.poly([0.8 * np.exp(0.5j), 0.8 * np.exp(-0.5j)]).real
    errors = [
        lfilter([1.0], poles, rng.standard_normal((900, 1)), axis=0)
        for _ in range(n_experiments)
    ]
    (a,) = whitening_filters(errors)
    taper = tukey(902, 0.2)[1:-1, None]  # errors rise from zero and fall to it
    r = autocorrelations([taper * v for v in errors], 2)[:, 0]
    assert_allclose(a, [1.0, *np.linalg.solve(toeplitz(r[:2]), -r[1:])])
    assert_allclose(a, poles, atol=0.1)
    # A constant is its own past: nothing is divided by zero.
    assert np.isfinite(whitening_filters([np.ones((50, 1))])[0]).all()


# -- tests of residuals ----------------------------------------------------------------


def ordinary_f(target, base, added):
    """F statistic of added regressors, by long matrices."""
    losses = []
    for M in (base, np.hstack([base, added])):
        left = target - (M @ np.linalg.lstsq(M, target, rcond=None)[0] if M.size else 0)
        losses.append(left @ left)
    dof = len(target) - base.shape[1] - added.shape[1]
    q = added.shape[1]
    F = (losses[0] - losses[1]) / q / (losses[1] / dof)
    return q * F, stats.f.sf(F, q, dof)


def lagged(u, lags, longest):
    inside = range(longest, len(u) - longest)
    return np.array([[u[t - k] for k in lags] for t in inside])


def test_white_errors_get_ordinary_f_tests():
    rng, M = np.random.default_rng(3), 4
    e, u = rng.standard_normal((300, 1)), coloured(rng, 300, 0.8, 2)
    found = input_tests([e], [u], M)
    target = e[M:-M, 0]
    past = [lagged(u[:, j], range(1, M + 1), M) for j in range(2)]
    present = [lagged(u[:, j], [0], M) for j in range(2)]
    future = [lagged(u[:, j], range(-M, 0), M) for j in range(2)]
    for j in range(2):
        expected = ordinary_f(target, np.zeros((len(target), 0)), past[j])
        assert found.past[0][j].dof == M
        assert_allclose(found.past[0][j][::2], expected)
        expected = ordinary_f(target, np.hstack(past), present[j])
        assert found.present[0][j].dof == 1
        assert_allclose(found.present[0][j][::2], expected)
        expected = ordinary_f(target, np.hstack(past + present), future[j])
        assert found.future[0][j].dof == M
        assert_allclose(found.future[0][j][::2], expected)


@pytest.mark.parametrize("n_fitted", [0, 3])
def test_ljung_box_of_one_record(n_fitted):
    """Lags are added for what was fitted, and the degrees of freedom remain."""
    e = np.random.default_rng(4).standard_normal((200, 1))
    r = autocorrelations([e], 10)[1:, 0]
    q = 200 * 202 * np.sum(r**2 / (200 - np.arange(1, 11)))
    found = whiteness_tests([e], 10 - n_fitted, n_fitted)[0]
    expected = q, 10 - n_fitted, stats.chi2.sf(q, 10 - n_fitted)
    assert_allclose(found, expected)


def slow_drift(rng, n_samples):
    return coloured(rng, n_samples, 0.9)


@pytest.mark.slow
@pytest.mark.parametrize("make_input", [held, slow_drift])
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_p_values_are_uniform_where_errors_and_inputs_are_strangers(pole, make_input):
    values = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        errors = [coloured(rng, n, pole) for n in (250, 150)]
        inputs = [make_input(rng, n) for n in (250, 150)]
        found = input_tests(errors, inputs, 8)
        p = [found.past[0][0].p_value, found.future[0][0].p_value]
        values.append([*p, whiteness_tests(errors, 8)[0].p_value])
    past, future, white = np.transpose(values)
    # Less than one of a hundred correct tests would stay below this.
    assert stats.kstest(past, "uniform").pvalue > 0.01
    assert stats.kstest(future, "uniform").pvalue > 0.01
    if pole:
        assert white.max() < 1e-6
    else:
        assert stats.kstest(white, "uniform").pvalue > 0.01


def test_what_the_model_lacks_shows_in_past_inputs_only():
    rng = np.random.default_rng(5)
    A = modes(0.9, 0.6 * np.exp(1.0j))
    u = coloured(rng, 1500, 0.7)
    y = lti_response(A, np.ones((3, 1)), np.ones((1, 3)), np.zeros((1, 1)), u)
    y += 0.1 * y.std() * coloured(rng, 1500, 0.9)
    with pytest.warns(UserWarning, match="order 1 lacks states"):
        models = {order: SubspaceLTI(order, horizon=10).fit(u, y) for order in (1, 3)}
    tables = {n: m.residual_tests(u, y).set_index("test") for n, m in models.items()}
    assert tables[1].loc["past inputs", "p_value"] < 1e-6
    assert tables[3].loc["past inputs", "passed"]
    for table in tables.values():
        assert table.loc["future inputs", "passed"]
        assert not table.loc["whiteness", "passed"]


def test_feedback_shows_in_future_inputs():
    """A controller answers the sum of the noise at once; the errors are the noise."""
    e, r = np.random.default_rng(6).standard_normal((2, 2000, 1))
    u = r - 0.2 * lfilter([1.0], [1.0, -0.8], e, axis=0)
    table = table_of([e], [u])
    assert table.loc["whiteness", "passed"]
    assert table.loc["past inputs", "passed"]
    assert table.loc["present input", "p_value"] < 1e-6
    assert table.loc["future inputs", "p_value"] < 1e-6


def test_sensitivities_are_spanned_by_every_pole_taken_twice():
    """Finite differences of the simulated output, for every entry of A, B and C."""
    rng = np.random.default_rng(7)
    A = modes(0.9, 0.7 * np.exp(0.8j))
    B, C = rng.standard_normal((3, 2)), rng.standard_normal((1, 3))
    u, D = rng.standard_normal((200, 2)), np.zeros((1, 2))
    direct = np.zeros((1, 2), dtype=bool)
    fitted = Fitted(np.linalg.eigvals(A), direct, np.eye(1)[None])
    (span,) = _sensitivities(fitted, 0, u)
    assert span.shape == (200, 12)
    Q = np.linalg.qr(span)[0]
    for k, M in enumerate((A, B, C)):
        for place in np.ndindex(M.shape):
            step = np.zeros(M.shape)
            step[place] = 1e-6
            ends = []
            for sign in (-1, 1):
                moved = [A, B, C]
                moved[k] = M + sign * step
                ends.append(lti_response(*moved, D, u)[:, 0])
            change = (ends[1] - ends[0]) / 2e-6
            assert_allclose(Q @ (Q.T @ change), change, atol=1e-6)


def test_p_values_do_not_turn_on_rounding():
    """Errors that change by 1e-14, where regressors are combinations of others."""
    rng = np.random.default_rng(8)
    poles = np.array([0.99, 0.83, 0.6 + 0.45j, 0.6 - 0.45j])
    u, white = held(rng, 600), rng.standard_normal(600)
    e = lfilter([1.0], [1.0, -0.8], white)[:, None]
    direct = np.ones((1, 1), dtype=bool)
    expected = input_tests([e], [u], 25, Fitted(poles, direct, np.eye(1)[None]))
    for _ in range(4):
        near = Fitted(poles * (1.0 + 1e-14 * rng.random()), direct, np.eye(1)[None])
        found = input_tests([e * (1.0 + 1e-14 * rng.random(e.shape))], [u], 25, near)
        for ours, theirs in zip(found, expected, strict=True):
            assert ours[0][0].dof == theirs[0][0].dof
            assert_allclose(ours[0][0].p_value, theirs[0][0].p_value, rtol=1e-9)


@cache
def fit_of(pole, seed):
    """A model, and the samples that it was fitted to."""
    A, b, c, d = modes(0.9, 0.6 * np.exp(1.0j)), np.ones((3, 1)), np.ones((1, 3)), 0.5
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((600, 1))
    y = lti_response(A, b, c, np.array([[d]]), u)
    y += 0.2 * y.std() * coloured(rng, 600, pole)
    return SubspaceLTI(3, horizon=10).fit(u, y), u, y


def p_values_of_fits(pole, errors, n_runs):
    """Fits tested on their samples; and where these are not recognised."""
    right, plain = [], []
    for seed in range(n_runs):
        model, u, y = fit_of(pole, seed)
        found = model.residual_tests(u, y, errors=errors, n_lags=20).set_index("test")
        right.append(found["p_value"].drop("present input"))
        # The samples were fitted by D, and say nothing of it any more.
        assert found.loc["present input", "dof"] == 0
        # The first sample is another one, so that they are not recognised.
        y = y + 1e-9 * (np.arange(600) == 0)[:, None]
        found = model.residual_tests(u, y, errors=errors, n_lags=20).set_index("test")
        plain.append(found.loc["past inputs", "p_value"])
    return pd.concat(right, axis=1), np.array(plain)


def test_fits_are_recognised_by_their_samples():
    right, plain = p_values_of_fits(0.0, "simulation", 3)
    assert right.to_numpy().min() > 0.01
    assert (right.loc["past inputs"] < plain).all()


@pytest.mark.slow
@pytest.mark.parametrize("errors", ["simulation", "prediction"])
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_p_values_are_uniform_on_the_samples_of_the_fit(pole, errors):
    right, plain = p_values_of_fits(pole, errors, 60)
    for test, values in right.iterrows():
        if pole and errors == "simulation" and test == "whiteness":
            assert values.max() < 1e-6
        else:
            assert stats.kstest(values, "uniform").pvalue > 0.01, test
    if not pole:  # what the parameters took is missed, unless told
        assert stats.kstest(plain, "uniform").pvalue < 0.01


def test_inputs_that_repeat_themselves_say_nothing_of_the_future():
    """A sine is a combination of its own past: there is nothing left to test."""
    rng, t = np.random.default_rng(8), np.arange(500.0)[:, None]
    u = np.hstack([np.sin(0.3 * t), rng.standard_normal((500, 1))])
    found = input_tests([rng.standard_normal((500, 1))], [u], 6)
    assert found.past[0][0].dof == 2
    assert found.future[0][0] == (0.0, 0, 1.0)
    assert found.future[0][1].dof == 6


def test_errors_that_are_zero_pass():
    u = np.random.default_rng(8).standard_normal((300, 1))
    assert_array_equal(table_of([np.zeros((300, 2))], [u])["p_value"], 1.0)


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_errors_that_are_rounding_are_said_to_be(offset):
    """One output of a model is free of noise, the other is not."""
    rng = np.random.default_rng(8)
    u = rng.standard_normal((300, 1))
    y = np.hstack([u, u]) @ [[1.0, 0.0], [0.0, 2.0]]
    y[:, 1] += 0.1 * rng.standard_normal(300)
    model = SubspaceLTI(0, detrend="constant").fit(u, y + offset)
    with pytest.warns(
        UserWarning, match="errors of y1 are rounding .*all .* pass"
    ) as w:
        table = model.residual_tests(u, y + offset).set_index("output")
    assert w[0].filename == __file__
    assert_array_equal(table.loc["y1", "p_value"], 1.0)
    assert table.loc["y2", "p_value"].iloc[0] < 1.0


def test_the_table_names_what_was_tested():
    rng = np.random.default_rng(9)
    e, u = rng.standard_normal((400, 2)), rng.standard_normal((400, 3))
    residuals = Residuals([e], [u], ["angle", "rate"], list("abc"))
    table = residual_tests(residuals, level=0.5)
    columns = "output test input statistic dof p_value passed n_missing"
    assert list(table.columns) == columns.split()
    assert len(table) == 2 * (1 + 3 + 3 + 3)
    assert list(table["output"][[0, 10]]) == ["angle", "rate"]
    assert list(table["input"][:7]) == ["", *"abc", *"abc"]
    assert_array_equal(table["passed"], table["p_value"] >= 0.5)
    white = table["test"] == "whiteness"
    assert (table["dof"][white] == with_windows(residuals, None)[1]).all()


def test_units_of_errors_and_inputs_do_not_matter():
    rng = np.random.default_rng(10)
    e, u = coloured(rng, 400, 0.5, 2), held(rng, 400, 2)
    plain = table_of([e], [u])
    scaled = table_of([e * [1e-6, 1e3]], [u * [1e4, 1e-5]])
    assert_allclose(scaled["p_value"], plain["p_value"], rtol=1e-7)


def test_long_records_are_worked_on_in_pieces(monkeypatch):
    rng = np.random.default_rng(11)
    e, u = coloured(rng, 500, 0.5, 2), held(rng, 500, 2)
    whole = table_of([e], [u])
    monkeypatch.setattr("lpvlearn.subspace.evidence.residuals._PIECE", 64)
    assert_allclose(table_of([e], [u])["p_value"], whole["p_value"], rtol=1e-9)


def test_experiments_without_windows_are_left_out():
    rng = np.random.default_rng(12)
    e, u = rng.standard_normal((2, 400, 1))
    parts = [[x[:300], x[300:301], x[301:]] for x in (e, u)]
    long = [[part for part in x if len(part) > 100] for x in parts]
    found, expected = table_of(*parts, n_lags=25), table_of(*long, n_lags=25)
    pd.testing.assert_frame_equal(found, expected)


def test_short_experiments_are_refused_with_what_they_need():
    def lags(n, m, n_lags=None):
        x = Residuals([np.zeros((n, 1))], [np.zeros((n, m))], "y", "abc"[:m])
        return with_windows(x, n_lags)[1]

    assert lags(22, 1) == 1 and lags(100, 1) == 4 and lags(1000, 1) == 25
    with pytest.raises(ValueError, match="at least 22 samples for 1 input.*Got 21"):
        lags(21, 1)
    with pytest.raises(ValueError, match="at least 42 samples for 2 input.*Got 20"):
        lags(20, 2)
    with pytest.raises(
        ValueError, match="of 30 lag.* at least 180 samples .*; lower `n_lags`"
    ):
        lags(120, 1, 30)
    with pytest.raises(ValueError, match="`n_lags` must be an integer, at least 1"):
        lags(100, 1, 0)


# -- of a table ------------------------------------------------------------------------


def test_columns_gaps_and_trends_are_those_of_the_fit():
    """Two experiments in one table of other levels, each cut by a missing sample."""
    rng = np.random.default_rng(13)
    u, levels = rng.standard_normal((800, 1)), np.repeat([[3.0], [50.0]], 400, axis=0)
    y = np.vstack(
        [lfilter([0.0, 1.0], [1.0, -0.8], part, axis=0) for part in (u[:400], u[400:])]
    )
    y += levels + 0.1 * rng.standard_normal(y.shape)
    y[[150, 600]] = np.nan
    X = pd.DataFrame({"run": np.repeat([1, 2], 400), "torque": u[:, 0]})
    options = {"experiment": "run", "missing": "split", "detrend": "constant"}
    model = SubspaceLTI(1, horizon=5, **options).fit(X, y)
    table = model.residual_tests(X, pd.DataFrame(y, columns=["angle"]))
    assert set(table["output"]) == {"angle"} and set(table["input"]) == {"", "torque"}
    assert table["passed"].all()
    # The first run alone is a part of the fit too.
    own = model._residuals(X[:400], y[:400], "simulation")
    assert own.fitted is not None and [len(e) for e in own.errors] == [150, 249]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"errors": "other"}, "`errors` must be 'simulation' or 'prediction'"),
        ({"level": 0.0}, "`level` must be between 0 and 1. Got 0.0"),
        ({"y": np.zeros((100, 2))}, r"`y` must hold the 1 output\(s\).* Got 2"),
        ({"y": None}, "`y` must hold the measured outputs. Got None"),
    ],
)
def test_errors_teach(options, message):
    u, e = np.random.default_rng(14).standard_normal((2, 100, 1))
    model = SubspaceLTI(1, horizon=3).fit(u, np.cumsum(u, axis=0) + e)
    with pytest.raises(ValueError, match=message):
        model.residual_tests(u, **{"y": e, **options})


def test_a_model_that_diverges_is_refused():
    u, e = np.random.default_rng(14).standard_normal((2, 3000, 1))
    model = SubspaceLTI(1, horizon=3).fit(u, lfilter([1.0], [1.0, -0.5], u, axis=0) + e)
    model.lti_ = StateSpace([[1.5]], [[1.0]], [[1.0]], sampling_time=1.0)
    with pytest.raises(ValueError, match="unstable .*: use stability='enforce'"):
        model.residual_tests(u, e)


# -- a lack that a fit tells of --------------------------------------------------------


def resonance(rng, n_samples, noise, pole=0.0):
    """A fourth-order system, 0 to 1 samples per radian, with noise at its output."""
    A = modes(0.95 * np.exp(0.3j), 0.9 * np.exp(1.2j))
    system = StateSpace(
        A, [[1.0], [0.3], [1.0], [0.2]], [[0.5, 0.2, 1.0, 0.4]], None, 1
    )
    u = rng.standard_normal((n_samples, 1))
    y = system.simulate(u)
    e = coloured(rng, n_samples, pole)
    return u, y + noise * y.std() / e.std() * e


def test_a_fit_tells_of_missing_states():
    u, y = resonance(np.random.default_rng(0), 800, 0.1)
    with pytest.warns(UserWarning, match="order 2 lacks states.*order='auto'"):
        SubspaceLTI(2, horizon=12).fit(u, y)
    SubspaceLTI(4, horizon=12).fit(u, y)  # silently


def test_a_small_lack_is_not_told():
    """Neither next to the noise, nor next to the output."""
    rng = np.random.default_rng(1)
    u = rng.standard_normal((3000, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.5], u, axis=0)
    weak = 0.05 * lfilter([0.0, 0.0, 0.0, 1.0], [1.0, 0.8], u, axis=0)
    noise = rng.standard_normal(y.shape)
    SubspaceLTI(1, horizon=8).fit(u, y + weak + 0.5 * noise)
    SubspaceLTI(1, horizon=8).fit(u, y + 0.05 * weak)
    for size in (0.01, 0.35):  # the lack is all of the errors, or 5 % of their squares
        with pytest.warns(UserWarning, match="lacks states"):
            SubspaceLTI(1, horizon=8).fit(u, y + weak + size * noise)


@pytest.mark.broad
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_noise_alone_is_no_lack(pole):
    for seed in range(8):
        u, y = resonance(np.random.default_rng(seed), 600, 0.3, pole)
        SubspaceLTI(4, horizon=12).fit(u, y)
