"""Whether black boxes had better be interpolated in the observable canonical form.

No structure, no common states: those that are aligned follow any models, but by no law.
Outputs and their derivatives are states of any system, and where its equations are
polynomials in the scheduling variables, or fractions of such, so is the canonical form:
of a low degree, if a system is simple. That points follow such a form within their
covariances, and foresee one another by it, happens by no chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...lpv.auto import AutoLPV
from ...lpv.extrapolation import distance_from_hull
from ...lpv.polynomial import PolynomialLPV
from ...lpv.rational import RationalLPV
from ...lpv.spline import SplineLPV
from ...lpv.weighting import noise_explains
from ...models.statespace import DEVIATION, StateSpace, forgetting, scaled
from ...restructuring.coordinates import CanonicalForm
from ...structures.structure import GrayBoxStructure
from ...structures.templates import generic_indices
from ...systems.least_squares import RCOND, column_scale
from ..checks.stability import holds_within_range
from ..points.left_out import (
    UNLIKE,
    errors_left_out,
    forgotten,
    largest_difference,
)
from ..points.local_models import LocalModel
from .black_boxes import of_rates

Array = NDArray[np.float64]

# The degree of a polynomial, and both degrees of a fraction, at most; and degrees of
# freedom that each parameter of one of a degree more has, at least.
_LOW, _SPARE = (2, 3), 2

# Times the chi-square of a form, that of constants: noise moves no point so far
_EXPLAINED = 1e4

# Errors in a model's largest gain: of a point left out, as good as none; of a form at a
# point of its own that it misses, by its noise, and where that does not explain it
_FORESEEN, _BY_NOISE, _MISSED = 0.01, 0.3, 0.05

# By how much the error of points left out may be above that of aligned models, in the
# mean, where outputs integrate: a jump of the rate costs more, and stays.
_JUMP = 0.5

# Bias of parameters, in standard deviations, by which they are all but linear in what
# noise does to a model; where they are not, choices of states that are tried, and the
# share of the bias of the usual ones that others must stay below
_STRAIGHT, _MOST_CHAINS, _FAR_LESS = 0.1, 12, 0.1


class CanonicalModels(NamedTuple):
    """Models of all points in the form, and the covariances of their parameters."""

    structure: GrayBoxStructure
    theta: Array  # (n_points, n_params)
    covariance: Array  # (n_points, n_params, n_params)


def canonical_black_boxes(local: Sequence[LocalModel]) -> CanonicalModels | None:
    """None where a model has no such form, or its covariance is not known.

    Of the outputs and derivatives that may be the states, the usual ones: or others, of
    which noise bends the parameters far less.
    """
    integrating = local[0].integrating
    models = [of_rates(model.lti, integrating) for model in local]
    first = models[0]
    if len({model.order for model in models}) > 1 or not first.order:
        return None
    around = []
    for model in local:
        deviated = [m for pair in model.deviated() for m in pair]
        # one with a pole beyond zero has more states in continuous time
        if not deviated or any(m.order != model.order for m in deviated):
            return None
        around.append([of_rates(m, integrating) for m in (model.lti, *deviated)])
    sizes = first.order, first.n_inputs, first.n_outputs
    direct = any(bool(model.D.any()) for model in models)
    best, least = None, np.inf
    for indices in islice(generic_indices(*sizes[::2]), _MOST_CHAINS):
        of_rate, whole = (
            GrayBoxStructure.observable_canonical(*sizes, direct, some, indices)
            for some in ((), integrating)
        )
        known = _parameters(of_rate, around)
        if known is None:
            continue
        bend = max(point.bend for point in known)
        if best is None or bend < least:
            least = bend if best else _FAR_LESS * bend
            theta = np.array([point.theta for point in known])
            covariance = np.array([point.covariance for point in known])
            best = CanonicalModels(whole, theta, covariance)
            if bend < _STRAIGHT:
                break
    return best


class _Point(NamedTuple):
    """Parameters of a model, what is not known of them, and what noise biases them by.

    Changes (k, n_params) with each of what is not known, by its standard deviation.
    """

    theta: Array
    changes: Array
    bias: Array

    @property
    def covariance(self) -> Array:
        return self.changes.T @ self.changes

    @property
    def bend(self) -> float:
        """The bias of parameters that bend with noise, in their standard deviations.

        ``sqrt(b^T P^+ b)``: the shortest step of what is not known that moves them so.
        """
        unit = column_scale(self.changes)
        rows = (self.changes / unit).T
        step = np.linalg.lstsq(rows, self.bias / unit, rcond=RCOND)[0]
        return float(np.linalg.norm(step))


def _parameters(
    structure: GrayBoxStructure, around: Sequence[Sequence[StateSpace]]
) -> list[_Point] | None:
    """Of groups of a model and the pairs about it; None where one has none."""
    form, points = CanonicalForm(structure, None), []
    for group in around:
        rows = [form.parameters(_matrix(model)) for model in group]
        known = [row for row in rows if row is not None]
        if len(known) < len(rows):
            return None
        at, up, down = known[0], np.array(known[1::2]), np.array(known[2::2])
        bias = 0.5 * (up + down - 2.0 * at).sum(axis=0) / DEVIATION**2
        points.append(_Point(at, (up - down) / (2.0 * DEVIATION), bias))
    return points


def is_better_form(
    canonical: CanonicalModels,
    aligned: tuple[GrayBoxStructure, Array],
    local: Sequence[LocalModel],
    kappa: Array,
    sizes: tuple[Array, Array],
    longest: float,
    auto: AutoLPV,
) -> bool:
    """Whether a form carries canonical parameters, and foresees points no worse.

    Points that are left out, no worse than what is interpolated of `aligned` models
    (not much worse, where outputs integrate), inputs and outputs in units of their
    `sizes`, what does not decay in the `longest` record (seconds) forgotten. Judged by
    what `auto`, fitted to them, chose: a low form, or any where outputs integrate.
    """
    structure, theta, covariance = canonical
    form = auto.best_estimator_
    # aligned states let the rate jump with kappa, and an integrator keeps that
    if not (_is_low(form, structure.n_params) or local[0].integrating):
        return False
    if not holds_within_range(structure, form):
        return False
    models = [model.lti for model in local]
    rate = forgotten(models, longest)

    def seen(model: StateSpace) -> StateSpace:
        return forgetting(scaled(model, *sizes), rate)

    # covariances of parameters that outputs hardly tell apart say little of the model
    met = map(structure.model, form.predict(kappa))
    pairs = zip(met, models, strict=True)
    missed = max(largest_difference(seen(a), seen(b)) for a, b in pairs)
    if missed > (_BY_NOISE if noise_explains(form) else _MISSED):
        return False
    dof = getattr(form, "degrees_of_freedom_", 0)  # none of a curve through the points
    if 0 < dof < 2 * structure.n_params:  # less than with a point less
        constant = auto.selection_["chi2"].iloc[0]
        if constant > _EXPLAINED * max(form.chi2_, dof):
            return True
    ways = (*aligned, SplineLPV(), None), (structure, theta, form, covariance)
    other, own = (
        errors_left_out(
            of,
            models,
            curve,
            kappa,
            values,
            covariance=P,
            seen=seen,
        )
        for of, values, curve, P in ways
    )
    both = [k for k in own if k in other]
    # what the others do not surround is extrapolated, by any form
    both = [k for k in both if not _is_corner(k, kappa)] or both
    by_form, by_curve = (
        sum(min(max(errors[k], _FORESEEN), UNLIKE) for k in both)
        for errors in (own, other)
    )
    leeway = _JUMP * len(both) if local[0].integrating else 0.0
    return bool(both) and by_form <= by_curve + leeway


def _is_corner(k: int, kappa: Array) -> bool:
    """Whether a point is outside the hull of the others."""
    others = np.delete(kappa, k, axis=0)
    return bool(distance_from_hull(kappa[[k]], others)[0] > 0.0)


def _matrix(model: StateSpace) -> Array:
    return np.block([[model.A, model.B], [model.C, model.D]])


def _is_low(form: Any, n_params: int) -> bool:
    """Whether a form is simple, and the points are more than it needs."""
    plain, fraction = _LOW
    if isinstance(form, PolynomialLPV):
        low = form.degree <= plain
    elif isinstance(form, RationalLPV):
        beyond = form.degree + form.denominator - fraction
        spare = form.degrees_of_freedom_ >= _SPARE * n_params
        low = beyond <= (1 if spare else 0)
    else:
        return False
    return low and form.degrees_of_freedom_ > 0
