"""Reports: rows and columns, comparisons, tables for people."""

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.metrics import mean_squared_error, r2_score

from lpvlearn import (
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
    bft_score,
    compare_models,
    fit_report,
    readable_report,
    vaf_score,
)
from lpvlearn.metrics.table_simulation import TableSimulator

from ..conftest import (
    KAPPA,
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_structure,
    spring_tables,
    spring_truth,
)
from .conftest import IN_MOTION, RNG, GainFromRest


@pytest.fixture(scope="module")
def fitted():
    X, y = spring_tables(noise=0.05, n_samples=400, n_repeats=2)
    return spring_pipeline().fit(X, y)


@pytest.fixture(scope="module")
def balanced(spring):
    return spring_pipeline(restructurer="passthrough").fit(*spring[:2])


# -- one model -------------------------------------------------------------------------


@IN_MOTION
def test_the_report_has_a_row_for_each_experiment_and_output(data):
    model, X, y = data
    report = fit_report(model, X, y)
    assert list(report) == [
        "experiment", "operating_point", "output", "BFT", "VAF", "RMSE", "R2",
        "n_missing",
    ]  # fmt: skip
    assert report["experiment"].tolist() == ["a", "a", "b", "b", "c", "c"]
    assert report["output"].tolist() == 3 * ["vx", "vy"]
    assert report["operating_point"].tolist() == [0.25, 0.25, 0.5, 0.5, 0.75, 0.75]
    prediction = model.predict(X)
    for _, row in report.iterrows():
        rows = (X["run"] == row["experiment"]).to_numpy()
        true = y.loc[rows, row["output"]]
        pred = prediction[rows, y.columns.get_loc(row["output"])]
        assert row["BFT"] == pytest.approx(bft_score(true, pred))
        assert row["VAF"] == pytest.approx(vaf_score(true, pred))
        assert row["RMSE"] == pytest.approx(np.sqrt(mean_squared_error(true, pred)))
        assert row["R2"] == pytest.approx(r2_score(true, pred))


def test_experiments_at_one_value_are_at_one_operating_point():
    rng = np.random.default_rng(0)
    for n_samples in (300, 400):
        values = np.repeat([0.1, 0.4, 0.7], n_samples)
        X = pd.DataFrame({"force": rng.normal(size=len(values)), "kappa": values})
        X["run"], X["time"] = values, np.tile(0.1 * np.arange(n_samples), 3)
        model = TableSimulator(spring_lpv(), **ROLES)
        report = fit_report(model, X, rng.normal(size=len(X)))
        assert report["operating_point"].tolist() == [0.1, 0.4, 0.7]


@IN_MOTION
def test_the_report_takes_the_scorers_options(data):
    model, X, y = data
    assert (fit_report(model, X, y, initial_state="estimate")["BFT"] == 100).all()
    full, cut = fit_report(model, X, y), fit_report(model, X, y, burn_in=30)
    assert (cut["RMSE"] < full["RMSE"]).all()


def test_the_report_of_any_regressor_is_one_experiment():
    X, y = RNG.normal(size=(30, 2)), RNG.normal(size=30)
    report = fit_report(LinearRegression().fit(X, y), X, y)
    assert report[["experiment", "output"]].to_numpy().tolist() == [[0, "y1"]]


# -- several side by side --------------------------------------------------------------


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


@IN_MOTION
def test_the_start_of_a_record_in_the_middle_is_estimated(spring):
    X, y = (table.iloc[400:900] for table in spring[2:])
    models = {"lpv": spring_lpv(), "lti": spring_lpv().at(0.75)}
    rest = compare_models(models, X, y, **ROLES)["BFT"]
    estimated = compare_models(models, X, y, initial_state="estimate", **ROLES)["BFT"]
    assert rest[0] < 95 and estimated[0] > 100 - 1e-6
    assert estimated[1] >= rest[1]


def test_a_discrete_model_keeps_its_own_step():
    model = StateSpace(0.9, 0.1, 1.0, sampling_time=1.0)
    u = np.sign(np.sin(np.arange(100.0)))
    y = model.simulate(u)
    X = pd.DataFrame({"u": u, "t": np.arange(100) * 0.01})
    with pytest.raises(ValueError, match="the time step of the model. Got 1 s, and 0"):
        compare_models({"m": model}, X, y, time="t")
    with pytest.raises(ValueError, match="must be 1.0 s, the model's own. Got 0.01"):
        compare_models({"m": model}, X[["u"]], y, sampling_time=0.01)
    right = compare_models({"m": model}, X.assign(t=np.arange(100.0)), y, time="t")
    assert right["BFT"].iloc[0] == pytest.approx(100.0)


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
            {"inputs": "force", "sampling_time": 0.02},
            "model 'a': .*2",
        ),
        (
            {"a": StateSpace(-np.eye(1), np.eye(1), np.eye(1))},
            {"inputs": "force"},
            "model 'a': `time` or `sampling_time` must tell the seconds",
        ),
        (
            {"a": spring_lpv()},
            {"inputs": "force", "scheduling": "kappa"},
            "model 'a': `time` or `sampling_time` must tell the seconds",
        ),
    ],
)
def test_bad_comparisons_name_the_cause(models, roles, words, spring):
    with pytest.raises(ValueError, match=words):
        compare_models(models, *spring[2:], **roles)


# -- for people ------------------------------------------------------------------------


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


# -- missing samples -------------------------------------------------------------------


@IN_MOTION
def test_missing_samples_are_counted_and_left_out(data):
    model, X, y = data
    y = y.copy()
    y.loc[X["run"] == "b", "vy"] = np.nan
    y.loc[5:11, "vx"] = np.nan
    report = fit_report(model, X, y)
    assert report["n_missing"].tolist() == [7, 0, 0, 40, 0, 0]
    measures = ["BFT", "VAF", "RMSE", "R2"]
    assert report.loc[3, measures].isna().all()  # that output was never measured there
    whole = fit_report(model, X, data[2])
    same = report["n_missing"] == 0
    pd.testing.assert_frame_equal(report[same], whole[same])
    assert readable_report(report)["missing"].tolist() == list("700") + ["40", "0", "0"]
    known = y["vx"].notna().to_numpy() & (X["run"] == "a").to_numpy()
    expected = bft_score(y["vx"][known], model.predict(X)[known, 0])
    assert report["BFT"][0] == pytest.approx(expected)


def test_a_simulation_that_is_not_finite_is_no_missing_sample(data):
    model, X, y = data
    broken = GainFromRest(np.nan, experiment="run", scheduling="kappa").fit(
        X, X["u"].rename("y")
    )
    with pytest.raises(ValueError, match="`y_pred` must be finite. Got nan at row 0"):
        fit_report(broken, X, y)


@pytest.mark.parametrize("labels", [[101310.0, 101320.0], [20240101.0, 20240102.0]])
def test_labels_of_many_digits_are_told_apart(labels):
    report = pd.DataFrame({"BFT": [98.0, 97.0]}, index=labels)
    assert readable_report(report).index.tolist() == [f"{v:.0f}" for v in labels]
    column = readable_report(report.rename_axis("experiment").reset_index())
    assert column["experiment"].tolist() == readable_report(report).index.tolist()
