"""State matrices from subspaces, sections, simulation least squares, refinement."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from lpvlearn.subspace.identification import identify, max_horizon, max_order
from lpvlearn.subspace.realization import (
    METHODS,
    reflect_unstable,
    shift_invariant_pair,
)
from lpvlearn.subspace.refinement import refine_simulation
from lpvlearn.subspace.selection import (
    _held_out_error,
    _horizon_grid,
    _smallest_good_order,
    select,
)
from lpvlearn.subspace.signals import (
    Record,
    block_sections,
    signal_factor,
    signal_pieces,
)
from lpvlearn.subspace.simulation_fit import (
    Realization,
    _general_regression,
    freedom,
    linear_regression,
    simulation_fit,
    solve_regressions,
)
from lpvlearn.systems.simulation import (
    estimate_initial_state,
    free_responses,
    lti_response,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def modes(*poles):
    """Real block-diagonal matrix with the given poles (one of each complex pair)."""
    blocks = [
        [[p.real, p.imag], [-p.imag, p.real]] if np.imag(p) else [[np.real(p)]]
        for p in poles
    ]
    return block_diag(*blocks)


def example(rng, A, n_inputs=2, n_outputs=2):
    n = len(A)
    mix = np.linalg.qr(rng.standard_normal((n, n)))[0]
    B, C = rng.standard_normal((n, n_inputs)), rng.standard_normal((n_outputs, n))
    return mix @ A @ mix.T, B, C, rng.standard_normal((n_outputs, n_inputs))


def experiment(rng, system, n_samples=300, x0=None, noise=0.0):
    u = rng.standard_normal((n_samples, system[1].shape[1]))
    y = lti_response(*system, u, x0)
    return u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape)


def markov(A, B, C, D, n=30):
    out = [D]
    power = B
    for _ in range(n):
        out.append(C @ power)
        power = A @ power
    return np.array(out)


def sorted_poles(A):
    return np.sort_complex(np.linalg.eigvals(A).round(12))


POLES = (0.9 * np.exp(0.4j), 0.97 * np.exp(1.3j), 0.7, 0.95)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("refine", [True, False])
def test_noise_free_data_give_back_poles_and_markov_parameters(rng, method, refine):
    system = example(rng, modes(*POLES))
    runs = [experiment(rng, system, n, rng.standard_normal(6)) for n in (250, 300)]
    found = identify(runs, 6, 8, method=method, refine=refine)
    np.testing.assert_allclose(
        sorted_poles(found.A), sorted_poles(system[0]), atol=1e-8
    )
    expected = markov(*system)
    np.testing.assert_allclose(
        markov(*found[:4]), expected, atol=1e-8 * np.abs(expected).max()
    )
    assert found.residual < 1e-8


def test_initial_state_of_every_experiment_is_recovered(rng):
    system = example(rng, modes(*POLES))
    states = rng.standard_normal((3, 6))
    runs = [experiment(rng, system, 200, x0) for x0 in states]
    found = identify(runs, 6, 6)
    for (u, y), x0 in zip(runs, found.initial_states, strict=True):
        np.testing.assert_allclose(lti_response(*found[:4], u, x0), y, atol=1e-7)


def test_result_does_not_depend_on_the_units_of_the_channels(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 600, noise=0.1)
    found = identify([(u, y)], 6, 10)
    su, sy = np.array([1e9, 1e-3]), np.array([1e-9, 1e9])
    other = identify([(u * su, y * sy)], 6, 10)
    np.testing.assert_allclose(
        markov(*other[:4]) / sy[:, None] * su, markov(*found[:4]), rtol=1e-6, atol=1e-7
    )


def test_result_does_not_depend_on_the_basis_of_the_subspace(rng):
    system = example(rng, modes(*POLES))
    observability = np.vstack(
        [system[2] @ np.linalg.matrix_power(system[0], k) for k in range(8)]
    )
    observability = observability + 0.01 * rng.standard_normal(observability.shape)
    A, C = shift_invariant_pair(observability, 2, 6)
    T = rng.standard_normal((6, 6))
    A2, C2 = shift_invariant_pair(observability @ T, 2, 6)
    np.testing.assert_allclose(T @ A2, A @ T, atol=1e-9)
    np.testing.assert_allclose(C2, C @ T, atol=1e-12)


def test_pooled_experiments_are_better_than_one(rng):
    system = example(rng, modes(*POLES))
    runs = [experiment(rng, system, 300, noise=0.3) for _ in range(8)]
    truth = markov(*system)
    one = np.mean(
        [np.linalg.norm(markov(*identify([r], 6, 10)[:4]) - truth) for r in runs]
    )
    pooled = np.linalg.norm(markov(*identify(runs, 6, 10)[:4]) - truth)
    assert pooled < 0.6 * one


def test_feedthrough_off_fixes_D_at_zero(rng):
    A, B, C, D = example(rng, modes(*POLES))
    u, y = experiment(rng, (A, B, C, 0 * D))
    found = identify([(u, y)], 6, 8, feedthrough=False)
    assert not found.D.any()
    np.testing.assert_allclose(markov(*found[:4]), markov(A, B, C, 0 * D), atol=1e-7)


@pytest.mark.parametrize("engine", ["cholesky", "qr"])
def test_order_zero_is_the_least_squares_gain(rng, engine):
    u = rng.standard_normal((50, 2))
    y = u @ rng.standard_normal((2, 3)) + 0.1 * rng.standard_normal((50, 3))
    found = identify([(u, y)], 0, 2, engine=engine)
    np.testing.assert_allclose(found.D, np.linalg.lstsq(u, y, rcond=None)[0].T)
    assert found.A.shape == (0, 0)


@pytest.mark.parametrize("noise", ["white", "coloured"])
def test_pi_moesp_error_falls_with_the_number_of_samples(noise):
    errors = []
    system = example(np.random.default_rng(1), modes(0.9 * np.exp(0.5j), 0.8))
    truth = markov(*system)
    for n in (1000, 16000):
        runs = []
        for seed in range(4):
            rng = np.random.default_rng(seed)
            u, y = experiment(rng, system, n)
            e = rng.standard_normal(y.shape)
            if noise == "coloured":
                for t in range(1, n):
                    e[t] += 0.9 * e[t - 1]
            y = y + 0.3 * y.std(axis=0) * e / e.std(axis=0)
            found = identify([(u, y)], 3, 15, method="pi-moesp", refine=False)
            runs.append(np.linalg.norm(markov(*found[:4]) - truth))
        errors.append(np.median(runs))
    assert errors[1] < 0.45 * errors[0]  # 1/sqrt(16) = 0.25


def test_refinement_is_efficient_where_the_subspace_step_is_not():
    """A pole much slower than the horizon, as on the arm."""
    A = modes(0.998, 0.95 * np.exp(0.05j))
    gains = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        system = (A, np.eye(3), np.ones((1, 3)), np.zeros((1, 3)))
        u, y = experiment(rng, system, 2000, noise=0.05)
        truth = lti_response(*system, u)
        errors = [
            np.linalg.norm(
                lti_response(*identify([(u, y)], 3, 15, refine=r)[:4], u) - truth
            )
            for r in (True, False)
        ]
        gains.append(errors[0] / errors[1])
    assert np.median(gains) < 0.9


def test_refinement_stops_at_a_stationary_point_of_the_simulation_error(rng):
    system = example(rng, modes(0.9 * np.exp(0.5j), 0.8), 1, 1)
    u, y = experiment(rng, system, 200, noise=0.2)
    records = [Record(u.T.copy(), y.T.copy())]
    start = simulation_fit(system[0], system[2], records)
    model, n_iter = refine_simulation(start, records)
    assert n_iter > 0 and model.loss < start.loss

    def loss(A, C):
        return simulation_fit(A, C, records).loss

    for _ in range(10):
        dA, dC = rng.standard_normal(model.A.shape), rng.standard_normal((1, 3))
        h = 1e-5
        slope = loss(model.A + h * dA, model.C + h * dC) - loss(
            model.A - h * dA, model.C - h * dC
        )
        start_slope = loss(start.A + h * dA, start.C + h * dC) - loss(
            start.A - h * dA, start.C - h * dC
        )
        assert abs(slope) < max(0.1 * abs(start_slope), 1e-4 * model.loss)


@pytest.mark.parametrize(
    "A",
    [
        modes(*POLES),
        np.array([[1.0, 1.0], [0.0, 1.0]]),
        np.array([[0.9, 1.0, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 0.99]]),
        np.array([[0.9, 1.0, 0.0], [0.0, 0.9, 0.0], [0.3, 0.0, 0.2]]),
        np.array([[0.5]]),
    ],
    ids=["distinct", "double integrator", "double pole", "coupled", "one state"],
)
def test_sections_span_free_and_forced_responses(rng, A):
    n = len(A)
    B, C, D = rng.standard_normal((n, 1)), np.eye(n), np.zeros((n, 1))
    u = rng.standard_normal((60, 1))
    y = lti_response(A, B, C, D, u, rng.standard_normal(n))
    sections = block_sections(A)
    (piece,) = signal_pieces(sections.blocks, Record(u.T, y.T))
    signals = piece[: 2 * n].T
    fitted = signals @ np.linalg.lstsq(signals, y, rcond=None)[0]
    np.testing.assert_allclose(fitted, y, atol=1e-9 * np.abs(y).max())


def test_poles_of_high_multiplicity_have_no_sections():
    assert block_sections(np.eye(4, k=1) + 0.5 * np.eye(4)) is None


def test_both_regressions_give_the_same_B_D_and_initial_state(rng):
    system = example(rng, modes(*POLES))
    A, _, C, _ = system
    u, y = experiment(rng, system, 100, rng.standard_normal(6), noise=0.1)
    record = Record(u.T.copy(), y.T.copy())
    sections = block_sections(A)
    T = sections.transform
    free, blocks = freedom(2, 2), sections.blocks
    R = signal_factor(blocks, record)
    fast = solve_regressions([linear_regression(R, blocks, C @ T, free)], 6)
    slow = solve_regressions([_general_regression(A, C, record, free)], 6)
    np.testing.assert_allclose(T @ fast[1][0], slow[1][0], atol=1e-9)
    np.testing.assert_allclose(
        T @ fast[0][:12].reshape(6, 2), slow[0][:12].reshape(6, 2), atol=1e-9
    )
    np.testing.assert_allclose(fast[0][12:], slow[0][12:], atol=1e-9)
    np.testing.assert_allclose(fast[2], slow[2], rtol=1e-9)


def test_simulation_least_squares_loss_is_the_simulation_error(rng):
    system = example(rng, modes(*POLES))
    runs = [experiment(rng, system, n, noise=0.2) for n in (100, 140)]
    records = [Record(u.T.copy(), y.T.copy()) for u, y in runs]
    model = simulation_fit(system[0], system[2], records)
    error = sum(
        ((y - lti_response(*model[:4], u, x0)) ** 2).sum()
        for (u, y), x0 in zip(runs, model.initial_states, strict=True)
    )
    np.testing.assert_allclose(model.loss, error, rtol=1e-9)


def test_overflowing_simulation_has_infinite_loss(rng):
    record = Record(rng.standard_normal((1, 3000)), rng.standard_normal((1, 3000)))
    model = simulation_fit(np.array([[2.0]]), np.ones((1, 1)), [record])
    assert np.isinf(model.loss)


def test_initial_state_of_a_free_response_is_exact(rng):
    A, B, C, D = example(rng, modes(*POLES))
    x0 = rng.standard_normal(6)
    free = lti_response(A, B, C, D, np.zeros((50, 2)), x0)
    found = estimate_initial_state(free_responses(A, C, 50), free)
    np.testing.assert_allclose(found, x0, atol=1e-9)


def test_reflection_inverts_unstable_poles_and_keeps_the_others(rng):
    T = rng.standard_normal((5, 5))
    A = T @ modes(1.2 * np.exp(0.7j), 0.5, -1.25, 0.9) @ np.linalg.inv(T)
    expected = modes(np.exp(0.7j) / 1.2, 0.5, -0.8, 0.9)
    np.testing.assert_allclose(
        sorted_poles(reflect_unstable(A)), sorted_poles(expected), atol=1e-9
    )


def test_truly_unstable_system_is_kept_unless_stability_is_enforced(rng):
    system = example(rng, modes(1.02, 0.8), 1, 1)
    u, y = experiment(rng, system, 300)
    found = identify([(u, y)], 2, 6)
    np.testing.assert_allclose(sorted_poles(found.A), [0.8, 1.02], atol=1e-8)
    stable = identify([(u, y)], 2, 6, enforce_stability=True)
    assert np.abs(np.linalg.eigvals(stable.A)).max() < 1.0


def test_limits_count_columns_rows_and_instruments():
    for lengths in ([100], [30, 40, 50]):
        h = max_horizon(lengths, 2, 1)
        columns = [sum(max(0, n - 2 * k + 1) for n in lengths) for k in (h, h + 1)]
        assert columns[0] >= 6 * h and columns[1] < 6 * (h + 1)
    assert max_order(5, 1, 3, "po-moesp") == 12
    assert max_order(5, 1, 3, "pi-moesp") == 5


def test_horizon_grid_is_increasing_and_holds_both_ends():
    for low, high in ((1, 1), (2, 2), (2, 3), (4, 125)):
        grid = _horizon_grid(low, high)
        assert grid[0] == low and grid[-1] == high
        assert (np.diff(grid) > 0).all()


def test_order_rule_ignores_insignificant_gains(rng):
    noise = 1.0 + 0.1 * rng.standard_normal(20)
    blocks = [3.0 * noise, noise + 1e-6, noise - 1e-3 * rng.standard_normal(20)]
    assert _smallest_good_order(dict(zip([1, 2, 3], blocks, strict=True))) == 2
    assert _smallest_good_order({0: np.array([np.nan]), 1: np.ones(1)}) == 1


def test_held_out_error_is_measured_after_the_cut(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 100)
    y = y.copy()
    y[:70] += 1.0
    model = Realization(*system, np.zeros((1, 6)), 0.0)
    blocks, bft = _held_out_error(model, [Record(u.T, y.T)], [70])
    assert blocks.sum() < 1e-18
    assert bft == pytest.approx(100.0)


def test_selection_finds_the_order_of_noise_free_data(rng):
    system = example(rng, modes(*POLES))
    u, y = experiment(rng, system, 400)
    chosen = select([Record(u.T.copy(), y.T.copy())], None, None)
    assert chosen.order == 6
