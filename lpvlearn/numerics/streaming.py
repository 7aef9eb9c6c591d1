"""Identification of records that never fit into memory, batch after batch.

Two summaries of bounded size grow with the stream. The first is the Gram matrix (or the
triangular factor) of the block-Hankel data, to which the windows of every new batch
are added, those across the border to the previous batch included: the
subspace step of the whole stream is the same as that of one table. The second is a
triangular factor of the linearised simulation error. Every stretch of data is
linearised at the model of that moment, in fixed local coordinates around a pilot
model, and stacked: a Gauss-Newton method that sees each sample once, as efficient as
the batch one in the limit (Ljung and Soderstrom, 1983), because the pilot is already
close. A stretch has an initial state of its own, which costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .hankel import cholesky_factor, hankel_gram, past_future_rows, qr_factor
from .hankel import stack_factors as stack
from .regression import (
    Freedom,
    Point,
    jacobian_regression,
    linear_regression,
    n_own,
    project_out,
    scaled_lstsq,
    stack_regressions,
)
from .sections import state_coefficients
from .signals import Record, signal_factor
from .simulationfit import Realization

Array = NDArray[np.float64]

# Directions of the scaled parameters that the pilot data do not determine.
_RCOND = 1e-9


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
        if lower is None:  # cannot happen to a sum of well conditioned parts
            raise linalg.LinAlgError("The summed Gram matrix lost its rank.")
        return lower


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


class Recursion(NamedTuple):
    """Accumulated linearised simulation errors around a pilot model.

    Attributes
    ----------
    pilot : Realization
        In section form.
    directions : ndarray of shape (n_parameters, k)
        Local coordinates: parameters (B, D, A, C) are those of the pilot plus
        ``directions @ position``.
    information : ndarray of shape (k + 1, k + 1)
        Triangular factor of ``[J, J position - error]``, summed up.
    position : ndarray of shape (k,)
    """

    pilot: Realization
    directions: Array
    information: Array
    position: Array


def start_recursion(
    pilot: Realization, regressions: Sequence[Array], free: Freedom
) -> Recursion:
    """Local coordinates and first information, from the data of the pilot model.

    Parameters
    ----------
    pilot : Realization
    regressions : sequence of ndarray
        One per experiment, from `jacobian_regression` at the pilot model.
    free : Freedom

    Returns
    -------
    Recursion
    """
    own = n_own(len(pilot.A), free)
    stacked = stack_regressions(regressions, own)
    jacobian = stacked[:, :-1]
    scale = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    scale[scale == 0.0] = 1.0
    _, s, right = linalg.svd(jacobian / scale, full_matrices=False, check_finite=False)
    directions = right[s > _RCOND * s[0]].T / scale[:, None]
    k = directions.shape[1]
    rows = np.column_stack([jacobian @ directions, stacked[:, -1]])
    information = _triangle(rows, k + 1)
    return Recursion(pilot, directions, information, _solve(information))


def _triangle(rows: Array, size: int) -> Array:
    """Upper triangular factor of shape (size, size)."""
    out = np.zeros((size, size))
    upper = np.linalg.qr(rows, mode="r")
    out[: len(upper)] = upper
    return out


def _solve(information: Array) -> Array:
    return scaled_lstsq(information[:-1, :-1], information[:-1, -1])[0]


def current_model(recursion: Recursion, free: Freedom) -> Realization:
    """Model at the present position.

    Returns
    -------
    Realization
        Its loss is the sum of squared errors of the linearised problem.
    """
    pilot, blocks = recursion.pilot, []
    assert pilot.blocks is not None
    step = recursion.directions @ recursion.position
    n_b, n_d = pilot.B.size, int(free.direct.sum())
    D = pilot.D.copy()
    D[free.direct] += step[n_b : n_b + n_d]
    start = n_b + n_d
    for block in pilot.blocks:
        blocks.append(block + step[start : start + block.size].reshape(block.shape))
        start += block.size
    residual = recursion.information[:, -1].copy()
    residual[:-1] -= recursion.information[:-1, :-1] @ recursion.position
    return pilot._replace(
        A=linalg.block_diag(*blocks) if blocks else pilot.A,
        B=pilot.B + step[:n_b].reshape(pilot.B.shape),
        C=pilot.C + step[start:].reshape(pilot.C.shape),
        D=D,
        loss=float(residual @ residual),
        blocks=tuple(blocks),
    )


def extend_recursion(
    recursion: Recursion, record: Record, free: Freedom
) -> tuple[Recursion, Array]:
    """Add a stretch of data, linearised at the present model.

    Parameters
    ----------
    recursion : Recursion
    record : Record
        Scaled as the pilot's data.
    free : Freedom

    Returns
    -------
    recursion : Recursion
        Unchanged where the responses overflow.
    initial_state : ndarray of shape (order,)
        Of the stretch.
    """
    model = current_model(recursion, free)
    assert model.blocks is not None
    n, own = len(model.A), n_own(len(model.A), free)
    x0 = np.zeros(n)
    R = signal_factor(model.blocks, record)
    if R is None:
        return recursion, x0
    if own:
        M = linear_regression(R, model.blocks, model.C, free)
        known = np.concatenate([model.B.ravel(), model.D[free.direct]])
        x0 = scaled_lstsq(M[:, :n], M[:, -1] - M[:, n:-1] @ known)[0]
    driven = np.column_stack([x0, model.B])
    state_map = state_coefficients(model.blocks, driven)
    R = signal_factor(model.blocks, record, state_map)
    if R is None:
        return recursion, x0
    point = Point(model.C, model.D, driven)
    M = project_out(jacobian_regression(R, model.blocks, point, free), own)
    J = M[:, :-1] @ recursion.directions
    rows = np.column_stack([J, M[:, -1] + J @ recursion.position])
    information = _triangle(
        np.vstack([recursion.information, rows]), len(recursion.information)
    )
    moved = recursion._replace(information=information, position=_solve(information))
    return moved, x0


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
