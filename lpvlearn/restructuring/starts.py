"""Starting points of the restructuring: candidates, ranked by frequency response."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_random_state

from ..structures.mechanical import ImplicitSystem
from ..systems.balancing import balancing_transformation
from .continuation import continued_fits
from .error_system import ErrorSystem
from .least_squares import (
    LeastSquaresResult,
    channel_scaling,
    fit_frequency_response,
    frequency_grid,
)
from .limits import growth
from .problem import RestructuringProblem
from .similarity import scaled_problem, similarity_starts
from .transfer import Target, model_derivatives

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

GOOD_FIT = 3e-3  # relative least-squares error that needs no further starts

_FAR_FIT = 0.1  # a worse one is searched on for, even where starts agree on it

_HOP_FIT = 0.03  # error of a fit whose neighbouring basins are looked at

_HOPS = (0.1, 0.3, 1.0) * 4  # sizes of the hops, of logarithms of the parameters

_HOP_RETURNS = 5

_HOP_ROUNDS = 4

_SAME = 1e-4  # relative difference of the costs of fits in one basin

_ROUNDS = 3

_FAINT = 0.03  # of modes that only fill the order, relative to the black box

_N_SMOOTH_SEEDS = 6  # of the continuation

_N_QUICK_SEEDS = 3

_QUICK = {"shifts": (1.0, 0.2, 0.05, 0.0), "n_points": 18, "max_iter": 16}

_SPREAD = 0.3  # standard deviation of log-parameters around a given first guess


def reduced(target: Target, order: int) -> Target:
    """The black box without states that do nothing, and with `order` at most."""
    _, left, right = balancing_transformation(
        target.A, target.B, target.C, discrete=target.dt is not None
    )
    if len(left) in (0, len(target.A)) and len(target.A) <= order:
        return target
    left, right = left[:order], right[:, :order]
    A, B, C = left @ target.A @ right, left @ target.B, target.C @ right
    return Target(A, B, C, target.D, target.dt)


def same_order(
    target: Target,
    order: int,
    rng: np.random.Generator,
    faint: tuple[float, float] = (_FAINT, _FAINT),
) -> Target:
    """The black box with `order` states: truncated, or padded with faint fast modes.

    `faint` are the sizes of the inputs and outputs of these modes; with one of them
    zero the transfer function does not change.
    """
    target = reduced(target, order)
    n = len(target.A)
    if n == order:
        return target
    extra = order - n
    rates = growth(np.linalg.eigvals(target.A).astype(complex), target.dt)
    fast = 3.0 * float(np.abs(rates).max(initial=0.0)) or 1.0
    decay = -fast * (1.0 + np.arange(extra))
    A = np.zeros((order, order))
    A[:n, :n] = target.A
    A[n:, n:] = np.diag(np.exp(decay * target.dt) if target.dt else decay)
    size_B = np.abs(target.B).max(initial=1e-300)
    size_C = np.abs(target.C).max(initial=1e-300)
    faint_B = faint[0] * size_B * rng.normal(size=(extra, target.B.shape[1]))
    faint_C = faint[1] * size_C * rng.normal(size=(target.C.shape[0], extra))
    return Target(
        A,
        np.vstack([target.B, faint_B]),
        np.hstack([target.C, faint_C]),
        target.D,
        target.dt,
    )


def similarity_candidates(
    target: Target,
    offset: Array,
    basis: Array,
    order: int,
    n_starts: int,
    rng: np.random.Generator,
) -> Array:
    """Parameters of an affine structure from random similarities, shape (k, n_params).

    Two time scales: the geometric mean and the maximum of the pole sizes.
    """
    faint = [(_FAINT, _FAINT)]
    if (
        len(reduced(target, order).A) < order
    ):  # also modes that no input moves, or no output shows
        faint += [(0.0, 1.0), (1.0, 0.0)]
    found = []
    for sizes in faint:
        box = same_order(target, order, rng, sizes)
        found.append(_similar(box, offset, basis, n_starts, rng))
    return np.vstack(found)


def _similar(
    box: Target, offset: Array, basis: Array, n_starts: int, rng: np.random.Generator
) -> Array:
    """Parameters from random similarities of a black box of the structure's order."""
    poles = np.abs(np.linalg.eigvals(box.A))
    poles = poles[poles > 1e-9 * poles.max(initial=0.0)]
    if box.dt is not None or poles.size == 0:
        scales = [1.0]
    else:
        scales = [float(np.exp(np.log(poles).mean())), float(poles.max())]
    grid = frequency_grid(np.linalg.eigvals(box.A).astype(complex), box.dt)
    balance = channel_scaling(model_derivatives(box, grid)[0])
    if balance is not None:  # rank one: factors of the outputs and of the inputs
        outputs, inputs = balance[:, 0] / balance[0, 0], balance[0]
        box, offset, basis = scaled_channels(box, offset, basis, outputs, inputs)
    found = []
    for rate in scales:
        problem = scaled_problem(box.A, box.B, box.C, box.D, offset, basis, rate)
        found.append(similarity_starts(problem, n_starts, rng)[0])
    return np.vstack(found)


def continuation_candidates(
    structure: Any,
    box: Target | None,
    seeds: Array,
    rng: np.random.Generator,
    thorough: bool = False,
) -> Array:
    """Fits of the blurred response, carried to the response; see `continuation`.

    Seeds are given parameters, stable or not, and random ones of a natural size where
    bounds or ranges tell signs. Continuous time only.

    Parameters
    ----------
    structure : GrayBoxStructure
    box : Target or None
    seeds : ndarray of shape (k, n_params)
    thorough : bool, default=False
        More seeds and smaller steps, and positive parameters where no sign is known,
        as physical ones are.
    """
    if box is None or box.dt is not None or len(box.A) == 0:
        return np.zeros((0, structure.n_params))
    count = _N_SMOOTH_SEEDS if thorough else _N_QUICK_SEEDS
    lower, upper = structure.lower, structure.upper
    ranges = structure.ranges
    signed = (lower >= 0) | (upper <= 0) | (ranges[0] * ranges[1] > 0)
    rows = [] if structure.initial is None else [structure.initial[None]]
    physical = np.zeros((0, structure.n_params))
    equations = getattr(structure, "implicit", None) is not None
    if equations and not signed.all():
        physical = seeds[(seeds > 0).all(1)][:count]
    if structure.is_affine and (thorough or signed.any()):
        sign = np.where(signed, np.where(upper <= 0, -1.0, 1.0), 0.0)
        drawn = _natural_sizes(structure, box, count, rng)
        physical = drawn * np.where(sign == 0, 1.0, sign)
        free = rng.choice([-1.0, 1.0], drawn.shape)
        rows.append(drawn * np.where(sign == 0, free, sign))
    if thorough or not (structure.is_affine and signed.any()):
        rows.append(seeds[~(seeds == 0).any(1)][:count])
    options: dict[str, Any] = {} if thorough else _QUICK
    found = [np.zeros((0, structure.n_params))]
    starts = np.vstack(rows) if rows else found[0]
    if len(starts):
        found.append(continued_fits(structure, box, starts, signed, **options)[0])
    if (thorough or equations) and len(physical) and not signed.all():
        every = np.ones_like(signed)
        found.append(continued_fits(structure, box, physical, every)[0])
    return np.vstack(found)


def _natural_sizes(
    structure: Any, box: Target, count: int, rng: np.random.Generator
) -> Array:
    """Random sizes of parameters that bring all entries of the structure near one."""
    poles = np.abs(np.linalg.eigvals(box.A))
    rate = float(np.exp(np.log(poles[poles > 0]).mean())) if poles.any() else 1.0
    full = same_order(box, structure.order, rng)
    problem = scaled_problem(
        full.A, full.B, full.C, full.D, structure.offset, structure.basis, rate
    )
    size = 1.0 / np.abs(problem.basis).max((1, 2))
    return np.asarray(size * np.exp(rng.normal(size=(count, len(size)))))


def scaled_channels(
    box: Target, offset: Array, basis: Array, outputs: Array, inputs: Array
) -> tuple[Target, Array, Array]:
    """Black box and structure with outputs and inputs in other units."""
    n = len(box.A)
    left = np.concatenate([np.ones(n), outputs])[:, None]
    right = np.concatenate([np.ones(n), inputs])
    scaled = Target(
        box.A,
        box.B * inputs,
        outputs[:, None] * box.C,
        outputs[:, None] * box.D * inputs,
        box.dt,
    )
    return scaled, left * offset * right, left * basis * right


def perturbed_candidates(
    theta: Array, n_starts: int, rng: np.random.Generator
) -> Array:
    """A given first guess, and random ones around it that keep the signs."""
    factors = np.exp(_SPREAD * rng.normal(size=(max(n_starts - 1, 0), len(theta))))
    return np.vstack([theta, theta * factors])


def distinct(thetas: Array, tol: float = 1e-6) -> Array:
    """Indices of rows that differ from all rows before them by more than `tol`."""
    kept: list[int] = []
    for i, theta in enumerate(thetas):
        size = np.linalg.norm(theta)
        if all(np.linalg.norm(theta - thetas[j]) > tol * size for j in kept):
            kept.append(i)
    return np.array(kept, dtype=int)


def best_fits(
    system: ErrorSystem,
    candidates: Array,
    omega: Array,
    G0: Complex,
    *,
    admissible: Callable[[Array], bool],
    n_fits: int,
) -> list[LeastSquaresResult]:
    """Least-squares fits from the best candidates, by ascending cost.

    The candidates are ranked by the error of their frequency response, not by their
    distance to the structure, and the best `n_fits` distinct ones are fitted, until
    one is good.
    """
    usable = [theta for theta in candidates if admissible(theta)]
    if not usable:
        return []
    thetas = np.array(usable)
    W = system.weight_response(omega)[0]
    balance = channel_scaling(W @ G0)
    scale = 1.0 if balance is None else balance
    errors = np.array(
        [np.linalg.norm(scale * (W @ (system.response(t, omega) - G0))) for t in thetas]
    )
    thetas = thetas[np.argsort(errors, kind="stable")]
    thetas = thetas[distinct(thetas)]
    good = GOOD_FIT * rms(W @ G0)
    fits = []
    for theta in thetas[:n_fits]:
        if balance is not None:  # all channels alike first, then as they are
            first = fit_frequency_response(
                system, theta, omega, G0, admissible=admissible, scaling=balance
            )
            theta = theta if first is None else first.x
        fit = fit_frequency_response(system, theta, omega, G0, admissible=admissible)
        fits.append(fit)
        if fit is not None and np.sqrt(fit.cost) <= good:
            break
    return sorted((fit for fit in fits if fit is not None), key=lambda fit: fit.cost)


def search_fits(
    system: ErrorSystem,
    candidates: Callable[[int], Array],
    omega: Array,
    G0: Complex,
    *,
    admissible: Callable[[Array], bool],
    n_fits: int,
    rng: np.random.Generator,
) -> list[LeastSquaresResult]:
    """Rounds of candidates and fits, until one is good; by ascending cost.

    Parameters
    ----------
    candidates : callable
        Round number to parameters of shape (k, n_params).
    n_fits : int
        Least-squares fits in a round.
    rng : Generator
        For the hops to neighbouring basins, where no fit is near.
    """
    size = rms(system.weight_response(omega)[0] @ G0)
    fits: list[LeastSquaresResult] = []
    for number in range(_ROUNDS):
        found = candidates(number)
        if len(found) == 0 and number:
            break
        fits += best_fits(
            system, found, omega, G0, admissible=admissible, n_fits=n_fits
        )
        fits.sort(key=lambda fit: fit.cost)
        if fits and np.sqrt(fits[0].cost) <= GOOD_FIT * size:
            break
        # the structure comes no nearer: different starts end at the same best cost
        agreeing = sum(fit.cost <= fits[0].cost * (1 + _SAME) for fit in fits)
        near = bool(fits) and np.sqrt(fits[0].cost) <= _FAR_FIT * size
        if near and agreeing >= (2 if number else n_fits):
            break
    if fits and np.sqrt(fits[0].cost) > _HOP_FIT * size:
        fits = hopped_fits(system, fits, omega, G0, admissible, rng)
    return fits


def hopped_fits(
    system: ErrorSystem,
    fits: list[LeastSquaresResult],
    omega: Array,
    G0: Complex,
    admissible: Callable[[Array], bool],
    rng: np.random.Generator,
) -> list[LeastSquaresResult]:
    """Fits from perturbations of the best one, as long as they find a better basin.

    Far from the black box the least-squares error has many minima beside each other.
    """
    lower, upper = system.structure.lower, system.structure.upper
    for _ in range(_HOP_ROUNDS):
        best, returned = fits[0], 0
        for size in _HOPS:
            if returned == _HOP_RETURNS:  # a wide basin
                break
            theta = best.x * np.exp(size * rng.normal(size=len(best.x)))
            theta = np.clip(theta, lower, upper)
            if not admissible(theta):
                continue
            fit = fit_frequency_response(
                system, theta, omega, G0, admissible=admissible
            )
            if fit is not None:
                fits = [*fits, fit]
                returned += abs(fit.cost - best.cost) <= _SAME * best.cost
        fits = sorted(fits, key=lambda fit: fit.cost)
        if fits[0].cost > best.cost * (1.0 - 1e-3):
            break
    return fits


def rms(G: Complex) -> float:
    """Root mean square over frequency of the Frobenius norm, not zero."""
    mean = np.mean(np.sum(np.abs(G) ** 2, axis=(1, 2)))
    return max(float(np.sqrt(mean)), 1e-300)


_N_FITS = 3  # least-squares fits from the best candidates

_LEAST_MARGIN = 1e-6

_N_SEEDS = 6  # starts at each time scale of which continuation makes use


def candidates(
    problem: RestructuringProblem,
    init: str | ArrayLike,
    n_starts: int,
    given: list[Array],
    number: int,
    rng: np.random.Generator,
) -> Array:
    """Parameters to start from in a round of the search, shape (k, n_params)."""
    structure = problem.structure
    # the second round begins elsewhere: far away, on a smoother response
    smoother = number == 1 and isinstance(init, str) and structure.order > 0
    n_starts = min(n_starts, _N_SEEDS) if smoother else n_starts * (1 + number)
    rows = [np.zeros((0, structure.n_params))]
    if number == 0 and given:
        rows.append(np.array(given))
    if structure.order == 0 and structure.is_affine:  # a gain, linear in them
        rows.append(np.zeros((1, structure.n_params)))
    elif not isinstance(init, str):
        guess = structure.check_params(init)
        rows.append(perturbed_candidates(guess, n_starts, rng))
    elif structure.is_affine and problem.box is not None:
        assert structure.offset is not None and structure.basis is not None
        rows.append(
            similarity_candidates(
                problem.box,
                structure.offset,
                structure.basis,
                structure.order,
                n_starts,
                rng,
            )
        )
    drawn = structure.draw(n_starts, rng)
    if drawn is None and structure.implicit is not None:
        drawn = natural_candidates(problem, structure.implicit, n_starts, rng)
    if drawn is not None and isinstance(init, str):
        known = [] if structure.initial is None else [structure.initial[None]]
        rows += [*known, drawn]
    found = np.vstack(rows)
    if smoother:
        continued = continuation_candidates(structure, problem.box, found, rng)
        found = continued if len(continued) else found
    elif number == 2 and isinstance(init, str) and structure.order > 0:
        more = continuation_candidates(structure, problem.box, found, rng, True)
        found = np.vstack([found, more])
    return np.clip(found, structure.lower, structure.upper)


def natural_candidates(
    problem: RestructuringProblem,
    equations: ImplicitSystem,
    n_starts: int,
    rng: np.random.Generator,
) -> Array:
    """Positive parameters of physical equations of which no size is known."""
    omega, box = problem.omega, problem.box
    times = omega if box is None else np.abs(np.linalg.eigvals(box.A))
    times = times[times > 0]
    rate = float(np.exp(np.log(times).mean())) if times.size else 1.0
    near = np.abs(np.log(np.maximum(omega, 1e-300) / rate)) < 1.0
    # of several models the first one
    G = np.abs(problem.response[near if near.any() else slice(None)])
    gains = np.sqrt(np.mean(G**2, axis=0))[: problem.structure.n_outputs].max(1)
    sizes = equations.natural_sizes(rate, gains)
    return np.asarray(sizes * np.exp(rng.normal(size=(n_starts, len(sizes)))))


def search(
    restructurer: Any, problem: RestructuringProblem, given: list[Array]
) -> tuple[RestructuringProblem, list[LeastSquaresResult]]:
    """Least-squares fits, by ascending cost, and the problem that they solve.

    Where no model of the structure decays as fast as the black box lets expect, its
    stability margin is given up.

    Raises
    ------
    ValueError
        If no stable starting point is found.
    """
    seed = check_random_state(restructurer.random_state).randint(2**31)
    for share in (1.0, _LEAST_MARGIN):
        problem = replace(problem, margin=share * problem.margin)
        rng = np.random.default_rng(seed)
        fits = search_fits(
            problem.system,
            partial(
                candidates,
                problem,
                restructurer.init,
                restructurer.n_starts,
                given,
                rng=rng,
            ),
            problem.omega,
            problem.response,
            admissible=problem.stable,
            n_fits=_N_FITS + len(given),
            rng=rng,
        )
        if fits:
            return problem, fits
    raise ValueError(
        "no stable starting point was found for `structure`. Give `init`, a vector of "
        "parameters of a stable model, or raise `n_starts` (got "
        f"{restructurer.n_starts})."
    )


def relative_error(fit: LeastSquaresResult, problem: RestructuringProblem) -> float:
    """Root-mean-square error of a fit over frequency, relative to the black box."""
    W = problem.system.weight_response(problem.omega)[0]
    return float(np.sqrt(fit.cost)) / rms(W @ problem.response)
