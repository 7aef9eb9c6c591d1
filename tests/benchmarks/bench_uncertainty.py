"""Coverage of the 95 % bands of `SubspaceLTI`, in a Monte Carlo.

Run with ``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_uncertainty.py``. What
is printed is the share of runs in which the truth lies within 1.96 standard deviations,
of real and imaginary parts of the frequency response at 12 frequencies and of the
poles: the average, and the lowest and the highest of any single entry (one of 300 runs
has a standard deviation of 1.3 % by chance alone; it takes 1000 runs to tell whether
an entry is off).
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from bench_subspace import arm_system, resonant_system
from scipy.signal import lfilter

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.systems.simulation import lti_response


def case(name: str) -> tuple[StateSpace, int, float, int, float]:
    """System, samples, pole of the noise, horizon, level of the noise in dB."""
    if name.startswith("arm"):
        return StateSpace(*arm_system(), 1.0), 3000, 0.0, 55, -30.0
    system = StateSpace(*resonant_system(np.random.default_rng(11), 4, 2), 1.0)
    return system, 1000, 0.9 if "AR" in name else 0.0, 20, -20.0


def coverage(name: str, n_runs: int) -> None:
    system, n, pole, horizon, level = case(name)
    omega = np.geomspace(1e-3, 0.3, 12) if "arm" in name else np.linspace(0.02, 3, 12)
    G, poles = system.frequency_response(omega), system.poles()
    hits, pole_hits, spent = [], [], 0.0
    for seed in range(n_runs):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((n, 2))
        if "arm" in name:
            u = 0.1 * np.repeat(rng.choice([-1.0, 1.0], (n // 5, 2)), 5, axis=0)
        y = lti_response(system.A, system.B, system.C, system.D, u)
        e = lfilter([1.0], [1.0, -pole], rng.standard_normal(y.shape), axis=0)
        y = y + 10 ** (level / 20) * y.std(axis=0) * e / e.std(axis=0)
        model = SubspaceLTI(system.order, horizon=horizon).fit(u, y)
        start = time.perf_counter()
        std = model.frequency_response_std(omega)
        spent += time.perf_counter() - start
        gap = model.lti_.frequency_response(omega) - G
        hits.append([abs(gap.real) < 1.96 * std.real, abs(gap.imag) < 1.96 * std.imag])
        found = model.lti_.poles()
        gap = found - poles[np.abs(found[:, None] - poles).argmin(axis=1)]
        inside = abs(gap.real) < 1.96 * model.poles_std_.real
        complex_ones = found.imag != 0.0
        inside_imag = (abs(gap.imag) < 1.96 * model.poles_std_.imag)[complex_ones]
        pole_hits.append(np.concatenate([inside, inside_imag]).mean())
    share = 100.0 * np.mean(hits, axis=0)
    print(
        f"{name:28s} {n_runs} runs: frequency response {share.mean():.1f} % "
        f"({share.min():.1f} to {share.max():.1f}), poles "
        f"{100.0 * np.mean(pole_hits):.1f} %, {1e3 * spent / n_runs:.1f} ms each",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=300)
    options = parser.parse_args()
    for name in (
        "order 4, white, 20 dB",
        "order 4, AR(1) 0.9, 20 dB",
        "arm, white, 30 dB",
    ):
        coverage(name, options.runs)


if __name__ == "__main__":
    main()
