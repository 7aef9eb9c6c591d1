"""The choice of order and horizon, in its parts."""

import numpy as np
import pytest

from lpvlearn.subspace.identification import Settings
from lpvlearn.subspace.selection import (
    _held_out_error,
    _horizon_grid,
    _smallest_good_order,
    select,
)
from lpvlearn.subspace.signals import Record
from lpvlearn.subspace.simulation_fit import Realization

from ..conftest import modes
from .conftest import POLES, example, experiment, freedom


def test_horizon_grid_is_increasing_and_holds_both_ends():
    for low, high in ((1, 1), (2, 2), (2, 3), (4, 125)):
        grid = _horizon_grid(low, high)
        assert grid[0] == low and grid[-1] == high
        assert (np.diff(grid) > 0).all()


def test_order_rule_ignores_insignificant_gains(rng):
    noise = 1.0 + 0.1 * rng.standard_normal(20)
    blocks = [3.0 * noise, noise + 1e-6, noise - 1e-3 * rng.standard_normal(20)]
    assert _smallest_good_order(dict(zip([1, 2, 3], blocks, strict=True))) == 2
    assert _smallest_good_order({0: np.array([np.nan]), 1: np.ones(1)}) == 1


def test_held_out_error_is_measured_after_the_cut(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 100)
    y = y.copy()
    y[:70] += 1.0
    model = Realization(*system, np.zeros((1, 6)), 0.0)
    blocks, bft = _held_out_error(model, [Record(u.T, y.T)], [70])
    assert blocks.sum() < 1e-18
    assert bft == pytest.approx(100.0)


def test_selection_finds_the_order_of_noise_free_data(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 400)
    settings = Settings(freedom(2, 2))
    chosen = select([Record.of(u, y)], None, None, settings)
    assert chosen.order == 6
