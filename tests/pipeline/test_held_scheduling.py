"""What outputs do as scheduling variables move within local experiments."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from joblib import Memory

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, LocalLPVPipeline
from lpvlearn.data.experiments import read_experiments
from lpvlearn.data.operating_points import local_experiments
from lpvlearn.pipeline.points.held_scheduling import _held, curve_at_rest
from lpvlearn.pipeline.running.runner import PointRunner

ROLES = {"scheduling": "charge", "experiment": "run", "time": "t"}
RUNNER = PointRunner(None, 0, "raise", Memory(None))
LEVELS = (0.2, 0.4, 0.6, 0.8)
CELL = GrayBoxStructure.from_template(A=[["-a"]], B=[["b"]], C=[[-1]], D=[["-r"]])


def at_rest(charge):
    return 3.2 + 0.9 * charge + 0.3 * charge**2


def with_knee(charge):
    """Of which four charges tell neither slope nor curvature."""
    return 3.2 + 0.9 * charge + 0.15 * np.tanh(12.0 * (charge - 0.15))


def discharged(
    n_samples=600,
    noise=2e-4,
    moved=1e-4,
    measured="voltage",
    seed=0,
    *,
    rest=at_rest,
    decay=0.05,
):
    """A cell (tau 20 s) at four charges, which its current moves."""
    rng = np.random.default_rng(seed)
    tables = []
    for run, level in enumerate(LEVELS):
        current = np.repeat(rng.choice([-5.0, 5.0], n_samples // 20), 20)
        current -= current.mean()
        charge = level - moved * np.cumsum(np.r_[0.0, current[:-1]])
        state, states = 0.0, np.empty(n_samples)
        for k, i in enumerate(current):
            states[k] = state
            state = np.exp(-decay) * state + 0.02 * (1.0 - np.exp(-decay)) * i
        voltage = rest(charge) - states - 0.03 * current
        columns = {"t": np.arange(float(n_samples)), "run": run, "current": current}
        table = pd.DataFrame(columns | {"charge": charge, "voltage": voltage})
        table["voltage"] += noise * rng.standard_normal(n_samples)
        tables.append(table.assign(output=table[measured]))
    table = pd.concat(tables, ignore_index=True)
    return table.drop(columns=["voltage", "output"]), table[["output"]]


def points_of(X, y):
    estimator = LocalLPVPipeline(**ROLES)
    return local_experiments(read_experiments(estimator, X, y))


@pytest.mark.slow
def test_outputs_that_follow_the_scheduling_are_no_mode_of_the_plant():
    X, y = discharged(seed=0)
    restructurer = GrayBoxRestructurer(CELL)
    with pytest.warns(UserWarning, match=r"\['charge'\], move within local"):
        found = LocalLPVPipeline(restructurer=restructurer, **ROLES).fit(X, y)
    parameters = found.parameters_
    assert [model.order for model in found.local_models_] == [1] * len(LEVELS)
    np.testing.assert_allclose(parameters["a"], 0.05, rtol=0.01)
    np.testing.assert_allclose(parameters["b"], 0.001, rtol=0.01)
    np.testing.assert_allclose(parameters["r"], 0.03, rtol=0.01)
    assert found.score(X, y) > 0.995


@pytest.mark.slow
def test_curves_are_those_of_each_point_where_few_points_tell_none():
    """Also beside a mode that is slow."""
    X, y = discharged(1200, 1e-3, 5e-5, rest=with_knee, decay=0.01)
    restructurer = GrayBoxRestructurer(CELL)
    with pytest.warns(UserWarning, match=r"\['charge'\], move within local"):
        found = LocalLPVPipeline(restructurer=restructurer, **ROLES).fit(X, y)
    np.testing.assert_allclose(found.parameters_["a"], 0.01, rtol=0.06)
    np.testing.assert_allclose(found.parameters_["b"], 0.0002, rtol=0.06)
    np.testing.assert_allclose(found.parameters_["r"], 0.03, rtol=0.01)


@pytest.mark.slow
def test_curves_are_exact_without_noise():
    X, y = discharged(noise=0.0, moved=5e-5)
    for group in points_of(X, y).experiments:
        (run,) = group
        charge = run.kappa.mean()
        found = curve_at_rest(group, "auto")
        np.testing.assert_allclose(found.slopes, 0.9 + 2.0 * 0.3 * charge, rtol=1e-3)
        np.testing.assert_allclose(found.bows, 0.3, rtol=1e-2)
        assert found.variances < 1e-6


@pytest.mark.slow
def test_held_experiments_lack_only_what_the_scheduling_moved():
    X, y = discharged()
    points = points_of(X, y)
    for before, after in zip(
        points.experiments, _held(points, RUNNER, "auto").experiments, strict=True
    ):
        (run,), (held,) = before, after
        moved = at_rest(run.kappa) - at_rest(run.kappa).mean()
        np.testing.assert_allclose(run.measured - held.measured, moved, atol=1e-3)
        assert np.ptp(held.kappa) == 0.0
        np.testing.assert_allclose(held.kappa[0], run.kappa.mean(), rtol=1e-12)


@pytest.mark.parametrize("options", [{"moved": 0.0}, {"measured": "charge"}])
def test_what_does_not_move_or_schedules_itself_stays(options):
    assert _held(points_of(*discharged(**options)), RUNNER, "auto") is None


def test_inputs_at_other_levels_stay():
    X, y = discharged()
    X["current"] += 10.0 * X["run"]
    assert _held(points_of(X, y), RUNNER, "auto") is None


def test_noise_of_the_scheduling_stays():
    X, y = discharged(moved=0.0)
    X["charge"] += 0.01 * np.random.default_rng(0).standard_normal(len(X))
    assert _held(points_of(X, y), RUNNER, "auto") is None


@pytest.mark.slow
def test_every_output_is_held_by_itself():
    rng, (X, y) = np.random.default_rng(0), discharged()
    other = X.assign(output=0.01 * X["current"] + rng.standard_normal(4)[X["run"]])
    both = y.assign(other=other["output"] + 1e-4 * rng.standard_normal(len(y)))
    (alone,), (beside,) = (
        _held(points_of(X, some), RUNNER, "auto").experiments[1] for some in (y, both)
    )
    np.testing.assert_allclose(beside.measured[:, 0], alone.measured[:, 0], atol=2e-4)


@pytest.mark.slow
def test_slopes_that_noise_tells_give_way_to_what_the_points_tell():
    rng, (X, y) = np.random.default_rng(0), discharged()
    clean = X["charge"]
    X["charge"] = clean + 0.0015 * rng.standard_normal(len(X))
    for run, group in enumerate(_held(points_of(X, y), RUNNER, "auto").experiments):
        moved = at_rest(clean[X["run"] == run].to_numpy())
        left = group[0].measured[:, 0] - y["output"][X["run"] == run] + moved
        assert np.std(left) < 0.4 * np.std(moved)
