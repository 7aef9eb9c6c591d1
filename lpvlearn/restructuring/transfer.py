"""Transfer functions of small models on the frequency axis, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Target:
    """A model by its matrices; `dt` None is continuous time."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float | None = None

    def repeated(self, copies: int) -> Target:
        """The model side by side, once for every channel: block-diagonal."""
        eye = np.eye(copies)
        A, B, C, D = (
            np.asarray(np.kron(eye, M), dtype=float)
            for M in (self.A, self.B, self.C, self.D)
        )
        return Target(A, B, C, D, self.dt)


def laplace_variable(
    omega: Array, dt: float | None
) -> tuple[Complex, Complex, Complex]:
    """``s(omega)`` and its two derivatives: ``j omega`` or ``exp(j omega dt)``."""
    if dt is None:
        zero = np.zeros(len(omega), complex)
        s = zero.copy()
        s.imag = omega  # 1j * inf is not a number
        return s, zero + 1j, zero
    z = np.exp(1j * omega * dt)
    return z, 1j * dt * z, -(dt**2) * z


def resolvent(A: Array, s: Complex) -> Complex:
    """``(s I - A)^-1`` for every `s`; zero at infinity."""
    finite = np.isfinite(s)
    M = np.where(finite, s, 0.0)[:, None, None] * np.eye(len(A)) - A
    if not finite.all():
        M[~finite] = np.eye(len(A))
    inverse: Complex = np.linalg.inv(M.astype(complex))
    inverse[~finite] = 0.0
    return inverse


def model_derivatives(model: Target, omega: Array) -> tuple[Complex, Complex, Complex]:
    """Frequency response of a model and its first two derivatives in frequency."""
    s, s1, s2 = laplace_variable(omega, model.dt)
    s1, s2 = s1[:, None, None], s2[:, None, None]
    P = resolvent(model.A, s)
    PB = P @ model.B
    X = P @ PB
    first = -s1 * (model.C @ X)
    second = 2.0 * s1**2 * (model.C @ (P @ X)) - s2 * (model.C @ X)
    return model.C @ PB + model.D, first, second


def series(
    A: Array, B: Array, C: Array, D: Array, weight: Target
) -> tuple[Array, Array, Array, Array]:
    """Realisation of the weight after a model."""
    n, k = len(A), len(weight.A)
    As = np.zeros((n + k, n + k))
    As[:n, :n], As[n:, n:] = A, weight.A
    As[n:, :n] = weight.B @ C
    return (
        As,
        np.vstack([B, weight.B @ D]),
        np.hstack([weight.D @ C, weight.C]),
        weight.D @ D,
    )
