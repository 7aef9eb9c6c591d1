"""What is said of samples from a loop, and of what was done about it."""

from __future__ import annotations

from ..alternatives.rivals import Doubt
from ..closed_loop.feedback import Feedback
from ..fits.local_fit import LocalFit
from ..fits.options import Choices
from ..telling import Telling

# Best fit of parts held out, percent, that leaves half their energy
_HALF_EXPLAINED = 29.3


def tell_of_feedback(
    feedback: Feedback,
    fitted: LocalFit,
    choices: Choices,
    doubt: Doubt | None,
    telling: Telling,
) -> None:
    """Tell the user of feedback, and what was done about it."""
    method = choices.method
    what = (
        "The inputs know the noise of the outputs (future inputs explain "
        f"{100.0 * feedback.share:.2g} % of the innovations, p = "
        f"{feedback.p_value:.1g}): the data come from a closed loop. "
    )
    if not feedback.shown:
        what = "The data seem to come from a closed loop. "
    elif feedback.soon:
        what += (
            "Or samples are means (as of pandas' resample().mean()) over times within "
            "which inputs move, which the next ones tell: keep single samples then. "
        )
    if doubt is not None and doubt.alternated:
        what += (
            "Or filters that know later samples have made these (filtfilt, decimate, "
            "moving means): the model of a loop alternates as no plant does. Use "
            "causal filters, the same for inputs and outputs, or none. "
        )
    loop = choices.feedthrough is True and feedback.instantaneous
    within = (
        "The input answers outputs within the sample, and these do not answer it (p = "
        f"{feedback.p_direct:.1g}): a free D would be that of the controller"
        if feedback.answered
        else "Inputs and outputs also depend on each other within the sample, and the "
        "data do not tell a feedthrough from a controller that answers at once"
    )
    if method not in ("auto", "pbsid"):
        what += (
            f"That biases method={method!r} however many samples there are. Use "
            f"method='pbsid'{', feedthrough=False' if feedback.answered else ''} (of "
            "`fit`, with the whole table), or identify with the controller's reference "
            "as input."
        )
    elif method == "pbsid" and loop:
        what += (
            f"{within}. Use feedthrough=False"
            f"{'' if feedback.answered else ' unless the controller needs a sample'}."
        )
    elif method == "pbsid":
        return
    elif feedback.cut_off:
        what += (
            "They are too few for the past that method='pbsid' needs: that of "
            "method='po-moesp' was taken, which feedback biases. Record for longer, or "
            "identify with the controller's reference as input."
        )
    elif doubt is not None:
        open_loop = fitted.method == "po-moesp"
        what += (
            f"The model of method='pbsid'{' with D = 0' if loop else ''} is "
            f"{'unstable' if doubt.grew else 'poor'} (its best fit to parts held out "
            f"is {doubt.bft:.3g} %). Taken was that of "
            f"{'method=' + repr(fitted.method) if open_loop else 'it with D free'} "
            f"({doubt.bft_taken:.3g} %), as where inputs and outputs are not sampled "
            "at once. If a controller makes the inputs"
            f"{'' if open_loop else ' without a delay of a sample'}, use "
            f"method='pbsid'{', feedthrough=False' if loop else ''}."
        )
        if loop and not open_loop and doubt.bft_taken < _HALF_EXPLAINED:
            what += (
                " Parts held out hardly tell: neither simulates them, as where "
                "disturbances move the loop more than what is added to it. Check which "
                "is known of the plant, or let the reference move more."
            )
    else:
        what += "method='pbsid' was taken, which that does not bias."
        if loop:
            what += f" {within}: D = 0 was taken."
        if loop and not feedback.answered:
            what += (
                " If the controller needs a sample to answer, say method='pbsid' "
                "yourself, which leaves D free."
            )
        if feedback.foreseen:
            what += (
                " But the inputs follow from the past: what moves them besides the "
                "controller is a few sines or less, which hardly tells the plant from "
                "the controller. Let the reference, or what is added to the inputs, "
                "move by random steps or noise."
            )
        what += (
            " A model that is only to simulate records of the same loop may do so "
            "better by method='po-moesp'."
        )
    telling.once("feedback", what)


def tell_of_answers(feedback: Feedback, telling: Telling) -> None:
    """Tell of an input that answers outputs, where D has it the other way round."""
    telling.once(
        "feedback",
        "An input answers outputs within the sample, and these do not answer it (p = "
        f"{feedback.p_direct:.1g}). If a controller makes it of them, D of this model "
        "is that of the controller: use method='pbsid', feedthrough=False. Else it is "
        "measured with noise, or the system is not linear.",
    )
