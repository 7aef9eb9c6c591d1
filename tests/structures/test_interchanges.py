"""Which parts of a structure may change places."""

from math import factorial

import numpy as np
import pytest
from scipy.linalg import expm

from lpvlearn import GrayBoxStructure
from lpvlearn.structures.interchanges import (
    distance,
    exchangeable,
    interchanges,
    known_before,
    slow_first,
    told_by_motion,
)

LAGS = GrayBoxStructure.from_template(
    [["-a", 0, 0], ["b", "-b", 0], [0, "c", "-c"]], [["a"], [0], [0]], [[0, 0, 1]]
)
SERVO = GrayBoxStructure.from_template(  # an actuator, a mode and a sensor
    [["-a", 0, 0, 0], [0, 0, 1, 0], ["k", "-k", "-c", 0], [0, "s", 0, "-s"]],
    [["a"], [0], [0], [0]],
    [[0, 0, 0, 1]],
)
TWINS = (
    GrayBoxStructure.mechanical(  # two masses side by side, of which the sum is seen
        [["m1", 0], [0, "m2"]],
        [["d1", 0], [0, "d2"]],
        [["k1", 0], [0, "k2"]],
        [[1], [1]],
        sensors=[[1, 1]],
    )
)


def time_constants(theta):
    one, two, gain = theta
    return [[-1 / one, 0], [1 / two, -1 / two]], [[gain / one], [0]], [[0, 1]]


@pytest.mark.parametrize(
    ("structure", "count"),
    [
        (GrayBoxStructure.modal(2), 2),
        (GrayBoxStructure.modal(3, 2, 2, n_real=2), factorial(3) * 2),
        (GrayBoxStructure.modal(2, 2, 3, normalize="output", feedthrough=True), 2),
        (GrayBoxStructure.modal(0, n_real=5), factorial(5)),
        (LAGS, factorial(3)),
        (SERVO, 2),
        (TWINS, 2),
        (GrayBoxStructure.from_function(time_constants, [1e-3, 1e-2, 5.0]), 2),
        (GrayBoxStructure.observable_canonical(4, 2, 2), 1),
        (GrayBoxStructure.full(2, 1, 1), 4),  # states, and the transposed system
    ],
)
def test_all_are_found_and_none_changes_the_response(structure, count):
    places = interchanges(structure)
    assert len(places) == count
    np.testing.assert_array_equal(places[0], np.arange(structure.n_params))
    known = {tuple(pi) for pi in places.tolist()}
    assert len(known) == count
    assert all(tuple(pi[rho]) in known for pi in places for rho in places[:6])
    theta = np.exp(np.random.default_rng(1).normal(size=structure.n_params))
    omega = np.array([0.3, 1.0, 4.0])
    G = structure.model(theta).frequency_response(omega)
    for pi in places:
        other = structure.model(theta[pi]).frequency_response(omega)
        np.testing.assert_allclose(other, G, rtol=1e-8)


def test_a_structure_that_exists_nowhere_in_the_middle_has_none_to_tell():
    def pole(theta):
        if abs(theta[0] - theta[1]) < 0.1:
            raise ValueError("the lags must differ")
        return np.diag(-theta), [[1], [1]], [[1, 1]]

    structure = GrayBoxStructure.from_function(pole, [1.0, 2.0])
    assert interchanges(structure).tolist() == [[0, 1]]


def servo(actuator="actuator", sensor="sensor"):
    return GrayBoxStructure.from_template(
        A=[[f"-{actuator}", 0], [1, f"-{sensor}"]], B=[["gain"], [0]], C=[[0, 1]]
    )


def told(structure, theta, init=None):
    known = known_before(structure, init)
    return exchangeable(structure, structure.check_params(theta), known)


def test_parts_of_which_nothing_tells_the_one_from_the_other_are_named():
    theta = {"actuator": 6.0, "sensor": 2.0, "gain": 1.0}
    assert told(servo(), theta) == ["actuator", "sensor"]
    assert told(servo(), theta | {"sensor": 6.0}) == []  # one value for both
    # bounds, ranges and guesses tell, if they are not those of both
    actuator, both = {"actuator": (4.0, 9.0)}, dict.fromkeys(theta, (1.0, 9.0))
    assert told(servo().with_bounds(actuator), theta) == []
    assert told(servo().with_ranges(actuator), theta) == []
    assert told(servo(), theta, [1.0, 5.0, 2.0]) == []
    assert told(servo().with_bounds(both), theta) == ["actuator", "sensor"]
    assert told(servo().with_ranges(both), theta) == ["actuator", "sensor"]


def test_what_is_outside_of_a_range_is_far():
    """However near it is to the middle."""
    ranges = {"actuator": (0.4, 2.6), "sensor": (0.8, 2.6)}
    structure = servo().with_ranges(ranges)
    known = known_before(structure, None)
    images = np.array([[[2.5, 1.0, 0.5]], [[0.5, 1.0, 2.5]]])  # actuator, gain, sensor
    assert structure.parameter_names == ("actuator", "gain", "sensor")
    far = distance(structure, images, known)
    assert far[0] > 100.0 * far[1]
    theta = dict(zip(structure.parameter_names, images[1, 0], strict=True))
    assert told(structure, theta) == []


def test_parts_that_are_but_numbered_may_have_any_number():
    assert (
        told(servo("lag_1", "lag_2"), {"lag_1": 6.0, "lag_2": 2.0, "gain": 1.0}) == []
    )


def test_slow_parameters_beside_fast_poles_are_told_apart():
    """As a product alone of two is seen at the rate of the fast one."""
    fast = GrayBoxStructure.from_template(
        [[0, 1, 0], [0, "-a", "a"], [0, 0, -1e8]], [[0], [0], ["b"]], [[1, 0, 0]]
    )
    assert len(interchanges(fast)) == 1


def along(structure, low, high, n_points=5):
    return np.linspace(structure.check_params(low), structure.check_params(high), 5)


@pytest.mark.parametrize("structure", [GrayBoxStructure.modal(3), TWINS])
def test_the_order_of_parts_side_by_side_is_no_other_model(structure):
    low, high = np.exp(np.random.default_rng(1).normal(size=(2, structure.n_params)))
    places = interchanges(structure)
    change = told_by_motion(structure, np.linspace(low, high, 5), places)
    np.testing.assert_allclose(change, 0.0, atol=1e-6)


def test_the_order_of_parts_in_series_is_another_model_if_one_varies():
    theta = {"actuator": 1.0, "sensor": 2.0, "gain": 1.0}
    places = interchanges(servo())

    def change(**high):
        return told_by_motion(servo(), along(servo(), theta, theta | high), places)[1]

    assert change() == 0.0
    assert change(gain=9.0) < 1e-6
    assert 0.2 < change(sensor=4.0) < change(sensor=9.0) < 1.0
    assert change(actuator=2.0) > 0.1


@pytest.mark.slow
def test_how_much_motion_tells_is_the_difference_after_a_jump():
    """By simulation: impulses before it, the responses behind it."""
    family = np.array([[1.0, 1.0, 2.0], [1.0, 1.0, 9.0]])
    places = interchanges(servo())
    times = np.arange(0.0, 20.0, 0.02) + 0.01

    def responses(pi, jump):
        a, b = (servo().model(row[pi]) for row in family[jump])
        before = [expm(a.A * t) @ a.B for t in times]
        after = np.vstack([b.C @ expm(b.A * t) for t in times])
        return after @ np.hstack(before)

    expected = []
    for jump in ([0, 1], [1, 0]):
        one, other = (responses(pi, jump) for pi in places)
        size = max(np.linalg.norm(one), np.linalg.norm(other))
        expected.append(np.linalg.norm(one - other) / size)
    found = told_by_motion(servo(), family, places)
    np.testing.assert_allclose(found, [0.0, max(expected)], rtol=0.02)


@pytest.mark.parametrize("units", [1e-6, 1e6])
def test_units_of_channels_and_integrators_do_not_change_what_motion_tells(units):
    def structure(unit, pole):
        return GrayBoxStructure.from_template(
            [["-a", 0, 0], [1, "-b", 0], [0, 1, pole]],
            [[unit], [0], [0]],
            [[0, unit, 0], [0, 0, 1]],
        )

    low, high = {"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 6.0}
    for pole in (0, -0.1, 0.1):
        plain, scaled = (structure(unit, pole) for unit in (1.0, units))
        places, family = interchanges(plain), along(plain, low, high)
        found = told_by_motion(plain, family, places)
        assert found[1] > 0.1
        again = told_by_motion(scaled, family, places)
        np.testing.assert_allclose(again, found, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_the_slower_parts_come_first(scale):
    """Whatever their gains, and in whichever order they are."""
    structure = GrayBoxStructure.modal(3)
    rng = np.random.default_rng(3)
    theta = dict(zip(structure.parameter_names, rng.normal(size=12), strict=True))
    for k in range(3):
        rate = scale * 2.0**k
        theta |= {f"d_{k + 1}": 0.1 * rate, f"w2_{k + 1}": rate**2}
    row = structure.check_params(theta)
    places = interchanges(structure)
    assert len(places) == 6
    for pi in places:
        best = places[np.argmax(slow_first(structure, row[pi][None], places))]
        np.testing.assert_array_equal(row[pi][best], row)
