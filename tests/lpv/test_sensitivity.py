"""Derivatives of simulated outputs: equal to differences, whatever the model has."""

from dataclasses import replace

import numpy as np
import pytest

from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV, RationalLPV
from lpvlearn.lpv import sensitivity
from lpvlearn.lpv.refinement import with_rate_terms
from lpvlearn.lpv.sensitivity import (
    coefficients_of,
    output_slopes,
    with_coefficients,
)

from ..conftest import spring_lpv, spring_structure

STEP = 0.05


def with_two_variables():
    grid = np.array([[0.0, -1], [1, -1], [0, 1], [1, 1], [0.4, 0.2]])
    theta = np.column_stack([30 + grid[:, 0], 2 + grid[:, 1], 40 + 9 * grid.sum(1)])
    interpolator = PolynomialLPV(1).fit(grid, theta)
    return LPVStateSpace(spring_structure(), interpolator, grid[[0, 3]])


def with_function():
    """A structure that is not affine, with a denominator, and a feedthrough."""
    structure = GrayBoxStructure.from_function(
        lambda p: (
            [[0, 1], [-p[0] / p[1], -p[0] * 0.1]],
            [[0], [1 / p[1]]],
            [[1, p[0] ** 2 / 50]],
            [[p[1]]],
        ),
        initial={"k": 4.0, "m": 2.0},
    )
    kappa = np.linspace(0, 1.5, 5)[:, None]
    theta = np.hstack([4 + kappa, 2 + 0 * kappa]) / (1 + 0.3 * kappa)
    return LPVStateSpace(structure, RationalLPV(1, 1).fit(kappa, theta), kappa[[0, -1]])


def with_offsets():
    kappa = np.linspace(0, 1.5, 5)[:, None]
    values = np.hstack([1 + kappa, kappa**2, 0.3 * kappa, 0.1 - kappa])
    return replace(spring_lpv(), offsets=PolynomialLPV(2).fit(kappa, values))


MODELS = {
    "affine": spring_lpv,
    "delayed": lambda: replace(spring_lpv(), input_delay=3 * STEP),
    "two variables": with_two_variables,
    "function": with_function,
    "offsets": with_offsets,
}


def trajectory(model, n_samples=60, seed=0):
    rng = np.random.default_rng(seed)
    low, high = model.scheduling_range
    phase = np.linspace(0, 5, n_samples)[:, None] + np.arange(model.n_scheduling)
    kappa = low + (high - low) * (0.5 - 0.5 * np.cos(phase))
    u = rng.choice([-1.0, 1.0], (n_samples // 3, model.n_inputs)).repeat(3, axis=0)
    return u, kappa


def slopes_and_differences(model, n_samples=60, dt=STEP):
    rng = np.random.default_rng(1)
    u, kappa = trajectory(model, n_samples)
    c = coefficients_of(model)
    c = c + 0.02 * rng.normal(size=len(c))
    model, x0 = with_coefficients(model, c), rng.normal(size=model.order)
    free = np.ones(len(c), bool)
    slopes = [J for _, J in output_slopes(model, u, kappa, dt, x0, free)]

    def outputs(z):
        moved = with_coefficients(model, z[model.order :])
        return moved.simulate(u, kappa, dt, z[: model.order])

    z, h = np.concatenate([x0, c]), 1e-5
    columns = [
        (outputs(z + step) - outputs(z - step)) / (2 * h) for step in h * np.eye(len(z))
    ]
    return np.concatenate(slopes), np.stack(columns, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_slopes_equal_differences(name, rates, hold):
    model = replace(MODELS[name](), hold=hold)
    if rates:
        model = with_rate_terms(model)[0]
    found, expected = slopes_and_differences(model)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["affine", "delayed", "function", "offsets"])
@pytest.mark.parametrize("rates", [False, True])
def test_slopes_of_runs_that_begin_where_their_inputs_hold_them(name, rates):
    model = MODELS[name]()
    if rates:
        model = with_rate_terms(model)[0]
    model = replace(model, steady_start=True)
    u, kappa = trajectory(model)
    u[:9] = 0.7
    rng = np.random.default_rng(1)
    c = coefficients_of(model)
    c = c + 0.02 * rng.normal(size=len(c))

    def outputs(c):
        return with_coefficients(model, c).simulate(u, kappa, STEP)

    h, model = 1e-5, with_coefficients(model, c)
    columns = [(outputs(c + d) - outputs(c - d)) / (2 * h) for d in h * np.eye(len(c))]
    expected = np.stack(columns, axis=-1)
    x0, free = model.beginning(u, kappa)[0], np.ones(len(c), bool)
    found = [J for _, J in output_slopes(model, u, kappa, STEP, x0, free)]
    found = np.concatenate(found)[:, :, model.order :]
    assert np.abs(expected[0]).max() > 1e-3  # it matters from the beginning
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.slow
def test_long_tables_and_short_ones_agree(monkeypatch):
    """With 300 samples matrices and directions come from a table over kappa."""
    found, expected = slopes_and_differences(with_function(), 300)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())
    monkeypatch.setattr(sensitivity, "_ENTRIES", 1)
    blocks, _ = slopes_and_differences(with_function(), 300)
    np.testing.assert_allclose(blocks, found, atol=1e-10)


@pytest.mark.parametrize("dt", [1e-3, 0.05, 1.0])
def test_fast_poles_take_shorter_steps(dt):
    """An actuator at 400 rad/s beside a spring at 6."""
    structure = GrayBoxStructure.from_template(
        [[0, 1, 0], ["-k", "-c", "b"], [0, 0, "-a"]], [[0], [0], ["a"]], [[1, 0, 0]]
    )
    kappa = np.array([[0.0], [1.0]])
    theta = [[400.0, 30, 1, 40], [300, 30, 2, 60]]
    model = LPVStateSpace(structure, PolynomialLPV(1).fit(kappa, theta), kappa)
    found, expected = slopes_and_differences(model, dt=dt)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_poles_beyond_all_sampling_are_refused():
    structure = GrayBoxStructure.from_template([["-a"]], [["a"]], [[1]])
    kappa = np.array([[0.0], [1.0]])
    model = LPVStateSpace(structure, PolynomialLPV(0).fit(kappa, [[1e6]] * 2), kappa)
    u, path = trajectory(model)
    with pytest.raises(
        ValueError, match="`sampling_time` must be at most 2000.*Got 5e.04"
    ):
        list(output_slopes(model, u, path, STEP, np.zeros(1), np.ones(1, bool)))


def test_units_of_states_do_not_matter():
    """Positions in micrometres."""
    structure = GrayBoxStructure.from_template(
        [[0, 1e6], ["-1e-6 * k", "-c"]], [[0], ["b"]], [[1e-6, 0]]
    )
    plain, free = spring_lpv(), np.ones(9, bool)
    u, path = trajectory(plain)

    def slopes(model):
        found = output_slopes(model, u, path, STEP, np.zeros(2), free)
        return np.concatenate([J for _, J in found])[:, :, 2:]

    changed = slopes(replace(plain, structure=structure))
    np.testing.assert_allclose(changed, slopes(plain), atol=1e-12)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("kinematic", [False, True])
def test_held_coefficients_are_left_out(name, kinematic):
    """Every second one, or those of rate terms that kinematics do not have."""
    model, held = with_rate_terms(MODELS[name]())
    static = len(coefficients_of(model)) - len(held)
    free = np.concatenate([np.ones(static, bool), ~held])
    if not kinematic:
        free = np.arange(len(free)) % 2 == 0
    u, kappa = trajectory(model)
    x0 = np.zeros(2)
    ((_, every),) = output_slopes(model, u, kappa, STEP, x0, np.ones_like(free))
    ((_, some),) = output_slopes(model, u, kappa, STEP, x0, free)
    np.testing.assert_allclose(
        some, every[:, :, np.r_[[True] * 2, free]], atol=1e-13 * np.abs(every).max()
    )
