"""Innovations: an innovation form is its own Kalman filter."""

import numpy as np

from lpvlearn.systems.innovations import covariance_root, kalman_filter


def test_the_filter_of_an_innovation_form_has_its_gain_and_covariance():
    A = np.array([[0.9, 0.2], [0.0, -0.5]])
    C = np.array([[1.0, 2.0], [-1.0, 0.5]])
    K = np.array([[0.3, 0.0], [0.1, 0.2]]) @ np.linalg.inv(C)  # A - K C is stable
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = kalman_filter(A, C, K @ covariance @ K.T, K @ covariance, covariance)
    np.testing.assert_allclose(found.gain, K, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, atol=1e-9)


def test_a_filter_of_sensor_noise_predicts_with_the_least_variance():
    """The scalar Riccati equation, solved by hand."""
    a, q, r = 0.8, 1.0, 2.0
    b = r * (1.0 - a**2) - q
    p = (-b + np.sqrt(b**2 + 4.0 * q * r)) / 2.0
    one = np.ones((1, 1))
    found = kalman_filter(a * one, one, q * one, 0.0 * one, r * one)
    np.testing.assert_allclose(found.covariance, p + r)
    np.testing.assert_allclose(found.gain, a * p / (p + r))


def test_the_root_of_a_covariance_is_one_whatever_the_units():
    factor = np.random.default_rng(0).standard_normal((3, 2))
    units = np.array([1e-90, 1.0, 1e90])
    covariance = factor @ factor.T * units[:, None] * units
    root = covariance_root(covariance, 1e-12)
    np.testing.assert_allclose(root @ root.T / covariance, 1.0, rtol=1e-12)
    assert root.any(axis=0).sum() == 2
