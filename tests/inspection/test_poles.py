"""Poles of the frozen models."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    LPVStateSpace,
    OutputErrorLPV,
    PolynomialLPV,
    from_trajectories,
)
from lpvlearn.inspection import BodeDisplay, PoleDisplay

from .conftest import SPRING, spring


def lpv_of(n_scheduling):
    corners = np.array([[0.0] * n_scheduling, [1.0] * n_scheduling])
    points = np.vstack([corners, np.eye(n_scheduling)])
    theta = np.column_stack([np.full(len(points), 0.5), 4 + points.sum(1)])
    return LPVStateSpace(SPRING, PolynomialLPV(degree=1).fit(points, theta), corners)


def test_pole_points_are_the_frozen_poles_coloured_by_scheduling():
    lpv = lpv_of(1)
    kappa = np.linspace(0, 1, 7)
    display = PoleDisplay.from_model(lpv, kappa=kappa, damping=True)
    poles = np.array([lpv.at(k).poles() for k in kappa]).ravel()
    drawn = display.points_.get_offsets() @ [1, 1j]
    assert_allclose(np.sort_complex(drawn), np.sort_complex(poles))
    assert_array_equal(display.points_.get_array(), np.repeat(kappa, 2))
    assert display.local_points_ is None
    left, right = display.ax_.get_xlim()
    assert right > 0  # the border of stability is seen
    assert left < 1.03 * poles.real.min()  # and no pole on the frame


def test_a_model_of_moving_data_is_drawn_without_local_ones():
    """The refined model of a table, at any value of its range."""
    lpv = lpv_of(1)
    kappa = np.linspace(0, 1, 120)
    u = np.sign(np.random.default_rng(0).standard_normal(120))
    X, y = from_trajectories(
        [(u, kappa, lpv.simulate(u, kappa, 0.2))], sampling_time=0.2
    )
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    fitted = OutputErrorLPV(lpv, rate=False, **roles).fit(X, y)
    display = PoleDisplay.from_estimator(fitted)
    assert display.local_points_ is None
    bode = BodeDisplay.from_estimator(fitted, kappa=0.5)
    assert list(bode.responses) == ["interpolated"]
    with pytest.raises(ValueError, match="`kappa` must tell.*its range is"):
        BodeDisplay.from_estimator(fitted)


def test_damping_lines_go_through_poles_of_that_damping():
    display = PoleDisplay([0.0], [[-3 + 4j, -3 - 4j]]).plot(damping=True)
    lines = [line for line in display.ax_.lines if line.get_linestyle() == ":"]
    ratios = [
        -line.get_xdata()[0] / np.hypot(line.get_xdata()[0], line.get_ydata()[0])
        for line in lines
    ]
    labels = [text.get_text() for text in display.ax_.texts]
    assert_allclose(ratios, [float(label.split()[-1]) for label in labels])


def test_poles_of_a_pipeline_show_the_local_models_as_rings(pipeline):
    display = PoleDisplay.from_estimator(pipeline)
    drawn = display.local_points_.get_offsets() @ [1, 1j]
    local = np.concatenate([model.poles() for model in pipeline.local_models_])
    assert_allclose(drawn, local)


def test_several_variables_have_a_panel_and_a_colour_bar_each():
    lpv = lpv_of(3)
    display = PoleDisplay.from_model(lpv)
    assert display.kappa.shape == (7**3, 3)
    assert_array_equal(display.kappa.min(axis=0), [0, 0, 0])
    assert_array_equal(display.kappa.max(axis=0), [1, 1, 1])
    assert len(display.axes_) == len(display.colorbars_) == 3
    labels = [bar.ax.get_ylabel() for bar in display.colorbars_]
    assert labels == ["κ1", "κ2", "κ3"]
    for j, ax in enumerate(display.axes_):
        (points,) = ax.collections
        assert_array_equal(points.get_array(), np.repeat(display.kappa[:, j], 2))
        drawn = points.get_offsets() @ [1, 1j]
        assert_allclose(drawn, lpv.frozen_poles(display.kappa).ravel())


def test_the_label_of_a_colour_bar_is_within_the_picture():
    long = "temperature of the bearing at the far end (degrees Celsius)"
    display = PoleDisplay.from_model(lpv_of(1), scheduling_label=long)
    figure = display.figure_
    figure.draw_without_rendering()
    label = display.colorbars_[0].ax.yaxis.label.get_window_extent()
    assert figure.bbox.x0 <= label.x0 and label.x1 <= figure.bbox.x1


def test_real_poles_are_not_drawn_by_their_rounding():
    display = PoleDisplay([0.0, 1.0], [[-1 + 1e-17j], [-2 - 1e-17j]]).plot()
    assert display.ax_.get_ylim()[1] > 0.1


def test_pole_errors_teach():
    with pytest.raises(ValueError, match="`model` must be an LPVStateSpace"):
        PoleDisplay.from_model(spring(0.0))
    with pytest.raises(ValueError, match=r"`poles` must have shape \(1, order\)"):
        PoleDisplay([0.0], [-1.0, -2.0])
