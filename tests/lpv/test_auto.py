"""The choice of the form: true ones are found, untrue ones are left to the points."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from lpvlearn import AutoLPV, PolynomialLPV, SplineLPV

KAPPA = np.linspace(0, 2, 7)[:, None]
FINE = np.linspace(0, 2, 101)[:, None]

TRUTHS = {
    "polynomial 0": lambda k: np.hstack([0 * k + 2, 0 * k + 3]),
    "polynomial 1": lambda k: np.hstack([2 + k, 3 - 2 * k]),
    "polynomial 2": lambda k: np.hstack([2 + k + k**2, 3 + 0 * k]),
    "rational 1/1": lambda k: np.hstack([2 + 3 * k, 5 + 0 * k]) / (1 + k),
}


def noisy(truth, rng, deviation=0.01):
    """Parameters with correlated errors, and their covariances."""
    clean = truth(KAPPA)
    roots = (
        deviation * np.array([[1.0, 0.0], [0.8, 0.6]]) * rng.uniform(0.3, 3, (7, 1, 1))
    )
    errors = (roots @ rng.normal(size=(7, 2, 1)))[:, :, 0]
    return clean + errors, roots @ roots.swapaxes(1, 2)


@pytest.mark.broad
@pytest.mark.parametrize("form", TRUTHS)
def test_the_true_form_is_chosen(form):
    rng = np.random.default_rng(0)
    chosen = []
    for _ in range(10):
        theta, P = noisy(TRUTHS[form], rng)
        chosen.append(AutoLPV().fit(KAPPA, theta, covariance=P).form_)
    assert chosen.count(form) >= 9


def test_the_table_tells_what_was_compared():
    theta, P = noisy(TRUTHS["polynomial 2"], np.random.default_rng(1))
    model = AutoLPV().fit(KAPPA, theta, covariance=P)
    table = model.selection_
    assert table.columns.tolist() == ["form", "chi2", "dof", "aic", "chosen"]
    assert table["form"][table["chosen"]].tolist() == [model.form_] == ["polynomial 2"]
    np.testing.assert_allclose(table["aic"], table["chi2"] + 2 * (14 - table["dof"]))
    parabola = PolynomialLPV(2).fit(KAPPA, theta, covariance=P)
    row = table[table["chosen"]].iloc[0]
    assert (row["chi2"], row["dof"]) == (parabola.chi2_, 8)
    np.testing.assert_array_equal(model.predict(FINE), parabola.predict(FINE))
    np.testing.assert_array_equal(
        model.best_estimator_.predict(FINE), model.predict(FINE)
    )
    bayes = AutoLPV(criterion="bic").fit(KAPPA, theta, covariance=P).selection_
    np.testing.assert_allclose(
        bayes["bic"], table["chi2"] + np.log(14) * (14 - table["dof"])
    )


def test_a_form_that_is_not_true_is_not_taken_however_good():
    """A kink, known precisely."""
    theta = np.abs(KAPPA - 0.9) + KAPPA
    model = AutoLPV().fit(KAPPA, theta, covariance=np.full(7, 1e-12))
    assert model.form_ == "pchip"
    assert model.selection_["chosen"].tolist()[-1]
    np.testing.assert_allclose(model.predict(KAPPA), theta)


def test_without_covariances_the_points_are_followed():
    theta, _ = noisy(TRUTHS["polynomial 2"], np.random.default_rng(2))
    model = AutoLPV().fit(KAPPA, theta)
    assert model.selection_["form"].tolist() == ["cubic"]
    expected = SplineLPV("cubic").fit(KAPPA, theta).predict(FINE)
    np.testing.assert_array_equal(model.predict(FINE), expected)


WIDE = np.array([0.5, 0.8, 1.2, 2.0, 3.0])[:, None]


@pytest.mark.parametrize("power", [-0.5, 0.3, -1.0])
def test_powers_of_a_positive_variable_are_followed_over_its_logarithm(power):
    """Beside noise of what hardly moves, whose size is not known."""
    noise = 1e-3 * np.random.default_rng(0).normal(size=(5, 1))
    theta = np.column_stack([WIDE**power, -3.0 * WIDE ** (power / 2), noise])
    model = AutoLPV().fit(WIDE, theta)
    assert model.form_.startswith("log ")
    between = np.array([[0.65], [1.0], [1.6], [2.5]])
    errors = model.predict(between)[:, :1] / between**power - 1.0
    shape_kept = SplineLPV().fit(WIDE, theta).predict(between)[:, :1]
    kept = shape_kept / between**power - 1.0
    assert np.abs(errors).max() < 0.15 * np.abs(kept).max()


def test_a_smooth_curve_over_logarithms_that_meets_points_by_chance_is_not_taken():
    """An elbow's angle: over its logarithm the curve that keeps the shape is worse."""
    angle = np.array([0.2, 0.9, 1.5, 2.2, 2.9])[:, None]
    c = np.cos(angle[:, 0])
    M = np.array([[3.0 + 1.2 * c, 0.6 + 0.6 * c], [0.6 + 0.6 * c, 0.6 + 0.0 * c]])
    inverse = np.linalg.inv(M.transpose(2, 0, 1)).reshape(5, 4)
    theta = np.hstack([-inverse * [2.0, 1.0, 2.0, 1.0], inverse[:, [0, 1, 3]]])
    assert AutoLPV().fit(angle, theta).form_ == "pchip"


def test_what_is_smooth_over_any_variable_is_followed_by_a_cubic_spline():
    kappa = np.linspace(-1.0, 1.0, 7)[:, None]
    theta = np.column_stack([kappa**2, np.exp(kappa)])
    assert AutoLPV().fit(kappa, theta).form_ == "cubic"
    steps = np.where(kappa > 0.1, 1.0, 0.0)  # of which it would swing
    assert AutoLPV().fit(kappa, steps).form_ == "pchip"
    few = AutoLPV().fit(kappa[:4], theta[:4])  # two left out tell too little
    assert few.form_ == "pchip"


def test_black_boxes_of_smooth_matrices_are_followed_by_a_cubic_spline():
    """Of thirty entries some hardly move, by noise, and are better left as they are."""
    kappa = np.linspace(0.0, 1.0, 7)[:, None]
    rng = np.random.default_rng(3)
    entries = rng.uniform(-1.0, 1.0, (2, 30)) * np.repeat([1.0, 1e-3], [27, 3])
    noise = 5e-3 * rng.standard_normal((7, 30))

    def truth(at):
        return np.column_stack([np.sin(5.0 * at), at]) @ entries

    between = 0.5 * (kappa[1:] + kappa[:-1])
    model = AutoLPV().fit(kappa, truth(kappa) + noise)
    assert model.form_ == "cubic"
    kept = SplineLPV().fit(kappa, truth(kappa) + noise).predict(between)
    error, other = model.predict(between) - truth(between), kept - truth(between)
    assert np.linalg.norm(error) < 0.4 * np.linalg.norm(other)


@pytest.mark.parametrize(("n_points", "form"), [(1, 0), (2, 1), (3, 2)])
def test_few_points_carry_a_constant_a_line_or_a_parabola(n_points, form):
    theta = np.exp(KAPPA[:n_points])
    variance = np.full((n_points, 1, 1), 1e-8)
    model = AutoLPV().fit(KAPPA[:n_points], theta, covariance=variance)
    assert model.form_ == f"polynomial {form}"
    np.testing.assert_allclose(model.predict(KAPPA[:n_points]), theta)


def test_three_points_of_one_parameter_that_varies_carry_a_parabola():
    """A rational function of degrees 1 and 1 meets them with fewer coefficients."""
    kappa = np.array([[0.0], [1.0], [1.5]])
    theta = np.hstack(
        [30 + 0 * kappa, 1.2 + 0 * kappa, 40 + 10 * kappa + 20 * kappa**2]
    )
    P = np.tile(np.diag([1e-4, 1e-6, 1e-4]), (3, 1, 1))
    model = AutoLPV().fit(kappa, theta, covariance=P)
    assert model.form_ == "polynomial 2"
    np.testing.assert_allclose(model.predict([[0.5]]), [[30, 1.2, 50]], rtol=1e-6)


@pytest.mark.slow
def test_forms_of_two_variables():
    axes = np.meshgrid(np.linspace(0, 1, 5), np.linspace(20, 40, 4), indexing="ij")
    kappa = np.stack(axes, axis=-1).reshape(-1, 2)
    load, speed = kappa[:, 0], kappa[:, 1] / 30
    rng = np.random.default_rng(3)
    truths = {
        "polynomial 1": [1 + load - speed, 2 * speed],
        "tensor polynomial 1": [1 + load * speed, 2 - load],
        "polynomial 2": [1 + load**2, 2 + speed**2 + load * speed],
        "rational 1/1": [(1 + load) / (1 + speed), speed / (1 + speed)],
    }
    for form, truth in truths.items():
        theta = np.column_stack(truth) + 1e-3 * rng.normal(size=(20, 2))
        P = np.tile(1e-6 * np.eye(2), (20, 1, 1))
        model = AutoLPV().fit(kappa, theta, covariance=P)
        assert model.form_ == form, model.selection_
        error = model.predict(kappa) - np.column_stack(truth)
        assert np.sqrt(np.mean(error**2)) < 1e-3


def test_points_on_a_curve_choose_among_what_they_determine():
    kappa = np.linspace(0, 1, 8)[:, None] * [1.0, 2.0]
    model = AutoLPV().fit(kappa, kappa[:, 0] ** 2, covariance=np.full(8, 1e-6))
    assert set(model.selection_["form"]) <= {"polynomial 0", "pchip"}
    np.testing.assert_allclose(model.predict(kappa), kappa[:, 0] ** 2, atol=1e-9)


def test_criteria_that_are_not_known_are_refused():
    with pytest.raises(ValueError, match="`criterion` must be 'aic' or 'bic'"):
        AutoLPV(criterion="press").fit(KAPPA, KAPPA)


def test_forms_with_nearly_a_coefficient_for_every_value_must_foresee_points():
    """A narrow bump, which a rational form meets at all points and nowhere else."""

    def bump(x):
        return np.column_stack([np.exp(-((x - 0.5) ** 2) / 0.01), 2 + 3 * x, 1 + x])

    def fitted(values):
        noise = 1e-3 * np.random.default_rng(0).normal(size=values.shape)
        covariance = np.tile(1e-6 * np.eye(3), (len(values), 1, 1))
        return AutoLPV().fit(kappa[:, None], values + noise, covariance=covariance)

    kappa = np.linspace(0, 1, 5)
    assert fitted(bump(kappa)).form_ == "pchip"
    true = np.column_stack([1 / (1.2 + kappa), 2 + kappa, 3 / (1.2 + kappa)])
    assert "rational" in fitted(true).form_


@pytest.mark.parametrize("seed", [107, 266, 312])
def test_polynomials_of_high_degrees_must_foresee_points(seed):
    """Steps through six points, 2 to 9 beyond which a quartic swings."""
    rng = np.random.default_rng(seed)
    kappa = np.sort(rng.uniform(0.0, 1.0, 6))[:, None]
    step = np.tanh(25.0 * (kappa[:, 0] - rng.uniform(0.3, 0.7)))
    values = step + 0.02 * rng.standard_normal(6)
    model = AutoLPV().fit(kappa, values, covariance=np.full(6, 4e-4))
    drawn = model.predict(np.linspace(*model.scheduling_range_, 100))
    assert np.abs(drawn).max() < np.abs(values).max() + 0.2


@pytest.mark.slow
def test_rational_forms_of_a_grid_must_foresee_whole_levels():
    """Three levels determine no common denominator, whatever single points tell."""
    kappa = np.array([[q, h] for q in (1.0, 4.0, 8.0) for h in (0.0, 0.5, 1.0)])

    def truth(kappa):
        q, h = kappa.T
        laws = (1 + 0.2 * h, 1 - 0.1 * h**2, 0.2 + 0.2 / q, 0.4 * (1 - 0.3 * h), 0.1)
        return np.column_stack([q * law for law in laws])

    fine = np.array([[q, h] for q in (1.5, 2.5, 6.0, 7.0) for h in (0.25, 0.75)])
    for seed in range(3):
        clean, rng = truth(kappa), np.random.default_rng(seed)
        theta = clean * (1.0 + 0.002 * rng.standard_normal(clean.shape))
        covariance = np.array([np.diag((0.002 * row) ** 2) for row in clean])
        model = AutoLPV().fit(kappa, theta, covariance=covariance)
        assert np.abs(model.predict(fine) / truth(fine) - 1.0).max() < 0.1


@pytest.mark.slow
def test_a_rational_form_that_is_a_cubic_without_a_point_is_not_told_by_that():
    """Through five points it has a pole, through four of them it meets the spline's."""
    kappa = np.array([0.0, 0.22, 0.44, 0.67, 1.0])[:, None]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        values = np.cos(np.pi * kappa + np.arange(3.0)) * [1.0, 0.3, 2.0]
        values += 1e-5 * rng.standard_normal(values.shape)
        P = np.tile(1e-10 * np.eye(3), (5, 1, 1))
        model = AutoLPV().fit(kappa, values, covariance=P)
        assert model.form_ == "cubic"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 22, 24, 38])
def test_squares_of_several_variables_must_foresee_scattered_points(seed):
    """Products of squares, nine for twelve points: they swing between these."""
    rng = np.random.default_rng(seed)

    def truth(kappa):
        p, q = 0.2 + kappa[:, 0], kappa[:, 1]
        return np.column_stack([1 / p, (1 + 0.3 * q) / np.sqrt(p), 1 + q + 0.2 * p])

    kappa, fine = rng.uniform(0.0, 1.0, (12, 2)), rng.uniform(0.0, 1.0, (600, 2))
    fine = fine[Delaunay(kappa).find_simplex(fine) >= 0]
    clean, spread = truth(kappa), np.ptp(truth(fine), axis=0)
    theta = clean + 0.01 * spread * rng.standard_normal(clean.shape)
    P = np.tile(np.diag((0.01 * spread) ** 2), (12, 1, 1))
    model = AutoLPV().fit(kappa, theta, covariance=P)
    error = (model.predict(fine) - truth(fine)) / spread
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("n_points", [1, 3, 4, 5])
def test_a_variable_of_one_value_does_not_count(n_points):
    kappa = np.linspace(0.0, 2.0, n_points)[:, None]
    noise = 0.05 * np.random.default_rng(0).standard_normal((n_points, 1))
    theta, P = 4.0 + 3.0 * kappa**2 + noise, np.full(n_points, 0.0025)
    one = AutoLPV().fit(kappa, theta, covariance=P)
    two = AutoLPV().fit(np.insert(kappa, 0, 5.0, axis=1), theta, covariance=P)
    assert two.form_ == one.form_
    beside = np.insert(FINE, 0, 5.0, axis=1)
    np.testing.assert_allclose(two.predict(beside), one.predict(FINE), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
def test_three_points_tell_a_pole_that_bends_all_parameters(times):
    """A pendulum of three lengths; a parabola that meets them is off by a sixth."""
    kappa = np.repeat([[0.5], [1.0], [2.0]], times, axis=0)
    fine = np.linspace(0.5, 2.0, 40)[:, None]

    def laws(length):
        return np.hstack([9.81 / length, 0.4 / length, 1.0 / length, 3.0 + 0 * length])

    def squares(speed):
        return np.hstack([3.0 + speed**2, 1.0 - 0.5 * speed**2, speed**2])

    parabola = PolynomialLPV(2).fit(kappa, laws(kappa)).predict(fine)
    assert np.abs(parabola / laws(fine) - 1.0).max() > 0.15
    for truth, form in ((laws, "rational 1/1"), (squares, "polynomial 2")):
        clean, errors = truth(kappa), []
        for seed in range(8):
            noise = np.random.default_rng(seed).standard_normal(clean.shape)
            P = np.array([np.diag((0.003 * row) ** 2) for row in clean])
            theta = clean + 0.003 * np.abs(clean) * noise
            model = AutoLPV().fit(kappa, theta, covariance=P)
            if model.form_ == form:
                error = model.predict(fine) - truth(fine)
                errors.append(np.abs(error / np.abs(truth(fine)).max(axis=0)).max())
        assert len(errors) >= 7 and max(errors) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_entries_that_are_noise_hide_no_law_of_one(seed):
    """Black boxes of a tank: its pole falls with the root of the level, no more."""
    level = np.geomspace(0.1, 2.5, 5)[:, None]
    rng = np.random.default_rng(seed)
    constant = [0.02, 1.0, 0.0] + 1e-3 * rng.standard_normal((5, 3))
    model = AutoLPV().fit(level, np.hstack([-0.05 / np.sqrt(level), constant]))
    assert model.form_.startswith("log ")
    between = np.sqrt(level[1:] * level[:-1])
    pole = model.predict(between)[:, :1]
    np.testing.assert_allclose(pole, -0.05 / np.sqrt(between), rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_variable_that_tells_nothing_is_left_out(seed):
    """A supply voltage, say, that is nearly constant; six points tell of no plane."""
    rng = np.random.default_rng(seed)
    speed, supply = np.linspace(0, 2, 6), 5.0 + 0.03 * rng.standard_normal(6)
    kappa = np.column_stack([speed, supply])

    def truth(x):
        return np.column_stack([40 + 20 * x**2, np.exp(x), 30 / (1 + x)])

    theta = truth(speed) + 1e-3 * rng.standard_normal((6, 3))
    known = {"covariance": np.tile(1e-6 * np.eye(3), (6, 1, 1))}
    between = 0.5 * (kappa[1:] + kappa[:-1])
    model, alone = AutoLPV().fit(kappa, theta, **known), AutoLPV()
    alone.fit(kappa[:, :1], theta, **known)
    assert model.form_ == f"{alone.form_} of variable 0"
    assert model.best_estimator_.variables == [0]
    np.testing.assert_allclose(model.predict(between), alone.predict(between[:, :1]))
    refitted = model.best_estimator_.fit(kappa, theta)
    np.testing.assert_array_equal(
        refitted.predict(between), refitted.predict(between * [1.0, 1.001])
    )


def test_variables_that_matter_are_kept():
    grid = np.stack(np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]), -1).reshape(-1, 2)
    theta = grid[:, 0] ** 2 + 0.1 * grid[:, 1]
    model = AutoLPV().fit(grid, theta, covariance=np.full(9, 1e-6))
    assert model.best_estimator_.variables is None
    assert not model.selection_["form"].str.contains("of variable").any()
