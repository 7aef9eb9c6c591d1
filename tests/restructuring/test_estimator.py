"""GrayBoxRestructurer: a black box in the user's structure."""

import pickle
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.stats import t as student
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning, NotFittedError

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace, peak_gains
from lpvlearn.datasets import FlexibleArm
from lpvlearn.exceptions import RankWarning
from lpvlearn.models.statespace import DEVIATION
from lpvlearn.restructuring import estimator
from lpvlearn.restructuring.minimise_hinf import minimise_hinf
from lpvlearn.restructuring.problem import problem_from_models

from ..conftest import spring_structure, stable_model
from .conftest import (
    CASES,
    disguised,
    far_fit,
    heat_exchanger,
    off_structure,
    two_masses,
)


@pytest.mark.parametrize("name", CASES)
def test_exact_models_are_recovered_from_nothing(name):
    structure, params = CASES[name]
    theta = structure.check_params(params)
    black_box = disguised(structure.model(theta), np.random.default_rng(0))
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    np.testing.assert_allclose(fitted.params_, theta, rtol=1e-6)
    assert fitted.relative_error_ < 1e-9
    assert fitted.structural_floor_ == 0.0


@pytest.mark.parametrize("name", ["spring_mass", "two_masses", "heat_exchanger"])
def test_measured_responses_are_recovered_from_nothing(name):
    structure, params = CASES[name]
    theta = structure.check_params(params)
    model = structure.model(theta)
    omega = np.geomspace(0.02, 50, 80)
    fitted = GrayBoxRestructurer(structure).fit(omega, model.frequency_response(omega))
    np.testing.assert_allclose(fitted.params_, theta, rtol=1e-6)
    table = fitted.predict(omega)
    assert table.shape == (80, 2 * model.n_outputs)
    assert fitted.score(omega, table) == 1.0


def test_result_does_not_depend_on_the_basis_of_the_black_box():
    structure, params = CASES["spring_mass"]
    rng = np.random.default_rng(3)
    black_box = off_structure(structure.model(params), rng, 0.02)
    first = GrayBoxRestructurer(structure).fit_model(black_box)
    second = GrayBoxRestructurer(structure).fit_model(disguised(black_box, rng))
    assert np.isclose(first.error_, second.error_, rtol=1e-6)
    np.testing.assert_allclose(first.params_, second.params_, rtol=1e-4)


@pytest.mark.broad
@pytest.mark.parametrize("seed", range(2))
def test_error_is_a_minimum_and_both_solvers_find_it(seed, rough):
    structure, rng = CASES["two_masses"][0], np.random.default_rng(seed)
    black_box, sqp = far_fit(seed)
    bundle = GrayBoxRestructurer(structure, solver="bundle", max_iter=2000)
    bundle.fit_model(black_box)
    assert np.isclose(sqp.error_, bundle.error_, rtol=1e-5)
    assert sqp.stationarity_ < 1e-5
    assert np.isclose(sqp.error_, (sqp.lti_ - black_box).hinf_norm(), rtol=1e-9)
    for _ in range(30):
        near = sqp.params_ * (1 + 1e-3 * rng.normal(size=len(sqp.params_)))
        error = (structure.model(near) - black_box).hinf_norm()
        assert error >= sqp.error_ * (1 - 1e-9)


def test_active_frequencies_carry_the_norm():
    black_box, fitted = far_fit(1)
    E = (fitted.lti_ - black_box).frequency_response(fitted.active_frequencies_)
    sigma = np.linalg.norm(E, 2, axis=(1, 2))
    np.testing.assert_allclose(sigma, fitted.error_, rtol=1e-5)
    assert len(sigma) > 1


def test_gain_fixed_by_the_structure_is_reported_as_a_floor():
    structure = GrayBoxStructure.from_template([["-a"]], [["a"]], [[1]])  # G(0) = 1
    black_box = StateSpace([[-2.0]], [[2.0]], [[1.05]])
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    assert np.isclose(fitted.structural_floor_, 0.05, rtol=1e-9)
    assert np.isclose(fitted.error_, 0.05, rtol=1e-6)
    assert np.isclose(fitted.params_[0], 2.0, rtol=0.1)


def test_canonical_form_without_a_structure_reproduces_the_model():
    rng = np.random.default_rng(2)
    structure, params = CASES["two_masses"]
    black_box = disguised(structure.model(params), rng)
    fitted = GrayBoxRestructurer().fit_model(black_box)
    assert fitted.relative_error_ < 1e-8
    assert fitted.structure_.n_params == 4 * 2 + 4


def test_discrete_time_models_are_restructured_in_discrete_time():
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-a0", "-a1"]], [[0], ["b"]], [[1, 0]]
    )
    model = structure.model({"a0": 0.8, "a1": -1.6, "b": 0.1}, sampling_time=0.05)
    fitted = GrayBoxRestructurer(structure).fit_model(
        disguised(model, np.random.default_rng(0))
    )
    np.testing.assert_allclose(fitted.params_, [0.8, -1.6, 0.1], rtol=1e-6)
    assert fitted.lti_.sampling_time == 0.05


def test_black_box_of_higher_order_than_the_structure():
    structure, params = CASES["spring_mass"]
    truth = structure.model(params)
    # a fast parasitic pole, hardly visible
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = truth.A, -500.0
    black_box = StateSpace(
        A, np.vstack([truth.B, [[1.0]]]), np.hstack([truth.C, [[1e-2]]])
    )
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    np.testing.assert_allclose(
        fitted.params_, structure.check_params(params), rtol=1e-2
    )


def test_black_box_of_lower_order_than_the_structure():
    structure = heat_exchanger()
    black_box = StateSpace(
        [[-0.5, 0.0], [2.0, -2.0]],
        [[0.5], [0.0]],
        [[1, 0], [0, 1], [0, 1]],
        [[0], [0], [0.1]],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    assert fitted.relative_error_ < 0.05


@pytest.mark.parametrize("rate", [1e-5, 1e5])
@pytest.mark.parametrize("channel", [1e-6, 1e6])
def test_time_scale_and_units_do_not_matter(rate, channel):
    structure, params = CASES["spring_mass"]
    theta = {
        "k": params["k"] * rate**2,
        "c": params["c"] * rate,
        "b": params["b"] * rate**2 * channel,
    }
    black_box = structure.model(theta).balance()
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    np.testing.assert_allclose(fitted.params_, structure.check_params(theta), rtol=1e-6)


@pytest.mark.parametrize("units", [(1e-6, 1e6), (1e6, 1e-6), (1.0, 1e-6)])
def test_channels_in_very_different_units(units):
    _, params = CASES["two_masses"]
    scaled = GrayBoxStructure.from_template(
        [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            ["-k1", "k2", "-c1", 0],
            ["k3", "-k3", 0, "-c2"],
        ],
        [[0], [0], ["b"], [0]],
        [[units[0], 0, 0, 0], [0, units[1], 0, 0]],
    )
    black_box = disguised(scaled.model(params), np.random.default_rng(0))
    fitted = GrayBoxRestructurer(scaled).fit_model(black_box)
    np.testing.assert_allclose(fitted.params_, scaled.check_params(params), rtol=1e-6)


def test_smooth_structures_start_from_their_first_guess():
    def pendulum(p):
        length, damping = p
        return [[0, 1], [-9.81 / length, -damping]], [[0], [1 / length**2]], [[1, 0]]

    structure = GrayBoxStructure.from_function(
        pendulum, {"length": 1.0, "damping": 0.3}
    )
    truth = [0.63, 0.21]
    fitted = GrayBoxRestructurer(structure).fit_model(structure.model(truth).balance())
    np.testing.assert_allclose(fitted.params_, truth, rtol=1e-6)


def test_a_physical_guess_is_used():
    structure, params = CASES["arm"]
    theta = structure.check_params(params)
    guess = theta * 1.05
    fitted = GrayBoxRestructurer(structure, init=guess, n_starts=1).fit_model(
        structure.model(theta).balance()
    )
    np.testing.assert_allclose(fitted.params_, theta, rtol=1e-6)


def test_neighbours_parameters_are_compared_by_their_fit():
    structure, params = CASES["arm"]
    theta = structure.check_params(params)
    black_box = structure.model(theta).balance()
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    near = FlexibleArm().parameters(1.0)
    assert fitted.start_error(black_box, near) < 1e-6
    assert fitted.start_error(black_box, -theta) == np.inf  # unstable


def test_unidentifiable_combination_is_named_and_a_fit_returned():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    black_box = StateSpace([[-2.0]], [[3.0]], [[1.0]])
    with pytest.warns(RankWarning, match=r"determines 2 of the 3.*b.*c"):
        fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    assert fitted.relative_error_ < 1e-6
    assert fitted.identifiability_.rank == 2


def test_structure_that_cannot_fit_warns():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    resonance = StateSpace([[0, 1], [-4, -0.2]], [[0], [1]], [[1, 0]])
    with pytest.warns(ConvergenceWarning, match="cannot represent the model") as given:
        GrayBoxRestructurer(structure).fit_model(resonance)
    assert given[0].filename == __file__  # it points to the caller


def test_too_few_iterations_warn_and_keep_the_best_point(rough):
    black_box, full = far_fit(0)
    with pytest.warns(ConvergenceWarning, match="`max_iter`=1"):
        short = clone(full).set_params(max_iter=1).fit_model(black_box)
    assert full.error_ <= short.error_ < 2 * full.error_


def test_similarity_norm_solves_the_bilinear_equations():
    structure, params = CASES["two_masses"]
    theta = structure.check_params(params)
    black_box = disguised(structure.model(theta), np.random.default_rng(0))
    fitted = GrayBoxRestructurer(structure, norm="similarity").fit_model(black_box)
    np.testing.assert_allclose(fitted.params_, theta, rtol=1e-6)
    assert fitted.objective_ < 1e-8


def test_hinf_norm_is_smaller_than_with_the_bilinear_equations(rough):
    black_box, hinf = far_fit(1)
    bilinear = clone(hinf).set_params(norm="similarity").fit_model(black_box)
    assert hinf.error_ < bilinear.error_


@pytest.mark.slow
def test_covariance_of_the_parameters_predicts_their_spread():
    structure, params = CASES["spring_mass"]
    theta = structure.check_params(params)
    rng = np.random.default_rng(0)
    exact, size, n = structure.model(theta), 2e-4, 400

    def noisy():
        A = exact.A + size * rng.normal(size=(2, 2))
        B = exact.B + size * rng.normal(size=(2, 1))
        return StateSpace(A, B, exact.C)

    models = [noisy() for _ in range(n)]
    fitted = GrayBoxRestructurer(structure, norm="h2").fit_model(
        exact, realizations=models
    )
    single = fitted.params_covariance_ * n
    # the fits that the minimisation starts from, around the truth
    estimates = np.array(
        [
            problem_from_models(structure, [model], None).fit(theta).x
            for model in models[:150]
        ]
    )
    spread = estimates.std(0)
    np.testing.assert_allclose(np.sqrt(np.diag(single)), spread, rtol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("norm", ["hinf", "h2", "similarity"])
def test_the_covariance_is_that_of_the_norm_that_was_minimised(norm):
    structure, params = CASES["heat_exchanger"]
    theta = structure.check_params(params)
    exact, rng, n = structure.model(theta), np.random.default_rng(0), 40
    parts = (exact.A, exact.B, exact.C)

    def noisy():
        return StateSpace(
            *(M * (1 + 1e-3 * rng.normal(size=M.shape)) for M in parts), exact.D
        )

    restructurer = GrayBoxRestructurer(structure, norm=norm)
    models = [noisy() for _ in range(n)]
    found = np.array(
        [
            restructurer.fit_model(model, starts=[theta], search=False).params_
            for model in models
        ]
    )
    fitted = restructurer.fit_model(exact, realizations=models)
    single = np.sqrt(np.diag(fitted.params_covariance_) * n)
    # all but D, which is exact
    assert_allclose(single[:3], found.std(0, ddof=1)[:3], rtol=0.35)


def test_confidence_intervals_are_those_of_student():
    """Of a gain the mean is the optimum in any norm."""
    d = np.array([2.9, 3.0, 3.3])
    runs = [StateSpace([], [], [], [[x]]) for x in d]
    mean = StateSpace([], [], [], [[d.mean()]])
    fitted = GrayBoxRestructurer(GAIN).fit_model(mean, realizations=runs)
    table = fitted.confidence_intervals(0.9)
    low, high = student.interval(0.9, 2, d.mean(), d.std(ddof=1) / np.sqrt(3))
    assert_allclose(table.loc["d"], [d.mean(), low, high], rtol=1e-6)
    with pytest.raises(ValueError, match="`confidence` must be between"):
        fitted.confidence_intervals(95)
    with pytest.raises(ValueError, match="need the covariance"):
        fitted.fit_model(mean).confidence_intervals()


@pytest.mark.parametrize("norm", ["hinf", "h2", "similarity"])
def test_noise_of_a_feedthrough_that_is_dropped_moves_no_parameter(norm):
    runs = [StateSpace(-2, 3, 1, e) for e in (-0.1, 0.0, 0.1)]
    fitted = GrayBoxRestructurer(LAG, norm=norm)
    fitted.fit_model(runs[1], realizations=runs)
    assert_allclose(fitted.params_covariance_, 0.0, atol=1e-20)


@pytest.mark.parametrize("norm", ["hinf", "h2", "similarity"])
def test_a_parameter_at_its_bound_has_no_variance(norm, rough):
    bounded = LAG.with_bounds({"a": (2.5, None)})
    runs = [StateSpace(-2 + e, 3, 1) for e in (-0.1, 0.0, 0.1)]
    fitted = GrayBoxRestructurer(bounded, norm=norm)
    fitted.fit_model(runs[1], realizations=runs)
    assert_allclose(fitted.params_[0], 2.5, rtol=1e-12)
    variance = np.diag(fitted.params_covariance_)
    assert variance[0] == 0 < variance[1]


@pytest.mark.parametrize("norm", ["hinf", "h2", "similarity"])
def test_parameters_of_which_only_the_product_is_seen_have_infinite_variances(norm):
    product = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    runs = [StateSpace(-2 + e, 3 - e, 1) for e in (-0.1, 0.0, 0.2)]
    fitted = GrayBoxRestructurer(product, norm=norm)
    with pytest.warns(RankWarning, match="determines 2 of the 3 parameters"):
        fitted.fit_model(runs[1], realizations=runs)
    variance = np.diag(fitted.params_covariance_)
    assert 0 < variance[0] < np.inf and np.isinf(variance[1:]).all()
    table = fitted.confidence_intervals()
    assert_allclose(table.loc["b", ["lower", "upper"]], [-np.inf, np.inf])


def test_restarts_from_perturbations_agree():
    structure, params = CASES["two_masses"]
    black_box = structure.model(params)
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    table = fitted.perturbation_check(black_box, n_restarts=2)
    assert table.shape == (2, 7)
    assert (table.drop(columns="error_").abs() < 1e-6).all(axis=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"solver": "bundle", "max_iter": 1000},
        {"norm": "h2"},
        {"norm": "similarity"},
    ],
    ids=["sqp", "bundle", "h2", "similarity"],
)
def test_bounds_are_respected_and_touched(options, rough):
    structure, params = CASES["two_masses"]
    black_box = structure.model(params)
    bounded = structure.with_bounds({"k1": (None, 25.0), "b": (0.0, None)})
    fitted = GrayBoxRestructurer(bounded, **options).fit_model(black_box)
    found = dict(zip(structure.parameter_names, fitted.params_, strict=True))
    assert np.isclose(found["k1"], 25.0, rtol=1e-9) and found["k1"] <= 25.0
    assert found["b"] > 0


def test_bounded_optimum_is_a_minimum_within_the_bounds(rough):
    structure, params = CASES["spring_mass"]
    black_box = structure.model(params)
    bounded = structure.with_bounds({"k": (None, 8.0)})
    fitted = GrayBoxRestructurer(bounded).fit_model(black_box)
    assert fitted.stationarity_ < 1e-5
    rng = np.random.default_rng(0)
    for _ in range(40):
        near = fitted.params_ * (1 + 1e-3 * rng.normal(size=3))
        near = np.clip(near, bounded.lower, bounded.upper)
        error = (structure.model(near) - black_box).hinf_norm()
        assert error >= fitted.error_ * (1 - 1e-9)


def test_fixed_parameters_stay():
    structure, params = CASES["two_masses"]
    fixed = structure.fix({"k3": params["k3"]})
    fitted = GrayBoxRestructurer(fixed).fit_model(structure.model(params))
    others = [v for k, v in sorted(params.items()) if k != "k3"]
    np.testing.assert_allclose(fitted.params_, others, rtol=1e-6)


def test_known_ranges_replace_a_first_guess():
    def oscillator(p):
        period, quality = p
        w = 2 * np.pi / period
        return [[0, 1], [-(w**2), -w / quality]], [[0], [w**2]], [[1, 0]]

    structure = GrayBoxStructure.from_function(
        oscillator, {"period": 20.0, "quality": 1.0}
    ).with_ranges({"period": (0.1, 50.0), "quality": (0.5, 100.0)})
    truth = [0.7, 12.0]
    fitted = GrayBoxRestructurer(structure).fit_model(structure.model(truth))
    np.testing.assert_allclose(fitted.params_, truth, rtol=1e-6)


def unstable():
    return StateSpace([[0.5]], [[1.0]], [[1.0]])


GOOD = CASES["spring_mass"][0].model(CASES["spring_mass"][1])
ERRORS = [
    (lambda: GrayBoxRestructurer().fit_model(unstable()), "must be stable.*0.5"),
    (lambda: GrayBoxRestructurer().fit_model([[1.0]]), "must be a StateSpace.*list"),
    (
        lambda: GrayBoxRestructurer(two_masses()).fit_model(GOOD),
        "2 outputs and 1 inputs, `model` has 1 and 1",
    ),
    (lambda: GrayBoxRestructurer("pendulum").fit_model(GOOD), "GrayBoxStructure.*str"),
    (
        lambda: GrayBoxRestructurer(norm="l1").fit_model(GOOD),
        r"`norm` must be .*Got 'l1'",
    ),
    (
        lambda: GrayBoxRestructurer(solver="adam").fit_model(GOOD),
        r"`solver` must be .*Got 'adam'",
    ),
    (
        lambda: GrayBoxRestructurer(init="random").fit_model(GOOD),
        "`init` must be 'similarity' or a vector",
    ),
    (
        lambda: GrayBoxRestructurer(spring_structure(), init=[1.0]).fit_model(GOOD),
        r"`init` must be 3 finite values \(b, c, k",
    ),
    (
        lambda: GrayBoxRestructurer(frequency_weight=(3, 1)).fit_model(GOOD),
        "0 <= low < high",
    ),
    (
        lambda: GrayBoxRestructurer(frequency_weight="low").fit_model(GOOD),
        "`frequency_weight` must be a StateSpace or a band",
    ),
    (
        lambda: GrayBoxRestructurer(frequency_weight=unstable()).fit_model(GOOD),
        "`frequency_weight` must be stable",
    ),
    (
        lambda: GrayBoxRestructurer(spring_structure(), norm="similarity").fit_model(
            GOOD - StateSpace([[-3.0]], [[0.1]], [[0.1]])
        ),
        "needs an affine structure of the order",
    ),
    (
        lambda: GrayBoxRestructurer(norm="covariance").fit_model(GOOD),
        "needs `estimates`",
    ),
    (
        lambda: GrayBoxRestructurer(norm="covariance").fit_model(GOOD, estimates=None),
        "needs `estimates`.*Got none",
    ),
    (
        lambda: GrayBoxRestructurer(norm="covariance").fit_model(GOOD, estimates=3),
        "`estimates` must be a list. Got int",
    ),
    (
        lambda: GrayBoxRestructurer(
            norm="covariance", frequency_weight=(None, 1.0)
        ).fit_model(GOOD, estimates=[(GOOD, [])]),
        "`frequency_weight` must be None",
    ),
    (
        lambda: GrayBoxRestructurer(spring_structure(), norm="h2").fit(
            [1.0], [[1.0, 0.0]]
        ),
        "`norm` must be 'hinf'",
    ),
    (
        lambda: GrayBoxRestructurer(spring_structure()).fit(
            [1.0], [[1.0, 0.0]], sample_weight=[-1.0]
        ),
        "`sample_weight` must hold 1 weights, one for each frequency",
    ),
    (
        lambda: GrayBoxRestructurer().fit([1.0, 2.0], [[1.0, 0.0], [1.0, 0.0]]),
        "`structure` must be given",
    ),
    (
        lambda: GrayBoxRestructurer(spring_structure()).fit([1.0, 2.0], [[1.0], [2.0]]),
        r"`frf` must have shape \(2, 2\)",
    ),
    (
        lambda: GrayBoxRestructurer(spring_structure()).fit(
            [1.0, 1.0], [[1.0, 0.0], [1.0, 0.0]]
        ),
        "every frequency once",
    ),
]


@pytest.mark.parametrize(("call", "words"), ERRORS)
def test_errors_teach(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_scikit_learn_conventions():
    structure, params = CASES["spring_mass"]
    restructurer = GrayBoxRestructurer(structure, n_starts=4)
    with pytest.raises(NotFittedError):
        restructurer.predict([1.0])
    copy = clone(restructurer)
    assert copy.get_params()["n_starts"] == 4
    fitted = copy.fit_model(structure.model(params))
    again = pickle.loads(pickle.dumps(fitted))
    omega = np.array([0.1, 1.0, 10.0])
    np.testing.assert_array_equal(fitted.predict(omega), again.predict(omega))
    assert not hasattr(restructurer, "params_")


@pytest.mark.slow
def test_result_is_reproducible(rough):
    black_box, fitted = far_fit(1)
    first, second = (
        clone(fitted).set_params(random_state=1).fit_model(black_box) for _ in range(2)
    )
    np.testing.assert_array_equal(first.params_, second.params_)


def test_neighbours_on_a_measured_grid_are_both_active(rough):
    driven = StateSpace(
        [[0, 1, 0], [-1, -0.1, 1], [0, 0, -30]], [[0], [0], [30]], [[1, 0, 0]]
    )
    spring = spring_structure()
    omega = np.geomspace(0.1, 100, 60)
    G = driven.frequency_response(omega)
    fitted = GrayBoxRestructurer(spring).fit(omega, G)

    def error(params):
        E = spring.model(params).frequency_response(omega) - G
        return np.abs(E).max()

    assert np.isclose(fitted.error_, error(fitted.params_), rtol=1e-12)
    assert fitted.stationarity_ < 1e-6 and fitted.second_order_ > 0
    places = np.searchsorted(omega, fitted.active_frequencies_)
    assert np.diff(places).tolist() == [1]
    exact = GrayBoxRestructurer(spring).fit_model(driven)
    assert fitted.error_ < error(exact.params_)
    rng = np.random.default_rng(0)
    for size in (1e-2, 1e-4, 1e-6):
        for _ in range(20):
            near = fitted.params_ * (1 + size * rng.normal(size=3))
            assert error(near) >= fitted.error_ * (1 - 1e-9)


# -- what a restructuring must survive ---------------------------------------------

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


def squared_gain(theta):
    return [[-theta[0]]], [[theta[0]]], [[1 + theta[1] ** 2]]


@pytest.mark.parametrize("interval", [(0, None), (None, 0), (None, None)])
def test_a_gain_at_its_turning_point_is_no_floor(interval):
    """1 + q^2 begun at q = 0, where its derivative vanishes, at a bound or not."""
    squared = GrayBoxStructure.from_function(squared_gain, {"a": 1.0, "q": 0.0})
    squared = squared.with_bounds({"q": interval})
    fitted = GrayBoxRestructurer(squared).fit_model(StateSpace(-2, 2, 3))
    assert_allclose(np.abs(fitted.params_), [2, np.sqrt(2)], rtol=1e-6)
    assert fitted.lower_bound_ == fitted.structural_floor_ == 0


@pytest.mark.filterwarnings("ignore:the values of")
def test_the_peaks_below_a_floor_are_equally_high(rough):
    """What is left below the floor is minimised, and told, without any weight."""
    unit = GrayBoxStructure.from_template(
        [[0, 1, 0, 0], ["-k", "-c", 0, 0], [0, 0, 0, 1], ["h", 0, "-h", "-d"]],
        [[0], ["k"], [0], [0]],
        [[0, 0, 1, 0]],
    )
    model = unit.model({"k": 4.0, "c": 4.0, "h": 100.0, "d": 15.0})
    rough_A = model.A * (1 + 0.02 * np.random.default_rng(0).normal(size=(4, 4)))
    off = StateSpace(rough_A, model.B, model.C)
    off = StateSpace(rough_A, 1.05 * model.B / off.dc_gain(), model.C)
    fitted = GrayBoxRestructurer(unit).fit_model(off)
    error = StateSpace(
        block_diag(fitted.lti_.A, off.A),
        np.vstack([fitted.lti_.B, off.B]),
        np.hstack([fitted.lti_.C, -off.C]),
    )
    peaks = peak_gains(error, within=0.9999)
    moving = peaks.values[peaks.frequencies > 0]
    assert_allclose(fitted.structural_floor_, peaks.norm, rtol=1e-9)
    assert_allclose(fitted.remaining_error_, moving.max(), rtol=1e-6)
    assert_allclose(moving, moving[0], rtol=1e-4)
    assert len(moving) == 2


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


@cache
def restructured_driven(gain=1.0, rate=1.0):
    structure = GrayBoxStructure.observable_canonical(2, 1, 1, feedthrough=False)
    return GrayBoxRestructurer(structure).fit_model(driven(gain, rate))


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize(
    "gain, rate",
    [(1e-9, 1.0), (1e9, 1.0), (1.0, 1e-9), (1.0, 1e9), (1e9, 1e9), (1e-9, 1e9)],
)
def test_units_change_nothing(gain, rate):
    one, other = restructured_driven(), restructured_driven(gain, rate)
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


@pytest.mark.parametrize(
    "outputs, unit",
    [
        ("position", 1e-6),
        ("position", 1e6),
        ("velocity", 1.0),
        ("acceleration", 1e-6),
        ("acceleration", 1.0),
    ],
)
def test_unknown_masses_are_found_from_nothing(outputs, unit):
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


def test_h2_optima_at_bounds_are_certified(rough):
    spring = spring_structure()
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


@pytest.mark.parametrize("seed", range(2))
def test_an_error_at_its_lower_bound_is_optimal(seed):
    """Reduction by one order, with D free: Glover's bound is attained, all-pass."""
    box = stable_model(seed, order=6)
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


def test_a_delay_is_left_out_and_put_back():
    structure = spring_structure()
    box = structure.model([30.0, 1.2, 40.0])
    late = box.with_input_delay(0.1)
    found = GrayBoxRestructurer(structure).fit_model(late)
    plain = GrayBoxRestructurer(structure).fit_model(box)
    np.testing.assert_array_equal(found.params_, plain.params_)
    np.testing.assert_array_equal(found.lti_.input_delay, [0.1])
    assert (found.lti_ - late).hinf_norm() < 1e-6
    with pytest.raises(ValueError, match="models of one `input_delay`"):
        GrayBoxRestructurer(structure).fit_model([box, late])
    with pytest.raises(ValueError, match="`frequency_weight` must be without delay"):
        weight = StateSpace(-1, 1, 1, input_delay=0.1)
        GrayBoxRestructurer(structure, frequency_weight=weight).fit_model(box)


# -- interchangeable parts -------------------------------------------------------------


def test_parts_of_a_fit_can_change_places():
    modes = GrayBoxStructure.modal(2)
    box = modes.model([1.0, 0.2, 2.0, 0.3, 0.4, 1.0, 4.0, 30.0])
    near = StateSpace(box.A, 1.01 * box.B, box.C)
    fitted = GrayBoxRestructurer(modes).fit_model(box, realizations=[box, near])
    places = [2, 3, 0, 1, 5, 4, 7, 6]
    other = fitted.interchanged(places)
    np.testing.assert_array_equal(other.params_, fitted.params_[places])
    np.testing.assert_array_equal(
        other.params_covariance_, fitted.params_covariance_[np.ix_(places, places)]
    )
    assert (other.lti_ - fitted.lti_).hinf_norm() < 1e-12
    assert other.error_ == fitted.error_
    np.testing.assert_array_equal(other.interchanged(places).params_, fitted.params_)
    with pytest.raises(ValueError, match="`places` must hold every index from 0 to 7"):
        fitted.interchanged([0, 0, 1, 2, 3, 4, 5, 6])


def test_a_fit_without_search_stays_in_the_basin_of_its_start():
    modes = GrayBoxStructure.modal(2)
    truth = np.array([1.0, 0.2, 2.0, 0.3, 0.4, 1.0, 4.0, 30.0])
    box = modes.model(truth)
    for start in (truth, truth[[2, 3, 0, 1, 5, 4, 7, 6]]):
        found = GrayBoxRestructurer(modes).fit_model(
            box, starts=[1.05 * start], search=False
        )
        np.testing.assert_allclose(found.params_, start, rtol=1e-6)
    with pytest.raises(
        ValueError, match="`starts` must hold parameters where `search`"
    ):
        GrayBoxRestructurer(modes).fit_model(box, search=False)


# -- what cannot be fitted -------------------------------------------------------------


def test_a_structure_without_parameters_is_a_model():
    nothing = GrayBoxStructure.from_template([[-1]], [[1]], [[1]])
    box = StateSpace(-1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="`structure` must have a parameter"):
        GrayBoxRestructurer(nothing).fit_model(box)
    with pytest.raises(ValueError, match="`structure` must have a parameter"):
        GrayBoxRestructurer(nothing).fit([1.0, 2.0], np.ones((2, 2)))


def test_a_fit_that_fails_leaves_no_attribute():
    lag = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]], [["a"]])
    good, bad = lag.model([2.0, 3.0]), StateSpace(-2.0, 1.0, 1.0, 5.0)
    fitted = GrayBoxRestructurer(lag, norm="h2")
    with pytest.raises(ValueError, match="without feedthrough"):
        fitted.fit_model(bad)
    assert not [name for name in vars(fitted) if name.endswith("_")]
    before = dict(vars(fitted.fit_model(good)))
    with pytest.raises(ValueError, match="without feedthrough"):
        fitted.fit_model(bad)
    after = vars(fitted)
    assert after.keys() == before.keys()
    assert all(after[name] is value for name, value in before.items())


@pytest.mark.parametrize("norm", ["covariance", "hinf"])
@pytest.mark.parametrize("std", [0.1, 1e-3])
def test_a_stall_matters_where_its_end_is_used_or_nothing_else_confirms_it(
    norm, std, monkeypatch
):
    """Efficient parameters that the noise explains do not hang on its last digits."""

    def stalled(*args, **options):
        theta, result, floor = minimise_hinf(*args, **options)
        return theta, replace(result, stationarity=2e-3, converged=False), floor

    monkeypatch.setattr(estimator, "minimise_hinf", stalled)
    lag = GrayBoxStructure.from_template([["-a"]], [[2]], [[1]])
    box, step = StateSpace(-2.0, 2.1, 1.0), DEVIATION * std
    pairs = [
        (StateSpace(-2.0 + step, 2.1, 1.0), StateSpace(-2.0 - step, 2.1, 1.0)),
        (StateSpace(-2.0, 2.1 + step, 1.0), StateSpace(-2.0, 2.1 - step, 1.0)),
    ]
    given = {"estimates": [(box, pairs)]} if norm == "covariance" else {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fitted = GrayBoxRestructurer(lag, norm=norm).fit_model(box, **given)
    told = any("the search stalled" in str(w.message) for w in caught)
    assert told == (norm == "hinf" or std < 0.1)
    assert fitted.convergence_ == "no"
    if norm == "covariance":
        assert (fitted.p_value_ > 0.1) == (std == 0.1)


def test_a_parameter_of_zero_is_perturbed_too():
    structure = GrayBoxStructure.from_template(
        A=[["-a"]],
        B=[["b"]],
        C=[[1]],
        D=[["d"]],
    )
    truth = structure.model([2.0, 3.0, 0.0])
    fit = GrayBoxRestructurer(structure).fit_model(truth)
    fit.params_ = np.array([2.0, 3.0, 0.0])
    found = fit.perturbation_check(truth, n_restarts=3)
    assert np.abs(found.to_numpy()).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("signs", [(1, 1, -1), (1, -1, 1), (-1, 1, 1)])
def test_signs_that_nothing_tells_are_tried(signs):
    """M = I + p p.T: first guesses of one sign, and no factor leads to others."""
    w = 2 * np.pi * 6.0 * np.array([1.0, 6.27, 17.5])
    drive, show = np.array([0.1, 0.5, 1.1]), np.array([2.0, -2.0, 2.0])

    def matrices(p):
        M = np.linalg.inv(np.eye(3) + np.outer(p, p))
        zero, D = np.zeros((3, 3)), np.diag(0.016 * w)
        A = np.block([[zero, np.eye(3)], [-M @ np.diag(w**2), -M @ D]])
        B = np.append(np.zeros(3), M @ drive)[:, None]
        return A, B, np.append(np.zeros(3), show)[None], np.zeros((1, 1))

    guess = {"p1": 0.3, "p2": 0.3, "p3": 0.3}
    structure = GrayBoxStructure.from_function(matrices, guess)
    true = np.array(signs) * [0.65, 0.35, 0.72]
    model = GrayBoxRestructurer(structure).fit_model(StateSpace(*matrices(true)[:3]))
    assert model.relative_error_ < 1e-9


# -- what may be wrong with a structure ------------------------------------------------

MOTOR = {"J": 4e-5, "L": 2e-3, "R": 1.1, "b": 2e-4, "k": 0.06}


def motor(back="-k"):
    """Voltage, current and speed; `back` is what the speed does to the current."""
    return GrayBoxStructure.from_template(
        E=[["L", 0], [0, "J"]],
        A=[["-R", back], ["k", "-b"]],
        B=[[1], [0]],
        C=[[1, 0], [0, 1]],
    )


def test_a_mass_that_is_negative_by_a_wrong_sign_is_told():
    box, wrong = motor().model(MOTOR), motor(back="k")
    with pytest.warns(UserWarning, match="`E` is not positive with J = -4e-05"):
        found = GrayBoxRestructurer(wrong).fit_model(box)
    assert found.relative_error_ < 1e-9
    # it is meant, and what bounds exclude is no point to begin from
    meant = wrong.with_bounds({"J": (None, 0)})
    assert np.isfinite(meant.matrices(meant.reference)[0]).all()
    found = GrayBoxRestructurer(meant).fit_model(box)  # a warning would be an error
    assert found.relative_error_ < 1e-9


def test_a_misfit_tells_of_bounds_and_of_the_feedthrough_that_is_left_out():
    def known(at_once):
        """A black box, and models a hundredth of a standard deviation from it."""
        box = motor().model(MOTOR)
        box = StateSpace(box.A, box.B, box.C, [[at_once], [0.0]])
        pairs = []
        for part in "ABCD":
            for place in np.ndindex(getattr(box, part).shape):
                size = 1e-3 * max(abs(getattr(box, part)[place]), 1.0)
                around = []
                for step in (DEVIATION * size, -DEVIATION * size):
                    matrices = {name: getattr(box, name).copy() for name in "ABCD"}
                    matrices[part][place] += step
                    around.append(StateSpace(**matrices))
                pairs.append(tuple(around))
        return box, pairs

    bounded = motor().with_bounds({"k": (0.07, 0.2)})
    cases = (
        (motor(), 0.1, r"The black box has D\[0\]\[0\], more than"),
        (bounded, 0.0, "At their bounds stand k"),
    )
    for structure, at_once, told in cases:
        box, pairs = known(at_once)
        search = GrayBoxRestructurer(structure, norm="covariance")
        with pytest.warns(UserWarning, match=f"as its noise explains .*{told}"):
            search.fit_model(box, estimates=[(box, pairs)])


def test_a_search_that_ends_where_nothing_moves_is_told():
    spring = GrayBoxStructure.from_template(
        E=[[1, 0], [0, "m"]], A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[0, 1]]
    )
    box = spring.model({"m": 1.0, "c": 0.1, "k": 1.0})
    search = GrayBoxRestructurer(spring)
    with pytest.warns(ConvergenceWarning, match="comes no nearer than 1e.02 %"):
        search.fit_model(box, starts=[[1e30, 1e30, 1e30]], search=False)
