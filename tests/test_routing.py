"""Metadata routing of scikit-learn: weights and groups reach whom they are for."""

import numpy as np
import pytest
from sklearn import config_context
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, cross_validate
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import (
    BlockedTimeSeriesSplit,
    ExperimentSplit,
    GrayBoxRestructurer,
    PolynomialLPV,
)

from .conftest import spring_tables

KAPPA = np.linspace(0.0, 1.0, 9)[:, None]
Y = KAPPA[:, 0] ** 2
WEIGHT = np.r_[np.ones(5), np.zeros(4)]


@pytest.fixture(autouse=True)
def routing():
    with config_context(enable_metadata_routing=True):
        yield


def test_weights_reach_the_interpolator_of_a_chain():
    line = PolynomialLPV(1).set_fit_request(sample_weight=True)
    chain = make_pipeline(StandardScaler().set_fit_request(sample_weight=False), line)
    chain.fit(KAPPA, Y, sample_weight=WEIGHT)
    expected = PolynomialLPV(1).fit(KAPPA[:5], Y[:5]).predict(KAPPA)
    np.testing.assert_allclose(chain.predict(KAPPA), expected, atol=1e-12)


def test_weights_reach_the_fits_of_a_search():
    line = PolynomialLPV().set_fit_request(sample_weight=True)
    line = line.set_score_request(sample_weight=True)
    search = GridSearchCV(line, {"degree": [1]}, cv=3)
    search.fit(KAPPA, Y, sample_weight=WEIGHT + 1e-9)
    expected = PolynomialLPV(1).fit(KAPPA, Y, sample_weight=WEIGHT + 1e-9)
    found = search.best_estimator_.coefficients()
    np.testing.assert_array_equal(found, expected.coefficients())


def test_weights_that_nobody_asked_for_are_refused():
    with pytest.raises(ValueError, match="sample_weight.*not explicitly set"):
        cross_validate(PolynomialLPV(1), KAPPA, Y, params={"sample_weight": WEIGHT})


@pytest.mark.parametrize(
    "split", [ExperimentSplit(3), ExperimentSplit("all"), BlockedTimeSeriesSplit(2)]
)
def test_groups_reach_the_split(split):
    X, y = spring_tables(n_samples=60, kappas=(0.0, 0.0, 0.0))
    runs, U, Y = X["run"].to_numpy(), X[["force"]].to_numpy(), y.to_numpy()
    options = {"cv": split, "return_indices": True}
    found = cross_validate(LinearRegression(), U, Y, params={"groups": runs}, **options)
    for rows, expected in zip(
        found["indices"]["test"], split.split(U, Y, runs), strict=True
    ):
        np.testing.assert_array_equal(rows, expected[1])


def test_frequencies_and_responses_are_data_not_metadata():
    with pytest.raises(TypeError, match="Unexpected args: {'omega'}"):
        GrayBoxRestructurer().set_fit_request(omega=True)
    requested = GrayBoxRestructurer().set_fit_request(sample_weight=True)
    others = dict.fromkeys(("noise", "coherence", "n_averages"))
    found = requested.get_metadata_routing().fit.requests
    assert found == {"sample_weight": True, **others}
    assert GrayBoxRestructurer().get_metadata_routing().predict.requests == {}
