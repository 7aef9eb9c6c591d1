"""Other parameters of the same response."""

import warnings

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure

# Two stores of heat: the poles and the gain do not tell which capacity is which.
STORES = GrayBoxStructure.from_template(
    E=[["C1", 0], [0, "C2"]],
    A=[["-0.8", 0.8], [0.8, "-0.8 - h"]],
    B=[[1], [0]],
    C=[[0, 1]],
)
TRUTH = {"C1": 2.0, "C2": 5.0, "h": 0.3}
# C1 C2 = 10 and 1.1 C1 + 0.8 C2 = 6.2 in both
TWIN = {"C1": 40.0 / 11.0, "C2": 2.75, "h": 0.3}
OMEGA = np.geomspace(0.01, 3.0, 60)


def test_both_have_one_response():
    G, H = (STORES.model(p).frequency_response(OMEGA) for p in (TRUTH, TWIN))
    np.testing.assert_allclose(H, G, rtol=1e-12)


@pytest.mark.parametrize("noisy", [False, True])
def test_the_other_solution_is_told(noisy):
    G = STORES.model(TRUTH).frequency_response(OMEGA)
    sd, rng = 0.02 * np.abs(G), np.random.default_rng(0)
    error = sd * (rng.normal(size=(60, 1, 1, 2)) @ [1, 1j]) / np.sqrt(2)
    options, fitted = {}, GrayBoxRestructurer(STORES)
    if noisy:
        options, fitted = {"noise": sd}, fitted.set_params(norm="covariance")
    with pytest.warns(UserWarning, match="other values of 'C1', 'C2' give") as told:
        fitted.fit(OMEGA, G + noisy * error, **options)
    assert fitted.score(OMEGA, G) > 0.99  # of the complex response, as fit takes it
    found, message = fitted.params_, str(told[0].message)
    other = TWIN if abs(found[0] - 2.0) < 0.5 else TRUTH
    value = float(message.split("C1 = ")[1].split(",")[0])
    assert abs(value - other["C1"]) < (0.1 if noisy else 1e-3)


@pytest.mark.parametrize(
    "known",
    [
        STORES.with_bounds({"C1": (None, 2.8)}),
        STORES.with_ranges({"C1": (1.0, 3.0), "C2": (3.0, 8.0)}),
    ],
    ids=["bounds", "ranges"],
)
def test_not_where_it_is_known_which(known):
    G = STORES.model(TRUTH).frequency_response(OMEGA)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fitted = GrayBoxRestructurer(known).fit(OMEGA, G)
        GrayBoxRestructurer(STORES, init=[2.1, 4.8, 0.3]).fit(OMEGA, G)
    np.testing.assert_allclose(fitted.params_, [2.0, 5.0, 0.3], rtol=1e-6)
