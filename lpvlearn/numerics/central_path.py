"""The central path, from least squares to the minimum of the H-infinity norm.

For mu to infinity the minimiser of the barrier psi(theta, mu) is the least-squares fit,
for mu to zero that of the highest singular value, Eq. (16). Between them runs a path of
minimisers, which Newton's method with exact second derivatives follows. A search on the
norm itself must keep to the ridge where several peaks are equal, and crawls where it
bends; for a large mu the ridge is wide. All steps are taken along geodesics of the
response, so that the choice of parameters does not bend the path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .barrier import Barrier, Quadratic
from .leastsquares import frequency_grid
from .limits import Limits
from .matching import ErrorSystem
from .measured import MeasuredErrorSystem

Array = NDArray[np.float64]

_SHRINK = 0.3  # of mu, from one stage to the next
_FIRST_LEVEL = 2.0  # level of the first stage, relative to the largest singular value
_NEGLIGIBLE = 1e-14
_TAKEN = 1e-2  # part of the promised decrease that a step must bring
_WORSE = 1.05
_DEPTH = 0.5  # local maxima down to there join the frequencies
_BENT = 1.5  # a step whose geodesic bends more than that is too long
_HALVINGS = 6


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
        barrier = Barrier(system, limits, np.union1d(grid, seen), found.norm)
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
    while n_iter < max_iter:
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
            radius = 0.5 * min(length, radius)
            continue
        ratio = (model.value - barrier.value(trial, mu)) / promised
        missed = np.union1d(missed, barrier.missed)
        if ratio > _TAKEN:
            if missed.size:
                barrier.watch(np.union1d(barrier.omega, missed))
            if ratio > 0.7:
                radius = max(radius, 3.0 * length)
            elif ratio < 0.25:
                radius *= 0.5
            return trial, radius, promised
        radius = 0.3 * min(length, radius)
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
    d = -Q @ (slopes / np.maximum(size, 1e-12 * size.max(initial=1e-300)))
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
