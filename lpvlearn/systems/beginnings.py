"""How records begin: at rest about one point, or where their first inputs hold them.

A step test stands still until the step comes, but seldom where the model is at rest:
that is about the means of the record, of which most comes after the step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STANDING = 5  # samples in which inputs that move later stand still
_STILL = 0.02  # part of their range that measured ones may move meanwhile
_OFTEN = 10  # moves of inputs that are no step test's
_MANY = 100  # moves that tell the levels of inputs
_BRIEF = 0.5  # part of the samples that inputs of pulses are away from their level
_SELDOM = 4  # moves of inputs that are one, whatever they begin with; pulses of few
_NEARER = 0.5  # of what there is between two beginnings: nearer to one beyond noise
# Of outputs that move: part of what there is between two beginnings, and standard
# deviations of the means of noise
_MOVING, _CHANCE = 0.1, 3.0
_STIRRING = 0.3  # the same of records that may begin at rest: that is of their motion
# Times the squared errors of a beginning at rest, in any record; part of what there is
# between two beginnings that is none.
_WORSE, _ROUNDING = 2.0, 1e-6


def standing(u: Array) -> int:
    """Samples in which inputs stand still before they move; 0 if few, or to the end.

    >>> u = np.repeat([[2.0], [3.0]], 8, axis=0)
    >>> standing(u), standing(u[4:]), standing(u[8:])
    (8, 0, 0)
    """
    if not len(u):
        return 0
    n = int(_left(u, u[0]).argmax())
    return n if n >= _STANDING else 0


def _left(u: Array, level: Array) -> NDArray[np.bool_]:
    """Which samples are far from a level, by the range of all."""
    with np.errstate(over="ignore"):
        far = np.abs(u - level) > _STILL * np.ptp(u, axis=0)
    return np.asarray(far.any(axis=1))


def _held_again(moves: NDArray[np.intp]) -> int:
    """Samples for which inputs are held at the longest later, if they move often."""
    return int(np.diff(moves).max()) if len(moves) > _OFTEN else 0


def waiting(u: Array) -> int:
    """As `standing`, but 0 where inputs that move often are held as long later.

    Unless they stand where they never come again, as they do to all levels else.

    >>> u = np.repeat([2.0, 3.0] * 9, 8)[:, None]
    >>> standing(u), waiting(u), waiting(u[:40])
    (8, 0, 8)
    >>> waiting(np.vstack([np.full((8, 1), 2.5), u]))
    8
    """
    n, moves = standing(u), moves_of(u)
    return n if n and (n > _held_again(moves) or _left_for_good(u, moves)) else 0


def _left_for_good(u: Array, moves: NDArray[np.intp]) -> bool:
    """Whether inputs come back to every level that they move to, but not the first."""
    if not _left(u, u[0])[moves[0] + 1 :].all():
        return False
    levels = u[moves[:_MANY] + 1]
    with np.errstate(over="ignore"):
        alike = np.abs(levels[:, None] - levels) <= _STILL * np.ptp(u, axis=0)
    return bool((alike.all(axis=2).sum(axis=1) > 1).all())


def moves_of(u: Array) -> NDArray[np.intp]:
    """Samples after which inputs (n_samples, n_inputs) move.

    >>> moves_of(np.repeat([[2.0], [3.0], [2.0]], 4, axis=0))
    array([3, 7])
    """
    with np.errstate(over="ignore"):
        moved = np.abs(np.diff(u, axis=0)) > _STILL * np.ptp(u, axis=0)
    return np.flatnonzero(moved.any(axis=1))


def first_inputs(u: Array) -> Array:
    """Inputs at the beginning, their median as long as they stand still."""
    return np.asarray(np.median(u[: standing(u) or 1], axis=0))


class Stands(NamedTuple):
    """How records begin that may begin at rest."""

    first: Array  # (n_records, n_inputs): inputs that they begin with
    seen: bool  # whether outputs show it, for as long as inputs stand still


def stands(records: Iterable[tuple[Array, Array]]) -> Stands | None:
    """How records (u, y) begin, if all may at a stand.

    Few samples before the first of few moves show nothing, and may be one all the same.
    None where inputs of a record go on to move, or move slowly; and where outputs move
    while inputs stand still.

    >>> u, y = np.repeat([[2.0], [3.0]], 8, axis=0), np.repeat([[20.0], [25.0]], 8, 0)
    >>> stands([(u, y), (u[7:], y[7:])])
    Stands(first=array([[2.],
           [2.]]), seen=False)
    >>> stands([(u, u.cumsum()[:, None])]), stands([(y.cumsum()[:, None], y)])
    (None, None)
    """
    first, seen = [], True
    for u, y in records:
        moves = moves_of(u)
        n = int(moves[0]) + 1 if len(moves) else 0
        if not n or _left(u, u[0])[:n].any():
            return None  # they go on slowly
        shown = n >= _STANDING and n > _held_again(moves)  # not as they go on to do
        size = np.nanmax(y, axis=0) - np.nanmin(y, axis=0)
        size = np.where(size > 0.0, size, 1.0)
        if len(moves) > _SELDOM and not shown:
            return None
        if shown and _moves(y[:n] / size, _STIRRING**2 * n):
            return None
        seen &= shown
        first.append(np.median(u[:n], axis=0))
    return Stands(np.array(first), seen)


def pulsed(records: Iterable[tuple[Array, Array]]) -> Stands | None:
    """How records (u, y) begin whose inputs stand at one level but for few pulses.

    There before they begin, as before the impact, the kick or the dose with which some
    begin, or soon go on. None where none does.

    >>> u = np.repeat([[3.0], [2.0]], [2, 9], axis=0)
    >>> pulsed([(u, u), (u[4:], u[4:])])
    Stands(first=array([[2.],
           [2.]]), seen=False)
    >>> pulsed([(u[4:], u[4:])]), pulsed([(u.cumsum()[:, None], u)])
    (None, None)
    """
    levels, soon = [], False
    for u, _ in records:
        level = np.median(u, axis=0)
        away = _left(u, level)
        n_pulses = np.count_nonzero(np.diff(away.astype(int), prepend=0) > 0)
        if n_pulses > _SELDOM or np.mean(away) > _BRIEF:
            return None
        soon |= bool(away[:_STANDING].any())
        levels.append(level)
    return Stands(np.array(levels), False) if soon else None


def held_state(A: Array, B: Array, u: Array, *, discrete: bool) -> Array | None:
    """The state in which constant inputs hold a model; None if that is nowhere.

    >>> held_state(np.array([[-2.0]]), np.eye(1), np.array([6.0]), discrete=False)
    array([3.])
    """
    try:
        x = np.linalg.solve(np.eye(len(A)) - A if discrete else -A, B @ u)
    except np.linalg.LinAlgError:  # an integrator
        return None
    return np.asarray(x) if np.isfinite(x).all() else None


class Beginning(NamedTuple):
    """Outputs (n_samples, n_outputs) of a record as long as its inputs stand still."""

    measured: Array  # NaN where they are missing
    at_rest: Array  # of a simulation from rest
    at_mean: Array  # from where the mean of the inputs holds the model
    held: Array  # (n_outputs,), where the first inputs do

    @classmethod
    def of(
        cls,
        record: tuple[Array, Array],
        rest: tuple[Array, Array],
        gain: Array,
        simulated: Callable[[Array], Array],
        *,
        about_mean: bool,
    ) -> Beginning:
        """Of a record (u, y) and a model, at rest at (u0, y0), by its static gain.

        `simulated` gives its answer to inputs from rest at zero. A record that is not
        `about_mean` is about the point of rest.
        """
        (u, y), (u0, y0) = record, rest
        n, mean = waiting(u), u.mean(axis=0) if about_mean else u0
        at_mean, held = (y0 + gain @ (v - u0) for v in (mean, first_inputs(u)))
        at_rest, moved = (simulated(u[:n] - v) for v in (u0, mean))
        return cls(y[:n], y0 + at_rest, at_mean + moved, held)


def begin_held(beginnings: Iterable[Beginning]) -> bool:
    """Whether records begin where their first inputs hold them.

    And not where the mean of the inputs would, as records about that do.

    Examples
    --------
    >>> y, decay = np.full((8, 1), 20.0), np.linspace(25, 20, 8)[:, None]
    >>> begin_held([Beginning(y, decay, decay, np.array([20.0]))])
    True
    """
    records = list(beginnings)
    apart = [one.at_mean - one.held for one in records]
    if not records or not all(np.isfinite(a).all() for a in apart):
        return False
    size = np.max([np.abs(a).max(axis=0, initial=0.0) for a in apart], axis=0)
    known = size > np.finfo(float).tiny
    weight = np.divide(1.0, size, out=np.zeros_like(size), where=known)
    nearer = worse = total = 0.0
    for one, a in zip(records, apart, strict=True):
        to_rest, to_mean, to_held = (
            float(np.nansum((weight * (one.measured - other)) ** 2))
            for other in (one.at_rest, one.at_mean, one.held)
        )
        own = float(np.sum(np.where(np.isnan(one.measured), 0.0, weight * a) ** 2))
        if _moves(one.measured * weight, own):
            continue
        nearer, total = nearer + to_mean - to_held, total + own
        worse += to_held - _WORSE * to_rest
    if worse > _ROUNDING * total:
        return False  # gains are too poorly known for that
    return nearer > _NEARER * total


def _moves(y: Array, apart: float) -> bool:
    """Whether outputs move beyond noise, by a part of what is between two beginnings.

    `apart` is the sum of squares of that. Records in motion are often near to where
    inputs that have been held for long would lead them.
    """
    n, change, noise = len(y), 0.0, 0.0
    for column in y.T:
        known = column[~np.isnan(column)]
        if len(known) > 2:
            first, second = np.array_split(known, 2)
            change += float((second.mean() - first.mean()) ** 2)
            noise += float(np.mean(np.diff(known) ** 2)) / 2.0
    return n * change > _MOVING**2 * apart + _CHANCE**2 * 4.0 * noise
