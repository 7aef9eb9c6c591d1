"""Experiments on the arm: tables, seeds, localness, the sweep."""

import numpy as np
import pytest

from lpvlearn.datasets import (
    make_flexible_arm,
)

SMALL = {
    "n_operating_points": 3,
    "n_realizations": 2,
    "duration": 0.1,
    "sweep_duration": 0.15,
}


def test_tables_have_the_agreed_columns_and_labels():
    data = make_flexible_arm(**SMALL, random_state=0)
    for X, y, n_labels, n_samples in (
        (data.X, data.y, 6, 100),
        (data.X_local, data.y_local, 3, 100),
        (data.X_sweep, data.y_sweep, 1, 150),
    ):
        assert list(X.columns) == ["u1", "u2", "kappa", "experiment", "time"]
        assert list(y.columns) == ["y1", "y2"]
        assert len(X) == len(y) == n_labels * n_samples
        assert X.groupby("experiment").size().tolist() == [n_samples] * n_labels
        np.testing.assert_allclose(X["time"].to_numpy()[:3], [0, 1e-3, 2e-3])
        assert X["time"].groupby(X["experiment"]).is_monotonic_increasing.all()
    assert len(data.analytic_models) == 3 and data.structure.n_params == 16
    assert data.sampling_time == 1e-3 and "theta2 = i pi / 4" in data.DESCR
    np.testing.assert_allclose(data.theta2, np.pi * np.array([1, 2, 3]) / 4)
    np.testing.assert_allclose(data.operating_points, np.cos(data.theta2))
    means = data.X.groupby("experiment")["kappa"].mean().to_numpy()
    np.testing.assert_array_equal(means[::2], means[1::2])
    np.testing.assert_allclose(means[::2], data.operating_points, atol=1e-2)


def test_realizations_share_everything_but_the_noise():
    data = make_flexible_arm(**SMALL, random_state=0)
    X = data.X.to_numpy().reshape(3, 2, 100, 5)
    y = data.y.to_numpy().reshape(3, 2, 100, 2)
    np.testing.assert_array_equal(
        X[:, 0][..., [0, 1, 2, 4]], X[:, 1][..., [0, 1, 2, 4]]
    )
    assert (y[:, 0] != y[:, 1]).all()


def test_random_state_reproduces_and_realizations_do_not_shift_the_references():
    first, same = (make_flexible_arm(**SMALL, random_state=7) for _ in range(2))
    for name in ("X", "y", "X_local", "y_local", "X_sweep", "y_sweep"):
        assert first[name].equals(same[name])
    other = make_flexible_arm(**SMALL, random_state=8)
    assert not first.y.equals(other.y) and not first.X_local.equals(other.X_local)
    more = make_flexible_arm(**{**SMALL, "n_realizations": 3}, random_state=7)
    assert more.X_local.equals(first.X_local) and more.y_sweep.equals(first.y_sweep)
    np.testing.assert_array_equal(more.X["u1"][:100], first.X["u1"][:100])


def test_local_validation_is_new_and_noise_free():
    data = make_flexible_arm(**{**SMALL, "n_realizations": 1}, random_state=0)
    assert not np.array_equal(data.X["u1"], data.X_local["u1"])
    reference = data.X_local[["u1", "u2"]].to_numpy().reshape(3, 100, 2)
    y = data.arm.simulate(reference, data.theta2, 1e-3).y
    np.testing.assert_allclose(data.y_local, y.reshape(-1, 2), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_local_experiments_are_local_and_linear():
    data = make_flexible_arm(n_operating_points=3, random_state=0)
    groups = data.X_local.groupby("experiment")
    assert (groups["kappa"].max() - groups["kappa"].min()).max() < 0.03
    for label, rows in groups:
        y = data.y_local.loc[rows.index].to_numpy()
        model = data.analytic_models[label].simulate(
            rows[["u1", "u2"]].to_numpy(), sampling_time=1e-3
        )
        error = np.linalg.norm(y - model, axis=0)
        assert (error < 0.01 * np.linalg.norm(y - y.mean(axis=0), axis=0)).all()


@pytest.mark.slow
def test_sweep_visits_the_range_of_the_operating_points():
    data = make_flexible_arm(n_operating_points=1, duration=0.1, random_state=0)
    theta2 = np.arccos(data.X_sweep["kappa"])
    assert theta2.iloc[0] == pytest.approx(np.pi / 8)
    assert theta2.min() > np.pi / 9 and 6.5 * np.pi / 8 < theta2.max() < 7.1 * np.pi / 8


def test_scalar_clock_and_independent_bits():
    options = {**SMALL, "clock": 0.005, "balance_time": None}
    data = make_flexible_arm(**options, random_state=0)
    u = data.X_local[["u1", "u2"]].to_numpy().reshape(-1, 5, 2)
    np.testing.assert_array_equal(u, u[:, :1].repeat(5, axis=1))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"n_operating_points": 0}, "`n_operating_points` must be an integer"),
        ({"n_realizations": 1.5}, "`n_realizations` must be an integer"),
        ({"snr_db": np.nan}, "`snr_db` must be a number"),
        ({"duration": 0.0}, "`duration` must be finite and at least"),
        ({"sampling_time": -1.0}, "`sampling_time` must be a positive number"),
        ({"clock": 0.0}, "`clock` must be a positive multiple"),
        ({"clock": 0.0015}, "`clock` must be a positive multiple"),
        ({"clock": (0.01, 0.01, 0.01)}, "`clock` must be one time"),
        ({"balance_time": 0.0}, "`balance_time` must be positive, at most"),
        ({"amplitude": 0.0}, "`amplitude` must be finite and positive"),
    ],
)
def test_bad_options_of_the_generator(options, message):
    with pytest.raises(ValueError, match=message):
        make_flexible_arm(**{**SMALL, **options})
