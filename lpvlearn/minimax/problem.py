"""Minimax problems: peaks, their geometry, and certificates of an optimum.

The objective is ``f(y) = max_i phi_i(y)``; the ``phi_i`` are the local maxima over
frequency of the largest singular value of the error, Eq. (16).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]

_INFINITY = 1e30  # what daqp takes for no bound
_PRIMAL, _DUAL = 1e-11, 1e-12  # its tolerances: no promise below them is acted on
# Where it cycles at that: primal tolerances that end nearly all cycles, and the part of
# the decrease by which their steps may break what the program asks
_LOOSER, _BROKEN = (1e-9, 1e-7), 1e-2
_RANK = 1e-10  # relative singular value of a span: gradients are known to less
_BINDING = -1e-9  # relative value from which a constraint binds: a step's rounding
# Least curvatures of a convexified Hessian, relative to that of the Lagrangian: along
# the tangent space, across it, and of all directions once more against rounding
_TANGENT, _ACROSS, _EVERYWHERE = 1e-9, 1e-8, 1e-11
_STRAIGHT = 1e-12  # curvature of a Lagrangian that has none

# The solver wants a positive definite Hessian. A little curvature of t makes the
# multipliers add up to 1 + 1e-3 t: exact where t, the promised decrease, vanishes.
_EPIGRAPH_CURVATURE = 1e-3


def epigraph_step(
    H: Array,
    values: Array,
    G: Array,
    constraint_values: Array,
    constraint_gradients: Array,
    radius: float,
) -> tuple[Array, Array, Array] | None:
    """Minimise ``t + d^T H d / 2`` over steps below the linearised peaks.

    Subject to ``values_i + G_i d <= t``, ``constraint_values_j + gradients_j d <= 0``
    and ``|d|_inf <= radius``, for a positive definite `H`.

    Returns the step, the multipliers of the peaks (not negative, they add up to one at
    a stationary point) and those of the constraints; None where there is no solution.
    """
    # Rows that stay below another one in all of the box bind nothing
    reach = radius * np.abs(G).sum(1)
    high = values + reach >= (values - reach).max()
    full, values, G = len(values), values[high], G[high]
    q, k, c = len(H), len(values), len(constraint_values)
    P = np.zeros((q + 1, q + 1))
    P[:q, :q] = H
    P[q, q] = _EPIGRAPH_CURVATURE
    f = np.zeros(q + 1)
    f[q] = 1.0
    A = np.zeros((k + c, q + 1))
    A[:k, :q], A[:k, q] = G, -1.0
    A[k:, :q] = constraint_gradients
    span = 1.0 + np.abs(values).max() + radius * np.abs(G).sum(1).max()
    upper = np.concatenate([np.full(q, radius), [span], -values, -constraint_values])
    lower = np.concatenate([-upper[: q + 1], np.full(k + c, -_INFINITY)])
    senses = np.zeros(len(upper), dtype=np.int32)
    for tol in (_PRIMAL, *_LOOSER):
        x, _, flag, info = daqp.solve(
            P, f, A, upper, lower, senses, primal_tol=tol, dual_tol=_DUAL
        )
        if flag >= 1 and np.isfinite(x).all():
            break
    else:
        return None
    if tol > _PRIMAL and (A @ x - upper[q + 1 :]).max() > _BROKEN * -x[q]:
        return None
    multipliers = np.maximum(np.asarray(info["lam"])[q + 1 :], 0.0)
    of_peaks = np.zeros(full)
    of_peaks[high] = multipliers[:k]
    return np.asarray(x[:q]), of_peaks, multipliers[k:]


def shortest_in_hull(G: Array, normals: Array | None = None) -> tuple[float, Array]:
    """Norm of the shortest vector in the convex hull of the rows of `G`.

    Zero certifies a stationary point of a maximum of smooth functions with these
    active gradients. Solved as a non-negative least-squares problem:
    ``min |G^T x + N^T y|^2 + (1 - sum x)^2``, ``x, y >= 0``, whose solution is
    proportional to the weights.

    `normals` are gradients N of binding constraints, of which any non-negative multiple
    is added. Returns the norm and the weights of the rows, which add up to one.
    """
    scale = max(float(np.linalg.norm(G, axis=1).max()), 1e-300)
    N = np.zeros((0, G.shape[1])) if normals is None else normals
    length = np.linalg.norm(N, axis=1, keepdims=True)
    N = N / np.where(length > 0, length, 1.0)
    stacked = np.zeros((G.shape[1] + 1, len(G) + len(N)))
    stacked[:-1] = np.hstack([G.T / scale, N.T])
    stacked[-1, : len(G)] = 1.0
    rhs = np.zeros(len(stacked))
    rhs[-1] = 1.0
    solution = nnls(stacked, rhs)[0]
    weights, total = solution[: len(G)], solution[: len(G)].sum()
    if total == 0:
        weights, total = np.ones(len(G)), float(len(G))
    force = scale * (N.T @ solution[len(G) :])
    distance = float(np.linalg.norm(G.T @ weights + force)) / total
    return distance, weights / total


Flags = NDArray[np.bool_]

ACTIVE_PEAK = 1e-6  # peaks within that fraction of the highest one are active
ACTIVE_MULTIPLIER = 1e-8  # smaller multipliers do not count

# Why a search ended short of an optimum, beside the number of its iterations
NO_STEP = "the quadratic program of a step had no solution"


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
    """What the minimax solvers ask of a problem."""

    peaks: Callable[[Array], Peaks | None]  # of y; None where it is not admissible
    samples: Callable[[Array, Array], Peaks]  # the values at fixed frequencies
    values: Callable[[Array, Array], Array]  # without gradients; inf for no model
    # of the sum with non-negative weights: (y, weights, frequencies, moving)
    hessian: Callable[[Array, Array, Array, Flags], Array]
    constraints: Callable[[Array], tuple[Array, Array]]  # c(y) <= 0 and gradients
    grid: Array = field(default_factory=lambda: np.zeros(0))  # watched beside the peaks
    curve: Callable[[Array], Curve] | None = None  # of y; by default straight steps
    stop: Callable[[], bool] = lambda: False  # whether to end at the best point so far


@dataclass(frozen=True)
class MinimaxResult:
    """Best point, its peaks, and what certifies it.

    `stationarity` is the shortest vector in the convex hull of the active gradients,
    relative to the objective, without what binding constraints hold back.
    `second_order` is the smallest eigenvalue of the Hessian of the Lagrangian on the
    subspace along which all active peaks stay equal, relative to the objective:
    positive for a strict local minimum, NaN where the solver has no second-order model.
    `valley` is its eigenvector, along which a saddle can be left. `history` has a row
    per iteration: objective, predicted decrease, radius, active peaks. `cause` says
    what ended the search short of an optimum; empty where it converged or ran out of
    iterations.
    """

    y: Array
    peaks: Peaks
    stationarity: float
    second_order: float
    converged: bool
    n_iter: int
    history: list[dict[str, float]] = field(default_factory=list)
    cause: str = ""
    valley: Array | None = None


def tangent_spaces(G: Array, dc: Array) -> tuple[Array, Array]:
    """Bases of the span of active gradient differences and constraints, and its
    complement, along which all active peaks stay equal to first order."""
    rows = [G[1:] - G[0], dc]
    D = np.vstack(rows).T
    if D.size == 0:
        return np.zeros((G.shape[1], 0)), np.eye(G.shape[1])
    U, s, _ = np.linalg.svd(D, full_matrices=True)
    r = int((s > _RANK * s.max(initial=0.0)).sum())
    return U[:, :r], U[:, r:]


def convexified(L: Array, G: Array, dc: Array) -> Array:
    """Positive definite Hessian that agrees with `L` where curvature matters.

    Negative curvature is mirrored on the tangent space of the active peaks, and a
    multiple of the projector on its complement, where the peaks themselves bend the
    objective, makes the rest positive.
    """
    scale = max(float(np.abs(np.linalg.eigvalsh(L)).max()), _STRAIGHT)
    Y, Z = tangent_spaces(G, dc)
    H = L.copy()
    if Z.shape[1]:
        values, vectors = np.linalg.eigh(Z.T @ L @ Z)
        positive = np.maximum(np.abs(values), _TANGENT * scale)
        W = Z @ vectors
        H += (W * (positive - values)) @ W.T
    if Y.shape[1]:
        S = Y.T @ H @ Y
        if Z.shape[1]:
            C = Y.T @ H @ Z
            S = S - C @ np.linalg.solve(Z.T @ H @ Z, C.T)
        low = float(np.linalg.eigvalsh(0.5 * (S + S.T)).min())
        H += (max(0.0, -low) + _ACROSS * scale) * Y @ Y.T
    return 0.5 * (H + H.T) + _EVERYWHERE * scale * np.eye(len(H))


class Certificate(NamedTuple):
    """What is known of a point, see `MinimaxResult`."""

    stationarity: float
    second_order: float
    valley: Array | None = None


def certificate(
    problem: MinimaxProblem, y: Array, peaks: Peaks, negligible: float
) -> Certificate:
    """Stationarity and second-order measure at a point."""
    f = peaks.top
    if f <= negligible:
        return Certificate(0.0, np.inf)
    active = peaks.values >= f * (1.0 - ACTIVE_PEAK)
    G = peaks.gradients[active] / f
    c, dc = problem.constraints(y)
    binding = dc[c >= _BINDING]
    distance, weights = shortest_in_hull(G, binding)
    where = peaks.frequencies[active], peaks.moving[active]
    L = problem.hessian(y, weights, *where) / f
    Z = tangent_spaces(G[weights > ACTIVE_MULTIPLIER], binding)[1]
    if Z.shape[1] == 0:
        return Certificate(distance, np.inf)
    curvatures, directions = np.linalg.eigh(Z.T @ L @ Z)
    return Certificate(distance, float(curvatures[0]), Z @ directions[:, 0])
