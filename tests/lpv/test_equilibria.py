"""Points of work of local models as one family."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import StateSpace
from lpvlearn.lpv.equilibria import _Family, _Statics, interpolated, points_of_work
from lpvlearn.lpv.spline import SplineLPV

ONE = (np.ones(1), np.ones(1))
SMALL = (0.1 * np.ones(1), np.ones(1))  # motions of the inputs about their levels
KAPPA = np.linspace(-1.2, 1.2, 13)[:, None]


def pendulum(angle, T=None):
    """``theta'' = u - sin(theta) - 0.3 theta'`` about an angle."""
    model = StateSpace([[0, 1], [-np.cos(angle), -0.3]], [[0], [1]], [[1, 0]])
    return model if T is None else model.transform(T)


def pendula(T=None):
    return [pendulum(k, T) for k in KAPPA[:, 0]]


def test_equilibria_of_one_system_stay_where_they_were_found():
    values = points_of_work(pendula(), KAPPA, np.sin(KAPPA), KAPPA, ONE)
    expected = np.hstack([np.sin(KAPPA), KAPPA, KAPPA, 0 * KAPPA])
    assert_allclose(values, expected, atol=1e-12)


def test_states_at_rest_follow_the_basis():
    T = np.array([[1.0, 2.0], [-1.0, 3.0]])
    values = points_of_work(pendula(T), KAPPA, np.sin(KAPPA), KAPPA, ONE)
    assert_allclose(values[:, 2:], KAPPA * T[:, 0], atol=1e-12)


def test_states_of_a_bent_family_meet_its_tangent():
    """Two springs in a row, of which the first hardens: ``A dx0 + B du0 = 0``."""
    q = np.linspace(0.0, 1.0, 60)[:, None]  # stretch of the first, y; u = q + q^3
    models = [
        StateSpace([[-(1 + 3 * p**2), 0.0], [0.7, -0.7]], [[1.0], [0.3]], [[1.0, 0]])
        for p in q[:, 0]
    ]
    values = points_of_work(models, q, q + q**3, q, ONE)
    du, x0 = np.gradient(values[:, 0]), values[:, 2:]
    for model, step, dx in zip(models, du, np.gradient(x0, axis=0), strict=True):
        assert_allclose(model.A @ dx + model.B[:, 0] * step, 0.0, atol=1e-3)
    assert_allclose(x0[:, 0], q[:, 0], atol=1e-12)


def test_inputs_about_one_level_are_moved_to_it():
    """What the experiments' means happen to be does not bend the interpolation."""
    rng = np.random.default_rng(0)
    stiffness = np.linspace(1.0, 4.0, 6)
    models = [StateSpace([[0, 1], [-k, -1.0]], [[0], [1]], [[1, 0]]) for k in stiffness]
    load = np.array([0.5, -1.0, 0.3, 2.0, 1.0, -0.2])  # an input that nobody measures
    u0 = 0.2 * rng.normal(size=6)
    y0 = (u0 + load) / stiffness
    columns = stiffness[:, None], u0[:, None], y0[:, None]
    values = points_of_work(models, *columns, ONE)
    assert_allclose(values[:, 0], u0.mean())
    assert_allclose(values[:, 1], (u0.mean() + load) / stiffness)
    x0 = np.column_stack([values[:, 1], np.zeros(6)])
    assert_allclose(values[:, 2:], x0, atol=1e-12)


def test_what_hardly_settles_rests_where_it_was_found():
    """Its gain, of 1e4 and hardly known, would take the output beyond all others."""
    models = [StateSpace(-rate, 1.0, 1.0) for rate in (1.0, 1e-4, 0.5)]
    u0, y0 = np.array([[0.0], [0.3], [-0.3]]), np.array([[3.0], [3.1], [3.2]])
    values = points_of_work(models, np.arange(3.0)[:, None], u0, y0, ONE)
    assert_allclose(values[:, 0], 0.0, atol=1e-15)
    assert_allclose(values[:, 1], [3.0, 3.1, 3.8])


@pytest.mark.parametrize("softer", [1.0, 4.0])
@pytest.mark.parametrize("u_zero, y_zero", [(0.0, 3.0), (2.0, 0.0)])
def test_zeros_of_sensors_move_no_state(u_zero, y_zero, softer):
    """Also where the static gain is the same at all points, and the modes are not."""
    rng, kappa = np.random.default_rng(0), np.linspace(1.0, 4.0, 6)[:, None]
    gains = softer / (kappa if softer > 1 else 1.0 + 0.0 * kappa)
    models = [
        StateSpace([[0, 1], [-k, -1.0]], [[0], [k * g]], [[1, 0]])
        for k, g in zip(kappa[:, 0], gains[:, 0], strict=True)
    ]
    u0 = u_zero + 0.1 * rng.normal(size=(6, 1))
    y0 = y_zero + gains * (u0 - u_zero) + 0.01 * rng.normal(size=(6, 1))
    values = points_of_work(models, kappa, u0, y0, ONE)
    for row, model in zip(values, models, strict=True):
        u, y, x = row[0], row[1], row[2:]
        assert_allclose(model.dc_gain()[0, 0] * (u - u_zero), x[0], atol=0.1)
        assert_allclose(model.C @ x, y - y_zero, atol=0.1)


def test_an_output_without_static_gain_has_an_offset_of_its_sensor():
    rates = [StateSpace([[0, 1], [-k, -1.0]], [[0], [1]], [[0, 1]]) for k in (1.0, 2.0)]
    kappa, y0 = np.array([[0.0], [1.0]]), np.array([[5.0], [4.0]])
    values = points_of_work(rates, kappa, np.zeros((2, 1)), y0, ONE)
    assert_allclose(values, [[0, 5, 0, 0], [0, 4, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("n_inputs, n_outputs", [(1, 3), (3, 1), (2, 2)])
def test_models_that_are_not_square_rest_where_they_say(n_inputs, n_outputs):
    rng = np.random.default_rng(1)
    A, B = -np.diag([1.0, 2.0, 3.0]), rng.normal(size=(3, n_inputs))
    C, D = rng.normal(size=(n_outputs, 3)), rng.normal(size=(n_outputs, n_inputs))
    models = [StateSpace(k * A, B, C, D) for k in (1.0, 2.0)]
    u0, w = rng.normal(size=(2, 2, n_inputs))
    gains = np.array([model.dc_gain() for model in models])
    y0 = np.einsum("kij,kj->ki", gains, u0 - w)
    scales = (rng.uniform(0.5, 2, n_inputs), rng.uniform(0.5, 2, n_outputs))
    values = points_of_work(models, np.array([[0.0], [1.0]]), u0, y0, scales)
    for row, model in zip(values, models, strict=True):
        u, y, x = np.split(row, [n_inputs, n_inputs + n_outputs])
        v = np.linalg.lstsq(B, -model.A @ x, rcond=None)[0]
        assert_allclose(model.A @ x + B @ v, 0.0, atol=1e-10)  # it is their answer
        assert_allclose(C @ x + D @ v, y, atol=1e-10)
    assert_allclose(y - gains[1] @ u, y0[1] - gains[1] @ u0[1], atol=1e-10)


@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_inputs_that_one_output_does_not_tell_apart_are_what_they_are(bias):
    """Two inputs, one output: the state at rest is that for both of them."""
    h = np.linspace(0.5, 2.0, 5)
    models = [
        StateSpace(
            [[-(k + 0.5), k], [0.2 * k, -0.2 * k - 0.1]],
            [[1.0, 0.5], [0.0, 0.1]],
            [[1.0, 0.0]],
        )
        for k in h
    ]
    u0 = np.tile([5.0, 8.0], (5, 1))
    states = [-np.linalg.solve(m.A, m.B @ u) for m, u in zip(models, u0, strict=True)]
    y0 = np.array([x[:1] for x in states]) + bias
    values = points_of_work(models, h[:, None], u0, y0, (np.ones(2), np.ones(1)))
    assert_allclose(values[:, 3:], states, rtol=1e-9)


def test_an_input_that_stands_still_moves_no_state():
    """Two tanks in a row, of which only the second one's pump and level change."""
    level = np.linspace(0.5, 3.0, 40)
    first = 0.25  # of the upper tank, whose pump stands still
    models = [
        StateSpace(
            [[-0.5 / first**0.5, 0], [0.5 / first**0.5, -0.5 / h**0.5]],
            np.eye(2),
            [[0, 1]],
        )
        for h in level
    ]
    u0 = np.column_stack([np.full(40, first**0.5), level**0.5 - first**0.5])
    columns = level[:, None], u0, level[:, None]
    values = points_of_work(models, *columns, (np.full(2, 0.1), np.ones(1)))
    steps = np.diff(values[:, 3:], axis=0)
    assert_allclose(steps[:, 0], 0.0, atol=1e-3)
    assert_allclose(steps[:, 1], np.diff(level), atol=1e-3)


def test_what_integrates_rests_at_any_output():
    models = [StateSpace([[0, 1], [0, -d]], [[0], [2.0]], [[1, 0]]) for d in (1.0, 3.0)]
    places = np.array([[0.0], [1.0]])
    values = points_of_work(models, places, np.ones((2, 1)), 7.0 + places, ONE)
    assert_allclose(values, [[1, 7, 7, 0], [1, 8, 8, 0]], atol=1e-9)


def motor(speed):
    """Currents of a synchronous motor: affine in its speed, as its back-EMF is."""
    w = float(np.ravel(speed)[0])
    A = [[-66.7, 1.5 * w], [-0.667 * w, -44.4]]
    return StateSpace(A, np.diag([83.3, 55.6]), np.eye(2))


def currents_at_rest(speed, u):
    model = motor(speed)
    return -np.linalg.solve(model.A, model.B @ u + [0.0, -6.67 * float(speed)])


@pytest.mark.parametrize("n_points, error", [(6, 1e-3), (4, np.inf)])
def test_equilibria_that_bend_follow_from_constants_that_do_not(n_points, error):
    rng = np.random.default_rng(0)
    speeds = np.linspace(0.0, 250.0, n_points)
    inputs = np.column_stack([rng.normal(-2.0, 0.3, n_points), 6.0 + 0.12 * speeds])
    rest = [currents_at_rest(w, u) for w, u in zip(speeds, inputs, strict=True)]
    values = np.hstack([inputs, rest, rest])

    def spline():
        return SplineLPV("cubic")

    kappa = speeds[:, None]
    found = interpolated(spline, kappa, values, motor, (np.ones(2), np.ones(2)))
    assert_allclose(found.predict(kappa), values, atol=1e-6 if n_points > 4 else 1e-9)
    between = 0.5 * (speeds[1:] + speeds[:-1])
    far, near = 0.0, 0.0
    alone = spline().fit(kappa, values)
    for w in between:
        for one in (alone, found):
            u, y, x = np.split(one.predict([[w]])[0], [2, 4])
            off = np.abs(y - currents_at_rest(w, u)).max()
            assert_allclose(x, y, atol=1e-6)
            far, near = (max(far, off), near) if one is alone else (far, max(near, off))
    assert far > 0.1
    assert near <= min(error, far)


@pytest.mark.parametrize("n_points", [3, 5])
@pytest.mark.parametrize("level", [lambda flow: 30.0 / flow, np.log])
def test_equilibria_are_followed_over_what_they_bend_less(level, n_points):
    """The temperature of what is heated while it flows by."""
    flows = np.linspace(0.5, 3.0, n_points)[:, None]

    def exchanger(flow):
        return StateSpace(-1.0, 1.0, 1.0)

    y = 20.0 + level(flows)
    values = np.hstack([60.0 + 0.0 * flows, y, y])
    found = interpolated(lambda: SplineLPV("cubic"), flows, values, exchanger, ONE)
    between = np.array([[0.6], [0.75], [1.25], [2.5]])
    # of levels from 10 to 60
    assert_allclose(found.predict(between)[:, 1:2], 20.0 + level(between), atol=0.1)


@pytest.mark.parametrize("n_points", [3, 4, 6])
def test_outputs_at_rest_are_what_the_models_answer_beside_one_constant(n_points):
    """Few points tell that, though their gains and inputs bend as they like."""
    rng = np.random.default_rng(n_points)
    kappa = np.linspace(0.5, 3.0, n_points)[:, None]

    def heated(flow):
        return StateSpace(-float(flow[0]), 1.0, 1.0)

    u = 40.0 + 5.0 * rng.normal(size=kappa.shape)
    x = u / kappa
    values = np.hstack([u, 20.0 + x, x])
    found = interpolated(lambda: SplineLPV(), kappa, values, heated, ONE)
    between = np.linspace(0.6, 2.9, 9)[:, None]
    u0, y0, x0 = found.predict(between).T
    assert_allclose(y0 - x0, 20.0, rtol=1e-9)
    assert_allclose(x0, u0 / between[:, 0], rtol=0.02)


def test_equilibria_that_do_not_bend_are_interpolated_as_they_are():
    """A spring: its point of work is linear in kappa, its constants are not."""

    def spring(kappa):
        return StateSpace(
            [[0, 1], [-1.0 - float(kappa[0]), -0.5]], [[0], [1]], [[1, 0]]
        )

    kappa = np.linspace(0.0, 2.0, 6)[:, None]
    y = 0.3 + kappa
    values = np.hstack([(1.0 + kappa) * y, y, y, 0.0 * y])
    found = interpolated(lambda: SplineLPV("cubic"), kappa, values, spring, ONE)
    assert found.n_points_ == 6


def tank(level):
    """``h' = u - sqrt(h)``, of which the level is measured."""
    return StateSpace([[-0.5 / np.sqrt(level[0])]], [[1.0]], [[1.0]])


def valve(opening):
    """``h' = u - log(h)``, of which the input is known."""
    return StateSpace([[-np.exp(-opening[0])]], [[1.0]], [[1.0]])


@pytest.mark.parametrize(
    "system, kappa, inputs, outputs",
    [
        (tank, [1.0, 4.0, 9.0, 16.0], np.sqrt, np.asarray),
        (valve, [0.0, 1.0, 2.0, 3.0], np.asarray, np.exp),
    ],
)
def test_equilibria_of_one_system_have_the_slopes_of_its_gains(
    system, kappa, inputs, outputs
):
    kappa = np.array(kappa)[:, None]
    models = [system(k) for k in kappa]
    values = points_of_work(models, kappa, inputs(kappa), outputs(kappa), SMALL)
    found = interpolated(lambda: SplineLPV("cubic"), kappa, values, system, ONE)
    alone = SplineLPV("cubic").fit(kappa, values)
    assert_allclose(found.predict(kappa), values, atol=1e-9)
    between = 0.5 * (kappa[1:] + kappa[:-1])
    truth = np.hstack([inputs(between), outputs(between)])
    ours, theirs = (
        np.abs(one.predict(between)[:, :2] - truth).max() for one in (found, alone)
    )
    assert ours < 0.5 * theirs


def test_outputs_that_measure_all_states_tell_where_these_rest():
    """A boost converter over its load, whose source is no input."""
    load = np.linspace(0.05, 0.25, 5)[:, None]
    models, x0 = [], []
    for g in load[:, 0]:
        A = np.array([[-0.6, -0.5], [0.5, -g]])
        x0.append(np.linalg.solve(-A, [12.0, 0.0]))
        current, voltage = x0[-1]
        models.append(StateSpace(A, [[voltage], [-current]], [[0, 1], [2, 0]]))
    outputs = np.array(x0) @ models[0].C.T + [3.0, -1.0]  # zeros of the sensors
    scales = np.array([0.02]), np.array([0.5, 0.2])
    inputs = np.full((5, 1), 0.5)
    values = points_of_work(models, load, inputs, outputs, scales)
    assert_allclose(values[:, :3], np.hstack([inputs, outputs]), rtol=1e-12)
    assert_allclose(np.diff(values[:, 3:], axis=0), np.diff(x0, axis=0), rtol=1e-9)


def test_a_plant_with_an_optimum_is_one_family_by_its_inputs():
    """Gains that are 10, 4, -2 and -8: their inverses have a pole between points."""
    u = np.array([0.5, 0.8, 1.1, 1.4])[:, None]
    y = 10.0 * (1.0 - (u - 1.0) ** 2)
    models = [
        StateSpace([[-2.0, 0.0], [60.0 * (1.0 - at), -3.0]], [[2.0], [0.0]], [[0, 1.0]])
        for at in u[:, 0]
    ]
    scales = np.array([0.04]), np.array([0.2])
    found = points_of_work(models, u, u, y, scales)
    np.testing.assert_allclose(found[:, :2], np.hstack([u, y]))
    steps = np.diff(np.hstack([u, y]), axis=0)
    np.testing.assert_allclose(np.diff(found[:, 2:], axis=0), steps, atol=1e-12)


def test_what_moves_outputs_without_inputs_makes_no_family_by_inputs():
    """Levels that an input of its own accord does not explain."""
    kappa = np.arange(4.0)[:, None]
    models = [StateSpace(-1.0 - k, 1.0, [[1.0], [0.5]]) for k in kappa[:, 0]]
    u = np.array([[0.0], [1.0], [0.0], [1.0]])
    y = np.hstack([10.0 * kappa, -3.0 * kappa])
    statics = _Statics.of(models, (np.ones(1), np.ones(2)))
    assert not _Family.of(statics, kappa, u, y, (np.ones(1), np.ones(2))).is_one


@pytest.mark.parametrize("seed", range(6))
def test_one_constant_of_the_sensors_is_no_family(seed):
    """Inputs that happen to go along with the scheduling explain most of the steps."""
    rng = np.random.default_rng(seed)
    kappa = np.linspace(0.0, 1.0, 5)[:, None]
    gain, rate = 1.0 + 0.1 * kappa[:, 0], 1.0 + kappa[:, 0]
    models = [
        StateSpace([[-a, 0], [1, -2]], [[a * g], [0]], [[0, 2.0]])
        for a, g in zip(rate, gain, strict=True)
    ]
    u = 3.0 * kappa + 0.3 * rng.standard_normal(kappa.shape)
    x = np.hstack([gain[:, None] * u, 0.5 * gain[:, None] * u])
    found = points_of_work(models, kappa, u, 2.0 * x[:, 1:] + 5.0, ONE)
    np.testing.assert_allclose(np.diff(found[:, 2:], axis=0), np.diff(x, axis=0))


def mixed(flow, rng, part=0.01):
    """A stream that is dosed, and a sensor whose slope is known to a part."""
    slope, rate = 2.0 * (1.0 + part * rng.standard_normal()), 0.1
    return StateSpace([[-flow, 0], [slope * rate, -rate]], [[1.0], [0]], [[0, 1.0]])


@pytest.mark.parametrize("seed", range(6))
def test_what_is_held_at_a_set_point_has_one_state_at_rest(seed):
    """Inputs of hundreds of motions, times what is not known of the models."""
    rng = np.random.default_rng(seed)
    flow = np.linspace(1.0, 2.2, 5)[:, None]
    models = [mixed(f, rng) for f in flow[:, 0]]
    u0, y0 = 100.0 * flow, 6.0 + 0.05 * rng.standard_normal(flow.shape)
    found = points_of_work(models, flow, u0, y0, ONE)
    assert_allclose(found[:, :2], np.hstack([u0, y0]))
    # the states of the sensor follow its outputs, those before it by its slope
    assert_allclose(np.diff(found[:, 3]), np.diff(y0[:, 0]), atol=1e-9)
    assert_allclose(found[:, 2], found[:, 2].mean(), atol=0.1)


def test_a_basis_that_turns_moves_no_state_that_is_held():
    """Black boxes: what a turn makes of a state far from zero is none of its motion."""
    rng = np.random.default_rng(0)
    flow = np.linspace(1.0, 2.2, 5)[:, None]
    turns = [np.array([[1.0, 0.1 * f], [-0.1 * f, 1.0]]) for f in flow[:, 0]]
    models = [
        mixed(f, rng).transform(T) for f, T in zip(flow[:, 0], turns, strict=True)
    ]
    work = models, flow, 100.0 * flow, np.full_like(flow, 6.0), ONE
    assert_allclose(np.ptp(points_of_work(*work, structured=False)[:, 2:], axis=0), 0.0)
    assert np.ptp(points_of_work(*work)[:, 2:], axis=0).min() > 1.0


@pytest.mark.parametrize("n_points", [3, 5])
def test_a_state_that_moves_while_the_output_is_held_moves_at_rest(n_points):
    """A heater in a stream that it keeps at one temperature: hotter with more."""
    rng = np.random.default_rng(0)
    flow = np.linspace(1.0, 2.2, n_points)[:, None]
    models = [
        StateSpace([[-h, h], [h, -h - f]], [[1.0], [0.0]], [[0.0, 1.0]])
        for f in flow[:, 0]
        for h in [5.0 * (1.0 + 0.01 * rng.standard_normal())]
    ]
    u0, y0 = 35.0 * flow, np.full_like(flow, 50.0)
    found = points_of_work(models, flow, u0, y0, ONE)
    assert_allclose(np.diff(found[:, 2]), np.diff(u0[:, 0]) / 5.0, atol=0.35)
    assert_allclose(np.ptp(found[:, 3]), 0.0, atol=1e-9)


FEED = np.linspace(8.0, 12.0, 5)[:, None]


def condenser(feed):
    """A pressure, and cooling that hardly acts where its valve is nearly open."""
    return StateSpace(-1.0, -5.0 * saturating(feed) ** -2, 1.0)


def saturating(feed):
    """A flow, from 2 to 40, of which one over it is linear."""
    return 1.0 / (0.5 - 0.475 * (np.ravel(feed)[0] - 8.0) / 4.0)


def test_inputs_that_saturate_are_followed_over_one_over_them():
    """And outputs that stand where they are do so between the points."""
    u0 = np.array([[saturating(f)] for f in FEED])
    y0 = np.full_like(u0, 25.0)
    scales = np.array([0.3]), np.array([0.2])
    values = np.hstack([u0, y0, y0])

    def spline():
        return SplineLPV("cubic")

    found = interpolated(spline, FEED, values, condenser, scales, tell=True)
    between = 0.5 * (FEED[1:] + FEED[:-1])
    u, y, x = found.predict(between).T
    assert_allclose(u, [saturating(f) for f in between], rtol=1e-6)
    assert_allclose([y, x], 25.0, rtol=1e-9)
    alone = spline().fit(FEED, values).predict(between)[:, 0]
    assert np.abs(alone / u - 1.0).max() > 0.1


def test_points_that_no_curve_foresees_are_told():
    """A valve that sticks at one of the points."""
    values = np.hstack([FEED, 25.0 + 0.0 * FEED, 25.0 + 0.0 * FEED])
    scales = np.array([0.3]), np.array([0.2])

    def first_order(feed):
        return StateSpace(-1.0, 1.0, 1.0)

    def spline():
        return SplineLPV("cubic")

    smooth = interpolated(spline, FEED, values, first_order, scales, tell=True)
    assert_allclose(smooth.predict(FEED + 0.5)[:4, 0], FEED[:4, 0] + 0.5)
    values[2, 0] += 30.0
    with pytest.warns(UserWarning, match="miss output 1 at rest by .* Measure in"):
        interpolated(spline, FEED, values, first_order, scales, tell=True)
