"""The system matrix S = [[A, B], [C, D]]: from blocks, and its blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..validation import shown

Array = NDArray[np.float64]

Blocks = tuple[Array, Array, Array, Array]


def blocks(S: Array, order: int) -> Blocks:
    """A, B, C, D of ``S = [[A, B], [C, D]]``, stacked over its leading axes."""
    n = order
    return S[..., :n, :n], S[..., :n, n:], S[..., n:, :n], S[..., n:, n:]


def stack_system(
    source: str,
    blocks: Sequence[Any],
    shape: tuple[int, int, int],
    lead: tuple[int, ...],
) -> NDArray[Any]:
    """``[[A, B], [C, D]]`` from (A, B, C) or (A, B, C, D), after `lead` axes.

    `shape` is order, n_inputs, n_outputs. A ValueError about the function `source`
    that returned the blocks, if one has another shape.
    """
    if not isinstance(blocks, Sequence) or len(blocks) not in (3, 4):
        raise ValueError(
            f"`{source}` must return (A, B, C) or (A, B, C, D). Got {shown(blocks)}."
        )
    n, m, p = shape
    given = [np.asarray(block) for block in blocks if block is not None]
    S = np.zeros((*lead, n + p, n + m), np.result_type(float, *given))
    corners = ((0, 0, n, n), (0, n, n, m), (n, 0, p, n), (n, n, p, m))
    for name, block, corner in zip("ABCD", blocks, corners, strict=False):
        if block is None:
            continue
        row, column, height, width = corner
        array, expected = np.asarray(block), (*lead, height, width)
        if array.size != np.prod(expected):
            raise ValueError(
                f"`{source}` must return `{name}` of shape {expected}. Got "
                f"{array.shape}."
            )
        place = ..., slice(row, row + height), slice(column, column + width)
        S[place] = array.reshape(expected)
    return S
