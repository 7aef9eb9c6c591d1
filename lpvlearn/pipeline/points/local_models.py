"""Step 3 at an operating point: a black box, in continuous time.

The experiments of the point make one model, or one each; these are averaged then.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import ROLES, Experiment, as_table
from ...data.preparation import DETRENDS
from ...exceptions import Told, collected, retold, take_back, warn
from ...lpv.alignment import rotations_to
from ...models.statespace import (
    ModelPair,
    StateSpace,
    balanced_models,
    forgetting,
    scaled,
)
from ...restructuring.minimise_covariance import Estimate
from ...subspace.diagnosis.fit_warnings import OF_LASTING
from ...subspace.estimator import SubspaceLTI
from ...subspace.evidence.constants import CERTAIN
from ...subspace.fits.integrating import integrating_flags
from ...subspace.telling import unheard
from ...systems.modes import lasting, n_changes

Array = NDArray[np.float64]

# Mean of an output in standard deviations, from which it looks like an offset (a record
# that rises steadily from rest has a mean of 1.7).
_OFFSET = 5.0

_FAR = 5.0  # from the mean of the outputs, in their motion: not where they rest

# Standard deviation of the constants of experiments at a point, in those of outputs,
# that a user should know of.
_APART = 0.1

# A pole that much slower than the others is an integrator, and an output shows it by
# more than that part of the output that does most.
_STANDING = 0.05

_ABOUT_ZERO = 0.25  # of the others: it may be one, known by samples that are not many
_NOTHING = 1e-6  # share by which what does not decay, to rounding, may do so or grow
HARDLY = 0.05  # share by which an integrator may decay, or grow, in a record
_GROWN = 3.0  # time constants per record, up to which one that grows may be one

# What fits experiments as methods do that take a table.
_OF_READ = {"fit": "fit_experiments", "fit_each": "fit_each_experiment"}

ALTERNATES = "alternates"  # the kind of a warning, of poles on the negative real axis

# States that a disturbance may have beside those of a structure: two resonances, or a
# resonance and two drifts.
_OF_LOADS = 4

# Decrease of the criterion from which they are taken: below it they were not better.
_LIKELIER = 10.0


class Advice(NamedTuple):
    """What to do about a model that grows."""

    first: str = "Try "
    of_rates: bool = False  # whose outputs are named
    in_loop: bool = False

    def text(self, named: str) -> str:
        """With what is advised for outputs that integrate, `named`."""
        held, enforced = "", "stability='enforce', "
        if self.in_loop:  # as no plant is that only its controller holds
            enforced = ""
            held = (
                "If only its controller holds the plant, identify the closed loop, "
                "with the controller's reference as input and the controller in the "
                "structure. "
            )
        return (
            f"{named}{held}{self.first}local=SubspaceLTI(offset='linear') if the "
            f"outputs drift, {enforced}another `order`, a longer `horizon` or more "
            "data, or leave the point out by on_error='skip'."
        )


_TWICE = Advice(
    "Where rates integrate as well, as the velocity of what nothing holds, have a "
    "structure say so: restructurer=GrayBoxRestructurer(structure) with zeros in its "
    "A. Else try ",
    of_rates=True,
)


@dataclass(frozen=True)
class LocalModel:
    """The black-box model of one operating point."""

    lti: StateSpace  # continuous time, balanced
    order: int  # as identified, in discrete time
    horizon: int | None  # of the subspace step, where the estimator tells it
    method: str | None = None  # of identification, where the estimator tells it
    costs: dict[int, float] = field(default_factory=dict)  # of orders, by the criterion
    realizations: list[StateSpace] = field(default_factory=list)  # what was averaged
    # to either side of it, as identified
    pairs: list[ModelPair] = field(default_factory=list)
    discretization: str = "zoh"
    integrating: list[int] = field(default_factory=list)  # outputs, by place
    n_trend: int = 0  # 1: a constant of every output and experiment, 2: and a drift
    lasts: bool = False  # whether a mode does not decay over the longest experiment
    criterion: float = np.nan  # as `SubspaceLTI.criterion`, where that is told
    # inputs and outputs at rest, near the experiments; None: not looked for
    rest: tuple[Array, Array] | None = None
    # that of the order that its record takes, where it is not the one of all points
    own: LocalModel | None = None
    # the model as identified (of every realization) with models to either side of it,
    # where the covariance is known; with "zoh" in discrete time
    estimates: list[Estimate] = field(default_factory=list)

    @property
    def hold(self) -> str:
        """What inputs do between samples, as `LPVStateSpace` has it."""
        return "foh" if self.discretization == "foh" else "zoh"

    @property
    def order_of_rates(self) -> int:
        """As the estimator counts, without integrators."""
        return self.order - len(self.integrating)

    def deviated(self) -> list[ModelPair]:
        """The pairs in continuous time; none where one of them has no equivalent.

        Few ask for them: the covariance of most parameters comes from `estimates`.
        """
        try:
            return _all_continuous(self.pairs, self.discretization)
        except ValueError:
            return []


def identify_point(
    local: Any,
    experiments: Sequence[Experiment],
    *,
    sampling_time: float,
    combine: str,
    discretization: str,
    efficient: bool = False,
    deviate: bool = True,
    most: bool = False,
    n_at_zero: int = 0,
) -> LocalModel:
    """Identify the local model of one operating point by a clone of `local`.

    Fitted, it has `lti_`, a discrete-time StateSpace. `combine` is "pool", one fit of
    all experiments, or "average": one model each, balanced, signs aligned, and the
    matrices averaged (the paper's Monte Carlo). Refuses outputs that do not vary, and
    an unstable model, which cannot be balanced. `efficient` gives `estimates`,
    `deviate` the `pairs` of a pooled one, which these need. The order may be the `most`
    that there can be: a pooled model then leaves out states that the samples do not ask
    for, where they alternate. In a loop those of a disturbance come to it. So many
    poles are known to be `n_at_zero`: estimates of these may grow.
    """
    if integrates(local) and combine == "average":
        raise ValueError(
            "`combine` must be 'pool' for a local estimator with `integrating`: models "
            "with integrators cannot be balanced. Got 'average'."
        )
    advice = _look_at_outputs(experiments, local)
    rate = 1.0 / (sampling_time * max(len(e.inputs) for e in experiments))
    labels = labels_of(experiments)
    if combine == "average" and len(labels) > 1:
        runs = [[e for e in experiments if e.label == label] for label in labels]
        alike = _fit_alike_at_most if most else _fit_alike
        each = zip(labels, alike(local, runs, sampling_time), strict=True)
        known = experiments, discretization, advice, efficient
        none_at_zero = AboutZero(0, rate)  # what grows cannot be balanced
        return _averaged(dict(each), *known, none_at_zero)
    fit = _fit_at_most if most else _fit_local
    pooled = fit(local, experiments, sampling_time)
    about_zero = AboutZero(n_at_zero, rate)
    return _pooled(
        pooled, experiments, discretization, advice, efficient, about_zero, deviate
    )


def unheard_model(
    local: Any, experiments: Sequence[Experiment], **options: Any
) -> StateSpace:
    """That of `identify_point`, of samples of which all is told by another fit."""
    with unheard():
        return identify_point(local, experiments, **options).lti


def _pooled(
    fitted: Any,
    experiments: Sequence[Experiment],
    discretization: str,
    advice: Advice,
    efficient: bool,
    about_zero: AboutZero,
    deviate: bool,
) -> LocalModel:
    """That of one fit of all experiments of a point; options as in `identify_point`."""
    pairs = _deviated(fitted) if deviate else []
    if _from_closed_loop(fitted):
        advice = advice._replace(in_loop=True)
    rates = getattr(fitted, "rates_", None)
    if rates is None:
        lti = _continuous(fitted.lti_, discretization, advice, about_zero)
        lti = lti.balance() if lti.is_stable else lti
        if about_zero.are_all_that_last(lti.poles()):
            for kind in OF_LASTING:
                take_back(kind)
    else:  # stable but for the integrators, of which an output may have two
        twice = AboutZero(rates.lti_.n_outputs, HARDLY * about_zero.rate)
        growth = _continuous(rates.lti_, discretization, _TWICE, twice).poles().real
        with collected():  # said of the rates
            lti = fitted.lti_.to_continuous(discretization)
        if growth.max(initial=-np.inf) >= 0.0:
            slower = growth.max() + _NOTHING * about_zero.rate
            lti = _with_slower_rates(lti, len(_integrating(fitted)), slower)
    found = LocalModel(
        lti,
        **_told_by(fitted, experiments),
        pairs=pairs,
        discretization=discretization,
        integrating=_integrating(fitted),
        n_trend=_n_trend(fitted),
        lasts=_lasts(fitted, experiments),
        criterion=_criterion(fitted),
        rest=_equilibrium(lti, [fitted], experiments),
    )
    if efficient and pairs:
        found.estimates.append(_in_own_time(fitted.lti_, pairs, discretization))
    return found


def _averaged(
    fitted: Mapping[Hashable, Any],
    experiments: Sequence[Experiment],
    discretization: str,
    advice: Advice,
    efficient: bool,
    about_zero: AboutZero,
) -> LocalModel:
    """The mean of fits of the realisations of a point, by label.

    Those without a stable model are left out, with a warning.
    """
    models, failures = [], []
    kept: list[Any] = []
    estimates: list[Estimate] = []
    for label, own in fitted.items():
        if not kept and _from_closed_loop(own):
            advice = advice._replace(in_loop=True)
        model, pairs = own.lti_, _deviated(own) if efficient else []
        try:
            models.append(_continuous(model, discretization, advice, about_zero))
            estimates.append(_in_own_time(model, pairs, discretization))
            kept.append(own)
        except ValueError as error:
            failures.append((label, error))
    if not models:
        raise failures[0][1]
    if failures:
        warn(
            f"{len(failures)} of {len(fitted)} realisations were left out of the "
            f"average; the first, {failures[0][0]!r}: {failures[0][1]}"
        )
    known = all(pairs for _, pairs in estimates)
    first = [e for e in experiments if e.label == next(iter(fitted))]
    models = _in_one_basis(models, experiments)
    lti = _average(models)
    return LocalModel(
        lti,
        **_told_by(kept[0], first),
        realizations=models,
        discretization=discretization,
        estimates=estimates if known else [],
        n_trend=max(map(_n_trend, kept)),
        rest=_equilibrium(lti, kept, experiments),
    )


def as_ramps(
    model: LocalModel, experiments: Sequence[Experiment], sampling_time: float
) -> LocalModel:
    """The model whose inputs are ramps between samples, of one for held inputs.

    Raises a ValueError where it has no equivalent.
    """
    estimates: list[Estimate] = []
    for held, pairs in model.estimates:
        either = [(_answering(one), _answering(other)) for one, other in pairs]
        continuous = _answering(held).to_continuous("foh")
        estimates.append((continuous, _all_continuous(either, "foh")))
    models = [estimate for estimate, _ in estimates]
    if not models:  # the uncertainty is not known
        known = model.realizations or [model.lti]
        sampled = [_answering(m.to_discrete(sampling_time)) for m in known]
        models = [m.to_continuous("foh") for m in sampled]
    if len(models) > 1:
        models = _in_one_basis(models, experiments)
        lti = _average(models)
    else:
        (lti,), models = models, []
        lti = lti.balance() if lti.is_stable else lti
    return replace(
        model, lti=lti, realizations=models, estimates=estimates, discretization="foh"
    )


def _answering(model: StateSpace) -> StateSpace:
    """The same model, whose inputs are answered at once after their delays.

    As ramps are: a delay ends a sample later than one of held inputs. With
    ``q (q I - A)^-1 = I + (q I - A)^-1 A`` it has ``A b``, and ``C b`` for d, of them.
    """
    late = (model.input_delay > 0) & ~model.D.any(axis=0)
    if not late.any():
        return model
    B = np.where(late, model.A @ model.B, model.B)
    D = model.D + late * (model.C @ model.B)
    names = model.input_names, model.output_names, model.units
    delay = model.input_delay + late
    return StateSpace(model.A, B, model.C, D, model.sampling_time, delay, *names)


def _told_by(fitted: Any, experiments: Sequence[Experiment]) -> dict[str, Any]:
    """What an estimator chose for experiments, as a `LocalModel` has it."""
    return {
        "order": fitted.lti_.order,
        "horizon": getattr(fitted, "horizon_", None),
        "method": getattr(fitted, "method_", None),
        "costs": _costs(fitted, experiments),
    }


def experiments_of(u: Array, y: Array, sampling_time: float) -> list[Experiment]:
    """Experiments of one length, (n_experiments, n_samples, n_channels) each."""
    rows = np.arange(u.shape[1])
    return [
        Experiment(k, rows, *pair, sampling_time=sampling_time)
        for k, pair in enumerate(zip(u, y, strict=True))
    ]


def labels_of(experiments: Sequence[Experiment]) -> list[Hashable]:
    return list(dict.fromkeys(e.label for e in experiments))


def is_left(local: Any, name: str) -> bool:
    """Whether an estimator is to choose an option itself ("auto")."""
    value = local.get_params(deep=False).get(name)
    return isinstance(value, str) and value == "auto"


def integrates(local: Any) -> bool:
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


def _lasts(fitted: Any, experiments: Sequence[Experiment]) -> bool:
    """Whether a mode does not decay over the longest experiment; integrators apart."""
    rates = getattr(fitted, "rates_", None)
    lti = fitted.lti_ if rates is None else rates.lti_
    longest = max(len(e.inputs) for e in experiments)
    return bool(lasting(lti.poles(), longest).any())


def _criterion(fitted: Any) -> float:
    """That of the model of an estimator that tells it, else NaN."""
    told = getattr(fitted, "criterion", None)
    return np.nan if told is None else told()


def _equilibrium(
    lti: StateSpace, fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> tuple[Array, Array] | None:
    """Inputs and outputs at which the model rests, nearest to the experiments' means.

    Where these have drifts: as they begin, from which what drifts goes away. In units
    of how far they move within the experiments; where the experiments begin nearest to
    rest if a mode does not decay over them, which rests nearly anywhere, but for one
    that stands for constants and would have that far from all outputs. None where the
    estimator has not looked for constants, or does not tell.
    """
    first = fitted[0]
    looked = getattr(first, "offset", None) or getattr(first, "detrend", None)
    if not looked or not hasattr(first, "resting_point"):
        return None
    known = [own.resting_point(begun=True) for own in fitted]
    u0, y0 = (np.mean(values, axis=0) for values in zip(*known, strict=True))
    if integrates(first):
        begun = _beginning(fitted)
        return None if first.offset_ is None and not begun.any() else (u0, y0 + begun)
    longest = max(len(e.inputs) for e in experiments)
    (u, u_scale), (y, y_scale) = motions(_without_drifts(fitted, experiments))
    gain = lti.dc_gain()
    if n_changes(first.lti_.A, longest) < 1.0:
        far = np.abs(y0 - y) > _FAR * y_scale
        if not (far.any() and np.isfinite(gain).all()):
            return u0, y0
    _tell_different_constants(lti, fitted, experiments)
    step, *_ = np.linalg.lstsq(
        np.vstack([np.diag(1.0 / u_scale), gain / y_scale[:, None]]),
        np.concatenate([(u - u0) / u_scale, (y - y0) / y_scale]),
    )
    return u0 + step, y0 + gain @ step


def _beginning(fitted: Sequence[Any]) -> Array:
    """Where outputs that integrate begin, mean of all; zero where that is near rest."""
    states = [own.begun_state_ for own in fitted]
    outputs = [
        own.lti_.C @ (np.zeros(own.order_) if x is None else x)
        for own, x in zip(fitted, states, strict=True)
    ]
    flags = np.isin(np.arange(len(outputs[0])), _integrating(fitted[0]))
    return np.where(flags, np.mean(outputs, axis=0), 0.0)


def _without_drifts(
    fitted: Sequence[Any], experiments: Sequence[Experiment]
) -> Sequence[Experiment]:
    """The experiments without what their outputs drift from the beginning on."""
    drifts = np.vstack([own.output_drift_ for own in fitted])  # per second
    if not drifts.any() or len(drifts) != len(experiments):
        return experiments
    per_sample = drifts * fitted[0].lti_.sampling_time
    return [
        replace(e, outputs=e.measured - np.arange(len(e.inputs))[:, None] * drift)
        for e, drift in zip(experiments, per_sample, strict=True)
    ]


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
    found = []
    for values in zip(*((e.inputs, e.outputs) for e in experiments), strict=True):
        mean, variance = _moments(values, about_own=True)
        found.append((mean, np.where(variance > 0, np.sqrt(variance), 1.0)))
    return found[0], found[1]


def channel_sizes(groups: Sequence[Sequence[Experiment]]) -> tuple[Array, Array]:
    """How far inputs and outputs move at the points, root mean squares of all."""
    both = zip(*(motions(group) for group in groups), strict=True)
    u, y = (np.sqrt(np.mean([std**2 for _, std in one], axis=0)) for one in both)
    return u, y


def _moments(values: Sequence[Any], *, about_own: bool) -> tuple[Array, Array]:
    """Mean and variance of channels, NaN left out, about the mean of each part or all.

    Zero where nothing is known.
    """
    counts = [np.count_nonzero(~np.isnan(v), axis=0) for v in values]
    sums = [np.nansum(v, axis=0) for v in values]
    n = np.maximum(np.sum(counts, axis=0), 1)
    mean = np.sum(sums, axis=0) / n
    centres = [mean for _ in values]
    if about_own:
        centres = [s / np.maximum(k, 1) for s, k in zip(sums, counts, strict=True)]
    squares = [
        np.nansum((v - centre) ** 2, axis=0)
        for v, centre in zip(values, centres, strict=True)
    ]
    return mean, np.sum(squares, axis=0) / n


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
    alike = hasattr(local, "fit_each") and not estimates_outputs(local)
    if alike and all(len(runs) == 1 for runs in realisations):
        whole = [run for runs in realisations for run in runs]
        return _fit_table(local, whole, sampling_time, "fit_each")
    first = _fit_local(local, realisations[0], sampling_time)
    chosen = clone(local)
    for name in ("order", "horizon", "method", "input_delay"):
        if name in chosen.get_params() and hasattr(first, name + "_"):
            chosen.set_params(**{name: getattr(first, name + "_")})
    others = [_fit_local(chosen, runs, sampling_time) for runs in realisations[1:]]
    return [first, *others]


def estimates_outputs(local: Any) -> bool:
    """Whether a local estimator takes outputs of which some are missing."""
    return getattr(local, "missing", None) == "estimate"


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


def _fit_at_most(
    local: Any, experiments: Sequence[Experiment], sampling_time: float
) -> Any:
    """The same with more states in a loop, where these are those of a disturbance.

    And with fewer ones where some of them alternate, and are not asked for: no system
    in continuous time has a pole on the negative real axis, and a state more than the
    samples show follows their noise there.
    """
    with retold() as told:
        fitted = _fit_local(local, experiments, sampling_time)
        if _from_closed_loop(fitted):
            likelier = _fit_with_loads(local, fitted, experiments, sampling_time)
            if likelier is not None:
                fitted, told[:] = likelier
        n_alternating = len(_alternating(fitted.lti_))
        if not n_alternating:
            return fitted
        highest = fitted.order_ - len(_integrating(fitted))
        fewer = range(max(1, highest - n_alternating), highest + 1)
        with collected() as other, suppress(ValueError):
            again = clone(local).set_params(order=fewer)
            again = _fit_local(again, experiments, sampling_time)
            if again.order_ < fitted.order_ and not len(_alternating(again.lti_)):
                told[:] = other
                return again
        return fitted


def _fit_alike_at_most(
    local: Any, realisations: Sequence[Sequence[Experiment]], sampling_time: float
) -> list[Any]:
    """As `_fit_alike`, with the states of a disturbance that the first one shows."""
    with retold() as told:
        fitted = _fit_alike(local, realisations, sampling_time)
        if not _from_closed_loop(fitted[0]):
            return fitted
        # one tells of all: beyond chance
        likelier = _fit_with_loads(
            local, fitted[0], realisations[0], sampling_time, asked=CERTAIN
        )
        if likelier is None:
            return fitted
        told.clear()
        order = likelier[0].order_ - len(_integrating(likelier[0]))
        more = clone(local).set_params(order=order)
        return _fit_alike(more, realisations, sampling_time)


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
        other = _fit_local(more, experiments, sampling_time)
        known, its = (_criterion(getattr(f, "rates_", f)) for f in (fitted, other))
        grows = fitted.lti_.is_stable and not other.lti_.is_stable
        if other.order_ > fitted.order_ and its < known - asked and not grows:
            return other, told
    return None


def _alternating(model: StateSpace) -> Array:
    """Poles on the negative real axis, of a model in discrete time."""
    poles = model.poles()
    return np.asarray(poles.real[(poles.real < 0.0) & (poles.imag == 0.0)])


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


def _of_lowest_order(models: Sequence[StateSpace]) -> list[StateSpace]:
    lowest = min(model.order for model in models)
    return [model for model in models if model.order == lowest]


def _in_one_basis(
    models: Sequence[StateSpace], experiments: Sequence[Experiment]
) -> list[StateSpace]:
    """Balanced models of one order, each turned to be nearest to the first.

    By signals of about unit size: balancing, and what is near, depend on units. Signs
    alone would not do where singular values are nearly equal, whose states may be
    turned.
    """
    u, y = _sizes(experiments)
    models = _of_lowest_order(models)  # where none grew
    models = balanced_models([scaled(model, u, y) for model in models])
    first, *others = _of_lowest_order(models)  # nor lost what is rounding
    turns = rotations_to(others, first)
    turned = [first, *(m.transform(T.T) for m, T in zip(others, turns, strict=True))]
    return [scaled(model, 1.0 / u, 1.0 / y) for model in turned]


def balanced_by_motion(
    model: StateSpace, experiments: Sequence[Experiment], order: int | None = None
) -> StateSpace:
    """The model balanced for signals of about unit size; as it is where it grows.

    With as many states as `order` at most.
    """
    if not model.is_stable:
        return model
    u, y = _sizes(experiments)
    return scaled(scaled(model, u, y).balance(order), 1.0 / u, 1.0 / y)


def _sizes(experiments: Sequence[Experiment]) -> tuple[Array, Array]:
    """How far inputs and outputs move, about.

    Powers of two: no rounding, and the same wherever in memory the samples are.
    """
    u, y = (np.exp2(np.rint(np.log2(size))) for _, size in motions(experiments))
    return u, y


def _average(models: Sequence[StateSpace]) -> StateSpace:
    """The mean of the matrices of models in one basis."""
    A, B, C, D = (np.mean([getattr(m, M) for m in models], axis=0) for M in "ABCD")
    mean = StateSpace(A, B, C, D, input_delay=models[0].input_delay)
    return mean.balance() if mean.is_stable else mean


def _far_from_zero(records: Sequence[Array]) -> bool:
    """Whether a channel stands far from zero, as to how it moves over all records."""
    mean, variance = _moments(records, about_own=False)
    return bool((np.abs(mean) > _OFFSET * np.sqrt(variance)).any())


def _look_at_outputs(experiments: Sequence[Experiment], local: Any) -> Advice:
    """What to try first if the model turns out unstable: offsets make it so.

    But for those that the estimator finds itself.
    """
    inputs = [e.inputs for e in experiments]
    outputs = [e.measured for e in experiments]
    still = all((y == outputs[0][0]).all() for y in outputs)
    if sum(map(len, outputs)) > len(experiments) and still:
        raise ValueError(
            f"An output must vary. Got {outputs[0][0].tolist()} throughout: no "
            "dynamics can be identified from it."
        )
    far = [
        (name, place)
        for name, place, values in (("outputs", "y", outputs), ("inputs", "X", inputs))
        if _far_from_zero(values)
    ]
    if not far or local.get_params(deep=False).get("offset") is not None:
        return Advice()
    names, places = (" and ".join(words) for words in zip(*far, strict=True))
    return Advice(
        f"The {names} stand far from zero: subtract their value at rest from {places} "
        "(a simulation begins there), or let the local models find a constant: "
        "local=SubspaceLTI(offset='auto'). Else try "
    )


class Integrates(ValueError):
    """A local model is refused, for poles about zero: outputs may integrate."""


class AboutZero(NamedTuple):
    """Poles that are known to be at zero: their number, and how near estimates are."""

    n_poles: int = 0
    rate: float = 0.0  # 1/s

    def others(self, poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Poles of a model without estimates of these."""
        poles = poles[np.argsort(np.abs(poles))]
        far = np.abs(poles) > self.rate
        far[self.n_poles :] = True
        return poles[far]

    def are_all_that_last(self, poles: NDArray[np.complex128]) -> bool:
        """Whether a model has estimates of these, and all others decay."""
        others = self.others(poles)
        return len(others) < len(poles) and bool((others.real < -self.rate).all())


def _continuous(
    model: StateSpace, discretization: str, advice: Advice, about_zero: AboutZero
) -> StateSpace:
    with collected():  # said below
        lti = model.to_continuous(discretization)
    growth = about_zero.others(lti.poles()).real.max(initial=-np.inf)
    if 0.0 <= growth <= _NOTHING * about_zero.rate:
        lti = forgetting(lti, 2.0 * _NOTHING * about_zero.rate)
    elif growth > 0.0:
        worst = lti.poles()[np.argmax(lti.poles().real)]
        named = ""
        if not advice.of_rates:
            named = _integrating_outputs(lti, _GROWN * about_zero.rate)
        raise (Integrates if named else ValueError)(
            f"the local model must be stable. Got a pole at {worst:.4g} 1/s. "
            f"{advice.text(named)}"
        )
    take_back("border")
    if lti.order > model.order:
        poles = _alternating(model)
        warn(
            f"the identified model of order {model.order} has "
            f"{lti.order - model.order} pole(s) on the negative real axis "
            f"({', '.join(f'{p:.3g}' for p in poles)}), as no continuous-time model of "
            "that order has: without a structure what becomes of the point is near it "
            "at low frequencies only. A shorter sampling time or a lower `order` "
            "avoids it.",
            kind=ALTERNATES,
        )
    return lti


def _with_slower_rates(lti: StateSpace, n_integrators: int, rate: float) -> StateSpace:
    """A model whose poles are that much (1/s) lower, but for so many at zero.

    With ``A v = 0`` for as many directions as before.
    """
    kept = np.linalg.svd(lti.A)[2][: lti.order - n_integrators]
    return lti._of(lti.A - rate * kept.T @ kept, lti.B, lti.C, lti.D)


def integrating_places(lti: StateSpace, rate: float) -> list[int]:
    """Which outputs integrate, where slow poles are about zero: within a `rate`, 1/s.

    And nearer to it than all others. They are those of the outputs that show them, two
    of one that integrates twice.
    """
    poles, V = np.linalg.eig(lti.A)
    slow = np.abs(poles) <= rate
    others = np.abs(poles[~slow]).min(initial=np.inf)
    if not slow.any() or np.abs(poles[slow]).max() > _ABOUT_ZERO * others:
        return []
    size = np.linalg.norm(lti.C, axis=1)  # of outputs in any unit
    seen = np.linalg.norm(lti.C @ V[:, slow], axis=1) / np.where(size > 0.0, size, 1.0)
    return np.flatnonzero(seen > _STANDING * seen.max()).tolist()


def _integrating_outputs(lti: StateSpace, rate: float) -> str:
    """What to do about outputs that integrate, if there are any, up to a `rate`."""
    places = integrating_places(lti, rate)
    if not places:
        return ""
    return (
        f"If the outputs at {places} (positions in y) integrate, name them: "
        f"local=SubspaceLTI(integrating={places}) identifies their rates. "
    )


def _integrating(fitted: Any) -> list[int]:
    """Outputs of a fitted estimator that integrate, by their places."""
    if getattr(fitted, "rates_", None) is None:
        return []
    places = range(fitted.lti_.n_outputs)
    return np.flatnonzero(integrating_flags(fitted.integrating, places)).tolist()


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
    if _from_closed_loop(fitted) and len(costs):
        orders = orders - max(0, orders[np.argmin(costs)] - fitted.order_)
    found = zip(orders.tolist(), costs.tolist(), strict=True)
    return {order: cost for order, cost in found if order >= 0}
