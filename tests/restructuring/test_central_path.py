"""The barrier of the error, and the path from least squares to its minimum."""

import numpy as np
import pytest

import lpvlearn.restructuring.central_path as barrier_module
from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.central_path import (
    Barrier,
    PathPoint,
    central_path,
    level_of,
    trust_region_step,
)
from lpvlearn.restructuring.coordinates import View
from lpvlearn.restructuring.error_system import ErrorSystem
from lpvlearn.restructuring.least_squares import fit_frequency_response
from lpvlearn.restructuring.limits import Limits
from lpvlearn.restructuring.measured import MeasuredErrorSystem

from .conftest import SYSTEMS, stable_model, system_of, target_of


@pytest.mark.parametrize("case", SYSTEMS, ids=str)
@pytest.mark.parametrize("mu", [0.3, 1e-3])
def test_the_quadratic_is_that_of_the_value_along_geodesics(case, mu, monkeypatch):
    # the second derivatives of the poles are left out, and with them the barrier here
    monkeypatch.setattr(barrier_module, "_BARRIER", 0.0)
    system, theta = system_of(**case)
    peaks = system.peaks(theta, 0.5)
    omega = np.union1d(system.grid, peaks.frequencies)
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


@pytest.mark.parametrize("case", SYSTEMS, ids=str)
def test_a_short_step_towards_the_next_mu_brings_what_it_promises(case):
    system, theta = system_of(**case)
    limits, mu, radius = Limits(system, 0.01), 1e-2, 1e-6
    omega = np.union1d(system.grid, system.peaks(theta, 0.5).frequencies)
    Z = Barrier(system, limits, omega, 0.1).quadratic(theta, mu).Z
    barrier = Barrier(system, limits, omega, 0.1, (omega, Z))
    model = barrier.quadratic(theta, 0.3 * mu)
    end, _, left = barrier_module._newton(barrier, theta, model, radius)
    promised = radius * np.linalg.norm(model.gradient)
    assert np.isclose(model.value - barrier.value(end, 0.3 * mu), promised, rtol=1e-3)
    assert np.isclose(left, promised, rtol=1e-3)  # the radius holds the step back


@pytest.mark.parametrize("case", SYSTEMS, ids=str)
def test_a_short_step_takes_the_multipliers_to_those_of_psi(case, monkeypatch):
    system, theta = system_of(**case)
    limits, mu = Limits(system, 0.01), 1e-2
    here = Barrier(system, limits, system.grid, 0.1).quadratic(theta, mu)
    assert np.allclose(here.Z, mu * here.M, rtol=1e-12)
    d = 1e-6 * np.random.default_rng(2).normal(size=len(theta))
    end = theta + here.geometry.T @ d
    bend = here.bend(d, system.weighted_error(end, system.grid))
    moved = here.multipliers(d, bend)
    there = Barrier(system, limits, system.grid, 0.1).quadratic(end, mu)
    change = np.abs(there.Z - here.Z).max()
    assert np.abs(moved - there.Z).max() < 1e-3 * change


def trace(A):
    return np.trace(A, axis1=1, axis2=2).real


@pytest.mark.parametrize("case", SYSTEMS, ids=str)
def test_multipliers_of_their_own_solve_newtons_equations(case):
    system, theta = system_of(**case)
    limits, mu, omega = Limits(system, 0.01), 1e-2, system.grid
    psi = Barrier(system, limits, omega, 0.1).quadratic(theta, mu)
    rng = np.random.default_rng(3)
    Z = psi.Z * rng.uniform(0.2, 5.0, size=(len(omega), 1, 1))
    off = Barrier(system, limits, omega, 0.1, (omega, Z)).quadratic(theta, mu)
    assert np.allclose(off.gradient, psi.gradient, rtol=1e-10)
    assert np.allclose(off.Z, Z * trace(psi.Z).sum() / trace(Z).sum(), rtol=1e-8)
    d = 1e-3 * rng.normal(size=len(theta))
    dX = off.E.conj().swapaxes(1, 2) @ off.geometry.change(d)
    dX = dX + dX.conj().swapaxes(1, 2)
    moved = off.multipliers(d, np.zeros_like(dX))
    # Z (tau I - X) = mu I to first order gives the change of the level, ...
    left = off.mu * off.M - moved  # = sym(Z (level I - dX) M)
    both = 0.5 * (off.Z @ off.M + off.M @ off.Z)
    driven = 0.5 * (off.Z @ dX @ off.M + off.M @ dX @ off.Z)
    level = np.sum(both.conj() * (left + driven)).real / np.sum(np.abs(both) ** 2)
    assert np.allclose(left, level * both - driven, rtol=1e-6, atol=1e-12)
    # ... which keeps the sum of traces at (1/2 + mu k m) / tau = mu tr M
    total = mu * trace(off.M).sum()
    tau = level_of(np.linalg.svd(off.E, compute_uv=False).ravel() ** 2, mu)
    assert np.isclose(trace(moved).sum(), total * (1.0 - level / tau), rtol=1e-8)
    # and squares that bend by what is linear in d add what the Hessian has of first
    # derivatives: its product with d, but for the term of dE^H dE and the second ones
    added = off.corrected(dX) - off.gradient
    expected = 2.0 * off.geometry.pulled(off.E @ (moved - off.mu * off.M))
    assert np.allclose(added, expected, rtol=1e-6, atol=1e-12)


def test_new_frequencies_share_the_multipliers_of_the_nearest():
    system, theta = system_of((1, 1))
    limits, omega, mu = Limits(system, 0.01), system.grid, 1e-2
    Z = Barrier(system, limits, omega, 0.1).quadratic(theta, mu).Z
    more = np.append(omega, omega[3] * (1 + 1e-9))
    split = Barrier(system, limits, more, 0.1, (omega, Z)).quadratic(theta, mu).Z
    assert np.isclose(split[3, 0, 0], split[-1, 0, 0])
    assert np.isclose(split[3] / split[5], 0.5 * Z[3] / Z[5], rtol=1e-6).all()


@pytest.mark.parametrize("mu", [1e4, 1.0, 1e-3, 1e-9])
def test_level_solves_its_equation(mu):
    s = np.random.default_rng(1).exponential(size=50)
    tau = level_of(s, mu)
    assert np.isclose(2 * mu * np.sum(s / (tau - s)), 1.0, rtol=1e-6)
    assert tau > s.max()


def test_no_error_has_a_level_that_is_next_to_nothing():
    assert 0.0 < level_of(np.zeros(5), 0.1) < 1e-200


def test_for_a_large_mu_psi_is_the_sum_of_squares():
    system, theta = system_of((2, 2))
    limits, omega, mu = Limits(system, 0.01), system.grid, 1e6
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
    barrier.omega = np.append(barrier.omega, barrier.missed)
    assert np.isfinite(barrier.value(theta, 1e-3))
    assert barrier.missed.size == 0


def test_the_path_of_a_gain_ends_at_its_chebyshev_approximation():
    """1 / (s + 1) is a circle through 0 and 1: the gain 1/2 is nearest."""
    structure = GrayBoxStructure.from_template(
        np.zeros((0, 0)).tolist(), np.zeros((0, 1)).tolist(), [[]], [["d"]]
    )
    model = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    system = ErrorSystem(structure, target_of(model))
    limits = Limits(system, 0.0)
    start = PathPoint(View.of(system, np.array([0.3]), limits))
    path = central_path(start, mu_end=1e-8, max_iter=200, decrement=1e-3)
    assert np.allclose(path.view.theta, 0.5, atol=1e-4)
    assert path.norm <= 0.5 * (1 + 1e-4)


def fitted(structure, model, theta):
    system = ErrorSystem(structure, target_of(model))
    grid = system.grid
    fit = fit_frequency_response(system, theta, grid, admissible=lambda _: True)
    return system, fit


def test_the_path_lowers_the_norm_of_the_least_squares_fit():
    model = stable_model(np.random.default_rng(5), 6, 1, 1)
    structure = GrayBoxStructure.modal(1, 1, 1)
    system, fit = fitted(structure, model, np.array([-1.0, 2.0, 1.0, 1.0]))
    start = PathPoint(View.of(system, fit.x, Limits(system, 1e-3)))
    ends = (1e-1, 1e-2, 1e-4, 1e-6)
    norms = [central_path(start, mu_end=mu, max_iter=500).norm for mu in ends]
    assert (np.diff(norms) < 0).all()
    assert norms[-1] < 0.95 * start.norm


def test_the_path_keeps_bounds_and_margin():
    model = StateSpace([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]])
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    ).with_bounds({"k": (1, 3), "c": (0.5, None)})
    system = ErrorSystem(structure, target_of(model))
    names = list(structure.parameter_names)
    start = np.array([{"k": 3.0, "c": 0.6, "b": 1.0}[name] for name in names])
    limits = Limits(system, 0.26)
    path = PathPoint(View.of(system, start, limits))
    end = central_path(path, mu_end=1e-6, max_iter=300).view.theta
    assert (end >= structure.lower).all()
    assert (end <= structure.upper).all()
    assert limits.strict(end)
    assert np.isclose(end[names.index("k")], 3.0, rtol=1e-3)


def test_measured_responses_are_watched_at_their_own_frequencies_only():
    model = StateSpace([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]])
    omega = np.linspace(0.5, 6, 23)
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    system = MeasuredErrorSystem(structure, omega, model.frequency_response(omega))
    start = PathPoint(View.of(system, np.array([1.0, 1.0]), Limits(system, 1e-3)))
    path = central_path(start, mu_end=1e-5, max_iter=200)
    assert path.frequencies.size == 0
    assert path.norm < start.norm


@pytest.mark.parametrize(
    "spectrum, slopes",
    [
        ([1.0, 2.0], [0.1, 0.1]),
        ([1.0, 2.0], [10.0, 1.0]),
        ([-1.0, 2.0], [0.3, 1.0]),
        ([-1.0, 2.0], [0.0, 0.1]),
        ([0.0, 2.0], [1.0, 0.1]),
        ([-2.0, -2.0, 1e8], [0.0, 1e-3, 1.0]),
    ],
)
def test_trust_region_step_solves_its_optimality_conditions(spectrum, slopes):
    spectrum, slopes, radius = np.array(spectrum), np.array(slopes), 0.7
    x = trust_region_step(spectrum, slopes, radius)
    assert np.linalg.norm(x) <= radius * (1 + 1e-9)
    # no better point on a dense sample of the disc
    rng = np.random.default_rng(0)
    other = rng.normal(size=(20000, len(x)))
    other *= (
        radius
        * rng.uniform(size=(20000, 1))
        / np.linalg.norm(other, axis=1, keepdims=True)
    )

    def model(z):
        return z @ slopes + 0.5 * (z**2) @ spectrum

    assert model(x) <= model(other).min() + 5e-3 * abs(model(x))
