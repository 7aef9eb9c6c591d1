"""Noise that drifts: plants told by the differences of their samples.

Outputs may wander off by what inputs do not do: temperatures, biases of sensors, loads
that add up. Of any one record of that a slow state explains a good part, driven by the
inputs and an initial state of its own, as regressions of one random walk on another do
(Granger and Newbold, *Journal of Econometrics* 2, 1974); what it gains of the
likelihood is no chi-square, and the states that the plant has go astray with it. The
differences of all channels have the same plant,

    ``y[k+1] - y[k] = G(q) (u[k+1] - u[k]) + (v[k+1] - v[k])``,

and a noise that does not wander. Where v does not either, its differences hide slow
motions: the model of the samples is the better one, and likelier.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...data.preparation import Pairs
from ...systems.modes import lasting, mode_rates, n_changes
from ..closed_loop.feedback import find_feedback
from ..evidence.constants import ALIKE, CERTAIN, motion_left, with_levels
from ..evidence.offsets import Offsets, attributed
from ..evidence.residuals import lacks
from ..evidence.statistics import Evidence
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples
from ..samples.records import (
    ScaledRecords,
    centred,
    output_energy,
    scale_records,
    shorten,
)
from ..simulation_error.criterion import PRICE
from ..simulation_error.noise import Whitening
from ..simulation_error.simulation_fit import simulation_errors, with_initial_states

Array = NDArray[np.float64]

_FEWEST = 3  # samples of an experiment, for more than one difference

# Time constants per longest experiment: of noise that may be drift; of noise that may
# be it beside more noise, of which few lags tell less; of modes that may have followed
# it, with rates by that of the slowest other mode. Faster noise comes back as often as
# it drifts: of measured records the samples tell more then than their differences.
_SLOW, _SLOW_BESIDE, _FOLLOWS, _FAR = 12.0, 60.0, 1.0, 0.5

_EXPLAINED = 0.02  # relative error below which drift does not matter

_GOES = 2.0  # standard deviations of drift in which constants may be its doing

_DIFFERENCE = np.array([1.0, -1.0])  # as a filter


def differences(pairs: Pairs) -> Pairs:
    """Those of consecutive samples, (n_samples - 1, n_channels)."""
    return [(np.diff(u, axis=0), np.diff(y, axis=0)) for u, y in pairs]


def n_lasting(fitted: LocalFit) -> int:
    """Number of modes that do not decay over the longest experiment, or grow."""
    poles = np.linalg.eigvals(fitted.model.A)
    return int(lasting(poles, fitted.evidence.longest).sum())


def outlasts(fitted: LocalFit) -> bool:
    """Whether there are such modes."""
    return n_lasting(fitted) > 0


def may_drift(fitted: LocalFit) -> bool:
    """Whether the errors of a model wander, or a mode of it may do so for them.

    Of what such a mode leaves of drift, white errors are not.
    """
    evidence = fitted.evidence
    shortest = min(record.n_samples for record in evidence.records)
    if shortest < _FEWEST or motion_left(evidence) < _EXPLAINED**2:
        return False
    noise = evidence.noise.A
    slow = n_changes(noise, evidence.longest) < _SLOW
    return slow or (len(noise) > 0 and outlasts(fitted))


def of_levels(other: Evidence, scaled: ScaledRecords, n_trend: int) -> Evidence:
    """The model of differences as one of the samples themselves.

    These are `scaled`, their inputs in the combinations that the model has.
    """
    records, share = shorten(scaled.records)
    of_inputs = scaled.input_scale / other.input_scale
    of_outputs = other.output_scale / scaled.output_scale
    free = other.free._replace(n_trend=n_trend)
    weight = other.whitening.weight / of_outputs
    weight = weight / np.linalg.det(weight) ** (1.0 / len(weight))
    model = other.model.of_channels(np.diag(of_inputs), of_outputs)
    return replace(
        other,
        model=with_initial_states(model, records, free, weight),
        records=records,
        input_scale=scaled.input_scale,
        output_scale=scaled.output_scale,
        free=free,
        whitening=Whitening(np.convolve(_DIFFERENCE, other.whitening.filter), weight),
        share=share,
    )


def wanders(evidence: Evidence) -> bool:
    """Whether noise beside which there may be more is as slow as drift."""
    return n_changes(evidence.noise.A, evidence.longest) < _SLOW_BESIDE


def settles(level: LocalFit, other: LocalFit) -> bool:
    """Whether as many states of the samples as `other` has, of differences, suffice.

    For a noise that does not wander, and with none that may follow it.
    """
    slowest = mode_rates(other.model.A).min(initial=1.0)
    follows = (mode_rates(level.model.A) < _FAR * slowest).any() or outlasts(level)
    return not follows and not wanders(level.evidence)


def drifts(whole: LocalFit, other: LocalFit, doubt: float = 0.0) -> bool:
    """Whether the model of differences, `other`, is to be preferred.

    Or one like it may be, whose criterion is better by as much as is in `doubt`. Where
    errors wander, what further slow modes gain may be chance; and of equals that model
    is taken which does not say that it knows where the outputs stand. Else it must be
    better beyond chance.
    """
    better = doubt + whole.evidence.criterion - other.evidence.criterion
    if not wanders(other.evidence):
        return better > CERTAIN
    n_samples = whole.evidence.longest
    # modes of the samples that are far slower than those of their differences
    rates = mode_rates(whole.model.A)
    slowest = mode_rates(other.model.A).min(initial=1.0)
    n_followed = int((rates < min(_FOLLOWS / n_samples, _FAR * slowest)).sum())
    return better > -PRICE - CERTAIN * n_followed


def of_drifting_noise(samples: Samples, whole: LocalFit) -> LocalFit | None:
    """The model by differences of all samples; None where their noise does not drift.

    Or that of samples with as many states, where its noise does not. Where a
    controller answers the outputs, its inputs follow the drift as well.
    """
    choices = samples.choices
    weighed = choices.refine in ("auto", "prediction") and not choices.estimated
    if whole.method == "pbsid" or not weighed or not choices.initial_states:
        return None
    if whole.feedback is None or whole.feedback.found or whole.stability_loss:
        return None
    if not may_drift(whole):
        return None
    innovations = whole.feedback.innovations
    n_trend = whole.evidence.free.n_trend
    n_left = max(n_trend - 1, 0)
    moved = samples.having(method=whole.method, differences=True)
    moved = moved._replace(pairs=differences(samples.pairs))
    if choices.offset == "auto":  # where drift begins is anywhere
        n_trend = max(n_trend, 1)

    def may_be_better_so(near: LocalFit) -> bool:
        return drifts(whole, _of_samples(samples, near, n_trend), CERTAIN)

    # From a model whose noise is slow, steps on differences may lead astray.
    if not wanders(whole.evidence) and not moved.is_worth_a_choice(
        may_be_better_so, whole, n_left
    ):
        return None
    found = moved.aside().tried(n_left)
    if found is None or found.stability_loss:
        return None
    other = _of_samples(samples, found, n_trend)
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
    level, worse = samples.of_order(order, other, n_trend)
    if worse < ALIKE and settles(level, other):
        return level
    held_out = found.selection.held_out
    if held_out is not None:  # its errors, by those of all differences
        share = held_out.residual / found.residual
        held_out = held_out._replace(residual=share * other.residual)
        selection = replace(found.selection, held_out=held_out)
        other = other._replace(selection=selection)
    if n_trend == whole.evidence.free.n_trend or outlasts(other):
        return other
    return other._replace(offsets=_beyond_drift(other))


def _beyond_drift(fitted: LocalFit) -> Offsets:
    """Its offsets, without constants that may be where the noise has drifted.

    Where outputs stand, no samples tell then: they are at rest at zero, unless they are
    farther from that than drift goes.
    """
    evidence, offsets = fitted.evidence, fitted.offsets
    errors = np.vstack(simulation_errors(evidence.model, evidence.records))
    far = _GOES * errors.std(axis=0) * evidence.output_scale
    by_chance = (np.abs(offsets.pooled().constants) < far)[0]
    if by_chance.all():
        none = np.zeros_like(offsets.outputs)
        inputs = np.zeros_like(offsets.inputs)
        return offsets._replace(inputs=inputs, outputs=none, constants=none)
    left = np.where(by_chance, offsets.constants, 0.0)
    return offsets._replace(
        outputs=offsets.outputs - left, constants=offsets.constants - left
    )


def _of_samples(samples: Samples, found: LocalFit, n_trend: int) -> LocalFit:
    """The model that was `found` of the differences of samples as one of these."""
    pairs = samples.pairs
    moved, centres = centred(pairs, n_trend, samples.choices.initial_states)
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
        scaled=scaled,
    )
