"""Integrators and other poles that black box and structure share."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace, SubspaceLTI
from lpvlearn.pipeline.points.common_choices import of_structure
from lpvlearn.restructuring.error_system import series
from lpvlearn.restructuring.known_poles import divide, hidden_integrators

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
OSCILLATOR = template(
    [[0, 1, 0], [-25, 0, 1], [0, 0, "-a"]], [["f"], ["g"], ["b"]], [[1, 0, 0]]
)
# an angle, the sloshing of a liquid, and an actuator; the last output shows neither
SLOSHING = template(
    [
        [0, 1, 0, 0, 0],
        [0, 0, 0, 0, "k"],
        [0, 0, 0, 2, 0],
        [0, 0, -2, 0, 1],
        [0, 0, 0, 0, "-a"],
    ],
    [[0, 0], [0, "e"], [0, "f"], [0, "g"], ["b", 0]],
    [[1, 0, 1, 0, 0], [1, 0, 0, 0, 0], [0, 0, 0, 3, 0], [0, 0, 0, 0, 1]],
)
IN_SERIES = template(
    [
        [0, 1, 0, 0, 0],
        [-9, 0, 1, 0, 0],
        [0, 0, 0, 1, 0],
        [0, 0, -9, 0, 1],
        [0, 0, 0, 0, "-a"],
    ],
    [[0], ["e"], [0], ["f"], ["b"]],
    [[1, 0, 0, 0, 0], [0, 0, 1, 0, 0]],
)
SIDE_BY_SIDE = template(
    [
        [0, 3e3, 0, 0, 0],
        [-3e3, 0, 0, 0, 0],
        [0, 0, 0, 3e3, 0],
        [0, 0, -3e3, 0, 2e3],
        [0, 0, 0, 0, "-a"],
    ],
    [["e", 0], ["f", 0], [0, 0], [0, "g"], [0, "b"]],
    [[1, 0, 0, 0, 0], [0, 0, 1, 0, 0]],
)
SPIRAL = template([[0.5, -4, 1], [1, 0.5, 0], [0, 0, "-a"]], [["f"], [0], ["b"]],
                  [[0, 1, 0]])  # fmt: skip
COS, SIN = np.cos(0.6), np.sin(0.6)
ALTERNATING = template(
    [[COS, SIN, 0, 0], [-SIN, COS, 0, 1], [0, 0, -1, "e"], [0, 0, 0, "a"]],
    [["f"], [0], ["g"], ["b"]],
    [[1, 0, 0, 0], [0, 0, 1, 0]],
)

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
    "oscillator": (OSCILLATOR, {"a": 3.0, "b": 2.0, "f": 1.0, "g": 4.0}, None),
    "integrators and a pair": (
        SLOSHING, {"k": 1.5, "a": 9.0, "b": 4.0, "e": 0.7, "f": 0.5, "g": 2.0}, None,
    ),
    "pairs in series": (IN_SERIES, {"a": 1.0, "b": 2.0, "e": 3.0, "f": 0.4}, None),
    "pairs side by side": (
        SIDE_BY_SIDE, {"a": 1e3, "b": 2e3, "e": 3e3, "f": 900.0, "g": 5e3}, None,
    ),
    "unstable pair": (SPIRAL, {"a": 3.0, "b": 2.0, "f": 0.4}, None),
    "discrete pair": (
        ALTERNATING, {"a": 0.8, "b": 0.3, "e": 0.2, "f": 1.0, "g": 0.5}, 0.1,
    ),
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
    divided, division = divide(structure, dt, [target_of(model)])
    omega = np.geomspace(0.05, 20.0, 40)
    expected = division.weight(omega) * model.frequency_response(omega)
    own = divided.model(theta, dt)
    assert own.is_stable
    zero = 1e-12 * np.abs(expected).max()  # of channels that are
    np.testing.assert_allclose(
        own.frequency_response(omega), expected, rtol=1e-8, atol=zero
    )
    box = division.of(target_of(disguised(model, np.random.default_rng(1))))
    of_box = StateSpace(box.A, box.B, box.C, box.D, dt)
    assert of_box.is_stable
    np.testing.assert_allclose(
        of_box.frequency_response(omega), expected, rtol=1e-6, atol=zero
    )
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


def test_the_error_beside_an_oscillator_is_the_norm_of_the_weighted_difference():
    """With c the frequency of the pair, which is nearer than the other poles."""
    box = OSCILLATOR.model({"a": 3.0, "b": 2.0, "f": 1.0, "g": 4.0})
    quick = target_of(StateSpace([[-1e3]], [[1.2e3]], [[1.0]]))
    box = StateSpace(*series(target_of(box), quick).matrices)
    fitted = GrayBoxRestructurer(OSCILLATOR).fit_model(box)
    omega = np.geomspace(1e-3, 1e5, 4000)
    error = fitted.lti_.frequency_response(omega) - box.frequency_response(omega)
    weight = (25.0 - omega**2) / ((1j * omega + 5.0) ** 2 + 25.0)
    peak = np.abs(weight * error[:, 0, 0]).max()
    assert np.isclose(fitted.error_, peak, rtol=1e-4)


def test_a_mode_beside_the_known_pair_is_not_taken_for_it():
    """With c the distance of the two, and the box's own pair an estimate."""
    structure = template(
        [[0, 5, 0, 0], [-5, 0, 1, 0], [0, 0, 0, 1], [0, 0, "-k", "-d"]],
        [[0], ["e"], [0], ["b"]],
        [[1, 0, 0, 0]],
    )
    theta = structure.check_params({"k": 30.0, "d": 0.1, "b": 2.0, "e": 1.0})
    box = structure.model(theta)
    (step,) = divide(structure, None, [target_of(box)])[1].steps
    c = np.sqrt(30.0 - 0.05**2) - 5.0
    assert np.isclose(step.pole - step.instead, np.hypot(c, 0.05))
    A = box.A - 1e-3 * np.diag([1.0, 1.0, 0.0, 0.0])
    fitted = GrayBoxRestructurer(structure).fit_model(StateSpace(A, box.B, box.C))
    np.testing.assert_allclose(fitted.params_, theta, rtol=1e-2)


def test_outputs_that_do_not_show_the_pole_are_not_weighted():
    structure, truth, dt = CASES["flexible, three outputs"]
    model = structure.model(truth)
    _, division = divide(structure, dt, [target_of(model)])
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


@pytest.mark.slow
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
        template([[0, 1], ["k", 0]], [[0], ["b"]], [[1, 0]]),
        template([[0, 1e6], ["1e-3 * k", "1e15 * c"]], [[0], ["b"]], [[1e6, 0]]),
        SPRING.with_bounds({"k": (-9, 0), "c": (-2, 0), "b": (0, 0.5)}),
        GrayBoxStructure.from_function(
            lambda p: ([[0, 1], [p[0], p[1]]], [[0], [1]], [[1, 0]]), [0.0, 0.0]
        ),
    ],
)
def test_a_pole_that_parameters_move_is_not_known(structure):
    box = SPRING.model({"k": -4.0, "c": -1.0, "b": 0.3})
    assert divide(structure, None, [target_of(box)]) == (structure, None)


SCALED = template([[0, 1], [-25, 0]], [["b"], [1]], [["g", 0]])
GAIN = template([[0, 1], [0, "-a"]], [[0], [1]], [["g", 0]])


@pytest.mark.parametrize(
    ("structure", "known_poles", "words"),
    [
        (SERVO, [], "if it is an integrator, write it into the structure"),
        (SERVO, [1.0], "must be poles of `structure` for all of its parameters"),
        (SERVO, [-1.0], "must be of real part zero or more"),
        (SERVO, [5j, -5j], "must be poles of `structure` for all of its parameters"),
        (SERVO, [0.0, 5j], r"in pairs. Got 0\+5j without 0-5j: add it"),
        (SERVO, [np.nan], "must be of real part zero or more"),
        (SCALED, None, "must have a state and outputs of fixed entries"),
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


# Positions along two axes and one velocity; a lag drives one of them.
AXES = template(
    [
        [0, 1, 0, 0, 0],
        [0, 0, 0, 0, 1],
        [0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, "-a"],
    ],
    [[0, 0], [0, "f"], [0, 0], [0, "g"], ["b", 0]],
    [[1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 1, 0, 0, 0]],
)
EYE = np.eye(5)


@pytest.mark.broad
@pytest.mark.parametrize(
    ("structure", "values", "positions", "centres"),
    [
        (*CASES["double integrator"][:2], [[1, 1, 0, 0]], [[1 / 3, 2 / 3, 0, 0]]),
        (AXES, {"a": 3.0, "b": 2.0, "f": 0.5, "g": 4.0}, EYE[[0, 2]], EYE[[0, 2]]),
    ],
)
@pytest.mark.parametrize(
    ("total", "product"),
    [(0.0, -1e-8), (0.0, 1e-8), (3e-3, 2e-6), (-2e-3, 2e-6), (0.0, 0.0)],
)
def test_poles_about_a_double_integrator_are_estimates_of_it(
    structure, values, positions, centres, total, product
):
    """With s^2 - total s + product for s^2, in a basis where no entry tells of it."""
    truth = structure.model(values)
    at, seen = np.asarray(positions, float), np.asarray(centres, float)
    step = 2 if len(at) == 1 else 1  # from the state of a position to its velocity
    moving, seen_moving = (np.roll(of, step, axis=1) for of in (at, seen))
    change = moving.T @ (total * seen_moving - product * seen)
    model = StateSpace(truth.A + change, truth.B, truth.C)
    slow = np.sort(np.abs(model.poles() ** 2 - total * model.poles() + product))
    np.testing.assert_allclose(slow[: 2 * len(at)], 0.0, atol=1e-10)
    fitted = GrayBoxRestructurer(structure).fit_model(
        disguised(model, np.random.default_rng(2))
    )
    np.testing.assert_allclose(
        fitted.params_, structure.check_params(values), rtol=5e-3
    )


@pytest.mark.parametrize("b", [0.0, 1e-200])
def test_a_double_integrator_that_no_input_moves_is_told(b):
    """Of an estimate of it: the states have no units of size one."""
    A = [[1e-6, 1.0, 0.0], [0.0, -1e-6, 2.0], [0.0, 0.0, -3.0]]
    structure = template(
        [[0, 1, 0], [0, 0, "k"], [0, 0, "-a"]], [[0], [0], ["b"]], [[1, 0, 0]]
    )
    box = StateSpace(A, [[0.0], [0.0], [b]], [[1.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="a response that is not zero"):
        GrayBoxRestructurer(structure).fit_model(box)


@pytest.mark.parametrize("shift", [-0.01, 0.01, 0.01j, -0.01j])
def test_a_pair_that_is_nearly_the_known_one_is_an_estimate_of_it(shift):
    truth = OSCILLATOR.model({"a": 3.0, "b": 2.0, "f": 1.0, "g": 4.0})
    A, s = truth.A.copy(), np.real(shift)
    A[:2, :2] = [[s, 1.0], [-((5.0 + np.imag(shift)) ** 2), s]]
    box = disguised(StateSpace(A, truth.B, truth.C), np.random.default_rng(2))
    fitted = GrayBoxRestructurer(OSCILLATOR).fit_model(box)
    np.testing.assert_allclose(fitted.params_, [3.0, 2.0, 1.0, 4.0], rtol=2e-2)


def test_measured_responses_of_oscillators():
    omega = np.geomspace(0.1, 100.0, 60)
    truth = OSCILLATOR.check_params({"a": 3.0, "b": 2.0, "f": 1.0, "g": 4.0})
    frf = OSCILLATOR.model(truth).frequency_response(omega)
    fitted = GrayBoxRestructurer(OSCILLATOR).fit(omega, frf)
    np.testing.assert_allclose(fitted.params_, truth, rtol=1e-6)
    omega[30] = 5.0
    with pytest.raises(ValueError, match=r"`omega` .* must differ .* Got 5"):
        GrayBoxRestructurer(OSCILLATOR).fit(omega, frf)


def test_poles_may_be_named():
    """As NumPy has them, with or without their rounding."""
    model = OSCILLATOR.model({"a": 3.0, "b": 2.0, "f": 1.0, "g": 4.0})
    own = divide(OSCILLATOR, None, [target_of(model)])[1]
    for names in ([5j, -5j], np.roots([1, 0, 25]), [5j + 1e-12, -5j + 1e-12]):
        named = divide(OSCILLATOR, None, [target_of(model)], names)[1]
        assert named.steps[0].pole == own.steps[0].pole == 5j
    z = np.exp([0.6j, -0.6j])
    assert len(divide(*_sampled(), z)[1].steps) == 1


def _sampled():
    theta = ALTERNATING.check_params(CASES["discrete pair"][1])
    return ALTERNATING, 0.1, [target_of(ALTERNATING.model(theta, 0.1))]


@pytest.mark.slow
@pytest.mark.parametrize("fast", [1e3, 1e8])
def test_slow_poles_beside_fast_ones_are_not_known(fast):
    structure = template(
        [[0, 1, 0], [0, "-a", "a"], [0, 0, -fast]], [[0], [0], ["b"]], [[1, 0, 0]]
    )
    model = structure.model({"a": 1.0, "b": 2.0 * fast})
    for box in (model, disguised(model, np.random.default_rng(0))):
        fitted = GrayBoxRestructurer(structure).fit_model(box)
        np.testing.assert_allclose(fitted.params_, [1.0, 2.0 * fast], rtol=1e-6)


def test_the_oscillator_of_fast_systems_may_have_slow_units():
    w = 2.0 * np.pi * 1e6
    structure = template([[0, 1], [-(w**2), 0]], [["f"], ["g"]], [[1, 0]])
    box = structure.model({"f": 2.0, "g": w})
    fitted = GrayBoxRestructurer(structure).fit_model(box)
    np.testing.assert_allclose(fitted.params_, [2.0, w], rtol=1e-6)


def test_the_integrator_of_fast_systems_is_told_from_their_slow_pole():
    structure = template(
        [[0, 1, 0], [0, "-a", 1], [0, 0, "-w"]], [[0], [0], ["b"]], [[1, 0, 0]]
    ).with_bounds({"w": (1e6, None)})
    box = structure.model({"a": 1.0, "w": 2e6, "b": 1e6})
    (step,) = divide(structure, None, [target_of(box)])[1].steps
    assert np.isclose(step.instead, -1.0)


def test_positions_that_no_output_shows_are_no_states_of_the_records():
    free = {"M": [["m", 0], [0, 1]], "D": [["d", 0], [0, 1]], "F": np.eye(2)}
    for K, outputs, count in (
        ([[0, 0], [0, 0]], "velocity", 2),
        ([[0, 0], [0, 0]], "position", 0),
        ([["k", 0], [0, 0]], "velocity", 1),
        ([["k", 0], [0, 1e-6]], "velocity", 0),
    ):
        structure = GrayBoxStructure.mechanical(**free, K=K, outputs=outputs)
        assert hidden_integrators(structure) == count
        local, _ = of_structure(SubspaceLTI(), structure)
        assert local.order == 4 - count
    gain = GrayBoxStructure.from_template(A=[], B=[], C=[], D=[["d"]])
    assert hidden_integrators(gain) == 0
