"""Whether interchangeable parts keep their places from one operating point to the next.

    python tests/benchmarks/branches_study.py [--families 200] [--first 0] [--snr 40]
        [--horizon 3]

Random families of structures with two to four interchangeable parts: modes, real poles,
lags in series, an actuator and a sensor about a mode. Their parameters are polynomials
of the second degree in the scheduling variable, with branches that cross; five to nine
operating points, an experiment of 800 samples each, from data to the LPV model.

A family is wrong where the LPV model's error between the points (H-infinity norm,
relative to the true model there) exceeds three times the largest one at the points.
"matched" is the error between points of the same parameters with every part in its true
place, which no choice can beat: what is wrong there, too, is no matter of places.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.structures.interchanges import interchanges

# Least relative distance of the poles of two parts at the points. Real poles with gains
# of their own, nearer to each other, are hardly told apart at 40 dB: their standard
# deviations grow to the size of the parameters, whatever their places.
APART = {"modes": 0.2, "real poles": 0.6, "lags": 0.2, "sensor": 0.2}
WRONG = 3.0  # times the largest error at the points
KINDS = ("modes", "real poles", "lags", "sensor")
N_SAMPLES = 800


class FamilyProblem(NamedTuple):
    """A structure and its true parameters over the scheduling variable."""

    kind: str
    structure: GrayBoxStructure
    truth: Callable[[float], np.ndarray]
    kappa: np.ndarray


def structure_of(kind: str, n: int) -> GrayBoxStructure:
    if kind == "modes":
        return GrayBoxStructure.modal(n)
    if kind == "real poles":
        return GrayBoxStructure.modal(0, n_real=n)
    if kind == "lags":
        A = [["0"] * n for _ in range(n)]
        for i in range(n):
            A[i][i] = f"-a{i + 1}"
            if i:
                A[i][i - 1] = f"a{i + 1}"
        B = [["a1"], *[[0]] * (n - 1)]
        return GrayBoxStructure.from_template(A, B, [[0] * (n - 1) + [1]])
    A = [["-a", 0, 0, 0], [0, 0, 1, 0], ["k", "-k", "-c", 0], [0, "s", 0, "-s"]]
    return GrayBoxStructure.from_template(A, [["a"], [0], [0], [0]], [[0, 0, 0, 1]])


def parts_of(kind: str, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Values of the parameters at the ends and in the middle of the range."""
    found: dict[str, np.ndarray] = {}

    def moving(low: float, high: float) -> np.ndarray:
        """A value anywhere that moves by up to a factor of two, and bends a little."""
        middle = np.exp(rng.uniform(np.log(low), np.log(high)))
        slope, bend = rng.uniform(-0.35, 0.35), rng.uniform(-0.08, 0.08)
        return middle * np.array([1 - slope + bend, 1.0, 1 + slope + bend])

    if kind == "sensor":
        found = {"a": moving(1.0, 6.0), "s": moving(1.0, 6.0)}
        rate = moving(3.0, 5.0)
        return found | {"k": rate**2, "c": 2 * rng.uniform(0.1, 0.4) * rate}
    for i in range(n):
        if kind == "lags":
            found[f"a{i + 1}"] = moving(0.5, 8.0)
        elif kind == "real poles":
            found[f"r_{i + 1}"] = moving(0.5, 12.0)
            gain = rng.choice([-1.0, 1.0]) * moving(0.5, 2.0)
            found[f"c1_{i + 1}"] = gain * found[f"r_{i + 1}"][1]
        else:
            rate = moving(1.0, 12.0)
            found[f"w2_{i + 1}"] = rate**2
            found[f"d_{i + 1}"] = 2 * rng.uniform(0.03, 0.2) * rate
            gain = rng.choice([-1.0, 1.0]) * moving(0.5, 2.0)
            found[f"c1_{2 * i + 1}"] = gain * rate[1] ** 2 * 0.3
            found[f"c1_{2 * i + 2}"] = rng.normal() * 0.1 * np.abs(gain) * rate[1]
    return found


def part_poles(problem: FamilyProblem, kappa: float) -> np.ndarray:
    """Poles of the interchangeable parts, one of each pair."""
    names, theta = problem.structure.parameter_names, problem.truth(kappa)
    value = dict(zip(names, theta, strict=True))
    if problem.kind == "modes":
        rows = [(value[f"w2_{i}"], value[f"d_{i}"]) for i in range(1, 9)
                if f"w2_{i}" in value]  # fmt: skip
        return np.array([-d / 2 + 1j * np.sqrt(w2 - d**2 / 4) for w2, d in rows])
    keep = {"real poles": "r", "lags": "a", "sensor": "as"}[problem.kind]
    return np.array([-v for name, v in value.items() if name[0] in keep])


def family(seed: int) -> FamilyProblem:
    rng = np.random.default_rng([seed, 4])
    kind = KINDS[seed % len(KINDS)]
    while True:
        n = 2 if kind == "sensor" else int(rng.integers(2, 5))
        structure = structure_of(kind, n)
        ends = parts_of(kind, n, rng)
        values = np.array([ends[name] for name in structure.parameter_names])
        kappa = np.linspace(-1.0, 1.0, int(rng.integers(5, 10)))

        def truth(k: float, values: np.ndarray = values) -> np.ndarray:
            low, middle, high = values.T
            bend = (high + low) / 2 - middle
            return middle + (high - low) / 2 * k + bend * k**2

        problem = FamilyProblem(kind, structure, truth, kappa)
        gaps = []
        for k in kappa:
            p = part_poles(problem, k)
            distance = np.abs(p[:, None] - p) / np.minimum(abs(p[:, None]), abs(p))
            gaps.append(distance[~np.eye(len(p), dtype=bool)].min())
        if min(gaps) > APART[kind]:
            return problem


def identified(
    problem: FamilyProblem, snr: float, seed: int, horizon: int | None = None
) -> LocalLPVPipeline:
    rng = np.random.default_rng([seed, 5])
    structure, kappa = problem.structure, problem.kappa
    poles = np.concatenate([structure.model(problem.truth(k)).poles() for k in kappa])
    step = 0.6 / np.abs(poles).max()
    runs = []
    for k in kappa:
        u = rng.choice([-1.0, 1.0], (N_SAMPLES // 4, 1)).repeat(4, axis=0)
        u = u + 0.5 * rng.standard_normal(u.shape)
        y = structure.model(problem.truth(k)).simulate(u, sampling_time=step)
        noise = 10 ** (-snr / 20) * y.std() * rng.standard_normal(y.shape)
        runs.append((u, k, y + noise))
    return LocalLPVPipeline(
        SubspaceLTI(
            feedthrough=False,
            horizon="auto" if horizon is None else horizon * structure.order,
        ),
        GrayBoxRestructurer(structure, random_state=seed),
        scheduling="kappa",
        experiment="experiment",
        time="time",
    ).fit(*from_trajectories(runs, sampling_time=step))


def errors(
    lpv: Callable[[float], object], problem: FamilyProblem, points: np.ndarray
) -> np.ndarray:
    found = []
    for k in points:
        truth = problem.structure.model(problem.truth(k))
        found.append((lpv(k) - truth).hinf_norm() / truth.hinf_norm())
    return np.array(found)


def matched(pipeline: LocalLPVPipeline, problem: FamilyProblem) -> LPVStateSpace:
    """The LPV model of the same parameters, with every part in its true place."""
    theta, places = pipeline.parameters_.to_numpy(), interchanges(problem.structure)
    rows, covariance = [], []
    for k, own, P in zip(
        problem.kappa, theta, pipeline.parameters_covariance_, strict=True
    ):
        true = problem.truth(k)
        gaps = np.abs((own[places] - true) / true).sum(1)
        pi = places[int(np.argmin(gaps))]
        rows.append(own[pi])
        covariance.append(P[np.ix_(pi, pi)])
    kappa = problem.kappa[:, None]
    found = AutoLPV().fit(kappa, np.array(rows), covariance=np.array(covariance))
    span = np.array([[-1.0], [1.0]])
    return LPVStateSpace(problem.structure, found, span)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--families", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--snr", type=float, default=40.0)
    parser.add_argument("--horizon", type=int, help="samples per state; by choice")
    options = parser.parse_args()
    table: dict[str, list[tuple[bool, bool, bool, float]]] = {k: [] for k in KINDS}
    for seed in range(options.first, options.first + options.families):
        problem, start = family(seed), time.process_time()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pipeline = identified(problem, options.snr, seed, options.horizon)
        seconds = time.process_time() - start
        told = bool(caught)  # of places, or of what the data do not determine
        kappa = problem.kappa
        between = (kappa[1:] + kappa[:-1]) / 2
        models = dict(zip(kappa, pipeline.structured_models_, strict=True))
        at_points = errors(models.__getitem__, problem, kappa).max()
        here = errors(pipeline.lpv_.at, problem, between).max()
        best = errors(matched(pipeline, problem).at, problem, between).max()
        wrong, hopeless = here > WRONG * at_points, best > WRONG * at_points
        row = wrong, wrong and hopeless, wrong and not told, seconds
        table[problem.kind].append(row)
        if wrong:
            print(
                f"{seed:4d} {problem.kind:10s} {len(pipeline.parameters_.columns):2d} "
                f"parameters, {len(kappa)} points: at points {at_points:.2g}, between "
                f"{here:.2g}, matched {best:.2g}{', told' if told else ''}",
                flush=True,
            )
    print("\nkind        families  wrong  also matched  silent  seconds (median)")
    for kind, rows in table.items():
        if rows:
            wrong, hopeless, silent, seconds = np.array(rows).T
            print(
                f"{kind:10s} {len(rows):9d} {int(wrong.sum()):6d} "
                f"{int(hopeless.sum()):13d} {int(silent.sum()):7d} "
                f"{np.median(seconds):9.2f}"
            )


if __name__ == "__main__":
    main()
