"""Parameters nearest to a black box in the metric of its own uncertainty."""

import numpy as np
import pytest
from scipy.stats import kstest

from lpvlearn import GrayBoxStructure, StateSpace, SubspaceLTI
from lpvlearn.restructuring.error_system import ErrorSystem, Target
from lpvlearn.restructuring.minimise_covariance import (
    SampledStructure,
    efficient_parameters,
    minimise_covariance,
    uncertain_response,
)
from lpvlearn.restructuring.problem import problem_from_models

from ..conftest import stable_model

LAG = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
MASSES = GrayBoxStructure.mechanical(
    M=[["m1", 0], [0, "m2"]],
    D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
    K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
    F=[[1, 0], [0, 1]],
)
APART = 0.02  # standard deviations between the models of a pair


def with_matrices(model, S):
    n = model.order
    return StateSpace(S[:n, :n], S[:n, n:], S[n:, :n], S[n:, n:], model.sampling_time)


def system_matrix(model):
    return np.block([[model.A, model.B], [model.C, model.D]])


def pairs_around(model, changes):
    """Models half of `APART` standard deviations to either side."""
    S = system_matrix(model)
    return [
        tuple(with_matrices(model, S + sign * APART / 2 * change) for sign in (1, -1))
        for change in changes
    ]


def random_changes(model, seed=0, size=1e-3):
    """Standard deviations along more directions than the model has."""
    rng = np.random.default_rng(seed)
    shape = (40, *system_matrix(model).shape)
    changes = size * rng.normal(size=shape)
    if not model.D.any():
        changes[:, model.order :, model.order :] = 0.0
    return changes


def fit(structure, model, pairs, start, *, boxes=None, omega=None):
    problem = problem_from_models(structure, [model], None)
    omega = problem.omega if omega is None else omega
    box = uncertain_response(model, pairs, omega)
    return (
        minimise_covariance(
            problem.system, start, problem.margin, [box] if boxes is None else boxes
        ),
        box,
    )


@pytest.fixture
def black_box():
    return stable_model(0, order=3, n_inputs=2, n_outputs=2, feedthrough=True)


@pytest.fixture
def masses():
    """Parameters of the structure, its model, and one a little off the structure."""
    theta = np.array([0.8, 0.4, 60.0, 30.0, 1.0, 0.5])
    model = MASSES.model(theta).balance()
    rng = np.random.default_rng(3)
    S = system_matrix(model)
    return theta, model, with_matrices(model, S + 1e-3 * rng.normal(size=S.shape))


def test_a_structure_of_full_form_is_the_black_box_itself(black_box):
    """Cost 0, and the covariance of the response comes back from theta's."""
    structure = GrayBoxStructure.observable_canonical(3, 2, 2, feedthrough=True)
    problem = problem_from_models(structure, [black_box], None)
    pairs = pairs_around(black_box, random_changes(black_box))
    omega = np.geomspace(0.1, 10, 15)
    box = uncertain_response(black_box, pairs, omega)
    start = canonical_parameters(structure, black_box)
    found = minimise_covariance(problem.system, start * 1.001, problem.margin, [box])
    assert found.converged and found.cost < 1e-15
    assert found.degrees_of_freedom == 0 and found.p_value == 1.0
    np.testing.assert_allclose(
        structure.model(found.theta).frequency_response(omega), box.response, rtol=1e-8
    )
    J = problem.system.response_jacobian(found.theta, omega)[1].reshape(-1, 16)
    changes = np.array(
        [(a.frequency_response(omega) - b.frequency_response(omega)) for a, b in pairs]
    )
    V = changes.reshape(len(pairs), -1).T / APART
    expected = V @ V.conj().T
    actual = J @ found.covariance @ J.conj().T
    np.testing.assert_allclose(actual, expected, atol=1e-6 * np.abs(expected).max())


def canonical_parameters(structure, model):
    """Observable canonical form of order 3 with outputs (y1, y1', y2) as states."""
    C, A = model.C, model.A
    T = np.array([C[0], C[0] @ A, C[1]])
    inverse = np.linalg.inv(T)
    S = np.block([[T @ A @ inverse, T @ model.B], [C @ inverse, model.D]])
    theta = np.linalg.lstsq(
        structure.basis.reshape(structure.n_params, -1).T,
        (S - structure.offset).ravel(),
        rcond=None,
    )[0]
    np.testing.assert_allclose(structure.system_matrix(theta), S, atol=1e-9)
    return theta


def test_an_exact_black_box_returns_the_parameters(masses):
    theta, model, _ = masses
    pairs = pairs_around(model, random_changes(model))
    found, _ = fit(MASSES, model, pairs, theta * 1.02)
    np.testing.assert_allclose(found.theta, theta, rtol=1e-9)
    assert found.cost < 1e-12 and found.converged
    assert found.degrees_of_freedom == 16 - 6


def test_a_linear_structure_has_the_closed_form_of_gauss_and_markov():
    """G = b1 / (s + 1) + b2 / (s + 3) is linear: theta = (J' S+ J)^-1 J' S+ g0."""
    structure = GrayBoxStructure.from_template(
        [[-1, 0], [0, -3]], [["b1"], ["b2"]], [[1, 1]]
    )
    box_model = StateSpace([[-1.1, 0], [0, -2.8]], [[1.0], [2.0]], [[1, 1.0]], [[0.1]])
    omega = np.geomspace(0.1, 20, 12)
    changes = random_changes(box_model, size=0.03)
    pairs = pairs_around(box_model, changes)
    found, _ = fit(structure, box_model, pairs, np.array([1.0, 1.0]), omega=omega)

    def parts(G):
        flat = G.reshape(len(omega), -1)
        return np.concatenate([flat.real, flat.imag]).squeeze()

    V = np.column_stack(
        [
            parts(a.frequency_response(omega) - b.frequency_response(omega)) / APART
            for a, b in pairs
        ]
    )
    # in the tangent space of the black box, whose basis is any p columns
    J = np.column_stack([parts(1 / (1j * omega + a)) for a in (1, 3)])
    std = np.sqrt((V**2).sum(1))
    scaled = np.linalg.pinv((V @ V.T) / np.outer(std, std), rcond=1e-10, hermitian=True)
    weight = scaled / np.outer(std, std)
    gram = J.T @ weight @ J
    expected = np.linalg.solve(
        gram, J.T @ weight @ parts(box_model.frequency_response(omega))
    )
    np.testing.assert_allclose(found.theta, expected, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(gram), rtol=1e-5)
    r = parts(box_model.frequency_response(omega)) - J @ expected
    assert np.isclose(found.cost, r @ weight @ r, rtol=1e-5)


def test_the_state_basis_of_any_model_is_free(masses):
    theta, _, model = masses
    pairs = pairs_around(model, random_changes(model))
    plain, _ = fit(MASSES, model, pairs, theta)
    rng = np.random.default_rng(1)

    def turned(m):
        return m.transform(np.eye(4) + 0.3 * rng.normal(size=(4, 4)))

    other, _ = fit(
        MASSES, turned(model), [(turned(a), turned(b)) for a, b in pairs], theta
    )
    np.testing.assert_allclose(other.theta, plain.theta, rtol=1e-7)
    np.testing.assert_allclose(other.cost, plain.cost, rtol=1e-7)
    np.testing.assert_allclose(other.covariance, plain.covariance, rtol=1e-5, atol=0)


def test_units_of_channels_time_and_parameters_do_not_matter():
    """y in mm, u in kN, time in ms, a in 1/ms: the same lag."""
    box = StateSpace([[-2.0]], [[3.0]], [[1.0]], [[0.05]])
    pairs = pairs_around(box, random_changes(box, size=0.05))
    omega = np.geomspace(0.05, 40, 20)
    plain, _ = fit(LAG, box, pairs, np.array([2.1, 2.9]), omega=omega)
    gain, rate = 1e6, 1e-3

    def scaled(m):
        return StateSpace(m.A * rate, m.B * rate * gain, m.C, m.D * gain)

    units = np.array([rate, rate * gain])
    other, _ = fit(
        LAG,
        scaled(box),
        [(scaled(a), scaled(b)) for a, b in pairs],
        np.array([2.1, 2.9]) * units,
        omega=omega * rate,
    )
    assert plain.cost > 1e-3
    np.testing.assert_allclose(other.theta, plain.theta * units, rtol=1e-9)
    np.testing.assert_allclose(other.cost, plain.cost, rtol=1e-8)
    np.testing.assert_allclose(
        other.covariance, plain.covariance * np.outer(units, units), rtol=1e-6
    )


def test_two_equal_realizations_count_twice(masses):
    theta, _, model = masses
    pairs = pairs_around(model, random_changes(model))
    one, box = fit(MASSES, model, pairs, theta)
    two, _ = fit(MASSES, model, pairs, theta, boxes=[box, box])
    np.testing.assert_allclose(two.theta, one.theta, rtol=1e-6)
    assert np.isclose(two.cost, 2 * one.cost, rtol=1e-9)
    np.testing.assert_allclose(two.covariance, one.covariance / 2, rtol=1e-4)
    assert two.degrees_of_freedom == 2 * one.degrees_of_freedom + 6


def test_a_parameter_at_its_bound_is_as_one_that_is_fixed(masses):
    theta, _, model = masses
    pairs = pairs_around(model, random_changes(model))
    free, _ = fit(MASSES, model, pairs, theta)
    k = MASSES.parameter_names.index("k1")
    limit = free.theta[k] * 0.999
    bounded, _ = fit(MASSES.with_bounds({"k1": (None, limit)}), model, pairs, theta)
    fixed_structure = MASSES.fix({"k1": limit})
    fixed, _ = fit(fixed_structure, model, pairs, np.delete(theta, k))
    others = np.delete(np.arange(6), k)
    assert bounded.theta[k] == limit and (bounded.covariance[k] == 0).all()
    np.testing.assert_allclose(bounded.theta[others], fixed.theta, rtol=1e-6)
    np.testing.assert_allclose(bounded.cost, fixed.cost, rtol=1e-8)
    np.testing.assert_allclose(
        bounded.covariance[np.ix_(others, others)], fixed.covariance, rtol=1e-4
    )
    assert bounded.degrees_of_freedom == fixed.degrees_of_freedom == 20 - 5
    assert bounded.converged


def test_what_the_black_box_does_not_determine_has_no_finite_variance():
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    box = StateSpace([[-2.0]], [[3.0]], [[1.0]])
    pairs = pairs_around(box, random_changes(box, size=0.05))
    found, _ = fit(structure, box, pairs, np.array([2.0, 3.0, 1.0]))
    std = dict(zip(structure.parameter_names, np.diag(found.covariance), strict=True))
    assert np.isinf([std["b"], std["c"]]).all() and 0 < std["a"] < np.inf
    assert found.degrees_of_freedom == 0


def test_the_stability_margin_is_kept(black_box):
    box = StateSpace([[-0.5]], [[1.0]], [[1.0]])
    pairs = pairs_around(box, random_changes(box, size=0.05))
    problem = problem_from_models(LAG, [box], None)
    estimate = uncertain_response(box, pairs, problem.omega)
    margin = 0.6  # faster than the black box
    start = np.array([1.0, 1.0])
    found = minimise_covariance(problem.system, start, margin, [estimate])
    assert 0.6 <= found.theta[0] < 0.7
    start = np.array([0.55, 1.0])  # where another search may have ended
    found = minimise_covariance(problem.system, start, margin, [estimate])
    assert 0.48 <= found.theta[0] < 0.7
    assert (
        minimise_covariance(problem.system, np.array([0.1, 1]), margin, [estimate])
        is None
    )


def test_a_fit_that_noise_does_not_explain_begins_at_other_starts_too():
    """A resonance that the first start has elsewhere, by far."""
    spring = GrayBoxStructure.from_template(
        A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0]]
    )
    theta, start = np.array([4.0, 0.05]), np.array([40.0, 0.05])
    model = spring.model(theta)
    estimates = [(model, pairs_around(model, random_changes(model)))]
    alone = efficient_parameters(spring, estimates, start)
    assert not alone.is_plausible
    others = [1.2 * start, theta * 1.05]
    found = efficient_parameters(spring, estimates, start, others=others)
    assert found.is_plausible
    np.testing.assert_allclose(found.theta, theta, rtol=1e-6)


def test_what_is_astray_is_not_taken():
    """As where an uncertainty cannot be the black box's: the start stays."""
    theta, start = np.array([2.0, 3.0]), np.array([2.2, 2.9])
    model = LAG.model(theta)
    pairs = pairs_around(model, random_changes(model))
    poor = LAG.fix({"b": 2.0})  # which no noise explains
    found = [
        efficient_parameters(poor, [(model, pairs)], start[:1], astray=astray)
        for astray in (None, lambda _: False, lambda _: True)
    ]
    assert not found[0].is_plausible
    np.testing.assert_array_equal(found[0].theta, found[1].theta)
    np.testing.assert_array_equal(found[2].theta, start[:1])
    assert found[2].converged and found[2].covariance[0, 0] > 0.0
    true = efficient_parameters(LAG, [(model, pairs)], start, astray=lambda _: True)
    np.testing.assert_allclose(true.theta, theta)  # which noise explains


def test_nothing_is_weighed_where_no_uncertainty_is_left():
    box = StateSpace([[-2.0]], [[3.0]], [[1.0]])
    omega = np.geomspace(0.1, 10, 5)
    assert uncertain_response(box, [], omega) is None
    faint = pairs_around(box, random_changes(box, size=1e-13))
    assert uncertain_response(box, faint, omega) is None


def test_a_poor_structure_of_a_well_known_black_box_settles(masses):
    theta, model, _ = masses
    structure = MASSES.fix({"c2": 0.2})
    start = np.delete(theta, MASSES.parameter_names.index("c2"))
    pairs = pairs_around(model, random_changes(model, size=1e-6))
    found, _ = fit(structure, model, pairs, start)
    assert found.cost > 1e6 and found.converged and found.p_value == 0.0


@pytest.mark.parametrize("held", [False, True])
def test_models_in_samples_or_in_continuous_time(masses, held):
    theta, model, _ = masses
    estimate = model, pairs_around(model, random_changes(model))
    if held:
        discrete = model.to_discrete(0.05)
        estimate = discrete, pairs_around(discrete, random_changes(discrete))
    found = efficient_parameters(MASSES, [estimate] * 2, theta * 1.01)
    np.testing.assert_allclose(found.theta, theta, rtol=1e-8)
    assert found.degrees_of_freedom == 2 * 16 - 6
    assert efficient_parameters(MASSES, [(model, [])], theta) is None


# -- with data --------------------------------------------------------------------

STEP = 0.1


def lag_record(seed, n_samples=600, noise=0.1):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, 1))
    y = LAG.model({"a": 0.8, "b": 1.5}).simulate(u, sampling_time=STEP)
    return u, y + noise * rng.standard_normal(y.shape)


def identified(structure, u, y, start, step, **options):
    fitted = SubspaceLTI(sampling_time=step, horizon=8, **options).fit(u, y)
    pairs = [
        (above.to_continuous(), below.to_continuous())
        for above, below in fitted.deviated_models()
    ]
    return fit(structure, fitted.lti_.to_continuous(), pairs, start)[0]


@pytest.mark.slow
def test_a_true_structure_has_costs_of_a_chi_square():
    found = [
        identified(LAG, *lag_record(seed), np.array([0.8, 1.5]), STEP, order=1)
        for seed in range(40)
    ]
    assert {fit.degrees_of_freedom for fit in found} == {1}  # no feedthrough
    assert kstest([fit.p_value for fit in found], "uniform").pvalue > 0.01
    z = [(f.theta - [0.8, 1.5]) / np.sqrt(np.diag(f.covariance)) for f in found]
    assert 0.8 < np.std(z) < 1.2


def test_a_wrong_structure_is_found_out():
    u, y = lag_record(0)
    y = y + 0.1 * u  # a feedthrough of one noise's size
    found = identified(LAG, u, y, np.array([0.8, 1.5]), STEP, order=1)
    assert found.p_value < 1e-3


def test_the_covariance_is_the_cramer_rao_bound_of_the_structure(masses):
    theta, step = masses[0], 0.05
    rng = np.random.default_rng(0)
    u = rng.standard_normal((3000, 2))

    def outputs(params):
        return MASSES.model(params).simulate(u, sampling_time=step)

    clean = outputs(theta)
    std = 0.01 * clean.std(axis=0)
    J = [
        (outputs(theta + h) - outputs(theta - h)) / (2e-5 * size) / std
        for size, h in zip(theta, np.diag(1e-5 * theta), strict=True)
    ]
    J = np.array(J).reshape(6, -1)
    y = clean + std * rng.standard_normal(clean.shape)
    found = identified(MASSES, u, y, theta, step, order=4)
    bound = np.linalg.inv(J @ J.T)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(bound), rtol=0.15)


DT = 0.1
LAGS = GrayBoxStructure.from_template(
    [["-a", 1], [0, "-b"]], [["g"], ["h"]], [[1, 0]], [["d"]]
)
CHAIN = GrayBoxStructure.mechanical(
    M=[["m1", 0], [0, "m2"]],
    D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
    K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
    F=[[1, 0], [0, 1]],
    outputs="acceleration",
)
POINTS = {
    "lags": (LAGS, np.array([0.8, 3.0, 0.2, 1.5, 2.0])),
    "masses": (CHAIN, np.array([0.8, 0.4, 60.0, 30.0, 1.0, 0.5])),
}


@pytest.mark.parametrize("name", POINTS)
def test_models_are_those_of_the_zero_order_hold(name):
    structure, theta = POINTS[name]
    expected = structure.model(theta).to_discrete(DT)
    S = SampledStructure(structure, DT).system_matrix(theta)
    n = structure.order
    for block, M in (
        (S[:n, :n], expected.A),
        (S[:n, n:], expected.B),
        (S[n:, :n], expected.C),
        (S[n:, n:], expected.D),
    ):
        np.testing.assert_allclose(block, M, atol=1e-13)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("name", POINTS)
def test_jacobian_equals_central_differences_in_any_unit(name, unit):
    structure, theta = POINTS[name]

    class Rescaled:  # the same structure in other units of its parameters
        order, n_params = structure.order, structure.n_params
        lower, upper = structure.lower, structure.upper

        def system_matrix(self, theta):
            return structure.system_matrix(theta / unit)

        def jacobian(self, theta):
            return structure.jacobian(theta / unit) / unit

    sampled, theta = SampledStructure(Rescaled(), DT), theta * unit
    numeric = np.array(
        [
            (sampled.system_matrix(theta + h) - sampled.system_matrix(theta - h))
            / (2 * h.sum())
            for h in np.diag(1e-5 * theta)
        ]
    )
    exact = sampled.jacobian(theta)
    np.testing.assert_allclose(exact, numeric, atol=1e-8 * np.abs(numeric).max())


def test_a_model_that_overflows_is_not_finite():
    sampled = SampledStructure(LAGS, DT)
    S = sampled.system_matrix(np.array([-1e5, 3.0, 0.2, 1.5, 2.0]))
    assert not np.isfinite(S).all()


def estimate(structure, model, pairs, omega, start):
    target = Target(model.A, model.B, model.C, model.D, model.sampling_time)
    box = uncertain_response(model, pairs, omega)
    return minimise_covariance(ErrorSystem(structure, target), start, 0.0, [box])


def record(truth, seed=0, n_samples=1000, noise=0.05):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n_samples, 1))
    y = truth.simulate(u)
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    return u, y


def test_time_domains_give_one_estimate():
    """The structure has fewer parameters than the black box: both match by weight."""
    structure = LAGS.fix({"d": 0.0, "h": 1.5})
    theta = np.array([0.8, 3.0, 0.2])
    u, y = record(structure.model(theta).to_discrete(DT))
    fitted = SubspaceLTI(2, horizon=8, sampling_time=DT).fit(u, y)
    omega = np.geomspace(0.1, 0.95 * np.pi / DT, 40)

    def found(structure, convert):
        pairs = [
            (convert(above), convert(below))
            for above, below in fitted.deviated_models()
        ]
        return estimate(structure, convert(fitted.lti_), pairs, omega, theta)

    discrete = found(SampledStructure(structure, DT), lambda model: model)
    continuous = found(structure, StateSpace.to_continuous)
    # equal to first order: apart by a small part of the standard deviation
    std = np.sqrt(np.diag(continuous.covariance))
    np.testing.assert_allclose(
        discrete.theta, continuous.theta, atol=0.1 * std.min(), rtol=0
    )
    np.testing.assert_allclose(
        np.diag(discrete.covariance), np.diag(continuous.covariance), rtol=0.05
    )
    assert np.isclose(discrete.cost, continuous.cost, rtol=0.1)
    assert discrete.degrees_of_freedom == continuous.degrees_of_freedom == 2


def test_a_pole_on_the_negative_axis_needs_no_logarithm():
    """A fast lag in noise has a discrete pole near zero, of either sign."""
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
    structure = structure.with_bounds({"a": (None, 100.0)})
    truth = np.array([50.0, 50.0])  # five times the sampling rate: exp(-5) = 0.007
    negative = 0
    for seed in range(6):
        u, y = record(structure.model(truth).to_discrete(DT), seed, 300, noise=0.3)
        fitted = SubspaceLTI(1, horizon=5, sampling_time=DT).fit(u, y)
        negative += fitted.lti_.A.item() < 0
        pairs = fitted.deviated_models()
        omega = np.linspace(0.5, 30, 30)
        found = estimate(
            SampledStructure(structure, DT), fitted.lti_, pairs, omega, truth
        )
        gain = found.theta[1] / found.theta[0]
        assert np.isclose(gain, 1.0, rtol=0.1)  # the pole itself may be open
        assert found.p_value > 1e-3
    assert negative > 0
