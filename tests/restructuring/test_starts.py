"""Starting points: neighbouring basins, and positive parameters."""

import numpy as np
import pytest

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.restructuring.problem import problem_from_models
from lpvlearn.restructuring.starts import continuation_candidates, hopped_fits

from ..conftest import spring_structure
from .conftest import target_of


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
