r"""From the VARX to innovation forms of every order, by the states of the predictor.

With ``z[t] = [u[t]; y[t]]``, three least squares, all of them in the triangular factor
of the Hankel matrix with rows ``z[t-p], ..., z[t]``:

1. The VARX of `varx` gives the Markov parameters ``M_l = C A_K^(l-1) B_K``.
2. Their shifts give the future window of the predictor,
   ``Gamma K_p = [M_{l+i}]`` for rows ``i < p`` and columns ``l <= p``, where
   ``A_K^p = 0``. Singular values of ``(I x S^{-1/2}) Gamma K_p Z_p`` (S the
   innovation covariance, Z_p the past samples) tell the order and the states.
3. The states of ``t`` and ``t + 1`` give C and D, then A, B and K, for every order
   from the one factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...systems.innovations import kalman_filter
from ...systems.least_squares import scaled_lstsq, thin_svd
from ...systems.modes import spectral_radius
from ..samples.hankel import hankel_factor
from ..samples.records import Record
from .predictor import Innovation, innovation_root
from .varx import NO_INNOVATION, longest_past, n_windows, past_window, samples_of

Array = NDArray[np.float64]

_MOST_ROWS = 400  # of the longest past window: its Cholesky factor costs some 10 ms

# Part of the mean state noise added to each state where the gain must come from the
# Riccati equation, so that no mode on the unit circle is free of noise.
_RICCATI_FLOOR = 1e-9


class PredictorSubspace(NamedTuple):
    """What models of every order need of the data."""

    factor: Array  # (r, r), lower triangular, of ``z[t-past], ..., z[t]``
    states: Array  # rows that turn a past window into states, most important first
    singular_values: Array  # (past * n_outputs,), descending
    direct: NDArray[np.bool_]  # free entries of D
    n_columns: int
    past: int


def predictor_subspace(
    records: Sequence[Record],
    highest_order: int,
    direct: NDArray[np.bool_],
    past: int | None,
) -> PredictorSubspace:
    """VARX and predictor subspace of several experiments, once for all orders.

    A `ValueError` where the samples do not carry the order or the past window.
    """
    ny, m = direct.shape
    c = m + ny
    # Fewer samples of the past than this cannot tell so many states apart.
    shortest = max(1, -(-highest_order // ny))
    if past is None:
        longest = max(shortest, longest_past(records, _MOST_ROWS))
        acting = np.asarray(direct.any(axis=0))
        if n_windows(records, longest) > (longest + 1) * c:
            past = past_window(records, shortest, longest, acting)
        else:
            past = longest
    elif past < shortest:
        raise ValueError(
            f"`horizon` must be at least {shortest} for order {highest_order} and "
            f"{ny} output(s) with method='pbsid'. Got {past}."
        )
    n_columns = n_windows(records, past)
    if n_columns <= (past + 1) * c:
        n_samples = sum(record.n_samples for record in records)
        raise ValueError(
            f"method='pbsid' needs more than {(past + 1) * c} windows of {past} past "
            f"samples ({m} input(s), {ny} output(s)). Got {n_columns} in {n_samples} "
            "samples: lower `order` or `horizon`, or take a longer record."
        )
    rows = np.arange((past + 1) * c)
    n_trend = len(records[0].trend)
    factor = hankel_factor(samples_of(records), past + 1, rows, n_trend=n_trend)
    Z, U, Y = factor[: past * c], factor[past * c : past * c + m], factor[-ny:]
    markov, D = _output_regression(Z, U, Y, direct)
    residual = Y - markov @ Z - D @ U
    root = innovation_root(
        residual @ residual.T / n_columns, np.sum(Y**2, axis=1) / n_columns
    )
    weighted = linalg.solve_triangular(root, markov, lower=True)
    shifted = np.zeros((past * ny, past * c))
    for i in range(past):
        shifted[i * ny : (i + 1) * ny, i * c :] = weighted[:, : (past - i) * c]
    left, s, _ = thin_svd(shifted @ Z[:, : past * c])
    values = np.maximum(s, np.finfo(float).eps * s[0]) if s[0] else np.ones_like(s)
    states = (left / np.sqrt(values)).T @ shifted
    return PredictorSubspace(
        factor, states, s / np.sqrt(n_columns), direct, n_columns, past
    )


def innovation_form(subspace: PredictorSubspace, order: int) -> Innovation:
    """Innovation form of one order, of plant and noise together.

    With states ``X`` and ``X+`` one sample later, ``[C D]`` regresses Y on ``[X; U]``,
    and ``[A B K]`` regresses ``X+`` on ``[X; U; E]`` with E what the first left. Where
    that K does not make ``A - K C`` stable (few samples), it is the gain of the
    Riccati equation of the same second moments.
    """
    factor, n = subspace.factor, subspace.n_columns
    ny, m = subspace.direct.shape
    c = m + ny
    T = subspace.states[:order]
    X, ahead = T @ factor[:-c], T @ factor[c:]
    U, Y = factor[-c:-ny], factor[-ny:]
    C, D = _output_regression(X, U, Y, subspace.direct)
    E = Y - C @ X - D @ U
    parts = np.zeros((order, order + c))
    if order:
        parts = scaled_lstsq(np.vstack([X, U, E]).T, ahead.T)[0].T
    A, B, K = np.split(parts, [order, order + m], axis=1)
    if not spectral_radius(A - K @ C) < 1.0:
        K = _riccati_gain(A, C, ahead - A @ X - B @ U, E, n)
    return Innovation(A, B, C, D, K, E @ E.T / n)


def errors_by_order(subspace: PredictorSubspace, highest: int) -> list[Array]:
    """What the states of every order leave of the outputs, these scaled to one."""
    ny, m = subspace.direct.shape
    Z, U, Y = np.split(subspace.factor, [-m - ny, -ny])
    size = np.linalg.norm(Y, axis=1, keepdims=True)
    Y = Y / np.where(size > 0.0, size, 1.0)
    errors = []
    for order in range(min(highest, len(subspace.states)) + 1):
        X = subspace.states[:order] @ Z
        C, D = _output_regression(X, U, Y, subspace.direct)
        errors.append(Y - C @ X - D @ U)
    return errors


def criteria_by_order(errors: Sequence[Array], subspace: PredictorSubspace) -> Array:
    """Criterion of Hannan and Quinn of every order of plant and noise, per sample.

    ``log det S + 2 n_parameters log log n / n``, S the moments of what an order leaves,
    and ``order (n_inputs + 2 n_outputs)`` parameters besides D. A state too few spoils
    the plant, one too many costs little, whence no heavier penalty; it finds the order
    in the long run.
    """
    n, (ny, m) = subspace.n_columns, subspace.direct.shape
    floor = NO_INNOVATION * np.eye(ny)
    each = 2.0 * (m + 2 * ny) * np.log(np.log(max(n, 3)))
    volumes = [np.linalg.slogdet(E @ E.T + floor)[1] for E in errors]
    least = ny * np.log(NO_INNOVATION)  # but for rounding
    return np.maximum(volumes, least) + each / n * np.arange(len(errors))


def _output_regression(
    X: Array, U: Array, Y: Array, direct: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Coefficients of Y in X, and in those inputs that D lets act at once."""
    C, D = np.zeros((len(Y), len(X))), np.zeros(direct.shape)
    # Outputs with the same free entries share their regressors.
    for mask in np.unique(direct, axis=0):
        outputs = np.flatnonzero((direct == mask).all(axis=1))
        solution = scaled_lstsq(np.vstack([X, U[mask]]).T, Y[outputs].T)[0].T
        C[outputs] = solution[:, : len(X)]
        D[np.ix_(outputs, np.flatnonzero(mask))] = solution[:, len(X) :]
    return C, D


def _riccati_gain(A: Array, C: Array, W: Array, E: Array, n_columns: int) -> Array:
    """Kalman gain from the residuals of the state and of the output equation."""
    Q, S, R = (M / n_columns for M in (W @ W.T, W @ E.T, E @ E.T))
    Q = Q + _RICCATI_FLOOR * np.trace(Q) / len(Q) * np.eye(len(Q))
    try:
        return kalman_filter(A, C, Q, S, R).gain
    except ValueError:  # of SciPy, in its own words
        raise ValueError(
            f"No predictor of {len(A)} states, of plant and noise together, is found "
            "for these samples: their outputs grow beyond what numbers resolve, or "
            "follow from fewer states. Use a lower `order` or method='po-moesp', or "
            "give samples before the outputs have grown."
        ) from None
