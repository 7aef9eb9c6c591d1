r"""Constants of the experiments: are they there, and what are they?

Measured signals stand about a point of work, ``y - y0 = G(q) (u - u0)`` but for the
free response, which is ``y = G(q) u + c`` with ``c = y0 - G(1) u0``: the transient of a
constant input is a free response. So an experiment has one unknown for each output, c,
that outputs are linear in, like the initial state; u0 and y0 need not be known. With an
integrator G(1) is infinite: the answer to ``-u0`` is a straight line, which takes the
drift (``offset="linear"``) and tells u0, and c itself is a matter of the initial state.

All experiments have constants or none: where one has, another may well have, and one
that is not needed costs what an unknown does.

Are constants significant? At a model, fitted with or without them, the effect t of the
constants on the outputs is freed of what initial states and parameters could explain
(their Jacobian). With the errors v of the model the score ``g = t.T v`` does not depend
on small errors of the parameters (Neyman), and has covariance ``t.T cov(v) t``; as t is
slow, the spectral density of v at frequency zero stands for cov(v): at a model without
constants too, unless they explain most of v, which is not noise then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from ..data.preparation import Pairs
from ..exceptions import DivergenceError
from ..systems.beginnings import moves_of, standing
from ..systems.least_squares import column_scale
from ..systems.modes import mode_rates, spectral_radius
from ..systems.simulation import free_responses, lti_response, trend_signals
from .noise import autoregression, spectral_density
from .records import Centres, Record
from .signals import signal_factor
from .simulation_fit import (
    Realization,
    in_sections,
    jacobian_regression,
    project_out,
    simulation_errors,
    with_initial_states,
)
from .statistics import Evidence

Array = NDArray[np.float64]

# Trends of every output and experiment; "auto" begins without.
N_TRENDS = {"auto": 0, None: 0, "constant": 1, "linear": 2}

# Chance of a constant that is not there: of fitting again with constants, and of
# keeping them. One that is kept costs what an unknown does.
_SUSPICIOUS, _SIGNIFICANT = 1e-2, 1e-3

# By which the criterion is better with a chance of 1e-7; and the chance by the test of
# the constants, above which that says more of poor models than of constants; unless the
# criterion is better by the third, of signals far from zero among noise of long memory.
CERTAIN, _LIKELY, _BEYOND_DOUBT = 30.0, 0.5, 150.0

USELESS = 0.9  # errors, relative, that explain next to nothing

_FEW_STATES = 2  # none of which a model can spare for a level

_MOSTLY = 0.5  # part of the squared errors; noise of long memory has a quarter at most

_N_TESTED = 20  # experiments that the tests look at; more of them tell the same

# Part of a constant, squared, that the model does not explain, below which rounding and
# curvature decide: beside a pole this close to one there is no constant.
_EXPLAINED = 1e-6

_RCOND = 1e-9  # directions of the parameters that data do not tell, as in `refinement`
_ROUNDING = 1e-9  # errors of outputs of unit size that are rounding
_BEYOND = 100.0  # times the largest output: a constant that is none
_SETTLED = 10.0  # time constants per experiment of a mode that forgets its beginning
_RELUCTANTLY = 1e-4  # taken: initial states where offsets do as well
_FEW_MOVES = 10  # of inputs, whose answers may be straight lines
_UNSEEN, _NEARLY = 0.1, 0.01  # of errors, and of a drift: what inputs need not explain
_LASTING = 0.1  # decay of a mode over a record, of one that may be a constant
_FAR = 3.0  # standard deviations between the mean of a channel and zero

# Motion that a state off rest would have made where inputs and outputs stand still at
# the beginning, times what is seen.
_AT_REST = 5.0

# Time constants per longest experiment of a mode that may stand for a constant.
HARDLY_DECAYS = 3.0

# Units of the criterion by which models are no better than each other; times the
# squared errors without what inputs do to such modes, of ones that they hardly move.
ALIKE, HARDLY_MOVED = 10.0, 3.0


class Offsets(NamedTuple):
    """Where the experiments stand: ``y - outputs = G(q) (u - inputs)``, and drift."""

    inputs: Array  # (n_experiments, n_inputs)
    outputs: Array  # (n_experiments, n_outputs)
    drifts: Array  # (n_experiments, n_outputs), per sample, about the middle
    constants: Array  # (n_experiments, n_outputs), outputs at rest at input zero
    n_samples: Array  # (n_experiments,)
    differ: bool = False  # the constants do, by more than their uncertainty

    def shifted(self, inputs: Array, outputs: Array) -> Offsets:
        """Of samples before these were subtracted."""
        inputs, outputs = self.inputs + inputs, self.outputs + outputs
        return self._replace(inputs=inputs, outputs=outputs)

    def begun(self) -> Offsets:
        """With the outputs where the drifts of the experiments begin."""
        gone = self.drifts * (self.n_samples - 1)[:, None] / 2.0
        return self._replace(outputs=self.outputs - gone)

    def pooled(self) -> Offsets:
        """As of one experiment: the means over all samples."""
        total = self.n_samples.sum(keepdims=True)
        share = (self.n_samples / total)[None]
        u, y, drift = share @ self.inputs, share @ self.outputs, share @ self.drifts
        return Offsets(u, y, drift, share @ self.constants, total, self.differ)


def joined(parts: Sequence[Offsets]) -> Offsets:
    """Of the experiments of all parts."""
    u, y, drifts, c, n = (np.concatenate([p[k] for p in parts]) for k in range(5))
    return Offsets(u, y, drifts, c, n, any(part.differ for part in parts))


def with_levels(evidence: Evidence, offsets: Offsets) -> tuple[Evidence, Offsets]:
    """What is left to be told of the constants, once they are known."""
    trends = evidence.model.trends
    if trends.shape[1]:
        levels = offsets.constants / evidence.output_scale - trends[:, 0]
        evidence = replace(evidence, levels=levels)
        if len(trends) > 1:
            chance = chance_of_trend(evidence.one_step, equal=True)
            offsets = offsets._replace(differ=chance < _SIGNIFICANT)
    return evidence, offsets


def attributed(evidence: Evidence, centres: Centres, pairs: Pairs) -> Offsets:
    """Offsets of the experiments `pairs`, from a model of the centred ones.

    The inputs stand at their means, the outputs where the static gain then has them.
    Where a mode is not far faster than the longest experiment, means tell little of
    where it rests, and the static gain may be infinite: both stand where experiments
    begin nearest to rest, if that is near where outputs go, unlike in mid-motion. Where
    these are known to start at rest, inputs stand at zero.
    """
    model, lengths = evidence.model, np.array([len(u) for u, _ in pairs])
    n_trend, ny = centres.trends.shape[1:]
    levels, none = centres.inputs, np.zeros((len(pairs), ny))
    if not n_trend:
        return Offsets(levels, none, none, none, lengths)
    trends = centres.trends + evidence.output_scale * model.trends
    outputs, constants, drifts = trends[:, 0], trends[:, 0], none
    if n_trend > 1:
        drifts = trends[:, 1] * 2.0 / np.maximum(lengths - 1, 1)[:, None]
    if not evidence.free.initial_states:
        return Offsets(levels, outputs, drifts, constants, lengths)
    slowest = mode_rates(model.A).min(initial=1.0) * lengths.max()
    decays = slowest > 1.0  # over the longest experiment
    if decays:
        gain = evidence.state_space(model, 1.0).dc_gain()
        constants = outputs - levels @ gain.T
    if slowest <= _SETTLED and len(model.initial_states) == len(pairs):
        found = _as_they_begin(evidence, trends, lengths)
        outputs_of = [y for _, y in pairs]
        if found is not None and not (decays and far_off(found[1], outputs_of)):
            return Offsets(levels + found[0], found[1], none, constants, lengths)
    if not decays:
        return Offsets(levels, outputs, drifts, constants, lengths)
    means = np.array([u.mean(axis=0) for u, _ in pairs])
    return Offsets(means, constants + means @ gain.T, drifts, constants, lengths)


def far_off(y0: Array, outputs: Sequence[Array]) -> bool:
    """Whether an output is to rest farther from its range than that is wide."""
    y = np.vstack(outputs)
    least, most = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
    wide = most - least
    return bool(((y0 < least - wide) | (y0 > most + wide)).any())


def of_rates(rates: Offsets, gain: Array, flags: NDArray[np.bool_]) -> Offsets:
    """Offsets of the outputs of which some, by `flags`, integrate those of `rates`.

    A constant rate is the answer of the rates, of that static `gain`, to an offset of
    the inputs; what they cannot make is a drift.
    """
    c, none = rates.constants, np.zeros_like(rates.drifts)
    if not np.isfinite(gain).all() or not c.any():
        return rates
    inputs = -linalg.lstsq(gain[flags], c[:, flags].T)[0].T
    left = c + inputs @ gain.T
    left[np.abs(left) <= _ROUNDING * np.abs(c)] = 0.0
    outputs, drifts = np.where(flags, 0.0, left), np.where(flags, left, 0.0)
    return Offsets(inputs, outputs, drifts, none, rates.n_samples, rates.differ)


def _as_they_begin(
    evidence: Evidence, trends: Array, lengths: Array
) -> tuple[Array, Array] | None:
    """Offsets of inputs and outputs by which experiments begin nearest to rest.

    With the answer S to steps of the inputs, ``trends + free x0 = y0 - S u0 + free x``:
    behind an integrator u0 is a straight line. Least squares, with as little as may be
    of x. Shapes (n_experiments, n_inputs) and (n_experiments, n_outputs); None where
    drifts are left, or the model grows beyond all numbers.
    """
    model, n_values = evidence.model, sum(r.n_values for r in evidence.records)
    lti, scale = evidence.state_space(model, 1.0), evidence.output_scale
    noise = np.sqrt(model.loss / n_values)
    m, ny, found = lti.n_inputs, lti.n_outputs, []
    for n, x0, trend in zip(lengths, model.initial_states, trends, strict=True):
        free = free_responses(lti.A, lti.C, n)
        target = (free @ x0 + trend_signals(n, len(trend)).T @ trend) / scale
        try:
            steps = [-lti.simulate(np.tile(row, (n, 1))) for row in np.eye(m)]
        except DivergenceError:
            return None
        constants = np.broadcast_to(np.eye(ny), (n, ny, ny))
        columns = np.concatenate([np.stack(steps, axis=2), constants, free], axis=2)
        columns = (columns / scale[:, None]).reshape(n * ny, -1)
        size = column_scale(columns)
        size[m + ny :] /= _RELUCTANTLY
        x = linalg.lstsq(columns / size, target.ravel(), _RCOND)[0]
        left = target.ravel() - columns / size @ x
        most = _UNSEEN * noise + _NEARLY * target.std(axis=0).max()
        if not np.sqrt(np.mean(left**2)) <= most:
            return None
        found.append((x / size)[: m + ny])
    u0, y0 = np.split(np.array(found), [m], axis=1)
    return u0, y0


def may_have_constants(evidence: Evidence) -> bool:
    """Whether a model without constants should be tried with them.

    They show in its errors, or a slow mode may stand for them; where a channel is far
    from zero, nothing but its mean may have been fitted.
    """
    if _is_far(evidence.records):
        return True
    return _has_slow_mode(evidence) or chance_of_trend(evidence) < _SUSPICIOUS


def stands_by_chance(evidence: Evidence, times: float = _AT_REST) -> bool:
    """Whether outputs stand still where a model without constants is not at rest.

    Neither with the inputs that it begins with nor, if these are a step, without any.
    While inputs do not move yet, states that are as far from rest as the outputs are
    would have moved these, by so many `times` what is seen, unless they happen to
    balance each other.
    """
    model, poles = evidence.model, np.linalg.eigvals(evidence.model.A)
    if np.abs(1.0 - poles).min(initial=1.0) < _RCOND or evidence.free.n_trend:
        return False
    gain = _static_gain(model)
    for record in evidence.records:
        n = standing(record.u.T)
        if not n:
            continue
        y = record.y[:, :n]
        first, second = y[:, : n // 2].mean(axis=1), y[:, n // 2 :].mean(axis=1)
        motion = 2.0 * np.abs(second - first) + 2.0 * y.std(axis=1) / np.sqrt(n)
        level = y.mean(axis=1)
        off = np.minimum(np.abs(level - gain @ record.u[:, 0]), np.abs(level))
        with np.errstate(over="ignore", invalid="ignore"):
            moved = np.abs(1.0 - poles**n).min(initial=1.0)
        if (off * moved > times * motion).any():
            return True
    return False


def _static_gain(model: Realization) -> Array:
    """Outputs at rest by inputs of one, of scaled records."""
    x = np.linalg.solve(np.eye(len(model.A)) - model.A, model.B)
    return np.asarray(model.C @ x + model.D)


def without_slow_modes(evidence: Evidence) -> list[tuple[Array, Array]] | None:
    """``(A, C)`` of a model without each one of the modes that may be constants.

    None where that is not all that constants may change: of signals far from zero, and
    of slow oscillations.
    """
    A, C = evidence.model.A, evidence.model.C
    poles, left = linalg.eig(A.T)
    slow = _is_slow(poles, evidence)
    if _is_far(evidence.records) or poles[slow].imag.any():
        return None
    bases = [linalg.null_space(w.real[None]) for w in left.T[slow]]
    return [(Z.T @ A @ Z, C @ Z) for Z in bases]


def may_be_better(without: Evidence, other: Evidence) -> bool:
    """Whether a model near `other`, which has constants, may be one where they matter.

    Of as many states the chance of the constants tells; of fewer ones the criterion,
    which other states with these may make better yet.
    """
    better = without.criterion - other.criterion
    if len(other.model.A) < len(without.model.A):
        return better > -CERTAIN
    return better > 0.0 or chance_of_trend(other) < _SUSPICIOUS


def _is_far(records: Sequence[Record]) -> bool:
    """Whether means are next to all there is of a channel."""
    level, motion = _levels([np.vstack((r.u, r.y)) for r in records])
    return bool((np.abs(level) > _FAR * motion).any())


def stays_far(records: Sequence[Record]) -> bool:
    """Whether channels are far from zero, and all of these begin far from it as well.

    A step from rest soon is far, and tells by how it begins that there is no constant.
    """
    both = [np.vstack((r.u, r.y)) for r in records]
    level, motion = _levels(both)
    far = level > _FAR * motion
    begins = np.min([np.abs(part[:, 0]) for part in both], axis=0)
    return bool(far.any() and (begins > 0.5 * level)[far].all())


def follows_means_alone(evidence: Evidence) -> bool:
    """Whether a model without constants explains no more than where outputs stay.

    What one that grows over the record simulates tells nothing.
    """
    stays = not evidence.free.n_trend and stays_far(evidence.records)
    stays &= evidence.longest * (spectral_radius(evidence.model.A) - 1.0) < 1.0
    return stays and motion_left(evidence) > USELESS**2


def motion_left(evidence: Evidence) -> float:
    """Part of the outputs' motion about their means, squared, that a model leaves."""
    left = motions_left(evidence)
    return float(np.nanmean(left)) if not np.isnan(left).all() else 0.0


def motions_left(evidence: Evidence) -> Array:
    """That of every output; NaN of one that does not move."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.vstack(simulation_errors(evidence.model, evidence.records))
        left = np.sum(errors**2, axis=0)
    left = np.where(np.isfinite(left), left, np.inf)
    motion = np.sum([r.u.shape[1] * r.y.var(axis=1) for r in evidence.records], axis=0)
    return np.asarray(left / np.where(motion > 0.0, motion, np.nan))


def leaves_rounding(evidence: Evidence) -> bool:
    """Whether what a model leaves tells nothing."""
    return motion_left(evidence) < _ROUNDING**2


def _levels(parts: Sequence[Array]) -> tuple[Array, Array]:
    """Size of the means of every channel, and of its motion about them."""
    n = sum(part.shape[1] for part in parts)
    level = sum(part.shape[1] * part.mean(axis=1) ** 2 for part in parts)
    motion = sum(part.shape[1] * part.var(axis=1) for part in parts)
    return np.sqrt(level / n), np.sqrt(motion / n)


def constants_matter(without: Evidence, other: Evidence) -> bool:
    """Whether the model with constants, `other`, is to be preferred.

    By the criterion of the orders. That takes a constant by chance now and then, and is
    enough where fewer states are left: some of them stood for constants, or for what
    an offset of the inputs is behind an integrator; and where it is better by what no
    chance explains. The test of the constants may not see these among slow noise,
    whose density few samples tell; the criterion knows that noise by its innovations.

    Signals that are far from zero all the time hardly rest there. Without constants the
    static gain or a slow mode follows their means, which the criterion hardly minds and
    little excitation does not refute, and simulations begin at zero. They are left out
    where the criterion says, beyond chance, that the model with them is a poor one: the
    other is one with zeros. They are kept where they halve the squared errors of as few
    states: these follow the means else, and leave to the noise how outputs move. Beside
    a mode that grows their test has the word.

    Of a given order one state may stand for the constants of all experiments, by its
    initial values: it does not decay. The criterion does not mind that, until some
    other mode is missing: such a state is to go where the test tells of constants.

    Of models that are alike, the one is right for which outputs that stand still are at
    rest. Where constants of a model cannot be told from its slow modes, the criterion
    alone decides.

    A constant far beyond the outputs stands for a drift, together with the initial
    state of a mode that does not decay over the record; or for an offset of the inputs,
    where these move that mode. Rounding tells nothing.
    """
    if _is_beyond(other):
        moved = unmoved_errors(other, beside_drifts=True)
        if not HARDLY_MOVED < moved < np.inf:
            return False
    better = without.criterion - other.criterion
    if better > 0.0 and len(other.model.A) < len(without.model.A):
        return True
    if leaves_rounding(without):
        return False
    if better > -ALIKE and stands_by_chance(without):
        return True
    far = stays_far(without.records)
    few = len(other.model.A) <= min(len(without.model.A), _FEW_STATES)
    decays = spectral_radius(other.model.A) <= 1.0
    if far and decays:
        if better > -CERTAIN:
            return True
        if few and motion_left(other) < _MOSTLY * motion_left(without):
            return True
    replaced = _lasts(without) and not _lasts(other)
    if not better > -(0.0, CERTAIN, _BEYOND_DOUBT)[far + replaced]:
        hardly = better > -ALIKE and not _has_slow_mode(other)
        if not hardly or not unmoved_errors(without) < HARDLY_MOVED:
            return False
    if far and better > _BEYOND_DOUBT:
        return True
    chance = chance_of_trend(other)
    if chance == 1.0:
        return better > (ALIKE if far else CERTAIN)
    return chance < _SIGNIFICANT or (chance < _LIKELY and (far or better > CERTAIN))


def lasting(poles: NDArray, longest: int) -> NDArray[np.bool_]:
    """Which modes do not decay over the longest experiment, or grow."""
    return (np.abs(1.0 - poles) * longest < HARDLY_DECAYS) | (np.abs(poles) > 1.0)


def may_have_drift(evidence: Evidence) -> bool:
    """Whether a model without drifts should be tried with them.

    They show in its errors; or a mode grows, or does not decay, which stands for them,
    or for the offset of an input that is integrated.
    """
    poles = np.linalg.eigvals(evidence.model.A)
    if lasting(poles, evidence.longest).any():
        return True
    return chance_of_trend(evidence, 2) < _SUSPICIOUS


def drifts_off(evidence: Evidence) -> bool:
    """Whether errors have a drift beyond chance."""
    return chance_of_trend(evidence, 2) < _SIGNIFICANT


def _lasts(evidence: Evidence) -> bool:
    """Whether a mode stays what it is over the longest record."""
    return bool((mode_rates(evidence.model.A) * evidence.longest < _LASTING).any())


def unmoved_errors(evidence: Evidence, *, beside_drifts: bool = False) -> float:
    """Times the squared errors, without what inputs do to modes that do not decay.

    Next to one of modes that follow a drift; infinite where there are none. Of an
    integrator the level of an input makes a drift: what it does `beside_drifts` tells
    whether inputs move it, of ones that move often.
    """
    model, free, records = evidence.model, evidence.free, evidence.records
    if beside_drifts and sum(len(moves_of(r.u.T)) for r in records) > _FEW_MOVES:
        free = free._replace(n_trend=2)
        records = [r._replace(trend=trend_signals(r.u.shape[1], 2)) for r in records]
    poles, V = np.linalg.eig(model.A)
    # By column of `V`.
    slow = lasting(poles, evidence.longest)
    if not slow.any() or not free.initial_states:
        return np.inf
    try:
        part = (V[:, slow] @ np.linalg.inv(V)[slow]).real
    except np.linalg.LinAlgError:
        return np.inf
    weight, losses = evidence.whitening.weight, []
    for B in (model.B - part @ model.B, model.B):
        moved = model._replace(B=B, blocks=None)
        with np.errstate(over="ignore", invalid="ignore"):
            found = with_initial_states(moved, records, free, weight)
        losses.append(found.loss)
    return losses[0] / losses[1] if 0.0 < losses[1] < np.inf else np.inf


def _is_beyond(evidence: Evidence) -> bool:
    """Whether constants are far beyond anything that the outputs reach.

    About the means of inputs that stay far from zero: there these are at home.
    """
    records, model = evidence.records, evidence.model
    constants = model.trends
    if spectral_radius(model.A) < 1.0:
        means = np.array([r.u.mean(axis=1) for r in records])
        motion = np.array([r.u.std(axis=1) for r in records])
        levels = np.where(np.abs(means) > _FAR * motion, means, 0.0)
        constants = constants.copy()
        constants[:, 0] += levels @ _static_gain(model).T
    reached = np.max([np.abs(r.y).max(axis=1) for r in records], axis=0)
    return bool((np.abs(constants) > _BEYOND * reached).any())


def shifts_matter(whole: Evidence, parts: Evidence) -> bool:
    """Whether cut records have other constants, and no chance explains the better fit.

    The criterion is that of as many samples: those about the cuts are left out, and
    glitches with them, which are no shifts.
    """
    n, kept = (sum(r.u.shape[1] for r in e.records) for e in (whole, parts))
    if not whole.criterion - n / kept * parts.criterion > CERTAIN:
        return False
    return chance_of_trend(parts, equal=True) < _SIGNIFICANT


def level_matters(without: Array, other: Array, n_unknowns: int) -> bool:
    """Whether a level explains most of what is left of a record, and no chance does.

    Errors (n_samples, n_outputs) of outputs that count alike, NaN where these are not
    known, without it and beside it, with so many unknowns. A few samples do not tell it
    from a slow mode, and what they make of it is far off later.

    >>> level = np.where(np.arange(40) % 2, 1.0, 1.2)[:, None]
    >>> level_matters(level, level - level.mean(), 2), level_matters(level, level, 2)
    (True, False)
    >>> level_matters(level[:3], level[:3] - level[:3].mean(), 2)
    False
    """
    before, after = (float(np.nansum(x**2)) for x in (without, other))
    ny, n_error = other.shape[1], np.count_nonzero(~np.isnan(other)) - n_unknowns
    if n_error < 1 or not after < _MOSTLY * before:
        return False
    after = max(after, np.finfo(float).tiny)
    ratio = (before - after) / ny / (after / n_error)
    return bool(special.fdtrc(ny, n_error, ratio) < _SIGNIFICANT)


def _has_slow_mode(evidence: Evidence) -> bool:
    """Whether a mode decays, or grows, too slowly to be told from a constant."""
    return bool(_is_slow(np.linalg.eigvals(evidence.model.A), evidence).any())


def _is_slow(poles: NDArray[np.inexact], evidence: Evidence) -> NDArray[np.bool_]:
    return (1.0 - poles.real) * evidence.longest <= HARDLY_DECAYS


def chance_of_trend(
    evidence: Evidence, n_trend: int = 1, *, equal: bool = False
) -> float:
    """Chance of estimated constants as large as these, where there are none.

    With `n_trend` 2 of drifts, beside constants. With `equal`: as different, where they
    are the same in all experiments. 1 where nothing can be told.
    """
    model, free = in_sections(evidence.model), evidence.free._replace(n_trend=n_trend)
    if model.blocks is None or not np.isfinite(model.loss):
        return 1.0
    last, parts, errors = len(evidence.records) - 1, [], []
    for k in sorted({round(k) for k in np.linspace(0, last, _N_TESTED)}):
        whole, x0 = evidence.records[k], model.initial_states[k]
        record = Record(whole.u, whole.y, trend_signals(whole.u.shape[1], n_trend))
        driven = np.column_stack([x0, model.B])
        R = signal_factor(model.blocks, record, driven)
        if R is None:
            return 1.0
        regression = jacobian_regression(R, model, driven, free)
        beside = free.n_own(len(model.A)) - len(whole.y)
        part = project_out(regression, beside)
        if evidence.levels is not None:
            part[:, -1] += part[:, : len(whole.y)] @ evidence.levels[k]
        parts.append(part)
        error = whole.y.T - lti_response(*model[:4], whole.u.T, x0)
        errors.append(error - error.mean(axis=0))
    return _chance(parts, errors, equal, evidence.levels is not None)


def _chance(
    parts: Sequence[Array], errors: Sequence[Array], equal: bool, freed: bool
) -> float:
    """As `chance_of_trend`, from regressions ``[constants, Jacobian, error]``.

    `freed` errors are of a model with constants.
    """
    ny, n_samples = errors[0].shape[1], sum(map(len, errors))
    rows = np.vstack(parts)
    constants, jacobian, error = rows[:, :ny], rows[:, ny:-1], rows[:, -1]
    own = linalg.block_diag(*(part[:, :ny] for part in parts))
    size = np.sqrt(np.repeat([len(v) for v in errors], ny))
    if equal:
        jacobian = np.column_stack([jacobian, constants])
    explained = linalg.orth(jacobian / column_scale(jacobian), _RCOND)
    own = (own - explained @ (explained.T @ own)) / size
    values, vectors = np.linalg.eigh(own.T @ own)
    own = own @ vectors[:, values > _EXPLAINED]
    if own.shape[1] == 0:
        return 1.0
    # Rows: experiments times outputs times signals.
    effect = own.reshape(len(parts), ny, -1, own.shape[1])
    score, stacked = own.T @ error, np.vstack(errors)
    rounding = _ROUNDING**2 * np.eye(ny)
    white = stacked.T @ stacked / n_samples + rounding
    n_error = n_samples - jacobian.shape[1] - own.shape[1]
    chance = _tail(score, effect, white, n_error)
    if chance > _SUSPICIOUS:
        return chance  # that of coloured noise takes as long as a step of refinement
    left = error - explained @ (explained.T @ error)
    if not freed and _squares(linalg.orth(own).T @ left) > _MOSTLY * _squares(left):
        return chance
    # Noise of long memory tells its density at zero no better than few samples do.
    density = spectral_density(autoregression(errors), np.zeros(1))[0].real + rounding
    share = min(1.0, float(np.min(np.diagonal(white) / np.diagonal(density))))
    return _tail(score, effect, density, max(1.0, share * n_error))


def _squares(x: Array) -> float:
    return float(np.sum(x**2))


def _tail(score: Array, effect: Array, density: Array, n_error: float) -> float:
    """Chance of such a score, by the F distribution."""
    by_sample = effect.transpose(0, 2, 1, 3)
    covariance = np.tensordot(by_sample, density @ by_sample, ([0, 1, 2], [0, 1, 2]))
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(scale > 0, scale, 1.0)  # zero of outputs that are one signal
    inverse = np.linalg.pinv(covariance / scale[:, None] / scale, hermitian=True)
    statistic = float((score / scale) @ inverse @ (score / scale))
    q = len(score)
    return float(special.fdtrc(q, n_error, statistic / q)) if n_error >= 1.0 else 1.0
