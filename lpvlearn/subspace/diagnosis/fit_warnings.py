"""What is said of a fit: what the samples lack, and what is wrong with the model.

Of kinds of things that were told already nothing is said again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...data.faulty_signals import far_out
from ...data.preparation import independent_inputs
from ...exceptions import RankWarning
from ..evidence.constancy import change_over
from ..evidence.constants import (
    CERTAIN,
    USELESS,
    follows_means_alone,
    motions_left,
    stays_far,
)
from ..evidence.linearity import find_bend
from ..evidence.residuals import lacks
from ..evidence.rounding import rounded_outputs
from ..evidence.spikes import find_spikes
from ..evidence.statistics import OPEN, Evidence
from ..fits.local_fit import LocalFit
from ..orders.identification import Settings
from ..orders.selection import MAX_ORDER
from ..samples.records import thinned
from ..simulation_error.held_out import HeldOut
from ..telling import SPOILING, Telling, in_experiment

Array = NDArray[np.float64]

# What is told from tests that take as long as a fit
TESTS = {"held out", "orders", "static gain", "response", "decay", "bent", "lack"}

# What is told of modes that do not decay
OF_LASTING = ("decay", "pole", "border")

# What was told of that bends a response as well
_BENDS = {"bent", "limit", "held", "dropouts", "input spikes", "lines"}

# What errors follow of a system that is not linear, by its causes
_FOLLOWED = {
    "size": "squares or cubes of the inputs or of what these do",
    "direction": (
        "the direction in which inputs or outputs move, as friction, backlash and "
        "hysteresis make them"
    ),
    "change": (
        "large changes of the inputs, as actuators make them whose rate is limited"
    ),
}

_HALF = 0.5  # share of their energy that enforced stability must cost to be reported

# Share of its fit (one less the relative error) that parts held out must confirm; with
# 200 samples at equal noise and signal a right model comes to two thirds.
_CONFIRMED = 0.5

_NOTHING = 1.0  # best fit of parts held out, percent, that is none

_DECAYS = 2.0  # standard deviations of a pole, from which its decay is known

# Standard deviation of a pole, per longest experiment, from which it matters: that of
# an integrator is less.
_MATTERS = 0.1

_OUTSIDE = 1e-8  # farther outside the unit circle no pole on it is found

# A pole on the unit circle is found this far inside at most; an enforced one keeps
# farther away.
_INSIDE = 1e-9

# Poles this close to one may be those of integrators.
_ABOUT_ONE = 0.02

# A stream fits much worse than its first samples where its error exceeds both
_MUCH_WORSE = 5.0  # times theirs
_POOR = 0.2  # of the outputs' size

# What was poor from the start was told then; it is told again where it grows by this.
_GROWN = 1.1


def warn_beside_faults(fitted: LocalFit, telling: Telling) -> None:
    """Tell what is wrong with a model of samples that are not all of the system's.

    That it explains next to nothing a few repeated samples are no reason for.
    """
    warn_about_pole(fitted.model.A, telling, fitted)
    if fitted.residual > USELESS and not telling.kinds & (SPOILING - {"bursts"}):
        _warn_of_error(fitted, True, telling, False)


def warn_about(fitted: LocalFit, telling: Telling) -> None:
    """Tell the user what is wrong with a model that is returned all the same.

    No kind of which something was told is told of again.
    """
    model = fitted.model
    chose_order = len({row.order for row in fitted.selection.rows}) > 1
    if model.rank_deficit:
        remedy = "Excite the inputs more richly, or lower `order`."
        inputs = [r.u.T - r.u.mean(axis=1) for r in fitted.scaled.records]
        if inputs and independent_inputs(inputs) is not None:
            remedy = (
                "Inputs are the same but for constants and factors, and nothing tells "
                "what each of them does: leave out all but one of these."
            )
        telling.once(
            "rank",
            f"The data leave {model.rank_deficit} directions of B and D "
            f"undetermined; the smallest solution was taken. {remedy}",
            RankWarning,
        )
    warn_about_pole(model.A, telling, fitted)
    feedback = fitted.feedback
    in_loop = feedback is None or feedback.found or "feedback" in telling
    bent = False
    if not in_loop and not fitted.stability_loss and not telling.kinds & _BENDS:
        bent = _warn_of_bends(fitted, telling)
    _warn_of_error(fitted, chose_order, telling, bent)
    _warn_of_spikes(fitted, telling)
    choice_is_told = TESTS <= telling.kinds or fitted.residual > USELESS
    if fitted.selection.held_out is not None and not choice_is_told:
        _warn_about_choice(fitted, fitted.selection.held_out, telling)
    if feedback is None or fitted.stability_loss:
        return
    if not in_loop and not telling.kinds & (_BENDS | {"useless"}):
        _warn_of_change(fitted, telling)
    if fitted.method == "pbsid" or "lack" in telling:
        return
    if not lacks(fitted.evidence, feedback.innovations):
        return
    rounded = _rounded_output(fitted.evidence)
    if rounded is not None:
        output, share = rounded
        telling.once(
            "lack",
            f"Output {telling.output(output)} is rounded to steps of "
            f"{100.0 * share:.2g} % of its size, and the errors of the model are "
            "hardly larger: more states would follow what rounding does wherever the "
            "inputs repeat themselves. Keep the `order` low, or use larger inputs or a "
            "finer sensor.",
        )
    else:
        remedy = "a higher `order`"
        if not chose_order:
            remedy += " (order='auto' finds it, but for one that all points share)"
        # Without figures, so that a search over orders says it once of each.
        telling.once(
            "lack",
            "The simulation error depends on past inputs, beyond chance and by more "
            f"than a little: the model of order {len(model.A)} lacks states, a delay "
            f"or a nonlinearity, and is not as certain as it says. Try {remedy}, "
            "`input_delay`, or, if the system is nonlinear, smaller inputs; "
            "`residual_tests` tells which input it is.",
        )


def _rounded_output(evidence: Evidence) -> tuple[int, float] | None:
    """An output whose errors are mostly rounding, and the step relative to its size."""
    variances = rounded_outputs(evidence.model, evidence.records).variances
    if not variances.any():
        return None
    output = int(variances.argmax())
    size = np.std(np.hstack([record.y[output] for record in evidence.records]))
    return output, float(np.sqrt(12.0 * variances[output]) / size)


def _warn_of_error(
    fitted: LocalFit, chose_order: bool, telling: Telling, bent: bool
) -> None:
    """Tell of a model that explains next to nothing, or only without its stability.

    If that is of a plant that is `bent`, it was told.
    """
    residual, whitening = fitted.residual, fitted.evidence.whitening
    as_found = residual - fitted.stability_loss
    if residual**2 - as_found**2 > _HALF:
        telling.once(
            "enforced",
            "No stable model explains these outputs: the simulation error is "
            f"{100.0 * residual:.0f} % of their size with stability='enforce', "
            f"{100.0 * as_found:.3g} % without. The system seems to be unstable: "
            "identify it with stability='warn', or from a record of bounded outputs, "
            "with the controller's reference as input.",
        )
    elif residual > USELESS and len(fitted.model.A) and whitening.of_differences:
        telling.once(
            "useless",
            "The outputs drift, by what the inputs do not do and more than by what "
            f"they do: the simulation error is {100.0 * residual:.0f} % of their size. "
            "The model is that of the differences of the samples, and tells how the "
            "outputs move, not where they stand. Record what makes them drift as an "
            "input, or use `predict_ahead`.",
        )
    elif residual > USELESS:
        other = "an `order` of your own" if chose_order else "order='auto'"
        if len(fitted.model.C) > 1 and fitted.method != "pbsid":
            other += (
                ", or method='pbsid' where noise moves the states of the plant, as "
                "wind and roads do"
            )
        free, records = fitted.evidence.free, fitted.scaled.records
        n_samples = [record.n_samples for record in records]  # of a stream none
        # Glitches hide whatever else there is.
        if bent or _tells_of_glitches(fitted, telling):
            return
        subspace = bool(n_samples) and fitted.method != "pbsid"
        if subspace and Settings(free).max_horizon(n_samples) < 2:
            telling.once(
                "useless",
                f"{_next_to_nothing(fitted)} So few samples ({max(n_samples)}) carry "
                f"no states beside {sum(free.direct.shape)} inputs and outputs. Give a "
                "longer record.",
            )
        else:
            telling.once(
                "useless",
                f"{_next_to_nothing(fitted)} Try a longer `horizon` or {other}, and "
                "check that inputs and outputs belong together and in the order of "
                "time.",
            )
    elif follows_means_alone(fitted.evidence) or _confirms_means_alone(fitted):
        higher = "" if chose_order else ", order='auto'"
        telling.once(
            "useless",
            "The model explains where the outputs stay, and next to nothing of how "
            f"they move. Try offset='constant'{higher} or a longer `horizon`, and "
            "check that inputs and outputs belong together and in the order of time.",
        )
    elif len(fitted.model.A):
        _warn_of_outputs(fitted, chose_order, telling)


def _next_to_nothing(fitted: LocalFit) -> str:
    return (
        "The model explains next to nothing of the outputs: its simulation error is "
        f"{100.0 * fitted.residual:.0f} % of their size."
    )


def _tells_of_glitches(fitted: LocalFit, telling: Telling) -> bool:
    """Tell of single outputs far from all others, if there are some; or were told."""
    if "dropouts" in telling:
        return True
    far = [far_out(record.y.T) for record in fitted.scaled.records]
    found = [(k, *at) for k, one in enumerate(far) for at in np.argwhere(one)]
    if not found:
        return False
    first, sample, output = found[0]
    where = in_experiment(sample, first, len(far))
    telling.once(
        "dropouts",
        f"{len(found)} sample(s) of the outputs stand far from all others and hide "
        f"what the inputs do; the first is sample {where} of output "
        f"{telling.output(output)}, counted from 0. If a sensor got them wrong, "
        "replace them by NaN and use missing='estimate'.",
    )
    return True


def _confirms_means_alone(fitted: LocalFit) -> bool:
    """Whether parts held out move as no model without constants foresees at all."""
    held_out, evidence = fitted.selection.held_out, fitted.evidence
    if held_out is None or evidence.free.n_trend or not held_out.bft < _NOTHING:
        return False
    return stays_far(evidence.records)


def _warn_of_outputs(fitted: LocalFit, chose_order: bool, telling: Telling) -> None:
    """Tell of outputs whose motion a model does not explain, of all of them or some."""
    model, left = fitted.evidence.model, _motions_left(fitted)
    if left is None:
        return
    poor = [telling.output(k) for k in np.flatnonzero(left > USELESS**2)]
    if poor and len(poor) == np.count_nonzero(~np.isnan(left)):
        if fitted.method == "pbsid" or fitted.grows():
            return  # what it simulates without a controller tells nothing
        telling.once(
            "useless",
            "The model explains next to nothing of how the outputs move: its "
            f"simulation error is {100.0 * np.sqrt(np.nanmean(left)):.0f} % of that. "
            "Try a longer `horizon`, or another `order`, and check that inputs and "
            "outputs belong together and in the order of time.",
        )
        return
    if not chose_order:
        return
    about_one = np.abs(np.linalg.eigvals(model.A) - 1.0) < _ABOUT_ONE
    remedy = "Try"
    if about_one.any():
        remedy = "Where it integrates, name it in `integrating`. Else try"
    if poor:
        telling.once(
            "noisy output",
            f"The model explains next to nothing of output(s) {', '.join(poor)}: what "
            "moves these is mostly noise, or noise as slow as what the inputs do. "
            f"{remedy} refine='simulation' or a higher `order`, identify them apart "
            "from the others, or leave them out.",
        )


def _motions_left(fitted: LocalFit) -> Array | None:
    """Part of the motion of every output, NaN of still ones; None where not known."""
    evidence = fitted.evidence
    if len(evidence.model.initial_states) != len(evidence.records):
        return None
    return motions_left(evidence)


def _warn_of_spikes(fitted: LocalFit, telling: Telling) -> None:
    """Tell of samples that a sensor may have got wrong: the model follows them."""
    told = "spikes" in telling or "dropouts" in telling
    spikes = None if told else find_spikes(fitted.evidence)
    if spikes is None:
        return
    rounded = rounded_outputs(fitted.evidence.model, fitted.evidence.records)
    if rounded.variances[spikes.output]:
        return  # some errors of that are larger than others
    n_records = len(fitted.evidence.records)
    where = in_experiment(spikes.sample, spikes.experiment, n_records)
    stands_out = (
        f"{spikes.n_found} sample(s) of output {telling.output(spikes.output)} stand "
        "far out of the errors of the model and make "
        f"{100.0 * spikes.share:.0f} % of their squares; "
        f"the farthest is sample {where}, counted from 0. "
    )
    if spikes.follow:
        stands_out += (
            "Most come right after inputs move: the model lacks a delay or states. Use "
            "`input_delay` or a higher `order`."
        )
    else:
        stands_out += (
            "If a sensor got them wrong, they spoil the model: replace them by NaN and "
            "use missing='estimate'."
        )
    telling.once("spikes", stands_out)


def _warn_of_bends(fitted: LocalFit, telling: Telling) -> bool:
    """Tell of a plant in open loop that is not linear over the range of the record.

    In a loop, inputs and what they do know the noise. Nor are bends looked for beside
    samples that hide them.
    """
    poor = fitted.residual > USELESS and not fitted.evidence.whitening.of_differences
    if poor and _tells_of_glitches(fitted, telling):
        return False
    bend = find_bend(fitted.evidence, apart="contradiction" in telling)
    if bend is None:
        return False
    output, (cause, *others) = telling.output(bend.output), bend.causes
    what = f"{_next_to_nothing(fitted)} " if poor else ""
    follow = " or, about as well, ".join(_FOLLOWED[one] for one in bend.causes)
    if bend.ahead:
        what = what or f"The model explains little of output {output}. "
        telling.once(
            "bent",
            f"{what}What is new in a sample of output {output}, given those before it, "
            f"follows {follow}, beyond chance and for the most part: over the range of "
            "this record the system is not linear. Use inputs that move less, about "
            "one operating point at a time (`split_levels` cuts a record by a signal's "
            "level), or give what bends it as a scheduling variable.",
        )
    elif others:
        telling.once(
            "bent",
            f"{what}The errors of output {output} follow {follow}, beyond chance and "
            "by more than a little: over the range of this record the system is not "
            "linear, and the model, which stands in for it there, simulates larger, "
            "smaller or other motions worse. Compare records of smaller and larger "
            "motions, which tell size from direction: among small ones stiffening and "
            "limits are gone, friction and backlash are most of it. Use inputs that "
            "keep to where the system is linear. Where inputs were measured with "
            "noise, which looks the same, give what was commanded.",
        )
    elif cause == "direction":
        telling.once(
            "bent",
            f"{what}The errors of output {output} follow the direction "
            "in which the inputs or outputs move, beyond chance and by more than a "
            "little, as friction and backlash make them: the model, which stands in "
            "for the system over motions like those of this record, simulates smaller "
            "ones worse, and others where motion turns. Use inputs that move the "
            "system well beyond the play and seldom turn, or measure behind what has "
            "the play and give that as the input. Where inputs were measured with "
            "noise, which looks the same, give what was commanded.",
        )
    elif cause == "change":
        telling.once(
            "bent",
            f"{what}The errors of output {output} follow large changes "
            "of the inputs more than in proportion, beyond chance and by more than a "
            "little, as an actuator makes them whose rate is limited (slew rate): the "
            "model, which stands in for the system over changes like those of this "
            "record, simulates smaller and larger ones worse. Use steps or speeds of "
            "the inputs that are small enough, or give the measured position of the "
            "actuator as the input. Where inputs were measured with noise, which looks "
            "the same, give what was commanded.",
        )
    else:
        telling.once(
            "bent",
            f"{what}The errors of output {output} follow squares or "
            "cubes of the inputs or of what these do, beyond chance and by more than a "
            "little: over the range of this record the system is not linear, and the "
            "model, which stands in for it there, simulates larger, smaller or other "
            "motions worse. Use inputs that move less, about one operating point at a "
            "time (`split_levels` cuts a record by a signal's level), or give what "
            "bends it as a scheduling variable. Where inputs were measured with noise, "
            "which looks the same, give what was commanded.",
        )
    return True


def _warn_of_change(fitted: LocalFit, telling: Telling) -> None:
    """Tell of a system that is not the same all over its record."""
    change = change_over(fitted.evidence)
    if change is not None:
        telling.once(
            "change",
            "The system changes over the record, or is not linear: of output "
            f"{telling.output(change.output)} one model leaves "
            f"{100.0 * change.together:.2g} %, models of each of {change.n_parts} "
            f"parts leave {100.0 * change.apart:.2g} %. Its response is one between "
            "those, with bands too narrow for any of them. Fit the parts apart, or "
            "give what changes as a scheduling variable.",
        )


def _warn_about_choice(fitted: LocalFit, held_out: HeldOut, telling: Telling) -> None:
    """Tell what the samples do not confirm of a model of automatic order.

    Without figures, so that a search says it once.
    """
    if 1.0 - held_out.residual < _CONFIRMED * (1.0 - fitted.residual):
        telling.once(
            "held out",
            "The model simulates parts of the record that it was not fitted to far "
            "worse than the others (`selection_`): the system is nonlinear, changes "
            "over the record or drifts, or the record is too short for it. Give a "
            "lower `order`, leave disturbed parts out, or use offset='linear'.",
        )
    if len(fitted.model.A) == MAX_ORDER == max(r.order for r in fitted.selection.rows):
        telling.once(
            "highest",
            f"The automatic order is the highest that is tried, {MAX_ORDER}: the "
            "system may have more states. Give a higher `order`, or use fewer outputs "
            "or a narrower band of frequencies.",
        )
    if _disputed(fitted):
        telling.once(
            "orders",
            "Parts held out took fewer states than the likelihood asks for, by more "
            "than chance explains (`selection_`): the system is not quite linear, or "
            "changes over the record, or its inputs move too seldom for parts to tell. "
            "Compare both orders on another record, or give one with inputs that move "
            "more often, and less far if the system is not linear.",
        )
    if _may_last(fitted):
        telling.once(
            "decay",
            "A mode of the model does not decay over the longest experiment, nor by "
            "more than the standard deviation of its poles (`poles_std_`). It may be "
            "an integrator (name its outputs in `integrating`), stand for a drift that "
            "the inputs do not explain, or for a system that is not linear: it may "
            "simulate other records poorly. Give a lower `order`, or record for "
            "longer, with inputs that move more often.",
        )

    _warn_of_unknown_response(fitted, telling)


def _warn_of_unknown_response(fitted: LocalFit, telling: Telling) -> None:
    """Tell where the inputs excite the system too little to tell its response."""
    gain = fitted.evidence.static_gain()
    if gain is None:
        return
    left = _motions_left(fitted) if telling.kinds & {"still", "noisy output"} else None
    if left is not None:  # what does not answer was told: nobody asks for its response
        told = ~(left <= USELESS**2)[:, None]
        gain = gain._replace(size=np.where(told, np.inf, gain.size))
    if gain.unknown.any():
        output, which = np.argwhere(gain.unknown)[0]
        telling.once(
            "static gain",
            f"The static gain (from input {telling.input(which)} to output "
            f"{telling.output(output)}) is known no better than to its own size: the "
            "record excites slow motions too little to tell it. Record for longer, "
            "with inputs that are held for longer, or lower `order`; at higher "
            "frequencies the model may be right (`frequency_response_std`).",
        )
        return
    share, omega = fitted.evidence.unknown_share(gain.size)
    if share > OPEN:
        period = f"{2.0 * np.pi / omega:.3g}" if omega else "many"
        telling.once(
            "response",
            "The response is hardly known (`frequency_response_std`) at frequencies "
            "that the record hardly excites, least for oscillations with a period of "
            f"{period} samples: inputs that hold these may be simulated wildly. Use "
            "inputs that move as fast or as slowly as that, or lower `order`.",
        )


def _disputed(fitted: LocalFit) -> bool:
    """Whether the criterion speaks clearly against the order that was taken."""
    records, selection = fitted.scaled.records, fitted.selection
    n_values = sum(record.y.size for record in thinned(records)) if records else 0
    chosen = selection.order, selection.horizon
    return any(
        row[:2] == chosen and row.criterion * n_values > CERTAIN
        for row in selection.rows
    )


def _may_last(fitted: LocalFit) -> bool:
    """Whether the decay of a mode of a stable model is not known.

    Of summaries of records nobody knows how long these were.
    """
    poles = fitted.evidence.state_space(fitted.model, 1.0).poles()
    lengths = [record.n_samples for record in fitted.scaled.records]
    if not lengths:
        return False
    decay = 1.0 - np.abs(poles)
    lasting = (decay >= 0.0) & (decay * max(lengths) < 1.0)
    try:
        spread = np.abs(fitted.evidence.poles_std()) if lasting.any() else decay
    except ValueError:  # it is not known
        return False
    unknown = (decay < _DECAYS * spread) & (spread * max(lengths) > _MATTERS)
    return bool((lasting & unknown).any())


def warn_about_pole(A: Array, telling: Telling, fitted: LocalFit | None = None) -> None:
    """Tell the user that a model is unstable, or on the border of that.

    The fit tells how sure it is, and what the model is good for; not that of a stream.
    """
    poles = np.linalg.eigvals(A)
    moduli = np.abs(poles)
    radius = float(moduli.max(initial=0.0))
    if radius > 1.0 + _OUTSIDE:
        stable = (
            "stability='enforce' for a stable one, another `order`, or a longer "
            "`horizon`."
        )
        if fitted is not None and fitted.method == "pbsid":
            remedy = (
                "Such a plant can be predicted (`predict_ahead`), but not simulated "
                "for long nor brought into a structure: for that, identify the closed "
                "loop, with the controller's reference as input."
            )
        elif fitted is not None and fitted.grows(surely=True):
            remedy = (
                "It grows beyond chance, as a plant does that a controller or a hand "
                "holds: simulate from the state that outputs tell "
                "(`predict_with_initial_state`) and not for long, or give "
                "method='pbsid' and use `predict_ahead`. If the plant is stable, use "
                f"{stable}"
            )
        else:
            remedy = f"Use {stable}"
        if (np.abs(poles[moduli > 1.0] - 1.0) < _ABOUT_ONE).all():
            remedy = (
                "Name outputs that integrate, as a position does, in `integrating`. "
                f"Where they drift, use offset='linear'. Else: {remedy}"
            )
        telling.once(
            "pole",
            f"The identified model is unstable: a pole has modulus {radius:.6g}. "
            + remedy,
        )
    elif radius >= 1.0 - _INSIDE:
        count = int((moduli >= 1.0 - _INSIDE).sum())
        telling.once(
            "border",
            "The identified model is on the border of stability, by integrators or "
            f"undamped oscillations: {count} of its poles at modulus 1, to rounding. "
            "Its outputs may grow without end. Name outputs that integrate in "
            "`integrating`; otherwise use stability='enforce', or another `order`.",
        )


def warn_about_drift(
    error: float, first: float, n_samples: int, telling: Telling
) -> None:
    """Tell the user where a stream does not go on as its first samples began.

    `error` and `first` are relative simulation errors, of the stream and of its first
    `n_samples`.
    """
    poor = error > min(USELESS, max(_POOR, _MUCH_WORSE * first))
    if poor and error > _GROWN * first:
        telling.once(
            "drift",
            f"The simulation error of the stream is {100.0 * error:.3g} % of the "
            f"outputs, after {100.0 * first:.3g} % over its first {n_samples:,} "
            "samples: these excite the system too little to go on from their model, "
            "or the system or its noise has changed. Begin a stream with samples that "
            "excite what comes later, or `fit` the whole table.",
        )
