"""Auto- and cross-correlations of the errors of a model."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ..data.alignment import align_outputs
from ..data.preparation import read_runs
from ..data.tables import Table, as_numbers, read_outputs
from ..metrics.table_simulation import unwrap
from ..subspace import SubspaceLTI
from ..subspace.evidence.residuals import (
    Residuals,
    autocorrelations,
    check_kind,
    cross_correlations,
    input_labels,
    residual_tests,
    with_windows,
)
from .drawing import (
    ACCENT,
    INK,
    LABEL_SIZE,
    MUTED,
    TEXT_SIZE,
    axes_grid,
    drawable,
    figure_legend,
    given_names,
    tidy,
)

Array = NDArray[np.float64]

# Bands hold the correlations of strangers with this probability, each for itself: of
# the 76 values of a panel pair some are outside a 95 % band always.
_CONFIDENCE = 0.99

_HEADROOM = 1.3  # of a panel above its largest value, where its words stand


class ResidualDisplay:
    """Correlations of a model's errors with themselves and with the inputs.

    One row of panels for each output. On the left the autocorrelations: beyond the
    band the errors are coloured. Then the cross-correlations with each input, errors
    and inputs whitened by autoregressions first: beyond the band at positive lags
    (past inputs) the model lacks something, at negative lags (future inputs) the errors
    went back to the input: feedback. At lag 0 it is either, and the p-value is
    shown where it is small. The p-values are those of
    `SubspaceLTI.residual_tests`: of all lags of a part together, given the parts before
    it. Make it with `from_estimator` or `from_residuals`.

    Parameters
    ----------
    errors : array-like of shape (n_samples, n_outputs) or list of them
        Measured minus simulated or predicted outputs, one array per experiment.
    inputs : array-like of shape (n_samples, n_inputs) or list of them
    n_lags : int, default=None
        None: 25, fewer where the experiments are short.
    confidence : float, default=0.99
        Probability with which independent errors stay within the bands.
    output_names, input_names : sequence, default=None
        None is y1, y2, ... and u1, u2, ...
    what : str, default="residuals"
        Name of the errors, for the title.

    Attributes
    ----------
    autocorrelations : ndarray of shape (n_lags + 1, n_outputs)
    cross_correlations : CrossCorrelations
        `lags` and `values` of shape (2 * n_lags + 1, n_outputs, n_inputs).
    autocorrelation_band, cross_correlation_band : float
        Half the width of the bands.
    tests : DataFrame
        As `SubspaceLTI.residual_tests` returns.
    ax_ : Axes
        The first panel.
    axes_ : ndarray of Axes of shape (n_outputs, 1 + n_inputs)
    figure_ : Figure
    lines_ : dict from str to ndarray of Line2D of shape (n_outputs, 1 + n_inputs)
        "inside" and "outside": correlations within and beyond the bands.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn.inspection import ResidualDisplay
    >>> e, u = np.random.default_rng(1).standard_normal((2, 1000, 1))
    >>> e[3:] += 0.2 * u[:-3]
    >>> display = ResidualDisplay.from_residuals(e, u)
    >>> display.lines_["outside"][0, 1].get_xdata()
    array([3])
    """

    def __init__(
        self,
        errors: Any,
        inputs: Any,
        *,
        n_lags: int | None = None,
        confidence: float = _CONFIDENCE,
        output_names: Sequence[Hashable] | None = None,
        input_names: Sequence[Hashable] | None = None,
        what: str = "residuals",
    ) -> None:
        parts, u = _as_parts("errors", errors), _as_parts("inputs", inputs)
        sizes = [len(e) for e in parts]
        if sizes != [len(part) for part in u]:
            raise ValueError(
                f"`inputs` must have as many samples as `errors`, {sizes}. Got "
                f"{[len(part) for part in u]}."
            )
        outputs = given_names("output_names", output_names, parts[0].shape[1], "y")
        names = given_names("input_names", input_names, u[0].shape[1], "u")
        self._examine(Residuals(parts, u, outputs, names), n_lags, confidence, what)

    def _examine(
        self, residuals: Residuals, n_lags: int | None, confidence: float, what: str
    ) -> None:
        level = as_numbers("confidence", confidence)
        if level.shape != (1,) or not 0.0 < level[0] < 1.0:
            raise ValueError(
                f"`confidence` must lie between 0 and 1. Got {confidence}."
            )
        self.confidence, self.what = float(level[0]), what
        residuals, n_lags = with_windows(residuals, n_lags)
        errors, u, outputs, inputs = residuals[:4]
        self.output_names = [str(name) for name in outputs]
        self.input_names = [str(name) for name in inputs]
        quantile = float(norm.ppf(0.5 + 0.5 * self.confidence))
        self.autocorrelations = autocorrelations(errors, n_lags)
        self.autocorrelation_band = quantile / np.sqrt(sum(map(len, errors)))
        self.cross_correlations = cross_correlations(errors, u, n_lags)
        self.cross_correlation_band = quantile * self.cross_correlations.deviation
        beyond = 1.0 - self.confidence
        self.tests = residual_tests(residuals, n_lags=n_lags, level=beyond)

    @classmethod
    def from_residuals(
        cls, errors: Any, inputs: Any, *, ax: Any = None, **options: Any
    ) -> ResidualDisplay:
        """Draw the correlations of given errors.

        Parameters
        ----------
        errors : array-like of shape (n_samples, n_outputs) or list of them
        inputs : array-like of shape (n_samples, n_inputs) or list of them
        ax : Axes or array of Axes, default=None
        **options
            `n_lags`, `confidence`, `output_names`, `input_names`, `what` of the class.

        Returns
        -------
        ResidualDisplay
        """
        return cls(errors, inputs, **options).plot(ax)

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: Any,
        y: Any,
        *,
        errors: str = "simulation",
        n_lags: int | None = None,
        confidence: float = _CONFIDENCE,
        ax: Any = None,
    ) -> ResidualDisplay:
        """Draw the correlations of an estimator's errors on a table.

        Parameters
        ----------
        estimator : fitted estimator, or a fitted search over one
            `SubspaceLTI` or `LocalLPVPipeline`. On the samples of the fit the p-values
            of the former allow for the fitted parameters.
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : DataFrame or array-like of shape (n_samples, n_outputs) or (n_samples,)
        errors : {"simulation", "prediction"}, default="simulation"
            "prediction" takes one-step predictions of `SubspaceLTI`, which a noise
            model should leave white.
        n_lags : int, default=None
            None: 25, fewer where the experiments are short.
        confidence : float, default=0.99
        ax : Axes or array of Axes, default=None

        Returns
        -------
        ResidualDisplay

        Raises
        ------
        ValueError
            If an option is unknown, the estimator is another, or the experiments are
            too short.
        """
        check_kind(errors)
        (estimator, X), simulates = unwrap(estimator, X), errors == "simulation"
        if isinstance(estimator, SubspaceLTI):
            residuals = estimator._residuals(X, y, errors)
        elif simulates and hasattr(estimator, "predict_with_initial_state"):
            X = Table(X).X
            y = align_outputs(X, y, estimator)
            outputs, names = read_outputs(y)
            simulated = estimator.predict_with_initial_state(X, y)
            wrong = outputs - np.reshape(simulated, outputs.shape)
            runs = read_runs(estimator, X, y, split=True, reset=False)
            labels = input_labels(runs[0].input_names)
            residuals = Residuals(
                [wrong[e.rows] for e in runs],
                [e.inputs for e in runs],
                names,
                labels,
                n_missing=np.isnan(wrong).sum(axis=0),
            )
        else:
            wanted = " or a LocalLPVPipeline" if simulates else ""
            raise ValueError(
                f"`estimator` must be a SubspaceLTI{wanted} for errors={errors!r}. Got "
                f"{type(estimator).__name__}; predict with it and use from_residuals()."
            )
        display = cls.__new__(cls)
        what = "simulation errors" if simulates else "one-step prediction errors"
        display._examine(residuals, n_lags, confidence, what)
        return display.plot(ax)

    def plot(self, ax: Any = None) -> ResidualDisplay:
        """Draw the correlations.

        Parameters
        ----------
        ax : Axes or array of Axes, default=None
            None makes a figure; one subplot is divided.

        Returns
        -------
        ResidualDisplay
        """
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        ny, m = len(self.output_names), len(self.input_names)
        height = 0.9 + (2.6 if ny == 1 else 2.0 * ny)
        self.figure_, self.axes_ = axes_grid(ax, ny, 1 + m, height=height, sharex="col")
        self.ax_ = self.axes_.flat[0]
        self.lines_ = {
            name: np.empty((ny, 1 + m), dtype=object) for name in ("inside", "outside")
        }
        lags = self.cross_correlations.lags
        for i, output in enumerate(self.output_names):
            tests = self.tests.iloc[i * (1 + 3 * m) :]  # whiteness, then m at a time
            lost = tests["n_missing"].iloc[0]
            self.axes_[i, 0].set_ylabel(f"{output}, {lost} missing" if lost else output)
            own = self.autocorrelations[1:, i]
            self._panel((i, 0), lags[lags > 0], own, self.autocorrelation_band)
            self._say(self.axes_[i, 0], tests.iloc[0], "whiteness", "left")
            for j in range(m):
                values = self.cross_correlations.values[:, i, j]
                self._panel((i, 1 + j), lags, values, self.cross_correlation_band)
                one = self.axes_[i, 1 + j]
                one.axvline(0.0, color=MUTED, linewidth=0.8, linestyle=":", zorder=0.5)
                past, present, future = (tests.iloc[1 + j + k * m] for k in range(3))
                self._say(one, future, "future", "left")
                # In narrow panels two texts do not fit side by side.
                self._say(one, past, "past", "right", low=m > 2)
                if not present["passed"]:
                    self._say(one, present, "lag 0", "left", low=True)
        titles = ["with itself", *(f"with {name}" for name in self.input_names)]
        for k, title in enumerate(titles):
            self.axes_[0, k].set_title(title, fontsize=LABEL_SIZE)
            self.axes_[-1, k].set_xlabel("Lag (samples)")
        if ax is None:
            band = f"{100 * self.confidence:g} % band of independent signals"
            handles = [
                Patch(color="0.85", label=band),
                Line2D([], [], color=ACCENT, marker="o", markersize=4, label="beyond"),
            ]
            legend = figure_legend(self.figure_, self.ax_, handles, own=True)
            legend.set_title(f"Correlations of {self.what}", {"size": LABEL_SIZE})
            legend.set_alignment("left")
        drawable(self.figure_)
        return self

    def _panel(
        self, place: tuple[int, int], lags: NDArray[Any], values: Array, band: float
    ) -> None:
        """Stems over a band, those beyond it in the accent colour."""
        one = self.axes_[place]
        one.axhspan(-band, band, color="0.88", linewidth=0, zorder=0.4)
        one.axhline(0.0, color="0.5", linewidth=0.7, zorder=0.6)
        beyond = np.abs(values) > band
        dots: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 3.0}
        shares = {"inside": (~beyond, INK), "outside": (beyond, ACCENT)}
        for name, (shown, colour) in shares.items():
            x, y = lags[shown], values[shown]
            one.vlines(x, 0.0, y, color=colour, linewidth=1.1)
            (self.lines_[name][place],) = one.plot(x, y, color=colour, **dots)
        reach = max(np.abs(values).max(), 1.2 * band) or 1.0  # errors may be zero
        one.set_ylim(-_HEADROOM * reach, _HEADROOM * reach)
        one.set_xlim(lags[0] - 0.8, lags[-1] + 0.8)
        tidy(one)

    def _say(
        self, ax: Any, test: Any, what: str, side: str, *, low: bool = False
    ) -> None:
        """The p-value of a test in a corner; refused ones stand out."""
        p = test["p_value"]
        shown = f"= {p:.2f}" if p >= 0.01 else f"= {p:.0e}".replace("e-0", "e-")
        ax.text(
            0.02 if side == "left" else 0.98,
            0.02 if low else 0.985,
            f"{what} p {'< 1e-99' if p < 1e-99 else shown}",
            transform=ax.transAxes,
            ha=side,
            va="bottom" if low else "top",
            fontsize=TEXT_SIZE,
            color=INK if test["passed"] else ACCENT,
        )


def _as_parts(argument: str, values: Any) -> list[Array]:
    """One finite matrix per experiment."""
    several = isinstance(values, list | tuple) and (
        all(np.ndim(x) > 0 for x in values) and len(values) > 0
    )
    parts = [as_numbers(argument, x) for x in (values if several else [values])]
    parts = [part[:, None] if part.ndim == 1 else part for part in parts]
    if (
        len({part.shape[1:] for part in parts}) > 1
        or parts[0].ndim != 2
        or (0 in parts[0].shape)
    ):
        raise ValueError(
            f"`{argument}` must be one array of shape (n_samples, n_channels) for each "
            f"experiment. Got shapes {[part.shape for part in parts]}."
        )
    if not all(np.isfinite(part).all() for part in parts):
        raise ValueError(
            f"`{argument}` must be finite. Leave out missing samples: give the runs "
            "between them as experiments."
        )
    return parts
