"""The error of a restructured model over frequency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.tables import as_numbers
from ..metrics.table_simulation import unwrapped
from ..models.frequencies import frequency_axis, nyquist_frequency
from ..models.statespace import StateSpace
from .drawing import ACCENT, INK, MUTED, drawable, legend_above, single_axes, tidy
from .fitted import check_model, nearest_point
from .frequency import (
    check_frequencies,
    frequency_label,
    response_up_to_nyquist,
)

Array = NDArray[np.float64]

_DEPTH = 1e-6  # six decades below the highest point, there is nothing to see


class ErrorDisplay:
    r"""Largest singular value of the error :math:`G - \mathfrak{G}` over frequency.

    Its maximum is the H-infinity norm that the restructuring minimises, Eq. (6). At an
    optimum several peaks are equally high: the active ones. Make it with
    `from_estimator` or `from_models`.

    Parameters
    ----------
    omega : array-like of shape (n_freq,)
        Angular frequencies, rad/s.
    error : array-like of shape (n_freq,)
        Largest singular value of the error.
    start : array-like of shape (n_freq,), default=None
        The same before the minimisation.
    active_frequencies, active_values : array-like of shape (n_active,), default=None
        The peaks that support the optimum. A frequency of 0 or infinity is drawn at
        the end of the axis, as an arrow head.
    floor : float, default=0.0
        Part of the error that no parameter changes; 0 is not drawn.
    norms : dict from str to float, default=None
        H-infinity norms of "error" and "start" for the legend.

    Attributes
    ----------
    ax_ : Axes
    axes_ : ndarray of Axes of shape (1,)
    figure_ : Figure
    lines_ : dict from str to Line2D
        "error", and those drawn of "start" and "floor".
    active_points_ : list of Line2D

    Examples
    --------
    >>> from lpvlearn import StateSpace
    >>> from lpvlearn.inspection import ErrorDisplay
    >>> slow = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    >>> fast = StateSpace([[-2.0]], [[2.0]], [[1.0]])
    >>> display = ErrorDisplay.from_models(slow, fast)
    >>> float(display.error.max().round(2))
    0.33
    """

    def __init__(
        self,
        omega: ArrayLike,
        error: ArrayLike,
        *,
        start: ArrayLike | None = None,
        active_frequencies: ArrayLike | None = None,
        active_values: ArrayLike | None = None,
        floor: float = 0.0,
        norms: Mapping[str, float] | None = None,
        frequency_label: str = "Frequency (rad/s)",
    ) -> None:
        self.frequency_label = frequency_label
        self.omega = check_frequencies(omega)
        self.error = self._curve("error", error)
        self.start = None if start is None else self._curve("start", start)
        self.active_frequencies = _vector("active_frequencies", active_frequencies)
        self.active_values = _vector("active_values", active_values)
        if self.active_values.shape != self.active_frequencies.shape:
            raise ValueError(
                "`active_values` must hold a value for each of "
                f"{len(self.active_frequencies)} `active_frequencies`. Got "
                f"{len(self.active_values)}."
            )
        self.floor = _level("floor", floor, np.finfo(float).max)
        norms = {} if norms is None else norms
        if not isinstance(norms, Mapping):
            raise ValueError(
                "`norms` must be a mapping from names to numbers. Got "
                f"{type(norms).__name__}."
            )
        self.norms = {k: _level(f"norms[{k!r}]", norm) for k, norm in norms.items()}

    def _curve(self, name: str, values: ArrayLike) -> Array:
        curve = as_numbers(name, values)
        if curve.shape != self.omega.shape:
            raise ValueError(
                f"`{name}` must have shape {self.omega.shape}, a value for each "
                f"frequency in `omega`. Got {curve.shape}."
            )
        return curve

    @classmethod
    def from_models(
        cls,
        gray_box: StateSpace,
        black_box: StateSpace,
        *,
        start: StateSpace | None = None,
        active_frequencies: ArrayLike | None = None,
        floor: float = 0.0,
        omega: ArrayLike | None = None,
        ax: Any = None,
    ) -> ErrorDisplay:
        """Draw the error between two models.

        Parameters
        ----------
        gray_box, black_box : StateSpace
            With the same inputs, outputs and sampling time.
        start : StateSpace, default=None
            The gray-box model before the minimisation.
        active_frequencies : array-like of shape (n_active,), default=None
            Frequencies (rad/s) to mark; may hold 0 and infinity.
        floor : float, default=0.0
            Part of the error that no parameter changes.
        omega : array-like of shape (n_freq,), default=None
            None: around the poles of the models.
        ax : Axes, default=None

        Returns
        -------
        ErrorDisplay

        Raises
        ------
        ValueError
            If the models do not fit together.
        """
        check_model("gray_box", gray_box)
        check_model("black_box", black_box)
        if start is not None:
            check_model("start", start)
        difference = gray_box - black_box
        active = _vector("active_frequencies", active_frequencies)
        marked = np.minimum(active, nyquist_frequency(difference))
        if omega is None:
            grid = frequency_axis([gray_box, black_box])
            inside = (marked > grid[0]) & (marked < grid[-1])
            grid = np.unique(np.concatenate([grid, marked[inside]]))
        else:
            grid = check_frequencies(omega)
        before = None if start is None else start - black_box
        norms = {"error": difference.hinf_norm()}
        if before is not None:
            norms["start"] = before.hinf_norm()
        display = cls(
            grid,
            _sigma(difference, grid),
            start=None if before is None else _sigma(before, grid),
            active_frequencies=active,
            active_values=_sigma(difference, marked),
            floor=floor,
            norms=norms,
            frequency_label=frequency_label([gray_box, black_box]),
        )
        return display.plot(ax)

    @classmethod
    def from_estimator(
        cls,
        restructurer: Any,
        model: StateSpace | None = None,
        *,
        kappa: float | ArrayLike | None = None,
        start: StateSpace | ArrayLike | str | None = "auto",
        omega: ArrayLike | None = None,
        ax: Any = None,
    ) -> ErrorDisplay:
        """Draw the error of a fitted restructurer.

        Parameters
        ----------
        restructurer : fitted GrayBoxRestructurer or LocalLPVPipeline
        model : StateSpace, default=None
            The black box that it was fitted to; a pipeline has its own.
        kappa : float or array-like of shape (n_scheduling,), default=None
            Scheduling value near which to take the operating point of a pipeline.
        start : "auto", StateSpace, array-like of shape (n_params,) or None
            The gray-box model, or its parameters, to compare with. "auto" (default):
            the least-squares fit that the minimisation began with, where the
            restructurer tells it.
        omega : array-like of shape (n_freq,), default=None
            None: around the poles of the models.
        ax : Axes, default=None

        Returns
        -------
        ErrorDisplay

        Raises
        ------
        ValueError
            If the restructurer is not fitted, or `model` does not fit it.

        Notes
        -----
        A feedthrough that the structure lacks is left out of the black box, as in the
        fit.
        """
        restructurer = unwrapped(restructurer)
        if getattr(restructurer, "restructurers_", None):
            nearest = nearest_point(restructurer, kappa)
            model = restructurer.local_models_[nearest]
            restructurer = restructurer.restructurers_[nearest]
        for attribute in ("structure_", "lti_"):
            if not hasattr(restructurer, attribute):
                raise ValueError(
                    "`restructurer` must be a fitted GrayBoxRestructurer (call its "
                    "fit_model() first), or a fitted pipeline with a structure. Got "
                    f"{type(restructurer).__name__} without `{attribute}`."
                )
        check_model("model", model)
        assert model is not None
        dropped = restructurer.dropped_feedthrough_
        if dropped.shape != model.D.shape:
            raise ValueError(
                "`model` must be the black box of the fit, with "
                f"{dropped.shape[0]} outputs and {dropped.shape[1]} inputs. Got "
                f"{model}."
            )
        compared = StateSpace(
            model.A,
            model.B,
            model.C,
            model.D - dropped,
            model.sampling_time,
            model.input_delay,
        )
        if isinstance(start, str):
            if start != "auto":
                raise ValueError(
                    "`start` must be 'auto', a StateSpace, parameters or None. Got "
                    f"{start!r}."
                )
            start = getattr(restructurer, "start_params_", None)
        before = start
        if before is not None and not isinstance(before, StateSpace):
            before = restructurer.structure_.model(start, model.sampling_time)
            before = before.with_input_delay(model.input_delay)
        return cls.from_models(
            restructurer.lti_,
            compared,
            start=before,
            active_frequencies=restructurer.active_frequencies_,
            floor=restructurer.structural_floor_,
            omega=omega,
            ax=ax,
        )

    def plot(self, ax: Any = None) -> ErrorDisplay:
        """Draw the error.

        Parameters
        ----------
        ax : Axes, default=None
            None makes a figure.

        Returns
        -------
        ErrorDisplay
        """
        self.figure_, self.axes_ = single_axes(ax, height=3.6)
        self.ax_ = one = self.axes_[0]
        self.lines_: dict[str, Any] = {}
        dashes = (0, (6, 1.5, 1.2, 1.5))
        for name, curve, style in (
            ("error", self.error, {"color": INK, "lw": 1.6, "zorder": 2.5}),
            ("start", self.start, {"color": MUTED, "lw": 1.1, "linestyle": dashes}),
        ):
            if curve is not None:
                label = name
                if name in self.norms:
                    label += f", H∞ norm {self.norms[name]:.3g}"
                seen = np.where(curve > 0, curve, np.nan)
                (self.lines_[name],) = one.loglog(
                    self.omega, seen, label=label, **style
                )
        if self.floor > 0:
            self.lines_["floor"] = one.axhline(
                self.floor,
                color="#0072B2",
                linewidth=1.2,
                linestyle="--",
                label=f"structural floor {self.floor:.3g}",
            )
        self._mark_active(one)
        one.set_xlim(self.omega[0], self.omega[-1])
        self._limit(one)
        tidy(one)
        one.set_xlabel(self.frequency_label)
        one.set_ylabel("Largest singular value of the error")
        handles = [*self.lines_.values(), *self.active_points_[:1]]
        legend_above(one, handles, n_columns=4 if len(handles) < 4 else 2)
        drawable(self.figure_)
        return self

    def _mark_active(self, ax: Any) -> None:
        """Peaks as dots; beyond the ends of the axis, arrow heads that point there."""
        low, high = self.omega[[0, -1]]
        label = "active peak" + ("s" if len(self.active_values) > 1 else "")
        self.active_points_ = []
        for frequency, value in zip(
            self.active_frequencies, self.active_values, strict=True
        ):
            if not value > 0.0:  # as where a bound at infinity is met: no place on it
                continue
            marker = "<" if frequency < low else ">" if frequency > high else "o"
            (point,) = ax.plot(
                np.clip(frequency, low, high),
                value,
                color=ACCENT,
                marker=marker,
                markersize=7,
                linestyle="none",
                clip_on=False,
                zorder=4,
                label=label,
            )
            self.active_points_.append(point)

    def _limit(self, ax: Any) -> None:
        """The axis ends at `_DEPTH` of the highest point."""
        curves = [c for c in (self.error, self.start) if c is not None]
        shown = np.concatenate(curves)
        shown = shown[np.isfinite(shown) & (shown > 0)]
        top = shown.max(initial=0.0)
        if shown.min(initial=np.inf) < _DEPTH * top:
            ax.set_ylim(_DEPTH * top, 2.0 * top)  # with room for the dots above


def _sigma(model: StateSpace, omega: Array) -> Array:
    """Largest singular values of a response; NaN above the Nyquist frequency."""
    if omega.size == 0:
        return np.zeros(0)
    response = response_up_to_nyquist(model, omega)
    values = np.full(len(omega), np.nan)
    seen = np.isfinite(response).all((1, 2))
    values[seen] = np.linalg.norm(response[seen], 2, axis=(1, 2))
    return values


def _vector(name: str, values: ArrayLike | None) -> Array:
    return np.zeros(0) if values is None else as_numbers(name, values).reshape(-1)


def _level(name: str, value: Any, most: float = np.inf) -> float:
    level = as_numbers(name, value)
    if level.shape != (1,) or not 0 <= level[0] <= most:
        kind = "number" if most == np.inf else "finite number"
        raise ValueError(f"`{name}` must be a {kind} of at least 0. Got {value}.")
    return float(level[0])
