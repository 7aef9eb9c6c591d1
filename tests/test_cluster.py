"""On a cluster of dask, of which a worker is killed in the middle: the same bits."""

import os
import signal
import threading
import time
from importlib import import_module

import numpy as np
import pandas as pd
import pytest
from joblib import delayed, parallel_config
from sklearn.model_selection import GridSearchCV

from lpvlearn import ExperimentSplit, PolynomialLPV, SubspaceLTI
from lpvlearn.paper import run_paper_experiment
from lpvlearn.pipeline.running.workers import results_of

from .conftest import spring_pipeline, spring_tables

cloudpickle = pytest.importorskip("cloudpickle")
distributed = pytest.importorskip("distributed")

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]

AT_WORK = 0.2  # seconds, after which a worker is in the middle of a task


@pytest.fixture(scope="module")
def cluster():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        with distributed.Client(cluster) as client:
            client.amm.stop()  # or copies beyond the first are dropped every 2 s
            yield client


def chain(**options):
    return spring_pipeline(
        local=SubspaceLTI(2, horizon=8), interpolator=PolynomialLPV(2), **options
    )


@pytest.fixture(scope="module")
def tables():
    return spring_tables(noise=0.01, kappas=np.linspace(0.0, 1.5, 8))


@pytest.fixture
def sent(monkeypatch):
    """Bytes of tasks that go to the cluster, and what goes there beside them."""
    tasks, beside = [], []
    submit, scatter = distributed.Client.submit, distributed.Client.scatter

    def submitting(self, *args, **options):
        tasks.append(len(cloudpickle.dumps(options["tasks"])))
        return submit(self, *args, **options)

    def scattering(self, data, **options):
        beside.append(data)
        return scatter(self, data, **options)

    monkeypatch.setattr(distributed.Client, "submit", submitting)
    monkeypatch.setattr(distributed.Client, "scatter", scattering)
    return tasks, beside


def with_a_worker_killed(client, work):
    """What `work` returns; a worker is killed in the middle of a task of it."""
    workers, killed, ended = client.run(os.getpid), [], threading.Event()

    def kill_when_at_work():
        while not ended.wait(0.05):
            busy = [address for address, tasks in client.processing().items() if tasks]
            if busy:
                time.sleep(AT_WORK)
                killed.extend(workers[address] for address in busy[:1])
                os.kill(killed[0], signal.SIGKILL)
                return

    killer = threading.Thread(target=kill_when_at_work)
    killer.start()
    try:
        found = work()
        assert killed, "the work ended before a worker was killed"
    finally:
        ended.set()
        killer.join()
    client.wait_for_workers(2)
    assert killed[0] not in client.run(os.getpid).values()
    return found


def test_a_chain_comes_out_to_the_bit(cluster, tables):
    with parallel_config(backend="dask"):
        fitted = with_a_worker_killed(cluster, lambda: chain(n_jobs=2).fit(*tables))
    alone = chain().fit(*tables)
    np.testing.assert_array_equal(fitted.parameters_, alone.parameters_)
    np.testing.assert_array_equal(fitted.predict(tables[0]), alone.predict(tables[0]))


class Unreadable:
    """What a process has to read by a module that it does not find."""

    def __reduce__(self):
        return import_module, ("a_module_of_one_machine",)


def test_a_task_that_the_cluster_cannot_read_is_not_waited_for(cluster):
    with parallel_config(backend="dask"):
        results = results_of([delayed(len)([Unreadable()])], 2)
        with pytest.raises(RuntimeError, match="different environments"):
            list(results)


def test_data_are_sent_once(cluster, sent):
    """Those of an operating point with its task, a table of a search beside all."""
    X, y = spring_tables(noise=0.01, n_samples=4000, kappas=np.linspace(0.0, 1.5, 8))
    once = X[["force", "time"]].to_numpy().nbytes + y.to_numpy().nbytes
    cv = ExperimentSplit(3, experiment="run", scheduling="kappa")
    search = GridSearchCV(chain(), {"interpolator__degree": [1, 2]}, cv=cv)
    tasks, beside = sent
    for model, tables in ((chain(n_jobs=2), []), (search, [X, y])):
        tasks.clear()
        with parallel_config(backend="dask"):
            model.fit(X, y)  # of the search: once more with all data
        assert once < sum(tasks) < 1.2 * once
        found = [data for data in beside if isinstance(data, pd.DataFrame)]
        assert len(found) == len(tables)
        for one, other in zip(found, tables, strict=True):
            pd.testing.assert_frame_equal(one, other)


def test_a_search_comes_out_to_the_bit(cluster, tables):
    cv = ExperimentSplit(3, experiment="run", scheduling="kappa")
    grid = {"interpolator__degree": [1, 2]}
    splits = list(cv.split(*tables))
    search = GridSearchCV(chain(), grid, cv=splits, n_jobs=2)
    # joblib gives a split to one worker, with which it is lost: all have all of these
    shared = [*tables, *(rows for split in splits for rows in split)]
    with parallel_config(backend="dask", scatter=shared):
        found = with_a_worker_killed(cluster, lambda: search.fit(*tables).cv_results_)
    alone = GridSearchCV(chain(), grid, cv=splits).fit(*tables).cv_results_
    for name in found:
        if name.startswith("split"):
            np.testing.assert_array_equal(found[name], alone[name])


def test_the_papers_tables_come_out_to_the_bit(cluster):
    """The Monte Carlo of the command."""
    with parallel_config(backend="dask"):
        found = with_a_worker_killed(
            cluster, lambda: run_paper_experiment(2, n_jobs=2).tables
        )
    alone = run_paper_experiment(2).tables
    assert found.pop("timing").shape == alone.pop("timing").shape
    assert list(found) == list(alone)
    for name, table in found.items():
        pd.testing.assert_frame_equal(table, alone[name], check_exact=True)
