"""The central path from least squares to the minimum of the H-infinity norm."""

import numpy as np
import pytest

import lpvlearn.numerics.central_path as central_path_module
from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.numerics.central_path import (
    _Stage,
    central_path,
    level_of,
    search_grid,
    trust_region_step,
)
from lpvlearn.numerics.leastsquares import fit_frequency_response
from lpvlearn.numerics.limits import Limits
from lpvlearn.numerics.matching import ErrorSystem, MeasuredErrorSystem
from lpvlearn.numerics.transfer import Target


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


def stage_of(shape, dt=None, weighted=False, physical=False):
    """psi around a random point, and a stage whose coordinates are not trivial."""
    rng = np.random.default_rng(3)
    p, m = shape
    black_box = stable_model(rng, 4, m, p, dt)
    if physical:
        structure = GrayBoxStructure.from_function(
            oscillator, {"m": 1.0, "k": 2.0, "c": 0.5}
        ).with_bounds({"m": (0, None), "k": (0.5, 9)})
        theta = np.array([0.8, 2.5, 0.4])
    else:
        structure = GrayBoxStructure.full(3, m, p, feedthrough=False)
        start = stable_model(rng, 3, m, p, dt)
        theta = np.concatenate([M.ravel() for M in (start.A, start.B, start.C)])
    weight = Target(*(np.array([[v]]) for v in (-2.0, 1.0, 3.0, 0.5)))
    system = ErrorSystem(structure, target_of(black_box), weight if weighted else None)
    grid = search_grid(system)
    T = np.diag(0.1 * np.abs(theta) + 0.05) @ rng.normal(size=(len(theta),) * 2)
    return _Stage(system, Limits(system, 0.01), theta, T, grid)


CASES = [
    {"shape": (1, 1)},
    {"shape": (2, 1)},
    {"shape": (1, 3)},
    {"shape": (2, 2)},
    {"shape": (3, 2), "dt": 0.1},
    {"shape": (2, 2), "weighted": True},
    {"shape": (1, 1), "physical": True},
]


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("mu", [0.3, 1e-3])
def test_gradient_and_hessian_are_those_of_the_value(case, mu, monkeypatch):
    # the second derivatives of the poles are left out, and with them the barrier here
    monkeypatch.setattr(central_path_module, "_BARRIER", 0.0)
    stage = stage_of(**case)
    rng = np.random.default_rng(0)
    y = 1e-3 * rng.normal(size=len(stage.theta0))
    value, gradient, hessian = stage.derivatives(y, mu)
    assert np.isclose(value, stage.value(y, mu), rtol=1e-12)
    h = 1e-5
    for _ in range(3):
        d = rng.normal(size=len(y))
        d /= np.linalg.norm(d)
        up, down = stage.derivatives(y + h * d, mu), stage.derivatives(y - h * d, mu)
        slope = (stage.value(y + h * d, mu) - stage.value(y - h * d, mu)) / (2 * h)
        assert np.isclose(gradient @ d, slope, rtol=1e-5, atol=1e-7)
        bend = (up[1] - down[1]) / (2 * h)
        size = np.linalg.norm(hessian, 2)
        assert np.allclose(hessian @ d, bend, rtol=1e-5, atol=1e-6 * size)


@pytest.mark.parametrize("mu", [1e4, 1.0, 1e-3, 1e-9])
def test_level_solves_its_equation(mu):
    s = np.random.default_rng(1).exponential(size=50)
    tau = level_of(s, mu)
    assert np.isclose(2 * mu * np.sum(s / (tau - s)), 1.0, rtol=1e-6)
    assert tau > s.max()


def test_for_a_large_mu_psi_is_the_sum_of_squares():
    stage, mu = stage_of((2, 2)), 1e6
    y = np.zeros(len(stage.theta0))
    s = stage._squares(stage.theta0)
    c = stage.limits.rows(stage.theta0)[0]
    barrier = -1e-2 * mu * np.log(-c).sum()
    expected = 0.5 * np.log(2 * mu * s.sum()) + 0.5
    assert np.isclose(stage.value(y, mu) - barrier, expected, rtol=1e-3)


def test_the_path_of_a_gain_ends_at_its_chebyshev_approximation():
    """1 / (s + 1) is a circle through 0 and 1: the gain 1/2 is nearest."""
    structure = GrayBoxStructure.from_template(
        np.zeros((0, 0)).tolist(), np.zeros((0, 1)).tolist(), [[]], [["d"]]
    )
    model = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    system = ErrorSystem(structure, target_of(model))
    limits = Limits(system, 0.0)
    path = central_path(
        system, np.array([0.3]), limits, mu_end=1e-8, max_iter=200, decrement=1e-3
    )
    assert np.allclose(path.theta, 0.5, atol=1e-4)
    assert system.peaks(path.theta).norm <= 0.5 * (1 + 1e-4)


def fitted(structure, model, theta):
    system = ErrorSystem(structure, target_of(model))
    grid = search_grid(system)
    fit = fit_frequency_response(
        system, theta, grid, system.target_response(grid), admissible=lambda _: True
    )
    return system, fit


def test_the_path_lowers_the_norm_of_the_least_squares_fit():
    model = stable_model(np.random.default_rng(5), 6, 1, 1)
    structure = GrayBoxStructure.modal(1, 1, 1)
    system, fit = fitted(structure, model, np.array([-1.0, 2.0, 1.0, 1.0]))
    limits = Limits(system, 1e-3)
    norms = []
    for mu_end in (1e-1, 1e-2, 1e-4, 1e-6):
        path = central_path(system, fit.x, limits, mu_end=mu_end, max_iter=500)
        norms.append(system.peaks(path.theta).norm)
    assert (np.diff(norms) < 0).all()
    assert norms[-1] < 0.95 * system.peaks(fit.x).norm


def test_the_path_keeps_bounds_and_margin():
    model = StateSpace([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]])
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    ).with_bounds({"k": (1, 3), "c": (0.5, None)})
    system = ErrorSystem(structure, target_of(model))
    names = list(structure.parameter_names)
    start = np.array([{"k": 3.0, "c": 0.6, "b": 1.0}[name] for name in names])
    limits = Limits(system, 0.26)
    path = central_path(system, start, limits, mu_end=1e-6, max_iter=300)
    assert (path.theta >= structure.lower).all()
    assert (path.theta <= structure.upper).all()
    assert limits.strict(path.theta)
    assert np.isclose(path.theta[names.index("k")], 3.0, rtol=1e-3)


def test_measured_responses_are_watched_at_their_own_frequencies_only():
    model = StateSpace([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]])
    omega = np.linspace(0.5, 6, 23)
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    system = MeasuredErrorSystem(structure, omega, model.frequency_response(omega))
    path = central_path(
        system, np.array([1.0, 1.0]), Limits(system, 1e-3), mu_end=1e-5, max_iter=200
    )
    assert path.frequencies.size == 0
    assert system.peaks(path.theta).norm < system.peaks(np.array([1.0, 1.0])).norm


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
