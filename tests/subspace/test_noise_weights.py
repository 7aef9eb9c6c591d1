"""A model estimated once more with every output in units of its noise."""

import numpy as np
import pytest

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.noise_weights import noise_weighted
from lpvlearn.systems.simulation import lti_response

TRUTH = StateSpace(
    [[0.8, 0.3], [-0.3, 0.7]], [[1.0], [0.5]], np.eye(2), sampling_time=1.0
)
OMEGA = np.linspace(0.05, 3, 20)


def record(noise, seed=0, n_samples=1000):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, 1))
    y = TRUTH.simulate(u)
    return u, y + y.std(0) * noise * rng.standard_normal(y.shape)


def fitted(u, y):
    return SubspaceLTI(2, horizon=8, feedthrough=False).fit(u, y).lti_


def errors(model, u, y):
    return y - lti_response(model.A, model.B, model.C, model.D, u)


@pytest.mark.parametrize("seed", range(3))
def test_the_units_become_those_of_the_noise(seed):
    u, y = record([0.01, 1.0], seed)
    found = noise_weighted(fitted(u, y), [(u, y)])
    noise = TRUTH.simulate(u).std(0) * [0.01, 1.0]
    ratio = found.output_scale / noise
    assert np.isclose(ratio[0] / ratio[1], 1.0, rtol=0.15)
    # White errors of that size, uncorrelated with the inputs, are all that is left.
    left = errors(found.lti, u, y)[20:].std(0)
    np.testing.assert_allclose(left, noise, rtol=0.1)


def test_a_poor_sensor_no_longer_spoils_a_good_one():
    def row_errors(model):
        gap = model.frequency_response(OMEGA) - TRUTH.frequency_response(OMEGA)
        return np.sqrt(np.mean(np.abs(gap) ** 2, axis=(0, 2)))

    before, after = [], []
    for seed in range(4):
        u, y = record([0.01, 1.0], seed)
        plain = fitted(u, y)
        before.append(row_errors(plain))
        after.append(row_errors(noise_weighted(plain, [(u, y)]).lti))
    before, after = np.median(before, axis=0), np.median(after, axis=0)
    assert after[0] < 0.1 * before[0] and after[1] < 1.1 * before[1]


def test_the_weighted_error_is_least():
    u, y = record([0.05, 1.0])
    y = y[:, ::-1].copy()
    found, unit = noise_weighted(fitted(u, y), [(u, y)])

    def loss(model):
        return np.sum((errors(model, u, y) / unit) ** 2)

    least = loss(found)
    rng = np.random.default_rng(1)
    for _ in range(20):
        changed = StateSpace(
            found.A * (1 + 3e-2 * rng.normal(size=(2, 2))),
            found.B,
            found.C,
            sampling_time=1.0,
        )
        assert loss(changed) > least


def test_noise_in_proportion_leaves_the_model_as_it_is():
    u, y = record([0.1, 0.1])
    plain = fitted(u, y)
    assert noise_weighted(plain, [(u, y)]).lti is plain
    assert noise_weighted(plain, [(u[:500], y[:500]), (u[500:], y[500:])]).lti is plain


def test_one_output_has_nothing_to_weigh():
    u, y = record([0.1, 0.1])
    plain = fitted(u, y[:, :1])
    assert noise_weighted(plain, [(u, y[:, :1])]).lti is plain


def test_units_of_the_outputs_do_not_matter():
    u, y = record([0.02, 1.0])
    one = noise_weighted(fitted(u, y), [(u, y)])
    factor = np.array([1e-3, 1e4])
    other = noise_weighted(fitted(u, y * factor), [(u, y * factor)])
    np.testing.assert_allclose(other.output_scale, one.output_scale * factor, rtol=1e-3)
    np.testing.assert_allclose(
        other.lti.frequency_response(OMEGA),
        factor[:, None] * one.lti.frequency_response(OMEGA),
        rtol=1e-4,
    )


def test_an_offset_is_taken_off_as_in_the_fit():
    u, y = record([0.01, 1.0])
    shifted = y + [3.0, -2.0]
    plain = noise_weighted(fitted(u, y), [(u, y)], detrend="constant")
    moved = noise_weighted(fitted(u, y), [(u, shifted)], detrend="constant")
    np.testing.assert_allclose(moved.lti.A, plain.lti.A, rtol=1e-8)


def test_without_noise_the_model_stays():
    u, y = record([0.0, 0.0])
    plain = fitted(u, y)
    found = noise_weighted(plain, [(u, y)]).lti
    np.testing.assert_allclose(
        found.frequency_response(OMEGA), plain.frequency_response(OMEGA), rtol=1e-9
    )
