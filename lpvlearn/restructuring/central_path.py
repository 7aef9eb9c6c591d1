"""The central path from the least-squares fit to the least H-infinity norm.

With a level t above the largest singular value of the error E at every frequency,

    psi(theta, mu) = min_t  log t - mu sum_k log det(I - E_k^H E_k / t^2)

is smooth: least squares for a large mu, the highest singular value for a small one.
Its minimisers for a falling mu are the central path, which Newton's method follows in
a trust region, along geodesics of the response.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .coordinates import ResponseGeometry
from .deadline import time_is_up
from .error_system import ErrorSystem
from .limits import Limits

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# weight of the logarithms of the limits, relative to mu: they keep steps off the limits
# and hardly move the minimum
_BARRIER = 1e-2
_SHRINK = 0.3  # of mu, from one stage to the next
_FIRST_LEVEL = 2.0  # level of the first stage, relative to the largest singular value
_SINGULAR = 1e-12  # relative curvature: flatter directions are taken as that steep
# Of a trust-region step: relative curvature that still counts as positive, the excess
# of the shift over the lowest eigenvalue, and digits of the shift, of which few matter
_POSITIVE, _EXCESS, _CLOSE = 1e-13, 1e-14, 1.001
_BISECTIONS = 60  # halve the logarithm of any bracket of doubles down to `_CLOSE`
_NEGLIGIBLE = 1e-14  # decrease of psi, or radius, that is rounding noise
_TAKEN = 1e-2  # part of the promised decrease that a step must bring

# of the trust region: longer after steps as good as promised, shorter after poor ones,
# and shorter still after those that failed
_GOOD, _LONGER, _POOR, _SHORTER, _FAILED = 0.7, 3.0, 0.25, 0.5, 0.3
_NOTHING = 1e-300  # square of the level of no error
_WORSE = 1.05  # end above the least norm met by more: that point is kept instead
_DEPTH = 0.5  # local maxima down to there join the frequencies
_BENT = 1.5  # a step whose geodesic bends more than that is too long
_HALVINGS = 6  # of a step along the path; beyond, Newton's method does better


def level_of(squares: Array, mu: float) -> float:
    """Square of the level t, where ``2 mu sum s / (t^2 - s) = 1``.

    `squares` are the squared singular values s of all frequencies.
    """
    top = float(squares.max())
    if not top > 0:  # no error, or one whose square no number holds
        return _NOTHING
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
    """psi near one theta, along geodesics of the response."""

    value: float
    gradient: Array
    hessian: Array
    drift: Array  # derivative of the gradient by mu
    geometry: ResponseGeometry  # of which y are the coordinates


class Barrier:
    """psi for one set of frequencies.

    The limits are kept by logarithms of their own; a unit step changes the response by
    `size`. `missed` are frequencies of resonances between the others that rose above
    the level at the point of the last `value`.
    """

    def __init__(
        self, system: ErrorSystem, limits: Limits, omega: Array, size: float
    ) -> None:
        self.system, self.limits, self.size = system, limits, size
        self.omega, self.missed = omega, np.zeros(0)

    def mu_of_level(self, theta: Array, ratio: float) -> float:
        """mu for which the level is `ratio` times the largest singular value."""
        s = self._squares(theta)
        return float(0.5 / (s / (ratio**2 * s.max() - s)).sum())

    def _squares(self, theta: Array) -> Array:
        E = self.system.weighted_error(theta, self.omega)
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
        s = self._squares(theta)
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
        system, omega = self.system, self.omega
        geometry = ResponseGeometry(system, theta, omega, self.size, pull)
        at, L, S = geometry.at, geometry.L, geometry.S
        E = system.weight_response(omega)[0] @ (at.G - system.target_response(omega))
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
        dEC = (C.swapaxes(1, 2)[:, None] @ geometry.changes).reshape(-1, q)
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


@dataclass
class PathPoint:
    """Where the central path was left."""

    theta: Array  # its end, or the point of least norm met if that is much lower
    mu: float | None  # its last value; None for a point that is not on the path yet
    frequencies: Array  # local maxima met on the way
    n_iter: int  # Newton steps
    history: list[dict[str, float]]  # a row per value of mu: objective, mu, steps


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

    `theta` is stable: the least-squares fit, or a point met on the path. At `mu_end`
    the level is about ``mu_end * n_active`` (relative) above the minimum. The first
    `mu` is by default that of a level of twice the norm; `frequencies` are local maxima
    known already; `max_iter` counts Newton steps. A stage ends when Newton's method
    promises less than `decrement`, relative to mu: the steps that a point far from the
    path needs are longest while mu is large.
    """
    inside = theta if limits.strict(theta) else limits.inside(theta)
    if not limits.strict(inside):  # at the margin: nothing to follow
        return PathPoint(theta, mu, np.zeros(0), 0, [])
    theta = inside
    found = system.peaks(theta, _DEPTH)
    best, best_norm = theta, found.norm
    seen = np.zeros(0) if frequencies is None else frequencies
    history: list[dict[str, float]] = []
    n_iter = 0
    while n_iter < max_iter and not time_is_up():
        if system.peaks_move:
            seen = np.union1d(seen, found.frequencies)
        barrier = Barrier(system, limits, np.union1d(system.grid, seen), found.norm)
        if mu is None:
            mu = barrier.mu_of_level(theta, _FIRST_LEVEL)
        ahead = max(_SHRINK * mu, min(mu_end, mu))
        theta, steps = _stage(
            barrier, theta, mu, ahead, decrement * mu, max_iter - n_iter
        )
        n_iter += steps
        found = system.peaks(theta, _DEPTH)
        history.append({"objective": found.norm, "mu": mu, "steps": float(steps)})
        if found.norm < best_norm:
            best, best_norm = theta, found.norm
        if mu <= mu_end:
            break
        mu = ahead
    if found.norm > _WORSE * best_norm:
        theta = best
    return PathPoint(theta, mu, seen, n_iter, history)


def _stage(
    barrier: Barrier,
    theta: Array,
    mu: float,
    ahead: float,
    enough: float,
    max_iter: int,
) -> tuple[Array, int]:
    """Newton's method at one mu, and a step towards the next one.

    Returns the end and the number of steps.
    """
    radius, n_iter = 1.0, 0
    while n_iter < max_iter and not time_is_up():
        model = barrier.quadratic(theta, mu)
        n_iter += 1
        if not (np.isfinite(model.gradient).all() and np.isfinite(model.hessian).all()):
            break
        spectrum, Q = np.linalg.eigh(0.5 * (model.hessian + model.hessian.T))
        slopes = Q.T @ model.gradient
        x = trust_region_step(spectrum, slopes, radius)
        if ahead < mu and _promised(spectrum, slopes, x) < enough:
            return _predicted(barrier, theta, model, (spectrum, Q), ahead, mu), n_iter
        theta, radius, promised = _newton(
            barrier, theta, mu, model, (spectrum, Q), radius
        )
        if promised < enough:
            break
    return theta, n_iter


def _promised(spectrum: Array, slopes: Array, x: Array) -> float:
    return -float(slopes @ x + 0.5 * x @ (spectrum * x))


def _newton(
    barrier: Barrier,
    theta: Array,
    mu: float,
    model: Quadratic,
    eigen: tuple[Array, Array],
    radius: float,
) -> tuple[Array, float, float]:
    """One step of the trust region: its end, the next radius, the promised decrease.

    The decrease is zero where no step lowers psi.
    """
    spectrum, Q = eigen
    slopes = Q.T @ model.gradient
    missed = np.zeros(0)
    while radius > _NEGLIGIBLE:
        x = trust_region_step(spectrum, slopes, radius)
        promised, length = _promised(spectrum, slopes, x), float(np.linalg.norm(x))
        if promised < _NEGLIGIBLE:
            break
        trial = _along(theta, model, Q @ x)
        if trial is None:
            radius = _SHORTER * min(length, radius)
            continue
        ratio = (model.value - barrier.value(trial, mu)) / promised
        missed = np.union1d(missed, barrier.missed)
        if ratio > _TAKEN:
            if missed.size:
                barrier.omega = np.union1d(barrier.omega, missed)
            if ratio > _GOOD:
                radius = max(radius, _LONGER * length)
            elif ratio < _POOR:
                radius *= _SHORTER
            return trial, radius, promised
        radius = _FAILED * min(length, radius)
    return theta, radius, 0.0


def _predicted(
    barrier: Barrier,
    theta: Array,
    model: Quadratic,
    eigen: tuple[Array, Array],
    ahead: float,
    mu: float,
) -> Array:
    """A step along the path: to where it will be at the next mu, or part of the way."""
    spectrum, Q = eigen
    slopes = Q.T @ (model.gradient + (ahead - mu) * model.drift)
    size = np.abs(spectrum)
    d = -Q @ (slopes / np.maximum(size, _SINGULAR * size.max(initial=1e-300)))
    here = barrier.value(theta, ahead)
    for _ in range(_HALVINGS):
        trial = _along(theta, model, d)
        if trial is not None and barrier.value(trial, ahead) < here:
            return trial
        d = 0.5 * d
    return theta


def _along(theta: Array, model: Quadratic, d: Array) -> Array | None:
    """End of the geodesic that leaves along `d`; None where it bends too much."""
    a = model.geometry.acceleration(d)
    if not np.linalg.norm(a) <= _BENT * np.linalg.norm(d):
        return None
    return theta + model.geometry.T @ (d + 0.5 * a)


def trust_region_step(spectrum: Array, slopes: Array, radius: float) -> Array:
    """Minimise ``slopes x + sum(spectrum x^2) / 2`` over ``|x| <= radius``."""
    size = max(float(np.abs(spectrum).max(initial=0.0)), 1e-300)
    low = float(spectrum.min())
    if low > _POSITIVE * size:
        x = -slopes / spectrum
        if np.linalg.norm(x) <= radius:
            return x
    shift = max(0.0, -low) + _EXCESS * size
    x = -slopes / (spectrum + shift)
    short = radius**2 - float(x @ x)
    if short > 0:  # the hard case: the rest along the lowest curvature
        i = int(np.argmin(spectrum))
        x[i] += np.sqrt(short) if slopes[i] <= 0 else -np.sqrt(short)
        return x
    high = shift + float(np.linalg.norm(slopes)) / radius + size
    for _ in range(_BISECTIONS):
        middle = np.sqrt(shift * high)
        if np.linalg.norm(slopes / (spectrum + middle)) > radius:
            shift = middle
        else:
            high = middle
        if high < _CLOSE * shift:
            break
    return -slopes / (spectrum + high)
