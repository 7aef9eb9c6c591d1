"""Records are cut, scaled and centred, and tell what that was."""

import numpy as np
import pytest

from lpvlearn import SubspaceLTI
from lpvlearn.subspace.samples.records import (
    Record,
    centred,
    scale_records,
    share_known,
    shorten,
)
from lpvlearn.systems.simulation import trend_signals


def test_heads_of_long_records_keep_their_proportion(rng):
    records = [Record(*rng.standard_normal((2, 1, n))) for n in (40_000, 20_000)]
    heads, share = shorten(records)
    assert [head.n_samples for head in heads] == [20_000, 10_000]
    assert share == 0.5
    assert shorten(heads) == (heads, 1.0)


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_channels_are_scaled_to_unit_root_mean_square(rng, size):
    pairs = [
        (size * rng.standard_normal((n, 2)) * [1.0, 0.0], rng.standard_normal((n, 1)))
        for n in (30, 50)
    ]
    records, su, sy = scale_records(pairs)
    u, y = (np.hstack([record[k] for record in records]) for k in (0, 1))
    np.testing.assert_allclose(np.mean(u**2, axis=1), [1.0, 0.0])
    np.testing.assert_allclose(np.mean(y**2, axis=1), 1.0)
    for record, (u, y) in zip(records, pairs, strict=True):
        np.testing.assert_allclose(record.u.T * su, u)
        np.testing.assert_allclose(record.y.T * sy, y)


def test_records_know_which_outputs_are_estimates(rng):
    pairs = [(rng.standard_normal((40, 1)), rng.standard_normal((40, 2)))]
    estimated = np.zeros((50, 2), bool)  # of an experiment that goes on
    estimated[:10, 1] = estimated[45:] = True
    records = scale_records(pairs, 0, [estimated]).records
    np.testing.assert_array_equal(records[0].known, ~estimated[:40])
    assert records[0].n_values == 70
    assert share_known(records) == 70 / 80


@pytest.mark.parametrize("n_trend", [1, 2])
def test_what_is_centred_comes_back_with_its_centres(rng, n_trend):
    pairs = [
        (rng.standard_normal((n, 2)) + [1e3, 1.0], 50.0 + rng.standard_normal((n, 1)))
        for n in (30, 50)
    ]
    moved, centres = centred(pairs, n_trend, True)
    assert (centres.inputs[:, 0] != 0.0).all() and not centres.inputs[:, 1].any()
    for k, (u, y) in enumerate(moved):
        trends = trend_signals(len(u), n_trend)
        np.testing.assert_allclose(trends @ y, 0.0, atol=1e-9)
        np.testing.assert_allclose(y + trends.T @ centres.trends[k], pairs[k][1])
        np.testing.assert_allclose(u + centres.inputs[k], pairs[k][0])
    assert centred(pairs, 0, True)[0] is pairs


def test_heads_of_records_know_how_long_these_are():
    """Else all noise drifts over what is left of many short experiments."""
    rng = np.random.default_rng(0)
    records = [Record.of(*rng.standard_normal((2, 200, 1))) for _ in range(300)]
    heads, share = shorten(records)
    assert share == 0.5 and {head.n_samples for head in heads} == {100}
    assert {head.n_samples + head.n_later for head in heads} == {200}
    u, y = (np.concatenate([getattr(r, c).T for r in records]) for c in "uy")
    y = y + np.vstack([[[0.0]], u[:-1]])
    X = np.column_stack([u, np.repeat(np.arange(300.0), 200)])
    model = SubspaceLTI(1, horizon=4, inputs=[0], experiment=1).fit(X, y)
    assert model._evidence.longest == 200
