"""What all displays share: imports, sizes of texts, labels, given axes."""

import subprocess
import sys

import numpy as np
import pytest

from lpvlearn import (
    LocalLPVPipeline,
    SubspaceLTI,
)
from lpvlearn.inspection import (
    BodeDisplay,
    ErrorDisplay,
    ParameterDisplay,
    PoleDisplay,
    SimulationDisplay,
    SingularValueDisplay,
)
from lpvlearn.inspection.drawing import line_style, with_unit

from .conftest import ONE, random_model, spring

HEAVY = ("matplotlib", "tqdm", "scipy.signal", "sklearn.pipeline")


def test_importing_the_library_leaves_out_what_is_slow_to_import():
    """Against what a user of scikit-learn and pandas has imported anyway."""
    code = f"""
import sys, sklearn.linear_model, pandas
before = set(sys.modules)
import lpvlearn, lpvlearn.inspection
sys.exit(", ".join(set({HEAVY}) & set(sys.modules) - before) or 0)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


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


@pytest.mark.slow
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


def test_others_must_not_take_the_name_of_the_pipelines_own(pipeline):
    with pytest.raises(ValueError, match="`others` must not use .*'restructured'"):
        ParameterDisplay.from_estimator(pipeline, others={"restructured": [[1]]})
    with pytest.raises(ValueError, match="own names, local, gray-box"):
        BodeDisplay.from_estimator(pipeline, kappa=0, others={"local": ONE})


def test_displays_ask_for_a_fitted_pipeline():
    for display in (ParameterDisplay, PoleDisplay):
        with pytest.raises(ValueError, match=r"fitted LocalLPVPipeline: call its fit"):
            display.from_estimator(LocalLPVPipeline())


@pytest.mark.parametrize(
    ("name", "label"),
    [("angle", "angle (rad)"), ("angle (°)", "angle (°)"), ("I [A]", "I [A]")],
)
def test_a_name_with_a_unit_gets_no_other_one(name, label):
    assert with_unit(name, "rad") == label
