"""Starting points: neighbouring basins, and positive parameters."""

import numpy as np

from lpvlearn import GrayBoxStructure, StateSpace
from lpvlearn.restructuring.error_system import ErrorSystem
from lpvlearn.restructuring.least_squares import fit_frequency_response, grid_and_margin
from lpvlearn.restructuring.limits import stability_test
from lpvlearn.restructuring.starts import continuation_candidates, hopped_fits
from lpvlearn.restructuring.transfer import Target


def two_modes():
    """A strong mode at 1 rad/s, and a weak one at 3 rad/s."""
    A = [[0, 1, 0, 0], [-1, -0.02, 0, 0], [0, 0, 0, 1], [0, 0, -9, -0.02]]
    return StateSpace(A, [[0], [1], [0], [1]], [[1, 0, 2.0, 0]])


def target_of(model):
    return Target(model.A, model.B, model.C, model.D, model.sampling_time)


def oscillator():
    return GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["b"]], [[1, 0]]
    )


def fit_of(structure, model, params):
    target = target_of(model)
    system = ErrorSystem(structure, target)
    omega, margin = grid_and_margin(target)
    admissible = stability_test(system, margin)
    G0 = system.target_response(omega)
    fit = fit_frequency_response(
        system, structure.check_params(params), omega, G0, admissible=admissible
    )
    return system, omega, G0, admissible, fit


def test_a_hop_leaves_the_basin_of_the_weak_mode():
    structure = oscillator()
    system, omega, G0, admissible, fit = fit_of(
        structure, two_modes(), {"k": 9.0, "c": 0.02, "b": 2.0}
    )
    k = structure.parameter_names.index("k")
    assert abs(fit.x[k] - 9) < 1
    rng = np.random.default_rng(0)
    fits = hopped_fits(system, [fit], omega, G0, admissible, rng)
    costs = [found.cost for found in fits]
    assert costs == sorted(costs)
    assert costs[0] < 0.9 * fit.cost
    assert abs(fits[0].x[k] - 1) < 0.1


def test_hops_keep_the_bounds_and_what_is_good():
    structure = oscillator().with_bounds({"k": (8, 10), "c": (0.01, None)})
    system, omega, G0, admissible, fit = fit_of(
        structure, two_modes(), {"k": 9.0, "c": 0.02, "b": 2.0}
    )
    fits = hopped_fits(system, [fit], omega, G0, admissible, np.random.default_rng(1))
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
