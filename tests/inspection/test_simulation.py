"""Simulated outputs beside the measured ones."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
)
from lpvlearn.inspection import (
    SimulationDisplay,
)

from .conftest import STEP


def legend_texts(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_simulation_draws_the_signals_and_tells_their_bft():
    rng = np.random.default_rng(0)
    time, y = np.arange(50) * 0.1, rng.standard_normal((50, 2))
    predictions = {"good": y + 0.1, "poor": 0.3 * y}
    display = SimulationDisplay.from_predictions(time, y, predictions, units=["V", "A"])
    assert len(display.axes_) == 2
    assert [ax.get_ylabel() for ax in display.axes_] == ["y1 (V)", "y2 (A)"]
    for i, ax in enumerate(display.axes_):
        assert_array_equal(display.lines_["measured"][i].get_ydata(), y[:, i])
        for name, y_pred in predictions.items():
            line = display.lines_[name][i]
            assert_array_equal(line.get_xdata(), time)
            assert_array_equal(line.get_ydata(), y_pred[:, i])
        fits = [bft_score(y[:, i], y_pred[:, i]) for y_pred in predictions.values()]
        assert legend_texts(ax) == [
            "measured",
            f"good: BFT {fits[0]:.1f} %",
            f"poor: BFT {fits[1]:.1f} %",
        ]


def test_columns_of_a_simulation_are_found_by_their_names():
    rng = np.random.default_rng(1)
    y = pd.DataFrame(rng.standard_normal((50, 2)), columns=["a", "b"])
    turned = SimulationDisplay.from_predictions(range(50), y, 0.9 * y[["b", "a"]])
    expected = bft_score(y, 0.9 * y, multioutput="raw_values")
    assert_array_equal(turned.bft_["simulated"], expected)


def test_zoom_shows_a_part_and_keeps_the_fit_of_the_whole():
    time = np.arange(100) * 0.1
    y = np.sin(time)
    display = SimulationDisplay.from_predictions(time, y, 0.9 * y, zoom=(2.0, 3.0))
    line = display.lines_["simulated"][0]
    assert_allclose(line.get_xdata(), np.arange(20, 31) * 0.1)
    assert legend_texts(display.axes_[0])[1].endswith(f"{bft_score(y, 0.9 * y):.1f} %")
    title = display.axes_[0].get_legend().get_title().get_text()
    assert "whole record, 0 to 9.9 s" in title


def test_simulation_of_an_experiment_is_the_prediction_there(pipeline, tables):
    X, y = tables
    display = SimulationDisplay.from_estimator(pipeline, X, y, experiment="c")
    rows = (X["run"] == "c").to_numpy()
    line = display.lines_["simulated"][0]
    assert_allclose(line.get_ydata(), pipeline.predict(X)[rows][:, 0])
    assert_allclose(line.get_xdata(), X["time"][rows])
    assert display.axes_[0].get_ylabel() == "angle"
    assert display.axes_[-1].get_xlabel() == "Time (s)"


@pytest.mark.filterwarnings("ignore:The scored table starts in mid-motion")
def test_simulation_from_an_estimated_state_fits_a_record_cut_in_the_middle(
    pipeline, tables
):
    X, y = (table.iloc[30:300] for table in tables)
    rest = SimulationDisplay.from_estimator(pipeline, X, y)
    estimate = SimulationDisplay.from_estimator(
        pipeline, X, y, initial_state="estimate"
    )
    assert rest.bft_["simulated"][0] < 90 < 99 < estimate.bft_["simulated"][0]
    assert estimate.time[0] == pytest.approx(30 * STEP)


def test_simulation_takes_arrays_and_searches(tables):
    X, y = tables[0][["u"]].to_numpy()[:300], tables[1].to_numpy()[:300, 0]
    fitted = SubspaceLTI(order=2, horizon=8, sampling_time=STEP).fit(X, y)
    search = SimpleNamespace(best_estimator_=fitted)
    display = SimulationDisplay.from_estimator(search, X, y, name="model")
    assert_allclose(display.lines_["model"][0].get_ydata(), fitted.predict(X))
    assert_allclose(display.time, STEP * np.arange(300))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"experiment": "z"}, "`experiment` must be the label .*'a', 'b'.* Got 'z'"),
        ({"initial_state": "zero"}, "`initial_state` must be 'rest' or 'estimate'"),
        ({"zoom": (99, 100)}, "`zoom` must be .*within 0 to 14.95. Got"),
        ({"units": ["m", "s"]}, "`units` must hold 1 names"),
        ({"name": "measured"}, "must not name a simulation 'measured'"),
    ],
)
def test_simulation_errors_teach(pipeline, tables, options, message):
    with pytest.raises(ValueError, match=message):
        SimulationDisplay.from_estimator(pipeline, *tables, **options)


def test_simulation_errors_teach_about_shapes_and_estimators(tables):
    with pytest.raises(ValueError, match=r"`time` must have shape \(3,\)"):
        SimulationDisplay.from_predictions([0, 1], [1, 2, 3], [1, 2, 3])
    with pytest.raises(ValueError, match=r"'simulated' must have the shape"):
        SimulationDisplay.from_predictions([0, 1], [1.0, 2], [1.0, 2, 3])
    with pytest.raises(ValueError, match=r"split_experiments.*from_predictions"):
        SimulationDisplay.from_estimator(PolynomialLPV(), *tables)
    alone = SubspaceLTI(order=2, horizon=8, inputs="u")
    X, y = (table.iloc[:300] for table in tables)
    with pytest.raises(ValueError, match="`experiment` must be None"):
        SimulationDisplay.from_estimator(alone.fit(X, y), X, y, experiment="a")


def test_missing_measurements_leave_a_gap_and_do_not_count(pipeline, tables):
    X, y = tables[0].iloc[:300], tables[1].iloc[:300].copy()
    y.iloc[20:32] = np.nan
    display = SimulationDisplay.from_estimator(pipeline, X, y)
    drawn = display.lines_["measured"][0].get_ydata()
    assert_array_equal(np.isnan(drawn), np.isin(np.arange(300), range(20, 32)))
    assert legend_texts(display.axes_[0])[0] == "measured, 12 missing"
    assert display.n_missing_.tolist() == [12]
    known = y.notna().to_numpy()[:, 0]
    expected = bft_score(y[known], pipeline.predict(X)[known])
    assert_allclose(display.bft_["simulated"], expected)
    with pytest.raises(ValueError, match="`y_pred` must be finite"):
        SimulationDisplay.from_predictions([0, 1], [1.0, np.nan], [np.nan, 1.0])


def test_bands_are_those_of_outputs_without_noise(noisy, tables):
    X, y = tables
    display = SimulationDisplay.from_estimator(
        noisy, X, y, experiment="b", uncertainty=True, zoom=(2.0, 5.0)
    )
    rows = (X["run"] == "b").to_numpy()
    mean, std = noisy.predict(X[rows], return_std=True)
    assert_allclose(display.std["simulated"], std)
    (band,) = display.axes_[0].collections
    shown = (display.time >= 2.0) & (display.time <= 5.0)
    edges = band.get_paths()[0].vertices[:, 1]
    assert_allclose(edges.max(), (mean + 2 * std)[shown].max())
    assert "simulated ± 2 std: BFT" in legend_texts(display.axes_[0])[1]


@pytest.mark.slow
def test_bands_that_are_not_known_are_refused(noisy, tables):
    options = {"uncertainty": True}
    with pytest.raises(ValueError, match="`uncertainty` must be False.*'estimate'"):
        SimulationDisplay.from_estimator(
            noisy, *tables, initial_state="estimate", **options
        )
    black_box = SubspaceLTI(2, inputs="u", experiment="run", time="time")
    with pytest.warns(UserWarning, match="experiments contradict one another"):
        black_box.fit(*tables)
    with pytest.raises(ValueError, match="Got True with SubspaceLTI"):
        SimulationDisplay.from_estimator(black_box, *tables, **options)
    time, y = np.arange(3.0), np.ones(3)
    for std in ({"other": y}, {"model": np.ones(2)}):
        with pytest.raises(ValueError, match="`std` must have names of simulations"):
            SimulationDisplay(time, y, {"model": y}, std=std)


def test_what_was_not_measured_is_not_called_so():
    time = np.arange(5.0)
    display = SimulationDisplay.from_predictions(
        time, time, {"model": time}, true_name="truth", units={"y1": "m"}
    )
    assert list(display.lines_) == ["truth", "model"]
    legend = display.axes_[0].get_legend().get_texts()[0].get_text()
    assert (legend, display.axes_[0].get_ylabel()) == ("truth", "y1 (m)")
    with pytest.raises(ValueError, match="must not name a simulation 'truth'"):
        SimulationDisplay.from_predictions(
            time, time, {"truth": time}, true_name="truth"
        )
