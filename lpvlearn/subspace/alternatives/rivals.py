"""Other models of the same samples, and whether these refute the first one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.preparation import DETRENDS
from ...systems.modes import HARDLY_DECAYS, spectral_radius
from ..closed_loop.plant_and_noise import ClosedLoopEvidence
from ..closed_loop.varx import Regression
from ..evidence.constants import CERTAIN, follows_means_alone
from ..evidence.rounding import rounded_outputs
from ..fits.delay import find_lead, with_later_inputs
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples, TooFewSamples
from ..fits.options import Choices
from ..simulation_error.criterion import PRICE, n_parameters
from ..simulation_error.held_out import DOUBT, HeldOut
from .drift import n_lasting
from .trends import with_trends

Array = NDArray[np.float64]

# Share of the squared errors that later inputs leave where the outputs lead them; or
# where half the states are enough beside these, as for inputs that foretell themselves
_LED, _NO_MORE = 0.1, 0.9
_NEARLY_LED = 0.5  # beyond which half the states are asked before any number
_LINE = 1.0  # time constants per experiment of a mode that may be a reference's line

# Share of the squared errors of a plant in a loop that must be left of them for another
# model not to refute it; and for one with D free, where nothing but answers within the
# sample shows a loop
_OF_NOISE = 0.5
_OF_ANSWERS = 0.25

# Best fit of parts held out, percent, that leaves a quarter of their energy: below it
# noise may be what moves the loop
_NOISY = 50.0

_FASTEST = 2.0  # growth within a sample of a plant that no controller holds

# Share of the first model's squared errors on parts held out that one of more states,
# which grows, leaves there; or percent that it explains
_OF_FIRST, _NEARLY_ALL = 0.25, 95.0

_LAGS = 2  # of a noise that may be more than that of a sensor
_PLENTY = 20_000  # samples of which more tell the plant without its noise
_AUDIBLE = 0.01  # share of the outputs' size, below which either model is as good

# Share of the squared errors of parts held out that further states leave there where
# they are the plant's.
_FAR_BETTER = 0.5


class Doubt(NamedTuple):
    """Why the first model of a closed loop was given up."""

    bft: float  # on parts held out, percent
    bft_taken: float  # of the model that was taken instead
    grew: bool  # whether it was unstable
    alternated: bool  # and no sampled plant


def believable(samples: Samples, first: LocalFit) -> tuple[LocalFit, Doubt | None]:
    """The first model of a closed loop, or one that refutes it on parts held out.

    Its like of the order that "po-moesp" takes is one: prediction, by which the order
    in a loop is chosen, hardly sees of a plant what outputs tell themselves. Where the
    method is free, that with D free where the first has none by default is another, and
    the model of "po-moesp". The latter minimises the simulation error, and so does
    better than the plant itself by what the inputs tell of the noise: that does not
    refute the plant unless inputs were to be noise more than anything else
    (`_OF_NOISE`), and how they act at once was not said, nor shown by a controller that
    answers at once; or the plant is unstable, by no more than chance, and the other is
    not; or D was left free for a stable plant, but fits these parts no better. Inputs
    are noise more than anything else where it moves the loop more than what is added to
    it: where the other explains little of these parts (`_NOISY`), it must not predict
    worse for certain, as outputs tell their noise before the inputs do.
    """
    choices, n_trend = samples.choices, first.evidence.free.n_trend
    without_d = not first.evidence.free.direct.any()
    feedback, as_said = first.feedback, choices.feedthrough
    answered = feedback is not None and feedback.answered
    shown = feedback is not None and feedback.shown
    if answered and without_d:
        samples = samples.having(feedthrough=False)
        choices = samples.choices
    same = samples.having(offset=DETRENDS[n_trend])

    def rival(**chosen: Any) -> tuple[LocalFit, HeldOut]:
        chosen_so = same.having(**chosen)
        other = chosen_so.fit(n_trend, first)
        return other, chosen_so.errors_held_out(other)

    best, error = first, samples.errors_held_out(first)
    before, makeshift = error, False
    try:
        if not error.parts:
            return first, None
        open_loop, of_that = rival(method="po-moesp")
        if (order := open_loop.selection.order) != first.selection.order:
            free = False if without_d else choices.feedthrough
            other, found = rival(method="pbsid", order=order, feedthrough=free)
            better = found.clearly_better_than(error, DOUBT)
            if better and _may_refute(first, other, found):
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
            if better or best.grows(surely=True) and not other.grows(surely=True):
                makeshift = found.total > error.total
                best, error = other, found
            # inputs of the same sample tell the noise in the outputs: of a free D, all
            blind, of_blind = rival(method="po-moesp", feedthrough=False)
        # whoever says which entries of D act knows how the channels were sampled
        said = answered or not isinstance(choices.feedthrough, bool)
        better = not said and of_blind.total < _OF_NOISE * error.total
        # growing modes simulate bounded signals by what is to come of the inputs
        better &= not blind.grows(surely=True)
        # and are predicted: what they have of noise, simulations amplify
        better &= not best.grows(surely=True) or _deviance(blind) < _deviance(best)
        unsure = makeshift or (best.grows() and not best.grows(surely=True))
        if not said and not best.grows() and of_that.total < _LED * error.total:
            # inputs were made of later outputs, too
            unsure |= find_lead(samples.pairs)[0] > 0
        better &= unsure or _may_refute(best, blind, of_blind)
        if unsure and not open_loop.grows() and not better:
            blind, of_blind = open_loop, of_that
            better = of_that.clearly_better_than(error, DOUBT)
        if _alternates(best) and not open_loop.grows():
            # as filters make them that know later samples, and no plant
            blind, of_blind, better = open_loop, of_that, True
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
    doubt = Doubt(before.bft, error.bft, first.grows(), _alternates(first))
    if n_trend and choices.offset == "auto":  # constants are judged anew
        free = as_said if best.evidence.free.direct.any() else False
        same = samples.having(method=best.method, feedthrough=free)
        best = with_trends(same, best)
    return best, doubt


def _may_refute(first: LocalFit, other: LocalFit, error: HeldOut) -> bool:
    """Whether another model's error on parts held out tells against the first one.

    What the inputs tell of the noise, outputs told before: where little else is
    explained, who simulates better by it must not predict worse for certain.
    """
    return error.bft > _NOISY or _deviance(other) < _deviance(first) + CERTAIN


def _alternates(fitted: LocalFit) -> bool:
    """Whether a mode grows from sample to sample with another sign.

    No sampled plant has a real pole below -1: those of continuous time have no sign.
    """
    poles = np.linalg.eigvals(fitted.model.A)
    return bool((poles[poles.imag == 0.0].real < -1.0).any())


def tell_of_lead(samples: Samples, fitted: LocalFit) -> None:
    """Tell of outputs that lead the inputs, where these seem to know the noise.

    Beside later inputs a model simulates parts held out far better, or better with half
    the states, and there is no feedback. So does the inverse of a controller that
    leaves little to its reference.
    """
    (pairs, choices, telling), n_trend = samples, fitted.evidence.free.n_trend
    lead, latest = find_lead(pairs)
    if not lead:
        return
    later = samples.having(method="po-moesp", offset=DETRENDS[n_trend], estimated=())
    later = later._replace(pairs=with_later_inputs(pairs, lead)).aside()
    error = samples.errors_held_out(fitted)
    led = _OF_NOISE if fitted.grows() else _LED
    own = fitted.selection.order

    def beside(order: int | None) -> tuple[LocalFit | None, HeldOut]:
        """A model without feedback, and what its like leaves of parts held out."""
        chosen = later.having(order=order)
        other = chosen.tried(n_trend)
        if other is None or other.feedback is None or other.feedback.found:
            return None, HeldOut([], np.nan)
        return other, chosen.errors_held_out(other)

    # Few orders tell whether it is worth while to look for the best.
    other, found = beside(choices.order or max(1, own))
    if choices.order is None and found.total < _NO_MORE * error.total:
        if not found.total < _NEARLY_LED * error.total:
            found = beside(max(1, own // 2))[1]
        if found.total < _NO_MORE * error.total:
            other, found = beside(None)
    fewer = choices.order is None and other and 2 * other.selection.order <= own
    if other is None or not found.total < (_NO_MORE if fewer else led) * error.total:
        return
    # A reference of a few lines is the free motion of modes that do not decay.
    longest = max(len(u) for u, _ in later.pairs)
    if 1.0 - spectral_radius(other.model.A) >= _LINE / longest:
        telling.once(
            "lead",
            f"The outputs seem to know input {telling.input(latest)} at least {lead} "
            "sample(s) ahead: beside inputs that come so much later, a model without "
            f"feedback, of order {other.selection.order}, simulates {found.bft:.3g} % "
            f"of parts held out, this one, of order {fitted.selection.order}, "
            f"{error.bft:.3g} %. Either the outputs lead it, by clocks or filters: "
            "move it by as much. Or a controller makes it of the outputs and leaves "
            "little to its reference: that must move more for a plant to be found.",
        )


def may_be_held(fitted: LocalFit, choices: Choices) -> bool:
    """Whether outputs grow by their own past, more than they do in any record.

    As those of a plant that only a loop holds, be its noise too small to be known to
    the inputs. Inputs that follow from the outputs hide it.
    """
    feedback = fitted.feedback
    asked = choices.method == "auto" and choices.refine in ("auto", "prediction")
    asked &= choices.initial_states and not choices.enforce_stability
    if not asked or fitted.method == "pbsid" or choices.estimated:
        return False
    if choices.differences or feedback is None or feedback.regression is None:
        return False
    if not fitted.residual > _AUDIBLE or fitted.grows(surely=True):
        return False  # it may have grown
    growth = max(spectral_radius(_own_past(feedback.regression)), 1.0)
    grows = np.log(growth) * fitted.evidence.longest > HARDLY_DECAYS
    return bool(grows) or feedback.foreseen


def _own_past(regression: Regression) -> Array:
    """The state matrix of a regression on past outputs."""
    own = -regression[1:, :, regression.shape[2] - regression.shape[1] :]
    past, ny, _ = own.shape
    A = np.eye(past * ny, k=-ny)
    A[:ny] = np.hstack(list(own))
    return A


def held_by_a_loop(samples: Samples, first: LocalFit) -> LocalFit:
    """The model of a plant that grows for certain, if that is far likelier.

    In open loop its outputs would have grown: there is a loop, however little of it
    the noise shows. Of more states than in open loop, parts held out must show it as
    well: what many of them predict of a system that is not linear may grow, too.
    """
    n_trend, feedback = first.evidence.free.n_trend, first.feedback
    choices = samples.choices
    chosen = samples.having(method="pbsid", offset=DETRENDS[n_trend])
    if choices.feedthrough is True and feedback is not None and feedback.instantaneous:
        chosen = chosen.having(feedthrough=False)
    try:
        other = chosen.fit(n_trend, first)
        likelier = _deviance(other) < _deviance(first) - CERTAIN
        held = spectral_radius(other.model.A) < _FASTEST
        if not (likelier and held and other.grows(surely=True)):
            return first
        if len(other.model.A) > len(first.model.A):
            error, its = samples.errors_held_out(first), chosen.errors_held_out(other)
            if not (its.total < _OF_FIRST * error.total or its.bft > _NEARLY_ALL):
                return first
        if choices.offset == "auto":  # constants are judged anew
            other = with_trends(chosen.having(offset="auto"), other)
    except TooFewSamples:
        return first
    samples.telling.once(
        "feedback",
        "The outputs follow from their own past as those of a plant that grows by "
        "itself, though they have not grown: a controller holds it. method='pbsid' was "
        "taken, which that does not bias. In open loop, where one that is not linear "
        "looks like it, give method='po-moesp'.",
    )
    return other


def may_share_noise(fitted: LocalFit, choices: Choices) -> bool:
    """Whether noise of more than a lag may be what else moves the plant."""
    feedback, records = fitted.feedback, fitted.scaled.records
    return bool(
        choices.method == "auto"
        and sum(record.n_samples for record in records) <= _PLENTY
        and choices.refine in ("auto", "prediction")
        and fitted.selection.order
        and not (choices.estimated or choices.differences)
        and not (feedback is not None and feedback.found)
        and fitted.residual > _AUDIBLE
        and len(fitted.evidence.noise.A) >= _LAGS * len(fitted.model.C)
        and not rounded_outputs(fitted.model, records).repeated.any()
    )


def with_shared_noise(samples: Samples, first: LocalFit) -> LocalFit:
    """The model of which noise moves the states of the plant, if that is likelier.

    Such noise tells of the poles what inputs do not. A model of the simulation error
    has no use for that, and takes what noise does in a mode that inputs hardly excite
    for their doing. Parts held out hardly tell: there, that noise is all that is left
    of either. The states of the plant must explain all of the noise, or with those of
    the load that moves them be likelier beyond chance. Where outputs are several they
    must be no more than without, as further ones may be those of a noise that the
    outputs share; unless parts held out are simulated far better with these. Noise
    that drifts makes some models likelier by chance than a chi-square tells: then, and
    with states of a load, that must be beyond doubt, or parts held out confirm it.
    """
    n_trend = first.evidence.free.n_trend
    several, own = len(first.model.C) > 1, first.selection.order
    tried = [samples.having(method="pbsid", offset=DETRENDS[n_trend])]
    if samples.choices.order is None:  # as many at least, of which inputs reach all
        tried += [tried[0].having(n_noise_states=n) for n in (own, own + 1)]
    least, drifts = _deviance(first), first.evidence.whitening.of_differences
    best, error, n_joint = first, None, -1
    for chosen in tried:
        if chosen.choices.n_noise_states <= n_joint:
            continue  # as many states were chosen before
        other = chosen.tried(n_trend, first)
        if other is None:
            continue
        evidence = other.evidence
        if not isinstance(evidence, ClosedLoopEvidence):
            continue
        n_joint, deviance = len(evidence.kept), _deviance(other)
        doubt = CERTAIN * (int(best is first and drifts) + int(not evidence.kept.all()))
        if other.grows() or not deviance < least:
            continue
        if len(evidence.one_step.noise.A):
            continue
        if follows_means_alone(evidence):
            continue  # what moves it is all called noise
        error = error or samples.errors_held_out(first)
        its = chosen.errors_held_out(other)
        far_better = its.total < _FAR_BETTER * error.total
        confirmed = far_better or its.clearly_better_than(error, DOUBT)
        if not confirmed and not deviance < least - doubt:
            continue
        more = several and other.selection.order > own
        if more and not far_better:
            continue
        if not error.clearly_better_than(its, DOUBT):
            best, least = other, deviance
    if best is first or not n_trend or samples.choices.offset != "auto":
        return best
    other = with_trends(samples.having(method="pbsid"), best)  # judged anew
    likelier = _deviance(other) < least and not other.grows()
    # no mode is to stand for constants, and none to be called noise for them
    alike = n_lasting(other) <= n_lasting(best)
    alike &= other.selection.order >= best.selection.order
    return other if likelier and alike else best


def _deviance(fitted: LocalFit) -> float:
    """Minus twice the logarithm of the likelihood, and the price of the parameters.

    That of the innovations of all outputs together: what one of them tells of another's
    noise is no evidence of states.
    """
    evidence = fitted.evidence.one_step
    noise, records, (ny, n) = evidence.noise, evidence.records, evidence.model.C.shape
    n_samples = sum(record.n_samples for record in records)
    n_unknown = n_parameters(n, records, evidence.free) + ny * len(noise.A)
    volume = float(np.linalg.slogdet(noise.covariance)[1])
    return n_samples * volume + PRICE * n_unknown
