"""Outputs that integrate, of which nobody said so."""

import warnings

import numpy as np
import pytest

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.pipeline.points.integrators import integrating_outputs
from lpvlearn.pipeline.points.local_models import LocalModel

from .conftest import OF_TRAJECTORIES as ROLES


@pytest.mark.parametrize(
    "poles, places",
    [
        ((-1e-6, -2e-6), [0]),
        ((-1e-6, 0.0), [0]),
        ((-1e-6, -0.01), []),  # at one point it decays
    ],
)
def test_outputs_that_integrate_do_so_at_all_points(poles, places):
    local = [
        LocalModel(StateSpace(np.diag([pole, -1.0]), [[1.0], [1.0]], np.eye(2)), 2, 5)
        for pole in poles
    ]
    assert integrating_outputs(local, 5e-4) == places


def exact(plant, kappas=(1.0, 2.0, 3.0), dt=0.1, noise=0.0):
    """Records of 400 samples at each point, without noise."""
    rng, runs = np.random.default_rng(0), []
    for kappa in kappas:
        u = np.repeat(rng.choice([-1.0, 1.0], 100), 4)
        y = StateSpace(*plant(kappa)).simulate(u, sampling_time=dt)
        runs.append((u, kappa, y + noise * y.std() * rng.standard_normal(y.shape)))
    return from_trajectories(runs, sampling_time=dt)


PLANTS = {
    "tank": lambda k: ([[0.0]], [[k]], [[1.0]]),
    "lag": lambda k: ([[0.0, 1.0], [0.0, -k]], [[0.0], [k]], [[1.0, 0.0]]),
    "twice": lambda k: ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [k]], [[1.0, 0.0]]),
    "oscillator": lambda k: ([[0.0, 1.0], [-k, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]]),
}


@pytest.mark.broad
@pytest.mark.parametrize("plant", PLANTS)
def test_exact_records_of_what_does_not_decay_need_no_structure(plant):
    """Poles at zero, to rounding, were refused."""
    X, y = exact(PLANTS[plant])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        model = LocalLPVPipeline(**ROLES).fit(X, y)
    assert model.score(X, y) > 0.9999
    said = [str(w.message) for w in told]
    found = ["identified by their rates, and integrated" in text for text in said]
    assert found == ([] if plant == "oscillator" else [True])


@pytest.mark.slow
def test_what_integrates_twice_is_found_in_noise():
    """Estimates of its two poles grow, and were refused."""
    X, y = exact(PLANTS["twice"], noise=1e-3)
    with pytest.warns(UserWarning, match="identified by their rates, and integrated"):
        model = LocalLPVPipeline(**ROLES).fit(X, y)
    assert model.score(*exact(PLANTS["twice"], (1.5, 2.5))) > 0.999


SHIP = GrayBoxStructure.from_template([[0, 1], [0, "-a"]], [[0], ["b"]], [[1, 0]])


def headings(seed):
    """A ship's at three speeds, with a biased rudder, and its parameters there."""
    runs, true, rng = [], [], np.random.default_rng(seed)
    for speed in (4.0, 6.0, 8.0):
        true.append([0.01 * speed, 0.0012 * speed**2])
        u = np.repeat(rng.choice([-10.0, 10.0], 30), 20) + rng.normal(0.0, 2.0, 600)
        y = SHIP.model(true[-1]).simulate(u - u.mean(), sampling_time=1.0)
        y += 90.0 + 0.005 * y.std() * rng.standard_normal(y.shape)
        runs.append((u - u.mean() + 1.0, speed, y))
    return *from_trajectories(runs, sampling_time=1.0), true


@pytest.mark.slow
def test_integrators_without_a_structure_are_found():
    """They jumped with the speed, and the integrator kept that: fits of -90 to 95 %."""
    with pytest.warns(UserWarning, match="identified by their rates, and integrated"):
        model = LocalLPVPipeline(**ROLES).fit(*headings(0)[:2])
    for seed in (0, 1, 2):
        assert model.score(*headings(seed)[:2]) > 0.998


@pytest.mark.slow
def test_integrators_of_records_in_pieces_are_told_only():
    X, y, _ = headings(0)
    lost = X.index.isin([200, 333, 900, 1500])
    pipeline = LocalLPVPipeline(SubspaceLTI(missing="split"), **ROLES)
    with pytest.warns(UserWarning, match="drifts off where that is not known"):
        pipeline.fit(X[~lost], y[~lost])


@pytest.mark.slow
def test_a_structure_may_integrate_without_a_word():
    """No warning, and parameters within what is said of them."""
    X, y, true = headings(1)
    model = LocalLPVPipeline(restructurer=GrayBoxRestructurer(SHIP), **ROLES).fit(X, y)
    off = (model.parameters_ - np.array(true)) / model.parameters_std_
    assert off.abs().to_numpy().max() < 3.5
    assert (model.parameters_std_ / np.array(true) < 3e-3).all(axis=None)


def battery(seed, n=900):
    """Cells at five states of charge, which the current hardly changes."""
    rng, runs = np.random.default_rng(seed), []
    for charge in (0.15, 0.3, 0.5, 0.7, 0.9):
        current = 12.0 * np.repeat(rng.choice([-1.0, 1.0], n // 15), 15)
        fast, slow, serial = (
            a + b * np.exp(-c * charge)
            for a, b, c in ((4.0, 6.0, 5.0), (6.0, 10.0, 4.0), (12.0, 8.0, 6.0))
        )
        v1, v2, z, volts = 0.0, 0.0, charge, np.empty(n)
        for k, i in enumerate(1e-3 * current):
            at_rest = 3.2 + 0.9 * z + 0.15 * np.tanh(4.0 * z - 2.0)
            at_rest += 0.08 * np.log(z / (1.02 - z))
            volts[k] = at_rest - v1 - v2 - serial * i
            v1 += (1.0 - np.exp(-1.0 / 8.0)) * (fast * i - v1)
            v2 += (1.0 - np.exp(-1.0 / 90.0)) * (slow * i - v2)
            z -= 1e3 * i / (50.0 * 3600.0)
        volts += 0.025 * volts.std() * rng.standard_normal(n)
        runs.append((current, charge, np.round(volts, 3)))
    return from_trajectories(runs, sampling_time=1.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_point_that_grows_slowly_is_named_where_others_do_not():
    """Not by what compares the points, which balances their models."""
    X, y = battery(9)
    with pytest.raises(ValueError, match="point 4 .* integrate, name them"):
        LocalLPVPipeline(**ROLES).fit(X, y)
