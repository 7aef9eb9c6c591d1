"""What is said of scheduling values that no operating point is near."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..exceptions import ExtrapolationWarning, warn
from ..validation import number_shown

Array = NDArray[np.float64]

# Values this close to the identified range, relative to its width, are in it: a
# measured mean and a range read from a report differ by rounding.
_RANGE_RTOL = 1e-6

_NEAR = 0.01  # of the range that a model has seen: beyond it, but nothing to tell of

_MANY_VARIABLES = 4  # beyond, a hull has too many faces
_BESIDE = 0.05  # of the ranges: distance from the hull that is still near it


def describe_extrapolation(X: Array, scheduling_range: Array) -> str:
    """Say how far values are out of range; nothing when they are in it."""
    low, high = scheduling_range
    width = np.where(high > low, high - low, 1.0)
    excess = np.maximum(low - X, X - high) - _RANGE_RTOL * (high - low)
    excess /= width
    if not (excess > 0).any():
        return ""
    row, j = np.unravel_index(np.argmax(excess), excess.shape)
    outside = int((excess > 0).any(axis=1).sum())
    return (
        f"Scheduling values must be within the identified range, [{low[j]:.6g}, "
        f"{high[j]:.6g}] for variable {j + 1}. Got {outside} of {len(X)} outside, the "
        f"farthest {X[row, j]:.6g}. No interpolation is to be trusted there: identify "
        "a model there too, or hold the border's value with `extrapolation='clip'`."
    )


def warn_extrapolation(
    kappa: Array, identified_range: Array, names: Sequence[Hashable]
) -> None:
    """Warn, once, of scheduling values outside the (2, n_scheduling) range identified.

    By more than another run through the same range may be. The message names every
    such variable, its range and the farthest value.
    """
    low, high = identified_range
    width = np.where(high > low, high - low, 1.0)
    excess = np.maximum(low - kappa, kappa - high) / width
    near, said = np.where(high > low, _NEAR, 0.0), []
    for j in np.flatnonzero((excess > near).any(axis=0)):
        farthest = kappa[np.argmax(excess[:, j]), j]
        least, most, value = (
            number_shown(v, width[j]) for v in (low[j], high[j], farthest)
        )
        said.append(
            f"Scheduling variable {names[int(j)]!r} must be within the identified "
            f"range, {least} to {most}. Got {int((excess[:, j] > 0).sum())} of "
            f"{len(kappa)} samples outside, the farthest at {value}"
        )
    if said:
        warn(
            f"{'. '.join(said)}: the model is extrapolated. Identify a model there "
            "too, or hold the border's with "
            "interpolator=AutoLPV(extrapolation='clip').",
            ExtrapolationWarning,
        )


def warn_outside_hull(
    kappa: Array, points: Array, identified_range: Array, names: Sequence[Hashable]
) -> None:
    """Warn, once, of values in the range of every variable that no points surround.

    What moved within the experiments widens the hull of the points as it does the
    range.
    """
    low, high = identified_range
    inside = ((low <= kappa) & (kappa <= high)).all(axis=1)
    away = np.where(inside, distance_from_hull(kappa, points), 0.0)
    span = np.ptp(points, axis=0)
    moved = (0.5 * (high - low - span) / np.where(span > 0, span, np.inf)).max()
    far = away > _BESIDE + moved
    if not far.any():
        return
    worst = int(np.argmax(away))
    place = ", ".join(
        f"{name!r} = {value:.4g}"
        for name, value in zip(names, kappa[worst], strict=True)
    )
    warn(
        f"{int(far.sum())} of {len(kappa)} samples are outside the hull of the "
        f"{len(points)} operating points, though within the range of every scheduling "
        f"variable: the farthest, at {place}, by {100 * away[worst]:.0f} % of the "
        "ranges. The model is extrapolated there. Identify a model there too.",
        ExtrapolationWarning,
    )


def distance_from_hull(kappa: Array, points: Array) -> Array:
    """How far (n_samples,) values are beyond the faces of the convex hull of points.

    Every variable in its range over the points; 0 within. 0 too of one variable, of
    which the range tells all, of very many, and of points on a line or plane, whose
    hull is empty.

    >>> corners = np.array([[0.0, 0.0], [0.0, 10.0], [2.0, 0.0]])
    >>> distance_from_hull(np.array([[0.1, 0.5], [2.0, 10.0]]), corners).round(3)
    array([0.   , 0.707])
    """
    away = np.zeros(len(kappa))
    low, span = points.min(axis=0), np.ptp(points, axis=0)
    varies = span > 0
    if not 1 < varies.sum() <= min(_MANY_VARIABLES, len(points) - 1):
        return away
    low, span, kappa = low[varies], span[varies], kappa[:, varies]
    try:
        faces = ConvexHull((points[:, varies] - low) / span).equations
    except QhullError:
        return away
    for *normal, offset in faces:  # one at a time: trajectories are long
        slopes = normal / span
        np.maximum(away, kappa @ slopes + (offset - low @ slopes), out=away)
    return away
