"""Values that no operating point is near."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import PolynomialLPV
from lpvlearn.exceptions import ExtrapolationWarning
from lpvlearn.lpv.extrapolation import (
    distance_from_hull,
    warn_extrapolation,
    warn_outside_hull,
)

TRIANGLE = np.array([[0.0, 0.0], [0.0, 10.0], [2.0, 0.0]])
NAMES = ["mass", "speed"]
BOX = np.array([[0.0, 0.0], [2.0, 10.0]])


def test_distances_from_a_triangle_in_units_of_its_ranges():
    kappa = np.array([[0.1, 0.5], [2.0, 10.0], [1.0, 5.0], [2.0, 5.0]])
    expected = [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.125)]
    assert_allclose(distance_from_hull(kappa, TRIANGLE), expected, atol=1e-12)


def test_the_points_themselves_and_all_between_are_within():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3)) * [1e-6, 1.0, 1e6]
    between = rng.dirichlet(np.ones(12), 200) @ points
    kappa = np.vstack([points, between])
    assert_allclose(distance_from_hull(kappa, points), 0, atol=1e-10)


@pytest.mark.parametrize(
    "points",
    [
        np.linspace(0, 1, 5)[:, None],
        np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]),
        np.array([[0.0, 3.0], [1.0, 3.0]]),
        np.random.default_rng(0).normal(size=(30, 6)),
    ],
    ids=["one variable", "a line", "a constant variable", "six variables"],
)
def test_no_hull_no_distance(points):
    assert_array_equal(distance_from_hull(points + 7.0, points), 0)


def test_what_no_point_surrounds_is_told_once():
    kappa = np.array([[0.2, 1.0], [1.0, 5.1], [1.9, 9.0], [2.0, 10.0]])
    with pytest.warns(ExtrapolationWarning) as caught:
        warn_outside_hull(kappa, TRIANGLE, BOX, NAMES)
    (told,) = (str(w.message) for w in caught)
    assert "2 of 4 samples are outside the hull of the 3 operating points" in told
    assert "'mass' = 2, 'speed' = 10, by 71 % of the ranges" in told


@pytest.mark.parametrize(
    ("kappa", "box"),
    [
        ([[1.05, 5.2]], BOX),  # near it
        ([[2.5, 12.0]], BOX),  # out of the range, which is told elsewhere
        ([[1.5, 6.0]], BOX + [[-1.0, -5.0], [1.0, 5.0]]),  # moved so far within a run
    ],
    ids=["near", "out of range", "motion"],
)
def test_what_is_near_or_told_already_is_not(kappa, box):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_outside_hull(np.array(kappa), TRIANGLE, box, NAMES)


def test_the_farthest_variable_is_that_farthest_out_of_its_range():
    form = PolynomialLPV(1, extrapolation="error")
    form.fit([[0.0, 0.0], [0.1, 0.0], [0.0, 1000.0]], [0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match=r"\[0, 0.1\] for variable 1.*farthest 1\."):
        form.predict([[1.0, 1020.0]])


def test_a_run_hardly_beyond_the_range_is_not_told(recwarn):
    seen = np.array([[1.0], [2.0]])
    warn_extrapolation(np.array([[0.992], [2.008]]), seen, ["k"])
    assert not recwarn
    with pytest.warns(ExtrapolationWarning, match="2 of 3 samples .* at 2.02"):
        warn_extrapolation(np.array([[0.992], [1.5], [2.02]]), seen, ["k"])


def test_beyond_a_single_point_everything_is_told():
    point = np.full((2, 1), 1e-3)
    with pytest.warns(ExtrapolationWarning, match="1 of 1 samples .* at 0.005"):
        warn_extrapolation(np.array([[5e-3]]), point, ["k"])
