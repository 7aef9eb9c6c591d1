"""The weight of the error over frequency, a model or a band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..models.statespace import StateSpace
from .error_system import Target, series

FrequencyWeight = StateSpace | Sequence[float | None] | None


def weight_model(
    weight: Any, n_outputs: int, sampling_time: float | None
) -> StateSpace | None:
    """The `frequency_weight`, model or band, in the time domain of the black boxes."""
    if weight is None:
        return None
    if not isinstance(weight, StateSpace):
        weight = _band(weight)
        if sampling_time is not None:
            weight = weight.to_discrete(sampling_time, "tustin")
    if weight.sampling_time != sampling_time:
        raise ValueError(
            "`frequency_weight` must be in the time domain of the model: sampling time "
            f"{sampling_time}. Got {weight.sampling_time}."
        )
    if weight.input_delay.any():
        raise ValueError(
            f"`frequency_weight` must be without delay. Got {weight}. A delay changes "
            "no gain: leave it out by with_input_delay(0)."
        )
    if not weight.is_stable:
        raise ValueError(
            "`frequency_weight` must be stable. Got a pole at "
            f"{weight.poles()[np.argmax(weight.poles().real)]:.4g}."
        )
    if weight.D.shape not in ((1, 1), (n_outputs, n_outputs)):
        raise ValueError(
            f"`frequency_weight` must be 1 x 1 or {n_outputs} x {n_outputs}, for the "
            f"outputs. Got {weight.n_outputs} x {weight.n_inputs}."
        )
    return weight


def _band(edges: Any) -> StateSpace:
    """First-order band-pass ``s / (s + low) * high / (s + high)``; rad/s.

    None, 0 or infinity leaves that side open.
    """
    try:
        low, high = edges
        low = 0.0 if low is None else float(low)
        high = np.inf if high is None else float(high)
    except (TypeError, ValueError):
        raise ValueError(
            "`frequency_weight` must be a StateSpace or a band (low, high) in rad/s. "
            f"Got {edges!r}."
        ) from None
    if not 0 <= low < high:
        raise ValueError(
            f"`frequency_weight` must be a band with 0 <= low < high. Got {edges!r}."
        )
    one = np.ones((1, 1))
    band = Target(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), one)
    if low > 0:
        band = series(band, Target(-low * one, low * one, -one, one))
    if np.isfinite(high):
        band = series(band, Target(-high * one, high * one, one, 0.0 * one))
    return StateSpace(*band.matrices)
