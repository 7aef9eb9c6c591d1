"""A record with missing outputs, completed by its own model, in rounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..data.experiments import Experiment
from ..data.preparation import has_gaps
from ..exceptions import DivergenceError
from .evidence.statistics import Evidence
from .fits.delay import Delay
from .fits.local_fit import LocalFit
from .fits.one_fit import TooFewSamples
from .fits.options import Choices
from .fits.simulator import Simulator
from .missing_outputs import (
    by_prediction,
    by_simulation,
    first_guess,
    further,
    is_sparse,
    movement,
    runs_to_complete,
    warn_of_few,
)
from .orders.selection import MAX_ORDER
from .simulation_error.criterion import EXACT, n_parameters
from .simulation_error.simulation_fit import simulation_errors
from .telling import Telling

# Missing outputs are estimated in so many rounds at most, until they move by less than
# this many standard deviations of an innovation.
_MOST_ROUNDS, _SETTLED = 20, 0.01
_ASTRAY = 4  # rounds that move them more than one before, after which no more is done
_FREE_ROUNDS = 3  # after so many no other order is looked for
_BEYOND = 2  # orders tried beyond the best one, where few outputs are there

_AGAIN = 3  # rounds in which a model that is known estimates them

# The model of experiments, by what is known of ones like them
Learn = Callable[
    [list[Experiment], Choices, Delay, LocalFit | None], tuple[LocalFit, Simulator]
]


def completed(
    experiments: list[Experiment],
    choices: Choices,
    telling: Telling,
    delay_of: Callable[[list[Experiment], Choices], Delay],
    learn: Learn,
) -> tuple[list[Experiment], Choices]:
    """Experiments with missing outputs as the model of the completed ones expects.

    Cut where inputs are missing, or time has a hole. And the choices that remain: where
    little is there, the order is chosen by that, from below.
    """
    runs = runs_to_complete(experiments, at_rest=not choices.initial_states)
    if not any(map(has_gaps, runs)):
        return runs, choices
    warn_of_few(runs, telling)
    guess = first_guess(runs)
    delay = delay_of(guess, choices)
    sparse = is_sparse(runs)
    if sparse and choices.method == "auto":
        choices = choices._replace(method="po-moesp")
    if not sparse or choices.order is not None:
        return _settled(runs, guess, choices, delay, learn)[0], choices
    best, least, beyond = (guess, choices), np.inf, 0
    for order in choices.orders or range(1, MAX_ORDER + 1):
        some = choices._replace(order=order, orders=())
        try:
            found, fitted = _settled(runs, guess, some, delay, learn)
        except TooFewSamples:
            break
        cost, beyond = _cost_of_known(fitted.evidence), beyond + 1
        if cost < least:
            best, least, beyond = (found, some), cost, 0
        elif beyond == _BEYOND:
            break
    return best


def _cost_of_known(evidence: Evidence) -> float:
    """Schwarz's criterion of the simulation errors of outputs that are there."""
    model, records, free = evidence.model, evidence.records, evidence.free
    if not np.isfinite(model.loss):
        return np.inf
    known = np.vstack([record.known for record in records])
    squares = np.where(known, np.vstack(simulation_errors(model, records)), 0.0) ** 2
    n_known = known.sum(axis=0)
    power = np.where(known, np.hstack([r.y for r in records]).T, 0.0) ** 2
    floor = np.maximum(EXACT * power.sum(axis=0), np.finfo(float).tiny)
    left = np.log(np.maximum(squares.sum(axis=0), floor) / n_known)
    n_unknown = n_parameters(len(model.A), records, free)
    return float(n_known @ left + np.log(n_known.sum()) * n_unknown)


def completed_by(
    model: Simulator, experiments: Sequence[Experiment], *, at_rest: bool
) -> list[Experiment]:
    """Experiments with missing outputs as a model expects them that is known."""
    runs = runs_to_complete(experiments, at_rest=at_rest)
    found = first_guess(runs)
    for _ in range(_AGAIN):
        found = _expected(model, runs, found, at_rest=at_rest)
    return found


def _settled(
    runs: Sequence[Experiment],
    found: list[Experiment],
    choices: Choices,
    delay: Delay,
    learn: Learn,
) -> tuple[list[Experiment], LocalFit]:
    """Experiments, completed as they were `found`, as their own model expects them."""
    at_rest = not choices.initial_states
    chosen: tuple[int, str] | None = None
    known: LocalFit | None = None
    least, astray, last = np.inf, 0, [found]
    for k in range(_MOST_ROUNDS):
        fitted, model = learn(found, choices, delay, known)
        before, found = found, _expected(model, runs, found, at_rest=at_rest)
        moved = movement(runs, before, found, model.predictor().covariance)
        astray = 0 if known is None or moved < least else astray + 1
        if not moved > _SETTLED or astray == _ASTRAY:
            break
        least = min(least, moved)
        last = [*last, found] if known is not None else [found]
        if len(last) == 3:
            found = further(runs, last)
            last = [found]
        if chosen == (fitted.selection.order, fitted.method) or k >= _FREE_ROUNDS:
            known = fitted
        chosen = fitted.selection.order, fitted.method
    return found, fitted


def _expected(
    model: Simulator,
    runs: Sequence[Experiment],
    before: Sequence[Experiment],
    *,
    at_rest: bool,
) -> list[Experiment]:
    """Runs of known inputs with the outputs that a model expects of missing ones.

    Their initial states, and trends, are those of runs that were completed `before`: of
    the known outputs alone they might be anything.
    """
    predictor = model.predictor()
    u0, y0 = model.resting_point()
    own = [
        (model.beginning(e), y0)
        if at_rest
        else model.own_part(e, predictor, of_fit=True)
        for e in before
    ]
    found = list(zip(runs, own, strict=True))
    try:
        if predictor.gain is not None:
            expected = [
                by_prediction(e, predictor, e.inputs - u0, x0, level)
                for e, (x0, level) in found
            ]
        else:
            simulated = [
                level + model.lti.simulate(e.inputs - u0, initial_state=x0)
                for e, (x0, level) in found
            ]
            expected = by_simulation(runs, simulated)
        if all(np.isfinite(e.measured).all() for e in expected):
            return expected
    except DivergenceError:
        pass
    raise ValueError(
        "missing='estimate' needs a model that can be simulated. That of order "
        f"{model.lti.order} grows beyond numbers: use missing='split', another "
        "`order`, or stability='enforce'."
    )
