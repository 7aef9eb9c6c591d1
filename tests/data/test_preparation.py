"""Runs between missing samples."""

from dataclasses import replace

import numpy as np
import pytest

from lpvlearn.data.experiments import Experiment
from lpvlearn.data.preparation import (
    complete_runs,
    has_gaps,
    independent_inputs,
    split_at_gaps,
)

WHOLE = Experiment(
    "a", 10 + np.arange(9), np.ones((9, 1)), np.ones((9, 2)), np.ones((9, 1))
)


def with_nan(name, rows):
    values = getattr(WHOLE, name).copy()
    values[rows, 0] = np.nan
    return replace(WHOLE, **{name: values})


def rows_of(runs):
    return [(run.rows - 10).tolist() for run in runs]


@pytest.mark.parametrize("name", ["inputs", "outputs", "scheduling"])
def test_runs_end_at_missing_values_of_any_signal(name):
    experiment = with_nan(name, [0, 4, 6])
    assert has_gaps(experiment) and not has_gaps(WHOLE)
    assert rows_of(split_at_gaps([experiment])) == [[1, 2, 3], [7, 8]]
    assert rows_of(complete_runs(experiment, 1)) == [[1, 2, 3], [5], [7, 8]]
    whole = rows_of(complete_runs(experiment, 1, outputs=False)) == [list(range(9))]
    assert whole == (name == "outputs")


def test_runs_end_at_holes_of_time():
    experiment = replace(with_nan("inputs", [5]), breaks=(2, 3, 5, 6, 8))
    assert has_gaps(replace(WHOLE, breaks=(1,)))
    runs = complete_runs(experiment, 1)
    assert rows_of(runs) == [[0, 1], [2], [3, 4], [6, 7], [8]]
    assert all(run.breaks == () and len(run.outputs) == len(run.rows) for run in runs)
    with pytest.raises(ValueError, match="at least 2 consecutive complete samples"):
        split_at_gaps([replace(WHOLE, breaks=tuple(range(1, 9)))])


def test_inputs_that_rest_are_no_scale():
    u = np.random.default_rng(0).standard_normal((50, 3))
    u[:, 1] = 0.0
    P = independent_inputs([u])
    assert P.shape == (3, 2) and not P[1].any()
