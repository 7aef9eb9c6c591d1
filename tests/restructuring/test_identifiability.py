"""Which parameters a response determines."""

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.exceptions import RankWarning
from lpvlearn.restructuring.identifiability import Identifiability
from lpvlearn.restructuring.problem import problem_from_models
from lpvlearn.restructuring.uncertainty import ParameterUncertainty

from ..conftest import spring_structure

OMEGA = np.array([0.1, 0.5, 1.0, 2.0, 3.0, 9.0])


def response_jacobian(structure, theta, omega=OMEGA):
    """Derivative of the response by central differences."""
    theta = np.asarray(theta, dtype=float)
    columns = []
    for step in np.diag(1e-6 * np.maximum(np.abs(theta), 1e-3)):
        ahead = structure.model(theta + step).frequency_response(omega)
        behind = structure.model(theta - step).frequency_response(omega)
        columns.append((ahead - behind) / (2 * step.max()))
    return np.moveaxis(columns, 0, -1)


def exact_jacobian(structure, theta, omega=OMEGA):
    """``dG = dC X B + C X dA X B + C X dB + dD`` with ``X = (j omega - A)^-1``."""
    theta = np.asarray(theta, dtype=float)
    A, B, C, _ = structure.matrices(theta)
    n = structure.order
    X = np.linalg.inv(1j * omega[:, None, None] * np.eye(n) - A)
    p, m = structure.n_outputs, structure.n_inputs
    left = np.concatenate([C @ X, np.broadcast_to(np.eye(p), (len(omega), p, p))], 2)
    right = np.concatenate([X @ B, np.broadcast_to(np.eye(m), (len(omega), m, m))], 1)
    return np.einsum("kia,qab,kbj->kijq", left, structure.jacobian(theta), right)


def test_the_exact_jacobian_is_the_difference():
    structure = GrayBoxStructure.full(2, 2, 1)
    theta = np.random.default_rng(0).normal(size=structure.n_params)
    exact = exact_jacobian(structure, theta)
    scale = np.abs(exact).max()
    error = np.abs(exact - response_jacobian(structure, theta)).max()
    assert error < 1e-7 * scale


def analysis(structure, theta, omega=OMEGA):
    J = exact_jacobian(structure, theta, omega) * np.abs(theta)
    G = structure.model(theta).frequency_response(omega)
    level = np.linalg.norm(G, axis=(1, 2))
    return Identifiability.from_jacobian(J, structure.parameter_names, level)


def test_a_spring_is_identifiable():
    found = analysis(spring_structure(), [2.0, 0.5, 4.0])
    assert found.rank == found.n_params == 3 and found.directions == ()
    assert 1 < found.condition < 100
    assert "all 3 parameters are identifiable" in str(found)


def test_a_product_of_gains_is_named():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    found = analysis(structure, [1.0, 3.0, -0.2])
    assert found.rank == 2 and found.condition > 1e9
    (direction,) = found.directions
    # b grows as c, which is negative, falls in size
    assert set(direction) == {"b", "c"}
    assert direction["b"] == pytest.approx(direction["c"])
    assert "determines 2 of the 3 parameters" in str(found)
    assert "+1 b +1 c" in str(found)


def test_independent_products_are_named_apart():
    structure = GrayBoxStructure.from_template(
        [["-a", 0], [0, "-2*a"]], [["b", 0], [0, "e"]], [["c", 0], [0, "f"]]
    )
    found = analysis(structure, [1.0, 3.0, 0.2, 5.0, 7.0])
    assert found.rank == 3
    names = {frozenset(direction) for direction in found.directions}
    assert names == {frozenset("bc"), frozenset("ef")}


def test_a_parameter_without_effect_is_named_alone():
    structure = GrayBoxStructure.from_template(
        [["-a", 0], [0, "-q"]], [["b"], [0]], [[1, 1]]
    )
    found = analysis(structure, [1.0, 3.0, 0.2])
    assert found.rank == 2 and found.directions == ({"q": 1.0},)
    assert found.condition == np.inf


def test_too_few_frequencies_leave_combinations_open():
    structure = GrayBoxStructure.observable_canonical(2)
    theta = [-4.0, -0.5, 1.0, 2.0]
    assert analysis(structure, theta).rank == 4
    found = analysis(structure, theta, OMEGA[:1])
    assert found.rank == 2 and len(found.directions) == 2


@pytest.mark.parametrize("order, n_inputs, n_outputs", [(2, 1, 1), (3, 2, 2)])
def test_a_full_structure_leaves_the_basis_open(order, n_inputs, n_outputs):
    structure = GrayBoxStructure.full(order, n_inputs, n_outputs)
    theta = np.random.default_rng(order).normal(size=structure.n_params)
    found = analysis(structure, theta, np.linspace(0.1, 9, 30))
    assert structure.n_params - found.rank == order**2 == len(found.directions)


def identified(structure, theta):
    model = structure.model(theta)
    problem = problem_from_models(structure, [model], None)
    return ParameterUncertainty(problem, theta).identifiability()


def test_units_of_the_parameters_and_of_time_do_not_matter():
    theta = np.array([-4.0, -0.5, 1.0, 2.0])
    one = identified(GrayBoxStructure.observable_canonical(2), theta)
    unit = [["1e-9*a", "1e9*b"], ["1e3*c", "d"]]
    scaled = GrayBoxStructure.from_template(
        [[0, 1e6], [f"1e6*{unit[0][0]}", f"1e6*{unit[0][1]}"]],
        [[unit[1][0]], [unit[1][1]]],
        [[1e6, 0]],
    )
    other = identified(scaled, theta * [1e9, 1e-9, 1e-3, 1.0])
    assert one.rank == other.rank == 4
    assert other.condition == pytest.approx(one.condition)
    gains = list(one.sensitivities.values())
    assert list(other.sensitivities.values()) == pytest.approx(gains)
    assert max(gains) <= one.condition <= np.linalg.norm(gains)


@pytest.mark.parametrize("faint", [1e-2, 1e-5])
def test_a_faint_parameter_has_the_condition_of_its_effect(faint):
    """1 / (s + a) + faint / (s + b): errors of the response grow by 1 / faint."""
    structure = GrayBoxStructure.from_template(
        [["-a", 0], [0, "-b"]], [[1], [1]], [[1, faint]]
    )
    found = identified(structure, np.array([1.0, 3.0]))
    assert found.rank == 2
    assert 1 < found.sensitivities["a"] < 10
    assert 1 < found.condition * faint < 100
    assert found.sensitivities["b"] == pytest.approx(found.condition, rel=0.1)
    assert f"(condition {found.condition:.2g}, most that of b)" in str(found)


def test_a_zero_that_the_response_is_linear_in_is_determined():
    structure = GrayBoxStructure.observable_canonical(2)
    one, other = (
        identified(structure, np.array([-4.0, -1.0, zero, 1.0]))
        for zero in (0.0, -1e-15)
    )
    assert one.condition == pytest.approx(other.condition, rel=1e-6)
    assert one.condition < 100


@pytest.mark.parametrize("order", [7, 8, 12])
def test_a_canonical_form_of_any_order_is_identifiable(order):
    rng = np.random.default_rng(order)
    w, z = 10 ** rng.uniform(-1, 1.5, order // 2), 10 ** rng.uniform(-2, 0, order // 2)
    poles = w * (-z + 1j * np.sqrt(1 - z * z))
    a = np.real(np.poly([*poles, *poles.conj(), *[-1.0] * (order % 2)]))[1:]
    b = rng.normal(size=order) * w.max() ** np.arange(1, order + 1)
    structure = GrayBoxStructure.observable_canonical(order)
    found = identified(structure, np.r_[-a[::-1], b])
    assert found.rank == 2 * order and found.directions == ()


@pytest.mark.parametrize("seed", [0, 3, 11])
def test_a_high_condition_is_no_deficiency(seed):
    """Coefficients that are recovered are determined; those of one state more are not.

    Singular values go down to 3e-14 here, and to 1e-16 there.
    """
    rng = np.random.default_rng(seed)
    n = 7 + seed % 2
    A = rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(n)
    box = StateSpace(A, rng.normal(size=(n, 1)), rng.normal(size=(1, n)))
    fitted = GrayBoxRestructurer().fit_model(box)
    found = fitted.identifiability_
    a = dict(zip(fitted.structure_.parameter_names, fitted.params_, strict=True))
    exact = np.poly(A)[:0:-1]
    recovered = [-a[f"a{n}_{j + 1}"] for j in range(n)]
    np.testing.assert_allclose(recovered, exact, rtol=1e-6)
    assert found.rank == found.n_params and 1e8 < found.condition < 1e13
    more = GrayBoxStructure.observable_canonical(n + 1)
    with pytest.warns(RankWarning, match="does not change along"):
        found = GrayBoxRestructurer(more).fit_model(box).identifiability_
    assert found.rank == 2 * n + 1


def test_a_common_factor_shows_all_its_names():
    structure = GrayBoxStructure.mechanical(
        M=[["m1", 0], [0, "m2"]],
        D=[["c", 0], [0, "c"]],
        K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
        F=[["f"], [0]],
    )
    values = {"m1": 1.0, "m2": 2.0, "c": 3e-3, "k1": 1e5, "k2": 8e4, "f": 1e-3}
    theta = np.array([values[name] for name in structure.parameter_names])
    found = identified(structure, theta)
    assert found.condition == np.inf
    (direction,) = found.directions
    assert direction == pytest.approx(dict.fromkeys(structure.parameter_names, 1.0))
