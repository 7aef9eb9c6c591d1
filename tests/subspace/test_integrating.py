"""Outputs with an integrator: identified from their rates."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    bft_score,
    from_trajectories,
)
from lpvlearn.models.statespace import DEVIATION
from lpvlearn.pipeline.points.continuous_time import (
    integrating_outputs as _integrating_outputs,
)
from lpvlearn.subspace.fits.integrating import integrated

STEP = 0.02
SERVO = GrayBoxStructure.from_template(
    [[0, 1], [0, "-a"]], [[0], ["b"]], [[1, 0], [0, 1]]
)


def record(noise=0.0, seed=0, a=3.0, b=2.0, n=600):
    """Input, and angle and speed of a motor."""
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], size=(n // 5, 1)).repeat(5, axis=0)
    y = SERVO.model({"a": a, "b": b}).simulate(u, sampling_time=STEP)
    y = y + noise * y.std(axis=0) * rng.normal(size=y.shape)
    return u, pd.DataFrame(y, columns=["angle", "speed"])


def test_a_motor_is_identified_exactly_with_its_integrator():
    u, y = record()
    local = SubspaceLTI(1, sampling_time=STEP, integrating="angle").fit(u, y)
    assert local.order_ == 2
    assert np.abs(local.lti_.poles() - 1.0).min() < 1e-12
    omega = np.geomspace(0.1, 50.0, 30)
    truth = SERVO.model({"a": 3.0, "b": 2.0}).to_discrete(STEP)
    np.testing.assert_allclose(
        local.lti_.frequency_response(omega),
        truth.frequency_response(omega),
        rtol=1e-6,
        atol=1e-9,
    )
    assert local.score(u, y) > 1 - 1e-9
    level = y + np.array([40.0, 0.0])  # of an angle that no one has set to zero
    np.testing.assert_allclose(
        local.predict_with_initial_state(u, level), level, atol=1e-6
    )
    again = pickle.loads(pickle.dumps(local))
    np.testing.assert_array_equal(again.predict(u), local.predict(u))
    with pytest.warns(
        UserWarning, match=r"border of stability, .*: 1 of .* `integrating`"
    ):
        plain = local.set_params(integrating=None, order=2).fit(u, y)
    assert not hasattr(plain, "rates_")


def test_several_experiments_are_not_joined():
    parts = [record(seed=k) for k in range(3)]
    X = pd.concat(
        [pd.DataFrame({"u": u[:, 0], "run": k}) for k, (u, _) in enumerate(parts)]
    )
    y = pd.concat([y + [k, 0.0] for k, (_, y) in enumerate(parts)])  # other angles
    roles = {"sampling_time": STEP, "experiment": "run"}
    local = SubspaceLTI(1, integrating=["angle"], **roles).fit(X, y)
    poles = np.sort(local.lti_.to_continuous("zoh").poles().real)
    np.testing.assert_allclose(poles, [-3.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_nothing_is_left_of_the_fit_before():
    u, y = record(noise=0.01)
    local = SubspaceLTI(1, sampling_time=STEP).fit(u, y)
    local.set_params(integrating=[0]).fit(u, y)
    assert not hasattr(local, "initial_states_")
    with pytest.raises(ValueError, match="shape \\(n_outputs, n_inputs\\) = "):
        local.set_params(feedthrough=[[True] * 3] * 2).fit(u, y)


@pytest.mark.parametrize("integrating", [["angel"], [2], "x", [True]])
def test_outputs_must_be_known(integrating):
    with pytest.raises(ValueError, match="`integrating` must be None, True, or name"):
        SubspaceLTI(1, integrating=integrating).fit(*record(n=100))


def test_what_is_known_of_the_rates_is_asked_of_them():
    u, y = record(noise=0.01)
    local = SubspaceLTI(1, sampling_time=STEP, integrating=[0]).fit(u, y)
    assert not hasattr(local, "predictor_") and not hasattr(local, "poles_std_")
    for ask in (
        lambda: local.frequency_response_std([1.0]),
        lambda: local.residual_tests(u, y),
        lambda: local.predict_ahead(u, y),
    ):
        with pytest.raises(ValueError, match="Ask `rates_`"):
            ask()
    with pytest.raises(ValueError, match="`integrating` must be None in partial_fit"):
        local.partial_fit(u, y)
    with pytest.raises(ValueError, match="needs detrend=None"):
        SubspaceLTI(1, integrating=[0], offset="linear").fit(u, y)
    pairs = local.deviated_models()
    assert pairs and all(abs(m.poles() - 1.0).min() < 1e-12 for m in pairs[0])


@pytest.mark.slow
def test_deviations_of_integrated_models_are_those_of_the_estimates():
    """White noise on an angle is that of its model; its rates have it differenced."""
    found = {"angle": [], "rates": []}
    told = []
    for seed in range(30):
        u, y = record(noise=0.01, seed=seed, n=500)
        local = SubspaceLTI(1, horizon=5, sampling_time=STEP, integrating=True)
        local.fit(u, y["angle"])

        def pole(model):
            return float(model.poles().real.min())

        found["angle"].append(pole(local.lti_))
        found["rates"].append(pole(local.rates_.lti_))
        changes = [pole(a) - pole(b) for a, b in local.deviated_models()]
        told.append(np.linalg.norm(changes) / (2.0 * DEVIATION))
    spread = np.std(found["angle"])
    assert spread < 0.85 * np.std(found["rates"])
    assert 0.7 * spread < np.median(told) < 1.5 * spread
    assert abs(np.mean(found["angle"]) - np.exp(-3.0 * STEP)) < 3.0 * spread / 30**0.5


INERTIA = (1.0, 2.0, 3.0)


def servo_tables(noise=1e-3):
    trajectories = []
    for k, inertia in enumerate(INERTIA):
        u, y = record(noise, seed=k, a=3.0 / inertia, b=6.0 / inertia)
        trajectories.append((u, inertia, y.to_numpy()[:, :1]))
    X, y = from_trajectories(trajectories, sampling_time=STEP)
    return X, pd.DataFrame(np.asarray(y), columns=["angle"])


ANGLE = GrayBoxStructure.from_template([[0, 1], [0, "-a"]], [[0], ["b"]], [[1, 0]])
ROLES = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}


@pytest.mark.broad
@pytest.mark.parametrize("efficient", [False, True])
def test_a_servo_from_data_to_the_lpv_model(efficient):
    X, y = servo_tables()
    pipeline = LocalLPVPipeline(
        SubspaceLTI(integrating="angle"),
        GrayBoxRestructurer(ANGLE),
        efficient=efficient,
        **ROLES,
    ).fit(X, y)
    truth = np.array([[3.0 / j, 6.0 / j] for j in INERTIA])
    np.testing.assert_allclose(pipeline.parameters_[["a", "b"]], truth, rtol=0.01)
    assert np.isfinite(pipeline.parameters_std_).all().all()
    assert pipeline.score(X, y) > 0.999
    assert pipeline.lpv_.at(1.5).poles()[0] == 0.0
    assert pipeline.warnings_ == []


def test_models_with_integrators_are_not_averaged():
    X, y = servo_tables()
    pipeline = LocalLPVPipeline(
        SubspaceLTI(1, integrating=True),
        GrayBoxRestructurer(ANGLE),
        combine="average",
        **ROLES,
    )
    with pytest.raises(ValueError, match="`combine` must be 'pool'"):
        pipeline.fit(X, y)


def test_integrators_are_offered_by_name():
    drifting = StateSpace(
        [[1e-4, 1.0], [0.0, -3.0]], [[0.0], [1.0]], [[0.0, 1.0], [1.0, 0.0]]
    )
    assert "SubspaceLTI(integrating=[1])" in _integrating_outputs(drifting, 0.01)
    assert _integrating_outputs(drifting, 1e-5) == ""  # a long record would show it
    growing = StateSpace([[2.0, 1.0], [0.0, -3.0]], [[0.0], [1.0]], [[1.0, 0.0]])
    assert _integrating_outputs(growing, 1.9) == ""


def test_positions_begin_where_those_of_the_fit_did():
    """Of a rate that rests nothing tells where: three experiments begin at 50."""
    rng = np.random.default_rng(0)
    servo = StateSpace([[0.0, 1.0], [0.0, -2.0]], [[0.0], [3.0]], [[1.0, 0.0]])
    u = rng.choice([-1.0, 1.0], (4, 60, 1)).repeat(10, axis=1)
    y = 50.0 + np.array([servo.simulate(run, sampling_time=STEP) for run in u])
    y += 2e-4 * rng.standard_normal(y.shape)
    X = pd.DataFrame({"u": u[:3].ravel(), "run": np.repeat(range(3), 600)})
    options = {"integrating": True, "experiment": "run", "sampling_time": STEP}
    model = SubspaceLTI(1, **options).fit(X, y[:3].reshape(-1, 1))
    fresh = pd.DataFrame({"u": u[3].ravel(), "run": 0})
    assert bft_score(y[3], model.predict(fresh)) > 99.0
    level = SubspaceLTI(1, **options).fit(X, y[:3].reshape(-1, 1) - 50.0)
    assert level.begun_state_ is None


@pytest.mark.slow
def test_the_rates_of_a_loop_keep_what_acts_at_once():
    """Rates hold the input of their first sample, whatever a controller does."""
    friction, gain, n = 2.8, 7.0, 3000
    rng = np.random.default_rng(5)
    decay, ratio = np.exp(-friction * STEP), gain / friction
    wanted = np.repeat(rng.choice([-0.5, 0.5], n // 60), 60)
    wanted = wanted + 0.1 * np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    u, y = np.zeros((2, n))
    angle = speed = load = before = 0.0
    for k in range(n):
        y[k] = angle
        u[k] = 8.0 * (wanted[k] - angle) - (angle - before) / STEP
        before, load = angle, 0.95 * load + 0.2 * rng.standard_normal()
        final = ratio * (u[k] + load)
        angle += final * STEP + (speed - final) * (1 - decay) / friction
        speed = final + (speed - final) * decay
    with pytest.warns(UserWarning, match="closed loop"):
        model = SubspaceLTI(1, integrating=True, sampling_time=STEP).fit(u[:, None], y)
    rates = model.rates_
    assert rates.method_ == "pbsid"
    at_once = ratio * (1 - (1 - decay) / friction / STEP)
    np.testing.assert_allclose(rates.lti_.D.item(), at_once, rtol=0.2)
    static = rates.lti_.frequency_response([0.0]).real.item()
    np.testing.assert_allclose(static, ratio, rtol=0.3)


@pytest.mark.broad
@pytest.mark.parametrize("seed", [0, 1])
def test_differenced_noise_of_a_sensor_moves_no_plant(seed):
    """It would be taken for states, or for what a loop answers."""
    rng = np.random.default_rng(seed)
    w = 17.0
    A = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -(w**2), -0.2 * w]]
    servo = StateSpace(A, [[0.0], [0.0], [0.3 * w**2]], [[1.0, 0.0, 0.0]])
    u = np.repeat(rng.choice([-1.0, 1.0], 500), 5)[:, None]
    y = servo.simulate(u, sampling_time=0.02)
    y = y + 0.02 * y.std() * rng.standard_normal(y.shape)
    model = SubspaceLTI(integrating=True, sampling_time=0.02).fit(u, y)
    assert (model.order_, model.method_) == (3, "po-moesp")
    omega = np.geomspace(0.2, 80.0, 40)
    true = servo.frequency_response(omega)
    found = model.lti_.to_continuous().frequency_response(omega)
    assert np.abs(found - true).max() < 0.01 * np.abs(true).max()


def test_rates_that_are_mostly_noise_explain_their_sums():
    """The simulation error told of is that of the outputs."""
    u, y = record(noise=0.03)
    angle = y[["angle"]]  # a warning would be an error
    model = SubspaceLTI(sampling_time=STEP, integrating=True).fit(u, angle)
    assert model.rates_.residual_ > 0.5
    assert model.score(u, angle) > 0.9
    with pytest.warns(UserWarning, match="next to nothing of the.*outputs integrate"):
        noise = np.random.default_rng(0).normal(size=angle.shape)
        SubspaceLTI(1, sampling_time=STEP, integrating=True).fit(u, noise)


@pytest.mark.slow
def test_rates_of_an_output_that_answers_at_once_do_not_drop_out():
    """A battery, whose resistance makes one value at every step of a current."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-4.0, -2.0, 0.0, 2.0], 50), 40)[:, None]
    y = 7e-5 * np.cumsum(np.vstack([[[0.0]], u[:-1]]), axis=0) + 0.012 * u
    y = np.round(y + 5e-4 * rng.standard_normal(u.shape), 3)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        SubspaceLTI(integrating=True).fit(u, y)
    assert not any("drops out" in str(one.message) for one in caught)


def battery(u, noise, seed=99):
    """Voltages of a battery: its charge, a relaxation, and a resistance."""
    cells = StateSpace([[-0.07, 0], [0, 0]], [[1 / 800], [7e-5]], [[1, 1]], [[0.0136]])
    y = cells.simulate(u, sampling_time=1.0)
    return y + noise * np.random.default_rng(seed).standard_normal(y.shape)


@pytest.mark.parametrize("noise", [0.0, 5e-4])
def test_what_acts_at_once_on_an_output_that_integrates_is_none_of_its_rate(noise):
    rng = np.random.default_rng(2)
    u = np.repeat(rng.choice([-3.0, 0.0, 3.0], 100), 15)[:, None]
    y = battery(u, noise)
    model = SubspaceLTI(sampling_time=1.0, integrating=True).fit(u, y)
    assert model.method_ == "po-moesp"
    np.testing.assert_allclose(model.lti_.D, 0.0136, rtol=1e-9 if noise == 0 else 5e-3)
    truth = battery(u, 0.0)
    assert bft_score(truth, model.predict(u)) > (99.9 if noise == 0 else 97.0)
    flags, none = np.array([True]), np.zeros((1, 1))
    assert integrated(model.rates_.lti_, flags, none).D == 0.0


@pytest.mark.slow
def test_deviations_of_a_battery_are_those_of_its_resistance_as_well():
    rng = np.random.default_rng(2)
    u = np.repeat(rng.choice([-3.0, 0.0, 3.0], 60), 10)[:, None]
    found, std = [], []
    for seed in range(30):
        y = battery(u, 2e-3, seed)
        model = SubspaceLTI(1, sampling_time=1.0, integrating=True).fit(u, y)
        found.append(model.lti_.D.item())
        pairs = model.deviated_models()
        steps = [(a.D - b.D).item() / (2 * DEVIATION) for a, b in pairs]
        std.append(np.linalg.norm(steps))
    assert 0.7 < np.std(found) / np.mean(std) < 1.4
    assert abs(np.mean(found) - 0.0136) < 4 * np.std(found) / np.sqrt(30)


def test_a_resistance_that_may_be_a_controller_is_told():
    u = 3.0 * np.random.default_rng(0).standard_normal((1500, 1))
    y = battery(u, 5e-4)
    options = {"sampling_time": 1.0, "integrating": True}
    with pytest.warns(UserWarning, match="The former was taken.*feedthrough"):
        model = SubspaceLTI(**options).fit(u, y)
    np.testing.assert_allclose(model.lti_.D, 0.0136, rtol=5e-3)
    table = pd.DataFrame(y, columns=["v"]).astype("Float64")  # as of Arrow or a cloud
    with pytest.warns(UserWarning, match="The former was taken.*feedthrough"):
        same = SubspaceLTI(**options).fit(pd.DataFrame(u, columns=["i"]), table)
    np.testing.assert_array_equal(same.lti_.D, model.lti_.D)
    said = SubspaceLTI(**options, feedthrough=[[True]]).fit(u, y)
    np.testing.assert_allclose(said.lti_.D, 0.0136, rtol=5e-3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The inputs know the noise")
@pytest.mark.parametrize("seed", [0, 1])
def test_a_controller_that_answers_at_once_is_no_feedthrough_of_the_others(seed):
    """The records of the outputs tell so, not those of the rates."""
    rng, step = np.random.default_rng(seed), 0.02
    plant = StateSpace([[0, 1], [0, -2]], [[0], [5]], np.eye(2)).to_discrete(step)
    x, u, y = np.zeros(2), np.zeros((3000, 1)), np.zeros((3000, 2))
    for k in range(3000):
        y[k] = x + [0.01, 0.05] * rng.standard_normal(2)
        u[k] = 0.5 * rng.standard_normal() - 20.0 * y[k, 0] - 2.0 * y[k, 1]
        x = plant.A @ x + plant.B @ u[k]
    local = SubspaceLTI(sampling_time=step, integrating=[0])
    with pytest.warns(UserWarning, match="within the sample: of those that do not int"):
        local.fit(u, y)
    assert not local.lti_.D.any()
    gain = local.lti_.to_continuous().frequency_response([3.0])[0]
    true = plant.to_continuous().frequency_response([3.0])[0]
    assert np.linalg.norm(gain - true) < 0.05 * np.linalg.norm(true)


@pytest.mark.broad
@pytest.mark.parametrize("runs", [1, 3])
def test_outputs_that_integrate_begin_where_those_of_the_fit_did(runs):
    """A ship's heading: no motion tells its zero."""
    rng = np.random.default_rng(0)
    ship = StateSpace([[0, 1], [0, -0.05]], [[0], [0.002]], [[1, 0]]).to_discrete(1.0)
    tables, outputs = [], []
    for run in range(runs):
        u = 6 * rng.choice([-1.0, 1.0], size=20).repeat(30)
        y = 90 + ship.simulate(u)[:, 0]
        tables.append(pd.DataFrame({"rudder": u, "run": run}))
        outputs.append(y + 0.02 * rng.standard_normal(len(y)))
    X, y = pd.concat(tables, ignore_index=True), np.concatenate(outputs)[:, None]
    heading = SubspaceLTI(
        inputs=["rudder"], experiment="run", sampling_time=1.0, integrating=[0]
    ).fit(X, y)
    u = 6 * rng.choice([-1.0, 1.0], size=20).repeat(30)
    fresh = pd.DataFrame({"rudder": u, "run": 0})
    error = heading.predict(fresh).ravel() - 90 - ship.simulate(u)[:, 0]
    assert np.abs(error).max() < 0.03 * np.ptp(ship.simulate(u))
    rates = heading.lti_.A @ heading.begun_state_ - heading.begun_state_
    np.testing.assert_allclose(rates, 0.0, atol=1e-9)
    # what is about zero to the errors begins there
    about_zero = heading.fit(X, y - 90)
    assert about_zero.begun_state_ is None
