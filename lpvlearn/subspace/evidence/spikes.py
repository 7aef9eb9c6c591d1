"""Single errors that stand out of the others, as a sensor makes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.beginnings import moves_of
from ..simulation_error.simulation_fit import simulation_errors
from .residuals import MUCH_OF_OUTPUT
from .statistics import Evidence

Array = NDArray[np.float64]

# Times what half of the errors stay within, from which one is a spike: 8 standard
# deviations of Gaussian noise.
_SPIKE = 12.0

# Spikes are told that make much of the errors and are few: others may be what the noise
# is.
_MUCH_OF_SPIKES = 0.25  # of the squared errors, at least
_FEW = 0.05  # of the samples, at most

# Spikes follow the inputs of which most come soon after a move, though few samples do.
_SOON = 4  # samples after a move
_SELDOM = 0.3  # of all samples are soon after one, at most
_MOSTLY = 0.7  # of the spikes are, at least


class Spikes(NamedTuple):
    """Errors of one output that stand out of the others."""

    output: int
    experiment: int  # of the highest of them
    sample: int  # in that experiment
    n_found: int
    share: float  # of the squared errors of the output
    follow: bool  # most of them moves of the inputs, which move seldom


def find_spikes(evidence: Evidence) -> Spikes | None:
    """Errors of single samples that make much of those of an output, if any do.

    They stand out of the line between their neighbours, near which coloured noise and
    what a model lacks stay.
    """
    whole = evidence.one_step
    if len(whole.model.initial_states) != len(whole.records):
        return None  # of samples that are not kept
    errors = simulation_errors(whole.model, whole.records)
    if not all(np.isfinite(e).all() for e in errors):
        return None
    bends = [np.zeros_like(e) for e in errors]  # none at the ends of experiments
    looked_at = [record.known.copy() for record in whole.records]
    for bend, e, known in zip(bends, errors, looked_at, strict=True):
        bend[1:-1] = np.abs(e[1:-1] - 0.5 * (e[:-2] + e[2:]))
        known[1:-1] &= known[:-2] & known[2:]
    size, ends = np.vstack(bends), np.cumsum([len(e) for e in errors])
    known = np.vstack(looked_at)
    if not known.any(axis=0).all():
        return None
    large = _SPIKE * size >= size.max(axis=0)
    if known.all() and (large.mean(axis=0) > 0.5).all():  # the usual case
        return None
    middle = [np.median(column[at]) for column, at in zip(size.T, known.T, strict=True)]
    peaks = (size >= np.roll(size, 1, axis=0)) & (size >= np.roll(size, -1, axis=0))
    size *= known & peaks & (size > _SPIKE * np.array(middle))
    count, taken = np.sum(size > 0.0, axis=0), np.sum(size**2, axis=0)
    total = sum((e**2).sum(axis=0) for e in errors)
    power = sum((record.y**2).sum(axis=1) for record in whole.records)
    share = taken / np.where(total > MUCH_OF_OUTPUT**4 * power, total, np.inf)
    share[count > _FEW * len(size)] = 0.0
    output = int(np.argmax(share))
    if not share[output] > _MUCH_OF_SPIKES:
        return None
    at = int(np.argmax(size[:, output]))
    k = int(np.searchsorted(ends, at, side="right"))
    sample = at - (int(ends[k - 1]) if k else 0)
    most = min(float(share[output]), 1.0)
    after = np.concatenate([_after_moves(record.u) for record in evidence.records])
    follow = after.mean() < _SELDOM and after[size[:, output] > 0.0].mean() > _MOSTLY
    return Spikes(output, k, sample, int(count[output]), most, bool(follow))


def _after_moves(u: Array) -> NDArray[np.bool_]:
    """Which samples come soon after inputs (n_inputs, n_samples) move."""
    after = np.zeros(u.shape[1], dtype=bool)
    for k in moves_of(u.T) + 1:
        after[k : k + _SOON] = True
    return after
