"""From experiments to everything that `SubspaceLTI` keeps of a fit.

The records are made regular, order and horizon chosen, the model identified
(`fit_samples`), with what the samples turn out to need: constants of the experiments,
drifts, shifts, rest at their beginning, a model of the closed loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import check_excitation, remove_trends
from .alternatives.at_rest import from_rest, moved_back
from .alternatives.drift import of_drifting_noise
from .alternatives.noise_levels import as_given, by_own_noise
from .alternatives.oscillations import without_modes_of_few_lines, without_oscillations
from .alternatives.rivals import (
    Doubt,
    believable,
    held_by_a_loop,
    may_be_held,
    may_share_noise,
    tell_of_lead,
    with_shared_noise,
)
from .alternatives.rounded_inputs import without_rounding
from .alternatives.shifts import without_shifts
from .alternatives.trends import with_trends
from .closed_loop.answers import tell_of_answering_input
from .diagnosis.cross_checks import tell_of_contradiction, tell_of_input_spikes
from .diagnosis.faulty_outputs import (
    tell_of_codes,
    tell_of_drift,
    tell_of_dropouts,
    tell_of_exchange,
    tell_of_held_outputs,
    tell_of_limits,
    tell_of_logging,
    tell_of_still_outputs,
)
from .diagnosis.loop_warnings import tell_of_answers, tell_of_feedback
from .fits.local_fit import LocalFit
from .fits.one_fit import Samples, TooFewSamples

Array = NDArray[np.float64]


def fit_samples(
    samples: Samples, *, detrend: str | None = None, like: LocalFit | None = None
) -> tuple[LocalFit, Samples]:
    """Check, detrend, choose and identify.

    With the samples that the model was made of: without what no input moves, cut where
    levels shift. Of samples `like` those of another fit feedback is not looked for
    again.
    `TooFewSamples` where an input is constant or the samples are too few.
    """
    pairs, choices, telling = samples
    # By channel in memory, as tables are read: sums take a tenth of the time.
    pairs = [(np.asfortranarray(u), np.asfortranarray(y)) for u, y in pairs]
    try:
        check_excitation(pairs, telling.input)
    except ValueError as error:
        raise TooFewSamples(str(error)) from None
    outputs = [y for _, y in pairs]
    if not telling.silent:
        tell_of_still_outputs(outputs, telling)
        tell_of_codes(pairs, telling)
        tell_of_dropouts(pairs, telling)
    pairs, u_mean, y_mean = remove_trends(pairs, detrend)
    samples = samples._replace(pairs=pairs)
    fitted = with_trends(samples, like)
    samples, fitted = without_rounding(samples, fitted, like)
    fitted = of_drifting_noise(samples, fitted) or fitted
    samples, fitted, turns = without_oscillations(samples, fitted)
    fitted = without_modes_of_few_lines(samples, fitted)
    if not telling.silent:
        tell_of_exchange(pairs, fitted, telling)
        tell_of_logging(pairs, fitted, telling)
        if not telling.spoilt:
            _tell_of_signals(outputs, samples, fitted)
    whole, rest, differ = samples, None, fitted.offsets.differ
    samples, fitted = without_shifts(samples, fitted)
    if samples is whole:
        rest = from_rest(samples, fitted, like)
    if rest is not None:
        samples, fitted, first = rest
        choices = samples.choices
    sizes, constants_differ = None, fitted.offsets.differ
    if like is None:
        samples, fitted, sizes = by_own_noise(samples, fitted)
    doubt = None
    foreseen = fitted.feedback is not None and fitted.feedback.foreseen
    if fitted.method == "pbsid" and (choices.method == "auto" or choices.order is None):
        # Of inputs without anything new a rival makes of many states what it likes.
        if not foreseen:
            fitted, doubt = believable(samples, fitted)
    elif may_be_held(fitted, choices):
        fitted = held_by_a_loop(samples, fitted)
    elif may_share_noise(fitted, choices):
        fitted = with_shared_noise(samples, fitted)
    quiet = telling.silent or telling.spoilt
    if not quiet:
        _tell_of_loop(samples, fitted, doubt, like)
    if len(turns) and fitted.method != "pbsid":
        fitted = fitted._replace(evidence=fitted.evidence.beside(turns=turns))
    if sizes is not None:
        fitted = as_given(fitted, sizes, constants_differ)
    if rest is not None:
        fitted = moved_back(fitted, first, differ)
    if detrend is not None:
        fitted = fitted._replace(offsets=fitted.offsets.shifted(u_mean, y_mean))
    if choices.offset == "auto" and not quiet:
        tell_of_drift(fitted, outputs, telling)
    return fitted, samples


def _tell_of_signals(outputs: list[Array], samples: Samples, fitted: LocalFit) -> None:
    """Tell what the signals do that no sensor should, beside the model of them."""
    if fitted.selection.order:
        tell_of_held_outputs(outputs, samples.telling)
        tell_of_limits(outputs, fitted, samples.telling)
    tell_of_contradiction(samples, fitted)
    tell_of_input_spikes(samples, fitted)


def _tell_of_loop(
    samples: Samples, fitted: LocalFit, doubt: Doubt | None, like: LocalFit | None
) -> None:
    """Tell where inputs answer the outputs, or seem to."""
    pairs, choices, telling = samples
    feedback = fitted.feedback
    if feedback is None:
        return
    asked = not (choices.estimated or choices.differences or "feedback" in telling)
    if asked and tell_of_answering_input(pairs, telling):
        return
    if feedback.found and "feedback" not in telling:
        if feedback.shown or not fitted.model.D.any():
            tell_of_feedback(feedback, fitted, choices, doubt, telling)
        else:
            tell_of_answers(feedback, telling)
        if like is None and feedback.shown and not feedback.foreseen:
            tell_of_lead(samples, fitted)
    elif feedback.may_be_answered and fitted.model.D.any():
        tell_of_answers(feedback, telling)
