"""How good an LPV model of local experiments is, by state and by interpolation.

    python tests/benchmarks/bench_lpv.py [--runs 10] [--first 5000]

The flexible arm, local experiments of 3 s at 30 dB: BFT of both outputs on a sweep of
theta2 up and one down, simulated from rest, mean and worst over the seeds; the forms
that AutoLPV chose.

A spring of quadratic stiffness, seven points, two of 100 samples and five of 3000, at
20 dB: the error of the parameters over the range relative to the Cramer-Rao bound of
quadratic parameters, of AutoLPV and of a parabola without weights.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from typing import NamedTuple

import numpy as np

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    SplineLPV,
    SubspaceLTI,
    from_trajectories,
)
from lpvlearn.datasets import make_flexible_arm
from lpvlearn.paper.tables import both_sweeps, sweeps_table

INTERPOLATORS = {
    "AutoLPV": AutoLPV(),
    "parabola": PolynomialLPV(2),
    "pchip": SplineLPV(),
    "cubic spline": SplineLPV("cubic"),
}

SPRING = GrayBoxStructure.from_template([[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]])
COEFFICIENTS = np.array([[30, 0, 0], [1.2, 0.4, 0], [40, 10, 12]])  # of b, c, k
STEP = 0.05  # s
FINE = np.linspace(0, 1.5, 50)


def bench_arm(n_points: int, seeds: range) -> None:
    """Print a row for each state and interpolation."""
    fits: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    forms: Counter[str] = Counter()
    for seed in seeds:
        data = make_flexible_arm(n_points, random_state=seed)
        pipeline = LocalLPVPipeline(
            SubspaceLTI(feedthrough=False),
            GrayBoxRestructurer(data.structure),
            scheduling="kappa",
            experiment="experiment",
            time="time",
        ).fit(data.X, data.y)
        forms[pipeline.interpolator_.form_] += 1
        kappa, P = pipeline.operating_points_, pipeline.parameters_covariance_
        sweeps = both_sweeps(data)
        for name, interpolator in INTERPOLATORS.items():
            known = {} if "pchip" in name or "spline" in name else {"covariance": P}
            interpolator.fit(kappa, pipeline.parameters_.to_numpy(), **known)
            for state in ("rate", "momentum"):
                model = LPVStateSpace(
                    data.arm.structure(state), interpolator, kappa[[0, -1]]
                )
                table = sweeps_table(model, sweeps)
                bft = table[table["metric"] == "BFT"]["ours"].to_numpy()
                fits[state, name].append(bft)
    print(f"\nFlexible arm, {n_points} points: BFT up (y1, y2), down (y1, y2)")
    for (state, name), values in sorted(fits.items()):
        mean, worst = (
            "  ".join(f"{value:6.1f}" for value in rows)
            for rows in (np.mean(values, axis=0), np.min(values, axis=0))
        )
        print(f"{state:9} {name:13} mean {mean}   worst {worst}")
    print("AutoLPV chose", dict(forms))


class SpringRun(NamedTuple):
    """Mean squared errors of b, c, k over the range, and their bound."""

    form: str
    auto: np.ndarray
    unweighted: np.ndarray
    bound: np.ndarray


def run_spring(seed: int) -> SpringRun:
    rng = np.random.default_rng(seed)
    kappas, powers = np.linspace(0, 1.5, 7), np.arange(3)
    information = np.zeros((9, 9))
    runs = []
    for k, kappa in enumerate(kappas):
        theta = COEFFICIENTS @ kappa**powers
        n = 100 if k in (1, 4) else 3000
        u = rng.choice([-1.0, 1.0], (n // 4, 1)).repeat(4, axis=0)
        model = SPRING.model(theta).to_discrete(STEP)
        y = model.simulate(u)
        noise = 0.1 * y.std()
        slopes = [
            SPRING.model(theta + h).to_discrete(STEP).simulate(u)
            - SPRING.model(theta - h).to_discrete(STEP).simulate(u)
            for h in np.diag(1e-5 * theta)
        ]
        J = np.column_stack(slopes) / (2e-5 * theta * noise)
        rest = np.column_stack(
            [model.simulate(0 * u, initial_state=x) for x in np.eye(2)]
        )  # the initial state is unknown
        J -= rest @ np.linalg.lstsq(rest, J, rcond=None)[0]
        G = np.kron(np.eye(3), kappa**powers)
        information += G.T @ (J.T @ J) @ G
        runs.append((u, kappa, y + noise * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=STEP)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, feedthrough=False),
        GrayBoxRestructurer(SPRING),
        scheduling="kappa",
        experiment="experiment",
        time="time",
    ).fit(X, y)
    terms = FINE[:, None] ** powers
    truth = terms @ COEFFICIENTS.T
    plain = PolynomialLPV(2).fit(kappas[:, None], pipeline.parameters_)
    P = np.linalg.inv(information).reshape(3, 3, 3, 3)
    bound = np.einsum("kp,jpjr,kr->kj", terms, P, terms).mean(axis=0)
    return SpringRun(
        pipeline.interpolator_.form_,
        np.mean((pipeline.lpv_.parameters(FINE) - truth) ** 2, axis=0),
        np.mean((plain.predict(FINE[:, None]) - truth) ** 2, axis=0),
        bound,
    )


def bench_spring(seeds: range) -> None:
    """Print the errors relative to the bound."""
    found = [run_spring(seed) for seed in seeds]
    bound = np.mean([run.bound for run in found], axis=0)
    print(
        "\nSpring, two points of 100 samples among five of 3000: error over the bound"
    )
    for name in ("auto", "unweighted"):
        error = np.mean([getattr(run, name) for run in found], axis=0)
        print(f"{name:11} {np.sqrt(np.mean(error / bound)):.3f}")
    print("AutoLPV chose", dict(Counter(run.form for run in found)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--first", type=int, default=5000)
    options = parser.parse_args()
    chosen = range(options.first, options.first + options.runs)
    bench_spring(chosen)
    for count in (7, 4):
        bench_arm(count, chosen)
