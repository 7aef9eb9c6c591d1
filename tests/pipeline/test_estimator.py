"""LocalLPVPipeline: from local experiments to an LPV model."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.ensemble import RandomForestRegressor
from sklearn.linear_model import LinearRegression

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
    bft_score,
    compare_models,
    fit_report,
)
from lpvlearn.datasets import make_unbalanced_disc
from lpvlearn.exceptions import DivergenceError, ExtrapolationWarning
from lpvlearn.subspace.streams import stream

from ..conftest import (
    KAPPA,
    ROLES,
    spring_pipeline,
    spring_structure,
    spring_sweep,
    spring_tables,
    spring_truth,
)
from .conftest import N_SAMPLES


@pytest.fixture(scope="module")
def fitted(spring, memory):
    X, y, _, _ = spring
    return spring_pipeline(memory=memory).fit(X, y)


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
    assert (report["n_samples"] == N_SAMPLES).all()
    assert (report["local_BFT"] > 99.999).all()
    assert (report["structured_BFT"] > 99.999).all()
    assert (report["relative_error"] < 1e-6).all()
    assert (report["interpolation_error"] < 1e-6).all()


def test_prediction_is_the_simulation_of_the_lpv_model(fitted, spring):
    _, _, X, _ = spring
    direct = fitted.lpv_.simulate(X[["force"]], X["kappa"], 0.02)
    np.testing.assert_array_equal(fitted.predict(X), direct)


@pytest.mark.slow
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


@pytest.mark.broad
@pytest.mark.parametrize("combine", ["pool", "average"])
def test_realizations_are_pooled_or_averaged(combine):
    X, y = spring_tables(noise=0.03, n_samples=300, n_repeats=4)
    pipeline = spring_pipeline(combine=combine).fit(X, y)
    X_sweep, y_sweep = spring_sweep()
    assert bft_score(y_sweep, pipeline.predict(X_sweep)) > 98
    assert (pipeline.report_["n_experiments"] == 4).all()
    np.testing.assert_allclose(pipeline.parameters_, spring_truth(KAPPA), rtol=0.05)


def test_baseline_without_structure_is_worse(fitted, spring, memory):
    X, y, X_sweep, y_sweep = spring
    baseline = spring_pipeline(restructurer="passthrough", memory=memory).fit(X, y)
    assert baseline.restructurers_ == []
    assert baseline.parameters_.shape == (4, 4 + 2 + 2 + 1)
    for balanced, true in zip(
        baseline.structured_models_, fitted.structured_models_, strict=True
    ):
        assert (balanced - true).hinf_norm() < 1e-6 * true.hinf_norm()
    score = bft_score(y_sweep, baseline.predict(X_sweep))
    assert score < bft_score(y_sweep, fitted.predict(X_sweep)) - 1


@pytest.mark.slow
def test_black_boxes_are_aligned_where_that_is_asked_for(fitted, spring):
    X, y, X_sweep, y_sweep = spring
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, feedthrough=False), "aligned", **ROLES
    ).fit(X, y)
    assert pipeline.restructurers_ == []
    assert pipeline.parameters_.shape == (4, 4 + 2 + 2)  # no feedthrough
    for turned, true in zip(
        pipeline.structured_models_, fitted.structured_models_, strict=True
    ):
        assert (turned - true).hinf_norm() < 1e-6 * true.hinf_norm()
    assert "each turned to its neighbour" in pipeline.summary()
    signs = spring_pipeline(restructurer="passthrough").fit(X, y)
    aligned, baseline = (
        bft_score(y_sweep, model.predict(X_sweep)) for model in (pipeline, signs)
    )
    assert aligned > baseline - 0.1


def test_a_restructurer_without_structure_takes_the_canonical_form(spring):
    X, y, X_sweep, y_sweep = spring
    pipeline = LocalLPVPipeline(
        SubspaceLTI(feedthrough=False), GrayBoxRestructurer(), **ROLES
    ).fit(X, y)
    assert pipeline.parameters_.shape == (4, 4)  # two poles, two entries of B
    assert bft_score(y_sweep, pipeline.predict(X_sweep)) > 99.9


def test_any_regressor_interpolates(spring, memory):
    X, y, X_sweep, y_sweep = spring
    linear = spring_pipeline(interpolator=LinearRegression(), memory=memory).fit(X, y)
    same = spring_pipeline(interpolator=PolynomialLPV(1), memory=memory).fit(X, y)
    np.testing.assert_allclose(
        linear.predict(X_sweep), same.predict(X_sweep), atol=1e-9
    )
    forest = RandomForestRegressor(5, random_state=0)
    steps = spring_pipeline(interpolator=forest, memory=memory).fit(X, y)
    assert bft_score(y_sweep, steps.predict(X_sweep)) > 50


@pytest.mark.slow
def test_points_of_few_samples_count_by_their_covariances():
    """Two operating points of 100 samples among five of 3000."""
    kappas = np.linspace(0, 1.5, 7)
    parts = [
        spring_tables(
            0.1, 100 if k in (1, 4) else 3000, seed=20 + k, kappas=kappas[k : k + 1]
        )
        for k in range(7)
    ]
    X = pd.concat([X.assign(run=k) for k, (X, _) in enumerate(parts)])
    y = pd.concat([y for _, y in parts])
    pipeline = spring_pipeline(local=SubspaceLTI(2, feedthrough=False)).fit(X, y)
    assert pipeline.interpolator_.form_ == "polynomial 2"
    assert pipeline.interpolator_.best_estimator_.weighted_
    assert "(polynomial 2)" in pipeline.summary()
    unweighted = PolynomialLPV().fit(kappas[:, None], pipeline.parameters_)
    fine = np.linspace(0, 1.5, 50)
    truth = spring_truth(fine)
    errors = [
        np.sqrt(np.mean(((found - truth) / truth) ** 2))
        for found in (
            pipeline.lpv_.parameters(fine),
            unweighted.predict(fine[:, None]),
        )
    ]
    assert errors[0] < errors[1] / 1.5


@pytest.mark.slow
def test_sub_estimators_are_cloned(spring):
    X, y, _, _ = spring
    pipeline = spring_pipeline(local=SubspaceLTI(), interpolator=PolynomialLPV(1))
    pipeline.fit(X, y)
    assert not hasattr(pipeline.local, "lti_")
    assert not hasattr(pipeline.restructurer, "params_")
    assert not hasattr(pipeline.interpolator, "coef_")
    assert pipeline.local.inputs is None


@pytest.mark.slow  # it starts processes
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_tustin_warps_what_zero_order_hold_does_not(fitted, spring):
    X, y, _, _ = spring
    tustin = spring_pipeline(discretization="tustin").fit(X, y)
    error = np.abs(tustin.parameters_ / fitted.parameters_ - 1).max().max()
    assert 1e-4 < error < 0.1


@pytest.mark.slow
def test_progress_goes_to_stderr_only(spring, capsys):
    X, y, _, _ = spring
    spring_pipeline(verbose=1).fit(X, y)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "local models" in captured.err and "restructuring" in captured.err


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:any 3 points lie on a form")
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
    with pytest.warns(UserWarning, match="left out operating point 2") as caught:
        kept = spring_pipeline(local=local, on_error="skip").fit(X, y)
    (told,) = (w for w in caught if "left out" in str(w.message))
    assert told.filename == __file__
    np.testing.assert_allclose(kept.operating_points_[:, 0], [0.0, 0.5, 1.5])
    np.testing.assert_allclose(
        kept.parameters_, spring_truth([0.0, 0.5, 1.5]), rtol=1e-5
    )


ERRORS = [
    ({"combine": "sum"}, "`combine` must be 'pool' or 'average'"),
    ({"discretization": "euler"}, "`discretization` must be 'auto', 'zoh'"),
    ({"on_error": "ignore"}, "`on_error` must be 'raise' or"),
    ({"local": SubspaceLTI(inputs=[0])}, "`inputs` must be given to LocalLPVPipe"),
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


def test_parameters_of_a_default_step_can_be_set():
    pipeline = LocalLPVPipeline(**ROLES)
    pipeline.set_params(local__horizon=12, interpolator__criterion="bic")
    assert pipeline.local.get_params() == SubspaceLTI(horizon=12).get_params()
    assert pipeline.interpolator.get_params() == AutoLPV("bic").get_params()
    assert pipeline.restructurer is None
    with pytest.raises(ValueError, match="Invalid parameter 'horizn'"):
        pipeline.set_params(local__horizn=3)


# --------------------------------------------------------- where the model is not valid


def test_leaving_the_identified_range_warns_once_for_all_experiments(fitted, spring):
    X = spring[2]
    beyond = pd.concat(
        [
            X.assign(run=run, kappa=X["kappa"] + shift)
            for run, shift in (("a", 1), ("b", 2))
        ]
    )
    with pytest.warns(ExtrapolationWarning) as caught:
        fitted.predict(beyond)
    (warning,) = caught
    text = str(warning.message)
    outside = int((beyond["kappa"] > 1.5 + 1e-5).sum())
    assert "'kappa' must be within the identified range, 0 to 1.5." in text
    assert f"Got {outside} of 3000 samples outside, the farthest at 3.5" in text
    assert warning.filename == __file__


def test_the_model_tells_of_extrapolation_as_predict_does(fitted, spring):
    _, _, X_sweep, _ = spring
    u, kappa = X_sweep[["force"]], X_sweep["kappa"] + 0.2
    for use in (
        lambda: fitted.predict(X_sweep.assign(kappa=kappa)),
        lambda: fitted.lpv_.simulate(u, {"kappa": kappa}, 0.02),
        lambda: fitted.lpv_.at({"kappa": 1.7}),
    ):
        with pytest.warns(ExtrapolationWarning, match="'kappa' must be within the ide"):
            use()
    np.testing.assert_array_equal(
        fitted.lpv_.at({"kappa": 0.7}).A, fitted.lpv_.at(0.7).A
    )


def test_holding_the_border_is_no_extrapolation(spring, memory):
    X, y, X_sweep, _ = spring
    clipped = PolynomialLPV(extrapolation="clip")
    pipeline = spring_pipeline(interpolator=clipped, memory=memory)
    pipeline.fit(X, y)
    beyond = X_sweep.assign(kappa=9.0)
    border = X_sweep.assign(kappa=1.5)
    np.testing.assert_allclose(pipeline.predict(beyond), pipeline.predict(border))


def test_the_interpolators_own_warning_is_not_added(spring, memory):
    X, y, X_sweep, _ = spring
    warning = PolynomialLPV(extrapolation="warn")
    pipeline = spring_pipeline(interpolator=warning, memory=memory)
    pipeline.fit(X, y)
    with pytest.warns(ExtrapolationWarning) as caught:
        pipeline.predict(X_sweep.assign(kappa=2.0))
    assert len(caught) == 1


@pytest.mark.slow
def test_motion_seen_in_local_experiments_is_within_the_range():
    X, y = spring_tables()
    rng = np.random.default_rng(0)
    noisy = X.assign(kappa=X["kappa"] + 0.01 * rng.normal(size=len(X)))
    pipeline = spring_pipeline().fit(noisy, y)
    pipeline.predict(noisy)  # does not warn
    low, high = pipeline.scheduling_range_[:, 0]
    assert -0.15 < low < -0.02 and 1.52 < high < 1.65


@pytest.mark.broad
@pytest.mark.parametrize("kappa", [0.0, 0.5])
def test_one_operating_point_with_noise_is_a_time_invariant_model(kappa):
    X, y = spring_tables(kappas=(0.5,), n_repeats=2)
    rng = np.random.default_rng(1)
    noisy = X.assign(kappa=kappa + 1e-3 * rng.normal(size=len(X)))
    with pytest.warns(UserWarning, match="one operating point .*time-invariant"):
        pipeline = spring_pipeline(interpolator=PolynomialLPV(3)).fit(noisy, y)
    assert pipeline.interpolator_.degree == 0
    np.testing.assert_allclose(pipeline.parameters_, spring_truth([0.5]), rtol=1e-6)
    np.testing.assert_allclose(pipeline.predict(noisy), y, atol=1e-6)
    assert "time-invariant" in pipeline.summary()
    with pytest.warns(ExtrapolationWarning):
        pipeline.predict(noisy.assign(kappa=1.0))


def test_one_sweep_is_no_operating_point(spring):
    with pytest.raises(ValueError, match="'sweep' must be local"):
        spring_pipeline().fit(*spring[2:])


def test_two_points_carry_a_line_by_default(spring, memory):
    X, y, _, _ = spring
    two = X["kappa"].isin([0.0, 0.5])
    pipeline = spring_pipeline(memory=memory)
    with pytest.warns(UserWarning, match="nothing tells of what is between"):
        pipeline.fit(X[two], y[two])
    assert pipeline.interpolator_.form_ == "polynomial 1"
    pipeline.set_params(interpolator=PolynomialLPV(1)).fit(X[two], y[two])
    assert pipeline.warnings_ == []


# -------------------------------------------------------------------- tables and arrays


@pytest.mark.slow
def test_read_only_and_memory_mapped_arrays(fitted, spring, tmp_path):
    X, y, _, _ = spring
    numbers = X.assign(run=X["run"].astype("category").cat.codes).to_numpy(float)
    roles = {"scheduling": 1, "experiment": 2, "time": 3}
    np.save(tmp_path / "X.npy", numbers)
    mapped = np.load(tmp_path / "X.npy", mmap_mode="r")
    frozen = y.to_numpy().copy()
    frozen.setflags(write=False)
    pipeline = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(spring_structure()), **roles
    ).fit(mapped, frozen)
    np.testing.assert_array_equal(pipeline.parameters_, fitted.parameters_)
    np.testing.assert_array_equal(pipeline.predict(mapped), fitted.predict(X))


def test_polars_tables(fitted, spring):
    polars = pytest.importorskip("polars")
    X, y, X_sweep, y_sweep = (
        polars.DataFrame({name: table[name].tolist() for name in table})
        for table in spring
    )
    pipeline = spring_pipeline().fit(X, y)
    # scikit-learn 1.6 does not see the names of the newest polars' columns
    names = getattr(pipeline, "feature_names_in_", X.columns)
    assert list(names) == list(X.columns)
    assert pipeline.output_names_ == ["position"]
    np.testing.assert_array_equal(pipeline.parameters_, fitted.parameters_)
    np.testing.assert_array_equal(pipeline.predict(X_sweep), fitted.predict(spring[2]))
    assert fit_report(pipeline, X_sweep, y_sweep)["experiment"].tolist() == ["sweep"]


def test_names_of_columns_are_kept_and_checked(fitted, spring):
    X = spring[0]
    assert list(fitted.feature_names_in_) == ["force", "kappa", "run", "time"]
    assert fitted.n_features_in_ == 4
    assert fitted.output_names_ == ["position"]
    assert fitted.scheduling_names_ == ["kappa"]
    with pytest.raises(ValueError, match=r"none of name 'force' \(inputs\)"):
        fitted.predict(X.rename(columns={"force": "u"}))


@pytest.mark.slow
def test_columns_of_a_multiindex_take_roles(fitted, spring, memory):
    X, y, X_sweep, y_sweep = spring
    names = {"force": ("in", "force"), "kappa": ("set", "kappa")}
    names |= {"run": ("row", "run"), "time": ("row", "time")}

    def renamed(X):
        return X.set_axis(pd.MultiIndex.from_tuples(map(names.get, X)), axis=1)

    outputs = pd.MultiIndex.from_tuples([("out", "position")])
    roles = {role: names[column] for role, column in ROLES.items()}
    model = spring_pipeline(memory=memory).set_params(**roles)
    model.fit(renamed(X), y.set_axis(outputs, axis=1)).set_output(transform="pandas")
    found = model.predict(renamed(X_sweep))
    np.testing.assert_array_equal(found, fitted.predict(X_sweep))
    assert found.columns.equals(outputs)
    assert model.scheduling_names_ == [("set", "kappa")]
    assert model.lpv_.at(0.5).input_names == [("in", "force")]
    assert len(fit_report(model, renamed(X_sweep), y_sweep)) == 1
    with pytest.warns(ExtrapolationWarning, match="'set', 'kappa'"):
        model.predict(renamed(X_sweep.assign(kappa=9.0)))


def test_html_shows_the_steps_before_and_after_fitting(fitted):
    nested = spring_pipeline(local=SubspaceLTI(), interpolator=PolynomialLPV())
    for pipeline, state in ((nested, "Not fitted"), (fitted, "Fitted")):
        html = pipeline._repr_html_()
        assert "GrayBoxRestructurer" in html and "GrayBoxStructure" in html
        assert state in html
    assert "PolynomialLPV" in nested._repr_html_()


@pytest.mark.slow
@pytest.mark.parametrize("combine", ["pool", "average"])
def test_gaps_are_split_where_the_local_estimator_splits(spring, combine):
    X, y = spring_tables(n_repeats=2)
    y = y.mask((X["time"] > 5.0) & (X["time"] < 5.5), axis=0)
    with pytest.raises(ValueError, match="Input y contains NaN"):
        spring_pipeline().fit(X, y)
    local = SubspaceLTI(order=2, horizon=10, missing="split")
    pipeline = spring_pipeline(local=local, combine=combine).fit(X, y)
    np.testing.assert_allclose(pipeline.parameters_, spring_truth(KAPPA), rtol=1e-6)
    assert (pipeline.report_["n_experiments"] == 2).all()


@pytest.mark.slow
def test_deviations_of_averaged_parameters_cover_their_errors():
    """Errors are of the size of the deviations."""
    X, y = spring_tables(noise=0.05, n_samples=300, n_repeats=12)
    local = SubspaceLTI(order=2, horizon=10, feedthrough=False)
    pipeline = spring_pipeline(local=local, combine="average").fit(X, y)
    errors = (pipeline.parameters_ - spring_truth(KAPPA)) / pipeline.parameters_std_
    assert errors.shape == (4, 3)
    assert 0.4 < np.sqrt((errors**2).mean(axis=None)) < 2.0
    assert (errors.abs() < 4).all(axis=None)
    np.testing.assert_array_equal(
        pipeline.report_["std_k"], pipeline.parameters_std_["k"]
    )
    assert " std" in pipeline.summary()


def load_and_heat(places):
    """k = 40 + 10 load + 5 heat: a table with an experiment at each place."""
    tables, outputs = [], []
    rng = np.random.default_rng(0)
    for run, (load, heat) in enumerate(places):
        u = rng.choice([-1.0, 1.0], size=60).repeat(5)
        theta = {"b": 30.0, "c": 1.2, "k": 40.0 + 10 * load + 5 * heat}
        y = spring_structure().model(theta).simulate(u, sampling_time=0.02)
        time = 0.02 * np.arange(300)
        roles = {"load": load, "heat": heat, "run": run, "time": time}
        tables.append(pd.DataFrame({"force": u, **roles}))
        outputs.append(y)
    X, y = pd.concat(tables, ignore_index=True), np.vstack(outputs)[:, 0]
    pipeline = LocalLPVPipeline(
        SubspaceLTI(order=2, horizon=10),
        GrayBoxRestructurer(spring_structure()),
        PolynomialLPV(1),
        **{**ROLES, "scheduling": ["load", "heat"]},
    )
    return pipeline.fit(X, y), X, y


def test_two_scheduling_variables():
    """On a grid of four points and at one within."""
    grid = [(0, 0), (0, 1), (1, 0), (1, 1), (0.5, 0.5)]
    pipeline, X, y = load_and_heat(grid)
    assert pipeline.parameters_.index[1] == (0.0, 1.0)
    assert pipeline.report_.index.equals(pipeline.parameters_.index)
    np.testing.assert_allclose(pipeline.predict(X), y, atol=1e-6)
    assert "load from 0 to 1, heat from 0 to 1" in pipeline.summary()
    with pytest.warns(ExtrapolationWarning, match="'heat' .* the farthest at 3"):
        pipeline.predict(X.assign(heat=3.0))


@pytest.mark.filterwarnings("ignore:3 operating points determine")
def test_a_corner_that_no_points_surround_is_extrapolation():
    pipeline, X, y = load_and_heat([(0, 0), (0, 1), (1, 0)])
    np.testing.assert_allclose(pipeline.predict(X), y, atol=1e-6)
    with pytest.warns(ExtrapolationWarning, match="'load' = 1, 'heat' = 1, by 71 %"):
        pipeline.predict(X.assign(load=1.0, heat=1.0))


@pytest.mark.filterwarnings("ignore:All experiments are at one operating point")
def test_motion_about_a_single_point_is_no_sweep():
    """An oscillation about zero, as of the arm's elbow, has no scale."""
    X, y = spring_tables(kappas=(0.5,))
    t = X["time"].to_numpy()
    wobble = 0.004 * (np.sin(1.3 * t) + np.sin(7.1 * t))
    spring_pipeline().fit(X.assign(kappa=wobble), y)
    with pytest.raises(ValueError, match="'p0r0' must be local"):
        spring_pipeline().fit(X.assign(kappa=np.linspace(-1, 1, len(X))), y)


# -- time ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:Scheduling variable 'kappa' must be within")
def test_a_prediction_that_diverges_names_the_experiment(spring):
    X, y, _, _ = spring
    line = PolynomialLPV(1)  # whose stiffness is negative far below
    model = spring_pipeline(interpolator=line).fit(X, y)
    far = X.assign(kappa=X["kappa"].where(X["run"] != "p2r0", -1e9))
    with pytest.raises(DivergenceError, match="Experiment 'p2r0': .*at scheduling"):
        model.predict(far)


@pytest.mark.slow
def test_time_may_come_from_the_local_estimator_or_be_counted_in_samples(spring):
    X, y, _, _ = spring
    bare = X.drop(columns="time")
    told = spring_pipeline().fit(X, y).parameters_
    for options in (
        {"local": SubspaceLTI(2, sampling_time=0.02)},
        {"sampling_time": 0.02},
    ):
        model = spring_pipeline(**options).set_params(time=None).fit(bare, y)
        pd.testing.assert_frame_equal(model.parameters_, told, rtol=1e-6)
    u = X.loc[X["run"] == "p0r0", ["force"]]
    lti = LocalLPVPipeline(SubspaceLTI(2, horizon=8)).fit(u, y.loc[u.index])
    assert lti.sampling_time_ == 1.0  # one black box: nothing means seconds


def shifted(X, y, inputs=0.0, outputs=0.0):
    """The same experiments, measured with other zeros."""
    return X.assign(force=X["force"] + inputs), y + outputs


@pytest.fixture(scope="module")
def about_zero(spring):
    X, y, _, _ = spring
    return spring_pipeline(local=SubspaceLTI(offset=None)).fit(X, y)


@pytest.mark.slow
@pytest.mark.parametrize(
    "structure", [None, pytest.param(spring_structure(), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("moved", [{"outputs": 3.0}, {"inputs": -2.0}])
def test_other_zeros_of_the_sensors_change_nothing(spring, structure, moved):
    X, y, X_sweep, y_sweep = spring
    restructurer = structure and GrayBoxRestructurer(structure)
    local = SubspaceLTI(2, horizon=8, feedthrough=False)
    pipeline = spring_pipeline(local=local, restructurer=restructurer)
    plain = clone(pipeline).fit(X, y)
    pipeline.fit(*shifted(X, y, **moved))
    assert plain.lpv_.offsets is None
    at_rest = plain.predict_with_initial_state(X_sweep, y_sweep)
    there = shifted(X_sweep, y_sweep, **moved)
    np.testing.assert_allclose(
        pipeline.predict_with_initial_state(*there),
        at_rest + moved.get("outputs", 0.0),
        atol=2e-3 * y_sweep.std().item(),
    )


def test_offsets_are_left_out_where_there_are_none(spring, about_zero):
    X, y, X_sweep, _ = spring
    pipeline = spring_pipeline().fit(X, y)
    assert pipeline.lpv_.offsets is None
    np.testing.assert_allclose(
        pipeline.predict(X_sweep), about_zero.predict(X_sweep), atol=1e-6
    )


@pytest.mark.slow
def test_a_model_without_offsets_says_what_it_misses(spring):
    X, y, _, _ = spring
    X, y = X[X["kappa"] < 1], y[X["kappa"] < 1]
    local = SubspaceLTI(2, horizon=8, offset=None)
    for options in ({"offsets": None}, {"local": local}):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            pipeline = spring_pipeline(**options).fit(X, y + 3.0)
        assert any("the LPV model has no offsets" in str(w.message) for w in told)
        assert pipeline.lpv_.offsets is None


@pytest.mark.slow
@pytest.mark.parametrize("detrend", ["constant", "linear"])
def test_detrend_of_the_local_step_is_honoured(spring, detrend):
    X, y, X_sweep, y_sweep = spring
    local = SubspaceLTI(2, horizon=8, detrend=detrend)
    pipeline = spring_pipeline(local=local).fit(X, y + 3.0)
    assert pipeline.report_["local_BFT"].min() > 95
    assert pipeline.score(X, y + 3.0) > 0.98
    assert pipeline.score(X_sweep, y_sweep + 3.0) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("with_structure, bar", [(True, 98.5), (False, 93.0)])
def test_a_system_that_stands_about_offsets(with_structure, bar):
    data = make_unbalanced_disc(5, duration=8.0, large_duration=20.0, random_state=3)
    structure = GrayBoxRestructurer(data.structure) if with_structure else None
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, horizon=15, feedthrough=False),
        structure,
        scheduling="kappa",
        experiment="experiment",
        time="time",
    ).fit(data.X, data.y)
    X, y = data.X_large[data.X_large.columns[::-1]], data.y_large
    simulated = pipeline.predict(X)
    assert bft_score(y, simulated) > bar
    assert bft_score(y, pipeline.predict_with_initial_state(X, y)) > bar
    voltages = pipeline.report_["u0_voltage"]
    np.testing.assert_allclose(voltages, data.holding_voltages, atol=0.02)
    angles = pipeline.report_["y0_angle"]
    np.testing.assert_allclose(angles, data.operating_points, atol=0.01)
    assert "Points of work: voltage -4.4" in pipeline.summary()
    models = {"pipeline": pipeline, "model": pipeline.lpv_}
    fits = compare_models(models, X, y)["BFT"]
    np.testing.assert_allclose(fits, bft_score(y, simulated))
    turned = pipeline.lpv_.change_basis(lambda k: [[1.0, k[0]], [0.0, 2.0 + k[0]]])
    again = turned.simulate(X[["voltage"]], X["kappa"], data.sampling_time)
    np.testing.assert_allclose(again, simulated, atol=1e-9)


@pytest.mark.slow
def test_constants_that_differ_at_one_point_are_told():
    X, y = spring_tables(noise=0.02, n_repeats=2, seed=3, kappas=KAPPA[:2])
    level = X["run"].astype("category").cat.codes.to_numpy() % 3 - 1.0
    for combine in ("pool", "average"):
        with pytest.warns(UserWarning, match="have different constants.*At all oper"):
            fitted = spring_pipeline(
                combine=combine, interpolator=PolynomialLPV(1)
            ).fit(X, y + 0.2 * level[:, None])
        truth = spring_truth(KAPPA[:2])
        np.testing.assert_allclose(fitted.parameters_, truth, rtol=0.05)
        assert fitted.report_["local_BFT"].min() > 95.0
        assert fitted.report_["structured_BFT"].min() > 95.0


# -- input delays ----------------------------------------------------------------


def late_springs(delays, noise=0.02):
    """Local experiments on the spring whose force acts late, by samples at each."""
    X, y = spring_tables(noise=noise, n_samples=N_SAMPLES)
    parts = [
        np.vstack([np.zeros((d, 1)), y.loc[rows.index].to_numpy()[: len(rows) - d]])
        for d, (_, rows) in zip(delays, X.groupby("run"), strict=True)
    ]
    return X, pd.DataFrame(np.vstack(parts), columns=["position"])


@pytest.mark.slow
@pytest.mark.parametrize("input_delay", [5, "auto"])
def test_a_delay_of_the_input_does_not_bend_the_parameters(input_delay):
    X, y = late_springs([5] * 4)
    pipeline = spring_pipeline(local=SubspaceLTI(input_delay=input_delay)).fit(X, y)
    np.testing.assert_allclose(
        pipeline.parameters_["k"], spring_truth(KAPPA)[:, 2], rtol=0.01
    )
    assert (pipeline.report_["delay_force"] == 5).all()
    assert (pipeline.report_["local_BFT"] > 97).all()
    assert (pipeline.report_["structured_BFT"] > 97).all()
    np.testing.assert_allclose(pipeline.lpv_.input_delay, [0.1])
    for model in (*pipeline.local_models_, *pipeline.structured_models_):
        np.testing.assert_allclose(model.input_delay, [0.1])
    assert pipeline.score(X, y) > 0.99
    fit = bft_score(y, pipeline.predict_with_initial_state(X, y))
    assert fit > 95
    assert "Input delay: 5 sample(s)" in pipeline.summary()


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"combine": "average"}, {"efficient": False}])
def test_delays_go_along_with_the_options(options):
    X, y = late_springs([3] * 4, noise=0.0)
    local = SubspaceLTI(input_delay=3)
    pipeline = spring_pipeline(local=local, **options).fit(X, y)
    np.testing.assert_allclose(pipeline.parameters_, spring_truth(KAPPA), rtol=1e-5)


@pytest.mark.slow
def test_points_tell_a_delay_together():
    """A furnace at four throughputs: short records, each of which tells another one."""
    rng, parts, dt = np.random.default_rng(0), [], 30.0
    throughputs = np.array([0.2, 0.5, 0.8, 1.1])
    for run, p in enumerate(np.repeat(throughputs, 2)):
        n = 45 + int(rng.integers(-8, 12))
        u = np.full(n, 5.0 * rng.choice([-1.0, 1.0]))
        u[:6] = 0.0
        gain, rate = 3.0 / (0.5 + p), (0.5 + p) / 300.0
        late = np.concatenate([np.zeros(2), u[:-2]])
        y = StateSpace(-rate, gain * rate, 1.0).simulate(late, sampling_time=dt)[:, 0]
        y += 400.0 + 40.0 * p + 0.1 * gain * rng.standard_normal(n)
        columns = {"gas": 50.0 + u, "p": p, "T": y, "t": dt * np.arange(n)}
        parts.append(pd.DataFrame(columns).assign(run=run))
    table = pd.concat(parts, ignore_index=True)
    furnace = GrayBoxStructure.from_template(A=[["-a"]], B=[["b"]], C=[[1]])
    pipeline = LocalLPVPipeline(
        SubspaceLTI(input_delay="auto"),
        GrayBoxRestructurer(furnace),
        scheduling="p",
        experiment="run",
        time="t",
    )
    pipeline.fit(table[["run", "t", "gas", "p"]], table["T"])
    assert pipeline.input_delay_.tolist() == [2]
    rates = (0.5 + throughputs) / 300.0
    np.testing.assert_allclose(pipeline.parameters_["a"], rates, rtol=0.06)


@pytest.mark.slow
def test_no_delay_is_imagined():
    X, y = late_springs([0] * 4)
    pipeline = spring_pipeline(local=SubspaceLTI(input_delay="auto")).fit(X, y)
    assert not pipeline.lpv_.input_delay.any()
    assert "delay_force" not in pipeline.report_
    assert "Input delay" not in pipeline.summary()


@pytest.mark.slow
def test_delays_that_differ_between_points_are_told():
    X, y = late_springs([5, 5, 6, 5])
    local = SubspaceLTI(input_delay="auto")
    with pytest.warns(UserWarning, match=r"0: 5; 0.5: 5; 1: 6; 1.5: 5\)") as told:
        pipeline = spring_pipeline(local=local).fit(X, y)
    assert "takes the median, 5;" in str(told[0].message)
    np.testing.assert_allclose(pipeline.lpv_.input_delay, [0.1])
    np.testing.assert_array_equal(pipeline.report_["delay_force"], [5, 5, 6, 5])
    assert (pipeline.report_["structured_BFT"] > 97).all()
    np.testing.assert_allclose(
        pipeline.parameters_["k"], spring_truth(KAPPA)[:, 2], rtol=0.01
    )


def test_a_passed_through_model_keeps_its_delay():
    X, y = late_springs([2] * 4, noise=0.0)
    local = SubspaceLTI(2, input_delay=2)
    pipeline = spring_pipeline(local=local, restructurer="passthrough").fit(X, y)
    for model in pipeline.structured_models_:
        np.testing.assert_allclose(model.input_delay, [0.04])
    assert pipeline.score(X, y) > 0.99


@pytest.mark.slow
def test_points_of_which_no_sample_is_left_are_told():
    X, y = spring_tables(kappas=[0.0, 0.5, 1.0, 1.5], n_samples=200)
    y = y.copy()
    y[(X["run"] == X["run"].unique()[1]).to_numpy()] = np.nan
    pipeline = spring_pipeline(local=SubspaceLTI(2, missing="split"))
    with pytest.warns(UserWarning, match="no two consecutive samples"):
        pipeline.fit(X, y)
    assert pipeline.operating_points_.ravel().tolist() == [0.0, 1.0, 1.5]


def test_a_restructurer_in_the_first_place_is_named():
    X, y = spring_tables(n_samples=60)
    wrong = LocalLPVPipeline(GrayBoxRestructurer(spring_structure()), **ROLES)
    with pytest.raises(ValueError, match="which is a `restructurer`"):
        wrong.fit(X, y)


@pytest.mark.slow
@pytest.mark.parametrize("structured", [True, False])
def test_points_of_work_are_where_drifts_begin(structured):
    """Of outputs that drift by as much as they move, about a level."""
    X, y = spring_tables(noise=0.01)
    runs = X["run"].astype("category").cat.codes.to_numpy()
    drift = np.array([0.8, -1.0, 0.6, -0.4])[runs] * X["time"] / X["time"].max()
    X["force"] += 2.0 * X["kappa"]
    y = y["position"] + drift + 5.0
    restructurer = GrayBoxRestructurer(spring_structure()) if structured else None
    model = LocalLPVPipeline(restructurer=restructurer, **ROLES).fit(X, y)
    kappa = model.operating_points_
    moved = model.lpv_.input_offset(kappa) - 2.0 * kappa
    rest = model.lpv_.output_offset(kappa) - moved * [
        [lti.dc_gain().item()] for lti in model.structured_models_
    ]
    np.testing.assert_allclose(rest, 5.0, atol=0.02)
    assert (model.report_["local_BFT"] > 98.0).all()


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_scheduling_whose_noise_moves_the_outputs_is_told(noise):
    """A lag about a point of work: y = 100 kappa at rest."""
    rng, step = np.random.default_rng(0), 0.1
    rows = []
    for run, kappa in enumerate([0.0, 0.5, 1.0]):
        plant = StateSpace(-1.0 - kappa, 1.0 + kappa, 1.0)
        u = np.sign(rng.standard_normal(100)).repeat(5)
        y = 100.0 * kappa + plant.simulate(u, sampling_time=step)[:, 0]
        y += 0.01 * rng.standard_normal(500)
        level = kappa + noise * rng.standard_normal(500)
        columns = {"run": run, "t": step * np.arange(500), "level": level, "u": u}
        rows.append(pd.DataFrame({**columns, "y": y}))
    table = pd.concat(rows, ignore_index=True)
    roles = {"inputs": "u", "scheduling": "level", "experiment": "run", "time": "t"}
    pipeline = LocalLPVPipeline(SubspaceLTI(1, feedthrough=False), **roles)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pipeline.fit(table.drop(columns="y"), table[["y"]])
    said = [
        str(one.message) for one in told if "noise of the sched" in str(one.message)
    ]
    assert len(said) == (noise > 0.0)
    assert all("'level'" in text and "'y'" in text for text in said)


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", ["by a sensor", "by its order"])
def test_what_spoils_a_record_is_told_alone(spoilt):
    """Of all else that it makes, there were up to twenty warnings."""
    X, y = spring_tables(noise=0.01, n_samples=400)
    if spoilt == "by a sensor":
        y = y.mask(np.random.default_rng(0).random(y.shape) < 0.005, -9999.0)
        cause = "is -9999 in"
    else:
        X = X.drop(columns="time").sample(frac=1, random_state=0)
        y, cause = y.loc[X.index], "not in the order of its index"
    roles = {k: v for k, v in ROLES.items() if v in X.columns}
    chain = LocalLPVPipeline(sampling_time=0.02, **roles)
    chain.set_params(restructurer=GrayBoxRestructurer(spring_structure()))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        chain.fit(X, y)
    first, *others = (str(w.message) for w in told)
    assert cause in first
    known = "`lpv_` is unstable", "If a sensor got them wrong"
    assert [other for other in others if not any(k in other for k in known)] == []


def test_points_longer_than_the_buffer_become_one_model(monkeypatch):
    """Sums of their samples stand for all experiments but the first of each."""
    monkeypatch.setattr(stream, "BUFFER", 700)
    X, y = spring_tables(noise=0.01, n_samples=300, n_repeats=4)
    pipeline = spring_pipeline(local=SubspaceLTI(2, horizon=8)).fit(X, y)
    np.testing.assert_allclose(pipeline.parameters_, spring_truth(KAPPA), rtol=0.02)
