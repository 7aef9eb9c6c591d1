"""Problems of many parameters: seconds, and what is reached.

python tests/benchmarks/large_study.py [--seeds 2] [--only modal60]
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable

import numpy as np
from exact_problems import Rng, _network, _random_tree, _scaled, template
from restructuring_problems import beside, perturbed, random_modes

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace

Problem = tuple[GrayBoxStructure, StateSpace]


def _positive(structure: GrayBoxStructure) -> GrayBoxStructure:
    return structure.with_bounds(dict.fromkeys(structure.parameter_names, (0, None)))


def rc_line(rng: Rng, sensors: list[int], noise: float = 0.0) -> Problem:
    """Fourteen conductances and capacities, current in at one end."""
    n = 14
    L = _network(n, [(i - 1, i) for i in range(n)], "g")
    E = [[f"c{i + 1}" if i == j else 0 for j in range(n)] for i in range(n)]
    A = [[f"-({entry})" for entry in row] for row in L]
    B, C = np.eye(n)[:, -1:].tolist(), np.eye(n)[sensors].tolist()
    structure = _positive(template(A, B, C, E=E))
    truth = np.exp(0.3 * rng.normal(size=structure.n_params))
    model = structure.model(truth).balance()
    return structure, perturbed(model, rng, noise) if noise else model


def thermal(rng: Rng, full: bool) -> Problem:
    """Seven nodes of known capacities: a tree, or all of them connected."""
    n = 7
    edges = [*_random_tree(n, rng), (-1, n - 1)]
    if full:
        edges = [(i, j) for j in range(n) for i in range(-1, j)]
    L, capacity = _network(n, edges, "g"), np.exp(0.5 * rng.normal(size=n))
    A = [
        [_scaled(entry, -1.0 / capacity[i]) for entry in row] for i, row in enumerate(L)
    ]
    B = np.diag(1.0 / capacity)[:, [0, n - 1]].tolist()
    structure = _positive(template(A, B, np.eye(n)[[0, n - 1]].tolist()))
    truth = np.exp(0.6 * rng.normal(size=structure.n_params))
    return structure, structure.model(truth).balance()


def modal(rng: Rng, n_modes: int, gap: float) -> Problem:
    """Lightly damped modes, neighbours apart by a factor of about exp(gap)."""
    structure = GrayBoxStructure.modal(n_modes, 1, 1)
    rates = np.exp(np.cumsum(rng.uniform(0.5 * gap, 1.5 * gap, n_modes)))
    truth = rng.normal(size=structure.n_params)
    for j, name in enumerate(structure.parameter_names):
        rate = rates[int(name.split("_")[-1]) - 1] if name[0] in "dw" else 0.0
        if name[0] == "w":
            truth[j] = rate**2
        elif name[0] == "d":
            truth[j] = 2.0 * rate * 10 ** rng.uniform(-2, -0.7)
    return structure, structure.model(truth).balance()


def canonical(rng: Rng, exact: bool) -> Problem:
    """Twenty-four states, 3 x 3; the black box has as many, or half as many more."""
    box = random_modes(24, 3, 3, rng)
    if not exact:
        box = beside(box, random_modes(12, 3, 3, rng, 0.1))
    box = box.transform(rng.normal(size=(box.order,) * 2))
    return GrayBoxStructure.observable_canonical(24, 3, 3), box


CASES: dict[str, Callable[[Rng], Problem]] = {
    "rc28 all": lambda rng: rc_line(rng, list(range(14))),
    "rc28 half": lambda rng: rc_line(rng, list(range(0, 14, 2))),
    "rc28 ends": lambda rng: rc_line(rng, [0, 13]),
    "rc28 near": lambda rng: rc_line(rng, list(range(0, 14, 2)), 0.02),
    "thermal7": lambda rng: thermal(rng, False),
    "thermal7 full": lambda rng: thermal(rng, True),
    "modal40": lambda rng: modal(rng, 10, 0.25),
    "modal40 wide": lambda rng: modal(rng, 10, 0.6),
    "modal60": lambda rng: modal(rng, 15, 0.25),
    "modal60 wide": lambda rng: modal(rng, 15, 0.6),
    "canonical24": lambda rng: canonical(rng, True),
    "canonical24 near": lambda rng: canonical(rng, False),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", choices=CASES)
    parser.add_argument("--max-time", type=float)
    options = parser.parse_args()
    print("problem           seed  params  seconds     error  stationarity  told")
    for name in [options.only] if options.only else CASES:
        for seed in range(options.seeds):
            structure, box = CASES[name](np.random.default_rng(seed))
            fitted = GrayBoxRestructurer(structure, max_time=options.max_time)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                start = time.process_time()
                fitted.fit_model(box)
                seconds = time.process_time() - start
            print(
                f"{name:18s} {seed:3d} {structure.n_params:7d} {seconds:8.1f} "
                f"{fitted.relative_error_:9.1e} {fitted.stationarity_:13.1e}  "
                f"{'; '.join(str(w.message)[:30] for w in caught)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
