"""The residual display: what is drawn is what the tests say; errors teach."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from lpvlearn import SubspaceLTI
from lpvlearn.inspection import ResidualDisplay
from lpvlearn.subspace.evidence.residuals import autocorrelations, cross_correlations
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes

ROLES = {"inputs": ["torque", "valve"], "experiment": "run", "time": "time"}


@pytest.fixture(scope="module")
def plant():
    """Two experiments on a plant of three states, 2 x 2, with white noise."""
    rng = np.random.default_rng(0)
    A = modes(0.9, 0.7 * np.exp(0.8j))
    B, C = rng.standard_normal((3, 2)), rng.standard_normal((2, 3))
    parts = []
    for label, n in (("a", 500), ("b", 300)):
        u = rng.standard_normal((n, 2))
        y = lti_response(A, B, C, np.zeros((2, 2)), u)
        y = y + 0.2 * rng.standard_normal(y.shape)
        columns = dict(
            zip(["torque", "valve", "angle", "rate"], [*u.T, *y.T], strict=True)
        )
        parts.append(
            pd.DataFrame({"run": label, "time": 0.1 * np.arange(n), **columns})
        )
    table = pd.concat(parts, ignore_index=True)
    return table[["run", "time", "torque", "valve"]], table[["angle", "rate"]]


@pytest.fixture(scope="module")
def fitted(plant):
    return SubspaceLTI(order=3, horizon=8, **ROLES).fit(*plant)


def drawn(display, place):
    """Values by lag of one panel, and which of them stand out."""
    values, outside = {}, set()
    for name, lines in display.lines_.items():
        points = lines[place].get_xdata(), lines[place].get_ydata()
        values |= dict(zip(*points, strict=True))
        if name == "outside":
            outside = set(points[0])
    return values, outside


@pytest.mark.parametrize("errors", ["simulation", "prediction"])
def test_panels_are_the_correlations_of_the_estimators_errors(plant, fitted, errors):
    X, y = plant
    display = ResidualDisplay.from_estimator(fitted, X, y, errors=errors, n_lags=12)
    predicted = (
        fitted.predict_with_initial_state(X, y)
        if errors == "simulation"
        else fitted.predict_ahead(X, y)
    )
    rows = [np.flatnonzero(X["run"] == run) for run in "ab"]
    e = [(y.to_numpy() - predicted)[r] for r in rows]
    u = [X[["torque", "valve"]].to_numpy()[r] for r in rows]
    own, with_inputs = autocorrelations(e, 12), cross_correlations(e, u, 12)
    quantile = norm.ppf(0.995)
    assert display.axes_.shape == (2, 3)
    for i in range(2):
        values, outside = drawn(display, (i, 0))
        assert_allclose([values[k] for k in range(1, 13)], own[1:, i])
        assert outside == {k for k, r in values.items() if abs(r) > quantile / 800**0.5}
        for j in range(2):
            values, outside = drawn(display, (i, 1 + j))
            assert_allclose(
                [values[k] for k in range(-12, 13)], with_inputs.values[:, i, j]
            )
            limit = quantile * with_inputs.deviation
            assert outside == {k for k, r in values.items() if abs(r) > limit}
    assert [ax.get_title() for ax in display.axes_[0]] == [
        "with itself",
        "with torque",
        "with valve",
    ]
    assert [ax.get_ylabel() for ax in display.axes_[:, 0]] == ["angle", "rate"]
    assert set(display.tests["input"]) == {"", "torque", "valve"}


@pytest.mark.slow
def test_a_model_that_lacks_states_is_seen_and_said(plant, fitted):
    with pytest.warns(UserWarning, match="order 2 lacks states"):
        poor = SubspaceLTI(order=2, horizon=8, **ROLES).fit(*plant)
    shown = {}
    for name, model in (("good", fitted), ("poor", poor)):
        display = ResidualDisplay.from_estimator(model, *plant)
        shown[name] = display.tests.groupby("test")["p_value"].min()
        texts = {t.get_text() for ax in display.axes_.flat for t in ax.texts}
        assert any(text.startswith("past p") for text in texts)
        # The colour of a text is the verdict.
        for ax in display.axes_.flat:
            for text in ax.texts:
                p = float(text.get_text().split()[-1])
                assert (text.get_color() == "#000000") == (p >= 0.01)
    assert shown["poor"]["past inputs"] < 1e-6
    assert shown["good"]["past inputs"] > 0.01
    assert min(s["future inputs"] for s in shown.values()) > 1e-3


def test_p_values_are_those_of_the_estimator_and_zero_errors_can_be_drawn(
    plant, fitted
):
    display = ResidualDisplay.from_estimator(fitted, *plant, confidence=0.9)
    expected = fitted.residual_tests(*plant, level=0.1)
    pd.testing.assert_frame_equal(display.tests, expected)
    silent = ResidualDisplay.from_residuals(np.zeros((50, 1)), E[:50])
    assert silent.tests["passed"].all()


def test_a_pipeline_is_drawn_from_its_simulation(tables, pipeline):
    X, y = tables
    display = ResidualDisplay.from_estimator(pipeline, X, y)
    wrong = y.to_numpy() - pipeline.predict_with_initial_state(X, y)
    e = [wrong[rows] for rows in pipeline.split_experiments(X)]
    assert_allclose(display.autocorrelations, autocorrelations(e, 25))
    assert display.output_names == ["angle"] and display.input_names == ["u"]


def test_missing_samples_are_left_out(plant):
    X, y = plant[0].copy(), plant[1].copy()
    y.loc[[100, 101, 640], "angle"] = np.nan
    model = SubspaceLTI(order=3, horizon=8, missing="split", **ROLES).fit(X, y)
    display = ResidualDisplay.from_estimator(model, X, y)
    assert_allclose(display.autocorrelation_band, norm.ppf(0.995) / np.sqrt(797))


def test_arrays_get_numbered_names_and_a_search_shows_its_best():
    e, u = np.random.default_rng(1).standard_normal((2, 300, 1))
    display = ResidualDisplay.from_residuals(e[:, 0], u[:, 0], n_lags=5)
    assert display.output_names == ["y1"] and display.input_names == ["u1"]
    both = ResidualDisplay.from_residuals([e, e], [u, u], n_lags=5)
    assert_allclose(both.autocorrelations, display.autocorrelations)
    model = SubspaceLTI(order=1, horizon=3).fit(u, np.cumsum(u, axis=0) + e)
    found = ResidualDisplay.from_estimator(
        SimpleNamespace(best_estimator_=model), u, np.cumsum(u, axis=0) + e
    )
    assert found.input_names == ["u1"]


@pytest.mark.slow
def test_texts_can_be_read_and_a_subplot_is_divided(plant, fitted, plt):
    from matplotlib.text import Text

    display = ResidualDisplay.from_estimator(fitted, *plant)
    display.figure_.canvas.draw()
    sizes = [
        text.get_fontsize()
        for text in display.figure_.findobj(Text)
        if text.get_text() and text.get_visible()
    ]
    assert min(sizes) >= 8
    assert display.figure_.get_size_inches()[0] * 100 == 800
    assert all(ax.get_xlabel() == "Lag (samples)" for ax in display.axes_[-1])
    figure, (left, right) = plt.subplots(1, 2)
    assert display.plot(right) is display
    assert display.figure_ is figure and display.axes_.shape == (2, 3)
    assert not right.axison
    assert_array_equal(left.lines, [])


E = np.ones((100, 1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda m, X, y: ResidualDisplay.from_estimator(m, X, y, errors="other"),
            "`errors` must be 'simulation' or 'prediction'. Got 'other'",
        ),
        (
            lambda m, X, y: ResidualDisplay.from_estimator(
                SimpleNamespace(predict_with_initial_state=1), X, y, errors="prediction"
            ),
            "must be a SubspaceLTI for errors='prediction'. Got SimpleNamespace",
        ),
        (
            lambda m, X, y: ResidualDisplay(E, E[:50]),
            r"as many samples as `errors`, \[100\]. Got \[50\]",
        ),
        (
            lambda m, X, y: ResidualDisplay(E, E, confidence=1.0),
            "`confidence` must lie between 0 and 1. Got 1.0",
        ),
        (
            lambda m, X, y: ResidualDisplay([E, np.ones((5, 2))], [E, E[:5]]),
            r"`errors` must be one array .*Got shapes \[\(100, 1\), \(5, 2\)\]",
        ),
        (
            lambda m, X, y: ResidualDisplay(E, np.nan * E),
            "`inputs` must be finite",
        ),
        (lambda m, X, y: ResidualDisplay(E[:9], E[:9]), "at least 22 samples.*Got 9"),
        (lambda m, X, y: ResidualDisplay([], []), "`errors` must be one array"),
        (
            lambda m, X, y: ResidualDisplay(E, E, output_names=["a", "b"]),
            "`output_names` must hold 1 names",
        ),
    ],
)
def test_errors_teach(plant, fitted, call, message):
    with pytest.raises(ValueError, match=message):
        call(fitted, *plant)
