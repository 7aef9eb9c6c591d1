"""Parameters that the record of a point does not tell, by the other points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...exceptions import warn
from ...lpv.auto import AutoLPV
from ...lpv.left_out import interpolated_without, values_left_out
from ...models.statespace import StateSpace
from ..points.left_out import NEAR, largest_difference
from ..running.runner import place_of
from .structured_models import StructuredModels, delayed_models

Array = NDArray[np.float64]

# Of parameters at a point: the standard deviation, by those of the others, from which
# these may foresee them better, and points that are enough for that. And of others
# there that are foreseen elsewhere: by so many times what is usual, up to which error
_UNTOLD, _FORESEEING = 10.0, 4
_ASTRAY, _LIKE = 5.0, 0.01


def with_foreseen(found: StructuredModels) -> StructuredModels:
    """The models with parameters of a point that its record does not tell.

    As those of a mode that vanishes there: they may be anything, and a curve through
    all points would follow them. What the others foresee is taken where it is more
    certain, by what they miss when they are left out, than the point's own standard
    deviation, and where with it the model is what the record does tell. Told.
    """
    kappa, n = found.points.kappa, len(found.theta)
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    usual = np.median(std, axis=0)
    some = (usual > 0.0) & np.isfinite(usual)
    ratio = np.divide(std, usual, out=np.zeros_like(std), where=some)
    # but for a record that tells less of all parameters: covariances weigh that
    least = ratio.min(axis=1, initial=np.inf, keepdims=True)
    doubted = ratio > _UNTOLD * np.maximum(least, 1.0)
    doubtful: NDArray[np.bool_] = doubted.any(axis=1)
    rest = np.flatnonzero(~doubtful)
    enough = n > len(rest) >= max(_FORESEEING, n - n // 3)
    if np.isnan(std).any() or not enough:
        return found
    form, others = AutoLPV(), found.theta[rest]
    left_out = values_left_out(form, kappa[rest], others, found.covariance[rest])
    missed = [values - others[out] for out, values in left_out]
    places = kappa[doubtful]
    foreseen = interpolated_without(
        doubtful, form, kappa, found.theta, places, found.covariance
    )
    if not missed or foreseen is None:
        return found
    scatter = np.maximum(np.sqrt(np.mean(np.vstack(missed) ** 2, axis=0)), usual)
    low, high = kappa[rest].min(axis=0), kappa[rest].max(axis=0)
    theta, covariance = found.theta.copy(), found.covariance.copy()
    models, told, worst = list(found.models), [], 0.0
    names = np.array(found.structure.parameter_names, dtype=object)

    def away(k: int, own: Array, taken: Any) -> tuple[float, Array, StateSpace]:
        """How far a model of which some values are foreseen is from the record's."""
        row = np.where(taken, own, found.theta[k])
        row = np.clip(row, found.structure.lower, found.structure.upper)
        (model,) = delayed_models(found.structure, row[None], [found.local[k]])
        error = largest_difference(model, found.local[k].lti)
        return (error if model.is_stable else np.inf), row, model

    for k, own in zip(np.flatnonzero(doubtful).tolist(), foreseen, strict=True):
        untold = doubted[k] & (std[k] > scatter)
        if not (untold.any() and ((low <= kappa[k]) & (kappa[k] <= high)).all()):
            continue
        # where one is anything, others may be, with a deviation that is none
        astray = untold | (np.abs(own - theta[k]) > _ASTRAY * scatter)
        mode = untold.copy()  # a mode vanishes as a whole: what no longer matters, too
        for j in np.flatnonzero(astray & ~untold):
            more = mode.copy()
            more[j] = True
            if away(k, own, more)[0] < away(k, own, mode)[0] + _LIKE:
                mode = more
        for taken, most in ((astray, _LIKE), (mode, NEAR), (untold, NEAR)):
            error, row, model = away(k, own, taken)
            if not error < most:
                continue
            theta[k], models[k], worst = row, model, max(worst, error)
            P = np.where(taken | taken[:, None], 0.0, covariance[k])
            covariance[k] = P + np.diag(np.where(taken, scatter, 0.0) ** 2)
            what = ", ".join(map(repr, names[taken]))
            told.append(f"{what} at {place_of(k, kappa)}")
            break
    if told:
        warn(
            f"the record does not tell {'; '.join(told)}, as where a mode vanishes: "
            "the LPV model takes what the other points foresee there instead. Within "
            f"{100.0 * worst:.2g} % of the largest gain it is what the record does "
            "tell. Give values or bounds of these parameters if they are known."
        )
    return found._replace(theta=theta, covariance=covariance, models=models)
