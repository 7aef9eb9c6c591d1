"""Gray-box structures: parameters to state-space matrices, with Jacobians.

A structure writes the system matrix ``S = [[A, B], [C, D]]`` as a function of the
parameter vector, Eq. (2). It is affine, ``S(theta) = S_0 + sum_j theta_j S_j``, when
given as a template, and any smooth function otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.statespace import StateSpace
from ..validation import named_values
from .map import StructureMap
from .mechanical import mechanical_system
from .templates import (
    Entry,
    affine_system,
    dimensions,
    full_cells,
    modal_cells,
    observable_canonical_cells,
)

Array = NDArray[np.float64]

__all__ = ["GrayBoxStructure"]


class GrayBoxStructure(StructureMap):
    """The map from parameters to the matrices of a gray-box model, Eq. (2).

    Build one with :meth:`from_template` (entries affine in the parameters),
    :meth:`from_function` (smooth), :meth:`mechanical` (equations of motion),
    :meth:`modal`, :meth:`observable_canonical` or :meth:`full`. It is never changed:
    :meth:`fix`, :meth:`with_bounds` and :meth:`with_ranges` return another one.

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
    lower, upper : ndarray of shape (n_params,)
        Bounds that optimisers respect; -inf and inf where there is none.
    is_bounded : bool
    ranges : ndarray of shape (2, n_params)
        Where a parameter is expected; NaN where that is not known.

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
        return cls(order, names, offset, basis)

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
        structure = cls(
            model.order,
            names,
            np.empty([model.order + k for k in (model.n_outputs, model.n_inputs)]),
            None,
            function=function,
            jacobian=jacobian,
            initial=start,
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
        order, m, p = dimensions(order, n_inputs, n_outputs, feedthrough)
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
        order, m, p = dimensions(order, n_inputs, n_outputs, feedthrough)
        A, B = full_cells("a", order, order), full_cells("b", order, m)
        C, D = full_cells("c", p, order), full_cells("d", p, m) if feedthrough else None
        blocks = (A, B, C, D or [])
        names = [str(name) for block in blocks for row in block for name in row]
        return cls.from_template(A, B, C, D, parameter_names=names)

    @classmethod
    def modal(
        cls,
        n_modes: int,
        n_inputs: int = 1,
        n_outputs: int = 1,
        n_real: int = 0,
        feedthrough: bool = False,
        *,
        normalize: str = "input",
    ) -> GrayBoxStructure:
        """Real modal form: decoupled second-order modes and real poles.

        Mode ``i`` is ``[[0, 1], [-w2_i, -d_i]]``: a pair of poles with the square of
        the natural frequency (rad/s) and twice the decay rate (1/s), complex or real;
        a real pole is ``-r_i``. Every model with distinct poles that the normalised
        input reaches (that the normalised output sees) has such a form, unique up to
        the order of the modes.

        Parameters
        ----------
        n_modes, n_inputs, n_outputs : int
        n_real : int, default=0
            Real poles, behind the modes.
        feedthrough : bool, default=False
            Also free the entries of D.
        normalize : {"input", "output"}, default="input"
            What settles the scale of the modes: the first column of B is ``[0, 1]`` for
            a mode and 1 for a real pole, or the first row of C is ``[1, 0]`` and 1. The
            other entries of B and C are free.

        Raises
        ------
        ValueError
            If a number is not a valid integer, there is no pole, or `normalize` is
            unknown.

        Examples
        --------
        >>> structure = GrayBoxStructure.modal(1, n_outputs=2)
        >>> structure.parameter_names
        ('c1_1', 'c1_2', 'c2_1', 'c2_2', 'd_1', 'w2_1')
        """
        _, m, p = dimensions(1, n_inputs, n_outputs, feedthrough)
        A, B, C = modal_cells(n_modes, n_real, m, p, normalize)
        return cls.from_template(
            A, B, C, full_cells("d", p, m) if feedthrough else None
        )

    @classmethod
    def mechanical(
        cls,
        M: Sequence[Sequence[Entry]],
        D: Sequence[Sequence[Entry]],
        K: Sequence[Sequence[Entry]],
        F: Sequence[Sequence[Entry]],
        outputs: str = "position",
        *,
        sensors: ArrayLike | None = None,
        initial: ArrayLike | Mapping[str, float] | None = None,
        parameter_names: Sequence[str] | None = None,
    ) -> GrayBoxStructure:
        """Equations of motion ``M q'' + D q' + K q = F u`` with states ``[q, q']``.

        Parameters
        ----------
        M, D, K : nested sequences of float or str
            Mass, damping and stiffness, shape (n_dof, n_dof), affine in the parameters.
        F : nested sequences of float or str
            Shape (n_dof, n_inputs).
        outputs : {"position", "velocity", "acceleration"}, default="position"
        sensors : array-like of shape (n_outputs, n_dof), default=None
            What the outputs measure, e.g. ``[[1, 0]]`` for the first coordinate alone;
            None is every coordinate.
        initial : array-like of shape (n_params,) or mapping, default=None
            A first guess.
        parameter_names : sequence of str, default=None
            Order of the parameters; None is the natural alphabetical order.

        Returns
        -------
        GrayBoxStructure
            Affine where M holds numbers only, else a function with exact derivatives.

        Raises
        ------
        ValueError
            If shapes do not fit, an entry is not affine, or M is singular.

        Notes
        -----
        Motion does not tell a common factor of M, D, K and F: at least one of their
        entries must be a number.

        Examples
        --------
        >>> structure = GrayBoxStructure.mechanical(
        ...     M=[["m"]], D=[["c"]], K=[["k"]], F=[[1]])
        >>> structure.model({"m": 2.0, "c": 1.0, "k": 8.0}).A
        array([[ 0. ,  1. ],
               [-4. , -0.5]])
        """
        system, names = mechanical_system(M, D, K, F, outputs, sensors, parameter_names)
        start = None
        if initial is not None:
            start = named_values("initial", initial, names)[0]
        elif system.M[1:].any():
            system.regular_point()  # that there is none is told of here
        return cls._from_implicit(system, names, start)
