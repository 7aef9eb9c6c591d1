"""The choice of order and horizon, in its parts."""

import warnings

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.metrics import bft_score
from lpvlearn.subspace.diagnosis import fit_warnings
from lpvlearn.subspace.orders import selection
from lpvlearn.subspace.orders.identification import Settings
from lpvlearn.subspace.orders.selection import (
    _horizon_grid,
    select,
)
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.held_out import HeldOut, Part
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes, stable_model
from .conftest import POLES, example, experiment, freedom


def test_horizon_grid_is_increasing_and_holds_both_ends():
    for low, high in ((1, 1), (2, 2), (2, 3), (4, 125)):
        grid = _horizon_grid(low, high)
        assert grid[0] == low and grid[-1] == high
        assert (np.diff(grid) > 0).all()


def test_selection_finds_the_order_of_noise_free_data(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 400)
    settings = Settings(freedom(2, 2))
    chosen = select([Record.of(u, y)], None, None, settings)
    assert chosen.order == 6


def coloured(seed, n_samples, pole=0.9, level=0.3):
    rng = np.random.default_rng(seed)
    system = example(rng, modes(0.9 * np.exp(0.4j), 0.7), 1, 2)
    u, y = experiment(rng, system, n_samples)
    e = lfilter([1.0], [1.0, -pole], rng.standard_normal(y.shape), axis=0)
    return Record.of(u, y + level * y.std(axis=0) * e / e.std(axis=0))


@pytest.mark.slow
def test_coloured_noise_is_not_taken_for_states():
    orders = [
        select([coloured(seed, 600)], None, None, Settings(freedom(2, 1))).order
        for seed in range(6)
    ]
    assert sum(order == 3 for order in orders) >= 5 and max(orders) <= 4


def test_states_that_took_slow_noise_are_given_up_by_the_noise_without_them():
    """A mode of the pilot and a faster noise hold each other; another search frees."""
    orders, poles = [], (0.9 * np.exp(1.2j), 0.85 * np.exp(2.0j), 0.8 * np.exp(0.8j))
    for seed in (5, 6, 8, 9):
        rng = np.random.default_rng(seed)
        system = example(rng, modes(*poles), 1, 1)
        u = np.sign(rng.standard_normal((72, 1))).repeat(3, axis=0)
        y = lti_response(*system, u)
        e = lfilter([0.436], [1.0, -0.9], rng.standard_normal((416, 1)), axis=0)[200:]
        record = Record.of(u, y + 0.15 * y.std(axis=0) * e)
        orders.append(select([record], None, None, Settings(freedom(1, 1))).order)
    assert orders == [6, 6, 6, 6]


@pytest.mark.slow
def test_noise_that_a_rich_pilot_followed_is_found_by_the_order_itself():
    """Many channels, few samples: states too many take slow noise for answers."""
    orders = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        A = np.diag([0.8, 0.93, 0.975])
        B, C = rng.standard_normal((3, 5)), rng.standard_normal((3, 3))
        B *= np.sqrt(1.0 - np.diag(A) ** 2)[:, None]
        u = np.repeat(rng.standard_normal((24, 5)), 5, axis=0)
        y = lti_response(A, B, C, np.zeros((3, 5)), u)
        white = rng.standard_normal((220, 3))
        e = lfilter([0.436], [1.0, -0.9], white, axis=0)[100:]
        y += 0.1 * y.std(axis=0) * e
        u, y = (z / np.sqrt(np.mean(z**2, axis=0)) for z in (u, y))
        chosen = select([Record.of(u, y)], None, None, Settings(freedom(3, 5)))
        orders.append(chosen.order)
    # Two states may simulate the parts held out better than the three of the system.
    assert set(orders) <= {2, 3} and orders.count(3) > orders.count(2)


@pytest.mark.slow
def test_parts_held_out_decide_where_the_criterion_hardly_does():
    n_close = 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        system = example(rng, modes(0.6 * np.exp(0.5j), 0.8), 1, 1)
        u = np.sign(rng.standard_normal((80, 1))).repeat(3, axis=0)
        y = lti_response(*system, u)
        y = y + y.std() * rng.standard_normal(y.shape)
        chosen = select([Record.of(u, y)], None, None, Settings(freedom(1, 1)))
        table = chosen.table.dropna(subset="criterion").set_index("order")
        least = table["criterion"].idxmin()
        gap = len(y) * (table["criterion"] - table["criterion"].min())
        close = table[(gap < 4.0) & (table.index >= least)]["validation_bft"]
        assert close.notna().all()
        n_close += len(close) - 1
        if chosen.order > least:
            assert close[chosen.order] > close[least]
    assert n_close > 0


@pytest.mark.parametrize("bft, order", [(0.0, 3), (20.0, 1)])
def test_parts_that_no_order_explains_do_not_refute_one(monkeypatch, bft, order):
    """Inputs that rest where parts are held out tell nothing of what they drive."""

    def validate(candidate, records, settings):
        n = len(candidate.model.A)
        error = (1.0 + n) * np.ones((50, 2))
        part = Part(error, np.zeros((50, 2, 0)), np.eye(2))
        return HeldOut([part], bft, float((error**2).sum()))

    monkeypatch.setattr(selection, "validate", validate)
    chosen = select([coloured(0, 600)], None, None, Settings(freedom(2, 1)))
    assert chosen.order == order


@pytest.mark.parametrize("certain, order", [(selection.CERTAIN, 3), (np.inf, 2)])
def test_less_beside_common_unknowns_does_not_refute_what_is_far_likelier(
    monkeypatch, certain, order
):
    """A slow free motion of the likelier order hides that its own errors are less."""
    time = np.arange(40.0)[:, None]
    slow, hum = np.sin(0.1 * time) + np.zeros(2), 0.1 * np.cos(2.0 * time) * np.ones(2)

    def validate(candidate, records, settings):
        rich = len(candidate.model.A) == 3
        error = hum if rich else 0.5 * hum + 0.1 * slow
        free = slow[:, :, None] * np.eye(2) if rich else np.zeros((40, 2, 0))
        part = Part(error, free, np.eye(2))
        total = float((part.without(free) ** 2).sum())
        return HeldOut([part], 20.0, total)

    monkeypatch.setattr(selection, "validate", validate)
    monkeypatch.setattr(selection, "CERTAIN", certain)
    chosen = select([coloured(0, 600)], None, None, Settings(freedom(2, 1)))
    assert chosen.order == order


def _ladder(n_stages):
    """Chains of coils and capacitors, with a resistor at the end."""
    A = np.zeros((2 * n_stages, 2 * n_stages))
    for i in range(n_stages):
        current, voltage = 2 * i, 2 * i + 1
        A[current, current], A[current, voltage] = -2.0, -1.0
        A[voltage, current] = 100.0
        if i > 0:
            A[current, voltage - 2] = 1.0
            A[voltage - 2, current] = -100.0
    A[-1, -1] = -1.0
    B, C = np.eye(2 * n_stages)[:, :1], np.eye(2 * n_stages)[-1:]
    return StateSpace(A, B, C).to_discrete(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_resonances_that_noise_could_be_do_not_end_the_search(seed):
    # A long autoregression imitates those that an order lacks, so that the criterion
    # rises over several orders before it falls to its minimum.
    rng, plant = np.random.default_rng(seed), _ladder(4)
    u = np.repeat(rng.choice([-1.0, 1.0], (1000, 1)), 4, axis=0)
    y = plant.simulate(u)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    model, fresh = SubspaceLTI().fit(u, y), rng.standard_normal((2000, 1))
    assert model.order_ == 8
    assert bft_score(plant.simulate(fresh), model.lti_.simulate(fresh)) > 99.0


@pytest.mark.slow
def test_the_highest_order_that_is_tried_is_told(monkeypatch):
    monkeypatch.setattr(selection, "MAX_ORDER", 4)
    monkeypatch.setattr(fit_warnings, "MAX_ORDER", 4)
    rng = np.random.default_rng(1)
    u = rng.standard_normal((2000, 1))
    y = _ladder(4).simulate(u)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert SubspaceLTI(method="po-moesp").fit(u, y).order_ == 4
    assert any("is the highest that is tried, 4" in str(w.message) for w in told)


def test_losses_do_not_rise_with_the_order():
    chosen = select([coloured(1, 300)], None, None, Settings(freedom(2, 1)))
    table = chosen.table.dropna(subset="criterion").set_index("order")["criterion"]
    n_values, per_state = 2 * (300 - 1), 1 + 2 + 1
    # Without the price of the parameters only the logarithm of the loss is left.
    loss = table - table.index * per_state * np.log(n_values) / n_values
    assert (loss.diff().dropna() < 1e-3).all()


@pytest.mark.slow
def test_parts_where_nothing_happens_do_not_overrule_the_step_before_them():
    """Noise is all that is left of a lag there: an order too low does as well."""
    rng = np.random.default_rng(0)
    for _ in range(2):
        u = (np.arange(66) >= 5).astype(float)[:, None]
        y = lfilter([0.0, 0.0, 0.4], [1.0, -0.6], u, axis=0)
        y += 0.01 * rng.standard_normal(y.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            model = SubspaceLTI().fit(u, y)
        assert model.order_ >= 2 and model.residual_ < 0.05


def test_orders_out_of_the_question_are_not_simulated_on_parts_held_out(rng):
    """Of errors a thousandth of the outputs they are, of half of these they are not."""
    system = example(rng, modes(0.9 * np.exp(0.5j)), 1, 1)
    u = rng.standard_normal((400, 1))
    y = lti_response(*system, u)
    e = y.std() * rng.standard_normal(y.shape)
    for level, lower in ((1e-3, [False, False]), (0.5, [True, True])):
        records = [Record.of(u, y + level * e)]
        chosen = select(records, None, None, Settings(freedom(1, 1)))
        best = chosen.table.dropna(subset="criterion").set_index("order")
        known = best["validation_bft"].notna()
        assert chosen.order == 2 and known[2] and known[[0, 1]].tolist() == lower


@pytest.mark.slow
def test_the_noise_of_the_choice_goes_with_it():
    chosen = select([coloured(2, 2000)], None, None, Settings(freedom(2, 1)))
    np.testing.assert_allclose(chosen.candidate.whitening.filter[1], -0.9, atol=0.05)
    plain = Settings(freedom(2, 1), weigh=False)
    other = select([coloured(2, 2000)], None, None, plain)
    assert other.candidate is None and other.order == chosen.order


@pytest.mark.broad
@pytest.mark.parametrize("method", ["po-moesp", "pbsid"])
@pytest.mark.parametrize(
    ("among", "chosen"),
    [(range(2, 7), 4), ([9, 4, 2], 4), (np.arange(3), 2), ((3, 6, 5), 5), ([3], 3)],
)
def test_the_order_is_chosen_among_those_given(method, among, chosen):
    rng = np.random.default_rng(3)
    truth = stable_model(3, 4, 1, 1, sampling_time=1.0)
    u = rng.standard_normal((800, 1))
    y = truth.simulate(u)
    y += 1e-3 * y.std() * rng.standard_normal(y.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of orders that are not the system's
        model = SubspaceLTI(among, method=method, sampling_time=1.0).fit(u, y)
    assert model.order_ == chosen
    tried = set(model.selection_["order"])
    assert method == "pbsid" or tried <= set(among)


def test_orders_beyond_those_of_auto_are_tried_where_they_are_asked_for(rng):
    u = rng.standard_normal((2000, 1))
    y = lti_response(*(np.array([[v]]) for v in (0.9, 1.0, 1.0, 0.0)), u)
    y += 0.1 * rng.standard_normal(y.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of states that the data do not tell
        model = SubspaceLTI([31, 32], horizon=40, refine="simulation").fit(u, y)
    assert set(model.selection_["order"]) == {31, 32}


def test_all_orders_given_are_as_none():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 1))
    y = stable_model(0, 3, 1, 2, sampling_time=1.0).simulate(u)
    y += 0.1 * rng.standard_normal(y.shape)
    whole, given = (SubspaceLTI(order).fit(u, y) for order in ("auto", range(31)))
    for name in "ABCD":
        np.testing.assert_array_equal(
            getattr(whole.lti_, name), getattr(given.lti_, name)
        )


def test_a_given_order_is_kept_and_its_horizon_found():
    for order in (1, 3, 6):
        settings = Settings(freedom(2, 1))
        chosen = select([coloured(3, 400)], order, None, settings)
        assert chosen.order == order == len(chosen.candidate.model.A)
        assert set(chosen.table["order"]) == {order}


def test_a_given_horizon_bounds_the_orders_that_are_tried():
    record, settings = coloured(0, 300, pole=0.0), Settings(freedom(2, 1))
    for horizon in (1, 2, 4):  # fewer rows than the pilot has states
        chosen = select([record], None, horizon, settings)
        assert chosen.horizon == horizon
        assert chosen.order <= settings.max_order(horizon)
    assert chosen.order == 3


@pytest.mark.slow
def test_many_short_experiments_tell_the_order():
    """Every twentieth output is missing at random, which leaves some 20 in a row."""
    rng, A = np.random.default_rng(0), modes(0.95 * np.exp(0.3j), 0.8)
    system = A, np.ones((3, 1)), np.ones((1, 3)), np.zeros((1, 1))
    u = rng.standard_normal((1000, 1))
    y = lti_response(*system, u)
    y += 0.1 * y.std() * rng.standard_normal(y.shape)
    y[rng.choice(1000, 50, replace=False)] = np.nan
    with pytest.warns(UserWarning, match="Use missing='estimate'"):
        model = SubspaceLTI(missing="split").fit(u, y)
    assert model.order_ == 3
    exact = lti_response(*system, u)
    error = exact - model.lti_.simulate(u)
    assert np.linalg.norm(error) < 0.03 * np.linalg.norm(exact)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_outputs_behind_a_filter_have_their_order(seed):
    """What such an output makes of its own past is likelier than any few states."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], (667, 1)), 3, axis=0)
    A = modes(0.98 * np.exp(0.1j), 0.97)
    system = StateSpace(A, [[0], [1], [1]], [[1, 0, 1]], None, 1.0)
    exact = system.simulate(u)
    y = exact + 0.05 * exact.std() * rng.standard_normal(exact.shape)
    exact, y = (lfilter(*butter(4, 0.15), signal, axis=0) for signal in (exact, y))
    model = SubspaceLTI().fit(u, y)
    assert model.order_ >= 5
    error = exact - model.lti_.simulate(u)
    assert np.linalg.norm(error) < 0.02 * np.linalg.norm(exact)
