"""Largest singular values, their derivatives and their maxima."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn.systems.peaks import (
    PeakRefiner,
    _square_derivatives,
    _square_jet,
    sigma_max,
)
from lpvlearn.systems.response import FrequencyEngine

from .conftest import random_system


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (2, 2), (3, 2), (2, 4), (4, 3)])
def test_derivatives_of_the_singular_value_match_differences(
    shape: tuple[int, int],
) -> None:
    system = random_system(6, shape[1], shape[0], seed=3)
    engine = FrequencyEngine(*system)
    w, h = np.array([0.2, 0.7, 1.9, 5.0]), 1e-3
    value, slope, bend = _square_derivatives(*engine.derivatives(w))
    steps = np.arange(-3, 4) * h
    f = np.array([sigma_max(engine.response(w + step)) ** 2 for step in steps])
    first = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60.0 * h)
    second = np.array([2, -27, 270, -490, 270, -27, 2]) / (180.0 * h * h)
    for k, at in enumerate(w):
        jet = _square_jet(*engine.jet(at))
        assert_allclose(jet, [value[k], slope[k], bend[k]], rtol=1e-9, atol=1e-12)
    assert_allclose(value, f[3], rtol=1e-13)
    assert_allclose(slope, first @ f, rtol=1e-6, atol=1e-8 * f.max())
    assert_allclose(bend, second @ f, rtol=1e-6, atol=1e-6 * f.max())


@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (2, 2), (2, 5), (4, 4)])
def test_largest_singular_value_equals_the_svd(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    G = rng.standard_normal((*shape, 9)) + 1j * rng.standard_normal((*shape, 9))
    expected = np.linalg.svd(G.transpose(2, 0, 1), compute_uv=False)[:, 0]
    assert_allclose(sigma_max(G), expected, rtol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_maxima_between_coarse_samples_are_those_of_a_fine_grid(seed: int) -> None:
    refiner = PeakRefiner(FrequencyEngine(*random_system(6, seed=seed)))
    w, s = refiner.sampled(np.append(np.geomspace(1e-2, 1e2, 60), [0.0, np.inf]))
    floor = 0.5 * s.max()
    found = [peak for peak in refiner.every(w, s, floor) if 0 < peak.frequency < 1e2]
    fine = np.geomspace(1e-2, 1e2, 40_000)
    s = sigma_max(refiner.engine.response(fine))
    tops = np.flatnonzero((s[1:-1] > s[:-2]) & (s[1:-1] > s[2:])) + 1
    tops = tops[s[tops] > floor]
    values = [peak.value for peak in found if peak.value > floor]
    assert_allclose(values, s[tops], rtol=1e-6)
