"""From experiments to everything that `SubspaceLTI` keeps of a fit.

The records are made regular, order and horizon chosen, the model identified
(`fit_pairs`), without constants of the experiments and with them where these matter.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import (
    DETRENDS,
    Pairs,
    Rounded,
    check_excitation,
    far_out,
    independent_inputs,
    remove_trends,
)
from ..exceptions import RankWarning
from ..systems.beginnings import stands
from ..systems.simulation import delayed, lti_response
from .closed_loop import ClosedLoopEvidence, identify_closed_loop
from .criterion import PRICE
from .delay import find_lead, first_samples, longest_delays, with_later_inputs
from .drift import (
    differences,
    drifts,
    may_drift,
    of_levels,
    outlasts,
    settles,
    wanders,
)
from .fit_warnings import (
    Doubt,
    tell,
    tell_of_answers,
    tell_of_feedback,
    tell_of_held_outputs,
    tell_of_limits,
    tell_of_still_outputs,
)
from .held_out import HeldOut, held_out
from .identification import (
    Candidate,
    ScaledRecords,
    Settings,
    centred,
    identify,
    scale_records,
    spectral_radius,
    validate,
)
from .local_fit import LocalFit
from .offsets import (
    ALIKE,
    CERTAIN,
    HARDLY_DECAYS,
    HARDLY_MOVED,
    N_TRENDS,
    attributed,
    constants_matter,
    criterion_in_units,
    follows_means_alone,
    leaves_rounding,
    may_be_better,
    may_have_constants,
    may_have_drift,
    shifts_matter,
    stands_by_chance,
    unmoved_errors,
    with_levels,
    without_slow_modes,
)
from .options import Choices
from .residuals import lacks
from .rounding import rounded_outputs
from .selection import PlantFit, Row, Selection, select
from .shifts import cut_at, find_shifts
from .signals import Record, SharedSignals, output_energy, share_known, shorten
from .simulation_fit import Realization, simulation_errors, with_initial_states
from .statistics import Evidence
from .varx import Feedback, find_feedback

Array = NDArray[np.float64]


# A model of like samples has led into another minimum where the error ends this many
# times as large as theirs; between realizations of noise it varies by a few per cent.
_WORSE = 1.2

# Share of the squared errors that later inputs leave where the outputs lead them; time
# constants per experiment of a mode that may be a line of a reference
_LED, _LINE = 0.1, 3.0

# Share of the outputs' size left unexplained that constants may be the reason of
_HARDLY = 0.4

# Experiments contradict one another where models of each leave less than this share of
# the squared errors of the one for all. That is looked into where it leaves more than
# this share of the outputs' size, for the longest ones, of so many samples a parameter.
_CONTRADICTED, _ROUGH, _MOST_ALONE, _VALUES_EACH = 0.25, 0.1, 6, 10

# Share of the error that is left without samples of inputs that are not answered.
_ANSWERED = 0.6

# Samples of a delay, or states in its place, that are told: fewer cost next to nothing.
# The response of the model comes to half its height within so many times a delay, over
# so many times of which that is looked for, and is not so high yet half the way there.
_LATE, _FEWER = 3, 2
_RISEN, _WHOLE, _EARLY = 4, 20, 0.25

# Lags of a noise that may be more than that of a sensor; samples of which more tell the
# plant without it; share of the outputs' size below which either model is as good.
_LAGS, _PLENTY, _AUDIBLE = 2, 20_000, 0.01

# Share of the squared errors of a plant in a loop that must be left of them for another
# model not to refute it; standard errors by which a lesser one must be better where the
# plant grows; standard deviations by which a pole does so for certain.
_OF_NOISE, _DOUBT, _CERTAIN = 0.5, 2.0, 3.0

# The same of one with D free, where nothing but answers within the sample shows a loop.
_OF_ANSWERS = 0.25

# Share of the squared errors of parts held out that further states leave there where
# they are the plant's.
_FAR_BETTER = 0.5

# Times the squared errors without what inputs do to modes that do not decay, of ones
# that they do not move at all.
_NOT_MOVED = 1.1

# Times the squared errors of free initial states, of rest at the beginning; and the
# least of it that is told from none.
_NOT_FAR_WORSE, _LEAST = 3.0, 1e-30

# Of inputs that only rounding tells apart: times the gain of all others, of a model
# that makes of the ripple what it likes, at these frequencies (rad per sample); and the
# part of the largest ripple from which an input is one of them.
_WILD, _LOOKED_AT, _PART = 10.0, np.geomspace(1e-2, 3.0, 8), 0.05


class TooFewSamples(ValueError):
    """The samples do not tell enough for a model; more of them may."""


def fit_pairs(
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    *,
    detrend: str | None = None,
    names: Sequence[Hashable] | None = None,
    known: LocalFit | None = None,
) -> LocalFit:
    """Check, detrend, choose and identify.

    `told` are the kinds of warnings that were given and are not repeated, `names` those
    of the inputs, for messages; of samples like those of a `known` fit feedback is not
    looked for again. `TooFewSamples` where an input is constant or the samples are too
    few.
    """
    # By channel in memory, as tables are read: sums take a tenth of the time.
    pairs = [(np.asfortranarray(u), np.asfortranarray(y)) for u, y in pairs]
    try:
        check_excitation(pairs, names)
    except ValueError as error:
        raise TooFewSamples(str(error)) from None
    outputs = [y for _, y in pairs]
    if "still" not in told:
        tell_of_still_outputs(outputs, told)
    pairs, u_mean, y_mean = remove_trends(pairs, detrend)
    fitted = _with_constants(pairs, choices, told, known)
    rounded = Rounded.of([u for u, _ in pairs])
    if rounded is not None and _is_wild(fitted, rounded):
        exact = list(zip(rounded.exact, (y for _, y in pairs), strict=True))
        other = _with_constants(exact, choices, told | {"collinear"}, known)
        worse = criterion_in_units(other.evidence.one_step)
        worse -= criterion_in_units(fitted.evidence.one_step)
        if worse < CERTAIN:  # or the ripple is what drives outputs
            _tell_of_rounding(rounded, pairs, told, names)
            pairs, fitted = exact, other
    drifting = _of_drifting_noise(pairs, choices, told, fitted)
    fitted = drifting or fitted
    if fitted.selection.order:
        if "held" not in told:
            tell_of_held_outputs(outputs, told)
        if "limit" not in told:
            tell_of_limits(outputs, fitted, told)
    if len(pairs) > 1 and fitted.residual > _ROUGH and "contradiction" not in told:
        _tell_of_contradiction(pairs, choices, told, fitted)
    if fitted.residual > _ROUGH and "input spikes" not in told:
        _tell_of_input_spikes(pairs, choices, told, fitted)
    # The errors of a rough model are not the noise that shifts must stand out of.
    cuts = choices.offset == "auto" and choices.initial_states and choices.refine
    whole, rest, differ = pairs, None, fitted.offsets.differ
    if cuts and not choices.estimated:
        pairs, fitted = _without_shifts(pairs, choices, told, fitted)
    if not drifting and pairs is whole:
        rest = _at_rest(pairs, choices, told, fitted, known)
    if rest is not None:
        pairs, choices, fitted, first = rest
    doubt = None
    foreseen = fitted.feedback is not None and fitted.feedback.foreseen
    if fitted.method == "pbsid" and (choices.method == "auto" or choices.order is None):
        # Of inputs without anything new a rival makes of many states what it likes.
        if not foreseen:
            fitted, doubt = _believable(pairs, choices, told, fitted)
    elif _may_share_noise(fitted, choices):
        fitted = _with_shared_noise(pairs, choices, told, fitted)
    feedback = fitted.feedback
    if feedback is not None and feedback.found and "feedback" not in told:
        if feedback.shown or not fitted.model.D.any():
            tell_of_feedback(feedback, fitted, choices, doubt, told)
        else:
            tell_of_answers(feedback, told)
        if known is None and not foreseen:
            _tell_of_lead(pairs, choices, told, fitted)
    if rest is not None:
        fitted = _moved_back(fitted, first, differ)
    if detrend is None:
        return fitted
    return fitted._replace(offsets=fitted.offsets.shifted(u_mean, y_mean))


class _AtRest(NamedTuple):
    """A model of experiments that begin at rest, and what it is one of."""

    pairs: Pairs  # inputs less those that the experiments begin with
    choices: Choices
    fitted: LocalFit
    first: Array  # (n_experiments, n_inputs): those inputs


def _at_rest(
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    free: LocalFit,
    known: LocalFit | None,
) -> _AtRest | None:
    """The model of experiments that begin at a stand, if as likely as the `free` one.

    Others that are `known` tell how these begin.
    """
    asked = choices.offset in ("auto", "constant")
    if known is not None:
        asked = not known.evidence.free.initial_states
    asked &= choices.initial_states and not choices.estimated
    if not asked or free.method == "pbsid" or not len(free.model.A):
        return None
    stand, evidence = stands(pairs), free.evidence
    if stand is None:
        return None
    first, at_rest = stand.first, choices._replace(initial_states=False)
    if first.any():  # a level is that of the answer to these
        sure = choices.offset == "constant" or evidence.free.n_trend
        if not sure and not stands_by_chance(evidence.one_step):
            return None  # without a constant it is that to zero
        at_rest = at_rest._replace(offset="constant")
    moved = [(u - level, y) for (u, y), level in zip(pairs, first, strict=True)]
    fitted = _as_likely(moved, at_rest, told, free, stand.seen)
    return None if fitted is None else _AtRest(moved, at_rest, fitted, first)


def _as_likely(
    pairs: Pairs, choices: Choices, told: set[str], free: LocalFit, seen: bool
) -> LocalFit | None:
    """The model from rest, unless that is less likely than `free` initial states.

    These and a constant may balance each other for as long as inputs stand still, and
    leave of the static gain what noise makes of it. Of rest that is not `seen` in the
    outputs, or instead of a drift, likelihood is asked for more. The criterion, to
    which the first errors count little, may be met by noise that takes what states do:
    so the errors themselves must hardly be larger.
    """
    try:
        fitted = _with_constants(pairs, choices, told, free)
    except TooFewSamples:
        return None
    own, other = fitted.evidence, free.evidence
    by_chance, drifts_off = stands_by_chance(other.one_step), other.free.n_trend > 1
    rate = 1.0 - spectral_radius(own.model.A)
    settles = rate * own.longest > (HARDLY_DECAYS if drifts_off else 1.0)
    if not (len(own.model.A) and settles):
        return None
    left, plainly = _plain_errors(own, other)
    worse = criterion_in_units(own.one_step) - criterion_in_units(other.one_step)
    most = CERTAIN if by_chance else ALIKE
    if not worse <= most * ((seen and not drifts_off) or left < 1.0):
        return None
    if by_chance:
        return fitted if left < _NOT_FAR_WORSE else None
    order = len(other.model.A)
    allowed = ALIKE + PRICE * order * len(pairs)
    if plainly > allowed and len(own.model.A) < order:  # a state is missing, not rest
        as_many, _ = _of_order(pairs, choices, told, order, fitted, own.free.n_trend)
        left, plainly = _plain_errors(as_many.evidence, other)
    return fitted if plainly <= allowed else None


def _plain_errors(own: Evidence, other: Evidence) -> tuple[float, float]:
    """Squared errors of simulation by another's; and how much less likely they are.

    Twice the logarithm of that, as of fewer values that are white: by how much errors
    of the other correlate with those a sample before.
    """
    errors, others = (
        np.vstack(simulation_errors(e.model, e.records)) * e.output_scale
        for e in (own, other)
    )
    ratios, unlikely = [], 0.0
    for e, before in zip(errors.T, others.T, strict=True):
        squares = float(before @ before)
        if squares > 0.0:
            ratios.append(max(float(e @ e) / squares, _LEAST))
            r = min(max(float(before[1:] @ before[:-1]) / squares, 0.0), 1.0)
            unlikely += len(before) * (1.0 - r) / (1.0 + r) * np.log(ratios[-1])
    return float(np.mean(ratios or [1.0])), float(unlikely)


def _moved_back(fitted: LocalFit, first: Array, differ: bool) -> LocalFit:
    """The model of inputs as they are, from that of inputs less the first ones.

    Whether constants `differ` was told without these.
    """
    offsets = fitted.offsets.shifted(first, np.zeros(1))
    gain = fitted.evidence.state_space(fitted.model, 1.0).dc_gain()
    constants = offsets.constants - first @ gain.T
    offsets = offsets._replace(constants=constants, differ=differ)
    return fitted._replace(offsets=offsets)


def _with_constants(
    pairs: Pairs, choices: Choices, told: set[str], known: LocalFit | None
) -> LocalFit:
    """Choose and identify, with constants of the experiments where these matter."""
    n_trend = N_TRENDS[choices.offset]
    # The errors of a rough model are not the noise that constants must stand out of.
    rough = choices.offset == "auto" and choices.refine is False
    judged = choices._replace(refine="simulation") if rough else choices
    fitted = _fit(pairs, judged, told, n_trend, known)
    # A slow mode of the noise, which outputs drive, stands for constants only too well;
    # so does one of a model that has to start at rest. In the errors of a poor model of
    # a given order nothing stands out.
    hides = fitted.method == "pbsid" or not choices.initial_states
    hides |= choices.order is not None and fitted.residual > _HARDLY
    tested = fitted.evidence.one_step
    stands = choices.offset == "auto" and stands_by_chance(tested)

    def may_matter() -> bool:
        if hides or stands:
            return True
        return may_have_constants(tested) and _is_worth_a_choice(
            lambda near: may_be_better(tested, near.evidence),
            *(pairs, judged, told, fitted, 1),
        )

    refused = np.inf
    if choices.offset == "auto" and may_matter():
        other = _fit(pairs, judged, told, 1, fitted)
        order = len(fitted.model.A)
        if stands and len(other.model.A) > order:
            as_many, worse = _of_order(pairs, judged, told, order, other, 1)
            other = as_many if worse < 0.0 else other
        if constants_matter(tested, other.evidence.one_step):
            fitted, n_trend = other, 1
        elif choices.order is not None:  # a poor model shows many things
            refused = criterion_in_units(other.evidence.one_step)
    # The states of a given order that are to follow a drift are missing elsewhere.
    given = choices.order is not None and choices.initial_states and n_trend < 2
    given &= fitted.method != "pbsid" and not choices.enforce_stability
    lost = given and (outlasts(fitted) or fitted.residual > _HARDLY)
    shown = choices.order is None and not hides and not rough
    if choices.offset == "auto" and (
        lost or (shown and _may_drift_off(pairs, judged, told, fitted))
    ):
        fitted = _with_drifts(pairs, judged, told, fitted, refused)
        n_trend = fitted.evidence.free.n_trend
    return _fit(pairs, choices, told, n_trend, fitted) if rough else fitted


def _may_drift_off(
    pairs: Pairs, choices: Choices, told: set[str], fitted: LocalFit
) -> bool:
    """Whether to try drifts, of a model whose errors or modes may hide them."""
    tested = fitted.evidence.one_step
    if not (may_have_drift(tested) or wanders(tested)):
        return False
    # Errors that are rounding go with the inputs, slowly.
    if rounded_outputs(tested.model, tested.records).repeated.any():
        return False
    most = criterion_in_units(tested) + CERTAIN
    return _is_worth_a_choice(
        lambda near: criterion_in_units(near.evidence) < most,
        *(pairs, choices, told, fitted, 2),
    )


def _with_drifts(
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    fitted: LocalFit,
    refused: float = np.inf,
) -> LocalFit:
    """The model with drifts, or offsets of inputs that are integrated, if that is it.

    Of equals the model is taken which needs no mode that inputs do not move: it stands
    for an offset of theirs, or for a drift. Else drifts must be beyond doubt: noise may
    be as slow. The criterion of a model that was `refused` is to be met as well.
    """
    tested = fitted.evidence.one_step
    if leaves_rounding(tested):
        return fitted
    try:
        other = _fit(pairs, choices, told, 2, fitted)
    except TooFewSamples:
        return fitted
    before = min(criterion_in_units(tested), refused)
    better = before - criterion_in_units(other.evidence.one_step)
    spared = len(fitted.model.A) - len(other.model.A)
    drifting = other.offsets.drifts.any()
    simpler = not outlasts(other) if drifting else spared >= 0
    if choices.order is not None:
        least = CERTAIN
    elif not drifting:
        least = -ALIKE if spared else ALIKE
    elif (unmoved := unmoved_errors(tested)) < _NOT_MOVED:
        least = -ALIKE
    else:
        least = ALIKE if unmoved < HARDLY_MOVED else CERTAIN
    if not (simpler and better > least):
        return fitted
    if drifting and _takes_a_gain(fitted.evidence, other.evidence):
        return fitted
    if spared < 0 and choices.order is None:
        # What more states gain is no drift.
        order, n_trend = len(other.model.A), fitted.evidence.free.n_trend
        level, worse = _of_order(pairs, choices, told, order, other, n_trend)
        if not worse > least:
            return level
    return other


def _takes_a_gain(without: Evidence, other: Evidence) -> bool:
    """Whether drifts stand for what inputs do slowly: static gains are lost to them."""
    before, after = without.static_gain(), other.static_gain()
    if before is None or after is None:
        return False
    return bool((after.unknown & ~before.unknown).any())


def _of_order(
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    order: int,
    other: LocalFit,
    n_trend: int,
) -> tuple[LocalFit, float]:
    """The model of the samples of that order, with these trends.

    And by how much its criterion is worse than that of the `other`, whose choice of the
    order it keeps.
    """
    found = _fit(pairs, choices._replace(order=order), told, n_trend)
    worse = criterion_in_units(found.evidence.one_step)
    worse -= criterion_in_units(other.evidence.one_step)
    return found._replace(selection=found.selection.among(other.selection)), worse


def _is_worth_a_choice(
    promising: Callable[[LocalFit], bool],
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    fitted: LocalFit,
    n_trend: int,
) -> bool:
    """Whether to choose among all orders again, with other trends or of differences.

    That takes as long as the first choice. Few steps lead from the model found to one
    of its order, and to those without each one of the modes that may be constants:
    unless these tell nothing of other orders, one of them must be promising.
    """
    evidence, horizon = fitted.evidence, fitted.selection.horizon
    others = without_slow_modes(evidence)
    if others is None or not evidence.refined:
        return True
    free = evidence.free._replace(n_trend=n_trend)
    told = told | {"collinear"}

    def near(A: Array, C: Array) -> LocalFit:
        model = evidence.model._replace(A=A, C=C, blocks=None)
        start = fitted._replace(
            evidence=replace(evidence, model=model, free=free),
            selection=Selection(len(A), horizon, []),
            residual=np.inf,  # whatever comes of it
        )
        same = choices._replace(order=len(A), horizon=horizon, refine="prediction")
        return _fit(pairs, same._replace(method=fitted.method), told, n_trend, start)

    try:
        own = evidence.model.A, evidence.model.C
        return any(promising(near(A, C)) for A, C in [own, *others])
    except TooFewSamples:  # for that horizon
        return True


def _of_drifting_noise(
    pairs: Pairs, choices: Choices, told: set[str], whole: LocalFit
) -> LocalFit | None:
    """The model by differences of all samples; None where their noise does not drift.

    Or that of samples with as many states, where its noise does not. Where a
    controller answers the outputs, its inputs follow the drift as well.
    """
    weighed = choices.refine in ("auto", "prediction") and not choices.estimated
    if whole.method == "pbsid" or not weighed or not choices.initial_states:
        return None
    if whole.feedback is None or whole.feedback.found or whole.stability_loss:
        return None
    if not may_drift(whole):
        return None
    innovations = whole.feedback.innovations
    same = choices._replace(method=whole.method, differences=True)
    n_trend = whole.evidence.free.n_trend
    moved, n_left = differences(pairs), max(n_trend - 1, 0)
    if choices.offset == "auto":  # where drift begins is anywhere
        n_trend = max(n_trend, 1)

    def may_be_better_so(near: LocalFit) -> bool:
        return drifts(whole, _of_samples(pairs, choices, near, n_trend), CERTAIN)

    # From a model whose noise is slow, steps on differences may lead astray.
    if not wanders(whole.evidence) and not _is_worth_a_choice(
        may_be_better_so, moved, same, told, whole, n_left
    ):
        return None
    try:
        found = _fit(moved, same, set(told), n_left)
    except TooFewSamples:
        return None
    if found.stability_loss:
        return None
    other = _of_samples(pairs, choices, found, n_trend)
    feedback = find_feedback(other.scaled.records)
    if feedback is None or feedback.found:
        return None
    other = other._replace(feedback=feedback)
    if not drifts(whole, other):
        return None
    if lacks(whole.evidence, innovations) or lacks(
        other.evidence, feedback.innovations
    ):
        return None  # errors that inputs explain are no drift
    order = len(other.model.A)
    level, worse = _of_order(pairs, choices, told, order, other, n_trend)
    if worse < ALIKE and settles(level, other):
        return level
    held_out = found.selection.held_out
    if held_out is not None:  # its errors, by those of all differences
        share = held_out.residual / found.residual
        held_out = held_out._replace(residual=share * other.residual)
        selection = replace(found.selection, held_out=held_out)
        other = other._replace(selection=selection)
    return other


def _of_samples(
    pairs: Pairs, choices: Choices, found: LocalFit, n_trend: int
) -> LocalFit:
    """The model that was `found` of the differences of samples as one of these."""
    moved, centres = centred(pairs, n_trend, choices.initial_states)
    moved = [(u @ found.evidence.basis, y) for u, y in moved]
    scaled = scale_records(moved, n_trend)
    evidence = of_levels(found.evidence, scaled, n_trend)
    evidence, offsets = with_levels(evidence, attributed(evidence, centres, pairs))
    energy = output_energy(evidence.records) or 1.0
    return found._replace(
        model=evidence.model,
        residual=float(np.sqrt(evidence.model.loss / energy)),
        evidence=evidence,
        offsets=offsets,
        first_model=evidence.model,
        scaled=scaled,
    )


def _tell_of_contradiction(
    pairs: Pairs, choices: Choices, told: set[str], whole: LocalFit
) -> None:
    """Tell of experiments that one model cannot explain, and models of each do."""
    free, same = whole.evidence.free, whole.chosen(choices)
    records, model = whole.scaled.records, whole.evidence.model
    if whole.method == "pbsid" or choices.estimated or len(records) != len(pairs):
        return
    n_values = model.C.size + model.B.size + np.count_nonzero(free.direct)
    least = _VALUES_EACH * (n_values + len(model.A))
    lengths = np.array([record.y.size for record in records])
    some = [
        k
        for k in np.argsort(-lengths)[:_MOST_ALONE]
        if lengths[k] >= least and np.ptp(pairs[k][0], axis=0).all()  # inputs move
    ]
    found = simulation_errors(with_initial_states(model, records, free), records)
    energies = []
    for k in some:
        try:
            other = _fit([pairs[k]], same, told | {"collinear"}, free.n_trend, whole)
        except TooFewSamples:
            continue
        own = other.scaled.records
        scale = other.evidence.output_scale / whole.evidence.output_scale
        errors = simulation_errors(other.evidence.model, own)[0] * scale
        size = np.sum(records[k].y ** 2)
        energies.append([np.sum(found[k] ** 2), np.sum(errors**2), size])
    if len(energies) < 2:
        return
    together, apart, size = np.sum(energies, axis=0)
    if apart < _CONTRADICTED * together:
        left, alone = 100.0 * np.sqrt([together / size, apart / size])
        tell(
            told,
            "contradiction",
            "The experiments contradict one another: of their outputs one model leaves "
            f"{left:.2g} %, models of each alone leave {max(alone, 0.01):.2g} %. The "
            "system was not the same in them (a load, a setting, the sign of a "
            "sensor), or it is not linear. Check them, give what differs as a "
            "scheduling variable, or leave out those that do not belong here.",
        )


def _tell_of_input_spikes(
    pairs: Pairs, choices: Choices, told: set[str], whole: LocalFit
) -> None:
    """Tell of single samples of an input that the outputs do not answer."""
    without, found = [], []
    for k, (u, y) in enumerate(pairs):
        spikes = far_out(u)
        u = u.copy()
        for i, j in np.argwhere(spikes):
            u[i, j] = 0.5 * (u[i - 1, j] + u[i + 1, j])
            found.append((j, k, i))
        without.append((u, y))
    if not found:
        return
    n_trend = whole.evidence.free.n_trend
    try:
        other = _fit(without, whole.chosen(choices), set(told), n_trend)
    except TooFewSamples:
        return
    if other.residual < _ANSWERED * whole.residual:
        j, k, i = found[0]
        where = f"sample {i}{f' of experiment {k}' if len(pairs) > 1 else ''}"
        tell(
            told,
            "input spikes",
            f"{len(found)} sample(s) of the inputs stand far out, and the outputs do "
            f"not answer them; the first is {where} of input {j + 1}, counted from 0. "
            f"With what their neighbours have in their place a model leaves "
            f"{100.0 * other.residual:.2g} % of the outputs, not "
            f"{100.0 * whole.residual:.2g} %. If they were logged wrongly, replace "
            "them by NaN and use missing='split', or by what was sent.",
        )


def tell_of_delay(
    pairs: Pairs, choices: Choices, told: set[str], whole: LocalFit
) -> None:
    """Tell of inputs that arrive late, where no delay was asked for.

    Each sample of a delay takes a state, or blurs the response. The first answer that
    is certain may come later than the input arrives: with that much delay a model must
    simulate parts held out clearly better, or no worse with fewer states.
    """
    if whole.method == "pbsid" or choices.estimated or "delay" in told:
        return
    pairs = first_samples(pairs)
    channels = pairs[0][1].shape[1], pairs[0][0].shape[1]
    direct = np.broadcast_to(choices.feedthrough, channels)
    delay = longest_delays(pairs, np.any(direct, axis=0))
    cut = int(delay.max())
    # A model that lacks something tells nothing of how the plant begins to answer.
    if cut < _LATE or not ("lack" in told or _answers_late(whole, cut)):
        return
    n_trend = whole.evidence.free.n_trend
    given = choices._replace(method=whole.method, offset=DETRENDS[n_trend])
    known = slice(cut if choices.initial_states else 0, None)  # from rest, all are
    pairs = [(u, y) for u, y in pairs if len(u) > cut + 1]
    late = [(delayed(u, delay)[known], y[known]) for u, y in pairs]
    early = [(u[known], y[known]) for u, y in pairs]
    try:
        other = _fit(late, given, set(told), n_trend)
        first = _fit(early, whole.chosen(choices), set(told), n_trend)
    except TooFewSamples:
        return
    error, found = _held_out(first, given), _held_out(other, given)
    if [p.error.shape for p in error.parts] != [p.error.shape for p in found.parts]:
        return  # late inputs move in other parts
    n_saved = first.selection.order - other.selection.order
    better = n_saved >= _FEWER and not error.clearly_better_than(found, 0.0)
    if not better and not found.clearly_better_than(error, _DOUBT):
        return
    orders = other.selection.order, first.selection.order
    if better:
        what = f"does as well on parts held out as this one of order {orders[1]}"
    else:
        what = (
            f"simulates {found.bft:.3g} % of parts held out, this one {error.bft:.3g} %"
        )
    tell(
        told,
        "delay",
        f"Input {int(delay.argmax()) + 1} shows in the outputs only after {cut} "
        "samples, for certain. With a delay in their place a model of order "
        f"{orders[0]} {what}. Use input_delay='auto', which takes those that are a "
        f"delay beyond doubt, or give it: {cut} at most.",
    )


def _answers_late(fitted: LocalFit, delay: int) -> bool:
    """Whether the impulse response of a model may be that of a delay.

    Of a slow system the first samples are as small, beside what comes later.
    """
    A, B, C, D = fitted.model[:4]
    impulse = np.zeros((_WHOLE * delay + 1, 1))
    impulse[0] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        heights = np.column_stack(
            [
                np.abs(lti_response(A, B[:, [j]], C, D[:, [j]], impulse)).max(axis=1)
                for j in range(B.shape[1])
            ]
        )
    if not np.isfinite(heights).all():
        return False
    heights = heights / np.maximum(heights.max(axis=0), np.finfo(float).tiny)
    late = (heights[: delay // 2 + 1] < _EARLY).all(axis=0)
    return bool((late & (heights[: _RISEN * delay] > 0.5).any(axis=0)).any())


def _without_shifts(
    pairs: Pairs, choices: Choices, told: set[str], whole: LocalFit
) -> tuple[Pairs, LocalFit]:
    """Cut the experiments where levels shift, if that explains them clearly better.

    One step ahead, where noise alone explains all that moves slowly: parts that leave
    inputs nothing to explain, or models of a given order, whose errors may be its lack
    of states, must simulate as much of what is held out as the whole.
    Short ones hide in their initial states that a mode would grow.
    """
    feedback = whole.feedback
    if feedback is None:
        return pairs, whole
    shifts = find_shifts(whole.scaled.records, feedback.regression)
    if not any(shifts):
        return pairs, whole
    parts = cut_at(pairs, shifts)
    rests = np.all([np.ptp(u, axis=0) == 0.0 for u, _ in parts], axis=0)
    if rests.any():  # an input tells nothing of any part: its step made the shift
        return pairs, whole
    try:
        fitted = _fit(parts, choices, told, 1, whole)
    except TooFewSamples:
        return pairs, whole
    if not shifts_matter(whole.evidence.one_step, fitted.evidence.one_step):
        return pairs, whole
    if fitted.grows() and not whole.grows():
        return pairs, whole
    given = choices.order is not None
    if whole.selection.order and (given or not fitted.selection.order):
        if _held_out(fitted, choices).bft < _held_out(whole, choices).bft:
            return pairs, whole
    samples = "; ".join(
        f"{', '.join(map(str, cuts))}{f' of experiment {k}' if len(pairs) > 1 else ''}"
        for k, cuts in enumerate(shifts)
        if cuts
    )
    tell(
        told,
        "shifts",
        f"The outputs shift at sample(s) {samples}, counted from 0, by what the inputs "
        "do not explain: a load came or went, a sensor moved, or the system is not "
        "linear. What lies between was fitted as experiments of their own, each with "
        "its constant (`output_offset_`). Give a load that you know as an input; "
        "offset='constant' or None fits the whole.",
    )
    return parts, fitted


def _fit(
    pairs: Pairs,
    choices: Choices,
    told: set[str],
    n_trend: int,
    known: LocalFit | None = None,
) -> LocalFit:
    """Choose and identify, with `n_trend` trends of every output and experiment.

    What is `known` of the same samples with other trends, or of others like them, is
    the feedback, whose test gives every experiment a constant.
    """
    n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
    order, horizon = choices.order, choices.horizon
    whole, (pairs, centres) = pairs, centred(pairs, n_trend, choices.initial_states)
    try:
        pairs, basis = _with_independent_inputs(pairs, told)
        settings = choices.settings(n_outputs, n_inputs, basis, n_trend)
        if settings.method != "pbsid":
            settings.check_size([len(u) for u, _ in pairs], order, horizon)
    except ValueError as error:
        raise TooFewSamples(str(error)) from None
    scaled = scale_records(pairs, n_trend, choices.estimated)
    feedback = find_feedback(scaled.records) if known is None else known.feedback
    settings = _heed(feedback, settings, choices.feedthrough is True)
    if settings.method == "pbsid":
        try:
            plant = identify_closed_loop(scaled, basis, order, horizon, settings)
            found = plant.selection.order
            if order is None and found not in (settings.orders or [found]):
                # a state too few spoils the plant, one too many costs little
                enough = (n for n in settings.orders if n > found)
                order = min(enough, default=settings.orders[-1])
                plant = identify_closed_loop(scaled, basis, order, horizon, settings)
        except ValueError as error:
            raise TooFewSamples(str(error)) from None
    else:
        plant = _identify_open_loop(scaled, basis, order, horizon, settings, known)
    offsets = attributed(plant.evidence, centres, whole)
    evidence, offsets = with_levels(plant.evidence, offsets)
    residual = plant.residual
    if choices.estimated:
        residual = _residual_of_known(evidence, settings.method, residual)
    return LocalFit(
        evidence.model,
        plant.singular_values,
        residual,
        plant.stability_loss,
        plant.selection,
        evidence,
        settings.method,
        feedback,
        offsets,
        evidence.model,
        scaled,
        SharedSignals(),
    )


def _residual_of_known(evidence: Evidence, method: str, found: float) -> float:
    """What was `found` for errors relative to outputs, of those that are no estimates.

    Of one-step errors those of estimates are next to nothing.
    """
    model, records = evidence.model, evidence.records
    if method == "pbsid" or len(model.initial_states) != len(records):
        return found / float(np.sqrt(share_known(records)))
    errors = simulation_errors(model, records)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = sum(
            float(np.sum(e[record.known] ** 2))
            for e, record in zip(errors, records, strict=True)
        )
    power = sum(float(np.sum(r.y.T[r.known] ** 2)) for r in records)
    known = float(np.sqrt(squares / power)) if power else found
    return known if np.isfinite(known) else found


def _identify_open_loop(
    scaled: ScaledRecords,
    basis: Array,
    order: int | None,
    horizon: int | None,
    settings: Settings,
    like: LocalFit | None = None,
) -> PlantFit:
    """Identify a plant whose inputs do not know the noise, by choice where not given.

    `basis` is that of the `Evidence`. From the model of samples `like` these a few
    steps lead to that of these, unless it fits them worse.
    """
    chosen = found = None
    if order is None or horizon is None:
        chosen = select(scaled.records, order, horizon, settings)
        order, horizon = chosen.order, chosen.horizon
    elif like is not None and like.follows(order, settings):
        chosen, start = like.selection, like.candidate(scaled.output_scale)
        found = identify(scaled.records, order, horizon, settings, start, near=True)
        found = found._replace(singular_values=like.singular_values)
        if found.residual > _WORSE * like.residual:
            chosen = found = None
    if found is None:
        known = None if chosen is None else chosen.candidate
        found = identify(scaled.records, order, horizon, settings, known)
    if chosen is None:
        only = Row(order, horizon, found.residual, 0.0, np.nan)
        chosen = Selection(order, horizon, [only])
    records, share = shorten(scaled.records)
    evidence = Evidence(
        model=found.model,
        records=records,
        input_scale=scaled.input_scale,
        output_scale=scaled.output_scale,
        basis=basis,
        free=settings.free,
        whitening=found.whitening,
        refined=found.refined and found.stability_loss == 0.0,
        share=share,
    )
    return PlantFit(
        evidence, chosen, found.singular_values, found.residual, found.stability_loss
    )


def _heed(feedback: Feedback | None, settings: Settings, by_default: bool) -> Settings:
    """The settings with their method chosen; and D, which is free `by_default`.

    Where inputs and outputs depend on each other within the sample, data hardly tell a
    feedthrough from a controller that answers at once: the latter is taken for it.
    """
    if settings.method != "auto":
        return settings
    if feedback is None or not feedback.found or feedback.cut_off:
        return settings._replace(method="po-moesp")
    free = settings.free
    if by_default and feedback.instantaneous:
        free = free._replace(direct=np.zeros_like(free.direct))
    return settings._replace(method="pbsid", free=free)


def _believable(
    pairs: Pairs, choices: Choices, told: set[str], first: LocalFit
) -> tuple[LocalFit, Doubt | None]:
    """The first model of a closed loop, or one that refutes it on parts held out.

    Its like of the order that "po-moesp" takes is one: prediction, by which the order
    in a loop is chosen, hardly sees of a plant what outputs tell themselves. Where the
    method is free, that with D free where the first has none by default is another, and
    the model of "po-moesp". The latter minimises the simulation error, and so does
    better than the plant itself by what the inputs tell of the noise: that does not
    refute the plant unless inputs were to be noise more than anything else
    (`_OF_NOISE`), and how they act at once was not said, nor shown by a controller that
    answers at once; or the plant is unstable, by no more than chance, and the other is
    not; or D was left free for a stable plant, but fits these parts no better.
    """
    n_trend = first.evidence.free.n_trend
    without_d = not first.evidence.free.direct.any()
    feedback, as_said = first.feedback, choices.feedthrough
    answered = feedback is not None and feedback.answered
    shown = feedback is not None and feedback.shown
    if answered and without_d:
        choices = choices._replace(feedthrough=False)
    same = choices._replace(offset=DETRENDS[n_trend])

    def rival(**chosen: Any) -> tuple[LocalFit, HeldOut]:
        chosen_so = same._replace(**chosen)
        other = _fit(pairs, chosen_so, told, n_trend, first)
        return other, _held_out(other, chosen_so)

    best, error = first, _held_out(first, choices)
    before, makeshift = error, False
    try:
        if not error.parts:
            return first, None
        open_loop, of_that = rival(method="po-moesp")
        if (order := open_loop.selection.order) != first.selection.order:
            free = False if without_d else choices.feedthrough
            other, found = rival(method="pbsid", order=order, feedthrough=free)
            if found.clearly_better_than(error, _DOUBT):
                tried = other.selection.among(first.selection)
                first = best = other._replace(selection=tried)
                before = error = found
        if choices.method != "auto":
            return first, None
        blind, of_blind = open_loop, of_that
        if without_d and choices.feedthrough is not False:
            other, found = rival(method="pbsid")
            better = found.total < _OF_NOISE * error.total
            # data do not tell it apart from the first
            if better or best.grows(_CERTAIN) and not other.grows(_CERTAIN):
                makeshift = found.total > error.total
                best, error = other, found
            # inputs of the same sample tell the noise in the outputs: of a free D, all
            blind, of_blind = rival(method="po-moesp", feedthrough=False)
        # whoever says which entries of D act knows how the channels were sampled
        said = answered or not isinstance(choices.feedthrough, bool)
        better = not said and of_blind.total < _OF_NOISE * error.total
        # growing modes simulate bounded signals by what is to come of the inputs
        better &= not blind.grows(_CERTAIN)
        unsure = makeshift or (best.grows() and not best.grows(_CERTAIN))
        if not said and not best.grows() and of_that.total < _LED * error.total:
            unsure |= find_lead(pairs)[0] > 0  # inputs were made of later outputs, too
        if unsure and not open_loop.grows() and not better:
            blind, of_blind = open_loop, of_that
            better = of_that.clearly_better_than(error, _DOUBT)
        if better:
            best, error = blind, of_blind
        if answered and not shown and as_said is True:
            # noise of a measured input answers outputs as well
            other, found = rival(method="po-moesp", feedthrough=True)
            if found.total < _OF_ANSWERS * error.total:
                best, error = other, found
    except TooFewSamples:
        pass
    if best is first:
        return first, None
    doubt = Doubt(before.bft, error.bft, first.grows())
    if n_trend and choices.offset == "auto":  # constants are judged anew
        chosen = choices._replace(method=best.method)
        best = _with_constants(pairs, chosen, told, best)
    return best, doubt


def _may_share_noise(fitted: LocalFit, choices: Choices) -> bool:
    """Whether noise of more than a lag may be what else moves the plant."""
    feedback, records = fitted.feedback, fitted.scaled.records
    return bool(
        choices.method == "auto"
        and sum(record.u.shape[1] for record in records) <= _PLENTY
        and choices.refine in ("auto", "prediction")
        and fitted.selection.order
        and not choices.estimated
        and feedback is not None
        and not feedback.found
        and fitted.residual > _AUDIBLE
        and len(fitted.evidence.noise.A) >= _LAGS * len(fitted.model.C)
        and not rounded_outputs(fitted.model, records).repeated.any()
    )


def _with_shared_noise(
    pairs: Pairs, choices: Choices, told: set[str], first: LocalFit
) -> LocalFit:
    """The model of which noise moves the states of the plant, if that is likelier.

    Such noise tells of the poles what inputs do not. A model of the simulation error
    has no use for that, and takes what noise does in a mode that inputs hardly excite
    for their doing. Parts held out hardly tell: there, that noise is all that is left
    of either. The states of the plant must explain all of the noise, and where outputs
    are several be no more than without, as further ones may be those of a noise that
    the outputs share; unless parts held out are simulated far better with these. Noise
    that drifts makes some models likelier by chance than a chi-square tells.
    """
    n_trend = first.evidence.free.n_trend
    several, own = pairs[0][1].shape[1] > 1, first.selection.order
    tried = [choices._replace(method="pbsid", offset=DETRENDS[n_trend])]
    if choices.order is None:  # as many states at least, of which the inputs reach all
        tried += [tried[0]._replace(n_noise_states=n) for n in (own, own + 1)]
    least = _deviance(first)
    least -= CERTAIN if first.evidence.whitening.of_differences else 0.0
    best, error, n_joint = first, None, -1
    for chosen in tried:
        if chosen.n_noise_states <= n_joint:
            continue  # as many states were chosen before
        try:
            other = _fit(pairs, chosen, told, n_trend, first)
        except TooFewSamples:
            continue
        evidence = other.evidence
        if not isinstance(evidence, ClosedLoopEvidence):
            continue
        n_joint, deviance = len(evidence.kept), _deviance(other)
        if not evidence.kept.all() or other.grows():
            continue
        if len(evidence.one_step.noise.A) or not deviance < least:
            continue
        if follows_means_alone(evidence):
            continue  # what moves it is all called noise
        error, its = error or _held_out(first, choices), _held_out(other, chosen)
        more = several and other.selection.order > own
        if more and not its.total < _FAR_BETTER * error.total:
            continue
        if not error.clearly_better_than(its, _DOUBT):
            best, least = other, deviance
    return best


def _deviance(fitted: LocalFit) -> float:
    """Minus twice the logarithm of the likelihood, and the price of the parameters.

    That of the innovations of all outputs together: what one of them tells of another's
    noise is no evidence of states.
    """
    evidence = fitted.evidence.one_step
    noise, (ny, n) = evidence.noise, evidence.model.C.shape
    n_samples = sum(record.u.shape[1] for record in evidence.records)
    n_parameters = n * (evidence.model.B.shape[1] + ny) + ny * len(noise.A)
    n_parameters += evidence.free.n_own(n) * len(evidence.records)
    volume = float(np.linalg.slogdet(noise.covariance)[1])
    return n_samples * volume + PRICE * n_parameters


def _held_out(fitted: LocalFit, choices: Choices) -> HeldOut:
    """Errors of a fit's like on parts held out."""
    evidence, scaled = fitted.evidence, fitted.scaled
    horizon = fitted.selection.horizon
    free = evidence.free._replace(initial_states=True)  # what is left begins in motion
    settings = Settings(
        free,
        fitted.method,
        choices.refine is not False,
        choices.enforce_stability,
        choices.n_noise_states,
    )
    if fitted.method != "pbsid":
        whitening, refined = evidence.whitening, evidence.refined
        like = Candidate(evidence.model, horizon, whitening, refined)
        return validate(like, scaled.records, settings)

    refitted: Callable[[list[Record]], Realization]
    if isinstance(evidence, ClosedLoopEvidence) and evidence.refined:
        refitted = replace(evidence, free=free).of_others
    else:

        def refitted(train: list[Record]) -> Realization:
            part = scaled._replace(records=train)
            basis, order = evidence.basis, choices.order
            return identify_closed_loop(
                part, basis, order, choices.horizon, settings
            ).evidence.model

    try:
        return held_out(refitted, scaled.records)
    except ValueError:  # too few samples are left
        return HeldOut([], np.nan)


def _tell_of_lead(
    pairs: Pairs, choices: Choices, told: set[str], fitted: LocalFit
) -> None:
    """Tell of outputs that lead the inputs, where these seem to know the noise.

    Beside later inputs a model simulates parts held out far better, and there is no
    feedback. So does the inverse of a controller that leaves little to its reference.
    """
    lead, latest = find_lead(pairs)
    if not lead:
        return
    n_trend = fitted.evidence.free.n_trend
    offset = DETRENDS[n_trend]
    plain = choices._replace(method="auto", offset=offset, estimated=())
    pairs, error = with_later_inputs(pairs, lead), _held_out(fitted, choices)
    led = _OF_NOISE if fitted.grows() else _LED
    # One order tells whether it is worth while to look for the best.
    first = choices.order or max(1, fitted.selection.order)
    for order, share in {first: _OF_NOISE, choices.order: led}.items():
        plain = plain._replace(order=order)
        try:
            other = _fit(pairs, plain, set(told), n_trend)
        except TooFewSamples:
            return
        if other.feedback is None or other.feedback.found:
            return
        found = _held_out(other, plain)
        if not found.total < share * error.total:
            return
    # A reference of a few lines is the free motion of modes that do not decay.
    if 1.0 - spectral_radius(other.model.A) >= _LINE / max(len(u) for u, _ in pairs):
        tell(
            told,
            "lead",
            f"The outputs seem to know input {latest + 1} at least {lead} sample(s) "
            "ahead: beside inputs that come so much later, a model without feedback "
            f"simulates {found.bft:.3g} % of parts held out, this one {error.bft:.3g} "
            "%. Either the outputs lead it, by clocks or filters: move it by as much. "
            "Or a controller makes it of the outputs and leaves little to its "
            "reference: that must move more for a plant to be found.",
        )


def _is_wild(fitted: LocalFit, rounded: Rounded) -> bool:
    """Whether a model makes far more of a ripple than of all that inputs do else."""
    model = fitted.evidence.state_space(fitted.model, 1.0)
    G = model.frequency_response(_LOOKED_AT)
    of_ripple = np.abs(G @ rounded.faint).max()
    return bool(of_ripple > _WILD * np.abs(G @ rounded.others).max())


def _tell_of_rounding(
    rounded: Rounded, pairs: Pairs, told: set[str], names: Sequence[Hashable] | None
) -> None:
    exact, inputs = np.vstack(rounded.exact), np.vstack([u for u, _ in pairs])
    ripple = np.abs(exact - inputs).max(axis=0)
    some = np.flatnonzero(ripple > _PART * ripple.max())
    listed = ", ".join(str(k + 1 if names is None else names[int(k)]) for k in some)
    tell(
        told,
        "rounded",
        f"The inputs {listed} add up, weighted, to a constant but for the rounding of "
        "their numbers: what each of them does is not identifiable, and the smallest "
        "solution was taken. Excite them independently, or leave one out.",
        RankWarning,
    )


def _with_independent_inputs(pairs: Pairs, told: set[str]) -> tuple[Pairs, Array]:
    """Replace collinear inputs by independent combinations of them, and say so.

    The input matrix in the original inputs is that of the new ones times ``basis.T``,
    the second value; the identity in the usual case.
    """
    n_inputs = pairs[0][0].shape[1]
    basis = independent_inputs([u for u, _ in pairs])
    if basis is None:
        return pairs, np.eye(n_inputs)
    tell(
        told,
        "collinear",
        f"The {n_inputs} inputs are collinear (rank {basis.shape[1]}): their separate "
        "effects are not identifiable and the smallest solution was taken. Excite the "
        "inputs independently.",
        RankWarning,
    )
    return [(u @ basis, y) for u, y in pairs], basis
