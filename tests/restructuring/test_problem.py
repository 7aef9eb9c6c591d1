"""What is matched, behind weights, and what it tells of the parameters."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.models.statespace import DEVIATION
from lpvlearn.restructuring import estimator as estimator_module
from lpvlearn.restructuring.minimise_covariance import (
    minimise_covariance,
    uncertain_response,
)
from lpvlearn.restructuring.problem import (
    Identifiability,
    agreeing,
    problem_from_models,
)
from lpvlearn.restructuring.starts import Search

from ..conftest import spring_structure
from .conftest import CASES, disguised, far_fit, off_structure


def test_feedthrough_that_the_structure_lacks_is_reported():
    structure, params = CASES["spring_mass"]
    model = structure.model(params)
    black_box = StateSpace(model.A, model.B, model.C, [[0.25]])
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    np.testing.assert_array_equal(fitted.dropped_feedthrough_, [[0.25]])
    np.testing.assert_allclose(
        fitted.params_, structure.check_params(params), rtol=1e-6
    )


@pytest.mark.parametrize("kind", ["band", "scalar", "matrix"])
def test_weighted_error_is_the_norm_of_the_weighted_difference(kind, rough):
    black_box, plain = far_fit(2)
    low = StateSpace([[-2.0]], [[2.0]], [[1.0]])
    pair = StateSpace(-2 * np.eye(2), 2 * np.eye(2), np.diag([1.0, 0.1]))
    weight = {"band": (None, 2.0), "scalar": low, "matrix": pair}[kind]
    fitted = clone(plain).set_params(frequency_weight=weight).fit_model(black_box)
    omega = np.geomspace(1e-3, 1e3, 4000)
    E = (fitted.lti_ - black_box).frequency_response(omega)
    W = (pair if kind == "matrix" else low).frequency_response(omega)
    sigma = np.linalg.norm(W @ E if kind == "matrix" else W * E, 2, axis=(1, 2))
    assert np.isclose(fitted.error_, sigma.max(), rtol=1e-3)
    E = (plain.lti_ - black_box).frequency_response(omega)
    sigma = np.linalg.norm(W @ E if kind == "matrix" else W * E, 2, axis=(1, 2))
    assert fitted.error_ <= sigma.max() * (1 + 1e-6)


def test_one_weight_serves_all_measured_outputs():
    structure, params = CASES["two_masses"]
    omega = np.geomspace(0.1, 20, 40)
    G = structure.model(params).frequency_response(omega)
    square = StateSpace(-5 * np.eye(2), 5 * np.eye(2), np.eye(2))
    fits = [
        GrayBoxRestructurer(structure, frequency_weight=weight).fit(omega, G)
        for weight in ((None, 5.0), square)
    ]
    for fitted in fits:
        np.testing.assert_allclose(
            fitted.params_, structure.check_params(params), rtol=1e-6
        )


def test_weights_of_the_samples_decide_between_frequencies(rough):
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    omega = np.array([0.1, 0.2, 0.5, 20.0, 40.0])
    G = np.where(omega < 1, 1.0 / (1j * omega + 1), 3.0 / (1j * omega + 2))
    trusted = np.where(omega < 1, 1.0, 1e-6)
    fitted = GrayBoxRestructurer(structure).fit(omega, G, sample_weight=trusted)
    np.testing.assert_allclose(fitted.params_, [1.0, 1.0], rtol=1e-3)


def test_several_models_of_one_point_are_matched_together(rough):
    structure, params = CASES["spring_mass"]
    theta = structure.check_params(params)
    rng = np.random.default_rng(0)
    exact = structure.model(theta)
    same = GrayBoxRestructurer(structure).fit_model([exact, disguised(exact, rng)])
    np.testing.assert_allclose(same.params_, theta, rtol=1e-6)
    boxes = [off_structure(exact, rng, 5e-3) for _ in range(3)]
    fitted = GrayBoxRestructurer(structure).fit_model(boxes)
    omega = np.geomspace(0.01, 100, 20000)
    stacked = np.concatenate(
        [(fitted.lti_ - box).frequency_response(omega) for box in boxes], axis=1
    )
    assert np.isclose(
        fitted.error_, np.linalg.norm(stacked, 2, axis=(1, 2)).max(), rtol=1e-4
    )


def test_hankel_singular_value_bounds_the_error_from_below(rough):
    structure, params = CASES["spring_mass"]
    truth = structure.model(params)
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = truth.A, -4.0
    black_box = StateSpace(A, np.vstack([truth.B, [[1]]]), np.hstack([truth.C, [[1]]]))
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    hankel = black_box.hankel_singular_values()[2]
    assert fitted.lower_bound_ == hankel
    assert hankel <= fitted.error_


def test_table_and_complex_responses_are_the_same_data():
    structure, params = CASES["two_masses"]
    omega = np.geomspace(0.1, 30, 50)
    G = structure.model(params).frequency_response(omega)
    flat = G.reshape(50, -1)
    table = np.hstack([flat.real, flat.imag])
    one = GrayBoxRestructurer(structure).fit(omega[:, None], table)
    two = GrayBoxRestructurer(structure).fit(omega, G)
    np.testing.assert_array_equal(one.params_, two.params_)


# -- identifiability -----------------------------------------------------------

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
    return problem_from_models(structure, [model], None).identifiability(theta)


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


# -- how far the black box itself is known --------------------------------------------


def test_the_uncertainty_is_the_spread_of_the_response():
    gain = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    box, std = gain.model([2.0, 3.0]), 0.05
    step = DEVIATION * std
    pairs = [(gain.model([2.0, 3.0 + step]), gain.model([2.0, 3.0 - step]))]
    problem = problem_from_models(gain, [box], None)
    assert np.isclose(problem.uncertainty([], [(box, pairs)]), std / 3.0)
    half = problem.uncertainty([], [(box, pairs)] * 4)
    assert np.isclose(half, std / 3.0 / 2.0)
    runs = [gain.model([2.0, 3.0 + d]) for d in (-0.1, 0.0, 0.1)]
    assert np.isclose(problem.uncertainty(runs, []), 0.1 / np.sqrt(3) / 3.0)
    assert problem.uncertainty([box], []) == 0.0


def test_fits_end_where_two_agree_or_the_error_is_the_black_boxs_own():
    structure = spring_structure()
    box = structure.model([30.0, 1.2, 50.0])
    scale = np.linspace(0.9, 1.1, 9)[:, None]
    starts = structure.check_params({"b": 30.0, "c": 1.2, "k": 50.0}) * scale
    exact = problem_from_models(structure, [box], None)
    assert len(exact.best_fits(starts, 3)) == 1
    rng = np.random.default_rng(0)
    problem = problem_from_models(structure, [off_structure(box, rng, 3e-4)], None)
    fits = problem.best_fits(starts, 3)
    assert 1e-8 < fits[0].relative_error < 3e-3
    assert len(fits) == agreeing(fits) == 2
    assert len(problem.best_fits(starts, 3, enough=3e-3)) == 1


def test_a_fit_that_no_other_round_confirms_is_told(monkeypatch):
    structure = spring_structure()
    truth = structure.model([30.0, 1.2, 50.0])
    box = off_structure(truth, np.random.default_rng(0), 3e-4)

    def search(problem, *_):
        fit = problem.fit(structure.check_params({"b": 30.0, "c": 1.2, "k": 50.0}))
        other = fit._replace(cost=4 * fit.cost, relative_error=2 * fit.relative_error)
        return Search(problem, [fit, other], certain)

    monkeypatch.setattr(estimator_module, "starts_of", search)
    certain = False
    with pytest.warns(ConvergenceWarning, match="one round .* alone .* 1 of 2"):
        GrayBoxRestructurer(structure).fit_model(box)
    certain = True  # nothing is told
    GrayBoxRestructurer(structure).fit_model(box)


@pytest.mark.parametrize(
    "other",
    [
        StateSpace(-1.0, np.ones((1, 2)), 1.0),
        StateSpace(0.5, 1.0, 1.0, sampling_time=0.1),
    ],
)
def test_realizations_are_models_of_the_same_channels_and_time(other):
    box = spring_structure().model([30.0, 1.2, 50.0])
    with pytest.raises(
        ValueError, match="`realizations` must have 1 outputs, 1 inputs"
    ):
        GrayBoxRestructurer(spring_structure()).fit_model(
            box, realizations=[box, other]
        )


def two_lags(a, b):
    """Two lags in a row, whose order the response does not show."""
    structure = GrayBoxStructure.from_template(
        [["-a", 0], [1, "-b"]], [["g"], [0]], [[0, 1]]
    )
    theta = np.array([{"a": a, "b": b, "g": 1.0}[n] for n in structure.parameter_names])
    return problem_from_models(
        structure, [structure.model(theta).balance()], None
    ), theta


def realizations(model, size, count=12, seed=0):
    rng = np.random.default_rng(seed)
    blocks = [[getattr(model, M) for M in "ABC"] for _ in range(count)]
    return [
        StateSpace(*(M * (1 + size * rng.normal(size=M.shape)) for M in each))
        for each in blocks
    ]


def test_intervals_of_parts_that_are_nearly_alike_are_told():
    near, theta = two_lags(1.0, 1.05)
    far, apart = two_lags(1.0, 3.0)
    alike = 1e-3 * np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    assert near.structure.parameter_names == ("a", "b", "g")
    assert near.bent(theta, alike) == ["a", "b"]
    assert near.bent(theta, 1e9 * alike) == ["a", "b"]
    assert near.bent(theta, 1e-3 * alike) == []
    assert far.bent(apart, alike) == []
    assert near.bent(theta, np.zeros((3, 3))) == []
    # a bound that is a hair away leaves no step to tell by
    bounded = near.structure.with_bounds({"a": (1.0 - 1e-10, None)})
    box = near.structure.model(theta).balance()
    assert problem_from_models(bounded, [box], None).bent(theta, alike) == []


def test_fits_tell_of_intervals_that_are_not_linear():
    problem, theta = two_lags(1.0, 1.02)
    box = problem.model(theta).balance()
    fitted = GrayBoxRestructurer(problem.structure)
    known = {"starts": [theta], "search": False}
    with pytest.warns(UserWarning, match="intervals of 'a', 'b' are not to be trusted"):
        fitted.fit_model(box, realizations=realizations(box, 3e-3), **known)


def test_lags_that_have_met_take_their_part_of_the_errors():
    """Their squared difference is a column beside the derivatives."""
    problem, theta = two_lags(1.0, 1.0)
    changes = problem._changes(theta)
    assert changes.shape[-1] == 4
    s = 1j * problem.omega
    # 1 / ((s + 1 + x) (s + 1 - x)) bends with x^2 by 2 / (s + 1)^4
    np.testing.assert_allclose(changes[:, 0, 0, 3], 2 / (s + 1) ** 4, rtol=1e-5)
    moved = problem.parameter_changes(theta, changes[None, ..., 3], "hinf")
    np.testing.assert_allclose(moved, 0.0, atol=1e-9)
    apart, theta = two_lags(1.0, 1.1)
    assert apart._changes(theta).shape[-1] == 3


@pytest.mark.parametrize("norm", ["h2", "hinf", "covariance"])
def test_the_error_of_a_gain_is_that_beside_mean_and_square_of_two_lags(norm):
    """Parameters in which two lags that have met are no singular point."""
    problem, theta = two_lags(1.0, 1.0)
    regular = GrayBoxStructure.from_template(
        [["-m", "q"], [1, "-m"]], [["g"], [0]], [[0, 1]]
    )
    other = problem_from_models(regular, [problem.model(theta).balance()], None)
    names, values = regular.parameter_names, {"m": 1.0, "q": 0.0, "g": 1.0}
    there = np.array([values[name] for name in names])
    box = problem.model(theta).balance()
    if norm == "covariance":
        rng = np.random.default_rng(0)
        shifts = [
            [DEVIATION * 1e-2 * rng.normal(size=M.shape) for M in (box.A, box.B, box.C)]
            for _ in range(8)
        ]
        pairs = [
            tuple(
                StateSpace(box.A + s * a, box.B + s * b, box.C + s * c) for s in (1, -1)
            )
            for a, b, c in shifts
        ]
        estimate = uncertain_response(box, pairs, problem.omega)
        found = [
            minimise_covariance(p.system, x, p.margin, [estimate]).covariance
            for p, x in ((problem, theta), (other, there))
        ]
    else:
        runs = realizations(box, 1e-2)
        found = [
            p.spread_covariance(x, runs, norm)
            for p, x in ((problem, theta), (other, there))
        ]
    gain, expected = found[0][2, 2], found[1][names.index("g"), names.index("g")]
    assert np.isinf(found[0][[0, 1], [0, 1]]).all()
    np.testing.assert_allclose(gain, expected, rtol=2e-2)


def test_a_redundant_gain_bends_to_nothing_new():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    problem = problem_from_models(structure, [StateSpace(-1, 1, 6)], None)
    assert problem._changes(np.array([1.0, 2.0, 3.0])).shape[-1] == 3
    sums = GrayBoxStructure.from_template([["-a"]], [["b + c"]], [[1]])
    problem = problem_from_models(sums, [StateSpace(-1, 5, 1)], None)
    assert problem._changes(np.array([1.0, 2.0, 3.0])).shape[-1] == 3
