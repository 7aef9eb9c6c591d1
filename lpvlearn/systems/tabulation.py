"""A smooth array-valued function along a trajectory, by a table of Chebyshev series.

Matrices of an LPV model are smooth functions of one scheduling variable, needed at
every sample. The series

    f(x) = sum_k c_k T_k(t),    t = (2 x - low - high) / (high - low),

converges geometrically: some tens of evaluations of `f`, and one matrix product for
the samples, replace an evaluation for each of them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial.chebyshev import chebpts2, chebvander
from numpy.typing import NDArray
from scipy.fft import dct

Array = NDArray[np.float64]

# Numbers of nodes, 2^k + 1: each set holds the one before. A function that 129 nodes
# do not resolve is evaluated itself: the table would cost more than it saves.
_SIZES = (9, 17, 33, 65, 129)

# Last coefficients, relative to the largest value of their entry, of a series that has
# converged: hundreds of times the rounding unit, so that rounding does not forbid it.
_TAIL = 1e-13

# Nodes from which a tail may be rounding noise of the whole matrix, and not only of
# its entry: a few nodes cannot tell noise from a function that is not resolved.
_NOISE_SIZE = 33

# Samples at which the table is compared with the function, and how far it may be off,
# relative to the size that rounding errors have there: above what a tail of `_TAIL`
# leaves, below what would show in a simulation.
_PROBES = 128
_PROBE_TOLERANCE = 1e-11

_TINY = float(np.finfo(float).tiny)  # keeps a function that is zero from dividing by it


def tabulate(f: Callable[[Array], Array], x: Array) -> Array:
    """``f(x)`` to about 1e-12, for `f` from (k,) points to (k, ...) values.

    By a Chebyshev table and one matrix product where `f` is smooth, else by `f` itself.
    """
    if len(x) <= 2 * _SIZES[1]:  # a table of two rounds would need as many values
        return f(x)
    low, high = float(x.min()), float(x.max())
    if high <= low:
        value = f(x[:1])
        return np.broadcast_to(value[0], (len(x), *value.shape[1:]))
    coef = _chebyshev_coefficients(f, low, high)
    if coef is None:
        return f(x)

    def table(points: Array) -> Array:
        t = np.clip((2.0 * points - low - high) / (high - low), -1.0, 1.0)
        return np.tensordot(chebvander(t, len(coef) - 1), coef, 1)

    # A step or a narrow feature may fall between the nodes: look at the data itself.
    probe = x[:: max(1, len(x) // _PROBES)]
    exact = f(probe)
    matrices = _as_matrices(exact)
    allowed = _PROBE_TOLERANCE * _rounding_scale(np.abs(matrices).max(0))
    if (np.abs(table(probe) - matrices) > allowed).any():
        return f(x)
    return table(x).reshape(len(x), *exact.shape[1:])


def _chebyshev_coefficients(
    f: Callable[[Array], Array], low: float, high: float
) -> Array | None:
    """Chebyshev coefficients of a smooth array-valued function, or None.

    The table doubles until its last coefficients vanish to `_TAIL` of the largest value
    of their entry. Its nodes include the ends, where a clipped function has its kinks.
    """
    values = np.empty(0)
    for size in _SIZES:
        nodes = 0.5 * (low + high) + 0.5 * (high - low) * chebpts2(size)[::-1]
        if len(values):  # every second node is known
            merged = np.empty((size, *values.shape[1:]))
            merged[::2], merged[1::2] = values, _as_matrices(f(nodes[1::2]))
            values = merged
        else:
            values = _as_matrices(f(nodes))
        coef = dct(values, type=1, axis=0) / (size - 1)
        coef[[0, -1]] *= 0.5
        scale = np.abs(values).max(0)
        tail = np.abs(coef[-3:]).max(0)
        if (tail <= _TAIL * scale).all():
            return coef
        # Entries that are rounding noise of the whole must not forbid the table.
        if size >= _NOISE_SIZE and (tail <= _TAIL * _rounding_scale(scale)).all():
            return coef
    return None


def _as_matrices(values: Array) -> Array:
    """Function values of any shape as a stack of matrices."""
    return values.reshape(len(values), *(values.shape[1:] or (1,))[:1], -1)


def _rounding_scale(size: Array) -> Array:
    """Size that rounding errors of the entries of a matrix are relative to.

    The largest of the row times the largest of the column: it follows a change of
    units of the states, inputs and outputs, as the errors do.
    """
    rows, columns = size.max(-1, keepdims=True), size.max(-2, keepdims=True)
    return rows * (columns / max(float(size.max(initial=0.0)), _TINY))
