"""Points where a combination of parameters changes the response to second order alone.

Two lags that have met are such a point: what they do to the response depends on their
mean and on the square of their difference. The derivative by the difference is zero, as
that of a combination that changes nothing at all. But data move the square like any
parameter, and what it takes of their errors the other parameters must not take for
theirs: to their uncertainty it is one parameter more.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..systems.least_squares import scaled_lstsq

Array = NDArray[np.float64]

# Relative steps that show second derivatives, how many combinations are looked at, and
# the part of their second derivative that is no change of the parameters to first order
_SHORT, _MOST, _STANDS_OUT = 1e-3, 6, 1e-3

_ROUNDING = 1e-12  # of a parameter: a step that ends at its bound does not leave it

Bend = Callable[[Array], NDArray[Any] | None]


def bend_of(
    values: Callable[[Array], NDArray[Any]], theta: Array, lower: Array, upper: Array
) -> Bend:
    """The sum of the changes of `values` by a step from `theta` to either side.

    A function of the step; None where it leaves the bounds, or there are no values.
    """
    here = values(theta)

    def bend(step: Array) -> NDArray[Any] | None:
        room = np.minimum(theta - lower, upper - theta) + _ROUNDING * np.abs(theta)
        if (np.abs(step) > room).any():
            return None
        with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
            found = values(theta + step) + values(theta - step) - 2.0 * here
            return found if np.isfinite(found).all() else None
        return None

    return bend


def squared_combinations(
    J: NDArray[Any], combinations: Array, sizes: Array, bend: Bend, size: float
) -> NDArray[Any]:
    """Columns (n_values, r) beside the derivatives `J` (n_values, n_params).

    The rows of `combinations` are steps of any length along which the values, of that
    `size`, do not change to first order, `sizes` those of the parameters; `bend` is
    that of `bend_of`.
    Left out is what bends within the span of J: there other parameters undo it.

    Examples
    --------
    ``a + b`` and ``(a - b)^2`` at a = b = 1, where the difference has no derivative:

    >>> def values(x):
    ...     return np.array([x[0] + x[1], (x[0] - x[1]) ** 2])
    >>> bend = bend_of(values, np.ones(2), np.zeros(2), np.full(2, np.inf))
    >>> J, difference = np.array([[1.0, 1.0], [0.0, 0.0]]), np.array([[1.0, -1.0]])
    >>> squared_combinations(J, difference, np.ones(2), bend, 2.0).round(6)
    array([[0.],
           [8.]])
    """
    lengths = np.abs(combinations / sizes).max(1, keepdims=True, initial=0.0)
    steps = list((combinations / lengths)[:_MOST])
    sums = [steps[i] + steps[j] for j in range(len(steps)) for i in range(j)]
    found, known = np.zeros((len(J), 0), J.dtype), _parts(J)
    for step in steps + sums:
        bent = bend(_SHORT * step)
        if bent is None:
            continue
        column = bent.ravel() / _SHORT**2
        own = _parts(column)
        left = own - known @ scaled_lstsq(known, own)[0]
        if np.linalg.norm(left) > _STANDS_OUT * max(float(np.linalg.norm(own)), size):
            found = np.column_stack([found, column])
    return found


def _parts(A: NDArray[Any]) -> Array:
    return np.concatenate([A.real, A.imag])
