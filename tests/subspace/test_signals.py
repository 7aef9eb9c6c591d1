"""Sections of a state matrix, and the signals of a record through them."""

import numpy as np
import pytest

from lpvlearn.subspace.signals import Record, block_sections, signal_pieces
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
