r"""Level shifts: steps of a load or of a sensor within an experiment.

What steps at an input or at an output without a sample that tells of it is no noise of
a spectrum: a slow mode, which simulates other records by what it made up, explains it
better than any. With the VARX of `varx` as ``P(q) z = w``, ``z = [u; y]``, a channel
that stands higher by d from sample k on leaves

.. math:: w_t = d \sum_{l \le t - k} P_l e_j + \text{white noise},

and one that a sensor got wrong for a sample ``d P_{t-k} e_j``. The most probable of all
these is taken out of the samples, and looked for again, as long as it stands out (Chen
and Liu, 1993). A regression on the past cannot follow a step before it happens, however
many states it has, so that nothing hides these.

A plant that is not linear answers to steps of its inputs by shifts of its own. Those
are left alone: where the inputs have just moved more than they do on average.

References
----------
C. Chen and L.-M. Liu, "Joint estimation of model parameters and outlier effects in time
series", Journal of the American Statistical Association 88, 1993.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray

from ...data.preparation import Pairs
from ..closed_loop.varx import Regression, regression_of, samples_of
from ..evidence.constants import shifts_matter
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples
from ..samples.records import Record
from ..telling import in_experiment

Array = NDArray[np.float64]

# Standard deviations that a shift is above zero: of a thousand normal numbers one is
# in a record of 150. The criterion of the models has the last word.
_STANDS_OUT = 4.5

_MOST = 20  # changes looked for: more of them are what the noise is

# Share of the inputs' motion in the past of the VARX, by that of any such window, from
# which a shift may be the plant's answer to it.
_MOVED = 3.0

_LEAST = 0.1  # of the energy of a shift, that a constant of the record does not take

# Samples after the first past of a record in which its start may still be felt, and
# between two shifts that are told apart (no fewer than the past).
_START, _APART = 20, 10

_ABOUT = 5  # samples to either side of a shift in which it may have begun

_OF_NORMAL = 0.6745  # median magnitude of a normal number
_ROUNDING = 1e-5  # innovations of scaled outputs that are no noise


class _Change(NamedTuple):
    """What stands out of the innovations."""

    statistic: float
    record: int
    sample: int
    channel: int
    size: float
    lasts: bool


def find_shifts(
    records: Sequence[Record], regression: Regression | None
) -> list[list[int]]:
    """Samples of every record at which levels shift; `regression` is that of records.

    None of any record where there are too many of them to be single events.
    """
    found: list[list[int]] = [[] for _ in records]
    if regression is None:
        return found
    samples, past = samples_of(records, 1), len(regression) - 1
    m = len(records[0].u)
    for _ in range(_MOST):
        change = max(
            (_most_probable(z, regression, k) for k, z in enumerate(samples)),
            key=lambda one: abs(one.statistic),
        )
        if not abs(change.statistic) > _STANDS_OUT:
            break
        _, record, k, channel, size, lasts = change
        z = samples[record] = samples[record].copy()
        z[k : None if lasts else k + 1, channel] -= size
        apart = max(_APART, len(regression) - 1)
        if lasts and all(abs(k - other) > apart for other in found[record]):
            found[record].append(k)
        again = regression_of([Record.of(z[:, :m], z[:, m:], 1) for z in samples])
        if again is None:
            break
        regression = again
    else:
        return [[] for _ in records]
    return [
        sorted(k for k in shifts if not _has_moved(record.u, k, past))
        for record, shifts in zip(records, found, strict=True)
    ]


def _has_moved(u: Array, k: int, past: int) -> bool:
    """Whether inputs (n_inputs, n_samples) moved much in the samples up to k."""
    moves = np.diff(u, axis=1, prepend=u[:, :1]) ** 2
    recent = moves[:, max(0, k - past) : k + 1].mean(axis=1)
    return bool((recent > _MOVED * moves.mean(axis=1)).any())


def _most_probable(z: Array, regression: Regression, record: int) -> _Change:
    """The change of one channel (n_samples, n_channels) that stands out most."""
    past, n = len(regression) - 1, len(z)
    best = _Change(0.0, record, 0, 0, 0.0, True)
    if n <= 4 * past + _START + _APART:
        return best
    w = sum(z[past - k : n - k] @ P.T for k, P in enumerate(regression))
    w -= w.mean(axis=0)
    size = np.maximum(np.median(np.abs(w), axis=0) / _OF_NORMAL, _ROUNDING)
    w /= size
    for channel in range(z.shape[1]):
        effect = regression[:, :, channel] / size
        for lasts in (True, False):
            if not lasts and channel < z.shape[1] - w.shape[1]:
                continue
            shape = np.cumsum(effect, axis=0) if lasts else effect
            t, d = _statistics(w, shape, lasts)
            # Slow motions that the regression leaves spread the statistics of all.
            t /= max(1.0, float(np.median(np.abs(t))) / _OF_NORMAL)
            t[: past + _START] = t[n - past - _APART :] = 0.0
            k = int(np.argmax(np.abs(t)))
            if abs(t[k]) > abs(best.statistic):
                best = _Change(
                    float(t[k]), record, k + past, channel, float(d[k]), lasts
                )
    return best


def _statistics(w: Array, shape: Array, lasts: bool) -> tuple[Array, Array]:
    """Of a shape (n_terms, n_outputs) that begins at every sample of white noise.

    How many standard deviations it is above zero, and its size. With `lasts` its last
    term goes on to the end; a constant of the record is projected out.
    """
    n, n_terms = len(w), len(shape)
    shape = shape[:n]
    ends = np.minimum(np.arange(n, 0, -1), len(shape))  # terms within the record
    score = sum(
        scipy.signal.correlate(w[:, i], shape[:, i])[len(shape) - 1 :]
        for i in range(w.shape[1])
    )
    energy = np.cumsum((shape**2).sum(axis=1))[ends - 1]
    mean = np.cumsum(shape, axis=0)[ends - 1]
    if lasts and n > n_terms:
        rest = np.zeros((n, w.shape[1]))
        rest[: n - n_terms] = np.cumsum(w[::-1], axis=0)[::-1][n_terms:]
        score = score + rest @ shape[-1]
        n_rest = np.maximum(np.arange(n, 0, -1) - n_terms, 0)
        energy = energy + n_rest * float(shape[-1] @ shape[-1])
        mean = mean + n_rest[:, None] * shape[-1]
    own = energy - (mean**2).sum(axis=1) / n
    known = own > _LEAST * energy
    own = np.where(known & (own > 0.0), own, np.inf)
    return score / np.sqrt(own), score / own


def cut_at(pairs: Pairs, shifts: Sequence[Sequence[int]]) -> Pairs:
    """Experiments that end before levels shift, and begin anew after that.

    Where a load shifts is known to some samples: one at the end of an experiment would
    be taken for a mode that grows.

    >>> u = np.zeros((60, 1))
    >>> [len(part) for part, _ in cut_at([(u, u), (u, u)], [[20, 50], []])]
    [15, 20, 5, 60]
    """
    return [
        (u[start:stop], y[start:stop])
        for (u, y), cuts in zip(pairs, shifts, strict=True)
        for start, stop in zip(
            [0, *(k + _ABOUT for k in cuts)],
            [*(k - _ABOUT for k in cuts), len(u)],
            strict=True,
        )
        if stop > start
    ]


def without_shifts(samples: Samples, whole: LocalFit) -> tuple[Samples, LocalFit]:
    """Cut the experiments where levels shift, if that explains them clearly better.

    One step ahead, where noise alone explains all that moves slowly: parts that leave
    inputs nothing to explain, or models of a given order, whose errors may be its lack
    of states, must simulate as much of what is held out as the whole.
    Short ones hide in their initial states that a mode would grow.
    """
    (pairs, choices, telling), feedback = samples, whole.feedback
    # The errors of a rough model are not the noise that shifts must stand out of.
    asked = choices.offset == "auto" and choices.initial_states and choices.refine
    if not asked or choices.estimated or feedback is None:
        return samples, whole
    records, regression = whole.scaled.records, feedback.regression
    channels = len(records[0].u) + len(records[0].y)
    if regression is not None and regression.shape[2] != channels:
        regression = regression_of(records)  # levels were no input beside constants
    shifts = find_shifts(records, regression)
    if not any(shifts):
        return samples, whole
    parts = cut_at(pairs, shifts)
    rests = np.all([np.ptp(u, axis=0) == 0.0 for u, _ in parts], axis=0)
    if rests.any():  # an input tells nothing of any part: its step made the shift
        return samples, whole
    cut = samples._replace(pairs=parts)
    fitted = cut.tried(1, whole)
    if fitted is None:
        return samples, whole
    if not shifts_matter(whole.evidence.one_step, fitted.evidence.one_step):
        return samples, whole
    if fitted.grows() and not whole.grows():
        return samples, whole
    given = choices.order is not None
    if whole.selection.order and (given or not fitted.selection.order):
        held_out = cut.errors_held_out(fitted), samples.errors_held_out(whole)
        if held_out[0].bft < held_out[1].bft:
            return samples, whole
    where = "; ".join(
        in_experiment(", ".join(map(str, cuts)), k, len(pairs))
        for k, cuts in enumerate(shifts)
        if cuts
    )
    telling.once(
        "shifts",
        f"The outputs shift at sample(s) {where}, counted from 0, by what the inputs "
        "do not explain: a load came or went, a sensor moved, or the system is not "
        "linear. What lies between was fitted as experiments of their own, each with "
        "its constant (`output_offset_`). Give a load that you know as an input; "
        "offset='constant' or None fits the whole.",
    )
    return cut, fitted
