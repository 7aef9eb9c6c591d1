"""Maps from parameters to the system matrix ``S = [[A, B], [C, D]]``, with derivatives.

A structure holds one of them: an :class:`AffineMap`, the :class:`FunctionMap` of a
user's function, or the :class:`~lpvlearn.structures.mechanical.ImplicitMap` of
equations of motion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..models.system_matrix import stack_system
from .differentiation import (
    numerical_curvature,
    numerical_jacobian,
    symmetric_differences,
)

Array = NDArray[np.float64]

Flags = NDArray[np.bool_]


class StructureMap(ABC):
    """What a structure asks of its map; theta has shape (n_params,)."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of S, (order + n_outputs, order + n_inputs)."""

    @abstractmethod
    def system_matrix(self, theta: Array) -> Array:
        """S; NaN where the parameters give no model."""

    @abstractmethod
    def jacobian(self, theta: Array) -> Array:
        """``dS / dtheta``, shape (n_params, *shape)."""

    @abstractmethod
    def curvature(self, theta: Array) -> Array | None:
        """Second derivatives, (n_params, n_params, *shape); None where all are zero."""

    def fix(self, values: Array, free: Flags) -> StructureMap:
        """The map of the `free` parameters, the others at their `values`."""
        return FixedMap(self, values, free)


@dataclass(frozen=True, eq=False)
class AffineMap(StructureMap):
    """``S(theta) = offset + sum_j theta_j basis_j``, also for stacked theta."""

    offset: Array
    basis: Array

    def __post_init__(self) -> None:
        self.offset.setflags(write=False)
        self.basis.setflags(write=False)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.offset.shape

    def system_matrix(self, theta: Array) -> Array:
        flat = self.basis.reshape(len(self.basis), self.offset.size)
        return self.offset + (theta @ flat).reshape(np.shape(theta)[:-1] + self.shape)

    def jacobian(self, theta: Array) -> Array:
        return self.basis

    def curvature(self, theta: Array) -> None:
        return None

    def fix(self, values: Array, free: Flags) -> AffineMap:
        held = np.tensordot(values[~free], self.basis[~free], 1)
        return AffineMap(self.offset + held, self.basis[free])


@dataclass(frozen=True, eq=False)
class FunctionMap(StructureMap):
    """A smooth function of the user.

    Attributes
    ----------
    function : callable
        Maps theta to A, B, C, D.
    derivatives : callable or None
        Maps theta to the derivatives of the blocks; None differentiates numerically.
    dimensions : tuple of int
        order, n_inputs, n_outputs.
    typical : ndarray of shape (n_params,)
        Usual values: their sizes set the steps of numerical derivatives.
    """

    function: Callable[[Any], Any]
    derivatives: Callable[[Any], Any] | None
    dimensions: tuple[int, int, int]
    typical: Array

    @property
    def shape(self) -> tuple[int, ...]:
        n, m, p = self.dimensions
        return n + p, n + m

    def system_matrix(self, theta: Array) -> Array:
        try:
            with np.errstate(all="ignore"):
                blocks = self.function(theta)
        except (ValueError, ArithmeticError):  # no model there: "mass must be positive"
            return np.full(self.shape, np.nan)
        return stack_system("function", blocks, self.dimensions, ())

    def jacobian(self, theta: Array) -> Array:
        if self.derivatives is None:
            return numerical_jacobian(self.system_matrix, theta, self.typical)
        blocks = self.derivatives(theta)
        return stack_system("jacobian", blocks, self.dimensions, (len(theta),))

    def curvature(self, theta: Array) -> Array:
        if self.derivatives is None:
            return numerical_curvature(self.system_matrix, theta, self.typical)
        return symmetric_differences(self.jacobian, theta, self.typical)


@dataclass(frozen=True, eq=False)
class FixedMap(StructureMap):
    """Another map of which only the `free` parameters are left."""

    parent: StructureMap
    values: Array
    free: Flags

    @property
    def shape(self) -> tuple[int, ...]:
        return self.parent.shape

    def _all(self, theta: Array) -> Array:
        full = self.values.astype(np.result_type(self.values, theta))
        full[self.free] = theta
        return full

    def system_matrix(self, theta: Array) -> Array:
        return self.parent.system_matrix(self._all(theta))

    def jacobian(self, theta: Array) -> Array:
        return self.parent.jacobian(self._all(theta))[self.free]

    def curvature(self, theta: Array) -> Array | None:
        H = self.parent.curvature(self._all(theta))
        return None if H is None else H[self.free][:, self.free]


@dataclass(frozen=True, eq=False)
class RowsMap(StructureMap):
    """Some rows of the S of another map; one may stand several times."""

    parent: StructureMap
    rows: NDArray[np.intp]

    @property
    def shape(self) -> tuple[int, ...]:
        return len(self.rows), self.parent.shape[1]

    def system_matrix(self, theta: Array) -> Array:
        return self.parent.system_matrix(theta)[self.rows]

    def jacobian(self, theta: Array) -> Array:
        return self.parent.jacobian(theta)[:, self.rows]

    def curvature(self, theta: Array) -> Array | None:
        H = self.parent.curvature(theta)
        return None if H is None else H[:, :, self.rows]
