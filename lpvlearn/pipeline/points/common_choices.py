"""Step 3 at the operating points, of which none has to choose alone.

What records of a point leave open, those of all tell together: the order, the delay of
the inputs, whether outputs drift.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import Experiment
from ...data.operating_points import OperatingPoints
from ...exceptions import collected, warn
from ...restructuring.known_poles import (
    hidden_integrators,
    integrators,
    poles_at_zero,
)
from ...structures.structure import GrayBoxStructure
from ...subspace.estimator import SubspaceLTI
from ...subspace.fits.delay import with_late_inputs
from ...subspace.simulation_error.criterion import PRICE
from ..running.runner import Done, PointRunner, label_of, tell_skipped
from .local_models import (
    LocalModel,
    identify_point,
    integrates,
    is_left,
    labels_of,
)

Array = NDArray[np.float64]

# Points that together tell one delay of all, and by how much, in twice the logarithm of
# the likelihood, it must be likelier than another; or a delay of a point of its own.
_PROBED, _CLEARER = 5, 6.0
_CHANCE = 2  # samples by which delays that points find for themselves may differ

# Points that look for their order everywhere, and states fewer and more than theirs
# among which the others look first: a mode may vanish, or come.
_SCOUTS, _FEWER, _MORE = 3, 2, 2


def identify_points(
    local: Any,
    points: OperatingPoints,
    runner: PointRunner,
    *,
    structure: GrayBoxStructure | None,
    **options: Any,
) -> tuple[list[LocalModel], OperatingPoints]:
    """Local models of the operating points, and which of these did not fail.

    The order of the structure replaces ``order="auto"`` of the local estimator, as the
    `most` there can be; without one, "auto", or several orders, become an order that a
    point takes: the one with the most evidence of all points. Options as in
    `identify_point`.
    """
    given = local.get_params(deep=False).get("order")
    free = is_left(local, "order")
    chooses = free or isinstance(given, range | list | tuple | np.ndarray)
    local, options["most"] = of_structure(local, structure)
    if isinstance(structure, GrayBoxStructure):
        options["n_at_zero"] = poles_at_zero(structure)
    # Where a record stood in the table does not matter: splits share their results.
    groups = [[_bare(e) for e in group] for group in points.experiments]

    def identify(
        estimator: Any, known: Sequence[Done | None] = (), by: PointRunner = runner
    ) -> list[Done | None]:
        arguments = [(estimator, group) for group in groups]
        return by.run(
            "local models", identify_point, arguments, points.kappa, known, **options
        )

    def tried(
        estimator: Any, some: Sequence[int], known: Sequence[Done | None] = ()
    ) -> list[Done | None]:
        """Of some points alone; what fails is not told."""
        found: list[Done | None] = [None] * len(groups)
        known = [known[k] for k in some] if known else ()
        arguments = [(estimator, groups[k]) for k in some]
        quiet = replace(runner, on_error="skip", verbose=0)
        run = partial(quiet.run, "local models", identify_point, arguments)
        with collected(), suppress(ValueError):
            for k, done in zip(
                some, run(points.kappa[some], known, **options), strict=True
            ):
                found[k] = done
        return found

    def attempted(
        estimator: Any, known: Sequence[Done | None] = ()
    ) -> list[Done | None]:
        """Of all points; what fails is left open, and not told yet."""
        with collected(), suppress(ValueError):
            return identify(estimator, known, replace(runner, on_error="skip"))
        return [None] * len(groups)

    known: list[Done | None] = [None] * len(groups)
    if _looks_for_delays(local, groups, options["combine"]):
        local, known = _with_one_delay(local, tried, groups, options["sampling_time"])
    if not chooses or structure is not None:
        found = identify(local, known)
    else:
        search = free and len(groups) > _SCOUTS and type(local) is SubspaceLTI
        some = _spread(len(groups), _SCOUTS)
        scouts = tried(local, some, known) if search else []
        if is_left(local, "offset"):
            # whatever the others are, but where drifts are what all of them lack
            fails = scouts and not any(scouts) and runner.on_error == "raise"
            found = known if fails else _of_own_orders(local, attempted, scouts, known)
            found = _drifting_alike(local, tried, found)
            found = identify(local, found) if None in found else found
        else:
            found = _of_own_orders(local, identify, scouts, known)
        models = [done.result for done in found if done is not None]
        if len({model.order for model in models}) > 1:
            order = _common_order(models)
            alike = [
                done
                if done is not None and done.result.order_of_rates == order
                else None
                for done in found
            ]
            own, found = found, identify(clone(local).set_params(order=order), alike)
            found = [_beside(*pair) for pair in zip(found, own, strict=True)]
    tell_skipped(found, points.kappa)
    kept = [k for k, done in enumerate(found) if done is not None]
    return [done.result for done in found if done is not None], points.keep(kept)


def of_structure(local: Any, structure: Any) -> tuple[Any, bool]:
    """The estimator with the order of a structure, if that is left to it ("auto").

    And whether a model may have fewer states, as `identify_point` asks.
    """
    if not (is_left(local, "order") and isinstance(structure, GrayBoxStructure)):
        return local, False
    # the model of the rates has not the integrators, no model what nothing shows
    lost = integrators if integrates(local) else hidden_integrators
    order = structure.order - lost(structure)
    return clone(local).set_params(order=order), isinstance(local, SubspaceLTI)


def _spread(n_points: int, most: int) -> list[int]:
    """Some of the points, from the first to the last."""
    return np.unique(np.linspace(0, n_points - 1, most).round().astype(int)).tolist()


def _looks_for_delays(
    local: Any, groups: Sequence[Sequence[Experiment]], combine: str
) -> bool:
    """Whether points find delays, by models whose criteria tell which are likelier.

    Those of rates have none, nor has an average.
    """
    asked = type(local) is SubspaceLTI and isinstance(local.input_delay, str)
    averages = combine == "average" and any(len(labels_of(g)) > 1 for g in groups)
    return asked and len(groups) > 1 and not averages and not integrates(local)


def _with_one_delay(
    local: Any,
    tried: Callable[..., list[Done | None]],
    groups: Sequence[Sequence[Experiment]],
    sampling_time: float,
) -> tuple[Any, list[Done | None]]:
    """The estimator with the delay of all points, where each was to find its own.

    And its models of the points that told. A short record takes a sample more or less
    for states, or for noise. Criteria of independent records add up: beginning at the
    median of some points, longer delays of an input are taken where these together are
    likelier so by more than a state, which may stand for a sample, and shorter ones
    where they are as likely. Not where delays of their own are likelier beyond doubt,
    as with transport at another speed.
    """
    found = tried(local, _spread(len(groups), _PROBED))
    known: dict[tuple[int, ...], list[Done | None]] = {}

    def costs_of(found: Sequence[Done | None]) -> dict[int, float]:
        return {
            k: cost_with_delay(local, done.result, groups[k], sampling_time)
            for k, done in enumerate(found)
            if done is not None
        }

    def delay_of(done: Done) -> NDArray[np.intp]:
        return delay_in_samples(done.result, sampling_time)

    own = costs_of(found)
    least_of_own = sum(own.values())

    def having(
        delay: NDArray[np.intp], points: Sequence[int]
    ) -> tuple[Any, list[Done | None]]:
        """The estimator and its models, which of a delay found is that of one given."""
        estimator = clone(local).set_params(input_delay=delay.tolist())
        have = [
            done if done is not None and (delay_of(done) == delay).all() else None
            for done in found
        ]
        have = known.get(tuple(delay.tolist()), have)
        new = tried(estimator, points, have) if points else have
        models = [a if b is None else b for a, b in zip(have, new, strict=True)]
        known[tuple(delay.tolist())] = models
        return estimator, models

    def cost(delay: NDArray[np.intp], former: NDArray[np.intp] | None = None) -> float:
        """Or infinity, where the first point is far likelier with a former delay.

        One that all points have is far worse for none of them.
        """
        first, limit = min(own), np.inf
        if former is not None:
            limit = costs_of(having(former, [])[1])[first] + _CLEARER * len(own)
        for points in ([first], list(own)):
            costs = costs_of(having(delay, points)[1])
            if any(k not in costs for k in points) or costs[first] > limit:
                return np.inf
        return sum(costs.values())

    if len(own) < 2 or not np.isfinite(least_of_own):
        return local, found
    delays = np.array([delay_of(done) for done in found if done is not None])
    delay = np.sort(delays, axis=0)[(len(own) - 1) // 2]
    agree = bool((delays == delay).all())
    if agree and delay.any():
        return having(delay, [])
    inputs, outputs = groups[0][0].inputs.shape[1], groups[0][0].measured.shape[1]
    state = len(own) * PRICE * (inputs + outputs)
    far_apart = bool((np.ptp(delays, axis=0) > _CHANCE).any())
    least = cost(delay, delays[0] if far_apart else None)
    if np.isinf(least):
        return local, found
    for sample in np.eye(len(delay), dtype=np.intp):
        for step, worth in ((sample, _CLEARER + state), (-sample, -_CLEARER)):
            delay, least = _along(step, worth, (delay, least), cost)
    alike = least < least_of_own + _CLEARER * (len(own) - 1)
    return having(delay, []) if alike else (local, found)


def cost_with_delay(
    local: SubspaceLTI,
    model: LocalModel,
    experiments: Sequence[Experiment],
    sampling_time: float,
) -> float:
    """The criterion of as many samples, whatever is unknown of the first ones."""
    rest, gaps = local.initial_state == "rest", local.missing != "raise"
    delay = delay_in_samples(model, sampling_time)
    n_samples, n_known = (
        sum(
            len(e.rows)
            for e in with_late_inputs(experiments, some, rest=rest, gaps=gaps)
        )
        for some in (np.zeros_like(delay), delay)
    )
    return model.criterion * n_samples / n_known


def delay_in_samples(model: LocalModel, sampling_time: float) -> NDArray[np.intp]:
    """The delays of the inputs of a local model."""
    return np.round(model.lti.input_delay / sampling_time).astype(np.intp)


def _along(
    step: NDArray[np.intp],
    worth: float,
    start: tuple[NDArray[np.intp], float],
    cost: Callable[[NDArray[np.intp], NDArray[np.intp]], float],
) -> tuple[NDArray[np.intp], float]:
    """The delay of least cost some steps from a start, where that is `worth` it.

    Up to where the cost rises beyond doubt.
    """
    delay, least = start
    best, lowest, other = start, least - worth, delay + step
    while (other >= 0).all():
        reached = cost(other, other - step)
        if not reached < least + _CLEARER:
            break
        if reached < lowest:
            best, lowest = (other, reached), reached
        least, other = min(least, reached), other + step
    return best


def _of_own_orders(
    local: Any,
    identify: Callable[..., list[Done | None]],
    scouts: Sequence[Done | None],
    known: Sequence[Done | None],
) -> list[Done | None]:
    """Models of all points, each of the order that it takes itself.

    What the `scouts` among them take tells the others where to look. One that finds its
    order at an end of that looks everywhere, as those have that are `known`.
    """
    orders = [done.result.order_of_rates for done in scouts if done is not None]
    if not orders:
        return identify(local, known)
    about = range(max(0, min(orders) - _FEWER), max(orders) + _MORE + 1)
    found = identify(clone(local).set_params(order=about), scouts)
    ends = {about[0], about[-1]} - {0}
    unsure = [
        scout is None and done is not None and done.result.order_of_rates in ends
        for scout, done in zip(scouts, found, strict=True)
    ]
    if not any(unsure):
        return found
    kinds = zip(found, known, unsure, strict=True)
    return identify(local, [own if again else done for done, own, again in kinds])


def _drifting_alike(
    local: Any,
    tried: Callable[[Any, Sequence[int]], list[Done | None]],
    found: list[Done | None],
) -> list[Done | None]:
    """With drifts at all points, if these together are likelier so.

    What drifts in one experiment mostly does in all of them. Where it is not beyond
    doubt, states that the plant does not have stand for it: ones that other points do
    not need, that do not decay, or grow. Their records are independent, and criteria
    add up: those with drifts, of no more states than the others take together, must
    have the lesser sum.
    """
    models = [done.result for done in found if done is not None]
    sound = [model for model in models if model.n_trend > 1 and not model.lasts]
    most = _common_order(sound) if sound else np.inf
    doubtful = [m.lasts or (m.n_trend < 2 and m.order_of_rates > most) for m in models]
    if not any(doubtful) and len(models) == len(found):
        return found
    drifting = clone(local).set_params(offset="linear")
    if not models and tried(drifting, [0])[0] is None:
        return found

    def anew(known: list[Done | None], again: Sequence[int]) -> list[Done | None]:
        new = tried(drifting, again) if again else known
        return [new[k] if k in again else done for k, done in enumerate(known)]

    def drifts(known: list[Done | None], highest: float) -> list[Done | None]:
        """All points with drifts; anew where they are not, or have more states."""
        again = [
            k
            for k, done in enumerate(known)
            if done is None
            or done.result.n_trend < 2
            or done.result.order_of_rates > highest
        ]
        return anew(known, again)

    lasting = [k for k, m in enumerate(found) if m is not None and m.result.lasts]
    first = anew(found, lasting)
    order = _common_order(models) if models else 0
    for one in [first[k] for k in lasting]:
        if one is not None and one.result.lasts and one.result.order_of_rates <= order:
            return found  # where a drift is no help to one of them it is to none
    others = drifts(first, np.inf)
    with_them = [done.result for done in others if done is not None]
    if not with_them:
        return found
    highest, given = _common_order(with_them), local.get_params(deep=False)["order"]
    given = range(highest + 1) if isinstance(given, str) else given
    drifting.set_params(order=[n for n in given if n <= highest])
    others = drifts(others, highest)
    with_them = [done.result for done in others if done is not None]
    if len(with_them) < len(found) or any(model.lasts for model in with_them):
        return found
    if not models:
        return others
    better = sum(_cost(m, order) - _cost(m, m.order_of_rates) for m in models)
    for one, other in zip(found, with_them, strict=True):
        better += one.result.criterion - other.criterion if one is not None else 0.0
    return others if better > 0.0 and highest <= order else found


def _beside(found: Done | None, own: Done | None) -> Done | None:
    """The model of the common order beside that of the order that its record takes."""
    if found is None or own is None or own.result.order == found.result.order:
        return found
    return found._replace(result=replace(found.result, own=own.result))


def _common_order(models: Sequence[LocalModel]) -> int:
    """The order of least cost to all points together, of those that one of them takes.

    Their records are independent: likelihoods multiply, and a state that one point in
    nine takes from its noise is not had by all. The highest one where costs are untold.
    """
    orders = sorted({model.order_of_rates for model in models})
    if not all(model.costs for model in models):
        return orders[-1]
    total = dict.fromkeys(orders, 0.0)
    for model in models:
        for order in orders:
            total[order] += _cost(model, order)
    return min(orders, key=lambda order: total[order])


def _cost(model: LocalModel, order: int) -> float:
    """What an order costs; beyond those tried, more states bring nothing."""
    return model.costs.get(min(order, max(model.costs, default=order)), np.inf)


def _bare(experiment: Experiment) -> Experiment:
    """An experiment without its place in the table."""
    return replace(
        experiment,
        rows=np.broadcast_to(np.intp(0), len(experiment.rows)),
        scheduling=None,
        operating_point=None,
    )


def common_delay(
    local: Sequence[LocalModel], kappa: Array, sampling_time: float
) -> Array:
    """Delay of the inputs, seconds, of all operating points: their lower median.

    Warns where they do not agree.
    """
    delays = np.array([model.lti.input_delay for model in local])
    median = np.sort(delays, axis=0)[(len(delays) - 1) // 2]
    samples = np.round(delays / sampling_time).astype(int)
    if (samples != samples[0]).any():
        each = "; ".join(
            f"{label_of(row)}: {', '.join(map(str, own))}"
            for row, own in zip(kappa, samples.tolist(), strict=True)
        )
        taken = ", ".join(map(str, np.round(median / sampling_time).astype(int)))
        warn(
            "the input delay differs between operating points (scheduling: samples of "
            f"each input; {each}). The LPV model takes the median, {taken}; the local "
            "models keep their own. Where the system has one delay, give it: "
            "local=SubspaceLTI(input_delay=...). Where it follows the scheduling "
            "variable, as transport at another speed does, shift the column of the "
            "input by what is known of it, for the fit and for predictions."
        )
    return median
