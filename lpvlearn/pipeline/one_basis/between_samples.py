"""What inputs do between the samples: stay, as a converter holds them, or go on.

Signals that were measured, and are smooth, go on nearly linearly from sample to sample.
As a model with held inputs such data have a delay of half a sample too much, for which
a structure has no parameter: it lies far from the black boxes then, by their own
uncertainty, and near them once these are taken to continuous time by a hold of order
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np

from ...data.operating_points import OperatingPoints
from ...exceptions import collected, retold
from ...restructuring.minimise_covariance import efficient_parameters, is_explained
from ..points.local_models import LocalModel, as_ramps
from ..running.runner import PointRunner
from .structured_models import StructuredModels, restructure_points

# Factor by which the squared distance from the black boxes, in units of their
# uncertainty, must be less where inputs go on: half a sample of delay makes it that
# great wherever it matters.
_LESS = 4.0


def restructured_by_hold(
    restructurer: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    runner: PointRunner,
    sampling_time: float,
    max_time: float | None = None,
) -> StructuredModels:
    """As `restructure_points`, with held inputs, or ramps where these explain far more.

    `local` are models with held inputs. What was told of the structure is dropped where
    ramps take their place.
    """
    began = perf_counter()
    options = runner, sampling_time
    with retold() as told:
        found = restructure_points(restructurer, local, points, *options, max_time)
        smooth = _with_ramps(found)
        if max_time is not None:
            max_time -= perf_counter() - began
        if smooth is not None and not (max_time is not None and max_time <= 0.0):
            told.clear()
            found = restructure_points(
                restructurer, smooth, found.points, *options, max_time
            )
    return found


def _with_ramps(found: StructuredModels) -> list[LocalModel] | None:
    """The local models with ramps between samples, where these explain far more."""
    fits = found.restructurers
    cost = sum(getattr(fitted, "chi2_", np.nan) for fitted in fits)
    freedom = sum(getattr(fitted, "degrees_of_freedom_", np.nan) for fitted in fits)
    if not freedom > 0 or is_explained(cost, freedom):
        return None
    groups = found.points.experiments
    with collected(), suppress(ValueError):  # a pole may have no logarithm
        smooth = list(map(as_ramps, found.local, groups))
        if _cost(found, smooth) < cost / _LESS:
            return smooth
    return None


def _cost(found: StructuredModels, smooth: Sequence[LocalModel]) -> float:
    """Squared distance of the structure from other black boxes, near its parameters."""
    total = 0.0
    for model, theta in zip(smooth, found.theta, strict=True):
        fit = efficient_parameters(
            found.structure, model.estimates, theta, admissible=lambda _: True
        )
        total += np.inf if fit is None else fit.cost
    return total
