"""Simulation of parts that a model has not seen."""

import numpy as np
import pytest
from scipy import linalg
from scipy.signal import lfilter, place_poles

from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.held_out import HeldOut, Part, held_out
from lpvlearn.subspace.simulation_error.simulation_fit import Realization

from ..conftest import modes
from .conftest import POLES, example, experiment


def test_errors_are_those_of_the_pieces_alone(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 400, x0=rng.standard_normal(6))
    model = Realization(*system, np.zeros((1, 6)), 0.0)
    lengths = []

    def refitted(train):
        lengths.append([record.n_samples for record in train])
        return model

    error = held_out(refitted, [Record.of(u, y)])
    assert lengths == [[100, 200], [200, 100], [300]]
    assert len(error.parts) == 3 and error.total < 1e-15
    assert error.bft == pytest.approx(100.0)
    noise = rng.standard_normal((100, 2))
    y[300:] += noise
    error = held_out(refitted, [Record.of(u, y)])
    # What the state of the piece takes of the noise is made up for.
    assert error.total == pytest.approx((noise**2).sum(), rel=0.05)
    first, second, third = (part.without(part.free) for part in error.parts)
    assert max(np.abs(first).max(), np.abs(second).max()) < 1e-8 < np.abs(third).max()


def test_a_short_experiment_beside_a_long_one_is_not_cut(rng):
    """A few samples tell no more than the state that they begin from."""
    system = example(rng, modes(*POLES))
    model = Realization(*system, np.zeros((2, 6)), 0.0)
    long, short = (Record.of(*experiment(rng, system, n, noise=0.1)) for n in (400, 12))
    kept = []

    def refitted(train):
        kept.append(train[-1].n_samples)
        return model

    both = held_out(refitted, [long, short])
    assert kept == [12, 12, 12]
    assert both.total == held_out(refitted, [long]).total


def test_a_piece_begins_where_it_is(rng):
    """Not where the samples before, and what has moved a system since, lead."""
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    u = np.sign(rng.standard_normal(40)).repeat(10)[:, None]
    moved = np.zeros((400, 2))
    moved[::100] = 5.0 * rng.standard_normal((4, 2))  # as a hand does a ball
    x, y = np.zeros(2), np.zeros((400, 1))
    for k in range(400):
        x = x + moved[k]
        y[k], x = x[0], A @ x + B @ u[k]
    model = Realization(A, B, np.eye(1, 2), np.zeros((1, 1)), np.zeros((1, 2)), 0.0)
    error = held_out(lambda train: model, [Record.of(u, y)])
    assert error.bft == pytest.approx(100.0)


@pytest.mark.parametrize("poles", [(1.4, 0.7), (1.4, -1.2)])
def test_modes_that_grow_beyond_all_digits_are_simulated(rng, poles):
    """Of a plant that only a loop holds: ``1.4**100`` is 4e14."""
    A, B, x = np.diag(poles), np.ones((2, 1)), np.zeros(2)
    hold = place_poles(A, B, [0.3, 0.5]).gain_matrix
    u, y, C = rng.standard_normal((400, 1)), np.zeros((400, 1)), np.array([[1.0, 0.5]])
    for t in range(400):
        y[t], u[t] = C @ x, u[t] - hold @ x
        x = A @ x + B @ u[t]
    model = Realization(A, B, C, np.zeros((1, 1)), np.zeros((1, 2)), 0.0)
    error = held_out(lambda train: model, [Record.of(u, y)])
    assert error.residual < 1e-9


def test_short_experiments_are_not_held_out(rng):
    system = example(rng, modes(*POLES))
    records = [Record.of(*experiment(rng, system, 7)) for _ in range(3)]
    model = Realization(*system, np.zeros((3, 6)), 0.0)
    error = held_out(lambda train: model, records)
    assert not error.parts and np.isinf(error.total) and np.isnan(error.bft)


def test_of_short_experiments_whole_ones_are_held_out(rng):
    system = example(rng, modes(*POLES))
    lengths = (12, 30, 20, 11, 40, 25, 9, 35)
    records = [Record.of(*experiment(rng, system, n)) for n in lengths]
    model, out = Realization(*system, np.zeros((8, 6)), 0.0), []

    def refitted(train):
        out.append(set(lengths) - {record.n_samples for record in train})
        return model

    assert held_out(refitted, records).residual < 1e-9
    assert out == [{40, 25}, {35}, {30}]


@pytest.mark.parametrize("pole", [1.0, 1.0 + 1e-16, 1.0 + 1e-12, 1.0 + 1e-9, 1.0005])
def test_integrators_are_no_modes_that_grow(rng, pole):
    """Rounding moves several poles at one to either side of the circle."""
    T = rng.standard_normal((5, 5))
    A = T @ linalg.block_diag(np.diag(np.full(3, pole)) + np.eye(3, k=1), 0.5, 1.2)
    A = np.linalg.solve(T.T, A.T).T
    system = (A, rng.standard_normal((5, 1)), rng.standard_normal((1, 5)), np.eye(1))
    u, y = experiment(rng, system, 40)
    model = Realization(*system, np.zeros((1, 5)), 0.0)
    error = held_out(lambda train: model, [Record.of(u, y)])
    assert error.bft > 99.99


def test_a_model_whose_poles_are_rounding_is_no_better_than_any(rng):
    poles = rng.uniform(0.5, 1.5, 12)
    A = np.diag(poles) + 1e15 * np.triu(rng.standard_normal((12, 12)), 1)
    T = linalg.qr(rng.standard_normal((12, 12)))[0]
    model = Realization(
        T @ A @ T.T, np.ones((12, 1)), np.ones((1, 12)), np.eye(1), np.zeros((1, 12)), 0
    )
    u, y = rng.standard_normal((2, 1, 60))
    error = held_out(lambda train: model, [Record.of(u.T, y.T)])
    assert error.bft == 0.0


def errors_of(*blocks):
    """Parts held out of errors given, a block of ten samples for each."""
    error = np.concatenate([np.full((10, 1), block) for block in blocks])
    parts = [
        Part(e, np.zeros((*e.shape, 0)), np.eye(1)) for e in error.reshape(-1, 50, 1)
    ]
    return HeldOut(parts, 0.0, float((error**2).sum()))


def test_a_difference_counts_where_it_is_neither_chance_nor_small(rng):
    noise = 1.0 + 0.1 * rng.standard_normal(15)
    base = errors_of(*noise)
    assert errors_of(*(0.9 * noise)).clearly_better_than(base, 2.0)
    assert not errors_of(*(0.99 * noise)).clearly_better_than(base, 2.0)
    mixed = noise * np.where(np.arange(15) % 2, 0.2, 1.3)
    assert not errors_of(*mixed).clearly_better_than(base, 2.0)
    diverged = errors_of(*np.full(15, np.nan))
    assert base.clearly_better_than(diverged, 2.0)
    assert not diverged.clearly_better_than(base, 2.0)


def test_a_slow_mode_gains_nothing_by_what_it_takes_of_slow_noise(rng):
    """With no input to it, it simulates as the model without it does."""
    A, B, C, D = example(rng, modes(0.6, 0.8 * np.exp(0.9j)), 1, 1)
    u, y = experiment(rng, (A, B, C, D), 400)
    y = y + lfilter([1.0], [1.0, -0.95], rng.standard_normal(y.shape), axis=0)
    more = linalg.block_diag(A, 0.99), np.vstack([B, [[0.0]]]), np.hstack([C, [[1.0]]])
    plain, slow = (
        held_out(lambda train, m=m: m, [Record.of(u, y)])
        for m in (
            Realization(A, B, C, D, np.zeros((1, 3)), 0.0),
            Realization(*more, D, np.zeros((1, 4)), 0.0),
        )
    )
    assert slow.total < 0.9 * plain.total
    slack = 1e-9  # rounding, as a share of the errors
    assert not slow.clearly_better_than(plain, 0.0, slack)
    assert not plain.clearly_better_than(slow, 0.0, slack)


def test_what_common_unknowns_hide_is_not_forgotten():
    """Less than a period: a light mode's free response is as its answer to inputs."""
    wave = np.sin(0.1 * np.arange(40.0))[:, None]
    hum = 0.1 * np.cos(2.0 * np.arange(40.0))[:, None]
    none, weight = np.zeros((40, 1, 0)), np.eye(1)
    for size, better in ((0.1, True), (1.0, False)):  # of the wave that it lacks
        without = Part(0.5 * hum + size * wave, none, weight)
        light = Part(hum, wave[:, :, None], weight)
        mine, others = (
            HeldOut([part], np.nan, float((part.without(part.free) ** 2).sum()))
            for part in (without, light)
        )
        assert mine.clearly_better_than(others, 0.0) == better


def test_what_moves_in_one_piece_alone_is_not_held_out(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 400)
    u[:150] = u[150:] = u[150]
    u[:150] = 0.0
    lengths = []

    def refitted(train):
        lengths.append([record.n_samples for record in train])
        return Realization(*system, np.zeros((1, 6)), 0.0)

    held_out(refitted, [Record.of(u, y)])
    assert lengths == [[400], [200, 100], [300]]
