"""Output error on data that moves: what must hold exactly, and what on average."""

from dataclasses import replace

import numpy as np
import pytest
from joblib import Parallel

from lpvlearn import (
    GrayBoxStructure,
    LPVStateSpace,
    PolynomialLPV,
    SubspaceLTI,
)
from lpvlearn.exceptions import DivergenceError
from lpvlearn.lpv import refinement
from lpvlearn.lpv.refinement import (
    Own,
    Prior,
    Record,
    local_prior,
    refine,
    refine_with_rates,
    weights_of,
    with_rate_terms,
)
from lpvlearn.lpv.sensitivity import coefficients_of, with_coefficients

from ..conftest import spring_lpv, spring_structure

STEP = 0.05
REST, MOVING = Own(False, False), Own(True, False)


def record(model, n_samples=300, seed=0, noise=0.0, x0=None, offset=0.0, turns=2):
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (n_samples // 3 + 1, 1)).repeat(3, axis=0)[:n_samples]
    kappa = 0.75 - 0.75 * np.cos(np.linspace(0, turns * np.pi, n_samples))[:, None]
    y = model.simulate(u, kappa, STEP, x0) + offset
    return Record(u, y + noise * rng.normal(size=y.shape), kappa, STEP)


def perturbed(model, share=0.1, seed=0):
    c = coefficients_of(model)
    factors = 1 + share * np.random.default_rng(seed).normal(size=len(c))
    return with_coefficients(model, c * factors)


def test_exact_data_give_the_true_coefficients():
    truth = spring_lpv()
    records = [record(truth, seed=seed, x0=[0.3, -1.0]) for seed in (0, 1)]
    found = refine(perturbed(truth), records, MOVING)
    np.testing.assert_allclose(
        coefficients_of(found.model), coefficients_of(truth), rtol=1e-7, atol=1e-7
    )
    np.testing.assert_allclose(found.own, [[0.3, -1.0]] * 2, atol=1e-7)


@pytest.mark.slow
def test_exact_rate_terms_are_found():
    truth, kinematic = with_rate_terms(spring_lpv())
    c = coefficients_of(truth)
    rng = np.random.default_rng(2)
    c[len(c) - len(kinematic) :] = np.where(
        kinematic, 0.0, 0.5 * rng.normal(size=len(kinematic))
    )
    truth = with_coefficients(truth, c)
    records = [record(truth, seed=seed, turns=2 + seed) for seed in (0, 1)]
    start = replace(perturbed(spring_lpv()), rate_terms=None)
    found = refine_with_rates(
        start, records, REST, None, rate="auto", groups=[0, 1], max_iter=60
    )
    np.testing.assert_allclose(coefficients_of(found.model), c, atol=1e-5)


@pytest.mark.slow
def test_rate_terms_that_are_not_there_are_left_out():
    truth = spring_lpv()
    kept = []
    for seed in range(3):
        records = [record(truth, 160, 10 * seed + k, noise=0.05) for k in (0, 1)]
        found = refine_with_rates(
            truth, records, REST, None, rate="auto", groups=[0, 1], max_iter=10
        )
        kept.append(found.model.rate_terms is not None)
    assert sum(kept) == 0


def test_one_experiment_cannot_tell_whether_rates_matter():
    truth = spring_lpv()
    whole = record(truth, noise=0.02)
    halves = [
        Record(*(part[rows] for part in whole[:3]), STEP)
        for rows in (slice(150), slice(150, None))
    ]
    found = refine_with_rates(
        truth, halves, MOVING, None, rate="auto", groups=[7, 7], max_iter=5
    )
    assert found.model.rate_terms is None


def test_constant_scheduling_gives_the_output_error_of_a_time_invariant_model():
    rng = np.random.default_rng(4)
    plain = spring_lpv().at(0.7)
    u = rng.normal(size=(400, 1))
    y = plain.simulate(u, sampling_time=STEP)
    y = y + 0.1 * y.std() * rng.normal(size=y.shape)
    local = SubspaceLTI(2, sampling_time=STEP, feedthrough=False, offset=None).fit(u, y)
    start = local.lti_.to_continuous("zoh").balance()
    structure = GrayBoxStructure.full(2, 1, 1, feedthrough=False)
    theta = np.concatenate([M.ravel() for M in (start.A, start.B, start.C)])
    theta *= 1 + 0.03 * rng.normal(size=len(theta))
    place = np.array([[0.7]])
    form = PolynomialLPV(0).fit(place, theta[None])
    model = LPVStateSpace(structure, form, np.repeat(place, 2, axis=0))
    kappa = np.full((400, 1), 0.7)
    found = refine(model, [Record(u, y, kappa, STEP)], MOVING, max_iter=100)
    omega = np.logspace(-1, 1.5, 30)
    expected = local.lti_.to_continuous("zoh").frequency_response(omega)
    response = found.model.at(0.7).frequency_response(omega)
    np.testing.assert_allclose(response, expected, atol=1e-3 * np.abs(expected).max())


def test_a_prior_without_doubt_returns_the_start():
    truth = spring_lpv()
    start = perturbed(truth)
    c = coefficients_of(start)
    prior = Prior(c, 1e14 * np.eye(len(c)))
    found = refine(start, [record(truth, noise=0.01)], REST, prior)
    np.testing.assert_allclose(coefficients_of(found.model), c, rtol=1e-6, atol=1e-9)


def test_a_prior_weighs_as_the_data_it_stands_for():
    """Of a record far longer than noise, its information does what the record does."""
    truth = spring_lpv()
    first, second = (record(truth, 600, seed, noise=0.01) for seed in (0, 1))
    both = refine(truth, [first, second], REST)
    one = refine(truth, [first], REST)
    prior = Prior(coefficients_of(one.model), one.information)
    after = refine(one.model, [second], REST, prior)
    error = coefficients_of(after.model) - coefficients_of(both.model)
    assert error @ both.information @ error < 0.1  # squared standard deviations


def test_the_gradient_vanishes_where_it_ends():
    truth = spring_lpv()
    rows = [record(truth, noise=0.05, x0=[1.0, 0.0], offset=0.3)]
    found = refine(perturbed(truth), rows, Own(True, True), max_iter=100)
    c, free = coefficients_of(found.model), found.free
    weight = 1.0 / found.deviation

    def cost(c):
        model = with_coefficients(found.model, c)
        errors, _ = refinement.simulated(model, rows[0], Own(True, True), weight)
        return np.sum((errors * weight) ** 2)

    unit = 1.0 / np.sqrt(np.diag(found.information))  # a standard deviation
    slopes = [
        (cost(c + 1e-3 * step) - cost(c - 1e-3 * step)) / 2e-3 for step in np.diag(unit)
    ]
    assert free.all()
    assert np.abs(slopes).max() < 0.1  # of a cost of 300


def test_constants_and_initial_states_are_told_apart():
    truth = spring_lpv()
    rows = [record(truth, seed=k, x0=[0.5, k], offset=k + 2.0) for k in (0, 1)]
    found = refine(perturbed(truth, 0.03), rows, Own(True, True))
    np.testing.assert_allclose(found.own, [[0.5, 0, 2], [0.5, 1, 3]], atol=1e-6)


@pytest.mark.slow
def test_errors_are_as_large_as_their_covariance_says():
    truth = spring_lpv()
    c, distances = coefficients_of(truth), []
    for seed in range(30):
        found = refine(truth, [record(truth, 400, seed, noise=0.1)], MOVING)
        error = coefficients_of(found.model) - c
        distances.append(error @ found.information @ error)
    # chi-square of 9 degrees of freedom, mean of 30
    assert 9 * 0.7 < np.mean(distances) < 9 * 1.4


@pytest.mark.slow
def test_outputs_weigh_by_their_noise():
    """An output a hundred times as noisy does not spoil what the other one tells."""
    structure = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0], [0, 1]]
    )
    truth = replace(spring_lpv(), structure=structure)
    rng, errors = np.random.default_rng(0), {1: [], 2: []}
    for seed in range(5):
        clean = record(truth, seed=seed)
        noise = rng.normal(size=clean.y.shape) * [0.01, 3.0]
        both = clean._replace(y=clean.y + noise)
        one = both._replace(y=both.y[:, :1])
        single = replace(truth, structure=spring_structure())
        for model, rows in ((truth, both), (single, one)):
            found = refine(perturbed(model), [rows], REST)
            error = coefficients_of(found.model) - coefficients_of(model)
            errors[rows.y.shape[1]].append(error @ found.information @ error)
    assert np.mean(errors[2]) < 2 * np.mean(errors[1])


@pytest.mark.slow
def test_steps_that_diverge_are_rejected():
    """From far away: full steps lead to negative stiffness or no model at all."""
    truth = spring_lpv()
    c = coefficients_of(truth).reshape(3, 3)  # terms of b, c, k
    far = with_coefficients(truth, (c * [1, 1, 0.5]).ravel())
    tried = []
    whole = refinement.simulated

    def watched(model, *args):
        try:
            return whole(model, *args)
        except DivergenceError:
            tried.append(model)
            raise

    bad = with_coefficients(truth, (c * [1, -60.0, 1]).ravel())
    long = record(truth, 3000)
    with pytest.raises(DivergenceError):
        whole(bad, long, REST, np.ones(1))
    found = refine(far, [record(truth)], REST, max_iter=100)
    np.testing.assert_allclose(
        coefficients_of(found.model), coefficients_of(truth), atol=1e-5
    )


def test_a_start_that_diverges_is_told():
    truth = spring_lpv()
    c = coefficients_of(truth).reshape(3, 3)
    bad = with_coefficients(truth, (c * [1, -60.0, 1]).ravel())
    with pytest.raises(DivergenceError, match="diverges"):
        refine(bad, [record(truth, 3000)], REST)


@pytest.mark.slow
@pytest.mark.parametrize("refused", [1, 3])
def test_steps_whose_derivatives_would_not_end_are_rejected(monkeypatch, refused):
    truth, calls, whole = spring_lpv(), [], refinement._gram

    def sometimes(*args):
        calls.append(args)
        if len(calls) == refused:
            raise ValueError("states too fast")
        return whole(*args)

    monkeypatch.setattr(refinement, "_gram", sometimes)
    start, records = perturbed(truth), [record(truth)]
    if refused == 1:  # the start itself
        with pytest.raises(ValueError, match="too fast"):
            refine(start, records, REST)
        return
    found = coefficients_of(refine(start, records, REST).model)
    np.testing.assert_allclose(found, coefficients_of(truth), atol=1e-5)


def test_residuals_in_few_coordinates_keep_all_that_steps_need():
    rng = np.random.default_rng(0)
    J, r = rng.normal(size=(50, 4)), rng.normal(size=50)
    J[:, 3] = J[:, 2]  # not determined
    Z = np.column_stack([r, J])
    few = refinement._rotated(Z.T @ Z, np.linalg.norm(r))
    short = np.zeros(5)
    short[0] = np.linalg.norm(r)
    np.testing.assert_allclose(few.T @ few, J.T @ J, atol=1e-12)
    np.testing.assert_allclose(few.T @ short, J.T @ r, atol=1e-12)


def test_local_experiments_tell_what_their_covariances_do():
    """Of many samples, the information of coefficients by either way."""
    truth = spring_lpv()
    kappa, rng = np.array([[0.0], [0.6], [1.5]]), np.random.default_rng(0)
    groups = []
    for place in kappa:
        u = rng.normal(size=(300, 1))
        path = np.repeat(place[None], 300, axis=0)
        y = truth.simulate(u, path, STEP)
        groups.append([Record(u, y + 0.05 * rng.normal(size=y.shape), path, STEP)])
    theta = truth.parameters(kappa)
    known = local_prior(truth, kappa, theta, groups, MOVING).information
    joint = refine(truth, [g[0] for g in groups], MOVING)
    size = np.sqrt(np.diag(joint.information))
    np.testing.assert_allclose(
        known / size[:, None] / size, joint.information / size[:, None] / size, atol=0.2
    )


def test_an_operating_point_without_records_tells_nothing():
    truth, points = spring_lpv(), np.array([[0.0], [1.0]])
    own, theta = [record(truth)], truth.parameters(points)
    one = local_prior(truth, points[:1], theta[:1], [own], MOVING).information
    both = local_prior(truth, points, theta, [own, []], MOVING).information
    np.testing.assert_array_equal(both, one)
    none = local_prior(truth, points, theta, [[], []], MOVING).information
    np.testing.assert_array_equal(none, np.zeros_like(one))


def test_a_covariance_of_the_coefficients_does_not_matter_to_what_records_tell():
    """Its size is that of the form, not of the constants at a point."""
    truth, points = spring_lpv(), np.array([[0.0], [1.0]])
    own, theta = [[record(truth)]] * 2, truth.parameters(points)
    told = replace(truth, covariance=np.eye(len(coefficients_of(truth))))
    known, again = (local_prior(m, points, theta, own, MOVING) for m in (truth, told))
    np.testing.assert_array_equal(again.information, known.information)


@pytest.mark.slow
def test_experiments_in_parallel_are_the_same():
    truth = spring_lpv()
    rows = [record(truth, 150, seed, noise=0.05) for seed in range(3)]
    two_at_once = Parallel(n_jobs=2)
    one = refine(perturbed(truth), rows, MOVING, max_iter=4)
    two = refine(perturbed(truth), rows, MOVING, max_iter=4, run=two_at_once)
    np.testing.assert_array_equal(
        coefficients_of(one.model), coefficients_of(two.model)
    )


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_an_output_that_stands_still_in_one_record_weighs_by_the_others(unit):
    rng = np.random.default_rng(0)
    y = rng.standard_normal((50, 2)) * [1.0, unit]
    records = [Record(y[:, :1], some, y[:, :1], 0.1) for some in (y, y * [1.0, 0.0])]
    size = np.sqrt([np.mean([np.var(r.y[:, k]) for r in records]) for k in (0, 1)])
    np.testing.assert_allclose(weights_of(records), 1.0 / size)
    still = Record(y[:, :1], 0.0 * y, y[:, :1], 0.1)
    np.testing.assert_array_equal(weights_of([still]), 1.0)
