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
    if len(A) == 0:  # LAPACK would complain on the terminal
        return A, np.ones(0)
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
    return _factors(_schur(A[None]), B[None], discrete)[0]


class _Schur(NamedTuple):
    """``A = S Q T Q^H S^-1``, T upper triangular, S diagonal to balance A; stacked."""

    scale: Array  # (k, n), diagonals of S
    Q: NDArray[np.complex128]
    T: NDArray[np.complex128]

    def transposed(self) -> _Schur:
        """That of ``A^T``, states in the reverse order."""
        T = self.T.swapaxes(1, 2)[:, ::-1, ::-1]
        return _Schur(1.0 / self.scale, self.Q.conj()[:, :, ::-1], T)


def _schur(A: Array) -> _Schur:
    scale = np.ones(A.shape[:2])
    Q, T = np.zeros((2, *A.shape), dtype=complex)
    for k in range(len(A) if A.size else 0):
        even, scale[k] = in_even_units(A[k])
        # `scipy.linalg.schur` asks LAPACK for the size of its work: 60 us, not 20
        T[k], _, _, Q[k], _, info = lapack.zgees(lambda _: None, even + 0j)
        if info:
            raise LinAlgError("eigenvalues of `A` did not converge: take other units.")
    return _Schur(scale, Q, T)


def _factors(of_A: _Schur, B: Array, discrete: bool) -> Array:
    """As `gramian_factor`, of stacked pairs."""
    scale, Q, T = of_A
    n, poles = T.shape[-1], T.diagonal(axis1=1, axis2=2)[..., None]
    if n == 0:
        return np.zeros(T.shape)
    margin = 1.0 - np.abs(poles) if discrete else -poles.real
    if not (margin > 0).all():
        worst = poles.ravel()[margin.argmin()]
        raise ValueError(
            "`A` must be stable, beyond rounding, for a Gramian. Got a pole at "
            f"{worst:.4g}."
        )
    F = Q.conj().swapaxes(1, 2) @ (B / scale[..., None])
    # lest squares overflow; by a power of two, which rounds nothing
    size = np.abs(F).max(axis=(1, 2), keepdims=True, initial=_SMALLEST)
    unit = np.ldexp(1.0, np.frexp(size)[1])
    F /= unit
    L = np.zeros(T.shape, dtype=complex)
    # Column k from the last input direction that state k receives; what is left of
    # the earlier states is a Lyapunov equation of order k, with the input F[:k].
    for k in range(n - 1, -1, -1):
        pole, head, column = poles[:, k], T[:, :k, :k], T[:, :k, k]
        size = np.linalg.norm(F[:, k], axis=1, keepdims=True)
        direction = F[:, k] / np.where(size > 0, size, 1.0)
        along = _times(F[:, :k], direction.conj())
        if discrete:
            root = np.sqrt(margin[:, k] * (1.0 + np.abs(pole)))
            rhs = pole.conj() * column * (size / root) + root * along
            above = _solution(np.eye(k) - pole.conj()[..., None] * head, rhs)
            moved = _times(head, above) + column * (size / root)
            change = root * moved - (1.0 + pole) * along
        else:
            root = np.sqrt(2.0 * margin[:, k])
            rhs = -column * (size / root) - root * along
            above = _solution(head + pole.conj()[..., None] * np.eye(k), rhs)
            change = -root * above
        L[:, k, k], L[:, :k, k] = (size / root)[:, 0], above
        F[:, :k] += change[..., None] * direction[:, None]
    factor = Q @ L
    # W is real, so the real and imaginary parts side by side are a factor too.
    side_by_side = np.concatenate([factor.real, factor.imag], axis=2)
    R = np.asarray(np.linalg.qr(side_by_side.swapaxes(1, 2), mode="r"))
    return unit * scale[..., None] * R.swapaxes(1, 2)


def _times(M: NDArray, x: NDArray) -> NDArray:
    return (M @ x[..., None])[..., 0]


def _solution(M: NDArray, x: NDArray) -> NDArray:
    return np.linalg.solve(M, x[..., None])[..., 0]


class Balancing(NamedTuple):
    """Hankel singular values (n,), descending, and the projections that balance.

    ``left @ right = I``, of shapes (r, n) and (n, r), and ``(left A right, left B,
    C right)`` is balanced. `r` is less than `n` when the remaining values are rounding
    noise (states not controllable or not observable).
    """

    hankel: Array
    left: Array
    right: Array


def balancing_transformation(A: Array, B: Array, C: Array, discrete: bool) -> Balancing:
    """The balancing of a stable model."""
    return balancing_transformations(A[None], B[None], C[None], discrete)[0]


def balancing_transformations(
    A: Array, B: Array, C: Array, discrete: bool
) -> list[Balancing]:
    """Those of stacked stable models, many at a time for little more than one."""
    n = A.shape[-1]
    of_A = _schur(A)
    controllable = _factors(of_A, B, discrete)
    observable = _factors(of_A.transposed(), C.swapaxes(1, 2), discrete)
    with np.errstate(over="ignore", invalid="ignore"):
        product = observable.swapaxes(1, 2) @ controllable
    if not np.isfinite(product).all():
        raise ValueError(
            "`A`, `B` and `C` must have Hankel singular values that are numbers. Got "
            "some beyond all: take other units."
        )
    found = []
    for k, (U, hankel, Vt) in enumerate(zip(*np.linalg.svd(product), strict=True)):
        r = int((hankel > _ROUNDING * max(n, 1) * hankel.max(initial=0.0)).sum())
        root = np.sqrt(hankel[:r])
        left = (U[:, :r] / root).T @ observable[k].T
        found.append(Balancing(hankel, left, controllable[k] @ (Vt[:r].T / root)))
    return found


def align_signs(B: Array, C: Array, B_ref: Array, C_ref: Array) -> Array:
    """Signs (+1 or -1) that bring a balanced realisation next to a reference.

    A balanced realisation with distinct Hankel singular values is unique up to the
    sign of every state; the sign chosen for state ``i`` maximises
    ``B_ref[i] B[i]^T + C_ref[:, i]^T C[:, i]``.
    """
    match = np.einsum("ij,ij->i", B_ref, B) + np.einsum("ji,ji->i", C_ref, C)
    return np.where(match < 0, -1.0, 1.0)
