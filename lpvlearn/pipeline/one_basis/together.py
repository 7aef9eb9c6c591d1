r"""Coefficients that explain the black boxes of all operating points at once.

The parameters of a point are its own best ones. Where a black box hardly determines
them (two lags that noise has merged) they are far from the true ones, by more than
their covariance tells: what is linear in the parameters no longer holds, and no smooth
function goes through them. One may go through the black boxes all the same. With
``z_k(theta)`` the coordinates of the structured model in the uncertainty of the black
box of point k (`restructuring.minimise_covariance`), and the parameters
``theta(kappa_k) = S_k c`` of a polynomial,

.. math:: \min_c \sum_k |z_k(S_k c)|^2,

a chi-square if the structure and the polynomial are true. The search starts at
parameters that follow the black boxes from one point to its neighbours, and at constant
ones, from which the degree is raised. Akaike's criterion chooses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh

from ...exceptions import warn
from ...lpv.alignment import spanning_tree
from ...lpv.auto import AutoLPV
from ...lpv.polynomial import PolynomialLPV, resolvable_powers
from ...lpv.weighting import is_chance
from ...restructuring.deadline import time_is_up
from ...restructuring.minimise_covariance import UncertainBoxes, common_coefficients
from ...structures.structure import GrayBoxStructure
from ..checks.stability import holds_within_range
from .structured_models import StructuredModels

Array = NDArray[np.float64]

_DEGREES = (1, 2, 3, 4)
_PLAIN = 2  # degrees that the points may just determine
_FEWEST = 3  # points whose uncertainty is known
_STARTS, _KEPT = 5, 2  # points whose parameters are tried throughout, and gone on with
# Chi-squares per degree of freedom: of parameters, from which a form is far from them;
# of black boxes, from which they refute it
_NEAR, _FAR = 100.0, 4.0


class Together(NamedTuple):
    """A polynomial through the black boxes of all points."""

    form: PolynomialLPV
    covariance: Array  # of its coefficients
    misfit: float  # chi-square per degree of freedom


def through_black_boxes(
    form: Any, found: StructuredModels
) -> tuple[AutoLPV, Array, StructuredModels] | None:
    """The polynomial through the black boxes, where none goes through the parameters.

    With the covariance of its coefficients, and the models of the points that it has.
    None where the form that goes through the parameters is to be kept: it is the user's
    choice, all are determined and some form explains them, the black boxes too, or none
    is near.
    """
    if not isinstance(form, AutoLPV) or not found.restructurers:
        return None
    chi2, dof = form.selection_["chi2"], form.selection_["dof"]
    determined = np.isfinite(found.covariance).all()
    explained = chi2[form.selection_["chosen"]].notna().all()
    compared = chi2.notna().any()  # by covariances that tell apart
    near = (chi2 < _NEAR * dof).any()
    if determined and compared and not explained and not near:
        return None
    kappa, structure = found.points.kappa, found.structure
    estimates = [model.estimates for model in found.local]
    boxes = [UncertainBoxes.of(structure, own) if own else None for own in estimates]
    if determined and explained:
        there = _misfit(boxes, form.predict(kappa))  # of most forms that is near
        if there < _FAR or not _misfit(boxes, found.theta) < _FAR:
            return None
    together = fitted_together(structure, boxes, kappa, found.theta)
    if together is None:
        return None
    # a form that the black boxes refute is near to parameters that tell too little
    trusted = determined and not explained
    if not (trusted and _meets_some_form(form, structure.n_params)):
        warn(
            "the parameters of the operating points lie on no smooth function, as "
            "where data hardly tell some of them apart. One goes through the "
            "identified models all the same: its chi-square is "
            f"{together.misfit:.2g} per degree of freedom. The LPV model takes that; "
            "parameters of single points (`parameters_`) may be others that say nearly "
            "the same. Fix or bound parameters in the structure to tell them apart."
        )
    degree = together.form.degree
    chosen = form.replaced(f"polynomial {degree} through the models", together.form)
    models = [found.structure.model(row) for row in together.form.predict(kappa)]
    return chosen, together.covariance, found._replace(models=models)


def _meets_some_form(form: AutoLPV, n_params: int) -> bool:
    """Whether the parameters lie on some smooth function, as far as noise lets tell.

    It need not be chosen: where it foresees no more than a curve does, that one is. But
    as many values as a point has must speak for it: of fewer, chance explains too much.
    """
    chi2, dof = form.selection_["chi2"], form.selection_["dof"]
    pairs = zip(chi2, dof, strict=True)
    return any(k >= n_params and is_chance(value, k) for value, k in pairs)


def _misfit(boxes: Sequence[UncertainBoxes | None], theta: Array) -> float:
    """Chi-square per value of parameters, by black boxes of known uncertainty.

    inf far off, as of an unstable model through parameters that hardly matter.
    """
    pairs = zip(boxes, theta, strict=True)
    with np.errstate(over="ignore"):
        z = [box.coordinates(row)[0] for box, row in pairs if box is not None]
        return float(np.mean(np.concatenate(z) ** 2)) if z else np.nan


def fitted_together(
    structure: GrayBoxStructure,
    boxes: Sequence[UncertainBoxes | None],
    kappa: Array,
    theta: Array,
) -> Together | None:
    """The polynomial in `kappa` that explains the black boxes of the points best.

    `boxes` are those of every point, None of an uncertainty that is not known, `theta`
    (n_points, n_params) its parameters. None where too few are known, or no polynomial
    explains them.
    """
    known = [box for box in boxes if box is not None]
    if len(known) < _FEWEST:
        return None
    there = np.array([box is not None for box in boxes])
    places, theta = kappa[there], theta[there]
    n_values = sum(box.n_directions for box in known)
    best, least = None, np.inf
    for found in _candidates(known, places, theta):
        n = found.form.coefficients().size
        likely = found.cost < _FAR * (n_values - n) and found.cost + 2.0 * n < least
        if likely and holds_within_range(structure, found.form):
            misfit, least = found.cost / (n_values - n), found.cost + 2.0 * n
            covariance = max(misfit, 1.0) * pinvh(found.slopes.T @ found.slopes)
            best = Together(found.form, covariance, misfit)
    return best


def _candidates(
    boxes: Sequence[UncertainBoxes], kappa: Array, theta: Array
) -> Iterator[_Found]:
    """Polynomials of all degrees that several starts lead to."""
    degrees = [d for d in _DEGREES if _may_have(d, kappa)]
    for outward in (True, False):
        values = _along_the_points(boxes, kappa, theta, outward)
        for degree in degrees:
            if time_is_up():
                return
            yield _fitted(boxes, kappa, values, degree)
    some = np.linspace(0, len(theta) - 1, min(_STARTS, len(theta))).astype(int)
    starts = [_fitted(boxes, kappa, theta[[k] * len(kappa)], 0) for k in some]
    for found in sorted(starts, key=lambda found: found.cost)[:_KEPT]:
        for degree in degrees:
            if time_is_up():
                return
            found = _fitted(boxes, kappa, found.form.predict(kappa), degree)
            yield found


def _may_have(degree: int, kappa: Array) -> bool:
    """Whether there are points enough: those of a high degree meet any errors."""
    if degree >= max(len(np.unique(column)) for column in kappa.T):
        return False
    n_terms = len(resolvable_powers(degree, kappa))
    return n_terms < len(kappa) if degree <= _PLAIN else 2 * n_terms <= len(kappa)


def _along_the_points(
    boxes: Sequence[UncertainBoxes], kappa: Array, theta: Array, outward: bool
) -> Array:
    """Parameters of all points, each nearest to its black box from its neighbour's on.

    The first has its own. What the boxes hardly determine changes little on the way.
    """
    order, parents = spanning_tree(kappa, outward=outward)
    values = theta.copy()
    for k in order[1:]:
        start = values[[parents[k]]]
        values[k] = _fitted([boxes[k]], kappa[[k]], start, 0).form.predict(kappa[[k]])
    return values


class _Found(NamedTuple):
    form: PolynomialLPV
    cost: float  # chi-square
    slopes: Array  # of what its squares add up to, by its coefficients


def _fitted(
    boxes: Sequence[UncertainBoxes], kappa: Array, theta: Array, degree: int
) -> _Found:
    """The polynomial of least chi-square, from one near the parameters."""
    form = PolynomialLPV(degree).fit(kappa, theta)
    S = form.sensitivities(kappa)
    c, cost, J = common_coefficients(boxes, S, form.coefficients())
    return _Found(form.with_coefficients(c), cost, J)
