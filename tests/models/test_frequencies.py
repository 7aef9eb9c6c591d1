"""Frequency axes show what models do."""

import numpy as np
from numpy.testing import assert_allclose

from lpvlearn import StateSpace
from lpvlearn.models.frequencies import frequency_axis


def test_frequency_axis_reaches_a_decade_beyond_the_poles():
    omega = frequency_axis([StateSpace(np.diag([-2.0, -30.0]), [[1], [1]], [[1, 1]])])
    assert_allclose(omega[[0, -1]], [0.2, 300.0])
