"""Identification of records that never fit into memory: the compressed Hankel data.

The Gram matrix (or the triangular factor) of the block-Hankel data grows with the
stream: the windows of every new stretch are added, those across the border to the
stretch before included, so that the subspace step of the whole stream is the same as
that of one table. What B and D need besides is in `recursion`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .hankel import cholesky_factor, hankel_gram, past_future_rows, qr_factor
from .hankel import stack_factors as stack
from .regression import Freedom, scaled_lstsq

Array = NDArray[np.float64]


class HankelSum(NamedTuple):
    """Compressed block-Hankel data of a stream.

    Attributes
    ----------
    n_inputs, n_outputs, horizon : int
    past_outputs : bool
    gram : ndarray of shape (r, r) or None
        Gram matrix of all windows; None where the data need the factor.
    factor : ndarray of shape (r, r) or None
        Triangular factor instead of the Gram matrix.
    tail : ndarray of shape (at most 2 * horizon - 1, n_channels)
        Last samples of the experiment that may continue.
    """

    n_inputs: int
    n_outputs: int
    horizon: int
    past_outputs: bool
    gram: Array | None
    factor: Array | None
    tail: Array

    @property
    def rows(self) -> NDArray[np.intp]:
        """Rows of the Hankel matrix that are kept, in their order."""
        return past_future_rows(
            self.n_inputs,
            self.n_outputs,
            self.horizon,
            past_outputs=self.past_outputs,
        )

    def triangular(self) -> Array:
        """Triangular factor of everything seen."""
        if self.gram is None:
            return np.zeros((0, 0)) if self.factor is None else self.factor
        lower = cholesky_factor(self.gram)
        if lower is not None:
            return lower
        # Later samples of another size may hide what the first ones showed.
        values, vectors = np.linalg.eigh(self.gram)
        return stack([vectors * np.sqrt(np.maximum(values, 0.0))])


def start_hankel_sum(
    samples: Sequence[Array], n_inputs: int, horizon: int, *, past_outputs: bool = True
) -> HankelSum:
    """Summary of the first experiments, of which the last may continue.

    Parameters
    ----------
    samples : sequence of ndarray of shape (n_samples_i, n_channels)
        Scaled samples ``[u, y]``, one array per experiment.
    n_inputs, horizon : int
    past_outputs : bool, default=True

    Returns
    -------
    HankelSum

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn.numerics.hankel import data_factor
    >>> z = np.random.default_rng(0).standard_normal((300, 3))
    >>> parts = start_hankel_sum([z[:100]], n_inputs=2, horizon=4)
    >>> parts = extend_hankel_sum(parts, z[100:], starts=False)
    >>> np.allclose(parts.triangular(), data_factor([z], n_inputs=2, horizon=4))
    True
    """
    c = samples[0].shape[1]
    empty = HankelSum(
        n_inputs, c - n_inputs, horizon, past_outputs, None, None, np.zeros((0, c))
    )
    rows, n_rows = empty.rows, 2 * horizon
    gram = np.zeros((len(rows), len(rows)))
    for z in samples:
        if len(z) >= n_rows:
            gram += hankel_gram(z, n_rows)[np.ix_(rows, rows)]
    tail = samples[-1][-(n_rows - 1) :].copy()
    if cholesky_factor(gram) is None:
        factor = qr_factor(samples, n_rows, rows)
        return empty._replace(factor=factor, tail=tail)
    return empty._replace(gram=gram, tail=tail)


def extend_hankel_sum(state: HankelSum, samples: Array, *, starts: bool) -> HankelSum:
    """Add the next samples.

    Parameters
    ----------
    state : HankelSum
    samples : ndarray of shape (n_samples, n_channels)
    starts : bool
        Whether they begin a new experiment rather than continue the last one.

    Returns
    -------
    HankelSum
    """
    z = samples if starts else np.vstack([state.tail, samples])
    n_rows = 2 * state.horizon
    tail = z[-(n_rows - 1) :].copy()
    if len(z) < n_rows:
        return state._replace(tail=tail)
    if state.gram is not None:
        gram = state.gram + hankel_gram(z, n_rows)[np.ix_(state.rows, state.rows)]
        return state._replace(gram=gram, tail=tail)
    assert state.factor is not None
    factor = stack([state.factor, qr_factor([z], n_rows, state.rows)])
    return state._replace(factor=factor, tail=tail)


def factor_input_matrices(
    factor: Array, A: Array, C: Array, free: Freedom, horizon: int
) -> tuple[Array, Array]:
    """B and D from the triangular factor alone (MOESP).

    With ``Q`` orthogonal to the extended observability matrix ``O`` and ``T`` the
    Toeplitz matrix of the Markov parameters, ``Q.T L31 = Q.T T L11`` but for the
    noise, which is linear in B and D (Verhaegen and Verdult, 2007, Section 9.2.4).
    Consistent, but less accurate than the simulation least squares of
    `simulation_fit`, which needs the samples.

    Parameters
    ----------
    factor : ndarray of shape (r, r)
        Lower triangular, of ``[U_f; ...; Y_f]``.
    A : ndarray of shape (order, order)
    C : ndarray of shape (n_outputs, order)
    free : Freedom
    horizon : int

    Returns
    -------
    B : ndarray of shape (order, n_inputs)
    D : ndarray of shape (n_outputs, n_inputs)
    """
    (ny, n), m = C.shape, free.direct.shape[1]
    powers = [C]
    for _ in range(horizon - 1):
        powers.append(powers[-1] @ A)
    observability = np.vstack(powers)
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
