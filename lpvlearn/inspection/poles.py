"""Poles that migrate over the scheduling variable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.tables import as_numbers
from .drawing import (
    MUTED,
    axes_grid,
    colour_bar,
    colour_scale,
    drawable,
    labels_of,
    legend_above,
    tidy,
    whole,
)
from .fitted import fitted_pipeline, scheduling_labels

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

_DAMPING = (0.1, 0.3, 0.5, 0.7, 0.9)  # damping ratios that get a ray

# Frozen models over the range of one scheduling variable: their poles make a line. Of
# several, so many in all at most, on a grid.
_N_POINTS, _N_GRID = 101, 500

_N_TICKS = 5  # of an axis at most: their labels stand apart in a report, too

_REAL = 1e-6  # imaginary parts, relative to the largest pole, that are rounding


class PoleDisplay:
    """Poles of the frozen models in the s-plane, coloured by the scheduling value.

    Of several scheduling variables, there is a panel for each, with the same poles
    coloured by that variable. Make it with `from_model` or `from_estimator`.

    Parameters
    ----------
    kappa : array-like of shape (n_points,) or (n_points, n_scheduling)
        Scheduling values.
    poles : array-like of shape (n_points, order)
        Poles of the frozen models, rad/s.
    local_kappa : array-like of shape (n_local,) or (n_local, n_scheduling)
        Scheduling values of local models, drawn as rings.
    local_poles : array-like of shape (n_local, order), default=None
        Their poles, rad/s.
    scheduling_label : str or sequence of str, default="κ"
        Labels of the colour bars; one for several variables is numbered.

    Attributes
    ----------
    ax_ : Axes
        The first panel.
    axes_ : ndarray of Axes of shape (n_scheduling,)
    figure_ : Figure
    points_ : PathCollection
        The poles of the first panel, in the order of ``poles.ravel()``.
    local_points_ : PathCollection or None
    colorbars_ : list of Colorbar

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV
    >>> from lpvlearn.inspection import PoleDisplay
    >>> structure = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", -0.5]], B=[[0], [1]], C=[[1, 0]])
    >>> kappa = np.array([[0.0], [1.0]])
    >>> stiffness = PolynomialLPV(degree=1).fit(kappa, [[4.0], [9.0]])
    >>> lpv = LPVStateSpace(structure, stiffness, kappa)
    >>> PoleDisplay.from_model(lpv).poles.shape
    (101, 2)
    """

    def __init__(
        self,
        kappa: ArrayLike,
        poles: ArrayLike,
        *,
        local_kappa: ArrayLike | None = None,
        local_poles: ArrayLike | None = None,
        scheduling_label: str | Sequence[str] = "κ",
    ) -> None:
        self.kappa, self.poles = _pair("", kappa, poles)
        self.local_kappa, self.local_poles = self.kappa[:0], self.poles[:0]
        if local_poles is not None and local_kappa is not None:
            pair = _pair("local_", local_kappa, local_poles)
            self.local_kappa, self.local_poles = pair
            if pair[0].shape[1] != self.kappa.shape[1]:
                raise ValueError(
                    f"`local_kappa` must have as many columns as `kappa` has, "
                    f"{self.kappa.shape[1]}. Got {pair[0].shape[1]}."
                )
        self.scheduling_labels = labels_of(scheduling_label, self.kappa.shape[1])

    @classmethod
    def from_model(
        cls,
        model: Any,
        *,
        kappa: ArrayLike | None = None,
        damping: bool = False,
        scheduling_label: str | Sequence[str] = "κ",
        ax: Any = None,
    ) -> PoleDisplay:
        """Draw the poles of an LPV model.

        Parameters
        ----------
        model : LPVStateSpace
        kappa : array-like, (n_points,) or (n_points, n_scheduling), default=None
            Scheduling values; None is a grid over the identified range.
        damping : bool, default=False
            Whether to draw lines of constant damping ratio.
        scheduling_label : str or sequence of str, default="κ"
        ax : Axes or array of Axes, default=None

        Returns
        -------
        PoleDisplay

        Raises
        ------
        ValueError
            If `model` is no LPV model.
        """
        if not hasattr(model, "frozen_poles"):
            raise ValueError(
                f"`model` must be an LPVStateSpace. Got {type(model).__name__}; a "
                "fitted LocalLPVPipeline holds one in `lpv_`."
            )
        grid = _grid(model, kappa)
        display = cls(grid, model.frozen_poles(grid), scheduling_label=scheduling_label)
        return display.plot(ax, damping=damping)

    @classmethod
    def from_estimator(
        cls,
        pipeline: Any,
        *,
        kappa: ArrayLike | None = None,
        damping: bool = False,
        scheduling_label: str | Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        ax: Any = None,
    ) -> PoleDisplay:
        """Draw the poles of a pipeline's model, and those of its local models.

        Parameters
        ----------
        pipeline : fitted LocalLPVPipeline or OutputErrorLPV
            The black-box local models of a pipeline are drawn as rings.
        kappa : array-like, (n_points,) or (n_points, n_scheduling), default=None
            Scheduling values; None is a grid over the identified range.
        damping : bool, default=False
        scheduling_label : str or sequence of str, default=None
            None is the names of the scheduling columns.
        units : dict from str to str, default=None
            Of the scheduling variables, by name; None: those that the pipeline knows.
        ax : Axes or array of Axes, default=None

        Returns
        -------
        PoleDisplay

        Raises
        ------
        ValueError
            If the pipeline is not fitted.
        """
        pipeline = fitted_pipeline(pipeline, "lpv_")
        grid = _grid(pipeline.lpv_, kappa)
        local: dict[str, Any] = {}
        if hasattr(pipeline, "local_models_"):
            points, models = pipeline.operating_points_, pipeline.local_models_
            local = {
                "local_kappa": np.repeat(points, [m.order for m in models], axis=0),
                "local_poles": np.concatenate([m.poles() for m in models])[:, None],
            }
        display = cls(
            grid,
            pipeline.lpv_.frozen_poles(grid),
            **local,
            scheduling_label=scheduling_labels(pipeline, grid.shape[1], units)
            if scheduling_label is None
            else scheduling_label,
        )
        return display.plot(ax, damping=damping)

    def plot(self, ax: Any = None, *, damping: bool = False) -> PoleDisplay:
        """Draw the s-plane.

        Parameters
        ----------
        ax : Axes or array of Axes, default=None
            None makes a figure. Of an array, a panel for each scheduling variable.
        damping : bool, default=False
            Whether to draw lines of constant damping ratio.

        Returns
        -------
        PoleDisplay
        """
        n_panels = self.kappa.shape[1]
        self.figure_, axes = axes_grid(
            ax, 1, n_panels, height=4.4, sharex=True, sharey=True
        )
        self.axes_ = axes[0]
        self.ax_ = self.axes_[0]
        self.colorbars_: list[Any] = []
        panels = [self._draw(j, one) for j, one in enumerate(self.axes_)]
        self.points_, self.local_points_ = panels[0]
        self.ax_.set_ylabel("Imaginary part (rad/s)")
        if whole("damping", damping, range(2)):
            for one in self.axes_:
                _draw_damping(one)
        drawable(self.figure_)
        return self

    def _draw(self, j: int, one: Any) -> tuple[Any, Any]:
        """Poles coloured by scheduling variable j, and rings likewise."""
        from matplotlib.lines import Line2D

        colours = colour_scale(np.concatenate([self.kappa, self.local_kappa])[:, j])
        s = self.poles.ravel()
        kappa = np.repeat(self.kappa[:, j], self.poles.shape[1])
        points = one.scatter(
            s.real, s.imag, c=kappa, s=9, linewidths=0, zorder=3, **colours
        )
        rings = None
        if self.local_poles.size:
            s = self.local_poles.ravel()
            kappa = np.repeat(self.local_kappa[:, j], self.local_poles.shape[1])
            rings = one.scatter(
                s.real,
                s.imag,
                s=46,
                facecolors="none",
                edgecolors=colours["cmap"](colours["norm"](kappa)),
                linewidths=1.4,
                zorder=4,
            )
            ring = Line2D([], [], color=MUTED, marker="o", markerfacecolor="none")
            ring.set(linestyle="", label="local models")
            if j == 0:
                legend_above(one, [ring])
        tidy(one)
        one.update_datalim([(0.0, 0.0)])  # the border of stability is of the picture
        one.autoscale_view()
        size = np.abs(self.poles).max()
        if np.abs(self.poles.imag).max() < _REAL * size:  # else rounding is magnified
            one.set_ylim(-0.25 * size, 0.25 * size)
        one.set_xlabel("Real part (rad/s)")
        one.locator_params(axis="x", nbins=_N_TICKS)
        one.axvline(0.0, color="0.35", linewidth=0.9, zorder=1)
        one.axhline(0.0, color="0.7", linewidth=0.7, zorder=1)
        bar = colour_bar(self.figure_, points, one, self.scheduling_labels[j])
        self.colorbars_.append(bar)
        return points, rings


def _draw_damping(ax: Any) -> None:
    """Rays of constant damping ratio, labelled where they leave the picture."""
    limits = {"xlim": ax.get_xlim(), "ylim": ax.get_ylim()}
    left, top = limits["xlim"][0], limits["ylim"][1]
    for zeta in _DAMPING:
        # s = r (-zeta + j sqrt(1 - zeta^2))
        direction = np.array([-zeta, np.sqrt(1.0 - zeta**2)])
        reach = min(left / direction[0], top / direction[1])
        x, y = reach * direction
        ax.plot([x, 0.0, x], [y, 0.0, -y], color="0.75", lw=0.7, ls=":", zorder=1)
        ax.annotate(
            f"ζ = {zeta:g}",
            (x, y),
            xytext=(3, -3),
            textcoords="offset points",
            ha="left",
            va="top",
            fontsize=8,
            color=MUTED,
        )
    ax.set(**limits)


def _grid(model: Any, kappa: ArrayLike | None) -> Array:
    n = model.n_scheduling
    if kappa is not None:
        return as_numbers("kappa", kappa).reshape(-1, n)
    size = _N_POINTS if n == 1 else max(3, int(_N_GRID ** (1 / n)))
    axes = [np.linspace(low, high, size) for low, high in model.scheduling_range.T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n)


def _pair(prefix: str, kappa: ArrayLike, poles: ArrayLike) -> tuple[Array, Complex]:
    points = as_numbers(f"{prefix}kappa", kappa)
    points = points[:, None] if points.ndim < 2 else points
    if points.ndim != 2 or points.shape[1] == 0:
        raise ValueError(
            f"`{prefix}kappa` must have shape (n_points, n_scheduling). Got "
            f"{points.shape}."
        )
    table = as_numbers(f"{prefix}poles", poles, imaginary=True)
    if table.ndim != 2 or len(table) != len(points) or table.size == 0:
        raise ValueError(
            f"`{prefix}poles` must have shape ({len(points)}, order), a row for each "
            f"value of `{prefix}kappa`. Got {table.shape}."
        )
    bad = ~np.isfinite(points).all(axis=1) | np.isinf(table).any(axis=1)
    if bad.any():
        raise ValueError(
            f"`{prefix}kappa` and `{prefix}poles` must be finite. Got {points[bad][0]} "
            f"and {table[bad][0]}. Leave such points out; poles that a point does not "
            "have may be NaN."
        )
    return points, table
