"""Choice of the order and of the horizon by what validates.

Every candidate is identified on the first part of each experiment. For a given order
all horizons have the same number of parameters, so that the one with the smallest
simulation error is simply the best; orders are compared by the simulation error on
the part held out, and the smallest that is not significantly worse than the best is
taken. The steps, one function each: hold out a part (`_hold_out`), list the horizons
and orders worth trying (`_horizons`, `_highest_order`), try each order at the horizon
that suits it (`_try_orders`), and choose among what was tried (`_choose`).

A horizon that was given is not questioned but by `better_horizon`, after the fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..systems.simulation import lti_response
from .hankel import correlation_sequence
from .identification import Settings, estimate, realize, subspaces_of
from .realization import ObservabilitySubspace
from .refinement import refine_simulation
from .signals import Record, output_energy
from .simulation_fit import Realization

Array = NDArray[np.float64]

_MAX_SAMPLES = 12_000  # that a choice is made from: it needs fewer than an estimate

# Share of each experiment to identify on, and the length below which none is held out:
# what is left would be two samples.
_ESTIMATION_SHARE, _TOO_SHORT = 0.7, 8

# Blocks of time of each held-out part: many enough for the spread of their errors to be
# known, and long enough for these to be nearly independent.
_N_BLOCKS = 20

_HORIZON_RATIO = 1.5  # between horizons tried: the error changes little within it

# Height of the Hankel matrix up to which horizons are tried: the cost of compression
# grows with its third power.
_MAX_ROWS = 1000

# Highest order tried, and the values that the data must have for each parameter.
_MAX_ORDER, _VALUES_PER_PARAMETER = 20, 10

# Orders tried beyond the last one that made the loss this much smaller, one per cent.
_PATIENCE, _NOTICEABLE = 3, 0.99

_EXACT = 1e-18  # share of the outputs' energy (an error of 1e-9) that is rounding

# A start this close to the best one ends in the same minimum when it is refined; the
# shorter horizon is then the cheaper one. Unrefined, a horizon must be as good.
_LOSS_SLACK = {True: 1.05, False: 1.005}

# Held-out errors that are higher by less than this share, or by less than this many
# standard errors (two: 95 %), are as good: one superfluous state costs more than the
# first in a record of a few thousand samples.
_NEGLIGIBLE_GAIN, _STANDARD_ERRORS = 3e-3, 2.0

# What rules an order out by the data it was estimated on: this many times the loss of a
# higher one (twice the error), and an F statistic that does not come about by chance.
_TWICE_THE_ERROR, _CERTAIN = 4.0, 20.0


class Candidate(NamedTuple):
    """One row of the selection table.

    The criterion is the simulation error of the subspace model on the estimation part,
    root mean square relative to the outputs; `validation_bft` the best fit (percent,
    mean over outputs) on the held-out part of the model that would be returned, NaN for
    a horizon that lost within its order.
    """

    order: int
    horizon: int
    criterion: float
    validation_bft: float


class Selection(NamedTuple):
    """The order and the horizon chosen, and everything that was tried."""

    order: int
    horizon: int
    candidates: list[Candidate]

    def table(self) -> pd.DataFrame:
        """One row per candidate, and which of them was chosen."""
        columns = [np.array(column) for column in zip(*self.candidates, strict=True)]
        chosen = (columns[0] == self.order) & (columns[1] == self.horizon)
        names = (*Candidate._fields, "chosen")
        return pd.DataFrame(dict(zip(names, [*columns, chosen], strict=True)))


def selection_text(table: pd.DataFrame) -> str:
    """The selection table as text, the chosen row marked.

    >>> print(selection_text(Selection(2, 9, [Candidate(2, 9, 0.031, 96.9)]).table()))
    order  horizon  error [%]  validation BFT [%]
        2        9     3.1000               96.90  <- chosen
    """
    lines = ["order  horizon  error [%]  validation BFT [%]"]
    for order, horizon, criterion, validation_bft, chosen in table.to_numpy():
        bft = "-" if np.isnan(validation_bft) else f"{validation_bft:.2f}"
        mark = "  <- chosen" if chosen else ""
        error = f"{100.0 * criterion:.4f}"
        lines.append(f"{order:5.0f}  {horizon:7.0f}  {error:>9}  {bft:>18}{mark}")
    return "\n".join(lines)


class _Split(NamedTuple):
    """Records of which the later parts are held out."""

    records: list[Record]  # whole
    parts: list[Record]  # what models are estimated on
    cuts: list[int]  # where the held-out part begins; the length where there is none

    @property
    def energy(self) -> float:
        """Of the outputs to estimate on."""
        return output_energy(self.parts)


class _Tried(NamedTuple):
    """One order, at the horizon that suits it best."""

    order: int
    horizon: int
    model: Realization  # that would be returned, of the parts to estimate on
    held_out: Array  # (n_blocks,): sums of its squared errors on the parts held out
    candidates: list[Candidate]  # the horizons compared


def select(
    records: Sequence[Record],
    order: int | None,
    horizon: int | None,
    settings: Settings,
) -> Selection:
    """Choose the order, the horizon or both (None) for scaled records."""
    records = _thin_records(records, _MAX_SAMPLES)
    if order is not None or not settings.enforce_stability:
        return _search(records, order, horizon, settings)
    # The order is that of the system, whatever a stable model can show of it.
    as_found = settings._replace(enforce_stability=False)
    chosen = _search(records, None, horizon, as_found)
    stable = _search(records, chosen.order, horizon, settings)
    others = [row for row in chosen.candidates if row.order != chosen.order]
    return stable._replace(candidates=sorted(others + stable.candidates))


def _search(
    records: list[Record], order: int | None, horizon: int | None, settings: Settings
) -> Selection:
    """The choice for settings that suit all orders alike."""
    split = _hold_out(records, order, settings)
    parts = split.parts
    horizons = _horizons(parts, order or 0, settings) if horizon is None else [horizon]
    highest = _highest_order(parts, horizons, settings) if order is None else order
    orders = range(0 if order is None else order, highest + 1)
    width = highest + settings.n_noise_states
    widths = {h: min(width, settings.max_order(h)) for h in horizons}
    spaces = subspaces_of(parts, widths, settings.method)
    # Of a given order, the table tells what every horizon would return.
    tried = _try_orders(orders, spaces, split, settings, validate_all=order is not None)
    best = _choose(tried, split)
    chosen = best.horizon
    if not settings.refine and horizon is None:
        # Nothing corrects the horizon afterwards: compare on the whole records.
        width = best.order + settings.n_noise_states
        widths = {h: width for h in horizons if best.order <= settings.max_order(h)}
        spaces = subspaces_of(records, widths, settings.method)
        starts = _starts(best.order, spaces, records, settings)
        chosen = _best_horizon(starts, settings.refine)
    candidates = [row for one in tried for row in one.candidates]
    return Selection(best.order, chosen, candidates)


def _thin_records(records: Sequence[Record], n_samples: int) -> list[Record]:
    """Evenly spread experiments of about `n_samples` in total, at least one.

    Experiments beyond that length are cut to it.

    >>> runs = [Record(np.zeros((1, n)), np.zeros((1, n))) for n in (50, 40, 60, 70)]
    >>> [run.u.shape[1] for run in _thin_records(runs, 120)]
    [50, 60]
    """
    lengths = [record.u.shape[1] for record in records]
    keep = max(1, min(len(records), int(n_samples * len(records) / sum(lengths))))
    spread = [i * len(records) // keep for i in range(keep)]
    return [records[i].head(n_samples) for i in spread]


def _hold_out(records: list[Record], order: int | None, settings: Settings) -> _Split:
    """Part the records, unless too few samples are left to estimate a given order."""
    lengths = [record.u.shape[1] for record in records]
    cuts = [
        n if n < _TOO_SHORT else int(np.ceil(_ESTIMATION_SHARE * n)) for n in lengths
    ]
    if order and settings.max_order(settings.max_horizon(cuts)) < order:
        return _Split(records, records, lengths)
    parts = [record.head(cut) for record, cut in zip(records, cuts, strict=True)]
    return _Split(records, parts, cuts)


def _horizons(parts: Sequence[Record], order: int, settings: Settings) -> list[int]:
    """Horizons to try: those that show the order and that the data can fill."""
    highest = _highest_horizon(parts, settings)
    lowest = 2 if highest > 1 else 1
    while lowest < highest and settings.max_order(lowest) < order:
        lowest += 1
    return _horizon_grid(lowest, highest)


def _highest_horizon(records: Sequence[Record], settings: Settings) -> int:
    """Highest horizon to try: one that the data fill and that costs little."""
    ny, m = settings.free.direct.shape
    height = 2 * m + (1 if settings.method == "pi-moesp" else 2) * ny
    lengths = [record.u.shape[1] for record in records]
    return min(settings.max_horizon(lengths), max(2, _MAX_ROWS // height))


def _horizon_grid(lowest: int, highest: int) -> list[int]:
    """Horizons to try, in a geometric progression that ends at the highest.

    >>> _horizon_grid(4, 30)
    [4, 6, 9, 13, 20, 30]
    """
    grid = [highest]
    while grid[-1] / _HORIZON_RATIO >= lowest + 0.5:
        grid.append(round(grid[-1] / _HORIZON_RATIO))
    if grid[-1] > lowest:
        grid.append(lowest)
    return sorted(set(grid))


def _highest_order(
    parts: Sequence[Record], horizons: Sequence[int], settings: Settings
) -> int:
    """Highest order to try: one that leaves enough values for each parameter."""
    ny, m = settings.free.direct.shape
    n_values = sum(part.y.size for part in parts)
    affordable = n_values / _VALUES_PER_PARAMETER - m * ny
    affordable /= m + ny + len(parts)
    by_horizon = max(settings.max_order(h) for h in horizons)
    return int(np.clip(affordable, 0, min(_MAX_ORDER, by_horizon)))


def _try_orders(
    orders: Sequence[int],
    spaces: Mapping[int, ObservabilitySubspace],
    split: _Split,
    settings: Settings,
    *,
    validate_all: bool,
) -> list[_Tried]:
    """Every order in turn, until further states gain nothing.

    Of the horizons of an order the best is validated, or each with `validate_all`.
    """
    tried: list[_Tried] = []
    best_loss, stale = np.inf, 0
    for order in orders:
        starts = _starts(order, spaces, split.parts, settings)
        found = _validated(order, starts, split, settings, validate_all=validate_all)
        tried.append(found)
        stale = 0 if found.model.loss < _NOTICEABLE * best_loss else stale + 1
        best_loss = min(best_loss, found.model.loss)
        if stale > _PATIENCE or best_loss <= _EXACT * split.energy:
            break
    return tried


def _validated(
    order: int,
    starts: Mapping[int, Realization],
    split: _Split,
    settings: Settings,
    *,
    validate_all: bool,
) -> _Tried:
    """One order at the horizon whose start is best, and what the others came to."""
    chosen = _best_horizon(starts, settings.refine)
    models, errors = {}, {}
    for horizon in starts if validate_all else [chosen]:
        model = starts[horizon]
        if settings.refine:
            model = refine_simulation(model, split.parts, settings.free)
        models[horizon] = model
        errors[horizon] = _held_out_error(model, split.records, split.cuts)
    candidates = [
        Candidate(
            order,
            horizon,
            float(np.sqrt(start.loss / (split.energy or 1.0))),
            errors[horizon].bft if horizon in errors else np.nan,
        )
        for horizon, start in starts.items()
    ]
    return _Tried(order, chosen, models[chosen], errors[chosen].blocks, candidates)


def _starts(
    order: int,
    spaces: Mapping[int, ObservabilitySubspace],
    records: Sequence[Record],
    settings: Settings,
) -> dict[int, Realization]:
    """Model of an order, before refinement, from every horizon that can show it."""
    return {
        horizon: realize(space, records, order, settings)
        for horizon, space in spaces.items()
        if order <= settings.max_order(horizon)
    }


def _best_horizon(starts: Mapping[int, Realization], refine: bool) -> int:
    """Smallest horizon whose loss is near the best."""
    limit = min(model.loss for model in starts.values()) * _LOSS_SLACK[refine]
    return min(h for h, model in starts.items() if model.loss <= limit)


class _HeldOutError(NamedTuple):
    """Simulation error on the parts held out."""

    blocks: Array  # (n_blocks,): sums of squares over consecutive blocks of time
    bft: float  # best fit, percent, mean over outputs; NaN where nothing is held out


def _held_out_error(
    model: Realization, records: Sequence[Record], cuts: Sequence[int]
) -> _HeldOutError:
    """Error after the cuts of whole records, simulated from the model's states."""
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
        return _HeldOutError(np.zeros(0), np.nan)
    error, output = np.vstack(errors), np.vstack(outputs)
    spread = np.sqrt(((output - output.mean(axis=0)) ** 2).sum(axis=0))
    spread[spread == 0.0] = 1.0
    miss = np.sqrt((error**2).sum(axis=0)) / spread
    bft = 100.0 * float(np.maximum(1.0 - miss, 0.0).mean())
    return _HeldOutError(np.array(blocks), bft if np.isfinite(bft) else 0.0)


def _choose(tried: Sequence[_Tried], split: _Split) -> _Tried:
    """The smallest order that neither part of the data speaks against."""
    parts = split.parts
    n_values = sum(part.y.size for part in parts)
    per_state = len(parts[0].u) + len(parts[0].y) + len(parts)
    losses = {one.order: one.model.loss for one in tried}
    lowest = _lowest_order(losses, n_values, per_state)
    held_out = {one.order: one.held_out for one in tried if one.order >= lowest}
    order = _smallest_good_order(held_out)
    return next(one for one in tried if one.order == order)


def _smallest_good_order(held_out: Mapping[int, Array]) -> int:
    """Smallest order whose held-out error is not significantly above the best.

    Significantly: by more than two standard errors of the sum of the blockwise
    differences, and by more than 0.3 % of the best error. `held_out` are the block sums
    of squared errors by order, ascending.

    >>> errors = {1: np.full(10, 5.0), 2: np.full(10, 1.001), 3: np.full(10, 1.0)}
    >>> _smallest_good_order(errors)
    2
    """
    totals = {n: b.sum() if len(b) else np.inf for n, b in held_out.items()}
    totals = {n: total if np.isfinite(total) else np.inf for n, total in totals.items()}
    best = min(totals, key=totals.__getitem__)
    for order, block in held_out.items():
        if not np.isfinite(totals[order]):
            continue
        gap = block - held_out[best]
        error = gap.std(ddof=1) * np.sqrt(len(gap)) if len(gap) > 1 else 0.0
        allowed = max(_STANDARD_ERRORS * error, _NEGLIGIBLE_GAIN * totals[best])
        if totals[order] - totals[best] <= allowed:
            return order
    return best


def _lowest_order(losses: Mapping[int, float], n_values: int, per_state: int) -> int:
    """Lowest order that the data it was estimated on do not rule out.

    Held-out parts may be silent, as after an impulse or a step. Ruled out is an order
    that has twice the error (root mean square) of a higher one, and many times more
    than its missing parameters would explain.

    `losses` are sums of squared simulation errors on the estimation part by order,
    ascending, of `n_values` samples times outputs; a state adds `per_state` parameters.

    >>> _lowest_order({0: 1.0, 1: 1e-3, 2: 0.9e-3}, n_values=500, per_state=2)
    1
    """
    orders = list(losses)
    lowest = orders[0]
    for i, low in enumerate(orders):
        for high in orders[i + 1 :]:
            loss = losses[high]
            degrees = max(n_values - high * per_state, 1)
            excess = _CERTAIN * (high - low) * per_state * loss / degrees
            if losses[low] > max(_TWICE_THE_ERROR * loss, loss + excess):
                lowest = max(lowest, orders[i + 1])
    return lowest


# What a model at its minimum under white noise does not show: correlation of the
# simulation error with past inputs, in standard deviations (the largest of a hundred
# chance values is near three), or with its predecessor.
_SUSPICIOUS, _SMOOTH = 6.0, 0.3

# Where that is looked for: past inputs up to this many samples ago, in this many
# samples of so many experiments.
_N_LAGS, _MAX_SUSPECTED, _SUSPECTED_RECORDS = 40, 4_096, 4

# Least variance of a correlation, relative to that of white signals: an estimated sum
# of products over the lags may come out as low as zero.
_LEAST_VARIANCE = 0.2

_CLEARLY_BETTER = 0.9  # of the present error: that of a clearly better model
_ROUNDING = 1e-6  # relative errors below it are rounding


def better_horizon(
    model: Realization,
    residual: float,
    records: Sequence[Record],
    horizon: int,
    settings: Settings,
) -> tuple[int, float] | None:
    """Another horizon whose model fits clearly better, and its residual.

    Others are tried only if the simulation error has structure: coloured noise, a model
    of too low an order, or a poor minimum, which can be told apart by trying.
    """
    if not _ROUNDING < residual < np.inf:
        return None
    some = zip(records[:_SUSPECTED_RECORDS], model.initial_states, strict=False)
    structure = [_error_structure(model, record, x0) for record, x0 in some]
    if all(u < _SUSPICIOUS and v < _SMOOTH for u, v in structure):
        return None
    order, energy = len(model.A), output_energy(records)
    highest = _highest_horizon(records, settings)
    for other in (2 * horizon, 4 * horizon, horizon // 2):
        if not 2 <= other <= highest or settings.max_order(other) < order:
            continue
        space = subspaces_of(records, {other: order}, settings.method)[other]
        trial = estimate(space, records, order, settings)
        error = float(np.sqrt(trial.loss / energy))
        if error < _CLEARLY_BETTER * residual:
            return other, error
    return None


def _error_structure(
    model: Realization, record: Record, x0: Array
) -> tuple[float, float]:
    """How much the simulation error depends on past inputs and on its own past.

    The largest correlation with past inputs, in standard deviations of an error that
    does not depend on them (Bartlett's formula for two autocorrelated signals), and
    the largest of an output's error with that one sample before.
    """
    n = min(record.u.shape[1], _MAX_SUSPECTED)
    u, m = record.u[:, :n].T, len(record.u)
    error = record.y[:, :n].T - lti_response(*model[:4], u, x0)
    lags = correlation_sequence(np.hstack([u, error]), min(_N_LAGS, n))
    own = np.einsum("dii->di", lags)
    of_u, of_v = own[:, :m], own[:, m:]
    white = np.outer(of_u[0], of_v[0])
    variance = np.maximum(2.0 * of_u.T @ of_v - white, _LEAST_VARIANCE * white) / n
    variance[variance == 0.0] = np.inf
    by_inputs = (np.abs(lags[:, :m, m:]) / np.sqrt(variance)).max()
    size = np.where(of_v[0] > 0.0, of_v[0], np.inf)
    return float(by_inputs), float((of_v[min(1, len(own) - 1)] / size).max())
