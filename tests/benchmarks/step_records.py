"""Step tests: records that begin at rest at a level, one step, a pulse or two steps.

    python tests/benchmarks/step_records.py [--records 140] [--first 0] [--offset auto]
                                            [--anywhere]

One to three lags and a delay of up to 9 samples, 100 to 500 samples, noise of .1 to 3 %
of the step, rounded in every third. `SubspaceLTI` without options: the static gain by
the true one, and the best fit to fresh steps without noise, whose level and initial
state are estimated from a noisy record (`predict_with_initial_state`). Inputs begin at
zero, or `--anywhere`.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI
from lpvlearn.metrics import bft_score

Answer = Callable[[np.ndarray], np.ndarray]


def plant(rng: np.random.Generator, n: int) -> tuple[Answer, float]:
    """Answers of random lags and a delay to an input; and their static gain."""
    poles = np.exp(-1.0 / (n * rng.uniform(0.05, 0.25, rng.integers(1, 4))))
    delay, gain = int(rng.integers(10)), rng.uniform(0.2, 3.0) * rng.choice([-1, 1])

    def answer(u: np.ndarray) -> np.ndarray:
        y = np.concatenate([np.zeros(delay), u])[: len(u)]
        for pole in poles:
            y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y)
        return gain * y

    return answer, gain


def excitation(rng: np.random.Generator, n: int, size: float) -> np.ndarray:
    """One step, a pulse or two steps, from zero."""
    start, kind = int(n * rng.uniform(0.02, 0.25)), rng.integers(3)
    u = size * (np.arange(n) >= start)
    middle = start + (n - start) // 2
    if kind:
        u[middle:] *= 0.0 if kind == 1 else rng.choice([0.5, 1.6])
    return u


def measure(
    seed: int, offset: str, anywhere: bool
) -> tuple[float, float, bool, str | None]:
    """Best fit, gain by the true one, whether anything was told, and constants."""
    rng = np.random.default_rng([seed, 39])
    n = int(rng.integers(100, 500))
    size, level = rng.uniform(10, 60), rng.uniform(0, 60)
    answer, gain = plant(rng, n)
    noise = 10 ** rng.uniform(-3, -1.5) * abs(gain) * size
    step = noise * rng.choice([0.0, 0.0, 1.0])

    def recorded(y: np.ndarray) -> np.ndarray:
        y = y + level + noise * rng.standard_normal(len(y))
        return np.round(y / step) * step if step else y

    u = excitation(rng, n, size)
    first = np.random.default_rng([seed, 7]).uniform(-60, 60) if anywhere else 0.0
    fresh = np.repeat(size * (0.5 + 0.5 * rng.standard_normal(12)), n // 8)
    target = answer(fresh)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI(offset=offset).fit(first + u[:, None], recorded(answer(u)))
        told = bool(caught)
        known = recorded(target)
        found = model.predict_with_initial_state(first + fresh[:, None], known)
    found_gain = model.lti_.frequency_response([1e-9]).real.item()
    score = bft_score(target + level, np.ravel(found))
    return score, found_gain / gain, told, model.offset_


def main() -> None:
    """Print the distribution of the fits, and what is silently poor."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=140)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--offset", choices=["auto", "constant"], default="auto")
    parser.add_argument("--anywhere", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.records)
    scores, gains, told, offsets = zip(
        *(measure(k, options.offset, options.anywhere) for k in seeds), strict=True
    )
    fits, silent = np.maximum(scores, -100.0), ~np.array(told)
    far = np.abs(np.array(gains) - 1.0) > 0.3
    print(
        f"{len(fits)} records: best fit median {np.median(fits):.1f}, mean "
        f"{fits.mean():.1f} %, below 80 in {np.sum(fits < 80)} (silently "
        f"{np.sum((fits < 80) & silent)}); gain off by 30 % or more in {far.sum()} "
        f"(silently {np.sum(far & silent)}); without a constant "
        f"{sum(o is None for o in offsets)}, drifts {offsets.count('linear')}"
    )


if __name__ == "__main__":
    main()
