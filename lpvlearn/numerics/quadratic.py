"""Small quadratic programs of the minimax methods."""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]

_INFINITY = 1e30
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

    Returns
    -------
    d : ndarray of shape (q,)
    multipliers : ndarray of shape (k,)
        Of the peaks; non-negative, they add up to one at a stationary point.
    constraint_multipliers : ndarray
        None instead of the triple where the program has no solution.
    """
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
    x, _, flag, info = daqp.solve(
        P,
        f,
        A,
        upper,
        lower,
        np.zeros(q + 1 + k + c, dtype=np.int32),
        primal_tol=1e-11,
        dual_tol=1e-12,
    )
    if flag < 1 or not np.isfinite(x).all():
        return None
    multipliers = np.maximum(np.asarray(info["lam"])[q + 1 :], 0.0)
    return np.asarray(x[:q]), multipliers[:k], multipliers[k:]


def shortest_in_hull(G: Array, normals: Array | None = None) -> tuple[float, Array]:
    """Norm of the shortest vector in the convex hull of the rows of `G`.

    Zero certifies a stationary point of a maximum of smooth functions with these
    active gradients. Solved as a non-negative least-squares problem:
    ``min |G^T x + N^T y|^2 + (1 - sum x)^2``, ``x, y >= 0``, whose solution is
    proportional to the weights.

    Parameters
    ----------
    G : ndarray of shape (k, q)
    normals : ndarray of shape (c, q), default=None
        Gradients N of binding constraints, of which any non-negative multiple is added.

    Returns
    -------
    distance : float
    weights : ndarray of shape (k,)
        Non-negative, adding up to one.
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
