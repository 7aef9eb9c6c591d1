"""Minimisation of the H-infinity norm of the error over the parameters, Eq. (14)-(16).

The parameters are written ``theta = theta_0 + T y`` in the Gauss-Newton metric of the
least-squares fit, where a unit step changes the response by about the objective.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bundle import proximal_bundle
from .certificates import Flags, MinimaxProblem, MinimaxResult, Peaks
from .leastsquares import (
    LeastSquaresResult,
    fit_frequency_response,
    frequency_grid,
)
from .matching import ErrorSystem, MeasuredErrorSystem, vanishing_weight
from .minimax import minimax_sqp

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_DEPTH = 0.6  # peaks down to that fraction below the objective enter the local model
_FLAT = 1e-7  # a peak with a smaller relative gradient does not depend on theta
_METRIC_CAP = 1e-5
_STATIONARY = 1e-6
_POLISH_ROUNDS = 3
_POLISH_STEPS = 150
_REMAINDER_TOLERANCE = 1e-4
_REMAINDER_STEPS = 60
_CAP_TOLERANCE = 1e-7
_MAX_CAPS = 12
_HARD_STEPS = (0.99, 0.9999)


def keeps_margin(system: ErrorSystem, theta: Array, margin: float) -> bool:
    """Whether every mode of the gray-box model decays faster than `margin` (1/s)."""
    rate = growth(system.poles(theta), system.dt)
    return bool(np.isfinite(rate).all() and rate.max(initial=-np.inf) <= -margin)


def growth(poles: Complex, dt: float | None) -> Array:
    """Growth rates (1/s) of poles: negative for stable ones."""
    if dt is None:
        return poles.real
    return np.log(np.maximum(np.abs(poles), 1e-300)) / dt


def growth_gradients(system: ErrorSystem, theta: Array) -> tuple[Array, Array, Array]:
    """Growth rates, their gradients (n, n_params), and sizes for relative scaling."""
    n = system.n
    A = system.split(system.structure.system_matrix(theta))[0]
    poles, V = np.linalg.eig(A)
    W = np.linalg.pinv(V)
    dA = system.structure.jacobian(theta)[:, :n, :n]
    d = np.einsum("ia,jab,bi->ij", W, dA, V)
    rate = growth(poles, system.dt)
    if system.dt is None:
        return rate, np.real(d), np.abs(poles)
    safe = np.where(poles == 0, 1.0, poles)
    return rate, np.real(d / safe[:, None]) / system.dt, np.abs(np.log(np.abs(safe)))


def metric_coordinates(R: Array, size: float) -> Array:
    """`T` with ``|R T y| = size |y|`` on the directions that `R` sees.

    `R` is the triangular factor of the response Jacobian. Directions that it does not
    see (unidentifiable ones) are capped.
    """
    _, s, Vt = np.linalg.svd(R)
    s = np.maximum(s, _METRIC_CAP * s.max(initial=0.0))
    s = np.where(s > 0, s, 1.0)
    return Vt.T * (size / s)


def within_bounds(system: ErrorSystem, theta: Array) -> Array:
    """`theta` without the rounding errors that pass a bound."""
    return np.clip(theta, system.structure.lower, system.structure.upper)


def bound_rows(system: ErrorSystem, theta: Array) -> tuple[Array, Array]:
    """The finite bounds of the parameters as ``c <= 0``, scaled, and gradients."""
    lower, upper = system.structure.lower, system.structure.upper
    low, high = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    eye = np.eye(len(theta))
    size = np.maximum(np.abs(theta), 1e-300)
    size = np.maximum(size, 1e-3 * size.max(initial=0.0))
    return (
        np.concatenate(
            [(lower - theta)[low] / size[low], (theta - upper)[high] / size[high]]
        ),
        np.vstack([-eye[low] / size[low, None], eye[high] / size[high, None]]),
    )


@dataclass
class HinfObjective:
    """Peaks of the error in the coordinates y, with constant peaks set aside.

    Attributes
    ----------
    system : ErrorSystem
    theta0 : ndarray of shape (n_params,)
    T : ndarray of shape (n_params, n_params)
    margin : float
        Growth rates stay below ``-margin`` (1/s).
    cap : float
        With `capped`: its norm stays below that.
    capped : ErrorSystem or None
        The error whose norm is bounded while that of `system` is minimised.
    floor, floor_frequency : float
        Highest peak met so far whose value does not depend on the parameters.
    """

    system: ErrorSystem
    theta0: Array
    T: Array
    margin: float
    cap: float = np.inf
    capped: ErrorSystem | None = None
    floor: float = 0.0
    floor_frequency: float = 0.0
    _top: float = 0.0
    _cap_frequencies: Array = field(default_factory=lambda: np.zeros(0))

    def theta(self, y: Array) -> Array:
        """Parameters at the coordinates `y`."""
        return self.theta0 + self.T @ y

    def admissible(self, theta: Array) -> bool:
        """Whether the gray-box model keeps (most of) the margin, and the cap."""
        if not keeps_margin(self.system, theta, 0.8 * self.margin):
            return False
        if self.capped is None:
            return True
        found = self.capped.peaks(theta, 1e-3)
        high = found.frequencies[found.values > self.cap * (1.0 + _CAP_TOLERANCE)]
        if high.size:  # bounded there from now on, by a smooth constraint
            known = np.concatenate([self._cap_frequencies, high])
            self._cap_frequencies = np.unique(known)[-_MAX_CAPS:]
        return high.size == 0

    def peaks(self, y: Array) -> Peaks | None:
        """Peaks that depend on the parameters; None where `y` is not admissible."""
        theta = self.theta(y)
        if not self.admissible(theta):
            return None
        within = _DEPTH
        if self.floor > 0 and self._top > 0:
            within = max(_DEPTH, 1.0 - (1.0 - _DEPTH) * self._top / self.floor)
        for depth in (within, *(h for h in _HARD_STEPS if h > within), 1.0):
            found = self.system.peaks(theta, min(depth, 1.0 - 1e-9))
            _, gradients = self.system.gradients(theta, found.frequencies)
            gradients = gradients @ self.T
            steep = np.linalg.norm(gradients, axis=1) > _FLAT * found.values
            if found.norm == 0.0 or steep.any():
                break
        if not steep.all():
            flat = int(np.argmax(np.where(steep, -np.inf, found.values)))
            if found.values[flat] > self.floor:
                self.floor = float(found.values[flat])
                self.floor_frequency = float(found.frequencies[flat])
        if not steep.any():  # nothing is left that the parameters could lower
            none = np.zeros(1)
            return Peaks(none, none, np.zeros((1, len(y))), np.zeros(1, bool))
        peaks = Peaks(
            found.values[steep],
            found.frequencies[steep],
            gradients[steep],
            np.full(int(steep.sum()), self.system.peaks_move),
        )
        self._top = peaks.top
        return peaks

    def samples(self, y: Array, omega: Array) -> Peaks:
        """Singular values at fixed frequencies, and their gradients."""
        values, gradients = self.system.gradients(self.theta(y), omega)
        return Peaks(values, omega, gradients @ self.T, np.zeros(len(omega), bool))

    def hessians(self, y: Array, omega: Array, moving: Flags) -> Array:
        """Second derivatives of the peaks in the coordinates y."""
        H = self.system.hessians(self.theta(y), omega, moving)
        return self.T.T @ H @ self.T

    def constraints(self, y: Array) -> tuple[Array, Array]:
        """``(growth rate + margin) / |pole| <= 0``, the cap, and their gradients."""
        theta = self.theta(y)
        rate, gradients, size = growth_gradients(self.system, theta)
        size = np.maximum(size, self.margin)
        c, dc = (rate + self.margin) / size, gradients @ self.T / size[:, None]
        bounds, rows = bound_rows(self.system, theta)
        c, dc = np.concatenate([c, bounds]), np.vstack([dc, rows @ self.T])
        if self.capped is None or self._cap_frequencies.size == 0:
            return c, dc
        values, slopes = self.capped.gradients(theta, self._cap_frequencies)
        return (
            np.concatenate([c, values / self.cap - 1.0]),
            np.vstack([dc, slopes @ self.T / self.cap]),
        )

    def problem(self) -> MinimaxProblem:
        """The callbacks of the minimax solvers."""
        return MinimaxProblem(self.peaks, self.samples, self.hessians, self.constraints)


Solver = Callable[..., MinimaxResult]


def polished_sqp(
    problem: MinimaxProblem, y0: Array, *, max_iter: int, tol: float, negligible: float
) -> MinimaxResult:
    """`minimax_sqp`, helped by `proximal_bundle` where it stalls.

    Two peaks that merge and split again are no smooth functions; the cutting planes of
    the bundle pass them, and the second-order method finishes.
    """
    best = minimax_sqp(problem, y0, max_iter=max_iter, tol=tol, negligible=negligible)
    steps = min(max_iter, _POLISH_STEPS)
    for _ in range(_POLISH_ROUNDS):
        if best.stationarity <= _STATIONARY or best.peaks.top <= negligible:
            break
        helped = proximal_bundle(
            problem, best.y, max_iter=steps, tol=tol, negligible=negligible
        )
        after = minimax_sqp(
            problem,
            helped.y,
            max_iter=steps,
            tol=tol,
            radius=0.01,
            negligible=negligible,
        )
        done = after.peaks.top > best.peaks.top * (1.0 - 1e-9)
        best = replace(
            after,
            n_iter=best.n_iter + helped.n_iter + after.n_iter,
            history=best.history + helped.history + after.history,
        )
        if done:
            break
    return best


SOLVERS: dict[str, Solver] = {"sqp": polished_sqp, "bundle": proximal_bundle}


def minimise_hinf(
    system: ErrorSystem,
    fit: LeastSquaresResult,
    margin: float,
    solver: Solver,
    *,
    max_iter: int,
    tol: float,
    negligible: float,
) -> tuple[Array, MinimaxResult, float]:
    """Minimise the H-infinity norm of the error from a stable point.

    Parameters
    ----------
    system : ErrorSystem
    fit : LeastSquaresResult
        Stable start, and the metric of the steps.
    margin : float
        Stability margin, 1/s.
    solver : callable
        One of `SOLVERS`.
    negligible : float
        Errors at or below it are rounding noise.

    Returns
    -------
    theta : ndarray of shape (n_params,)
    result : MinimaxResult
        Of the peaks that depend on the parameters.
    floor : float
        Highest constant peak (0 where there is none).

    Notes
    -----
    Where the floor is above all other peaks, the start is already optimal, and so is
    every theta that keeps the others below it. Then a weight that vanishes at the
    floor's frequency sets it aside, and the norm of what remains is minimised among
    these optimal points.
    """
    theta0, R = fit.x, fit.R
    start = system.peaks(theta0)
    if start.norm <= negligible:  # exact already
        flat = np.zeros((len(start.values), len(theta0)))
        still = np.zeros(len(start.values), bool)
        peaks = Peaks(start.values, start.frequencies, flat, still)
        return theta0, MinimaxResult(theta0, peaks, 0.0, np.inf, True, 0), 0.0
    origin = np.zeros(len(theta0))
    T = metric_coordinates(R, max(start.norm, 1e-300))
    objective = HinfObjective(system, theta0, T, margin)
    first = objective.peaks(origin)
    options: dict[str, Any] = {
        "max_iter": max_iter,
        "tol": tol,
        "negligible": negligible,
    }
    if first is None or objective.floor < first.top:
        result = solver(objective.problem(), origin, **options)
        floor = objective.floor if objective.floor > negligible else 0.0
        return within_bounds(system, objective.theta(result.y)), result, floor
    weight = vanishing_weight(system, objective.floor_frequency)
    if weight is None:
        certified = MinimaxResult(theta0, first, 0.0, 0.0, True, 0)
        return theta0, certified, objective.floor
    theta, result = _minimise_remainder(
        system, system.reweighted(weight), objective.floor, theta0, margin, options
    )
    # a constant peak is active: its zero gradient certifies the optimum, though
    # not a strict one
    certified = replace(result, stationarity=0.0, second_order=0.0, converged=True)
    return theta, certified, objective.floor


def _minimise_remainder(
    system: ErrorSystem,
    remainder: ErrorSystem,
    floor: float,
    theta0: Array,
    margin: float,
    options: dict[str, Any],
) -> tuple[Array, MinimaxResult]:
    """Minimise the weighted remainder while the error stays on its floor."""
    poles = np.linalg.eigvals(system.target.A).astype(complex)
    omega = (
        system.omega
        if isinstance(system, MeasuredErrorSystem)
        else frequency_grid(poles, system.dt)
    )
    bound = HinfObjective(remainder, theta0, np.eye(len(theta0)), margin, floor, system)
    fit = fit_frequency_response(
        remainder,
        theta0,
        omega,
        remainder.target_response(omega),
        admissible=bound.admissible,
    )
    assert fit is not None  # theta0 is admissible
    T = metric_coordinates(fit.R, max(remainder.peaks(fit.x).norm, 1e-300))
    objective = HinfObjective(remainder, fit.x, T, margin, floor, system)
    # the optimum is certified by the floor; what follows chooses among optimal points
    options = options | {
        "tol": max(options["tol"], _REMAINDER_TOLERANCE),
        "max_iter": min(options["max_iter"], _REMAINDER_STEPS),
    }
    result = minimax_sqp(objective.problem(), np.zeros(len(theta0)), **options)
    return within_bounds(system, objective.theta(result.y)), result
