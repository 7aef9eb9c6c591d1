"""Rational interpolation: exact functions, poles, limits where it is polynomial."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from lpvlearn import AutoLPV, PolynomialLPV, RationalLPV
from lpvlearn.datasets import FlexibleArm

KAPPA = np.linspace(-0.9, 0.9, 7)[:, None]


def grid(*axes):
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def rational(kappa):
    below = 1 + 0.4 * kappa + 0.3 * kappa**2
    return np.hstack([1 + kappa, 2 - kappa**2, 0 * kappa + 3]) / below


def test_rational_functions_are_recovered_exactly():
    model = RationalLPV().fit(KAPPA, rational(KAPPA))
    between = np.linspace(-1, 1, 31)[:, None]
    np.testing.assert_allclose(model.predict(between), rational(between), atol=1e-9)
    assert model.degrees_of_freedom_ == 21 - 9 - 2


def test_the_entries_of_an_inverse_have_one_denominator():
    """``M(kappa)^-1 K`` with M affine in two coordinates: degrees 1 over 2."""

    def entries(k):
        M = np.array([[2 + k, 0.3], [0.3, 1 - k / 2]])
        return np.linalg.solve(M, [[5.0, -1.0], [-1.0, 3.0]]).ravel()

    theta = np.array([entries(k) for k in KAPPA[:, 0]])
    model = RationalLPV(1, 2).fit(KAPPA, theta)
    np.testing.assert_allclose(model.predict([[0.33]])[0], entries(0.33), atol=1e-9)


def test_the_flexible_arm_is_rational_of_degrees_two_and_two():
    arm = FlexibleArm()
    kappa = np.cos(np.pi * np.arange(1, 8) / 8)[:, None]
    theta = np.array([arm.parameters(angle) for angle in np.arccos(kappa[:, 0])])
    model = RationalLPV(2, 2).fit(kappa, theta)
    np.testing.assert_allclose(
        model.predict([[0.2]])[0], arm.parameters(np.arccos(0.2)), rtol=1e-6
    )


def test_a_denominator_of_degree_zero_is_a_polynomial():
    rng = np.random.default_rng(0)
    theta = rng.normal(size=(7, 3))
    roots = rng.normal(size=(7, 3, 3))
    P = roots @ roots.swapaxes(1, 2)
    for covariance in (None, P):
        model = RationalLPV(2, 0).fit(KAPPA, theta, covariance=covariance)
        polynomial = PolynomialLPV(2).fit(KAPPA, theta, covariance=covariance)
        np.testing.assert_allclose(
            model.predict(KAPPA), polynomial.predict(KAPPA), atol=1e-9
        )
        assert model.denominator_.tolist() == [1.0]


def test_a_pole_near_the_range_is_found_where_nothing_else_is_plausible():
    """Of a rope from 0.6 to 12 m: its pendulum's stiffness is one over its length."""
    lengths = np.array([[0.6], [2.0], [4.0], [7.0], [12.0]])
    rng, std = np.random.default_rng(0), 1e-3
    truth = np.hstack([9.81 / lengths, 0.1 + 0.0 * lengths, 1.0 / lengths])
    covariance = np.tile(np.diag(std**2 * np.ones(3)), (5, 1, 1))
    theta = truth + std * rng.normal(size=truth.shape)
    for model in (RationalLPV(1, 1), AutoLPV()):
        model.fit(lengths, theta, covariance=covariance)
        np.testing.assert_allclose(
            model.predict([[1.0]])[0], [9.81, 0.1, 1.0], atol=5e-3
        )
    assert model.form_ == "rational 1/1"


def test_polynomials_need_no_denominator():
    theta = np.hstack([KAPPA**2, 1 + KAPPA])
    model = RationalLPV(2, 2).fit(KAPPA, theta)
    np.testing.assert_allclose(model.denominator_, [1, 0, 0], atol=1e-9)


def test_the_fit_is_at_a_minimum_of_the_true_weighted_error():
    rng = np.random.default_rng(1)
    roots = 0.01 * rng.normal(size=(7, 3, 3)) + 0.01 * np.eye(3)
    theta = rational(KAPPA) + (roots @ rng.normal(size=(7, 3, 1)))[:, :, 0]
    P = roots @ roots.swapaxes(1, 2)
    model = RationalLPV().fit(KAPPA, theta, covariance=P)
    assert model.weighted_
    whitening = np.linalg.inv(np.linalg.cholesky(P))
    phi = np.polynomial.chebyshev.chebvander(KAPPA[:, 0] / 0.9, 2)

    def errors(x):
        values = phi @ x[:9].reshape(3, 3) / (1 + phi[:, 1:] @ x[9:])[:, None]
        return (whitening @ (values - theta)[:, :, None]).ravel()

    found = np.concatenate([model.numerator_.ravel(), model.denominator_[1:]])
    np.testing.assert_allclose(errors(found) @ errors(found), model.chi2_, rtol=1e-9)
    best = least_squares(errors, found, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert 2 * best.cost > model.chi2_ * (1 - 1e-6)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("degrees", [(1, 1), (1, 2), (2, 2), (3, 3)])
def test_there_is_no_pole_within_the_range_and_its_margin(seed, degrees):
    """Noise, and 1 / kappa, whose pole is in the middle of the range."""
    rng = np.random.default_rng(seed)
    kappa = np.sort(rng.uniform(-1, 1, (8, 1)), axis=0)
    theta = np.hstack([rng.normal(size=(8, 1)), 1 / kappa])
    model = RationalLPV(*degrees).fit(kappa, theta)
    low, high = model.scheduling_range_[:, 0]
    margin = 0.1 * (high - low)
    fine = np.linspace(low - margin, high + margin, 10001)
    scaled = (2 * fine - low - high) / (high - low)
    below = np.polynomial.chebyshev.chebval(scaled, model.denominator_)
    assert below.min() >= 0.0199 * below.max()


def test_two_variables_of_a_tensor_rational():
    def truth(kappa):
        load, speed = kappa.T
        below = 1 + 0.5 * load + 0.2 * load**2 * speed
        return (
            np.column_stack([1 + load * speed**2, 3 + load**2 * speed]) / below[:, None]
        )

    points = grid(np.linspace(0, 1, 7), np.linspace(20, 30, 4) / 25)
    model = RationalLPV(2, 2, terms="tensor").fit(points, truth(points))
    assert len(model.powers_) == 9
    assert model.denominator_powers_[0].tolist() == [0, 0]
    between = grid(np.linspace(0, 1, 5), np.linspace(0.8, 1.2, 5))
    np.testing.assert_allclose(model.predict(between), truth(between), atol=1e-7)
    total = RationalLPV(2, 2).fit(points, truth(points))
    assert len(total.powers_) == 6


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"degree": -1}, "`degree` must be an integer, at least 0"),
        ({"denominator": 1.5}, "`denominator` must be an integer"),
        ({"terms": "all"}, "`terms` must be 'total' or 'tensor'"),
        ({"degree": 7}, "`degree` must be at most 6 for 7 operating points"),
    ],
)
def test_bad_options_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        RationalLPV(**options).fit(KAPPA, KAPPA)


@pytest.mark.parametrize("denominator", [1, 2, 3])
def test_points_of_one_place_are_one_place_to_the_denominator(denominator):
    kappa = np.repeat([[0.0], [1.0]], 3, axis=0)
    values = [1.0, 1.1, 0.9, 2.0, 2.1, 1.9]
    form = RationalLPV(1, denominator).fit(kappa, values)
    assert len(form.denominator_powers_) == 1
    assert np.allclose(form.predict([[0.0], [1.0]]), [1.0, 2.0])
    auto = AutoLPV().fit(kappa, values, covariance=np.full(6, 0.01))
    assert np.allclose(auto.predict([[0.5]]), 1.5)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("longest", [3.0, 7.0, 12.0])
def test_squares_of_lengths_over_a_wide_range_are_found(longest, known):
    """A crane's rope: the denominator is small where it is short."""
    length = np.geomspace(0.8, longest, 6)[:, None]
    between = np.sqrt(length[1:] * length[:-1])

    def truth(length):
        return np.hstack([9.81 / length, 0.3 / length**2, 1.0 / length])

    P = np.array([np.diag((1e-4 * row) ** 2) for row in truth(length)])
    model = RationalLPV(1, 2)
    model.fit(length, truth(length), covariance=P if known else None)
    np.testing.assert_allclose(model.predict(between), truth(between), rtol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_no_pole_is_near_between_points(seed):
    """Steps over points ever farther apart: a form that nearly has one there."""
    rng = np.random.default_rng(seed)
    kappa = np.geomspace(0.3, 8.0, 10)[:, None]
    steps = np.tanh((kappa - [6.8, 7.1, 6.2]) / [0.4, 0.4, 0.9])
    theta = steps + 1e-3 * rng.standard_normal(steps.shape)
    P = np.tile(1e-6 * np.eye(3), (10, 1, 1))
    for degree in (2, 3):
        model = RationalLPV(degree, 2).fit(kappa, theta, covariance=P)
        fine = np.linspace(0.3, 8.0, 2000)[:, None]
        below = model._terms(fine, model.denominator_powers_) @ model.denominator_
        at_end = below[[0, -1]].min() == below.min()
        assert below.min() >= (0.002 if at_end else 0.02) * below.max()


@pytest.mark.parametrize("ratio", [60.0, 1e3, 1e5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_pole_may_lie_at_zero_however_near_that_is(ratio, sign):
    """What is divided by a mass, of any range; but not where the sign changes."""
    mass = sign * np.geomspace(1.0, ratio, 6)[:, None]
    theta = np.hstack([20.0 / mass, 3.0 + 0.0 * mass])
    model = RationalLPV(1, 1).fit(mass, theta)
    between = sign * np.sqrt(mass[1:] * mass[:-1])
    np.testing.assert_allclose(model.predict(between)[:, 0], 20.0 / between[:, 0])
    across = mass - 2.0 * sign  # from below zero to above
    other = RationalLPV(1, 1).fit(across, 1.0 / (across + 1.001 * sign))
    low, high = np.sort(across[[0, -1], 0])
    wide = np.linspace(low - 0.02 * (high - low), high + 0.02 * (high - low), 4000)
    terms = other._terms(wide[:, None], other.denominator_powers_)
    assert (terms @ other.denominator_ > 0.0).all()
