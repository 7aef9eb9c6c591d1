"""The range of scheduling variables: as intervals, as a grid, as a unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CLOSE = 1e-8  # of a number: half the least interval about it that digits resolve well


def domains(scheduling_range: Array) -> Array:
    """Ends (2, n_scheduling) of the intervals; of width 2 around a constant one.

    Where that is none besides so large a number, of a larger one.
    """
    low, high = scheduling_range
    half = np.where(low == high, np.maximum(1.0, _CLOSE * np.abs(low)), 0.0)
    return np.array([low - half, high + half])


def grid_over(scheduling_range: Array, levels: int) -> Array:
    """All combinations of levels of the variables, (levels^n_scheduling, n)."""
    low, high = domains(scheduling_range)
    axes = [np.linspace(a, b, levels) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def to_unit(kappa: Array, scheduling_range: Array) -> Array:
    """Scheduling values mapped linearly from their range to [-1, 1]."""
    low, high = domains(scheduling_range)
    return (2 * kappa - (low + high)) / (high - low)


def in_range_of_points(kappa: Array) -> Array:
    """Points in units of the range that they span, from 0 to 1; 0 of a constant one."""
    span = np.ptp(kappa, axis=0)
    return np.asarray((kappa - kappa.min(axis=0)) / np.where(span > 0, span, 1.0))
