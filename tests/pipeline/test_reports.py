"""Reports: tables that say what was fitted, and how well."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
    bft_score,
    compare_models,
    fit_report,
    from_trajectories,
    parameter_fit,
    readable_report,
)

from ..conftest import (
    KAPPA,
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_structure,
    spring_tables,
    spring_truth,
)


@pytest.fixture(scope="module")
def fitted():
    X, y = spring_tables(noise=0.05, n_samples=400, n_repeats=2)
    return spring_pipeline().fit(X, y)


@pytest.fixture(scope="module")
def balanced(spring):
    return spring_pipeline(restructurer="passthrough").fit(*spring[:2])


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


# ------------------------------------------------------------------------- the pipeline


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
    expected = [
        parameter_fit(own, other)
        for own, other in zip(fitted.parameters_.to_numpy(), met, strict=True)
    ]
    np.testing.assert_allclose(report["interpolation_FIT"], expected)
    k = 1
    distance = fitted.structured_models_[k] - fitted.lpv_.at(
        fitted.operating_points_[k]
    )
    relative = distance.hinf_norm() / fitted.structured_models_[k].hinf_norm()
    assert report["interpolation_error"].iloc[k] == pytest.approx(relative)


def test_parameters_are_reported_one_by_one(fitted):
    report = fitted.parameter_report_
    theta, met = fitted.parameters_, fitted.lpv_.parameters(fitted.operating_points_)
    assert list(report.index) == ["b", "c", "k"]
    np.testing.assert_array_equal(report["highest"], theta.max())
    rmse = np.sqrt(((theta - met) ** 2).mean())
    np.testing.assert_allclose(report["interpolation_RMSE"], rmse)
    assert report.loc["k", "interpolation_FIT"] > 99
    np.testing.assert_array_equal(report["std"], fitted.parameters_std_.median())


def test_standard_deviations_are_reported_where_they_are_known(uncertain):
    np.testing.assert_array_equal(uncertain.parameters_std_, [[1, 2, 3]] * 4)
    assert uncertain.report_["std_k"].tolist() == [3.0] * 4
    assert uncertain.parameter_report_["std"].tolist() == [1.0, 2.0, 3.0]
    assert " std" in uncertain.summary()


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
        "Interpolation: PolynomialLPV",
        "gray-box BFT",
        "parameter",
    ):
        assert words in text
    assert max(map(len, text.splitlines())) <= 120
    assert "no common state basis" in balanced.summary()


# --------------------------------------------------------------------------- comparison


@pytest.fixture(scope="module")
def comparison(fitted, balanced, spring):
    X, y = spring[2:]
    models = {
        "restructured": fitted,
        "balanced": balanced,
        "analytic": spring_lpv(),
        "frozen": spring_lpv().at(0.75),
    }
    return models, compare_models(models, X, y)


def test_estimators_and_models_are_compared_on_one_table(comparison, spring):
    X, y = spring[2:]
    models, report = comparison
    assert list(report["model"]) == list(models)
    assert list(report.columns[1:]) == list(fit_report(models["balanced"], X, y))
    bft = report.set_index("model")["BFT"]
    assert bft["analytic"] > 100 - 1e-6
    assert bft["restructured"] > bft["balanced"] > bft["frozen"]
    expected = bft_score(y, models["restructured"].predict(X))
    assert bft["restructured"] == pytest.approx(expected)
    frozen = models["frozen"].simulate(X[["force"]], sampling_time=0.02)
    assert bft["frozen"] == pytest.approx(bft_score(y, frozen))


def test_models_without_an_estimator_take_roles(spring):
    X, y = spring[2:]
    report = compare_models({"analytic": spring_lpv()}, X, y, **ROLES)
    assert report["BFT"].item() > 100 - 1e-6
    assert report[["experiment", "output"]].to_numpy().tolist() == [
        ["sweep", "position"]
    ]
    bare = compare_models(
        {"analytic": spring_lpv()},
        X.drop(columns="time"),
        y,
        scheduling="kappa",
        experiment="run",
        sampling_time=0.02,
    )
    assert bare["BFT"].item() > 100 - 1e-6


def test_the_start_of_a_record_in_the_middle_is_estimated(spring):
    X, y = (table.iloc[400:900] for table in spring[2:])
    models = {"lpv": spring_lpv(), "lti": spring_lpv().at(0.75)}
    rest = compare_models(models, X, y, **ROLES)["BFT"]
    estimated = compare_models(models, X, y, initial_state="estimate", **ROLES)["BFT"]
    assert rest[0] < 95 and estimated[0] > 100 - 1e-6
    assert estimated[1] >= rest[1]


def test_a_discrete_model_is_compared_as_it_is(spring):
    X, y = spring[:2]
    first = (X["run"] == "p0r0").to_numpy()
    sampled = spring_lpv().at(0.0).to_discrete(0.02)
    report = compare_models({"sampled": sampled}, X[first], y[first], **ROLES)
    assert report["BFT"].item() > 100 - 1e-6


@pytest.mark.parametrize(
    ("models", "roles", "words"),
    [
        ({}, {}, "`models` must be a dict"),
        ([StateSpace([[-1.0]], [[1.0]], [[1.0]])], {}, "`models` must be a dict"),
        ({"a": 3}, {}, r"`models\['a'\]` must be a fitted estimator"),
        ({"a": spring_lpv()}, {"run": "run"}, "`roles` must be 'inputs', .* Got 'run'"),
        (
            {"a": spring_lpv()},
            {"inputs": "force"},
            "model 'a': `scheduling` must name the 1 column",
        ),
        (
            {"a": StateSpace(-np.eye(2), np.eye(2), np.eye(2))},
            {"inputs": "force"},
            "model 'a': .*2",
        ),
    ],
)
def test_bad_comparisons_name_the_cause(models, roles, words, spring):
    with pytest.raises(ValueError, match=words):
        compare_models(models, *spring[2:], **roles)


# --------------------------------------------------------------------------- for people


def test_readable_reports_keep_every_row_and_column(fitted, comparison):
    for report in (fitted.report_, fitted.parameter_report_, comparison[1]):
        text = readable_report(report)
        assert text.shape == report.shape
        assert all(isinstance(cell, str) for cell in text.to_numpy().ravel())
        assert not any("_" in heading for heading in text.columns)
    assert readable_report(fitted.report_).index.tolist() == ["0", "0.5", "1", "1.5"]
    assert readable_report(pd.DataFrame({"BFT": [99.999, np.nan]}))["BFT"].tolist() == [
        "100.00",
        "",
    ]


def test_reports_over_several_scheduling_variables_are_readable():
    report = pd.DataFrame(
        {"local_BFT": [99.0]},
        index=pd.Index([(0.5, 1.25)], name="operating_point", tupleize_cols=False),
    )
    assert readable_report(report).index.tolist() == ["0.5, 1.25"]


def test_reports_are_written_to_latex(fitted):
    pytest.importorskip("jinja2")
    latex = readable_report(fitted.report_).to_latex()
    assert "local BFT" in latex and "95." in latex
    assert "active at rad/s" in latex
    assert fitted.report_.style.format(precision=2).to_html()
    labelled = readable_report(pd.DataFrame({"experiment": ["run_1"], "BFT": [98.0]}))
    assert r"run\_1 & 98.00" in labelled.to_latex(escape=True)


def test_reports_are_written_to_markdown(fitted):
    pytest.importorskip("tabulate")
    lines = readable_report(fitted.report_).to_markdown().splitlines()
    assert len(lines) == 2 + len(KAPPA)
    text = readable_report(pd.DataFrame({"BFT": [98.0]}))
    assert "98.00" in text.to_markdown(disable_numparse=True)


def test_the_analytic_model_may_be_any_lpv_model(spring):
    """Built from parameters at points, as a user does who knows the physics."""
    kappa = np.array(KAPPA)[:, None]
    lpv = LPVStateSpace(
        spring_structure(),
        PolynomialLPV(2).fit(kappa, spring_truth(KAPPA)),
        [[0.0], [1.5]],
    )
    assert compare_models({"lpv": lpv}, *spring[2:], **ROLES)["BFT"].item() > 99.999
