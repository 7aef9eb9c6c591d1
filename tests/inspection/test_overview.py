"""All pictures on one page."""

import numpy as np
import pytest

from lpvlearn import LocalLPVPipeline, PolynomialLPV, SubspaceLTI
from lpvlearn.inspection import plot_overview

from .conftest import spring


def titles(figure):
    return [part._suptitle.get_text() for part in figure.subfigs]


@pytest.mark.slow
def test_a_page_of_a_pipeline_with_and_without_a_table(noisy, tables):
    alone = plot_overview(noisy)
    assert titles(alone)[:2] == ["Parameters", "Poles"] and len(alone.subfigs) == 4
    figure = plot_overview(noisy, *tables, experiment="b", units={"angle": "rad"})
    assert len(figure.subfigs) == 6
    simulation = figure.subfigs[4].axes[0]
    assert simulation.get_ylabel() == "angle (rad)"
    assert "± 2 std" in simulation.get_legend_handles_labels()[1][1]
    figure.draw_without_rendering()


@pytest.mark.slow
def test_a_page_over_two_variables_says_what_it_leaves_out(tables):
    X, y = tables
    X = X.assign(other=(X["run"] > "b") * 1.0)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, horizon=8),
        "passthrough",
        PolynomialLPV(degree=0),
        scheduling=["kappa", "other"],
        experiment="run",
        time="time",
    ).fit(X, y)
    figure = plot_overview(pipeline, units={"other": "V"})
    assert titles(figure)[0] == "Parameters (not drawn: 1 more)"
    bars = [ax.get_ylabel() for ax in figure.subfigs[1].axes]
    assert "kappa" in bars and "other (V)" in bars


def test_a_page_needs_a_fitted_pipeline():
    with pytest.raises(ValueError, match="`pipeline` must be a fitted"):
        plot_overview(spring(np.float64(0.0)))
