"""The H2 norm of the error, its gradient and its minimisation."""

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.restructuring.error_system import ErrorSystem, Target
from lpvlearn.restructuring.minimise_h2 import squared_h2

from ..conftest import stable_model
from .test_error_system import error_system

ONE = np.ones((1, 1))


def strictly_proper(system):
    """The same error without feedthrough of the black box."""
    t = system.target
    return ErrorSystem(system.structure, Target(t.A, t.B, t.C, 0 * t.D, t.dt))


@pytest.mark.parametrize("dt", [None, 0.1])
def test_squared_norm_is_the_energy_of_the_impulse_response(dt):
    lag = GrayBoxStructure.from_template([["-a"]], [[1]], [[1]])
    if dt is None:  # 1/(s + 3) against 0: integral of exp(-6 t)
        theta, expected = np.array([3.0]), 1.0 / 6.0
    else:  # 1/(z - 0.5): sum of 0.25^k
        theta, expected = np.array([-0.5]), 1.0 / 0.75
    nothing = Target(0.1 * ONE, 0 * ONE, ONE, 0 * ONE, dt)
    if dt is None:
        nothing = Target(-ONE, 0 * ONE, ONE, 0 * ONE)
    J, _ = squared_h2(ErrorSystem(lag, nothing), theta)
    assert np.isclose(J, expected, rtol=1e-12)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 1)])
def test_gradient_equals_central_differences(shape, dt, weighted):
    system, theta, _, _ = error_system(np.random.default_rng(0), shape, dt)
    if weighted:
        pole = -2.0 * ONE if dt is None else 0.5 * ONE
        weight = Target(pole, ONE, ONE, 0.5 * ONE, dt)
        system = ErrorSystem(system.structure, system.target, weight)
    _, gradient = squared_h2(system, theta)
    h = 1e-6
    numeric = np.array(
        [
            squared_h2(system, theta + h * e)[0] - squared_h2(system, theta - h * e)[0]
            for e in np.eye(len(theta))
        ]
    ) / (2 * h)
    np.testing.assert_allclose(gradient, numeric, atol=1e-7 * np.abs(numeric).max())


def two_lags():
    return GrayBoxStructure.from_template(
        [["-a", 0], [1, "-b"]], [["g"], [0]], [[0, 1]]
    )


@pytest.mark.filterwarnings("ignore:the values of")
@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_restructurer_minimises_the_h2_norm():
    box = StateSpace(
        [[0, 1, 0], [-2, -3, 0], [0, 0, -30]], [[0], [2], [1]], [[1, 0, 0.3]]
    )
    structure = two_lags()
    fitted = GrayBoxRestructurer(structure, norm="h2").fit_model(box)
    hinf = GrayBoxRestructurer(structure).fit_model(box)
    target = Target(box.A, box.B, box.C, box.D)
    system = ErrorSystem(structure, target)
    J = squared_h2(system, fitted.params_)[0]
    assert np.isclose(fitted.objective_, np.sqrt(J), rtol=1e-9)
    assert J <= squared_h2(system, hinf.params_)[0]
    assert hinf.error_ <= fitted.error_
    rng = np.random.default_rng(0)
    for _ in range(20):
        near = fitted.params_ * (1 + 1e-3 * rng.normal(size=3))
        assert squared_h2(system, near)[0] >= J * (1 - 1e-9)


@pytest.mark.parametrize("unit", [1e-7, 1e-5, 1e-2, 1e3, 1e6])
def test_h2_is_the_same_in_any_unit_of_time(unit):
    """`unit` of the seconds of a spring; its parameters are powers of a rate."""
    spring = GrayBoxStructure.from_template(
        A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]]
    )
    box = StateSpace([[0, 1], [-40, -1.2]], [[0.15], [30]], [[1, 0.01]])
    scaled = StateSpace(box.A / unit, box.B / unit, box.C)
    rates = {"k": unit**2, "c": unit, "b": unit**2}
    restructurer = GrayBoxRestructurer(spring, norm="h2")
    with pytest.warns(ConvergenceWarning, match="comes no nearer than 4.9 %"):
        own = restructurer.fit_model(box).params_
        other = restructurer.fit_model(scaled).params_
    found = [rates[n] * x for n, x in zip(spring.parameter_names, other, strict=True)]
    np.testing.assert_allclose(found, own, rtol=1e-6)


def test_h2_recovers_exact_models_with_a_feedthrough_parameter():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]], [["d"]])
    box = structure.model({"a": 2.0, "b": 3.0, "d": 0.5}).balance()
    fitted = GrayBoxRestructurer(structure, norm="h2").fit_model(box)
    np.testing.assert_allclose(fitted.params_, [2.0, 3.0, 0.5], rtol=1e-6)


def test_infinite_h2_norm_is_refused():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]], [["a"]])
    box = StateSpace([[-2.0]], [[1.0]], [[1.0]], [[5.0]])
    with pytest.raises(ValueError, match="without feedthrough"):
        GrayBoxRestructurer(structure, norm="h2").fit_model(box)


@pytest.mark.broad
@pytest.mark.filterwarnings("ignore:the values of")
@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
@pytest.mark.filterwarnings("ignore:the response determines")
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_what_ends_without_a_warning_is_stationary(seed, bounded):
    chain = GrayBoxStructure.from_template(
        [["-a", 0, 0], ["b", "-b", 0], [0, "c", "-c"]], [["g"], [0], [0]], [[0, 0, 1]]
    )
    if bounded:
        chain = chain.with_bounds({name: (0, None) for name in chain.parameter_names})
    truth = chain.model(np.exp(np.random.default_rng(seed).normal(size=4)))
    rate, gain = np.abs(truth.poles()).mean(), truth.hinf_norm()
    rest = stable_model(seed, 3, 1, 1, rate=rate)
    box = truth - StateSpace(rest.A, 0.05 * gain / rest.hinf_norm() * rest.B, rest.C)
    fitted = GrayBoxRestructurer(chain, norm="h2").fit_model(box)
    assert fitted.stationarity_ <= 1e-3  # a warning would be an error
    assert fitted.convergence_ in ("optimal", "nearly")
    system = ErrorSystem(chain, Target(box.A, box.B, box.C, box.D))
    for size in (1e-3, 1e-2):  # nothing near is lower
        for step in size * np.random.default_rng(0).normal(size=(10, 4)):
            near = fitted.params_ * (1 + step)
            if system.poles(near).real.max() < -1e-3 * rate:
                J = squared_h2(system, near)[0]
                assert J >= fitted.objective_**2 * (1 - 1e-7)


def test_an_optimum_at_a_bound_is_stationary():
    lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    box = lag.model([2.0, 3.0])
    held = lag.with_bounds({"b": (None, 2.5)})
    with pytest.warns(UserWarning, match="comes no nearer"):
        fitted = GrayBoxRestructurer(held, norm="h2").fit_model(box)
    assert np.isclose(fitted.params_[1], 2.5, rtol=1e-9)
    assert fitted.stationarity_ < 1e-5
