"""The unbalanced disc: its equation, its linear models, and the experiments."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

from lpvlearn.datasets import UnbalancedDisc, make_unbalanced_disc, prbs

SLIDING = UnbalancedDisc(Fc=0.0)
SMALL = {"duration": 0.5, "large_duration": 0.3, "random_state": 0}


def energy(disc, theta, rate):
    return 0.5 * rate**2 - disc.omega0**2 * np.cos(theta)


def test_without_friction_energy_stays():
    disc = UnbalancedDisc(gamma=0.0, Fc=0.0)
    theta, rate = disc.simulate(np.zeros(400), 1.2, 0.01, integration_step=5e-4)
    assert theta.min() < -1.19  # it swings to the other side
    found = energy(disc, theta, rate)
    assert_allclose(found, found[0], rtol=1e-8)


@pytest.mark.parametrize("friction", [{"Fc": 0.0}, {"gamma": 0.0, "Fc": 0.5}])
def test_friction_only_takes_energy(friction):
    disc = UnbalancedDisc(**friction)
    found = energy(disc, *disc.simulate(np.zeros(200), [0.5, 1.2], 0.01))
    assert (np.diff(found) <= 1e-9).all() and (found[:, -1] < found[:, 0] - 1.0).all()


def test_dry_friction_holds_the_disc():
    disc, stuck = UnbalancedDisc(), np.full(50, 0.9 * 6.062730 / 28.136158)
    theta, _ = disc.simulate(stuck, 0.0, 0.01)
    assert np.abs(theta).max() < 1e-3  # it creeps, as tanh is no step
    theta, _ = disc.simulate(3 * stuck, 0.0, 0.01)
    assert theta[-1] > 0.05


def test_the_holding_voltage_holds():
    angles = np.linspace(-1.4, 1.4, 5)
    voltage = np.repeat(SLIDING.holding_voltage(angles)[:, None], 100, axis=1)
    theta, rate = SLIDING.simulate(voltage, angles, 0.01)
    assert_allclose(theta, np.repeat(angles[:, None], 100, axis=1), atol=1e-12)
    assert_allclose(rate, 0.0, atol=1e-11)


@pytest.mark.parametrize("disc", [SLIDING, UnbalancedDisc(2.0, 0.3, 1e-4, 5.0)])
@pytest.mark.parametrize("angle", [-1.2, 0.0, 0.7, 2.0])
def test_linear_models_are_the_jacobian(disc, angle):
    u, h = disc.holding_voltage(angle), 1e-7
    model = disc.linearize(angle)
    slopes = [
        (disc.acceleration(*(at + h * d)) - disc.acceleration(*(at - h * d))) / (2 * h)
        for at, d in zip([np.array([angle, 0.0, u])] * 3, np.eye(3), strict=True)
    ]
    assert_allclose([*model.A[1], model.B[1, 0]], slopes, rtol=1e-5, atol=1e-6)
    assert_array_equal(model.A[0], [0, 1])
    assert_array_equal(model.C, [[1, 0]])


def test_small_motions_follow_the_linear_model():
    u = prbs(300, amplitude=1e-4, clock=8, random_state=0)[:, 0]
    angle = 0.9
    theta, _ = SLIDING.simulate(SLIDING.holding_voltage(angle) + u, angle, 0.01)
    linear = SLIDING.linearize(angle).simulate(u, sampling_time=0.01)[:, 0]
    assert_allclose(theta - angle, linear, atol=1e-3 * np.abs(linear).max())


def test_integration_is_that_of_scipy_and_a_batch_that_of_each():
    u = prbs(40, 3, amplitude=2.0, clock=8, random_state=0).T
    start = np.array([0.0, 1.0, -3.0])
    theta, rate = SLIDING.simulate(u, start, 0.01)
    for k in range(3):
        alone = SLIDING.simulate(u[k], start[k], 0.01)
        assert_allclose((theta[k], rate[k]), alone, atol=1e-12)
        x = [start[k], 0.0]
        for j in range(39):
            x = solve_ivp(
                lambda t, x, held: [x[1], SLIDING.acceleration(*x, held)],
                [0, 0.01],
                x,
                args=(u[k, j],),
                rtol=1e-10,
                atol=1e-12,
            ).y[:, -1]
        assert_allclose((theta[k, -1], rate[k, -1]), x, atol=1e-6)


def test_tables_have_the_agreed_columns_and_labels():
    data = make_unbalanced_disc(3, n_realizations=2, **SMALL)
    for X, y, n_labels, n_samples in (
        (data.X, data.y, 6, 50),
        (data.X_local, data.y_local, 3, 50),
        (data.X_large, data.y_large, 1, 30),
    ):
        assert list(X.columns) == ["voltage", "kappa", "experiment", "time"]
        assert list(y.columns) == ["angle"] and len(X) == len(y)
        assert X.groupby("experiment").size().tolist() == [n_samples] * n_labels
    assert_array_equal(data.operating_points, [-1.3, 0.0, 1.3])
    assert_allclose(data.holding_voltages, data.disc.holding_voltage([-1.3, 0.0, 1.3]))
    assert data.disc.Fc == 0.0 and data.structure.n_params == 3
    first = data.X.groupby("experiment").first()
    assert_array_equal(first["kappa"], np.repeat(data.operating_points, 2))
    assert_array_equal(data.X_local["kappa"], data.y_local["angle"])
    assert "3 operating points" in data.DESCR
    assert "-1.3 to 1.3" in data.DESCR


def test_random_state_reproduces_and_noise_has_its_size():
    first, same = (make_unbalanced_disc(2, **SMALL) for _ in range(2))
    for name in ("X", "y", "X_local", "y_local", "X_large", "y_large"):
        assert first[name].equals(same[name])
    quiet = make_unbalanced_disc(2, **SMALL, snr_db=np.inf)
    assert_array_equal(quiet.y["angle"], quiet.X["kappa"])
    assert quiet.X.equals(first.X)
    for _, rows in first.X.groupby("experiment"):
        noise = first.y["angle"] - quiet.y["angle"]
        share = noise[rows.index].std() / quiet.y["angle"][rows.index].std()
        assert 0.02 < share < 0.05  # 30 dB: 0.0316


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: UnbalancedDisc(omega0=0.0), "`omega0` must be finite and positive"),
        (lambda: UnbalancedDisc(Fc=-1.0), "`Fc` must be finite and non-negative"),
        (lambda: SLIDING.simulate([0.0], [[1.0]], 0.01), "`voltage` must be finite"),
        (lambda: SLIDING.simulate([np.nan], 1.0, 0.01), "`voltage` must be finite"),
        (lambda: SLIDING.simulate(np.zeros((3, 5)), [0.0, 1.0], 0.01), "`theta` must"),
        (lambda: SLIDING.simulate([0.0], 1.0, 0.0), "`sampling_time` must be"),
        (lambda: SLIDING.linearize(np.nan), "`theta` must be one finite angle"),
        (lambda: make_unbalanced_disc(0), "`n_operating_points` must be"),
        (lambda: make_unbalanced_disc(reach=1.6), "`reach` must be positive and less"),
        (lambda: make_unbalanced_disc(snr_db=np.nan), "`snr_db` must be a number"),
        (lambda: make_unbalanced_disc(amplitude=0.0), "`amplitude` must be finite"),
        (lambda: make_unbalanced_disc(clock=1e-3), "`clock` must be finite"),
    ],
)
def test_wrong_calls_are_explained(call, message):
    with pytest.raises(ValueError, match=message):
        call()
