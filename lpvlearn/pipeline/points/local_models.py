"""Step 3 at an operating point: a black box, in continuous time.

The experiments of the point make one model, or one each; these are averaged then.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.experiments import Experiment
from ...data.motion import moments, motions
from ...exceptions import collected, take_back, warn
from ...lpv.alignment import rotations_to
from ...models.statespace import ModelPair, StateSpace, balanced_models, scaled
from ...restructuring.minimise_covariance import Estimate
from ...subspace.diagnosis.fit_warnings import OF_LASTING
from ...subspace.telling import unheard
from .continuous_time import (
    HARDLY,
    NOTHING,
    TWICE,
    AboutZero,
    Advice,
    all_continuous,
    continuous,
    in_own_time,
    with_slower_rates,
)
from .fitting import (
    criterion,
    deviated,
    fit_alike,
    fit_alike_at_most,
    fit_at_most,
    fit_local,
    from_closed_loop,
    integrates,
    integrating,
    labels_of,
    lasts,
    n_trend,
    told_by,
)
from .rest import equilibrium

Array = NDArray[np.float64]

# Mean of an output in standard deviations, from which it looks like an offset (a record
# that rises steadily from rest has a mean of 1.7).
_OFFSET = 5.0


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
            return all_continuous(self.pairs, self.discretization)
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
        alike = fit_alike_at_most if most else fit_alike
        each = zip(labels, alike(local, runs, sampling_time), strict=True)
        known = experiments, discretization, advice, efficient
        none_at_zero = AboutZero(0, rate)  # what grows cannot be balanced
        return _averaged(dict(each), *known, none_at_zero)
    fit = fit_at_most if most else fit_local
    pooled = fit(local, experiments, sampling_time)
    about_zero = AboutZero(n_at_zero, rate)
    return _pooled(
        pooled, experiments, discretization, advice, efficient, about_zero, deviate
    )


def experiments_of(u: Array, y: Array, sampling_time: float) -> list[Experiment]:
    """Experiments of one length, (n_experiments, n_samples, n_channels) each."""
    rows = np.arange(u.shape[1])
    return [
        Experiment(k, rows, *pair, sampling_time=sampling_time)
        for k, pair in enumerate(zip(u, y, strict=True))
    ]


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
    pairs = deviated(fitted) if deviate else []
    if from_closed_loop(fitted):
        advice = advice._replace(in_loop=True)
    rates = getattr(fitted, "rates_", None)
    if rates is None:
        lti = continuous(fitted.lti_, discretization, advice, about_zero)
        lti = lti.balance() if lti.is_stable else lti
        if about_zero.are_all_that_last(lti.poles()):
            for kind in OF_LASTING:
                take_back(kind)
    else:  # stable but for the integrators, of which an output may have two
        twice = AboutZero(rates.lti_.n_outputs, HARDLY * about_zero.rate)
        growth = continuous(rates.lti_, discretization, TWICE, twice).poles().real
        with collected():  # said of the rates
            lti = fitted.lti_.to_continuous(discretization)
        if growth.max(initial=-np.inf) >= 0.0:
            slower = growth.max() + NOTHING * about_zero.rate
            lti = with_slower_rates(lti, len(integrating(fitted)), slower)
    found = LocalModel(
        lti,
        **told_by(fitted, experiments),
        pairs=pairs,
        discretization=discretization,
        integrating=integrating(fitted),
        n_trend=n_trend(fitted),
        lasts=lasts(fitted, experiments),
        criterion=criterion(fitted),
        rest=equilibrium(lti, [fitted], experiments),
    )
    if efficient and pairs:
        found.estimates.append(in_own_time(fitted.lti_, pairs, discretization))
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
        if not kept and from_closed_loop(own):
            advice = advice._replace(in_loop=True)
        model, pairs = own.lti_, deviated(own) if efficient else []
        try:
            models.append(continuous(model, discretization, advice, about_zero))
            estimates.append(in_own_time(model, pairs, discretization))
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
        **told_by(kept[0], first),
        realizations=models,
        discretization=discretization,
        estimates=estimates if known else [],
        n_trend=max(map(n_trend, kept)),
        rest=equilibrium(lti, kept, experiments),
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
        estimates.append((continuous, all_continuous(either, "foh")))
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
    u, y = _rounded_sizes(experiments)
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
    u, y = _rounded_sizes(experiments)
    return scaled(scaled(model, u, y).balance(order), 1.0 / u, 1.0 / y)


def _rounded_sizes(experiments: Sequence[Experiment]) -> tuple[Array, Array]:
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
    mean, variance = moments(records, about_own=False)
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
