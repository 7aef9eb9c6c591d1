import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import linalg, signal

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.metrics import bft_score
from lpvlearn.subspace.orders.decimation import SlowStarts, decimated, full_rate
from lpvlearn.subspace.orders.identification import Settings
from lpvlearn.subspace.samples.records import Record
from lpvlearn.subspace.simulation_error.simulation_fit import Freedom

STEP = 0.006  # seconds: some five hundred samples in a period of the faster mode


def _plant():
    modes = [[[0.0, 1.0], [-(w**2), -0.2 * w]] for w in (0.8, 2.0)]
    A = linalg.block_diag(*modes)
    model = StateSpace(A, [[0.0], [1.0], [0.0], [-2.0]], [[1.0, 0.0, 1.0, 0.0]])
    return model.to_discrete(STEP)


def _smooth_input(n_samples, seed):
    """What nothing above a hundredth of the Nyquist frequency is left of."""
    white = np.random.default_rng(seed).standard_normal(n_samples)
    return signal.sosfilt(signal.butter(4, 0.01, output="sos"), white)[:, None]


def _record(seed=0, n_samples=12_000, noise=0.03):
    plant, u = _plant(), _smooth_input(n_samples, seed)
    y = plant.simulate(u)
    e = np.random.default_rng(seed + 1).standard_normal(y.shape)
    return u, y + noise * y.std() * e


def _settings():
    return Settings(Freedom(np.ones((1, 1), bool)))


def _distance(A, others):
    """Of eigenvalues, each from the nearest of the others, by that one's damping."""
    poles, others = np.linalg.eigvals(A), np.asarray(others)
    nearest = others[np.abs(poles[:, None] - others).argmin(axis=1)]
    return np.abs(poles - nearest).max() / (1.0 - np.abs(others)).min()


class TestDecimated:
    @pytest.mark.parametrize("factor", [2, 7, 16])
    def test_tells_the_free_motion_of_a_system_at_a_lower_rate(self, factor):
        # Filtered, a sum of slow modes is one, and k steps are one by A^k.
        A = np.array([[0.999, 0.01], [-0.01, 0.999]])
        x = [np.array([1.0, 0.5])]
        for _ in range(2_000):
            x.append(A @ x[-1])
        u, y = np.zeros((2_001, 1)), np.array(x)
        slow = decimated([Record.of(u, y)], factor)[0].y
        step = np.linalg.matrix_power(A, factor)
        assert_allclose(slow[:, 1:], step @ slow[:, :-1], atol=1e-12)

    def test_samples_are_in_their_place(self):
        u = np.arange(3_000.0)[:, None]
        slow = decimated([Record.of(u, u**2)], 10)[0]
        assert_allclose(np.diff(slow.u[0]), 10.0)
        # The filter is symmetric: of a parabola it adds its own second moment.
        above = slow.y[0] - slow.u[0] ** 2
        assert_allclose(above, above[0], atol=1e-6)

    def test_weakens_what_the_lower_rate_cannot_show(self):
        n = np.arange(20_000)
        y = np.cos(np.pi * n / 8 * 1.3)[:, None]  # above the new Nyquist frequency
        slow = decimated([Record.of(y, y)], 8)[0]
        assert np.abs(slow.y).max() < 0.005

    def test_short_records_are_left_out(self):
        records = [Record.of(np.ones((n, 1)), np.ones((n, 2)), 1) for n in (30, 300)]
        (slow,) = decimated(records, 8)
        assert slow.y.shape == (2, (300 - 1) // 8 + 1 - 8)
        assert slow.trend.shape == (1, slow.y.shape[1])


class TestFullRate:
    def test_is_the_root_of_slow_and_integrating_systems(self):
        rng = np.random.default_rng(3)
        modes = [[[0.99, 0.02], [-0.02, 0.99]], 1.0, 0.95, 1.002]
        T = rng.standard_normal((5, 5))
        A = T @ linalg.block_diag(*modes) @ np.linalg.inv(T)
        assert_allclose(full_rate(np.linalg.matrix_power(A, 12), 12), A, atol=1e-9)

    def test_poles_that_no_slow_ones_lead_to_decay(self):
        A = full_rate(np.diag([0.5, -0.3, 0.0]), 2)
        assert_allclose(np.sort(np.linalg.eigvals(A)), [1e-3, 1e-3, np.sqrt(0.5)])

    def test_nothing_stays_nothing(self):
        assert full_rate(np.zeros((0, 0)), 3).shape == (0, 0)

    def test_none_for_eigenvectors_without_digits(self):
        assert full_rate(np.array([[0.9, 1.0], [0.0, 0.9]]), 2) is None


class TestSlowStarts:
    def test_finds_the_dynamics_without_noise(self):
        u, y = _record(noise=0.0)
        model = SlowStarts([Record.of(u, y)], 4, _settings()).best(4)
        assert _distance(model.A, _plant().poles()) < 0.01

    def test_is_near_where_long_horizons_see_noise(self):
        u, y = _record()
        model = SlowStarts([Record.of(u, y)], 8, _settings()).best(4)
        assert _distance(model.A, _plant().poles()) < 0.3
        assert model.loss < 1.1 * 0.03**2 * (y**2).sum()

    @pytest.mark.parametrize("n_samples", [12, 40])
    def test_short_records_have_none(self, n_samples):
        record = Record.of(*_record(n_samples=n_samples))
        assert SlowStarts([record], 5, _settings()).best(5) is None

    def test_none_of_order_zero(self):
        assert SlowStarts([Record.of(*_record())], 5, _settings()).best(0) is None


@pytest.mark.slow
def test_smooth_records_sampled_far_too_fast_are_fitted():
    model = SubspaceLTI(sampling_time=STEP).fit(*_record(0))
    plant, u = _plant(), _smooth_input(12_000, 2)
    assert 4 <= model.order_ <= 6
    assert bft_score(plant.simulate(u), model.lti_.simulate(u)) > 99.0


@pytest.mark.slow
def test_experiments_with_constants_are_fitted_alike():
    runs = [_record(seed) for seed in (0, 10)]
    pairs = [(u, y + level) for (u, y), level in zip(runs, (3.0, -2.0), strict=True)]
    X = [np.hstack([u, np.full((len(u), 1), k)]) for k, (u, _) in enumerate(pairs)]
    X, y = np.vstack(X), np.vstack([y for _, y in pairs])
    model = SubspaceLTI(experiment=1, offset="constant", sampling_time=STEP).fit(X, y)
    plant, u = _plant(), _smooth_input(12_000, 5)
    assert bft_score(plant.simulate(u), model.lti_.simulate(u)) > 99.0


@pytest.mark.slow
def test_orders_of_long_records_are_chosen_over_all_of_their_time():
    # The twelve thousand samples of a choice, at most, are too few of so slow a motion.
    rng = np.random.default_rng(9)
    modes = [[[0.0, 1.0], [-(w**2), -0.2 * w]] for w in (0.8, 2.0)]
    B, C = [[0.0], [1.0], [0.0], [-2.0]], [[1.0, 0.0, 1.0, 0.0]]
    plant = StateSpace(linalg.block_diag(*modes), B, C).to_discrete(0.001)
    u, fresh = rng.standard_normal((2, 60_000, 1))
    y = plant.simulate(u)
    model = SubspaceLTI().fit(u, y + y.std() * rng.standard_normal(y.shape))
    assert model.order_ >= 4  # 0 of the first samples alone
    assert bft_score(plant.simulate(fresh), model.lti_.simulate(fresh)) > 98.0
