"""Levels of a record: each held stretch found, whatever is between and beside."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import split_levels

from ..conftest import KAPPA, ROLES, spring_lpv, spring_pipeline, spring_truth


def staircase(levels, n=150, ramp=20, noise=0.0, seed=0):
    """Levels of `n` rows with ramps between, and the true number of every row."""
    rng, x, truth = np.random.default_rng(seed), [], []
    for k, level in enumerate(levels):
        if k:
            x.append(np.linspace(levels[k - 1], level, ramp + 2)[1:-1])
            truth.append(np.full(ramp, -1))
        x.append(np.full(n, level))
        truth.append(np.full(n, k))
    x, truth = np.concatenate(x), np.concatenate(truth)
    return x + noise * rng.uniform(-1, 1, len(x)), truth


def table(x, **columns):
    return pd.DataFrame({"kappa": x, **columns})


def test_levels_are_found_exactly():
    x, truth = staircase([0.0, 1.0, 0.2, 1.0], ramp=30)
    assert_array_equal(split_levels(table(x), "kappa", tol=1e-6), truth)
    assert_array_equal(split_levels(x[:, None], 0, tol=0), truth)
    x, truth = staircase([3.0, 1.0, 2.0], ramp=0)
    assert_array_equal(split_levels(table(x), ["kappa"]), truth)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e12])
@pytest.mark.parametrize("seed", range(3))
def test_noise_below_the_tolerance_changes_the_ends_alone(scale, seed):
    x, truth = staircase([0.0, 1.0, 0.3], noise=0.02, seed=seed)
    found = split_levels(table(scale * (7 + x)), "kappa")
    held = truth >= 0
    assert_array_equal(found[held], truth[held])
    grown = (found >= 0) & ~held
    assert (np.abs(x[grown] - np.array([0.0, 1.0, 0.3])[found[grown]]) < 0.05).all()


def test_no_stretch_ranges_beyond_the_tolerance_or_across_records():
    rng = np.random.default_rng(0)
    X = table(np.cumsum(rng.normal(size=2000)), run=np.repeat(["a", "b"], 1000))
    X["other"] = np.cumsum(rng.normal(size=2000))
    names = ["kappa", "other"]
    found = split_levels(X, names, experiment="run", tol=[8, 5], min_samples=10)
    groups = X[found >= 0].groupby(found[found >= 0])
    assert len(groups) > 20 and groups.size().min() >= 10
    assert (groups[names].max() - groups[names].min() <= [8, 5]).all(axis=None)
    assert (groups["run"].nunique() == 1).all()
    assert (np.diff(found[found >= 0]) >= 0).all()


def test_missing_values_and_outliers_end_a_stretch():
    x = np.zeros(300)
    x[[100, 200]] = np.nan, 9.0
    found = split_levels(table(x), "kappa", min_samples=50)
    assert_array_equal(np.flatnonzero(found < 0), [100, 200])
    assert_array_equal(found[[0, 150, 250]], [0, 1, 2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scheduling": "speed"}, "`scheduling` must name a column .*'kappa'"),
        ({"scheduling": None}, "`scheduling` must name the columns"),
        ({"tol": -1}, "`tol` must be a non-negative number"),
        ({"tol": [1, 2]}, r"one per scheduling variable \(1\)"),
        ({"min_samples": 1}, "`min_samples` must"),
        ({"tol": 0}, r"`tol` must leave .* Got 0, .* for 1 rows at most"),
    ],
)
def test_wrong_arguments_are_refused(options, message):
    options = {"scheduling": "kappa", **options}
    with pytest.raises(ValueError, match=message):
        split_levels(table(np.linspace(0, 1, 300)), **options)
    with pytest.raises(ValueError, match="for 0 rows at most"):
        split_levels(table(np.full(300, np.nan)), "kappa")


@pytest.mark.slow
def test_one_record_of_levels_gives_the_model_of_many():
    """A staircase through the points of the spring, in one simulation."""
    x, truth = staircase(KAPPA, n=500, ramp=50)
    u = np.sign(np.random.default_rng(1).standard_normal(len(x)))
    y = pd.DataFrame({"position": spring_lpv().simulate(u, x, 0.02)[:, 0]})
    X = table(x, force=u, time=0.02 * np.arange(len(x)))
    X["run"] = split_levels(X, "kappa", tol=1e-3)
    held = X["run"] >= 0
    assert_array_equal(X["run"], truth)
    found = spring_pipeline().fit(X[held], y[held])
    assert_allclose(found.parameters_, spring_truth(KAPPA), rtol=1e-6)
    assert set(ROLES.values()) <= set(X)
