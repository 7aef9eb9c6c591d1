"""Missing outputs, estimated by the model that they are missing for."""

import copy
import warnings
from contextlib import nullcontext

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
)
from lpvlearn.data.experiments import Experiment
from lpvlearn.subspace.missing_outputs import further, with_estimates
from tests.conftest import ROLES, spring_structure, spring_tables

OMEGA = np.linspace(0.01, 3.1, 100)


def system(rng, n_outputs=2):
    modes = [(0.9, 0.4), (0.8, 1.5)]
    blocks = [
        r * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
        for r, w in modes
    ]
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = blocks
    B, C = rng.standard_normal((4, 1)), rng.standard_normal((n_outputs, 4))
    return StateSpace(A, B, C, None, 1.0)


def record(seed, n_samples=1200, *, noise=0.1, colour=0.0, n_outputs=2):
    """A system, inputs and outputs."""
    rng = np.random.default_rng(seed)
    true = system(rng, n_outputs)
    u = rng.standard_normal((n_samples, 1))
    y = true.simulate(u)
    e = lfilter(
        [np.sqrt(1 - colour**2)], [1.0, -colour], rng.standard_normal(y.shape).T
    )
    return true, u, y + noise * y.std(axis=0) * e.T


def without(y, share, seed=0):
    """Outputs of which single values are missing."""
    out = y.copy()
    out[np.random.default_rng(seed).random(y.shape) < share] = np.nan
    return out


def distance(model, true):
    found, wanted = (m.frequency_response(OMEGA) for m in (model.lti_, true))
    return np.linalg.norm(found - wanted) / np.linalg.norm(wanted)


def test_complete_records_are_fitted_as_ever():
    _, u, y = record(0, 400)
    plain, other = (SubspaceLTI(missing=m).fit(u, y) for m in ("raise", "estimate"))
    assert np.array_equal(plain.lti_.A, other.lti_.A)


@pytest.mark.slow
def test_without_noise_the_system_is_found():
    true, u, y = record(1, 600, noise=0.0)
    model = SubspaceLTI(4, horizon=8, missing="estimate").fit(u, without(y, 0.2))
    assert distance(model, true) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_a_third_of_the_outputs_is_hardly_missed(colour):
    true, u, y = record(0, colour=colour)
    whole = SubspaceLTI().fit(u, y)
    model = SubspaceLTI(missing="estimate").fit(u, without(y, 0.3))
    assert model.order_ == 4
    assert distance(model, true) < 2.0 * distance(whole, true)


def test_least_squares_of_the_known_errors():
    """Where noise is taken for white: no other parameters make less of these."""
    _, u, y = record(3, 500)
    gappy = without(y, 0.3)
    options = {"horizon": 8, "refine": "simulation", "missing": "estimate"}
    model = SubspaceLTI(4, **options).fit(u, gappy)

    other = copy.deepcopy(model)

    def squares(lti):
        other.lti_ = lti
        left = gappy - other.predict_with_initial_state(u, gappy)
        return np.nansum(left**2)

    least = squares(model.lti_)
    for pair in model.deviated_models()[:6]:
        # a hundredth of a standard deviation moves the squares by next to nothing
        slope = squares(pair[0]) - squares(pair[1])
        assert abs(slope) < 1e-3 * least


def test_deviations_know_what_is_missing():
    _, u, y = record(4, 4000, n_outputs=1)
    whole = SubspaceLTI(4, horizon=8).fit(u, y)
    half = SubspaceLTI(4, horizon=8, missing="estimate").fit(u, without(y, 0.5))
    wanted = np.sqrt(2.0) * whole.frequency_response_std(OMEGA).real
    ratio = half.frequency_response_std(OMEGA).real / wanted
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kept", ["all every fifth", "one every fifth", "none for long"]
)
def test_outputs_that_come_in_a_rhythm_or_stay_away(kept):
    true, u, y = record(5, 1500)
    rows, column = np.arange(1500) % 5 != 0, slice(None)
    if kept == "none for long":
        rows = slice(400, 700)
    elif kept == "one every fifth":
        column = 1
    gappy = y.copy()
    gappy[rows, column] = np.nan
    rare = pytest.warns(UserWarning, match="is missing in 80 %")
    with nullcontext() if kept == "none for long" else rare:
        model = SubspaceLTI(4, missing="estimate").fit(u, gappy)
    assert distance(model, true) < 0.03


@pytest.mark.slow
def test_inputs_and_outputs_missing_with_delay_and_offset():
    true, u, y = record(6, 1500)
    late = np.vstack([np.zeros((3, 1)), u[:-3]])
    gappy = without(true.simulate(late) + y - true.simulate(u) + 7.0, 0.1)
    some = u.copy()
    some[700:705] = np.nan
    model = SubspaceLTI(4, missing="estimate", input_delay="auto").fit(some, gappy)
    assert model.input_delay_.tolist() == [3]
    assert model.offset_ == "constant"
    levels = model.output_offset_ - model.input_offset_ @ model.lti_.dc_gain().T
    np.testing.assert_allclose(levels, 7.0, atol=0.1)
    assert distance(model, true.with_input_delay(3)) < 0.03


@pytest.mark.slow
def test_a_plant_in_a_loop():
    rng = np.random.default_rng(0)
    plant = StateSpace([[1.2, -0.5], [1.0, 0.0]], [[1.0], [0.0]], [[0.5, 0.3]], None, 1)
    x, v, rows = np.zeros(2), 0.0, []
    for r, e in rng.standard_normal((2000, 2)):
        v = 0.8 * v + 0.2 * e
        y = float((plant.C @ x)[0]) + v
        u = r - 0.6 * y
        rows.append((u, y))
        x = plant.A @ x + plant.B[:, 0] * u
    u, y = np.array(rows).T[:, :, None]
    with pytest.warns(UserWarning, match="know the noise"):
        model = SubspaceLTI(missing="estimate").fit(u, without(y, 0.2))
    assert model.method_ == "pbsid"
    assert distance(model, plant) < 0.05


@pytest.mark.slow
def test_residuals_of_gappy_records_are_tested():
    _, u, y = record(7)
    gappy = without(y, 0.2)
    model = SubspaceLTI(4, missing="estimate").fit(u, gappy)
    assert model.residual_tests(u, gappy)["passed"].all()
    low = SubspaceLTI(2, missing="estimate")
    with pytest.warns(UserWarning, match="depends on past inputs"):
        low.fit(u, gappy)
    tests = low.residual_tests(u, gappy)
    assert not tests.loc[tests["test"] == "past inputs", "passed"].any()


@pytest.mark.slow
def test_a_chain_of_local_models():
    X, y = spring_tables(noise=1e-2, n_samples=400)
    local = SubspaceLTI(2, horizon=10, missing="estimate")
    steps = GrayBoxRestructurer(spring_structure()), PolynomialLPV(2)
    whole = LocalLPVPipeline(local, *steps, **ROLES).fit(X, y)
    gappy = y.mask(np.random.default_rng(0).random(y.shape) < 0.2)
    model = LocalLPVPipeline(local, *steps, **ROLES).fit(X, gappy)
    np.testing.assert_allclose(model.parameters_, whole.parameters_, rtol=0.05)
    with pytest.warns(UserWarning, match="values of the outputs are missing"):
        assert model.score(X, gappy) > 0.98


def test_a_record_cut_to_pieces_is_told():
    _, u, y = record(8, 600)
    with pytest.warns(UserWarning, match="missing='estimate'"):
        SubspaceLTI(4, horizon=5, missing="split").fit(u, without(y, 0.05))


@pytest.mark.parametrize(
    ("options", "u_missing", "message"),
    [
        (
            {"detrend": "constant"},
            False,
            "`detrend` must be None with missing='estimate",
        ),
        ({"integrating": True}, False, "`missing` must be 'raise' or 'split' with"),
        ({"initial_state": "rest"}, True, "`initial_state` must be 'estimate' where"),
    ],
)
def test_what_does_not_go_together(options, u_missing, message):
    _, u, y = record(9, 200)
    if u_missing:
        u[50] = np.nan
    with pytest.raises(ValueError, match=message):
        SubspaceLTI(2, horizon=6, missing="estimate", **options).fit(u, without(y, 0.1))


def test_batches_and_series_of_fits_do_not_estimate():
    _, u, y = record(9, 200)
    model = SubspaceLTI(2, horizon=6, missing="estimate")
    for method in (model.partial_fit, model.fit_each):
        with pytest.raises(ValueError, match="`missing` must be 'raise' or 'split'"):
            method(u, without(y, 0.1))


def test_an_output_that_is_never_there():
    _, u, y = record(9, 200)
    y[:, 1] = np.nan
    with pytest.raises(ValueError, match="some samples of every output"):
        SubspaceLTI(2, horizon=6, missing="estimate").fit(u, y)


@pytest.mark.broad
@pytest.mark.parametrize("n_lost", [20, 300, 700])
@pytest.mark.parametrize("outputs", ["one", "all"])
def test_outputs_that_begin_late(n_lost, outputs):
    """What fast modes were at the first sample is not asked of much later ones."""
    true, u, y = record(10, 1500)
    y[:n_lost, : 1 if outputs == "one" else 2] = np.nan
    model = SubspaceLTI(4, horizon=8, missing="estimate").fit(u, y)
    assert distance(model, true) < 0.03


def test_units_of_outputs_do_not_matter():
    _, u, y = record(11, 500)
    gappy, units = without(y, 0.2), np.array([1e-9, 1e9])
    models = [
        SubspaceLTI(4, horizon=8, missing="estimate").fit(u, z)
        for z in (gappy, gappy * units)
    ]
    plain, other = (m.lti_.frequency_response(OMEGA) for m in models)
    np.testing.assert_allclose(other, plain * units[:, None], rtol=1e-2)


def test_rows_that_are_lost_leave_nothing_to_estimate():
    _, u, y = record(12, 400)
    X = np.column_stack([u, np.arange(400.0)])
    kept = np.ones(400, bool)
    kept[[100, 250]] = False
    models = [
        SubspaceLTI(4, horizon=8, time=1, missing=m).fit(X[kept], y[kept])
        for m in ("split", "estimate")
    ]
    np.testing.assert_allclose(*(m.lti_.poles() for m in models), rtol=1e-9)


@pytest.mark.slow
def test_the_predictor_is_that_of_the_noise():
    _, u, y = record(13, 3000, noise=0.3, colour=0.9)
    whole = SubspaceLTI(4, horizon=8).fit(u, y)
    model = SubspaceLTI(4, horizon=8, missing="estimate").fit(u, without(y, 0.3))
    errors = [np.std(y - m.predict_ahead(u, y), axis=0) for m in (whole, model)]
    np.testing.assert_allclose(*errors, rtol=0.05)
    claimed = np.sqrt(np.diagonal(model.predictor_.covariance))
    np.testing.assert_allclose(claimed, errors[0], rtol=0.1)
    assert model.residual_ == pytest.approx(whole.residual_, rel=0.1)


def test_another_table_is_not_that_of_the_fit():
    _, u, y = record(14, 400)
    late = y.copy()
    late[:60] = np.nan
    model = SubspaceLTI(4, horizon=8, missing="estimate").fit(u, late)
    for table, own in ((late, True), (y[::-1], False)):
        found = model._residuals(u, table, "simulation").fitted
        assert (found is not None) == own


@pytest.mark.parametrize("columns", [0, 1, 3])
def test_residuals_need_the_outputs_of_the_model(columns):
    _, u, y = record(14, 400)
    model = SubspaceLTI(4, horizon=8, missing="estimate").fit(u, without(y, 0.1))
    other = np.full((400, columns), 1.0) if columns else None
    expected = "2 output|measured outputs. Got None"
    with pytest.raises(ValueError, match=f"`y` must hold the ({expected})"):
        model.residual_tests(u, other)


def test_nothing_is_left_after_a_delay():
    _, u, y = record(14, 100)
    y[6:, 0] = np.nan
    rare = pytest.warns(UserWarning, match="is missing in 94 %")
    with pytest.raises(ValueError, match="come with their delay"), rare:
        SubspaceLTI(1, horizon=3, missing="estimate", input_delay=6).fit(u, y)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "every"), [(1, 2), (2, 4)])
def test_the_order_of_outputs_that_come_seldom_is_that_of_what_is_there(seed, every):
    """Completed samples ask for states of their own, and look like a loop."""
    rng = np.random.default_rng(seed)
    A = 0.97 * np.array([[0.9, 0.3], [-0.3, 0.9]])
    plant = StateSpace(A, rng.normal(size=(2, 1)), rng.normal(size=(1, 2)))
    plant = StateSpace(plant.A, plant.B, plant.C, sampling_time=0.1)
    u = np.repeat(rng.choice([-1.0, 1.0], 200), 6)[:, None]
    y = plant.simulate(u)
    y = y + 0.03 * y.std() * rng.normal(size=y.shape)
    y[np.arange(len(y)) % every > 0] = np.nan
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is missing in")
        found = SubspaceLTI(missing="estimate", sampling_time=0.1).fit(u, y)
    assert found.order_ == 2
    assert (found.lti_ - plant).hinf_norm() < 0.01 * plant.hinf_norm()


def test_rounds_that_go_one_way_are_taken_to_their_end():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(30, 2))
    run = Experiment("a", np.arange(30), y, np.where(y > 0.5, np.nan, y))
    away = np.where(y > 0.5, rng.normal(size=y.shape), 0.0)
    rounds = [[with_estimates(run, y + 0.9**k * away)] for k in range(3)]
    (end,) = further([run], rounds)
    np.testing.assert_allclose(end.outputs, y, atol=1e-12)
    (still,) = further([run], [rounds[0]] * 3)
    np.testing.assert_array_equal(still.outputs, rounds[0][0].outputs)
