"""Work shared between processes: how many of them."""

import os

import pytest
from joblib import delayed, parallel_config

from lpvlearn.pipeline.running.workers import check_jobs, give_way, results_of


def test_no_more_jobs_than_tasks_or_processors_are_begun():
    with parallel_config("threading"):
        found = results_of([delayed(abs)(-k) for k in range(3)], 10**9)
        assert list(found) == [0, 1, 2]


@pytest.mark.parametrize("n_jobs", ["auto", 0, [], 1.5])
def test_what_is_no_number_of_jobs_is_refused(n_jobs):
    with pytest.raises(ValueError, match="`n_jobs` must be None or an integer, -1"):
        check_jobs(n_jobs)
    assert check_jobs(None) is None and check_jobs(-1) == -1


def niceness():
    """That of a process before and after it gives way, twice."""
    before = os.nice(0)
    give_way()
    give_way()
    return os.nice(0) - before


@pytest.mark.skipif(not hasattr(os, "nice"), reason="no niceness")
@pytest.mark.slow
def test_workers_give_way_once_and_this_process_never():
    assert niceness() == 0
    found = {*results_of([delayed(niceness)()] * 8, n_jobs=2)}
    assert found <= {0, 3} and 3 in found
