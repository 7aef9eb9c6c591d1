"""Proximity control: the paper's proximal bundle method, Sections 2.5-2.6.

Around the best point y the objective is replaced by a polyhedral model, the highest of
cutting planes, Eq. (18)-(19), relative to the objective itself,

    f(y + d) / f(y) - 1  ~  max_i alpha_i + g_i^T d,

and a trial step minimises the model plus a proximity term ``tau |d|^2 / 2``, which
keeps it where the model holds. A *serious* step brings a good part of what the model
promised and is taken; after a *null* step the model is refined by the cutting planes of
the trial point, Eq. (20), for the singular values instead of their squares: with the
singular vectors of a peak, Eq. (21), its gradient is the ``g``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .problem import (
    ACTIVE_MULTIPLIER,
    NO_STEP,
    MinimaxProblem,
    MinimaxResult,
    Peaks,
    certificate,
    epigraph_step,
)

Array = NDArray[np.float64]

_MAX_CUTS = 60  # some times the peaks of an optimum; the rest only costs time
_ROOM = 10  # cuts for which room is made at once
_SERIOUS = 0.1  # a step is taken when it brings that part of the promised decrease
_GOOD = 0.7  # the model was good: the next step may be longer

# Cuts of a function that is not convex may pass above it. Those of a trial point are
# pushed below the objective by that multiple of the proximity term, ...
_DOWNSHIFT = 1e-4
# ... and those that come along to a new point by more: they were already old.
_OLD_DOWNSHIFT = 0.05
_KEPT = 1e-10  # cuts with a smaller multiplier did not shape the step, and are dropped

# Factors of tau: where the model holds, where its new cuts do not explain the failure,
# and where it says nothing of it (a step that is not admissible, or none)
_LOOSER, _TIGHTER, _TIGHTEST = 0.5, 2.0, 4.0
_UNEXPLAINED = 0.5  # part of the promise that the new cuts leave standing
_STIFFEST = 1e14  # of tau: a step that short changes no digit
_FIRST_STEP = 0.1  # of the radius, along the steepest cut
_REACH = 1e3  # box around a step, in radii: tau bounds it, the box only its rounding


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
    start = problem.peaks(y0)
    if start is None:
        raise ValueError("the starting point of the bundle is not admissible.")
    y, peaks, model = y0.copy(), start, _Model.of(start)
    steepest = float(np.linalg.norm(model.gradients, axis=1).max(initial=0.0))
    tau = steepest / max(_FIRST_STEP * radius, 1e-300)
    history: list[dict[str, float]] = []
    converged, cause, n_iter = False, "", 0
    while n_iter < max_iter and not (converged or problem.stop()):
        if peaks.top <= negligible:
            converged = True
            break
        n_iter += 1
        constraints = problem.constraints(y)
        solution = model.step(tau, *constraints, _REACH * radius)
        while solution is None and tau <= _STIFFEST:
            tau *= _TIGHTEST
            solution = model.step(tau, *constraints, _REACH * radius)
        if solution is None:
            cause = NO_STEP
            break
        d, multipliers = solution
        promised = -model.at(d)
        history.append(
            {
                "objective": peaks.top,
                "predicted": promised,
                "radius": float(np.abs(d).max()),
                "active": float((multipliers > ACTIVE_MULTIPLIER).sum()),
            }
        )
        if promised <= tol and model.is_own:
            converged = True
            break
        trial = problem.peaks(y + d) if promised > tol else None
        if promised <= tol:
            model = model.own()  # only cuts of other points forbid progress
            tau *= _TIGHTEST
        elif trial is None:
            tau *= _TIGHTEST
        elif trial.top <= negligible:
            y, peaks = y + d, trial
        elif (gain := (1.0 - trial.top / peaks.top) / promised) >= _SERIOUS:
            model = model.moved(d, peaks.top, trial, multipliers > _KEPT, tau)
            y, peaks = y + d, trial
            tau *= _LOOSER if gain > _GOOD else 1.0
        else:
            cuts = model.cuts(d, peaks.top, trial, tau)
            still = -max(cuts.at(d), -promised)
            tau *= _TIGHTER if still >= _UNEXPLAINED * promised else 1.0
            model = model.refined(cuts, d)
        converged = tau > _STIFFEST  # no step, however short, lowers the objective
    slope, bend, valley = certificate(problem, y, peaks, negligible)
    found = y, peaks, slope, bend
    return MinimaxResult(*found, converged, n_iter, history, cause, valley)


@dataclass(frozen=True)
class _Model:
    """Cutting planes ``alpha + g^T d`` of ``f(y + d) / f(y) - 1``, Eq. (19)."""

    offsets: Array
    gradients: Array
    n_own: int  # the first ones are those of the peaks of y itself

    @classmethod
    def of(cls, peaks: Peaks) -> _Model:
        """The cutting planes of the current point alone."""
        f = peaks.top
        return cls(peaks.values / f - 1.0, peaks.gradients / f, len(peaks.values))

    @property
    def is_own(self) -> bool:
        return len(self.offsets) == self.n_own

    def own(self) -> _Model:
        """Without the cuts of other points."""
        return _Model(
            self.offsets[: self.n_own], self.gradients[: self.n_own], self.n_own
        )

    def at(self, d: Array) -> float:
        """Value of the model."""
        return float(np.max(self.offsets + self.gradients @ d))

    def step(
        self, tau: float, c: Array, dc: Array, reach: float
    ) -> tuple[Array, Array] | None:
        """Step that minimises the model plus ``tau |d|^2 / 2``, and its multipliers."""
        found = epigraph_step(
            tau * np.eye(self.gradients.shape[1]),
            self.offsets,
            self.gradients,
            np.minimum(c, 0.0),
            dc,
            reach,
        )
        return None if found is None else found[:2]

    def joined(self, offsets: Array, gradients: Array) -> _Model:
        return _Model(
            np.concatenate([self.offsets, offsets]),
            np.vstack([self.gradients, gradients]),
            self.n_own,
        )

    def moved(
        self, d: Array, f: float, peaks: Peaks, kept: NDArray[np.bool_], tau: float
    ) -> _Model:
        """The model around ``y + d``, with those cuts that shaped the step."""
        fresh, ratio = _Model.of(peaks), f / peaks.top
        offsets = (self.offsets + self.gradients @ d)[kept] * ratio + (ratio - 1.0)
        offsets = np.minimum(offsets, -_OLD_DOWNSHIFT * tau * float(d @ d))
        room = max(_MAX_CUTS - fresh.n_own, 0)
        return fresh.joined(offsets[:room], (self.gradients[kept] * ratio)[:room])

    @staticmethod
    def cuts(d: Array, f: float, trial: Peaks, tau: float) -> _Model:
        """Cutting planes of the trial point ``y + d``, Eq. (20), not above f at y."""
        gradients = trial.gradients / f
        offsets = trial.values / f - 1.0 - gradients @ d
        low = -_DOWNSHIFT * tau * float(d @ d)
        return _Model(np.where(offsets > 0, low, offsets), gradients, 0)

    def refined(self, cuts: _Model, d: Array) -> _Model:
        """With more cuts; of too many, those that are highest at `d` are kept."""
        full = self.joined(cuts.offsets, cuts.gradients)
        if len(full.offsets) <= _MAX_CUTS:
            return full
        worth = full.offsets + full.gradients @ d
        worth[: self.n_own] = np.inf
        best = np.argsort(-worth, kind="stable")[: _MAX_CUTS - _ROOM]
        best = np.sort(best)
        return _Model(full.offsets[best], full.gradients[best], self.n_own)
