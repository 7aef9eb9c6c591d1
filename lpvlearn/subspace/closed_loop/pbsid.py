r"""Predictor-based subspace identification (PBSID_opt): consistent under feedback.

The innovation form ``x[t+1] = A x[t] + B u[t] + K e[t]``,
``y[t] = C x[t] + D u[t] + e[t]`` is written as its predictor, which is stable even
where the plant is not. With ``A_K = A - K C``, ``B_K = [B - K D, K]`` and the samples
``z[t] = [u[t]; y[t]]``,

.. math::

    x_t = \sum_{l=1}^{p} A_K^{l-1} B_K z_{t-l} + A_K^p x_{t-p}, \qquad
    y_t = C x_t + D u_t + e_t .

No future input stands in these equations, so that feedback from y to u does not
correlate the regressors with the innovation: three least squares give innovation forms
of every order (`predictor_subspace`). A finite past is a bias where modes are slow and
the noise is that of the sensors, since ``A - K C`` is then as slow as A. The refinement
(`predictor`) takes it away: it minimises the prediction error.

The states are those of plant and noise together, of which the inputs do not reach those
of the noise alone (`plant_and_noise`). How many there are is chosen by criteria
``log det S + price n_parameters / n``, S the covariance of the innovations: by that of
Hannan and Quinn in the subspace, by Schwarz's among refined models.

A constant of the outputs (and a drift) is one of their prediction, but for a free
response of the predictor: it is projected out of the Hankel matrix and is an unknown of
the refinement, as in open loop.

Every step is invariant to other units, and to an invertible mixing, of inputs and of
outputs. Where D is free, ``u[t]`` is a regressor of ``y[t]``. That is right as long as
the controller needs at least one sample to answer: one that answers within the sample
and a feedthrough form an algebraic loop, of which second moments do not tell the parts.

References
----------
A. Chiuso, "The role of vector autoregressive modeling in predictor-based subspace
identification", Automatica 43, 2007.

G. van der Veen, J.-W. van Wingerden, M. Bergamasco, M. Lovera and M. Verhaegen,
"Closed-loop subspace identification methods: an overview", IET Control Theory and
Applications 7, 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evidence.statistics import Evidence
from ..orders.identification import STABLE_MARGIN, Settings
from ..orders.realization import reflect_unstable
from ..orders.selection import PlantFit, Row, Selection
from ..samples.records import Record, ScaledRecords, output_energy, shorten
from ..simulation_error.criterion import PRICE
from ..simulation_error.noise import Whitening
from ..simulation_error.simulation_fit import Freedom, Realization, simulation_fit
from .plant_and_noise import (
    ByInputs,
    ClosedLoopEvidence,
    split_modes,
    without_reached_noise,
)
from .predictor import Found, Innovation, Predictor, prediction_errors, refine_predictor
from .predictor_subspace import (
    PredictorSubspace,
    criteria_by_order,
    errors_by_order,
    innovation_form,
    predictor_subspace,
)
from .varx import NO_INNOVATION

Array = NDArray[np.float64]

_MAX_ORDER = 20  # of plant and noise together, where it is chosen


def identify_closed_loop(
    scaled: ScaledRecords,
    basis: Array,
    order: int | None,
    horizon: int | None,
    settings: Settings,
    like: Evidence | None = None,
) -> PlantFit:
    """Identify a plant that may stand in a feedback loop.

    Order and states of plant and noise together follow from one VARX. As many states
    make the prediction error the likelihood, which is maximised; of them those are the
    plant's that the inputs reach. Where these do not add up to a given order, the model
    is that of so many states of the subspace, not refined: the prediction error of so
    few would trade the plant for the noise.

    A model `like` it, of the same samples with other trends, is begun from as well:
    where trends are further parameters, it can only be likelier with them.

    Poles that `enforce_stability` refuses are reflected into the unit circle, and B
    and D minimise the simulation error. `basis` is that of the `Evidence`.
    """
    records, free = scaled.records, settings.free
    wanted = (order or 0) + settings.n_noise_states
    subspace = predictor_subspace(records, wanted, free.direct, horizon)
    left = errors_by_order(subspace, max(wanted, _MAX_ORDER))
    criteria = criteria_by_order(left, subspace)
    free_order = order is None or (settings.refine and settings.n_noise_states == 0)
    n_joint = max(wanted, int(np.argmin(criteria))) if free_order else wanted
    start = None
    if isinstance(like, ClosedLoopEvidence):
        start = like.start(scaled, free)
    together = _fit_together(subspace, records, order, n_joint, settings, start)
    fitted, joint, transform, kept = together
    own, errors = prediction_errors(joint, records, free)
    states, trends = free.own_parts(own, len(joint.A))
    loss = sum(float(np.sum(e**2)) for e in errors)
    A, B, C = joint.A[kept][:, kept], joint.B[kept], joint.C[:, kept]
    plant = Realization(A, B, C, joint.D, states[:, kept], loss, trends=trends)
    energy, stability_loss = output_energy(records) or 1.0, 0.0
    residual = float(np.sqrt(loss / energy))
    heads, share = shorten(records)
    none = Whitening.none(len(free.direct))
    known = heads, scaled.input_scale, scaled.output_scale, basis, free, none
    evidence: Evidence
    limit = 1.0 - STABLE_MARGIN if settings.enforce_stability else np.inf
    stable_A = reflect_unstable(A, limit)
    if stable_A is A:
        evidence = ClosedLoopEvidence(
            plant,
            *known,
            fitted is not None,
            share,
            joint=joint,
            transform=transform,
            kept=kept,
            fitted=fitted,
        )
    else:
        plant = simulation_fit(stable_A, C, records, free)
        stability_loss = float(np.sqrt(plant.loss / energy)) - residual
        residual += stability_loss
        evidence = Evidence(plant, *known, False, share)
    sizes = [float(np.linalg.norm(e)) / np.sqrt(len(e)) for e in left]
    excess = (criteria - criteria.min()).tolist()
    tried = [
        Row(n, subspace.past, size, value, np.nan)
        for n, (size, value) in enumerate(zip(sizes, excess, strict=True))
        if order in (None, n)
    ]
    chosen = Selection(len(A), subspace.past, tried)
    return PlantFit(
        evidence, chosen, subspace.singular_values, residual, stability_loss
    )


class _Together(NamedTuple):
    """Plant and noise."""

    fitted: Predictor | None  # None where it is not at a minimum
    joint: Innovation  # block diagonal
    transform: Array  # from the states of `fitted` to these
    kept: NDArray[np.bool_]  # which states are the plant's


def _fit_together(
    subspace: PredictorSubspace,
    records: Sequence[Record],
    order: int | None,
    n_joint: int,
    settings: Settings,
    start: tuple[Innovation, NDArray[np.bool_]] | None,
) -> _Together:
    """Plant and noise of `n_joint` states or more, told apart.

    `order` is that of the plant. States of the noise that the subspace does not show
    would be taken from those of a given one. Where what is refined from a `start` is
    not told apart, that is as it was.
    """
    free = settings.free
    found: list[Found] = [(None, innovation_form(subspace, n_joint))]
    if settings.refine:
        first = refine_predictor(found[0][1], records, free)
        found = [first]
        if order is None or not settings.n_noise_states:
            more = _with_more_states(*first, subspace, records, free)
            found = [more] if order is None or more[1] is first[1] else [more, first]
    together = _told_apart(found, records, order, subspace, free)
    if together is None:
        fitted, joint = found[-1]
        if order is not None and order != len(joint.A):
            joint, fitted = innovation_form(subspace, order), None
        whole = np.ones(len(joint.A), dtype=bool)
        together = _Together(fitted, joint, np.eye(len(whole)), whole)
    if start is None or not settings.refine:
        return together
    joint, kept = start
    near = [refine_predictor(joint, records, free)]
    other = _told_apart(near, records, order, subspace, free)
    if other is None:
        if order not in (None, int(kept.sum())):
            return together
        joint = _likeliest([joint], records, free)
        other = _Together(None, joint, np.eye(len(kept)), kept)
    # at the price by which models with and without trends are compared
    costs = [_cost(m.joint, subspace, records, PRICE) for m in (together, other)]
    return other if costs[1] < costs[0] else together


def _told_apart(
    found: Sequence[Found],
    records: Sequence[Record],
    order: int | None,
    subspace: PredictorSubspace,
    free: Freedom,
) -> _Together | None:
    """Plant and noise of the first of these models that tells them apart."""
    n = subspace.n_columns
    for fitted, joint in found:
        split = split_modes(joint, fitted, order, records, free, n)
        if split is None:
            continue
        T, kept, by_inputs = split
        apart = joint.transformed(T)
        if fitted is None or kept.all():
            return _Together(fitted, apart, T, kept)
        models = without_reached_noise(apart, fitted, T, kept, free.direct)
        if by_inputs is not None:  # else what is no noise would be told apart as well
            moved = [ByInputs.of(model, records, free) for model in models[:-1]]
            models = [some.reaching(kept)[1] for some in (*moved, by_inputs)]
        apart, fewer = _likeliest(models, records, free), int((~kept).sum())
        if order is not None or _as_likely(apart, joint, fewer, records, n):
            return _Together(fitted, apart, T, kept)
    return None


def _with_more_states(
    fitted: Predictor | None,
    joint: Innovation,
    subspace: PredictorSubspace,
    records: Sequence[Record],
    free: Freedom,
) -> Found:
    """The refined model, or one of more states, while these are worth it.

    Of modes that are slow beside the past window the subspace tells little: what it
    leaves of the outputs without them is no more than with them. Schwarz's criterion,
    as the refined models have as many states as they can use.
    """
    highest = min(_MAX_ORDER, len(subspace.states))
    price = float(np.log(subspace.n_columns))

    @cache
    def refined(order: int) -> Found:
        return refine_predictor(innovation_form(subspace, order), records, free)

    def criterion(model: Found) -> float:
        return _cost(model[1], subspace, records, price)

    best = fitted, joint
    while True:
        order = len(best[1].A)  # a mode is one state or two
        further = map(refined, range(order + 1, min(order + 2, highest) + 1))
        others = [model for model in further if model[0] is not None]
        least = min([best, *others], key=criterion)
        if least is best:
            return best
        best = least


def _cost(
    model: Innovation,
    subspace: PredictorSubspace,
    records: Sequence[Record],
    price: float,
) -> float:
    """Criterion per sample of a model, by the price of a parameter."""
    (ny, m), n = subspace.direct.shape, subspace.n_columns
    parameters = len(model.A) * (m + 2 * ny)
    return _volume(model.covariance, records) + price * parameters / n


def _volume(covariance: Array, records: Sequence[Record]) -> float:
    """Logarithm of the determinant of innovations, rounding allowed for."""
    floor = NO_INNOVATION * np.mean(np.hstack([r.y for r in records]) ** 2, axis=1)
    return float(np.linalg.slogdet(covariance + np.diag(floor))[1])


def _likeliest(
    models: Sequence[Innovation], records: Sequence[Record], free: Freedom
) -> Innovation:
    """The model of least errors, with the covariance of these."""
    found = []
    for model in models:
        errors = np.vstack(prediction_errors(model, records, free)[1])
        covariance = errors.T @ errors / len(errors)
        found.append(model._replace(covariance=covariance))
    return min(found, key=lambda model: _volume(model.covariance, records))


def _as_likely(
    model: Innovation,
    whole: Innovation,
    n_fewer: int,
    records: Sequence[Record],
    n: int,
) -> bool:
    """Whether a model without B of so many states is worth what it loses.

    By Schwarz's criterion, as Wald's statistic has said of the whole model: which is to
    be trusted where the likelihood is as quadratic as it takes it for.
    """
    loss = _volume(model.covariance, records) - _volume(whole.covariance, records)
    return bool(loss < n_fewer * model.B.shape[1] * np.log(n) / n)
