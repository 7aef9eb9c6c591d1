"""Skops, where it is there: what it can hold comes back to the bit."""

import numpy as np
import pytest

from lpvlearn import AutoLPV, PolynomialLPV, RationalLPV, SplineLPV, SubspaceLTI

from .conftest import spring_pipeline, spring_tables

skops = pytest.importorskip("skops.io")

KAPPA = np.linspace(0.0, 1.0, 9)[:, None]
THETA = np.column_stack([1.0 + KAPPA, 1.0 / (2.0 + KAPPA)])

# Of 0.16; `save` and `load` of this library hold them all.
NO_TABLES = pytest.mark.xfail(
    raises=TypeError, strict=False, reason="skops holds no pandas table"
)
NO_CURVES = pytest.mark.xfail(
    raises=TypeError, strict=False, reason="skops holds no interpolator of scipy"
)


def came_back(fitted, X):
    """Predictions of an estimator, before and after it was in the text of skops."""
    data = skops.dumps(fitted)
    back = skops.loads(data, trusted=skops.get_untrusted_types(data=data))
    return np.asarray(fitted.predict(X)), np.asarray(back.predict(X))


@pytest.mark.parametrize(
    "form",
    [
        PolynomialLPV(2),
        RationalLPV(1),
        pytest.param(SplineLPV(), marks=NO_CURVES),
        pytest.param(AutoLPV(), marks=NO_TABLES),
    ],
    ids=lambda form: type(form).__name__,
)
def test_interpolators_come_back_to_the_bit(form):
    np.testing.assert_array_equal(*came_back(form.fit(KAPPA, THETA), KAPPA + 0.01))


@NO_TABLES
def test_local_models_come_back_to_the_bit():
    X, y = spring_tables(n_samples=200)
    roles = {"inputs": "force", "experiment": "run", "time": "time"}
    fitted = SubspaceLTI(2, horizon=8, **roles).fit(X, y)
    np.testing.assert_array_equal(*came_back(fitted, X))


@NO_TABLES
def test_chains_come_back_to_the_bit():
    X, y = spring_tables(n_samples=200)
    fitted = spring_pipeline(local=SubspaceLTI(2, horizon=8)).fit(X, y)
    np.testing.assert_array_equal(*came_back(fitted, X))
