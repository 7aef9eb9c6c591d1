r"""Coefficients that explain the black boxes of all operating points at once.

The parameters of a point are its own best ones. Where a black box hardly determines
them (two lags that noise has merged) they are far from the true ones, by more than
their covariance tells: what is linear in the parameters no longer holds, and no smooth
function goes through them. One may go through the black boxes all the same. With
``z_k(theta)`` the coordinates of the structured model in the uncertainty of the black
box of point k (`restructuring.minimise_covariance`), and the parameters
``theta(kappa_k) = S_k c`` of a polynomial,

.. math:: \min_c \sum_k |z_k(S_k c)|^2,

a chi-square if the structure and the polynomial are true. From a model of constant
parameters the degree is raised, one after another; Akaike's criterion chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh

from ..exceptions import warn
from ..lpv.auto import AutoLPV
from ..lpv.interpolator import grid_over
from ..lpv.polynomial import PolynomialLPV, resolvable_powers
from ..restructuring.deadline import time_is_up
from ..restructuring.minimise_covariance import UncertainBoxes, common_coefficients
from ..structures.structure import GrayBoxStructure
from .structured_models import StructuredModels

Array = NDArray[np.float64]

_DEGREES = (1, 2, 3, 4)
_FEWEST = 3  # points whose uncertainty is known
_STARTS, _KEPT = 5, 2  # points whose parameters are tried throughout, and gone on with
# Chi-squares per degree of freedom: of parameters, from which a form is far from them;
# of black boxes, from which they refute it
_NEAR, _FAR = 100.0, 4.0
_LEVELS = 41  # of each scheduling variable: where the model must be stable


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
        own, there = _misfit(boxes, found.theta), _misfit(boxes, form.predict(kappa))
        if not own < _FAR or there < _FAR:
            return None
    together = fitted_together(structure, boxes, kappa, found.theta)
    if together is None:
        return None
    warn(
        "the parameters of the operating points lie on no smooth function, as where "
        "data hardly tell some of them apart. One goes through the identified models "
        f"all the same: its chi-square is {together.misfit:.2g} per degree of freedom. "
        "The LPV model takes that; parameters of single points (`parameters_`) may be "
        "others that say nearly the same. Fix or bound parameters in the structure to "
        "tell them apart."
    )
    degree = together.form.degree
    chosen = form.replaced(f"polynomial {degree} through the models", together.form)
    models = [found.structure.model(row) for row in together.form.predict(kappa)]
    return chosen, together.covariance, found._replace(models=models)


def _misfit(boxes: Sequence[UncertainBoxes | None], theta: Array) -> float:
    """Chi-square per value of parameters, by black boxes of known uncertainty."""
    pairs = zip(boxes, theta, strict=True)
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
    places = kappa[[box is not None for box in boxes]]
    some = np.linspace(0, len(theta) - 1, min(_STARTS, len(theta))).astype(int)
    starts = [_fitted(known, places, theta[[k] * len(places)], 0) for k in some]
    best = _best_of(structure, known, places, starts)
    if best is None:  # far from all black boxes, constant parameters are alike
        lines = [_fitted(known, places, one.form.predict(places), 1) for one in starts]
        best = _best_of(structure, known, places, lines)
    return best


def _best_of(
    structure: GrayBoxStructure,
    known: Sequence[UncertainBoxes],
    places: Array,
    starts: Sequence[_Found],
) -> Together | None:
    """The polynomial of any degree that the best starts lead to."""
    n_values = sum(box.n_directions for box in known)
    best, least = None, np.inf
    for found in sorted(starts, key=lambda found: found.cost)[:_KEPT]:
        for degree in _DEGREES:
            n_terms = len(resolvable_powers(degree, places))
            n = n_terms * structure.n_params
            free = n_values - n
            if n_terms >= len(places) or free <= 0 or time_is_up():
                break
            found = _fitted(known, places, found.form.predict(places), degree)
            likely = found.cost < _FAR * free and found.cost + 2.0 * n < least
            if likely and _holds(structure, found.form):
                misfit, least = found.cost / free, found.cost + 2.0 * n
                covariance = max(misfit, 1.0) * pinvh(found.information)
                best = Together(found.form, covariance, misfit)
    return best


class _Found(NamedTuple):
    form: PolynomialLPV
    cost: float  # chi-square
    information: Array  # of its coefficients


def _fitted(
    boxes: Sequence[UncertainBoxes], kappa: Array, theta: Array, degree: int
) -> _Found:
    """The polynomial of least chi-square, from one near the parameters."""
    form = PolynomialLPV(degree).fit(kappa, theta)
    S = form.sensitivities(kappa)
    c, cost, J = common_coefficients(boxes, S, form.coefficients())
    return _Found(form.with_coefficients(c), cost, J.T @ J)


def _holds(structure: GrayBoxStructure, form: PolynomialLPV) -> bool:
    """Whether the model is stable and within its bounds over the range."""
    values = form.predict(grid_over(form.scheduling_range_, _LEVELS))
    within = (values >= structure.lower) & (values <= structure.upper)
    poles = np.linalg.eigvals(structure.matrices(values)[0])
    return bool(within.all() and (poles.real < 0).all())
