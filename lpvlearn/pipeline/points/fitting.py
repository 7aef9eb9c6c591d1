"""What a local estimator is asked, and what it tells.

Experiments that have been read are given to a clone of it, as they are or as a table.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import ROLES, Experiment, as_table
from ...data.preparation import DETRENDS
from ...exceptions import Told, collected, retold
from ...models.statespace import ModelPair, StateSpace
from ...subspace.estimator import SubspaceLTI
from ...subspace.evidence.constants import CERTAIN
from ...subspace.fits.integrating import integrating_flags
from ...systems.modes import lasting

Array = NDArray[np.float64]

# What fits experiments as methods do that take a table.
_OF_READ = {"fit": "fit_experiments", "fit_each": "fit_each_experiment"}

# States that a disturbance may have beside those of a structure: two resonances, or a
# resonance and two drifts.
_OF_LOADS = 4

# Decrease of the criterion from which they are taken: below it they were not better.
_LIKELIER = 10.0


def is_left(local: Any, name: str) -> bool:
    """Whether an estimator is to choose an option itself ("auto")."""
    value = local.get_params(deep=False).get(name)
    return isinstance(value, str) and value == "auto"


def integrates(local: Any) -> bool:
    """Whether an estimator identifies the rates of outputs, and integrates them."""
    return getattr(local, "integrating", None) is not None


def estimates_outputs(local: Any) -> bool:
    """Whether a local estimator takes outputs of which some are missing."""
    return getattr(local, "missing", None) == "estimate"


def labels_of(experiments: Sequence[Experiment]) -> list[Hashable]:
    return list(dict.fromkeys(e.label for e in experiments))


def fit_local(
    local: Any, experiments: Sequence[Experiment], sampling_time: float
) -> Any:
    """A clone of the local estimator, fitted on the experiments as one table."""
    fitted = _fit_table(local, experiments, sampling_time, "fit")
    if not isinstance(getattr(fitted, "lti_", None), StateSpace):
        raise ValueError(
            "`local` must be an estimator that identifies a StateSpace model, its "
            f"attribute `lti_`, as SubspaceLTI does. Got {type(local).__name__}."
        )
    return fitted


def fit_alike(
    local: Any, realisations: Sequence[Sequence[Experiment]], sampling_time: float
) -> list[Any]:
    """Clones of the local estimator for every realisation of one system.

    The first realisation chooses order, horizon and method, the others follow it. One
    with gaps is several experiments.
    """
    alike = hasattr(local, "fit_each") and not estimates_outputs(local)
    if alike and all(len(runs) == 1 for runs in realisations):
        whole = [run for runs in realisations for run in runs]
        return _fit_table(local, whole, sampling_time, "fit_each")
    first = fit_local(local, realisations[0], sampling_time)
    chosen = clone(local)
    for name in ("order", "horizon", "method", "input_delay"):
        if name in chosen.get_params() and hasattr(first, name + "_"):
            chosen.set_params(**{name: getattr(first, name + "_")})
    others = [fit_local(chosen, runs, sampling_time) for runs in realisations[1:]]
    return [first, *others]


def fit_at_most(
    local: Any, experiments: Sequence[Experiment], sampling_time: float
) -> Any:
    """The same with more states in a loop, where these are those of a disturbance.

    And with fewer ones where some of them alternate, and are not asked for: no system
    in continuous time has a pole on the negative real axis, and a state more than the
    samples show follows their noise there.
    """
    with retold() as told:
        fitted = fit_local(local, experiments, sampling_time)
        if from_closed_loop(fitted):
            likelier = _fit_with_loads(local, fitted, experiments, sampling_time)
            if likelier is not None:
                fitted, told[:] = likelier
        n_alternating = len(alternating(fitted.lti_))
        if not n_alternating:
            return fitted
        highest = fitted.order_ - len(integrating(fitted))
        fewer = range(max(1, highest - n_alternating), highest + 1)
        with collected() as other, suppress(ValueError):
            again = clone(local).set_params(order=fewer)
            again = fit_local(again, experiments, sampling_time)
            if again.order_ < fitted.order_ and not len(alternating(again.lti_)):
                told[:] = other
                return again
        return fitted


def fit_alike_at_most(
    local: Any, realisations: Sequence[Sequence[Experiment]], sampling_time: float
) -> list[Any]:
    """As `fit_alike`, with the states of a disturbance that the first one shows."""
    with retold() as told:
        fitted = fit_alike(local, realisations, sampling_time)
        if not from_closed_loop(fitted[0]):
            return fitted
        # one tells of all: beyond chance
        likelier = _fit_with_loads(
            local, fitted[0], realisations[0], sampling_time, asked=CERTAIN
        )
        if likelier is None:
            return fitted
        told.clear()
        order = likelier[0].order_ - len(integrating(likelier[0]))
        more = clone(local).set_params(order=order)
        return fit_alike(more, realisations, sampling_time)


def _fit_with_loads(
    local: Any,
    fitted: Any,
    experiments: Sequence[Experiment],
    sampling_time: float,
    asked: float = _LIKELIER,
) -> tuple[Any, list[Told]] | None:
    """A likelier model of more states than the fitted one, and what is told of it.

    In a loop plant and noise share their states, and what inputs know of a disturbance
    is one more: with as many as the plant has alone, the likeliest ones are those of
    the disturbance as well. None where more are not worth what they cost, by as much
    as is `asked`, or grow.
    """
    order = local.get_params(deep=False)["order"]
    more = clone(local).set_params(order=range(order, order + _OF_LOADS + 1))
    with collected() as told, suppress(ValueError):
        other = fit_local(more, experiments, sampling_time)
        known, its = (criterion(getattr(f, "rates_", f)) for f in (fitted, other))
        grows = fitted.lti_.is_stable and not other.lti_.is_stable
        if other.order_ > fitted.order_ and its < known - asked and not grows:
            return other, told
    return None


def _fit_table(
    local: Any, experiments: Sequence[Experiment], sampling_time: float, method: str
) -> Any:
    """What a clone's method of fitting returns for the experiments as one table."""
    estimator = clone(local)
    known = estimator.get_params(deep=False)
    # an estimator that fits in a way of its own is given a table
    own_way = getattr(type(local), method) is not getattr(SubspaceLTI, method)
    if not (own_way or integrates(local)):
        estimator.set_params(sampling_time=sampling_time)
        read = [_with_step(e, sampling_time) for e in experiments]
        return getattr(estimator, _OF_READ[method])(read)
    table, y = as_table(experiments)
    *inputs, label = table.columns
    own: dict[str, Any] = {
        **dict.fromkeys(ROLES),
        "inputs": inputs,
        "experiment": label,
        "sampling_time": sampling_time,
    }
    estimator.set_params(**{name: own[name] for name in own if name in known})
    return getattr(estimator, method)(table, y)


def _with_step(experiment: Experiment, sampling_time: float) -> Experiment:
    return replace(experiment, sampling_time=sampling_time, breaks=(), jitter=0.0)


def alternating(model: StateSpace) -> Array:
    """Poles on the negative real axis, of a model in discrete time."""
    poles = model.poles()
    return np.asarray(poles.real[(poles.real < 0.0) & (poles.imag == 0.0)])


def told_by(fitted: Any, experiments: Sequence[Experiment]) -> dict[str, Any]:
    """What an estimator chose for experiments, as a `LocalModel` has it."""
    return {
        "order": fitted.lti_.order,
        "horizon": getattr(fitted, "horizon_", None),
        "method": getattr(fitted, "method_", None),
        "costs": _costs(fitted, experiments),
    }


def _costs(fitted: Any, experiments: Sequence[Experiment]) -> dict[int, float]:
    """What every order costs an estimator that tells it, above the best one.

    The orders that "pbsid" chooses among are those of plant and noise together.
    """
    table = getattr(fitted, "selection_", None)
    if table is None or "criterion" not in table:
        return {}
    n_values = sum(e.measured.size for e in experiments)
    orders, criteria = table["order"].to_numpy(), table["criterion"].to_numpy()
    known = ~np.isnan(criteria)
    orders, costs = orders[known], n_values * criteria[known]
    if from_closed_loop(fitted) and len(costs):
        orders = orders - max(0, orders[np.argmin(costs)] - fitted.order_)
    found = zip(orders.tolist(), costs.tolist(), strict=True)
    return {order: cost for order, cost in found if order >= 0}


def deviated(fitted: Any) -> list[ModelPair]:
    """Models to either side of a fitted one, where the estimator knows them."""
    pairs = getattr(fitted, "deviated_models", None)
    return [] if pairs is None else pairs()


def from_closed_loop(fitted: Any) -> bool:
    return getattr(fitted, "method_", None) == "pbsid"


def n_trend(fitted: Any) -> int:
    """Trends of every output and experiment in a model, as `LocalModel` has them."""
    trends = {getattr(fitted, name, None) for name in ("offset_", "detrend")}
    return max(n for n, trend in enumerate(DETRENDS) if trend in trends or n == 0)


def lasts(fitted: Any, experiments: Sequence[Experiment]) -> bool:
    """Whether a mode does not decay over the longest experiment; integrators apart."""
    rates = getattr(fitted, "rates_", None)
    lti = fitted.lti_ if rates is None else rates.lti_
    longest = max(len(e.inputs) for e in experiments)
    return bool(lasting(lti.poles(), longest).any())


def criterion(fitted: Any) -> float:
    """That of the model of an estimator that tells it, else NaN."""
    told = getattr(fitted, "criterion", None)
    return np.nan if told is None else told()


def integrating(fitted: Any) -> list[int]:
    """Outputs of a fitted estimator that integrate, by their places."""
    if getattr(fitted, "rates_", None) is None:
        return []
    places = range(fitted.lti_.n_outputs)
    return np.flatnonzero(integrating_flags(fitted.integrating, places)).tolist()
