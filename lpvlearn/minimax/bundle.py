"""Proximity control: the paper's proximal bundle method, Sections 2.5-2.6.

The objective is replaced by a polyhedral model, the maximum of cutting planes
``alpha + g^T (y - x)`` (Eq. (19)-(20), for sigma instead of its square), plus a
proximity term ``tau |d|^2 / 2`` that keeps the step where the model holds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .problem import MinimaxProblem, MinimaxResult, Peaks, certificate, epigraph_step

Array = NDArray[np.float64]

_MAX_CUTS = 60

_SERIOUS = 0.1  # a step is taken when it brings that part of the promised decrease

_GOOD = 0.7

_DOWNSHIFT = 1e-4


def proximal_bundle(
    problem: MinimaxProblem,
    y0: Array,
    *,
    max_iter: int = 600,
    tol: float = 1e-10,
    radius: float = 0.5,
    negligible: float = 0.0,
) -> MinimaxResult:
    """Minimise the highest peak by proximity control; parameters of `minimax_sqp`.

    A first-order method: many cheap iterations, against few of `minimax_sqp`.
    """
    peaks = problem.peaks(y0)
    if peaks is None:
        raise ValueError("the starting point of the bundle is not admissible.")
    y = y0.copy()
    q = len(y)
    f = peaks.top
    offsets, gradients = _own_cuts(peaks, f)
    n_fresh = len(offsets)
    tau = float(np.linalg.norm(gradients, axis=1).max()) / max(0.1 * radius, 1e-300)
    history: list[dict[str, float]] = []
    converged, n_iter = False, 0
    while n_iter < max_iter and not converged:
        if f <= negligible:
            converged = True
            break
        n_iter += 1
        c, dc = problem.constraints(y)
        solution = epigraph_step(
            tau * np.eye(q), offsets, gradients, np.minimum(c, 0.0), dc, 1e3 * radius
        )
        if solution is None:
            tau *= 4.0
            converged = tau > 1e14
            continue
        d, multipliers, _ = solution
        predicted = -float(np.max(offsets + gradients @ d))
        history.append(
            {
                "objective": f,
                "predicted": predicted,
                "radius": float(np.abs(d).max()),
                "active": float((multipliers > 1e-8).sum()),
            }
        )
        if predicted <= tol:
            if len(offsets) == n_fresh or tau > 1e14:
                converged = True
                break
            # only the cuts of other points forbid progress: begin afresh
            offsets, gradients = offsets[:n_fresh], gradients[:n_fresh]
            tau *= 4.0
            continue
        trial = problem.peaks(y + d)
        ratio = -1.0 if trial is None else (f - trial.top) / f / predicted
        if trial is not None and trial.top <= negligible:
            y, peaks, f = y + d, trial, trial.top
            continue
        if trial is not None and ratio >= _SERIOUS:
            fall = (f - trial.top) / trial.top
            keep = multipliers > 1e-10
            old_offsets = (offsets[keep] + gradients[keep] @ d) * (f / trial.top) + fall
            old_gradients = gradients[keep] * (f / trial.top)
            y, peaks, f = y + d, trial, trial.top
            # cuts of a non-convex function are pushed below it at the new point
            old_offsets = np.minimum(old_offsets, -0.05 * tau * float(d @ d))
            offsets, gradients = _own_cuts(peaks, f)
            n_fresh = len(offsets)
            room = _MAX_CUTS - n_fresh
            offsets = np.concatenate([offsets, old_offsets[: max(room, 0)]])
            gradients = np.vstack([gradients, old_gradients[: max(room, 0)]])
            tau *= 0.5 if ratio > _GOOD else 1.0
            continue
        if trial is None:
            tau *= 4.0
            converged = tau > 1e14
            continue
        new_gradients = trial.gradients / f
        new_offsets = trial.values / f - 1.0 - new_gradients @ d
        shift = np.maximum(new_offsets, 0.0) + np.where(
            new_offsets > 0, _DOWNSHIFT * tau * float(d @ d), 0.0
        )
        new_offsets = new_offsets - shift
        promised = -max(float(np.max(new_offsets + new_gradients @ d)), -predicted)
        if promised >= 0.5 * predicted:  # the new cuts do not explain the failure
            tau *= 2.0
            converged = tau > 1e14
        offsets = np.concatenate([offsets, new_offsets])
        gradients = np.vstack([gradients, new_gradients])
        if len(offsets) > _MAX_CUTS:
            worth = offsets + gradients @ d
            worth[:n_fresh] = np.inf
            best = np.sort(np.argsort(-worth, kind="stable")[: _MAX_CUTS - 10])
            offsets, gradients = offsets[best], gradients[best]
    stationarity, second_order = certificate(
        problem, y, peaks, problem.constraints(y), negligible
    )
    return MinimaxResult(
        y, peaks, stationarity, second_order, converged, n_iter, history
    )


def _own_cuts(peaks: Peaks, f: float) -> tuple[Array, Array]:
    """Cutting planes of the current point, relative to the objective `f`."""
    return peaks.values / f - 1.0, peaks.gradients / f
