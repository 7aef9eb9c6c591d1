"""Modes: how far out, and how fast."""

import numpy as np

from lpvlearn.systems.modes import (
    lasting,
    mode_rates,
    n_changes,
    n_decays,
    spectral_radius,
)


def test_a_turning_mode_is_as_fast_as_it_turns_and_decays():
    turn = 0.99 * np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    rate = abs(1.0 - 0.99 * np.exp(0.1j))
    np.testing.assert_allclose(mode_rates(turn), [rate, rate])
    np.testing.assert_allclose(spectral_radius(turn), 0.99)


def test_no_states_have_no_radius():
    assert spectral_radius(np.zeros((0, 0))) == 0.0
    assert mode_rates(np.zeros((0, 0))).size == 0


def test_a_record_is_long_to_a_mode_that_turns_but_not_to_its_decay():
    turn = 0.99 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    assert 0.99 < n_decays(turn, 100) < 1.01
    assert 49.0 < n_changes(turn, 100) < 50.0
    assert not lasting(np.linalg.eigvals(turn), 100).any()
    assert lasting(np.linalg.eigvals(turn / 0.98), 100).all()


def test_no_states_decay_at_once():
    none = np.zeros((0, 0))
    assert n_decays(none, 7) == 7.0 and n_changes(none, 7) == np.inf
    assert not lasting(np.zeros(0), 7).any()
