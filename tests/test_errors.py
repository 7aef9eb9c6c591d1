"""What a new user gets wrong, and what the library answers.

Every message names the argument or the place, the rule, the value that it got, and
what to do instead.
"""

import numpy as np
import pandas as pd
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from lpvlearn import (
    BlockedTimeSeriesSplit,
    ExperimentSplit,
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    LPVStateSpace,
    PolynomialLPV,
    StateSpace,
    SubspaceLTI,
    bft_score,
    bft_scorer,
    compare_models,
    fit_report,
    from_trajectories,
    make_bft_scorer,
    parameter_fit,
    peak_gains,
    readable_report,
)
from lpvlearn.datasets import FlexibleArm, make_flexible_arm
from lpvlearn.inspection import BodeDisplay, SimulationDisplay

from .conftest import (
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_structure,
    spring_sweep,
    spring_tables,
    stable_model,
)

X, Y = spring_tables(n_samples=150)
X_SWEEP, Y_SWEEP = spring_sweep(300)
FIVE_POINTS = spring_tables(n_samples=20, kappas=np.linspace(0, 2, 5))
U = np.random.default_rng(3).standard_normal((80, 1))
SPRING = spring_lpv().at(0.0)
SHUFFLED = np.random.default_rng(0).permutation(len(X))
TWO_INPUTS = GrayBoxStructure.from_template(
    [[0, 1], ["-k", "-c"]], [[0, 0], ["b", "d"]], [[1, 0]]
)
UNSTABLE = Y.where(
    X[["run"]].to_numpy() != "p2r0",
    (np.exp(0.5 * X["time"]) * np.cos(20 * X["time"])).to_numpy()[:, None],
)


def fit(X=X, y=Y, **options):
    """Fit a pipeline with one thing wrong."""
    options = {"restructurer": GrayBoxRestructurer(spring_structure()), **options}
    return LocalLPVPipeline(**{**ROLES, **options}).fit(X, y)


def spring_restructurer(**options):
    return GrayBoxRestructurer(spring_structure(), **options)


def put(value, row, column, table=X):
    """A table with one wrong value."""
    table = table.astype({column: object}) if isinstance(value, str) else table.copy()
    table.loc[row, column] = value
    return table


@pytest.fixture(scope="module")
def fitted():
    return spring_pipeline().fit(X, Y)


# Calls that go wrong, and words of the answer in the order in which they come.
TABLES = {
    "a misspelt scheduling column": (
        lambda: fit(scheduling="kapa"),
        [
            "`scheduling` must name a column",
            "'force', 'kappa'",
            "'kapa'. Did you mean 'kappa'?",
        ],
    ),
    "a misspelt experiment column": (
        lambda: fit(experiment="Run"),
        ["`experiment`", "Got 'Run'. Did you mean 'run'?"],
    ),
    "a misspelt time column": (lambda: fit(time="tme"), ["`time`", "mean 'time'?"]),
    "a misspelt input column": (
        lambda: fit(inputs=["forces"]),
        ["`inputs`", "Got 'forces'. Did you mean 'force'?"],
    ),
    "a column of quite another name": (
        lambda: fit(inputs="voltage"),
        ["`inputs` must name a column", "Got 'voltage'."],
    ),
    "a name where there are only positions": (
        lambda: LocalLPVPipeline(scheduling="kappa").fit(X[["force"]].to_numpy(), Y),
        ["`scheduling` must be an integer position", "array", "'kappa'"],
    ),
    "a position beyond the table": (
        lambda: LocalLPVPipeline(scheduling=7).fit(X[["force"]].to_numpy(), Y),
        ["`scheduling` must be a position among the 1 columns", "Got 7"],
    ),
    "one name for two columns": (
        lambda: fit(pd.concat([X, X[["force"]]], axis=1)),
        ["X must have distinct column names", "'force' 2 times", "rename"],
    ),
    "a forgotten role of a column of labels": (
        lambda: LocalLPVPipeline(scheduling="kappa", time="time").fit(X, Y),
        ["Column 'run' of X must hold numbers", "'p0r0' at row 0", "its role"],
    ),
    "shuffled rows": (
        lambda: fit(X.iloc[SHUFFLED], Y.iloc[SHUFFLED]),
        [
            "Time column 'time' of experiment",
            "must increase",
            "Got",
            "Do not shuffle",
            "ExperimentSplit",
            "BlockedTimeSeriesSplit",
        ],
    ),
    "a row that stands twice": (
        lambda: fit(X.assign(time=X["time"].mask(X.index == 7, 0.12))),
        ["must increase", "0.12 s followed by 0.12 s", "Drop rows that stand twice"],
    ),
    "a forgotten role of the experiment column": (
        lambda: fit(experiment=None, inputs="force"),
        ["must increase", "followed by 0 s", "`experiment` must name the column"],
    ),
    "forgotten roles of experiment and time": (
        lambda: LocalLPVPipeline(inputs="force", scheduling="kappa").fit(X, Y),
        ["Experiment 0 must be local", "`experiment` must name the column"],
    ),
    "an output left among the inputs": (
        lambda: fit(X.assign(position=Y["position"])),
        ["`inputs` must not hold an output", "'position' in X and in y", "drop it"],
    ),
    "an experiment that is too short": (
        lambda: fit(
            X[(X["run"] != "p1r0") | (X["time"] < 0.5)],
            Y[(X["run"] != "p1r0") | (X["time"] < 0.5)],
            local=SubspaceLTI(2, horizon=20),
        ),
        [
            "operating point 1 (scheduling 0.5)",
            "`horizon` must be at most",
            "25 samples",
            "on_error='skip'",
        ],
    ),
    "an output that stands still at one point": (
        lambda: fit(y=Y.mask(X["kappa"] == 0.5, 0.5)),
        ["operating point 1", "An output must vary. Got [0.5]", "on_error='skip'"],
    ),
    "an output far from zero": (
        lambda: fit(y=Y + 1000.0, local=SubspaceLTI(offset=None, refine=False)),
        ["must be stable", "subtract their value at rest from y", "offset='auto'"],
    ),
    "a missing sample": (
        lambda: fit(X.drop(index=50), Y.drop(index=50)),
        [
            "Time column 'time' of experiment 'p0r0' must be evenly spaced",
            "0.04 s",
            "1 row(s) are missing, at 1 place(s)",
            "missing='split'",
        ],
    ),
    "a logger that changed its rate": (
        lambda: SubspaceLTI(1, time="time").fit(
            pd.DataFrame({"u": U[:, 0], "time": np.cumsum([0.5] * 30 + [0.1] * 50)}),
            U[:, 0],
        ),
        ["evenly spaced", "changed its rate, lpvlearn.resample with sampling_time=0.5"],
    ),
    "a clock that jitters": (
        lambda: fit(X.assign(time=X["time"].mask(X.index == 7, 0.1414))),
        [
            "evenly spaced",
            "at sample 7, 0.068 of the step",
            "`time_tol`",
            "lpvlearn.resample",
        ],
    ),
    "outputs of other rows of one table": (
        lambda: fit(X.iloc[:300], Y.iloc[1:301]),
        ["`y` must have the row labels of X", "1 label(s)", "the first 300"],
    ),
    "a tolerance of a whole step": (
        lambda: fit(time_tol=1),
        ["`time_tol` must be a share of the time step", "Got 1"],
    ),
    "a sweep among local experiments": (
        lambda: fit(pd.concat([X, X_SWEEP]), pd.concat([Y, Y_SWEEP])),
        ["Experiment 'sweep' must be local", "1.5", "0.25 times", "for validation"],
    ),
    "a sweep alone": (
        lambda: fit(X_SWEEP, Y_SWEEP),
        ["Experiment 'sweep' must be local", "1.5", "for validation"],
    ),
    "NaN in an input": (
        lambda: fit(put(np.nan, 5, "force")),
        ["X contains NaN", "'force' of experiment 'p0r0', at row 5", "fill the gap"],
    ),
    "infinity in an input": (
        lambda: fit(put(np.inf, 5, "force")),
        ["X contains infinity", "'force'", "row 5"],
    ),
    "NaN in the scheduling variable": (
        lambda: fit(put(np.nan, 5, "kappa")),
        ["X contains NaN", "'kappa'", "row 5"],
    ),
    "NaN in an output": (
        lambda: fit(y=put(np.nan, 7, "position", Y)),
        ["y contains NaN", "'position' of experiment 'p0r0', at row 7", "'split'"],
    ),
    "a start at rest after a gap": (
        lambda: fit(
            y=put(np.nan, 70, "position", Y),
            local=SubspaceLTI(2, missing="split", initial_state="rest"),
        ),
        [
            "`initial_state` must be 'estimate' with missing='split'",
            "what follows a gap does not start from rest",
            "Got 'rest'",
        ],
    ),
    "a missing label": (
        lambda: fit(X.assign(run=X["run"].where(X.index != 3))),
        ["`experiment` column 'run' must label every row", "row 3"],
    ),
    "a text among the inputs": (
        lambda: fit(put("off", 3, "force")),
        ["Column 'force' of X must hold numbers", "'off' at row 3"],
    ),
    "a text among the outputs": (
        lambda: fit(y=put("a", 3, "position", Y)),
        ["Column 'position' of y must hold numbers", "'a' at row 3"],
    ),
    "an input that never moves": (
        lambda: fit(X.assign(force=1.0)),
        ["Every input must vary", "'force' constant at 1", "`inputs`"],
    ),
    "an input that does not move at one point": (
        lambda: fit(X.assign(force=X["force"].where(X["kappa"] != 0.5, 1.0))),
        ["operating point 1 (scheduling 0.5): Every input must vary", "'force'"],
    ),
    "an input of an array that does not move": (
        lambda: LocalLPVPipeline(scheduling=2, experiment=3, sampling_time=1).fit(
            X[["force", "time", "kappa", "run"]].assign(time=0.0).to_numpy(), Y
        ),
        ["Every input must vary", "Got input 1 constant at 0"],
    ),
    "an output that never moves": (
        lambda: fit(y=0 * Y + 2),
        ["Every output must vary", "'position' constant at 2", "`y`"],
    ),
    "experiments of one sample": (
        lambda: fit(X.groupby("run").head(1), Y[X["time"] == 0]),
        ["at least 2 samples", "Got n_samples = 1"],
    ),
    "too few samples for the order": (
        lambda: fit(local=SubspaceLTI(order=60)),
        ["`order` must be at most", "150 samples and horizon", "Got 60"],
    ),
    "too few samples for the horizon": (
        lambda: fit(local=SubspaceLTI(horizon=500)),
        ["`horizon` must be at most", "150 samples", "Got 500", "horizon='auto'"],
    ),
    "an empty table": (
        lambda: fit(X.iloc[:0], Y.iloc[:0]),
        ["0 sample(s)", "minimum of 1"],
    ),
    "fewer outputs than inputs": (
        lambda: fit(y=Y.iloc[:-1]),
        ["inconsistent numbers of samples", "[600, 599]"],
    ),
    "no outputs": (lambda: fit(y=None), ["requires y"]),
    "times as text": (
        lambda: fit(X.assign(time=X["time"].map("{} s".format))),
        ["Time column 'time' must hold finite numbers", "'0.0 s'", "to_datetime"],
    ),
    "another sampling time than the table's": (
        lambda: fit(sampling_time=0.1),
        ["`sampling_time` must be the step of the time column", "0.1 s, and 0.02 s"],
    ),
    "experiments of different sampling times": (
        lambda: fit(X.assign(time=X["time"] * np.where(X["run"] == "p0r0", 2, 1))),
        ["same time step", "0.04 s, and 0.02 s", "'p1r0'"],
    ),
    "a negative sampling time": (
        lambda: fit(X.drop(columns="time"), time=None, sampling_time=-1),
        ["`sampling_time` must be a positive number of seconds", "-1"],
    ),
    "operating points without a scheduling variable": (
        lambda: fit(scheduling=None, operating_point="kappa"),
        ["`scheduling` must name the variables", "Got None", "4 values"],
    ),
    "an operating point that changes within an experiment": (
        lambda: fit(inputs="force", operating_point="force"),
        [
            "`operating_point` column 'force' must hold one value per experiment",
            "'p0r0'",
        ],
    ),
    "a tolerance that joins all points": (
        lambda: fit(*FIVE_POINTS, scheduling_tol=0.5),
        ["`scheduling_tol` must separate", "With 0.5, 5 experiments", "smaller"],
    ),
    "a negative tolerance": (
        lambda: fit(scheduling_tol=-1),
        ["`scheduling_tol` must be a non-negative number", "Got -1"],
    ),
}

TABLES |= {
    "no time for a structure": (
        lambda: fit(X.drop(columns="time"), time=None),
        ["`time` or `sampling_time`", "structure", "continuous time", "Got neither"],
    ),
    "no time for an LPV model": (
        lambda: fit(X.drop(columns="time"), time=None, restructurer="passthrough"),
        ["`time` or `sampling_time`", "LPV model", "`time=`", "sampling_time=1"],
    ),
    "a column too many among the inputs": (
        lambda: fit(X.assign(torque=X["force"] ** 2 + X["time"] % 0.1)),
        ["`structure` has", "1 inputs", "2 input column(s), 'force', 'torque'"],
    ),
    "inputs named that the structure lacks": (
        lambda: fit(X.assign(torque=1 - X["force"]), inputs=["force", "torque"]),
        ["'force', 'torque'", "as named in `inputs`"],
    ),
    "an output that the structure lacks": (
        lambda: fit(y=Y.assign(speed=Y["position"].diff().fillna(0.0))),
        ["1 outputs", "`y` has 2 column(s), 'position', 'speed'", "in its order"],
    ),
    "the time among the inputs": (
        lambda: fit(inputs=["force", "time"]),
        ["`inputs` must not name", "the `time` column already", "'time'"],
    ),
    "the time to tell experiments": (
        lambda: fit(experiment="time"),
        ["`time` must not name", "the `experiment` column already", "'time'"],
    ),
    "a scheduling variable of words": (
        lambda: fit(scheduling="run", experiment=None, inputs="force"),
        ["Column 'run' of X must hold numbers", "'p0r0'"],
    ),
    "X and y swapped": (lambda: fit(Y, X), ["name a column", "('position')", "'run'"]),
    "a file for the table": (
        lambda: fit("data.csv"),
        ["`X` must be a table (a pandas.DataFrame)", "'data.csv'"],
    ),
    "a name for the outputs": (
        lambda: fit(y="position"),
        ["`y` must be a table (a pandas.DataFrame)", "'position'"],
    ),
    "nothing for the table": (lambda: fit(None), ["`X` must be a table", "None"]),
    "a set for the table": (lambda: fit({1, 2}), ["`X` must be a table", "set"]),
    "dates for the inputs": (
        lambda: SubspaceLTI(1).fit(np.zeros((4, 1), "datetime64[s]"), np.ones(4)),
        ["`X` must hold numbers", "dates", "`time`"],
    ),
    "a dict for the table": (lambda: fit({"a": 1}), ["`X` must be a table", "dict"]),
    "a series of words for the outputs": (
        lambda: fit(y=put("off", 3, "position", Y)["position"]),
        ["Column 'position' of y must hold numbers", "'off' at row 3", "Mend"],
    ),
    "an array of words for the outputs": (
        lambda: fit(y=put("off", 3, "position", Y).to_numpy()),
        ["`y` must hold numbers", "'off' at row 3, column 0"],
    ),
    "a list of words for the outputs": (
        lambda: fit(y=["off"] * len(X)),
        ["`y` must hold numbers", "'off' at row 0"],
    ),
    "a number for the outputs": (lambda: fit(y=3.0), ["`y` must be a table", "float"]),
    "words in an array of inputs": (
        lambda: SubspaceLTI(1).fit([["1.0"], ["off"]], [1.0, 2.0]),
        ["`X` must hold numbers", "'off' at row 1, column 0"],
    ),
    "rows of several lengths": (
        lambda: SubspaceLTI(1).fit([[1.0], [1.0, 2.0]], [1.0, 2.0]),
        ["`X` must have rows of one length"],
    ),
    "masked samples": (
        lambda: SubspaceLTI(1).fit(U, np.ma.masked_array(U[:, 0], U[:, 0] > 1)),
        ["y contains NaN", "'y1'"],
    ),
    "a tolerance of words": (
        lambda: fit(scheduling_tol="small"),
        ["`scheduling_tol` must", "'small'"],
    ),
}

STEPS = {
    "a structure with other inputs": (
        lambda: fit(restructurer=GrayBoxRestructurer(TWO_INPUTS)),
        ["`structure` has 1 outputs and 2 inputs", "agree"],
    ),
    "a list as structure": (
        lambda: fit(restructurer=GrayBoxRestructurer([[0, 1], ["-k", "-c"]])),
        ["`structure` must be a GrayBoxStructure", "Got list"],
    ),
    "a structure as restructurer": (
        lambda: fit(restructurer=spring_structure()),
        [
            "`restructurer` must be an estimator, 'aligned', 'passthrough' or None",
            "Got GrayBoxStructure",
            "GrayBoxRestructurer(structure)",
        ],
    ),
    "a word for the restructurer": (
        lambda: fit(restructurer="pass"),
        ["`restructurer` must be", "'passthrough'", "Got 'pass'"],
    ),
    "a regressor as restructurer": (
        lambda: fit(restructurer=LinearRegression()),
        ["`restructurer`", "Got LinearRegression", "fit_model"],
    ),
    "a class for the local estimator": (
        lambda: fit(local=SubspaceLTI),
        ["`local` must be an estimator", "class SubspaceLTI", "SubspaceLTI()"],
    ),
    "a method for the local estimator": (
        lambda: fit(local="po-moesp"),
        ["`local` must be an estimator", "Got 'po-moesp'", "SubspaceLTI()"],
    ),
    "a regressor as local estimator": (
        lambda: fit(local=LinearRegression()),
        ["`local` must be an estimator that identifies", "Got LinearRegression"],
    ),
    "a degree for the interpolator": (
        lambda: fit(interpolator=2),
        ["`interpolator` must be an estimator", "Got int", "PolynomialLPV()"],
    ),
    "an unstable local model": (
        lambda: fit(y=UNSTABLE, local=SubspaceLTI(order=2)),
        [
            "operating point 2 (scheduling 1)",
            "must be stable",
            "pole at",
            "stability='enforce'",
            "on_error='skip'",
        ],
    ),
    "a degree too high for the points": (
        lambda: fit(interpolator=PolynomialLPV(4)),
        ["`degree` must be at most 3 for 4 operating points", "Got 4"],
    ),
    "half a degree": (
        lambda: fit(interpolator=PolynomialLPV(1.5)),
        ["`degree` must be an integer", "Got 1.5"],
    ),
    "an unknown subspace method": (
        lambda: fit(local=SubspaceLTI(method="moesp")),
        ["`method` must be 'auto', 'po-moesp'", "Got 'moesp'"],
    ),
    "an unknown norm": (
        lambda: fit(restructurer=GrayBoxRestructurer(spring_structure(), norm="inf")),
        ["`norm` must be 'hinf'", "Got 'inf'"],
    ),
    "a guess of the wrong length": (
        lambda: fit(restructurer=GrayBoxRestructurer(spring_structure(), init=[1, 2])),
        ["3 finite values (b, c, k)", "Got [1. 2.]"],
    ),
    "an unknown way to combine": (
        lambda: fit(combine="mean"),
        ["`combine` must be 'pool' or 'average'", "Got 'mean'"],
    ),
    "an unknown discretization": (
        lambda: fit(discretization="tusin"),
        ["`discretization` must be 'auto', 'zoh', 'foh' or 'tustin'", "Got 'tusin'"],
    ),
    "a number for the memory": (lambda: fit(memory=3), ["`memory` must be", "Got int"]),
    "a misspelt parameter of a step": (
        lambda: LocalLPVPipeline().set_params(local__horizn=3),
        ["Invalid parameter 'horizn'", "horizon"],
    ),
    "a template that is not affine": (
        lambda: GrayBoxStructure.from_template([["-k*c"]], [["b"]], [[1]]),
        ["`A[0][0]`", "affine", "'-k*c'", "from_function"],
    ),
    "a template of the wrong shape": (
        lambda: GrayBoxStructure.from_template([["-k"]], [["b"]], [[1, 0]]),
        ["`C` must have shape (1, 1)", "Got (1, 2)"],
    ),
    "a model that is not square": (
        lambda: StateSpace([[1, 2]], [[1]], [[1]]),
        ["`A` must be square", "(1, 2)"],
    ),
}

STEPS |= {
    "a word for the feedthrough": (
        lambda: fit(local=SubspaceLTI(2, feedthrough="no")),
        ["`feedthrough` must be True, False or a table", "Got 'no'"],
    ),
    "a word for the jobs": (lambda: fit(n_jobs="all"), ["`n_jobs`", "-1", "'all'"]),
    "no job": (lambda: fit(n_jobs=0), ["`n_jobs`", "not 0"]),
    "a word for the progress": (
        lambda: fit(verbose="yes"),
        ["`verbose` must be an integer", "'yes'"],
    ),
    "a word for the efficiency": (
        lambda: fit(efficient="yes"),
        ["`efficient` must be True or False", "'yes'"],
    ),
    "time in samples for a structure": (
        lambda: spring_restructurer().fit_model(SubspaceLTI(2).fit(U, U * 1.0).lti_),
        ["`model` must have a known sampling time", "`time=`", "sampling_time=1"],
    ),
    "time in samples in continuous time": (
        lambda: SubspaceLTI(1, horizon=5).fit(U, np.roll(U, 1)).lti_.to_continuous(),
        ["`sampling_time` must be known", "`time=`", "`sampling_time=`"],
    ),
    "discrete time for equations of motion": (
        lambda: GrayBoxRestructurer(
            GrayBoxStructure.mechanical([["m"]], [["c"]], [["k"]], [[1]])
        ).fit_model(SPRING.to_discrete(0.02)),
        ["`model` must be in continuous time", "0.02 s", "to_continuous()"],
    ),
    "models of several clocks": (
        lambda: spring_restructurer().fit_model([SPRING, SPRING.to_discrete(0.02)]),
        ["one sampling time", "None and 0.02"],
    ),
    "a model of more inputs": (
        lambda: spring_restructurer().fit_model(stable_model(0, 2, 2, 1)),
        ["1 inputs, `model` has 1 and 2", "role was forgotten"],
    ),
    "a number for the starts": (
        lambda: spring_restructurer().fit_model(SPRING, starts=3),
        ["`starts` must be a list", "Got int", "brackets"],
    ),
    "a model for the realizations": (
        lambda: spring_restructurer().fit_model(SPRING, realizations=SPRING),
        ["`realizations` must be a list", "StateSpace"],
    ),
    "numbers for the realizations": (
        lambda: spring_restructurer().fit_model(SPRING, realizations=[1, 2]),
        ["`realizations` must be at least 2 models", "2 of int"],
    ),
    "a model without its uncertainty": (
        lambda: spring_restructurer(norm="covariance").fit_model(
            SPRING, estimates=[SPRING]
        ),
        ["`estimates` must hold pairs", "StateSpace"],
    ),
    "weights of words": (
        lambda: spring_restructurer().fit([1, 2], [[1, 2]] * 2, ["a", "b"]),
        ["`sample_weight` must hold real numbers", "'a'"],
    ),
    "weights of zero": (
        lambda: spring_restructurer().fit([1, 2], [[1, 2]] * 2, [0, 0]),
        ["`sample_weight`", "not all zero"],
    ),
    "weights without squares": (
        lambda: spring_restructurer().fit([1, 2], [[1, 2]] * 2, [1e-200, 1e-200]),
        ["`sample_weight`", "not all zero, as what lies below 1e-150"],
    ),
    "a word for a function": (
        lambda: GrayBoxStructure.from_function("pendulum", [1.0]),
        ["`function` must return (A, B, C)", "Got str"],
    ),
    "a function of two matrices": (
        lambda: GrayBoxStructure.from_function(lambda p: (1, 2), [1.0]),
        ["`function`", "(A, B, C)", "Got 2"],
    ),
    "a word for the structure of a model": (
        lambda: LPVStateSpace("spring", PolynomialLPV(), [[0], [1]]),
        ["`structure` must be a GrayBoxStructure", "Got str"],
    ),
    "nothing for the interpolator of a model": (
        lambda: LPVStateSpace(spring_structure(), None, [[0], [1]]),
        ["`interpolator` must be a fitted regressor", "NoneType"],
    ),
    "an interpolator of other parameters": (
        lambda: LPVStateSpace(
            spring_structure(), PolynomialLPV(1).fit([[0], [1]], [0, 1]), [[0], [1]]
        ).at(0.5),
        ["`interpolator` must predict the 3 parameters", "(1,)"],
    ),
    "arguments in another order": (
        lambda: spring_lpv().simulate(np.ones(99), 0.02, np.ones(99)),
        ["`sampling_time` must be a positive number", "array([1., 1.", "..."],
    ),
    "a word for a model": (lambda: peak_gains("G"), ["`model`", "StateSpace", "str"]),
    "models of samples and of seconds in one picture": (
        lambda: BodeDisplay.from_models(
            {"a": StateSpace(0.5, 1, 1, sampling_time=True), "b": StateSpace(-1, 1, 1)}
        ),
        ["count time alike", "True, None", "`time=`"],
    ),
    "words for frequencies": (
        lambda: BodeDisplay.from_models({"a": SPRING}, omega="low"),
        ["`omega`", "'low'"],
    ),
    "a word for axes": (
        lambda: BodeDisplay.from_models({"a": SPRING}, ax="left"),
        ["`ax` must be None", "1 of str"],
    ),
    "a word for the time of a picture": (
        lambda: SimulationDisplay.from_predictions("t", U, U),
        ["`time`", "'t'"],
    ),
    "a number for a zoom": (
        lambda: SimulationDisplay.from_predictions(np.arange(80), U, U, zoom=3),
        ["`zoom` must be (t_start, t_stop)", "Got 3"],
    ),
}

SPLITS = {
    "more folds than experiments": (
        lambda: list(ExperimentSplit(9, experiment="run").split(X)),
        ["`n_splits` must be at most the number of experiments", "Got 9 for 4"],
    ),
    "folds of a table of one experiment": (
        lambda: list(ExperimentSplit(2).split(X)),
        ["Got 2 for 1", "`experiment`"],
    ),
    "points held out without a column that tells them": (
        lambda: list(
            ExperimentSplit(2, experiment="run", hold_out="operating_point").split(X)
        ),
        ["`scheduling` or `operating_point` must name a column", "Got None"],
    ),
    "an unknown thing scored": (
        lambda: list(ExperimentSplit(2, experiment="run", test_on="train").split(X)),
        ["`test_on` must be 'held_out' or 'all'", "Got 'train'"],
    ),
    "an unknown thing held out": (
        lambda: list(ExperimentSplit(2, hold_out="points").split(X)),
        ["`hold_out` must be 'experiment' or 'operating_point'", "Got 'points'"],
    ),
    "one fold": (
        lambda: list(ExperimentSplit(1, experiment="run").split(X)),
        ["`n_splits` must be an integer, at least 2", "Got 1"],
    ),
    "no point inside the others": (
        lambda: list(
            ExperimentSplit(
                "all",
                experiment="run",
                scheduling="kappa",
                hold_out="operating_point",
                interior=True,
            ).split(X[X["kappa"] < 0.7])
        ),
        ["inside the range of the others", "Got 'all' for 0"],
    ),
    "the number of folds of no table": (
        lambda: ExperimentSplit("all", experiment="run").get_n_splits(),
        ["`X` must be given"],
    ),
    "a gap longer than a block": (
        lambda: list(BlockedTimeSeriesSplit(3, gap=60, experiment="run").split(X)),
        ["`gap` must be shorter than a block", "Got 60", "37 samples", "'p0r0'"],
    ),
    "a column that a splitter does not find": (
        lambda: list(ExperimentSplit(2, experiment="runs").split(X)),
        ["`experiment` must name a column", "Did you mean 'run'?"],
    ),
    "a scorer of an unknown start": (
        lambda: make_bft_scorer(initial_state="zero"),
        ["`initial_state` must be 'rest' or 'estimate'", "Got 'zero'"],
    ),
    "a simulation of another shape": (
        lambda: bft_score([1, 2], [1, 2, 3]),
        ["must have the same shape", "(2, 1) and (3, 1)"],
    ),
    "models in a list": (
        lambda: compare_models([LinearRegression()], X, Y),
        ["`models` must be a dict", "Got list"],
    ),
    "trajectories of unequal length": (
        lambda: from_trajectories([([1, 2], [1, 2, 3])]),
        ["`trajectories` must hold arrays of equal length", "[2, 3] in trajectory 0"],
    ),
    "trajectories of words": (
        lambda: from_trajectories([("a", "b")]),
        ["`trajectories[0]: u` must", "'a'"],
    ),
    "no list of trajectories": (
        lambda: from_trajectories(None),
        ["`trajectories` must be a list of tuples", "NoneType"],
    ),
    "trajectories in three dimensions": (
        lambda: from_trajectories([(np.zeros((2, 2, 2)), np.zeros(8))]),
        ["`trajectories[0]: u` must have shape", "(2, 2, 2)"],
    ),
    "trajectories back in time": (
        lambda: from_trajectories([([1, 2], [1, 2])], sampling_time=-1),
        ["`sampling_time` must be a positive number", "-1"],
    ),
    "folds of nothing": (
        lambda: list(ExperimentSplit(2).split(None)),
        ["X must have shape (n_samples, n_features)"],
    ),
    "folds of a vector": (
        lambda: list(BlockedTimeSeriesSplit(2).split(U[:, 0])),
        ["X must have shape", "(80,)", "reshape(-1, 1)"],
    ),
    "a score of a model": (
        lambda: bft_scorer(SPRING, X, Y),
        ["`estimator` must be a fitted estimator", "StateSpace", "compare_models"],
    ),
    "a score of words": (
        lambda: bft_score(["a"], [1.0]),
        ["`y_true` must hold numbers", "'a' at row 0"],
    ),
    "a score of numbers": (lambda: bft_score(1.0, 1.0), ["`y_true` must", "float"]),
    "weights of words for outputs": (
        lambda: bft_score([1.0, 2.0], [1.0, 2.0], multioutput=["a"]),
        ["`multioutput` must hold real numbers", "'a'"],
    ),
    "a fit of words": (
        lambda: parameter_fit(["a"], [1]),
        ["`params_true` must hold real numbers", "'a'"],
    ),
    "a report of numbers": (
        lambda: readable_report([1, 2]),
        ["`report` must be a DataFrame", "list"],
    ),
    "a comparison on too many inputs": (
        lambda: compare_models({"a": SPRING}, np.hstack([U, -U]), U[:, 0]),
        ["model 'a': `inputs` must name the 1 input(s)", "[0, 1]"],
    ),
    "an arm of words": (
        lambda: make_flexible_arm(n_operating_points="seven"),
        ["`n_operating_points` must be an integer of at least 1", "'seven'"],
    ),
    "a link of words": (lambda: FlexibleArm(l1="long"), ["`l1` must be", "'long'"]),
    "an arm without operating points": (
        lambda: make_flexible_arm(n_operating_points=0),
        ["`n_operating_points` must be an integer of at least 1", "Got 0"],
    ),
}

USES = {
    "other columns than at fit": (
        lambda model: model.predict(X.rename(columns={"force": "u"})),
        ["the columns that the fit read", "'force' (inputs) among 'u', 'kappa'"],
    ),
    "a column less than at fit": (
        lambda model: model.predict(X.drop(columns=["kappa", "run"])),
        ["the columns that the fit read", "'kappa' (scheduling), 'run' (experiment)"],
    ),
    "milliseconds after seconds": (
        lambda model: model.predict(X.assign(time=1000 * X["time"])),
        [
            "unit of time of the fit",
            "20 s",
            "0.02 s in the fit",
            "milliseconds by 1000",
        ],
    ),
    "fewer outputs than rows": (
        lambda model: bft_scorer(model, X, Y[:-1]),
        ["inconsistent numbers of samples", "[600, 599]"],
    ),
    "a report of fewer outputs than rows": (
        lambda model: fit_report(model, X, Y[:-1]),
        ["inconsistent numbers of samples", "[600, 599]"],
    ),
    "outputs of other rows": (
        lambda model: model.score(X.iloc[50:150], Y.iloc[60:160]),
        [
            "`y` must have the row labels of X",
            "10 label(s)",
            "the first 150",
            "to_numpy",
        ],
    ),
    "an input that is missing in a simulation": (
        lambda model: model.predict(put(np.nan, 5, "force")),
        ["X contains NaN", "row 5", "predict_with_initial_state"],
    ),
    "an array of the inputs alone": (
        lambda model: model.predict(X[["force"]].to_numpy()),
        ["1 features", "expecting 4 features"],
    ),
    "initial states from other outputs": (
        lambda model: model.predict_with_initial_state(X, np.hstack([Y, Y])),
        ["`y` must have the 1 output(s) of the model", "Got 2"],
    ),
    "a score of other outputs": (
        lambda model: bft_scorer(model, X, np.hstack([Y, Y])),
        ["must have the same shape", "(600, 2) and (600, 1)"],
    ),
    "a burn-in longer than the experiments": (
        lambda model: fit_report(model, X, Y, burn_in=1000),
        ["`burn_in` must be less", "150 in the shortest", "Got 1000"],
    ),
    "rows in disorder": (
        lambda model: model.predict(X.iloc[SHUFFLED]),
        ["must increase", "Do not shuffle"],
    ),
    "a scheduling trajectory of another length": (
        lambda model: model.lpv_.simulate(np.ones(5), np.ones(4), 0.02),
        ["`scheduling` must have one row for each of the 5 samples", "Got 4"],
    ),
    "two scheduling values for one variable": (
        lambda model: model.lpv_.at([1, 2]),
        ["`kappa` must be one finite value", "1. Got [1, 2]"],
    ),
    "a scheduling value that is missing": (
        lambda model: model.predict(put(np.nan, 5, "kappa")),
        ["X contains NaN", "'kappa'", "row 5"],
    ),
}


def check_answer(call, words):
    with pytest.raises(ValueError) as raised:
        call()
    text, place = str(raised.value), 0
    for word in words:
        assert word in text[place:], text
        place = text.index(word, place) + len(word)


ALL = TABLES | STEPS | SPLITS


OPTIONS = (
    "a start at rest after a gap",
    "an unknown subspace method",
    "an unknown norm",
    "a structure with other inputs",
)


@pytest.mark.parametrize("case", OPTIONS)
@pytest.mark.parametrize("on_error", ["raise", "skip"])
def test_wrong_options_of_a_step_are_not_blamed_on_a_point(case, on_error, monkeypatch):
    monkeypatch.setitem(globals(), "ROLES", {**ROLES, "on_error": on_error})
    with pytest.raises(ValueError, match="^`") as raised:
        ALL[case][0]()
    assert "operating point" not in str(raised.value)


@pytest.mark.filterwarnings("ignore:The (identified )?model")
@pytest.mark.parametrize("case", ALL)
def test_what_is_wrong_is_told(case):
    check_answer(*ALL[case])


@pytest.mark.filterwarnings("ignore:X does not have valid feature names")
@pytest.mark.parametrize("case", USES)
def test_what_is_wrong_with_a_use_is_told(case, fitted):
    call, words = USES[case]
    check_answer(lambda: call(fitted), words)


@pytest.mark.parametrize(
    "use", [lambda m: m.predict(X), lambda m: m.summary(), lambda m: m.score(X, Y)]
)
def test_a_pipeline_is_fitted_before_it_is_used(use):
    with pytest.raises(NotFittedError, match="LocalLPVPipeline instance is not fitted"):
        use(spring_pipeline())
