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

from ..systems.least_squares import scaled_lstsq
from .parameters import block_parts, change_between, moved_model
from .refinement import experiment_regressions
from .signals import Record, signal_factor, state_coefficients
from .simulation_fit import (
    Freedom,
    Point,
    Realization,
    jacobian_regression,
    linear_regression,
    n_own,
    project_out,
    stack_regressions,
)

Array = NDArray[np.float64]

# Directions of the scaled parameters that the pilot data do not determine.
_RCOND = 1e-9

# Samples from which the initial state of a stretch is estimated first.
_HEAD = 4_096

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

    Attributes
    ----------
    pilot : Realization
        In section form.
    free : Freedom
    directions : ndarray of shape (n_parameters, k)
        Local coordinates: parameters (B, D, A, C) are those of the pilot plus
        ``directions @ position``.
    coordinates : ndarray of shape (k, n_parameters)
        The other way: position of a change of the parameters, but for what leaves the
        response as it is.
    restraint : ndarray of shape (k,)
        Weight of the distance from the pilot, along every coordinate.
    information : ndarray of shape (k + 1, k + 1)
        Triangular factor of ``[J, J position - error]``, summed up.
    position : ndarray of shape (k,)
    """

    pilot: Realization
    free: Freedom
    directions: Array
    coordinates: Array
    restraint: Array
    information: Array
    position: Array


def start_recursion(
    pilot: Realization, records: Sequence[Record], free: Freedom
) -> Recursion | None:
    """Local coordinates and first information, from the data of the pilot model.

    What these tell of the parameters no better than the linearisation is valid, such as
    the poles of a superfluous mode, stays with the pilot until the data tell more.

    Parameters
    ----------
    pilot : Realization
    records : sequence of Record
    free : Freedom

    Returns
    -------
    Recursion or None
        None where the pilot cannot be linearised at: it has no section form, or its
        responses overflow.
    """
    if pilot.blocks is None or not np.isfinite(pilot.loss):
        return None
    regressions = experiment_regressions(pilot, records, free)
    if regressions is None:
        return None
    stacked = stack_regressions(regressions, n_own(len(pilot.A), free))
    jacobian = stacked[:, :-1]
    scale = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    scale[scale == 0.0] = 1.0
    _, s, right = linalg.svd(jacobian / scale, full_matrices=False, check_finite=False)
    right = right[s > _RCOND * s.max(initial=0.0)]
    directions = right.T / scale[:, None]
    rows = np.column_stack([jacobian @ directions, stacked[:, -1]])
    information = _triangle(rows)
    variance = pilot.loss / sum(record.y.size for record in records)
    restraint = np.sqrt(variance) / _ranges(pilot, directions)
    position = _solve(information, restraint)
    return Recursion(
        pilot, free, directions, right * scale, restraint, information, position
    )


def _ranges(pilot: Realization, directions: Array) -> Array:
    """How far every coordinate may move before a pole leaves its neighbourhood."""
    assert pilot.blocks is not None
    speed = np.full(directions.shape[1], _SLOWEST)
    parts = block_parts(pilot, len(directions))
    for block, part in zip(pilot.blocks, parts, strict=True):
        change = directions[part]
        margin = 1.0 - np.abs(np.linalg.eigvals(block)).max()
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
    """Model at the present position.

    Returns
    -------
    Realization
        Its loss is the sum of squared errors of the linearised problem.
    """
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

    Parameters
    ----------
    recursion : Recursion
    A : ndarray of shape (order, order)
    C : ndarray of shape (n_outputs, order)
        In any state basis; near the model of the recursion.

    Returns
    -------
    Realization or None
        In the basis of the pilot model. None where ``(A, C)`` has no form with the
        pilot's blocks.
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
    sizes = [len(block) for block in pilot.blocks]
    stops = np.cumsum(sizes)
    parts = [slice(k - size, k) for k, size in zip(stops, sizes, strict=True)]
    coupled = linalg.block_diag(*(np.ones((size, size)) for size in sizes)) == 0.0
    T = linalg.lstsq(_observability(A, C), _observability(pilot.A, pilot.C))[0]
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


def _observability(A: Array, C: Array) -> Array:
    """Extended observability matrix, of twice the order."""
    rows = [C]
    for _ in range(2 * len(A) - 1):
        rows.append(rows[-1] @ A)
    return np.vstack(rows)


def extend_recursion(
    recursion: Recursion,
    record: Record,
    *,
    starts: bool,
    point: Realization | None = None,
) -> tuple[Recursion, Array]:
    """Add a stretch of data, linearised at the present model.

    Parameters
    ----------
    recursion : Recursion
    record : Record
        Scaled as the pilot's data.
    starts : bool
        Whether an experiment begins with it.
    point : Realization, default=None
        Another model to linearise at, from `input_matrices`.

    Returns
    -------
    recursion : Recursion
        Unchanged where the responses overflow.
    initial_state : ndarray of shape (order,)
        Of the stretch.
    """
    if point is None:
        model, position = current_model(recursion), recursion.position
    else:
        model = point
        step = change_between(recursion.pilot, point, recursion.free)
        position = recursion.coordinates @ step
    assert model.blocks is not None
    free = freedom_of_stretch(recursion.free, starts)
    # A linearisation point for the initial state; the stretch corrects it.
    head = Record(record.u[:, :_HEAD], record.y[:, :_HEAD])
    loss, x0 = stretch_error(model, head, free)
    if not np.isfinite(loss):
        return recursion, x0
    driven = np.column_stack([x0, model.B])
    state_map = state_coefficients(model.blocks, driven)
    R = signal_factor(model.blocks, record, state_map)
    if R is None:
        return recursion, x0
    around = Point(model.C, model.D, driven)
    M = jacobian_regression(R, model.blocks, around, free)
    M = project_out(M, n_own(len(model.A), free))
    J = M[:, :-1] @ recursion.directions
    rows = np.column_stack([J, M[:, -1] + J @ position])
    information = _triangle(np.vstack([recursion.information, rows]))
    position = _solve(information, recursion.restraint)
    return recursion._replace(information=information, position=position), x0


def freedom_of_stretch(free: Freedom, starts: bool) -> Freedom:
    """What continues an experiment does not start from rest."""
    return free if starts else free._replace(initial_states=True)


def stretch_error(
    model: Realization, record: Record, free: Freedom
) -> tuple[float, Array]:
    """Simulation error of a stretch with the best initial state.

    Parameters
    ----------
    model : Realization
        In section form.
    record : Record
    free : Freedom

    Returns
    -------
    loss : float
        Sum of squares; infinite where the responses overflow.
    initial_state : ndarray of shape (order,)
    """
    assert model.blocks is not None
    n, own = len(model.A), n_own(len(model.A), free)
    R = signal_factor(model.blocks, record)
    if R is None:
        return np.inf, np.zeros(n)
    M = linear_regression(R, model.blocks, model.C, free)
    known = np.concatenate([model.B.ravel(), model.D[free.direct]])
    error = M[:, -1] - M[:, own:-1] @ known
    x0 = scaled_lstsq(M[:, :own], error)[0]
    error -= M[:, :own] @ x0
    return float(error @ error), x0 if own else np.zeros(n)
