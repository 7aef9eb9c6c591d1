"""Plant and noise told apart, and the uncertainty of the plant."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter
from scipy.stats import binom

from lpvlearn import StateSpace, SubspaceLTI

from .conftest import LOOP_PLANT, closed_loop, miss, pbsid


@pytest.mark.broad
@pytest.mark.parametrize("order", [2, "auto"])
def test_modes_of_the_noise_are_told_from_the_plant(order):
    u, y = closed_loop(np.random.default_rng(1), 2000, pole=0.9)
    model = pbsid(order, feedthrough=False).fit(u, y)
    predictor = model.predictor_
    assert (model.order_, predictor.n_noise_states) == (2, 1)
    assert_allclose(predictor.noise.A, [[0.9]], atol=0.05)
    assert miss(model) < 0.03
    assert not predictor.B[2:].any()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_clean_output_keeps_its_part_of_a_given_order(seed):
    """No input reaches the noise: not to first order where that is worse."""
    rng = np.random.default_rng(seed)
    u, w, v = (rng.standard_normal(400) for _ in range(3))
    true = StateSpace([[0.8, 0.2], [-0.2, 0.8]], [[1], [0]], [[1, 0]], None, True)
    exact, noise = true.simulate(u)[:, 0], lfilter([1.0], [1.0, -0.9], 0.3 * w)
    y = np.column_stack([exact + noise, exact + 1e-3 * v])
    model = SubspaceLTI(2, method="pbsid").fit(u[:, None], y)
    lti = model.lti_
    row = StateSpace(lti.A, lti.B, lti.C[1:], lti.D[1:], True)
    assert (row - true).hinf_norm() / true.hinf_norm() < 5e-4
    error = (y - model.predict_ahead(u[:, None], y))[20:]
    said = np.sqrt(np.diagonal(model.predictor_.covariance))
    np.testing.assert_allclose(error.std(axis=0), said, rtol=0.1)


@pytest.mark.parametrize("seed", [0, 1])
def test_states_of_the_disturbance_are_not_taken_from_a_given_order(seed):
    """A turbine's drivetrain in wind, whose state the subspace hardly shows."""
    rng, step, n = np.random.default_rng(seed), 0.05, 6000
    rotor, generator, stiffness, loss, ratio = 4.4e7, 5.03e6, 8.68e8, 6.2e6, 97.0
    damping, torque = 2.78e6, 5.25e5
    A = np.array(
        [
            [-(loss + damping) / rotor, loss / rotor, -stiffness / rotor],
            [loss / generator, -loss / generator, stiffness / generator],
            [1.0, -1.0, 0.0],
        ]
    )
    B = [[0, torque / rotor], [-1e3 * ratio / generator, 0], [0, 0]]
    plant = StateSpace(A, B, [[0, 926.0, 0], [9.55, 0, 0]]).to_discrete(step)
    fast, slow = np.sign(rng.standard_normal((2, n)))
    u = fast[::3].repeat(3)[:n] + 1.5 * slow[::60].repeat(60)[:n]
    wind = lfilter([1.0], [1.0, -0.98], np.sqrt(1 - 0.98**2) * rng.standard_normal(n))
    y = plant.simulate(np.column_stack([u, 0.15 * wind]))
    y += [1.0, 0.01] * rng.standard_normal(y.shape)
    model = SubspaceLTI(3, method="pbsid", feedthrough=False, sampling_time=step)
    model.fit(u[:, None], y)
    poles, true = model.lti_.poles(), plant.poles()
    slow = true[np.argmin(np.abs(true - 1.0))]
    k = int(np.argmin(np.abs(poles - slow)))
    assert abs(poles[k].real - slow.real) < 2.5 * model.poles_std_[k].real


@pytest.mark.slow
@pytest.mark.parametrize("pole", [None, 0.9])
def test_standard_deviations_cover(pole):
    omega = np.array([0.2, 0.8, 2.0])
    A, B, C, _ = LOOP_PLANT
    z = np.exp(1j * omega)[:, None, None]
    truth = C @ np.linalg.solve(z * np.eye(2) - A, np.broadcast_to(B, (3, 2, 1)))
    top = np.linalg.eigvals(A)[0]
    inside = []
    for seed in range(20):
        u, y = closed_loop(np.random.default_rng(seed), 1500, pole=pole)
        model = pbsid(2, feedthrough=False).fit(u, y)
        k = np.argmax(model.lti_.poles().imag)
        values = [
            (model.lti_.poles()[k] - top, model.poles_std_[k]),
            *zip(
                (model.lti_.frequency_response(omega) - truth).ravel(),
                model.frequency_response_std(omega).ravel(),
                strict=True,
            ),
        ]
        for error, std in values:
            inside += [abs(error.real) < 1.96 * std.real]
            inside += [abs(error.imag) < 1.96 * std.imag]
    # Errors of one record depend on each other: as many as its parameters count.
    low, high = binom.interval(0.99, 20 * 4, 0.95)
    assert low <= np.mean(inside) * 80 <= high + 1
