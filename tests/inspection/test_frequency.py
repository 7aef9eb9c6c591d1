"""Frequency axes of pictures."""

import pytest

from lpvlearn import (
    StateSpace,
)
from lpvlearn.inspection import BodeDisplay, ErrorDisplay
from lpvlearn.inspection.frequency import frequency_label


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
