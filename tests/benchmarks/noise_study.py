"""Noisy black boxes: coverage of intervals, responses that must not fail, optima.

    python tests/benchmarks/noise_study.py coverage [--norm hinf] [--trials 60]
    python tests/benchmarks/noise_study.py responses [--trials 1000]
    python tests/benchmarks/noise_study.py optima [--trials 36] [--first 0]

Coverage: 95 % intervals of the parameters from ten realizations, around the truth, a
row per generator, the share of parameters whose intervals are told to be no good, and
coverage of the others. Responses: random plants with noise of 0 to 200 % against
structures of other orders, few frequencies, and any scale; what raises, and what is
unstable. Optima: black boxes with noise of -25 dB, and ones with a mode more than the
structure has; how many end, from nothing, more than 1 % above the optimum that is
reached from the truth, and how many of these tell nothing.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter

import numpy as np
from exact_problems import GENERATORS, problems
from restructuring_problems import beside

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace

SPREAD = 3e-3  # relative noise of every entry of a balanced realization
REALIZATIONS = 10
BENT = "are not to be trusted"  # what is said of intervals that are not linear
WORSE, RECOVERED = 0.01, 1e-8  # relative to an optimum, and to the black box
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


def optima(trials: int, first: int) -> None:
    rows: dict[tuple[str, str], list[tuple[bool, bool, float]]] = {}
    for name, seed, structure, truth in problems(trials, first):
        model = structure.model(truth).balance()
        for kind, spoil in (("noise", noisy_by), ("outside", with_a_mode)):
            box = spoil(model, np.random.default_rng([seed, 25]))
            start = time.process_time()
            own, told = fitted_to(structure, box)
            seconds = time.process_time() - start
            others = [
                fitted_to(structure, box, starts=[truth], search=search)[0]
                for search in (True, False)
            ]
            best = min(own, *others)
            worse = own > max((1.0 + WORSE) * best, RECOVERED)
            row = worse, worse and not told, seconds
            rows.setdefault((kind, name), []).append(row)
            if worse:
                ratio, words = own / best, (told or ["SILENT"])[0][:50]
                print(
                    f"{kind:8s} {seed:5d} {name:18s} {ratio:8.3f} {words}", flush=True
                )
    print("\nblack box  generator           problems  worse silent  seconds: median")
    for kind in ("noise", "outside"):
        of_kind = {name: row for (k, name), row in rows.items() if k == kind}
        total = [row for found in of_kind.values() for row in found]
        for name, found in [*of_kind.items(), ("all", total)]:
            worse, silent, seconds = np.array(found).T
            counts = f"{len(found):8d} {int(worse.sum()):6d} {int(silent.sum()):6d}"
            print(f"{kind:10s} {name:20s} {counts} {np.median(seconds):15.2f}")


def fitted_to(
    structure: GrayBoxStructure, box: StateSpace, **options: object
) -> tuple[float, list[str]]:
    """The relative error that is reached, infinite where none is, and what is told."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            fitted = GrayBoxRestructurer(structure).fit_model(box, **options)
        except (ValueError, np.linalg.LinAlgError) as problem:
            return np.inf, [str(problem)]
    return fitted.relative_error_, [str(w.message) for w in caught]


def noisy_by(
    box: StateSpace, rng: np.random.Generator, decibel: float = 25.0
) -> StateSpace:
    """A stable model of that order whose response is so much off, in mean square."""
    wanted, omega = 10 ** (-decibel / 20), np.abs(box.poles())
    omega = np.geomspace(omega.min() / 20, omega.max() * 10, 200)
    G = box.frequency_response(omega)
    while True:
        draws = [rng.normal(size=M.shape) for M in (box.A, box.B, box.C)]
        size = 0.3 * wanted
        for _ in range(20):
            A, B, C = (
                M + size * np.abs(M).max() * draw * share
                for M, draw, share in zip(
                    (box.A, box.B, box.C), draws, (0.1, 1.0, 1.0), strict=True
                )
            )
            found = StateSpace(A, B, C, box.D)
            off = np.linalg.norm(found.frequency_response(omega) - G)
            ratio = wanted * np.linalg.norm(G) / off
            if abs(ratio - 1.0) < 0.05 and found.is_stable:
                return found
            size *= ratio


def with_a_mode(box: StateSpace, rng: np.random.Generator) -> StateSpace:
    """A resonance beside the model, of 1 to 30 % of its norm."""
    rates, p, m = np.abs(box.poles()), box.n_outputs, box.n_inputs
    w = np.exp(rng.uniform(np.log(rates.min()), np.log(rates.max())))
    A = [[0, 1], [-(w**2), -2 * w * 10 ** rng.uniform(-1.5, 0)]]
    mode = StateSpace(A, rng.normal(size=(2, m)), rng.normal(size=(p, 2)))
    size = 10 ** rng.uniform(-2, -0.5) * box.hinf_norm() / mode.hinf_norm()
    return beside(box, StateSpace(mode.A, mode.B, size * mode.C))


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
    parser.add_argument("study", choices=["coverage", "responses", "optima"])
    parser.add_argument("--norm", default="hinf")
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.study == "coverage":
        coverage(options.norm, options.trials)
    elif options.study == "optima":
        optima(options.trials, options.first)
    else:
        responses(options.trials)


if __name__ == "__main__":
    main()
