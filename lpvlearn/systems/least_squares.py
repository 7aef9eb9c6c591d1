"""Least squares: linear with scaled columns, and Levenberg-Marquardt for the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import lapack

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

# Directions of the normalised regressors below this are left out (minimum norm): what
# remains of sixteen digits after the squaring of a condition number in a Gram matrix.
RCOND = 1e-11

_LARGEST_BLOCK = 64  # columns that LAPACK's QR works on at a time, at most

_SCALING_PASSES = 16  # over rows and columns: each divides a size, in decades, by four

# Marquardt's damping, relative to the squared lengths of the Jacobian's columns
_FIRST_DAMPING = 1e-3  # nearly Gauss-Newton: starts that need more soon have it
_LEAST_DAMPING = 1e-12  # below, it is rounding noise beside the squared columns
_LARGEST_DAMPING = 1e12  # a step that short changes no digit
_LESS, _MORE = 0.1, 4.0  # after a step that came as promised, or one that failed
_AS_PROMISED = 0.75  # of the decrease of the linear model
_AHEAD = 0.1  # part of a step at which its bend is looked at
_BENT = 0.75  # bend, relative to the step, of a step that is too long
_NOISE = 1e-14  # a promised relative decrease below it cannot be seen in sixteen digits


def scaled_lstsq(M: Array, rhs: Array, rcond: float = RCOND) -> tuple[Array, int]:
    """Least squares with columns scaled to one, minimum norm where rank deficient.

    `rhs` may have one column per run; a direction whose relative singular value is
    below `rcond` counts as undetermined. Also returns the rank.
    """
    scale = column_scale(M)
    solution, rank = rank_lstsq(M / scale, rhs, rcond)
    return (solution.T / scale).T, rank


def rank_lstsq(M: Array, rhs: Array, rcond: float) -> tuple[Array, int]:
    """As `scaled_lstsq`, columns as they are.

    `scipy.linalg.lstsq` with LAPACK's driver by complete orthogonal factors, but for
    25 us that it takes to call.
    """
    n_rows, n = M.shape
    if M.size == 0:
        return np.zeros((n, *rhs.shape[1:])), 0
    columns = rhs.reshape(n_rows, -1)
    if columns.shape[1] > n and n_rows > 2 * n:  # LAPACK would turn every one of them
        Q, R = np.linalg.qr(M)
        solution, rank = rank_lstsq(R, Q.T @ columns, rcond)
        return solution.reshape(n, *rhs.shape[1:]), rank
    if n_rows < n:  # LAPACK returns the solution there
        columns = np.concatenate([columns, np.zeros((n - n_rows, columns.shape[1]))])
    n_work = 3 * n + _LARGEST_BLOCK * (n + 1 + columns.shape[1])
    _, solution, _, rank, _ = lapack.dgelsy(
        M, columns, np.zeros(n, np.int32), rcond, n_work
    )
    return solution[:n].reshape(n, *rhs.shape[1:]), int(rank)


def thin_svd(M: Array) -> tuple[Array, Array, Array]:
    """``M = U diag(s) V^T``, as `numpy.linalg.svd` without full matrices.

    Of one matrix or of a stack. By QR iterations where divide and conquer does not
    converge, as it does not for some matrices of which columns follow from others.
    """
    try:
        U, s, Vt = np.linalg.svd(M, full_matrices=False)
    except np.linalg.LinAlgError:
        if M.ndim > 2:
            parts = zip(*map(thin_svd, M), strict=True)
            U, s, Vt = (np.array(part) for part in parts)
        else:
            U, s, Vt = linalg.svd(M, full_matrices=False, lapack_driver="gesvd")
    return U, s, Vt


def column_scale(M: Array) -> Array:
    """Norm of every column of matrices; 1 for a column of zeros."""
    scale = np.sqrt(np.einsum("...ij,...ij->...j", M, M))
    scale[scale == 0.0] = 1.0
    return scale


def diagonal_scale(matrix: Array) -> Array:
    """Square roots of the diagonal of an information or a covariance; 1 for zeros.

    Which rounding may leave negative.
    """
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    scale[scale == 0.0] = 1.0
    return scale


def row_and_column_scales(terms: Array) -> tuple[Array, Array]:
    """Sizes of rows and columns that bring what varies near to one."""
    size = np.abs(terms).max(axis=0, initial=0.0)
    scales = [np.ones(length) for length in size.shape]
    for _ in range(_SCALING_PASSES):
        for axis in (0, 1):
            left = size / scales[0][:, None] / scales[1]
            largest = left.max(axis=1 - axis, initial=0.0)
            scales[axis] *= np.sqrt(np.where(largest > 0, largest, 1.0))
    return scales[0], scales[1]


# Residuals (k, n_residuals) of some rows of the stack of starts, not finite where a
# point is not admissible, and a function that gives the Jacobians (n_kept,
# n_residuals, n_unknowns) of those of them that are kept.
Residuals = Callable[[Array, Rows], tuple[Array, Callable[[Rows], Array]]]


def never() -> bool:
    """The answer of a search that nothing stops."""
    return False


class Minima(NamedTuple):
    """Where the starts ended: minimisers (k, n_unknowns) and costs ``|r|^2`` (k,).

    The cost of a start that was not admissible is infinite.
    """

    x: Array
    cost: Array


def levenberg_marquardt(
    residuals: Residuals,
    starts: Array,
    *,
    lower: Array | float = -np.inf,
    upper: Array | float = np.inf,
    longest: float = np.inf,
    max_iter: int = 50,
    tol: float = 1e-6,
    patience: int = 2,
    exact: float = 0.0,
    enough: int | None = None,
    stop: Callable[[], bool] = never,
    geodesic: bool = False,
    first_damping: float = _FIRST_DAMPING,
) -> Minima:
    r"""Minimise ``|r(x)|^2`` from every row of a stack of starts, all in one batch.

    A step solves :math:`(J^T J + \lambda S^2) d = -J^T r`, where S holds the largest
    lengths that the columns of J had so far (Marquardt's scaling). The normal equations
    cost a third of an orthogonal factor of every Jacobian, and what they lose in the
    weakest directions the next step mends: the gradient is exact. Steps are projected
    on the bounds; a variable whose bound the gradient presses against is left out.

    `longest` is the largest change of a variable in a step; `max_iter` counts the steps
    that are tried. A start ends when its cost falls by less than `tol` (relative)
    `patience` times in a row, when no step lowers it, or at a cost not above `exact`;
    all end when `enough` of them are that low, or where `stop`, asked before every
    step, says so.

    With `geodesic`, a step bends as the residuals do: their second derivative r'' along
    d, from one more evaluation, adds the half of :math:`-(J^T J + \lambda S^2)^{-1} J^T
    r''`. Along a curved valley that reaches much further [1]_.

    References
    ----------
    .. [1] M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt
       algorithm for nonlinear least-squares minimization", arXiv:1201.5885, 2012.
    """
    x = np.clip(starts, lower, upper)
    k, q = x.shape
    cost, damping = np.full(k, np.inf), np.full(k, first_damping)
    # At x: J^T J, J^T r, the longest columns of J so far, and their inverses, 0 where
    # a bound holds the variable
    H, g = np.zeros((k, q, q)), np.zeros((k, q))
    S, unit = np.zeros((k, q)), np.zeros((k, q))
    diagonal = np.arange(q)
    at: dict[int, tuple[Array, Array]] = {}  # residuals and Jacobian, if `geodesic`

    def move(rows: Rows, trial: Array) -> NDArray[np.bool_]:
        """Take the trial points that lower the cost; which these are."""
        with np.errstate(all="ignore"):
            r, jacobian = residuals(trial, rows)
            new = np.einsum("ij,ij->i", r, r)
            better = new < cost[rows]
            if not better.any():
                return better
            J = jacobian(np.flatnonzero(better))
            squares = J.swapaxes(1, 2) @ J
            slopes = (J.swapaxes(1, 2) @ r[better, :, None])[:, :, 0]
        finite = np.isfinite(squares).all((1, 2)) & np.isfinite(slopes).all(1)
        better[better] = finite
        own, J = rows[better], J[finite]
        x[own], cost[own] = trial[better], new[better]
        H[own], g[own] = squares[finite], slopes[finite]
        S[own] = np.maximum(S[own], np.sqrt(H[own][:, diagonal, diagonal]))
        held = ((x[own] <= lower) & (g[own] > 0)) | ((x[own] >= upper) & (g[own] < 0))
        unit[own] = np.where(held, 0.0, 1.0 / np.where(S[own] > 0, S[own], 1.0))
        if geodesic:
            at.update(zip(own.tolist(), zip(r[better], J, strict=True), strict=True))
        return better

    def bend(rows: Rows, d: Array, damped: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Half of the second-order part of the steps `d`, and which can be trusted."""
        with np.errstate(all="ignore"):
            ahead = residuals(np.clip(x[rows] + _AHEAD * d, lower, upper), rows)[0]
            g2 = np.zeros_like(d)
            for i, row in enumerate(rows.tolist()):
                r, J = at[row]
                if len(ahead[i]) == len(r):
                    g2[i] = J.T @ ((ahead[i] - r) / _AHEAD - J @ d[i])
            D = unit[rows]
            a = -D * np.linalg.solve(damped, (D * g2)[:, :, None])[:, :, 0] / _AHEAD
        known = np.asarray(np.isfinite(a).all(1))
        a = np.where(known[:, None], a, 0.0)
        size = np.linalg.norm(S[rows] * a, axis=1)
        return a, np.asarray(size <= _BENT * np.linalg.norm(S[rows] * d, axis=1))

    move(np.arange(k), x.copy())
    active, idle = np.isfinite(cost) & (cost > exact) & (q > 0), np.zeros(k, int)
    for _ in range(max_iter):
        rows = np.flatnonzero(active)
        if len(rows) == 0 or (enough is not None and (cost <= exact).sum() >= enough):
            break
        if stop():
            break
        D = unit[rows]
        damped = H[rows] * D[:, :, None] * D[:, None]
        damped[:, diagonal, diagonal] += damping[rows, None]
        d = -D * np.linalg.solve(damped, (D * g[rows])[:, :, None])[:, :, 0]
        d *= np.minimum(1.0, longest / np.maximum(np.abs(d).max(1), 1e-300))[:, None]
        trial = np.clip(x[rows] + d, lower, upper)
        taken = trial - x[rows]
        slope = 2.0 * g[rows] + (H[rows] @ taken[:, :, None])[:, :, 0]
        promised = -np.sum(taken * slope, axis=1)
        before = cost[rows]
        # a step that a bound cuts off may promise nothing where a shorter one does
        hopeful = promised > _NOISE * before
        cut = ~hopeful & (trial != x[rows] + d).any(1)
        damping[rows[cut]] *= _MORE
        active[rows] = (hopeful | cut) & (damping[rows] < _LARGEST_DAMPING)
        hopeful &= active[rows]
        if geodesic and hopeful.any():
            some = np.flatnonzero(hopeful)
            more, trusted = bend(rows[some], d[some], damped[some])
            trial[some] = np.clip(trial[some] + more, lower, upper)
            hopeful[some] = trusted
            damping[rows[some[~trusted]]] *= _MORE
        rows, before, promised = rows[hopeful], before[hopeful], promised[hopeful]
        if len(rows) == 0:
            continue
        better = move(rows, trial[hopeful])
        fall = before - cost[rows]
        good = np.where(fall > _AS_PROMISED * np.abs(promised), _LESS, 1.0)
        damping[rows] *= np.where(better, good, _MORE)
        damping[rows] = np.maximum(damping[rows], _LEAST_DAMPING)
        slow = better & (fall <= tol * before)
        idle[rows] = np.where(better & ~slow, 0, idle[rows] + slow)
        active[rows] = (idle[rows] < patience) & (cost[rows] > exact)
    return Minima(x, cost)
