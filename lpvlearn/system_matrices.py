"""The matrices of a state-space model: shapes, checks, read-only storage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import matrix, positive_time

Array = NDArray[np.float64]
Blocks = tuple[Array, Array, Array, Array]


@dataclass(frozen=True, eq=False, repr=False, init=False)
class SystemMatrices:
    """Matrices A, B, C, D that fit together, and a sampling time.

    Parameters
    ----------
    A : array-like of shape (order, order)
    B : array-like of shape (order, n_inputs)
    C : array-like of shape (n_outputs, order)
    D : array-like of shape (n_outputs, n_inputs), default=None
    sampling_time : float, default=None

    Raises
    ------
    ValueError
        If the shapes do not fit together, or an entry is not a finite real number.

    Examples
    --------
    >>> SystemMatrices([[0, 1], [-4, -1]], [[0], [1]], [[1, 0]]).order
    2
    """

    A: Array
    B: Array
    C: Array
    D: Array
    sampling_time: float | None

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike | None = None,
        sampling_time: float | None = None,
    ) -> None:
        A, B, C = matrix("A", A), matrix("B", B), matrix("C", C)
        n = len(A)
        if A.shape != (n, n):
            raise ValueError(f"`A` must be square. Got shape {A.shape}.")
        if D is not None:
            D = matrix("D", D)
            if n == 0:  # a pure gain: `[]` for B and C takes its shape from D
                B = np.zeros((0, D.shape[1])) if B.shape == (0, 0) else B
                C = np.zeros((D.shape[0], 0)) if C.shape == (0, 0) else C
        if B.shape[0] != n or C.shape[1] != n:
            raise ValueError(
                f"`B` needs {n} rows and `C` {n} columns to fit `A` of shape "
                f"{A.shape}. Got B {B.shape}, C {C.shape}."
            )
        shape = (C.shape[0], B.shape[1])
        D = np.zeros(shape) if D is None else D
        if D.shape != shape:
            raise ValueError(
                f"`D` must have shape {shape} to fit B and C. Got {D.shape}."
            )
        if 0 in shape:
            raise ValueError(
                "a model needs at least one input and one output; a pure gain takes "
                f"them from `D`. Got {shape[1]} inputs and {shape[0]} outputs."
            )
        for name, value in zip("ABCD", (A, B, C, D), strict=True):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if sampling_time is not None:
            sampling_time = positive_time("sampling_time", sampling_time)
        object.__setattr__(self, "sampling_time", sampling_time)

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles are built anew, so that their arrays are read-only too.
        return type(self), (self.A, self.B, self.C, self.D, self.sampling_time)

    def __repr__(self) -> str:
        time = (
            "continuous time"
            if self.sampling_time is None
            else f"sampling_time={self.sampling_time:g}"
        )
        return (
            f"{type(self).__name__}(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, {time})"
        )

    @property
    def order(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.D.shape[1]

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.D.shape[0]

    @property
    def is_continuous(self) -> bool:
        """True for a continuous-time model."""
        return self.sampling_time is None


def sorted_poles(A: Array) -> NDArray[np.complex128]:
    """Eigenvalues of (..., n, n) matrices, by modulus, real part, imaginary part."""
    poles = np.linalg.eigvals(A).astype(complex)
    order = np.lexsort((poles.imag, poles.real, np.abs(poles)), axis=-1)
    return np.take_along_axis(poles, order, axis=-1)


def blocks(S: Array, order: int) -> Blocks:
    """A, B, C, D of ``S = [[A, B], [C, D]]``, stacked over its leading axes.

    Examples
    --------
    >>> A, B, C, D = blocks(np.arange(4.0).reshape(2, 2), 1)
    >>> float(B[0, 0])
    1.0
    """
    n = order
    return S[..., :n, :n], S[..., :n, n:], S[..., n:, :n], S[..., n:, n:]


def stack_system(
    source: str,
    blocks: Sequence[Any],
    shape: tuple[int, int, int],
    lead: tuple[int, ...],
) -> NDArray[Any]:
    """``[[A, B], [C, D]]`` from (A, B, C) or (A, B, C, D), after `lead` axes.

    Parameters
    ----------
    source : str
        Name of the function that returned the blocks, for the message.
    blocks : sequence of array-like
    shape : tuple of int
        order, n_inputs, n_outputs.
    lead : tuple of int
        Leading axes that all blocks have.

    Raises
    ------
    ValueError
        If a block has another shape.
    """
    n, m, p = shape
    given = [np.asarray(block) for block in blocks if block is not None]
    S = np.zeros((*lead, n + p, n + m), np.result_type(float, *given))
    corners = ((0, 0, n, n), (0, n, n, m), (n, 0, p, n), (n, n, p, m))
    for i, (row, column, height, width) in enumerate(corners):
        if i >= len(blocks) or blocks[i] is None:
            continue
        array, expected = np.asarray(blocks[i]), (*lead, height, width)
        if array.shape != expected:
            if array.size != np.prod(expected):
                raise ValueError(
                    f"`{source}` must return `{'ABCD'[i]}` of shape {expected}. Got "
                    f"{array.shape}."
                )
            array = array.reshape(expected)
        S[..., row : row + height, column : column + width] = array
    return S
