"""Recursive Gauss-Newton steps on the simulation error of a stream.

Every stretch of data is linearised at the model of that moment, in fixed local
coordinates around a pilot model, and stacked to a triangular factor of bounded size: a
Gauss-Newton method that sees each sample once, as efficient as the batch one in
the limit (Ljung and Soderstrom, 1983), because the pilot is already close. A stretch
has an initial state of its own, which costs next to nothing.

The factor holds the simulation error as a function of all parameters near the models
it was linearised at. B and D for given matrices A and C, such as the subspace estimate
of the whole stream, follow from it as well (`input_matrices`): the simulation least
squares without the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...systems.least_squares import column_scale, scaled_lstsq, thin_svd
from ...systems.modes import spectral_radius
from ..orders.realization import observability_matrix
from ..samples.records import Record
from ..simulation_error.refinement import UNDETERMINED
from ..simulation_error.signals import block_slices, signal_factor
from ..simulation_error.simulation_fit import (
    Freedom,
    Realization,
    change_between,
    linear_regression,
    linearised,
    moved_model,
    parameter_slices,
)

Array = NDArray[np.float64]

_HEAD = 4_096  # samples from which the initial state of a stretch is estimated first

# A linearisation holds for changes of a pole of this share of its distance from the
# unit circle, taken as no smaller than some 10,000 samples can tell.
_RANGE, _CLOSEST = 0.1, 1e-4

# Coordinates that move no pole are restrained by next to nothing, but not by zero.
_SLOWEST = 1e-100

# Newton steps towards the pilot's blocks: they converge quadratically, or not at all.
_MAX_ALIGN = 30

# Coupling between blocks, relative to A, that is rounding; A grown beyond the limit is
# a pair that has no form with the pilot's blocks.
_COUPLING, _DIVERGED = 1e-14, 1e6


class Recursion(NamedTuple):
    """Accumulated linearised simulation errors around a pilot model.

    The parameters (B, D, A, C) are those of the pilot plus ``directions @ position``.
    """

    pilot: Realization  # in section form
    free: Freedom
    directions: Array  # (n_parameters, k)
    coordinates: Array  # (k, n_parameters): back, but for what leaves the response
    restraint: Array  # (k,): weight of the distance from the pilot
    information: Array  # (k + 1, k + 1): factor of [J, J position - error], summed up
    position: Array  # (k,)


def start_recursion(
    pilot: Realization, records: Sequence[Record], free: Freedom
) -> Recursion | None:
    """Local coordinates and first information, from the data of the pilot model.

    What these tell of the parameters no better than the linearisation is valid, such as
    the poles of a superfluous mode, stays with the pilot until the data tell more. None
    where the pilot cannot be linearised at: it has no section form, or its responses
    overflow.
    """
    if pilot.blocks is None or not np.isfinite(pilot.loss):
        return None
    stacked = linearised(pilot, records, free)
    if stacked is None:
        return None
    jacobian = stacked[:, :-1]
    scale = column_scale(jacobian)
    _, s, right = thin_svd(jacobian / scale)
    right = right[s > UNDETERMINED * s.max(initial=0.0)]
    directions = right.T / scale[:, None]
    rows = np.column_stack([jacobian @ directions, stacked[:, -1]])
    information = _triangle(rows)
    variance = pilot.loss / sum(record.y.size for record in records)
    restraint = np.sqrt(variance) / _ranges(pilot, directions, free)
    position = _solve(information, restraint)
    return Recursion(
        pilot, free, directions, right * scale, restraint, information, position
    )


def _ranges(pilot: Realization, directions: Array, free: Freedom) -> Array:
    """How far every coordinate may move before a pole leaves its neighbourhood."""
    assert pilot.blocks is not None
    speed = np.full(directions.shape[1], _SLOWEST)
    for block, part in zip(pilot.blocks, parameter_slices(pilot, free), strict=True):
        change = directions[part]
        margin = 1.0 - spectral_radius(block)
        size = np.sqrt(np.einsum("ij,ij->j", change, change))
        speed = np.maximum(speed, size / (_RANGE * max(abs(margin), _CLOSEST)))
    return 1.0 / speed


def _triangle(rows: Array) -> Array:
    """Upper triangular factor, square also of few rows."""
    out = np.zeros((rows.shape[1],) * 2)
    upper = np.linalg.qr(rows, mode="r")
    out[: len(upper)] = upper
    return out


def _solve(information: Array, restraint: Array) -> Array:
    rows = np.vstack([information[:-1, :-1], np.diag(restraint)])
    target = np.concatenate([information[:-1, -1], np.zeros(len(restraint))])
    return scaled_lstsq(rows, target)[0]


def current_model(recursion: Recursion) -> Realization:
    """Model at the present position; its loss is that of the linearised problem."""
    step = recursion.directions @ recursion.position
    return _pilot_after(recursion, step, recursion.position)


def _pilot_after(recursion: Recursion, step: Array, position: Array) -> Realization:
    """The pilot model after a step of its parameters, to the given position."""
    error = recursion.information[:, -1].copy()
    error[:-1] -= recursion.information[:-1, :-1] @ position
    model = moved_model(recursion.pilot, step, recursion.free)
    return model._replace(loss=float(error @ error))


def input_matrices(recursion: Recursion, A: Array, C: Array) -> Realization | None:
    """Model with given A and C: B and D that minimise the linearised error.

    `A` and `C` may be in any state basis, near the model of the recursion; the model is
    in that of the pilot. None where they have no form with the pilot's blocks.
    """
    pilot, free = recursion.pilot, recursion.free
    pair = _aligned_pair(A, C, pilot)
    if pair is None:
        return None
    blocks, C = pair
    n_bd = pilot.B.size + int(free.direct.sum())
    step = change_between(pilot, pilot._replace(blocks=blocks, C=C), free)
    R, target = recursion.information[:-1, :-1], recursion.information[:-1, -1]
    rest = target - R @ (recursion.coordinates @ step)
    step[:n_bd] = scaled_lstsq(R @ recursion.coordinates[:, :n_bd], rest)[0]
    return _pilot_after(recursion, step, recursion.coordinates @ step)


def _aligned_pair(
    A: Array, C: Array, pilot: Realization
) -> tuple[tuple[Array, ...], Array] | None:
    """``(A, C)`` in the state basis of another model, with blocks as that has them.

    The extended observability matrices give the basis; Newton steps on the invariant
    subspaces remove what then couples the blocks. None where no form is near.
    """
    assert pilot.blocks is not None
    n = len(A)
    if n == 0:
        return (), C
    parts = block_slices(pilot.blocks)
    coupled = linalg.block_diag(*map(np.ones_like, pilot.blocks)) == 0.0
    seen = observability_matrix(A, C, 2 * n)
    T = linalg.lstsq(seen, observability_matrix(pilot.A, pilot.C, 2 * n))[0]
    try:
        A, C = linalg.solve(T, A @ T), C @ T
        for _ in range(_MAX_ALIGN):
            if np.abs(A[coupled]).max(initial=0.0) <= _COUPLING * np.abs(A).max():
                return tuple(A[part, part] for part in parts), C
            # To first order, I + S brings every pair of blocks apart.
            S = np.eye(n)
            for p, q in permutations(parts, 2):
                S[p, q] = linalg.solve_sylvester(A[p, p], -A[q, q], -A[p, q])
            A, C = linalg.solve(S, A @ S), C @ S
            if not np.abs(A).max() < _DIVERGED:
                return None
    except (linalg.LinAlgError, ValueError):
        return None
    return None


def extend_recursion(
    recursion: Recursion,
    record: Record,
    *,
    starts: bool,
    point: Realization | None,
) -> tuple[Recursion, StretchError]:
    """Add a stretch of data, linearised at the present model; its own unknowns.

    `record` is scaled as the pilot's data; `starts` says whether an experiment begins
    with it. `point` is another model to linearise at, from `input_matrices`. Where the
    responses overflow the recursion stays as it is.
    """
    if point is None:
        model, position = current_model(recursion), recursion.position
    else:
        model = point
        step = change_between(recursion.pilot, point, recursion.free)
        position = recursion.coordinates @ step
    # A linearisation point for the initial state; the stretch corrects it.
    head = record.head(_HEAD)
    own = stretch_error(model, head, recursion.free, starts=starts)
    if not np.isfinite(own.loss):
        return recursion, own
    free = _freedom_of_stretch(recursion.free, starts)
    states = own.initial_state[None]
    M = linearised(model._replace(initial_states=states), [record], free)
    if M is None:
        return recursion, own
    J = M[:, :-1] @ recursion.directions
    rows = np.column_stack([J, M[:, -1] + J @ position])
    information = _triangle(np.vstack([recursion.information, rows]))
    position = _solve(information, recursion.restraint)
    return recursion._replace(information=information, position=position), own


def _freedom_of_stretch(free: Freedom, starts: bool) -> Freedom:
    """What continues an experiment does not start from rest."""
    return free if starts else free._replace(initial_states=True)


class StretchError(NamedTuple):
    """What a stretch of data is explained by, beside the model."""

    loss: float  # sum of squared errors; infinite where the responses overflow
    initial_state: Array
    trends: Array  # (n_trend, n_outputs)


def stretch_error(
    model: Realization, record: Record, free: Freedom, *, starts: bool
) -> StretchError:
    """Error of a stretch with its best own unknowns; the model is in section form."""
    assert model.blocks is not None
    free, n = _freedom_of_stretch(free, starts), len(model.A)
    own = free.n_own(n)
    R = signal_factor(model.blocks, record)
    if R is None:
        states, trends = free.own_parts(np.zeros((1, own)), n)
        return StretchError(np.inf, states[0], trends[0])
    M = linear_regression(R, model.blocks, model.C, free)
    known = np.concatenate([model.B.ravel(), model.D[free.direct]])
    error = M[:, -1] - M[:, own:-1] @ known
    best = scaled_lstsq(M[:, :own], error)[0]
    error -= M[:, :own] @ best
    states, trends = free.own_parts(best[None], n)
    return StretchError(float(error @ error), states[0], trends[0])
