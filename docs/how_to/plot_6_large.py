r"""
.. _how_to_large:

More data than memory, more than one machine
============================================

A log of weeks does not fit into memory, and a search over options may want more than
one computer. Neither needs another model, and neither changes its figures.
"""

# %%
# Batches of a stream
# -------------------
# :meth:`SubspaceLTI.fit_batches <lpvlearn.SubspaceLTI.fit_batches>` takes what yields
# tables: a generator, a database, a folder of files. One of them is held at a time.

import numpy as np

from lpvlearn import LocalLPVPipeline, StateSpace, SubspaceLTI
from lpvlearn.datasets import load_varying_spring

truth = StateSpace([[0.9, 0.3], [-0.3, 0.9]], [[1], [0]], [[1, 0]], None, 1.0)


def batches():
    rng = np.random.default_rng(0)
    for run in range(4):
        u = rng.standard_normal((1000, 1))
        X = np.column_stack([u, np.full(1000, run)])
        yield X, truth.simulate(u) + 0.01 * rng.standard_normal((1000, 1))


local = SubspaceLTI(2, inputs=[0], experiment=1).fit_batches(batches())
local.lti_.poles().round(3)

# %%
# 450 million such rows, 10 GB, took 99 s of one processor and 38 MB (:ref:`trust`).
#
# A data set on the disk
# ----------------------
# :meth:`LocalLPVPipeline.fit_dataset <lpvlearn.LocalLPVPipeline.fit_dataset>` reads
# parquet files, or a folder of them, experiment by experiment; it wants pyarrow
# (``pip install "lpvlearn[tables]"``). The rows of an experiment follow each other, in
# the order of time; the other columns keep their roles. What `fit` finds in the whole
# table, it finds too. Memory is that of an experiment, and of 131,072 rows: 10 GB of
# parquet files, in 20 points, took 138 s of one processor and 182 MB (:ref:`trust`). Of
# a closed loop, and where the first rows tell too little of the others, it is that of
# the largest operating point. Both times grow with the rows alone: 100 GB are 17
# minutes of a stream, and 23 minutes of files, in the same memory.

import tempfile
from importlib.util import find_spec
from pathlib import Path

spring = load_varying_spring()
roles = {"scheduling": "kappa", "experiment": "run", "time": "time"}
pipeline = LocalLPVPipeline(restructurer="passthrough", **roles)
whole = pipeline.fit(spring.X, spring.y).parameters_

if find_spec("pyarrow"):
    with tempfile.TemporaryDirectory() as folder:
        outputs = list(spring.y.columns)
        path = Path(folder) / "spring.parquet"
        spring.X.join(spring.y).to_parquet(path)
        found = pipeline.fit_dataset(path, outputs).parameters_
    print(np.array_equal(found, whole))

# %%
# Many machines
# -------------
# Whatever takes `n_jobs` runs on joblib's backends, so on a cluster of dask
# (``pip install "lpvlearn[dask]"``)::
#
#     from dask.distributed import Client
#     from joblib import parallel_config
#
#     client = Client("scheduler:8786")
#     with parallel_config(backend="dask"):
#         pipeline.set_params(n_jobs=8).fit(X, y)
#
# On one of Ray it is ``ray.util.joblib.register_ray()`` and ``backend="ray"``. The
# figures are those of one process, to the bit. A worker that dies under
# `LocalLPVPipeline.fit` or `run_paper_experiment` costs its points anew. Under a search
# joblib gives the rows of a split to one worker, and the search ends in its error where
# that one dies: send them to all of the workers, with the table, and have dask, which
# drops such copies every two seconds, keep them::
#
#     client.amm.stop()
#     splits = list(cv.split(X, y))
#     search = GridSearchCV(pipeline, grid, cv=splits, n_jobs=8)
#     shared = [X, y, *(rows for split in splits for rows in split)]
#     with parallel_config(backend="dask", scatter=shared):
#         search.fit(X, y)
