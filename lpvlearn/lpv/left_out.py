"""Operating points that are left out, and what a form through the others foresees."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from copy import copy, deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..exceptions import collected
from .interpolator import Interpolator
from .polynomial import PolynomialLPV

Array = NDArray[np.float64]


def inner_places(kappa: Array) -> Iterator[NDArray[np.bool_]]:
    """The points (n_points,) of every place that lies within the range of the others.

    >>> [out.tolist() for out in inner_places(np.array([[0.0], [2.0], [1.0]]))]
    [[False, False, True]]
    """
    for place in np.unique(kappa, axis=0):
        out = (kappa == place).all(axis=1)
        rest = kappa[~out]
        if len(rest) and (place >= rest.min(axis=0)).all():
            if (place <= rest.max(axis=0)).all():
                yield out


def inner_levels(kappa: Array) -> Iterator[NDArray[np.bool_]]:
    """The points (n_points,) of every level between others that several places share.

    >>> kappa = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [2, 0], [2, 1]], float)
    >>> [np.flatnonzero(out).tolist() for out in inner_levels(kappa)]
    [[2, 3]]
    """
    for values in kappa.T:
        for level in np.unique(values)[1:-1]:
            out = values == level
            if len(np.unique(kappa[out], axis=0)) > 1:
                yield out


def interpolated_without(
    out: NDArray[np.bool_],
    form: Any,
    kappa: Array,
    theta: Array,
    places: Array,
    covariance: Array | None,
) -> Array | None:
    """Parameters at places without some points; None where these are needed."""
    keep = ~out
    # of another library's regressor steps may be shared by a copy, and fitted anew
    form = copy(form) if isinstance(form, Interpolator) else deepcopy(form)
    if keep.sum() == 1:
        form = PolynomialLPV(degree=0)
    elif getattr(form, "extrapolation", "ignore") in ("warn", "error"):
        form.set_params(extrapolation="ignore")
    known = {}
    if covariance is not None and takes_covariance(form):
        known["covariance"] = covariance[keep]
    try:
        with collected():  # what it warns of was said of all points
            values = form.fit(kappa[keep], theta[keep], **known).predict(places)
            return np.reshape(values, (len(places), theta.shape[1]))
    except ValueError:
        return None


def takes_covariance(form: Any) -> bool:
    """Whether covariances of the parameters are of use to an interpolator."""
    return "covariance" in inspect.signature(form.fit).parameters


def values_left_out(
    form: Any, kappa: Array, theta: Array, covariance: Array | None = None
) -> Iterator[tuple[NDArray[np.bool_], Array]]:
    """Points of every place within the range of the others, and what these foresee.

    Their parameters; without places at which the others are too few.
    """
    for out in inner_places(kappa):
        values = interpolated_without(out, form, kappa, theta, kappa[out], covariance)
        if values is not None:
            yield out, values
