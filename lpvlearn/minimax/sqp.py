"""Trust-region sequential quadratic programming for a maximum over frequency.

Minimises ``f(y) = max_omega sigma(y, omega)``, the largest singular value of the error,
Eq. (16). The local model holds all local maxima near the norm, with the exact Hessian
of the Lagrangian, and beside them the singular value at fixed frequencies: where two
maxima merge, or a new one rises, only these are smooth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .problem import (
    ACTIVE_MULTIPLIER,
    NO_STEP,
    Curve,
    MinimaxProblem,
    MinimaxResult,
    Peaks,
    certificate,
    convexified,
    epigraph_step,
)

Array = NDArray[np.float64]

_MAX_EXTRA = 40  # frequencies beside the grid: those at which a step failed
_PATIENCE = 25  # iterations without progress that end the search
_NOTHING = 1e-8  # relative decrease that is no progress over so many iterations
_SHORTEST = 1e-14  # radius: a step that short changes no digit

# The trust region: a step is taken if it brings any of the promised decrease, ...
_TAKEN = 1e-4
# ... is followed by a longer one if the model was good and the radius held it back,
_GOOD, _HELD, _LONGER, _LONGEST = 0.75, 0.8, 2.5, 10.0
# by a shorter one if the model was poor, and repeated shorter if it failed.
_POOR, _SHORTER, _FAILED = 0.25, 0.5, 0.35
# Where the quadratic program has no solution: a smaller radius, and a Hessian that is
# more definite by part of its mean curvature.
_NO_PROGRAM, _STIFFER = 0.25, 0.1
_ROUNDING = 1e-12  # a promised relative decrease that rounding may hide
_CORRECTIONS = 3  # second-order corrections: each removes most of the bend that is left
_WORTHWHILE = 0.1  # part of the decrease that a correction must add for a further one

_FIRST_CURVATURE = 1e-2  # of the first program, by gradient over radius: little
_SHOULDER = 1e-9  # rounding of a singular value beside the objective
_SAME = 1e-6  # relative distance of frequencies that are the same
_MOVED = 1e-2  # the same of a local maximum before and after a step
_SURPRISE = 0.2  # part of the decrease that a peak between the frequencies took away


def minimax_sqp(
    problem: MinimaxProblem,
    y0: Array,
    *,
    max_iter: int = 200,
    tol: float = 1e-10,
    radius: float = 0.5,
    negligible: float = 0.0,
) -> MinimaxResult:
    """Minimise the highest peak from an admissible point.

    In coordinates where a unit step changes the response by about the objective; the
    first trust-region `radius` is in the maximum norm. Ends where the linear model
    predicts a relative decrease below `tol`, or at an objective not above `negligible`:
    rounding noise. A ValueError where `y0` is not admissible.
    """
    own = problem.peaks(y0)
    if own is None:
        raise ValueError("the starting point of the minimax is not admissible.")
    y, extra = y0.copy(), np.zeros(0)
    local: _Local | None = None
    history: list[dict[str, float]] = []
    converged, cause, n_iter = False, "", 0
    while n_iter < max_iter and not (converged or problem.stop()):
        f = own.top
        if f <= negligible:
            converged = True
            break
        n_iter += 1
        if local is None:
            omega = np.concatenate([problem.grid, extra])
            local = _local_model(problem, y, own, omega, radius)
        step = local.step(radius)
        cause = NO_STEP if step is None else ""
        if step is None:
            radius, local = _NO_PROGRAM * radius, local.stiffer()
            if radius < _SHORTEST:
                break
            continue
        d, multipliers = step
        linear, predicted = local.decrease(d)
        if _stalled(history, f):
            converged = True
            break
        history.append(
            {
                "objective": f,
                "predicted": linear,
                "radius": radius,
                "active": float((multipliers > ACTIVE_MULTIPLIER).sum()),
            }
        )
        if linear <= tol or radius < _SHORTEST:
            converged = True
            break
        d, high, trial = _tried(problem, y, local, d, radius)
        ratio = -1.0
        if trial is not None and predicted > 0:
            ratio = (f - trial.top) / f / predicted
            if trial.top > high + _SURPRISE * (f - high):
                new = trial.frequencies[trial.values > high]
                new = new[~_among(new, omega)]
                extra = np.concatenate([extra, new])[-_MAX_EXTRA:]
                local = None if new.size else local
        if trial is not None and ratio > _TAKEN and trial.top < f:
            y, own, local = y + d, trial, None
            if ratio > _GOOD and np.abs(d).max() > _HELD * radius:
                radius = min(_LONGER * radius, _LONGEST)
            elif ratio < _POOR:
                radius *= _SHORTER
        elif predicted < _ROUNDING:
            converged = True
        else:
            radius = _FAILED * min(radius, float(np.abs(d).max()))
    slope, bend, valley = certificate(problem, y, own, negligible)
    return MinimaxResult(y, own, slope, bend, converged, n_iter, history, cause, valley)


def _stalled(history: list[dict[str, float]], f: float) -> bool:
    """Whether the last iterations lowered the objective by next to nothing."""
    if len(history) < _PATIENCE:
        return False
    return history[-_PATIENCE]["objective"] - f <= _NOTHING * f


@dataclass(frozen=True)
class _Local:
    """The quadratic program at one point, relative to the objective."""

    entries: Peaks  # local maxima, and singular values at fixed frequencies
    H: Array  # convexified Hessian of the Lagrangian
    c: Array  # constraints c + dc d <= 0
    dc: Array
    curve: Curve | None = None  # that of the steps

    def stiffer(self) -> _Local:
        shift = _STIFFER * max(float(np.trace(self.H)) / len(self.H), 1e-8)
        H = self.H + shift * np.eye(len(self.H))
        return replace(self, H=H)

    def step(
        self, radius: float, ends: Array | None = None, d: Array | None = None
    ) -> tuple[Array, Array] | None:
        """Step and multipliers of the entries, or None.

        With the values `ends` that the entries have after the step `d`, corrected for
        their curvature.
        """
        f, slopes = self.entries.top, self.entries.gradients
        values = self.entries.values
        if ends is not None and d is not None:
            values = ends - slopes @ d
        solution = epigraph_step(
            self.H, values / f - 1.0, slopes / f, self.c, self.dc, radius
        )
        return None if solution is None else (solution[0], solution[1])

    def end(self, d: Array) -> Array:
        """Where the step along `d` ends."""
        return d if self.curve is None else self.curve.step(d)

    def decrease(self, d: Array) -> tuple[float, float]:
        """Relative decrease that the linear and the quadratic model promise."""
        f = self.entries.top
        ends = self.entries.values + self.entries.gradients @ d
        linear = 1.0 - float(ends.max()) / f
        return linear, linear - 0.5 * float(d @ self.H @ d)


class _Trial(NamedTuple):
    end: Array  # of the step, relative to where it begins
    high: float  # highest value of the entries there
    peaks: Peaks | None  # there; None where an entry is not below the objective


def _tried(
    problem: MinimaxProblem, y: Array, local: _Local, d: Array, radius: float
) -> _Trial:
    """The step's end, bent by the curvature of the entries, and what is there.

    First by the entries at their own frequencies. Where local maxima then stand higher
    beside these, they are followed, and the step is corrected for what that adds.
    """
    f = local.entries.top
    d, end, ends = _corrected(problem, y, local, d, radius)
    found = _followed(problem, y, local, end, ends)
    for _ in range(_CORRECTIONS):
        top = float(ends.max())
        if found.peaks is None or found.high <= top + _SURPRISE * (f - top):
            break
        step = local.step(radius, _risen(local.entries, ends, found.peaks), d)
        if step is None:
            break
        d, end = step[0], local.end(step[0])
        ends = problem.values(y + end, local.entries.frequencies)
        new = _followed(problem, y, local, end, ends)
        if new.peaks is None or not new.peaks.top < found.peaks.top:
            break
        found = new
    return found


def _followed(
    problem: MinimaxProblem, y: Array, local: _Local, end: Array, ends: Array
) -> _Trial:
    high, entries = float(ends.max()), local.entries
    peaks = problem.peaks(y + end) if high < entries.top else None
    if peaks is not None:
        high = float(_risen(entries, ends, peaks).max())
    return _Trial(end, high, peaks)


def _risen(entries: Peaks, ends: Array, peaks: Peaks) -> Array:
    """Values `ends` of the entries, those that move at the maxima they have become."""
    moving = entries.moving
    if not moving.any():
        return ends
    same = _near(entries.frequencies[moving], peaks.frequencies, _MOVED)
    with np.errstate(invalid="ignore"):  # inf - inf
        apart = np.abs(entries.frequencies[moving][:, None] - peaks.frequencies)
    nearest = np.where(np.isnan(apart), 0.0, apart).argmin(0)  # of two close ones
    same &= nearest == np.arange(moving.sum())[:, None]
    risen = ends.copy()
    tops = np.where(same, peaks.values, 0.0).max(1, initial=0.0)
    risen[moving] = np.maximum(ends[moving], tops)
    return risen


def _corrected(
    problem: MinimaxProblem, y: Array, local: _Local, d: Array, radius: float
) -> tuple[Array, Array, Array]:
    """The step, its end, and the entries there, bent by the curvature of these."""
    omega, f = local.entries.frequencies, local.entries.top
    end = local.end(d)
    ends = problem.values(y + end, omega)
    for _ in range(_CORRECTIONS):
        if not np.isfinite(ends).all():
            break
        step = local.step(radius, ends, d)
        if step is None:
            break
        new_end = local.end(step[0])
        new = problem.values(y + new_end, omega)
        gain = float(ends.max() - new.max())
        if not gain > 0:
            break
        d, end, ends = step[0], new_end, new
        if gain < _WORTHWHILE * (f - float(ends.max())):
            break
    return d, end, ends


def _local_model(
    problem: MinimaxProblem, y: Array, own: Peaks, omega: Array, radius: float
) -> _Local:
    """Entries, constraints, and the Hessian with the multipliers of a first step."""
    c, dc = problem.constraints(y)
    cuts = problem.samples(y, omega[~_among(omega, own.frequencies)])
    # Above the objective is only the shoulder of a constant peak that has been set
    # aside: there the error shall not grow, or a new peak would rise on the shoulder.
    below = cuts.values <= own.top * (1.0 + _SHOULDER)
    caps = cuts.values[~below]
    c = np.concatenate([np.minimum(c, 0.0), np.zeros(len(caps))])
    dc = np.vstack([dc, cuts.gradients[~below] / caps[:, None]])
    entries = Peaks(
        np.concatenate([own.values, cuts.values[below]]),
        np.concatenate([own.frequencies, cuts.frequencies[below]]),
        np.vstack([own.gradients, cuts.gradients[below]]),
        np.concatenate([own.moving, cuts.moving[below]]),
    )
    f, q = own.top, len(y)
    G = entries.gradients / f
    H = (
        _FIRST_CURVATURE
        * np.linalg.norm(G, axis=1).max()
        * np.eye(q)
        / max(radius, 1e-6)
    )
    curve = None if problem.curve is None else problem.curve(y)
    first = _Local(entries, H, c, dc, curve)
    solution = epigraph_step(H, entries.values / f - 1.0, G, c, dc, radius)
    for _ in range(2):  # the multipliers of the second-order model refine themselves
        if solution is None:
            break
        _, multipliers, mu = solution
        active = multipliers > ACTIVE_MULTIPLIER
        if not active.any():
            return first
        weights = multipliers[active] / multipliers[active].sum()
        where = entries.frequencies[active], entries.moving[active]
        L = problem.hessian(y, weights, *where) / f
        if curve is not None:
            L = L + curve.curvature(weights @ G[active])
        H = convexified(L, G[active], dc[mu > ACTIVE_MULTIPLIER])
        solution = epigraph_step(H, entries.values / f - 1.0, G, c, dc, radius)
        if solution is not None and ((solution[1] > ACTIVE_MULTIPLIER) == active).all():
            break
    return replace(first, H=H)


def _among(omega: Array, known: Array) -> NDArray[np.bool_]:
    """Which frequencies are, nearly, among the known ones."""
    return np.asarray(_near(omega, known, _SAME).any(1))


def _near(omega: Array, known: Array, part: float) -> NDArray[np.bool_]:
    """Which known frequencies are the same but for a part of them, (k, n_known)."""
    with np.errstate(invalid="ignore"):  # inf - inf
        near = np.abs(omega[:, None] - known) <= part * np.abs(known)
    return (omega[:, None] == known) | near & np.isfinite(known)
