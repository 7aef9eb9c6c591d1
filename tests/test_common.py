"""scikit-learn's common checks on the pipeline (the other rooms check their own)."""

import numpy as np
import pytest
from sklearn.base import clone, is_regressor
from sklearn.utils.estimator_checks import parametrize_with_checks

import lpvlearn
from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    OutputErrorLPV,
    PolynomialLPV,
    SubspaceLTI,
)

ESTIMATORS = [
    SubspaceLTI,
    GrayBoxRestructurer,
    PolynomialLPV,
    LocalLPVPipeline,
    OutputErrorLPV,
]


# The checks fit tables of independent samples, which no dynamic model explains.
TOLD = (
    "The model explains next to nothing",
    "A mode of the model does not",
    "The model simulates parts of the record",
    "the structure comes no nearer",
    "`lpv_` is unstable at values within its range",
    "with a constant of every experiment",
    "the errors of output .* follow from the inputs",
)


def common_checks(*estimators):
    """scikit-learn's checks of estimators; what is TOLD is no error."""

    def decorated(test):
        for message in TOLD:
            test = pytest.mark.filterwarnings(f"ignore:{message}")(test)
        return parametrize_with_checks(estimators)(test)

    return decorated


@common_checks(LocalLPVPipeline(), OutputErrorLPV(sampling_time=1.0, max_iter=3))
def test_common_checks(estimator, check):
    check(estimator)


@pytest.mark.slow
@common_checks(
    LocalLPVPipeline(restructurer="passthrough"),
    LocalLPVPipeline(combine="average", on_error="skip"),
)
def test_common_checks_with_options(estimator, check):
    check(estimator)


@pytest.mark.parametrize("estimator_class", ESTIMATORS)
def test_estimators_are_regressors_that_can_be_cloned(estimator_class):
    estimator = estimator_class()
    assert is_regressor(estimator)
    assert clone(estimator).get_params() == estimator.get_params()
    assert not [name for name in vars(estimator) if name.endswith("_")]


def test_public_names_are_importable_and_sorted():
    assert sorted(lpvlearn.__all__) == lpvlearn.__all__
    for name in lpvlearn.__all__:
        assert getattr(lpvlearn, name).__doc__, name


def test_frequencies_may_come_as_a_column():
    model = GrayBoxRestructurer(
        lpvlearn.GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    )
    omega = np.array([0.1, 1.0, 10.0])
    G = 2.0 / (1j * omega + 3.0)
    table = np.column_stack([G.real, G.imag])
    model.fit(omega[:, None], table)
    np.testing.assert_allclose(model.predict(omega), table, atol=1e-9)
