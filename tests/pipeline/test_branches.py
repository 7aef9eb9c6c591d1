"""One smooth family out of equally good parameters at the operating points."""

from itertools import permutations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.base import clone

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    OutputErrorLPV,
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
    from_trajectories,
)
from lpvlearn.pipeline.one_basis.branches import smoothest_family, tied_branches
from lpvlearn.restructuring.problem import problem_from_models

NOISE = 0.01


def shuffled(theta, rng, n_first=1):
    """Candidates of points (n_points, n_parts, n_each), every part anywhere."""
    orders = [list(pi) for pi in permutations(range(theta.shape[1]))]
    rows = []
    for k, row in enumerate(theta):
        own = row if k < n_first else row[rng.permutation(len(row))]
        rows.append(np.array([own[pi].ravel() for pi in orders]))
    return rows


def chosen_parts(kappa, candidates, shape, noise=NOISE):
    variances = [np.full_like(rows, noise**2) for rows in candidates]
    found = smoothest_family(kappa, candidates, variances, 1)
    picked = [rows[i] for rows, i in zip(candidates, found.chosen, strict=True)]
    return np.reshape(picked, shape), found.doubts


def smooth_parts(rng, x, n_parts, n_each):
    a, b, c = (
        rng.normal(size=(3, n_parts, n_each)) * np.array([1, 0.7, 0.3])[:, None, None]
    )
    x = x[:, None, None]
    return a + b * x + c * x**2


@pytest.mark.slow
def test_families_stay_whole_or_are_doubted():
    wrong = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        kappa = np.linspace(0.0, 2.0, int(rng.integers(5, 10)))[:, None]
        shape = len(kappa), int(rng.integers(2, 5)), 2
        theta = smooth_parts(rng, kappa[:, 0] - 1.0, *shape[1:])
        theta = theta + NOISE * rng.normal(size=shape)
        found, doubts = chosen_parts(kappa, shuffled(theta, rng), shape)
        good = any(
            np.allclose(found[:, list(pi)], theta, atol=0.1)
            for pi in permutations(range(shape[1]))
        )
        wrong += not good
        assert good or doubts
    assert wrong <= 2


def test_branches_cross_with_their_slopes():
    kappa = np.linspace(0.0, 1.0, 6)[:, None]
    rising = np.stack([kappa + 1.0, 2.0 - kappa], 1)  # they cross at 1/2
    found, doubts = chosen_parts(
        kappa, shuffled(rising, np.random.default_rng(0)), (6, 2)
    )
    np.testing.assert_allclose(found, rising[..., 0])
    assert not doubts


def test_what_is_the_same_in_all_parts_does_not_hide_what_differs():
    rng = np.random.default_rng(1)
    kappa = np.linspace(0.0, 1.0, 5)[:, None]
    theta = np.stack([[[400.0, 1.0]] * 5, [[400.0, 1.2]] * 5, [[4.0, 7.0]] * 5], 1)
    theta = theta + NOISE * rng.normal(size=theta.shape)
    found, doubts = chosen_parts(kappa, shuffled(theta, rng), theta.shape)
    np.testing.assert_array_equal(found, theta)
    assert not doubts


def test_units_of_parameters_and_of_the_scheduling_variables_do_not_matter():
    rng = np.random.default_rng(2)
    x = rng.uniform(size=(8, 2))
    theta = np.stack([x + [1.0, 0.0], 1.5 - 0.5 * x], 1)
    candidates = shuffled(theta, rng)
    plain, _ = chosen_parts(x, candidates, theta.shape)
    unit = np.array([1e-9, 1e12])
    scaled = [rows * np.tile(unit, 2) for rows in candidates]
    other, _ = chosen_parts(x * [1e6, 1e-6] + 5.0, scaled, theta.shape, 0.0)
    np.testing.assert_allclose(other / unit, plain, rtol=1e-12)
    assert any(np.array_equal(plain[:, list(pi)], theta) for pi in ((0, 1), (1, 0)))


def test_a_value_that_is_not_determined_does_not_pull_the_others():
    rng = np.random.default_rng(3)
    kappa = np.linspace(0.0, 1.0, 7)[:, None]
    theta = np.stack([kappa + 1.0, 3.0 - kappa], 1) + NOISE * rng.normal(size=(7, 2, 1))
    theta[3] = [[500.0], [-490.0]]
    candidates = shuffled(theta, rng)
    variances = [np.full_like(rows, NOISE**2) for rows in candidates]
    variances[3][:] = np.inf
    found = smoothest_family(kappa, candidates, variances, 1)
    picked = [rows[i] for rows, i in zip(candidates, found.chosen, strict=True)]
    keep = np.arange(7) != 3
    expected = theta[keep, :, 0]
    np.testing.assert_allclose(np.array(picked)[keep], expected, atol=5 * NOISE)


def test_two_ways_as_smooth_are_doubted():
    """Bends away or crosses: three points cannot tell."""
    kappa = np.array([[0.0], [1.0], [2.0]])
    theta = np.stack([[[0.0], [0.9], [1.2]], [[2.0], [1.1], [0.8]]], 1)
    _, doubts = chosen_parts(kappa, shuffled(theta, np.random.default_rng(4)), (3, 2))
    assert doubts and all(0.0 < doubt.probability < 0.95 for doubt in doubts)
    assert doubts[0].params.tolist() == [0, 1]


def test_one_point_and_one_candidate_leave_nothing_to_choose():
    rows = np.array([[1.0, 2.0], [2.0, 1.0]])
    assert smoothest_family(np.zeros((1, 1)), [rows], [0 * rows]).chosen.tolist() == [0]
    single = [rows[:1], rows[1:]]
    found = smoothest_family(np.array([[0.0], [1.0]]), single, [0 * r for r in single])
    assert found.chosen.tolist() == [0, 0] and not found.doubts


# -- from data to the LPV model --------------------------------------------------------

STEP = 0.1
MODES = GrayBoxStructure.modal(2)


def modes_at(kappa):
    values = {
        "c1_1": 1.0,
        "c1_2": 0.1,
        "c1_3": 2.0,
        "c1_4": 0.3,
        "d_1": 0.4,
        "d_2": 1.0,
    }
    return values | {"w2_1": 4.0 + 2.0 * kappa, "w2_2": 30.0 + 10.0 * kappa}


def modes_tables(kappas, noise=0.01, seed=0):
    rng = np.random.default_rng(seed)
    runs = []
    for kappa in kappas:
        u = rng.choice([-1.0, 1.0], (200, 1)).repeat(2, axis=0)
        y = MODES.model(modes_at(kappa)).simulate(u, sampling_time=STEP)
        runs.append((u, kappa, y + noise * y.std() * rng.standard_normal(y.shape)))
    return from_trajectories(runs, sampling_time=STEP)


def modes_pipeline(structure=MODES, seed=0, **options):
    return LocalLPVPipeline(
        SubspaceLTI(4, feedthrough=False, horizon=12),
        GrayBoxRestructurer(structure, random_state=seed),
        scheduling="kappa",
        experiment="experiment",
        time="time",
        **options,
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("efficient", [True, False])
def test_modes_keep_their_places_between_points(seed, efficient):
    kappas = np.linspace(0.0, 2.0, 4)
    pipeline = modes_pipeline(seed=seed, efficient=efficient).fit(*modes_tables(kappas))
    for kappa in (kappas[1:] + kappas[:-1]) / 2:
        truth = MODES.model(modes_at(kappa))
        assert (pipeline.lpv_.at(kappa) - truth).hinf_norm() < 0.02 * truth.hinf_norm()
    # what describes a point follows the choice
    report, table = pipeline.report_, pipeline.parameters_
    for k, fitted in enumerate(pipeline.restructurers_):
        np.testing.assert_array_equal(fitted.params_, table.iloc[k])
        np.testing.assert_array_equal(
            report.filter(like="param_").iloc[k], table.iloc[k]
        )
        model = fitted.structure_.model(fitted.params_)
        for name in "ABCD":
            kept = getattr(pipeline.structured_models_[k], name)
            np.testing.assert_array_equal(getattr(model, name), kept)
        P = pipeline.parameters_covariance_[k]
        np.testing.assert_allclose(np.diag(P), pipeline.parameters_std_.iloc[k] ** 2)
    order = pipeline.parameters_[["w2_1", "w2_2"]].to_numpy().argsort(1)
    assert (order == [0, 1]).all()  # the slow one is the first, whatever the seed
    ratio = pipeline.parameters_std_["w2_2"] / pipeline.parameters_std_["w2_1"]
    assert (ratio > 1.0).all()  # standard deviations stay with their modes


@pytest.mark.slow
@pytest.mark.parametrize(("slow", "fast"), ["12", "21"])
def test_what_is_known_of_the_parts_numbers_them(slow, fast):
    X, y = modes_tables((0.0, 1.0))
    ranged = MODES.with_ranges({f"w2_{slow}": (3, 10), f"w2_{fast}": (20, 60)})
    bounded = MODES.with_bounds({f"w2_{slow}": (None, 15), f"w2_{fast}": (15, None)})
    for structure in (ranged, bounded):
        pipeline = modes_pipeline(structure, interpolator=PolynomialLPV(1))
        found = pipeline.fit(X, y).parameters_
        assert (found[f"w2_{slow}"] < found[f"w2_{fast}"]).all()


@pytest.mark.slow
def test_choices_are_kept_in_a_memory(tmp_path):
    X, y = modes_tables((0.0, 2.0))
    options = {"memory": tmp_path, "interpolator": PolynomialLPV(1)}
    first, again = (modes_pipeline(**options).fit(X, y).parameters_ for _ in range(2))
    np.testing.assert_array_equal(first, again)


LAGS = GrayBoxStructure.from_template([["-a", 0], ["a", "-b"]], [["g"], [0]], [[0, 1]])


def lags(structure, *, n_points=8, init="similarity", memory=None):
    """Two tanks in series, one of which is 1.5 times as slow at all points."""
    rng = np.random.default_rng(3)
    kappa, outputs, inputs = np.linspace(0.5, 3.0, n_points), [], []
    for level in kappa:
        rate = 1.0 / np.sqrt(level)
        u = np.repeat(rng.choice([-1.0, 1.0], 60), 15)[:, None]
        plant = LAGS.model([rate / 60.0, rate / 90.0, 0.02])
        y = plant.simulate(u, sampling_time=2.0)
        outputs.append(y + 0.01 * y.std() * rng.standard_normal(y.shape))
        inputs.append(np.column_stack([u, np.full(len(u), level)]))
    pipeline = LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(structure, init=init),
        scheduling=1,
        experiment=1,
        sampling_time=2.0,
        memory=memory,
    )
    return pipeline.fit(np.vstack(inputs), np.vstack(outputs))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:All experiments are at one operating point")
@pytest.mark.parametrize("n_points", [1, 8])
def test_parameters_with_other_values_at_all_points_are_told(n_points):
    """Either family is as smooth: the slow lag may be either, with another gain."""
    told = r"a, b, g have other values .* \(scheduling 0.5\): a = .*with_ranges"
    with pytest.warns(UserWarning, match=told) as caught:
        lags(LAGS, n_points=n_points)
    assert sum("have other values" in str(w.message) for w in caught) == 1


@pytest.mark.slow
def test_bounds_for_all_parts_leave_one_family():
    """Whose parts exchanged at all points it is still: a warning would be an error."""
    bounds = dict.fromkeys(MODES.parameter_names, (-99.0, 99.0))
    modes_pipeline(MODES.with_bounds(bounds)).fit(*modes_tables(range(4)))


@pytest.mark.slow
@pytest.mark.parametrize("g", [0.02, 0.03])
@pytest.mark.parametrize("known", ["range", "bound", "guess"])
def test_what_is_known_of_them_tells_which_is_which(known, g, memory):
    interval, structure, init = {"g": (0.8 * g, 1.2 * g)}, LAGS, "similarity"
    if known == "range":
        structure = LAGS.with_ranges(interval)
    elif known == "bound":
        structure = LAGS.with_bounds(interval)
    else:
        init = [0.02, 0.01, 0.02]
        if g == 0.03:
            init = {"a": 0.01, "b": 0.02, "g": 0.03}
    found = lags(structure, n_points=4, init=init, memory=memory)
    np.testing.assert_allclose(found.parameters_["g"], g, rtol=0.05)


# -- the mirror image of a whole family ------------------------------------------------


def coils(r1="r1", l1="l1", r2="r2", l2="l2"):
    """A coil, a capacitor and a coil; or a motor, a spring and a load."""
    return GrayBoxStructure.from_template(
        A=[[f"-{r1}", f"-{l1}", 0], [1, 0, -1], [0, l2, f"-{r2}"]],
        B=[[l1], [0], [0]],
        C=[[0, 0, 1]],
    )


def two_coils(varies, *, n_sweeps, noise=0.01, seed=0, fast=1):
    """Tables of local experiments and sweeps, if one of the two varies, the other not.

    As the frozen responses are the same whichever does, the sweeps tell.
    """
    ends = np.array([[0.0], [2.0]])
    vary, stay = {"r": [0.3, 1.1], "l": [4.0, 14.0]}, {"r": [0.5, 0.5], "l": [6.0, 6.0]}
    values = {f"{k}{varies}": v for k, v in vary.items()}
    values |= {f"{k}{3 - varies}": v for k, v in stay.items()}
    structure = coils()
    theta = np.array([values[name] for name in structure.parameter_names]).T
    truth = LPVStateSpace(structure, PolynomialLPV(1).fit(ends, theta), ends)
    rng, runs = np.random.default_rng(seed), []
    sweep = 1.0 - np.cos(np.linspace(0.0, fast * 2.0 * np.pi, 600))
    for kappa in (*np.linspace(0.0, 2.0, 4), *[sweep] * n_sweeps):
        u = rng.choice([-1.0, 1.0], (200, 1)).repeat(3, axis=0)
        y = truth.simulate(u, np.broadcast_to(kappa, 600), STEP)
        runs.append((u, kappa, y + noise * y.std() * rng.standard_normal(y.shape)))
    return from_trajectories(runs, sampling_time=STEP)


def coils_pipeline(structure, memory, refiner=None, **options):
    return LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(structure, **options),
        refiner=refiner,
        memory=memory,
        scheduling="kappa",
        experiment="experiment",
        time="time",
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "varies, names", [(1, ()), (2, ("rotor", "motor", "friction", "load"))]
)
def test_experiments_that_move_choose_among_mirror_images(varies, names, memory):
    """Whatever the names: and so nothing is told (a warning would be an error)."""
    pipeline = coils_pipeline(coils(*names), memory, OutputErrorLPV())
    pipeline.fit(*two_coils(varies, n_sweeps=1))
    X, y = two_coils(varies, n_sweeps=1, noise=0.0, seed=5)
    fresh = X["experiment"] == X["experiment"].max()
    assert bft_score(y[fresh], pipeline.predict(X[fresh])) > 99.0
    theta, models = pipeline.parameters_.to_numpy(), pipeline.structured_models_
    for row, fitted, model in zip(theta, pipeline.restructurers_, models, strict=True):
        np.testing.assert_array_equal(fitted.params_, row)
        np.testing.assert_array_equal(fitted.lti_.A, model.A)
    first, second = coils(*names).parameter_names[:2] if not names else names[1::2]
    spread = pipeline.parameters_[[first, second]].std()
    assert spread.argmax() + 1 == varies


@pytest.mark.slow
@pytest.mark.parametrize("names", [(), ("rotor", "motor", "friction", "load")])
def test_mirror_images_that_nothing_tells_apart_are_told(names, memory):
    """Once: what each operating point says of it is not said again."""
    X, y = two_coils(1, n_sweeps=0)
    with pytest.warns(UserWarning, match="make another LPV model") as caught:
        coils_pipeline(coils(*names), memory).fit(X, y)
    assert len(caught) == 1


@pytest.mark.slow
def test_a_guess_tells_mirror_images_apart(memory):
    found = coils_pipeline(coils(), memory, init=[9.0, 6.0, 0.7, 0.5])
    spread = found.fit(*two_coils(1, n_sweeps=0)).parameters_.std()
    assert spread["l1"] > 10.0 * spread["l2"]


WRONG_IF_2_VARIES = [9.0, 6.0, 0.7, 0.5]  # a guess, which no frozen model refutes


@pytest.mark.slow
def test_a_refined_model_that_misses_its_own_record_is_told(memory):
    pipeline = coils_pipeline(coils(), memory, OutputErrorLPV(), init=WRONG_IF_2_VARIES)
    with pytest.warns(UserWarning, match="refined model misses .* in the experiments"):
        pipeline.fit(*two_coils(2, n_sweeps=1, fast=8))


@pytest.mark.slow
def test_a_refined_model_of_a_noisy_record_is_not_said_to_miss_it(memory):
    """A warning would be an error."""
    pipeline = coils_pipeline(coils(), memory, OutputErrorLPV(), init=WRONG_IF_2_VARIES)
    pipeline.fit(*two_coils(1, n_sweeps=1, noise=0.1))


@pytest.mark.slow
def test_parts_that_are_the_same_at_all_points_have_no_mirror_image(memory):
    """No state depends on their order then; gains may vary."""
    structure = GrayBoxStructure.from_template(
        A=[["-lag_1", 0], [1, "-lag_2"]], B=[["gain"], [0]], C=[[0, 1]]
    )
    rng, runs = np.random.default_rng(0), []
    for kappa in range(3):
        u = rng.choice([-1.0, 1.0], (200, 1)).repeat(3, axis=0)
        plant = structure.model({"lag_1": 0.4, "lag_2": 2.0, "gain": 1.0 + kappa})
        y = plant.simulate(u, sampling_time=STEP)
        runs.append((u, kappa, y + 1e-3 * y.std() * rng.standard_normal(y.shape)))
    coils_pipeline(structure, memory, init="similarity").fit(
        *from_trajectories(runs, sampling_time=STEP)
    )


@pytest.mark.slow
def test_a_lag_that_may_have_any_of_several_poles_is_told():
    """No permutation of the parameters: the rest of the model follows."""
    structure = GrayBoxStructure.from_template(
        A=[[0, 1, 0], ["-a0", "-a1", "b"], [0, 0, "-p"]],
        B=[[0], [0], ["p"]],
        C=[[1, 0, 0]],
    )
    kappa = np.linspace(0.0, 1.0, 4)[:, None]
    pole = 5.0 * (1.0 + kappa[:, 0])
    truth = np.column_stack(
        [2.0 * pole, 2.0 + pole, 0.0 * pole + 20.0, 0.0 * pole + 12]
    )
    models = [structure.model(theta) for theta in truth]
    problems = [problem_from_models(structure, [model], None) for model in models]
    slow = np.column_stack([12.0 * pole, 12.0 + pole, 0.0 * pole + 120, 0.0 * pole + 2])
    restructurer = GrayBoxRestructurer(structure, norm="h2")
    fitted = [
        clone(restructurer).set_params(init=theta).fit_model(model)
        for theta, model in zip(slow, models, strict=True)
    ]
    for one in fitted:  # as if nothing had been known
        one.init = "similarity"
    _, doubts = tied_branches(problems, fitted, [None] * 4, kappa)
    assert [doubt.point for doubt in doubts] == [0, 1, 2, 3]
    for doubt, model in zip(doubts, models, strict=True):
        other = structure.model(doubt.other)
        assert_allclose(other.dc_gain(), model.dc_gain(), rtol=1e-6)
        assert_allclose(np.sort(other.poles()), np.sort(model.poles()), rtol=1e-6)
