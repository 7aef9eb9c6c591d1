"""Displays: what is drawn is what the models say; errors teach."""

import subprocess
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
    bft_score,
)
from lpvlearn.inspection import (
    BodeDisplay,
    ErrorDisplay,
    ParameterDisplay,
    PoleDisplay,
    SimulationDisplay,
    SingularValueDisplay,
)
from lpvlearn.inspection.drawing import line_style
from lpvlearn.inspection.frequency import frequency_axis

STEP = 0.05
KAPPA = np.array([-1.0, 0.0, 1.0, 2.0])
SPRING = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]], B=[[0], ["k"]], C=[[1, 0]]
)


@pytest.fixture(autouse=True)
def plt():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as pyplot

    yield pyplot
    pyplot.close("all")


def spring(kappa):
    return SPRING.model({"k": 9.0 + 2.0 * kappa + kappa**2, "c": 0.8})


@pytest.fixture(scope="module")
def tables():
    rng = np.random.default_rng(0)
    parts = []
    for label, kappa in zip("abcd", KAPPA, strict=True):
        u = np.repeat(rng.choice([-1.0, 1.0], (60, 1)), 5, axis=0)
        y = spring(kappa).simulate(u, sampling_time=STEP)
        parts.append(
            pd.DataFrame(
                {
                    "u": u[:, 0],
                    "kappa": kappa,
                    "run": label,
                    "time": STEP * np.arange(300),
                    "angle": y[:, 0],
                }
            )
        )
    table = pd.concat(parts, ignore_index=True)
    return table.drop(columns="angle"), table[["angle"]]


@pytest.fixture(scope="module")
def pipeline(tables):
    return LocalLPVPipeline(
        local=SubspaceLTI(order=2, horizon=8),
        restructurer=GrayBoxRestructurer(SPRING),
        scheduling="kappa",
        experiment="run",
        time="time",
    ).fit(*tables)


def random_model(seed, order=4, n_outputs=2, n_inputs=3, sampling_time=None):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((order, order))
    if sampling_time is None:
        A -= (np.abs(np.linalg.eigvals(A).real).max() + 0.1) * np.eye(order)
    else:
        A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    return StateSpace(
        A,
        rng.standard_normal((order, n_inputs)),
        rng.standard_normal((n_outputs, order)),
        rng.standard_normal((n_outputs, n_inputs)),
        sampling_time,
    )


def test_importing_the_library_leaves_matplotlib_out():
    code = (
        "import sys, lpvlearn, lpvlearn.inspection; "
        "sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


# -- all displays ----------------------------------------------------------------------


@pytest.fixture
def displays(pipeline, tables):
    subspace = SubspaceLTI(
        order=2, horizon=8, inputs="u", experiment="run", time="time"
    )
    models = {"one": random_model(1), "two": random_model(2)}
    return [
        BodeDisplay.from_models(models, phase=True),
        SimulationDisplay.from_estimator(pipeline, *tables, units="rad"),
        ParameterDisplay.from_estimator(pipeline),
        PoleDisplay.from_estimator(pipeline, damping=True),
        ErrorDisplay.from_estimator(pipeline.restructurers_[0], spring(-0.9)),
        SingularValueDisplay.from_estimator(
            subspace.fit(tables[0].iloc[:300], tables[1].iloc[:300])
        ),
    ]


def test_every_text_is_of_8_points_or_more_and_every_figure_800_pixels_wide(
    displays, plt
):
    from matplotlib.text import Text

    for display in displays:
        display.figure_.canvas.draw()
        sizes = [
            text.get_fontsize()
            for text in display.figure_.findobj(Text)
            if text.get_text() and text.get_visible()
        ]
        assert min(sizes) >= 8
        assert display.figure_.get_size_inches()[0] * 100 == 800


def test_every_display_labels_its_axes(displays):
    for display in displays:
        axes = np.ravel(display.axes_)
        assert any(ax.get_ylabel() or ax.get_title() for ax in axes)
        last = getattr(display, "phase_axes_", None)
        bottom = axes[-1] if last is None else last[-1, -1]
        assert bottom.get_xlabel()


def test_plot_draws_again_into_given_axes(displays, plt):
    for display in displays[3:]:
        figure, ax = plt.subplots()
        assert display.plot(ax) is display
        assert display.figure_ is figure and display.axes_[0] is ax
    simulation = displays[1]
    figure, ax = plt.subplots()
    assert simulation.plot(ax).axes_[0] is ax


def test_lines_differ_without_colour():
    styles = [line_style(k, 100) for k in range(7)]
    looks = {(str(s["linestyle"]), s.get("marker")) for s in styles}
    assert len(looks) == 7


# -- Bode ------------------------------------------------------------------------------


def test_bode_lines_are_the_responses_in_decibels_and_degrees():
    models = {"a": random_model(1), "b": random_model(2)}
    display = BodeDisplay.from_models(models, phase=True)
    assert display.axes_.shape == display.phase_axes_.shape == (2, 3)
    for name, model in models.items():
        G = model.frequency_response(display.omega)
        for i, j in np.ndindex(2, 3):
            line = display.lines_[name][i, j]
            assert_array_equal(line.get_xdata(), display.omega)
            assert_allclose(line.get_ydata(), 20 * np.log10(np.abs(G[:, i, j])))
            phase = display.phase_lines_[name][i, j].get_ydata()
            assert_allclose(
                np.exp(1j * np.deg2rad(phase)), G[:, i, j] / np.abs(G[:, i, j])
            )
            assert np.abs(np.diff(phase)).max() <= 180


def test_phases_of_models_lie_within_half_a_turn_of_the_first():
    # +179 and -179 degrees are two degrees apart.
    responses = {
        name: np.full((5, 1, 1), np.exp(1j * np.deg2rad(angle)))
        for name, angle in (("above", 179.0), ("below", -179.0))
    }
    display = BodeDisplay([1, 2, 3, 4, 5], responses).plot(phase=True)
    assert_allclose(display.phase_lines_["above"][0, 0].get_ydata(), 179.0)
    assert_allclose(display.phase_lines_["below"][0, 0].get_ydata(), 181.0)


def test_bode_shows_resonances_in_full():
    light = StateSpace([[0, 1], [-1, -2e-4]], [[0], [1]], [[1, 0]])
    top = BodeDisplay.from_models({"light": light}).lines_["light"][0, 0].get_ydata()
    assert_allclose(top.max(), 20 * np.log10(light.hinf_norm()), atol=1e-3)


def test_frequency_axis_reaches_a_decade_beyond_the_poles():
    omega = frequency_axis([StateSpace(np.diag([-2.0, -30.0]), [[1], [1]], [[1, 1]])])
    assert_allclose(omega[[0, -1]], [0.2, 300.0])


@pytest.mark.parametrize(
    "model",
    [
        StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]]),
        StateSpace([[0.0]], [[1.0]], [[1.0]]),
        StateSpace([[0.0]], [[1.0]], [[1.0]], sampling_time=0.1),
        StateSpace([[1.0]], [[1.0]], [[1.0]], sampling_time=0.1),
    ],
    ids=["gain", "integrator", "delay", "sum"],
)
def test_bode_draws_models_without_a_time_constant(model):
    display = BodeDisplay.from_models({"model": model}, phase=True)
    assert np.isfinite(display.lines_["model"][0, 0].get_ydata()).all()
    display.figure_.canvas.draw()


def test_sampled_models_end_at_their_nyquist_frequency():
    continuous = spring(0.0)
    models = {"continuous": continuous, "sampled": continuous.to_discrete(0.5)}
    display = BodeDisplay.from_models(models, omega=np.geomspace(0.1, 100, 200))
    seen = np.isfinite(display.lines_["sampled"][0, 0].get_ydata())
    assert_array_equal(seen, display.omega <= np.pi / 0.5)
    alone = BodeDisplay.from_models({"sampled": models["sampled"]})
    assert_allclose(alone.omega[-1], np.pi / 0.5)


def test_zero_entries_leave_their_panel_empty():
    diagonal = StateSpace(-np.eye(2), np.eye(2), np.eye(2))
    display = BodeDisplay.from_models({"diagonal": diagonal}, phase=True)
    assert np.isnan(display.lines_["diagonal"][0, 1].get_ydata()).all()
    display.figure_.canvas.draw()


def test_bands_are_two_standard_deviations_wide():
    omega = np.geomspace(0.1, 10, 40)
    model = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    G = model.frequency_response(omega)
    display = BodeDisplay.from_models(
        {"model": model}, omega=omega, std={"model": 0.1 * np.abs(G)}, phase=True
    )
    (band,) = display.axes_[0, 0].collections
    level = 20 * np.log10(np.abs(G[0, 0, 0]))
    start = band.get_paths()[0].vertices
    start = start[np.isclose(start[:, 0], omega[0])][:, 1] - level
    assert_allclose(start.max(), 20 * np.log10(1.2))
    assert_allclose(start.min(), 20 * np.log10(0.8))


@pytest.mark.parametrize("phase", [False, True])
def test_bode_of_an_identified_model_shows_what_it_knows_of_its_error(tables, phase):
    X, y = (table.iloc[:300] for table in tables)
    y = y + 0.01 * np.random.default_rng(0).standard_normal(y.shape)
    fitted = SubspaceLTI(
        order=2, horizon=8, inputs="u", experiment="run", time="time"
    ).fit(X, y)
    truth = {"truth": spring(KAPPA[0]).to_discrete(STEP)}
    display = BodeDisplay.from_estimator(
        fitted, uncertainty=True, others=truth, phase=phase
    )
    assert list(display.std) == ["SubspaceLTI"]
    std = fitted.frequency_response_std(display.omega)
    assert_allclose(
        display.std["SubspaceLTI"] ** 2, (std.real**2 + std.imag**2) / 2, rtol=1e-12
    )
    assert len(display.axes_[0, 0].collections) == 1
    error = np.abs(display.responses["SubspaceLTI"] - display.responses["truth"])
    known = np.isfinite(error)
    assert (error < 4 * display.std["SubspaceLTI"])[known].mean() > 0.9


def test_bode_divides_a_subplot_into_its_grid(plt):
    figure, (left, right) = plt.subplots(1, 2)
    display = BodeDisplay.from_models({"a": random_model(0)}, ax=right)
    assert display.figure_ is figure
    assert display.axes_.shape == (2, 3)
    assert not right.axison


def test_bode_of_a_pipeline_shows_local_gray_box_and_interpolated_models(pipeline):
    display = BodeDisplay.from_estimator(
        pipeline, kappa=0.9, others={"truth": spring(1.0)}
    )
    assert list(display.lines_) == ["truth", "local", "gray-box", "interpolated"]
    nearest = pipeline.local_models_[2].frequency_response(display.omega)
    assert_array_equal(display.responses["local"], nearest)
    here = pipeline.lpv_.at(0.9).frequency_response(display.omega)
    assert_array_equal(display.responses["interpolated"], here)


def test_bode_of_a_restructurer_shows_its_model(pipeline):
    fitted = pipeline.restructurers_[0]
    display = BodeDisplay.from_estimator(SimpleNamespace(best_estimator_=fitted))
    assert list(display.lines_) == ["GrayBoxRestructurer"]


ONE = StateSpace([[-1.0]], [[1.0]], [[1.0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: BodeDisplay.from_models(ONE), "`models` must be a dict .*StateSpace"),
        (lambda: BodeDisplay.from_models({}), "at least one entry.*an empty dict"),
        (lambda: BodeDisplay.from_models({"a": 1}), r"`models\['a'\]` must be a State"),
        (
            lambda: BodeDisplay.from_models({"a": ONE, "b": random_model(0)}),
            r"same inputs and outputs.*\(1, 1\).*'b'.*\(2, 3\)",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, std={"a": [1.0]}),
            "`omega` must be given with `std`",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, omega=[1, 2], std={"b": [1]}),
            "`std` must .* among .*'a'.* Got 'b'",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, omega=[1, 2], std={"a": [1]}),
            r"`std\['a'\]` must hold .*\(2, 1, 1\).*Got shape \(1,\)",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, omega=[2, 1]),
            "`omega` must be finite, positive and increasing",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, omega=[[2.0]]),
            r"`omega` must hold at least 2 .* Got shape \(1, 1\)",
        ),
        (
            lambda: BodeDisplay([1.0, 2.0], {"a": np.ones(2)}),
            r"`responses\['a'\]` must have shape \(2, n_outputs, n_inputs\)",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, output_names=["p", "q"]),
            "`output_names` must hold 1 names",
        ),
        (
            lambda: BodeDisplay.from_models({"a": ONE}, ax=[None, None]),
            r"`ax` must be None, one subplot or an array of 1 Axes .* Got 2",
        ),
        (
            lambda: BodeDisplay.from_estimator(
                SimpleNamespace(lti_=ONE), uncertainty=True
            ),
            "`uncertainty` must be False .* Got True with SimpleNamespace; .*`std`",
        ),
        (
            lambda: BodeDisplay.from_estimator(SubspaceLTI()),
            r"`estimator` must be a fitted SubspaceLTI.*call fit\(\) first",
        ),
    ],
)
def test_bode_errors_teach(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_bode_of_a_pipeline_asks_for_the_scheduling_value(pipeline):
    with pytest.raises(ValueError, match=r"`kappa` must tell.*operating points are"):
        BodeDisplay.from_estimator(pipeline)
    with pytest.raises(ValueError, match=r"`kappa` must hold 1 scheduling value"):
        BodeDisplay.from_estimator(pipeline, kappa=[0.0, 1.0])


# -- simulation ------------------------------------------------------------------------


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


# -- parameters ------------------------------------------------------------------------


def test_parameters_of_a_pipeline_are_points_and_their_interpolation_a_curve(pipeline):
    truth = pd.DataFrame({"k": 9.0 + 2 * KAPPA + KAPPA**2, "c": 0.8})
    display = ParameterDisplay.from_estimator(pipeline, others={"truth": truth})
    names = list(pipeline.parameters_.columns)
    assert [ax.get_title() for ax in display.axes_] == names
    assert list(display.lines_) == ["restructured", "truth"]
    for k, name in enumerate(names):
        points = display.lines_["restructured"][k]
        assert_allclose(points.get_xdata(), pipeline.operating_points_[:, 0])
        assert_allclose(points.get_ydata(), pipeline.parameters_[name])
        assert_allclose(display.lines_["truth"][k].get_ydata(), truth[name])
        curve = display.curves_["restructured"][k]
        fine = curve.get_xdata()
        assert fine[0] == KAPPA.min() and fine[-1] == KAPPA.max()
        assert_allclose(
            curve.get_ydata(), pipeline.lpv_.parameters(fine)[:, k], rtol=1e-9
        )


def test_names_select_parameters(pipeline):
    display = ParameterDisplay.from_estimator(pipeline, names=["k"])
    assert display.names == ["k"] and len(display.axes_) == 1
    assert_allclose(
        display.lines_["restructured"][0].get_ydata(), pipeline.parameters_["k"]
    )


def test_sixteen_parameters_make_a_grid_of_four_by_four():
    rng = np.random.default_rng(0)
    theta = rng.standard_normal((5, 16))
    display = ParameterDisplay.from_parameters(
        np.linspace(0, 1, 5)[:, None], {"a": theta, "b": theta + 1}
    )
    assert len(display.axes_) == 16
    spec = display.axes_[0].get_subplotspec().get_gridspec()
    assert spec.get_geometry() == (4, 4)
    assert display.names[0] == "p1" and not display.curves_


def test_an_interpolator_is_fitted_to_each_set_and_left_alone():
    kappa = np.linspace(-1, 1, 5)
    sets = {"line": 2 * kappa[:, None], "bend": kappa[:, None] ** 2}
    polynomial = PolynomialLPV(degree=2)
    display = ParameterDisplay.from_parameters(
        kappa, sets, interpolator=polynomial, names=["gain"]
    )
    assert not hasattr(polynomial, "coef_")
    fine = display.curves_["bend"][0].get_xdata()
    assert_allclose(display.curves_["bend"][0].get_ydata(), fine**2, atol=1e-12)
    assert_allclose(display.curves_["line"][0].get_ydata(), 2 * fine, atol=1e-12)


def test_a_constant_parameter_is_drawn_flat():
    theta = 5 + 1e-12 * np.arange(4.0)[:, None]
    low, high = (
        ParameterDisplay.from_parameters(KAPPA, {"a": theta}).axes_[0].get_ylim()
    )
    assert high - low > 0.5


@pytest.mark.parametrize(
    ("kappa", "parameters", "names", "message"),
    [
        (
            np.ones((4, 2)),
            {"a": np.ones((4, 1))},
            None,
            "needs one scheduling variable",
        ),
        (KAPPA, {"a": np.ones((3, 1))}, None, r"`parameters\['a'\]` must .*\(4, 1\)"),
        (KAPPA, np.ones((4, 1)), None, "`parameters` must be a dict"),
        (KAPPA, {"a": np.ones((4, 2))}, ["p"], "`names` must hold 2 names"),
        (
            KAPPA,
            {"a": pd.DataFrame({"k": KAPPA})},
            ["m"],
            "`names` must be among the parameters k. Got 'm'",
        ),
        (
            KAPPA,
            {"a": pd.DataFrame({"k": KAPPA}), "b": pd.DataFrame({"m": KAPPA})},
            None,
            r"`parameters\['b'\]` must have the columns .* none named 'k'",
        ),
    ],
)
def test_parameter_errors_teach(kappa, parameters, names, message):
    with pytest.raises(ValueError, match=message):
        ParameterDisplay.from_parameters(kappa, parameters, names=names)


def test_others_must_not_take_the_name_of_the_pipelines_own(pipeline):
    with pytest.raises(ValueError, match="`others` must not use .*'restructured'"):
        ParameterDisplay.from_estimator(pipeline, others={"restructured": [[1]]})
    with pytest.raises(ValueError, match="own names, local, gray-box"):
        BodeDisplay.from_estimator(pipeline, kappa=0, others={"local": ONE})


def test_displays_ask_for_a_fitted_pipeline():
    for display in (ParameterDisplay, PoleDisplay):
        with pytest.raises(ValueError, match=r"fitted LocalLPVPipeline.*call fit"):
            display.from_estimator(LocalLPVPipeline())


# -- poles -----------------------------------------------------------------------------


def lpv_of(n_scheduling):
    corners = np.array([[0.0] * n_scheduling, [1.0] * n_scheduling])
    points = np.vstack([corners, np.eye(n_scheduling)])
    theta = np.column_stack([np.full(len(points), 0.5), 4 + points.sum(1)])
    return LPVStateSpace(SPRING, PolynomialLPV(degree=1).fit(points, theta), corners)


def test_pole_points_are_the_frozen_poles_coloured_by_scheduling():
    lpv = lpv_of(1)
    kappa = np.linspace(0, 1, 7)
    display = PoleDisplay.from_model(lpv, kappa=kappa, damping=True)
    poles = np.array([lpv.at(k).poles() for k in kappa]).ravel()
    drawn = display.points_.get_offsets() @ [1, 1j]
    assert_allclose(np.sort_complex(drawn), np.sort_complex(poles))
    assert_array_equal(display.points_.get_array(), np.repeat(kappa, 2))
    assert display.local_points_ is None
    right = display.ax_.get_xlim()[1]
    assert right > 0  # the border of stability is seen


def test_damping_lines_go_through_poles_of_that_damping():
    display = PoleDisplay([0.0], [[-3 + 4j, -3 - 4j]]).plot(damping=True)
    lines = [line for line in display.ax_.lines if line.get_linestyle() == ":"]
    ratios = [
        -line.get_xdata()[0] / np.hypot(line.get_xdata()[0], line.get_ydata()[0])
        for line in lines
    ]
    labels = [text.get_text() for text in display.ax_.texts]
    assert_allclose(ratios, [float(label.split()[-1]) for label in labels])


def test_poles_of_a_pipeline_show_the_local_models_as_rings(pipeline):
    display = PoleDisplay.from_estimator(pipeline)
    drawn = display.local_points_.get_offsets() @ [1, 1j]
    local = np.concatenate([model.poles() for model in pipeline.local_models_])
    assert_allclose(drawn, local)


def test_pole_errors_teach():
    with pytest.raises(ValueError, match="needs one scheduling variable.* Got 2"):
        PoleDisplay.from_model(lpv_of(2))
    with pytest.raises(ValueError, match="`model` must be an LPVStateSpace"):
        PoleDisplay.from_model(spring(0.0))
    with pytest.raises(ValueError, match=r"`poles` must have shape \(1, order\)"):
        PoleDisplay([0.0], [-1.0, -2.0])


# -- restructuring error ---------------------------------------------------------------


def largest_singular_value(model, omega):
    G = model.frequency_response(omega)
    return np.linalg.svd(G, compute_uv=False)[:, 0]


def test_error_lines_are_largest_singular_values_of_the_difference():
    gray, black, start = (random_model(seed, n_inputs=2) for seed in (1, 2, 3))
    display = ErrorDisplay.from_models(gray, black, start=start, floor=0.1)
    omega = display.lines_["error"].get_xdata()
    for name, model in (("error", gray), ("start", start)):
        G = model.frequency_response(omega) - black.frequency_response(omega)
        expected = np.linalg.svd(G, compute_uv=False)[:, 0]
        assert_allclose(display.lines_[name].get_ydata(), expected, rtol=1e-9)
        norm = (model - black).hinf_norm()
        assert display.lines_[name].get_label() == f"{name}, H∞ norm {norm:.3g}"
    assert_array_equal(display.lines_["floor"].get_ydata(), 0.1)


def test_active_peaks_lie_on_the_curve_and_beyond_the_axis_at_its_ends():
    slow, fast = ONE, StateSpace([[-2.0]], [[2.0]], [[1.0]], [[0.1]])
    active = [0.0, 1.5, np.inf]
    display = ErrorDisplay.from_models(slow, fast, active_frequencies=active)
    expected = largest_singular_value(slow - fast, active)
    points = display.active_points_
    assert_allclose([point.get_ydata()[0] for point in points], expected)
    assert [point.get_marker() for point in points] == ["<", "o", ">"]
    omega = [point.get_xdata()[0] for point in points]
    assert_allclose(omega, [display.omega[0], 1.5, display.omega[-1]])
    assert 1.5 in display.omega


def test_error_of_a_restructurer_is_what_it_minimised():
    black = random_model(5, order=3, n_outputs=1, n_inputs=1)
    structure = GrayBoxStructure.observable_canonical(2, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two states cannot represent three
        fitted = GrayBoxRestructurer(structure, n_starts=4).fit_model(black)
    display = ErrorDisplay.from_estimator(fitted, black, start=fitted.params_)
    D = black.D - fitted.dropped_feedthrough_
    compared = StateSpace(black.A, black.B, black.C, D)
    expected = largest_singular_value(fitted.lti_ - compared, display.omega)
    assert_allclose(display.error, expected, rtol=1e-8)
    assert_allclose(display.start, display.error)
    assert_allclose(display.norms["error"], fitted.error_, rtol=1e-6)
    assert ErrorDisplay.from_estimator(fitted, black, start=None).start is None
    began = ErrorDisplay.from_estimator(fitted, black)
    start = fitted.structure_.model(fitted.start_params_)
    assert_allclose(began.start, largest_singular_value(start - compared, began.omega))
    assert began.norms["start"] >= began.norms["error"] * (1 - 1e-9)
    assert_allclose(display.active_values.max(initial=0.0), fitted.error_, rtol=1e-3)


def test_sampled_models_have_their_last_peak_at_the_nyquist_frequency():
    a, b = (random_model(k, 2, 1, 1, sampling_time=0.1) for k in (1, 2))
    display = ErrorDisplay.from_models(a, b, active_frequencies=[np.pi / 0.1])
    assert np.isfinite(display.active_values).all()
    assert_allclose(display.omega[-1], np.pi / 0.1)


def test_an_error_of_zero_draws_without_a_warning():
    ErrorDisplay.from_models(ONE, ONE).figure_.canvas.draw()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ErrorDisplay.from_models(ONE, 2), "`black_box` must be a StateSpace"),
        (
            lambda: ErrorDisplay.from_models(ONE, random_model(0)),
            "same inputs, outputs",
        ),
        (
            lambda: ErrorDisplay.from_estimator(GrayBoxRestructurer(), ONE),
            r"fitted GrayBoxRestructurer.*fit_model\(\) first",
        ),
        (
            lambda: ErrorDisplay.from_models(ONE, ONE, floor=-1),
            "`floor` must be a finite number of at least 0. Got -1",
        ),
        (
            lambda: ErrorDisplay([1, 2], [1.0]),
            r"`error` must have shape \(2,\).*Got \(1,\)",
        ),
        (
            lambda: ErrorDisplay([1, 2], [1, 1], active_frequencies=[1.0]),
            "`active_values` must hold a value for each of 1",
        ),
    ],
)
def test_error_display_errors_teach(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_error_display_refuses_another_black_box(pipeline):
    fitted = pipeline.restructurers_[0]
    with pytest.raises(ValueError, match="`model` must be the black box of the fit"):
        ErrorDisplay.from_estimator(fitted, random_model(0))
    with pytest.raises(ValueError, match="`model` must be a StateSpace. Got list"):
        ErrorDisplay.from_estimator(fitted, [1])
    with pytest.raises(ValueError, match="`start` must be 'auto', .* Got 'fit'"):
        ErrorDisplay.from_estimator(fitted, ONE, start="fit")


# -- singular values -------------------------------------------------------------------


def test_singular_values_up_to_the_order_stand_out(tables):
    X, y = (table.iloc[:300] for table in tables)
    fitted = SubspaceLTI(order=2, horizon=8, inputs="u").fit(X, y)
    display = SingularValueDisplay.from_estimator(fitted)
    assert_allclose(
        display.lines_["kept"].get_ydata(), fitted.singular_values_[:2], rtol=1e-12
    )
    assert_array_equal(display.lines_["left"].get_xdata(), np.arange(3, 9))
    assert display.ax_.get_yscale() == "log"
    assert [text.get_text() for text in display.ax_.texts] == ["order 2"]


def test_many_singular_values_are_cut_but_never_within_twice_the_order():
    values = np.geomspace(1, 1e-6, 100)
    few = SingularValueDisplay.from_values(values, order=3)
    assert few.lines_["left"].get_xdata()[-1] == 30
    many = SingularValueDisplay.from_values(values, order=40)
    assert many.lines_["left"].get_xdata()[-1] == 80


def test_zero_singular_values_stay_on_the_logarithmic_axis():
    display = SingularValueDisplay.from_values([1.0, 0.0])
    assert (display.lines_["left"].get_ydata() > 0).all()


@pytest.mark.parametrize(
    ("values", "order", "message"),
    [
        ([[1.0]], None, r"`singular_values` must be a vector .* shape \(1, 1\)"),
        ([-1.0], None, "non-negative"),
        ([0.0], None, "must not all be zero"),
        ([1.0], 2, "`order` must be 0 to 1, the number of singular values. Got 2"),
    ],
)
def test_singular_value_errors_teach(values, order, message):
    with pytest.raises(ValueError, match=message):
        SingularValueDisplay.from_values(values, order)


def test_singular_values_ask_for_a_fitted_estimator():
    with pytest.raises(ValueError, match=r"fitted SubspaceLTI.*call fit\(\)"):
        SingularValueDisplay.from_estimator(SubspaceLTI())
