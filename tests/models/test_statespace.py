"""StateSpace: a value object with the algebra of linear systems."""

import copy
import pickle
import sys
import types
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lpvlearn import StateSpace
from lpvlearn.exceptions import DivergenceError

from ..conftest import stable_model

OMEGA = np.array([0.0, 0.1, 1.0, 7.0, 40.0])


def random_model(seed, order=4, n_inputs=2, n_outputs=3, **options):
    return stable_model(seed, order, n_inputs, n_outputs, feedthrough=True, **options)


@pytest.mark.parametrize("sampling_time", [None, 0.05])
def test_frequency_response_is_its_definition(sampling_time):
    model = random_model(0, sampling_time=sampling_time)
    points = 1j * OMEGA if sampling_time is None else np.exp(1j * OMEGA * sampling_time)
    expected = [
        model.C @ np.linalg.solve(z * np.eye(4) - model.A, model.B) + model.D
        for z in points
    ]
    np.testing.assert_allclose(
        model.frequency_response(OMEGA), expected, rtol=1e-11, atol=1e-12
    )


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    order=st.integers(1, 6),
    scales=st.lists(st.floats(-6, 6), min_size=6, max_size=6),
)
def test_a_change_of_basis_leaves_the_response(seed, order, scales):
    model = random_model(seed, order)
    rng = np.random.default_rng(seed + 1)
    rotation = np.linalg.qr(rng.normal(size=(order, order)))[0]
    T = np.diag(10.0 ** np.array(scales[:order])) @ rotation
    other = model.transform(T)
    G, H = model.frequency_response(OMEGA), other.frequency_response(OMEGA)
    np.testing.assert_allclose(H, G, rtol=1e-8, atol=1e-8 * np.abs(G).max())
    np.testing.assert_array_equal(other.D, model.D)


def test_transform_maps_the_state():
    rng = np.random.default_rng(3)
    model, T = random_model(1), rng.normal(size=(4, 4))
    u, x0 = rng.normal(size=(30, 2)), rng.normal(size=4)
    y = model.simulate(u, sampling_time=0.1, initial_state=x0)
    z = model.transform(T).simulate(u, sampling_time=0.1, initial_state=T @ x0)
    np.testing.assert_allclose(z, y, atol=1e-10 * np.abs(y).max())


@pytest.mark.parametrize("sampling_time", [None, 0.05])
def test_difference_has_the_difference_of_responses(sampling_time):
    one = random_model(0, 4, sampling_time=sampling_time)
    two = random_model(1, 2, sampling_time=sampling_time)
    G = one.frequency_response(OMEGA) - two.frequency_response(OMEGA)
    difference = one - two
    assert difference.order == 6
    np.testing.assert_allclose(difference.frequency_response(OMEGA), G, atol=1e-11)
    assert (one - one).hinf_norm() < 1e-10 * one.hinf_norm()


def test_dc_gain_is_the_settled_step_response():
    model = random_model(5)
    y = model.simulate(np.ones((4000, 2)), sampling_time=0.1)
    np.testing.assert_allclose(y[-1], model.dc_gain() @ np.ones(2), rtol=1e-9)
    np.testing.assert_allclose(
        model.to_discrete(0.3).dc_gain(), model.dc_gain(), rtol=1e-10
    )


def test_dc_gain_of_an_integrator_is_infinite():
    assert np.isinf(StateSpace(0, 1, 1).dc_gain()).all()


@pytest.mark.parametrize("damping", [0.01, 0.3, 0.7])
def test_hinf_norm_of_a_resonance(damping):
    model = StateSpace([[0, 1], [-1, -2 * damping]], [[0], [1]], [[1, 0]])
    expected = 1 / (2 * damping * np.sqrt(1 - damping**2))
    assert model.hinf_norm() == pytest.approx(expected, rel=1e-9)


def test_hinf_norm_of_lags_all_passes_and_unstable_models():
    assert StateSpace(-2, 6, 1).hinf_norm() == pytest.approx(3.0)
    all_pass = StateSpace(-1, 2, -1, 1)  # (s - 1) / (s + 1)
    assert all_pass.hinf_norm() == pytest.approx(1.0)
    assert StateSpace(0.5, 1, 1, sampling_time=1.0).hinf_norm() == pytest.approx(2.0)
    assert StateSpace(1, 1, 1).hinf_norm() == np.inf
    assert StateSpace(0, 1, 1).hinf_norm() == np.inf


@pytest.mark.parametrize("sampling_time", [None, 0.1])
def test_hinf_norm_bounds_every_frequency(sampling_time):
    model = random_model(8, sampling_time=sampling_time)
    omega = np.concatenate([[0.0], np.logspace(-3, np.log10(np.pi / 0.1), 4000)])
    largest = np.linalg.svd(model.frequency_response(omega), compute_uv=False).max()
    assert largest <= model.hinf_norm() * (1 + 1e-9)
    assert largest == pytest.approx(model.hinf_norm(), rel=1e-3)


def test_poles_are_sorted_and_stability_follows_them():
    model = StateSpace(np.diag([3.0, -1.0, 2.0]), np.ones((3, 1)), np.ones((1, 3)))
    np.testing.assert_array_equal(model.poles(), [-1, 2, 3])
    assert not model.is_stable
    assert random_model(0).is_stable and random_model(0, sampling_time=1.0).is_stable
    assert not StateSpace(0, 1, 1).is_stable
    assert StateSpace(0, 1, 1, sampling_time=1.0).is_stable
    assert not StateSpace(-1, 1, 1, sampling_time=1.0).is_stable


# -- simulation ------------------------------------------------------------------


def test_simulation_of_a_lag_is_the_exponential():
    t = 0.1 * np.arange(50)
    y = StateSpace(-2, 2, 1).simulate(np.ones(50), sampling_time=0.1)
    np.testing.assert_allclose(y[:, 0], 1 - np.exp(-2 * t), atol=1e-13)


def test_continuous_simulation_is_that_of_the_sampled_model():
    model, u = random_model(2), np.random.default_rng(0).normal(size=(200, 2))
    x0 = np.arange(4.0)
    y = model.simulate(u, sampling_time=0.2, initial_state=x0)
    sampled = model.to_discrete(0.2)
    np.testing.assert_array_equal(y, sampled.simulate(u, initial_state=x0))
    np.testing.assert_array_equal(
        y, sampled.simulate(u, sampling_time=0.2 * (1 + 1e-9), initial_state=x0)
    )


def test_simulation_is_causal_and_linear():
    model, rng = random_model(2), np.random.default_rng(0)
    u, v = rng.normal(size=(2, 60, 2))
    run = lambda w: model.simulate(w, sampling_time=0.1)  # noqa: E731
    np.testing.assert_allclose(run(2 * u - v), 2 * run(u) - run(v), atol=1e-11)
    later = u.copy()
    later[30:] += 1
    np.testing.assert_array_equal(run(later)[:30], run(u)[:30])


# -- a pure gain -----------------------------------------------------------------


def test_pure_gain_has_every_method():
    D = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    gain, u = StateSpace([], [], [], D), np.arange(12.0).reshape(4, 3)
    assert (gain.order, gain.n_inputs, gain.n_outputs) == (0, 3, 2)
    np.testing.assert_array_equal(gain.simulate(u, sampling_time=1.0), u @ D.T)
    np.testing.assert_array_equal(
        gain.frequency_response([0.0, 1.0, np.inf]), np.array([D, D, D])
    )
    np.testing.assert_array_equal(gain.dc_gain(), D)
    assert gain.hinf_norm() == pytest.approx(np.linalg.norm(D, 2))
    assert gain.is_stable and gain.poles().shape == (0,)
    assert gain.balance().order == 0 and gain.hankel_singular_values().shape == (0,)
    assert gain.transform(np.zeros((0, 0))).order == 0
    assert ((gain - gain).D == 0).all()
    np.testing.assert_array_equal((gain - random_model(0, 2, 3, 2)).A.shape, (2, 2))
    for method in ("zoh", "foh", "tustin"):
        sampled = gain.to_discrete(0.1, method)
        np.testing.assert_array_equal(sampled.D, D)
        np.testing.assert_array_equal(sampled.to_continuous(method).D, D)


def test_pure_gain_takes_its_shape_from_any_matrix():
    model = StateSpace(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((3, 0)))
    np.testing.assert_array_equal(model.D, np.zeros((3, 2)))
    assert StateSpace([], [], [], 2.0).D.shape == (1, 1)


# -- a value object --------------------------------------------------------------


def test_models_cannot_be_changed():
    A = np.array([[-1.0]])
    model = StateSpace(A, 1, 1)
    A[0, 0] = 5.0
    assert model.A[0, 0] == -1.0
    with pytest.raises(FrozenInstanceError):
        model.A = A
    with pytest.raises(FrozenInstanceError):
        model.label = "new"
    with pytest.raises(ValueError, match="read-only"):
        model.A[0, 0] = 2.0


@pytest.mark.parametrize(
    "duplicate",
    [copy.copy, copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))],
)
@pytest.mark.parametrize("order", [0, 3])
def test_copies_and_pickles_are_equal_and_read_only(duplicate, order):
    model = random_model(0, order, sampling_time=0.1)
    other = duplicate(model)
    assert isinstance(other, StateSpace) and other.sampling_time == 0.1
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(other, name), getattr(model, name))
        assert not getattr(other, name).flags.writeable


def test_repr_tells_the_dimensions():
    text = "StateSpace(order=4, n_inputs=2, n_outputs=3, "
    assert repr(random_model(0)) == text + "continuous time)"
    assert repr(random_model(0, sampling_time=0.1)) == text + "sampling_time=0.1)"


# -- errors ----------------------------------------------------------------------

ONE = [[1.0]]
SQUARE = [[-1.0, 0.0], [0.0, -2.0]]


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((ONE, ONE, ONE, [[1, 2]]), r"`D` must have shape \(1, 1\).*\(1, 2\)"),
        (([[1, 2]], ONE, ONE), r"`A` must be square. Got shape \(1, 2\)"),
        ((SQUARE, [1, 1], [[1, 1]]), r"`B` needs 2 rows and `C` 2 columns"),
        ((SQUARE, [[1], [1]], [[1]]), r"`B` needs 2 rows and `C` 2 columns"),
        ((np.zeros((1, 1, 1)), ONE, ONE), "`A` must have 2 dimensions"),
        (([[np.nan]], ONE, ONE), r"`A` must be finite. Got nan at \[0, 0\]"),
        ((SQUARE, [[1], [np.inf]], [[1, 1]]), r"`B` must be finite.*inf at \[1, 0\]"),
        ((ONE, ONE, ONE, [[np.nan]]), "`D` must be finite"),
        (([["k"]], ONE, ONE), "`A` must hold real numbers only"),
        (([["1"]], ONE, ONE), "`A` must hold real numbers only"),
        ((ONE, [[1j]], ONE), "`B` must hold real numbers only"),
        ((ONE, [[None]], ONE), "`B` must hold real|`B` must be finite"),
        (([[1, 2], [3]], ONE, ONE), "`A` must hold real numbers only"),
        ((ONE, ONE, ONE, None, 0.0), "`sampling_time` must be a positive"),
        ((ONE, ONE, ONE, None, -1), "`sampling_time` must be a positive"),
        ((ONE, ONE, ONE, None, np.nan), "`sampling_time` must be a positive"),
        ((ONE, ONE, ONE, None, np.inf), "`sampling_time` must be a positive"),
        ((ONE, ONE, ONE, None, "1"), "`sampling_time` must be a positive"),
        ((ONE, ONE, ONE, None, False), "`sampling_time` must be a positive"),
        ((ONE, ONE, ONE, None, [1, 2]), "`sampling_time` must be a positive"),
        (([], [], []), "a pure gain takes them from `D`"),
        ((ONE, np.zeros((1, 0)), ONE), "at least one input and one output"),
        (([], np.zeros((0, 3)), [], [[1, 2]]), "`D` must have shape"),
        (([], [[1]], [], [[1]]), "`B` needs 0 rows"),
    ],
)
def test_wrong_matrices_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        StateSpace(*arguments)


CONTINUOUS, DISCRETE = random_model(0), random_model(0, sampling_time=0.1)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: CONTINUOUS.frequency_response([np.nan]), "`omega`.*1 NaN"),
        (lambda: CONTINUOUS.frequency_response([[1.0]]), r"`omega`.*\(n_freq,\)"),
        (lambda: CONTINUOUS.frequency_response("dc"), "`omega` must hold real"),
        (lambda: DISCRETE.frequency_response([np.inf]), "`omega` must be finite"),
        (lambda: CONTINUOUS.simulate(np.ones((3, 2))), "`sampling_time`.*Got None"),
        (lambda: DISCRETE.simulate(np.ones((3, 1))), r"`u`.*\(n_samples, 2\)"),
        (lambda: DISCRETE.simulate(1.0), r"`u`.*\(n_samples, 2\)"),
        (lambda: DISCRETE.simulate([[1, np.nan]]), "`u`.*nan at sample 0, input 1"),
        (lambda: DISCRETE.simulate("u"), "`u` must hold real"),
        (
            lambda: DISCRETE.simulate(np.ones((3, 2)), sampling_time=0.2),
            "`sampling_time` must be 0.1 s",
        ),
        (
            lambda: DISCRETE.simulate(np.ones((3, 2)), initial_state=[1.0]),
            r"`initial_state` must have shape \(4,\)",
        ),
        (
            lambda: DISCRETE.simulate(np.ones((3, 2)), initial_state=[np.nan] * 4),
            "`initial_state` must be finite",
        ),
        (lambda: DISCRETE.transform(np.eye(3)), "`T` must have shape"),
        (lambda: DISCRETE.transform(np.ones((4, 4))), "`T` must be invertible"),
        (lambda: DISCRETE.transform(np.zeros((4, 4))), "`T` must be invertible"),
        (lambda: DISCRETE - CONTINUOUS, "same inputs, outputs and sampling"),
        (lambda: DISCRETE - random_model(0, 4, 1), "same inputs, outputs"),
        (lambda: DISCRETE.to_discrete(0.1), "needs a continuous-time model"),
        (lambda: CONTINUOUS.to_discrete(0.1, "euler"), "`method`.*'euler'"),
        (lambda: CONTINUOUS.to_discrete(0), "`sampling_time` must be a positive"),
        (lambda: DISCRETE.to_continuous("euler"), "`method`.*'euler'"),
        (lambda: CONTINUOUS.to_continuous("euler"), "`method`.*'euler'"),
        (lambda: StateSpace(1e6, 1, 1).to_discrete(1.0), "must be short.*1e\\+06"),
        (lambda: CONTINUOUS.balance(5), "`order` must be an integer, 0 to 4"),
        (lambda: CONTINUOUS.balance(-1), "`order` must be an integer, 0 to 4"),
        (lambda: CONTINUOUS.balance(2.0), "`order` must be an integer"),
        (lambda: CONTINUOUS.balance(True), "`order` must be an integer"),
        (lambda: StateSpace(1, 1, 1).balance(), "stable model. Got a pole at 1"),
        (lambda: StateSpace(0, 1, 1).hankel_singular_values(), "stable model"),
    ],
)
def test_wrong_calls_are_explained(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_subtracting_something_else_is_a_type_error():
    with pytest.raises(TypeError):
        CONTINUOUS - 3


# -- python-control --------------------------------------------------------------


def test_round_trip_through_control():
    pytest.importorskip("control")
    for model in (CONTINUOUS, DISCRETE):
        back = StateSpace.from_control(model.to_control())
        assert back.sampling_time == model.sampling_time
        for name in "ABCD":
            np.testing.assert_array_equal(getattr(back, name), getattr(model, name))


def test_control_gets_zero_for_continuous_time(monkeypatch):
    fake = types.ModuleType("control")
    fake.ss = lambda A, B, C, D, dt: types.SimpleNamespace(A=A, B=B, C=C, D=D, dt=dt)
    monkeypatch.setitem(sys.modules, "control", fake)
    assert CONTINUOUS.to_control().dt == 0 and DISCRETE.to_control().dt == 0.1
    for model in (CONTINUOUS, DISCRETE):
        back = StateSpace.from_control(model.to_control())
        assert back.sampling_time == model.sampling_time


def test_a_package_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(ImportError, match=r"needs the package control. Install it"):
        CONTINUOUS.to_control()


def test_control_models_of_unknown_time_or_kind_are_refused():
    known = dict(A=ONE, B=ONE, C=ONE, D=ONE)
    with pytest.raises(ValueError, match="`model.dt`"):
        StateSpace.from_control(types.SimpleNamespace(**known, dt=None))
    with pytest.raises(ValueError, match="must be a control.StateSpace.*int"):
        StateSpace.from_control(3)


# -- divergence ------------------------------------------------------------------


def test_an_unstable_model_grows_until_its_numbers_end():
    model = StateSpace(10.0, 1, 1, sampling_time=1.0)
    y = model.simulate(np.ones(309))  # 1.1e307 at last
    assert_allclose(y[:4, 0], [0, 1, 11, 111])
    assert np.isfinite(y).all()
    with pytest.raises(DivergenceError, match=r"0 is 1\.111e\+308 at sample 309"):
        model.simulate(np.ones(311))
    with pytest.raises(DivergenceError, match=r"sample 310\. .*\(a pole at 10"):
        model.simulate(np.ones(2000))
    with pytest.raises(DivergenceError, match=r"\(a pole at 10"):
        model.estimate_initial_state(np.zeros(2000), np.ones(2000))


def test_a_continuous_model_diverges_as_its_samples_do():
    with pytest.raises(DivergenceError, match=r"a pole at 2\+0j"):
        StateSpace(2.0, 1, 1).simulate(np.ones(9000), sampling_time=0.1)


def test_a_stable_model_is_not_blamed():
    with pytest.raises(DivergenceError, match="is stable: scale `u`"):
        StateSpace(0.5, 1e10, 1, sampling_time=1.0).simulate([1e300, 1e300, 1.0])


# -- time in samples -------------------------------------------------------------


def test_time_in_samples_is_that_of_one_second_samples():
    blocks = random_model(3, sampling_time=1.0)
    samples = StateSpace(blocks.A, blocks.B, blocks.C, blocks.D, True)
    omega, u = np.linspace(0.0, np.pi, 7), np.random.default_rng(0).normal(size=(9, 2))
    np.testing.assert_array_equal(
        samples.frequency_response(omega), blocks.frequency_response(omega)
    )
    assert samples.hinf_norm() == blocks.hinf_norm()
    assert (samples.is_stable, samples.is_continuous) == (blocks.is_stable, False)
    for step in (None, 0.1, 3.0):  # any step is as good
        np.testing.assert_array_equal(
            samples.simulate(u, sampling_time=step), blocks.simulate(u)
        )
    for copied in (samples.balance(), samples.transform(np.eye(samples.order))):
        assert copied.sampling_time is True
    assert pickle.loads(pickle.dumps(samples)).sampling_time is True
    assert "time in samples" in repr(samples)


def test_time_in_samples_agrees_with_any_step_but_not_with_continuous_time():
    samples = StateSpace(0.5, 1, 1, sampling_time=True)
    for dt in (0.1, 1.0):
        known = StateSpace(0.5, 1, 1, sampling_time=dt)
        for difference in (samples - known, known - samples):
            assert difference.sampling_time == dt and difference.hinf_norm() < 1e-12
    assert (samples - samples).sampling_time is True
    with pytest.raises(ValueError, match="same inputs, outputs and sampling time"):
        samples - StateSpace(-0.5, 1, 1)
    for method in ("zoh", "foh", "tustin"):
        with pytest.raises(ValueError, match="`sampling_time` must be known.*`time=`"):
            samples.to_continuous(method)


# -- initial states --------------------------------------------------------------


@pytest.mark.parametrize("n_outputs", [1, 2])
def test_the_estimated_initial_state_is_the_one_simulated_from(n_outputs):
    rng = np.random.default_rng(0)
    model = StateSpace(
        [[0.9, 0.2], [-0.2, 0.8]], [[1.0], [0.5]], np.eye(2)[:n_outputs], None, 0.1
    )
    u, x0 = rng.normal(size=30), np.array([2.0, -3.0])
    y = model.simulate(u, initial_state=x0)
    assert_allclose(model.estimate_initial_state(u, y), x0, rtol=1e-10)
    # a least-squares solution: what remains, of outputs by how far they move, is
    # orthogonal to the free responses
    noisy = y + rng.normal(size=y.shape)
    rest = noisy - model.simulate(
        u, initial_state=model.estimate_initial_state(u, noisy)
    )
    free = [model.simulate(0 * u, initial_state=unit) for unit in np.eye(2)]
    assert_allclose(np.tensordot(free, rest / noisy.var(axis=0), 2), 0.0, atol=1e-10)


@pytest.mark.parametrize(
    "model, u, y, message",
    [
        (StateSpace(-1, 1, 1), [1.0], [1.0], "needs a discrete-time model"),
        (StateSpace(0.5, 1, 1, None, 1.0), [1.0, 2.0], [1.0], "Got 2 and 1"),
        (StateSpace(0.5, 1, 1, None, 1.0), [], [], "at least one. Got 0 and 0"),
        (StateSpace(0.5, 1, 1, None, 1.0), [1.0], [np.inf], "`y` must be finite"),
        (StateSpace(0.5, 1, 1, None, 1.0), [1.0], [[1.0, 2.0]], r"`y`.*samples, 1\)"),
    ],
)
def test_an_initial_state_needs_a_record_of_a_sampled_model(model, u, y, message):
    with pytest.raises(ValueError, match=message):
        model.estimate_initial_state(u, y)


# -- input delays ----------------------------------------------------------------


def late_model(seed=0, delay=(3, 0)):
    model = random_model(seed, 3, sampling_time=0.1)
    return model.with_input_delay(delay)


def test_delayed_inputs_are_shifted_inputs():
    model, u = late_model(), np.random.default_rng(0).normal(size=(60, 2))
    late = np.column_stack([np.r_[np.zeros(3), u[:-3, 0]], u[:, 1]])
    x0 = np.arange(3.0)
    np.testing.assert_array_equal(
        model.simulate(u, initial_state=x0),
        model.with_input_delay(0).simulate(late, initial_state=x0),
    )
    short = model.simulate(u[:2], initial_state=x0)  # nothing of input 0 has arrived
    np.testing.assert_array_equal(short, model.simulate(u, initial_state=x0)[:2])


def test_absorbed_delays_are_states_at_the_origin():
    model, u = late_model(), np.random.default_rng(0).normal(size=(60, 2))
    absorbed = model.absorb_delay()
    assert absorbed.order == 6 and not absorbed.input_delay.any()
    assert np.sum(np.abs(absorbed.poles()) < 1e-4) == 3
    x0 = np.arange(6.0)  # the state, and the inputs in transit
    y = model.simulate(u, initial_state=x0)
    np.testing.assert_allclose(absorbed.simulate(u, initial_state=x0), y, atol=1e-11)
    omega = np.linspace(0, np.pi / 0.1, 30)
    np.testing.assert_allclose(
        absorbed.frequency_response(omega), model.frequency_response(omega), atol=1e-11
    )
    for one in (model, absorbed):
        estimated = one.estimate_initial_state(u, y)
        np.testing.assert_allclose(
            one.simulate(u, initial_state=estimated), y, atol=1e-10
        )


def test_the_initial_state_of_a_part_holds_the_inputs_in_transit():
    model, u = late_model(), np.random.default_rng(0).normal(size=(80, 2))
    y = model.simulate(u)
    x0 = model.estimate_initial_state(u[30:], y[30:])
    np.testing.assert_allclose(x0[3:], u[27:30, 0], atol=1e-9)
    np.testing.assert_allclose(model.simulate(u[30:], initial_state=x0), y[30:])


@pytest.mark.parametrize("sampling_time", [None, 0.1])
def test_a_delay_turns_the_response(sampling_time):
    plain = random_model(3, sampling_time=sampling_time)
    delay = np.array([2, 5]) if sampling_time else np.array([0.17, 0.4])
    omega = np.array([0.0, 0.3, 2.0, 20.0])
    seconds = delay * (sampling_time or 1.0)
    np.testing.assert_allclose(
        plain.with_input_delay(delay).frequency_response(omega),
        plain.frequency_response(omega)
        * np.exp(-1j * np.outer(omega, seconds))[:, None],
        atol=1e-12,
    )
    late = plain.with_input_delay(delay)
    np.testing.assert_array_equal(late.dc_gain(), plain.dc_gain())
    np.testing.assert_array_equal(late.poles(), plain.poles())


@pytest.mark.parametrize("delay", [4, (1, 4)])
def test_delays_leave_norms_as_they_are(delay):
    model = late_model(2, delay)
    assert model.hinf_norm() == model.with_input_delay(0).hinf_norm()
    assert model.absorb_delay().hinf_norm() == pytest.approx(model.hinf_norm())
    late = model.to_continuous("tustin").with_input_delay((0.3, 0.1))
    omega = np.array([0.5, np.inf])
    gains = np.linalg.svd(late.frequency_response(omega), compute_uv=False)
    plain = late.with_input_delay(0).frequency_response(omega)
    np.testing.assert_allclose(gains, np.linalg.svd(plain, compute_uv=False))


def test_a_delay_does_not_spoil_what_is_infinite():
    integrator = StateSpace(0, 1, 1, input_delay=0.5)
    assert np.isinf(integrator.dc_gain()).all()


def test_delays_go_along_with_conversions_and_changes_of_basis():
    model = late_model(1)
    T = np.random.default_rng(0).normal(size=(3, 3))
    for one in (model.transform(T), model.balance(), model.balance(2), model - model):
        np.testing.assert_array_equal(one.input_delay, [3, 0])
    continuous = model.to_continuous("tustin")
    np.testing.assert_allclose(continuous.input_delay, [0.3, 0.0])
    np.testing.assert_array_equal(
        continuous.to_discrete(0.1, "tustin").input_delay, [3, 0]
    )
    np.testing.assert_array_equal(continuous.to_discrete(0.05).input_delay, [6, 0])
    for one in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        np.testing.assert_array_equal(one.input_delay, [3, 0])
        assert not one.input_delay.flags.writeable
    assert "input_delay=[3, 0])" in repr(model)
    assert "input_delay=[0.3, 0] s)" in repr(continuous)


@pytest.mark.parametrize("feedthrough", [False, True])
def test_delays_between_samples_are_exact_for_held_inputs(feedthrough):
    model = stable_model(2, 3, feedthrough=feedthrough).with_input_delay([0.13, 0.3])
    sampled = model.to_discrete(0.1)
    assert sampled.order == 4  # one of the delays is whole
    np.testing.assert_array_equal(sampled.input_delay, [1, 3])
    u, x0 = np.random.default_rng(0).normal(size=(50, 2)), np.arange(3.0)
    fine = model.to_discrete(0.01)
    assert fine.order == 3
    expected = fine.simulate(u.repeat(10, axis=0), initial_state=x0)[::10]
    found = model.simulate(u, sampling_time=0.1, initial_state=x0)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_what_cannot_be_done_with_delays_says_what_can():
    model = late_model()
    with pytest.raises(ValueError, match=r"absorb_delay\(\), or"):
        model - model.with_input_delay(0)
    continuous = random_model(0).with_input_delay(0.25)
    with pytest.raises(ValueError, match="Use `method='zoh'`"):
        continuous.to_discrete(0.1, "tustin")
    with pytest.raises(ValueError, match="'foh'` needs delays that are whole numbers"):
        continuous.to_discrete(0.1, "foh")
    with pytest.raises(ValueError, match="needs a discrete-time model: no finite"):
        continuous.absorb_delay()
    with pytest.raises(ValueError, match="`to_control` needs a model without delay"):
        model.to_control()
    with pytest.raises(
        ValueError, match=r"\(3,\), or with the inputs in transit \(6,\)"
    ):
        model.simulate(np.zeros((5, 2)), initial_state=np.zeros(5))


@pytest.mark.parametrize("delay", [-1, 1.5, [1, 2, 3], "2", np.nan, [[1, 2]]])
def test_what_is_no_delay_is_refused(delay):
    with pytest.raises(ValueError, match="`input_delay` must"):
        late_model(delay=delay)


@pytest.mark.parametrize(
    "changed",
    [
        lambda m: m.to_discrete(0.1),
        lambda m: m.to_discrete(0.1, "tustin").to_continuous("tustin"),
        lambda m: m.to_discrete(0.1, "foh").to_continuous("foh"),
        lambda m: m.to_discrete(0.1).to_continuous(),
        lambda m: m.transform(2 * np.eye(2)),
        lambda m: m.balance(),
        lambda m: m.with_input_delay(0.2),
        lambda m: m.to_discrete(0.1).with_input_delay(1).absorb_delay(),
        lambda m: m - m,
        lambda m: pickle.loads(pickle.dumps(m)),
        copy.deepcopy,
    ],
)
def test_names_and_units_go_along(changed):
    A, B, C = [[0, 1], [-4, -1]], [[0], [1]], [[1, 0]]
    names = (["force"], ["angle"], {"force": "N", "angle": "rad"})
    found = changed(StateSpace(A, B, C).with_names(*names))
    assert (found.input_names, found.output_names, found.units) == names


def test_names_and_units_must_be_those_of_the_signals():
    with pytest.raises(ValueError, match="`input_names` must be a list of 1 distinct"):
        StateSpace(-1, 1, 1, input_names=["a", "b"])
    assert StateSpace(-1, 1, 1).with_names([("a", "b")]).input_names == [("a", "b")]
    with pytest.raises(ValueError, match="`units` must be a dict from names to units"):
        StateSpace(-1, 1, 1, units={"a": 1})


def test_python_control_knows_the_names():
    pytest.importorskip("control")
    model = StateSpace(-1, 1, 1, input_names=["u.1"], output_names=["speed"])
    taken = model.to_control()
    assert (taken.input_labels, taken.output_labels) == (["u_1"], ["speed"])
    assert model.to_control(inputs="force").input_labels == ["force"]
    assert StateSpace.from_control(taken).output_names == ["speed"]


def test_units_of_outputs_do_not_change_an_initial_state():
    """That of a mode that the small output alone shows."""
    rng = np.random.default_rng(0)
    A = np.diag([0.9, 0.8])
    x0, u = np.array([1.0, -2.0]), rng.normal(size=(50, 1))
    for unit in (1.0, 1e-6):
        model = StateSpace(A, [[1], [1]], np.diag([1.0, unit]), sampling_time=1.0)
        y = model.simulate(u, initial_state=x0)
        y[:, 0] += rng.normal(size=50)
        y[:, 1] += 1e-9 * unit * rng.normal(size=50)
        found = model.estimate_initial_state(u, y)
        assert_allclose(found[1], x0[1], rtol=1e-6)


def test_scipy_knows_the_same_model():
    model = StateSpace([[0, 1], [-4.0, -0.8]], [[0], [1.0]], [[3.0, 1.0]], [[0.5]])
    for one in (model, model.to_discrete(0.1)):
        known = one.to_scipy()
        assert known.dt == (None if one.is_continuous else 0.1)
        np.testing.assert_allclose(
            np.sort_complex(known.poles), np.sort_complex(one.poles()), rtol=1e-12
        )
        zpk = known.to_zpk()
        s = 0.3j if one.is_continuous else np.exp(0.03j)
        value = zpk.gain * np.prod(s - zpk.zeros) / np.prod(s - zpk.poles)
        np.testing.assert_allclose(value, one.frequency_response([0.3])[0, 0, 0])
    with pytest.raises(ValueError, match=r"needs a model without delay.*absorb_delay"):
        model.with_input_delay(0.2).to_scipy()
