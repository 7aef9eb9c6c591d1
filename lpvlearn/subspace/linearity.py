"""Is a system linear over the range of its record? What its errors know of bends.

Squares and cubes of the inputs, and of what a model answers to these from rest, act
through its modes as inputs do. Of the errors of a linear system in open loop they
explain nothing, whatever its noise is: both are given by the inputs (after Ramsey,
*Journal of the Royal Statistical Society B* 31, 1969). Nor does what signals lose in
play: that of backlash, and nearly the sign of their rates, by which friction acts. What
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


class Bend(NamedTuple):
    """An output whose errors follow what no linear system does."""

    output: int
    by_direction: bool  # of motion, as friction and backlash do


class _Terms(NamedTuple):
    """What may explain the errors of an experiment, one row per sample."""

    own: Array  # (n_rows, n_outputs, n_own), by initial states and trends
    linear: Array
    powers: Array
    lost_in_play: Array


@one_blas_thread
def find_bend(evidence: Evidence) -> Bend | None:
    """The first output whose errors clearly are bent, and not just by a little.

    By powers of signals, or else by what these lose in play. Errors of a model that is
    unstable may be anything, and are not looked at.
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
    terms = []
    for u, z in zip(inputs, moved, strict=True):
        z = (z[:, moves] - centre) / spread
        late = [delayed(u, np.full(m, k)) for k in range(n_lags + 1)]
        linear = [through_modes(poles, u, 2), *late, through_modes(poles, z), z]
        powers = np.hstack([z**power for power in _POWERS])
        lost = np.hstack([z - _play(z, radius) for radius in _PLAY])
        parts = (
            free_responses(A, C, len(u), trend_signals(len(u), 2)),
            np.hstack(linear),
            np.hstack([through_modes(poles, powers), powers]),
            np.hstack([through_modes(poles, lost), lost]),
        )
        terms.append(_Terms(*(x[n_lags:] for x in parts)))  # of inputs that are known
    errors = [e[n_lags:] for e in errors]
    for i in large:
        by_direction = _bend(terms, [e[:, i] for e in errors], i, least[i])
        if by_direction is not None:
            return Bend(i, by_direction)
    return None


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
) -> bool | None:
    """Whether what signals lose in play explains more of an output than `least`.

    False where powers do, None where neither does.
    """
    n_linear, n_own = terms[0].linear.shape[1], terms[0].own.shape[2]
    n_powers, n_lost = terms[0].powers.shape[1], terms[0].lost_in_play.shape[1]
    signals = [
        np.column_stack(
            [one.own[:, output], one.linear, one.powers, one.lost_in_play, e]
        )
        for one, e in zip(terms, errors, strict=True)
    ]
    # What is left of the errors is filtered: what the model lacks is no noise.
    columns = _rows(signals, np.ones(1), n_own)
    if len(columns) < _ROWS_PER_TERM * (n_linear + max(n_powers, n_lost) + 1):
        return None
    noise = without(of_size_one(columns[:, :n_linear]), columns[:, -1:])[0]
    if not noise.std() > least:
        return None
    stops = np.cumsum([len(part) for part in signals])[:-1]
    (a,) = whitening_filters(np.split(noise, stops))
    columns = of_size_one(_rows(signals, a, n_own))
    left, n_known = without(columns[:, :n_linear], columns)
    left, n = left[:, n_linear:], len(columns) - n_own * len(signals) - n_known
    for by_direction, bent in enumerate((left[:, :n_powers], left[:, n_powers:-1])):
        if not f_test(bent, left[:, -1], n).p_value < BEYOND_CHANCE:
            continue
        explained = _explained_elsewhere(np.column_stack([bent, left[:, -1]]))
        if explained * noise.var() > least**2:
            return bool(by_direction)
    return None


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
