"""Local experiments as they were, had the scheduling variables stood still.

Nothing stands quite still: a battery is discharged by the very current that excites it,
a furnace heats up, fuel is burnt. Then outputs follow where they are at rest,

    ``y(t) = y0(kappa(t)) + G(q) (u - u0)``,

slowly, which a model of constant scheduling takes for a mode that hardly decays, in
place of one of the plant. What has moved with it, ``y0(kappa(t)) - y0(mean)``, is
subtracted where the models of the points are likelier without.

What outputs stand at over the points tells how ``y0`` bends, if inputs stand at one
level everywhere. Its slope at a point the experiments there tell better: that of
``A(q) y = B(q) u + A(1) dy0/dkappa kappa + c``, of many lags, by linear least squares;
where the two disagree, what they tell is noise, or something else.

Not where that follows an output itself: what schedules itself is no motion beside the
plant's, but its own.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import Experiment
from ...data.operating_points import OperatingPoints
from ...exceptions import collected, repeat, warn
from ...lpv.equilibria import STANDING
from ...lpv.spline import SplineLPV
from ...subspace.evidence.constants import CERTAIN
from ..running.runner import PointRunner
from .local_models import LocalModel, channel_sizes, is_left, motions

Array = NDArray[np.float64]

_Identified: TypeAlias = "tuple[list[LocalModel], OperatingPoints]"

# Share of the outputs' motion that is worth it, and from which it may be the outputs'
# own; steps from sample to sample, as a share of the outputs' and of its own size,
# from which it is not slow; and what slopes may add to what the bends tell.
_SLIGHT, _OWN, _FAST, _NOISY, _ADDED = 0.005, 0.5, 0.1, 0.5, 0.5

_LAGS, _ROWS = 40, 4  # at most; and rows at least, for each parameter
_RCOND = 1e-12  # of directions that the rows do not tell
_MOST = 1_000_000  # samples, of tables that may lie on a disk


def identified_as_held(
    local: Any,
    points: OperatingPoints,
    identify: Callable[[Any, OperatingPoints, PointRunner], _Identified],
    runner: PointRunner,
) -> tuple[_Identified, OperatingPoints, Any]:
    """Models of the points that did not fail, all points, and the estimator of both.

    As if nothing had scheduled within these, where the models are likelier so. Then all
    of them have constants.
    """
    still = _held(points)
    if still is None:
        return identify(local, points, runner), points, local
    ways = [local]
    if is_left(local, "offset"):
        ways.append(clone(local).set_params(offset="constant"))
    for way in ways:
        held: _Identified = [], still
        with collected() as told_held, suppress(ValueError):
            held = identify(way, still, replace(runner, verbose=0))
        if held[0] and all(model.n_trend for model in held[0]):
            break
    else:
        return identify(local, points, runner), points, local
    own: _Identified = [], points
    with collected() as told, suppress(ValueError):
        own = identify(local, points, runner)
    pairs = zip(own[0], held[0], strict=False)
    gain = sum(a.criterion - b.criterion for a, b in pairs)  # NaN: not told
    n_own, n_held = len(own[0]), len(held[0])
    if n_own > n_held or (n_own == n_held and not gain > CERTAIN):
        repeat(told)
        return own, points, local
    repeat(told_held)
    return held, still, way


def tell_of_held(names: Sequence[Hashable]) -> None:
    """Tell of models that lack what scheduling variables do within experiments."""
    warn(
        f"the scheduling variables, {list(names)}, move within local experiments, and "
        "what outputs at rest do with them was taken out: `local_models_` are those of "
        "scheduling variables that stand still, and lack what inputs do through these; "
        "`predict` has it from the scheduling values. Use offsets=None to keep the "
        "experiments as they are."
    )


def _held(points: OperatingPoints) -> OperatingPoints | None:
    """The points without what their outputs do as scheduling variables move.

    None where that is nothing, or cannot be told.
    """
    runs = [run for group in points.experiments for run in group]
    n_samples = sum(len(run.rows) for run in runs)
    if len(points) == 1 or not points.moved.any() or n_samples > _MOST:
        return None
    sizes = channel_sizes(points.experiments)
    means = [tuple(mean for mean, _ in motions(g)) for g in points.experiments]
    levels, outputs = (np.array(values) for values in zip(*means, strict=True))
    if np.sum(np.var(levels / sizes[0], axis=0)) > STANDING:
        return None
    rest = SplineLPV(extrapolation="ignore").fit(points.kappa, outputs / sizes[1])
    bends = [_about_mean(rest.predict(run.kappa)) for run in runs]
    if not (_farthest(bends) > _SLIGHT).any():
        return None
    travelled = _square([_about_mean(run.kappa) for run in runs])
    steep = _square(bends) / np.where(travelled > 0.0, travelled, np.inf)[:, None]
    beyond, added = iter(bends), []
    for group in points.experiments:
        bent = [sizes[1] * next(beyond) for _ in group]
        slope, variance = _slope(group, bent)
        total = steep * sizes[1] ** 2 + variance  # of what it may be, and its error
        slope *= 1.0 - variance / np.where(total > 0.0, total, 1.0)
        slope /= sizes[1]
        added += [_about_mean(run.kappa) @ slope for run in group]
    agrees = _square(added) < _ADDED**2 * _square(bends)
    changes = [
        bend + np.where(agrees, more, 0.0)
        for bend, more in zip(bends, added, strict=True)
    ]
    moves = _moves(changes, [run.measured / sizes[1] for run in runs])
    if not moves.any():
        return None
    still = (np.where(moves, sizes[1] * change, 0.0) for change in changes)
    groups = [[_without(run, next(still)) for run in g] for g in points.experiments]
    return replace(points, experiments=groups)


def _farthest(bends: Sequence[Array]) -> Array:
    """What outputs may move at most within a run, with all that slopes may add."""
    size = np.max([bend.std(axis=0) for bend in bends], axis=0)
    return size + _ADDED * np.sqrt(_square(bends) / min(map(len, bends)))


def _moves(changes: Sequence[Array], outputs: Sequence[Array]) -> NDArray[np.bool_]:
    """Which outputs do slowly what matters; none where that is most that one does.

    In units of the outputs' motion. What is larger than that motion they do not do.
    """
    size = np.max([change.std(axis=0) for change in changes], axis=0)
    slow = _step(changes) < np.minimum(_FAST * _step(outputs), _NOISY * size)
    left = [y - change for y, change in zip(outputs, changes, strict=True)]
    own = (size > _OWN) & (_about_means(left) < _about_means(outputs))
    return (size > _SLIGHT) & (size < _OWN) & slow & ~own.any()


def _without(run: Experiment, change: Array) -> Experiment:
    """An experiment whose scheduling stands still, and outputs without a change."""
    still = np.zeros_like(run.kappa) + run.kappa.mean(axis=0)
    return replace(run, outputs=run.measured - change, scheduling=still)


def _slope(group: Sequence[Experiment], bends: Sequence[Array]) -> tuple[Array, Array]:
    """Of outputs at rest over the scheduling variables, (n_scheduling, n_outputs).

    At one point, beside what they bend; and its variance. Zero where there are too few
    samples to tell.
    """
    n_scheduling, ny = group[0].kappa.shape[1], group[0].measured.shape[1]
    per_lag = ny + group[0].inputs.shape[1]
    lengths = [len(run.rows) for run in group]
    lags = (sum(lengths) // _ROWS - n_scheduling) // per_lag
    lags = min(_LAGS, lags, max(lengths) // _ROWS)
    if lags < 1:
        return np.zeros((n_scheduling, ny)), np.zeros((n_scheduling, ny))
    causes, effects = [], []
    for run, bend in zip(group, bends, strict=True):
        if len(run.rows) <= lags + 1:
            continue
        u, y, kappa = run.inputs, run.measured - bend, _about_mean(run.kappa)
        past = sliding_window_view(np.hstack([y[:-1], u[:-1]]), lags, axis=0)
        past = past.reshape(len(past), -1)
        rows = np.hstack([past, u[lags:], kappa[lags:]])
        known = np.isfinite(rows).all(axis=1) & np.isfinite(y[lags:]).all(axis=1)
        causes.append(_about_mean(rows[known]))
        effects.append(_about_mean(y[lags:][known]))
    H, Y = np.vstack(causes), np.vstack(effects)
    size = np.linalg.norm(H, axis=0)
    size[size == 0.0] = 1.0
    # by the triangular factor of all, which has the products of all columns
    factor = np.asarray(np.linalg.qr(np.hstack([H / size, Y]), mode="r"))
    R, seen = np.split(factor, [len(size)], axis=1)
    inverse = np.linalg.pinv(R, rcond=_RCOND) / size[:, None]
    found = inverse @ seen
    left = seen - (R * size) @ found
    noise = left.T @ left / max(len(H) - len(size), 1)
    # of all lags of every output, and of the scheduling variables
    sums = np.zeros((ny + n_scheduling, H.shape[1]))
    sums[:ny, : ny * lags] = np.kron(np.eye(ny), np.ones(lags))
    sums[ny:, -n_scheduling:] = np.eye(n_scheduling)
    of_past, of_kappa = np.split(sums @ found, [ny])
    settled = np.linalg.pinv(np.eye(ny) - of_past)
    slope = of_kappa @ settled
    # d slope = (d of_kappa + slope d of_past) settled
    moves = np.hstack([slope, np.eye(n_scheduling)]) @ sums @ inverse
    spread = np.sum(moves**2, axis=1)[:, None] * np.diag(settled.T @ noise @ settled)
    return slope, spread


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
