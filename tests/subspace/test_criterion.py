"""The criterion of orders."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI, load, save
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.criterion import criterion_of
from lpvlearn.subspace.simulation_error.simulation_fit import (
    Realization,
    with_initial_states,
)

from ..conftest import modes
from .conftest import example, experiment, freedom


def test_an_oscillation_of_any_frequency_costs_the_search_for_it(rng):
    """The best of n / 2 lines of white noise gains about 2 log(n / 2) by chance.

    Of those that decay within ten samples, as many are told apart.
    """
    u, y = rng.standard_normal((2, 400, 1))
    criteria = []
    for radius in (0.9999, 0.9):
        A, B = modes(0.5, radius * np.exp(1.1j)), np.ones((3, 1))
        C, D, x0 = np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 1)), np.zeros((1, 3))
        model = Realization(A, B, C, D, x0, 1.0)
        criteria.append(criterion_of(model, [Record.of(u, y)], freedom(1, 1)))
    np.testing.assert_allclose(criteria[0] - criteria[1], 2.0 * np.log(200.0 / 10.0))


def test_initial_states_are_those_that_innovations_ask_for(rng):
    """White errors: whatever states are given. Slow ones: none leave a transient."""
    A, B, C, D = example(rng, modes(0.95, 0.6 * np.exp(0.9j)), 1, 1)
    free, criteria = freedom(1, 1), []
    u, y = experiment(rng, (A, B, C, D), 300)
    white = Record.of(u, y + rng.standard_normal(y.shape))
    for x0 in np.zeros((1, 3)), 0.1 * rng.standard_normal((1, 3)):
        model = Realization(A, B, C, D, x0, 1.0)
        criteria.append(criterion_of(model, [white], free))
    assert criteria[0] == pytest.approx(criteria[1], abs=1e-6)
    excess = []
    for _ in range(10):
        e = rng.standard_normal((800, 1))
        v = lfilter([1.0], [1.0, -1.6, 0.62], e, axis=0)[500:]
        slow = [Record.of(u, y + v)]
        model = with_initial_states(model, slow, free)
        excess.append(
            criterion_of(model, slow, free) - 300 * np.log(np.mean(e[500:] ** 2))
        )
    # Ten parameters and two lags cost four each; the five fitted here gain one.
    assert np.mean(excess) == pytest.approx(40.0 * 300 / 290 + 8.0 - 5.0, abs=4.0)


def test_a_model_tells_its_criterion(tmp_path):
    """Of the same samples; a model from a file has none."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((400, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.8], u, axis=0)
    y += 0.1 * rng.standard_normal(y.shape)
    found = [SubspaceLTI(order, horizon=8).fit(u, y).criterion() for order in (1, 2)]
    none = SubspaceLTI(0, horizon=8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found.append(none.fit(u, y).criterion())
    assert found[0] < found[1] < found[0] + 30.0 < found[2]
    integrating = SubspaceLTI(1, integrating=True).fit(u, np.cumsum(y, axis=0))
    assert np.isnan(integrating.criterion())
    save(none, tmp_path / "model.zip")
    assert np.isnan(load(tmp_path / "model.zip").criterion())


def test_a_model_of_sums_has_the_criterion_of_its_first_samples(short_buffer):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((2_400, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.8], u, axis=0)
    y += 0.1 * rng.standard_normal(y.shape)
    X = np.column_stack([u, np.arange(2_400) // 300])
    roles = {"inputs": [0], "experiment": 1}
    found = SubspaceLTI(1, horizon=8, **roles).fit(X, y).criterion()
    first = SubspaceLTI(1, horizon=8, **roles).fit(X[:1_000], y[:1_000]).criterion()
    assert found == pytest.approx(first, abs=20.0)
