"""Exact problems from nothing: how many are recovered, and what is silently wrong.

    python tests/benchmarks/exact_study.py [--problems 90] [--first 0] [--norm hinf]

A problem is recovered where the error is at most 1e-6 of the black box. It is silent
where it is not, and nothing was told.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np
from exact_problems import GENERATORS, problems

from lpvlearn import GrayBoxRestructurer

RECOVERED = 1e-6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=90)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--norm", default="hinf")
    options = parser.parse_args()
    table: dict[str, list[tuple[bool, bool, float]]] = {name: [] for name in GENERATORS}
    for name, seed, structure, truth in problems(options.problems, options.first):
        box = structure.model(truth).balance()
        fitted = GrayBoxRestructurer(structure, norm=options.norm, random_state=seed)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            start = time.process_time()
            error, failure = np.inf, ""
            try:
                error = fitted.fit_model(box).relative_error_
            except (ValueError, np.linalg.LinAlgError) as problem:
                failure = str(problem)
            seconds = time.process_time() - start
        told = [str(w.message) for w in caught] + [failure] * bool(failure)
        good = error <= RECOVERED
        table[name].append((good, not good and not told, seconds))
        if not good:
            first = told[0][:50] if told else "SILENT"
            print(
                f"{seed:4d} {name:18s} {error:8.1e} {seconds:5.1f} s  {first}",
                flush=True,
            )
    rows = [row for found in table.values() for row in found]
    print("\ngenerator           problems recovered silent  seconds: median  95 %")
    for name, found in [*table.items(), ("all", rows)]:
        if found:
            good, silent, seconds = np.array(found).T
            counts = f"{len(found):7d} {int(good.sum()):9d} {int(silent.sum()):6d}"
            times = f"{np.median(seconds):15.2f} {np.quantile(seconds, 0.95):5.2f}"
            print(f"{name:20s} {counts}  {times}")


if __name__ == "__main__":
    main()
