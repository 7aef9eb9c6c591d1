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
  ``dx0 = S dy0``, from neighbour to neighbour, whatever basis these share. Where G
  changes its sign (a plant with an optimum), P has a pole between the points. Then, if
  no one constant of the sensors explains them, it is ``dy0 = G du0`` that tells them,
  and ``dx0 = -A^-1 B du0``.
- They do not: inputs are free at every point. Constants ``c = y0 - G u0`` that are the
  same everywhere are the sensors', ``x0 = S (y0 - c)``. Where w is the same, too, that
  is taken by which there is less to hold. Of ``x0 = S (y0 - m) + S (m - c)``, with the
  mean m of the outputs, the second part is S, which parameters tell, times what may be
  hundreds of motions (a set point held at all flows). Where points left out are not
  foreseen better than by its mean, it is noise, and its mean is taken. So it is of
  black boxes, whose basis may turn from point to point, where outputs stand about one
  level.

Outputs that measure all states, by one C at all points and hardly a D, tell x0
themselves, whatever it is that holds it there (a source, a feed, that is no input):
``C x0 = y0 - D u0``, but for what is the same at all points and moves no state.

Where inputs stand about one level, all points are moved to one u0: what differs at
random would bend the interpolation.

Models that integrate are at rest at any output, and their inputs are constants then.

Between the points the equilibria follow from what is interpolated of them. Where that
tells left-out points clearly better, it is not themselves:

- Where they bend more than the models do (a drive, whose currents at rest are rational
  in a speed that its equations have as it is), the constants in ``dx/dt = A x + B u +
  c``, ``y = C x + D u + d``.
- Where the sensors have one constant at all points, what the models answer to the
  inputs at rest.
- Where they bend less over the logarithm of the scheduling variable, or over one over
  it (a flow, a speed), these.
- Where inputs do over their own logarithm, or over one over them (a valve that nearly
  saturates), these.
- Where they are those of one system that schedules itself (levels of a tank), a curve
  with the slopes that the models' gains tell: ``du0 = P dy0``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.linalg import null_space

from ..exceptions import warn
from ..models.statespace import StateSpace
from ..systems.balancing import gramian_factor
from .alignment import spanning_tree
from .left_out import inner_places

Array = NDArray[np.float64]

# What is at rest at scheduling values, of the frozen model there; how points tell it
_AtRest: TypeAlias = "Callable[[Array, StateSpace], _Work]"
_Way: TypeAlias = "Callable[[_Points], _AtRest]"
_Pair: TypeAlias = "tuple[Callable[[Array], Array], Callable[[Array], Array]]"

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

_ROUNDING = 1e-9  # of matrices that are the same
_AT_ONCE = 0.1  # of the outputs' motion: what inputs do at once that hardly matters

# Scheduling values of which there are logarithms and inverses
_POSITIVE = 1e-100

# Places from which a line tells more than the mean of those that it goes through
_TOLD_APART = 3

# Of the static gain between points: the part that it is seldom nearer than, which is of
# inputs that are missed what outputs are missed by, whatever these make up for.
_GAIN = 0.1

# Motions by which the output at rest of a point is missed that are told
_MISSED = 1.0

# Range of constants of sensors over the points that are one, by that of the outputs
_SAME_CONSTANT = 0.05

# Variance of the levels of inputs over the points, in that of their motion: none. And
# how far, in that of the outputs, a gain that is known takes them to a common one.
STANDING, _FAR = 0.1, 3.0

# Variance of outputs at rest, in that of their motion, up to which all experiments move
# about one level of theirs
_HELD = 1.0


def points_of_work(
    models: Sequence[StateSpace],
    kappa: Array,
    inputs: Array,
    outputs: Array,
    scales: tuple[Array, Array],
    *,
    structured: bool = True,
) -> Array:
    """``[u0, y0, x0]`` of models, (n_points, n_inputs + n_outputs + order).

    From equilibria, `inputs` (n_points, n_inputs) and `outputs` (n_points, n_outputs);
    `scales` are the sizes of the motions of inputs and outputs. States of models that
    are not `structured` are those of a basis that may turn over kappa.

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
    statics = _Statics.of(models, scales)
    gains = statics.gains
    if np.sum(np.var(inputs / u_scale, axis=0)) <= STANDING:
        common = np.broadcast_to(inputs.mean(axis=0), inputs.shape)
        change = _times(gains, common - inputs)
        # what hardly settles rests nearly anywhere, and by its gain anywhere else
        far = np.any(np.abs(change) > _FAR * y_scale, axis=1)
        outputs = outputs + np.where(far[:, None], 0.0, change)
        inputs = common
    if _measure_all_states(models, scales):
        shown = outputs - _times(np.array([model.D for model in models]), inputs)
        C = models[0].C / y_scale[:, None]
        x0 = np.linalg.lstsq(C, (shown / y_scale).T)[0].T
        return np.hstack([inputs, outputs, x0])
    family = _Family.of(statics, kappa, inputs, outputs, scales)
    if family.is_one:
        x0 = statics.states_at_rest(inputs, outputs)
        ends = statics.of_points(family.child), statics.of_points(family.parent)
        if family.by_outputs:
            changes = [some.states_at_rest(family.du, family.dy) for some in ends]
        else:
            changes = [_times(some.moved, family.du) for some in ends]
        step = 0.5 * (changes[0] + changes[1])
        for k, j, change in zip(family.child, family.parent, step, strict=True):
            x0[k] = x0[j] + change
        return np.hstack([inputs, outputs, x0])
    bias = _bias_of_sensors(inputs, outputs, gains, statics.inverse, u_scale)
    x0 = statics.states_at_rest(inputs, outputs - bias)
    shown = _times(statics.moved @ statics.inverse, outputs - outputs.mean(axis=0))
    held = x0 - shown
    stand = np.all(np.var(outputs / y_scale, axis=0) <= _HELD)
    # a basis that turns moves what stands still, by how far it is from zero
    if (stand and not structured) or _are_one_state(held, models, kappa, y_scale):
        x0 = shown + held.mean(axis=0)
    return np.hstack([inputs, outputs, x0])


def _are_one_state(
    states: Array, models: Sequence[StateSpace], kappa: Array, y_scale: Array
) -> bool:
    """Whether states (n_points, order) are the same at all points, but for noise.

    Where no plain curve through the others foresees one clearly better than their mean
    does: by the outputs that follow from the errors. Not where models are unstable.
    """
    if len(np.unique(kappa, axis=0)) < _TOLD_APART:
        return False
    try:
        pairs = [(m.A.T, (m.C / y_scale[:, None]).T) for m in models]
        factors = np.array([gramian_factor(*pair, False).T for pair in pairs])
    except ValueError:
        return False

    def error(terms: Array) -> float:
        """Of points left out, of a linear form in `terms` (n_points, n_terms)."""
        left = np.eye(len(terms)) - terms @ np.linalg.pinv(terms)
        alone = np.diag(left)[:, None]
        if alone.min() < _ROUNDING:  # the others do not tell the form
            return np.inf
        return float(np.sum(_times(factors, left @ states / alone) ** 2))

    one = np.ones((len(kappa), 1))
    plain = [kappa - kappa.mean(axis=0)]
    if (kappa > _POSITIVE).all():
        plain += [np.log(kappa), 1.0 / kappa]
    curves = [np.hstack([one, x]) for x in plain]
    curves.append(np.hstack([one, plain[0], plain[0] ** 2]))
    return min(map(error, curves)) > _BETTER * error(one)


def _measure_all_states(
    models: Sequence[StateSpace], scales: tuple[Array, Array]
) -> bool:
    """Whether states follow from outputs, at all points in the same way.

    And inputs hardly act at once: with them, so would what comes in their place.
    """
    C, (u_scale, y_scale) = models[0].C, scales
    if not C.size:
        return False
    atol = _ROUNDING * np.abs(C).max()
    if not all(np.allclose(model.C, C, rtol=0.0, atol=atol) for model in models):
        return False
    direct = max(np.max(np.abs(m.D) * u_scale / y_scale[:, None]) for m in models)
    return bool(direct < _AT_ONCE and np.linalg.matrix_rank(C) == models[0].order)


class _Family(NamedTuple):
    """Whether points follow one another by their models' own gain.

    As their outputs tell, ``du0 = P dy0``, or as their inputs do, ``dy0 = G du0``,
    where a constant of the sensors does not tell as much.
    """

    child: NDArray[np.int32]  # (n_steps,): points after their `parent` in a tree
    parent: NDArray[np.int32]
    du: Array  # (n_steps, n_inputs): from the parent to the child
    dy: Array
    by_outputs: bool
    by_inputs: bool

    @classmethod
    def of(
        cls,
        statics: _Statics,
        kappa: Array,
        inputs: Array,
        outputs: Array,
        scales: tuple[Array, Array],
    ) -> _Family:
        """Of equilibria; `scales` are the sizes of the motions."""
        order, parents = spanning_tree(kappa)
        child, parent = order[1:], parents[order[1:]]
        du, dy = inputs[child] - inputs[parent], outputs[child] - outputs[parent]

        def between(matrices: Array) -> Array:
            return np.asarray(0.5 * (matrices[child] + matrices[parent]))

        def explained(asked: Array, answer: Array) -> bool:
            moved = np.sum(asked**2) + np.sum(answer**2)
            left = np.sum((asked - answer) ** 2)
            return bool(asked.any() and left <= _UNEXPLAINED * moved)

        gains, inverse = statics.gains, statics.inverse
        u_scale, y_scale = scales
        asked = _times(between(inverse @ gains), du) / u_scale
        answer = _times(between(inverse), dy) / u_scale
        moved = _times(between(gains), du) / y_scale
        by_inputs = explained(moved, dy / y_scale)
        if by_inputs:
            constants = outputs - _times(gains, inputs)
            by_inputs = not _are_one(constants, outputs, y_scale)
        return cls(child, parent, du, dy, explained(asked, answer), by_inputs)

    @property
    def is_one(self) -> bool:
        """By either."""
        return self.by_outputs or self.by_inputs


def _are_one(constants: Array, outputs: Array, y_scale: Array) -> bool:
    """Whether constants of sensors are the same at all points."""
    c, y = (float(np.max(np.ptp(x, axis=0) / y_scale)) for x in (constants, outputs))
    return c < _SAME_CONSTANT * y


def _any_integrates(models: Sequence[StateSpace]) -> bool:
    return any(m.order and np.linalg.matrix_rank(m.A) < m.order for m in models)


def interpolated(
    spline: Callable[[], Any],
    kappa: Array,
    values: Array,
    model_at: Callable[[Array], StateSpace],
    scales: tuple[Array, Array],
    *,
    tell: bool = False,
) -> Any:
    """The `values` of points of work over `kappa`: as they are, or by their models.

    As the regressors that `spline` makes; `model_at` gives the frozen model at
    scheduling values (n_scheduling,), `scales` are the sizes of the motions of inputs
    and outputs. Points that the best way misses without them are told, if asked to.
    """
    by_themselves = spline().fit(kappa, values)
    if kappa.shape[1] > 1:
        return by_themselves
    models = [model_at(k) for k in kappa]
    if _any_integrates(models):
        return by_themselves
    points = _Points(kappa, values, models)
    # and the share of the errors of those before them that they may leave
    ways: list[tuple[_Way, float]] = [(partial(_over, _itself, spline), np.inf)]
    u, y = points.equilibria()
    distinct = len(np.unique(kappa)) == len(kappa)
    statics = _Statics.of(models, scales)
    family = _Family.of(statics, kappa, u, y, scales) if distinct else None
    if family is not None and family.is_one:
        straight = _bend(kappa, y / scales[1]) <= _bend(kappa, u / scales[0])
        of_outputs = family.by_outputs and straight
        ways.append((partial(_by_slopes, scales, of_outputs), 1.0))
    if points.have_one_constant(scales[1]):
        ways.append((partial(_by_one_constant, spline), _BETTER))
    if len(kappa) >= _FEWEST:
        ways.append((partial(_by_constants, spline), _BETTER))
    if (kappa > _POSITIVE).all():
        # what stays in a flow is held for as long as one over it
        ways += [(partial(_over, f, spline), _BETTER) for f in (np.log, np.reciprocal)]
    over = _straight_inputs(spline, kappa, u)
    if any(pair is not _ITSELF for pair in over):
        ways.append((partial(_by_straight_inputs, over, spline), _BETTER))
    best, least = ways[0][0], np.inf
    of_best: dict[int, Array] = {}
    for way, share in ways if tell or len(ways) > 1 else ():
        missed = _missed_at_rest(way, points, scales[1])
        error = float(np.mean(np.square([*missed.values()]))) if missed else 0.0
        if least > _BENT and error < share * least:
            best, least, of_best = way, error, missed
    if tell and of_best:
        _tell_missed(of_best, points, scales)
    if best is ways[0][0]:
        return by_themselves
    found = best(points)
    places = np.sort(kappa[:, 0])
    fine = np.interp(
        np.arange(_BETWEEN * (len(places) - 1) + 1) / _BETWEEN,
        np.arange(len(places)),
        places,
    )[:, None]
    rest = [np.concatenate(found(k, model_at(k))) for k in fine]
    return spline().fit(fine, np.array(rest))


class _Points(NamedTuple):
    """Points of work, and their models."""

    kappa: Array  # (n_points, 1)
    values: Array  # [u0, y0, x0]
    models: Sequence[StateSpace]

    def kept(self, rows: NDArray[np.intp]) -> _Points:
        """Those of some rows, in this order."""
        models = [self.models[k] for k in rows]
        return _Points(self.kappa[rows], self.values[rows], models)

    def equilibria(self) -> tuple[Array, Array]:
        """Inputs and outputs."""
        m, p = self.models[0].n_inputs, self.models[0].n_outputs
        return self.values[:, :m], self.values[:, m : m + p]

    def constants_of_sensors(self) -> Array:
        """Outputs less what the models answer to the inputs, (n_points, n_outputs)."""
        u, y = self.equilibria()
        return y - _times(np.array([model.dc_gain() for model in self.models]), u)

    def have_one_constant(self, y_scale: Array) -> bool:
        """Whether these are the same at all points, beside how outputs differ."""
        return _are_one(self.constants_of_sensors(), self.equilibria()[1], y_scale)


def _missed_at_rest(way: _Way, points: _Points, y_scale: Array) -> dict[int, Array]:
    """By points between others, the errors (n_outputs,) of outputs at rest without it.

    In motions. An equilibrium with other inputs is as good, up to what is not known of
    the gain.
    """
    errors = {}
    for out in inner_places(points.kappa):
        k = int(out.argmax())
        model = points.models[k]
        known = _Work.of(model, points.values[k])
        there = way(points.kept(np.flatnonzero(~out)))(points.kappa[k], model)
        gain, change = model.dc_gain(), known.u - there.u
        error = there.y + gain @ change - known.y
        unknown = _GAIN**2 * gain**2 @ change**2
        errors[k] = np.sqrt(error**2 + unknown) / y_scale
    return errors


def _tell_missed(
    missed: dict[int, Array], points: _Points, scales: tuple[Array, Array]
) -> None:
    """Tell of the point whose output at rest is missed most.

    By what experiments move it, or would, if it settled: that may be far more.
    """
    u_scale, y_scale = scales
    settled = {
        k: points.models[k].dc_gain() * u_scale / y_scale[:, None] for k in missed
    }
    worth = {k: np.hypot(1.0, np.linalg.norm(settled[k], axis=1)) for k in missed}
    shares = {k: missed[k] / worth[k] for k in missed}
    k = max(shares, key=lambda k: float(shares[k].max()))
    i = int(shares[k].argmax())
    if shares[k][i] > _MISSED:
        names = points.models[k].output_names or range(1, len(y_scale) + 1)
        warn(
            "equilibria between the operating points are a guess: without point "
            f"{k} (scheduling {points.kappa[k, 0]:.4g}) the others miss output "
            f"{names[i]!r} at rest by {missed[k][i] * y_scale[i]:.3g}, where the "
            f"motion of the experiments is worth {worth[k][i] * y_scale[i]:.3g}. "
            "Measure in between (`suggest_operating_point`), or give a scheduling "
            "variable over which inputs and outputs at rest are smoother."
        )


def _by_one_constant(spline: Callable[[], Any], points: _Points) -> _AtRest:
    """What the models answer to the inputs, beside the constants of the sensors."""
    inputs = spline().fit(points.kappa, points.equilibria()[0])
    bias = points.constants_of_sensors().mean(axis=0)

    def at_rest(place: Array, model: StateSpace) -> _Work:
        u = inputs.predict([place])[0]
        return _Work.resting(model, u, np.concatenate([np.zeros(model.order), bias]))

    return at_rest


def _itself(values: Array) -> Array:
    return values


# Functions of what is positive, and from them to it: what saturates grows as one over
# what is left, what doubles from point to point is a power
_ITSELF: _Pair = _itself, _itself
_STRAIGHTER: tuple[_Pair, ...] = (np.log, np.exp), (np.reciprocal, np.reciprocal)


def _over(
    function: Callable[[Array], Array], spline: Callable[[], Any], points: _Points
) -> _AtRest:
    """A curve through the points over a function of the scheduling variable."""
    curve = spline().fit(function(points.kappa), points.values)

    def at_rest(place: Array, model: StateSpace) -> _Work:
        return _Work.of(model, curve.predict([function(place)])[0])

    return at_rest


def _straight_inputs(spline: Callable[[], Any], kappa: Array, u: Array) -> list[_Pair]:
    """Of every input, over what function its levels are foreseen best, if clearly."""

    def error(pair: _Pair, level: Array) -> float:
        function, back = pair
        errors = []
        for out in inner_places(kappa):
            curve = _within(spline, kappa[~out], function(level[~out]))
            errors.append(back(curve(kappa[out])) - level[out])
        return float(np.sum(np.square(np.concatenate(errors)))) if errors else 0.0

    found: list[_Pair] = []
    for level in u.T[..., None]:
        pair = _ITSELF
        if (level > _POSITIVE).all():
            errors = [error(other, level) for other in _STRAIGHTER]
            if min(errors) < _BETTER * error(pair, level):
                pair = _STRAIGHTER[int(np.argmin(errors))]
        found.append(pair)
    return found


def _within(
    spline: Callable[[], Any], kappa: Array, values: Array
) -> Callable[[Array], Array]:
    """A curve that stays in the range of its points: an inverse must not cross zero."""
    curve, ends = spline().fit(kappa, values), (values.min(axis=0), values.max(axis=0))
    return lambda places: np.clip(curve.predict(places), *ends)


def _by_straight_inputs(
    pairs: Sequence[_Pair], spline: Callable[[], Any], points: _Points
) -> _AtRest:
    """Curves through inputs over functions of theirs, and through the rest as it is."""
    curve = spline().fit(points.kappa, points.values)
    levels = zip(points.equilibria()[0].T[..., None], pairs, strict=True)
    inputs = [
        (k, back, _within(spline, points.kappa, function(level)))
        for k, (level, (function, back)) in enumerate(levels)
        if function is not _itself
    ]

    def at_rest(place: Array, model: StateSpace) -> _Work:
        values = curve.predict([place])[0]
        for k, back, level in inputs:
            values[k] = back(level(place[None]))[0, 0]
        return _Work.of(model, values)

    return at_rest


def _by_constants(spline: Callable[[], Any], points: _Points) -> _AtRest:
    """A curve through the constants with which the models rest there."""
    pairs = zip(points.models, points.values, strict=True)
    constants = np.array([_Work.of(*pair).constants(pair[0]) for pair in pairs])
    both = points.equilibria()[0], constants
    inputs, own = (spline().fit(points.kappa, values) for values in both)

    def at_rest(place: Array, model: StateSpace) -> _Work:
        u = inputs.predict([place])[0]
        return _Work.resting(model, u, own.predict([place])[0])

    return at_rest


def _by_slopes(
    scales: tuple[Array, Array], of_outputs: bool, points: _Points
) -> _AtRest:
    """A curve whose slopes are those of equilibria of one system, by its models.

    Those of the outputs, or of the inputs, are those of a curve through them; the
    others follow: ``du0 = P dy0``, ``dy0 = G du0``, ``A dx0 + B du0 = 0``.
    """
    points = points.kept(np.argsort(points.kappa[:, 0]))
    x = points.kappa[:, 0]
    statics = _Statics.of(points.models, scales)
    gains, inverse = statics.gains, statics.inverse
    u, y = (CubicSpline(x, values)(x, 1) for values in points.equilibria())
    if of_outputs:
        u = u + _times(inverse, y - _times(gains, u))
    else:
        y = y + _times(gains, u - _times(inverse, y))
    slopes = np.hstack([u, y, statics.states_at_rest(u, y)])
    curve = CubicHermiteSpline(x, points.values, slopes)
    return lambda place, model: _Work.of(model, curve(place[0]))


def _bend(kappa: Array, values: Array) -> float:
    """Part of the variance of values that no straight line over `kappa` explains."""
    line = np.column_stack([np.ones(len(kappa)), kappa])
    moved = values - values.mean(axis=0)
    left = moved - line @ np.linalg.lstsq(line, moved)[0]
    size = np.sum(moved**2)
    return float(np.sum(left**2) / size) if size else np.inf


class _Statics(NamedTuple):
    """Models at rest: gains G (n_points, n_outputs, n_inputs), and what follows."""

    gains: Array
    inverse: Array  # P, from outputs to the inputs that they show
    moved: Array  # -A^-1 B, from inputs to states

    @classmethod
    def of(cls, models: Sequence[StateSpace], scales: tuple[Array, Array]) -> _Statics:
        u_scale, y_scale = scales
        gains = np.array([model.dc_gain() for model in models])
        inverse = _inverse(gains * u_scale / y_scale[:, None])
        inverse *= u_scale[:, None] / y_scale
        moved = -np.array([np.linalg.solve(m.A, m.B) for m in models])
        return cls(gains, inverse, moved)

    def of_points(self, points: NDArray[np.int32]) -> _Statics:
        """Those of some points."""
        return _Statics(*(matrices[points] for matrices in self))

    def states_at_rest(self, u: Array, y: Array) -> Array:
        """Of outputs, S y, and of inputs by what these do not show of them."""
        unseen = u - _times(self.inverse, _times(self.gains, u))
        return _times(self.moved, _times(self.inverse, y) + unseen)


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


def _bias_of_sensors(
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
