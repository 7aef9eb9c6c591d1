"""The H-infinity norm as a minimax problem, and the curves of its steps."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.minimax import problem as minimax_problem
from lpvlearn.minimax.sqp import minimax_sqp
from lpvlearn.restructuring import minimise_hinf
from lpvlearn.restructuring.coordinates import ResponseGeometry
from lpvlearn.restructuring.error_system import ErrorSystem, Target
from lpvlearn.restructuring.least_squares import fit_frequency_response
from lpvlearn.restructuring.limits import Limits
from lpvlearn.restructuring.minimise_hinf import (
    SOLVERS,
    HinfObjective,
    _left_saddle,
    is_saddle,
)
from lpvlearn.restructuring.problem import problem_from_models

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
    still = np.zeros(3, bool)
    H = [objective.hessian(y, weights, omega, still) for weights in np.eye(3)]
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


@pytest.mark.broad
@pytest.mark.parametrize("solver", list(SOLVERS))
def test_a_saddle_is_left_along_its_negative_curvature(solver):
    """Of two lags that are equal, no gradient tells which shall be the fast one."""
    lags = GrayBoxStructure.from_template([["-a", 0], [0, "-b"]], [[1], [1]], [[1, 1]])
    problem = problem_from_models(lags, [lags.model([1.0, 4.0])], None)
    system = problem.system
    x = minimize_scalar(lambda x: system.peaks(np.full(2, x)).norm, bounds=(1.0, 4.0),
                        options={"xatol": 1e-13}).x  # fmt: skip
    theta = np.full(2, x)
    T = ResponseGeometry(system, theta, system.grid, system.peaks(theta).norm).T
    objective = HinfObjective(system, theta, T, Limits(system, problem.margin))
    saddle = minimax_sqp(objective.problem(), np.zeros(2), max_iter=0)
    assert is_saddle(saddle) and saddle.second_order < -0.01
    valley = T @ saddle.valley
    np.testing.assert_allclose(valley[0], -valley[1], rtol=1e-3)
    found = _left_saddle(objective, saddle, SOLVERS[solver], max_iter=200, tol=1e-12)
    exact = 1e-5 if solver == "sqp" else 1e-2  # a first-order method takes its time
    assert found.peaks.top < exact * saddle.peaks.top
    rates = np.sort(objective.theta(found.y))
    np.testing.assert_allclose(rates, [1.0, 4.0], rtol=10 * exact)
    assert _left_saddle(objective, found, SOLVERS[solver]) is None


@pytest.mark.parametrize("promised, rounds", [(1e-7, 1), (1e-5, 2)])
def test_many_parameters_need_no_round_for_digits_that_do_not_tell(
    promised, rounds, monkeypatch
):
    """Of a solver that stops nearly at an optimum, its last step tells of the rest."""
    monkeypatch.setattr(minimise_hinf, "_MANY", 1)
    ends = []

    def stopping(problem, y0, **options):
        found = minimax_sqp(problem, y0, **options)
        last = {**found.history[-1], "predicted": promised}
        ends.append(found.peaks.top)
        return replace(found, converged=False, stationarity=5e-4, history=[last])

    objective, _ = objective_of()
    start = fit_frequency_response(
        objective.system,
        objective.theta0,
        objective.system.grid,
        admissible=objective.admissible,
    )
    _, result, _ = minimise_hinf.minimise_hinf(
        objective.system, [start], 1e-4, stopping, max_iter=200, tol=1e-10, negligible=0
    )
    assert len(ends) == rounds
    assert result.peaks.top == min(ends)


@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_how_far_a_search_converged_is_said():
    lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    box = StateSpace([[-1, 0], [0, -30]], [[1], [3]], [[1, 1]])
    fitted = GrayBoxRestructurer(lag).fit_model(box)
    assert fitted.convergence_ == "optimal" and fitted.stationarity_ <= 1e-5
    with pytest.warns(ConvergenceWarning, match="ended at `max_iter`=0"):
        fitted = GrayBoxRestructurer(lag, max_iter=0).fit_model(box)
    assert fitted.convergence_ == "no"


@pytest.mark.broad
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.filterwarnings("ignore:the response determines")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("dt", [None, 0.1])
def test_a_gain_whose_sign_is_wrong_vanishes(seed, dt):
    """A sensor's sign is turned: on the way lags stand, and poles are at zero."""
    n, own = 1 + seed, "-a" if dt is None else "1 - a"
    A = [[0] * n for _ in range(n)]
    for i in range(n):
        A[i][i] = f"{own}{i}"
        if i:
            A[i][i - 1] = f"c{i}"
    structure = GrayBoxStructure.from_template(
        A, [["g"], *[[0]] * (n - 1)], np.eye(n)[-1:].tolist()
    )
    truth = np.random.default_rng(seed).uniform(0.1, 0.9, structure.n_params)
    box = structure.model(truth, dt)
    turned = StateSpace(box.A, box.B, -box.C, sampling_time=dt)
    positive = dict.fromkeys(structure.parameter_names, (0, None))
    restructurer = GrayBoxRestructurer(structure.with_bounds(positive), max_iter=200)
    found = restructurer.fit_model(turned)
    # A search that ends before its tolerance says so, and how near depends on rounding.
    ended = 1e-6 if found.convergence_ == "no" else 1e-9
    assert 0.9 < found.relative_error_ <= 1.0 + ended
    assert found.lti_.is_stable


RESONANCE = GrayBoxStructure.from_template(
    [["-a", "-b"], [1, 0]], [["c"], [0]], [[1, 0]]
)


def beside_a_resonance(seed):
    """A model whose gain at rest is not zero, as that of the structure is."""
    rng, size = np.random.default_rng(seed), 4e-3
    own = RESONANCE.model([2.0, 6.5, 20.0])
    A = own.A + size * rng.normal(size=(2, 2))
    B = own.B * (1.0 + size * rng.normal())
    return StateSpace(A, B, own.C + size * rng.normal(size=(1, 2)))


@pytest.mark.broad
@pytest.mark.parametrize("seed", range(4))
def test_a_search_that_comes_down_to_the_floor_is_at_an_optimum(seed):
    box = beside_a_resonance(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fitted = GrayBoxRestructurer(RESONANCE).fit_model(box)
    assert fitted.convergence_ == "optimal" and fitted.stationarity_ == 0.0
    gain = abs(box.frequency_response(np.zeros(1)).item())
    np.testing.assert_allclose(fitted.structural_floor_, gain, rtol=1e-9)
    np.testing.assert_allclose(fitted.error_, gain, rtol=2e-6)
    assert 0.0 < fitted.remaining_error_ < gain


@pytest.mark.slow
def test_what_remains_below_a_floor_is_minimised_from_where_it_was_met(monkeypatch):
    box = beside_a_resonance(0)
    found = GrayBoxRestructurer(RESONANCE).fit_model(box)
    monkeypatch.setattr(minimise_hinf, "_gone_on", lambda _, *end: end[:2])
    met = GrayBoxRestructurer(RESONANCE).fit_model(box)
    assert found.remaining_error_ < 0.995 * met.remaining_error_
    assert found.n_iter_ > met.n_iter_ and len(found.history_) > len(met.history_)
