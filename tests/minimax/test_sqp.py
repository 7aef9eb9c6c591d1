"""Second-order optimality of the sequential quadratic programming."""

import numpy as np

from lpvlearn.minimax.sqp import minimax_sqp

from .conftest import charalambous_bandler


def test_sqp_certifies_the_optimum():
    result = minimax_sqp(charalambous_bandler(), np.array([2.0, 2.0]))
    assert result.stationarity < 1e-8
    assert result.second_order > 0
    assert np.all(np.diff([row["objective"] for row in result.history]) <= 0)
