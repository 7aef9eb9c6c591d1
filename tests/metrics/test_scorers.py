"""Scorers against the measures, and within scikit-learn's model selection."""

import pickle

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter
from sklearn.base import clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    cross_validate,
    learning_curve,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from lpvlearn import (
    SubspaceLTI,
    bft_score,
    bft_scorer,
    fit_report,
    make_bft_scorer,
    make_vaf_scorer,
    vaf_score,
    vaf_scorer,
)
from lpvlearn.metrics import TrajectoryScorer

from .conftest import IN_MOTION, RNG

# The table `data` does: warnings of it have a test of their own.
pytestmark = IN_MOTION


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


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: make_bft_scorer(initial_state="zero"), ["`initial_state`", "'zero'"]),
        (lambda: make_bft_scorer(burn_in=-1), ["`burn_in`", "-1"]),
        (lambda: make_vaf_scorer(burn_in=0.5), ["`burn_in`", "0.5"]),
        (lambda: make_bft_scorer(multioutput="mean"), ["`multioutput`", "'mean'"]),
        (lambda: make_bft_scorer(average="mean"), ["`average`", "'mean'"]),
        (lambda: TrajectoryScorer("R2"), ["`metric`", "'R2'"]),
        (lambda: TrajectoryScorer("VAF", burn_in=-3), ["`burn_in`", "-3"]),
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


@pytest.mark.parametrize("average", ["pool", "experiment"])
@pytest.mark.parametrize("initial_state", ["rest", "estimate"])
def test_missing_samples_are_left_out(data, average, initial_state):
    model, X, y = data
    lost = np.random.default_rng(5).random(len(y)) < 0.2
    both = lost[:, None].repeat(2, axis=1)
    scorer = make_bft_scorer(average=average, initial_state=initial_state, burn_in=3)
    wrong = y.mask(both, 1e3)  # what is missing may have been anything
    with pytest.warns(UserWarning, match=f"^{both.sum()} of 240 values .* missing"):
        found = scorer(model, X, y.mask(both))
    assert found != scorer(model, X, wrong)
    known = ~lost & (np.arange(120) % 40 >= 3)
    simulated = (
        model.predict(X)
        if initial_state == "rest"
        else model.predict_with_initial_state(X, y)
    )
    groups = [known] if average == "pool" else [known & (X["run"] == r) for r in "abc"]
    expected = np.mean([bft_score(y[rows], simulated[rows]) for rows in groups])
    assert found == pytest.approx(expected)


@pytest.mark.parametrize("initial_state", ["rest", "estimate"])
def test_outputs_in_another_order_are_those_of_the_fit(initial_state):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.8], u, axis=0) * [1.0, -3.0]
    y = pd.DataFrame(y + 0.1 * rng.standard_normal(y.shape), columns=["a", "b"])
    model, other = SubspaceLTI(1, horizon=5).fit(u, y), y[["b", "a"]]
    scorer = make_bft_scorer(initial_state=initial_state, multioutput="raw_values")
    assert scorer(model, u, other) == scorer(model, u, y)
    reports = [fit_report(model, u, y, initial_state=initial_state) for y in (other, y)]
    pd.testing.assert_frame_equal(*reports)
    pd.testing.assert_frame_equal(*(model.residual_tests(u, y) for y in (other, y)))
    np.testing.assert_array_equal(*(model.predict_ahead(u, y) for y in (other, y)))
    assert model.score(u, other) == model.score(u, y)
    assert scorer(model, u, y.set_axis(["c", "d"], axis=1))["BFT_c"] > 90.0
    with pytest.raises(ValueError, match="must have the outputs .*'c' is none of them"):
        scorer(model, u, y.set_axis(["b", "c"], axis=1))


@pytest.mark.parametrize("scorer", [bft_scorer, vaf_scorer])
def test_a_prefix_of_the_outputs_is_refused(data, scorer):
    model, X, y = data
    with pytest.raises(ValueError, match=r"inconsistent .* samples: \[120, 119\]"):
        scorer(model, X, y[:-1])
    with pytest.raises(ValueError, match="inconsistent"):
        scorer(model, X[:-1], y.to_numpy())
