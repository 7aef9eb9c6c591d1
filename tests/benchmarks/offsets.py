"""Constants of the experiments: what they cost, and what estimating them gains.

Random second and third order systems, ten decibels or more of white or coloured noise.
Relative error of the frequency response, median over the systems, of the ways to treat
constants, and how often "auto" takes them. `python -m tests.benchmarks.offsets`.
"""

import time
import warnings

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI

OMEGA = np.geomspace(3e-3, 3.0, 60)
SIZES = (0.0, 0.1, 0.3, 1.0, 10.0)
WAYS = {
    "none": {"offset": None},
    "detrend": {"detrend": "constant"},
    "constant": {"offset": "constant"},
    "auto": {"offset": "auto"},
}


def random_system(rng, slow):
    """Of a pair of complex poles and a real one, `slow` sampling times long."""
    radius, angle = rng.uniform(0.8, 0.97), rng.uniform(0.2, 1.5)
    pair = radius * np.exp(1j * angle)
    A = np.zeros((3, 3))
    A[:2, :2] = [[pair.real, pair.imag], [-pair.imag, pair.real]]
    A[2, 2] = np.exp(-1.0 / slow)
    B, C = rng.standard_normal((3, 1)), rng.standard_normal((1, 3))
    B[2] *= 1.0 - A[2, 2]
    return StateSpace(A, B, C, sampling_time=1.0)


def table(rng, system, size, *, n_experiments=5, n_samples=200, pole=0.0, noise=0.3):
    """Experiments with constants of standard deviation `size` (of the output's)."""
    parts = []
    for run in range(n_experiments):
        u = rng.standard_normal((n_samples + 300, 1))
        y = system.simulate(u)[300:, 0]
        e = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(len(u)))
        y = y / y.std() + noise * e[300:]
        y = y + size * rng.standard_normal()
        parts.append(pd.DataFrame({"u": u[300:, 0], "run": run, "y": y}))
    data = pd.concat(parts, ignore_index=True)
    return data[["u", "run"]], data["y"]


def relative_error(model, system):
    """Of the frequency response, the gain that scales the outputs fitted."""
    truth = system.frequency_response(OMEGA).ravel()
    found = model.lti_.frequency_response(OMEGA).ravel()
    gain = np.vdot(truth, found).real / np.vdot(truth, truth).real
    return np.linalg.norm(found - gain * truth) / np.linalg.norm(gain * truth)


def study(n_systems=20, orders=("auto", 3), sizes=SIZES, **options):
    """A table of errors, times and choices."""
    rows = []
    for order in orders:
        for size in sizes:
            errors = {way: [] for way in WAYS}
            seconds, taken = dict.fromkeys(WAYS, 0.0), []
            for seed in range(n_systems):
                rng = np.random.default_rng(seed)
                system = random_system(rng, rng.uniform(1.0, 60.0))
                X, y = table(rng, system, size, **options)
                for way, choice in WAYS.items():
                    start = time.perf_counter()
                    model = SubspaceLTI(order, experiment="run", **choice)
                    if order != "auto":
                        model.set_params(horizon=10)
                    model.fit(X, y)
                    seconds[way] += time.perf_counter() - start
                    errors[way].append(relative_error(model, system))
                taken.append(model.offset_ is not None)
            row = {"order": order, "size": size, "taken": np.mean(taken)}
            row |= {way: np.median(found) for way, found in errors.items()}
            row |= {"worst auto": np.max(errors["auto"])}
            row |= {"time": seconds["auto"] / seconds["none"]}
            rows.append(row)
    return pd.DataFrame(rows)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for title, options in {
        "five experiments of 200 samples, white noise": {},
        "coloured noise, AR(1) 0.9": {"pole": 0.9},
        "one experiment of 1000 samples": {"n_experiments": 1, "n_samples": 1000},
    }.items():
        print(title)
        print(study(**options).round(4).to_string(index=False), flush=True)
