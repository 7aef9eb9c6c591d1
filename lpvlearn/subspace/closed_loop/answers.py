r"""Inputs that follow exactly from the outputs: a controller's, and nothing else's.

Where no reference moves a loop, every sample fulfils the law of the controller,

.. math:: c(q) u_t = d(q) y_t + \mathrm{constant},

but for rounding. A plant that explains outputs by such inputs is that law, inverted,
with D where the controller answers within the sample: it leaves nothing unexplained,
whatever the true plant is (Gustavsson, Ljung and Soderstrom, 1977).

In open loop without noise an input has something new in every sample, which outputs
tell only if D is not zero. Then ``u = P^(-1) y`` is exact as well, and no second moment
tells which came first. What tells are laws that controllers have and plants with D
hardly: u is y times a constant, or c has a root at one, of an integrator, where the
plant would pass on what is fast and nothing of what stays. Nor does a controller make
inputs that are white, of a few levels, or held: those were designed.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...data.preparation import Pairs
from ...systems.least_squares import scaled_lstsq
from ...validation import SQUARED
from ..evidence.constants import CERTAIN
from ..evidence.rounding import Rounding
from ..samples.records import Record
from ..telling import Telling

Array = NDArray[np.float64]

_ENOUGH = 4_000  # samples that are looked at

_LONGEST, _PAST = 4, 20  # lags of a law; and of an input that tells itself

_PER_REGRESSOR = 5  # samples, at least

# Root mean square of what a law leaves, relative to the input, that is rounding of the
# numbers; or times that of the steps they are rounded to. Part of what the past of an
# input leaves of it, beyond which outputs are not all that makes it.
_EXACT, _STEPS, _OF_NEW = 1e-6, 2.0, 0.2

_DECIMALS, _NEAR = 9, 1e-3  # places of numbers that are rounded; of a step, how nearly

# A designed input: values it has at most, share of samples that repeat the one before;
# and of what its past foresees, beyond so many standard deviations of what chance does
_LEVELS, _HELD = 16, 0.5
_FORESEEN, _BY_CHANCE = 0.02, 4.0


class _Windows(NamedTuple):
    """A column for every sample with as long a past, less means of the experiments."""

    inputs: Array  # (lags + 1, n_inputs, n_windows), newest first
    outputs: Array  # (lags + 1, n_outputs, n_windows)

    @classmethod
    def of(cls, pairs: Pairs, lags: int) -> _Windows:
        parts = []
        for pair in pairs:
            z = np.hstack(pair)
            if len(z) > lags:
                rows = np.stack([z[lags - k : len(z) - k].T for k in range(lags + 1)])
                parts.append(rows - rows.mean(axis=2, keepdims=True))
        m, stacked = pairs[0][0].shape[1], np.concatenate(parts, axis=2)
        return cls(stacked[:, :m], stacked[:, m:])


def answering_input(pairs: Pairs) -> int | None:
    """The first input that is a controller's answer to the outputs, or None.

    >>> y = np.random.default_rng(0).standard_normal((500, 1)).cumsum(axis=0) * 0.1
    >>> y -= 0.9 * np.vstack([y[:1], y[:-1]])
    >>> u = -2.0 * y - 0.1 * y.cumsum(axis=0)
    >>> answering_input([(u, y)]), answering_input([(y, u)])
    (0, None)
    """
    some, left = [], _ENOUGH
    for u, y in pairs:
        some.append((u[:left], y[:left]))
        left -= len(some[-1][0])
        if left <= 0:
            break
    n_inputs = some[0][0].shape[1]
    if sum(max(0, len(u) - _PAST) for u, _ in some) < _PER_REGRESSOR * _PAST * n_inputs:
        return None
    free = [k for k in range(n_inputs) if not _is_designed(some, k)]
    if not free:
        return None
    own, predictable = _Windows.of(some, _PAST), {}
    for k in free:
        past = own.inputs[1:].reshape(-1, own.inputs.shape[2])
        spare = past.shape[1] - len(past)
        new = _left(own.inputs[0, k], past) * float(np.sqrt(past.shape[1] / spare))
        size = float(np.std(own.inputs[0, k]))
        by_chance = _BY_CHANCE * np.sqrt(2.0 * len(past)) / spare
        foreseen = 1.0 - (new / size) ** 2 > _FORESEEN + by_chance if size else False
        if foreseen and new > _EXACT * size:
            predictable[k] = new
    if not predictable:
        return None
    windows = _Windows.of(some, _LONGEST)
    u_steps, y_steps = (_steps(list(z)) for z in zip(*some, strict=True))
    answers = (
        k
        for k, new in predictable.items()
        if _is_answer(windows, k, new, u_steps[k], y_steps)
    )
    return next(answers, None)


def tell_of_answering_input(pairs: Pairs, telling: Telling) -> bool:
    """Tell of an input that a controller makes of the outputs alone; whether."""
    found = answering_input(pairs)
    if found is None:
        return False
    telling.once(
        "feedback",
        f"Input {telling.input(found)} follows from present and past outputs, exactly "
        "or to the rounding of the numbers, as a controller makes it whose reference "
        "does not move. Such samples do not tell the plant, and the model is likely "
        "that of the controller, inverted, or arbitrary. Give a record in which the "
        "reference moves, or in which random steps or noise are added to this input. "
        "Only if nothing makes it of the outputs, as in a record without noise, "
        "nothing is wrong.",
    )
    return True


def _left(row: Array, rows: Array) -> float:
    """Root mean square that rows leave of another."""
    errors = row - scaled_lstsq(rows.T, row[:, None], _EXACT**2)[0].T @ rows
    return float(np.sqrt(np.mean(errors**2)))


def _steps(signals: list[Array]) -> list[float]:
    """A twelfth of the steps that channels are rounded to, squared; else zeros.

    Of few values these tell the step, of many that they are decimals, or numbers of
    single precision.
    """
    records = [Record.of(signal, signal) for signal in signals]
    found = []
    for k, variance in enumerate(Rounding.of(records).variances):
        values = [signal[:, k] for signal in signals]
        moves = np.concatenate([np.diff(v) for v in values])
        largest = max(float(np.abs(v).max()) for v in values)
        step = 0.0
        least = largest * np.finfo(float).eps / _NEAR
        for decimal in 10.0 ** -np.arange(_DECIMALS):
            multiples = np.abs(moves / decimal)
            near = np.abs(multiples - np.round(multiples)).max() < _NEAR
            if near and multiples.max() > 0.5 and decimal > least:
                step = decimal
                break
        single = all((v == v.astype(np.float32)).all() for v in values)
        if single and not step:
            step = float(np.spacing(np.float32(largest)))
        found.append(float(variance) or step**2 / 12.0)
    return found


def _is_designed(pairs: Pairs, k: int) -> bool:
    """Whether an input has few levels, or is held."""
    values = [u[:, k] for u, _ in pairs]
    held = np.mean(np.concatenate([np.diff(v) == 0.0 for v in values]))
    return bool(held > _HELD) or len(np.unique(np.concatenate(values))) <= _LEVELS


def _is_answer(
    windows: _Windows, k: int, new: float, own_step: float, steps: list[float]
) -> bool:
    """Whether a law of a controller makes an input of one of the outputs.

    That of an integrator is a law of differences of the input. So is every other, once
    those of the output are taken as well: an integrator needs the output itself.
    """
    u = windows.inputs[:, k]
    floor = _EXACT * float(np.std(u[0]))
    changes = -np.diff(u, axis=0)
    for i, first in product(range(windows.outputs.shape[1]), (0, 1)):
        size = max(float(np.abs(windows.outputs[:, i]).max()), 1.0 / SQUARED)
        unit = np.exp2(np.frexp(size)[1] - 1)
        y = windows.outputs[first:, i] / unit
        sizes = own_step, steps[i] / unit / unit
        for lags in range(_LONGEST):
            row = changes[:lags] if lags else u[:1]
            left, rounding = _law(row, y[: lags + 1], *sizes, changes=lags > 0)
            if left > min(floor + _STEPS * rounding, _OF_NEW * new):
                continue
            if not lags:
                return True
            other, _ = _law(changes[:lags], -np.diff(y[: lags + 1], axis=0), *sizes)
            gain = np.log(max(other, floor) / max(left, floor))
            if 2.0 * u.shape[1] * gain > CERTAIN:
                return True
    return False


def _law(
    u: Array,
    y: Array,
    u_step: float,
    y_step: float,
    changes: bool = False,
) -> tuple[float, float]:
    """Root mean square of what a law leaves of an input, and of what rounding does.

    The rows are those of the last samples, newest first, of the input or of its
    `changes`, and of the output; of either a rounding step is given, squared.
    """
    known = np.vstack([u[1:], y])
    found = scaled_lstsq(known.T, u[0][:, None], _EXACT**2)[0][:, 0]
    left = float(np.sqrt(np.mean((u[0] - found @ known) ** 2)))
    c, d = np.append(1.0, -found[: len(u) - 1]), found[len(u) - 1 :]
    if changes:
        c = np.convolve(c, [1.0, -1.0])
    return left, float(np.sqrt(u_step * (c @ c) + y_step * (d @ d)))
