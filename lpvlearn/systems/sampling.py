"""Conversions between continuous and discrete time (holds of two orders, Tustin)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur, solve_sylvester, sqrtm
from scipy.special import factorial

from .balancing import in_even_units

Array = NDArray[Any]

# Norm to which matrices are scaled for the Taylor polynomial of degree 11 of their
# exponential: its first neglected term, 0.25^12 / 12! = 1e-16, is below rounding.
_TAYLOR_NORM = 0.25

# Logarithms by eigenvectors lose as many digits as their condition number has; worse
# ones take roots, ten times slower.
_MODAL_CONDITION = 1e4

# Of a matrix as near to one as this (1-norm) the logarithm by so many nodes is exact to
# rounding; each root comes nearer by half.
_NEAR_ONE, _N_NODES, _MOST_ROOTS = 0.25, 7, 100

# Rounding moves a pole of multiplicity k by about eps^(1/k). A complex pair this near
# the negative real axis counts as two poles on it, which is as exact.
_MOVED = 1e-4

# A pole nearer to the origin, relative to the largest, has no digits left in its
# logarithm once sampled; one nearer to the pole of the bilinear map is on it (its image
# is beyond 1e13, and all other entries are lost in it).
_AT_ORIGIN = 1e-10
_AT_MAPS_POLE = 1e-13

_ROUND_TRIP = 1e-6  # to which exp(log(A)) must return A, or the logarithm is refused


def sample_zoh(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """Zero-order-hold equivalents of stacked continuous ``(A, B)``.

    ``exp([A B; 0 0] dt) = [Ad Bd; 0 I]``: exact for inputs held over `dt`. Raises a
    ValueError if it overflows (an unstable pole, far too fast for `dt`).
    """
    n = A.shape[-1]
    E = _driven(A, B, dt, 1)
    return E[..., :n, :n], E[..., :n, n:]


def sample_foh(A: Array, B: Array, dt: float) -> tuple[Array, Array, Array]:
    """First-order-hold equivalents of stacked continuous ``(A, B)``.

    ``x[k+1] = Ad x[k] + B0 u[k] + B1 (u[k+1] - u[k])``, with
    ``exp([A B 0; 0 0 I/dt; 0 0 0] dt) = [Ad B0 B1; 0 I I; 0 0 I]``: exact for inputs
    that are linear between samples. Raises a ValueError as `sample_zoh`.
    """
    n, m = B.shape[-2:]
    E = _driven(A, B, dt, 2)
    return E[..., :n, :n], E[..., :n, n : n + m], E[..., :n, n + m :]


def _driven(A: Array, B: Array, dt: float, n_terms: int) -> Array:
    """Exponentials over `dt` of ``(A, B)`` with inputs that are sums of so many powers.

    Of ``u + change t / dt + ...``, whose terms are states.
    """
    n, m = B.shape[-2:]
    M = np.zeros(A.shape[:-2] + (n + n_terms * m,) * 2)
    with np.errstate(over="ignore", invalid="ignore"):
        M[..., :n, :n] = A * dt
        M[..., :n, n : n + m] = B * dt
        M[..., n : n + (n_terms - 1) * m, n + m :] = np.eye((n_terms - 1) * m)
        E = _expm(M)
    if not np.isfinite(E).all():
        fastest = np.linalg.eigvals(A).real.max()
        raise ValueError(
            "`sampling_time` must be short for the fastest pole: the sampled model "
            f"overflows. Got {dt:g} s, and a pole of real part {fastest:.3g} rad/s."
        )
    return E


def c2d_foh(
    A: Array, B: Array, C: Array, D: Array, dt: float
) -> tuple[Array, Array, Array, Array]:
    """First-order-hold equivalent, in the state ``x[k] - B1 u[k]`` (see `sample_foh`).

    In that the inputs that are still to come do not enter: ``Bd = Ad B1 + B0 - B1``,
    ``Dd = D + C B1``.
    """
    Ad, B0, B1 = sample_foh(A, B, dt)
    return Ad, Ad @ B1 + B0 - B1, C.copy(), D + C @ B1


def sample_zoh_late(
    A: Array, B: Array, C: Array, D: Array, dt: float, late: Array
) -> tuple[Array, Array, Array, Array]:
    """Zero-order-hold equivalent with inputs that change after the sampling instants.

    Input j does so by the share ``late[j]`` (0 to 1) of a period. The value that it had
    before is a state more for each of them where that is not 0. Exact (the modified
    z-transform of the hold).
    """
    which, n = np.flatnonzero(late), len(A)
    Ad, held = sample_zoh(A, B, dt)
    new, direct = held.copy(), D.copy()
    for j in which:
        new[:, j] = sample_zoh(A, B[:, [j]], (1.0 - late[j]) * dt)[1][:, 0]
        direct[:, j] = 0.0
    extended = np.zeros((n + len(which),) * 2)
    extended[:n, :n], extended[:n, n:] = Ad, (held - new)[:, which]
    inputs = np.vstack([new, np.eye(B.shape[1])[which]])
    return extended, inputs, np.hstack([C, D[:, which]]), direct


def _expm(M: Array) -> Array:
    """Exponentials of a stack of matrices, shape (..., n, n).

    Scaling and squaring of a Taylor polynomial (Paterson and Stockmeyer, degree 11 with
    four products), all matrices at once. ``F = exp(X) - I`` is squared, where
    `scipy.linalg.expm` squares ``exp(X)``: there slow modes drown in the identity.
    Beside a mode of 1e6 (1e9) per sample they come out to 2e-16 (7e-16) here, to
    5e-11 (6e-8) there. 30,000 matrices of order 3 take 27 ms instead of 180.
    """
    norm = float(np.abs(M).sum(-2).max(initial=0.0))
    if not np.isfinite(norm):
        return np.full_like(M, np.nan)
    squarings = max(0, int(np.ceil(np.log2(norm / _TAYLOR_NORM)))) if norm > 0 else 0
    X = M / 2.0**squarings
    eye = np.eye(M.shape[-1])
    c = 1.0 / factorial(np.arange(12))
    X2 = X @ X
    X3 = X2 @ X
    P = [c[k] * eye + c[k + 1] * X + c[k + 2] * X2 for k in (3, 6, 9)]
    F = ((P[2] @ X3 + P[1]) @ X3 + P[0]) @ X3 + X + 0.5 * X2
    for _ in range(squarings):
        F = 2.0 * F + F @ F
    return F + eye


class Held(NamedTuple):
    """A continuous-time model whose inputs are held over a sampling period."""

    A: Array
    B: Array
    C: Array
    D: Array
    doubled: Array  # the sampled model's poles on the negative axis: pairs now


def d2c_held(
    A: Array, B: Array, C: Array, D: Array, dt: float, method: str = "zoh"
) -> Held:
    """Inverse of `sample_zoh`, or `c2d_foh`, by the matrix logarithm.

    A real pole on the negative axis has no real logarithm. As in the control
    literature, it becomes a complex pair at the Nyquist frequency: the response at
    the sampling instants stays exact and the order grows by one.

    The model keeps its state basis (the states of poles on the negative axis come
    twice), behind a hold of order zero its feedthrough too. Raises a ValueError if a
    pole is at the origin (a pure delay has no continuous equivalent), or the logarithm
    is lost in rounding.
    """
    n = len(A)
    if n == 0:
        return Held(A.copy(), B.copy(), C.copy(), D.copy(), np.empty(0))
    A, scale = in_even_units(A)
    poles = np.linalg.eigvals(A)
    size = np.abs(poles)
    if _has_eigenvalue(A, poles, 0.0, tol=_AT_ORIGIN):
        raise ValueError(
            f"`method={method!r}` needs poles away from the origin: a pole at "
            f"{size.min():.1e} is a pure delay and has no continuous equivalent. Use "
            "`method='tustin'`, an `input_delay` in its place, or a lower order."
        )
    negative = _on_negative_axis(poles.real, poles.imag)
    if negative.any():
        L = _extended_logarithm(A)
        extra = len(L) - n
        scale = np.concatenate([scale, np.ones(extra)])
        B = np.vstack([B, np.zeros((extra, B.shape[1]))])
        C = np.hstack([C, np.zeros((C.shape[0], extra))])
    else:
        L = _logarithm(A)
    # B enters the sampled model through integrals of exp(A t) over one hold
    eye = np.eye(len(L))
    if method == "zoh":
        (back, hold), ramp = sample_zoh(L, eye, 1.0), np.zeros_like(L)
    else:
        back, hold, _, ramp = c2d_foh(L, eye, eye, np.zeros_like(L), 1.0)
    if np.abs(back[:n, :n] - A).max() > _ROUND_TRIP * np.abs(A).max():
        raise ValueError(
            f"`method={method!r}` needs a state matrix with an accurate logarithm. Got "
            f"poles {np.array2string(poles, precision=3)}, too near to one another or "
            "to the origin. Use `method='tustin'` or a lower order."
        )
    moved = np.linalg.solve(hold, B / scale[:, None])
    return Held(
        scale[:, None] * L / scale / dt,
        scale[:, None] * moved / dt,
        C.copy(),
        D - C * scale @ ramp @ moved,
        poles[negative].real,
    )


def _has_eigenvalue(A: Array, poles: NDArray, value: float, tol: float) -> bool:
    """Whether `value` is a pole, also a multiple one that rounding has moved."""
    distance = np.abs(poles - value).min(initial=np.inf)
    largest = max(1.0, float(np.abs(poles).max(initial=0.0)))
    if distance <= tol * largest:
        return True
    if distance > _MOVED * largest:
        return False
    singular = np.linalg.svd(A - value * np.eye(len(A)), compute_uv=False)
    # A few units of rounding for every state.
    return bool(singular[-1] <= 1e-15 * len(A) * max(singular[0], 1.0))


def _on_negative_axis(real: NDArray, imag: NDArray) -> NDArray[np.bool_]:
    return (real < 0) & (np.abs(imag) <= -_MOVED * real)


def _logarithm(A: Array) -> Array:
    """Real principal logarithm of a matrix without poles on the negative axis.

    In modal form, or near a defective matrix by inverse scaling and squaring (Higham,
    *Functions of Matrices*, 2008, Section 11.5): of a root of A near one the integral
    ``log(I + X) = int_0^1 (I + t X)^-1 X dt`` by Gauss and Legendre, which is Pade's
    approximation.
    """
    poles, V = np.linalg.eig(A)
    if np.linalg.cond(V) <= _MODAL_CONDITION:
        return np.real((V * np.log(poles.astype(complex))) @ np.linalg.inv(V))
    T, Z = schur(A, output="complex")
    eye, scale = np.eye(len(A)), 1.0
    for _ in range(_MOST_ROOTS):
        if not np.linalg.norm(T - eye, 1) > _NEAR_ONE:
            break
        T, scale = sqrtm(T).astype(complex), 2.0 * scale
    X, (nodes, weights) = T - eye, np.polynomial.legendre.leggauss(_N_NODES)
    t = 0.5 * (nodes[:, None, None] + 1.0)
    L = scale * np.tensordot(0.5 * weights, np.linalg.solve(eye + t * X, X), 1)
    return np.real(Z @ L @ Z.conj().T)


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

    Raises a ValueError if a pole is at ``2/dt``, which it sends to infinity.
    """
    half = 0.5 * dt
    if _has_eigenvalue(half * A, half * np.linalg.eigvals(A), 1.0, _AT_MAPS_POLE):
        raise ValueError(
            f"`method='tustin'` needs poles away from 2 / sampling_time = {2 / dt:.6g} "
            "rad/s. Use another sampling time or `method='zoh'`."
        )
    return _bilinear(half * A, half * B, C, D)


def d2c_tustin(
    A: Array, B: Array, C: Array, D: Array, dt: float
) -> tuple[Array, Array, Array, Array]:
    """Inverse of `c2d_tustin`: ``z = (1 + s dt / 2) / (1 - s dt / 2)``.

    Raises a ValueError if a pole is at -1, which it sends to infinity.
    """
    if _has_eigenvalue(A, np.linalg.eigvals(A), -1.0, _AT_MAPS_POLE):
        raise ValueError(
            "`method='tustin'` needs poles away from -1: I + A is singular. Use "
            "`method='zoh'` or a lower order."
        )
    A, B, C, D = _bilinear(-A, B, -C, D)
    return (-2.0 / dt) * A, B / dt, -2.0 * C, D


def _bilinear(
    A: Array, B: Array, C: Array, D: Array
) -> tuple[Array, Array, Array, Array]:
    """``z = (1 + s) / (1 - s)``, which is its own inverse but for signs.

    `scipy.signal.cont2discrete` has no way back, and warns of a singular matrix where
    only the units of the states are far apart (1e6).
    """
    M = np.eye(len(A)) - A
    right = np.linalg.solve(M, B)
    return (
        np.linalg.solve(M, np.eye(len(A)) + A),
        2.0 * right,
        np.linalg.solve(M.T, C.T).T,
        D + C @ right,
    )
