"""The steps of a restructuring: candidates, minimisation, warnings."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state

from .exceptions import RankWarning
from .numerics.certificates import MinimaxResult
from .numerics.h2 import minimise_h2
from .numerics.leastsquares import LeastSquaresResult
from .numerics.restructure import SOLVERS, minimise_hinf, promising
from .numerics.similarity import minimise_bilinear
from .numerics.starts import (
    continuation_candidates,
    perturbed_candidates,
    rms,
    search_fits,
    similarity_candidates,
)
from .restructuring_problem import RestructuringProblem
from .structure_forms import ImplicitSystem

Array = NDArray[np.float64]

_NORMS = ("hinf", "h2", "similarity")
_POOR_FIT = 2e-2  # relative least-squares error that is warned about
_N_FITS = 3  # least-squares fits from the best candidates
_LEAST_MARGIN = 1e-6
_N_SEEDS = 6  # starts at each time scale of which continuation makes use
_AGREE = 1e-3  # relative difference of the errors of fits in one basin
_PROVEN = 1e-8  # an error that much above its lower bound is optimal
_ROUNDING = 1e-11  # an error of that size, relative to the black box, is exact


def check_options(restructurer: Any) -> None:
    """A ValueError for options of a GrayBoxRestructurer that are not valid."""
    for name, allowed in (("norm", _NORMS), ("solver", tuple(SOLVERS))):
        value = getattr(restructurer, name)
        if value not in allowed:
            raise ValueError(f"`{name}` must be one of {allowed}. Got {value!r}.")
    init = restructurer.init
    if isinstance(init, str) and init != "similarity":
        raise ValueError(
            f"`init` must be 'similarity' or a vector of parameters. Got {init!r}."
        )
    for name, least in (("n_starts", 1), ("max_iter", 0)):
        value = getattr(restructurer, name)
        if not isinstance(value, Integral) or value < least:
            raise ValueError(
                f"`{name}` must be an integer of at least {least}. Got {value!r}."
            )
    tol = restructurer.tol
    if not isinstance(tol, Real) or not 0.0 <= float(tol) < 1.0:
        raise ValueError(
            f"`tol` must be a relative decrease, at least 0 and below 1. Got {tol!r}."
        )


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


def minimise(
    problem: RestructuringProblem,
    fits: list[LeastSquaresResult],
    *,
    norm: str,
    solver: str,
    max_iter: int,
    tol: float,
) -> tuple[Array, MinimaxResult, float]:
    """Minimise the norm of the error from least-squares fits.

    Returns
    -------
    theta : ndarray of shape (n_params,)
    result : MinimaxResult
    floor : float
        Highest peak that no parameter changes.
    """
    options: dict[str, Any] = {
        "max_iter": max_iter,
        "tol": tol,
        "negligible": _ROUNDING * problem.reference,
    }
    system, margin = problem.system, problem.margin
    if norm == "h2":
        runs = [minimise_h2(system, fit, margin, **options) for fit in promising(fits)]
        return *min(runs, key=lambda run: run[1].peaks.top), 0.0
    if norm == "similarity":
        found = minimise_bilinear(problem.structure, problem.box, fits[0].x, max_iter)
        return *found, 0.0
    theta, result, floor = minimise_hinf(
        system, fits, margin, SOLVERS[solver], **options
    )
    if result.peaks.top <= problem.lower_bound * (1.0 + _PROVEN):
        # no model is nearer; where the error is equally high everywhere, its peaks
        # could not tell
        result = replace(result, stationarity=0.0, converged=True)
    return theta, result, floor


def relative_error(fit: LeastSquaresResult, problem: RestructuringProblem) -> float:
    """Root-mean-square error of a fit over frequency, relative to the black box."""
    W = problem.system.weight_response(problem.omega)[0]
    return float(np.sqrt(fit.cost)) / rms(W @ problem.response)


def warn_about(
    restructurer: Any, problem: RestructuringProblem, result: MinimaxResult
) -> None:
    """Warnings about a fitted GrayBoxRestructurer."""
    if not result.converged:
        spent = restructurer.n_iter_ >= restructurer.max_iter
        warnings.warn(
            f"the search {'ended at' if spent else 'stalled before'} "
            f"`max_iter`={restructurer.max_iter} steps, with `stationarity_` "
            f"{restructurer.stationarity_:.1g} (0 at an optimum): a lower norm may be "
            "near. The best point is kept. "
            + ("Raise `max_iter`" if spent else "Try another `random_state`")
            + ", or take a structure of fewer parameters.",
            ConvergenceWarning,
            stacklevel=4,
        )
    error = restructurer.fit_error_
    floor = restructurer.structural_floor_ / max(problem.reference, 1e-300)
    if error - floor > _POOR_FIT:
        costs = restructurer.starts_["relative_error"].to_numpy()
        agreeing = int((costs <= costs.min() * (1.0 + _AGREE)).sum())
        warnings.warn(
            f"the structure comes no nearer than {100 * error:.2g} % (root mean square "
            f"over frequency) to the black box; {agreeing} of {len(costs)} fits from "
            "different starts end there. "
            + (
                "It probably cannot represent the model any better."
                if agreeing > 1
                else "Either it cannot represent the model, or the search ended in a "
                "wrong basin."
            )
            + " Give `init`, or raise `n_starts`, to search elsewhere.",
            ConvergenceWarning,
            stacklevel=4,
        )
    found = restructurer.identifiability_
    if found.rank < problem.structure.n_params:
        warnings.warn(str(found), RankWarning, stacklevel=4)
