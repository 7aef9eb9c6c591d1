"""The logarithmic barrier of the error's largest singular value, and its derivatives.

With a level t above the largest singular value of the error E at every frequency,

    psi(theta, mu) = min_t  log t - mu sum_k log det(I - E_k^H E_k / t^2)

is smooth: least squares for a large mu, the highest singular value for a small one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .limits import Limits
from .matching import ErrorSystem
from .response_geometry import ResponseGeometry

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BARRIER = 1e-2  # weight of the logarithms of the limits, relative to mu


def level_of(squares: Array, mu: float) -> float:
    """Square of the level t, where ``2 mu sum s / (t^2 - s) = 1``.

    Parameters
    ----------
    squares : ndarray
        Squared singular values s, of all frequencies.
    """
    top = float(squares.max())
    gap, low = squares - top, 2.0 * mu * top
    high = 2.0 * mu * float(squares.sum())
    x = low
    for _ in range(60):  # 1 / sum is nearly linear in the distance x
        ratio = squares / (x - gap)
        total = float(ratio.sum())
        slope = float((ratio / (x - gap)).sum())
        new = x - (1.0 / total - 2.0 * mu) * total**2 / slope
        new = min(max(new, low), high)
        if abs(new - x) <= 4e-16 * new:
            break
        x = new
    return top + x


@dataclass(frozen=True)
class Quadratic:
    """psi near one theta, along geodesics of the response.

    Attributes
    ----------
    value : float
    gradient : ndarray of shape (q,)
    hessian : ndarray of shape (q, q)
    drift : ndarray of shape (q,)
        Derivative of the gradient by mu.
    geometry : ResponseGeometry
        Of which y are the coordinates.
    """

    value: float
    gradient: Array
    hessian: Array
    drift: Array
    geometry: ResponseGeometry


class Barrier:
    """psi for one set of frequencies.

    Parameters
    ----------
    system : ErrorSystem
    limits : Limits
        Kept by logarithms of their own.
    omega : ndarray
        Frequencies, rad/s.
    size : float
        Change of the response that a unit step makes.

    Attributes
    ----------
    missed : ndarray
        Frequencies (rad/s) of resonances between the others that rose above the level
        at the point of the last `value`.
    """

    def __init__(
        self, system: ErrorSystem, limits: Limits, omega: Array, size: float
    ) -> None:
        self.system, self.limits, self.size = system, limits, size
        self.missed = np.zeros(0)
        self.watch(omega)

    def watch(self, omega: Array) -> None:
        """Take that set of frequencies."""
        self.omega = omega
        self._G0 = self.system.target_response(omega)
        self._W = self.system.weight_response(omega)[0]

    def mu_of_level(self, theta: Array, ratio: float) -> float:
        """mu for which the level is `ratio` times the largest singular value."""
        s = self._squares(theta, self.omega, self._G0, self._W)
        return float(0.5 / (s / (ratio**2 * s.max() - s)).sum())

    def _squares(self, theta: Array, omega: Array, G0: Complex, W: Complex) -> Array:
        E = W @ (self.system.response(theta, omega) - G0)
        return np.asarray(np.linalg.svd(E, compute_uv=False) ** 2).ravel()

    def value(self, theta: Array, mu: float) -> float:
        """psi, infinite where the limits are not kept.

        And where a resonance of the gray-box model, unseen between the frequencies,
        rises above the level.
        """
        self.missed = np.zeros(0)
        system = self.system
        if not np.isfinite(theta).all():
            return np.inf
        poles = system.poles(theta)
        if not np.isfinite(poles).all():
            return np.inf
        c = self.limits.values(theta, poles)
        if not c.max(initial=-1.0) < 0:
            return np.inf
        s = self._squares(theta, self.omega, self._G0, self._W)
        if not np.isfinite(s).all():
            return np.inf
        level = level_of(s, mu)
        turns = system.resonances(poles)
        if turns.size:
            self.missed = turns[system.values(theta, turns) ** 2 >= level]
            if self.missed.size:
                return np.inf
        return _psi(s, level, mu) - _BARRIER * mu * float(np.log(-c).sum())

    def quadratic(self, theta: Array, mu: float) -> Quadratic:
        """psi, its gradient and its Hessian.

        With ``M = (t^2 I - E^H E)^-1`` and ``dX = E^H dE + dE^H E`` the terms of a
        frequency have the derivatives ``2 mu Re tr(M E^H dE)`` and ``mu (2 tr(M dE^H
        dE) + tr(M dX M dX) + 2 Re tr(M E^H d2E))``. The level is eliminated. Along
        geodesics only the normal part of the covector ``2 mu E M`` meets ``d2E``.
        """
        c, dc, _ = self.limits.rows(theta)
        pull, weight = dc / -c[:, None], _BARRIER * mu
        geometry = ResponseGeometry(
            self.system, theta, self.omega, self.size, self._G0, pull
        )
        at, L, S = geometry.at, geometry.L, geometry.S
        E = self._W @ at.E
        k, p, m = E.shape
        q = len(S)
        _, sigma, Vh = np.linalg.svd(E)
        s = sigma**2
        tau = level_of(s.ravel(), mu)
        padded = np.zeros((k, m))
        padded[:, : s.shape[1]] = s
        C = Vh.conj().swapaxes(1, 2) / np.sqrt(tau - padded)[:, None]  # M = C C^H
        Eh, Ch = E.conj().swapaxes(1, 2), C.conj().swapaxes(1, 2)
        inner = C @ (Ch @ Eh)  # M E^H
        P = at.R @ inner @ L  # tr(M E^H dE_j) = tr(P S_j)
        P2 = (at.R @ (C @ (Ch @ inner)) @ L).sum(0)
        flat, T = S.reshape(q, -1), geometry.T
        gradient = 2.0 * mu * (flat @ np.real(P.sum(0)).T.ravel())
        by_level = -2.0 * mu * (flat @ np.real(P2).T.ravel())
        level_curvature = mu / tau * float((s / (tau - s) ** 2).sum())
        # dE C and C^H dX C, whose Gram matrices are the terms of first derivatives
        dEC = geometry.by_parameter(geometry.products @ (at.R @ C))
        Z = ((Ch @ Eh) @ dEC.reshape(k, p, m * q)).reshape(k, m, m, q)
        dX = (Z + Z.conj().swapaxes(1, 2)).reshape(-1, q)
        first = np.sqrt(2.0) * dEC
        rows = np.concatenate([first.real, first.imag, dX.real, dX.imag])
        value = _psi(s.ravel(), tau, mu) - weight * float(np.log(-c).sum())
        hessian = mu * (rows.T @ rows) + weight * (pull.T @ pull)
        hessian = hessian - np.outer(by_level, by_level) / level_curvature
        gradient, by_level = T.T @ (gradient + weight * pull.sum(0)), T.T @ by_level
        normal = 2.0 * mu * P - geometry.tangential(gradient)
        hessian = T.T @ hessian @ T + geometry.second_derivatives(normal)
        # at fixed theta the level falls with mu by 1 / (2 mu tau curvature)
        drift = gradient / mu + by_level / (2.0 * mu * tau * level_curvature)
        return Quadratic(value, gradient, hessian, drift, geometry)


def _psi(squares: Array, tau: float, mu: float) -> float:
    return float(0.5 * np.log(tau) - mu * np.log1p(-squares / tau).sum())
