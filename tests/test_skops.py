"""Skops, where it is there: fitted estimators come back to the bit."""

import pickle

import numpy as np
import pandas as pd
import pytest

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    OutputErrorLPV,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    SubspaceLTI,
)

from .conftest import (
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_structure,
    spring_tables,
)

skops = pytest.importorskip("skops.io")

# One time-invariant model of several operating points is meant here.
pytestmark = pytest.mark.filterwarnings("ignore:The experiments contradict one another")

KAPPA = np.linspace(0.0, 1.0, 9)[:, None]
THETA = np.column_stack([1.0 + KAPPA, 1.0 / (2.0 + KAPPA)])
RECORD = {"inputs": "force", "experiment": "run", "time": "time"}
OMEGA = np.array([0.1, 1.0, 10.0])


def through_skops(fitted):
    data = skops.dumps(fitted)
    return skops.loads(data, trusted=skops.get_untrusted_types(data=data))


def through_pickle(fitted):
    return pickle.loads(pickle.dumps(fitted))


def assert_equal(one, other):
    """Everything that two estimators tell and predict, tables with labels and types."""
    assert vars(one).keys() == vars(other).keys()
    for name, value in vars(one).items():
        found = getattr(other, name)
        assert type(value) is type(found), name
        if isinstance(value, pd.DataFrame):
            pd.testing.assert_frame_equal(found, value)
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(found, value)


def comes_back(fitted, X):
    for back in (through_skops(fitted), through_pickle(fitted)):
        assert_equal(fitted, back)
        found, expected = (np.asarray(m.predict(X)) for m in (back, fitted))
        np.testing.assert_array_equal(found, expected)


@pytest.fixture(scope="module")
def tables():
    return spring_tables(noise=1e-3, n_samples=200)


@pytest.fixture(scope="module")
def chain(tables):
    return spring_pipeline(local=SubspaceLTI(2, horizon=8)).fit(*tables)


@pytest.mark.parametrize(
    "form",
    [
        PolynomialLPV(2),
        RationalLPV(1),
        *(SplineLPV(kind) for kind in ("pchip", "cubic", "linear")),
        AutoLPV(),
    ],
    ids=str,
)
def test_interpolators_come_back_to_the_bit(form):
    comes_back(form.fit(KAPPA, THETA), KAPPA + 0.01)


def test_splines_over_logarithms_come_back_to_the_bit():
    comes_back(SplineLPV(scale="log").fit(KAPPA + 1.0, THETA), KAPPA + 1.01)


def test_splines_over_two_variables_come_back_to_the_bit():
    kappa = np.column_stack([KAPPA, KAPPA**2])
    comes_back(SplineLPV().fit(kappa, THETA), kappa + 0.01)


@pytest.mark.filterwarnings("ignore:Output 'position' drifts along a line")
@pytest.mark.parametrize(
    "options", [{}, {"refine": "simulation"}, {"method": "pi-moesp"}], ids=str
)
def test_local_models_come_back_to_the_bit(options, tables):
    X, y = tables
    comes_back(SubspaceLTI(2, horizon=8, **RECORD, **options).fit(X, y), X)


@pytest.mark.parametrize("dates", [False, True], ids=["seconds", "dates"])
def test_a_stream_goes_on_where_skops_left_it(dates, tables):
    X, y = tables
    if dates:
        X = X.assign(time=pd.Timestamp("2026-01-01") + pd.to_timedelta(X["time"], "s"))
    begun = SubspaceLTI(2, horizon=8, **RECORD).partial_fit(X[:300], y[:300])
    back = through_skops(begun)
    comes_back(begun, X)
    for model in (begun, back):
        model.partial_fit(X[300:], y[300:])
    np.testing.assert_array_equal(back.predict(X), begun.predict(X))


def test_restructured_models_come_back_to_the_bit():
    fitted = GrayBoxRestructurer(spring_structure()).fit_model(spring_lpv().at(0.5))
    comes_back(fitted, OMEGA)


def pendulum(theta):
    return [[0.0, 1.0], [-theta[0], -theta[1]]], [[0.0], [theta[2]]], [[1.0, 0.0]]


def test_structures_of_functions_come_back_to_the_bit():
    structure = GrayBoxStructure.from_function(pendulum, initial=[30.0, 1.2, 40.0])
    fitted = GrayBoxRestructurer(structure, norm="h2").fit_model(spring_lpv().at(0.5))
    comes_back(fitted, OMEGA)


def test_chains_come_back_to_the_bit(chain, tables):
    comes_back(chain, tables[0])
    assert through_skops(chain).summary() == chain.summary()


def test_chains_without_structure_come_back_to_the_bit(tables):
    local = SubspaceLTI(2, horizon=8)
    comes_back(LocalLPVPipeline(local, "passthrough", **ROLES).fit(*tables), tables[0])


def test_models_fitted_to_the_output_come_back_to_the_bit(chain, tables):
    comes_back(OutputErrorLPV(chain.lpv_, **ROLES).fit(*tables), tables[0])
