"""One fit: of these samples, with these trends.

Order and horizon are chosen where they are not given, the method by whether inputs know
the noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.preparation import Pairs, independent_inputs
from ...exceptions import RankWarning
from ..closed_loop.feedback import Feedback, find_feedback
from ..closed_loop.pbsid import identify_closed_loop
from ..closed_loop.plant_and_noise import ClosedLoopEvidence
from ..evidence.constants import with_levels, without_slow_modes
from ..evidence.offsets import attributed
from ..evidence.statistics import Evidence
from ..orders.identification import Settings, identify, validate
from ..orders.selection import PlantFit, Row, Selection, select
from ..samples.records import (
    Record,
    ScaledRecords,
    centred,
    scale_records,
    share_known,
    shorten,
)
from ..simulation_error.held_out import HeldOut, held_out
from ..simulation_error.signals import SharedSignals
from ..simulation_error.simulation_fit import Realization, simulation_errors
from ..telling import Telling
from .local_fit import LocalFit
from .options import Choices

Array = NDArray[np.float64]

# A model of like samples has led into another minimum where the error ends this many
# times as large as theirs; between realizations of noise it varies by a few per cent.
_WORSE = 1.2


class TooFewSamples(ValueError):
    """The samples do not tell enough for a model; more of them may."""


class Samples(NamedTuple):
    """Samples, how models of them are to be chosen, and what is told meanwhile."""

    pairs: Pairs
    choices: Choices
    telling: Telling

    def having(self, **chosen: Any) -> Samples:
        """The same with other choices."""
        return self._replace(choices=self.choices._replace(**chosen))

    def aside(self, *kinds: str) -> Samples:
        """The same of which nothing is told, or nothing but of other kinds."""
        return self._replace(telling=self.telling.aside(*kinds))

    def fit(self, n_trend: int, like: LocalFit | None = None) -> LocalFit:
        """Choose and identify, with `n_trend` trends of every output and experiment.

        What is known of a model of the same samples with other trends, or of others
        `like` them, is the feedback, whose test gives every experiment a constant.
        `TooFewSamples` where they do not tell enough.
        """
        choices, order, horizon = self.choices, self.choices.order, self.choices.horizon
        pairs, centres = centred(self.pairs, n_trend, choices.initial_states)
        n_inputs, n_outputs = pairs[0][0].shape[1], pairs[0][1].shape[1]
        try:
            pairs, basis = _with_independent_inputs(pairs, self.telling)
            settings = choices.settings(n_outputs, n_inputs, basis, n_trend)
            if settings.method != "pbsid":
                settings.check_size([len(u) for u, _ in pairs], order, horizon)
        except ValueError as error:
            raise TooFewSamples(str(error)) from None
        scaled = scale_records(pairs, n_trend, choices.estimated)
        feedback = find_feedback(scaled.records) if like is None else like.feedback
        settings = _heed(feedback, settings, choices.feedthrough is True)
        if settings.method == "pbsid":
            try:
                near = None if like is None else like.evidence
                plant = identify_closed_loop(
                    scaled, basis, order, horizon, settings, near
                )
                found = plant.selection.order
                if order is None and found not in (settings.orders or [found]):
                    # a state too few spoils the plant, one too many costs little
                    enough = (n for n in settings.orders if n > found)
                    order = min(enough, default=settings.orders[-1])
                    plant = identify_closed_loop(
                        scaled, basis, order, horizon, settings
                    )
            except ValueError as error:
                raise TooFewSamples(str(error)) from None
        else:
            plant = _identify_open_loop(scaled, basis, order, horizon, settings, like)
        offsets = attributed(plant.evidence, centres, self.pairs)
        evidence, offsets = with_levels(plant.evidence, offsets)
        residual = plant.residual
        if choices.estimated:
            residual = _residual_of_known(evidence, settings.method, residual)
        return LocalFit(
            model=evidence.model,
            singular_values=plant.singular_values,
            residual=residual,
            stability_loss=plant.stability_loss,
            selection=plant.selection,
            evidence=evidence,
            method=settings.method,
            feedback=feedback,
            offsets=offsets,
            scaled=scaled,
            signals=SharedSignals(),
        )

    def tried(self, n_trend: int, like: LocalFit | None = None) -> LocalFit | None:
        """As `fit`; None where the samples do not tell enough."""
        try:
            return self.fit(n_trend, like)
        except TooFewSamples:
            return None

    def of_order(
        self, order: int, other: LocalFit, n_trend: int
    ) -> tuple[LocalFit, float]:
        """The model of that order, with these trends.

        And by how much its criterion is worse than that of the `other`, whose choice of
        the order it keeps.
        """
        found = self.having(order=order).fit(n_trend)
        selection = found.selection.among(other.selection)
        return found._replace(selection=selection), found.worse_than(other)

    def is_worth_a_choice(
        self, promising: Callable[[LocalFit], bool], fitted: LocalFit, n_trend: int
    ) -> bool:
        """Whether to choose among all orders again, with other trends or samples.

        That takes as long as the first choice. Few steps lead from the model `fitted`
        to one of its order, and to those without each one of the modes that may be
        constants: unless these tell nothing of other orders, one of them must be
        promising, or one of a state less that begins at its own subspace.
        """
        evidence = fitted.evidence
        others = without_slow_modes(evidence)
        if others is None or not evidence.refined:
            return True
        own = evidence.model.A, evidence.model.C
        try:
            for A, C in [own, *others]:
                if promising(self.near(fitted, A, C, n_trend)):
                    return True
            lower = len(evidence.model.A) - 1
            anew = self._like(fitted).having(order=lower)
            return lower > 0 and promising(anew.fit(n_trend, fitted))
        except TooFewSamples:  # for that horizon
            return True

    def near(self, fitted: LocalFit, A: Array, C: Array, n_trend: int) -> LocalFit:
        """The model with other trends that few steps from one with A and C lead to.

        In the scale of the one `fitted`, of the same samples.
        """
        evidence = fitted.evidence
        start = fitted._replace(
            evidence=replace(
                evidence,
                model=evidence.model._replace(A=A, C=C, blocks=None),
                free=evidence.free._replace(n_trend=n_trend),
            ),
            selection=Selection(len(A), fitted.selection.horizon, []),
            residual=np.inf,  # whatever comes of it
        )
        return self._like(fitted).having(order=len(A)).fit(n_trend, start)

    def _like(self, fitted: LocalFit) -> Samples:
        """Choosing no other horizon or method than a fit did."""
        chosen = self.having(horizon=fitted.selection.horizon, refine="prediction")
        return chosen.having(method=fitted.method).aside("collinear")

    def errors_held_out(self, fitted: LocalFit) -> HeldOut:
        """Errors of a fit's like on parts held out."""
        evidence, scaled, choices = fitted.evidence, fitted.scaled, self.choices
        free = evidence.free._replace(initial_states=True)  # what is left is in motion
        settings = fitted.settings(choices)._replace(free=free)
        if fitted.method != "pbsid":
            like = fitted.candidate(evidence.output_scale)
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


def _identify_open_loop(
    scaled: ScaledRecords,
    basis: Array,
    order: int | None,
    horizon: int | None,
    settings: Settings,
    like: LocalFit | None,
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


def _with_independent_inputs(pairs: Pairs, telling: Telling) -> tuple[Pairs, Array]:
    """Replace collinear inputs by independent combinations of them, and say so.

    The input matrix in the original inputs is that of the new ones times ``basis.T``,
    the second value; the identity in the usual case.
    """
    n_inputs = pairs[0][0].shape[1]
    basis = independent_inputs([u for u, _ in pairs])
    if basis is None:
        return pairs, np.eye(n_inputs)
    if not basis.shape[1]:
        raise ValueError(
            "An input must move within an experiment: what it does by its levels alone "
            "cannot be told from constants of the experiments. Give records in which "
            "it moves, make one experiment of them, or use offset=None."
        )
    telling.once(
        "collinear",
        f"The {n_inputs} inputs are collinear (rank {basis.shape[1]}): their separate "
        "effects are not identifiable and the smallest solution was taken. Excite the "
        "inputs independently.",
        RankWarning,
    )
    return [(u @ basis, y) for u, y in pairs], basis
