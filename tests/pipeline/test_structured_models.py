"""Step 4 at the operating points: covariances, what is kept, time that is bounded."""

import warnings
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
    from_trajectories,
    make_bft_scorer,
)
from lpvlearn.data.experiments import Experiment
from lpvlearn.pipeline.one_basis.foreseen_parameters import with_foreseen
from lpvlearn.pipeline.one_basis.structured_models import (
    StructuredModels,
    _tell_of_no_deviations,
    covariance_of_parameters,
    restructure_points,
)
from lpvlearn.pipeline.points.local_models import LocalModel, identify_point

from ..conftest import (
    KAPPA,
    spring_pipeline,
    spring_structure,
    spring_tables,
)

# -- standard deviations of gray-box parameters ---------------------------------------

LAG = GrayBoxStructure.from_template([["-a"]], [["b"]], [[1]])
STEP = 0.1


def lag_record(seed, n_samples=300, noise=0.05):
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (n_samples // 3, 1)).repeat(3, axis=0)
    y = LAG.model({"a": 0.8, "b": 1.5}).simulate(u, sampling_time=STEP)
    return u, y + noise * rng.standard_normal(y.shape)


def simulated(theta, u, x0):
    model = LAG.model(theta)
    return model.simulate(u, sampling_time=STEP, initial_state=[x0])[:, 0]


def test_covariance_is_that_of_nonlinear_least_squares_in_the_parameters():
    """Black box and gray box have as many parameters here: the formula is known."""
    u, y = lag_record(0)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(order=1, horizon=8, feedthrough=False, sampling_time=STEP),
        GrayBoxRestructurer(LAG),
    ).fit(u, y)
    theta = pipeline.parameters_.to_numpy()[0]
    h = 1e-6
    J = np.column_stack(
        [
            (simulated(theta + h * e, u, 0.0) - simulated(theta - h * e, u, 0.0))
            / (2 * h)
            for e in np.eye(2)
        ]
        + [simulated(theta, u, 1.0) - simulated(theta, u, 0.0)]
    )
    error = y[:, 0] - simulated(theta, u, 0.0)
    error = error - J[:, 2:] @ np.linalg.lstsq(J[:, 2:], error, rcond=None)[0]
    variance = error @ error / (len(y) - 3)
    expected = np.sqrt(variance * np.diag(np.linalg.inv(J.T @ J))[:2])
    # The noise may have been taken for a faintly coloured one.
    np.testing.assert_allclose(pipeline.parameters_std_.iloc[0], expected, rtol=0.15)


@pytest.fixture(scope="module")
def short_springs():
    """Noisy local experiments on the spring, and the deviations that they tell."""
    X, y = spring_tables(0.05, n_samples=300)
    return X, y, spring_pipeline().fit(X, y).parameters_std_


@pytest.mark.slow
def test_more_experiments_tell_more(short_springs):
    X, y = spring_tables(0.05, n_samples=300, n_repeats=4)
    ratio = short_springs[2] / spring_pipeline().fit(X, y).parameters_std_
    assert ratio.median().between(1.5, 2.7).all()  # the root of 4


@pytest.mark.slow
def test_deviations_are_the_spread_over_new_noise():
    found, told = [], []
    for seed in range(20):
        pipeline = LocalLPVPipeline(
            SubspaceLTI(order=1, horizon=8, feedthrough=False, sampling_time=STEP),
            GrayBoxRestructurer(LAG, n_starts=2),
        ).fit(*lag_record(seed))
        found.append(pipeline.parameters_.iloc[0])
        told.append(pipeline.parameters_std_.iloc[0])
    ratio = pd.DataFrame(told).mean() / pd.DataFrame(found).std()
    assert ratio.between(0.65, 1.5).all()


@pytest.mark.slow
def test_deviations_follow_the_units(short_springs):
    X, y, one = short_springs
    other = spring_pipeline().fit(X, 1000.0 * y).parameters_std_
    np.testing.assert_allclose(other["b"], 1000.0 * one["b"], rtol=1e-3)
    np.testing.assert_allclose(other["k"], one["k"], rtol=1e-3)


@pytest.mark.filterwarnings("ignore:The model explains next to nothing")
@pytest.mark.filterwarnings("ignore:The simulation error depends on past")
@pytest.mark.parametrize("options", [{"refine": False}, {"order": 0}])
def test_nothing_is_claimed_where_the_covariance_is_not_known(options):
    u, y = lag_record(2)
    point = identify_point(
        SubspaceLTI(**{"order": 1, "horizon": 8, **options}),
        [Experiment("a", np.arange(len(u)), u, y)],
        sampling_time=STEP,
        combine="pool",
        discretization="zoh",
    )
    assert point.deviated() == []


def test_a_frequency_weight_enters_the_covariance():
    u, y = lag_record(3)
    fitted = SubspaceLTI(1, horizon=8, feedthrough=False, sampling_time=STEP).fit(u, y)
    pairs = [
        (above.to_continuous(), below.to_continuous())
        for above, below in fitted.deviated_models()
    ]
    box = fitted.lti_.to_continuous()
    theta = GrayBoxRestructurer(LAG).fit_model(box).params_
    plain, weighted = (
        covariance_of_parameters(LAG, theta, weight, box, pairs)
        for weight in (None, (None, 2.0))
    )
    # A structure that meets the black box exactly leaves a weight nothing to choose.
    np.testing.assert_allclose(weighted, plain, rtol=0.05)


@pytest.mark.slow
def test_average_tells_its_own_spread_and_a_single_experiment_that_of_its_fit():
    X, y = spring_tables(0.05, n_samples=300, n_repeats=3)
    average = spring_pipeline(combine="average").fit(X, y)
    first = X["run"].str.endswith("r0")
    single = spring_pipeline(combine="average").fit(X[first], y[first])
    pooled = spring_pipeline(combine="pool").fit(X[first], y[first])
    assert average.restructurers_[0].params_covariance_.shape == (3, 3)
    pd.testing.assert_frame_equal(single.parameters_std_, pooled.parameters_std_)


def test_memory_tells_the_same_deviations(tmp_path):
    u, y = lag_record(4)
    X, Y = from_trajectories([(u, 0.3, y)], sampling_time=STEP)
    options = {"experiment": "experiment", "time": "time", "inputs": "u1"}
    fits = [
        LocalLPVPipeline(
            SubspaceLTI(1, horizon=8),
            GrayBoxRestructurer(LAG),
            memory=memory,
            **options,
        ).fit(X, Y)
        for memory in (None, tmp_path, tmp_path)
    ]
    for other in fits[1:]:
        pd.testing.assert_frame_equal(fits[0].parameters_std_, other.parameters_std_)


@pytest.fixture(scope="module")
def with_a_negative_pole():
    """Three points; at the middle one a pole of the sampled system is -0.3."""
    rng = np.random.default_rng(0)
    points = []
    for kappa, pole in zip((0.0, 1.0, 2.0), (0.3, -0.3, 0.3), strict=True):
        A, B, C = np.diag([0.8, pole]), np.ones((2, 1)), np.array([[1.0, 0.7]])
        u = rng.standard_normal((400, 1))
        y = StateSpace(A, B, C, sampling_time=STEP).simulate(u)
        points.append((u, kappa, y + 0.01 * rng.standard_normal(y.shape)))
    return from_trajectories(points, sampling_time=STEP)


TWO_LAGS = GrayBoxStructure.from_template(
    [["-a", 0], [0, "-b"]], [["g"], ["h"]], [[1, 1]]
)


@pytest.mark.broad
@pytest.mark.filterwarnings(
    "ignore:the (structure|search for|parameters|intervals|values of)"
)
@pytest.mark.parametrize(
    "restructurer",
    [None, GrayBoxRestructurer(), "passthrough", GrayBoxRestructurer(TWO_LAGS)],
)
def test_an_order_that_grows_in_continuous_time_is_that_of_the_others(
    with_a_negative_pole, restructurer
):
    pipeline = LocalLPVPipeline(
        SubspaceLTI(order=2, horizon=8),
        restructurer,
        scheduling="kappa",
        experiment="experiment",
        time="time",
    )
    with pytest.warns(UserWarning, match=r"1 pole\(s\) on the negative real.*-0\.3"):
        pipeline.fit(*with_a_negative_pole)
    assert [model.order for model in pipeline.local_models_] == [2, 3, 2]
    assert [model.order for model in pipeline.structured_models_] == [2, 2, 2]
    if isinstance(restructurer, GrayBoxRestructurer):
        assert pipeline.report_["structured_BFT"].min() > 60


def servo(kappa):
    """A position, and the current behind it."""
    A = [[0, 1, 0], [0, -2.0 - kappa, 4.0], [0, -0.5, -8.0]]
    return StateSpace(A, [[0], [0], [6.0]], [[1, 0, 0], [0, 0, 1]])


@pytest.mark.broad
@pytest.mark.parametrize(
    "restructurer", ["aligned", "passthrough", GrayBoxRestructurer()], ids=str
)
def test_integrators_need_no_structure(restructurer):
    rng, runs = np.random.default_rng(3), []
    for kappa in (0.0, 1.0, 2.0):
        u = rng.choice([-1.0, 1.0], (60, 1)).repeat(5, axis=0)
        y = servo(kappa).simulate(u, sampling_time=0.05)
        runs.append((u, kappa, y + [7.0, 0.0]))  # the position counts from anywhere
    X, y = from_trajectories(runs, sampling_time=0.05)
    local = SubspaceLTI(2, integrating=[0], offset=None)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    pipeline = LocalLPVPipeline(local, restructurer, **roles).fit(X, y)
    assert [model.order for model in pipeline.structured_models_] == [3] * 3
    omega = np.array([0.1, 1.0, 5.0])
    for kappa in (0.0, 1.0, 2.0):
        model, true = pipeline.lpv_.at(kappa), servo(kappa)
        assert np.abs(model.poles()).min() == 0.0
        G, G0 = model.frequency_response(omega), true.frequency_response(omega)
        assert_allclose(G, G0, rtol=1e-5)
    scorer = make_bft_scorer(initial_state="estimate")
    assert scorer(pipeline, X, y) > 99.99


@pytest.mark.slow
def test_one_order_with_integrators_is_that_of_all_points():
    """Two points need a state behind the integrator, the third needs two."""
    rng, runs = np.random.default_rng(4), []
    for kappa in (0.0, 1.0, 2.0):
        u = rng.choice([-1.0, 1.0], (80, 1)).repeat(5, axis=0)
        model = servo(kappa).A[1:, 1:] if kappa == 2.0 else np.array([[-2.0 - kappa]])
        n = len(model)
        A = np.block([[0.0, np.eye(1, n)], [np.zeros((n, 1)), model]])
        B, C = np.eye(n + 1)[:, -1:], np.eye(1, n + 1)
        y = StateSpace(A, B, C).simulate(u, sampling_time=0.05)
        runs.append((u, kappa, y + 1e-4 * y.std() * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=0.05)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of states too many at the first points
        pipeline = LocalLPVPipeline(SubspaceLTI(integrating=[0]), **roles).fit(X, y)
    assert [model.order for model in pipeline.structured_models_] == [3] * 3
    assert pipeline.report_["local_BFT"].min() > 99.0


@pytest.mark.slow
def test_the_rates_of_a_double_integrator_have_one_integrator():
    structure = GrayBoxStructure.from_template([[0, 1], [0, 0]], [[0], ["b"]], [[1, 0]])
    rng, runs = np.random.default_rng(0), []
    for kappa in (0.0, 1.0):
        u = np.repeat(rng.choice([-1.0, 1.0], 150), 6)
        y = structure.model({"b": 5.0 - 3.0 * kappa}).simulate(u, sampling_time=0.05)
        runs.append((u, kappa, y + 5e-3 * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=0.05)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    local = SubspaceLTI(integrating=True)
    pipeline = LocalLPVPipeline(local, GrayBoxRestructurer(structure), **roles)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the noise of rates
        pipeline.fit(X, y)
    assert_allclose(pipeline.parameters_["b"], [5.0, 2.0], rtol=1e-2)


def test_nothing_is_said_of_distances_between_integrators():
    rng, runs = np.random.default_rng(5), []
    structure = GrayBoxStructure.from_template(
        [[0, 1], [0, -2]], [[0], ["b"]], [[1, 0]]
    )
    for kappa in (1.0, 2.0):
        u = rng.choice([-1.0, 1.0], (60, 1)).repeat(5, axis=0)
        y = structure.model([kappa]).simulate(u, sampling_time=0.05)
        runs.append((u, kappa, y + 1e-3 * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=0.05)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    restructurer = GrayBoxRestructurer(structure)
    local = SubspaceLTI(integrating=[0])
    constant = LocalLPVPipeline(local, restructurer, PolynomialLPV(0), **roles)
    text = constant.fit(X, y).summary()
    assert "Interpolation: PolynomialLPV(degree=0)" in text
    assert "through the local models" not in text and "nan" not in text


def test_undamped_oscillators_are_weighed_by_their_uncertainty():
    """Identified pairs lie beside the axis; the residues tell what explains them."""
    structure = GrayBoxStructure.from_template(
        [[0, 1], [-25, 0]], [["f"], ["g"]], [[1, 0]]
    )
    rng, runs = np.random.default_rng(0), []
    truth = np.array([[1.0, 4.0], [0.7, 3.0]])
    for kappa, row in enumerate(truth):
        u = rng.standard_normal(500)
        y = structure.model(row).simulate(u, sampling_time=0.05)
        runs.append(
            (u, float(kappa), y + 0.03 * y.std() * rng.standard_normal(y.shape))
        )
    X, y = from_trajectories(runs, sampling_time=0.05)
    roles = {"scheduling": "kappa", "experiment": "experiment", "time": "time"}
    local = SubspaceLTI(stability="enforce")
    pipeline = LocalLPVPipeline(local, GrayBoxRestructurer(structure), **roles)
    pipeline.fit(X, y)
    for fitted, row in zip(pipeline.restructurers_, truth, strict=True):
        assert fitted.p_value_ > 1e-3
        std = np.sqrt(np.diag(fitted.params_covariance_))
        assert (np.abs(fitted.params_ - row) < 4.0 * std).all()
        assert (std < 0.05).all()
    assert pipeline.score(X, y) > 0.998


def test_one_canonical_form_needs_one_order():
    models = [
        LocalModel(StateSpace(-np.eye(n), np.ones((n, 1)), np.ones((1, n))), n, None)
        for n in (1, 2)
    ]
    with pytest.raises(ValueError, match=r"one order. Got orders \[1, 2\]"):
        restructure_points(GrayBoxRestructurer(), models, None, None, 1.0)


SENSORS = GrayBoxStructure.from_template(
    [[0, 1], ["-k", "-c"]], [[0], [1]], [[1, 0], [0, 1]]
)


def sensor_record(seed, n_samples=600, noise=(0.02, 1.0), method="zoh"):
    """Position and speed of a mass, the latter by a poor sensor."""
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (n_samples // 3, 1)).repeat(3, axis=0)
    y = SENSORS.model({"c": 0.6, "k": 5.0}).to_discrete(STEP, method).simulate(u)
    size = y.std(axis=0) * noise
    return u, y + size * rng.standard_normal(y.shape), size


def sensor_pipeline(**options):
    free = options.get("discretization", "zoh") != "zoh"
    local = SubspaceLTI(2, horizon=8, feedthrough=free, sampling_time=STEP)
    options.setdefault("restructurer", GrayBoxRestructurer(SENSORS))
    return LocalLPVPipeline(local, **options)


@pytest.mark.slow
@pytest.mark.parametrize("discretization", ["zoh", "foh", "tustin"])
def test_efficient_parameters_are_those_of_maximum_likelihood(discretization):
    u, y, size = sensor_record(0, method=discretization)

    def residuals(theta):
        model = SENSORS.model(theta).to_discrete(STEP, discretization)
        return ((y - model.simulate(u)) / size).ravel()

    best = least_squares(residuals, [0.6, 5.0], x_scale="jac")
    bound = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    pipeline = sensor_pipeline(discretization=discretization).fit(u, y)
    assert (np.abs(pipeline.parameters_.iloc[0] - best.x) < 0.5 * bound).all()
    np.testing.assert_allclose(pipeline.parameters_std_.iloc[0], bound, rtol=0.15)
    row = pipeline.report_.iloc[0]
    assert row["degrees_of_freedom"] == (4 if discretization == "zoh" else 6)
    assert row["p_value"] > 1e-3
    assert row["relative_hinf_error"] <= row["relative_error"]
    hinf = pipeline.hinf_parameters_.iloc[0]
    restructurer = pipeline.restructurers_[0]
    np.testing.assert_array_equal(restructurer.hinf_params_, hinf)
    np.testing.assert_array_equal(restructurer.params_, pipeline.parameters_.iloc[0])
    if discretization == "zoh":  # no feedthrough is left out of the comparison
        distance = (restructurer.lti_ - pipeline.local_models_[0]).hinf_norm()
        assert np.isclose(restructurer.error_, distance, rtol=1e-6)
    assert "chi-square per degree of freedom" in pipeline.summary()


@pytest.mark.parametrize(
    "options",
    [
        {"efficient": False},
        {"restructurer": GrayBoxRestructurer(SENSORS, norm="h2")},
        {"restructurer": GrayBoxRestructurer(SENSORS, frequency_weight=(None, 9.0))},
    ],
)
def test_what_another_norm_asks_for_stays(options):
    u, y, _ = sensor_record(1, noise=(0.1, 0.1))
    pipeline = sensor_pipeline(**options).fit(u, y)
    pd.testing.assert_frame_equal(pipeline.parameters_, pipeline.hinf_parameters_)
    assert "p_value" not in pipeline.report_
    assert pipeline.parameters_std_.notna().all(axis=None)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:All experiments are at one operating point")
def test_realizations_are_weighed_together():
    records = [sensor_record(seed)[:2] for seed in range(3)]
    X, Y = from_trajectories([(u, 0.0, y) for u, y in records], sampling_time=STEP)
    roles = {"experiment": "experiment", "time": "time", "scheduling": "kappa"}
    pooled, average = (
        sensor_pipeline(combine=combine, **roles).fit(X, Y)
        for combine in ("pool", "average")
    )
    assert average.report_["degrees_of_freedom"].iloc[0] == 3 * 6 - 2
    gap = (average.parameters_ - pooled.parameters_) / pooled.parameters_std_
    assert gap.abs().to_numpy().max() < 0.5
    ratio = average.parameters_std_ / pooled.parameters_std_
    assert ratio.stack().between(0.8, 1.25).all()


@pytest.mark.filterwarnings("ignore:the structure comes no nearer")
def test_a_structure_that_the_noise_does_not_explain_is_told():
    u, y, _ = sensor_record(2, noise=(0.01, 0.01))
    wrong = SENSORS.fix({"c": 0.7})
    with pytest.warns(UserWarning, match=r"times as far .* efficient=False"):
        pipeline = sensor_pipeline(restructurer=GrayBoxRestructurer(wrong)).fit(u, y)
    assert pipeline.report_["p_value"].iloc[0] < 1e-3


def test_without_a_covariance_the_hinf_optimum_is_kept():
    u, y, _ = sensor_record(3, noise=(0.01, 0.01))
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, horizon=8, refine=False, feedthrough=False, sampling_time=STEP),
        GrayBoxRestructurer(SENSORS, norm="covariance"),
    ).fit(u, y)
    pd.testing.assert_frame_equal(pipeline.parameters_, pipeline.hinf_parameters_)
    assert pipeline.parameters_std_.isna().all(axis=None)


# -- time and wrong options ------------------------------------------------------------


@pytest.mark.slow
def test_max_time_is_shared_by_the_points_and_told():
    X, y = spring_tables(noise=0.02, n_samples=300, kappas=KAPPA[::3])
    pipeline = spring_pipeline(
        max_time=1e-6, efficient=False, interpolator=PolynomialLPV(1)
    )
    with pytest.warns(ConvergenceWarning, match="max_time") as told:
        pipeline.fit(X, y)
    assert len(told) >= 2
    assert {fit.max_time for fit in pipeline.restructurers_} == {0.75e-6 / 2}
    assert not any("`max_time`=" in str(warning.message) for warning in told)
    own = GrayBoxRestructurer(spring_structure(), max_time=1e-9)
    with pytest.warns(ConvergenceWarning, match="max_time"):
        pipeline.set_params(restructurer=own).fit(X, y)
    assert {fit.max_time for fit in pipeline.restructurers_} == {1e-9}
    pipeline.set_params(max_time=1e3, restructurer=spring_pipeline().restructurer)
    assert pipeline.fit(X, y).warnings_ == []


@pytest.mark.parametrize("seconds", [0, -1.0, "long"])
def test_no_time_is_refused(spring, seconds):
    with pytest.raises(ValueError, match="`max_time` must be a positive number"):
        spring_pipeline(max_time=seconds).fit(*spring[:2])


def with_a_mode_that_vanishes(c2):
    """Two modes at seven points, the second one not seen where `c2` is zero."""
    structure = GrayBoxStructure.from_template(
        [[0, 1, 0, 0], ["-k1", "-d1", 0, 0], [0, 0, 0, 1], [0, 0, "-k2", "-d2"]],
        [[0], [1], [0], [1]],
        [["c1", 0, "c2", 0]],
    )
    kappa = np.linspace(-1.0, 1.0, len(c2))[:, None]
    values = {"k1": 4.0, "d1": 0.4, "k2": 100.0, "d2": 1.0, "c1": 1.0, "c2": c2}
    names = structure.parameter_names
    theta = np.column_stack([np.broadcast_to(values[n], len(c2)) for n in names])
    known = np.tile(np.diag((1e-3 * np.abs(theta).max(axis=0)) ** 2), (len(c2), 1, 1))
    models = [structure.model(row) for row in theta]
    points = SimpleNamespace(kappa=kappa)
    local = [SimpleNamespace(lti=model) for model in models]
    return StructuredModels(points, local, structure, theta, known, models, [])


@pytest.mark.slow
def test_parameters_that_a_record_does_not_tell_are_foreseen_by_the_others():
    true = with_a_mode_that_vanishes(np.linspace(-20.0, 20.0, 7))
    theta, covariance = true.theta.copy(), true.covariance.copy()
    k2, d2 = map(true.structure.parameter_names.index, ("k2", "d2"))
    theta[3, [k2, d2]] = 9.0, 0.02
    covariance[3, k2, k2], covariance[3, d2, d2] = 30.0**2, 4.0**2
    spoilt = true._replace(theta=theta, covariance=covariance)
    with pytest.warns(UserWarning, match="does not tell 'd2', 'k2' at op"):
        found = with_foreseen(spoilt)
    np.testing.assert_allclose(found.theta, true.theta, rtol=1e-6, atol=1e-6)
    deviation = np.sqrt(np.diagonal(found.covariance[3]))
    np.testing.assert_allclose(deviation[[k2, d2]], [0.1, 1e-3])
    # not where the record contradicts
    bent = true.theta.copy()
    bent[3, k2] = 60.0
    seen = with_a_mode_that_vanishes(np.full(7, 20.0))
    local = list(seen.local)
    bent[:, true.structure.parameter_names.index("c2")] = 20.0
    local[3] = SimpleNamespace(lti=true.structure.model(bent[3]))
    kept = with_foreseen(seen._replace(theta=bent, covariance=covariance, local=local))
    np.testing.assert_array_equal(kept.theta, bent)


@pytest.mark.slow
def test_a_mode_that_vanishes_is_foreseen_as_a_whole():
    """Its stiffness is sure only by what is wrong of its gain and damping."""
    true = with_a_mode_that_vanishes(np.linspace(-20.0, 20.0, 7))
    theta, covariance = true.theta.copy(), true.covariance.copy()
    k2, d2, c2 = map(true.structure.parameter_names.index, ("k2", "d2", "c2"))
    theta[3, [k2, d2, c2]] = 9.0, 3.0, 0.01
    covariance[3, d2, d2], covariance[3, c2, c2] = 4.0**2, 1.0
    noisy = theta[3].copy()
    noisy[true.structure.parameter_names.index("c1")] *= 1.03  # as its record has it
    local = list(true.local)
    local[3] = SimpleNamespace(lti=true.structure.model(noisy))
    spoilt = true._replace(theta=theta, covariance=covariance, local=local)
    with pytest.warns(UserWarning, match="does not tell 'c2', 'd2', 'k2' at op"):
        found = with_foreseen(spoilt)
    assert abs(found.theta[3, k2] - 100.0) < 1.0


def test_what_all_records_tell_is_left_alone():
    true = with_a_mode_that_vanishes(np.linspace(10.0, 20.0, 7))
    assert with_foreseen(true) is true
    short = true.covariance.copy()
    short[3] *= 400.0  # a short record: its covariance weighs it
    known = true._replace(covariance=short)
    assert with_foreseen(known) is known
    unknown = true._replace(covariance=np.full_like(true.covariance, np.nan))
    assert with_foreseen(unknown) is unknown


def test_points_without_deviations_are_told_beside_others():
    kappa, known = np.arange(3.0)[:, None], np.eye(2)
    with pytest.warns(UserWarning, match="not known at operating point 1 .scheduling"):
        _tell_of_no_deviations([known, None, known], kappa)
    for same in ([None, None, None], [known, known, known]):  # a warning is an error
        _tell_of_no_deviations(same, kappa)
