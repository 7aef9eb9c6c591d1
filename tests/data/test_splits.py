"""Cross-validation with scikit-learn's tools, and the splitters of this library."""

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.compose import ColumnTransformer, TransformedTargetRegressor
from sklearn.inspection import permutation_importance
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    KFold,
    LeaveOneGroupOut,
    TimeSeriesSplit,
    cross_val_predict,
    cross_val_score,
    cross_validate,
    learning_curve,
)
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import (
    BlockedTimeSeriesSplit,
    ExperimentSplit,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
    bft_scorer,
    from_trajectories,
    make_bft_scorer,
    vaf_scorer,
)
from lpvlearn.datasets import make_flexible_arm

from ..conftest import (
    ROLES,
    spring_pipeline,
    spring_structure,
    spring_sweep,
    spring_tables,
)

EXTRAPOLATES = pytest.mark.filterwarnings(
    "ignore::lpvlearn.exceptions.ExtrapolationWarning"
)
ESTIMATE = make_bft_scorer(initial_state="estimate")
EVEN = make_bft_scorer(average="experiment")


class CountingSubspace(SubspaceLTI):
    """Counts its fits, in private: a public value would tell results apart."""

    _fits = 0

    def fit(self, X, y):
        type(self)._fits += 1
        return super().fit(X, y)


class CountingRestructurer(GrayBoxRestructurer):
    """Counts how often it is fitted to a model."""

    _fits = 0

    def fit_model(self, *args, **options):
        type(self)._fits += 1
        return super().fit_model(*args, **options)


@pytest.fixture(scope="module")
def data():
    """Two realisations at each of four operating points, with a little noise."""
    return spring_tables(noise=0.02, n_samples=300, n_repeats=2)


@pytest.fixture(scope="module")
def few(data):
    """The first three of them."""
    X, y = data
    some = X["kappa"] <= 1.0
    return X[some], y[some]


@pytest.fixture
def counted():
    CountingSubspace._fits = CountingRestructurer._fits = 0
    return {
        "local": CountingSubspace(order=2, horizon=10),
        "restructurer": CountingRestructurer(spring_structure(), norm="similarity"),
    }


def quick_pipeline(**options):
    """A pipeline without the search for a horizon and for the H-infinity optimum."""
    return spring_pipeline(
        local=SubspaceLTI(order=2, horizon=10, feedthrough=False),
        restructurer=GrayBoxRestructurer(spring_structure(), norm="similarity"),
        **options,
    )


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    """Such a pipeline that remembers, over all tests, the points it has fitted."""
    return quick_pipeline(memory=tmp_path_factory.mktemp("memory"))


def black_box():
    """Local models interpolated as they are."""
    return LocalLPVPipeline(
        SubspaceLTI(order=2, horizon=10), restructurer="passthrough", **ROLES
    )


def points_held_out(**options):
    return ExperimentSplit(
        "all",
        experiment="run",
        scheduling="kappa",
        hold_out="operating_point",
        **options,
    )


def repeat_of(X):
    return X["run"].str[-1]


# ----------------------------------------------------------------- scikit-learn's tools


@pytest.mark.slow
def test_cross_validation_by_experiment_with_several_scorers(few, pipeline):
    X, y = few
    results = cross_validate(
        pipeline,
        X,
        y,
        groups=repeat_of(X),
        cv=GroupKFold(2),
        scoring={"bft": bft_scorer, "vaf": vaf_scorer, "r2": "r2"},
        error_score="raise",
    )
    assert (results["test_bft"] > 96).all()
    assert (results["test_vaf"] > 99.8).all()
    assert (results["test_r2"] > 0.998).all()


@pytest.mark.slow
@EXTRAPOLATES
@pytest.mark.filterwarnings("ignore:any 3 points lie on a form")  # three are left
def test_every_operating_point_is_predicted_by_the_others(data, pipeline):
    X, y = data
    scores = cross_val_score(
        pipeline,
        X,
        y,
        groups=X["kappa"],
        cv=LeaveOneGroupOut(),
        scoring=bft_scorer,
        error_score="raise",
    )
    assert scores.shape == (4,)
    assert (scores > 95).all()  # the true parameters are a parabola


@pytest.mark.slow
def test_every_experiment_is_predicted_by_the_others(few, pipeline):
    X, y = few
    scores = cross_val_score(pipeline, X, y, groups=X["run"], cv=LeaveOneGroupOut())
    assert scores.shape == (6,)
    assert (scores > 0.998).all()


def test_out_of_fold_predictions_are_those_of_the_folds(few, pipeline):
    X, y = few
    folds = {"groups": repeat_of(X), "cv": LeaveOneGroupOut()}
    predicted = cross_val_predict(pipeline, X, y, **folds)
    held_out = (repeat_of(X) == "1").to_numpy()
    model = clone(pipeline).fit(X[~held_out], y[~held_out])
    np.testing.assert_array_equal(predicted[held_out], model.predict(X[held_out]))
    assert bft_score(y, predicted) > 96


@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_interior_points_of_a_grid_are_those_that_others_surround(jitter):
    rng = np.random.default_rng(0)
    corners = [(a, b) for a in (65, 95) for b in (0, 30)]
    grid = [(a, b) for a in (65, 75, 85, 95) for b in (0, 15, 30)]
    a, b = np.repeat(np.array(grid, float), 50, axis=0).T
    a, b = (x + jitter * rng.standard_normal(len(x)) for x in (a, b))
    table = pd.DataFrame({"run": np.repeat(range(12), 50), "a": a, "b": b})
    cv = ExperimentSplit(
        "all",
        hold_out="operating_point",
        interior=True,
        experiment="run",
        scheduling=["a", "b"],
    )
    held_out = [grid[table["run"].iloc[test[0]]] for _, test in cv.split(table)]
    assert sorted(held_out) == sorted(set(grid) - set(corners))


@pytest.mark.slow
def test_grid_search_over_all_three_steps_refits_the_best(data, pipeline):
    X, y = data
    grid = [
        {"local__horizon": [6], "restructurer__norm": ["h2"]},
        {"interpolator__degree": [1, 2]},
    ]
    pipeline = clone(pipeline).set_params(interpolator=PolynomialLPV())
    cv = points_held_out(interior=True)
    search = GridSearchCV(pipeline, grid, scoring=bft_scorer, cv=cv).fit(X, y)
    assert search.best_params_["interpolator__degree"] == 2
    assert search.best_score_ > 95
    fitted = search.best_estimator_
    assert fitted.interpolator_.degree == 2
    assert len(fitted.operating_points_) == 4
    np.testing.assert_array_equal(search.predict(X), fitted.predict(X))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_learning_curve_over_experiments_rises_with_their_number():
    kappas = (0.0, 0.75, 1.5)
    X, y = spring_tables(noise=0.3, n_samples=100, n_repeats=8, kappas=kappas)
    sizes, _, scores = learning_curve(
        quick_pipeline(),
        X,
        y,
        train_sizes=[3 * 100, 12 * 100],
        cv=ExperimentSplit(2, experiment="run", scheduling="kappa"),
        scoring=bft_scorer,
        error_score="raise",
    )
    assert list(sizes) == [300, 1200]  # one, and four experiments at every point
    mean = scores.mean(axis=1)
    assert mean[1] > mean[0]


def test_importance_of_inputs_by_permutation(few):
    """Roles kept in the index are not permuted: only inputs are columns."""
    X, y = few
    rng = np.random.default_rng(0)
    X = X.assign(idle=rng.choice([-1.0, 1.0], len(X)))
    X = X.set_index(["run", "time", "kappa"])
    model = black_box().fit(X, y)
    assert list(model.feature_names_in_) == ["force", "idle"]
    importance = permutation_importance(
        model, X, y, scoring=bft_scorer, n_repeats=2, random_state=0
    )
    force, idle = importance["importances_mean"]
    assert force > 90
    assert abs(idle) < 1


def test_a_transformed_target_is_transformed_back(few):
    X, y = few
    scaled = TransformedTargetRegressor(
        black_box(), transformer=StandardScaler(with_mean=False)
    ).fit(X, y)
    plain = black_box().fit(X, y)
    np.testing.assert_allclose(scaled.predict(X), plain.predict(X), atol=1e-3)
    assert make_bft_scorer(burn_in=20)(scaled, X, y) > 96


@pytest.mark.slow
@pytest.mark.parametrize("output", ["pandas", "default"])
def test_a_column_transformer_stands_in_front(few, pipeline, output):
    X, y = few
    front = ColumnTransformer(
        [("scale", StandardScaler(with_mean=False), ["force"])],
        remainder="passthrough",
        verbose_feature_names_out=False,
    ).set_output(transform=output)
    roles = (
        ROLES if output == "pandas" else {"scheduling": 1, "experiment": 2, "time": 3}
    )
    model = Pipeline(
        [("columns", front), ("lpv", clone(pipeline).set_params(**roles))]
    ).fit(X, y)
    direct = clone(pipeline).fit(X, y)
    np.testing.assert_allclose(model.predict(X), direct.predict(X), atol=1e-5)
    assert ESTIMATE(model, X, y) > 97


@pytest.mark.slow  # starts processes that import everything
def test_two_processes_score_the_same(data, pipeline):
    X, y = data
    options = {"groups": repeat_of(X), "cv": GroupKFold(2), "scoring": bft_scorer}
    one = cross_val_score(pipeline, X, y, **options)
    two = cross_val_score(pipeline, X, y, n_jobs=2, **options)
    np.testing.assert_array_equal(two, one)


@pytest.mark.parametrize("cv", [KFold(3, shuffle=True, random_state=0), KFold(3)])
def test_splits_that_tear_experiments_raise_and_teach(data, pipeline, cv):
    X, y = data
    if not cv.shuffle:  # contiguous blocks of a table in the order of time
        X = X.sort_values("run", kind="stable").sort_values("time", kind="stable")
    with pytest.raises(ValueError, match="split by experiment with ExperimentSplit"):
        cross_val_score(pipeline, X, y.loc[X.index], cv=cv, error_score="raise")


# ---------------------------------------------------------------------------- memory


@pytest.mark.slow
def test_a_search_over_the_degree_identifies_nothing_twice(few, counted, tmp_path):
    X, y = few
    pipeline = LocalLPVPipeline(
        **counted, interpolator=PolynomialLPV(), memory=tmp_path, **ROLES
    )
    grid = {"interpolator__degree": [0, 1]}
    cv = ExperimentSplit(2, experiment="run", scheduling="kappa")
    search = GridSearchCV(pipeline, grid, cv=cv).fit(X, y)
    # Two folds and the refit, three operating points each.
    assert CountingSubspace._fits == 3 * 3
    assert CountingRestructurer._fits == 3 * 3
    again = LocalLPVPipeline(**counted, memory=str(tmp_path), **ROLES).fit(X, y)
    assert CountingSubspace._fits == CountingRestructurer._fits == 3 * 3
    pd.testing.assert_frame_equal(again.parameters_, search.best_estimator_.parameters_)
    plain = LocalLPVPipeline(**counted, **ROLES).fit(X, y)
    pd.testing.assert_frame_equal(again.parameters_, plain.parameters_)


@pytest.mark.slow
@EXTRAPOLATES
def test_folds_share_the_operating_points_they_have_in_common(data, counted, tmp_path):
    X, y = data
    pipeline = LocalLPVPipeline(
        **counted, interpolator=PolynomialLPV(), memory=tmp_path, **ROLES
    )
    cross_val_score(pipeline, X, y, cv=points_held_out(), error_score="raise")
    assert CountingSubspace._fits == CountingRestructurer._fits == 4


@pytest.mark.slow
def test_another_solver_restructures_anew_but_does_not_identify(few, counted, tmp_path):
    X, y = few
    pipeline = LocalLPVPipeline(**counted, memory=tmp_path, **ROLES).fit(X, y)
    pipeline.set_params(restructurer__tol=1e-9).fit(X, y)
    assert CountingSubspace._fits == 3
    assert CountingRestructurer._fits == 6
    pipeline.set_params(local__horizon=12).fit(X, y)
    assert CountingSubspace._fits == 6
    pipeline.fit(X, y + 1e-3)
    assert CountingSubspace._fits == 9


# -------------------------------------------------------------------------- splitters


@pytest.fixture
def table():
    """Three operating points with 2, 3 and 1 experiments of 4 samples."""
    runs = ["a", "b", "c", "d", "e", "f"]
    kappa = [0.0, 1.0, 0.0, 2.0, 1.0, 1.0]
    return pd.DataFrame(
        {
            "u": np.arange(24.0),
            "run": np.repeat(runs, 4),
            "kappa": np.repeat(kappa, 4),
        }
    )


def runs_of(X, rows):
    return list(X["run"].iloc[rows].unique())


def test_experiments_are_held_out_whole_and_each_once(table):
    for shuffle in (False, True):
        cv = ExperimentSplit(3, experiment="run", shuffle=shuffle, random_state=0)
        tested = []
        for train, test in cv.split(table):
            assert set(runs_of(table, train)).isdisjoint(runs_of(table, test))
            assert sorted([*train, *test]) == list(range(24))
            tested += runs_of(table, test)
        assert sorted(tested) == list("abcdef")
        assert cv.get_n_splits() == 3


def test_experiments_of_a_point_are_dealt_evenly(table):
    cv = ExperimentSplit(2, experiment="run", scheduling="kappa")
    for cv.shuffle in (False, True):
        for train, _ in cv.split(table):
            seen = table["kappa"].iloc[train]
            assert {0.0, 1.0} <= set(seen)


def test_operating_points_are_held_out_whole(table):
    cv = points_held_out()
    held_out = [sorted(runs_of(table, test)) for _, test in cv.split(table)]
    assert held_out == [["a", "c"], ["b", "e", "f"], ["d"]]
    assert cv.get_n_splits(table) == 3
    ((train, test),) = points_held_out(interior=True).split(table)
    assert runs_of(table, test) == ["b", "e", "f"]
    assert len(train) == 12


def test_points_are_as_near_as_the_pipeline_takes_them(table):
    X = table.assign(kappa=table["kappa"] + 0.1 * (table["run"] == "c"))
    for tol, n_points in ((0.05, 4), (0.2, 3)):
        assert points_held_out(scheduling_tol=tol).get_n_splits(X) == n_points


def test_a_prefix_of_the_training_rows_covers_the_points(table):
    cv = ExperimentSplit("all", experiment="run", scheduling="kappa")
    for train, _ in cv.split(table):
        points = set(table["kappa"].iloc[train])
        first = train[: 4 * len(points)]
        assert set(table["kappa"].iloc[first]) == points


def test_labels_of_experiments_may_come_as_groups(table):
    named = ExperimentSplit(3, experiment="run").split(table)
    given = ExperimentSplit(3).split(table[["u"]], groups=table["run"])
    for (train, test), (train2, test2) in zip(named, given, strict=True):
        np.testing.assert_array_equal(train, train2)
        np.testing.assert_array_equal(test, test2)


def test_blocks_test_what_comes_after_the_training_in_every_experiment(table):
    X = pd.concat([table, table]).sort_values("run", kind="stable")  # 8 samples each
    cv = BlockedTimeSeriesSplit(3, gap=1, experiment="run")
    for fold, (train, test) in enumerate(cv.split(X), start=1):
        for run in "abcdef":
            own = np.flatnonzero(X["run"] == run)
            assert [r for r in train if r in own] == list(own[: 2 * fold])
            assert [r for r in test if r in own] == list(
                own[2 * fold + 1 : 2 * fold + 2]
            )
    rolling = BlockedTimeSeriesSplit(3, max_train_size=3, experiment="run")
    train, _ = list(rolling.split(X))[-1]
    assert len(train) == 6 * 3


def test_blocks_without_experiments_are_one_record():
    cv = BlockedTimeSeriesSplit(4)
    X = np.zeros((50, 1))
    for (train, test), (ours, own) in zip(
        TimeSeriesSplit(4).split(X), cv.split(X), strict=True
    ):
        np.testing.assert_array_equal(train, ours)
        np.testing.assert_array_equal(test, own)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The scored table starts in mid-motion")
def test_later_parts_of_experiments_are_predicted_from_estimated_states(few, pipeline):
    X, y = few
    cv = BlockedTimeSeriesSplit(2, gap=10, experiment="run")
    scores = {
        "rest": bft_scorer,
        "estimate": ESTIMATE,
        "burnt": make_bft_scorer(burn_in=40),
    }
    results = cross_validate(pipeline, X, y, cv=cv, scoring=scores, error_score="raise")
    assert (results["test_estimate"] > 95).all()
    assert (results["test_rest"] < results["test_estimate"] - 5).all()
    assert (results["test_burnt"] > results["test_rest"]).all()


# -------------------------------------------------------------------- choosing a degree


@pytest.mark.slow
def test_points_left_out_choose_the_degree_that_the_sweep_confirms(tmp_path):
    """The arm at full size: tests/benchmarks/choose_degree.py."""
    kappas = np.linspace(0, 1.5, 5)
    X, y = spring_tables(noise=0.05, n_samples=200, n_repeats=2, kappas=kappas)
    X_sweep, y_sweep = spring_sweep(600)
    pipeline = quick_pipeline(interpolator=PolynomialLPV(), memory=tmp_path)
    degrees = [1, 2, 3]
    search = GridSearchCV(
        pipeline,
        {"interpolator__degree": degrees},
        scoring=bft_scorer,
        cv=points_held_out(interior=True),
        refit=False,
    ).fit(X, y)
    sweep = [
        bft_scorer(
            pipeline.set_params(interpolator__degree=d).fit(X, y), X_sweep, y_sweep
        )
        for d in degrees
    ]
    assert search.best_params_["interpolator__degree"] == degrees[np.argmax(sweep)] == 2


@pytest.mark.slow
@EXTRAPOLATES
def test_on_the_arm_models_that_lack_a_point_choose_what_the_sweep_confirms(tmp_path):
    """Shorter and fewer experiments than in tests/benchmarks/choose_degree.py."""
    arm = make_flexible_arm(5, duration=1.0, sweep_duration=1.5, random_state=0)
    columns = {"scheduling": "kappa", "experiment": "experiment"}
    pipeline = LocalLPVPipeline(
        SubspaceLTI(6, horizon=40, feedthrough=False),
        GrayBoxRestructurer(arm.structure, norm="h2"),
        PolynomialLPV(),
        time="time",
        memory=tmp_path,
        **columns,
    )
    cv = ExperimentSplit(
        "all", hold_out="operating_point", interior=True, test_on="all", **columns
    )
    degrees = [1, 2, 3]
    search = GridSearchCV(
        pipeline, {"interpolator__degree": degrees}, scoring=EVEN, cv=cv
    ).fit(arm.X, arm.y)
    sweep = [
        bft_scorer(
            pipeline.set_params(interpolator__degree=d).fit(arm.X, arm.y),
            arm.X_sweep,
            arm.y_sweep,
        )
        for d in degrees
    ]
    assert search.best_params_["interpolator__degree"] == degrees[np.argmax(sweep)]
    assert min(sweep) < max(sweep) - 5  # there is something to choose


def test_models_that_lack_a_point_are_scored_on_all_experiments(table):
    on_all, held_out = points_held_out(test_on="all"), points_held_out()
    for (train, test), (same, _) in zip(
        on_all.split(table), held_out.split(table), strict=True
    ):
        np.testing.assert_array_equal(train, same)
        assert sorted(test) == list(range(24))
    assert on_all.get_n_splits(table) == 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`lpv_` is unstable")
def test_a_gap_of_few_points_misjudges_the_degree(tmp_path):
    """A resonance between the points: only the whole range tells what it costs."""
    kappas = np.linspace(0, 1.5, 7)
    stiffness = 40 + 60 / (1 + (4 * (kappas - 0.75)) ** 2)
    rng = np.random.default_rng(0)
    runs = []
    for kappa, k in zip(kappas, stiffness, strict=True):
        u = rng.choice([-1.0, 1.0], (60, 1)).repeat(5, axis=0)
        model = spring_structure().model({"b": 30, "c": 1.2, "k": k})
        runs.append((u, kappa, model.simulate(u, sampling_time=0.02)))
    X, y = from_trajectories(runs, sampling_time=0.02)
    columns = {"scheduling": "kappa", "experiment": "experiment"}
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, horizon=10, feedthrough=False),
        GrayBoxRestructurer(spring_structure(), norm="h2"),
        PolynomialLPV(),
        time="time",
        memory=tmp_path,
        **columns,
    )

    def chosen(test_on):
        cv = ExperimentSplit(
            "all", hold_out="operating_point", interior=True, test_on=test_on, **columns
        )
        grid = {"interpolator__degree": [2, 4, 5]}
        search = GridSearchCV(pipeline, grid, scoring=EVEN, cv=cv).fit(X, y)
        return search.best_params_["interpolator__degree"]

    def worst(degree):
        """Error of the stiffness between the points."""
        fine = np.linspace(0, 1.5, 200)[:, None]
        found = PolynomialLPV(degree).fit(kappas[:, None], stiffness).predict(fine)
        truth = 40 + 60 / (1 + (4 * (fine[:, 0] - 0.75)) ** 2)
        return np.sqrt(np.mean((found - truth) ** 2))

    assert worst(chosen("all")) < 0.7 * worst(chosen("held_out"))
