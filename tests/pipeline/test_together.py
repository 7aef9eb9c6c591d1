"""A polynomial through the black boxes of all points."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lpvlearn import AutoLPV, GrayBoxStructure, SplineLPV
from lpvlearn.models.statespace import DEVIATION
from lpvlearn.pipeline.one_basis.structured_models import StructuredModels
from lpvlearn.pipeline.one_basis.together import (
    _along_the_points,
    _may_have,
    _misfit,
    fitted_together,
    through_black_boxes,
)
from lpvlearn.pipeline.points.local_models import LocalModel
from lpvlearn.restructuring.minimise_covariance import UncertainBoxes

LAGS = GrayBoxStructure.from_template(
    [["-a", 0], [0, "-c"]], [["b"], ["d"]], [[1, 1]], parameter_names=list("abcd")
)
KAPPA = np.linspace(-1.0, 1.0, 5)[:, None]
TRUTH = np.array([1.0, 2.0, 4.0, -1.0]) + KAPPA * [0.2, -0.3, 0.5, 0.1]
STD = 1e-3


def estimate(theta, discrete=False):
    """A black box that knows its poles and gains to 0.1 %, in another state basis."""

    def model(values):
        found = LAGS.model(values).transform([[2.0, 1.0], [0.0, 3.0]])
        return found.to_discrete(0.1) if discrete else found

    step = DEVIATION * STD * np.eye(4) * theta
    return model(theta), [(model(theta + d), model(theta - d)) for d in step]


def boxes(estimates):
    return [UncertainBoxes.of(LAGS, own) for own in estimates]


@pytest.mark.slow
@pytest.mark.parametrize("discrete", [False, True])
def test_the_polynomial_of_exact_black_boxes_is_found_from_afar(discrete):
    estimates = [[estimate(theta, discrete)] for theta in TRUTH]
    start = TRUTH[:, [2, 3, 0, 1]] * [1.5, 1.5, 0.7, 0.7]
    found = fitted_together(LAGS, boxes(estimates), KAPPA, start)
    assert found.misfit < 1e-6 and found.form.degree == 1
    values = found.form.predict(KAPPA)
    if values[0, 0] > values[0, 2]:  # lags in parallel have no order
        values = values[:, [2, 3, 0, 1]]
    assert_allclose(values, TRUTH, rtol=1e-5)


def test_the_covariance_is_that_of_generalised_least_squares():
    estimates = [[estimate(theta)] for theta in TRUTH]
    found = fitted_together(LAGS, boxes(estimates), KAPPA, TRUTH)
    weights = [np.diag((STD * theta) ** -2.0) for theta in TRUTH]
    S = found.form.sensitivities(KAPPA)
    information = sum(s.T @ P @ s for s, P in zip(S, weights, strict=True))
    assert_allclose(found.covariance @ information, np.eye(8), atol=1e-4)


def structured(theta, covariance):
    local = [
        LocalModel(LAGS.model(row), 2, None, estimates=[estimate(row)]) for row in TRUTH
    ]
    models = [LAGS.model(row) for row in theta]
    points = type("Points", (), {"kappa": KAPPA})
    return StructuredModels(points, local, LAGS, theta, covariance, models, [None] * 5)


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [np.diag([np.inf] * 4), np.full((4, 4), 1e8)])
def test_it_is_taken_where_a_point_does_not_determine_its_parameters(unknown):
    theta, P = TRUTH.copy(), np.array([np.diag((STD * row) ** 2) for row in TRUTH])
    sure = AutoLPV().fit(KAPPA, theta, covariance=P)
    assert through_black_boxes(sure, structured(theta, P)) is None
    theta[3] = 1.9, 80.0, 2.0, -79.0
    P[3] = unknown
    lost = AutoLPV().fit(KAPPA, theta, covariance=P)
    with pytest.warns(UserWarning, match="on no smooth function.*The LPV model takes"):
        form, covariance, found = through_black_boxes(lost, structured(theta, P))
    assert form.form_ == "polynomial 1 through the models"
    assert form.selection_["chosen"].tolist()[-1] and covariance.shape == (8, 8)
    assert_allclose(form.predict(KAPPA), TRUTH, rtol=1e-4)
    for model, row in zip(found.models, TRUTH, strict=True):
        assert (model - LAGS.model(row)).hinf_norm() < 1e-4


@pytest.mark.slow
def test_nothing_is_taken_that_the_black_boxes_refute_or_do_not_know():
    rng = np.random.default_rng(0)
    wild = TRUTH * np.exp(rng.normal(size=TRUTH.shape))
    refuted = boxes([[estimate(t)] for t in wild])
    assert fitted_together(LAGS, refuted, KAPPA, wild) is None
    blind = [[(LAGS.model(theta), [])] for theta in TRUTH]
    assert fitted_together(LAGS, boxes(blind), KAPPA, TRUTH) is None
    assert fitted_together(LAGS, [None] * 5, KAPPA, TRUTH) is None


@pytest.mark.slow
def test_a_form_that_the_black_boxes_refute_is_not_kept():
    """It is as near to the parameters as a covariance asks that tells too little."""
    P = np.tile(0.2 * np.eye(4), (5, 1, 1))
    rough = AutoLPV().fit(KAPPA, TRUTH, covariance=P)
    assert rough.form_ == "polynomial 0"
    with pytest.warns(UserWarning, match="on no smooth function.*The LPV model takes"):
        form, _, _ = through_black_boxes(rough, structured(TRUTH, P))
    assert_allclose(form.predict(KAPPA), TRUTH, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("deviations", [0.0, 10.0])
def test_parameters_near_a_form_that_foresees_no_more_are_on_a_smooth_function(
    deviations,
):
    """A curve through the points is chosen then: that alone is no fault of theirs."""
    theta, P = TRUTH.copy(), np.array([np.diag((STD * row) ** 2) for row in TRUTH])
    theta[3] *= 1.0 + deviations * STD
    through = AutoLPV().fit(KAPPA, theta, covariance=P)
    curve = through.replaced("pchip", SplineLPV().fit(KAPPA, theta))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        form, _, _ = through_black_boxes(curve, structured(theta, P))
    assert_allclose(form.predict(KAPPA), TRUTH, rtol=1e-4)
    told = ["on no smooth function" in str(w.message) for w in caught]
    assert told == [True] * (deviations > 0.0)


def test_what_is_far_from_the_black_boxes_is_infinitely_far():
    own = boxes([[estimate(theta)] for theta in TRUTH])
    assert _misfit(own, TRUTH) < 1e-9
    assert _misfit(own, TRUTH * [1.0, 1e200, 1.0, 1.0]) == np.inf  # silently


@pytest.mark.parametrize("outward", [True, False])
def test_parameters_follow_the_black_boxes_from_one_point_to_its_neighbours(outward):
    """Parts that changed places, or went astray, at other points are those of one."""
    rng = np.random.default_rng(1)
    first = 2 if outward else 0
    theta = TRUTH * np.exp(0.3 * rng.normal(size=TRUTH.shape))
    theta[first] = TRUTH[first]
    theta[1] = TRUTH[1, [2, 3, 0, 1]]
    known = boxes([[estimate(row)] for row in TRUTH])
    assert_allclose(_along_the_points(known, KAPPA, theta, outward), TRUTH, rtol=1e-6)


def test_a_high_degree_needs_twice_as_many_points_as_it_has_terms():
    """One black box that is off is no reason to bend through all of them."""
    kappa = np.linspace(-1.0, 1.0, 6)[:, None]
    truth = np.array([1.0, 2.0, 4.0, -1.0]) + kappa * [0.2, -0.3, 0.5, 0.1]
    off = truth.copy()
    off[3] *= 1.0 + 3.0 * STD
    found = fitted_together(LAGS, boxes([[estimate(t)] for t in off]), kappa, off)
    assert found.form.degree <= 2 and 1.0 < found.misfit
    assert_allclose(found.form.predict(kappa), truth, rtol=3 * STD)


def test_degrees_are_those_that_few_points_tell():
    """Four points have no polynomial of the fourth degree, and need none."""
    known = boxes([[estimate(row)] for row in TRUTH[:4]])
    found = fitted_together(LAGS, known, KAPPA[:4], TRUTH[:4])
    assert found.form.degree == 1
    grid = np.array([[x, y] for x in (0.0, 1.0) for y in range(5)])
    assert [_may_have(d, grid) for d in (1, 2, 3, 4)] == [True, True, False, False]
