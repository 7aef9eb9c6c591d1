"""States that no point tells, and that matter where scheduling variables move."""

import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from lpvlearn import LocalLPVPipeline
from lpvlearn.data.experiments import read_experiments
from lpvlearn.data.operating_points import local_experiments
from lpvlearn.pipeline.one_basis.in_motion import tell_of_other_states

from ..conftest import ROLES, spring_pipeline, spring_tables

STEP, N = 0.02, 600  # seconds, samples


def test_a_model_that_moves_as_the_other_one_is_not_told_of():
    X, y = spring_tables(noise=1e-3, n_samples=200)
    model = spring_pipeline().fit(X, y).lpv_
    points = local_experiments(read_experiments(spring_pipeline(), X, y))
    tell_of_other_states(model, model, points, STEP)
    late = replace(model, input_delay=np.array([0.2]))
    with pytest.warns(UserWarning, match="another output 'position', by .* refiner="):
        tell_of_other_states(model, late, points, STEP)


def trim(speed):
    """Elevator at which an aircraft flies level."""
    return -0.03 * (100.0 / speed) ** 2


def short_period(speed, elevator, between=4):
    """Pitch rate and vertical acceleration, behind an actuator, begun in level flight.

    An aircraft's A is polynomial in the speed, as then is that of a canonical form, in
    whose states the speed's rate of change acts.
    """
    step, x, y = STEP / between, np.empty(3), np.empty((len(elevator), 2))
    for k, (v, u) in enumerate(zip(speed, elevator, strict=True)):
        r = v / 100.0
        A = np.array(
            [[-0.9 * r, 1.0, -0.08 * r], [-6 * r**2, -1.2 * r, -9 * r**2], [0, 0, -25]]
        )
        x = np.linalg.solve(A, [0.0, 0.0, -25.0 * u]) if k == 0 else x
        y[k] = 57.3 * x[1], v * (0.9 * r * x[0] + 0.08 * r * x[2]) + 9.81
        for _ in range(between):
            half = x + step / 2.0 * (A @ x + [0.0, 0.0, 25.0 * u])
            x = x + step * (A @ half + [0.0, 0.0, 25.0 * u])
    return y


@pytest.mark.slow
def test_states_of_a_canonical_form_that_no_aircraft_has_are_told():
    rng, time, parts = np.random.default_rng(0), STEP * np.arange(N), []

    def shaken(speed):
        moves = np.repeat(rng.choice([-1.0, 1.0], N // 8), 8)
        moves[:24] = 0.0
        return trim(speed) + 0.015 * moves

    for run, v in enumerate((60.0, 85.0, 110.0, 140.0, 170.0, 200.0)):
        speed = np.full(N, v)
        u = shaken(speed)
        y = short_period(speed, u)
        y += 0.03 * y.std(axis=0) * rng.standard_normal(y.shape)
        columns = {"run": run, "time": time, "speed": v, "elevator": u}
        parts.append(pd.DataFrame(columns | {"q": y[:, 0], "az": y[:, 1]}))
    table = pd.concat(parts, ignore_index=True)
    X, y = table[["run", "time", "speed", "elevator"]], table[["q", "az"]]
    roles = {"scheduling": "speed", "experiment": "run", "time": "time"}
    models, told = [], []
    for restructurer in (None, "aligned"):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            pipeline = LocalLPVPipeline(restructurer=restructurer, **roles)
            models.append(pipeline.fit(X, y))
        told.append(any("what the states of the model" in str(w.message) for w in said))
    assert told == [True, False]
    speed = 130.0 - 68.0 * np.cos(2.0 * np.pi * time / 12.0)
    u = shaken(speed)
    new = pd.DataFrame({"run": 0, "time": time, "speed": speed, "elevator": u})
    true = short_period(speed, u)
    canonical, aligned = (np.std(m.predict(new) - true, axis=0)[0] for m in models)
    assert aligned < 0.7 * canonical


@pytest.mark.slow
def test_positions_and_rates_are_states_of_a_canonical_form():
    X, y = spring_tables(noise=1e-3, n_samples=400)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = LocalLPVPipeline(**ROLES).fit(X, y)
    assert model.lpv_.structure.parameter_names[0] == "a2_1"
