"""Predictor and uncertainty of SubspaceLTI."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter
from scipy.stats import binom

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.evidence.statistics import (
    _frequency_response_jacobian,
    _pole_jacobian,
)
from lpvlearn.subspace.simulation_error.simulation_fit import Freedom, Realization
from lpvlearn.systems.simulation import lti_response, state_trajectory

OMEGA = np.array([0.1, 0.5, 1.0, 2.0])


def second_order():
    A = 0.9 * np.array([[np.cos(0.6), np.sin(0.6)], [-np.sin(0.6), np.cos(0.6)]])
    C = np.array([[1.0, 0.5], [0.2, -1.0]])
    return A, np.array([[1.0], [0.4]]), C, np.array([[0.3], [0.0]])


def coloured(rng, n_samples, pole, n_outputs=2):
    return lfilter([1.0], [1.0, -pole], rng.standard_normal((n_samples, n_outputs)), 0)


def experiment(seed, n_samples, pole=0.0, level=0.3):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, 1))
    y = lti_response(*second_order(), u)
    e = coloured(rng, n_samples, pole)
    return u, y + level * y.std(axis=0) * e / e.std(axis=0)


def truth(omega):
    A, B, C, D = second_order()
    return np.array(
        [C @ np.linalg.solve(np.exp(1j * w) * np.eye(2) - A, B) + D for w in omega]
    )


@pytest.fixture(scope="module")
def coloured_fit():
    """Model of a long record in coloured noise."""
    return SubspaceLTI(2, horizon=12).fit(*experiment(0, 20_000, pole=0.9))


@pytest.mark.parametrize("steps", [1, 3])
def test_prediction_error_under_coloured_noise_is_that_of_the_true_predictor(
    coloured_fit, steps
):
    model = coloured_fit
    predictor = model.predictor_
    assert predictor.n_noise_states == 2
    np.testing.assert_allclose(np.linalg.eigvals(predictor.noise.A), 0.9, atol=0.02)
    v, z = experiment(1, 20_000, pole=0.9)
    ahead = z - model.predict_ahead(v, z, steps=steps)
    simulated = z - model.predict_with_initial_state(v, z)
    expected = np.sqrt(1.0 - 0.81**steps)
    np.testing.assert_allclose(ahead.std(0) / simulated.std(0), expected, rtol=0.03)
    if steps == 1:
        np.testing.assert_allclose(
            np.diag(predictor.covariance), ahead.var(0), rtol=0.05
        )


def test_far_prediction_and_white_noise_are_the_simulation(coloured_fit):
    model = coloured_fit
    u, y = experiment(0, 3000, pole=0.9)
    far = model.predict_ahead(u, y, 400) - model.predict_with_initial_state(u, y)
    assert np.abs(far[:300]).max() < 0.01  # of outputs that count otherwise
    np.testing.assert_allclose(far[300:], 0.0, atol=1e-9)
    u, y = experiment(0, 3000)
    model = SubspaceLTI(2, horizon=12).fit(u, y)
    assert not model.predictor_.K.any()
    np.testing.assert_array_equal(
        model.predict_ahead(u, y), model.predict_with_initial_state(u, y)
    )


@pytest.mark.broad
@pytest.mark.parametrize("clean", [1e-4, 1e-6])
@pytest.mark.parametrize("missing", ["raise", "estimate"])
def test_a_clean_output_spoils_no_prediction_of_a_noisy_one(clean, missing):
    """What its noise leaves of the other one by the initial state is no innovation."""
    rng = np.random.default_rng(0)
    u, v, w = rng.standard_normal((3, 400))
    true = StateSpace([[0.8, 0.2], [-0.2, 0.8]], [[1], [0]], [[1, 0]], None, True)
    exact, noise = true.simulate(u)[:, 0], lfilter([1.0], [1.0, -0.9], 0.3 * w)
    y = np.column_stack([exact + noise, exact + clean * v])
    if missing == "estimate":
        y[100:110, 0] = np.nan
    model = SubspaceLTI(2, missing=missing).fit(u[:, None], y)
    error = y[:, 0] - model.predict_ahead(u[:, None], y)[:, 0]
    assert np.sqrt(np.nanmean(error**2)) < 0.32
    tests = model.residual_tests(u[:, None], y, errors="prediction")
    assert tests.loc[tests["test"] == "whiteness", "p_value"].iloc[0] > 1e-3


def test_prediction_uses_no_later_output(coloured_fit):
    model = coloured_fit
    u, y = experiment(0, 500, pole=0.9)
    changed = y.copy()
    changed[300:] += 5.0
    pair = [model.predict_ahead(u, z, 2, initial_state="rest") for z in (y, changed)]
    np.testing.assert_array_equal(pair[0][:302], pair[1][:302])
    assert abs(pair[0][302] - pair[1][302]).max() > 0.1


def test_noise_model_in_the_units_of_the_outputs():
    u, y = experiment(0, 4000, pole=0.8)
    scale = np.array([1e-6, 1e6])
    first = SubspaceLTI(2, horizon=10).fit(u, y).predictor_
    other = SubspaceLTI(2, horizon=10).fit(u, y * scale).predictor_
    np.testing.assert_allclose(
        other.covariance, first.covariance * np.outer(scale, scale), rtol=1e-5
    )


@pytest.mark.slow
def test_noise_states_make_the_unrefined_po_moesp_consistent():
    errors = {}
    for extra in (0, 2):
        gaps = []
        for seed in range(3):
            u, y = experiment(seed, 20_000, pole=0.9, level=0.5)
            model = SubspaceLTI(2, horizon=12, refine=False, n_noise_states=extra)
            response = model.fit(u, y).lti_.frequency_response(OMEGA)
            gaps.append(np.linalg.norm(response - truth(OMEGA)))
        errors[extra] = np.median(gaps)
    assert errors[2] < 0.3 * errors[0]


def finite_difference(function, blocks, B, C, D, step=1e-6):
    """Derivatives in the order of the parameters: B, D, A, C."""
    columns = []
    for matrices in (B, D, *blocks, C):
        for index in np.ndindex(matrices.shape):
            before = matrices[index]
            values = []
            for sign in (1.0, -1.0):
                matrices[index] = before + sign * step
                values.append(function())
            matrices[index] = before
            columns.append((values[0] - values[1]) / (2.0 * step))
    return np.stack(columns, axis=-1)


def test_jacobians_equal_finite_differences():
    rng = np.random.default_rng(0)
    blocks = (np.array([[0.5]]), np.array([[0.7, 0.4], [-0.3, 0.6]]))
    B, C, D = (rng.standard_normal(s) for s in ((3, 2), (2, 3), (2, 2)))

    def assemble():
        A = np.zeros((3, 3))
        A[:1, :1], A[1:, 1:] = blocks
        return A

    def response():
        return np.array(
            [
                C @ np.linalg.solve(np.exp(1j * w) * np.eye(3) - assemble(), B) + D
                for w in OMEGA
            ]
        )

    model = Realization(assemble(), B, C, D, np.zeros((1, 3)), 0.0, 0, blocks)
    free = Freedom(np.ones((2, 2), bool))
    J = _frequency_response_jacobian(model, free, OMEGA)
    expected = finite_difference(response, blocks, B, C, D)
    np.testing.assert_allclose(J, expected, atol=1e-7)
    poles, J = _pole_jacobian(model, free, expected.shape[-1])

    def all_poles():
        return np.concatenate([np.linalg.eigvals(block) for block in blocks])

    np.testing.assert_allclose(poles, all_poles())
    np.testing.assert_allclose(
        J, finite_difference(all_poles, blocks, B, C, D), atol=1e-7
    )


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_bands_of_95_percent_cover_the_truth(pole):
    """Within what 40 runs can tell, entry by entry; 300 runs are a benchmark."""
    runs = 40
    hits, pole_hits = [], []
    for seed in range(runs):
        u, y = experiment(seed, 600, pole=pole)
        model = SubspaceLTI(2, horizon=10).fit(u, y)
        error = model.lti_.frequency_response(OMEGA) - truth(OMEGA)
        std = model.frequency_response_std(OMEGA)
        hits.append(
            [abs(error.real) < 1.96 * std.real, abs(error.imag) < 1.96 * std.imag]
        )
        true_pole = 0.9 * np.exp(0.6j * np.sign(model.lti_.poles().imag))
        gap = model.lti_.poles() - true_pole
        pole_hits.append(abs(gap.real) < 1.96 * model.poles_std_.real)
    worst = binom.ppf(1e-4, runs, 0.95) / runs
    assert np.mean(hits, axis=0).min() >= worst
    assert np.mean(pole_hits) >= binom.ppf(1e-4, runs, 0.95) / runs
    # Not by being too wide: the average over entries is near 95 %.
    assert 0.90 < np.mean(hits) < 0.99


def test_covariance_holds_the_variances_and_follows_the_units():
    u, y = experiment(0, 800)
    model = SubspaceLTI(2, horizon=10).fit(u, y)
    covariance = model.frequency_response_covariance(OMEGA)
    assert covariance.shape == (4, 4, 4)
    std = model.frequency_response_std(OMEGA).reshape(4, 2)
    np.testing.assert_allclose(
        np.sqrt(np.einsum("fii->fi", covariance)),
        np.hstack([std.real, std.imag]),
        atol=1e-12,
    )
    su, sy = 1e3, np.array([1e-9, 1e9])
    other = SubspaceLTI(2, horizon=10, sampling_time=0.1).fit(su * u, sy * y)
    np.testing.assert_allclose(
        other.frequency_response_std(OMEGA / 0.1) / sy[:, None] * su,
        model.frequency_response_std(OMEGA),
        rtol=1e-4,
    )


def test_more_data_shrink_the_standard_deviation_as_one_over_root_n():
    stds = []
    for n_samples in (2_000, 80_000):  # the longer one is averaged over a part
        model = SubspaceLTI(2, horizon=10).fit(*experiment(0, n_samples))
        stds.append(np.abs(model.frequency_response_std(OMEGA)).mean())
    assert stds[0] / stds[1] == pytest.approx(np.sqrt(40.0), rel=0.1)


def heading(seed):
    """A ship's: an integrator behind a lag, about a level, with a biased rudder."""
    rng = np.random.default_rng(seed)
    u = 10.0 * np.repeat(rng.choice([-1.0, 1.0], 30), 20) + rng.normal(0.0, 2.0, 600)
    rate = lfilter([0.0, 0.4], [1.0, -0.94], u - u.mean())
    y = 90.0 + lfilter([0.0, 1.0], [1.0, -1.0], rate)
    return u[:, None] + 1.0, (y + 0.005 * y.std() * rng.standard_normal(600))[:, None]


def test_poles_beside_an_integrator_are_known_as_well_as_they_are_found():
    """Near 1 a pole's free response is all but the constant: of that nothing hangs."""
    models = [SubspaceLTI(2).fit(*heading(seed)) for seed in range(5)]
    lags, integrators = np.array([model.lti_.poles().real for model in models]).T
    stds = np.array([model.poles_std_.real for model in models])
    # Some models stand at the edge of stability, others at a distance.
    assert (1.0 - integrators).min() < 2e-8 and (1.0 - integrators).max() > 1e-6
    assert (stds / np.median(stds, axis=0) < 3.0).all()
    assert (stds / np.median(stds, axis=0) > 1.0 / 3.0).all()
    hits = np.abs(np.array([lags - 0.94, integrators - 1.0]).T / stds)
    assert hits.max() < 3.0 and np.mean(hits[:, 0] ** 2) < 2.5


def test_covariance_of_an_unrefined_model_is_refused():
    model = SubspaceLTI(2, horizon=10, refine=False).fit(*experiment(0, 400))
    with pytest.raises(ValueError, match="refine='simulation' or 'prediction'"):
        model.frequency_response_std(OMEGA)
    assert not hasattr(model, "poles_std_")


@pytest.mark.filterwarnings("ignore:The model explains next to nothing")
@pytest.mark.parametrize("method", ["po-moesp", "pbsid"])
def test_a_model_without_parameters_is_certain(rng, method):
    u, y = rng.standard_normal((2, 300, 1))
    model = SubspaceLTI(0, feedthrough=False, method=method).fit(u, y)
    assert model.poles_std_.shape == (0,) and model.deviated_models() == []
    assert (model.frequency_response_std(OMEGA) == np.zeros((4, 1, 1))).all()
    assert (model.frequency_response_covariance(OMEGA) == np.zeros((4, 2, 2))).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"steps": 0}, "`steps` must be an integer, at least 1. Got 0"),
        ({"initial_state": "zero"}, "`initial_state` must be 'estimate' or 'rest'"),
    ],
)
def test_wrong_prediction_arguments_are_refused(coloured_fit, arguments, message):
    u, y = experiment(0, 300, pole=0.9)
    with pytest.raises(ValueError, match=message):
        coloured_fit.predict_ahead(u, y, **arguments)


def test_process_noise_is_predicted_as_well_as_by_the_kalman_filter():
    A, B, C, _ = second_order()
    rng = np.random.default_rng(1)

    def simulate(n_samples):
        u = rng.standard_normal((n_samples, 1))
        w = 0.5 * rng.standard_normal((n_samples, 2))
        x = state_trajectory(A, u @ B.T + w)
        return u, x @ C.T + 0.5 * rng.standard_normal((n_samples, 2))

    model = SubspaceLTI(2, horizon=15, n_noise_states=2).fit(*simulate(10_000))
    u, y = simulate(10_000)
    P = solve_discrete_are(A.T, C.T, 0.25 * np.eye(2), 0.25 * np.eye(2))
    best = np.sqrt(np.diag(C @ P @ C.T + 0.25 * np.eye(2)))
    error = (y - model.predict_ahead(u, y)).std(axis=0)
    np.testing.assert_allclose(error, best, rtol=0.03)
    assert (error < 0.7 * (y - model.predict(u)).std(axis=0)).all()


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_pairs_stand_on_both_sides_of_the_estimate(method):
    rng = np.random.default_rng(1)
    u = rng.choice([-1.0, 1.0], (100, 1)).repeat(3, axis=0)
    lag = StateSpace([[-0.8]], [[1.5]], [[1.0]])
    y = lag.simulate(u, sampling_time=0.1) + 0.05 * rng.standard_normal((300, 1))
    fitted = SubspaceLTI(1, horizon=8, sampling_time=0.1).fit(u, y)
    pairs = [
        (above.to_continuous(method), below.to_continuous(method))
        for above, below in fitted.deviated_models()
    ]
    assert len(pairs) == 3  # pole, gain and feedthrough
    omega = np.geomspace(0.01, 20, 20)
    here = fitted.lti_.to_continuous(method).frequency_response(omega)
    for above, below in pairs:
        step = above.frequency_response(omega) - here
        middle = above.frequency_response(omega) + below.frequency_response(omega)
        assert np.abs(middle - 2 * here).max() < 0.02 * np.abs(step).max()


def test_collinear_inputs_leave_the_deviations_open():
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], (200, 1))
    y = StateSpace([[0.8]], [[1.0]], [[1.0]], sampling_time=1.0).simulate(u)
    y = y + 0.01 * rng.standard_normal(y.shape)
    both = np.hstack([u, 2 * u])
    with pytest.warns(UserWarning, match="collinear"):
        fitted = SubspaceLTI(1, horizon=5).fit(both, y)
    assert fitted.deviated_models() == []


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_pairs_tell_the_deviations_of_the_fit_in_any_unit_of_an_output(unit):
    rng = np.random.default_rng(0)
    truth = StateSpace(
        [[0.8, 0.3], [-0.3, 0.7]], [[1.0], [0.5]], np.eye(2), sampling_time=1.0
    )
    u = rng.standard_normal((1000, 1))
    y = truth.simulate(u)
    y = (y + 0.1 * y.std(0) * rng.standard_normal(y.shape)) * [1.0, unit]
    fitted = SubspaceLTI(2, horizon=8).fit(u, y)
    omega = np.linspace(0.1, 3, 6)
    changes = [
        above.frequency_response(omega) - below.frequency_response(omega)
        for above, below in fitted.deviated_models()
    ]
    expected = np.abs(fitted.frequency_response_std(omega))
    actual = np.linalg.norm(changes, axis=0) / 0.02
    np.testing.assert_allclose(actual, expected, rtol=1e-3)
