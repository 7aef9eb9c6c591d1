"""What a restructuring must survive: units, few data, bounds, margins, functions."""

import warnings

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace

LAG = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
GAIN = GrayBoxStructure.from_template(
    np.zeros((0, 0)).tolist(), np.zeros((0, 1)).tolist(), [[]], [["d"]]
)


def driven(gain=1.0, rate=1.0):
    A = np.array([[0, 1, 0], [-1, -0.1, 1], [0, 0, -3]])
    return StateSpace(rate * A, [[0], [0], [3 * rate * gain]], [[1, 0, 0]])


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_the_minimum_of_a_peak_is_no_floor():
    """The nearest gain to a half circle leaves an error that depends on the gain."""
    omega = np.array([1e-3, 1.0, 1e3])
    G = np.array([0.0, 1.0 + 1.0j, 2.0])[:, None, None]
    fitted = GrayBoxRestructurer(GAIN).fit(omega, G)
    assert np.isclose(fitted.params_[0], 1.0, atol=1e-6)
    assert fitted.structural_floor_ == 0 and fitted.lower_bound_ == 0
    assert np.isclose(fitted.error_, fitted.remaining_error_, rtol=1e-9)
    assert fitted.stationarity_ < 1e-6


def test_a_gain_that_the_structure_fixes_is_a_floor():
    unit = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["k"]], [[1, 0]]
    )
    model = unit.model({"k": 4.0, "c": 5.0})
    off = StateSpace(model.A, 1.1 * model.B, model.C)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = GrayBoxRestructurer(unit).fit_model(off)
    assert fitted.error_ >= fitted.structural_floor_ * (1 - 1e-9)
    assert np.isclose(fitted.structural_floor_, 0.1, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("seed", range(8))
def test_as_many_frequencies_as_active_peaks(seed):
    rng = np.random.default_rng(seed)
    omega = np.array([0.3, 1.0, 4.0])
    G = LAG.model([1.0, 2.0]).frequency_response(omega)
    G = G + 0.05 * (rng.normal(size=G.shape) + 1j * rng.normal(size=G.shape))
    fitted = GrayBoxRestructurer(LAG).fit(omega, G)
    E = fitted.lti_.frequency_response(omega) - G
    assert np.isclose(fitted.error_, np.abs(E).max(), rtol=1e-9)
    assert fitted.relative_error_ < 0.2


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("gain", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("rate", [1e-9, 1.0, 1e9])
def test_units_change_nothing(gain, rate):
    structure = GrayBoxStructure.observable_canonical(2, 1, 1, feedthrough=False)
    one = GrayBoxRestructurer(structure).fit_model(driven())
    other = GrayBoxRestructurer(structure).fit_model(driven(gain, rate))
    assert np.isclose(other.relative_error_, one.relative_error_, rtol=1e-8)
    assert other.stationarity_ < 1e-6
    assert np.isclose(other.second_order_, one.second_order_, rtol=1e-2)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_a_bound_holds_in_any_unit(unit):
    bounded = LAG.with_bounds({"b": (None, unit)})
    model = StateSpace([[-1.0]], [[3.0 * unit]], [[1.0]])
    fitted = GrayBoxRestructurer(bounded).fit_model(model)
    b = fitted.params_[fitted.structure_.parameter_names.index("b")]
    assert b <= unit and np.isclose(b, unit, rtol=1e-9)
    assert np.isclose(fitted.error_, fitted.remaining_error_, rtol=1e-9)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_a_slower_structure_than_the_black_box_lets_expect():
    """The poles of a finite impulse response are at zero: they decay at once."""
    fir = StateSpace([[0, 1], [0, 0]], [[0], [1]], [[0.5, 1.0]], [[0.0]], 1.0)
    fitted = GrayBoxRestructurer(LAG, init=[-0.5, 1.0]).fit_model(fir)
    assert fitted.lti_.is_stable and fitted.relative_error_ < 0.5


def test_a_function_may_refuse_parameters():
    def mass(theta):
        m, k, c = theta
        if np.real(m) <= 0.2:
            raise ValueError("the mass must be more than 0.2.")
        A = np.array([[0 * m, 1 + 0 * m], [-k / m, -c / m]])
        return A, np.array([[0 * m], [1 / m]]), np.array([[1.0, 0.0]])

    structure = GrayBoxStructure.from_function(mass, {"m": 5.0, "k": 9.0, "c": 3.0})
    truth = np.array([0.3, 2.0, 0.2])
    fitted = GrayBoxRestructurer(structure).fit_model(structure.model(truth))
    np.testing.assert_allclose(fitted.params_, truth, rtol=1e-6)


def test_a_gain_need_not_be_linear_in_its_parameter():
    square = GrayBoxStructure.from_function(
        lambda t: (
            np.zeros((0, 0)),
            np.zeros((0, 1)),
            np.zeros((1, 0)),
            np.array([[t[0] ** 2]]),
        ),
        [2.0],
    )
    model = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[9.0]])
    fitted = GrayBoxRestructurer(square, init=[2.5]).fit_model(model)
    assert np.isclose(fitted.params_[0], 3.0, rtol=1e-6)


def test_nothing_stays_of_an_earlier_fit():
    model = LAG.model([1.0, 2.0])
    others = [LAG.model([1.0 + d, 2.0]) for d in (-0.1, 0.0, 0.1)]
    restructurer = GrayBoxRestructurer(LAG)
    restructurer.fit_model(model, realizations=others)
    assert restructurer.params_covariance_.shape == (2, 2)
    restructurer.fit_model(model)
    assert not hasattr(restructurer, "params_covariance_")


@pytest.mark.parametrize(
    "options",
    [{"tol": -1.0}, {"tol": np.nan}, {"max_iter": 2.5}, {"n_starts": "a"}],
    ids=str,
)
def test_options_are_checked(options):
    (name,) = options
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        GrayBoxRestructurer(LAG, **options).fit_model(LAG.model([1.0, 2.0]))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("outputs", ["position", "velocity", "acceleration"])
def test_unknown_masses_are_found_from_nothing(unit, outputs):
    """Neither ranges, nor bounds, nor a first guess tell the size of a parameter."""
    structure = GrayBoxStructure.mechanical(
        M=[["m1", 0], [0, "m2"]],
        D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
        K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
        F=[[1], [0]],
        outputs=outputs,
    )
    values = {"m1": 2.0, "m2": 0.5, "c1": 0.4, "c2": 0.05, "k1": 9.0, "k2": 3.0}
    truth = np.array([unit * values[name] for name in structure.parameter_names])
    model = structure.model(truth)
    for given in (model, [model, model]):
        found = GrayBoxRestructurer(structure).fit_model(given)
        assert np.allclose(found.params_, truth, rtol=1e-5)


@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_h2_optima_at_bounds_are_certified():
    spring = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    )
    names = spring.parameter_names
    truth = np.array([{"k": 4.0, "c": 0.5, "b": 2.0}[name] for name in names])
    box = spring.model(truth)
    bounded = spring.with_bounds({"k": (None, 3.0), "c": (0, None)})
    start = np.array([{"k": 2.0, "c": 1.0, "b": 1.0}[name] for name in names])
    found = GrayBoxRestructurer(bounded, norm="h2", init=start).fit_model(box)
    assert np.isclose(found.params_[names.index("k")], 3.0)
    assert found.stationarity_ < 1e-4
    for j in range(3):  # no small step within the bounds is better
        for step in (-1e-3, 1e-3):
            other = found.params_.copy()
            other[j] = np.clip(other[j] + step, bounded.lower[j], bounded.upper[j])
            assert h2_of(bounded.model(other), box) >= found.objective_ * (1 - 1e-7)


def h2_of(one, two):
    """H2 norm of the difference by a dense grid."""
    omega = np.linspace(0, 200, 200001)
    E = one.frequency_response(omega) - two.frequency_response(omega)
    return np.sqrt(np.trapezoid(np.abs(E[:, 0, 0]) ** 2, omega) / np.pi)


@pytest.mark.parametrize("seed", range(3))
def test_an_error_at_its_lower_bound_is_optimal(seed):
    """Reduction by one order, with D free: Glover's bound is attained, all-pass."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6))
    A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(6)
    box = StateSpace(A, rng.normal(size=(6, 2)), rng.normal(size=(2, 6)))
    structure = GrayBoxStructure.observable_canonical(5, 2, 2, feedthrough=True)
    found = GrayBoxRestructurer(structure).fit_model(box)
    assert np.isclose(found.error_, box.hankel_singular_values()[5], rtol=1e-7)
    assert found.stationarity_ == 0.0


@pytest.mark.filterwarnings("ignore:the response determines")
@pytest.mark.parametrize("order", [3, 5, 6])
def test_a_black_box_of_lower_order_is_matched_exactly(order):
    """The structure has states to spare; its parameters are not unique."""
    box = StateSpace(
        [[0, 1, 0], [0, 0, 1], [-6, -11, -6]], [[0], [0], [1]], [[6, 5, 1]]
    )
    n = order
    A = [[0.0] * n for _ in range(n)]
    for i in range(n - 1):
        A[i][i + 1] = 1.0
    A[-1] = [f"-a{i}" for i in range(n)]
    controllable = GrayBoxStructure.from_template(
        A, [[0.0]] * (n - 1) + [[1.0]], [[f"b{i}" for i in range(n)]]
    )
    for structure in (controllable, GrayBoxStructure.observable_canonical(n)):
        assert GrayBoxRestructurer(structure).fit_model(box).relative_error_ < 1e-9
