"""Short experiments, and a memory that the tests of the later steps share."""

import numpy as np
import pandas as pd
import pytest

from ..conftest import spring_sweep, spring_tables

N_SAMPLES = 300

# Columns of tables that `from_trajectories` makes.
OF_TRAJECTORIES = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}

FINE = np.linspace(0, 1.5, 7)


@pytest.fixture(scope="session")
def spring():
    """Noise-free local experiments and a sweep."""
    return *spring_tables(n_samples=N_SAMPLES), *spring_sweep()


@pytest.fixture(scope="session")
def memory(tmp_path_factory):
    """Keeps local and gray-box models of the spring from one test to the next."""
    return tmp_path_factory.mktemp("memory")


def sweeps(noise=0.03, n=2, n_samples=400):
    """Experiments through the whole range, with noise."""
    tables, outputs = [], []
    rng = np.random.default_rng(1)
    for k in range(n):
        X, y = spring_sweep(n_samples, seed=20 + k)
        tables.append(X.assign(run=f"sweep {k}"))
        outputs.append(y + noise * y["position"].std() * rng.normal(size=y.shape))
    return pd.concat(tables, ignore_index=True), pd.concat(outputs, ignore_index=True)
