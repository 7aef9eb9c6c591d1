"""Modes of a system in discrete time: how far out, how fast, and whether they last.

How long a record is to a mode, in its time constants, has two meanings. Its pole p may
be near the unit circle: what it was excited to is there at the end still. Or it may be
near one: it is nearly constant, which one that turns is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Time constants per longest experiment of a mode that may stand for a constant, or a
# drift.
HARDLY_DECAYS = 3.0


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


def n_decays(A: Array, n_samples: int) -> float:
    """Time constants in so many samples of the mode that decays least, ``n (1 - |p|)``.

    Negative of one that grows; the samples where there is none.

    >>> round(n_decays(np.diag([0.5, -0.9]), 100), 9)
    10.0
    """
    return (1.0 - spectral_radius(A)) * n_samples


def n_changes(A: Array, n_samples: int) -> float:
    """Those of the mode that is nearest to a constant, ``n |1 - p|``.

    Whether it decays, grows or turns; infinity where there is none.

    >>> round(n_changes(np.diag([0.5, -0.9]), 100), 9)
    50.0
    """
    return float((mode_rates(A) * n_samples).min(initial=np.inf))


def lasting(poles: NDArray, longest: int) -> NDArray[np.bool_]:
    """Which modes do not decay over the longest experiment, or grow.

    >>> lasting(np.array([0.9, 0.99, 1.01, 1j]), 200)
    array([False,  True,  True, False])
    """
    return (np.abs(1.0 - poles) * longest < HARDLY_DECAYS) | (np.abs(poles) > 1.0)
