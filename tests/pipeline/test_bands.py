"""Bands of predictions: parts that are told apart, on tables."""

import copy

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LinearRegression

from lpvlearn import LocalLPVPipeline, OutputErrorLPV
from lpvlearn.data.experiments import Experiment
from lpvlearn.lpv.refinement import Own, Record, simulated
from lpvlearn.pipeline.refining.errors import errors_along

from ..conftest import (
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_sweep,
    spring_tables,
)
from .conftest import N_SAMPLES, sweeps

PARTS = ["parameters", "model_error", "total", "measurement"]


@pytest.fixture(scope="module")
def local(memory):
    X, y = spring_tables(noise=0.05, n_samples=N_SAMPLES)
    return spring_pipeline(memory=memory).fit(X, y)


@pytest.fixture(scope="module")
def moving():
    """Of sweeps alone, from the true model."""
    X, y = sweeps()
    return OutputErrorLPV(spring_lpv(), **ROLES).fit(X, y)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["local", "moving"])
def test_parts_add_up(name, request):
    model = request.getfixturevalue(name)
    X, _ = spring_sweep(300)
    X.index = X.index + 7
    y, std = model.predict(X, return_std=True)
    np.testing.assert_array_equal(y, model.predict(X))
    table = model.prediction_std(X)
    assert table.index.equals(X.index)
    assert table.columns.tolist() == [("position", part) for part in PARTS]
    own, error, total, measured = table.to_numpy().T
    np.testing.assert_allclose(total, np.hypot(own, error))
    assert std.shape == y.shape
    np.testing.assert_array_equal(std.ravel(), total)
    levels = model.output_errors_.loc["position"]
    np.testing.assert_array_equal(error, levels["model_error"])
    np.testing.assert_allclose(measured, np.hypot(total, levels["noise"]))
    assert own[0] == 0  # at rest before anything has moved
    assert np.isfinite(table).all(axis=None)


def test_tables_where_they_are_wanted(local):
    X, _ = spring_sweep(50)
    X.index = X.index + 7
    tabled = copy.copy(local).set_output(transform="pandas")
    for found, plain in zip(
        tabled.predict(X, return_std=True),
        local.predict(X, return_std=True),
        strict=True,
    ):
        assert found.index.equals(X.index) and list(found) == ["position"]
        np.testing.assert_array_equal(found, plain)


@pytest.mark.slow
def test_rows_may_be_lists():
    X, y = sweeps()
    X["run"] = X["run"].str[-1].astype(int)
    places = {role: X.columns.get_loc(name) for role, name in ROLES.items()}
    model = OutputErrorLPV(spring_lpv(), **places).fit(X.to_numpy(), y.to_numpy())
    rows, _ = spring_sweep(50)
    rows = rows.assign(run=0)[list(X)].to_numpy()
    for ours, theirs in zip(
        model.predict(rows.tolist(), return_std=True),
        model.predict(rows, return_std=True),
        strict=True,
    ):
        np.testing.assert_array_equal(ours, theirs)
    assert list(model.prediction_std(rows.tolist()).index) == [*range(50)]


@pytest.mark.parametrize("name", ["local", "moving"])
def test_the_noise_is_found_and_a_true_model_has_no_error(name, request):
    model = request.getfixturevalue(name)
    X, y = spring_sweep(1500)
    found = model.output_errors_.loc["position"]
    noise = (0.05 if name == "local" else 0.03) * y["position"].std()
    assert 0.7 * noise < found["noise"] < 1.3 * noise
    assert found["model_error"] < 0.7 * noise
    error = np.abs(model.predict(X) - y.to_numpy())
    assert (error < 3 * model.predict(X, return_std=True)[1]).mean() > 0.95


def test_single_outputs(memory):
    X, y = spring_tables(noise=0.05, n_samples=N_SAMPLES)
    model = spring_pipeline(memory=memory).fit(X, y["position"])
    new, _ = spring_sweep(100)
    mean, std = model.predict(new, return_std=True)
    assert mean.shape == std.shape == (100,)
    assert model.output_errors_.index.tolist() == ["position"]


@pytest.mark.slow
def test_scales_of_outputs_scale_bands(memory, local):
    X, y = spring_tables(noise=0.05, n_samples=N_SAMPLES)
    large = spring_pipeline(memory=memory).fit(X, 1e3 * y)
    new, _ = spring_sweep(200)
    pd.testing.assert_frame_equal(
        large.output_errors_, 1e3 * local.output_errors_, rtol=1e-2
    )
    ours, theirs = (
        model.prediction_std(new).xs("parameters", axis=1, level="part").to_numpy()
        for model in (local, large)
    )
    np.testing.assert_allclose(theirs[1:], 1e3 * ours[1:], rtol=0.02)


@pytest.mark.slow
def test_what_is_not_known_is_refused_with_the_remedy(memory):
    X, y = spring_tables(noise=0.05, n_samples=N_SAMPLES)
    new, _ = spring_sweep(50)
    for model in (
        # parameters without covariances
        LocalLPVPipeline(restructurer="aligned", **ROLES),
        spring_pipeline(memory=memory, interpolator=LinearRegression()),
    ):
        model.fit(X, y)
        assert model.lpv_.covariance is None
        with pytest.raises(ValueError, match=r"`covariance` is None.*OutputErrorLPV"):
            model.predict(new, return_std=True)
        assert np.isfinite(model.output_errors_).all(axis=None)


@pytest.mark.slow
def test_the_refiner_hands_its_covariance_and_errors_on(memory):
    tables = zip(spring_tables(noise=0.05, n_samples=N_SAMPLES), sweeps(), strict=True)
    X, y = (pd.concat(pair, ignore_index=True) for pair in tables)
    model = spring_pipeline(memory=memory, refiner=OutputErrorLPV()).fit(X, y)
    refiner = model.refiner_
    np.testing.assert_array_equal(
        model.lpv_.covariance, refiner.coefficients_covariance_
    )
    pd.testing.assert_frame_equal(model.output_errors_, refiner.output_errors_)
    new, _ = spring_sweep(300)
    local = spring_pipeline(memory=memory).fit(
        *spring_tables(noise=0.05, n_samples=N_SAMPLES)
    )
    ours, theirs = (
        m.prediction_std(new).xs("parameters", axis=1, level="part").to_numpy().mean()
        for m in (model, local)
    )
    assert ours < theirs  # more data of the same truth


@pytest.mark.slow
def test_errors_are_as_large_as_told():
    new, truth = spring_sweep(400)
    scores = []
    for seed in range(4):
        X, y = spring_tables(noise=0.05, n_samples=N_SAMPLES, seed=seed)
        model = spring_pipeline().fit(X, y)
        std = model.prediction_std(new).xs("parameters", axis=1, level="part")
        error = model.predict(new) - truth.to_numpy()
        scores.append(np.mean((error[20:] / std.to_numpy()[20:]) ** 2))
    assert 0.4 < np.mean(scores) < 2.0


def test_each_of_some_realizations_has_errors_of_its_own():
    rng, lpv, own = np.random.default_rng(0), spring_lpv(), Own(True, True)
    u, other = rng.normal(size=(2, 50, 1))
    kappa = np.full((50, 1), 0.4)
    y = rng.normal(size=(4, 50, 1))
    runs = [Record(v, z, kappa, 0.02) for v, z in zip([u, u, other, u], y, strict=True)]
    named = [Experiment(k, np.arange(50), r.u, r.y) for k, r in enumerate(runs)]
    found = errors_along(lpv, named, runs, own)
    for errors, run in zip(found, runs, strict=True):
        np.testing.assert_array_equal(errors, simulated(lpv, run, own)[0])
