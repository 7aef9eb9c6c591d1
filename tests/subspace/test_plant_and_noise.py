"""Plant and noise told apart, and the uncertainty of the plant."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter
from scipy.stats import binom

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.closed_loop.plant_and_noise import ByInputs
from lpvlearn.subspace.closed_loop.predictor import Innovation, prediction_errors
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.simulation_fit import Freedom

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


def two_lags_in_a_loop(seed, level=8.0, n=700, step=5.0):
    """Two tanks in a PI loop, of lags that are nearly equal, their level rounded."""
    rng = np.random.default_rng(seed)
    rate = 9.0 / np.sqrt(level) / np.array([300.0, 240.0])
    tanks = StateSpace(
        [[-rate[0], 0.0], [rate[1], -rate[1]]], [[2.0 / 300.0], [0.0]], [[0.0, 1.0]]
    )
    sampled = tanks.to_discrete(step)
    A, B = sampled.A, sampled.B
    reference = rng.choice([-1.0, 1.0], n // 60 + 1).repeat(60)
    shaken = 2.5 * rng.choice([-1.0, 1.0], n // 20 + 1).repeat(20)
    x, total, u, y = np.zeros(2), 0.0, np.empty((n, 1)), np.empty(n)
    for k in range(n):
        y[k] = np.round(10.0 * (x[1] + 0.02 * rng.standard_normal())) / 10.0
        total += step * (reference[k] - y[k])
        u[k] = shaken[k] + 3.0 * (reference[k] - y[k]) + 0.008 * total
        x = A @ x + B[:, 0] * u[k]
    return u, y, tanks.dc_gain()[0, 0]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_lags_that_nearly_coincide_stay_together():
    """The large rows of B of either are uncertain; without one of them nothing fits."""
    for seed in range(6):
        u, y, gain = two_lags_in_a_loop(seed)
        model = SubspaceLTI(2, method="pbsid", sampling_time=5.0).fit(u, y)
        assert_allclose(model.lti_.dc_gain(), gain, rtol=0.02)


def test_errors_of_prediction_are_linear_in_b_and_d(rng):
    A = np.diag([0.9, 0.5, -0.3])
    B, C = rng.standard_normal((3, 2)), rng.standard_normal((2, 3))
    D, K = rng.standard_normal((2, 2)), 0.1 * rng.standard_normal((3, 2))
    u, e = rng.standard_normal((300, 2)), 0.1 * rng.standard_normal((300, 2))
    B[1] = 0.0
    x, y = np.zeros(3), np.empty((300, 2))
    for k in range(300):
        y[k] = C @ x + D @ u[k] + e[k]
        x = A @ x + B @ u[k] + K @ e[k]
    free = Freedom(np.ones((2, 2), bool), True)
    records = [Record.of(u, y)]
    model = Innovation(A, B, C, D, K, 0.01 * np.eye(2))
    by_inputs = ByInputs.of(model, records, free)
    reached = np.array([True, False, True])
    loss, found = by_inputs.reaching(reached)
    assert not found.B[1].any()
    assert_allclose(found.B, B, atol=0.05)
    assert_allclose(found.D, D, atol=0.05)

    def loss_of(model):
        errors = np.vstack(prediction_errors(model, records, free)[1])
        return np.sum(errors**2) / 0.01

    assert_allclose(loss, loss_of(found), rtol=1e-6)
    for moved in ("B", "D"):
        change = 1e-3 * rng.standard_normal(getattr(found, moved).shape)
        change[1] = 0.0
        other = found._replace(**{moved: getattr(found, moved) + change})
        assert loss_of(other) > loss
    assert by_inputs.reaching(np.ones(3, bool))[0] < loss
