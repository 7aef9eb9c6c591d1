"""How well a model simulates the experiments at an operating point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.experiments import Experiment
from ...metrics.scores import fit_of_norms
from ...models.statespace import StateSpace, unknown_responses
from ...systems.simulation import (
    delayed,
    estimate_initial_state,
    state_trajectory,
    trend_signals,
)

Array = NDArray[np.float64]

_AT_ONCE = 131_072  # samples that are simulated together

_ABOUT_ZERO = 1e-9  # of a pole by the fastest one: it is an integrator's


class Measured(NamedTuple):
    """Experiments as models are compared with them."""

    batches: list[list[Experiment]]  # of one length each, that are simulated together
    size: Array  # how far outputs move, as `spread_of`
    spread: Array  # root of the squares about their means, in these sizes

    @classmethod
    def of(cls, group: Sequence[Experiment]) -> Measured:
        batches = []
        for length in sorted({len(e.rows) for e in group}):
            part = [e for e in group if len(e.rows) == length]
            n = max(1, _AT_ONCE // length)
            batches += [part[k : k + n] for k in range(0, len(part), n)]
        return cls(batches, *_size_and_spread([e.measured for e in group]))

    def stacked(self) -> Iterator[tuple[Array, Array]]:
        """Of each batch inputs (length, n_inputs, n_runs), one run if all are alike.

        And outputs channel by channel in memory, as experiments are: (n_outputs,
        n_runs, length).
        """
        for part in self.batches:
            inputs = [e.inputs for e in part]
            if all(np.array_equal(u, inputs[0]) for u in inputs[1:]):
                inputs = inputs[:1]
            y = np.stack([e.measured.T for e in part], axis=1)
            yield np.stack(inputs, axis=-1), y


def _size_and_spread(outputs: Sequence[Array]) -> tuple[Array, Array]:
    """`size` and `spread` of `Measured`, without a copy of all outputs."""
    n = np.sum([np.count_nonzero(~np.isnan(y), axis=0) for y in outputs], axis=0)
    known = np.maximum(n, 1)
    mean = np.sum([np.nansum(y, axis=0) / known for y in outputs], axis=0)
    low, high = (
        np.array([f.reduce(y, axis=0) for y in outputs]) for f in (np.fmin, np.fmax)
    )
    moves = np.fmin.reduce(low) < np.fmax.reduce(high)
    unit = np.where(moves, np.fmax.reduce(np.fmax(high - mean, mean - low)), 1.0)
    squares = [np.nansum(((y - mean) / unit) ** 2, axis=0) for y in outputs]
    root = np.sqrt(np.sum(squares, axis=0))
    size = np.where(moves, unit * root / np.sqrt(known), 1.0)
    return size, np.where(moves, np.sqrt(known), 0.0)


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
    squares = np.zeros(model.n_outputs)
    for inputs, y in measured.stacked():
        length, u = len(inputs), delayed(inputs, sampled.input_delay)
        x = state_trajectory(
            sampled.A, np.tensordot(u, sampled.B, (1, 1)).swapaxes(1, 2)
        )
        free = unknown_responses(sampled, length, trend_signals(length, n_trend))
        errors = y - (sampled.C @ x + sampled.D @ u).transpose(1, 2, 0)
        own = estimate_initial_state(free, errors.transpose(2, 0, 1), measured.size)
        errors -= own.T @ free.transpose(1, 2, 0)
        errors /= measured.size[:, None, None]
        squares += np.nansum(errors**2, axis=(1, 2))
    return fit_of_norms(np.sqrt(squares), measured.spread)


def _integrates(model: StateSpace) -> bool:
    rates = np.abs(model.poles())
    return bool(rates.min(initial=1.0) <= _ABOUT_ZERO * rates.max(initial=0.0))
