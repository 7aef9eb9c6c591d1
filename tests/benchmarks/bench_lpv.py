"""How good an LPV model of local experiments is, by state and by interpolation.

    python tests/benchmarks/bench_lpv.py [--runs 10] [--first 5000] [--part refined]

The flexible arm, local experiments of 3 s at 30 dB: BFT of both outputs on a sweep of
theta2 up and one down, simulated from rest, mean and worst over the seeds; the forms
that AutoLPV chose.

A spring of quadratic stiffness, seven points, two of 100 samples and five of 3000, at
20 dB: the error of the parameters over the range relative to the Cramer-Rao bound of
quadratic parameters, of AutoLPV and of a parabola without weights.

The arm's models refined on two sweeps at 30 dB, one in either direction, and models of
these sweeps alone: BFT on new noise-free ones, at full, half and double speed; of the
bands of 95 %, the share of outputs that are within (of those of the parameters alone,
too), with the refinement and with the local experiments alone.

Time and memory of a step of the refinement, by the number of samples.
"""

from __future__ import annotations

import argparse
import resource
import time
import warnings
from collections import Counter, defaultdict
from typing import NamedTuple

import numpy as np
import pandas as pd

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    OutputErrorLPV,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    SubspaceLTI,
    bft_score,
    from_trajectories,
)
from lpvlearn.datasets import FlexibleArm, make_flexible_arm, prbs
from lpvlearn.exceptions import ExtrapolationWarning
from lpvlearn.paper.tables import sweeps_table

INTERPOLATORS = {
    "AutoLPV": AutoLPV(),
    "parabola": PolynomialLPV(2),
    "pchip": SplineLPV(),
    "cubic spline": SplineLPV("cubic"),
}

ALIGNED = {  # black boxes, whose entries have no covariance
    "AutoLPV": AutoLPV(),
    "parabola": PolynomialLPV(2),
    "cubic": PolynomialLPV(3),
    "rational": RationalLPV(2, 2),
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
        for name, interpolator in INTERPOLATORS.items():
            known = {} if "pchip" in name or "spline" in name else {"covariance": P}
            interpolator.fit(kappa, pipeline.parameters_.to_numpy(), **known)
            for state in ("rate", "momentum"):
                model = LPVStateSpace(
                    data.arm.structure(state), interpolator, kappa[[0, -1]]
                )
                table = sweeps_table(model, data)
                bft = table[table["metric"] == "BFT"]["ours"].to_numpy()
                fits[state, name].append(bft)
        for name, interpolator in ALIGNED.items():
            turned = LocalLPVPipeline(LOCAL, "aligned", interpolator, **ROLES)
            table = sweeps_table(turned.fit(data.X, data.y).lpv_, data)
            fits["aligned", name].append(
                table[table["metric"] == "BFT"]["ours"].to_numpy()
            )
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


ROLES = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
SPEEDS = (1.0, 0.5, 2.0)
LOCAL = SubspaceLTI(6, feedthrough=False, stability="enforce")
REFINED = {
    "momentum": (GrayBoxRestructurer(FlexibleArm().structure("momentum")), None),
    "rates": (GrayBoxRestructurer(FlexibleArm().structure()), None),
    "aligned, cubic": ("aligned", PolynomialLPV(3)),
    "aligned, rational": ("aligned", RationalLPV(2, 2)),
}
ALONE = {
    "sweeps alone, momentum": (
        FlexibleArm().structure("momentum"),
        RationalLPV(2, 2),
    ),
    "sweeps alone, no structure": (None, PolynomialLPV(3)),
}


def sweeps(arm: FlexibleArm, speed: float, rng: np.random.Generator) -> list:
    """Trajectories of a sweep up and one down, noise-free, 1 ms."""
    n = round(3000 / speed)
    references = np.empty((2, n, 2))
    for u, direction in zip(references, (1, -1), strict=True):
        u[:] = prbs(n, 2, amplitude=1.87, clock=5, balance=100, random_state=rng)
        u[:, 1] += direction * speed * np.pi / 4
    found = arm.simulate(references, [np.pi / 8, 7 * np.pi / 8], 1e-3)
    return list(zip(references, found.kappa, found.y, strict=True))


def scores(model: LPVStateSpace, runs: list) -> np.ndarray:
    """BFT of both outputs on every trajectory."""
    simulated = [model.silenced().simulate(u, k, 1e-3) for u, k, _ in runs]
    return np.array(
        [
            bft_score(y, found, multioutput="raw_values")
            for (_, _, y), found in zip(runs, simulated, strict=True)
        ]
    )


def coverage(model: LocalLPVPipeline | OutputErrorLPV, runs: list) -> np.ndarray:
    """Percent of the outputs of runs, two at each speed, within the bands of 95 %.

    Of the whole bands, and of those of the parameters alone.
    """
    X, y = from_trajectories(runs, sampling_time=1e-3)
    with warnings.catch_warnings(action="ignore", category=ExtrapolationWarning):
        error = np.abs(model.predict(X) - y.to_numpy())
    std = model.prediction_std(X)
    parts = (std.xs(part, axis=1, level="part") for part in ("total", "parameters"))
    inside = [(error <= 1.96 * part.to_numpy()).mean(axis=1) for part in parts]
    speed = X["experiment"].to_numpy() // 2
    return 100 * np.array(
        [[part[speed == k].mean() for k in range(len(SPEEDS))] for part in inside]
    )


def bench_refined(seeds: range) -> None:
    """Print rows of the local models, refined, and of the sweeps alone."""
    fits: dict[str, list[np.ndarray]] = defaultdict(list)
    inside: dict[str, list[np.ndarray]] = defaultdict(list)
    seconds: dict[str, list[float]] = defaultdict(list)
    rates: Counter[str] = Counter()
    for seed in seeds:
        data, rng = make_flexible_arm(7, random_state=seed), np.random.default_rng(seed)
        moving = [
            (u, kappa, y + 10**-1.5 * y.std(axis=0) * rng.standard_normal(y.shape))
            for u, kappa, y in sweeps(data.arm, 1.0, rng)
        ]
        new = [run for speed in SPEEDS for run in sweeps(data.arm, speed, rng)]
        X, y = from_trajectories(moving, sampling_time=1e-3)
        X["experiment"] += 1000
        both = [
            pd.concat(tables, ignore_index=True)
            for tables in ((data.X, X), (data.y, y))
        ]

        for name, (restructurer, interpolator) in REFINED.items():
            steps = (LOCAL, restructurer, interpolator)
            pipeline = LocalLPVPipeline(*steps, OutputErrorLPV(), **ROLES).fit(*both)
            inside[name].append(coverage(pipeline, new))
            if restructurer != "aligned":
                local = LocalLPVPipeline(*steps, **ROLES).fit(data.X, data.y)
                inside[f"{name}, local"].append(coverage(local, new))
            seconds[name].append(pipeline.step_times_["refinement"])
            rates[name] += pipeline.refiner_.rate_
            fits[name].append(scores(pipeline.lpv_, new))
        for name, (start, form) in ALONE.items():
            begin = time.process_time()
            model = OutputErrorLPV(start, interpolator=form, local=LOCAL, **ROLES)
            model.fit(X, y)
            inside[name].append(coverage(model, new))
            seconds[name].append(time.process_time() - begin)
            rates[name] += model.rate_
            fits[name].append(scores(model.lpv_, new))
    print("\nTwo sweeps: BFT up (y1, y2), down (y1, y2); at half and at double speed")
    for name, values in fits.items():
        mean, worst = (
            "  ".join(f"{value:5.1f}" for value in rows.ravel())
            for rows in (np.mean(values, axis=0), np.min(values, axis=0))
        )
        print(f"{name:27} mean  {mean}\n{'':27} worst {worst}")
        print(
            f"{'':27} {np.median(seconds[name]):.1f} s, rate terms in {rates[name]} of "
            f"{len(values)}"
        )
    print("\nWithin the bands of 95 %, at full, half and double speed (%)")
    for name, shares in inside.items():
        (mean, alone), worst = np.mean(shares, axis=0), np.min(shares, axis=0)[0]
        row = (
            f"{label} " + "  ".join(f"{value:5.1f}" for value in values)
            for label, values in (
                ("mean", mean),
                ("worst", worst),
                ("parameters alone", alone),
            )
        )
        print(f"{name:27} {'   '.join(row)}")


def bench_growth() -> None:
    """Print time and memory of a few steps by the number of samples."""
    arm, kappa = FlexibleArm(), np.cos(np.linspace(0.4, 2.7, 7))[:, None]
    theta = [arm.linearize(np.arccos(k)) for k in kappa[:, 0]]
    rows = [np.concatenate([M.ravel() for M in (G.A, G.B, G.C)]) for G in theta]
    structure = GrayBoxStructure.full(6, 2, 2, feedthrough=False)
    form = PolynomialLPV(2).fit(kappa, np.array(rows))
    model = LPVStateSpace(structure, form, kappa[[-1, 0]])
    print("\nA fit of three steps, 6 states, 180 coefficients")
    for n in (10_000, 100_000, 1_000_000):
        rng = np.random.default_rng(0)
        u = rng.standard_normal((n, 2))
        path = 0.8 * np.cos(np.arange(n) / 500)
        y = model.simulate(u, path, 1e-3)
        X, y = from_trajectories(
            [(u, path, y + 0.01 * rng.standard_normal(y.shape))], sampling_time=1e-3
        )
        fit = OutputErrorLPV(model, rate=False, max_iter=3, **ROLES)
        begin = time.process_time()
        fit.fit(X, y)
        spent = time.process_time() - begin
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        print(f"{n:9,} samples: {spent:7.1f} s, {peak:7.0f} MB at most", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--first", type=int, default=5000)
    parts = ("local", "refined", "growth")
    parser.add_argument("--part", choices=parts, action="append")
    options = parser.parse_args()
    chosen = range(options.first, options.first + options.runs)
    wanted = options.part or parts
    if "local" in wanted:
        bench_spring(chosen)
        for count in (7, 4):
            bench_arm(count, chosen)
    if "refined" in wanted:
        bench_refined(chosen)
    if "growth" in wanted:
        bench_growth()
