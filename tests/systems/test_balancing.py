"""Gramians, Hankel singular values, balanced realisations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, solve_continuous_lyapunov, solve_discrete_lyapunov

from lpvlearn import StateSpace
from lpvlearn.models.statespace import balanced_models
from lpvlearn.systems.balancing import (
    align_signs,
    balancing_transformation,
    gramian_factor,
    in_even_units,
)

from ..conftest import stable_model


def random_model(seed, *shape, discrete=False):
    return stable_model(seed, *shape, sampling_time=0.1 if discrete else None)


def gramians(model):
    """Controllability and observability Gramian, by scipy."""
    A, B, C = model.A, model.B, model.C
    if model.is_continuous:
        W = solve_continuous_lyapunov(A, -B @ B.T)
        return W, solve_continuous_lyapunov(A.T, -C.T @ C)
    return solve_discrete_lyapunov(A, B @ B.T), solve_discrete_lyapunov(A.T, C.T @ C)


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 10**6),
    order=st.integers(1, 8),
    n_inputs=st.integers(1, 3),
    discrete=st.booleans(),
)
def test_factor_solves_the_lyapunov_equation(seed, order, n_inputs, discrete):
    model = random_model(seed, order, n_inputs, discrete=discrete)
    A, B = model.A, model.B
    L = gramian_factor(A, B, discrete)
    W = L @ L.T
    left = A @ W @ A.T - W if discrete else A @ W + W @ A.T
    size = np.abs(W).max() * max(1.0, np.abs(A).max()) + np.abs(B).max() ** 2
    assert np.abs(left + B @ B.T).max() <= 1e-12 * size


@pytest.mark.parametrize("discrete", [False, True])
def test_models_are_balanced_together_as_one_by_one(discrete):
    models = [random_model(seed, 5, 2, 3, discrete=discrete) for seed in range(4)]
    for model, together in zip(models, balanced_models(models), strict=True):
        alone = model.balance()
        for name in "ABC":
            one, other = getattr(alone, name), getattr(together, name)
            assert_allclose(other, one, rtol=1e-10, atol=1e-12 * np.abs(one).max())


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("order", [1, 3, 6])
def test_balanced_gramians_are_equal_and_diagonal(order, discrete):
    model = random_model(order, order, discrete=discrete)
    balanced = model.balance()
    hankel = model.hankel_singular_values()
    for W in gramians(balanced):
        assert_allclose(W, np.diag(hankel), atol=1e-11 * hankel[0])
    omega = np.array([0.0, 0.3, 2.0, 11.0])
    assert_allclose(
        balanced.frequency_response(omega),
        model.frequency_response(omega),
        atol=1e-11 * hankel[0],
    )


@pytest.mark.parametrize("discrete", [False, True])
def test_hankel_values_are_roots_of_the_product_of_gramians(discrete):
    model = random_model(0, 4, discrete=discrete)
    W, M = gramians(model)
    expected = np.sqrt(np.sort(np.linalg.eigvals(W @ M).real)[::-1])
    assert_allclose(model.hankel_singular_values(), expected, rtol=1e-9)


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 10**6),
    discrete=st.booleans(),
    exponents=st.lists(st.floats(-6, 6), min_size=4, max_size=4),
)
def test_hankel_values_do_not_depend_on_the_units_of_states(seed, discrete, exponents):
    model = random_model(seed, discrete=discrete)
    T = np.diag(10.0 ** np.array(exponents))
    expected = model.hankel_singular_values()
    found = model.transform(T).hankel_singular_values()
    assert_allclose(found, expected, rtol=1e-9, atol=1e-11 * expected[0])


def test_hankel_values_do_not_depend_on_the_basis():
    model, rng = random_model(1, 5), np.random.default_rng(1)
    expected = model.hankel_singular_values()
    found = model.transform(rng.normal(size=(5, 5))).hankel_singular_values()
    assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * expected[0])


def test_time_scales_from_1e_minus_6_to_1e6():
    rates = 10.0 ** np.arange(-6, 7, 3)
    model = StateSpace(
        np.diag(-rates), np.sqrt(rates)[:, None], np.sqrt(rates)[None, :]
    )
    balanced = model.balance()
    assert balanced.order == 5
    omega = 10.0 ** np.arange(-7, 8)
    # the balanced states mix all rates, and 1e-6 beside 1e6 keeps few digits
    assert_allclose(
        balanced.frequency_response(omega), model.frequency_response(omega), rtol=1e-3
    )
    # slow and fast parts hardly see one another: each alone has the value 1/2
    assert_allclose(model.hankel_singular_values(), 0.5, rtol=0.14)


def test_channels_from_1e_minus_6_to_1e6():
    model = random_model(4, 4)
    units = np.diag([1e-6, 1e6])
    scaled = StateSpace(model.A, model.B @ units, units @ model.C)
    assert_allclose(
        scaled.balance().frequency_response([0.5])[0],
        units @ model.frequency_response([0.5])[0] @ units,
        rtol=1e-5,
        atol=1e-11,
    )


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("order", [1, 4, 7])
def test_states_without_input_or_output_are_dropped(order, discrete):
    model, rng = random_model(order, order, discrete=discrete), np.random.default_rng(0)
    hidden = np.diag([0.3, 0.6]) if discrete else np.diag([-1.0, -0.3])
    A = block_diag(model.A, hidden)
    A[:order, order:] = rng.normal(size=(order, 2))  # seen, but never excited
    B = np.vstack([model.B, np.zeros((2, 2))])
    C = np.hstack([model.C, rng.normal(size=(2, 2))])
    T = rng.normal(size=A.shape)
    larger = StateSpace(A, B, C, None, model.sampling_time).transform(T)
    hankel = larger.hankel_singular_values()
    assert len(hankel) == order + 2 and (hankel[order:] < 1e-13 * hankel[0]).all()
    for side in (larger, StateSpace(larger.A.T, larger.C.T, larger.B.T, None, 0.1)):
        if side is larger or discrete:
            assert side.balance().order == order
    omega = np.array([0.0, 1.0, 9.0])
    assert_allclose(
        larger.balance().frequency_response(omega),
        model.frequency_response(omega),
        atol=1e-10 * hankel[0],
    )


@pytest.mark.parametrize("kept", [0, 1, 2, 3])
@pytest.mark.parametrize("discrete", [False, True])
def test_truncation_error_is_within_twice_the_tail(kept, discrete):
    model = random_model(6, 5, discrete=discrete)
    reduced, hankel = model.balance(kept), model.hankel_singular_values()
    assert reduced.order == kept and reduced.is_stable
    error = (model - reduced).hinf_norm()
    assert hankel[kept] * (1 - 1e-9) <= error <= 2 * hankel[kept:].sum() * (1 + 1e-9)


def test_a_model_without_any_response_has_order_zero():
    silent = StateSpace(-np.eye(2), np.zeros((2, 1)), np.ones((1, 2)), [[3.0]])
    assert silent.balance().order == 0
    assert silent.balance(1).dc_gain() == 3.0
    assert_allclose(silent.hankel_singular_values(), 0.0)


def test_no_states_have_even_units_in_silence(capfd):
    even, units = in_even_units(np.zeros((0, 0)))
    assert even.shape == (0, 0) and units.shape == (0,)
    assert capfd.readouterr() == ("", "")


def test_balancing_twice_changes_nothing():
    once = random_model(3).balance()
    twice = once.balance()
    for name in "ABC":
        assert_allclose(getattr(twice, name), getattr(once, name), atol=1e-9)


def test_projections_are_inverse_to_each_other():
    model = random_model(2, 6)
    _, left, right = balancing_transformation(model.A, model.B, model.C, False)
    assert_allclose(left @ right, np.eye(6), atol=1e-10)


def test_repeated_poles_and_lightly_damped_modes():
    jordan = np.diag(-np.ones(4)) + np.diag(np.ones(3), 1)
    light = np.array([[-1e-9, 10.0], [-10.0, -1e-9]])
    model = StateSpace(block_diag(jordan, light), np.ones((6, 1)), np.ones((1, 6)))
    balanced = model.balance()
    omega = np.array([0.0, 1.0, 30.0])
    # the peak is 1e9 high; what lies 1e-10 below it is near the limit of rounding
    size = model.hankel_singular_values()[0]
    error = balanced.frequency_response(omega) - model.frequency_response(omega)
    assert np.abs(error).max() < 1e-12 * size
    assert balanced.poles().real.max() == pytest.approx(-1e-9, rel=1e-3)


@pytest.mark.parametrize(
    "A, discrete",
    [([[1.0]], False), ([[0.0]], False), ([[1.0]], True), ([[-2.0]], True)],
)
def test_unstable_models_have_no_gramian(A, discrete):
    with pytest.raises(
        ValueError, match="stable, beyond rounding, for a Gramian. Got a pole"
    ):
        gramian_factor(np.array(A), np.ones((1, 1)), discrete)


def test_signs_are_aligned_with_the_reference():
    rng = np.random.default_rng(0)
    B, C = rng.normal(size=(5, 2)), rng.normal(size=(3, 5))
    signs = np.array([1.0, -1.0, -1.0, 1.0, -1.0])
    found = align_signs(signs[:, None] * B, C * signs, B, C)
    assert_allclose(found, signs)
    assert_allclose(align_signs(B, C, B, C), 1.0)
