"""Parts of a structure that no response at a point tells from one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...exceptions import take_back, warn
from ...lpv.model import LPVStateSpace
from ...structures.interchanges import (
    INTERCHANGE,
    as_plausible,
    interchanges,
    known_before,
    told_by_motion,
)
from .structured_models import StructuredModels, delayed_models

Array = NDArray[np.float64]

# Change of what is remembered after a jump over the range from which an interchange is
# another LPV model, and is told of (in fast sweeps the outputs then miss by a tenth);
# and interchanges that are compared along experiments at most
_ANOTHER, _TOLD = 0.01, 0.2
_IMAGES = 24


def mirror_images(found: StructuredModels) -> list[StructuredModels]:
    """The models, and those with parts interchanged at all points, if others over them.

    These have the same responses at every point, and nothing known before tells them
    apart; where the scheduling variables move they differ. Takes back what was told of
    that at the points.
    """
    mirrored, others = [found], _images(found)[0]
    if len(others):
        take_back(INTERCHANGE)
    for places in others:
        theta = found.theta[:, places]
        models = delayed_models(found.structure, theta, found.local)
        covariance = found.covariance[:, places[:, None], places]
        fits = [fitted.interchanged(places) for fitted in found.restructurers]
        mirrored.append(
            found._replace(
                theta=theta, covariance=covariance, models=models, restructurers=fits
            )
        )
    return mirrored


def _images(
    found: StructuredModels, family: Array | None = None
) -> tuple[NDArray[np.intp], Array]:
    """Interchanges that make another LPV model, and how much: the most first."""
    structure, fits = found.structure, found.restructurers
    none = np.zeros((0, structure.n_params), dtype=np.intp), np.zeros(0)
    if len(found.theta) < 2 or not all(hasattr(f, "interchanged") for f in fits):
        return none
    places = interchanges(structure) if fits else none[0]
    if len(places) < 2:
        return none
    theta = found.theta if family is None else family
    known = known_before(structure, getattr(fits[0], "init", None))
    places = places[as_plausible(structure, theta, places, known)][:_IMAGES]
    try:
        change = told_by_motion(structure, theta, places)
    except (ValueError, np.linalg.LinAlgError):  # no such model, or no Gramians
        return none
    order = np.argsort(-change, kind="stable")
    order = order[change[order] > _ANOTHER]
    return places[order], change[order]


def tell_of_mirror_images(found: StructuredModels, model: LPVStateSpace) -> None:
    """Tell of parts whose interchange is another LPV model of the same responses."""
    q = found.structure.n_params
    if any(fitted.identifiability_.rank < q for fitted in found.restructurers):
        return  # these are told
    family = model.silenced().parameters(found.points.kappa)
    places, change = _images(found, family)
    if not (change > _TOLD).any():
        return
    take_back(INTERCHANGE)
    moved = (places[change > _TOLD] != np.arange(places.shape[1])).any(axis=0)
    names = [found.structure.parameter_names[j] for j in np.flatnonzero(moved)]
    warn(
        f"the values of {', '.join(map(repr, names))} may be those of one another at "
        "all operating points: no response there tells these parts of the structure "
        "apart, but where the scheduling variables move they make another LPV model, "
        "and this one may be wrong. Give experiments that move, with refiner="
        "OutputErrorLPV(), which decide; or say which is which by "
        "structure.with_bounds(), structure.with_ranges(), or a first guess, "
        "GrayBoxRestructurer(structure, init=...)."
    )
