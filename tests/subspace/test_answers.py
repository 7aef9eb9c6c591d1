"""Inputs that a controller makes of the outputs alone are told, and no others."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI
from lpvlearn.subspace.closed_loop.answers import _steps, answering_input

# numerator and denominator of the controller's law
LAWS = {
    "P": ([2.0], [1.0]),
    "PI": ([2.0, -1.95], [1.0, -1.0]),
    "PID": ([2.5, -2.95, 0.5], [1.0, -1.0]),
    "a sample later": ([0.0, 2.0, -1.95], [1.0, -1.0]),
}


def regulated(law="PI", *, seed=0, n_samples=1000, digits=None, dither=0.0):
    """A first-order plant that a disturbance moves about a constant set-point."""
    (b, a), rng = LAWS[law], np.random.default_rng(seed)
    e, w, v = rng.standard_normal((3, n_samples)) * [[0.05], [0.05], [dither]]
    u, y, x = np.zeros(n_samples), np.zeros(n_samples), 0.0
    for t in range(n_samples):
        y[t] = x + e[t]
        u[t] = v[t] - sum(gain * y[t - k] for k, gain in enumerate(b) if k <= t)
        u[t] -= sum(c * u[t - k] for k, c in enumerate(a) if 0 < k <= t)
        x = 0.95 * x + 0.1 * u[t] + w[t]
    u, y = u[:, None] + 40.0, y[:, None] + 300.0
    if digits == "single":
        return u.astype(np.float32).astype(float), y.astype(np.float32).astype(float)
    return (u, y) if digits is None else (u.round(digits), y.round(digits))


def inputs(kind, rng, n):
    white = rng.standard_normal(n)
    made = {
        "white": lambda: white,
        "slow": lambda: lfilter([1.0], [1.0, -0.95], white),
        "slower": lambda: lfilter([0.1], [1.0, -1.8, 0.82], white),
        "held": lambda: np.repeat(white, 5)[:n],
        "levels": lambda: np.where(rng.random(n) < 0.1, -1.0, 1.0).cumprod(),
        "sines": lambda: sum(np.sin(w * np.arange(n) + w) for w in (0.1, 0.23, 0.5)),
    }
    return made[kind]()


@pytest.mark.parametrize("digits", [None, "single", 5, 4, 3, 2])
@pytest.mark.parametrize("law", LAWS)
def test_answers_are_found_for_what_they_are(law, digits):
    for seed in range(3):
        u, y = regulated(law, seed=seed, digits=digits)
        assert answering_input([(u, y)]) == 0
        halves = [(u[:400], y[:400]), (u[400:] + 7.0, y[400:])]
        assert answering_input(halves) == 0


def test_one_of_several_inputs_may_answer_one_of_several_outputs():
    u, y = regulated()
    rng = np.random.default_rng(9)
    other, more = rng.standard_normal((2, len(u), 1))
    assert answering_input([(np.hstack([other, u]), np.hstack([more, y]))]) == 1


@pytest.mark.parametrize("dither", [0.01, 0.3])
def test_a_dither_is_no_answer(dither):
    assert answering_input([regulated(dither=dither)]) is None


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("direct", [0.0, 1.0])
@pytest.mark.parametrize("digits", [None, 2])
def test_inputs_in_open_loop_are_no_answers(noise, direct, digits):
    rng = np.random.default_rng(3)
    for kind in ("white", "slow", "slower", "held", "levels", "sines"):
        u = inputs(kind, rng, 1000)
        u = u / u.std()
        y = lfilter([direct, 0.3, 0.1], [1.0, -1.2, 0.5], u)
        y = y + noise * rng.standard_normal(1000)
        pair = u[:, None], y[:, None]
        if digits is not None:
            pair = pair[0].round(digits), pair[1].round(digits)
        assert answering_input([pair]) is None, kind


@pytest.mark.broad
@pytest.mark.parametrize("digits", [None, 2])
@pytest.mark.parametrize("options", [{}, {"method": "pbsid"}, {"feedthrough": False}])
def test_the_fit_tells_that_the_model_is_the_controllers(options, digits):
    u, y = regulated(digits=digits)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        SubspaceLTI(1, **options).fit(u, y)
    texts = [str(one.message) for one in told]
    assert sum("is likely that of the controller, inverted" in t for t in texts) == 1
    assert sum("closed loop" in t for t in texts) == 0


@pytest.mark.slow
def test_parts_that_a_disturbance_moves_are_said_to_tell_little():
    rng, n = np.random.default_rng(0), 1500
    u, y, x = np.zeros(n), np.zeros(n), 0.0
    w, e, v = rng.standard_normal((3, n)) * [[0.5], [0.05], [0.3]]
    for t in range(n):
        y[t] = x + e[t]
        u[t] = v[t] - 2.0 * y[t] - 0.05 * y[:t].sum()
        x = 0.95 * x + 0.1 * (u[t] + w[t])
    text = "use method='pbsid', feedthrough=False.*Parts held out hardly tell"
    with pytest.warns(UserWarning, match=text):
        SubspaceLTI().fit(u[:, None], y[:, None])


@pytest.mark.parametrize("n_samples", [150, 300, 1000])
def test_a_white_input_of_few_samples_is_designed(n_samples):
    for seed in range(20):
        u = np.random.default_rng(seed).standard_normal((n_samples, 1))
        assert answering_input([(u, 3.0 * u)]) is None


def test_too_few_samples_tell_no_law():
    u, y = regulated(n_samples=30)
    assert answering_input([(u, y)]) is None


def test_small_units_are_no_rounding():
    """Metres for micrometres: all moves are far less than a decimal."""
    signal = np.random.default_rng(0).standard_normal((300, 1))
    assert _steps([1e-6 * signal]) == _steps([signal]) == [0.0]
    (twelfth,) = _steps([np.round(1e-3 * signal.cumsum(axis=0), 4)])
    np.testing.assert_allclose(twelfth, 1e-8 / 12.0)
