"""OutputErrorLPV: alone, and as the fourth step of a pipeline."""

import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, cross_validate

from lpvlearn import (
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    OutputErrorLPV,
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
    from_trajectories,
)
from lpvlearn.exceptions import ExtrapolationWarning, collected
from lpvlearn.inspection import SimulationDisplay
from lpvlearn.lpv.sensitivity import coefficients_of, with_coefficients

from ..conftest import (
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_structure,
    spring_sweep,
    spring_tables,
    spring_truth,
)
from .conftest import FINE, N_SAMPLES, sweeps


@pytest.fixture(scope="module")
def both():
    """Noisy local experiments, and all of them with two sweeps."""
    local = spring_tables(noise=0.05, n_samples=N_SAMPLES)
    moving = sweeps()
    return local, [
        pd.concat(p, ignore_index=True) for p in zip(local, moving, strict=True)
    ]


@pytest.fixture(scope="module")
def refined(both, memory):
    return spring_pipeline(memory=memory, refiner=OutputErrorLPV()).fit(*both[1])


def error(model):
    """Of the parameters over the range, relative."""
    return np.sqrt(np.mean((model.lpv_.parameters(FINE) / spring_truth(FINE) - 1) ** 2))


def test_moving_experiments_refine_and_local_ones_identify(refined, both, memory):
    plain = spring_pipeline(memory=memory).fit(*both[0])
    np.testing.assert_array_equal(refined.operating_points_, plain.operating_points_)
    pd.testing.assert_frame_equal(refined.parameters_, plain.parameters_)
    assert error(refined) < error(plain)
    assert list(refined.refiner_.report_.index) == ["sweep 0", "sweep 1"]
    assert (refined.refiner_.report_["BFT"] > 96.5).all()
    assert "refinement" in refined.step_times_
    text = refined.summary()
    assert "Refinement: OutputErrorLPV, without rate terms" in text
    assert "sweep 1" in text
    assert plain.refiner_ is None
    np.testing.assert_array_equal(
        refined.interpolator_.predict(FINE[:, None]), refined.lpv_.parameters(FINE)
    )


@pytest.mark.slow
@pytest.mark.parametrize("structured", [True, False])
def test_units_of_outputs_do_not_matter(structured):
    """Of short records in mid-motion, whose initial states two outputs share."""
    X, y = sweeps(n=1)
    steps = {"sampling_time": 0.1, "inputs": "force", "scheduling": "kappa"}
    rows = slice(150, 270)
    rates = np.gradient(y["position"].to_numpy(), 0.1)
    y = y.assign(rate=rates + 0.1 * np.random.default_rng(2).normal(size=len(y)))[rows]
    X = X[rows].drop(columns=["run", "time"])
    found = []
    for unit in (1.0, 1024.0):
        spring = GrayBoxStructure.from_template(
            A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0], [0, unit]]
        )
        refiner = OutputErrorLPV(
            spring if structured else None, rate=False, max_iter=5, **steps
        )
        with collected():  # few steps of a short record
            refiner.fit(X, y * [1.0, unit])
        found.append((refiner.predict(X) / [1.0, unit], refiner.output_errors_))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-3, atol=1e-4)
    errors = found[1][1].div([1.0, 1024.0], axis=0)
    np.testing.assert_allclose(errors, found[0][1], rtol=1e-3)


def test_without_a_refiner_moving_experiments_are_refused_with_the_remedy(both):
    with pytest.raises(ValueError, match=r"refiner=OutputErrorLPV\(\)"):
        spring_pipeline().fit(*both[1])


def test_only_moving_experiments_need_no_pipeline():
    with pytest.raises(ValueError, match=r"OutputErrorLPV\(\)\.fit"):
        spring_pipeline(refiner=OutputErrorLPV()).fit(*sweeps(n_samples=100))


def test_no_moving_experiment_is_told(both, memory):
    with pytest.warns(UserWarning, match="nothing to do"):
        model = spring_pipeline(memory=memory, refiner=OutputErrorLPV()).fit(*both[0])
    assert model.refiner_ is None


def test_a_refiner_needs_coefficients(both, memory):
    pipeline = spring_pipeline(
        memory=memory, interpolator=LinearRegression(), refiner=OutputErrorLPV()
    )
    with pytest.raises(ValueError, match="Got LinearRegression"):
        pipeline.fit(*both[1])


@pytest.mark.slow
def test_the_prior_may_be_certain(both, memory):
    plain = spring_pipeline(memory=memory).fit(*both[0])
    held = spring_pipeline(memory=memory, refiner=OutputErrorLPV(prior=1e12))
    held.fit(*both[1])
    np.testing.assert_allclose(
        held.lpv_.parameters(FINE), plain.lpv_.parameters(FINE), rtol=1e-5
    )


def test_without_a_structure_local_experiments_are_the_prior(both, memory):
    pipeline = spring_pipeline(
        memory=memory,
        restructurer=None,
        interpolator=PolynomialLPV(2),
        refiner=OutputErrorLPV(rate=False, max_iter=10),
    ).set_params(local__order=2, local__feedthrough=False)
    pipeline.fit(*both[1])
    assert (pipeline.refiner_.report_["BFT"] > 96.5).all()


@pytest.mark.slow
def test_the_prior_leaves_out_what_is_missing_of_local_experiments(both):
    X, y = both[1]
    y = y.copy()
    y.iloc[50:55] = np.nan
    model = LocalLPVPipeline(
        SubspaceLTI(2, missing="estimate", feedthrough=False),
        "aligned",
        PolynomialLPV(2),
        refiner=OutputErrorLPV(rate=False, max_iter=10),
        **ROLES,
    ).fit(X, y)
    assert (model.refiner_.report_["BFT"] > 96.5).all()


@pytest.mark.slow
def test_searches_and_splits_work(both, memory):
    X, y = both[1]
    pipeline = spring_pipeline(memory=memory, refiner=OutputErrorLPV(max_iter=5))
    groups = X["run"].isin(["sweep 1"]).astype(int)
    split = [(np.flatnonzero(groups == 0), np.flatnonzero(groups == 1))]
    found = cross_validate(pipeline, X, y, cv=split)
    assert found["test_score"][0] > 0.99
    grid = {"refiner__rate": [False, True], "refiner__prior": ["local", None]}
    search = GridSearchCV(pipeline, grid, cv=split).fit(X, y)
    assert search.best_score_ > 0.99
    copy = pickle.loads(pickle.dumps(search.best_estimator_))
    np.testing.assert_array_equal(copy.predict(X), search.predict(X))


# -- alone -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone():
    X, y = sweeps()
    return OutputErrorLPV(spring_lpv(), rate=False, **ROLES).fit(X, y)


def test_another_table_is_predicted_by_names_of_columns(alone):
    X, y = spring_sweep(300, seed=77)
    shuffled = X[["time", "kappa", "run", "force"]]
    simulated = alone.predict(shuffled)
    np.testing.assert_array_equal(simulated, alone.predict(X))
    direct = alone.lpv_.simulate(X["force"], X["kappa"], 0.02)
    np.testing.assert_array_equal(simulated, direct)
    assert bft_score(y, simulated) > 98
    assert alone.score(X, y) > 0.999


def test_arrays_and_series_do_as_tables(alone):
    X, y = sweeps()
    numbers = X.assign(run=(X["run"] == "sweep 1").astype(float)).to_numpy()
    positions = {"scheduling": 1, "experiment": 2, "time": 3}
    model = OutputErrorLPV(spring_lpv(), rate=False, **positions)
    model.fit(numbers, y.to_numpy()[:, 0])
    np.testing.assert_allclose(model.coefficients_, alone.coefficients_, rtol=1e-9)
    assert model.predict(numbers).shape == (len(X),)


def test_missing_rows_cut_experiments(alone):
    X, y = sweeps()
    with_gaps = y.copy()
    with_gaps.iloc[100:110] = np.nan
    options = {"rate": False, **ROLES}
    with pytest.raises(ValueError, match="NaN"):
        OutputErrorLPV(spring_lpv(), **options).fit(X, with_gaps)
    model = OutputErrorLPV(spring_lpv(), missing="split", **options).fit(X, with_gaps)
    assert model.initial_states_.shape == (3, 2)
    assert list(model.report_["n_samples"]) == [390, 400]
    deviation = np.sqrt(np.diag(alone.coefficients_covariance_))
    assert np.abs((model.coefficients_ - alone.coefficients_) / deviation).max() < 1.5


def test_constants_of_the_outputs_are_found():
    X, y = sweeps()
    level = np.where(X["run"] == "sweep 1", 0.7, -0.2)
    moved = y.add(level, axis=0)
    model = OutputErrorLPV(spring_lpv(), rate=False, offset="constant", **ROLES)
    model.fit(X, moved)
    np.testing.assert_allclose(model.offsets_[:, 0], [-0.2, 0.7], atol=0.05)
    # predictions begin at their mean, and stay there without an input
    mean = model.offsets_.mean(axis=0)
    rest = model.predict(X.assign(force=0.0))
    np.testing.assert_allclose(rest, np.tile(mean, (len(X), 1)), rtol=1e-12)
    np.testing.assert_allclose(model.lpv_.output_offset([0.5]), [mean], rtol=1e-12)


def test_a_record_far_from_zero_is_predicted_with_its_constant():
    X, y = sweeps()
    model = OutputErrorLPV(spring_lpv(), rate=False, offset="constant", **ROLES)
    assert model.fit(X, y + 50.0).score(X, y + 50.0) > 0.9


def test_what_it_knows_of_itself(alone):
    q = len(alone.coefficients_)
    assert alone.coefficients_covariance_.shape == (q, q)
    assert not alone.rate_
    assert alone.history_.columns.tolist() == ["round", "cost"]
    assert alone.report_.columns.tolist() == ["n_samples", "start_BFT", "BFT"]
    copy = pickle.loads(pickle.dumps(alone))
    X, _ = sweeps()
    np.testing.assert_array_equal(copy.predict(X), alone.predict(X))
    assert not hasattr(clone(alone), "lpv_")


def test_names_and_units_of_the_table_travel():
    X, y = sweeps(n=1, n_samples=200)
    units = {"force": "N", "position": "m", "k": "1/s2"}
    options = {"rate": False, "max_iter": 1, "units": units}
    nameless = replace(spring_lpv(), scheduling_names=None, units={"kappa": "1"})
    own = replace(nameless, input_names=["F"], scheduling_names=["load"])
    model = OutputErrorLPV(nameless, **ROLES, **options).fit(X, y)
    frozen = model.lpv_.at(0.7)
    assert list(frozen.input_names) == ["force"]
    assert list(frozen.output_names) == list(model.output_errors_.index) == ["position"]
    assert list(model.lpv_.scheduling_names) == ["kappa"]
    assert frozen.units == model.lpv_.units == {"kappa": "1", **units}
    axes = SimulationDisplay.from_estimator(model, X, y).axes_
    assert axes[0].get_ylabel() == "position (m)"
    found = OutputErrorLPV(own, **ROLES, **options).fit(X, y).lpv_
    assert (*found.input_names, *found.scheduling_names) == ("F", "load")


def test_columns_of_a_multiindex_are_named_by_tuples():
    X, y = sweeps(n=1, n_samples=200)
    X.columns = pd.MultiIndex.from_tuples([("t", name) for name in X])
    roles = {role: ("t", column) for role, column in ROLES.items()}
    model = OutputErrorLPV(spring_lpv(), rate=False, max_iter=1, **roles).fit(X, y)
    assert model.scheduling_names_ == [("t", "kappa")]
    assert model.lpv_.input_names == [("t", "force")]


def test_leaving_the_range_is_told(alone):
    X, _ = spring_sweep(100)
    with pytest.warns(ExtrapolationWarning, match="'kappa'.*farthest at 2"):
        alone.predict(X.assign(kappa=np.linspace(0, 2, 100)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": "yes"}, "`rate` must be"),
        ({"units": "m"}, "`units` must be"),
        ({"prior": "global"}, "`prior` must be"),
        ({"prior": -1.0}, "`prior` must be"),
        ({"start": "arx"}, "`start` must be"),
        ({"initial_state": "zero"}, "`initial_state` must be"),
        ({"offset": "linear"}, "`offset` must be"),
        ({"missing": "drop"}, "`missing` must be"),
        ({"max_iter": 0}, "`max_iter` must be"),
        ({"interpolator": "auto"}, "`interpolator` must be an estimator or None. Got"),
        ({"interpolator": LinearRegression()}, "`interpolator` needs an interpolator"),
        ({"local": 3}, "`local` must be an estimator or None. Got int"),
        ({"n_jobs": 0}, "`n_jobs` must be None or an integer, -1 for all"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        OutputErrorLPV(**options, **ROLES).fit(*sweeps(n_samples=50))


def test_a_start_of_other_channels_is_refused():
    X, y = sweeps(n_samples=50)
    with pytest.raises(ValueError, match="`start` has 1 input"):
        OutputErrorLPV(spring_lpv(), **ROLES).fit(X.assign(torque=X["force"]), y)


def test_the_progress_bar_tells_the_cost(capsys):
    X, y = sweeps(n_samples=100)
    OutputErrorLPV(spring_lpv(), rate=False, verbose=1, **ROLES).fit(X, y)
    assert "cost=" in capsys.readouterr().err


# -- what the errors tell --------------------------------------------------------------


@pytest.mark.slow
def test_a_run_of_a_few_samples_is_fitted_with_the_others():
    X, y = sweeps()
    few = X["run"] == "sweep 1"
    keep = ~few | (np.cumsum(few) <= 4)
    roles = ROLES | {"experiment": "run"}
    found = OutputErrorLPV(spring_structure(), **roles).fit(X[keep], y[keep])
    assert found.report_.loc["sweep 0", "BFT"] > 90.0


def held_springs(n=2, before=10):
    """Sweeps that begin where a force has held the spring for long."""
    X, _ = sweeps(n=n, noise=0.0)
    truth = replace(spring_lpv(), steady_start=True)
    runs, outputs = [], []
    for _, run in X.groupby("run"):
        force = run["force"].to_numpy() + 3.0
        force[:before] = 3.0
        runs.append(run.assign(force=force))
        y = truth.simulate(force, run["kappa"], 0.02)
        outputs.append(pd.DataFrame({"position": y[:, 0]}))
    return pd.concat(runs), pd.concat(outputs, ignore_index=True)


def test_predictions_begin_as_the_experiments_do():
    X, y = held_springs()
    y = y + 0.03 * y.std().item() * np.random.default_rng(3).normal(size=y.shape)
    model = OutputErrorLPV(spring_lpv(), rate=False, **ROLES).fit(X, y)
    assert model.lpv_.steady_start
    assert bft_score(y, model.predict(X)) > 95.0
    at_rest = OutputErrorLPV(spring_lpv(), rate=False, initial_state="rest", **ROLES)
    with collected():  # which they are not
        assert not at_rest.fit(X, y).lpv_.steady_start


def test_experiments_at_rest_begin_there(alone):
    assert not alone.lpv_.steady_start
    X, y = held_springs()
    rest = y.assign(position=spring_lpv().simulate(X["force"], X["kappa"], 0.02)[:, 0])
    model = OutputErrorLPV(spring_lpv(), rate=False, **ROLES).fit(X[:400], rest[:400])
    assert not model.lpv_.steady_start


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`lpv_` is unstable")  # as it is without them
def test_constants_that_are_missing_are_told():
    X, y = sweeps(n=1)
    roles = ROLES | {"experiment": "run"}
    off = y + y.std()
    with pytest.warns(UserWarning, match="Use offset='constant'"):
        OutputErrorLPV(spring_structure(), offset=None, **roles).fit(X, off)
    found = OutputErrorLPV(spring_structure(), **roles).fit(X, off)
    assert found.report_["BFT"].min() > 90.0
    np.testing.assert_allclose(found.offsets_, y.std().item(), rtol=0.05)
    # and none where there are none
    assert not OutputErrorLPV(spring_structure(), **roles).fit(X, y).offsets_.any()


@pytest.mark.slow
@pytest.mark.parametrize("gain", [-1.0, 1000.0])
def test_a_sensor_of_another_sign_or_unit_is_told(both, memory, gain):
    """Constants do not stand for it: local experiments hold the model."""
    X, y = both[1]
    moves = X.groupby("run")["kappa"].transform(np.ptp) > 0.0
    other = y.mul(np.where(moves, gain, 1.0), axis=0)
    with pytest.warns(UserWarning, match="'position' is .* times what") as w:
        spring_pipeline(memory=memory, refiner=OutputErrorLPV()).fit(X, other)
    assert len(w) == 1


@pytest.mark.slow
def test_a_delay_that_is_missing_is_told():
    X, y = sweeps(n=1)
    roles = ROLES | {"experiment": "run"}
    late = y.groupby(X["run"]).shift(4).fillna(0.0)
    with pytest.warns(UserWarning, match="'position' follow from the inputs.*delay"):
        OutputErrorLPV(spring_structure(), **roles).fit(X, late)


@pytest.mark.slow
@pytest.mark.parametrize("rate", ["auto", True])
def test_a_gain_without_states_has_no_rate_terms(rate):
    rng = np.random.default_rng(0)
    X, y = spring_sweep(200, seed=1)
    X = pd.concat([X.assign(run=run) for run in ("up", "down")], ignore_index=True)
    gain, force = 2.0 + X["kappa"], rng.standard_normal(len(X))
    X, y = X.assign(force=force), gain * force + 0.01 * rng.standard_normal(len(X))
    static = GrayBoxStructure.full(0, 1, 1)
    model = OutputErrorLPV(static, rate=rate, **ROLES).fit(X, y)
    assert not model.rate_
    np.testing.assert_allclose(model.lpv_.parameters(FINE)[:, 0], 2.0 + FINE, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_smooth_inputs_of_moving_records_are_held_or_ramps(hold, noise):
    rng = np.random.default_rng(0)
    t, kappa = np.arange(600), 1 - np.cos(np.linspace(0, 9, 600))
    f = np.linspace(0.01, 1 / 10, 15)
    u = np.cos(2 * np.pi * f * t[:, None] + rng.uniform(0, 6.3, 15)).sum(1)
    ends = np.array([[0.0], [2.0]])
    form = PolynomialLPV(1).fit(ends, [[1.0, 20.0], [2.0, 45.0]])
    structure = GrayBoxStructure.from_template(
        A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0]]
    )
    truth = LPVStateSpace(structure, form, ends, hold=hold)
    y = truth.simulate(u, kappa, 0.05)
    y += noise * y.std() * rng.standard_normal(y.shape)
    X, y = from_trajectories([(u, kappa, y)], sampling_time=0.05)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    form = PolynomialLPV(1)
    model = OutputErrorLPV(structure, rate=False, interpolator=form, **roles)
    assert model.fit(X, y).lpv_.hold == hold
    found, true = (m.parameters([0.0, 1.0, 2.0]) for m in (model.lpv_, truth))
    np.testing.assert_allclose(found, true, rtol=0.03 if noise else 1e-6)


def test_errors_are_those_that_are_left_however_few_the_steps():
    X, y = sweeps(noise=0.0, n=1)
    truth = spring_lpv()
    start = with_coefficients(truth, 1.05 * coefficients_of(truth))
    few = OutputErrorLPV(start, max_iter=4, rate=False, **ROLES).fit(X, y)
    assert (np.asarray(y) - few.predict(X)).std() < 1e-6
    assert few.deviation_[0] < 1e-6
