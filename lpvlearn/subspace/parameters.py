"""The parameters of a model in section form as one vector.

B (state-major), the free entries of D, the blocks of A (row-major) and C follow one
another, as in the columns of `jacobian_regression`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .simulation_fit import Freedom, Realization

Array = NDArray[np.float64]


def block_parts(model: Realization, n_parameters: int) -> list[slice]:
    """Where the entries of every block of A stand among the parameters."""
    assert model.blocks is not None
    sizes = [block.size for block in model.blocks]
    stops = n_parameters - model.C.size - sum(sizes) + np.cumsum(sizes, dtype=int)
    return [slice(stop - size, stop) for stop, size in zip(stops, sizes, strict=True)]


def moved_model(model: Realization, change: Array, free: Freedom) -> Realization:
    """The model after a change of its parameters; what else it tells is not updated."""
    assert model.blocks is not None
    n_b, n_d, n_c = model.B.size, int(free.direct.sum()), model.C.size
    D = model.D.copy()
    D[free.direct] += change[n_b : n_b + n_d]
    parts = block_parts(model, len(change))
    blocks = tuple(
        block + change[part].reshape(block.shape)
        for block, part in zip(model.blocks, parts, strict=True)
    )
    return model._replace(
        A=linalg.block_diag(*blocks) if blocks else model.A,
        B=model.B + change[:n_b].reshape(model.B.shape),
        C=model.C + change[len(change) - n_c :].reshape(model.C.shape),
        D=D,
        blocks=blocks,
    )


def change_between(start: Realization, end: Realization, free: Freedom) -> Array:
    """The change of the parameters that leads from one model to another."""
    assert start.blocks is not None and end.blocks is not None
    changes = [new - old for new, old in zip(end.blocks, start.blocks, strict=True)]
    return np.concatenate(
        [
            (end.B - start.B).ravel(),
            (end.D - start.D)[free.direct],
            *(change.ravel() for change in changes),
            (end.C - start.C).ravel(),
        ]
    )
