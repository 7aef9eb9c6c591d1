"""From experiments to everything that `SubspaceLTI` keeps of a fit.

The options are checked (`check_options`), the records made regular, order and
horizon chosen, the model identified (`fit_pairs`), without constants of the experiments
and with them where these matter, and what is wrong with it told.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import (
    DETRENDS,
    Pairs,
    check_excitation,
    held_for,
    independent_inputs,
    remove_trends,
    stays_at_limits,
)
from ..exceptions import RankWarning, warn
from ..validation import is_whole, one_of, positive_time, real_array, shown
from .closed_loop import ClosedLoopEvidence, identify_closed_loop
from .delay import find_lead, with_later_inputs
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
from .offsets import (
    CERTAIN,
    N_TRENDS,
    USELESS,
    Offsets,
    attributed,
    constants_matter,
    follows_means_alone,
    may_have_constants,
    shifts_matter,
    with_levels,
)
from .realization import METHODS
from .residuals import find_spikes, lacks
from .selection import PlantFit, Row, Selection, better_horizon, select
from .shifts import cut_at, find_shifts
from .signals import Record, SharedSignals, share_known, shorten, thinned
from .simulation_fit import Freedom, Realization, simulation_errors
from .statistics import Evidence
from .varx import Feedback, find_feedback

Array = NDArray[np.float64]


REFINEMENTS = ("auto", "simulation", "prediction")

MISSING = ("raise", "split", "estimate")


class Choices(NamedTuple):
    """Checked options that decide about a fit.

    The method "auto" is "pbsid" where there is feedback, else "po-moesp".
    """

    order: int | None = None  # None is to be chosen
    horizon: int | None = None
    n_noise_states: int = 0
    method: str = "auto"
    feedthrough: Any = True
    refine: str | bool = "auto"
    enforce_stability: bool = False
    initial_states: bool = True  # False starts every experiment from rest
    offset: str | None = None  # "auto" is to be chosen
    # of every experiment, (n_samples, n_outputs): outputs that are estimates; none: ()
    estimated: Sequence[NDArray[np.bool_]] = ()

    def following(self, known: LocalFit) -> Choices:
        """What was chosen for samples that tell the same."""
        evidence, refine = known.evidence, self.refine
        if refine == "auto" and known.method != "pbsid":
            refine = "simulation" if evidence.whitening.is_none else "prediction"
            refine = refine if evidence.refined or known.stability_loss else False
        return self._replace(
            order=known.selection.order,
            horizon=known.selection.horizon,
            method=known.method,
            feedthrough=self.feedthrough if evidence.free.direct.any() else False,
            refine=refine,
            offset=DETRENDS[evidence.free.n_trend],
        )

    def settings(
        self, n_outputs: int, n_inputs: int, basis: Array, n_trend: int = 0
    ) -> Settings:
        """How models of these channels are made.

        `basis` (n_inputs, rank) are the original inputs in terms of the independent
        ones, which the models have; `n_trend` as in `Freedom`.
        """
        mask = _feedthrough_mask(self.feedthrough, n_outputs, n_inputs, basis.shape[1])
        return Settings(
            Freedom(mask, self.initial_states, n_trend),
            self.method,
            self.refine is not False,
            self.enforce_stability,
            self.n_noise_states,
            weigh=self.refine in ("auto", "prediction"),
            compare=self.refine == "auto",
        )


def check_options(options: Mapping[str, Any]) -> Choices:
    """Refuse what is not an option of `SubspaceLTI`, naming those that are."""
    one_of("method", options["method"], ("auto", *METHODS, "pbsid"))
    one_of("stability", options["stability"], ("warn", "enforce"))
    one_of("initial_state", options["initial_state"], ("estimate", "rest"))
    one_of("missing", options["missing"], MISSING)
    one_of("detrend", options["detrend"], DETRENDS)
    one_of("offset", options["offset"], tuple(N_TRENDS))
    one_of("refine", options["refine"], (*REFINEMENTS, True, False))
    _feedthrough(options["feedthrough"])
    if options["sampling_time"] is not None:
        positive_time("sampling_time", options["sampling_time"])
    if options["initial_state"] == "rest" and options["missing"] == "split":
        raise ValueError(
            "`initial_state` must be 'estimate' with missing='split': what follows a "
            "gap does not start from rest. Got 'rest'."
        )
    offset = options["offset"]
    if options["detrend"] is not None and offset == "auto":
        offset = None  # what is to become of offsets was said
    return Choices(
        _integer_or_auto("order", options["order"], 0),
        _integer_or_auto("horizon", options["horizon"], 1),
        _integer_or_auto("n_noise_states", options["n_noise_states"], 0) or 0,
        options["method"],
        options["feedthrough"],
        REFINEMENTS[0] if options["refine"] is True else options["refine"],
        options["stability"] == "enforce",
        options["initial_state"] == "estimate",
        offset,
    )


def _integer_or_auto(name: str, value: Any, lowest: int) -> int | None:
    if isinstance(value, str) and value == "auto":
        return None
    if not is_whole(value) or value < lowest:
        raise ValueError(
            f"`{name}` must be 'auto' or an integer of at least {lowest}. Got "
            f"{shown(value)}."
        )
    return int(value)


def _feedthrough(value: Any) -> NDArray[np.bool_]:
    """The option as one or a table of booleans."""
    try:
        mask = real_array("feedthrough", value)
    except ValueError:
        mask = np.full(1, np.nan)
    if not np.isin(mask, (0.0, 1.0)).all():
        raise ValueError(
            "`feedthrough` must be True, False or a table of them, shape (n_outputs, "
            f"n_inputs). Got {shown(value)}."
        )
    return mask.astype(bool)


def _feedthrough_mask(
    feedthrough: Any, n_outputs: int, n_inputs: int, rank: int
) -> NDArray[np.bool_]:
    """Free entries of D for the independent inputs, (n_outputs, rank)."""
    mask = _feedthrough(feedthrough)
    if mask.ndim == 0:
        return np.full((n_outputs, rank), mask)
    if mask.shape != (n_outputs, n_inputs):
        raise ValueError(
            "`feedthrough` must be True, False or a table of shape (n_outputs, "
            f"n_inputs) = ({n_outputs}, {n_inputs}). Got shape {mask.shape}."
        )
    if rank == n_inputs or mask.all() or not mask.any():
        return mask[:, :rank]
    raise ValueError(
        "`feedthrough` cannot fix single entries of D while inputs are collinear. "
        "Leave all but one of the collinear inputs out."
    )


class TooFewSamples(ValueError):
    """The samples do not tell enough for a model; more of them may."""


class LocalFit(NamedTuple):
    """A fitted model and what is known of it."""

    model: Realization  # of the scaled samples
    singular_values: Array
    residual: float
    stability_loss: float
    selection: Selection
    evidence: Evidence
    method: str  # that made the model
    feedback: Feedback | None  # None where the samples are too few for its test
    offsets: Offsets  # of the experiments, what `detrend` subtracted among them
    first_model: Realization  # of `scaled`, the samples that were fitted as one table:
    scaled: ScaledRecords  # all of them, or the first ones of a long table or a stream
    signals: SharedSignals  # of this model and samples like these

    def follows(self, order: int, settings: Settings) -> bool:
        """Whether it leads to a model of other samples with these settings."""
        own, free = self.evidence.free, settings.free
        same = own.n_trend == free.n_trend and own.direct.shape == free.direct.shape
        same &= order == self.selection.order and self.method == settings.method
        return same and settings.refine and self.evidence.refined

    def candidate(self, output_scale: Array) -> Candidate:
        """The model of outputs in another scale."""
        evidence, horizon = self.evidence, self.selection.horizon
        ratio = evidence.output_scale / output_scale
        model = evidence.model._replace(C=evidence.model.C * ratio[:, None])
        return Candidate(model, horizon, evidence.whitening, True, self.signals)


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
    pairs, u_mean, y_mean = remove_trends(pairs, detrend)
    fitted = _with_constants(pairs, choices, told, known)
    if fitted.selection.order:
        if "held" not in told:
            _tell_of_held_outputs(outputs, told)
        if "limit" not in told:
            _tell_of_limits(outputs, fitted, told)
    # The errors of a rough model are not the noise that shifts must stand out of.
    cuts = choices.offset == "auto" and choices.initial_states and choices.refine
    if cuts and not choices.estimated:
        pairs, fitted = _without_shifts(pairs, choices, told, fitted)
    doubt = None
    if fitted.method == "pbsid" and (choices.method == "auto" or choices.order is None):
        fitted, doubt = _believable(pairs, choices, told, fitted)
    feedback = fitted.feedback
    if feedback is not None and feedback.found and "feedback" not in told:
        _tell_of_feedback(feedback, fitted, choices, doubt, told)
        if known is None:
            _tell_of_lead(pairs, choices, told, fitted)
    if detrend is None:
        return fitted
    return fitted._replace(offsets=fitted.offsets.shifted(u_mean, y_mean))


def _tell_of_held_outputs(outputs: Sequence[Array], told: set[str]) -> None:
    """Tell of outputs that are sampled more slowly than the table."""
    held = [held_for([y[:, i] for y in outputs]) for i in range(outputs[0].shape[1])]
    slowest = max(held)
    if slowest > 1:
        tell(
            told,
            "held",
            f"Output {held.index(slowest) + 1} keeps its values for {slowest} samples: "
            "it was sampled more slowly than the table, and held in between as the "
            f"response of no linear system is. Take one row of every {slowest} (the "
            "first of each value), or `resample`.",
        )


def _tell_of_limits(outputs: Sequence[Array], fitted: LocalFit, told: set[str]) -> None:
    """Tell of an output that stays at a limit where its model moves on."""
    model, records = fitted.evidence.model, fitted.scaled.records
    stays = [
        stays_at_limits([y[:, i] for y in outputs]) for i in range(outputs[0].shape[1])
    ]
    if not any(map(any, stays)) or len(model.initial_states) != len(records):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        moves = [model.outputs(record, k) for k, record in enumerate(records)]
        least = _MOVES_ON * np.std(np.vstack(moves), axis=0)
    for i in np.flatnonzero(np.isfinite(least)):
        passed = [
            (y[start, i], stop - start)
            for y, moved, parts in zip(outputs, moves, stays[i], strict=True)
            for start, stop in parts
            if np.std(moved[start:stop, i]) > least[i]
        ]
        n_passed = sum(n for _, n in passed)
        if n_passed > _AT_LIMITS * sum(map(len, outputs)):
            values = ", ".join(f"{v:.6g}" for v in sorted({v for v, _ in passed}))
            tell(
                told,
                "limit",
                f"Output {i + 1} stays at {values} for {n_passed} samples in which "
                "its model moves on: it is at a limit, of its sensor or of the plant, "
                "as no linear system has one. Record within the limits, or use NaN "
                "for them and missing='estimate', and compare.",
            )


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
    if choices.offset == "auto" and (hides or may_have_constants(tested)):
        other = _fit(pairs, judged, told, 1, fitted)
        if constants_matter(tested, other.evidence.one_step):
            fitted, n_trend = other, 1
    return _fit(pairs, choices, told, n_trend, fitted) if rough else fitted


def _without_shifts(
    pairs: Pairs, choices: Choices, told: set[str], whole: LocalFit
) -> tuple[Pairs, LocalFit]:
    """Cut the experiments where levels shift, if that explains them clearly better.

    One step ahead, where noise alone explains all that moves slowly: parts that leave
    inputs nothing to explain must simulate as much of what is held out as the whole.
    Short ones hide in their initial states that a mode would grow.
    """
    feedback = whole.feedback
    if feedback is None:
        return pairs, whole
    shifts = find_shifts(whole.scaled.records, feedback.regression)
    if not any(shifts):
        return pairs, whole
    parts = cut_at(pairs, shifts)
    try:
        fitted = _fit(parts, choices, told, 1, whole)
    except TooFewSamples:
        return pairs, whole
    if not shifts_matter(whole.evidence.one_step, fitted.evidence.one_step):
        return pairs, whole
    if _grows(fitted) and not _grows(whole):
        return pairs, whole
    if whole.selection.order and not fitted.selection.order:
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

    Where inputs and outputs depend on each other within the sample, data do not tell a
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


class _Doubt(NamedTuple):
    """Why the first model of a closed loop was given up."""

    bft: float  # on parts held out, percent
    bft_taken: float  # of the model that was taken instead
    grew: bool  # whether it was unstable


def _believable(
    pairs: Pairs, choices: Choices, told: set[str], first: LocalFit
) -> tuple[LocalFit, _Doubt | None]:
    """The first model of a closed loop, or one that refutes it on parts held out.

    Its like of the order that "po-moesp" takes is one: prediction, by which the order
    in a loop is chosen, hardly sees of a plant what outputs tell themselves. Where the
    method is free, that with D free where the first has none by default is another, and
    the model of "po-moesp". The latter minimises the simulation error, and so does
    better than the plant itself by what the inputs tell of the noise: that does not
    refute the plant unless inputs were to be noise more than anything else
    (`_OF_NOISE`), or the plant is unstable, by no more than chance, and the other is
    not; or D was left free for a stable plant, but fits these parts no better.
    """
    n_trend = first.evidence.free.n_trend
    without_d = not first.evidence.free.direct.any()
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
        if without_d and choices.feedthrough is not False:
            other, found = rival(method="pbsid")
            better = found.total < _OF_NOISE * error.total
            # data do not tell it apart from the first
            if better or _grows(best, _CERTAIN) and not _grows(other, _CERTAIN):
                makeshift = found.total > error.total
                best, error = other, found
        better = of_that.total < _OF_NOISE * error.total
        unsure = makeshift or (_grows(best) and not _grows(best, _CERTAIN))
        if unsure and not _grows(open_loop):
            better |= of_that.clearly_better_than(error, _DOUBT)
        if better:
            best, error = open_loop, of_that
    except TooFewSamples:
        pass
    if best is first:
        return first, None
    doubt = _Doubt(before.bft, error.bft, _grows(first))
    if n_trend and choices.offset == "auto":  # constants are judged anew
        chosen = choices._replace(method=best.method)
        best = _with_constants(pairs, chosen, told, best)
    return best, doubt


def _held_out(fitted: LocalFit, choices: Choices) -> HeldOut:
    """Errors of a fit's like on parts held out."""
    evidence, scaled = fitted.evidence, fitted.scaled
    free, horizon = evidence.free, fitted.selection.horizon
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
        refitted = evidence.of_others
    else:

        def refitted(train: list[Record]) -> Realization:
            part = scaled._replace(records=train)
            basis, order = evidence.basis, choices.order
            return identify_closed_loop(
                part, basis, order, choices.horizon, settings
            ).evidence.model

    try:
        return held_out(refitted, scaled.records, at_rest=not free.initial_states)
    except ValueError:  # too few samples are left
        return HeldOut([], np.nan)


def _grows(fitted: LocalFit, deviations: float = 0.0) -> bool:
    """Whether a pole lies outside the unit circle, by so many standard deviations."""
    poles = fitted.evidence.state_space(fitted.model, 1.0).poles()
    growth, spread = np.abs(poles) - 1.0, np.zeros(len(poles))
    if deviations and (growth > 0.0).any():
        try:
            spread = np.abs(fitted.evidence.poles_std())
        except ValueError:  # it is not known
            return False
    return bool((growth > deviations * spread).any())


def _tell_of_feedback(
    feedback: Feedback,
    fitted: LocalFit,
    choices: Choices,
    doubt: _Doubt | None,
    told: set[str],
) -> None:
    """Tell the user of feedback, and what was done about it."""
    method = choices.method
    what = (
        "The inputs know the noise of the outputs (future inputs explain "
        f"{100.0 * feedback.share:.2g} % of the innovations, p = "
        f"{feedback.p_value:.1g}): the data come from a closed loop. "
    )
    loop = bool(np.any(choices.feedthrough)) and feedback.instantaneous
    within = (
        "Inputs and outputs also depend on each other within the sample, and the data "
        "do not tell a feedthrough from a controller that answers at once"
    )
    if method not in ("auto", "pbsid"):
        what += (
            f"That biases method={method!r} however many samples there are. "
            "Use method='pbsid', or identify with the controller's reference as input."
        )
    elif method == "pbsid" and loop:
        what += (
            f"{within}. "
            "Use feedthrough=False unless the controller needs a sample to answer."
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
    else:
        what += "method='pbsid' was taken, which that does not bias."
        if loop and choices.feedthrough is True:
            what += (
                f" {within}: D = 0 was taken. If the controller needs a sample to "
                "answer, say method='pbsid' yourself, which leaves D free."
            )
        what += (
            " A model that is only to simulate records of the same loop may do so "
            "better by method='po-moesp'."
        )
    tell(told, "feedback", what)


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
    try:
        other = _fit(with_later_inputs(pairs, lead), plain, set(told), n_trend)
    except TooFewSamples:
        return
    if other.feedback is None or other.feedback.found:
        return
    # A reference of a few lines is the free motion of modes that do not decay.
    if 1.0 - spectral_radius(other.model.A) < _LINE / max(len(u) for u, _ in pairs):
        return
    found, error = _held_out(other, plain), _held_out(fitted, choices)
    if found.total < (_OF_NOISE if _grows(fitted) else _LED) * error.total:
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


def warn_about_horizon(fitted: LocalFit, choices: Choices) -> None:
    """Tell the user when another horizon fits clearly better than the one given."""
    if fitted.method == "pbsid":
        return
    settings = Settings(
        fitted.evidence.free,
        fitted.method,
        choices.refine is not False,
        choices.enforce_stability,
    )
    better = better_horizon(
        fitted.first_model,
        fitted.residual,
        fitted.scaled.records,
        fitted.selection.horizon,
        settings,
    )
    if better is not None:
        warn(
            f"horizon={choices.horizon} ends in a poor model: its simulation error is "
            f"{100.0 * fitted.residual:.3g} % of the outputs, that of horizon "
            f"{better[0]} is {100.0 * better[1]:.3g} %. Use horizon='auto'."
        )


# A model of like samples has led into another minimum where the error ends this many
# times as large as theirs; between realizations of noise it varies by a few per cent.
_WORSE = 1.2

# Share of its motion by which a model moves where an output stays, and of the samples
_MOVES_ON, _AT_LIMITS = 0.05, 0.01

# Share of the squared errors that later inputs leave where the outputs lead them; time
# constants per experiment of a mode that may be a line of a reference
_LED, _LINE = 0.1, 3.0

# Share of the outputs' size left unexplained that constants may be the reason of
_HARDLY = 0.4

# What is told from tests that take as long as a fit
TESTS = {"held out", "orders", "static gain", "decay", "lack"}

# Share of the squared errors of a plant in a loop that must be left of them for another
# model not to refute it; standard errors by which a lesser one must be better where the
# plant grows; standard deviations by which a pole does so for certain.
_OF_NOISE, _DOUBT, _CERTAIN = 0.5, 2.0, 3.0

_HALF = 0.5  # share of their energy that enforced stability must cost to be reported
# Share of its fit (one less the relative error) that parts held out must confirm; with
# 200 samples at equal noise and signal a right model comes to two thirds.
_CONFIRMED = 0.5

_ENOUGH = 100  # samples, for parts of them to tell anything


# A standard deviation of the static gain by the root mean square of the response of its
# output to all inputs as they move: above it, a gain that is not known matters.
_OPEN = 0.3

# Standard deviations of a pole, for its decay to be known; and one over the longest
# experiment that matters: an integrator is known better.
_DECAYS, _MATTERS = 2.0, 0.1

# A pole on the unit circle is found this far outside at most; inside, an enforced one
# keeps farther away than the second.
_OUTSIDE, _INSIDE = 1e-8, 1e-9

# A stream fits much worse than its first samples where its error exceeds theirs by
# this factor, and this share of the outputs' size.
_MUCH_WORSE, _POOR = 5.0, 0.2

# What was poor from the start was told then; it is told again where it grows by this.
_GROWN = 1.1


def tell(
    told: set[str], kind: str, message: str, category: type[Warning] = UserWarning
) -> None:
    """Warn of a kind of thing that was not told before; from now on it was."""
    if kind not in told:
        told.add(kind)
        warn(message, category)


def warn_about(fitted: LocalFit, told: set[str]) -> None:
    """Tell the user what is wrong with a model that is returned all the same.

    `told` are the kinds of warnings that are not repeated; it grows by these.
    """
    model, residual = fitted.model, fitted.residual
    chose_order = len({row.order for row in fitted.selection.rows}) > 1
    if model.rank_deficit:
        tell(
            told,
            "rank",
            f"The data leave {model.rank_deficit} directions of B and D "
            "undetermined; the smallest solution was taken. Excite the inputs "
            "more richly, or lower `order`.",
            RankWarning,
        )
    warn_about_pole(model.A, told, fitted.method)
    as_found = residual - fitted.stability_loss
    if residual**2 - as_found**2 > _HALF:
        tell(
            told,
            "enforced",
            "No stable model explains these outputs: the simulation error is "
            f"{100.0 * residual:.0f} % of their size with stability='enforce', "
            f"{100.0 * as_found:.3g} % without. The system seems to be unstable: "
            "identify it with stability='warn', or from a record of bounded outputs, "
            "with the controller's reference as input.",
        )
    elif residual > USELESS:
        tell(
            told,
            "useless",
            "The model explains next to nothing of the outputs: its simulation "
            f"error is {100.0 * residual:.0f} % of their size. Try a longer "
            "`horizon` or order='auto', and check that inputs and outputs belong "
            "together and in the order of time.",
        )
    elif follows_means_alone(fitted.evidence):
        higher = "" if chose_order else ", order='auto'"
        tell(
            told,
            "useless",
            "The model explains where the outputs stay, and next to nothing of how "
            f"they move. Try offset='constant'{higher} or a longer `horizon`, and "
            "check that inputs and outputs belong together and in the order of time.",
        )
    _warn_of_spikes(fitted, told)
    choice_is_told = TESTS <= told or residual > USELESS
    if fitted.selection.held_out is not None and not choice_is_told:
        _warn_about_choice(fitted, fitted.selection.held_out, told)
    feedback = None if fitted.method == "pbsid" else fitted.feedback
    if feedback is None or fitted.stability_loss or "lack" in told:
        return
    if lacks(fitted.evidence, feedback.innovations):
        remedy = "a higher `order`" if chose_order else "order='auto'"
        # Without figures, so that a search over orders says it once of each.
        tell(
            told,
            "lack",
            "The simulation error depends on past inputs, which explain more than a "
            f"tenth of it: the model of order {len(model.A)} lacks states, a delay or "
            f"a nonlinearity. Try {remedy}, `input_delay`, or, if the system is "
            "nonlinear, smaller inputs; `residual_tests` tells which input it is.",
        )


def _warn_of_spikes(fitted: LocalFit, told: set[str]) -> None:
    """Tell of samples that a sensor may have got wrong: the model follows them."""
    spikes = None if "spikes" in told else find_spikes(fitted.evidence)
    if spikes is None:
        return
    several, n = len(fitted.evidence.records) > 1, spikes.n_found
    tell(
        told,
        "spikes",
        f"{n} sample(s) of output {spikes.output + 1} stand far out of the "
        f"errors of the model and make {100.0 * spikes.share:.0f} % of their squares; "
        f"the farthest is sample {spikes.sample}"
        f"{f' of experiment {spikes.experiment}' if several else ''}, counted from 0. "
        "If a sensor got them wrong, they spoil the model: replace them by NaN and use "
        "missing='estimate'.",
    )


def _warn_about_choice(fitted: LocalFit, held_out: HeldOut, told: set[str]) -> None:
    """Tell what the samples do not confirm of a model of automatic order.

    Without figures, so that a search says it once.
    """
    if sum(record.u.shape[1] for record in fitted.evidence.records) < _ENOUGH:
        return
    if 1.0 - held_out.residual < _CONFIRMED * (1.0 - fitted.residual):
        tell(
            told,
            "held out",
            "The model simulates parts of the record that it was not fitted to far "
            "worse than the others (`selection_`): the system is nonlinear, changes "
            "over the record or drifts, or the record is too short for it. Give a "
            "lower `order`, leave disturbed parts out, or use offset='linear'.",
        )
    if _disputed(fitted):
        tell(
            told,
            "orders",
            "Parts held out took fewer states than the likelihood asks for, by more "
            "than chance explains (`selection_`): the system is not quite linear, or "
            "changes over the record, or its inputs move too seldom for parts to tell. "
            "Compare both orders on another record, or give one with inputs that move "
            "more often, and less far if the system is not linear.",
        )
    if _may_last(fitted):
        tell(
            told,
            "decay",
            "A mode of the model does not decay over the longest experiment, nor by "
            "more than the standard deviation of its poles (`poles_std_`). It may be "
            "an integrator (name its outputs in `integrating`), stand for a drift that "
            "the inputs do not explain, or for a system that is not linear: it may "
            "simulate other records poorly. Give a lower `order`, or record for "
            "longer, with inputs that move more often.",
        )

    gain = fitted.evidence.static_gain()
    if gain is None:
        return
    unknown = (gain.std > np.abs(gain.value)) & (gain.std > _OPEN * gain.size)
    if unknown.any():
        output, which = np.argwhere(unknown)[0] + 1
        tell(
            told,
            "static gain",
            f"The static gain (from input {which} to output {output}) is known no "
            "better than to its own size: the record excites slow motions too little "
            "to tell it. Record for longer, with inputs that are held for longer, or "
            "lower `order`; at higher frequencies the model may be right "
            "(`frequency_response_std`).",
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
    lengths = [record.u.shape[1] for record in fitted.scaled.records]
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


def warn_about_pole(A: Array, told: set[str], method: str = "po-moesp") -> None:
    """Tell the user that a model is unstable, or on the border of that."""
    moduli = np.abs(np.linalg.eigvals(A))
    radius = float(moduli.max(initial=0.0))
    if radius > 1.0 + _OUTSIDE:
        remedy = (
            "Use stability='enforce' for a stable one, another `order`, or a longer "
            "`horizon`."
        )
        if method == "pbsid":
            remedy = (
                "Such a plant can be predicted (`predict_ahead`), but not simulated "
                "for long nor brought into a structure: for that, identify the closed "
                "loop, with the controller's reference as input."
            )
        tell(
            told,
            "pole",
            f"The identified model is unstable: a pole has modulus {radius:.6g}. "
            + remedy,
        )
    elif radius >= 1.0 - _INSIDE:
        count = int((moduli >= 1.0 - _INSIDE).sum())
        tell(
            told,
            "border",
            "The identified model is on the border of stability, by integrators or "
            f"undamped oscillations: {count} of its poles at modulus 1, to rounding. "
            "Its outputs may grow without end, and no chain of local "
            "models takes it. Name outputs that integrate in `integrating`; otherwise "
            "use stability='enforce', or another `order`.",
        )


def warn_about_drift(
    error: float, first: float, n_samples: int, told: set[str]
) -> None:
    """Tell the user where a stream does not go on as its first samples began.

    `error` and `first` are relative simulation errors, of the stream and of its first
    `n_samples`.
    """
    poor = error > min(USELESS, max(_POOR, _MUCH_WORSE * first))
    if poor and error > _GROWN * first:
        tell(
            told,
            "drift",
            f"The simulation error of the stream is {100.0 * error:.3g} % of the "
            f"outputs, after {100.0 * first:.3g} % over its first {n_samples:,} "
            "samples: these excite the system too little to go on from their model, "
            "or the system or its noise has changed. Begin a stream with samples that "
            "excite what comes later, or `fit` the whole table.",
        )
