"""Systems that bend are told of, and no noise makes a linear one seem to."""

import warnings

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.subspace.evidence.linearity import _large_changes, find_bend

from ..conftest import modes, spring_tables
from .test_residuals import coloured


@pytest.mark.parametrize(
    "bend, sensor",
    [
        (lambda u: np.tanh(1.5 * u), lambda y: y),
        (lambda u: u + 0.3 * u**2, lambda y: y),
        (lambda u: u - np.clip(u, -0.5, 0.5), lambda y: y),
        (lambda u: u, lambda y: np.sqrt(y + 4.0)),
    ],
)
def test_a_fit_tells_that_a_system_is_not_linear(bend, sensor):
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-2.0, 2.0, (80, 1)), 5, axis=0)
    system = StateSpace(modes(0.9 + 0.2j), [[0.0], [1.0]], [[0.3, 0.0]], [[0.0]], 1.0)
    y = sensor(system.simulate(bend(u)))
    y += 0.05 * y.std() * rng.standard_normal(y.shape)
    with pytest.warns(UserWarning, match="of output 1 follow squares or cubes"):
        SubspaceLTI(2, method="po-moesp", horizon=12, offset="constant").fit(u, y)


def behind_play(signal, radius):
    place, places = signal[0], []
    for value in signal:
        place = min(max(place, value - radius), value + radius)
        places.append(place)
    return np.array(places)


@pytest.mark.broad
@pytest.mark.parametrize("at_input", [True, False])
@pytest.mark.parametrize("smooth", [True, False])
def test_a_fit_tells_of_backlash(at_input, smooth):
    rng = np.random.default_rng(7)
    u = rng.standard_normal((800, 1))
    if smooth:
        u = lfilter([0.3], [1.0, -0.95], u, axis=0)
    system = StateSpace(modes(0.9 + 0.2j), [[0.0], [1.0]], [[0.3, 0.0]], [[0.0]], 1.0)
    if at_input:
        y = system.simulate(behind_play(u, 0.4))
    else:
        y = system.simulate(u)
        y = behind_play(y, 0.15 * y.std())
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    with pytest.warns(UserWarning, match="of output 1 follow the direction"):
        SubspaceLTI(3, offset=None).fit(u, y)


def at_limited_rate(signal, rate):
    place, places = 0.0, []
    for value in signal:
        place += min(max(value - place, -rate), rate)
        places.append(place)
    return np.array(places)


def told_of(u, y):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        SubspaceLTI(2, offset=None).fit(u, y)
    return [str(one.message) for one in told]


@pytest.mark.broad
@pytest.mark.parametrize("rate", [0.05, 0.15])
@pytest.mark.parametrize("pole", [0.9 + 0.2j, 0.7 + 0.1j])
def test_a_fit_tells_of_an_actuator_of_limited_rate(rate, pole):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1.0, 1.0, 50), 40)
    system = StateSpace(modes(pole), [[0.0], [1.0]], [[0.3, 0.0]], [[0.0]], 1.0)
    y = system.simulate(at_limited_rate(u, rate)[:, None])
    y += 0.02 * y.std() * rng.standard_normal(y.shape)
    bent = [message for message in told_of(u[:, None], y) if "1 follow" in message]
    assert len(bent) == 1 and "large changes" in bent[0] and "slew rate" in bent[0]


def test_of_two_levels_a_limited_rate_is_as_linear_as_any():
    rng = np.random.default_rng(3)
    levels = rng.choice([-1.0, 1.0], (2_000, 1))
    moves = _large_changes(levels, 25)
    lags = [np.roll(levels, k, axis=0) for k in (0, 1, 4, 16)]
    left = np.linalg.lstsq(np.hstack(lags)[16:], moves[16:])[1]
    assert (left < 1e-20 * np.sum(moves**2)).all()
    u = np.repeat(rng.choice([-1.0, 1.0], (50, 1)), 40, axis=0)
    system = StateSpace(modes(0.9 + 0.2j), [[0.0], [1.0]], [[0.3, 0.0]], [[0.0]], 1.0)
    y = system.simulate(at_limited_rate(u[:, 0], 0.1)[:, None])
    y += 0.02 * y.std() * rng.standard_normal(y.shape)
    assert not any("of output 1 follow" in message for message in told_of(u, y))


def mass_on_a_spring(force, pushes_back, n_steps=6):
    """Positions of a mass with a resonance at 0.7 rad, and 3 % of damping."""
    x, v, omega, places = 0.0, 0.0, 0.706, []
    for f in force:
        places.append(x)
        for _ in range(n_steps):
            a = omega**2 * (f - pushes_back(x)) - 0.06 * omega * v
            v += a / n_steps
            x += v / n_steps
    return np.array(places)


def record_of_a_spring(seed, level, pushes_back):
    rng = np.random.default_rng(seed)
    u = level * lfilter(*butter(6, 0.65), rng.standard_normal(1_500))
    y = mass_on_a_spring(u, pushes_back)
    return u[:, None], y + 0.005 * y.std() * rng.standard_normal(len(y))


def stiffens(x):
    return x + 3.0 * x**3


def has_two_wells(x):
    return -x + 3.0 * x**3


@pytest.mark.broad
@pytest.mark.parametrize(
    "pushes_back, level, seed",
    [(stiffens, 0.5, 0), (stiffens, 1.5, 1), (has_two_wells, 0.3, 0)],
)
def test_of_what_no_linear_model_explains_the_bend_is_told(pushes_back, level, seed):
    u, y = record_of_a_spring(seed, level, pushes_back)
    with pytest.warns(UserWarning, match="explains .* cubes .* is not linear"):
        SubspaceLTI().fit(u, y)


@pytest.mark.broad
@pytest.mark.parametrize("level, seed", [(0.015, 0), (0.05, 1), (0.1, 3)])
def test_a_spring_that_stiffens_is_not_taken_for_friction(level, seed):
    with pytest.warns(UserWarning, match="follows? squares or cubes"):
        SubspaceLTI(2).fit(*record_of_a_spring(seed, level, stiffens))


def test_hysteresis_may_be_by_size_or_direction():
    rng = np.random.default_rng(0)
    u, x, v, z, y = 0.5 * rng.standard_normal(2_000), 0.0, 0.0, 0.0, []
    u = lfilter(*butter(4, 0.2), 3.0 * u)
    for f in u:
        y.append(x)
        for _ in range(20):  # Bouc and Wen
            v += 0.02 * (f - x - 0.1 * v - z)
            x += 0.02 * v
            z += 0.02 * (v - 0.8 * abs(v) * z - 0.2 * v * abs(z))
    y = np.array(y) + 0.003 * np.std(y) * rng.standard_normal(len(y))
    with pytest.warns(UserWarning, match="or, about as well"):
        SubspaceLTI(3).fit(u[:, None], y)


@pytest.mark.filterwarnings("ignore:The model explains next to nothing")
def test_noise_that_is_not_gaussian_bends_no_linear_system():
    """Behind a zero outside the unit circle its powers tell of what comes."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u, e = rng.standard_normal((1_000, 1)), rng.exponential(size=(1_000, 1)) - 1.0
        e = lfilter([-0.6, 1.0], [1.0, -0.6], e, axis=0)
        y = lfilter([0.0, 0.2], [1.0, -0.8], u, axis=0) + e
        assert find_bend(SubspaceLTI(1, horizon=8).fit(u, y)._evidence) is None


@pytest.mark.broad
@pytest.mark.parametrize("noise", ["t", "AR(.99)", "by the output", "walk"])
def test_no_noise_makes_a_linear_system_seem_bent(noise):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.exponential(size=(160, 1)), 5, axis=0)
        y = lfilter([0.0, 0.2], [1.0, -0.8], u, axis=0)
        e = {
            "t": rng.standard_t(4.0, y.shape),
            "AR(.99)": coloured(rng, len(y), 0.99),
            "by the output": rng.standard_normal(y.shape) * (0.3 + y),
            "walk": rng.standard_normal(y.shape).cumsum(axis=0),
        }[noise]
        y += 0.2 * y.std() / e.std() * e
        SubspaceLTI(1, horizon=8, offset="constant").fit(u, y)  # silently


@pytest.mark.filterwarnings("ignore:Experiment.s. 2")  # at another operating point
def test_experiments_of_other_linear_systems_are_not_bent():
    X, y = spring_tables(noise=1e-3, n_samples=60, kappas=(0.0, 0.75, 1.5))
    model = SubspaceLTI(2, method="po-moesp", horizon=5, refine=False, offset=None)
    model.set_params(inputs="force", experiment="run", time="time").fit(X, y)
    assert find_bend(model._evidence) is not None  # as of one system
    assert find_bend(model._evidence, apart=True) is None
