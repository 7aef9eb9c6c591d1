"""Reports for people: rounded tables, and the account of a fitted pipeline."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from .scores import parameter_fit

__all__ = ["readable_report"]

# Heading and format of the columns of the reports, for people.
_READABLE = {
    "model": ("model", "{}"),
    "experiment": ("experiment", "{}"),
    "operating_point": ("operating point", "{}"),
    "output": ("output", "{}"),
    "BFT": ("BFT", "{:.2f}"),
    "VAF": ("VAF", "{:.2f}"),
    "RMSE": ("RMSE", "{:.3g}"),
    "R2": ("R2", "{:.4f}"),
    "n_experiments": ("experiments", "{:.0f}"),
    "n_samples": ("samples", "{:.0f}"),
    "order": ("order", "{:.0f}"),
    "horizon": ("horizon", "{:.0f}"),
    "local_BFT": ("local BFT", "{:.2f}"),
    "structured_BFT": ("gray-box BFT", "{:.2f}"),
    "relative_error": ("relative error", "{:.2e}"),
    "relative_floor": ("floor", "{:.2e}"),
    "remaining_error": ("remaining error", "{:.2e}"),
    "active_frequency": ("active at rad/s", "{:.4g}"),
    "stationarity": ("stationarity", "{:.0e}"),
    "interpolation_error": ("interpolation error", "{:.2e}"),
    "interpolation_FIT": ("interpolation FIT", "{:.2f}"),
    "interpolation_RMSE": ("interpolation RMSE", "{:.2g}"),
    "lowest": ("lowest", "{:.4g}"),
    "highest": ("highest", "{:.4g}"),
    "std": ("std", "{:.2g}"),
}

# Share of the black box's norm below which a floor is none.
_NO_FLOOR = 1e-8


def readable_report(report: pd.DataFrame) -> pd.DataFrame:
    """A report with headings and rounded numbers, as text.

    Parameters
    ----------
    report : DataFrame
        From `fit_report`, `compare_models`, or `report_` and `parameter_report_` of a
        pipeline. Other columns are shown with four digits.

    Returns
    -------
    DataFrame
        Of strings: prints well, and so do its ``to_latex``, ``to_markdown`` and
        ``style``.

    Notes
    -----
    pandas needs jinja2 for ``to_latex`` and ``style``, and tabulate for
    ``to_markdown``. ``to_latex(escape=True)`` takes labels such as ``run_1`` into a
    document; ``to_markdown(disable_numparse=True)`` leaves ``98.00`` as it is.

    Examples
    --------
    >>> import pandas as pd
    >>> from lpvlearn.summary import readable_report
    >>> readable_report(pd.DataFrame({"local_BFT": [96.83157], "param_k": [3.0]}))
      local BFT  k
    0     96.83  3
    """
    headings, columns = [], []
    for name, column in report.items():
        heading, style = _READABLE.get(str(name), (str(name), "{:.4g}"))
        heading = heading.removeprefix("param_").replace("std_", "std ", 1)
        headings.append(heading)
        columns.append([_as_shown(value, style) for value in column])
    index = pd.Index([_as_shown(value, "{:.4g}") for value in report.index])
    index.name = _READABLE.get(str(report.index.name), (report.index.name,))[0]
    return pd.DataFrame(
        dict(enumerate(columns)), index=index if len(index) else None
    ).set_axis(headings, axis=1)


def _as_shown(value: Any, style: str) -> str:
    if isinstance(value, (bool, str)) or value is None:
        return "" if value is None else str(value)
    if isinstance(value, tuple):
        return ", ".join(_as_shown(part, "{:.4g}") for part in value)
    if isinstance(value, (int, np.integer)):
        return str(value)
    if isinstance(value, (float, np.floating)):
        return (
            ""
            if np.isnan(value)
            else ("{:.4g}" if style == "{}" else style).format(value)
        )
    return str(value)


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
