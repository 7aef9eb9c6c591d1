"""Steps 3 and 4 at the operating points: a black box each, then all in one structure.

`identify_points` makes the experiments of every point a continuous-time model,
`restructure_points` brings these into the structure; there the points help one another:
the parameters of a neighbour lead out of a wrong basin. A `PointRunner` does either at
several points at a time, tells progress and failures, and keeps results in a memory.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import accumulate
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from joblib import Memory, delayed, effective_n_jobs
from numpy.typing import NDArray
from sklearn.base import clone
from threadpoolctl import ThreadpoolController

from ..data.experiments import ROLES, Experiment
from ..data.operating_points import OperatingPoints
from ..data.preparation import DETRENDS
from ..exceptions import Told, collected, warn
from ..lpv.alignment import aligned_models
from ..lpv.equilibria import points_of_work
from ..models.statespace import DEVIATION, ModelPair, StateSpace, with_signs_of
from ..restructuring.deadline import bounded, time_is_up
from ..restructuring.known_poles import integrators
from ..restructuring.minimise_covariance import Estimate
from ..restructuring.problem import GOOD_FIT, problem_from_models
from ..structures.structure import GrayBoxStructure
from .branches import tied_branches
from .memory import Remembered
from .workers import results_of

Array = NDArray[np.float64]

# Mean of an output in standard deviations, from which it looks like an offset (a record
# that rises steadily from rest has a mean of 1.7).
_OFFSET = 5.0

# Standard deviation of the constants of experiments at a point, in those of outputs,
# that a user should know of.
_APART = 0.1

_Task = tuple[StateSpace, list[StateSpace], list[Estimate]]

_SWEEPS = 4  # passes over the points: help travels that far from a good one

_NEIGHBOURS = 2  # points that help one: those to either side along one variable

# A pole that much slower than the others is an integrator, and an output shows it by
# more than that part of the output that does most.
_STANDING = 0.05

_FIRST_SHARE = 0.75  # of `max_time`, before the points help one another

_BETTER = 0.98  # factor by which a neighbour's start must lower the error: no rounding

_HELD = (
    "If only its controller holds the plant, identify the closed loop, with the "
    "controller's reference as input and the controller in the structure. "
)

_SKIP = " (Mend the experiments there, or leave the point out by on_error='skip'.)"

# -- step 3: a black box at every point ------------------------------------------------


@dataclass(frozen=True)
class LocalModel:
    """The black-box model of one operating point."""

    lti: StateSpace  # continuous time, balanced
    order: int  # as identified, in discrete time
    horizon: int | None  # of the subspace step, where the estimator tells it
    realizations: list[StateSpace] = field(default_factory=list)  # what was averaged
    deviated: list[ModelPair] = field(default_factory=list)  # of the local estimator
    n_trend: int = 0  # 1: a constant of every output and experiment, 2: and a drift
    # inputs and outputs at rest, near the experiments; None: not looked for
    rest: tuple[Array, Array] | None = None
    # the model as identified (of every realization) with models to either side of it,
    # where the covariance is known; with "zoh" in discrete time
    estimates: list[Estimate] = field(default_factory=list)


def identify_points(
    local: Any,
    points: OperatingPoints,
    runner: PointRunner,
    *,
    structure: GrayBoxStructure | None,
    **options: Any,
) -> tuple[list[LocalModel], OperatingPoints]:
    """Local models of the operating points, and which of these did not fail.

    The order of the structure replaces ``order="auto"`` of the local estimator; without
    one, "auto" becomes the highest order that a point takes. Options as in
    `identify_point`.
    """
    chooses = local.get_params(deep=False).get("order") == "auto"
    if chooses and isinstance(structure, GrayBoxStructure):
        rest = structure.order
        if _integrates(local):  # the model of the rates has not the integrators
            rest -= integrators(structure)
        local = clone(local).set_params(order=rest)
    # Where a record stood in the table does not matter: splits share their results.
    groups = [[_bare(e) for e in group] for group in points.experiments]

    def identify(estimator: Any) -> list[Done | None]:
        arguments = [(estimator, group) for group in groups]
        return runner.run(
            "local models", identify_point, arguments, points.kappa, **options
        )

    found = identify(local)
    orders = {done.result.order for done in found if done is not None}
    if chooses and structure is None and len(orders) > 1:
        found = identify(clone(local).set_params(order=max(orders)))
    _tell(found, points.kappa)
    kept = [k for k, done in enumerate(found) if done is not None]
    return [done.result for done in found if done is not None], points.keep(kept)


def identify_point(
    local: Any,
    experiments: Sequence[Experiment],
    *,
    sampling_time: float,
    combine: str,
    discretization: str,
    efficient: bool = False,
) -> LocalModel:
    """Identify the local model of one operating point by a clone of `local`.

    Fitted, it has `lti_`, a discrete-time StateSpace. `combine` is "pool", one fit of
    all experiments, or "average": one model each, balanced, signs aligned, and the
    matrices averaged (the paper's Monte Carlo). Refuses outputs that do not vary, and
    an unstable model, which cannot be balanced. `efficient` gives `estimates`.
    """
    if _integrates(local) and combine == "average":
        raise ValueError(
            "`combine` must be 'pool' for a local estimator with `integrating`: models "
            "with integrators cannot be balanced. Got 'average'."
        )
    advice = _look_at_outputs(experiments)
    labels = list(dict.fromkeys(e.label for e in experiments))
    if combine == "pool" or len(labels) == 1:
        fitted = _fit_local(local, experiments, sampling_time)
        pairs = _deviated(fitted)
        if _from_closed_loop(fitted):
            advice = _HELD + advice
        rates = getattr(fitted, "rates_", None)
        if rates is None:
            lti = _continuous(fitted.lti_, discretization, advice)
        else:  # stable but for the integrators
            _continuous(rates.lti_, discretization, advice)
            lti = fitted.lti_.to_continuous(discretization)
        found = LocalModel(
            lti,
            fitted.lti_.order,
            _horizon(fitted),
            deviated=_all_continuous(pairs, discretization),
            n_trend=_n_trend(fitted),
            rest=_equilibrium(lti, [fitted], experiments),
        )
        if efficient and pairs:
            found.estimates.append(_in_own_time(fitted.lti_, pairs, discretization))
        return found
    realisations = [[e for e in experiments if e.label == label] for label in labels]
    models, failures = [], []
    kept: list[Any] = []
    estimates: list[Estimate] = []
    for label, fitted in zip(
        labels, _fit_alike(local, realisations, sampling_time), strict=True
    ):
        if not kept and _from_closed_loop(fitted):
            advice = _HELD + advice
        model, pairs = fitted.lti_, _deviated(fitted) if efficient else []
        try:
            models.append(_continuous(model, discretization, advice))
            estimates.append(_in_own_time(model, pairs, discretization))
            kept.append(fitted)
        except ValueError as error:
            failures.append((label, error))
    if not models:
        raise failures[0][1]
    if failures:
        warn(
            f"{len(failures)} of {len(labels)} realisations were left out of the "
            f"average; the first, {failures[0][0]!r}: {failures[0][1]}"
        )
    lowest = min(model.order for model in models)  # where none grew
    models = [model for model in models if model.order == lowest]
    known, lti = all(pairs for _, pairs in estimates), _average(models)
    return LocalModel(
        lti,
        kept[0].lti_.order,
        _horizon(kept[0]),
        models,
        estimates=estimates if known else [],
        n_trend=max(map(_n_trend, kept)),
        rest=_equilibrium(lti, kept, experiments),
    )


def experiments_of(u: Array, y: Array, sampling_time: float) -> list[Experiment]:
    """Experiments of one length, (n_experiments, n_samples, n_channels) each."""
    rows = np.arange(u.shape[1])
    return [
        Experiment(k, rows, *pair, sampling_time=sampling_time)
        for k, pair in enumerate(zip(u, y, strict=True))
    ]


def _integrates(local: Any) -> bool:
    """Whether an estimator identifies the rates of outputs, and integrates them."""
    return getattr(local, "integrating", None) is not None


def _deviated(fitted: Any) -> list[ModelPair]:
    """Models to either side of a fitted one, where the estimator knows them."""
    pairs = getattr(fitted, "deviated_models", None)
    return [] if pairs is None else pairs()


def _from_closed_loop(fitted: Any) -> bool:
    return getattr(fitted, "method_", None) == "pbsid"


def _n_trend(fitted: Any) -> int:
    """Trends of every output and experiment in a model, as `LocalModel` has them."""
    trends = {getattr(fitted, name, None) for name in ("offset_", "detrend")}
    return max(n for n, trend in enumerate(DETRENDS) if trend in trends or n == 0)


def _equilibrium(
    lti: StateSpace, fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> tuple[Array, Array] | None:
    """Inputs and outputs at which the model rests, nearest to the experiments' means.

    In units of how far they move within the experiments. None where the estimator has
    not looked for constants, or does not tell.
    """
    first = fitted[0]
    if _integrates(first):  # it rests anywhere
        return None
    looked = getattr(first, "offset", None) or getattr(first, "detrend", None)
    if not looked or not hasattr(first, "resting_point"):
        return None
    _tell_different_constants(lti, fitted, experiments)
    known = [own.resting_point() for own in fitted]
    u0, y0 = (np.mean(values, axis=0) for values in zip(*known, strict=True))
    (u, u_scale), (y, y_scale) = motions(experiments)
    gain = lti.dc_gain()
    step, *_ = np.linalg.lstsq(
        np.vstack([np.diag(1.0 / u_scale), gain / y_scale[:, None]]),
        np.concatenate([(u - u0) / u_scale, (y - y0) / y_scale]),
    )
    return u0 + step, y0 + gain @ step


def _tell_different_constants(
    lti: StateSpace, fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> None:
    """Warn of constants that differ from experiment to experiment at one point."""
    levels = [
        own.output_offset_ - own.input_offset_ @ lti.dc_gain().T for own in fitted
    ]
    apart = np.vstack(levels).std(axis=0) > _APART * motions(experiments)[1][1]
    differ = len(fitted) > 1 or any(own.offsets_differ_ for own in fitted)
    if differ and apart.any():
        warn(
            "the experiments at one operating point have different constants in their "
            "outputs. The LPV model takes their mean, and is off by the rest: subtract "
            "what drifted between experiments from y, or let the scheduling variables "
            "tell what the constants depend on."
        )


def motions(
    experiments: Sequence[Experiment],
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Mean, and standard deviation about that of every experiment, of inputs, outputs.

    A channel that stands still counts as moving by one.
    """
    found, n = [], sum(len(e.inputs) for e in experiments)
    for values in zip(*((e.inputs, e.outputs) for e in experiments), strict=True):
        sums = [
            (v.sum(axis=0), ((v - v.mean(axis=0)) ** 2).sum(axis=0)) for v in values
        ]
        mean, variance = np.sum(sums, axis=0) / n
        found.append((mean, np.where(variance > 0, np.sqrt(variance), 1.0)))
    return found[0], found[1]


def _in_own_time(
    model: StateSpace, pairs: list[ModelPair], method: str
) -> tuple[StateSpace, list[ModelPair]]:
    """In discrete time where inputs are held, else as the continuous-time model."""
    if method == "zoh":
        return model, pairs
    return model.to_continuous(method), _all_continuous(pairs, method)


def _all_continuous(pairs: list[ModelPair], method: str) -> list[ModelPair]:
    with collected():  # the estimate's own conversion says it once
        return [(a.to_continuous(method), b.to_continuous(method)) for a, b in pairs]


def _fit_alike(
    local: Any, realisations: Sequence[Sequence[Experiment]], sampling_time: float
) -> list[Any]:
    """Clones of the local estimator for every realisation of one system.

    The first realisation chooses order, horizon and method, the others follow it. One
    with gaps is several experiments.
    """
    if hasattr(local, "fit_each") and all(len(runs) == 1 for runs in realisations):
        whole = [run for runs in realisations for run in runs]
        return _fit_table(local, whole, sampling_time, "fit_each")
    first = _fit_local(local, realisations[0], sampling_time)
    chosen = clone(local)
    for name in ("order", "horizon", "method", "input_delay"):
        if name in chosen.get_params() and hasattr(first, name + "_"):
            chosen.set_params(**{name: getattr(first, name + "_")})
    others = [_fit_local(chosen, runs, sampling_time) for runs in realisations[1:]]
    return [first, *others]


def _fit_local(
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


def _fit_table(
    local: Any, experiments: Sequence[Experiment], sampling_time: float, method: str
) -> Any:
    """What a clone's method of fitting returns for the experiments as one table."""
    u = np.vstack([e.inputs for e in experiments])
    y = np.vstack([e.outputs for e in experiments if e.outputs is not None])
    label = np.repeat(np.arange(len(experiments)), [len(e.rows) for e in experiments])
    names = _column_names(experiments[0].input_names, u.shape[1])
    table = pd.DataFrame(np.column_stack([u, label]), columns=names)
    own: dict[str, Any] = {
        **dict.fromkeys(ROLES),
        "inputs": names[:-1],
        "experiment": names[-1],
        "sampling_time": sampling_time,
    }
    estimator = clone(local)
    known = estimator.get_params(deep=False)
    estimator.set_params(**{name: own[name] for name in own if name in known})
    return getattr(estimator, method)(table, y)


def _column_names(inputs: Sequence[Hashable], n_inputs: int) -> list[str]:
    """Names of the inputs as the user knows them, and of a column of labels."""
    names = [str(name) for name in inputs or range(n_inputs)]
    label = "experiment"
    while label in names:
        label += "_"
    return [*names, label]


def _average(models: Sequence[StateSpace]) -> StateSpace:
    """Average balanced models of one order, state signs aligned to the first."""
    aligned = [with_signs_of(models[0], model) for model in models]
    A, B, C, D = (np.mean([getattr(m, M) for m in aligned], axis=0) for M in "ABCD")
    return StateSpace(A, B, C, D, input_delay=models[0].input_delay)


def _bare(experiment: Experiment) -> Experiment:
    """An experiment without its place in the table."""
    return replace(
        experiment,
        rows=np.broadcast_to(np.intp(0), len(experiment.rows)),
        scheduling=None,
        operating_point=None,
    )


def _look_at_outputs(experiments: Sequence[Experiment]) -> str:
    """What to try first if the model turns out unstable: offsets make it so."""
    outputs = np.vstack([e.outputs for e in experiments if e.outputs is not None])
    if len(outputs) > len(experiments) and not np.ptp(outputs, axis=0).any():
        raise ValueError(
            f"An output must vary. Got {outputs[0].tolist()} throughout: no dynamics "
            "can be identified from it."
        )
    inputs = np.vstack([e.inputs for e in experiments])
    far = [
        (name, place)
        for name, place, values in (("outputs", "y", outputs), ("inputs", "X", inputs))
        if (np.abs(values.mean(axis=0)) > _OFFSET * values.std(axis=0)).any()
    ]
    if not far:
        return "Try "
    names, places = (" and ".join(words) for words in zip(*far, strict=True))
    return (
        f"The {names} stand far from zero: subtract their value at rest from {places} "
        "(a simulation begins there), or let the local models find a constant: "
        "local=SubspaceLTI(offset='auto'). Else try "
    )


def _continuous(model: StateSpace, discretization: str, advice: str) -> StateSpace:
    with collected():  # said below
        lti = model.to_continuous(discretization)
    if not lti.is_stable:
        worst = lti.poles()[np.argmax(lti.poles().real)]
        advice = _integrating_outputs(lti) + advice
        raise ValueError(
            f"the local model must be stable. Got a pole at {worst:.4g} 1/s. {advice}"
            "local=SubspaceLTI(stability='enforce'), another `order`, a longer "
            "`horizon` or more data, or leave the point out by on_error='skip'."
        )
    if lti.order > model.order:
        poles = model.poles()
        poles = poles[(poles.real < 0) & (poles.imag == 0)].real
        warn(
            f"the identified model of order {model.order} has "
            f"{lti.order - model.order} pole(s) on the negative real axis "
            f"({', '.join(f'{p:.3g}' for p in poles)}), as no continuous-time model of "
            "that order has: what becomes of the point is the nearest one. A shorter "
            "sampling time or a lower `order` avoids it."
        )
    return lti.balance()


def _integrating_outputs(lti: StateSpace) -> str:
    """Which outputs integrate, where the only pole that does not decay is about zero.

    It is that of the outputs that show it.
    """
    poles, V = np.linalg.eig(lti.A)
    i = int(np.argmax(poles.real))
    others = np.delete(np.abs(poles), i)
    if poles[i].imag or abs(poles[i]) > _STANDING * others.min(initial=np.inf):
        return ""
    seen = np.abs(lti.C @ V[:, i].real)
    places = np.flatnonzero(seen > _STANDING * seen.max()).tolist()
    return (
        f"If outputs {places} integrate, as a position does, name them: "
        f"local=SubspaceLTI(integrating={places}) identifies their rates. "
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
            f"{_label(row)}: {', '.join(map(str, own))}"
            for row, own in zip(kappa, samples.tolist(), strict=True)
        )
        taken = ", ".join(map(str, np.round(median / sampling_time).astype(int)))
        warn(
            "the input delay differs between operating points (scheduling: samples of "
            f"each input; {each}). The LPV model takes the median, {taken}; the local "
            "models keep their own. Where the system has one delay, give it: "
            "local=SubspaceLTI(input_delay=...)."
        )
    return median


def _horizon(fitted: Any) -> int | None:
    horizon = getattr(fitted, "horizon_", None)
    return None if horizon is None else int(horizon)


# -- step 4: all of them in one structure ----------------------------------------------


class StructuredModels(NamedTuple):
    """Models of one structure at the operating points that did not fail."""

    points: OperatingPoints
    local: list[LocalModel]  # the black boxes
    structure: GrayBoxStructure
    theta: Array  # (n_points, n_params), parameters
    covariance: Array  # (n_points, n_params, n_params): NaN where not known
    models: list[StateSpace]
    restructurers: list[Any]  # fitted; empty without that step


def restructure_points(
    restructurer: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    runner: PointRunner,
    max_time: float | None = None,
) -> StructuredModels:
    """Bring the local models of all operating points into one structure.

    "aligned" or "passthrough": the entries of the balanced models are parameters.
    `max_time` bounds the seconds of all points: equal shares, known in advance, and
    what is left of it for the help of neighbours.
    """
    began = perf_counter()
    if isinstance(restructurer, str):
        # poles on the negative real axis make the order grow in continuous time
        models = [
            model.lti.balance(min(model.order, model.lti.order)) for model in local
        ]
        kappa = points.kappa if restructurer == "aligned" else None
        structure, theta = balanced_entries(models, kappa)
        balanced = [
            structure.model(row).with_input_delay(model.input_delay)
            for row, model in zip(theta, models, strict=True)
        ]
        unknown = _unknown_covariance(theta)
        return StructuredModels(points, local, structure, theta, unknown, balanced, [])
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
    found = runner.run(
        "restructuring",
        _restructure_point,
        tasks,
        points.kappa,
        restructurer=restructurer,
    )
    kept = [k for k, done in enumerate(found) if done is not None]
    first = [done.result for done in found if done is not None]
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
    _tell(found, points.kappa)
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
    _tell(tied, points.kappa)
    for k, other in enumerate(tied):
        if other is not None:
            helped[k] = other.result
            covariances[k] = _covariance(helped[k], local[k], runner)
    theta = np.array([fitted.params_ for fitted in helped])
    covariance = _unknown_covariance(theta)
    for P, known in zip(covariance, covariances, strict=True):
        if known is not None:
            P[:] = known
    models = [fitted.lti_ for fitted in helped]
    return StructuredModels(
        points, local, helped[0].structure_, theta, covariance, models, helped
    )


def offsets_of_points(found: StructuredModels) -> Array | None:
    """``[u0, y0, x0]`` of every point, as `LPVStateSpace` has them; None for none."""
    if not any(model.n_trend and model.rest for model in found.local):
        return None
    runs = [run for group in found.points.experiments for run in group]
    (u, u_scale), (y, y_scale) = motions(runs)
    rest = [model.rest or (np.zeros_like(u), np.zeros_like(y)) for model in found.local]
    inputs, outputs = (np.array(values) for values in zip(*rest, strict=True))
    scales = (u_scale, y_scale)
    return points_of_work(found.models, found.points.kappa, inputs, outputs, scales)


def _covariance(fitted: Any, model: LocalModel, runner: PointRunner) -> Array | None:
    """Covariance of the parameters at a point, None where it is not known."""
    known = getattr(fitted, "params_covariance_", None)  # where it tells its own
    if known is None and model.deviated:
        known = runner.call(
            covariance_of_parameters,
            fitted.structure_,
            fitted.params_,
            getattr(fitted, "frequency_weight", None),
            model.lti,
            model.deviated,
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
    first = local[0].lti
    form = GrayBoxStructure.observable_canonical(
        orders[0],
        first.n_inputs,
        first.n_outputs,
        orders[0] == 0 or any(model.lti.D.any() for model in local),
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
    *,
    restructurer: Any,
    **options: Any,
) -> Any:
    """A clone of the restructurer, fitted to one local model."""
    restructurer = clone(restructurer)
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
    span = np.ptp(kappa, axis=0)
    scaled = kappa / np.where(span > 0, span, 1.0)
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
    for doubt in doubts:
        names = ", ".join(structure.parameter_names[j] for j in doubt.params)
        warn(
            f"the parameters {names} may have changed places at "
            f"{_place(doubt.point, kappa)}: several values give the same response, and "
            "those that continue the other points most smoothly are only "
            f"{100 * doubt.probability:.0f} % likely to be the right ones. Between the "
            "points the LPV model may be wrong. Add operating points near it, or tell "
            "the parts apart by structure.with_bounds()."
        )
    return tied


def covariance_of_parameters(
    structure: GrayBoxStructure,
    theta: Array,
    weight: Any,
    model: StateSpace,
    deviated: Sequence[ModelPair],
) -> Array:
    """Covariance of gray-box parameters from that of the black box `model`.

    The deviations of the response (`deviated_models`) are carried to the parameters to
    first order, as the least-squares fit of the response does. `weight` is the
    `frequency_weight` of `GrayBoxRestructurer`.
    """
    problem = problem_from_models(structure, [model], weight)
    response = problem.response_of
    changes = [response(above) - response(below) for above, below in deviated]
    T = problem.parameter_changes(theta, np.array(changes)) / (2.0 * DEVIATION)
    return T.T @ T


def balanced_entries(
    models: Sequence[StateSpace], kappa: Array | None = None
) -> tuple[GrayBoxStructure, Array]:
    """The entries of balanced models as parameters. Orders must agree.

    Aligned with one another over `kappa`; without it their signs only, along the
    points: the baseline of the paper, of no common state basis.
    """
    orders = sorted({model.order for model in models})
    if len(orders) > 1:
        raise ValueError(
            "Without a structure the matrices are interpolated, which needs local "
            f"models of one order. Got orders {orders}. Fix the order: "
            "local=SubspaceLTI(order=...)."
        )
    if kappa is not None:
        models = aligned_models(models, kappa)
    else:
        models = list(accumulate(models, with_signs_of))
    first = models[0]
    direct = any(model.D.any() for model in models)
    sizes = (orders[0], first.n_inputs, first.n_outputs)
    structure = GrayBoxStructure.full(*sizes, feedthrough=direct)
    names = "ABCD" if direct else "ABC"
    rows = [np.concatenate([getattr(m, M).ravel() for M in names]) for m in models]
    return structure, np.array(rows)


# -- any step: processes, progress, failures, memory -----------------------------------


@dataclass(frozen=True)
class PointRunner:
    """How a step is applied to the operating points."""

    n_jobs: int | None  # points worked on at the same time
    verbose: int  # 1 shows a progress bar
    on_error: str  # "raise" or "skip": whether a point that fails stops the others
    memory: Memory  # where results are kept; without a location, nowhere

    def run(
        self,
        what: str,
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        kappa: Array,
        **shared: Any,
    ) -> list[Done | None]:
        """Results of a step at every operating point; None where it failed and may.

        What the points warn of comes with them: given at once, warnings would tear
        the progress bar, name no point, and be lost in other processes.

        The function takes the arguments of a point and the shared keywords; the memory
        knows its results by the values of all of them. `what` labels the progress bar.
        A failure names the point (by `kappa`), unless another one fails in the same
        words: the cause is an option then.
        """
        return self.start(what, function, arguments, kappa, **shared)()

    def start(
        self,
        what: str,
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        kappa: Array,
        **shared: Any,
    ) -> Callable[[], list[Done | None]]:
        """As `run`, whose results a call of what is returned waits for.

        Other processes are at work in the meantime.
        """
        kept = self._remembered(function)
        stop = self.on_error == "raise"
        tasks = (
            delayed(_attempt)(kept, args, shared, k if stop else None)
            for k, args in enumerate(arguments)
        )
        results = results_of(tasks, self.n_jobs)

        def again(k: int) -> Any:
            return _attempt(kept, arguments[k], shared, None)

        return lambda: self._wait(results, what, kappa, again)

    def _wait(
        self, results: Any, what: str, kappa: Array, again: Callable[[int], Any]
    ) -> list[Done | None]:
        if self.verbose:
            from tqdm import tqdm  # slow to import

            results = tqdm(results, desc=what, total=len(kappa))
        found: list[Done | _Failure] = []
        try:
            found.extend(results)
        except _Stopped as stopped:
            k, error, told = stopped.args
            if self.verbose:
                results.close()  # or the warnings would stand in the bar's line
            _tell([*_done(found[:k]), Done(None, told)], kappa)
            # The point, or an option? A neighbour (the last for the first) tells.
            other = again(k - 1)
            if isinstance(other, _Failure) and other.text == str(error):
                raise ValueError(str(error)) from error
            skip = "" if "on_error" in str(error) else _SKIP
            raise ValueError(f"{_place(k, kappa)}: {error}{skip}") from error
        failures = {k: r for k, r in enumerate(found) if isinstance(r, _Failure)}
        if len(failures) == len(found):
            first = failures[0]
            if all(failure.text == first.text for failure in failures.values()):
                raise ValueError(first.text) from first.error
            raise ValueError(
                f"{what}: every operating point failed. First {_place(0, kappa)}: "
                f"{first.text}"
            ) from first.error
        for k, failure in failures.items():
            warn(f"left out {_place(k, kappa)}: {failure.text}")
        return _done(found)

    def call(
        self, function: Callable[..., Any], *args: Any, ignore: Sequence[str] = ()
    ) -> Any:
        """Call a function at the top of a module, or take its result from the memory.

        The arguments to `ignore` follow from the others and do not tell results apart.
        """
        return self._remembered(function, ignore)(*args)

    def _remembered(
        self, function: Callable[..., Any], ignore: Sequence[str] = ()
    ) -> Callable[..., Any]:
        if hasattr(self.memory, "store_backend"):
            return Remembered(function, self.memory.store_backend, tuple(ignore))
        # An object with the interface of joblib.Memory: its own affair.
        return self.memory.cache(function, ignore=list(ignore))


class Done(NamedTuple):
    """The result of a step at a point, and what was told on the way."""

    result: Any
    told: list[Told]


@dataclass(frozen=True)
class _Failure:
    """Why a point failed."""

    error: Exception

    @property
    def text(self) -> str:
        return str(self.error)


class _Stopped(Exception):
    """A failure that ends the step: number of the point, error, what was told."""


def _attempt(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    shared: dict[str, Any],
    stop_as: int | None,
) -> Any:
    """Run a step at one operating point; `stop_as` is its number if it must succeed."""
    told: list[Told] = []
    try:
        with _ONE_BLAS_THREAD, collected() as told:
            return Done(function(*args, **shared), told)
    except (ValueError, np.linalg.LinAlgError) as error:
        if stop_as is not None:
            raise _Stopped(stop_as, error, told) from error
        return _Failure(error)  # told by the runner, who knows the other points


class _OneBlasThread:
    """One thread of BLAS as long as any thread of the process is within.

    Their number is that of the process: the first one in sets it, and the last one out
    puts it back.
    """

    def __init__(self) -> None:
        self._lock, self._n_within = threading.Lock(), 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._n_within:
                self._limit = _blas().limit(limits=1, user_api="blas")
                self._limit.__enter__()
            self._n_within += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._n_within -= 1
            if not self._n_within:
                self._limit.__exit__(*error)


_ONE_BLAS_THREAD = _OneBlasThread()


@cache
def _blas() -> ThreadpoolController:
    """Found once in every process: the search takes longer than a small step."""
    return ThreadpoolController()


def _done(found: Sequence[Done | _Failure]) -> list[Done | None]:
    return [result if isinstance(result, Done) else None for result in found]


def _tell(found: Sequence[Done | None], kappa: Array) -> None:
    """Give the warnings of all points: each once, with the points that it came from."""
    where: dict[Told, list[int]] = {}
    for k, done in enumerate(found):
        for told in dict.fromkeys(done.told if done is not None else ()):
            where.setdefault(told, []).append(k)
    for (message, category), points in where.items():
        place = "all operating points"
        if len(points) < len(kappa):
            place = ", ".join(_place(k, kappa) for k in points)
        warn(message if len(kappa) == 1 else f"{message} (At {place}.)", category)


def _place(number: int, kappa: Array) -> str:
    return f"operating point {number} (scheduling {_label(kappa[number])})"


def _label(kappa: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in kappa)
