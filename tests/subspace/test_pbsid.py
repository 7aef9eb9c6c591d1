"""PBSID: exact without noise, consistent under feedback, honest about its errors."""

import warnings

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy import linalg
from scipy.signal import decimate, lfilter

from lpvlearn import StateSpace, SubspaceLTI, bft_score
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes
from .conftest import (
    closed_loop,
    experiment,
    markov,
    matrices,
    miss,
    pbsid,
    record,
    sweep_of_a_hardening_spring,
)

UNSTABLE = (
    np.array([[1.1, 0.3], [0.0, 0.7]]),
    np.array([[1.0], [0.5]]),
    np.array([[0.5, 0.2]]),
    np.zeros((1, 1)),
)


def unstable_loop(seed, n_samples=1500):
    """A plant that only the loop holds; the controller needs a sample to answer."""
    rng = np.random.default_rng(seed)
    drive = np.array([0.5, 0.2])
    return closed_loop(rng, n_samples, UNSTABLE, gain=0.8, delay=1, drive=drive)


# -- what is identified ----------------------------------------------------------------


@pytest.mark.parametrize("order", [5, "auto"])
def test_it_is_exact_without_noise(system, order):
    u, y = record(system, 400, noise=0.0)
    model = pbsid(order).fit(u, y)
    assert model.order_ == 5 and model.method_ == "pbsid"
    assert_allclose(markov(*matrices(model)), markov(*system), atol=1e-6)
    assert model.residual_ < 1e-7
    assert model.singular_values_.shape == (2 * model.horizon_,)


@pytest.mark.slow
def test_the_error_falls_under_feedback_where_that_of_others_stays():
    errors = {"po-moesp": [], "pbsid": []}
    for n_samples in (1000, 9000):
        u, y = closed_loop(np.random.default_rng(n_samples), n_samples)
        other = SubspaceLTI(2, method="po-moesp", feedthrough=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the closed loop
            errors["po-moesp"].append(miss(other.fit(u, y)))
        errors["pbsid"].append(miss(pbsid(feedthrough=False).fit(u, y)))
    assert errors["po-moesp"][1] > 0.15
    assert errors["pbsid"][1] < 0.03 and errors["pbsid"][0] < 0.1


@pytest.mark.slow
def test_a_plant_may_be_unstable():
    u, y = unstable_loop(0)
    with pytest.warns(UserWarning, match="predicted .* controller's reference"):
        model = pbsid().fit(u, y)
    assert_allclose(model.lti_.poles(), [0.7, 1.1], atol=0.08)
    predictor = model.predictor_
    inner = predictor.A - predictor.K @ predictor.C
    assert np.abs(linalg.eigvals(inner)).max() < 1.0
    errors = y - model.predict_ahead(u, y)
    assert_allclose(np.sqrt(np.sum(errors**2) / np.sum(y**2)), model.residual_)
    assert 0.45 < errors.std() < 0.55  # the innovations'
    # Ten samples ahead more is unknown, by the impulse response of the noise.
    ahead = (y - model.predict_ahead(u, y, 10))[10:]
    A, C, K = predictor.A, predictor.C, predictor.K
    weights = [1.0] + [(C @ np.linalg.matrix_power(A, k) @ K).item() for k in range(9)]
    assert_allclose(ahead.std() / errors.std(), np.linalg.norm(weights), rtol=0.1)
    tests = model.residual_tests(u, y, errors="prediction").set_index("test")
    assert tests["passed"].to_dict() == {
        "whiteness": True,
        "past inputs": True,
        "present input": True,
        "future inputs": False,
    }
    with pytest.raises(ValueError, match="diverges"):
        model.residual_tests(np.tile(u, (9, 1)), np.tile(y, (9, 1)))


def test_stability_can_be_enforced():
    u, y = unstable_loop(1, 600)
    model = pbsid(2, stability="enforce").fit(u, y)
    assert model.lti_.is_stable and model.stability_loss_ > 0.0
    error = y - model.predict_with_initial_state(u, y)
    assert_allclose(np.sqrt(np.sum(error**2) / np.sum(y**2)), model.residual_)
    stable = closed_loop(np.random.default_rng(0), 600)
    options = {"feedthrough": False}
    models = [
        pbsid(2, stability=how, **options).fit(*stable) for how in ("warn", "enforce")
    ]
    assert_allclose(models[1].lti_.A, models[0].lti_.A)
    assert models[1].stability_loss_ == 0.0


# -- options ---------------------------------------------------------------------------


def test_units_do_not_matter(system):
    u, y = record(system, 300)
    first = pbsid(5).fit(u, y)
    other = pbsid(5).fit(u * [1e-6, 1e5], y * [1e4, 1e-7])
    assert_allclose(other.lti_.poles(), first.lti_.poles(), rtol=1e-7)
    covariance = other.predictor_.covariance / np.outer([1e4, 1e-7], [1e4, 1e-7])
    assert_allclose(covariance, first.predictor_.covariance, rtol=1e-6)


def test_experiments_gaps_rest_and_masks(system):
    rng = np.random.default_rng(0)
    parts = [experiment(rng, system, 100, rng.standard_normal(5)) for _ in range(4)]
    X = pd.DataFrame(np.vstack([u for u, _ in parts]), columns=["a", "b"])
    X["run"] = np.repeat(range(4), 100)
    y = np.vstack([y for _, y in parts])
    model = pbsid(5, experiment="run").fit(X, y)
    assert_allclose(markov(*matrices(model)), markov(*system), atol=1e-6)
    assert model.initial_states_.shape == (4, 5)
    assert_allclose(model.predict_with_initial_state(X, y), y, atol=1e-6)
    y[250] = np.nan
    gappy = pbsid(5, experiment="run", missing="split").fit(X, y)
    assert gappy.initial_states_.shape == (5, 5)
    assert_allclose(markov(*matrices(gappy)), markov(*system), atol=1e-6)
    u, y = record((*system[:3], np.diag([1.0, 0.0])), 400)
    mask = [[True, False], [False, False]]
    model = pbsid(5, feedthrough=mask, initial_state="rest").fit(u, y)
    assert_allclose(model.lti_.D, [[1.0, 0.0], [0.0, 0.0]], atol=0.3)
    assert (model.lti_.D != 0.0).sum() == 1 and not model.initial_states_.any()
    shifted = pbsid(5, detrend="constant").fit(u + 3.0, y - 7.0)
    again = pbsid(5, detrend="constant").fit(u, y)
    assert_allclose(shifted.lti_.poles(), again.lti_.poles(), rtol=1e-6)


def two_loops(levels, n_samples=1000):
    """Two experiments, and their channels about levels (2, 2) of input and output."""
    rng = np.random.default_rng(7)
    parts = [np.hstack(closed_loop(rng, n_samples)) + level for level in levels]
    table = pd.DataFrame(np.vstack(parts), columns=["u", "y"])
    table["experiment"] = np.repeat(["a", "b"], n_samples)
    return table[["u", "experiment"]], table["y"].to_numpy()


LEVELS = np.array([[3.0, -50.0], [-2.0, 7.0]])


def loops_fit(X, y, order=2, **options):
    return pbsid(order, experiment="experiment", feedthrough=False, **options).fit(X, y)


def test_constants_change_nothing_but_themselves():
    about_zero, moved = two_loops(np.zeros((2, 2))), two_loops(LEVELS)
    models = [loops_fit(*data, offset="constant") for data in (about_zero, moved)]
    first, other = models
    assert_allclose(markov(*matrices(other)), markov(*matrices(first)), atol=1e-6)
    assert_allclose(other.predictor_.covariance, first.predictor_.covariance, rtol=1e-6)
    gain = first.lti_.dc_gain()
    c = [m.output_offset_ - m.input_offset_ @ gain.T for m in models]
    wanted = LEVELS[:, 1:] - LEVELS[:, :1] @ gain.T
    assert_allclose(c[1] - c[0], wanted, atol=1e-5)
    ahead = [
        m.predict_ahead(*data, steps=3)
        for m, data in zip(models, (about_zero, moved), strict=True)
    ]
    assert_allclose(ahead[1] - ahead[0], np.repeat(LEVELS[:, 1], 1000), atol=1e-5)
    tests = [
        m.residual_tests(*data, errors="prediction")["p_value"]
        for m, data in zip(models, (about_zero, moved), strict=True)
    ]
    assert_allclose(*tests, atol=1e-4)
    assert tests[0][:2].min() > 1e-3  # whiteness and past inputs, not the future


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, "auto"])
def test_constants_are_taken_where_they_are(order):
    assert loops_fit(*two_loops(np.zeros((2, 2))), order).offset_ is None
    model = loops_fit(*two_loops(LEVELS), order)
    assert model.offset_ == "constant" and model.order_ == 2
    assert miss(model) < 0.1
    with pytest.warns(UserWarning, match="different constants"):
        model.predict(two_loops(LEVELS)[0])
    same = loops_fit(*two_loops(LEVELS[[0, 0]]), order)
    same.predict(two_loops(LEVELS)[0])  # which does not warn


@pytest.mark.broad
@pytest.mark.parametrize("level", [1.0, 1e2, 1e6])
def test_constants_are_found_near_and_far(level):
    """A slow mode stands for near ones, and far ones hide everything else."""
    for seed in (6, 10, 15):
        u, y = closed_loop(np.random.default_rng(seed), 500)
        model = pbsid(2, feedthrough=False).fit(u + level, y + 0.1 * level)
        assert model.offset_ == "constant"
        assert miss(model) < 0.15


@pytest.mark.slow
def test_auto_finds_the_loop_about_its_point_of_work():
    X, y = two_loops(LEVELS)
    model = SubspaceLTI(2, experiment="experiment")
    with pytest.warns(UserWarning, match="closed loop") as told:
        model.fit(X, y)
    assert len(told) == 1
    assert (model.method_, model.offset_) == ("pbsid", "constant")
    assert miss(model) < 0.1


def test_a_drift_of_a_loop_is_a_drift_of_its_outputs():
    u, y = closed_loop(np.random.default_rng(3), 1500)
    drift = 0.01 * np.arange(1500.0)[:, None]
    first, other = (
        pbsid(2, feedthrough=False, offset="linear").fit(u, outputs)
        for outputs in (y, y + drift)
    )
    assert_allclose(markov(*matrices(other)), markov(*matrices(first)), atol=1e-6)
    assert_allclose(other.output_drift_ - first.output_drift_, 0.01, rtol=1e-5)


def test_prediction_goes_on_where_outputs_are_missing():
    """Of a plant that only the loop holds, about its point of work."""
    u, y = unstable_loop(0)
    y = y + 5.0
    with pytest.warns(UserWarning, match="unstable"):
        model = pbsid(2, feedthrough=False, offset="constant").fit(u, y)
    lost = y.copy()
    lost[1000:1003] = np.nan
    lost[1200] = np.nan
    rest = {"initial_state": "rest"}
    found, whole = (model.predict_ahead(u, outputs, **rest) for outputs in (lost, y))
    assert_allclose(found[:1001], whole[:1001])
    for row, steps in ((1001, 2), (1002, 3), (1003, 4), (1201, 2)):
        ahead = model.predict_ahead(u, y, steps=steps, **rest)
        assert_allclose(found[row], ahead[row], atol=1e-6)
    assert_allclose(found[-50:], whole[-50:], atol=1e-6)
    # Estimated beside the constant, from four outputs less.
    found, whole = model.predict_ahead(u, lost), model.predict_ahead(u, y)
    assert_allclose(found[:1001], whole[:1001], atol=0.02)


def test_orders_that_no_modes_add_up_to_are_those_of_the_subspace(system):
    u, y = record(system, 600)
    model = pbsid(1).fit(u, y)
    assert model.order_ == 1 and model.lti_.is_stable
    with pytest.raises(AttributeError, match="not that of the modes that inputs reach"):
        _ = model.poles_std_
    with pytest.warns(UserWarning, match="next to nothing"):
        assert pbsid(0).fit(u, y).order_ == 0
    noisy = pbsid(5, n_noise_states=2, refine=False).fit(u, y)
    assert noisy.order_ == 5 and noisy.predictor_.n_noise_states == 2


def test_streams_are_refused():
    u, y = closed_loop(np.random.default_rng(0), 60)
    with pytest.raises(ValueError, match="`method` must not be 'pbsid'.*`fit`"):
        pbsid().partial_fit(u, y)


# -- auto ------------------------------------------------------------------------------


@pytest.mark.slow
def test_auto_takes_it_where_there_is_feedback():
    u, y = closed_loop(np.random.default_rng(3), 2000)
    with pytest.warns(UserWarning, match="closed loop.*'pbsid' was taken.*D = 0"):
        model = SubspaceLTI().fit(u, y)
    assert model.method_ == "pbsid" and not model.lti_.D.any()
    same = pbsid(feedthrough=False).fit(u, y)  # without a warning
    assert_allclose(model.lti_.A, same.lti_.A)
    with pytest.warns(UserWarning, match="feedthrough=False unless"):
        assert pbsid().fit(u, y).lti_.D.any()
    late = closed_loop(np.random.default_rng(0), 6000, gain=0.15, delay=3)
    with pytest.warns(UserWarning, match="does not bias. A model"):
        assert SubspaceLTI(2).fit(*late).lti_.D.any()
    with pytest.warns(UserWarning, match="closed loop.*biases method='po-moesp'"):
        streamed = SubspaceLTI(2).partial_fit(u, y)
    assert streamed.method_ == "po-moesp"


@pytest.mark.slow
def test_a_controller_that_answers_at_once_is_no_feedthrough():
    """A free D would be minus one over the gain of the controller."""
    for rng in map(np.random.default_rng, range(2)):
        x, n = 0.0, 1000
        r, e = np.repeat(rng.choice([-0.5, 0.5], n // 20), 20), rng.standard_normal(n)
        u, y = np.zeros((2, n, 1))
        for t in range(n):
            y[t] = x + 0.3 * e[t]
            u[t] = 2.0 * (r[t] - y[t])
            x = 0.8 * x + 0.2 * u[t, 0]
        told = "closed loop.*'pbsid' was taken.*input answers outputs within.*D = 0"
        with pytest.warns(UserWarning, match=told):
            model = SubspaceLTI().fit(u, y)
        assert_allclose(model.lti_.dc_gain(), 1.0, rtol=0.15)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            biased = SubspaceLTI(method="po-moesp").fit(u, y)
        remedy = "se method='pbsid', feedthrough=False"
        assert any(remedy in str(w.message) for w in caught)
        assert abs(biased.lti_.D.item()) > 0.1
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pbsid().fit(u, y)
        assert any(remedy in str(w.message) for w in caught)


def test_noise_of_a_measured_input_answers_as_a_controller_does():
    """Covariances and more are alike: what is simulated decides, and that is told."""
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], (2000, 1))
    y = lfilter([1.0, -0.6], [1.0, -0.8], u, axis=0)
    y += 0.01 * rng.standard_normal(y.shape)
    told = "answers outputs within the sample.*Else it is measured with noise"
    with pytest.warns(UserWarning, match=told):
        model = SubspaceLTI().fit(u + 0.1 * rng.standard_normal(u.shape), y)
    assert_allclose(model.lti_.D, 1.0, rtol=0.05)
    assert_allclose(model.lti_.dc_gain(), 2.0, rtol=0.05)


def sampled_early(seed, n_samples=400):
    """Outputs that are means over the sample to come, of slow inputs: no feedback."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.9], rng.standard_normal((n_samples + 1, 1)), axis=0)
    y = lfilter([1.0, -0.6], [1.0, -0.8], u, axis=0)
    noise = 0.05 * y.std() * rng.standard_normal((n_samples, 1))
    return u[:-1], 0.5 * (y[:-1] + y[1:]) + noise


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The outputs seem to know")
def test_auto_gives_up_what_parts_held_out_refute():
    for seed in range(2):
        (u, y), (u_other, y_other) = sampled_early(seed), sampled_early(seed + 9)
        with pytest.warns(UserWarning, match="D = 0 is (poor|unstable) .* Taken was"):
            model = SubspaceLTI().fit(u, y)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the closed loop
            rivals = [
                SubspaceLTI(model.order_, method="po-moesp").fit(u, y),
                pbsid(feedthrough=False).fit(u, y),
            ]
        first, ordinary, without = (
            np.std(y_other - m.predict_with_initial_state(u_other, y_other))
            for m in (model, *rivals)
        )
        assert first < min(1.2 * ordinary, 0.7 * without)


def modes_sampled_early(seed, n_samples=500):
    """Two lightly damped modes, outputs as in `sampled_early`."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.97], rng.standard_normal((n_samples + 1, 1)), axis=0)
    slow, fast = (
        lfilter(b, [1.0, -2.0 * r * np.cos(w), r * r], u, axis=0)
        for b, r, w in (([1.0, -0.9], 0.98, 0.2), ([0.0, 0.5], 0.97, 0.7))
    )
    y = 0.5 * (slow + fast)[:-1] + 0.5 * (slow + fast)[1:]
    return u[:-1], y + 0.005 * y.std() * rng.standard_normal(y.shape)


def loaded_loop(seed, n_samples=1500):
    """A lag under a PI controller, moved more by its load than by what is added."""
    rng = np.random.default_rng(seed)
    added = np.repeat(rng.choice([-1.0, 1.0], n_samples // 5), 5)
    load = lfilter([1.0], [1.0, -0.8], rng.standard_normal(n_samples))
    x, total, u, y = 0.0, 0.0, np.zeros(n_samples), np.zeros(n_samples)
    for t in range(n_samples):
        y[t] = x
        if t:
            total -= y[t - 1]
            u[t] = added[t] - 1.5 * y[t - 1] + 0.1 * total
        x = 0.8 * x + 0.2 * (u[t] + load[t])
    return u[:, None], y[:, None]


@pytest.mark.broad
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_inputs_that_tell_the_noise_do_not_refute_the_plant(seed):
    """By them a model without states simulates parts held out clearly better."""
    u, y = loaded_loop(seed)
    with pytest.warns(UserWarning, match="closed loop.*'pbsid' was taken"):
        model = SubspaceLTI().fit(u, y)
    assert_allclose(model.lti_.dc_gain(), 1.0, rtol=0.25)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The outputs seem to know")
def test_a_free_d_that_only_makes_the_plant_stable_competes_with_the_open_loop():
    for seed in (0, 1):
        u, y = modes_sampled_early(seed)
        u_other, y_other = modes_sampled_early(seed + 100)
        with pytest.warns(UserWarning, match="D = 0 is unstable .* method='po-moesp'"):
            model = SubspaceLTI().fit(u, y)
        assert model.method_ == "po-moesp"
        with pytest.warns(UserWarning, match="closed loop"):
            free = pbsid().fit(u, y)
        error, of_that = (
            np.std(y_other - m.predict_with_initial_state(u_other, y_other))
            for m in (model, free)
        )
        assert error < of_that


@pytest.mark.slow
@pytest.mark.parametrize("lead", [3, 6])
def test_outputs_that_lead_the_inputs_are_told(lead):
    rng = np.random.default_rng(lead)
    for pole in (0.0, 0.9):
        u = lfilter([1.0], [1.0, -pole], rng.standard_normal((800, 2)), axis=0)
        y = lfilter([0.0, 1.0], [1.0, -1.5, 0.7], u @ [[1.0], [0.5]], axis=0)
        y += 0.05 * y.std() * rng.standard_normal(y.shape)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            SubspaceLTI().fit(u[:-lead], y[lead:])
        # what leads by a sample less than the plant needs is its feedthrough
        (message,) = [str(w.message) for w in told if "outputs lead it" in str(w)]
        assert f"at least {lead - 1} sample(s) ahead" in message


@pytest.mark.slow
def test_the_inputs_of_a_loop_with_a_reference_do_not_come_too_late():
    for seed in range(2):
        u, y = closed_loop(np.random.default_rng(seed), 2000)
        with pytest.warns(UserWarning) as told:
            SubspaceLTI().fit(u, y)
        assert not any("outputs lead it" in str(w.message) for w in told)


def test_a_reference_of_few_lines_is_no_sign_of_a_lead():
    """Modes that do not decay are such a reference, beside the inverse controller."""
    t = np.arange(800)
    r = np.sin(2.0 * np.pi * t / 40.0) + np.sin(t / 7.3)
    for seed in range(2):
        noise = 0.1 * np.random.default_rng(seed).standard_normal(800)
        u, y, x = np.zeros(800), np.zeros(800), 0.0
        for k in t:
            y[k] = x + noise[k]
            u[k] = r[k - 2] - y[k - 2] if k > 1 else 0.0
            x = 0.8 * x + 0.2 * u[k]
        with pytest.warns(UserWarning, match="closed loop") as told:
            SubspaceLTI().fit(u[:, None], y)
        assert not any("outputs lead it" in str(w.message) for w in told)


def slow_plant_in_a_loop(seed, n_samples=1000):
    """What outputs tell of themselves one step ahead, and its response."""
    rng = np.random.default_rng(seed)
    a, b = np.poly([0.9, 0.6, 0.3, 0.2]), np.array([0.0, 0.02, 0.05, 0.03, 0.01])
    r = np.repeat(rng.choice([-1.0, 1.0], n_samples // 10), 10)
    noise = 0.3 * lfilter([1.0], [1.0, -0.9], rng.standard_normal(n_samples))
    u, x, y = np.zeros((3, n_samples))
    for t in range(n_samples):
        back = np.arange(1, min(4, t) + 1)
        x[t] = b[back] @ u[t - back] - a[back] @ x[t - back]
        y[t] = x[t] + noise[t]
        u[t] = r[t] - 0.8 * y[t]
    omega = np.linspace(0.02, 1.0, 40)
    delay = np.exp(-1j * omega)
    response = np.polyval(b[::-1], delay) / np.polyval(a[::-1], delay)
    return u[:, None], y[:, None], omega, response


@pytest.mark.broad
@pytest.mark.parametrize("seed", [1, 2])
def test_the_order_in_a_loop_is_one_that_simulates(seed):
    u, y, omega, truth = slow_plant_in_a_loop(seed)

    def error(model):
        response = model.lti_.frequency_response(omega).ravel()
        return np.linalg.norm(response - truth) / np.linalg.norm(truth)

    model = pbsid(feedthrough=False).fit(u, y)
    table = model.selection_
    assert table["order"][table["chosen"]].tolist() == [model.order_]
    predicts_best = int(table["order"][table["criterion"].idxmin()])
    with pytest.warns(UserWarning, match="unstable"):
        other = pbsid(predicts_best, feedthrough=False).fit(u, y)
    assert error(other) > 1.0
    assert error(model) < 0.15


@pytest.mark.slow
def test_auto_keeps_a_plant_that_only_the_loop_holds():
    for delay in (0, 1):
        rng, drive = np.random.default_rng(0), np.array([0.5, 0.2])
        loop = closed_loop(rng, 600, UNSTABLE, gain=0.5, delay=delay, drive=drive)
        with pytest.warns(UserWarning, match="closed loop|unstable"):
            model = SubspaceLTI().fit(*loop)
        assert model.method_ == "pbsid" and model.lti_.D.any() == bool(delay)
        assert_allclose(np.abs(model.lti_.poles()).max(), 1.1, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_kicks_of_a_derivative_do_not_hide_the_loop(seed):
    """Steps of a reference through a PD controller of a magnet that falls by itself."""
    rng = np.random.default_rng(seed)
    levitated = StateSpace([[0.0, 1.0], [1800.0, 0.0]], [[0.0], [-24.0]], [[1.0, 0.0]])
    A, B = (getattr(levitated.to_discrete(0.002), M) for M in "AB")
    r = 1e-3 * np.repeat(rng.choice([-1.0, 1.0], 34), 60)[:2000]
    noise = 1e-5 * rng.standard_normal(2000)
    x, before, u, y = np.zeros(2), 0.0, np.zeros(2000), np.zeros(2000)
    for t in range(2000):
        y[t] = x[0] + noise[t]
        error = r[t] - y[t]
        u[t] = -300.0 * error - 2500.0 * (error - before)
        x, before = A @ x + B[:, 0] * u[t], error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the loop, of its pole
        model = SubspaceLTI(sampling_time=0.002).fit(u[:, None] + 0.8, y + 0.012)
    assert model.method_ == "pbsid"
    poles = np.sort(np.abs(model.lti_.poles()))
    assert poles[-1] == pytest.approx(np.exp(0.002 * np.sqrt(1800.0)), abs=5e-3)


@pytest.mark.slow
def test_a_plant_that_grows_is_held_though_noise_is_too_small_to_show_it():
    """Its inputs are nearly all reference and answers to that."""
    rng = np.random.default_rng(0)
    plant = StateSpace([[0.0, 1.0], [0.6, -1.7]], [[0.0], [1.0]], [[1.0, 0.0]])
    A, B = (getattr(plant.to_discrete(0.25), M) for M in "AB")
    r = rng.standard_normal(1200)
    x, before, u, y = np.zeros(2), 0.0, np.zeros(1200), np.zeros(1200)
    for t in range(1200):
        y[t] = x[0] + 0.01 * rng.standard_normal()
        error = r[t] - y[t]
        u[t] = 4.0 * error + 2.0 * (error - before)
        x, before = A @ x + B[:, 0] * u[t], error
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI(sampling_time=0.25).fit(u[:, None], y)
    told = "".join(str(one.message) for one in caught)
    assert "a controller holds it" in told or "The inputs know the noise" in told
    assert model.method_ == "pbsid"
    poles = np.linalg.eigvals(A).real
    assert np.abs(model.lti_.poles()).max() == pytest.approx(poles.max(), abs=3e-3)


@pytest.mark.slow
def test_a_spring_that_hardens_is_no_plant_that_a_controller_holds():
    """Many states predict it well in open loop, and some of these grow."""
    u, y = sweep_of_a_hardening_spring(600, damping=0.02, cubic=4.0, rates=(1.2, 0.6))
    y += 1e-4 * y.std() * np.random.default_rng(0).standard_normal(y.shape)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI().fit(u, y)
    assert not any("controller holds" in str(one.message) for one in caught)
    assert model.method_ == "po-moesp"


def test_a_pole_that_grows_beyond_chance_is_not_told_to_be_enforced_first(rng):
    u = rng.standard_normal(100)
    y = lfilter([0.0, 1.0], [1.0, -1.05], u) + 0.1 * rng.standard_normal(100)
    with pytest.warns(UserWarning, match="It grows beyond chance, as a plant"):
        SubspaceLTI(1, method="po-moesp").fit(u[:, None], y)


def test_auto_is_po_moesp_in_open_loop(system):
    u, y = record(system, 500)
    model = SubspaceLTI(5).fit(u, y)
    assert model.method_ == "po-moesp"
    same = SubspaceLTI(5, method="po-moesp").fit(u, y)
    np.testing.assert_array_equal(model.lti_.A, same.lti_.A)


def shaken(seed, shared, n_samples=3000, size=1.0):
    """A light mode that wind moves more than the input does, or a sensor's noise.

    That is `size` times as large, and oscillates as lightly at twice the frequency.
    Returns the samples and the plant.
    """
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n_samples // 40), 40)[:, None]
    light = np.exp(-0.005 + 0.14j)
    A, C = modes(light, 0.98), np.array([[1.0, 0.3, 1.0]])
    plant = A, np.array([[0.02], [0.01], [0.02]]), C, np.zeros((1, 1))
    y = lti_response(*plant, u)
    oscillation = modes(light) if shared else modes(np.exp(-0.005 + 0.28j))
    gust = np.array([[0.3], [1.0]])
    wind = rng.standard_normal((n_samples + 2000, 1))
    noise = lti_response(oscillation, gust, C[:, :2], np.zeros((1, 1)), wind)[2000:]
    y = y + size * y.std() * noise / noise.std()
    return (u, y + 0.01 * y.std() * rng.standard_normal(y.shape)), plant


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_that_moves_the_plant_tells_of_its_poles(seed):
    samples, plant = shaken(seed, shared=True)
    model, without = SubspaceLTI().fit(*samples), SubspaceLTI(method="po-moesp")
    assert model.method_ == "pbsid" and model.order_ == 3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a mode that does not decay, and others
        without.fit(*samples)
    assert miss(model, plant) < min(0.3, 0.6 * miss(without, plant))
    both = model.lti_.poles(), linalg.eigvals(plant[0])
    found, true = map(np.sort_complex, both)
    assert (np.abs(found - true) < 4.0 * np.abs(model.poles_std_).max()).all()


@pytest.mark.broad
@pytest.mark.parametrize("seed", [0, 1])
def test_a_mode_that_the_subspace_hardly_shows_is_found_by_refinement(seed):
    rng = np.random.default_rng(seed)
    mode = [[0.0, 1.0], [-0.49, -0.35]]
    lagged = linalg.block_diag(mode, [[-0.1]])
    lagged[1, 2] = 1.0
    plant = StateSpace(lagged, np.eye(3)[:, 2:], np.eye(3)[:1]).to_discrete(0.2)
    gusts = StateSpace(mode, [[0.0], [1.0]], [[1.0, 0.0]]).to_discrete(0.2)
    u = np.repeat(rng.choice([-1.0, 1.0], 150), 20)[:, None]
    y, noise = plant.simulate(u), gusts.simulate(rng.standard_normal((4000, 1)))[1000:]
    noise = noise / noise.std() + 0.05 * rng.standard_normal(noise.shape)
    model = SubspaceLTI(method="pbsid").fit(u, y + y.std() * noise)
    assert model.order_ == 3 and bft_score(y, model.lti_.simulate(u)) > 80.0


def test_little_noise_that_moves_the_plant_is_known_for_it():
    samples, plant = shaken(0, shared=True, size=0.05)
    model = SubspaceLTI(3).fit(*samples)
    assert model.method_ == "pbsid"
    found, true = map(np.sort_complex, (model.lti_.poles(), linalg.eigvals(plant[0])))
    assert (np.abs(found - true) < 4.0 * np.abs(model.poles_std_).max()).all()


@pytest.mark.broad
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_of_a_sensor_leaves_the_plant_alone(seed):
    samples, _ = shaken(seed, shared=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert SubspaceLTI().fit(*samples).method_ == "po-moesp"


def in_wind(seed, n_samples=4000):
    """A wind turbine: rotor speed and tower acceleration, by pitch and by gusts.

    Gusts last some seconds. Returns the samples, and the plant of both inputs.
    """
    rng, square = np.random.default_rng(seed), (0.64 * np.pi) ** 2
    A = [
        [-0.02, 0.0, 0.0, 0.083],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, -square, -0.06, 0.1],
        [0.0, 0.0, 0.0, -0.25],
    ]
    B = [[-0.37, 0.0], [0.0, 0.0], [-0.25, 0.0], [0.0, 1.5]]
    C, D = [[1.0, 0.0, 0.0, 0.0], A[2]], [[0.0, 0.0], B[2]]
    plant = StateSpace(A, B, C, D)
    u = 1.5 * np.repeat(rng.choice([-1.0, 1.0], n_samples // 20), 20)
    both = np.column_stack([u, rng.standard_normal(n_samples)])
    y = plant.simulate(both, sampling_time=0.1)
    return (u[:, None], y + 0.02 * rng.standard_normal(y.shape)), plant


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_a_load_of_its_own_mode_tells_of_the_plant(seed):
    """What makes the gusts is no state of the plant, but moves these."""
    (u, y), plant = in_wind(seed)
    v = 1.5 * np.repeat(np.random.default_rng(9).choice([-1.0, 1.0], 100), 20)
    true = plant.simulate(np.column_stack([v, 0 * v]), sampling_time=0.1)[:, 0]
    errors = []
    for method in ("auto", "po-moesp"):
        with warnings.catch_warnings():
            warnings.simplefilter("error" if method == "auto" else "ignore")
            model = SubspaceLTI(method=method, sampling_time=0.1).fit(u, y)
        errors.append(np.linalg.norm(model.predict(v[:, None])[:, 0] - true))
        if method == "auto":
            assert (model.method_, model.order_, model.offset_) == ("pbsid", 3, None)
    assert errors[0] < 0.6 * errors[1]


def early_outputs(seed, n_samples=300):
    """Three modes under coloured inputs, the outputs read a sample before them."""
    rng = np.random.default_rng(seed)
    A = modes(*np.array([0.97, 0.92, 0.9]) * np.exp([1.6j, 1.1j, 2.6j]))
    B, C = rng.standard_normal((6, 2)), rng.standard_normal((2, 6))
    u, e = (rng.standard_normal((n_samples + 1, 2)) for _ in range(2))
    u = lfilter([1.0], [1.0, -1.6, 0.7], u, axis=0)
    y = lti_response(A, B, C, np.zeros((2, 2)), u)
    y += 0.02 * y.std(axis=0) * lfilter([1.0], [1.0, -0.95], e, axis=0)
    return u[:-1], y[1:]


@pytest.mark.filterwarnings("ignore:The identified model is unstable")
@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_a_split_must_be_as_likely_as_the_whole(seed):
    """Wald's statistic calls modes noise whose loss spoils a model that is wrong."""
    u, y = early_outputs(seed)
    model = pbsid(feedthrough=False).fit(u, y)
    whole = pbsid(len(model.predictor_.A), feedthrough=False).fit(u, y)
    assert model.residual_ < 1.1 * whole.residual_


@pytest.mark.filterwarnings("ignore:Output 1 is .* in all samples")
def test_outputs_of_zero_and_tiny_tables_have_a_model():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((40, 2))
    model = pbsid().fit(u, np.zeros((40, 2)))
    assert model.order_ == 0 and not model.predict(u).any()
    for n in (10, 15, 21):
        y = lfilter([0.0, 1.0], [1.0, -0.5], u[:n, 0])
        assert np.isfinite(pbsid().fit(u[:n], y).lti_.A).all()


def test_a_reference_of_few_sines_is_told():
    rng = np.random.default_rng(0)
    u, y, x = np.zeros((1000, 1)), np.zeros(1000), 0.0
    for t, e in enumerate(0.1 * rng.standard_normal(1000)):
        y[t] = x + e
        u[t] = np.sin(0.1 * t) - 0.5 * y[t - 1]
        x = 0.95 * x + 0.3 * u[t, 0]
    with pytest.warns(UserWarning, match="the inputs follow from the past"):
        assert SubspaceLTI().fit(u, y).method_ == "pbsid"


@pytest.mark.broad
@pytest.mark.parametrize("seed", [1, 7])
def test_a_controller_is_not_taken_for_the_feedthrough_of_its_plant(seed):
    """A ball on a beam: with D free, the inputs tell the noise that they answer."""
    rng, step, gain = np.random.default_rng(seed), 0.1, 7.0
    reference = np.repeat(rng.uniform(-0.3, 0.3, 40), rng.integers(15, 60, 40))[:1000]
    A, B = np.array([[1.0, step], [0.0, 1.0]]), gain * np.array([step**2 / 2, step])
    x, rate, before, u, y = np.zeros(2), 0.0, 0.0, [], []
    for r in reference:
        y.append(x[0] + 0.003 * rng.standard_normal())
        rate = 0.6 * rate + 0.4 * (y[-1] - before) / step
        before = y[-1]
        u.append(0.12 * (r - before) - 0.22 * rate)
        x = A @ x + B * u[-1] + [0.0, 0.002 * rng.standard_normal()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = SubspaceLTI(sampling_time=step).fit(np.array(u)[:, None], y)
    assert not model.lti_.D.any()
    omega = np.geomspace(0.3, 15.0, 40)
    true = StateSpace(A, B[:, None], [[1.0, 0.0]], None, step)
    G = true.frequency_response(omega)
    error = np.abs(model.lti_.frequency_response(omega) - G) / np.abs(G)
    assert error.mean() < 0.15


def car_with_biases(seed, speed=32.0, n_samples=4000, step=0.01):
    """Yaw rate and lateral acceleration of a car that a driver keeps straight."""
    mass, inertia, front, rear, Cf, Cr = 1500.0, 2500.0, 1.2, 1.5, 8e4, 9e4
    turn = front * Cf - rear * Cr
    A = [
        [-(Cf + Cr) / (mass * speed), -speed - turn / (mass * speed)],
        [-turn / (inertia * speed), -(front**2 * Cf + rear**2 * Cr) / inertia / speed],
    ]
    B = [[Cf / mass], [front * Cf / inertia]]
    C = [[0.0, 1.0], [A[0][0], A[0][1] + speed]]
    plant = StateSpace(A, B, C, [[0.0], [Cf / mass]]).to_discrete(step)
    rng, x = np.random.default_rng(seed), np.zeros(2)
    yaw = seen = filtered = gust = 0.0
    moves = np.repeat(rng.choice([-0.03, 0.03], n_samples // 60 + 1), 60)
    noise = rng.standard_normal((n_samples, 3)) * [1.0, 0.003, 0.08]
    u, y = np.zeros((n_samples, 1)), np.zeros((n_samples, 2))
    for k in range(n_samples):
        filtered += step / 0.15 * (moves[k] - filtered)
        gust = 0.98 * gust + 0.02 * noise[k, 0]
        u[k] = filtered - 0.05 * yaw - 0.1 * seen
        seen = x[1] + noise[k, 1]
        y[k] = plant.C @ x + plant.D @ u[k] + [noise[k, 1], noise[k, 2]]
        yaw += step * x[1]
        x = plant.A @ x + plant.B @ u[k] + 0.002 * gust
    return u + 0.01, y + [0.004, 0.15]


@pytest.mark.slow
@pytest.mark.parametrize("speed, seed", [(20.0, 1), (26.0, 6)])
def test_constants_beside_a_given_order_are_no_less_likely_than_none(speed, seed):
    """The model with constants begins at the one without: levels were lost else."""
    u, y = car_with_biases(seed, speed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the loop
        model = SubspaceLTI(2, method="pbsid").fit(u, y)
    assert model.offset_ == "constant"
    assert model.score(u, y) > 0.99


@pytest.mark.slow
@pytest.mark.broad
@pytest.mark.parametrize("seed", [0, 1])
def test_filters_that_know_later_samples_make_no_plant_that_alternates(seed):
    """Zero-phase decimation: inputs know the errors, and nobody controls."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.98], rng.standard_normal((16_000, 1)), axis=0)
    y = lfilter([0.0, 0.01], [1.0, -1.98, 0.985], u, axis=0)
    y += lfilter([0.003], [1.0, -0.997], u, axis=0)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    u, y = (decimate(x, 20, ftype="fir", axis=0) for x in (u, y))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI().fit(u[:400], y[:400])
    assert any("filters that know later samples" in str(w.message) for w in caught)
    assert model.lti_.is_stable
    fresh = model.predict_with_initial_state(u[400:], y[400:])
    assert bft_score(y[400:], fresh) > 97.0
