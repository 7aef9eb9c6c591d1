"""Geodesics of the response, charts of models, and canonical forms in them."""

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.restructuring.coordinates import (
    CanonicalForm,
    LocalChart,
    ResponseGeometry,
    View,
    real_form,
    row_space,
)
from lpvlearn.restructuring.error_system import ErrorSystem
from lpvlearn.restructuring.limits import Limits

from .conftest import SYSTEMS, stable_model, system_of, target_of


def weighted_response(system, theta, omega):
    """The response as one real vector, its norm the root mean square."""
    G = system.weight_response(omega)[0] @ system.response(theta, omega)
    return real_form(G).ravel() / np.sqrt(len(omega))


@pytest.mark.parametrize("case", SYSTEMS, ids=str)
def test_a_unit_step_changes_the_response_by_the_given_size(case):
    system, theta = system_of(**case)
    omega = system.grid
    geometry = ResponseGeometry(system, theta, omega, 1e-5)
    assert np.allclose(geometry.T @ geometry.inverse, np.eye(len(theta)), atol=1e-9)
    here = weighted_response(system, theta, omega)
    changes = [
        np.linalg.norm(weighted_response(system, theta + step, omega) - here)
        for step in geometry.T.T
    ]
    assert np.allclose(changes, 1e-5, rtol=1e-2)


@pytest.mark.parametrize("case", SYSTEMS, ids=str)
def test_the_response_turns_away_from_its_tangent_along_a_geodesic(case):
    """G'' along ``theta + T (h d + h^2 a / 2)`` has no tangential part."""
    system, theta = system_of(**case)
    omega = system.grid
    size = np.linalg.norm(weighted_response(system, theta, omega))
    geometry = ResponseGeometry(system, theta, omega, 0.1 * size)
    rng, h = np.random.default_rng(1), 1e-3

    def along(d, a, h):
        return weighted_response(
            system, theta + geometry.T @ (h * d + 0.5 * h * h * a), omega
        )

    for _ in range(3):
        d = rng.normal(size=len(theta))
        a = geometry.acceleration(d)
        tangential = []
        for bend in (0 * a, a):
            second = along(d, bend, h) - 2 * along(d, bend, 0) + along(d, bend, -h)
            J = geometry.changes.reshape(len(second), -1)
            tangential.append(np.linalg.norm(J.T @ second) / h**2)
        assert tangential[1] < 1e-3 * tangential[0]


def matrix_of(model):
    return np.block([[model.A, model.B], [model.C, model.D]])


def model_of(S, n, dt):
    return StateSpace(S[:n, :n], S[:n, n:], S[n:, :n], S[n:, n:], dt)


CASES = [
    {"n_inputs": 1, "n_outputs": 1},
    {"n_inputs": 2, "n_outputs": 1},
    {"n_inputs": 2, "n_outputs": 3},
    {"n_inputs": 1, "n_outputs": 2, "dt": 0.1},
    {"n_inputs": 1, "n_outputs": 2, "rate": 1e5},
    {"n_inputs": 1, "n_outputs": 2, "rate": 1e-4},
]


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("feedthrough", [False, True])
def test_a_chart_has_as_many_coordinates_as_models_have(case, feedthrough):
    """n (m + p) + m p, none of which leaves the transfer function unchanged."""
    model = stable_model(np.random.default_rng(0), 4, **case)
    m, p = case["n_inputs"], case["n_outputs"]
    chart = LocalChart(matrix_of(model), 4, model.sampling_time, feedthrough)
    assert chart.n_params == 4 * (m + p) + feedthrough * m * p
    top = case.get("rate", 1.0) * 10
    omega = np.geomspace(top / 1e4, top, 60)
    if model.sampling_time:
        omega = np.linspace(0.1, 30, 60)
    origin = model_of(chart.system_matrix(np.zeros(chart.n_params)), 4, case.get("dt"))
    G = model.frequency_response(omega)
    assert np.allclose(origin.frequency_response(omega), G, rtol=1e-9)
    system = ErrorSystem(chart, target_of(model))
    J = system.response_jacobian(np.zeros(chart.n_params), omega)[1]
    J = J.reshape(-1, chart.n_params)
    s = np.linalg.svd(np.vstack([J.real, J.imag]), compute_uv=False)
    assert s[-1] > 1e-6 * s[0]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_parameters_of_a_canonical_form_are_found_again(case):
    rng = np.random.default_rng(1)
    model = stable_model(rng, 5, **case)
    structure = GrayBoxStructure.observable_canonical(
        5, case["n_inputs"], case["n_outputs"]
    )
    dt = case.get("dt")
    form = CanonicalForm(structure, dt)
    theta = form.parameters(matrix_of(model))
    size = np.abs(np.linalg.eigvals(model.A)).max() if dt is None else 10.0
    omega = np.geomspace(0.1 * size, 3 * size, 9)
    found = structure.model(theta, sampling_time=dt).frequency_response(omega)
    assert np.allclose(found, model.frequency_response(omega), rtol=1e-6)


def system_with(structure, order=3, seed=2):
    box = stable_model(
        np.random.default_rng(seed), order, structure.n_inputs, structure.n_outputs
    )
    return ErrorSystem(structure, target_of(box))


def test_canonical_forms_are_told_from_other_structures():
    observable = GrayBoxStructure.observable_canonical(2, 1, 1)
    controllable = GrayBoxStructure.from_template(
        [[0, 1], ["-a0", "-a1"]], [[0], [1]], [["b0", "b1"]]
    )
    spring = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    )
    full = GrayBoxStructure.full(2, 1, 1, feedthrough=False)
    # as many parameters as a canonical form, but not every model has its gain
    chain = GrayBoxStructure.from_template(
        [["a", "b"], ["c", "-a"]], [[1], [0]], [["d", 0]]
    )
    values = {
        "a0": 2.0, "a1": 0.5, "b0": 1.0, "b1": 0.3, "k": 2.0, "c": -0.5, "b": 1.0
    }  # fmt: skip

    def form_of(structure):
        system = system_with(structure)
        theta = np.array([values.get(n, 0.7) for n in structure.parameter_names])
        return CanonicalForm.of(system, theta)

    assert form_of(controllable) is not None
    assert form_of(spring) is None
    assert form_of(full) is None
    assert form_of(chain) is None
    assert form_of(observable) is not None
    assert (
        form_of(observable.with_bounds({observable.parameter_names[0]: (0, 9)})) is None
    )
    assert form_of(observable.fix({observable.parameter_names[0]: -1.0})) is None


def test_a_view_and_its_point_are_the_same_model():
    structure = GrayBoxStructure.observable_canonical(4, 2, 2)
    rng = np.random.default_rng(3)
    model = stable_model(rng, 4, 2, 2)
    system = ErrorSystem(structure, target_of(stable_model(rng, 6, 2, 2)))
    theta = CanonicalForm(structure, None).parameters(matrix_of(model))
    form = CanonicalForm.of(system, theta)
    plain = View.of(system, theta, Limits(system, 1e-3), form)
    assert plain.back().theta is theta
    view = plain.centred()
    assert view.system is not system
    assert np.allclose(view.back().theta, theta, rtol=1e-6)
    moved = view.at(1e-3 * rng.normal(size=len(theta)))
    norm = moved.system.peaks(moved.theta).norm
    assert np.isclose(system.peaks(moved.back().theta).norm, norm, rtol=1e-8)
    again = moved.centred()  # another chart, of the same model
    assert not again.theta.any()
    assert np.isclose(again.system.peaks(again.theta).norm, norm, rtol=1e-10)


def test_all_canonical_forms_of_one_order_end_at_the_same_norm():
    """Reduction of a model of order 6 to 4: the forms hold the same models."""
    box = stable_model(np.random.default_rng(7), 6, 1, 1)
    A = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [f"-a{i}" for i in range(4)]]
    controllable = GrayBoxStructure.from_template(
        A, [[0], [0], [0], [1]], [[f"b{i}" for i in range(4)]]
    )
    observable = GrayBoxStructure.observable_canonical(4)
    errors = [
        GrayBoxRestructurer(s).fit_model(box).error_ for s in (controllable, observable)
    ]
    assert np.isclose(*errors, rtol=1e-6)
    bound = box.hankel_singular_values()[4]
    assert min(errors) >= bound * (1 - 1e-9)


def test_units_of_outputs_cost_a_canonical_form_no_digits():
    rng = np.random.default_rng(6)
    A, unit = rng.standard_normal((5, 5)), np.array([1e-5, 1.0, 1e6])
    B, C = rng.standard_normal((5, 2)), rng.standard_normal((3, 5))
    A, D = A - 3.0 * np.eye(5), np.zeros((3, 2))
    structure = GrayBoxStructure.observable_canonical(5, 2, 3)
    form = CanonicalForm(structure, None)
    plain = form.parameters(np.block([[A, B], [C, D]]))
    other = form.parameters(np.block([[A, B], [unit[:, None] * C, D]]))
    ours, theirs = structure.model(plain), structure.model(other)
    T = np.diag(1.0 / np.repeat(unit, [2, 2, 1]))  # outputs and their rates
    back = theirs.transform(T)
    np.testing.assert_allclose(back.A, ours.A, rtol=0, atol=1e-11 * abs(ours.A).max())
    np.testing.assert_allclose(back.B, ours.B, rtol=0, atol=1e-11 * abs(ours.B).max())


def test_a_model_that_is_not_minimal_has_no_chart():
    model = StateSpace(np.diag([-1.0, -2.0]), [[1.0], [0.0]], [[1.0, 1.0]])
    with pytest.raises(ValueError, match="not minimal"):
        LocalChart(matrix_of(model), 2, None, False)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_canonical_form_of_many_states_keeps_digits_that_it_holds(seed):
    """In errors that a unit in the last place of its entries makes."""
    box = stable_model(np.random.default_rng(seed), 12, 1, 1)
    structure = GrayBoxStructure.observable_canonical(12, 1, 1)
    system = ErrorSystem(structure, target_of(box))
    form = CanonicalForm(structure, None)
    found = form.parameters(matrix_of(box))
    refined = form.refined(matrix_of(box), system.grid)
    found_error, error = (
        np.abs(system.weighted_error(theta, system.grid)).max()
        for theta in (found, refined)
    )
    assert error < 1e4 * system.rounding(refined) < found_error


@pytest.mark.parametrize("kind, digits", [("chain", 1e-13), ("stiff", 1e-10)])
def test_resolvents_of_one_matrix_span_few_dimensions(kind, digits):
    """As far as the inverse of a matrix of condition 1e6 has digits."""
    n = 16
    A = -np.eye(n) + np.eye(n, k=1)  # one eigenvector
    if kind == "stiff":
        mixing = np.random.default_rng(0).normal(size=(n, n))
        A = np.linalg.solve(mixing, -np.geomspace(1e-2, 1e4, n)[:, None] * mixing)
    omega = np.geomspace(1e-3, 1e5, 120)
    Phi = np.linalg.inv(1j * omega[:, None, None] * np.eye(n) - A)
    rows = np.concatenate([Phi.real, Phi.imag]).reshape(-1, n * n)
    span = row_space(rows, n)
    assert span.shape[1] < n**2 / 4
    assert np.abs(rows @ span @ span.T - rows).max() < digits * np.abs(rows).max()
