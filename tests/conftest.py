"""Small systems that several rooms test with."""

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import block_diag

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
)

ROLES = {"scheduling": "kappa", "experiment": "run", "time": "time"}
KAPPA = (0.0, 0.5, 1.0, 1.5)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Of a test that is `broad` all cases but the first are slow."""
    seen = set()
    for item in items:
        if item.get_closest_marker("broad"):
            test = item.nodeid.partition("[")[0]
            if test in seen:
                item.add_marker(pytest.mark.slow)
            seen.add(test)


def modes(*poles):
    """Real block-diagonal matrix with the given poles, one of each complex pair."""
    return block_diag(
        *(
            [[p.real, p.imag], [-p.imag, p.real]] if np.imag(p) else [[np.real(p)]]
            for p in poles
        )
    )


def stable_model(
    seed,
    order=4,
    n_inputs=2,
    n_outputs=2,
    *,
    sampling_time=None,
    feedthrough=False,
    decay=0.3,
    rate=1.0,
):
    """A random stable model; `seed` may be a Generator that goes on.

    The slowest mode of a continuous model decays at the rate `decay`, and all of it
    goes `rate` times as fast; with a `sampling_time` the spectral radius is 0.9.
    """
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(order, order))
    poles = np.linalg.eigvals(A)
    if sampling_time is None:
        A = A - (poles.real.max(initial=-np.inf) + decay) * np.eye(order)
    else:
        A = 0.9 * A / np.abs(poles).max(initial=1e-3)
    B, C = rng.normal(size=(order, n_inputs)), rng.normal(size=(n_outputs, order))
    D = rng.normal(size=(n_outputs, n_inputs)) if feedthrough else None
    return StateSpace(rate * A, rate * B, C, D, sampling_time)


def spring_structure():
    """A mass with a spring that depends on the scheduling variable."""
    return GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    )


def spring_truth(kappa):
    """Parameters b, c, k at scheduling values: k = 40 + 10 kappa + 20 kappa^2."""
    kappa = np.asarray(kappa, dtype=float)
    ones = np.ones_like(kappa)
    return np.column_stack([30 * ones, 1.2 * ones, 40 + 10 * kappa + 20 * kappa**2])


def spring_lpv():
    """The true LPV model."""
    kappa = np.linspace(0, 1.5, 5)[:, None]
    interpolator = PolynomialLPV(2).fit(kappa, spring_truth(kappa[:, 0]))
    bounds = np.array([[0.0], [1.5]])
    return LPVStateSpace(spring_structure(), interpolator, bounds)


def spring_tables(noise=0.0, n_samples=600, n_repeats=1, seed=0, kappas=KAPPA):
    """Local experiments on the spring, sampled at 20 ms: X and y."""
    rng = np.random.default_rng(seed)
    lpv, dt, tables, outputs = spring_lpv(), 0.02, [], []
    for point, kappa in enumerate(kappas):
        for repeat in range(n_repeats):
            u = rng.choice([-1.0, 1.0], size=(n_samples // 5, 1)).repeat(5, axis=0)
            y = lpv.at(kappa).simulate(u, sampling_time=dt)
            y = y + noise * y.std() * rng.normal(size=y.shape)
            tables.append(
                pd.DataFrame(
                    {
                        "force": u[:, 0],
                        "kappa": kappa,
                        "run": f"p{point}r{repeat}",
                        "time": dt * np.arange(len(u)),
                    }
                )
            )
            outputs.append(y)
    X = pd.concat(tables, ignore_index=True)
    return X, pd.DataFrame(np.vstack(outputs), columns=["position"])


def spring_sweep(n_samples=1500, seed=9):
    """A validation experiment through the whole scheduling range."""
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], size=(n_samples // 5, 1)).repeat(5, axis=0)
    kappa = 0.75 - 0.75 * np.cos(np.linspace(0, 3 * np.pi, n_samples))
    y = spring_lpv().simulate(u, kappa, 0.02)
    X = pd.DataFrame(
        {
            "force": u[:, 0],
            "kappa": kappa,
            "run": "sweep",
            "time": 0.02 * np.arange(n_samples),
        }
    )
    return X, pd.DataFrame(y, columns=["position"])


def spring_pipeline(**options):
    """A pipeline with the spring's structure and columns."""
    options = {"restructurer": GrayBoxRestructurer(spring_structure()), **options}
    return LocalLPVPipeline(**ROLES, **options)


@pytest.fixture(scope="session")
def spring():
    """Noise-free local experiments and a sweep."""
    return *spring_tables(), *spring_sweep()
