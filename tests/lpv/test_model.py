"""LPVStateSpace: frozen models and simulation along a trajectory."""

import copy
import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV, StateSpace
from lpvlearn.exceptions import DivergenceError, ExtrapolationWarning
from lpvlearn.lpv import model as model_module

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


def test_noisy_scheduling_is_the_loop():
    model, u = spring("ignore"), inputs(600)
    kappa = sweep(600) + 0.05 * np.random.default_rng(1).normal(size=600)
    expected = loop(model, u, kappa, np.zeros(2))
    y = model.simulate(u, kappa, DT)
    assert_allclose(y, expected, atol=1e-12 * np.abs(expected).max())


def test_scheduling_that_jumps_back_in_time_is_not_reordered():
    model, u, kappa = spring(), inputs(300), sweep(300)
    expected = loop(model, u, kappa[::-1], np.zeros(2))
    assert_allclose(model.simulate(u, kappa[::-1], DT), expected, atol=1e-12)


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
        (lambda m: m.at([0.0, 1.0]), "must have 1 columns"),
        (lambda m: m.at(np.nan), "`scheduling` must be finite"),
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
