"""Noisy black boxes: coverage of intervals, and responses that must not fail.

    python tests/benchmarks/noise_study.py coverage [--norm hinf] [--trials 60]
    python tests/benchmarks/noise_study.py responses [--trials 1000]

Coverage: 95 % intervals of the parameters from ten realizations, around the truth, a
row per generator, the share of parameters whose intervals are told to be no good, and
coverage of the others. Responses: random plants with noise of 0 to 200 % against
structures of other orders, few frequencies, and any scale; what raises, and what is
unstable.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter

import numpy as np
from exact_problems import GENERATORS, problems

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace

SPREAD = 3e-3  # relative noise of every entry of a balanced realization
REALIZATIONS = 10
BENT = "are not to be trusted"  # what is said of intervals that are not linear
NOISE = (0, 0, 1e-3, 0.05, 0.2, 0.5, 2.0)  # of the mean size of a response


def coverage(norm: str, trials: int) -> None:
    for name, _, structure, truth in problems(len(GENERATORS), 0):
        box, inside, told = structure.model(truth).balance(), [], []
        for trial in range(trials):
            rng = np.random.default_rng(trial)
            runs = [noisy(box, rng) for _ in range(REALIZATIONS)]
            blocks = (np.mean([getattr(r, M) for r in runs], axis=0) for M in "ABCD")
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                fitted = GrayBoxRestructurer(structure, norm=norm).fit_model(
                    StateSpace(*blocks, box.sampling_time),
                    starts=[truth],
                    search=False,
                    realizations=runs,
                )
            text = " ".join(str(w.message) for w in caught if BENT in str(w.message))
            told.append([f"'{name}'" in text for name in structure.parameter_names])
            table = fitted.confidence_intervals()
            inside.append((table["lower"] <= truth) & (truth <= table["upper"]))
        right, doubted = np.array(inside), np.array(told)
        others = 100 * np.mean(right[~doubted]) if not doubted.all() else np.nan
        all_of, share = 100 * np.mean(right), 100 * np.mean(doubted)
        print(
            f"{name:24s} {all_of:5.1f} %  told {share:5.1f} %, others {others:5.1f} %"
        )


def noisy(box: StateSpace, rng: np.random.Generator) -> StateSpace:
    blocks = (box.A, box.B, box.C, box.D)
    blocks = (M * (1 + SPREAD * rng.normal(size=M.shape)) for M in blocks)
    return StateSpace(*blocks, box.sampling_time)


def responses(trials: int) -> None:
    counts: Counter[str] = Counter()
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        structure, omega, G = response(rng)
        try:
            fitted = GrayBoxRestructurer(structure, n_starts=2, max_iter=25)
            stable = fitted.fit(omega, G).lti_.is_stable
            counts["stable" if stable else f"unstable: {trial}"] += 1
        except Exception as problem:  # what this study counts
            counts[f"{trial}: {problem!r}"] += 1
    for what, count in counts.most_common():
        print(count, what)


def response(
    rng: np.random.Generator,
) -> tuple[GrayBoxStructure, np.ndarray, np.ndarray]:
    p, m, n = (int(rng.integers(1, high)) for high in (3, 3, 5))
    structure = [
        GrayBoxStructure.observable_canonical(int(rng.integers(1, 7)), m, p),
        GrayBoxStructure.modal(int(rng.integers(1, 3)), m, p, int(rng.integers(2))),
    ][rng.integers(2)]
    w, z = 10 ** rng.uniform(-1, 1, n), 10 ** rng.uniform(-2, 0.3, n)
    A = np.kron(np.eye(n), [[0, 1], [0, 0]])
    A[1::2] -= np.kron(np.diag(w**2), [[1, 0]]) + np.kron(np.diag(2 * z * w), [[0, 1]])
    plant = StateSpace(A, rng.normal(size=(2 * n, m)), rng.normal(size=(p, 2 * n)))
    count = int(rng.integers(1, 60))
    omega = np.geomspace(0.05, 20, count) if count % 2 else np.linspace(0.1, 20, count)
    G = plant.frequency_response(omega) * 10 ** rng.uniform(-6, 6)
    noise = rng.normal(size=(2, *G.shape))
    return (
        structure,
        omega,
        G + rng.choice(NOISE) * np.abs(G).mean() * (noise[0] + 1j * noise[1]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=["coverage", "responses"])
    parser.add_argument("--norm", default="hinf")
    parser.add_argument("--trials", type=int, default=60)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.study == "coverage":
        coverage(options.norm, options.trials)
    else:
        responses(options.trials)


if __name__ == "__main__":
    main()
