"""The doors of the estimators: one table in many dresses is one table."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import (
    GrayBoxRestructurer,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    bft_score,
    bft_scorer,
    compare_models,
    fit_report,
    make_bft_scorer,
)
from lpvlearn.inspection import ResidualDisplay, SimulationDisplay

from .conftest import ROLES, spring_pipeline, spring_structure, spring_tables

# One time-invariant model of several operating points is meant here.
pytestmark = pytest.mark.filterwarnings("ignore:The experiments contradict one another")

X, Y = spring_tables(noise=0.02, n_samples=150, kappas=(0.0, 0.5, 1.0))
# Three experiments at one point, which a time-invariant model explains.
ALIKE = spring_tables(noise=0.02, n_samples=150, kappas=(0.0,), n_repeats=3)
TABLES = {"local": ALIKE, "pipeline": (X, Y)}
NOON = pd.Timestamp("2024-03-31 00:59:58")  # two seconds before an hour is left out
MODELS = ("local", "pipeline")


# What is looked for in the tables is soon found: they are the subject, not the models.
QUICK = {"method": "po-moesp", "refine": "simulation", "offset": None}


def make(kind, **options):
    local = {"order": 2, "horizon": 8, "feedthrough": False, **QUICK}
    if kind == "local":
        return SubspaceLTI(**local, inputs="force", **ROLES, **options)
    return spring_pipeline(
        local=SubspaceLTI(**local, missing=options.pop("missing", "raise")),
        restructurer=GrayBoxRestructurer(spring_structure(), norm="similarity"),
        inputs="force",
        **options,
    )


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def fitted():
    return {kind: make(kind).fit(X, Y) for kind in MODELS}


@pytest.fixture(scope="module")
def at_home():
    """Models of the tables that they explain."""
    return {kind: make(kind).fit(*TABLES[kind]) for kind in MODELS}


def model_of(estimator):
    if isinstance(estimator, SubspaceLTI):
        return estimator.lti_.frequency_response([0.5, 5.0])
    return estimator.parameters_.to_numpy()


def dated(unit, tz=None):
    stamps = NOON + pd.to_timedelta(X["time"], unit="s")
    stamps = stamps.dt.tz_localize(tz) if tz else stamps
    return X.assign(time=stamps.dt.as_unit(unit))


def arrow():
    pytest.importorskip("pyarrow")
    return X.convert_dtypes(dtype_backend="pyarrow")


INTERLEAVED = np.arange(len(X)).reshape(3, -1).T.ravel()

DRESSES = {
    "float32": lambda: X.astype({"force": "float32", "time": "float32"}),
    "nullable integers": lambda: X.astype({"force": "Int64"}),
    "nullable floats": lambda: X.astype({"force": "Float64", "time": "Float64"}),
    "small integers": lambda: X.astype({"force": "int8"}),
    "arrow": arrow,
    "objects": lambda: X.astype(object),
    "text of numbers": lambda: X.assign(force=X["force"].map(str)),
    "categories": lambda: X.astype({"run": "category", "kappa": "category"}),
    "extra levels of a category": lambda: X.assign(
        run=pd.Categorical(X["run"], categories=["none", *sorted(set(X["run"]))])
    ),
    "sparse": lambda: X.astype({"kappa": pd.SparseDtype(float)}),
    "dates, milliseconds": lambda: dated("ms"),
    "dates, microseconds": lambda: dated("us"),
    "dates, nanoseconds": lambda: dated("ns"),
    "dates, UTC": lambda: dated("us", "UTC"),
    "time differences": lambda: X.assign(time=pd.to_timedelta(X["time"], unit="s")),
    "objects of dates": lambda: X.assign(
        time=(NOON + pd.to_timedelta(X["time"], unit="s")).astype(object)
    ),
    "milliseconds in time stamps": lambda: X.assign(time=X["time"] + 1.7e9),
    "a duplicated index": lambda: X.set_axis(np.arange(len(X)) % 7),
    "an index of text": lambda: X.set_axis([f"row {k}" for k in range(len(X))]),
    "levels with roles": lambda: X.set_index(["run", "time"]),
    "other columns": lambda: X.assign(note="text", when=NOON)[["note", *X, "when"]],
    "columns in another order": lambda: X[["time", "run", "kappa", "force"]],
    "interleaved rows": lambda: X.iloc[INTERLEAVED],
    "read-only": lambda: X.copy(deep=False),
}


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("dress", DRESSES)
def test_a_table_in_any_dress_is_the_same_table(dress, kind, fitted):
    table = DRESSES[dress]()
    rows = INTERLEAVED if dress == "interleaved rows" else slice(None)
    y = Y.iloc[rows].set_axis(table.index)
    other = make(kind).fit(table, y)
    assert_allclose(model_of(other), model_of(fitted[kind]), rtol=1e-5)
    expected = fitted[kind].predict(X)[rows]
    # Either model on either table.
    assert_allclose(other.predict(table), expected, atol=1e-5)
    assert_allclose(other.predict(X)[rows], expected, atol=1e-5)
    if dress not in ("levels with roles",):
        assert_allclose(fitted[kind].predict(table), expected, atol=1e-5)
    assert_allclose(other.score(table, y), fitted[kind].score(X, Y), rtol=1e-5)


@pytest.mark.parametrize("kind", MODELS)
def test_shuffled_rows_are_refused_and_shuffled_labels_put_right(kind, fitted):
    order = np.random.default_rng(0).permutation(len(X))
    with pytest.raises(ValueError, match="Do not shuffle"):
        make(kind).fit(X.iloc[order], Y.iloc[order])
    with pytest.warns(UserWarning, match="another order"):
        other = make(kind).fit(X, Y.iloc[order])
    assert_array_equal(model_of(other), model_of(fitted[kind]))
    for use in (other.score, lambda *t: bft_scorer(other, *t)):
        with pytest.warns(UserWarning, match="another order"):
            assert use(X, Y.iloc[order]) == use(X, Y)
    with pytest.warns(UserWarning, match="another order"):
        report = fit_report(other, X, Y.iloc[order])
    pd.testing.assert_frame_equal(report, fit_report(other, X, Y))


@pytest.mark.parametrize("kind", MODELS)
def test_labels_of_operating_points_may_be_categories(kind, fitted):
    point = pd.Categorical(X["kappa"].map("point {}".format))
    model = make(kind, operating_point="point").fit(X.assign(point=point), Y)
    assert_allclose(model_of(model), model_of(fitted[kind]), rtol=1e-9)
    assert_allclose(model.predict(X), fitted[kind].predict(X), atol=1e-9)


# ------------------------------------------------------------------ after the fit


def uses(model, table, y):
    """Everything that reads a table after the fit."""
    estimate = {"initial_state": "estimate"}
    yield model.predict(table)
    yield model.predict_with_initial_state(table, y)
    yield np.concatenate(model.split_experiments(table))
    yield model.score(table, y)
    yield bft_scorer(model, table, y)
    yield make_bft_scorer(average="experiment", **estimate)(model, table, y)
    yield fit_report(model, table, y, **estimate)[["BFT", "R2", "n_missing"]]
    frozen = {"model": model, "lpv": getattr(model, "lpv_", None) or model.lti_}
    yield compare_models(frozen, table, y)["BFT"]
    yield SimulationDisplay.from_estimator(model, table, y).bft_["simulated"]
    yield ResidualDisplay.from_estimator(model, table, y).tests["p_value"]


@pytest.mark.slow
def test_outputs_are_found_by_their_names():
    rng = np.random.default_rng(0)
    plant = StateSpace(0.9, 1, [[1], [3]], [[0], [1]], sampling_time=0.1)
    u = pd.DataFrame({"u": rng.standard_normal(300)})
    y = plant.simulate(u) + rng.standard_normal((300, 2))
    y = pd.DataFrame(y, columns=["a", "b"])
    turned, plant = y[["b", "a"]], plant.with_names(output_names=["a", "b"])
    stream, expected = SubspaceLTI(1), SubspaceLTI(1).partial_fit(u, y)
    for first, part in ((0, y), (100, turned), (200, turned)):
        stream.partial_fit(u[first : first + 100], part[first : first + 100])
    assert_allclose(stream.predict(u), expected.predict(u))
    local = SubspaceLTI(1, sampling_time=0.1).fit(u, y)
    for model in (local, LocalLPVPipeline(local, "passthrough").fit(u, y)):
        turned_and_not = (uses(model, u, given) for given in (turned, y))
        for found, right in zip(*turned_and_not, strict=True):
            assert_array_equal(found, right)
    reports = [compare_models({"plant": plant}, u, given) for given in (turned, y)]
    pd.testing.assert_frame_equal(*reports)


@pytest.mark.parametrize("kind", MODELS)
def test_only_columns_with_a_needed_role_are_needed(kind, fitted):
    few = X[["kappa", "run", "force"]].assign(zeta="text", alpha=np.nan)
    for found, expected in zip(
        uses(fitted[kind], few[sorted(few)], Y), uses(fitted[kind], X, Y), strict=True
    ):
        assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("kind", MODELS)
def test_columns_without_a_role_in_the_fit_are_inputs_by_name(kind):
    model = make(kind).set_params(inputs=None).fit(X, Y)
    mixed = X.assign(extra=1.0)[["extra", "run", "kappa", "force"]]
    assert_array_equal(model.predict(mixed), model.predict(X))
    with pytest.raises(ValueError, match=r"none of name 'force' \(inputs\)"):
        model.predict(X.drop(columns="force"))


def test_a_time_invariant_model_needs_no_scheduling_variable(fitted):
    table = X.drop(columns=["kappa", "time"])
    assert_array_equal(fitted["local"].predict(table), fitted["local"].predict(X))
    with pytest.raises(ValueError, match=r"'kappa' \(scheduling\)"):
        fitted["pipeline"].predict(table)


# ------------------------------------------------------------------- gaps and jitter


@pytest.mark.filterwarnings(r"ignore:\d+ of \d+ values of the outputs are missing")
@pytest.mark.parametrize("kind", MODELS)
def test_missing_outputs_count_nowhere_and_are_told(kind, at_home):
    X, Y = TABLES[kind]
    lost = np.random.default_rng(3).random(Y.shape) < 0.03
    y = Y.mask(lost)
    model, known = at_home[kind], ~lost[:, 0]
    report = fit_report(model, X, y)
    assert report["n_missing"].sum() == lost.sum()
    by_run = {run: (X["run"] == run).to_numpy() & known for run in report["experiment"]}
    expected = [bft_score(Y[rows], model.predict(X)[rows]) for rows in by_run.values()]
    assert_allclose(report["BFT"], expected)
    display = SimulationDisplay.from_estimator(model, X, y)
    assert display.n_missing_.tolist() == [int(lost[:150].sum())]
    residuals = ResidualDisplay.from_estimator(model, X, y)
    assert (residuals.tests["n_missing"] == lost.sum()).all()
    assert residuals.axes_[0, 0].get_ylabel().endswith(f", {lost.sum()} missing")
    for found in uses(model, X, y):
        assert np.isfinite(np.asarray(found, dtype=float)).all()
    with pytest.raises(ValueError, match="y contains NaN.*missing='split'"):
        make(kind).fit(X, y)
    again = make(kind, missing="estimate").fit(X, y)
    assert_allclose(model_of(again), model_of(model), rtol=0.1)


@pytest.mark.filterwarnings(r"ignore:\d+ of \d+ values of the outputs are missing")
@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("hole", ["rows", "inputs", "both"])
def test_holes_are_gaps_for_a_fit_that_splits(kind, hole, at_home):
    X, Y = TABLES[kind]
    table, y = X, Y
    if hole != "inputs":
        kept = np.random.default_rng(4).random(len(X)) > 0.02
        table, y = table[kept], y[kept]
    if hole != "rows":
        gone = np.arange(len(table)) % 61 == 20
        table = table.assign(force=table["force"].mask(gone))
    with pytest.raises(ValueError, match="missing='split'"):
        make(kind).fit(table, y)
    model = make(kind, missing="split").fit(table, y)
    assert_allclose(model_of(model), model_of(at_home[kind]), rtol=0.1)
    with pytest.raises(ValueError, match="predict_with_initial_state"):
        model.predict(table)
    gone = table["force"].isna().to_numpy()
    estimate = {"initial_state": "estimate"}
    report = fit_report(model, table, y, **estimate)
    assert (report["BFT"] > 95).all() and report["n_missing"].sum() == gone.sum()
    assert make_bft_scorer(**estimate)(model, table, y) > 95
    assert_array_equal(np.isnan(model.predict_with_initial_state(table, y))[:, 0], gone)
    models = {"model": model, "lpv": getattr(model, "lpv_", None) or model.lti_}
    compared = compare_models(models, table, y, **estimate)
    assert compared["n_missing"].sum() == 2 * gone.sum()
    SimulationDisplay.from_estimator(model, table, y, **estimate)


@pytest.mark.slow
@pytest.mark.parametrize("kind", MODELS)
def test_jitter_is_accepted_up_to_the_tolerance_and_told(kind, at_home):
    X, Y = TABLES[kind]
    off = np.random.default_rng(5).uniform(-1, 1, len(X))
    jittered = X.assign(time=X["time"] + 0.02 * 0.008 * off)
    model = make(kind).fit(jittered, Y)
    assert 0.006 < model.time_jitter_ < 0.01
    assert at_home[kind].time_jitter_ < 1e-9
    assert_allclose(model_of(model), model_of(at_home[kind]), rtol=1e-2)
    worse = X.assign(time=X["time"] + 0.02 * 0.05 * off)
    with pytest.raises(ValueError, match="`time_tol` accepts.*lpvlearn.resample"):
        make(kind).fit(worse, Y)
    model = make(kind, time_tol=0.06).fit(worse, Y)
    assert 0.04 < model.time_jitter_ < 0.06
    assert np.isfinite(model.predict(worse)).all()
    assert compare_models({"m": model}, worse, Y)["BFT"].min() > 90


# -------------------------------------------------------------------- units of time


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("whole", [False, True])
def test_milliseconds_after_seconds_are_refused_and_agree_with_themselves(
    kind, whole, fitted
):
    ms = X.assign(time=1000 * X["time"])
    ms = ms.assign(time=ms["time"].round().astype(int)) if whole else ms
    with pytest.raises(ValueError, match=r"20 s.*0.02 s|0.02 s.*20 s") as raised:
        fitted[kind].predict(ms)
    assert "a column of milliseconds by 1000" in str(raised.value)
    with pytest.raises(ValueError, match="a column of milliseconds by 1000"):
        fitted[kind].score(ms, Y)
    slow = SubspaceLTI(2, horizon=8, inputs="force", **ROLES).fit(ms, Y)
    assert slow.lti_.sampling_time == pytest.approx(20.0)
    assert_allclose(slow.predict(ms), slow.predict(X.drop(columns="time")))
    with pytest.raises(ValueError, match="X must have the time step of the model"):
        slow.predict(X)


def test_another_step_is_refused_by_a_discrete_model_and_followed_by_lpv(fitted):
    halved = X.assign(time=X["time"] / 2)
    with pytest.raises(ValueError, match=r"step of the model. Got 0.02 s, and 0.01 s"):
        fitted["local"].predict(halved)
    first = X["run"] == "p0r0"
    simulated = fitted["pipeline"].predict(halved[first])[:, 0]
    frozen = fitted["pipeline"].lpv_.at(0.0)
    expected = frozen.simulate(X.loc[first, ["force"]], sampling_time=0.01)[:, 0]
    assert_allclose(simulated, expected, atol=1e-9)
