"""Trust-region sequential quadratic programming for a maximum of peak functions.

Minimises ``f(y) = max_i phi_i(y)``, where the ``phi_i`` are the local maxima over
frequency of the largest singular value of the error, Eq. (16). All peaks near the
norm enter the local model, with the exact Hessian of the Lagrangian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .certificates import (
    ACTIVE_MULTIPLIER,
    MinimaxProblem,
    MinimaxResult,
    Peaks,
    certificate,
    convexified,
)
from .quadratic import epigraph_step

Array = NDArray[np.float64]

_MAX_ENTRIES = 60
_PATIENCE = 25  # iterations without progress that end the search
_NOTHING = 1e-8


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

    Parameters
    ----------
    problem : MinimaxProblem
        In coordinates where a unit step changes the response by about the objective.
    y0 : ndarray of shape (q,)
    tol : float
        Stop when the linear model predicts a relative decrease below it.
    radius : float
        First trust-region radius (maximum norm).
    negligible : float
        An objective at or below it is rounding noise: nothing is left to minimise.

    Raises
    ------
    ValueError
        If `y0` is not admissible.
    """
    own = problem.peaks(y0)
    if own is None:
        raise ValueError("the starting point of the minimax is not admissible.")
    y, peaks = y0.copy(), own
    model: _Model | None = None
    history: list[dict[str, float]] = []
    converged, n_iter = False, 0
    shoulders = _Shoulders(np.zeros(0), np.zeros(0))
    while n_iter < max_iter and not converged:
        if own.top <= negligible:
            converged = True
            break
        n_iter += 1
        f = own.top
        c, dc = shoulders.constraints(problem, y)
        if model is None:
            model = _model(problem, y, peaks, c, dc, radius)
        step = model.step(peaks, c, dc, radius)
        if step is None:
            radius *= 0.25
            model = model.stiffer()
            converged = radius < 1e-14
            continue
        d, multipliers = step
        slack = peaks.values / f - 1.0
        linear = -float(np.max(slack + peaks.gradients @ d / f))
        predicted = linear - 0.5 * float(d @ model.H @ d)
        if stalled(history, f):  # peaks that merge and split: no smooth functions
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
        if linear <= tol or radius < 1e-14:
            converged = True
            break
        trial = problem.peaks(y + d)
        ratio = (f - trial.top) / f / predicted if trial and predicted > 0 else -1.0
        if trial is not None and ratio < 0.3:
            corrected = _second_order_correction(
                problem, y, peaks, trial, d, model, c, dc, radius
            )
            if corrected is not None and corrected[1].top < trial.top:
                d, trial = corrected
                ratio = (f - trial.top) / f / predicted
        if trial is not None and ratio > 1e-4 and trial.top < f:
            y, own, peaks, model = y + d, trial, trial, None
            if ratio > 0.75 and np.abs(d).max() > 0.8 * radius:
                radius = min(2.5 * radius, 10.0)
            elif ratio < 0.25:
                radius *= 0.5
        elif predicted < 1e-12:
            converged = True
        else:
            radius = 0.35 * min(radius, float(np.abs(d).max()))
            if trial is not None:
                high = trial.frequencies[trial.values >= 0.98 * trial.top]
                enriched, shoulders = _with_cuts(
                    problem, y, peaks, shoulders, own.top, high
                )
                if enriched is not None:
                    peaks, model = enriched, None
    stationarity, second_order = certificate(
        problem, y, own, shoulders.constraints(problem, y), negligible
    )
    return MinimaxResult(y, own, stationarity, second_order, converged, n_iter, history)


def stalled(history: list[dict[str, float]], f: float) -> bool:
    """Whether the last iterations lowered the objective by next to nothing."""
    if len(history) < _PATIENCE:
        return False
    return history[-_PATIENCE]["objective"] - f <= _NOTHING * f


@dataclass(frozen=True)
class _Model:
    """Convexified Hessian of the Lagrangian, relative to the objective."""

    H: Array

    def stiffer(self) -> _Model:
        shift = 0.1 * max(float(np.trace(self.H)) / len(self.H), 1e-8)
        return _Model(self.H + shift * np.eye(len(self.H)))

    def step(
        self,
        peaks: Peaks,
        c: Array,
        dc: Array,
        radius: float,
        slack: Array | None = None,
    ) -> tuple[Array, Array] | None:
        """Solution of the quadratic program, or None; `slack` replaces the values."""
        f = peaks.top
        values = peaks.values / f - 1.0 if slack is None else slack
        solution = epigraph_step(
            self.H, values, peaks.gradients / f, np.minimum(c, 0.0), dc, radius
        )
        return None if solution is None else (solution[0], solution[1])


def _model(
    problem: MinimaxProblem, y: Array, peaks: Peaks, c: Array, dc: Array, radius: float
) -> _Model:
    """Hessian of the Lagrangian with the multipliers of a first-order step."""
    f, q = peaks.top, len(y)
    G = peaks.gradients / f
    first_order = 1e-2 * np.linalg.norm(G, axis=1).max() * np.eye(q) / max(radius, 1e-6)
    solution = epigraph_step(
        first_order, peaks.values / f - 1.0, G, np.minimum(c, 0.0), dc, radius
    )
    if solution is None:
        return _Model(first_order)
    H = None
    for _ in range(2):  # the multipliers of the second-order model refine themselves
        _, multipliers, mu = solution
        active = multipliers > ACTIVE_MULTIPLIER
        if not active.any():
            return _Model(first_order)
        weights = multipliers[active] / multipliers[active].sum()
        hessians = problem.hessians(y, peaks.frequencies[active], peaks.moving[active])
        L = np.tensordot(weights, hessians, axes=1) / f
        H = convexified(L, G[active], dc[mu > ACTIVE_MULTIPLIER])
        solution = epigraph_step(
            H, peaks.values / f - 1.0, G, np.minimum(c, 0.0), dc, radius
        )
        if solution is None or ((solution[1] > ACTIVE_MULTIPLIER) == active).all():
            break
    assert H is not None
    return _Model(H)


def _second_order_correction(
    problem: MinimaxProblem,
    y: Array,
    peaks: Peaks,
    trial: Peaks,
    d: Array,
    model: _Model,
    c: Array,
    dc: Array,
    radius: float,
) -> tuple[Array, Peaks] | None:
    """Solve again with the peaks' values at the trial point, matched by frequency."""
    f = peaks.top
    slack = peaks.values / f - 1.0
    for i, (omega, g) in enumerate(
        zip(peaks.frequencies, peaks.gradients, strict=True)
    ):
        j = nearest_peak(trial.frequencies, omega)
        if j is not None:
            slack[i] = (trial.values[j] - g @ d) / f - 1.0
    step = model.step(peaks, c, dc, radius, slack)
    if step is None:
        return None
    corrected = problem.peaks(y + step[0])
    return None if corrected is None else (step[0], corrected)


@dataclass(frozen=True)
class _Shoulders:
    """Frequencies beside a constant peak, where the error shall not grow.

    There the singular value is above the objective, because a peak that no parameter
    changes has been set aside. A step that would raise a new peak on its shoulder is
    forbidden by a constraint at that frequency, ``sigma(y) <= cap``.
    """

    frequencies: Array
    caps: Array

    def constraints(self, problem: MinimaxProblem, y: Array) -> tuple[Array, Array]:
        """Constraints of the problem and of the shoulders, and their gradients."""
        c, dc = problem.constraints(y)
        if self.caps.size == 0:
            return c, dc
        found = problem.samples(y, self.frequencies)
        return (
            np.concatenate([c, found.values / self.caps - 1.0]),
            np.vstack([dc, found.gradients / self.caps[:, None]]),
        )


def _with_cuts(
    problem: MinimaxProblem,
    y: Array,
    peaks: Peaks,
    shoulders: _Shoulders,
    f: float,
    frequencies: Array,
) -> tuple[Peaks | None, _Shoulders]:
    """Add the singular value at fixed frequencies, those at which a trial step failed.

    A peak that is about to split, or that a resonance carries quickly along the
    frequency axis, is a bad local model of itself; its value at the frequency where
    it hurt is a smooth function. None where there is nothing to add.
    """
    known = np.concatenate([peaks.frequencies, shoulders.frequencies])
    new = [w for w in frequencies if nearest_peak(known, w, 1 + 1e-6) is None]
    if not new or len(known) > _MAX_ENTRIES:
        return None, shoulders
    cuts = problem.samples(y, np.array(new))
    below = cuts.values <= f * (1.0 + 1e-9)
    if not below.all():
        shoulders = _Shoulders(
            np.concatenate([shoulders.frequencies, cuts.frequencies[~below]]),
            np.concatenate([shoulders.caps, cuts.values[~below]]),
        )
    return (
        Peaks(
            np.concatenate([peaks.values, cuts.values[below]]),
            np.concatenate([peaks.frequencies, cuts.frequencies[below]]),
            np.vstack([peaks.gradients, cuts.gradients[below]]),
            np.concatenate([peaks.moving, cuts.moving[below]]),
        ),
        shoulders,
    )


def nearest_peak(frequencies: Array, omega: float, ratio: float = 1.25) -> int | None:
    """Index of the frequency nearest to `omega` within `ratio`, else None."""
    same = np.flatnonzero(frequencies == omega)
    if same.size:
        return int(same[0])
    if omega == 0 or not np.isfinite(omega):
        return None
    usable = (frequencies > 0) & np.isfinite(frequencies)
    if not usable.any():
        return None
    distance = np.full(len(frequencies), np.inf)
    distance[usable] = np.abs(np.log(frequencies[usable] / omega))
    j = int(np.argmin(distance))
    return j if distance[j] <= np.log(ratio) else None
