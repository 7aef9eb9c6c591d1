"""LPVStateSpace: frozen models and simulation along a trajectory."""

import copy
import pickle
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.chebyshev import chebvander
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from sklearn.base import clone
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV, StateSpace
from lpvlearn.exceptions import DivergenceError, ExtrapolationWarning
from lpvlearn.lpv import model as model_module
from lpvlearn.lpv.bands import simulation_std
from lpvlearn.systems.sampling import sample_foh

from ..conftest import spring_lpv

DT = 0.05


def spring_structure():
    """A sprung mass with damping, and with the force as a second output."""
    return GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]],
        [[0, 0], ["b", 1]],
        [[1, 0], ["-k", 0]],
        [[0, 0], [1, 0]],
    )


def spring(extrapolation="warn"):
    """Parameters b = 2, c = 0.3 + kappa / 5, k = 4 + 3 kappa + kappa^2."""
    kappa = np.array([[0.0], [1.0], [2.0]])
    theta = np.column_stack(
        [2 + 0 * kappa, 0.3 + 0.2 * kappa, 4 + 3 * kappa + kappa**2]
    )
    interpolator = PolynomialLPV(2, extrapolation=extrapolation).fit(kappa, theta)
    return LPVStateSpace(spring_structure(), interpolator, kappa[[0, 2]])


def two_variables():
    kappa = np.array([[i, j] for i in (0.0, 1.0, 2.0) for j in (-1.0, 0.0, 1.0)])
    theta = np.column_stack(
        [1 + kappa[:, 1] ** 2, 0.5 + 0.1 * kappa[:, 0], 4 + kappa[:, 0] * kappa[:, 1]]
    )
    interpolator = PolynomialLPV(2).fit(kappa, theta)
    bounds = [kappa.min(0), kappa.max(0)]
    return LPVStateSpace(spring_structure(), interpolator, bounds)


def loop(model, u, kappa, x):
    """Sample by sample, each with its own matrix exponential."""
    y = []
    for uk, at in zip(u, kappa, strict=True):
        local = model.at(at)
        y.append(local.C @ x + local.D @ uk)
        n, m = local.B.shape
        M = np.zeros((n + m, n + m))
        M[:n, :n], M[:n, n:] = local.A, local.B
        E = expm(DT * M)
        x = E[:n, :n] @ x + E[:n, n:] @ uk
    return np.array(y)


def inputs(n_samples, seed=0):
    return np.random.default_rng(seed).normal(size=(n_samples, 2))


def sweep(n_samples):
    return 1 - np.cos(np.linspace(0, 5, n_samples))


@pytest.mark.slow
@pytest.mark.parametrize("n_samples", [1, 2, 20, 700])
def test_simulation_is_the_loop(n_samples):
    model, u, kappa = spring(), inputs(n_samples), sweep(n_samples)
    x0 = np.array([1.0, -2.0])
    expected = loop(model, u, kappa, x0)
    y = model.simulate(u, kappa, DT, x0)
    assert_allclose(y, expected, atol=1e-12 * np.abs(expected).max())


@settings(deadline=None, max_examples=15)
@given(kappa=st.floats(0, 2), n_samples=st.integers(0, 100), seed=st.integers(0, 99))
def test_constant_scheduling_is_the_sampled_model_exactly(kappa, n_samples, seed):
    model, u = spring(), inputs(n_samples, seed)
    x0 = np.array([0.3, -1.0])
    y = model.simulate(u, np.full(n_samples, kappa), DT, x0)
    local = model.at(kappa).simulate(u, sampling_time=DT, initial_state=x0)
    assert y.shape == local.shape
    assert_allclose(y, local, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_noisy_scheduling_is_the_loop():
    model, u = spring("ignore"), inputs(600)
    kappa = sweep(600) + 0.05 * np.random.default_rng(1).normal(size=600)
    expected = loop(model, u, kappa, np.zeros(2))
    y = model.simulate(u, kappa, DT)
    assert_allclose(y, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.slow
def test_scheduling_that_jumps_back_in_time_is_not_reordered():
    model, u, kappa = spring(), inputs(300), sweep(300)
    expected = loop(model, u, kappa[::-1], np.zeros(2))
    assert_allclose(model.simulate(u, kappa[::-1], DT), expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("n_samples", [30, 400])
def test_two_scheduling_variables(n_samples):
    model, u = two_variables(), inputs(n_samples)
    t = np.linspace(0, 3, n_samples)
    kappa = np.column_stack([1 + np.sin(t), np.cos(2 * t)])
    expected = loop(model, u, kappa, np.ones(2))
    assert_allclose(model.simulate(u, kappa, DT, np.ones(2)), expected, atol=1e-12)
    held = np.tile([0.7, -0.4], (n_samples, 1))
    local = model.at([0.7, -0.4]).simulate(u, sampling_time=DT)
    assert_allclose(model.simulate(u, held, DT), local, atol=1e-13)


@pytest.mark.slow
def test_interpolators_that_are_not_smooth():
    kappa = np.linspace(0, 2, 6)[:, None]
    theta = spring().parameters(kappa)
    steps = KNeighborsRegressor(n_neighbors=1).fit(kappa, theta)
    model = LPVStateSpace(spring_structure(), steps, kappa[[0, -1]])
    u, trajectory = inputs(500), sweep(500)
    expected = loop(model, u, trajectory, np.zeros(2))
    assert_allclose(model.simulate(u, trajectory, DT), expected, atol=1e-12)


def test_blocks_of_samples_join_without_a_seam(monkeypatch):
    model, u, kappa = spring(), inputs(500), sweep(500)
    x0 = np.array([1.0, 0.0])
    y, free = model.simulate(u, kappa, DT, x0), model.free_responses(kappa, DT)
    monkeypatch.setattr(model_module, "_BLOCK", 64)
    assert_allclose(model.simulate(u, kappa, DT, x0), y, atol=1e-12)
    assert_allclose(model.free_responses(kappa, DT), free, atol=1e-12)


@pytest.mark.slow
def test_inputs_that_go_on_linearly_are_those_of_many_more_samples(monkeypatch):
    """Held over the middles of these, by which outputs are exact to second order."""
    monkeypatch.setattr(model_module, "_BLOCK", 64)
    model, u, n = about_offsets(hold="foh"), inputs(150), 200
    between = (np.arange(n * 149) + 0.5) / n
    fine = np.column_stack([np.interp(between, np.arange(150), v) for v in u.T])
    kappa = np.full(len(fine), 0.7)
    held = replace(model, hold="zoh")
    expected = held.simulate(fine, kappa, DT / n, [1.0, 0.0])[::n, 0]
    y = model.simulate(u, kappa[:150], DT, [1.0, 0.0])[:149, 0]
    coarse = held.simulate(u, kappa[:150], DT, [1.0, 0.0])[:149, 0]
    assert np.abs(y - expected).max() < 1e-4 * np.abs(coarse - expected).max()


def test_at_a_constant_value_it_is_the_sampled_model_with_ramps():
    model, u = replace(spring(), hold="foh"), inputs(200)
    x0 = np.array([0.3, -1.0])
    sampled = model.at(0.7).to_discrete(DT, "foh")
    start = x0 - sample_foh(model.at(0.7).A, model.at(0.7).B, DT)[2] @ u[0]
    y = model.simulate(u, np.full(200, 0.7), DT, x0)
    assert_allclose(y, sampled.simulate(u, initial_state=start), atol=1e-12)
    free = model.free_responses(np.full(200, 0.7), DT)
    rest = model.simulate(u, np.full(200, 0.7), DT)
    assert_allclose(y, rest + free @ x0, atol=1e-12)
    with pytest.raises(ValueError, match="`hold` must be 'zoh' or 'foh'. Got 'tustin'"):
        replace(model, hold="tustin")


def test_more_samples_than_one_block():
    model, n = spring(), model_module._BLOCK + 1000
    u, kappa = inputs(n), sweep(n)
    y = model.simulate(u, kappa, DT)
    # the state at the seam from the outputs: y1 = position, and one step of the loop
    start = model_module._BLOCK - 500
    x = model.simulate(u[:start], kappa[:start], DT)
    again = model.simulate(u[start:], kappa[start:], DT)
    free = model.free_responses(kappa[start:], DT)
    x0 = np.linalg.lstsq(free.reshape(-1, 2), (y[start:] - again).ravel(), rcond=None)[
        0
    ]
    assert_allclose(free @ x0 + again, y[start:], atol=1e-9 * np.abs(y).max())
    assert_array_equal(x.shape, (start, 2))


@pytest.mark.parametrize("n_samples", [1, 50, 400])
def test_free_responses_are_the_answers_to_an_initial_state(n_samples):
    model, kappa, u = spring(), sweep(n_samples), inputs(n_samples)
    free = model.free_responses(kappa, DT)
    assert free.shape == (n_samples, 2, 2)
    x0 = np.array([2.0, -5.0])
    forced = model.simulate(u, kappa, DT)
    total = model.simulate(u, kappa, DT, x0)
    assert_allclose(forced + free @ x0, total, atol=1e-11)
    assert_allclose(free[0], model.at(kappa[0]).C)


def test_simulation_is_linear_in_input_and_initial_state():
    model, kappa = spring(), sweep(300)
    u, v, x = inputs(300, 0), inputs(300, 1), np.array([1.0, 2.0])
    y = model.simulate(2 * u - v, kappa, DT, 2 * x)
    expected = 2 * model.simulate(u, kappa, DT, x) - model.simulate(v, kappa, DT)
    assert_allclose(y, expected, atol=1e-11)


def test_frozen_models_and_poles():
    model, kappa = spring(), np.linspace(0, 2, 7)
    poles = model.frozen_poles(kappa)
    assert poles.shape == (7, 2)
    for k, row in zip(kappa, poles, strict=True):
        local = model.at(k)
        assert isinstance(local, StateSpace) and local.is_continuous
        assert_allclose(local.A, [[0, 1], [-4 - 3 * k - k**2, -0.3 - 0.2 * k]])
        assert_allclose(row, local.poles())
        # stiffness and damping are the coefficients of the characteristic polynomial
        assert_allclose(np.poly(row).real, [1, 0.3 + 0.2 * k, 4 + 3 * k + k**2])
    assert_allclose(two_variables().at([1.0, 0.5]).A[1], [-4.5, -0.6])


def test_a_pure_gain_may_be_scheduled():
    structure = GrayBoxStructure.observable_canonical(0, 1, 1, feedthrough=True)
    kappa = np.array([[0.0], [1.0]])
    model = LPVStateSpace(structure, PolynomialLPV(1).fit(kappa, [[1.0], [3.0]]), kappa)
    for n in (5, 200):
        u, trajectory = inputs(n)[:, :1], np.linspace(0, 1, n)
        expected = (1 + 2 * trajectory[:, None]) * u
        assert_allclose(model.simulate(u, trajectory, DT), expected, atol=1e-12)
        assert model.free_responses(trajectory, DT).shape == (n, 1, 0)
    assert model.frozen_poles([0.0, 1.0]).shape == (2, 0)


# -- outside of the range --------------------------------------------------------


def test_extrapolation_is_told_once_and_of_the_samples():
    model, u = spring(), inputs(500)
    kappa = np.linspace(0, 2.2, 500)
    with pytest.warns(ExtrapolationWarning, match="of 500 outside") as caught:
        model.simulate(u, kappa, DT)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        spring("ignore").simulate(u, kappa, DT)
    with pytest.raises(ValueError, match="of 500 outside"):
        spring("error").simulate(u, kappa, DT)


def test_the_warning_of_a_nested_interpolator_is_told_once_too():
    model, u = spring(), inputs(500)
    nested = make_pipeline(StandardScaler(with_std=False), PolynomialLPV(2))
    nested.set_params(polynomiallpv__extrapolation="warn")
    points = np.linspace(0, 2, 4)[:, None]
    nested.fit(points, model.parameters(points))
    with pytest.warns(ExtrapolationWarning, match="of 500 outside") as caught:
        replace(model, interpolator=nested).simulate(u, np.linspace(0, 2.2, 500), DT)
    assert len(caught) == 1


@pytest.mark.parametrize("beyond", [1e-4, 0.01, 0.5])
def test_clipped_parameters_stay_clipped(beyond):
    model, u = spring("clip"), inputs(500)
    kappa = np.linspace(0, 2 + beyond, 500)
    expected = model.simulate(u, np.clip(kappa, 0, 2), DT)
    assert_allclose(model.simulate(u, kappa, DT), expected, atol=1e-11)


# -- a value object --------------------------------------------------------------


def test_models_cannot_be_changed():
    model = spring()
    with pytest.raises(AttributeError):
        model.interpolator = None
    with pytest.raises(ValueError, match="read-only"):
        model.scheduling_range[0, 0] = 5.0


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))]
)
def test_copies_and_pickles_simulate_alike(duplicate):
    model, u, kappa = spring(), inputs(50), sweep(50)
    other = duplicate(model)
    assert_array_equal(other.simulate(u, kappa, DT), model.simulate(u, kappa, DT))


def test_repr_tells_the_dimensions():
    text = "LPVStateSpace(order=2, n_inputs=2, n_outputs=2, n_scheduling=1)"
    assert repr(spring()) == text


# -- errors ----------------------------------------------------------------------

U, KAPPA = inputs(10), sweep(10)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda m: m.simulate(U[:, :1], KAPPA, DT), r"`u`.*\(n_samples, 2\)"),
        (lambda m: m.simulate(U * np.nan, KAPPA, DT), "`u` must be finite"),
        (lambda m: m.simulate(U, KAPPA[:9], DT), "each of the 10 samples.*Got 9"),
        (lambda m: m.simulate(U, KAPPA * np.nan, DT), "`scheduling` must be finite"),
        (lambda m: m.simulate(U, np.ones((10, 2)), DT), "must have 1 columns"),
        (lambda m: m.simulate(U, "kappa", DT), "`scheduling` must hold real"),
        (lambda m: m.simulate(U, KAPPA, 0.0), "`sampling_time` must be a positive"),
        (lambda m: m.simulate(U, KAPPA, DT, [1.0]), r"`initial_state`.*\(2,\)"),
        (lambda m: m.free_responses(KAPPA, -1.0), "`sampling_time` must be a positive"),
        (lambda m: m.at([0.0, 1.0]), "`kappa` must be one finite value"),
        (lambda m: m.at(np.nan), "`kappa` must be one finite value"),
        (lambda m: m.frozen_poles([np.inf]), "`scheduling` must be finite"),
    ],
)
def test_wrong_calls_are_explained(call, message):
    with pytest.raises(ValueError, match=message):
        call(spring())


@pytest.mark.parametrize(
    "bounds", [[0.0, 1.0], [[1.0], [0.0]], [[0.0]], [[np.nan], [1.0]], [["a"], ["b"]]]
)
def test_wrong_scheduling_ranges_are_explained(bounds):
    model = spring()
    with pytest.raises(ValueError, match="`scheduling_range` must"):
        LPVStateSpace(model.structure, model.interpolator, bounds)


def root(theta):
    return [[-(np.abs(theta[0]) + theta[0]) / (np.abs(theta[0]) + theta[0])]], 1, 1


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_matrices_that_are_not_finite_are_located():
    structure = GrayBoxStructure.from_function(root, [1.0])
    kappa = np.array([[-1.0], [1.0]])
    model = LPVStateSpace(structure, PolynomialLPV(1).fit(kappa, kappa), kappa)
    with pytest.raises(ValueError, match="finite matrices along `scheduling`.*at"):
        model.simulate(np.ones((10, 1)), np.linspace(1, -1, 10), DT)


def stiffening():
    """Unstable where kappa is negative."""
    structure = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    line = PolynomialLPV(1).fit([[0.0], [1.0]], [[0.0], [1.0]])
    return structure, line


def test_a_diverging_simulation_names_the_frozen_model():
    structure, line = stiffening()
    kappa = np.r_[np.full(100, 0.5), np.full(9000, -2.0)]
    outside = LPVStateSpace(structure, line, [[0.0], [1.0]])
    with pytest.raises(DivergenceError) as raised:
        outside.simulate(np.ones(9100), kappa, 0.1)
    for words in ("beyond all numbers at sample", "[-2.0]", "real part 2 1/s", "clip"):
        assert words in str(raised.value)
    inside = LPVStateSpace(structure, line, [[-2.0], [1.0]])
    with pytest.raises(DivergenceError, match="offset, shuffled rows, or times in"):
        inside.simulate(np.ones(9100), kappa, 0.1)
    with pytest.raises(DivergenceError, match="diverges within one sample of 1000 s"):
        inside.simulate(np.ones(3), np.full(3, -2.0), 1000.0)
    assert np.isfinite(inside.simulate(np.ones(300), kappa[:300], 0.1)).all()


def test_delayed_inputs_are_shifted_inputs():
    rng, plain = np.random.default_rng(0), spring_lpv()
    lpv = replace(plain, input_delay=0.06)
    u, kappa = rng.normal(size=(80, 1)), np.linspace(0, 1.5, 80)
    late = np.vstack([np.zeros((3, 1)), u[:-3]])
    np.testing.assert_array_equal(
        lpv.simulate(u, kappa, 0.02), plain.simulate(late, kappa, 0.02)
    )
    x0 = rng.normal(size=5)  # two states, three inputs in transit
    y = lpv.simulate(u, kappa, 0.02, initial_state=x0)
    free = lpv.free_responses(kappa, 0.02)
    np.testing.assert_allclose(lpv.simulate(u, kappa, 0.02) + free @ x0, y, atol=1e-12)
    frozen = lpv.at(1.0)
    np.testing.assert_array_equal(frozen.input_delay, [0.06])
    constant = lpv.simulate(u, np.ones(80), 0.02)
    np.testing.assert_allclose(
        frozen.simulate(u, sampling_time=0.02), constant, atol=1e-12
    )
    assert "input_delay=[0.06] s" in repr(lpv)
    with pytest.raises(ValueError, match="must divide the input delay"):
        lpv.simulate(u, kappa, 0.025)


# ---------------------------------------------------------------- changes of the basis


def growing(kappa):
    """An invertible T that follows the scheduling variable."""
    return np.array([[1.0, 0.3 * kappa[0]], [np.sin(kappa[0]), 2.0 + kappa[0]]])


def test_a_change_of_basis_changes_no_output():
    model, u, kappa = spring(), inputs(200), sweep(200)
    x0 = np.array([0.3, -1.0])
    changed = model.change_basis(growing)
    y = model.simulate(u, kappa, DT, x0)
    assert_allclose(changed.simulate(u, kappa, DT, growing(kappa[:1]) @ x0), y)
    free = changed.free_responses(kappa, DT)
    expected = model.free_responses(kappa, DT)
    assert_allclose(free @ growing(kappa[:1]), expected, atol=1e-12)
    assert_allclose(changed.frozen_poles(kappa), model.frozen_poles(kappa))


def test_a_change_of_basis_leaves_inputs_in_transit_alone():
    lpv = replace(spring(), input_delay=[3 * DT, DT])
    u, kappa = inputs(60), sweep(60)
    x0, transit = np.array([0.3, -1.0]), np.array([1.0, -2.0, 0.5, 3.0])
    changed = lpv.change_basis(growing)
    moved = np.concatenate([growing(kappa[:1]) @ x0, transit])
    y = lpv.simulate(u, kappa, DT, np.concatenate([x0, transit]))
    assert_allclose(changed.simulate(u, kappa, DT, moved), y)
    forced = changed.simulate(u, kappa, DT)
    assert_allclose(forced + changed.free_responses(kappa, DT) @ moved, y, atol=1e-12)
    for rate in (None, 2.0):
        assert_array_equal(changed.at(1.0, rate=rate).input_delay, lpv.input_delay)


def test_the_model_in_the_new_basis_is_that_of_the_moving_state():
    """``z = T x`` along a trajectory, from the matrices of `at` with a rate."""
    model = spring()
    changed = model.change_basis(growing)
    t, dt = 0.7, 1e-6

    def kappa(t):
        return np.array([1 + np.sin(t)])

    x, u = np.array([0.5, -0.2]), np.array([1.0, 0.4])
    local = model.at(kappa(t))
    ahead, behind = (
        growing(kappa(t + h)) @ (x + h * (local.A @ x + local.B @ u)) for h in (dt, -dt)
    )
    new = changed.at(kappa(t), rate=np.cos(t))
    z = growing(kappa(t)) @ x
    assert_allclose(new.A @ z + new.B @ u, (ahead - behind) / (2 * dt), atol=1e-8)
    assert_allclose(new.C @ z + new.D @ u, local.C @ x + local.D @ u, atol=1e-12)
    at_rest = changed.at(kappa(t))
    assert_allclose(
        at_rest.A, growing(kappa(t)) @ local.A @ np.linalg.inv(growing(kappa(t)))
    )


def test_changes_of_basis_follow_one_another_and_back():
    model = spring()
    T = np.array([[2.0, 1.0], [0.0, 1.0]])
    there = model.change_basis(T).change_basis(growing)
    back = there.change_basis(lambda k: np.linalg.inv(growing(k) @ T))
    assert_allclose(back.at(0.7, rate=2.0).A, model.at(0.7).A, atol=1e-8)
    assert_allclose(
        model.change_basis(T).at(0.7, rate=2.0).A,
        T @ model.at(0.7).A @ np.linalg.inv(T),
    )
    assert pickle.loads(pickle.dumps(model.change_basis(growing))).bases == (growing,)


def test_a_change_of_basis_over_two_variables():
    model = two_variables()

    def T(kappa):
        return np.diag([1.0 + kappa[0], 2.0 + kappa[1] * kappa[0]])

    kappa, rate = np.array([0.5, 0.2]), np.array([3.0, -1.0])
    changed = model.change_basis(T).at(kappa, rate=rate)
    slope = np.diag([rate[0], rate[1] * kappa[0] + kappa[1] * rate[0]])
    expected = (T(kappa) @ model.at(kappa).A + slope) @ np.linalg.inv(T(kappa))
    assert_allclose(changed.A, expected, atol=1e-8)


@pytest.mark.parametrize("T", [np.eye(3), np.ones((2, 2)), lambda k: np.zeros((2, 2))])
def test_what_is_no_basis_is_refused(T):
    with pytest.raises(ValueError):
        spring().change_basis(T)


def test_a_model_of_momenta_follows_newtons_law_while_the_mass_moves():
    """``(m q')' = u - c q' - k q`` integrated; the frozen models do not tell it."""
    kappa = np.array([[0.0], [1.0]])
    mass = PolynomialLPV(1).fit(kappa, 3.0 - 2.0 * kappa)
    t = 0.01 * np.arange(1000)

    def moves(time):
        return 0.5 - 0.5 * np.cos(2.0 * time)

    def law(time, state):
        rate = state[1] / (3.0 - 2.0 * moves(time))
        return [rate, 1.0 - 0.1 * rate - state[0]]

    true = solve_ivp(law, (0, t[-1]), [0, 0], t_eval=t, max_step=0.01, rtol=1e-9).y[0]
    errors = []
    for state in ("rate", "momentum"):
        structure = GrayBoxStructure.mechanical(
            [["m"]], [[0.1]], [[1]], [[1]], state=state
        )
        y = LPVStateSpace(structure, mass, kappa).simulate(
            np.ones(1000), moves(t), 0.01
        )
        errors.append(np.abs(y[:, 0] - true).max() / np.ptp(true))
    assert errors[1] < 0.02 < 0.3 < errors[0]


# ------------------------------------------------------------------ names and ranges


def of_mass_and_speed(extrapolation="ignore"):
    """Two named variables, 0 to 2 and -1 to 1, identified a little beyond."""
    model = two_variables()
    quiet = clone(model.interpolator).set_params(extrapolation=extrapolation)
    points = np.array([[i, j] for i in (0.0, 1.0, 2.0) for j in (-1.0, 0.0, 1.0)])
    return replace(
        model,
        interpolator=quiet.fit(points, model.parameters(points)),
        scheduling_names=["mass", "speed"],
        identified_range=[[-0.1, -1.1], [2.1, 1.1]],
    )


def test_values_go_by_name_in_any_order():
    model, u, t = of_mass_and_speed(), inputs(50), np.linspace(0, 1, 50)
    by_name, by_place = model.at({"speed": 0.5, "mass": 1.5}), model.at([1.5, 0.5])
    assert_array_equal(by_name.A, by_place.A)
    expected = model.simulate(u, np.column_stack([t, -t]), DT)
    named = {"speed": -t, "mass": t}
    assert_array_equal(model.simulate(u, named, DT), expected)
    table = pd.DataFrame(named).assign(other=0.0)
    assert_array_equal(model.simulate(u, table, DT), expected)
    held = model.change_basis(lambda kappa: np.diag([1, 2 + kappa[1]]))
    A = held.at({"speed": 0.5, "mass": 1.5}, rate={"mass": 0.0, "speed": 1.0}).A
    assert_allclose(A, held.at([1.5, 0.5], rate=[0.0, 1.0]).A)


@pytest.mark.parametrize(
    "kappa, words",
    [
        ({"mass": 1.0}, r"the model knows \['mass', 'speed'\]. Got \['mass'\]"),
        ({"mass": 1.0, "sped": 2.0}, r"Got \['mass', 'sped'\]"),
        ({"mass": [1.0, 2.0], "speed": 0.0}, r"as many values .* Got \[2, 1\]"),
        ({"mass": [1.0, 2.0], "speed": [0.0, 1.0]}, "one value of every"),
        ({"mass": np.nan, "speed": 0.0}, "must be finite"),
    ],
)
def test_names_that_do_not_fit_are_refused(kappa, words):
    with pytest.raises(ValueError, match=words):
        of_mass_and_speed().at(kappa)


def test_a_model_without_names_says_so():
    with pytest.raises(ValueError, match="knows no names"):
        spring().at({"kappa": 1.0})
    with pytest.raises(ValueError, match="`scheduling_names` must be a list of 1"):
        replace(spring(), scheduling_names=["mass", "speed"])


@pytest.mark.parametrize("extrapolation", ["ignore", "warn"])
def test_values_out_of_range_are_named_with_their_range(extrapolation):
    model, u = of_mass_and_speed(extrapolation), inputs(50)
    with pytest.warns(ExtrapolationWarning) as caught:
        model.at({"mass": 3.0, "speed": 0.5})
    text = str(caught[0].message)
    assert "'mass' must be within the identified range, -0.1 to 2.1." in text
    assert "farthest at 3:" in text and "'speed'" not in text
    kappa = {"mass": np.linspace(0, 2.5, 50), "speed": np.linspace(-2, 1, 50)}
    with pytest.warns(ExtrapolationWarning) as caught:
        model.simulate(u, kappa, DT)
    assert len(caught) == 1
    text = str(caught[0].message)
    assert "'mass' must be" in text and "8 of 50 samples outside, the farthest" in text
    assert "'speed' must be" in text and "farthest at -2:" in text


def test_what_is_within_the_range_or_held_at_its_border_is_not_told():
    u = inputs(50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of_mass_and_speed("warn").at([2.05, -1.05])
        of_mass_and_speed("clip").at([3.0, 0.0])
        of_mass_and_speed().silenced().at([3.0, 0.0])
        of_mass_and_speed().simulate(u, np.tile([2.05, 0.0], (50, 1)), DT)
    with pytest.raises(ValueError, match="identified range"):
        of_mass_and_speed("error").at([3.0, 0.0])


# ---------------------------------------------------------------------------- offsets


def offsets_of(kappa):
    """Points of work [u0, y0, x0] that follow kappa, (n_points, 6)."""
    k = np.reshape(kappa, (-1, 1))
    one = np.ones_like(k)
    return np.hstack([1 + k, -2 * one, k**2, 3 - k, 0.5 * k, 0.1 * one])


def about_offsets(extrapolation="warn", **changes):
    model, kappa = spring(extrapolation), np.array([[0.0], [1.0], [2.0]])
    offsets = PolynomialLPV(2, extrapolation=extrapolation)
    return replace(model, offsets=offsets.fit(kappa, offsets_of(kappa)), **changes)


def test_offsets_are_those_of_the_regressor_and_zero_without():
    model, kappa = about_offsets(), np.linspace(0, 2, 5)
    u0, y0, x0 = np.split(offsets_of(kappa), 3, axis=1)
    assert_allclose(model.input_offset(kappa), u0, atol=1e-12)
    assert_allclose(model.output_offset(kappa), y0, atol=1e-12)
    assert_allclose(model.state_offset(kappa), x0, atol=1e-12)
    assert "with offsets" in repr(model) and "offsets" not in repr(spring())
    for offset in (spring().input_offset, spring().output_offset):
        assert_array_equal(offset(kappa), np.zeros((5, 2)))
    assert_array_equal(spring().state_offset([1.0]), np.zeros((1, 2)))


@pytest.mark.parametrize("delay", [0, [3 * DT, DT]])
def test_constant_scheduling_is_the_sampled_model_about_the_point_of_work(delay):
    model, u = about_offsets(input_delay=delay), inputs(200)
    u0, y0, x0 = np.split(offsets_of(0.7)[0], 3)
    local = model.at(0.7)
    y = model.simulate(u, np.full(200, 0.7), DT)  # at rest before, inputs too
    assert_allclose(y, y0 + local.simulate(u - u0, sampling_time=DT), atol=1e-12)
    moved = x0 + [1.0, -2.0]
    y = model.simulate(u, np.full(200, 0.7), DT, initial_state=moved)
    deviation = local.simulate(u - u0, sampling_time=DT, initial_state=[1.0, -2.0])
    assert_allclose(y, y0 + deviation, atol=1e-12)


def test_at_rest_nothing_moves():
    model, kappa = about_offsets(input_delay=2 * DT), np.full(300, 1.3)
    y = model.simulate(model.input_offset(kappa), kappa, DT)
    assert_allclose(y, model.output_offset(kappa), atol=1e-12)


@pytest.mark.slow
def test_simulation_about_offsets_is_the_loop():
    model, u, kappa = about_offsets(), inputs(300), sweep(300)
    x, expected = offsets_of(kappa[0])[0, 4:], []
    for uk, k in zip(u, kappa, strict=True):
        u0, y0, x0 = np.split(offsets_of(k)[0], 3)
        local, step = (
            model.at(k),
            expm(DT * np.block([[model.at(k).A, np.eye(2)], [np.zeros((2, 4))]])),
        )
        expected.append(y0 + local.C @ (x - x0) + local.D @ (uk - u0))
        x = step[:2, :2] @ x + step[:2, 2:] @ (local.B @ (uk - u0) - local.A @ x0)
    assert_allclose(model.simulate(u, kappa, DT), expected, atol=1e-11)


def test_offsets_of_zero_change_nothing():
    kappa = np.array([[0.0], [2.0]])
    none = PolynomialLPV(1).fit(kappa, np.zeros((2, 6)))
    model, u, trajectory = spring(), inputs(400), sweep(400)
    y = model.simulate(u, trajectory, DT, [1.0, -1.0])
    zero = replace(model, offsets=none)
    assert_allclose(zero.simulate(u, trajectory, DT, [1.0, -1.0]), y, atol=1e-13)


def test_another_equilibrium_of_the_same_models_is_the_same_system():
    """x0, u0 and y0 may move along the steady states, differently at each kappa."""
    model, u, kappa = about_offsets(), inputs(300), sweep(300)

    class Moved:
        def predict(self, X):
            found = offsets_of(X)
            for row, k in zip(found, X, strict=True):
                local, step = model.at(k), np.array([np.sin(k[0]), 1.0])
                row[:2] += step
                row[2:4] += local.dc_gain() @ step
                row[4:] -= np.linalg.solve(local.A, local.B @ step)
            return found

    x0 = [0.3, 2.0]
    y = replace(model, offsets=Moved()).simulate(u, kappa, DT, x0)
    assert_allclose(y, model.simulate(u, kappa, DT, x0), atol=1e-10)


def test_a_change_of_basis_takes_the_offsets_along():
    model, u, kappa = about_offsets(), inputs(300), sweep(300)
    changed = model.change_basis(growing).change_basis([[0.0, 1.0], [2.0, 0.0]])
    y = model.simulate(u, kappa, DT)
    assert_allclose(changed.simulate(u, kappa, DT), y, atol=1e-12)
    T = np.array([[0.0, 1.0], [2.0, 0.0]]) @ growing(kappa[:1])
    x = model.state_offset(kappa[:1])[0]
    assert_allclose(changed.state_offset(kappa[:1])[0], T @ x, atol=1e-12)
    moved = changed.simulate(u, kappa, DT, T @ (x + [1.0, 2.0]))
    free = model.free_responses(kappa, DT)
    assert_allclose(moved, y + free @ [1.0, 2.0], atol=1e-11)


@pytest.mark.parametrize(
    "make",
    [
        spring,
        about_offsets,
        lambda: replace(spring(), input_delay=[3 * DT, DT]),
        lambda: replace(about_offsets(), input_delay=[3 * DT] * 2),
        lambda: about_offsets().change_basis(growing),
    ],
)
def test_both_responses_come_in_one_pass(make):
    model = make()
    u, kappa = inputs(60)[:, : model.n_inputs], sweep(60)
    rest, free = model.rest_and_free_responses(u, kappa, DT)
    assert_allclose(rest, model.simulate(u, kappa, DT), atol=1e-13)
    assert_allclose(free, model.free_responses(kappa, DT), atol=1e-13)
    start = np.arange(1.0, 1.0 + free.shape[2])
    y = model.simulate(u, kappa, DT, start)
    found = model.estimate_initial_state(u, kappa, y, DT)
    assert_allclose(found, start, atol=1e-9)
    y[5:9, 0] = np.nan
    assert_allclose(model.estimate_initial_state(u, kappa, y, DT), start, atol=1e-9)


def test_what_a_record_does_not_tell_of_its_start_is_at_rest():
    model = about_offsets()
    u, kappa = inputs(60)[:, : model.n_inputs], sweep(60)
    x0 = model.state_offset(kappa[:1])[0]
    none = np.full((60, model.n_outputs), np.nan)
    assert_allclose(model.estimate_initial_state(u, kappa, none, DT), x0, atol=1e-13)
    with pytest.raises(ValueError, match="one row for each of the same samples"):
        model.estimate_initial_state(u, kappa, none[1:], DT)


def test_extrapolated_offsets_are_told_once():
    kappa = np.linspace(0, 2.2, 100)
    with pytest.warns(ExtrapolationWarning) as caught:
        about_offsets().simulate(inputs(100), kappa, DT)
    assert len(caught) == 1


def test_wrong_offsets_are_explained():
    with pytest.raises(ValueError, match="`offsets` must be a fitted regressor"):
        replace(spring(), offsets=3.0)
    model = spring()
    wrong = replace(model, offsets=model.interpolator)
    with pytest.raises(ValueError, match="`offsets` must predict the 6 values"):
        wrong.simulate(inputs(5), sweep(5), DT)


def with_rates(model, N):
    """The model with the rate term N(kappa), a polynomial of degree 2."""
    kappa = np.linspace(0, 2, 3)[:, None]
    entries = np.array([np.ravel(N(k)) for k in kappa[:, 0]])
    return replace(model, rate_terms=PolynomialLPV(2).fit(kappa, entries))


def test_rate_terms_are_those_of_a_change_of_basis():
    """``T' T^-1`` of T = diag(1, exp(kappa)) in A is the constant diag(0, kappa')."""
    model = spring()
    moved = with_rates(model, lambda k: np.diag([0.0, 1.0]))
    assert_allclose(moved.at(0.7).A, model.at(0.7).A)
    difference = moved.at(0.7, rate=3.0).A - model.at(0.7).A
    assert_allclose(difference, np.diag([0.0, 3.0]))
    T = [[0.0, 1.0], [2.0, 0.0]]
    turned = moved.change_basis(T).at(0.7, rate=3.0).A
    assert_allclose(turned, T @ moved.at(0.7, rate=3.0).A @ np.linalg.inv(T))
    assert "with rate terms" in repr(moved)


@pytest.mark.slow
def test_rate_terms_follow_the_trajectory():
    model, kappa, u = spring(), sweep(300), inputs(300)
    moved = with_rates(model, lambda k: [[0.1 * k, 0], [-k, 0.2 * k**2]])
    rates = np.gradient(kappa, DT)
    x, expected = np.array([0.5, -1.0]), []
    for k, rate, uk in zip(kappa, rates, u, strict=True):
        local = moved.at(k, rate=rate)
        expected.append(local.C @ x + local.D @ uk)
        step = local.to_discrete(DT)
        x = step.A @ x + step.B @ uk
    found = moved.simulate(u, kappa, DT, [0.5, -1.0])
    assert_allclose(found, expected, atol=1e-11)
    constant = np.full(300, 0.4)
    assert_allclose(moved.simulate(u, constant, DT), model.simulate(u, constant, DT))
    assert moved.simulate(u[:1], kappa[:1], DT).shape == (1, 2)


def test_wrong_rate_terms_are_explained():
    with pytest.raises(ValueError, match="`rate_terms` must be a fitted regressor"):
        replace(spring(), rate_terms=1.0)
    model = spring()
    wrong = replace(model, rate_terms=model.interpolator)
    with pytest.raises(ValueError, match="`rate_terms` must predict the 1 matrices"):
        wrong.simulate(inputs(5), sweep(5), DT)


def uncertain_spring():
    F = 1e-2 * np.random.default_rng(0).normal(size=(9, 9))
    return replace(spring_lpv(), covariance=F @ F.T)


def test_deviations_of_parameters_are_those_of_the_terms():
    """Of a polynomial, ``phi^T P phi`` for every parameter."""
    lpv = uncertain_spring()
    kappa = np.linspace(-0.2, 1.7, 9)
    phi = chebvander(kappa / 0.75 - 1.0, 2)
    values, std = lpv.parameters(kappa, return_std=True)
    P = lpv.covariance.reshape(3, 3, 3, 3)
    expected = np.einsum("kt,tpsp,ks->kp", phi, P, phi)
    np.testing.assert_allclose(std**2, expected)
    np.testing.assert_array_equal(values, lpv.parameters(kappa))
    each = lpv.parameter_deviations(kappa)
    np.testing.assert_allclose(np.linalg.norm(each, axis=2), std)


@pytest.mark.parametrize("delay", [0, 0.3])
def test_deviations_of_responses_equal_differences(delay):
    lpv = replace(uncertain_spring(), input_delay=delay)
    omega, h = np.array([0.1, 5.0, 7.0, 40.0]), 1e-4
    c, squares = lpv.interpolator.coefficients(), 0.0
    for step in lpv.covariance_root().T:
        above, below = (
            replace(lpv, interpolator=lpv.interpolator.with_coefficients(c + s * step))
            .at(0.4)
            .frequency_response(omega)
            for s in (h, -h)
        )
        slope = (above - below) / (2 * h)
        squares = squares + slope.real**2 + 1j * slope.imag**2
    std = lpv.frequency_response_std(0.4, omega)
    np.testing.assert_allclose(std.real**2 + 1j * std.imag**2, squares, rtol=1e-6)
    moved = lpv.change_basis(lambda kappa: np.diag([1, 1 + kappa[0]]))
    np.testing.assert_allclose(moved.frequency_response_std(0.4, omega), std)


def test_a_covariance_is_one_of_the_coefficients():
    lpv = spring_lpv()
    with pytest.raises(ValueError, match=r"`covariance` must be a finite.*\(9, 9\)"):
        replace(lpv, covariance=np.eye(3))
    foreign = KNeighborsRegressor(1).fit([[0.0], [1.0]], np.ones((2, 3)))
    with pytest.raises(ValueError, match="`covariance` needs regressors with coef"):
        replace(lpv, interpolator=foreign, covariance=np.eye(3))
    for call in (
        lambda: lpv.parameters([0.1], return_std=True),
        lambda: lpv.frequency_response_std(0.1, [1.0]),
    ):
        with pytest.raises(ValueError, match="`covariance` is None.*AutoLPV"):
            call()


@pytest.mark.parametrize("delay", [0.0, 0.1])
def test_runs_begin_where_their_first_inputs_hold_them(delay):
    """As after a long time with these; in any basis, and with inputs in transit."""
    kappa = np.linspace(0, 1.5, 5)[:, None]
    values = np.hstack([1 + kappa, kappa**2, 0.3 * kappa, 0.1 - kappa])
    lpv = replace(
        spring_lpv(),
        offsets=PolynomialLPV(2).fit(kappa, values),
        input_delay=delay,
        steady_start=True,
    )
    lpv = lpv.change_basis(lambda k: np.array([[1.0, k[0]], [0.0, 2.0]]))
    u = np.repeat([[2.0], [-1.0], [3.0]], [2000, 10, 30], axis=0)
    path = np.concatenate([np.full(2000, 0.4), np.linspace(0.4, 1.2, 40)])
    y = lpv.simulate(u, path, 0.05)
    np.testing.assert_allclose(
        lpv.simulate(u[1990:], path[1990:], 0.05), y[1990:], atol=1e-9
    )
    np.testing.assert_allclose(y[:2000], np.tile(y[0], (2000, 1)), atol=1e-9)
    x0 = lpv.estimate_initial_state(u[1990:], path[1990:], y[1990:], 0.05)
    found = lpv.simulate(u[1990:], path[1990:], 0.05, x0)
    np.testing.assert_allclose(found, y[1990:], atol=1e-9)


def test_step_responses_begin_at_rest():
    """Inputs that never move, or move at once, do not tell of a time before."""
    lpv = replace(spring_lpv(), steady_start=True)
    for u in (np.ones(50), np.repeat([1.0, 2.0], [3, 47])):
        found = lpv.simulate(u, np.zeros(50), 0.05)
        np.testing.assert_array_equal(
            found, spring_lpv().simulate(u, np.zeros(50), 0.05)
        )


@pytest.mark.parametrize(
    "low, width", [(1e5, 1.0), (-1e-8, 1e-8), (0.0, 1e6), (3.0, 0)]
)
def test_the_rate_of_a_basis_is_that_of_its_range(low, width):
    kappa = np.array([[low], [low + width]])
    spring = GrayBoxStructure.from_template(
        A=[[0, 1], ["-k", -0.5]], B=[[0], [1]], C=[[1, 0]]
    )
    k = PolynomialLPV(0).fit(kappa, [[4.0], [4.0]])
    unit = width or 1.0
    lpv = LPVStateSpace(spring, k, kappa).change_basis(
        lambda kappa: np.diag([1.0, np.exp((kappa[0] - low) / unit)])
    )
    for place in kappa.ravel():
        at_rest, moving = lpv.at(place), lpv.at(place, rate=3.0 * unit)
        assert np.allclose(moving.A - at_rest.A, [[0, 0], [0, 3.0]], atol=3e-5)


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"scheduling_range": [[-np.inf], [np.inf]]}, "must be finite"),
        ({"identified_range": [0.0, 1.0]}, "shape of `scheduling_range`"),
        ({"bases": (np.eye(3),)}, "`T` must have shape"),
    ],
)
def test_ranges_and_bases_that_do_not_fit_are_refused(wrong, said):
    decay = GrayBoxStructure.from_template(A=[["-a"]], B=[[1]], C=[[1]])
    a = PolynomialLPV(0).fit([[0.0], [1.0]], [[1.0], [1.0]])
    with pytest.raises(ValueError, match=said):
        LPVStateSpace(decay, a, **({"scheduling_range": [[0.0], [1.0]]} | wrong))


def test_names_are_any_list_of_labels():
    k = [[0.0, 0.0], [1.0, 1.0]]
    flat = PolynomialLPV(0).fit(k, [[1.0], [1.0]])
    structure = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    for names in (np.array(["p", "q"]), pd.Index(["p", "q"])):
        options = {"scheduling_names": names, "identified_range": k}
        lpv = LPVStateSpace(structure, flat, k, **options)
        assert list(lpv.scheduling_names) == ["p", "q"]
        with pytest.warns(ExtrapolationWarning, match="'q'"):
            lpv.simulate([1.0, 1.0], [[0.5, 3.0]] * 2, 0.1)


def test_the_deviation_of_a_response_is_not_known_at_a_pole():
    k = [[0.0], [1.0]]
    integrator = GrayBoxStructure.from_template([[0]], [["b"]], [[1]])
    form = PolynomialLPV(0).fit(k, [[1.0], [1.0]])
    lpv = LPVStateSpace(integrator, form, k, covariance=[[0.01]])
    with pytest.raises(ValueError, match="`omega` must be off the poles"):
        lpv.frequency_response_std(0.0, [0.0, 2.0])
    np.testing.assert_allclose(lpv.frequency_response_std(0.0, [2.0])[0], 0.05j)


def test_models_without_states_have_slopes_from_a_steady_start():
    k = [[0.0], [1.0]]
    gain = PolynomialLPV(1).fit(k, [[1.0], [2.0]])
    structure = GrayBoxStructure.full(0, 1, 1)
    P = 0.01 * np.eye(2)
    lpv = LPVStateSpace(structure, gain, k, covariance=P, steady_start=True)
    std = simulation_std(lpv, np.ones((5, 1)), np.full((5, 1), 0.5), 0.1)
    np.testing.assert_allclose(std, 0.1)
