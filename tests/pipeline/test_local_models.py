"""Step 3 at the operating points: plants in a loop, plants that integrate."""

import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.data.experiments import Experiment
from lpvlearn.pipeline.points.fitting import _costs
from lpvlearn.pipeline.points.local_models import LocalModel, identify_point
from lpvlearn.pipeline.points.rest import equilibrium

from ..conftest import ROLES

STEP = 0.1
OF_TRAJECTORIES = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}


def loop_record(seed, pole=0.9, n_samples=1500):
    """A first-order plant with process noise, under feedback one sample late."""
    r, e = np.random.default_rng(seed).standard_normal((2, n_samples))
    u, y, x = np.zeros((n_samples, 1)), np.zeros((n_samples, 1)), 0.0
    for t in range(n_samples):
        y[t] = x + 0.5 * e[t]
        u[t] = r[t] - (0.5 * y[t - 1] if t else 0.0)
        x = pole * x + u[t, 0] + 0.4 * e[t]
    return Experiment(seed, np.arange(n_samples), u, y)


@pytest.mark.parametrize("combine", ["pool", "average"])
def test_a_plant_in_a_loop_keeps_what_its_own_method_found(combine):
    records = [loop_record(seed) for seed in range(2)]
    local = SubspaceLTI(1, feedthrough=False)
    options = {"sampling_time": STEP, "combine": combine, "discretization": "zoh"}
    with pytest.warns(UserWarning, match="closed loop.*'pbsid' was taken"):
        point = identify_point(local, records, efficient=True, **options)
    n_estimates = 1 if combine == "pool" else 2
    assert len(point.estimates) == n_estimates
    for model, pairs in point.estimates:
        error = np.log(0.9) / STEP - np.log(model.poles()[0].real) / STEP
        both = [np.log([m.poles()[0].real for m in pair]) / STEP for pair in pairs]
        std = np.sqrt(sum((a - b) ** 2 for a, b in both)) / 0.02
        assert 0.01 < std < 0.5 and abs(error) < 3.0 * std


def two_lags_in_a_loop(seed, load, sensor=0.02, n_samples=1200):
    """Two lags under PI control, with a coloured load on their input; and the plant."""
    rng, step = np.random.default_rng(seed), 0.2
    truth = StateSpace([[-1.45, 0.5], [0.0, -0.8]], [[0], [10.0]], [[1, 0]], [[0]])
    A, B, C = (getattr(truth.to_discrete(step), name) for name in "ABC")
    reference = 3.0 * rng.uniform(-1, 1, n_samples // 60 + 1).repeat(60)
    u, y = np.zeros((2, n_samples, 1))
    x, integral, d = np.zeros(2), 0.0, 0.0
    for t in range(n_samples):
        y[t] = C @ x + sensor * rng.standard_normal()
        error = reference[t] - y[t, 0]
        integral += 0.04 * error * step
        u[t] = 0.05 * error + integral
        d = 0.95 * d + 0.1 * load * rng.standard_normal()
        x = A @ x + B[:, 0] * (u[t, 0] + d)
    return Experiment(seed, np.arange(n_samples), u, y), truth


def error_at_order_two(records, truth, **options):
    """Relative, of the response of the local model, which may have more states."""
    options = {"combine": "pool", "discretization": "zoh"} | options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        point = identify_point(SubspaceLTI(2), records, sampling_time=0.2, **options)
    w = np.logspace(-1.5, 0.7, 60)
    G, H = (np.ravel(m.frequency_response(w)) for m in (point.lti, truth))
    return point.order, np.linalg.norm(G - H) / np.linalg.norm(H)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seeds", [(11,), pytest.param((22, 24, 25), marks=pytest.mark.slow)]
)
def test_a_load_has_states_of_its_own_beside_those_of_a_structure(seeds):
    """Or those of the structure are enough."""
    orders, errors = [], []
    for seed in seeds:
        record, truth = two_lags_in_a_loop(seed, load=0.3)
        order, error = error_at_order_two([record], truth, most=True)
        orders.append(order)
        errors.append((error, error_at_order_two([record], truth)[1]))
        assert errors[-1][0] <= errors[-1][1]
    assert max(orders) > 2
    assert np.mean(errors, axis=0)[0] < 0.07


@pytest.mark.slow
@pytest.mark.parametrize("combine", ["pool", "average"])
def test_white_noise_in_a_loop_adds_no_states(combine):
    pairs = [two_lags_in_a_loop(seed, load=0.0, sensor=0.1) for seed in (5, 6)]
    records, truth = [record for record, _ in pairs], pairs[0][1]
    found = [
        error_at_order_two(records, truth, combine=combine, most=most)
        for most in (False, True)
    ]
    assert found[0] == found[1] and found[0][0] == 2


@pytest.mark.slow
def test_realisations_in_a_loop_have_the_states_of_their_load():
    pairs = [two_lags_in_a_loop(seed, load=0.3) for seed in (11, 12, 13)]
    records, truth = [record for record, _ in pairs], pairs[0][1]
    options = {"combine": "average"}
    order, error = error_at_order_two(records, truth, most=True, **options)
    assert order > 2
    assert error < 0.6 * error_at_order_two(records, truth, **options)[1]


@pytest.mark.slow
def test_a_state_that_alternates_with_the_noise_is_left_out():
    # the fast one of four lags hardly shows: a fourth state follows the noise
    rates = np.array([0.5, 0.7, 1.0, 6.0])
    A = np.diag(rates[1:], -1) - np.diag(rates)
    truth = StateSpace(A, rates[0] * np.eye(4, 1), [[0, 0, 0, 1]], [[0]])
    rng = np.random.default_rng(18)
    u = rng.choice([-1.0, 1.0], (150, 1)).repeat(4, axis=0)
    y = truth.simulate(u, sampling_time=STEP)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    chain = GrayBoxStructure.from_template(
        A=[["-a", 0, 0, 0], ["b", "-b", 0, 0], [0, "c", "-c", 0], [0, 0, "d", "-d"]],
        B=[["a"], [0], [0], [0]],
        C=[[0, 0, 0, 1]],
    )
    X, y = from_trajectories([(u, 0.0, y)], sampling_time=STEP)
    errors = {}
    for order in ("auto", 4):
        pipeline = LocalLPVPipeline(
            SubspaceLTI(order, feedthrough=False), GrayBoxRestructurer(chain), **ROLES
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pipeline.fit(X.rename(columns={"experiment": "run"}), y)
        texts = [str(w.message) for w in caught]
        assert any("negative real axis" in text for text in texts) == (order == 4)
        (box,) = pipeline.local_models_
        errors[box.order] = (box - truth).hinf_norm() / truth.hinf_norm()
    assert errors[3] < 0.002 and errors[5] > 0.1  # a pole on that axis counts as two


def test_a_plant_that_only_its_loop_holds_is_refused_with_the_remedy():
    options = {"sampling_time": STEP, "combine": "pool", "discretization": "zoh"}
    local = SubspaceLTI(1, method="pbsid", feedthrough=False)
    with (
        pytest.warns(UserWarning, match="unstable.*controller's reference"),
        pytest.raises(ValueError, match="must be stable.*the closed loop") as refused,
    ):
        identify_point(local, [loop_record(0, 1.1)], **options)
    assert "enforce" not in str(refused.value)


def test_a_plant_that_grows_is_no_integrator():
    """Of one state, which has no other to be compared with."""
    options = {"sampling_time": STEP, "combine": "pool", "discretization": "zoh"}
    u = np.random.default_rng(0).standard_normal((300, 1))
    plant = StateSpace(1.05, 1.0, 1.0, None, STEP)
    run = Experiment(0, np.arange(300), u, plant.simulate(u))
    with (
        pytest.warns(UserWarning, match="unstable"),
        pytest.raises(ValueError, match="must be stable") as refused,
    ):
        identify_point(SubspaceLTI(1), [run], **options)
    assert "integrate" not in str(refused.value)


@pytest.mark.broad
@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_a_structure_may_integrate_twice(noise):
    """Estimates of the poles grow at some points, and nobody has to name the output."""
    rng = np.random.default_rng(1)
    structure = GrayBoxStructure.from_template([[0, 1], [0, 0]], [[0], ["b"]], [[1, 0]])
    runs, truth = [], 1.0 + np.array([0.0, 1.0, 2.0])
    for b in truth:
        u = rng.choice([-1.0, 1.0], (60, 1)).repeat(10, axis=0)
        y = structure.model([b]).simulate(u, sampling_time=STEP)
        y += noise * y.std() * rng.standard_normal(y.shape)
        runs.append((u, b, y))
    X, y = from_trajectories(runs, sampling_time=STEP)
    model = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(structure),
        **OF_TRAJECTORIES,
    ).fit(X, y)
    np.testing.assert_allclose(model.parameters_["b"], truth, rtol=10.0 * noise)
    assert model.score(X, y) > 1.0 - 2.0 * noise


def test_positions_of_all_points_begin_where_those_of_the_fit_did():
    """At one place, whichever the scheduling variable: means of what points tell."""
    rng = np.random.default_rng(0)
    structure = GrayBoxStructure.from_template(
        [[0, 1], [0, "-d"]], [[0], ["b"]], [[1, 0]]
    )
    runs = []
    for d, level in zip([1.0, 2.0, 3.0], [49.0, 50.0, 51.0], strict=True):
        u = rng.choice([-1.0, 1.0], (60, 1)).repeat(10, axis=0)
        y = level + structure.model([3.0, d]).simulate(u, sampling_time=STEP)
        runs.append((u, d, y + 1e-3 * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=STEP)
    model = LocalLPVPipeline(
        SubspaceLTI(integrating=True),
        GrayBoxRestructurer(structure),
        **OF_TRAJECTORIES,
    ).fit(X, y)
    begins = model.predict(X).reshape(3, -1)[:, 0]
    np.testing.assert_allclose(begins, 50.0, atol=0.2)


def test_deviations_are_unknown_where_one_has_no_continuous_time():
    lag, other, still = (StateSpace(a, 1.0, 1.0, 0.0, STEP) for a in (0.5, 0.6, 0.0))
    found = LocalModel(lag.to_continuous(), 1, None, pairs=[(lag, other)])
    assert [m.A.item() for m in found.deviated()[0]] == pytest.approx(
        [np.log(0.5) / STEP, np.log(0.6) / STEP]
    )
    found = LocalModel(lag.to_continuous(), 1, None, pairs=[(lag, still)])
    assert found.deviated() == []


SAMPLE, BIAS = 0.02, 0.2  # s, and of the drive


def position(u, inertia):
    """``inertia w' = 3 (u + bias) - w``, and its integral, from rest."""
    w, angle, y = 0.0, 0.0, []
    for force, J in zip(u + BIAS, inertia, strict=True):
        y.append(angle)
        decay = np.exp(-SAMPLE / J)
        end = 3.0 * force
        angle += end * SAMPLE + (w - end) * J * (1.0 - decay)
        w = end + (w - end) * decay
    return np.array(y)[:, None]


# the black box has a pole beside one, the structure at one
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the structure lies")
@pytest.mark.parametrize("integrating", [None, True])
def test_a_bias_is_known_to_the_lpv_model(integrating):
    rng = np.random.default_rng(0)

    def held(n):
        return np.repeat(rng.choice([-1.0, 1.0], n // 8), 8)

    runs = []
    for J in np.linspace(0.3, 1.2, 5):
        u = held(1600)
        y = position(u, np.full(1600, J)) + 0.002 * rng.standard_normal((1600, 1))
        runs.append((u[:, None], J, y))
    X, y = from_trajectories(runs, sampling_time=SAMPLE)
    J, u = 0.75 + 0.4 * np.sin(np.arange(2000) / 200), held(2000)
    truth = position(u, J)
    sweep, _ = from_trajectories([(u[:, None], J, truth)], sampling_time=SAMPLE)
    structure = GrayBoxStructure.from_template(
        [[0, 1], [0, "-d"]], [[0], ["k"]], [[1, 0]]
    )
    model = LocalLPVPipeline(
        SubspaceLTI(integrating=integrating),
        GrayBoxRestructurer(structure),
        **OF_TRAJECTORIES,
    ).fit(X, y)
    np.testing.assert_allclose(model.report_["u0_u1"], -BIAS, atol=5e-3)
    error = truth - model.predict(sweep).reshape(truth.shape)
    assert np.linalg.norm(error) < 0.03 * np.linalg.norm(truth - truth.mean())


def test_a_mode_that_stands_for_constants_does_not_tell_where_outputs_rest():
    """A battery of 3.5 V, whose model has a pole of 1e-5 for that and no constant."""
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], (60, 1)).repeat(5, axis=0)
    y = 3.5 + 0.1 * u
    run = Experiment(0, np.arange(300), u, y, sampling_time=1.0)
    fitted = SubspaceLTI(1, offset=None).fit(u, y - 3.5)
    fitted.offset, fitted.lti_ = "auto", StateSpace(1.0 - 1e-5, 0.1, 1.0, None, 1.0)
    lti = fitted.lti_.to_continuous()
    ((u0,), (y0,)) = equilibrium(lti, [fitted], [run])
    assert y0 == pytest.approx(3.5, abs=0.1)
    assert y0 == pytest.approx(lti.dc_gain().item() * u0)
    low = Experiment(0, np.arange(300), u, y - 3.5, sampling_time=1.0)
    assert equilibrium(lti, [fitted], [low]) == (0.0, 0.0)


@pytest.mark.parametrize("method, cheapest", [("po-moesp", 3), ("pbsid", 2)])
def test_states_of_the_noise_are_none_of_the_plant(method, cheapest):
    """Behind "pbsid" the criterion is that of both together: here of a third one."""

    class Fitted:
        method_, order_ = method, 2
        selection_ = pd.DataFrame(
            {"order": [0, 1, 2, 3, 4], "criterion": [9.0, 4.0, 1.0, 0.0, 0.5]}
        )

    run = Experiment(0, np.arange(9), np.ones((9, 1)), np.ones((9, 1)))
    costs = _costs(Fitted(), [run])
    assert min(costs, key=costs.__getitem__) == cheapest
    assert costs[cheapest - 1] == 9.0 and min(costs) == 0


def test_an_average_knows_no_units_and_turns_states_of_equal_singular_values():
    """Two axes that are alike: signs alone would average states turned anyhow."""
    axis = np.array([[0.0, 1.0], [-4.0, -0.8]])
    A, B = np.kron(np.eye(2), axis), np.kron(np.eye(2), [[0.0], [1.0]])
    plant = StateSpace(A, B, np.kron(np.eye(2), [[1.0, 0.0]]))
    rng, omega = np.random.default_rng(1), np.array([0.3, 2.0, 5.0])
    options = {"sampling_time": 0.1, "combine": "average", "discretization": "zoh"}
    records = []
    for k in range(4):
        u = np.sign(rng.standard_normal((400, 2)))
        y = plant.simulate(u, sampling_time=0.1)
        y += 0.02 * rng.standard_normal(y.shape)
        records.append(Experiment(k, np.arange(400), u, y))
    for size in ([1.0, 1.0], [1e5, 1.0]):
        scaled = [replace(e, inputs=e.inputs * size) for e in records]
        model = identify_point(SubspaceLTI(4), scaled, efficient=True, **options).lti
        G, G0 = model.frequency_response(omega), plant.frequency_response(omega)
        assert np.abs(G * size - G0).max() < 0.05 * np.abs(G0).max()
