"""Do constants of the experiments, and drifts, matter?

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

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from ...systems.beginnings import moves_of, standing
from ...systems.least_squares import column_scale, diagonal_scale
from ...systems.modes import (
    HARDLY_DECAYS,
    lasting,
    n_changes,
    n_decays,
    spectral_radius,
)
from ...systems.simulation import lti_response, trend_signals
from ..samples.records import Record
from ..simulation_error.noise import autoregression, spectral_density
from ..simulation_error.refinement import UNDETERMINED
from ..simulation_error.signals import signal_factor
from ..simulation_error.simulation_fit import (
    Realization,
    in_sections,
    jacobian_regression,
    project_out,
    simulation_errors,
    with_initial_states,
)
from .offsets import ROUNDING, Offsets
from .statistics import Evidence

Array = NDArray[np.float64]

# Chance of a constant that is not there, of fitting again with constants
_SUSPICIOUS = 1e-2
# and of keeping them. One that is kept costs what an unknown does.
_SIGNIFICANT = 1e-3
_LIKELY = 0.5  # above it their test says more of poor models than of constants

# Units of the criterion: by which models are no better than each other; by which one is
# better with a chance of 1e-7; and beyond doubt, of signals far from zero among noise
# of long memory.
ALIKE = 10.0
CERTAIN = 30.0
_BEYOND_DOUBT = 150.0

USELESS = 0.9  # errors, relative, that explain next to nothing

_FEW_STATES = 2  # none of which a model can spare for a level

_MOSTLY = 0.5  # part of the squared errors; noise of long memory has a quarter at most

_N_TESTED = 20  # experiments that the tests look at; more of them tell the same

# Part of a constant, squared, that the model does not explain, below which rounding and
# curvature decide.
_EXPLAINED = 1e-6
_AT_ONE = 1e-9  # distance from one of a pole beside which there is no constant

_BEYOND = 100.0  # times the largest output: a constant that is none
_FEW_MOVES = 10  # of inputs, whose answers may be straight lines
# Standard deviations between the mean of a channel and zero, from which constants are
# likely; and from which they are looked for beside states of a given order.
_FAR, _OFF = 3.0, 1.0

# Motion that a state off rest would have made where inputs and outputs stand still at
# the beginning, times what is seen.
_AT_REST = 5.0

_LASTING = 0.5  # time constants per longest experiment of one that may be a constant

# Times the squared errors without what inputs do to modes that do not decay, of ones
# that they hardly move.
HARDLY_MOVED = 3.0


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


def may_have_constants(evidence: Evidence, *, given: bool) -> bool:
    """Whether a model without constants should be tried with them.

    They show in its errors, or a slow mode may stand for them; where a channel is far
    from zero, nothing but its mean may have been fitted. One of a `given` order may
    have spent its states on that already where channels are not as far.
    """
    if _is_far(evidence.records, _OFF if given else _FAR):
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
    if np.abs(1.0 - poles).min(initial=1.0) < _AT_ONE or evidence.free.n_trend:
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


def _is_far(records: Sequence[Record], deviations: float = _FAR) -> bool:
    """Whether the mean of a channel is so many standard deviations from zero.

    By default it is next to all there is of it.
    """
    level, motion = _levels([np.vstack((r.u, r.y)) for r in records])
    return bool((np.abs(level) > deviations * motion).any())


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
    stays &= n_decays(evidence.model.A, evidence.longest) > -1.0
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
    motion = np.sum([r.n_samples * r.y.var(axis=1) for r in evidence.records], axis=0)
    return np.asarray(left / np.where(motion > 0.0, motion, np.nan))


def leaves_rounding(evidence: Evidence) -> bool:
    """Whether what a model leaves tells nothing."""
    return motion_left(evidence) < ROUNDING**2


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
    return n_changes(evidence.model.A, evidence.longest) < _LASTING


def unmoved_errors(evidence: Evidence, *, beside_drifts: bool = False) -> float:
    """Times the squared errors, without what inputs do to modes that do not decay.

    Next to one of modes that follow a drift; infinite where there are none. Of an
    integrator the level of an input makes a drift: what it does `beside_drifts` tells
    whether inputs move it, of ones that move often.
    """
    model, free, records = evidence.model, evidence.free, evidence.records
    if beside_drifts and sum(len(moves_of(r.u.T)) for r in records) > _FEW_MOVES:
        free = free._replace(n_trend=2)
        records = [r._replace(trend=trend_signals(r.n_samples, 2)) for r in records]
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
    n, kept = (sum(r.n_samples for r in e.records) for e in (whole, parts))
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
        if evidence.levels is not None and n_trend == 1:  # which are of constants
            part[:, -1] += part[:, : len(whole.y)] @ evidence.levels[k]
        parts.append(part)
        error = whole.y.T - lti_response(*model[:4], whole.u.T, x0)
        errors.append(error - error.mean(axis=0))
    return _chance(parts, errors, equal, evidence.free.n_trend >= n_trend)


def _chance(
    parts: Sequence[Array], errors: Sequence[Array], equal: bool, freed: bool
) -> float:
    """As `chance_of_trend`, from regressions ``[constants, Jacobian, error]``.

    `freed` errors are of a model that has them.
    """
    ny, n_samples = errors[0].shape[1], sum(map(len, errors))
    rows = np.vstack(parts)
    constants, jacobian, error = rows[:, :ny], rows[:, ny:-1], rows[:, -1]
    own = linalg.block_diag(*(part[:, :ny] for part in parts))
    size = np.sqrt(np.repeat([len(v) for v in errors], ny))
    if equal:
        jacobian = np.column_stack([jacobian, constants])
    explained = linalg.orth(jacobian / column_scale(jacobian), UNDETERMINED)
    own = (own - explained @ (explained.T @ own)) / size
    values, vectors = np.linalg.eigh(own.T @ own)
    own = own @ vectors[:, values > _EXPLAINED]
    if own.shape[1] == 0:
        return 1.0
    # Rows: experiments times outputs times signals.
    effect = own.reshape(len(parts), ny, -1, own.shape[1])
    score, stacked = own.T @ error, np.vstack(errors)
    rounding = ROUNDING**2 * np.eye(ny)
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
    scale = diagonal_scale(covariance)  # zero of outputs that are one signal
    inverse = np.linalg.pinv(covariance / scale[:, None] / scale, hermitian=True)
    statistic = float((score / scale) @ inverse @ (score / scale))
    q = len(score)
    return float(special.fdtrc(q, n_error, statistic / q)) if n_error >= 1.0 else 1.0
