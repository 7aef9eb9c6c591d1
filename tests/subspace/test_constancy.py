"""Systems that change over their record are told, and noise is not."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI

STEP, N = 0.05, 2000


def plant(stiffness=25.0):
    A, B = [[0.0, 1.0], [-stiffness, -1.0]], [[0.0], [25.0]]
    return StateSpace(A, B, [[1.0, 0.0]]).to_discrete(STEP)


def record(change):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], N // 4), 4)[:, None]
    y = change(u)
    return u, y + 0.02 * y.std() * rng.standard_normal(y.shape)


def varying(u, stiffness):
    """Outputs of a plant whose stiffness is another at every sample."""
    x, y = np.zeros(2), np.zeros((N, 1))
    for k in range(N):
        y[k], now = x[0], plant(stiffness(k))
        x = now.A @ x + now.B[:, 0] * u[k]
    return y


CHANGES = {
    "half-way": lambda u: varying(u, lambda k: 25.0 if k < N // 2 else 40.0),
    "slowly": lambda u: varying(u, lambda k: 25.0 + 15.0 * k / N),
    "sensor": lambda u: plant().simulate(u) * np.linspace(1.0, 2.0, N)[:, None],
}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "po-moesp"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_system_that_changes_is_told(change, method):
    u, y = record(CHANGES[change])
    with pytest.warns(UserWarning, match="changes over the record.*8 parts leave"):
        SubspaceLTI(method=method, sampling_time=STEP).fit(u, y)


@pytest.mark.broad
@pytest.mark.parametrize("pole", [0.0, 0.9, 0.99, 1.0])
def test_noise_is_no_change(pole):
    """Slow noise is followed by trends and initial states of parts."""
    u, y = record(plant().simulate)
    rng = np.random.default_rng(1)
    noise = lfilter([1.0], [1.0, -pole], rng.standard_normal(y.shape), axis=0)
    y = y + noise / noise.std() * 0.5 * y.std()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI(sampling_time=STEP).fit(u, y)
    assert model.residual_ > 0.02
    assert not [w for w in caught if "changes over" in str(w.message)]


@pytest.mark.parametrize("bend", [lambda u: np.clip(u, -0.4, 0.4), lambda u: u**3])
def test_an_input_that_bends_is_no_noise_that_moves_the_plant(bend):
    """Whatever method is taken for that."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, N // 4), 4)[:, None]
    y = plant().simulate(bend(u))
    y = y + 0.02 * y.std() * rng.standard_normal(y.shape)
    with pytest.warns(UserWarning, match="follow squares or cubes"):
        SubspaceLTI(sampling_time=STEP).fit(u, y)


@pytest.mark.broad
@pytest.mark.parametrize("initial_state", ["estimate", "rest"])
def test_parts_begin_in_mid_motion_whatever_the_record_does(initial_state):
    """Slow poles: what moves from before is most of a part."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 80), 15)[:, None]
    gain = np.where(np.arange(len(u)) < 600, 1.0, 2.5)[:, None]
    y = lfilter([0.0, 0.02], [1.0, -0.98], gain * u, axis=0)
    y = y + 0.05 * y.std() * rng.standard_normal(y.shape)
    with pytest.warns(UserWarning, match="changes over the record"):
        SubspaceLTI(initial_state=initial_state).fit(u, y)
