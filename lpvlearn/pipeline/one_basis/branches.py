"""Which of equally good parameters at every operating point belong together.

Where parts of a structure may change places, or several parameters give one response,
every operating point has several optima, and the error cannot choose. What can is that
the parameters are smooth functions of the scheduling variable: of all families that
take one candidate at each point, the one of the highest evidence is chosen, with every
parameter a Gaussian process over the scheduling variable,

    theta_j(kappa) = line + a smooth function of unknown size and length + noise,

the noise that of the estimate and a little more. Branches that cross, cross with their
slopes. Families are built point after point along the minimum spanning tree, the best
ones of every length kept; their evidences also tell how certain the choice is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ...lpv.alignment import spanning_tree
from ...models.scheduling_range import in_range_of_points
from ...restructuring.equal_optima import (
    EQUAL,
    EXACT,
    elsewhere,
    exchanges,
    is_other,
)
from ...restructuring.problem import RestructuringProblem
from ...restructuring.uncertainty import ParameterUncertainty
from ...structures.interchanges import (
    distance,
    interchanges,
    known_before,
    slow_first,
    within_bounds,
)
from ...structures.structure import GrayBoxStructure

Array = NDArray[np.float64]
Choices = NDArray[np.intp]
Distance = Callable[[Array], Array]  # of families (..., n_points, n_params)

_OPTIMA = 6  # of a point at most, apart from interchanges
_TINY = 1e-6  # part of the mean square below which what is usual says nothing
_SWEEPS = 4  # over the points: optima travel that far

# Prior of a parameter over the scheduling range, in units of its spread: the level, the
# change of its line, and what bends: its sizes, its lengths, and noise beside the known
_LEVEL, _LINE = 1.0, 1.0
_BENDS, _LENGTHS, _ROUGH = (0.03, 0.3, 1.0), (0.4, 1.0), (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
_QUICK = ((0.1, 0.5, 0.02), (0.5, 0.5, 0.05))  # of the search: bend, length, noise

_UNKNOWN = 1e6  # variance, in squares of the spread, from which a value says nothing

_KEPT = 200  # families of every length
_WEIGHED = 24  # of them whose evidence is computed, for each prior of the search
_CERTAIN = 0.95  # probability of the choice from which no more is said
_WHOLE = 1e-8  # and of other parameters at all points, which may be as smooth by nature
_TELLS = 0.05  # difference of two choices, in the spread of a parameter, that matters
_DEVIATIONS = 3.0  # and in its standard deviations


class Branch(NamedTuple):
    """What becomes of the fit of a point."""

    start: Array | None  # another optimum, to begin from
    places: Choices | None  # else its own parameters, put in these places; None: stays


class Doubt(NamedTuple):
    """Where another family is nearly as plausible."""

    point: int
    params: Choices  # which would change
    probability: float  # of the choice
    other: Array  # (n_params,): what they would be


class Family(NamedTuple):
    """One candidate at every point."""

    chosen: Choices  # (n_points,)
    doubts: list[Doubt]


def tied_branches(
    problems: Sequence[RestructuringProblem],
    fitted: Sequence[Any],
    covariances: Sequence[Array | None],
    kappa: Array,
) -> tuple[list[Branch], list[Doubt]]:
    """Which of the equally good parameters of every point make one smooth family.

    `problems` are those of the points, `fitted` their restructurers, `covariances` of
    the parameters None where not known.
    """
    structure = problems[0].structure
    places = interchanges(structure)
    optima, lower_fit = _equal_optima(problems, fitted, kappa, places)
    alone = len(places) == 1 and all(len(found) == 1 for found in optima)
    if alone and not lower_fit.any():
        return [Branch(None, None)] * len(fitted), []
    low, high = structure.lower, structure.upper
    candidates, variances, origins = [], [], []
    for problem, found, P in zip(problems, optima, covariances, strict=True):
        known = np.zeros((structure.n_params,) * 2) if P is None else P
        spread = _variances(problem, found, known)
        # the optima first, then those with interchanged parts
        origin = [(i, pi) for pi in places for i in range(len(found))]
        rows = np.array([found[i][pi] for i, pi in origin])
        inside = np.asarray(((rows >= low) & (rows <= high)).all(1), dtype=bool)
        inside[0] = True
        candidates.append(rows[inside])
        variances.append(np.array([spread[i][pi] for i, pi in origin])[inside])
        origins.append([origin[i] for i in np.flatnonzero(inside)])
    # without bounds the parts of a whole family may be numbered in any way
    n_first = (
        None
        if structure.is_bounded
        else len(optima[int(spanning_tree(kappa, outward=False)[0][0])])
    )
    known = known_before(structure, getattr(fitted[0], "init", None))
    far = None if np.isnan(known).all() else partial(distance, structure, guess=known)
    chosen, doubts = smoothest_family(
        kappa, candidates, variances, n_first, far, places
    )
    family = np.array([c[i] for c, i in zip(candidates, chosen, strict=True)])
    number = places[_numbering(structure, family, places, far)]
    branches = []
    for found, origin, i, lower in zip(optima, origins, chosen, lower_fit, strict=True):
        optimum, pi = origin[i]
        pi = pi[number]
        if optimum or lower:
            branches.append(Branch(found[optimum][pi], None))
        else:
            branches.append(Branch(None, None if (pi == places[0]).all() else pi))
    back = np.argsort(number)
    return branches, [
        d._replace(params=np.sort(back[d.params]), other=d.other[number])
        for d in doubts
    ]


def _variances(
    problem: RestructuringProblem, optima: Sequence[Array], known: Array
) -> Array:
    """Of the parameters of optima, of the covariance of the first of them.

    What noise does to the response, ``J dtheta`` with J its derivatives, is the same at
    all. Those of the first where that is not known; zero where nothing is.
    """
    own = np.where(np.isnan(np.diag(known)), 0.0, np.diag(known))
    found = [own] * len(optima)
    if len(optima) > 1 and np.isfinite(known).all():
        dG = problem.system.response_jacobian(optima[0], problem.omega)[1]
        dG = np.moveaxis(dG, -1, 0)
        for k, theta in enumerate(optima[1:], start=1):
            T = ParameterUncertainty(problem, theta).changes(dG, "hinf")
            found[k] = np.maximum(np.diag(T.T @ known @ T), 0.0)
    return np.array(found)


def _equal_optima(
    problems: Sequence[RestructuringProblem],
    fitted: Sequence[Any],
    kappa: Array,
    places: Choices,
) -> tuple[list[list[Array]], NDArray[np.bool_]]:
    """Parameters of every point that fit it as well as its own, which are the first.

    Least-squares fits from those of the neighbours, apart from permutations `places`.
    And where these fit better, and take the place of its own.
    """
    optima = [[own.params_] for own in fitted]
    lower = np.zeros(len(fitted), bool)
    if any(f.identifiability_.rank < f.structure_.n_params for f in fitted):
        return optima, lower  # whole valleys of them
    starts = [own.start_params_ for own in fitted]
    least = [max(own.fit_error_, EXACT) for own in fitted]
    known = [[x[places]] for x in starts]
    order, parents = spanning_tree(kappa, outward=False)
    edges = [(int(k), int(parents[k])) for k in order[1:]]
    edges = sorted([*edges, *((j, i) for i, j in edges)])
    beside = [[j for i, j in edges if i == k] for k in range(len(kappa))]
    waiting = [(i, starts[j]) for i, j in edges]
    root = int(order[0])
    most = EQUAL * least[root]
    if len(places) == 1:
        for pi in exchanges(problems[root], starts[root], most):
            waiting += [(k, start[pi]) for k, start in enumerate(starts)]
    for other in elsewhere(problems[root], starts[root], most, places):
        waiting += [(k, other) for k in range(len(starts))]
    for _ in range(_SWEEPS):
        new = []
        for i, start in waiting:
            fit = problems[i].fit(start)
            if fit is None or len(optima[i]) == _OPTIMA:
                continue
            if fit.relative_error > EQUAL * least[i]:
                continue
            if EQUAL * fit.relative_error < least[i] > EXACT:
                least[i], lower[i] = max(fit.relative_error, EXACT), True
                optima[i], known[i] = [fit.x], [fit.x[places]]
                new += [(k, fit.x) for k in beside[i]]
                continue
            if is_other(fit.x, np.vstack(known[i])):
                optima[i].append(fit.x)
                known[i].append(fit.x[places])
                new += [(k, fit.x) for k in beside[i]]
        waiting = new
    return optima, lower


def _numbering(
    structure: GrayBoxStructure, family: Array, places: Choices, far: Distance | None
) -> int:
    """Which image of the whole family to keep: the least `far` from what is known.

    Else, and of those as far, the one whose earlier parts are the slower ones.
    """
    images = family[:, places].swapaxes(0, 1)
    inside = within_bounds(structure, images)
    away = np.where(inside, 0.0 if far is None else far(images), np.inf)
    near = np.isclose(away, away.min())
    merit = slow_first(structure, family, places)
    return int(np.argmax(np.where(near, merit, -np.inf)))


def smoothest_family(
    kappa: Array,
    candidates: Sequence[Array],
    variances: Sequence[Array],
    n_first: int | None = None,
    far: Distance | None = None,
    places: Choices | None = None,
) -> Family:
    """The most plausible choice of one candidate at every point.

    `candidates` hold parameters (n_candidates, n_params) for every row of `kappa`,
    `variances` those of their errors (zero where not known). Families that but number
    their parts in another of `places` (n_numberings, n_params) are one: at the first
    point of the tree only the first `n_first` are taken, where the others would do
    that. Of two that differ at all points the less `far` from what is known is taken,
    if something is.
    """
    x = in_range_of_points(kappa) - 0.5
    order = spanning_tree(kappa, outward=False)[0].astype(np.intp)
    columns = np.flatnonzero(
        np.any([np.ptp(rows, axis=0) > 0 for rows in candidates], axis=0)
    )
    chosen = np.zeros(len(kappa), dtype=np.intp)
    if columns.size == 0:
        return Family(chosen, [])
    center, unit = _units(candidates, columns)
    Y = [(rows[:, columns] - center) / unit for rows in candidates]
    V = [np.minimum(rows[:, columns] / unit**2, _UNKNOWN) for rows in variances]
    families = np.unique(
        np.vstack([_search(x, Y, V, order, prior, n_first) for prior in _QUICK]), axis=0
    )
    places = np.arange(candidates[0].shape[1])[None] if places is None else places
    rows = zip(candidates, families.T, strict=True)
    values = np.stack([np.asarray(c)[i] for c, i in rows], axis=1)
    families, images = _apart(families, values[..., places].swapaxes(1, 2))
    evidence = _evidence(x, Y, V, families)
    chosen = families[int(np.argmax(evidence))]
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    changes = _changes(Y, V, families, chosen)
    other = np.array([differs.any(1) for differs in changes])  # (n_points, n_families)
    whole = other.all(0) & (weight > _WHOLE)
    if whole.any() and far is not None:
        away = np.where(whole | (weight == weight.max()), 0.0, np.inf)
        away += far(images).min(1)
        return Family(families[int(np.argmin(away))], [])
    doubts = []
    for k, differs in enumerate(changes):
        certain = 1.0 - float(weight[other[k]].sum())
        if whole.any() or certain < _CERTAIN:
            rivals = whole if whole.any() else other[k]
            rival = int(np.argmax(np.where(rivals, weight, -1.0)))
            values = np.asarray(candidates[k])[families[rival, k]]
            doubts.append(Doubt(k, columns[differs[rival]], certain, values))
    return Family(chosen, doubts)


def _apart(families: Choices, images: Array) -> tuple[Choices, Array]:
    """The families that are no other numbering of one before, and theirs.

    `images` are all of these, (n_families, n_numberings, n_points, n_params).
    """
    kept: list[int] = []
    for f, image in enumerate(images):
        if not (images[kept, 0] == image[:, None]).all((2, 3)).any():
            kept.append(f)
    return families[kept], images[kept]


def _changes(
    Y: Sequence[Array], V: Sequence[Array], families: Choices, chosen: Choices
) -> list[NDArray[np.bool_]]:
    """Where families differ from one, (n_families, q) of every point."""
    changes = []
    for k, c in enumerate(chosen):
        gap = np.abs(Y[k][families[:, k]] - Y[k][c])
        noise = np.sqrt(V[k][families[:, k]] + V[k][c])
        changes.append(gap > np.maximum(_TELLS, _DEVIATIONS * noise))
    return changes


def _units(candidates: Sequence[Array], columns: Choices) -> tuple[Array, Array]:
    """Level and spread of every parameter over all candidates of the usual point."""
    rows = [c[:, columns] for c in candidates]
    center = np.median([c.mean(0) for c in rows], axis=0)
    squares = np.array([((c - center) ** 2).mean(0) for c in rows])
    usual, mean = np.median(squares, axis=0), squares.mean(0)
    return center, np.sqrt(np.where(usual > _TINY**2 * mean, usual, mean))


def _prior(x: Array, bend: float, length: float) -> Array:
    """Covariance of a parameter at the points."""
    smooth = np.exp(-0.5 * (cdist(x, x) / length) ** 2)
    return np.asarray(_LEVEL**2 + _LINE**2 * (x @ x.T) + bend**2 * smooth)


def _search(
    x: Array,
    Y: Sequence[Array],
    V: Sequence[Array],
    order: Choices,
    prior: tuple[float, float, float],
    n_first: int | None,
) -> Choices:
    """Families of the least sum of squared surprises, (n_families, n_points)."""
    bend, length, rough = prior
    K = _prior(x, bend, length)
    # one noise for all candidates of a parameter: the weights are those of all families
    noise = np.array([v.mean(0) for v in V]).T + rough**2  # (q, n)
    first = int(order[0])
    families = np.arange(len(Y[first]) if n_first is None else n_first)[:, None]
    values, cost = Y[first][families[:, 0]][:, None], np.zeros(len(families))
    for i, k in enumerate(order[1:], start=1):
        known = order[:i]
        inner = K[np.ix_(known, known)] + noise[:, known, None] * np.eye(i)
        weights = np.linalg.solve(inner, K[known, k][:, None])[..., 0]  # (q, i)
        variance = K[k, k] + noise[:, k] - weights @ K[known, k]
        expected = np.einsum("ji,fij->fj", weights, values)
        surprise = ((Y[k][None] - expected[:, None]) ** 2 / variance).sum(2)
        total = (cost[:, None] + surprise).ravel()
        best = np.argsort(total, kind="stable")[:_KEPT]
        parent, child = np.divmod(best, len(Y[k]))
        families = np.column_stack([families[parent], child])
        values = np.concatenate([values[parent], Y[k][child][:, None]], axis=1)
        cost = total[best]
    found = np.empty_like(families[:_WEIGHED])
    found[:, order] = families[:_WEIGHED]
    return found


def _evidence(
    x: Array, Y: Sequence[Array], V: Sequence[Array], families: Choices
) -> Array:
    """Logarithm of the evidence of every family: priors alike, parameters apart."""
    n = len(x)
    priors = np.array([_prior(x, b, L) for b in _BENDS for L in _LENGTHS])
    K = priors[:, None] + np.array([r**2 * np.eye(n) for r in _ROUGH])
    K = K.reshape(-1, n, n)
    evidence = np.empty(len(families))
    for f, family in enumerate(families):
        y = np.array([rows[c] for rows, c in zip(Y, family, strict=True)]).T  # (q, n)
        v = np.array([rows[c] for rows, c in zip(V, family, strict=True)]).T
        L = np.linalg.cholesky(K + (v[:, None, :, None] * np.eye(n)))  # (q, g, n, n)
        z = np.linalg.solve(L, np.broadcast_to(y[:, None, :, None], (*L.shape[:3], 1)))
        size = np.log(np.diagonal(L, axis1=2, axis2=3)).sum(2)
        each = -0.5 * (z[..., 0] ** 2).sum(2) - size
        top = each.max(1, keepdims=True)
        evidence[f] = np.sum(top[:, 0] + np.log(np.exp(each - top).mean(1)))
    return evidence
