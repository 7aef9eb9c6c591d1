"""Frequency weights of the restructuring: a model, or a band of frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .numerics.transfer import Target
from .statespace import StateSpace

Array = NDArray[np.float64]

FrequencyWeight = StateSpace | Sequence[float | None] | None


def weight_target(
    weight: Any, n_outputs: int, sampling_time: float | None
) -> Target | None:
    """The weight as matrices in the time domain of the models.

    Parameters
    ----------
    weight : StateSpace, pair of float or None
        A stable model with one input and output, or with as many as the black box has
        outputs; or a band ``(low, high)`` in rad/s, where None leaves a side open.

    Raises
    ------
    ValueError
        If the weight is unstable, or does not fit the outputs or the time domain.
    """
    if weight is None:
        return None
    if not isinstance(weight, StateSpace):
        weight = band(weight)
        if sampling_time is not None:
            weight = weight.to_discrete(sampling_time, "tustin")
    if weight.sampling_time != sampling_time:
        raise ValueError(
            "`frequency_weight` must be in the time domain of the model: sampling time "
            f"{sampling_time}. Got {weight.sampling_time}."
        )
    if not weight.is_stable:
        raise ValueError(
            "`frequency_weight` must be stable. Got a pole at "
            f"{weight.poles()[np.argmax(weight.poles().real)]:.4g}."
        )
    shape = (weight.n_outputs, weight.n_inputs)
    if shape not in ((1, 1), (n_outputs, n_outputs)):
        raise ValueError(
            f"`frequency_weight` must be 1 x 1 or {n_outputs} x {n_outputs}, for the "
            f"outputs. Got {shape[0]} x {shape[1]}."
        )
    return Target(weight.A, weight.B, weight.C, weight.D, weight.sampling_time)


def band(edges: Any) -> StateSpace:
    """First-order band-pass ``s / (s + low) * high / (s + high)`` between two edges.

    Parameters
    ----------
    edges : pair of float or None
        Rad/s; None, 0 or infinity leaves that side open.
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
    parts = []
    if low > 0:
        parts.append(([[-low]], [[low]], [[-1.0]], [[1.0]]))
    if np.isfinite(high):
        parts.append(([[-high]], [[high]], [[1.0]], [[0.0]]))
    if not parts:
        return StateSpace([], [], [], [[1.0]])
    if len(parts) == 1:
        return StateSpace(*parts[0])
    (a, b, c, d), (e, f, g, _) = (tuple(np.array(M) for M in part) for part in parts)
    A = np.block([[a, np.zeros((1, 1))], [f @ c, e]])
    return StateSpace(A, np.vstack([b, f @ d]), np.hstack([np.zeros((1, 1)), g]))
