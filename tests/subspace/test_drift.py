import warnings
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.metrics import bft_score
from lpvlearn.subspace.alternatives import drift, trends
from lpvlearn.subspace.alternatives.drift import differences, of_levels
from lpvlearn.subspace.evidence.statistics import StaticGain
from lpvlearn.subspace.fits.one_fit import Samples
from lpvlearn.subspace.fits.options import Choices
from lpvlearn.subspace.telling import Telling

from ..benchmarks import noisy_identification as noisy


def _plant(slow=30.0, fast=6.0):
    poles = np.exp([-1.0 / slow, -1.0 / fast])
    B = (1.0 - poles)[:, None] * [[1.0], [0.4]]
    return StateSpace(np.diag(poles), B, np.ones((1, 2)), None, 1.0)


def _record(seed, n_samples=1_000, drift=0.03, noise=0.05, start=0.0):
    """Steps of an input, and outputs that wander as far as they answer these."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n_samples // 20), 20)[:, None]
    y = _plant().simulate(u)[:, 0] + start
    y += drift * np.cumsum(rng.standard_normal(n_samples))
    return u, y + noise * rng.standard_normal(n_samples)


def _fresh_bft(model):
    u = np.repeat(np.random.default_rng(99).choice([-1.0, 1.0], 100), 20)[:, None]
    return bft_score(_plant().simulate(u), model.lti_.simulate(u))


def _quiet_fit(u, y, **options):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The (outputs drift|response|static gain)")
        warnings.filterwarnings("ignore", "Output . drifts along a line")
        return SubspaceLTI(sampling_time=1.0, **options).fit(u, y)


def _of_differences(model):
    return model._evidence.whitening.of_differences


class TestOfLevels:
    @pytest.mark.parametrize("offset", [None, "constant"])
    def test_differences_of_exact_samples_tell_the_same_system(self, offset):
        rng = np.random.default_rng(0)
        plant = _plant().transform(rng.standard_normal((2, 2)))
        u = rng.standard_normal((300, 1))
        y = plant.simulate(u, initial_state=[0.3, -1.0]) + 2.0 * (offset is not None)
        choices = Choices(order=2, horizon=8, offset=offset)
        n_trend = int(offset is not None)
        whole = Samples([(u, y)], choices, Telling()).fit(n_trend)
        found = Samples(differences([(u, y)]), choices, Telling()).fit(0)
        evidence = of_levels(found.evidence, whole.scaled, n_trend)
        omega = np.linspace(1e-3, np.pi, 20)
        response = evidence.state_space(evidence.model, 1.0)
        assert_allclose(
            response.frequency_response(omega),
            plant.frequency_response(omega),
            rtol=1e-9,
        )
        assert evidence.model.loss < 1e-15  # with initial states and constants

    def test_scales_of_several_channels_are_those_of_the_samples(self):
        rng = np.random.default_rng(1)
        A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.0], [0.0, 0.0, 0.7]])
        B, C = rng.standard_normal((3, 2)), rng.standard_normal((2, 3))
        plant = StateSpace(A, B * [1e3, 1e-2], C * [[1e-5], [1e4]], None, 1.0)
        u = np.cumsum(rng.standard_normal((400, 2)), axis=0) * [1e-3, 1e2]
        y = plant.simulate(u)
        choices = Choices(order=3, horizon=8)
        whole = Samples([(u, y)], choices, Telling()).fit(0)
        found = Samples(differences([(u, y)]), choices, Telling()).fit(0)
        evidence = of_levels(found.evidence, whole.scaled, 0)
        assert_allclose(
            evidence.state_space(evidence.model, 1.0).dc_gain(),
            plant.dc_gain(),
            rtol=1e-8,
        )


class TestDriftingOutputs:
    @pytest.mark.slow
    @pytest.mark.parametrize(("order", "most_told"), [("auto", 1), (2, 0)])
    def test_no_slow_state_follows_the_drift(self, order, most_told):
        """Or it is told."""
        fits, deviations, told = [], [], 0
        for seed in range(5):
            try:
                model = _quiet_fit(*_record(seed), order=order)
            except UserWarning:
                told += 1
                continue
            std = np.abs(model.frequency_response_std([1e-6])).item()
            error = (model.lti_.dc_gain() - _plant().dc_gain()).item()
            deviations.append(abs(error) / std)
            fits.append(_fresh_bft(model))
            assert (np.abs(1.0 - model.lti_.poles()) * 1_000 > 5.0).all()
        assert told <= most_told
        assert np.median(fits) > 85.0
        assert min(fits) > 50.0
        assert np.median(deviations) < 1.5
        assert max(deviations) < 4.0

    @pytest.mark.slow
    def test_where_the_outputs_stand_does_not_matter(self):
        models = [_quiet_fit(*_record(3, start=k)) for k in (0.0, 500.0)]
        gains = [model.lti_.dc_gain().item() for model in models]
        assert gains[0] == pytest.approx(gains[1], rel=1e-6)

    @pytest.mark.slow
    def test_outputs_drift_apart(self):
        u, y = _record(0)
        other = 20.0 * _record(10)[1] - 20.0 * _plant().simulate(_record(10)[0])[:, 0]
        answer = 20.0 * _plant().simulate(u)[:, 0]
        model = _quiet_fit(u, np.column_stack([y, answer + other]))
        assert _of_differences(model)
        gains = model.lti_.dc_gain().ravel() / [1.0, 20.0]
        std = np.abs(model.frequency_response_std([1e-6])).ravel() / [1.0, 20.0]
        assert (np.abs(gains - _plant().dc_gain().item()) < 3.5 * std).all()

    @pytest.mark.slow
    def test_experiments_wander_on_their_own(self):
        taken = 0
        for first in (0, 4, 8):
            parts = [_record(first + k, n_samples=400) for k in range(4)]
            X = pd.DataFrame({"u": np.vstack([u for u, _ in parts])[:, 0]})
            X["run"] = np.repeat(np.arange(4), 400)
            y = np.concatenate([y for _, y in parts])
            model = _quiet_fit(X, y, experiment="run")
            taken += _of_differences(model)
            assert _fresh_bft(model) > 90.0
        assert taken > 1

    def test_a_model_that_drift_outweighs_is_told_so(self):
        with pytest.warns(UserWarning, match="The outputs drift.*predict_ahead"):
            SubspaceLTI(2, sampling_time=1.0).fit(*_record(1, drift=0.3))

    @pytest.mark.broad
    @pytest.mark.parametrize("seed", range(3))
    def test_states_of_a_given_order_are_left_to_the_plant(self, seed):
        """A straight line, which one of them would follow."""
        rng = np.random.default_rng(seed)
        plant = StateSpace([[0.0, 1.0], [-40.0, -1.2]], [[0.0], [30.0]], [[1.0, 0.0]])
        plant = plant.to_discrete(0.02)
        u = rng.choice([-1.0, 1.0], (150, 1)).repeat(6, axis=0)
        y = plant.simulate(u)
        y += np.linspace(0.0, 8.0 * y.std(), len(y))[:, None]
        y += 0.01 * y.std() * rng.standard_normal(y.shape)
        model = _quiet_fit(u, y, order=2)
        assert model.offset_ == "linear"
        assert_allclose(model.lti_.dc_gain(), plant.dc_gain(), rtol=0.05)


class TestOutputsThatDoNotDrift:
    @pytest.mark.parametrize("colour", [0.0, 0.9])
    def test_slow_modes_are_told_by_the_samples(self, colour):
        rng = np.random.default_rng(4)
        u = np.repeat(rng.choice([-1.0, 1.0], 50), 40)[:, None]
        plant, e = _plant(slow=150.0), rng.standard_normal(2_000)
        v = np.zeros(2_000)
        for t in range(1, 2_000):
            v[t] = colour * v[t - 1] + e[t]
        y = plant.simulate(u)[:, 0] + 0.2 * v * np.sqrt(1.0 - colour**2)
        model = SubspaceLTI(sampling_time=1.0).fit(u, y)
        assert not _of_differences(model)
        std = np.abs(model.frequency_response_std([1e-6])).item()
        assert abs((model.lti_.dc_gain() - plant.dc_gain()).item()) < 3.5 * std

    @pytest.mark.slow
    def test_nothing_drifts_beside_as_many_states(self, monkeypatch):
        """Whatever the samples looked like with others."""
        monkeypatch.setattr(drift, "may_drift", lambda fitted: True)
        monkeypatch.setattr(drift, "drifts", lambda whole, other, doubt=0.0: True)
        u, y = _record(0, drift=0.0, noise=0.3)
        model = _quiet_fit(u, y)
        assert not _of_differences(model)
        assert model.offset_ == "constant"  # as beside differences
        assert _fresh_bft(model) > 95.0
        u, y = _record(0)
        assert _of_differences(_quiet_fit(u, y, method="po-moesp"))

    def test_a_drift_that_takes_the_static_gain_is_what_inputs_do(self):
        """A gain known to 10 %, and one to 150 %, of a response of size one."""
        known, lost = (
            StaticGain(np.ones((1, 1)), np.full((1, 1), std), np.ones((1, 1)))
            for std in (0.1, 1.5)
        )
        evidence = [
            SimpleNamespace(static_gain=lambda gain=gain: gain)
            for gain in (known, lost, None)
        ]
        takes = [[trends._takes_a_gain(a, b) for b in evidence] for a in evidence]
        assert takes == [[False, True, False]] + [[False] * 3] * 2

    def test_what_was_said_of_the_refinement_is_heeded(self):
        u, y = _record(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = SubspaceLTI(2, sampling_time=1.0, refine="simulation").fit(u, y)
        assert not _of_differences(model)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 11])
def test_noise_that_shakes_slow_modes_may_be_more_than_drift(seed):
    rng = np.random.default_rng(seed)
    A = np.array([[0.985, 0.15, 0.0], [-0.15, 0.985, 0.0], [0.0, 0.0, 0.995]])
    B, C = rng.standard_normal((3, 1)), np.array([[1.0, 0.5, 1.0], [0.0, 1.0, -1.0]])
    plant = StateSpace(A, B, C, None, 1.0)
    u = np.repeat(rng.choice([-1.0, 1.0], (30, 1)), 10, axis=0)
    K, w = 0.25 * rng.standard_normal((3, 2)), rng.standard_normal((300, 2))
    y, v = plant.simulate(u), StateSpace(A, K, C, np.eye(2), 1.0).simulate(w)
    model = _quiet_fit(u, y + 0.5 * y.std() / v.std() * v)
    fresh = rng.standard_normal((1_000, 1))
    target = plant.simulate(fresh)
    error = model.lti_.simulate(fresh) - target
    assert np.linalg.norm(error) < 0.25 * np.linalg.norm(target)


def _thermal(seed, slowest, drift, samples=600):
    """Two lags, one of up to half the record, and an output that drifts along a line.

    Units of the time are samples; the drift is by the output's standard deviation.
    """
    rng = np.random.default_rng(seed)
    A = [[-1.0 / slowest, 0.0], [1.0 / 16.0, -1.0 / 16.0]]
    plant = StateSpace(A, [[1.0 / slowest], [0.0]], [[0.0, 2.5]])
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 20), 20)[:, None]
    y = plant.simulate(u, sampling_time=1.0)[:, 0]
    line = drift * y.std() * np.linspace(0.0, 1.0, samples)
    return plant, u, y + line + 0.01 * y.std() * rng.standard_normal(samples)


@pytest.mark.broad
@pytest.mark.filterwarnings("ignore:Output 1 drifts along a line")
@pytest.mark.parametrize("slowest", [120.0, 300.0])
@pytest.mark.parametrize(("drift", "part"), [(0.3, None), (1.0, None), (1.0, 0.05)])
def test_no_slow_mode_stands_for_a_line_beside_slow_ones(slowest, drift, part):
    """Nor where outputs are rounded, to a part of their standard deviation."""
    plant, u, y = _thermal(0, slowest, drift)
    if part is not None:
        y = part * y.std() * np.round(y / (part * y.std()))
    model = SubspaceLTI(sampling_time=1.0).fit(u, y)
    assert (model.order_, model.offset_) == (2, "linear")
    fresh = _thermal(50, slowest, 0.0)[1]
    truth = plant.simulate(fresh, sampling_time=1.0)
    assert bft_score(truth, model.lti_.simulate(fresh)) > (95.0 if part else 98.0)


@pytest.mark.broad
@pytest.mark.parametrize("level", [0.0, 20.0])
def test_constants_are_not_where_the_noise_has_drifted(level):
    """By its size they are told from where outputs stand."""
    rng = np.random.default_rng(0)
    plant = StateSpace([[0.9, 0.2], [-0.2, 0.9]], [[1], [0]], [[1, 0]], None, 1.0)
    u = np.repeat(rng.choice([-1.0, 1.0], (60, 1)), 10, axis=0)
    y = plant.simulate(u)
    walk = np.cumsum(rng.standard_normal(y.shape), axis=0)
    drift = 0.5 * y.std() / walk.std() * walk
    model = SubspaceLTI(sampling_time=1.0).fit(u, y + drift + level * y.std())
    assert _of_differences(model)
    expected = (drift.mean() + level * y.std()) if level else 0.0
    assert model.output_offset_.item() == pytest.approx(expected, abs=0.2 * y.std())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_parts_held_out_confirm_states_that_what_drifts_moves():
    """A walk beside white noise: by differences the slow state was lost (63 %)."""
    rng = np.random.default_rng(505)
    plant = noisy._slow_plant(rng, 400.0)
    n_samples = int(np.exp(rng.uniform(np.log(150), np.log(2000))))
    u, fresh = (noisy._held_or_not(rng, n) for n in (n_samples, 2000))
    y = plant.simulate(u)
    y = y + y.std() * noisy._SLOW_NOISE["and white"](rng, n_samples)[:, None]
    y = y + 5.0 * y.std() * (rng.random() < 0.5)
    model = SubspaceLTI(sampling_time=1.0).fit(u, y)
    assert bft_score(plant.simulate(fresh), model.lti_.simulate(fresh)) > 85.0
