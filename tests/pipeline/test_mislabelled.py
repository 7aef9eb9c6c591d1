"""Points with a channel in another unit, of another sign, or in another place."""

import numpy as np
import pytest

from lpvlearn import StateSpace
from lpvlearn.exceptions import collected
from lpvlearn.pipeline.points.local_models import LocalModel
from lpvlearn.pipeline.points.mislabelled import (
    tell_of_mislabelled,
    tell_of_wrong_values,
)

KAPPA = np.arange(4.0)[:, None]
ONES = np.ones(4)


def oscillators(by_input=ONES, by_output=ONES):
    """Position and speed by two inputs, with gains of the second ones at the points."""
    models = []
    for (kappa,), b, c in zip(KAPPA, by_input, by_output, strict=True):
        A = [[0.0, 1.0], [-(4.0 + kappa**2), -0.8]]
        B = np.array([[0.0, 0.0], [1.0, 0.3 + 0.2 * kappa]]) * [1.0, b]
        models.append(StateSpace(A, B, [[1.0, 0.0], [0.0, c]], np.zeros((2, 2))))
    return models


def said(models, kappa=KAPPA):
    local = [LocalModel(model, model.order, None) for model in models]
    with collected() as told:
        found = tell_of_mislabelled(local, kappa, 50.0, ["u", "v"], ["y", "z"])
    assert found == bool(told)
    return told[0].message if told else ""


@pytest.mark.parametrize("factor", [1000.0, 1e-3, 60.0, -1000.0])
@pytest.mark.parametrize("point", [1, 2])
def test_a_unit_is_told(factor, point):
    gains = ONES.copy()
    gains[point] = factor
    place = f"at operating point {point} (scheduling {point}) acts "
    size = max(abs(factor), 1.0 / abs(factor))
    for words, name in (
        (said(oscillators(by_output=gains)), "output 'z'"),
        (said(oscillators(by_input=gains)), "input 'v'"),
    ):
        assert words.startswith(f"{name} {place}") and "check its unit" in words
        assert ("in reverse" in words) == (factor < 0.0)
        times = float(words.split("about ")[1].split(" ")[0].removeprefix("1/"))
        assert 0.7 * size < times < 1.5 * size


@pytest.mark.parametrize("point", [1, 2])
def test_a_sign_is_told(point):
    gains = ONES.copy()
    gains[point] = -1.0
    words = said(oscillators(by_input=gains))
    assert words.startswith(
        f"input 'v' at operating point {point} (scheduling {point})"
    )
    assert "has the reverse sign" in words


@pytest.mark.parametrize("point", [1, 2])
def test_outputs_that_are_exchanged_are_told(point):
    models = oscillators()
    one = models[point]
    models[point] = StateSpace(one.A, one.B, one.C[::-1], one.D)
    words = said(models)
    assert words.startswith(f"output 'y' and output 'z' at operating point {point} ")
    assert "look exchanged" in words


@pytest.mark.parametrize(
    "law",
    [
        [1.0, 1.0, 1.0, 1.0],
        [-1.0, 1.0, 1.0, 1.0],  # it may have gone through zero
        [-1.5, -0.5, 0.5, 1.5],
        [-2.0, -1.0, 1e-3, 1.0],
        [1.0, -1.0, 1.0, 7.0],
        [1.0, 10.0, 100.0, 1000.0],
        [1000.0, 30.0, 6.0, 2.0],
        [0.0, 1.0, 2.0, 3.0],
        [1.0, 0.0, 1.0, 1.0],  # a dead input
    ],
)
def test_laws_of_the_scheduling_are_none_of_these(law):
    assert said(oscillators(by_input=law)) == ""
    assert said(oscillators(by_output=law)) == ""


def test_laws_that_overflow_far_from_the_points_are_laws():
    kappa = np.array([[0.0], [1e-3], [2e-3], [3.0]])
    assert said(oscillators(by_output=[1.0, 10.0, 100.0, 1.0]), kappa) == ""


PLACES = np.linspace(0.0, 1.0, 6)[:, None]


def parameters(law, noise=1e-3):
    """Those of a law and their covariance, and a constant beside it."""
    rng = np.random.default_rng(0)
    theta = np.column_stack([law(PLACES[:, 0]), np.ones(6)])
    theta += noise * rng.standard_normal(theta.shape)
    return theta, np.broadcast_to(noise**2 * np.eye(2), (6, 2, 2))


@pytest.mark.parametrize("pair", [(1, 2), (0, 5), (2, 5)])
@pytest.mark.parametrize("law", [lambda k: 1.0 + k, lambda k: 3.0 - k - k**2])
def test_points_that_have_the_values_of_one_another_are_named(law, pair):
    theta, covariance = parameters(law)
    kappa = PLACES.copy()
    kappa[list(pair)] = kappa[list(pair[::-1])]
    words = f"point {pair[0]} .* and operating point {pair[1]} .* look exchanged"
    with pytest.warns(UserWarning, match=words):
        tell_of_wrong_values(kappa, theta, covariance, ["speed"])


@pytest.mark.parametrize("point", [0, 3, 5])
@pytest.mark.parametrize(
    "told, wrong",
    [
        ("Fahrenheit in place of Celsius: {:.4g} for", lambda x: 1.8 * x + 32.0),
        ("radians in place of degrees", np.deg2rad),
        ("thousandths in place of ones", lambda x: 1e3 * x),
    ],
)
def test_a_point_with_another_unit_is_named(told, wrong, point):
    theta, covariance = parameters(lambda k: 1.0 + 3.0 * k + k**2)
    kappa = 20.0 + 10.0 * PLACES
    told = told.format(kappa[point, 0])
    kappa[point] = wrong(kappa[point])
    words = rf"operating point {point} .* looks to have 'speed' in another .*{told}"
    with pytest.warns(UserWarning, match=words):
        tell_of_wrong_values(kappa, theta, covariance, ["speed"])


@pytest.mark.parametrize(
    "law",
    [
        lambda k: 1.0 + k,
        lambda k: np.abs(k - 0.5),
        lambda k: np.where(k > 0.5, 2.0, 1.0),
        lambda k: np.sin(9.0 * k),
        lambda k: 1.0 / (0.1 + k),
    ],
)
def test_laws_that_bend_are_no_exchange(law):
    theta, covariance = parameters(law)
    tell_of_wrong_values(PLACES, theta, covariance, ["speed"])
    unknown = np.full_like(covariance, np.nan)
    tell_of_wrong_values(PLACES[::-1], theta, unknown, ["speed"])


@pytest.mark.parametrize("point", [1, 4])
def test_a_point_that_follows_no_law_of_the_others_is_named(point):
    """As where a sensor had another gain there, which bends several parameters."""
    theta, covariance = parameters(lambda k: 1.0 + k)
    theta[point] *= [2.0, 0.5]
    with pytest.warns(UserWarning, match=f"point {point} .* is unlike the others"):
        assert tell_of_wrong_values(PLACES, theta, covariance, ["speed"])
    for end in (0, 5):  # where a law may end
        theta, covariance = parameters(lambda k: 1.0 + k)
        theta[end] *= [2.0, 0.5]
        assert not tell_of_wrong_values(PLACES, theta, covariance, ["speed"])
