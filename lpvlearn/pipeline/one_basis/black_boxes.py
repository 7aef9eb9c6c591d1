"""Black boxes of the operating points in one basis: their entries are the parameters.

Without a structure nothing tells which states the points have in common. What tells how
good a choice of them is: whether a point is foreseen by the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...exceptions import warn
from ...lpv.alignment import (
    OUTPUTS,
    STATES,
    aligned_models,
    show_all_states,
    spanning_tree,
)
from ...lpv.spline import SplineLPV
from ...models.statespace import StateSpace, forgetting, scaled, with_signs_of
from ...structures.structure import GrayBoxStructure
from ...validation import listed
from ..points.left_out import (
    NEAR,
    UNLIKE,
    changed,
    errors_left_out,
    forgotten,
    largest_difference,
)
from ..points.local_models import LocalModel
from ..running.runner import place_of

Array = NDArray[np.float64]

# Part of the fastest pole, and frequencies up to it, at which a model must be met that
# is to have fewer states.
_SLOWER, _N_SLOWER = 0.2, 40

# Error of points left out, in the largest gain, if all are foreseen; the shares of it
# that other states must leave, and that they must where outputs are states, which tell
# where these rest, or where they are fewer
_FORESEEN, _CLEARLY, _PLAINLY = 0.01, 0.8, 0.5

# Of points whose states may be noise: the share of the errors of the others that is
# left without them, and the error of what these foresee, for which it is taken
_RELIEF = 0.5

# Error of points left out, in the mean, from which fewer states are tried, so many of
# these further than the best
_UNFORESEEN, _FURTHER = 0.3, 2
_MANY = 12  # states, of which fewer are not tried

# An error of the others beside points whose records tell fewer states that is told
_SPOILT = 0.05

# Change of a response, in its largest gain, by another order than a record takes, from
# which it is told; operating points that a message lists
_FORCED, _NAMED = 0.5, 3


def aligned_black_boxes(
    local: Sequence[LocalModel], kappa: Array, u: Array, y: Array, longest: float
) -> tuple[GrayBoxStructure, Array]:
    """Entries of the models of all points in the states that are foreseen best.

    With what the other points foresee where the record of one does not tell its states.
    Warns of points whose own records speak for another order. Inputs and outputs count
    by how far they move, `u` and `y`, whatever their units. What decays in about the
    `longest` record (seconds) or later is `forgotten` while states are compared.
    """
    models, rate = _comparable(local, u, y, longest)
    fewer = _with_fewer_states(local)
    own = [
        model if one.own is None or k not in fewer else _seen(one.own, u, y, rate)
        for k, (one, model) in enumerate(zip(local, models, strict=True))
    ]
    theta, mended = _foretold(models, own, fewer, kappa)
    tell_of_forced(local, kappa, longest, mended)
    direct = _has_feedthrough(models)
    first = next(model for k, model in enumerate(models) if k not in mended)
    structure = _full(first, direct)
    rows = [
        scaled(forgetting(structure.model(row), -rate), 1.0 / u, 1.0 / y)
        for row in theta
    ]
    whole = _full(first, direct, local[0].integrating)
    return whole, _entries(rows, direct)


def _comparable(
    local: Sequence[LocalModel], u: Array, y: Array, longest: float
) -> tuple[list[StateSpace], float]:
    """The models as they are compared, and the rate at which states are forgotten."""
    models = [scaled(balanced(model), u, y) for model in local]
    rate = forgotten(models, longest)
    return [forgetting(model, rate).balance() for model in models], rate


def _seen(model: LocalModel, u: Array, y: Array, rate: float) -> StateSpace:
    """Another model in these units, its states forgotten at that rate."""
    return forgetting(scaled(balanced(model), u, y), rate)


def _with_fewer_states(local: Sequence[LocalModel]) -> list[int]:
    """Points whose own records tell fewer states than all together."""
    return [
        k
        for k, model in enumerate(local)
        if model.own is not None and model.own.order < model.order
    ]


def foreseen_order(
    local: Sequence[LocalModel],
    kappa: Array,
    u: Array,
    y: Array,
    longest: float,
    identified: Callable[[int], Sequence[LocalModel]],
) -> int | None:
    """A lower order, by which alone the points foresee one another; None for none.

    Where records speak for orders of their own, some of the states may be no dynamics:
    those of a resonance that is not linear, which many samples tell, differ from point
    to point, and an interpolation of them is anything. The models of a lower order
    (`identified` of it, none where they are not) are left out in turn as those of the
    common one are, and compared with what the records themselves tell. Arguments as of
    `aligned_black_boxes`; told. Of very many states, as dead times take, that is left:
    it would take minutes.
    """
    order = local[0].order_of_rates
    if order > _MANY or all(model.own is None for model in local):
        return None
    models, rate = _comparable(local, u, y, longest)
    every = range(len(models))
    truth = [
        model if one.own is None else _seen(one.own, u, y, rate)
        for one, model in zip(local, models, strict=True)
    ]

    def error(candidates: Sequence[StateSpace]) -> float:
        if len({model.order for model in candidates}) != 1:
            return np.inf
        theta = _foreseeable(candidates, kappa, every, (), every).theta
        structure = _full(candidates[0], _has_feedthrough(candidates))
        errors = errors_left_out(structure, truth, SplineLPV(), kappa, theta)
        return _Foreseeable(theta, errors).mean()

    common = error(models)
    poor = _with_fewer_states(local)
    rich = [k for k in every if k not in poor]
    if poor and len(rich) > 1 and len({models[k].order for k in rich}) == 1:
        # a mode may vanish at the others
        foreseen = _foreseeable(models, kappa, rich, truth, poor)
        common = min(common, foreseen.mean())
    if not common > _UNFORESEEN:
        return None
    best, least = 0, np.inf
    for lower in range(1, order):
        if best and lower > best + _FURTHER:
            break
        others = [_seen(model, u, y, rate).balance() for model in identified(lower)]
        found = error(others)
        if found < _CLEARLY * least:
            best, least = lower, found
    if not least < _PLAINLY * min(common, UNLIKE):
        return None
    warn(
        f"with the order {order}, for which the records speak, operating points do not "
        "foresee one another: left out, they are missed by "
        f"{100.0 * min(common, UNLIKE):.0f} % of the largest gain. Order {best} was "
        f"taken, by which that is {100.0 * least:.0f} %: states that points do not "
        "share may be those of a system that is not linear, and an interpolation of "
        "them is none. Use smaller inputs, or keep the order by "
        f"local=SubspaceLTI(order={order})."
    )
    return best


def balanced_entries(
    models: Sequence[StateSpace], integrating: Sequence[int] = ()
) -> tuple[GrayBoxStructure, Array]:
    """Entries of balanced models, their signs aligned along the points.

    The baseline of the paper, of no common state basis. Outputs `integrating` are
    integrals of those of the models.
    """
    aligned = list(accumulate(_of_one_order(models), with_signs_of))
    direct = _has_feedthrough(aligned)
    return _full(aligned[0], direct, integrating), _entries(aligned, direct)


def balanced(local: LocalModel) -> StateSpace:
    """The local model, balanced: that of the rates of outputs that integrate.

    Poles on the negative real axis make the order grow in continuous time: what the
    model is then without some states is the nearer one, in its slower part, of itself
    with fast states in their place, and of what balanced truncation leaves.
    """
    rates = of_rates(local.lti, local.integrating)
    order = local.order_of_rates
    if rates.order <= order:
        return rates.balance()
    ways = [rates.balance(order)]
    with_fast = _with_fast_states(rates, rates.order - order)
    if with_fast.order <= order:
        ways.append(with_fast.balance())
    omega = _SLOWER * np.abs(rates.poles()).max() * np.linspace(0.0, 1.0, _N_SLOWER)
    G = rates.frequency_response(omega)
    size = np.abs(G).max(axis=0)

    def error(model: StateSpace) -> float:
        left = np.abs(model.frequency_response(omega) - G).max(axis=0)
        return float((left / np.where(size > 0.0, size, 1.0)).max())

    return min(ways, key=error)


def _with_fast_states(model: StateSpace, n_pairs: int) -> StateSpace:
    """The model with a real state in the place of each of its fastest pairs of poles.

    Those at the Nyquist frequency, of a state that alternates from sample to sample:
    the real ones are as fast, and have the same static gain (of rank one, at best).
    """
    poles, L, V = linalg.eig(model.A, left=True)
    pairs = np.argsort(poles.imag)[::-1]
    pairs = pairs[: min(n_pairs, np.count_nonzero(poles.imag > 0.0))]
    L, V = L[:, pairs].conj().T, V[:, pairs]
    W = np.linalg.solve(L @ V, L)  # the other modes may be defective
    c, b = model.C @ V, W @ model.B
    kept = np.eye(model.order) - 2.0 * (V @ W).real
    U = np.linalg.svd(kept)[0][:, : model.order - 2 * len(pairs)]
    A, B, C = [U.T @ model.A @ U], [U.T @ kept @ model.B], [model.C @ U]
    for k, pole in enumerate(poles[pairs]):
        gain = -2.0 * np.real(np.outer(c[:, k], b[k]) / pole)
        left, size, right = np.linalg.svd(gain)
        A.append(np.array([[-np.abs(pole)]]))
        B.append(np.abs(pole) * size[0] * right[:1])
        C.append(left[:, :1])
    matrices = linalg.block_diag(*A), np.vstack(B), np.hstack(C), model.D
    return StateSpace(*matrices, input_delay=model.input_delay)


def of_rates(model: StateSpace, integrating: Sequence[int]) -> StateSpace:
    """The model of the rates of outputs that integrate, and of the others.

    Its derivatives do not see the states on which nothing else depends, ``A v = 0``.
    """
    if not integrating:
        return model
    C, D = model.C.copy(), model.D.copy()
    C[integrating], D[integrating] = C[integrating] @ model.A, C[integrating] @ model.B
    n = model.order - len(integrating)
    seen = np.linalg.svd(model.A)[2][:n].T
    A, B = seen.T @ model.A @ seen, seen.T @ model.B
    return StateSpace(A, B, C @ seen, D, input_delay=model.input_delay)


class _Foreseeable(NamedTuple):
    """Entries of models (n_points, n_entries), and how well points are foreseen."""

    theta: Array
    errors: dict[int, float]  # by points that the others can foresee

    def mean(self, points: Sequence[int] | None = None) -> float:
        """Of some points, or all; what is worse than no model counts as that."""
        known = [k for k in self.errors if points is None or k in points]
        errors = [min(self.errors[k], UNLIKE) for k in known]
        return float(np.mean(errors)) if errors else 0.0


def _foreseeable(
    models: Sequence[StateSpace],
    kappa: Array,
    some: Sequence[int],
    own: Sequence[StateSpace],
    judges: Sequence[int],
) -> _Foreseeable:
    """Of `some` points, in states in which they foresee the `judges` best.

    Of the other points what their `own` models tell, of themselves one left out at a
    time; by interpolation. States other than the outputs, where these show them all, or
    than balanced ones must be clearly better: what they do while the scheduling moves
    no point tells, but that outputs do not jump.
    """
    rest, places = [models[k] for k in some], kappa[list(some)]
    others = [k for k in range(len(models)) if k not in some]
    direct = _has_feedthrough(models)
    structure = _full(rest[0], direct)
    best, least = None, np.inf
    for states in (OUTPUTS, *STATES) if show_all_states(rest) else STATES:
        known = _entries(aligned_models(rest, places, states), direct)
        left_out = errors_left_out(structure, rest, SplineLPV(), places, known)
        theta = known
        errors = {some[k]: error for k, error in left_out.items()}
        if others:
            theta = SplineLPV().fit(places, known).predict(kappa)
            theta[list(some)] = known
        for k in others:
            model = structure.model(theta[k])
            errors[k] = largest_difference(model, own[k]) if model.is_stable else np.inf
        found = _Foreseeable(theta, errors)
        error = found.mean(judges)
        if best is None or error < least:
            best = found
            least = error * (_PLAINLY if states == OUTPUTS else _CLEARLY)
        if error < _FORESEEN:
            break
    assert best is not None
    return best


def _foretold(
    models: Sequence[StateSpace],
    own: Sequence[StateSpace],
    fewer: Sequence[int],
    kappa: Array,
) -> tuple[Array, Sequence[int]]:
    """Entries with those that the others foresee where states are noise, and where.

    A record tells `fewer` states where a mode vanishes at a point, say; what the model
    of the common order has beyond them may be anything, and spoils what is
    interpolated. What the others foresee is taken where it is what the record does
    tell, of which `own` are the models. Where nobody asked how many states a record
    tells, the others must foresee one another much better without the point, too.
    """
    every = range(len(models))
    some = [k for k in every if k not in fewer]
    whole, judged = None, False
    if len({model.order for model in models}) == 1:
        whole = _foreseeable(models, kappa, every, own, some)
        judged = any(k in whole.errors for k in some)
        if judged and whole.mean(some) < _FORESEEN:
            return whole.theta, ()
    doubted = fewer
    for group in [fewer] if fewer else _suspects(whole, kappa):
        rest = [k for k in every if k not in group]
        if len(rest) < 2 or len({models[k].order for k in rest}) != 1:
            continue
        alone = _foreseeable(models, kappa, rest, own, group)
        if group is not fewer and not _relieved(alone, whole, rest):
            continue
        worst = max(alone.errors[k] for k in group)
        names = listed([place_of(k, kappa) for k in group], _NAMED)
        if worst < NEAR:
            warn(
                f"the record at {names} does not tell all states of the other points, "
                "as where a mode vanishes: what is identified of these there is noise. "
                "The LPV model takes what the other points foresee there instead: "
                f"within {100.0 * worst:.2g} % of the largest gain it is what the "
                "record does tell. Give a structure, or a lower order: "
                "local=SubspaceLTI(order=...)."
            )
            return alone.theta, group
        doubted = doubted or group
    if doubted and (whole is None or not judged or whole.mean(some) > _SPOILT):
        names = listed([place_of(k, kappa) for k in doubted], _NAMED)
        warn(
            f"the record at {names} tells fewer states than those of the other points, "
            "as where a mode vanishes: what is identified of these there is noise, and "
            "the LPV model may be wrong from there to the next points. Record for "
            "longer there, leave the point out, give a structure, or a lower order: "
            "local=SubspaceLTI(order=...)."
        )
    if whole is None:
        _of_one_order(models)
    assert whole is not None
    return whole.theta, ()


def _relieved(
    alone: _Foreseeable, whole: _Foreseeable | None, rest: Sequence[int]
) -> bool:
    """Whether points foresee one another much better than beside those left out."""
    inner = [k for k in rest if k in alone.errors]
    if whole is None or not inner:
        return False
    return alone.mean(inner) < _RELIEF * whole.mean(inner)


def _suspects(whole: _Foreseeable | None, kappa: Array) -> list[Sequence[int]]:
    """The point that is foreseen worst, or a neighbour of it, may spoil the others."""
    if whole is None or whole.mean() < _SPOILT:
        return []
    worst = max(whole.errors, key=whole.errors.__getitem__)
    parents = spanning_tree(kappa)[1].tolist()
    near = [k for k, parent in enumerate(parents) if parent == worst]
    return [[k] for k in (worst, *near, parents[worst]) if k >= 0]


def tell_of_forced(
    local: Sequence[LocalModel],
    kappa: Array,
    longest: float,
    mended: Sequence[int] = (),
) -> None:
    """Warn of models of the common order that are not those of their own records.

    What hardly decays in the `longest` record (seconds) does not count, as nothing is
    known of it, nor do models that have no equivalent of their order in continuous
    time. But for points that are `mended`.
    """
    forced = [
        f"{place_of(k, kappa)}: {100.0 * change:.0f} %"
        for k, model in enumerate(local)
        if model.own is not None
        and model.own.lti.order == model.own.order  # or it alternates with the noise
        and k not in mended
        and (change := changed(model.lti, model.own.lti, longest)) > _FORCED
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
            "show. Ask for the one that the system has: local=SubspaceLTI(order=...)."
        )
    return models


def _has_feedthrough(models: Sequence[StateSpace]) -> bool:
    """Whether the entries of D are parameters, too."""
    return any(bool(model.D.any()) for model in models)


def _full(
    first: StateSpace, direct: bool, integrating: Sequence[int] = ()
) -> GrayBoxStructure:
    sizes = first.order, first.n_inputs, first.n_outputs
    return GrayBoxStructure.full(*sizes, direct, integrating)


def _entries(models: Sequence[StateSpace], direct: bool) -> Array:
    names = "ABCD" if direct else "ABC"
    rows = [np.concatenate([getattr(m, M).ravel() for M in names]) for m in models]
    return np.array(rows)
