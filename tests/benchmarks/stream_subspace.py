"""Identification of a stream in bounded memory: `SubspaceLTI.partial_fit`.

Run with ``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/stream_subspace.py``;
``--samples 1e8`` for the large run. Data of two inputs and two outputs come from a
generator and are never stored; the peak of the resident memory is printed as it grows,
and the errors of the frequency response beside what they should be. ``--compare`` puts
the stream beside `fit` on the same samples as one table, which must agree to the last
digit, and beside the simulation least squares on all samples at once.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator

import numpy as np
from bench_subspace import identify, resonant_system

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.systems.simulation import state_trajectory

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


def compare(n_samples: int, batch: int, refine: bool) -> None:
    """Differences of the frequency response, relative to its norm."""
    truth = StateSpace(*resonant_system(np.random.default_rng(0), 6, 2), 1.0)
    omega = np.linspace(0.01, 3.0, 200)
    G = truth.frequency_response(omega)
    u, y = map(np.vstack, zip(*stream(n_samples, batch), strict=True))
    start = time.process_time()
    streamed = SubspaceLTI(6, horizon=30, refine=refine)
    for k in range(0, n_samples, batch):
        streamed.partial_fit(u[k : k + batch], y[k : k + batch])
    middle = time.process_time()
    whole = SubspaceLTI(6, horizon=30, refine=refine).fit(u, y)
    stop = time.process_time()
    at_once = StateSpace(*identify(u, y, 6, 30, refine=refine), 1.0)
    end = time.process_time()
    H = streamed.lti_.frequency_response(omega)

    def gap(model: StateSpace) -> float:
        return np.linalg.norm(H - model.frequency_response(omega)) / np.linalg.norm(G)

    error = np.linalg.norm(at_once.frequency_response(omega) - G) / np.linalg.norm(G)
    print(
        f"{n_samples} samples, refine={refine}: partial_fit {gap(truth):.2e} from the "
        f"truth ({middle - start:.2f} s), {gap(whole.lti_):.1e} from fit "
        f"({stop - middle:.2f} s), {gap(at_once):.1e} from all samples at once "
        f"({end - stop:.2f} s), which are {error:.2e} from the truth"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=float, default=1e7)
    parser.add_argument("--batch", type=int, default=100_000)
    parser.add_argument("--unrefined", action="store_true")
    parser.add_argument("--compare", action="store_true")
    options = parser.parse_args()
    n_samples = int(options.samples)
    if options.compare:
        for refine in (True, False):
            compare(n_samples, options.batch, refine)
        return
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
