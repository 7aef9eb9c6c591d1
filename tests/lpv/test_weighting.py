"""Weighted least squares over operating points against independent formulas."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from lpvlearn import PolynomialLPV
from lpvlearn.lpv.weighting import is_chance, weighted_points

KAPPA = np.linspace(0, 1, 6)
TERMS = KAPPA[:, None] ** np.arange(3)


def covariances(rng, n=6, q=3):
    roots = rng.normal(size=(n, q, q)) * rng.uniform(0.3, 3, (n, 1, 1))
    return roots @ roots.swapaxes(1, 2) + 0.01 * np.eye(q)


def test_the_coefficients_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(0)
    theta, P = rng.normal(size=(6, 3)), covariances(rng)
    F = np.kron(TERMS, np.eye(3))
    W = np.linalg.inv(block_diag(*P))
    expected = np.linalg.solve(F.T @ W @ F, F.T @ W @ theta.ravel()).reshape(3, 3)
    points = weighted_points(theta, np.ones(6), P)
    coefficients, rank = points.coefficients(TERMS)
    assert rank == 3
    np.testing.assert_allclose(coefficients, expected, atol=1e-9)
    error = (theta - TERMS @ coefficients).ravel()
    np.testing.assert_allclose(points.misfit(TERMS @ coefficients), error @ W @ error)


def test_equal_covariances_weigh_nothing():
    """One covariance for all points, whatever it is: Zellner's theorem."""
    rng = np.random.default_rng(1)
    theta, P = rng.normal(size=(6, 3)), np.tile(covariances(rng, 1), (6, 1, 1))
    weighted, _ = weighted_points(theta, np.ones(6), P).coefficients(TERMS)
    plain, _ = weighted_points(theta, np.ones(6), None).coefficients(TERMS)
    np.testing.assert_allclose(weighted, plain, atol=1e-10)


def test_weights_of_points_divide_their_covariances():
    rng = np.random.default_rng(2)
    theta, P = rng.normal(size=(6, 3)), covariances(rng)
    weight = rng.uniform(0.5, 2, 6)
    both, _ = weighted_points(theta, weight, P).coefficients(TERMS)
    divided = weighted_points(theta, np.ones(6), P / weight[:, None, None])
    np.testing.assert_allclose(both, divided.coefficients(TERMS)[0], atol=1e-9)


def test_what_no_point_determines_is_kept_as_it_is():
    """Of values that only together mean anything, none is taken for noise."""
    rng = np.random.default_rng(4)
    theta, known = rng.normal(size=(6, 3)), covariances(rng)
    moved = theta.copy()
    moved[0, 1] += 1e-3
    for n_open, matters in ((6, True), (1, False)):
        P = known.copy()
        P[:n_open, 1, 1] = np.inf
        misfit = weighted_points(theta, np.ones(6), P).misfit(moved)
        assert misfit > 1e6 if matters else misfit < 1e-6


def test_the_misfit_of_the_true_form_is_a_chi_square():
    rng = np.random.default_rng(3)
    P = covariances(rng)
    roots, truth = np.linalg.cholesky(P), TERMS @ rng.normal(size=(3, 3))
    misfits = []
    for _ in range(400):
        theta = truth + (roots @ rng.normal(size=(6, 3, 1)))[:, :, 0]
        points = weighted_points(theta, np.ones(6), P)
        misfits.append(points.misfit(TERMS @ points.coefficients(TERMS)[0]))
    # mean 9 and variance 18 of a chi-square with 9 degrees of freedom
    assert abs(np.mean(misfits) - 9) < 4 * np.sqrt(18 / 400)
    assert np.mean([is_chance(value, 9) for value in misfits]) == 1.0


def test_a_form_is_chance_by_its_misfit_per_degree_of_freedom():
    assert is_chance(1e9, 0)
    assert is_chance(10.0, 1)  # once in 600
    assert not is_chance(11.0, 1)
    assert is_chance(239.0, 60)
    assert not is_chance(241.0, 60)


@pytest.mark.slow
def test_precise_points_count_more_where_the_polynomial_is_true():
    rng = np.random.default_rng(4)
    deviation = np.where(np.arange(6) % 3 == 1, 0.2, 0.01)[:, None]
    truth = TERMS @ [[1.0], [2.0], [3.0]]
    errors = []
    for _ in range(100):
        theta = truth + deviation * rng.normal(size=(6, 1))
        fits = [
            PolynomialLPV().fit(KAPPA[:, None], theta, covariance=P)
            for P in (deviation[:, 0] ** 2, None)
        ]
        errors.append([fit.predict(KAPPA[:, None]) - truth for fit in fits])
    weighted, plain = np.sqrt(np.mean(np.square(errors), axis=(0, 2, 3)))
    bound = np.linalg.inv((TERMS / deviation).T @ (TERMS / deviation))
    expected = np.sqrt(np.mean(np.einsum("ij,jk,ik->i", TERMS, bound, TERMS)))
    assert weighted == pytest.approx(expected, rel=0.2)
    assert plain > 3 * weighted


def test_precise_points_do_not_bend_a_polynomial_that_is_too_low():
    theta = np.exp(3 * KAPPA)
    variance = np.where(np.arange(6) < 2, 1e-10, 1e-6)
    model = PolynomialLPV(1).fit(KAPPA[:, None], theta, covariance=variance)
    assert not model.weighted_
    assert model.chi2_ > 1e3
    np.testing.assert_array_equal(
        model.coef_, PolynomialLPV(1).fit(KAPPA[:, None], theta).coef_
    )


def test_points_without_noise_are_compared_to_rounding():
    """Parameters that are zero but for rounding, with covariances of zero."""
    rng = np.random.default_rng(5)
    theta = np.column_stack([40 + 3 * KAPPA, 1e-14 * rng.normal(size=6)])
    model = PolynomialLPV(1).fit(KAPPA[:, None], theta, covariance=np.zeros((6, 2, 2)))
    assert model.weighted_


def test_a_parameter_that_its_point_does_not_determine_has_no_weight():
    kappa = np.arange(5.0)[:, None]
    theta = np.column_stack([2.0 + kappa[:, 0], 5.0 - kappa[:, 0]])
    wrong = theta.copy()
    wrong[2, 0] = 1e3
    P = np.tile(1e-4 * np.eye(2), (5, 1, 1))
    P[2, 0, 0] = np.inf
    found = PolynomialLPV(1).fit(kappa, wrong, covariance=P)
    np.testing.assert_allclose(found.predict(kappa), theta, rtol=1e-6)
