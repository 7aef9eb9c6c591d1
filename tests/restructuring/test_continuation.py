"""Fits on contours that approach the frequency axis."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import GrayBoxStructure
from lpvlearn.restructuring.continuation import continued_fits
from lpvlearn.restructuring.error_system import Target


def chain(masses):
    """Three masses on a line, the first tied to the ground."""
    M = [["m1", 0, 0], [0, "m2", 0], [0, 0, "m3"]] if masses else np.eye(3).tolist()
    K = [["k1 + k2", "-k2", 0], ["-k2", "k2 + k3", "-k3"], [0, "-k3", "k3"]]
    D = [[str(entry).replace("k", "c") for entry in row] for row in K]
    sensors = [[1, 0, 0], [0, 0, 1]]
    return GrayBoxStructure.mechanical(M, D, K, [[1], [0], [0]], sensors=sensors)


VALUES = {"c1": 0.1, "c2": 0.2, "c3": 0.1, "k1": 40.0, "k2": 60.0, "k3": 25.0}
MASSES = {"m1": 2.0, "m2": 0.7, "m3": 1.0}


def problem(masses):
    structure = chain(masses)
    values = VALUES | (MASSES if masses else {})
    truth = np.array([values[name] for name in structure.parameter_names])
    model = structure.model(truth)
    return structure, truth, Target(model.A, model.B, model.C, model.D)


@pytest.mark.parametrize("masses", [False, True])
def test_lightly_damped_masses_are_found_from_guesses_three_times_off(masses):
    structure, truth, target = problem(masses)
    rng = np.random.default_rng(0)
    guesses = truth * np.exp(rng.normal(size=(4, len(truth))))
    signed = np.ones(len(truth), bool)
    found, costs = continued_fits(structure, target, guesses, signed)
    assert (np.diff(costs) >= 0).all()
    assert_allclose(found[0], truth, rtol=1e-3)
    # without the blur, the resonances beside the true ones capture the fits
    direct, _ = continued_fits(
        structure, target, guesses, signed, shifts=(0.0,), max_iter=60
    )
    right = [(np.abs(t / truth - 1).max(1) < 1e-2).sum() for t in (found, direct)]
    assert right[0] > right[1]


def test_the_truth_stays_where_it_is():
    structure, truth, target = problem(True)
    found, costs = continued_fits(
        structure, target, truth[None], np.zeros(len(truth), bool)
    )
    assert_allclose(found[0], truth, rtol=1e-9)
    assert costs[0] < 1e-9


def test_signs_are_kept_where_they_are_known():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    model = structure.model([2.0, -3.0])
    target, start = Target(model.A, model.B, model.C, model.D), np.array([[1.0, 5.0]])
    found, _ = continued_fits(structure, target, start, np.array([True, True]))
    assert (found > 0).all()
    found, _ = continued_fits(structure, target, start, np.array([True, False]))
    assert_allclose(found[0], [2.0, -3.0], rtol=1e-6)


def test_discrete_models_are_blurred_outside_the_unit_circle():
    structure = GrayBoxStructure.observable_canonical(2)
    truth = np.array([-0.9, 1.7, 0.3, 0.4])
    model = structure.model(truth, 0.1)
    target = Target(model.A, model.B, model.C, model.D, 0.1)
    guesses = np.array([[-0.3, 0.5, 0.1, 0.1], [-0.5, 1.0, 1.0, 1.0]])
    found, _ = continued_fits(structure, target, guesses, np.zeros(4, bool))
    assert_allclose(found[0], truth, rtol=1e-4)


def test_lost_starts_are_left_out():
    structure, truth, target = problem(False)
    guesses = np.array([truth * 1.5, np.full(len(truth), np.nan)])
    found, costs = continued_fits(structure, target, guesses, np.ones(6, bool))
    assert len(found) == len(costs) == 1
