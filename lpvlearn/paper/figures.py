"""The paper's Figures 2 to 10, drawn from our own run of its experiment."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import LocalLPVPipeline, PolynomialLPV
from ..inspection import BodeDisplay, ParameterDisplay, SimulationDisplay
from ..inspection.drawing import axes_grid, figure_legend, tidy
from .experiment import PaperExperiment
from .tables import local_experiments, nearest_model, simulate_sweep

Array = NDArray[np.float64]

_RATE = "rad/s"  # unit of inputs and outputs

_TRUE = "arm, without noise"  # what the validation data are

_DOTS_PER_INCH = 130  # 1040 pixels wide

_COMPRESSION = {"compress_level": 3}  # in two thirds of the time, 4 % larger

_TITLE_SIZE = 10.0  # points

_RIGHT, _BELOW = 0.15, 0.46  # inches beside and under the axes

# The arm's dynamics, 0.7 to 120 rad/s, and up to 1e4 rad/s as in the paper.
_BODE_RANGE = (1e-1, 1e4)

# Diagonal and neighbours of A: enough to see how a balanced basis wanders.
_BALANCED_ENTRIES = (
    (1, 1), (1, 2), (2, 2), (2, 3), (3, 3), (3, 4), (4, 4), (4, 5),
    (5, 5), (5, 6), (6, 6), (1, 6),
)  # fmt: skip


def save_figures(experiment: PaperExperiment, directory: Path) -> list[Path]:
    """Draw Figures 2 to 10 and save them as PNG files.

    Parameters
    ----------
    experiment : PaperExperiment
        From `run_paper_experiment`.
    directory : Path
        Made if it does not exist.

    Returns
    -------
    list of Path
        ``figure02.png``, ..., ``figure10.png``.

    Notes
    -----
    The figures are closed when they are saved: none is shown.
    """
    from matplotlib import pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, (draw, room) in _FIGURES.items():
        figure, title = draw(experiment)
        _entitle(figure, f"Figure {number}. {title}")
        _place(figure, room)
        path = directory / f"figure{number:02d}.png"
        figure.set_dpi(_DOTS_PER_INCH)
        with path.open("wb") as file:
            # drawn once, by savefig thrice
            FigureCanvasAgg(figure).print_png(file, pil_kwargs=_COMPRESSION)
        plt.close(figure)
        paths.append(path)
    return paths


def _entitle(figure: Any, title: str) -> None:
    """A title above a figure: over its legend where that stands above the axes."""
    if not figure.legends:
        figure.suptitle(title, fontsize=_TITLE_SIZE, x=0.01, ha="left")
        return
    # Both would claim the same place if the title were the figure's.
    legend = figure.legends[0]
    legend.set_alignment("left")
    legend.set_title(title, prop={"size": _TITLE_SIZE})


class _Room(NamedTuple):
    """Inches that labels take beside axes, and titles above them."""

    left: float
    above: float
    between_rows: float = 0.0
    between_columns: float = 0.0


def _place(figure: Any, room: _Room) -> None:
    """Axes where there is room for their labels.

    Matplotlib's own layout measures all of them, in more time than it draws them.
    """
    figure.set_layout_engine("none")
    width, height = figure.get_size_inches()
    grid = figure.axes[0].get_gridspec()
    across = width - room.left - _RIGHT + room.between_columns
    down = height - room.above - _BELOW + room.between_rows
    for ax in figure.axes:
        cell = ax.get_subplotspec()
        row, column = cell.rowspan.start, cell.colspan.start
        left = room.left + column * across / grid.ncols
        bottom = _BELOW + (grid.nrows - 1 - row) * down / grid.nrows
        wide = across / grid.ncols - room.between_columns
        high = down / grid.nrows - room.between_rows
        size = np.array([width, height, width, height])
        ax.set_position(np.array([left, bottom, wide, high]) / size)


def draw_data(experiment: PaperExperiment) -> tuple[Any, str]:
    """Fig. 2: inputs and outputs of one local experiment."""
    data = experiment.data
    labels = data.X["experiment"].to_numpy()
    middle = np.unique(labels)[len(np.unique(labels)) // 2]
    X, y = data.X[labels == middle], data.y[labels == middle]
    figure, axes = axes_grid(None, 4, 1, height=6.2, sharex=True)
    for ax, (name, signal) in zip(
        axes[:, 0], [*X[["u1", "u2"]].items(), *y.items()], strict=True
    ):
        is_input = name in X
        ax.plot(
            X["time"],
            signal,
            color="#000000" if is_input else "#0072B2",
            linewidth=0.8,
            drawstyle="steps-post" if is_input else "default",
        )
        ax.set_ylabel(f"{name} ({_RATE})")
        ax.set_xlim(0.0, X["time"].iloc[-1])
        tidy(ax)
    axes[-1, 0].set_xlabel("Time (s)")
    angle = _nearest_angle(data.theta2, float(X["kappa"].mean()))
    return figure, (
        f"Noisy data of one local experiment at θ₂ = {angle}: velocity references "
        "(above), outputs"
    )


def draw_local_responses(experiment: PaperExperiment) -> tuple[Any, str]:
    """Fig. 3: time responses of the local model at 5 pi / 8."""
    data = experiment.data
    wanted = np.cos(5 * np.pi / 8)
    kappa, X, y = min(local_experiments(data), key=lambda e: abs(e[0] - wanted))
    model = nearest_model(experiment.pipeline, kappa)
    simulated = model.simulate(
        X[["u1", "u2"]].to_numpy(), sampling_time=data.sampling_time
    )
    display = SimulationDisplay.from_predictions(
        X["time"],
        y.rename(columns=str),
        {"local model": simulated},
        units=_RATE,
        true_name=_TRUE,
        zoom=(0.0, min(1.0, float(X["time"].iloc[-1]))),
    )
    angle = _nearest_angle(data.theta2, kappa)
    return display.figure_, f"Local model at θ₂ = {angle} on new noise-free data"


def draw_bode(experiment: PaperExperiment) -> tuple[Any, str]:
    """Fig. 4: magnitudes at pi / 8 of the analytic, rigid and estimated models."""
    data = experiment.data
    theta2 = float(data.theta2[0])
    models = {
        "analytic": data.analytic_models[0],
        "estimated": nearest_model(experiment.pipeline, np.cos(theta2)),
        "rigid arm": data.arm.rigid(theta2),
    }
    display = BodeDisplay.from_models(models, omega=np.geomspace(*_BODE_RANGE, 600))
    nyquist = np.pi / data.sampling_time
    for ax in display.axes_.flat:
        ax.axvline(nyquist, color="0.6", linewidth=0.8, linestyle=":")
    display.axes_[0, 0].annotate(
        "Nyquist",
        (nyquist, 0.02),
        xycoords=("data", "axes fraction"),
        xytext=(-3, 0),
        textcoords="offset points",
        ha="right",
        fontsize=8,
        color="0.4",
    )
    angle = _nearest_angle(data.theta2, np.cos(theta2))
    return display.figure_, f"Bode magnitudes of the local models at θ₂ = {angle}"


def draw_parameters(experiment: PaperExperiment) -> tuple[Any, str]:
    """Fig. 5: the restructured and the analytic parameters over cos(theta2)."""
    names = experiment.pipeline.parameters_.columns.tolist()
    sets = {
        name: experiment.parameters[name].theta for name in ("restructured", "analytic")
    }
    display = ParameterDisplay(
        experiment.pipeline.operating_points_,
        sets,
        names=names,
        interpolators={"restructured": experiment.lpv["restructured"].interpolator},
        std=_deviations(experiment.pipeline),
        scheduling_label="κ = cos θ₂",
    ).plot()
    return display.figure_, (
        f"Parameters of the restructured and the analytic models, degree "
        f"{experiment.degree}"
    )


def _deviations(pipeline: LocalLPVPipeline) -> dict[str, Any]:
    """Standard deviations of the restructured parameters, where they are known."""
    std = pipeline.parameters_std_
    return {"restructured": std} if np.isfinite(std).all(axis=None) else {}


def draw_balanced(experiment: PaperExperiment) -> tuple[Any, str]:
    """Fig. 6: entries of A of the balanced local models over cos(theta2)."""
    found = experiment.parameters["balanced"]
    A = found.structure.matrices(found.theta)[0]
    order = A.shape[1]
    entries = [(i, j) for i, j in _BALANCED_ENTRIES if max(i, j) <= order]
    display = ParameterDisplay.from_parameters(
        experiment.pipeline.operating_points_,
        {"balanced": np.array([A[:, i - 1, j - 1] for i, j in entries]).T},
        names=[f"A[{i}, {j}]" for i, j in entries],
        interpolator=PolynomialLPV(experiment.degree),
        scheduling_label="κ = cos θ₂",
    )
    return display.figure_, (
        f"Entries of A of the balanced local models, degree {experiment.degree}"
    )


def draw_sweep_angle(experiment: PaperExperiment) -> tuple[Any, str]:
    """Fig. 7: theta2 during the validation of the LPV models."""
    data = experiment.data
    figure, axes = axes_grid(None, 1, 1, height=3.2)
    ax = axes[0, 0]
    ax.plot(
        data.X_sweep["time"],
        np.arccos(data.X_sweep["kappa"]),
        color="#000000",
        linewidth=1.4,
        label="θ₂ during the sweep",
    )
    for theta2 in data.theta2:
        ax.axhline(theta2, color="#0072B2", linewidth=0.8, linestyle="--", zorder=1)
    (local,) = ax.plot([], [], color="#0072B2", linewidth=0.8, linestyle="--")
    local.set_label("operating points of the local experiments")
    ax.set_yticks(
        data.theta2, [_nearest_angle(data.theta2, np.cos(t)) for t in data.theta2]
    )
    ax.set_xlim(0.0, data.X_sweep["time"].iloc[-1])
    ax.set_ylabel("θ₂ (rad)")
    ax.set_xlabel("Time (s)")
    tidy(ax)
    figure_legend(figure, ax, ax.get_legend_handles_labels()[0], own=True)
    return figure, "θ₂ during the validation of the LPV models"


def draw_sweep(experiment: PaperExperiment, name: str) -> tuple[Any, str]:
    """Fig. 8, 9 or 10: one LPV model on the sweep."""
    data = experiment.data
    display = SimulationDisplay.from_predictions(
        data.X_sweep["time"],
        data.y_sweep,
        {f"LPV, {name}": simulate_sweep(experiment.lpv[name], data)},
        units=_RATE,
        true_name=_TRUE,
    )
    return display.figure_, f"LPV model from the {name} local models on the sweep"


def _nearest_angle(theta2: Array, kappa: float) -> str:
    """The operating point nearest to a scheduling value, as a multiple of pi."""
    n = len(theta2) + 1
    i = int(np.argmin(np.abs(np.cos(theta2) - kappa))) + 1
    return f"π/{n}" if i == 1 else f"{i}π/{n}"


_PARAMETERS, _SIGNALS = _Room(0.47, 0.69, 0.44, 0.53), _Room(0.61, 0.49, 0.35)

_FIGURES: dict[int, tuple[Callable[[PaperExperiment], tuple[Any, str]], _Room]] = {
    2: (draw_data, _Room(0.69, 0.29, 0.14)),
    3: (draw_local_responses, _Room(0.69, 0.67, 0.35)),
    4: (draw_bode, _Room(0.83, 0.72, 0.14, 0.32)),
    5: (draw_parameters, _PARAMETERS),
    6: (draw_balanced, _PARAMETERS),
    7: (draw_sweep_angle, _Room(0.58, 0.54)),
    8: (partial(draw_sweep, name="restructured"), _SIGNALS),
    9: (partial(draw_sweep, name="analytic"), _SIGNALS),
    10: (partial(draw_sweep, name="balanced"), _SIGNALS),
}
