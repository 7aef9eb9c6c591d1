"""The central path from least squares to the minimum of the H-infinity norm."""

import numpy as np
import pytest

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.central_path import (
    central_path,
    search_grid,
    trust_region_step,
)
from lpvlearn.restructuring.error_system import ErrorSystem
from lpvlearn.restructuring.least_squares import fit_frequency_response
from lpvlearn.restructuring.limits import Limits
from lpvlearn.restructuring.measured import MeasuredErrorSystem
from lpvlearn.restructuring.transfer import Target


def target_of(model):
    return Target(model.A, model.B, model.C, model.D, model.sampling_time)


def stable_model(rng, order, n_inputs, n_outputs, dt=None):
    A = rng.normal(size=(order, order))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(order)
    B, C = rng.normal(size=(order, n_inputs)), rng.normal(size=(n_outputs, order))
    model = StateSpace(A, B, C)
    return model if dt is None else model.to_discrete(dt)


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
