"""The H-infinity norm as a minimax problem, and the curves of its steps."""

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.minimax import problem as minimax_problem
from lpvlearn.restructuring.coordinates import ResponseGeometry
from lpvlearn.restructuring.error_system import ErrorSystem, Target
from lpvlearn.restructuring.limits import Limits
from lpvlearn.restructuring.minimise_hinf import HinfObjective

TRUTH = {"k1": 20.0, "k2": 10.0, "c1": 0.4, "c2": 0.2, "m1": 2.0, "m2": 0.5}


def objective_of(bounds=None):
    """Two masses beside other ones, and the parameters' names."""
    structure = GrayBoxStructure.mechanical(
        M=[["m1", 0], [0, "m2"]],
        D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
        K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
        F=[[1.0], [0.0]],
        sensors=np.eye(2),
    )
    names = structure.parameter_names
    theta = np.array([TRUTH[name] for name in names])
    other = theta * np.exp(0.2 * np.cos(np.arange(len(theta)) ** 2))
    box: StateSpace = structure.model(other)
    if bounds:
        structure = structure.with_bounds(bounds)
    system = ErrorSystem(structure, Target(box.A, box.B, box.C, box.D))
    size = system.peaks(theta).norm
    T = ResponseGeometry(system, theta, system.grid, size).T
    return HinfObjective(system, theta, T, Limits(system, 1e-4)), names


def test_hessians_along_the_curves_are_second_derivatives():
    objective, _ = objective_of()
    y = np.zeros(len(objective.theta0))
    omega = objective.system.grid[[5, 30, 60]]
    curve = objective.curve(y)
    slopes = objective.samples(y, omega).gradients
    H = objective.hessians(y, omega, np.zeros(3, bool))
    rng, h = np.random.default_rng(0), 2e-5
    for _ in range(3):
        d = rng.normal(size=len(y))
        ahead, here, behind = (
            objective.values(y + curve.step(s * h * d), omega) for s in (1, 0, -1)
        )
        measured = (ahead - 2 * here + behind) / h**2
        bend = [d @ (H[k] + curve.curvature(slopes[k])) @ d for k in range(len(omega))]
        assert np.allclose(bend, measured, rtol=1e-3, atol=1e-3 * np.abs(bend).max())


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_curves_keep_within_the_bounds(size):
    bounds = {name: (0.9 * TRUTH[name], 1.1 * TRUTH[name]) for name in TRUTH}
    objective, _ = objective_of(bounds)
    structure, curve = (
        objective.system.structure,
        objective.curve(np.zeros(len(objective.theta0))),
    )
    rng = np.random.default_rng(1)
    room = 1e-9 * np.abs(objective.theta0)
    for _ in range(10):
        d = size * rng.normal(size=len(objective.theta0))
        theta = objective.theta(curve.step(d))
        assert (theta >= structure.lower - room).all()
        assert (theta <= structure.upper + room).all()


def test_curves_leave_in_the_direction_of_the_step():
    objective, _ = objective_of()
    curve = objective.curve(np.zeros(len(objective.theta0)))
    d = np.random.default_rng(2).normal(size=len(objective.theta0))
    for h in (1e-3, 1e-4):
        off = np.linalg.norm(curve.step(h * d) - h * d)
        assert off <= 2 * h**2 * np.linalg.norm(d) ** 2 * len(d)


@pytest.mark.parametrize("solver", ["sqp", "bundle"])
def test_a_failed_quadratic_program_is_warned_about(solver, monkeypatch):
    def infeasible(P, *_, **__):
        return np.full(len(P), np.nan), np.nan, -1, {"lam": np.zeros(0)}

    monkeypatch.setattr(minimax_problem.daqp, "solve", infeasible)
    objective, _ = objective_of()
    lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    t = objective.system.target
    box = StateSpace(t.A, t.B, t.C[:1])
    with pytest.warns(ConvergenceWarning) as caught:
        GrayBoxRestructurer(lag, solver=solver).fit_model(box)
    assert any("quadratic program of a step had no" in str(w.message) for w in caught)
