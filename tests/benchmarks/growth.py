"""How time and memory grow: with rows, experiments, points, batches and samples.

    python tests/benchmarks/growth.py [name ...]

Every figure is measured in a process of its own. Memory is what the call needs at its
peak beyond the table that it is given, in sizes of that table.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

_EVERY = 0.005  # seconds between two looks at memory

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))


class Cost:
    """CPU seconds of a block, and its peak of memory (MB) beyond what was there.

    Of memory that is not a file's: the system takes pages of files when it needs them.
    What was there is told when the object is made.
    """

    def __init__(self):
        self._before = _status("RssAnon")

    def __enter__(self):
        self._peak = self._before
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._look)
        self._watch.start()
        self._start = time.process_time()
        return self

    def _look(self):
        while not self._ended.wait(_EVERY):
            self._peak = max(self._peak, _status("RssAnon"))

    def __exit__(self, *_):
        self.seconds = time.process_time() - self._start
        self._ended.set()
        self._watch.join()
        self.megabytes = max(self._peak, _status("RssAnon")) - self._before


def _status(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(s.split()[1]) / 1024 for s in lines if s.startswith(field))


def _table(n_rows, per_experiment):
    """A lightly damped system of order 4, two inputs and outputs, 1 % of noise."""
    import pandas as pd

    from lpvlearn import StateSpace

    rng = np.random.default_rng(0)
    A = np.kron(np.diag([0.95, 0.8]), [[0.9, 0.3], [-0.3, 0.9]])
    B, C = rng.standard_normal((4, 2)), rng.standard_normal((2, 4))
    model = StateSpace(A, B, C, None, 1.0)
    u = rng.standard_normal((n_rows, 2))
    starts = range(0, n_rows, per_experiment)
    y = np.vstack([model.simulate(u[k : k + per_experiment]) for k in starts])
    y += 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    X = pd.DataFrame(u, columns=["u1", "u2"])
    X["run"] = np.arange(n_rows) // per_experiment
    return X, pd.DataFrame(y, columns=["y1", "y2"])


def _size(*tables):
    return sum(t.to_numpy().nbytes for t in tables) / 2**20


def experiments(n_rows):
    """Fit of experiments of 200 samples."""
    from lpvlearn import SubspaceLTI

    n_rows = int(n_rows)
    X, y = _table(n_rows, 200)
    SubspaceLTI(4, experiment="run", sampling_time=1.0).fit(X[:2000], y[:2000])
    with Cost() as cost:
        SubspaceLTI(4, experiment="run", sampling_time=1.0).fit(X, y)
    return (
        f"{cost.seconds:6.2f} s  {1e5 * cost.seconds / n_rows:5.2f} s per 100,000 rows"
        f"  {cost.megabytes / _size(X, y):5.1f} tables"
    )


def points(n_points):
    """Fit of a chain without structure, an experiment of 400 samples at each point."""
    from lpvlearn import LocalLPVPipeline, PolynomialLPV
    from tests.conftest import ROLES, spring_tables

    n_points = int(n_points)
    kappas = 0.1 * np.arange(n_points)  # beyond what merges points, for any number
    X, y = spring_tables(noise=1e-3, n_samples=400, kappas=kappas)
    pipeline = LocalLPVPipeline(
        restructurer="passthrough", interpolator=PolynomialLPV(2), **ROLES
    )
    with Cost() as cost:
        pipeline.fit(X, y)
    return f"{cost.seconds:6.2f} s  {cost.seconds / n_points:5.3f} s per point"


def structured(n_points):
    """The same with the structure of the spring."""
    from lpvlearn import LocalLPVPipeline, PolynomialLPV
    from tests.conftest import ROLES, spring_structure, spring_tables

    n_points = int(n_points)
    kappas = 0.1 * np.arange(n_points)  # beyond what merges points, for any number
    X, y = spring_tables(noise=1e-3, n_samples=400, kappas=kappas)
    from lpvlearn import GrayBoxRestructurer

    pipeline = LocalLPVPipeline(
        None, GrayBoxRestructurer(spring_structure()), PolynomialLPV(2), **ROLES
    )
    with Cost() as cost:
        pipeline.fit(X, y)
    return f"{cost.seconds:6.2f} s  {cost.seconds / n_points:5.3f} s per point"


def batches(size):
    """partial_fit of 100,000 rows by batches of a size."""
    from lpvlearn import SubspaceLTI

    size, n_rows = int(size), 100_000
    X, y = _table(n_rows, n_rows)
    u, y = X[["u1", "u2"]].to_numpy(), y.to_numpy()
    model = SubspaceLTI(4, horizon=10, sampling_time=1.0)
    with Cost() as cost:
        for k in range(0, n_rows, size):
            model.partial_fit(u[k : k + size], y[k : k + size])
        assert model.lti_.order == 4  # of all rows
    return f"{cost.seconds:6.2f} s"


def simulation(n_samples):
    """Simulation of the LPV spring."""
    from tests.conftest import spring_lpv

    n = int(float(n_samples))
    model, rng = spring_lpv(), np.random.default_rng(0)
    u, kappa = rng.standard_normal(n), 0.75 + 0.7 * np.sin(1e-3 * np.arange(n))
    model.simulate(u[:1000], kappa[:1000], sampling_time=0.02)
    with Cost() as cost:
        model.simulate(u, kappa, sampling_time=0.02)
    return f"{cost.seconds:6.2f} s"


def prediction(n_samples):
    """Prediction of one table by a local model, and by the chain."""
    import pandas as pd

    from tests.conftest import ROLES, spring_pipeline, spring_tables

    n = int(float(n_samples))
    pipeline = spring_pipeline().fit(*spring_tables(noise=1e-3, n_samples=400))
    rng = np.random.default_rng(0)
    X = pd.DataFrame(
        {
            "force": rng.standard_normal(n),
            "kappa": 0.75 + 0.7 * np.sin(1e-3 * np.arange(n)),
            "run": 0,
            "time": 0.02 * np.arange(n),
        }
    )[[*pipeline.feature_names_in_]]
    assert set(ROLES.values()) <= set(X.columns)
    pipeline.predict(X[:1000])
    with Cost() as cost:
        pipeline.predict(X)
    return f"{cost.seconds:6.2f} s  {cost.megabytes / _size(X):5.1f} tables"


def dataset(megabytes, combine="pool"):
    """fit_dataset of so many MB: 20 points, experiments of 62,500 rows.

    Memory is what is beyond a process without data.
    """
    import shutil

    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    from lpvlearn import LocalLPVPipeline, PolynomialLPV, SubspaceLTI
    from tests.conftest import ROLES, spring_lpv

    cost = Cost()
    n, per_run = int(float(megabytes) * 2**20 / 40), 62_500
    n_runs = max(20, n // per_run)
    folder = Path(tempfile.mkdtemp(prefix="growth-"))
    try:
        rng, models = np.random.default_rng(0), {}
        for run in range(n_runs):
            kappa = 1.5 * (run % 20) / 19
            models.setdefault(kappa, spring_lpv().at(kappa).to_discrete(0.02))
            u = rng.standard_normal(per_run)
            y = models[kappa].simulate(u)[:, 0]
            y += 0.01 * y.std() * rng.standard_normal(per_run)
            time = 0.02 * np.arange(per_run)
            columns = {"force": u, "kappa": kappa, "run": run, "time": time, "y": y}
            table = pa.Table.from_pandas(pd.DataFrame(columns), preserve_index=False)
            pq.write_table(table, folder / f"{run:06}.parquet")
        local = SubspaceLTI(2, horizon=10, feedthrough=False)
        pipeline = LocalLPVPipeline(
            local, "passthrough", PolynomialLPV(2), combine=combine, **ROLES
        )
        with cost:
            pipeline.fit_dataset(folder, "y")
    finally:
        shutil.rmtree(folder)
    size = n_runs * per_run * 40 / 2**20
    return (
        f"{n_runs} experiments, {size:.0f} MB in memory: {cost.seconds:6.1f} s  "
        f"{cost.megabytes:5.0f} MB"
    )


def averaged(megabytes):
    """The same by models of single experiments, those of a point averaged."""
    return dataset(megabytes, "average")


def stream(n_rows):
    """fit_batches of a generator, 100,000 rows each."""
    from lpvlearn import StateSpace, SubspaceLTI

    n_rows, size = int(float(n_rows)), 100_000
    model = StateSpace([[0.9, 0.3], [-0.3, 0.9]], [[1], [0]], [[1, 0]], None, 1.0)

    def batches():
        rng = np.random.default_rng(0)
        for run in range(n_rows // size):
            u = rng.standard_normal((size, 1))
            y = model.simulate(u)
            X = np.column_stack([u, np.full(size, run)])
            yield X, y + 0.01 * rng.standard_normal(y.shape)

    with Cost() as cost:
        SubspaceLTI(2, inputs=[0], experiment=1).fit_batches(batches())
    size = 24 * n_rows / 2**20
    return f"{size:.0f} MB: {cost.seconds:6.2f} s  {cost.megabytes:5.0f} MB"


def imports(statement):
    """Imports, least of eleven runs, of compiled modules."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        own = {**os.environ, "PYTHONPYCACHEPREFIX": folder}
        own.pop("PYTHONDONTWRITEBYTECODE", None)
        for _ in range(12):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-c", statement]
            subprocess.run(command, check=True, cwd=ROOT, env=own)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            user = after.ru_utime - before.ru_utime
            times.append(user + after.ru_stime - before.ru_stime)
    return f"{min(times[1:]):6.2f} s"


MEASURES = {
    experiments: (65_536, 131_000, 262_400, 524_800),
    points: (10, 40),
    structured: (10, 40),
    batches: (1, 100, 1_000, 100_000),
    simulation: (10_000, 100_000, 1_000_000),
    prediction: (1_000_000,),
    stream: (1e6, 1e7),
    dataset: (100, 1000),
    averaged: (100, 1000),
    imports: (
        "import sklearn.linear_model",
        "import lpvlearn",
        "from lpvlearn import StateSpace",
        "from lpvlearn import SubspaceLTI",
        "from lpvlearn import LocalLPVPipeline",
    ),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "names", nargs="*", help=", ".join(f.__name__ for f in MEASURES)
    )
    parser.add_argument("--of", help="the size of one measure, in this process")
    asked = parser.parse_args()
    for measure, sizes in MEASURES.items():
        if asked.names and measure.__name__ not in asked.names:
            continue
        if asked.of is not None:
            warnings.simplefilter("ignore")
            print(measure(asked.of))
            continue
        print(measure.__doc__.splitlines()[0])
        for size in sizes:
            command = [sys.executable, __file__, measure.__name__, "--of", str(size)]
            found = subprocess.run(command, check=True, capture_output=True, text=True)
            print(f"{size:>40}  {found.stdout.rstrip()}", flush=True)


if __name__ == "__main__":
    main()
