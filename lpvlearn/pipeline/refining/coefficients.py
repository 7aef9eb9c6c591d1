"""Coefficients of an interpolation: what operating points tell of them, refined.

Parameters theta_k at the points, of covariance S_k, are ``Phi_k c`` to first order:
``sum_k Phi_k^T S_k^-1 Phi_k`` is the information of c, before experiments that move
tell more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import Experiment
from ...data.preparation import complete_runs
from ...lpv.interpolator import Interpolator
from ...lpv.model import LPVStateSpace
from ...lpv.refinement import Prior, local_prior
from ...lpv.weighting import covariance_of
from ..one_basis.structured_models import StructuredModels
from .errors import own_of_local, record_of

Array = NDArray[np.float64]

NO_COEFFICIENTS = (
    "`{}` needs an interpolator with coefficients to fit: AutoLPV, PolynomialLPV, "
    "RationalLPV or SplineLPV. Got {}."
)


def refine_model(
    refiner: Any,
    model: LPVStateSpace,
    experiments: Sequence[Experiment],
    sampling_time: float,
    known: Prior,
) -> Any:
    """A clone of the refiner, with the refined model."""
    return clone(refiner).refine(model, experiments, sampling_time, known)


def known_coefficients(
    model: LPVStateSpace, found: StructuredModels, sampling_time: float
) -> Prior:
    """What the operating points tell of the coefficients.

    By the covariances of the parameters; without these, from the local experiments,
    where nothing of them is missing.
    """
    form = model.interpolator
    if not isinstance(form, Interpolator):
        raise ValueError(NO_COEFFICIENTS.format("refiner", type(form).__name__))
    points = found.points
    information = form.information(points.kappa, found.covariance)
    if information is not None:
        return Prior(form.coefficients(), information)
    runs = [[run for e in g for run in complete_runs(e)] for g in points.experiments]
    groups = [[record_of(e, sampling_time) for e in g] for g in runs]
    own = own_of_local(found)
    return local_prior(model, points.kappa, found.theta, groups, own)


def local_covariance(form: Any, found: StructuredModels) -> Array | None:
    """Of the coefficients of a form through operating points; None: not known."""
    if not isinstance(form, Interpolator):
        return None
    information = form.information(found.points.kappa, found.covariance)
    return None if information is None else covariance_of(information)
