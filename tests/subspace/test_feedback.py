"""The long autoregression and the test of feedback: exact, of right size and power."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.closed_loop.feedback import find_feedback
from lpvlearn.subspace.closed_loop.varx import longest_past, past_window
from lpvlearn.subspace.samples.records import Record

from ..conftest import stable_model
from .conftest import closed_loop


def records_of(*pairs):
    return [Record.of(u / u.std(), y / y.std()) for u, y in pairs]


def open_loop(rng, n_samples, signal, *, order=3, pole=0.0):
    """A random system, 10 dB."""
    system = stable_model(rng, order, 1, 1, sampling_time=1.0)
    white = rng.standard_normal((n_samples, 1))
    if signal == "held":
        u = np.repeat(white, 7, axis=0)[:n_samples]
    elif signal == "coloured":
        u = lfilter([1.0], [1.0, -0.97], white, axis=0)
    else:
        u = white
    y = system.simulate(u)
    e = lfilter([1.0], [1.0, -pole], rng.standard_normal(y.shape), axis=0)
    return u, y + 0.3 * y.std() / e.std() * e


def test_it_is_a_regression_on_past_and_future():
    """Of two experiments, each with its own constant, by long matrices."""
    rng, f = np.random.default_rng(0), 8
    pairs = [open_loop(rng, n, "white") for n in (300, 200)]
    records = records_of(*pairs)
    found = find_feedback(records)
    longest = longest_past(records, 120 - f, f)
    losses = {}
    for p in range(1, longest + 1):
        rows = []
        for own, record in zip(np.eye(2), records, strict=True):
            u, y = record.u[0], record.y[0]
            for t in range(longest, len(u) - f):
                past = [s[t - p : t][::-1] for s in (u, y)]
                rows.append(np.r_[own, past[0], past[1], u[t : t + f + 1], y[t]])
        M = np.array(rows)
        n, fits = len(M) - 2, []
        for k in (2 * p + 1, 2 * p + 1 + f):
            X = M[:, : 2 + k]
            fits.append(np.sum((M[:, -1] - X @ np.linalg.lstsq(X, M[:, -1])[0]) ** 2))
        n_parameters = 2 * p + 2
        penalty = 2.0 * n_parameters * n / (n - 2 * p - 3)
        losses[n * np.log(fits[0]) + penalty] = (p, *fits)
    p, short, full = losses[min(losses)]
    dof = n - 2 * p - 1
    statistic = (dof - f + 0.5 * (f - 2)) * np.log(short / full)
    assert_allclose(found.p_value, stats.chi2.sf(statistic, f), rtol=1e-6)
    assert_allclose(found.innovations, short / dof, rtol=1e-8)


@pytest.mark.parametrize("signal", ["white", "held", "coloured"])
def test_p_values_are_uniform_in_open_loop(signal):
    rng = np.random.default_rng(1)
    p = [
        find_feedback(
            records_of(open_loop(rng, 400, signal, pole=rng.choice([0.0, 0.9])))
        ).p_value
        for _ in range(60)
    ]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_feedback_is_found():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found = find_feedback(records_of(closed_loop(rng, 1500)))
        assert found.found and found.instantaneous and found.p_value < 1e-6
        late = find_feedback(records_of(closed_loop(rng, 6000, gain=0.15, delay=3)))
        assert late.found and not late.instantaneous


def within_the_sample(rng, kind, steps=True, n_samples=1000):
    """A lag with an input that acts at once, or a controller that answers at once."""
    r = np.repeat(rng.choice([-1.0, 1.0], n_samples // 5), 5)
    r = r if steps else rng.standard_normal(n_samples)
    e = 0.3 * rng.standard_normal(n_samples)
    x, u, y = 0.0, np.zeros(n_samples), np.zeros(n_samples)
    for t in range(n_samples):
        if kind == "answer":
            y[t] = x + e[t]
            u[t] = 2.0 * (r[t] - y[t])
        else:
            u[t] = r[t]
            y[t] = x - u[t] + e[t]
        x = 0.8 * x + 0.2 * u[t]
    return u[:, None], y[:, None]


@pytest.mark.parametrize("kind", ["answer", "feedthrough"])
def test_steps_tell_a_feedthrough_from_a_controller_that_answers_at_once(kind):
    answers = kind == "answer"
    for rng in map(np.random.default_rng, range(5)):
        found = find_feedback(records_of(within_the_sample(rng, kind)))
        assert found.instantaneous and found.answered == answers
        assert min(found.p_direct, found.p_answer) < 1e-8
        found = find_feedback(records_of(within_the_sample(rng, kind, steps=False)))
        assert found.instantaneous and not found.answered


@pytest.mark.parametrize("kind", ["answer", "feedthrough"])
def test_an_input_beside_a_controller_does_not_hide_its_answers(kind):
    for rng in map(np.random.default_rng, range(5)):
        u, y = within_the_sample(rng, kind, n_samples=2000)
        free = np.repeat(rng.choice([-1.0, 1.0], (250, 1)), 8, axis=0)
        y = np.hstack([y, 0.5 * y + free + 0.3 * rng.standard_normal(y.shape)])
        found = find_feedback(records_of((np.hstack([free, u]), y)))
        assert found.instantaneous and not found.answered  # which is no proof
        assert found.may_be_answered == (kind == "answer")


@pytest.mark.slow
def test_lines_within_the_sample_are_hardly_refuted_by_chance():
    p = []
    for rng in map(np.random.default_rng, range(60)):
        found = find_feedback(records_of(within_the_sample(rng, "feedthrough")))
        p.append(found.p_direct)
        found = find_feedback(records_of(within_the_sample(rng, "answer")))
        p.append(found.p_answer)
    assert min(p) > 1e-4 and np.mean(np.array(p) < 0.05) < 0.1


def test_a_few_spikes_tell_nothing_of_what_acts_within_the_sample():
    """They may be no moves of the input: nothing answers them."""
    u, y = within_the_sample(np.random.default_rng(0), "feedthrough")
    u[[100, 400, 700]] = 60.0
    assert not find_feedback(records_of((u, y))).answered


def test_units_and_order_of_channels_do_not_matter():
    rng = np.random.default_rng(3)
    u, y = closed_loop(rng, 800)
    more = np.hstack([u, rng.standard_normal(u.shape)])
    found = find_feedback([Record.of(more, y)])
    mixed = find_feedback([Record.of(more @ [[0.0, 1e5], [2.0, 1.0]], 1e-4 * y)])
    assert_allclose(mixed.p_value, found.p_value, rtol=1e-5)
    assert_allclose(mixed.share, found.share, rtol=1e-6)
    assert_allclose(mixed.innovations, 1e-8 * found.innovations, rtol=1e-8)


def test_constants_of_the_experiments_are_no_feedback():
    """Nor do they hide it."""
    rng = np.random.default_rng(5)
    loops = [closed_loop(rng, 600) for _ in range(3)]
    for pairs in (loops, [open_loop(rng, 600, "coloured") for _ in range(3)]):
        moved = [(u + 3.0 * k, y - 5.0 * k) for k, (u, y) in enumerate(pairs)]
        scale = [(u / 4.0, y / 6.0) for u, y in pairs]
        first, other = (
            find_feedback([Record.of(u, y) for u, y in data]) for data in (scale, moved)
        )
        assert_allclose(other[:3], first[:3], rtol=1e-6)
        assert first.found == (pairs is loops)


@pytest.mark.parametrize("seed", range(4))
def test_a_nonlinearity_is_no_feedback(seed):
    """Not even where inputs that are held, or swept, follow from the past."""
    rng = np.random.default_rng(seed)
    u, y = open_loop(rng, 6000, "held")
    walk = np.clip(np.cumsum(0.2 * rng.standard_normal((6000, 1)), axis=0), -2.0, 2.0)
    smooth = lfilter([0.0, 0.3], [1.0, -0.7], walk + 0.5 * np.abs(walk), axis=0)
    smooth = smooth + 1e-2 * rng.standard_normal(smooth.shape)
    bent = np.clip(y, -y.std(), y.std())
    assert not find_feedback(records_of((u, bent))).found
    assert not find_feedback(records_of((walk, smooth))).found


@pytest.mark.parametrize("seed", range(4))
def test_spikes_on_two_channels_are_no_feedback(seed):
    rng = np.random.default_rng(seed)
    u = np.repeat([0.0, 1.0, 0.0, 1.0], 250)[:, None]
    y = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
    y += 0.02 * rng.standard_normal(y.shape)
    at = rng.choice(900, 6, replace=False)
    y[at] -= 0.8
    u[at + 1] -= 1.0
    assert not find_feedback(records_of((u, y))).found


def test_a_controller_that_answers_at_once_is_found_whatever_its_reference():
    """Of a binary one, which the input tells of nonlinearly, and so of the noise."""
    rng = np.random.default_rng(0)
    r = rng.choice([-1.0, 1.0], 150).repeat(20)
    u, y, x = np.zeros((3000, 1)), np.zeros((3000, 1)), 0.0
    for t, e in enumerate(0.1 * rng.standard_normal(3000)):
        y[t] = x + e
        u[t] = 2.0 * (r[t] - y[t])
        x = 0.9 * x + 0.1 * u[t, 0]
    found = find_feedback(records_of((u, y)))
    assert found.found and found.instantaneous


@pytest.mark.parametrize("seed", range(2))
def test_kicks_of_a_derivative_do_not_hide_feedback(seed):
    """A levitation, double pole at +-30, held by a PID that steps of a reference kick.

    Inputs of the same kind tell nothing of the noise of a plant that they do not know.
    """
    rng = np.random.default_rng(seed)
    r = (rng.choice([-1.0, 1.0], 8) * rng.uniform(0.3, 1.0, 8)).repeat(250)
    a, b = np.cosh(0.06), np.sinh(0.06)
    A, B = np.array([[a, b], [b, a]]), np.array([a - 1.0, b]) / 9.0
    u, y, x = np.zeros((2000, 1)), np.zeros((2000, 1)), np.zeros(2)
    total = derived = last = after = 0.0
    for t, e in enumerate(0.002 * rng.standard_normal(2000)):
        y[t] = x[0] + e
        error = r[t] - y[t, 0]
        total += 2.16 * error
        derived = 0.1 * derived + 650.0 * (error - last)
        u[t], last, after = after, error, 95.0 * error + total + derived
        x = A @ x + B * u[t]
    assert np.abs(y).max() < 10.0
    short = u[:9], y[:9]  # has no sample with all that the test needs
    assert find_feedback(records_of((u, y), short)).found
    other = lfilter([0.0, 0.1], [1.0, -0.9], u, axis=0)
    other += 0.002 * other.std() * rng.standard_normal(u.shape)
    assert not find_feedback(records_of((u, other))).found


@pytest.mark.parametrize("at_once", [False, True])
def test_inputs_of_a_loop_may_follow_from_the_past(at_once):
    """Of a reference of a sine, which two samples foresee: not of one with noise."""
    rng = np.random.default_rng(0)
    for size in (0.0, 0.02):
        u, y, x = np.zeros((2000, 1)), np.zeros((2000, 1)), 0.0
        r = np.sin(0.1 * np.arange(2000)) + size * rng.standard_normal(2000)
        for t, e in enumerate(0.1 * rng.standard_normal(2000)):
            y[t] = x + e
            u[t] = r[t] - 0.5 * y[t if at_once else t - 1]
            x = 1.02 * x + 0.3 * u[t, 0]
        records = records_of((u, y))
        assert find_feedback(records).foreseen == (size == 0.0)
    assert not find_feedback(records_of(open_loop(rng, 400, "held"))).foreseen


def test_there_may_be_nothing_to_test():
    rng, t = np.random.default_rng(0), np.arange(500)[:, None]
    sine = np.sin(0.8 * t)  # known from two samples
    e = 0.1 * rng.standard_normal(sine.shape)
    assert find_feedback(records_of((sine, np.cumsum(e, axis=0)))).p_value == 1.0
    u = rng.standard_normal((500, 1))
    exact = find_feedback(records_of((u, lfilter([1.0, 0.5], [1.0, -0.5], u, axis=0))))
    assert exact.p_value == 1.0 and exact.innovations < 1e-10
    assert find_feedback([Record.of(u, 0.0 * u)]).p_value == 1.0
    assert find_feedback(records_of((u[:20], u[:20] + 1.0))) is None


def test_a_past_that_is_cut_off_tells_of_feedback_beyond_doubt_only():
    """Short records of a system whose memory is longer than they can carry."""
    rng, suspected = np.random.default_rng(11), 0
    for _ in range(100):
        found = find_feedback(records_of(open_loop(rng, 60, "held", order=5, pole=0.8)))
        assert not found.found
        suspected += found.p_value < 1e-4
    assert suspected > 0
    r, e = rng.standard_normal((2, 80)) * [[0.1], [1.0]]
    u, y = np.zeros((80, 1)), np.zeros((80, 1))
    for t in range(1, 80):
        y[t] = 0.5 * u[t - 1] + e[t] + (0.8 * y[t - 6] if t > 6 else 0.0)
        u[t] = r[t] - 0.8 * y[t - 1]
    found = find_feedback(records_of((u, y)))
    assert found.cut_off and found.found
    with pytest.warns(UserWarning) as told:
        assert SubspaceLTI(1, horizon=3).fit(u, y).method_ == "po-moesp"
    assert "too few for the past that method='pbsid'" in str(told[0].message)


def test_the_past_is_as_long_as_the_memory():
    rng = np.random.default_rng(2)
    u, e = rng.standard_normal((2, 4000, 1))
    y = lfilter([1.0], [1.0, 0.0, 0.0, 0.0, -0.6], u + e, axis=0)
    records = records_of((u, y))
    assert past_window(records, 1, 20, np.array([True])) in (4, 5)
    assert past_window(records, 6, 20, np.array([True])) == 6
    assert longest_past(records_of((u[:20], y[:20])), 400) == 1
    assert longest_past(records, 40) == 20


def test_an_output_that_repeats_others_makes_no_number_invalid():
    rng = np.random.default_rng(0)
    with np.errstate(all="raise"):
        for _ in range(5):
            u, y = open_loop(rng, 500, "white")
            twice = find_feedback(records_of((u, np.hstack([y, y]))))
            assert np.isfinite(twice.p_value) and not twice.found


@pytest.mark.parametrize("seed", [38, 206])
def test_chance_within_the_sample_is_no_answer_to_outputs(seed):
    """Held inputs of pieces, of which the past is short: half a per cent were."""
    rng = np.random.default_rng(seed)
    plant = StateSpace([[1.6, -0.8], [1, 0]], [[1], [0]], [[0.2, 0.1]], None, 1.0)
    hold = int(rng.integers(2, 9))
    u = np.sign(rng.standard_normal((3000 // hold + 1, 1))).repeat(hold, 0)[:3000]
    y = plant.simulate(u)
    y += 0.03 * y.std() * rng.standard_normal(y.shape)
    kept = np.flatnonzero(rng.random(3000) > 0.01)
    pieces = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
    records = [Record.of(u[k], y[k] / y.std(), 1) for k in pieces if len(k) > 2]
    assert not find_feedback(records).found


@pytest.mark.slow
def test_means_over_samples_know_the_next_inputs():
    """As of pandas' resample().mean(), of inputs that move meanwhile; not in a loop."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 1000), rng.integers(40, 300, 1000))
    u = u[:40_000]
    y = lfilter([0.0, 0.01], [1.0, -0.99], u)
    y += 0.02 * y.std() * rng.standard_normal(len(u))
    means = pd.DataFrame({"u": u, "y": y}).groupby(np.arange(len(u)) // 25).mean()
    with pytest.warns(UserWarning) as told:
        SubspaceLTI(sampling_time=1.0).fit(means[["u"]], means["y"])
    assert any("Or samples are means" in str(warning.message) for warning in told)
    x, before, table = 0.0, 0.0, []
    for reference in np.repeat(rng.uniform(-1.0, 1.0, 80), 20):
        force = reference - before
        before = x + 0.1 * rng.standard_normal()
        table.append((force, before))
        x = 0.8 * x + 0.3 * force
    forces, outputs = np.hsplit(np.array(table), 2)
    with pytest.warns(UserWarning) as told:
        SubspaceLTI(sampling_time=1.0).fit(forces, outputs)
    messages = " ".join(str(warning.message) for warning in told)
    assert "from a closed loop" in messages and "are means" not in messages
