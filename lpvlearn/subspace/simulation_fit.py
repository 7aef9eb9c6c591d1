"""B, D and initial states by least squares on the simulation error.

With A and C given, the simulated outputs ``y = C (z I - A)^-1 (x0 + B u) + D u`` are
linear in the rest of the model. The regressors of all samples are combinations of a
few section signals (see `signals`), so that the triangular factor of these signals,
computed once, stands for the samples: the regressions here have as many rows as there
are signals, for each output. The derivative of the simulation error with respect to
all parameters, which `refinement` takes its steps by, is a regression on the same
signals and on second responses. The unknowns of an experiment (its initial state) are
projected out before experiments are pooled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ..systems.least_squares import RCOND, scaled_lstsq
from ..systems.simulation import lti_response
from .hankel import triangularize
from .signals import (
    Record,
    block_remainder,
    block_sections,
    block_slices,
    output_coefficients,
    signal_factor,
    state_coefficients,
)

Array = NDArray[np.float64]


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


def freedom(
    n_outputs: int,
    n_inputs: int,
    feedthrough: bool | NDArray[np.bool_] = True,
    initial_states: bool = True,
) -> Freedom:
    """Initial states free or zero, and D as `feedthrough` says: all, none or a mask."""
    direct = np.broadcast_to(np.asarray(feedthrough, dtype=bool), (n_outputs, n_inputs))
    return Freedom(np.array(direct), initial_states)


class Realization(NamedTuple):
    """A discrete-time model with the initial states of its experiments.

    Attributes
    ----------
    A, B, C, D : ndarray
        State-space matrices.
    initial_states : ndarray of shape (n_experiments, order)
    loss : float
        Sum of squared simulation errors over all experiments; infinite where the
        simulation overflows.
    rank_deficit : int
        Number of directions of B and D that the data leave undetermined.
    blocks : tuple of ndarray or None
        Diagonal blocks of A where it is in section form.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    initial_states: Array
    loss: float
    rank_deficit: int = 0
    blocks: tuple[Array, ...] | None = None


def simulation_fit(
    A: Array, C: Array, records: Sequence[Record], free: Freedom | None = None
) -> Realization:
    """B, D and initial states that minimise the simulation error.

    Parameters
    ----------
    A : ndarray of shape (order, order)
    C : ndarray of shape (n_outputs, order)
    records : sequence of Record
        Experiments, each with its own initial state.
    free : Freedom, default=None
        None frees all initial states and all of D.

    Returns
    -------
    Realization
        In the coordinates of `block_sections` where these exist, else in those given.

    References
    ----------
    M. Verhaegen and V. Verdult, *Filtering and System Identification*, Cambridge
    University Press, 2007, Section 9.2.4.
    """
    if free is None:
        free = freedom(len(C), len(records[0].u))
    sections = block_sections(A)
    if sections is not None:
        return block_fit(sections.blocks, C @ sections.transform, records, free)
    with np.errstate(over="ignore", invalid="ignore"):
        factors = [_general_regression(A, C, r, free) for r in records]
    if not all(np.isfinite(factor).all() for factor in factors):
        return _overflowing(A, C, records)
    return _realization(A, C, factors, free, None)


def block_fit(
    blocks: tuple[Array, ...], C: Array, records: Sequence[Record], free: Freedom
) -> Realization:
    """As `simulation_fit`, for a state matrix in section form."""
    A = linalg.block_diag(*blocks) if blocks else np.zeros((0, 0))
    factors = []
    for record in records:
        R = signal_factor(blocks, record)
        if R is None:
            return _overflowing(A, C, records)
        factors.append(linear_regression(R, blocks, C, free))
    return _realization(A, C, factors, free, blocks)


def _general_regression(A: Array, C: Array, record: Record, free: Freedom) -> Array:
    """As `linear_regression` for any A, by the adjoint state recursion.

    ``c (z I - A)^-1 B u_j`` is linear in B through the state of the model
    ``(A.T, c)`` driven by ``u_j``. Slower, but free of any transformation.
    """
    (m, n_samples), (ny, n) = record.u.shape, C.shape
    own = n_own(n, free)
    where = np.argwhere(free.direct)
    eye, none = np.eye(n), np.zeros((n, 1))
    parts = []
    for i in range(ny):
        M = np.zeros((own + n * m + len(where) + 1, n_samples))
        if own:
            at_rest = np.zeros((n_samples, 1))
            M[:n] = lti_response(A.T, none, eye, none, at_rest, C[i]).T
        for j in range(m):
            M[own + j : own + n * m : m] = lti_response(
                A.T, C[i][:, None], eye, none, record.u[j][:, None]
            ).T
        for row, (output, j) in enumerate(where, start=own + n * m):
            if output == i:
                M[row] = record.u[j]
        M[-1] = record.y[i]
        parts.append(triangularize(M))
    return np.vstack(parts)


def _realization(
    A: Array,
    C: Array,
    factors: Sequence[Array],
    free: Freedom,
    blocks: tuple[Array, ...] | None,
) -> Realization:
    n, m = len(A), free.direct.shape[1]
    own = n_own(n, free)
    common, states, loss, deficit = solve_regressions(factors, own)
    D = np.zeros(free.direct.shape)
    D[free.direct] = common[n * m :]
    if not own:
        states = np.zeros((len(factors), n))
    return Realization(
        A, common[: n * m].reshape(n, m), C, D, states, loss, deficit, blocks
    )


def _overflowing(A: Array, C: Array, records: Sequence[Record]) -> Realization:
    m, (ny, n) = len(records[0].u), C.shape
    zero = np.zeros((n, m)), np.zeros((ny, m)), np.zeros((len(records), n))
    return Realization(A, zero[0], C, zero[1], zero[2], np.inf)


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


def stack_regressions(regressions: Sequence[Array], n: int) -> Array:
    """One regression on the common unknowns, the first `n` of each projected out."""
    reduced = [project_out(M, n) for M in regressions]
    if len(reduced) == 1:
        return reduced[0]
    return triangularize(np.vstack(reduced).T)


def project_out(M: Array, n: int) -> Array:
    """The columns after the first `n`, without what the first `n` explain."""
    if n == 0:
        return M
    explained = linalg.orth(M[:, :n] / column_scale(M[:, :n]), RCOND)
    return M[:, n:] - explained @ (explained.T @ M[:, n:])


def column_scale(M: Array) -> Array:
    """Norm of every column; 1 for a column of zeros."""
    scale = np.sqrt(np.einsum("ij,ij->j", M, M))
    scale[scale == 0.0] = 1.0
    return scale


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
    out = np.zeros((ny, k, _n_linear(n, free) + 1))
    _fill_linear(out, R, blocks, C, free)
    base = n * (1 + m)
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
    column, base = _n_linear(n, free), n * (1 + m)
    size_a = sum(block.size for block in blocks)
    out = np.zeros((ny, k, column + size_a + ny * n + 1))
    _fill_linear(out, R, blocks, C, free)
    second = R[:, base + m + ny :]
    for block, part in zip(blocks, block_slices(blocks), strict=True):
        # Entry (p, q) of the block drives state p with state q.
        answer = second[:, part]
        if len(block) == 1:
            effect = C[:, None, part, None] * answer[None, :, None, :]
        else:
            N = block_remainder(block)
            g_u = R[:, (part.start + 1) * (1 + m) : part.stop * (1 + m)]
            first = answer @ N.T + g_u @ driven[part].T
            effect = C[:, None, part, None] * first[None, :, None, :]
            effect += (C[:, part] @ N)[:, None, :, None] * answer[None, :, None, :]
        out[:, :, column : column + block.size] = effect.reshape(ny, k, -1)
        column += block.size
    states = R[:, :base] @ state_coefficients(blocks, driven).T
    for i in range(ny):
        out[i, :, column + i * n : column + (i + 1) * n] = states
    fitted = states @ C.T + R[:, base : base + m] @ D.T
    out[:, :, -1] = (R[:, base + m : base + m + ny] - fitted).T
    return out.reshape(ny * k, -1)


def _n_linear(order: int, free: Freedom) -> int:
    """Number of unknowns that an output is linear in: initial state, B and D."""
    return n_own(order, free) + order * free.direct.shape[1] + int(free.direct.sum())


def _fill_linear(
    out: Array, R: Array, blocks: tuple[Array, ...], C: Array, free: Freedom
) -> None:
    """Fill in the effects of initial state (if free), B and the free entries of D."""
    (ny, n), m, k = C.shape, free.direct.shape[1], len(R)
    own, base = n_own(n, free), n * (1 + m)
    signals = R[:, :base].reshape(k, n, 1 + m).transpose(0, 2, 1)
    effect = signals[None] @ output_coefficients(blocks, C)[:, None]
    out[:, :, :own] = effect[:, :, 0, :own]
    by_state = effect[:, :, 1:].transpose(0, 1, 3, 2)
    out[:, :, own : own + n * m] = by_state.reshape(ny, k, n * m)
    for column, (i, j) in enumerate(np.argwhere(free.direct), start=own + n * m):
        out[i, :, column] = R[:, base + j]


def n_own(order: int, free: Freedom) -> int:
    """Number of unknowns that belong to one experiment."""
    return order if free.initial_states else 0
