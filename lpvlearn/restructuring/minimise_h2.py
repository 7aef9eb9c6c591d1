"""Minimisation of the H2 norm of the error: the mean square over all frequencies.

With Gramians ``A P + P A^T + B B^T = 0`` and ``A^T Q + Q A + C^T C = 0`` (or their
discrete counterparts) the squared norm is ``J = tr(C P C^T)`` and its derivatives are
``dJ/dA = 2 Q P``, ``dJ/dB = 2 Q B``, ``dJ/dC = 2 C P``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov
from scipy.optimize import minimize

from ..minimax.problem import MinimaxResult, Peaks
from .coordinates import metric_coordinates
from .error_system import ErrorSystem
from .least_squares import LeastSquaresResult
from .limits import Limits, keeps_margin, within_bounds

Array = NDArray[np.float64]

_NO_FEEDTHROUGH = 1e-9  # relative size of a feedthrough that is rounding noise
_REFUSED = 1e3  # squared error, relative to the start, of a model that is not stable


def squared_h2(system: ErrorSystem, theta: Array) -> tuple[float, Array]:
    """Squared H2 norm of the weighted error, and its gradient.

    In continuous time the feedthrough of the error must vanish; it is left out.
    """
    structure, n, p, w = system.structure, system.n, system.n_outputs, system.weight
    N = n + len(system.target.A)
    As, Bs, Cs, Ds = system.realisation(theta)
    if system.dt is None:
        P = solve_continuous_lyapunov(As, -Bs @ Bs.T)
        Q = solve_continuous_lyapunov(As.T, -Cs.T @ Cs)
        J, gA, gB, gC = np.trace(Cs @ P @ Cs.T), 2 * Q @ P, 2 * Q @ Bs, 2 * Cs @ P
        gDs = np.zeros_like(Ds)
    else:
        P = solve_discrete_lyapunov(As, Bs @ Bs.T)
        Q = solve_discrete_lyapunov(As.T, Cs.T @ Cs)
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

    A ValueError where the error has a feedthrough in continuous time: its H2 norm is
    infinite.
    """
    theta0, active = _matched_feedthrough(system, fit.x)
    J0, _ = squared_h2(system, theta0)
    scale = np.sqrt(J0) if J0 > 0 else 1.0
    J = system.linearised_error(theta0, system.grid)[1]()[..., active]
    T = metric_coordinates(J, max(np.sqrt(fit.cost), negligible, 1e-300))
    bounded = np.isfinite([system.structure.lower, system.structure.upper]).any()
    if bounded:  # coordinates in which the bounds stay bounds
        T = np.diag(Limits(system, margin).sizes(theta0)[active])
    history: list[dict[str, float]] = []

    def theta_of(y: Array) -> Array:
        theta = theta0.copy()
        theta[active] += T @ y
        return within_bounds(system, theta)

    def objective(y: Array) -> tuple[float, Array]:
        theta = theta_of(y)
        if not keeps_margin(system, theta, margin):
            return _REFUSED, np.zeros_like(y)
        J, gradient = squared_h2(system, theta)
        return J / scale**2, (gradient[active] @ T) / scale**2

    y, found = np.zeros(len(T)), None
    low, high = np.full((2, len(y)), [[-np.inf], [np.inf]])
    if bounded:
        low = (system.structure.lower - theta0)[active] / np.diag(T)
        high = (system.structure.upper - theta0)[active] / np.diag(T)
    if J0 > negligible**2:
        found = minimize(
            objective,
            y,
            jac=True,
            method="L-BFGS-B" if bounded else "BFGS",
            bounds=np.transpose([low, high]) if bounded else None,
            options={"maxiter": max_iter, "gtol": max(tol, 1e-12) ** 0.75},
            callback=lambda z: history.append(
                {"objective": scale * np.sqrt(max(objective(z)[0], 0.0))}
            ),
        )
        y = found.x if found.fun <= 1.0 else y
    theta = theta_of(y)
    value, gradient = objective(y)
    size = scale * np.sqrt(value)
    peaks = Peaks(np.array([size]), np.zeros(0), gradient[None], np.zeros(1, bool))
    held = ((y <= low) & (gradient > 0)) | ((y >= high) & (gradient < 0))
    slope = (
        float(np.linalg.norm(gradient[~held])) / max(value, 1e-300) if J0 > 0 else 0.0
    )
    done = found is None or found.nit < max_iter
    n_iter = 0 if found is None else int(found.nit)
    result = MinimaxResult(theta, peaks, slope, np.nan, done, n_iter, history)
    return theta, result


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
    error = system.split(structure.system_matrix(theta))[3] - system.target.D
    if only_D.any():
        columns = S[only_D][:, n:, n:].reshape(int(only_D.sum()), -1).T
        theta[only_D] -= np.linalg.lstsq(columns, error.ravel(), rcond=None)[0]
        error = system.split(structure.system_matrix(theta))[3] - system.target.D
    size = max(float(np.abs(system.target.D).max()), float(np.abs(error).max()), 1e-300)
    if np.abs(error).max() > _NO_FEEDTHROUGH * size and in_D.any():
        raise ValueError(
            "`norm='h2'` needs an error without feedthrough: D of the black box cannot "
            "be matched by the structure. Use norm='hinf', or a strictly proper "
            "`frequency_weight`."
        )
    return theta, ~only_D
