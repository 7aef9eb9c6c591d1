"""Poles that migrate over the scheduling variable."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.experiments import as_numbers
from .drawing import (
    LABEL_SIZE,
    MUTED,
    TEXT_SIZE,
    drawable,
    legend_above,
    single_axes,
    tidy,
    whole,
)
from .fitted import (
    check_one_scheduling,
    fitted_pipeline,
    scheduling_name,
)

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

_DAMPING = (0.1, 0.3, 0.5, 0.7, 0.9)  # damping ratios that get a ray

_N_POINTS = 101  # frozen models over the range: their poles make a line


class PoleDisplay:
    """Poles of the frozen models in the s-plane, coloured by the scheduling value.

    Make it with `from_model` or `from_estimator`.

    Parameters
    ----------
    kappa : array-like of shape (n_points,)
        Scheduling values.
    poles : array-like of shape (n_points, order)
        Poles of the frozen models, rad/s.
    local_kappa : array-like of shape (n_local,), default=None
        Scheduling values of local models, drawn as rings.
    local_poles : array-like of shape (n_local, order), default=None
        Their poles, rad/s.
    scheduling_label : str, default="κ"
        Label of the colour bar.

    Attributes
    ----------
    ax_ : Axes
    axes_ : ndarray of Axes of shape (1,)
    figure_ : Figure
    points_ : PathCollection
        The poles, in the order of ``poles.ravel()``.
    local_points_ : PathCollection or None
    colorbar_ : Colorbar

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
        scheduling_label: str = "κ",
    ) -> None:
        self.kappa, self.poles = _pair("", kappa, poles)
        self.local_kappa, self.local_poles = np.zeros(0), np.zeros((0, 0), complex)
        if local_poles is not None and local_kappa is not None:
            pair = _pair("local_", local_kappa, local_poles)
            self.local_kappa, self.local_poles = pair
        self.scheduling_label = scheduling_label

    @classmethod
    def from_model(
        cls,
        model: Any,
        *,
        kappa: ArrayLike | None = None,
        damping: bool = False,
        scheduling_label: str = "κ",
        ax: Any = None,
    ) -> PoleDisplay:
        """Draw the poles of an LPV model.

        Parameters
        ----------
        model : LPVStateSpace
            With one scheduling variable.
        kappa : array-like of shape (n_points,), default=None
            Scheduling values; None is 101 over the identified range.
        damping : bool, default=False
            Whether to draw lines of constant damping ratio.
        scheduling_label : str, default="κ"
        ax : Axes, default=None

        Returns
        -------
        PoleDisplay

        Raises
        ------
        ValueError
            If the model has several scheduling variables.
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
        scheduling_label: str | None = None,
        ax: Any = None,
    ) -> PoleDisplay:
        """Draw the poles of a pipeline's model, and those of its local models.

        Parameters
        ----------
        pipeline : fitted LocalLPVPipeline or OutputErrorLPV
            With one scheduling variable. The black-box local models of a pipeline are
            drawn as rings.
        kappa : array-like of shape (n_points,), default=None
            Scheduling values; None is 101 over the identified range.
        damping : bool, default=False
        scheduling_label : str, default=None
            None is the name of the scheduling column.
        ax : Axes, default=None

        Returns
        -------
        PoleDisplay

        Raises
        ------
        ValueError
            If the pipeline is not fitted or has several scheduling variables.
        """
        pipeline = fitted_pipeline(pipeline, "lpv_")
        grid = _grid(pipeline.lpv_, kappa)
        local: dict[str, Any] = {}
        if hasattr(pipeline, "local_models_"):
            points, models = pipeline.operating_points_[:, 0], pipeline.local_models_
            local = {
                "local_kappa": np.repeat(points, [model.order for model in models]),
                "local_poles": np.concatenate([m.poles() for m in models])[:, None],
            }
        display = cls(
            grid,
            pipeline.lpv_.frozen_poles(grid),
            **local,
            scheduling_label=scheduling_label or scheduling_name(pipeline),
        )
        return display.plot(ax, damping=damping)

    def plot(self, ax: Any = None, *, damping: bool = False) -> PoleDisplay:
        """Draw the s-plane.

        Parameters
        ----------
        ax : Axes, default=None
            None makes a figure.
        damping : bool, default=False
            Whether to draw lines of constant damping ratio.

        Returns
        -------
        PoleDisplay
        """
        from matplotlib.lines import Line2D

        self.figure_, self.axes_ = single_axes(ax, height=4.4)
        self.ax_ = one = self.axes_[0]
        colours = _colours(np.concatenate([self.kappa, self.local_kappa]))
        s = self.poles.ravel()
        kappa = np.repeat(self.kappa, self.poles.shape[1])
        self.points_ = one.scatter(
            s.real, s.imag, c=kappa, s=9, linewidths=0, zorder=3, **colours
        )
        self.local_points_ = None
        if self.local_poles.size:
            s = self.local_poles.ravel()
            kappa = np.repeat(self.local_kappa, self.local_poles.shape[1])
            rings = colours["cmap"](colours["norm"](kappa))
            self.local_points_ = one.scatter(
                s.real,
                s.imag,
                s=46,
                facecolors="none",
                edgecolors=rings,
                linewidths=1.4,
                zorder=4,
            )
            ring = Line2D([], [], color=MUTED, marker="o", markerfacecolor="none")
            ring.set(linestyle="", label="local models")
            legend_above(one, [ring])
        tidy(one)
        one.autoscale_view()
        # The border of stability is part of the picture.
        one.set_xlim(right=max(one.get_xlim()[1], -0.03 * one.get_xlim()[0]))
        one.set_xlabel("Real part (rad/s)")
        one.set_ylabel("Imaginary part (rad/s)")
        one.axvline(0.0, color="0.35", linewidth=0.9, zorder=1)
        one.axhline(0.0, color="0.7", linewidth=0.7, zorder=1)
        if whole("damping", damping, range(2)):
            _draw_damping(one)
        self.colorbar_ = self.figure_.colorbar(
            self.points_, ax=one, pad=0.02, aspect=30
        )
        self.colorbar_.ax.set_title(self.scheduling_label, fontsize=LABEL_SIZE)
        self.colorbar_.ax.tick_params(labelsize=TEXT_SIZE)
        self.colorbar_.outline.set_visible(False)
        drawable(self.figure_)
        return self


def _colours(kappa: Array) -> dict[str, Any]:
    """Colour map and scale: cividis, lightness in step, without its palest end."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap, Normalize

    cmap = ListedColormap(colormaps["cividis"](np.linspace(0.0, 0.9, 256)))
    return {"cmap": cmap, "norm": Normalize(kappa.min(), kappa.max())}


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
    check_one_scheduling(model.n_scheduling, "PoleDisplay")
    if kappa is not None:
        return as_numbers("kappa", kappa).reshape(-1)
    low, high = model.scheduling_range[:, 0]
    return np.linspace(low, high, _N_POINTS)


def _pair(prefix: str, kappa: ArrayLike, poles: ArrayLike) -> tuple[Array, Complex]:
    points = as_numbers(f"{prefix}kappa", kappa).reshape(-1)
    table = as_numbers(f"{prefix}poles", poles, imaginary=True)
    if table.ndim != 2 or len(table) != len(points) or table.size == 0:
        raise ValueError(
            f"`{prefix}poles` must have shape ({len(points)}, order), a row for each "
            f"value of `{prefix}kappa`. Got {table.shape}."
        )
    return points, table
