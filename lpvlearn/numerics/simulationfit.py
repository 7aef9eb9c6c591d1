"""B, D and initial states by least squares on the simulated outputs.

With A and C given, the simulated output is linear in B, D and in the initial state of
every experiment. Solving for them over the whole record (Verhaegen and Verdult, 2007,
Section 9.2.4) leaves no bias, unlike a regression on a shifted state sequence.
Each experiment is compressed to a small triangular factor of the section
signals; everything after that works on matrices of a few dozen rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .hankel import triangularize
from .regression import (
    Freedom,
    linear_regression,
    n_own,
    scaled_lstsq,
    solve_regressions,
)
from .sections import block_sections
from .signals import Record, signal_factor
from .simulation import lti_response

Array = NDArray[np.float64]


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


def freedom(
    n_outputs: int,
    n_inputs: int,
    feedthrough: bool | NDArray[np.bool_] = True,
    initial_states: bool = True,
) -> Freedom:
    """Initial states free or zero, and D as `feedthrough` says: all, none or a mask."""
    direct = np.broadcast_to(np.asarray(feedthrough, dtype=bool), (n_outputs, n_inputs))
    return Freedom(np.array(direct), initial_states)


def general_regression(A: Array, C: Array, record: Record, free: Freedom) -> Array:
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
        factors = [general_regression(A, C, r, free) for r in records]
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


def _overflowing(A: Array, C: Array, records: Sequence[Record]) -> Realization:
    m, (ny, n) = len(records[0].u), C.shape
    zero = np.zeros((n, m)), np.zeros((ny, m)), np.zeros((len(records), n))
    return Realization(A, zero[0], C, zero[1], zero[2], np.inf)


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


def estimate_initial_state(
    A: Array, C: Array, free_response: Array
) -> NDArray[np.float64]:
    """Least-squares initial state of a free response.

    Parameters
    ----------
    A : ndarray of shape (order, order)
    C : ndarray of shape (n_outputs, order)
    free_response : ndarray of shape (n_samples, n_outputs)
        Outputs minus the simulation from rest.

    Returns
    -------
    ndarray of shape (order,)

    Examples
    --------
    >>> import numpy as np
    >>> A, C = np.array([[0.5]]), np.array([[2.0]])
    >>> estimate_initial_state(A, C, np.array([[6.0], [3.0], [1.5]]))
    array([3.])
    """
    record = Record(np.zeros((0, len(free_response))), free_response.T)
    M = general_regression(A, C, record, freedom(len(C), 0))
    return scaled_lstsq(M[:, :-1], M[:, -1])[0]
