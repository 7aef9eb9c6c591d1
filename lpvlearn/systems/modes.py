"""Modes of a system in discrete time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def mode_rates(A: Array) -> Array:
    """Of modes, one over the samples in which they decay, grow or turn.

    >>> mode_rates(np.diag([0.9, 0.5])).round(3)
    array([0.1, 0.5])
    """
    return np.abs(1.0 - np.linalg.eigvals(A))


def spectral_radius(A: Array) -> float:
    """Modulus of the farthest eigenvalue; 0 without any.

    >>> round(spectral_radius(np.array([[0.0, 0.5], [-0.5, 0.0]])), 9)
    0.5
    """
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
