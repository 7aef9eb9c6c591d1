"""Conversions between continuous and discrete time (zero-order hold, Tustin)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import logm, matrix_balance, schur, solve_sylvester

from .simulation import sample_zoh

Array = NDArray[Any]

# Eigenvectors worse conditioned than this are not used as coordinates.
_MODAL_CONDITION = 1e4

# Rounding moves a pole of multiplicity k by about eps^(1/k). A complex pair this near
# the negative real axis counts as two poles on it, which is as exact.
_MOVED = 1e-4

_ROUND_TRIP = 1e-6


def c2d_zoh(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """``[Ad Bd; 0 I] = exp([A B; 0 0] dt)``: exact for inputs held over `dt`.

    Parameters
    ----------
    A : ndarray of shape (n, n)
    B : ndarray of shape (n, n_inputs)
    dt : float
        Sampling time, seconds.

    Returns
    -------
    Ad, Bd : ndarray
        The feedthrough and the output matrix do not change.

    Raises
    ------
    ValueError
        If the exponential overflows.

    Examples
    --------
    >>> import numpy as np
    >>> Ad, Bd = c2d_zoh(np.array([[0.0]]), np.array([[3.0]]), 0.5)
    >>> Ad, Bd
    (array([[1.]]), array([[1.5]]))
    """
    return sample_zoh(A, B, dt)


def d2c_zoh(A: Array, B: Array, C: Array, dt: float) -> tuple[Array, Array, Array]:
    """Inverse of `c2d_zoh` by the matrix logarithm.

    A real pole on the negative axis has no real logarithm. As in the control
    literature, it becomes a complex pair at the Nyquist frequency: the response at
    the sampling instants stays exact and the order grows by one (with a warning).

    Parameters
    ----------
    A, B, C : ndarray
        Shapes (n, n), (n, n_inputs), (n_outputs, n).
    dt : float
        Sampling time, seconds.

    Returns
    -------
    A, B, C : ndarray
        The continuous model in the same state basis (the states of poles on the
        negative axis come twice); the feedthrough does not change.

    Raises
    ------
    ValueError
        If a pole is at the origin (a pure delay has no continuous equivalent), or the
        logarithm is lost in rounding.

    Warns
    -----
    RuntimeWarning
        If a pole lies on the negative real axis.

    Examples
    --------
    >>> import numpy as np
    >>> A, B, C = d2c_zoh(np.array([[1.0]]), np.array([[1.5]]), np.ones((1, 1)), 0.5)
    >>> A, B
    (array([[0.]]), array([[3.]]))
    """
    n = len(A)
    if n == 0:
        return A.copy(), B.copy(), C.copy()
    A, (scale, _) = matrix_balance(A, permute=False, separate=True)
    poles = np.linalg.eigvals(A)
    size = np.abs(poles)
    if _has_eigenvalue(A, poles, 0.0, tol=1e-10):
        raise ValueError(
            "`method='zoh'` needs poles away from the origin: a pole at "
            f"{size.min():.1e} is a pure delay and has no continuous equivalent. Use "
            "`method='tustin'` or a lower order."
        )
    negative = _on_negative_axis(poles.real, poles.imag)
    if negative.any():
        warnings.warn(
            f"{int(negative.sum())} pole(s) on the negative real axis "
            f"({', '.join(f'{p:.3g}' for p in poles[negative].real)}) have no real "
            "logarithm; each becomes a pair at the Nyquist frequency and the order "
            "grows by one. A shorter sampling time or a lower order avoids it.",
            RuntimeWarning,
            stacklevel=3,
        )
        L = _extended_logarithm(A)
        extra = len(L) - n
        scale = np.concatenate([scale, np.ones(extra)])
        B = np.vstack([B, np.zeros((extra, B.shape[1]))])
        C = np.hstack([C, np.zeros((C.shape[0], extra))])
    else:
        L = _logarithm(A)
    # B enters the sampled model through the integral of exp(A t) over one hold
    back, hold = c2d_zoh(L, np.eye(len(L)), 1.0)
    if np.abs(back[:n, :n] - A).max() > _ROUND_TRIP * np.abs(A).max():
        raise ValueError(
            "`method='zoh'` needs a state matrix with an accurate logarithm. Got poles "
            f"{np.array2string(poles, precision=3)}, too near to one another or to the "
            "origin. Use `method='tustin'` or a lower order."
        )
    B_c = scale[:, None] * np.linalg.solve(hold, B / scale[:, None]) / dt
    return scale[:, None] * L / scale / dt, B_c, C.copy()


def _has_eigenvalue(A: Array, poles: NDArray, value: float, tol: float) -> bool:
    """Whether `value` is a pole, also a multiple one that rounding has moved."""
    distance = np.abs(poles - value).min()
    largest = max(1.0, float(np.abs(poles).max()))
    if distance <= tol * largest:
        return True
    if distance > _MOVED * largest:
        return False
    singular = np.linalg.svd(A - value * np.eye(len(A)), compute_uv=False)
    return bool(singular[-1] <= 1e-15 * len(A) * max(singular[0], 1.0))


def _on_negative_axis(real: NDArray, imag: NDArray) -> NDArray[np.bool_]:
    return (real < 0) & (np.abs(imag) <= -_MOVED * real)


def _logarithm(A: Array) -> Array:
    """Real principal logarithm of a matrix without poles on the negative axis."""
    poles, V = np.linalg.eig(A)
    if np.linalg.cond(V) <= _MODAL_CONDITION:
        return np.real((V * np.log(poles.astype(complex))) @ np.linalg.inv(V))
    with warnings.catch_warnings():  # its estimate of the error warns at 2e-13
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.real(logm(A))


def _extended_logarithm(A: Array) -> Array:
    """Real `L` of order n + k with ``exp(L) = diag(A, N)``.

    N holds the k poles of A on the negative axis once more: with a twin,
    ``diag(N, N) = exp([log(-N), -pi I; pi I, log(-N)])`` is real.
    """
    n = len(A)
    T, Z, k = schur(A, sort=lambda re, im=0.0: _on_negative_axis(re, im))
    # Decouple the poles on the axis from the others
    Y = solve_sylvester(T[:k, :k], -T[k:, k:], -T[:k, k:]) if k < n else T[:k, k:]
    V = np.eye(n + k)
    V[:n, :k], V[:n, k:n] = Z[:, :k], Z[:, :k] @ Y + Z[:, k:]
    L = np.zeros((n + k, n + k))
    L[:k, :k] = L[n:, n:] = _logarithm(-T[:k, :k])
    if k < n:
        L[k:n, k:n] = _logarithm(T[k:, k:])
    L[n:, :k] = np.pi * np.eye(k)
    L[:k, n:] = -L[n:, :k]
    return np.linalg.solve(V.T, (V @ L).T).T


def c2d_tustin(
    A: Array, B: Array, C: Array, D: Array, dt: float
) -> tuple[Array, Array, Array, Array]:
    """Bilinear transformation ``s = (2/dt) (z - 1) / (z + 1)``.

    Parameters
    ----------
    A, B, C, D : ndarray
        Shapes (n, n), (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs).
    dt : float
        Sampling time, seconds.

    Returns
    -------
    A, B, C, D : ndarray

    Raises
    ------
    ValueError
        If a pole is at ``2/dt``, which the transformation sends to infinity.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.ones((1, 1))
    >>> [float(M[0, 0]) for M in c2d_tustin(-one, one, one, 0 * one, dt=2.0)]
    [0.0, 1.0, 0.5, 0.5]
    """
    n = len(A)
    half = 0.5 * dt
    if n and _has_eigenvalue(half * A, half * np.linalg.eigvals(A), 1.0, tol=1e-13):
        raise ValueError(
            f"`method='tustin'` needs poles away from 2 / sampling_time = {2 / dt:.6g} "
            "rad/s. Use another sampling time or `method='zoh'`."
        )
    M = np.eye(n) - half * A
    Ad = np.linalg.solve(M, np.eye(n) + half * A)
    Bd = np.linalg.solve(M, dt * B)
    Cd = np.linalg.solve(M.T, C.T).T
    return Ad, Bd, Cd, D + half * (Cd @ B)


def d2c_tustin(
    A: Array, B: Array, C: Array, D: Array, dt: float
) -> tuple[Array, Array, Array, Array]:
    """Inverse of `c2d_tustin`: ``z = (1 + s dt / 2) / (1 - s dt / 2)``.

    Parameters
    ----------
    A, B, C, D : ndarray
        Shapes (n, n), (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs).
    dt : float
        Sampling time, seconds.

    Returns
    -------
    A, B, C, D : ndarray

    Raises
    ------
    ValueError
        If a pole is at -1, which the transformation sends to infinity.

    Examples
    --------
    >>> import numpy as np
    >>> A, one = np.zeros((1, 1)), np.ones((1, 1))
    >>> [float(M[0, 0]) for M in d2c_tustin(A, one, 0.5 * one, 0.5 * one, dt=2.0)]
    [-1.0, 1.0, 1.0, 0.0]
    """
    n = len(A)
    if n and _has_eigenvalue(A, np.linalg.eigvals(A), -1.0, tol=1e-13):
        raise ValueError(
            "`method='tustin'` needs poles away from -1: I + A is singular. Use "
            "`method='zoh'` or a lower order."
        )
    M = np.eye(n) + A
    Ac = (2.0 / dt) * np.linalg.solve(M.T, (A - np.eye(n)).T).T
    inv_B = np.linalg.solve(M, B)
    Cc = np.linalg.solve(M.T, C.T).T
    return Ac, (2.0 / dt) * inv_B, 2.0 * Cc, D - C @ inv_B
