"""Gray-box structures: parameters to state-space matrices, with derivatives.

A structure writes the system matrix ``S = [[A, B], [C, D]]`` as a function of the
parameter vector, Eq. (2). It is affine, ``S(theta) = S_0 + sum_j theta_j S_j``, when
given as a template, and any smooth function otherwise. It is two things: the map from
parameters to S (:mod:`~lpvlearn.structures.map`), and what is known of their values:
bounds, ranges and a first guess.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exceptions import VersionedPickle
from ..models.statespace import StateSpace
from ..models.system_matrix import Blocks, blocks
from ..validation import (
    SQUARED,
    has_one_axis,
    named_values,
    names_of,
    real_array,
    shown,
    squarable,
    whole_number,
)
from .map import AffineMap, FramedMap, FunctionMap, StructureMap
from .mechanical import FluxMap, ImplicitMap, descriptor_map, mechanical_map
from .templates import (
    Entry,
    SystemCells,
    affine_system,
    full_cells,
    integrated_cells,
    modal_cells,
    observable_canonical_cells,
)

Array = NDArray[np.float64]

Interval = Sequence[float | None]

_SPREAD = 0.3  # standard deviation of log-parameters: a guess is right to a third

_ASIDE = 0.1  # relative distance of a point at which another derivative is taken

_DECADE = 10.0  # a range that spans more tells an order of magnitude, not a value
_MOST_COPIES = 1000  # of the outputs: one for each weight or model

_LISTED = 8  # names that a message lists


class GrayBoxStructure(VersionedPickle):
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
    is_mechanical : bool
        Whether it comes from equations of motion, which are in continuous time.

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
        map: StructureMap,
        parameter_names: Sequence[str],
        *,
        initial: Array | None = None,
        lower: Array | None = None,
        upper: Array | None = None,
        ranges: Array | None = None,
        is_mechanical: bool = False,
    ) -> None:
        order = whole_number("order", order, 0)
        if not isinstance(map, StructureMap):
            raise ValueError(
                f"`map` must be a StructureMap. Got {shown(map)}. Write structures by "
                "from_template, from_function or mechanical."
            )
        if not has_one_axis(parameter_names) or len(parameter_names) > 0:
            parameter_names = names_of("parameter_names", parameter_names)
        q = len(parameter_names)
        vectors = {"initial": initial, "lower": lower, "upper": upper, "ranges": ranges}
        for name, values in vectors.items():
            shape = (2, q) if name == "ranges" else (q,)
            given = None if values is None else real_array(name, values)
            if given is not None and given.shape != shape:
                raise ValueError(
                    f"`{name}` must have shape {shape}. Got {shown(values)}."
                )
            vectors[name] = given
        initial, lower, upper, ranges = vectors.values()
        self.order, self.map = order, map
        self.parameter_names, self.n_params = tuple(parameter_names), q
        self.n_outputs, self.n_inputs = (int(k) - order for k in map.shape)
        self.initial, self.is_mechanical = initial, is_mechanical
        self.lower = np.full(q, -np.inf) if lower is None else lower
        self.upper = np.full(q, np.inf) if upper is None else upper
        self.ranges = np.full((2, q), np.nan) if ranges is None else ranges
        self.is_bounded = bool(np.isfinite([self.lower, self.upper]).any())
        affine = map if isinstance(map, AffineMap) else None
        self.is_affine = affine is not None
        self.offset = None if affine is None else affine.offset
        self.basis = None if affine is None else affine.basis
        # the equations M(theta) X = N(theta) of a structure that solves them
        while isinstance(map, FramedMap):
            map = map.parent
        equations = map.equations if isinstance(map, FluxMap) else map
        self.implicit = equations if isinstance(equations, ImplicitMap) else None
        if self.implicit is not None and initial is None:
            # that there is none is told of here
            self.implicit.regular_point(self.lower, self.upper)
        for array in (self.initial, self.lower, self.upper, self.ranges):
            if array is not None:
                array.setflags(write=False)

    def _changed(self, **changes: Any) -> GrayBoxStructure:
        """Another one, which differs in some of the constructor's arguments."""
        names = ("order", "map", "parameter_names")
        known = ("initial", "lower", "upper", "ranges", "is_mechanical")
        own = {name: getattr(self, name) for name in (*names, *known)}
        return type(self)(**own | changes)

    def __repr__(self) -> str:
        kind = "affine" if self.is_affine else "function"
        return (
            f"{type(self).__name__}(order={self.order}, n_inputs={self.n_inputs}, "
            f"n_outputs={self.n_outputs}, n_params={self.n_params}, {kind})"
        )

    # -- ways to write one ---------------------------------------------------------

    @classmethod
    def from_template(
        cls,
        A: Sequence[Sequence[Entry]],
        B: Sequence[Sequence[Entry]],
        C: Sequence[Sequence[Entry]],
        D: Sequence[Sequence[Entry]] | None = None,
        *,
        E: Sequence[Sequence[Entry]] | None = None,
        descriptor: str = "rate",
        parameter_names: Sequence[str] | None = None,
    ) -> GrayBoxStructure:
        """Structure whose entries are numbers or affine expressions of names.

        Parameters
        ----------
        A, B, C, D : nested sequences of float or str
            Shapes (order, order), (order, n_inputs), (n_outputs, order) and
            (n_outputs, n_inputs). A string such as ``"-p9"`` or ``"2*k - 1"`` is an
            affine expression of parameter names; one name may stand in several entries.
        E : nested sequence of float or str, default=None
            Left side of descriptor equations, shape (order, order), in the same
            entries; None is the identity.
        descriptor : {"rate", "flux"}, default="rate"
            Equations ``E x' = A x + B u`` in the state x, or ``d(E x)/dt = A x + B u``
            in the state ``E x``, with outputs ``y = C x + D u``. The frozen models are
            the same; where E follows a scheduling variable that moves, an LPV model is
            not: see :ref:`guide_state_basis`.
        parameter_names : sequence of str, default=None
            Order of the parameters; None is the natural alphabetical order
            (p2 before p10).

        Raises
        ------
        ValueError
            If shapes do not fit, an entry is not an affine expression (the message
            names the cell), or E is singular.

        Examples
        --------
        A tank whose level x drains through a pipe, with the free surface ``area``. The
        volume ``area * x`` is what flows in and out:

        >>> tank = {"E": [["area"]], "A": [["-r"]], "B": [[1]], "C": [[1]]}
        >>> level = GrayBoxStructure.from_template(**tank).model([2.0, 0.5])
        >>> level.A, level.C
        (array([[-0.25]]), array([[1.]]))
        >>> volume = GrayBoxStructure.from_template(**tank, descriptor="flux")
        >>> volume.model([2.0, 0.5]).A, volume.model([2.0, 0.5]).C
        (array([[-0.25]]), array([[0.5]]))

        >>> structure = GrayBoxStructure.from_template(
        ...     A=[["-1 / 2 * a"]], B=[["a"]], C=[[1]], D=[["d"]])
        >>> structure.model({"a": 4.0, "d": 1.0}).A
        array([[-2.]])
        """
        if E is None:
            return cls(*affine_system(A, B, C, D, parameter_names))
        read = descriptor_map(E, A, B, C, D, descriptor, parameter_names)
        return cls(len(A), *read)

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
        try:
            given = function(start) if callable(function) else function
        except TypeError as error:
            if "positional argument" not in str(error):
                raise
            raise ValueError(
                "`function` must take one vector of all parameters, (n_params,). Got "
                f"{error}. Take them apart within: k, c = theta."
            ) from error
        if not isinstance(given, tuple | list) or len(given) not in (3, 4):
            many = f"{len(given)} of them" if isinstance(given, tuple | list) else ""
            raise ValueError(
                "`function` must return (A, B, C) or (A, B, C, D) for a vector of "
                f"parameters. Got {many or type(given).__name__}."
            )
        A, B, C = given[:3]
        model = StateSpace(A, B, C, given[3] if len(given) == 4 else None)
        dimensions = model.order, model.n_inputs, model.n_outputs
        map = FunctionMap(function, jacobian, dimensions, start)
        if jacobian is None:
            map = map.checked()
        elif callable(jacobian):
            map.jacobian(start)  # its shapes are told of here, not in a fit
        else:
            raise ValueError(
                "`jacobian` must be a function of the parameters, or None. Got "
                f"{shown(jacobian)}."
            )
        return cls(model.order, map, names, initial=start)

    @classmethod
    def observable_canonical(
        cls,
        order: int,
        n_inputs: int = 1,
        n_outputs: int = 1,
        feedthrough: bool = False,
        integrating: Sequence[int] = (),
        indices: Sequence[int] | None = None,
    ) -> GrayBoxStructure:
        """Observable canonical form, by default of generic observability indices.

        Output ``i`` heads a chain of states, each the derivative of the one before;
        the last row of a chain and all of B are free. Every generic model of that order
        has exactly one such form for all lengths of the chains.

        Parameters
        ----------
        order, n_inputs, n_outputs : int
            Order 0 is a pure gain and needs `feedthrough`.
        feedthrough : bool, default=False
            Also free the entries of D.
        integrating : sequence of int, default=()
            Places of outputs that are integrals of those of the form, with a state each
            behind the others.
        indices : sequence of int or None, default=None
            Length of the chain of every output, which add up to the order. None: they
            differ by one at most, and those of the first outputs are the longer.

        Raises
        ------
        ValueError
            If a number is not a valid integer, nothing is free, or `indices` do not
            add up to the order.

        Examples
        --------
        >>> structure = GrayBoxStructure.observable_canonical(2)
        >>> structure.parameter_names
        ('a2_1', 'a2_2', 'b1_1', 'b2_1')
        >>> structure.model([-4.0, -1.0, 0.0, 1.0]).A
        array([[ 0.,  1.],
               [-4., -1.]])
        """
        return cls._integrated(
            observable_canonical_cells(
                order, n_inputs, n_outputs, feedthrough, indices
            ),
            integrating,
        )

    @classmethod
    def full(
        cls,
        order: int,
        n_inputs: int,
        n_outputs: int,
        feedthrough: bool = True,
        integrating: Sequence[int] = (),
    ) -> GrayBoxStructure:
        """Every entry of the matrices is a parameter (row by row: A, B, C, D).

        The arguments are those of :meth:`observable_canonical`. Outputs `integrating`,
        by their places, are integrals of what these matrices say, with a state each
        behind the others.

        Examples
        --------
        >>> GrayBoxStructure.full(1, 1, 1).parameter_names
        ('a1_1', 'b1_1', 'c1_1', 'd1_1')
        >>> servo = GrayBoxStructure.full(1, 1, 1, feedthrough=False, integrating=[0])
        >>> servo.model([-2.0, 1.0, 3.0]).poles()
        array([ 0.+0.j, -2.+0.j])
        """
        return cls._integrated(
            full_cells(order, n_inputs, n_outputs, feedthrough), integrating
        )

    @classmethod
    def _integrated(
        cls, cells: SystemCells, integrating: Sequence[int]
    ) -> GrayBoxStructure:
        """Integrals of outputs; the parameters stay those of the cells, in order."""
        rows = [row for block in cells for row in block or []]
        names = [cell for row in rows for cell in row if isinstance(cell, str)]
        return cls.from_template(
            *integrated_cells(cells, integrating), parameter_names=names
        )

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
        return cls.from_template(
            *modal_cells(n_modes, n_inputs, n_outputs, n_real, feedthrough, normalize)
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
        state: str = "rate",
        sensors: ArrayLike | None = None,
        initial: ArrayLike | Mapping[str, float] | None = None,
        parameter_names: Sequence[str] | None = None,
    ) -> GrayBoxStructure:
        """Equations of motion ``M q'' + D q' + K q = F u``.

        Parameters
        ----------
        M, D, K : nested sequences of float or str
            Mass, damping and stiffness, shape (n_dof, n_dof), affine in the parameters.
        F : nested sequences of float or str
            Shape (n_dof, n_inputs).
        outputs : {"position", "velocity", "acceleration"}, default="position"
            Acceleration with ``state="rate"`` only.
        state : {"rate", "momentum"}, default="rate"
            Coordinates and rates ``[q, q']``, or coordinates and momenta ``[q, M q']``.
            The frozen models are the same. Where M follows a scheduling variable that
            moves, forces change momenta: then "momentum" is Newton's law and "rate"
            leaves the term ``M' q'`` out. See :ref:`guide_state_basis`.
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
        map, names = mechanical_map(
            M, D, K, F, outputs, state, sensors, parameter_names
        )
        guess = None if initial is None else named_values("initial", initial, names)[0]
        return cls(2 * len(M), map, names, initial=guess, is_mechanical=True)

    # -- what is known of the parameters -------------------------------------------

    def with_bounds(self, bounds: Mapping[str, Interval]) -> GrayBoxStructure:
        """The structure with bounds of some parameters; the others keep theirs.

        Parameters
        ----------
        bounds : mapping from name to (lower, upper)
            None, an infinity or a number from 1e150, where there is no bound.

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
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> structure.with_bounds({"a1_1": (None, 0)}).upper
        array([ 0., inf])
        """
        lower, upper = self.lower.copy(), self.upper.copy()
        for j, name, (low, high) in self._intervals("bounds", bounds):
            lower[j] = -np.inf if low is None or low <= -SQUARED else low
            upper[j] = np.inf if high is None or high >= SQUARED else high
            if not lower[j] < upper[j]:
                raise ValueError(
                    f"`bounds` of {name!r} must have the lower one below the upper "
                    f"one. Got ({lower[j]:g}, {upper[j]:g}). A parameter of one value "
                    "is fixed: structure.fix()."
                )
        squarable("bounds", np.array([lower, upper]))
        return self._changed(lower=lower, upper=upper)._agreeing()

    def with_ranges(self, ranges: Mapping[str, Interval]) -> GrayBoxStructure:
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
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> structure.with_ranges({"b1_1": (1, 100)}).ranges
        array([[ nan,   1.],
               [ nan, 100.]])
        """
        table = self.ranges.copy()
        for j, name, (low, high) in self._intervals("ranges", ranges):
            if low is None or high is None or not -np.inf < low < high < np.inf:
                raise ValueError(
                    f"`ranges` of {name!r} must be two finite values, the lower first. "
                    f"Got ({low}, {high}). A limit on one side is a bound: "
                    "structure.with_bounds()."
                )
            table[:, j] = low, high
        return self._changed(ranges=squarable("ranges", table))._agreeing()

    def fix(self, values: Mapping[str, float]) -> GrayBoxStructure:
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
            If a name is unknown, a value is not finite or outside its bounds, no
            parameter remains, or a coordinate of equations of motion loses its mass.

        Examples
        --------
        >>> structure = GrayBoxStructure.from_template(
        ...     A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]])
        >>> fixed = structure.fix({"b": 2.0})
        >>> fixed.parameter_names
        ('c', 'k')
        >>> fixed.model([0.5, 4.0]).B
        array([[0.],
               [2.]])
        """
        if not isinstance(values, Mapping):
            raise ValueError(f"`values` must map names to numbers. Got {values!r}.")
        full, free = np.zeros(self.n_params), np.ones(self.n_params, bool)
        for name, value in values.items():
            j = self._index("values", name)
            try:
                full[j], free[j] = _number(value), False
            except (TypeError, ValueError):
                full[j] = np.nan
            low, high = self.lower[j], self.upper[j]
            if not np.isfinite(full[j]) or not low <= full[j] <= high:
                raise ValueError(
                    f"`values` of {name!r} must be finite and within its bounds "
                    f"({low:g}, {high:g}). Got {value!r}."
                )
        if not free.any():
            raise ValueError(
                "`values` must leave a parameter free: a structure without parameters "
                "is a model, structure.model(). Got values for all."
            )
        return self._changed(
            map=self.map.fix(full, free),
            parameter_names=[self.parameter_names[j] for j in np.flatnonzero(free)],
            initial=None if self.initial is None else self.initial[free],
            lower=self.lower[free],
            upper=self.upper[free],
            ranges=self.ranges[:, free],
        )

    def _intervals(
        self, argument: str, given: Any
    ) -> list[tuple[int, str, tuple[float | None, float | None]]]:
        """Index, name and limits of every parameter that is named."""
        if not isinstance(given, Mapping):
            raise ValueError(
                f"`{argument}` must map names to pairs such as {{'k': (0, None)}}. "
                f"Got {given!r}."
            )
        found = []
        for name, pair in given.items():
            j = self._index(argument, name)
            try:
                low, high = (None if x is None else _number(x) for x in pair)
            except (TypeError, ValueError):
                raise ValueError(
                    f"`{argument}` of {name!r} must be a pair of numbers, None where "
                    f"there is no limit. Got {pair!r}."
                ) from None
            found.append((j, name, (low, high)))
        return found

    def _index(self, argument: str, name: Any) -> int:
        """Position of a parameter, or an error that names the argument."""
        if not isinstance(name, str) or name not in self.parameter_names:
            known = ", ".join(self.parameter_names[:_LISTED])
            more = ", ..." if self.n_params > _LISTED else ""
            raise ValueError(
                f"`{argument}` must name parameters of the structure "
                f"({known}{more}). Got {name!r}."
            )
        return self.parameter_names.index(name)

    def _agreeing(self) -> GrayBoxStructure:
        """The structure, if its ranges and first guess lie within its bounds."""
        for j, name in enumerate(self.parameter_names):
            (low, high), (lower, upper) = (
                self.ranges[:, j],
                (self.lower[j], self.upper[j]),
            )
            if low < lower or high > upper:
                raise ValueError(
                    f"`ranges` of {name!r} must lie within its bounds "
                    f"({lower:g}, {upper:g}). Got ({low:g}, {high:g})."
                )
            value = np.nan if self.initial is None else self.initial[j]
            if value < lower or value > upper:
                raise ValueError(
                    f"`bounds` of {name!r} must hold its initial value {value:g}. Got "
                    f"({lower:g}, {upper:g})."
                )
        return self

    def with_stacked_outputs(self, copies: int) -> GrayBoxStructure:
        """The structure with all of its outputs several times, below each other."""
        copies = whole_number("copies", copies, 1, _MOST_COPIES)
        states, outputs = np.split(np.arange(self.map.shape[0]), [self.order])
        rows = np.concatenate([states, np.tile(outputs, copies)])
        return self._changed(map=self.map.select(rows))

    def with_map(self, order: int, map: StructureMap) -> GrayBoxStructure:
        """The parameters and what is known of them, with another map and order."""
        return self._changed(order=order, map=map)

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
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> rng = np.random.default_rng(0)
        >>> structure.draw(5, rng) is None
        True
        >>> ranged = structure.with_ranges({"a1_1": (-2, -1), "b1_1": (1, 100)})
        >>> ranged.draw(5, rng).shape
        (5, 2)
        """
        known = ~np.isnan(self.ranges[0])
        if self.initial is None and not known.all():
            return None
        initial = np.zeros(self.n_params) if self.initial is None else self.initial
        around = drawn_around(initial, n, rng)
        uniform = rng.uniform(size=(n, len(initial)))
        low, high = np.where(known, self.ranges, 1.0)
        ratio = np.divide(high, low, out=np.ones_like(low), where=low != 0)
        ratio = np.where(ratio > 0, ratio, 1.0)  # of one sign only
        wide = np.maximum(ratio, 1.0 / ratio) > _DECADE
        drawn = np.where(
            wide, low * ratio**uniform, low * (1.0 - uniform) + high * uniform
        )
        return np.clip(np.where(known, drawn, around), self.lower, self.upper)

    def check_params(
        self, theta: ArrayLike | Mapping[str, float], *, name: str = "theta"
    ) -> Array:
        """`theta` as a finite vector.

        Parameters
        ----------
        theta : array-like of shape (n_params,) or mapping from name to value
        name : str, default="theta"
            How messages call it.

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
                    f"`{name}` must have a value for each name of the structure. Got "
                    f"missing or unknown ones: {', '.join(map(str, wrong))}."
                )
            theta = [theta[of] for of in self.parameter_names]
        vector = real_array(name, theta).reshape(-1)
        if vector.shape != (self.n_params,) or not np.isfinite(vector).all():
            some = ", ".join(self.parameter_names[:4])
            raise ValueError(
                f"`{name}` must be {self.n_params} finite values "
                f"({some}{', ...' if self.n_params > 4 else ''}). Got {vector}."
            )
        return squarable(name, vector)

    @property
    def reference(self) -> Array:
        """A point where the matrices exist, shape (n_params,).

        The first guess, else the middle of the ranges, else zeros or parameters of
        unit masses, all within the bounds.
        """
        if self.initial is not None:
            return self.initial
        start = np.zeros(self.n_params)
        if self.implicit is not None:
            start = self.implicit.regular_point(self.lower, self.upper)
        known = ~np.isnan(self.ranges[0])
        start = np.where(known, self.ranges.sum(0) / 2.0, start)
        return np.clip(start, self.lower, self.upper)

    # -- the matrices --------------------------------------------------------------

    @property
    def free_feedthrough(self) -> NDArray[np.bool_]:
        """Which entries of D hold a parameter, shape (n_outputs, n_inputs)."""
        n, points = self.order, [self.reference]
        if not self.is_affine:  # a derivative may vanish at one point
            move = _ASIDE * np.where(points[0] == 0, 1.0, points[0])
            points.append(np.clip(points[0] + move, self.lower, self.upper))
        slopes = np.nan_to_num([self.jacobian(point) for point in points])
        return (slopes[:, :, n:, n:] != 0).any((0, 1))

    def feedthrough_of(self, D: Array) -> Array:
        """`D` where the structure has a parameter in it, else the structure's own D."""
        return np.where(self.free_feedthrough, D, self.matrices(self.reference)[3])

    def system_matrix(self, theta: Array) -> Array:
        """``S = [[A, B], [C, D]]``, shape (..., order + n_outputs, order + n_inputs).

        Parameters
        ----------
        theta : ndarray of shape (..., n_params)
        """
        array = type(theta) is np.ndarray and theta.dtype.kind in "fc"
        fits = array and theta.shape[-1:] == (self.n_params,)
        if not fits or not np.isfinite(theta).all():
            theta = self._stacked_params(theta)
        if self.is_affine or np.ndim(theta) == 1:
            return self.map.system_matrix(theta)
        rows = np.reshape(theta, (-1, self.n_params))
        stack = np.array([self.map.system_matrix(row) for row in rows])
        return stack.reshape(np.shape(theta)[:-1] + self.map.shape)

    def jacobian(self, theta: Array) -> Array:
        """``dS / dtheta``, shape (n_params, order + n_outputs, order + n_inputs)."""
        return self.map.jacobian(theta)

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
        return self.map.curvature(theta)

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
        return blocks(self.system_matrix(self._stacked_params(theta)), self.order)

    def _stacked_params(self, theta: Any) -> Array:
        stacked = real_array("theta", theta)
        fits = stacked.shape[-1:] == (self.n_params,)
        if not fits or not np.isfinite(stacked).all():
            raise ValueError(
                f"`theta` must be finite, of shape (..., {self.n_params}). Got "
                f"{shown(theta)}."
            )
        return stacked

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


def drawn_around(
    guess: Array, n: int, rng: np.random.Generator, spread: float = _SPREAD
) -> Array:
    """Random vectors around a guess that keep its signs, shape (n, n_params)."""
    return guess * np.exp(spread * rng.normal(size=(n, len(guess))))


def _number(value: Any) -> float:
    """`value` as a float that is not NaN; strings are refused."""
    limit = real_array("bounds", value)
    if isinstance(value, bool) or limit.ndim or np.isnan(limit):
        raise ValueError(f"not a number: {shown(value)}")
    return float(limit)
