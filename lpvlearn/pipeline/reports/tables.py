"""What a pipeline found: tables by operating point and by parameter, and a summary."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...data.experiments import Experiment
from ...data.motion import motions
from ...exceptions import warn
from ...lpv.model import LPVStateSpace
from ...lpv.spline import SplineLPV
from ...lpv.weighting import noise_explains
from ...metrics.reports import LABEL, as_shown, readable_report
from ...metrics.scores import parameter_fit
from ...models.statespace import StateSpace
from ...restructuring.estimator import GrayBoxRestructurer
from ...validation import number_shown
from ..one_basis.structured_models import StructuredModels
from ..points.common_delay import delay_in_samples
from ..points.fits import Measured, fit_of
from ..points.left_out import listed_errors
from ..points.local_models import LocalModel

Array = NDArray[np.float64]

# Constants are missed that are worth so many points of BFT, or where a local model is
# this poor, and was fitted to signals with means so many times their motion.
_WORTH, _POOR, _FAR = 5.0, 50.0, 2.0

_LOOKED_AT = 10  # experiments of an operating point: more tell the same of constants

# Errors of an interpolation, percent of the model's norm, below which they are rounding
_THROUGH = 1e-7
_MISSED = 0.3  # in that norm, beyond which a point is missed

_NO_FLOOR = 1e-8  # share of the black box's norm below which a floor is rounding
_ROUNDED = 1e-6  # part of a step by which stamps are off that are rounded


class Tables(NamedTuple):
    """What a pipeline found, as its attributes have it."""

    parameters: pd.DataFrame  # (n_points, n_params)
    deviations: pd.DataFrame  # their standard deviations: NaN where not known
    points: pd.DataFrame  # `report_`: a row per operating point, how good each step was
    by_parameter: pd.DataFrame  # `parameter_report_`: a row per parameter


class Summary(NamedTuple):
    """What a pipeline found, for people."""

    lines: list[str]
    points: pd.DataFrame  # of texts, a row per operating point
    parameters: pd.DataFrame | None  # of a structure: a row per parameter
    refinement: str = ""  # of a refiner, and its table

    @property
    def text(self) -> str:
        """All of it."""
        tables = [
            t.to_string() for t in (self.points, self.parameters) if t is not None
        ]
        return "\n\n".join(
            filter(None, ["\n".join(self.lines), *tables, self.refinement])
        )


def tables(
    found: StructuredModels, lpv: LPVStateSpace, sampling_time: float, growth: Array
) -> Tables:
    """Tabulate the results of steps 3 to 5 at the operating points.

    `growth` (n_points,) as of `growth_rates`.
    """
    points, theta = found.points, found.theta
    spread = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    labels = [row[0] if len(row) == 1 else tuple(row) for row in points.kappa.tolist()]
    index = pd.Index(labels, name="operating_point", tupleize_cols=False)
    names = pd.Index(found.structure.parameter_names)
    interpolated = lpv.parameters(points.kappa)
    unit = _root_mean_squares(theta)
    deviations = pd.DataFrame(spread, index, list(names))

    rows = []
    for k, own in enumerate(theta):
        row = _of_models(k, found, lpv, sampling_time)
        met = found.structure.model(interpolated[k])
        row["interpolation_error"] = _interpolation_error(found.models[k], met)
        row["interpolation_FIT"] = parameter_fit(own / unit, interpolated[k] / unit)
        row["growth_rate"] = growth[k]
        if found.restructurers:
            row |= dict(zip("param_" + names, own, strict=True))
            if not np.isnan(spread).all():
                row |= dict(zip("std_" + names, spread[k], strict=True))
        rows.append(row)
    by_point = pd.DataFrame(rows, index=index)
    if lpv.offsets is None:
        _tell_of_missed_constants(found, lpv.hold, sampling_time)
    _tell_of_missed_points(by_point["interpolation_error"], lpv, points.kappa)
    by_parameter = {
        "lowest": theta.min(axis=0),
        "highest": theta.max(axis=0),
        "std": deviations.median().to_numpy(),
        "interpolation_RMSE": np.sqrt(np.mean((theta - interpolated) ** 2, axis=0)),
        "interpolation_FIT": [
            parameter_fit(own, met)
            for own, met in zip(theta.T, interpolated.T, strict=True)
        ],
    }
    return Tables(
        pd.DataFrame(theta, index, list(names)),
        deviations,
        by_point,
        pd.DataFrame(by_parameter, index=names.rename("parameter")),
    )


def _of_models(
    k: int, found: StructuredModels, lpv: LPVStateSpace, sampling_time: float
) -> dict[str, Any]:
    """Experiments, local, structured and LPV model of an operating point."""
    group, model = found.points.experiments[k], found.local[k]
    known = Measured.of(group), sampling_time, model.n_trend, lpv.hold
    row: dict[str, Any] = {
        "n_experiments": len({e.label for e in group}),
        "n_samples": sum(len(e.rows) for e in group),
        "order": model.order,
        "horizon": model.horizon,
        "local_BFT": fit_of(model.lti, *known),
    }
    if found.restructurers:
        row["structured_BFT"] = fit_of(found.models[k], *known)
        row |= _restructuring(found.restructurers[k])
    place = found.points.kappa[[k]]
    frozen = lpv.at(place[0])
    row["lpv_BFT"] = np.nan
    if not frozen.poles().real.max(initial=0.0) > 0.0:
        row["lpv_BFT"] = fit_of(frozen, *known)
    if any(one.lti.input_delay.any() for one in found.local):
        samples = delay_in_samples(model, sampling_time)
        inputs = group[0].input_names
        row |= {f"delay_{u}": d for u, d in zip(inputs, samples, strict=True)}
    if lpv.offsets is not None:
        for prefix, signals, levels in (
            ("u0_", lpv.input_names, lpv.input_offset(place)[0]),
            ("y0_", lpv.output_names, lpv.output_offset(place)[0]),
        ):
            named = zip(signals or (), levels, strict=True)
            row |= {f"{prefix}{name}": level for name, level in named}
    return row


def _interpolation_error(gray_box: StateSpace, met: StateSpace) -> float:
    """Distance to the interpolated model, relative to the norm of the point's own."""
    size = gray_box.hinf_norm()
    if not 0 < size < np.inf:  # with integrators, whose gains need not agree
        return np.nan
    return (gray_box.with_input_delay(0) - met).hinf_norm() / size


def _tell_of_missed_constants(
    found: StructuredModels, hold: str, sampling_time: float
) -> None:
    """Tell what a model without offsets lacks, if it lacks some."""
    each = zip(found.local, found.points.experiments, strict=True)
    if not any(_misses_constants(*one, sampling_time, hold) for one in each):
        return
    if any(model.integrating for model in found.local):
        warn(
            "inputs or outputs stand away from zero, and models of `integrating` have "
            "no offsets: what a constant input or rate adds up to is missed. Subtract "
            "from the inputs where the system rests, or use the rates as outputs."
        )
    else:
        warn(
            "inputs or outputs stand away from zero, and the LPV model has no offsets: "
            "it misses what a constant of every experiment would explain. Have it "
            "found by offsets='auto', with local=SubspaceLTI(offset='auto'), or "
            "subtract from X and y where the system rests."
        )


def _tell_of_missed_points(errors: pd.Series, lpv: LPVStateSpace, kappa: Array) -> None:
    """Tell of points that are missed by a form, where noise does not explain it."""
    far = [(e, k) for k, e in enumerate(errors) if e > _MISSED]
    form = getattr(lpv.interpolator, "best_estimator_", None)  # nobody's choice
    if not far or form is None or noise_explains(form):
        return
    missed_at = listed_errors(sorted(far, reverse=True), kappa)
    if isinstance(form, SplineLPV):  # which met all of them
        warn(
            f"records that move have taken the LPV model from operating point(s) "
            f"{missed_at}, in percent of the H-infinity norm of the local models. "
            "Check what sets these records apart from those of the points: another "
            "load, units, offsets."
        )
    else:
        warn(
            "the LPV model misses the local models at operating point(s) "
            f"{missed_at}, in percent of their H-infinity norm: its parameters do "
            "not follow so simple a form. Use interpolator=SplineLPV(), which "
            "meets all points."
        )


def _misses_constants(
    model: LocalModel, group: Sequence[Experiment], sampling_time: float, hold: str
) -> bool:
    """Whether constants would explain more of the outputs of experiments at a point."""
    if model.rest is not None and not model.n_trend:
        return False  # they have been looked for
    group, constants = group[:_LOOKED_AT], max(1, model.n_trend)
    measured = Measured.of(group)
    best, without = (
        fit_of(model.lti, measured, sampling_time, n, hold) for n in (constants, 0)
    )
    return best - without > _WORTH or (
        without < _POOR
        and any((abs(mean) > _FAR * scale).any() for mean, scale in motions(group))
    )


def _restructuring(fitted: GrayBoxRestructurer) -> dict[str, float]:
    """Errors of step 4 at one point, relative to the black box's norm."""
    size = np.inf
    if fitted.relative_error_ > 0:
        size = fitted.error_ / fitted.relative_error_
    weighed = {}
    if hasattr(fitted, "hinf_params_"):
        weighed = {
            "relative_hinf_error": fitted.hinf_error_ / size,
            "chi2": fitted.chi2_,
            "degrees_of_freedom": fitted.degrees_of_freedom_,
            "p_value": fitted.p_value_,
        }
    return {
        "relative_error": fitted.relative_error_,
        "relative_floor": fitted.structural_floor_ / size,
        "remaining_error": fitted.remaining_error_ / size,
        "active_frequency": np.max(fitted.active_frequencies_, initial=0.0),
        "stationarity": fitted.stationarity_,
        **weighed,
    }


def summarise(
    found: Tables,
    lpv: LPVStateSpace,
    *,
    sampling_time: float,
    jitter: float,
    scheduling: Sequence[Hashable],
    local: str,
    restructurer: str,
) -> Summary:
    """What a fitted pipeline found, for people.

    `jitter` is by how much of a step time stamps are off, at most; `scheduling` names
    the variables (none: a time-invariant model), `local` and `restructurer` the classes
    of steps 3 and 4, or the states of black boxes.
    """
    report = found.points
    kappa = np.array([np.atleast_1d(label) for label in report.index], dtype=float)
    places = "no scheduling variable"
    if scheduling:
        spans = [
            f"{name} from {number_shown(low)} to {number_shown(high)}"
            for name, low, high in zip(
                scheduling, kappa.min(0), kappa.max(0), strict=True
            )
        ]
        places = f"{len(kappa)} operating point(s), {', '.join(spans)}"
    lines = [
        f"LPV model of order {lpv.order}: {lpv.n_inputs} input(s), {lpv.n_outputs} "
        f"output(s), {found.parameters.shape[1]} parameters",
        f"{report['n_experiments'].sum()} experiment(s), {report['n_samples'].sum()} "
        f"samples at {sampling_time:.4g} s"
        f"{', inputs linear between them' if lpv.hold == 'foh' else ''}, {places}",
        "",
        f"Local models: {local}, simulation fit (BFT) {_span(report['local_BFT'])} %",
    ]
    if jitter > _ROUNDED:
        lines.insert(2, f"Time stamps off by up to {100.0 * jitter:.2g} % of a step")
    if lpv.input_delay.any():
        samples = np.round(lpv.input_delay / sampling_time).astype(int)
        lines.insert(2, f"Input delay: {', '.join(map(str, samples))} sample(s)")
    if lpv.offsets is not None:
        names = [name for name in report if name.startswith(("u0_", "y0_"))]
        spans = [f"{name[3:]} {_span(report[name])}" for name in names]
        lines.append(f"Points of work: {', '.join(spans)}")
    hidden = ["u0_", "y0_", "param_", "std_", "n_", "stationarity", "horizon", "order"]
    hidden += ["relative_hinf_error", "chi2", "degrees_of_freedom", "lpv_BFT"]
    if report["growth_rate"].max() <= 0:
        hidden.append("growth_rate")
    restructured = "structured_BFT" in report
    if restructured:
        of_step, more = _nearness(found, restructurer)
        hidden += more
    else:
        of_step = [_without_structure(restructurer)]
    lines += [*of_step, *_interpolation(found, lpv, kappa)]
    if len(kappa) == 1:
        lines.append("One operating point: the model is time-invariant.")
    shown = [name for name in report.columns if not name.startswith(tuple(hidden))]
    parameters = None
    if restructured:
        parameters = readable_report(found.by_parameter.dropna(axis=1, how="all"))
    return Summary(lines, readable_report(report[shown]), parameters)


def _nearness(found: Tables, restructurer: str) -> tuple[list[str], list[str]]:
    """How near the structure comes to the black boxes; columns that need no place."""
    report = found.points
    error, floor = 100 * report["relative_error"], 100 * report["relative_floor"]
    remaining = 100 * report["remaining_error"]
    has_floor = report["relative_floor"].max() > _NO_FLOOR
    place = (
        f"the largest at {_label_of_largest(remaining)} near "
        f"{report['active_frequency'].iloc[_largest(remaining)]:.4g} rad/s"
    )
    weighed, spot = "p_value" in report, "" if has_floor else f", {place}"
    lines = [
        f"Restructuring: {restructurer}, "
        f"simulation fit (BFT) {_span(report['structured_BFT'])} %",
        f"    H-infinity error {_span(error)} % of the black box's norm"
        + ("" if weighed else spot),
    ]
    if has_floor:
        lines += [
            f"    of which no parameter can change {_span(floor)} %",
            f"    apart from that, {_span(remaining)} %, {place}",
        ]
    if weighed:
        best = 100 * report["relative_hinf_error"]
        misfit = report["chi2"] / report["degrees_of_freedom"].clip(lower=1)
        lines.append(f"    that of the H-infinity optimum {_span(best)} %{spot}")
        if misfit.notna().any():  # none of exact data
            lines.append(
                "    in the black box's standard deviations: chi-square per degree "
                f"of freedom {_span(misfit)}"
            )
    # Without a floor, all of the error remains.
    hidden = ["relative_error"] if has_floor else ["relative_floor", "remaining_error"]
    unknown = int(found.deviations.isna().all(axis=1).sum())
    if unknown:
        lines.append(
            f"    standard deviations of the parameters are not known at {unknown} "
            "point(s): see `parameters_std_`"
        )
    return lines, hidden


def _without_structure(states: str) -> str:
    """That there is none, and of what the states of the black boxes are."""
    basis = {
        "aligned": "each turned to its neighbour",
        "canonical": "in the observable canonical form",
    }.get(states, "which have no common state basis")
    return "Restructuring: none; the entries of black boxes are interpolated, " + basis


def _interpolation(found: Tables, lpv: LPVStateSpace, kappa: Array) -> list[str]:
    """How near the interpolation comes to the models of the operating points."""
    report = found.points
    distance = 100 * report["interpolation_error"]
    form = getattr(lpv.interpolator, "form_", "")
    theta = found.parameters.to_numpy()
    size = _root_mean_squares(theta)
    fit = parameter_fit(theta / size, lpv.parameters(kappa) / size)
    lines = [
        f"Interpolation: {lpv.interpolator}{form and f' ({form})'}, "
        f"parameter fit (FIT) {fit:.2f} %",
    ]
    if distance.max() > _THROUGH:
        lines.append(
            f"    H-infinity error {_span(distance)} % of the model's norm, the "
            f"largest at {_label_of_largest(distance)}"
        )
        if report["lpv_BFT"].notna().any():
            lines.append(f"    simulation fit (BFT) {_span(report['lpv_BFT'])} %")
    elif len(kappa) > 1 and distance.notna().all():  # no norm is where it integrates
        lines.append(
            "    through the local models: how good it is between them only data there "
            "tell"
        )
    return lines


def _root_mean_squares(theta: Array) -> Array:
    """Root mean square of every parameter: together they count alike in any unit."""
    size = np.sqrt(np.mean(theta**2, axis=0))
    return np.where(size > 0.0, size, 1.0)


def _span(values: pd.Series) -> str:
    low, high = f"{values.min():.4g}", f"{values.max():.4g}"
    return low if low == high else f"{low} to {high}"


def _largest(values: pd.Series) -> int:
    return int(values.fillna(0.0).to_numpy().argmax())


def _label_of_largest(values: pd.Series) -> str:
    return as_shown(values.index[_largest(values)], LABEL)
