"""Input delays: inputs as they arrive, and the delays that the records show.

A model with a delay is identified from late inputs, ``u[t - d]`` in the place of
``u[t]``: all other rooms see these only (`with_late_inputs`).

Which delay (`find_delays`)? A regression on past outputs and on inputs from ``u[t]``
back tells how many of the latest inputs can be left out: the delay is not longer. It
may be shorter, as smooth systems begin to answer below the noise. But a model with a
delay that is k samples too short needs k states more, and a delay of one sample more
can stand for a first answer that is a feedthrough then. So models of several orders and
delays, with feedthrough and without, are compared by Schwarz's criterion, in samples
whose noise is whitened. The best one's delay is certain only where a model without
delay has not done as well with a state more (unless the order was given), nor at the
same order on samples held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ...data.experiments import Experiment
from ...data.preparation import (
    DETRENDS,
    Pairs,
    remove_trends,
    split_at_gaps,
    unbroken_runs,
)
from ...systems.simulation import delayed
from ...validation import input_delays
from ..evidence.offsets import N_TRENDS
from ..orders.identification import Settings, fit_once
from ..orders.selection import select
from ..samples.records import FOR_A_CHOICE, Record
from ..simulation_error.noise import (
    Whitening,
    autoregression,
    through_filter,
    whitening_filter,
)
from ..simulation_error.simulation_fit import simulation_errors
from .options import Choices

Array = NDArray[np.float64]

Delay = NDArray[np.intp]

# Samples that a delay is looked for, of each input, and of all of them together where
# it is not found among these.
LONGEST, _MOST_LAGS = 30, 300

# And no longer than a tenth of the longest experiment; than a fifth where nothing is
# certain among these.
_SHARE, _LARGEST_SHARE = 10, 5

# Past outputs and, after the longest delay, inputs in the regression: enough for its
# error to be nearly white, and for the answers of systems of usual orders.
_PAST = 12

_AT_ONCE = 2_000  # samples whose windows are in memory

_CHANCE = 1e-4  # probability by chance of an answer that is certain

# No delay, with a state more, must be worse than several samples of delay by this, in
# twice the logarithm of the likelihood. One sample that state can take the place of:
# there it must gain no more than by chance, and the sample be worth this factor of the
# mean square error.
_WORSE, _BY_CHANCE, _CLEARLY = 6.0, 0.05, 1.05

_STATES = range(-2, 3)  # about the order chosen at the longest delay, that are tried

_SMOOTH = 0.5  # steps of smooth inputs from sample to sample, relative to their size

_GIVEN_UP = 2  # delays in turn without any good model: shorter ones have none either

# Long delays that smooth inputs leave possible are looked at in so many steps first,
# then one by one about the best of these.
_COARSE = 10

_SHORTEST_HORIZON = 8  # of the models compared, which the refinement makes equal

_ROUNDING = 1e-14  # share of an output's energy that is rounding

_LARGEST_RATIO = 1e4  # of an output's size to its noise by which outputs are weighed

_ESTIMATED = 0.7  # part of the samples to estimate on where others are held out


def late_inputs(
    experiment: Experiment, delay: Delay, *, rest: bool, before: Array | None = None
) -> tuple[Experiment, Array]:
    """An experiment with its inputs as they arrive, and the inputs still in transit.

    What arrives in the first samples was sent `before` (the inputs in transit where an
    experiment goes on), or else is unknown: NaN, or zero from `rest`.
    """
    sent, longest = experiment.inputs, int(delay.max())
    if before is None:
        before = np.full((longest, sent.shape[1]), 0.0 if rest else np.nan)
    sent, n_samples = np.vstack([before, sent]), len(sent)
    late = [
        column[longest - d : longest - d + n_samples]
        for column, d in zip(sent.T, delay, strict=True)
    ]
    return replace(experiment, inputs=np.column_stack(late)), sent[n_samples:]


def with_late_inputs(
    experiments: Sequence[Experiment],
    delay: Delay,
    *,
    rest: bool,
    gaps: bool,
    at_mean: bool = False,
) -> list[Experiment]:
    """Experiments with inputs as they arrive, cut at gaps where there may be some.

    With `rest` the inputs before are zero, or `at_mean`, where that is to be removed.
    Without `rest` the first samples, to which unknown inputs arrive, are left out. A
    ValueError where that leaves no two samples of any experiment.
    """
    if not delay.any():
        return split_at_gaps(experiments) if gaps else list(experiments)
    longest = max(len(e.rows) for e in experiments)
    if longest < delay.max() + 2 and (gaps or not rest):
        raise ValueError(
            f"`input_delay` of {delay.max()} samples needs an experiment of at least "
            f"{delay.max() + 2} samples: what arrives before is not known. Got "
            f"{longest}. initial_state='rest' takes it as zero."
        )
    delay = np.minimum(delay, longest)  # nothing arrives later than at the end
    late = []
    for e in experiments:
        first, *others = unbroken_runs(e)
        mean = np.tile(first.inputs.mean(axis=0), (delay.max(), 1))
        before = mean if rest and at_mean else None
        late.append(late_inputs(first, delay, rest=rest, before=before)[0])
        late += [late_inputs(run, delay, rest=False)[0] for run in others]
    return late if rest and not gaps else split_at_gaps(late)


def delays_of(
    experiments: Sequence[Experiment],
    input_delay: Any,
    choices: Choices,
    *,
    detrend: str | None,
    gaps: bool,
) -> Delay:
    """Delay of every input, in samples: as given by an option, or found for "auto".

    With `gaps` experiments may have some.
    """
    n_inputs = experiments[0].inputs.shape[1]
    if not isinstance(input_delay, str):
        return input_delays(input_delay, n_inputs, samples=True)
    if input_delay != "auto":
        raise ValueError(
            "`input_delay` must be 'auto' or whole numbers of samples. Got "
            f"{input_delay!r}."
        )
    if gaps:
        experiments = split_at_gaps(experiments)
    pairs = [(e.inputs, e.measured) for e in experiments]
    pairs = remove_trends(pairs, detrend)[0]
    n_outputs = pairs[0][1].shape[1]
    if choices.method in ("auto", "pbsid"):  # a loop leaves delays where they are
        choices = choices._replace(method="po-moesp")
    # A constant more than there is costs little, one less is taken for a mode.
    n_trend = 1 if choices.offset == "auto" else N_TRENDS[choices.offset]
    settings = choices.settings(n_outputs, n_inputs, np.eye(n_inputs), n_trend)
    return find_delays(pairs, settings, choices.order, choices.horizon)


def find_delays(
    pairs: Pairs, settings: Settings, order: int | None, horizon: int | None
) -> Delay:
    """Delay of every input, in samples, as far as it is certain; else 0.

    `order` and `horizon` as of `select`. Experiments have the trends of `settings`,
    whose removal here leaves little for the models to tell.
    """
    pairs = remove_trends(first_samples(pairs), DETRENDS[settings.free.n_trend])[0]
    delay = longest_delays(pairs, np.any(settings.free.direct, axis=0))
    if not delay.any():
        return delay
    lengths = [len(u) - int(delay.max()) for u, _ in pairs]
    settings.check_size(lengths, order, horizon)
    settings = settings._replace(
        free=settings.free._replace(initial_states=True),
        refine=True,
        enforce_stability=False,
    )
    plain = settings._replace(weigh=False, compare=False)
    trial = _Trial.of(pairs, plain, int(delay.max()), horizon or 1)
    orders = [] if order is None else [order]
    if order is None or horizon is None:
        chosen = select(trial.records(delay), order, horizon, settings)
        if order is None and are_foretold(pairs, delay > 0):
            undelayed = trial.records(np.zeros_like(delay))
            other = select(undelayed, order, horizon, settings)
            chosen = min(chosen, other, key=lambda selected: selected.order)
        trial = replace(trial, horizon=chosen.horizon)
        about = [chosen.order + more for more in _STATES if chosen.order + more >= 0]
        orders = orders or about
    trial = trial.whitened(delay, orders[-1])
    for j in np.flatnonzero(delay):
        delay[j] = trial.delay_of(int(j), delay, orders, given=order is not None)
    return delay


def are_foretold(pairs: Pairs, of: NDArray[np.bool_]) -> bool:
    """Whether some of the inputs are smooth, so that early ones tell the later ones.

    The longest delay may be much too long then, and states stand for what it lacks.
    """
    steps = np.sum([(np.diff(u, axis=0) ** 2).sum(axis=0) for u, _ in pairs], axis=0)
    sizes = np.sum([(u**2).sum(axis=0) for u, _ in pairs], axis=0)
    return bool((steps < _SMOOTH**2 * sizes)[of].any())


def longest_delays(pairs: Pairs, direct: NDArray[np.bool_]) -> Delay:
    """Samples after which every input certainly shows in an output; else 0.

    Those that are `direct` (n_inputs,) act through D, others a sample later. They are
    looked for over more lags where there are none, and no delay is longer.
    """
    n_samples = max(len(u) for u, _ in pairs)
    longest = min(LONGEST, n_samples // _SHARE)
    answers = first_answers(pairs, longest)
    most = max(longest, _MOST_LAGS // len(answers))
    most = min(n_samples // _LARGEST_SHARE, most)
    while (answers < 0).any() and longest < most:
        longest = min(2 * longest + 1, most)
        answers = np.where(answers < 0, first_answers(pairs, longest), answers)
    return np.where(answers < 0, 0, np.maximum(answers - ~direct, 0))


def first_samples(pairs: Pairs) -> Pairs:
    """The first experiments, some thousand samples of them."""
    out, left = [], FOR_A_CHOICE
    for u, y in pairs:
        if left > 0:
            out.append((u[:left], y[:left]))
            left -= len(u)
    return out


def first_answers(pairs: Pairs, longest: int) -> Delay:
    """Latest input that certainly shows in an output, counted back from the present.

    For every input 0 to `longest`, or -1 where none of these is certain.

    >>> u, e = np.random.default_rng(0).standard_normal((2, 500, 1))
    >>> first_answers([(u[3:], u[:-3] + 0.1 * e[3:])], 10)
    array([3])
    """
    m, ny = pairs[0][0].shape[1], pairs[0][1].shape[1]
    n_samples = sum(len(u) for u, _ in pairs)
    # No more unknowns than a quarter of the samples
    past = int(np.clip((n_samples / 4 - m * longest) / (m + ny), 1, _PAST))
    span = longest + past
    found = np.full(m, -1)
    columns = 1 + past * ny + m * (span + 1)
    R, n_rows = np.zeros((0, columns + ny)), 0
    starts = [
        (k, at)
        for k, (u, _) in enumerate(pairs)
        for at in range(0, len(u) - span, _AT_ONCE)
    ]
    waiting: list[Array] = []
    for k, at in starts:
        u, y = (z[at : at + _AT_ONCE + span] for z in pairs[k])
        waiting.append(_windows(u, y, span, past))
        n_rows += len(waiting[-1])
        if sum(map(len, waiting)) >= _AT_ONCE or (k, at) == starts[-1]:
            R = np.asarray(np.linalg.qr(np.vstack([R, *waiting]), mode="r"))
            waiting = []
    error = n_rows - columns
    if error < 1:
        return found
    squares = (R[:, columns:] ** 2).sum(axis=0)
    least = _ROUNDING * squares + np.finfo(float).tiny
    own = np.arange(span + 1)
    for j in range(m):
        # the input last, and its present last of it
        at = columns - (m - j) * (span + 1) + own
        order = np.r_[np.setdiff1d(np.arange(columns), at), at, columns : columns + ny]
        T = np.asarray(np.linalg.qr(R[:, order], mode="r"))
        explained = T[columns - longest - 1 : columns, columns:][::-1] ** 2
        left = (T[columns:, columns:] ** 2).sum(axis=0)
        left = np.maximum(left, least) / error
        count = np.arange(1, longest + 2)[:, None]
        F = np.cumsum(explained, axis=0) / count / left
        certain = (special.fdtrc(count, error, F) < _CHANCE / (longest + 1)).any(axis=1)
        if certain.any():
            found[j] = np.argmax(certain)
    return found


def _windows(u: Array, y: Array, span: int, past: int) -> Array:
    """One, past outputs, inputs by channel with the present last, and outputs."""
    window = np.lib.stride_tricks.sliding_window_view
    n = len(u) - span
    inputs = window(u, span + 1, axis=0).reshape(n, -1)
    earlier = window(y[span - past : -1], past, axis=0).reshape(n, -1)
    return np.hstack([np.ones((n, 1)), earlier, inputs, y[span:]])


def find_lead(pairs: Pairs) -> tuple[int, int]:
    """By how many samples the outputs may lead an input, and which one; 0 for none.

    The latest input that certainly shows in an output, where some are still to come.
    """
    pairs = first_samples(pairs)
    most = min(LONGEST, max(len(u) for u, _ in pairs) // _SHARE)
    answers = first_answers(with_later_inputs(pairs, most), most)
    leads = np.where(answers < 0, 0, most - answers)
    return int(leads.max()), int(leads.argmax())


def with_later_inputs(pairs: Pairs, lead: int) -> Pairs:
    """Outputs beside the inputs that come `lead` samples after them.

    >>> u = np.arange(5.0)[:, None]
    >>> with_later_inputs([(u, u)], 2)[0][0].ravel()
    array([2., 3., 4.])
    """
    return [(u[lead:], y[: len(y) - lead]) for u, y in pairs if len(u) > lead + 1]


class _Size(NamedTuple):
    """How many parameters a model has: sizes are in their order."""

    order: int
    direct: bool  # whether the input whose delay is looked for acts at once


class _Best(NamedTuple):
    """The lowest criterion so far, of which model and delay."""

    cost: float
    size: _Size
    delay: int


@dataclass(frozen=True)
class _Trial:
    """Samples to try delays on; from row `longest` on all inputs are known."""

    pairs: Pairs
    settings: Settings
    longest: int
    horizon: int  # of the models compared, at least
    known: dict[tuple[int, ...], float] = field(default_factory=dict)  # losses

    @classmethod
    def of(
        cls,
        pairs: Pairs,
        settings: Settings,
        longest: int,
        horizon: int,
        noise: Array | float = np.inf,
    ) -> _Trial:
        """The trial of inputs of unit size, and outputs in units of their noise.

        Where that is not known, or very small, their own size counts.
        """
        unit = [
            np.sqrt(np.mean(np.vstack([pair[k] for pair in pairs]) ** 2, axis=0))
            for k in (0, 1)
        ]
        su, sy = (np.where(size > 0.0, size, 1.0) for size in unit)
        sy = np.where(np.isfinite(noise), np.maximum(noise, sy / _LARGEST_RATIO), sy)
        # the largest output has unit size
        sy = sy * max(float((unit[1] / sy).max()), np.finfo(float).tiny)
        kept = [(u / su, y / sy) for u, y in pairs if len(u) > longest + 1]
        return cls(kept, settings, longest, horizon)

    def records(self, delay: Delay) -> list[Record]:
        cut, n_trend = slice(self.longest, None), self.settings.free.n_trend
        late = [(delayed(u, delay)[cut], y[cut]) for u, y in self.pairs]
        return [Record.of(u, y, n_trend) for u, y in late]

    def errors(
        self, delay: Delay, size: _Size, j: int, part: float = 1.0
    ) -> list[Array]:
        """Simulation errors of a model of these; with `part` those of the rest."""
        order, direct = size
        settings = self.settings
        if not direct:
            mask = settings.free.direct.copy()
            mask[:, j] = False
            settings = settings._replace(free=settings.free._replace(direct=mask))
        records = self.records(delay)
        cuts = [int(np.ceil(part * r.n_samples)) for r in records]
        heads = [r.head(cut) for r, cut in zip(records, cuts, strict=True)]
        horizon = max(self.horizon, _SHORTEST_HORIZON, 2 * (order + 1))
        horizon = min(horizon, self.settings.max_horizon(cuts))
        if self.settings.max_order(horizon) < order:
            return [np.full_like(r.y.T, np.inf) for r in records]
        # Along the valleys of smooth inputs, steps without an end tell no delays apart.
        none = Whitening.none(len(heads[0].y))
        model = fit_once(heads, order, horizon, settings, none, patient=False).model
        if part == 1.0:
            cuts = [0] * len(cuts)
        errors = simulation_errors(model, records)
        return [e[cut:] for e, cut in zip(errors, cuts, strict=True)]

    def loss(self, delay: Delay, size: _Size, j: int) -> float:
        """Mean square of the simulation errors; at least that of rounding.

        Without D of input j, unless that is `direct`: then it is one for all of them.
        """
        key = (*delay.tolist(), *size, -1 if size.direct else j)
        if key not in self.known:
            mean = float(np.mean(np.concatenate(self.errors(delay, size, j)) ** 2))
            self.known[key] = (mean if np.isfinite(mean) else np.inf) + _ROUNDING
        return self.known[key]

    def whitened(self, delay: Delay, order: int) -> _Trial:
        """The trial of samples filtered alike, so that noise becomes nearly white.

        One filter for all inputs and outputs leaves the system as it is. Of samples
        too few for the order nothing is known of the noise.
        """
        errors = self.errors(delay, _Size(order, True), 0)
        size = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
        if not np.isfinite(size).all():
            return self
        size[size == 0.0] = 1.0
        channels = [e[:, [i]] / size[i] for e in errors for i in range(len(size))]
        a = whitening_filter(autoregression(channels))
        white = [(through_filter(a, u), through_filter(a, y)) for u, y in self.pairs]
        return self.of(white, self.settings, self.longest, self.horizon, size)

    def delay_of(
        self, j: int, longest: Delay, orders: Sequence[int], *, given: bool
    ) -> int:
        """Delay of one input, up to the `longest`; those of the others stay.

        An order that is `given` is not raised to do without a delay.
        """

        def at(d: int) -> Delay:
            return np.where(np.arange(len(longest)) == j, d, longest)

        m, ny = self.pairs[0][0].shape[1], self.pairs[0][1].shape[1]
        may_be_direct = bool(self.settings.free.direct[:, j].any())
        families = [
            [_Size(n, direct) for n in sorted(orders, reverse=True)]
            for direct in (False, True)[: 1 + may_be_direct]
        ]

        def n_parameters(size: _Size) -> int:
            return size.order * (m + ny) + size.direct * ny

        def price(size: _Size) -> float:  # Schwarz's criterion
            return float(np.log(self.n_values)) * n_parameters(size)

        def with_delay(d: int, best: _Best) -> tuple[_Best, bool]:
            """The best so far, and whether a model of that delay is good."""
            good = False
            for sizes in families:
                for size in sizes:
                    misfit = self.n_values * np.log(self.loss(at(d), size, j))
                    if misfit + price(size) < best.cost:
                        best = _Best(misfit + price(size), size, d)
                    if misfit + price(sizes[-1]) > best.cost:
                        break  # smaller models fit no better
                    good = True
            return best, good

        def best_of(delays: range, best: _Best) -> _Best:
            in_vain = 0
            for d in delays:
                best, good = with_delay(d, best)
                in_vain = 0 if good else in_vain + 1
                if in_vain == _GIVEN_UP:
                    break
            return best

        most = int(longest[j])
        step = max(1, most // _COARSE)
        best = best_of(range(most, -1, -step), _Best(np.inf, families[0][0], 0))
        if step > 1:
            near = best.delay
            best = best_of(range(min(near + step - 1, most), near, -1), best)
            best = best_of(range(near - 1, max(near - step, -1), -1), best)
        _, size, d = best
        if d == 0:
            return 0
        loss = self.loss(at(d), size, j)
        same, more = (_Size(size.order + k, may_be_direct) for k in (0, not given))
        gain = self._evidence(loss, self.loss(at(0), more, j))
        certain = gain < -_WORSE
        if d == 1:
            dof = n_parameters(more) - n_parameters(size)
            certain = gain < (special.chdtri(dof, _BY_CHANCE) if dof else -_WORSE)
            certain &= self.loss(at(0), same, j) > _CLEARLY * loss
        if not certain:
            return 0
        late, present = (
            np.sum(np.concatenate(self.errors(at(one), same, j, _ESTIMATED)) ** 2)
            for one in (d, 0)
        )
        return 0 if late > present else d

    @property
    def n_values(self) -> int:
        return sum(y[self.longest :].size for _, y in self.pairs)

    def _evidence(self, loss: float, best: float) -> float:
        """Twice the logarithm of the ratio of two likelihoods."""
        return self.n_values * float(np.log(loss) - np.log(best))
