"""Starts for slow dynamics: models of low-passed records sampled less often.

Sampled a few hundred times faster than the system moves, records of a system differ so
little from sample to sample that the longest horizon that is affordable spans next to
nothing of its motion, and noise decides on the subspace. A filter F of all channels
commutes with the dynamics, ``F y = G (F u)``, and what it leaves of the samples is told
by every k-th of them, whose horizon spans k times as much. Of the eigenvalues z of
their state matrix the k-th roots are those of the records,

    ``A_k = V diag(z) V^-1``, ``A = V diag(z^(1/k)) V^-1``,

the principal ones, for faster oscillations do not pass the filter. Between samples the
input is held at the full rate only: B and D are those of the samples of the records,
and the refinement takes the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray
from scipy import linalg

from ..samples.records import Record
from ..simulation_error.simulation_fit import Realization, simulation_fit
from .identification import Settings, realize, subspaces_of
from .realization import Subspace

Array = NDArray[np.float64]

# Horizon of decimated records, and height of their Hankel matrix, at most.
_HORIZON, _MAX_ROWS = 40, 400

# Edge of the filter relative to the new Nyquist frequency, and its taps by the factor:
# what is above that frequency is weaker by a factor of several hundred.
_EDGE, _TAPS = 0.6, 8

_BETTER = 0.95  # of the loss at one factor: that of the next, or no further is tried

# A mode that one step of a decimated record leaves less of is as good as gone, and one
# that changes sign from step to step, at the edge of what is seen, alike.
_GONE = 1e-6

_MAX_CONDITION = 1e10  # of eigenvectors, beyond which they have no digits


class _Decimated(NamedTuple):
    """Records sampled less often, and their subspace."""

    records: list[Record]
    subspace: Subspace
    highest: int  # order


class SlowStarts:
    """Models of records that begin with decimated ones, of orders up to the highest."""

    def __init__(
        self, records: Sequence[Record], highest: int, settings: Settings
    ) -> None:
        self._records = records
        self._highest = highest
        self._settings = settings
        self._known: dict[int, _Decimated | None] = {}

    def best(self, order: int, factor: int = 2) -> Realization | None:
        """Not yet refined; by the factor, the least or more, that suits the order."""
        best = None
        while (model := self._start(order, factor)) is not None:
            if best is not None and not model.loss < _BETTER * best.loss:
                break
            best, factor = model, 2 * factor
        return best

    def _start(self, order: int, factor: int) -> Realization | None:
        """From records decimated by a factor; None if these do not show the order."""
        found = self._decimated(factor) if order else None
        if found is None or order > found.highest:
            return None
        slow = realize(found.subspace, found.records, order, self._settings)
        A = full_rate(slow.A, factor)
        if A is None:
            return None
        return simulation_fit(A, slow.C, self._records, self._settings.free)

    def _decimated(self, factor: int) -> _Decimated | None:
        """Records of every so many samples; none where too few of these are left."""
        if factor not in self._known:
            self._known[factor] = self._decimate(factor)
        return self._known[factor]

    def _decimate(self, factor: int) -> _Decimated | None:
        records = decimated(self._records, factor)
        if not records:
            return None
        settings, height = self._settings, 2 * sum(self._settings.free.direct.shape)
        lengths = [record.n_samples for record in records]
        if settings.too_few(lengths):
            return None
        room = settings.max_horizon(lengths)
        horizon = min(_HORIZON, max(2, _MAX_ROWS // height), room)
        highest = min(self._highest, settings.max_order(horizon))
        width = min(highest + settings.n_noise_states, settings.max_order(horizon))
        spaces = subspaces_of(records, {horizon: width}, settings)
        return _Decimated(records, spaces[horizon], highest)


def decimated(records: Sequence[Record], factor: int) -> list[Record]:
    """Every so many samples of low-passed records, without those at their ends.

    What a record of zeros was before its first sample and after its last would bend
    those. Records that are too short for the filter are left out.

    >>> ramp = Record.of(np.arange(100.0)[:, None], np.ones((100, 1)))
    >>> slow = decimated([ramp], 4)[0]
    >>> slow.u.round(9)[0, :3], slow.y.round(9)[0, :3]
    (array([16., 20., 24.]), array([1., 1., 1.]))
    """
    n_taps = _TAPS * factor + 1
    filter_ = scipy.signal.firwin(n_taps, _EDGE / factor)
    out = []
    for record in records:
        n_samples = record.n_samples
        if n_samples >= n_taps + factor:
            whole = slice(_TAPS, (n_samples - 1) // factor + 1)
            u, y = (
                scipy.signal.upfirdn(filter_, z, down=factor, axis=1)[:, whole]
                for z in (record.u, record.y)
            )
            out.append(Record.of(u.T, y.T, len(record.trend)))
    return out


def full_rate(A: Array, factor: int) -> Array | None:
    """State matrix of single steps, by that of so many steps at a time.

    None where its eigenvectors have no digits.

    >>> A = np.array([[0.9, 0.2], [-0.2, 0.9]])
    >>> full_rate(np.linalg.matrix_power(A, 4), 4).round(12)
    array([[ 0.9,  0.2],
           [-0.2,  0.9]])
    """
    if A.size == 0:
        return A
    values, vectors = np.linalg.eig(A)
    if not np.linalg.cond(vectors) < _MAX_CONDITION:
        return None
    gone = (np.abs(values) < _GONE) | ((values.imag == 0.0) & (values.real < 0.0))
    values = np.where(gone, _GONE, values).astype(complex)
    roots = np.exp(np.log(values) / factor)
    found = linalg.solve(vectors.T, (vectors * roots).T, check_finite=False).T
    return np.ascontiguousarray(found.real)
