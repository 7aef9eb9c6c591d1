"""Minimax problems: peaks, their geometry, and certificates of an optimum.

The objective is ``f(y) = max_i phi_i(y)``; the ``phi_i`` are the local maxima over
frequency of the largest singular value of the error, Eq. (16).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .quadratic import shortest_in_hull

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

ACTIVE_PEAK = 1e-6  # peaks within that fraction of the highest one are active
ACTIVE_MULTIPLIER = 1e-8  # smaller multipliers do not count


@dataclass(frozen=True)
class Peaks:
    """Values, frequencies (rad/s) and gradients of the peaks at one point.

    Where `moving` is False, the entry is the singular value at a fixed frequency, a
    lower bound of the objective everywhere, and no local maximum.
    """

    values: Array
    frequencies: Array
    gradients: Array
    moving: Flags

    @property
    def top(self) -> float:
        """The objective: the highest peak."""
        return float(self.values.max())


class Curve(Protocol):
    """Curves through one point along which the functions of a problem bend least."""

    def step(self, d: Array) -> Array:
        """End, relative to the point, of the curve that leaves along `d`."""

    def curvature(self, gradient: Array) -> Array:
        """What the curves add to a Hessian of that gradient, shape (q, q)."""


@dataclass(frozen=True)
class MinimaxProblem:
    """What the minimax solvers ask of a problem.

    Attributes
    ----------
    peaks : callable
        ``y -> Peaks``, or None where `y` is not admissible (an unstable model).
    samples : callable
        ``(y, frequencies) -> Peaks``: the singular value at fixed frequencies.
    values : callable
        The same without gradients; infinite where there is no model.
    hessians : callable
        ``(y, frequencies, moving) -> (k, q, q)``, second derivatives of the values.
    constraints : callable
        ``y -> (c, dc)``: smooth constraints ``c(y) <= 0`` and their gradients.
    grid : ndarray
        Frequencies to watch beside the peaks.
    curve : callable, default=None
        ``y -> Curve``; by default steps are straight.
    """

    peaks: Callable[[Array], Peaks | None]
    samples: Callable[[Array, Array], Peaks]
    values: Callable[[Array, Array], Array]
    hessians: Callable[[Array, Array, Flags], Array]
    constraints: Callable[[Array], tuple[Array, Array]]
    grid: Array = field(default_factory=lambda: np.zeros(0))
    curve: Callable[[Array], Curve] | None = None


@dataclass(frozen=True)
class MinimaxResult:
    """Best point, its peaks, and what certifies it.

    Attributes
    ----------
    y : ndarray of shape (q,)
    peaks : Peaks
    stationarity : float
        Shortest vector in the convex hull of the active gradients, relative to the
        objective; what binding constraints hold back is left out.
    second_order : float
        Smallest eigenvalue of the Hessian of the Lagrangian on the subspace along
        which all active peaks stay equal, relative to the objective; positive for a
        strict local minimum, NaN where the solver has no second-order model.
    converged : bool
    n_iter : int
    history : list of dict
        One row per iteration: objective, predicted decrease, radius, active peaks.
    """

    y: Array
    peaks: Peaks
    stationarity: float
    second_order: float
    converged: bool
    n_iter: int
    history: list[dict[str, float]] = field(default_factory=list)


def tangent_spaces(G: Array, dc: Array) -> tuple[Array, Array]:
    """Bases of the span of active gradient differences and constraints, and its
    complement, along which all active peaks stay equal to first order."""
    rows = [G[1:] - G[0], dc]
    D = np.vstack(rows).T
    if D.size == 0:
        return np.zeros((G.shape[1], 0)), np.eye(G.shape[1])
    U, s, _ = np.linalg.svd(D, full_matrices=True)
    r = int((s > 1e-10 * s.max(initial=0.0)).sum())
    return U[:, :r], U[:, r:]


def convexified(L: Array, G: Array, dc: Array) -> Array:
    """Positive definite Hessian that agrees with `L` where curvature matters.

    Negative curvature is mirrored on the tangent space of the active peaks, and a
    multiple of the projector on its complement, where the peaks themselves bend the
    objective, makes the rest positive.
    """
    scale = max(float(np.abs(np.linalg.eigvalsh(L)).max()), 1e-12)
    Y, Z = tangent_spaces(G, dc)
    H = L.copy()
    if Z.shape[1]:
        values, vectors = np.linalg.eigh(Z.T @ L @ Z)
        positive = np.maximum(np.abs(values), 1e-9 * scale)
        W = Z @ vectors
        H += (W * (positive - values)) @ W.T
    if Y.shape[1]:
        S = Y.T @ H @ Y
        if Z.shape[1]:
            C = Y.T @ H @ Z
            S = S - C @ np.linalg.solve(Z.T @ H @ Z, C.T)
        low = float(np.linalg.eigvalsh(0.5 * (S + S.T)).min())
        H += (max(0.0, -low) + 1e-8 * scale) * Y @ Y.T
    return 0.5 * (H + H.T) + 1e-11 * scale * np.eye(len(H))


def certificate(
    problem: MinimaxProblem,
    y: Array,
    peaks: Peaks,
    constraints: tuple[Array, Array],
    negligible: float,
) -> tuple[float, float]:
    """Stationarity and second-order measure at a point, see `MinimaxResult`."""
    f = peaks.top
    if f <= negligible:
        return 0.0, np.inf
    active = peaks.values >= f * (1.0 - ACTIVE_PEAK)
    G = peaks.gradients[active] / f
    c, dc = constraints
    binding = dc[c >= -1e-9]
    distance, weights = shortest_in_hull(G, binding)
    hessians = problem.hessians(y, peaks.frequencies[active], peaks.moving[active])
    L = np.tensordot(weights, hessians, axes=1) / f
    Z = tangent_spaces(G[weights > ACTIVE_MULTIPLIER], binding)[1]
    if Z.shape[1] == 0:
        return distance, np.inf
    return distance, float(np.linalg.eigvalsh(Z.T @ L @ Z).min())
