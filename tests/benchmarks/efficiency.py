"""How near the parameters of a gray box are to the Cramer-Rao bound.

    python tests/benchmarks/efficiency.py [--runs 40] [--first 0] [--only NAME]
    python tests/benchmarks/efficiency.py --chain [--runs 5] [--first 0]

Two masses on springs, forces in, positions out, both masses driven by white noise. For
every way of restructuring: the root mean square, over runs and parameters, of the error
in units of the bound's standard deviation (1 is the best that an unbiased estimate
reaches; 40 runs tell it to some 5 %), that of the worst parameter, the share of errors
within 1.96 of the standard deviations that are claimed, and the mean cost by its
degrees of freedom (1 if the structure is true and the covariance right).

The bound is that of the gray-box model itself: from the Jacobian J of its simulated
outputs, whitened by the true noise, ``inv(J^T J)``.

"weighted": the parameters at the least distance in units of the covariance of a black
box that minimises the simulation error. "noise": the same from one whose errors were
whitened, as `SubspaceLTI` does. "pbsid": from one of that method. "ml": least squares
on the whitened outputs, from the true parameters.

With `--chain` the same of a whole `LocalLPVPipeline` with its defaults, from tables of
seven operating points, 400 samples each, between which both springs stiffen: orders and
horizons are its own.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.signal import lfilter

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    SubspaceLTI,
)
from lpvlearn.pipeline.one_basis.structured_models import covariance_of_parameters
from lpvlearn.pipeline.points.local_models import _average
from lpvlearn.restructuring.minimise_covariance import efficient_parameters

STRUCTURE = GrayBoxStructure.mechanical(
    M=[["m1", 0], [0, "m2"]],
    D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
    K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
    F=[[1, 0], [0, 1]],
)
TRUTH = STRUCTURE.check_params(
    {"m1": 1.0, "m2": 0.5, "c1": 0.8, "c2": 0.4, "k1": 60.0, "k2": 30.0}
)
STEP = 0.05  # s; the modes are at 0.9 and 2.1 Hz


class Case(NamedTuple):
    """An experiment: samples, noise by output (of its standard deviation), pole."""

    n_samples: int
    noise: tuple[float, float]
    pole: float = 0.0
    n_realizations: int = 1
    process: float = 0.0  # of forces that shake the masses, by what they do to outputs


CASES = {
    "400 samples, 20 dB": Case(400, (0.1, 0.1)),
    "1000 samples, 20 dB": Case(1000, (0.1, 0.1)),
    "3000 samples, 20 dB": Case(3000, (0.1, 0.1)),
    "400 samples, noise 1:100": Case(400, (0.01, 1.0)),
    "1000 samples, noise 1:100": Case(1000, (0.01, 1.0)),
    "1000 samples, AR(0.9)": Case(1000, (0.1, 0.1), 0.9),
    "6 x 400 averaged, 20 dB": Case(400, (0.1, 0.1), 0.0, 6),
    "1000 samples, shaken": Case(1000, (0.03, 0.03), process=0.1),
}


class Estimate(NamedTuple):
    """Parameters, their claimed covariance, cost and its degrees of freedom."""

    theta: np.ndarray
    covariance: np.ndarray | None = None
    cost: float = np.nan
    freedom: int = 0


class Record(NamedTuple):
    """One experiment, the white noise's size, and a root of its covariance."""

    u: np.ndarray
    y: np.ndarray
    std: np.ndarray
    root: np.ndarray | None = None  # of samples and outputs, where forces shake


def simulated(theta: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Outputs of the structured model."""
    return STRUCTURE.model(theta).simulate(u, sampling_time=STEP)


def experiment(
    rng: np.random.Generator, case: Case, theta: np.ndarray = TRUTH
) -> Record:
    """A fresh input and fresh noise."""
    u = rng.standard_normal((case.n_samples, 2))
    clean = simulated(theta, u)
    white = rng.standard_normal(clean.shape)
    std = clean.std(axis=0) * case.noise * np.sqrt(1.0 - case.pole**2)
    y = clean + lfilter([1.0], [1.0, -case.pole], std * white, 0)
    if not case.process:
        return Record(u, y, std)
    v = simulated(theta, rng.standard_normal((2 * len(u), 2)))
    size = case.process * clean.std(axis=0) / v.std(axis=0)
    root = root_of_covariance(theta, size, std, len(u))
    return Record(u, y + size * v[len(u) :], std, root)


def root_of_covariance(
    theta: np.ndarray, size: np.ndarray, std: np.ndarray, n: int
) -> np.ndarray:
    """Of n samples of outputs that white forces move, and of white noise in these."""
    pulses = np.zeros((2, 2 * n, 2))
    pulses[[0, 1], 0, [0, 1]] = 1.0
    h = size * [simulated(theta, pulse) for pulse in pulses]  # (forces, time, outputs)
    R = [np.einsum("fto,ftp->op", h[:, k:], h[:, : 2 * n - k]) for k in range(n)]
    R[0] = R[0] + np.diag(std**2)
    lags = np.array([r.T for r in R[:0:-1]] + R)
    by_times = lags[np.subtract.outer(np.arange(n), np.arange(n)) + n - 1]
    return np.linalg.cholesky(by_times.swapaxes(1, 2).reshape(2 * n, 2 * n))


def whitened(y: np.ndarray, record: Record, case: Case) -> np.ndarray:
    """Outputs, filtered or divided so that their noise is white and of size one."""
    if record.root is not None:
        return solve_triangular(record.root, y.ravel(), lower=True)
    return (lfilter([1.0, -case.pole], [1.0], y, axis=0) / record.std).ravel()


def jacobian(theta: np.ndarray, records: Sequence[Record], case: Case) -> np.ndarray:
    """Derivatives of the whitened outputs, by central differences."""
    columns = []
    for h in np.diag(1e-5 * theta):
        rows = [
            whitened(simulated(theta + h, r.u) - simulated(theta - h, r.u), r, case)
            for r in records
        ]
        columns.append(np.concatenate(rows) / (2.0 * h.sum()))
    return np.column_stack(columns)


def maximum_likelihood(records: Sequence[Record], case: Case) -> Estimate:
    """Least squares on the whitened outputs."""

    def residuals(theta: np.ndarray) -> np.ndarray:
        rows = [whitened(simulated(theta, r.u) - r.y, r, case) for r in records]
        return np.concatenate(rows)

    found = least_squares(
        residuals, TRUTH, lambda x: jacobian(x, records, case), x_scale="jac"
    )
    return Estimate(found.x, np.linalg.inv(found.jac.T @ found.jac))


def weighted(fits: Sequence[SubspaceLTI], start: np.ndarray) -> Estimate:
    """Parameters nearest to discrete-time models in their own uncertainty."""
    identified = [(fit.lti_, fit.deviated_models()) for fit in fits]
    found = efficient_parameters(STRUCTURE, identified, start)
    assert found is not None and found.converged
    return Estimate(found.theta, found.covariance, found.cost, found.degrees_of_freedom)


def estimates(records: Sequence[Record], case: Case) -> Iterator[tuple[str, Estimate]]:
    """What every method makes of the records."""
    plain, fits, shared = (
        [
            SubspaceLTI(4, horizon=15, sampling_time=STEP, **options).fit(r.u, r.y)
            for r in records
        ]
        for options in ({"refine": "simulation"}, {}, {"method": "pbsid"})
    )
    models = [fit.lti_ for fit in fits]
    black_boxes = [model.to_continuous().balance() for model in models]
    if any(box.order != STRUCTURE.order for box in black_boxes):
        return  # a pole on the negative axis
    black_box, realizations = black_boxes[0], {}
    if len(records) > 1:
        black_box = _average(black_boxes)
        realizations = {"realizations": black_boxes}
    for norm in ("hinf", "h2"):
        found = GrayBoxRestructurer(STRUCTURE, norm=norm).fit_model(
            black_box, **realizations
        )
        if realizations:
            covariance = found.params_covariance_
        else:
            pairs = [
                (above.to_continuous(), below.to_continuous())
                for above, below in fits[0].deviated_models()
            ]
            covariance = covariance_of_parameters(
                STRUCTURE, found.params_, None, black_box, pairs, norm
            )
        yield norm, Estimate(found.params_, covariance)
        if norm == "hinf":
            start = found.params_
    yield "weighted", weighted(plain, start)
    yield "noise", weighted(fits, start)
    yield "pbsid", weighted(shared, start)
    yield "ml", maximum_likelihood(records, case)


def study(name: str, runs: range) -> None:
    """Print a table for one kind of experiment."""
    case, begin = CASES[name], time.perf_counter()
    errors, inside, costs = defaultdict(list), defaultdict(list), defaultdict(list)
    for run in runs:
        rng = np.random.default_rng([run, *name.encode()])
        records = [experiment(rng, case) for _ in range(case.n_realizations)]
        J = jacobian(TRUTH, records, case)
        bound = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
        for method, found in estimates(records, case):
            error = found.theta - TRUTH
            errors[method].append(error / bound)
            if found.covariance is not None:
                std = np.sqrt(np.diag(found.covariance))
                inside[method].append(np.abs(error) <= 1.96 * std)
            costs[method].append(found.cost / max(found.freedom, 1))
    spent = time.perf_counter() - begin
    print(f"\n{name}: {len(errors['ml'])} runs, {spent:.0f} s")
    print("method      RMSE / bound   worst   within 95 %   cost / freedom")
    for method, error in errors.items():
        by_parameter = np.sqrt(np.mean(np.square(error), axis=0))
        print(
            f"{method:10s} {np.sqrt(np.mean(by_parameter**2)):10.3f}"
            f"{by_parameter.max():12.3f}{100.0 * np.mean(inside[method]):11.1f}"
            f"{np.mean(costs[method]):15.2f}",
            flush=True,
        )


def chain(name: str, runs: range) -> None:
    """Print what a pipeline with its defaults makes of tables of seven points."""
    case, begin = CASES[name], time.process_time()
    stiffening = np.array(TRUTH)[None] * np.ones((7, 1))
    for parameter, slope in (("k1", 3.0), ("k2", 1.5)):
        stiffening[:, STRUCTURE.parameter_names.index(parameter)] += slope * np.arange(
            7
        )
    errors, inside = [], []
    for run in runs:
        rng = np.random.default_rng([run, *name.encode()])
        tables, outputs, bounds = [], [], []
        for point, theta in enumerate(stiffening):
            record = experiment(rng, case, theta)
            J = jacobian(theta, [record], case)
            bounds.append(np.sqrt(np.diag(np.linalg.inv(J.T @ J))))
            table = pd.DataFrame(record.u, columns=["first", "second"])
            at = {"time": STEP * np.arange(len(table)), "stiffness": float(point)}
            tables.append(table.assign(**at, run=point))
            outputs.append(record.y)
        pipeline = LocalLPVPipeline(
            restructurer=GrayBoxRestructurer(STRUCTURE),
            inputs=["first", "second"],
            scheduling="stiffness",
            experiment="run",
            time="time",
        ).fit(pd.concat(tables, ignore_index=True), np.vstack(outputs))
        error = pipeline.parameters_[[*STRUCTURE.parameter_names]] - stiffening
        errors.append(error.to_numpy() / bounds)
        inside.append(error.abs() <= 1.96 * pipeline.parameters_std_)
    error = np.abs(errors)
    print(
        f"the chain, {name}: {len(runs)} runs, RMSE / bound "
        f"{np.sqrt(np.mean(error**2)):.3f}, of a run median "
        f"{np.median(np.sqrt(np.mean(error**2, axis=(1, 2)))):.3f}, worst "
        f"{np.sqrt(np.mean(error**2, axis=(1, 2))).max():.3f}; within 95 % "
        f"{100.0 * np.mean(inside):.1f}; "
        f"{(time.process_time() - begin) / len(runs):.1f} CPU s each",
        flush=True,
    )


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--chain", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    part = chain if options.chain else study
    for name, case in CASES.items():
        if options.only in name and not (options.chain and case.n_samples > 400):
            part(name, range(options.first, options.first + options.runs))


if __name__ == "__main__":
    main()
