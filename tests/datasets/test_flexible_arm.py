"""The arm: simulation, linear models, structure, and what it refuses."""

import numpy as np
import pytest
import scipy.integrate

from lpvlearn.datasets import (
    FlexibleArm,
    prbs,
)

from .conftest import ANGLES, COARSE, LOPSIDED


def test_steps_of_any_length_give_what_another_method_does():
    arm, start = LOPSIDED, np.array([0.0, 1.0, 0.0, 0.0])
    reference = prbs(60, 2, amplitude=0.5, clock=4, random_state=0)

    def derivative(_, x, u):
        q, qdot = x[:4], x[4:]
        torques = arm.gains * (u - qdot[:2])
        pushed = arm.forces(q, qdot) + np.append(torques, [0.0, 0.0])
        return np.append(qdot, np.linalg.solve(arm.mass_matrix(q), pushed))

    x, rates = np.append(start, np.zeros(4)), []
    for u in reference:
        rates.append(x[4:])
        exact = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12, "args": (u,)}
        x = scipy.integrate.solve_ivp(derivative, (0.0, 2e-3), x, **exact).y[:, -1]
    for step, error in ((5e-4, 1e-10), (2e-3, 1e-10), (None, 1e-8), (1e-2, 1e-5)):
        found = arm.simulate(reference, 1.0, 2e-3, integration_step=step)
        assert np.abs(found.qdot - rates).max() < error * np.abs(rates).max()


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
        (np.full((99, 2), 1e9), 1.0, {}, "`velocity_reference` must be small enough"),
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


def test_momenta_are_another_state_of_the_same_models():
    arm = FlexibleArm()
    rates, momenta = arm.structure(), arm.structure(form="momentum")
    assert momenta.parameter_names == rates.parameter_names
    for angle in (0.5, 1.5, 2.5):
        theta = arm.parameters(angle)
        found, expected = momenta.model(theta), rates.model(theta)
        omega = np.geomspace(0.1, 1e3, 30)
        np.testing.assert_allclose(
            found.frequency_response(omega),
            expected.frequency_response(omega),
            atol=1e-9,
        )
        # z is what M q' = [G Lambda, K] z makes it
        M = arm.mass_matrix([0.0, angle, 0.0, 0.0])
        loads = np.diag([*arm.gains, 4 * arm.EI1 * arm.l1, 4 * arm.EI2 * arm.l2])
        T = np.zeros((6, 6))
        T[:2, :2], T[2:, 2:] = np.eye(2), np.linalg.solve(loads, M)
        moved = expected.transform(T)
        np.testing.assert_allclose(found.A, moved.A, atol=1e-9 * np.abs(moved.A).max())
        np.testing.assert_allclose(found.B, moved.B, atol=1e-9)
        np.testing.assert_allclose(found.C, moved.C, rtol=1e-9, atol=1e-6)
    with pytest.raises(ValueError, match="`form` must be 'rate' or 'momentum'"):
        arm.structure("rates")
