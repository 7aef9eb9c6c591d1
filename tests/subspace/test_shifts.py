"""Shifts of level: found where they are, and nowhere else; cut as by hand."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI
from lpvlearn.subspace.alternatives import shifts
from lpvlearn.subspace.alternatives.shifts import (
    _statistics,
    cut_at,
    find_shifts,
)
from lpvlearn.subspace.closed_loop.feedback import find_feedback
from lpvlearn.subspace.closed_loop.varx import longest_past, regression_of
from lpvlearn.subspace.fits.one_fit import Samples
from lpvlearn.subspace.samples.records import Record


def slow_record(rng, n=1200, noise=0.03):
    """Inputs of a few steps, a system of second order, white noise."""
    u = np.repeat(rng.standard_normal((12, 1)), n // 12, axis=0)
    y = answer(u)
    return u, y + noise * rng.standard_normal(y.shape)


def answer(u):
    return lfilter([0.0, 0.5, 0.2], [1.0, -1.2, 0.5], u, axis=0)


def shifts_of(*pairs):
    records = [Record.of(u / u.std(), y / y.std()) for u, y in pairs]
    return find_shifts(records, find_feedback(records).regression)


def test_the_regression_is_that_of_least_squares(rng):
    u, y = rng.standard_normal((2, 300, 1))
    y = answer(u) + y
    records = [Record.of(u, y)]
    P, first = regression_of(records), longest_past(records, 112, 8)
    z = np.hstack([u, y])
    rows = [np.ones(300 - first), u[first:, 0]]
    rows += [z[first - k : 300 - k, j] for k in range(1, len(P)) for j in (0, 1)]
    found = np.linalg.lstsq(np.array(rows).T, y[first:, 0], rcond=None)[0]
    assert P[0, 0, 1] == 1.0
    assert_allclose(np.append(-P[0, 0, 0], -P[1:].ravel()), found[1:], atol=1e-10)
    assert_allclose(find_feedback(records).regression.shape[1:], P.shape[1:])


@pytest.mark.parametrize("lasts", [True, False])
def test_statistics_are_those_of_a_regression(rng, lasts):
    """On the shape, from every sample on, and a constant, of two outputs."""
    n, shape = 40, rng.standard_normal((6, 2))
    w = rng.standard_normal((n, 2))
    w -= w.mean(axis=0)
    t, size = _statistics(w, shape, lasts)
    constants = np.kron(np.eye(2), np.ones((n, 1)))
    for k in (0, 7, 30, 38):
        effect = np.zeros((n, 2))
        tail = np.vstack([shape, np.tile(shape[-1:] * lasts, (n, 1))])
        effect[k:] = tail[: n - k]
        regressors = np.column_stack([effect.T.ravel(), constants])
        own = np.linalg.inv(regressors.T @ regressors)
        found = own @ regressors.T @ w.T.ravel()
        assert_allclose(size[k], found[0], rtol=1e-8)
        assert_allclose(t[k], found[0] / np.sqrt(own[0, 0]), rtol=1e-8)


def test_a_sensor_and_a_load_that_step_are_found(rng):
    u, y = slow_record(rng)
    late = (np.arange(len(u)) >= 750)[:, None]
    assert shifts_of((u, y)) == [[]]
    for moved in (y + 0.5 * late, y + answer(0.5 * late)):
        (found,) = shifts_of((u, moved))
        assert 750 in found and max(abs(k - 750) for k in found) <= 20
    other = slow_record(rng)
    (none, found) = shifts_of((u, y), (other[0], other[1] - 0.4 * late))
    assert not none and 750 in found


def test_what_is_no_shift_is_none(rng):
    u, y = slow_record(rng)
    spiked = y.copy()
    spiked[500] += 2.0
    assert shifts_of((u, spiked)) == [[]]
    walk = 0.05 * np.cumsum(rng.standard_normal(y.shape), axis=0)
    assert shifts_of((u, y + walk)) == [[]]
    # The answers of a plant that is not linear shift as its inputs do.
    assert shifts_of((u, answer(u + 0.3 * u**2))) == [[]]
    assert find_shifts([Record.of(u, y)], None) == [[]]


@pytest.mark.slow
def test_a_record_is_cut_as_by_hand():
    """The model is that of a table with experiments that end at the shifts."""
    rng = np.random.default_rng(3)
    u, y = slow_record(rng, 900)
    y = y + np.searchsorted([400, 640], np.arange(900), side="right")[:, None]
    with pytest.warns(UserWarning, match="shift at sample.s. 400, 640, counted"):
        found = SubspaceLTI().fit(u, y)
    parts = cut_at([(u, y)], [[400, 640]])
    X = np.vstack(
        [np.hstack([u, np.full_like(u, k)]) for k, (u, _) in enumerate(parts)]
    )
    outputs = np.vstack([y for _, y in parts])
    by_hand = SubspaceLTI(experiment=1, offset="constant").fit(X, outputs)
    assert found.offset_ == "constant" and found.offsets_differ_
    assert_allclose(found.lti_.A, by_hand.lti_.A, atol=1e-9)
    assert_allclose(found.output_offset_, by_hand.output_offset_, atol=1e-9)
    assert found.initial_states_.shape == (3, found.order_)
    with warnings.catch_warnings():  # what the user says is done
        warnings.simplefilter("error")
        whole = SubspaceLTI(2, offset="constant").fit(u, y)
    assert len(whole.initial_states_) == 1


@pytest.mark.slow
@pytest.mark.parametrize("better", [True, False])
def test_cuts_for_a_given_order_must_simulate_as_much_held_out(better, monkeypatch):
    """One lag for a motor with dead time: what it lacks looks like shifts."""
    rng = np.random.default_rng(3)
    u, y = slow_record(rng, 900)
    y = y + np.searchsorted([400, 640], np.arange(900), side="right")[:, None]
    order = SubspaceLTI(offset="constant").fit(u, y).order_
    told = Samples.errors_held_out

    def held_out(samples, fitted):
        found = told(samples, fitted)
        cut = len(fitted.scaled.records) > 1
        return found._replace(bft=found.bft if better or not cut else -1e3)

    monkeypatch.setattr(Samples, "errors_held_out", held_out)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = SubspaceLTI(order).fit(u, y)
    assert len(found.output_offset_) == (3 if better else 1)


@pytest.mark.slow
def test_cuts_that_leave_inputs_nothing_to_explain_are_not_made(monkeypatch):
    """Noise may explain, one step ahead, all that moves between them."""
    rng = np.random.default_rng(3)
    u, y = slow_record(rng, 900)
    y = y + 0.1 * np.searchsorted([400, 640], np.arange(900), side="right")[:, None]

    def fitted(samples, *args, fit=Samples.fit):
        order = 0 if len(samples.pairs) > 1 else samples.choices.order
        return fit(samples.having(order=order), *args)

    monkeypatch.setattr(Samples, "fit", fitted)
    monkeypatch.setattr(shifts, "shifts_matter", lambda whole, parts: True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of what the shifts do
        found = SubspaceLTI().fit(u, y)
    assert found.order_ > 0 and len(found.initial_states_) == 1


def test_cuts_that_make_a_stable_model_grow_are_not_made(monkeypatch):
    """Initial states of the parts hide that their modes do not grow."""
    rng = np.random.default_rng(3)
    u, y = slow_record(rng, 900)
    y = y + 0.1 * np.searchsorted([400, 640], np.arange(900), side="right")[:, None]

    def fitted(samples, *args, fit=Samples.fit):
        found = fit(samples, *args)
        if len(samples.pairs) == 1:
            return found
        evidence = found.evidence
        grown = evidence.model._replace(A=1.5 * evidence.model.A)
        evidence = replace(evidence, model=grown)
        return found._replace(evidence=evidence, model=grown)

    monkeypatch.setattr(Samples, "fit", fitted)
    monkeypatch.setattr(shifts, "shifts_matter", lambda whole, parts: True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of what the shifts do
        found = SubspaceLTI(2).fit(u, y)
    assert len(found.initial_states_) == 1
    assert np.abs(found.lti_.poles()).max() < 1.0


@pytest.mark.slow
def test_a_level_that_is_no_input_beside_constants_is_left_alone():
    """A scheduling variable without its role: it stands still in every experiment."""
    rng, X, Y = np.random.default_rng(0), [], []
    for run, level in enumerate([0.0, 0.5, 1.0]):
        u = np.repeat(rng.choice([-1.0, 1.0], 30), 10)[:, None]
        y = lfilter([0.0, 0.1], [1.0, level / 5.0 - 0.9], u, axis=0)
        Y.append(20.0 + 30.0 / (1.0 + level) + y)
        X.append(np.hstack([u, np.full((300, 1), level), np.full((300, 1), run)]))
    y = np.vstack(Y) + 0.004 * rng.standard_normal((900, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = SubspaceLTI(experiment=2).fit(np.vstack(X), y)
    assert model.offset_ == "constant"
