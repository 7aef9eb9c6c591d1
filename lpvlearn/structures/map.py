"""Maps from parameters to the system matrix ``S = [[A, B], [C, D]]``, with derivatives.

A structure holds one of them: an :class:`AffineMap`, the :class:`FunctionMap` of a
user's function, or the :class:`~lpvlearn.structures.mechanical.ImplicitMap` of
equations of motion; or one that is made of another, with some parameters fixed
(:class:`FixedMap`), of some rows (:class:`RowsMap`), or between other matrices
(:class:`FramedMap`). A function without derivatives is differentiated by a complex
step, or by differences.
"""

from __future__ import annotations

import threading
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.exceptions import ComplexWarning
from numpy.typing import NDArray

from ..models.system_matrix import stack_system

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.intp]

# All steps are relative to the sizes of the parameters.
_COMPLEX_STEP = 1e-30  # nothing is subtracted: its square is below any rounding
_CENTRAL_STEP = 6e-6  # about eps^(1/3): rounding and truncation balance
_CURVATURE_STEP = 1e-5  # the same for derivatives, whose scale of change is longer

# Relative difference of exact and central derivatives of an analytic function: far
# above the truncation of the latter, far below what a missing part would make.
_AGREEMENT = 1e-4

# Relative rounding error of a central difference: eps / _CENTRAL_STEP is 4e-11, and the
# function may lose two digits of its own.
_ROUNDING = 1e-8

_NO_SIZE = 1e-200  # a parameter smaller than that is zero: no step could be
_LEAST_SIZE = 1e-3  # of a parameter near zero, relative to its usual size

_FILTERS = threading.RLock()  # the warning filters are those of all threads


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

    def select(self, rows: Rows) -> StructureMap:
        """The map to some rows of S; one may stand several times."""
        return RowsMap(self, rows)


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
    """A smooth function of the user."""

    function: Callable[[Any], Any]  # theta to A, B, C, D
    derivatives: Callable[[Any], Any] | None  # theta to those of the blocks
    dimensions: tuple[int, int, int]  # order, n_inputs, n_outputs
    typical: Array  # values whose sizes set the steps of numerical derivatives
    takes_complex: bool = False  # parameters, and loses no imaginary part

    def checked(self) -> FunctionMap:
        """The map that knows whether its function takes complex parameters.

        This changes the warning filters for a moment, which are those of all threads:
        it belongs where a structure is made, not where it is fitted.
        """
        theta = np.where(np.abs(self.typical) > _NO_SIZE, self.typical, 1.0)
        try:
            with _FILTERS, warnings.catch_warnings():
                warnings.simplefilter("error", ComplexWarning)
                _complex_step(self.system_matrix, theta, np.abs(theta))
        except (TypeError, ValueError, NotImplementedError, ComplexWarning):
            return self
        return replace(self, takes_complex=True)

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
            return numerical_jacobian(
                self.system_matrix, theta, self.typical, self.takes_complex
            )
        blocks = self.derivatives(theta)
        return stack_system("jacobian", blocks, self.dimensions, (len(theta),))

    def curvature(self, theta: Array) -> Array:
        if self.derivatives is None:
            return _numerical_curvature(
                self.system_matrix, theta, self.typical, self.takes_complex
            )
        return _symmetric_differences(self.jacobian, theta, self.typical)


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
    rows: Rows

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


@dataclass(frozen=True, eq=False)
class FramedMap(StructureMap):
    """``left S right + constant`` for the S of another map."""

    parent: StructureMap
    left: Array
    right: Array
    constant: Array

    @property
    def shape(self) -> tuple[int, ...]:
        return self.constant.shape

    def system_matrix(self, theta: Array) -> Array:
        own = self.left @ self.parent.system_matrix(theta) @ self.right
        return np.asarray(own + self.constant)

    def jacobian(self, theta: Array) -> Array:
        return np.asarray(self.left @ self.parent.jacobian(theta) @ self.right)

    def curvature(self, theta: Array) -> Array | None:
        H = self.parent.curvature(theta)
        return None if H is None else np.asarray(self.left @ H @ self.right)


def mirrored(theta: Array, lower: Array | float, upper: Array | float) -> Array:
    """Parameters, those beyond a bound mirrored at it: at zero others have no effect.

    >>> mirrored(np.array([-2.0, 1.0]), 0.0, np.inf)
    array([2., 1.])
    """
    theta = np.where(theta < lower, 2.0 * lower - theta, theta)
    theta = np.where(theta > upper, 2.0 * upper - theta, theta)
    return np.clip(theta, lower, upper)


def framed(
    map: StructureMap, left: Array, right: Array, constant: Array
) -> StructureMap:
    """``left S right + constant``, which is affine where S is."""
    if isinstance(map, AffineMap):
        offset = left @ map.offset @ right + constant
        return AffineMap(offset, left @ map.basis @ right)
    return FramedMap(map, left, right, constant)


def numerical_jacobian(
    f: Callable[[Any], Any], theta: Array, typical: Array, takes_complex: bool = False
) -> Array:
    """Derivative of `f` at `theta`, shape (n_params, ...).

    That of central differences, but exact where `f` takes complex parameters and is
    analytic.
    """
    scale = _parameter_scale(theta, typical)
    exact = _analytic_jacobian(f, theta, scale) if takes_complex else None
    return _central(f, theta, _CENTRAL_STEP * scale) if exact is None else exact


def _complex_step(f: Callable[[Any], Any], theta: Array, scale: Array) -> Array:
    columns = [
        np.imag(f(theta + 1j * step)) / step.max()
        for step in np.diag(_COMPLEX_STEP * scale)
    ]
    return np.array(columns, dtype=float)


def _analytic_jacobian(
    f: Callable[[Any], Any], theta: Array, scale: Array
) -> Array | None:
    """The derivative by complex steps; None where `f` is not analytic.

    A function that is not (abs, real, conj) fails the complex step in silence. Its
    change along one direction, in which no two parameters change alike, tells, entry
    by entry.
    """
    try:
        exact = _complex_step(f, theta, scale)
    except (TypeError, ValueError, NotImplementedError):
        return None
    direction = scale * np.cos(1.0 + np.arange(len(theta)) ** 2)
    step = _CENTRAL_STEP * direction
    up, down = np.asarray(f(theta + step)), np.asarray(f(theta - step))
    change = (up - down) / (2.0 * _CENTRAL_STEP)
    size = np.abs(exact * scale.reshape(-1, *[1] * (exact.ndim - 1))).sum(0)
    rounding = _ROUNDING * (np.abs(up) + np.abs(down))
    error = np.abs(np.tensordot(direction, exact, axes=1) - change)
    agrees = error <= _AGREEMENT * np.maximum(np.abs(change), size) + rounding
    return exact if agrees.all() else None


def _numerical_curvature(
    f: Callable[[Any], Any], theta: Array, typical: Array, takes_complex: bool
) -> Array:
    """Second derivatives, (n_params, n_params, ...): differences of the first ones."""
    scale = _parameter_scale(theta, typical)
    analytic = takes_complex and _analytic_jacobian(f, theta, scale) is not None

    def jacobian(point: Array) -> Array:
        if analytic:  # as around theta: not asked again at every step
            return _complex_step(f, point, scale)
        return numerical_jacobian(f, point, typical)

    return _symmetric_differences(jacobian, theta, typical)


def _symmetric_differences(
    jacobian: Callable[[Array], Array], theta: Array, typical: Array
) -> Array:
    """Second derivatives from a Jacobian that maps (n_params,) to (n_params, ...)."""
    H = _central(jacobian, theta, _CURVATURE_STEP * _parameter_scale(theta, typical))
    return 0.5 * (H + H.swapaxes(0, 1))


def _central(f: Callable[[Any], Any], theta: Array, steps: Array) -> Array:
    return np.array(
        [
            (f(theta + step) - f(theta - step)) / (2.0 * step.max())
            for step in np.diag(steps)
        ]
    )


def _parameter_scale(theta: Array, typical: Array) -> Array:
    """Size of every parameter; 0 stands for a usual value of 1."""
    usual = np.abs(typical)
    usual = np.where(usual > _NO_SIZE, usual, 1.0)
    return np.maximum(np.abs(theta), _LEAST_SIZE * usual)
