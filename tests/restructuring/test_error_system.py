"""The error system of model matching: peaks and their derivatives."""

import numpy as np
import pytest

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.error_system import ErrorSystem, Target, frequency_grid
from lpvlearn.restructuring.measured import MeasuredErrorSystem

from .conftest import stable_model as sampled_model


def stable_model(rng, order, n_inputs, n_outputs, dt=None):
    return sampled_model(
        rng, order, n_inputs, n_outputs, dt, decay=0.3, feedthrough=True
    )


def error_system(rng, shape, dt=None, structure=None):
    n_outputs, n_inputs = shape
    black_box = stable_model(rng, 4, n_inputs, n_outputs, dt)
    structure = structure or GrayBoxStructure.full(3, n_inputs, n_outputs)
    gray_box = stable_model(rng, 3, n_inputs, n_outputs, dt)
    theta = np.concatenate(
        [M.ravel() for M in (gray_box.A, gray_box.B, gray_box.C, gray_box.D)]
    )
    target = Target(black_box.A, black_box.B, black_box.C, black_box.D, dt)
    return ErrorSystem(structure, target), theta, gray_box, black_box


SHAPES = [(1, 1), (2, 2), (3, 1), (1, 3), (2, 3)]


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("shape", SHAPES)
def test_norm_is_that_of_the_difference_of_the_models(shape, dt):
    system, theta, gray_box, black_box = error_system(
        np.random.default_rng(1), shape, dt
    )
    assert np.isclose(
        system.peaks(theta).norm, (gray_box - black_box).hinf_norm(), rtol=1e-9
    )


@pytest.mark.parametrize("depths", [(0.9, 0.5, None), (None, 0.5, 0.9)])
def test_peaks_that_are_remembered_are_those_of_a_search(depths):
    rng = np.random.default_rng(4)
    system, theta, *_ = error_system(rng, (2, 2))
    for point in (theta, 0.9 * theta, theta):
        for within in depths:
            fresh = ErrorSystem(system.structure, system.target)
            found, expected = (s.peaks(point, within) for s in (system, fresh))
            assert np.isclose(found.norm, expected.norm, rtol=1e-9)
            assert np.allclose(found.values, expected.values, rtol=1e-9)
            assert np.allclose(found.frequencies, expected.frequencies, rtol=1e-4)
    assert len(system.peaks(theta, 0.9).values) > 1


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_equal_central_differences(shape, dt):
    system, theta, _, _ = error_system(np.random.default_rng(2), shape, dt)
    omega = np.array([0.0, 0.3, 2.0])
    _, gradients = system.gradients(theta, omega)
    h = 1e-6
    numeric = np.array(
        [
            (
                system.gradients(theta + h * e, omega)[0]
                - system.gradients(theta - h * e, omega)[0]
            )
            / (2 * h)
            for e in np.eye(len(theta))
        ]
    ).T
    np.testing.assert_allclose(gradients, numeric, atol=1e-7 * np.abs(numeric).max())


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("shape", SHAPES)
def test_hessians_equal_differences_of_gradients(shape, dt):
    system, theta, _, _ = error_system(np.random.default_rng(3), shape, dt)
    omega, weights, h = np.array([0.4, 1.7]), np.array([0.3, 0.7]), 1e-5
    H = system.hessian(theta, weights, omega, np.zeros(2, bool))
    numeric = np.array(
        [
            system.gradients(theta + h * e, omega)[1]
            - system.gradients(theta - h * e, omega)[1]
            for e in np.eye(len(theta))
        ]
    ).transpose(1, 0, 2) / (2 * h)
    expected = np.tensordot(weights, numeric, axes=1)
    np.testing.assert_allclose(H, expected, atol=1e-6 * np.abs(H).max())


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("shape", SHAPES)
def test_hessian_of_a_moving_peak_follows_the_maximum(shape, dt):
    rng = np.random.default_rng(6)
    system, theta, _, _ = error_system(rng, shape, dt)
    peaks = system.peaks(theta, within=0.9)
    inner = (peaks.frequencies > 0) & np.isfinite(peaks.frequencies)
    assert inner.any()
    omega = peaks.frequencies[inner][:1]
    direction = rng.normal(size=len(theta))
    direction /= np.linalg.norm(direction)
    H = system.hessian(theta, np.ones(1), omega, np.array([True]))

    def height(t):
        found = system.peaks(theta + t * direction, within=0.95)
        near = np.argmin(np.abs(found.frequencies - omega[0]))
        return found.values[near]

    h = 1e-3
    numeric = (height(h) - 2 * height(0.0) + height(-h)) / h**2
    assert np.isclose(direction @ H @ direction, numeric, rtol=1e-3)


def test_curvature_of_a_function_structure_enters_the_hessian():
    def squared(p):
        return [[0, 1], [-(p[0] ** 2), -p[0] * p[1]]], [[0], [p[0] ** 2]], [[1, 0]]

    structure = GrayBoxStructure.from_function(squared, [2.0, 0.4])
    rng = np.random.default_rng(0)
    box = stable_model(rng, 3, 1, 1)
    system = ErrorSystem(structure, Target(box.A, box.B, box.C, 0 * box.D))
    theta, omega, h = np.array([2.2, 0.5]), np.array([1.3]), 1e-5
    H = system.hessian(theta, np.ones(1), omega, np.array([False]))
    numeric = np.array(
        [
            system.gradients(theta + h * e, omega)[1][0]
            - system.gradients(theta - h * e, omega)[1][0]
            for e in np.eye(2)
        ]
    ) / (2 * h)
    np.testing.assert_allclose(H, numeric, atol=1e-5 * np.abs(numeric).max())


def test_response_jacobian_is_the_derivative_of_the_response():
    system, theta, gray_box, _ = error_system(np.random.default_rng(8), (2, 3))
    omega = np.array([0.0, 0.5, 4.0])
    G, J = system.response_jacobian(theta, omega)
    np.testing.assert_allclose(G, gray_box.frequency_response(omega), rtol=1e-10)
    h = 1e-6
    for j in (0, 8, len(theta) - 1):
        e = h * np.eye(len(theta))[j]
        numeric = system.response(theta + e, omega) - system.response(theta - e, omega)
        np.testing.assert_allclose(
            J[..., j], numeric / (2 * h), atol=1e-7 * np.abs(J).max()
        )


def test_measured_error_is_the_maximum_over_the_grid():
    rng = np.random.default_rng(4)
    system, theta, gray_box, black_box = error_system(rng, (2, 2))
    omega = np.geomspace(0.05, 20, 40)
    G0 = black_box.frequency_response(omega)
    shuffled = rng.permutation(len(omega))
    measured = MeasuredErrorSystem(system.structure, omega[shuffled], G0[shuffled])
    sigma = np.linalg.norm(gray_box.frequency_response(omega) - G0, 2, axis=(1, 2))
    peaks = measured.peaks(theta, within=0.5)
    assert np.isclose(peaks.norm, sigma.max(), rtol=1e-12)
    assert np.isclose(peaks.frequencies[0], omega[np.argmax(sigma)])
    assert peaks.norm <= system.peaks(theta).norm * (1 + 1e-12)


@pytest.mark.parametrize("dt", [None, 0.1])
def test_rounding_is_what_a_unit_in_the_last_place_makes(dt):
    system, theta, gray_box, black_box = error_system(
        np.random.default_rng(3), (2, 2), dt
    )
    rng, unit, omega = np.random.default_rng(0), 1e-6, system.grid
    squares = np.zeros(len(omega))
    for model in (gray_box, black_box):
        G = model.frequency_response(omega)
        matrices = model.A, model.B, model.C, model.D
        for _ in range(200):
            signs = [rng.choice([-1.0, 1.0], M.shape) for M in matrices]
            moved = [M * (1.0 + unit * s) for M, s in zip(matrices, signs, strict=True)]
            other = StateSpace(*moved, dt).frequency_response(omega)
            squares += np.sum(np.abs(other - G) ** 2, axis=(1, 2)) / 200
    expected = np.finfo(float).eps * np.sqrt(squares.max()) / unit
    assert np.isclose(system.rounding(theta), expected, rtol=0.1)


@pytest.mark.parametrize("pole", [0.0, 1e-300, -1e-30, 1e-12])
def test_poles_next_to_zero_are_faster_than_any_frequency(pole):
    """Their logarithms are beyond the Nyquist frequency; the grid is not empty."""
    grid = frequency_grid(np.array([pole]), 0.1)
    assert len(grid) > 10 and grid.max() < np.pi / 0.1
