"""Frequency axes show what models do."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import (
    StateSpace,
)
from lpvlearn.inspection import BodeDisplay, ErrorDisplay
from lpvlearn.inspection.frequency import frequency_axis, frequency_label


def test_frequency_axis_reaches_a_decade_beyond_the_poles():
    omega = frequency_axis([StateSpace(np.diag([-2.0, -30.0]), [[1], [1]], [[1, 1]])])
    assert_allclose(omega[[0, -1]], [0.2, 300.0])


def test_models_in_one_picture_count_time_alike():
    samples = StateSpace(0.5, 1, 1, sampling_time=True)
    second = StateSpace(0.5, 1, 1, sampling_time=1.0)
    assert frequency_label([second, StateSpace(-1, 1, 1)]) == "Frequency (rad/s)"
    assert frequency_label([samples, second]) == "Frequency (rad/sample)"
    with pytest.raises(ValueError, match="count time alike. Got sampling times True"):
        frequency_label([samples, StateSpace(0.5, 1, 1, sampling_time=0.1)])
    for display in (
        BodeDisplay.from_models({"a": samples}),
        ErrorDisplay.from_models(samples, StateSpace(0.6, 1, 1, sampling_time=True)),
    ):
        axes = display.figure_.axes
        assert axes[-1].get_xlabel() == "Frequency (rad/sample)"
