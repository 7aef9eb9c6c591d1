"""Parts of records to estimate from, and the simulation error on what is held out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .signals import Record
from .simulation import lti_response
from .simulationfit import Realization

Array = NDArray[np.float64]

_ESTIMATION_SHARE = 0.7
_N_BLOCKS = 20


def split_record(record: Record) -> tuple[Record, int]:
    """First part of a record, for estimation, and its length."""
    n = record.u.shape[1]
    cut = n if n < 8 else int(np.ceil(_ESTIMATION_SHARE * n))
    return Record(record.u[:, :cut].copy(), record.y[:, :cut].copy()), cut


def thin_records(records: Sequence[Record], n_samples: int) -> list[Record]:
    """Evenly spread experiments of about `n_samples` in total, at least one.

    Experiments beyond that length are cut to it.

    Examples
    --------
    >>> import numpy as np
    >>> runs = [Record(np.zeros((1, n)), np.zeros((1, n))) for n in (50, 40, 60, 70)]
    >>> [run.u.shape[1] for run in thin_records(runs, 120)]
    [50, 60]
    """
    lengths = [record.u.shape[1] for record in records]
    keep = max(1, min(len(records), int(n_samples * len(records) / sum(lengths))))
    spread = [i * len(records) // keep for i in range(keep)]
    return [
        Record(
            np.ascontiguousarray(records[i].u[:, :n_samples]),
            np.ascontiguousarray(records[i].y[:, :n_samples]),
        )
        for i in spread
    ]


def held_out_errors(
    model: Realization, records: Sequence[Record], cuts: Sequence[int]
) -> tuple[Array, float]:
    """Simulation errors after the cuts.

    Parameters
    ----------
    model : Realization
        Identified on the parts before the cuts, with their initial states.
    records : sequence of Record
        Whole records.
    cuts : sequence of int
        Where the held-out part of each begins.

    Returns
    -------
    blocks : ndarray of shape (n_blocks,)
        Sums of squared errors over consecutive blocks of time.
    bft : float
        Best fit over the held-out parts, percent, the mean over outputs.
    """
    blocks, errors, outputs = [], [], []
    for record, cut, x0 in zip(records, cuts, model.initial_states, strict=True):
        if cut == record.u.shape[1]:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            fitted = lti_response(model.A, model.B, model.C, model.D, record.u.T, x0)
        error = record.y.T[cut:] - fitted[cut:]
        errors.append(error)
        outputs.append(record.y.T[cut:])
        n_blocks = min(_N_BLOCKS, len(error))
        blocks += [float((b**2).sum()) for b in np.array_split(error, n_blocks)]
    if not errors:
        return np.zeros(0), np.nan
    error, output = np.vstack(errors), np.vstack(outputs)
    spread = np.sqrt(((output - output.mean(axis=0)) ** 2).sum(axis=0))
    spread[spread == 0.0] = 1.0
    miss = np.sqrt((error**2).sum(axis=0)) / spread
    bft = 100.0 * float(np.maximum(1.0 - miss, 0.0).mean())
    return np.array(blocks), bft if np.isfinite(bft) else 0.0
