"""What all pictures share: styles of lines, axes, grids, legends, units."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ..data.tables import as_numbers

WIDTH = 8.0  # inches: 800 pixels at matplotlib's 100 dots per inch

LABEL_SIZE, TEXT_SIZE = 9.0, 8.5  # points: read at the width of a column

_N_MARKERS = 20  # on a line

INK, MUTED, ACCENT = "#000000", "#767676", "#D55E00"

# The palette of Okabe and Ito, told apart with any colour vision; dashes and markers
# tell the lines apart without colour too.
_STYLES: tuple[dict[str, Any], ...] = (
    {"color": INK, "linestyle": "-", "linewidth": 1.5},
    {"color": ACCENT, "linestyle": (0, (4, 1.6)), "linewidth": 1.6},
    {"color": "#0072B2", "linestyle": "-", "linewidth": 1.1, "marker": "o"},
    {"color": "#009E73", "linestyle": (0, (6, 1.5, 1.2, 1.5)), "linewidth": 1.5},
    {"color": "#CC79A7", "linestyle": (0, (1.2, 1.2)), "linewidth": 1.8},
    {"color": "#E69F00", "linestyle": "-", "linewidth": 1.1, "marker": "s"},
    {"color": "#56B4E9", "linestyle": (0, (4, 1.6)), "linewidth": 1.1, "marker": "^"},
)

_POINTS: tuple[dict[str, Any], ...] = (
    {"color": ACCENT, "marker": "o", "markersize": 4.5},
    {"color": INK, "marker": "s", "markersize": 6.5, "markerfacecolor": "none"},
    {"color": "#0072B2", "marker": "^", "markersize": 6.0, "markerfacecolor": "none"},
    {"color": "#009E73", "marker": "x", "markersize": 5.5},
    {"color": "#CC79A7", "marker": "D", "markersize": 5.0, "markerfacecolor": "none"},
)


def line_style(k: int, n_points: int = 0) -> dict[str, Any]:
    """Keywords of the k-th line; markers, where it has them, stand at distances."""
    style = dict(_STYLES[k % len(_STYLES)])
    if "marker" in style:
        step = max(1, n_points // _N_MARKERS)
        # Lines with markers do not put them at the same places.
        style |= {
            "markersize": 4.0,
            "markerfacecolor": "white",
            "markevery": (k * step // len(_STYLES), step),
        }
    return style


def point_style(k: int) -> dict[str, Any]:
    """Keywords of the k-th set of points: filled or hollow, of different shapes."""
    return dict(_POINTS[k % len(_POINTS)]) | {"linestyle": "none"}


def axes_grid(
    ax: Any,
    n_rows: int,
    n_columns: int,
    *,
    height: float,
    sharex: bool | str = False,
    sharey: bool | str = False,
    height_ratios: Sequence[float] | None = None,
) -> tuple[Any, Any]:
    """A figure and an array of axes of shape (n_rows, n_columns) to draw in.

    `ax` None makes a figure of `height` inches; a single Axes is divided where more
    than one is needed; an array must hold as many as that.
    """
    from matplotlib import pyplot as plt
    from matplotlib.axes import Axes

    share: dict[str, Any] = {"sharex": sharex, "sharey": sharey, "squeeze": False}
    n_axes = n_rows * n_columns
    if ax is None:
        return plt.subplots(
            n_rows,
            n_columns,
            figsize=(WIDTH, height),
            layout="constrained",
            height_ratios=height_ratios,
            **share,
        )
    if isinstance(ax, Axes) and n_axes > 1 and ax.get_subplotspec() is not None:
        ax.set_axis_off()
        spec: Any = ax.get_subplotspec()
        cells = spec.subgridspec(n_rows, n_columns, height_ratios=height_ratios)
        return ax.figure, cells.subplots(**share)
    axes = np.atleast_1d(np.asarray(ax, dtype=object))
    if axes.size != n_axes or not all(isinstance(one, Axes) for one in axes.flat):
        kinds = ", ".join(sorted({type(one).__name__ for one in axes.flat}))
        raise ValueError(
            f"`ax` must be None, one subplot or an array of {n_axes} Axes "
            f"({n_rows} x {n_columns}). Got {axes.size} of {kinds}."
        )
    return axes.flat[0].figure, axes.reshape(n_rows, n_columns)


def single_axes(ax: Any, height: float) -> tuple[Any, Any]:
    """A figure and an array of one Axes to draw in; `ax` and `height` as above."""
    figure, axes = axes_grid(ax, 1, 1, height=height)
    return figure, axes.ravel()


def tidy(ax: Any) -> None:
    """A light grid below the data, no box, small tick labels."""
    ax.grid(True, which="major", color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("0.5")
    ax.tick_params(which="both", labelsize=TEXT_SIZE, color="0.5")
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_offset_text().set_fontsize(TEXT_SIZE)
        axis.label.set_fontsize(LABEL_SIZE)


def band(ax: Any, x: Any, low: Any, high: Any, colour: Any, alpha: float = 0.2) -> None:
    """What is not known of a curve, as a pale band about it."""
    ax.fill_between(x, low, high, color=colour, alpha=alpha, lw=0)


def legend_above(
    ax: Any, handles: Sequence[Any], *, n_columns: int = 3, title: str | None = None
) -> Any:
    """A legend in a row above the axes, where it hides no data."""
    return ax.legend(
        handles=list(handles),
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=min(n_columns, len(handles)),
        title=title,
        alignment="left",
        frameon=False,
        borderaxespad=0.1,
        handlelength=2.6,
        columnspacing=1.6,
        fontsize=TEXT_SIZE,
        title_fontsize=TEXT_SIZE,
    )


def figure_legend(figure: Any, ax: Any, handles: Sequence[Any], own: bool) -> Any:
    """One legend for several axes: above the figure if it is ours, else within `ax`.

    Beside the title of a part of a figure.
    """
    from matplotlib.figure import SubFigure

    if not own and isinstance(figure, SubFigure) and figure.get_suptitle():
        return figure.legend(
            handles=list(handles),
            loc="upper right",
            ncols=len(handles),
            frameon=False,
            fontsize=TEXT_SIZE,
        )
    if not own:
        legend = ax.legend(handles=list(handles), fontsize=8, framealpha=0.8)
        # A legend wider than its panel would squeeze the panels.
        legend.set_in_layout(False)
        return legend
    return figure.legend(
        handles=list(handles),
        loc="outside upper left",
        ncols=min(4, len(handles)),
        frameon=False,
        handlelength=3.0,
        fontsize=TEXT_SIZE,
    )


def named(argument: str, values: Any, what: str) -> dict[str, Any]:
    """`values` as a dict from names to things to draw, or a ValueError."""
    if not isinstance(values, Mapping) or len(values) == 0:
        got = "an empty dict" if isinstance(values, Mapping) else type(values).__name__
        raise ValueError(
            f"`{argument}` must be a dict from names to {what}, with at least one "
            f"entry, for instance {{'estimated': ...}}. Got {got}."
        )
    return {str(name): value for name, value in values.items()}


def by_name(argument: str, values: Any) -> dict[str, Any]:
    """`values` as a dict from names, empty for None, or a ValueError."""
    if values is not None and not isinstance(values, Mapping):
        raise ValueError(
            f"`{argument}` must be a dict from names, or None. Got "
            f"{type(values).__name__}."
        )
    return {str(name): value for name, value in (values or {}).items()}


def whole(argument: str, value: Any, allowed: range) -> int:
    """A whole number among those `allowed`, or a ValueError."""
    number = as_numbers(argument, value)
    if number.shape != (1,) or number[0] not in allowed:
        raise ValueError(
            f"`{argument}` must be a whole number from {allowed[0]} to {allowed[-1]}. "
            f"Got {value!r}."
        )
    return int(number[0])


def with_unit(name: Hashable, unit: str | None) -> str:
    """A quantity's label with its unit in parentheses, if its name has none."""
    told = str(name).rstrip()[-1:] in (")", "]")
    return f"{name} ({unit})" if unit and not told else str(name)


def units_of(
    names: Sequence[Hashable], units: str | Sequence[str] | Mapping[str, str] | None
) -> list[str | None]:
    """A unit or None of every name: one for all, one for each, or by name."""
    if units is None or isinstance(units, str):
        return [units] * len(names)
    if isinstance(units, Mapping):
        return [units.get(str(name)) for name in names]
    return list(given_names("units", units, len(names), ""))


def labels_of(label: str | Sequence[str], n: int) -> list[str]:
    """Labels of n scheduling variables; one for several is numbered."""
    if isinstance(label, str):
        return [label] if n == 1 else [f"{label}{k + 1}" for k in range(n)]
    return given_names("scheduling_label", label, n, "κ")


def colour_scale(values: Any) -> dict[str, Any]:
    """Colour map and scale: cividis, lightness in step, without its palest end."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap, Normalize

    cmap = ListedColormap(colormaps["cividis"](np.linspace(0.0, 0.9, 256)))
    return {"cmap": cmap, "norm": Normalize(np.min(values), np.max(values))}


def colour_bar(figure: Any, drawn: Any, ax: Any, label: str = "") -> Any:
    """A bar beside the axes; its label runs along it, where none is too long."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import MaxNLocator

    is_log = isinstance(drawn.norm, LogNorm)
    ticks = None if is_log else MaxNLocator(5)
    bar = figure.colorbar(drawn, ax=ax, pad=0.02, aspect=30, ticks=ticks)
    if is_log:
        plain_ticks(bar.ax.yaxis)
    bar.set_label(label, fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TEXT_SIZE)
    bar.outline.set_visible(False)
    return bar


def plain_ticks(axis: Any) -> None:
    """0.1, 0.2, 0.5, 1 and so on along a logarithmic axis, in place of powers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def is_names(names: Any) -> bool:
    """Whether a value is a list of what may be a name."""
    listed = pd.api.types.is_list_like(names, allow_sets=False)
    listed = listed and hasattr(names, "__len__")  # an iterator is read once only
    return listed and all(isinstance(name, Hashable) for name in names)


def given_names(argument: str, names: Any, n: int, letter: str) -> list[str]:
    """Given names, else the letter with numbers from 1."""
    if names is None:
        return [f"{letter}{k + 1}" for k in range(n)]
    if not is_names(names) or len(names) != n:
        raise ValueError(f"`{argument}` must hold {n} names. Got {names!r}.")
    return [str(name) for name in names]


def drawable(figure: Any) -> None:
    """Show labels as they are written where they are no formulas, as "$x_".

    Matplotlib takes what stands between two dollars for a formula, and fails at the
    first look at the figure where it is none.
    """
    from matplotlib.mathtext import MathTextParser

    parser: Any = MathTextParser("path")
    for text in _texts(figure):
        if text.get_text().count("$") > 1 and text.get_parse_math():
            try:
                parser.parse(text.get_text())
            except ValueError:
                text.set_parse_math(False)


def _texts(artist: Any) -> Iterator[Any]:
    """All texts but the labels of ticks, which are numbers, and made when drawn."""
    from matplotlib.axis import Axis
    from matplotlib.text import Text

    if isinstance(artist, Text):
        yield artist
    children = [artist.label] if isinstance(artist, Axis) else artist.get_children()
    for child in children:
        yield from _texts(child)
