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
from ...exceptions import collected
from ...restructuring.known_poles import (
    hidden_integrators,
    integrators,
    poles_at_zero,
)
from ...structures.structure import GrayBoxStructure
from ...subspace.estimator import SubspaceLTI
from ..running.runner import Done, PointRunner, tell_skipped
from .common_delay import some_of, with_one_delay
from .fitting import integrates, is_left, labels_of
from .local_models import LocalModel, identify_point

Array = NDArray[np.float64]

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
        local, known = with_one_delay(local, tried, groups, options["sampling_time"])
    if not chooses or structure is not None:
        found = identify(local, known)
    else:
        search = free and len(groups) > _SCOUTS and type(local) is SubspaceLTI
        some = some_of(len(groups), _SCOUTS)
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


def _looks_for_delays(
    local: Any, groups: Sequence[Sequence[Experiment]], combine: str
) -> bool:
    """Whether points find delays, by models whose criteria tell which are likelier.

    Those of rates have none, nor has an average.
    """
    asked = type(local) is SubspaceLTI and isinstance(local.input_delay, str)
    averages = combine == "average" and any(len(labels_of(g)) > 1 for g in groups)
    return asked and len(groups) > 1 and not averages and not integrates(local)


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
