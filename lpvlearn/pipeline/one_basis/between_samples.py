"""What inputs do between the samples: stay, as a converter holds them, or go on.

Signals that were measured, and are smooth, go on nearly linearly from sample to sample.
As a model with held inputs such data have a delay of half a sample too much, for which
a structure has no parameter: it lies far from the black boxes then, by their own
uncertainty, and near them once these are taken to continuous time by a hold of order
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...data.operating_points import OperatingPoints
from ...exceptions import collected, retold
from ...restructuring.minimise_covariance import is_explained
from ...restructuring.problem import GOOD_FIT
from ..points.local_models import LocalModel, as_ramps
from ..running.runner import PointRunner
from .structured_models import StructuredModels, restructure_points

Array = NDArray[np.float64]

# Of smooth inputs: samples that differ from the one before, and how far these are from
# one another, relative to how far inputs move.
_MOVING, _SMOOTH = 0.6, 0.75

# Factors by which the squared distance from a black box must be less with ramps: where
# noise explains what is left, and where it does not. A lead of half a sample looks like
# ramps, but for the highest frequencies.
_LESS, _FAR_LESS = 4.0, 25.0

# Part of `max_time` that a second search has at least
_LEAST_SHARE = 0.2


def are_smooth(inputs: Sequence[Array]) -> bool:
    """Whether an input may go on between samples, (n_samples, n_inputs) of each record.

    Inputs that are seen to stay, or jump as far as they move at all, are held.
    """
    changes = np.vstack([np.diff(u, axis=0) for u in inputs])
    about = np.vstack([u - u.mean(axis=0) for u in inputs])
    smooth = np.linalg.norm(changes, axis=0) < _SMOOTH * np.linalg.norm(about, axis=0)
    return bool((((changes != 0).mean(axis=0) > _MOVING) & smooth).any())


def restructured_by_hold(
    restructurer: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    runner: PointRunner,
    sampling_time: float,
    max_time: float | None = None,
    *,
    certain: bool = False,
) -> StructuredModels:
    """As `restructure_points`, with held inputs, or ramps where these explain far more.

    At most points, and where inputs are smooth; or where it is `certain`. `local` are
    models with held inputs: from parameters that fit these, the search goes on with
    ramps, whose responses beyond the Nyquist frequency nothing bounds. What was told of
    the structure is dropped where ramps take their place.
    """
    began = perf_counter()
    with retold() as told:
        found = restructure_points(
            restructurer, local, points, runner, sampling_time, max_time
        )
        met = all(map(_is_met, found.restructurers))
        if not certain and (met or not _may_be_ramps(found)):
            return found
        if max_time is not None:
            left = max_time - (perf_counter() - began)
            max_time = max(left, _LEAST_SHARE * max_time)
        pairs = zip(found.local, found.points.experiments, strict=True)
        no_logarithm = nullcontext() if certain else suppress(ValueError)
        with collected() as later, no_logarithm:
            other = restructure_points(
                restructurer,
                [as_ramps(*known, sampling_time) for known in pairs],
                found.points,
                runner,
                sampling_time,
                max_time,
                starts=found.theta,
            )
            if certain or _meets_more(other, found):
                told[:], found = later, other
    return found


def _may_be_ramps(found: StructuredModels) -> bool:
    """Whether inputs are smooth, and models do at once a part of what ramps do.

    Or after a delay, which may be a sample longer.
    """
    direct = any(
        model.lti.D.any() or model.lti.input_delay.any() or model.integrating
        for model in found.local
    )
    groups = found.points.experiments
    return direct and are_smooth([e.inputs for group in groups for e in group])


def _is_met(fitted: Any) -> bool:
    """Whether a structure meets the black box of a point, as far as noise lets tell."""
    cost, freedom = _cost(fitted)
    return is_explained(cost, freedom) if freedom else cost <= GOOD_FIT**2


def _cost(fitted: Any) -> tuple[float, float]:
    """Squared distance from a black box, and its degrees of freedom.

    Where no uncertainty is known, relative and 0.
    """
    cost = getattr(fitted, "chi2_", np.nan)
    if np.isfinite(cost):
        return cost, fitted.degrees_of_freedom_
    return getattr(fitted, "fit_error_", 0.0) ** 2, 0.0


def _meets_more(other: StructuredModels, found: StructuredModels) -> bool:
    """Whether at most points another hold leaves far less."""
    if len(other.restructurers) < len(found.restructurers):
        return False
    votes = []
    for one, held in zip(other.restructurers, found.restructurers, strict=True):
        less = _LESS if _is_met(one) else _FAR_LESS
        votes.append(not _is_met(held) and less * _cost(one)[0] < _cost(held)[0])
    return bool(np.mean(votes) > 0.5)
