"""Time of a restructuring and of its steps.

Run with ``OPENBLAS_NUM_THREADS=1 pytest tests/benchmarks/bench_restructuring.py``. The
problems are those of ``restructuring_study.py``, which tells what the fits reach.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer
from lpvlearn.restructuring.continuation import continued_fits
from lpvlearn.restructuring.error_system import Target

sys.path.insert(0, str(Path(__file__).parent))

from restructuring_problems import (  # noqa: E402
    NOISY,
    RANDOM,
    Problem,
    family_problem,
    noisy_problem,
    random_problem,
)


def fitted(problem: Problem, solver: str) -> GrayBoxRestructurer:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        restructurer = GrayBoxRestructurer(problem.structure, solver=solver)
        return restructurer.fit_model(problem.model)


def record(benchmark: Callable, problem: Problem, solver: str) -> None:
    fit = benchmark.pedantic(fitted, (problem, solver), rounds=3)
    benchmark.extra_info["relative error"] = fit.relative_error_
    benchmark.extra_info["stationarity"] = fit.stationarity_
    benchmark.extra_info["iterations"] = fit.n_iter_


@pytest.mark.parametrize("name", NOISY)
def test_noisy_models(benchmark: Callable, name: str) -> None:
    record(benchmark, noisy_problem(name, 0), "sqp")


@pytest.mark.parametrize("solver", ["sqp", "bundle"])
@pytest.mark.parametrize("perturbation", [0.03, 0.08])
def test_perturbed_arms(benchmark: Callable, perturbation: float, solver: str) -> None:
    record(benchmark, family_problem(0, perturbation), solver)


@pytest.mark.parametrize("kind", RANDOM)
@pytest.mark.parametrize("seed", [0, 1, 2, 3])  # 4, 6, 8 and 12 states
def test_random_structures(benchmark: Callable, kind: str, seed: int) -> None:
    record(benchmark, random_problem(kind, seed), "sqp")


@pytest.mark.parametrize("name", ["two masses", "quarter car", "cart", "six masses"])
def test_one_continuation(benchmark: Callable, name: str) -> None:
    problem = noisy_problem(name, 0)
    m, theta = problem.model, problem.truth
    guess = theta * np.exp(np.random.default_rng(0).normal(size=(1, len(theta))))
    target, signed = Target(m.A, m.B, m.C, m.D), np.ones(len(theta), bool)
    benchmark.pedantic(
        continued_fits, (problem.structure, target, guess, signed), rounds=3
    )
