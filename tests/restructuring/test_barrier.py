"""The logarithmic barrier of the error, and the geometry of the response."""

import numpy as np
import pytest

import lpvlearn.restructuring.central_path as barrier_module
from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.central_path import Barrier, level_of, search_grid
from lpvlearn.restructuring.coordinates import ResponseGeometry
from lpvlearn.restructuring.error_system import ErrorSystem
from lpvlearn.restructuring.limits import Limits
from lpvlearn.restructuring.transfer import Target


def target_of(model):
    return Target(model.A, model.B, model.C, model.D, model.sampling_time)


def stable_model(rng, order, n_inputs, n_outputs, dt=None):
    A = rng.normal(size=(order, order))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(order)
    B, C = rng.normal(size=(order, n_inputs)), rng.normal(size=(n_outputs, order))
    model = StateSpace(A, B, C)
    return model if dt is None else model.to_discrete(dt)


def oscillator(theta):
    """Mass, stiffness and damping of an oscillator: not affine."""
    m, k, c = theta
    A = np.array([[0 * m, 1 + 0 * m], [-k / m, -c / m]])
    return A, np.array([[0 * m], [1 / m]]), np.array([[1.0, 0.0]])


def system_of(shape, dt=None, weighted=False, physical=False):
    """An error system and parameters of a stable model."""
    rng = np.random.default_rng(3)
    p, m = shape
    black_box = stable_model(rng, 4, m, p, dt)
    if physical:
        structure = GrayBoxStructure.from_function(
            oscillator, {"m": 1.0, "k": 2.0, "c": 0.5}
        ).with_bounds({"m": (0, None), "k": (0.5, 9)})
        theta = np.array([0.8, 2.5, 0.4])
    else:
        start = stable_model(rng, 3, m, p, dt)
        A, B = start.A.tolist(), [[f"b{i}{j}" for j in range(m)] for i in range(3)]
        for i in range(3):
            A[i][i] = f"a{i}"
        structure = GrayBoxStructure.from_template(A, B, start.C.tolist())
        values = {f"a{i}": start.A[i, i] for i in range(3)}
        values |= {B[i][j]: start.B[i, j] for i in range(3) for j in range(m)}
        theta = np.array([values[name] for name in structure.parameter_names])
    weight = Target(*(np.array([[v]]) for v in (-2.0, 1.0, 3.0, 0.5)))
    system = ErrorSystem(structure, target_of(black_box), weight if weighted else None)
    return system, theta


CASES = [
    {"shape": (1, 1)},
    {"shape": (2, 1)},
    {"shape": (1, 3)},
    {"shape": (2, 2)},
    {"shape": (3, 2), "dt": 0.1},
    {"shape": (2, 2), "weighted": True},
    {"shape": (1, 1), "physical": True},
]


def weighted_response(system, theta, omega):
    """The response as one real vector, its norm the root mean square."""
    G = system.weight_response(omega)[0] @ system.response(theta, omega)
    return np.concatenate([G.real.ravel(), G.imag.ravel()]) / np.sqrt(len(omega))


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_unit_step_changes_the_response_by_the_given_size(case):
    system, theta = system_of(**case)
    omega = search_grid(system)
    geometry = ResponseGeometry(system, theta, omega, 1e-5)
    assert np.allclose(geometry.T @ geometry.inverse, np.eye(len(theta)), atol=1e-9)
    here = weighted_response(system, theta, omega)
    changes = [
        np.linalg.norm(weighted_response(system, theta + step, omega) - here)
        for step in geometry.T.T
    ]
    assert np.allclose(changes, 1e-5, rtol=1e-2)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_response_turns_away_from_its_tangent_along_a_geodesic(case):
    """G'' along ``theta + T (h d + h^2 a / 2)`` has no tangential part."""
    system, theta = system_of(**case)
    omega = search_grid(system)
    size = np.linalg.norm(weighted_response(system, theta, omega))
    geometry = ResponseGeometry(system, theta, omega, 0.1 * size)
    rng, h = np.random.default_rng(1), 1e-3

    def along(d, a, h):
        return weighted_response(
            system, theta + geometry.T @ (h * d + 0.5 * h * h * a), omega
        )

    for _ in range(3):
        d = rng.normal(size=len(theta))
        a = geometry.acceleration(d)
        tangential = []
        for bend in (0 * a, a):
            second = along(d, bend, h) - 2 * along(d, bend, 0) + along(d, bend, -h)
            tangential.append(np.linalg.norm(geometry._J.T @ second) / h**2)
        assert tangential[1] < 1e-3 * tangential[0]


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("mu", [0.3, 1e-3])
def test_the_quadratic_is_that_of_the_value_along_geodesics(case, mu, monkeypatch):
    # the second derivatives of the poles are left out, and with them the barrier here
    monkeypatch.setattr(barrier_module, "_BARRIER", 0.0)
    system, theta = system_of(**case)
    peaks = system.peaks(theta, 0.5)
    omega = np.union1d(search_grid(system), peaks.frequencies)
    barrier = Barrier(system, Limits(system, 0.01), omega, 1e-2 * peaks.norm)
    model = barrier.quadratic(theta, mu)
    assert np.isclose(model.value, barrier.value(theta, mu), rtol=1e-12)
    rng, h = np.random.default_rng(0), 1e-3
    for _ in range(3):
        d = rng.normal(size=len(theta))
        d /= np.linalg.norm(d)
        a = model.geometry.acceleration(d)
        up, down = (
            barrier.value(theta + model.geometry.T @ (s * h * d + 0.5 * h * h * a), mu)
            for s in (1, -1)
        )
        slope, bend = (up - down) / (2 * h), (up - 2 * model.value + down) / h**2
        top = np.linalg.norm(model.hessian, 2)
        steepest = np.linalg.norm(model.gradient)
        assert np.isclose(model.gradient @ d, slope, rtol=1e-3, atol=1e-4 * steepest)
        assert np.isclose(d @ model.hessian @ d, bend, rtol=1e-3, atol=1e-3 * top)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_drift_is_the_derivative_of_the_gradient_by_mu(case):
    system, theta = system_of(**case)
    barrier = Barrier(system, Limits(system, 0.01), search_grid(system), 0.1)
    mu, h = 1e-2, 1e-7
    up, down = (barrier.quadratic(theta, mu + s * h).gradient for s in (1, -1))
    drift = barrier.quadratic(theta, mu).drift
    assert np.allclose(drift, (up - down) / (2 * h), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("mu", [1e4, 1.0, 1e-3, 1e-9])
def test_level_solves_its_equation(mu):
    s = np.random.default_rng(1).exponential(size=50)
    tau = level_of(s, mu)
    assert np.isclose(2 * mu * np.sum(s / (tau - s)), 1.0, rtol=1e-6)
    assert tau > s.max()


def test_for_a_large_mu_psi_is_the_sum_of_squares():
    system, theta = system_of((2, 2))
    limits, omega, mu = Limits(system, 0.01), search_grid(system), 1e6
    E = system.response(theta, omega) - system.target_response(omega)
    c = limits.rows(theta)[0]
    logarithms = -1e-2 * mu * np.log(-c).sum()
    expected = 0.5 * np.log(2 * mu * np.sum(np.abs(E) ** 2)) + 0.5
    value = Barrier(system, limits, omega, 1.0).value(theta, mu)
    assert np.isclose(value - logarithms, expected, rtol=1e-3)


def test_a_resonance_between_the_frequencies_is_not_passed_over():
    """A mode of damping 1e-4 rises between two frequencies that do not see it."""
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    )
    model = StateSpace([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]])
    system = ErrorSystem(structure, target_of(model))
    barrier = Barrier(system, Limits(system, 1e-6), np.array([0.5, 1.0, 3.0]), 1.0)
    names = structure.parameter_names
    theta = np.array([{"k": 4.0, "c": 2e-4, "b": 1.0}[name] for name in names])
    assert barrier.value(theta, 1e-3) == np.inf
    assert np.allclose(barrier.missed, 2.0, rtol=1e-6)
    barrier.watch(np.append(barrier.omega, barrier.missed))
    assert np.isfinite(barrier.value(theta, 1e-3))
    assert barrier.missed.size == 0
