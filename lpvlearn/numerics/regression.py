"""Least squares in compressed form: simulated outputs by their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .sections import block_coefficients, output_coefficients, state_coefficients

Array = NDArray[np.float64]

# Directions of the normalised regressors below this are left out (minimum norm).
_RCOND = 1e-11


class Freedom(NamedTuple):
    """Which parameters are free besides A, B and C.

    Attributes
    ----------
    direct : ndarray of bool, shape (n_outputs, n_inputs)
        Entries of D; the others are zero.
    initial_states : bool
        False starts every experiment from rest.
    """

    direct: NDArray[np.bool_]
    initial_states: bool = True


class Point(NamedTuple):
    """A model in section form, around which the simulation error is linearised.

    Attributes
    ----------
    C : ndarray of shape (n_outputs, order)
    D : ndarray of shape (n_outputs, n_inputs)
    driven : ndarray of shape (order, 1 + n_inputs)
        Initial state and B.
    """

    C: Array
    D: Array
    driven: Array


def n_own(order: int, free: Freedom) -> int:
    """Number of unknowns that belong to one experiment."""
    return order if free.initial_states else 0


def linear_regression(
    R: Array, blocks: tuple[Array, ...], C: Array, free: Freedom
) -> Array:
    """Regression of the outputs on initial state, B and D, with A and C given.

    Parameters
    ----------
    R : ndarray of shape (k, n_signals)
        From `signal_factor`.
    blocks : tuple of ndarray
        Blocks of A.
    C : ndarray of shape (n_outputs, order)
    free : Freedom

    Returns
    -------
    ndarray of shape (n_outputs * k, n_unknowns + 1)
        Columns: initial state (if free), B (state-major), free entries of D, output.
    """
    (ny, n), m, k = C.shape, free.direct.shape[1], len(R)
    own = n_own(n, free)
    where = np.argwhere(free.direct)
    out = np.zeros((ny, k, own + n * m + len(where) + 1))
    base = _driven_columns(out, R, blocks, C, m, own)
    for column, (i, j) in enumerate(where, start=own + n * m):
        out[i, :, column] = R[:, base + j]
    out[:, :, -1] = R[:, base + m : base + m + ny].T
    return out.reshape(ny * k, -1)


def jacobian_regression(
    R: Array, blocks: tuple[Array, ...], point: Point, free: Freedom
) -> Array:
    """Regression of the simulation error on changes of all parameters.

    Parameters
    ----------
    R : ndarray of shape (k, n_signals)
        From `signal_factor`, with second responses.
    blocks : tuple of ndarray
        Blocks of A.
    point : Point
    free : Freedom

    Returns
    -------
    ndarray of shape (n_outputs * k, n_parameters + 1)
        Columns: initial state (if free), B, free entries of D, A (blocks, row-major),
        C, simulation error.
    """
    C, D, driven = point
    (ny, n), m, k = C.shape, D.shape[1], len(R)
    own, second = n_own(n, free), sum(len(block) ** 2 for block in blocks)
    where = np.argwhere(free.direct)
    at_a = own + n * m + len(where)
    out = np.zeros((ny, k, at_a + second + ny * n + 1))
    base = _driven_columns(out, R, blocks, C, m, own)
    for column, (i, j) in enumerate(where, start=own + n * m):
        out[i, :, column] = R[:, base + j]
    start, column, row = 0, at_a, base + m + ny
    for block in blocks:
        size = len(block)
        part = slice(start, start + size)
        # Entry (p, q) of the block drives state p with state q.
        answer = R[:, row : row + size]
        if size == 1:
            effect = C[:, None, part, None] * answer[None, :, None, :]
        else:
            N = block_coefficients(block)[1]
            g_u = R[:, (start + 1) * (1 + m) : (start + 2) * (1 + m)]
            first = answer @ N.T + g_u @ driven[part].T
            effect = C[:, None, part, None] * first[None, :, None, :]
            effect += (C[:, part] @ N)[:, None, :, None] * answer[None, :, None, :]
        out[:, :, column : column + size * size] = effect.reshape(ny, k, -1)
        start, column, row = part.stop, column + size * size, row + size
    states = R[:, :base] @ state_coefficients(blocks, driven).T
    for i in range(ny):
        out[i, :, column + i * n : column + (i + 1) * n] = states
    fitted = states @ C.T + R[:, base : base + m] @ D.T
    out[:, :, -1] = (R[:, base + m : base + m + ny] - fitted).T
    return out.reshape(ny * k, -1)


def _driven_columns(
    out: Array, R: Array, blocks: tuple[Array, ...], C: Array, m: int, own: int
) -> int:
    """Fill in the effects of initial state and B; the number of section signals."""
    (ny, n), k = C.shape, len(R)
    base = n * (1 + m)
    signals = R[:, :base].reshape(k, n, 1 + m).transpose(0, 2, 1)
    effect = signals[None] @ output_coefficients(blocks, C)[:, None]
    out[:, :, :own] = effect[:, :, 0, :own]
    by_state = effect[:, :, 1:].transpose(0, 1, 3, 2)
    out[:, :, own : own + n * m] = by_state.reshape(ny, k, n * m)
    return base


def scaled_lstsq(M: Array, rhs: Array, rcond: float = _RCOND) -> tuple[Array, int]:
    """Least squares with columns scaled to one, minimum norm where rank deficient.

    Parameters
    ----------
    M : ndarray of shape (n_rows, n_unknowns)
    rhs : ndarray of shape (n_rows,)
    rcond : float
        Relative singular value below which a direction counts as undetermined.

    Returns
    -------
    solution : ndarray of shape (n_unknowns,)
    rank : int
    """
    if M.shape[1] == 0:
        return np.zeros(0), 0
    scale = np.sqrt(np.einsum("ij,ij->j", M, M))
    scale[scale == 0.0] = 1.0
    solution, _, rank, _ = linalg.lstsq(
        M / scale, rhs, cond=rcond, lapack_driver="gelsy", check_finite=False
    )
    return solution / scale, int(rank)


def project_out(M: Array, n: int, rcond: float = _RCOND) -> Array:
    """The columns after the first `n`, without what the first `n` explain."""
    if n == 0:
        return M
    scale = np.sqrt(np.einsum("ij,ij->j", M[:, :n], M[:, :n]))
    scale[scale == 0.0] = 1.0
    left, s, _ = linalg.svd(M[:, :n] / scale, full_matrices=False, check_finite=False)
    left = left[:, s > rcond * s[0]]
    return M[:, n:] - left @ (left.T @ M[:, n:])


def stack_regressions(regressions: Sequence[Array], n: int) -> Array:
    """One regression on the common unknowns, the first `n` of each projected out."""
    reduced = [project_out(M, n) for M in regressions]
    if len(reduced) == 1:
        return reduced[0]
    return np.triu(linalg.qr(np.vstack(reduced), mode="r", check_finite=False)[0])[
        : reduced[0].shape[1]
    ]


def solve_regressions(
    regressions: Sequence[Array], n: int
) -> tuple[Array, Array, float, int]:
    """Common unknowns and the own ones of every experiment.

    Parameters
    ----------
    regressions : sequence of ndarray
        The first `n` columns belong to an experiment's own unknowns, the last is the
        right-hand side.
    n : int

    Returns
    -------
    common : ndarray of shape (n_common,)
    own : ndarray of shape (n_experiments, n)
    loss : float
        Residual sum of squares.
    rank_deficit : int
        Of the common unknowns.
    """
    if len(regressions) == 1:
        M, rhs = regressions[0][:, :-1], regressions[0][:, -1]
        solution, rank = scaled_lstsq(M, rhs)
        if rank == M.shape[1]:
            loss = float(np.sum((M @ solution - rhs) ** 2))
            return solution[n:], solution[None, :n], loss, 0
    stacked = stack_regressions(regressions, n)
    common, rank = scaled_lstsq(stacked[:, :-1], stacked[:, -1])
    loss = float(np.sum((stacked[:, :-1] @ common - stacked[:, -1]) ** 2))
    own = np.empty((len(regressions), n))
    for e, M in enumerate(regressions):
        own[e] = scaled_lstsq(M[:, :n], M[:, -1] - M[:, n:-1] @ common)[0]
    return common, own, loss, len(common) - rank
