"""Noise models, and errors whitened by them."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.models.innovation import NoiseModel
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.noise import (
    Whitening,
    autoregression,
    expected_change,
    noise_of,
    reduced_noise_model,
    spectral_density,
)
from lpvlearn.subspace.simulation_error.simulation_fit import (
    Freedom,
    Realization,
    simulation_errors,
    with_initial_states,
)

from .conftest import freedom, identify, record


def test_autoregression_recovers_a_vector_process():
    rng = np.random.default_rng(0)
    Phi = np.array([[0.8, 0.3], [-0.2, 0.5]])
    e = rng.standard_normal((40_000, 2)) @ np.array([[1.0, 0.4], [0.0, 0.6]])
    v = np.zeros_like(e)
    for t in range(1, len(e)):
        v[t] = Phi @ v[t - 1] + e[t]
    model = autoregression([v[:15_000], v[15_000:]])
    np.testing.assert_allclose(model.A, Phi, atol=0.02)
    np.testing.assert_allclose(model.covariance, np.cov(e.T), rtol=0.05, atol=0.02)
    assert abs(np.linalg.eigvals(model.A - model.K @ model.C)).max() < 1e-9


def test_noise_of_long_memory_does_not_begin_with_a_jump():
    """Nor end with one: the variance of the innovations (1) would be 1.7."""
    logs = []
    for seed in range(20):
        e = np.random.default_rng(seed).standard_normal((2400, 1))
        v = lfilter([1.0], [1.0, -0.998], e, axis=0)[2000:]
        logs.append(np.log(autoregression([v]).covariance[0, 0]))
    assert abs(np.mean(logs)) < 0.1 and np.std(logs) < 0.15


def test_white_and_vanishing_errors_have_no_noise_states():
    white = np.random.default_rng(0).standard_normal((3000, 2))
    assert len(autoregression([white]).A) == 0
    assert len(autoregression([np.zeros((50, 2))]).A) == 0


def test_reduced_noise_model_has_a_stable_predictor_and_the_riccati_gain():
    e = np.random.default_rng(1).standard_normal((20_000, 1))
    long = autoregression([lfilter([1.0, 0.7], [1.0, -0.9], e, axis=0)])
    short = reduced_noise_model(long, 1)
    np.testing.assert_allclose(short.A, [[0.9]], atol=0.02)
    assert abs(np.linalg.eigvals(short.A - short.K @ short.C)).max() < 1.0
    omega = 2.0 * np.pi * np.arange(256) / 256
    np.testing.assert_allclose(
        spectral_density(short, omega), spectral_density(long, omega), rtol=0.2
    )
    # An innovation form is its own Kalman filter: the Riccati solution is zero.
    Q, S = short.K @ short.covariance @ short.K.T, short.K @ short.covariance
    P = solve_discrete_are(short.A.T, short.C.T, Q, short.covariance, s=S)
    np.testing.assert_allclose(P, 0.0, atol=1e-8)
    white = reduced_noise_model(long, 0)
    np.testing.assert_allclose(
        white.covariance, spectral_density(long, omega).real.mean(), rtol=0.1
    )


def testspectral_density_integrates_to_the_variance():
    one = np.ones((1, 1))
    model = NoiseModel(0.8 * one, 0.8 * one, one, 2.0 * one)
    omega = 2.0 * np.pi * np.arange(512) / 512
    variance = spectral_density(model, omega).mean().real
    assert variance == pytest.approx(2.0 / (1.0 - 0.64), rel=1e-9)


def covariance_example(rng, n=4000):
    """White errors of three outputs, two of which share most of their noise."""
    mix = np.array([[0.02, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.9, 0.2]])
    return rng.standard_normal((n, 3)) @ mix.T


def dense(noise, n_samples):
    """The map from outputs, sample by sample, to innovations."""
    A, C, K, _ = noise
    ny, inner = len(C), A - K @ C
    L = np.eye(n_samples * ny)
    answer = K
    for d in range(1, n_samples):
        for t in range(n_samples - d):
            L[(t + d) * ny : (t + d + 1) * ny, t * ny : (t + 1) * ny] = -C @ answer
        answer = inner @ answer
    return L


def test_expected_outputs_make_the_least_of_the_innovations():
    rng = np.random.default_rng(0)
    A = np.diag([0.9, 0.5, -0.3])
    C, K = rng.standard_normal((2, 3)), 0.3 * rng.standard_normal((3, 2))
    root = np.array([[2.0, 0.0], [0.01, 0.03]])
    noise = NoiseModel(A, C, K, root @ root.T)
    innovations = rng.standard_normal((40, 2)) @ root.T
    missing = rng.random((40, 2)) < 0.3
    L = dense(noise, 40)
    white = np.kron(np.eye(40), np.linalg.inv(root))
    some = (white @ L)[:, missing.ravel()]
    wanted = np.linalg.lstsq(some, -white @ innovations.ravel())[0]
    change = expected_change(noise, innovations, missing)
    assert not change[~missing].any()
    size = np.array([2.0, 0.03])
    np.testing.assert_allclose(
        (change / size)[missing], wanted / np.tile(size, 40)[missing.ravel()], atol=0.01
    )


def test_white_errors_of_missing_outputs_are_zero():
    noise = NoiseModel.white(np.eye(1))
    errors = np.random.default_rng(0).standard_normal((30, 1))
    missing = np.arange(30)[:, None] % 4 == 0
    left = errors + expected_change(noise, errors, missing)
    np.testing.assert_allclose(left[missing], 0.0, atol=1e-12)
    np.testing.assert_array_equal(left[~missing], errors[~missing])


@pytest.mark.broad
@pytest.mark.parametrize("gaps", ["at random", "in a rhythm"])
def test_the_noise_of_errors_that_are_partly_known(gaps):
    e = np.random.default_rng(0).standard_normal((20000, 1))
    v = lfilter([1.0], [1.0, -0.9], e, axis=0)
    some = np.where(np.random.default_rng(0).random(v.shape) < 0.4, np.nan, v)
    if gaps == "in a rhythm":  # what a wave of that period would explain
        some = np.where(np.arange(20000)[:, None] % 3 == 0, v, np.nan)
    model = noise_of([some])
    density = spectral_density(model, np.array([0.0, 2.0 * np.pi / 3.0])).real.ravel()
    assert density[0] == pytest.approx(100.0, rel=0.5)
    assert density[1] < 5.0


def test_whitened_errors_are_white_equally_large_and_uncorrelated(rng):
    e = lfilter([1.0], [1.0, -0.8], covariance_example(rng), axis=0)
    whitening = Whitening.of([e[:1500], e[1500:]], freedom(3, 1))
    white = whitening.records([Record.of(e, e)], freedom(3, 1))[0].y
    S = np.cov(white) / np.cov(white).trace() * 3
    np.testing.assert_allclose(S, np.eye(3), atol=0.06)
    assert abs(np.corrcoef(white[0, 1:], white[0, :-1])[0, 1]) < 0.06
    assert np.linalg.det(whitening.weight) == pytest.approx(1.0)


def test_outputs_are_not_mixed_where_single_entries_of_d_are_known(rng):
    free = Freedom(np.array([[True], [False], [True]]))
    weight = Whitening.of([covariance_example(rng)], free).weight
    assert np.array_equal(weight, np.diag(np.diag(weight)))
    assert weight[0, 0] / weight[1, 1] == pytest.approx(50.0, rel=0.05)


def test_equal_white_errors_and_rounding_are_left_alone(rng):
    for e in (rng.standard_normal((2000, 2)), 1e-12 * covariance_example(rng)):
        assert Whitening.of([e], freedom(e.shape[1], 1)).is_none
    assert not Whitening.of([covariance_example(rng)], freedom(3, 1)).is_none


def test_a_model_answers_whitened_inputs_with_whitened_outputs(system):
    u, y = record(system, 300, noise=0.0)
    rng = np.random.default_rng(0)
    colour = lfilter([1.0], [1.0, -0.9, 0.3], rng.standard_normal((300, 2)), axis=0)
    for at_rest in (True, False):
        free = freedom(2, 2)._replace(initial_states=not at_rest)
        whitening = Whitening.of([colour * [0.1, 1.0]], free)
        lost = 0 if at_rest else len(whitening.filter) - 1
        white = whitening.records([Record.of(u, y)], free)
        assert white[0].n_samples == 300 - lost and len(whitening.filter) > 1
        found = identify([(u, y)], 5, 8)
        model = whitening.model(in_form(found))
        model = with_initial_states(model, white, free)
        assert np.abs(simulation_errors(model, white)[0]).max() < 1e-8
        back = whitening.undone(model)
        np.testing.assert_allclose(back.C, found.C, rtol=1e-10)
        np.testing.assert_allclose(back.D, found.D, atol=1e-10)


def in_form(found):
    return Realization(*found[:4], found.initial_states, 0.0)


TRUTH = StateSpace(
    [[0.8, 0.3], [-0.3, 0.7]], [[1.0], [0.5]], np.eye(2), sampling_time=1.0
)
GRID = np.linspace(0.05, 3, 20)


def experiment(noise, seed=0, n_samples=1000, pole=0.0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, 1))
    y = TRUTH.simulate(u)
    e = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], rng.standard_normal(y.shape), 0)
    return u, y + y.std(0) * noise * e


def fitted(u, y, refine="prediction"):
    model = SubspaceLTI(2, horizon=8, feedthrough=False, refine=refine).fit(u, y)
    return model.lti_


def row_errors(model):
    gap = model.frequency_response(GRID) - TRUTH.frequency_response(GRID)
    return np.sqrt(np.mean(np.abs(gap) ** 2, axis=(0, 2)))


def test_a_poor_sensor_does_not_spoil_a_good_one():
    pairs = [experiment([0.01, 1.0], seed) for seed in range(4)]
    plain, weighted = (
        np.median([row_errors(fitted(*pair, refine)) for pair in pairs], axis=0)
        for refine in ("simulation", "auto")
    )
    assert weighted[0] < 0.1 * plain[0] and weighted[1] < 1.1 * plain[1]


@pytest.mark.slow
def test_coloured_noise_costs_less_than_plain_errors_would_make_it():
    """White noise changes nothing."""
    pairs = [experiment([0.5, 0.5], seed, pole=0.95) for seed in range(4)]
    plain, weighted = (
        np.median([row_errors(fitted(*pair, refine)) for pair in pairs], axis=0)
        for refine in ("simulation", "auto")
    )
    assert (weighted < plain).all() and weighted.sum() < 0.6 * plain.sum()
    u, y = experiment([0.1, 0.1])
    plain, same = fitted(u, y, "simulation"), fitted(u, y)
    assert np.array_equal(plain.A, same.A)


def test_the_weighted_error_is_least():
    u, y = experiment([0.05, 1.0], pole=0.7)
    model = SubspaceLTI(2, horizon=8, feedthrough=False, refine="prediction").fit(u, y)
    whitening = model._evidence.whitening
    su, sy = u.std(), np.sqrt(np.mean(y**2, axis=0))
    white = whitening.records([Record.of(u / su, y / sy)], model._evidence.free)

    def loss(lti):
        C = whitening.weight @ (lti.C / sy[:, None])
        found = Realization(lti.A, lti.B * su, C, 0 * C[:, :1], np.zeros((1, 2)), 0.0)
        return with_initial_states(found, white, model._evidence.free).loss

    least = loss(model.lti_)
    rng = np.random.default_rng(1)
    for _ in range(20):
        changed = StateSpace(
            model.lti_.A * (1 + 1e-2 * rng.normal(size=(2, 2))),
            model.lti_.B,
            model.lti_.C,
            sampling_time=1.0,
        )
        assert loss(changed) > least


def test_units_of_the_outputs_do_not_matter():
    u, y = experiment([0.02, 1.0], pole=0.5)
    factor = np.array([1e-3, 1e4])
    one, other = fitted(u, y, "auto"), fitted(u, y * factor, "auto")
    np.testing.assert_allclose(
        other.frequency_response(GRID),
        factor[:, None] * one.frequency_response(GRID),
        rtol=1e-7,
    )
