"""A valid call of every public name, of which a test spoils an argument or two."""

import contextlib
import tempfile
import warnings
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from sklearn.base import clone

import lpvlearn as lp
from lpvlearn import datasets, inspection, metrics, models

from ..conftest import (
    ROLES,
    spring_lpv,
    spring_pipeline,
    spring_structure,
    spring_tables,
)

QUICK = {
    "order": 2,
    "method": "po-moesp",
    "horizon": 5,
    "refine": False,
    "offset": None,
    "n_noise_states": 0,
}
TABLE_ROLES = {"inputs": "force", "experiment": "run", "time": "time"}
GOLDEN = Path(__file__).parents[1] / "pipeline" / "files" / "local_schema_1.zip"
THETA = [30.0, 1.2, 40.0]


class Call(NamedTuple):
    """A function, its valid arguments, and what else is to be known of it."""

    function: Any
    arguments: dict[str, Any]
    weight: float = 1.0  # of the cases, the smaller the dearer the call
    open: tuple[str, ...] = ()  # kinds of no number that it may return, as documented


@cache
def world():
    """What the calls share: small tables, and models fitted to them."""
    X, y = spring_tables(noise=1e-3, n_samples=60, kappas=(0.0, 0.75, 1.5))
    quick = lp.SubspaceLTI(**QUICK)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        told = clone(quick).set_params(refine="simulation")  # its uncertainty
        subspace = clone(told).set_params(**TABLE_ROLES).fit(X, y)
        pipeline = spring_pipeline(local=told).fit(X, y)
        restructurer = lp.GrayBoxRestructurer(spring_structure(), norm="h2")
        restructurer.fit_model(spring_lpv().at(0.5))
        refined = lp.OutputErrorLPV(
            spring_lpv(), **TABLE_ROLES, scheduling="kappa", max_iter=1
        ).fit(X, y)
    slow = lp.StateSpace([[0, 1], [-4, -1]], [[0], [1]], [[1, 0]])
    fast = slow.to_discrete(0.1)
    noise = models.NoiseModel([[0.5]], [[1.0]], [[0.3]], [[1.0]])
    parquet = Path(tempfile.mkdtemp()) / "part.parquet"
    with contextlib.suppress(ImportError):  # without pyarrow
        X.join(y).to_parquet(parquet)
    return SimpleNamespace(
        parquet=parquet,
        X=X,
        y=y,
        U=X[["force"]].to_numpy()[:60],
        K=X["kappa"].to_numpy()[:60],
        Y=y.to_numpy()[:60],
        quick=quick,
        subspace=subspace,
        pipeline=pipeline,
        refined=refined,
        restructurer=restructurer,
        slow=slow,
        fast=fast,
        innovation=lp.InnovationModel(fast, noise),
        structure=spring_structure(),
        lpv=spring_lpv(),
        arm=datasets.FlexibleArm(),
        disc=datasets.UnbalancedDisc(),
        kappa=np.array([[0.0], [0.5], [1.0], [1.5]]),
        theta=np.array([[1.0, 2.0], [1.5, 2.1], [2.0, 2.5], [2.5, 2.2]]),
        omega=np.array([0.1, 1.0, 10.0]),
    )


def fitting(make, **fixed):
    """A function that fits an estimator of some options."""

    def fit(X, y, **options):
        return make(**{**fixed, **options}).fit(X, y)

    return fit


def drawing(draw):
    """The same function, which draws what it returns on a canvas."""

    def drawn(**arguments):
        try:
            display = draw(**arguments)
            figure = getattr(display, "figure_", None) or display.plot().figure_
            figure.canvas.draw()
        finally:
            plt.close("all")

    return drawn


def constructed(display):
    return drawing(lambda **arguments: display(**arguments))


def fit_interpolator(make):
    def fit(X, y, X_new=None, covariance=None, **options):
        model = make(**options).fit(X, y, covariance=covariance)
        return model.predict(X if X_new is None else X_new)

    return fit


def splitting(make):
    def split(X, y, **options):
        return [[*pair] for pair in make(**options).split(X, y)]

    return split


def streaming(X, y, X_next, y_next, **options):
    model = lp.SubspaceLTI(**{**QUICK, **TABLE_ROLES, **options})
    return model.partial_fit(X, y).partial_fit(X_next, y_next)


def saved_and_loaded(model):
    with tempfile.TemporaryDirectory() as folder:
        lp.save(model, Path(folder) / "m.lpv")
        return lp.load(Path(folder) / "m.lpv")


def html(pipeline, **arguments):
    with tempfile.TemporaryDirectory() as folder:
        pipeline.to_html_report(Path(folder) / "r.html", **arguments)


def lti_calls(w):
    A, B = np.array([[0.0, 1.0], [-4.0, -1.0]]), np.array([[0.0], [1.0]])
    C, D = np.array([[1.0, 0.0]]), np.array([[0.0]])
    yield "StateSpace", lp.StateSpace, {
        "A": A, "B": B, "C": C, "D": D, "sampling_time": 0.1, "input_delay": 1,
        "input_names": ["u"], "output_names": ["y"], "units": {"y": "m"},
    }  # fmt: skip
    yield "StateSpace.with_names", w.slow.with_names, {
        "input_names": ["u"], "output_names": ["y"], "units": {"y": "m"},
    }  # fmt: skip
    for name, model in {"slow": w.slow, "fast": w.fast}.items():
        own = f"StateSpace({name})."
        yield own + "frequency_response", model.frequency_response, {"omega": w.omega}
        yield own + "simulate", model.simulate, {
            "u": w.U, "sampling_time": 0.1, "initial_state": np.array([1.0, 0.0]),
        }  # fmt: skip
        yield own + "with_input_delay", model.with_input_delay, {"input_delay": 0}
        yield own + "balance", model.balance, {"order": 1}
        yield own + "transform", model.transform, {"T": np.eye(2)}
        yield own + "to_continuous", model.to_continuous, {"method": "zoh"}
    yield "StateSpace.to_discrete", w.slow.to_discrete, {
        "sampling_time": 0.1, "method": "tustin",
    }  # fmt: skip
    yield (
        "StateSpace.from_control",
        lp.StateSpace.from_control,
        {"model": SimpleNamespace(A=A, B=B, C=C, D=D, dt=0.1)},
    )
    yield "StateSpace.estimate_initial_state", w.fast.estimate_initial_state, {
        "u": w.U, "y": w.Y,
    }  # fmt: skip
    yield "StateSpace.properties", properties_of_a_model, {
        "A": A, "B": B, "C": C, "D": D, "sampling_time": 0.1,
    }  # fmt: skip
    yield "gap", lp.gap, {"G1": w.slow, "G2": w.slow}
    yield "peak_gains", lp.peak_gains, {"model": w.fast, "within": 1e-6, "norm": "hinf"}
    yield "InnovationModel", lp.InnovationModel, {
        "lti": w.fast, "noise": w.innovation.noise, "gain": np.array([[0.1], [0.1]]),
    }  # fmt: skip
    yield (
        "InnovationModel.noise",
        lambda **a: lp.InnovationModel(w.fast, models.NoiseModel(**a)),
        {"A": A / 9, "C": C, "K": B, "covariance": D + 1},
    )
    yield "InnovationModel.predict", w.innovation.predict, {
        "u": w.U, "y": w.Y, "steps": 2, "initial_state": np.zeros(2),
    }  # fmt: skip
    yield (
        "InnovationModel.estimate_initial_state",
        (w.innovation.estimate_initial_state),
        {"u": w.U, "y": w.Y, "trend": np.ones((1, 60))},
    )


def properties_of_a_model(**arguments):
    """Everything about one model whose matrices a test spoils."""
    model = lp.StateSpace(**arguments)
    values = [model.poles(), model.is_stable, repr(model)]
    if np.isfinite(model.dc_gain()).all() and model.is_stable:
        values += [model.hinf_norm(), model.hankel_singular_values(), model.balance()]
        values += [model.absorb_delay(), model.to_continuous("tustin")]
    return values


def structure_calls(w):
    make, cells = lp.GrayBoxStructure, [["0", "1"], ["-k", "-c"]]
    yield "GrayBoxStructure", make, {
        "order": 2, "map": w.structure.map, "parameter_names": ["b", "c", "k"],
        "initial": np.array(THETA), "lower": np.zeros(3), "upper": np.full(3, 99.0),
        "ranges": np.array([[1.0] * 3, [99.0] * 3]),
    }  # fmt: skip
    yield "GrayBoxStructure.from_template", make.from_template, {
        "A": cells, "B": [["0"], ["b"]], "C": [[1, 0]], "D": [[0.0]],
        "E": [["m", 0], [0, 1]], "descriptor": "rate",
        "parameter_names": ["b", "c", "k", "m"],
    }  # fmt: skip
    yield "GrayBoxStructure.from_function", make.from_function, {
        "function": lambda t: ([[-t[0]]], [[t[1]]], [[1.0]]),
        "initial": np.array([1.0, 2.0]), "parameter_names": ["a", "b"],
        "jacobian": None,
    }  # fmt: skip
    yield "GrayBoxStructure.mechanical", make.mechanical, {
        "M": [["m"]], "D": [["c"]], "K": [["k"]], "F": [[1.0]], "outputs": "position",
        "state": "rate", "sensors": np.array([[1.0]]), "initial": [1.0, 2.0, 3.0],
        "parameter_names": ["c", "k", "m"],
    }  # fmt: skip
    sizes = {"n_inputs": 1, "n_outputs": 2, "feedthrough": True}
    yield "GrayBoxStructure.full", make.full, {
        "order": 2, **sizes, "integrating": [0],
    }  # fmt: skip
    yield "GrayBoxStructure.observable_canonical", make.observable_canonical, {
        "order": 2, **sizes, "indices": [0, 2],
    }  # fmt: skip
    yield "GrayBoxStructure.modal", make.modal, {
        "n_modes": 1, **sizes, "n_real": 1, "normalize": "input",
    }  # fmt: skip
    for name in ("matrices", "jacobian", "system_matrix", "check_params"):
        call = getattr(w.structure, name)
        yield f"GrayBoxStructure.{name}", call, {"theta": np.array(THETA)}
    yield "GrayBoxStructure.model", w.structure.model, {
        "theta": np.array(THETA), "sampling_time": 0.1,
    }  # fmt: skip
    for name, value in {
        "fix": {"k": 40.0},
        "with_bounds": {"k": (1.0, 50.0)},
        "with_ranges": {"k": (1.0, 50.0)},
        "with_stacked_outputs": 2,
    }.items():
        call, argument = getattr(w.structure, name), {
            "fix": "values", "with_bounds": "bounds", "with_ranges": "ranges",
            "with_stacked_outputs": "copies",
        }[name]  # fmt: skip
        yield f"GrayBoxStructure.{name}", call, {argument: value}
    bound = lambda low, high: w.structure.with_bounds({"k": (low, high)})  # noqa: E731
    yield "GrayBoxStructure.with_bounds(values)", bound, {"low": 1.0, "high": 50.0}
    ranges = lambda low, high: w.structure.with_ranges({"k": (low, high)})  # noqa: E731
    yield "GrayBoxStructure.with_ranges(values)", ranges, {"low": 1.0, "high": 50.0}


def restructuring_calls(w):
    G = w.lpv.at(0.5).frequency_response(w.omega).ravel()
    frf = np.column_stack([G.real, G.imag])
    options = {"norm": "h2", "n_starts": 1, "max_iter": 10, "tol": 1e-6}
    yield "GrayBoxRestructurer.fit", (
        lambda omega, frf, sample_weight, **o: lp.GrayBoxRestructurer(
            w.structure, **{**options, **o}
        ).fit(omega, frf, sample_weight).params_
    ), {"omega": w.omega, "frf": frf, "sample_weight": np.ones(3), **options,
        "norm": "hinf",
        "init": THETA, "random_state": 0, "solver": "sqp", "max_time": 10.0,
        "known_poles": None}  # fmt: skip
    noisy = {"omega": w.omega, "frf": frf, "noise": np.full(3, 1e-3)}
    known = lp.GrayBoxRestructurer(w.structure, norm="covariance", init=THETA)
    yield "GrayBoxRestructurer.fit(noise)", (
        lambda omega, frf, noise: known.fit(omega, frf, noise=noise).params_
    ), noisy  # fmt: skip
    yield "GrayBoxRestructurer.fit(coherence)", (
        lambda coherence, n_averages: clone(known).set_params(norm="hinf").fit(
            w.omega, frf, coherence=coherence, n_averages=n_averages
        ).params_
    ), {"coherence": np.full(3, 0.9), "n_averages": 8}  # fmt: skip
    yield "GrayBoxRestructurer.confidence_intervals", (
        lambda confidence: clone(known).fit(**noisy).confidence_intervals(confidence)
    ), {"confidence": 0.9}  # fmt: skip
    yield "GrayBoxRestructurer.fit_model", (
        lambda model, starts, realizations, search, **o: lp.GrayBoxRestructurer(
            **{**options, **o}
        ).fit_model(
            model, starts=starts, realizations=realizations, search=search
        ).params_
    ), {"model": w.lpv.at(0.5), "structure": w.structure, **options, "init": THETA,
        "solver": "sqp", "random_state": 0, "frequency_weight": None,
        "max_time": 10.0, "known_poles": None,
        "starts": [np.array(THETA)], "realizations": [w.lpv.at(0.5), w.lpv.at(0.6)],
        "search": True}  # fmt: skip
    r = w.restructurer
    yield "GrayBoxRestructurer.predict", r.predict, {"omega": w.omega}
    yield "GrayBoxRestructurer.score", r.score, {
        "X": w.omega, "y": frf, "sample_weight": np.ones(3),
    }  # fmt: skip
    yield (
        "GrayBoxRestructurer.interchanged",
        (lambda places: r.interchanged(places).params_),
        {"places": [0, 1, 2]},
    )
    yield "GrayBoxRestructurer.start_error", r.start_error, {
        "model": w.lpv.at(0.5), "params": np.array(THETA),
    }  # fmt: skip
    yield "GrayBoxRestructurer.perturbation_check", r.perturbation_check, {
        "model": w.lpv.at(0.5), "n_restarts": 1, "size": 0.05,
    }  # fmt: skip


def lpv_calls(w):
    table = {"X": w.kappa, "y": w.theta, "X_new": w.kappa + 0.1}
    many = np.broadcast_to(0.01 * np.eye(2), (4, 2, 2))
    both = {**table, "covariance": many}
    for name, make, options in (
        ("PolynomialLPV", lp.PolynomialLPV, {"degree": 1, "basis": "chebyshev"}),
        ("SplineLPV", lp.SplineLPV, {"kind": "pchip"}),
        (
            "RationalLPV",
            lp.RationalLPV,
            {
                "degree": 1,
                "denominator": 1,
                "terms": "total",
            },
        ),
        ("AutoLPV", lp.AutoLPV, {"criterion": "aic"}),
    ):
        yield name, fit_interpolator(make), {
            **both, **options, "extrapolation": "clip",
        }  # fmt: skip
        fitted = make().fit(w.kappa, w.theta)
        for method in ("predict", "sensitivities"):
            yield f"{name}.{method}", getattr(fitted, method), {"X": w.kappa}
        yield f"{name}.score", fitted.score, {
            "X": w.kappa, "y": w.theta, "sample_weight": np.ones(4),
        }  # fmt: skip
        yield (
            f"{name}.with_coefficients",
            fitted.with_coefficients,
            {"coefficients": fitted.coefficients()},
        )
    yield "PolynomialLPV.fit(weights)", (
        lambda **a: lp.PolynomialLPV().fit(**a).predict(w.kappa)
    ), {"X": w.kappa, "y": w.theta, "sample_weight": np.ones(4)}  # fmt: skip
    grid = np.array(np.meshgrid([0.0, 1, 2], [0.0, 1, 2], [0.0, 1])).reshape(3, -1).T
    yield "PolynomialLPV(3 variables)", fit_interpolator(lp.PolynomialLPV), {
        "X": grid, "y": grid, "degree": 1,
    }  # fmt: skip
    model = w.lpv
    yield "LPVStateSpace", lp.LPVStateSpace, {
        "structure": w.structure, "interpolator": model.interpolator,
        "scheduling_range": np.array([[0.0], [1.5]]), "scheduling_names": ["kappa"],
        "identified_range": np.array([[0.0], [1.5]]), "input_delay": 0,
        "input_names": ["u"], "output_names": ["y"], "covariance": np.eye(9),
        "units": {"kappa": "m"},
    }  # fmt: skip
    yield "LPVStateSpace.simulate", model.simulate, {
        "u": w.U, "scheduling": w.K, "sampling_time": 0.02,
        "initial_state": np.zeros(2),
    }  # fmt: skip
    yield "LPVStateSpace.free_responses", model.free_responses, {
        "scheduling": w.K, "sampling_time": 0.02,
    }  # fmt: skip
    fitted = w.pipeline.lpv_
    for method in ("input_offset", "output_offset", "state_offset"):
        yield f"LPVStateSpace.{method}", getattr(model, method), {"kappa": 0.5}
    yield "LPVStateSpace.at", model.at, {"kappa": 0.5, "rate": 0.0}
    yield "LPVStateSpace.rest_and_free_responses", model.rest_and_free_responses, {
        "u": w.U, "scheduling": w.K, "sampling_time": 0.02,
    }  # fmt: skip
    yield "LPVStateSpace.estimate_initial_state", model.estimate_initial_state, {
        "u": w.U, "scheduling": w.K, "y": w.Y, "sampling_time": 0.02,
    }  # fmt: skip
    for method in ("parameters", "frozen_poles", "parameter_deviations"):
        yield f"LPVStateSpace.{method}", getattr(fitted, method), {"kappa": w.kappa}
    yield "LPVStateSpace.parameters(std)", fitted.parameters, {
        "kappa": w.kappa, "return_std": True,
    }  # fmt: skip
    yield "LPVStateSpace.frequency_response_std", fitted.frequency_response_std, {
        "kappa": 0.5, "omega": w.omega,
    }  # fmt: skip
    yield "LPVStateSpace.grid", model.grid, {"points": w.kappa}
    yield "LPVStateSpace.change_basis", model.change_basis, {"T": np.eye(2)}
    yield "LPVStateSpace.coefficients", model.coefficients, {"normalized": True}
    yield "LPVStateSpace.lfr", model.lfr, {"normalized": True}
    yield (
        "LPVStateSpace.to_mat",
        lambda points: to_mat(model, points),
        {"points": w.kappa},
    )
    yield "LPVStateSpace.to_mat(path)", model.to_mat, {
        "path": tempfile.mktemp(".mat"), "points": w.kappa,
    }  # fmt: skip
    yield "MatrixCoefficients.at", model.coefficients().at, {"kappa": 0.5}
    yield "LinearFractionalModel.at", model.lfr().at, {"kappa": 0.5}
    yield "LinearFractionalModel.delta", model.lfr().delta, {"kappa": 0.5}


def to_mat(model, points):
    with tempfile.TemporaryDirectory() as folder:
        model.to_mat(Path(folder) / "m.mat", points)


def data_calls(w):
    table = {"X": w.X, "y": w.y}
    yield "resample", lp.resample, {
        **table, "time": "time", "sampling_time": 0.03, "experiment": "run",
        "method": "linear", "hold": "auto", "max_gap": 3.0, "antialias": True,
    }  # fmt: skip
    yield "split_levels", lp.split_levels, {
        "X": w.X, "scheduling": "kappa", "experiment": "run", "tol": 0.1,
        "min_samples": 5,
    }  # fmt: skip
    yield "from_trajectories", lp.from_trajectories, {
        "trajectories": [(w.U, w.K, w.Y), (w.U, w.K, w.Y)], "sampling_time": 0.1,
    }  # fmt: skip
    yield (
        "from_trajectories(arrays)",
        lambda u, kappa, y: lp.from_trajectories([(u, kappa, y)]),
        {"u": w.U, "kappa": w.K, "y": w.Y},
    )
    yield "ExperimentSplit", splitting(lp.ExperimentSplit), {
        **table, "n_splits": 3, "experiment": "run", "scheduling": "kappa",
        "hold_out": "experiment", "interior": False, "test_on": "held_out",
        "shuffle": True, "random_state": 0, "operating_point": None,
    }  # fmt: skip
    for name, split in {
        "ExperimentSplit": lp.ExperimentSplit(3),
        "BlockedTimeSeriesSplit": lp.BlockedTimeSeriesSplit(3),
    }.items():
        yield f"{name}.split", (
            lambda X, groups, split=split: [*map(list, split.split(X, None, groups))]
        ), {"X": w.X, "groups": w.X["run"].to_numpy()}  # fmt: skip
    yield (
        "ExperimentSplit.get_n_splits",
        (lp.ExperimentSplit(3, experiment="run").get_n_splits),
        {"X": w.X},
    )
    yield "BlockedTimeSeriesSplit", splitting(lp.BlockedTimeSeriesSplit), {
        **table, "n_splits": 3, "gap": 1, "max_train_size": 30, "experiment": "run",
    }  # fmt: skip
    yield (
        "BlockedTimeSeriesSplit.get_n_splits",
        (lp.BlockedTimeSeriesSplit(3).get_n_splits),
        {"X": w.X},
    )


def score_calls(w):
    Y = np.column_stack([w.Y, w.Y**2])
    pair = {"y_true": Y, "y_pred": 0.9 * Y}
    yield "bft_score", lp.bft_score, {**pair, "multioutput": "raw_values"}
    yield "vaf_score", lp.vaf_score, {**pair, "multioutput": np.array([0.3, 0.7])}
    yield "parameter_fit", lp.parameter_fit, {
        "params_true": w.theta, "params_pred": 0.9 * w.theta,
    }  # fmt: skip
    options = {
        "initial_state": "estimate", "burn_in": 2, "multioutput": "raw_values",
        "average": "pool",
    }  # fmt: skip
    table = {"X": w.X, "y": w.y}
    for name, model in {"SubspaceLTI": w.subspace, "pipeline": w.pipeline}.items():
        for make in (lp.make_bft_scorer, lp.make_vaf_scorer):
            yield (
                f"{make.__name__}({name})",
                (lambda X, y, make=make, model=model, **o: make(**o)(model, X, y)),
                {**table, **options},
            )
        yield f"fit_report({name})", lp.fit_report, {
            "estimator": model, **table, "initial_state": "rest", "burn_in": 2,
        }  # fmt: skip
        one = {"estimator": model, **table}
        yield f"bft_scorer({name})", lp.bft_scorer, one
        yield f"vaf_scorer({name})", lp.vaf_scorer, one
    yield "TrajectoryScorer", metrics.TrajectoryScorer, {"metric": "BFT", **options}
    yield "compare_models", lp.compare_models, {
        "models": {"a": w.pipeline, "b": w.lpv}, **table, "initial_state": "rest",
        "burn_in": 2, "scheduling": "kappa", "experiment": "run", "time": "time",
        "inputs": "force",
    }  # fmt: skip
    yield (
        "readable_report",
        lp.readable_report,
        {"report": lp.fit_report(w.pipeline, w.X, w.y)},
    )


def estimator_calls(w):
    table = {"X": w.X, "y": w.y}
    quick = {**QUICK, "sampling_time": 0.02, "time_tol": 0.01, "stability": "warn"}
    more = {
        "feedthrough": True, "input_delay": 0, "initial_state": "estimate",
        "detrend": None, "missing": "raise",
    }  # fmt: skip
    yield "SubspaceLTI.fit", fitting(lp.SubspaceLTI), {
        **table, **quick, **more, **TABLE_ROLES, "scheduling": "kappa",
        "operating_point": None,
    }  # fmt: skip
    short = w.X.iloc[:60].drop(columns=["run"]), w.y.iloc[:60]
    yield "SubspaceLTI.fit(one experiment)", fitting(lp.SubspaceLTI, **QUICK), {
        "X": short[0], "y": short[1], "inputs": "force", "time": "time",
    }  # fmt: skip
    yield "SubspaceLTI.fit(arrays)", fitting(lp.SubspaceLTI, **QUICK), {
        "X": w.U, "y": w.Y, "order": 2,
    }  # fmt: skip
    yield "SubspaceLTI.fit(automatic)", fitting(lp.SubspaceLTI), {
        "X": w.U, "y": w.Y, "order": "auto", "method": "auto", "horizon": "auto",
        "refine": "auto", "offset": "auto", "n_noise_states": "auto",
        "input_delay": "auto", "feedthrough": np.array([[True]]),
    }  # fmt: skip
    yield "SubspaceLTI.fit(closed loop)", fitting(
        lp.SubspaceLTI, order=2, method="pbsid", **TABLE_ROLES
    ), {**table, "stability": "enforce", "offset": None,
        "missing": "split"}  # fmt: skip
    gappy = np.where(np.arange(w.Y.size).reshape(w.Y.shape) % 7, w.Y, np.nan)
    yield "SubspaceLTI.fit(missing outputs)", fitting(
        lp.SubspaceLTI, **{**QUICK, "missing": "estimate"}
    ), {"X": w.U, "y": gappy, "order": 2, "method": "auto", "offset": "auto",
        "initial_state": "estimate", "refine": "auto"}  # fmt: skip
    yield "SubspaceLTI.fit(integrating)", fitting(
        lp.SubspaceLTI, **QUICK, **TABLE_ROLES
    ), {**table, "integrating": True}  # fmt: skip
    runs = lp.SubspaceLTI(**QUICK, **TABLE_ROLES)
    yield "SubspaceLTI.fit_each", clone(runs).fit_each, table
    yield "SubspaceLTI.fit_batches", clone(runs).fit_batches, {"batches": [(w.X, w.y)]}
    yield "SubspaceLTI.set_output", clone(runs).set_output, {"transform": "pandas"}
    yield "SubspaceLTI.partial_fit", streaming, {
        **table, "X_next": w.X.assign(run=w.X["run"] + "b"),
        "y_next": w.y, "order": 2, "horizon": 5, "missing": "raise",
    }  # fmt: skip
    m = w.subspace
    yield "SubspaceLTI.predict", m.predict, {"X": w.X}
    yield "SubspaceLTI.predict_with_initial_state", m.predict_with_initial_state, table
    yield "SubspaceLTI.score", m.score, {**table, "sample_weight": np.ones(len(w.X))}
    yield "SubspaceLTI.predict_ahead", m.predict_ahead, {
        **table, "steps": 2, "initial_state": "estimate",
    }  # fmt: skip
    yield "SubspaceLTI.residual_tests", m.residual_tests, {
        **table, "errors": "simulation", "n_lags": 5, "level": 0.01,
    }  # fmt: skip
    yield "SubspaceLTI.split_experiments", m.split_experiments, {"X": w.X}
    for name in ("frequency_response_std", "frequency_response_covariance"):
        yield f"SubspaceLTI.{name}", getattr(m, name), {"omega": w.omega}


def pipeline_calls(w):
    table = {"X": w.X, "y": w.y}
    yield "LocalLPVPipeline.fit", fitting(
        lp.LocalLPVPipeline, local=w.quick, restructurer="passthrough"
    ), {**table, **ROLES, "inputs": "force", "interpolator": lp.PolynomialLPV(1),
        "refiner": None, "operating_point": None, "scheduling_tol": 0.01,
        "sampling_time": 0.02, "time_tol": 0.01, "combine": "pool",
        "discretization": "zoh", "offsets": None, "efficient": True,
        "on_error": "raise", "verbose": 0, "max_time": 10.0, "memory": None,
        "units": {"kappa": "m"}}  # fmt: skip
    yield "LocalLPVPipeline.fit(parts)", fitting(lp.LocalLPVPipeline, **ROLES), {
        **table, "local": w.quick, "restructurer": "passthrough",
        "interpolator": lp.PolynomialLPV(1),
    }  # fmt: skip
    p = w.pipeline
    yield "LocalLPVPipeline.predict", p.predict, {"X": w.X, "return_std": False}
    yield "LocalLPVPipeline.predict_with_initial_state", (
        p.predict_with_initial_state
    ), table  # fmt: skip
    yield "LocalLPVPipeline.score", p.score, {
        **table, "sample_weight": np.ones(len(w.X)),
    }  # fmt: skip
    if w.parquet.exists():
        yield "LocalLPVPipeline.fit_dataset", clone(p).fit_dataset, {
            "dataset": w.parquet, "outputs": ["position"],
        }  # fmt: skip
    for name in ("split_experiments", "prediction_std"):
        yield f"LocalLPVPipeline.{name}", getattr(p, name), {"X": w.X}
    yield "suggest_operating_point", lp.suggest_operating_point, {
        "pipeline": p, "criterion": "uncertainty",
    }  # fmt: skip
    yield "OutputErrorLPV.fit", fitting(lp.OutputErrorLPV), {
        **table, **TABLE_ROLES, "scheduling": "kappa", "start": w.lpv, "rate": False,
        "prior": None, "initial_state": "rest", "offset": None, "missing": "raise",
        "sampling_time": 0.02, "time_tol": 0.01, "max_iter": 2, "verbose": 0,
        "interpolator": None, "local": None, "units": None,
    }  # fmt: skip
    yield "OutputErrorLPV.predict", w.refined.predict, {"X": w.X, "return_std": False}
    yield "OutputErrorLPV.predict_with_initial_state", (
        w.refined.predict_with_initial_state
    ), table  # fmt: skip
    yield "save", saved_and_loaded, {"model": w.pipeline}
    yield "save(path)", lp.save, {"model": w.slow, "path": tempfile.mktemp(".lpv")}
    yield "load", lp.load, {"path": GOLDEN, "function": None}
    yield "LocalLPVPipeline.to_html_report", lambda **a: html(p, **a), {
        **table, "initial_state": "rest", "title": "T", "units": {"position": "m"},
        "figures": None,
    }  # fmt: skip


def dataset_calls(w):
    yield "prbs", datasets.prbs, {
        "n_samples": 100, "n_channels": 2, "amplitude": 1.0, "clock": 5, "balance": 20,
        "random_state": 0,
    }  # fmt: skip
    numbers = {n: getattr(w.arm, n) for n in datasets.FlexibleArm.__dataclass_fields__}
    yield "FlexibleArm", datasets.FlexibleArm, numbers
    q = np.array([0.1, 0.2])
    yield "FlexibleArm.mass_matrix", w.arm.mass_matrix, {"q": np.tile(q, 2)}
    both = {"q": np.tile(q, 2), "qdot": np.tile(q, 2)}
    yield "FlexibleArm.forces", w.arm.forces, both
    yield "FlexibleArm.rigid_rates", w.arm.rigid_rates, both
    for name in ("linearize", "parameters", "rigid"):
        yield f"FlexibleArm.{name}", getattr(w.arm, name), {"theta2": 0.5}
    yield "FlexibleArm.structure", w.arm.structure, {"form": "rate"}
    yield "FlexibleArm.simulate", w.arm.simulate, {
        "velocity_reference": np.zeros((5, 2)), "theta2": np.full(5, 0.5),
        "sampling_time": 1e-3, "integration_step": 1e-3,
    }  # fmt: skip
    disc = w.disc
    names = datasets.UnbalancedDisc.__dataclass_fields__
    yield (
        "UnbalancedDisc",
        datasets.UnbalancedDisc,
        {n: getattr(disc, n) for n in names},
    )
    yield "UnbalancedDisc.acceleration", disc.acceleration, {
        "theta": q, "rate": q, "u": q,
    }  # fmt: skip
    yield "UnbalancedDisc.holding_voltage", disc.holding_voltage, {"theta": q}
    for name in ("linearize", "parameters"):
        yield f"UnbalancedDisc.{name}", getattr(disc, name), {"theta": 0.5}
    yield "UnbalancedDisc.simulate", disc.simulate, {
        "voltage": np.zeros(5), "theta": 0.5, "sampling_time": 0.01,
        "integration_step": 0.002,
    }  # fmt: skip
    yield "make_flexible_arm", datasets.make_flexible_arm, {
        "n_operating_points": 2, "n_realizations": 1, "snr_db": 30.0, "duration": 0.05,
        "sampling_time": 1e-3, "random_state": 0, "amplitude": 0.1,
        "clock": [0.02, 0.01], "balance_time": 0.02, "integration_step": 1e-3,
        "sweep_duration": 0.05, "sweep_amplitude": 1.0, "sweep_clock": 0.005,
        "arm": w.arm,
    }  # fmt: skip
    yield "make_unbalanced_disc", datasets.make_unbalanced_disc, {
        "n_operating_points": 2, "n_realizations": 1, "snr_db": 30.0, "duration": 0.5,
        "sampling_time": 0.01, "random_state": 0, "reach": 1.3, "amplitude": 0.05,
        "clock": 0.08, "large_duration": 0.5, "disc": disc,
    }  # fmt: skip


def display_calls(w):
    i, Y = inspection, w.Y
    G = w.slow.frequency_response(w.omega)
    labels = {"output_names": ["y"], "input_names": ["u"]}
    yield "BodeDisplay", constructed(i.BodeDisplay), {
        "omega": w.omega, "responses": {"a": G}, "std": {"a": 0.1 * G}, **labels,
        "frequency_label": "f", "units": {"y": "m"},
    }  # fmt: skip
    yield "BodeDisplay.from_models", drawing(i.BodeDisplay.from_models), {
        "models": {"a": w.slow}, "omega": w.omega, **labels, "phase": True,
        "units": {"y": "m"}, "std": None, "ax": None,
    }  # fmt: skip
    yield "BodeDisplay.from_estimator", drawing(i.BodeDisplay.from_estimator), {
        "estimator": w.pipeline, "kappa": 0.5, "others": {"b": w.slow},
        "omega": w.omega, "uncertainty": True, "units": {"y": "m"}, "phase": False,
    }  # fmt: skip
    yield "ErrorDisplay", constructed(i.ErrorDisplay), {
        "omega": w.omega, "error": w.omega, "start": w.omega, "floor": 0.1,
        "active_frequencies": w.omega[:1], "active_values": w.omega[:1],
        "norms": {"a": 1.0}, "frequency_label": "f",
    }  # fmt: skip
    model = w.lpv.at(0.5)
    yield "ErrorDisplay.from_models", drawing(i.ErrorDisplay.from_models), {
        "gray_box": model, "black_box": w.lpv.at(0.6), "omega": w.omega, "floor": 0.1,
        "start": w.lpv.at(0.7), "active_frequencies": w.omega[:1],
    }  # fmt: skip
    yield "ErrorDisplay.from_estimator", drawing(i.ErrorDisplay.from_estimator), {
        "restructurer": w.restructurer, "model": model, "start": None,
        "omega": w.omega, "kappa": None, "ax": None,
    }  # fmt: skip
    line = lp.PolynomialLPV(1).fit(w.kappa, w.theta)
    yield "ParameterDisplay", constructed(i.ParameterDisplay), {
        "kappa": w.kappa, "parameters": {"a": w.theta}, "names": ["k", "c"],
        "std": {"a": 0.1 * w.theta}, "scheduling_label": "x", "units": {"k": "N"},
        "interpolators": {"a": line}, "curve_std": None,
    }  # fmt: skip
    yield "ParameterDisplay.from_parameters", drawing(
        i.ParameterDisplay.from_parameters
    ), {"kappa": w.kappa, "parameters": {"a": w.theta}, "names": ["k", "c"],
        "interpolator": lp.PolynomialLPV(1), "n_columns": 2, "units": {"k": "N"},
        "scheduling_label": "x", "ax": None}  # fmt: skip
    yield "ParameterDisplay.from_estimator", drawing(
        i.ParameterDisplay.from_estimator
    ), {"pipeline": w.pipeline, "names": ["k"], "name": "n", "uncertainty": True,
        "scheduling_label": "s", "n_columns": 2, "others": None, "forms": None,
        "units": {"k": "N"}}  # fmt: skip
    poles = w.lpv.frozen_poles(w.kappa)
    yield "PoleDisplay", constructed(i.PoleDisplay), {
        "kappa": w.kappa, "poles": poles, "local_kappa": w.kappa, "local_poles": poles,
        "scheduling_label": "s",
    }  # fmt: skip
    yield "PoleDisplay.from_model", drawing(i.PoleDisplay.from_model), {
        "model": w.lpv, "kappa": w.kappa, "damping": True, "scheduling_label": "s",
    }  # fmt: skip
    yield "PoleDisplay.from_estimator", drawing(i.PoleDisplay.from_estimator), {
        "pipeline": w.pipeline, "kappa": w.kappa, "damping": False, "units": None,
        "scheduling_label": "s", "ax": None,
    }  # fmt: skip
    yield "ResidualDisplay", constructed(i.ResidualDisplay), {
        "errors": Y, "inputs": w.U, "n_lags": 5, "confidence": 0.9, **labels,
        "what": "w",
    }  # fmt: skip
    yield "ResidualDisplay.from_estimator", drawing(
        i.ResidualDisplay.from_estimator
    ), {"estimator": w.subspace, "X": w.X, "y": w.y, "errors": "simulation",
        "n_lags": 5, "confidence": 0.9}  # fmt: skip
    yield (
        "ResidualDisplay.from_residuals",
        drawing(i.ResidualDisplay.from_residuals),
        {"errors": Y, "inputs": w.U},
    )
    time = 0.1 * np.arange(60)
    yield "SimulationDisplay", constructed(i.SimulationDisplay), {
        "time": time, "y_true": Y, "predictions": {"a": 0.9 * Y}, "units": ["m"],
        "std": {"a": 0.1 + 0 * Y}, "output_names": ["y"], "time_label": "t",
        "true_name": "n",
    }  # fmt: skip
    yield "SimulationDisplay.from_predictions", drawing(
        i.SimulationDisplay.from_predictions
    ), {"time": time, "y_true": Y, "y_pred": 0.9 * Y, "zoom": [1.0, 2.0],
        "output_names": ["y"], "units": "m", "true_name": "n"}  # fmt: skip
    yield "SimulationDisplay.from_estimator", drawing(
        i.SimulationDisplay.from_estimator
    ), {"estimator": w.pipeline, "X": w.X, "y": w.y, "experiment": "p0r0",
        "initial_state": "rest", "name": "n", "units": "m", "uncertainty": False,
        "zoom": [0.0, 1.0]}  # fmt: skip
    values = np.array([3.0, 1.0, 0.1])
    yield "SingularValueDisplay", constructed(i.SingularValueDisplay), {
        "singular_values": values, "order": 2,
    }  # fmt: skip
    yield (
        "SingularValueDisplay.from_values",
        drawing(i.SingularValueDisplay.from_values),
        {"singular_values": values, "order": 2},
    )
    yield (
        "SingularValueDisplay.from_estimator",
        drawing(i.SingularValueDisplay.from_estimator),
        {"subspace": w.subspace, "n_shown": 3},
    )
    yield "UncertaintyDisplay", constructed(i.UncertaintyDisplay), {
        "kappa": w.kappa, "error": w.kappa[:, 0] + 0.1, "grid": w.kappa,
        "std": w.kappa[:, 0] + 0.2, "scheduling_label": "s",
    }  # fmt: skip
    yield "UncertaintyDisplay.from_estimator", drawing(
        i.UncertaintyDisplay.from_estimator
    ), {"pipeline": w.pipeline, "omega": w.omega, "units": {"kappa": "m"}}  # fmt: skip
    plots = {
        i.BodeDisplay.from_models({"a": w.slow}): {"phase": True, "n_std": 2.0},
        i.ErrorDisplay(w.omega, w.omega): {},
        i.ParameterDisplay(w.kappa, {"a": w.theta}): {"n_columns": 2, "n_std": 2.0},
        i.PoleDisplay(w.kappa, poles): {"damping": True},
        i.ResidualDisplay(Y, w.U): {},
        i.SimulationDisplay(time, Y, {"a": 0.9 * Y}): {
            "zoom": [1.0, 2.0], "n_std": 2.0,
        },
        i.SingularValueDisplay(values): {"n_shown": 3},
    }  # fmt: skip
    plt.close("all")
    for display, options in plots.items():
        name = f"{type(display).__name__}.plot"
        yield name, drawing(display.plot), {"ax": None, **options}
    yield "plot_overview", i.plot_overview, {
        "pipeline": w.pipeline, "X": w.X, "y": w.y, "experiment": "p0r0",
        "units": {"position": "m"},
    }  # fmt: skip


# Seconds of a valid call are behind the weights: all groups cost about as much.
GROUPS = (
    (lti_calls, 1.0),
    (structure_calls, 1.0),
    (restructuring_calls, 0.3),
    (lpv_calls, 1.0),
    (data_calls, 1.0),
    (score_calls, 0.7),
    (estimator_calls, 0.7),
    (pipeline_calls, 0.4),
    (dataset_calls, 0.7),
    (display_calls, 0.2),
)
WEIGHTS = {
    "LocalLPVPipeline.to_html_report": 0.0,
    "plot_overview": 0.0,
    "suggest_operating_point": 0.05,
}

# Gains at a pole and errors of unstable models are infinite, missing samples are NaN.
OPEN = {
    "frequency_response": ("infinity",),
    "peak_gains": ("infinity",),
    "start_error": ("infinity",),
    "from_trajectories": ("NaN", "infinity"),
    "resample": ("NaN",),
    "properties": ("infinity in result[3]",),  # of a pole on the border, to rounding
}


@cache
def calls():
    """Every call by its name."""
    return {
        name: Call(
            function,
            arguments,
            WEIGHTS.get(name, weight),
            next((kinds for part, kinds in OPEN.items() if part in name), ()),
        )
        for group, weight in GROUPS
        for name, function, arguments in group(world())
    }


def shares(n_cases):
    """How many of `n_cases` are each call's."""
    total = sum(call.weight for call in calls().values())
    return {
        name: max(1, round(n_cases * call.weight / total)) if call.weight else 0
        for name, call in calls().items()
    }
