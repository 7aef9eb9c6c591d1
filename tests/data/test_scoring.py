"""Scores of simulations from rest, and tables that do not start there."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter
from sklearn.metrics import r2_score
from sklearn.model_selection import cross_val_score

from lpvlearn import SubspaceLTI, bft_scorer, fit_report, make_bft_scorer

from ..conftest import spring_tables, stable_model

MOTION = "starts in mid-motion"


@pytest.fixture(scope="module")
def spring():
    X, y = spring_tables(noise=0.02, n_samples=500, kappas=(0.0,))
    return SubspaceLTI(2, horizon=10, sampling_time=0.02), X[["force"]], y


def test_missing_outputs_are_left_out(spring):
    model, X, y = spring
    model.fit(X, y)
    assert model.score(X, y) == r2_score(y, model.predict(X))
    lost = np.random.default_rng(0).random(len(y)) < 0.2
    weight = np.random.default_rng(1).random(len(y))
    with pytest.warns(UserWarning, match=f"^{lost.sum()} of {len(y)} values"):
        found = model.score(X, y.mask(lost[:, None]), sample_weight=weight)
    known = y[~lost], model.predict(X)[~lost]
    assert found == r2_score(*known, sample_weight=weight[~lost])


def told_of_motion(model, X, y, scoring):
    """Scores of five blocks of one experiment, and what the library says of starts."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter(
            "always"
        )  # the models are poor, too: their training is torn
        scores = cross_val_score(model, X, y, scoring=scoring)
    return scores, [str(w.message) for w in caught if MOTION in str(w.message)]


@pytest.mark.slow
@pytest.mark.parametrize("scoring", [None, bft_scorer])
def test_folds_that_start_in_mid_motion_are_warned_of(spring, scoring):
    """Four of the five blocks start in the middle."""
    scores, told = told_of_motion(*spring, scoring)
    assert (scores[1:] < scores[0]).all()
    # As the text is the same, Python's own filter shows it once.
    assert len(told) >= 3 and len(set(told)) == 1
    assert not told_of_motion(*spring, make_bft_scorer(initial_state="estimate"))[1]


def test_reports_warn_too(spring):
    model, X, y = spring
    model.fit(X, y)
    with pytest.warns(UserWarning, match=MOTION):
        fit_report(model, X[200:], y[200:])
    fit_report(model, X[200:], y[200:], initial_state="estimate")
    fit_report(model, X[200:], y[200:], burn_in=250)


@pytest.mark.parametrize("time_constant", [5.0, 30.0, 150.0])
def test_a_level_is_not_taken_for_motion(time_constant):
    """Of records of a system at rest, whose sensor stands elsewhere than in the fit."""
    pole = np.exp(-1.0 / time_constant)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((40, 1)).repeat(15, axis=0)
        y = lfilter([0.0, 0.1], [1.0, -pole], u, axis=0)
        size = y.std()
        model = SubspaceLTI(sampling_time=1.0, order=1)
        model.fit(u, y + 0.05 * size * rng.standard_normal(y.shape))
        assert model.offset_ is None
        y += 0.05 * size * rng.standard_normal(y.shape)
        model.score(u, y + 0.7 * size)  # no warning
        with pytest.warns(UserWarning, match=MOTION):
            model.score(u, y + 1.5 * size * pole ** np.arange(len(y))[:, None])


@pytest.mark.broad
@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("pole", [0.0, 0.9])
@pytest.mark.filterwarnings("ignore:The simulation error depends on past inputs")
@pytest.mark.filterwarnings("ignore:The model explains next to nothing")
def test_rest_is_not_taken_for_motion(order, pole):
    """Models of too low an order and the right one, at 10 dB; warnings are errors."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        system = stable_model(rng, 3, 1, 1, sampling_time=1.0)
        u = rng.standard_normal((300, 1))
        y = system.simulate(u)
        v = lfilter([1.0], [1.0, -pole], rng.standard_normal((400, 1)), axis=0)[100:]
        y = y + 0.3 * y.std() * v / v.std()
        SubspaceLTI(order, horizon=8).fit(u, y).score(u, y)


def test_inputs_in_transit_at_rest_are_not_taken_for_motion():
    """Estimated, the twenty of them meet the noise of twenty samples."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        system = stable_model(rng, 2, 1, 1, sampling_time=1.0).with_input_delay(20)
        u = rng.standard_normal((400, 1))
        y = system.simulate(u)
        y = y + y.std() * rng.standard_normal(y.shape)
        SubspaceLTI(2, horizon=8, input_delay=20).fit(u, y).score(u, y)


def test_an_experiment_without_a_measurement_tells_nothing(spring):
    model, X, y = spring
    lost = y.copy()
    lost[:] = np.nan
    with pytest.raises(ValueError, match="at least 1 measured sample"):
        model.fit(X, y).score(X, lost)
