"""Parameters from nothing: the similarity start of the restructuring, Eq. (3), (34).

A similarity T takes the black box to ``(T A T^-1, T B, C T^-1)``. Rows of A and C, and
entries of B, that hold no parameter give equations linear in T. They are solved
exactly, ``T = T_0 + sum_l z_l N_l``; what remains of the distance to the affine
structure is minimised over z by a Levenberg-Marquardt method, from many starts at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import least_squares

from ..minimax.problem import MinimaxResult, Peaks
from ..systems.least_squares import Residuals, levenberg_marquardt
from .deadline import time_is_up
from .error_system import Structure, Target

Array = NDArray[Any]

_EXACT = 4  # starts that reach the structure exactly; no more are needed

# relative singular value of the linear equations that noise of a black box may leave
_NULL_TOLERANCE = 1e-6

# A start ends when its squared distance falls by less than _SLOW that often in a row:
# far from the structure progress is slow and then fast again.
_SLOW, _PATIENCE = 1e-4, 4
_ROUNDING = 1e-24  # squared distance, relative to the structure: it is reached exactly


@dataclass(frozen=True)
class AffineProblem:
    """An affine structure beside a black box of the same order, time-scaled."""

    A: Array
    B: Array
    C: Array
    D: Array
    offset: Array  # (n + p, n + m)
    basis: Array  # (q, n + p, n + m)


def scaled_problem(
    A: Array, B: Array, C: Array, D: Array, offset: Array, basis: Array, rate: float
) -> AffineProblem:
    """The problem with time in units of ``1 / rate`` and states rescaled to fit.

    The state scaling ``x = diag(s) x'`` brings the fixed entries of the structure
    close to one, e.g. the kinematic ones of ``v' = w``: ``s_w = rate s_v``. The
    parameters do not change, only the equations that hold them.
    """
    n = len(A)
    fixed = (offset != 0) & ~(basis != 0).any(0)
    rows, values = [], []
    for i, j in np.argwhere(fixed):
        if i >= n and j >= n:
            continue
        row = np.zeros(n)
        if i < n:
            row[i] -= 1.0
        if j < n:
            row[j] += 1.0
        if row.any():
            # log |entry'| = log |entry| - log s_i + log s_j - (log rate, rows of A, B)
            rows.append(row)
            values.append((np.log(rate) if i < n else 0.0) - np.log(abs(offset[i, j])))
    s = np.ones(n)
    if rows:
        s = np.exp(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0])
    p, m = D.shape
    left = np.concatenate([1.0 / (s * rate), np.ones(p)])
    right = np.concatenate([s, np.ones(m)])
    return AffineProblem(
        A / rate,
        B / rate,
        C,
        D,
        left[:, None] * offset * right,
        left[:, None] * basis * right,
    )


def linear_equations(problem: AffineProblem) -> tuple[Array, Array]:
    """Equations ``M vec(T) = b`` (row-major) from what holds no parameter."""
    n, m, p = len(problem.A), problem.B.shape[1], problem.C.shape[0]
    free = (problem.basis != 0).any(0)
    S, eye = problem.offset, np.eye(n)
    M: list[Array] = [np.zeros((0, n * n))]
    b: list[Array] = [np.zeros(0)]
    for i in range(n):
        row = eye[i : i + 1]
        if not free[i, :n].any():  # e_i T A - S_i T = 0
            M.append(np.kron(row, problem.A.T) - np.kron(S[i : i + 1, :n], eye))
            b.append(np.zeros(n))
        for j in range(m):
            if not free[i, n + j]:  # e_i T b_j = S_ij
                M.append(np.kron(row, problem.B[:, j : j + 1].T))
                b.append(S[i : i + 1, n + j])
    for k in range(p):
        if not free[n + k, :n].any():  # S_k T = c_k
            M.append(np.kron(S[n + k : n + k + 1, :n], eye))
            b.append(problem.C[k])
    return np.vstack(M), np.concatenate(b)


def similarity_starts(
    problem: AffineProblem,
    n_starts: int,
    rng: np.random.Generator,
    *,
    max_iter: int = 40,
) -> tuple[Array, Array]:
    """Parameter vectors from random similarities, all starts in one batch.

    Returns them (n_found, n_params) and the distances to the structure that remain,
    ascending.
    """
    n = len(problem.A)
    M, b = linear_equations(problem)
    T0 = np.linalg.lstsq(M, b, rcond=None)[0] if len(b) else np.zeros(n * n)
    N = null_space(M, rcond=_NULL_TOLERANCE) if len(b) else np.eye(n * n)
    size = np.linalg.norm(T0) / n if T0.any() else 1.0
    if N.shape[1] == 0:
        Z = np.zeros((1, 0))
    else:
        spread = size * 10 ** rng.uniform(-1, 1, size=(n_starts, 1))
        Z = rng.normal(size=(n_starts, N.shape[1])) * spread
    flat = problem.basis.reshape(len(problem.basis), -1)
    directions = np.linalg.qr(flat.T)[0]
    Z, cost = levenberg_marquardt(
        _distances(problem, T0, N, directions),
        Z,
        max_iter=max_iter,
        tol=_SLOW,
        patience=_PATIENCE,
        exact=_ROUNDING * (1.0 + np.abs(problem.offset).sum()) ** 2,
        enough=_EXACT,
        stop=time_is_up,
    )
    Z, cost = Z[np.isfinite(cost)], cost[np.isfinite(cost)]  # regular ones
    if len(Z) == 0:
        return np.zeros((0, len(flat))), cost
    d = _transformed(problem, (T0 + Z @ N.T).reshape(-1, n, n))[0]
    theta = nearest_parameters(problem, d)
    good = np.isfinite(theta).all(1)
    order = np.argsort(cost[good], kind="stable")
    return theta[good][order], np.sqrt(cost[good][order])


def nearest_parameters(problem: AffineProblem, d: Array) -> Array:
    """Parameters of the structure nearest to ``offset + d``, for each row of `d`."""
    flat = problem.basis.reshape(len(problem.basis), -1)
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    size = np.where(size > 0, size, 1.0)
    return np.asarray((np.linalg.lstsq((flat / size).T, d.T, rcond=None)[0] / size).T)


def _transformed(problem: AffineProblem, T: Array) -> tuple[Array, Array, Array]:
    """Stacked ``[T A T^-1, T B; C T^-1, D] - offset``, the matrices, and T^-1."""
    n = len(problem.A)
    inverse = np.linalg.inv(T)
    S = np.empty((len(T), *problem.offset.shape))
    S[:, :n, :n] = T @ problem.A @ inverse
    S[:, :n, n:] = T @ problem.B
    S[:, n:, :n] = problem.C @ inverse
    S[:, n:, n:] = problem.D
    return (S - problem.offset).reshape(len(T), -1), S, inverse


def _distances(
    problem: AffineProblem, T0: Array, N: Array, directions: Array
) -> Residuals:
    """Distance to the affine set and its Jacobian in z.

    With ``Delta = N_l T^-1``: ``dA = Delta A - A Delta``, ``dB = Delta B``,
    ``dC = -C Delta`` for the transformed matrices.
    """
    n = len(problem.A)

    def rest(d: Array) -> Array:
        return d - (d @ directions) @ directions.T

    def residuals(z: Array, _: Any) -> tuple[Array, Callable[..., Array]]:
        T = (T0 + z @ N.T).reshape(-1, n, n)
        r = np.full((len(T), problem.offset.size), np.nan)
        good = np.asarray(np.isfinite(T).all((1, 2)), dtype=bool)
        good[good] = np.abs(np.linalg.det(T[good])) > 0
        d, S, inverse = _transformed(
            problem, np.where(good[:, None, None], T, np.eye(n))
        )
        r[good] = rest(d[good])

        def jacobian(kept: Array) -> Array:
            Delta = N.T.reshape(1, -1, n, n) @ inverse[kept, None]
            J = np.zeros((len(kept), N.shape[1], *problem.offset.shape))
            J[:, :, :n] = Delta @ S[kept, None, :n]
            J[..., :n] -= S[kept, None, :, :n] @ Delta
            return rest(J.reshape(*J.shape[:2], problem.offset.size)).swapaxes(1, 2)

        return r, jacobian

    return residuals


def bilinear_fit(
    problem: AffineProblem,
    theta: Array,
    max_iter: int,
    bounds: tuple[Array, Array],
) -> tuple[Array, float, int, bool]:
    """Minimise Eq. (7) over parameters and similarity from given parameters.

    ``|A T - T A(theta)|_F^2 + |B - T B(theta)|_F^2 + |C T - C(theta)|_F^2``, where T
    takes the structured state to that of the black box. The cost is quadratic in T for
    given parameters, which starts T, and quadratic in the parameters for given T.

    Returns the parameters, the square root of the cost, iterations, and whether these
    converged.
    """
    n = len(problem.A)
    eye = np.eye(n)

    def blocks(theta: Array) -> tuple[Array, Array, Array]:
        S = problem.offset + np.tensordot(theta, problem.basis, axes=1)
        return S[:n, :n], S[:n, n:], S[n:, :n]

    def residuals(x: Array) -> Array:
        T = x[: n * n].reshape(n, n)
        A, B, C = blocks(x[n * n :])
        parts = (problem.A @ T - T @ A, problem.B - T @ B, problem.C @ T - C)
        return np.concatenate([part.ravel() for part in parts])

    def jacobian(x: Array) -> Array:
        T = x[: n * n].reshape(n, n)
        A, B, _ = blocks(x[n * n :])
        in_T = np.vstack(
            [
                np.kron(problem.A, eye) - np.kron(eye, A.T),
                -np.kron(eye, B.T),
                np.kron(problem.C, eye),
            ]
        )
        q = len(problem.basis)
        in_theta = np.hstack(
            [
                -(T @ problem.basis[:, :n, :n]).reshape(q, -1),
                -(T @ problem.basis[:, :n, n:]).reshape(q, -1),
                -problem.basis[:, n:, :n].reshape(q, -1),
            ]
        ).T
        return np.hstack([in_T, in_theta])

    x = np.concatenate([np.zeros(n * n), theta])
    J = jacobian(x)[:, : n * n]
    rhs = residuals(x)
    x[: n * n] = -np.linalg.lstsq(J, rhs, rcond=None)[0]
    free = np.full(n * n, np.inf)
    limits = (np.append(-free, bounds[0]), np.append(free, bounds[1]))
    x = np.clip(x, *limits)
    found = least_squares(
        residuals, x, jacobian, bounds=limits, x_scale="jac", max_nfev=max_iter
    )
    return found.x[n * n :], np.sqrt(2.0 * found.cost), found.nfev, found.status > 0


def minimise_bilinear(
    structure: Structure, box: Target | None, theta: Array, max_iter: int
) -> tuple[Array, MinimaxResult]:
    """Minimise Eq. (7) from given parameters, time and states scaled.

    A ValueError where the structure is not affine or of another order than the box.
    """
    offset = getattr(structure, "offset", None)
    if offset is None or box is None or len(box.A) != structure.order:
        raise ValueError(
            "`norm='similarity'` needs an affine structure of the order of the black "
            f"box, as Eq. (7) does. Got {structure} and order "
            f"{'unknown' if box is None else len(box.A)}."
        )
    poles = np.abs(np.linalg.eigvals(box.A))
    rate = 1.0 if box.dt is not None else max(float(poles.max(initial=0.0)), 1e-300)
    basis = structure.jacobian(theta)
    problem = scaled_problem(box.A, box.B, box.C, box.D, offset, basis, rate)
    theta, cost, n_iter, done = bilinear_fit(
        problem, theta, max(max_iter, 1), (structure.lower, structure.upper)
    )
    peaks = Peaks(
        np.array([cost]), np.zeros(0), np.zeros((1, len(theta))), np.zeros(1) > 0
    )
    return theta, MinimaxResult(theta, peaks, np.nan, np.nan, done, n_iter)
