"""From experiments to everything that `SubspaceLTI` keeps of a fit.

The records are made regular, order and horizon chosen, the model identified
(`fit_pairs`), with what the samples turn out to need: constants of the experiments,
drifts, shifts, rest at their beginning, a model of the closed loop.
"""

from __future__ import annotations

import numpy as np

from ..data.preparation import Pairs, check_excitation, remove_trends
from .at_rest import from_rest, moved_back
from .cross_checks import tell_of_contradiction, tell_of_input_spikes, without_rounding
from .drift import of_drifting_noise
from .fit_warnings import (
    tell_of_answers,
    tell_of_dropouts,
    tell_of_feedback,
    tell_of_held_outputs,
    tell_of_limits,
    tell_of_still_outputs,
)
from .local_fit import LocalFit
from .one_fit import TooFewSamples
from .options import Choices
from .rivals import (
    believable,
    held_by_a_loop,
    may_be_held,
    may_share_noise,
    tell_of_lead,
    with_shared_noise,
)
from .shifts import without_shifts
from .telling import Telling
from .trends import with_trends


def fit_pairs(
    pairs: Pairs,
    choices: Choices,
    telling: Telling,
    *,
    detrend: str | None = None,
    known: LocalFit | None = None,
) -> LocalFit:
    """Check, detrend, choose and identify.

    Of samples like those of a `known` fit feedback is not looked for again.
    `TooFewSamples` where an input is constant or the samples are too few.
    """
    # By channel in memory, as tables are read: sums take a tenth of the time.
    pairs = [(np.asfortranarray(u), np.asfortranarray(y)) for u, y in pairs]
    try:
        check_excitation(pairs, telling.input)
    except ValueError as error:
        raise TooFewSamples(str(error)) from None
    outputs = [y for _, y in pairs]
    tell_of_still_outputs(outputs, telling)
    tell_of_dropouts(pairs, telling)
    pairs, u_mean, y_mean = remove_trends(pairs, detrend)
    fitted = with_trends(pairs, choices, telling, known)
    pairs, fitted = without_rounding(pairs, choices, telling, fitted, known)
    fitted = of_drifting_noise(pairs, choices, telling, fitted) or fitted
    if fitted.selection.order:
        tell_of_held_outputs(outputs, telling)
        tell_of_limits(outputs, fitted, telling)
    tell_of_contradiction(pairs, choices, telling, fitted)
    tell_of_input_spikes(pairs, choices, telling, fitted)
    whole, rest, differ = pairs, None, fitted.offsets.differ
    pairs, fitted = without_shifts(pairs, choices, telling, fitted)
    if pairs is whole:
        rest = from_rest(pairs, choices, telling, fitted, known)
    if rest is not None:
        pairs, choices, fitted, first = rest
    doubt = None
    foreseen = fitted.feedback is not None and fitted.feedback.foreseen
    if fitted.method == "pbsid" and (choices.method == "auto" or choices.order is None):
        # Of inputs without anything new a rival makes of many states what it likes.
        if not foreseen:
            fitted, doubt = believable(pairs, choices, telling, fitted)
    elif may_be_held(fitted, choices):
        fitted = held_by_a_loop(pairs, choices, telling, fitted)
    elif may_share_noise(fitted, choices):
        fitted = with_shared_noise(pairs, choices, telling, fitted)
    feedback = fitted.feedback
    if feedback is not None and feedback.found and "feedback" not in telling:
        if feedback.shown or not fitted.model.D.any():
            tell_of_feedback(feedback, fitted, choices, doubt, telling)
        else:
            tell_of_answers(feedback, telling)
        if known is None and not foreseen:
            tell_of_lead(pairs, choices, telling, fitted)
    if rest is not None:
        fitted = moved_back(fitted, first, differ)
    if detrend is None:
        return fitted
    return fitted._replace(offsets=fitted.offsets.shifted(u_mean, y_mean))
