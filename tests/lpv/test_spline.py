"""Interpolation through the points: what each kind keeps."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from lpvlearn import SplineLPV

KAPPA = np.array([[2.0], [0.0], [1.0], [5.0]])
THETA = np.column_stack([KAPPA[:, 0] ** 2, np.exp(-KAPPA[:, 0]), [3, 1, 1, 3]])


@pytest.mark.parametrize("kind", ["pchip", "cubic", "linear"])
def test_every_point_is_met_and_repeated_ones_in_their_mean(kind):
    model = SplineLPV(kind).fit(KAPPA, THETA)
    np.testing.assert_allclose(model.predict(KAPPA), THETA, atol=1e-12)
    kappa, theta = np.vstack([KAPPA, KAPPA]), np.vstack([THETA - 0.5, THETA + 0.5])
    repeated = SplineLPV(kind).fit(kappa, theta)
    assert repeated.n_points_ == 4
    np.testing.assert_allclose(repeated.predict(KAPPA), THETA, atol=1e-12)


def test_the_curves_are_those_of_scipy():
    x, order = np.linspace(0, 5, 21), np.argsort(KAPPA[:, 0])
    for kind, curve in (("pchip", PchipInterpolator), ("cubic", CubicSpline)):
        expected = curve(KAPPA[order, 0], THETA[order])(x)
        found = SplineLPV(kind).fit(KAPPA, THETA).predict(x[:, None])
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_shape_is_kept():
    kappa = np.arange(6.0)[:, None]
    steps = np.array([0.0, 0, 0, 1, 1, 1])
    fine = np.linspace(0, 5, 501)[:, None]
    kept = SplineLPV().fit(kappa, steps).predict(fine)
    assert (np.diff(kept) >= 0).all()
    assert kept.min() == 0.0
    assert kept.max() == 1.0
    assert SplineLPV("cubic").fit(kappa, steps).predict(fine).min() < -0.05


def test_beyond_the_range_it_goes_straight_on():
    model = SplineLPV("cubic").fit(KAPPA, THETA)
    line = model.predict([[5.0], [6.0], [7.0], [100.0]])
    np.testing.assert_allclose(line[2] - line[1], line[1] - line[0])
    np.testing.assert_allclose(line[3] - line[0], 95 * (line[1] - line[0]))
    inside = model.predict([[5.0 - 1e-6], [5.0]])
    np.testing.assert_allclose(
        (inside[1] - inside[0]) / 1e-6, line[1] - line[0], rtol=1e-4
    )


@pytest.mark.parametrize("kind", ["pchip", "cubic", "linear"])
def test_planes_over_scattered_points_are_recovered_between_them(kind):
    rng = np.random.default_rng(0)
    kappa = rng.uniform([0, 100], [1, 300], (40, 2))
    theta = kappa @ [[1.0, 2.0], [0.03, -0.01]] + [1.0, 5.0]
    model = SplineLPV(kind).fit(kappa, theta)
    np.testing.assert_allclose(model.predict(kappa), theta, atol=1e-9)
    inside = [[0.5, 200.0], [0.4, 180.0]]
    expected = inside @ np.array([[1.0, 2.0], [0.03, -0.01]]) + [1.0, 5.0]
    exact = kind != "linear"
    np.testing.assert_allclose(
        model.predict(inside), expected, atol=1e-8 if exact else 0.5
    )


def test_points_on_one_line_and_single_points_serve():
    kappa = np.arange(5.0)[:, None] * [1.0, 2.0]
    model = SplineLPV().fit(kappa, kappa[:, 0])
    np.testing.assert_allclose(model.predict([[1.5, 3.0]]), 1.5)
    single = SplineLPV().fit([[3.0]], [[1.0, 2.0]])
    np.testing.assert_allclose(single.predict([[3.0], [4.0]]), [[1.0, 2.0]] * 2)
    two = SplineLPV().fit([[0.0], [1.0]], [0.0, 2.0])
    np.testing.assert_allclose(two.predict([[0.25]]), 0.5)


def test_kinds_that_are_not_known_are_refused():
    with pytest.raises(ValueError, match="`kind` must be 'pchip', 'cubic' or 'linear'"):
        SplineLPV("quintic").fit(KAPPA, THETA)


# -- over logarithms -------------------------------------------------------------------

WIDE = np.array([[0.5], [0.8], [1.2], [2.0], [3.0]])
BETWEEN = np.array([[0.65], [1.6], [2.5]])


@pytest.mark.parametrize("kind", ["pchip", "cubic", "linear"])
def test_over_logarithms_what_is_linear_in_them_is_met(kind):
    model = SplineLPV(kind, scale="log").fit(WIDE, 3.0 - 2.0 * np.log(WIDE))
    expected = 3.0 - 2.0 * np.log(BETWEEN)
    np.testing.assert_allclose(model.predict(BETWEEN), expected, rtol=1e-12)


def test_over_logarithms_it_goes_straight_on_in_the_variable_too():
    """Along the tangents at the ends, to zero and below."""
    model = SplineLPV("cubic", scale="log").fit(WIDE, np.log(WIDE[:, 0]))
    beyond = np.array([-2.0, 0.0, 0.25, 0.5, 3.0, 6.0])
    line = np.r_[np.log(0.5) + 2.0 * (beyond[:4] - 0.5), np.log(3) + beyond[4:] / 3 - 1]
    np.testing.assert_allclose(model.predict(beyond[:, None]), line, rtol=1e-12)


def test_logarithms_need_values_above_zero():
    with pytest.raises(ValueError, match="`scale` must be 'linear'.*above zero. Got"):
        SplineLPV(scale="log").fit(KAPPA, THETA)
    with pytest.raises(ValueError, match="`scale` must be 'linear' or 'log'"):
        SplineLPV(scale="lin").fit(WIDE, WIDE)


def test_one_value_of_a_variable_has_a_logarithm():
    kappa = np.column_stack([WIDE[:, 0], np.full(5, 0.01)])
    model = SplineLPV(scale="log").fit(kappa, WIDE[:, 0])
    np.testing.assert_allclose(model.predict(kappa), WIDE[:, 0])


def test_other_coefficients_draw_the_curve_once(monkeypatch):
    form = SplineLPV().fit([[0.0], [1.0], [2.0]], [1.0, 3.0, 2.0])
    drawn, through = [], SplineLPV._through
    monkeypatch.setattr(
        SplineLPV, "_through", lambda self, t: drawn.append(t) or through(self, t)
    )
    moved = form.with_coefficients(form.coefficients() + 1.0)
    assert len(drawn) == 1
    assert np.allclose(moved.predict([[0.5]]), form.predict([[0.5]]) + 1.0)


@pytest.mark.parametrize("kind", ["pchip", "cubic", "linear"])
def test_a_variable_of_one_value_changes_nothing(kind):
    places = np.linspace(-1.0, 6.0, 30)[:, None]
    alone = SplineLPV(kind).fit(KAPPA, THETA)
    beside = SplineLPV(kind).fit(np.hstack([KAPPA, 7.0 + 0.0 * KAPPA]), THETA)
    both = np.hstack([places, 7.0 + 0.0 * places])
    np.testing.assert_array_equal(beside.predict(both), alone.predict(places))
    slopes = alone.sensitivities(places)
    np.testing.assert_array_equal(beside.sensitivities(both), slopes)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_slopes_follow_the_values_over_any_variable(scale):
    kappa = np.column_stack([np.linspace(-1, 1, 5) ** 3, np.geomspace(1, 9, 5)])
    theta = np.array([1.0, 3.0, 2.0, 4.0, 4.5])
    curve = SplineLPV(scale=scale, variables=[1]).fit(kappa, theta)
    alone = SplineLPV(scale=scale).fit(kappa[:, 1:], theta)
    between = 0.5 * (kappa[1:] + kappa[:-1])
    np.testing.assert_allclose(
        curve.sensitivities(between), alone.sensitivities(between[:, 1:])
    )
