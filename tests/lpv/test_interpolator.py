"""What interpolators have in common: scikit-learn's rules, range, covariances."""

import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.utils.estimator_checks import parametrize_with_checks

from lpvlearn import AutoLPV, PolynomialLPV, RationalLPV, SplineLPV
from lpvlearn.exceptions import ExtrapolationWarning

ALL = [PolynomialLPV, RationalLPV, SplineLPV, AutoLPV]
KAPPA = np.linspace(-1, 2, 7)[:, None]
THETA = np.hstack([2 + KAPPA, 1 - KAPPA**2])


@parametrize_with_checks(
    [
        RationalLPV(),
        RationalLPV(1, 1, terms="tensor"),
        SplineLPV(),
        SplineLPV("linear"),
        AutoLPV(),
    ]
)
def test_scikit_learns_rules(estimator, check):
    check(estimator)


@pytest.mark.parametrize("interpolator", ALL)
def test_names_survive_cloning_and_pickling(interpolator):
    X = pd.DataFrame({"angle": KAPPA[:, 0]})
    model = clone(interpolator(extrapolation="clip")).fit(X, THETA)
    assert model.get_params()["extrapolation"] == "clip"
    assert list(model.feature_names_in_) == ["angle"]
    copy = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copy.predict(X), model.predict(X))


@pytest.mark.parametrize("interpolator", ALL)
def test_one_parameter_gives_one_dimensional_predictions(interpolator):
    variances = np.full(7, 1e-4)
    flat = interpolator().fit(KAPPA, THETA[:, 0], covariance=variances)
    column = interpolator().fit(
        KAPPA, THETA[:, :1], covariance=variances[:, None, None]
    )
    assert flat.predict(KAPPA).shape == (7,)
    np.testing.assert_array_equal(flat.predict(KAPPA), column.predict(KAPPA)[:, 0])


@pytest.mark.parametrize("interpolator", ALL)
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_predictions_do_not_depend_on_units(interpolator, scale):
    rng = np.random.default_rng(0)
    P = np.array([np.diag(d**2) for d in rng.uniform(0.01, 0.03, (7, 2))])
    theta = THETA + 0.02 * rng.normal(size=THETA.shape)
    units = np.array([scale, 1.0])
    between = np.linspace(-1, 2, 21)[:, None]
    plain = interpolator().fit(KAPPA, theta, covariance=P).predict(between)
    changed = interpolator().fit(
        scale * KAPPA, units * theta, covariance=P * np.outer(units, units)
    )
    np.testing.assert_allclose(
        changed.predict(scale * between) / units, plain, rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize("interpolator", ALL)
def test_extrapolation_is_told_clipped_or_refused_as_asked(interpolator):
    outside = [[3.0], [0.0]]
    with pytest.warns(ExtrapolationWarning, match=r"\[-1, 2\].*1 of 2.*farthest 3\."):
        interpolator(extrapolation="warn").fit(KAPPA, THETA).predict(outside)
    clipped = interpolator(extrapolation="clip").fit(KAPPA, THETA)
    np.testing.assert_allclose(clipped.predict(outside), clipped.predict([[2], [0]]))
    with pytest.raises(ValueError, match="identified range"):
        interpolator(extrapolation="error").fit(KAPPA, THETA).predict(outside)
    assert np.isfinite(interpolator().fit(KAPPA, THETA).predict(outside)).all()


@pytest.mark.parametrize("interpolator", ALL)
@pytest.mark.parametrize("shape", [(7,), (7, 2), (6, 2, 2), (7, 3, 3)])
def test_covariances_of_another_shape_are_refused(interpolator, shape):
    with pytest.raises(ValueError, match=r"`covariance` must have shape \(7, 2, 2\)"):
        interpolator().fit(KAPPA, THETA, covariance=np.ones(shape))


@pytest.mark.parametrize("interpolator", ALL)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, "singular"])
def test_one_covariance_that_is_not_known_leaves_all_out(interpolator, bad):
    P = np.tile(1e-4 * np.eye(2), (7, 1, 1))
    P[3] = 1e-4 * np.ones((2, 2)) if bad == "singular" else np.diag([bad, bad])
    theta = THETA + 0.1 * np.random.default_rng(1).normal(size=THETA.shape)
    between = np.linspace(-1, 2, 21)[:, None]
    with_them = interpolator().fit(KAPPA, theta, covariance=P)
    without = interpolator().fit(KAPPA, theta)
    np.testing.assert_array_equal(with_them.predict(between), without.predict(between))


@pytest.mark.parametrize("interpolator", ALL)
def test_unknown_options_are_refused(interpolator):
    with pytest.raises(ValueError, match="`extrapolation` must be"):
        interpolator(extrapolation="no").fit(KAPPA, THETA)
