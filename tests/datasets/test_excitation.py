"""Binary sequences and noise: levels, spectra, ratios."""

import numpy as np
import pytest

from lpvlearn.datasets import (
    make_flexible_arm,
    prbs,
)

from .conftest import COARSE


def test_prbs_has_two_levels_held_for_the_clock():
    u = prbs(1000, 3, amplitude=0.2, clock=7, random_state=0)
    assert u.shape == (1000, 3)
    np.testing.assert_array_equal(np.unique(u), [-0.2, 0.2])
    changes = np.flatnonzero(np.diff(u, axis=0).any(axis=1)) + 1
    assert (changes % 7 == 0).all()


def test_prbs_is_white_balanced_in_the_mean_and_uncorrelated():
    n = 2**15
    u = prbs(n, 2, random_state=0)
    bound = 4 / np.sqrt(n)  # four standard deviations
    assert np.abs(u.mean(axis=0)).max() < bound
    spectra = np.fft.fft(u, 2 * n, axis=0)
    lags = np.fft.ifft(np.abs(spectra) ** 2, axis=0).real[1:50] / n
    assert np.abs(lags).max() < bound
    cross = np.fft.ifft(spectra[:, 0] * spectra[:, 1].conj()).real / n
    assert np.abs(cross[:50]).max() < bound
    power = (np.abs(np.fft.fft(u, axis=0)) ** 2 / n).reshape(64, -1, 2).mean(axis=1)
    np.testing.assert_allclose(power, 1, atol=4 / np.sqrt(n / 64))


def test_held_prbs_has_the_squared_sinc_spectrum():
    clock, n = 5, 2**15
    u = prbs(n * clock, 1, clock=clock, random_state=1).ravel()
    power = np.abs(np.fft.rfft(u)) ** 2 / u.size
    bands = power[1 : 1 + 50 * (len(power) // 50)].reshape(50, -1).mean(axis=1)
    omega = np.pi * (np.arange(50) + 0.5) / 50
    expected = np.sin(clock * omega / 2) ** 2 / np.sin(omega / 2) ** 2 / clock
    np.testing.assert_allclose(bands, expected, atol=0.15 * expected.max())


def test_balanced_prbs_integrates_to_zero_over_each_window():
    u = prbs(400, 2, clock=4, balance=10, random_state=0)
    np.testing.assert_array_equal(u.reshape(10, 40, 2).sum(axis=1), 0)


@pytest.mark.slow
def test_noise_has_the_asked_signal_to_noise_ratio_and_is_white():
    options = {"n_operating_points": 2, "duration": 0.5, "sweep_duration": 0.01}
    noisy, clean = (
        make_flexible_arm(
            n_realizations=40, snr_db=snr, random_state=0, **options, **COARSE
        ).y.to_numpy()
        for snr in (20.0, np.inf)
    )
    v = (noisy - clean).reshape(2, 40, 500, 2)
    y = clean.reshape(2, 40, 500, 2)
    np.testing.assert_array_equal(y, y[:, :1].repeat(40, axis=1))
    snr = 10 * np.log10(y[:, 0].var(axis=1) / v.var(axis=(1, 2)))
    # the relative deviation of a variance of n samples is sqrt(2 / n)
    np.testing.assert_allclose(snr, 20, atol=4 * 4.343 * np.sqrt(2 / 20000))
    unit = (v / v.std(axis=(1, 2), keepdims=True)).reshape(-1, 2)
    bound = 4 / np.sqrt(len(unit))
    assert abs(np.mean(unit[:, 0] * unit[:, 1])) < bound
    assert np.abs(np.mean(unit[1:] * unit[:-1], axis=0)).max() < bound
    kurtosis = np.mean(unit**4, axis=0)
    np.testing.assert_allclose(kurtosis, 3, atol=4 * np.sqrt(24 / len(unit)))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"n_samples": 0}, "`n_samples` must be an integer of at least 1"),
        ({"clock": 1.5}, "`clock` must be an integer of at least 1"),
        ({"balance": 3}, "`balance` must be"),
    ],
)
def test_bad_options_of_prbs(options, message):
    with pytest.raises(ValueError, match=message):
        prbs(**{"n_samples": 10, **options})
