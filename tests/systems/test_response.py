"""Frequency responses against independent formulas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lpvlearn.systems.response import (
    FrequencyEngine,
    equilibrated,
    frequency_response,
    pole_grid,
    pole_rates,
    resolvent,
)

from .conftest import random_system

Matrices = tuple[NDArray, NDArray, NDArray, NDArray]


def jordan_chain(n: int = 6) -> Matrices:
    """1 / (s + 1)**n: the eigenvectors are all one."""
    A = -np.eye(n) + np.eye(n, k=-1)
    return A, np.eye(n)[:, :1], np.eye(n)[-1:], np.zeros((1, 1))


def solved_at(system: Matrices, x: complex) -> NDArray:
    A, B, C, D = system
    return C @ np.linalg.solve(x * np.eye(len(A)) - A, B.astype(complex)) + D


def test_resolvent_vanishes_at_infinity() -> None:
    assert not resolvent(np.eye(2), np.array([np.inf + 0j])).any()


def test_continuous_response_is_the_resolvent_formula() -> None:
    system = random_system()
    omega = np.array([0.0, 0.3, 2.0, 50.0])
    expected = [solved_at(system, 1j * w) for w in omega]
    assert_allclose(frequency_response(*system, omega), expected, rtol=1e-11)


def test_discrete_response_is_evaluated_on_the_unit_circle() -> None:
    A, B, C, D = random_system()
    system = (0.1 * A, B, C, D)
    omega = np.array([0.0, 3.0, np.pi / 0.02])
    expected = [solved_at(system, np.exp(1j * w * 0.02)) for w in omega]
    assert_allclose(frequency_response(*system, omega, dt=0.02), expected, rtol=1e-11)


def test_infinite_frequency_gives_the_feedthrough() -> None:
    system = random_system()
    assert_array_equal(frequency_response(*system, [np.inf])[0], system[3])


def test_infinite_frequency_is_refused_in_discrete_time() -> None:
    with pytest.raises(ValueError, match=r"`omega` must be finite.*pi/dt"):
        frequency_response(*random_system(), [np.inf], dt=0.1)


def test_order_zero_is_the_feedthrough_everywhere() -> None:
    D = np.array([[1.0, 2.0]])
    G = frequency_response(
        np.empty((0, 0)), np.empty((0, 2)), np.empty((1, 0)), D, [0.0, 1.0, np.inf]
    )
    assert_array_equal(G, np.tile(D, (3, 1, 1)))


def test_response_at_a_pole_on_the_axis_is_infinite() -> None:
    one = np.ones((1, 1))
    G = frequency_response(0.0 * one, one, one, one, [0.0, 1.0])
    assert np.isinf(G[0, 0, 0])
    assert G[1, 0, 0] == 1.0 - 1.0j


def test_roll_off_keeps_its_digits_far_above_the_poles() -> None:
    """Modal terms cancel to 1e-18 of their size here."""
    n, omega = 6, 1e3
    poles = np.arange(1.0, n + 1.0)
    A = -np.diag(poles) + np.eye(n, k=-1)
    G = frequency_response(A, np.eye(n)[:, :1], np.eye(n)[-1:], np.zeros((1, 1)), omega)
    assert_allclose(G[0, 0, 0], 1.0 / np.prod(1j * omega + poles), rtol=1e-12)


def test_response_is_accurate_where_eigenvectors_are_useless() -> None:
    system = jordan_chain()
    engine = FrequencyEngine(*system)
    assert not engine.is_modal
    omega = np.array([0.0, 0.5, 3.0])
    expected = 1.0 / (1j * omega + 1.0) ** 6
    assert_allclose(engine.response(omega)[0, 0], expected, rtol=1e-12)
    assert_allclose(frequency_response(*system, omega)[:, 0, 0], expected, rtol=1e-12)


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("system", [random_system(), jordan_chain()])
def test_derivatives_are_those_of_the_resolvent(
    system: Matrices, discrete: bool
) -> None:
    A, B, C, D = system
    A = 0.1 * A if discrete else A
    engine = FrequencyEngine(A, B, C, D, discrete=discrete)
    for w in (0.0, 0.4, 3.0):
        x = np.exp(1j * w) if discrete else 1j * w
        R = np.linalg.inv(x * np.eye(len(A)) - A)
        x1, x2 = (1j * x, -x) if discrete else (1j, 0.0)
        slope = -C @ R @ R @ B * x1
        bend = 2.0 * C @ R @ R @ R @ B * x1**2 - C @ R @ R @ B * x2
        G, G1, G2 = (M[:, :, 0] for M in engine.derivatives(np.array([w])))
        assert_allclose(G, C @ R @ B + D, atol=1e-11 * abs(G).max())
        assert_allclose(G1, slope, atol=1e-11 * abs(slope).max())
        assert_allclose(G2, bend, atol=1e-11 * abs(bend).max())
        solved = engine.solved(np.array([w]))
        assert_allclose(solved[:, :, 0], G, atol=1e-11 * abs(G).max())
        for found, expected in zip(engine.jet(w), (G, slope, bend), strict=True):
            assert_allclose(found, expected, atol=1e-11 * abs(expected).max())


def test_fast_sampling_loses_no_digits() -> None:
    """One step of 1e-9 s of a lag of 1 s: all of A is in its last digits."""
    step = 2.0**-30
    A, B = np.array([[1.0 - step]]), np.array([[step]])
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    G = frequency_response(A, B, one, zero, [0.0, 1.0], dt=step)[:, 0, 0]
    assert_allclose(G[0], 1.0, rtol=1e-14)
    assert_allclose(G[1], 1.0 / (1.0 + 1.0j), rtol=2.0 * step)


def test_solves_are_refined_at_a_nearly_undamped_mode() -> None:
    """The exact gain at resonance, in coordinates that mix slow and fast."""
    w, z, fast = 2.0**-6, 2.0**-24, 64.0
    A = np.zeros((3, 3))
    A[:2, :2] = [[0.0, w], [-w, -2.0 * z * w]]
    A[2, 2] = -fast
    B, C = np.array([[0.0], [w], [0.0]]), np.array([[2.0 * z, 0.0, 0.0]])
    mix = np.eye(3) + np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0]])
    back = 2.0 * np.eye(3) - mix
    engine = FrequencyEngine(mix @ A @ back, mix @ B, C @ back, np.zeros((1, 1)))
    G = engine.solved(np.array([w]))[0, 0, 0]
    assert_allclose(G, -1j, rtol=1e-8)
    assert_allclose(engine.jet(w)[0], [[-1j]], rtol=1e-8)


def test_equilibration_leaves_the_response_alone() -> None:
    A, B, C, D = random_system()
    s = 2.0 ** np.arange(-12, 16, 4)
    scaled = A * s / s[:, None], B / s[:, None], C * s
    Ab, Bb, Cb = equilibrated(*scaled)
    assert np.abs(Ab).max() < 1e2 * np.abs(A).max()
    for w in (0.0, 1.0):
        assert_allclose(
            solved_at((Ab, Bb, Cb, D), 1j * w), solved_at((A, B, C, D), 1j * w)
        )


@pytest.mark.parametrize("dt", [None, 0.1])
def test_grid_of_poles_stands_on_every_resonance(dt: float | None) -> None:
    rates = np.array([-0.1 + 4j, -0.1 - 4j, -2.0])
    poles = rates if dt is None else np.exp(rates * dt)
    found = pole_rates(poles, dt)
    assert_allclose(found, rates, rtol=1e-12)
    grid = pole_grid(found, 0.1, 10.0, 5, [0.0, 1.0])
    assert (np.diff(grid) > 0).all()
    for w in (0.1, 1.0, 10.0, 4.0, 4.1, 2.0):
        assert np.abs(grid - w).min() < 1e-9
    assert pole_rates(np.array([0.0]), 0.1).real < -200.0  # a delay is fast
