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
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..systems.least_squares import scaled_lstsq
from ..systems.simulation import (
    delayed,
    free_responses,
    lti_response,
    trend_signals,
)
from ..systems.threads import one_blas_thread
from .noise import through_filter
from .records import thinned
from .residuals import (
    BEYOND_CHANCE,
    DEPENDENT,
    N_LAGS,
    WINDOWS_PER_LAG,
    f_test,
    of_size_one,
    through_modes,
    whitening_filters,
    without,
)
from .simulation_fit import simulation_errors, with_initial_states
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
# 0.3.
_CLEARLY = 0.4

_CAUSES = ("size", "direction", "change")


class Bend(NamedTuple):
    """An output whose errors follow what no linear system does."""

    output: int
    cause: str  # size, direction of motion (friction, backlash), or change of inputs


class _Terms(NamedTuple):
    """What may explain the errors of an experiment, one row per sample."""

    own: Array  # (n_rows, n_outputs, n_own), by initial states and trends
    linear: Array
    bent: list[Array]  # for each of the causes


@one_blas_thread
def find_bend(evidence: Evidence) -> Bend | None:
    """The first output whose errors clearly are bent, and not just by a little.

    By powers of signals, by what these lose in play, or by large changes of the inputs,
    whichever explains most. Errors of a model that is unstable may be anything, and are
    not looked at.
    """
    poles = np.linalg.eigvals(evidence.model.A).astype(complex)
    if not np.isfinite(evidence.model.loss) or np.abs(poles).max(initial=0.0) > 1.0:
        return None
    poles = poles[poles.imag >= 0.0]
    poles = poles[np.argsort(np.abs(1.0 - poles))[:_SLOWEST]]
    records, free = thinned(evidence.records, _BENT_SAMPLES), evidence.free
    records = [record for record in records if record.n_samples > 2 * N_LAGS]
    if not records:
        return None
    model = with_initial_states(
        evidence.model, records, free, evidence.whitening.weight
    )
    A, B, C, D = model.A, model.B, model.C, model.D
    inputs, rest = [record.u.T for record in records], np.zeros(len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        errors = simulation_errors(model, records)
        moved = [np.hstack([u, lti_response(A, B, C, D, u, rest)]) for u in inputs]
    whole = np.vstack(moved)
    if not all(np.isfinite(x).all() for x in (whole, *errors)):
        return None
    least = _BENT * np.hstack([record.y for record in records]).std(axis=1)
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
        cause = _bend(terms, [e[:, i] for e in errors], i, least[i])
        if cause is not None:
            return Bend(i, cause)
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


def _bend(
    terms: Sequence[_Terms], errors: Sequence[Array], output: int, least: float
) -> str | None:
    """The cause that explains most of an output, where that is more than `least`."""
    n_linear, n_own = terms[0].linear.shape[1], terms[0].own.shape[2]
    sizes = [x.shape[1] for x in terms[0].bent]
    signals = [
        np.column_stack([one.own[:, output], one.linear, *one.bent, e])
        for one, e in zip(terms, errors, strict=True)
    ]
    # What is left of the errors is filtered: what the model lacks is no noise.
    columns = _rows(signals, np.ones(1), n_own)
    if len(columns) < _ROWS_PER_TERM * (n_linear + max(sizes) + 1):
        return None
    plain = without(of_size_one(columns[:, :n_linear]), columns[:, n_linear:])[0]
    noise = plain[:, -1:]
    if not noise.std() > least:
        return None
    stops = np.cumsum([len(part) for part in signals])[:-1]
    (a,) = whitening_filters(np.split(noise, stops))
    columns = of_size_one(_rows(signals, a, n_own))
    left, n_known = without(columns[:, :n_linear], columns)
    left, n = left[:, n_linear:], len(columns) - n_own * len(signals) - n_known
    causes: dict[str, float] = {}
    stops = np.cumsum([0, *sizes])
    for cause, first, stop in zip(_CAUSES, stops[:-1], stops[1:], strict=True):
        which = [*range(first, stop), -1]
        if f_test(left[:, first:stop], left[:, -1], n).p_value < BEYOND_CHANCE:
            explained = _explained_elsewhere(left[:, which])
            whole = _explained_elsewhere(plain[:, which])
            slow = explained > 0.0 and whole > _CLEARLY
            if slow if cause == "change" else explained * noise.var() > least**2:
                causes[cause] = whole
    return max(causes, key=lambda cause: causes[cause], default=None)


def _rows(signals: Sequence[Array], a: Array, n_own: int) -> Array:
    """Filtered signals of all records, of each less what the first `n_own` explain."""
    rows = []
    for part in signals:
        white = through_filter(a, part)
        own = of_size_one(white[:, :n_own])
        rows.append(without(own, white[:, n_own:])[0])
    return np.vstack(rows)


def _explained_elsewhere(columns: Array) -> float:
    """Share of the last column that the others explain as they do in its other half.

    Noise that grows with the signals, or what changes over the record, may be explained
    beyond the chance of noise that does not, but not by the same terms again.
    """
    halves = np.array_split(columns, 2)
    left = 0.0
    for half, other in zip(halves, halves[::-1], strict=True):
        fit = scaled_lstsq(other[:, :-1], other[:, -1], DEPENDENT)[0]
        left += float(np.sum((half[:, -1] - half[:, :-1] @ fit) ** 2))
    return 1.0 - left / float(np.sum(columns[:, -1] ** 2))
