"""Residual tests: exact regressions, uniform p-values, and the power to see."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI
from lpvlearn.subspace.refinement import refine_simulation
from lpvlearn.subspace.residuals import (
    Fitted,
    Residuals,
    _sensitivities,
    _whitening_filters,
    autocorrelations,
    cross_correlations,
    input_tests,
    residual_tests,
    whiteness_tests,
    with_windows,
)
from lpvlearn.subspace.signals import Record
from lpvlearn.subspace.simulation_fit import simulation_fit
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes, stable_model


def held(rng, n_samples, n_inputs=1):
    """A random binary signal, each value held for five samples."""
    steps = rng.choice([-1.0, 1.0], (n_samples // 5 + 1, n_inputs))
    return np.repeat(steps, 5, axis=0)[:n_samples]


def coloured(rng, n_samples, pole, n_channels=1):
    """AR(1) noise without a transient."""
    white = rng.standard_normal((n_samples + 100, n_channels))
    return lfilter([1.0], [1.0, -pole], white, axis=0)[100:]


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
    found = cross_correlations(errors, inputs, 6)
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


def test_deviations_of_white_signals_are_those_of_bartlett():
    rng = np.random.default_rng(1)
    e, u = rng.standard_normal((2, 900, 1))
    assert_allclose(cross_correlations([e], [u], 5).deviations, 1 / 30, rtol=0.01)


def test_deviations_are_the_spread_of_coloured_signals():
    rng, runs = np.random.default_rng(2), []
    for _ in range(50):
        found = cross_correlations(
            [coloured(rng, 600, 0.9)], [held(rng, 600)], n_lags=12
        )
        runs.append(found.values[:, 0, 0] / found.deviations[0, 0])
    # 25 lags, neighbours alike: some 300 independent values
    assert 0.85 < np.std(runs) < 1.15
    # Taken as white they would be far too narrow.
    assert found.deviations.min() > 1.7 / np.sqrt(600)


@pytest.mark.parametrize("n_experiments", [1, 3])
def test_errors_are_whitened_by_their_autoregression(n_experiments):
    """The recursion solves the normal equations of the order it takes."""
    rng = np.random.default_rng(3)
    poles = np.poly([0.8 * np.exp(0.5j), 0.8 * np.exp(-0.5j)]).real
    errors = [
        lfilter([1.0], poles, rng.standard_normal((900, 1)), axis=0)
        for _ in range(n_experiments)
    ]
    (a,) = _whitening_filters(errors)
    r = autocorrelations(errors, 2)[:, 0]
    assert_allclose(a, [1.0, *np.linalg.solve(toeplitz(r[:2]), -r[1:])])
    assert_allclose(a, poles, atol=0.1)
    # A constant is its own past: the recursion ends, and nothing is divided by zero.
    assert np.isfinite(_whitening_filters([np.ones((50, 1))])[0]).all()


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
    e = np.random.default_rng(4).standard_normal((200, 1))
    r = autocorrelations([e], 10)[1:, 0]
    q = 200 * 202 * np.sum(r**2 / (200 - np.arange(1, 11)))
    found = whiteness_tests([e], 10, n_fitted)[0]
    expected = q, 10 - n_fitted, stats.chi2.sf(q, 10 - n_fitted)
    assert_allclose(found, expected)


def slow_drift(rng, n_samples):
    return coloured(rng, n_samples, 0.9)


@pytest.mark.parametrize(
    ("pole", "make_input"),
    [
        (0.9, held),
        pytest.param(0.9, slow_drift, marks=pytest.mark.slow),
        pytest.param(0.0, held, marks=pytest.mark.slow),
        pytest.param(0.0, slow_drift, marks=pytest.mark.slow),
    ],
)
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
    tables = {}
    for order in (1, 3):
        model = SubspaceLTI(order=order, horizon=10).fit(u, y)
        error = y - model.predict_with_initial_state(u, y)
        tables[order] = residual_tests([error], [u]).set_index("test")
    assert tables[1].loc["past inputs", "p_value"] < 1e-6
    assert tables[3].loc["past inputs", "passed"]
    for table in tables.values():
        assert table.loc["future inputs", "passed"]
        assert not table.loc["whiteness", "passed"]


def test_feedback_shows_in_future_inputs():
    record, e = closed_loop(PLANT, 2000, 6, sources=True)
    table = residual_tests([e], [record.u.T]).set_index("test")
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
    span = _sensitivities(np.linalg.eigvals(A), u)
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


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_a_model_passes_on_the_samples_that_it_was_fitted_to(pole):
    plain, right = [], []
    A, b, c, d = modes(0.9, 0.6 * np.exp(1.0j)), np.ones((3, 1)), np.ones((1, 3)), 0.5
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((600, 1))
        y = lti_response(A, b, c, np.array([[d]]), u)
        y += 0.2 * y.std() * coloured(rng, 600, pole)
        records = [Record(u.T, y.T)]
        start = simulation_fit(A, c, records)
        model = refine_simulation(start, records)[0]
        e = y - lti_response(*model[:4], u, model.initial_states[0])
        fitted = Fitted(np.linalg.eigvals(model.A), np.ones((1, 1), dtype=bool))
        plain.append(input_tests([e], [u], 20).past[0][0].p_value)
        found = input_tests([e], [u], 20, fitted)
        right.append(found.past[0][0].p_value)
        # The samples were fitted by D, and say nothing of it any more.
        assert found.present[0][0].dof == 0
    assert stats.kstest(right, "uniform").pvalue > 0.01
    if not pole:  # what the parameters took is missed, unless told
        assert stats.kstest(plain, "uniform").pvalue < 0.05


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
    table = residual_tests([np.zeros((300, 2))], [u])
    assert_array_equal(table["p_value"], 1.0)


def test_the_table_names_what_was_tested():
    rng = np.random.default_rng(9)
    e, u = rng.standard_normal((400, 2)), rng.standard_normal((400, 3))
    table = residual_tests(
        [e], [u], output_names=["angle", "rate"], input_names="abc", level=0.5
    )
    assert list(table.columns) == [
        "output",
        "test",
        "input",
        "statistic",
        "dof",
        "p_value",
        "passed",
    ]
    assert len(table) == 2 * (1 + 3 + 3 + 3)
    assert list(table["output"][[0, 10]]) == ["angle", "rate"]
    assert list(table["input"][:7]) == ["", *"abc", *"abc"]
    assert_array_equal(table["passed"], table["p_value"] >= 0.5)
    assert (
        table["dof"][table["test"] == "whiteness"] == affordable_lags([400], 3)
    ).all()


def test_units_of_errors_and_inputs_do_not_matter():
    rng = np.random.default_rng(10)
    e, u = coloured(rng, 400, 0.5, 2), held(rng, 400, 2)
    plain = residual_tests([e], [u])
    scaled = residual_tests([e * [1e-6, 1e3]], [u * [1e4, 1e-5]])
    assert_allclose(scaled["p_value"], plain["p_value"], rtol=1e-7)


def test_short_experiments_are_refused_with_what_they_need():
    assert affordable_lags([22], 1) == 1
    with pytest.raises(ValueError, match="at least 22 samples for 1 input.*Got 21"):
        affordable_lags([21], 1)
    with pytest.raises(ValueError, match="at least 42 samples for 2 input"):
        residual_tests([np.zeros((20, 1))], [np.zeros((20, 2))])
