"""Constants and drifts of experiments, where these matter."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from ...systems.beginnings import moves_of
from ..evidence.constants import (
    ALIKE,
    CERTAIN,
    HARDLY_MOVED,
    constants_matter,
    drifts_off,
    leaves_rounding,
    may_be_better,
    may_have_constants,
    may_have_drift,
    stands_by_chance,
    stays_far,
    unmoved_errors,
)
from ..evidence.offsets import N_TRENDS
from ..evidence.rounding import rounded_outputs
from ..evidence.statistics import Evidence
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples, TooFewSamples
from ..samples.records import Record
from .drift import n_lasting, outlasts, wanders

# Share of the outputs' size left unexplained that constants may be the reason of
_HARDLY = 0.4

# Times the squared errors without what inputs do to modes that do not decay, of ones
# that they do not move at all.
_NOT_MOVED = 1.1

_DECAYS = 1e-2  # of a mode over the longest experiment, that stands for a constant


def with_trends(samples: Samples, like: LocalFit | None = None) -> LocalFit:
    """Choose and identify, with constants of the experiments where these matter."""
    choices = samples.choices
    given, n_trend = choices.order is not None, N_TRENDS[choices.offset]
    # The errors of a rough model are not the noise that constants must stand out of.
    rough = choices.offset == "auto" and choices.refine is False
    judged = samples.having(refine="simulation") if rough else samples
    auto = choices.offset == "auto"
    moves = any(np.ptp(u, axis=0).any() for u, _ in samples.pairs)
    first, sure = None, False
    if auto and moves and not given and like is None:
        first, sure = _with_constants_first(judged)
    fitted = first if first and sure else judged.fit(n_trend, like)
    n_trend = fitted.evidence.free.n_trend
    # A slow mode of the noise, which outputs drive, stands for constants only too well;
    # so does one of a model that has to start at rest. In the errors of a poor model
    # nothing stands out.
    hides = fitted.method == "pbsid" or not choices.initial_states
    hides |= fitted.residual > _HARDLY
    tested = fitted.evidence.one_step
    stands = auto and stands_by_chance(tested)

    def may_matter() -> bool:
        if hides or stands:
            return True
        return may_have_constants(tested, given=given) and judged.is_worth_a_choice(
            lambda near: may_be_better(tested, near.evidence), fitted, 1
        )

    refused = np.inf
    if auto and moves and not sure and may_matter():
        other = first or judged.fit(1, fitted)
        if first and fitted.method == "pbsid" and other.worse_than(fitted) > 0.0:
            # In a loop it can only be likelier, if it begins at the other as well.
            other = judged.fit(1, fitted)
        order = len(fitted.model.A)
        if stands and len(other.model.A) > order:
            as_many, worse = judged.of_order(order, other, 1)
            other = as_many if worse < 0.0 else other
        if constants_matter(tested, other.evidence.one_step):
            fitted, n_trend = other, 1
        elif given:  # a poor model shows many things
            refused = other.evidence.one_step.criterion
    # The states of a given order that are to follow a drift are missing elsewhere.
    follows = given and choices.initial_states and n_trend < 2
    follows &= fitted.method != "pbsid" and not choices.enforce_stability

    def may_drift() -> bool:
        if follows:
            lost = outlasts(fitted) or fitted.residual > _HARDLY
            return lost or _drifts_off(judged, fitted, tested)
        shown = not (given or hides or rough)
        return shown and _may_drift_off(judged, fitted)

    if auto and moves and may_drift():
        fitted = _with_drifts(judged, fitted, refused)
        n_trend = fitted.evidence.free.n_trend
    return samples.fit(n_trend, fitted) if rough else fitted


def _with_constants_first(samples: Samples) -> tuple[LocalFit | None, bool]:
    """The model with constants, of signals that stay far from zero: they mostly matter.

    And whether one without them is refuted, by those that few steps lead to from this:
    with another mode in their place, or a state more, which hardly decays.
    """
    if not stays_far([Record.of(u, y) for u, y in samples.pairs]):
        return None, False
    found = samples.tried(1)
    if found is None or not found.evidence.refined or found.method == "pbsid":
        return found, False
    evidence, level = found.evidence, found.offsets.constants[0]
    A, C = evidence.model.A, evidence.model.C
    lasting = linalg.block_diag(A, 1.0 - _DECAYS / evidence.longest)
    seen = np.column_stack([C, level / evidence.output_scale])
    try:
        rivals = [samples.near(found, A, C, 0), samples.near(found, lasting, seen, 0)]
    except TooFewSamples:
        return found, False
    best = min(rivals, key=lambda rival: rival.worse_than(found))
    without = best.evidence.one_step
    refuted = best.worse_than(found) > 0.0 and not stands_by_chance(without)
    return found, refuted and constants_matter(without, evidence.one_step)


def _drifts_off(samples: Samples, fitted: LocalFit, tested: Evidence) -> bool:
    """Whether errors of a given order drift, and by no state that inputs move."""
    own = fitted.evidence.one_step
    shown = drifts_off(tested) or (own is not tested and drifts_off(own))
    if not (shown or wanders(own)):
        return False
    order, n_trend = len(fitted.model.A) + 1, fitted.evidence.free.n_trend
    try:
        more, worse = samples.of_order(order, fitted, n_trend)
    except TooFewSamples:
        return True
    moved = unmoved_errors(more.evidence.one_step, beside_drifts=True) > HARDLY_MOVED
    return not (worse < -CERTAIN and moved)


def _may_drift_off(samples: Samples, fitted: LocalFit) -> bool:
    """Whether to try drifts, of a model whose errors or modes may hide them."""
    tested = fitted.evidence.one_step
    if not (may_have_drift(tested) or wanders(tested)):
        return False
    # Errors that are rounding go with the inputs, slowly.
    rounded = rounded_outputs(tested.model, tested.records).repeated.any()
    if rounded and not outlasts(fitted):
        return False

    def may_drift(near: LocalFit) -> bool:
        # Drifts instead of a mode may need other states yet; beside all modes they are
        # there, or are not.
        doubt = CERTAIN if len(near.model.A) < len(tested.model.A) else 0.0
        return near.evidence.criterion < tested.criterion + doubt

    return samples.is_worth_a_choice(may_drift, fitted, 2)


def _with_drifts(samples: Samples, fitted: LocalFit, refused: float) -> LocalFit:
    """The model with drifts, or offsets of inputs that are integrated, if that is it.

    Of equals the model is taken which needs no mode that inputs do not move: it stands
    for an offset of theirs, or for a drift. Else drifts must be beyond doubt: noise may
    be as slow. The criterion of a model that was `refused` is to be met as well.
    """
    tested = fitted.evidence.one_step
    if leaves_rounding(tested):
        return fitted
    other, given = samples.tried(2, fitted), samples.choices.order is not None
    if other is None:
        return fitted
    better = min(tested.criterion, refused) - other.evidence.one_step.criterion
    asked = _gain_asked(fitted, other, given=given)
    if not better > asked:
        return fitted
    if other.offsets.drifts.any() and _takes_a_gain(fitted.evidence, other.evidence):
        return fitted
    if given and not fitted.evidence.free.n_trend:
        # What constants gain is no drift.
        level = samples.tried(1, fitted)
        if level is not None and not level.worse_than(other) > asked:
            return level
    order = len(other.model.A)
    if order > len(fitted.model.A) and not given:
        # What more states gain is no drift.
        n_trend = fitted.evidence.free.n_trend
        level, worse = samples.of_order(order, other, n_trend)
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
