"""Gray-box structures: parameters to state-space matrices, with derivatives.

A structure writes the system matrix ``S = [[A, B], [C, D]]`` as a function of the
parameter vector, Eq. (2). It is affine, ``S(theta) = S_0 + sum_j theta_j S_j``, when
given as a template, and any smooth function otherwise. It is two things: the map from
parameters to S (:mod:`~lpvlearn.structures.map`), and the domain of the parameters
(:mod:`~lpvlearn.structures.domain`), what is known of their values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.statespace import StateSpace
from ..models.system_matrix import Blocks, blocks
from ..validation import named_values, real_array
from .domain import Interval, ParameterDomain
from .map import AffineMap, FunctionMap, StructureMap
from .mechanical import ImplicitMap, mechanical_map
from .templates import (
    Entry,
    affine_system,
    full_cells,
    modal_cells,
    observable_canonical_cells,
)

Array = NDArray[np.float64]


class GrayBoxStructure:
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

    def __init__(self, order: int, map: StructureMap, domain: ParameterDomain) -> None:
        self.order, self.map, self.domain = order, map, domain
        self.n_outputs, self.n_inputs = (int(k) - order for k in map.shape)
        self.parameter_names, self.n_params = domain.names, len(domain.names)
        self.initial, self.ranges = domain.initial, domain.ranges
        self.lower, self.upper = domain.lower, domain.upper
        self.is_bounded = bool(np.isfinite([domain.lower, domain.upper]).any())
        affine = map if isinstance(map, AffineMap) else None
        self.is_affine = affine is not None
        self.offset = None if affine is None else affine.offset
        self.basis = None if affine is None else affine.basis

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
        order, map, names = affine_system(A, B, C, D, parameter_names)
        return cls(order, map, ParameterDomain.free(names))

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
        given = function(start)
        if len(given) not in (3, 4):
            raise ValueError(
                f"`function` must return (A, B, C) or (A, B, C, D). Got {len(given)}."
            )
        A, B, C = given[:3]
        model = StateSpace(A, B, C, given[3] if len(given) == 4 else None)
        dimensions = model.order, model.n_inputs, model.n_outputs
        map = FunctionMap(function, jacobian, dimensions, start)
        if jacobian is not None:
            map.jacobian(start)  # its shapes are told of here, not in a fit
        return cls(model.order, map, ParameterDomain.free(names, start))

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
        return cls.from_template(
            *observable_canonical_cells(order, n_inputs, n_outputs, feedthrough)
        )

    @classmethod
    def full(
        cls, order: int, n_inputs: int, n_outputs: int, feedthrough: bool = True
    ) -> GrayBoxStructure:
        """Every entry of the matrices is a parameter (row by row: A, B, C, D).

        The arguments are those of :meth:`observable_canonical`.

        Examples
        --------
        >>> GrayBoxStructure.full(1, 1, 1).parameter_names
        ('a1_1', 'b1_1', 'c1_1', 'd1_1')
        """
        A, B, C, D = full_cells(order, n_inputs, n_outputs, feedthrough)
        names = [str(name) for row in (*A, *B, *C, *(D or [])) for name in row]
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
        equations, names = mechanical_map(M, D, K, F, outputs, sensors, parameter_names)
        guess = None if initial is None else named_values("initial", initial, names)[0]
        domain = ParameterDomain.free(names, guess)
        structure = cls(equations.order, equations.simplest(), domain)
        if guess is None and structure.implicit is not None:
            equations.regular_point()  # that there is none is told of here
        return structure

    # -- what is known of the parameters -------------------------------------------

    def with_bounds(self, bounds: Mapping[str, Interval]) -> GrayBoxStructure:
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
        return type(self)(self.order, self.map, self.domain.with_bounds(bounds))

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
        >>> from lpvlearn import GrayBoxStructure
        >>> structure = GrayBoxStructure.observable_canonical(1)
        >>> structure.with_ranges({"b1_1": (1, 100)}).ranges
        array([[ nan,   1.],
               [ nan, 100.]])
        """
        return type(self)(self.order, self.map, self.domain.with_ranges(ranges))

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
        full, free = self.domain.fixed(values)
        map, domain = self.map.fix(full, free), self.domain.restricted(free)
        return type(self)(self.order, map, domain)

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
        return self.domain.draw(n, rng)

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

    # -- the matrices --------------------------------------------------------------

    @property
    def implicit(self) -> ImplicitMap | None:
        """The equations ``M(theta) X = N(theta)`` of a structure that solves them."""
        return self.map if isinstance(self.map, ImplicitMap) else None

    @property
    def free_feedthrough(self) -> NDArray[np.bool_]:
        """Which entries of D hold a parameter, shape (n_outputs, n_inputs)."""
        n = self.order
        return (self.jacobian(self.reference)[:, n:, n:] != 0).any(0)

    def system_matrix(self, theta: Array) -> Array:
        """``S = [[A, B], [C, D]]``, shape (..., order + n_outputs, order + n_inputs).

        Parameters
        ----------
        theta : ndarray of shape (..., n_params)
        """
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
