"""Operating points that are left out, and what the others make of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.operating_points import neighbours
from ...exceptions import warn
from ...lpv.left_out import values_left_out
from ...lpv.model import LPVStateSpace
from ...lpv.spline import SplineLPV
from ...models.statespace import StateSpace, forgetting
from ...restructuring.error_system import frequency_grid
from ...structures.structure import GrayBoxStructure
from ...validation import listed
from ..running.runner import label_of

Array = NDArray[np.float64]

_BESIDE = 1.0 + 1e-6  # of a pole: there may be no response at one on the axis

# Error of what the others make of a model, in its largest gain: that of a resonance
# that is elsewhere, as may be at a point of many; what is worse than that; and the
# median of several, or of few, from which models between the points are seldom good to
# a tenth: of few points, each that is left out leaves a large gap.
_ELSEWHERE, _WORSE, _MEDIAN, _MANY, _OF_FEW = 1.0, 1.5, 0.3, 4, 0.8

UNLIKE = 2.0  # an error of a point left out, in its largest gain, as bad as any
NEAR = 0.1  # and one up to which what the others foresee is what the record tells

# Difference, in the largest gain, from which what is between two points is a guess: of
# their two models, or of what two curves make of the middle (mostly twice the error).
_GUESS = 0.3

_HARDLY = 3.0  # time constants in the longest record of what hardly decays

_NAMED = 3  # operating points that a message lists

# Of the largest error of the others: the share that is left without a point that is
# wrong, by what is left without any other one.
_RELIEF = 0.5


def errors_left_out(
    structure: GrayBoxStructure,
    models: Sequence[StateSpace],
    form: Any,
    kappa: Array,
    theta: Array,
    *,
    covariance: Array | None = None,
    seen: Callable[[StateSpace], StateSpace] | None = None,
) -> dict[int, float]:
    """By points within the range of the others, the errors of what these make of them.

    Of the response, in the largest gain of the point's model. Models are `seen` as they
    are, or otherwise.
    """
    errors = {}
    for out, values in values_left_out(form, kappa, theta, covariance):
        for k, own in zip(np.flatnonzero(out).tolist(), values, strict=True):
            both = [structure.model(own), models[k]]
            if seen is not None:
                both = [seen(model) for model in both]
            errors[k] = largest_difference(*both)
    return errors


def tell_unforeseen(
    lpv: LPVStateSpace,
    models: Sequence[StateSpace],
    form: Any,
    kappa: Array,
    theta: Array,
    longest: float,
    *,
    saturated: bool = False,
) -> None:
    """Tell of points within the range of the others of which these know nothing.

    Where no form is true the interpolation follows the points: one that the others do
    not foresee is another system, or there are too few of them; as where a form is
    `saturated`. And of points between which curves differ that both pass through them.
    """
    if not models[0].is_continuous:
        return
    rate = forgotten(models, longest)
    forgets = partial(forgetting, rate=rate)
    errors = errors_left_out(lpv.structure, models, form, kappa, theta, seen=forgets)
    worst = sorted(((error, k) for k, error in errors.items()), reverse=True)
    high = [(error, k) for error, k in worst if error > _ELSEWHERE]
    often = high and (high[0][0] > _WORSE or 2 * len(high) >= len(errors))
    limit = _MEDIAN if len(errors) >= _MANY else _OF_FEW
    most = errors and np.median([*errors.values()]) > limit
    if often or most:
        known = (
            f"any {len(np.unique(kappa, axis=0))} points lie on a form of as many "
            "coefficients"
            if saturated
            else "no form fits the parameters over the operating points"
        )
        left = _left_without(lpv.structure, models, form, kappa, theta, forgets)
        first, second = np.argsort(left)[:2].tolist()
        named = {k: error for error, k in high or worst}
        alone = ""
        if left[first] < min(_RELIEF * left[second], _MEDIAN):
            named = {first: errors[first]} if first in errors else named
            alone = (
                f"Without point {first} (scheduling {label_of(kappa[first])}) the "
                "others foresee one another within "
                f"{100.0 * left[first]:.0f} %: check its record and its scheduling "
                "value. "
            )
        worst = [(named[k], k) for k in sorted(named, key=left.__getitem__)]
        warn(
            f"{known}, and the others do not foresee point(s) "
            f"{listed_errors(worst, kappa)}, by the error in the largest gain: between "
            f"points the LPV model may be as wrong. {alone}Look at `parameters_` for a "
            "point that is unlike the others, give a structure where there is none "
            "(a canonical one: restructurer=GrayBoxRestructurer()), or "
            "measure in between (`suggest_operating_point`)."
        )
    if often or most or saturated:
        return
    differences = _differences_between(lpv.structure, form, kappa, theta, forgets)
    apart, k, other = max(differences, default=(0.0, 0, 0))
    if apart > _GUESS:
        warn(
            "no form fits the parameters over the operating points, and between points "
            f"{k} and {other} (scheduling {label_of(kappa[k])} and "
            f"{label_of(kappa[other])}) curves through all of them differ, one that "
            f"keeps their shape and a smooth one: by {100.0 * apart:.0f} % of the "
            "largest gain, as wrong as the LPV model may be there. Give a structure "
            "where there is none (a canonical one: "
            "restructurer=GrayBoxRestructurer()), or measure in between "
            "(`suggest_operating_point`)."
        )


def _left_without(
    structure: GrayBoxStructure,
    models: Sequence[StateSpace],
    form: Any,
    kappa: Array,
    theta: Array,
    seen: Callable[[StateSpace], StateSpace],
) -> list[float]:
    """Of every point, the largest error of the others that is left without it.

    The least of the one that is wrong: what is beside it is foreseen as badly.
    """
    left = []
    for k in range(len(models)):
        rest = [i for i in range(len(models)) if i != k]
        known = [models[i] for i in rest], form, kappa[rest], theta[rest]
        errors = errors_left_out(structure, *known, seen=seen)
        left.append(max(errors.values(), default=np.inf))
    return left


def _differences_between(
    structure: GrayBoxStructure,
    form: SplineLPV,
    kappa: Array,
    theta: Array,
    seen: Callable[[StateSpace], StateSpace],
) -> Iterator[tuple[float, int, int]]:
    """How far a smooth curve is from one that keeps the shape, between neighbours.

    In the middle of each pair of points, by the response, in the largest gain of the
    `form`. Nothing of a form that is smooth itself: points left out speak for it.
    """
    if form.kind != "pchip" or not np.ptp(kappa, axis=0).any():
        return
    pairs = neighbours(kappa)
    smooth = clone(form).set_params(kind="cubic").fit(kappa, theta)
    own, other = (f.predict(kappa[pairs].mean(axis=1)) for f in (form, smooth))
    for (k, at), *parameters in zip(pairs.tolist(), other, own, strict=True):
        with suppress(ValueError):  # beyond the points a structure may have no model
            both = [seen(structure.model(values)) for values in parameters]
            yield largest_difference(*both), k, at


def listed_errors(errors: Sequence[tuple[float, int]], kappa: Array) -> str:
    """The first of some points, with their errors in percent, for a message."""
    named = [
        f"{k} (scheduling {label_of(kappa[k])}: {100.0 * error:.0f} %)"
        for error, k in errors
    ]
    return listed(named, _NAMED)


def tell_of_two_points(
    models: Sequence[StateSpace], kappa: Array, longest: float
) -> None:
    """Tell that straight lines between two points, whose models differ, are a guess."""
    if len(np.unique(kappa, axis=0)) != 2 or not models[0].is_continuous:
        return
    k = int((kappa != kappa[0]).any(axis=1).argmax())
    one, other = models[0], models[k]
    change = min(changed(one, other, longest), changed(other, one, longest))
    if change > _GUESS:
        warn(
            "with two operating points nothing tells of what is between them: the "
            "parameters run along straight lines, between models that differ by "
            f"{100.0 * change:.0f} % of the largest gain. Measure a point in between; "
            "where the lines are known to be straight, use "
            "interpolator=PolynomialLPV(1)."
        )


def forgotten(models: Sequence[StateSpace], longest: float) -> float:
    """The rate, 1/s, at which states are forgotten where models are compared.

    What decays in about the `longest` record (seconds) or later, as integrators, has
    Gramians and gains of any size, which say nothing of it. 0 where all decay sooner.
    """
    rate = _HARDLY / longest
    slowest = max(model.poles().real.max(initial=-np.inf) for model in models)
    return rate if slowest > -rate else 0.0


def changed(one: StateSpace, other: StateSpace, longest: float) -> float:
    """`largest_difference` of what decays within the `longest` record (seconds)."""
    rate = forgotten((one, other), longest)
    return largest_difference(forgetting(one, rate), forgetting(other, rate))


def largest_difference(one: StateSpace, other: StateSpace) -> float:
    """Largest difference of responses, relative to the second one's largest gain.

    Of continuous-time models.
    """
    poles = np.concatenate([one.poles(), other.poles()])
    omega = _BESIDE * frequency_grid(poles, None)
    with np.errstate(all="ignore"):
        G, G0 = (m.with_input_delay(0).frequency_response(omega) for m in (one, other))
        size, error = np.abs([G0, G - G0]).max(axis=(1, 2, 3))
        relative = error / (size or 1.0)
    return float(relative) if np.isfinite(relative) else 0.0
