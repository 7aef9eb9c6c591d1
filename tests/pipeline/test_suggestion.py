"""Where to measure next: candidates, what their columns mean, and their order."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError
from sklearn.neighbors import KNeighborsRegressor

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    PolynomialLPV,
    SplineLPV,
    from_trajectories,
    gap,
    suggest_operating_point,
)

from ..conftest import KAPPA, spring_pipeline, spring_tables

COLUMNS = ["from", "to", "neighbour_gap", "leave_one_out", "noise", "uncertainty"]


@pytest.fixture
def fitted(memory):
    """Fit the spring's pipeline; what several tests need is kept."""

    def fit(interpolator=None, noise=0.0, scale=(1.0, 1.0), kappas=KAPPA):
        X, y = spring_tables(noise=noise, n_samples=300, kappas=kappas)
        X["force"] *= scale[0]
        pipeline = spring_pipeline(interpolator=interpolator, memory=memory)
        return pipeline.fit(X, scale[1] * y)

    return fit


@pytest.mark.slow
def test_a_form_that_is_true_leaves_only_noise(fitted):
    """Without noise nothing moves, whichever of the four points is left out."""
    pipeline = fitted(PolynomialLPV(2))
    table = suggest_operating_point(pipeline)
    assert list(table.columns) == ["kappa", *COLUMNS]
    assert_allclose(sorted(table["kappa"]), [0.25, 0.75, 1.25])
    assert_array_equal(table["to"] - table["from"], 1)
    assert table["uncertainty"].max() < 1e-5
    assert (table["neighbour_gap"] > 0.01).all()
    assert table["uncertainty"].is_monotonic_decreasing


@pytest.mark.slow
def test_a_form_that_is_not_true_is_least_certain_where_it_bends(fitted):
    """A straight line for a parabola: near an end, where a point is missed most."""
    table = suggest_operating_point(fitted(PolynomialLPV(1)))
    assert table["leave_one_out"].min() > 0.01
    line = suggest_operating_point(fitted(SplineLPV("linear"), kappas=(0, 0.2, 0.4, 3)))
    assert_allclose(line["kappa"].iloc[0], 1.7)


@pytest.mark.slow
def test_noise_is_proportional_to_that_of_the_outputs(fitted):
    low, high = (
        suggest_operating_point(fitted(PolynomialLPV(2), noise)).sort_values("kappa")
        for noise in (0.002, 0.004)
    )
    ratio = high["noise"].to_numpy() / low["noise"].to_numpy()
    assert_allclose(ratio, 2.0, rtol=0.1)
    assert (low["noise"] > 1e-5).all()


@pytest.mark.slow
@pytest.mark.parametrize("scale", [(1e6, 1.0), (1.0, 1e-6), (1e-3, 1e3)])
def test_units_of_signals_do_not_matter(fitted, scale):
    plain = suggest_operating_point(fitted(PolynomialLPV(1)))
    other = suggest_operating_point(fitted(PolynomialLPV(1), scale=scale))
    columns = ["kappa", "neighbour_gap", "leave_one_out"]
    assert_allclose(other[columns], plain[columns], rtol=1e-4)


@pytest.mark.slow
def test_neighbour_gaps_are_those_of_models_with_gains_of_one(fitted):
    pipeline = fitted(PolynomialLPV(2))
    table = suggest_operating_point(pipeline, criterion="neighbour_gap")
    assert table["neighbour_gap"].is_monotonic_decreasing
    models = pipeline.structured_models_
    omega = np.concatenate([np.abs(model.poles()) for model in models])
    largest = max(np.abs(model.frequency_response(omega)).max() for model in models)
    one, other = (
        type(m)(m.A, m.B / largest, m.C)
        for m in (models[table["from"][0]], models[table["to"][0]])
    )
    assert_allclose(table["neighbour_gap"][0], gap(one, other), rtol=1e-6)


@pytest.mark.slow
def test_where_every_point_is_needed_the_gap_ranks(fitted):
    """A cubic through four points: none can be left out, and noise is not known."""
    table = suggest_operating_point(fitted(PolynomialLPV(3)))
    assert table["leave_one_out"].isna().all()
    nearest = suggest_operating_point(fitted(KNeighborsRegressor(4)))
    assert nearest["uncertainty"].isna().all()
    assert nearest["neighbour_gap"].is_monotonic_decreasing
    with pytest.warns(UserWarning, match="nothing tells of what is between"):
        pipeline = fitted(AutoLPV(), kappas=(0.0, 1.0))
    two = suggest_operating_point(pipeline)
    assert len(two) == 1 and two["leave_one_out"][0] > 0.01


def plane(places):
    """A pipeline of two scheduling variables, at some places."""
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    u = np.sign(np.random.default_rng(0).standard_normal(120))
    runs = []
    for place in places:
        model = structure.model({"a": 1 + place[0], "b": 2 + place[1]})
        y = model.simulate(u, sampling_time=0.2)
        runs.append((u, np.tile(place, (len(u), 1)), y))
    X, y = from_trajectories(runs, sampling_time=0.2)
    X = X.rename(columns={"kappa1": "mass", "kappa2": "speed"})
    return LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(structure),
        interpolator=PolynomialLPV(1),
        scheduling=["mass", "speed"],
        experiment="experiment",
        time="time",
    ).fit(X, y)


@pytest.mark.slow
def test_two_scheduling_variables():
    """The corners of a square and its middle: four sides, four spokes."""
    table = suggest_operating_point(plane([(0, 0), (0, 9), (1, 0), (1, 9), (0.5, 4.5)]))
    assert list(table.columns) == ["mass", "speed", *COLUMNS]
    found = set(zip(table["mass"], table["speed"], strict=True))
    sides = {(0, 4.5), (1, 4.5), (0.5, 0), (0.5, 9)}
    spokes = {(m, s) for m in (0.25, 0.75) for s in (2.25, 6.75)}
    assert {tuple(np.round(place, 6)) for place in found} == sides | spokes


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:4 operating points determine")
@pytest.mark.filterwarnings("ignore:3 operating points determine")
@pytest.mark.filterwarnings("ignore:the scheduling variables .* move together")
def test_points_on_a_line_have_one_neighbour_on_each_side():
    table = suggest_operating_point(plane([(0, 0), (2, 2), (3, 3), (1, 1)]))
    assert_allclose(sorted(table["mass"]), [0.5, 1.5, 2.5], atol=1e-9)
    assert_allclose(table["mass"], table["speed"], atol=1e-9)


def test_without_a_structure():
    X, y = spring_tables(n_samples=300)
    pipeline = LocalLPVPipeline(
        scheduling="kappa", experiment="run", time="time", restructurer="aligned"
    ).fit(X, y)
    table = suggest_operating_point(pipeline)
    assert len(table) == 3 and table["noise"].isna().all()
    assert np.isfinite(table["uncertainty"]).all()


def test_what_has_no_middle_is_refused(fitted):
    with pytest.warns(UserWarning, match="at one operating point"):
        alone = fitted(kappas=(0.5,))
    with pytest.raises(ValueError, match="between operating points and needs two"):
        suggest_operating_point(alone)
    with pytest.raises(NotFittedError):
        suggest_operating_point(spring_pipeline())
    with pytest.raises(
        ValueError, match="`pipeline` must be a fitted LocalLPVPipeline"
    ):
        suggest_operating_point(3)
    with pytest.raises(ValueError, match="`criterion` must be"):
        suggest_operating_point(spring_pipeline(), criterion="gap")
