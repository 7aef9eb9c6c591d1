"""Fits in threads: as serial ones, and what belongs to the whole process stays."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from joblib import Parallel, delayed, parallel_config
from sklearn.base import clone
from threadpoolctl import ThreadpoolController, threadpool_limits

import lpvlearn
from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
    gap,
)

from .conftest import spring_pipeline, spring_tables

ROOT = Path(lpvlearn.__file__).parent


def matrices(theta):
    """Of a kind that takes no complex parameters: they would warn."""
    k, c, b = theta
    A = np.zeros((2, 2))
    A[:] = [[0, 1], [-k, -c]]
    return A, [[0], [b]], [[1, 0]]


def in_threads(pipeline, X, y):
    with parallel_config("threading", n_jobs=4):
        found = Parallel()(delayed(clone(pipeline).fit)(X, y) for _ in range(4))
        return [*found, clone(pipeline).set_params(n_jobs=3).fit(X, y)]


POOLS = ThreadpoolController().select(user_api="blas").lib_controllers


def blas_threads():
    return [pool.num_threads for pool in POOLS]


@pytest.mark.slow
def test_threads_agree_with_a_serial_fit_and_put_back_the_threads_of_blas():
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0, 2.0))
    structure = GrayBoxStructure.from_function(matrices, [30.0, 1.2, 50.0])
    pipeline = spring_pipeline(restructurer=GrayBoxRestructurer(structure))
    expected = clone(pipeline).fit(X, y).parameters_.to_numpy()
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        found = in_threads(pipeline, X, y)
        assert blas_threads() == before
    for fitted in found:
        np.testing.assert_array_equal(fitted.parameters_.to_numpy(), expected)


def local_fit():
    X, e = np.random.default_rng(0).standard_normal((2, 200, 1))
    y = StateSpace(0.9, 1, 1, None, 1.0).simulate(X) + 0.1 * e
    SubspaceLTI(1, horizon=5).fit(X, y).residual_tests(X, y)


def restructuring():
    structure = GrayBoxStructure.from_template(A=[["-a"]], B=[[1]], C=[["c"]])
    GrayBoxRestructurer(structure).fit_model(StateSpace(-2, 3, 4))


def interpolation():
    kappa = np.linspace(0.0, 1.0, 5)[:, None]
    AutoLPV().fit(kappa, np.sin(kappa), covariance=np.full((5, 1, 1), 1e-4))


def chain():
    pipeline = spring_pipeline(interpolator=PolynomialLPV(1))
    pipeline.fit(*spring_tables(n_samples=100, kappas=(0.0, 1.0)))


@pytest.mark.parametrize(
    "work",
    [
        local_fit,
        restructuring,
        interpolation,
        chain,
        lambda: gap(StateSpace(-2, 3, 4), StateSpace(-3, 3, 4)),
    ],
    ids=["local fit", "restructuring", "interpolation", "chain", "gap"],
)
def test_small_matrices_have_one_thread_of_blas_which_is_put_back(work, monkeypatch):
    seen = []

    def watched(original):
        def watch(*args, **options):
            seen.append(blas_threads())
            return original(*args, **options)

        return watch

    for name in ("eigvals", "svd", "solve", "lstsq", "qr"):
        monkeypatch.setattr(np.linalg, name, watched(getattr(np.linalg, name)))
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        work()
        assert blas_threads() == before
    assert seen and all(n == 1 for threads in seen for n in threads)


def test_no_code_that_a_fit_runs_changes_the_filters(monkeypatch):
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0))
    structure = GrayBoxStructure.from_function(matrices, [30.0, 1.2, 50.0])
    jordan = StateSpace([[0.9, 1.0], [0.0, 0.9]], [[0], [1]], [[1, 0]], [[0]], 0.1)

    original = warnings.catch_warnings

    def refuse(*args, **kwargs):
        caller = Path(sys._getframe(1).f_code.co_filename)
        assert not caller.is_relative_to(ROOT), f"{caller}: the filters of all threads"
        return original(*args, **kwargs)

    with monkeypatch.context() as patched:
        patched.setattr(warnings, "catch_warnings", refuse)
        spring_pipeline(
            restructurer=GrayBoxRestructurer(structure), interpolator=PolynomialLPV(1)
        ).fit(X, y)
        jordan.to_continuous()
