"""All there is to see of a fitted pipeline, on one page."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np

from ..metrics.reports import LABEL, as_shown
from .bode import BodeDisplay
from .drawing import WIDTH, by_name
from .fitted import fitted_pipeline, units_for
from .parameters import ParameterDisplay
from .poles import PoleDisplay
from .residuals import ResidualDisplay
from .simulation import SimulationDisplay
from .uncertainty import UncertaintyDisplay

_MOST_PARAMETERS = 8  # that are drawn: two rows of four

# Inches: of a row of a display, and of each row of panels within it.
_ROW, _PANEL = 2.9, 1.7


def plot_overview(
    pipeline: Any,
    X: Any = None,
    y: Any = None,
    *,
    experiment: Hashable = None,
    initial_state: str = "rest",
    units: Mapping[str, str] | None = None,
) -> Any:
    """Draw parameters, poles, responses, errors and simulations on one page.

    Parameters
    ----------
    pipeline : fitted LocalLPVPipeline, or a fitted search over one
        With one or two scheduling variables.
    X, y : table of inputs and roles, table of outputs, default=None
        To simulate, and to test the errors on; best one that was not in the fit. None
        leaves both panels out.
    experiment : hashable, default=None
        Label of the experiment to simulate; None is the first in the table.
    initial_state : {"rest", "estimate"}, default="rest"
    units : dict from str to str, default=None
        Units of inputs, outputs, parameters and scheduling variables, by name; None:
        those that the pipeline knows.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        If the pipeline is not fitted, or a display refuses.

    Examples
    --------
    >>> from lpvlearn import LocalLPVPipeline, SubspaceLTI
    >>> from lpvlearn.datasets import load_varying_spring
    >>> from lpvlearn.inspection import plot_overview
    >>> data = load_varying_spring()
    >>> pipeline = LocalLPVPipeline(
    ...     SubspaceLTI(2, feedthrough=False),
    ...     scheduling="kappa", experiment="run", time="time").fit(data.X, data.y)
    >>> figure = plot_overview(pipeline, data.X, data.y, units={"position": "m"})
    >>> len(figure.subfigs)
    6
    """
    from matplotlib import pyplot as plt

    pipeline = fitted_pipeline(pipeline, "parameters_")
    units = by_name("units", units_for(pipeline, units))
    lpv, points = pipeline.lpv_, pipeline.operating_points_
    names = list(pipeline.parameters_)[:_MOST_PARAMETERS]
    maps = points.shape[1] == 2
    n_rows = -(-len(names) // (2 if maps else 4))
    middle = points[len(points) // 2]
    place = as_shown(tuple(middle), LABEL)
    more = len(pipeline.parameters_.columns) - len(names)
    heads = {
        "Parameters" + (f" (not drawn: {more} more)" if more else ""): max(
            _ROW, n_rows * _PANEL * (1.3 if maps else 1)
        ),
        "Poles": _ROW + 0.6,
        "Error of the model over the range": _ROW,
        f"Gain at scheduling {place}": max(_ROW, _PANEL * lpv.n_outputs),
    }
    if X is not None:
        heads |= {
            "Simulation": max(_ROW, _PANEL * lpv.n_outputs),
            "Correlations of the errors": max(_ROW, _PANEL * lpv.n_outputs),
        }
    figure = plt.figure(figsize=(WIDTH, sum(heads.values())), layout="constrained")
    parts: Any = figure.subfigures(len(heads), 1, height_ratios=list(heads.values()))
    for part, head in zip(parts, heads, strict=True):
        part.suptitle(head, fontsize=10, x=0.01, ha="left", fontweight="bold")
    axes = [part.subplots() for part in parts]
    ParameterDisplay.from_estimator(pipeline, names=names, units=units, ax=axes[0])
    if lpv.order:
        PoleDisplay.from_estimator(pipeline, units=units, ax=axes[1])
    UncertaintyDisplay.from_estimator(pipeline, units=units, ax=axes[2])
    uncertainty = lpv.covariance is not None
    BodeDisplay.from_estimator(
        pipeline,
        kappa=np.asarray(middle),
        uncertainty=uncertainty,
        units=units,
        ax=axes[3],
    )
    if X is not None:
        SimulationDisplay.from_estimator(
            pipeline,
            X,
            y,
            experiment=experiment,
            initial_state=initial_state,
            uncertainty=uncertainty and initial_state == "rest",
            units=units,
            ax=axes[4],
        )
        ResidualDisplay.from_estimator(pipeline, X, y, ax=axes[5])
    return figure
