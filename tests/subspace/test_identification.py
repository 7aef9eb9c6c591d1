"""From records to a model: exact without noise, better with more data."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI, bft_score
from lpvlearn.subspace.orders.identification import (
    Candidate,
    Settings,
    _is_astray,
)
from lpvlearn.subspace.orders.realization import METHODS
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.noise import Whitening
from lpvlearn.subspace.simulation_error.simulation_fit import simulation_fit
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes
from .conftest import (
    POLES,
    example,
    experiment,
    freedom,
    identify,
    markov,
    sorted_poles,
    sweep_of_a_hardening_spring,
)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("refine", [True, False])
def test_noise_free_data_give_back_poles_and_markov_parameters(rng, method, refine):
    system = example(rng, modes(*POLES))
    runs = [experiment(rng, system, n, rng.standard_normal(6)) for n in (250, 300)]
    found = identify(runs, 6, 8, method=method, refine=refine)
    np.testing.assert_allclose(
        sorted_poles(found.A), sorted_poles(system[0]), atol=1e-8
    )
    expected = markov(*system)
    np.testing.assert_allclose(
        markov(*found[:4]), expected, atol=1e-8 * np.abs(expected).max()
    )
    assert found.residual < 1e-8


def test_initial_state_of_every_experiment_is_recovered(rng):
    system = example(rng, modes(*POLES))
    states = rng.standard_normal((3, 6))
    runs = [experiment(rng, system, 200, x0) for x0 in states]
    found = identify(runs, 6, 6)
    for (u, y), x0 in zip(runs, found.initial_states, strict=True):
        np.testing.assert_allclose(lti_response(*found[:4], u, x0), y, atol=1e-7)


def test_result_does_not_depend_on_the_units_of_the_channels(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 600, noise=0.1)
    found = identify([(u, y)], 6, 10)
    su, sy = np.array([1e9, 1e-3]), np.array([1e-9, 1e9])
    other = identify([(u * su, y * sy)], 6, 10)
    np.testing.assert_allclose(
        markov(*other[:4]) / sy[:, None] * su, markov(*found[:4]), rtol=1e-6, atol=1e-7
    )


def test_pooled_experiments_are_better_than_one(rng):
    system = example(rng, modes(*POLES))
    runs = [experiment(rng, system, 300, noise=0.3) for _ in range(8)]
    truth = markov(*system)
    one = np.mean(
        [np.linalg.norm(markov(*identify([r], 6, 10)[:4]) - truth) for r in runs]
    )
    pooled = np.linalg.norm(markov(*identify(runs, 6, 10)[:4]) - truth)
    assert pooled < 0.6 * one


def test_feedthrough_off_fixes_D_at_zero(rng):
    A, B, C, D = example(rng, modes(*POLES))
    u, y = experiment(rng, (A, B, C, 0 * D))
    found = identify([(u, y)], 6, 8, feedthrough=False)
    assert not found.D.any()
    np.testing.assert_allclose(markov(*found[:4]), markov(A, B, C, 0 * D), atol=1e-7)


@pytest.mark.parametrize("engine", ["cholesky", "qr"])
def test_order_zero_is_the_least_squares_gain(rng, engine, monkeypatch):
    if engine == "qr":
        refused = "lpvlearn.subspace.samples.hankel.cholesky_factor"
        monkeypatch.setattr(refused, lambda gram, **_: None)
    u = rng.standard_normal((50, 2))
    y = u @ rng.standard_normal((2, 3)) + 0.1 * rng.standard_normal((50, 3))
    found = identify([(u, y)], 0, 2)
    np.testing.assert_allclose(found.D, np.linalg.lstsq(u, y, rcond=None)[0].T)
    assert found.A.shape == (0, 0)


@pytest.mark.parametrize("noise", ["white", "coloured"])
def test_pi_moesp_error_falls_with_the_number_of_samples(noise):
    errors = []
    system = example(np.random.default_rng(1), modes(0.9 * np.exp(0.5j), 0.8))
    truth = markov(*system)
    for n in (1000, 16000):
        runs = []
        for seed in range(4):
            rng = np.random.default_rng(seed)
            u, y = experiment(rng, system, n)
            e = rng.standard_normal(y.shape)
            if noise == "coloured":
                for t in range(1, n):
                    e[t] += 0.9 * e[t - 1]
            y = y + 0.3 * y.std(axis=0) * e / e.std(axis=0)
            found = identify([(u, y)], 3, 15, method="pi-moesp", refine=False)
            runs.append(np.linalg.norm(markov(*found[:4]) - truth))
        errors.append(np.median(runs))
    assert errors[1] < 0.45 * errors[0]  # 1/sqrt(16) = 0.25


def test_truly_unstable_system_is_kept_unless_stability_is_enforced(rng):
    system = example(rng, modes(1.02, 0.8), 1, 1)
    u, y = experiment(rng, system, 300)
    found = identify([(u, y)], 2, 6)
    np.testing.assert_allclose(sorted_poles(found.A), [0.8, 1.02], atol=1e-8)
    stable = identify([(u, y)], 2, 6, enforce_stability=True)
    assert np.abs(np.linalg.eigvals(stable.A)).max() < 1.0


def test_states_that_exact_samples_do_not_have_are_stable():
    """An unstable pole may take the last bits of samples; it would blow up others."""
    for rng in map(np.random.default_rng, range(30)):
        system = example(rng, modes(0.988 * np.exp(0.04j)), 1, 1)
        u = np.sign(rng.standard_normal((20, 1))).repeat(20, 0)
        found = identify([(u, lti_response(*system, u, np.zeros(2)))], 6, 8)
        assert found.residual < 1e-9
        assert np.abs(np.linalg.eigvals(found.A)).max() < 1.0


def test_limits_count_columns_rows_and_instruments():
    for lengths in ([100], [30, 40, 50]):
        h = Settings(freedom(1, 2)).max_horizon(lengths)
        columns = [sum(max(0, n - 2 * k + 1) for n in lengths) for k in (h, h + 1)]
        assert columns[0] >= 6 * h and columns[1] < 6 * (h + 1)
    assert Settings(freedom(5, 3)).max_horizon([35]) == 2  # of all channels
    assert Settings(freedom(5, 3)).max_horizon([34]) == 3  # of an output and the inputs
    assert Settings(freedom(5, 3)).max_horizon([18]) == 1
    assert Settings(freedom(3, 1)).max_order(5) == 12
    assert Settings(freedom(3, 1), "pi-moesp").max_order(5) == 5


def test_a_step_is_not_noise_for_an_order_that_is_too_low(rng):
    """Three lags by one: what it leaves is smooth, and so is the whole answer."""
    u = np.repeat([20.0, 40.0], [12, 120])
    y = u - 20.0
    for pole in (0.8, 0.85, 0.7):
        y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y)
    y = 3.0 + 0.04 * (y + 20.0) + 0.004 * rng.standard_normal(len(y))
    with pytest.warns(UserWarning, match="the model of order 1 lacks states"):
        model = SubspaceLTI(1).fit(u[:, None], y)
    assert model.lti_.dc_gain().item() == pytest.approx(0.04, rel=0.03)
    assert bft_score(y, model.predict(u[:, None])) > 85.0


def test_a_model_of_whitened_errors_that_the_likelihood_refutes_is_astray(rng):
    """Far worse in plain errors, and in the criterion, than the one of these."""
    right = example(rng, modes(0.95, 0.6 * np.exp(0.9j)), 1, 1)
    u, y = experiment(rng, right, 300, noise=0.1)
    record, settings = Record.of(u, y), Settings(freedom(1, 1))
    A, _, C, _ = right
    plain = Candidate(
        simulation_fit(A, C, [record], settings.free), 9, Whitening.none(1), True
    )
    # another system: what is left of the outputs is slow, and whitened away
    poor = simulation_fit(0.5 * A, C, [record], settings.free)
    chosen = plain._replace(model=poor)
    assert _is_astray(chosen, plain, [record], settings)
    assert not _is_astray(plain, chosen, [record], settings)
    assert not _is_astray(plain, plain, [record], settings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of what is not linear
def test_what_fits_small_motions_alone_does_not_pass_for_the_model():
    """Its whitened errors are small where little moves, which is most of the record."""
    u, y = sweep_of_a_hardening_spring(480, damping=0.01, cubic=3.0)
    y += 1e-3 * y.std() * np.random.default_rng(0).standard_normal(y.shape)
    assert SubspaceLTI().fit(u, y).residual_ < 0.5
