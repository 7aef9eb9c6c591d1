"""What fuzzing found, by class: each was a wrong result, a hang or a riddle."""

import warnings
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest

import lpvlearn as lp
from lpvlearn.datasets import FlexibleArm, prbs
from lpvlearn.inspection import (
    ErrorDisplay,
    ParameterDisplay,
    PoleDisplay,
    SimulationDisplay,
)
from lpvlearn.validation import number, real_array, whole_number

from ..conftest import spring_lpv
from .calls import QUICK, TABLE_ROLES, calls, world

NO_NUMBERS = {
    "complex numbers among objects": np.array([1.0, 2.0 + 0j], object),
    "NumPy's complex numbers among objects": np.array([np.complex128(1j)], object),
    "text among objects": np.array([1.0, "2"], object),
    "bytes": np.array([b"1"]),
    "dates": np.array(["2020-01-01"], "M8[s]"),
    "time differences, which NumPy counts as integers": np.timedelta64(1, "s"),
    "time differences among objects": np.array([np.timedelta64(1, "s")], object),
    "dicts": np.array([{}, {}], object),
    "an integer beyond floats": [10**400],
    "an integer of too many digits to be shown": 10**5000,
    "a signalling NaN": Decimal("sNaN"),
    "a signalling NaN among objects": np.array([Decimal("sNaN"), 1], object),
    "a missing scalar": None,
    "pandas' missing scalar": pd.NA,
    "rows of several lengths": [[1.0], [1.0, 2.0]],
    "records": np.array([(1, 2.0)], dtype=[("a", int), ("b", float)]),
}


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_what_is_no_number_is_refused_by_name(value):
    with pytest.raises(ValueError, match=r"^`gain` must hold real numbers only. Got"):
        real_array("gain", value)
    with pytest.raises(ValueError, match=r"^`gain` must be a finite number. Got"):
        number("gain", value)
    if not isinstance(value, int):
        with pytest.raises(ValueError, match=r"^`gain` must be an integer, at least 0"):
            whole_number("gain", value, 0)


@pytest.mark.parametrize(
    "value, expected",
    [
        (np.ma.masked_equal([1.0, -9.0], -9.0), [1.0, np.nan]),
        (pd.Series([1, None], dtype="Int64"), [1.0, np.nan]),
        (np.array([1.0, None], object), [1.0, np.nan]),
        ([Decimal("0.5"), True], [0.5, 1.0]),
        (pd.Series([2, 1], dtype="category"), [2.0, 1.0]),
        (np.array([1, 2], ">f8"), [1.0, 2.0]),
    ],
)
def test_numbers_come_in_many_dresses_and_what_is_missing_is_nan(value, expected):
    found = real_array("gain", value)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.float64 and found.flags.writeable


@pytest.mark.parametrize("of", [np.array, pd.Series])
def test_tables_of_one_axis_are_told_by_splitters_and_scorers(of):
    x, w = of([1.0, 2.0, 3.0, 4.0]), world()
    for split in (lp.ExperimentSplit(2), lp.BlockedTimeSeriesSplit(2)):
        with pytest.raises(ValueError, match="X must have shape"):
            list(split.split(x))
    for scorer in (lp.bft_scorer, lp.vaf_scorer):
        with pytest.raises(ValueError, match="X must|`X` must|as many rows as X"):
            scorer(w.subspace, x, w.y)


@pytest.mark.filterwarnings("ignore:Experiment.s. 2")  # at another operating point
def test_a_stream_asks_for_the_outputs_of_every_batch():
    w = world()
    model = lp.SubspaceLTI(**QUICK, **TABLE_ROLES).partial_fit(w.X, w.y)
    before = model.lti_
    with pytest.raises(ValueError, match="`y` must hold the outputs of every batch"):
        model.partial_fit(w.X.assign(run="more"), None)
    assert model.lti_ is before


def test_a_gain_has_no_poles_to_be_uncertain_of():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((200, 1))
    y = 2.0 * u + 0.01 * rng.standard_normal((200, 1))
    model = lp.SubspaceLTI(0, refine="simulation", sampling_time=1.0).fit(u, y)
    assert model.poles_std_.shape == (0,)


@pytest.mark.parametrize("A", [[[0.0]], [[0, 1], [0, 0]], [[0, 0], [0, -1]]])
@pytest.mark.parametrize("sampling_time", [None, 0.1])
def test_a_singular_state_matrix_is_a_model_like_others(A, sampling_time):
    n = len(A)
    model = lp.StateSpace(A, np.ones((n, 1)), np.ones((1, n)), None, sampling_time)
    if sampling_time is None:
        assert np.isinf(model.dc_gain()).all() and model.hinf_norm() == np.inf
        integrated = model.to_discrete(0.1).simulate(np.ones(9))
        assert np.isfinite(integrated).all()
    else:
        with pytest.raises(ValueError, match="pole"):
            model.to_continuous()


@pytest.mark.parametrize("label", ["$x_{", "cost $ and $_", r"$\frac$", "$x_1$", "$"])
def test_dollars_that_are_no_formula_are_drawn(label):
    time, y = np.arange(9.0), np.ones((9, 1)) * np.arange(9.0)[:, None]
    display = SimulationDisplay.from_predictions(
        time, y, {label: y}, output_names=[label], units=label
    )
    display.figure_.canvas.draw()


def test_a_high_degree_in_many_variables_ends_at_once():
    rng = np.random.default_rng(0)
    X, y = rng.standard_normal((100, 4)), rng.standard_normal(100)
    with pytest.raises(ValueError, match="`degree` must make at most 10000 terms"):
        lp.PolynomialLPV(100).fit(X, y)
    levels = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], [0.0, 1])).reshape(4, -1).T
    model = lp.PolynomialLPV(100).fit(levels, levels.prod(axis=1))
    assert len(model.powers_) == 16


def test_a_sampling_period_of_ages_is_no_integration():
    with pytest.raises(ValueError, match="at most 2000 integration steps"):
        FlexibleArm().simulate(np.zeros((3, 2)), 0.5, 1e16)


def test_a_scheduling_value_beyond_all_numbers_is_told():
    with pytest.raises(ValueError, match="near the range of the fit"):
        spring_lpv().at(1e308)
    line = lp.PolynomialLPV(2).fit([[0.0], [1.0], [2.0]], [0.0, 1.0, 4.0])
    for evaluate in (line.predict, line.sensitivities):
        with pytest.raises(ValueError, match="near the range of the fit"):
            evaluate([[1e308]])


def test_a_forged_report_is_refused_when_it_is_read(tmp_path):
    pipeline = world().pipeline
    path, whole = tmp_path / "m.zip", pipeline.report_
    try:
        pipeline.report_ = whole.drop(columns="interpolation_error")
        with pytest.raises(ValueError, match="its tables do not tell what those"):
            lp.save(pipeline, path)
    finally:
        pipeline.report_ = whole
    lp.save(pipeline, path)
    assert lp.load(path).summary() == pipeline.summary()


HUGE = np.full((4, 2), 1e308)


@pytest.mark.parametrize(
    "name, spoiled, told",
    [
        ("SubspaceLTI.fit", {"inputs": [[1], [1, 2]]}, "column"),
        ("SubspaceLTI.fit(arrays)", {"order": np.timedelta64(1, "s")}, "`order` must"),
        ("PoleDisplay", {"scheduling_label": [[1], [1, 2]]}, "`scheduling_label` must"),
        (
            "InnovationModel.estimate_initial_state",
            {"u": np.full((60, 1), -1e308)},
            "`u` must hold numbers below",
        ),
        ("PoleDisplay", {"local_kappa": np.ones((4, 2))}, "`local_kappa` must have as"),
        ("PoleDisplay", {"local_poles": HUGE}, "below 1e\\+150"),
        ("ParameterDisplay.from_estimator", {"names": pd.NaT}, "`names` must"),
        (
            "ParameterDisplay.from_estimator",
            {"scheduling_label": iter([])},
            "`scheduling_label` must hold 1 names",
        ),
        ("PoleDisplay", {"kappa": np.zeros((4, 0))}, "`kappa` must have shape"),
        ("FlexibleArm.simulate", {"sampling_time": 7}, "at most 2000 integration"),
        ("LocalLPVPipeline.fit", {"time_tol": np.timedelta64(1, "s")}, "`time_tol`"),
        ("GrayBoxRestructurer.fit(coherence)", {"n_averages": 10**400}, "n_averages"),
        ("ErrorDisplay", {"norms": "text"}, "`norms` must be a mapping"),
        ("PolynomialLPV", {"X": HUGE[:, :1]}, "`X` must hold numbers below"),
        ("PolynomialLPV.score", {"y": HUGE}, "`y` must hold numbers below"),
        ("AutoLPV", {"X": 1e-200 * np.ones((4, 1)).cumsum(0)}, "whose powers"),
        ("GrayBoxRestructurer.score", {"y": HUGE[:3]}, "`y` must hold numbers below"),
        ("GrayBoxRestructurer.fit_model", {"norm": np.eye(3)}, "`norm` must be"),
        ("GrayBoxRestructurer.predict", {"omega": [1e200]}, "`omega` must hold"),
        ("GrayBoxRestructurer.fit", {"omega": [1e199, 1e200]}, "`omega` must hold"),
        ("vaf_score", {"multioutput": [1e308, 1e308]}, "`multioutput` must hold"),
        ("FlexibleArm.simulate", {"velocity_reference": [[1e200, 0.0]]}, "must hold n"),
        ("fit_report(pipeline)", {"y": np.full((180, 1), 1e308)}, "`y` must hold"),
        ("from_trajectories", {"sampling_time": 1e308}, "1e-100 to 1e\\+100"),
        ("make_flexible_arm", {"n_realizations": 10**6}, "`n_realizations`.*rows"),
        ("make_unbalanced_disc", {"duration": 1e6}, "`duration` must be at most"),
        ("make_unbalanced_disc", {"snr_db": -np.inf}, "`snr_db` must be"),
        ("SplineLPV", {"covariance": np.full((4, 2, 2), 1e200)}, "`covariance` must"),
        ("UnbalancedDisc.acceleration", {"u": -1e308}, "`u` must hold numbers below"),
        (
            "InnovationModel.estimate_initial_state",
            {"y": np.full((180, 1), 1e308)},
            "`y` must hold numbers below",
        ),
        ("vaf_score", {"y_true": [10**400] * 40}, "`y_true` must hold numbers. Got"),
        ("StateSpace.properties", {"A": 1e200 * np.eye(2)}, "`A` must hold numbers be"),
        (
            "StateSpace.properties",
            {"A": [[0.0, 1.0], [-1e100, -1.0]], "sampling_time": None},
            # LAPACK finds them or does not, by its version
            "`A` must be stable, beyond rounding|eigenvalues of `A` did not converge",
        ),
        ("SubspaceLTI.fit", {"feedthrough": pd.NA}, "`feedthrough` must be True"),
        ("SubspaceLTI.fit(automatic)", {"order": 10**6}, "`order` must be at most"),
        ("SubspaceLTI.fit(automatic)", {"horizon": 10**6}, "`horizon` must be at most"),
        ("GrayBoxRestructurer.fit", {"frf": [[1], [1, 2]]}, "`frf` must hold"),
        ("GrayBoxRestructurer.fit_model", {"search": pd.NA}, "`search` must be True"),
        (
            "GrayBoxRestructurer.fit_model",
            {"starts": np.array(3.0)},
            "`starts` must be",
        ),
        (
            "GrayBoxRestructurer.score",
            {"sample_weight": 0},
            "`sample_weight` must hold 3",
        ),
        (
            "PolynomialLPV.fit(weights)",
            {"sample_weight": ["a"]},
            "`sample_weight` must",
        ),
        (
            "SubspaceLTI.score",
            {"sample_weight": [1.0]},
            "`sample_weight` must hold 180",
        ),
        (
            "LPVStateSpace.rest_and_free_responses",
            {"u": [1.0]},
            "`scheduling` must have",
        ),
        ("GrayBoxStructure.full", {"integrating": 0}, "`integrating` must be a list"),
        ("GrayBoxStructure.from_function", {"jacobian": len}, "`jacobian` must return"),
        ("GrayBoxStructure.from_function", {"jacobian": 1}, "`jacobian` must be a fun"),
        ("LPVStateSpace.to_mat(path)", {"path": 0}, "`path` must name a file"),
        (
            "SubspaceLTI.fit(integrating)",
            {"integrating": pd.NA},
            "`integrating` must be",
        ),
        (
            "UnbalancedDisc.simulate",
            {"voltage": [-1e308, 0.0]},
            "`voltage` must hold n",
        ),
        ("BodeDisplay.from_models", {"std": np.array([])}, "`std` must be a dict"),
        ("BodeDisplay.from_estimator", {"kappa": [[1], [1, 2]]}, "`kappa` must hold"),
        ("ErrorDisplay.from_models", {"start": 0}, "`start` must be a StateSpace"),
        ("ParameterDisplay.from_estimator", {"forms": {"k": "v"}}, "`forms` must hold"),
        (
            "SimulationDisplay.from_estimator",
            {"experiment": pd.NA},
            "`experiment` must",
        ),
        ("SimulationDisplay.from_estimator", {"zoom": []}, "`zoom` must be"),
        ("SubspaceLTI.fit", {"feedthrough": [[1], [1, 2]]}, "`feedthrough` must be T"),
        (
            "PoleDisplay",
            {"poles": np.full((4, 2), np.inf)},
            "must be finite. Got .0.*inf",
        ),
        (
            "SimulationDisplay",
            {"y_true": HUGE[:, :1]},
            "`y_true` must hold numbers below",
        ),
        (
            "GrayBoxRestructurer.fit(noise)",
            {"omega": [1e-201, 1e-200, 1e-199]},
            "`omega` must hold zero or numbers of at least",
        ),
    ],
)
def test_what_surveys_found_is_told(name, spoiled, told):
    call = calls()[name]
    with pytest.raises(ValueError, match=told):
        call.function(**{**call.arguments, **spoiled})


@pytest.mark.filterwarnings("ignore:Output 1 is .* in all samples")
def test_what_surveys_found_is_right():
    structure, theta = world().structure, np.array([30.0, 1.2, 40.0])
    masked = structure.system_matrix(np.ma.masked_less(theta, 0.0))
    assert (masked == structure.system_matrix(theta)).all()
    folds = lp.BlockedTimeSeriesSplit(2, max_train_size=2**63)
    assert len(list(folds.split(np.ones((9, 1))))) == 2
    assert lp.parameter_fit([1.0, 2.0], [1.0, 1e120]) < -1e100
    u, tiny = np.sin(np.arange(60.0) ** 2)[:, None], np.full(60, 5e-324)
    assert lp.SubspaceLTI().fit(u, tiny).order_ == 0
    kappa = np.full((4, 3), 1e16)
    predicted = lp.PolynomialLPV().fit(kappa, np.ones((4, 1))).predict(kappa)
    np.testing.assert_allclose(predicted, 1.0, rtol=1e-12)
    frequencies = np.array([1.0, 2.0, 3.0])
    display = ErrorDisplay(frequencies, np.full(3, np.inf), start=frequencies)
    assert np.isfinite(display.plot().ax_.get_ylim()).all()
    columns = np.column_stack([np.repeat([0.0, 1.0, 2.0], 9), np.arange(27.0)])
    folds = lp.BlockedTimeSeriesSplit(2, experiment=0)
    for ours, theirs in zip(
        folds.split(columns.view(np.matrix)), folds.split(columns), strict=True
    ):
        assert all((a == b).all() for a, b in zip(ours, theirs, strict=True))
    tiny = lp.GrayBoxStructure.from_function(
        lambda t: ([[-t[0]]], [[t[1]]], [[1.0]]), [1e-320, 1.0]
    )
    assert (tiny.jacobian([2.0, 3.0]).ravel() == [-1, 0, 0, 0, 0, 1, 0, 0]).all()
    for score in (lp.bft_score, lp.vaf_score):
        assert score(1e-200 * theta, 1e-200 * theta[::-1]) == score(theta, theta[::-1])
        assert score([1e308, 0.9e308], [-1e308, -0.9e308]) == 0.0
        assert score([1e308, -1e308, 0.0], [1e308, -1e308, 0.0]) == 100.0


@pytest.mark.parametrize("value", [np.inf, 1e308])
def test_scheduling_beyond_arithmetic_is_told_of_splits(value):
    X = np.column_stack([np.ones(9), np.full(9, value), np.repeat([0, 1, 2], 3)])
    with pytest.raises(ValueError, match="`scheduling` must"):
        list(lp.ExperimentSplit(3, experiment=2, scheduling=1).split(X))


@pytest.mark.parametrize("size", [1.0, 1e100, 1e149])
def test_gains_at_a_pole_of_rounding_are_infinite(size):
    model = lp.StateSpace(np.full((2, 2), size), [[0], [1]], [[1, 0]], None, 0.1)
    assert np.isinf(model.dc_gain()) == (size > 1.0)
    assert np.isinf(lp.StateSpace(0, size, size).frequency_response([0.0])).all()


@pytest.mark.parametrize("size", [1e-100, 1e100, 1e149])
def test_states_of_other_units_are_balanced_alike(size):
    plain = lp.StateSpace([[0, 1], [-4, -1]], [[0], [1]], [[1, 0]])
    model = lp.StateSpace([[0, size], [-4 / size, -1]], [[0], [1]], [[1 / size, 0]])
    np.testing.assert_allclose(
        model.hankel_singular_values(), plain.hankel_singular_values(), rtol=1e-12
    )


def test_numbers_of_other_kinds_are_numbers_or_refused():
    arm, reference = FlexibleArm(), np.ones((3, 2))
    plain = arm.simulate(reference, 1.5, 0.25).y
    for kind in (np.longdouble, Fraction):
        assert (arm.simulate(reference, 1.5, kind(0.25)).y == plain).all()
    kappa, P = np.arange(4.0)[:, None], np.tile(1e-2 * np.eye(2), (4, 1, 1))
    P[0, 1, 0] = np.inf  # no covariance: none is used
    theta = np.column_stack([kappa, 1.0 + kappa**2])
    model = lp.RationalLPV(1, 1).fit(kappa, theta, covariance=P)
    assert np.isfinite(model.predict(kappa)).all()
    with pytest.raises(ValueError, match="`kappa` must be finite.*Got nan"):
        ParameterDisplay(np.full(4, np.nan), {"local": theta})


def test_what_is_no_label_is_told():
    X = world().X
    groups = X["run"].to_numpy().copy()
    groups[3] = np.zeros(2)
    with pytest.raises(TypeError, match="`groups` must hold one label in each row"):
        list(lp.ExperimentSplit(3).split(X, None, groups))


def test_parameters_near_the_smallest_number_are_interpolated():
    call = calls()["RationalLPV"]
    tiny = np.full((4, 2), 5e-324)
    assert np.isfinite(call.function(**{**call.arguments, "y": tiny})).all()


def test_limits_of_time_are_numbers_of_any_kind():
    call = calls()["GrayBoxRestructurer.fit"]
    for seconds in (Decimal("9.5"), np.float16(9)):
        call.function(**{**call.arguments, "max_time": seconds})
    with pytest.raises(TypeError, match="`batches` must be an iterable of pairs"):
        lp.SubspaceLTI().fit_batches(0)


def test_what_no_number_can_stand_for_is_refused():
    y = np.ones((3, 1))
    with pytest.raises(ValueError, match="`time` must be finite"):
        SimulationDisplay([0.0, 1.0, np.nan], y, {"model": y})
    with pytest.raises(ValueError, match="`kappa` and `poles` must be finite"):
        PoleDisplay([0.0, 1.0], np.full((2, 1), -np.inf))
    with pytest.raises(ValueError, match="one or two scheduling variables .* Got 0"):
        ParameterDisplay(np.ones((4, 0)), {"local": np.ones((4, 1))})
    empty = pd.DataFrame()
    with pytest.raises(ValueError, match="`y` must hold a row for each frequency"):
        world().restructurer.score(empty, empty)
    for make in (lp.OutputErrorLPV, lp.LocalLPVPipeline):
        for verbose in (pd.Series([1, 2]), -1):
            with pytest.raises(ValueError, match="`verbose` must be an integer"):
                make(verbose=verbose, scheduling="kappa").fit(world().X, world().y)
    with pytest.raises(ValueError, match="`sampling_time` must be a positive number"):
        lp.SubspaceLTI(sampling_time=5e-324).fit(world().X, world().y)
    with pytest.raises(ValueError, match="`sampling_time` must be a positive number"):
        FlexibleArm().simulate(np.zeros((3, 2)), 1.0, sampling_time=5e-324)


@pytest.mark.parametrize("name", ["X", "y"])
def test_infinity_is_not_resampled(name):
    call, infinite = calls()["resample"], getattr(world(), name).copy()
    infinite.iloc[5, 0] = np.inf
    with pytest.raises(ValueError, match="must hold numbers below.*Got inf at row 5"):
        call.function(**{**call.arguments, name: infinite})


def test_times_of_text_are_refused_by_all():
    call, X = calls()["resample"], world().X.astype({"time": str})
    with pytest.raises(ValueError, match="Convert text"):
        call.function(**{**call.arguments, "X": X})


@pytest.mark.parametrize("digits", [400, 5000])
def test_times_beyond_floats_are_refused_at_their_row(digits):
    X = world().X.astype({"time": object})
    X.iloc[2, X.columns.get_loc("time")] = 10**digits
    with pytest.raises(ValueError, match="finite numbers .* Got .* at row 2"):
        calls()["resample"].function(**{**calls()["resample"].arguments, "X": X})


def test_times_of_text_are_refused_where_they_are_categories():
    X = world().X.iloc[:1].astype({"time": str}).astype({"time": "category"})
    call = calls()["SubspaceLTI.predict"]
    with pytest.raises(ValueError, match="Convert text"):
        call.function(**{**call.arguments, "X": X})


@pytest.mark.filterwarnings("ignore:Output 1 is .* in all samples")
def test_a_constant_of_any_size_is_found():
    u = np.random.default_rng(0).standard_normal((180, 1))
    model = lp.SubspaceLTI().fit(u, np.full((180, 1), 1e16))
    np.testing.assert_allclose(model.predict(u), 1e16)


def test_a_missing_name_names_no_column_of_a_dataset(tmp_path):
    arrow = pytest.importorskip("pyarrow.parquet")
    table = pytest.importorskip("pyarrow").Table.from_pandas(world().X)
    arrow.write_table(table, tmp_path / "runs.parquet")
    with pytest.raises(ValueError, match="`outputs` must name columns .* Got <NA>"):
        lp.LocalLPVPipeline().fit_dataset(tmp_path / "runs.parquet", outputs=pd.NA)


def test_parameters_are_squarable_and_bounds_beyond_are_none():
    model = lp.StateSpace([[-1.0]], [[2.0]], [[1.0]])
    lag = lp.GrayBoxStructure.from_template([["-a"]], [["b"]], [[1.0]])
    for init in ({"a": 1.0, "b": 1e200}, {"a": 1e308, "b": -1e308}):
        with pytest.raises(ValueError, match="must hold numbers below 1e.150"):
            lp.GrayBoxRestructurer(lag, init=init).fit_model(model)
    with pytest.raises(ValueError, match="`bounds` must hold numbers below 1e.150"):
        lag.with_bounds({"a": (1e300, None)})
    with pytest.raises(ValueError, match="`ranges` must hold numbers below 1e.150"):
        lag.with_ranges({"a": (1.0, 1e300)})
    free = lag.with_bounds({"a": (-1e308, 1e308)})
    assert not free.is_bounded
    fitted = lp.GrayBoxRestructurer(free).fit_model(model)
    np.testing.assert_allclose(fitted.params_, [1.0, 2.0])


def test_an_output_error_model_that_grows_within_its_range_is_told():
    w = world()
    with pytest.warns(UserWarning, match="unstable at values within.*Where no exper"):
        lp.OutputErrorLPV(  # the table's time, taken for a scheduling variable
            w.lpv, inputs="force", scheduling="time", experiment="kappa", time="time",
            max_iter=2,
        ).fit(w.X, w.y)  # fmt: skip


def test_sequences_that_no_memory_holds_are_refused():
    with pytest.raises(ValueError, match="`n_samples` .* `n_channels`"):
        prbs(1_000_000, n_channels=1_000_000)
    with pytest.raises(ValueError, match="`balance` times `n_channels` must be at"):
        prbs(10, n_channels=1_000_000, balance=1_000_000)


@pytest.mark.parametrize("end", [1e12, 1e16])
def test_times_that_span_more_steps_than_memory_holds_are_refused(end):
    X = pd.DataFrame({"t": [*np.arange(0.0, 50.0), end], "u": 1.0})
    with pytest.raises(ValueError, match="must not span more than 100,000,000 steps"):
        lp.resample(X, time="t")


def test_numbers_near_the_smallest_make_no_warning_of_numpy():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 60), 3)[:, None]
    rates = lp.StateSpace([[-1.0]], [[1.0]], [[1.0]]).simulate(u, sampling_time=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", UserWarning)
        lp.SubspaceLTI(sampling_time=0.1, integrating=True).fit(
            u, 1e-203 * np.cumsum(rates, axis=0)
        )
        lp.SubspaceLTI().fit(u, np.full((180, 1), 1e-320))


def test_simulated_sampling_times_may_be_fractions():
    third = Fraction(1, 3)
    disc = lp.datasets.make_unbalanced_disc(
        2, duration=4, large_duration=2, sampling_time=third, clock=third
    )
    assert disc.sampling_time == float(third)


def test_ragged_ranges_and_frequencies_without_squares_are_told():
    lpv = world().lpv
    with pytest.raises(ValueError, match="`identified_range` must"):
        lp.LPVStateSpace(
            lpv.structure, lpv.interpolator, lpv.scheduling_range,
            identified_range=[[1], [1, 2]],
        )  # fmt: skip
    lag = lp.GrayBoxStructure.from_template([["-a"]], [["b"]], [[1.0]])
    with pytest.raises(ValueError, match="`omega` must hold zero or numbers of at"):
        lp.GrayBoxRestructurer(lag).fit([0.1, 1e-320, 10.0], np.ones((3, 2)))


def test_ragged_responses_have_no_score():
    lag = lp.GrayBoxStructure.from_template([["-a"]], [["b"]], [[1.0]])
    omega = np.array([0.1, 1.0])
    G = lag.model([2.0, 3.0]).frequency_response(omega)
    fitted = lp.GrayBoxRestructurer(lag).fit(omega, G)
    assert fitted.score(omega, G) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="`y` must"):
        fitted.score(omega, [[1], [1, 2]])
