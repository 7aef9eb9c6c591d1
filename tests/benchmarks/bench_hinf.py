"""Speed of the H-infinity kernel beside other packages (pytest-benchmark).

Run with one BLAS thread, on an idle machine::

    OPENBLAS_NUM_THREADS=1 pytest tests/benchmarks/bench_hinf.py

Twelve states, two inputs, two outputs: one random system and one error system
G(theta) - G0, the inner loop of the restructuring. The eigenvalues of one
Hamiltonian are the floor of every method of this kind. Packages that are not
installed are skipped.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag

from lpvlearn.systems.hinf_norm import hinf_norm

Matrices = tuple[NDArray, NDArray, NDArray, NDArray]


def modes(n: int, seed: int, change: float = 0.0) -> Matrices:
    """Random modes in random coordinates; parameters off by a relative change."""
    rng = np.random.default_rng(seed)
    w, z = 10.0 ** rng.uniform(-1, 1, n // 2), 10.0 ** rng.uniform(-2, -0.3, n // 2)
    T = rng.standard_normal((n, n))
    B, C = rng.standard_normal((n, 2)), rng.standard_normal((2, n))
    D = rng.standard_normal((2, 2))
    w, z, B = (M * (1.0 + change * rng.standard_normal(M.shape)) for M in (w, z, B))
    c = np.sqrt(1.0 - z * z)
    blocks = [
        wk * np.array([[-zk, ck], [-ck, -zk]])
        for wk, zk, ck in zip(w, z, c, strict=True)
    ]
    return np.linalg.solve(T, block_diag(*blocks) @ T), np.linalg.solve(T, B), C @ T, D


def error_system(n: int, seed: int) -> Matrices:
    A, B, C, D = modes(n // 2, seed)
    A2, B2, C2, D2 = modes(n // 2, seed, change=0.03)
    return block_diag(A, A2), np.vstack((B, B2)), np.hstack((C, -C2)), D - D2


SYSTEMS = {"random": modes(12, 0), "error": error_system(12, 0)}
systems = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)


@systems
@pytest.mark.parametrize("within", [None, 1e-6, 0.1, 0.6])
def test_this_library(
    benchmark: Callable, system: Matrices, within: float | None
) -> None:
    benchmark(hinf_norm, *system, within=within)


@pytest.mark.parametrize("n", [50, 100, 200])
def test_this_library_at_higher_order(benchmark: Callable, n: int) -> None:
    benchmark.pedantic(hinf_norm, modes(n, 0), {"within": 0.1}, rounds=3)


@systems
def test_one_hamiltonian(benchmark: Callable, system: Matrices) -> None:
    A, B, C, _ = system
    H = np.block([[A, B @ B.T], [-C.T @ C, -A.T]])
    benchmark(np.linalg.eigvals, H)


def compared(benchmark: Callable, norm: float, system: Matrices) -> None:
    """Record how far the other package's value is from this library's."""
    ours = hinf_norm(*system).norm
    benchmark.extra_info["relative difference"] = float(norm / ours - 1.0)


@systems
def test_slycot(benchmark: Callable, system: Matrices) -> None:
    slycot = pytest.importorskip("slycot")
    A, B, C, D = system
    E = np.eye(len(A))
    arguments = "C", "I", "S", "D", len(A), 2, 2, A, E, B, C, D, 1e-10
    norm, _ = benchmark(slycot.ab13dd, *arguments)
    compared(benchmark, norm, system)


@systems
def test_python_control(benchmark: Callable, system: Matrices) -> None:
    control = pytest.importorskip("control")
    model = control.ss(*system)
    norm = benchmark(control.system_norm, model, p="inf", tol=1e-10, method="scipy")
    compared(benchmark, norm, system)


@systems
def test_harold(benchmark: Callable, system: Matrices) -> None:
    harold = pytest.importorskip("harold")
    model = harold.State(*system)
    norm = benchmark(lambda: harold.system_norm(model, p=np.inf, hinf_tol=1e-10))
    compared(benchmark, norm[0] if isinstance(norm, tuple) else norm, system)
