"""Step 4 at the operating points: all black boxes in one structure.

There the points help one another: the parameters of a neighbour lead out of a wrong
basin, and branches are tied.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import compress
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import are_beginnings
from ...data.motion import channel_sizes, motions
from ...data.operating_points import OperatingPoints
from ...exceptions import collected, retold, warn
from ...lpv.auto import AutoLPV
from ...lpv.equilibria import points_of_work
from ...lpv.left_out import takes_covariance
from ...lpv.model import LPVStateSpace
from ...models.scheduling_range import in_range_of_points
from ...models.statespace import DEVIATION, ModelPair, StateSpace
from ...restructuring.deadline import bounded, time_is_up
from ...restructuring.minimise_covariance import Estimate
from ...restructuring.problem import GOOD_FIT, problem_from_models
from ...restructuring.uncertainty import ParameterUncertainty
from ...structures.structure import GrayBoxStructure
from ...systems.beginnings import Beginning, begin_held, waiting
from ...validation import listed
from ..points.local_models import LocalModel
from ..running.runner import Done, PointRunner, place_of, tell_skipped
from .black_boxes import (
    aligned_black_boxes,
    balanced,
    balanced_entries,
    tell_of_forced,
)
from .branches import Doubt, tied_branches
from .canonical import canonical_black_boxes, is_better_form

Array = NDArray[np.float64]

_Task = tuple[StateSpace, list[StateSpace], list[Estimate]]

_SWEEPS = 4  # passes over the points: help travels that far from a good one

_NEIGHBOURS = 2  # points that help one: those to either side along one variable

_FIRST_SHARE = 0.75  # of `max_time`, before the points help one another

_NAMED = 3  # points in a message; of more the number is enough

_BETTER = 0.98  # factor by which a neighbour's start must lower the error: no rounding


class StructuredModels(NamedTuple):
    """Models of one structure at the operating points that did not fail."""

    points: OperatingPoints
    local: list[LocalModel]  # the black boxes
    structure: GrayBoxStructure
    theta: Array  # (n_points, n_params), parameters
    covariance: Array  # (n_points, n_params, n_params): NaN where not known
    models: list[StateSpace]
    restructurers: list[Any]  # fitted; empty without that step
    interpolator: AutoLPV | None = None  # which is fitted to them already


def restructure_points(
    restructurer: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    runner: PointRunner,
    sampling_time: float,
    max_time: float | None = None,
    starts: Array | None = None,
) -> StructuredModels:
    """Bring the local models of all operating points into one structure.

    "aligned" or "passthrough": the entries of the balanced models are parameters.
    `max_time` bounds the seconds of all points: equal shares, known in advance, and
    what is left of it for the help of neighbours. Where `starts` of all points are
    given, (n_points, n_params), no others are looked for.
    """
    began = perf_counter()
    if isinstance(restructurer, str):
        return _black_boxes(restructurer, local, points, sampling_time)
    restructurer = _with_structure(restructurer, local)
    if max_time is not None:
        at_once = min(effective_n_jobs(runner.n_jobs), len(local))
        restructurer = _with_time(
            restructurer, _FIRST_SHARE * max_time * at_once / len(local)
        )
    # What a fit is about: the model, and where they are known its realizations and
    # estimates. Another norm or a weight is what the user wants minimised.
    weighed = getattr(restructurer, "norm", None) in ("hinf", "covariance")
    weighed = weighed and restructurer.frequency_weight is None
    tasks: list[_Task] = [
        (model.lti, model.realizations, model.estimates if weighed else [])
        for model in local
    ]
    given = [None] * len(tasks) if starts is None else list(starts)
    found = runner.run(
        "restructuring",
        _restructure_point,
        [(*task, start) for task, start in zip(tasks, given, strict=True)],
        points.kappa,
        restructurer=restructurer,
    )
    kept = [k for k, done in enumerate(found) if done is not None]
    first = [done.result for done in found if done is not None]
    if starts is None:
        with bounded(None if max_time is None else began + max_time - perf_counter()):
            better = runner.call(
                _help_neighbours,
                first,
                [tasks[k] for k in kept],
                points.kappa[kept],
                restructurer,
                ignore=["fitted"],
            )
        for k, other in zip(kept, better, strict=True):
            found[k] = other or found[k]
    tell_skipped(found, points.kappa)
    helped = [done.result for done in found if done is not None]
    points, local = points.keep(kept), [local[k] for k in kept]
    covariances = [
        _covariance(*pair, runner) for pair in zip(helped, local, strict=True)
    ]
    tied = runner.call(
        _tie_branches,
        helped,
        covariances,
        [tasks[k] for k in kept],
        points.kappa,
        restructurer,
        ignore=["fitted"],
    )
    tell_skipped(tied, points.kappa)
    for k, other in enumerate(tied):
        if other is not None:
            helped[k] = other.result
            covariances[k] = _covariance(helped[k], local[k], runner)
    theta = np.array([fitted.params_ for fitted in helped])
    covariance = _unknown_covariance(theta)
    for P, known in zip(covariance, covariances, strict=True):
        if known is not None:
            P[:] = known
    _tell_of_no_deviations(covariances, points.kappa)
    models = [fitted.lti_ for fitted in helped]
    return StructuredModels(
        points, local, helped[0].structure_, theta, covariance, models, helped
    )


def _tell_of_no_deviations(known: Sequence[Array | None], kappa: Array) -> None:
    """Tell of points whose parameters have no deviations, where those of others do."""
    lacking = [k for k, P in enumerate(known) if P is None]
    if lacking and len(lacking) < len(known):
        places = listed([place_of(k, kappa) for k in lacking], _NAMED)
        warn(
            f"the standard deviations of the parameters are not known at {places}: the "
            "local models have none there, as in a loop whose noise takes more states "
            "than they have. The parameters are the H-infinity optimum, and the "
            "interpolation does not know how far to trust them. Use `local` with "
            "another `order`, or record for longer there."
        )


def _black_boxes(
    states: str, local: list[LocalModel], points: OperatingPoints, sampling_time: float
) -> StructuredModels:
    """The balanced models, "aligned" or not: their entries are the parameters."""
    longest = sampling_time * points.n_longest
    if states == "aligned":
        sizes = channel_sizes(points.experiments)
        structure, theta = aligned_black_boxes(local, points.kappa, *sizes, longest)
    else:
        tell_of_forced(local, points.kappa, longest)
        models = [balanced(model) for model in local]
        structure, theta = balanced_entries(models, local[0].integrating)
    models = delayed_models(structure, theta, local)
    unknown = _unknown_covariance(theta)
    return StructuredModels(points, local, structure, theta, unknown, models, [])


def without_structure(
    local: list[LocalModel],
    points: OperatingPoints,
    runner: PointRunner,
    sampling_time: float,
    interpolator: Any,
    *,
    every: bool,
) -> list[StructuredModels]:
    """Aligned models and canonical ones, the better first for the `interpolator`.

    Aligned ones alone where these are told of, or are the better and not `every` one
    is asked for.
    """
    with retold() as told:
        aligned = restructure_points("aligned", local, points, runner, sampling_time)
    # two points lie on a line, whatever states they have
    tells = isinstance(interpolator, AutoLPV) and (every or len(points) > 2)
    if told or not tells:
        return [aligned]
    found = canonical_black_boxes(local)
    if found is None:
        return [aligned]
    kappa = points.kappa
    auto = clone(interpolator).fit(kappa, found.theta, covariance=found.covariance)
    better = is_better_form(
        found,
        (aligned.structure, aligned.theta),
        local,
        kappa,
        channel_sizes(points.experiments),
        sampling_time * points.n_longest,
        auto,
    )
    models = delayed_models(found.structure, found.theta, local)
    canonical = StructuredModels(points, local, *found, models, [], auto)
    ways = [canonical, aligned] if better else [aligned, canonical]
    return ways if every or better else ways[:1]


def delayed_models(
    structure: GrayBoxStructure, theta: Array, local: Sequence[LocalModel]
) -> list[StateSpace]:
    """Models of a structure with the delays of the local ones."""
    return [
        structure.model(row).with_input_delay(model.lti.input_delay)
        for row, model in zip(theta, local, strict=True)
    ]


def over_points(interpolator: Any, found: StructuredModels) -> Any:
    """The interpolator, fitted to parameters, and by their covariances if it may."""
    fitted = found.interpolator
    if fitted is not None and fitted.get_params() == interpolator.get_params():
        return fitted
    known = {}
    if takes_covariance(interpolator):
        known["covariance"] = found.covariance
    return interpolator.fit(found.points.kappa, found.theta, **known)


def offsets_of_points(
    found: StructuredModels,
) -> tuple[Array, tuple[Array, Array]] | None:
    """``[u0, y0, x0]`` of every point, as `LPVStateSpace` has them; None for none.

    And the sizes of the motions of inputs and outputs.
    """
    local = found.local
    if not any((model.n_trend or model.integrating) and model.rest for model in local):
        return None
    runs = [run for group in found.points.experiments for run in group]
    (u, u_scale), (y, y_scale) = motions(runs)
    rest = [model.rest or (np.zeros_like(u), np.zeros_like(y)) for model in local]
    inputs, outputs = (np.array(values) for values in zip(*rest, strict=True))
    places = local[0].integrating  # where these stand no scheduling variable moves
    outputs[:, places] = outputs[:, places].mean(axis=0)
    scales = (u_scale, y_scale)
    kappa = found.points.kappa
    known = found.models, kappa, inputs, outputs, scales
    return points_of_work(*known, structured=bool(found.restructurers)), scales


def local_ones_begin_held(
    model: LPVStateSpace, points: OperatingPoints, dt: float
) -> bool:
    """Whether local experiments begin where their first inputs hold the model.

    And not at rest about zero, or, where there are points of work, about their means.
    """
    model = model.silenced()

    groups = [
        [e for e in compress(group, are_beginnings(group)) if waiting(e.inputs)]
        for group in points.experiments
    ]
    if not any(groups):
        return False
    models = [model.at(kappa) for kappa in points.kappa]
    if not all(frozen.is_stable for frozen in models):
        return False

    def beginnings() -> Iterator[Beginning]:
        levels = model.input_offset(points.kappa), model.output_offset(points.kappa)
        for frozen, group, u0, y0 in zip(models, groups, *levels, strict=True):
            gain = frozen.dc_gain()
            simulated = partial(frozen.simulate, sampling_time=dt)
            for e in group:
                yield Beginning.of(
                    (e.inputs, e.measured),
                    (u0, y0),
                    gain,
                    simulated,
                    about_mean=model.offsets is not None,
                )

    return begin_held(beginnings())


def _covariance(fitted: Any, model: LocalModel, runner: PointRunner) -> Array | None:
    """Covariance of the parameters at a point, None where it is not known."""
    known = getattr(fitted, "params_covariance_", None)  # where it tells its own
    if known is None and (deviated := model.deviated()):
        known = runner.call(
            covariance_of_parameters,
            fitted.structure_,
            fitted.params_,
            getattr(fitted, "frequency_weight", None),
            model.lti,
            deviated,
            getattr(fitted, "norm", "hinf"),
        )
    return known


def _unknown_covariance(theta: Array) -> Array:
    return np.full((*theta.shape, theta.shape[1]), np.nan)


def _with_structure(restructurer: Any, local: Sequence[LocalModel]) -> Any:
    """One canonical form for all points, of the identified order, where none is given.

    Raises
    ------
    ValueError
        If the models differ in order.
    """
    if getattr(restructurer, "structure", "its own") is not None:
        return restructurer
    orders = sorted({model.order for model in local})
    if len(orders) > 1:
        raise ValueError(
            "`structure=None` interpolates the parameters of a canonical form and "
            f"needs local models of one order. Got orders {orders}. Fix the order: "
            "local=SubspaceLTI(order=...)."
        )
    first, integrating = local[0].lti, local[0].integrating
    form = GrayBoxStructure.observable_canonical(
        local[0].order_of_rates,
        first.n_inputs,
        first.n_outputs,
        orders[0] == 0 or any(model.lti.D.any() for model in local),
        integrating,
    )
    return clone(restructurer).set_params(structure=form)


def _with_time(restructurer: Any, seconds: float) -> Any:
    """The restructurer with a time for every point, where it has no shorter one."""
    own = restructurer.get_params().get("max_time", 0.0)  # unknown: untouched
    if own is not None and own <= seconds:
        return restructurer
    return clone(restructurer).set_params(max_time=seconds)


def _restructure_point(
    model: StateSpace,
    realizations: Sequence[StateSpace],
    estimates: Sequence[Estimate],
    start: Array | None = None,
    *,
    restructurer: Any,
    **options: Any,
) -> Any:
    """A clone of the restructurer, fitted to one local model; from a start alone."""
    restructurer = clone(restructurer)
    if start is not None:
        options |= {"starts": [start], "search": False}
    if len(realizations) > 1:
        options["realizations"] = realizations
    if estimates:
        restructurer.set_params(norm="covariance")
        options["estimates"] = estimates
    elif getattr(restructurer, "norm", None) == "covariance":  # it is not known
        restructurer.set_params(norm="hinf")
    return restructurer.fit_model(model, **options)


def _help_neighbours(
    fitted: Sequence[Any],
    tasks: Sequence[_Task],
    kappa: Array,
    restructurer: Any,
) -> list[Done | None]:
    """Try the parameters of neighbouring points as starts, until nothing improves.

    A point in a wrong basin is one that its neighbours' parameters lead out of. Points
    that fit well need no help. `fitted` follows from the other arguments. Returns the
    better fits, None where there is none.
    """
    fitted = list(fitted)
    better: list[Done | None] = [None] * len(fitted)
    scaled = in_range_of_points(kappa)
    distance = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
    tried: set[tuple[int, bytes]] = set()
    for _ in range(_SWEEPS):
        improved = False
        for i, task in enumerate(tasks):
            if fitted[i].fit_error_ <= GOOD_FIT:
                continue
            for j in np.argsort(distance[i], kind="stable")[1 : 1 + _NEIGHBOURS]:
                start = fitted[j].params_
                key = (i, start.tobytes())
                if key in tried or time_is_up():
                    continue
                tried.add(key)
                own = fitted[i].fit_error_
                if fitted[i].start_error(task[0], start) < _BETTER * own:
                    with collected() as told:
                        other = _restructure_point(
                            *task, restructurer=restructurer, starts=[start]
                        )
                    if other.fit_error_ < own:  # if its time was enough
                        fitted[i], better[i] = other, Done(other, told)
                        improved = True
        if not improved:
            break
    return better


def _tie_branches(
    fitted: Sequence[Any],
    covariances: Sequence[Array | None],
    tasks: Sequence[_Task],
    kappa: Array,
    restructurer: Any,
) -> list[Done | None]:
    """Among equally good parameters of the points, those of one smooth family.

    None where it is what was found. `fitted` follows from the other arguments. Warns
    where families are nearly as plausible.
    """
    structure = fitted[0].structure_
    weight = getattr(restructurer, "frequency_weight", None)
    problems = [problem_from_models(structure, [task[0]], weight) for task in tasks]
    branches, doubts = tied_branches(problems, fitted, covariances, kappa)
    tied: list[Done | None] = [None] * len(fitted)
    for k, branch in enumerate(branches):
        with collected() as told:
            if branch.start is not None:
                fitted_there = _restructure_point(
                    *tasks[k],
                    restructurer=restructurer,
                    starts=[branch.start],
                    search=False,
                )
                tied[k] = Done(fitted_there, told)
            elif branch.places is not None:
                tied[k] = Done(fitted[k].interchanged(branch.places), told)
    if len(doubts) == len(kappa):
        _warn_of_another_family(structure, doubts[0], place_of(0, kappa))
        return tied
    for doubt in doubts:
        names = ", ".join(structure.parameter_names[j] for j in doubt.params)
        warn(
            f"the parameters {names} may have changed places at "
            f"{place_of(doubt.point, kappa)}: several values give the same response, "
            "and those that continue the other points most smoothly are only "
            f"{100 * doubt.probability:.0f} % likely to be the right ones. Between the "
            "points the LPV model may be wrong. Add operating points near it, tell the "
            "parts apart by structure.with_bounds(), or fit all experiments together: "
            "OutputErrorLPV(structure)."
        )
    return tied


def _warn_of_another_family(
    structure: GrayBoxStructure, doubt: Doubt, place: str
) -> None:
    """Tell of other parameters of all points that are as good, and as smooth."""
    names = structure.parameter_names
    values = ", ".join(f"{names[j]} = {doubt.other[j]:.4g}" for j in doubt.params)
    warn(
        f"the parameters {', '.join(names[j] for j in doubt.params)} have other values "
        f"that give the same responses at all operating points ({place}: {values}), "
        "and change as smoothly: the data do not tell which part is which. Say it by "
        "structure.with_bounds(), structure.with_ranges(), or a first guess, "
        "GrayBoxRestructurer(structure, init=...)."
    )


def covariance_of_parameters(
    structure: GrayBoxStructure,
    theta: Array,
    weight: Any,
    model: StateSpace,
    deviated: Sequence[ModelPair],
    norm: str = "hinf",
) -> Array:
    """Covariance of gray-box parameters from that of the black box `model`.

    The deviations of the response (`deviated_models`) are carried to the parameters to
    first order, as the minimisation of that norm does, for "hinf" as the least-squares
    fit of the response; what these do not determine is infinite. `weight` is the
    `frequency_weight` of `GrayBoxRestructurer`.
    """
    problem = problem_from_models(structure, [model], weight)
    response = problem.response_of
    changes = [response(above) - response(below) for above, below in deviated]
    found = ParameterUncertainty(problem, theta)
    T = found.changes(np.array(changes), norm) / (2.0 * DEVIATION)
    return T.T @ T + found.open_variances()
