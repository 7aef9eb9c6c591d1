"""The error of a restructured model over frequency."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    StateSpace,
)
from lpvlearn.inspection import (
    ErrorDisplay,
)

from .conftest import ONE, random_model


def largest_singular_value(model, omega):
    G = model.frequency_response(omega)
    return np.linalg.svd(G, compute_uv=False)[:, 0]


def test_error_lines_are_largest_singular_values_of_the_difference():
    gray, black, start = (random_model(seed, n_inputs=2) for seed in (1, 2, 3))
    display = ErrorDisplay.from_models(gray, black, start=start, floor=0.1)
    omega = display.lines_["error"].get_xdata()
    for name, model in (("error", gray), ("start", start)):
        G = model.frequency_response(omega) - black.frequency_response(omega)
        expected = np.linalg.svd(G, compute_uv=False)[:, 0]
        assert_allclose(display.lines_[name].get_ydata(), expected, rtol=1e-9)
        norm = (model - black).hinf_norm()
        assert display.lines_[name].get_label() == f"{name}, H∞ norm {norm:.3g}"
    assert_array_equal(display.lines_["floor"].get_ydata(), 0.1)


def test_active_peaks_lie_on_the_curve_and_beyond_the_axis_at_its_ends():
    slow, fast = ONE, StateSpace([[-2.0]], [[2.0]], [[1.0]], [[0.1]])
    active = [0.0, 1.5, np.inf]
    display = ErrorDisplay.from_models(slow, fast, active_frequencies=active)
    expected = largest_singular_value(slow - fast, active)
    points = display.active_points_
    assert_allclose([point.get_ydata()[0] for point in points], expected)
    assert [point.get_marker() for point in points] == ["<", "o", ">"]
    omega = [point.get_xdata()[0] for point in points]
    assert_allclose(omega, [display.omega[0], 1.5, display.omega[-1]])
    assert 1.5 in display.omega


def test_error_of_a_restructurer_is_what_it_minimised():
    black = random_model(5, order=3, n_outputs=1, n_inputs=1)
    structure = GrayBoxStructure.observable_canonical(2, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two states cannot represent three
        fitted = GrayBoxRestructurer(structure, n_starts=4).fit_model(black)
    display = ErrorDisplay.from_estimator(fitted, black, start=fitted.params_)
    D = black.D - fitted.dropped_feedthrough_
    compared = StateSpace(black.A, black.B, black.C, D)
    expected = largest_singular_value(fitted.lti_ - compared, display.omega)
    assert_allclose(display.error, expected, rtol=1e-8)
    assert_allclose(display.start, display.error)
    assert_allclose(display.norms["error"], fitted.error_, rtol=1e-6)
    assert ErrorDisplay.from_estimator(fitted, black, start=None).start is None
    began = ErrorDisplay.from_estimator(fitted, black)
    start = fitted.structure_.model(fitted.start_params_)
    assert_allclose(began.start, largest_singular_value(start - compared, began.omega))
    assert began.norms["start"] >= began.norms["error"] * (1 - 1e-9)
    assert_allclose(display.active_values.max(initial=0.0), fitted.error_, rtol=1e-3)


def test_sampled_models_have_their_last_peak_at_the_nyquist_frequency():
    a, b = (random_model(k, 2, 1, 1, sampling_time=0.1) for k in (1, 2))
    display = ErrorDisplay.from_models(a, b, active_frequencies=[np.pi / 0.1])
    assert np.isfinite(display.active_values).all()
    assert_allclose(display.omega[-1], np.pi / 0.1)


def test_an_error_of_zero_draws_without_a_warning():
    ErrorDisplay.from_models(ONE, ONE).figure_.canvas.draw()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ErrorDisplay.from_models(ONE, 2), "`black_box` must be a StateSpace"),
        (
            lambda: ErrorDisplay.from_models(ONE, random_model(0)),
            "same inputs, outputs",
        ),
        (
            lambda: ErrorDisplay.from_estimator(GrayBoxRestructurer(), ONE),
            r"fitted GrayBoxRestructurer.*fit_model\(\) first",
        ),
        (
            lambda: ErrorDisplay.from_estimator(SimpleNamespace(lti_=ONE), ONE),
            "pipeline with a structure. Got SimpleNamespace without `structure_`",
        ),
        (
            lambda: ErrorDisplay.from_models(ONE, ONE, floor=-1),
            "`floor` must be a finite number of at least 0. Got -1",
        ),
        (
            lambda: ErrorDisplay([1, 2], [1.0]),
            r"`error` must have shape \(2,\).*Got \(1,\)",
        ),
        (
            lambda: ErrorDisplay([1, 2], [1, 1], active_frequencies=[1.0]),
            "`active_values` must hold a value for each of 1",
        ),
    ],
)
def test_error_display_errors_teach(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_error_display_refuses_another_black_box(pipeline):
    fitted = pipeline.restructurers_[0]
    with pytest.raises(ValueError, match="`model` must be the black box of the fit"):
        ErrorDisplay.from_estimator(fitted, random_model(0))
    with pytest.raises(ValueError, match="`model` must be a StateSpace. Got list"):
        ErrorDisplay.from_estimator(fitted, [1])
    with pytest.raises(ValueError, match="`start` must be 'auto', .* Got 'fit'"):
        ErrorDisplay.from_estimator(fitted, ONE, start="fit")


def test_a_pipeline_shows_the_error_at_the_point_nearest_to_kappa(pipeline):
    display = ErrorDisplay.from_estimator(pipeline, kappa=0.9)
    own = ErrorDisplay.from_estimator(
        pipeline.restructurers_[2], pipeline.local_models_[2]
    )
    assert_allclose(display.error, own.error)
    with pytest.raises(ValueError, match="`kappa` must tell at which"):
        ErrorDisplay.from_estimator(pipeline)
