"""Frequency axes that show what models do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.experiments import as_numbers
from ..models.statespace import StateSpace
from ..systems.response import pole_grid, pole_rates

Array = NDArray[np.float64]

_PAD = 10.0  # a decade beyond the slowest and the fastest pole

_SMALLEST = 1e-6  # slower poles, relative to the fastest, count as integrators


# Places around a resonance, in half-widths: the peak is drawn round, not cut.
_AROUND = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.3, 3.2, 5.0, 8.0])


def frequency_axis(models: Sequence[StateSpace], n_points: int = 400) -> Array:
    """Angular frequencies (rad/s) from a decade below to one above the poles.

    Logarithmic, with further points around resonances. Ends at the highest Nyquist
    frequency where all models are in discrete time.

    Examples
    --------
    >>> frequency_axis([StateSpace([[-2.0]], [[1.0]], [[1.0]])])[[0, -1]]
    array([ 0.2, 20. ])
    """
    poles = np.concatenate([pole_rates(m.poles(), m.sampling_time) for m in models])
    nyquist = max(nyquist_frequency(model) for model in models)
    size = np.abs(poles)
    size = size[size > _SMALLEST * size.max(initial=0.0)]
    if size.size:
        low, high = size.min() / _PAD, min(size.max() * _PAD, nyquist)
    else:
        high = nyquist if np.isfinite(nyquist) else _PAD
        low = high / _PAD**2
    low = min(low, high / _PAD**2) if np.isfinite(nyquist) else low
    resonant = poles[(poles.imag > 0) & (poles.real != 0)]
    offsets = np.concatenate([-_AROUND, _AROUND])
    grid = pole_grid(resonant, low, high, n_points, offsets)
    return grid[(grid >= low) & (grid <= high)]


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


def nyquist_frequency(model: StateSpace) -> float:
    """Highest frequency (rad/s) of a sampled model; infinity in continuous time."""
    return np.inf if model.sampling_time is None else np.pi / model.sampling_time


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
