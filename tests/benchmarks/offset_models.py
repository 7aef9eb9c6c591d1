"""LPV models of systems that stand about offsets: the disc and a tank.

BFT (percent) on fresh noise-free large runs from rest, ten seeds, local experiments at
30 dB. The bar is 99 for both. `python -m tests.benchmarks.offset_models [N_SEEDS]`.
"""

import sys
import warnings

import numpy as np
import pandas as pd

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    SubspaceLTI,
    bft_score,
    from_trajectories,
)
from lpvlearn.datasets import make_unbalanced_disc, prbs

GRAVITY, OUTLET, AREA, PUMP = 981.0, 0.071, 28.0, 3.3  # cm and s; V of the pump
LEVELS = np.array([3.0, 6.0, 10.0, 14.0, 18.0])  # cm


def tank_level(u, level, n_substeps=5):
    """``h' = (PUMP u - OUTLET sqrt(2 g h)) / AREA``, sampled every second."""
    h, out = np.array(level, float), np.empty((len(u), *np.shape(level)))
    for k, held in enumerate(u):
        out[k] = h
        for _ in range(n_substeps):
            slopes, step = [], 1.0 / n_substeps
            for share in (0.0, 0.5, 0.5, 1.0):
                at = h + share * step * slopes[-1] if slopes else h
                flow = OUTLET * np.sqrt(2 * GRAVITY * np.maximum(at, 1e-6))
                slopes.append((PUMP * held - flow) / AREA)
            a, b, c, d = slopes
            h = h + step / 6 * (a + 2 * b + 2 * c + d)
    return out


def holding(level):
    return OUTLET * np.sqrt(2 * GRAVITY * np.asarray(level)) / PUMP


def tank(seed):
    """Local experiments on the tank and a run through all levels."""
    rng = np.random.default_rng(seed)
    bits = [prbs(1500, clock=20, balance=20, random_state=rng)[:, 0] for _ in LEVELS]
    u = holding(LEVELS) + 0.25 * np.transpose(bits)
    h = tank_level(u, LEVELS)
    noise = h.std(axis=0) * 10 ** (-30 / 20) * rng.standard_normal(h.shape)
    runs = zip(u.T, h.T, (h + noise).T, strict=True)
    X, y = from_trajectories([*runs], sampling_time=1.0)
    low, high = holding([3.5, 16.0])
    t = np.arange(3000)
    swing = 0.5 * (low + high) - 0.5 * (high - low) * np.cos(2 * np.pi * t / 1500)
    swing = swing + 0.2 * prbs(3000, clock=25, random_state=rng)[:, 0]
    h = tank_level(swing, 3.5)
    X_large, y_large = from_trajectories([(swing, h, h)], sampling_time=1.0)
    structure = GrayBoxStructure.from_template([["-k"]], [["b"]], [[1]])
    return structure, X, y, X_large, y_large


def disc(seed):
    data = make_unbalanced_disc(random_state=seed)
    return data.structure, data.X, data.y, data.X_large, data.y_large


def study(system, n_seeds):
    """A row per model: mean and worst BFT over the seeds."""
    found = {}
    for seed in range(n_seeds):
        structure, X, y, X_large, y_large = system(1000 + seed)
        order, gray = structure.order, GrayBoxRestructurer(structure)
        plain = SubspaceLTI(order, feedthrough=False)
        detrended = SubspaceLTI(order, feedthrough=False, detrend="constant")
        for name, options in {
            "structure": {"local": plain, "restructurer": gray},
            "structure, detrended": {"local": detrended, "restructurer": gray},
            "no structure": {"local": plain},
            "structure, no offsets": {
                "local": plain,
                "restructurer": gray,
                "offsets": None,
            },
        }.items():
            roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
            model = LocalLPVPipeline(**options, **roles).fit(X, y)
            fit = bft_score(y_large, model.predict(X_large))
            found.setdefault(name, []).append(fit)
    table = pd.DataFrame(found)
    return pd.DataFrame({"mean": table.mean(), "worst": table.min()})


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    for system in (disc, tank):
        print(f"{system.__name__}, {n_seeds} seeds")
        print(study(system, n_seeds).round(2).to_string(), flush=True)
