"""Stability between operating points: told with the range, shown in the report."""

import numpy as np
import pytest

from lpvlearn import LPVStateSpace, PolynomialLPV, SplineLPV
from lpvlearn.pipeline.checks.stability import growth_rates

from ..conftest import spring_pipeline, spring_structure, spring_tables

KAPPA = np.array([[0.0], [1.0], [2.0], [3.0]])


def damped(c, interpolator, kappa=KAPPA):
    """Springs of stiffness 9 whose damping is interpolated."""
    structure = spring_structure().fix({"k": 9.0, "b": 1.0})
    form = interpolator.fit(kappa, np.asarray(c)[:, None])
    ends = [kappa.min(axis=0), kappa.max(axis=0)]
    return LPVStateSpace(structure, form, ends)


def test_a_cubic_between_stable_points_may_be_unstable():
    lpv = damped([20.0, 0.2, 0.2, 20.0], PolynomialLPV(3))
    with pytest.warns(UserWarning, match=r"unstable.*1 from 1.0\d to 1.9\d.*at 1\.5"):
        rates = growth_rates(lpv, KAPPA, 1e3)
    assert rates[0] < 0 < rates[1] == pytest.approx(rates[2], rel=1e-9)
    poles = lpv.frozen_poles([1.5])
    assert rates[1] == pytest.approx(poles.real.max())


def test_a_spline_does_not_overshoot():
    lpv = damped([20.0, 0.2, 0.2, 20.0], SplineLPV())
    rates = growth_rates(lpv, KAPPA, 1e3)  # a warning would be an error
    np.testing.assert_allclose(rates[1:3], lpv.frozen_poles([1.0, 2.0]).real.max(1))


class Hollow:
    """Damping that is negative about (0.5, 0.5), and one elsewhere."""

    def predict(self, kappa):
        far = ((kappa - 0.5) ** 2).sum(axis=1, keepdims=True)
        return 1.0 - 1.5 * np.exp(-50.0 * far)


def test_between_points_of_two_variables():
    kappa = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0], [1.0, 1.0]])
    structure = spring_structure().fix({"k": 9.0, "b": 1.0})
    lpv = LPVStateSpace(
        structure, Hollow(), [kappa[0], kappa[3]], scheduling_names=["mass", "speed"]
    )
    with pytest.warns(UserWarning, match=r"'mass' from 0.4.* 'speed' from 0.4"):
        rates = growth_rates(lpv, kappa, 1e3)
    np.testing.assert_array_equal(rates > 0, [True, False, False, False, True])


def test_integrators_are_no_growth():
    structure = spring_structure().fix({"k": 0.0, "b": 1.0})
    form = PolynomialLPV(1).fit(KAPPA, [[1.0], [2.0], [3.0], [4.0]])
    lpv = LPVStateSpace(structure, form, [KAPPA[0], KAPPA[-1]])
    np.testing.assert_array_equal(growth_rates(lpv, KAPPA, 1e3), 0.0)


@pytest.mark.slow
def test_the_report_shows_the_growth_rate():
    X, y = spring_tables(n_samples=100, kappas=(0.0, 1.0, 2.0))
    pipeline = spring_pipeline().fit(X, y)
    found = pipeline.lpv_.frozen_poles(np.linspace(0, 2, 41)).real.max()
    assert pipeline.report_["growth_rate"].max() == pytest.approx(found, rel=1e-6)
