"""The nu-gap: its definition on a grid, limit cases, invariances."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.stats import ortho_group

from lpvlearn import StateSpace, gap

from ..conftest import stable_model

RATES = (-3.0, -0.5, 0.0, 0.1, 2.0)


def chordal(G1, G2, omega):
    """Largest distance over frequencies, by the definition."""

    def inverse_root(M):
        values, vectors = np.linalg.eigh(M)
        return vectors / np.sqrt(values)[:, None] @ vectors.conj().swapaxes(1, 2)

    a, b = G1.frequency_response(omega), G2.frequency_response(omega)
    left = inverse_root(np.eye(b.shape[1]) + b @ b.conj().swapaxes(1, 2))
    right = inverse_root(np.eye(a.shape[2]) + a.conj().swapaxes(1, 2) @ a)
    return np.linalg.norm(left @ (b - a) @ right, 2, axis=(1, 2)).max()


def turns(G1, G2, omega):
    """How often det(I + G2* G1) goes around zero, over the whole axis."""
    a, b = G1.frequency_response(omega), G2.frequency_response(omega)
    loop = np.eye(a.shape[2]) + b.conj().swapaxes(1, 2) @ a
    phase = np.unwrap(np.angle(np.linalg.det(loop)))
    return round((phase[-1] - phase[0]) / np.pi)


def n_unstable(model):
    poles = model.poles()
    return int((poles.real > 0 if model.is_continuous else abs(poles) > 1).sum())


def any_model(rng, dt, n_inputs, n_outputs):
    n = int(rng.integers(0, 6))
    A = rng.normal(size=(n, n))
    if dt:
        A *= rng.uniform(0.5, 1.3) / np.abs(np.linalg.eigvals(A)).max(initial=0.1)
    B, C = rng.normal(size=(n, n_inputs)), rng.normal(size=(n_outputs, n))
    return StateSpace(A, B, C, rng.normal(size=(n_outputs, n_inputs)), dt)


def transposed(G):
    return StateSpace(G.A.T, G.C.T, G.B.T, G.D.T, G.sampling_time)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [None, 0.5])
def test_gap_is_its_definition(dt):
    rng, n_apart = np.random.default_rng(3), 0
    omega = np.append(0.0, np.geomspace(1e-5, 1e5, 800))
    omega = omega if dt is None else np.linspace(0, np.pi / dt, 800)
    for _ in range(12):
        n_inputs, n_outputs = rng.integers(1, 4, 2)
        G1, G2 = (any_model(rng, dt, n_inputs, n_outputs) for _ in range(2))
        if n_apart > 2:  # a neighbour instead: two strangers are 1 apart
            A = G1.A + 0.01 * rng.normal(size=G1.A.shape)
            G2 = StateSpace(A, G1.B, G1.C, G1.D, dt)
        winds = turns(G1, G2, omega) == n_unstable(G1) - n_unstable(G2)
        expected = chordal(G1, G2, omega) if winds else 1.0
        found = gap(G1, G2)
        n_apart += found == 1.0
        assert_allclose(found, expected, rtol=2e-3, atol=1e-12)
        assert found >= expected * (1 - 1e-9)
        assert_allclose(gap(G2, G1), found, atol=1e-10)
        assert_allclose(gap(transposed(G1), transposed(G2)), found, atol=1e-10)
        assert_allclose(gap(G1, G1), 0.0, atol=1e-10)
    assert n_apart > 2


@pytest.mark.parametrize("a", RATES)
@pytest.mark.parametrize("b", RATES)
def test_lags_stable_or_not(a, b):
    """1 / (s + a) and 1 / (s + b) are farthest apart at rest."""
    at_rest = abs(a - b) / np.sqrt((a * a + 1) * (b * b + 1))
    expected = at_rest if a * b > -1 else 1.0
    assert_allclose(
        gap(StateSpace(-a, 1, 1), StateSpace(-b, 1, 1)), expected, atol=1e-9
    )


def test_matlabs_example():
    """1 / (s - 0.001), unstable, and 1 / (s + 0.001): gapmetric says 0.0020."""
    assert_allclose(
        gap(StateSpace(1e-3, 1, 1), StateSpace(-1e-3, 1, 1)), 2e-3, rtol=1e-5
    )


@pytest.mark.parametrize("n", [1, 2])
def test_chains_of_integrators(n):
    A, B, C = np.eye(n, k=1), np.eye(n)[:, [-1]], np.eye(n)[[0]]
    one, other = StateSpace(A, B, C), StateSpace(A, B, 3 * C)
    assert_allclose(gap(one, other), 0.5, rtol=1e-9)


def test_static_gains():
    one, two = (StateSpace([], [], [], [[gain]]) for gain in (1.0, 2.0))
    assert_allclose(gap(one, two), 1 / np.sqrt(10), rtol=1e-12)
    assert gap(two, StateSpace([], [], [], [[-0.5]])) == 1.0  # orthogonal lines


@pytest.mark.parametrize("rate", [1e-6, 1.0, 1e6])
def test_units_of_time_do_not_matter(rate):
    one, other = (stable_model(0, feedthrough=True), stable_model(1, feedthrough=True))
    fast = [
        StateSpace(rate * G.A, rate * G.B, G.C, G.D)
        for G in (one, other.transform(np.diag([1e-6, 1.0, 1e3, 1e6])))
    ]
    assert_allclose(gap(*fast), gap(one, other), rtol=1e-7)


def test_small_and_large_gains():
    """Of small gains it is their difference; of large ones that of the inverses."""
    one, other, unstable = (StateSpace(-rate, 1, 1) for rate in (1, 2, -1))
    for size, expected in ((1e-6, [0.5e-6, 1.0]), (1e6, [1e-6, 2e-6])):
        models = [StateSpace(G.A, size * G.B, G.C) for G in (one, other, unstable)]
        found = [gap(models[0], G) for G in models[1:]]
        assert_allclose(found, expected, rtol=1e-5)


def test_rotations_of_channels_do_not_matter():
    one, other = stable_model(0), stable_model(1)
    U, V = ortho_group.rvs(2, random_state=0, size=2)
    turned = [StateSpace(G.A, G.B @ U, V @ G.C) for G in (one, other)]
    assert_allclose(gap(*turned), gap(one, other), rtol=1e-9)


def test_bilinear_sampling_does_not_matter():
    one, other = stable_model(0), stable_model(1, rate=2.0)
    sampled = [G.to_discrete(0.1, "tustin") for G in (one, other)]
    assert_allclose(gap(*sampled), gap(one, other), rtol=1e-8)


def test_triangle_inequality():
    a, b, c = (stable_model(seed, rate=0.2) for seed in range(3))
    assert gap(a, c) <= gap(a, b) + gap(b, c) + 1e-12


def test_delays():
    G1, G2 = stable_model(0), stable_model(1)
    late = [G.with_input_delay([0.3, 0.0]) for G in (G1, G2)]
    assert gap(*late) == gap(G1, G2)
    with pytest.raises(ValueError, match="same `input_delay` in continuous time"):
        gap(late[0], G2)
    D1 = StateSpace(0.5, 1, 1, sampling_time=1.0)
    D2 = D1.with_input_delay(1)
    assert_allclose(gap(D1, D2), gap(D1, D2.absorb_delay()), rtol=1e-12)
    poles_at_minus_one = StateSpace([[0, 1], [-1, 0]], [[0], [1]], [[1, 0]], None, 1.0)
    assert 0 < gap(StateSpace(-1, 1, 1, sampling_time=1.0), D1) <= 1
    assert_allclose(gap(poles_at_minus_one, poles_at_minus_one), 0, atol=1e-9)


def test_hidden_states():
    """Stable ones count for nothing; unstable ones have no stabilising feedback."""
    hidden = StateSpace([[-1, 0], [0, -3]], [[1], [0]], [[1, 1]])
    assert_allclose(gap(hidden, StateSpace(-1, 1, 1)), 0, atol=1e-9)
    seen = StateSpace(-1, 1, 1)
    swing = np.array([[0.0, 2.0], [-2.0, 0.0]])
    for block in (3 * np.eye(1), np.zeros((1, 1)), swing):
        n = len(block)
        A = block_diag(-1, block)
        reached, shown = np.ones((n + 1, 1)), np.ones((1, n + 1))
        lost = np.eye(n + 1)[:, :1]
        for hidden in (StateSpace(A, lost, shown), StateSpace(A, reached, lost.T)):
            for pair in ((hidden, hidden), (hidden, seen), (seen, hidden)):
                with pytest.raises(ValueError, match="feedback stabilises"):
                    gap(*pair)


def test_models_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="`G2` must be a StateSpace"):
        gap(stable_model(0), 1.0)
    with pytest.raises(ValueError, match="same inputs, outputs and sampling"):
        gap(stable_model(0), stable_model(0, n_inputs=1))


def test_poles_that_are_hardly_to_be_told_apart():
    """Unstable ones side by side: exact, or refused where rounding hides them."""

    def model(n, feedthrough):
        A, ones = np.diag(np.linspace(1, 2, n)), np.ones((n, 1))
        return StateSpace(A, ones, ones.T, [[feedthrough]])

    expected = 1e-3 / np.hypot(1.0, 1e-3)  # at infinity
    assert_allclose(gap(model(6, 0.0), model(6, 1e-3)), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="feedback stabilises"):
        gap(model(12, 0.0), model(12, 1e-3))


def test_lost_digits_are_told_of(monkeypatch):
    monkeypatch.setattr(sys.modules["lpvlearn.models.gap"], "_LOST", -1.0)
    with pytest.warns(UserWarning, match="so hard to stabilise"):
        gap(stable_model(0), stable_model(1))
