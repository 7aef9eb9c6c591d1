"""Error systems that several rooms test with."""

import numpy as np

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.error_system import ErrorSystem
from lpvlearn.restructuring.transfer import Target


def target_of(model):
    return Target(model.A, model.B, model.C, model.D, model.sampling_time)


def stable_model(rng, order, n_inputs, n_outputs, dt=None, rate=1.0):
    A = rng.normal(size=(order, order))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(order)
    B, C = rng.normal(size=(order, n_inputs)), rng.normal(size=(n_outputs, order))
    model = StateSpace(rate * A, rate * B, C)
    return model if dt is None else model.to_discrete(dt)


def oscillator(theta):
    """Mass, stiffness and damping of an oscillator: not affine."""
    m, k, c = theta
    A = np.array([[0 * m, 1 + 0 * m], [-k / m, -c / m]])
    return A, np.array([[0 * m], [1 / m]]), np.array([[1.0, 0.0]])


def system_of(shape, dt=None, weighted=False, physical=False):
    """An error system and parameters of a stable model."""
    rng = np.random.default_rng(3)
    p, m = shape
    black_box = stable_model(rng, 4, m, p, dt)
    if physical:
        structure = GrayBoxStructure.from_function(
            oscillator, {"m": 1.0, "k": 2.0, "c": 0.5}
        ).with_bounds({"m": (0, None), "k": (0.5, 9)})
        theta = np.array([0.8, 2.5, 0.4])
    else:
        start = stable_model(rng, 3, m, p, dt)
        A, B = start.A.tolist(), [[f"b{i}{j}" for j in range(m)] for i in range(3)]
        for i in range(3):
            A[i][i] = f"a{i}"
        structure = GrayBoxStructure.from_template(A, B, start.C.tolist())
        values = {f"a{i}": start.A[i, i] for i in range(3)}
        values |= {B[i][j]: start.B[i, j] for i in range(3) for j in range(m)}
        theta = np.array([values[name] for name in structure.parameter_names])
    weight = Target(*(np.array([[v]]) for v in (-2.0, 1.0, 3.0, 0.5)))
    system = ErrorSystem(structure, target_of(black_box), weight if weighted else None)
    return system, theta


SYSTEMS = [
    {"shape": (1, 1)},
    {"shape": (2, 1)},
    {"shape": (1, 3)},
    {"shape": (2, 2)},
    {"shape": (3, 2), "dt": 0.1},
    {"shape": (2, 2), "weighted": True},
    {"shape": (1, 1), "physical": True},
]
