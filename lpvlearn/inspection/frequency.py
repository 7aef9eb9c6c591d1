"""Frequency axes of pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.tables import as_numbers
from ..models.frequencies import nyquist_frequency
from ..models.statespace import StateSpace

Array = NDArray[np.float64]


def frequency_label(models: Sequence[StateSpace]) -> str:
    """Of the axis; a ValueError where some models count time in samples, others not."""
    times = [model.sampling_time for model in models]
    if not any(time is True for time in times):
        return "Frequency (rad/s)"
    if any(time != 1 for time in times):
        raise ValueError(
            "models to draw together must count time alike. Got sampling times "
            f"{', '.join(map(str, times))}, where True counts samples: identify that "
            "model with `time=` or `sampling_time=`."
        )
    return "Frequency (rad/sample)"


def response_up_to_nyquist(model: StateSpace, omega: Array) -> NDArray[np.complex128]:
    """Frequency response, NaN above the Nyquist frequency of a sampled model."""
    response = np.full(
        (len(omega), model.n_outputs, model.n_inputs), complex(np.nan, np.nan)
    )
    # Rounding may put the last point of an axis a hair above its own end.
    below = omega <= nyquist_frequency(model) * (1.0 + 1e-9)
    response[below] = model.frequency_response(omega[below])
    return response


def check_frequencies(omega: ArrayLike) -> Array:
    """`omega` as increasing positive frequencies, or a ValueError."""
    grid = as_numbers("omega", omega)
    if grid.ndim != 1 or len(grid) < 2:
        raise ValueError(
            "`omega` must hold at least 2 angular frequencies in rad/s, shape "
            f"(n_freq,). Got shape {grid.shape}."
        )
    if not np.isfinite(grid).all() or grid[0] <= 0 or (np.diff(grid) <= 0).any():
        raise ValueError(
            "`omega` must be finite, positive and increasing, as its axis is "
            f"logarithmic. Got {grid.min():g} to {grid.max():g}."
        )
    return grid
