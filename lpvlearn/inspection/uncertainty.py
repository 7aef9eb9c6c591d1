"""What an LPV model does not know: its relative error over the scheduling range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.tables import as_numbers
from ..models.frequencies import frequency_axis
from ..models.scheduling_range import grid_over
from ..models.statespace import StateSpace
from .drawing import (
    ACCENT,
    INK,
    colour_bar,
    colour_scale,
    drawable,
    labels_of,
    legend_above,
    plain_ticks,
    single_axes,
    tidy,
)
from .fitted import fitted_pipeline, scheduling_labels
from .frequency import check_frequencies

Array = NDArray[np.float64]

# Frozen models over the range: of one scheduling variable, and along each of two.
_N_CURVE, _N_MAP = 41, 13

_N_STD = 2.0  # standard deviations


class UncertaintyDisplay:
    """Error of the interpolated model over the scheduling range, in percent.

    A line, or over two variables a map, shows two standard deviations of the frozen
    response by the uncertainty of the coefficients: what noise leaves open. Points
    show how far the interpolated model is from the local one that was identified
    there, without interpolation or structure. Points above the line are more than
    noise: a form of the interpolation that is not true, a structure that lacks
    something, a local model that is off. Between the points, nothing but the line is
    known: `suggest_operating_point` tells where to measure. All are the largest
    singular value over frequency, relative to that of the model: 10 % is -20 dB at the
    peak. Make it with `from_estimator`.

    Parameters
    ----------
    kappa : array-like of shape (n_points, n_scheduling)
        Operating points.
    error : array-like of shape (n_points,)
        Relative errors there.
    grid : array-like of shape (n_grid, n_scheduling), default=None
        Scheduling values of `std`; of two variables, the points of a grid, the last
        one running fastest.
    std : array-like of shape (n_grid,), default=None
        Relative standard deviations.
    scheduling_label : str or sequence of str, default="κ"

    Attributes
    ----------
    ax_ : Axes
    axes_ : ndarray of Axes of shape (1,)
    figure_ : Figure
    points_ : Line2D or PathCollection
    curve_ : Line2D, QuadMesh or None

    Examples
    --------
    >>> from lpvlearn.inspection import UncertaintyDisplay
    >>> display = UncertaintyDisplay(
    ...     [[0.0], [1.0]], [0.01, 0.02], grid=[[0.0], [1.0]], std=[0.01, 0.01]).plot()
    >>> display.ax_.get_ylabel()
    'Error of the model (%)'
    """

    def __init__(
        self,
        kappa: ArrayLike,
        error: ArrayLike,
        *,
        grid: ArrayLike | None = None,
        std: ArrayLike | None = None,
        scheduling_label: str | Sequence[str] = "κ",
    ) -> None:
        self.kappa, self.error = _rows("kappa", "error", kappa, error)
        self.grid, self.std = self.kappa[:0], self.error[:0]
        if grid is not None and std is not None:
            self.grid, self.std = _rows("grid", "std", grid, std)
        if self.kappa.shape[1] > 2:
            raise ValueError(
                "UncertaintyDisplay needs one or two scheduling variables as its axes. "
                f"Got {self.kappa.shape[1]}. See the column interpolation_error of "
                "`report_` for the errors at the operating points."
            )
        n_scheduling = self.kappa.shape[1]
        if self.grid.shape[1] != n_scheduling:
            raise ValueError(
                f"`grid` must have the {n_scheduling} column(s) of `kappa`. Got "
                f"{self.grid.shape[1]}."
            )
        self.scheduling_labels = labels_of(scheduling_label, n_scheduling)

    @classmethod
    def from_estimator(
        cls,
        pipeline: Any,
        *,
        omega: ArrayLike | None = None,
        units: Mapping[str, str] | None = None,
        ax: Any = None,
    ) -> UncertaintyDisplay:
        """Draw what a pipeline's model does not know.

        Parameters
        ----------
        pipeline : fitted LocalLPVPipeline
            With one or two scheduling variables.
        omega : array-like of shape (n_freq,), default=None
            Angular frequencies to look at, rad/s. None: around the poles of the model
            at each scheduling value.
        units : dict from str to str, default=None
            Of the scheduling variables, by name; None: those that the pipeline knows.
        ax : Axes, default=None

        Returns
        -------
        UncertaintyDisplay

        Raises
        ------
        ValueError
            If the pipeline is not fitted or has more than two scheduling variables.
        """
        pipeline = fitted_pipeline(pipeline, "local_models_")
        lpv, points = pipeline.lpv_, pipeline.operating_points_
        omega = None if omega is None else check_frequencies(omega)
        error = [
            _relative(lpv.at(place), model, omega)
            for place, model in zip(points, pipeline.local_models_, strict=True)
        ]
        known: dict[str, Any] = {}
        n = points.shape[1]
        if lpv.covariance is not None and n <= 2:
            size = _N_CURVE if n == 1 else _N_MAP
            grid = grid_over(lpv.scheduling_range, size)
            inside = np.clip(grid, *lpv.scheduling_range)  # none beyond a constant one
            std = [_deviation(lpv, place, omega) for place in inside]
            known = {"grid": grid, "std": std}
        labels = scheduling_labels(pipeline, n, units)
        return cls(points, error, **known, scheduling_label=labels).plot(ax)

    def plot(self, ax: Any = None) -> UncertaintyDisplay:
        """Draw the errors.

        Parameters
        ----------
        ax : Axes, default=None
            None makes a figure.

        Returns
        -------
        UncertaintyDisplay
        """
        self.figure_, self.axes_ = single_axes(ax, height=3.6)
        self.ax_ = one = self.axes_[0]
        self.curve_: Any = None
        tidy(one)
        one.set_xlabel(self.scheduling_labels[0])
        (self._draw_map if self.kappa.shape[1] == 2 else self._draw_curve)(one)
        drawable(self.figure_)
        return self

    def _draw_curve(self, ax: Any) -> None:
        handles = []
        if len(self.std):
            (self.curve_,) = ax.semilogy(
                self.grid[:, 0],
                100 * _N_STD * self.std,
                color=INK,
                linewidth=1.5,
                label=f"by noise ({_N_STD:g} standard deviations)",
            )
            handles.append(self.curve_)
        (self.points_,) = ax.semilogy(
            self.kappa[:, 0],
            100 * self.error,
            color=ACCENT,
            marker="o",
            linestyle="none",
            label="from the local models",
        )
        ax.set_ylabel("Error of the model (%)")
        plain_ticks(ax.yaxis)
        legend_above(ax, [*handles, self.points_], n_columns=1)

    def _draw_map(self, ax: Any) -> None:
        from matplotlib.colors import LogNorm

        shown = 100 * np.concatenate([_N_STD * self.std, self.error])
        shown = shown[shown > 0]
        colours = colour_scale(shown if len(shown) else np.ones(1))
        colours["norm"] = LogNorm(colours["norm"].vmin, colours["norm"].vmax)
        if len(self.std):
            sides = [np.unique(column) for column in self.grid.T]
            values = 100 * _N_STD * self.std.reshape([len(side) for side in sides])
            self.curve_ = ax.pcolormesh(
                *sides, values.T, shading="nearest", rasterized=True, **colours
            )
        self.points_ = ax.scatter(
            *self.kappa.T,
            c=100 * self.error,
            s=60,
            edgecolors="white",
            clip_on=False,
            zorder=3,
            **colours,
        )
        ax.grid(False)
        ax.set_ylabel(self.scheduling_labels[1])
        ax.set_title(
            f"map: by noise ({_N_STD:g} std), dots: from the local models",
            fontsize=9,
            pad=8,
        )
        colour_bar(self.figure_, self.points_, ax, "Error of the model (%)")


def _rows(
    name: str, of: str, places: ArrayLike, values: ArrayLike
) -> tuple[Array, Array]:
    kappa, found = as_numbers(name, places), as_numbers(of, values)
    kappa = kappa[:, None] if kappa.ndim < 2 else kappa
    if found.shape != kappa.shape[:1] or not len(found):
        raise ValueError(
            f"`{of}` must have shape ({len(kappa)},), a value for each row of "
            f"`{name}`. Got {found.shape}."
        )
    return kappa, found


def _peak(response: NDArray[Any]) -> float:
    """Largest singular value over frequency."""
    return float(np.linalg.norm(response, 2, axis=(1, 2)).max())


def _relative(one: StateSpace, other: StateSpace, omega: Array | None) -> float:
    """Distance of two responses, relative to the first."""
    axis = frequency_axis([one, other]) if omega is None else omega
    mine, its = (model.frequency_response(axis) for model in (one, other))
    return _peak(mine - its) / _peak(mine)


def _deviation(lpv: Any, place: Array, omega: Array | None) -> float:
    """Standard deviation of a frozen response, relative to the response."""
    frozen = lpv.at(place)
    axis = frequency_axis([frozen]) if omega is None else omega
    std = np.abs(lpv.frequency_response_std(place, axis))
    return _peak(std) / _peak(frozen.frequency_response(axis))
