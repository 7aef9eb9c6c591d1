"""Starts for structures that are sums of parts: a mode of the black box for each part.

A modal form, or lags beside one another, has a block-diagonal A. The poles of the black
box are then those of the parts, and in its own modal basis each part is a similarity
problem of one or two states, which has no wrong minimum to fall into. Where the order
is large, random similarities of all states find none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from .error_system import Target
from .similarity import scaled_problem, similarity_starts

Array = NDArray[np.float64]
Places = NDArray[np.intp]

_LARGEST = 2  # states of a part: poles do not tell which ones make a larger one
_STARTS = 4  # random similarities of a part, where its equations leave any freedom
_DEFECTIVE = 1e7  # condition of a modal basis that has lost half of the digits
_IMPOSSIBLE = 1e6  # distance of a mode to a part that it cannot be, entries being one


class _Part(NamedTuple):
    """States that no others touch, and the parameters of their entries."""

    states: Places
    params: Places
    offset: Array
    basis: Array


def start_by_parts(
    box: Target, offset: Array, basis: Array, rng: np.random.Generator
) -> tuple[Array, float] | None:
    """Parameters that give every part a mode of the black box, and their distance.

    `offset` and `basis` are those of an affine structure of the order of the box. The
    distance is that of the scaled entries to the structure: about zero where the box is
    one of its models. None where the structure is no sum of parts of one or two states,
    or the box has no modes for them.

    Examples
    --------
    >>> from lpvlearn import GrayBoxStructure
    >>> lags = GrayBoxStructure.from_template(
    ...     A=[["-a", 0], [0, "-b"]], B=[[1], [1]], C=[["g", "h"]])
    >>> model = lags.model([3.0, 20.0, 5.0, 7.0]).balance()
    >>> box, rng = Target(model.A, model.B, model.C, model.D), np.random.default_rng(0)
    >>> theta, distance = start_by_parts(box, lags.offset, lags.basis, rng)
    >>> theta.round(6), bool(distance < 1e-9)
    (array([ 3., 20.,  5.,  7.]), True)
    """
    n = len(box.A)
    parts = _parts(offset, basis, n)
    if parts is None:
        return None
    modes = _modes(box, [len(part.states) for part in parts])
    if modes is None:
        return None
    distances = np.full((len(parts), len(modes)), _IMPOSSIBLE)
    found: dict[tuple[int, int], Array] = {}
    known: dict[tuple[bytes, bytes, int], tuple[Array, Array]] = {}
    for i, part in enumerate(parts):
        for j, mode in enumerate(modes):
            if len(mode.A) != len(part.states):
                continue
            key = (part.offset.tobytes(), part.basis.tobytes(), j)
            if key not in known:
                rate = float(np.abs(np.linalg.eigvals(mode.A)).max()) or 1.0
                rate = rate if box.dt is None else 1.0
                problem = scaled_problem(mode, part.offset, part.basis, rate)
                known[key] = similarity_starts(problem, _STARTS, rng)
            thetas, costs = known[key]
            if len(thetas):
                found[i, j], distances[i, j] = thetas[0], costs[0]
    rows, columns = linear_sum_assignment(distances)
    total = float(np.linalg.norm(distances[rows, columns]))
    if not total < _IMPOSSIBLE:
        return None
    theta = np.zeros(len(basis))
    only_D = ~(basis[:, :n] != 0).any((1, 2)) & ~(basis[:, n:, :n] != 0).any((1, 2))
    if only_D.any():
        flat = basis[only_D][:, n:, n:].reshape(int(only_D.sum()), -1)
        rest = (box.D - offset[n:, n:]).ravel()
        theta[only_D] = np.linalg.lstsq(flat.T, rest, rcond=None)[0]
    for i, j in zip(rows, columns, strict=True):
        theta[parts[i].params] = found[i, j]
    return theta, total


def _parts(offset: Array, basis: Array, n: int) -> list[_Part] | None:
    """The parts, by their first states; None where it is no sum of small ones."""
    used = (offset != 0) | (basis != 0).any(0)
    count, label = connected_components(used[:n, :n], directed=False)
    if count < 2 or np.bincount(label).max() > _LARGEST:
        return None
    states_only = basis.copy()
    states_only[:, n:, n:] = 0.0
    parts, owned = [], np.zeros(len(basis), int)
    for k in range(count):
        states = np.flatnonzero(label == k)
        rows = np.append(states, np.arange(n, offset.shape[0]))
        columns = np.append(states, np.arange(n, offset.shape[1]))
        own = np.ix_(rows, columns)
        inner = np.array([matrix[own] for matrix in states_only])
        params = np.flatnonzero((inner != 0).any((1, 2)))
        if params.size == 0:
            return None
        owned[params] += 1
        fixed = offset[own].copy()
        fixed[len(states) :, len(states) :] = 0.0
        parts.append(_Part(states, params, fixed, inner[params]))
    in_D = (basis[:, n:, n:] != 0).any((1, 2))
    return None if (owned + in_D > 1).any() else parts


def _modes(box: Target, sizes: list[int]) -> list[Target] | None:
    """The black box as a sum of modes of these sizes, by their rates.

    A pair of complex poles is one of two states; so are neighbours among real poles as
    long as such modes are wanted.
    """
    poles, V = np.linalg.eig(box.A)
    order = np.lexsort((poles.imag, np.round(np.abs(poles), 12)))
    poles, V = poles[order], V[:, order]
    if not np.linalg.cond(V) < _DEFECTIVE:
        return None
    upper, real = np.flatnonzero(poles.imag > 0), np.flatnonzero(poles.imag == 0)
    pairs = sizes.count(2) - len(upper)
    if pairs < 0 or 2 * pairs > len(real):
        return None
    single, double = np.split(real, [len(real) - 2 * pairs])  # the slowest stand alone
    chosen = [*upper[:, None], *single[:, None], *double.reshape(-1, 2)]
    chosen.sort(key=lambda own: own[-1])
    groups = [
        V[:, own].real
        if poles[own[0]].imag == 0
        else np.hstack([V[:, own].real, V[:, own].imag])
        for own in chosen
    ]
    T = np.hstack(groups)
    inverse = np.linalg.inv(T)
    A, B, C = inverse @ box.A @ T, inverse @ box.B, box.C @ T
    modes, first = [], 0
    for group in groups:
        own = slice(first, first + group.shape[1])
        modes.append(Target(A[own, own], B[own], C[:, own], 0.0 * box.D, box.dt))
        first = own.stop
    return modes
