"""Other parameters whose response is as near the black box: no error tells which.

As where two parts of a structure may change places with other values of each, or a lag
may have any of several poles, and the rest of the model follows.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..structures.interchanges import (
    distance,
    interchanges,
    known_before,
    within_bounds,
)
from ..structures.structure import drawn_around
from .deadline import time_is_up
from .problem import RestructuringProblem

Array = NDArray[np.float64]
Choices = NDArray[np.intp]

# A fit is another optimum where its error exceeds that of the first by no more than a
# part, or rounding, and a parameter differs by more than a part (those below _TINY of
# the largest by that of it).
EQUAL, EXACT = 1.02, 1e-9
_OTHER, _TINY = 1e-2, 1e-6
_UNLIKE, _ROUNDING = 0.05, 1e-6  # parts of that error, or of a channel, that differ

_FEW = 8  # parameters of which any two may be exchanged
_SCATTERED, _SPREAD = 12, 1.0  # starts about an optimum, by factors of e or so


def as_good(problem: RestructuringProblem, theta: Array, error: float) -> Array | None:
    """Other parameters than theta (n_params,) that are as good; None where none is.

    Of that relative error, within the bounds, and no farther from what is known of the
    parameters, such as ranges. Apart from interchanges, which are told anyway.
    """
    structure = problem.structure
    known, places = known_before(structure, None), interchanges(structure)
    most = EQUAL * max(error, EXACT)
    starts = [theta[pi] for pi in exchanges(problem, theta, most)]
    found = [other for _, other in _others(problem, theta, starts, most, places)]
    found += elsewhere(problem, theta, most, places)
    unlike = max(_UNLIKE * error, _ROUNDING)
    for other in found:
        inside = within_bounds(structure, other[None, None])[0]
        if not inside or (_differences(problem, other, theta) > unlike).any():
            continue
        if np.isnan(known).all():
            return other
        away = [distance(structure, x[None], known) for x in (other, theta)]
        if away[0] <= away[1]:
            return other
    return None


def _differences(problem: RestructuringProblem, other: Array, theta: Array) -> Array:
    """Of the responses of every channel, relative to its size."""
    models = (problem.structure.model(x) for x in (other, theta))
    H, G = (model.frequency_response(problem.omega) for model in models)
    gap, size = (np.linalg.norm(value, axis=0) for value in (H - G, G))
    return np.asarray(gap / np.where(size > 0.0, size, 1.0))


def is_other(theta: Array, known: Array) -> bool:
    """Whether parameters are none of the rows that are known."""
    return bool(are_apart(theta, known).any(1).all())


def are_apart(theta: Array, known: Array) -> NDArray[np.bool_]:
    """Which parameters differ from those known, (..., n_params)."""
    size = np.maximum(np.abs(theta), _TINY * np.abs(theta).max())
    return np.asarray(np.abs(known - theta) > _OTHER * np.where(size > 0, size, 1.0))


def exchanges(
    problem: RestructuringProblem, theta: Array, most: float
) -> list[list[int]]:
    """Which two parameters, exchanged, lead to other optima of at most that error.

    Of parts of like kind, lags in series, say, another value of each gives the same
    response. Of many parameters that is not looked for.
    """
    n = len(theta)
    exchanged = [
        [{i: j, j: i}.get(k, k) for k in range(n)]
        for i, j in combinations(range(n if n <= _FEW else 0), 2)
    ]
    itself = np.arange(n)[None]
    starts = [theta[pi] for pi in exchanged]
    return [exchanged[k] for k, _ in _others(problem, theta, starts, most, itself)]


def elsewhere(
    problem: RestructuringProblem, theta: Array, most: float, places: Choices
) -> list[Array]:
    """Other optima of at most that error, from starts about the one that is known.

    As where a lag may have any of several poles, and the rest of a model follows.
    """
    starts = drawn_around(theta, _SCATTERED, np.random.default_rng(0), _SPREAD)
    starts = np.clip(starts, problem.structure.lower, problem.structure.upper)
    return [other for _, other in _others(problem, theta, starts, most, places)]


def _others(
    problem: RestructuringProblem,
    theta: Array,
    starts: Iterable[Array],
    most: float,
    places: Choices,
) -> list[tuple[int, Array]]:
    """Numbers of the starts that lead to other optima of at most that error, and these.

    Other than theta and than one another, apart from permutations `places`.
    """
    known, found = theta[places], []
    for k, start in enumerate(starts):
        fit = None if time_is_up() else problem.fit(start)
        if fit is None or fit.relative_error > most:
            continue
        if is_other(fit.x, known):
            known = np.vstack([known, fit.x[places]])
            found.append((k, fit.x))
    return found
