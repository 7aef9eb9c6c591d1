"""Reports of fits as tables: one model, several side by side, for people."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.experiments import OPTIONAL_ROLES, ROLES, fitted_roles
from ..data.operating_points import mean_values
from ..data.tables import Table
from ..models.statespace import StateSpace
from ..validation import number_shown, one_of, squarable
from .scorers import InitialState, check_options
from .scores import accounted_variance, best_fit, r2_ratio
from .table_simulation import (
    ScheduledModel,
    TableSimulator,
    drop_start,
    owner_of_experiments,
    simulate,
    split,
    unwrap,
)


def fit_report(
    estimator: Any,
    X: Any,
    y: Any,
    *,
    initial_state: InitialState = "rest",
    burn_in: int = 0,
) -> pd.DataFrame:
    """Report the fit of every output in every experiment.

    Parameters
    ----------
    estimator : fitted estimator
        Anything with `predict`; without `split_experiments(X)`, the table is taken as
        one experiment.
    X : DataFrame or array-like of shape (n_samples, n_features)
    y : DataFrame, Series or array-like of shape (n_samples,) or (n_samples, n_outputs)
        Measured outputs; missing ones (NaN) are left out.
    initial_state : {"rest", "estimate"}, default="rest"
    burn_in : int, default=0
        As in `make_bft_scorer`.

    Returns
    -------
    DataFrame
        One row per experiment and output; columns `experiment`, `operating_point` (the
        label, else the mean of the scheduling variable, a tuple for several),
        `output`, `BFT` and `VAF` (percent), `RMSE` (units of the output), `R2`, and
        `n_missing`, samples of the output that were not measured or, for want of an
        input, not simulated.

    Raises
    ------
    ValueError
        When shapes differ, or `burn_in` leaves nothing of an experiment.
    TypeError
        When the estimator lacks the method that an option needs.

    Warns
    -----
    UserWarning
        When an experiment that is simulated from rest starts in mid-motion.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from lpvlearn import fit_report
    >>> u = np.array([[0.0], [1.0], [2.0]])
    >>> fit_report(LinearRegression().fit(u, [0, 1, 2]), u, [0, 1, 3]).round(3)
       experiment operating_point output     BFT     VAF   RMSE     R2  n_missing
    0           0            None     y1  53.709  85.714  0.577  0.786          0
    """
    check_options(initial_state, burn_in)
    simulator, X = unwrap(estimator, X)
    found = simulate(simulator, X, y, initial_state)
    Y, names = found.measured, found.names
    groups = [np.arange(len(Y))]
    labels: list[tuple[Hashable, Hashable]] = [(0, None)]
    if burn_in or owner_of_experiments(simulator) is not None:
        groups = split(simulator, X)
        owner, table = owner_of_experiments(simulator), Table(X)
        labels = _labels(fitted_roles(owner, table, optional=ROLES), table, groups)
    parts = []
    for rows, (experiment, operating_point) in zip(
        drop_start(groups, burn_in), labels, strict=True
    ):
        true, pred = Y[rows], found.simulated[rows]
        columns: dict[str, Any] = {"output": names, **_measures(true, pred)}
        parts += [
            {"experiment": experiment, "operating_point": operating_point}
            | {column: values[k] for column, values in columns.items()}
            for k in range(len(names))
        ]
    if not burn_in:
        found.warn_of_motion(simulator, X)
    return pd.DataFrame(parts)


def _measures(
    true: NDArray[np.float64], pred: NDArray[np.float64]
) -> dict[str, NDArray[Any]]:
    """Measures of fit of every output; NaN for one that was never measured."""
    missing = np.isnan(squarable("y", true))
    known = np.asarray(~missing.all(axis=0))
    columns: dict[str, NDArray[Any]] = {}
    true, pred = true[:, known], pred[:, known]
    for name, values in {
        "BFT": best_fit(true, pred),
        "VAF": accounted_variance(true, pred),
        "RMSE": np.sqrt(np.nanmean((true - pred) ** 2, axis=0)),
        "R2": r2_ratio(true, pred),
    }.items():
        columns[name] = np.full(len(known), np.nan)
        columns[name][known] = values
    return columns | {"n_missing": missing.sum(axis=0)}


def _labels(
    roles: Mapping[str, Any], table: Table, groups: Sequence[NDArray[np.intp]]
) -> list[tuple[Hashable, Hashable]]:
    """The experiment's and operating point's label for each group of rows."""
    label = table.one(roles["experiment"], "experiment")
    point = table.one(roles["operating_point"], "operating_point")
    kappa = table.several(roles["scheduling"], "scheduling")
    names: list[Hashable] = [0] * len(groups)
    points: list[Hashable] = [None] * len(groups)
    if label is not None:
        names = label.labels([rows[0] for rows in groups])
    if point is not None:
        points = point.labels([rows[0] for rows in groups])
    elif kappa:
        values = np.column_stack([column.numbers("X") for column in kappa])
        means = [tuple(mean_values(values[rows]).tolist()) for rows in groups]
        points = [mean if len(mean) > 1 else mean[0] for mean in means]
    return list(zip(names, points, strict=True))


_DIGITS = "{:.4g}"  # of numbers without a format of their own
LABEL = "{}"  # what tells rows apart

# Heading and format of the columns of the reports, for people.
_READABLE = {
    "model": ("model", LABEL),
    "experiment": ("experiment", LABEL),
    "operating_point": ("operating point", LABEL),
    "output": ("output", LABEL),
    "BFT": ("BFT", "{:.2f}"),
    "VAF": ("VAF", "{:.2f}"),
    "RMSE": ("RMSE", "{:.3g}"),
    "R2": ("R2", "{:.4f}"),
    "n_missing": ("missing", "{:.0f}"),
    "n_experiments": ("experiments", "{:.0f}"),
    "n_samples": ("samples", "{:.0f}"),
    "order": ("order", "{:.0f}"),
    "horizon": ("horizon", "{:.0f}"),
    "local_BFT": ("local BFT", "{:.2f}"),
    "structured_BFT": ("gray-box BFT", "{:.2f}"),
    "lpv_BFT": ("LPV BFT", "{:.2f}"),
    "relative_error": ("relative error", "{:.2e}"),
    "relative_floor": ("floor", "{:.2e}"),
    "remaining_error": ("remaining error", "{:.2e}"),
    "active_frequency": ("active at rad/s", "{:.4g}"),
    "stationarity": ("stationarity", "{:.0e}"),
    "relative_hinf_error": ("H-infinity optimum", "{:.2e}"),
    "chi2": ("chi-square", "{:.4g}"),
    "degrees_of_freedom": ("degrees of freedom", "{:.0f}"),
    "p_value": ("p-value", "{:.2g}"),
    "interpolation_error": ("interpolation error", "{:.2e}"),
    "growth_rate": ("growth [1/s]", "{:.3g}"),
    "interpolation_FIT": ("interpolation FIT", "{:.2f}"),
    "interpolation_RMSE": ("interpolation RMSE", "{:.2g}"),
    "lowest": ("lowest", "{:.4g}"),
    "highest": ("highest", "{:.4g}"),
    "std": ("std", "{:.2g}"),
}


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
    >>> from lpvlearn import readable_report
    >>> readable_report(pd.DataFrame({"local_BFT": [96.83157], "param_k": [3.0]}))
      local BFT  k
    0     96.83  3
    """
    if not isinstance(report, pd.DataFrame):
        raise ValueError(
            "`report` must be a DataFrame, such as fit_report returns. Got "
            f"{type(report).__name__}."
        )
    headings, columns = [], []
    for name, column in report.items():
        heading, style = _READABLE.get(str(name), (str(name), _DIGITS))
        heading = heading.removeprefix("param_").replace("std_", "std ", 1)
        headings.append(heading)
        columns.append([as_shown(value, style) for value in column])
    index = pd.Index([as_shown(value, LABEL) for value in report.index])
    index.name = _READABLE.get(str(report.index.name), (report.index.name,))[0]
    return pd.DataFrame(
        dict(enumerate(columns)), index=index if len(index) else None
    ).set_axis(headings, axis=1)


def as_shown(value: Any, style: str) -> str:
    """A cell of a report as text; nothing for a value that is not known."""
    if isinstance(value, tuple):
        return ", ".join(as_shown(part, style) for part in value)
    if isinstance(value, (float, np.floating)):
        if np.isnan(value):
            return ""
        return number_shown(float(value)) if style == LABEL else style.format(value)
    return "" if value is None else str(value)


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
    for name in roles:
        one_of("roles", name, (*ROLES, "sampling_time"))
    known = _roles_of(models.values(), X) | roles
    if known.get("time") is not None and "sampling_time" not in roles:
        known["sampling_time"] = None  # every experiment tells its own
    parts = []
    for name, model in models.items():
        if isinstance(model, (ScheduledModel, StateSpace)):
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


def _roles_of(models: Any, X: Any) -> dict[str, Any]:
    """Roles, sampling time and tolerance of the first estimator that has them."""
    for model in models:
        owner = owner_of_experiments(model)
        if owner is not None:
            step = getattr(owner, "sampling_time_", owner.sampling_time)
            return fitted_roles(owner, Table(X), optional=OPTIONAL_ROLES) | {
                "sampling_time": step,
                "time_tol": owner.time_tol,
            }
    return {}
