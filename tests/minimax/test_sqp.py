"""Second-order optimality of the sequential quadratic programming."""

import numpy as np

from lpvlearn.minimax.sqp import minimax_sqp

from .conftest import charalambous_bandler, with_narrow_peaks


def test_sqp_certifies_the_optimum():
    result = minimax_sqp(charalambous_bandler(), np.array([2.0, 2.0]))
    assert result.stationarity < 1e-8
    assert result.second_order > 0
    assert np.all(np.diff([row["objective"] for row in result.history]) <= 0)


def test_narrow_peaks_that_move_along_the_frequency_cost_no_more_steps():
    """They are followed to where a step takes them, not watched where they were."""
    problem = charalambous_bandler()
    for start in np.array([[2.0, 2.0], [-1.0, 3.0]]):
        still = minimax_sqp(problem, start)
        moving = minimax_sqp(with_narrow_peaks(problem, 1e8), start)
        assert moving.stationarity < 1e-8
        assert moving.n_iter <= still.n_iter + 1
        np.testing.assert_allclose(moving.peaks.top, still.peaks.top, rtol=1e-12)
