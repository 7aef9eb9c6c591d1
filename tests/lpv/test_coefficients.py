"""Coefficients of the matrices: the frozen models from them, and their table."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.neighbors import KNeighborsRegressor

from lpvlearn import (
    AutoLPV,
    GrayBoxStructure,
    LPVStateSpace,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
)

from ..conftest import spring_lpv
from .conftest import assert_same_matrices, lpv_model

FORMS = [
    PolynomialLPV(0),
    PolynomialLPV(3),
    PolynomialLPV(2, basis="legendre"),
    RationalLPV(2, 2),
    RationalLPV(1, 2, terms="tensor"),
]


@pytest.mark.parametrize("n_scheduling", [1, 2, 3])
@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("normalized", [False, True])
def test_coefficients_give_the_frozen_models(form, n_scheduling, normalized):
    lpv, places = lpv_model(form, n_scheduling)
    lpv = replace(lpv, input_delay=[0.2, 0.0])
    lpv = lpv.change_basis(np.array([[1.0, 2, 0], [0, 1e-3, 1], [0, 0, 5]]))
    found = lpv.coefficients(normalized=normalized)
    for place, model in zip(places, lpv.grid(places), strict=True):
        assert_same_matrices(found.at(place), model, 1e-11)
        assert_array_equal(found.at(place).input_delay, model.input_delay)


def test_coefficients_of_the_spring_are_those_that_made_it():
    found = spring_lpv().coefficients()
    assert_array_equal(found.powers, [[0], [1], [2]])
    assert_allclose(found.A[0], [[0, 1], [-40, -1.2]], atol=1e-12)
    assert_allclose(found.A[1], [[0, 0], [-10, 0]], atol=1e-12)
    assert_allclose(found.A[2], [[0, 0], [-20, 0]], atol=1e-12)
    assert_allclose(found.B[:, 1, 0], [30, 0, 0], atol=1e-12)
    assert_array_equal(found.denominator, [1, 0, 0])
    table = found.table()
    assert list(table.columns) == ["1", "kappa", "kappa^2"]
    assert_allclose(table.loc[("A", 1, 0)], [-40, -10, -20], atol=1e-12)
    assert set(table.index.get_level_values("matrix")) == {"A", "B", "C"}


def test_a_table_says_the_constants_of_a_fraction_once():
    kappa = np.linspace(1.0, 3.0, 7)[:, None]
    structure = GrayBoxStructure.from_template(
        [[0, 2], ["-a", "b"]], [[0], [1]], [[1, 0]]
    )
    theta = np.hstack([1.0 / (1.0 + kappa), kappa / (1.0 + kappa)])
    form = RationalLPV(1, 1).fit(kappa, theta)
    lpv = LPVStateSpace(structure, form, kappa[[0, -1]], scheduling_names=["mass"])
    table = lpv.coefficients().table()
    assert list(table.columns) == ["constant", "1", "mass"]
    assert_array_equal(table.loc[("A", 0, 1)], [2, 0, 0])
    d = table.loc[("denominator", 0, 0)].to_numpy()[1:]
    assert_allclose(d / d[0], [1, 1], rtol=1e-9)
    assert_allclose(table.loc[("A", 1, 1)].to_numpy()[1:] / d[0], [0, 1], atol=1e-9)


def test_terms_of_several_variables_bear_their_names():
    lpv, _ = lpv_model(PolynomialLPV(2), 2)
    lpv = replace(lpv, scheduling_names=["mass", "speed"])
    expected = ["1", "mass", "speed", "mass^2", "mass*speed", "speed^2"]
    assert list(lpv.coefficients().table().columns) == expected


def test_a_form_that_was_chosen_has_its_coefficients():
    kappa = np.linspace(0, 1, 6)[:, None]
    P = np.full((6, 1, 1), 1e-12)
    form = AutoLPV().fit(kappa, 1 + kappa**2, covariance=P)
    structure = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    lpv = LPVStateSpace(structure, form, [[0.0], [1.0]])
    assert_allclose(lpv.coefficients().A[:, 0, 0], [-1, 0, -1], atol=1e-5)


def test_variables_far_from_zero_are_told_of():
    kappa = 1e6 + np.linspace(0, 1, 4)[:, None]
    structure = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    form = PolynomialLPV(2).fit(kappa, (kappa - 1e6) ** 2)
    lpv = LPVStateSpace(structure, form, kappa[[0, -1]])
    with pytest.warns(UserWarning, match="far from zero in units of their range"):
        lpv.coefficients()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = lpv.coefficients(normalized=True)
    assert_same_matrices(found.at(kappa[1]), lpv.at(kappa[1]), 1e-12)


def test_what_has_no_coefficients_is_refused():
    def pendulum(theta):
        return [[0, 1], [-9.81 / theta[0], -1]], [[0], [1]], [[1, 0]]

    smooth = GrayBoxStructure.from_function(pendulum, [1.0])
    affine = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    kappa, theta = np.array([[0.0], [1.0]]), np.array([[1.0], [2.0]])
    line = PolynomialLPV(1).fit(kappa, theta)
    with pytest.raises(ValueError, match="affine in the parameters"):
        LPVStateSpace(smooth, line, kappa).coefficients()
    for other in (
        SplineLPV().fit(kappa, theta),
        KNeighborsRegressor(1).fit(kappa, theta),
    ):
        with pytest.raises(ValueError, match="an interpolation that has a form"):
            LPVStateSpace(affine, other, kappa).coefficients()
    moving = LPVStateSpace(affine, line, kappa).change_basis(lambda k: [[1 + k[0]]])
    with pytest.raises(ValueError, match="the same everywhere"):
        moving.lfr()
