"""LocalLPVPipeline: from local experiments to an LPV model."""

import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.ensemble import RandomForestRegressor
from sklearn.linear_model import LinearRegression

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
)

from .conftest import KAPPA, spring_structure, spring_sweep, spring_tables, spring_truth

ROLES = {"scheduling": "kappa", "experiment": "run", "time": "time"}


def spring_pipeline(**options):
    options = {"restructurer": GrayBoxRestructurer(spring_structure()), **options}
    return LocalLPVPipeline(**ROLES, **options)


@pytest.fixture(scope="module")
def fitted(spring):
    X, y, _, _ = spring
    return spring_pipeline().fit(X, y)


def test_noise_free_experiments_give_the_true_model(fitted, spring):
    _, _, X_sweep, y_sweep = spring
    np.testing.assert_allclose(fitted.operating_points_[:, 0], KAPPA)
    np.testing.assert_allclose(fitted.parameters_, spring_truth(KAPPA), rtol=1e-6)
    np.testing.assert_allclose(fitted.predict(X_sweep), y_sweep, atol=1e-6)


def test_parameters_and_report_are_tables_by_operating_point(fitted):
    assert list(fitted.parameters_.columns) == ["b", "c", "k"]
    assert list(fitted.parameters_.index) == list(KAPPA)
    report = fitted.report_
    assert list(report.index) == list(KAPPA)
    assert (report["n_samples"] == 600).all()
    assert (report["local_BFT"] > 99.999).all()
    assert (report["structured_BFT"] > 99.999).all()
    assert (report["relative_error"] < 1e-6).all()
    assert (report["interpolation_error"] < 1e-6).all()


def test_prediction_is_the_simulation_of_the_lpv_model(fitted, spring):
    _, _, X, _ = spring
    direct = fitted.lpv_.simulate(X[["force"]], X["kappa"], 0.02)
    np.testing.assert_array_equal(fitted.predict(X), direct)


def test_order_of_experiments_does_not_matter(fitted, spring):
    X, y, X_sweep, _ = spring
    order = np.concatenate([X.index[X["run"] == f"p{k}r0"] for k in (2, 0, 3, 1)])
    other = spring_pipeline().fit(X.loc[order], y.loc[order])
    np.testing.assert_allclose(other.parameters_, fitted.parameters_, rtol=1e-9)


def test_rows_of_experiments_may_be_interleaved(fitted, spring):
    X, _, _, _ = spring
    mixed = X.sort_values("time", kind="stable")
    expected = pd.DataFrame(fitted.predict(X), index=X.index).loc[mixed.index]
    np.testing.assert_array_equal(fitted.predict(mixed), expected)


@pytest.mark.parametrize("combine", ["pool", "average"])
def test_realizations_are_pooled_or_averaged(combine):
    X, y = spring_tables(noise=0.03, n_repeats=4)
    pipeline = spring_pipeline(combine=combine).fit(X, y)
    X_sweep, y_sweep = spring_sweep()
    assert bft_score(y_sweep, pipeline.predict(X_sweep)) > 98
    assert (pipeline.report_["n_experiments"] == 4).all()
    np.testing.assert_allclose(pipeline.parameters_, spring_truth(KAPPA), rtol=0.05)


def test_baseline_without_structure_is_worse(fitted, spring):
    X, y, X_sweep, y_sweep = spring
    baseline = spring_pipeline(restructurer="passthrough").fit(X, y)
    assert baseline.restructurers_ == []
    assert baseline.parameters_.shape == (4, 4 + 2 + 2 + 1)
    for balanced, true in zip(
        baseline.structured_models_, fitted.structured_models_, strict=True
    ):
        assert (balanced - true).hinf_norm() < 1e-6 * true.hinf_norm()
    score = bft_score(y_sweep, baseline.predict(X_sweep))
    assert score < bft_score(y_sweep, fitted.predict(X_sweep)) - 1


def test_default_restructurer_is_the_canonical_form(spring):
    X, y, X_sweep, y_sweep = spring
    pipeline = LocalLPVPipeline(SubspaceLTI(feedthrough=False), **ROLES).fit(X, y)
    assert pipeline.parameters_.shape == (4, 4)  # two poles, two entries of B
    assert bft_score(y_sweep, pipeline.predict(X_sweep)) > 99.9


def test_any_regressor_interpolates(spring):
    X, y, X_sweep, y_sweep = spring
    linear = spring_pipeline(interpolator=LinearRegression()).fit(X, y)
    same = spring_pipeline(interpolator=PolynomialLPV(1)).fit(X, y)
    np.testing.assert_allclose(
        linear.predict(X_sweep), same.predict(X_sweep), atol=1e-9
    )
    forest = RandomForestRegressor(5, random_state=0)
    steps = spring_pipeline(interpolator=forest).fit(X, y)
    assert bft_score(y_sweep, steps.predict(X_sweep)) > 50


def test_sub_estimators_are_cloned(spring):
    X, y, _, _ = spring
    pipeline = spring_pipeline(local=SubspaceLTI(), interpolator=PolynomialLPV(1))
    pipeline.fit(X, y)
    assert not hasattr(pipeline.local, "lti_")
    assert not hasattr(pipeline.restructurer, "params_")
    assert not hasattr(pipeline.interpolator, "coef_")
    assert pipeline.local.inputs is None


def test_processes_do_not_change_the_result(fitted, spring):
    X, y, _, _ = spring
    parallel = spring_pipeline(n_jobs=2).fit(X, y)
    np.testing.assert_array_equal(parallel.parameters_, fitted.parameters_)


def test_pickled_model_predicts_the_same(fitted, spring):
    _, _, X_sweep, _ = spring
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.predict(X_sweep), fitted.predict(X_sweep))


def test_initial_state_is_estimated_in_the_middle_of_an_experiment(fitted, spring):
    _, _, X, y = spring
    part = slice(500, 900)
    from_rest = fitted.predict(X.iloc[part])
    estimated = fitted.predict_with_initial_state(X.iloc[part], y.iloc[part])
    assert bft_score(y.iloc[part], from_rest) < 95
    np.testing.assert_allclose(estimated, y.iloc[part], atol=1e-6)


def test_one_operating_point_is_a_time_invariant_model(spring):
    X, y, _, _ = spring
    one = X["run"] == "p1r0"
    roles = {"inputs": "force", "experiment": "run", "time": "time"}
    pipeline = LocalLPVPipeline(
        SubspaceLTI(feedthrough=False), GrayBoxRestructurer(spring_structure()), **roles
    ).fit(X[one], y[one])
    np.testing.assert_allclose(pipeline.parameters_, spring_truth([0.5]), rtol=1e-6)
    np.testing.assert_allclose(pipeline.predict(X[one]), y[one], atol=1e-6)


def test_arrays_take_positions_as_roles(fitted, spring):
    X, y, _, _ = spring
    numbers = X.assign(run=X["run"].astype("category").cat.codes).to_numpy(float)
    pipeline = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(spring_structure()),
        scheduling=1,
        experiment=2,
        time=3,
    ).fit(numbers, y.to_numpy()[:, 0])
    np.testing.assert_allclose(pipeline.parameters_, fitted.parameters_, rtol=1e-9)
    assert pipeline.predict(numbers).shape == (len(X),)


def test_sampling_time_without_a_time_column(fitted, spring):
    X, y, X_sweep, _ = spring
    roles = {"scheduling": "kappa", "experiment": "run"}
    pipeline = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(spring_structure()),
        sampling_time=0.02,
        **roles,
    ).fit(X.drop(columns="time"), y)
    np.testing.assert_allclose(pipeline.parameters_, fitted.parameters_, rtol=1e-9)
    finer = X_sweep.assign(time=X_sweep["time"] / 2)
    assert not np.allclose(fitted.predict(finer), fitted.predict(X_sweep), atol=1e-2)


@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_tustin_warps_what_zero_order_hold_does_not(fitted, spring):
    X, y, _, _ = spring
    tustin = spring_pipeline(discretization="tustin").fit(X, y)
    error = np.abs(tustin.parameters_ / fitted.parameters_ - 1).max().max()
    assert 1e-4 < error < 0.1


def test_progress_goes_to_stderr_only(spring, capsys):
    X, y, _, _ = spring
    spring_pipeline(verbose=1).fit(X, y)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "local models" in captured.err and "restructuring" in captured.err


@pytest.mark.filterwarnings("ignore:The (identified )?model")
@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_failure_names_its_point_and_can_be_skipped(spring):
    X, y = spring[:2]
    y = y.copy()
    t = X.loc[X["run"] == "p2r0", "time"]
    y.loc[X["run"] == "p2r0", "position"] = np.exp(0.5 * t) * np.cos(20 * t)
    local = SubspaceLTI(order=2, feedthrough=False)
    with pytest.raises(ValueError, match=r"operating point 2 \(scheduling 1\).*stable"):
        spring_pipeline(local=local).fit(X, y)
    with pytest.warns(UserWarning, match="left out operating point 2"):
        kept = spring_pipeline(local=local, on_error="skip").fit(X, y)
    np.testing.assert_allclose(kept.operating_points_[:, 0], [0.0, 0.5, 1.5])
    np.testing.assert_allclose(
        kept.parameters_, spring_truth([0.0, 0.5, 1.5]), rtol=1e-5
    )


ERRORS = [
    ({"combine": "sum"}, "`combine` must be one of"),
    ({"discretization": "euler"}, "`discretization` must be one of"),
    ({"on_error": "ignore"}, "`on_error` must be one of"),
    ({"restructurer": "none"}, "`restructurer` must be an estimator"),
    ({"scheduling": "theta"}, "theta"),
    ({"sampling_time": 0.5}, "sampling"),
]


@pytest.mark.parametrize(("options", "words"), ERRORS)
def test_errors_teach(options, words, spring):
    X, y, _, _ = spring
    with pytest.raises(ValueError, match=words):
        LocalLPVPipeline(**{**ROLES, **options}).fit(X, y)


def test_a_sweep_is_refused_as_a_local_experiment(spring):
    X, y, X_sweep, y_sweep = spring
    with pytest.raises(ValueError, match="'sweep' must be local"):
        spring_pipeline().fit(pd.concat([X, X_sweep]), pd.concat([y, y_sweep]))


def test_shuffled_rows_are_refused(spring):
    X, y, _, _ = spring
    shuffled = np.random.default_rng(0).permutation(len(X))
    with pytest.raises(ValueError, match="time"):
        spring_pipeline().fit(X.iloc[shuffled], y.iloc[shuffled])


def test_nested_parameters_reach_the_steps():
    pipeline = spring_pipeline(local=SubspaceLTI(), interpolator=PolynomialLPV())
    pipeline.set_params(
        local__horizon=12, restructurer__n_starts=3, interpolator__degree=1
    )
    copy = clone(pipeline)
    assert copy.local.horizon == 12
    assert copy.restructurer.n_starts == 3
    assert copy.interpolator.degree == 1
