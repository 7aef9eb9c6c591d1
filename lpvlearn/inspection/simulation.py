"""Measured and simulated outputs over time."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.alignment import align_outputs, beside
from ..data.experiments import ROLES, fitted_roles
from ..data.tables import Table, as_numbers, read_outputs
from ..data.timestamps import time_in_seconds
from ..metrics.scorers import check_options
from ..metrics.scores import best_fit
from ..metrics.table_simulation import simulate, unwrap
from .drawing import (
    ACCENT,
    axes_grid,
    band,
    by_name,
    drawable,
    given_names,
    legend_above,
    line_style,
    tidy,
    units_of,
    whole,
    with_unit,
)
from .fitted import units_for

Array = NDArray[np.float64]

Units = str | Sequence[str] | Mapping[str, str] | None

# Dense signals hide each other whatever their dashes: a broad pale line for the
# measurement stays visible under thin dark ones.
_MEASURED = {"color": "0.68", "linestyle": "-", "linewidth": 2.6}

_FIRST = {"color": ACCENT, "linestyle": "-", "linewidth": 1.0}


class SimulationDisplay:
    """Measured and simulated outputs, one below the other, with their fit.

    Make it with `from_estimator` or `from_predictions`.

    Parameters
    ----------
    time : ndarray of shape (n_samples,)
        Seconds (or sample numbers, with another `time_label`).
    y_true : ndarray of shape (n_samples, n_outputs)
        Measured outputs; missing ones (NaN) leave a gap, and do not count.
    predictions : dict from str to ndarray of shape (n_samples, n_outputs)
        Simulated outputs, by name of the model.
    std : dict from str to ndarray of shape (n_samples, n_outputs), default=None
        Standard deviations of some of the simulated outputs, drawn as bands.
    output_names : sequence of str, default=None
        None is y1, y2, ...
    units : str, sequence of str or dict, default=None
        Unit of all outputs, one for each, or by name.
    time_label : str, default="Time (s)"
    true_name : str, default="measured"
        What `y_true` is, in the legend.

    Attributes
    ----------
    bft_ : dict from str to ndarray of shape (n_outputs,)
        Best fit ratios, percent, over the whole record.
    n_missing_ : ndarray of shape (n_outputs,)
        Samples of every output that are missing.
    axes_ : ndarray of Axes of shape (n_outputs,)
    figure_ : Figure
    lines_ : dict from str to list of Line2D
        By `true_name` and the names of the models; one line for each output.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn.inspection import SimulationDisplay
    >>> time = np.linspace(0.0, 1.0, 101)
    >>> y = np.sin(10 * time)
    >>> display = SimulationDisplay.from_predictions(
    ...     time, y, {"model": 0.9 * y}, units="rad/s")
    >>> [text.get_text() for text in display.axes_[0].get_legend().get_texts()]
    ['measured', 'model: BFT 89.6 %']
    """

    def __init__(
        self,
        time: ArrayLike,
        y_true: ArrayLike,
        predictions: Mapping[str, ArrayLike],
        *,
        std: Mapping[str, ArrayLike] | None = None,
        output_names: Sequence[Hashable] | None = None,
        units: Units = None,
        time_label: str = "Time (s)",
        true_name: str = "measured",
    ) -> None:
        outputs, names = read_outputs(y_true)
        self.y_true = as_numbers("y_true", outputs)
        n_outputs = self.y_true.shape[1]
        self.time = as_numbers("time", time, finite=True)
        if self.time.shape != (len(self.y_true),):
            raise ValueError(
                f"`time` must have shape ({len(self.y_true)},), a value for each row "
                f"of `y_true`. Got {self.time.shape}."
            )
        self.predictions = {
            name: as_numbers("predictions", read_outputs(beside(y_true, y))[0])
            for name, y in by_name("predictions", predictions).items()
        }
        self.true_name = true_name = str(true_name)
        if true_name in self.predictions:
            raise ValueError(
                f"`y_pred` must not name a simulation {true_name!r}, which names "
                "`y_true`."
            )
        self.bft_, self.n_missing_ = {}, np.isnan(self.y_true).sum(axis=0)
        for name, y_pred in self.predictions.items():
            if y_pred.shape != self.y_true.shape:
                raise ValueError(
                    f"the simulation {name!r} must have the shape of `y_true`, "
                    f"{self.y_true.shape}. Got {y_pred.shape}."
                )
            self.bft_[name] = best_fit(self.y_true, y_pred)
        self.std = {
            name: as_numbers("std", read_outputs(beside(y_true, own))[0])
            for name, own in by_name("std", std).items()
        }
        for name, own in self.std.items():
            if name not in self.predictions or own.shape != self.y_true.shape:
                raise ValueError(
                    "`std` must have names of simulations, and standard deviations of "
                    f"the shape of `y_true`, {self.y_true.shape}. Got {name!r} with "
                    f"shape {own.shape}."
                )
        given = names if output_names is None else output_names
        self.output_names = given_names("output_names", given, n_outputs, "y")
        self.units = units_of(self.output_names, units)
        self.time_label = time_label

    @classmethod
    def from_predictions(
        cls,
        time: ArrayLike,
        y_true: ArrayLike,
        y_pred: Mapping[str, ArrayLike] | ArrayLike,
        *,
        output_names: Sequence[Hashable] | None = None,
        units: Units = None,
        true_name: str = "measured",
        zoom: tuple[float, float] | None = None,
        ax: Any = None,
    ) -> SimulationDisplay:
        """Draw simulated outputs beside measured ones.

        Parameters
        ----------
        time : array-like of shape (n_samples,)
            Seconds.
        y_true : array-like of shape (n_samples,) or (n_samples, n_outputs)
        y_pred : dict from str to array-like of the shape of `y_true`, or one of these
        output_names : sequence of str, default=None
            None is the columns of `y_true`, else y1, y2, ...
        units : str, sequence of str or dict, default=None
        true_name : str, default="measured"
            What `y_true` is, in the legend: "simulated arm", "truth".
        zoom : tuple (t_start, t_stop), default=None
            Part of the record to draw, in seconds; the fit stays that of the whole.
        ax : Axes or array of Axes, default=None

        Returns
        -------
        SimulationDisplay

        Raises
        ------
        ValueError
            If shapes differ, a value is infinite or huge, a simulation is NaN where
            there is a measurement, or `zoom` holds no samples.
        """
        named = y_pred if isinstance(y_pred, Mapping) else {"simulated": y_pred}
        display = cls(
            time,
            y_true,
            named,
            output_names=output_names,
            units=units,
            true_name=true_name,
        )
        return display.plot(ax, zoom=zoom)

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: Any,
        y: Any,
        *,
        experiment: Hashable = None,
        initial_state: str = "rest",
        name: str = "simulated",
        uncertainty: bool = False,
        units: Units = None,
        zoom: tuple[float, float] | None = None,
        ax: Any = None,
    ) -> SimulationDisplay:
        """Simulate an experiment of a table and draw it beside the measurement.

        Parameters
        ----------
        estimator : fitted estimator, or a fitted search over one
            With `split_experiments`, as `SubspaceLTI` and `LocalLPVPipeline`.
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)
        experiment : hashable, default=None
            Label of the experiment; None is the first in the table.
        initial_state : {"rest", "estimate"}, default="rest"
            "estimate" fits the initial state to `y` by least squares, for tables that
            start in the middle of an experiment.
        name : str, default="simulated"
            Of the model, in the legend.
        uncertainty : bool, default=False
            Whether to draw the band of two standard deviations of the outputs without
            noise: those of ``predict(X, return_std=True)``, as `LocalLPVPipeline` and
            `OutputErrorLPV` have it.
        units : str, sequence of str or dict, default=None
            Of the outputs; None: those that the pipeline knows.
        zoom : tuple (t_start, t_stop), default=None
            Part of the experiment to draw, in seconds.
        ax : Axes or array of Axes, default=None

        Returns
        -------
        SimulationDisplay

        Raises
        ------
        ValueError
            If there is no such experiment, an option is unknown, or the uncertainty
            is not known.
        """
        check_options(initial_state)
        estimator, X = unwrap(estimator, X)
        uncertainty = bool(whole("uncertainty", uncertainty, range(2)))
        if uncertainty and (
            initial_state != "rest" or not hasattr(estimator, "prediction_std")
        ):
            raise ValueError(
                "`uncertainty` must be False but for simulations from rest of an "
                "estimator that knows it, as LocalLPVPipeline does. Got True with "
                f"{type(estimator).__name__} and initial_state={initial_state!r}."
            )
        if not hasattr(estimator, "split_experiments"):
            raise ValueError(
                "`estimator` must tell the experiments of a table by "
                f"split_experiments(X). Got {type(estimator).__name__}; simulate with "
                "it and use from_predictions()."
            )
        X = Table(X).X
        outputs, names = read_outputs(align_outputs(X, y, estimator))
        rows = _rows_of(estimator, X, experiment)
        part = X.iloc[rows] if hasattr(X, "iloc") else X[rows]
        found = simulate(estimator, part, outputs[rows], initial_state)
        found.warn_of_motion(estimator, part)
        std = None
        if uncertainty:
            known = estimator.prediction_std(part)
            std = {str(name): known.xs("total", axis=1, level="part")}
        time, label = _time_of(estimator, Table(part))
        display = cls(
            time,
            found.measured,
            {str(name): found.simulated},
            std=std,
            output_names=names,
            units=units_for(estimator, units),
            time_label=label,
        )
        return display.plot(ax, zoom=zoom)

    def plot(
        self,
        ax: Any = None,
        *,
        zoom: tuple[float, float] | None = None,
        n_std: float = 2.0,
    ) -> SimulationDisplay:
        """Draw the outputs, one below the other.

        Parameters
        ----------
        ax : Axes or array of Axes, default=None
            None makes a figure.
        zoom : tuple (t_start, t_stop), default=None
            Part of the record to draw, in seconds.
        n_std : float, default=2.0
            Half-width of the bands, in standard deviations.

        Returns
        -------
        SimulationDisplay
        """
        shown = self._window(zoom)
        n_outputs = len(self.output_names)
        height = 0.5 + (2.9 if n_outputs == 1 else 2.0 * n_outputs)
        self.figure_, axes = axes_grid(ax, n_outputs, 1, height=height, sharex=True)
        self.axes_ = axes[:, 0]
        self.lines_: dict[str, list[Any]] = {self.true_name: []}
        self.lines_ |= {name: [] for name in self.predictions}
        title = None
        if zoom is not None:
            title = f"BFT of the whole record, {self.time[0]:g} to {self.time[-1]:g} s"
        for i, one in enumerate(self.axes_):
            lost = self.n_missing_[i]
            known = f"{self.true_name}, {lost} missing" if lost else self.true_name
            signals = {self.true_name: (self.y_true, known)}
            for name, y_pred in self.predictions.items():
                wide = f" ± {n_std:g} std" if name in self.std else ""
                fit = f"{name}{wide}: BFT {self.bft_[name][i]:.1f} %"
                signals[name] = (y_pred, fit)
            for k, (name, (signal, label)) in enumerate(signals.items()):
                style = _style(k, int(shown.sum()))
                (line,) = one.plot(
                    self.time[shown], signal[shown, i], label=label, **style
                )
                self.lines_[name].append(line)
                if name in self.std:
                    width = n_std * self.std[name][:, i]
                    low, high = signal[:, i] - width, signal[:, i] + width
                    ends, colour = (low[shown], high[shown]), line.get_color()
                    band(one, self.time[shown], *ends, colour, alpha=0.35)
            tidy(one)
            one.set_ylabel(with_unit(self.output_names[i], self.units[i]))
            one.set_xlim(self.time[shown][0], self.time[shown][-1])
            legend_above(one, [lines[i] for lines in self.lines_.values()], title=title)
            title = None
        self.axes_[-1].set_xlabel(self.time_label)
        drawable(self.figure_)
        return self

    def _window(self, zoom: tuple[float, float] | None) -> NDArray[np.bool_]:
        if zoom is None:
            return np.ones(len(self.time), dtype=bool)
        edges = as_numbers("zoom", zoom).ravel()
        first, last = edges if len(edges) == 2 else (np.inf, np.inf)
        shown = (self.time >= first) & (self.time <= last)
        if shown.sum() < 2:
            raise ValueError(
                "`zoom` must be (t_start, t_stop) with at least 2 samples between, "
                f"within {self.time[0]:g} to {self.time[-1]:g}. Got {zoom}."
            )
        return shown


def _style(k: int, n_samples: int) -> dict[str, Any]:
    """Keywords of the measurement (0), of the first simulation, of further ones."""
    if k < 2:
        return dict((_MEASURED, _FIRST)[k])
    return line_style(k, n_samples) | {"linewidth": 1.2}


def _rows_of(estimator: Any, X: Any, label: Hashable) -> NDArray[np.intp]:
    """Rows of an experiment of the table."""
    groups = estimator.split_experiments(X)
    if label is None:
        return groups[0]
    column = Table(X).one(getattr(estimator, "experiment", None), "experiment")
    if column is None:
        raise ValueError(
            "`experiment` must be None, as the estimator takes the table for one "
            f"experiment. Got {label!r}."
        )
    labels = column.labels([rows[0] for rows in groups])
    places = dict(zip(labels, groups, strict=True))
    try:
        rows = places.get(label)
    except TypeError:  # no label at all
        rows = None
    if rows is None:
        shown = ", ".join(map(repr, labels[:10]))
        shown += ", ..." if len(labels) > 10 else ""
        raise ValueError(
            f"`experiment` must be the label of an experiment in X: {shown}. Got "
            f"{label!r}."
        )
    return rows


def _time_of(estimator: Any, table: Table) -> tuple[Array, str]:
    """Time of every row in seconds, else sample numbers; and the axis label."""
    column = table.one(fitted_roles(estimator, table, optional=ROLES)["time"], "time")
    if column is not None:
        seconds = time_in_seconds(column.values, column.name)
        return np.asarray(seconds, dtype=float), "Time (s)"
    number = np.arange(table.n_rows, dtype=np.float64)
    step = getattr(estimator, "sampling_time_", None)
    if step is None and hasattr(estimator, "lti_"):
        step = estimator.lti_.sampling_time
    if step is None or step is True:
        return number, "Sample"
    return float(step) * number, "Time (s)"
