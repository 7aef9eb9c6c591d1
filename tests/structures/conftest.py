"""What the tests of the structures share."""

import numpy as np

from lpvlearn.restructuring.identifiability import Identifiability

OMEGA = np.geomspace(0.05, 50.0, 40)


def response_jacobian(structure, theta, omega=OMEGA):
    """``L dS R`` with ``L = [C X, I]``, ``R = [X B; I]``, ``X = (j omega - A)^-1``."""
    A, B, C, _ = structure.matrices(theta)
    p, m, k = structure.n_outputs, structure.n_inputs, len(omega)
    X = np.linalg.inv(1j * omega[:, None, None] * np.eye(structure.order) - A)
    left = np.concatenate([C @ X, np.broadcast_to(np.eye(p), (k, p, p))], 2)
    right = np.concatenate([X @ B, np.broadcast_to(np.eye(m), (k, m, m))], 1)
    return np.einsum("kia,qab,kbj->kijq", left, structure.jacobian(theta), right)


def rank(structure, theta):
    J = response_jacobian(structure, np.asarray(theta))
    return Identifiability.from_jacobian(J, structure.parameter_names).rank


def pendulum(theta):
    length, damping, gain = theta
    A = np.array([[0, 1], [-9.81 / length, -damping * length**2]])
    return A, np.array([[0], [gain * np.exp(-length)]]), np.array([[1, 0]])


def pendulum_jacobian(theta):
    length, damping, gain = theta
    zero = np.zeros((2, 2))
    by_length = np.array([[0, 0], [9.81 / length**2, -2 * damping * length]])
    by_damping = np.array([[0, 0], [0, -(length**2)]])
    decay = np.exp(-length)
    B = [[[0], [-gain * decay]], [[0], [0]], [[0], [decay]]]
    return [by_length, by_damping, zero], B, np.zeros((3, 1, 2))
