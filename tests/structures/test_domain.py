"""Fixed parameters, bounds and known ranges of structures."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxStructure

from .conftest import pendulum, pendulum_jacobian


def template():
    return GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c - e"]], [[0], ["b"]], [["e", 0]]
    )


def flat_jacobian(theta):
    """Blocks of the right size are put into shape."""
    A, B, C = pendulum_jacobian(theta)
    return np.array(A), np.ravel(B), C


START = {"length": 1.3, "damping": 0.2, "gain": 4.0}
STRUCTURES = {
    "template": template(),
    "function": GrayBoxStructure.from_function(pendulum, START),
    "jacobian": GrayBoxStructure.from_function(
        pendulum, START, lambda theta: flat_jacobian(theta)
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
    structure = GrayBoxStructure.from_function(pendulum, START).fix({"damping": 0.1})
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
    structure = GrayBoxStructure.from_function(pendulum, START)
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
    structure = GrayBoxStructure.from_function(pendulum, {**START, "gain": -4.0})
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
    structure = GrayBoxStructure.from_function(pendulum, START)
    draws = [structure.draw(5, np.random.default_rng(7)) for _ in range(2)]
    assert_array_equal(*draws)
