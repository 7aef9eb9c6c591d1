"""Tables read as experiments: roles, order of time, errors."""

import re

import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.model_selection import (
    GroupKFold,
    KFold,
    LeaveOneGroupOut,
    ShuffleSplit,
    TimeSeriesSplit,
)
from sklearn.utils.estimator_checks import parametrize_with_checks
from sklearn.utils.validation import check_is_fitted

from lpvlearn import from_trajectories
from lpvlearn.data.experiments import Experiment, are_beginnings, read_experiments
from lpvlearn.data.tables import read_outputs

ROLES = {"scheduling": "kappa", "experiment": "run", "time": "t"}


class Reader(RegressorMixin, BaseEstimator):
    """A stand-in for the estimators that call `read_experiments`."""


class StaticGain(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Least squares on what `read_experiments` returns: a static system."""

    def __init__(self, experiment=None):
        self.experiment = experiment

    def fit(self, X, y):
        runs = read_experiments(self, X, y, experiment=self.experiment)
        self.one_output_ = np.asarray(y).ndim == 1
        u = np.vstack([run.inputs for run in runs])
        outputs = np.vstack([run.outputs for run in runs])
        self.gain_ = np.linalg.lstsq(u, outputs, rcond=None)[0]
        return self

    def predict(self, X):
        check_is_fitted(self)
        runs = read_experiments(self, X, experiment=self.experiment, reset=False)
        y = np.empty((sum(len(run.rows) for run in runs), self.gain_.shape[1]))
        for run in runs:
            y[run.rows] = run.inputs @ self.gain_
        return y.ravel() if self.one_output_ else y


@parametrize_with_checks([StaticGain()])
def test_an_estimator_on_read_experiments_keeps_scikit_learns_rules(estimator, check):
    check(estimator)


def read(X, y=None, **roles):
    roles.setdefault("reset", y is not None)
    return read_experiments(Reader(), X, y, **roles)


def make_table(n_runs=3, n_samples=5, dt=0.1):
    rng = np.random.default_rng(0)
    X = pd.DataFrame(
        {
            "u1": rng.normal(size=n_runs * n_samples),
            "u2": rng.integers(0, 2, n_runs * n_samples),
            "kappa": np.repeat(np.arange(n_runs) / 7, n_samples),
            "run": np.repeat([f"run {k}" for k in range(n_runs)], n_samples),
            "t": np.tile(dt * np.arange(n_samples), n_runs),
        }
    )
    y = pd.DataFrame(rng.normal(size=(len(X), 2)), columns=["vx", "vy"])
    return X, y


def assert_same(left, right):
    assert len(left) == len(right)
    for a, b in zip(left, right, strict=True):
        np.testing.assert_array_equal(a.inputs, b.inputs)
        np.testing.assert_array_equal(a.outputs, b.outputs)
        np.testing.assert_array_equal(a.scheduling, b.scheduling)
        np.testing.assert_array_equal(a.rows, b.rows)


# ------------------------------------------------------------------------------- roles


def test_columns_without_a_role_are_inputs():
    X, y = make_table()
    runs = read(X, y, **ROLES)
    assert [run.label for run in runs] == ["run 0", "run 1", "run 2"]
    for k, run in enumerate(runs):
        rows = slice(5 * k, 5 * k + 5)
        np.testing.assert_array_equal(run.inputs, X[["u1", "u2"]].iloc[rows])
        np.testing.assert_array_equal(run.outputs, y.iloc[rows])
        np.testing.assert_array_equal(run.scheduling, X[["kappa"]].iloc[rows])
        np.testing.assert_allclose(run.sampling_time, 0.1)
        assert run.inputs.dtype == run.scheduling.dtype == np.float64


def test_a_table_without_roles_is_one_experiment():
    X = np.arange(8).reshape(4, 2)
    (run,) = read(X, [1, 2, 3, 4])
    np.testing.assert_array_equal(run.inputs, X)
    np.testing.assert_array_equal(run.outputs, [[1], [2], [3], [4]])
    assert run.scheduling is None
    assert run.operating_point is None
    assert run.sampling_time is None


def test_arrays_and_lists_take_positions_as_tables_take_names():
    X, y = make_table()
    by_name = read(X, y, **ROLES)
    by_position = {"scheduling": [2], "experiment": 3, "time": -1, "inputs": [0, 1]}
    for table in (X, X.to_numpy(), X.to_numpy().tolist()):
        assert_same(by_name, read(table, y.to_numpy().tolist(), **by_position))


def test_index_levels_take_roles():
    X, y = make_table()
    by_name = read(X, y, **ROLES)
    assert_same(by_name, read(X.set_index(["run", "t"]), y, **ROLES))
    assert_same(by_name, read(X.set_index("t"), y, **ROLES))


def test_polars_tables_read_like_pandas_tables():
    pl = pytest.importorskip("polars")
    X, y = make_table()
    X_polars = pl.DataFrame({name: X[name].tolist() for name in X})
    y_polars = pl.DataFrame({name: y[name].tolist() for name in y})
    assert_same(read(X, y, **ROLES), read(X_polars, y_polars, **ROLES))


def test_interleaved_experiments_are_taken_apart_in_order():
    X, y = make_table()
    order = np.arange(len(X)).reshape(3, 5).T.ravel()
    runs = read(X.iloc[order], y.iloc[order], **ROLES)
    for sorted_run, run in zip(read(X, y, **ROLES), runs, strict=True):
        np.testing.assert_array_equal(run.inputs, sorted_run.inputs)
        np.testing.assert_array_equal(order[run.rows], sorted_run.rows)


def test_experiments_come_in_the_order_of_first_appearance():
    X, y = (table[::-1].reset_index(drop=True) for table in make_table())
    labels = [run.label for run in read(X, y, experiment="run", time=None, inputs="u1")]
    assert labels == ["run 2", "run 1", "run 0"]


@pytest.mark.parametrize(
    "convert",
    [
        lambda labels: labels.astype("category"),
        lambda labels: labels.str[-1].astype(int),
        lambda labels: labels.str[-1].astype("Int64"),
        lambda labels: labels.str[-1].astype(float),
        lambda labels: labels.map(lambda label: ("run", label)),
        lambda labels: pd.to_datetime(
            "2024-01-0" + (labels.str[-1].astype(int) + 1).astype(str)
        ),
    ],
    ids=["categorical", "int", "nullable int", "float", "tuple", "datetime"],
)
def test_labels_of_any_type_group_the_rows_alike(convert):
    X, y = make_table()
    relabelled = X.assign(run=convert(X["run"]))
    runs = read(relabelled, y, **ROLES)
    assert_same(read(X, y, **ROLES), runs)
    assert len({run.label for run in runs}) == 3


@pytest.mark.parametrize("dtype", [object, "Float64", "float32", "category", "str"])
def test_numbers_in_any_container_are_converted(dtype):
    X, y = make_table()
    X["u1"] = np.arange(len(X)) / 4
    np.testing.assert_array_equal(
        read(X.astype({"u1": dtype}), y, **ROLES)[0].inputs,
        read(X, y, **ROLES)[0].inputs,
    )


def test_boolean_and_integer_columns_are_inputs():
    X = pd.DataFrame({"on": [True, False], "level": [3, 4]})
    np.testing.assert_array_equal(read(X, [0, 1])[0].inputs, [[1, 3], [0, 4]])


def test_a_column_may_have_two_roles():
    X, y = make_table()
    runs = read(X, y, operating_point="kappa", **ROLES)
    assert [run.operating_point for run in runs] == [0, 1 / 7, 2 / 7]


def test_feature_names_are_set_in_fit_and_checked_in_predict():
    X, y = make_table()
    reader = Reader()
    read_experiments(reader, X, y, **ROLES)
    assert reader.n_features_in_ == 5
    assert list(reader.feature_names_in_) == list(X)
    assert read_experiments(reader, X, reset=False, **ROLES)[0].outputs is None
    with pytest.raises(ValueError, match=r"none of name 'u1' \(inputs\) among 'v'"):
        read_experiments(reader, X.rename(columns={"u1": "v"}), reset=False, **ROLES)
    with pytest.raises(ValueError, match="requires y to be passed"):
        read_experiments(reader, X, **ROLES)


def test_the_table_is_not_changed():
    X = np.arange(8.0).reshape(4, 2)
    X.flags.writeable = False
    read(X, np.arange(4.0))


def test_output_names_come_from_y():
    X, y = make_table()
    assert read_outputs(y)[1] == ["vx", "vy"]
    assert read_outputs(y["vx"])[1] == ["vx"]
    assert read_outputs(y.to_numpy())[1] == ["y1", "y2"]


# -------------------------------------------------------------------------------- time


def test_a_clock_of_single_samples_has_no_step():
    X, y = make_table(n_samples=1)
    assert [run.sampling_time for run in read(X, y, **ROLES)] == [None] * 3


@pytest.mark.parametrize("splitter", [GroupKFold(3), LeaveOneGroupOut()])
def test_splits_by_experiment_pass_the_guard(splitter):
    X, y = make_table()
    for train, test in splitter.split(X, y, groups=X["run"]):
        assert len(read(X.iloc[train], y.iloc[train], **ROLES)) == 2
        assert len(read(X.iloc[test], y.iloc[test], **ROLES)) == 1


def test_time_splits_pass_the_guard():
    X, y = make_table(n_runs=1, n_samples=50)
    for train, test in TimeSeriesSplit(4).split(X):
        read(X.iloc[train], y.iloc[train], **ROLES)
        read(X.iloc[test], y.iloc[test], **ROLES)


@pytest.mark.parametrize(
    "splitter", [KFold(5, shuffle=True, random_state=0), ShuffleSplit(random_state=0)]
)
def test_shuffled_splits_raise(splitter):
    X, y = make_table(n_runs=1, n_samples=50)
    train, _ = next(splitter.split(X))
    with pytest.raises(ValueError, match="Do not shuffle"):
        read(X.iloc[train], y.iloc[train], **ROLES)


# ------------------------------------------------------------------------------ errors


def _with(column, row, value):
    X, y = make_table()
    X[column] = X[column].astype(object)
    X.loc[row, column] = value
    return X, y


def _slow():
    X, y = make_table()
    X.loc[X["run"] == "run 2", "t"] *= 2
    return X, y


BAD_CALLS = [
    (make_table, {"inputs": "torque"}, ["`inputs`", "'torque'", "'u1', 'u2'"]),
    (make_table, {"scheduling": ["kappa", "k"]}, ["`scheduling`", "'k'"]),
    (make_table, {"experiment": 9}, ["`experiment`", "5 columns", "Got 9"]),
    (make_table, {"time": ("t",)}, ["`time`", "('t',)"]),
    (make_table, {"inputs": []}, ["`inputs`", "at least one"]),
    (make_table, {"inputs": ["u1", 0]}, ["`inputs`", "each once"]),
    (make_table, {"inputs": None, "scheduling": ["u1", "u2", "kappa"]}, ["`inputs`"]),
    (make_table, {"inputs": ["u1", "run"]}, ["`inputs`", "`experiment`", "'run'"]),
    (make_table, {"inputs": ["t", "u1"]}, ["`inputs`", "`time` column", "'t'"]),
    (make_table, {"time": "run"}, ["`time`", "`experiment` column", "'run'"]),
    (make_table, {"scheduling": ["run"]}, ["'run'", "must hold numbers", "'run 0'"]),
    (make_table, {"operating_point": "u1"}, ["`operating_point`", "'u1'", "'run 0'"]),
    (make_table, {"sampling_time": 0.2}, ["`sampling_time`", "0.2 s", "0.1 s"]),
    (
        make_table,
        {"time": "run", "experiment": None},
        ["'run'", "to_datetime", "'run 0'"],
    ),
    (_slow, {}, ["same time step", "0.1 s", "0.2 s", "'run 2'"]),
    (lambda: _with("u1", 7, np.nan), {}, ["NaN", "'u1'", "'run 1'", "row 7"]),
    (lambda: _with("u2", 12, pd.NA), {}, ["NaN", "'u2'", "'run 2'", "row 12"]),
    (lambda: _with("kappa", 3, np.inf), {}, ["infinity", "'kappa'", "row 3"]),
    (lambda: _with("u1", 4, "1,5"), {}, ["'u1'", "numbers", "'1,5'", "row 4"]),
    (lambda: _with("kappa", 4, "1,5"), {}, ["decimal comma", "read_csv(decimal=',')"]),
    (lambda: _with("u1", 4, "1,500.00"), {}, ["read_csv(thousands=',')"]),
    (lambda: _with("u1", 4, 1j), {}, ["'u1'", "numbers", "row 4"]),
    (lambda: _with("run", 4, None), {}, ["`experiment`", "'run'", "row 4"]),
    (lambda: _with("t", 4, np.nan), {}, ["'t'", "finite", "row 4"]),
    (lambda: (make_table()[0], np.ones(3)), {}, ["inconsistent", "15", "3"]),
    (
        lambda: (make_table()[0], make_table()[1].replace({"vy": {}}).assign(vy="a")),
        {},
        ["'vy' of y", "numbers", "'a'"],
    ),
    (
        lambda: (make_table()[0], make_table()[1].assign(vy=np.nan)),
        {},
        ["y contains NaN", "'vy'", "'run 0'", "row 0"],
    ),
    (lambda: (make_table()[0].to_numpy(), np.ones(15)), {}, ["integer position"]),
    (
        lambda: (make_table()[0].rename(columns={"u2": "u1"}), np.ones(15)),
        {"inputs": "u1"},
        ["'u1' 2 times", "distinct"],
    ),
    (
        lambda: (make_table()[0].assign(u1=pd.Timestamp("2024-01-01")), np.ones(15)),
        {},
        ["'u1'", "must hold numbers"],
    ),
    (lambda: (make_table()[0].iloc[:0], np.ones(0)), {}, ["0 sample(s)"]),
]


@pytest.mark.parametrize(("make", "roles", "words"), BAD_CALLS)
def test_bad_tables_raise_and_name_the_cause(make, roles, words):
    X, y = make()
    with pytest.raises(ValueError) as raised:
        read(X, y, **{**ROLES, **roles})
    for word in words:
        assert word in str(raised.value)


# ------------------------------------------------------------------------ trajectories


def test_trajectories_come_back_from_their_tables():
    rng = np.random.default_rng(2)
    trajectories = [
        (rng.normal(size=(n, 2)), rng.normal(size=n), rng.normal(size=(n, 3)))
        for n in (4, 6)
    ]
    X, y = from_trajectories(trajectories, sampling_time=0.5)
    assert list(X) == ["u1", "u2", "kappa", "experiment", "time"]
    assert list(y) == ["y1", "y2", "y3"]
    runs = read(
        X,
        y,
        scheduling="kappa",
        experiment="experiment",
        time="time",
        sampling_time=0.5,
    )
    for (u, kappa, outputs), run in zip(trajectories, runs, strict=True):
        np.testing.assert_array_equal(run.inputs, u)
        np.testing.assert_array_equal(run.scheduling[:, 0], kappa)
        np.testing.assert_array_equal(run.outputs, outputs)


def test_trajectories_may_have_constant_or_several_or_no_scheduling_variables():
    u = np.arange(3.0)
    assert list(from_trajectories([(u, u)])[0]) == ["u1", "experiment"]
    assert (from_trajectories([(u, 0.4, u)])[0]["kappa"] == 0.4).all()
    X, _ = from_trajectories([(u, [[0.4, 0.5]], u)])
    assert list(X) == ["u1", "kappa1", "kappa2", "experiment"]


@pytest.mark.parametrize(
    ("trajectories", "words"),
    [
        ([], ["at least one"]),
        ([np.ones(3)], ["tuples", "trajectory 0"]),
        ([(np.ones(3),)], ["(u, kappa, y)", "Got 1"]),
        ([(np.ones(3), np.ones(2), np.ones(3))], ["equal length", "[3, 2, 3]"]),
        ([(np.ones(3), np.ones(3)), (np.ones((3, 2)), np.ones(3))], ["trajectory 1"]),
    ],
)
def test_bad_trajectories_raise(trajectories, words):
    with pytest.raises(ValueError) as raised:
        from_trajectories(trajectories)
    for word in words:
        assert re.sub(r"\s+", " ", word) in str(raised.value)


def test_a_tuple_that_is_a_column_is_one_column():
    X = pd.DataFrame({("sig", "u"): [1.0, 2.0], ("sig", "kap"): [3.0, 3.0]})
    y = pd.Series([0.0, 1.0], name=("out", "y"))
    for inputs in (("sig", "u"), [("sig", "u")], 0):
        (run,) = read(X, y, inputs=inputs, scheduling=("sig", "kap"))
        assert run.input_names == (("sig", "u"),)
        assert run.scheduling_names == (("sig", "kap"),)
        np.testing.assert_array_equal(run.scheduling, [[3.0], [3.0]])
    assert read_outputs(y)[1] == [("out", "y")]
    (run,) = read(X, y, inputs=(("sig", "u"), ("sig", "kap")))
    assert run.input_names == (("sig", "u"), ("sig", "kap"))


def test_parts_after_a_gap_begin_no_experiment():
    rows = np.arange(3)
    parts = [Experiment(label, rows, rows[:, None]) for label in ("a", "a", "b", "a")]
    assert are_beginnings(parts) == [True, False, True, False]
