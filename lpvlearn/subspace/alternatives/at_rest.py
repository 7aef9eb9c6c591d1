"""Experiments that begin at a stand: models of which these begin at rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.beginnings import Stands, first_inputs, pulsed, stands
from ...systems.modes import HARDLY_DECAYS, n_decays
from ..evidence.constants import ALIKE, CERTAIN, stands_by_chance
from ..evidence.statistics import Evidence
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples, TooFewSamples
from ..simulation_error.criterion import PRICE
from ..simulation_error.simulation_fit import simulation_errors
from .trends import with_trends

Array = NDArray[np.float64]

# Times the squared errors of free initial states, of rest at the beginning; and the
# least of it that is told from none.
_NOT_FAR_WORSE, _LEAST = 3.0, 1e-30

_MAY_BE = 2.0  # times that states must balance each other, of what may be by chance


class AtRest(NamedTuple):
    """A model of experiments that begin at rest, and what it is one of."""

    samples: Samples  # inputs less those that the experiments begin with
    fitted: LocalFit
    first: Array  # (n_experiments, n_inputs): those inputs


def from_rest(samples: Samples, free: LocalFit, like: LocalFit | None) -> AtRest | None:
    """The model of experiments that begin at a stand, if as likely as the `free` one.

    At their first inputs, or at those that they come back to after an impact. Or
    likelier than that of experiments which are said to begin at rest, at inputs of
    zero. Else others `like` them tell how these begin.
    """
    pairs, choices, _ = samples
    asked, said = choices.offset in ("auto", "constant"), not choices.initial_states
    if like is not None and not said:
        asked = not like.evidence.free.initial_states
    if not asked or free.method == "pbsid" or not len(free.model.A):
        return None
    stand = stands(pairs)
    if stand is None and said:  # where it is not to be seen
        stand = Stands(np.array([first_inputs(u) for u, _ in pairs]), False)
    pulses = None if stand is not None and stand.seen else pulsed(pairs)
    found = [
        one
        for how in (stand, pulses)
        if how is not None and (one := _at(how, samples, free)) is not None
    ]
    costs = [one.fitted.evidence.one_step.criterion for one in found]
    as_likely = [
        one
        for one, cost in zip(found, costs, strict=True)
        if cost <= min(costs) + ALIKE
    ]
    # A step after one sample is as well an impact on another plant, of which most acts
    # at once; and an impact a step of one that has next to no static gain.
    return min(as_likely, key=lambda one: _direct(one.fitted), default=None)


def _direct(fitted: LocalFit) -> float:
    """Which part of the static gain acts at once, in the units of the samples."""
    model = fitted.evidence.state_space(fitted.model, 1.0)
    gain = np.linalg.norm(model.dc_gain())
    return float(np.linalg.norm(model.D) / gain) if gain > 0.0 else np.inf


def _at(stand: Stands, samples: Samples, free: LocalFit) -> AtRest | None:
    """The model of experiments that begin at such a stand, if as likely as `free`."""
    (pairs, choices, _), (first, seen) = samples, stand
    said, evidence = not choices.initial_states, free.evidence
    at_rest = samples.having(initial_states=False)
    if first.any():  # a level is that of the answer to these
        sure = said or choices.offset == "constant" or bool(evidence.free.n_trend)
        if not sure and not stands_by_chance(evidence.one_step, _MAY_BE):
            return None  # without a constant it is that to zero
        seen &= sure or stands_by_chance(evidence.one_step)
        at_rest = at_rest.having(offset="constant")
    elif said:
        return None
    moved = [(u - level, y) for (u, y), level in zip(pairs, first, strict=True)]
    at_rest = at_rest._replace(pairs=moved)
    fitted = _as_likely(at_rest, free, seen)
    return None if fitted is None else AtRest(at_rest, fitted, first)


def _as_likely(samples: Samples, free: LocalFit, seen: bool) -> LocalFit | None:
    """The model from rest, unless that is less likely than `free` initial states.

    These and a constant may balance each other for as long as inputs stand still, and
    leave of the static gain what noise makes of it. Of rest that is not `seen` in the
    outputs, or instead of a drift, likelihood is asked for more. The criterion, to
    which the first errors count little, may be met by noise that takes what states do:
    so the errors themselves must hardly be larger.
    """
    try:
        fitted = with_trends(samples, free)
    except TooFewSamples:
        return None
    own, other = fitted.evidence, free.evidence
    order, said = len(other.model.A), not other.free.initial_states
    more = said and len(own.model.A) > order  # which may be why it is likelier
    if not more and _is_as_likely(own, other, seen):
        return fitted
    if len(own.model.A) in (0, order):
        return None
    # states may be missing, or follow a drift
    as_many, _ = samples.of_order(order, fitted, own.free.n_trend)
    return as_many if _is_as_likely(as_many.evidence, other, seen) else None


def _is_as_likely(own: Evidence, other: Evidence, seen: bool) -> bool:
    """Whether rest explains samples as well as the initial states of the `other`.

    Where these leave the static gain unknown, or stand for a constant, they must be
    likelier beyond chance: it is they that take the gain. Rest elsewhere, at inputs of
    zero, has as many unknowns. A mode that hardly decays may follow a drift, but for
    that of a likelier model where outputs were seen to stand.
    """
    worse = own.one_step.criterion - other.one_step.criterion
    by_chance, drifts_off = stands_by_chance(other.one_step), other.free.n_trend > 1
    decays = n_decays(own.model.A, own.longest)
    settles = decays > (HARDLY_DECAYS if drifts_off else 1.0)
    stood = seen and worse <= 0.0 < decays
    if not (len(own.model.A) and (settles or stood)):
        return False
    left, plainly = _plain_errors(own, other)
    if not other.free.initial_states:
        return worse < 0.0 and plainly <= -worse
    if other.whitening.of_differences and left >= 1.0:
        return False  # it is meant to leave more
    gain = other.static_gain()
    loses = by_chance or gain is None or bool(gain.unknown.any())
    most = CERTAIN if loses else ALIKE
    if not worse <= most * ((seen and not drifts_off) or left < 1.0):
        return False
    if (by_chance or worse > ALIKE) and not left < _NOT_FAR_WORSE:
        return False
    n_more = other.free.n_own(len(other.model.A)) - own.free.n_own(len(own.model.A))
    allowed = ALIKE + PRICE * max(n_more, 0) * len(other.records)
    return by_chance or plainly <= allowed


def _plain_errors(own: Evidence, other: Evidence) -> tuple[float, float]:
    """Squared errors of simulation by another's; and how much less likely they are.

    Twice the logarithm of that, as of fewer values that are white: by how much errors
    of the other correlate with those a sample before.
    """
    errors, others = (
        np.vstack(simulation_errors(e.model, e.records)) * e.output_scale
        for e in (own, other)
    )
    ratios, unlikely = [], 0.0
    for e, before in zip(errors.T, others.T, strict=True):
        squares = float(before @ before)
        if squares > 0.0:
            ratios.append(max(float(e @ e) / squares, _LEAST))
            r = min(max(float(before[1:] @ before[:-1]) / squares, 0.0), 1.0)
            unlikely += len(before) * (1.0 - r) / (1.0 + r) * np.log(ratios[-1])
    return float(np.mean(ratios or [1.0])), float(unlikely)


def moved_back(fitted: LocalFit, first: Array, differ: bool) -> LocalFit:
    """The model of inputs as they are, from that of inputs less the first ones.

    Whether constants `differ` was told without these.
    """
    offsets = fitted.offsets.shifted(first, np.zeros(1))
    gain = fitted.evidence.state_space(fitted.model, 1.0).dc_gain()
    constants = offsets.constants - first @ gain.T
    offsets = offsets._replace(constants=constants, differ=differ)
    return fitted._replace(offsets=offsets)
