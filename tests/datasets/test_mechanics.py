"""Equations of motion against an independent Lagrangian: quadrature, complex steps."""

import numpy as np
import pytest

from lpvlearn.datasets import (
    FlexibleArm,
)

from .conftest import LOPSIDED


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


def energy(arm, q, qdot):
    kinetic = 0.5 * np.einsum("...i,...ij,...j->...", qdot, arm.mass_matrix(q), qdot)
    return kinetic + potential_energy(arm, np.moveaxis(q, -1, 0))


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
        5e-4,
        1.5e-3,
    )[..., 0]
    E = energy(arm, states[:, :4] @ inverse.T, states[:, 4:] @ inverse.T)
    assert np.ptp(states[:, 1]) > 0.01  # the links do bend
    np.testing.assert_allclose(E, E[0], rtol=1e-10)


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


def test_power_of_the_velocity_loops_is_the_change_of_energy():
    arm = LOPSIDED
    reference = np.tile([1.0, -0.7], (1000, 1))
    response = arm.simulate(reference, 1.2, 1e-3, integration_step=5e-3)
    E = energy(arm, response.q, response.qdot)
    rates = response.qdot[:, :2]
    power = ((reference - rates) * arm.gains * rates).sum(axis=1)
    work = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2) * 1e-3])
    np.testing.assert_allclose(E, work, atol=1e-4 * E.max())


def test_bad_coordinates():
    with pytest.raises(ValueError, match=r"`q` must have shape \(..., 4\)"):
        FlexibleArm().mass_matrix([1.0, 2.0])
    with pytest.raises(ValueError, match="`qdot` must be finite"):
        FlexibleArm().forces(np.zeros(4), [0, 0, np.inf, 0])
    with pytest.raises(ValueError, match="`theta2` must be one finite angle"):
        FlexibleArm().linearize(np.nan)
