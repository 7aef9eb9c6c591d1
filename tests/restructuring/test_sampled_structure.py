"""A continuous-time structure behind a zero-order hold."""

import numpy as np
import pytest

from lpvlearn import GrayBoxStructure, StateSpace, SubspaceLTI
from lpvlearn.restructuring.error_system import ErrorSystem, Target
from lpvlearn.restructuring.minimise_covariance import (
    minimise_covariance,
    uncertain_response,
)
from lpvlearn.restructuring.sampled_structure import SampledStructure
from lpvlearn.subspace.statistics import deviated_models

STEP = 0.1
LAGS = GrayBoxStructure.from_template(
    [["-a", 1], [0, "-b"]], [["g"], ["h"]], [[1, 0]], [["d"]]
)
MASSES = GrayBoxStructure.mechanical(
    M=[["m1", 0], [0, "m2"]],
    D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
    K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
    F=[[1, 0], [0, 1]],
    outputs="acceleration",
)
POINTS = {
    "lags": (LAGS, np.array([0.8, 3.0, 0.2, 1.5, 2.0])),
    "masses": (MASSES, np.array([0.8, 0.4, 60.0, 30.0, 1.0, 0.5])),
}


@pytest.mark.parametrize("name", POINTS)
def test_models_are_those_of_the_zero_order_hold(name):
    structure, theta = POINTS[name]
    expected = structure.model(theta).to_discrete(STEP)
    S = SampledStructure(structure, STEP).system_matrix(theta)
    n = structure.order
    for block, M in (
        (S[:n, :n], expected.A),
        (S[:n, n:], expected.B),
        (S[n:, :n], expected.C),
        (S[n:, n:], expected.D),
    ):
        np.testing.assert_allclose(block, M, atol=1e-13)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("name", POINTS)
def test_jacobian_equals_central_differences_in_any_unit(name, unit):
    structure, theta = POINTS[name]

    class Rescaled:  # the same structure in other units of its parameters
        order, n_params = structure.order, structure.n_params
        lower, upper = structure.lower, structure.upper

        def system_matrix(self, theta):
            return structure.system_matrix(theta / unit)

        def jacobian(self, theta):
            return structure.jacobian(theta / unit) / unit

    sampled, theta = SampledStructure(Rescaled(), STEP), theta * unit
    numeric = np.array(
        [
            (sampled.system_matrix(theta + h) - sampled.system_matrix(theta - h))
            / (2 * h.sum())
            for h in np.diag(1e-5 * theta)
        ]
    )
    exact = sampled.jacobian(theta)
    np.testing.assert_allclose(exact, numeric, atol=1e-8 * np.abs(numeric).max())


def test_a_model_that_overflows_is_not_finite():
    sampled = SampledStructure(LAGS, STEP)
    S = sampled.system_matrix(np.array([-1e5, 3.0, 0.2, 1.5, 2.0]))
    assert not np.isfinite(S).all()


def estimate(structure, model, pairs, omega, start):
    target = Target(model.A, model.B, model.C, model.D, model.sampling_time)
    box = uncertain_response(model, pairs, omega)
    return minimise_covariance(ErrorSystem(structure, target), start, 0.0, [box])


def record(truth, seed=0, n_samples=1000, noise=0.05):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, 1))
    y = truth.simulate(u)
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    return u, y


def test_time_domains_give_one_estimate():
    """The structure has fewer parameters than the black box: both match by weight."""
    structure = LAGS.fix({"d": 0.0, "h": 1.5})
    theta = np.array([0.8, 3.0, 0.2])
    u, y = record(structure.model(theta).to_discrete(STEP))
    fitted = SubspaceLTI(2, horizon=8, sampling_time=STEP).fit(u, y)
    omega = np.geomspace(0.1, 0.95 * np.pi / STEP, 40)

    def found(structure, convert):
        pairs = deviated_models(fitted.lti_, [(u, y)], convert)
        return estimate(structure, convert(fitted.lti_), pairs, omega, theta)

    discrete = found(SampledStructure(structure, STEP), lambda model: model)
    continuous = found(structure, StateSpace.to_continuous)
    # equal to first order: apart by a small part of the standard deviation
    std = np.sqrt(np.diag(continuous.covariance))
    np.testing.assert_allclose(
        discrete.theta, continuous.theta, atol=0.1 * std.min(), rtol=0
    )
    np.testing.assert_allclose(
        np.diag(discrete.covariance), np.diag(continuous.covariance), rtol=0.05
    )
    assert np.isclose(discrete.cost, continuous.cost, rtol=0.1)
    assert discrete.degrees_of_freedom == continuous.degrees_of_freedom == 2


def test_a_pole_on_the_negative_axis_needs_no_logarithm():
    """A fast lag in noise has a discrete pole near zero, of either sign."""
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    structure = structure.with_bounds({"a": (None, 100.0)})
    truth = np.array([50.0, 50.0])  # five times the sampling rate: exp(-5) = 0.007
    negative = 0
    for seed in range(6):
        u, y = record(structure.model(truth).to_discrete(STEP), seed, 300, noise=0.3)
        fitted = SubspaceLTI(1, horizon=5, sampling_time=STEP).fit(u, y)
        negative += fitted.lti_.A.item() < 0
        pairs = deviated_models(fitted.lti_, [(u, y)], lambda model: model)
        omega = np.linspace(0.5, 30, 30)
        found = estimate(
            SampledStructure(structure, STEP), fitted.lti_, pairs, omega, truth
        )
        gain = found.theta[1] / found.theta[0]
        assert np.isclose(gain, 1.0, rtol=0.1)  # the pole itself may be open
        assert found.p_value > 1e-3
    assert negative > 0
