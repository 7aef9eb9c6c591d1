"""The flexible arm: equations of motion, linear models, experiments, files."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline
from lpvlearn.datasets import (
    FlexibleArm,
    load_flexible_arm,
    load_varying_spring,
    make_flexible_arm,
    prbs,
)
from lpvlearn.datasets import reference as reference_module

# Every length and density different, so that no mix-up of links goes unseen.
LOPSIDED = FlexibleArm(
    l1=0.35, l2=0.25, rho1=0.9, rho2=0.6, EI1=70.0, EI2=20.0, elbow_mass=0.7
)
ANGLES = np.pi * np.arange(1, 8) / 8
COARSE = {"integration_step": 1e-3}


# -- an independent Lagrangian: positions by quadrature, derivatives by complex step --


def positions(arm, q):
    """Positions of mass elements, (n, 2), and their masses; q may be complex."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    nodes, weights = (nodes + 1) / 2, weights / 2
    th1, th2, v1, v2 = q
    th12 = th1 + th2 + 2 * arm.l1 * v1

    def point(x, angle, v):
        along, across = x - 2 / 3 * x**3 * v**2, x**2 * v
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * along - s * across, s * along + c * across], axis=-1)

    first = point(np.append(nodes * arm.l1, arm.l1), th1, v1)
    second = first[-1] + point(np.append(nodes * arm.l2, arm.l2), th12, v2)
    masses = [
        *(weights * arm.l1 * arm.rho1),
        arm.elbow_mass,
        *(weights * arm.l2 * arm.rho2),
        arm.tip_mass,
    ]
    return np.concatenate([first, second]), np.array(masses)


def lagrangian_mass(arm, q):
    """Mass matrix from the complex-step Jacobian of the positions and hub angles."""
    h = 1e-30
    J = np.array([positions(arm, q + 1j * h * e)[0].imag / h for e in np.eye(4)])
    M = np.einsum("ipk,p,jpk->ij", J, positions(arm, q)[1], J)
    hubs = np.array([[1.0, 0, 0, 0], [1.0, 1.0, 2 * arm.l1, 0]])
    return M + hubs.T @ np.diag([arm.J1, arm.J2]) @ hubs


def potential_energy(arm, q):
    """Bending energy 1/2 int EI (d2 delta / dx2)^2 dx with delta = x^2 v."""
    return 0.5 * (
        arm.EI1 * arm.l1 * (2 * q[2]) ** 2 + arm.EI2 * arm.l2 * (2 * q[3]) ** 2
    )


def lagrangian_forces(arm, q, qdot):
    """F = dL/dq - (d/dt dT/dq') at q'' = 0, by central differences of the masses."""
    h = 1e-5
    dM = np.array(
        [
            (lagrangian_mass(arm, q + h * e) - lagrangian_mass(arm, q - h * e))
            / (2 * h)
            for e in np.eye(4)
        ]
    )
    dV = np.array(
        [potential_energy(arm, q + 1j * 1e-30 * e).imag / 1e-30 for e in np.eye(4)]
    )
    return (
        0.5 * np.einsum("kij,i,j->k", dM, qdot, qdot)
        - np.einsum("kij,k,j->i", dM, qdot, qdot)
        - dV
    )


@pytest.mark.parametrize("arm", [FlexibleArm(), LOPSIDED])
def test_mass_matrix_equals_independent_quadrature(arm):
    q = np.random.default_rng(0).normal(size=(20, 4))
    expected = np.array([lagrangian_mass(arm, row) for row in q])
    np.testing.assert_allclose(arm.mass_matrix(q), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("arm", [FlexibleArm(), LOPSIDED])
def test_forces_equal_lagrange_equations(arm):
    rng = np.random.default_rng(1)
    q, qdot = rng.normal(size=(2, 20, 4))
    expected = [lagrangian_forces(arm, *rows) for rows in zip(q, qdot, strict=True)]
    np.testing.assert_allclose(arm.forces(q, qdot), expected, rtol=1e-8, atol=1e-7)


def test_mass_matrix_is_symmetric_positive_definite():
    rng = np.random.default_rng(2)
    q = rng.uniform(-1, 1, size=(200, 4)) * [np.pi, np.pi, 0.5, 0.5]
    M = LOPSIDED.mass_matrix(q)
    np.testing.assert_array_equal(M, M.swapaxes(1, 2))
    assert np.linalg.eigvalsh(M).min() > 0


def test_mass_and_forces_vectorise_over_leading_axes():
    rng = np.random.default_rng(3)
    q, qdot = rng.normal(size=(2, 2, 3, 4))
    M, F = LOPSIDED.mass_matrix(q), LOPSIDED.forces(q, qdot)
    assert M.shape == (2, 3, 4, 4) and F.shape == (2, 3, 4)
    np.testing.assert_allclose(M[1, 2], LOPSIDED.mass_matrix(q[1, 2]), rtol=1e-14)
    np.testing.assert_allclose(
        F[1, 2], LOPSIDED.forces(q[1, 2], qdot[1, 2]), rtol=1e-12, atol=1e-13
    )
    np.testing.assert_allclose(
        LOPSIDED.forces(q[0], qdot[0, 0]),
        LOPSIDED.forces(q[0], np.tile(qdot[0, 0], (3, 1))),
    )


def test_turning_joint_1_changes_nothing():
    q, qdot = np.random.default_rng(4).normal(size=(2, 4))
    turned = q + [1.234, 0, 0, 0]
    np.testing.assert_allclose(LOPSIDED.mass_matrix(turned), LOPSIDED.mass_matrix(q))
    np.testing.assert_allclose(LOPSIDED.forces(turned, qdot), LOPSIDED.forces(q, qdot))


# -- simulation ------------------------------------------------------------------------


def energy(arm, q, qdot):
    kinetic = 0.5 * np.einsum("...i,...ij,...j->...", qdot, arm.mass_matrix(q), qdot)
    return kinetic + potential_energy(arm, np.moveaxis(q, -1, 0))


def test_power_of_the_velocity_loops_is_the_change_of_energy():
    arm = LOPSIDED
    reference = np.tile([1.0, -0.7], (1000, 1))
    response = arm.simulate(reference, 1.2, 1e-3, integration_step=2.5e-4)
    E = energy(arm, response.q, response.qdot)
    rates = response.qdot[:, :2]
    power = ((reference - rates) * arm.gains * rates).sum(axis=1)
    work = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2) * 1e-3])
    np.testing.assert_allclose(E, work, atol=1e-4 * E.max())


def test_energy_is_conserved_without_control():
    from lpvlearn.datasets import mechanics

    arm = FlexibleArm(gains=(0.0, 0.0))
    T = mechanics.coordinate_change(arm.l1)
    inverse = np.linalg.inv(T)
    q0, qdot0 = np.array([0.3, 1.0, 0.05, -0.1]), np.array([2.0, -3.0, 1.0, 2.0])
    elastic = (
        -inverse.T
        @ np.diag([0, 0, 4 * arm.EI1 * arm.l1, 4 * arm.EI2 * arm.l2])
        @ inverse
    )
    states = mechanics.integrate(
        np.concatenate([T @ q0, T @ qdot0])[:, np.newaxis],
        np.zeros((1000, 4, 1)),
        np.hstack([elastic, np.zeros((4, 4))]),
        mechanics.arm_tables(
            arm.l1,
            arm.l2,
            arm.rho1,
            arm.rho2,
            arm.J1,
            arm.J2,
            arm.elbow_mass,
            arm.tip_mass,
        ),
        2.5e-4,
        2,
    )[..., 0]
    E = energy(arm, states[:, :4] @ inverse.T, states[:, 4:] @ inverse.T)
    assert np.ptp(states[:, 1]) > 0.01  # the links do bend
    np.testing.assert_allclose(E, E[0], rtol=1e-7)


def test_integration_converges_with_order_four():
    reference = prbs(100, 2, amplitude=0.5, clock=5, random_state=0)

    def end(step):
        response = FlexibleArm().simulate(reference, 1.0, 2e-3, integration_step=step)
        return response.q[-1]

    exact = end(1.25e-4)
    errors = [np.abs(end(step) - exact).max() for step in (2e-3, 1e-3)]
    assert 12 < errors[0] / errors[1] < 20


def test_batch_equals_single_simulations():
    arm = LOPSIDED
    references = np.stack(
        [prbs(150, 2, amplitude=0.3, clock=5, random_state=i) for i in range(3)]
    )
    theta2 = np.array([0.5, 1.5, -2.0])
    batch = arm.simulate(references, theta2, 1e-3, **COARSE)
    for i in range(3):
        single = arm.simulate(references[i], theta2[i], 1e-3, **COARSE)
        assert single.y.shape == (150, 2) and single.q.shape == (150, 4)
        for name in ("y", "q", "qdot", "kappa"):
            np.testing.assert_allclose(
                getattr(batch, name)[i], getattr(single, name), rtol=1e-9, atol=1e-11
            )


def test_one_reference_serves_several_angles_and_the_reverse():
    reference = prbs(50, 2, amplitude=0.1, clock=5, random_state=0)
    both = FlexibleArm().simulate(reference, [1.0, 2.0], 1e-3, **COARSE)
    same = FlexibleArm().simulate([reference, -reference], 1.0, 1e-3, **COARSE)
    np.testing.assert_allclose(both.y[0], same.y[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(both.q[:, 0, 1], [1.0, 2.0])


@pytest.mark.parametrize("theta2", ANGLES[[0, 3, 6]])
def test_small_signals_follow_the_linear_model(theta2):
    arm = LOPSIDED
    reference = prbs(600, 2, amplitude=1e-4, clock=10, random_state=0)
    y = arm.simulate(reference, theta2, 1e-3, **COARSE).y
    linear = arm.linearize(theta2).simulate(reference, sampling_time=1e-3)
    np.testing.assert_allclose(y, linear, atol=1e-3 * np.abs(y).max())


def test_mirrored_arm_moves_as_the_mirror_image():
    reference = prbs(100, 2, amplitude=0.5, clock=5, random_state=1)
    left = LOPSIDED.simulate(reference, 1.1, 1e-3, **COARSE)
    right = LOPSIDED.simulate(-reference, -1.1, 1e-3, **COARSE)
    np.testing.assert_allclose(right.q, -left.q, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(right.y, -left.y, rtol=1e-9, atol=1e-12)


def test_output_is_the_derivative_of_the_rigid_inverse_kinematics():
    arm = LOPSIDED
    q, qdot = np.array([0.4, 1.3, 0.08, -0.2]), np.array([0.5, -0.4, 0.3, 0.6])

    def rigid_angles(q):
        x, y = positions(arm, q)[0][-1]
        cosine = (x**2 + y**2 - arm.l1**2 - arm.l2**2) / (2 * arm.l1 * arm.l2)
        a2 = np.arccos(cosine)
        return np.array(
            [
                np.arctan2(y, x)
                - np.arctan2(arm.l2 * np.sin(a2), arm.l1 + arm.l2 * cosine),
                a2,
            ]
        )

    h = 1e-6
    expected = (rigid_angles(q + h * qdot) - rigid_angles(q - h * qdot)) / (2 * h)
    np.testing.assert_allclose(arm.rigid_rates(q, qdot), expected, rtol=1e-8)


def test_output_is_eq_31c_to_first_order():
    arm, rates = LOPSIDED, np.array([0.5, -0.4, 0.3, 0.6])
    C = arm.linearize(1.3).C[:, 2:]
    y = arm.rigid_rates([0.4, 1.3, 0.0, 0.0], rates)
    np.testing.assert_allclose(y, C @ rates, rtol=1e-12)


# -- linear models ---------------------------------------------------------------------


@pytest.mark.parametrize("theta2", ANGLES)
def test_linearisation_is_the_derivative_of_the_equations(theta2):
    arm = LOPSIDED
    Lambda = np.diag(arm.gains)

    def acceleration(state, reference):
        q = np.array([0.0, theta2, *state[:2]])
        torque = np.zeros(4)
        torque[:2] = Lambda @ (reference - state[2:4])
        return np.linalg.solve(arm.mass_matrix(q), arm.forces(q, state[2:]) + torque)

    h, zero = 1e-4, np.zeros(2)
    model = arm.linearize(theta2)
    columns = [
        (acceleration(h * e, zero) - acceleration(-h * e, zero)) / (2 * h)
        for e in np.eye(6)
    ]
    scale = np.abs(model.A).max()
    np.testing.assert_allclose(model.A[2:], np.array(columns).T, atol=1e-7 * scale)
    np.testing.assert_array_equal(model.A[:2], np.eye(6)[4:])
    inputs = [acceleration(np.zeros(6), e) for e in np.eye(2)]
    np.testing.assert_allclose(model.B[2:], np.array(inputs).T, rtol=1e-10)
    np.testing.assert_array_equal(model.B[:2], 0)


@pytest.mark.parametrize("theta2", ANGLES)
def test_static_gain_is_identity(theta2):
    arm = LOPSIDED
    for model in (arm.linearize(theta2), arm.rigid(theta2)):
        assert model.is_stable
        np.testing.assert_allclose(model.dc_gain(), np.eye(2), atol=1e-10)


def test_stiff_links_approach_the_rigid_arm():
    omega = np.geomspace(0.1, 30, 20)
    rigid = FlexibleArm().rigid(1.0).frequency_response(omega)
    errors = [
        np.abs(
            FlexibleArm(EI1=89 * k, EI2=12 * k).linearize(1.0).frequency_response(omega)
            - rigid
        ).max()
        for k in (1e2, 1e4)
    ]
    assert errors[1] < 1e-3
    np.testing.assert_allclose(errors[0] / errors[1], 100, rtol=0.2)


@pytest.mark.parametrize("theta2", ANGLES)
def test_structure_at_the_true_parameters_is_the_linear_model(theta2):
    arm = LOPSIDED
    A, B, C, D = arm.structure().matrices(arm.parameters(theta2))
    model = arm.linearize(theta2)
    for ours, expected in ((A, model.A), (B, model.B), (C, model.C), (D, model.D)):
        np.testing.assert_array_equal(ours, expected)


def test_structure_is_eq_32():
    structure = FlexibleArm().structure()
    assert structure.parameter_names == tuple(f"p{i}" for i in range(1, 17))
    A, B, C, _ = structure.matrices(np.arange(1.0, 17.0))
    np.testing.assert_array_equal(A[2:, :4], np.arange(1, 17).reshape(4, 4).T)
    np.testing.assert_array_equal(B[2:], -A[2:, 2:4])
    np.testing.assert_array_equal(A[:2], np.eye(6)[4:])
    np.testing.assert_array_equal(C, [[0, 0, 1, 0, 0.3, 0], [0, 0, 0, 1, 0.3, 0.3]])


def test_default_arm_has_the_designed_modes():
    poles = np.array([FlexibleArm().linearize(a).poles() for a in ANGLES])
    slowest = np.abs(poles.real).min(axis=1)
    assert slowest.min() > 0.65 and slowest.max() < 2.25
    modes = np.sort(np.where(poles.imag > 0, poles.imag, np.inf), axis=1)[:, :2]
    np.testing.assert_allclose(modes, np.tile([50, 117], (7, 1)), rtol=0.1)


# -- excitation and noise --------------------------------------------------------------


def test_prbs_has_two_levels_held_for_the_clock():
    u = prbs(1000, 3, amplitude=0.2, clock=7, random_state=0)
    assert u.shape == (1000, 3)
    np.testing.assert_array_equal(np.unique(u), [-0.2, 0.2])
    changes = np.flatnonzero(np.diff(u, axis=0).any(axis=1)) + 1
    assert (changes % 7 == 0).all()


def test_prbs_is_white_balanced_in_the_mean_and_uncorrelated():
    n = 2**15
    u = prbs(n, 2, random_state=0)
    bound = 4 / np.sqrt(n)  # four standard deviations
    assert np.abs(u.mean(axis=0)).max() < bound
    spectra = np.fft.fft(u, 2 * n, axis=0)
    lags = np.fft.ifft(np.abs(spectra) ** 2, axis=0).real[1:50] / n
    assert np.abs(lags).max() < bound
    cross = np.fft.ifft(spectra[:, 0] * spectra[:, 1].conj()).real / n
    assert np.abs(cross[:50]).max() < bound
    power = (np.abs(np.fft.fft(u, axis=0)) ** 2 / n).reshape(64, -1, 2).mean(axis=1)
    np.testing.assert_allclose(power, 1, atol=4 / np.sqrt(n / 64))


def test_held_prbs_has_the_squared_sinc_spectrum():
    clock, n = 5, 2**15
    u = prbs(n * clock, 1, clock=clock, random_state=1).ravel()
    power = np.abs(np.fft.rfft(u)) ** 2 / u.size
    bands = power[1 : 1 + 50 * (len(power) // 50)].reshape(50, -1).mean(axis=1)
    omega = np.pi * (np.arange(50) + 0.5) / 50
    expected = np.sin(clock * omega / 2) ** 2 / np.sin(omega / 2) ** 2 / clock
    np.testing.assert_allclose(bands, expected, atol=0.15 * expected.max())


def test_balanced_prbs_integrates_to_zero_over_each_window():
    u = prbs(400, 2, clock=4, balance=10, random_state=0)
    np.testing.assert_array_equal(u.reshape(10, 40, 2).sum(axis=1), 0)


def test_noise_has_the_asked_signal_to_noise_ratio_and_is_white():
    options = {"n_operating_points": 2, "duration": 0.5, "sweep_duration": 0.01}
    noisy, clean = (
        make_flexible_arm(
            n_realizations=40, snr_db=snr, random_state=0, **options, **COARSE
        ).y.to_numpy()
        for snr in (20.0, np.inf)
    )
    v = (noisy - clean).reshape(2, 40, 500, 2)
    y = clean.reshape(2, 40, 500, 2)
    np.testing.assert_array_equal(y, y[:, :1].repeat(40, axis=1))
    snr = 10 * np.log10(y[:, 0].var(axis=1) / v.var(axis=(1, 2)))
    # the relative deviation of a variance of n samples is sqrt(2 / n)
    np.testing.assert_allclose(snr, 20, atol=4 * 4.343 * np.sqrt(2 / 20000))
    unit = (v / v.std(axis=(1, 2), keepdims=True)).reshape(-1, 2)
    bound = 4 / np.sqrt(len(unit))
    assert abs(np.mean(unit[:, 0] * unit[:, 1])) < bound
    assert np.abs(np.mean(unit[1:] * unit[:-1], axis=0)).max() < bound
    kurtosis = np.mean(unit**4, axis=0)
    np.testing.assert_allclose(kurtosis, 3, atol=4 * np.sqrt(24 / len(unit)))


# -- the generator ---------------------------------------------------------------------

SMALL = {
    "n_operating_points": 3,
    "n_realizations": 2,
    "duration": 0.1,
    "sweep_duration": 0.15,
    **COARSE,
}


def test_tables_have_the_agreed_columns_and_labels():
    data = make_flexible_arm(**SMALL, random_state=0)
    for X, y, n_labels, n_samples in (
        (data.X, data.y, 6, 100),
        (data.X_local, data.y_local, 3, 100),
        (data.X_sweep, data.y_sweep, 1, 150),
    ):
        assert list(X.columns) == ["u1", "u2", "kappa", "experiment", "time"]
        assert list(y.columns) == ["y1", "y2"]
        assert len(X) == len(y) == n_labels * n_samples
        assert X.groupby("experiment").size().tolist() == [n_samples] * n_labels
        np.testing.assert_allclose(X["time"].to_numpy()[:3], [0, 1e-3, 2e-3])
        assert X["time"].groupby(X["experiment"]).is_monotonic_increasing.all()
    assert len(data.analytic_models) == 3 and data.structure.n_params == 16
    assert data.sampling_time == 1e-3 and "theta2 = i pi / 4" in data.DESCR
    np.testing.assert_allclose(data.theta2, np.pi * np.array([1, 2, 3]) / 4)
    np.testing.assert_allclose(data.operating_points, np.cos(data.theta2))
    means = data.X.groupby("experiment")["kappa"].mean().to_numpy()
    np.testing.assert_array_equal(means[::2], means[1::2])
    np.testing.assert_allclose(means[::2], data.operating_points, atol=1e-2)


def test_realizations_share_everything_but_the_noise():
    data = make_flexible_arm(**SMALL, random_state=0)
    X = data.X.to_numpy().reshape(3, 2, 100, 5)
    y = data.y.to_numpy().reshape(3, 2, 100, 2)
    np.testing.assert_array_equal(
        X[:, 0][..., [0, 1, 2, 4]], X[:, 1][..., [0, 1, 2, 4]]
    )
    assert (y[:, 0] != y[:, 1]).all()


def test_random_state_reproduces_and_realizations_do_not_shift_the_references():
    first, same = (make_flexible_arm(**SMALL, random_state=7) for _ in range(2))
    for name in ("X", "y", "X_local", "y_local", "X_sweep", "y_sweep"):
        assert first[name].equals(same[name])
    other = make_flexible_arm(**SMALL, random_state=8)
    assert not first.y.equals(other.y) and not first.X_local.equals(other.X_local)
    more = make_flexible_arm(**{**SMALL, "n_realizations": 3}, random_state=7)
    assert more.X_local.equals(first.X_local) and more.y_sweep.equals(first.y_sweep)
    np.testing.assert_array_equal(more.X["u1"][:100], first.X["u1"][:100])


def test_local_validation_is_new_and_noise_free():
    data = make_flexible_arm(**{**SMALL, "n_realizations": 1}, random_state=0)
    assert not np.array_equal(data.X["u1"], data.X_local["u1"])
    reference = data.X_local[["u1", "u2"]].to_numpy().reshape(3, 100, 2)
    y = data.arm.simulate(reference, data.theta2, 1e-3, **COARSE).y
    np.testing.assert_allclose(data.y_local, y.reshape(-1, 2), rtol=1e-9, atol=1e-12)


def test_local_experiments_are_local_and_linear():
    data = make_flexible_arm(n_operating_points=3, random_state=0, **COARSE)
    groups = data.X_local.groupby("experiment")
    assert (groups["kappa"].max() - groups["kappa"].min()).max() < 0.03
    for label, rows in groups:
        y = data.y_local.loc[rows.index].to_numpy()
        model = data.analytic_models[label].simulate(
            rows[["u1", "u2"]].to_numpy(), sampling_time=1e-3
        )
        error = np.linalg.norm(y - model, axis=0)
        assert (error < 0.01 * np.linalg.norm(y - y.mean(axis=0), axis=0)).all()


def test_sweep_visits_the_range_of_the_operating_points():
    data = make_flexible_arm(
        n_operating_points=1, duration=0.1, random_state=0, **COARSE
    )
    theta2 = np.arccos(data.X_sweep["kappa"])
    assert theta2.iloc[0] == pytest.approx(np.pi / 8)
    assert theta2.min() > np.pi / 9 and 6.5 * np.pi / 8 < theta2.max() < 7.1 * np.pi / 8


def test_scalar_clock_and_independent_bits():
    options = {**SMALL, "clock": 0.005, "balance_time": None}
    data = make_flexible_arm(**options, random_state=0)
    u = data.X_local[["u1", "u2"]].to_numpy().reshape(-1, 5, 2)
    np.testing.assert_array_equal(u, u[:, :1].repeat(5, axis=1))


# -- the files -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reference():
    return load_flexible_arm()


def test_files_hold_what_the_generator_makes(reference):
    made = make_flexible_arm(
        random_state=reference_module.REFERENCE_SEED, integration_step=5e-4
    )
    assert set(made) == set(reference)
    for name in ("X", "y", "X_local", "y_local", "X_sweep", "y_sweep"):
        assert list(made[name].columns) == list(reference[name].columns)
        # 7 digits, and the coarser step of this test
        np.testing.assert_allclose(
            reference[name], made[name], rtol=1e-6, atol=1e-6, err_msg=name
        )
    np.testing.assert_array_equal(made.theta2, reference.theta2)


def test_writing_twice_gives_the_same_bytes(tmp_path, monkeypatch, reference):
    monkeypatch.setattr(reference_module, "make_flexible_arm", lambda **_: reference)
    reference_module.write_reference(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        stored = reference_module.data_folder() / path.name
        # Other versions of zlib may compress the same text differently.
        assert gzip.decompress(path.read_bytes()) == gzip.decompress(
            stored.read_bytes()
        )


def test_data_card_names_every_file(reference):
    for name in reference_module.TABLES:
        assert name in reference.DESCR


def test_the_stored_spring_is_identified_as_what_it_is():
    data = load_varying_spring()
    pipeline = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(data.structure),
        scheduling="kappa",
        experiment="run",
        time="time",
    ).fit(data.X, data.y)
    assert pipeline.sampling_time_ == pytest.approx(data.sampling_time)
    names = list(pipeline.parameters_)
    error = pipeline.parameters_ - data.true_parameters[names].to_numpy()
    assert (error.abs() < 4 * pipeline.parameters_std_).all(axis=None)
    assert "varying_spring.csv" in data.DESCR


def test_missing_files_are_explained(monkeypatch, tmp_path):
    monkeypatch.setattr(
        reference_module, "__file__", str(tmp_path / "a" / "b" / "c.py")
    )
    with pytest.raises(FileNotFoundError, match="reinstall lpvlearn"):
        load_flexible_arm()


def test_wheel_folder_comes_first(monkeypatch, tmp_path):
    package = tmp_path / "lpvlearn" / "datasets"
    (package / "data").mkdir(parents=True)
    (package / "data" / next(iter(reference_module.TABLES))).touch()
    monkeypatch.setattr(reference_module, "__file__", str(package / "reference.py"))
    assert reference_module.data_folder() == Path(package / "data").resolve()


# -- bad input -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, message",
    [
        ({"l1": 0.0}, "`l1` must be finite and positive. Got 0.0"),
        ({"EI2": np.nan}, "`EI2` must be finite and positive. Got nan"),
        ({"tip_mass": -1.0}, "`tip_mass` must be finite and non-negative. Got -1.0"),
        ({"gains": (1.0, 2.0, 3.0)}, "`gains` must be two"),
        ({"gains": (1.0, -2.0)}, "`gains` must be two"),
    ],
)
def test_bad_parameters_of_the_arm(parameters, message):
    with pytest.raises(ValueError, match=message):
        FlexibleArm(**parameters)


@pytest.mark.parametrize(
    "reference, theta2, options, message",
    [
        (np.zeros(5), 1.0, {}, r"`velocity_reference` must have shape"),
        (np.zeros((5, 3)), 1.0, {}, r"`velocity_reference` must have shape"),
        (np.full((5, 2), np.nan), 1.0, {}, "`velocity_reference` must be finite"),
        (np.zeros((2, 5, 2)), [1.0, 2.0, 3.0], {}, r"`theta2` must hold one angle"),
        (np.zeros((5, 2)), [[1.0]], {}, "`theta2` must be one finite angle"),
        (np.zeros((5, 2)), np.inf, {}, "`theta2` must be one finite angle"),
        (np.zeros((5, 2)), 0.0, {}, "`theta2` must stay away from multiples of pi"),
        (np.zeros((5, 2)), 1.0, {"sampling_time": 0.0}, "`sampling_time` must be"),
        (np.zeros((5, 2)), 1.0, {"integration_step": -1.0}, "`integration_step` must"),
        (
            np.zeros((5, 2)),
            1.0,
            {"sampling_time": 0.1, "integration_step": 0.1},
            "`integration_step` must be at most 0.0",
        ),
    ],
)
def test_bad_simulations(reference, theta2, options, message):
    arguments = {"sampling_time": 1e-3, **options}
    with pytest.raises(ValueError, match=message):
        FlexibleArm().simulate(reference, theta2, **arguments)


def test_bad_coordinates():
    with pytest.raises(ValueError, match=r"`q` must have shape \(..., 4\)"):
        FlexibleArm().mass_matrix([1.0, 2.0])
    with pytest.raises(ValueError, match="`qdot` must be finite"):
        FlexibleArm().forces(np.zeros(4), [0, 0, np.inf, 0])
    with pytest.raises(ValueError, match="`theta2` must be one finite angle"):
        FlexibleArm().linearize(np.nan)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"n_operating_points": 0}, "`n_operating_points` must be an integer"),
        ({"n_realizations": 1.5}, "`n_realizations` must be an integer"),
        ({"snr_db": np.nan}, "`snr_db` must be a number"),
        ({"duration": 0.0}, "`duration` must be finite and at least"),
        ({"sampling_time": -1.0}, "`sampling_time` must be finite and positive"),
        ({"clock": 0.0}, "`clock` must be a positive multiple"),
        ({"clock": 0.0015}, "`clock` must be a positive multiple"),
        ({"clock": (0.01, 0.01, 0.01)}, "`clock` must be one time"),
        ({"balance_time": 0.0}, "`balance_time` must be positive or None"),
        ({"amplitude": 0.0}, "`amplitude` must be finite and positive"),
    ],
)
def test_bad_options_of_the_generator(options, message):
    with pytest.raises(ValueError, match=message):
        make_flexible_arm(**{**SMALL, **options})


@pytest.mark.parametrize(
    "options, message",
    [
        ({"n_samples": 0}, "`n_samples` must be an integer of at least 1"),
        ({"clock": 1.5}, "`clock` must be an integer of at least 1"),
        ({"balance": 3}, "`balance` must be None or an even number"),
    ],
)
def test_bad_options_of_prbs(options, message):
    with pytest.raises(ValueError, match=message):
        prbs(**{"n_samples": 10, **options})
