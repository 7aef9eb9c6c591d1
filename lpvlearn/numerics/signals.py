"""Triangular factors of the signals that make up a simulated output.

With A in sections (`sections`), the output and its derivatives by every parameter are
fixed combinations of a few filtered signals. Only the triangular factor of these
signals, the inputs and the outputs enters the least-squares problems: a few dozen rows
whatever the length of the record, which is worked through in pieces. As for the
Hankel data, a Cholesky factor of the Gram matrix serves where it is accurate enough.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .hankel import cholesky_factor, stack_factors
from .sections import SectionBank

Array = NDArray[np.float64]

# Samples worked on at a time: their signals stay in the cache.
_PIECE = 8192
# Squares of responses beyond this would overflow.
_LARGEST = 1e200


class Record(NamedTuple):
    """Samples of one experiment, one row per channel.

    Attributes
    ----------
    u : ndarray of shape (n_inputs, n_samples)
    y : ndarray of shape (n_outputs, n_samples)
    """

    u: Array
    y: Array


def signal_pieces(
    blocks: tuple[Array, ...], record: Record, state_map: Array | None = None
) -> Iterator[Array]:
    """Signals of consecutive stretches of a record.

    Parameters
    ----------
    blocks : tuple of ndarray
        Diagonal blocks of A.
    record : Record
    state_map : ndarray of shape (order, order * (1 + n_inputs)), default=None
        Coefficients of the states in the section signals. Given, the second responses
        follow: what every block answers to its own states, by `run_last`, since
        ``d = N g + [x0, B] g_u`` for states driven by signals with answers ``g_u``.

    Yields
    ------
    ndarray of shape (n_signals, n_samples_i)
        Rows: section signals, inputs, outputs, and second responses block by block.
        The memory is used again for the next piece.
    """
    (m, n_samples), ny = record.u.shape, len(record.y)
    order = sum(len(block) for block in blocks)
    base = order * (1 + m)
    second = 0 if state_map is None else order
    memory = np.empty((base + m + ny + second, min(n_samples, _PIECE)))
    first_bank = SectionBank(blocks, [1 + m] * len(blocks))
    second_bank = SectionBank(blocks, [len(block) for block in blocks])
    source = np.zeros((1 + m, memory.shape[1]))
    source[0, 0] = 1.0
    late = np.empty((order, memory.shape[1]))
    last_state = np.zeros(order)
    for start in range(0, n_samples, _PIECE):
        stop = min(start + _PIECE, n_samples)
        n = stop - start
        X = memory[:, :n]
        if start:
            source[0, 0] = 0.0
            source[1:, 0] = record.u[:, start - 1]
        source[1:, 1:n] = record.u[:, start : stop - 1]
        first_bank.run([source[:, :n]] * len(blocks), X[:base])
        X[base : base + m] = record.u[:, start:stop]
        X[base + m : base + m + ny] = record.y[:, start:stop]
        if state_map is not None:
            late[:, 0] = last_state
            late[:, 1:n] = state_map @ X[:base, :-1]
            last_state = state_map @ X[:base, -1]
            stops = np.cumsum([len(block) for block in blocks])
            parts = [
                late[stop - len(block) : stop, :n]
                for block, stop in zip(blocks, stops, strict=True)
            ]
            second_bank.run_last(parts, X[base + m + ny :])
        yield X


def signal_factor(
    blocks: tuple[Array, ...], record: Record, state_map: Array | None = None
) -> Array | None:
    """Upper triangular factor of the signals of a record.

    Parameters
    ----------
    blocks, record, state_map
        As in `signal_pieces`.

    Returns
    -------
    ndarray of shape (n_signals, n_signals) or None
        None where the responses overflow.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        gram: Array | float = 0.0
        for X in signal_pieces(blocks, record, state_map):
            gram = gram + X @ X.T
        gram = np.asarray(gram)
        if not np.abs(np.diagonal(gram)).max(initial=0.0) < _LARGEST:
            return None
        lower = cholesky_factor(gram)
    if lower is None:
        lower = np.zeros((len(gram), 0))
        for X in signal_pieces(blocks, record, state_map):
            lower = stack_factors([lower, X])
    return lower.T
