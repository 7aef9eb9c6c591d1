"""GrayBoxStructure: from parameters to matrices; bounds, ranges, fixed values."""

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
        ((pendulum, []), {}, "`parameter_names` must be a list of distinct"),
        ((pendulum, START), {"parameter_names": ["a", "b"]}, "`initial` must hold"),
        ((pendulum, START), {"parameter_names": ["a"] * 3}, "distinct names"),
        ((pendulum, {"a": 1.0}), {"parameter_names": ["b"]}, "`initial` must have a"),
        ((lambda a, b, c: 0, START), {}, "`function` must take one vector of all"),
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
        (["a", "b", "c"], "`theta` must hold real"),
        ({"b": 1.0, "c": 2.0}, "missing or unknown ones: k"),
        ({"b": 1.0, "c": 2.0, "k": 3.0, "q": 1.0}, "missing or unknown ones: q"),
    ],
)
def test_wrong_parameters_are_explained(theta, message):
    with pytest.raises(ValueError, match=message):
        spring_structure().model(theta)


def test_matrices_need_all_parameters():
    with pytest.raises(
        ValueError, match=r"`theta` must be finite, of shape \(..., 3\)"
    ):
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


# -- what is known of the parameters -------------------------------------------


def template():
    return GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c - e"]], [[0], ["b"]], [["e", 0]]
    )


def flat_jacobian(theta):
    """Blocks of the right size are put into shape."""
    A, B, C = pendulum_jacobian(theta)
    return np.array(A), np.ravel(B), C


GUESS = {"length": 1.3, "damping": 0.2, "gain": 4.0}
STRUCTURES = {
    "template": template(),
    "function": GrayBoxStructure.from_function(pendulum, GUESS),
    "jacobian": GrayBoxStructure.from_function(
        pendulum, GUESS, lambda theta: flat_jacobian(theta)
    ),
    "mechanical": GrayBoxStructure.mechanical(
        [["m", 0], [0, 2]],
        [["c", 0], [0, "m + c"]],
        [["k", -1], [-1, "k"]],
        [["b"], [1]],
    ),
}
structures = pytest.mark.parametrize("structure", STRUCTURES.values(), ids=STRUCTURES)


# -- fixed -----------------------------------------------------------------------


@structures
@pytest.mark.parametrize("fixed", [[0], [1], [0, 2], [2, 1]])
def test_a_fixed_structure_is_the_full_one_at_these_values(structure, fixed):
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.5, 2.0, structure.n_params)
    names = np.array(structure.parameter_names)
    smaller = structure.fix({names[j]: theta[j] for j in fixed})
    free = np.setdiff1d(np.arange(len(theta)), fixed)
    assert smaller.parameter_names == tuple(names[free])
    assert smaller.n_params == len(free)
    S = structure.system_matrix(theta)
    assert_allclose(smaller.system_matrix(theta[free]), S, atol=1e-14)
    J = structure.jacobian(theta)[free]
    assert_allclose(smaller.jacobian(theta[free]), J, atol=1e-12)
    H, expected = smaller.curvature(theta[free]), structure.curvature(theta)
    assert (H is None) == smaller.is_affine
    if H is not None:
        assert_allclose(H, expected[free][:, free], atol=1e-12)
    stack = theta * np.linspace(1, 2, 4)[:, None]
    stack[:, fixed] = theta[fixed]
    found = smaller.system_matrix(stack[:, free])
    assert_allclose(found, structure.system_matrix(stack), atol=1e-14)


@structures
def test_fixing_twice_is_fixing_together(structure):
    first, second, *_ = structure.parameter_names
    once = structure.fix({first: 1.5, second: 0.7})
    twice = structure.fix({second: 0.7}).fix({first: 1.5})
    theta = np.full(once.n_params, 1.1)
    assert_allclose(once.system_matrix(theta), twice.system_matrix(theta))
    assert twice.n_params == structure.n_params - 2


def test_fixed_structures_can_be_pickled():
    structure = GrayBoxStructure.from_function(pendulum, GUESS).fix({"damping": 0.1})
    other = pickle.loads(pickle.dumps(structure))
    theta = np.array([2.0, 3.0])
    assert_array_equal(other.jacobian(theta), structure.jacobian(theta))
    assert_array_equal(other.initial, [1.3, 4.0])


def test_fixing_nothing_changes_nothing():
    structure = template()
    same = structure.fix({})
    assert same.parameter_names == structure.parameter_names
    assert_array_equal(same.offset, structure.offset)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"q": 1.0}, r"`values` must name parameters.*\(b, c, e, k\).*Got 'q'"),
        ({"k": np.inf}, "`values` of 'k' must be finite"),
        ({"k": None}, "`values` of 'k' must be finite"),
        ({"k": "3"}, "`values` of 'k' must be finite"),
        ({"c": -1.0}, r"`values` of 'c'.*within its bounds \(0, inf\). Got -1.0"),
        ({"b": 1, "c": 1, "e": 1, "k": 1}, "must leave a parameter free"),
        ([1.0], "`values` must map names to numbers"),
    ],
)
def test_wrong_fixed_values_are_explained(values, message):
    with pytest.raises(ValueError, match=message):
        template().with_bounds({"c": (0, None)}).fix(values)


# -- bounds and ranges -----------------------------------------------------------


def test_bounds_belong_to_a_new_structure():
    structure = template()
    bounded = structure.with_bounds({"k": (0, None), "c": (-1, 2)})
    assert bounded.is_bounded and not structure.is_bounded
    assert_array_equal(structure.lower, -np.inf)
    assert_array_equal(structure.upper, np.inf)
    assert_array_equal(bounded.lower, [-np.inf, -1, -np.inf, 0])
    assert_array_equal(bounded.upper, [np.inf, 2, np.inf, np.inf])
    more = bounded.with_bounds({"k": (None, 9), "b": (None, np.inf)})
    assert_array_equal(more.lower, [-np.inf, -1, -np.inf, -np.inf])
    assert_array_equal(more.upper, [np.inf, 2, np.inf, 9])
    assert not more.fix({"c": 0, "k": 5}).is_bounded
    with pytest.raises(ValueError, match="read-only"):
        bounded.lower[0] = 3


@structures
def test_bounds_and_ranges_survive_fixing_and_pickling(structure):
    first, second, third, *_ = structure.parameter_names
    bounded = structure.with_bounds({first: (0, 9), third: (-4, 5)})
    ranged = bounded.with_ranges({third: (1, 2)})
    other = (
        pickle.loads(pickle.dumps(ranged))
        if getattr(structure.map, "derivatives", None) is None
        else ranged
    )
    smaller = other.fix({first: 3.0})
    assert smaller.parameter_names[:2] == (second, third)
    assert_array_equal(smaller.lower[:2], [-np.inf, -4])
    assert_array_equal(smaller.upper[:2], [np.inf, 5])
    assert_array_equal(smaller.ranges[:, :2], [[np.nan, 1], [np.nan, 2]])


@pytest.mark.parametrize(
    "bounds, message",
    [
        ({"q": (0, 1)}, "`bounds` must name parameters of the structure"),
        ({"k": (2, 1)}, r"`bounds` of 'k' must have the lower one below.*Got \(2, 1\)"),
        ({"k": (1, 1)}, "A parameter of one value is fixed"),
        ({"k": (np.inf, None)}, "`bounds` of 'k' must have the lower one below"),
        ({"k": 3}, "`bounds` of 'k' must be a pair of numbers"),
        ({"k": (1, 2, 3)}, "`bounds` of 'k' must be a pair"),
        ({"k": (np.nan, 1)}, "`bounds` of 'k' must be a pair"),
        ({"k": ("0", 1)}, "`bounds` of 'k' must be a pair"),
        ([(0, 1)], "`bounds` must map names to pairs"),
        ({"c": (5, 6)}, r"`ranges` of 'c' must lie within its bounds \(5, 6\)"),
    ],
)
def test_wrong_bounds_are_explained(bounds, message):
    with pytest.raises(ValueError, match=message):
        template().with_ranges({"c": (1, 2)}).with_bounds(bounds)


def test_bounds_must_hold_the_first_guess():
    structure = GrayBoxStructure.from_function(pendulum, GUESS)
    with pytest.raises(ValueError, match="'gain' must hold its initial value 4"):
        structure.with_bounds({"gain": (0, 3)})


@pytest.mark.parametrize(
    "ranges, message",
    [
        ({"q": (0, 1)}, "`ranges` must name parameters of the structure"),
        ({"k": (1, None)}, "`ranges` of 'k' must be two finite values.*with_bounds"),
        ({"k": (1, np.inf)}, "`ranges` of 'k' must be two finite values"),
        ({"k": (2, 1)}, "`ranges` of 'k' must be two finite values, the lower first"),
        ({"c": (-1, 1)}, r"`ranges` of 'c' must lie within its bounds \(0, inf\)"),
    ],
)
def test_wrong_ranges_are_explained(ranges, message):
    with pytest.raises(ValueError, match=message):
        template().with_bounds({"c": (0, None)}).with_ranges(ranges)


# -- random parameters -----------------------------------------------------------


def test_draws_fill_the_ranges():
    ranges = {"b": (-1, 3), "c": (1, 10_000), "e": (-50, -2), "k": (5, 6)}
    theta = template().with_ranges(ranges).draw(4000, np.random.default_rng(0))
    low, high = np.transpose(list(ranges.values()))
    assert theta.shape == (4000, 4)
    assert (theta >= low).all() and (theta <= high).all()
    # medians: uniform in the middle, log-uniform at the geometric mean
    expected = [1, 100, -10, 5.5]
    assert_allclose(np.median(theta, 0), expected, rtol=0.12)


def test_draws_go_around_the_first_guess_and_stay_within_bounds():
    structure = GrayBoxStructure.from_function(pendulum, {**GUESS, "gain": -4.0})
    theta = structure.draw(4000, np.random.default_rng(0))
    assert_allclose(np.median(theta, 0), structure.initial, rtol=0.03)
    assert_allclose(np.log(theta / structure.initial).std(0), 0.3, rtol=0.05)
    bounded = structure.with_bounds({"gain": (-5, -3.5)}).with_ranges(
        {"length": (8, 9)}
    )
    theta = bounded.draw(100, np.random.default_rng(0))
    assert (theta[:, 0] >= 8).all() and (theta[:, 0] <= 9).all()
    assert (theta[:, 2] >= -5).all() and (theta[:, 2] <= -3.5).all()


def test_unknown_sizes_are_not_drawn():
    structure = template().with_ranges({"b": (0, 1), "c": (0, 1), "e": (0, 1)})
    assert structure.draw(3, np.random.default_rng(0)) is None
    assert structure.fix({"k": 2.0}).draw(3, np.random.default_rng(0)).shape == (3, 3)


def test_draws_repeat_with_the_generator():
    structure = GrayBoxStructure.from_function(pendulum, GUESS)
    draws = [structure.draw(5, np.random.default_rng(7)) for _ in range(2)]
    assert_array_equal(*draws)


def test_a_feedthrough_is_free_where_its_derivative_vanishes_at_the_guess():
    structure = GrayBoxStructure.from_function(
        lambda t: ([[-t[0]]], [[t[0]]], [[1]], [[1 + t[1] ** 2]]),
        {"a": 1.0, "q": 0.0},
    )
    assert structure.free_feedthrough.all()
