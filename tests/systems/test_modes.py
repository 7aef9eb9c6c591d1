"""Modes: how far out, and how fast."""

import numpy as np

from lpvlearn.systems.modes import mode_rates, spectral_radius


def test_a_turning_mode_is_as_fast_as_it_turns_and_decays():
    turn = 0.99 * np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    rate = abs(1.0 - 0.99 * np.exp(0.1j))
    np.testing.assert_allclose(mode_rates(turn), [rate, rate])
    np.testing.assert_allclose(spectral_radius(turn), 0.99)


def test_no_states_have_no_radius():
    assert spectral_radius(np.zeros((0, 0))) == 0.0
    assert mode_rates(np.zeros((0, 0))).size == 0
