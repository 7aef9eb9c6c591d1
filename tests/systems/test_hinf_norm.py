"""The H-infinity norm against published, analytic and dense-grid values."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import cheby1, cont2discrete, tf2ss

from lpvlearn.systems.hinf_norm import _LevelSets, hinf_norm, linf_norm
from lpvlearn.systems.response import FrequencyEngine, frequency_response

from . import conftest

Matrices = tuple[NDArray, NDArray, NDArray, NDArray]


def load_stress() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "stress_hinf.py"
    spec = importlib.util.spec_from_file_location("stress_hinf", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


stress = load_stress()


def lag(w: float, z: float, gain: float = 1.0) -> Matrices:
    """gain * w**2 / (s**2 + 2 z w s + w**2)."""
    A = np.array([[0.0, w], [-w, -2.0 * z * w]])
    return A, np.array([[0.0], [w]]), np.array([[gain, 0.0]]), np.zeros((1, 1))


def peak_of_lag(z: float) -> float:
    return 1.0 / (2.0 * z * np.sqrt(1.0 - z * z))


def stacked(*systems: Matrices) -> Matrices:
    A, B, C, D = (block_diag(*parts) for parts in zip(*systems, strict=True))
    return A, B, C, D


def random_system(n: int, shape: tuple[int, int], seed: int) -> Matrices:
    return conftest.random_system(n, shape[1], shape[0], seed, decay=0.1)


# ------------------------------------------------------- published values


def test_three_undamped_modes_of_the_slicot_documentation() -> None:
    modes = [(0.5, 2e-4), (1.0, 2e-5), (2.0, 2e-6)]
    A = block_diag(*([[0.0, 1.0], [-k, -d]] for k, d in modes))
    B = np.tile([[1.0], [0.0]], (3, 1))
    C = np.tile([[1.0, 0.0]], (1, 3))
    peaks = hinf_norm(A, B, C, np.zeros((1, 1)))
    assert_allclose(peaks.norm, 5.0e5, rtol=1e-5)
    assert_allclose(peaks.frequencies, [np.sqrt(2.0)], rtol=1e-9)


def test_two_by_two_textbook_example() -> None:
    """[0, 3 s / (s**2 + s + 10); (s + 1) / (s + 5), 2 / (s + 6)]."""
    A = block_diag([[0.0, 1.0], [-10.0, -1.0]], -5.0, -6.0)
    B = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    C = np.array([[0.0, 3.0, 0.0, 0.0], [0.0, 0.0, -4.0, 2.0]])
    peaks = hinf_norm(A, B, C, np.array([[0.0, 0.0], [1.0, 0.0]]))
    assert_allclose(peaks.norm, 3.0150, atol=5e-5)
    # Published to the accuracy of the norm, on which a flat top depends little.
    assert_allclose(peaks.frequencies, [3.1623], rtol=1e-4)


def test_two_states_with_the_peak_close_to_the_feedthrough() -> None:
    """An absolute test for imaginary eigenvalues stops at D, 3.3 % too low."""
    A = np.array([[0.0, 458.24243777031757], [-1282.2184000441548, -1535.339096943864]])
    B = np.array([[422.25740331797454], [637.9048701016075]])
    C = np.array([[-1.6314470718364684, 0.1535014796656777]])
    peaks = hinf_norm(A, B, C, np.array([[3.887020429365412]]))
    assert_allclose(peaks.norm, 4.01933787227, rtol=1e-11)
    assert_allclose(peaks.frequencies, [1488.35], atol=5e-3)


# -------------------------------------------------------- analytic values


@pytest.mark.parametrize("z", [0.6, 0.1, 1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("w", [1e-8, 1.0, 1e8])
def test_damped_lag_in_closed_form(w: float, z: float) -> None:
    peaks = hinf_norm(*lag(w, z), within=0.9)
    assert_allclose(peaks.norm, peak_of_lag(z), rtol=1e-9)
    top = w * np.sqrt(1.0 - 2.0 * z * z)
    assert_allclose(peaks.frequencies[0], top, rtol=1e-6 * z + 1e-15)


def test_overdamped_lag_peaks_at_zero() -> None:
    peaks = hinf_norm(*lag(3.0, 0.9, gain=2.0), within=0.99)
    assert_allclose(peaks.norm, 2.0, rtol=1e-14)
    assert_array_equal(peaks.frequencies, [0.0])


def test_high_pass_peaks_at_infinity() -> None:
    one = np.ones((1, 1))
    peaks = hinf_norm(-one, one, -one, one, within=0.5)
    assert peaks.norm == 1.0
    assert_array_equal(peaks.frequencies, [np.inf])


def test_zero_and_infinity_are_both_reported() -> None:
    """(s**2 + 0.1 s + 1) / (s**2 + 2 s + 1) is one at both ends."""
    A = np.array([[0.0, 1.0], [-1.0, -2.0]])
    B, C = np.array([[0.0], [1.0]]), np.array([[0.0, -1.9]])
    peaks = hinf_norm(A, B, C, np.ones((1, 1)), within=0.1)
    assert_allclose(peaks.values, 1.0, rtol=1e-12)
    assert set(peaks.frequencies) == {0.0, np.inf}


@pytest.mark.parametrize("pole", [0.5, -0.5, 0.999999, -0.999999, 0.0])
def test_discrete_lag_peaks_at_the_end_of_the_axis(pole: float) -> None:
    dt, one = 0.01, np.ones((1, 1))
    peaks = hinf_norm(pole * one, one, one, 0.0 * one, dt=dt)
    assert_allclose(peaks.norm, 1.0 / (1.0 - abs(pole)), rtol=1e-9)
    if pole:
        assert_allclose(peaks.frequencies, [0.0 if pole > 0 else np.pi / dt])


@pytest.mark.parametrize("radius", [0.8, 0.99, 1.0 - 1e-6])
def test_discrete_resonance_in_closed_form(radius: float) -> None:
    """|z**2 - 2 r c z + r**2|**2 is a parabola in cos(omega)."""
    c, dt = np.cos(1.2), 0.1
    A = np.array([[2.0 * radius * c, -(radius**2)], [1.0, 0.0]])
    B, C = np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]])
    peaks = hinf_norm(A, B, C, np.zeros((1, 1)), dt=dt)
    top = np.arccos(0.5 * c * (1.0 + radius**2) / radius)
    norm = 1.0 / ((1.0 - radius**2) * np.sqrt(1.0 - c * c))
    assert_allclose(peaks.frequencies, [top / dt], rtol=1e-9)
    assert_allclose(peaks.norm, norm, rtol=1e-9)


def test_bilinear_sampling_keeps_the_norm_and_warps_the_peaks() -> None:
    dt = 0.3
    for seed in range(5):
        system = random_system(6, (2, 3), seed)
        sampled = cont2discrete(system, dt, method="bilinear")[:4]
        peaks = hinf_norm(*system, within=0.5)
        mapped = hinf_norm(*sampled, dt=dt, within=0.5)
        assert_allclose(mapped.values, peaks.values, rtol=1e-9)
        warped = 2.0 / dt * np.arctan(0.5 * dt * peaks.frequencies)
        assert_allclose(mapped.frequencies, warped, rtol=1e-7)


def test_band_pass_with_a_zero_at_both_ends() -> None:
    """2 z s / (s**2 + 2 z s + 1) is one at one."""
    for z in (0.9, 0.1, 1e-4):
        A = np.array([[0.0, 1.0], [-1.0, -2.0 * z]])
        B, C = np.array([[0.0], [1.0]]), np.array([[0.0, 2.0 * z]])
        peaks = hinf_norm(A, B, C, np.zeros((1, 1)), within=0.99)
        assert_allclose([peaks.norm, *peaks.frequencies], [1.0, 1.0], rtol=1e-9)


def test_discrete_delay_is_all_pass() -> None:
    A = np.eye(4, k=-1)
    system = A, np.eye(4)[:, :1], np.eye(4)[-1:], np.zeros((1, 1))
    assert_allclose(hinf_norm(*system, dt=1.0).norm, 1.0, rtol=1e-12)


def test_all_pass_has_norm_one() -> None:
    """(s**2 - 2 z s + 1) / (s**2 + 2 z s + 1)."""
    A = np.array([[0.0, 1.0], [-1.0, -0.2]])
    B, C = np.array([[0.0], [1.0]]), np.array([[0.0, -0.4]])
    peaks = hinf_norm(A, B, C, np.ones((1, 1)), within=0.3)
    assert_allclose(peaks.norm, 1.0, rtol=1e-12)
    assert len(peaks.frequencies) == 1


# ------------------------------------------------------------- all peaks


def test_equal_peaks_are_all_found() -> None:
    z = [1e-6, 1e-3, 0.1]
    w = [0.1, 1.0, 30.0]
    parts = [lag(wk, zk, 1.0 / peak_of_lag(zk)) for wk, zk in zip(w, z, strict=True)]
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
    A, B, C, D = stacked(*parts)
    peaks = hinf_norm(A, B @ V, U @ C, U @ D @ V, within=1e-6)
    assert_allclose(peaks.values, np.ones(3), rtol=1e-8)
    tops = np.array(w) * np.sqrt(1.0 - 2.0 * np.array(z) ** 2)
    assert_allclose(np.sort(peaks.frequencies), tops, rtol=1e-9)


@pytest.mark.parametrize("order", [4, 7, 10])
def test_every_ripple_of_a_chebyshev_filter_is_found(order: int) -> None:
    """Unit peaks at the zeros of the polynomial; warped when sampled."""
    zeros = np.cos((2.0 * np.arange(order) + 1.0) * np.pi / (2 * order))
    ripples = np.sort(zeros[zeros > -1e-9]).clip(0.0)
    system = tf2ss(*cheby1(order, 1.0, 1.0, analog=True))
    peaks = hinf_norm(*system, within=1e-6)
    assert_allclose(peaks.values, 1.0, rtol=1e-8)
    assert_allclose(np.sort(peaks.frequencies), ripples, rtol=1e-5, atol=1e-6)
    system = tf2ss(*cheby1(order, 1.0, 0.3))
    peaks = hinf_norm(*system, dt=0.1, within=1e-6)
    warped = 20.0 * np.arctan(np.tan(0.15 * np.pi) * ripples)
    assert_allclose(np.sort(peaks.frequencies), warped, rtol=1e-5, atol=1e-5)


def test_peaks_1e_5_apart_are_separated() -> None:
    z = 5e-7
    A, B, C, D = stacked(lag(1.0, z, 1e-6), lag(1.0 + 1e-5, z, 0.9e-6))
    one = np.ones((2, 1))
    peaks = hinf_norm(A, B @ one, one.T @ C, np.zeros((1, 1)), within=0.6)
    assert_allclose(peaks.frequencies, [1.0, 1.0 + 1e-5], atol=1e-8)


def test_two_broad_maxima_of_crossing_branches_are_separated() -> None:
    """Peaks 1 % apart, closer than the width of either."""
    parts = lag(1.0, 0.02, 1.0 / peak_of_lag(0.02)), lag(1.012, 0.02, 0.0399)
    A, B, C, D = stacked(*parts)
    w = np.linspace(0.9, 1.1, 4001)
    s = np.abs(frequency_response(A, B, C, D, w)).max((1, 2))
    tops = np.flatnonzero((s[1:-1] > s[:-2]) & (s[1:-1] > s[2:])) + 1
    peaks = hinf_norm(A, B, C, D, within=0.2)
    assert len(tops) == 2
    assert_allclose(np.sort(peaks.frequencies), w[tops], atol=1e-4)


def test_only_peaks_within_the_fraction_are_reported() -> None:
    heights = np.array([1.0, 0.7, 0.35])
    parts = [
        lag(w, 0.01, h / peak_of_lag(0.01))
        for w, h in zip([1.0, 5.0, 25.0], heights, strict=True)
    ]
    for within, count in [(0.0, 1), (0.25, 1), (0.31, 2), (0.66, 3)]:
        peaks = hinf_norm(*stacked(*parts), within=within)
        assert_allclose(peaks.values, heights[:count], rtol=1e-9)


def test_peaks_are_stationary_and_no_sample_is_higher() -> None:
    w = np.geomspace(1e-3, 1e3, 4000)
    for seed in range(10):
        system = random_system(9, (2, 2), seed)
        peaks = linf_norm(*system, within=0.6)
        s = np.linalg.svd(frequency_response(*system, w), compute_uv=False)[:, 0]
        assert s.max() <= peaks.norm * (1.0 + 1e-12)
        tops = np.flatnonzero((s[1:-1] > s[:-2]) & (s[1:-1] > s[2:])) + 1
        tops = tops[s[tops] > 0.401 * peaks.norm]
        found = peaks.frequencies[(peaks.frequencies > 0) & (peaks.frequencies < 1e6)]
        assert_allclose(np.sort(found), w[tops], rtol=4e-3)


# ------------------------------------------------------------ invariances


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(-26, 26), st.integers(-20, 20))
def test_time_and_channel_scale_only_rescale(seed: int, time: int, gain: int) -> None:
    A, B, C, D = random_system(5, (2, 2), seed)
    t, g = 2.0**time, 2.0**gain
    one = linf_norm(A, B, C, D, within=0.5)
    other = linf_norm(A * t, B * t * g, C, D * g, within=0.5)
    assert_allclose(other.values, one.values * g, rtol=1e-9)
    # a peak at zero is found there, or where rounding alone makes the slope
    assert_allclose(other.frequencies, one.frequencies * t, rtol=1e-7, atol=1e-9 * t)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_similarity_leaves_the_norm_alone(scale: float) -> None:
    rng = np.random.default_rng(1)
    for seed in range(5):
        A, B, C, D = random_system(6, (3, 2), seed)
        T = rng.standard_normal((6, 6)) * np.geomspace(1.0, scale, 6)
        moved = np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T, D
        assert_allclose(hinf_norm(*moved).norm, hinf_norm(A, B, C, D).norm, rtol=1e-9)


def test_transposed_system_has_the_same_peaks() -> None:
    A, B, C, D = random_system(7, (4, 2), 0)
    one, other = linf_norm(A, B, C, D, within=0.5), linf_norm(A.T, C.T, B.T, D.T)
    assert_allclose(other.norm, one.norm, rtol=1e-11)


def test_hidden_modes_do_not_count() -> None:
    A, B, C, D = random_system(4, (2, 2), 2)
    hidden = lag(2.0, 1e-6)[0]
    A2 = np.block([[A, np.ones((4, 2))], [np.zeros((2, 4)), hidden]])
    system = A2, np.vstack((B, np.zeros((2, 2)))), np.hstack((C, np.ones((2, 2)))), D
    expected = hinf_norm(A, B, C, D).norm
    assert_allclose(hinf_norm(*system).norm, expected, rtol=1e-9)


@pytest.mark.parametrize(("condition", "floor"), [(1.0, 1e-14), (1e2, 1e-11)])
def test_difference_of_a_system_and_itself_is_rounding(
    condition: float, floor: float
) -> None:
    A, B, C, D = random_system(6, (2, 2), 4)
    T = np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))[0]
    T = T * np.geomspace(1.0, condition, 6) if condition > 1.0 else np.eye(6)
    moved = np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T
    error = hinf_norm(
        block_diag(A, moved[0]),
        np.vstack((B, moved[1])),
        np.hstack((C, -moved[2])),
        np.zeros((2, 2)),
        within=0.1,
    )
    assert error.norm <= floor * hinf_norm(A, B, C, D).norm


# ------------------------------------------------------------- edge cases


def test_unstable_system_has_infinite_h_but_finite_l_infinity_norm() -> None:
    """1 / (s - 1)."""
    one = np.ones((1, 1))
    peaks = hinf_norm(one, one, one, 0.0 * one)
    assert peaks.norm == np.inf
    assert len(peaks.frequencies) == len(peaks.values) == 0
    assert_allclose(linf_norm(one, one, one, 0.0 * one).norm, 1.0)
    assert hinf_norm(2.0 * one, one, one, 0.0 * one, dt=1.0).norm == np.inf
    assert_allclose(linf_norm(2.0 * one, one, one, 0.0 * one, dt=1.0).norm, 1.0)


@pytest.mark.parametrize("dt", [None, 0.1])
def test_pole_on_the_boundary_makes_both_norms_infinite(dt: float | None) -> None:
    turn = np.array([[0.0, 2.0], [-2.0, 0.0]])
    A = turn if dt is None else np.array([[0.6, 0.8], [-0.8, 0.6]])
    B, C, D = np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))
    assert hinf_norm(A, B, C, D, dt=dt).norm == np.inf
    peaks = linf_norm(A, B, C, D, dt=dt)
    assert peaks.norm == np.inf
    omega = 2.0 if dt is None else np.arctan2(0.8, 0.6) / dt
    assert_allclose(peaks.frequencies, [omega])


@pytest.mark.parametrize("dt", [None, 0.1])
def test_constant_gain_is_its_largest_singular_value(dt: float | None) -> None:
    D = np.array([[3.0, 0.0, 4.0], [0.0, 1.0, 0.0]])
    empty = np.empty((0, 0)), np.empty((0, 3)), np.empty((2, 0))
    no_input = -0.5 * np.eye(2), np.zeros((2, 3)), np.ones((2, 2))
    no_output = -0.5 * np.eye(2), np.ones((2, 3)), np.zeros((2, 2))
    for A, B, C in (empty, no_input, no_output):
        peaks = hinf_norm(A, B, C, D, dt=dt, within=0.1)
        assert_allclose([peaks.norm, *peaks.values], [5.0, 5.0])
        assert_array_equal(peaks.frequencies, [0.0])


def test_zero_system_has_norm_zero() -> None:
    A, zero = -np.eye(2), np.zeros((1, 1))
    B, C = np.array([[1.0], [0.0]]), np.array([[0.0, 1.0]])
    assert hinf_norm(A, B, C, zero, within=0.5).norm == 0.0


@pytest.mark.parametrize("within", [-0.1, 1.0, 2.0])
@pytest.mark.parametrize("norm", [hinf_norm, linf_norm])
def test_within_must_be_a_fraction(norm, within: float) -> None:
    with pytest.raises(ValueError, match="`within`"):
        norm(*lag(1.0, 0.1), within=within)


def test_sixty_states_agree_with_a_dense_grid() -> None:
    system = random_system(60, (3, 3), 0)
    peaks = hinf_norm(*system)
    w = np.geomspace(1e-2, 1e2, 3000)
    s = np.linalg.svd(frequency_response(*system, w), compute_uv=False)[:, 0]
    assert s.max() <= peaks.norm <= s.max() * (1.0 + 1e-2)
    G = frequency_response(*system, peaks.frequencies)[0]
    assert_allclose(peaks.norm, np.linalg.norm(G, 2), rtol=1e-10)


# ------------------------------------------------------------- level sets


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("fraction", [0.3, 0.7, 0.99])
def test_no_crossing_of_a_level_is_missed(discrete: bool, fraction: float) -> None:
    A, B, C, D = random_system(6, (2, 3), 3)
    engine = FrequencyEngine(np.eye(6) + 0.1 * A if discrete else A, B, C, D, discrete)
    end = np.pi if discrete else 1e3
    w = np.append(np.geomspace(1e-3, end, 20_000), end)
    s = np.linalg.svd(engine.response(w).transpose(2, 0, 1), compute_uv=False)[:, 0]
    level = fraction * s.max()
    found = _LevelSets(engine).crossings(level)
    turns = np.flatnonzero((s[1:] > level) != (s[:-1] > level))
    assert len(turns)
    for k in turns:
        assert ((found >= w[k]) & (found <= w[k + 1])).any()


# ----------------------------------------------------------------- stress


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 5))]
)
def test_adversarial_systems_match_a_pole_aware_grid(seed: int) -> None:
    """Two of every family; thousands in the script of the stress."""
    for case in stress.cases(46, seed):
        verdict = stress.judged(case)
        errors = verdict.low, verdict.high, verdict.all_peaks
        assert max(errors) <= stress.TOLERANCE, (case.family, verdict)
        assert verdict.missed == verdict.false == 0, (case.family, verdict)


@pytest.mark.parametrize("exponent", [-1000, -600, -400, 400, 480, 600, 1000])
@pytest.mark.parametrize("where", ["B", "C", "B and D", "A", "B, not C"])
def test_scales_at_the_ends_of_the_numbers_change_no_digit(
    exponent: int, where: str
) -> None:
    rng = np.random.default_rng(0)
    A = np.array([[-0.1, 2, 0], [-2, -0.1, 1], [0, 0, -3]])
    B, C, D = rng.normal(size=(3, 2)), rng.normal(size=(2, 3)), np.zeros((2, 2))
    unit, gain, rate = 2.0**exponent, 2.0**exponent, 1.0
    if where == "A":
        A, B, gain, rate = unit * A, unit * B, 1.0, unit
    elif where == "B and D":
        B, D = unit * B, unit * rng.normal(size=(2, 2))
    elif where == "B, not C":
        B, C, gain = unit * B, C / unit, 1.0
    else:
        B, C = (unit * B, C) if where == "B" else (B, unit * C)
    empty = np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0))
    assert linf_norm(*empty, unit * np.eye(2)).norm == unit
    usual = linf_norm(A / rate, B / (gain * rate), C, D / gain, within=0.5)
    if where == "C":
        usual = linf_norm(A, B, C / gain, D, within=0.5)
    elif where == "B, not C":
        usual = linf_norm(A, B / unit, C * unit, D, within=0.5)
    found = linf_norm(A, B, C, D, within=0.5)
    assert_allclose(found.norm / gain, usual.norm, rtol=1e-13)
    assert_allclose(found.values / gain, usual.values, rtol=1e-13)
    assert_allclose(found.frequencies / rate, usual.frequencies, rtol=1e-9)
    G = frequency_response(A, B, C, D, found.frequencies)
    sigma = np.linalg.norm(G / gain, 2, axis=(1, 2))
    assert_allclose(sigma, usual.values, rtol=1e-9)


@pytest.mark.parametrize("distance", [1e-8, 1e-9, 1e-10, 1e-11, 3e-13])
def test_poles_beside_the_circle_cost_what_the_last_place_of_the_data_does(
    distance: float,
) -> None:
    """Against the quotient of polynomials in extended precision, of the same data."""
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("long double is no wider than double here")
    for angle in (0.3, 1.1, 2.9):
        a1, a2 = 2 * (1 - distance) * np.cos(angle), -((1 - distance) ** 2)
        found = linf_norm(
            np.array([[a1, a2], [1.0, 0]]), np.eye(2)[:, :1], np.eye(2)[1:],
            np.zeros((1, 1)), dt=1.0,
        )  # fmt: skip
        long1, long2 = np.longdouble(a1), np.longdouble(a2)
        # of the squared denominator, a parabola in the cosine
        least = (1 + long2) ** 2 * (1 + long1**2 / (4 * long2))
        last_place = np.finfo(float).eps / distance
        exact = float(1 / np.sqrt(least))
        assert abs(found.norm / exact - 1) < 5 * last_place + 1e-10
