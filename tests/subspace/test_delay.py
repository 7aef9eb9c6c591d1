"""Input delays: given, found, and from batch to batch."""

import re
import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.data.experiments import Experiment
from lpvlearn.models.innovation import InnovationModel, NoiseModel
from lpvlearn.subspace.fits import delay as delays
from lpvlearn.subspace.fits.delay import find_delays, first_answers, late_inputs
from lpvlearn.subspace.fits.options import Choices

from ..conftest import stable_model

DELAY = [4, 1]


def late_record(n_samples=300, seed=0, noise=0.0, delay=DELAY):
    rng = np.random.default_rng(seed)
    model = stable_model(3, 3, sampling_time=1.0, feedthrough=True)
    u = rng.normal(size=(n_samples, 2))
    y = model.with_input_delay(delay).simulate(u)
    return model, u, y + noise * y.std(axis=0) * rng.normal(size=y.shape)


def estimator(**options):
    return SubspaceLTI(3, **{"horizon": 6, "input_delay": DELAY, **options})


@pytest.mark.parametrize("initial_state", ["estimate", "rest"])
def test_a_given_delay_is_a_fit_of_late_inputs(initial_state):
    model, u, y = late_record(noise=0.1)
    found = estimator(initial_state=initial_state).fit(u, y)
    late = np.zeros_like(u)
    for j, d in enumerate(DELAY):
        late[d:, j] = u[: len(u) - d, j]
    start = 4 if initial_state == "estimate" else 0
    plain = SubspaceLTI(3, horizon=6, initial_state=initial_state)
    plain.fit(late[start:], y[start:])
    np.testing.assert_array_equal(found.lti_.A, plain.lti_.A)
    np.testing.assert_array_equal(found.initial_states_, plain.initial_states_)
    np.testing.assert_array_equal(found.poles_std_, plain.poles_std_)
    np.testing.assert_array_equal(found.input_delay_, DELAY)
    np.testing.assert_allclose(found.predict(u), plain.predict(late), atol=1e-12)
    # the phase of a delay is known: it turns the uncertainty of the response only
    omega = np.array([0.1, 1.0, 3.0])
    total = [
        np.trace(one.frequency_response_covariance(omega), axis1=1, axis2=2)
        for one in (found, plain)
    ]
    np.testing.assert_allclose(*total)


@pytest.mark.parametrize("initial_state", ["estimate", "rest"])
def test_late_systems_are_found_exactly(initial_state):
    model, u, y = late_record()
    found = estimator(initial_state=initial_state).fit(u, y)
    omega = np.linspace(0, np.pi, 20)
    np.testing.assert_allclose(
        found.lti_.frequency_response(omega),
        model.with_input_delay(DELAY).frequency_response(omega),
        atol=1e-9,
    )
    np.testing.assert_allclose(found.predict(u), y, atol=1e-9)
    for predict in (found.predict_with_initial_state, found.predict_ahead):
        np.testing.assert_allclose(predict(u[100:], y[100:]), y[100:], atol=1e-9)


@pytest.mark.parametrize("initial_state", ["estimate", "rest"])
@pytest.mark.parametrize("first", [1, 7])
def test_batches_make_the_model_of_the_table(initial_state, first):
    _, u, y = late_record(noise=0.1)
    whole = estimator(initial_state=initial_state).fit(u, y)
    stream = estimator(initial_state=initial_state)
    cuts = [0, *range(first, 6 * first, first), 120, 300]
    for start, stop in zip(cuts[:-1], cuts[1:], strict=True):
        stream.partial_fit(u[start:stop], y[start:stop])
    np.testing.assert_array_equal(stream.lti_.A, whole.lti_.A)
    np.testing.assert_array_equal(stream.lti_.input_delay, DELAY)


def test_inputs_before_a_gap_of_the_outputs_are_known():
    _, u, y = late_record()
    y[150:152] = np.nan
    found = estimator(missing="split").fit(u, y)
    assert found.residual_ < 1e-9
    # 4 samples are lost at the start, none after the gap
    assert sum(record.n_samples for record in found._evidence.records) == 300 - 4 - 2
    stream = estimator(missing="split")
    for start in range(0, 300, 60):
        stream.partial_fit(u[start : start + 60], y[start : start + 60])
    np.testing.assert_array_equal(stream.lti_.A, found.lti_.A)


def test_an_experiment_goes_on_with_the_inputs_in_transit():
    u = np.arange(12.0).reshape(6, 2)
    whole, _ = late_inputs(Experiment(0, np.arange(6), u), np.array([2, 0]), rest=False)
    np.testing.assert_array_equal(whole.inputs[:, 0], [np.nan, np.nan, 0, 2, 4, 6])
    np.testing.assert_array_equal(whole.inputs[:, 1], u[:, 1])
    before, parts = None, []
    for rows in (slice(0, 1), slice(1, 4), slice(4, 6)):
        e = Experiment(0, np.arange(6)[rows], u[rows])
        late, before = late_inputs(e, np.array([2, 0]), rest=False, before=before)
        parts.append(late.inputs)
    np.testing.assert_array_equal(np.vstack(parts), whole.inputs)


def test_prediction_begins_with_the_inputs_in_transit():
    """Without states of the noise it is the simulation from the same start."""
    _, u, y = late_record(600, noise=0.05)
    model = estimator(n_noise_states=0).fit(u, y)
    u, y = u[37:], y[37:]
    np.testing.assert_allclose(
        model.predict_ahead(u, y), model.predict_with_initial_state(u, y)
    )


@pytest.mark.slow
def test_residuals_tell_of_a_delay_that_is_missing():
    _, u, y = late_record(600, noise=0.05)
    tests = estimator().fit(u, y).residual_tests(u, y, n_lags=10)
    assert tests["passed"].all()
    wrong = estimator(input_delay=0, horizon=10)
    with (
        pytest.warns(UserWarning, match="the outputs show input 1 only after 4"),
        pytest.warns(UserWarning, match="lacks states, a delay"),
    ):
        wrong.fit(u, y)
    tests = wrong.residual_tests(u, y, n_lags=10).set_index("test")
    assert not tests.loc["past inputs", "passed"].all()


# -- with offsets, trends and gaps -----------------------------------------------


def offset_tables(noise=0.02, holes=True):
    """Two experiments about points of their own, each at rest there before it."""
    rng = np.random.default_rng(8)
    model = stable_model(3, 3, sampling_time=1.0, feedthrough=True)
    late, u0 = model.with_input_delay(DELAY), [[3.0, -2.0], [-1.0, 40.0]]
    constants = np.array([[50.0, -8.0], [-20.0, 3.0]])
    du = rng.normal(size=(2, 300, 2))
    y = np.array([late.simulate(v) for v in du])
    y += noise * y.std(axis=(0, 1)) * rng.normal(size=y.shape)
    y += (u0 @ model.dc_gain().T + constants)[:, None]
    u = du + np.array(u0)[:, None]
    if holes:
        y[0, 150:152] = y[1, 200, 0] = np.nan
    table = np.column_stack([u.reshape(600, 2), np.repeat([0, 1], 300)])
    return late, table, y.reshape(600, 2), constants


@pytest.mark.parametrize("input_delay", [DELAY, "auto"])
def test_late_inputs_offsets_and_gaps_together(input_delay):
    late, X, y, constants = offset_tables()
    found = SubspaceLTI(
        3, horizon=6, input_delay=input_delay, missing="split", experiment=2
    ).fit(X, y)
    np.testing.assert_array_equal(found.input_delay_, DELAY)
    assert found.offset_ == "constant"
    omega, exact = np.linspace(0.0, np.pi, 20), late.frequency_response
    error = found.lti_.frequency_response(omega) - exact(omega)
    assert (np.abs(error) < 5.0 * np.abs(found.frequency_response_std(omega))).all()
    # at the mean inputs the outputs are known as well as a mean of 96 samples is
    rest = constants[[0, 0, 1, 1]] + found.input_offset_ @ late.dc_gain().T
    noise = 0.02 * np.nanstd(y[:300], axis=0)
    bound = 5.0 * noise / np.sqrt(96.0)
    np.testing.assert_array_less(np.abs(found.output_offset_ - rest), bound + 0 * rest)
    assert found.residual_tests(X, y, n_lags=10)["passed"].all()
    known = ~np.isnan(y)
    for predict in (found.predict_with_initial_state, found.predict_ahead):
        z = predict(X, y)
        assert np.isfinite(z).all()  # missing outputs cut nothing there
        error = (z - y)[known.all(axis=1)]
        np.testing.assert_array_less(error.std(axis=0), 1.2 * noise)


def test_without_noise_all_own_unknowns_are_exact():
    """States, inputs in transit and constants; y does not depend on the others."""
    late, X, y, _ = offset_tables(noise=0.0)
    found = SubspaceLTI(
        3, horizon=6, input_delay=DELAY, missing="split", experiment=2
    ).fit(X, y)
    omega = np.linspace(0.0, np.pi, 20)
    np.testing.assert_allclose(
        found.lti_.frequency_response(omega),
        late.frequency_response(omega),
        atol=1e-8,
    )
    known = ~np.isnan(y)
    for start in (0, 37):  # in mid-motion, with inputs in transit
        rows = slice(start, None)
        for predict in (found.predict_with_initial_state, found.predict_ahead):
            z = predict(X[rows], y[rows])
            np.testing.assert_allclose(z[known[rows]], y[rows][known[rows]], atol=1e-7)


@pytest.mark.parametrize("lost", [[], [20, 21, 90]])
def test_a_predictor_with_a_gain_estimates_what_is_in_transit(lost):
    """All states and inputs in transit, of time-varying gains where outputs miss."""
    rng = np.random.default_rng(2)
    lti = stable_model(3, 3, sampling_time=1.0, feedthrough=True)
    lti = lti.with_input_delay(DELAY)
    noise = NoiseModel(
        0.8 * np.eye(1), np.ones((2, 1)), np.full((1, 2), 0.2), np.eye(2)
    )
    model = InnovationModel(lti, noise, 0.1 * rng.normal(size=(3, 2)))
    u, own = rng.normal(size=(100, 2)), rng.normal(size=4 + sum(DELAY) + 2)
    x0, level = own[:-2], own[-2:]
    y = lti.simulate(u, initial_state=np.delete(x0, 3))
    y += x0[3] * 0.8 ** np.arange(100.0)[:, None]
    assert np.abs(model.predict(u, y, initial_state=x0) - y).max() < 1e-12
    z = y + level
    z[lost] = np.nan
    found = model.estimate_initial_state(u, z, np.ones((1, 100)))
    np.testing.assert_allclose(found, own, atol=1e-8)


def test_from_rest_the_input_before_is_the_offset():
    _, X, y, _ = offset_tables(noise=0.0, holes=False)
    found = SubspaceLTI(3, horizon=6, input_delay=DELAY).fit(X[:300, :2], y[:300])
    still = np.broadcast_to(found.input_offset_[0], (10, 2))
    rest = np.broadcast_to(found.output_offset_[0], (10, 2))
    np.testing.assert_allclose(found.predict(still), rest, atol=1e-7)


def test_rest_at_the_mean_is_that_of_the_inputs_before():
    """Detrended, an experiment from rest is the same wherever its inputs stand."""
    _, u, y = late_record(noise=0.05)
    plain, moved = (
        estimator(initial_state="rest", detrend="constant").fit(u + level, y + level[0])
        for level in (np.zeros(2), np.array([30.0, -4.0]))
    )
    np.testing.assert_allclose(moved.lti_.poles(), plain.lti_.poles(), atol=1e-6)
    expected = plain.predict(u) + 30.0
    np.testing.assert_allclose(
        moved.predict(u + [30.0, -4.0]), expected, atol=1e-5 * y.std()
    )


def test_holes_in_time_end_what_is_known_of_the_inputs():
    _, u, y = late_record()
    rows = np.r_[0:120, 123:300]
    table = np.column_stack([u, np.arange(300.0)])[rows]
    options = {"missing": "split", "time": 2, "offset": None}
    found = estimator(**options).fit(table, y[rows])
    assert found.residual_ < 1e-9
    # 4 samples are lost at the start, and after the hole
    assert sum(record.n_samples for record in found._evidence.records) == 297 - 8
    np.testing.assert_allclose(
        found.predict_with_initial_state(table, y[rows]), y[rows], atol=1e-9
    )
    for first in (60, 120, 200):  # before, at and after the hole
        stream = estimator(**options)
        for start, stop in ((0, first), (first, 297)):
            stream.partial_fit(table[start:stop], y[rows][start:stop])
        np.testing.assert_array_equal(stream.lti_.A, found.lti_.A)


# -- found -----------------------------------------------------------------------


def resonance(rng, direct):
    """A sampled system of order 2 that answers clearly from the start."""
    pole = rng.uniform(0.6, 0.95) * np.exp(1j * rng.uniform(0.3, 1.5))
    A = [[pole.real, pole.imag], [-pole.imag, pole.real]]
    C = [[1.0, rng.uniform(-1, 1)]]
    return StateSpace(A, [[1.0], [0.5]], C, [[-1.0 * direct]], 1.0)


def excitation(rng, kind, n_samples):
    if kind == "held":
        return rng.choice([-1.0, 1.0], size=(n_samples // 4, 1)).repeat(4, axis=0)
    white = rng.normal(size=(n_samples, 1))
    return white if kind == "white" else lfilter([1], [1, -0.8], white, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("kind", ["white", "held", "coloured"])
def test_delays_are_found_and_none_is_imagined(kind, direct):
    rng = np.random.default_rng(11)
    for delay in (0, 0, 1, 7, 20):
        model = resonance(rng, direct).with_input_delay(delay)
        u = excitation(rng, kind, 600)
        y = model.simulate(u)
        y += 0.05 * y.std() * rng.normal(size=y.shape)
        settings = Choices(order=2).settings(1, 1, np.eye(1))
        found = find_delays([(u, y)], settings, 2, None)
        np.testing.assert_array_equal(found, [delay])


@pytest.mark.broad
@pytest.mark.parametrize("delay", [30, 31, 60])
def test_long_delays_are_looked_for_where_no_input_answers_before(delay):
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-1.0, 1.0, (12, 1)), 100, axis=0)
    plant = StateSpace([[0.97]], [[1.0]], [[0.1]], sampling_time=1.0)
    y = plant.with_input_delay(delay).simulate(u)
    y += 0.03 * y.std() * rng.normal(size=y.shape)
    model = SubspaceLTI(input_delay="auto").fit(u + 3.0, y + 5.0)
    np.testing.assert_array_equal(model.input_delay_, [delay])
    assert model.order_ == 1


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_given_order_is_not_raised_to_do_without_a_delay(delay):
    """A state more would make up for the sample of delay, and for a weak mode."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=(400, 1))
    model = StateSpace(np.diag([0.8, -0.5]), [[1.0], [1.0]], [[1.0, 0.2]], [[0.5]], 1.0)
    y = model.with_input_delay(delay).simulate(u)
    y += 0.1 * y.std() * rng.normal(size=y.shape)
    settings = Choices(order=1).settings(1, 1, np.eye(1))
    np.testing.assert_array_equal(find_delays([(u, y)], settings, 1, None), [delay])


def test_every_input_has_its_own_delay():
    _, u, y = late_record(500, noise=0.02)
    found = estimator(input_delay="auto").fit(u, y)
    np.testing.assert_array_equal(found.input_delay_, DELAY)
    np.testing.assert_array_equal(found.lti_.input_delay, DELAY)


@pytest.mark.slow
def test_experiments_are_looked_at_together_and_units_do_not_matter():
    _, u, y = late_record(400, noise=0.02)
    v, z = late_record(200, seed=5, noise=0.02)[1:]
    u, y = 1e6 * np.vstack([u, v]), 1e-5 * np.vstack([y, z])
    table = np.column_stack([u, np.repeat([0, 1], [400, 200])])
    found = SubspaceLTI(input_delay="auto", experiment=2).fit(table, y)
    np.testing.assert_array_equal(found.input_delay_, DELAY)


def test_without_noise_the_delay_is_exact():
    _, u, y = late_record(200)
    found = SubspaceLTI(input_delay="auto").fit(u, y)
    np.testing.assert_array_equal(found.input_delay_, DELAY)
    assert found.order_ == 3


@pytest.mark.parametrize("n_trend", [1, 2])
def test_offsets_and_drifts_are_no_delays(n_trend):
    """What is found does not depend on them at all."""
    _, u, y = late_record(200, noise=0.02)
    v, z = late_record(150, seed=5, noise=0.02)[1:]
    settings = Choices().settings(2, 2, np.eye(2), n_trend)
    line = np.arange(200.0)[:, None] * (n_trend - 1)
    pairs = [(u + [100.0, -5.0] + 0.1 * line, y - 1e3 + line), (v - 7.0, z + 55.0)]
    for found in (pairs, [(u, y), (v, z)]):
        np.testing.assert_array_equal(find_delays(found, settings, 3, 6), DELAY)


@pytest.mark.parametrize("n_samples", [10, 15, 21, 40])
def test_few_samples_tell_of_no_delay(n_samples):
    rng = np.random.default_rng(n_samples)
    u, y = rng.normal(size=(2, n_samples, 1))
    settings = Choices().settings(1, 1, np.eye(1))
    np.testing.assert_array_equal(find_delays([(u, y)], settings, None, None), [0])


@pytest.mark.parametrize("seed", range(3))
def test_a_dead_time_of_more_than_a_tenth_of_a_record_is_found(seed):
    """Two steps of a furnace, sixty samples."""
    rng = np.random.default_rng(seed)
    u = np.repeat([0.0, 5.0, -2.0], [8, 22, 30])[:, None]
    lag = StateSpace([[0.78]], [[0.55]], [[1.0]], sampling_time=1.0, input_delay=8)
    y = lag.simulate(u) + 0.3 * rng.standard_normal(u.shape)
    found = SubspaceLTI(1, input_delay="auto").fit(u, y)
    assert found.input_delay_.tolist() == [8]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_few_samples_of_a_system_leak_no_numerical_warnings():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u, noise = rng.standard_normal((2, 20, 1))
        truth = stable_model(seed, 2, 1, 1, sampling_time=1.0)
        SubspaceLTI(input_delay="auto").fit(u, truth.simulate(u) + 0.1 * noise)


def test_first_answers_of_an_output_that_stays_at_zero_are_none():
    u, y = np.random.default_rng(0).normal(size=(60, 1)), np.zeros((60, 1))
    y[:5] = u[:5]
    np.testing.assert_array_equal(first_answers([(u, y)], 10), [-1])


def test_first_answers_need_evidence_for_each_input():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(600, 3)), rng.normal(size=(600, 2))
    y[3:, 1] += u[:-3, 0]
    y[7:, 0] += u[:-7, 2]
    np.testing.assert_array_equal(first_answers([(u, y)], 10), [3, -1, 7])


# -- refused ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("order", "start"), [("auto", "estimate"), (2, "rest")])
def test_a_delay_that_nobody_asked_for_is_told(order, start):
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], (300, 2)).repeat(4, axis=0)
    late = np.r_[np.zeros(12), u[:-12, 1]]
    y = lfilter([0.0, 0.1], [1.0, -1.6, 0.7], u[:, 0] - late)
    y += 0.1 * rng.standard_normal(len(y))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        SubspaceLTI(order, initial_state=start).fit(u, y)
    text = "".join(str(w.message) for w in told)
    assert text.count("the outputs show") == 1
    assert re.search(r"input 2 .* 1[23] samples.* order 2 .*input_delay='auto'", text)
    model = SubspaceLTI(order, input_delay="auto").fit(u, y)  # silently
    assert model.order_ == 2
    assert abs(model.input_delay_ - [0, 12]).max() <= 1


def test_a_slow_answer_is_no_delay():
    rng = np.random.default_rng(1)
    u = rng.choice([-1.0, 1.0], (20, 1)).repeat(50, axis=0)
    y = lfilter([1e-6], np.poly([0.99, 0.98, 0.97]), u[:, 0])
    y += 0.05 * y.std() * rng.standard_normal(len(y))
    SubspaceLTI().fit(u, y)  # silently


@pytest.mark.parametrize("delay", [-1, 1.5, [1, 2, 3], "some"])
def test_what_is_no_delay_is_refused(delay):
    _, u, y = late_record()
    with pytest.raises(ValueError, match="`input_delay` must be"):
        estimator(input_delay=delay).fit(u, y)


def test_experiments_shorter_than_the_delay_are_refused():
    _, u, y = late_record()
    with pytest.raises(ValueError, match="experiment of at least 302 samples"):
        estimator(input_delay=300).fit(u, y)
    with pytest.raises(ValueError, match="experiment of at least 1000000002 samples"):
        estimator(input_delay=10**9).fit(u, y)  # at once
    with pytest.raises(ValueError, match="Every input must vary"):
        estimator(input_delay=10**9, initial_state="rest").fit(u, y)


def test_a_stream_cannot_look_for_its_delay():
    _, u, y = late_record()
    with pytest.raises(ValueError, match="`input_delay` must be a number in partial"):
        estimator(input_delay="auto").partial_fit(u, y)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The response is hardly known")
@pytest.mark.parametrize(("seed", "delay"), [(2, 0), (3, 0), (0, 1), (1, 4)])
def test_inputs_that_are_foretold_make_no_delay(seed, delay):
    """Early ones tell the later ones: any delay is possible with states enough."""
    rng, t = np.random.default_rng(seed), np.arange(300)[:, None]
    f = np.linspace(0.02, 1 / 12, 25)
    u = np.cos(2 * np.pi * f * t + rng.uniform(0, 6.3, 25)).sum(axis=1, keepdims=True)
    spring = StateSpace([[0, 1], [-50, -1.5]], [[0], [3]], [[1, 0]]).to_discrete(0.05)
    model = spring.with_input_delay(delay)
    y = model.simulate(u)
    y += 0.02 * y.std() * rng.standard_normal(y.shape)
    found = SubspaceLTI(input_delay="auto", sampling_time=0.05).fit(u, y)
    assert found.input_delay_[0] <= delay and found.order_ <= 2 + delay
    omega = 2 * np.pi * f / 0.05
    G, G0 = (m.frequency_response(omega) for m in (found.lti_, model))
    assert np.linalg.norm(G - G0) < 0.01 * np.linalg.norm(G0)


def test_answers_are_those_of_all_samples_at_once(monkeypatch):
    """By factors of some at a time, which take the memory of these."""
    rng = np.random.default_rng(0)
    pairs = []
    for n in (150, 90, 300):
        u = rng.standard_normal((n, 2))
        y = 0.3 * np.roll(u[:, :1], 4, axis=0) + np.roll(u[:, 1:], 1, axis=0)
        pairs.append((u, y + 0.5 * rng.standard_normal((n, 1))))
    at_once = first_answers(pairs, 10)
    monkeypatch.setattr(delays, "_AT_ONCE", 40)
    assert first_answers(pairs, 10).tolist() == at_once.tolist() == [4, 1]
