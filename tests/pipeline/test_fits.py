"""How well models simulate the experiments of a point, some at a time."""

import numpy as np
import pytest

from lpvlearn import StateSpace, bft_score
from lpvlearn.data.experiments import Experiment
from lpvlearn.pipeline.points import fits
from lpvlearn.pipeline.points.fits import Measured, fit_of


def experiments(model, lengths, rng, noise=0.1):
    found = []
    for k, n in enumerate(lengths):
        u = rng.standard_normal((n, 1))
        y = model.to_discrete(0.1).simulate(u) + noise * rng.standard_normal((n, 2))
        found.append(Experiment(k, np.arange(n), u, 3.0 + y))
    return found


@pytest.mark.parametrize("at_once", [1, 90, 10_000])
def test_it_is_that_of_all_samples_however_many_are_looked_at_at_once(
    at_once, monkeypatch
):
    rng = np.random.default_rng(0)
    model = StateSpace([[-1.0, 2.0], [-2.0, -1.0]], [[1.0], [0.0]], np.eye(2))
    group = experiments(model, (40, 60, 40, 40), rng)
    monkeypatch.setattr(fits, "_AT_ONCE", at_once)
    found = fit_of(model, Measured.of(group), 0.1, 1)
    true, near = [], []
    for e in group:
        simulated = model.to_discrete(0.1).simulate(e.inputs)
        left = e.measured - simulated
        A = model.to_discrete(0.1).A
        powers = [np.eye(2)]
        for _ in range(len(left) - 1):
            powers.append(powers[-1] @ A)
        size = np.vstack([e.measured for e in group]).std(axis=0)
        free = np.concatenate(
            [np.array(powers), np.broadcast_to(np.eye(2), (len(left), 2, 2))], axis=2
        )
        rows = (free / size[:, None]).reshape(-1, 4)
        own = np.linalg.lstsq(rows, (left / size).ravel())[0]
        true.append(e.measured)
        near.append(simulated + free @ own)
    assert found == pytest.approx(bft_score(np.vstack(true), np.vstack(near)))


def test_an_output_that_stands_still_has_no_spread():
    rng = np.random.default_rng(0)
    model = StateSpace([[-1.0]], [[1.0]], [[1.0], [1.0]])
    (e,) = experiments(model, (50,), rng)
    e.outputs[:, 1] = 0.1  # whose mean is rounded
    found = Measured.of([e])
    assert found.spread.tolist() == [pytest.approx(np.sqrt(50.0)), 0.0]
    assert found.size.tolist() == [pytest.approx(e.measured[:, 0].std()), 1.0]


def test_missing_outputs_are_left_out():
    rng = np.random.default_rng(0)
    model = StateSpace([[-1.0]], [[1.0]], [[1.0], [0.5]])
    group = experiments(model, (50, 50), rng, noise=0.0)
    group[1].outputs[3:20, 0] = np.nan
    assert fit_of(model, Measured.of(group), 0.1, 1) == pytest.approx(100.0)
