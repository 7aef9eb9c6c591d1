"""Parameters over the scheduling variable."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from lpvlearn import (
    PolynomialLPV,
)
from lpvlearn.inspection import (
    ParameterDisplay,
)

from .conftest import KAPPA


def test_parameters_of_a_pipeline_are_points_and_their_interpolation_a_curve(pipeline):
    truth = pd.DataFrame({"k": 9.0 + 2 * KAPPA + KAPPA**2, "c": 0.8})
    display = ParameterDisplay.from_estimator(pipeline, others={"truth": truth})
    names = list(pipeline.parameters_.columns)
    assert [ax.get_title() for ax in display.axes_] == names
    assert list(display.lines_) == ["restructured", "truth"]
    for k, name in enumerate(names):
        points = display.lines_["restructured"][k]
        assert_allclose(points.get_xdata(), pipeline.operating_points_[:, 0])
        assert_allclose(points.get_ydata(), pipeline.parameters_[name])
        assert_allclose(display.lines_["truth"][k].get_ydata(), truth[name])
        curve = display.curves_["restructured"][k]
        fine = curve.get_xdata()
        assert fine[0] == KAPPA.min() and fine[-1] == KAPPA.max()
        assert_allclose(
            curve.get_ydata(), pipeline.lpv_.parameters(fine)[:, k], rtol=1e-9
        )


def test_other_forms_are_fitted_to_the_same_points(noisy):
    line = PolynomialLPV(1)
    display = ParameterDisplay.from_estimator(noisy, forms={"line": line})
    assert list(display.curves_) == ["restructured", "line"]
    kappa, P = noisy.operating_points_, noisy.parameters_covariance_
    fitted = PolynomialLPV(1).fit(kappa, noisy.parameters_, covariance=P)
    for k, curve in enumerate(display.curves_["line"]):
        expected = fitted.predict(curve.get_xdata()[:, None])[:, k]
        assert_allclose(curve.get_ydata(), expected, rtol=1e-9)
    assert not hasattr(line, "coef_")


def test_names_select_parameters(pipeline):
    display = ParameterDisplay.from_estimator(pipeline, names=["k"])
    assert display.names == ["k"] and len(display.axes_) == 1
    assert_allclose(
        display.lines_["restructured"][0].get_ydata(), pipeline.parameters_["k"]
    )


def test_sixteen_parameters_make_a_grid_of_four_by_four():
    rng = np.random.default_rng(0)
    theta = rng.standard_normal((5, 16))
    display = ParameterDisplay.from_parameters(
        np.linspace(0, 1, 5)[:, None], {"a": theta, "b": theta + 1}
    )
    assert len(display.axes_) == 16
    spec = display.axes_[0].get_subplotspec().get_gridspec()
    assert spec.get_geometry() == (4, 4)
    assert display.names[0] == "p1" and not display.curves_


def test_an_interpolator_is_fitted_to_each_set_and_left_alone():
    kappa = np.linspace(-1, 1, 5)
    sets = {"line": 2 * kappa[:, None], "bend": kappa[:, None] ** 2}
    polynomial = PolynomialLPV(degree=2)
    display = ParameterDisplay.from_parameters(
        kappa, sets, interpolator=polynomial, names=["gain"]
    )
    assert not hasattr(polynomial, "coef_")
    fine = display.curves_["bend"][0].get_xdata()
    assert_allclose(display.curves_["bend"][0].get_ydata(), fine**2, atol=1e-12)
    assert_allclose(display.curves_["line"][0].get_ydata(), 2 * fine, atol=1e-12)


def test_numbers_have_a_common_power_of_ten_and_are_no_formulas():
    values = np.array([[-2e4], [-1.6e4]])
    display = ParameterDisplay.from_parameters([[0.0], [1.0]], {"own": values})
    display.figure_.canvas.draw()
    axis = display.axes_.flat[0].yaxis
    assert "10^{4}" in axis.get_offset_text().get_text()
    labels = [label.get_text() for label in axis.get_ticklabels()]
    assert min(map(float, [one.replace("−", "-") for one in labels])) >= -3


def test_a_constant_parameter_is_drawn_flat():
    theta = 5 + 1e-12 * np.arange(4.0)[:, None]
    low, high = (
        ParameterDisplay.from_parameters(KAPPA, {"a": theta}).axes_[0].get_ylim()
    )
    assert high - low > 0.5


@pytest.mark.parametrize(
    ("kappa", "parameters", "names", "message"),
    [
        (
            np.ones((4, 3)),
            {"a": np.ones((4, 1))},
            None,
            "needs one or two scheduling variables.* Got 3",
        ),
        (KAPPA, {"a": np.ones((3, 1))}, None, r"`parameters\['a'\]` must .*\(4, 1\)"),
        (KAPPA, np.ones((4, 1)), None, "`parameters` must be a dict"),
        (KAPPA, {"a": np.ones((4, 2))}, ["p"], "`names` must hold 2 names"),
        (
            KAPPA,
            {"a": pd.DataFrame({"k": KAPPA})},
            ["m"],
            "`names` must be among the parameters k. Got 'm'",
        ),
        (
            KAPPA,
            {"a": pd.DataFrame({"k": KAPPA}), "b": pd.DataFrame({"m": KAPPA})},
            None,
            r"`parameters\['b'\]` must have the columns .* none named 'k'",
        ),
    ],
)
def test_parameter_errors_teach(kappa, parameters, names, message):
    with pytest.raises(ValueError, match=message):
        ParameterDisplay.from_parameters(kappa, parameters, names=names)


def test_bands_are_those_of_the_interpolation(noisy):
    display = ParameterDisplay.from_estimator(noisy, uncertainty=True)
    for k, name in enumerate(display.names):
        bars, band = display.axes_[k].collections
        low, high = np.array([segment[:, 1] for segment in bars.get_segments()]).T
        assert_allclose(high - low, 4 * noisy.parameters_std_[name])
        fine = display.curves_["restructured"][k].get_xdata()
        mean, std = noisy.lpv_.parameters(fine, return_std=True)
        edges = band.get_paths()[0].vertices[:, 1]
        assert_allclose(edges.max(), (mean + 2 * std)[:, k].max())
        assert_allclose(edges.min(), (mean - 2 * std)[:, k].min())


def test_bands_are_left_out_on_request_and_where_they_are_not_known(noisy):
    display = ParameterDisplay.from_estimator(noisy, uncertainty=False)
    assert not any(ax.collections for ax in display.axes_)
    known = ParameterDisplay.from_estimator(noisy)
    assert all(len(ax.collections) == 2 for ax in known.axes_)


def test_two_variables_make_maps_with_the_points_in_their_colours():
    rng = np.random.default_rng(0)
    kappa = rng.uniform(0, 1, (9, 2))
    theta = pd.DataFrame({"k": 1 + kappa @ [2, 3], "c": kappa[:, 0]})
    display = ParameterDisplay.from_parameters(
        kappa,
        {"local": theta, "other": theta + 1},
        interpolator=PolynomialLPV(degree=1),
        scheduling_label=["load (kg)", "charge"],
        units={"k": "N/m"},
    )
    assert [ax.get_title() for ax in display.axes_] == ["k (N/m)", "c"]
    first = display.axes_[0]
    assert (first.get_xlabel(), first.get_ylabel()) == ("load (kg)", "charge")
    for k, name in enumerate(theta):
        dots, rings = (display.lines_[which][k] for which in ("local", "other"))
        assert_allclose(dots.get_offsets(), kappa)
        assert_allclose(dots.get_array(), theta[name])
        assert_allclose(rings.get_array(), theta[name] + 1)
        (surface,) = display.curves_["local"][k : k + 1]
        low, high = kappa.min(axis=0), kappa.max(axis=0)
        if name == "k":  # linear, so the map's corners tell it
            corner = surface.get_array().reshape(60, 60)[0, 0]
            assert_allclose(corner, 1 + low @ [2, 3])
            top = surface.get_array().reshape(60, 60)[-1, -1]
            assert_allclose(top, 1 + high @ [2, 3])
        assert dots.norm.vmin == rings.norm.vmin == surface.norm.vmin


def test_bars_need_the_shape_of_the_parameters():
    theta = {"local": np.ones((4, 2))}
    with pytest.raises(ValueError, match=r"`std\['local'\]` must have shape \(4, 2\)"):
        ParameterDisplay(KAPPA, theta, std={"local": np.ones((3, 2))})
