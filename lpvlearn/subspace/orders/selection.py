"""Choice of the order and of the horizon by evidence.

Errors are whitened first by the noise in those of a pilot model (`noise`), so that
their sum of squares is a likelihood. Each order is then fitted at the horizon whose
start is best, or from the model of the order below with one state more for what that
leaves, whichever gives less: more states never fit worse. A criterion like Akaike's
weighs the likelihood against the number of parameters. In the end the orders about the
best one are fitted again, each by the noise that it leaves itself, and looked for anew
by that of the best.

The criterion trusts that the system is what the models are. Simulation of parts held
out does not (`held_out`): it may lower the order, and decides among orders which the
criterion hardly tells apart, as noise that follows the inputs and a further state are.

A horizon that was given is questioned after the fit only (`horizons`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..evidence.constants import CERTAIN
from ..evidence.rounding import rounded_outputs
from ..evidence.statistics import Evidence
from ..samples.records import Record, output_energy, thinned
from ..simulation_error.criterion import EXACT, PRICE, criterion_of, n_parameters
from ..simulation_error.held_out import MATTERS, HeldOut
from ..simulation_error.noise import Whitening
from ..simulation_error.refinement import refine_simulation
from ..simulation_error.simulation_fit import (
    Realization,
    simulation_errors,
    simulation_fit,
    with_initial_states,
)
from .decimation import SlowStarts, decimated, full_rate
from .further_states import FurtherStates
from .identification import (
    Candidate,
    Settings,
    of_records,
    realize,
    refit,
    restarted,
    subspaces_of,
    validate,
)
from .realization import Subspace

Array = NDArray[np.float64]

_HORIZON_RATIO = 2.0  # between horizons tried: the error changes little within it

# Height of the Hankel matrix up to which horizons are tried: the cost of compression
# grows with its third power.
_MAX_ROWS = 1000

# Highest order tried, and the values that the data must have for each parameter: fewer
# and the criterion, which is one of many samples, would be trusted too far.
MAX_ORDER, _VALUES_PER_PARAMETER = 30, 3

# So many values for each initial state of other experiments than the first, by those
# for a parameter: what many unknowns gain by chance is known well.
_OF_OTHERS = 0.5

# Order and refinement steps of the pilot, whose errors are to be noise and not lack of
# states; it is not to fit the noise itself.
_PILOT_ORDER, _PILOT_STEPS = 8, 3

_WEIGHINGS = 4  # of the outputs, with the pilot: each brings a clean one nearer by ten

_MORE_ROUNDS = 2  # of an order about the best: with the noise that it leaves itself

_PATIENCE = 3  # orders looked at about the best one; a fourth ends the search beyond it

# A start this close to the best one ends in the same minimum when it is refined; the
# shorter horizon is then the cheaper one. Unrefined, a horizon must be as good.
_LOSS_SLACK = {True: 1.05, False: 1.005}

# Times the least loss from subspaces, of the order below and a state more, before it is
# refined, up to which it may end lower.
_NEARLY = 1.02

_AS_GOOD = 0.999  # share of the loss of the order below that more states must beat

# Times the squared errors of the pilot, in samples whitened alike, beyond which its
# order must be reached: where outputs hardly show noise, as behind a filter, what they
# make of their own past is likelier than what a few states make of the inputs.
_UNEXPLAINED = 4.0

_DOUBT = 1.0  # standard errors by which another order must be better

# How far below the choice other orders are simulated on parts held out.
_LOWER = (1, 2, 4, 8, 16)

# Of a criterion, for each value, above the best one: so far the noise of its own brings
# no order. That has taken up to seven tenths of such a distance, mostly a tenth.
_FAR = 1.0

# An order below that is as far and has so many times the squared errors, in samples
# that it was fitted to, cannot be better on parts held out: states that are free anew
# in each of these take a tenth or so of slow noise.
_BEYOND = 100.0

# Times the squared errors on parts held out, beyond which those on the samples of the
# fit are of what these parts do not show: a step that comes before all of them.
_EASIER = 10.0


_criterion, _loss = attrgetter("criterion"), attrgetter("loss")  # that is to be least


class Row(NamedTuple):
    """One row of the selection table.

    The error is that of the subspace model, whitened, root mean square relative to the
    outputs; the criterion that of the refined model, per value and above the best one,
    NaN for a horizon that lost within its order; `validation_bft` the best fit (in
    percent, mean over outputs) on parts held out, NaN where that was not looked at.
    """

    order: int
    horizon: int
    error: float
    criterion: float
    validation_bft: float


@dataclass(frozen=True)
class Selection:
    """The order and the horizon chosen, and everything that was tried."""

    order: int
    horizon: int
    rows: list[Row]
    candidate: Candidate | None = None  # the choice, of thinned records
    held_out: HeldOut | None = None  # its errors

    def among(self, others: Selection) -> Selection:
        """The choice among what others tried."""
        rest = [row for row in others.rows if row.order != self.order]
        return replace(self, rows=sorted([*self.rows, *rest]))

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per candidate, and which of them was chosen."""
        columns = [np.array(column) for column in zip(*self.rows, strict=True)]
        chosen = (columns[0] == self.order) & (columns[1] == self.horizon)
        names = (*Row._fields, "chosen")
        return pd.DataFrame(dict(zip(names, [*columns, chosen], strict=True)))


class PlantFit(NamedTuple):
    """A model of scaled records, of an open or a closed loop, and how it was chosen."""

    evidence: Evidence
    selection: Selection
    singular_values: Array
    residual: float  # rms of simulation or prediction errors relative to the outputs
    stability_loss: float  # increase of the residual that enforced stability cost


def selection_text(table: pd.DataFrame) -> str:
    """The best horizon of every order as text, the chosen row marked.

    >>> print(selection_text(Selection(2, 9, [Row(2, 9, 0.031, 0.0, 96.9)]).table))
    order  horizon  error [%]  criterion  validation BFT [%]
        2        9     3.1000     0.0000               96.90  <- chosen
    """
    lines = ["order  horizon  error [%]  criterion  validation BFT [%]"]
    best = table.dropna(subset="criterion")
    for order, horizon, error, criterion, validation_bft, chosen in best.to_numpy():
        bft = "-" if np.isnan(validation_bft) else f"{validation_bft:.2f}"
        mark = "  <- chosen" if chosen else ""
        lines.append(
            f"{order:5.0f}  {horizon:7.0f}  {100.0 * error:9.4f}  {criterion:9.4f}  "
            f"{bft:>18}{mark}"
        )
    return "\n".join(lines)


class _Tried(NamedTuple):
    """One order, at the horizon that suits it best."""

    order: int
    candidate: Candidate  # its model that of whitened records, until it is judged
    criterion: float
    errors: dict[int, float]  # by horizon, relative, of the model before refinement


def select(
    records: Sequence[Record],
    order: int | None,
    horizon: int | None,
    settings: Settings,
) -> Selection:
    """Choose the order, the horizon or both (None) for scaled records."""
    whole, records = records, thinned(records)
    # The order is that of the system, whatever a stable or rough model can show of it,
    # or one that minimises other errors.
    by_evidence = settings._replace(enforce_stability=False, refine=True)
    if settings.refine and not settings.enforce_stability:
        chosen = _search(records, order, horizon, by_evidence)
        if horizon is None:
            chosen = _of_longer_time(chosen, whole, order, by_evidence)
        return chosen if settings.weigh else replace(chosen, candidate=None)
    rows: list[Row] = []
    if order is None:
        chosen = _search(records, None, horizon, by_evidence)
        order = chosen.order
        rows = [row for row in chosen.rows if row.order != order]
    wanted = _Range([order], order, horizon, {}, {})
    starts = _starts(wanted, order, records, settings)
    best = _best_horizon(starts, settings.refine)
    errors = _relative_errors(starts, records)
    rows += [
        Row(order, h, error, 0.0 if h == best else np.nan, np.nan)
        for h, error in errors.items()
    ]
    return Selection(order, best, sorted(rows))


def _of_longer_time(
    chosen: Selection, whole: Sequence[Record], order: int | None, settings: Settings
) -> Selection:
    """The choice, or that of decimated records of all the time where that is better.

    As many samples of slow motion as a choice needs may take longer than the records
    that it was made of.
    """
    n_samples = sum(record.n_samples for record in whole)
    factor = -(-n_samples // sum(record.n_samples for record in thinned(whole)))
    if factor == 1 or chosen.candidate is None:
        return chosen
    n, free = order or max(chosen.order, _PILOT_ORDER), settings.free
    slow = SlowStarts(whole, n, settings).best(n, factor)
    model = chosen.candidate.model
    least = simulation_fit(model.A, model.C, whole, free).loss / _LOSS_SLACK[True]
    if slow is None or not slow.loss < least:
        return chosen
    other = _search(thinned(decimated(whole, factor)), order, None, settings)
    assert other.candidate is not None
    A = full_rate(other.candidate.model.A, factor)
    if A is None:
        return chosen
    model = simulation_fit(A, other.candidate.model.C, whole, free)
    candidate = Candidate(model, other.horizon, Whitening.none(len(model.C)), True)
    return replace(other, candidate=candidate) if model.loss < least else chosen


class _Range(NamedTuple):
    """What is to be tried; one order, or one horizon, is given."""

    orders: Sequence[int]  # ascending
    pilot: int  # its order
    horizon: int | None
    # of the records as they are, for orders up to the highest: by horizon, as found;
    # None for horizons that are left out
    spaces: dict[int, Subspace | None]
    starts: dict[tuple[int, int], Realization]  # by order and horizon, as found
    slow: bool = False  # whether decimated records are asked as well


def _search(
    records: list[Record], order: int | None, horizon: int | None, settings: Settings
) -> Selection:
    """The choice for settings that suit all orders alike."""
    wanted = _wanted(records, order, horizon, settings)
    pilot, slow = _pilot(records, wanted, settings)
    wanted = wanted._replace(slow=slow or settings.differences)
    repeated = tuple(rounded_outputs(pilot, records).repeated)
    settings = settings._replace(repeated=repeated)
    noise = _noise_of(pilot, records, wanted, settings)
    tried = _try_orders(wanted, records, noise, settings, pilot=pilot)
    found = _judged(tried, records, settings)
    orders, far = _by_own_noise(found, records, wanted, settings)
    least = min(orders.values(), key=_criterion)
    highest, last = max(orders), wanted.orders[-1]
    again = not least.candidate.whitening.is_close_to(noise)
    while again or least.order == highest < last:
        lowest, end = highest, last  # or until further states gain nothing
        if again:
            lowest = max(wanted.orders[0], least.order - _PATIENCE)
            end = min(last, least.order + _PATIENCE)
        noise = least.candidate.whitening
        some = [k for k in wanted.orders if lowest <= k <= end]
        about = wanted._replace(orders=some)
        tried = _try_orders(about, records, noise, settings)
        for k, one in _judged(tried, records, settings).items():
            orders[k] = min(orders.get(k, one), one, key=_criterion)
        least = min(orders.values(), key=_criterion)
        reached = max((one.order for one in tried), default=lowest)
        if not again and reached == highest:
            break  # the data show no more
        highest, again = reached, False
    chosen = best = least.order
    errors = {best: validate(least.candidate, records, settings)}
    close = [k for k, one in orders.items() if one.criterion < least.criterion + PRICE]
    for order in [k for k in close if k > best] + [best - step for step in _LOWER]:
        if order not in orders:
            continue
        if order in far:
            if _is_beyond(far[order], orders[chosen], errors[chosen], records):
                continue
            own = _with_own_noise(far[order], records, wanted, settings)
            orders[order] = min(own, orders[order], key=_criterion)
        errors[order] = validate(orders[order].candidate, records, settings)
        if not _shows(orders[order], errors[order], records):
            continue
        (one, error), (other, its) = ((orders[k], errors[k]) for k in (chosen, order))
        if _refutes(one, error, other, its, 0.0 if order > best else MATTERS):
            chosen = order
    candidate = orders[chosen].candidate
    rows = _rows(orders, records, errors)
    return Selection(chosen, candidate.horizon, rows, candidate, errors[chosen])


def _is_beyond(
    one: _Tried, chosen: _Tried, error: HeldOut, records: Sequence[Record]
) -> bool:
    """Whether an order cannot be better on parts held out than the choice is."""
    n_values = sum(record.n_values for record in records)
    least = max(chosen.candidate.model.loss, error.residual**2 * n_values)
    return one.candidate.model.loss > _BEYOND * least


def _refutes(
    chosen: _Tried, error: HeldOut, other: _Tried, its: HeldOut, share: float
) -> bool:
    """Whether parts held out are simulated clearly better by another order.

    What is far likelier is not refuted by errors that are larger themselves, and less
    only beside what the unknowns of both explain.
    """
    surely = chosen.criterion < other.criterion - CERTAIN
    if surely and its.total > error.total:
        return False
    return its.clearly_better_than(error, _DOUBT, share)


def _shows(one: _Tried, error: HeldOut, records: Sequence[Record]) -> bool:
    """Whether parts held out show what a model lacks as samples of the fit do.

    Inputs may rest there.
    """
    n_values = sum(record.n_values for record in records)
    easier = one.candidate.model.loss > _EASIER * error.residual**2 * n_values
    return error.bft > 0.0 and not easier


def _judged(
    tried: Sequence[_Tried], records: list[Record], settings: Settings
) -> dict[int, _Tried]:
    """By order: models of the records, and their criteria in these.

    Of samples that were weighted but not filtered the criterion is what it was.
    """
    found = {}
    for one in tried:
        whitening = one.candidate.whitening
        model = of_records(one.candidate.model, records, whitening, settings.free)
        candidate = one.candidate._replace(model=model)
        if len(whitening.filter) > 1:
            found[one.order] = _judge(one, candidate, records, settings)
        else:
            found[one.order] = one._replace(candidate=candidate)
    return found


def _by_own_noise(
    found: Mapping[int, _Tried],
    records: list[Record],
    wanted: _Range,
    settings: Settings,
) -> tuple[dict[int, _Tried], dict[int, _Tried]]:
    """All orders, those about the best one fitted again by the noise of each.

    The noise of one model for all favours orders like its own: what states too many
    took of slow noise, those that leave it would have to follow. Those that are too far
    from the best one for it are left as they are, and returned on their own as well.
    """
    found, far = dict(found), {}
    least = min(found.values(), key=_criterion)
    limit = least.criterion + _FAR * sum(record.n_values for record in records)
    orders = sorted(found)
    first = orders.index(least.order)
    for side in (orders[first::-1], orders[first + 1 :]):
        best, stale = np.inf, 0
        for order in side:
            if stale > _PATIENCE:
                break
            one = found[order]
            if one.criterion > limit:
                far[order] = one
            else:
                found[order] = _with_own_noise(one, records, wanted, settings)
            stale = 0 if found[order].criterion < best else stale + 1
            best = min(best, found[order].criterion)
    return found, far


def _with_own_noise(
    one: _Tried, records: list[Record], wanted: _Range, settings: Settings
) -> _Tried:
    """An order fitted again by the noise that it leaves itself."""
    candidate = one.candidate
    for _ in range(_MORE_ROUNDS):
        noise = _noise_of(candidate.model, records, wanted, settings)
        if noise.is_close_to(candidate.whitening):
            break
        candidate = refit(records, candidate, settings, noise, patient=False)
    if candidate is one.candidate:
        return one
    return _judge(one, candidate, records, settings)


def _judge(
    one: _Tried, candidate: Candidate, records: list[Record], settings: Settings
) -> _Tried:
    """A model of the records, its criterion in samples weighted but not filtered."""
    weighted = Whitening(np.ones(1), candidate.whitening.weight)
    model, free = weighted.model(candidate.model), settings.free
    model = model._replace(trends=model.trends @ weighted.weight.T)
    records = weighted.records(records, free)
    criterion = criterion_of(model, records, free, settings.repeated)
    return one._replace(candidate=candidate, criterion=criterion)


def _pilot(
    records: list[Record], wanted: _Range, settings: Settings
) -> tuple[Realization, bool]:
    """A model whose errors are the noise, or little else: outputs are weighted.

    And whether decimated records are why it is as good.
    """
    free, whitening = settings.free, Whitening.none(len(records[0].y))
    order = wanted.pilot
    _look_up(wanted, order, records, settings)  # for the orders to come as well
    is_cut = wanted.horizon is None and _is_cut_short(wanted, records, settings)
    only = wanted._replace(orders=range(order, order + 1))
    starts = _starts(only, order, records, settings)
    slow = SlowStarts(records, order, settings).best(order) if is_cut else None
    model, is_slow = _refined(starts, slow, records, settings, _PILOT_STEPS)
    for _ in range(_WEIGHINGS if len(records[0].y) > 1 else 0):
        errors = simulation_errors(model, records)
        again = Whitening.of(errors, free, filtered=False)
        if again.is_close_to(whitening):
            break
        whitening, white = again, again.records(records, free)
        start = restarted(model, whitening, white, free)
        model = refine_simulation(start, white, free, _PILOT_STEPS)
        model = of_records(model, records, whitening, free)
    return model, is_slow


def _noise_of(
    model: Realization, records: Sequence[Record], wanted: _Range, settings: Settings
) -> Whitening:
    """Noise in the errors of a model; none where a filter takes too many samples."""
    errors = simulation_errors(model, records)
    found = Whitening.of(errors, settings.free)
    lengths = found.lengths(records, settings.free)
    room, horizon = settings.max_horizon(lengths), wanted.horizon or 1
    if room < horizon or settings.max_order(room) < wanted.orders[0]:
        return Whitening.none(len(records[0].y))
    return found


def _rows(
    orders: Mapping[int, _Tried],
    records: Sequence[Record],
    errors: Mapping[int, HeldOut],
) -> list[Row]:
    """Of all horizons of every order."""
    least = min(one.criterion for one in orders.values())
    n_values = sum(record.y.size for record in records)
    rows = []
    for order, one in sorted(orders.items()):
        above = (one.criterion - least) / n_values
        bft = errors[order].bft if order in errors else np.nan
        for horizon, error in one.errors.items():
            is_best = horizon == one.candidate.horizon
            known = (above, bft) if is_best else (np.nan, np.nan)
            rows.append(Row(order, horizon, error, *known))
    return rows


def _relative_errors(
    starts: Mapping[int, Realization], records: Sequence[Record]
) -> dict[int, float]:
    """Simulation errors by horizon, root mean square relative to the outputs."""
    energy = output_energy(records) or 1.0
    return {h: float(np.sqrt(start.loss / energy)) for h, start in starts.items()}


def _look_up(
    wanted: _Range, lowest: int, records: Sequence[Record], settings: Settings
) -> dict[int, Subspace]:
    """Subspaces of every horizon that shows the lowest order, known ones or new."""
    horizon, width = wanted.horizon, max(wanted.orders[-1], wanted.pilot)
    width += settings.n_noise_states
    horizons = [horizon] if horizon else _horizons(records, lowest, settings)
    new = [h for h in horizons if h not in wanted.spaces]
    if new:
        widths = {h: min(width, settings.max_order(h)) for h in new}
        cheap = wanted.horizon is None
        found = subspaces_of(records, widths, settings, cheap=cheap)
        wanted.spaces.update({h: found.get(h) for h in new})
    spaces = {h: wanted.spaces[h] for h in horizons}
    return {h: space for h, space in spaces.items() if space is not None}


def _weighted(wanted: _Range, whitening: Whitening) -> dict[int, Subspace | None]:
    """The subspaces looked up already, where outputs were weighted and no more."""
    found: dict[int, Subspace | None] = {}
    for horizon, space in wanted.spaces.items() if len(whitening.filter) == 1 else ():
        new = None if space is None else space.weighted(whitening.weight)
        if new is not None or space is None:
            found[horizon] = new
    return found


def _horizons(records: Sequence[Record], order: int, settings: Settings) -> list[int]:
    """Horizons to try: those that show the order and that the data can fill."""
    highest = highest_horizon(records, settings)
    lowest = 2 if highest > 1 else 1
    while lowest < highest and settings.max_order(lowest) < order:
        lowest += 1
    return _horizon_grid(lowest, highest)


def highest_horizon(records: Sequence[Record], settings: Settings) -> int:
    """Highest horizon to try: one that the data fill and that costs little."""
    ny, m = settings.free.direct.shape
    height = 2 * m + (1 if settings.method == "pi-moesp" else 2) * ny
    lengths = [record.n_samples for record in records]
    return min(settings.max_horizon(lengths), max(2, _MAX_ROWS // height))


def _horizon_grid(lowest: int, highest: int) -> list[int]:
    """Horizons to try, in a geometric progression that ends at the highest.

    >>> _horizon_grid(4, 30)
    [4, 8, 15, 30]
    """
    grid = [highest]
    while grid[-1] / _HORIZON_RATIO >= lowest + 0.5:
        grid.append(round(grid[-1] / _HORIZON_RATIO))
    if grid[-1] > lowest:
        grid.append(lowest)
    return sorted(set(grid))


def _wanted(
    records: Sequence[Record],
    order: int | None,
    horizon: int | None,
    settings: Settings,
) -> _Range:
    """The order, or those to try among the ones that are asked for."""
    if order is not None:
        return _Range([order], order, horizon, {}, {})
    horizons = [horizon] if horizon else _horizons(records, 0, settings)
    highest = _highest_order(records, horizons, settings)
    orders: Sequence[int] = range(highest + 1)
    if settings.orders:
        orders = [n for n in settings.orders if n <= highest] or settings.orders[:1]
    pilot = max(orders[0], min(highest, _PILOT_ORDER))
    return _Range(orders, pilot, horizon, {}, {})


def _highest_order(
    records: Sequence[Record], horizons: Sequence[int], settings: Settings
) -> int:
    """Highest order to try: one that leaves enough values for each parameter.

    Beyond `MAX_ORDER` where higher ones are asked for.
    """
    ny, m = settings.free.direct.shape
    n_values = sum(record.y.size for record in records)
    affordable = n_values / _VALUES_PER_PARAMETER - m * ny
    affordable /= m + ny + 1 + _OF_OTHERS * (len(records) - 1)
    by_horizon = max(settings.max_order(h) for h in horizons)
    return int(
        np.clip(affordable, 0, min(max((MAX_ORDER, *settings.orders)), by_horizon))
    )


def _try_orders(
    wanted: _Range,
    records: Sequence[Record],
    whitening: Whitening,
    settings: Settings,
    pilot: Realization | None = None,
) -> list[_Tried]:
    """Every order in turn on whitened records, until further states gain nothing.

    A `pilot` that is better yet, a model of the records themselves, tells that they do.
    """
    orders, free = wanted.orders, settings.free
    limit, n_pilot, least = np.inf, 0, np.inf
    # Least variance of what a model leaves: no start has to leave less.
    n_values, variance = sum(record.n_values for record in records), 0.0

    def left(order: int) -> int:
        return max(n_values - n_parameters(order, records, free), 1)

    if not whitening.is_none:
        records = whitening.records(records, settings.free)
        wanted = wanted._replace(spaces=_weighted(wanted, whitening), starts={})
    if pilot is not None:
        model = with_initial_states(whitening.model(pilot), records, settings.free)
        limit = criterion_of(model, records, settings.free, settings.repeated)
        n_pilot, least = len(model.A), model.loss
        variance = model.loss / left(n_pilot)
    tried: list[_Tried] = []
    best, stale, left_by_best = np.inf, 0, np.inf
    energy = output_energy(records)
    slow_starts = SlowStarts(records, orders[-1], settings)
    further = FurtherStates(records, settings)
    for order in orders:
        enough = _LOSS_SLACK[True] * variance * left(order)
        starts = _starts(wanted, order, records, settings, enough)
        if not starts:
            break
        slow = slow_starts.best(order) if wanted.slow else None
        model = _refined(starts, slow, records, settings)[0]
        is_next = bool(tried) and tried[-1].order == order - 1
        below = tried[-1].candidate.model if is_next else None
        if below is not None and model.loss > _AS_GOOD * below.loss:
            start = further.of_errors(below)
            if start is not None:
                refined = refine_simulation(start, records, free)
                model = min(model, refined, key=_loss)
        if below is not None and further.n_moves < n_parameters(order, records, free):
            # the minimum that subspaces led to may not be the best one
            for start in further.beside(below):
                if start.loss < _NEARLY * model.loss:
                    refined = refine_simulation(start, records, free)
                    model = min(model, refined, key=_loss)
        variance = min(variance, model.loss / left(order))
        criterion = criterion_of(model, records, settings.free, settings.repeated)
        horizon = _best_horizon(starts, refine=True)
        candidate = Candidate(model, horizon, whitening, True)
        errors = _relative_errors(starts, records)
        tried.append(_Tried(order, candidate, criterion, errors))
        stale += 1
        if criterion < best:
            best, stale, left_by_best = criterion, 0, model.loss
        known = best <= limit and left_by_best <= _UNEXPLAINED * least
        known |= order >= n_pilot
        if (known and stale > _PATIENCE) or model.loss <= EXACT * energy:
            break
    return tried


def _refined(
    starts: Mapping[int, Realization],
    slow: Realization | None,
    records: Sequence[Record],
    settings: Settings,
    max_iter: int | None = None,
) -> tuple[Realization, bool]:
    """From the best of the starts of an order, or a slow one where that is no worse.

    And whether the latter was asked.
    """
    start = starts[_best_horizon(starts, refine=True)]
    # Nearly as good ones may end in different minima where noise is most of both.
    rivals = [start] if slow is None else [start, slow]
    worst = min(map(_loss, rivals)) * _LOSS_SLACK[True]
    rivals = [one for one in rivals if one.loss <= worst] or [start]
    refined = [
        refine_simulation(one, records, settings.free, max_iter) for one in rivals
    ]
    return min(refined, key=_loss), rivals[0] is slow


def _starts(
    wanted: _Range,
    order: int,
    records: Sequence[Record],
    settings: Settings,
    enough: float = -np.inf,
) -> dict[int, Realization]:
    """Model of an order, before refinement, from every horizon that can show it.

    Up to the first one whose loss is `enough`.
    """
    starts: dict[int, Realization] = {}
    for horizon, space in _look_up(wanted, wanted.orders[0], records, settings).items():
        if order <= settings.max_order(horizon):
            if order == 0 and starts:  # they are the same without states
                starts[horizon] = next(iter(starts.values()))
                continue
            if (order, horizon) not in wanted.starts:
                found = realize(space, records, order, settings)
                wanted.starts[order, horizon] = found
            starts[horizon] = wanted.starts[order, horizon]
            if starts[horizon].loss <= enough:
                break
    return starts


def _is_cut_short(
    wanted: _Range, records: Sequence[Record], settings: Settings
) -> bool:
    """Whether horizons that the data could fill are left out for what they cost."""
    room = settings.max_horizon([record.n_samples for record in records])
    return highest_horizon(records, settings) < room or None in wanted.spaces.values()


def _best_horizon(starts: Mapping[int, Realization], refine: bool) -> int:
    """Smallest horizon whose loss is near the best."""
    limit = min(model.loss for model in starts.values()) * _LOSS_SLACK[refine]
    return min(h for h, model in starts.items() if model.loss <= limit)
