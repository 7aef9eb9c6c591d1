"""Gray-box structures: parameters to state-space matrices, with Jacobians.

A structure writes the system matrix ``S = [[A, B], [C, D]]`` as a function of the
parameter vector, Eq. (2). It is affine, ``S(theta) = S_0 + sum_j theta_j S_j``, when
given as a template, and any smooth function otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import named_values, real_array, whole_number
from .numerics.differentiation import numerical_curvature, numerical_jacobian
from .statespace import StateSpace
from .system_matrices import stack_system
from .templates import Entry, affine_system, full_cells, observable_canonical_cells

__all__ = ["GrayBoxStructure"]

Array = NDArray[np.float64]


class GrayBoxStructure:
    """The map from parameters to the matrices of a gray-box model, Eq. (2).

    Build one with :meth:`from_template` (entries affine in the parameters),
    :meth:`from_function` (smooth), :meth:`observable_canonical` or :meth:`full`.

    Attributes
    ----------
    order, n_inputs, n_outputs, n_params : int
    parameter_names : tuple of str
    is_affine : bool
    offset : ndarray of shape (order + n_outputs, order + n_inputs) or None
        ``S_0`` of an affine structure.
    basis : ndarray of shape (n_params, order + n_outputs, order + n_inputs) or None
        ``S_j`` of an affine structure.
    initial : ndarray of shape (n_params,) or None
        A first guess, where the structure carries one.

    Examples
    --------
    A mass-spring-damper with the position as output:

    >>> from lpvlearn import GrayBoxStructure
    >>> structure = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]])
    >>> structure.parameter_names
    ('b', 'c', 'k')
    >>> structure.model([1.0, 0.5, 4.0]).A
    array([[ 0. ,  1. ],
           [-4. , -0.5]])
    """

    def __init__(
        self,
        order: int,
        offset: Array | None,
        basis: Array | None,
        parameter_names: Sequence[str],
        *,
        function: Callable[[Any], Any] | None = None,
        jacobian: Callable[[Any], Any] | None = None,
        initial: Array | None = None,
        shape: tuple[int, int] | None = None,
    ) -> None:
        self.order = order
        self.parameter_names = tuple(parameter_names)
        self.n_params = len(self.parameter_names)
        self.is_affine = function is None
        self.offset, self.basis = offset, basis
        self.function, self._jacobian, self.initial = function, jacobian, initial
        for array in (offset, basis, initial):
            if array is not None:
                array.setflags(write=False)
        rows, columns = offset.shape if offset is not None else shape  # type: ignore
        self.n_outputs, self.n_inputs = rows - order, columns - order

    @property
    def _shape(self) -> tuple[int, int, int]:
        return self.order, self.n_inputs, self.n_outputs

    def __repr__(self) -> str:
        kind = "affine" if self.is_affine else "function"
        return (
            f"GrayBoxStructure(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, n_params={self.n_params}, {kind})"
        )

    @classmethod
    def from_template(
        cls,
        A: Sequence[Sequence[Entry]],
        B: Sequence[Sequence[Entry]],
        C: Sequence[Sequence[Entry]],
        D: Sequence[Sequence[Entry]] | None = None,
        *,
        parameter_names: Sequence[str] | None = None,
    ) -> GrayBoxStructure:
        """Structure whose entries are numbers or affine expressions of names.

        Parameters
        ----------
        A, B, C, D : nested sequences of float or str
            Shapes (order, order), (order, n_inputs), (n_outputs, order) and
            (n_outputs, n_inputs). A string such as ``"-p9"`` or ``"2*k - 1"`` is an
            affine expression of parameter names; one name may stand in several entries.
        parameter_names : sequence of str, default=None
            Order of the parameters; None is the natural alphabetical order
            (p2 before p10).

        Raises
        ------
        ValueError
            If shapes do not fit, or an entry is not an affine expression
            (the message names the cell).

        Examples
        --------
        >>> structure = GrayBoxStructure.from_template(
        ...     A=[["-1 / 2 * a"]], B=[["a"]], C=[[1]], D=[["d"]])
        >>> structure.model({"a": 4.0, "d": 1.0}).A
        array([[-2.]])
        """
        order, offset, basis, names = affine_system(A, B, C, D, parameter_names)
        return cls(order, offset, basis, names)

    @classmethod
    def from_function(
        cls,
        function: Callable[[Array], Sequence[ArrayLike]],
        initial: ArrayLike | Mapping[str, float],
        jacobian: Callable[[Array], Sequence[ArrayLike]] | None = None,
        *,
        parameter_names: Sequence[str] | None = None,
    ) -> GrayBoxStructure:
        """Structure given by a smooth function of the parameters.

        Parameters
        ----------
        function : callable
            Maps theta (n_params,) to ``(A, B, C)`` or ``(A, B, C, D)``.
        initial : array-like of shape (n_params,) or mapping from name to value
            A sensible point; its sizes set the steps of numerical derivatives.
        jacobian : callable, default=None
            Maps theta to the derivatives, one array of shape (n_params, rows, columns)
            for each matrix that `function` returns. None differentiates by a complex
            step where the function allows it, else by central differences.
        parameter_names : sequence of str, default=None
            None takes the mapping's keys, or p1, p2, ...

        Raises
        ------
        ValueError
            If names and values do not fit together, or the function does not return
            matrices of a model.

        Notes
        -----
        Such a structure can be pickled if its functions can: name them at the top
        level of a module, not ``lambda``.

        Examples
        --------
        A pendulum whose length enters as ``1 / length``:

        >>> def pendulum(theta):
        ...     length, damping = theta
        ...     return [[0, 1], [-9.81 / length, -damping]], [[0], [1]], [[1, 0]]
        >>> structure = GrayBoxStructure.from_function(
        ...     pendulum, initial={"length": 1.0, "damping": 0.1})
        >>> structure.jacobian(np.array([2.0, 0.1]))[0, 1, 0]
        np.float64(2.4525)
        """
        start, names = named_values("initial", initial, parameter_names)
        blocks = function(start)
        if len(blocks) not in (3, 4):
            raise ValueError(
                f"`function` must return (A, B, C) or (A, B, C, D). Got {len(blocks)}."
            )
        A, B, C = blocks[:3]
        model = StateSpace(A, B, C, blocks[3] if len(blocks) == 4 else None)
        shape = (model.order + model.n_outputs, model.order + model.n_inputs)
        structure = cls(
            model.order,
            None,
            None,
            names,
            function=function,
            jacobian=jacobian,
            initial=start,
            shape=shape,
        )
        if jacobian is not None:
            structure.jacobian(start)  # its shapes are told of here, not in a fit
        return structure

    @classmethod
    def observable_canonical(
        cls,
        order: int,
        n_inputs: int = 1,
        n_outputs: int = 1,
        feedthrough: bool = False,
    ) -> GrayBoxStructure:
        """Observable canonical form with generic observability indices.

        Output ``i`` heads a chain of states, each the derivative of the one before;
        the last row of a chain and all of B are free. The chains differ in length
        by one at most. Every generic model of that order has exactly one such form.

        Parameters
        ----------
        order, n_inputs, n_outputs : int
            Order 0 is a pure gain and needs `feedthrough`.
        feedthrough : bool, default=False
            Also free the entries of D.

        Raises
        ------
        ValueError
            If a number is not a valid integer, or nothing is free.

        Examples
        --------
        >>> structure = GrayBoxStructure.observable_canonical(2)
        >>> structure.parameter_names
        ('a2_1', 'a2_2', 'b1_1', 'b2_1')
        >>> structure.model([-4.0, -1.0, 0.0, 1.0]).A
        array([[ 0.,  1.],
               [-4., -1.]])
        """
        order, m, p = _dimensions(order, n_inputs, n_outputs, feedthrough)
        A, C = observable_canonical_cells(order, p)
        B = full_cells("b", order, m)
        D = full_cells("d", p, m) if feedthrough else None
        return cls.from_template(A, B, C, D)

    @classmethod
    def full(
        cls, order: int, n_inputs: int, n_outputs: int, feedthrough: bool = True
    ) -> GrayBoxStructure:
        """Every entry of the matrices is a parameter (row by row: A, B, C, D).

        Parameters
        ----------
        order, n_inputs, n_outputs : int
            Order 0 is a pure gain and needs `feedthrough`.
        feedthrough : bool, default=True
            Also free the entries of D.

        Raises
        ------
        ValueError
            If a number is not a valid integer, or nothing is free.

        Examples
        --------
        >>> GrayBoxStructure.full(1, 1, 1).parameter_names
        ('a1_1', 'b1_1', 'c1_1', 'd1_1')
        """
        order, m, p = _dimensions(order, n_inputs, n_outputs, feedthrough)
        A, B = full_cells("a", order, order), full_cells("b", order, m)
        C, D = full_cells("c", p, order), full_cells("d", p, m) if feedthrough else None
        blocks = (A, B, C, D or [])
        names = [str(name) for block in blocks for row in block for name in row]
        return cls.from_template(A, B, C, D, parameter_names=names)

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
        return stack_system("function", self.function(theta), self._shape, ())

    def jacobian(self, theta: Array) -> Array:
        """``dS / dtheta``, shape (n_params, order + n_outputs, order + n_inputs)."""
        if self.function is None:
            assert self.basis is not None
            return self.basis
        if self._jacobian is not None:
            blocks = self._jacobian(theta)
            return stack_system("jacobian", blocks, self._shape, (self.n_params,))
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
        return numerical_curvature(self.jacobian, theta, self.initial)

    def matrices(self, theta: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """Matrices ``(A, B, C, D)`` at `theta`, stacked over its leading axes.

        Parameters
        ----------
        theta : array-like of shape (..., n_params)

        Raises
        ------
        ValueError
            If the last axis does not have length n_params.
        """
        n, theta = self.order, real_array("theta", theta)
        if theta.shape[-1:] != (self.n_params,):
            raise ValueError(
                f"`theta` must have shape (..., {self.n_params}). Got {theta.shape}."
            )
        S = self.system_matrix(theta)
        return S[..., :n, :n], S[..., :n, n:], S[..., n:, :n], S[..., n:, n:]

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


def _dimensions(
    order: int, n_inputs: int, n_outputs: int, feedthrough: bool
) -> tuple[int, int, int]:
    order = whole_number("order", order, 0)
    if order == 0 and not feedthrough:
        raise ValueError(
            "`feedthrough` must be True for order 0: a pure gain has no other "
            "parameters. Got False."
        )
    n_inputs = whole_number("n_inputs", n_inputs, 1)
    return order, n_inputs, whole_number("n_outputs", n_outputs, 1)
