"""What the restructuring reaches: right basins, optima, flat optima; and why it fails.

Run with ``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/restructuring_study.py basin``
(or ``structures``, ``optimality``, ``flat``, ``all``). ``--seeds`` sets the number of
data sets, ``--only`` names kinds of problems, ``--cache`` a folder that keeps the
identified models of the arm. Times are of the processor, per fit.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from restructuring_problems import (
    NOISY,
    RANDOM,
    Problem,
    arm_problems,
    family_problem,
    noisy_problem,
    random_problem,
)
from restructuring_references import exchange, nonsmooth_bfgs

from lpvlearn import GrayBoxRestructurer, parameter_fit

RIGHT = 95.0  # percent of parameter fit that is the right basin
SAME = 1e-6  # relative difference of equal optima
BASIN = 1e-3  # relative difference of least-squares errors in one basin


def fitted(problem: Problem, starts: Sequence[Any] = (), **options: Any) -> dict:
    """One fit: its estimator (None on an error), time, and warnings."""
    restructurer = GrayBoxRestructurer(problem.structure, **options)
    wall, own = time.perf_counter(), time.process_time()
    message = ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            restructurer.fit_model(problem.model, starts=starts)
        except (ValueError, np.linalg.LinAlgError) as error:
            restructurer, message = None, f"{type(error).__name__}: {error}"
    texts = [str(item.message) for item in caught]
    return {
        "fit": restructurer,
        "cpu": time.process_time() - own,
        "wall": time.perf_counter() - wall,
        "warned": bool(texts),
        "why": message or "; ".join(text[:40] for text in texts),
    }


def details(fit: GrayBoxRestructurer) -> dict[str, Any]:
    """What an estimator reports about its optimum."""
    return {
        "ls": fit.fit_error_,
        "relative": fit.relative_error_,
        "floor": fit.structural_floor_ / max(fit.error_, 1e-300),
        "stationarity": fit.stationarity_,
        "second": fit.second_order_,
        "n_iter": fit.n_iter_,
        "fits": len(fit.starts_),
        "active": len(fit.active_frequencies_),
    }


def summary(table: pd.DataFrame, by: str) -> pd.DataFrame:
    """One row per kind: counts of booleans, quantiles of times."""
    groups = table.groupby(by, sort=False)
    out = pd.DataFrame({"runs": groups.size()})
    for column in table.columns:
        if table[column].dtype == bool:
            out[column] = groups[column].sum()
    out["cpu median"] = groups["cpu"].median()
    out["cpu 95 %"] = groups["cpu"].quantile(0.95)
    out["cpu max"] = groups["cpu"].max()
    out["wall median"] = groups["wall"].median()
    return out


def show(title: str, table: pd.DataFrame) -> None:
    print(f"\n{title}")
    with pd.option_context(
        "display.width", 250, "display.max_columns", 40, "display.max_colwidth", 60
    ):
        print(table.to_string(float_format=lambda x: f"{x:.4g}"), flush=True)


# -- right basin -------------------------------------------------------------------


def basin_row(problem: Problem) -> dict[str, Any]:
    """A fit from nothing beside one that may start from the truth."""
    run = fitted(problem)
    helped = fitted(problem, starts=[problem.truth])
    fit, best = run.pop("fit"), helped["fit"]
    row: dict[str, Any] = {"kind": problem.name, "seed": problem.seed}
    row |= {"right": False, "basin": False, "possible": False, **run}
    if best is not None:
        row["fit truth"] = parameter_fit(problem.truth, best.params_)
        row["ls truth"] = best.fit_error_
        row["possible"] = bool(row["fit truth"] >= RIGHT)
    if fit is not None:
        row["fit"] = parameter_fit(problem.truth, fit.params_)
        row["right"] = bool(row["fit"] >= RIGHT)
        row |= details(fit)
        if best is not None:
            ceiling = best.fit_error_ * (1 + BASIN) + 1e-12
            row["basin"] = bool(fit.fit_error_ <= ceiling)
    row["wrong, silent"] = bool(not row["basin"] and not row["warned"])
    return row


def basins(title: str, problems: Sequence[Problem]) -> None:
    """``right``: parameter fit; ``possible``: that of a fit helped by the truth;
    ``basin``: no worse least squares than with that help."""
    table = pd.DataFrame([basin_row(problem) for problem in problems])
    show(title, summary(table, "kind"))
    failures = table[(~table["basin"]) | (table["possible"] & ~table["right"])]
    if len(failures):
        show(f"{title}: failures", failures.drop(columns=["possible"]))


# -- optimality --------------------------------------------------------------------


def references(problem: Problem, ours: GrayBoxRestructurer) -> dict[str, tuple]:
    """Values and parameters that other solvers and starts reach."""
    found: dict[str, tuple] = {}

    def add(name: str, run: dict) -> None:
        if run["fit"] is not None:
            found[name] = run["fit"].error_, run["fit"].params_

    for seed in (1, 2):
        add(f"sqp seed {seed}", fitted(problem, random_state=seed, n_starts=48))
    add("bundle", fitted(problem, solver="bundle", max_iter=600))
    tasks = [(exchange, "start"), (nonsmooth_bfgs, "start")]
    thetas = {"start": ours.start_params_}
    if problem.truth.size:
        add("sqp truth", fitted(problem, init=problem.truth))
        tasks.append((exchange, "truth"))
        thetas["truth"] = problem.truth
    for solver, name in tasks:
        try:
            result = solver(problem.structure, problem.model, thetas[name])
        except (np.linalg.LinAlgError, IndexError):
            continue
        found[f"{solver.__name__} {name}"] = result
    return found


def diagnosis(
    problem: Problem, fit: GrayBoxRestructurer, best: float, theta: np.ndarray
) -> dict[str, Any]:
    """Whether a worse value is a stalled solver, or another local minimum."""
    polished = exchange(problem.structure, problem.model, fit.params_)[0]
    from_best = fit.start_error(problem.model, theta)
    stalled = polished < fit.error_ * (1 - SAME)
    if stalled:
        cause = "stalled"
    elif from_best < fit.fit_error_ * (1 - BASIN):
        cause = "better least-squares basin missed"
    else:
        cause = "local minimum beside the best least squares"
    return {"cause": cause, "polished": polished / best - 1, "ls best": from_best}


def optimality_row(problem: Problem) -> dict[str, Any]:
    run = fitted(problem)
    fit = run.pop("fit")
    row: dict[str, Any] = {"kind": problem.name, "seed": problem.seed}
    row |= {"1e-6": False, "1e-4": False, "1e-2": False, **run}
    if fit is None:
        return row | {"cause": "no fit"}
    others = references(problem, fit)
    winner = min(others, key=lambda name: others[name][0])
    best = min(others[winner][0], fit.error_)
    row["excess"] = fit.error_ / best - 1
    for name in ("1e-6", "1e-4", "1e-2"):
        row[name] = bool(row["excess"] <= float(name))
    row |= details(fit)
    for name in ("bundle", "exchange start", "nonsmooth_bfgs start"):
        row[name] = others[name][0] / best - 1 if name in others else np.nan
    row["ahead"] = bool(fit.error_ < others[winner][0] * (1 - SAME))
    if row["excess"] > SAME:
        row |= {"winner": winner, **diagnosis(problem, fit, best, others[winner][1])}
    return row


def optimality(problems: Sequence[Problem]) -> None:
    rows = []
    for problem in problems:
        row = optimality_row(problem)
        rows.append(row)
        line = {name: value for name, value in row.items() if value is not False}
        print(line, flush=True)
    table = pd.DataFrame(rows)
    show("optimality: within these of the best known value", summary(table, "kind"))
    for name in ("bundle", "exchange start", "nonsmooth_bfgs start"):
        reached = (table[name] <= SAME).groupby(table["kind"], sort=False).sum()
        print(f"{name}: within {SAME:g}: {reached.to_dict()}")
    failures = table[~table["1e-6"]]
    if len(failures):
        show("optimality: failures", failures.drop(columns=["1e-6", "ahead"]))


# -- flat optima -------------------------------------------------------------------


def flat(problems: Sequence[Problem]) -> None:
    """Parameters of the result beside those of the least-squares start."""
    rows = []
    for problem in problems:
        run = fitted(problem)
        fit = run.pop("fit")
        start = parameter_fit(problem.truth, fit.start_params_)
        result = parameter_fit(problem.truth, fit.params_)
        rows.append(
            {
                "seed": problem.seed,
                "start": start,
                "result": result,
                "change": result - start,
                "floor": fit.structural_floor_ / fit.error_,
                "remaining": fit.remaining_error_ / fit.error_,
                "n_iter": fit.n_iter_,
                "cpu": run["cpu"],
            }
        )
    table = pd.DataFrame(rows)
    levels = [0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0]
    numbers = table[["start", "result", "change", "floor", "remaining", "cpu"]]
    show("flat optima: quantiles", numbers.quantile(levels))
    show("flat optima: means", numbers.mean().to_frame().T)
    worse = table["change"] < 0
    print(f"worse than the start: {worse.sum()} of {len(table)}")
    show("flat optima: largest losses", table.sort_values("change").head(12))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    studies = ("basin", "structures", "optimality", "flat", "all")
    parser.add_argument("study", choices=studies)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--cache", type=Path, default=None)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)

    def chosen(names: Sequence[str]) -> list[str]:
        return [n for n in names if options.only is None or n in options.only]

    def wanted(study: str) -> bool:
        return options.study in (study, "all")

    if wanted("basin") or wanted("flat"):
        arms = [p for seed in seeds for p in arm_problems(seed, options.cache)]
    if wanted("basin"):
        basins("arm, from nothing", arms)
    if wanted("flat"):
        flat(arms)
    if wanted("structures"):
        kinds = chosen(list(NOISY))
        basins("noisy structures", [noisy_problem(k, s) for k in kinds for s in seeds])
    if wanted("optimality"):
        sizes = {"family 3%": 0.03, "family 8%": 0.08}
        families = [sizes[name] for name in chosen(list(sizes))]
        problems = [family_problem(s, size) for size in families for s in seeds]
        problems += [random_problem(k, s) for k in chosen(RANDOM) for s in seeds]
        optimality(problems)


if __name__ == "__main__":
    main()
