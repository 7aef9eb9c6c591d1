"""Is a system linear over the range of its record? What its errors know of bends.

Squares and cubes of the inputs, and of what a model answers to these from rest, act
through its modes as inputs do. Of the errors of a linear system in open loop they
explain nothing, whatever its noise is: both are given by the inputs (after Ramsey,
*Journal of the Royal Statistical Society B* 31, 1969). Nor does what signals lose in
play: that of backlash, and nearly the sign of their rates, by which friction acts. Nor
do cubes of changes of the inputs: of a step h, an actuator whose rate is limited to R
misses the area ``h |h| / (2 R)``, which grows with h more than in proportion. What
lagged inputs explain, and the signals themselves, is taken from all of them before:
states that a model lacks are another thing. So is what initial states and trends do:
where little is left of slow noise, much of that is of the first samples.

What a model simulates that explains little of a record tells nothing of how the plant
moves. There the same is asked of the outputs themselves, a sample ahead: given past
inputs and outputs, what is new in a linear system depends on no power of them if its
noise is Gaussian, and on other noise by a small part.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.least_squares import scaled_lstsq
from ...systems.simulation import (
    delayed,
    free_responses,
    lti_response,
    trend_signals,
)
from ...systems.threads import one_blas_thread
from ..samples.records import Record, thinned
from ..simulation_error.noise import through_filter
from ..simulation_error.simulation_fit import Realization, simulation_errors
from .regressions import (
    DEPENDENT,
    f_test,
    of_size_one,
    through_modes,
    whitening_filters,
    without,
)
from .residuals import BEYOND_CHANCE, N_LAGS, WINDOWS_PER_LAG
from .statistics import Evidence

Array = NDArray[np.float64]

# Powers of signals that a linear system does not know; what they explain is told where
# it is larger than this share of the output. They are looked for in so many samples, at
# least two for each of all terms, of the slowest modes and so many lagged inputs.
_POWERS, _BENT = (2, 3), 0.03
_BENT_SAMPLES, _ROWS_PER_TERM, _SLOWEST, _LAGGED = 2_048, 2, 4, 50

_PLAY = (0.1, 0.5)  # standard deviations of a signal, to each side

# Samples over which inputs change, at most those of the lags that are known.
_CHANGES = (1, 4, 16)

# Of the errors as they are, not filtered, large changes must explain that share, which
# is no chance of slow noise: limits of rate explain 0.45 to 0.95 in the other half of a
# record; noise that grows with the output, or in a loop that nobody found, less than
# 0.3. Where other causes do, that is what they explain of an output.
_CLEARLY = 0.4

_ROUNDING = 1e-6  # motion of outputs of unit size that is none, and errors ahead

_CAUSES = ("size", "direction", "change")

# A cause that explains this part of what the first one does may be it as well: cubes of
# a resonant motion come to 0.45 of one at most, hysteresis has both.
_AS_WELL = 0.5

# Part of the motion of an output that a model leaves of which no answer tells how the
# plant moves; and samples before, whose powers may tell the next one.
_POOR, _BEFORE = 0.5, 3

# Parts of a record, each of which the others explain. The powers of measured outputs
# must explain the share `_CLEARLY`: stiffening springs come to 0.5 and more, noise that
# is not Gaussian, and behind zeros outside the unit circle, to 0.2.
_HALVES, _QUARTERS = 2, 4


class Bend(NamedTuple):
    """An output whose errors follow what no linear system does."""

    output: int
    # Size, direction of motion (friction, backlash), or change of inputs: the first of
    # those that explain most, and others that explain about as much.
    causes: tuple[str, ...]
    ahead: bool = False  # of a sample ahead of measured ones, not of the simulation


class _Terms(NamedTuple):
    """What may explain the errors of an experiment, one row per sample."""

    own: Array  # (n_rows, n_outputs, n_own), by initial states and trends
    linear: Array
    bent: list[Array]  # for each of the causes


@one_blas_thread
def find_bend(evidence: Evidence, *, apart: bool = False) -> Bend | None:
    """The first output whose errors clearly are bent, and not just by a little.

    By powers of signals, by what these lose in play, or by large changes of the inputs,
    whichever explains most. Outputs that are left unexplained are asked themselves
    first. Errors of a model that is unstable may be anything, and are not looked at.
    Of experiments that are `apart`, with linear systems of their own, what lagged
    inputs explain is taken from each.
    """
    records = thinned(evidence.records, _BENT_SAMPLES)
    records = [record for record in records if record.n_samples > 2 * N_LAGS]
    if not records:
        return None
    model = evidence.begun_in(records)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = simulation_errors(model, records)
    bend = _bend_ahead(records, errors, apart)
    finite = np.isfinite(model.loss) and all(np.isfinite(e).all() for e in errors)
    if bend is not None or not finite:
        return bend
    return _bend_of_simulation(model, records, errors, apart)


def _bend_of_simulation(
    model: Realization,
    records: Sequence[Record],
    errors: Sequence[Array],
    apart: bool,
) -> Bend | None:
    """What signals that the inputs give tell of the errors of simulation."""
    A, B, C, D = model.A, model.B, model.C, model.D
    poles = np.linalg.eigvals(A).astype(complex)
    if np.abs(poles).max(initial=0.0) > 1.0:
        return None
    poles = poles[poles.imag >= 0.0]
    poles = poles[np.argsort(np.abs(1.0 - poles))[:_SLOWEST]]
    inputs, rest = [record.u.T for record in records], np.zeros(len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        moved = [np.hstack([u, lti_response(A, B, C, D, u, rest)]) for u in inputs]
    whole = np.vstack(moved)
    if not np.isfinite(whole).all():
        return None
    sizes = np.hstack([record.y for record in records]).std(axis=1)
    least = np.where(sizes > _ROUNDING, _BENT * sizes, np.inf)  # nothing of still ones
    large = np.flatnonzero(np.vstack(errors).std(axis=0) > least).tolist()
    if not large:
        return None
    moves = whole.std(axis=0) > 0.0
    centre, spread = whole.mean(axis=0)[moves], whole.std(axis=0)[moves]
    m = inputs[0].shape[1]
    n_lags = min(N_LAGS, _LAGGED // m, len(whole) // (WINDOWS_PER_LAG * m))
    terms, scale = [], np.where(moves[:m], whole[:, :m].std(axis=0), 1.0)
    for u, z in zip(inputs, moved, strict=True):
        z = (z[:, moves] - centre) / spread
        late = [delayed(u, np.full(m, k)) for k in range(n_lags + 1)]
        linear = [through_modes(poles, u, 2), *late, through_modes(poles, z), z]
        powers = np.hstack([z**power for power in _POWERS])
        lost = np.hstack([z - _play(z, radius) for radius in _PLAY])
        bent = (powers, lost, _large_changes(u / scale, n_lags))
        own = free_responses(A, C, len(u), trend_signals(len(u), 2))
        terms.append(  # of inputs that are known
            _Terms(
                own[n_lags:],
                np.hstack(linear)[n_lags:],
                [np.hstack([through_modes(poles, x), x])[n_lags:] for x in bent],
            )
        )
    errors = [e[n_lags:] for e in errors]
    for i in large:
        causes = _causes(terms, [e[:, i] for e in errors], i, apart, least[i])
        if causes:
            return Bend(i, causes)
    return None


def _bend_ahead(
    records: Sequence[Record], errors: Sequence[Array], apart: bool
) -> Bend | None:
    """What measured signals tell of the next sample, of outputs left unexplained."""
    m, ny = len(records[0].u), len(records[0].y)
    whole = np.hstack([np.vstack((record.u, record.y)) for record in records])
    centre, spread = whole.mean(axis=1), whole.std(axis=1)
    little = np.vstack(errors).std(axis=0) <= _POOR * spread[m:]
    poor = np.flatnonzero(~little & (spread[m:] > _ROUNDING)).tolist()
    if not poor or any(record.missing.any() for record in records):
        return None
    spread = np.where(spread > 0.0, spread, 1.0)
    n_lags = min(N_LAGS, whole.shape[1] // (WINDOWS_PER_LAG * (m + ny)))
    if n_lags < _BEFORE:
        return None
    terms, outputs, near_lags = [], [], range(1, _BEFORE + 1)
    for record in records:
        z = (np.vstack((record.u, record.y)).T - centre) / spread
        past = [delayed(z, np.full(m + ny, k)) for k in range(1, n_lags + 1)]
        near = np.hstack([z[:, :m], *past[:_BEFORE]])
        lost = np.hstack([z - _play(z, radius) for radius in _PLAY])
        bent = [
            np.hstack([near**power for power in _POWERS]),
            np.hstack([delayed(lost, np.full(lost.shape[1], k)) for k in near_lags]),
        ]
        own = np.broadcast_to(trend_signals(len(z), 2).T[:, None], (len(z), ny, 2))
        linear = np.hstack([z[:, :m], *past])
        terms.append(_Terms(own[n_lags:], linear[n_lags:], [b[n_lags:] for b in bent]))
        outputs.append(z[n_lags:, m:])
    for i in poor:
        news = [y[:, i] for y in outputs]
        causes = _causes(terms, news, i, apart, _ROUNDING, ahead=True)
        if causes:
            return Bend(i, causes, ahead=True)
    return None


def _large_changes(inputs: Array, most: int) -> Array:
    """Cubes of changes of inputs of a common size, over `most` samples at most.

    Of inputs with two levels they are changes, and lagged inputs explain them.
    """
    m = inputs.shape[1]
    lags = [np.full(m, k) for k in sorted({min(k, most) for k in _CHANGES})]
    return np.hstack([(inputs - delayed(inputs, lag)) ** 3 for lag in lags])


def _play(signals: Array, radius: float) -> Array:
    """What follows each column within the radius, and rests while it can."""
    follow = np.empty_like(signals)
    for signal, column in zip(signals.T, follow.T, strict=True):
        at, places = float(signal[0]), []
        for value in signal.tolist():
            at = min(max(at, value - radius), value + radius)
            places.append(at)
        column[:] = places
    return follow


def _causes(
    terms: Sequence[_Terms],
    errors: Sequence[Array],
    output: int,
    apart: bool,
    least: float,
    *,
    ahead: bool = False,
) -> tuple[str, ...]:
    """Causes that explain most of an output, where that is more than `least`.

    Of what is new a sample `ahead`, where that is more than a clear share of it.
    """
    n_linear, n_own = terms[0].linear.shape[1], terms[0].own.shape[2]
    sizes = [x.shape[1] for x in terms[0].bent]
    signals = [
        np.column_stack([one.own[:, output], one.linear, *one.bent, e])
        for one, e in zip(terms, errors, strict=True)
    ]
    n_rows = [len(part) for part in signals]
    least_rows = _ROWS_PER_TERM * (n_linear + max(sizes) + 1)
    if (min(n_rows) if apart else sum(n_rows)) < least_rows:
        return ()
    if apart:
        n_linear, n_own = 0, n_own + n_linear
    # What is left of the errors is filtered: what the model lacks is no noise.
    columns = _rows(signals, np.ones(1), n_own)
    plain = without(of_size_one(columns[:, :n_linear]), columns[:, n_linear:])[0]
    noise = plain[:, -1:]
    if not noise.std() > least:
        return ()
    stops = np.cumsum(n_rows)[:-1]
    (a,) = whitening_filters(np.split(noise, stops))
    if len(a) > 1:  # else they are white as they are
        columns = _rows(signals, a, n_own)
    columns = of_size_one(columns)
    left, n_known = without(columns[:, :n_linear], columns)
    left, n = left[:, n_linear:], len(columns) - n_own * len(signals) - n_known
    n_parts = _QUARTERS if ahead else _HALVES
    found: dict[str, tuple[float, float]] = {}
    stops = np.cumsum([0, *sizes])
    for cause, first, stop in zip(_CAUSES, stops[:-1], stops[1:], strict=False):
        which = [*range(first, stop), -1]
        if f_test(left[:, first:stop], left[:, -1], n).p_value < BEYOND_CHANCE:
            explained = _explained_elsewhere(left[:, which], n_parts)
            whole = _explained_elsewhere(plain[:, which], n_parts)
            clearly = explained > 0.0 and whole > _CLEARLY
            if ahead:
                clearly &= explained > _CLEARLY
            elif cause != "change":
                share = max(explained, whole) if clearly else explained
                clearly = share * noise.var() > least**2
            if clearly:
                found[cause] = explained, whole
    if not found:
        return ()
    first_cause = max(found, key=lambda cause: found[cause][0])
    most = found.pop(first_cause)
    also = [
        cause
        for cause, shares in found.items()
        if all(s > _AS_WELL * m for s, m in zip(shares, most, strict=True))
    ]
    return first_cause, *also


def _rows(signals: Sequence[Array], a: Array, n_own: int) -> Array:
    """Filtered signals of all records, of each less what the first `n_own` explain."""
    rows = []
    for part in signals:
        white = through_filter(a, part)
        own = of_size_one(white[:, :n_own])
        rows.append(without(own, white[:, n_own:])[0])
    return np.vstack(rows)


def _explained_elsewhere(columns: Array, n_parts: int) -> float:
    """Share of the last column that the others explain as they do in its other parts.

    Noise that grows with the signals, or what changes over the record, may be explained
    beyond the chance of noise that does not, but not by the same terms again.
    """
    parts, left = np.array_split(columns, n_parts), 0.0
    for k, part in enumerate(parts):
        others = np.vstack(parts[:k] + parts[k + 1 :])
        fit = scaled_lstsq(others[:, :-1], others[:, -1], DEPENDENT)[0]
        left += float(np.sum((part[:, -1] - part[:, :-1] @ fit) ** 2))
    return 1.0 - left / float(np.sum(columns[:, -1] ** 2))
