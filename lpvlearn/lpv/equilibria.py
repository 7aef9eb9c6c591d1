"""Points of work of local models: inputs, outputs and states at rest, of one family.

Experiments at a point tell an equilibrium (u0, y0) of its model, or as well any other
one, (u0 + v, y0 + G v) with the static gain G. They do not tell the state x0 there,
which matters while kappa moves. What moves outputs at rest is taken to come through
inputs, ``w = u0 - P y0`` with ``P = G^-1``; then ``x0 = S y0`` with ``S = -A^-1 B P``.
(P is a pseudoinverse without the directions in which G is next to nothing; what it does
not reach stays an offset of the sensors. Inputs of which the outputs tell nothing, ``(I
- P G) u0``, are what they are, and add to x0.) Which family do the points make?

- They follow one another by the models' own gain, ``du0 = P dy0``: they are equilibria
  of one system that schedules itself, and ``A dx0 + B du0 = 0`` along them. So
  ``dx0 = S dy0``, from neighbour to neighbour, whatever basis these share.
- They do not: inputs are free at every point. Constants ``c = y0 - G u0`` that are the
  same everywhere are the sensors', ``x0 = S (y0 - c)``. Where w is the same, too, that
  is taken by which there is less to hold.

Where inputs stand about one level, all points are moved to one u0: what differs at
random would bend the interpolation.

Models that integrate are at rest at any output, and their inputs are constants then.

Between the points the equilibria follow from what is interpolated of them. Where they
bend more than the models do (a drive, whose currents at rest are rational in a speed
that its equations have as it is), that had better be the constants in ``dx/dt = A x + B
u + c``, ``y = C x + D u + d``: of those that tell left-out points better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from ..models.statespace import StateSpace
from .alignment import spanning_tree
from .weighting import inner_places

Array = NDArray[np.float64]

# Static gain, from motions of the inputs to those of the outputs, that is nothing.
_STATIC = 0.01

# Part of the steps from point to point, squared, that the models' gain may not explain
# of equilibria of one system, and that equal constants may not of the constants.
_UNEXPLAINED = 0.1

# Misfit of constants of the inputs, in that of constants of the sensors, that decides.
_CLEAR = 10.0

# Squared errors at points left out, relative, from which constants tell them better,
# the fewest points for that, and places between points that equilibria are taken at
_BETTER, _FEWEST, _BETWEEN = 0.25, 5, 8
_BENT = 1e-4  # mean square of such an error, by the motion, that is worth it

# Variance of the levels of inputs over the points, in that of their motion: none. And
# how far, in that of the outputs, a gain that is known takes them to a common one.
_STANDING, _FAR = 0.1, 3.0


def points_of_work(
    models: Sequence[StateSpace],
    kappa: Array,
    inputs: Array,
    outputs: Array,
    scales: tuple[Array, Array],
) -> Array:
    """``[u0, y0, x0]`` of models, (n_points, n_inputs + n_outputs + order).

    From equilibria, `inputs` (n_points, n_inputs) and `outputs` (n_points, n_outputs);
    `scales` are the sizes of the motions of inputs and outputs.

    Examples
    --------
    A tank, ``h' = u - sqrt(h)``, at two levels:

    >>> import numpy as np
    >>> h = np.array([[1.0], [4.0]])
    >>> tanks = [StateSpace(-0.5 / np.sqrt(level), 1.0, 1.0) for level in h]
    >>> one = (np.ones(1), np.ones(1))
    >>> points_of_work(tanks, h, np.sqrt(h), h, one)
    array([[1., 1., 1.],
           [2., 4., 4.]])
    """
    u_scale, y_scale = scales
    if _any_integrates(models):
        found = zip(models, inputs, outputs, strict=True)
        x0 = np.array([_state_at_rest(*point, scales) for point in found])
        return np.hstack([inputs, outputs, x0])
    gains = np.array([model.dc_gain() for model in models])
    inverse = _inverse(gains * u_scale / y_scale[:, None])
    inverse *= u_scale[:, None] / y_scale
    moved_states = -np.array([np.linalg.solve(m.A, m.B) for m in models])
    states, seen = moved_states @ inverse, inverse @ gains
    unseen = moved_states @ (np.eye(len(u_scale)) - seen)
    if np.sum(np.var(inputs / u_scale, axis=0)) <= _STANDING:
        common = np.broadcast_to(inputs.mean(axis=0), inputs.shape)
        change = _times(gains, common - inputs)
        # what hardly settles rests nearly anywhere, and by its gain anywhere else
        far = np.any(np.abs(change) > _FAR * y_scale, axis=1)
        outputs = outputs + np.where(far[:, None], 0.0, change)
        inputs = common
    order, parents = spanning_tree(kappa)
    child, parent = order[1:], parents[order[1:]]
    du, dy = inputs[child] - inputs[parent], outputs[child] - outputs[parent]
    asked = _times(0.5 * (seen[child] + seen[parent]), du) / u_scale
    answer = _times(0.5 * (inverse[child] + inverse[parent]), dy) / u_scale
    moved = np.sum(asked**2) + np.sum(answer**2)
    if asked.any() and np.sum((asked - answer) ** 2) <= _UNEXPLAINED * moved:
        x0 = _times(states, outputs) + _times(unseen, inputs)
        for k, j, step, of_input in zip(child, parent, dy, du, strict=True):
            x0[k] = x0[j] + 0.5 * (states[k] + states[j]) @ step
            x0[k] += 0.5 * (unseen[k] + unseen[j]) @ of_input
        return np.hstack([inputs, outputs, x0])
    bias = _constants_of_sensors(inputs, outputs, gains, inverse, u_scale)
    x0 = _times(states, outputs - bias) + _times(unseen, inputs)
    return np.hstack([inputs, outputs, x0])


def _any_integrates(models: Sequence[StateSpace]) -> bool:
    return any(m.order and np.linalg.matrix_rank(m.A) < m.order for m in models)


def interpolated(
    spline: Callable[[], Any],
    kappa: Array,
    values: Array,
    model_at: Callable[[Array], StateSpace],
    y_scale: Array,
) -> Any:
    """The `values` of points of work over `kappa`, by themselves or their constants.

    As the regressors that `spline` makes; `model_at` gives the frozen model at
    scheduling values (n_scheduling,), `y_scale` is the size of the motion of outputs.
    """
    by_themselves = spline().fit(kappa, values)
    if kappa.shape[1] > 1 or len(kappa) < _FEWEST:
        return by_themselves
    models = [model_at(k) for k in kappa]
    if _any_integrates(models):
        return by_themselves
    work = [_Work.of(*one) for one in zip(models, values, strict=True)]
    constants = np.array(
        [point.constants(m) for point, m in zip(work, models, strict=True)]
    )
    errors = []  # of outputs at rest at points that the others foresee
    for out in inner_places(kappa):
        k = int(out.argmax())
        kept = [spline().fit(kappa[~out], v[~out]) for v in (values, constants)]
        point, rest = (one.predict(kappa[[k]])[0] for one in kept)
        there = _Work.of(models[k], point)
        moved = there.y + models[k].dc_gain() @ (work[k].u - there.u)
        both = moved, _Work.resting(models[k], work[k].u, rest).y
        errors.append([(y - work[k].y) / y_scale for y in both])
    own, by_constants = np.mean(np.square(errors), axis=(0, 2))
    if not (own > _BENT and by_constants < _BETTER * own):
        return by_themselves
    places = np.sort(kappa[:, 0])
    fine = np.interp(
        np.arange(_BETWEEN * (len(places) - 1) + 1) / _BETWEEN,
        np.arange(len(places)),
        places,
    )[:, None]
    c = spline().fit(kappa, constants).predict(fine)
    u = by_themselves.predict(fine)[:, : models[0].n_inputs]
    found = [
        np.concatenate(_Work.resting(model_at(k), *known))
        for k, *known in zip(fine, u, c, strict=True)
    ]
    return spline().fit(fine, np.array(found))


class _Work(NamedTuple):
    """A point of work."""

    u: Array
    y: Array
    x: Array

    @classmethod
    def of(cls, model: StateSpace, values: Array) -> _Work:
        """From ``[u0, y0, x0]``."""
        m = model.n_inputs
        return cls(*np.split(values, [m, m + model.n_outputs]))

    @classmethod
    def resting(cls, model: StateSpace, u: Array, constants: Array) -> _Work:
        """Where a model rests with the input `u`: ``A x + B u + c = 0``."""
        c, d = np.split(constants, [model.order])
        x = -np.asarray(np.linalg.solve(model.A, model.B @ u + c), float)
        return cls(u, model.C @ x + model.D @ u + d, x)

    def constants(self, model: StateSpace) -> Array:
        """``[c, d]`` with which the model rests there."""
        c = -model.A @ self.x - model.B @ self.u
        return np.concatenate([c, self.y - model.C @ self.x - model.D @ self.u])


def _state_at_rest(
    model: StateSpace, u0: Array, y0: Array, scales: tuple[Array, Array]
) -> Array:
    """The state at rest with an output, of all inputs the nearest to `u0`."""
    u_scale, y_scale = scales
    n = model.order
    rest = null_space(np.hstack([model.A, model.B]))  # states and inputs
    to_output = np.hstack([model.C, model.D]) @ rest / y_scale[:, None]
    to_input = _STATIC * rest[n:] / u_scale[:, None]
    wanted = np.concatenate([y0 / y_scale, _STATIC * u0 / u_scale])
    z = np.linalg.lstsq(np.vstack([to_output, to_input]), wanted, rcond=None)[0]
    return np.asarray(rest[:n] @ z)


def _times(matrices: Array, vectors: Array) -> Array:
    """Products of matrices and vectors, point by point."""
    return np.asarray(np.einsum("kij,kj->ki", matrices, vectors))


def _constants_of_sensors(
    inputs: Array, outputs: Array, gains: Array, inverse: Array, u_scale: Array
) -> Array:
    """Constants (n_outputs,) that the outputs of all points have; zero for none."""

    def size(values: Array, about: float = 0.0) -> float:
        """Of outputs, by the inputs that they are worth."""
        worth = _times(inverse, values) / u_scale
        return float(np.sum((worth - np.mean(worth, axis=0) * about) ** 2))

    constants = outputs - _times(gains, inputs)
    bias = constants.mean(axis=0)
    of_sensors, of_inputs = size(constants - bias), size(constants, about=1.0)
    if min(of_sensors, of_inputs) > _UNEXPLAINED * size(constants):
        return np.zeros_like(bias)
    found = of_sensors < of_inputs / _CLEAR
    if not found and of_sensors < of_inputs * _CLEAR:  # either: what has less to hold
        found = size(outputs - bias) < size(outputs)
    return bias if found else np.zeros_like(bias)


def _inverse(gains: Array) -> Array:
    """Pseudoinverses of scaled gains, (n_points, n_inputs, n_outputs)."""
    U, s, V = np.linalg.svd(gains, full_matrices=False)
    s = np.where(s > _STATIC, 1.0 / np.maximum(s, _STATIC), 0.0)
    return np.asarray((V.mT * s[:, None]) @ U.mT)
