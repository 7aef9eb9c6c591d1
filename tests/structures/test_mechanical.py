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


# -------------------------------------------------------- momenta and descriptor forms


def as_momenta(values):
    """T from coordinates and rates to coordinates and momenta."""
    return np.diag([1, 1, values["m1"], values["m2"]])


@pytest.mark.parametrize("outputs", ["position", "velocity"])
def test_momenta_are_another_basis_of_the_same_frozen_models(outputs):
    rates, momenta = (
        MECHANICAL(M2, D2, K2, UNIT, outputs, state=state)
        for state in ("rate", "momentum")
    )
    assert momenta.parameter_names == rates.parameter_names
    expected = rates.model(VALUES).transform(as_momenta(VALUES))
    found = momenta.model(VALUES)
    for block in "ABCD":
        assert_allclose(getattr(found, block), getattr(expected, block), atol=1e-14)
    fixed = momenta.fix({"m1": 1.5, "m2": 0.4})
    assert fixed.is_affine
    rest = {name: VALUES[name] for name in fixed.parameter_names}
    assert_allclose(fixed.model(rest).A, found.A)
    partly = momenta.fix({"m1": 1.5})
    rest = {name: VALUES[name] for name in partly.parameter_names}
    assert_allclose(partly.model(rest).A, found.A)


def test_a_known_mass_gives_an_affine_structure_of_momenta():
    structure = MECHANICAL([[2.0]], [["c"]], [["k"]], [[1]], state="momentum")
    assert structure.is_affine and structure.implicit is None
    assert_array_equal(structure.model([3.0, 5.0]).A, [[0, 0.5], [-5, -1.5]])


def test_searches_begin_in_the_equations_of_motion_in_either_state():
    rates, momenta = (
        MECHANICAL(M2, D2, K2, [[1], [0]], state=state)
        for state in ("rate", "momentum")
    )
    assert_array_equal(momenta.reference, rates.reference)
    gains = np.array([[0.1], [0.2]])
    assert_array_equal(
        momenta.implicit.natural_sizes(3.0, gains),
        rates.implicit.natural_sizes(3.0, gains),
    )


def test_natural_sizes_make_all_terms_of_an_equation_alike():
    # m x'' = -c x' - k x + u, where x is `gain` of u and moves at `rate`
    rate, gain = 3e5, 2e-7
    alike = {"c": 1.0 / (gain * rate), "k": 1.0 / gain, "m": 1.0 / (gain * rate**2)}
    by_motion = MECHANICAL([["m"]], [["c"]], [["k"]], [[1]])
    by_cells = GrayBoxStructure.from_template(
        E=[[1, 0], [0, "m"]],
        A=[[0, 1], ["-k", "-c"]],
        B=[[0], [1]],
        C=[[1, 0]],
    )
    for structure in (by_motion, by_cells):
        found = structure.implicit.natural_sizes(rate, np.array([[gain]]))
        expected = [alike[name] for name in structure.parameter_names]
        assert_allclose(found, expected, rtol=1e-9)


def test_the_unit_of_an_output_moves_the_natural_size_of_its_sensor_alone():
    structure = GrayBoxStructure.from_template(
        E=[["Ca", 0], [0, "Cw"]],
        A=[["-g - v", "g"], ["g", "-g - w"]],
        B=[["a", "v"], [0, "w"]],
        C=[[1, 0], [0, "s"]],
    )
    gains = np.array([[2.0, 0.1], [0.4, 0.3]])
    first = structure.implicit.natural_sizes(1e-3, gains)
    gains[1] *= 1e4
    expected = first * np.where(np.array(structure.parameter_names) == "s", 1e4, 1.0)
    assert_allclose(structure.implicit.natural_sizes(1e-3, gains), expected, rtol=1e-9)


@pytest.mark.parametrize("state", ["rate", "momentum"])
def test_stacked_outputs_are_those_of_the_same_equations(state):
    structure = MECHANICAL(M2, D2, K2, [[1], [0]], state=state)
    stacked = structure.with_stacked_outputs(3)
    assert_array_equal(stacked.reference, structure.reference)
    theta, n = structure.reference * np.linspace(1.0, 2.0, 6), structure.order
    for name in ("system_matrix", "jacobian", "curvature"):
        S, T = getattr(structure, name)(theta), getattr(stacked, name)(theta)
        assert_allclose(T[..., :n, :], S[..., :n, :], rtol=1e-12, atol=1e-12)
        outputs = np.concatenate([S[..., n:, :]] * 3, axis=-2)
        assert_allclose(T[..., n:, :], outputs, rtol=1e-12, atol=1e-12)
    gains = np.array([[0.1], [0.2]])
    assert_allclose(
        stacked.implicit.natural_sizes(3.0, np.tile(gains, (3, 1))),
        structure.implicit.natural_sizes(3.0, gains),
    )
    assert not stacked.free_feedthrough.any()
    assert np.isfinite(stacked.fix({"m1": 1.5}).reference).all()


E_, A_ = [["m + j", "j"], ["j", 2]], [["-a", 1], ["-j", "-2*b"]]
B_, C_ = [["g"], [1]], [["c", 1], [0, 1], ["j", 0]]


@pytest.mark.parametrize("descriptor", ["rate", "flux"])
def test_descriptor_equations_are_solved_for_their_state(descriptor):
    structure = GrayBoxStructure.from_template(
        A_, B_, C_, [["g"], [0], [0]], E=E_, descriptor=descriptor
    )
    v = {"a": 1.5, "b": 0.3, "c": 2.0, "g": 0.7, "j": 0.4, "m": 3.0}
    E = np.array([[3.4, 0.4], [0.4, 2.0]])
    A, B = np.array([[-1.5, 1], [-0.4, -0.6]]), np.array([[0.7], [1]])
    C = np.array([[2.0, 1], [0, 1], [0.4, 0]])
    inverse = np.linalg.inv(E)
    model = structure.model(v)
    if descriptor == "rate":
        expected = inverse @ A, inverse @ B, C
    else:
        expected = A @ inverse, B, C @ inverse
    for found, block in zip((model.A, model.B, model.C), expected, strict=True):
        assert_allclose(found, block, atol=1e-14)
    assert_allclose(model.D, [[0.7], [0], [0]])
    theta = np.array([v[name] for name in structure.parameter_names])
    J = structure.jacobian(theta)
    assert_allclose(J, complex_step(structure, theta), atol=1e-13)
    H = np.array(
        [
            (structure.jacobian(theta + h) - structure.jacobian(theta - h)) / 2e-5
            for h in 1e-5 * np.eye(len(theta))
        ]
    )
    assert_allclose(structure.curvature(theta), H, atol=1e-7)
    copy = pickle.loads(pickle.dumps(structure))
    assert_array_equal(copy.system_matrix(theta), structure.system_matrix(theta))


@pytest.mark.parametrize("descriptor", ["rate", "flux"])
def test_without_parameters_in_it_e_leaves_the_structure_affine(descriptor):
    template = GrayBoxStructure.from_template([["-a"]], [[3]], [["c"]])
    structure = GrayBoxStructure.from_template(
        [["-2*a"]], [[6]], [["c"]], E=[[2]], descriptor=descriptor
    )
    assert structure.is_affine
    theta = {"a": 0.7, "c": 5.0}
    found, expected = structure.model(theta), template.model(theta)
    assert_allclose(found.frequency_response(OMEGA), expected.frequency_response(OMEGA))
    assert_allclose(found.C, 5.0 if descriptor == "rate" else 2.5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"E": [[1, 0]]}, r"`E` must have shape \(1, 1\) to fit `A`"),
        ({"E": [[0]]}, "`E` must be regular"),
        ({"E": [["m*m"]]}, r"`E\[0\]\[0\]` must be a number or an affine"),
        ({"E": [["m"]], "descriptor": "momentum"}, "`descriptor` must be 'rate' or"),
    ],
)
def test_descriptor_equations_that_do_not_fit_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        GrayBoxStructure.from_template([["-a"]], [[1]], [[1]], **options)


def test_states_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="`state` must be 'rate' or 'momentum'"):
        MECHANICAL([["m"]], [[0]], [["k"]], [[1]], state="velocity")
    with pytest.raises(ValueError, match="no function of the momenta"):
        MECHANICAL([["m"]], [[0]], [["k"]], [[1]], "acceleration", state="momentum")
    with pytest.raises(ValueError, match="`M` must be regular"):
        MECHANICAL([[0]], [[0]], [["k"]], [[1]], state="momentum")
