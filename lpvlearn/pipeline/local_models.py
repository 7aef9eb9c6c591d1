"""Step 3: the experiments of every operating point to a continuous-time model."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.base import clone

from ..data.columns import ROLES
from ..data.experiments import Experiment
from ..data.operating_points import OperatingPoints
from ..exceptions import warn
from ..models.statespace import StateSpace
from ..restructuring.minimise_covariance import Estimate
from ..structures.structure import GrayBoxStructure
from ..subspace.noise_weights import noise_weighted
from ..subspace.statistics import ModelPair, deviated_models
from ..systems.balancing import align_signs
from .runner import PointRunner

Array = NDArray[np.float64]

# Mean of an output in standard deviations, from which it looks like an offset (a record
# that rises steadily from rest has a mean of 1.7).
_OFFSET = 5.0


@dataclass(frozen=True)
class LocalModel:
    """The black-box model of one operating point.

    Attributes
    ----------
    lti : StateSpace
        Continuous time, balanced.
    order : int
        As identified, in discrete time.
    horizon : int or None
        Horizon of the subspace step, where the estimator tells it.
    realizations : list of StateSpace
        Models that were averaged; none after a pooled fit.
    deviated : list of (StateSpace, StateSpace)
        Continuous-time models to either side of a pooled fit, as `deviated_models`
        has them.
    estimates : list of (StateSpace, list of (StateSpace, StateSpace))
        The model as identified (of every realization), and models to either side of it;
        none where the covariance is not known. With "zoh" in discrete time.
    """

    lti: StateSpace
    order: int
    horizon: int | None
    realizations: list[StateSpace] = field(default_factory=list)
    deviated: list[ModelPair] = field(default_factory=list)
    estimates: list[Estimate] = field(default_factory=list)


def identify_points(
    local: Any,
    points: OperatingPoints,
    runner: PointRunner,
    *,
    structure: GrayBoxStructure | None,
    **options: Any,
) -> tuple[list[LocalModel], OperatingPoints]:
    """Identify the local models of all operating points.

    Parameters
    ----------
    local : estimator
        As in `identify_point`.
    points : OperatingPoints
    runner : PointRunner
    structure : GrayBoxStructure or None
        Its order replaces ``order="auto"`` of the local estimator. Without one, "auto"
        becomes the highest order that a point takes.
    **options
        As in `identify_point`.

    Returns
    -------
    models : list of LocalModel
    points : OperatingPoints
        Those that did not fail.
    """
    chooses = _has_auto_order(local)
    if chooses and isinstance(structure, GrayBoxStructure):
        local = clone(local).set_params(order=structure.order)
    # Where a record stood in the table does not matter: splits share their results.
    groups = [[_bare(e) for e in group] for group in points.experiments]

    def identify(estimator: Any) -> list[LocalModel | None]:
        arguments = [(estimator, group) for group in groups]
        return runner.run(
            "local models", identify_point, arguments, points.kappa, **options
        )

    found = identify(local)
    orders = {model.order for model in found if model is not None}
    if chooses and structure is None and len(orders) > 1:
        found = identify(clone(local).set_params(order=max(orders)))
    kept = [k for k, model in enumerate(found) if model is not None]
    return [model for model in found if model is not None], points.keep(kept)


def identify_point(
    local: Any,
    experiments: Sequence[Experiment],
    *,
    sampling_time: float,
    combine: str,
    discretization: str,
    efficient: bool = False,
) -> LocalModel:
    """Identify the local model of one operating point.

    Parameters
    ----------
    local : estimator
        Like `SubspaceLTI`: fitted, it has `lti_`, a discrete-time StateSpace. It is
        cloned.
    experiments : sequence of Experiment
        The realisations of this operating point.
    combine : {"pool", "average"}
        One fit of all experiments, or one model each, balanced, signs aligned, and the
        matrices averaged (the paper's Monte Carlo).
    discretization : {"zoh", "tustin"}
    efficient : bool
        Whether to weigh the outputs by their noise, and to give `estimates`.

    Raises
    ------
    ValueError
        If no output varies, or the identified model is unstable, so that it cannot be
        balanced.
    """
    advice = _look_at_outputs(experiments)
    labels = list(dict.fromkeys(e.label for e in experiments))
    if combine == "pool" or len(labels) == 1:
        fitted = _fit_local(local, experiments, sampling_time)
        model, pairs = _estimate(fitted, experiments, efficient)
        lti = _continuous(model, discretization, advice)
        found = LocalModel(
            lti,
            fitted.lti_.order,
            _horizon(fitted),
            deviated=_all_continuous(pairs, discretization),
        )
        if efficient and pairs:
            found.estimates.append(_in_own_time(model, pairs, discretization))
        return found
    # The first realisation chooses order and horizon, the others follow it.
    # A realisation with gaps is several experiments of one label.
    realisations = [[e for e in experiments if e.label == label] for label in labels]
    fitted = _fit_local(local, realisations[0], sampling_time)
    chosen = clone(local)
    for name in ("order", "horizon"):
        if name in chosen.get_params() and hasattr(fitted, name + "_"):
            chosen.set_params(**{name: getattr(fitted, name + "_")})
    models, failures = [], []
    estimates: list[Estimate] = []
    for realisation in realisations:
        refitted = _fit_local(chosen, realisation, sampling_time)
        model, pairs = refitted.lti_, []
        if efficient:
            model, pairs = _estimate(refitted, realisation, efficient)
        try:
            models.append(_continuous(model, discretization, advice))
            estimates.append(_in_own_time(model, pairs, discretization))
        except ValueError as error:
            failures.append((realisation[0].label, error))
    if not models:
        raise failures[0][1]
    if failures:
        warn(
            f"{len(failures)} of {len(labels)} realisations were left out of the "
            f"average; the first, {failures[0][0]!r}: {failures[0][1]}"
        )
    lowest = min(model.order for model in models)  # where none grew
    models = [model for model in models if model.order == lowest]
    known = all(pairs for _, pairs in estimates)
    return LocalModel(
        _average(models),
        fitted.lti_.order,
        _horizon(fitted),
        models,
        estimates=estimates if known else [],
    )


def _estimate(
    fitted: Any, experiments: Sequence[Experiment], efficient: bool
) -> tuple[StateSpace, list[ModelPair]]:
    """The model, its outputs weighed by their noise if so wished, and its pairs."""
    samples = [(e.inputs, e.outputs) for e in experiments if e.outputs is not None]
    model, scale = fitted.lti_, None
    detrend = getattr(fitted, "detrend", None)
    refined = getattr(fitted, "refine", False) and not fitted.stability_loss_
    if refined and efficient:
        model, scale = noise_weighted(model, samples, detrend=detrend)
    return model, deviated_models(
        model,
        samples,
        lambda other: other,
        detrend=detrend,
        refined=refined,
        output_scale=scale,
    )


def _in_own_time(
    model: StateSpace, pairs: list[ModelPair], method: str
) -> tuple[StateSpace, list[ModelPair]]:
    """In discrete time where inputs are held, else as the continuous-time model."""
    if method == "zoh":
        return model, pairs
    return model.to_continuous(method), _all_continuous(pairs, method)


def _all_continuous(pairs: list[ModelPair], method: str) -> list[ModelPair]:
    with warnings.catch_warnings():  # the estimate's own conversion says it once
        warnings.simplefilter("ignore")
        return [(a.to_continuous(method), b.to_continuous(method)) for a, b in pairs]


def _fit_local(
    local: Any, experiments: Sequence[Experiment], sampling_time: float
) -> Any:
    """A clone of the local estimator, fitted on the experiments as one table."""
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
    fitted = estimator.fit(table, y)
    if not isinstance(getattr(fitted, "lti_", None), StateSpace):
        raise ValueError(
            "`local` must be an estimator that identifies a StateSpace model, its "
            f"attribute `lti_`, as SubspaceLTI does. Got {type(local).__name__}."
        )
    return fitted


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
    return StateSpace(*(np.mean([getattr(m, M) for m in aligned], 0) for M in "ABCD"))


def with_signs_of(reference: StateSpace, model: StateSpace) -> StateSpace:
    """A balanced model with the signs of its states turned to those of another."""
    s = align_signs(model.B, model.C, reference.B, reference.C)
    return StateSpace(
        s[:, None] * model.A * s, s[:, None] * model.B, model.C * s, model.D
    )


def _has_auto_order(local: Any) -> bool:
    order = local.get_params(deep=False).get("order")
    return isinstance(order, str) and order == "auto"


def _bare(experiment: Experiment) -> Experiment:
    """An experiment without its place in the table."""
    return replace(
        experiment,
        rows=np.arange(len(experiment.rows)),
        scheduling=None,
        operating_point=None,
    )


def _look_at_outputs(experiments: Sequence[Experiment]) -> str:
    """What to try first if the model turns out unstable."""
    outputs = np.vstack([e.outputs for e in experiments if e.outputs is not None])
    spread = outputs.std(axis=0)
    if len(outputs) > len(experiments) and not np.ptp(outputs, axis=0).any():
        raise ValueError(
            f"An output must vary. Got {outputs[0].tolist()} throughout: no dynamics "
            "can be identified from it."
        )
    if (np.abs(outputs.mean(axis=0)) > _OFFSET * spread).any():
        return (
            "The outputs stand far from zero: subtract their value at rest from y (a "
            "simulation begins there). Else try "
        )
    return "Try "


def _continuous(model: StateSpace, discretization: str, advice: str) -> StateSpace:
    with warnings.catch_warnings():  # said below, at this point
        warnings.filterwarnings("ignore", ".*negative real axis", RuntimeWarning)
        lti = model.to_continuous(discretization)
    if not lti.is_stable:
        worst = lti.poles()[np.argmax(lti.poles().real)]
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


def _horizon(fitted: Any) -> int | None:
    horizon = getattr(fitted, "horizon_", None)
    return None if horizon is None else int(horizon)
