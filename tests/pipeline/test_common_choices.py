"""What the operating points choose together: orders, delays, drifts."""

import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone

from lpvlearn import LocalLPVPipeline, StateSpace, SubspaceLTI
from lpvlearn.exceptions import collected
from lpvlearn.pipeline.points import common_choices
from lpvlearn.pipeline.points.common_choices import _of_own_orders
from lpvlearn.pipeline.points.local_models import LocalModel, identify_point
from lpvlearn.pipeline.running.runner import Done

from ..conftest import ROLES, spring_tables


class Restless(SubspaceLTI):
    """Takes a third state of large outputs, and tells the cost of every order."""

    def fit(self, X, y=None):
        if self.order != "auto":
            GAIN["fits"] += 1
            return super().fit(X, y)
        large = np.ptp(y) > 10.0
        found = clone(self).set_params(order=3 if large else 2).fit(X, y)
        vars(self).update(vars(found) | {"order": "auto"})
        costs = [9.0, GAIN["third"], 0.0] if large else [9.0, 0.0, 4.0]
        table = {"order": [1, 2, 3], "criterion": np.array(costs) / len(X)}
        self.selection_ = pd.DataFrame(table) if GAIN["third"] else None
        return self


GAIN = {"third": 0.0}  # of the third state there; 0: untold


@pytest.mark.broad
@pytest.mark.parametrize(("gain", "order"), [(5.0, 2), (50.0, 3), (0.0, 3)])
def test_without_a_structure_points_take_the_order_of_most_evidence(
    gain, order, monkeypatch
):
    monkeypatch.setitem(GAIN, "third", gain)
    monkeypatch.setitem(GAIN, "fits", 0)
    X, y = spring_tables(noise=0.01, n_samples=300)
    y = y.where(X["kappa"] > 0, 1e3 * y)  # the four points need two states
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a state too many may look like anything
        pipeline = LocalLPVPipeline(Restless(), **ROLES).fit(X, y)
    assert pipeline.report_["order"].tolist() == [order] * 4
    # those that took another one are fitted again; fewer states are not tried where
    # the outputs of a point have another unit
    assert GAIN["fits"] == 4 + (1 if order == 2 else 3)


class Everywhere(SubspaceLTI):
    """Looks for its order at every point as if it were alone."""


@pytest.mark.slow
def test_points_look_for_their_order_where_a_few_of_them_found_theirs():
    kappas = 0.2 * np.arange(7)
    X, y = spring_tables(noise=0.01, n_samples=300, kappas=kappas)
    near, alone = (
        LocalLPVPipeline(local, **ROLES).fit(X, y)
        for local in (SubspaceLTI(), Everywhere())
    )
    assert (near.report_["order"] == 2).all() and (alone.report_["order"] == 2).all()
    for one, other in zip(near.local_models_, alone.local_models_, strict=True):
        omega = np.geomspace(1.0, 50.0, 30)
        G, H = one.frequency_response(omega), other.frequency_response(omega)
        assert np.linalg.norm(G - H) < 1e-3 * np.linalg.norm(H)


@pytest.mark.parametrize(
    ("own", "again"),
    [((2, 2, 3, 2, 2), []), ((2, 5, 3, 4, 2), [1]), ((3, 3, 3, 1, 4), [3])],
)
def test_an_order_at_the_end_of_those_looked_at_is_looked_for_everywhere(own, again):
    searched = []

    def identify(local, known):
        done = []
        for k, (order, one) in enumerate(zip(own, known, strict=True)):
            if one is None:
                orders = range(31) if local.order == "auto" else local.order
                if local.order == "auto":
                    searched.append(k)
                lti = StateSpace.__new__(StateSpace)
                one = Done(
                    LocalModel(lti, int(np.clip(order, orders[0], orders[-1])), 5), []
                )
            done.append(one)
        return done

    scouts = [
        None if k % 2 else one
        for k, one in enumerate(identify(SubspaceLTI(), [None] * 5))
    ]
    searched.clear()
    found = _of_own_orders(SubspaceLTI(), identify, scouts, [None] * 5)
    assert [done.result.order for done in found] == list(own)
    assert searched == again


@pytest.mark.broad
@pytest.mark.parametrize(
    ("late", "options", "others"),
    [
        (2, {}, 0),
        (0, {}, 8),  # of a sample more, and of two
        (0, {"local__integrating": True}, 0),
        (0, {"combine": "average"}, 0),
    ],
)
def test_points_that_told_the_delay_are_not_identified_again(
    late, options, others, monkeypatch
):
    asked = []

    def counted(local, experiments, **how):
        asked.append(local.input_delay)
        return identify_point(local, experiments, **how)

    monkeypatch.setattr(common_choices, "identify_point", counted)
    X, y = spring_tables(noise=0.01, n_samples=150, n_repeats=2)
    shifted = y.groupby(X["run"]).shift(late).fillna(0.0)
    if "local__integrating" in options:
        shifted = shifted.groupby(X["run"]).cumsum()
    local = SubspaceLTI(2, input_delay="auto")
    pipeline = LocalLPVPipeline(local, "aligned", **ROLES).set_params(**options)
    with collected():
        pipeline.fit(X, shifted)
    assert pipeline.input_delay_.tolist() == [late]
    n_points = len(pipeline.operating_points_)
    assert asked.count("auto") == n_points and len(asked) == n_points + others


@pytest.mark.broad
@pytest.mark.parametrize("order", [[1, 2, 3], (3, 2), np.arange(1, 4)])
def test_points_take_one_of_several_orders_together(order):
    X, y = spring_tables(noise=0.01, n_samples=300)
    fitted = LocalLPVPipeline(SubspaceLTI(order=order), **ROLES).fit(X, y)
    assert (fitted.report_["order"] == 2).all()


@pytest.mark.slow
def test_what_drifts_at_some_points_is_looked_for_at_all():
    """Where it is not beyond doubt, a third mode would stand for it."""
    rng, X, Y = np.random.default_rng(0), [], []

    def plant(z):
        lag = 60.0 * (1.0 + 0.4 * z)
        A = [[-1.0 / lag, 0.0], [0.125, -0.125]]
        return StateSpace(A, [[1.0 / lag], [0.0]], [[0.0, 2.0 + z]])

    for run, z in enumerate([0.0, 0.5, 1.0, 1.5]):
        u = np.repeat(rng.choice([-1.0, 1.0], 30), 20)[:, None]
        y = plant(z).simulate(u, sampling_time=0.5)[:, 0]
        line = y.std() * rng.choice([-1.0, 1.0]) * np.linspace(0.0, 0.8, 600)
        Y.append(y + line + 0.01 * y.std() * rng.standard_normal(600))
        columns = {"u": u[:, 0], "kappa": z, "run": run, "time": 0.5 * np.arange(600)}
        X.append(pd.DataFrame(columns))
    model = LocalLPVPipeline(**ROLES).fit(pd.concat(X), np.concatenate(Y))
    for z in (0.25, 0.75, 1.25):
        true, found = plant(z), model.lpv_.at(z)
        assert found.order == 2
        assert (found - true).hinf_norm() < 0.05 * true.hinf_norm()


@pytest.mark.slow
def test_points_together_tell_that_outputs_drift():
    """Two tanks, not linear: each point alone has slow states for it, or grows."""
    rng, X, Y = np.random.default_rng(0), [], []
    for run, level in enumerate([1.5, 3.0, 5.0, 8.0]):
        u = 0.45 * np.sqrt(level) + 0.06 * np.repeat(rng.choice([-1.0, 1.0], 20), 20)
        levels, y = np.full(2, level), np.empty(400)
        for k in range(400):
            y[k] = levels[1]
            for _ in range(4):  # half a second each
                out = 0.45 * np.sqrt(levels)
                levels = levels + 0.125 * np.array([u[k] - out[0], out[0] - out[1]])
        size, drift = y.std(), rng.uniform(-1.5, 1.5)
        y += size * (drift * np.linspace(0, 1, 400) + 0.03 * rng.standard_normal(400))
        columns = {"u": u, "kappa": level, "run": run, "time": 2.0 * np.arange(400)}
        X.append(pd.DataFrame(columns))
        Y.append(y)
    model = LocalLPVPipeline(**ROLES).fit(pd.concat(X), np.concatenate(Y))
    for level in (2.2, 4.0, 6.5):
        found = model.lpv_.at(level)
        assert found.order == 2
        assert found.dc_gain().item() == pytest.approx(
            2.0 * np.sqrt(level) / 0.45, rel=0.1
        )


def test_points_of_which_none_has_a_model_are_refused_by_a_few(monkeypatch):
    fitted = []

    def refused(local, experiments, **options):
        fitted.append(experiments[0].label)
        raise ValueError(f"{fitted[-1]} must be stable")

    monkeypatch.setattr(common_choices, "identify_point", refused)
    X, y = spring_tables(kappas=np.arange(9.0), n_samples=50)
    with pytest.raises(ValueError, match="operating point 0 .* p0r0 must be"):
        LocalLPVPipeline(**ROLES).fit(X, y)
    # scouts, one with a drift, and two to tell the point from the options
    assert fitted == ["p0r0", "p4r0", "p8r0", "p0r0", "p0r0", "p8r0"]
