"""SubspaceLTI: a scikit-learn estimator that simulates, chooses and teaches."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.utils.estimator_checks import parametrize_with_checks

from lpvlearn import StateSpace, SubspaceLTI, bft_score, from_trajectories
from lpvlearn.data.experiments import read_experiments
from lpvlearn.exceptions import DivergenceError, RankWarning
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes
from .conftest import sorted_poles


@pytest.mark.filterwarnings("ignore:The model explains:UserWarning")
@pytest.mark.filterwarnings("ignore:The data leave:lpvlearn.exceptions.RankWarning")
@pytest.mark.filterwarnings("ignore:A mode of the model does not:UserWarning")
@pytest.mark.filterwarnings("ignore:The model simulates parts of the:UserWarning")
@pytest.mark.filterwarnings("ignore:The identified model is unstable:UserWarning")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks([SubspaceLTI(), SubspaceLTI(method="pi-moesp", refine=False)])
def test_scikit_learn_contract(estimator, check):
    check(estimator)


def bft(y, fitted):
    error = np.linalg.norm(y - fitted, axis=0)
    return 100.0 * (1.0 - error / np.linalg.norm(y - y.mean(axis=0), axis=0))


def noisy(y, snr_db, rng):
    return y + y.std(axis=0) * 10 ** (-snr_db / 20) * rng.standard_normal(y.shape)


def arm_like(rng, n_samples=3000):
    """The difficulty of the arm at 1 ms: a slow pole beside fast modes."""
    A = modes(-0.7, -45.0, -3.8 + 52.6j, -46.0 + 121.0j)
    B = np.array(
        [[0.3, 0.2], [20.0, 12.0], [2.0, -3.0], [1.0, 2.0], [9.0, 6.0], [-8.0, 9.0]]
    )
    C = np.array([[1.0, 0.6, 1.0, 0.5, 0.7, 0.4], [-0.8, 1.0, 0.7, -1.0, 0.5, -0.6]])
    system = StateSpace(A, B, C).to_discrete(1e-3)
    n_switch = n_samples // 5 + 1
    u = 0.1 * np.repeat(rng.choice([-1.0, 1.0], (n_switch, 2)), 5, axis=0)[:n_samples]
    return system, u, system.simulate(u)


def resonant(rng):
    """Order 6, two inputs, two outputs, damping 0.01 to 0.02, feedthrough."""
    omega, zeta = rng.uniform(0.1, 2.5, 3), rng.uniform(0.01, 0.02, 3)
    A = modes(*np.exp(-zeta * omega + 1j * omega))
    shapes = (6, 2), (2, 6), (2, 2)
    return StateSpace(A, *(rng.standard_normal(s) for s in shapes), 1.0)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def table():
    """Three runs of a second-order system, rows interleaved at random."""
    rng = np.random.default_rng(3)
    A, B = np.array([[0.8, 0.3], [-0.3, 0.8]]), np.array([[1.0], [0.5]])
    C, D = np.array([[1.0, 0.0], [0.0, 2.0]]), np.zeros((2, 1))
    parts = []
    for run, n in zip("abc", (150, 200, 120), strict=True):
        u = rng.standard_normal((n, 1))
        y = lti_response(A, B, C, D, u, rng.standard_normal(2))
        parts.append(
            pd.DataFrame(
                {"u": u[:, 0], "run": run, "t": 0.01 * np.arange(n), "kappa": 0.5}
            ).assign(y1=y[:, 0], y2=y[:, 1])
        )
    order = np.argsort(np.concatenate([rng.random(len(p)).cumsum() for p in parts]))
    data = pd.concat(parts, ignore_index=True).iloc[order]
    return data[["u", "run", "t", "kappa"]], data[["y1", "y2"]]


ROLES = {"inputs": "u", "experiment": "run", "time": "t", "scheduling": "kappa"}


@pytest.mark.parametrize("method", ["po-moesp", "pi-moesp"])
def test_interleaved_experiments_are_identified_exactly(table, method):
    X, y = table
    model = SubspaceLTI(2, method=method, **ROLES).fit(X, y)
    np.testing.assert_allclose(model.lti_.poles(), [0.8 - 0.3j, 0.8 + 0.3j], atol=1e-8)
    assert model.lti_.sampling_time == pytest.approx(0.01)
    assert model.initial_states_.shape == (3, 2)
    fitted = model.predict_with_initial_state(X, y)
    np.testing.assert_allclose(fitted, y, atol=1e-7)
    assert abs(model.predict(X) - y.to_numpy()).max() > 0.1  # from rest


def test_split_experiments_lists_the_rows_of_every_run(table):
    X, y = table
    model = SubspaceLTI(2, horizon=5, **ROLES).fit(X, y)
    rows = model.split_experiments(X)
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(len(X)))
    for part in rows:
        assert X.iloc[part]["run"].nunique() == 1
        assert X.iloc[part]["t"].is_monotonic_increasing


def test_prediction_does_not_depend_on_the_order_of_experiments(table):
    X, y = table
    model = SubspaceLTI(2, horizon=5, **ROLES).fit(X, y)
    whole = pd.DataFrame(model.predict(X), index=X.index)
    by_run = X.sort_values("run", kind="stable", ascending=False)
    other = SubspaceLTI(2, horizon=5, **ROLES).fit(by_run, y.loc[by_run.index])
    np.testing.assert_allclose(
        other.predict(by_run), whole.loc[by_run.index], atol=1e-6
    )
    kept = X[X["run"] != "b"]
    np.testing.assert_allclose(model.predict(kept), whole.loc[kept.index], atol=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The scored table starts in mid-motion")
def test_grid_search_over_orders_with_experiments_as_groups(table):
    X, y = table
    search = GridSearchCV(
        SubspaceLTI(horizon=5, **ROLES), {"order": [1, 2]}, cv=GroupKFold(3)
    )
    with pytest.warns(UserWarning, match="order 1 lacks states"):
        search.fit(X, y, groups=X["run"])
    assert search.best_params_ == {"order": 2}


def test_single_output_predicts_one_dimension(rng):
    u = rng.standard_normal((200, 1))
    y = lti_response(*(np.array([[v]]) for v in (0.8, 1.0, 1.0, 0.0)), u)
    assert SubspaceLTI(1).fit(u, y[:, 0]).predict(u).shape == (200,)
    assert SubspaceLTI(1).fit(u, y).predict(u).shape == (200, 1)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [15, 30])
def test_resonant_system_in_noise_reaches_the_accuracy_of_maximum_likelihood(horizon):
    scores = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        system = resonant(rng)
        u, v = rng.standard_normal((2, 3000, 2))
        model = SubspaceLTI(6, horizon=horizon).fit(
            u, noisy(system.simulate(u), 30, rng)
        )
        scores.append(bft(system.simulate(v), model.predict(v)).mean())
    assert np.median(scores) > 99.7


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:horizon=.* ends in a poor model:UserWarning")
@pytest.mark.parametrize("method", ["po-moesp", "pi-moesp"])
@pytest.mark.parametrize("refine", [True, False])
def test_automatic_horizon_is_as_good_as_the_best_of_a_full_scan(method, refine):
    rng = np.random.default_rng(0)
    _, u, y = arm_like(rng)
    _, v, z = arm_like(np.random.default_rng(1000))
    y = noisy(y, 30, rng)
    options = {"method": method, "refine": refine}
    auto = bft(z, SubspaceLTI(6, **options).fit(u, y).predict(v)).mean()
    scan = [
        bft(z, SubspaceLTI(6, horizon=h, **options).fit(u, y).predict(v)).mean()
        for h in (40, 80, 120)
    ]
    assert auto > max(scan) - 0.3


@pytest.mark.slow
def test_automatic_order_on_the_slow_and_fast_system():
    orders = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        system, u, y = arm_like(rng)
        model = SubspaceLTI().fit(u, noisy(y, 30, rng))
        orders.append(model.order_)
        assert bft(y, model.predict(u)).min() > 99.0
    assert np.median(orders) == 6


@pytest.mark.slow
def test_zones_of_a_building_whose_heaters_add_up():
    """Jacobians of which many columns follow from others, as far as numbers tell."""
    n, dt, rng = 4, 0.25, np.random.default_rng(300)
    air = -1.85 * np.eye(n) + 0.3 * np.roll(np.eye(n), 1, axis=1)
    A = np.block([[air, np.eye(n)], [np.eye(n) / 20, -0.075 * np.eye(n)]])
    B = np.block([[2.0 * np.eye(n), np.full((n, 1), 0.25)], [np.zeros((n, n + 1))]])
    B[n:, n] = 1 / 40
    system = StateSpace(A, B, np.eye(n, 2 * n)).to_discrete(dt)
    heaters = np.repeat(rng.standard_normal((125, n)) > 0, 8, axis=0)
    daily = 10 + 6 * np.sin(2 * np.pi * dt * np.arange(1000) / 24)
    outside = daily + lfilter([0.1], [1, -0.98], rng.standard_normal(1000))
    u = np.column_stack([heaters, outside])
    rest = np.linalg.solve(np.eye(2 * n) - system.A, system.B @ u.mean(axis=0))
    y = system.simulate(u, initial_state=rest)
    model = SubspaceLTI(sampling_time=dt).fit(
        u, y + 0.05 * np.random.default_rng(0).standard_normal(y.shape)
    )
    assert bft(y, model.predict_with_initial_state(u, y)).min() > 98.0


def test_selection_table_shows_what_was_tried(rng):
    u = rng.standard_normal((400, 1))
    y = noisy(lti_response(*(np.array([[v]]) for v in (0.9, 1, 1, 0)), u), 20, rng)
    table = SubspaceLTI().fit(u, y).selection_
    columns = ["order", "horizon", "error", "criterion", "validation_bft", "chosen"]
    assert list(table) == columns
    row = table[table["chosen"]].iloc[0]
    assert row["order"] == 1 and row["validation_bft"] > 85
    # An order that is too low has a larger error.
    assert table[table["order"] == 0]["error"].min() > row["error"]


def test_pure_gain_and_pure_delay(rng):
    u = rng.standard_normal((300, 2))
    gain = np.array([[2.0, -1.0]])
    model = SubspaceLTI().fit(u, u @ gain.T)
    assert model.order_ == 0
    np.testing.assert_allclose(model.lti_.D, gain, atol=1e-10)
    delayed = np.vstack([np.zeros((3, 1)), u[:-3, :1]])
    with pytest.warns(UserWarning, match="only after 3 samples"):
        model = SubspaceLTI().fit(u[:, :1], delayed)
    assert model.order_ == 3
    np.testing.assert_allclose(model.predict(u[:, :1]), delayed, atol=1e-6)


def test_integrator_is_identified(rng):
    u = rng.standard_normal((500, 1))
    y = np.vstack([[0.0], np.cumsum(u, axis=0)[:-1]])
    with pytest.warns(UserWarning, match="on the border of stability.*: 1 of its"):
        model = SubspaceLTI(1).fit(u, y)
    np.testing.assert_allclose(model.lti_.poles(), [1.0], atol=1e-7)
    np.testing.assert_allclose(model.predict(u), y, atol=1e-4)


@pytest.mark.filterwarnings("ignore:Output 1 is .* in all samples")
def test_outputs_of_zero_give_a_model_of_zero(rng):
    u = rng.standard_normal((100, 2))
    for order in (0, 2, "auto"):
        model = SubspaceLTI(order).fit(u, np.zeros((100, 2)))
        assert not model.predict(u).any()


def test_collinear_inputs_warn_and_share_the_effect(rng):
    u = rng.standard_normal((300, 1))
    y = lti_response(*(np.array([[v]]) for v in (0.8, 1.0, 1.0, 0.0)), u)
    with pytest.warns(RankWarning, match="collinear"):
        model = SubspaceLTI(1).fit(np.hstack([u, u]), y)
    np.testing.assert_allclose(model.lti_.B[:, 0], model.lti_.B[:, 1])
    np.testing.assert_allclose(model.predict(np.hstack([u, u])), y, atol=1e-8)


@pytest.mark.parametrize("shape", [(10, 3), (15, 4), (21, 2), (6, 2), (4, 8), (2, 1)])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_tiny_tables_are_fitted(rng, shape):
    for n_outputs in (1, 5):
        X, y = rng.standard_normal(shape), rng.standard_normal((shape[0], n_outputs))
        model = SubspaceLTI().fit(X, y)
        assert model.predict(X).shape == y.shape


def test_unstable_system_warns_or_is_made_stable(rng):
    u = rng.standard_normal((300, 1))
    y = lti_response(*(np.array([[v]]) for v in (1.02, 1.0, 1.0, 0.0)), u)
    with pytest.warns(UserWarning, match="unstable"):
        model = SubspaceLTI(1).fit(u, y)
    np.testing.assert_allclose(model.lti_.poles(), [1.02], atol=1e-8)
    model = SubspaceLTI(1, stability="enforce").fit(u, y)
    assert model.lti_.is_stable


def test_unrelated_outputs_warn(rng):
    u, y = rng.standard_normal((2, 500, 1))
    with pytest.warns(UserWarning, match="next to nothing"):
        SubspaceLTI(2).fit(u, y)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"order": -1}, "`order` must be 'auto' or an integer of at least 0. Got -1"),
        ({"order": 2.0}, "`order` must be"),
        ({"order": True}, "`order` must be"),
        ({"order": [2, 3.5]}, r"or 1 to 1000 such integers, .* Got \[2, 3.5\]"),
        ({"order": range(0)}, r"`order` must be .* Got range\(0, 0\)"),
        ({"order": range(10**30)}, "or 1 to 1000 such integers"),
        ({"order": (4, -1)}, "integer of at least 0, or"),
        ({"order": [30, 31]}, "`order` must be at most 4 for 40 samples"),
        ({"horizon": 0}, "`horizon` must be 'auto' or an integer of at least 1"),
        (
            {"method": "arx"},
            "`method` must be 'auto', 'po-moesp', .* or 'pbsid'. Got 'arx'",
        ),
        ({"stability": "maybe"}, "`stability` must be 'warn' or 'enforce'"),
        ({"sampling_time": 0.0}, "`sampling_time` must be a positive"),
        ({"horizon": 20}, "`horizon` must be at most 5 for 40 samples"),
        (
            {"order": 8, "horizon": 4},
            "`order` must be at most 3 for 40 samples and horizon 4. Got 8.",
        ),
        ({"order": 30}, "`order` must be at most 4 for 40 samples"),
    ],
)
def test_options_are_refused_with_the_remedy(rng, options, message):
    X, y = rng.standard_normal((40, 2)), rng.standard_normal(40)
    with pytest.raises(ValueError, match=message):
        SubspaceLTI(**options).fit(X, y)


def test_constant_input_is_refused(rng):
    X = np.column_stack([rng.standard_normal(50), np.full(50, 2.0)])
    with pytest.raises(ValueError, match="Every input must vary. Got input 2"):
        SubspaceLTI().fit(X, X[:, 0])


def test_one_sample_is_refused():
    with pytest.raises(ValueError, match="n_samples = 1"):
        SubspaceLTI().fit([[1.0]], [1.0])


def test_clone_and_refit_give_the_same_model(table):
    X, y = table
    model = SubspaceLTI(2, horizon=6, **ROLES)
    first = model.fit(X, y).predict(X)
    np.testing.assert_array_equal(clone(model).fit(X, y).predict(X), first)


@pytest.mark.parametrize("given", [1.0, 1, 0.2])
def test_a_sampling_time_beside_a_time_column_must_agree_with_it(given):
    u = np.random.default_rng(0).standard_normal(100)
    X = pd.DataFrame({"u": u, "time": 0.1 * np.arange(100)})
    with pytest.raises(ValueError, match="`sampling_time` must be the step of the"):
        SubspaceLTI(1, time="time", sampling_time=given).fit(X, np.roll(u, 1))
    for agreed in (0.1, None):
        model = SubspaceLTI(1, time="time", sampling_time=agreed)
        assert model.fit(X, np.roll(u, 1)).lti_.sampling_time == pytest.approx(0.1)


def test_without_any_sampling_time_time_is_counted_in_samples():
    u = np.random.default_rng(0).standard_normal((100, 1))
    model = SubspaceLTI(1, horizon=5).fit(u, np.roll(u, 1))
    assert model.lti_.sampling_time is True
    known = SubspaceLTI(1, horizon=5, sampling_time=1).fit(u, np.roll(u, 1))
    np.testing.assert_array_equal(model.predict(u), known.predict(u))
    omega = np.linspace(0.1, 3.0, 4)
    np.testing.assert_array_equal(
        model.frequency_response_std(omega), known.frequency_response_std(omega)
    )
    with pytest.raises(ValueError, match="`time=`.*or `sampling_time=`"):
        model.lti_.to_continuous()
    stream = SubspaceLTI(1, horizon=5).partial_fit(u, np.roll(u, 1))
    assert stream.partial_fit(u, np.roll(u, 1)).lti_.sampling_time is True


@pytest.mark.filterwarnings("ignore:The identified model is unstable")
def test_predictions_that_diverge_name_experiment_and_sample():
    rng = np.random.default_rng(0)
    X = pd.DataFrame({"u": rng.normal(size=60), "run": "short"})
    y = lfilter([0.0, 1.0], [1.0, -1.5], X["u"])
    model = SubspaceLTI(1, horizon=4, experiment="run").fit(X, y)
    assert np.isfinite(model.predict(X)).all()
    long = pd.DataFrame({"u": rng.normal(size=3000), "run": "long"})
    both = pd.concat([X, long], ignore_index=True)
    for use in (
        model.predict,
        lambda both: model.score(both, both["u"]),
        lambda both: model.predict_with_initial_state(both, both["u"]),
    ):
        with pytest.raises(DivergenceError, match="Experiment 'long': .*pole at 1.5"):
            use(both)
    some = long.head(1000)  # to 1e176, whose square is no number
    with pytest.raises(DivergenceError, match=r"output 0 is .*e\+17\d in row 999, and"):
        model.score(some, some["u"])
    with pytest.raises(DivergenceError, match="in row 999, and"):
        model.score(some, some["u"], sample_weight=np.arange(1000) < 100)


def realizations(rng, n, noise=0.05, n_samples=600):
    """Tables of one system under one input, `n` experiments of new noise."""
    model = StateSpace(modes(0.9, 0.7 + 0.5j), np.ones((3, 1)), [[1, 1, 0]], None, 1.0)
    u = rng.standard_normal(n_samples)
    y = model.simulate(u)[:, 0]
    runs = [(u, 0.0, y + noise * rng.standard_normal(n_samples)) for _ in range(n)]
    return from_trajectories(runs)


@pytest.mark.parametrize("refine", ["auto", "simulation", False])
def test_each_experiment_has_the_model_of_its_own_fit(rng, refine):
    """Followers of the first: the same choices, the same minimum of their own."""
    X, y = realizations(rng, 4)
    roles = {"experiment": "experiment", "scheduling": "kappa"}
    models = SubspaceLTI(3, refine=refine, **roles).fit_each(X, y)
    options = {"horizon": models[0].horizon_, "offset": models[0].offset_}
    omega = np.linspace(0.0, 3.0, 50)
    for model, (_, own) in zip(models, X.groupby("experiment"), strict=True):
        alone = SubspaceLTI(3, refine=refine, **options, **roles)
        alone.fit(own, y.loc[own.index])
        G, G0 = (m.lti_.frequency_response(omega) for m in (model, alone))
        if refine is False:
            assert_allclose(G, G0, rtol=1e-9)
        else:
            assert (
                np.abs(G - G0) < 0.2 * np.abs(alone.frequency_response_std(omega))
            ).all()
        assert model.horizon_ == models[0].horizon_
        assert_allclose(model.residual_, alone.residual_, rtol=1e-3)


def test_an_experiment_unlike_the_first_is_fitted_on_its_own(rng):
    """Of another system: no few steps from the model of the first lead to its own."""
    X, y = realizations(rng, 2)
    last = (X["experiment"] == X["experiment"].iloc[-1]).to_numpy()
    other = StateSpace(modes(-0.8, 0.1 + 0.9j), np.ones((3, 1)), [[1, 0, 2]], None, 1.0)
    y = np.asarray(y).copy()
    y[last] = other.simulate(X["u1"].to_numpy()[last])
    roles = {"experiment": "experiment", "scheduling": "kappa"}
    models = SubspaceLTI(3, refine="simulation", **roles).fit_each(X, y)
    assert_allclose(models[1].lti_.poles(), other.poles(), atol=1e-6)


@pytest.mark.parametrize("missing", ["raise", "split", "estimate"])
def test_experiments_that_were_read_have_the_model_of_their_table(rng, missing):
    X, y = realizations(rng, 3)
    if missing != "raise":
        y.iloc[[50, 51, 700]] = np.nan
    model = SubspaceLTI(3, missing=missing, experiment="experiment", scheduling="kappa")
    whole = clone(model).fit(X, y)
    read = read_experiments(clone(model), X, y, allow_missing="Xy")
    found = clone(model).fit_experiments(read)
    assert_array_equal(found.lti_.A, whole.lti_.A)
    assert_array_equal(found.initial_states_, whole.initial_states_)
    assert found.lti_.input_names == whole.lti_.input_names == ["u1"]


def test_each_experiment_that_was_read_has_the_model_of_its_row(rng):
    X, y = realizations(rng, 3)
    model = SubspaceLTI(3, experiment="experiment", scheduling="kappa")
    read = read_experiments(clone(model), X, y)
    pairs = zip(model.fit_each(X, y), model.fit_each_experiment(read), strict=True)
    for own, other in pairs:
        assert_array_equal(other.lti_.A, own.lti_.A)
        assert other.lti_.output_names == own.lti_.output_names
    integrating = SubspaceLTI(3, integrating=True)
    with pytest.raises(ValueError, match="None in fit_experiments. Got True. Use"):
        integrating.fit_experiments(read)
    with pytest.raises(ValueError, match="`integrating` must be None in fit_each"):
        integrating.fit_each_experiment(read)
    for one in ([], X, [X]):
        with pytest.raises(ValueError, match="Use `fit`, which takes tables"):
            model.fit_experiments(one)


def test_each_needs_outputs_that_do_not_integrate(rng):
    X, y = realizations(rng, 2)
    with pytest.raises(ValueError, match="`integrating` must be None in fit_each"):
        SubspaceLTI(3, integrating=True, experiment="experiment").fit_each(X, y)


def step_test(first, last, level, n=300, delay=0):
    """A lag of gain one that stands at an input until it steps to another."""
    u = np.where(np.arange(n) < 60, first, last)[:, None]
    y = StateSpace([[0.95]], [[0.05]], [[1.0]], sampling_time=1.0).simulate(u - first)
    y = np.vstack([np.zeros((delay, 1)), y])[:n] + first + level
    return u, y + 0.05 * np.random.default_rng(0).standard_normal(y.shape)


@pytest.mark.parametrize("level", [0.0, 7.0])
@pytest.mark.parametrize("delay", [0, 4])
def test_step_tests_begin_where_they_stood(level, delay):
    """Not at rest about the means, of which most comes after the step."""
    u, y = step_test(30.0, 50.0, level, delay=delay)
    model = SubspaceLTI(1, input_delay=delay).fit(u, y)
    assert model.steady_start_
    assert model.score(u, y) > 0.999  # and no warning of mid-motion
    other, truth = step_test(45.0, 20.0, level, delay=delay)
    found = model.predict(other)
    np.testing.assert_allclose(found[0], 45.0 + level, atol=0.3)
    assert bft_score(truth, found) > 98.0
    ahead = model.predict_ahead(other, truth, initial_state="rest")
    np.testing.assert_allclose(ahead[0], 45.0 + level, atol=0.3)
    known = model.predict_with_initial_state(u, y)
    np.testing.assert_allclose(known, model.predict(u), atol=0.1)


def of_many_channels(seed, n_samples, n_states=3):
    """Inputs, outputs and plant of eight channels."""
    rng = np.random.default_rng(seed)
    u, poles = rng.standard_normal((n_samples, 3)), rng.uniform(0.5, 0.9, n_states)
    B, C = rng.standard_normal((n_states, 3)), rng.standard_normal((5, n_states))
    plant = StateSpace(np.diag(poles), B, C, None, 1.0)
    return u, plant.simulate(u), plant


def test_few_samples_of_many_channels_are_told():
    """A horizon of two, which states need, takes 19 of three inputs and an output."""
    u, y, _ = of_many_channels(0, 18)
    with pytest.warns(UserWarning, match=r"few samples \(18\).* Give a longer record"):
        assert SubspaceLTI().fit(u, y).order_ == 0


@pytest.mark.parametrize("order", ["auto", 3])
def test_outputs_show_states_alone_where_all_together_cannot(order):
    """All eight channels take 35 samples for a horizon of two."""
    u, y, plant = of_many_channels(0, 31)
    model = SubspaceLTI(order=order).fit(u, y)
    assert model.order_ == 3 and model.horizon_ > 1
    assert model.singular_values_.shape == (5 * model.horizon_,)
    np.testing.assert_allclose(
        sorted_poles(model.lti_.A), sorted_poles(plant.A), atol=1e-9
    )


@pytest.mark.parametrize(("n_samples", "n_experiments"), [(31, 1), (9, 3)])
@pytest.mark.parametrize("options", [{}, {"refine": False}, {"stability": "enforce"}])
def test_few_samples_of_many_channels_have_a_model(n_samples, n_experiments, options):
    u, y, plant = of_many_channels(1, n_samples * n_experiments)
    y = y + 0.02 * y.std(axis=0) * np.random.default_rng(2).standard_normal(y.shape)
    X = pd.DataFrame(u).add_prefix("u")
    X["test"] = np.repeat(np.arange(n_experiments), n_samples)
    model = SubspaceLTI(experiment="test", **options).fit(X, y)
    other = np.random.default_rng(3).standard_normal((300, 3))
    truth, found = plant.simulate(other), model.lti_.simulate(other)
    assert bft_score(truth, found) > 70.0


def test_runs_after_a_gap_are_no_beginnings():
    """A run that begins in motion may do so where inputs were held for a while."""
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], (300, 1)).repeat(10, axis=0)
    truth = StateSpace([[0.0, 8.0], [-8.0, -2.4]], [[0.0], [24.0]], [[1.0, 0.0]])
    y = truth.simulate(u, sampling_time=0.02)
    y += 0.03 * y.std() * rng.standard_normal(y.shape)
    y[rng.choice(3000, 8, replace=False)] = np.nan
    model = SubspaceLTI(2, sampling_time=0.02, missing="split").fit(u, y)
    assert len(model.initial_states_) > 8 and not model.steady_start_
    fresh = rng.choice([-1.0, 1.0], (100, 1)).repeat(10, axis=0)
    assert model.score(fresh, truth.simulate(fresh, sampling_time=0.02)) > 0.99


def test_records_that_begin_at_rest_go_on_doing_so():
    """With inputs that are held for long, too, and without a level."""
    rng = np.random.default_rng(0)
    u = rng.choice([-1.0, 1.0], (20, 1)).repeat(25, axis=0)
    y = StateSpace([[0.95]], [[0.05]], [[1.0]], sampling_time=1.0).simulate(u)
    y = y + 0.01 * rng.standard_normal(y.shape)
    for level in (0.0, 5.0):
        model = SubspaceLTI().fit(u, y + level)
        assert not model.steady_start_
    assert SubspaceLTI().fit(u, y).score(u, y) > 0.99
