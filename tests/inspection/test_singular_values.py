"""Singular values and the order chosen."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    SubspaceLTI,
)
from lpvlearn.inspection import (
    SingularValueDisplay,
)


def test_singular_values_up_to_the_order_stand_out(tables):
    X, y = (table.iloc[:300] for table in tables)
    fitted = SubspaceLTI(order=2, horizon=8, inputs="u").fit(X, y)
    display = SingularValueDisplay.from_estimator(fitted)
    assert_allclose(
        display.lines_["kept"].get_ydata(), fitted.singular_values_[:2], rtol=1e-12
    )
    assert_array_equal(display.lines_["left"].get_xdata(), np.arange(3, 9))
    assert display.ax_.get_yscale() == "log"
    assert [text.get_text() for text in display.ax_.texts] == ["order 2"]


def test_many_singular_values_are_cut_but_never_within_twice_the_order():
    values = np.geomspace(1, 1e-6, 100)
    few = SingularValueDisplay.from_values(values, order=3)
    assert few.lines_["left"].get_xdata()[-1] == 30
    many = SingularValueDisplay.from_values(values, order=40)
    assert many.lines_["left"].get_xdata()[-1] == 80


def test_zero_singular_values_stay_on_the_logarithmic_axis():
    display = SingularValueDisplay.from_values([1.0, 0.0])
    assert (display.lines_["left"].get_ydata() > 0).all()


@pytest.mark.parametrize(
    ("values", "order", "message"),
    [
        ([[1.0]], None, r"`singular_values` must be a vector .* shape \(1, 1\)"),
        ([-1.0], None, "non-negative"),
        ([0.0], None, "must begin with the largest"),
        ([1.0], 2, "`order` must be a whole number from 0 to 1. Got 2"),
    ],
)
def test_singular_value_errors_teach(values, order, message):
    with pytest.raises(ValueError, match=message):
        SingularValueDisplay.from_values(values, order)


def test_singular_values_ask_for_a_fitted_estimator():
    with pytest.raises(ValueError, match=r"fitted SubspaceLTI: call its fit\(\)"):
        SingularValueDisplay.from_estimator(SubspaceLTI())
