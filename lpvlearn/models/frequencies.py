"""Frequencies at which models are looked at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..systems.response import pole_grid, pole_rates
from .statespace import StateSpace

Array = NDArray[np.float64]

_PAD = 10.0  # a decade beyond the slowest and the fastest pole

_N_FREQUENCIES = 400  # of a curve as wide as a page, which then looks smooth

_SMALLEST = 1e-6  # slower poles, relative to the fastest, count as integrators


# Places around a resonance, in half-widths: the peak is drawn round, not cut.
_AROUND = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.3, 3.2, 5.0, 8.0])


def frequency_axis(models: Sequence[StateSpace]) -> Array:
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
    grid = pole_grid(resonant, low, high, _N_FREQUENCIES, offsets)
    return grid[(grid >= low) & (grid <= high)]


def nyquist_frequency(model: StateSpace) -> float:
    """Highest frequency (rad/s) of a sampled model; infinity in continuous time."""
    return np.inf if model.sampling_time is None else np.pi / model.sampling_time
