"""What fitted estimators hold that can be drawn, and errors where they hold none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.tables import as_numbers
from ..metrics.table_simulation import unwrapped
from ..models.statespace import StateSpace
from .drawing import units_of, with_unit

_STILL = 0.01  # part of its size by which a variable hardly moves


def models_of(
    estimator: Any, kappa: float | ArrayLike | None = None
) -> dict[str, StateSpace]:
    """State-space models of a fitted estimator, by name; those of an LPV at `kappa`.

    Of a pipeline the local models of the nearest operating point too; at several places
    (rows of `kappa`) the interpolated models alone.
    """
    estimator = unwrapped(estimator)
    if hasattr(estimator, "lti_"):
        return {type(estimator).__name__: estimator.lti_}
    if not hasattr(estimator, "lpv_"):
        raise ValueError(
            "`estimator` must be a fitted SubspaceLTI, GrayBoxRestructurer, "
            "LocalLPVPipeline or OutputErrorLPV: call its fit() first. Got "
            f"{type(estimator).__name__} without `lti_` or `lpv_`."
        )
    if kappa is not None and as_numbers("kappa", kappa).ndim == 2:
        places = places_of(estimator, kappa)
        return {label: estimator.lpv_.at(place) for label, place in places.items()}
    lpv, place = estimator.lpv_, _place(estimator, kappa)
    found = {}
    if hasattr(estimator, "operating_points_"):
        nearest = nearest_point(estimator, place)
        found["local"] = estimator.local_models_[nearest]
        if estimator.restructurers_:
            found["gray-box"] = estimator.structured_models_[nearest]
    return found | {"interpolated": lpv.at(place)}


def places_of(pipeline: Any, kappa: Any) -> dict[str, NDArray[np.float64]]:
    """Scheduling values, rows of `kappa`, by the text that tells them in a legend."""
    places = [_place(pipeline, row) for row in as_numbers("kappa", kappa)]
    return {"at " + ", ".join(f"{value:.6g}" for value in k): k for k in places}


def _place(pipeline: Any, kappa: float | ArrayLike | None) -> NDArray[np.float64]:
    """A scheduling value of the right shape, or a ValueError that tells the range."""
    lpv, points = pipeline.lpv_, getattr(pipeline, "operating_points_", None)
    if kappa is None:
        known = "range is" if points is None else "operating points are"
        places = lpv.scheduling_range if points is None else points
        shown = ", ".join(np.array2string(k, precision=4) for k in places)
        raise ValueError(
            "`kappa` must tell at which scheduling value to draw the LPV model's "
            f"frozen models. Got None; its {known} {shown}."
        )
    place = as_numbers("kappa", kappa).reshape(-1)
    if len(place) != lpv.n_scheduling:
        raise ValueError(
            f"`kappa` must hold {lpv.n_scheduling} scheduling value(s). Got {kappa!r}."
        )
    return place


def nearest_point(pipeline: Any, kappa: float | ArrayLike | None) -> int:
    """Number of the operating point of a fitted pipeline that is nearest to `kappa`.

    Every variable counts in its range, whatever its unit; one that hardly moves does
    not.
    """
    distances = pipeline.operating_points_ - _place(pipeline, kappa)
    size = _STILL * np.abs(pipeline.operating_points_).max(axis=0)
    span = np.maximum(np.ptp(distances, axis=0), size)
    scaled = distances / np.where(span > 0, span, 1.0)
    return int(np.argmin(np.linalg.norm(scaled, axis=1)))


def fitted_pipeline(pipeline: Any, attribute: str) -> Any:
    """The pipeline (of a search), or a ValueError if it is not fitted."""
    pipeline = unwrapped(pipeline)
    if not hasattr(pipeline, attribute):
        raise ValueError(
            "`pipeline` must be a fitted LocalLPVPipeline: call its fit() first. Got "
            f"{type(pipeline).__name__} without `{attribute}`."
        )
    return pipeline


def check_model(name: str, model: Any, hint: str = "") -> None:
    """A ValueError unless the argument is a StateSpace."""
    if not isinstance(model, StateSpace):
        raise ValueError(
            f"`{name}` must be a StateSpace. Got {type(model).__name__}{hint}."
        )


def with_others(own: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """An estimator's things and further ones to compare with, by name."""
    for name in others:
        if name in own:
            raise ValueError(
                f"`others` must not use the estimator's own names, {', '.join(own)}. "
                f"Got {name!r}."
            )
    return {**own, **others}


def scheduling_labels(
    estimator: Any, n_scheduling: int, units: Mapping[str, str] | None
) -> list[str]:
    """Labels of a pipeline's scheduling variables, with their units."""
    names = getattr(estimator, "scheduling", None)
    names = list(names) if isinstance(names, (list, tuple)) else [names]
    if len(names) != n_scheduling or not all(isinstance(name, str) for name in names):
        names = [f"κ{k + 1}" for k in range(n_scheduling)]
    return [
        with_unit("κ" if n_scheduling == 1 and name in ("kappa", "κ1") else name, unit)
        for name, unit in zip(
            names, units_of(names, units_for(estimator, units)), strict=True
        )
    ]


def units_for(estimator: Any, units: Any) -> Any:
    """The units given, or those that the estimator's LPV model knows."""
    known = getattr(getattr(estimator, "lpv_", None), "units", None)
    return known if units is None else units
