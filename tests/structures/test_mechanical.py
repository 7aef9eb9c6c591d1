"""Equations of motion: limit cases, derivatives, identifiability."""

import pickle

import joblib
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxStructure

from .conftest import OMEGA, rank

MECHANICAL = GrayBoxStructure.mechanical

D2 = [["c1 + c2", "-c2"], ["-c2", "c2"]]
K2 = [["k1 + k2", "-k2"], ["-k2", "k2"]]
M2 = [["m1", 0], [0, "m2"]]
UNIT = [[1, 0], [0, 1]]
VALUES = {"c1": 0.3, "c2": 0.1, "k1": 5.0, "k2": 2.0, "m1": 1.5, "m2": 0.4}


def test_unit_masses_give_the_hand_written_template():
    structure = MECHANICAL(UNIT, D2, K2, [[0], ["b"]])
    template = GrayBoxStructure.from_template(
        A=[
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            ["-(k1 + k2)", "k2", "-(c1 + c2)", "c2"],
            ["k2", "-k2", "c2", "-c2"],
        ],
        B=[[0], [0], [0], ["b"]],
        C=[[1, 0, 0, 0], [0, 1, 0, 0]],
    )
    assert structure.is_affine and structure.implicit is None
    assert structure.parameter_names == template.parameter_names
    assert_array_equal(structure.offset, template.offset)
    assert_array_equal(structure.basis, template.basis)


def equations_of_motion(values, omega, forces):
    """``q = (K + j w D - w^2 M)^-1 F`` of the two-mass chain."""
    v = values
    M = np.diag([v["m1"], v["m2"]])
    D = np.array([[v["c1"] + v["c2"], -v["c2"]], [-v["c2"], v["c2"]]])
    K = np.array([[v["k1"] + v["k2"], -v["k2"]], [-v["k2"], v["k2"]]])
    s = 1j * omega[:, None, None]
    return np.linalg.solve(K + s * D + s**2 * M, forces)


@pytest.mark.parametrize(
    "outputs, power", [("position", 0), ("velocity", 1), ("acceleration", 2)]
)
@pytest.mark.parametrize("sensors", [None, [[1.0, -1.0]]])
def test_the_response_is_that_of_the_equations_of_motion(outputs, power, sensors):
    forces = np.array([[1.0, 0.0], [0.0, 2.0]])
    structure = MECHANICAL(M2, D2, K2, forces.tolist(), outputs, sensors=sensors)
    H = np.eye(2) if sensors is None else np.array(sensors)
    q = H @ equations_of_motion(VALUES, OMEGA, forces)
    expected = q * (1j * OMEGA[:, None, None]) ** power
    found = structure.model(VALUES).frequency_response(OMEGA)
    assert_allclose(found, expected, rtol=1e-10, atol=1e-13)
    assert structure.free_feedthrough.any() == (outputs == "acceleration")
    fixed = structure.fix({"m1": 1.5, "m2": 0.4})
    assert fixed.is_affine
    rest = {name: VALUES[name] for name in fixed.parameter_names}
    found = fixed.model(rest).frequency_response(OMEGA)
    assert_allclose(found, expected, rtol=1e-10, atol=1e-13)


def complex_step(structure, theta):
    steps = 1e-30j * np.eye(len(theta))
    return np.array([structure.system_matrix(theta + h).imag / 1e-30 for h in steps])


@pytest.mark.parametrize("outputs", ["position", "acceleration"])
def test_mechanical_derivatives_are_exact(outputs):
    mass = [["m1 + j", "j"], ["j", "m2"]]
    structure = MECHANICAL(mass, D2, K2, [["b"], [1]], outputs, sensors=[[1, 1]])
    assert not structure.is_affine
    theta = np.random.default_rng(0).uniform(0.5, 2.0, structure.n_params)
    J = structure.jacobian(theta)
    assert_allclose(J, complex_step(structure, theta), atol=1e-13)
    H = np.array(
        [
            (structure.jacobian(theta + h) - structure.jacobian(theta - h)) / 2e-5
            for h in 1e-5 * np.eye(len(theta))
        ]
    )
    assert_allclose(structure.curvature(theta), H, atol=1e-7)


@pytest.mark.parametrize("outputs", ["position", "velocity", "acceleration"])
def test_a_chain_of_masses_is_identifiable(outputs):
    structure = MECHANICAL(M2, D2, K2, [[1], [0]], outputs)
    theta = [VALUES[name] for name in structure.parameter_names]
    assert rank(structure, theta) == structure.n_params == 6
    free_force = MECHANICAL(M2, D2, K2, [["b"], [0]], outputs)
    theta = [{**VALUES, "b": 1.0}[name] for name in free_force.parameter_names]
    assert rank(free_force, theta) == 6  # a common factor remains open


def test_structures_without_a_guess_have_a_regular_reference():
    structure = MECHANICAL(M2, D2, K2, [[1], [0]])
    assert structure.initial is None
    assert np.isfinite(structure.system_matrix(structure.reference)).all()
    guessed = MECHANICAL(M2, D2, K2, [[1], [0]], initial=VALUES)
    assert_array_equal(guessed.reference, guessed.initial)
    theta = guessed.initial * np.linspace(1, 2, 3)[:, None]
    other = pickle.loads(pickle.dumps(guessed))
    assert_array_equal(other.system_matrix(theta), guessed.system_matrix(theta))


def test_a_pickle_is_the_same_to_a_memory():
    structure = MECHANICAL(M2, D2, K2, [[1], [0]])
    other = pickle.loads(pickle.dumps(structure))
    assert joblib.hash(other) == joblib.hash(structure)


def test_a_model_without_mass_is_refused():
    structure = MECHANICAL(M2, D2, K2, [[1], [0]])
    with pytest.raises(ValueError, match="`A` must be finite"):
        structure.model({**VALUES, "m1": 0.0})


@pytest.mark.parametrize(
    "change, message",
    [
        ({"M": [[1, 0]]}, r"`M` must have shape \(1, 1\)"),
        ({"M": [[1, 0], [0, 0]]}, "`M` must be regular: a coordinate without mass"),
        ({"M": [["m", "m"], ["m", "m"]]}, "`M` must be regular for some parameters"),
        ({"M": []}, "at least one coordinate and one input. Got 0 and 1"),
        ({"D": [[1]]}, r"`D` must have shape \(2, 2\)"),
        ({"D": []}, r"`D` must have shape \(2, 2\).*Got \(0, 0\)"),
        ({"K": [["k*k", 0], [0, 1]]}, r"`K\[0\]\[0\]` must be a number or an affine"),
        ({"F": [[1]]}, r"`F` must have shape \(2, 1\)"),
        ({"outputs": "force"}, "`outputs` must be 'position', 'velocity' or"),
        ({"sensors": [[1]]}, "`sensors` must have 2 columns"),
        ({"initial": {"m1": 1.0}}, "`initial` must have a value for each"),
        ({"parameter_names": ["m1"]}, "`parameter_names` must name each"),
    ],
)
def test_wrong_equations_of_motion_are_explained(change, message):
    arguments = {"M": M2, "D": D2, "K": K2, "F": [[1], [0]]} | change
    with pytest.raises(ValueError, match=message):
        MECHANICAL(**arguments)


@pytest.mark.parametrize(
    "mass, values",
    [
        ([["m1"]], {"m1": 0.0}),  # affine then
        ([["m1", 0], [0, "m2"]], {"m1": 0.0}),  # singular whatever m2 is
    ],
)
def test_a_coordinate_does_not_lose_its_mass(mass, values):
    n = len(mass)
    stiffness = [[f"k{i}" if i == j else 0 for j in range(n)] for i in range(n)]
    structure = MECHANICAL(mass, stiffness, stiffness, [[1]] * n)
    with pytest.raises(ValueError, match=r"`M` must be regular.* without mass"):
        structure.fix(values)
