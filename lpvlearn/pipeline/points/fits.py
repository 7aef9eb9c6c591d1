"""How well a model simulates the experiments at an operating point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.experiments import Experiment
from ...metrics.scores import best_fit
from ...models.statespace import StateSpace, unknown_responses
from ...systems.simulation import (
    delayed,
    estimate_initial_state,
    spread_of,
    state_trajectory,
    trend_signals,
)

Array = NDArray[np.float64]

_ABOUT_ZERO = 1e-9  # of a pole by the fastest one: it is an integrator's


class Measured(NamedTuple):
    """Experiments as models are compared with them."""

    size: Array  # how far outputs move
    # Of each length: inputs (length, n_inputs, n_runs), one run if all are alike, and
    # outputs channel by channel in memory, as experiments are: (n_outputs, n_runs,
    # length)
    parts: list[tuple[Array, Array]]

    @classmethod
    def of(cls, group: Sequence[Experiment]) -> Measured:
        size = spread_of(np.vstack([e.measured for e in group]))
        parts = []
        for length in sorted({len(e.rows) for e in group}):
            part = [e for e in group if len(e.rows) == length]
            inputs = [e.inputs for e in part]
            if all(np.array_equal(u, inputs[0]) for u in inputs[1:]):
                inputs = inputs[:1]
            y = np.stack([e.measured.T for e in part], axis=1)
            parts.append((np.stack(inputs, axis=-1), y))
        return cls(size, parts)


def fit_of(
    model: StateSpace,
    measured: Measured,
    sampling_time: float,
    n_trend: int,
    hold: str = "zoh",
) -> float:
    """BFT (percent, mean over the outputs) of a continuous model on experiments.

    The initial state of every experiment is estimated by least squares, and with
    `n_trend` a constant (1), a constant and a drift (2) of every output. Experiments of
    one length are simulated together; realizations of one input, once.
    """
    sampled = model.to_discrete(sampling_time, hold)
    if n_trend and _integrates(model):  # what offsets of the inputs add up to
        n_trend = 2
    true, simulated = [], []
    for inputs, y in measured.parts:
        length, u = len(inputs), delayed(inputs, sampled.input_delay)
        x = state_trajectory(
            sampled.A, np.tensordot(u, sampled.B, (1, 1)).swapaxes(1, 2)
        )
        free = unknown_responses(sampled, length, trend_signals(length, n_trend))
        forced = (sampled.C @ x + sampled.D @ u).transpose(1, 2, 0)
        errors = (y - forced).transpose(2, 0, 1)
        own = estimate_initial_state(free, errors, measured.size)
        found = forced + own.T @ free.transpose(1, 2, 0)
        true.append(y.reshape(model.n_outputs, -1))
        simulated.append(found.reshape(model.n_outputs, -1))
    return float(best_fit(np.hstack(true).T, np.hstack(simulated).T, "uniform_average"))


def _integrates(model: StateSpace) -> bool:
    rates = np.abs(model.poles())
    return bool(rates.min(initial=1.0) <= _ABOUT_ZERO * rates.max(initial=0.0))
