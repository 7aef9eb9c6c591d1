"""Other solvers for ``min ||G(theta) - G0||_inf``, as references for the studies.

A semi-infinite program solved by SLSQP with exchange of frequencies, and a nonsmooth
BFGS method. Small and slow; they share nothing with the library's solvers but the
H-infinity norm.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.error_system import Target
from lpvlearn.restructuring.limits import natural_margin
from lpvlearn.systems.hinf_norm import linf_norm

UNSTABLE = 1e300


class Objective:
    """The norm of the error in coordinates ``theta = theta_0 + T y``."""

    def __init__(
        self, structure: GrayBoxStructure, model: StateSpace, theta: np.ndarray
    ) -> None:
        self.structure, self.model = structure, model
        target = Target(model.A, model.B, model.C, model.D)
        self.margin = natural_margin(target)  # the library's set of models
        self.theta0, self.T = theta, np.eye(len(theta))
        omega = self.grid()
        _, L, R = self.error(theta, omega)
        dS = structure.jacobian(theta)
        J = np.einsum("kia,qab,kbj->kijq", L, dS, R, optimize=True)
        J = J.reshape(-1, len(theta))
        _, s, Vt = np.linalg.svd(np.vstack([J.real, J.imag]) / np.sqrt(len(omega)))
        s = np.maximum(s, 1e-6 * s[0])
        self.T = Vt.T / s * self.norm(theta, 1e-9)[0]

    def grid(self) -> np.ndarray:
        poles = np.abs(self.model.poles())
        return np.unique(
            np.r_[poles, np.geomspace(0.1 * poles.min(), 10 * poles.max(), 30)]
        )

    def theta(self, y: np.ndarray) -> np.ndarray:
        return self.theta0 + self.T @ y

    def growth(self, theta: np.ndarray) -> float:
        return float(np.linalg.eigvals(self.structure.matrices(theta)[0]).real.max())

    def stable(self, theta: np.ndarray) -> bool:
        return self.growth(theta) < -0.8 * self.margin

    def norm(self, theta: np.ndarray, within: float) -> tuple[float, np.ndarray]:
        """The norm and the frequencies of the peaks near it."""
        A, B, C, D = self.structure.matrices(theta)
        lower, upper = self.structure.lower, self.structure.upper
        outside = (theta < lower).any() or (theta > upper).any()
        if outside or not np.isfinite(A).all() or not self.stable(theta):
            return UNSTABLE, np.zeros(0)
        m = self.model
        zero = np.zeros((len(A), m.order))
        Ae = np.block([[A, zero], [zero.T, m.A]])
        Be, Ce = np.vstack([B, m.B]), np.hstack([C, -m.C])
        found = linf_norm(Ae, Be, Ce, D - m.D, within=within)
        return found.norm, found.frequencies

    def error(self, theta: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, ...]:
        """Error response, and ``L``, ``R`` of its derivatives ``L dS_j R``."""
        omega = np.where(np.isinf(omega), 1e12, omega)
        A, B, C, D = self.structure.matrices(theta)
        n, k = len(A), len(omega)
        X = np.linalg.inv(1j * omega[:, None, None] * np.eye(n) - A)
        p, m = D.shape
        L = np.concatenate([C @ X, np.broadcast_to(np.eye(p), (k, p, p))], 2)
        R = np.concatenate([X @ B, np.broadcast_to(np.eye(m), (k, m, m))], 1)
        E = L[:, :, :n] @ B + D - self.model.frequency_response(omega)
        return E, L, R

    def peaks(self, y: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Largest singular values at the frequencies, and gradients in y."""
        theta = self.theta(y)
        E, L, R = self.error(theta, omega)
        U, s, Vh = np.linalg.svd(E)
        left = np.einsum("ki,kia->ka", U[:, :, 0].conj(), L)
        right = np.einsum("kbj,kj->kb", R, Vh[:, 0].conj())
        outer = np.real(left[:, :, None] * right[:, None, :]).reshape(len(omega), -1)
        dS = self.structure.jacobian(theta).reshape(len(theta), -1)
        return s[:, 0], outer @ dS.T @ self.T

    def value(self, y: np.ndarray) -> tuple[float, np.ndarray]:
        """The norm and one subgradient."""
        norm, omega = self.norm(self.theta(y), 1e-12)
        if norm >= UNSTABLE:
            return norm, np.zeros(len(y))
        return norm, self.peaks(y, omega[:1])[1][0]


def exchange(
    structure: GrayBoxStructure, model: StateSpace, theta: np.ndarray, rounds: int = 15
) -> tuple[float, np.ndarray]:
    """SLSQP on a growing set of frequencies; the best value and its parameters."""
    objective = Objective(structure, model, theta)
    y = np.zeros(len(theta))
    best, best_y = objective.norm(theta, 0.5)[0], y
    omega = np.unique(np.r_[objective.grid(), objective.norm(theta, 0.5)[1]])
    scale, last = best, np.inf
    unit = np.r_[np.zeros(len(y)), 1.0]

    def slack(x: np.ndarray) -> np.ndarray:
        return x[-1] - objective.peaks(x[:-1], omega)[0] / scale

    def slack_slope(x: np.ndarray) -> np.ndarray:
        slope = -objective.peaks(x[:-1], omega)[1] / scale
        return np.hstack([slope, np.ones((len(omega), 1))])

    def stable(x: np.ndarray) -> np.ndarray:
        return np.array([-objective.growth(objective.theta(x[:-1])) - objective.margin])

    for _ in range(rounds):
        start = np.r_[y, objective.peaks(y, omega)[0].max() / scale]
        found = minimize(
            lambda x: x[-1],
            start,
            jac=lambda x: unit,
            constraints=[
                {"type": "ineq", "fun": slack, "jac": slack_slope},
                {"type": "ineq", "fun": stable},
            ],
            bounds=[(v - 1.0, v + 1.0) for v in y] + [(0, None)],
            method="SLSQP",
            options={"maxiter": 60, "ftol": 1e-13},
        )
        trial = found.x[:-1]
        value, peaks = objective.norm(objective.theta(trial), 0.5)
        for _ in range(5):
            if value < UNSTABLE:
                break
            trial = 0.5 * (trial + y)
            value, peaks = objective.norm(objective.theta(trial), 0.5)
        omega = np.unique(np.r_[omega, peaks[np.isfinite(peaks)]])
        y = trial if value < 1.5 * best else y
        if value < best:
            best, best_y = value, trial
        if abs(value - last) < 1e-9 * best:
            break
        last = value
    return best, objective.theta(best_y)


def nonsmooth_bfgs(
    structure: GrayBoxStructure,
    model: StateSpace,
    theta: np.ndarray,
    max_iter: int = 250,
) -> tuple[float, np.ndarray]:
    """BFGS with a weak Wolfe line search; the best value and its parameters."""
    objective = Objective(structure, model, theta)
    y = np.zeros(len(theta))
    f, g = objective.value(y)
    H = 0.1 * np.eye(len(y)) / max(float(np.linalg.norm(g)), 1e-300)
    stalled = 0
    for n_iter in range(max_iter):
        d = -H @ g
        slope = float(g @ d)
        if slope >= -1e-16 * f:
            break
        low, high, t = 0.0, np.inf, 1.0
        for _ in range(40):
            new_f, new_g = objective.value(y + t * d)
            if new_f >= f + 1e-4 * t * slope:
                high = t
            elif float(new_g @ d) < 0.5 * slope:
                low = t
            else:
                break
            t = 2.0 * low if np.isinf(high) else 0.5 * (low + high)
        if new_f >= f:
            break
        s, change = t * d, new_g - g
        stalled = stalled + 1 if f - new_f < 1e-10 * f else 0
        y, f, g = y + s, new_f, new_g
        curvature = float(s @ change)
        if curvature > 0:
            if n_iter == 0:
                H = np.eye(len(y)) * curvature / float(change @ change)
            V = np.eye(len(y)) - np.outer(s, change) / curvature
            H = V @ H @ V.T + np.outer(s, s) / curvature
        if stalled >= 15:
            break
    return f, objective.theta(y)
