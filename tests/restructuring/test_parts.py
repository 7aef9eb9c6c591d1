"""Starts for sums of parts: a mode of the black box for each."""

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure
from lpvlearn.restructuring.parts import start_by_parts

from .conftest import disguised, target_of


def modal_model(n_modes, n_inputs, n_outputs, n_real, rng, dt=None):
    """A modal form and parameters over several decades, some of them damped."""
    structure = GrayBoxStructure.modal(n_modes, n_inputs, n_outputs, n_real)
    rate = np.exp(np.cumsum(rng.uniform(0.3, 0.9, n_modes + n_real)))
    theta = rng.normal(size=structure.n_params)
    for j, name in enumerate(structure.parameter_names):
        i = int(name.split("_")[-1]) - 1
        if name[0] == "w":
            theta[j] = rate[i] ** 2
        elif name[0] == "d":
            theta[j] = 2.0 * rate[i] * 10 ** rng.uniform(-2, -0.3)
        elif name[0] == "r":
            theta[j] = rate[n_modes + i]
    return structure, theta


@pytest.mark.parametrize("sizes", [(10, 1, 1, 0), (15, 1, 1, 0), (4, 2, 3, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_modal_forms_of_many_parameters_are_exact(sizes, seed):
    rng = np.random.default_rng(seed)
    structure, theta = modal_model(*sizes, rng)
    model = structure.model(theta)
    box = disguised(model.balance(), rng)
    found, distance = start_by_parts(
        target_of(box), structure.offset, structure.basis, rng
    )
    omega = np.geomspace(0.1, 1e4, 200)
    G = model.frequency_response(omega)
    own = structure.model(found).frequency_response(omega)
    assert distance < 1e-6
    assert np.abs(own - G).max() < 1e-6 * np.abs(G).max()
    if seed == 0:
        fitted = GrayBoxRestructurer(structure).fit_model(model.balance())
        assert fitted.relative_error_ < 1e-9


def test_parts_of_different_forms_get_their_own_modes():
    structure = GrayBoxStructure.from_template(
        A=[[0, 1, 0, 0], ["-9", "-c", 0, 0], [0, 0, "-a", 0], [0, 0, 0, "-50"]],
        B=[[0], ["b"], [1], ["g"]],
        C=[[1, 0, "h", 1]],
        D=[["d"]],
    )
    truth = {"c": 0.5, "b": 2.0, "a": 1.5, "h": 0.7, "g": 3.0, "d": 0.2}
    theta = structure.check_params(truth)
    rng = np.random.default_rng(0)
    box = target_of(disguised(structure.model(theta), rng))
    found, distance = start_by_parts(box, structure.offset, structure.basis, rng)
    np.testing.assert_allclose(found, theta, rtol=1e-8)
    assert distance < 1e-8


TWO = [[0, 1], ["-k", "-c"]]
NO_PARTS = {
    "one part": (TWO, [[0], ["b"]], [[1, 0]]),
    "shared": ([["-a", 0], [0, "-b"]], [["g"], ["g"]], [[1, 1]]),
    "known": ([["-a", 0], [0, "-2"]], [["g"], [1]], [[1, 1]]),
    "large": (
        [["-a", 1, 0, 0], [0, "-b", 1, 0], [0, 0, "-c", 0], [0, 0, 0, "-d"]],
        [[0], [0], ["g"], [1]],
        [[1, 0, 0, 1]],
    ),
}


@pytest.mark.parametrize("name", NO_PARTS)
def test_what_is_no_sum_of_small_parts_of_its_own_has_no_such_start(name):
    structure = GrayBoxStructure.from_template(*NO_PARTS[name])
    theta = np.arange(1.0, structure.n_params + 1)
    rng = np.random.default_rng(0)
    box = target_of(structure.model(theta))
    assert start_by_parts(box, structure.offset, structure.basis, rng) is None


def test_complex_poles_have_no_place_in_real_parts():
    lags = GrayBoxStructure.from_template(
        [["-a", 0], [0, "-b"]], [[1], [1]], [["g", "h"]]
    )
    box = GrayBoxStructure.from_template(TWO, [[0], ["b"]], [[1, 0]])
    model = target_of(box.model({"k": 4.0, "c": 0.1, "b": 1.0}))
    rng = np.random.default_rng(0)
    assert start_by_parts(model, lags.offset, lags.basis, rng) is None
