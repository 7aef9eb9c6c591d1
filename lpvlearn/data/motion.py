"""How far signals move: means and standard deviations of channels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .experiments import Experiment

Array = NDArray[np.float64]


def motions(
    experiments: Sequence[Experiment],
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Mean, and standard deviation about that of every experiment, of inputs, outputs.

    A channel that stands still counts as moving by one.
    """
    found = []
    for values in zip(*((e.inputs, e.outputs) for e in experiments), strict=True):
        mean, variance = moments(values, about_own=True)
        found.append((mean, np.where(variance > 0, np.sqrt(variance), 1.0)))
    return found[0], found[1]


def channel_sizes(groups: Sequence[Sequence[Experiment]]) -> tuple[Array, Array]:
    """How far inputs and outputs move at the points, root mean squares of all."""
    both = zip(*(motions(group) for group in groups), strict=True)
    u, y = (np.sqrt(np.mean([std**2 for _, std in one], axis=0)) for one in both)
    return u, y


def moments(values: Sequence[Any], *, about_own: bool) -> tuple[Array, Array]:
    """Mean and variance of channels, NaN left out, about the mean of each part or all.

    Zero where nothing is known.
    """
    counts = [np.count_nonzero(~np.isnan(v), axis=0) for v in values]
    sums = [np.nansum(v, axis=0) for v in values]
    n = np.maximum(np.sum(counts, axis=0), 1)
    mean = np.sum(sums, axis=0) / n
    centres = [mean for _ in values]
    if about_own:
        centres = [s / np.maximum(k, 1) for s, k in zip(sums, counts, strict=True)]
    squares = [
        np.nansum((v - centre) ** 2, axis=0)
        for v, centre in zip(values, centres, strict=True)
    ]
    return mean, np.sum(squares, axis=0) / n
