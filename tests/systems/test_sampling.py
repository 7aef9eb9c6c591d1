"""Continuous to discrete time and back."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, expm
from scipy.signal import cont2discrete

from lpvlearn import StateSpace
from lpvlearn.systems.sampling import (
    _expm,
    c2d_foh,
    c2d_tustin,
    d2c_held,
    d2c_tustin,
    sample_foh,
    sample_zoh,
)


def jordan(pole, size):
    return pole * np.eye(size) + np.diag(np.ones(size - 1), 1)


def system(A, seed=0, n_inputs=2, n_outputs=2, similar=True):
    """Random B, C, D for given poles, in a random basis."""
    rng, n = np.random.default_rng(seed), len(A)
    T = np.linalg.qr(rng.normal(size=(n, n)))[0] if similar else np.eye(n)
    T = T * rng.uniform(0.5, 2, n)
    B, C = rng.normal(size=(n, n_inputs)), rng.normal(size=(n_outputs, n))
    return T @ A @ np.linalg.inv(T), B, C, rng.normal(size=(n_outputs, n_inputs))


def markov(A, B, C, count=15):
    """Impulse response at the sampling instants."""
    out, X = [], B
    for _ in range(count):
        out.append(C @ X)
        X = A @ X
    return np.array(out)


# Continuous state matrices with a principal logarithm at 0.1 s
CONTINUOUS = {
    "distinct": np.diag([-1.0, -2.0, -7.0]),
    "oscillating": block_diag([[-0.1, 20], [-20, -0.1]], -3.0),
    "integrator": np.diag([0.0, -1.0]),
    "double integrator": block_diag(jordan(0.0, 2), -1.0),
    "triple integrator": jordan(0.0, 3),
    "repeated": -2.0 * np.eye(3),
    "Jordan block": block_diag(jordan(-2.0, 3), -1.0),
    "unstable": np.diag([1.5, -2.0]),
    "time scales": np.diag([-1e-6, -1e-3, -1.0, -100.0]),
}


@pytest.mark.parametrize("name", CONTINUOUS)
@pytest.mark.parametrize("similar", [True, False])
def test_zoh_is_undone_by_the_logarithm(name, similar):
    A, B, C, D = system(CONTINUOUS[name], similar=similar)
    A2, B2, C2, D2, _ = d2c_held(*sample_zoh(A, B, 0.1), C, D, 0.1)
    # a pole that decays to 5e-5 within a sample has lost these digits
    tol = 1e-8 if name == "time scales" else 1e-10
    assert_allclose(A2, A, atol=tol * np.abs(A).max())
    assert_allclose(B2, B, atol=tol * np.abs(B).max() * max(1, np.abs(A).max()))
    assert_allclose(C2, C)
    assert_allclose(D2, D)


@pytest.mark.parametrize("name", CONTINUOUS)
@pytest.mark.parametrize("similar", [True, False])
def test_ramps_are_undone_by_the_logarithm(name, similar):
    A, B, C, D = system(CONTINUOUS[name], similar=similar)
    found = d2c_held(*c2d_foh(A, B, C, D, 0.1), 0.1, "foh")
    tol = 1e-8 if name == "time scales" else 1e-10
    for own, expected in zip(found, (A, B, C, D), strict=False):
        size = np.abs(expected).max() * max(1, np.abs(A).max())
        assert_allclose(own, expected, atol=tol * size)


def test_ramps_are_those_of_scipy():
    A, B, C, D = system(CONTINUOUS["oscillating"])
    expected = cont2discrete((A, B, C, D), 0.1, method="foh")
    for own, other in zip(c2d_foh(A, B, C, D, 0.1), expected, strict=False):
        assert_allclose(own, other, atol=1e-13)


def test_inputs_that_are_ramps_are_answered_exactly():
    """As ten thousand steps of a hold answer them, and inputs that stay as a hold."""
    A, B, _, _ = system(CONTINUOUS["distinct"])
    Ad, B0, B1 = sample_foh(A, B, 0.1)
    held = sample_zoh(A, B, 0.1)
    assert_allclose(Ad, held[0], atol=1e-15)
    assert_allclose(B0, held[1], atol=1e-15)
    n, x = 10_000, np.zeros((3, 2))
    F, G = sample_zoh(A, B, 0.1 / n)
    for k in range(n):
        x = F @ x + G * (k + 0.5) / n
    assert_allclose(B1, x, atol=1e-9)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_zoh_is_that_of_scipy(name):
    A, B, C, D = system(CONTINUOUS[name])
    Ad, Bd, *_ = cont2discrete((A, B, C, D), 0.1, method="zoh")
    for found, expected in zip(sample_zoh(A, B, 0.1), (Ad, Bd), strict=True):
        assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize("name", CONTINUOUS)
def test_tustin_is_that_of_scipy_and_is_undone(name):
    A, B, C, D = system(CONTINUOUS[name])
    sampled = c2d_tustin(A, B, C, D, 0.1)
    expected = cont2discrete((A, B, C, D), 0.1, method="bilinear")[:4]
    for found, other in zip(sampled, expected, strict=True):
        assert_allclose(found, other, atol=1e-12 * np.abs(other).max())
    for found, other in zip(d2c_tustin(*sampled, 0.1), (A, B, C, D), strict=True):
        assert_allclose(found, other, atol=1e-10 * np.abs(other).max())


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    order=st.integers(1, 6),
    dt=st.floats(-3, 0).map(lambda e: 10.0**e),
)
def test_round_trips_of_random_models(seed, order, dt):
    rng = np.random.default_rng(seed)
    poles = -rng.uniform(0.05, 2.5, order) / dt
    A, B, C, D = system(np.diag(poles) + np.diag(rng.normal(size=order - 1), 1), seed)
    model = StateSpace(A, B, C, D)
    omega = np.array([0.0, 0.1, 1.0]) / dt
    G = model.frequency_response(omega)
    for method in ("zoh", "tustin"):
        with (
            warnings.catch_warnings()
        ):  # Tustin may put a real pole on the negative axis
            warnings.simplefilter("error")
            back = model.to_discrete(dt, method).to_continuous(method)
        error = np.abs(back.frequency_response(omega) - G).max()
        assert error <= 1e-7 * np.abs(G).max()


def test_tustin_warps_frequencies():
    model, dt = StateSpace(*system(CONTINUOUS["oscillating"])), 0.1
    omega = np.array([0.0, 1.0, 5.0, 20.0, 31.0])
    warped = 2 / dt * np.tan(omega * dt / 2)
    assert_allclose(
        model.to_discrete(dt, "tustin").frequency_response(omega),
        model.frequency_response(warped),
        rtol=1e-9,
    )


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_fast_sampling_tends_to_the_continuous_model(method):
    model = StateSpace(*system(CONTINUOUS["oscillating"]))
    errors = [
        np.abs(
            model.to_discrete(dt, method).frequency_response([3.0])
            - model.frequency_response([3.0])
        ).max()
        for dt in (1e-2, 1e-3)
    ]
    # the hold delays by half a sample: first order; Tustin is of second order
    assert errors[1] < errors[0] * (0.12 if method == "zoh" else 0.012)


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_stability_is_kept(method):
    for pole in (-3.0, -0.01, 0.01, 3.0):
        model = StateSpace(pole, 1, 1)
        assert model.to_discrete(0.1, method).is_stable == model.is_stable


def test_badly_scaled_inputs_do_not_spoil_the_exponential():
    A, B, *_ = system(CONTINUOUS["distinct"])
    units = np.array([1e9, 1e-9])
    Ad, Bd = sample_zoh(A, B * units, 0.1)
    expected_A, expected_B = sample_zoh(A, B, 0.1)
    assert_allclose(Ad, expm(0.1 * A), atol=1e-14)
    assert_allclose(Ad, expected_A, atol=1e-15)
    assert_allclose(Bd / units, expected_B, atol=1e-15)


@pytest.mark.parametrize(
    "A, extra",
    [
        (np.diag([-0.5, 0.3, 0.9]), 1),
        (np.diag([-0.5, -0.2, 0.9]), 2),
        (-0.5 * np.eye(2), 2),
        (np.diag([-0.5]), 1),
        (np.diag([-1.0, 1.0]), 1),
        (block_diag(jordan(-0.5, 2), 0.7), 2),
        (block_diag(jordan(-0.5, 3), [[0.7, 0.2], [-0.2, 0.7]]), 3),
        (block_diag(-0.5, jordan(1.0, 2)), 1),
    ],
)
@pytest.mark.parametrize("similar", [True, False])
def test_poles_on_the_negative_axis_keep_the_sampled_response(A, extra, similar):
    A, B, C, D = system(A, similar=similar)
    model = StateSpace(A, B, C, D, 0.1)
    with pytest.warns(RuntimeWarning, match="negative real axis"):
        continuous = model.to_continuous()
    assert continuous.order == len(A) + extra
    assert np.abs(continuous.poles().imag).max() == pytest.approx(np.pi / 0.1, rel=1e-3)
    back = continuous.to_discrete(0.1)
    expected = markov(A, B, C)
    found = markov(back.A, back.B, back.C)
    assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())
    # the states keep their meaning, the extra ones start at rest
    x0 = np.arange(1.0, len(A) + 1)
    u = np.random.default_rng(0).normal(size=(40, 2))
    y = model.simulate(u, initial_state=x0)
    again = back.simulate(u, initial_state=np.append(x0, np.zeros(extra)))
    assert_allclose(again, y, atol=1e-10 * np.abs(y).max())


@pytest.mark.parametrize(
    "A",
    [
        np.diag([0.0, 0.5]),
        np.diag([1e-12, 0.5]),
        block_diag(jordan(0.0, 2), 0.5),
        block_diag(jordan(0.0, 3), 0.5),
        np.zeros((1, 1)),
    ],
)
def test_a_pole_at_the_origin_has_no_logarithm(A):
    A, B, C, D = system(A)
    model = StateSpace(A, B, C, D, 0.1)
    with pytest.raises(ValueError, match="pure delay.*'tustin'"):
        model.to_continuous()
    assert_allclose(
        model.to_continuous("tustin").to_discrete(0.1, "tustin").A, A, atol=1e-12
    )


def test_faint_poles_that_are_not_zero_are_converted():
    A, B, C, D = system(np.diag([1e-5, 0.5]))
    Ac, Bc, *_ = d2c_held(A, B, C, D, 1.0)
    assert_allclose(np.sort(np.linalg.eigvals(Ac)), np.log([1e-5, 0.5]), rtol=1e-9)
    assert_allclose(sample_zoh(Ac, Bc, 1.0)[0], A, atol=1e-14)


@pytest.mark.parametrize("A", [np.diag([-1.0, 0.5]), jordan(-1.0, 2)])
def test_tustin_has_no_inverse_at_minus_one(A):
    A, B, C, D = system(A)
    with pytest.raises(ValueError, match="needs poles away from -1"):
        d2c_tustin(A, B, C, D, 0.1)


def test_tustin_has_no_image_of_the_pole_two_over_dt():
    with pytest.raises(ValueError, match="2 / sampling_time = 20 rad/s"):
        StateSpace(np.diag([20.0, -1.0]), np.ones((2, 1)), np.ones((1, 2))).to_discrete(
            0.1, "tustin"
        )


def test_units_of_the_states_do_not_matter():
    A, B, C, D = system(block_diag(jordan(0.9, 2), -0.4, 0.2))
    units = 10.0 ** np.array([-6.0, 6.0, 0.0, 3.0])
    scaled = units[:, None] * A / units, units[:, None] * B, C / units
    a, b, c, _, doubled = d2c_held(*scaled, D, 0.1)
    assert_allclose(doubled, [-0.4])
    expected = markov(A, B, C)
    found = markov(*sample_zoh(a, b, 0.1), c)
    assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())
    ill = d2c_tustin(*scaled, D, 0.1)
    well = d2c_tustin(A, B, C, D, 0.1)
    assert_allclose(ill[0] * units / units[:, None], well[0], rtol=1e-8, atol=1e-9)
    assert_allclose(ill[3], well[3], rtol=1e-9)


def test_continuous_models_pass_to_continuous_unchanged():
    model = StateSpace(-1, 1, 1)
    assert model.to_continuous() is model


# -- exponentials ----------------------------------------------------------------


def normwise(found, expected):
    return np.abs(found - expected).max() / max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-3, 0.2, 0.3, 1.0, 10.0, 60.0])
def test_exponentials_are_those_of_scipy(size):
    M = size * np.random.default_rng(0).normal(size=(20, 5, 5))
    expected = np.array([expm(m) for m in M])
    for found, other in zip(_expm(M), expected, strict=True):
        assert normwise(found, other) <= 1e-13 * max(1.0, 10 * size)


def test_exponentials_in_one_batch_may_differ_in_size():
    rng = np.random.default_rng(1)
    M = rng.normal(size=(9, 4, 4)) * np.logspace(-6, 1, 9)[:, None, None]
    single = np.array([_expm(m) for m in M])
    assert_allclose(_expm(M), single, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("fast", [1e3, 1e6, 1e9])
def test_slow_modes_keep_their_digits_beside_fast_ones(fast):
    slow = np.array([-1e-3, -0.5, 0.2])
    # not triangular: of such matrices scipy's exponential keeps 5 to 9 digits less
    V = np.array([[0, 0, 1.0, 1], [1, 0, 0, 1], [0, 0, 0, 1], [0, 1, 0, 1]])
    M = V @ np.diag([*slow, -fast]) @ np.linalg.inv(V)
    expected = V @ np.diag([*np.exp(slow), 0.0]) @ np.linalg.inv(V)
    assert_allclose(_expm(M), expected, atol=2e-15)


def test_semigroup_property():
    M = np.random.default_rng(2).normal(size=(4, 4))
    assert_allclose(_expm(M) @ _expm(-M), np.eye(4), atol=1e-12)
    assert_allclose(_expm(2 * M), _expm(M) @ _expm(M), rtol=1e-11)


def test_empty_batches_have_empty_exponentials():
    assert _expm(np.zeros((0, 3, 3))).shape == (0, 3, 3)
    assert _expm(np.zeros((2, 0, 0))).shape == (2, 0, 0)


def test_zoh_of_a_stack_is_the_integral():
    rng = np.random.default_rng(3)
    A, B, dt = rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3, 2)), 0.3
    Ad, Bd = sample_zoh(A, B, dt)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for k in range(7):
        assert_allclose(Ad[k], expm(A[k] * dt), atol=1e-13)
        times = 0.5 * dt * (nodes + 1)
        held = sum(
            0.5 * dt * w * expm(A[k] * t) for w, t in zip(weights, times, strict=True)
        )
        assert_allclose(Bd[k], held @ B[k], atol=1e-13)


def test_overflow_is_told():
    with pytest.raises(ValueError, match=r"must be short.*Got 1 s.*1e\+06 rad/s"):
        sample_zoh(np.array([[1e6]]), np.ones((1, 1)), 1.0)
