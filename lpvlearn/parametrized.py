"""Objects with named parameters: their domain, and vectors from names."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import real_array
from .parameter_domain import Interval, ParameterDomain

Array = NDArray[np.float64]
Self = TypeVar("Self", bound="Parametrized")


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

    def _with_domain(self: Self, domain: ParameterDomain) -> Self:
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

    def with_bounds(self: Self, bounds: Mapping[str, Interval]) -> Self:
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

    def with_ranges(self: Self, ranges: Mapping[str, Interval]) -> Self:
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
