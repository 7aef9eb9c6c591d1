"""Short experiments, and a memory that the tests of the later steps share."""

import pytest

from ..conftest import spring_sweep, spring_tables

N_SAMPLES = 300


@pytest.fixture(scope="session")
def spring():
    """Noise-free local experiments and a sweep."""
    return *spring_tables(n_samples=N_SAMPLES), *spring_sweep()


@pytest.fixture(scope="session")
def memory(tmp_path_factory):
    """Keeps local and gray-box models of the spring from one test to the next."""
    return tmp_path_factory.mktemp("memory")
