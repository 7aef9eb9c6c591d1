"""What the model does not know, over the scheduling range."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
)
from lpvlearn.inspection import ParameterDisplay, UncertaintyDisplay

from .conftest import KAPPA, SPRING


def test_the_line_is_two_deviations_of_the_response_and_points_are_distances(noisy):
    omega = np.geomspace(0.3, 30, 40)
    display = UncertaintyDisplay.from_estimator(noisy, omega=omega)
    kappa, line = display.curve_.get_data()
    k = len(kappa) // 3
    std = noisy.lpv_.frequency_response_std([kappa[k]], omega)
    size = np.abs(noisy.lpv_.at(kappa[k]).frequency_response(omega)).max()
    assert_allclose(line[k], 100 * 2 * np.abs(std).max() / size)
    places, error = display.points_.get_data()
    assert_allclose(places, KAPPA)
    local = noisy.local_models_[1].frequency_response(omega)
    mine = noisy.lpv_.at(places[1]).frequency_response(omega)
    assert_allclose(error[1], 100 * np.abs(local - mine).max() / np.abs(mine).max())


def test_more_noise_is_known_to_be_more(noisy, pipeline):
    """Of data without noise, nothing is left open."""
    little, much = (
        UncertaintyDisplay.from_estimator(fitted).std.max()
        for fitted in (pipeline, noisy)
    )
    assert little < 1e-3 * much


def test_two_variables_make_a_map():
    sides = np.linspace(0, 1, 3), np.linspace(0, 2, 4)
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    std = 0.01 + 0.01 * grid[:, 0] + 0.02 * grid[:, 1]
    display = UncertaintyDisplay(
        [[0.0, 0.0], [1.0, 2.0]],
        [0.02, 0.03],
        grid=grid,
        std=std,
        scheduling_label=["a", "b"],
    ).plot()
    drawn = np.asarray(display.curve_.get_array()).reshape(4, 3)
    assert_allclose(drawn.T.ravel(), 200 * std)
    assert_allclose(display.points_.get_array(), [2.0, 3.0])
    assert (display.ax_.get_xlabel(), display.ax_.get_ylabel()) == ("a", "b")


@pytest.mark.slow
def test_maps_give_a_constant_variable_a_width_and_do_not_leave_its_value(tables):
    X, y = tables
    fitted = LocalLPVPipeline(
        SubspaceLTI(order=2, horizon=8),
        GrayBoxRestructurer(SPRING),
        PolynomialLPV(2, extrapolation="error"),
        inputs="u",
        scheduling=["kappa", "load"],
        experiment="run",
        time="time",
    ).fit(X.assign(load=7.0), y + np.random.default_rng(1).normal(size=y.shape))
    uncertain = UncertaintyDisplay.from_estimator(fitted)
    ends = uncertain.grid.min(axis=0), uncertain.grid.max(axis=0)
    assert_allclose(ends, [[KAPPA[0], 6.0], [KAPPA[-1], 8.0]])
    shown = ParameterDisplay.from_estimator(fitted)
    (maps,) = shown.curves_.values()
    for drawn in (uncertain.curve_, *maps):
        values = drawn.get_array()
        assert_allclose(values, np.broadcast_to(values[0], values.shape))
        assert np.ptp(values) > 0.0


def test_uncertainty_errors_teach(pipeline):
    with pytest.raises(ValueError, match="needs one or two scheduling .* Got 3"):
        UncertaintyDisplay(np.ones((2, 3)), [0.1, 0.1])
    with pytest.raises(ValueError, match=r"`error` must have shape \(2,\), a value"):
        UncertaintyDisplay([0.0, 1.0], [0.1])
    with pytest.raises(ValueError, match="`pipeline` must be a fitted"):
        UncertaintyDisplay.from_estimator(pipeline.local_models_[0])
