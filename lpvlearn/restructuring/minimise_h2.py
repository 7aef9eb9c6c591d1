"""Minimisation of the H2 norm of the error: the mean square over all frequencies.

With Gramians ``A P + P A^T + B B^T = 0`` and ``A^T Q + Q A + C^T C = 0`` (or their
discrete counterparts) the squared norm is ``J = tr(C P C^T)`` and its derivatives are
``dJ/dA = 2 Q P``, ``dJ/dB = 2 Q B``, ``dJ/dC = 2 C P``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov
from scipy.optimize import minimize

from ..minimax.problem import MinimaxResult, Peaks, shortest_in_hull
from ..systems.balancing import in_even_units
from .coordinates import metric_coordinates
from .deadline import time_is_up
from .error_system import ErrorSystem, Target, remembering
from .least_squares import LeastSquaresResult
from .limits import Limits, within_bounds
from .minimise_hinf import NEARLY

_ROUNDS = 12  # of the quasi-Newton method
_PROGRESS = 1e-9  # relative decrease of the squared norm that is worth another round

_FINEST = 1e-16  # decrease, relative to the start of a round, that ends it
_BINDING = -1e-6  # relative value from which a limit binds

# Squared error, relative to the squared norm of the model, that is rounding: the norm
# of a difference of Gramians keeps half of the digits.
_RELATIVE_ROUNDING = 1e-12

Array = NDArray[np.float64]

_NO_FEEDTHROUGH = 1e-9  # relative size of a feedthrough that is rounding noise
_REFUSED = 1e3  # squared error, relative to the start, of a model that is not stable


def squared_h2(system: ErrorSystem, theta: Array) -> tuple[float, Array]:
    """Squared H2 norm of the weighted error, and its gradient.

    In continuous time the feedthrough of the error must vanish; it is left out.
    """
    structure, n, p, w = system.structure, system.n, system.n_outputs, system.weight
    N = n + len(system.target.A)
    As, Bs, Cs, Ds = system.realisation(theta).matrices
    continuous = system.dt is None
    P, Q = _gramian(As, Bs, continuous), _gramian(As.T, Cs.T, continuous)
    if continuous:
        J, gA, gB, gC = np.trace(Cs @ P @ Cs.T), 2 * Q @ P, 2 * Q @ Bs, 2 * Cs @ P
        gDs = np.zeros_like(Ds)
    else:
        J = np.trace(Cs @ P @ Cs.T) + np.sum(Ds**2)
        gA, gB, gC = 2 * Q @ As @ P, 2 * Q @ Bs, 2 * Cs @ P
        gDs = 2 * Ds
    gCe, gDe = gC[:, :N], gDs
    if w is not None:
        gCe = w.B.T @ gA[N:, :N] + w.D.T @ gC[:, :N]
        gDe = w.B.T @ gB[N:] + w.D.T @ gDs
    gS = np.zeros((n + p, n + system.n_inputs))
    gS[:n, :n], gS[:n, n:] = gA[:n, :n], gB[:n]
    gS[n:, :n], gS[n:, n:] = gCe[:, :n], gDe
    gradient = np.tensordot(structure.jacobian(theta), gS, axes=2)
    return float(max(J, 0.0)), gradient


def _gramian(A: Array, B: Array, continuous: bool) -> Array:
    """The controllability Gramian P, solved for in even units of the states.

    In others poles of a fast system would seem to lie on the axis.
    """
    even, units = in_even_units(A)
    B = B / units[:, None]
    if continuous:
        P = solve_continuous_lyapunov(even, -B @ B.T)
    else:
        P = solve_discrete_lyapunov(even, B @ B.T)
    return np.asarray(P * units[:, None] * units)


def minimise_h2(
    system: ErrorSystem,
    fit: LeastSquaresResult,
    margin: float,
    *,
    max_iter: int,
    tol: float,
    negligible: float,
) -> tuple[Array, MinimaxResult]:
    """Minimise the H2 norm by a quasi-Newton method from a least-squares fit.

    In rounds, each in coordinates of the response's metric where it begins. A
    ValueError where the error has a feedthrough in continuous time: its H2 norm is
    infinite.
    """
    theta, active = _matched_feedthrough(system, fit.x)
    limits = Limits(system, margin)
    J, gradient = squared_h2(system, theta)
    history: list[dict[str, float]] = []
    n_iter, slope, known = 0, 0.0, np.inf
    for left in range(_ROUNDS, -1, -1):
        if negligible**2 >= J:
            slope = 0.0
            break
        T = _metric(system, theta, active, negligible)
        c, dc = limits.scaled(theta, T)
        slope = shortest_in_hull((gradient @ T / J)[None], dc[c >= _BINDING])[0]
        idle = J >= known * (1.0 - _PROGRESS)
        if slope <= tol or idle or not left or n_iter >= max_iter or time_is_up():
            break
        end, steps = _quasi_newton(
            system, limits, theta, J, T, max_iter - n_iter, history
        )
        n_iter += steps
        known, found = J, squared_h2(system, end)
        if found[0] < known:
            theta, (J, gradient) = end, found
    peaks = Peaks(
        np.array([np.sqrt(J)]), np.zeros(0), gradient[None], np.zeros(1, bool)
    )
    done = slope <= NEARLY or J <= _rounding(system, theta)
    cause = "" if done else "no step of the quasi-Newton method lowers the norm"
    return theta, MinimaxResult(
        theta, peaks, slope, np.nan, done, n_iter, history, cause
    )


def _metric(
    system: ErrorSystem, theta: Array, active: NDArray[np.bool_], negligible: float
) -> Array:
    """Coordinates in which a unit step changes the response by its error.

    Of the `active` parameters: the others stay.
    """
    E, slopes = system.linearised_error(theta, system.grid)
    size = float(np.linalg.norm(E)) / np.sqrt(len(system.grid))
    size = max(size, negligible, 1e-300)
    T = np.zeros((len(theta), active.sum()), order="F")
    T[active] = metric_coordinates(slopes()[..., active], size)
    return T


class _TimeIsUp(Exception):
    """Ends SciPy's search."""


def _quasi_newton(
    system: ErrorSystem,
    limits: Limits,
    theta: Array,
    J: float,
    T: Array,
    max_iter: int,
    history: list[dict[str, float]],
) -> tuple[Array, int]:
    """End of a round, and its iterations."""

    def theta_of(y: Array) -> Array:
        return theta + T @ y

    least, best = J, np.zeros(T.shape[1])

    @remembering
    def objective(y: Array) -> tuple[float, Array]:
        nonlocal least, best
        if time_is_up():
            raise _TimeIsUp
        end = theta_of(y)
        if not limits.admissible(end):
            return _REFUSED, np.zeros_like(y)
        value, gradient = squared_h2(system, end)
        if value < least:
            least, best = value, y.copy()
        return value / J, (gradient @ T) / J

    @remembering
    def kept(y: Array) -> tuple[Array, Array]:
        end = theta_of(y)
        if not np.isfinite(system.poles(end)).all():
            return np.full(1, -1.0), np.zeros((1, len(y)))
        return limits.scaled(end, T)

    known = len(history)
    try:
        best = minimize(
            objective,
            np.zeros(T.shape[1]),
            jac=True,
            method="SLSQP",
            constraints={
                "type": "ineq",
                "fun": lambda y: -kept(y)[0],
                "jac": lambda y: -kept(y)[1],
            },
            options={"maxiter": max_iter, "ftol": _FINEST},
            callback=lambda z: history.append(
                {"objective": np.sqrt(J * max(objective(z)[0], 0.0))}
            ),
        ).x
    except _TimeIsUp:
        pass
    end = within_bounds(system, theta_of(best))
    return end if limits.admissible(end) else theta, len(history) - known


def _rounding(system: ErrorSystem, theta: Array) -> float:
    """Squared norm of an error that is rounding beside what it is the difference of."""
    t, nothing = system.target, np.zeros_like
    alone = Target(
        nothing(t.A) - np.eye(len(t.A)), nothing(t.B), t.C, nothing(t.D), t.dt
    )
    if t.dt is not None:
        alone = replace(alone, A=nothing(t.A))
    whole = ErrorSystem(system.structure, alone, system.weight)
    return _RELATIVE_ROUNDING * squared_h2(whole, theta)[0]


def _matched_feedthrough(
    system: ErrorSystem, theta: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Parameters of D alone set to match, and the mask of the others."""
    n, structure = system.n, system.structure
    S = structure.jacobian(theta)
    in_D = (S[:, n:, n:] != 0).any((1, 2))
    elsewhere = (S[:, :n] != 0).any((1, 2)) | (S[:, n:, :n] != 0).any((1, 2))
    if system.dt is not None or (
        system.weight is not None and not system.weight.D.any()
    ):
        return theta, np.ones(len(theta), bool)
    only_D = in_D & ~elsewhere
    theta = theta.copy()
    error = system.model(theta).D - system.target.D
    if only_D.any():
        columns = S[only_D][:, n:, n:].reshape(int(only_D.sum()), -1).T
        theta[only_D] -= np.linalg.lstsq(columns, error.ravel(), rcond=None)[0]
        error = system.model(theta).D - system.target.D
    size = max(float(np.abs(system.target.D).max()), float(np.abs(error).max()), 1e-300)
    if np.abs(error).max() > _NO_FEEDTHROUGH * size and in_D.any():
        raise ValueError(
            "`norm='h2'` needs an error without feedthrough: D of the black box cannot "
            "be matched by the structure. Use norm='hinf', or a strictly proper "
            "`frequency_weight`."
        )
    return theta, ~only_D
