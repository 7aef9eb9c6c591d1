"""The criterion of orders: how likely a model is, and what its parameters cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray

from ...systems.simulation import estimate_initial_state, free_responses
from ..samples.records import Record
from .noise import autoregression, taper, whitening_filter
from .simulation_fit import Freedom, Realization, simulation_errors

# Of a parameter, in squared standard deviations of its estimate: two of them. Akaike's
# price of 2 takes a superfluous state in one fit of ten, Schwarz's of log(n) leaves
# out states of a few thousand noisy samples that would improve the simulation.
PRICE = 4.0

# Samples of the longest experiment for each lag of the noise: in short ones initial
# states are why errors correlate.
_SAMPLES_PER_LAG = 16

EXACT = 1e-18  # share of the outputs' energy (an error of 1e-9) that is rounding


def criterion_of(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    repeated: Sequence[float] = (),
) -> float:
    """Likelihood and number of parameters of a model of records, whitened or not.

    Minus twice the logarithm of the likelihood, and the price of the parameters with
    the correction that a ratio of sums of squares in few samples needs. The errors that
    a model leaves tell the noise of every output anew: by that of the model before,
    states that follow slow noise would prove themselves right.

    Of errors that are mostly rounding a share, of every output, repeats those before:
    they are no noise of a memory, and tell as much as the others do alone. States may
    follow them in every part of a record whose inputs repeat themselves.
    """
    ny = len(model.C)
    n_values = sum(record.n_values for record in records)
    n_samples, n_free = n_values // ny, n_parameters(len(model.A), records, free)
    few = n_values / max(n_values - n_free, 1)
    if not np.isfinite(model.loss):
        return np.inf
    # Of many lines of a spectrum one stands out by chance: an oscillation may be any of
    # as many as its decay tells apart, and costs what the best of them gains.
    longest = max(record.n_samples for record in records)
    poles = np.linalg.eigvals(model.A)
    decay = np.maximum(1.0 - np.abs(poles[poles.imag > 0.0]), 2.0 / longest)
    misfit = -2.0 * float(np.log(decay).sum())
    misfit += few * PRICE * n_free
    told = 1.0 - np.array(repeated or np.zeros(ny))
    lags = np.where(told < 1.0, 0, longest // _SAMPLES_PER_LAG)
    noise = _innovations(model, records, free, lags)
    for i, (variance, n_lags) in enumerate(noise):
        power = sum(float(record.y[i] @ record.y[i]) for record in records) / n_samples
        variance = max(variance, EXACT * power) or 1.0
        misfit += told[i] * n_samples * np.log(variance) + PRICE * n_lags
    return float(misfit)


def n_parameters(order: int, records: Sequence[Record], free: Freedom) -> int:
    """Of a model of that order, and unknowns of the records of their own."""
    ny, m = free.direct.shape
    own = len(records) * free.n_own(order)
    return order * (m + ny) + int(free.direct.sum()) + own


def _innovations(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    highest: NDArray[np.intp],
) -> list[tuple[float, int]]:
    """Variance and number of lags of the noise of every output, up to the highest.

    The own unknowns are those that make the least of the innovations: of slow noise,
    what makes the least of the errors leaves large ones in the first samples. These,
    and the last, count for less: a transient that an experiment begins with tells of
    modes, and next to nothing of how they answer to the inputs.
    """
    errors = simulation_errors(model, records)
    first = len(model.A) - free.n_states(len(model.A))
    filters, sizes = [], []
    for i in range(len(model.C)):
        parts = [error[:, [i]] for error in errors]
        noise = autoregression(parts, highest=int(highest[i]))
        filters.append(whitening_filter(noise))
        sizes.append(np.sqrt(noise.covariance[0, 0]) or 1.0)
    lost, squares = max(map(len, filters)) - 1, np.zeros(len(sizes))
    n_samples = np.zeros(len(sizes))
    for record, error in zip(records, errors, strict=True):
        if len(error) <= 2 * lost:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            unknown = free_responses(model.A, model.C, len(error), record.trend)
        unknown = unknown[:, :, first:]
        unknown = unknown[:, :, np.isfinite(unknown).all(axis=(0, 1))]
        signals = np.concatenate([error[:, :, None], unknown], axis=2)
        for i, (f, size) in enumerate(zip(filters, sizes, strict=True)):
            signals[:, i] = scipy.signal.lfilter(f, size, signals[:, i], axis=0)
        weights = taper(len(error))[lost:]
        signals = signals[lost:] * weights[:, :, None]
        white, unknown = signals[:, :, 0], signals[:, :, 1:]
        white = white - unknown @ estimate_initial_state(unknown, white)
        squares += (white**2).sum(axis=0)
        # What is expected of missing ones leaves the squares of the others, on average.
        n_samples += (weights**2 * record.known[lost:]).sum(axis=0)
    n_samples[n_samples == 0.0] = 1.0  # of an output that is not known
    variances = np.array(sizes) ** 2 * squares / n_samples
    return [(float(v), len(f) - 1) for v, f in zip(variances, filters, strict=True)]
