"""Warnings point to the user's line; pickles keep the tables of an estimator."""

import pickle

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import LocalLPVPipeline, PolynomialLPV, SubspaceLTI
from lpvlearn.exceptions import (
    ExtrapolationWarning,
    RankWarning,
    collected,
    take_back,
    warn,
)


def collinear():
    u = np.random.default_rng(0).standard_normal((200, 1))
    return np.hstack([u, 2 * u]), lfilter([0.0, 1.0], [1.0, -0.8], u[:, 0])


def test_a_direct_call_is_named():
    with pytest.warns(RankWarning) as caught:
        SubspaceLTI(1, horizon=5).fit(*collinear())
    assert [w.filename for w in caught] == [__file__] * len(caught)


def test_what_lies_between_is_passed_over():
    X, y = collinear()
    table = pd.DataFrame(X, columns=["a", "b"]).assign(kappa=np.repeat([0.0, 1.0], 100))
    with pytest.warns(RankWarning) as caught:
        LocalLPVPipeline(
            SubspaceLTI(1, horizon=5),
            "passthrough",
            PolynomialLPV(1),
            scheduling="kappa",
            experiment="kappa",
            sampling_time=0.1,
        ).fit(table, y)
    assert {w.filename for w in caught} == {__file__}


def test_called_by_another_library_its_call_is_named():
    X, y = collinear()
    with pytest.warns(RankWarning) as caught:
        make_pipeline(StandardScaler(), SubspaceLTI(1, horizon=5)).fit(X, y)
    assert all("sklearn" in w.filename for w in caught)


def test_predictions_outside_of_the_range_name_the_caller():
    model = PolynomialLPV(1, extrapolation="warn").fit(
        [[0.0], [1.0], [2.0]], [0.0, 1.0, 2.0]
    )
    with pytest.warns(ExtrapolationWarning) as caught:
        model.predict([[3.0]])
    assert [w.filename for w in caught] == [__file__]


@pytest.mark.parametrize(
    "table",
    [
        pd.DataFrame({"a": [1.5, np.nan], "b": [1, 2], "c": ["x", "y"]}),
        pd.DataFrame({"a": [None, 1.0], "b": [True, False]}, index=["r", "s"]),
        pd.DataFrame([[1.0, 2.0]], columns=["a", "a"]),
        pd.DataFrame(np.eye(2), pd.MultiIndex.from_product([[0.5], ["u", "v"]])),
        pd.DataFrame(
            [[1]], columns=pd.MultiIndex.from_tuples([("a", 1)], names=["p", "q"])
        ),
        pd.DataFrame({"a": pd.to_datetime(["2026-01-01"]), "b": [1.0]}),
        pd.DataFrame({"a": [1.0, 2.0]}, index=pd.Index([3, 4], name="point")),
        pd.DataFrame(  # as operating points of two scheduling variables are labelled
            {"a": [1.0]}, pd.Index([(0.0, 2.0)], name="p", tupleize_cols=False)
        ),
        pd.DataFrame({"a": pd.Categorical(["x"], ["x", "y"], ordered=True)}),
        pd.DataFrame({"a": np.float32([0.1])}),
        pd.DataFrame(index=["r"]),
        pd.DataFrame(columns=["a", "b"]),
        pd.DataFrame(),
    ],
    ids=str,
)
def test_tables_of_a_pickled_estimator_stay_what_they_are(table):
    fitted = PolynomialLPV(1)
    fitted.table_ = table
    back = pickle.loads(pickle.dumps(fitted))
    pd.testing.assert_frame_equal(back.table_, table)


def test_what_is_known_better_later_is_taken_back():
    take_back("never told")
    with collected() as told:
        warn("one thing may be another one", kind="interchange")
        warn("the sky falls")
        take_back("interchange")
    assert [one.message for one in told] == ["the sky falls"]
