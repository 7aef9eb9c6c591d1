"""Random systems that the rooms of this folder test with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrices = tuple[NDArray, NDArray, NDArray, NDArray]


def random_system(
    n: int = 7,
    n_inputs: int = 2,
    n_outputs: int = 3,
    seed: int = 0,
    decay: float = 0.2,
) -> Matrices:
    """A, B, C, D whose slowest mode decays at the rate `decay`."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A -= (np.linalg.eigvals(A).real.max() + decay) * np.eye(n)
    return (
        A,
        rng.standard_normal((n, n_inputs)),
        rng.standard_normal((n_outputs, n)),
        rng.standard_normal((n_outputs, n_inputs)),
    )
