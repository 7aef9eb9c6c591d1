"""Outputs that are multiples of a step."""

import warnings

import numpy as np
import pytest

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.metrics import bft_score
from lpvlearn.subspace.evidence.rounding import Rounding
from lpvlearn.subspace.samples.records import Record


@pytest.mark.parametrize("step", [1e-6, 0.1, 3.0, 1e5])
def test_rounding_is_that_of_the_step_about_any_constant(rng, step):
    y = step * np.round(20.0 * rng.standard_normal((500, 2))) + [0.0, 7.7 * step]
    y[:, 1] = np.where(rng.random(500) < 0.5, y[:, 1], 7.7 * step)
    found = Rounding.of([Record.of(y, y), Record.of(y, y + 0.3 * step)])
    np.testing.assert_allclose(found.variances, step**2 / 12.0, rtol=1e-6)


@pytest.mark.parametrize("kind", ["noise", "constant", "fine", "mixed", "one sample"])
def test_what_no_step_divides_is_not_rounded(rng, kind):
    y = {
        "noise": rng.standard_normal(400),
        "constant": np.ones(400),
        "fine": np.round(rng.standard_normal(400), 4),
        "mixed": np.append(np.round(10.0 * rng.standard_normal(399)), 0.123),
        "one sample": np.ones(1),
    }[kind][:, None]
    np.testing.assert_array_equal(Rounding.of([Record.of(y, y)]), [[0.0], [0.0]])


@pytest.mark.slow
@pytest.mark.parametrize(("n_levels", "fit"), [(5, 75.0), (10, 85.0), (20, 93.0)])
def test_rounding_is_not_followed_by_states(n_levels, fit):
    # It repeats where inputs do: in parts held out as well.
    plant = StateSpace([[0.0, 1.0], [-0.01, -0.12]], [[0.0], [0.01]], [[1.0, 0.0]])
    plant = plant.to_discrete(1.0)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([0.0, 1.0], (20, 1)), 50, axis=0)
    y = plant.simulate(u)
    step = np.ptp(y) / n_levels
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = SubspaceLTI().fit(u, step * np.round((y + 40.0) / step))
    fresh = np.repeat(rng.choice([-1.0, 1.0], (300, 1)), 3, axis=0)
    assert 2 <= model.order_ <= 3
    assert bft_score(plant.simulate(fresh), model.lti_.simulate(fresh)) > fit


def test_rounding_is_told_where_errors_depend_on_inputs():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([0.0, 1.0], (20, 1)), 50, axis=0)
    y = StateSpace(0.9, 0.1, 1.0, sampling_time=1.0).simulate(u)
    with pytest.warns(UserWarning, match="is rounded to steps of 3[0-9] %"):
        SubspaceLTI(1).fit(u, 0.15 * np.round(y / 0.15))
