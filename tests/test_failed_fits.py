"""Fits that fail or are interrupted leave an estimator as it was."""

import numpy as np
import pytest
from sklearn.base import clone

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    LocalLPVPipeline,
    OutputErrorLPV,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    SubspaceLTI,
)

from .conftest import ROLES, spring_lpv, spring_structure, spring_tables

X, Y = spring_tables(noise=1e-3, n_samples=60, kappas=(0.0, 0.75, 1.5))
KAPPA = np.linspace(0.0, 1.0, 5)[:, None]
THETA = np.column_stack([KAPPA, 1 + KAPPA**2])
LOCAL = SubspaceLTI(2, method="po-moesp", horizon=5, refine=False, offset=None)
ONE_RUN = {"inputs": "force", "experiment": "run", "time": "time"}
OMEGA = np.array([0.1, 1.0, 10.0])
G = spring_lpv().at(0.5).frequency_response(OMEGA).ravel()
FRF = np.column_stack([G.real, G.imag])


class Interrupted(PolynomialLPV):
    """An interpolator in whose fit the user loses patience."""

    def fit(self, X, y, sample_weight=None, covariance=None):
        raise KeyboardInterrupt


def state(estimator):
    return {name: id(value) for name, value in vars(estimator).items()}


CASES = {
    "subspace": (clone(LOCAL).set_params(**ONE_RUN), X, Y),
    "restructurer": (GrayBoxRestructurer(spring_structure(), n_starts=1), OMEGA, FRF),
    "pipeline": (
        LocalLPVPipeline(LOCAL, "passthrough", PolynomialLPV(1), **ROLES),
        X,
        Y,
    ),
    "output error": (
        OutputErrorLPV(spring_lpv(), rate=False, max_iter=1, **ROLES),
        X,
        Y,
    ),
    "polynomial": (PolynomialLPV(1), KAPPA, THETA),
    "spline": (SplineLPV(), KAPPA, THETA),
    "rational": (RationalLPV(1, 1), KAPPA, THETA),
    "auto": (AutoLPV(), KAPPA, THETA),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CASES)
def test_a_fit_that_is_refused_leaves_the_estimator_as_it_was(name):
    estimator, X, y = CASES[name]
    estimator = clone(estimator).fit(X, y)
    before, bad = state(estimator), np.array(y)
    bad[1, 0] = np.inf
    for wrong in (bad, y[:-1], np.array(y, dtype=complex), None):
        with pytest.raises((ValueError, TypeError)):
            estimator.fit(X, wrong)
        assert state(estimator) == before


@pytest.mark.filterwarnings("ignore")
def test_an_interrupted_fit_leaves_the_chain_as_it_was():
    chain = clone(CASES["pipeline"][0]).fit(X, Y)
    chain.set_params(interpolator=Interrupted())
    before = state(chain)
    with pytest.raises(KeyboardInterrupt):
        chain.fit(X, Y)
    assert state(chain) == before


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name, place",
    [
        ("subspace", "lpvlearn.subspace.estimator.warn_about_horizon"),
        ("polynomial", "lpvlearn.lpv.polynomial.conversion_to"),
        ("restructurer", "lpvlearn.restructuring.estimator.starts_of"),
    ],
)
def test_an_interruption_in_the_depths_leaves_the_estimator_as_it_was(
    name, place, monkeypatch
):
    estimator, X, y = CASES[name]
    estimator = clone(estimator).fit(X, y)
    before = state(estimator)

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(place, interrupt)
    with pytest.raises(KeyboardInterrupt):
        estimator.fit(X, y)
    assert state(estimator) == before
