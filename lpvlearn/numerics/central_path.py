"""The central path, from least squares to the minimum of the H-infinity norm.

With a level t above the largest singular value of the error E at every frequency,

    psi(theta, mu) = min_t  log t - mu sum_k log det(I - E_k^H E_k / t^2)

is smooth. For mu to infinity its minimiser is the least-squares fit, for mu to zero
that of the highest singular value, Eq. (16). Between them runs a path of minimisers,
which Newton's method with exact second derivatives follows. A search on the norm itself
must keep to the ridge where several peaks are equal, and crawls where it bends; for a
large mu the ridge is wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .leastsquares import frequency_grid
from .limits import Limits
from .matching import ErrorSystem, MeasuredErrorSystem

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_SHRINK = 0.3  # of mu, from one stage to the next
_FIRST_LEVEL = 2.0  # level of the first stage, relative to the largest singular value
_BARRIER = 1e-2  # weight of the logarithms of the limits, relative to mu
_NEGLIGIBLE = 1e-14
_TAKEN = 1e-2  # part of the promised decrease that a step must bring
_WORSE = 1.05
_DEPTH = 0.5  # local maxima down to there join the frequencies
_METRIC_CAP = 1e-5


def metric_coordinates(R: Array, size: float) -> Array:
    """`T` with ``|R T y| = size |y|`` on the directions that `R` sees.

    `R` is the triangular factor of the response Jacobian. Directions that it does not
    see (unidentifiable ones) are capped, in units in which all parameters count alike.
    """
    unit = np.linalg.norm(R, axis=0)
    unit = np.where(unit > 0, unit, max(float(unit.max(initial=0.0)), 1e-300))
    _, s, Vt = np.linalg.svd(R / unit)
    s = np.maximum(s, _METRIC_CAP * s.max(initial=0.0))
    s = np.where(s > 0, s, 1.0)
    return Vt.T * (size / s) / unit[:, None]


def response_metric(
    system: ErrorSystem, theta: Array, omega: Array, size: float
) -> Array:
    """`metric_coordinates` of the response at `theta`: a unit step changes it by about
    `size` in root mean square."""
    W = system.weight_response(omega)[0]
    J = system.response_jacobian(theta, omega)[1]
    k, p, m, q = J.shape
    J = (W @ J.reshape(k, p, m * q)).reshape(-1, q) / np.sqrt(k)
    R = np.asarray(np.linalg.qr(np.vstack([J.real, J.imag]), mode="r"))
    return metric_coordinates(R, size)


def search_grid(system: ErrorSystem) -> Array:
    """Frequencies at which a search watches the error, rad/s."""
    if isinstance(system, MeasuredErrorSystem):
        return system.omega
    poles = np.linalg.eigvals(system.target.A).astype(complex)
    return frequency_grid(poles, system.dt)


@dataclass
class PathPoint:
    """Where the central path was left.

    Attributes
    ----------
    theta : ndarray of shape (n_params,)
        Its end; the point of least norm met where the end is much above that.
    mu : float or None
        Its last value; None for a point that is not on the path yet.
    frequencies : ndarray
        Local maxima met on the way, rad/s.
    n_iter : int
        Newton steps.
    history : list of dict
        One row per value of mu: objective, mu, steps.
    """

    theta: Array
    mu: float | None
    frequencies: Array
    n_iter: int
    history: list[dict[str, float]]


def central_path(
    system: ErrorSystem,
    theta: Array,
    limits: Limits,
    *,
    mu_end: float,
    max_iter: int,
    decrement: float = 1e-1,
    mu: float | None = None,
    frequencies: Array | None = None,
) -> PathPoint:
    """Follow the path from `theta` to `mu_end`.

    Parameters
    ----------
    system : ErrorSystem
    theta : ndarray of shape (n_params,)
        Stable; the least-squares fit, or a point met on the path.
    limits : Limits
    mu_end : float
        There the level is about ``mu_end * n_active`` (relative) above the minimum.
    max_iter : int
        Newton steps.
    decrement : float
        A stage ends when Newton's method promises less, relative to mu. The steps that
        a point far from the path needs are longest while mu is large.
    mu : float, default=None
        First value; by default that of a level of twice the norm.
    frequencies : ndarray, default=None
        Local maxima that are known already.
    """
    grid = search_grid(system)
    inside = theta if limits.strict(theta) else limits.inside(theta)
    if not limits.strict(inside):  # at the margin: nothing to follow
        return PathPoint(theta, mu, np.zeros(0), 0, [])
    theta = inside
    found = system.peaks(theta, _DEPTH)
    best, best_norm = theta, found.norm
    seen = np.zeros(0) if frequencies is None else frequencies
    history: list[dict[str, float]] = []
    n_iter = 0
    while n_iter < max_iter:
        if system.peaks_move:
            seen = np.union1d(seen, found.frequencies)
        T = response_metric(system, theta, grid, found.norm)
        stage = _Stage(system, limits, theta, T, np.union1d(grid, seen))
        if mu is None:
            mu = stage.mu_of_level(_FIRST_LEVEL)
        y, steps = _newton(stage, mu, decrement * mu, max_iter - n_iter)
        n_iter += steps
        theta = stage.theta(y)
        found = system.peaks(theta, _DEPTH)
        history.append({"objective": found.norm, "mu": mu, "steps": float(steps)})
        if found.norm < best_norm:
            best, best_norm = theta, found.norm
        if mu <= mu_end:
            break
        mu = max(_SHRINK * mu, mu_end)
    if found.norm > _WORSE * best_norm:
        theta = best
    return PathPoint(theta, mu, seen, n_iter, history)


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


class _Stage:
    """psi for one set of frequencies, in coordinates ``theta = theta_0 + T y``."""

    def __init__(
        self, system: ErrorSystem, limits: Limits, theta0: Array, T: Array, omega: Array
    ) -> None:
        self.system, self.limits = system, limits
        self.theta0, self.T, self.omega = theta0, T, omega
        self.G0 = system.target_response(omega)
        self.W = system.weight_response(omega)[0]

    def theta(self, y: Array) -> Array:
        return self.theta0 + self.T @ y

    def mu_of_level(self, ratio: float) -> float:
        """mu for which the level is `ratio` times the largest singular value."""
        s = self._squares(self.theta0)
        return float(0.5 / (s / (ratio**2 * s.max() - s)).sum())

    def _squares(self, theta: Array) -> Array:
        E = self.W @ (self.system.response(theta, self.omega) - self.G0)
        return np.asarray(np.linalg.svd(E, compute_uv=False) ** 2).ravel()

    def value(self, y: Array, mu: float) -> float:
        """psi, infinite where the limits are not kept."""
        theta = self.theta(y)
        if not np.isfinite(theta).all() or not self.limits.admissible(theta):
            return np.inf
        c = self.limits.values(theta)
        s = self._squares(theta)
        if c.max(initial=-1.0) >= 0 or not np.isfinite(s).all():
            return np.inf
        return _psi(s, level_of(s, mu), mu) - _BARRIER * mu * float(np.log(-c).sum())

    def derivatives(self, y: Array, mu: float) -> tuple[float, Array, Array]:
        """psi, its gradient and its Hessian in y.

        With ``M = (t^2 I - E^H E)^-1`` and ``dX = E^H dE + dE^H E`` the terms of a
        frequency have the derivatives ``2 mu Re tr(M E^H dE)`` and ``mu (2 tr(M dE^H
        dE) + tr(M dX M dX) + 2 Re tr(M E^H d2E))``. The level is eliminated.
        """
        system, theta = self.system, self.theta(y)
        S = system.structure.jacobian(theta)
        q, n = len(S), system.n
        at = system.point(theta, self.omega, self.G0)
        L, E = self.W @ at.L, self.W @ at.E
        k, p, m = E.shape
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
        flat = S.reshape(q, -1)
        gradient = 2.0 * mu * (flat @ np.real(P.sum(0)).T.ravel())
        by_level = -2.0 * mu * (flat @ np.real(P2).T.ravel())
        # dE C and C^H dX C, whose Gram matrices are the terms of first derivatives
        left = np.tensordot(L, S, axes=(2, 1)).reshape(k, p * q, -1)
        dEC = (left @ (at.R @ C)).reshape(k, p, q, m).swapaxes(2, 3)
        Z = ((Ch @ Eh) @ dEC.reshape(k, p, m * q)).reshape(k, m, m, q)
        dX = (Z + Z.conj().swapaxes(1, 2)).reshape(-1, q)
        first = np.sqrt(2.0) * dEC.reshape(-1, q)
        rows = np.concatenate([first.real, first.imag, dX.real, dX.imag])
        # d2E_ij = L S_i Phi S_j R and its mirror image
        product = np.real(np.tensordot(P, at.Phi, axes=(0, 0)))  # (b, a, c, d)
        product = product.transpose(1, 2, 3, 0).reshape(P.shape[2] * n, n * P.shape[1])
        mixed = S[:, :, :n].reshape(q, -1) @ product @ S[:, :n].reshape(q, -1).T
        hessian = mu * (rows.T @ rows) + 2.0 * mu * (mixed + mixed.T)
        curvature = system.structure.curvature(theta)
        if curvature is not None:
            bend = np.tensordot(curvature, np.real(P.sum(0)).T, axes=2)
            hessian = hessian + 2.0 * mu * bend
        level_curvature = mu / tau * float((s / (tau - s) ** 2).sum())
        hessian = hessian - np.outer(by_level, by_level) / level_curvature
        c, dc, _ = self.limits.rows(theta)
        pull = dc / -c[:, None]
        weight = _BARRIER * mu
        value = _psi(s.ravel(), tau, mu) - weight * float(np.log(-c).sum())
        gradient = gradient + weight * pull.sum(0)
        hessian = hessian + weight * (pull.T @ pull)
        T = self.T
        return value, T.T @ gradient, T.T @ hessian @ T


def _psi(squares: Array, tau: float, mu: float) -> float:
    return float(0.5 * np.log(tau) - mu * np.log1p(-squares / tau).sum())


def _newton(
    stage: _Stage, mu: float, enough: float, max_iter: int
) -> tuple[Array, int]:
    """Trust-region Newton method from y = 0; the end and the number of steps."""
    y = np.zeros(len(stage.theta0))
    radius, n_iter = 1.0, 0
    while n_iter < max_iter:
        value, g, H = stage.derivatives(y, mu)
        n_iter += 1
        if not (np.isfinite(g).all() and np.isfinite(H).all()):
            break
        spectrum, Q = np.linalg.eigh(0.5 * (H + H.T))
        slopes = Q.T @ g
        ratio = promised = 0.0
        while radius > _NEGLIGIBLE:
            x = trust_region_step(spectrum, slopes, radius)
            promised = -float(slopes @ x + 0.5 * x @ (spectrum * x))
            if promised < _NEGLIGIBLE:
                break
            ratio = (value - stage.value(y + Q @ x, mu)) / promised
            if ratio > _TAKEN:
                break
            radius = 0.3 * min(float(np.linalg.norm(x)), radius)
        if ratio <= _TAKEN:
            break
        y = y + Q @ x
        if ratio > 0.7:
            radius = max(radius, 3.0 * float(np.linalg.norm(x)))
        elif ratio < 0.25:
            radius *= 0.5
        if promised < enough:
            break
    return y, n_iter


def trust_region_step(spectrum: Array, slopes: Array, radius: float) -> Array:
    """Minimise ``slopes x + sum(spectrum x^2) / 2`` over ``|x| <= radius``."""
    size = max(float(np.abs(spectrum).max(initial=0.0)), 1e-300)
    low = float(spectrum.min())
    if low > 1e-13 * size:
        x = -slopes / spectrum
        if np.linalg.norm(x) <= radius:
            return x
    shift = max(0.0, -low) + 1e-14 * size
    x = -slopes / (spectrum + shift)
    short = radius**2 - float(x @ x)
    if short > 0:  # the hard case: the rest along the lowest curvature
        i = int(np.argmin(spectrum))
        x[i] += np.sqrt(short) if slopes[i] <= 0 else -np.sqrt(short)
        return x
    high = shift + float(np.linalg.norm(slopes)) / radius + size
    for _ in range(60):
        middle = np.sqrt(shift * high)
        if np.linalg.norm(slopes / (spectrum + middle)) > radius:
            shift = middle
        else:
            high = middle
        if high < 1.001 * shift:
            break
    return -slopes / (spectrum + high)
