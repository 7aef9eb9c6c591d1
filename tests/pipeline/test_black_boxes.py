"""Black boxes in one basis: modes that go through zero, records that tell little."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import block_diag

from lpvlearn import (
    LocalLPVPipeline,
    SplineLPV,
    StateSpace,
    SubspaceLTI,
    bft_score,
    from_trajectories,
)
from lpvlearn.datasets import prbs
from lpvlearn.exceptions import collected
from lpvlearn.lpv.alignment import aligned_models
from lpvlearn.pipeline.one_basis.black_boxes import (
    _entries,
    _with_fast_states,
    aligned_black_boxes,
    tell_of_forced,
)
from lpvlearn.pipeline.points.local_models import LocalModel

from ..conftest import ROLES, modes

STEP = 0.1


def two_modes(kappa, nothing, by_inputs=False):
    """The second one's gain is zero at `nothing`."""
    gain = kappa - nothing
    A = modes((-0.1 + 1j) * (2.0 + 0.3 * kappa), (-0.1 + 1j) * (6.0 + 0.8 * kappa))
    B = np.array([[0.0], [2.0], [0.0], [6.0 * (gain if by_inputs else 1.0)]])
    C = np.array([[1.0, 0.0, 1.0 if by_inputs else gain, 0.0]])
    return StateSpace(A, B, C)


def local(lti, own=None):
    return LocalModel(lti, lti.order, 5, own=own)


def aligned(points, kappa, outputs=(1.0,)):
    """Of one input in units of one, and outputs in those given."""
    return aligned_black_boxes(points, kappa, np.ones(1), np.array(outputs), 1e9)


def errors_between(structure, theta, kappa, truth):
    form = SplineLPV().fit(kappa, theta)
    errors = []
    for middle in (kappa[1:, 0] + kappa[:-1, 0]) / 2.0:
        true = truth(middle)
        model = structure.model(form.predict([[middle]])[0])
        errors.append((model - true).hinf_norm() / true.hinf_norm())
    return np.array(errors)


@pytest.mark.parametrize("by_inputs", [True, False])
def test_a_gain_that_goes_through_zero_between_points_does_so_smoothly(by_inputs):
    """Balanced, entries go with its square root."""
    kappa = np.linspace(0.0, 2.0, 7)[:, None]

    def truth(kappa):
        return two_modes(kappa, 0.8, by_inputs)

    models = [truth(*k).balance() for k in kappa]
    structure, theta = aligned([local(m) for m in models], kappa)
    errors = errors_between(structure, theta, kappa, truth)
    balanced = _entries(aligned_models(models, kappa), False)
    before = errors_between(structure, balanced, kappa, truth)
    assert before.max() > 0.05 and errors.max() < 0.2 * before.max()


def test_balanced_states_are_kept_where_others_are_no_better():
    kappa = np.linspace(0.0, 1.0, 5)[:, None]
    models = [two_modes(k, -1.0).balance() for k in kappa[:, 0]]
    theta = aligned([local(m) for m in models], kappa)[1]
    expected = _entries(aligned_models(models, kappa), False)
    np.testing.assert_allclose(theta, expected, atol=1e-9)


def vanishing(place, kappas):
    """Tables of experiments; the mode vanishes at a point."""
    rng, runs = np.random.default_rng(0), []
    for kappa in kappas:
        u = rng.choice([-1.0, 1.0], (800, 1))
        y = two_modes(kappa, kappas[place]).simulate(u, sampling_time=STEP)
        noise = 0.03 * y.std() * rng.standard_normal(y.shape)
        runs.append((u, kappa, y + noise))
    return from_trajectories(runs, sampling_time=STEP)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "n_points", "order", "most"),
    [(2, 5, "auto", 0.05), (4, 5, "auto", 0.05), (2, 6, 4, 0.05), (1, 3, "auto", 0.1)],
)
def test_a_mode_that_vanishes_at_a_point_is_foretold_by_the_others(
    place, n_points, order, most
):
    """Whether or not the order is known, and of three points as well."""
    kappas = np.linspace(0.0, 2.0, n_points)
    X, y = vanishing(place, kappas)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(order), scheduling="kappa", experiment="experiment", time="time"
    )
    with pytest.warns(UserWarning, match=rf"operating point {place} .* does not tell"):
        fitted = pipeline.fit(X, y)
    assert len(fitted.operating_points_) == n_points
    assert (fitted.report_["order"] == 4).all()
    size = two_modes(1.0, kappas[place]).hinf_norm()
    for kappa in np.linspace(0.0, 2.0, 17):
        true = two_modes(kappa, kappas[place])
        assert (fitted.lpv_.at(kappa) - true).hinf_norm() < most * size


def test_units_of_the_channels_do_not_matter():
    """The second output alone shows the mode that goes through zero."""
    kappa = np.linspace(0.0, 2.0, 7)[:, None]

    def points(unit):
        for k in kappa[:, 0]:
            one = two_modes(k, 0.8)
            C = np.vstack([[1.0, 0.0, 0.0, 0.0], unit * one.C])
            yield local(StateSpace(one.A, one.B, C).balance())

    responses = []
    for unit in (1.0, 1e-6):
        structure, theta = aligned(list(points(unit)), kappa, (1.0, unit))
        form = SplineLPV().fit(kappa, theta)
        between = [structure.model(row) for row in form.predict(kappa[1:] - 0.15)]
        omega = np.geomspace(0.5, 20.0, 9)
        G = np.array([model.frequency_response(omega) for model in between])
        responses.append(G / np.array([[1.0], [unit]]))
    np.testing.assert_allclose(responses[1], responses[0], atol=1e-6)


def test_a_feedthrough_at_the_point_alone_is_no_parameter_of_it():
    """The other points foresee none there."""
    kappa = np.linspace(0.0, 2.0, 6)[:, None]
    models = [two_modes(k, 0.8) for k in kappa[:, 0]]
    points = [local(model.balance()) for model in models]
    one = models[2]
    own = StateSpace(one.A[:2, :2], one.B[:2], one.C[:, :2])
    A = modes(-0.2 + 2.24j, -3.0 + 40j)
    forced = StateSpace(A, [[0], [2.0], [0], [1e-3]], [[1, 0, 1e-3, 0]], [[1e-6]])
    points[2] = local(forced.balance(), local(own))
    with pytest.warns(UserWarning, match="does not tell all states"):
        structure, theta = aligned(points, kappa)
    assert structure.n_params == theta.shape[1] == 16 + 4 + 4 + 1
    foreseen = structure.model(theta[2])
    assert (foreseen - one).hinf_norm() < 0.05 * one.hinf_norm()
    assert foreseen.D == 0.0


def test_what_the_others_do_not_foretell_is_kept_and_told():
    """A point of another gain, whose second mode is noise."""
    kappa = np.linspace(0.0, 1.0, 7)[:, None]
    models = [two_modes(k, -1.0) for k in kappa[:, 0]]
    points = [local(model.balance()) for model in models]
    A = modes(-0.2 + 2.0j, -3.0 + 40j)
    odd = StateSpace(A, [[0.0], [6.0], [0.0], [0.1]], [[1.0, 0.0, 0.1, 0.0]])
    own = StateSpace(A[:2, :2], odd.B[:2], odd.C[:, :2])
    points[3] = local(odd.balance(), local(own))
    with pytest.warns(UserWarning, match="may be wrong from there to the next points"):
        structure, theta = aligned(points, kappa)
    kept = structure.model(theta[3])
    assert (kept - odd).hinf_norm() < 1e-9 * odd.hinf_norm()


def test_points_of_which_more_states_make_another_model_are_named():
    lag = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    faint, loud = (
        StateSpace(
            [[-1.0, 0.0, 0.0], [0.0, -0.1, 5.0], [0.0, -5.0, -0.1]],
            [[1.0], [gain], [0.0]],
            [[1.0, 1.0, 0.0]],
        )
        for gain in (1e-3, 1.0)
    )
    points = [local(faint), local(faint, local(lag)), local(loud, local(lag))]
    kappa = np.array([[0.0], [0.5], [1.0]])
    with pytest.warns(
        UserWarning, match=r"order 3.*\(operating point 2 \(sch.*: 5\d\d %"
    ):
        tell_of_forced(points, kappa, np.inf)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tell_of_forced(points[:2], kappa[:2], np.inf)
        tell_of_forced([replace(points[2], own=None)], kappa[2:], np.inf)
        tell_of_forced(points, kappa, np.inf, mended=[2])


def test_states_of_a_record_that_hardly_decay_within_it_are_not_told():
    lag = StateSpace([[-0.05]], [[0.5]], [[1.0]])
    A = modes(-1e-6 + 0.011j, -0.05)
    more = StateSpace(A, [[0.0], [1e-2], [0.5]], [[1e-2, 0.0, 1.0]])
    point = local(lag, local(more))
    with pytest.warns(UserWarning, match="does not tell so many states"):
        tell_of_forced([point], np.zeros((1, 1)), np.inf)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tell_of_forced([point], np.zeros((1, 1)), 900.0)
        grown = replace(point, own=replace(local(more), order=2))
        tell_of_forced([grown], np.zeros((1, 1)), np.inf)


# A state that is rounding has its pole anywhere.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the identified model of order 2 has 1 pole")
@pytest.mark.parametrize("vanishes", [0, 1, 2])
def test_a_mode_that_exact_records_do_not_have_at_a_point_is_foreseen(vanishes):
    def plant(z):
        return StateSpace(np.diag([-2.0, -8.0]), [[1.0], [1.0]], [[1.0, 2.0 * z]])

    places = 0.5 * (np.arange(3) - vanishes)
    inputs = [prbs(500, clock=5, random_state=i) for i in range(3)]
    runs = [
        (u, z, plant(z).simulate(u, sampling_time=0.03))
        for u, z in zip(inputs, places, strict=True)
    ]
    X, y = from_trajectories(runs, sampling_time=0.03)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    with pytest.warns(UserWarning, match="does not tell all states"):
        lpv = LocalLPVPipeline(**roles).fit(X, y).lpv_
    for z in np.linspace(places[0], places[-1], 5):
        true = plant(z)
        assert (lpv.at(z) - true).hinf_norm() < 0.03 * true.hinf_norm()


@pytest.mark.slow
def test_integrators_have_gains_of_any_size_and_states_of_one():
    """A position that a servo drives: its pole is anywhere near zero."""
    rng, tables = np.random.default_rng(0), []

    def servo(kappa):
        w = 12.0 / np.sqrt(kappa)
        A = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -(w**2), -0.2 * w]]
        return StateSpace(A, [[0.0], [0.0], [0.3 * w**2]], [[1.0, 0.0, 0.0]])

    for run, kappa in enumerate([0.5, 1.0, 1.5, 2.0]):
        u = np.repeat(rng.choice([-1.0, 1.0], 300), 5)[:, None]
        y = servo(kappa).simulate(u, sampling_time=0.02)[:, 0]
        y = y + 0.02 * y.std() * rng.standard_normal(len(y))
        columns = {"u": u[:, 0], "kappa": kappa, "run": run, "y": y}
        tables.append(pd.DataFrame(columns).assign(time=0.02 * np.arange(len(u))))
    table = pd.concat(tables, ignore_index=True)
    model = LocalLPVPipeline(**ROLES)
    with pytest.warns(UserWarning, match=r"Use local=SubspaceLTI\(integrating=\['y'\]"):
        model.fit(table.drop(columns="y"), table[["y"]])
    omega = np.geomspace(0.2, 80.0, 40)
    for kappa in (0.75, 1.25, 1.75):
        true = servo(kappa).frequency_response(omega)
        found = model.lpv_.at(kappa).frequency_response(omega)
        assert np.abs(found - true).max() < 0.03 * np.abs(true).max()


def test_outputs_that_show_all_states_are_the_states():
    """In any basis that the records have: C is the same at all points, then."""
    rng, kappa = np.random.default_rng(0), np.linspace(0.05, 0.25, 5)[:, None]
    points = []
    for g in kappa[:, 0]:
        A, B = np.array([[-0.6, -0.5], [0.5, -g]]), np.array([[12.0], [-2.0]])
        plant = StateSpace(A, B, [[0.0, 1.0], [2.0, 0.0]])
        points.append(local(plant.transform(rng.normal(size=(2, 2)))))
    structure, theta = aligned(points, kappa, (3.0, 4.0))
    found = [structure.model(row) for row in theta]
    for model, point in zip(found, points, strict=True):
        np.testing.assert_allclose(model.C, np.diag([3.0, 4.0]), atol=1e-9)
        assert (model - point.lti).hinf_norm() < 1e-8 * model.hinf_norm()


def hardening(u, mass, step=0.005):
    """Position (mm) of a mass on a spring that hardens by next to nothing."""
    size = 0.5 * step
    position, x, v = [], 0.0, 0.0

    def moved(x, v, force):
        return v, (force - 3.0 * v - 900.0 * x - 1e3 * x**3) / mass

    for force in u:
        position.append(1e3 * x)
        for _ in range(2):
            a = moved(x, v, force)
            b = moved(x + 0.5 * size * a[0], v + 0.5 * size * a[1], force)
            c = moved(x + 0.5 * size * b[0], v + 0.5 * size * b[1], force)
            d = moved(x + size * c[0], v + size * c[1], force)
            x += size / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0])
            v += size / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1])
    return np.array(position)


@pytest.mark.slow
def test_states_that_no_two_points_share_are_given_up():
    """What a sweep tells of a spring that hardens looks like modes beside the mode."""
    rng, t = np.random.default_rng(1), 0.005 * np.arange(2500)
    growth = np.log(50.0) / 12.5
    u = 10.0 * np.sin(2.0 * np.pi * 0.3 / growth * np.expm1(growth * t))
    trajectories = []
    for load in (0.0, 0.5, 1.0, 2.0):
        y = hardening(u, 1.0 + load)
        y = y + 0.02 * y.std() * rng.standard_normal(y.shape)
        trajectories.append((u, load, y))
    X, y = from_trajectories(trajectories, sampling_time=0.005)
    pipeline = LocalLPVPipeline(**ROLES | {"experiment": "experiment"})
    with pytest.warns(UserWarning) as told:  # of the gap between the last two, too
        pipeline.fit(X, y)
    messages = [str(warning.message) for warning in told]
    alone = re.compile("do not foresee one another: .* Order 2 was")
    assert any(map(alone.search, messages))
    fresh = 7.0 * np.repeat(rng.choice([-1.0, 1.0], 50), 20)
    free = {"scheduling": np.full(1000, 0.75), "sampling_time": 0.005}
    found = pipeline.lpv_.simulate(fresh, **free)[:, 0]
    assert bft_score(hardening(fresh, 1.75), found) > 80.0


@pytest.mark.parametrize("n_outputs", [1, 2])
def test_a_state_that_alternates_leaves_the_plant_as_it_is(n_outputs):
    """In continuous time it is a pair of poles, whose place a fast one takes."""
    plant = StateSpace(-1.0, 1.0, [[1.0], [-2.0]][:n_outputs]).to_discrete(0.5)
    sampled = StateSpace(
        np.diag([plant.A[0, 0], -0.6]),
        [*plant.B, [0.3]],
        np.hstack([plant.C, [[1.0], [0.5]][:n_outputs]]),
        sampling_time=0.5,
    )
    with pytest.warns(RuntimeWarning, match="a pair at the Nyquist frequency"):
        lti = sampled.to_continuous()
    assert lti.order == 3
    found = _with_fast_states(lti, 1)
    assert found.order == 2 and found.is_stable
    assert np.isclose(found.poles(), -1.0).any()
    np.testing.assert_allclose(found.dc_gain(), sampled.dc_gain(), rtol=1e-9)
    omega = np.linspace(0.0, 1.0, 5)
    G = lti.frequency_response(omega)
    error = found.frequency_response(omega) - G
    assert np.abs(error).max() < 0.03 * np.abs(G).max()
    truncated = lti.balance(2).frequency_response(omega) - G
    assert np.abs(truncated).max() > 3.0 * np.abs(error).max()


def test_equal_lags_beside_a_state_that_alternates_stay_as_they_are():
    """No basis of eigenvectors shows them."""
    lags = StateSpace([[-0.5, 0], [0.5, -0.5]], [[0.5], [0]], [[0, 1.0]]).to_discrete(1)
    A = block_diag(lags.A, -0.4)
    B, C = np.vstack([lags.B, [[0.1]]]), np.hstack([lags.C, [[0.3]]])
    sampled = StateSpace(A, B, C, sampling_time=1.0)
    with collected():  # of the pair
        lti = sampled.to_continuous().balance()
    found = _with_fast_states(lti, 1)
    assert found.order == 3
    np.testing.assert_allclose(found.dc_gain(), sampled.dc_gain(), rtol=1e-9)
    slow = np.sort_complex(found.poles())[1:]
    np.testing.assert_allclose(slow, -0.5, atol=1e-5)
