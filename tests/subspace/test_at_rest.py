"""Experiments that begin at a stand, as step tests do."""

import warnings

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI, load, save


def step_test(seed, first=0.0, level=20.0, n=240, at=25, noise=0.01, decay=0.0):
    """Two lags in series, a step by 30; what an unknown state leaves decays slowly."""
    rng, gain = np.random.default_rng(seed), 0.5 + 0.3 * (seed % 4)
    u = np.full((n, 1), first)
    u[at:] += 30.0
    step = lfilter([0.0, 0.15], [1.0, -0.85], u - first, axis=0)
    y = level + gain * lfilter([0.0, 0.03], [1.0, -0.97], step, axis=0)
    y += decay * 0.99 ** np.arange(n)[:, None]
    return u, y + noise * 30.0 * gain * rng.standard_normal(y.shape), gain


@pytest.mark.slow
@pytest.mark.parametrize("order", ["auto", 2])
@pytest.mark.parametrize("first", [0.0, 30.0])
def test_step_tests_tell_the_static_gain(first, order):
    """Free states and a constant would balance each other until the step comes."""
    errors = []
    for seed in range(2):
        u, y, gain = step_test(seed, first)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            model = SubspaceLTI(order).fit(u, y)
        errors.append(model.lti_.dc_gain().item() / gain - 1.0)
        assert model.offset_ == "constant" and model.steady_start_
        assert not model.initial_states_.any()
        np.testing.assert_array_equal(model.input_offset_, [[first]])
        np.testing.assert_allclose(model.output_offset_, 20.0, atol=0.2 * gain)
        assert model.score(u, y) > 0.99
    assert np.median(np.abs(errors)) < 0.02 and np.max(np.abs(errors)) < 0.1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # of states that noise has
@pytest.mark.parametrize("seed", range(2))
def test_rest_that_is_said_may_be_where_inputs_go_on_slowly(seed):
    """A zone that is heated, and the temperature outdoors."""
    rng = np.random.default_rng(seed)
    heat = np.repeat(rng.choice([20.0, 60.0], 20), 20)
    heat[:20] = 60.0
    outdoors = 20.0 + 5.0 * np.sin(2 * np.pi * np.arange(400) / 400)
    u = np.column_stack([heat, outdoors])
    y = 21.0 + lfilter([0.0, 0.003], [1.0, -0.97], heat - heat[0])
    y += lfilter([0.0, 0.01], [1.0, -0.98], outdoors - outdoors[0])
    noisy = y + 0.03 * rng.standard_normal(400)
    model = SubspaceLTI(initial_state="rest").fit(u, noisy)
    np.testing.assert_array_equal(model.input_offset_, [[60.0, 20.0]])
    left = model.predict(u) - y
    assert np.linalg.norm(left) < 0.05 * np.linalg.norm(y - y.mean())


def test_a_level_of_zero_is_no_constant():
    u, y, gain = step_test(1, level=0.0)
    model = SubspaceLTI().fit(u, y)
    assert model.offset_ is None
    np.testing.assert_allclose(model.lti_.dc_gain(), gain, rtol=0.05)


@pytest.mark.slow
def test_records_in_mid_motion_do_not_begin_at_rest():
    """Their inputs stand still, their outputs move on."""
    for seed in range(2):
        u, y, _ = step_test(seed, n=600, noise=0.003, decay=20.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            assert SubspaceLTI().fit(u, y).initial_states_.any()


@pytest.mark.slow
def test_a_logger_that_begins_soon_before_the_step_is_none_the_worse():
    for seed in range(2):
        u, y, gain = step_test(seed, at=3)
        model = SubspaceLTI().fit(u, y)
        np.testing.assert_allclose(model.lti_.dc_gain(), gain, rtol=0.1)


@pytest.mark.parametrize("offset", [None, "linear"])
def test_what_is_said_of_offsets_is_kept_where_records_begin_at_a_stand(offset):
    u, y, _ = step_test(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert SubspaceLTI(2, offset=offset).fit(u, y).offset_ == offset


def test_the_order_of_records_that_begin_at_rest_is_that_of_the_plant():
    """What follows a part held out begins in mid-motion, though."""
    for rng in map(np.random.default_rng, range(3)):
        u = np.repeat(rng.uniform(0.0, 100.0, 6), 50)[:, None]
        u[:10] = 0.0
        y = lfilter([0.0, 0.15], [1.0, -0.85], u, axis=0)
        y = lfilter([0.0, 0.004], [1.0, -0.985], y, axis=0)
        y += 0.003 * y.std() * rng.standard_normal(y.shape)
        model = SubspaceLTI(initial_state="rest").fit(u, y)
        assert model.order_ >= 2 and model.score(u, y) > 0.99


# -- a slow plant with dead time behind a coarse sensor -------------------------------


def heater(seed, size=10.0, first=36.0, n=310):
    """Two lags, a dead time, a step by `size`, an output in steps of 1/16."""
    rng = np.random.default_rng(seed)
    gain, dead = rng.uniform(0.3, 0.5), int(rng.integers(5, 15))
    u = np.full((n, 1), first)
    u[9:] += size
    y = np.vstack([np.zeros((dead, 1)), u - first])[:n]
    for pole in np.exp(-1.0 / np.array([rng.uniform(50, 80), rng.uniform(5, 15)])):
        y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y, axis=0)
    y = 35.6 + gain * y + 0.03 * rng.standard_normal(y.shape)
    return u, np.round(16.0 * y) / 16.0, gain


HEATERS = [heater(seed, size) for seed, size in enumerate([5.0, 10.0])]


def gains(heaters=HEATERS, **options):
    """Static gains by the true ones."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        models = [SubspaceLTI(**options).fit(u, y) for u, y, _ in heaters]
    assert all(model.steady_start_ for model in models)
    found = [model.lti_.dc_gain().item() for model in models]
    return np.array(found) / [gain for *_, gain in heaters]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"order": 2}, {"order": 3}])
def test_states_of_a_dead_time_take_nothing_of_the_gain(options):
    """Free ones stand for a level of any size, with and without a constant."""
    np.testing.assert_allclose(gains(**options), 1.0, atol=0.1)


@pytest.mark.slow
def test_rest_that_is_said_is_at_the_first_inputs():
    """Where that is likelier than at rest at zero with a step of 36 before."""
    options = {"initial_state": "rest", "feedthrough": False}
    np.testing.assert_allclose(gains(order=2, **options), 1.0, atol=0.1)
    u, y, _ = HEATERS[0]
    model = SubspaceLTI(2, **options).fit(u, y)
    np.testing.assert_array_equal(model.input_offset_, [[36.0]])
    assert model.score(u, y) > 0.98
    each = SubspaceLTI(2, experiment=1, **options)
    X = np.column_stack([np.tile(u[:, 0], 2), np.repeat([0, 1], len(u))])
    for one in each.fit_each(X, np.vstack([y, y])):
        np.testing.assert_array_equal(one.input_offset_, [[36.0]])
        np.testing.assert_allclose(one.lti_.poles(), model.lti_.poles(), rtol=0.02)


@pytest.mark.slow
def test_rest_at_zero_is_kept_where_outputs_move_at_once():
    """The first inputs are a step from zero."""
    for rng in map(np.random.default_rng, range(4)):
        u = np.repeat(rng.uniform(2.0, 10.0, (5, 1)), 40, axis=0)
        y = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
        y += 0.01 * rng.standard_normal(y.shape)
        model = SubspaceLTI(initial_state="rest").fit(u, y)
        np.testing.assert_allclose(model.lti_.dc_gain(), 1.0, atol=0.02)
        assert not model.input_offset_.any() and not model.steady_start_


@pytest.mark.broad
@pytest.mark.parametrize("hold", [8, 15, 30])
def test_rest_at_zero_is_kept_while_a_dead_time_hides_the_first_inputs(hold):
    """A step from zero, of which outputs show nothing before the inputs move again."""
    for rng in map(np.random.default_rng, range(3)):
        u = np.repeat([10.0, 25.0, -5.0, 15.0], [hold, 100, 100, 100])[:, None]
        y = np.vstack([np.zeros((20, 1)), u])[: len(u)]
        for pole in (0.9, 0.7):
            y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y, axis=0)
        y += 0.1 * rng.standard_normal(y.shape)
        model = SubspaceLTI(initial_state="rest", input_delay=20).fit(u, y)
        np.testing.assert_allclose(model.lti_.dc_gain(), 1.0, atol=0.01)


def test_every_experiment_says_where_it_rests_whichever_comes_first():
    for order in ([0.0, 10.0, 20.0], [10.0, 0.0, 20.0]):
        X, y = [], []
        for run, first in enumerate(order):
            u, own, _ = step_test(1, first=first)
            X.append(np.column_stack([u, np.full(len(u), run)]))
            y.append(own)
        each = SubspaceLTI(2, initial_state="rest", experiment=1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            models = each.fit_each(np.vstack(X), np.vstack(y))
        assert [model.input_offset_.item() for model in models] == order


@pytest.mark.slow
def test_a_missing_output_takes_nothing_of_the_gain():
    for k, (u, y, gain) in enumerate(HEATERS):
        y = y.copy()
        y[[5, 40][k]] = np.nan
        model = SubspaceLTI(2, feedthrough=False, missing="estimate").fit(u, y)
        np.testing.assert_allclose(model.lti_.dc_gain(), gain, rtol=0.1)


def test_a_gap_that_cuts_off_the_step_is_told():
    u, y, _ = HEATERS[0]
    y = y.copy()
    y[90] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        with pytest.warns(UserWarning, match="in 1 of 2 pieces no input moves.*estim"):
            SubspaceLTI(2, missing="split").fit(u, y)


def test_where_rest_is_far_from_all_outputs_predictions_begin_as_the_fit(tmp_path):
    """A mode that does not decay holds the level, which was not to be a constant."""
    rng = np.random.default_rng(0)
    plant = StateSpace([[0.9]], [[0.01]], [[1.0]], None, 1.0)
    u = np.repeat(rng.choice([-1.0, 1.0], (100, 1)), 6, axis=0)
    y = 4.0 + plant.simulate(u) + 0.001 * rng.standard_normal((600, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of that mode
        model = SubspaceLTI(2, offset=None, sampling_time=1.0).fit(u, y)
    assert np.abs(model.lti_.poles() - 1.0).min() < 1e-3
    fresh = np.repeat(rng.choice([-1.0, 1.0], (30, 1)), 6, axis=0)
    predicted = model.predict(fresh)
    error = predicted - 4.0 - plant.simulate(fresh)
    assert np.abs(error).max() < 0.02 and model.begun_state_ is not None
    save(model, tmp_path / "model.zip")
    same = load(tmp_path / "model.zip").predict(fresh)
    np.testing.assert_array_equal(same, predicted)
    moving = SubspaceLTI(1, offset=None, sampling_time=1.0).fit(u, y - 4.0)
    assert moving.begun_state_ is None


@pytest.mark.parametrize("seed", [1, 2, 6])
def test_short_records_in_motion_are_not_held_where_some_stand_by_chance(seed):
    """Lag and resonance, from anywhere: inputs of a quarter stand at first."""
    rng = np.random.default_rng(seed)
    A = [[-2.8, -17.6, -32.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    system = StateSpace(A, [[1.0], [0.0], [0.0]], [[0.0, 0.0, 40.0]], None)
    system, n_runs = system.to_discrete(0.05), 60
    inputs, outputs = [], []
    for _ in range(n_runs):
        u = np.repeat(rng.choice([-1.0, 1.0], 13), 2)[:25, None]
        x0 = 0.05 * rng.standard_normal(3)
        inputs.append(u)
        outputs.append(system.simulate(u, initial_state=x0))
        outputs[-1] += 0.01 * rng.standard_normal(u.shape)
    X = pd.DataFrame({"u": np.vstack(inputs)[:, 0], "run": np.arange(1500) // 25})
    options = {"horizon": 6, "method": "po-moesp", "refine": "simulation"}
    model = SubspaceLTI(3, experiment="run", offset=None, **options)
    assert not model.fit(X, np.vstack(outputs)).steady_start_


@pytest.mark.slow
@pytest.mark.parametrize(
    "width, pause, level", [(1, 0, 0.0), (1, 2, 5.0), (4, 0, 5.0), (4, 2, 0.0)]
)
def test_records_begin_with_an_impact(width, pause, level):
    """Free states would take its answer, of a resonance that rings for the record."""
    A, B = np.array([[0.97, 0.2], [-0.2, 0.97]]), np.array([[0.0], [1.0]])
    plant = StateSpace(A, B, [[1.0, 0.0]], None, 1.0)
    rng, tables, outputs = np.random.default_rng(width), [], []
    for run in range(3):
        u = np.zeros((200, 1))
        u[pause : pause + width] = rng.uniform(1.0, 2.0, (width, 1))
        y = plant.simulate(u)
        outputs.append(y + 0.02 * y.std() * rng.standard_normal(y.shape))
        tables.append(pd.DataFrame({"run": run, "force": level + u[:, 0]}))
    X, y = pd.concat(tables, ignore_index=True), np.vstack(outputs)
    model = SubspaceLTI(experiment="run", sampling_time=1.0).fit(X, y)
    assert model.order_ == 2 and not model.initial_states_.any()
    assert not model.steady_start_
    omega = np.linspace(0.01, 3.0, 200)
    G, own = (m.frequency_response(omega) for m in (plant, model.lti_))
    assert np.linalg.norm(own - G) < 0.02 * np.linalg.norm(G)


@pytest.mark.filterwarnings("ignore::UserWarning")  # the gain is poorly known
def test_a_record_that_is_cut_within_an_impact_is_in_motion():
    rng = np.random.default_rng(0)
    u = np.zeros((700, 1))
    u[[280, 300, 400, 450, 600]] = [[2.0], [1.0], [-1.0], [-2.0], [1.5]]
    plant = StateSpace(0.95, 1.0, 1.0, None, 1.0)
    y = plant.simulate(u) + 0.01 * rng.standard_normal(u.shape)
    model = SubspaceLTI(1).fit(u[300:], y[300:])
    assert model.initial_states_.any()
    assert abs(model.lti_.poles().real.item() - 0.95) < 0.01


@pytest.mark.parametrize("seed", range(2))
def test_a_step_after_one_sample_is_no_impact(seed):
    """As likely as an impact, but only with a feedthrough that answers it."""
    u = np.full((150, 1), 3.0)
    u[0] += 1.5
    plant = StateSpace(0.93, 1.0, 1.0, None, 1.0)
    y = plant.simulate(u - u[0]) + plant.dc_gain() * u[0]
    y += 0.01 * np.random.default_rng(seed).standard_normal(y.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = SubspaceLTI(1, sampling_time=1.0).fit(u, y)
    assert abs(model.lti_.dc_gain() / plant.dc_gain() - 1.0) < 0.02


def doublet(seed, n, lead, step=0.02):
    """A pitch doublet (3-2-1-1) of a plane, whose phugoid takes longer than that."""
    rng = np.random.default_rng(seed)
    plane = StateSpace(
        [[-0.02, 0.04, 0, -9.81], [-0.06, -0.9, 60, 0], [0.001, -0.08, -1.2, 0]]
        + [[0, 0, 1, 0]],
        [[0], [-8], [-6], [0]],
        [[0, 1 / 60, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    ).to_discrete(step)
    stick = np.repeat([0, 1, -1, 1, -1, 0], [lead, 150, 100, 50, 50, n - lead - 350])
    u = stick[:, None].astype(float)
    y = plane.simulate(u)
    return plane, u, y + 0.03 * y.std(axis=0) * rng.standard_normal(y.shape)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "n", "lead"), [(7, 800, 200), (9, 700, 150), (7, 1500, 50)]
)
def test_a_mode_longer_than_the_record_begins_at_rest_and_is_no_drift(seed, n, lead):
    plane, u, y = doublet(seed, n, lead)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = SubspaceLTI(sampling_time=0.02).fit(u, y)
    assert model.order_ == 4 and model.offset_ is None
    assert not model.initial_states_.any()
    rng = np.random.default_rng(0)
    other = rng.choice([-1.0, 1.0], (30, 1)).repeat(50, axis=0)
    truth = plane.simulate(other)
    error = np.linalg.norm(model.predict(other) - truth, axis=0)
    assert (error < 0.15 * np.linalg.norm(truth - truth.mean(axis=0), axis=0)).all()


def test_a_slow_mode_in_motion_is_not_taken_for_rest():
    rng = np.random.default_rng(1)
    before = 5.0 * rng.standard_normal(300)
    u = np.r_[np.zeros(60), rng.choice([-1.0, 1.0], 26).repeat(25)]
    y = lfilter([0.0, 0.1], np.poly([0.9, 0.9995]), np.r_[before, u])[300:]
    y += 0.03 * y.std() * rng.standard_normal(len(y))
    model = SubspaceLTI(2, offset=None).fit(u[:, None], y)
    assert model.initial_states_.any()


@pytest.mark.parametrize("n_first", [0, 8, 20])
def test_a_level_that_is_left_for_good_is_one_to_stand_at(n_first):
    """However short the stand: a binary sequence is held as long later, by chance."""
    rng = np.random.default_rng(n_first)
    u = 3.0 + 2.0 * np.repeat(rng.choice([-1.0, 1.0], 60), 8)[:, None]
    u[:n_first] = 2.0  # not the mean, about which models rest
    true = StateSpace(0.97, 0.03, 1.0, None, 1.0)
    y = 7.0 + true.simulate(u - 2.0)
    y += 0.01 * rng.standard_normal(y.shape)
    model = SubspaceLTI(1).fit(u, y)
    assert model.steady_start_ == (n_first > 0)
    if n_first:
        assert model.score(u, y) > 0.985
