"""Where the minimisation starts: candidates, ranked and fitted, until one fit is good.

Candidates are parameters from whatever is known: a first guess, ranges, similarity
transformations of the black box, sizes that equations of motion make natural, and, from
the second round on, fits of a smoother response. The best ones start least-squares
fits.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..structures.map import AffineMap, mirrored
from ..structures.mechanical import ImplicitMap
from ..structures.structure import GrayBoxStructure, drawn_around
from ..systems.balancing import balancing_transformation
from ..validation import shown
from .continuation import continued_fits
from .coordinates import CanonicalForm
from .deadline import time_is_up
from .error_system import Target, frequency_grid, model_response
from .least_squares import LeastSquaresResult, channel_scaling
from .limits import growth
from .parts import start_by_parts
from .problem import AGREEING, RestructuringProblem, agreeing
from .similarity import mean_rate, scaled_problem, similarity_starts

Array = NDArray[np.float64]

# A worse fit is searched on for, even where starts agree on it: a structure seldom is
# that far from what it is meant to describe, and starts may agree on a wrong basin.
_FAR_FIT = 0.1

DISCRETE_BOX = (  # what often is wrong then
    " The black box is in discrete time: convert it by to_continuous() if the "
    "structure is in continuous time."
)

_COST = attrgetter("cost")  # by which fits are sorted
_ROUNDS = 3  # more starts; then a smoother response; then both, thoroughly
_N_FITS = 3  # of a round, from the best candidates: their ranking is seldom far off
_SAME = 1e-4  # relative difference of the costs of fits in one basin: they end at 1e-6

_DISTINCT = 1e-6  # relative distance of candidates that would end in the same fit

# A structure slower than the black box lets expect is searched for with that part of
# the stability margin: it must be stable still.
_LEAST_MARGIN = 1e-6

_HOP_FIT = 0.03  # error of a fit so far off that better basins may lie beside its own
_HOPS = (0.1, 0.3, 1.0) * 4  # sizes of the hops of logarithms: 10 %, to a factor of 3
_HOP_RETURNS = 5  # to the fit itself, after which its basin counts as wide
_HOP_ROUNDS = 4  # from ever better fits
_HOP_GAIN = 1e-3  # relative decrease of the cost that is worth another round
_MOST_SIGNS = 12  # parameters whose sign is changed, one at a time
_FAINT = 0.03  # size of modes that only fill the order: seen, but hardly disturbing
_FAST = 3.0  # decay of these modes, relative to the fastest: they are out of the way
_AMONG = 1.3  # of modes without effect, relative to the mean: no pole's own
_EXACT_PARTS = 1e-6  # distance of a start by parts that the black box itself is
_SLOWEST = 1e-9  # poles smaller than that part of the largest are integrators

_POINTS, _OF_ROUNDING = 20, 1e-12  # at which a trace is zero, relative to its matrix

# A parameter is at a flat point where a change of its size, one at least, changes the
# response by less; decades about one of its starts elsewhere.
_FLAT, _DECADES = 1e-4, 3.0

# Starts at each time scale that are carried through a continuation: its steps cost as
# much as a fit each, and a wrong size does it no harm.
_N_CONTINUED = 6

_N_QUICK = 3  # seeds of the second round

# Its contours, frequencies and steps, about a third of the thorough ones: what a few
# seeds find that way is found, and what they miss the third round looks for.
_QUICK = {"shifts": (1.0, 0.2, 0.05, 0.0), "n_points": 18, "max_iter": 16}


class Search(NamedTuple):
    """Least-squares fits, the problem that they solve, and what is known of the best.

    It is `certain` where rounds of starts agree on it, or nothing can be better.
    """

    problem: RestructuringProblem
    fits: list[LeastSquaresResult]  # by ascending cost
    certain: bool


def search(
    problem: RestructuringProblem,
    init: str | ArrayLike,
    n_starts: int,
    given: list[Array],
    seed: int,
    only_given: bool = False,
) -> Search:
    """Least-squares fits from many starts, or only from `given` ones.

    Where no model of the structure decays as fast as the black box lets expect, its
    stability margin is given up. The options are those of `GrayBoxRestructurer`;
    further candidates may be `given`, or all of them.
    """
    guess = None
    if not isinstance(init, str):
        guess = problem.structure.check_params(init, name="init")
    for share in (1.0, _LEAST_MARGIN):
        problem = replace(problem, margin=share * problem.margin)
        if only_given:
            lower, upper = problem.structure.lower, problem.structure.upper
            found = problem.best_fits(np.clip(given, lower, upper), len(given))
            fits, certain = sorted(found, key=_COST), False
        else:
            rng = np.random.default_rng(seed)
            fits, certain = _rounds(problem, guess, n_starts, given, rng)
        if fits:
            return Search(problem, fits, certain)
    silent = _without_effect(problem, np.random.default_rng(seed))
    if silent:
        raise ValueError(
            "`structure` must have parameters that change its response. Got "
            f"{', '.join(silent)}, which change nothing: an input or an output may be "
            "missing in B, C or D."
        )
    if _never_decays(problem, np.random.default_rng(seed)):
        raise ValueError(
            "`structure` must have parameters of a model that decays. Got one that "
            "never does: the sum of its poles, the trace of A, is negative for no "
            "parameters (within their bounds). Add damping, as '-c' on the diagonal of "
            "A or `D` of equations of motion; where it is small, bound it by what is "
            "known of it."
        )
    if guess is None and not only_given:
        rng = np.random.default_rng(seed)
        drawn = list(_natural_starts(problem, n_starts, rng))
        fits, certain = _rounds(problem, guess, n_starts, drawn, rng)
        if fits:
            return Search(problem, fits, certain)
    begun = given if only_given else [guess]
    worst = None if begun[0] is None else _worst_pole(problem, begun[0])
    if worst is not None:
        name, others = "init", "init='similarity'"
        if only_given:
            name, others = "starts", "search=True"
        raise ValueError(
            f"`{name}` must be parameters of a stable model. Got {shown(begun[0])}, "
            f"with a pole at {worst:.4g}. Correct it (its signs, the order of the "
            f"parameters), or leave it out: {others} looks for others."
            + DISCRETE_BOX
            * (problem.system.dt is not None)
        )
    raise ValueError(
        "no stable starting point was found for `structure`. Check the signs of its "
        "entries: one that is wrong may make it unstable for all parameters. Else give "
        "`init`, a vector of parameters of a stable model, bounds or ranges that tell "
        "signs and sizes (with_bounds, with_ranges), or raise `n_starts` (got "
        f"{n_starts})." + DISCRETE_BOX * (problem.system.dt is not None)
    )


def _worst_pole(problem: RestructuringProblem, theta: Array) -> complex | None:
    """The pole that makes the model of parameters unstable, if any does."""
    poles = problem.system.poles(theta)
    rates = growth(poles, problem.system.dt)
    grows = np.isfinite(poles).all() and rates.max(initial=-np.inf) >= 0
    return complex(poles[np.argmax(rates)]) if grows else None


def _never_decays(problem: RestructuringProblem, rng: np.random.Generator) -> bool:
    """Whether the trace of A(theta) in continuous time is negative for no parameters.

    Of an affine structure by its bounds. Others, analytic in their parameters, have
    the trace zero everywhere if they have at any random points, but for rounding.
    """
    structure, n = problem.structure, problem.structure.order
    if problem.system.dt is not None or n == 0:
        return False
    if isinstance(structure.map, AffineMap):
        offset, basis = structure.map.offset, structure.map.basis
        slopes = np.trace(basis[:, :n, :n], axis1=1, axis2=2)
        ends = np.where(slopes > 0.0, structure.lower, structure.upper)
        moves = slopes != 0.0
        least = np.trace(offset[:n, :n]) + slopes[moves] @ ends[moves]
        return bool(least >= 0.0)
    shape = _POINTS, structure.n_params
    points = np.clip(rng.normal(size=shape), structure.lower, structure.upper)
    matrices = [structure.map.system_matrix(theta)[:n, :n] for theta in points]
    return all(abs(np.trace(A)) <= _OF_ROUNDING * np.abs(A).max() for A in matrices)


def _without_effect(
    problem: RestructuringProblem, rng: np.random.Generator
) -> list[str]:
    """Names of the parameters that change no response at a random point."""
    structure = problem.structure
    theta = rng.normal(size=structure.n_params)
    theta = mirrored(theta, structure.lower, structure.upper)
    J = problem.system.response_jacobian(theta, problem.omega)[1]
    effect = np.abs(np.nan_to_num(J, nan=1.0)).max((0, 1, 2))
    return [n for n, e in zip(structure.parameter_names, effect, strict=True) if e == 0]


def _rounds(
    problem: RestructuringProblem,
    guess: Array | None,
    n_starts: int,
    given: list[Array],
    rng: np.random.Generator,
) -> tuple[list[LeastSquaresResult], bool]:
    """Rounds of candidates and fits, until two agree, and whether no doubt is left.

    One fit that is exact needs no other. Starts of one round have much in common,
    which may mislead all of them.
    """
    structure, n_fits = problem.structure, _N_FITS + len(given)
    linear = structure.order == 0 and structure.is_affine  # one optimum
    tried = np.zeros((0, structure.n_params))
    fits: list[LeastSquaresResult] = []
    ends: list[LeastSquaresResult] = []  # the best fit of every round
    best, certain = np.inf, False
    for number in range(_ROUNDS):
        found = _reduced_otherwise(problem, fits, number)
        if found is None:
            found = _candidates(problem, guess, n_starts, number, rng)
        found = np.clip(np.vstack([*given, found]), structure.lower, structure.upper)
        new = _distinct(found, tried)
        if len(new) == 0 and fits:  # the only start there is
            around = drawn_around(fits[0].x, n_starts, rng)
            new = np.clip(around, structure.lower, structure.upper)
        if len(new) == 0:
            break
        tried = np.vstack([tried, new])
        more = problem.best_fits(new, n_fits, ends)
        ends += sorted(more, key=_COST)[:1]
        fits = sorted(fits + more, key=_COST)
        best = fits[0].relative_error if fits else np.inf
        exact = bool(fits) and problem.is_exact(fits[0])
        certain = linear or exact or agreeing(ends) >= AGREEING
        if certain and best <= max(_FAR_FIT, problem.enough) or (fits and time_is_up()):
            break
    if fits and best > _HOP_FIT:
        fits = hopped_fits(problem, fits, rng)
        exact = problem.is_exact(fits[0])
        certain = certain or exact or agreeing(fits) >= AGREEING
    # one within the black box's own error is not doubted for what one output lacks
    return fits, certain or best <= problem.enough


def _distinct(thetas: Array, others: Array) -> Array:
    """The rows that differ from all rows before them, and from all `others`."""
    kept = len(others)
    for theta in thetas:
        least = _DISTINCT * np.linalg.norm(theta)
        if not (np.linalg.norm(others - theta, axis=1) <= least).any():
            others = np.vstack([others, theta])
    return others[kept:]


def hopped_fits(
    problem: RestructuringProblem,
    fits: list[LeastSquaresResult],
    rng: np.random.Generator,
) -> list[LeastSquaresResult]:
    """Fits from perturbations of the best one, as long as they find a better basin.

    Far from the black box the least-squares error has many minima beside each other.
    No factor leads to those of other signs: every one is changed where nothing tells
    it.
    """
    lower, upper = problem.structure.lower, problem.structure.upper
    for j in np.flatnonzero(known_signs(problem.structure) == 0.0)[:_MOST_SIGNS]:
        if time_is_up():
            break
        theta = fits[0].x.copy()
        theta[j] *= -1.0
        fit = problem.fit(np.clip(theta, lower, upper))
        if fit is not None:
            fits = sorted([*fits, fit], key=_COST)
    for _ in range(_HOP_ROUNDS):
        best, returned = fits[0], 0
        for size in _HOPS:
            if returned == _HOP_RETURNS or time_is_up():
                break
            theta = best.x * np.exp(size * rng.normal(size=len(best.x)))
            fit = problem.fit(np.clip(theta, lower, upper))
            if fit is not None:
                fits = [*fits, fit]
                returned += abs(fit.cost - best.cost) <= _SAME * best.cost
        fits = sorted(fits, key=_COST)
        if time_is_up() or fits[0].cost > best.cost * (1.0 - _HOP_GAIN):
            break
    return fits


def _candidates(
    problem: RestructuringProblem,
    guess: Array | None,
    n_starts: int,
    number: int,
    rng: np.random.Generator,
) -> Array:
    """Parameters to start from in a round of the search, shape (k, n_params)."""
    structure, box = problem.structure, problem.box
    affine = structure.map if isinstance(structure.map, AffineMap) else None
    # the second round begins elsewhere: far away, on a smoother response
    smoother = number == 1 and guess is None and structure.order > 0
    n_starts = min(n_starts, _N_CONTINUED) if smoother else n_starts * (1 + number)
    rows = [np.zeros((0, structure.n_params))]
    if affine is not None and structure.order == 0:  # a gain, linear in its parameters
        rows.append(np.zeros((1, structure.n_params)))
    elif guess is not None:
        rows += [guess[None], drawn_around(guess, max(n_starts - 1, 0), rng)]
    elif affine is not None and box is not None:
        rows.append(_similar_candidates(box, affine, structure.order, n_starts, rng))
    drawn = structure.draw(n_starts, rng)
    if drawn is None and structure.implicit is not None:
        drawn = _natural_candidates(problem, structure.implicit, n_starts, rng)
    if drawn is not None and guess is None:
        known = [] if structure.initial is None else [structure.initial[None]]
        rows += [*known, drawn]
    begun = structure.initial if guess is None else guess
    if begun is not None:
        rows.append(_off_flat_points(problem, begun, n_starts, rng))
    found = np.vstack(rows)
    if smoother:
        continued = continuation_candidates(structure, box, found, rng)
        found = np.vstack([found, continued])
    elif number == 2 and guess is None and structure.order > 0:
        more = continuation_candidates(structure, box, found, rng, thorough=True)
        found = np.vstack([found, more])
    return found


def _off_flat_points(
    problem: RestructuringProblem, theta: Array, count: int, rng: np.random.Generator
) -> Array:
    """Starts from `theta` whose parameters of no effect there are of any size.

    As q = 0 in a gain of 1 + q^2: no derivative leads away, and no factor. None where
    all have an effect.
    """
    with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
        G, J = problem.system.response_jacobian(theta, problem.omega)
        size = max(np.linalg.norm(G), np.linalg.norm(problem.response))
        effect = np.linalg.norm(J.reshape(-1, len(theta)), axis=0)
        flat = effect * np.maximum(np.abs(theta), 1.0) <= _FLAT * size
        if flat.any():
            shape = count, len(theta)
            anywhere = 10.0 ** rng.uniform(-_DECADES, _DECADES, shape)
            anywhere *= rng.choice([-1.0, 1.0], shape)
            return np.where(flat, anywhere, drawn_around(theta, count, rng))
    return np.zeros((0, len(theta)))


def _reduced_otherwise(
    problem: RestructuringProblem, fits: list[LeastSquaresResult], number: int
) -> Array | None:
    """Later starts of a form that can be any model of its order, (1, n_params).

    The first round begins at the balanced truncation of the black box, the second one
    at its singular perturbation, exact at zero frequency: what is left out is in
    equilibrium, ``0 = A21 x1 + A22 x2 + B2 u`` (in discrete time x2 for 0). The third
    one truncates what is balanced behind an integrator. None for other structures, and
    where no states are left out.
    """
    box, n = problem.box, problem.structure.order
    form = CanonicalForm.of(problem.system, fits[0].x) if number and fits else None
    if form is None or box is None:
        return None
    still = 0.0 if box.dt is None else np.eye(len(box.A))
    S = np.block([[box.A - still, box.B], [box.C, box.D]])
    B = box.B if number == 1 else np.asarray(np.linalg.solve(box.A - still, box.B))
    _, left, right = balancing_transformation(
        box.A, B.astype(float), box.C, discrete=box.dt is not None
    )
    if len(left) <= n:
        return None
    S = block_diag(left, np.eye(len(box.C))) @ S
    S = S @ block_diag(right, np.eye(box.B.shape[1]))
    fast = slice(n, len(left))
    if number == 1:
        S = S - S[:, fast] @ np.linalg.solve(S[fast, fast], S[fast])
    S = np.delete(np.delete(S, fast, 0), fast, 1)
    if box.dt is not None:
        S[:n, :n] += np.eye(n)
    S[n:, n:] = problem.structure.feedthrough_of(S[n:, n:])
    theta = form.parameters(S)
    return None if theta is None else theta[None]


def _natural_candidates(
    problem: RestructuringProblem,
    equations: ImplicitMap,
    n_starts: int,
    rng: np.random.Generator,
) -> Array:
    """Parameters of physical equations of which no size is known.

    Positive where no sign is; beside negative ones half of them of any sign.
    """
    omega, box = problem.omega, problem.box
    rate = mean_rate(omega if box is None else np.abs(np.linalg.eigvals(box.A)))
    # around the rate, up to a factor of e, the states of all equations take part
    near = np.abs(np.log(np.maximum(omega, 1e-300) / rate)) < 1.0
    # of several models the first one
    G = np.abs(problem.response[near if near.any() else slice(None)])
    gains = np.sqrt(np.mean(G**2, axis=0))[: problem.structure.n_outputs]
    sizes = equations.natural_sizes(rate, gains)
    drawn = sizes * np.exp(rng.normal(size=(n_starts, len(sizes))))
    sign, free = known_signs(problem.structure), np.ones(drawn.shape)
    if (sign < 0.0).any():
        free[1::2] = rng.choice([-1.0, 1.0], free[1::2].shape)
    return np.where(sign == 0.0, free, sign) * drawn


def _similar_candidates(
    box: Target,
    affine: AffineMap,
    order: int,
    n_starts: int,
    rng: np.random.Generator,
) -> Array:
    """Parameters of an affine structure from random similarities, shape (k, n_params).

    Where states are missing, modes fill the order that are faint, or that no input
    moves, or that no output shows. A sum of parts has a start of its own, by modes; no
    others are needed where the black box is one of its models.
    """
    core = _reduced(box, order)
    by_parts = []
    faint = [(_FAINT, _FAINT), (0.0, 1.0), (1.0, 0.0)]
    found = []
    for sizes in faint if len(core.A) < order else faint[:1]:
        full = _padded(core, order, rng, sizes)
        start = start_by_parts(full, affine.offset, affine.basis, rng)
        if start is not None:
            theta, distance = start
            by_parts.append(theta[None])
            if distance <= _EXACT_PARTS and len(box.A) <= order:
                break
        found.append(_random_similarities(full, affine, n_starts, rng))
    return np.vstack(by_parts + found)


def _random_similarities(
    box: Target, affine: AffineMap, n_starts: int, rng: np.random.Generator
) -> Array:
    """Parameters from random similarities of a black box of the structure's order.

    Two time scales: the geometric mean and the maximum of the pole sizes.
    """
    poles = np.linalg.eigvals(box.A).astype(complex)
    sizes = np.abs(poles)
    sizes = sizes[sizes > _SLOWEST * sizes.max(initial=0.0)]
    scales = [1.0]
    if box.dt is None and sizes.size:
        scales = [mean_rate(sizes), float(sizes.max())]
    offset, basis = affine.offset, affine.basis
    scaling = channel_scaling(model_response(box, frequency_grid(poles, box.dt)))
    if scaling is not None:  # rank one: factors of the outputs and of the inputs
        outputs, inputs = scaling[:, 0] / scaling[0, 0], scaling[0]
        ones = np.ones(len(box.A))
        left = np.concatenate([ones, outputs])[:, None]
        right = np.concatenate([ones, inputs])
        offset, basis = left * offset * right, left * basis * right
        B, C = box.B * inputs, outputs[:, None] * box.C
        box = Target(box.A, B, C, outputs[:, None] * box.D * inputs, box.dt)
    found = []
    for rate in scales:
        problem = scaled_problem(box, offset, basis, rate)
        found.append(similarity_starts(problem, n_starts, rng)[0])
    return np.vstack(found)


def _reduced(box: Target, order: int) -> Target:
    """The black box without states that do nothing, and with `order` at most."""
    _, left, right = balancing_transformation(
        box.A, box.B, box.C, discrete=box.dt is not None
    )
    if len(left) in (0, len(box.A)) and len(box.A) <= order:
        return box
    left, right = left[:order], right[:, :order]
    return Target(left @ box.A @ right, left @ box.B, box.C @ right, box.D, box.dt)


def _padded(
    box: Target, order: int, rng: np.random.Generator, faint: tuple[float, float]
) -> Target:
    """The black box with `order` states: modes fill what is missing.

    `faint` are the sizes of the inputs and outputs of these modes, which are fast. With
    one of them zero the transfer function does not change, and they decay as the others
    do: the coefficients of forms then differ least in size.
    """
    n, extra = len(box.A), order - len(box.A)
    if extra == 0:
        return box
    rates = growth(np.linalg.eigvals(box.A).astype(complex), box.dt)
    if 0.0 in faint:
        decay = -mean_rate(np.abs(rates)) * (_AMONG + np.arange(extra))
    else:
        fast = _FAST * float(np.abs(rates).max(initial=0.0)) or 1.0
        decay = -fast * (1.0 + np.arange(extra))
    A = np.zeros((order, order))
    A[:n, :n] = box.A
    A[n:, n:] = np.diag(np.exp(decay * box.dt) if box.dt else decay)
    size_B = np.abs(box.B).max(initial=1e-300)
    size_C = np.abs(box.C).max(initial=1e-300)
    B = faint[0] * size_B * rng.normal(size=(extra, box.B.shape[1]))
    C = faint[1] * size_C * rng.normal(size=(len(box.C), extra))
    return Target(A, np.vstack([box.B, B]), np.hstack([box.C, C]), box.D, box.dt)


def continuation_candidates(
    structure: GrayBoxStructure,
    box: Target | None,
    seeds: Array,
    rng: np.random.Generator,
    thorough: bool = False,
) -> Array:
    """Fits of the blurred response, carried to the response; see `continuation`.

    Seeds are given parameters, stable or not, and random ones of a natural size where
    bounds or ranges tell signs.

    A `thorough` call takes more seeds and smaller steps, and positive parameters where
    no sign is known, as physical ones are.
    """
    nothing = np.zeros((0, structure.n_params))
    if box is None or len(box.A) == 0:
        return nothing
    count = _N_CONTINUED if thorough else _N_QUICK
    sign = known_signs(structure)
    signed = sign != 0.0
    rows = [nothing if structure.initial is None else structure.initial[None]]
    equations = structure.implicit is not None
    physical = seeds[(seeds > 0).all(1)][:count] if equations else nothing
    if isinstance(structure.map, AffineMap) and (thorough or signed.any()):
        S, basis = structure.map.offset, structure.map.basis
        drawn = _natural_sizes(box, S, basis, structure.order, count, rng)
        physical = drawn * np.where(sign == 0, 1.0, sign)
        free = rng.choice([-1.0, 1.0], drawn.shape)
        rows.append(drawn * np.where(sign == 0, free, sign))
    if thorough or not (structure.is_affine and signed.any()):
        rows.append(seeds[~(seeds == 0).any(1)][:count])
    options: dict[str, Any] = {} if thorough else _QUICK
    starts, found = np.vstack(rows), [nothing]
    if len(starts):
        found.append(continued_fits(structure, box, starts, signed, **options)[0])
    if (thorough or equations) and len(physical) and not signed.all():
        every = np.ones_like(signed)
        found.append(continued_fits(structure, box, physical, every)[0])
    return np.vstack(found)


def known_signs(structure: GrayBoxStructure) -> Array:
    """Signs that bounds or ranges tell, (n_params,): -1 or 1; 0 where nothing does."""
    lower, upper, ranges = structure.lower, structure.upper, structure.ranges
    known = (lower >= 0) | (upper <= 0) | (ranges[0] * ranges[1] > 0)
    below = (upper <= 0) | ((ranges[0] < 0) & (lower < 0))
    return np.where(known, np.where(below, -1.0, 1.0), 0.0)


def _natural_starts(
    problem: RestructuringProblem, count: int, rng: np.random.Generator
) -> Array:
    """Random parameters of an affine structure of which the black box gives no start.

    Of the sizes that its poles and the gains of its inputs make natural. Of half of
    them those whose sign no bound tells are positive, as physical ones are.
    """
    structure, box, n = problem.structure, problem.box, problem.structure.order
    if not isinstance(structure.map, AffineMap) or box is None:
        return np.zeros((0, structure.n_params))
    gains = np.sqrt(np.mean(np.abs(problem.response) ** 2, axis=0)).max(0)
    unit = np.append(np.ones(n), 1.0 / np.where(gains > 0, gains, 1.0))
    S, basis = structure.map.offset * unit, structure.map.basis * unit
    drawn = _natural_sizes(box, S, basis, n, count, rng)
    free = rng.choice([-1.0, 1.0], drawn.shape)
    free[::2] = 1.0
    sign = known_signs(structure)
    return drawn * np.where(sign == 0.0, free, sign)


def _natural_sizes(
    box: Target,
    offset: Array,
    basis: Array,
    order: int,
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Random sizes of parameters that bring all entries of the structure near one."""
    rate = mean_rate(np.abs(np.linalg.eigvals(box.A)))
    full = _padded(_reduced(box, order), order, rng, (_FAINT, _FAINT))
    problem = scaled_problem(full, offset, basis, rate)
    size = 1.0 / np.abs(problem.basis).max((1, 2))
    return np.asarray(size * np.exp(rng.normal(size=(count, len(size)))))
