"""Black boxes of the operating points in one basis: their entries are the parameters.

Without a structure nothing tells which states the points have in common. What tells how
good a choice of them is: whether a point is foreseen by the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..exceptions import warn
from ..lpv.alignment import STATES, aligned_models
from ..lpv.spline import SplineLPV
from ..models.statespace import StateSpace, with_signs_of
from ..structures.structure import GrayBoxStructure
from ..validation import listed
from .left_out import errors_left_out, largest_difference
from .local_models import LocalModel
from .runner import place_of

Array = NDArray[np.float64]

# Errors of points left out, in the largest gain: all are foreseen; one is as unlike the
# others as may be; and the share of the error that other states must leave
_FORESEEN, _UNLIKE, _CLEARLY = 0.01, 2.0, 0.8

# Of points whose records do not tell all states: the share of the errors of the others
# that is left without them, and the error of what these foresee, for which it is taken
_RELIEF, _NEAR = 0.5, 0.1

# Change of a response, in its largest gain, by another order than a record takes, from
# which it is told; operating points that a message lists
_FORCED, _NAMED = 0.5, 3


def aligned_black_boxes(
    local: Sequence[LocalModel], kappa: Array
) -> tuple[GrayBoxStructure, Array]:
    """Entries of the models of all points in the states that are foreseen best.

    With what the other points foresee where the record of one does not tell its states.
    Warns of points whose own records speak for another order.
    """
    models = [balanced(model) for model in local]
    fewer = [
        k
        for k, model in enumerate(local)
        if model.own is not None and model.own.order < model.order
    ]
    told = _foretold(local, models, fewer, kappa) if fewer else None
    tell_of_forced(local, kappa, fewer if told is not None else ())
    if told is None:
        told = _foreseeable(_of_one_order(models), kappa).theta
    return _full(models, local[0].integrating), told


def balanced_entries(
    models: Sequence[StateSpace], integrating: Sequence[int] = ()
) -> tuple[GrayBoxStructure, Array]:
    """Entries of balanced models, their signs aligned along the points.

    The baseline of the paper, of no common state basis. Outputs `integrating` are
    integrals of those of the models.
    """
    aligned = list(accumulate(_of_one_order(models), with_signs_of))
    return _full(aligned, integrating), _entries(aligned)


def balanced(local: LocalModel) -> StateSpace:
    """The local model, balanced: that of the rates of outputs that integrate.

    Its derivatives do not see the states on which nothing else depends, ``A v = 0``.
    Poles on the negative real axis make the order grow in continuous time.
    """
    model, integrating = local.lti, local.integrating
    C, D = model.C.copy(), model.D.copy()
    C[integrating], D[integrating] = C[integrating] @ model.A, C[integrating] @ model.B
    n = model.order - len(integrating)
    seen = np.linalg.svd(model.A)[2][:n].T
    A, B = seen.T @ model.A @ seen, seen.T @ model.B
    rates = StateSpace(A, B, C @ seen, D, input_delay=model.input_delay)
    return rates.balance(min(local.order - len(integrating), n))


class _Foreseeable(NamedTuple):
    """Entries of models (n_points, n_entries), and errors of points left out."""

    theta: Array
    errors: dict[int, float]  # by points within the range of the others

    def mean(self, points: Sequence[int] | None = None) -> float:
        """Of some points, or all; what is worse than no model counts as that."""
        known = self.errors if points is None else self.errors.keys() & set(points)
        errors = [min(self.errors[k], _UNLIKE) for k in known]
        return float(np.mean(errors)) if errors else 0.0


def _foreseeable(models: Sequence[StateSpace], kappa: Array) -> _Foreseeable:
    """In balanced states, or in others in which points are foreseen clearly better.

    By an interpolation of the others. What states do while the scheduling moves no
    point tells, and there balanced ones are as good a guess.
    """
    structure = _full(models)
    best, least = None, np.inf
    for states in STATES:
        theta = _entries(aligned_models(models, kappa, states))
        errors = errors_left_out(structure, models, SplineLPV(), kappa, theta)
        found = _Foreseeable(theta, errors)
        if best is None or found.mean() < least:
            best, least = found, (_CLEARLY if best is None else 1.0) * found.mean()
        if best.mean() < _FORESEEN:
            break
    assert best is not None
    return best


def _foretold(
    local: Sequence[LocalModel],
    models: Sequence[StateSpace],
    fewer: Sequence[int],
    kappa: Array,
) -> Array | None:
    """Entries with those that the others foresee where states are noise; None if none.

    A record tells `fewer` states where a mode vanishes at a point, say; what the model
    of the common order has beyond these may be anything, and spoils what is
    interpolated. What the others foresee is taken where they foresee one another better
    without these points, and what their records tell as well.
    """
    some = [k for k in range(len(models)) if k not in fewer]
    rest = [models[k] for k in some]
    if len({model.order for model in rest}) != 1:
        return None
    alone, before = _foreseeable(rest, kappa[some]), _UNLIKE
    if len({model.order for model in models}) == 1:
        before = _foreseeable(models, kappa).mean(some)
    if not alone.errors or alone.mean() >= _RELIEF * before:
        return None
    theta = SplineLPV().fit(kappa[some], alone.theta).predict(kappa)
    theta[some] = alone.theta
    unlike = {k: _unlike(_full(rest).model(theta[k]), local[k]) for k in fewer}
    worst = max(unlike.values())
    names = listed([place_of(k, kappa) for k in fewer], _NAMED)
    told = (
        f"the record tells fewer states than those of the other points at {names}, as "
        "where a mode vanishes: what is identified of the others there is noise. "
    )
    if worst < _NEAR:
        warn(
            f"{told}The LPV model takes what the other points foresee there instead: "
            f"within {100.0 * worst:.2g} % of the largest gain it is what the record "
            "does tell. Give a structure, or a lower order: "
            "local=SubspaceLTI(order=...)."
        )
        return theta
    warn(
        f"{told}The LPV model may be wrong from there to the next points, which "
        "foresee one another better without. Record for longer there, leave the point "
        "out, give a structure, or a lower order: local=SubspaceLTI(order=...)."
    )
    return None


def _unlike(foreseen: StateSpace, local: LocalModel) -> float:
    """How far it is from what the record of a point tells, in the largest gain."""
    own = local.own
    if own is None or not foreseen.is_stable:
        return np.inf
    return largest_difference(foreseen, balanced(own))


def tell_of_forced(
    local: Sequence[LocalModel], kappa: Array, mended: Sequence[int] = ()
) -> None:
    """Warn of models of the common order that are not those of their own records.

    But for points that are `mended`.
    """
    forced = [
        f"{place_of(k, kappa)}: {100.0 * change:.0f} %"
        for k, model in enumerate(local)
        if model.own is not None
        and k not in mended
        and (change := largest_difference(model.lti, model.own.lti)) > _FORCED
    ]
    if forced:
        warn(
            f"with the order {local[0].order}, for which all points together speak, "
            "the model of a point is far from the one of the order that its own record "
            f"speaks for ({listed(forced, _NAMED)} of the largest gain): that record "
            "does not tell so many states, and the LPV model may be wrong there and up "
            "to the next points. Record for longer there, leave the point out, or give "
            "a lower order: local=SubspaceLTI(order=...)."
        )


def _of_one_order(models: Sequence[StateSpace]) -> Sequence[StateSpace]:
    orders = sorted({model.order for model in models})
    if len(orders) > 1:
        raise ValueError(
            "`local` must give models of one order, whose matrices are interpolated "
            f"without a structure. Got orders {orders} of what inputs move and outputs "
            f"show. Ask for the least: local=SubspaceLTI(order={orders[0]})."
        )
    return models


def _full(
    models: Sequence[StateSpace], integrating: Sequence[int] = ()
) -> GrayBoxStructure:
    first, direct = models[0], any(model.D.any() for model in models)
    sizes = first.order, first.n_inputs, first.n_outputs
    return GrayBoxStructure.full(*sizes, direct, integrating)


def _entries(models: Sequence[StateSpace]) -> Array:
    names = "ABCD" if any(model.D.any() for model in models) else "ABC"
    rows = [np.concatenate([getattr(m, M).ravel() for M in names]) for m in models]
    return np.array(rows)
