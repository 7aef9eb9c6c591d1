"""Bode diagrams of several models side by side."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.tables import as_numbers
from ..metrics.table_simulation import unwrapped
from ..models.frequencies import frequency_axis
from ..models.statespace import StateSpace
from .drawing import (
    axes_grid,
    band,
    by_name,
    drawable,
    figure_legend,
    given_names,
    line_style,
    named,
    tidy,
    units_of,
    whole,
    with_unit,
)
from .fitted import check_model, models_of, places_of, with_others
from .frequency import (
    check_frequencies,
    frequency_label,
    response_up_to_nyquist,
)

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

# dB below the highest gain that are shown: seven decades; zeros reach further down.
_RANGE = 140.0


class BodeDisplay:
    """Magnitude, and phase if wanted, of every transfer from input to output.

    Make it with `from_models` or `from_estimator`; the constructor takes frequency
    responses, also measured ones.

    Parameters
    ----------
    omega : array-like of shape (n_freq,)
        Angular frequencies, rad/s, increasing.
    responses : dict from str to complex array of shape (n_freq, n_outputs, n_inputs)
        NaN is not drawn.
    std : dict from str to array of shape (n_freq, n_outputs, n_inputs), default=None
        Standard deviations of the responses of some of the names, in any direction of
        the complex plane. Complex ones, of real and of imaginary parts, as
        `SubspaceLTI.frequency_response_std` has them, are drawn as their root mean
        square.
    output_names, input_names : sequence of str, default=None
        None is y1, y2, ... and u1, u2, ...
    units : dict from str to str, default=None
        Units of outputs and inputs, by name.
    frequency_label : str, default="Frequency (rad/s)"

    Attributes
    ----------
    axes_ : ndarray of Axes of shape (n_outputs, n_inputs)
        Axes of the magnitudes.
    phase_axes_ : ndarray of Axes of shape (n_outputs, n_inputs), or None
    figure_ : Figure
    lines_ : dict from str to ndarray of Line2D of shape (n_outputs, n_inputs)
        Lines of the magnitudes.
    phase_lines_ : dict likewise, empty without phase

    Examples
    --------
    >>> from lpvlearn import StateSpace
    >>> from lpvlearn.inspection import BodeDisplay
    >>> flexible = StateSpace([[0, 1], [-100, -1]], [[0], [100]], [[1, 0]])
    >>> rigid = StateSpace([[-10.0]], [[10.0]], [[1.0]])
    >>> display = BodeDisplay.from_models({"flexible": flexible, "rigid": rigid})
    >>> display.axes_.shape
    (1, 1)
    """

    def __init__(
        self,
        omega: ArrayLike,
        responses: Mapping[str, ArrayLike],
        *,
        std: Mapping[str, ArrayLike] | None = None,
        output_names: Sequence[Hashable] | None = None,
        input_names: Sequence[Hashable] | None = None,
        units: Mapping[str, str] | None = None,
        frequency_label: str = "Frequency (rad/s)",
    ) -> None:
        self.frequency_label = frequency_label
        self.omega = check_frequencies(omega)
        self.responses = {
            name: as_numbers(f"responses[{name!r}]", response, imaginary=True)
            for name, response in named("responses", responses, "responses").items()
        }
        first = next(iter(self.responses.values())).shape
        for name, response in self.responses.items():
            if response.ndim != 3 or len(response) != len(self.omega):
                raise ValueError(
                    f"`responses[{name!r}]` must have shape ({len(self.omega)}, "
                    f"n_outputs, n_inputs), a row for each frequency. Got "
                    f"{response.shape}."
                )
            if response.shape != first:
                raise ValueError(
                    "all models must have the same inputs and outputs. Got "
                    f"{first[1:]} and, for {name!r}, {response.shape[1:]} (outputs, "
                    "inputs)."
                )
        self.std = self._check_std(std)
        self.output_names = given_names("output_names", output_names, first[1], "y")
        self.input_names = given_names("input_names", input_names, first[2], "u")
        self.units = by_name("units", units)

    def _check_std(self, std: Mapping[str, ArrayLike] | None) -> dict[str, Array]:
        found = {}
        for name, value in by_name("std", std).items():
            if name not in self.responses:
                raise ValueError(
                    f"`std` must be a dict with names among {list(self.responses)}. "
                    f"Got {name!r}."
                )
            array = as_numbers(f"std[{name!r}]", value, imaginary=True)
            if np.iscomplexobj(value):
                array = np.abs(array) / np.sqrt(2.0)
            array = array.real
            shape = self.responses[name].shape
            if array.shape != shape or not (array >= 0).all():
                raise ValueError(
                    f"`std[{name!r}]` must hold non-negative standard deviations, "
                    f"shape {shape}, one for each frequency in `omega`. Got shape "
                    f"{array.shape}."
                )
            found[name] = array
        return found

    @classmethod
    def from_models(
        cls,
        models: Mapping[str, StateSpace],
        *,
        omega: ArrayLike | None = None,
        std: Mapping[str, ArrayLike] | None = None,
        output_names: Sequence[Hashable] | None = None,
        input_names: Sequence[Hashable] | None = None,
        units: Mapping[str, str] | None = None,
        phase: bool = False,
        ax: Any = None,
    ) -> BodeDisplay:
        """Draw the responses of state-space models.

        Parameters
        ----------
        models : dict from str to StateSpace
            Models with the same inputs and outputs, in continuous or discrete time;
            sampled ones are drawn up to their Nyquist frequency. The first is drawn
            solid and black: the reference.
        omega : array-like of shape (n_freq,), default=None
            Angular frequencies, rad/s. None: from a decade below the slowest to a
            decade above the fastest pole, denser around resonances.
        std : dict from str to array, default=None
            Standard deviations of the responses at `omega`, which is then needed;
            as in the constructor.
        output_names, input_names : sequence of str, default=None
            None: those of the first model that has them.
        units : dict from str to str, default=None
            Units of outputs and inputs, by name; None: those that a model knows.
        phase : bool, default=False
            Whether to draw the phases below the magnitudes.
        ax : Axes or array of Axes, default=None

        Returns
        -------
        BodeDisplay

        Raises
        ------
        ValueError
            If models differ in inputs or outputs, or shapes do not fit.
        """
        models = named("models", models, "StateSpace models")
        hint = (
            "; a fitted estimator holds one in `lti_`, an LPVStateSpace gives one by "
            "`at(kappa)`"
        )
        for name, model in models.items():
            check_model(f"models[{name!r}]", model, hint=hint)
        if by_name("std", std) and omega is None:
            raise ValueError(
                "`omega` must be given with `std`, which belongs to frequencies. Got "
                "None."
            )
        grid = (
            frequency_axis(list(models.values()))
            if omega is None
            else check_frequencies(omega)
        )
        responses = {
            name: response_up_to_nyquist(model, grid) for name, model in models.items()
        }
        told = {
            "output_names": output_names,
            "input_names": input_names,
            "units": units,
        }
        for key, given in told.items():  # else by the first model that knows them
            known = [getattr(model, key) for model in models.values()]
            if given is None:
                told[key] = next((own for own in known if own is not None), None)
        names: dict[str, Any] = {
            **told,
            "frequency_label": frequency_label(list(models.values())),
        }
        return cls(grid, responses, std=std, **names).plot(ax, phase=phase)

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        *,
        kappa: float | ArrayLike | None = None,
        others: Mapping[str, StateSpace] | None = None,
        omega: ArrayLike | None = None,
        uncertainty: bool = False,
        units: Mapping[str, str] | None = None,
        phase: bool = False,
        ax: Any = None,
    ) -> BodeDisplay:
        """Draw what an estimator has identified.

        Parameters
        ----------
        estimator : fitted estimator
            `SubspaceLTI` and `GrayBoxRestructurer` show their model. The pipeline
            shows the local (black-box) and the gray-box model of the operating point
            nearest to `kappa`, and the interpolated model there.
        kappa : float or array-like of shape (n_scheduling,), default=None
            Scheduling value; needed by the pipeline. Several of them, of shape
            (n_points, n_scheduling), draw the family of the interpolated models there.
        others : dict from str to StateSpace, default=None
            Models to compare with, drawn first: the truth, an analytic model.
        omega : array-like of shape (n_freq,), default=None
        uncertainty : bool, default=False
            Whether to draw the band of two standard deviations, which `SubspaceLTI`
            knows of its model, and a pipeline of the interpolated one: that of the
            coefficients (``lpv_.covariance``), without the model's own error.
        units : dict from str to str, default=None
            Units of outputs and inputs, by name; None: those that a model knows.
        phase : bool, default=False
        ax : Axes or array of Axes, default=None

        Returns
        -------
        BodeDisplay

        Raises
        ------
        ValueError
            If the estimator holds no state-space model, the pipeline is not told
            `kappa`, or the uncertainty is not known.
        """
        own = models_of(estimator, kappa)
        others = by_name("others", others)
        both = with_others(own, others)
        models = {name: both[name] for name in [*others, *both]}
        std = None
        if whole("uncertainty", uncertainty, range(2)):
            omega = frequency_axis(list(models.values())) if omega is None else omega
            std = _uncertainty_of(unwrapped(estimator), own, kappa, omega)
        return cls.from_models(
            models, omega=omega, std=std, units=units, phase=phase, ax=ax
        )

    def plot(
        self, ax: Any = None, *, phase: bool = False, n_std: float = 2.0
    ) -> BodeDisplay:
        """Draw the diagram.

        Parameters
        ----------
        ax : Axes or array of Axes, default=None
            None makes a figure. Of an array, rows are outputs (with phases, magnitude
            and phase in turn), columns are inputs.
        phase : bool, default=False
        n_std : float, default=2.0
            Half-width of the bands, in standard deviations.

        Returns
        -------
        BodeDisplay
        """
        n_outputs, n_inputs = len(self.output_names), len(self.input_names)
        phase = bool(whole("phase", phase, range(2)))
        kinds = 2 if phase else 1
        self.figure_, axes = axes_grid(
            ax,
            kinds * n_outputs,
            n_inputs,
            height=0.9 + n_outputs * (2.1 + 1.3 * phase) + 0.5 * (n_outputs == 1),
            sharex=True,
            sharey="row",
            height_ratios=[1.6, 1.0] * n_outputs if phase else None,
        )
        self.axes_ = axes[::kinds]
        self.phase_axes_ = axes[1::2] if phase else None
        self.lines_ = self._draw(self.axes_, _magnitudes, n_std)
        self.phase_lines_: dict[str, Any] = {}
        if self.phase_axes_ is not None:
            self.phase_lines_ = self._draw(self.phase_axes_, _aligned_phases, n_std)
        self._dress(axes)
        handles = [lines[0, 0] for lines in self.lines_.values()]
        self.figure_.align_ylabels(axes[:, 0])
        figure_legend(self.figure_, axes[0, 0], handles, own=ax is None)
        drawable(self.figure_)
        return self

    def _draw(self, axes: Any, curves: Any, n_std: float) -> dict[str, Any]:
        lines = {name: np.empty(axes.shape, dtype=object) for name in self.responses}
        for i, j in np.ndindex(*axes.shape):
            entries = {name: G[:, i, j] for name, G in self.responses.items()}
            spread = {name: n_std * s[:, i, j] for name, s in self.std.items()}
            drawn = curves(entries, spread)
            for k, (name, (middle, low, high)) in enumerate(drawn.items()):
                style = line_style(k, len(self.omega))
                (lines[name][i, j],) = axes[i, j].plot(
                    self.omega, middle, label=name, **style
                )
                if name in spread:
                    band(axes[i, j], self.omega, low, high, style["color"])
        return lines

    def _dress(self, axes: Any) -> None:
        from matplotlib.ticker import MultipleLocator

        for ax in axes.flat:
            ax.set_xscale("log")
            ax.set_xlim(self.omega[0], self.omega[-1])
            tidy(ax)
        inputs, outputs = (
            [
                with_unit(*pair)
                for pair in zip(names, units_of(names, self.units), strict=True)
            ]
            for names in (self.input_names, self.output_names)
        )
        for j, name in enumerate(inputs):
            if len(inputs) > 1 or self.units:
                axes[0, j].set_title(f"from {name}", fontsize=9, y=1.0)
            axes[-1, j].set_xlabel(self.frequency_label)
        for i, name in enumerate(outputs):
            several = len(outputs) > 1 or len(inputs) > 1 or self.units
            prefix = f"to {name}\n" if several else ""
            self.axes_[i, 0].set_ylabel(f"{prefix}Magnitude (dB)")
            top = max(ax.dataLim.y1 for ax in self.axes_[i])
            low = min(ax.dataLim.y0 for ax in self.axes_[i])
            if top - low > _RANGE:
                self.axes_[i, 0].set_ylim(top - _RANGE, top + 0.05 * _RANGE)
            if self.phase_axes_ is not None:
                row = self.phase_axes_[i]
                row[0].set_ylabel("Phase (deg)")
                span = np.ptp([(a.dataLim.y0, a.dataLim.y1) for a in row])
                # Fractions of a turn as ticks, five of them at most.
                step = next((s for s in (45, 90, 180, 360) if span <= 5 * s), 720)
                row[0].yaxis.set_major_locator(MultipleLocator(step))


def _uncertainty_of(
    owner: Any, own: Mapping[str, StateSpace], kappa: Any, omega: ArrayLike
) -> dict[str, NDArray[np.complex128]]:
    """Standard deviations of the responses of an estimator's models, where known."""
    if hasattr(owner, "lpv_") and np.ndim(kappa) == 2:
        return {
            name: owner.lpv_.frequency_response_std(place, omega)
            for name, place in places_of(owner, kappa).items()
        }
    if hasattr(owner, "lpv_"):
        std = owner.lpv_.frequency_response_std(kappa, omega)
        return {name: std for name in own if name == "interpolated"}
    if not hasattr(owner, "frequency_response_std"):
        raise ValueError(
            "`uncertainty` must be False for an estimator that does not know "
            f"it, as SubspaceLTI does. Got True with {type(owner).__name__}; "
            "BodeDisplay.from_models takes standard deviations as `std`."
        )
    return {name: owner.frequency_response_std(omega) for name in own}


def _magnitudes(
    entries: Mapping[str, Complex], spread: Mapping[str, Array]
) -> dict[str, tuple[Array, Array, Array]]:
    """Magnitudes in dB with their bands, by name; NaN where a gain is zero."""
    found = {}
    for name, G in entries.items():
        size, width = np.abs(G), spread.get(name, 0.0)
        # A band that reaches down to zero ends far below the picture.
        low = np.maximum(size - width, 1e-3 * size)  # 60 dB below the curve
        gains = (np.where(gain > 0, gain, np.nan) for gain in (size, low, size + width))
        middle, low, high = (20.0 * np.log10(gain) for gain in gains)
        found[name] = (middle, low, high)
    return found


def _aligned_phases(
    entries: Mapping[str, Complex], spread: Mapping[str, Array]
) -> dict[str, tuple[Array, Array, Array]]:
    """Unwrapped phases in degrees with their bands, by name.

    A phase is known up to full turns: those of the first name are taken as they
    come, the others turned next to it.
    """
    found: dict[str, tuple[Array, Array, Array]] = {}
    reference: Array | None = None
    for name, G in entries.items():
        seen = np.isfinite(G) & (G != 0)
        phase = np.full(len(G), np.nan)
        phase[seen] = np.rad2deg(np.unwrap(np.angle(G[seen])))
        if reference is None:
            reference = phase
        both = np.isfinite(phase) & np.isfinite(reference)
        if both.any():
            phase += 360.0 * np.round(np.median((reference - phase)[both]) / 360.0)
        ratio = spread.get(name, 0.0) / np.where(seen, np.abs(G), np.nan)
        width = np.rad2deg(np.arcsin(np.minimum(ratio, 1.0)))
        found[name] = (phase, phase - width, phase + width)
    return found
