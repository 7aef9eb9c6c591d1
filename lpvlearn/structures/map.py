"""The map from parameters to system matrices, and its derivatives."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.statespace import StateSpace
from ..models.system_matrix import Blocks, blocks, stack_system
from ..validation import real_array
from .differentiation import (
    numerical_curvature,
    numerical_jacobian,
    symmetric_differences,
)
from .domain import Interval, ParameterDomain
from .mechanical import ImplicitSystem

Array = NDArray[np.float64]


class Parametrized:
    """What a structure says about its parameters: names, bounds, ranges, first guess.

    Attributes
    ----------
    parameter_names : tuple of str
        In the order of theta.
    n_params : int
    """

    def __init__(self, domain: ParameterDomain) -> None:
        self._domain = domain
        self.parameter_names, self.n_params = domain.names, len(domain.names)

    def _with_domain(self, domain: ParameterDomain) -> Self:
        new = copy.copy(self)
        Parametrized.__init__(new, domain)
        return new

    @property
    def initial(self) -> Array | None:
        """A first guess, shape (n_params,), where the structure carries one."""
        return self._domain.initial

    @property
    def lower(self) -> Array:
        """Lower bounds, shape (n_params,); -inf where there is none."""
        return self._domain.lower

    @property
    def upper(self) -> Array:
        """Upper bounds, shape (n_params,); inf where there is none."""
        return self._domain.upper

    @property
    def is_bounded(self) -> bool:
        """Whether any parameter has a bound."""
        return self._domain.is_bounded

    @property
    def ranges(self) -> Array:
        """Known ranges, shape (2, n_params); NaN where there is none."""
        return self._domain.ranges

    def with_bounds(self, bounds: Mapping[str, Interval]) -> Self:
        """The structure with bounds of some parameters; the others keep theirs.

        Parameters
        ----------
        bounds : mapping from name to (lower, upper)
            None, or an infinity, where there is no bound.

        Returns
        -------
        GrayBoxStructure
            A new one; its `lower`, `upper` and `is_bounded` tell the bounds.

        Raises
        ------
        ValueError
            If a name is unknown, a lower bound is not below the upper one, or a known
            range or first guess is outside.

        Examples
        --------
        >>> from lpvlearn import GrayBoxStructure
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> structure.with_bounds({"a1_1": (None, 0)}).upper
        array([ 0., inf])
        """
        return self._with_domain(self._domain.with_bounds(bounds))

    def with_ranges(self, ranges: Mapping[str, Interval]) -> Self:
        """The structure with known ranges of some parameters, where searches begin.

        Unlike bounds they do not limit the result.

        Parameters
        ----------
        ranges : mapping from name to (low, high)
            Finite.

        Returns
        -------
        GrayBoxStructure
            A new one; its `ranges` tell them.

        Raises
        ------
        ValueError
            If a name is unknown, or a range is infinite, empty or outside the bounds.

        Examples
        --------
        >>> from lpvlearn import GrayBoxStructure
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> structure.with_ranges({"b1_1": (1, 100)}).ranges
        array([[ nan,   1.],
               [ nan, 100.]])
        """
        return self._with_domain(self._domain.with_ranges(ranges))

    def draw(self, n: int, rng: np.random.Generator) -> Array | None:
        """Random parameter vectors from the ranges, or around the first guess.

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator

        Returns
        -------
        ndarray of shape (n, n_params) or None
            Log-uniform where a range of one sign spans more than a decade, else
            uniform; log-normal (standard deviation 0.3) around the first guess where
            there is no range; within the bounds. None if a parameter has neither a
            range nor a first guess.

        Examples
        --------
        >>> from lpvlearn import GrayBoxStructure
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> rng = np.random.default_rng(0)
        >>> structure.draw(5, rng) is None
        True
        >>> ranged = structure.with_ranges({"a1_1": (-2, -1), "b1_1": (1, 100)})
        >>> ranged.draw(5, rng).shape
        (5, 2)
        """
        return self._domain.draw(n, rng)

    def check_params(self, theta: ArrayLike | Mapping[str, float]) -> Array:
        """`theta` as a finite vector.

        Parameters
        ----------
        theta : array-like of shape (n_params,) or mapping from name to value

        Returns
        -------
        ndarray of shape (n_params,)

        Raises
        ------
        ValueError
            If a name has no value or is unknown, or a value is not finite.
        """
        if isinstance(theta, Mapping):
            if set(theta) != set(self.parameter_names):
                wrong = sorted(set(theta) ^ set(self.parameter_names), key=str)
                raise ValueError(
                    "parameters must have a value for each name of the structure. "
                    f"Missing or unknown: {', '.join(map(str, wrong))}."
                )
            theta = [theta[name] for name in self.parameter_names]
        vector = real_array("parameters", theta).reshape(-1)
        if vector.shape != (self.n_params,) or not np.isfinite(vector).all():
            some = ", ".join(self.parameter_names[:4])
            raise ValueError(
                f"parameters must be {self.n_params} finite values "
                f"({some}{', ...' if self.n_params > 4 else ''}). Got {vector}."
            )
        return vector


@dataclass(frozen=True, eq=False)
class FixedParameters:
    """The functions of a structure, of those parameters that are not fixed.

    Attributes
    ----------
    parent : GrayBoxStructure
        Its `system_matrix`, `jacobian` and `curvature` take all parameters.
    values : ndarray of shape (n_params of the parent,)
        All parameters; those that are not fixed are replaced.
    free : ndarray of bool
    """

    parent: Any
    values: Array
    free: NDArray[np.bool_]

    def _all(self, theta: Array) -> Array:
        full = self.values.astype(np.result_type(self.values, theta))
        full[self.free] = theta
        return full

    def __call__(self, theta: Array) -> Blocks:
        """Matrices A, B, C, D."""
        return blocks(self.parent.system_matrix(self._all(theta)), self.parent.order)

    def jacobian(self, theta: Array) -> Blocks:
        """Their derivatives by the free parameters."""
        S = self.parent.jacobian(self._all(theta))[self.free]
        return blocks(S, self.parent.order)

    def curvature(self, theta: Array) -> Array:
        """Second derivatives of ``[[A, B], [C, D]]`` by the free parameters."""
        return self.parent.curvature(self._all(theta))[self.free][:, self.free]


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
        cls,
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

    def fix(self, values: Mapping[str, float]) -> Self:
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
