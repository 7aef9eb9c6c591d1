"""Choice of the order and of the horizon by what validates.

Every candidate is identified on the first part of each experiment. For a given order
all horizons have the same number of parameters, so that the one with the smallest
simulation error is simply the best; orders are compared by the simulation error on
the part held out, and the smallest that is not significantly worse than the best is
taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..systems.simulation import lti_response
from .hankel import correlation_sequence
from .identification import (
    Identified,
    ScaledRecords,
    correlations_of,
    max_horizon,
    max_order,
    realize,
    subspace_of,
)
from .refinement import refine_simulation
from .signals import Record
from .simulation_fit import Freedom, Realization, freedom

Array = NDArray[np.float64]

_ESTIMATION_SHARE = 0.7

_N_BLOCKS = 20


def split_record(record: Record) -> tuple[Record, int]:
    """First part of a record, for estimation, and its length."""
    n = record.u.shape[1]
    cut = n if n < 8 else int(np.ceil(_ESTIMATION_SHARE * n))
    return Record(record.u[:, :cut].copy(), record.y[:, :cut].copy()), cut


def thin_records(records: Sequence[Record], n_samples: int) -> list[Record]:
    """Evenly spread experiments of about `n_samples` in total, at least one.

    Experiments beyond that length are cut to it.

    Examples
    --------
    >>> import numpy as np
    >>> runs = [Record(np.zeros((1, n)), np.zeros((1, n))) for n in (50, 40, 60, 70)]
    >>> [run.u.shape[1] for run in thin_records(runs, 120)]
    [50, 60]
    """
    lengths = [record.u.shape[1] for record in records]
    keep = max(1, min(len(records), int(n_samples * len(records) / sum(lengths))))
    spread = [i * len(records) // keep for i in range(keep)]
    return [
        Record(
            np.ascontiguousarray(records[i].u[:, :n_samples]),
            np.ascontiguousarray(records[i].y[:, :n_samples]),
        )
        for i in spread
    ]


def held_out_errors(
    model: Realization, records: Sequence[Record], cuts: Sequence[int]
) -> tuple[Array, float]:
    """Simulation errors after the cuts.

    Parameters
    ----------
    model : Realization
        Identified on the parts before the cuts, with their initial states.
    records : sequence of Record
        Whole records.
    cuts : sequence of int
        Where the held-out part of each begins.

    Returns
    -------
    blocks : ndarray of shape (n_blocks,)
        Sums of squared errors over consecutive blocks of time.
    bft : float
        Best fit over the held-out parts, percent, the mean over outputs.
    """
    blocks, errors, outputs = [], [], []
    for record, cut, x0 in zip(records, cuts, model.initial_states, strict=True):
        if cut == record.u.shape[1]:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            fitted = lti_response(model.A, model.B, model.C, model.D, record.u.T, x0)
        error = record.y.T[cut:] - fitted[cut:]
        errors.append(error)
        outputs.append(record.y.T[cut:])
        n_blocks = min(_N_BLOCKS, len(error))
        blocks += [float((b**2).sum()) for b in np.array_split(error, n_blocks)]
    if not errors:
        return np.zeros(0), np.nan
    error, output = np.vstack(errors), np.vstack(outputs)
    spread = np.sqrt(((output - output.mean(axis=0)) ** 2).sum(axis=0))
    spread[spread == 0.0] = 1.0
    miss = np.sqrt((error**2).sum(axis=0)) / spread
    bft = 100.0 * float(np.maximum(1.0 - miss, 0.0).mean())
    return np.array(blocks), bft if np.isfinite(bft) else 0.0


# What a model at its minimum under white noise does not show: correlation of the
# simulation error with past inputs (in standard deviations), or with its predecessor.
_SUSPICIOUS = 6.0

_SMOOTH = 0.3

_N_LAGS = 40

_MAX_SUSPECTED = 4_096

_MAX_ROWS = 1000

# An error below this share of the present one is that of a clearly better model.
_CLEARLY_BETTER = 0.9

# Relative errors below this are rounding.
_ROUNDING = 1e-6


def error_structure(
    model: tuple[Array, Array, Array, Array], record: Record, x0: Array
) -> tuple[float, float]:
    """How much the simulation error depends on past inputs and on its own past.

    Parameters
    ----------
    model : (A, B, C, D)
    record : Record
    x0 : ndarray of shape (order,)

    Returns
    -------
    by_inputs : float
        Largest correlation with past inputs, in standard deviations of an error that
        does not depend on them (Bartlett's formula for two autocorrelated signals).
    by_itself : float
        Largest correlation of an output's error with that one sample before.
    """
    n = min(record.u.shape[1], _MAX_SUSPECTED)
    u, m = record.u[:, :n].T, len(record.u)
    error = record.y[:, :n].T - lti_response(*model, u, x0)
    lags = correlation_sequence(np.hstack([u, error]), min(_N_LAGS, n))
    own = np.einsum("dii->di", lags)
    of_u, of_v = own[:, :m], own[:, m:]
    white = np.outer(of_u[0], of_v[0])
    variance = np.maximum(2.0 * of_u.T @ of_v - white, 0.2 * white) / n
    variance[variance == 0.0] = np.inf
    by_inputs = (np.abs(lags[:, :m, m:]) / np.sqrt(variance)).max()
    size = np.where(of_v[0] > 0.0, of_v[0], np.inf)
    return float(by_inputs), float((of_v[min(1, len(own) - 1)] / size).max())


def better_horizon(
    found: Identified,
    scaled: ScaledRecords,
    horizon: int,
    free: Freedom,
    *,
    method: str,
    refine: bool,
    enforce_stability: bool,
) -> tuple[int, float] | None:
    """Another horizon whose model fits clearly better, where there is one.

    Others are tried only if the simulation error has structure: coloured noise, a model
    of too low an order, or a poor minimum, which can be told apart by trying.

    Parameters
    ----------
    found : Identified
        Model of the given horizon.
    scaled : ScaledRecords
    horizon : int
    free : Freedom
    method, refine, enforce_stability
        As in `identify`.

    Returns
    -------
    horizon : int
    residual : float
        Its relative simulation error.
    """
    records, model = scaled.records, found.scaled_model
    if not _ROUNDING < found.residual < np.inf:
        return None
    states = model.initial_states
    structure = [
        error_structure(model[:4], record, x0)
        for record, x0 in zip(records[:4], states, strict=False)
    ]
    if all(u < _SUSPICIOUS and v < _SMOOTH for u, v in structure):
        return None
    m, ny, order = len(records[0].u), len(records[0].y), len(model.A)
    height = 2 * m + (1 if method == "pi-moesp" else 2) * ny
    lengths = [record.u.shape[1] for record in records]
    highest = min(max_horizon(lengths, m, ny), max(2, _MAX_ROWS // height))
    energy = sum(float((record.y**2).sum()) for record in records)
    for other in (2 * horizon, 4 * horizon, horizon // 2):
        if not 2 <= other <= highest or max_order(other, m, ny, method) < order:
            continue
        space = subspace_of(records, other, order, method=method)
        trial = realize(
            space, records, order, free, enforce_stability=enforce_stability
        )
        if refine:
            trial, _ = refine_simulation(trial, records, free)
        residual = float(np.sqrt(trial.loss / energy))
        if residual < _CLEARLY_BETTER * found.residual:
            return other, residual
    return None


_HORIZON_RATIO = 1.5

_MAX_ORDER = 20

# A choice needs fewer samples than an estimate.
_MAX_SAMPLES = 12_000

# Orders tried beyond the last one that reduced the simulation error noticeably.
_PATIENCE = 3

_NOTICEABLE = 0.99

_NEGLIGIBLE_GAIN = 3e-3

# An F statistic that does not come about by chance.
_CERTAIN = 20.0

# A start this close to the best one ends in the same minimum when it is refined; the
# shorter horizon is then the cheaper one. Unrefined, a horizon must be as good.
_LOSS_SLACK = {True: 1.05, False: 1.005}


class Candidate(NamedTuple):
    """One row of the selection table.

    Attributes
    ----------
    order, horizon : int
    criterion : float
        Simulation error of the subspace model on the estimation part, root mean
        square relative to the outputs.
    validation_bft : float
        Best fit (percent) on the held-out part of the model that would be returned,
        the mean over outputs; NaN for a horizon that lost within its order.
    """

    order: int
    horizon: int
    criterion: float
    validation_bft: float


class Selection(NamedTuple):
    """Outcome of `select`.

    Attributes
    ----------
    order, horizon : int
        The choice.
    candidates : list of Candidate
        Everything that was tried.
    """

    order: int
    horizon: int
    candidates: list[Candidate]


def horizon_grid(lowest: int, highest: int) -> list[int]:
    """Horizons to try, in a geometric progression that ends at the highest.

    Examples
    --------
    >>> horizon_grid(4, 30)
    [4, 6, 9, 13, 20, 30]
    """
    grid = [highest]
    while grid[-1] / _HORIZON_RATIO >= lowest + 0.5:
        grid.append(round(grid[-1] / _HORIZON_RATIO))
    if grid[-1] > lowest:
        grid.append(lowest)
    return sorted(set(grid))


def smallest_good_order(orders: Sequence[int], blocks: Sequence[Array]) -> int:
    """Smallest order whose held-out error is not significantly above the best.

    Parameters
    ----------
    orders : sequence of int
        Ascending.
    blocks : sequence of ndarray of shape (n_blocks,)
        Block sums of squared held-out errors of each order.

    Returns
    -------
    int

    Notes
    -----
    Significantly worse means by more than two standard errors of the sum of the
    blockwise differences, and by more than 0.3 % of the best error, which is less than
    one superfluous state costs in a record of a few thousand samples.

    Examples
    --------
    >>> import numpy as np
    >>> errors = [np.full(10, 5.0), np.full(10, 1.001), np.full(10, 1.0)]
    >>> smallest_good_order([1, 2, 3], errors)
    2
    """
    totals = [block.sum() if len(block) else np.inf for block in blocks]
    totals = [total if np.isfinite(total) else np.inf for total in totals]
    best = int(np.argmin(totals))
    for order, block, total in zip(orders, blocks, totals, strict=True):
        if not np.isfinite(total):
            continue
        gap = block - blocks[best]
        error = 2.0 * gap.std(ddof=1) * np.sqrt(len(gap)) if len(gap) > 1 else 0.0
        if total - totals[best] <= max(error, _NEGLIGIBLE_GAIN * totals[best]):
            return order
    return orders[best]


def lowest_order(
    orders: Sequence[int], losses: Sequence[float], n_values: int, per_state: int
) -> int:
    """Lowest order that the data it was estimated on do not rule out.

    Held-out parts may be silent, as after an impulse or a step.

    Parameters
    ----------
    orders : sequence of int
        Ascending.
    losses : sequence of float
        Sums of squared simulation errors on the estimation part.
    n_values : int
        Samples times outputs.
    per_state : int
        Parameters that a state adds.

    Returns
    -------
    int
        Every lower order has at least twice the error (root mean square) of a higher
        one, and many times more than its missing parameters would explain.

    Examples
    --------
    >>> lowest_order([0, 1, 2], [1.0, 1e-3, 0.9e-3], n_values=500, per_state=2)
    1
    """
    lowest = orders[0]
    for i, low in enumerate(orders):
        for high, loss in zip(orders[i + 1 :], losses[i + 1 :], strict=True):
            degrees = n_values - high * per_state
            excess = _CERTAIN * (high - low) * per_state * loss / max(degrees, 1)
            if losses[i] > max(4.0 * loss, loss + excess):
                lowest = max(lowest, orders[i + 1])
    return lowest


def _best_horizon(losses: dict[int, float], refine: bool) -> int:
    """Smallest horizon whose loss is near the best."""
    limit = min(losses.values()) * _LOSS_SLACK[refine]
    return min(h for h, loss in losses.items() if loss <= limit)


def select(
    records: Sequence[Record],
    order: int | None,
    horizon: int | None,
    *,
    method: str = "po-moesp",
    feedthrough: bool | NDArray[np.bool_] = True,
    refine: bool = True,
    enforce_stability: bool = False,
    n_noise_states: int = 0,
    initial_states: bool = True,
) -> Selection:
    """Choose the order, the horizon or both.

    Parameters
    ----------
    records : sequence of Record
        Scaled.
    order, horizon : int or None
        None is to be chosen.
    method, feedthrough, refine, enforce_stability, n_noise_states, initial_states
        As in `identify`.

    Returns
    -------
    Selection
    """
    m, ny = len(records[0].u), len(records[0].y)
    if order is None and enforce_stability:
        # The order is that of the system, whatever a stable model can show of it.
        shared_options: dict[str, Any] = {
            "method": method,
            "feedthrough": feedthrough,
            "refine": refine,
            "n_noise_states": n_noise_states,
            "initial_states": initial_states,
        }
        as_found = select(records, None, horizon, **shared_options)
        order = as_found.order
        stable = select(
            records, order, horizon, enforce_stability=True, **shared_options
        )
        others = [row for row in as_found.candidates if row.order != order]
        candidates = sorted(others + stable.candidates)
        return stable._replace(candidates=candidates)
    records = thin_records(records, _MAX_SAMPLES)
    splits = [split_record(record) for record in records]
    parts, cuts = [part for part, _ in splits], [cut for _, cut in splits]
    if order and max_order(max_horizon(cuts, m, ny), m, ny, method) < order:
        # Too few samples to hold any out.
        parts, cuts = list(records), [record.u.shape[1] for record in records]
    energy = sum(float((part.y**2).sum()) for part in parts) or 1.0
    horizons = _horizons(cuts, m, ny, order, horizon, method)
    highest = _highest_order(parts, m, ny, horizons, method) if order is None else order
    shared = correlations_of(parts, max(horizons))
    spaces = {
        h: subspace_of(
            parts,
            h,
            min(highest + n_noise_states, max_order(h, m, ny, method)),
            method=method,
            correlations=shared,
        )
        for h in horizons
    }
    free = freedom(ny, m, feedthrough, initial_states)
    options: dict[str, Any] = {
        "free": free,
        "enforce_stability": enforce_stability,
        "n_noise_states": n_noise_states,
    }
    candidates, tried, held_out, reached, chosen = [], [], [], [], {}
    best_loss, stale = np.inf, 0
    for n in [order] if order is not None else range(highest + 1):
        models = {
            h: realize(space, parts, n, **options)
            for h, space in spaces.items()
            if n <= max_order(h, m, ny, method)
        }
        losses = {h: model.loss for h, model in models.items()}
        chosen[n] = _best_horizon(losses, refine)
        for h, model in models.items():
            bft = np.nan
            if h == chosen[n] or order is not None:
                if refine:
                    start = model
                    model = refine_simulation(start, parts, free)[0]
                blocks, bft = held_out_errors(model, records, cuts)
                if h == chosen[n]:
                    tried.append(n)
                    held_out.append(blocks)
                    refined_loss = model.loss
                    reached.append(refined_loss)
            criterion = float(np.sqrt(losses[h] / energy))
            candidates.append(Candidate(n, h, criterion, bft))
        stale = 0 if refined_loss < _NOTICEABLE * best_loss else stale + 1
        best_loss = min(best_loss, refined_loss)
        if stale > _PATIENCE or best_loss <= 1e-18 * energy:
            break
    if order is None:
        n_values = sum(part.y.size for part in parts)
        lowest = lowest_order(tried, reached, n_values, m + ny + len(parts))
        allowed = [k for k, n in enumerate(tried) if n >= lowest]
        best = smallest_good_order(
            [tried[k] for k in allowed], [held_out[k] for k in allowed]
        )
    else:
        best = order
    if refine or horizon is not None:
        return Selection(best, chosen[best], candidates)
    # Nothing corrects the horizon afterwards: compare on the whole records.
    losses, shared = {}, correlations_of(records, max(horizons))
    for h in horizons:
        if best <= max_order(h, m, ny, method):
            space = subspace_of(
                records, h, best + n_noise_states, method=method, correlations=shared
            )
            losses[h] = realize(space, records, best, **options).loss
    return Selection(best, _best_horizon(losses, refine), candidates)


def _horizons(
    lengths: Sequence[int],
    m: int,
    ny: int,
    order: int | None,
    horizon: int | None,
    method: str,
) -> list[int]:
    """Horizons to try: those that show the order and that the data can fill."""
    if horizon is not None:
        return [horizon]
    height = 2 * m + (1 if method == "pi-moesp" else 2) * ny
    highest = min(max_horizon(lengths, m, ny), max(2, _MAX_ROWS // height))
    lowest = 2 if highest > 1 else 1
    while lowest < highest and max_order(lowest, m, ny, method) < (order or 0):
        lowest += 1
    return horizon_grid(lowest, highest)


def _highest_order(
    parts: Sequence[Record], m: int, ny: int, horizons: Sequence[int], method: str
) -> int:
    """Highest order to try: one that leaves ten values per parameter."""
    n_values = sum(part.y.size for part in parts)
    affordable = (n_values / 10 - m * ny) / (m + ny + len(parts))
    by_horizon = max(max_order(h, m, ny, method) for h in horizons)
    return int(np.clip(affordable, 0, min(_MAX_ORDER, by_horizon)))
