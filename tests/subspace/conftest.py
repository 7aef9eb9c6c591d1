"""Systems and records that the subspace rooms are tested with."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import linalg

from lpvlearn import SubspaceLTI
from lpvlearn.subspace.orders import identification
from lpvlearn.subspace.samples.records import scale_records
from lpvlearn.subspace.simulation_error.simulation_fit import Freedom
from lpvlearn.subspace.streams import stream as stream_module
from lpvlearn.subspace.streams import stream_summary as summary_module
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes

POLES = (0.9 * np.exp(0.4j), 0.97 * np.exp(1.3j), 0.7, 0.95)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def example(rng, A, n_inputs=2, n_outputs=2):
    n = len(A)
    mix = np.linalg.qr(rng.standard_normal((n, n)))[0]
    B, C = rng.standard_normal((n, n_inputs)), rng.standard_normal((n_outputs, n))
    return mix @ A @ mix.T, B, C, rng.standard_normal((n_outputs, n_inputs))


def experiment(rng, system, n_samples=300, x0=None, noise=0.0):
    u = rng.standard_normal((n_samples, system[1].shape[1]))
    y = lti_response(*system, u, x0)
    return u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape)


def markov(A, B, C, D, n=30):
    out = [D]
    power = B
    for _ in range(n):
        out.append(C @ power)
        power = A @ power
    return np.array(out)


def sorted_poles(A):
    return np.sort_complex(np.linalg.eigvals(A).round(12))


@pytest.fixture(scope="session")
def system():
    """A, B, C and D of order 5, two inputs, two outputs."""
    rng = np.random.default_rng(5)
    A = modes(0.95 * np.exp(0.5j), 0.9 * np.exp(1.4j), 0.8)
    shapes = (5, 2), (2, 5), (2, 2)
    return (A, *(rng.standard_normal(s) for s in shapes))


def record(system, n_samples, seed=0, noise=0.1):
    """Inputs and noisy outputs of a system from rest."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, system[1].shape[1]))
    y = lti_response(*system, u)
    return u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape)


def freedom(n_outputs, n_inputs):
    """All initial states and all of D."""
    return Freedom(np.ones((n_outputs, n_inputs), dtype=bool))


class Found(NamedTuple):
    """A model in the units of the data, and what is known of it."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    initial_states: np.ndarray
    singular_values: np.ndarray
    residual: float


def identify(pairs, order, horizon, *, feedthrough=True, **options):
    """The function core of `SubspaceLTI`, on samples that are not scaled yet."""
    records, su, sy = scale_records(pairs)
    free = Freedom(np.full((len(sy), len(su)), feedthrough))
    settings = identification.Settings(free, **options)
    found = identification.identify(records, order, horizon, settings)
    A, B, C, D, x0 = found.model[:5]
    C, D = sy[:, None] * C, sy[:, None] * D / su
    return Found(A, B / su, C, D, x0, found.singular_values, found.residual)


# A lightly damped plant, and how the innovations drive its states.
LOOP_PLANT = (
    np.array([[1.5, -0.7], [1.0, 0.0]]),
    np.array([[1.0], [0.0]]),
    np.array([[0.5, 0.3]]),
    np.zeros((1, 1)),
)
LOOP_GAIN = np.array([0.8, 0.4])


def closed_loop(
    rng, n_samples, plant=LOOP_PLANT, *, gain=0.4, delay=0, drive=LOOP_GAIN, pole=None
):
    """``u = r - gain y``, y some samples late, under process or coloured noise.

    With a `pole` the noise is of first order and does not drive the plant.
    """
    A, B, C, _ = plant
    r, e = rng.standard_normal((2, n_samples)) * [[1.0], [0.5]]
    x, v, u, y = np.zeros(len(A)), 0.0, np.zeros(n_samples), np.zeros(n_samples)
    for t in range(n_samples):
        v = e[t] if pole is None else pole * v + 0.43 * e[t]
        y[t] = C[0] @ x + v
        u[t] = r[t] - gain * (y[t - delay] if t >= delay else 0.0)
        x = A @ x + B[:, 0] * u[t] + (drive * e[t] if pole is None else 0.0)
    return u[:, None], y[:, None]


def matrices(model):
    return model.lti_.A, model.lti_.B, model.lti_.C, model.lti_.D


def miss(model, plant=LOOP_PLANT):
    """Relative error of the impulse response."""
    truth = markov(*plant, n=100)
    return linalg.norm(markov(*matrices(model), n=100) - truth) / linalg.norm(truth)


def pbsid(order="auto", **options):
    return SubspaceLTI(order, method="pbsid", **options)


def fed(model, u, y, sizes):
    start = 0
    for size in sizes:
        model.partial_fit(u[start : start + size], y[start : start + size])
        start += size
    assert start == len(u)
    return model


@pytest.fixture
def short_buffer(monkeypatch):
    """Summaries from 1000 samples on."""
    monkeypatch.setattr(stream_module, "BUFFER", 1000)


@pytest.fixture
def short_stream(short_buffer, monkeypatch):
    """Stretches of 2000 samples as well, so that tests stay small."""
    monkeypatch.setattr(summary_module, "STRETCH", 2000)


def sweep_of_a_hardening_spring(n, damping, cubic, rates=(1.1, 0.9)):
    """Force and position through the resonance, downwards, and again from above.

    `rates` are those that the sweeps begin and end with, radians per sample.
    """
    t, third = np.arange(n), n // 3
    below = np.interp(t, [0, third], [rates[0], 0.15])
    above = np.interp(t, [third, n], [3.0, rates[1]])
    u, y = 0.04 * np.sin(np.cumsum(np.where(t < third, below, above))), np.empty(n)
    position = speed = 0.0
    for k in range(n):
        y[k] = position
        for _ in range(20):
            force = 0.5625 * (u[k] - position) - 1.5 * damping * speed
            speed += (force - cubic * position**3) / 20.0
            position += speed / 20.0
    return u[:, None], y[:, None]
