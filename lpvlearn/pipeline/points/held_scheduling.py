"""Local experiments as they were, had the scheduling variables stood still.

Nothing stands quite still: a battery is discharged by the very current that excites it,
a furnace heats up, fuel is burnt. Then outputs follow where they are at rest,

    ``y(t) = y0(kappa(t)) + G(q) (u - u0)``,

slowly, which a model of constant scheduling takes for a mode that hardly decays, in
place of one of the plant. What has moved with it, ``y0(kappa(t)) - y0(mean)``, is
subtracted where the models of the points are likelier without.

What outputs stand at over the points tells whether that matters, if inputs stand at one
level everywhere, and their slope about where it is. The experiments at a point tell it
better: as the static gain from the scheduling variables, and where it is likelier so
from their squares, were they inputs.

Not where that follows an output itself: what schedules itself is no motion beside the
plant's, but its own.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import Experiment, as_table
from ...data.motion import channel_sizes, motions
from ...data.operating_points import OperatingPoints
from ...exceptions import collected, repeat, warn
from ...lpv.equilibria import STANDING
from ...lpv.spline import SplineLPV
from ...subspace.estimator import SubspaceLTI
from ...subspace.evidence.constants import CERTAIN
from ...subspace.telling import unheard
from ...systems.modes import spectral_radius
from ..running.runner import PointRunner
from .fitting import is_left
from .local_models import LocalModel

Array = NDArray[np.float64]

_Identified: TypeAlias = "tuple[list[LocalModel], OperatingPoints]"

# Share of the outputs' motion that is worth it, and what it leaves of one that is the
# scheduling variable itself; steps from sample to sample, as a share of the outputs'
# and of its own size, from which it is not slow; and what slopes of points may add.
_SLIGHT, _OWN, _FAST, _NOISY, _ADDED = 0.005, 0.2, 0.1, 0.2, 0.5

_ENOUGH = 3000  # samples that tell the curve of a point

_MOST = 1_000_000  # samples, of tables that may lie on a disk


def identified_as_held(
    local: Any,
    points: OperatingPoints,
    identify: Callable[[Any, OperatingPoints, PointRunner], _Identified],
    runner: PointRunner,
    order: Any,
) -> tuple[_Identified, OperatingPoints, Any]:
    """Models of the points that did not fail, all points, and the estimator of both.

    As if nothing had scheduled within these, where the models are likelier so. Then all
    of them have constants. `order` is that of the models, where it is known.
    """
    still = _held(points, runner, order)
    if still is None:
        return identify(local, points, runner), points, local
    own: _Identified = [], points
    with collected() as told, suppress(ValueError):
        own = identify(local, points, runner)
    ways = [local]
    if is_left(local, "offset"):
        ways.append(clone(local).set_params(offset="constant"))
    for way in ways:
        held: _Identified = [], still
        with collected() as told_held, suppress(ValueError):
            held = identify(way, still, replace(runner, verbose=0))
        pairs = zip(own[0], held[0], strict=False)
        gain = sum(a.criterion - b.criterion for a, b in pairs)  # NaN: not told
        n_own, n_held = len(own[0]), len(held[0])
        if n_own > n_held or (n_own == n_held and not gain > CERTAIN):
            break
        if held[0] and all(model.n_trend for model in held[0]):
            repeat(told_held)
            return held, still, way
    if not own[0]:
        return identify(local, points, runner), points, local  # which fails
    repeat(told)
    return own, points, local


def tell_of_held(names: Sequence[Hashable]) -> None:
    """Tell of models that lack what scheduling variables do within experiments."""
    warn(
        f"the scheduling variables, {list(names)}, move within local experiments, and "
        "what outputs at rest do with them was taken out: `local_models_` are those of "
        "scheduling variables that stand still, and lack what inputs do through these; "
        "`predict` has it from the scheduling values. Use offsets=None to keep the "
        "experiments as they are."
    )


def _held(
    points: OperatingPoints, runner: PointRunner, order: Any
) -> OperatingPoints | None:
    """The points without what their outputs do as scheduling variables move.

    None where that is nothing, or cannot be told.
    """
    runs = [run for group in points.experiments for run in group]
    n_samples = sum(len(run.rows) for run in runs)
    if len(points) == 1 or not points.moved.any() or n_samples > _MOST:
        return None
    paths = [_about_mean(run.kappa) for run in runs]
    if not (_step(paths) < _NOISY * np.sqrt(_square(paths) / n_samples)).any():
        return None  # what moves there is noise, or as fast as that
    sizes = channel_sizes(points.experiments)
    means = [tuple(mean for mean, _ in motions(g)) for g in points.experiments]
    levels, outputs = (np.array(values) for values in zip(*means, strict=True))
    if np.sum(np.var(levels / sizes[0], axis=0)) > STANDING:
        return None
    rest = SplineLPV(extrapolation="ignore").fit(points.kappa, outputs / sizes[1])
    bends = [_about_mean(rest.predict(run.kappa)) for run in runs]
    if not (_farthest(bends) > _SLIGHT).any():
        return None
    done = replace(runner, verbose=0).run(
        "curves at rest",
        curve_at_rest,
        [(_farthest_moved(group),) for group in points.experiments],
        points.kappa,
        order=order,
    )
    curves = [one.result for one in done if one is not None]
    changes = _changes(points, bends, curves, sizes[1])
    moves = _moves(changes, [run.measured / sizes[1] for run in runs])
    if not moves.any():
        return None
    still = (np.where(moves, sizes[1] * change, 0.0) for change in changes)
    groups = [[_without(run, next(still)) for run in g] for g in points.experiments]
    return replace(points, experiments=groups)


def _changes(
    points: OperatingPoints,
    bends: Sequence[Array],
    curves: Sequence[Curve],
    size: Array,
) -> list[Array]:
    """What outputs at rest do within every run, in units of their `size`.

    By the curve of each point, whose slope may be noise beside that of what the points
    tell together, `bends`.
    """
    paths = [[_about_mean(run.kappa) for run in g] for g in points.experiments]
    travelled = _square([path for some in paths for path in some])
    steep = _square(bends) / np.where(travelled > 0.0, travelled, np.inf)[:, None]
    ends = np.cumsum([len(some) for some in paths])[:-1]
    together = np.split(np.arange(len(bends)), ends)
    changes = []
    for some, own, curve in zip(paths, together, curves, strict=True):
        bent = np.linalg.lstsq(np.vstack(some), np.vstack([bends[k] for k in own]))[0]
        variance = curve.variances / size**2
        total = steep + variance  # of what a slope may be beside, and its error
        share = np.divide(steep, total, out=np.zeros_like(total), where=total > 0.0)
        slopes = bent + share * (curve.slopes / size - bent)
        changes += [path @ slopes + _bowed(path) @ curve.bows / size for path in some]
    return changes


def _farthest(bends: Sequence[Array]) -> Array:
    """What outputs may move at most within a run, with all that slopes may add."""
    size = np.max([bend.std(axis=0) for bend in bends], axis=0)
    return size + _ADDED * np.sqrt(_square(bends) / min(map(len, bends)))


def _moves(changes: Sequence[Array], outputs: Sequence[Array]) -> NDArray[np.bool_]:
    """Which outputs do slowly what matters; none where that is all that one does.

    In units of the outputs' motion. What is larger than that motion they do not do.
    """
    size = np.max([change.std(axis=0) for change in changes], axis=0)
    slow = _step(changes) < np.minimum(_FAST * _step(outputs), _NOISY * size)
    left = [y - change for y, change in zip(outputs, changes, strict=True)]
    own = _about_means(left) < _OWN**2 * _about_means(outputs)
    return (size > _SLIGHT) & (size < 1.0) & slow & ~own.any()


def _without(run: Experiment, change: Array) -> Experiment:
    """An experiment whose scheduling stands still, and outputs without a change."""
    still = np.zeros_like(run.kappa) + run.kappa.mean(axis=0)
    return replace(run, outputs=run.measured - change, scheduling=still)


def _farthest_moved(group: Sequence[Experiment]) -> list[Experiment]:
    """Those of which scheduling variables move most, of enough samples together."""
    moved = [float(np.square(_about_mean(run.kappa)).sum()) for run in group]
    chosen: list[Experiment] = []
    for k in np.argsort(moved, kind="stable")[::-1].tolist():
        if sum(len(run.rows) for run in chosen) < _ENOUGH:
            chosen.append(group[k])
    return chosen


class Curve(NamedTuple):
    """Outputs at rest over the scheduling variables about a point."""

    slopes: Array  # (n_scheduling, n_outputs)
    bows: Array  # likewise, of the squares
    variances: Array  # likewise, of the slopes; infinite where these are not told


def curve_at_rest(group: Sequence[Experiment], order: Any) -> Curve:
    """That of one point: static gains from scheduling variables and their squares.

    Of a model of that order; squares where it is likelier with them.
    """
    kappa = [_about_mean(run.kappa) for run in group]
    moves = np.asarray(np.vstack(kappa).any(axis=0))
    n = np.count_nonzero(moves)
    paths = [path[:, moves] for path in kappa]
    shape = len(moves), group[0].measured.shape[1]
    curve = Curve(np.zeros(shape), np.zeros(shape), np.full(shape, np.inf))
    likeliest = np.inf
    for causes in (paths, [np.hstack([path, _bowed(path)]) for path in paths]):
        driven = [
            replace(run, inputs=np.hstack([run.inputs, cause]), input_names=())
            for run, cause in zip(group, causes, strict=True)
        ]
        table, y = as_table(driven)
        *inputs, label = table.columns
        roles = {"inputs": inputs, "experiment": label, "missing": "split"}
        with unheard(), collected(), suppress(ValueError):
            found = SubspaceLTI(order, offset="constant", **roles).fit(table, y)
            std = found.frequency_response_std(np.zeros(1))[0].real
            longest = max(len(run.rows) for run in group)
            lasts = spectral_radius(found.lti_.A) > 1.0 - 1.0 / longest
            if lasts or not found.criterion() < likeliest:
                continue
            likeliest = found.criterion()
            first = group[0].inputs.shape[1]
            gain = found.lti_.dc_gain()[:, first:].T
            curve.slopes[moves], curve.bows[moves] = gain[:n], 0.0
            if len(gain) > n:
                curve.bows[moves] = gain[n:]
            curve.variances[moves] = std[:, first : first + n].T ** 2
    return curve


def _bowed(path: Array) -> Array:
    return _about_mean(path**2)


def _about_mean(signal: Array) -> Array:
    return np.asarray(signal - signal.mean(axis=0)) if len(signal) else signal


def _square(signals: Sequence[Array]) -> Array:
    """Sum of squares of every column, NaN left out."""
    return np.nansum(np.vstack(signals) ** 2, axis=0)


def _about_means(signals: Sequence[Array]) -> Array:
    return _square([signal - np.nanmean(signal, axis=0) for signal in signals])


def _step(signals: Sequence[Array]) -> Array:
    """Root mean square of the steps from sample to sample, of every column."""
    squares = np.vstack([np.diff(signal, axis=0) ** 2 for signal in signals])
    size = np.sqrt(np.nanmean(squares, axis=0))
    return np.where(size > 0.0, size, 1.0)
