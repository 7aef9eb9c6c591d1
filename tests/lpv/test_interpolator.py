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


@parametrize_with_checks([RationalLPV(), SplineLPV()])
def test_scikit_learns_rules(estimator, check):
    check(estimator)


@pytest.mark.slow
@parametrize_with_checks(
    [RationalLPV(1, 1, terms="tensor"), SplineLPV("linear"), AutoLPV()]
)
def test_scikit_learns_rules_with_options_and_a_search(estimator, check):
    tensor = getattr(estimator, "terms", "") == "tensor"
    if tensor and "sample_weight_equivalence" in str(check):
        pytest.skip("2^30 terms of its 30 variables")
    check(estimator)


@pytest.mark.parametrize(
    "form", [PolynomialLPV(2), RationalLPV(1, 1), SplineLPV(), AutoLPV()]
)
@pytest.mark.parametrize("known", [False, True])
def test_weights_count_beside_each_other(form, known):
    """As many repetitions; another unit of them changes nothing."""
    rng, times = np.random.default_rng(0), np.array([1, 3, 2, 1, 1, 2, 1])
    theta = THETA + 0.1 * rng.standard_normal(THETA.shape)
    P = np.tile(0.01 * np.eye(2), (7, 1, 1)) if known else None
    weighted = clone(form).fit(KAPPA, theta, times, P)
    scaled = clone(form).fit(KAPPA, theta, 1e-4 * times, P)
    some = [np.repeat(part, times, axis=0) for part in (KAPPA, theta)]
    repeated = clone(form).fit(*some, covariance=P if P is None else P[[0] * 11])
    places = np.linspace(-1, 2, 20)[:, None]
    for other in (scaled, repeated):
        values = other.predict(places)
        np.testing.assert_allclose(weighted.predict(places), values, rtol=1e-5)
    assert getattr(weighted, "weighted_", None) == getattr(scaled, "weighted_", None)


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
    P = np.tile(1e-6 * np.eye(2), (7, 1, 1))  # with which no form is plausible
    P[3] = 1e-6 * np.ones((2, 2)) if bad == "singular" else np.diag([bad, bad])
    theta = THETA + 0.1 * np.random.default_rng(1).normal(size=THETA.shape)
    between = np.linspace(-1, 2, 21)[:, None]
    with_them = interpolator().fit(KAPPA, theta, covariance=P)
    without = interpolator().fit(KAPPA, theta)
    np.testing.assert_array_equal(with_them.predict(between), without.predict(between))


@pytest.mark.parametrize("interpolator", ALL)
def test_unknown_options_are_refused(interpolator):
    with pytest.raises(ValueError, match="`extrapolation` must be"):
        interpolator(extrapolation="no").fit(KAPPA, THETA)


FORMS = [
    PolynomialLPV(2),
    PolynomialLPV(3, basis="legendre"),
    RationalLPV(2, 1),
    RationalLPV(1, 2),
    SplineLPV(),
    SplineLPV("cubic"),
    SplineLPV("linear"),
    AutoLPV(),
]
PLACES = np.array([[-1.2], [-1.0], [-0.3], [0.1], [0.77], [1.5], [2.0], [2.3]])


def wavy(kappa):
    """Parameters with turns, which the slopes of a curve depend on."""
    return np.hstack([np.sin(3 * kappa) / (2 + kappa), 1 / (3 + kappa), kappa**2])


@pytest.mark.parametrize("form", FORMS, ids=repr)
@pytest.mark.parametrize("n_variables", [1, 2])
def test_sensitivities_equal_differences(form, n_variables):
    rng = np.random.default_rng(0)
    kappa, places = KAPPA, PLACES
    if n_variables == 2:
        kappa = np.hstack([KAPPA.repeat(3, axis=0), np.tile([[0], [1], [2]], (7, 1))])
        places = np.hstack([PLACES, rng.uniform(0, 2, PLACES.shape)])
    model = clone(form).fit(kappa, wavy(kappa[:, :1]) + kappa.sum(1, keepdims=True))
    c = model.coefficients() + 0.01 * rng.normal(size=len(model.coefficients()))
    model = model.with_coefficients(c)
    np.testing.assert_array_equal(model.coefficients(), c)
    slopes = model.sensitivities(places)
    h = 1e-6
    differences = [
        (
            model.with_coefficients(c + step).predict(places)
            - model.with_coefficients(c - step).predict(places)
        )
        / (2 * h)
        for step in h * np.eye(len(c))
    ]
    np.testing.assert_allclose(slopes, np.moveaxis(differences, 0, -1), atol=1e-7)


@pytest.mark.parametrize("points", [1, 2, 3])
def test_few_points_have_sensitivities_too(points):
    for form in (SplineLPV(), SplineLPV("linear"), PolynomialLPV(0)):
        model = form.fit(KAPPA[:points], THETA[:points])
        c, places = model.coefficients(), PLACES[:4]
        np.testing.assert_allclose(  # homogeneous of degree one
            model.sensitivities(places) @ c, model.predict(places), atol=1e-12
        )


@pytest.mark.parametrize("form", FORMS, ids=repr)
def test_other_coefficients_leave_the_fitted_form_alone(form):
    model = clone(form).fit(KAPPA, THETA)
    before, c = model.predict(PLACES), model.coefficients()
    same = model.with_coefficients(c)
    np.testing.assert_array_equal(same.predict(PLACES), before)
    changed = pickle.loads(pickle.dumps(model.with_coefficients(1.1 * c)))
    assert (changed.predict(PLACES) != before).any()
    np.testing.assert_array_equal(model.predict(PLACES), before)
    with pytest.raises(ValueError, match="`coefficients` must be"):
        model.with_coefficients(c[:-1])


def test_the_published_coefficients_follow():
    model = PolynomialLPV(2).fit(KAPPA, THETA)
    doubled = model.with_coefficients(2 * model.coefficients())
    np.testing.assert_allclose(doubled.coef_, 2 * model.coef_)


def test_a_denominator_with_a_zero_in_the_range_is_refused():
    model = RationalLPV(1, 1).fit(KAPPA, THETA)
    c = model.coefficients()
    c[-1] = 1.2  # 1 + 1.2 t
    with pytest.raises(ValueError, match="keep the denominator positive"):
        model.with_coefficients(c)


@pytest.mark.slow
def test_information_is_the_inverse_covariance_of_the_coefficients():
    rng = np.random.default_rng(3)
    roots = 0.05 * rng.normal(size=(7, 2, 2)) + 0.1 * np.eye(2)
    P = roots @ roots.swapaxes(1, 2)
    model = PolynomialLPV(2).fit(KAPPA, THETA, covariance=P)
    predicted = np.linalg.inv(model.information(KAPPA, P))
    found = []
    for _ in range(1000):
        noise = (roots @ rng.normal(size=(7, 2, 1)))[:, :, 0]
        fitted = PolynomialLPV(2).fit(KAPPA, THETA + noise, covariance=P)
        found.append(fitted.coefficients())
    ratio = np.diag(np.cov(np.transpose(found))) / np.diag(predicted)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_information_is_inflated_where_the_form_is_not_true():
    P = np.tile(1e-6 * np.eye(2), (7, 1, 1))
    line = PolynomialLPV(1).fit(KAPPA, THETA, covariance=P)
    exact = PolynomialLPV(2).fit(KAPPA, THETA, covariance=P)
    S = line.sensitivities(KAPPA).reshape(14, -1)
    own = S.T @ S / 1e-6 * line.degrees_of_freedom_ / line.chi2_
    np.testing.assert_allclose(line.information(KAPPA, P), own, rtol=1e-6, atol=1e-9)
    S = exact.sensitivities(KAPPA).reshape(14, -1)
    np.testing.assert_allclose(
        exact.information(KAPPA, P), S.T @ S / 1e-6, rtol=1e-6, atol=1e-3
    )
    assert exact.information(KAPPA, np.nan * P) is None


@pytest.mark.parametrize("form", [PolynomialLPV(2), RationalLPV(1, 1), SplineLPV()])
def test_a_form_may_follow_some_of_the_variables(form):
    rng = np.random.default_rng(0)
    kappa = np.column_stack([np.linspace(1, 2, 6), rng.uniform(-1, 1, 6)])
    theta = 1.0 / kappa[:, 0]
    some = clone(form).set_params(variables=[0]).fit(kappa, theta)
    alone = clone(form).fit(kappa[:, :1], theta)
    between = 0.5 * (kappa[1:] + kappa[:-1])
    np.testing.assert_allclose(some.predict(between), alone.predict(between[:, :1]))
    np.testing.assert_array_equal(some.scheduling_range_, [kappa.min(0), kappa.max(0)])
    assert some.coefficients().shape == alone.coefficients().shape
    for wrong in ([2], [0.5], ["k"], 0, []):
        with pytest.raises(ValueError, match="`variables` must be places of schedul"):
            clone(form).set_params(variables=wrong).fit(kappa, theta)


def test_logarithms_are_taken_of_the_variables_that_are_followed():
    kappa = np.column_stack([np.geomspace(1, 100, 6), np.linspace(-1, 1, 6) ** 3])
    theta = np.log(kappa[:, 0])
    curve = SplineLPV("cubic", scale="log", variables=[0]).fit(kappa, theta)
    np.testing.assert_allclose(curve.predict([[10.0, -5.0]]), np.log(10.0))
