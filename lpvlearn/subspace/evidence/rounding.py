"""Outputs that are rounded, to the steps of a sensor or of a converter.

Rounding to steps of q adds errors of variance q^2 / 12, which are white where an output
moves by several steps from sample to sample. A slow one stays on a step: its errors are
those of the samples before, and those that they repeat tell nothing new. They follow
from the inputs, and come again where these repeat themselves, in parts held out too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..samples.records import Record
from ..simulation_error.simulation_fit import Realization, simulation_errors

Array = NDArray[np.float64]

_ENOUGH = 30_000  # samples of an experiment that are looked at

# Steps in the range of an output that is said to be rounded; of this range, and of a
# step, what is rounding of the numbers themselves.
_FEW, _EQUAL, _SAME = 2_000, 1e-9, 1e-3

_MOSTLY = 2.0  # times the variance of rounding: most of such errors are that


class Rounding(NamedTuple):
    """What is known of outputs that are multiples of a step; zeros of the others."""

    variances: Array  # a twelfth of the steps, squared
    repeated: Array  # share of the samples that are those before

    @classmethod
    def of(cls, records: Sequence[Record]) -> Rounding:
        """That of the outputs, but for a constant in every record.

        >>> y = 0.5 * np.repeat(np.random.default_rng(0).permutation(100), 4)[:, None]
        >>> rounding = Rounding.of([Record.of(y, y)])
        >>> rounding.variances.round(6), rounding.repeated.round(2)
        (array([0.020833]), array([0.75]))
        """
        found = []
        for i in range(len(records[0].y)):
            known = [r.y[i, :_ENOUGH][r.known[:_ENOUGH, i]] for r in records]
            moving = [values for values in known if len(values) and np.ptp(values) > 0]
            step = min(map(_step, moving), default=0.0)
            n_moves = sum(int((np.abs(np.diff(v)) > 0.5 * step).sum()) for v in moving)
            n_samples = sum(map(len, moving))
            found.append((step**2 / 12.0, 1.0 - n_moves / n_samples if step else 0.0))
        return cls(*np.array(found).T)


def _step(values: Array) -> float:
    """Greatest step that the values are multiples of, but for a constant; or 0."""
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > _EQUAL * np.ptp(values)]
    if not 0 < len(gaps) < min(_FEW, len(values)) or gaps.sum() > _FEW * gaps.min():
        return 0.0
    multiples = np.round(gaps / gaps.min())
    step = float(gaps.sum() / multiples.sum())
    return step if (np.abs(gaps - step * multiples) < _SAME * step).all() else 0.0


def rounded_outputs(model: Realization, records: Sequence[Record]) -> Rounding:
    """Rounding of the outputs whose errors are mostly that; zeros of the others."""
    rounding = Rounding.of(records)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.vstack(simulation_errors(model, records))
        mostly = np.mean(errors**2, axis=0) < _MOSTLY * rounding.variances
    return Rounding(*(np.where(mostly, values, 0.0) for values in rounding))
