"""Linear-fractional models: the frozen models, and how often a variable repeats."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV, RationalLPV

from ..conftest import spring_lpv
from .conftest import assert_same_matrices, lpv_model
from .test_coefficients import FORMS


@pytest.mark.slow
@pytest.mark.parametrize("n_scheduling", [1, 2, 3])
@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("normalized", [False, True])
def test_an_lfr_has_the_frozen_models(form, n_scheduling, normalized):
    lpv, places = lpv_model(form, n_scheduling)
    found = lpv.lfr(normalized=normalized)
    size = sum(found.repetitions)
    assert found.M.shape == (size + 3 + 2, size + 3 + 2)
    assert found.delta(places[0]).shape == (size, size)
    for place, model in zip(places, lpv.grid(places), strict=True):
        assert_same_matrices(found.at(place), model, 1e-9)


def test_a_normalized_delta_is_at_most_one():
    lpv, places = lpv_model(PolynomialLPV(2), 2)
    found = lpv.lfr(normalized=True)
    assert max(np.abs(found.delta(k)).max() for k in lpv.scheduling_range) == 1
    assert np.linalg.norm(found.delta(places[0]), 2) <= 1


def one_entry(function, n_scheduling=1, degree=2, form=PolynomialLPV):
    """An LPV model of order one whose pole is a function of kappa."""
    axis = np.linspace(1.0, 2.0, 4)
    kappa = np.stack(np.meshgrid(*[axis] * n_scheduling), -1).reshape(-1, n_scheduling)
    structure = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    fitted = form(degree).fit(kappa, function(*kappa.T))
    return LPVStateSpace(structure, fitted, [kappa.min(0), kappa.max(0)])


@pytest.mark.parametrize(
    ("lpv", "expected"),
    [
        (one_entry(lambda k: 0 * k + 3.0, degree=0), (0,)),
        (one_entry(lambda k: 1 + k), (1,)),
        (one_entry(lambda k: k**2), (2,)),
        (one_entry(lambda k: 1 / k, 1, 1, lambda d: RationalLPV(d, 1)), (1,)),
        (one_entry(lambda a, b: a + b, 2), (1, 1)),
        (one_entry(lambda a, b: a * b, 2), (1, 1)),
        (one_entry(lambda a, b: (a + b) ** 2, 2), (2, 2)),
        (spring_lpv(), (2,)),
    ],
)
def test_repetitions_are_the_fewest(lpv, expected):
    assert lpv.lfr(normalized=True).repetitions == expected


def test_rows_of_one_rank_repeat_as_one():
    """A dozen entries that follow one parameter need it once."""
    structure = GrayBoxStructure.from_template(
        [["-k", "k"], ["-2*k", "2*k"]], [["1000*k"], ["2000*k"]], [[1, 0]]
    )
    kappa = np.array([[0.0], [1.0]])
    form = PolynomialLPV(1).fit(kappa, [[1e-6], [3e-6]])
    found = LPVStateSpace(structure, form, kappa).lfr()
    assert found.repetitions == (1,)
    assert_array_equal(found.centre, [0.0])


def test_a_pole_at_zero_is_told_of():
    lpv = one_entry(lambda k: 1 / k, 1, 1, lambda d: RationalLPV(d, 1))
    with pytest.raises(ValueError, match=r"lfr\(normalized=True\)"):
        lpv.lfr()


def test_there_is_no_model_where_the_form_is_singular():
    M = np.array([[1.0, 1.0, 0.0], [1.0, -2.0, 1.0], [0.0, 1.0, 0.0]])  # 1 / (1 - k)
    form = replace(spring_lpv().lfr(), M=M, repetitions=(1,), order=1)
    kappa = form.centre + form.half_width
    with pytest.raises(ValueError, match="must be where the model is well posed"):
        form.at(kappa)
    assert_allclose(form.at(kappa - 0.5 * form.half_width).A, [[-2.0 + 0.5 / 0.5]])
