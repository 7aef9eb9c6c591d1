"""State matrices from the compressed data: weighted subspaces and shift invariance.

With ``[U_f; W_p; Y_f] = L Q`` (``W_p`` the past inputs and, but for PI-MOESP, the past
outputs), the block ``L32`` is the part of the future outputs that the past explains and
the future inputs do not. Its column space is that of the extended observability
matrix; the methods differ in how they weight it (Van Overschee and De Moor, 1995).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...systems.least_squares import rank_lstsq, scaled_lstsq, thin_svd
from ...systems.modes import spectral_radius
from ..simulation_error.simulation_fit import Freedom

Array = NDArray[np.float64]

# A, B and C of a pair of some outputs; None where it has no model.
WithInputs = Callable[[Array, Array, Sequence[int]], tuple[Array, Array, Array] | None]

METHODS = ("po-moesp", "pi-moesp", "n4sid", "cva")

# Singular values of the block of past data below this share of the largest are those of
# unexcited directions in data without noise; so are eigenvalues of the future outputs'
# covariance, their squares but for rounding, below the second.
_UNEXCITED, _UNEXCITED_POWER = 1e-10, 1e-12

# Block rows by the order, of a Hankel matrix of the states that outputs have apart
_LENGTH = 4

_EPSILON = float(np.finfo(float).eps)  # below it a direction is rounding

# Squaring (eigenvectors of L32 L32.T) is exact enough above this ratio of the last
# wanted to the first singular value; below it the SVD is used.
_MIN_RATIO = 1e-4


class ObservabilitySubspace(NamedTuple):
    """Column space of the extended observability matrix."""

    basis: Array  # (horizon * n_outputs, k): most important first, weighting undone
    singular_values: Array  # (horizon * n_outputs,): all of them, descending
    # of the matrix that they are of, where its rows have no weight of their own
    gram: Array | None = None

    def weighted(self, weight: Array) -> ObservabilitySubspace | None:
        """That of outputs times a `weight`, (n_outputs, n_outputs), of full rank.

        It leaves the rows that past and future inputs span as they are. None where that
        is not known, or squares are not exact enough for it.
        """
        if self.gram is None:
            return None
        size, gram = len(self.gram), self.gram
        for _ in range(2):
            gram = (weight @ gram.reshape(-1, len(weight), size)).reshape(size, size).T
        values, vectors = _of_squares(gram, self.basis.shape[1])
        if vectors is None:
            return None
        return ObservabilitySubspace(vectors, values, gram)

    def state_pair(
        self,
        n_outputs: int,
        order: int,
        n_noise_states: int,
        with_inputs: WithInputs,
    ) -> tuple[Array, Array]:
        """``(A, C)`` of an order, with noise states of those the inputs reach most.

        `with_inputs` makes A, B and C of the pair of the higher order and of outputs,
        or None where that has no model.
        """
        horizon = len(self.singular_values) // n_outputs
        most = min(self.basis.shape[1], (horizon - 1) * n_outputs)
        extended = min(order + n_noise_states, most)
        if 0 < order < extended:
            A, C = shift_invariant_pair(self.basis, n_outputs, extended)
            model = with_inputs(reflect_unstable(A), C, range(n_outputs))
            if model is not None:
                return _dominant_pair(*model, order, horizon)
        return shift_invariant_pair(self.basis, n_outputs, order)


class SubspacesApart(NamedTuple):
    """Those of each output alone, for samples too few for all of them together."""

    alone: list[ObservabilitySubspace]

    @property
    def singular_values(self) -> Array:
        """All of them, descending."""
        found = np.concatenate([space.singular_values for space in self.alone])
        return np.sort(found)[::-1]

    def weighted(self, weight: Array) -> None:
        """None: those of other outputs are not told by these."""

    def state_pair(
        self,
        n_outputs: int,
        order: int,
        n_noise_states: int,
        with_inputs: WithInputs,
    ) -> tuple[Array, Array]:
        """``(A, C)`` of the states of all outputs that dominate what the inputs do.

        As of an `ObservabilitySubspace`, but for noise states: the others are such. No
        output is given more than there are to be.
        """
        models = []
        for i, (basis, *_) in enumerate(self.alone):
            A, C = shift_invariant_pair(basis, 1, min(order, basis.shape[1]))
            model = with_inputs(reflect_unstable(A), C, [i])
            if model is None:  # it overflows
                return np.zeros((order, order)), np.zeros((n_outputs, order))
            models.append(model)
        A, C = (linalg.block_diag(*(model[k] for model in models)) for k in (0, 2))
        B = np.vstack([model[1] for model in models])
        return _dominant_pair(A, B, C, order, _LENGTH * order + 1)


Subspace = ObservabilitySubspace | SubspacesApart


def observability_subspace(
    factor: Array,
    n_inputs: int,
    n_outputs: int,
    horizon: int,
    max_order: int,
    method: str,
) -> ObservabilitySubspace:
    """Extended observability matrix from the triangular factor of the data.

    `factor` is that of ``[U_f; U_p; Y_p; Y_f]``, without ``Y_p`` for PI-MOESP;
    `max_order` directions are returned. "pi-moesp": instruments are past inputs only,
    consistent under coloured measurement noise (Verhaegen, 1993). "po-moesp": past
    inputs and outputs (Verhaegen, 1994). "n4sid", "cva": the same past, weighted by the
    oblique projection or to canonical correlations (Van Overschee and De Moor, 1995).
    """
    n_future, n_last = horizon * n_inputs, horizon * n_outputs
    past = slice(n_future, factor.shape[0] - n_last)
    explained = factor[-n_last:, past]
    if method == "n4sid":
        # The oblique projection L32 L22^-1 [L21 L22] Q; a pseudo-inverse, because
        # L22 is singular without noise.
        weight = linalg.lstsq(
            factor[past, past].T,
            explained.T,
            lapack_driver="gelsy",
            cond=_UNEXCITED,
            check_finite=False,
        )[0].T
        explained = np.hstack([weight @ factor[past, :n_future], explained])
    elif method == "cva":
        residual = factor[-n_last:, past.stop :]
        values, vectors = linalg.eigh(
            explained @ explained.T + residual @ residual.T, check_finite=False
        )
        # Without noise the weight has no inverse on the unexcited directions.
        floor = _UNEXCITED_POWER * values[-1] or 1.0
        root = np.sqrt(np.maximum(values, floor))
        left, singular = _left_singular((vectors / root).T @ explained, max_order)
        return ObservabilitySubspace((vectors * root) @ left, singular)
    gram = None if method == "n4sid" else explained @ explained.T
    return ObservabilitySubspace(*_left_singular(explained, max_order, gram), gram)


def _left_singular(
    matrix: Array, max_order: int, gram: Array | None = None
) -> tuple[Array, Array]:
    """Leading left singular vectors and all singular values of a wide matrix."""
    if gram is None:
        gram = matrix @ matrix.T
    values, vectors = _of_squares(gram, max_order)
    if vectors is None:
        vectors, values, _ = thin_svd(matrix)
    return vectors[:, :max_order], values


def _of_squares(gram: Array, max_order: int) -> tuple[Array, Array | None]:
    """All singular values, and leading vectors; None where these are not exact."""
    size = len(gram)
    wanted = min(max_order, size)
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0))
    if wanted == 0:
        return values, np.zeros((size, 0))
    if not values[wanted - 1] > _MIN_RATIO * values[0]:
        return values, None
    vectors = linalg.eigh(
        gram, subset_by_index=[size - wanted, size - 1], check_finite=False
    )[1]
    return values, vectors[:, ::-1]


def shift_invariant_pair(
    basis: Array, n_outputs: int, order: int
) -> tuple[Array, Array]:
    """``(A, C)`` from the shift invariance of the extended observability matrix.

    ``C`` is the first block row and ``A`` solves ``O[:-1] A = O[1:]`` in the least
    squares sense; `basis` has at least `order` columns, `order` is at most
    ``(horizon - 1) * n_outputs``.

    >>> basis = 2.0 * 0.5 ** np.arange(4.0)[:, None]
    >>> A, C = shift_invariant_pair(basis, n_outputs=1, order=1)
    >>> round(A.item(), 12), C.item()
    (0.5, 2.0)
    """
    leading = basis[:, :order]
    if order == 0:
        return np.zeros((0, 0)), np.zeros((n_outputs, 0))
    A = rank_lstsq(leading[:-n_outputs], leading[n_outputs:], _EPSILON)[0]
    return np.ascontiguousarray(A), leading[:n_outputs].copy()


def observability_matrix(A: Array, C: Array, length: int) -> Array:
    """Extended observability matrix ``[C; C A; C A^2; ...]`` of `length` block rows.

    >>> observability_matrix(np.array([[0.5]]), np.array([[2.0]]), 3).ravel()
    array([2. , 1. , 0.5])
    """
    rows = [C]
    for _ in range(length - 1):
        rows.append(rows[-1] @ A)
    return np.vstack(rows)


def reflect_unstable(A: Array, limit: float = 1.0) -> Array:
    """Reflect the poles outside a circle around the origin into it.

    Every pole ``z`` with ``|z| > limit`` becomes ``limit**2 / conj(z)``; the others
    stay. ``A`` itself where nothing had to be reflected.

    >>> reflect_unstable(np.diag([2.0, 0.5]))
    array([[0.5, 0. ],
           [0. , 0.5]])
    """
    if spectral_radius(A) <= limit:
        return A
    # By the real Schur form, because the eigenvectors may be nearly dependent; as
    # 1 / conj(z) = z / |z|**2, a diagonal block is divided by its squared modulus.
    triangular, rotation = linalg.schur(A, output="real")
    start = 0
    while start < len(A):
        pair = start + 1 < len(A) and triangular[start + 1, start] != 0.0
        block = slice(start, start + 1 + pair)
        modulus = spectral_radius(triangular[block, block])
        if modulus > limit:
            triangular[block, block] *= (limit / modulus) ** 2
        start = block.stop
    return rotation @ triangular @ rotation.T


def _dominant_pair(
    A: Array, B: Array, C: Array, order: int, length: int
) -> tuple[Array, Array]:
    """``(A, C)`` of the part of a model that dominates its first Markov parameters.

    The model is reduced through the singular values of its Hankel matrix of `length`
    block rows and columns (Ho and Kalman, 1966), which needs no stability. States that
    the inputs do not reach, such as those of a noise model, drop out.

    >>> A, B, C = np.diag([0.9, 0.2]), np.array([[1.0], [0.0]]), np.ones((1, 2))
    >>> _dominant_pair(A, B, C, 1, 8)[0].round(6)
    array([[0.9]])
    """
    seen = observability_matrix(A, C, length)
    reached = observability_matrix(A.T, B.T, length).T
    left, s, _ = linalg.svd(seen @ reached, full_matrices=False, check_finite=False)
    return shift_invariant_pair(left * np.sqrt(s), len(C), order)


def factor_input_matrices(
    factor: Array, A: Array, C: Array, free: Freedom, horizon: int
) -> tuple[Array, Array]:
    """B and D from the triangular factor alone (MOESP).

    With ``Q`` orthogonal to the extended observability matrix ``O`` and ``T`` the
    Toeplitz matrix of the Markov parameters, ``Q.T L31 = Q.T T L11`` but for the
    noise, which is linear in B and D (Verhaegen and Verdult, 2007, Section 9.2.4).
    Consistent, but less accurate than the simulation least squares of
    `simulation_fit`, which needs the samples. `factor` is that of ``[U_f; ...; Y_f]``.
    """
    (ny, n), m = C.shape, free.direct.shape[1]
    observability = observability_matrix(A, C, horizon)
    Q = linalg.qr(observability, check_finite=False)[0][:, n:]
    L11 = factor[: horizon * m, : horizon * m].reshape(horizon, m, horizon * m)
    L31 = Q.T @ factor[-horizon * ny :, : horizon * m]
    effect = np.zeros((horizon, Q.shape[1], ny + n))
    for t in range(horizon):
        effect[t, :, :ny] = Q[t * ny : (t + 1) * ny].T
        rest = horizon - t - 1
        effect[t, :, ny:] = Q[(t + 1) * ny :].T @ observability[: rest * ny]
    M = np.einsum("tar,tjc->acrj", effect, L11).reshape(L31.size, -1)
    allowed = np.vstack([free.direct, np.ones((n, m), dtype=bool)]).ravel()
    solution = np.zeros(len(allowed))
    solution[allowed] = scaled_lstsq(M[:, allowed], L31.ravel())[0]
    DB = solution.reshape(ny + n, m)
    return DB[ny:], DB[:ny]
