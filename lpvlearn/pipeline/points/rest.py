"""Where a local model rests: inputs and outputs, near its experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.experiments import Experiment
from ...data.motion import motions
from ...exceptions import warn
from ...models.statespace import StateSpace
from ...systems.modes import n_changes
from .fitting import integrates, integrating

Array = NDArray[np.float64]

_FAR = 5.0  # from the mean of the outputs, in their motion: not where they rest

# Standard deviation of the constants of experiments at a point, in those of outputs,
# that a user should know of.
_APART = 0.1


def equilibrium(
    lti: StateSpace, fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> tuple[Array, Array] | None:
    """Inputs and outputs at which the model rests, nearest to the experiments' means.

    Where these have drifts: as they begin, from which what drifts goes away. In units
    of how far they move within the experiments; where the experiments begin nearest to
    rest if a mode does not decay over them, which rests nearly anywhere, but for one
    that stands for constants and would have that far from all outputs. None where the
    estimator has not looked for constants, or does not tell.
    """
    first = fitted[0]
    looked = getattr(first, "offset", None) or getattr(first, "detrend", None)
    if not looked or not hasattr(first, "resting_point"):
        return None
    known = [own.resting_point(begun=True) for own in fitted]
    u0, y0 = (np.mean(values, axis=0) for values in zip(*known, strict=True))
    if integrates(first):
        begun = _beginning(fitted)
        return None if first.offset_ is None and not begun.any() else (u0, y0 + begun)
    longest = max(len(e.inputs) for e in experiments)
    (u, u_scale), (y, y_scale) = motions(_without_drifts(fitted, experiments))
    gain = lti.dc_gain()
    if n_changes(first.lti_.A, longest) < 1.0:
        far = np.abs(y0 - y) > _FAR * y_scale
        if not (far.any() and np.isfinite(gain).all()):
            return u0, y0
    _tell_different_constants(lti, fitted, experiments)
    step, *_ = np.linalg.lstsq(
        np.vstack([np.diag(1.0 / u_scale), gain / y_scale[:, None]]),
        np.concatenate([(u - u0) / u_scale, (y - y0) / y_scale]),
    )
    return u0 + step, y0 + gain @ step


def _beginning(fitted: Sequence[Any]) -> Array:
    """Where outputs that integrate begin, mean of all; zero where that is near rest."""
    states = [own.begun_state_ for own in fitted]
    outputs = [
        own.lti_.C @ (np.zeros(own.order_) if x is None else x)
        for own, x in zip(fitted, states, strict=True)
    ]
    flags = np.isin(np.arange(len(outputs[0])), integrating(fitted[0]))
    return np.where(flags, np.mean(outputs, axis=0), 0.0)


def _without_drifts(
    fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> Sequence[Experiment]:
    """The experiments without what their outputs drift from the beginning on."""
    drifts = np.vstack([own.output_drift_ for own in fitted])  # per second
    if not drifts.any() or len(drifts) != len(experiments):
        return experiments
    per_sample = drifts * fitted[0].lti_.sampling_time
    return [
        replace(e, outputs=e.measured - np.arange(len(e.inputs))[:, None] * drift)
        for e, drift in zip(experiments, per_sample, strict=True)
    ]


def _tell_different_constants(
    lti: StateSpace, fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> None:
    """Warn of constants that differ from experiment to experiment at one point."""
    levels = [
        own.output_offset_ - own.input_offset_ @ lti.dc_gain().T for own in fitted
    ]
    apart = np.vstack(levels).std(axis=0) > _APART * motions(experiments)[1][1]
    differ = len(fitted) > 1 or any(own.offsets_differ_ for own in fitted)
    if differ and apart.any():
        warn(
            "the experiments at one operating point have different constants in their "
            "outputs. The LPV model takes their mean, and is off by the rest: subtract "
            "what drifted between experiments from y, or let the scheduling variables "
            "tell what the constants depend on."
        )
