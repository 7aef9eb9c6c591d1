"""Where the parameters of a structure may lie: bounds, known ranges, first guesses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Interval = Sequence[float | None]

_SPREAD = 0.3  # standard deviation of log-parameters: a guess is right to a third

_DECADE = 10.0  # a range that spans more tells an order of magnitude, not a value

_LISTED = 8  # names that a message lists


@dataclass(frozen=True, eq=False)
class ParameterDomain:
    """Bounds, ranges and first guess of named parameters.

    Attributes
    ----------
    names : tuple of str
    lower, upper : ndarray of shape (n_params,)
        -inf and inf where a parameter is free.
    ranges : ndarray of shape (2, n_params)
        Where a parameter is expected, without a bound; NaN where that is not known.
    initial : ndarray of shape (n_params,) or None
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    ranges: Array
    initial: Array | None

    def __post_init__(self) -> None:
        for array in (self.lower, self.upper, self.ranges, self.initial):
            if array is not None:
                array.setflags(write=False)

    @classmethod
    def free(
        cls, names: Sequence[str], initial: Array | None = None
    ) -> ParameterDomain:
        """No bounds and no ranges.

        Examples
        --------
        >>> ParameterDomain.free(["k"]).lower
        array([-inf])
        """
        q = len(names)
        infinite, unknown = np.full(q, np.inf), np.full((2, q), np.nan)
        return cls(tuple(names), -infinite, infinite, unknown, initial)

    def with_bounds(self, bounds: Mapping[str, Interval]) -> ParameterDomain:
        """The domain with other bounds, see `GrayBoxStructure.with_bounds`."""
        lower, upper = self.lower.copy(), self.upper.copy()
        for j, name, (low, high) in self._intervals("bounds", bounds):
            lower[j] = -np.inf if low is None else low
            upper[j] = np.inf if high is None else high
            if not lower[j] < upper[j]:
                raise ValueError(
                    f"`bounds` of {name!r} must have the lower one below the upper "
                    f"one. Got ({lower[j]:g}, {upper[j]:g}). A parameter of one value "
                    "is fixed: structure.fix()."
                )
        return replace(self, lower=lower, upper=upper)._checked()

    def with_ranges(self, ranges: Mapping[str, Interval]) -> ParameterDomain:
        """The domain with other ranges, see `GrayBoxStructure.with_ranges`."""
        table = self.ranges.copy()
        for j, name, (low, high) in self._intervals("ranges", ranges):
            if low is None or high is None or not -np.inf < low < high < np.inf:
                raise ValueError(
                    f"`ranges` of {name!r} must be two finite values, the lower first. "
                    f"Got ({low}, {high}). A limit on one side is a bound: "
                    "structure.with_bounds()."
                )
            table[:, j] = low, high
        return replace(self, ranges=table)._checked()

    def fixed(self, values: Any) -> tuple[Array, NDArray[np.bool_]]:
        """A vector that holds the given values, and which parameters remain free."""
        if not isinstance(values, Mapping):
            raise ValueError(f"`values` must map names to numbers. Got {values!r}.")
        full, free = np.zeros(len(self.names)), np.ones(len(self.names), bool)
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
        return full, free

    def restricted(self, keep: NDArray[np.bool_]) -> ParameterDomain:
        """The domain of some of the parameters."""
        return ParameterDomain(
            tuple(np.array(self.names, dtype=object)[keep]),
            self.lower[keep],
            self.upper[keep],
            self.ranges[:, keep],
            None if self.initial is None else self.initial[keep],
        )

    def draw(self, n: int, rng: np.random.Generator) -> Array | None:
        """Random vectors, see `GrayBoxStructure.draw`."""
        known = ~np.isnan(self.ranges[0])
        if self.initial is None and not known.all():
            return None
        initial = np.zeros(len(self.names)) if self.initial is None else self.initial
        around = drawn_around(initial, n, rng)
        uniform = rng.uniform(size=(n, len(initial)))
        low, high = np.where(known, self.ranges, 1.0)
        ratio = np.divide(high, low, out=np.ones_like(low), where=low != 0)
        ratio = np.where(ratio > 0, ratio, 1.0)  # of one sign only
        wide = np.maximum(ratio, 1.0 / ratio) > _DECADE
        drawn = np.where(
            wide, low * ratio**uniform, low * (1.0 - uniform) + high * uniform
        )
        drawn = np.where(known, drawn, around)
        return np.clip(drawn, self.lower, self.upper)

    def _checked(self) -> ParameterDomain:
        for j, name in enumerate(self.names):
            low, high = self.ranges[:, j]
            if low < self.lower[j] or high > self.upper[j]:
                raise ValueError(
                    f"`ranges` of {name!r} must lie within its bounds "
                    f"({self.lower[j]:g}, {self.upper[j]:g}). Got ({low:g}, {high:g})."
                )
            value = np.nan if self.initial is None else self.initial[j]
            if value < self.lower[j] or value > self.upper[j]:
                raise ValueError(
                    f"`bounds` of {name!r} must hold its initial value {value:g}. Got "
                    f"({self.lower[j]:g}, {self.upper[j]:g})."
                )
        return self

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
        if name not in self.names:
            known = ", ".join(self.names[:_LISTED])
            more = ", ..." if len(self.names) > _LISTED else ""
            raise ValueError(
                f"`{argument}` must name parameters of the structure "
                f"({known}{more}). Got {name!r}."
            )
        return self.names.index(name)


def drawn_around(guess: Array, n: int, rng: np.random.Generator) -> Array:
    """Random vectors around a guess that keep its signs, shape (n, n_params)."""
    return guess * np.exp(_SPREAD * rng.normal(size=(n, len(guess))))


def _number(value: Any) -> float:
    """`value` as a float that is not NaN; strings are refused."""
    number = np.nan if isinstance(value, str | bool) else float(value)
    if np.isnan(number):
        raise ValueError(f"not a number: {value!r}")
    return number
