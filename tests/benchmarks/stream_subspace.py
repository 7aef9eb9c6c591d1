"""Identification of a stream in bounded memory: `SubspaceLTI.partial_fit`.

Run with ``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/stream_subspace.py``;
``--samples 1e8`` for the large run. Data of two inputs and two outputs come from a
generator and are never stored; the peak of the resident memory is printed as it grows,
and the errors of the frequency response beside what they should be.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator

import numpy as np
from bench_subspace import resonant_system

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.numerics.simulation import state_trajectory

Array = np.ndarray


def stream(n_samples: int, batch: int, seed: int = 1) -> Iterator[tuple[Array, Array]]:
    """Batches of one endless experiment, noise of 10 % on the outputs."""
    A, B, C, D = resonant_system(np.random.default_rng(0), 6, 2)
    rng = np.random.default_rng(seed)
    state, level = np.zeros(6), None
    for _ in range(0, n_samples, batch):
        u = rng.standard_normal((batch, 2))
        x = state_trajectory(A, u @ B.T, state)
        state = A @ x[-1] + B @ u[-1]
        y = x @ C.T + u @ D.T
        level = 0.1 * y.std(axis=0) if level is None else level
        yield u, y + level * rng.standard_normal(y.shape)


def peak() -> float:
    """Peak resident memory, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=float, default=1e7)
    parser.add_argument("--batch", type=int, default=100_000)
    parser.add_argument("--unrefined", action="store_true")
    options = parser.parse_args()
    n_samples = int(options.samples)
    truth = StateSpace(*resonant_system(np.random.default_rng(0), 6, 2), 1.0)
    omega = np.linspace(0.01, 3.0, 200)
    G = truth.frequency_response(omega)
    model = SubspaceLTI(6, horizon=30, refine=not options.unrefined)
    print(f"before: {peak():.0f} MB")
    spent, seen, report = 0.0, 0, 10 * options.batch
    for u, y in stream(n_samples, options.batch):
        start = time.perf_counter()
        model.partial_fit(u, y)
        spent += time.perf_counter() - start
        seen += len(u)
        if seen >= report or seen >= n_samples:
            report *= 10
            H = model.lti_.frequency_response(omega)
            line = (
                f"{seen:12d} samples  {peak():7.0f} MB  {spent:8.1f} s  relative error "
                f"{np.linalg.norm(H - G) / np.linalg.norm(G):.2e}"
            )
            if not options.unrefined:
                std = model.frequency_response_std(omega)
                line += (
                    "  error by its standard deviation "
                    f"{np.sqrt(np.mean(np.abs(H - G) ** 2 / np.abs(std) ** 2)):.2f}"
                )
            print(line, flush=True)


if __name__ == "__main__":
    main()
