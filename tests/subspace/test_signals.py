"""Sections of a state matrix, and the signals of a record through them."""

import numpy as np
import pytest

from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.signals import (
    SharedSignals,
    block_sections,
    section_states,
    signal_factor,
    signal_factors,
    signal_pieces,
)
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes
from .conftest import POLES


@pytest.mark.parametrize(
    "A",
    [
        modes(*POLES),
        np.array([[1.0, 1.0], [0.0, 1.0]]),
        np.array([[0.9, 1.0, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 0.99]]),
        np.array([[0.9, 1.0, 0.0], [0.0, 0.9, 0.0], [0.3, 0.0, 0.2]]),
        np.array([[0.5]]),
    ],
    ids=["distinct", "double integrator", "double pole", "coupled", "one state"],
)
def test_sections_span_free_and_forced_responses(rng, A):
    n = len(A)
    B, C, D = rng.standard_normal((n, 1)), np.eye(n), np.zeros((n, 1))
    u = rng.standard_normal((60, 1))
    y = lti_response(A, B, C, D, u, rng.standard_normal(n))
    sections = block_sections(A)
    (piece,) = signal_pieces(sections.blocks, Record(u.T, y.T))
    signals = piece[: 2 * n].T
    fitted = signals @ np.linalg.lstsq(signals, y, rcond=None)[0]
    np.testing.assert_allclose(fitted, y, atol=1e-9 * np.abs(y).max())


def test_poles_of_high_multiplicity_have_no_sections():
    assert block_sections(np.eye(4, k=1) + 0.5 * np.eye(4)) is None


@pytest.mark.parametrize("poles", [[0.5], [0.9, 0.2], [0.9, 0.8 + 0.3j, 0.6 + 0.6j]])
def test_states_of_sections_follow_the_recursion(rng, poles):
    A = modes(*poles)
    n = len(A)
    basis = rng.standard_normal((n, n))
    blocks, T = block_sections(basis @ A @ np.linalg.inv(basis))
    added = rng.standard_normal((n, 60))
    states, x = T @ section_states(blocks, np.linalg.solve(T, added)), np.zeros(n)
    for found, step in zip(states.T, added.T, strict=True):
        x = basis @ A @ np.linalg.solve(basis, x) + step
        np.testing.assert_allclose(found, x, rtol=1e-9, atol=1e-9)


def test_realizations_share_the_factors_of_their_input(rng):
    signals, blocks = SharedSignals(), block_sections(modes(*POLES)).blocks
    n = len(modes(*POLES))
    for u in rng.standard_normal((2, 2, 300)):
        for driven in rng.standard_normal((2, n, 3)):
            for y in rng.standard_normal((3, 2, 300)):
                record = Record(u, y)
                own = signal_factor(blocks, record, driven)
                shared = signals.factor(blocks, record, driven)
                np.testing.assert_allclose(shared, own, rtol=1e-9, atol=1e-9)


def test_shared_signals_of_collinear_inputs_keep_their_digits(rng):
    u, y = np.ones((1, 200)), rng.standard_normal((1, 200))
    record, blocks = Record(np.vstack([u, u]), y), (np.array([[0.5]]),)
    driven = np.ones((1, 3))
    R = SharedSignals().factor(blocks, record, driven)
    expected = signal_factor(blocks, record, driven)
    np.testing.assert_allclose(R.T @ R, expected.T @ expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize("n_trend", [0, 2])
@pytest.mark.parametrize("poles", [[0.5], POLES, [0.9, 0.2, 1.02]])
def test_factors_of_many_records_are_those_of_each(rng, poles, n_trend, second):
    A = modes(*poles)
    blocks, n = block_sections(A).blocks, len(A)
    lengths = [7, 300, 40, 8, 40, 1, 100]
    records = [
        Record(*rng.standard_normal((2, 2, k)), rng.standard_normal((n_trend, k)))
        for k in lengths
    ]
    driven = rng.standard_normal((len(records), n, 3)) if second else None
    seen = []
    for where, several in signal_factors(blocks, records, driven):
        for i, R in zip(where, several, strict=True):
            x = None if driven is None else driven[i]
            own = signal_factor(blocks, records[i], x)
            np.testing.assert_allclose(R.T @ R, own.T @ own, rtol=1e-9, atol=1e-9)
        seen += where.tolist()
    assert sorted(seen) == list(range(len(records)))


def test_many_records_of_which_one_overflows_have_no_factors(rng):
    records = [Record(*rng.standard_normal((2, 1, k))) for k in (20, 250, 250)]
    found = dict(
        (len(where), R) for where, R in signal_factors((np.array([[30.0]]),), records)
    )
    assert found == {3: None}


def test_shared_signals_that_overflow_have_no_factor(rng):
    record, blocks = Record(*rng.standard_normal((2, 1, 3000))), (np.array([[2.0]]),)
    assert SharedSignals().factor(blocks, record, np.ones((1, 2))) is None
