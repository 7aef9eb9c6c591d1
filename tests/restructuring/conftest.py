"""Structures, black boxes, and fits that the tests of the restructuring share."""

import warnings
from functools import cache

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.datasets import FlexibleArm
from lpvlearn.restructuring.error_system import ErrorSystem, Target

from ..conftest import spring_structure
from ..conftest import stable_model as continuous_model


def target_of(model):
    """A model as the error systems hold it."""
    return Target(model.A, model.B, model.C, model.D, model.sampling_time)


def two_masses():
    """Two masses in a chain: five parameters, one input, both positions."""
    return GrayBoxStructure.from_template(
        [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            ["-k1", "k2", "-c1", 0],
            ["k3", "-k3", 0, "-c2"],
        ],
        [[0], [0], ["b"], [0]],
        [[1, 0, 0, 0], [0, 1, 0, 0]],
    )


def heat_exchanger():
    """First-order lags in series, three outputs, a feedthrough parameter."""
    return GrayBoxStructure.from_template(
        [["-a1", 0, 0], ["a2", "-a2", 0], [0, "a3", "-a3"]],
        [["a1"], [0], [0]],
        np.eye(3),
        [[0], [0], ["d"]],
    )


CASES = {
    "spring_mass": (spring_structure(), {"k": 9.0, "c": 0.4, "b": 2.0}),
    "two_masses": (
        two_masses(),
        {"k1": 30.0, "k2": 12.0, "k3": 20.0, "c1": 0.5, "c2": 0.9, "b": 3.0},
    ),
    "heat_exchanger": (
        heat_exchanger(),
        {"a1": 0.5, "a2": 2.0, "a3": 0.3, "d": 0.1},
    ),
    "arm": (
        FlexibleArm().structure(),
        dict(
            zip(
                FlexibleArm().structure().parameter_names,
                FlexibleArm().parameters(0.9),
                strict=True,
            )
        ),
    ),
}


def disguised(model, rng):
    """The same transfer function in another state basis."""
    T = rng.normal(size=model.A.shape) + 2 * np.eye(model.order)
    return model.transform(T)


def off_structure(model, rng, size):
    """A black box near a model, outside of its structure."""
    A = model.A * (1 + size * rng.normal(size=model.A.shape))
    B = model.B * (1 + size * rng.normal(size=model.B.shape))
    C = model.C + size * rng.normal(size=model.C.shape) * np.abs(model.C).max()
    return StateSpace(A, B, C, model.D)


@cache
def far_fit(seed):
    """A black box off the structure of two masses, and a restructurer fitted to it."""
    structure, params = CASES["two_masses"]
    rng = np.random.default_rng(seed)
    black_box = off_structure(structure.model(params), rng, 0.03)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the structure comes no nearer")
        return black_box, GrayBoxRestructurer(structure).fit_model(black_box)


@pytest.fixture
def rough():
    """Black boxes far off the structure: the warning about them is not the subject."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the structure comes no nearer")
        yield


def stable_model(rng, order, n_inputs, n_outputs, dt=None, decay=0.5, **options):
    """The shared random model, sampled where `dt` says so."""
    model = continuous_model(rng, order, n_inputs, n_outputs, decay=decay, **options)
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
