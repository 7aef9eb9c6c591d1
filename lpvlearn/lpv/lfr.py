"""Linear-fractional representations: an LPV model as a constant matrix and a feedback.

A product of powers is a chain, ``w_j = delta_j z_j`` with ``z_j`` the product of one
factor less; a sum of products leaves the chains at the output, and a denominator feeds
them back to the input. What a variable repeats is then the state of a linear system in
``1 / delta_j``, with all else as its inputs and outputs, and is reduced to what these
reach and see, one variable after another (P. Lambrechts, J. Terlouw, S. Bennani,
M. Steinbuch, Parametric uncertainty modeling using LFTs, ACC 1993).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exceptions import VersionedPickle
from ..models.statespace import StateSpace
from ..models.system_matrix import blocks
from ..systems.least_squares import row_and_column_scales
from ..validation import flag, place
from .coefficients import MatrixCoefficients

Array = NDArray[np.float64]

# Directions this much weaker than coefficients, which are scaled to one, are rounding.
_RANK = 1e-12

# Least singular value of the change to variables as they are, relative to what it
# adds: half of the digits are lost. (Far from zero, in units of its range, a variable
# cancels what it adds.)
_ILL_POSED = 1e-8
_SINGULAR = 1e12  # condition that leaves five digits: it is that of LU, not of rounding

_MANY_VARIABLES = 4  # 24 orders in which to take the variables are tried


@dataclass(frozen=True, eq=False, repr=False)
class LinearFractionalModel(VersionedPickle):
    """An LPV model as an upper linear-fractional transformation.

    ``z = M11 w + M12 v``, ``[x'; y] = M21 w + M22 v``, ``w = Delta(kappa) z`` with
    ``v = [x; u]``: the frozen matrices are ``[[A, B], [C, D]] = M22 + M21 Delta
    (I - M11 Delta)^-1 M12``. Offsets of the model are left out.

    Attributes
    ----------
    M : ndarray of shape (size + order + n_outputs, size + order + n_inputs)
        ``[[M11, M12], [M21, M22]]``.
    repetitions : tuple of int
        How often each scheduling variable stands on the diagonal of Delta.
    size : int
        Of Delta, the sum of these.
    order, n_inputs, n_outputs : int
    centre, half_width : ndarray of shape (n_scheduling,)
        0 and 1, unless the variables are normalized.
    scheduling_names : tuple
    input_delay : ndarray of shape (n_inputs,)
        Seconds.
    """

    M: Array
    repetitions: tuple[int, ...]
    order: int
    centre: Array
    half_width: Array
    scheduling_names: tuple[Any, ...]
    input_delay: Array

    def __repr__(self) -> str:
        shown = zip(self.scheduling_names, self.repetitions, strict=True)
        each = ", ".join(f"{name}: {times}" for name, times in shown)
        return (
            f"LinearFractionalModel(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, repetitions={{{each}}})"
        )

    @property
    def size(self) -> int:
        """Size of Delta."""
        return sum(self.repetitions)

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.M.shape[1] - self.size - self.order

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.M.shape[0] - self.size - self.order

    def delta(self, kappa: ArrayLike) -> Array:
        """Delta at one scheduling value, shape (size, size), diagonal."""
        unit = place("kappa", kappa, len(self.centre)) - self.centre
        return np.diag(np.repeat(unit / self.half_width, self.repetitions))

    def at(self, kappa: ArrayLike) -> StateSpace:
        """The frozen model at one scheduling value, shape (n_scheduling,).

        A ValueError where ``I - M11 Delta`` is singular, or nearly so: there is no
        model, or rounding is much of it.
        """
        M11, M12, M21, M22 = blocks(self.M, self.size)
        delta = self.delta(kappa)
        loop = np.eye(self.size) - M11 @ delta
        finite = np.isfinite(loop).all()
        if self.size and not (finite and np.linalg.cond(loop) < _SINGULAR):
            raise ValueError(
                "`kappa` must be where the model is well posed, `I - M11 Delta` not "
                f"nearly singular. Got {kappa!r}; take a value near the range of the "
                "data, or the LPVStateSpace itself, which loses no digits beyond it."
            )
        z = np.linalg.solve(loop, M12)
        A, B, C, D = blocks(M22 + M21 @ delta @ z, self.order)
        return StateSpace(A, B, C, D, input_delay=self.input_delay)


def linear_fractional(
    coefficients: MatrixCoefficients, *, normalized: bool
) -> LinearFractionalModel:
    """The smallest form found, of coefficients in normalized variables."""
    c, normalized = coefficients, flag("normalized", normalized)
    upper, lower = np.concatenate([c.A, c.B], 2), np.concatenate([c.C, c.D], 2)
    S, d = np.concatenate([upper, lower], 1), c.denominator
    S, d = S / d[0], d / d[0]
    rows, columns = row_and_column_scales(S - d[:, None, None] * S[0])  # what varies
    S = S / rows[:, None] / columns
    n = c.powers.shape[1]
    orders = list(permutations(range(n))) if n <= _MANY_VARIABLES else [tuple(range(n))]
    found = []
    for order in orders:
        found.append(_reduced(*_chains(S, d, c.powers, order)))
        M, counts = _reduced(*_chains(S.swapaxes(1, 2), d, c.powers, order))
        found.append((M.T, counts))
    M, repetitions = min(found, key=lambda pair: sum(pair[1]))
    size = sum(repetitions)
    M = M * np.concatenate([np.ones(size), rows])[:, None]
    M = M * np.concatenate([np.ones(size), columns])
    centre, half_width = c.centre, c.half_width
    if not normalized:
        M = _in_plain_variables(M, repetitions, centre, half_width)
        centre, half_width = np.zeros(n), np.ones(n)
    return LinearFractionalModel(
        M,
        repetitions,
        c.A.shape[1],
        centre,
        half_width,
        c.scheduling_names,
        c.input_delay,
    )


def _chains(
    S: Array, d: Array, powers: NDArray[np.intp], order: tuple[int, ...]
) -> tuple[Array, tuple[int, ...]]:
    """M and repetitions of ``sum_k S_k t_k / sum_k d_k t_k``, ``d_0 = 1``.

    A factor of a product is taken from the first of its variables in `order`.
    """
    width = S.shape[2]
    known = {tuple(row): k for k, row in enumerate(powers.tolist())}
    taken: dict[tuple[int, ...], tuple[int, tuple[int, ...]]] = {}
    waiting = list(known)[1:]
    while waiting:
        term = waiting.pop()
        j = next(j for j in order if term[j])
        parent = tuple(power - (i == j) for i, power in enumerate(term))
        if term not in taken:
            taken[term] = j, parent
            if any(parent):
                waiting.append(parent)
    terms = sorted(taken, key=lambda term: taken[term][0])
    place = {term: slice(k * width, (k + 1) * width) for k, term in enumerate(terms)}
    size, eye = width * len(terms), np.eye(width)
    M = np.zeros((size + S.shape[1], size + width))
    M[size:, size:] = S[0]
    back = np.zeros((width, size + width))  # v less what the denominator feeds back
    back[:, size:] = eye
    for term in terms:
        if term in known:
            back[:, place[term]] = -d[known[term]] * eye
            M[size:, place[term]] = S[known[term]] - d[known[term]] * S[0]
    for term in terms:
        _, parent = taken[term]
        if any(parent):
            M[place[term], place[parent]] = eye
        else:
            M[place[term]] = back
    counts = [width * sum(taken[term][0] == j for term in terms) for j in sorted(order)]
    return M, tuple(counts)


def _reduced(M: Array, counts: tuple[int, ...]) -> tuple[Array, tuple[int, ...]]:
    """Without what the rest does not reach or see, one variable after another."""
    sizes, before = list(counts), None
    while sizes != before:
        before = list(sizes)
        for j in range(len(sizes)):
            for _ in range(2):  # what is reached; of the transposed, what is seen
                start, stop = sum(sizes[:j]), sum(sizes[: j + 1])
                rest = np.hstack([M[start:stop, :start], M[start:stop, stop:]])
                Q = _reachable(M[start:stop, start:stop], rest)
                M = np.vstack([M[:start], Q.T @ M[start:stop], M[stop:]])
                M = np.hstack([M[:, :start], M[:, start:stop] @ Q, M[:, stop:]])
                sizes[j] = Q.shape[1]
                M = M.T
    return M, tuple(sizes)


def _reachable(A: Array, B: Array) -> Array:
    """Orthonormal basis of what the inputs B reach in ``x' = A x + B u``."""
    Q, new = np.zeros((len(A), 0)), B
    while new.size:
        largest = max(1.0, float(np.linalg.norm(new, 2)))
        for _ in range(2):  # once more, for what rounding left
            new = new - Q @ (Q.T @ new)
        U, s, _ = np.linalg.svd(new, full_matrices=False)
        U = U[:, np.flatnonzero(s > _RANK * largest)]
        Q, new = np.hstack([Q, U]), A @ U
    return Q


def _in_plain_variables(
    M: Array, repetitions: tuple[int, ...], centre: Array, half_width: Array
) -> Array:
    """M for ``w = kappa z`` in the place of ``w = (kappa - centre) / half_width z``."""
    size = sum(repetitions)
    M11, M12, M21, M22 = blocks(M, size)
    width, shift = (np.repeat(v, repetitions) for v in (half_width, centre))
    M11, M21 = M11 / width, M21 / width
    added = M11 * shift
    back = np.eye(size) + added
    least = np.linalg.svd(back, compute_uv=False).min(initial=1.0)
    if not least > _ILL_POSED * max(1.0, np.abs(added).sum()):
        raise ValueError(
            "`normalized=False` needs a model that exists where the scheduling "
            f"variables are zero, and a range near to it. Got a range of {centre} "
            f"+- {half_width}. Use lfr(normalized=True), with variables in [-1, 1]."
        )
    z = np.linalg.solve(back, np.hstack([M11, M12]))
    return np.vstack([z, np.hstack([M21, M22]) - (M21 * shift) @ z])
