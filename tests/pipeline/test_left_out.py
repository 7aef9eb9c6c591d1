"""Operating points that the others do not foresee, and variables that move together."""

import warnings

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import (
    AutoLPV,
    GrayBoxStructure,
    LPVStateSpace,
    PolynomialLPV,
    SplineLPV,
)
from lpvlearn.lpv.left_out import values_left_out
from lpvlearn.pipeline.points.left_out import errors_left_out, tell_unforeseen

from ..conftest import spring_pipeline, spring_tables

KAPPAS = [0.0, 0.5, 1.0, 1.5]


@pytest.fixture(scope="module")
def tables():
    return spring_tables(noise=1e-2, n_samples=300, kappas=KAPPAS)


def said(pipeline, X, y):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        pipeline.fit(X, y)
    return " ".join(str(w.message) for w in found)


@pytest.mark.slow
def test_a_point_that_is_unlike_the_others_is_told(tables):
    """One sensor with the other sign, which no form of the parameters explains."""
    X, y = tables
    assert "foresee" not in said(spring_pipeline(), X, y)
    turned = y.copy()
    turned[(X["kappa"] == 1.0).to_numpy()] *= -1.0
    pipeline = spring_pipeline(interpolator=AutoLPV())
    words = said(pipeline, X, turned)
    assert pipeline.interpolator_.form_ == "pchip"
    assert "operating point 2 (scheduling 1) has the reverse sign" in words


@pytest.mark.slow
def test_a_wrong_value_of_few_points_is_told():
    X, y = spring_tables(noise=1e-2, n_samples=300, kappas=[0.0, 0.5, 1.0, 1.5, 2.0])
    assert said(spring_pipeline(), X, y) == ""
    X = X.assign(kappa=X["kappa"].replace(1.0, 1.75))
    assert "do not foresee point(s) 3 (scheduling 1.75" in said(spring_pipeline(), X, y)


@pytest.mark.broad
@pytest.mark.parametrize("together", [True, False])
def test_scheduling_variables_that_move_together_are_told(tables, together):
    X, y = tables
    load = {0.0: 3.0, 0.5: 2.0, 1.0: 1.0, 1.5: 0.0}
    if not together:
        load |= {0.0: 0.0, 0.5: 2.0}
    X = X.assign(load=X["kappa"].map(load))
    pipeline = spring_pipeline(interpolator=PolynomialLPV(1))
    words = said(pipeline.set_params(scheduling=["kappa", "load"]), X, y)
    assert ("'kappa', 'load' move together over the 4" in words) == together
    assert np.isfinite(pipeline.parameters_.to_numpy()).all()


def test_all_points_of_a_place_are_left_out_together():
    decay = GrayBoxStructure.from_template(A=[["-a"]], B=[[1]], C=[[1]])
    kappa, theta = np.array([[0.0], [1.0], [1.0], [2.0]]), np.array([[1.0, 5, 5, 1]]).T
    models = [decay.model(values) for values in theta]
    errors = errors_left_out(decay, models, SplineLPV(), kappa, theta)
    assert sorted(errors) == [1, 2]  # 1/(s + 1) where 1/(s + 5) is: 4 of its gain
    assert np.allclose([*errors.values()], 4.0, rtol=1e-2)


@pytest.mark.parametrize("kind, told", [("pchip", True), ("cubic", False)])
def test_a_gap_that_two_curves_cross_in_their_own_ways_is_told(kind, told):
    """Points close to one another foresee one another, and say nothing of the gap."""
    spring = GrayBoxStructure.from_template(
        A=[[0, 1], ["-k", -0.1]], B=[[0], [1]], C=[[1, 0]]
    )
    kappa = np.array([[8.0], [0.0], [3.0], [4.0], [5.0], [6.0], [7.0]])
    theta = np.maximum(4.0, 2.0 * kappa - 2.0)
    models = [spring.model(values) for values in theta]
    form = SplineLPV(kind).fit(kappa, theta)
    lpv = LPVStateSpace(spring, form, np.array([[0.0], [8.0]]))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        tell_unforeseen(lpv, models, form, kappa, theta, 100.0)
    words = " ".join(str(w.message) for w in found)
    between = "between points 1 and 2 (scheduling 0 and 3)"
    assert (between in words and "curves through all of them differ" in words) == told


def test_regressors_of_other_libraries_stay_what_they_are():
    kappa = np.linspace(0.0, 1.0, 5)[:, None]
    form = make_pipeline(StandardScaler(), LinearRegression()).fit(kappa, kappa**2)
    before = form.predict(kappa)
    assert len(list(values_left_out(form, kappa, kappa**2))) == 3
    np.testing.assert_array_equal(form.predict(kappa), before)
