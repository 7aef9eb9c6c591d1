"""Constants and drifts of experiments, where these matter."""

from __future__ import annotations

import numpy as np

from ..data.preparation import Pairs
from ..systems.beginnings import moves_of
from .drift import n_lasting, outlasts, wanders
from .local_fit import LocalFit
from .offsets import (
    ALIKE,
    CERTAIN,
    HARDLY_MOVED,
    N_TRENDS,
    constants_matter,
    criterion_in_units,
    drifts_off,
    leaves_rounding,
    may_be_better,
    may_have_constants,
    may_have_drift,
    stands_by_chance,
    unmoved_errors,
)
from .one_fit import TooFewSamples, choose_and_identify, is_worth_a_choice, of_order
from .options import Choices
from .rounding import rounded_outputs
from .statistics import Evidence
from .telling import Telling

# Share of the outputs' size left unexplained that constants may be the reason of
_HARDLY = 0.4

# Times the squared errors without what inputs do to modes that do not decay, of ones
# that they do not move at all.
_NOT_MOVED = 1.1


def with_trends(
    pairs: Pairs, choices: Choices, telling: Telling, known: LocalFit | None
) -> LocalFit:
    """Choose and identify, with constants of the experiments where these matter."""
    n_trend = N_TRENDS[choices.offset]
    # The errors of a rough model are not the noise that constants must stand out of.
    rough = choices.offset == "auto" and choices.refine is False
    judged = choices._replace(refine="simulation") if rough else choices
    fitted = choose_and_identify(pairs, judged, telling, n_trend, known)
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
        return may_have_constants(tested) and is_worth_a_choice(
            lambda near: may_be_better(tested, near.evidence),
            *(pairs, judged, telling, fitted, 1),
        )

    refused = np.inf
    moves = any(np.ptp(u, axis=0).any() for u, _ in pairs)
    if choices.offset == "auto" and moves and may_matter():
        other = choose_and_identify(pairs, judged, telling, 1, fitted)
        order = len(fitted.model.A)
        if stands and len(other.model.A) > order:
            as_many, worse = of_order(pairs, judged, telling, order, other, 1)
            other = as_many if worse < 0.0 else other
        if constants_matter(tested, other.evidence.one_step):
            fitted, n_trend = other, 1
        elif choices.order is not None:  # a poor model shows many things
            refused = criterion_in_units(other.evidence.one_step)
    # The states of a given order that are to follow a drift are missing elsewhere.
    given = choices.order is not None and choices.initial_states and n_trend < 2
    given &= fitted.method != "pbsid" and not choices.enforce_stability

    def may_drift() -> bool:
        if given:
            lost = outlasts(fitted) or fitted.residual > _HARDLY
            return lost or _drifts_off(pairs, judged, telling, fitted, tested)
        shown = choices.order is None and not hides and not rough
        return shown and _may_drift_off(pairs, judged, telling, fitted)

    if choices.offset == "auto" and moves and may_drift():
        fitted = _with_drifts(pairs, judged, telling, fitted, refused)
        n_trend = fitted.evidence.free.n_trend
    return (
        choose_and_identify(pairs, choices, telling, n_trend, fitted)
        if rough
        else fitted
    )


def _drifts_off(
    pairs: Pairs,
    choices: Choices,
    telling: Telling,
    fitted: LocalFit,
    tested: Evidence,
) -> bool:
    """Whether errors of a given order drift, and by no state that inputs move."""
    own = fitted.evidence.one_step
    shown = drifts_off(tested) or (own is not tested and drifts_off(own))
    if not (shown or wanders(own)):
        return False
    order, n_trend = len(fitted.model.A) + 1, fitted.evidence.free.n_trend
    try:
        more, worse = of_order(pairs, choices, telling, order, fitted, n_trend)
    except TooFewSamples:
        return True
    moved = unmoved_errors(more.evidence.one_step, beside_drifts=True) > HARDLY_MOVED
    return not (worse < -CERTAIN and moved)


def _may_drift_off(
    pairs: Pairs, choices: Choices, telling: Telling, fitted: LocalFit
) -> bool:
    """Whether to try drifts, of a model whose errors or modes may hide them."""
    tested = fitted.evidence.one_step
    if not (may_have_drift(tested) or wanders(tested)):
        return False
    # Errors that are rounding go with the inputs, slowly.
    rounded = rounded_outputs(tested.model, tested.records).repeated.any()
    if rounded and not outlasts(fitted):
        return False
    least, order = criterion_in_units(tested), len(tested.model.A)

    def may_drift(near: LocalFit) -> bool:
        # Drifts instead of a mode may need other states yet; beside all modes they are
        # there, or are not.
        doubt = CERTAIN if len(near.model.A) < order else 0.0
        return criterion_in_units(near.evidence) < least + doubt

    return is_worth_a_choice(may_drift, pairs, choices, telling, fitted, 2)


def _with_drifts(
    pairs: Pairs,
    choices: Choices,
    telling: Telling,
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
        other = choose_and_identify(pairs, choices, telling, 2, fitted)
    except TooFewSamples:
        return fitted
    before = min(criterion_in_units(tested), refused)
    better = before - criterion_in_units(other.evidence.one_step)
    asked = _gain_asked(fitted, other, given=choices.order is not None)
    if not better > asked:
        return fitted
    if other.offsets.drifts.any() and _takes_a_gain(fitted.evidence, other.evidence):
        return fitted
    order = len(other.model.A)
    if order > len(fitted.model.A) and choices.order is None:
        # What more states gain is no drift.
        n_trend = fitted.evidence.free.n_trend
        level, worse = of_order(pairs, choices, telling, order, other, n_trend)
        if not worse > asked:
            return level
    return other


def _gain_asked(fitted: LocalFit, other: LocalFit, *, given: bool) -> float:
    """By how much the criterion is to be better for the `other` model, with drifts.

    Of a `given` order, say. Infinite where that needs a mode which does not decay: but
    for one beside slow ones that the drift spares, or keeps from growing.
    """
    spared = len(fitted.model.A) - len(other.model.A)
    drifting = bool(other.offsets.drifts.any())
    fewer_last = n_lasting(other) < n_lasting(fitted) and not other.grows()
    if fewer_last and (spared > 0 or fitted.grows()) and _are_lines(other):
        return 0.0
    if outlasts(other) if drifting else spared < 0:
        return np.inf
    if given:
        return CERTAIN
    if not drifting:
        return -ALIKE if spared else ALIKE
    unmoved = unmoved_errors(fitted.evidence.one_step, beside_drifts=True)
    if unmoved < _NOT_MOVED:
        return -ALIKE
    return ALIKE if unmoved < HARDLY_MOVED else CERTAIN


def _are_lines(fitted: LocalFit) -> bool:
    """Whether outputs drift along lines, about which they do not wander.

    Of one move of the inputs an integrator makes a line.
    """
    kinks = any(len(moves_of(r.u.T)) > 1 for r in fitted.evidence.records)
    drifts = fitted.offsets.drifts.any() and not wanders(fitted.evidence)
    return bool(kinks and drifts)


def _takes_a_gain(without: Evidence, other: Evidence) -> bool:
    """Whether drifts stand for what inputs do slowly: static gains are lost to them."""
    before, after = without.static_gain(), other.static_gain()
    if before is None or after is None:
        return False
    return bool((after.unknown & ~before.unknown).any())
