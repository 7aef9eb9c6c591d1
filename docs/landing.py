"""The picture of the landing page: experiments, parameters between them, a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI
from lpvlearn.datasets import load_varying_spring, prbs

TARGET = Path(__file__).parent / "_static" / "landing.png"

_STEP, _SAMPLES = 0.02, 1000
_NOISE = 0.04  # of the outputs' size, to be seen
_COLOURS = plt.get_cmap("cividis")(np.linspace(0.0, 0.85, 4))


def draw_landing_picture() -> None:
    """Local experiments, the parameter over the scheduling variable, a moving test."""
    data = load_varying_spring()
    rng = np.random.default_rng(0)
    y = data.y + _NOISE * float(data.y.std().iloc[0]) * rng.standard_normal(
        data.y.shape
    )
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, feedthrough=False),
        GrayBoxRestructurer(data.structure),
        scheduling="kappa",
        experiment="run",
        time="time",
    ).fit(data.X, y)
    figure, axes = plt.subplots(
        1, 3, figsize=(9, 2.7), layout="constrained", width_ratios=[1, 0.8, 1.2]
    )
    points = pipeline.operating_points_[:, 0]
    for k, (_, rows) in enumerate(data.X.groupby("run", sort=False)):
        shown = rows.index[:250]
        axes[0].plot(
            rows["time"].iloc[:250],
            y.loc[shown].to_numpy()[:, 0] - 5.5 * k,
            color=_COLOURS[k],
            linewidth=1.0,
        )
        axes[0].text(5.1, -5.5 * k, f"κ = {points[k]:g}", va="center", fontsize=9)
    axes[0].set(title="1. experiments at a few points", xlabel="Time (s)", yticks=[])

    kappa = np.linspace(points[0], points[-1], 100)
    stiffness = list(pipeline.parameters_).index("k")
    axes[1].plot(kappa, pipeline.lpv_.parameters(kappa)[:, stiffness], "k", lw=1.2)
    axes[1].scatter(points, pipeline.parameters_["k"], c=_COLOURS, s=45, zorder=3)
    axes[1].set(title="2. parameters between them", xlabel="κ", ylabel="stiffness k")

    path = np.linspace(points[0], points[-1], _SAMPLES)
    force = prbs(_SAMPLES, clock=12, random_state=5)
    truth = _simulated(data, force, path)
    time = _STEP * np.arange(_SAMPLES)
    axes[2].plot(time, truth, color="0.68", lw=2.6, label="the system")
    found = pipeline.lpv_.simulate(force, path, _STEP)
    axes[2].plot(time, found, color="#D55E00", lw=1.0, label="the model")
    axes[2].set(title="3. a model for κ that moves", xlabel="Time (s)", yticks=[])
    axes[2].set_ylim(1.4 * truth.min())  # room for the legend
    axes[2].legend(frameon=False, fontsize=9, ncols=2, loc="lower left")
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.title.set_fontsize(10.5)
    axes[0].spines["left"].set_visible(False)
    axes[2].spines["left"].set_visible(False)
    figure.savefig(TARGET, dpi=180)
    plt.close(figure)


def _simulated(data: Any, force: np.ndarray, path: np.ndarray) -> np.ndarray:
    """The spring while its stiffness moves, in small steps."""
    x, found = np.zeros(2), np.empty(len(path))
    for k, kappa in enumerate(path):
        frozen = data.structure.model({"b": 30.0, "c": 1.2, "k": 40 + 20 * kappa**2})
        step = frozen.to_discrete(_STEP)
        found[k] = x[0]
        x = step.A @ x + step.B @ force[k]
    return found
