"""What the errors of a response do to the parameters."""

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.models.statespace import DEVIATION
from lpvlearn.restructuring.minimise_covariance import (
    minimise_covariance,
    uncertain_response,
)
from lpvlearn.restructuring.problem import problem_from_models
from lpvlearn.restructuring.uncertainty import ParameterUncertainty


def test_a_bound_that_holds_one_parameter_tells_the_other():
    product = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    bounded = product.with_bounds({"b": (3.0, None)})
    problem = problem_from_models(bounded, [StateSpace(-2, 3, 1)], None)
    held, free = np.array([2.0, 3.0, 1.0]), np.array([2.0, 6.0, 0.5])
    assert not ParameterUncertainty(problem, held).open_variances().any()
    variances = ParameterUncertainty(problem, free).open_variances()
    np.testing.assert_allclose(np.diag(variances), [0.0, np.inf, np.inf])


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_changes_of_parameters_do_not_depend_on_units(norm):
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-d"]], [[0], ["g"]], [[1, 0]]
    )
    factor = 1.0 + 1e-6 * np.array([1.0, -2.0, 3.0])
    for gain in (1.0, 1e17):
        theta = structure.check_params({"k": 1.0, "d": 0.1, "g": gain})
        problem = problem_from_models(structure, [structure.model(theta)], None)
        moved = problem.response_of(structure.model(theta * factor))
        dG = (moved - problem.response)[None]
        (change,) = ParameterUncertainty(problem, theta).changes(dG, norm)
        np.testing.assert_allclose(change / theta, factor - 1.0, rtol=1e-2)


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
    problem, theta = two_lags(1.0, 1.05)
    near = ParameterUncertainty(problem, theta)
    far = ParameterUncertainty(*two_lags(1.0, 3.0))
    alike = 1e-3 * np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    assert problem.structure.parameter_names == ("a", "b", "g")
    assert near.not_linear(alike) == ["a", "b"]
    assert near.not_linear(1e9 * alike) == ["a", "b"]
    assert near.not_linear(1e-3 * alike) == []
    assert far.not_linear(alike) == []
    assert near.not_linear(np.zeros((3, 3))) == []
    # a bound that is a hair away leaves no step to tell by
    bounded = problem.structure.with_bounds({"a": (1.0 - 1e-10, None)})
    held = problem_from_models(bounded, [problem.model(theta).balance()], None)
    assert ParameterUncertainty(held, theta).not_linear(alike) == []


@pytest.mark.filterwarnings("ignore:the values of")
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
    met = ParameterUncertainty(problem, theta)
    changes = met._columns
    assert changes.shape[-1] == 4
    s = 1j * problem.omega
    # 1 / ((s + 1 + x) (s + 1 - x)) bends with x^2 by 2 / (s + 1)^4
    np.testing.assert_allclose(changes[:, 0, 0, 3], 2 / (s + 1) ** 4, rtol=1e-5)
    moved = met.changes(changes[None, ..., 3], "hinf")
    np.testing.assert_allclose(moved, 0.0, atol=1e-9)
    apart = ParameterUncertainty(*two_lags(1.0, 1.1))
    assert apart._columns.shape[-1] == 3


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
            ParameterUncertainty(p, x).covariance_of_runs(runs, norm)
            for p, x in ((problem, theta), (other, there))
        ]
    gain, expected = found[0][2, 2], found[1][names.index("g"), names.index("g")]
    assert np.isinf(found[0][[0, 1], [0, 1]]).all()
    np.testing.assert_allclose(gain, expected, rtol=2e-2)


def test_a_redundant_gain_bends_to_nothing_new():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    theta = np.array([1.0, 2.0, 3.0])
    problem = problem_from_models(structure, [StateSpace(-1, 1, 6)], None)
    assert ParameterUncertainty(problem, theta)._columns.shape[-1] == 3
    sums = GrayBoxStructure.from_template([["-a"]], [["b + c"]], [[1]])
    problem = problem_from_models(sums, [StateSpace(-1, 5, 1)], None)
    assert ParameterUncertainty(problem, theta)._columns.shape[-1] == 3
