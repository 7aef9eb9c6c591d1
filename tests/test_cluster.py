"""On a cluster of dask, of which a worker is killed in the middle: the same bits."""

import os
import signal
import threading

import numpy as np
import pytest
from joblib import parallel_config
from sklearn.model_selection import GridSearchCV

from lpvlearn import ExperimentSplit, PolynomialLPV, SubspaceLTI

from .conftest import spring_pipeline, spring_tables

distributed = pytest.importorskip("distributed")

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]

KILLED_AFTER = 0.7  # seconds of work, a part of what there is


@pytest.fixture(scope="module")
def cluster():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        with distributed.Client(cluster) as client:
            yield client


def chain(**options):
    return spring_pipeline(
        local=SubspaceLTI(2, horizon=8), interpolator=PolynomialLPV(2), **options
    )


@pytest.fixture(scope="module")
def tables():
    return spring_tables(noise=0.01, kappas=np.linspace(0.0, 1.5, 8))


def with_a_worker_killed(client, work):
    """What `work` returns; meanwhile one of the workers is killed."""
    first, *_ = before = set(client.run(os.getpid).values())
    timer = threading.Timer(KILLED_AFTER, os.kill, (first, signal.SIGKILL))
    timer.start()
    try:
        found = work()
    finally:
        timer.join()
    client.wait_for_workers(2)
    assert set(client.run(os.getpid).values()) != before
    return found


def test_a_chain_comes_out_to_the_bit(cluster, tables):
    with parallel_config(backend="dask"):
        fitted = with_a_worker_killed(cluster, lambda: chain(n_jobs=2).fit(*tables))
    alone = chain().fit(*tables)
    np.testing.assert_array_equal(fitted.parameters_, alone.parameters_)
    np.testing.assert_array_equal(fitted.predict(tables[0]), alone.predict(tables[0]))


def test_a_search_comes_out_to_the_bit(cluster, tables):
    cv = ExperimentSplit(3, experiment="run", scheduling="kappa")
    grid = {"interpolator__degree": [1, 2]}
    search = GridSearchCV(chain(), grid, cv=cv, n_jobs=2)
    # none is killed: joblib gives every split to one worker, and dask loses it with it
    with parallel_config(backend="dask", scatter=list(tables)):
        found = search.fit(*tables).cv_results_
    alone = GridSearchCV(chain(), grid, cv=cv).fit(*tables).cv_results_
    for name in found:
        if name.startswith("split"):
            np.testing.assert_array_equal(found[name], alone[name])
