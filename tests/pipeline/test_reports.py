"""Reports of a pipeline: what was fitted at every point, how well, and in words."""

import numpy as np
import pytest
from sklearn.base import clone

from lpvlearn import (
    AutoLPV,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    PolynomialLPV,
    SubspaceLTI,
    bft_score,
    from_trajectories,
    parameter_fit,
)

from ..conftest import ROLES, spring_pipeline, spring_structure, spring_tables


@pytest.fixture(scope="module")
def fitted():
    X, y = spring_tables(noise=0.05, n_samples=400, n_repeats=2)
    return spring_pipeline().fit(X, y)


@pytest.fixture(scope="module")
def balanced(spring, memory):
    return spring_pipeline(restructurer="passthrough", memory=memory).fit(*spring[:2])


@pytest.fixture
def uncertain(fitted, monkeypatch):
    """A pipeline whose restructurers tell a covariance."""
    from lpvlearn import GrayBoxRestructurer

    def fit_model(self, *args, original=GrayBoxRestructurer.fit_model, **options):
        original(self, *args, **options)
        self.params_covariance_ = np.diag([1.0, 4.0, 9.0])
        return self

    monkeypatch.setattr(GrayBoxRestructurer, "fit_model", fit_model)
    return spring_pipeline().fit(*spring_tables(n_samples=200))


def test_the_report_of_a_pipeline_covers_all_three_steps(fitted):
    report = fitted.report_
    assert report.index.name == "operating_point"
    assert (report["n_experiments"] == 2).all() and (report["n_samples"] == 800).all()
    assert report["local_BFT"].between(94, 96).all()  # 5 % noise
    assert report["structured_BFT"].between(94, 96).all()
    for k, restructurer in enumerate(fitted.restructurers_):
        row = report.iloc[k]
        assert row["relative_error"] == restructurer.relative_error_
        assert row["active_frequency"] == restructurer.active_frequencies_.max()
        norm = fitted.local_models_[k].hinf_norm()
        floor = restructurer.structural_floor_
        assert row["relative_floor"] == pytest.approx(floor / norm, rel=1e-2, abs=1e-9)
        assert row["remaining_error"] == pytest.approx(
            restructurer.remaining_error_ / norm, rel=1e-2
        )


def test_the_report_holds_the_parameters_and_their_interpolation(fitted):
    report, names = fitted.report_, list(fitted.parameters_.columns)
    np.testing.assert_array_equal(
        report[[f"param_{n}" for n in names]], fitted.parameters_
    )
    met = fitted.interpolator_.predict(fitted.operating_points_)
    size = np.sqrt((fitted.parameters_**2).mean()).to_numpy()
    expected = [
        parameter_fit(own / size, other / size)
        for own, other in zip(fitted.parameters_.to_numpy(), met, strict=True)
    ]
    np.testing.assert_allclose(report["interpolation_FIT"], expected)
    k = 1
    distance = fitted.structured_models_[k] - fitted.lpv_.at(
        fitted.operating_points_[k]
    )
    relative = distance.hinf_norm() / fitted.structured_models_[k].hinf_norm()
    assert report["interpolation_error"].iloc[k] == pytest.approx(relative)


@pytest.mark.slow
def test_the_fit_of_parameters_does_not_depend_on_units():
    """Of time, say: the largest number would decide."""
    X, y = spring_tables(noise=0.01, n_samples=300)
    restructurer = GrayBoxRestructurer(spring_structure())
    pipeline = LocalLPVPipeline(None, restructurer, PolynomialLPV(1), **ROLES)
    own, other = (
        clone(pipeline).fit(X.assign(time=unit * X["time"]), y) for unit in (1.0, 1e3)
    )
    fits = [model.report_["interpolation_FIT"] for model in (own, other)]
    np.testing.assert_allclose(*fits, rtol=1e-6)
    line = [model.summary().split("parameter fit")[1][:14] for model in (own, other)]
    assert line[0] == line[1]


def test_parameters_are_reported_one_by_one(fitted):
    report = fitted.parameter_report_
    theta, met = fitted.parameters_, fitted.lpv_.parameters(fitted.operating_points_)
    assert list(report.index) == ["b", "c", "k"]
    np.testing.assert_array_equal(report["highest"], theta.max())
    rmse = np.sqrt(((theta - met) ** 2).mean())
    np.testing.assert_allclose(report["interpolation_RMSE"], rmse)
    assert report.loc["k", "interpolation_FIT"] > 99
    np.testing.assert_array_equal(report["std"], fitted.parameters_std_.median())


@pytest.mark.slow
def test_what_an_interpolation_loses_at_the_points_is_reported(fitted):
    report = fitted.report_
    np.testing.assert_allclose(report["lpv_BFT"], report["structured_BFT"], atol=0.5)
    X, y = spring_tables(n_samples=200)
    constant = spring_pipeline(interpolator=PolynomialLPV(0)).fit(X, y)
    report = constant.report_
    assert (report["lpv_BFT"] < 90.0).all() and (report["structured_BFT"] > 90.0).all()
    run = X["kappa"] == 0.0
    found = constant.predict_with_initial_state(X[run], y[run])
    assert bft_score(y[run], found) == pytest.approx(report["lpv_BFT"][0.0], abs=1e-6)
    spans = f"{report['lpv_BFT'].min():.4g} to {report['lpv_BFT'].max():.4g}"
    assert f"simulation fit (BFT) {spans} %" in constant.summary()


def test_standard_deviations_are_reported_where_they_are_known(uncertain):
    np.testing.assert_array_equal(uncertain.parameters_std_, [[1, 2, 3]] * 4)
    assert uncertain.report_["std_k"].tolist() == [3.0] * 4
    assert uncertain.parameter_report_["std"].tolist() == [1.0, 2.0, 3.0]
    assert " std" in uncertain.summary()


@pytest.mark.slow
def test_deviations_are_missing_where_they_are_not_known():
    rough = SubspaceLTI(order=2, horizon=10, refine=False)
    pipeline = spring_pipeline(local=rough).fit(*spring_tables(0.05, n_samples=200))
    assert pipeline.parameters_std_.isna().all(axis=None)
    assert not [name for name in pipeline.report_ if name.startswith("std_")]
    assert "standard deviations of the parameters are not known at 4" in (
        pipeline.summary()
    )


def test_the_summary_does_not_lay_the_floor_to_a_frequency_of_the_rest():
    """The structure fixes the gain at standstill, from which the data are 2 % off."""
    unit = GrayBoxStructure.from_template(
        [[0, 1], ["-k", "-c"]], [[0], ["k"]], [[1, 0]]
    )
    rng = np.random.default_rng(0)
    runs = []
    for kappa in (0.0, 1.0, 2.0):
        u = rng.choice([-1.0, 1.0], 80).repeat(5)
        y = unit.model({"c": 12.0, "k": 40 + 10 * kappa}).simulate(
            u, sampling_time=0.02
        )
        runs.append((u, kappa, 1.02 * y + 0.01 * rng.standard_normal(y.shape)))
    X, y = from_trajectories(runs, sampling_time=0.02)
    pipeline = LocalLPVPipeline(
        SubspaceLTI(2, horizon=10, feedthrough=False),
        GrayBoxRestructurer(unit),
        scheduling="kappa",
        experiment="experiment",
        time="time",
        efficient=False,  # the structure is wrong, as the noise would tell
    ).fit(X, y)
    report, text = pipeline.report_, pipeline.summary()
    assert (report["relative_floor"] > 1e-3).all()
    assert (report["remaining_error"] < report["relative_floor"]).all()
    error, floor, rest = text[text.index("    H-infinity error") :].splitlines()[:3]
    assert "rad/s" not in error
    assert "no parameter can change" in floor and "rad/s" not in floor
    worst = report["active_frequency"].iloc[report["remaining_error"].argmax()]
    assert f"near {worst:.4g} rad/s" in rest


def test_the_summary_tells_what_was_found(fitted, balanced):
    text = fitted.summary()
    for words in (
        "LPV model of order 2: 1 input(s), 1 output(s), 3 parameters",
        "8 experiment(s), 3200 samples at 0.02 s, 4 operating point(s), "
        "kappa from 0 to 1.5",
        "Local models: SubspaceLTI",
        "Restructuring: GrayBoxRestructurer",
        "rad/s",
        "Interpolation: AutoLPV() (polynomial 2)",
        "gray-box BFT",
        "parameter",
    ):
        assert words in text
    assert max(map(len, text.splitlines())) <= 120
    assert "no common state basis" in balanced.summary()


@pytest.mark.slow
def test_stamps_that_are_off_are_told():
    X, y = spring_tables(n_samples=100)
    assert "Time stamps" not in spring_pipeline().fit(X, y).summary()
    step = X["time"].iloc[1] - X["time"].iloc[0]
    off = np.random.default_rng(0).uniform(-0.004, 0.004, len(X)) * step
    model = spring_pipeline().fit(X.assign(time=X["time"] + off), y)
    line = f"Time stamps off by up to {100.0 * model.time_jitter_:.2g} % of a step"
    assert line in model.summary()


class Careless(AutoLPV):
    """Chooses a constant, whatever the points say."""

    def _fit(self, kappa, points):
        super()._fit(kappa, points)
        self.best_estimator_ = PolynomialLPV(0).fit(
            kappa, points.theta, covariance=points.covariance
        )


@pytest.mark.slow
def test_points_that_a_form_of_nobodys_choice_misses_are_told():
    X, y = spring_tables(n_samples=200, noise=0.01)
    with pytest.warns(UserWarning, match=r"point\(s\) 3 \(scheduling 1.5: .* 1 more"):
        spring_pipeline(interpolator=Careless()).fit(X, y)
