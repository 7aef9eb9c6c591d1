"""Norms of models with frequencies and directions."""

import numpy as np
import pytest

from lpvlearn import StateSpace, peak_gains


def resonator(omega, damping):
    return [[0, 1], [-(omega**2), -2 * damping * omega]], [[0], [omega**2]], [[1, 0]]


@pytest.mark.parametrize("sampling_time", [None, 0.05])
def test_singular_vectors_attain_the_peaks(sampling_time):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) - 4 * np.eye(6)
    model = StateSpace(A, rng.normal(size=(6, 2)), rng.normal(size=(3, 6)))
    model = model if sampling_time is None else model.to_discrete(sampling_time)
    peaks = peak_gains(model, within=0.9)
    G = model.frequency_response(peaks.frequencies)
    image = np.einsum("kpm,km->kp", G, peaks.right)
    np.testing.assert_allclose(image, peaks.values[:, None] * peaks.left, atol=1e-10)
    assert peaks.norm == peaks.values[0]
    assert np.isclose(peaks.norm, model.hinf_norm(), rtol=1e-10)


def test_equal_resonances_are_both_active():
    (A1, B1, C1), (A2, B2, C2) = resonator(2.0, 0.1), resonator(9.0, 0.1)
    A = np.block([[np.array(A1), np.zeros((2, 2))], [np.zeros((2, 2)), np.array(A2)]])
    B = np.block([[np.array(B1), np.zeros((2, 1))], [np.zeros((2, 1)), np.array(B2)]])
    C = np.block([[np.array(C1), np.zeros((1, 2))], [np.zeros((1, 2)), np.array(C2)]])
    peaks = peak_gains(StateSpace(A, B, C))
    expected = np.array([2.0, 9.0]) * np.sqrt(1 - 2 * 0.1**2)
    np.testing.assert_allclose(np.sort(peaks.frequencies), expected, rtol=1e-6)
    directions = np.abs(peaks.right[np.argsort(peaks.frequencies)])
    np.testing.assert_allclose(directions, np.eye(2), atol=1e-9)


def test_unstable_model():
    model = StateSpace([[1.0]], [[1.0]], [[2.0]])
    assert peak_gains(model).norm == np.inf
    assert peak_gains(model).frequencies.size == 0
    assert np.isclose(peak_gains(model, norm="linf").norm, 2.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"norm": "h2"}, "`norm` must be"), ({"within": 1.0}, "`within` must be")],
)
def test_errors_teach(options, words):
    with pytest.raises(ValueError, match=words):
        peak_gains(StateSpace(-1, 1, 1), **options)


@pytest.mark.parametrize("seed", [0, 3, 11226])
def test_the_norm_is_that_of_the_model_always(seed):
    """Also of companion forms, whose modes are too ill conditioned to be used."""
    rng = np.random.default_rng(seed)
    half = int(rng.integers(6, 31)) // 2
    w, z = 10 ** rng.uniform(0, 1, half), 10 ** rng.uniform(-3, -0.5, half)
    poles = w * (-z + 1j * np.sqrt(1 - z * z))
    a = np.real(np.poly(np.concatenate([poles, poles.conj()])))
    A = np.eye(2 * half, k=-1)
    A[0] = -a[1:]
    C = rng.normal(size=(1, 2 * half)) * np.abs(a[:-1]) * 10 ** rng.uniform(-3, 0)
    model = StateSpace(A, np.eye(2 * half)[:, :1], C)
    for within in (1e-6, 0.5):
        peaks = peak_gains(model, within=within)
        assert peaks.norm == peaks.values[0] == model.hinf_norm()
