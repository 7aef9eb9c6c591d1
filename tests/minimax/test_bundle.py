"""The polyhedral model of the proximal bundle."""

import numpy as np

from lpvlearn.minimax.bundle import _Model

from .conftest import charalambous_bandler


def test_cutting_planes_touch_a_convex_function_from_below():
    """Eq. (19)-(20): exact at the point itself, below everywhere else."""
    problem, y = charalambous_bandler(), np.array([1.0, -0.1])
    peaks, d = problem.peaks(y), np.array([0.2, 0.3])
    trial = problem.peaks(y + d)
    model = _Model.of(peaks)
    assert np.isclose(model.at(np.zeros(2)), 0.0)
    refined = model.refined(_Model.cuts(d, peaks.top, trial, 1.0), d)
    assert np.isclose(refined.at(d), trial.top / peaks.top - 1.0)
    moved = refined.moved(d, peaks.top, trial, np.ones(6, bool), 1.0)
    assert moved.n_own == 3 and np.isclose(moved.at(np.zeros(2)), 0.0)
    rng = np.random.default_rng(0)
    for step in 0.5 * rng.normal(size=(50, 2)):
        f = problem.peaks(y + step).top
        assert refined.at(step) <= f / peaks.top - 1.0 + 1e-12
        assert moved.at(step - d) <= f / trial.top - 1.0 + 1e-12
