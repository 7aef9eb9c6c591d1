"""Modal and mechanical structures: limit cases, derivatives, identifiability."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.identifiability import Identifiability

OMEGA = np.geomspace(0.05, 50.0, 40)
MODAL = GrayBoxStructure.modal
MECHANICAL = GrayBoxStructure.mechanical


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


def complex_step(structure, theta):
    steps = 1e-30j * np.eye(len(theta))
    return np.array([structure.system_matrix(theta + h).imag / 1e-30 for h in steps])


# -- modal -----------------------------------------------------------------------


def modal_parameters(model, structure, normalize):
    """Parameters of the modal form of a model, by eigenvectors alone."""
    poles, V = np.linalg.eig(model.A)
    Bt, Ct = np.linalg.solve(V, model.B), model.C @ V
    values = {}
    pairs = [i for i in range(len(poles)) if poles[i].imag > 0]
    reals = [i for i in range(len(poles)) if poles[i].imag == 0]
    n_modes = (structure.order - len(reals)) // 2
    assert n_modes == len(pairs)
    for k, i in enumerate(pairs):
        values[f"w2_{k + 1}"] = abs(poles[i]) ** 2
        values[f"d_{k + 1}"] = -2 * poles[i].real
        # companion block: right eigenvector [1, lambda]; scaled by a complex number
        lam = poles[i]
        V0 = np.array([[1, 1], [lam, lam.conj()]])
        if normalize == "input":  # V0 diag(s) Bt = [0, 1] for the first input
            s = np.linalg.solve(V0, [0, 1])[0] / Bt[i, 0]
        else:  # Ct diag(1/s) V0^-1 = [1, 0] for the first output
            s = Ct[0, i] / 1.0
        b, c = s * Bt[i], Ct[:, i] / s
        B2 = (V0 @ np.array([b, b.conj()])).real
        C2 = (np.stack([c, c.conj()], 1) @ np.linalg.inv(V0)).real
        for row in range(2):
            for j in range(model.n_inputs):
                values[f"b{2 * k + row + 1}_{j + 1}"] = B2[row, j]
            for j in range(model.n_outputs):
                values[f"c{j + 1}_{2 * k + row + 1}"] = C2[j, row]
    for k, i in enumerate(reals):
        s = 1 / Bt[i, 0].real if normalize == "input" else Ct[0, i].real
        values[f"r_{k + 1}"] = -poles[i].real
        state = 2 * n_modes + k + 1
        for j in range(model.n_inputs):
            values[f"b{state}_{j + 1}"] = s * Bt[i, j].real
        for j in range(model.n_outputs):
            values[f"c{j + 1}_{state}"] = Ct[j, i].real / s
    for i, j in np.ndindex(model.D.shape):
        values[f"d{i + 1}_{j + 1}"] = model.D[i, j]
    return np.array([values[name] for name in structure.parameter_names])


@pytest.mark.parametrize("normalize", ["input", "output"])
@pytest.mark.parametrize(
    "n_modes, n_real, m, p, feedthrough",
    [(1, 0, 1, 1, False), (2, 0, 2, 3, False), (1, 2, 2, 2, True), (0, 1, 1, 2, False)],
)
def test_modal_form_holds_every_diagonalizable_model(
    n_modes, n_real, m, p, feedthrough, normalize
):
    rng = np.random.default_rng(n_modes + 10 * n_real)
    n = 2 * n_modes + n_real
    A = np.zeros((n, n))
    for i in range(n_modes):
        s, w = rng.uniform(0.1, 1), rng.uniform(1, 9)
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[-s, w], [-w, -s]]
    for i in range(2 * n_modes, n):
        A[i, i] = -rng.uniform(0.2, 5)
    D = rng.normal(size=(p, m)) * feedthrough
    model = StateSpace(A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), D)
    model = model.transform(rng.normal(size=(n, n)))
    structure = MODAL(n_modes, m, p, n_real, feedthrough, normalize=normalize)
    assert structure.n_params == n * (m + p) + D.size * feedthrough
    theta = modal_parameters(model, structure, normalize)
    G = model.frequency_response(OMEGA)
    error = structure.model(theta).frequency_response(OMEGA) - G
    assert np.abs(error).max() < 1e-10 * np.abs(G).max()
    assert rank(structure, theta) == structure.n_params


def test_modal_parameters_are_poles():
    structure = MODAL(1, n_real=1)
    theta = dict.fromkeys(structure.parameter_names, 1.0)
    poles = structure.model(theta | {"w2_1": 9.0, "d_1": 0.5, "r_1": 7.0}).poles()
    assert_allclose(np.prod(poles[:2]).real, 9.0)
    assert_allclose(poles[:2].sum().real, -0.5)
    assert_allclose(poles[2], -7.0)


@pytest.mark.parametrize(
    "arguments, options, message",
    [
        ((0,), {}, "`n_modes` or `n_real` must be at least 1"),
        ((-1,), {}, "`n_modes` must be an integer"),
        ((1, 0), {}, "`n_inputs` must be an integer"),
        ((1, 1, 1.5), {}, "`n_outputs` must be an integer"),
        ((1, 1, 1, -2), {}, "`n_real` must be an integer"),
        ((1,), {"normalize": "both"}, "`normalize` must be 'input' or 'output'"),
    ],
)
def test_wrong_modal_forms_are_explained(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        MODAL(*arguments, **options)


# -- mechanical ------------------------------------------------------------------

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
