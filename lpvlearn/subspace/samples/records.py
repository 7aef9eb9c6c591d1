"""Records: what fits see of experiments, scaled, centred, and cut to what is needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...data.preparation import Pairs
from ...systems.simulation import trend_signals

Array = NDArray[np.float64]

# Averages over the record are known to a percent or so from this many samples.
_MAX_SAMPLES = 30_000

FOR_A_CHOICE = 12_000  # samples: it needs fewer than an estimate

# Mean of an input in standard deviations, beyond which it is subtracted to keep digits.
# Nearer to zero it stays: with an integrator in the model it tells something.
_FAR = 100.0


class Record(NamedTuple):
    """Samples of one experiment, one row per channel."""

    u: Array  # (n_inputs, n_samples)
    y: Array  # (n_outputs, n_samples)
    trend: Array = np.zeros((0, 0))  # (n_trend, n_samples), free in every output
    # (n_outputs, n_samples): outputs that were missing, and are estimates; empty: none
    missing: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)
    n_later: int = 0  # samples of the experiment that come after these

    @classmethod
    def of(cls, u: Array, y: Array, n_trend: int = 0) -> Record:
        """The record of samples with one row per time instant, rows contiguous."""
        trend = trend_signals(len(u), n_trend)
        return cls(np.ascontiguousarray(u.T), np.ascontiguousarray(y.T), trend)

    @property
    def n_samples(self) -> int:
        """Number of time instants."""
        return self.u.shape[1]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Outputs that were there, (n_samples, n_outputs)."""
        if self.missing.size:
            return ~self.missing.T
        return np.broadcast_to(np.True_, self.y.shape[::-1])

    @property
    def n_values(self) -> int:
        """Number of outputs that were there."""
        return self.y.size - int(np.count_nonzero(self.missing))

    def part(self, samples: slice) -> Record:
        """Some of the samples, in memory of their own."""
        u, y, trend = (signals[:, samples].copy() for signals in self[:3])
        return Record(u, y, trend, self.missing[:, samples])

    def head(self, n_samples: int) -> Record:
        """The first samples, which know how many come after them."""
        head = self.part(slice(n_samples))
        later = self.n_later + self.n_samples - head.n_samples
        return head._replace(n_later=later)


def output_energy(records: Sequence[Record]) -> float:
    """Sum of squares of all outputs."""
    return sum(float((record.y**2).sum()) for record in records)


def share_known(records: Sequence[Record]) -> float:
    """Share of the outputs that were there."""
    return sum(r.n_values for r in records) / sum(r.y.size for r in records)


def shorten(records: Sequence[Record]) -> tuple[list[Record], float]:
    """Heads of the records, some 30,000 samples in total, and their share."""
    total = sum(record.n_samples for record in records)
    share = _MAX_SAMPLES / total
    if share >= 1.0:
        return list(records), 1.0
    parts = [r.head(max(2, int(share * r.n_samples))) for r in records]
    return parts, sum(record.n_samples for record in parts) / total


def thinned(records: Sequence[Record], n_samples: int = FOR_A_CHOICE) -> list[Record]:
    """Evenly spread experiments of about `n_samples` in total, at least one.

    Experiments beyond that length are cut to it.

    >>> runs = [Record(np.zeros((1, n)), np.zeros((1, n))) for n in (50, 40, 60, 70)]
    >>> [run.n_samples for run in thinned(runs, 120)]
    [50, 60]
    """
    lengths = [record.n_samples for record in records]
    keep = max(1, min(len(records), int(n_samples * len(records) / sum(lengths))))
    spread = [i * len(records) // keep for i in range(keep)]
    return [records[i].head(n_samples) for i in spread]


class ScaledRecords(NamedTuple):
    """Records with every channel scaled to unit root mean square."""

    records: list[Record]
    input_scale: Array
    output_scale: Array


def _root_mean_square(parts: Sequence[Array]) -> Array:
    """RMS of every column over all parts, safe against under- and overflow; 1 for 0."""
    peak = np.max([np.abs(part).max(axis=0) for part in parts], axis=0)
    peak[peak == 0.0] = 1.0
    energy = sum(((part / peak) ** 2).sum(axis=0) for part in parts)
    rms = peak * np.sqrt(energy / sum(len(part) for part in parts))
    rms[rms == 0.0] = 1.0
    return rms


def scale_records(
    experiments: Sequence[tuple[Array, Array]],
    n_trend: int = 0,
    estimated: Sequence[NDArray[np.bool_]] = (),
) -> ScaledRecords:
    """Scale all experiments (u, y), a row per sample, together.

    Which outputs are `estimated` is known of experiments that go on after these ends.
    """
    su = _root_mean_square([u for u, _ in experiments])
    sy = _root_mean_square([y for _, y in experiments])
    records = [Record.of(u / su, y / sy, n_trend) for u, y in experiments]
    for k, missing in enumerate(estimated[: len(records)]):
        record = records[k]
        records[k] = record._replace(missing=missing[: record.n_samples].T)
    return ScaledRecords(records, su, sy)


class Centres(NamedTuple):
    """What was subtracted from the samples of the experiments."""

    inputs: Array  # (n_experiments, n_inputs)
    trends: Array  # (n_experiments, n_trend, n_outputs)


def centred(pairs: Pairs, n_trend: int, initial_states: bool) -> tuple[Pairs, Centres]:
    """Take the trends out of the outputs, and far inputs to zero: digits are kept.

    A model with trends (and initial states, for inputs) of its own is not changed.
    """
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    moved: Pairs = []
    levels = np.zeros((len(pairs), n_inputs))
    trends = np.zeros((len(pairs), n_trend, n_outputs))
    for k, (u, y) in enumerate(pairs if n_trend else []):
        signals = trend_signals(len(u), n_trend).T
        trends[k] = linalg.lstsq(signals, y)[0]
        if initial_states:
            level = u.mean(axis=0)
            levels[k] = np.where(np.abs(level) > _FAR * u.std(axis=0), level, 0.0)
        moved.append((u - levels[k], y - signals @ trends[k]))
    return moved or pairs, Centres(levels, trends)
