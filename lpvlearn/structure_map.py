"""The map from parameters to system matrices, and its derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import real_array
from .numerics.differentiation import (
    numerical_curvature,
    numerical_jacobian,
    symmetric_differences,
)
from .parameter_domain import ParameterDomain
from .parametrized import Parametrized
from .statespace import StateSpace
from .structure_forms import FixedParameters, ImplicitSystem
from .system_matrices import Blocks, blocks, stack_system

Array = NDArray[np.float64]
Self = TypeVar("Self", bound="StructureMap")


class StructureMap(Parametrized):
    """Parameters to ``S = [[A, B], [C, D]]``: affine, or a smooth function.

    Parameters
    ----------
    order : int
    parameter_names : sequence of str
    offset : ndarray of shape (order + n_outputs, order + n_inputs)
        ``S_0`` of an affine structure; its shape alone counts for a function.
    basis : ndarray of shape (n_params, order + n_outputs, order + n_inputs) or None
        ``S_j`` of an affine structure; None for a function.
    function : callable, default=None
        Maps theta to A, B, C, D.
    jacobian : callable, default=None
        Maps theta to the derivatives of the blocks; None differentiates numerically.
    curvature : callable, default=None
        Maps theta to second derivatives of S; None differentiates numerically.
    initial : ndarray of shape (n_params,), default=None
    """

    def __init__(
        self,
        order: int,
        parameter_names: Sequence[str],
        offset: Array,
        basis: Array | None,
        *,
        function: Callable[[Any], Any] | None = None,
        jacobian: Callable[[Any], Any] | None = None,
        curvature: Callable[[Any], Any] | None = None,
        initial: Array | None = None,
    ) -> None:
        self.order = order
        self.n_outputs, self.n_inputs = (int(k) - order for k in offset.shape)
        self.is_affine = function is None
        self.offset = offset if self.is_affine else None
        self.basis = basis
        self.function, self._jacobian, self._curvature = function, jacobian, curvature
        self._memory: tuple[bytes, Array] | None = None  # the last Jacobian
        super().__init__(ParameterDomain.free(parameter_names, initial))
        for array in (offset, basis):
            if array is not None:
                array.setflags(write=False)

    @classmethod
    def _from_implicit(
        cls: type[Self],
        system: ImplicitSystem,
        names: Sequence[str],
        initial: Array | None,
    ) -> Self:
        """Affine where the left side of the equations holds no parameter."""
        if not system.M[1:].any():
            return cls(system.order, names, *system.affine(), initial=initial)
        return cls(
            system.order,
            names,
            system.offset,
            None,
            function=system,
            jacobian=system.jacobian,
            curvature=system.curvature,
            initial=initial,
        )

    def __repr__(self) -> str:
        kind = "affine" if self.is_affine else "function"
        return (
            f"{type(self).__name__}(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, n_params={self.n_params}, {kind})"
        )

    @property
    def reference(self) -> Array:
        """A point where the matrices exist, shape (n_params,).

        The first guess, else the middle of the ranges, else zeros or parameters of
        unit masses, all within the bounds.
        """
        if self.initial is not None:
            return self.initial
        zero = np.zeros(self.n_params)
        start = self.implicit.regular_point() if self.implicit is not None else zero
        known = ~np.isnan(self.ranges[0])
        start = np.where(known, self.ranges.sum(0) / 2.0, start)
        return np.clip(start, self.lower, self.upper)

    @property
    def implicit(self) -> ImplicitSystem | None:
        """The equations ``M(theta) X = N(theta)`` of a structure that solves them."""
        return self.function if isinstance(self.function, ImplicitSystem) else None

    @property
    def free_feedthrough(self) -> NDArray[np.bool_]:
        """Which entries of D hold a parameter, shape (n_outputs, n_inputs)."""
        n = self.order
        return (self.jacobian(self.reference)[:, n:, n:] != 0).any(0)

    def fix(self: Self, values: Mapping[str, float]) -> Self:
        """The structure with some parameters at known values.

        Parameters
        ----------
        values : mapping from name to value

        Returns
        -------
        GrayBoxStructure
            A new one without these parameters.

        Raises
        ------
        ValueError
            If a name is unknown, a value is not finite or outside its bounds, or no
            parameter remains.

        Examples
        --------
        >>> from lpvlearn import GrayBoxStructure
        >>> structure = GrayBoxStructure.from_template(
        ...     A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]])
        >>> fixed = structure.fix({"b": 2.0})
        >>> fixed.parameter_names
        ('c', 'k')
        >>> fixed.model([0.5, 4.0]).B
        array([[0.],
               [2.]])
        """
        full, free = self._domain.fixed(values)
        if self.is_affine:
            assert self.offset is not None and self.basis is not None
            offset = self.offset + np.tensordot(full[~free], self.basis[~free], 1)
            new = type(self)(self.order, (), offset, self.basis[free])
        elif self.implicit is not None:
            new = self._from_implicit(self.implicit.fix(full, free), (), None)
        else:
            function = FixedParameters(self, full, free)
            new = type(self)(
                self.order,
                (),
                np.empty([self.order + k for k in (self.n_outputs, self.n_inputs)]),
                None,
                function=function,
                jacobian=function.jacobian,
                curvature=function.curvature,
            )
        return new._with_domain(self._domain.without(~free))

    @property
    def _dimensions(self) -> tuple[int, int, int]:
        return self.order, self.n_inputs, self.n_outputs

    def system_matrix(self, theta: Array) -> Array:
        """``S = [[A, B], [C, D]]``, shape (..., order + n_outputs, order + n_inputs).

        Parameters
        ----------
        theta : ndarray of shape (..., n_params)
        """
        if self.function is None:
            assert self.offset is not None and self.basis is not None
            flat = self.basis.reshape(self.n_params, self.offset.size)
            shape = np.shape(theta)[:-1] + self.offset.shape
            return self.offset + (theta @ flat).reshape(shape)
        if np.ndim(theta) > 1:
            rows = np.reshape(theta, (-1, self.n_params))
            stack = np.array([self.system_matrix(row) for row in rows])
            shape = (self.order + self.n_outputs, self.order + self.n_inputs)
            return stack.reshape(np.shape(theta)[:-1] + shape)
        try:
            with np.errstate(all="ignore"):
                blocks = self.function(theta)
        except (ValueError, ArithmeticError):  # no model there: "mass must be positive"
            return np.full(
                [self.order + k for k in (self.n_outputs, self.n_inputs)], np.nan
            )
        return stack_system("function", blocks, self._dimensions, ())

    def jacobian(self, theta: Array) -> Array:
        """``dS / dtheta``, shape (n_params, order + n_outputs, order + n_inputs)."""
        if self.function is None:
            assert self.basis is not None
            return self.basis
        key = np.asarray(theta).tobytes()
        memory = self._memory
        if memory is None or memory[0] != key:  # asked for again and again
            derivatives = self._derivatives(theta)
            derivatives.setflags(write=False)
            self._memory = memory = key, derivatives
        return memory[1]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_memory": None}

    def _derivatives(self, theta: Array) -> Array:
        if self._jacobian is not None:
            derivatives = self._jacobian(theta)
            shape = (self.n_params,)
            return stack_system("jacobian", derivatives, self._dimensions, shape)
        return numerical_jacobian(self.system_matrix, theta, self.initial)

    def curvature(self, theta: Array) -> Array | None:
        """Second derivatives of S, or None where they are zero (affine).

        Parameters
        ----------
        theta : ndarray of shape (n_params,)

        Returns
        -------
        ndarray of shape (n_params, n_params, order + n_outputs, order + n_inputs) or
        None
        """
        if self.is_affine:
            return None
        if self._curvature is not None:
            return self._curvature(theta)
        if self._jacobian is not None:
            return symmetric_differences(self._derivatives, theta, self.initial)
        return numerical_curvature(self.system_matrix, theta, self.initial)

    def matrices(self, theta: ArrayLike) -> Blocks:
        """Matrices ``(A, B, C, D)`` at `theta`, stacked over its leading axes.

        Parameters
        ----------
        theta : array-like of shape (..., n_params)

        Raises
        ------
        ValueError
            If the last axis does not have length n_params.
        """
        theta = real_array("theta", theta)
        if theta.shape[-1:] != (self.n_params,):
            raise ValueError(
                f"`theta` must have shape (..., {self.n_params}). Got {theta.shape}."
            )
        return blocks(self.system_matrix(theta), self.order)

    def model(
        self, theta: ArrayLike | Mapping[str, float], sampling_time: float | None = None
    ) -> StateSpace:
        """The model at `theta`.

        Parameters
        ----------
        theta : array-like of shape (n_params,) or mapping from name to value
        sampling_time : float, default=None
            Seconds; None is continuous time.

        Raises
        ------
        ValueError
            If `theta` does not fit the parameters.
        """
        return StateSpace(*self.matrices(self.check_params(theta)), sampling_time)
