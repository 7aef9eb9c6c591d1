"""Reports as tables: what a pipeline fitted, and models side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.operating_points import OperatingPoints
from ..lpv.model import LPVStateSpace
from ..metrics.reports import _NO_FLOOR, _as_shown, readable_report
from ..metrics.scores import parameter_fit
from ..metrics.simulation import fit_of
from .local_models import LocalModel
from .structured_models import StructuredModels

Array = NDArray[np.float64]


def summarise(pipeline: Any) -> str:
    """What a fitted pipeline found, as text.

    Parameters
    ----------
    pipeline : LocalLPVPipeline
        Fitted.
    """
    report, lpv = pipeline.report_, pipeline.lpv_
    step = pipeline.sampling_time_
    lines = [
        f"LPV model of order {lpv.order}: {lpv.n_inputs} input(s), {lpv.n_outputs} "
        f"output(s), {pipeline.parameters_.shape[1]} parameters",
        f"{report['n_experiments'].sum()} experiment(s), {report['n_samples'].sum()} "
        f"samples at {step:.4g} s, {_places(pipeline)}",
        "",
        f"Local models: {_name(pipeline.local, 'SubspaceLTI')}, "
        f"simulation fit (BFT) {_span(report['local_BFT'])} %",
    ]
    if pipeline.restructurers_:
        error, floor = 100 * report["relative_error"], 100 * report["relative_floor"]
        remaining = 100 * report["remaining_error"]
        has_floor = report["relative_floor"].max() > _NO_FLOOR
        worst = _largest(remaining)
        place = (
            f"the largest at {_place(report, worst)} near "
            f"{report['active_frequency'].iloc[worst]:.4g} rad/s"
        )
        lines += [
            f"Restructuring: {_name(pipeline.restructurer, 'GrayBoxRestructurer')}, "
            f"simulation fit (BFT) {_span(report['structured_BFT'])} %",
            f"    H-infinity error {_span(error)} % of the black box's norm"
            + ("" if has_floor else f", {place}"),
        ]
        if has_floor:
            lines += [
                f"    of which no parameter can change {_span(floor)} %",
                f"    apart from that, {_span(remaining)} %, {place}",
            ]
        unknown = int(pipeline.parameters_std_.isna().all(axis=1).sum())
        if unknown:
            lines.append(
                f"    standard deviations of the parameters are not known at {unknown} "
                "point(s): see `parameters_std_`"
            )
    else:
        lines.append(
            "Restructuring: none; the entries of balanced models are interpolated, "
            "which have no common state basis"
        )
    total = parameter_fit(
        pipeline.parameters_, lpv.parameters(pipeline.operating_points_)
    )
    distance = 100 * report["interpolation_error"]
    lines += [
        f"Interpolation: {pipeline.interpolator_}, parameter fit (FIT) {total:.2f} %",
        f"    H-infinity error {_span(distance)} % of the model's norm, the largest at "
        f"{_place(report, _largest(distance))}",
    ]
    if len(pipeline.operating_points_) == 1:
        lines.append("One operating point: the model is time-invariant.")
    lines += ["", readable_report(report[_shown(report)]).to_string()]
    if pipeline.restructurers_:
        table = pipeline.parameter_report_.dropna(axis=1, how="all")
        lines += ["", readable_report(table).to_string()]
    return "\n".join(lines)


def _largest(values: pd.Series) -> int:
    return int(values.fillna(0.0).to_numpy().argmax())


def _place(report: pd.DataFrame, row: int) -> str:
    return _as_shown(report.index[row], "{:.4g}")


def _places(pipeline: Any) -> str:
    points = pipeline.operating_points_
    if pipeline.scheduling is None:
        return "no scheduling variable"
    low, high = points.min(axis=0), points.max(axis=0)
    spans = [
        f"{name} from {a:.4g} to {b:.4g}"
        for name, a, b in zip(pipeline.scheduling_names_, low, high, strict=True)
    ]
    return f"{len(points)} operating point(s), {', '.join(spans)}"


def _name(step: Any, default: str) -> str:
    return default if step is None else type(step).__name__


def _span(values: pd.Series) -> str:
    low, high = f"{values.min():.4g}", f"{values.max():.4g}"
    return low if low == high else f"{low} to {high}"


def _shown(report: pd.DataFrame) -> list[str]:
    """Columns for people: without a floor, all of the error remains."""
    hidden = ["param_", "std_", "n_", "stationarity", "horizon", "order"]
    if "relative_floor" in report:
        has_floor = report["relative_floor"].max() > _NO_FLOOR
        hidden += (
            ["relative_error"] if has_floor else ["relative_floor", "remaining_error"]
        )
    return [name for name in report.columns if not name.startswith(tuple(hidden))]


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
