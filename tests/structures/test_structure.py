"""GrayBoxStructure: from parameters to matrices, with derivatives."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxStructure

from ..conftest import spring_structure
from .conftest import pendulum, pendulum_jacobian


def test_jacobian_of_a_template_is_the_difference():
    structure = spring_structure()
    rng = np.random.default_rng(0)
    theta, step = rng.normal(size=(2, 3))
    S = structure.system_matrix
    change = np.tensordot(step, structure.jacobian(theta), 1)
    assert_allclose(S(theta + step) - S(theta), change, atol=1e-14)
    assert structure.curvature(theta) is None and structure.is_affine


# -- functions -------------------------------------------------------------------


def pendulum_with_abs(theta):
    return pendulum(np.abs(theta))


def pendulum_with_float(theta):
    return pendulum([float(t) for t in theta])


def pendulum_with_float_array(theta):
    stored = np.zeros(3)
    stored[:] = theta
    return pendulum(stored)


def pendulum_with_branch(theta):
    return pendulum(theta if theta[0] > 0 else -theta)


def pendulum_with_lists(theta):
    return [block.tolist() for block in pendulum(theta)] + [None]


START = np.array([1.3, 0.2, 4.0])


def test_complex_step_is_exact():
    structure = GrayBoxStructure.from_function(pendulum, START)
    explicit = GrayBoxStructure.from_function(pendulum, START, pendulum_jacobian)
    for theta in (START, np.array([1e-3, 5.0, -7.0]), np.array([2.0, 0.0, 1e8])):
        expected = explicit.jacobian(theta)
        scale = np.abs(expected).max((1, 2), keepdims=True)
        assert_allclose(structure.jacobian(theta) / scale, expected / scale, atol=1e-14)


@pytest.mark.parametrize(
    "function",
    [
        pendulum_with_abs,
        pendulum_with_float,
        pendulum_with_float_array,
        pendulum_with_branch,
    ],
)
def test_functions_that_are_not_analytic_are_differenced(function):
    structure = GrayBoxStructure.from_function(function, START)
    expected = GrayBoxStructure.from_function(
        pendulum, START, pendulum_jacobian
    ).jacobian(START)
    assert_allclose(structure.jacobian(START), expected, rtol=1e-8, atol=1e-8)


def test_one_non_analytic_parameter_among_steep_ones_is_noticed():
    def function(theta):
        return [[-1e6 * theta[0]]], [[1e-3 * np.abs(theta[1])]], [[1]]

    J = GrayBoxStructure.from_function(function, [2.0, 3.0]).jacobian([2.0, 3.0])
    assert J[1, 0, 1] == pytest.approx(1e-3)
    assert J[0, 0, 0] == pytest.approx(-1e6)


@pytest.mark.parametrize("jacobian", [None, pendulum_jacobian])
def test_curvature_is_the_second_difference(jacobian):
    structure = GrayBoxStructure.from_function(pendulum, START, jacobian)
    H = structure.curvature(START)
    length, _, gain = START
    expected = np.zeros_like(H)
    expected[0, 0, 1, 0] = -2 * 9.81 / length**3
    expected[0, 0, 1, 1] = -2 * START[1]
    expected[0, 1, 1, 1] = expected[1, 0, 1, 1] = -2 * length
    expected[0, 0, 1, 2] = gain * np.exp(-length)
    expected[0, 2, 1, 2] = expected[2, 0, 1, 2] = -np.exp(-length)
    assert_allclose(H, expected, atol=1e-7)
    assert_array_equal(H, H.swapaxes(0, 1))


def test_curvature_of_small_parameters():
    def function(theta):
        return [[-((1e6 * theta[0]) ** 2)]], [[1]], [[1]]

    structure = GrayBoxStructure.from_function(function, [2e-6])
    H = structure.curvature(np.array([2e-6]))
    assert H[0, 0, 0, 0] == pytest.approx(-2e12, rel=1e-6)


def test_functions_may_return_lists_and_no_feedthrough():
    structure = GrayBoxStructure.from_function(pendulum_with_lists, START)
    assert_allclose(structure.model(START).A, pendulum(START)[0])
    expected = pendulum_jacobian(START)[1]
    assert_allclose(structure.jacobian(START)[:, :2, 2:], expected, atol=1e-9)


def test_matrices_of_a_function_are_stacked():
    structure = GrayBoxStructure.from_function(pendulum, START)
    thetas = START * np.linspace(0.5, 2, 6).reshape(2, 3, 1)
    blocks = structure.matrices(thetas)
    assert [block.shape for block in blocks] == [
        (2, 3, 2, 2), (2, 3, 2, 1), (2, 3, 1, 2), (2, 3, 1, 1),
    ]  # fmt: skip
    assert_allclose(blocks[0][1, 2], pendulum(thetas[1, 2])[0])
    assert structure.matrices(np.zeros((0, 3)))[0].shape == (0, 2, 2)


def test_names_of_a_function_come_from_the_mapping():
    values = {"length": 1.3, "damping": 0.2, "gain": 4.0}
    structure = GrayBoxStructure.from_function(pendulum, values)
    assert structure.parameter_names == ("length", "damping", "gain")
    assert_array_equal(structure.initial, START)
    swapped = GrayBoxStructure.from_function(
        lambda t: pendulum(t[[1, 0, 2]]),
        values,
        parameter_names=["damping", "length", "gain"],
    )
    assert_allclose(swapped.model(values).A, structure.model(values).A)
    unnamed = GrayBoxStructure.from_function(pendulum, START)
    assert unnamed.parameter_names == ("p1", "p2", "p3")


def wrong_jacobian(theta):
    return np.zeros((3, 2, 2)), np.zeros((2, 2, 1)), np.zeros((3, 1, 2))


@pytest.mark.parametrize(
    "arguments, options, message",
    [
        ((pendulum, [1.0, np.nan, 1.0]), {}, "`initial` must hold one finite"),
        ((pendulum, [[1.0, 2.0, 3.0]]), {}, "`initial` must hold one finite"),
        ((pendulum, ["a"]), {}, "`initial` must hold real"),
        ((pendulum, []), {}, "`parameter_names` must be distinct"),
        ((pendulum, START), {"parameter_names": ["a", "b"]}, "`initial` must hold"),
        ((pendulum, START), {"parameter_names": ["a"] * 3}, "distinct names"),
        ((pendulum, {"a": 1.0}), {"parameter_names": ["b"]}, "`initial` must have a"),
        ((lambda t: (1, 2), START), {}, r"`function` must return \(A, B, C\)"),
        ((lambda t: ([[1]], [[1]], [[1, 2]]), START), {}, "`B` needs 1 rows"),
        ((lambda t: ([[np.nan]], [[1]], [[1]]), START), {}, "`A` must be finite"),
        ((pendulum, START, wrong_jacobian), {}, r"`jacobian`.*`B`.*\(3, 2, 1\)"),
    ],
)
def test_wrong_functions_are_explained(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        GrayBoxStructure.from_function(*arguments, **options)


def test_functions_that_change_their_shape_are_explained():
    def function(theta):
        n = 1 if theta[0] < 5 else 2
        return np.eye(n), np.ones((n, 1)), np.ones((1, n))

    structure = GrayBoxStructure.from_function(function, [1.0])
    with pytest.raises(ValueError, match=r"`function`.*`A` of shape \(1, 1\)"):
        structure.model([6.0])


# -- evaluation ------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), lead=st.sampled_from([(), (1,), (5,), (2, 3)]))
def test_stacked_parameters_give_stacked_matrices(seed, lead):
    structure = GrayBoxStructure.observable_canonical(3, 2, 2, feedthrough=True)
    theta = np.random.default_rng(seed).normal(size=(*lead, structure.n_params))
    blocks = structure.matrices(theta)
    for index in np.ndindex(*lead):
        single = structure.matrices(theta[index])
        for found, expected in zip(blocks, single, strict=True):
            assert_allclose(found[index], expected, atol=1e-15)


def test_models_take_vectors_mappings_and_a_sampling_time():
    structure = spring_structure()
    by_name = structure.model({"k": 4, "c": 0.5, "b": 2}, sampling_time=0.1)
    by_position = structure.model([2, 0.5, 4], 0.1)
    for name in "ABCD":
        assert_array_equal(getattr(by_name, name), getattr(by_position, name))
    assert by_name.sampling_time == 0.1 and structure.model([1, 1, 1]).is_continuous


@pytest.mark.parametrize(
    "theta, message",
    [
        ([1.0, 2.0], r"3 finite values \(b, c, k\)"),
        ([1.0, 2.0, np.nan], "3 finite values"),
        (["a", "b", "c"], "`parameters` must hold real"),
        ({"b": 1.0, "c": 2.0}, "Missing or unknown: k"),
        ({"b": 1.0, "c": 2.0, "k": 3.0, "q": 1.0}, "Missing or unknown: q"),
    ],
)
def test_wrong_parameters_are_explained(theta, message):
    with pytest.raises(ValueError, match=message):
        spring_structure().model(theta)


def test_matrices_need_all_parameters():
    with pytest.raises(ValueError, match=r"`theta` must have shape \(..., 3\)"):
        spring_structure().matrices(np.ones((5, 2)))


@pytest.mark.parametrize(
    "structure",
    [
        spring_structure(),
        GrayBoxStructure.from_function(pendulum, START, pendulum_jacobian),
    ],
)
@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))]
)
def test_copies_and_pickles_give_the_same_models(structure, duplicate):
    other = duplicate(structure)
    assert other.parameter_names == structure.parameter_names
    for found, expected in zip(
        other.matrices(START), structure.matrices(START), strict=True
    ):
        assert_array_equal(found, expected)
    assert_array_equal(other.jacobian(START), structure.jacobian(START))


def test_the_arrays_of_a_structure_are_read_only():
    structure = spring_structure()
    for array in (structure.offset, structure.jacobian(np.zeros(3))):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1.0


def test_repr_tells_the_dimensions():
    text = "GrayBoxStructure(order=2, n_inputs=1, n_outputs=1, n_params=3, "
    assert repr(spring_structure()) == text + "affine)"
    structure = GrayBoxStructure.from_function(pendulum, START)
    assert repr(structure) == text + "function)"
