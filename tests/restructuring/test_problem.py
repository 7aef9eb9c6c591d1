"""What is matched, behind weights."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.models.statespace import DEVIATION
from lpvlearn.restructuring import estimator as estimator_module
from lpvlearn.restructuring.problem import agreeing, problem_from_models
from lpvlearn.restructuring.starts import Search

from ..conftest import spring_structure
from .conftest import CASES, disguised, far_fit, off_structure


def test_feedthrough_that_the_structure_lacks_is_reported():
    structure, params = CASES["spring_mass"]
    model = structure.model(params)
    black_box = StateSpace(model.A, model.B, model.C, [[0.25]])
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    np.testing.assert_array_equal(fitted.dropped_feedthrough_, [[0.25]])
    np.testing.assert_allclose(
        fitted.params_, structure.check_params(params), rtol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["band", "scalar", "matrix"])
def test_weighted_error_is_the_norm_of_the_weighted_difference(kind, rough):
    black_box, plain = far_fit(2)
    low = StateSpace([[-2.0]], [[2.0]], [[1.0]])
    pair = StateSpace(-2 * np.eye(2), 2 * np.eye(2), np.diag([1.0, 0.1]))
    weight = {"band": (None, 2.0), "scalar": low, "matrix": pair}[kind]
    fitted = clone(plain).set_params(frequency_weight=weight).fit_model(black_box)
    omega = np.geomspace(1e-3, 1e3, 4000)
    E = (fitted.lti_ - black_box).frequency_response(omega)
    W = (pair if kind == "matrix" else low).frequency_response(omega)
    sigma = np.linalg.norm(W @ E if kind == "matrix" else W * E, 2, axis=(1, 2))
    assert np.isclose(fitted.error_, sigma.max(), rtol=1e-3)
    E = (plain.lti_ - black_box).frequency_response(omega)
    sigma = np.linalg.norm(W @ E if kind == "matrix" else W * E, 2, axis=(1, 2))
    assert fitted.error_ <= sigma.max() * (1 + 1e-6)


def test_one_weight_serves_all_measured_outputs():
    structure, params = CASES["two_masses"]
    omega = np.geomspace(0.1, 20, 40)
    G = structure.model(params).frequency_response(omega)
    square = StateSpace(-5 * np.eye(2), 5 * np.eye(2), np.eye(2))
    fits = [
        GrayBoxRestructurer(structure, frequency_weight=weight).fit(omega, G)
        for weight in ((None, 5.0), square)
    ]
    for fitted in fits:
        np.testing.assert_allclose(
            fitted.params_, structure.check_params(params), rtol=1e-6
        )


def test_weights_of_the_samples_decide_between_frequencies(rough):
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    omega = np.array([0.1, 0.2, 0.5, 20.0, 40.0])
    G = np.where(omega < 1, 1.0 / (1j * omega + 1), 3.0 / (1j * omega + 2))
    trusted = np.where(omega < 1, 1.0, 1e-6)
    fitted = GrayBoxRestructurer(structure).fit(omega, G, sample_weight=trusted)
    np.testing.assert_allclose(fitted.params_, [1.0, 1.0], rtol=1e-3)


def test_several_models_of_one_point_are_matched_together(rough):
    structure, params = CASES["spring_mass"]
    theta = structure.check_params(params)
    rng = np.random.default_rng(0)
    exact = structure.model(theta)
    same = GrayBoxRestructurer(structure).fit_model([exact, disguised(exact, rng)])
    np.testing.assert_allclose(same.params_, theta, rtol=1e-6)
    boxes = [off_structure(exact, rng, 5e-3) for _ in range(3)]
    fitted = GrayBoxRestructurer(structure).fit_model(boxes)
    omega = np.geomspace(0.01, 100, 20000)
    stacked = np.concatenate(
        [(fitted.lti_ - box).frequency_response(omega) for box in boxes], axis=1
    )
    assert np.isclose(
        fitted.error_, np.linalg.norm(stacked, 2, axis=(1, 2)).max(), rtol=1e-4
    )


def test_hankel_singular_value_bounds_the_error_from_below(rough):
    structure, params = CASES["spring_mass"]
    truth = structure.model(params)
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = truth.A, -4.0
    black_box = StateSpace(A, np.vstack([truth.B, [[1]]]), np.hstack([truth.C, [[1]]]))
    fitted = GrayBoxRestructurer(structure).fit_model(black_box)
    hankel = black_box.hankel_singular_values()[2]
    assert fitted.lower_bound_ == hankel
    assert hankel <= fitted.error_


def test_table_and_complex_responses_are_the_same_data():
    structure, params = CASES["two_masses"]
    omega = np.geomspace(0.1, 30, 50)
    G = structure.model(params).frequency_response(omega)
    flat = G.reshape(50, -1)
    table = np.hstack([flat.real, flat.imag])
    one = GrayBoxRestructurer(structure).fit(omega[:, None], table)
    two = GrayBoxRestructurer(structure).fit(omega, G)
    np.testing.assert_array_equal(one.params_, two.params_)


# -- how far the black box itself is known --------------------------------------------


def test_the_uncertainty_is_the_spread_of_the_response():
    gain = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    box, std = gain.model([2.0, 3.0]), 0.05
    step = DEVIATION * std
    pairs = [(gain.model([2.0, 3.0 + step]), gain.model([2.0, 3.0 - step]))]
    problem = problem_from_models(gain, [box], None)

    def deviations(*known):
        return problem.with_deviations(*known).deviations

    assert np.isclose(deviations([], [(box, pairs)]), std / 3.0)
    assert np.isclose(deviations([], [(box, pairs)] * 4), std / 3.0 / 2.0)
    runs = [gain.model([2.0, 3.0 + d]) for d in (-0.1, 0.0, 0.1)]
    assert np.isclose(deviations(runs, []), 0.1 / np.sqrt(3) / 3.0)
    assert deviations([box], []) == 0.0


def test_an_output_of_small_numbers_must_be_met_as_well():
    lags = GrayBoxStructure.from_template(
        [["-a", 0], [0, "-b"]], [["c"], ["d"]], [[1, 0], [0, 1]]
    )
    box, exact = lags.model([1.0, 2.0, 1e3, 2e-3]), [1.0, 2.0, 1e3, 2e-3]
    runs = [lags.model([1.0, 2.0, 1e3 * x, 2e-3 * x]) for x in (0.98, 1.0, 1.02)]
    problem = problem_from_models(lags, [box], None).with_deviations(runs, [])
    fit = problem.fit(np.array(exact))._replace(relative_error=1e-3)
    assert problem.is_exact(fit)
    off = fit._replace(x=np.array([1.0, 2.0, 1e3, -2e-3]))  # a millionth of all
    assert not problem.is_exact(off)


def test_fits_end_where_two_agree_or_the_error_is_the_black_boxs_own():
    structure = spring_structure()
    box = structure.model([30.0, 1.2, 50.0])
    scale = np.linspace(0.9, 1.1, 9)[:, None]
    starts = structure.check_params({"b": 30.0, "c": 1.2, "k": 50.0}) * scale
    exact = problem_from_models(structure, [box], None)
    assert len(exact.best_fits(starts, 3)) == 1
    rng = np.random.default_rng(0)
    problem = problem_from_models(structure, [off_structure(box, rng, 3e-4)], None)
    fits = problem.best_fits(starts, 3)
    assert 1e-8 < fits[0].relative_error < 3e-3
    assert len(fits) == agreeing(fits) == 2
    known = replace(problem, deviations=np.array([2e-3]))
    assert len(known.best_fits(starts, 3)) == 1


def test_a_fit_that_no_other_round_confirms_is_told(monkeypatch):
    structure = spring_structure()
    truth = structure.model([30.0, 1.2, 50.0])
    box = off_structure(truth, np.random.default_rng(0), 3e-4)

    def search(problem, *_):
        fit = problem.fit(structure.check_params({"b": 30.0, "c": 1.2, "k": 50.0}))
        other = fit._replace(cost=4 * fit.cost, relative_error=2 * fit.relative_error)
        return Search(problem, [fit, other], certain)

    monkeypatch.setattr(estimator_module, "starts_of", search)
    certain = False
    with pytest.warns(ConvergenceWarning, match="one round .* alone .* 1 of 2"):
        GrayBoxRestructurer(structure).fit_model(box)
    certain = True  # nothing is told
    GrayBoxRestructurer(structure).fit_model(box)


@pytest.mark.parametrize(
    "other",
    [
        StateSpace(-1.0, np.ones((1, 2)), 1.0),
        StateSpace(0.5, 1.0, 1.0, sampling_time=0.1),
    ],
)
def test_realizations_are_models_of_the_same_channels_and_time(other):
    box = spring_structure().model([30.0, 1.2, 50.0])
    with pytest.raises(
        ValueError, match="`realizations` must have 1 outputs, 1 inputs"
    ):
        GrayBoxRestructurer(spring_structure()).fit_model(
            box, realizations=[box, other]
        )


@pytest.mark.parametrize(("b", "c"), [(0.0, 1.0), (1e-200, 1e-150), (1e-160, 1.0)])
def test_a_black_box_of_no_response_is_refused(b, c):
    box = StateSpace([[0, 1], [-4, -0.5]], [[0], [b]], [[c, 0]])
    with pytest.raises(ValueError, match="must have a response that is not zero"):
        GrayBoxRestructurer(spring_structure()).fit_model(box)


def test_units_out_of_range_are_told():
    """No warning of NumPy comes before: they are errors here."""
    box, gray_box = spring_structure().model([30, 1.2, 40]), spring_structure()
    omega = np.geomspace(0.5, 50.0, 20)
    frf = box.frequency_response(omega)
    large = StateSpace(box.A, 1e100 * box.B, 1e100 * box.C)
    with pytest.raises(ValueError, match=r"gain .* below 1e\+20. Got .*e\+2"):
        GrayBoxRestructurer(gray_box).fit_model(large)
    with pytest.raises(ValueError, match=r"from 1e-60 to 1e\+20. Got .*e\+80"):
        GrayBoxRestructurer(gray_box).fit(omega, 1e80 * frf)
    with pytest.raises(ValueError, match="behind its weights.*e-100"):
        GrayBoxRestructurer(gray_box).fit(omega, frf, np.full(20, 1e-100))
    for gain in (1e-58, 1e18):
        restructurer = GrayBoxRestructurer(gray_box)
        restructurer.fit_model(StateSpace(box.A, gain * box.B, box.C))
        np.testing.assert_allclose(
            restructurer.params_, [30 * gain, 1.2, 40], rtol=1e-6
        )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::lpvlearn.exceptions.RankWarning")
def test_a_form_of_many_states_ends_where_its_coefficients_do():
    """What is left is rounding, though far above that of a response."""
    rng = np.random.default_rng(2)
    w, z = 10 ** rng.uniform(-0.75, 0.75, (2, 12))
    poles = w * np.exp(1j * (np.pi - np.arccos(np.minimum(0.03 * z, 0.5))))
    A = np.zeros((24, 24))
    for i, pole in enumerate(poles):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [
            [pole.real, pole.imag],
            [-pole.imag, pole.real],
        ]
    box = StateSpace(A, rng.normal(size=(24, 3)), rng.normal(size=(3, 24)))
    box = box.transform(rng.normal(size=(24, 24)))
    structure = GrayBoxStructure.observable_canonical(24, 3, 3)
    fitted = GrayBoxRestructurer(structure).fit_model(box)
    problem = problem_from_models(structure, [box], None)
    assert 1e-12 < fitted.relative_error_ <= problem.rounding(fitted.params_)
    assert fitted.n_iter_ == 0
