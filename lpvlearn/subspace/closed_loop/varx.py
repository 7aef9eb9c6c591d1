r"""Vector autoregression of the outputs (VARX).

Without a model, and without assuming that the inputs do not know the noise, the outputs
are regressed on the last samples of all channels:

.. math:: y_t = \sum_{l=1}^{p} M_l z_{t-l} + D u_t + e_t, \qquad z_t = [u_t; y_t].

Constants of the experiments, and drifts, are regressors too, projected out of all rows.
Everything follows from the triangular factor of one Hankel matrix. In the columns
beyond those of some first rows stand the other rows less what the first explain: of
rows ordered from the newest sample to the oldest, the residuals for every p.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...systems.least_squares import scaled_lstsq
from ..samples.hankel import hankel_factor, without_trend
from ..samples.records import Record, thinned

Array = NDArray[np.float64]

Regression = Array  # (past + 1, n_outputs, n_inputs + n_outputs): P of ``P(q) z = w``

# Samples per regressor of the longest past window that is tried: beyond that the small
# sample term of the criterion exceeds what any lag could gain.
_SAMPLES_PER_REGRESSOR = 4

# Part of an output's energy below which innovations are rounding: added to their
# variance, it makes criteria stop where nothing but rounding is left to explain.
NO_INNOVATION = 1e-16

# What the feedback is looked for in: so many samples of at most so many rows, and so
# many future samples of every input, on which controllers answer.
_MAX_SAMPLES, MAX_ROWS, N_FUTURE = 10_000, 120, 8

# Part of a future input that the past does not explain, below which it is known
# beforehand: sines, or values that are held.
FORESEEN = 1e-3

DEPENDENT = 1e-9  # part of a regressor below which it is rounding


def samples_of(records: Sequence[Record], least: int = 0) -> list[Array]:
    """Rows ``[u, y]`` of every record, less its trends, of which there be `least`."""
    return [
        without_trend(
            np.ascontiguousarray(np.vstack((record.u, record.y)).T),
            max(least, len(record.trend)),
        )
        for record in records
    ]


def n_windows(records: Sequence[Record], past: int) -> int:
    """Samples that have `past` others of their experiment before them.

    Less one for each of its trends, which are projected out of all channels.
    """
    return sum(
        max(0, record.n_samples - past - len(record.trend)) for record in records
    )


def longest_past(records: Sequence[Record], most_rows: int, ahead: int = 0) -> int:
    """Longest past window that the records can carry; 0 where there is none.

    `ahead` future samples of every input are regressed on too.
    """
    m, ny = len(records[0].u), len(records[0].y)
    past = 0
    while past * (m + ny) < most_rows:
        n_regressors = (past + 1) * (m + ny) + (1 + ahead) * m
        if n_windows(records, past + 1 + ahead) < _SAMPLES_PER_REGRESSOR * n_regressors:
            break
        past += 1
    return past


def past_window(
    records: Sequence[Record], shortest: int, longest: int, direct: NDArray[np.bool_]
) -> int:
    """Number of past samples that the VARX needs, by Akaike's criterion.

    `direct` (n_inputs,) are the inputs that act at once. Truncating the past is a bias,
    whence the most generous of the criteria, corrected for small samples (Hurvich and
    Tsai, 1993).
    """
    c = len(records[0].u) + len(records[0].y)
    factor = _newest_first(records, longest, 0)
    n = n_windows(records, longest)
    return _chosen_past(factor[-c:], n, shortest, longest, direct)


def regression_of(records: Sequence[Record]) -> Regression | None:
    """The VARX of samples, of as long a past as they need; None for too few."""
    whole = Past.of(records, 0)
    return None if whole is None else coefficients_of(whole)


def direct_terms(records: Sequence[Record]) -> tuple[Array, Array] | None:
    """D of the VARX of samples, and its standard deviations.

    None for too few samples, or inputs that follow from the past.
    """
    whole = Past.of(records, 0)
    if whole is None:
        return None
    m, ny = len(whole.records[0].u), len(whole.records[0].y)
    rows = whole.present[: m + ny]
    past = basis_of(whole.before, whole.before, DEPENDENT)
    left = rows - (rows @ past) @ past.T
    known = basis_of(left[:m], rows[:m], FORESEEN)
    if known.shape[1] < m:
        return None
    D = scaled_lstsq(left[:m].T, left[m:].T, DEPENDENT)[0].T
    noise = np.sum((left[m:] - D @ left[:m]) ** 2, axis=1)
    noise /= max(whole.n_windows - past.shape[1] - m, 1)
    spread = np.diag(np.linalg.inv(left[:m] @ left[:m].T))
    return D, np.sqrt(np.outer(noise, spread))


class Past(NamedTuple):
    """Rows of a factor of samples with as long a past as they need."""

    records: list[Record]
    before: Array  # of so many samples as are `needed` of the past, newest first
    present: Array  # of the samples themselves, and of future inputs
    needed: int
    longest: int  # past that was tried
    n_windows: int

    @classmethod
    def of(cls, records: Sequence[Record], ahead: int) -> Past | None:
        """That of records, and of so many future inputs; None for too few samples."""
        records = _some(records)
        m, c = len(records[0].u), len(records[0].u) + len(records[0].y)
        longest = longest_past(records, MAX_ROWS - N_FUTURE * m, N_FUTURE)
        if longest == 0:
            return None
        factor = _newest_first(records, longest, ahead)
        present, n = factor[longest * c :], n_windows(records, longest + ahead)
        needed = _chosen_past(present[:c], n, 1, longest, np.ones(m, dtype=bool))
        return cls(records, factor[: needed * c], present, needed, longest, n)


def coefficients_of(past: Past) -> Regression:
    """P of the innovations."""
    m, ny = len(past.records[0].u), len(past.records[0].y)
    u, y = np.split(past.present[: m + ny], [m])
    known = np.vstack([u, past.before])
    direct, before = np.split(scaled_lstsq(known.T, y.T, DEPENDENT)[0], [m])
    P = np.zeros((past.needed + 1, ny, m + ny))
    P[0] = np.hstack([-direct.T, np.eye(ny)])
    P[1:] = -before.reshape(past.needed, m + ny, ny).swapaxes(1, 2)
    return P


def _some(records: Sequence[Record]) -> list[Record]:
    """Records to look at, with constants."""
    return [
        record if len(record.trend) else Record.of(record.u.T, record.y.T, 1)
        for record in thinned(records, _MAX_SAMPLES)
    ]


def _newest_first(records: Sequence[Record], past: int, ahead: int) -> Array:
    """Factor of ``z[t-1], ..., z[t-past], z[t], u[t+1], ..., u[t+ahead]``."""
    m, c = len(records[0].u), len(records[0].u) + len(records[0].y)
    lags = np.arange((past + 1 + ahead) * c).reshape(-1, c)
    rows = [lags[:past][::-1], lags[past], lags[past + 1 :, :m]]
    flat = np.concatenate([part.ravel() for part in rows])
    samples, n_trend = samples_of(records), len(records[0].trend)
    return hankel_factor(samples, past + 1 + ahead, flat, n_trend=n_trend)


def _chosen_past(
    present: Array,
    n: int,
    shortest: int,
    longest: int,
    direct: NDArray[np.bool_],
) -> int:
    """The past window, from the rows of ``z[t]`` in a factor of the newest first."""
    m, c = len(direct), len(present)
    ny = c - m
    size = np.linalg.norm(present, axis=1, keepdims=True)
    scaled = present / np.where(size > 0.0, size, 1.0)
    acting = np.append(np.flatnonzero(direct), np.arange(m, c))
    n_direct = int(direct.sum())
    best, found = np.inf, longest
    for past in range(shortest, longest + 1):
        left = scaled[acting, past * c :]
        spread = left @ left.T + NO_INNOVATION * np.eye(len(left))
        volume = np.linalg.slogdet(spread)[1]
        with np.errstate(invalid="ignore"):  # inf - inf of inputs that are dependent
            volume -= np.linalg.slogdet(spread[:n_direct, :n_direct])[1]
        n_regressors = n_direct + past * c
        n_parameters = ny * n_regressors + ny * (ny + 1) / 2
        penalty = 2.0 * n_parameters * n / max(n - n_regressors - ny - 1, 1)
        value = n * volume + penalty
        if value < best:
            best, found = value, past
    return found


def basis_of(rows: Array, whole: Array, least: float) -> Array:
    """Orthonormal columns that span rows, those left out of which less remains.

    `whole` are the rows before anything was taken from them.
    """
    size = np.linalg.norm(whole, axis=1)
    kept = np.linalg.norm(rows, axis=1) > least * size
    if not kept.any():
        return np.zeros((rows.shape[1], 0))
    scaled = rows[kept] / size[kept, None]
    Q, R, _ = linalg.qr(scaled.T, mode="economic", pivoting=True, check_finite=False)
    return Q[:, np.abs(np.diagonal(R)) > least]
