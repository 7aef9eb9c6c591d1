"""A spring at four scheduling values, and pictures that are closed again."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
)

from ..conftest import stable_model

STEP = 0.05
KAPPA = np.array([-1.0, 0.0, 1.0, 2.0])
SPRING = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]], B=[[0], ["k"]], C=[[1, 0]]
)


ONE = StateSpace([[-1.0]], [[1.0]], [[1.0]])


@pytest.fixture(autouse=True)
def plt():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as pyplot

    yield pyplot
    pyplot.close("all")


def spring(kappa):
    return SPRING.model({"k": 9.0 + 2.0 * kappa + kappa**2, "c": 0.8})


@pytest.fixture(scope="session")
def tables():
    rng = np.random.default_rng(0)
    parts = []
    for label, kappa in zip("abcd", KAPPA, strict=True):
        u = np.repeat(rng.choice([-1.0, 1.0], (60, 1)), 5, axis=0)
        y = spring(kappa).simulate(u, sampling_time=STEP)
        parts.append(
            pd.DataFrame(
                {
                    "u": u[:, 0],
                    "kappa": kappa,
                    "run": label,
                    "time": STEP * np.arange(300),
                    "angle": y[:, 0],
                }
            )
        )
    table = pd.concat(parts, ignore_index=True)
    return table.drop(columns="angle"), table[["angle"]]


@pytest.fixture(scope="session")
def pipeline(tables):
    return LocalLPVPipeline(
        local=SubspaceLTI(order=2, horizon=8),
        restructurer=GrayBoxRestructurer(SPRING),
        scheduling="kappa",
        experiment="run",
        time="time",
    ).fit(*tables)


@pytest.fixture(scope="session")
def noisy(tables):
    """A pipeline on outputs with noise, which knows how uncertain it is."""
    X, y = tables
    noise = 0.05 * y["angle"].std() * np.random.default_rng(1).normal(size=y.shape)
    return LocalLPVPipeline(
        local=SubspaceLTI(order=2, horizon=8),
        restructurer=GrayBoxRestructurer(SPRING),
        scheduling="kappa",
        experiment="run",
        time="time",
    ).fit(X, y + noise)


def random_model(seed, order=4, n_outputs=2, n_inputs=3, sampling_time=None):
    return stable_model(
        seed, order, n_inputs, n_outputs, sampling_time=sampling_time, feedthrough=True
    )
