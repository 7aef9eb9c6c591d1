"""Reports as tables: what a pipeline fitted, and models side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .local_models import LocalModel
from .lpv import LPVStateSpace
from .metrics import InitialState, fit_report, simulator_in
from .operating_points import OperatingPoints
from .scores import parameter_fit
from .simulators import ROLES, TableSimulator, fit_of
from .statespace import StateSpace
from .structured_models import StructuredModels

__all__ = ["compare_models"]

Array = NDArray[np.float64]


def operating_point_report(
    points: OperatingPoints,
    local: Sequence[LocalModel],
    structured: StructuredModels,
    deviations: pd.DataFrame,
    lpv: LPVStateSpace,
    sampling_time: float,
) -> pd.DataFrame:
    """One row per operating point: how good each step was.

    Parameters
    ----------
    points : OperatingPoints
    local : sequence of LocalModel
    structured : StructuredModels
    deviations : DataFrame of shape (n_points, n_params)
        Standard deviations of the parameters.
    lpv : LPVStateSpace
    sampling_time : float

    Returns
    -------
    DataFrame
        Columns as in `LocalLPVPipeline.report_`.
    """
    interpolated = lpv.parameters(points.kappa)
    known = bool(deviations.notna().any(axis=None))
    rows = []
    for k, (group, model) in enumerate(zip(points.experiments, local, strict=True)):
        gray_box = structured.models[k]
        row: dict[str, Any] = {
            "n_experiments": len({e.label for e in group}),
            "n_samples": sum(len(e.rows) for e in group),
            "order": model.order,
            "horizon": model.horizon,
            "local_BFT": fit_of(model.lti, group, sampling_time),
        }
        if structured.restructurers:
            row["structured_BFT"] = fit_of(gray_box, group, sampling_time)
            row |= _restructuring(structured.restructurers[k])
        distance = (gray_box - lpv.at(points.kappa[k])).hinf_norm()
        size = gray_box.hinf_norm()
        row["interpolation_error"] = distance / size if size > 0 else np.nan
        row["interpolation_FIT"] = parameter_fit(structured.theta[k], interpolated[k])
        if structured.restructurers:
            row |= _named("param_", deviations.columns, structured.theta[k])
            if known:
                row |= _named("std_", deviations.columns, deviations.to_numpy()[k])
        rows.append(row)
    return pd.DataFrame(rows, index=point_index(points.kappa))


def parameter_tables(
    structured: StructuredModels, kappa: Array
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Parameters and their standard deviations, one row per operating point.

    A deviation that is not known is NaN.

    Parameters
    ----------
    structured : StructuredModels
    kappa : ndarray of shape (n_points, n_scheduling)
    """
    index, names = point_index(kappa), list(structured.structure.parameter_names)
    parameters = pd.DataFrame(structured.theta, index, names)
    deviations = pd.DataFrame(np.nan, index, names)
    for k, covariance in enumerate(structured.covariances):
        if covariance is not None:
            deviations.iloc[k] = np.sqrt(np.diag(covariance))
    return parameters, deviations


def parameter_report(
    parameters: pd.DataFrame, deviations: pd.DataFrame, interpolated: Array
) -> pd.DataFrame:
    """One row per parameter: how it varies over the points, and how it is met.

    Parameters
    ----------
    parameters, deviations : DataFrame of shape (n_points, n_params)
    interpolated : ndarray of shape (n_points, n_params)

    Returns
    -------
    DataFrame
        Columns as in `LocalLPVPipeline.parameter_report_`.
    """
    theta = parameters.to_numpy()
    return pd.DataFrame(
        {
            "lowest": theta.min(axis=0),
            "highest": theta.max(axis=0),
            "std": deviations.median(),
            "interpolation_RMSE": np.sqrt(np.mean((theta - interpolated) ** 2, axis=0)),
            "interpolation_FIT": [
                parameter_fit(own, met)
                for own, met in zip(theta.T, interpolated.T, strict=True)
            ],
        },
        index=pd.Index(parameters.columns, name="parameter"),
    )


def _named(prefix: str, names: pd.Index, values: Array) -> dict[str, float]:
    return {prefix + name: v for name, v in zip(names, values.tolist(), strict=True)}


def _restructuring(restructurer: Any) -> dict[str, float]:
    """What a fitted restructurer tells of its result."""
    r = restructurer
    size = r.error_ / r.relative_error_ if r.relative_error_ > 0 else np.inf
    return {
        "relative_error": r.relative_error_,
        "relative_floor": r.structural_floor_ / size,
        "remaining_error": r.remaining_error_ / size,
        "active_frequency": np.max(r.active_frequencies_, initial=0.0),
        "stationarity": r.stationarity_,
    }


def point_index(kappa: Array) -> pd.Index:
    """Scheduling values as the index of a table."""
    labels = [row[0] if len(row) == 1 else tuple(row) for row in kappa.tolist()]
    return pd.Index(labels, name="operating_point", tupleize_cols=False)


def compare_models(
    models: Mapping[str, Any],
    X: Any,
    y: Any,
    *,
    initial_state: InitialState = "rest",
    burn_in: int = 0,
    **roles: Any,
) -> pd.DataFrame:
    """Compare models on one table, as MATLAB's ``compare`` does.

    Parameters
    ----------
    models : dict of str to fitted estimator, LPVStateSpace or StateSpace
    X : DataFrame or array-like of shape (n_samples, n_features)
    y : DataFrame, Series or array-like of shape (n_samples,) or (n_samples, n_outputs)
    initial_state : {"rest", "estimate"}, default="rest"
    burn_in : int, default=0
        As in `fit_report`.
    **roles : column name, position or list
        `inputs`, `scheduling`, `experiment`, `time`, `operating_point` and
        `sampling_time` of the state-space models, as in `LocalLPVPipeline`. Those not
        given are taken from the first estimator in `models` that has them.

    Returns
    -------
    DataFrame
        One row per model, experiment and output: the column `model`, and those of
        `fit_report`.

    Raises
    ------
    ValueError
        When a model does not fit the table, or is none of the above.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import StateSpace, compare_models
    >>> u = np.sign(np.sin(np.arange(100.0)))
    >>> true = StateSpace([[0.9]], [[0.1]], [[1.0]], sampling_time=1.0)
    >>> faster = StateSpace([[0.88]], [[0.12]], [[1.0]], sampling_time=1.0)
    >>> report = compare_models(
    ...     {"true": true, "faster": faster}, u[:, None], true.simulate(u))
    >>> report.pivot_table("BFT", "output", "model").round(1)
    model   faster   true
    output
    y1        79.8  100.0
    """
    if not isinstance(models, Mapping) or not models:
        raise ValueError(
            "`models` must be a dict from names to models, not empty. Got "
            f"{type(models).__name__}."
        )
    allowed = (*ROLES, "sampling_time")
    for name in roles:
        if name not in allowed:
            raise ValueError(f"a role must be one of {allowed}. Got {name!r}.")
    known = _roles_of(models.values()) | roles
    parts = []
    for name, model in models.items():
        if isinstance(model, (LPVStateSpace, StateSpace)):
            model = TableSimulator(model, **known)
        elif not hasattr(model, "predict"):
            raise ValueError(
                f"`models[{name!r}]` must be a fitted estimator, an LPVStateSpace or a "
                f"StateSpace. Got {type(model).__name__}."
            )
        try:
            part = fit_report(model, X, y, initial_state=initial_state, burn_in=burn_in)
        except ValueError as error:
            raise ValueError(f"model {name!r}: {error}") from error
        parts.append(part.assign(model=name))
    table = pd.concat(parts, ignore_index=True)
    return table[["model", *table.columns.drop("model")]]


def _roles_of(models: Any) -> dict[str, Any]:
    """Roles and sampling time of the first estimator that has them."""
    for model in models:
        owner = simulator_in(model)
        if hasattr(owner, "split_experiments"):
            roles = {name: getattr(owner, name, None) for name in ROLES}
            step = getattr(owner, "sampling_time_", owner.sampling_time)
            return {**roles, "sampling_time": step}
    return {}
