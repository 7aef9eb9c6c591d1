"""Polynomial interpolation against exact polynomials and independent formulas."""

import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, LeaveOneOut
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils.estimator_checks import parametrize_with_checks

from lpvlearn import PolynomialLPV
from lpvlearn.exceptions import ExtrapolationWarning, RankWarning
from lpvlearn.lpv.polynomial import powers_up_to

BASES = ["power", "chebyshev", "legendre"]


@parametrize_with_checks([PolynomialLPV(), PolynomialLPV(1, basis="legendre")])
def test_scikit_learns_rules(estimator, check):
    check(estimator)


def grid(*axes):
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


# --------------------------------------------------------------------- the polynomial


@pytest.mark.parametrize("degree", range(7))
def test_polynomials_are_recovered_exactly(degree):
    rng = np.random.default_rng(degree)
    coef = rng.normal(size=(3, degree + 1))
    kappa = np.cos(np.pi * np.arange(1, 8) / 8)[:, None]
    theta = kappa ** np.arange(degree + 1) @ coef.T
    model = PolynomialLPV(degree).fit(kappa, theta)
    np.testing.assert_allclose(model.coef_, coef, atol=1e-11)
    between = np.linspace(-0.9, 0.9, 11)[:, None]
    expected = between ** np.arange(degree + 1) @ coef.T
    np.testing.assert_allclose(model.predict(between), expected, atol=1e-12)


def test_polynomials_of_two_variables_are_recovered_exactly():
    rng = np.random.default_rng(0)
    kappa = rng.uniform([0, 100], [1, 300], size=(40, 2))
    features = PolynomialFeatures(3)
    terms = features.fit_transform(kappa)
    np.testing.assert_array_equal(powers_up_to(3, [3, 3]), features.powers_)
    coef = rng.normal(size=(2, 10)) / 100.0 ** features.powers_[:, 1]
    model = PolynomialLPV(3).fit(kappa, terms @ coef.T)
    np.testing.assert_allclose(
        model.coef_ * 100.0 ** features.powers_[:, 1],
        coef * 100.0 ** features.powers_[:, 1],
        atol=1e-8,
    )
    np.testing.assert_allclose(model.predict(kappa), terms @ coef.T, atol=1e-10)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_fit_is_numpys_polynomial_fit(degree):
    rng = np.random.default_rng(1)
    kappa, theta = rng.uniform(-2, 5, 9), rng.normal(size=(9, 4))
    weight = rng.uniform(0.1, 2, 9)
    model = PolynomialLPV(degree).fit(kappa[:, None], theta, sample_weight=weight)
    expected = np.polyfit(kappa, theta, degree, w=np.sqrt(weight))[::-1].T
    np.testing.assert_allclose(model.coef_, expected, atol=1e-10)


def test_residuals_are_orthogonal_to_every_term():
    rng = np.random.default_rng(2)
    kappa, theta = rng.uniform(size=(30, 2)), rng.normal(size=(30, 3))
    weight = rng.uniform(size=30)
    residual = theta - PolynomialLPV(2).fit(kappa, theta, weight).predict(kappa)
    terms = PolynomialFeatures(2).fit_transform(kappa)
    np.testing.assert_allclose(terms.T @ (weight[:, None] * residual), 0, atol=1e-11)


@pytest.mark.parametrize("basis", BASES)
def test_predictions_do_not_depend_on_the_basis(basis):
    rng = np.random.default_rng(3)
    kappa, theta = rng.uniform(2, 7, (20, 2)), rng.normal(size=(20, 3))
    power = PolynomialLPV(3).fit(kappa, theta)
    model = PolynomialLPV(3, basis=basis).fit(kappa, theta)
    np.testing.assert_array_equal(model.predict(kappa), power.predict(kappa))


@pytest.mark.parametrize("basis", BASES)
def test_coefficients_evaluate_to_the_predictions_in_their_basis(basis):
    rng = np.random.default_rng(4)
    kappa, theta = rng.uniform(2, 7, (20, 2)), rng.normal(size=(20, 3))
    model = PolynomialLPV(3, basis=basis).fit(kappa, theta)
    low, high = model.scheduling_range_
    scaled = (2 * kappa - low - high) / (high - low)
    polynomial = {
        "power": np.polynomial.Polynomial,
        "chebyshev": np.polynomial.Chebyshev,
        "legendre": np.polynomial.Legendre,
    }[basis]
    x = kappa if basis == "power" else scaled
    terms = np.column_stack(
        [
            polynomial.basis(a)(x[:, 0]) * polynomial.basis(b)(x[:, 1])
            for a, b in model.powers_
        ]
    )
    np.testing.assert_allclose(terms @ model.coef_.T, model.predict(kappa), atol=1e-9)


@pytest.mark.parametrize("scale", [1e-9, 1e9])
@pytest.mark.parametrize("offset", [0.0, 50.0])
def test_predictions_do_not_depend_on_the_units_of_scheduling(scale, offset):
    rng = np.random.default_rng(5)
    kappa, theta = rng.uniform(size=(12, 1)), rng.normal(size=(12, 3))
    plain = PolynomialLPV(5).fit(kappa, theta)
    scaled = PolynomialLPV(5).fit(scale * (kappa + offset), theta)
    np.testing.assert_allclose(
        scaled.predict(scale * (kappa + offset)), plain.predict(kappa), rtol=1e-8
    )
    if offset == 0:
        np.testing.assert_allclose(
            scaled.coef_ * scale ** np.arange(6), plain.coef_, rtol=1e-7
        )


def test_a_high_degree_over_a_wide_range_is_well_conditioned():
    kappa = np.geomspace(1e-3, 1e5, 30)[:, None]
    truth = np.polynomial.Chebyshev(
        np.random.default_rng(6).normal(size=9), domain=[1e-3, 1e5]
    )
    model = PolynomialLPV(8).fit(kappa, truth(kappa))
    assert model.rank_ == 9
    between = np.linspace(1e-3, 1e5, 101)[:, None]
    np.testing.assert_allclose(model.predict(between), truth(between), atol=1e-8)


def test_a_weight_of_zero_leaves_a_point_out_and_of_two_doubles_it():
    rng = np.random.default_rng(7)
    kappa, theta = rng.uniform(size=(9, 1)), rng.normal(size=(9, 2))
    weight = np.array([0, 1, 1, 2, 1, 0, 1, 2, 1])
    weighted = PolynomialLPV().fit(kappa, theta, sample_weight=weight)
    repeated = PolynomialLPV().fit(
        np.repeat(kappa, weight, axis=0), np.repeat(theta, weight, axis=0)
    )
    np.testing.assert_allclose(weighted.coef_, repeated.coef_)
    np.testing.assert_array_equal(
        weighted.scheduling_range_, repeated.scheduling_range_
    )


def test_one_parameter_gives_one_dimensional_predictions():
    kappa = np.array([[0.0], [1.0], [2.0]])
    model = PolynomialLPV(1).fit(kappa, kappa.ravel())
    assert model.coef_.shape == (2,)
    assert model.predict(kappa).shape == (3,)
    model = PolynomialLPV(1).fit(kappa, kappa)
    assert model.coef_.shape == (1, 2)
    assert model.predict(kappa).shape == (3, 1)


def test_degree_zero_is_the_mean():
    theta = np.array([[1.0, 2.0], [3.0, 5.0]])
    model = PolynomialLPV(0).fit([[0.5], [0.5]], theta)
    np.testing.assert_allclose(model.predict([[0.5]]), [[2.0, 3.5]])


# ------------------------------------------------------------ undetermined polynomials


def test_two_levels_of_a_variable_carry_a_straight_line():
    kappa = grid([0.0, 1.0, 2.0], [0.0, 4.0])
    theta = (kappa[:, :1] ** 2 + kappa[:, :1] * kappa[:, 1:]) / 3
    model = PolynomialLPV(2).fit(kappa, theta)
    assert model.powers_.tolist() == [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1]]
    np.testing.assert_allclose(model.predict([[1.5, 2.0]]), [[(2.25 + 3.0) / 3]])


def test_points_on_a_curve_warn_and_are_met_at_minimum_norm():
    kappa = np.arange(6.0)[:, None] * [1.0, 2.0]
    theta = kappa[:, :1] ** 2
    with pytest.warns(RankWarning, match="6 operating points determine only 3 of the"):
        model = PolynomialLPV(2).fit(kappa, theta)
    assert model.rank_ == 3
    np.testing.assert_allclose(model.predict(kappa), theta, atol=1e-12)


# --------------------------------------------------------------------- extrapolation


def fitted(extrapolation):
    kappa = np.linspace(-1, 2, 5)[:, None]
    return PolynomialLPV(extrapolation=extrapolation).fit(kappa, kappa**2)


def test_extrapolation_warns_and_says_how_far():
    with pytest.warns(ExtrapolationWarning, match=r"\[-1, 2\].*1 of 2.*farthest 3\."):
        prediction = fitted("warn").predict([[3.0], [0.0]])
    np.testing.assert_allclose(prediction, [[9.0], [0.0]], atol=1e-12)


def test_extrapolation_is_ignored_clipped_or_refused_as_asked():
    np.testing.assert_allclose(fitted("ignore").predict([[3.0]]), [[9.0]])
    np.testing.assert_allclose(fitted("clip").predict([[3.0]]), [[4.0]])
    with pytest.raises(ValueError, match="identified range"):
        fitted("error").predict([[3.0]])


@pytest.mark.parametrize("extrapolation", ["warn", "error"])
def test_the_border_itself_is_within_the_range(extrapolation):
    fitted(extrapolation).predict([[-1.0 - 1e-9], [2.0 + 1e-9]])


# ------------------------------------------------------------------ citizen of sklearn


def test_a_search_finds_the_degree():
    rng = np.random.default_rng(8)
    kappa = rng.uniform(-1, 1, size=(25, 1))
    theta = np.hstack([kappa**3, 1 - kappa]) + 1e-3 * rng.normal(size=(25, 2))
    search = GridSearchCV(
        PolynomialLPV(),
        {"degree": [1, 2, 3]},
        cv=LeaveOneOut(),
        scoring="neg_mean_squared_error",
    ).fit(kappa, theta)
    assert search.best_params_ == {"degree": 3}


def test_names_survive_cloning_and_pickling():
    X = pd.DataFrame({"angle": [0.0, 1.0, 2.0]})
    model = clone(PolynomialLPV(degree=1, basis="legendre")).fit(X, [0.0, 1.0, 2.0])
    assert list(model.feature_names_in_) == ["angle"]
    copy = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copy.predict(X), model.predict(X))


# ------------------------------------------------------------------------------ errors

KAPPA = np.arange(4.0)[:, None]


@pytest.mark.parametrize(
    ("params", "args", "words"),
    [
        ({"degree": -1}, (KAPPA, KAPPA), ["`degree`", "at least 0", "-1"]),
        ({"degree": 1.5}, (KAPPA, KAPPA), ["`degree`", "integer", "1.5"]),
        ({"degree": True}, (KAPPA, KAPPA), ["`degree`", "integer", "True"]),
        ({"basis": "hermite"}, (KAPPA, KAPPA), ["`basis`", "'power'", "'hermite'"]),
        (
            {"extrapolation": "no"},
            (KAPPA, KAPPA),
            ["`extrapolation`", "'clip'", "'no'"],
        ),
        (
            {"degree": 2},
            (KAPPA[:2], KAPPA[:2]),
            ["`degree` must be at most 1 for 2 operating points. Got 2."],
        ),
        ({}, (KAPPA[:1], KAPPA[:1]), ["at most 0 for 1 operating point"]),
        ({}, (KAPPA.ravel(), KAPPA), ["Expected 2D array", "reshape(-1, 1)"]),
        ({}, (KAPPA, KAPPA[:3]), ["inconsistent", "[4, 3]"]),
        ({}, (KAPPA, [0, 1, np.nan, 3]), ["y contains NaN"]),
        ({}, (KAPPA, KAPPA, [1, 1, 1, -1]), ["`sample_weight`", "not negative", "-1]"]),
        ({}, (KAPPA, KAPPA, [0, 0, 0, 0]), ["`sample_weight`", "not all zero"]),
        (
            {},
            (KAPPA, KAPPA, [[1], [1], [1], [1]]),
            ["`sample_weight`", "must hold 4 weights", "[[1],"],
        ),
        ({}, (KAPPA, KAPPA, [1, 1]), ["must hold 4 weights", "[1, 1]"]),
    ],
)
def test_bad_calls_raise_and_name_the_cause(params, args, words):
    with pytest.raises(ValueError) as raised:
        PolynomialLPV(**params).fit(*args)
    for word in words:
        assert word in str(raised.value)
