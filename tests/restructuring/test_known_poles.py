"""Integrators and other poles that black box and structure share."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.restructuring.known_poles import divide

from .conftest import disguised, target_of

template = GrayBoxStructure.from_template

SERVO = template([[0, 1], [0, "-a"]], [[0], ["b"]], [[1, 0]])
FLEXIBLE = template(
    [[0, 1, 0, 0], [0, "-a", "k", 0], [0, 0, 0, 1], [0, "g", "-w", "-d"]],
    [[0], ["b"], [0], [0]],
    [[1, 0, 0, 0], [1, 0, 1, 0], [0, 1, 0, 0]],
)
FREE_MASSES = GrayBoxStructure.mechanical(
    [["m1", 0], [0, "m2"]], [["d", "-d"], ["-d", "d"]], [["k", "-k"], ["-k", "k"]],
    [[1], [0]],
)  # fmt: skip
BALL = template([[2, 1], [0, "-a"]], [[0], ["b"]], [[1, 0]])
SAMPLED = template([[1, "e"], [0, "f"]], [["g"], ["h"]], [[1, 0]])

CASES = {
    "servo": (SERVO, {"a": 3.0, "b": 2.0}, None),
    "flexible, three outputs": (
        FLEXIBLE, {"a": 3.0, "b": 2.0, "k": 1.0, "g": 0.5, "w": 40.0, "d": 0.8}, None,
    ),
    "double integrator": (
        FREE_MASSES, {"m1": 1.0, "m2": 2.0, "d": 0.3, "k": 20.0}, None,
    ),
    "unstable": (BALL, {"a": 3.0, "b": 2.0}, None),
    "discrete": (SAMPLED, {"e": 0.1, "f": 0.7, "g": 0.02, "h": 0.3}, 0.1),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_models_with_known_poles_are_recovered_from_nothing(name):
    structure, truth, dt = CASES[name]
    theta = structure.check_params(truth)
    model = structure.model(theta, dt)
    box = disguised(model, np.random.default_rng(0))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the response determines")  # SAMPLED
        fitted = GrayBoxRestructurer(structure).fit_model(box)
    assert fitted.relative_error_ < 1e-9
    if name != "discrete":
        np.testing.assert_allclose(fitted.params_, theta, rtol=1e-6)
    assert fitted.structure_ is structure
    omega = np.geomspace(0.05, 20.0, 40)
    np.testing.assert_allclose(
        fitted.lti_.frequency_response(omega),
        model.frequency_response(omega),
        rtol=1e-6,
    )


@pytest.mark.parametrize("name", CASES)
def test_the_divided_response_is_the_weighted_one(name):
    structure, truth, dt = CASES[name]
    theta = structure.check_params(truth)
    model = structure.model(theta, dt)
    divided, division = divide(structure, [target_of(model)], None)
    omega = np.geomspace(0.05, 20.0, 40)
    expected = division.weight(omega) * model.frequency_response(omega)
    own = divided.model(theta, dt)
    assert own.is_stable
    np.testing.assert_allclose(own.frequency_response(omega), expected, rtol=1e-8)
    box = division.of(target_of(disguised(model, np.random.default_rng(1))))
    of_box = StateSpace(box.A, box.B, box.C, box.D, dt)
    assert of_box.is_stable
    np.testing.assert_allclose(of_box.frequency_response(omega), expected, rtol=1e-6)
    step = 1e-6 * theta
    for j, slope in enumerate(divided.jacobian(theta)):
        ends = [
            divided.system_matrix(theta + sign * step * (np.arange(len(theta)) == j))
            for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose(
            (ends[0] - ends[1]) / (2.0 * step[j]),
            slope,
            atol=1e-6 * np.abs(slope).max(),
        )


def test_the_error_is_the_norm_of_the_weighted_difference():
    """Of K / (s (s + a)) and the servo, with c the pole a of the black box."""
    box = StateSpace(
        [[0, 1, 0], [0, -3, 1], [0, 0, -400]], [[0], [0], [800]], [[1, 0, 0]]
    )
    fitted = GrayBoxRestructurer(SERVO).fit_model(box)
    omega = np.geomspace(1e-6, 1e4, 4000)
    error = fitted.lti_.frequency_response(omega) - box.frequency_response(omega)
    weight = 1j * omega / (1j * omega + 3.0)
    peak = np.abs(weight * error[:, 0, 0]).max()
    assert np.isclose(fitted.error_, peak, rtol=1e-4)
    for factor in ([1.01, 1.0], [0.99, 1.0], [1.0, 1.01], [1.0, 0.99]):
        other = SERVO.model(fitted.params_ * factor).frequency_response(omega) - (
            box.frequency_response(omega)
        )
        assert np.abs(weight * other[:, 0, 0]).max() > peak


def test_outputs_that_do_not_show_the_pole_are_not_weighted():
    structure, truth, _ = CASES["flexible, three outputs"]
    model = structure.model(truth)
    _, division = divide(structure, [target_of(model)], None)
    weight = division.weight(np.array([1.0]))[0, :, 0]
    assert weight[2] == 1.0 and abs(weight[0]) < 1.0
    assert weight[0] == weight[1]


@pytest.mark.parametrize("pole", [-1e-3, 1e-3])
def test_a_pole_that_is_nearly_the_known_one_is_an_estimate_of_it(pole):
    box = StateSpace([[pole, 1], [0, -3]], [[0], [2]], [[1, 0]])
    fitted = GrayBoxRestructurer(SERVO).fit_model(box)
    np.testing.assert_allclose(fitted.params_, [3.0, 2.0], rtol=2e-3)
    assert fitted.relative_error_ < 1e-9


def test_measured_responses_of_servos():
    omega = np.geomspace(0.1, 100.0, 60)
    frf = SERVO.model([3.0, 2.0]).frequency_response(omega)
    fitted = GrayBoxRestructurer(SERVO).fit(omega, frf)
    np.testing.assert_allclose(fitted.params_, [3.0, 2.0], rtol=1e-6)
    with pytest.raises(ValueError, match="`omega` must be positive"):
        GrayBoxRestructurer(SERVO).fit(np.append(0.0, omega[1:]), frf)


@pytest.mark.parametrize("norm", ["h2", "similarity"])
def test_other_norms(norm):
    model = SERVO.model([3.0, 2.0])
    fitted = GrayBoxRestructurer(SERVO, norm=norm).fit_model(model)
    np.testing.assert_allclose(fitted.params_, [3.0, 2.0], rtol=1e-6)


def test_realizations_of_servos_have_a_covariance():
    rng = np.random.default_rng(0)
    truth = np.array([3.0, 2.0])
    thetas = truth * (1.0 + 0.01 * rng.normal(size=(200, 2)))
    realizations = [SERVO.model(theta) for theta in thetas]
    fitted = GrayBoxRestructurer(SERVO).fit_model(
        SERVO.model(thetas.mean(0)), realizations=realizations
    )
    std = np.sqrt(np.diag(fitted.params_covariance_) * len(thetas))
    np.testing.assert_allclose(std, thetas.std(0, ddof=1), rtol=0.03)


SPRING = template([[0, 1], ["k", "c"]], [[0], ["b"]], [[1, 0]])


@pytest.mark.parametrize(
    "structure",
    [
        SPRING,
        SPRING.with_bounds({"k": (None, 0), "c": (None, 0)}),
        template([[0, 1e6], ["1e-3 * k", "1e15 * c"]], [[0], ["b"]], [[1e6, 0]]),
        SPRING.with_bounds({"k": (-9, 0), "c": (-2, 0), "b": (0, 0.5)}),
        GrayBoxStructure.from_function(
            lambda p: ([[0, 1], [p[0], p[1]]], [[0], [1]], [[1, 0]]), [0.0, 0.0]
        ),
    ],
)
def test_a_pole_that_parameters_move_is_not_known(structure):
    box = SPRING.model({"k": -4.0, "c": -1.0, "b": 0.3})
    assert divide(structure, [target_of(box)], None) == (structure, None)


GAIN = template([[0, 1], [0, "-a"]], [[0], [1]], [["g", 0]])


@pytest.mark.parametrize(
    ("structure", "known_poles", "words"),
    [
        (SERVO, [], "if it is an integrator, write it into the structure"),
        (SERVO, [1.0], "must be poles of `structure` for all of its parameters"),
        (SERVO, [-1.0], "must be real, and zero or more"),
        (GAIN, None, "must have a state and outputs of fixed entries"),
    ],
)
def test_errors_teach(structure, known_poles, words):
    model = SERVO.model([3.0, 2.0])
    with pytest.raises(ValueError, match=words):
        GrayBoxRestructurer(structure, known_poles=known_poles).fit_model(model)


def test_an_estimated_integrator_leaves_the_outputs_that_do_not_show_it():
    """Position and velocity, of which the latter has a little of the estimated pole."""
    structure = GrayBoxStructure.from_template(
        [[0, 1], [0, "-d"]], [[0], ["b"]], [[1, 0], [0, 1]]
    )
    truth = structure.model({"d": 1.0, "b": 5.0})
    for pole in (-1e-3, -1e-7, 1e-7):
        A = truth.A + pole * np.array([[1.0, 0.0], [0.0, 0.0]])
        C = truth.C + np.array([[0.0, 0.0], [1e-4, 0.0]])
        fitted = GrayBoxRestructurer(structure).fit_model(StateSpace(A, truth.B, C))
        np.testing.assert_allclose(fitted.params_, [5.0, 1.0], rtol=5e-3)


def test_a_black_box_that_lacks_the_integrator_is_told_of():
    structure = GrayBoxStructure.from_template(
        [[0, 1], [0, "-d"]], [[0], ["b"]], [[1, 0]]
    )
    box = StateSpace([[-0.4, 1.0], [0.0, -1.0]], [[0.0], [5.0]], [[1.0, 0.0]])
    with pytest.warns(ConvergenceWarning, match=r"SubspaceLTI\(integrating=\.\.\.\)"):
        GrayBoxRestructurer(structure).fit_model(box)
