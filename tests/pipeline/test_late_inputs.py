"""Inputs that arrive late, of which nobody said so."""

import warnings

import numpy as np
import pytest

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    from_trajectories,
)

from .conftest import OF_TRAJECTORIES as ROLES

STEP = 0.1
LAG = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])


def records(delays, kappas=(1.0, 2.0, 3.0)):
    """First-order lags whose inputs act after so many samples, with noise of 1 %."""
    rng, runs = np.random.default_rng(0), []
    for kappa, delay in zip(kappas, delays, strict=True):
        u = np.repeat(rng.choice([-1.0, 1.0], 100), 4)
        lag = StateSpace([[-kappa]], [[2.0 * kappa]], [[1.0]])
        y = lag.simulate(np.roll(u, delay), sampling_time=STEP)
        y += 0.01 * y.std() * rng.standard_normal(y.shape)
        runs.append((u[delay:], kappa, y[delay:]))
    return from_trajectories(runs, sampling_time=STEP)


@pytest.mark.broad
@pytest.mark.parametrize("structure", [LAG, None], ids=["structure", "none"])
@pytest.mark.parametrize("delay", [1, 4])
def test_one_delay_of_all_points_is_found(structure, delay):
    X, y = records([delay] * 3)
    restructurer = None if structure is None else GrayBoxRestructurer(structure)
    with pytest.warns(UserWarning, match=rf"'u1'. arrive after .{delay}. samples"):
        chain = LocalLPVPipeline(restructurer=restructurer, **ROLES).fit(X, y)
    assert np.allclose(chain.lpv_.input_delay, delay * STEP)
    assert [model.order for model in chain.local_models_] == [1] * 3
    if structure is not None:
        off = chain.parameters_ - np.array([[1, 2], [2, 4], [3, 6]])
        assert (off.abs() < 4.0 * chain.parameters_std_).all(axis=None)


def test_who_asks_for_no_delay_has_none():
    X, y = records([4] * 3)
    chain = LocalLPVPipeline(
        SubspaceLTI(input_delay=[0]), GrayBoxRestructurer(LAG), **ROLES
    )
    with pytest.warns(UserWarning, match="lacks|shows|show"):
        chain.fit(X, y)
    assert not chain.lpv_.input_delay.any()


@pytest.mark.slow
def test_delays_that_differ_are_told_and_not_taken():
    X, y = records([2, 4, 6])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        chain = LocalLPVPipeline(restructurer=GrayBoxRestructurer(LAG), **ROLES)
        chain.fit(X, y)
    assert not chain.lpv_.input_delay.any()
    assert any("input_delay" in str(w.message) for w in told)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no form fits the parameters")
def test_points_that_are_asked_for_delays_keep_their_own_where_these_differ():
    delays = [2, 4, 6, 8]
    X, y = records(delays, kappas=(1.0, 1.3, 1.6, 2.0))
    chain = LocalLPVPipeline(SubspaceLTI(input_delay="auto"), **ROLES)
    with pytest.warns(UserWarning, match="delay differs between operating points"):
        chain.fit(X, y)
    own = [model.input_delay[0] / STEP for model in chain.local_models_]
    assert np.allclose(own, delays)
    assert [model.order for model in chain.local_models_] == [1] * 4
