"""Parameters of local models over the scheduling variable."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone

from ..data.tables import as_numbers
from ..models.scheduling_range import domains
from .drawing import (
    axes_grid,
    band,
    by_name,
    colour_bar,
    colour_scale,
    drawable,
    figure_legend,
    given_names,
    is_names,
    labels_of,
    named,
    point_style,
    tidy,
    units_of,
    whole,
    with_unit,
)
from .fitted import fitted_pipeline, scheduling_labels, units_for, with_others

Array = NDArray[np.float64]

_N_CURVE = 200  # points of a curve

_N_MAP = 60  # points along a side of a map

_DOT = 34.0  # area of a point on a map, square points; those of further sets are rings

_CONSTANT = 1e-6  # a parameter that varies less, relative to its size, is drawn flat


class ParameterDisplay:
    """Small multiples: each parameter over the scheduling variable, or over two.

    Points are local models, lines the interpolation through them. Over two variables
    the interpolation is a map, on which the points are dots in the colours of the
    map: those that stand out are off it. Further sets are rings about the dots. Make it
    with `from_estimator` or `from_parameters`.

    Parameters
    ----------
    kappa : array-like of shape (n_points,) or (n_points, n_scheduling)
        Scheduling values of the operating points, of two variables at most.
    parameters : dict from str to array-like of shape (n_points, n_params)
        Sets of parameters, by name.
    names : sequence of str, default=None
        Names of the parameters. None is the columns of a DataFrame, else p1, p2, ...
        The names of columns may be fewer than these: a selection.
    interpolators : dict from str to fitted regressor, default=None
        Curves for some of the sets: regressors that predict all parameters from
        scheduling values of shape (n, n_scheduling). A map shows the first.
    std : dict from str to array-like of shape (n_points, n_params), default=None
        Standard deviations of some of the sets, drawn as bars at the points, over one
        variable.
    curve_std : dict from str to callable, default=None
        Functions from scheduling values (n, 1) to standard deviations (n, n_params) of
        some of the curves, drawn as bands.
    scheduling_label : str or sequence of str, default="κ"
        Labels of the axes; one for two variables is numbered.
    units : dict from str to str, default=None
        Units of the parameters, by name.

    Attributes
    ----------
    axes_ : ndarray of Axes of shape (n_params,)
    figure_ : Figure
    lines_ : dict from str to list of Line2D or PathCollection
        Points of each set, one entry a parameter.
    curves_ : dict from str to list of Line2D or QuadMesh
        Curves of each set that has an interpolator; the map of the first.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import PolynomialLPV
    >>> from lpvlearn.inspection import ParameterDisplay
    >>> kappa = np.linspace(-1, 1, 5)
    >>> theta = np.column_stack([kappa, 1 - kappa**2])
    >>> display = ParameterDisplay.from_parameters(
    ...     kappa, {"local": theta}, interpolator=PolynomialLPV(degree=2))
    >>> [ax.get_title() for ax in display.axes_]
    ['p1', 'p2']
    """

    def __init__(
        self,
        kappa: ArrayLike,
        parameters: Mapping[str, ArrayLike],
        *,
        names: Sequence[Hashable] | None = None,
        interpolators: Mapping[str, Any] | None = None,
        std: Mapping[str, ArrayLike] | None = None,
        curve_std: Mapping[str, Callable[[Array], ArrayLike]] | None = None,
        scheduling_label: str | Sequence[str] = "κ",
        units: Mapping[str, str] | None = None,
    ) -> None:
        points = as_numbers("kappa", kappa, finite=True)
        self.kappa = points[:, None] if points.ndim < 2 else points
        n_scheduling = self.kappa.shape[1]
        if n_scheduling not in (1, 2):
            raise ValueError(
                "ParameterDisplay needs one or two scheduling variables as its axes. "
                f"Got {n_scheduling}. Fix all but two: take the operating points and "
                "parameters at one value of the others, and from_parameters()."
            )
        self.scheduling_labels = labels_of(scheduling_label, n_scheduling)
        self.units = by_name("units", units)
        sets = named("parameters", parameters, "tables of parameters")
        self.all_names, self.chosen = _names_and_choice(sets, names)
        self.parameters, self.std = (
            {
                name: self._table(f"{argument}[{name!r}]", table)
                for name, table in tables.items()
            }
            for argument, tables in (("parameters", sets), ("std", by_name("std", std)))
        )
        self.interpolators = by_name("interpolators", interpolators)
        self.curve_std = by_name("curve_std", curve_std)
        _check_can("interpolators", self.interpolators, "predict")
        _check_can("curve_std", self.curve_std, "__call__")

    def _table(self, argument: str, table: Any) -> Array:
        if hasattr(table, "columns"):
            table = _in_order(argument, table, self.all_names)
        values = as_numbers(argument, table)
        shape = len(self.kappa), len(self.all_names)
        if values.shape != shape:
            raise ValueError(
                f"`{argument}` must have shape {shape}: a row for each scheduling "
                "value in `kappa`, a column for each parameter. Got "
                f"{values.shape}."
            )
        return values

    @property
    def names(self) -> list[str]:
        """Names of the parameters that are drawn."""
        return [self.all_names[k] for k in self.chosen]

    @classmethod
    def from_parameters(
        cls,
        kappa: ArrayLike,
        parameters: Mapping[str, ArrayLike],
        *,
        names: Sequence[Hashable] | None = None,
        interpolator: Any = None,
        scheduling_label: str | Sequence[str] = "κ",
        units: Mapping[str, str] | None = None,
        n_columns: int | None = None,
        ax: Any = None,
    ) -> ParameterDisplay:
        """Draw sets of parameters, and a fitted curve through each.

        Parameters
        ----------
        kappa : array-like of shape (n_points,) or (n_points, n_scheduling)
            Of two scheduling variables at most.
        parameters : dict from str to array-like of shape (n_points, n_params)
            DataFrames bring the names of the parameters.
        names : sequence of str, default=None
            Names of the columns of arrays; a selection of columns of DataFrames.
        interpolator : regressor, default=None
            Fitted (a clone) to each set for its curve. None draws points only.
        scheduling_label : str or sequence of str, default="κ"
        units : dict from str to str, default=None
            Units of the parameters, by name.
        n_columns : int, default=None
            Panels in a row; None is 4, of maps 2.
        ax : Axes or array of Axes, default=None

        Returns
        -------
        ParameterDisplay

        Raises
        ------
        ValueError
            If shapes do not fit, or there are three scheduling variables or more.
        """
        display = cls(
            kappa,
            parameters,
            names=names,
            scheduling_label=scheduling_label,
            units=units,
        )
        if interpolator is not None and not hasattr(interpolator, "get_params"):
            raise ValueError(
                "`interpolator` must be a regressor, such as PolynomialLPV(), or None. "
                f"Got {type(interpolator).__name__}."
            )
        if interpolator is not None:
            display.interpolators = {
                name: clone(interpolator).fit(display.kappa, theta)
                for name, theta in display.parameters.items()
            }
        return display.plot(ax, n_columns=n_columns)

    @classmethod
    def from_estimator(
        cls,
        pipeline: Any,
        *,
        others: Mapping[str, ArrayLike] | None = None,
        forms: Mapping[str, Any] | None = None,
        names: Sequence[Hashable] | None = None,
        name: str | None = None,
        uncertainty: bool | None = None,
        scheduling_label: str | Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        n_columns: int | None = None,
        ax: Any = None,
    ) -> ParameterDisplay:
        """Draw a pipeline's local parameters and their interpolation.

        Parameters
        ----------
        pipeline : fitted LocalLPVPipeline
            With one or two scheduling variables.
        others : dict from str to array-like of shape (n_points, n_params), default=None
            Parameters at the same operating points to compare with, drawn as points:
            the truth, an analytic model.
        forms : dict from str to interpolator, default=None
            Other interpolations of the same parameters, to see the choice: clones are
            fitted, with the covariances where they take them. Of one variable.
        names : sequence of str, default=None
            Parameters to draw; None is all.
        name : str, default=None
            Of the pipeline's parameters in the legend. None is "restructured", or
            "balanced" without a restructurer.
        uncertainty : bool, default=None
            Whether to draw two standard deviations: of the local parameters as bars, of
            their interpolation as a band. None draws what is known. Of the parameters,
            that is: what the model's own error does to outputs is another thing, see
            `SimulationDisplay`. Over two variables it is not drawn.
        scheduling_label : str or sequence of str, default=None
            None is the names of the scheduling columns.
        units : dict from str to str, default=None
            Units of the parameters and of the scheduling variables, by name; None:
            those that the pipeline knows.
        n_columns : int, default=None
            Panels in a row; None is 4, of maps 2.
        ax : Axes or array of Axes, default=None

        Returns
        -------
        ParameterDisplay

        Raises
        ------
        ValueError
            If the pipeline is not fitted or has more than two scheduling variables,
            `others` has other shapes, there are `forms` in two variables, or the
            uncertainty is asked for and not known.
        """
        pipeline = fitted_pipeline(pipeline, "parameters_")
        if name is not None:
            name = str(name)
        else:
            name = "restructured" if pipeline.restructurers_ else "balanced"
        table = pipeline.parameters_
        known: dict[str, Any] = {}
        asked = uncertainty is None or whole("uncertainty", uncertainty, range(2))
        if asked and uncertainty is not None:
            pipeline.lpv_.covariance_root()  # refuses where there is none
        if asked:
            if pipeline.lpv_.covariance is not None:
                known["curve_std"] = {name: partial(_curve_std, pipeline.lpv_)}
            if np.isfinite(pipeline.parameters_std_).all(axis=None):
                known["std"] = {name: pipeline.parameters_std_}
        kappa = pipeline.operating_points_
        n_scheduling = kappa.shape[1]
        others_of_form = by_name("forms", forms)
        if others_of_form and n_scheduling > 1:
            raise ValueError(
                "`forms` must be None for two scheduling variables: maps show one. Got "
                f"{', '.join(map(repr, others_of_form))}."
            )
        _check_can("forms", others_of_form, "fit")
        drawn = {name: pipeline.interpolator_}
        for other, form in others_of_form.items():
            weighed = "covariance" in signature(form.fit).parameters
            P = {"covariance": pipeline.parameters_covariance_} if weighed else {}
            drawn[other] = clone(form).fit(kappa, table, **P)
        display = cls(
            kappa,
            with_others(dict.fromkeys(drawn, table), by_name("others", others)),
            names=names,
            interpolators=drawn,
            **known,
            scheduling_label=scheduling_labels(pipeline, n_scheduling, units)
            if scheduling_label is None
            else scheduling_label,
            units=units_for(pipeline, units),
        )
        return display.plot(ax, n_columns=n_columns)

    def plot(
        self, ax: Any = None, *, n_columns: int | None = None, n_std: float = 2.0
    ) -> ParameterDisplay:
        """Draw a panel for each parameter.

        Parameters
        ----------
        ax : Axes or array of Axes, default=None
            None makes a figure. Of an array, as many as there are places in the grid.
        n_columns : int, default=None
            Panels in a row; None is 4, of maps 2.
        n_std : float, default=2.0
            Half-width of bars and bands, in standard deviations.

        Returns
        -------
        ParameterDisplay
        """
        names, maps = self.names, self.kappa.shape[1] == 2
        if n_columns is None:
            n_columns = 2 if maps else 4
        n_columns = min(whole("n_columns", n_columns, range(1, 100)), len(names))
        n_rows = -(-len(names) // n_columns)
        row = 2.3 if maps else 1.45 if n_rows > 1 else 2.4
        height = 0.6 + row * n_rows
        self.figure_, axes = axes_grid(ax, n_rows, n_columns, height=height)
        for spare in axes.flat[len(names) :]:
            spare.set_axis_off()
        self.axes_ = axes.ravel()[: len(names)]
        self.lines_: dict[str, list[Any]] = {name: [] for name in self.parameters}
        self.curves_: dict[str, list[Any]] = {name: [] for name in self.interpolators}
        (self._draw_maps if maps else self._draw_curves)(n_std)
        for number, one in enumerate(self.axes_):
            self._dress(one, names[number], number >= len(names) - n_columns)
            if maps and number % n_columns == 0:
                one.set_ylabel(self.scheduling_labels[1])
        if not maps or len(self.parameters) > 1:
            handles = [
                lines[name][0]
                for name in self.parameters
                for lines in (self.lines_, {} if maps else self.curves_)
                if name in lines
            ]
            figure_legend(self.figure_, self.axes_[0], handles, own=ax is None)
        drawable(self.figure_)
        return self

    def _draw_maps(self, _: float) -> None:
        """The interpolation as a map, points as dots and rings in its colours."""
        ends = np.array([self.kappa.min(axis=0), self.kappa.max(axis=0)])
        low, high = domains(ends)
        sides = np.linspace(low, high, _N_MAP)
        inside = np.clip(sides, *ends)  # none is beyond a constant one
        grid = np.stack(np.meshgrid(*inside.T), axis=-1)
        shown = next(iter(self.interpolators), None)
        surface = None
        if shown is not None:
            found = self.interpolators[shown].predict(grid.reshape(-1, 2))
            surface = np.reshape(found, (_N_MAP, _N_MAP, -1))
        for one, column in zip(self.axes_, self.chosen, strict=True):
            values = [theta[:, column] for theta in self.parameters.values()]
            if surface is not None:
                values.append(surface[..., column].ravel())
            colours = colour_scale(np.concatenate(values))
            if surface is not None:
                drawn = one.pcolormesh(
                    *sides.T,
                    surface[..., column],
                    shading="nearest",
                    rasterized=True,
                    **colours,
                )
                self.curves_[str(shown)].append(drawn)
            for k, name in enumerate(self.parameters):
                drawn = one.scatter(
                    *self.kappa.T,
                    c=values[k],
                    s=_DOT * (1 + 1.6 * k) ** 2,
                    edgecolors="white",
                    linewidths=0.9,
                    zorder=9 - k,
                    label=name,
                    clip_on=False,  # most stand on the border
                    **colours,
                )
                self.lines_[name].append(drawn)
            colour_bar(self.figure_, drawn, one)

    def _draw_curves(self, n_std: float) -> None:
        """Points with bars, curves with bands."""
        kappa = self.kappa[:, 0]
        fine = np.linspace(kappa.min(), kappa.max(), _N_CURVE)
        curves = {
            name: np.reshape(model.predict(fine[:, None]), (_N_CURVE, -1))
            for name, model in self.interpolators.items()
        }
        bands = {
            name: n_std * np.reshape(std(fine[:, None]), (_N_CURVE, -1))
            for name, std in self.curve_std.items()
        }
        for k, (name, theta) in enumerate(self.parameters.items()):
            style = point_style(k)
            for one, column in zip(self.axes_, self.chosen, strict=True):
                (points,) = one.plot(
                    kappa, theta[:, column], label=name, zorder=3 + k, **style
                )
                self.lines_[name].append(points)
                if name in self.std:
                    one.errorbar(
                        kappa,
                        theta[:, column],
                        n_std * self.std[name][:, column],
                        fmt="none",
                        ecolor=style["color"],
                        elinewidth=1.0,
                        zorder=2 + k,
                    )
                if name in bands:
                    middle, width = curves[name][:, column], bands[name][:, column]
                    band(one, fine, middle - width, middle + width, style["color"])
                if name in curves:
                    (curve,) = one.plot(
                        fine,
                        curves[name][:, column],
                        color=style["color"],
                        label=f"{name}, interpolated",
                        linewidth=1.2,
                        linestyle=("-", "--", "-.", ":")[k % 4],
                    )
                    self.curves_[name].append(curve)

    def _dress(self, ax: Any, name: str, lowest: bool) -> None:
        from matplotlib.ticker import MaxNLocator

        from .numbers import ShortNumbers

        tidy(ax)
        title = with_unit(name, units_of([name], self.units)[0])
        ax.set_title(title, fontsize=9, pad=3, y=1.0)  # or a place is looked for
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        if lowest:
            ax.set_xlabel(self.scheduling_labels[0])
        if self.kappa.shape[1] == 2:
            ax.grid(False)
            return
        ax.margins(0.08, 0.12)
        ax.yaxis.set_major_formatter(ShortNumbers())
        low, high = ax.dataLim.y0, ax.dataLim.y1
        size = max(abs(low), abs(high))
        # Else the axis magnifies rounding errors of a constant.
        if high - low < _CONSTANT * size:
            ax.set_ylim(low - 0.1 * size, high + 0.1 * size)


def _check_can(argument: str, named: Mapping[str, Any], method: str) -> None:
    """Refuse things to draw, by name, that lack a method, or are classes."""
    for name, value in named.items():
        if isinstance(value, type) or not callable(getattr(value, method, None)):
            kind = (
                "a function" if method == "__call__" else f"an object with {method}()"
            )
            raise ValueError(
                f"`{argument}` must hold {kind} for each name. Got "
                f"{type(value).__name__} for {name!r}."
            )


def _curve_std(lpv: Any, kappa: Array) -> Array:
    return np.asarray(lpv.parameters(kappa, return_std=True)[1])


def _names_and_choice(
    sets: Mapping[str, Any], names: Sequence[Hashable] | None
) -> tuple[list[str], list[int]]:
    """Names of all parameters, and the positions of those to draw."""
    tables = [table for table in sets.values() if hasattr(table, "columns")]
    if not tables:
        argument, table = next(iter(sets.items()))
        shape = as_numbers(f"parameters[{argument!r}]", table).shape
        n_params = shape[-1] if len(shape) == 2 else 0
        return given_names("names", names, n_params, "p"), list(range(n_params))
    known = [str(column) for column in tables[0].columns]
    if names is not None and not is_names(names):
        raise ValueError(f"`names` must be a list of parameters. Got {names!r}.")
    wanted = known if names is None else [str(name) for name in names]
    for name in wanted:
        if name not in known:
            raise ValueError(
                f"`names` must be among the parameters {', '.join(known[:20])}. Got "
                f"{name!r}."
            )
    if not wanted:
        raise ValueError("`names` must name at least one parameter. Got none.")
    return known, [known.index(name) for name in wanted]


def _in_order(name: str, table: Any, names: list[str]) -> Any:
    """The columns of a DataFrame by name, in the common order."""
    columns = [str(column) for column in table.columns]
    missing = [one for one in names if one not in columns]
    if missing:
        raise ValueError(
            f"`{name}` must have the columns of the first set. Got none "
            f"named {missing[0]!r}."
        )
    return table.iloc[:, [columns.index(one) for one in names]]
