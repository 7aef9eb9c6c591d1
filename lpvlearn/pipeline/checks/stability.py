"""Whether the interpolated model is stable between the operating points too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...data.operating_points import neighbours
from ...exceptions import warn
from ...lpv.interpolator import Interpolator
from ...lpv.model import LPVStateSpace
from ...models.scheduling_range import grid_over
from ...structures.structure import GrayBoxStructure
from ...validation import number_shown

Array = NDArray[np.float64]

_STEPS = 20  # into which the way from a point to its neighbour is cut

GROWS = "grows"  # the kind of its warning
_GROWN = 0.01  # share by which what counts as growing does so over a record, at least

_ROUNDING = 1e-8  # of the largest pole: an integrator's may lie so far to the right

_LEVELS = 41  # of each scheduling variable, at which a form is looked at

_BETWEEN = "The local models are stable; "
_OVERSHOT = (
    f"{_BETWEEN}the interpolation between them overshoots, which "
    "interpolator=SplineLPV() does not."
)
_MIXED = f"{_BETWEEN}what is interpolated between them is not."


def growth_rates(
    lpv: LPVStateSpace, kappa: Array, longest: float, cause: str | None = None
) -> Array:
    """Largest real part (1/s) of the frozen poles about each operating point.

    Half-way to its neighbours. What grows is told: the range, and the `cause`; what
    does so by next to nothing over the `longest` record (seconds) counts as zero. None
    is what the interpolation lets expect.
    """
    if cause is None:  # "pchip" does not overshoot
        form = getattr(lpv.interpolator, "best_estimator_", lpv.interpolator)
        cause = _MIXED if getattr(form, "kind", "") == "pchip" else _OVERSHOT
    model, ends = lpv.silenced(), neighbours(kappa)
    least = _GROWN / longest
    rates = _rates(model, kappa, least)
    share = np.linspace(0.0, 1.0, _STEPS + 1)[1:-1, None]
    worst, where = rates.max(initial=-np.inf), kappa[rates.argmax()]
    unstable = [kappa[k] for k in np.flatnonzero(rates > 0)]
    for first, last in ends:
        between = kappa[first] + share * (kappa[last] - kappa[first])
        found = _rates(model, between, least)
        unstable += list(between[found > 0])
        if found.max() > worst:
            worst, where = found.max(), between[found.argmax()]
        half = len(found) // 2 + 1
        rates[first] = max(rates[first], found[:half].max())
        rates[last] = max(rates[last], found[half - 1 :].max())
    if unstable:
        names = lpv.scheduling_names or range(1, lpv.n_scheduling + 1)
        low, high = np.min(unstable, 0), np.max(unstable, 0)
        widths = np.ptp(lpv.scheduling_range, axis=0)
        spans = zip(low, high, where, names, widths, strict=True)
        places = ", ".join(
            "{!r} from {} to {} (worst at {})".format(
                name, *(number_shown(value, width) for value in span)
            )
            for *span, name, width in spans
        )
        warn(
            f"`lpv_` is unstable at values within its range, of {places}: a pole has "
            f"real part {worst:.3g} 1/s, and simulations that stay there grow without "
            f"bound. {cause} Use a lower degree, or measure there too "
            "(`suggest_operating_point`).",
            kind=GROWS,
        )
    return rates


def grows(lpv: LPVStateSpace, kappa: Array, longest: float) -> bool:
    """Whether a frozen model at a value grows over a record (seconds); not told."""
    return bool((_rates(lpv.silenced(), kappa, _GROWN / longest) > 0.0).any())


def _rates(model: LPVStateSpace, kappa: Array, least: float) -> Array:
    """Largest real part of the poles at every value; 0 up to `least`, and rounding."""
    poles = model.frozen_poles(kappa)
    rates = poles.real.max(axis=1, initial=-np.inf)
    size = np.abs(poles).max(axis=1, initial=0.0)
    is_zero = (np.abs(rates) <= _ROUNDING * size) | ((rates > 0) & (rates <= least))
    return np.where(is_zero, 0.0, rates)


def holds_within_range(structure: GrayBoxStructure, form: Interpolator) -> bool:
    """Whether the model is within its bounds over the range of a form, and stable.

    An integrator does not grow.
    """
    values = form.predict(grid_over(form.scheduling_range_, _LEVELS))
    within = (values >= structure.lower) & (values <= structure.upper)
    poles = np.linalg.eigvals(structure.matrices(values)[0])
    rounding = _ROUNDING * np.abs(poles).max(axis=1, initial=0.0, keepdims=True)
    return bool(within.all() and (poles.real <= rounding).all())
