"""The bilinear equations of a similarity transformation, Eq. (7), minimised."""

import numpy as np
from numpy.testing import assert_allclose

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace

STRUCTURE = GrayBoxStructure.from_template(
    A=[["-a", "b"], ["b", "-b - c"]], B=[[1], [0]], C=[[0, 1]], D=[["d"]]
)
THETA = STRUCTURE.check_params({"a": 2.0, "b": 0.7, "c": 1.5, "d": 0.4})
BASIS = np.array([[1.0, 0.3], [-0.2, 0.8]])


def minimiser(model, theta=THETA, **options):
    fitted = GrayBoxRestructurer(STRUCTURE, norm="similarity", init=theta, n_starts=1)
    return fitted.fit_model(model, **options)


def test_feedthrough_is_that_of_the_black_box():
    box = STRUCTURE.model(THETA).transform(BASIS)
    fitted = minimiser(box, 1.1 * THETA)
    assert_allclose(fitted.params_, THETA, rtol=1e-7)


def test_covariance_is_that_of_the_minimiser():
    """Two realizations around an exact black box: half their difference, squared."""
    box, rng = STRUCTURE.model(THETA).transform(BASIS), np.random.default_rng(0)
    change = [1e-5 * rng.normal(size=M.shape) for M in (box.A, box.B, box.C, box.D)]
    both = [
        StateSpace(
            *(getattr(box, M) + s * d for M, d in zip("ABCD", change, strict=True))
        )
        for s in (1, -1)
    ]
    spread = np.subtract(*(minimiser(model).params_ for model in both)) / 2
    # of the mean of two: half the variance of one, the square of the difference / 2
    turned = [both[0], both[1].transform(np.array([[2.0, 1.0], [0.0, -1.0]]))]
    for realizations in (both, turned):
        covariance = minimiser(box, realizations=realizations).params_covariance_
        assert_allclose(covariance, np.outer(spread, spread), rtol=1e-3)
