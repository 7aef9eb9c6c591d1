"""The central path from the least-squares fit to the least H-infinity norm.

With a level t above the largest singular value of the error E at every frequency,

    psi(theta, mu) = min_t  log t - mu sum_k log det(I - E_k^H E_k / t^2)

is smooth: least squares for a large mu, the highest singular value for a small one.
Its minimisers for a falling mu are the central path, which Newton's method follows in
a trust region, along geodesics of the response, with multipliers of its own as the
primal-dual methods of semidefinite programming have them (Conn, Gould, Orban and Toint,
2000, for nonconvex problems).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .coordinates import ResponseGeometry, View
from .deadline import time_is_up
from .error_system import ErrorSystem
from .limits import Limits

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# weight of the logarithms of the limits, relative to mu: they keep steps off the limits
# and hardly move the minimum
_BARRIER = 1e-2
_SHRINK, _FAST = 0.3, 0.1  # of mu, to the next stage; after one that took one step
_FIRST_LEVEL = 2.0  # level of the first stage, relative to the largest singular value
# Of a trust-region step: relative curvature that still counts as positive, the excess
# of the shift over the lowest eigenvalue, and digits of the shift, of which few matter
_POSITIVE, _EXCESS, _CLOSE = 1e-13, 1e-14, 1.001
_BISECTIONS = 60  # halve the logarithm of any bracket of doubles down to `_CLOSE`
_NEGLIGIBLE = 1e-14  # decrease of psi, or radius, that is rounding noise
_TAKEN = 1e-2  # part of the promised decrease that a step must bring
_HELD = 0.999  # part of the radius from which a step is held back by it

# of the trust region: longer after steps as good as promised, shorter after poor ones,
# and shorter still after those that failed
_GOOD, _LONGER, _POOR, _SHORTER, _FAILED = 0.7, 3.0, 0.25, 0.5, 0.3
_NOTHING = 1e-300  # square of the level of no error
_WORSE = 1.05  # end above the least norm met by more: that point is kept instead
_DEPTH = 0.5  # local maxima down to there join the frequencies
_BENT = 1.5  # a step whose geodesic bends more than that is too long
_APART = 1e3  # factor by which multipliers may differ from those of psi
_REACH = 0.99  # part of a distance to the level that a step may take
_CORRECTIONS = 3  # of a step, for the bend of the errors' squares


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
    """psi near one theta, along geodesics of the response, and the multipliers there.

    Newton's method for ``Z_k (tau I - X_k) = mu I`` moves the multipliers Z of the
    squares ``X = E^H E`` together with theta. On the path they are ``mu M``, ``M = (tau
    I - X)^-1``. Off it M changes as soon as a step is as long as the distances to the
    level tau, which shrink with mu; Z hardly does.
    """

    mu: float
    value: float
    gradient: Array
    hessian: Array  # that of psi where Z is mu M
    geometry: ResponseGeometry  # of which y are the coordinates
    E: Complex
    C: Complex  # with M = C C^H
    M: Complex
    Z: Complex
    both: Complex  # (Z M + M Z) / 2
    by_level: Array  # derivative of the gradient by the square tau of the level
    level_curvature: float  # second derivative of psi by tau

    def corrected(self, bend: Complex) -> Array:
        """The gradient where the squares are off the linear ones by `bend`."""
        W = _hermitian(self.Z @ bend @ self.M)
        gradient = self.gradient + 2.0 * self.geometry.pulled(self.E @ W)
        level = self._level_bend(bend) / self.level_curvature
        return gradient + level * self.by_level

    def bend(self, d: Array, E: Complex) -> Complex:
        """Change of the squares that is not linear in a step `d` to the errors `E`."""
        return _square(E) - _square(self.E) - self._linear(d)

    def reach(self, d: Array, bend: Complex) -> float:
        """Part of the step `d` that leaves some of every distance to the level."""
        rise = _adjoint(self.C) @ self._rise(d, bend) @ self.C
        if not np.isfinite(rise).all():
            return 1.0
        lowest = float(np.linalg.eigvalsh(rise).min())
        return _REACH / max(-lowest, _REACH)

    def multipliers(self, d: Array, bend: Complex) -> Complex:
        """Those after the step `d`."""
        return self.mu * self.M - _hermitian(self.Z @ self._rise(d, bend) @ self.M)

    def _level_bend(self, bend: Complex) -> float:
        return float(np.vdot(self.both, bend).real)

    def _linear(self, d: Array) -> Complex:
        return 2.0 * _hermitian(_adjoint(self.E) @ self.geometry.change(d))

    def _rise(self, d: Array, bend: Complex) -> Complex:
        """Change of ``tau I - X`` along the step `d`."""
        level = (self._level_bend(bend) - self.by_level @ d) / self.level_curvature
        return np.asarray(level * np.eye(self.M.shape[1]) - self._linear(d) - bend)


def _first_terms(E: Complex, C: Complex, F: Complex) -> Array:
    """``2 tr(Z dE^H dE) + tr(Z dX M dX)`` as quadratic forms of dE in its `real_form`.

    With ``dX = E^H dE + dE^H E``, ``M = C C^H`` and ``Z = F F^H``: the squares of the
    norms of ``dE F`` and ``C^H dX F``. Shape (k, 2 n_outputs n_inputs, the same).
    """
    k, p, m = E.shape
    entries = np.eye(p * m).reshape(-1, p, m)
    dE = np.concatenate([entries, 1j * entries])
    dEF = dE @ F[:, None]
    Eh = _adjoint(E)
    dX = (_adjoint(C) @ Eh)[:, None] @ dEF
    dX = dX + _adjoint((_adjoint(F) @ Eh)[:, None] @ dE @ C[:, None])
    parts = (np.sqrt(2.0) * dEF).reshape(k, len(dE), -1), dX.reshape(k, len(dE), -1)
    return np.asarray(sum(np.real(X @ _adjoint(X)) for X in parts))


def _adjoint(A: Complex) -> Complex:
    return np.asarray(A.conj().swapaxes(-1, -2))


def _square(E: Complex) -> Complex:
    return np.asarray(_adjoint(E) @ E)


def _hermitian(A: Complex) -> Complex:
    return np.asarray(0.5 * (A + _adjoint(A)))


def _trace(A: Complex) -> float:
    return float(np.real(np.einsum("kii->", A)))


class Barrier:
    """psi for one set of frequencies.

    The limits are kept by logarithms of their own; a unit step changes the response by
    `size`. Of the point of the last `value`: `error` at the frequencies, and `missed`,
    resonances between these that rose above the level. `carried` are frequencies and
    their multipliers (those of psi if None).
    """

    def __init__(
        self,
        system: ErrorSystem,
        limits: Limits,
        omega: Array,
        size: float,
        carried: tuple[Array, Complex] | None = None,
    ) -> None:
        self.system, self.limits, self.size = system, limits, size
        self.omega, self.missed = omega, np.zeros(0)
        self.error: Complex = np.zeros((0, 0, 0), complex)
        self.carried = carried

    def mu_of_level(self, theta: Array, ratio: float) -> float:
        """mu for which the level is `ratio` times the largest singular value."""
        s = _squares(self.system.weighted_error(theta, self.omega))
        return float(0.5 / (s / (ratio**2 * s.max() - s)).sum())

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
        self.error = system.weighted_error(theta, self.omega)
        if not np.isfinite(self.error).all():
            return np.inf
        s = _squares(self.error)
        level = level_of(s, mu)
        turns = system.resonances(poles)
        if turns.size:
            self.missed = turns[system.values(theta, turns) ** 2 >= level]
            if self.missed.size:
                return np.inf
        return _psi(s, level, mu) - _BARRIER * mu * float(np.log(-c).sum())

    def quadratic(self, theta: Array, mu: float) -> Quadratic:
        """psi, its gradient, and its Hessian by the multipliers.

        With ``M = (t^2 I - E^H E)^-1`` and ``dX = E^H dE + dE^H E`` the terms of a
        frequency have the derivatives ``2 mu Re tr(M E^H dE)`` and ``2 tr(Z dE^H dE) +
        tr(Z dX M dX) + 2 Re tr(Z E^H d2E)``, Z being ``mu M`` for the derivatives of
        psi. The level is eliminated. Along geodesics only the normal part of the
        covector ``2 E Z`` meets ``d2E``.
        """
        c, dc, _ = self.limits.rows(theta)
        pull, weight = dc / -c[:, None], _BARRIER * mu
        system, omega = self.system, self.omega
        geometry = ResponseGeometry(system, theta, omega, self.size, pull)
        at, T = geometry.at, geometry.T
        E = system.weight_response(omega)[0] @ (at.G - system.target_response(omega))
        k, p, m = E.shape
        _, sigma, Vh = np.linalg.svd(E)
        s = sigma**2
        tau = level_of(s.ravel(), mu)
        gaps = np.full((k, m), tau)
        gaps[:, : s.shape[1]] -= s
        C = np.asarray(_adjoint(Vh) / np.sqrt(gaps)[:, None], complex)
        F = self._factor(C, gaps, mu)
        M: Complex = C @ _adjoint(C)
        Z: Complex = F @ _adjoint(F)
        both = _hermitian(Z @ M)
        bounds = weight * T.T @ pull.sum(0)
        gradient = 2.0 * mu * geometry.pulled(E @ M) + bounds
        by_level = -2.0 * geometry.pulled(E @ both)
        level_curvature = _trace(both) - mu * _trace(M) / tau
        J = geometry.changes
        flat = J.reshape(-1, len(theta))
        hessian = flat.T @ (_first_terms(E, C, F) @ J).reshape(flat.shape)
        hessian = T.T @ (hessian + weight * (pull.T @ pull)) @ T
        hessian = hessian - np.outer(by_level, by_level) / level_curvature
        seen = 2.0 * geometry.pulled(E @ Z) + bounds
        normal = 2.0 * at.R @ (Z @ _adjoint(E)) @ geometry.L - geometry.tangential(seen)
        hessian = hessian + geometry.second_derivatives(normal)
        value = _psi(s.ravel(), tau, mu) - weight * float(np.log(-c).sum())
        local = value, gradient, hessian, geometry
        return Quadratic(mu, *local, E, C, M, Z, both, by_level, level_curvature)

    def _factor(self, C: Complex, gaps: Array, mu: float) -> Complex:
        """F with ``Z = F F^H``: the multipliers carried, within reach of ``mu M``.

        ``M = C C^H``, with `gaps` between the squares and the level. New frequencies
        share those of the nearest one: mostly it is the same maximum, which has moved.
        The sum of traces is that of ``mu M``, which the level asks for.
        """
        if self.carried is None or not np.isfinite(self.carried[1]).all():
            return np.asarray(np.sqrt(mu) * C)
        omega, Z = self.carried
        with np.errstate(invalid="ignore"):  # inf - inf is the nearest of all
            nearest = np.abs(self.omega[:, None] - omega).argmin(1)
        sharing = np.bincount(nearest)[nearest]
        inverse = gaps[:, :, None] * _adjoint(C)
        Z = Z[nearest] / (mu * sharing[:, None, None])
        w, U = np.linalg.eigh(inverse @ Z @ _adjoint(inverse))
        F = (C @ U) * np.sqrt(np.clip(w, 1.0 / _APART, _APART))[:, None]
        wanted = mu * np.sum(np.abs(C) ** 2)
        return np.asarray(F * np.sqrt(wanted / np.sum(np.abs(F) ** 2)))


def _squares(E: Complex) -> Array:
    return np.asarray(np.linalg.svd(E, compute_uv=False) ** 2).ravel()


def _psi(squares: Array, tau: float, mu: float) -> float:
    return float(0.5 * np.log(tau) - mu * np.log1p(-squares / tau).sum())


@dataclass(frozen=True)
class PathPoint:
    """Where the central path begins, or was left."""

    view: View  # its end, or the point of least norm met if that is much lower
    mu: float | None = None  # its last value; None for a point not on the path yet
    frequencies: Array = field(default_factory=lambda: np.zeros(0))  # local maxima met
    n_iter: int = 0  # Newton steps of the last stretch
    history: list[dict[str, float]] = field(default_factory=list)  # a row per mu of it

    @property
    def norm(self) -> float:
        """The norm of the error there."""
        return self.view.system.peaks(self.view.theta).norm


def central_path(
    start: PathPoint, *, mu_end: float, max_iter: int, decrement: float = 0.1
) -> PathPoint:
    """Follow the path from `start` to `mu_end`.

    It starts at a stable point: the least-squares fit, or a point met on the path. At
    `mu_end` the level is about ``mu_end * n_active`` (relative) above the minimum. The
    first mu is by default that of a level of twice the norm; `max_iter` counts Newton
    steps. A stage ends when the next one may bring less than `decrement`, relative to
    mu: the steps that a point far from the path needs are longest while mu is large.
    """
    view = start.view
    system, limits, theta = view.system, view.limits, view.theta
    inside = theta if limits.strict(theta) else limits.inside(theta)
    if not limits.strict(inside):  # at the margin: nothing to follow
        return PathPoint(view, start.mu)
    theta, mu, seen = inside, start.mu, start.frequencies
    found = system.peaks(theta, _DEPTH)
    best, best_norm = theta, found.norm
    history: list[dict[str, float]] = []
    n_iter, carried = 0, None
    while n_iter < max_iter and not time_is_up():
        if system.peaks_move:
            seen = np.union1d(seen, found.frequencies)
        omega = np.union1d(system.grid, seen)
        barrier = Barrier(system, limits, omega, found.norm, carried)
        if mu is None:
            mu = barrier.mu_of_level(theta, _FIRST_LEVEL)
        theta, steps = _stage(barrier, theta, mu, decrement * mu, max_iter - n_iter)
        n_iter, carried = n_iter + steps, barrier.carried
        found = system.peaks(theta, _DEPTH)
        history.append({"objective": found.norm, "mu": mu, "steps": float(steps)})
        if found.norm < best_norm:
            best, best_norm = theta, found.norm
        if mu <= mu_end:
            break
        mu = max((_FAST if steps == 1 else _SHRINK) * mu, mu_end)
    if found.norm > _WORSE * best_norm:
        theta = best
    return PathPoint(view.at(theta), mu, seen, n_iter, history)


def _stage(
    barrier: Barrier, theta: Array, mu: float, enough: float, max_iter: int
) -> tuple[Array, int]:
    """Newton's method at one mu: its end, and the number of steps."""
    radius, n_iter = 1.0, 0
    while n_iter < max_iter and not time_is_up():
        model = barrier.quadratic(theta, mu)
        n_iter += 1
        if not (np.isfinite(model.gradient).all() and np.isfinite(model.hessian).all()):
            break
        theta, radius, left = _newton(barrier, theta, model, radius)
        if left < enough:
            break
    return theta, n_iter


def _promised(spectrum: Array, slopes: Array, x: Array) -> float:
    return -float(slopes @ x + 0.5 * x @ (spectrum * x))


def _newton(
    barrier: Barrier, theta: Array, model: Quadratic, radius: float
) -> tuple[Array, float, float]:
    """One step of the trust region: its end, the next radius, and what it leaves.

    What is left is the decrease of psi that the next step may bring: what the model was
    off by, or, where the radius held the step back, as much as was promised of it; zero
    where no step lowers psi.
    """
    eigen = spectrum, Q = np.linalg.eigh(0.5 * (model.hessian + model.hessian.T))
    slopes = Q.T @ model.gradient
    missed = np.zeros(0)
    while radius > _NEGLIGIBLE:
        x = trust_region_step(spectrum, slopes, radius)
        promised, length = _promised(spectrum, slopes, x), float(np.linalg.norm(x))
        if promised < _NEGLIGIBLE:
            break
        trial = _tried(barrier, theta, model, eigen, x, radius)
        if trial is None:
            radius = _SHORTER * min(length, radius)
            continue
        ratio = (model.value - trial.value) / promised
        missed = np.union1d(missed, barrier.missed)
        if ratio > _TAKEN:
            barrier.carried = barrier.omega, model.multipliers(trial.d, trial.bend)
            if missed.size:
                barrier.omega = np.union1d(barrier.omega, missed)
            held = length > _HELD * radius
            if ratio > _GOOD:
                radius = max(radius, _LONGER * length)
            elif ratio < _POOR:
                radius *= _SHORTER
            left = promised if held else abs(1.0 - ratio) * promised
            return trial.theta, radius, left
        radius = _FAILED * min(length, radius)
    return theta, radius, 0.0


class _Trial(NamedTuple):
    theta: Array
    value: float  # of psi
    d: Array  # the step
    bend: Complex  # of the squares, as far as it was allowed for


def _tried(
    barrier: Barrier,
    theta: Array,
    model: Quadratic,
    eigen: tuple[Array, Array],
    x: Array,
    radius: float,
) -> _Trial | None:
    """The end of a step, corrected for the bend of the squares; None if bent too much.

    Distances to the level are far shorter than the step, and what bends the squares
    along it would be most of them.
    """
    spectrum, Q = eigen
    promised = _promised(spectrum, Q.T @ model.gradient, x)
    best, bend = None, np.zeros_like(model.M)
    for _ in range(_CORRECTIONS + 1):
        d = Q @ x
        d = model.reach(d, bend) * d
        end = _along(theta, model, d)
        if end is None:
            break
        value = barrier.value(end, model.mu)
        if best is not None and not value < best.value:
            break
        best = _Trial(end, value, d, bend)
        if not np.isfinite(value) or model.value - value > _GOOD * promised:
            break
        bend = model.bend(d, barrier.error)
        x = trust_region_step(spectrum, Q.T @ model.corrected(bend), radius)
    return best


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
