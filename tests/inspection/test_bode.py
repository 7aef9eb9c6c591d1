"""Bode diagrams: decibels, degrees, bands."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    StateSpace,
    SubspaceLTI,
)
from lpvlearn.inspection import (
    BodeDisplay,
)
from lpvlearn.inspection.fitted import nearest_point

from .conftest import KAPPA, ONE, STEP, random_model, spring


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


def test_bode_draws_the_band_of_an_interpolated_model(noisy):
    display = BodeDisplay.from_estimator(noisy, kappa=0.4, uncertainty=True)
    assert list(display.std) == ["interpolated"]
    std = noisy.lpv_.frequency_response_std(0.4, display.omega)
    assert_allclose(
        display.std["interpolated"] ** 2, (std.real**2 + std.imag**2) / 2, rtol=1e-12
    )
    assert len(display.axes_[0, 0].collections) == 1
    error = np.abs(
        display.responses["interpolated"]
        - spring(0.4).frequency_response(display.omega)
    )
    assert (error < 4 * display.std["interpolated"]).mean() > 0.9


def test_bode_draws_the_family_of_models_at_several_values(noisy):
    kappa = np.array([[0.0], [0.4], [0.9]])
    display = BodeDisplay.from_estimator(noisy, kappa=kappa, uncertainty=True)
    names = ["at 0", "at 0.4", "at 0.9"]
    assert list(display.responses) == list(display.std) == names
    alone = BodeDisplay.from_estimator(
        noisy, kappa=0.4, uncertainty=True, omega=display.omega
    )
    for found, one in (
        (display.responses, alone.responses),
        (display.std, alone.std),
    ):
        np.testing.assert_array_equal(found["at 0.4"], one["interpolated"])
    assert len(display.axes_[0, 0].collections) == 3
    with pytest.raises(ValueError, match=r"`kappa` must hold 1 scheduling value"):
        BodeDisplay.from_estimator(noisy, kappa=[[0.0, 1.0]])


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
            r"`estimator` must be a fitted SubspaceLTI.*call its fit\(\) first\. Got",
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


def test_a_pipeline_names_its_signals_and_units_stand_with_them(pipeline):
    units = {"u": "N", "angle": "rad"}
    display = BodeDisplay.from_estimator(pipeline, kappa=0.0, units=units)
    ax = display.axes_[0, 0]
    assert ax.get_title() == "from u (N)"
    assert ax.get_ylabel() == "to angle (rad)\nMagnitude (dB)"
    alone = BodeDisplay.from_estimator(pipeline, kappa=0.0).axes_[0, 0]
    assert (alone.get_title(), alone.get_ylabel()) == ("", "Magnitude (dB)")


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_nearest_point_is_the_same_in_other_units(unit):
    points = np.array([[0.0, 0.0], [0.3, 1.0], [1.0, 0.1], [0.7, 0.9], [0.5, 0.4]])
    scale = np.array([1.0, unit])
    held = SimpleNamespace(
        operating_points_=points * scale, lpv_=SimpleNamespace(n_scheduling=2)
    )
    assert nearest_point(held, [0.9, 0.8] * scale) == 3
    held.operating_points_[:, 1] = unit  # constant: all are as far away in it
    assert nearest_point(held, [0.9, 0.8] * scale) == 2
