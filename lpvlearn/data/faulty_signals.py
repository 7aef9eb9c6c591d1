"""What sensors and loggers do to a signal, and no linear system does.

They hold its values or draw lines between them, repeat the last one, turn an angle back
by a revolution, stay at a limit, drop out, or have single samples far from all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A signal is held for so many samples where this share of so many intervals between its
# changes are multiples of them; longer ones than the last are not looked for.
_HELD, _ENOUGH_CHANGES, _LONGEST_HELD = 0.95, 20, 1000

# A signal may be at a limit that stays for so many samples at an extreme value, this
# many times longer than at any other; this share of it is at others. One that changes
# in this share of its samples does not stay anywhere by itself.
_STAYS, _LONGER, _OTHERS, _CHANGES = 10, 3, 0.1, 0.5

# It drops out where it jumps to a value and back by so many times what this share of
# its steps are, and comes back as near as this share of the jump; and does so in less
# than this share of its samples. Not if so many of the jumps are moves of the inputs.
_APART, _MOST, _BACK, _SELDOM, _FOLLOWED = 4.0, 0.95, 0.5, 0.1, 0.7

# A value stands apart that is farther from all others than so many times their range,
# of which there are so many; one that loggers write, below others that are positive, if
# it is that part of the range away. In less than `_SELDOM` of the samples, or, of
# one that loggers write, in less than half.
_RANGES, _VALUES, _BELOW = 3.0, 10, 0.1

# What loggers write where nothing was measured: nines, limits of integers, and others
_CODES = {32767.0, 32768.0, 65535.0, 2147483647.0, 2147483648.0, 7777.0, 8888.0}
_HUGE_CODE, _NINES = 1e19, 2  # no measured value; digits, at least

# A sample stands out that is this many times as far from the median as this share of
# others are, of so many at least.
_FAR, _USUAL, _FAR_OF = 5.0, 0.95, 50

# It is drawn by lines where this share of its second differences are zero next to their
# largest; and lines are as long as the usual one, but for the rest of them.
_STRAIGHT, _LONGEST_LINE, _ZERO = 0.4, 100, 1e-9

# It repeats itself in bursts of so many samples, so many of them, that take no more
# than this share of all; other values come again in no more than this share. This share
# of the bursts begins with steps that are those of no rest, of this part of the usual
# one at least; and half of them end with steps of this part, as after play they do not.
_BURST, _BURSTS, _MOSTLY_NEW, _TWICE, _IN_MOTION = 3, 3, 0.5, 0.01, 0.7
_BEFORE, _AFTER = 0.05, 0.75

# It is wrapped where it steps by this share of its range, so many times, no other step
# is larger than this one, and that of its samples are neither near the top nor bottom.
# Or so many times, of a range that is this part of a revolution at least.
_REVOLUTION, _REVOLUTIONS, _OTHER_STEPS, _BETWEEN = 0.8, 3, 0.3, 0.3
_ABOUT_NORTH, _WHOLE, _ROUNDED, _ALIKE = 2, 0.9, 1e-3, 2.0


def far_out(signals: Array) -> NDArray[np.bool_]:
    """Single samples (n_samples, n_signals) far from all others and from neighbours.

    >>> u = np.tile([1.0, -1.0, 0.5, 0.0], 25)[:, None]
    >>> u[40] = 30.0
    >>> np.flatnonzero(far_out(u))
    array([40])
    """
    far = np.zeros(signals.shape, dtype=bool)
    if len(signals) < _FAR_OF:
        return far
    middle = np.median(signals, axis=0)
    usual = np.quantile(np.abs(signals - middle), _USUAL, axis=0)
    at = (np.abs(signals - middle) > _FAR * usual) & (usual > 0.0)
    far[1:-1] = at[1:-1] & ~at[:-2] & ~at[2:]
    return far


def stands_apart(signal: Array) -> float | None:
    """A seldom value of a signal (n_samples,) that is far from all others; else None.

    >>> stands_apart(np.append(np.arange(99.0), -9999.0))
    -9999.0
    """
    for value in (signal.min(), signal.max()):
        others = signal[signal != value]
        known = is_code(value)
        if len(others) <= (0.5 if known else 1.0 - _SELDOM) * len(signal):
            continue
        low, width = others.min(), np.ptp(others)
        gap = max(low - value, value - others.max())
        far = gap > _RANGES * width
        far |= known and value < 0.0 <= low and gap > _BELOW * width
        if far and len(np.unique(others)) > _VALUES:
            return float(value)
    return None


def is_code(value: float) -> bool:
    """Whether loggers write a number where nothing was measured.

    >>> [is_code(x) for x in (-9999.0, 99.9, 32767.0, 1e20, 9.0, 1000.0)]
    [True, True, True, True, False, False]
    """
    digits = f"{abs(value):.10g}".replace(".", "")
    nines = len(digits) >= _NINES and set(digits) == {"9"}
    return nines or abs(value) in _CODES or abs(value) > _HUGE_CODE


def held_for(signals: Sequence[Array]) -> int:
    """Samples for which a signal, (n_samples,) per experiment, is held: 1 if it is not.

    >>> held_for([np.repeat(np.arange(30.0), 3)])
    3
    """
    changes = [np.flatnonzero(np.diff(signal)) for signal in signals]
    gaps = np.concatenate([np.diff(at) for at in changes])
    # Were half of the gaps 2 or more, they would not fit into the samples.
    if len(gaps) < _ENOUGH_CHANGES or 1.5 * len(gaps) > sum(map(len, signals)):
        return 1
    longest = min(int(np.median(gaps)), _LONGEST_HELD)
    return next(k for k in range(longest, 0, -1) if np.mean(gaps % k == 0) >= _HELD)


def _edges(signal: Array) -> NDArray[np.intp]:
    """Where its runs of equal values begin, and the end."""
    return np.concatenate([[0], np.flatnonzero(np.diff(signal)) + 1, [len(signal)]])


def stays_put(signals: Sequence[Array]) -> list[list[tuple[int, int]]]:
    """Where a signal stays at its largest or smallest value, as at a limit.

    Start and stop by experiment, of signals (n_samples,). Elsewhere it must be, too,
    and not stay for as long: signals of two values, and coarse ones, are at no limit.
    Of one that changes all the time else, as sensors of many digits do, any value.

    >>> t = np.linspace(0.0, 20.0, 200)
    >>> stays_put([np.clip(np.sin(t), -1.0, 0.8)])
    [[(10, 23), (72, 85), (135, 148)]]
    """
    edges = [_edges(y) for y in signals]
    value = np.concatenate([y[k[:-1]] for y, k in zip(signals, edges, strict=True)])
    length = np.concatenate([np.diff(k) for k in edges])
    low, high = value.min(), value.max()
    others = length[(low < value) & (value < high)]
    if others.sum() < _OTHERS * length.sum():
        return [[] for _ in signals]
    changes = np.count_nonzero(length == 1) > _CHANGES * length.sum()
    longest = 1 if changes else others.max(initial=1)
    least = max(_STAYS, _LONGER * longest + 1)
    parts = []
    for y, k in zip(signals, edges, strict=True):
        long = np.diff(k) >= least
        if not changes:
            long &= (y[k[:-1]] == low) | (y[k[:-1]] == high)
        start, stop = k[:-1][long].tolist(), k[1:][long].tolist()
        parts.append(list(zip(start, stop, strict=True)))
    return parts


class DroppedOut(NamedTuple):
    """Where a signal falls to one value, and is back where it was."""

    value: float
    runs: list[tuple[int, int, int]]  # experiment, start and stop


def drops_out(
    signals: Sequence[Array], inputs: Sequence[Array] | None = None
) -> DroppedOut | None:
    """Runs in which a sensor of many digits reads one value, far from its neighbours.

    Of signals (n_samples,), by experiment; None where there are no two such samples, or
    they follow `inputs` (n_samples, n_inputs) that seldom move.

    >>> y = 5.0 + np.sin(np.linspace(0.0, 20.0, 200))
    >>> y[50:53] = y[120:121] = 0.0
    >>> drops_out([y])
    DroppedOut(value=0.0, runs=[(0, 50, 53), (0, 120, 121)])
    """
    known = [y[np.isfinite(y)] for y in signals]
    steps = np.abs(np.concatenate([np.diff(y) for y in known]))
    if not np.count_nonzero(steps) > _CHANGES * len(steps):
        return None
    large = np.count_nonzero(_APART * steps >= steps.max())
    if large > (1.0 - _MOST) * len(steps) + 2:  # the usual case
        return None
    least = _APART * np.quantile(steps, _MOST)
    found: dict[float, list[tuple[int, int, int]]] = {}
    for e, y in enumerate(signals):
        k = _edges(y)
        start, stop = k[1:-2], k[2:-1]  # but for the first run and the last
        value, before, after = y[start], y[start - 1], y[stop]
        jump = np.minimum(np.abs(value - before), np.abs(value - after))
        falls = (jump > least) & (np.abs(after - before) < _BACK * jump)
        for v, *run in zip(
            *(column[falls].tolist() for column in (value, start, stop)), strict=True
        ):
            found.setdefault(v, []).append((e, *run))
    if not found:
        return None
    common, runs = max(found.items(), key=lambda item: len(item[1]))
    n = sum(stop - start for _, start, stop in runs)
    few = n < _SELDOM * sum(map(len, signals))
    if inputs is not None:
        moves = [np.any(np.diff(u, axis=0, prepend=u[:1]) != 0, axis=1) for u in inputs]
        followed = np.mean([moves[e][start] for e, start, _ in runs])
        few &= not followed > _FOLLOWED or np.mean(np.concatenate(moves)) > followed / 2
    return DroppedOut(common, runs) if few and n > 1 else None


def line_length(signals: Sequence[Array]) -> int:
    """Samples for which a signal runs along straight lines: 1 if it does not.

    Of signals (n_samples,) by experiment.

    >>> y = np.random.default_rng(0).standard_normal(31)
    >>> line_length([np.interp(np.arange(121), np.arange(0, 121, 4), y)])
    4
    """
    bends = [np.abs(np.diff(y, 2)) for y in signals]
    largest = max((b.max(initial=0.0) for b in bends), default=0.0)
    runs = [np.abs(np.diff(y)[1:]) > _ZERO * largest for y in signals]
    corners = [np.flatnonzero(b > _ZERO * largest) for b in bends]
    n_straight = sum(
        np.count_nonzero(moves & (b <= _ZERO * largest))
        for moves, b in zip(runs, bends, strict=True)
    )
    gaps = np.concatenate([np.diff(at) for at in corners])
    if len(gaps) < _ENOUGH_CHANGES or n_straight < _STRAIGHT * sum(map(len, bends)):
        return 1
    length = int(np.median(gaps))
    alike = 1 < length <= _LONGEST_LINE and np.mean(gaps % length == 0) >= _HELD
    return length if alike else 1


def repeated_in_bursts(signals: Sequence[Array]) -> list[tuple[int, int, int]]:
    """Bursts in which a logger has repeated the last value: experiment, start, stop.

    Of signals (n_samples,) of many digits, which are at rest nowhere else.

    >>> y = np.random.default_rng(0).standard_normal(300)
    >>> for k in (40, 90, 200):
    ...     y[k : k + 4] = y[k]
    >>> repeated_in_bursts([y])
    [(0, 41, 44), (0, 91, 94), (0, 201, 204)]
    """
    found: list[tuple[int, int, int]] = []
    in_motion = caught_up = n_new = n_twice = 0
    steps = np.abs(np.concatenate([np.diff(y) for y in signals]))
    if steps.all():  # the usual case
        return []
    usual = np.median(steps[steps > 0.0]) if steps.any() else 0.0
    for e, y in enumerate(signals):
        k = _edges(y)
        start, stop = k[:-1], k[1:]
        long = (stop - start >= _BURST) & (start > 0) & (stop < len(y))
        a, b = start[long], stop[long]
        found += [(e, *run) for run in zip((a + 1).tolist(), b.tolist(), strict=True)]
        in_motion += int(np.sum(np.abs(y[a] - y[a - 1]) > _BEFORE * usual))
        caught_up += int(np.sum(np.abs(y[b] - y[b - 1]) > _AFTER * usual))
        n_new += len(start)
        n_twice += len(start) - len(np.unique(y[start]))
    n_repeated = sum(stop - start for _, start, stop in found)
    rare = n_repeated < _MOSTLY_NEW * sum(map(len, signals))
    if not rare or len(found) < _BURSTS or n_twice > _TWICE * n_new:
        return []
    at = {signals[e][start] for e, start, _ in found}
    if min(in_motion, len(at)) < _IN_MOTION * len(found):  # at a limit they are alike
        return []
    return found if 2 * caught_up >= len(found) else []


def wraps(signals: Sequence[Array], inputs: Sequence[Array]) -> int:
    """Times that signals (n_samples,) turn back by a revolution, as angles do.

    Not where an input (n_samples, n_inputs) jumps, at most two samples before. About
    north they are at both ends of their range: that is one of degrees or radians then,
    and steps are small but for whole revolutions.

    >>> angle = np.mod(np.linspace(0.0, 50.0, 400), 2.0 * np.pi)
    >>> wraps([angle], [np.ones((400, 1))]), wraps([angle], [angle[:, None]])
    (7, 0)
    >>> wraps([np.mod(20.0 * np.sin(angle), 360.0)], [np.ones((400, 1))])
    15
    """
    y = np.concatenate(signals)
    low, width = y.min(), np.ptp(y)
    steps = [np.diff(signal) for signal in signals]
    turns = [np.abs(step) > _REVOLUTION * width for step in steps]
    if sum(map(np.count_nonzero, turns)) < _ABOUT_NORTH:  # the usual case
        return 0
    others = (np.abs(step[~far]) for step, far in zip(steps, turns, strict=True))
    largest = max(step.max(initial=0.0) for step in others)
    n_turns = _by_themselves(turns, inputs)
    place = (y - low) / width
    between = np.mean((place > 0.2) & (place < 0.8)) > _BETWEEN
    if n_turns >= _REVOLUTIONS and largest < _OTHER_STEPS * width and between:
        return n_turns
    for period in (360.0, 2.0 * np.pi):
        if not _WHOLE * period < width <= (1.0 + _ROUNDED) * period:
            continue
        turns = [np.abs(step) > 0.5 * period for step in steps]
        left = [np.abs(step - period * np.round(step / period)) for step in steps]
        far, rest = np.concatenate(turns), np.concatenate(left)
        others = rest[~far].max(initial=0.0)
        # as all steps are, and not to one value and back, as where a sensor drops out
        small = others < _OTHER_STEPS * period and rest[far].max() < _ALIKE * others
        n_turns = _by_themselves(turns, inputs)
        if n_turns >= _ABOUT_NORTH and small:
            return n_turns
    return 0


def _by_themselves(turns: Sequence[NDArray[np.bool_]], inputs: Sequence[Array]) -> int:
    """Number of steps (n_samples - 1,) that follow no jump of an input."""
    widths = np.ptp(np.vstack(inputs), axis=0)
    found = 0
    for moved, far in zip(inputs, turns, strict=True):
        own = far.copy()
        jumps = (np.abs(np.diff(moved, axis=0)) > _OTHER_STEPS * widths).any(axis=1)
        for lag in range(3):  # which a plant may take
            own[lag:] &= ~jumps[: max(len(jumps) - lag, 0)]
        found += int(own.sum())
    return found
