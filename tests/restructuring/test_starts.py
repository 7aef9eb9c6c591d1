"""Starting points: neighbouring basins, and positive parameters."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.exceptions import RankWarning
from lpvlearn.restructuring import starts
from lpvlearn.restructuring.problem import problem_from_models
from lpvlearn.restructuring.starts import continuation_candidates, hopped_fits

from ..conftest import spring_structure
from .conftest import stable_model, target_of


def two_modes():
    """A strong mode at 1 rad/s, and a weak one at 3 rad/s."""
    A = [[0, 1, 0, 0], [-1, -0.02, 0, 0], [0, 0, 0, 1], [0, 0, -9, -0.02]]
    return StateSpace(A, [[0], [1], [0], [1]], [[1, 0, 2.0, 0]])


def at_the_weak_mode(structure):
    """The problem, and the fit that ends in the basin of its weak mode."""
    problem = problem_from_models(structure, [two_modes()], None)
    params = structure.check_params({"k": 9.0, "c": 0.02, "b": 2.0})
    return problem, problem.fit(params)


def test_a_hop_leaves_the_basin_of_the_weak_mode():
    structure = spring_structure()
    problem, fit = at_the_weak_mode(structure)
    k = structure.parameter_names.index("k")
    assert abs(fit.x[k] - 9) < 1
    rng = np.random.default_rng(0)
    fits = hopped_fits(problem, [fit], rng)
    costs = [found.cost for found in fits]
    assert costs == sorted(costs)
    assert costs[0] < 0.9 * fit.cost
    assert abs(fits[0].x[k] - 1) < 0.1


def test_hops_keep_the_bounds_and_what_is_good():
    structure = spring_structure().with_bounds({"k": (8, 10), "c": (0.01, None)})
    problem, fit = at_the_weak_mode(structure)
    fits = hopped_fits(problem, [fit], np.random.default_rng(1))
    assert fits[0].cost <= fit.cost
    for found in fits:
        assert (found.x >= structure.lower).all()
        assert (found.x <= structure.upper).all()


def test_positive_parameters_lead_to_a_chain_of_masses():
    chain = GrayBoxStructure.mechanical(
        M=[[1, 0], [0, 1]],
        D=[["c1 + c2", "-c2"], ["-c2", "c2"]],
        K=[["k1 + k2", "-k2"], ["-k2", "k2"]],
        F=[[1], [0]],
        sensors=[[0, 1]],
    )
    truth = chain.check_params({"k1": 20.0, "k2": 8.0, "c1": 0.3, "c2": 0.1})
    box = target_of(chain.model(truth))
    nothing = np.zeros((0, len(truth)))
    found = continuation_candidates(
        chain, box, nothing, np.random.default_rng(0), thorough=True
    )
    assert np.isclose(found, truth, rtol=1e-3).all(1).any()


def test_what_keeps_a_search_from_starting_is_told():
    silent = GrayBoxStructure.from_template([["-a"]], [[0]], [["c"]])
    with pytest.raises(ValueError, match="Got a, c, which change nothing"):
        GrayBoxRestructurer(silent).fit_model(StateSpace(-2, 3, 1))
    unstable = GrayBoxStructure.from_template([["a"]], [["b"]], [[1]])
    unstable = unstable.with_bounds({"a": (2, 3)})
    with pytest.raises(ValueError, match="no stable starting point.*discrete time"):
        GrayBoxRestructurer(unstable).fit_model(StateSpace(0.5, 3, 1, None, 1.0))


def undamped(**bounds):
    plain = [[0, 1], ["-k", 0]], [[0], ["b"]], [[1, 0]]
    return GrayBoxStructure.from_template(*plain).with_bounds(bounds)


def undamped_masses():
    K = [["k1 + k2", "-k2"], ["-k2", "k2"]]
    return GrayBoxStructure.mechanical(
        M=[["m", 0], [0, 1]], D=[[0, 0], [0, 0]], K=K, F=[[1], [0]], sensors=[[0, 1]]
    )


@pytest.mark.broad
@pytest.mark.parametrize(
    "structure",
    [
        undamped(),
        undamped(k=(0.1, 50.0)),
        undamped_masses(),
        GrayBoxStructure.from_template([["a"]], [["b"]], [[1]]).with_bounds(
            {"a": (2, 3)}
        ),
        GrayBoxStructure.from_template(
            [["a", 1], ["-k", "-a"]], [[0], ["b"]], [[1, 0]]
        ),
    ],
)
def test_a_structure_that_never_decays_is_told(structure):
    box = spring_structure().model([30.0, 1.2, 40.0])
    with pytest.raises(ValueError, match="`structure` must .* decays.* Add damping"):
        GrayBoxRestructurer(structure).fit_model(box)


def test_a_pole_that_grows_beside_one_that_decays_is_no_lack_of_damping():
    structure = GrayBoxStructure.from_template(
        [["c", 1], [0, "1.5 + 2*c"]], [[1], ["b"]], [[1, 0]]
    ).with_bounds({"c": (-0.6, -0.5)})
    with pytest.raises(ValueError, match="no stable starting point"):
        GrayBoxRestructurer(structure).fit_model(spring_structure().model([30, 1.2, 4]))


def test_an_unstable_first_guess_is_named_with_its_pole():
    box, wrong = spring_structure().model([30, 1.2, 40]), [-1.0, -1.0, -1.0]
    with pytest.raises(ValueError, match=r"`init` must.* pole at 1.618\+0j"):
        GrayBoxRestructurer(spring_structure(), init=wrong).fit_model(box)
    with pytest.raises(ValueError, match="`starts` must.*search=True looks"):
        only = {"starts": [wrong], "search": False}
        GrayBoxRestructurer(spring_structure()).fit_model(box, **only)


@pytest.fixture
def rooms():
    """Five nodes of known capacities, heat in at two; and the truth."""
    L = [
        ["g1 + g4 + g5", "-g1", 0, 0, "-g4"],
        ["-g1", "g1 + g2 + g3", "-g2", "-g3", 0],
        [0, "-g2", "g2", 0, 0],
        [0, "-g3", 0, "g3", 0],
        ["-g4", 0, 0, 0, "g4 + g6"],
    ]
    ends, E = np.eye(5)[[0, 4]].tolist(), np.diag([0.85, 0.6, 1.04, 1.95, 1.09])
    A = [[f"-({entry})" for entry in row] for row in L]
    structure = GrayBoxStructure.from_template(A, np.transpose(ends), ends, E=E)
    structure = structure.with_bounds({f"g{i + 1}": (0, None) for i in range(6)})
    return structure, np.array([2.29, 0.8, 0.51, 0.82, 0.59, 0.58])


WRONG = np.array([2.38, 0.19, 1.0, 0.83, 0.59, 0.58])  # g2 and g3 change places


def test_starts_of_one_round_that_agree_on_a_wrong_basin_are_not_trusted(
    rooms, monkeypatch
):
    structure, truth = rooms
    draw = starts._candidates

    def misleading(problem, guess, n_starts, number, rng):
        drawn = draw(problem, guess, n_starts, number, rng)
        return WRONG * [[1.0], [1.01]] if number == 0 else drawn

    monkeypatch.setattr(starts, "_candidates", misleading)
    box = structure.model(truth).balance()
    found = GrayBoxRestructurer(structure).fit_model(box)
    errors = found.starts_["relative_error"]
    assert (np.isclose(errors, 1.9e-3, rtol=0.05)).sum() == 2
    np.testing.assert_allclose(found.params_, truth, rtol=1e-6)
    # where the error is the black box's own, one round is enough
    problem = problem_from_models(structure, [box], None)
    problem = replace(problem, deviations=np.full(structure.n_outputs, 2e-3))
    fits = starts.search(problem, "similarity", 16, [], 0).fits
    assert len(fits) == 1 and fits[0].relative_error > 1e-3


def test_a_discrete_black_box_is_blurred_alike():
    structure = GrayBoxStructure.observable_canonical(2)
    truth = np.array([0.95, -1.9, 0.2, 0.1])
    box = target_of(structure.model(truth, 0.1))
    rng = np.random.default_rng(0)
    seeds = truth * np.exp(0.3 * rng.normal(size=(3, 4)))
    found = continuation_candidates(structure, box, seeds, rng)
    assert np.isclose(found, truth, rtol=1e-3).all(1).any()


@pytest.mark.parametrize("dt", [None, 0.1])
def test_later_starts_of_a_canonical_form_are_other_reductions(dt):
    """The singular perturbation keeps the static gain; all are stable."""
    rng = np.random.default_rng(0)
    box = stable_model(rng, 7, 2, 2, dt, feedthrough=True)
    form = GrayBoxStructure.observable_canonical(4, 2, 2, True)
    problem = problem_from_models(form, [box], None)
    first = problem.best_fits(starts._candidates(problem, None, 16, 0, rng), 3)
    assert starts._reduced_otherwise(problem, first, 0) is None
    models = [
        problem.model(starts._reduced_otherwise(problem, first, number)[0])
        for number in (1, 2)
    ]
    assert all(model.is_stable for model in models)
    gains = [m.frequency_response([0.0])[0] for m in (models[0], box)]
    np.testing.assert_allclose(*gains, rtol=1e-6)
    spring = problem_from_models(spring_structure(), [two_modes()], None)
    fits = [spring.fit(np.array([1.0, 0.1, 1.0]))]
    assert starts._reduced_otherwise(spring, fits, 1) is None


def gain_of_a_square(q):
    return [[-1.0]], [[1.0]], [[1.0 + q[0] ** 2]]


@pytest.mark.parametrize("guess", [0.0, 1e-12, 1e-9, 0.1])
@pytest.mark.parametrize("init", ["similarity", "guess"])
def test_a_flat_point_is_left(guess, init):
    """At q = 0 the derivative of 1 + q^2 is zero, and near it steps are too long."""
    structure = GrayBoxStructure.from_function(gain_of_a_square, [guess])
    box = structure.model([2.0])
    given = "similarity" if init == "similarity" else [guess]
    fitted = GrayBoxRestructurer(structure, init=given).fit_model(box)
    assert fitted.relative_error_ < 1e-9
    assert abs(fitted.params_[0]) == pytest.approx(2.0)


def test_a_flat_point_that_is_the_optimum_is_kept():
    structure = GrayBoxStructure.from_function(gain_of_a_square, [1e-9])
    with pytest.warns((ConvergenceWarning, RankWarning)):
        fitted = GrayBoxRestructurer(structure).fit_model(StateSpace(-1, 1, 0.5))
    assert fitted.error_ == pytest.approx(0.5)
    assert fitted.lower_bound_ == 0.0


NETWORKS = {  # inputs of which most act on one state
    "air and wall": (
        [["-g - go", "g"], ["h", "-h - w"]],
        [["b", "s", "go"], [0, 0, "w"]],
        [[1, 0]],
        {"g": 2.7, "go": 0.2, "h": 0.6, "w": 0.3, "b": 3.3, "s": 2.0},
    ),
    "air, wall and slab": (
        [["-g - k - go", "g", "k"], ["h", "-h - w", 0], ["l", 0, "-l"]],
        [["b", "s", "p", "go", 0], [0, 0, 0, "w", 0], [0, 0, 0, 0, "f"]],
        [[1, 0, 0]],
        {"g": 2.0, "k": 0.8, "go": 0.3, "h": 0.4, "w": 0.2, "l": 0.15, "f": 0.3}
        | {"b": 3.0, "s": 1.0, "p": 0.5},
    ),
    "three tanks": (
        [["-a", "b", 0], ["a", "-b - c", "d"], [0, "c", "-d - e"]],
        [["p", "q", "r", "s"], [0, 0, 0, "t"], [0, 0, 0, 0]],
        [[1, 0, 0]],
        {"a": 1.2, "b": 0.6, "c": 0.7, "d": 0.4, "e": 0.5}
        | {"p": 1.0, "q": 0.6, "r": 0.4, "s": 0.3, "t": 0.8},
    ),
}


def network(name, size, seed=0):
    """Its structure, and a black box that is one of its models but for noise."""
    A, B, C, params = NETWORKS[name]
    structure = GrayBoxStructure.from_template(A, B, C)
    model, rng = structure.model(params), np.random.default_rng(seed)
    A, B, C = (
        M + size * np.abs(M).max() * rng.normal(size=M.shape)
        for M in (model.A, model.B, model.C)
    )
    return structure, model, StateSpace(A, B, C, model.D).balance()


@pytest.mark.broad
@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("size", [1e-4, 5e-3])
@pytest.mark.parametrize("positive", [False, True])
def test_noise_on_inputs_of_one_state_leaves_a_start(name, size, positive):
    """The gray box is no farther from the black box than the truth is."""
    structure, truth, box = network(name, size)
    if positive:
        names = structure.parameter_names
        structure = structure.with_bounds(dict.fromkeys(names, (0, None)))
    fitted = GrayBoxRestructurer(structure).fit_model(box)
    omega = np.logspace(-3, 2, 200)
    G = box.frequency_response(omega)
    of_truth, of_fit = (
        np.linalg.norm(model.frequency_response(omega) - G, 2, axis=(1, 2)).max()
        for model in (truth, fitted.lti_)
    )
    assert of_fit <= 1.01 * of_truth


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("positive", [False, True])
def test_sizes_of_the_black_box_are_starts_where_there_are_no_others(
    monkeypatch, name, positive
):
    def nothing(box, affine, *_):
        return np.zeros((0, len(affine.basis)))

    monkeypatch.setattr(starts, "_similar_candidates", nothing)
    structure, truth, _ = network(name, 0.0)
    if positive:
        names = structure.parameter_names
        structure = structure.with_bounds(dict.fromkeys(names, (0, None)))
    fitted = GrayBoxRestructurer(structure).fit_model(truth)
    assert fitted.error_ <= 1e-6 * truth.hinf_norm()


def test_a_parameter_beside_bounds_at_zero_is_not_taken_for_silent():
    """At b = 0, in a corner of the bounds, no derivative sees the others."""
    structure = GrayBoxStructure.from_template([["-a"]], [["b"]], [["c"]])
    structure = structure.with_bounds(dict.fromkeys("abc", (0, None)))
    problem = problem_from_models(structure, [StateSpace(-2, 3, 1)], None)
    for seed in range(20):
        assert starts._without_effect(problem, np.random.default_rng(seed)) == []


def test_equations_in_any_units_are_found_from_nothing():
    # a mass on a spring, and a motor that drives a load through a shaft
    spring = GrayBoxStructure.from_template(
        E=[[1, 0], [0, "m"]], A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0]]
    )
    shaft = GrayBoxStructure.from_template(
        E=[[1, 0, 0], [0, "Jm", 0], [0, 0, "Jl"]],
        A=[[0, 1, -1], ["-k", "-d - bm", "d"], ["k", "d", "-d - bl"]],
        B=[[0], [1], [0]],
        C=[[0, 1, 0], [0, 0, 1]],
    )
    rng = np.random.default_rng(0)
    for _ in range(10):
        m, w = 10.0 ** rng.uniform([-9, 0], [3, 5])
        of_spring = {"m": m, "k": m * w**2, "c": 0.1 * m * w}
        of_shaft = {"Jm": m, "Jl": 4 * m, "k": m * w**2}
        of_shaft |= {"d": 0.05 * m * w, "bm": 0.1 * m * w, "bl": 0.05 * m * w}
        for structure, truth in ((spring, of_spring), (shaft, of_shaft)):
            found = GrayBoxRestructurer(structure).fit_model(
                structure.model(truth).balance()
            )
            expected = [truth[name] for name in structure.parameter_names]
            assert_allclose(found.params_, expected, rtol=1e-6)


def test_signs_that_ranges_tell_are_kept_where_a_search_is_carried_on():
    ranges = {"k": (-500, -1), "c": (-3, -0.1), "q": (-50, -1), "b": (0.1, 10)}
    structure = GrayBoxStructure.from_template(
        A=[[0, 1, 0], ["k", "c", "g"], [0, "h", "q"]],
        B=[[0], ["b"], [0]],
        C=[[1, 0, 0]],
    ).with_ranges(ranges | {"h": (-9, -0.1), "g": (0.1, 9)})
    truth = {"k": -40.0, "c": -0.5, "b": 2.0, "g": 3.0, "h": -2.0, "q": -10.0}
    box = target_of(structure.model(truth))
    signs = [np.sign(truth[name]) for name in structure.parameter_names]
    for thorough in (False, True):
        found = continuation_candidates(
            structure, box, np.zeros((0, 6)), np.random.default_rng(0), thorough
        )
        assert len(found) and (np.sign(found) == signs).all()
