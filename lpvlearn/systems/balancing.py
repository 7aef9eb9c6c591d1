"""Gramians and balanced realisations (square-root algorithm)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, lapack

Array = NDArray[np.float64]

# Hankel singular values below this, relative to the largest and per state, are rounding
# noise: with factors of the Gramians they are computed to some hundred units of it.
_ROUNDING = 1e-13

_SMALLEST = 1e-200  # of units: what is divided by a smaller one may overflow


def in_even_units(A: Array) -> tuple[Array, Array]:
    """A in units of the states that make its rows and columns alike, and these units.

    SciPy's `matrix_balance` without its integers, which cannot hold units beyond 2^63.

    >>> in_even_units(np.array([[0.0, 2.0**99], [-(2.0**-99), -1.0]]))[0]
    array([[ 0.,  1.],
           [-1., -1.]])
    """
    even, _, _, units, _ = lapack.dgebal(A, scale=True, permute=False)
    return even, units


def gramian_factor(A: Array, B: Array, discrete: bool) -> Array:
    """Factor `L` of the controllability Gramian ``W = L L^T`` of a stable pair.

    ``A W + W A^T + B B^T = 0`` in continuous time, ``A W A^T - W + B B^T = 0`` in
    discrete time. The observability factor is ``gramian_factor(A.T, C.T, ...)``.

    The factor itself is computed, not W: a factor taken from W has lost half of the
    digits. Of 20 random states the smallest Hankel values, 1e-13 of the largest, come
    out to 10 digits here, to 4 by `scipy.linalg.solve_continuous_lyapunov`.

    Raises a ValueError if A is not stable.

    References
    ----------
    .. [1] S. J. Hammarling, "Numerical solution of the stable, non-negative definite
       Lyapunov equation", IMA Journal of Numerical Analysis 2, 1982.
    """
    return _factor(_schur(A), B, discrete)


class _Schur(NamedTuple):
    """``A = S Q T Q^H S^-1``, T upper triangular, S diagonal to balance A."""

    scale: Array  # diagonal of S
    Q: NDArray[np.complex128]
    T: NDArray[np.complex128]

    def transposed(self) -> _Schur:
        """That of ``A^T``, states in the reverse order."""
        T = self.T.T[::-1, ::-1]
        return _Schur(1.0 / self.scale, self.Q.conj()[:, ::-1], T)


def _schur(A: Array) -> _Schur:
    if len(A) == 0:
        return _Schur(np.ones(0), np.zeros((0, 0), complex), np.zeros((0, 0), complex))
    A, scale = in_even_units(A)
    # `scipy.linalg.schur` asks LAPACK for the size of its work: 60 us instead of 20
    T, _, _, Q, _, info = lapack.zgees(lambda _: None, A + 0j)
    if info:
        raise LinAlgError("eigenvalues of `A` did not converge: take other units.")
    return _Schur(scale, Q, T)


def _factor(of_A: _Schur, B: Array, discrete: bool) -> Array:
    """As `gramian_factor`."""
    scale, Q, T = of_A
    n, poles = len(T), T.diagonal()
    if n == 0:
        return np.zeros((0, 0))
    margin = 1.0 - np.abs(poles) if discrete else -poles.real
    if not (margin > 0).all():
        worst = poles[margin.argmin()]
        raise ValueError(
            "`A` must be stable, beyond rounding, for a Gramian. Got a pole at "
            f"{worst:.4g}."
        )
    F = Q.conj().T @ (B / scale[:, None])
    # lest squares overflow; by a power of two, which rounds nothing
    unit = float(np.ldexp(1.0, np.frexp(np.abs(F).max(initial=_SMALLEST))[1]))
    F /= unit
    L = np.zeros((n, n), dtype=complex)
    # Column k from the last input direction that state k receives; what is left of
    # the earlier states is a Lyapunov equation of order k, with the input F[:k].
    for k in range(n - 1, -1, -1):
        pole = poles[k]
        size = np.linalg.norm(F[k])
        direction = F[k] / size if size > 0 else F[k]
        if discrete:
            root = np.sqrt(margin[k] * (1.0 + abs(pole)))
            L[k, k] = size / root
            along = F[:k] @ direction.conj()
            rhs = pole.conj() * T[:k, k] * L[k, k] + root * along
            L[:k, k] = _triangular(np.eye(k) - pole.conj() * T[:k, :k], rhs)
            moved = T[:k, :k] @ L[:k, k] + T[:k, k] * L[k, k]
            change = root * moved - (1.0 + pole) * along
        else:
            root = np.sqrt(2.0 * margin[k])
            L[k, k] = size / root
            rhs = -T[:k, k] * L[k, k] - root * (F[:k] @ direction.conj())
            L[:k, k] = _triangular(T[:k, :k] + pole.conj() * np.eye(k), rhs)
            change = -root * L[:k, k]
        F[:k] += np.outer(change, direction)
    factor = Q @ L
    # W is real, so the real and imaginary parts side by side are a factor too.
    side_by_side = np.hstack([factor.real, factor.imag])
    R = np.asarray(np.linalg.qr(side_by_side.T, mode="r"))
    return unit * scale[:, None] * R.T


def _triangular(U: NDArray, rhs: NDArray) -> NDArray:
    return lapack.ztrtrs(U, rhs)[0] if len(rhs) else rhs  # a fifth of scipy's time


def balancing_transformation(
    A: Array, B: Array, C: Array, discrete: bool
) -> tuple[Array, Array, Array]:
    """Hankel singular values and the balancing projections of a stable model.

    Values (n,), descending; `left` (r, n) and `right` (n, r) with ``left @ right = I``:
    ``(left A right, left B, C right)`` is balanced. `r` is less than `n` when the
    remaining values are rounding noise (states not controllable or not observable).
    """
    n = len(A)
    of_A = _schur(A)
    controllable = _factor(of_A, B, discrete)
    observable = _factor(of_A.transposed(), C.T, discrete)
    with np.errstate(over="ignore", invalid="ignore"):
        product = observable.T @ controllable
    if not np.isfinite(product).all():
        raise ValueError(
            "`A`, `B` and `C` must have Hankel singular values that are numbers. Got "
            "some beyond all: take other units."
        )
    U, hankel, Vt = np.linalg.svd(product)
    r = int((hankel > _ROUNDING * max(n, 1) * hankel.max(initial=0.0)).sum())
    root = np.sqrt(hankel[:r])
    left = (U[:, :r] / root).T @ observable.T
    right = controllable @ (Vt[:r].T / root)
    return hankel, left, right


def align_signs(B: Array, C: Array, B_ref: Array, C_ref: Array) -> Array:
    """Signs (+1 or -1) that bring a balanced realisation next to a reference.

    A balanced realisation with distinct Hankel singular values is unique up to the
    sign of every state; the sign chosen for state ``i`` maximises
    ``B_ref[i] B[i]^T + C_ref[:, i]^T C[:, i]``.
    """
    match = np.einsum("ij,ij->i", B_ref, B) + np.einsum("ji,ji->i", C_ref, C)
    return np.where(match < 0, -1.0, 1.0)
