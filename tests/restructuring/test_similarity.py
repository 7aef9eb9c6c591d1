"""Starts by similarity; the bilinear equations of Eq. (7), minimised."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.restructuring.similarity import scaled_problem, similarity_starts

from .conftest import target_of

STRUCTURE = GrayBoxStructure.from_template(
    A=[["-a", "b"], ["b", "-b - c"]], B=[[1], [0]], C=[[0, 1]], D=[["d"]]
)
THETA = STRUCTURE.check_params({"a": 2.0, "b": 0.7, "c": 1.5, "d": 0.4})
BASIS = np.array([[1.0, 0.3], [-0.2, 0.8]])


def minimiser(model, theta=THETA, **options):
    fitted = GrayBoxRestructurer(STRUCTURE, norm="similarity", init=theta, n_starts=1)
    return fitted.fit_model(model, **options)


def test_feedthrough_is_that_of_the_black_box():
    box = STRUCTURE.model(THETA).transform(BASIS)
    fitted = minimiser(box, 1.1 * THETA)
    assert_allclose(fitted.params_, THETA, rtol=1e-7)


def test_covariance_is_that_of_the_minimiser():
    """Two realizations around an exact black box: half their difference, squared."""
    box, rng = STRUCTURE.model(THETA).transform(BASIS), np.random.default_rng(0)
    change = [1e-5 * rng.normal(size=M.shape) for M in (box.A, box.B, box.C, box.D)]
    both = [
        StateSpace(
            *(getattr(box, M) + s * d for M, d in zip("ABCD", change, strict=True))
        )
        for s in (1, -1)
    ]
    spread = np.subtract(*(minimiser(model).params_ for model in both)) / 2
    # of the mean of two: half the variance of one, the square of the difference / 2
    turned = [both[0], both[1].transform(np.array([[2.0, 1.0], [0.0, -1.0]]))]
    for realizations in (both, turned):
        covariance = minimiser(box, realizations=realizations).params_covariance_
        assert_allclose(covariance, np.outer(spread, spread), rtol=1e-3)


def disturbed(model, size, seed=0):
    """A model in another basis, all of its entries changed by that part."""
    rng = np.random.default_rng(seed)
    n = model.order
    turned = model.transform(np.eye(n) + 0.3 * rng.normal(size=(n, n)))
    A, B, C = (
        M * (1.0 + size * rng.normal(size=M.shape))
        for M in (turned.A, turned.B, turned.C)
    )
    return StateSpace(A, B, C, model.D)


def starts_of(structure, model):
    offset, basis = structure.map.offset, structure.map.basis
    problem = scaled_problem(target_of(model), offset, basis, 1.0)
    return similarity_starts(problem, 16, np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(3))
def test_a_start_is_as_far_from_the_truth_as_its_black_box(seed):
    """Two inputs that reach the air alone: they fix three of two entries of T."""
    room = GrayBoxStructure.from_template(
        A=[["-g - go", "g"], ["h", "-h - w"]],
        B=[["b", "s", "go"], [0, 0, "w"]],
        C=[[1, 0]],
    )
    theta = room.check_params(
        {"g": 2.7, "go": 0.2, "h": 0.4, "w": 0.1, "b": 3.0, "s": 2.0}
    )
    model = room.model(theta)
    far = []
    for size in (0.0, 1e-5, 1e-4, 1e-3):
        found, distances = starts_of(room, disturbed(model, size, seed))
        far.append(np.abs(found[0] / theta - 1.0).max())
        assert distances[0] <= 100 * size + 1e-9
    assert far[0] < 1e-6
    assert_allclose(np.divide(far[1:3], far[2:]), 0.1, rtol=0.2)  # to first order
    assert far[3] < 0.3


def test_the_unit_of_a_state_stays_where_nothing_tells_it():
    structure = GrayBoxStructure.from_template(
        A=[["-a", "c", 0], ["d", "-e", "g"], [0, "h", "-i"]],
        B=[["b1", "b2", "b3", "b6"], [0, "b4", "b7", 0], [0, 0, 0, "b5"]],
        C=[[1, 0, 0]],
    )
    model = structure.model(
        {"a": 2.0, "c": 1.0, "d": 0.5, "e": 0.9, "g": 0.3, "h": 0.4, "i": 0.8}
        | {"b1": 1.0, "b2": 0.4, "b3": 0.8, "b4": 0.6, "b5": 0.5, "b6": 0.3, "b7": 0.35}
    )
    found = starts_of(structure, disturbed(model, 1e-4))[0]
    assert len(found) == 16
    # the starts' units are drawn from some four decades, each with its inverse
    assert np.abs(found).max() < 1e6
