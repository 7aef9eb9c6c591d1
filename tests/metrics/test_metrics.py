"""Measures of fit, scorers and reports against independent formulas."""

import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin, clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.linear_model import LinearRegression
from sklearn.metrics import mean_squared_error, r2_score
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    cross_validate,
    learning_curve,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from lpvlearn import (
    bft_score,
    bft_scorer,
    fit_report,
    make_bft_scorer,
    make_vaf_scorer,
    parameter_fit,
    vaf_score,
    vaf_scorer,
)
from lpvlearn.data.experiments import read_experiments
from lpvlearn.metrics.scores import r2_ratio

RNG = np.random.default_rng(0)
Y_TRUE = RNG.normal(size=(50, 2))
Y_PRED = Y_TRUE + RNG.normal(scale=[0.1, 0.4], size=(50, 2)) + [0.2, 0.0]


class GainFromRest(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """y = gain u plus a state that the simulation from rest misses."""

    def __init__(self, gain=1.0, experiment=None, scheduling=None, time=None):
        self.gain = gain
        self.experiment = experiment
        self.scheduling = scheduling
        self.time = time

    def _read(self, X, y=None, reset=False):
        return read_experiments(
            self,
            X,
            y,
            inputs=["u"],
            experiment=self.experiment,
            scheduling=self.scheduling,
            time=self.time,
            reset=reset,
        )

    def fit(self, X, y):
        self._read(X, y, reset=True)
        return self

    def split_experiments(self, X):
        return [run.rows for run in self._read(X)]

    def predict(self, X):
        y = np.empty((len(X), 2))
        for run in self._read(X):
            y[run.rows] = self.gain * run.inputs * [1.0, 2.0]
        return y

    def predict_with_initial_state(self, X, y):
        simulated = self.predict(X)
        for rows in self.split_experiments(X):
            simulated[rows] += 0.9 ** np.arange(len(rows))[:, None]
        return simulated


@pytest.fixture
def data():
    rng = np.random.default_rng(1)
    X = pd.DataFrame({"u": rng.normal(size=120)})
    X["run"] = np.repeat(["a", "b", "c"], 40)
    X["kappa"] = np.repeat([0.25, 0.5, 0.75], 40)
    model = GainFromRest(experiment="run", scheduling="kappa").fit(X, X["u"])
    true = model.predict_with_initial_state(X, None)
    return model, X, pd.DataFrame(true, columns=["vx", "vy"])


# ---------------------------------------------------------------------------- measures


def test_bft_is_one_minus_the_root_of_one_minus_r2():
    r2 = r2_score(Y_TRUE, Y_PRED, multioutput="raw_values")
    np.testing.assert_allclose(
        bft_score(Y_TRUE, Y_PRED, multioutput="raw_values"),
        100 * (1 - np.sqrt(1 - r2)),
    )
    np.testing.assert_allclose(r2_ratio(Y_TRUE, Y_PRED), r2)


def test_vaf_is_the_r2_of_centred_signals():
    centred = Y_TRUE - Y_TRUE.mean(axis=0), Y_PRED - Y_PRED.mean(axis=0)
    r2 = r2_score(*centred, multioutput="raw_values")
    vaf = vaf_score(Y_TRUE, Y_PRED, multioutput="raw_values")
    np.testing.assert_allclose(vaf, 100 * r2)


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_scores_run_from_zero_to_hundred(score):
    assert score(Y_TRUE, Y_TRUE) == 100
    assert score(Y_TRUE, -Y_TRUE) == 0
    assert score(Y_TRUE, 1e200 * Y_TRUE) == 0
    np.testing.assert_allclose(
        score(Y_TRUE, 0.5 * (Y_TRUE - Y_TRUE.mean(axis=0)) + Y_TRUE.mean(axis=0)),
        50 if score is bft_score else 75,
    )


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_scores_do_not_depend_on_units(score):
    scale, offset = np.array([1e-6, 1e6]), np.array([0.1, 1e3])
    np.testing.assert_allclose(
        score(scale * Y_TRUE + offset, scale * Y_PRED + offset),
        score(Y_TRUE, Y_PRED),
        rtol=1e-9,
    )


def test_a_constant_offset_of_the_simulation_costs_bft_and_no_vaf():
    assert bft_score(Y_TRUE, Y_TRUE + 0.3) < 80
    np.testing.assert_allclose(vaf_score(Y_TRUE, Y_TRUE + 0.3), 100)


@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3])
def test_a_constant_output_scores_all_or_nothing(value):
    true = np.full((7, 1), value)
    assert bft_score(true, true) == vaf_score(true, true) == 100
    assert bft_score(true, true + 1) == 0
    assert vaf_score(true, true + 1) == 100
    assert vaf_score(true, true + np.arange(7)[:, None]) == 0
    assert parameter_fit(true, true) == 100
    assert parameter_fit(true, true + 1) == 0


@pytest.mark.parametrize("score", [bft_score, vaf_score])
def test_outputs_are_averaged_as_asked(score):
    raw = score(Y_TRUE, Y_PRED, multioutput="raw_values")
    assert raw.shape == (2,)
    np.testing.assert_allclose(score(Y_TRUE, Y_PRED), raw.mean())
    weighted = score(Y_TRUE, Y_PRED, multioutput=[3, 1])
    np.testing.assert_allclose(weighted, (3 * raw[0] + raw[1]) / 4)
    assert isinstance(weighted, float)
    np.testing.assert_allclose(score(Y_TRUE[:, 0], Y_PRED[:, :1]), raw[0])
    np.testing.assert_allclose(score(pd.DataFrame(Y_TRUE), Y_PRED.tolist()), raw.mean())


def test_parameter_fit_is_the_unclipped_ratio_of_all_parameters_together():
    eta = RNG.normal(size=(7, 16))
    eta_hat = eta + 0.1 * RNG.normal(size=eta.shape)
    expected = 100 * (1 - np.sqrt(1 - r2_score(eta.ravel(), eta_hat.ravel())))
    np.testing.assert_allclose(parameter_fit(eta, eta_hat), expected)
    np.testing.assert_allclose(parameter_fit(eta, 3 * eta - 2 * eta.mean()), -100)


# ----------------------------------------------------------------------------- scorers


def test_scorers_from_rest_score_predict():
    X, y = RNG.normal(size=(30, 2)), RNG.normal(size=(30, 2))
    model = LinearRegression().fit(X, y)
    assert bft_scorer(model, X, y) == bft_score(y, model.predict(X))
    assert vaf_scorer(model, X, y) == vaf_score(y, model.predict(X))


def test_an_estimated_initial_state_removes_the_transient(data):
    model, X, y = data
    assert make_bft_scorer(initial_state="estimate")(model, X, y) == 100
    assert bft_scorer(model, X, y) < 90


def test_burn_in_leaves_out_the_start_of_every_experiment(data):
    model, X, y = data
    kept = np.arange(120) % 40 >= 30
    assert make_vaf_scorer(burn_in=30)(model, X, y) == pytest.approx(
        vaf_score(y[kept], model.predict(X)[kept]), rel=1e-12
    )
    assert make_bft_scorer(burn_in=30)(model, X, y) > bft_scorer(model, X, y)


def test_scores_of_experiments_are_averaged_as_asked(data):
    model, X, y = data
    runs = [
        bft_score(y[X["run"] == run], model.predict(X[X["run"] == run]))
        for run in "abc"
    ]
    scorer = make_bft_scorer(average="experiment")
    assert scorer(model, X, y) == pytest.approx(np.mean(runs))


def test_weights_score_a_single_output(data):
    model, X, y = data
    raw = bft_score(y, model.predict(X), multioutput="raw_values")
    assert make_bft_scorer(multioutput=[0, 1])(model, X, y) == pytest.approx(raw[1])


@pytest.mark.parametrize("average", ["pool", "experiment"])
def test_raw_values_score_every_output_by_name(data, average):
    model, X, y = data
    raw = make_vaf_scorer(multioutput="raw_values", average=average)
    first, second = (
        make_vaf_scorer(multioutput=weights, average=average)(model, X, y)
        for weights in ([1, 0], [0, 1])
    )
    assert raw(model, X, y) == pytest.approx({"VAF_vx": first, "VAF_vy": second})
    folds = {"cv": GroupKFold(3), "groups": X["run"]}
    results = cross_validate(model, X, y, scoring=raw, **folds)
    assert results["test_VAF_vy"].shape == (3,)


def test_scorers_serve_scikit_learns_model_selection(data):
    model, X, y = data
    scoring = {
        "rest": bft_scorer,
        "estimate": make_vaf_scorer(initial_state="estimate", burn_in=2),
    }
    folds = {"cv": GroupKFold(3), "groups": X["run"]}
    results = cross_validate(model, X, y, scoring=scoring, **folds)
    np.testing.assert_allclose(results["test_estimate"], 100)
    assert (results["test_rest"] < 90).all()
    search = GridSearchCV(
        model,
        {"gain": [0.5, 1.0, 2.0]},
        scoring=make_bft_scorer(initial_state="estimate"),
        cv=GroupKFold(3),
    ).fit(X, y, groups=X["run"])
    assert search.best_params_ == {"gain": 1.0}
    # A search is itself an estimator to score.
    assert make_bft_scorer(burn_in=5, initial_state="estimate")(search, X, y) == 100
    _, _, scores = learning_curve(
        model, X, y, train_sizes=[40, 80], scoring=bft_scorer, **folds
    )
    assert np.isfinite(scores).all()


def test_scorers_reach_an_estimator_within_a_pipeline(data):
    model, X, y = data
    swapped = make_pipeline(
        FunctionTransformer(lambda T: T.assign(u=T["v"])), clone(model)
    )
    renamed = X.assign(v=X["u"], u=0.0)
    swapped.fit(renamed, y)
    for scorer in (bft_scorer, make_bft_scorer(burn_in=3, initial_state="estimate")):
        assert scorer(swapped, renamed, y) == scorer(model, X, y)


def test_burn_in_reaches_an_estimator_with_a_transformed_target(data):
    model, X, y = data
    wrapped = TransformedTargetRegressor(model, check_inverse=False).fit(X, y)
    scorer = make_bft_scorer(burn_in=3)
    assert scorer(wrapped, X, y) == pytest.approx(scorer(model, X, y))


@pytest.mark.parametrize("scorer", [bft_scorer, make_vaf_scorer(multioutput=[1, 2])])
def test_scorers_are_pickled(scorer):
    assert pickle.loads(pickle.dumps(scorer)) == scorer


# ------------------------------------------------------------------------------ report


def test_the_report_has_a_row_for_each_experiment_and_output(data):
    model, X, y = data
    report = fit_report(model, X, y)
    assert list(report) == [
        "experiment", "operating_point", "output", "BFT", "VAF", "RMSE", "R2",
    ]  # fmt: skip
    assert report["experiment"].tolist() == ["a", "a", "b", "b", "c", "c"]
    assert report["output"].tolist() == 3 * ["vx", "vy"]
    assert report["operating_point"].tolist() == [0.25, 0.25, 0.5, 0.5, 0.75, 0.75]
    prediction = model.predict(X)
    for _, row in report.iterrows():
        rows = (X["run"] == row["experiment"]).to_numpy()
        true = y.loc[rows, row["output"]]
        pred = prediction[rows, y.columns.get_loc(row["output"])]
        assert row["BFT"] == pytest.approx(bft_score(true, pred))
        assert row["VAF"] == pytest.approx(vaf_score(true, pred))
        assert row["RMSE"] == pytest.approx(np.sqrt(mean_squared_error(true, pred)))
        assert row["R2"] == pytest.approx(r2_score(true, pred))


def test_the_report_takes_the_scorers_options(data):
    model, X, y = data
    assert (fit_report(model, X, y, initial_state="estimate")["BFT"] == 100).all()
    full, cut = fit_report(model, X, y), fit_report(model, X, y, burn_in=30)
    assert (cut["RMSE"] < full["RMSE"]).all()


def test_the_report_of_any_regressor_is_one_experiment():
    X, y = RNG.normal(size=(30, 2)), RNG.normal(size=30)
    report = fit_report(LinearRegression().fit(X, y), X, y)
    assert report[["experiment", "output"]].to_numpy().tolist() == [[0, "y1"]]


# ------------------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: bft_score([1, 2], [1, 2, 3]), ["same shape", "(2, 1)", "(3, 1)"]),
        (lambda: vaf_score(Y_TRUE, Y_TRUE[:, :1]), ["same shape", "(50, 1)"]),
        (lambda: bft_score([1, 2], [1, np.inf]), ["`y_pred`", "row 1", "unstable"]),
        (lambda: bft_score([np.nan, 2], [1, 2]), ["`y_true`", "row 0"]),
        (lambda: bft_score([1, 2], [1, 2], multioutput="mean"), ["'mean'"]),
        (lambda: bft_score(Y_TRUE, Y_PRED, multioutput=[1]), ["2 output(s)", "[1]"]),
        (lambda: parameter_fit([1, 2], [[1, 2]]), ["`params_true`", "(1, 2)"]),
        (lambda: parameter_fit([1, np.nan], [1, 2]), ["`params_true`", "row 1"]),
        (lambda: make_bft_scorer(initial_state="zero"), ["`initial_state`", "'zero'"]),
        (lambda: make_bft_scorer(burn_in=-1), ["`burn_in`", "-1"]),
        (lambda: make_vaf_scorer(burn_in=0.5), ["`burn_in`", "0.5"]),
        (lambda: make_bft_scorer(multioutput="mean"), ["`multioutput`", "'mean'"]),
        (lambda: make_bft_scorer(average="mean"), ["`average`", "'mean'"]),
    ],
)
def test_bad_calls_raise_and_name_the_cause(call, words):
    with pytest.raises(ValueError) as raised:
        call()
    for word in words:
        assert word in str(raised.value)


def test_too_long_a_burn_in_raises(data):
    with pytest.raises(ValueError, match="40 in the shortest. Got 40"):
        make_bft_scorer(burn_in=40)(*data)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"initial_state": "estimate"}, "predict_with_initial_state.*LinearRegression"),
        ({"burn_in": 1}, "split_experiments.*LinearRegression"),
        ({"average": "experiment"}, "split_experiments.*LinearRegression"),
    ],
)
def test_an_estimator_without_the_method_for_an_option_raises(options, words):
    model = LinearRegression().fit([[0.0], [1.0]], [0, 1])
    with pytest.raises(TypeError, match=words):
        make_bft_scorer(**options)(model, [[0.0], [1.0]], [0, 1])
