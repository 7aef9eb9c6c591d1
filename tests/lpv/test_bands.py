"""Bands of simulated outputs: exact where outputs are linear in the coefficients."""

from dataclasses import replace

import numpy as np
import pytest

from lpvlearn import GrayBoxStructure, LPVStateSpace, PolynomialLPV, SplineLPV
from lpvlearn.lpv.bands import left_out_errors, levels_of, simulation_std
from lpvlearn.lpv.refinement import Own, Prior, Record, refine, with_rate_terms
from lpvlearn.lpv.sensitivity import coefficients_of, with_coefficients

from ..conftest import spring_lpv
from .test_sensitivity import MODELS, STEP, trajectory

REST = Own(initial_state=False, constant=False)


def random_covariance(n, scale=1e-3, seed=0):
    F = scale * np.random.default_rng(seed).normal(size=(n, n))
    return F @ F.T


def gain_model(form=None):
    """A lag whose gain is a parabola: outputs are linear in the coefficients."""
    structure = GrayBoxStructure.from_template([[-2]], [["b"]], [[1]])
    kappa = np.linspace(0, 1, 4)[:, None]
    form = (form or PolynomialLPV(2)).fit(kappa, 1 + kappa**2)
    return LPVStateSpace(structure, form, kappa[[0, -1]])


def columns_of(model, u, kappa):
    """Derivatives (n_samples, n_coefficients) of outputs that are linear."""
    n = len(coefficients_of(model))
    units = [with_coefficients(model, unit) for unit in np.eye(n)]
    return np.hstack([one.simulate(u, kappa, STEP) for one in units])


@pytest.mark.parametrize("form", [PolynomialLPV(2), SplineLPV("cubic")])
def test_linear_outputs_have_exact_deviations(form):
    model = gain_model(form)
    u, kappa = trajectory(model, 99)
    J = columns_of(model, u, kappa)
    P = random_covariance(J.shape[1])
    std = simulation_std(replace(model, covariance=P), u, kappa, STEP)
    np.testing.assert_allclose(std[:, 0] ** 2, np.sum((J @ P) * J, axis=1), atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("rates", [False, True])
def test_deviations_are_those_of_draws(name, rates):
    model = with_rate_terms(MODELS[name]())[0] if rates else MODELS[name]()
    u, kappa = trajectory(model)
    c = coefficients_of(model)
    P = random_covariance(len(c), 1e-3)
    std = simulation_std(replace(model, covariance=P), u, kappa, STEP)
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(len(c)), P, 80)
    y = np.array(
        [
            with_coefficients(model, c + sign * d).simulate(u, kappa, STEP)
            for d in draws
            for sign in (1, -1)
        ]
    )
    moved = std > 1e-3 * std.max()
    ratio = y.var(axis=0)[moved] / std[moved] ** 2
    assert abs(ratio.mean() - 1) < 0.3  # its deviation is 0.16 at most


def test_nothing_uncertain_has_no_band():
    model = replace(spring_lpv(), covariance=np.zeros((9, 9)))
    u, kappa = trajectory(model)
    assert not simulation_std(model, u, kappa, STEP).any()
    assert not model.parameters(kappa, return_std=True)[1].any()
    assert not model.frequency_response_std(0.5, [1.0, 5.0]).any()


def test_units_scale_bands():
    """Outputs in millimetres, and stiffness in thousands."""
    P = random_covariance(9)
    plain = replace(spring_lpv(), covariance=P)
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-1000 * k", "-c"]], [[0], ["b"]], [[1000, 0]]
    )
    order = [
        structure.parameter_names.index(n) for n in plain.structure.parameter_names
    ]
    theta = plain.parameters([0.0, 0.7, 1.5])
    units = np.array([1.0, 1.0, 1e-3])
    assert list(plain.structure.parameter_names) == ["b", "c", "k"]
    assert order == [0, 1, 2]
    form = PolynomialLPV(2).fit([[0.0], [0.7], [1.5]], theta * units)
    T = np.tile(units, 3)
    changed = LPVStateSpace(
        structure, form, [[0.0], [1.5]], covariance=P * T[:, None] * T
    )
    u, kappa = trajectory(plain)
    np.testing.assert_allclose(
        simulation_std(changed, u, kappa, STEP),
        1000 * simulation_std(plain, u, kappa, STEP),
        rtol=1e-9,
        atol=1e-15,
    )


def test_a_change_of_basis_changes_no_band():
    plain = replace(spring_lpv(), covariance=random_covariance(9))
    moved = plain.change_basis(lambda kappa: np.diag([1, 2 + kappa[0]]))
    u, kappa = trajectory(plain)
    np.testing.assert_allclose(
        simulation_std(moved, u, kappa, STEP), simulation_std(plain, u, kappa, STEP)
    )


def slow(n, rng):
    """An error of the slowest tenth of frequencies, of size 1."""
    smooth = np.convolve(rng.normal(size=n + 40), np.hanning(41), "valid")[:, None]
    return smooth / smooth.std()


@pytest.mark.parametrize("share", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_noise_is_told_from_the_models_own_error(share, scale):
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        errors = [
            scale * (rng.normal(size=(2000, 1)) + share * slow(2000, rng))
            for _ in range(2)
        ]
        found.append(np.hstack(levels_of(errors)) / scale)
    error, noise = np.sqrt(np.mean(np.square(found), axis=0))
    assert abs(noise - 1) < 0.05
    assert abs(error - share) < 0.1 * share + 0.2


def test_short_records_and_exact_ones():
    error = np.array([[1.0], [-1.0], [1.0], [1.0]])
    assert np.hstack(levels_of([error])).tolist() == [1.0, 0.0]
    assert np.hstack(levels_of([0 * error])).tolist() == [0.0, 0.0]


def test_left_out_errors_are_those_of_fits_without():
    model, rng = gain_model(), np.random.default_rng(0)
    records, columns = [], []
    for seed in range(3):
        u, kappa = trajectory(model, 120, seed)
        y = model.simulate(u, kappa, STEP) + 0.1 * rng.normal(size=(120, 1))
        records.append(Record(u, y, kappa, STEP))
        columns.append(columns_of(model, u, kappa))
    found = refine(model, records, REST)
    left_out = left_out_errors(found, records, REST)
    quarter = np.arange(120) // 30
    folds = np.concatenate([quarter, 4 + quarter, quarter])
    J, y = np.vstack(columns), np.vstack([r.y for r in records])[:, 0]
    expected = np.empty(len(y))
    for fold in range(8):
        out = folds == fold
        c = np.linalg.lstsq(J[~out], y[~out], rcond=None)[0]
        expected[out] = (J @ c - y)[out]
    np.testing.assert_allclose(np.vstack(left_out)[:, 0], expected, atol=1e-6)


def test_left_out_stretches_count_the_prior_and_the_own_unknowns():
    """With a prior that knows all, nothing is lost by leaving out."""
    model, rng = spring_lpv(), np.random.default_rng(0)
    u, kappa = trajectory(model, 210)
    y = model.simulate(u, kappa, STEP, [0.1, 0.0]) + 0.5
    record = Record(u, y + 1e-3 * rng.normal(size=y.shape), kappa, STEP)
    own = Own(initial_state=True, constant=True)
    prior = Prior(coefficients_of(model), 1e12 * np.eye(9))
    found = refine(model, [record], own, prior)
    (left_out,) = left_out_errors(found, [record], own)
    surer = prior._replace(information=1e20 * np.eye(9))
    (in_sample,) = left_out_errors(found._replace(prior=surer), [record], own)
    np.testing.assert_allclose(left_out, in_sample, atol=1e-8)
    assert left_out.std() < 1.1e-3
    free = refine(model, [record], own)
    (without,) = left_out_errors(free, [record], own)
    assert np.mean(without**2) > np.mean(in_sample**2)
