"""Files without code: exact, whole or absent, and harmless whoever wrote them."""

import io
import json
import os
import pickle
import re
import textwrap
import tracemalloc
import warnings
import zipfile
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.lib import format as npy
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

import lpvlearn
from lpvlearn import (
    AutoLPV,
    ExperimentSplit,
    GrayBoxRestructurer,
    GrayBoxStructure,
    InnovationModel,
    LocalLPVPipeline,
    LPVStateSpace,
    OutputErrorLPV,
    PolynomialLPV,
    RationalLPV,
    SplineLPV,
    StateSpace,
    SubspaceLTI,
    load,
    save,
)
from lpvlearn.datasets import prbs
from lpvlearn.exceptions import VersionedPickle, VersionWarning, collected
from lpvlearn.models.innovation import NoiseModel
from lpvlearn.pipeline.model_files.files import _TEXT, SCHEMA
from lpvlearn.pipeline.model_files.schema import CLASSES, FORMS, before_saving
from lpvlearn.pipeline.running.memory import fingerprint

from ..conftest import (
    ROLES,
    spring_lpv,
    spring_structure,
    spring_sweep,
    spring_tables,
    stable_model,
)

GOLDEN = Path(__file__).parent / "files"
DOCUMENTATION = Path(__file__).parents[2] / "docs" / "files.rst"


def pendulum(theta):
    length, damping = theta
    return [[0, 1], [-9.81 / length, -damping]], [[0], [1]], [[1, 0]]


def pendulum_jacobian(theta):
    A = np.zeros((2, 2, 2))
    A[0, 1, 0], A[1, 1, 1] = 9.81 / theta[0] ** 2, -1.0
    return A, np.zeros((2, 2, 1)), np.zeros((2, 1, 2))


def there_and_back(model, path, **options):
    save(model, path)
    return load(path, **options)


def assert_same(one, other, place="model"):
    """Equal to the bit: types, dtypes, signs of zeros, memory order."""
    one, other = before_saving(one), before_saving(other)
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype and one.shape == other.shape, place
        if one.dtype != object:
            assert one.tobytes("A") == other.tobytes("A"), place
        else:
            assert one.tolist() == other.tolist(), place
    elif isinstance(one, pd.DataFrame):
        pd.testing.assert_frame_equal(one, other, check_exact=True, obj=place)
    elif type(one) in CLASSES.values():
        assert type(one) is type(other), place
        kept = {n for n, text in FORMS[type(one)].items() if text != "-"}
        names = kept | set(vars(one) if hasattr(one, "__dict__") else ())
        for name in names & set(dir(one)) - set(unkept(one)):
            assert_same(getattr(one, name), getattr(other, name), f"{place}.{name}")
    elif isinstance(one, dict):
        assert list(one) == list(other), place
        for key in one:
            assert_same(one[key], other[key], f"{place}.{key}")
    elif isinstance(one, list | tuple):
        assert type(one) is type(other) and len(one) == len(other), place
        for k, pair in enumerate(zip(one, other, strict=True)):
            assert_same(*pair, f"{place}.{k}")
    elif isinstance(one, float):
        assert np.float64(one).tobytes() == np.float64(other).tobytes(), place
    else:
        assert one == other, place


def unkept(model):
    """Attributes that follow from others, or that files do not keep."""
    derived = {"implicit", "basis", "offset"} if hasattr(model, "map") else set()
    return {"_curve", "_stream", "memory"} | derived


@pytest.fixture(scope="module")
def pipeline():
    X, y = spring_tables(noise=0.01, n_samples=300, kappas=(0.0, 0.7, 1.5))
    restructurer = GrayBoxRestructurer(spring_structure(), n_starts=2)
    local = SubspaceLTI(2, horizon=8)
    return LocalLPVPipeline(local, restructurer, PolynomialLPV(2), **ROLES).fit(X, y)


@pytest.fixture(scope="module")
def fitted():
    X, y = spring_tables(noise=0.05, n_samples=400, kappas=(0.5,))
    roles = {"experiment": "run", "time": "time", "scheduling": "kappa"}
    return SubspaceLTI(2, horizon=8, **roles).fit(X, y), X, y


def lti_models():
    late = stable_model(1, sampling_time=0.1).with_input_delay([0, 3])
    extreme = StateSpace([[-0.0, 5e-324], [1e149, -1.0]], np.ones((2, 1)), [[0.1, 0]])
    gain = StateSpace([], [], [], [[1 / 3, 2.0]], True)
    transposed = StateSpace(np.asfortranarray(late.A), late.B, late.C, late.D)
    return [stable_model(0), late, extreme, gain, transposed]


def structures():
    template = spring_structure()
    flux = GrayBoxStructure.from_template(
        [["-r"]], [[1]], [[1]], E=[["area"]], descriptor="flux"
    )
    beam = {"M": [["m"]], "D": [["c"]], "K": [["k"]], "F": [[1]]}
    moving = GrayBoxStructure.mechanical(**beam, state="momentum")
    named = template.with_bounds({"k": (0, None)}).with_ranges({"c": (0.1, 9)})
    return [
        template,
        named,
        template.fix({"b": 2.0}),
        template.with_stacked_outputs(2),
        GrayBoxStructure.modal(1, n_outputs=2, n_real=1, feedthrough=True),
        GrayBoxStructure.observable_canonical(3, 2, 2),
        GrayBoxStructure.mechanical(**beam, initial={"m": 1, "c": 2, "k": 3}),
        moving,
        moving.fix({"c": 0.5}),
        moving.with_stacked_outputs(2),
        flux,
    ]


@pytest.mark.parametrize("model", lti_models(), ids=str)
def test_state_space_models_come_back_to_the_bit(model, tmp_path):
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    for name in "ABCD":
        assert not getattr(other, name).flags.writeable


@pytest.mark.parametrize("structure", structures(), ids=str)
def test_structures_come_back_to_the_bit(structure, tmp_path):
    other = there_and_back(structure, tmp_path / "structure.zip")
    assert_same(structure, other)
    theta = np.linspace(1.0, 2.0, structure.n_params)
    for name in ("system_matrix", "jacobian", "curvature"):
        assert_same(getattr(structure, name)(theta), getattr(other, name)(theta))


@pytest.mark.parametrize("gain", [None, np.array([[0.1], [0.2]])])
def test_innovation_models_come_back_to_the_bit(gain, tmp_path):
    one = np.ones((1, 1))
    lti = StateSpace(np.diag([0.5, 0.2]), one.repeat(2, 0), [[1.0, 1.0]], None, 1.0)
    model = InnovationModel(lti, NoiseModel(0.9 * one, 0.9 * one, one, one), gain)
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    u, y = np.random.default_rng(0).normal(size=(2, 50, 1))
    assert_same(model.predict(u, y), other.predict(u, y))


def interpolators():
    rng, one = np.random.default_rng(0), np.linspace(0, 1, 6)[:, None]
    two = np.stack(np.meshgrid(one[:4, 0], one[:3, 0]), -1).reshape(-1, 2)
    P = np.tile(1e-4 * np.eye(2), (12, 1, 1))
    for kappa in (one, two):
        theta = np.column_stack([1 + kappa[:, 0], np.exp(kappa[:, -1])])
        theta += 1e-3 * rng.normal(size=theta.shape)
        covariance = P[: len(kappa)]
        yield PolynomialLPV(2, basis="legendre").fit(kappa, theta)
        yield PolynomialLPV(1).fit(pd.DataFrame(kappa).add_prefix("k"), theta[:, 0])
        yield RationalLPV(1, 1).fit(kappa, theta, covariance=covariance)
        yield AutoLPV().fit(kappa, theta, covariance=covariance)
        yield AutoLPV("bic", extrapolation="clip").fit(kappa, theta)
        for kind in ("pchip", "cubic", "linear"):
            yield SplineLPV(kind).fit(kappa, theta)
    yield SplineLPV("cubic", scale="log").fit([[1.0], [2.0], [4.0]], [1.0, 3.0, 2.0])
    yield SplineLPV().fit([[1.0]], [[2.0, 3.0]])
    yield PolynomialLPV(3)


@pytest.mark.parametrize("model", list(interpolators()), ids=str)
def test_interpolators_come_back_to_the_bit(model, tmp_path):
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    if not hasattr(model, "scheduling_range_"):
        return
    kappa = np.random.default_rng(1).uniform(-0.2, 1.2, (40, model.n_features_in_))
    if hasattr(model, "feature_names_in_"):
        kappa = pd.DataFrame(kappa, columns=model.feature_names_in_)
    assert_same(model.predict(kappa), other.predict(kappa))
    assert_same(model.sensitivities(kappa), other.sensitivities(kappa))
    again = model.with_coefficients(model.coefficients() * 1.001).predict(kappa)
    moved = other.with_coefficients(other.coefficients() * 1.001).predict(kappa)
    assert_same(again, moved)


def test_lpv_models_come_back_to_the_bit(tmp_path):
    structure, interpolator = spring_structure(), spring_lpv().interpolator
    limits = np.array([[0.0], [1.5]])
    at_rest = PolynomialLPV(1).fit([[0.0], [1.5]], [[1.0, 2, 3, 4], [2, 3, 4, 5]])
    model = LPVStateSpace(
        structure,
        interpolator,
        limits,
        scheduling_names=["kappa"],
        identified_range=limits + [[-0.1], [0.1]],
        input_delay=0.04,
        offsets=at_rest,
        input_names=("force",),
        output_names=["position"],
    ).change_basis([[1.0, 2.0], [0.0, 1.0]])
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    u, kappa = np.sin(np.arange(300) / 7), 0.75 + 0.7 * np.cos(np.arange(300) / 40)
    for own in (model, spring_lpv()):
        loaded = there_and_back(own, tmp_path / "model.zip")
        assert_same(own.simulate(u, kappa, 0.02), loaded.simulate(u, kappa, 0.02))
    assert_same(model.at(0.3), other.at({"kappa": 0.3}))


@pytest.mark.parametrize("jacobian", [None, pendulum_jacobian])
def test_functions_are_kept_by_name_and_given_by_the_caller(jacobian, tmp_path):
    path = tmp_path / "pendulum.zip"
    guess = {"length": 1.0, "damping": 0.1}
    structure = GrayBoxStructure.from_function(pendulum, guess, jacobian)
    save(structure, path)
    with pytest.raises(ValueError, match=r"`function` must be the function .*pendulum"):
        load(path)
    given = {f"{f.__module__}.{f.__qualname__}": f for f in (pendulum, jacobian) if f}
    for function in (given, *([pendulum] if jacobian is None else [])):
        other = load(path, function=function)
        assert_same(structure, other)
        assert_same(structure.jacobian(np.ones(2)), other.jacobian(np.ones(2)))
    if jacobian is not None:
        with pytest.raises(ValueError, match="pendulum_jacobian"):
            load(path, function={next(iter(given)): pendulum})


def test_bases_that_follow_the_scheduling_variables_are_functions_too(tmp_path):
    model = spring_lpv().change_basis(pendulum_basis)
    other = there_and_back(model, tmp_path / "model.zip", function=pendulum_basis)
    assert_same(model.at(0.3), other.at(0.3))


def test_a_range_of_orders_becomes_their_tuple(tmp_path):
    path = tmp_path / "model.zip"
    save(SubspaceLTI(order=range(2, 7)), path)
    assert load(path).order == (2, 3, 4, 5, 6)
    with pytest.raises(ValueError, match="`model.order` must be something that a file"):
        save(SubspaceLTI(order=range(10**30)), path)


def pendulum_basis(kappa):
    return np.diag([1.0, 1.0 + kappa[0]])


@pytest.mark.parametrize(
    "options",
    [
        {"order": "auto", "inputs": ["force"]},
        {"method": "pbsid", "horizon": 10, "inputs": "force"},
        {"refine": False, "n_noise_states": 2, "inputs": "force"},
        {"offset": "linear", "input_delay": 1, "inputs": "force"},
        {"feedthrough": np.array([[False]]), "inputs": ["force"]},
        {"inputs": ("force", "twice")},
        {"order": (1, 2, 3), "inputs": ["force"]},
    ],
    ids=str,
)
def test_local_models_come_back_to_the_bit(options, fitted, tmp_path):
    model, X, y = fitted
    X = X.assign(twice=2.0 * X["force"])
    with collected():  # of collinear inputs
        model = clone(model).set_params(**options).fit(X, y)
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    for name in ("predict_with_initial_state", "predict_ahead", "score"):
        assert_same(getattr(model, name)(X, y), getattr(other, name)(X, y))
    assert_same(model.predict(X), other.predict(X))
    assert_same(model.predictor_, other.predictor_)
    assert_same(model.deviated_models(), other.deviated_models())
    assert model.selection_text() == other.selection_text()
    if options.get("refine", True):
        omega = np.linspace(0.0, 100.0, 9)
        assert_same(model.poles_std_, other.poles_std_)
        for name in ("frequency_response_std", "frequency_response_covariance"):
            assert_same(getattr(model, name)(omega), getattr(other, name)(omega))
    else:
        with pytest.raises(AttributeError, match="refine"):
            other.poles_std_  # noqa: B018


@pytest.mark.parametrize("at_once", [0.0, 2.0])
def test_models_of_integrating_outputs_come_back_to_the_bit(tmp_path, at_once):
    u = prbs(400, clock=3, random_state=0)
    rate = StateSpace(0.8, 0.2, 1.0, sampling_time=0.1)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((400, 1))
    y = np.cumsum(rate.simulate(u), axis=0) + at_once * u + noise
    model = SubspaceLTI(1, integrating=True, sampling_time=0.1).fit(u, y)
    other = there_and_back(model, tmp_path / "model.zip")
    assert model.lti_.D.any() == bool(at_once)
    assert_same(model, other)
    assert_same(model.predict(u), other.predict(u))
    assert_same(model.deviated_models(), other.deviated_models())
    assert_same(model.rates_.poles_std_, other.rates_.poles_std_)
    with pytest.raises(AttributeError, match="Ask `rates_`"):
        other.poles_std_  # noqa: B018


@pytest.mark.parametrize("method", ["po-moesp", "pbsid"])
def test_models_without_states_come_back_to_the_bit(method, tmp_path):
    u = prbs(300, random_state=0)
    y = 2.0 * u + 0.1 * np.random.default_rng(0).standard_normal(u.shape)
    model = SubspaceLTI(0, method=method).fit(u, y)
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    assert_same(model.predict(u), other.predict(u))


def test_a_fit_that_lacks_what_files_need_is_no_estimator_without_one(fitted, tmp_path):
    model = copy(fitted[0])
    del model.horizon_
    with pytest.raises(ValueError, match=r"Got none of \['horizon_"):
        save(model, tmp_path / "model.zip")


def test_a_loaded_local_model_takes_any_table_for_a_new_one(fitted, tmp_path):
    model, X, y = fitted
    other = there_and_back(model, tmp_path / "model.zip")
    assert (tmp_path / "model.zip").stat().st_size < 25_000  # none of the samples
    found = other.residual_tests(X, y)
    assert list(found.columns) == list(model.residual_tests(X, y).columns)
    new = X[:200], -y[:200]
    assert_same(model.residual_tests(*new), other.residual_tests(*new))
    streamed = other.partial_fit(X, y)
    assert_same(streamed.lti_, SubspaceLTI(**model.get_params()).partial_fit(X, y).lti_)


def test_a_streamed_model_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    u = rng.normal(size=(300, 1))
    y = StateSpace(0.9, 1, 1, sampling_time=1.0).simulate(u)
    y = y + 0.1 * rng.normal(size=y.shape)
    model = SubspaceLTI(1, horizon=5).partial_fit(u[:200], y[:200])
    model = model.partial_fit(u[200:], y[200:])
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    assert_same(model.predict(u), other.predict(u))


def test_restructurers_come_back_to_the_bit(tmp_path):
    model = spring_structure().model([1.0, 0.5, 4.0])
    box = GrayBoxRestructurer(
        spring_structure().with_bounds({"k": (0, None)}),
        init=[1.0, 1.0, 3.0],
        n_starts=1,
        frequency_weight=(None, 50.0),
    ).fit_model(model)
    other = there_and_back(box, tmp_path / "box.zip")
    assert_same(box, other)
    omega = np.geomspace(0.1, 10, 20)
    assert_same(box.predict(omega), other.predict(omega))
    assert str(box.identifiability_) == str(other.identifiability_)
    assert_same(box.perturbation_check(model, 1), other.perturbation_check(model, 1))


def test_pipelines_come_back_to_the_bit(pipeline, tmp_path):
    X, y = spring_tables(noise=0.02, n_samples=200, seed=3)
    other = there_and_back(pipeline, tmp_path / "pipeline.zip")
    assert_same(pipeline, other)
    assert_same(pipeline.predict(X), other.predict(X))
    assert pipeline.score(X, y) == other.score(X, y)
    assert pipeline.summary() == other.summary()
    assert_same(
        lpvlearn.fit_report(pipeline, X, y),
        lpvlearn.fit_report(other, X, y),
    )
    assert_same(
        lpvlearn.suggest_operating_point(pipeline),
        lpvlearn.suggest_operating_point(other),
    )


@pytest.fixture(scope="module")
def refined():
    """A pipeline with a refiner, rate terms, and inputs and outputs off zero."""
    X, y = spring_tables(noise=0.01, n_samples=200, kappas=(0.0, 0.7, 1.5))
    moving = [part.iloc[:300] for part in spring_sweep()]
    X, y = (pd.concat(p, ignore_index=True) for p in zip((X, y), moving, strict=True))
    return LocalLPVPipeline(
        SubspaceLTI(2, horizon=8, offset="constant"),
        GrayBoxRestructurer(spring_structure(), n_starts=2),
        PolynomialLPV(2),
        refiner=OutputErrorLPV(rate=True, initial_state="rest"),
        **ROLES,
    ).fit(X, y + 3.0)


def test_refined_models_come_back_to_the_bit(refined, tmp_path):
    X, y = (part.iloc[:150] for part in spring_sweep(seed=3))
    assert refined.lpv_.rate_terms is not None and refined.lpv_.offsets is not None
    other = there_and_back(refined, tmp_path / "model.zip")
    assert_same(refined, other)
    assert_same(refined.predict(X), other.predict(X))
    assert_same(refined.refiner_.report_, other.refiner_.report_)
    assert refined.summary() == other.summary()
    alone = OutputErrorLPV(spring_lpv(), rate=False, **ROLES).fit(X, y)
    again = there_and_back(alone, tmp_path / "model.zip")
    assert_same(alone, again)
    assert_same(alone.predict(X), again.predict(X))
    assert alone.score(X, y) == again.score(X, y)


def test_names_of_scheduling_variables_do_no_harm(tmp_path):
    """An interpolator that knows names, in a model that gives it arrays."""
    table = pd.DataFrame({"kappa": [0.0, 1.5]})
    named = PolynomialLPV(1).fit(table, [[30, 1.2, 40], [30, 1.2, 100]])
    model = LPVStateSpace(spring_structure(), named, [[0.0], [1.5]])
    assert_same(model, there_and_back(model, tmp_path / "model.zip"))


def test_names_may_be_tuples(tmp_path):
    names = {"input_names": [("in", "force")], "output_names": [("out", 1)]}
    model = replace(spring_lpv(), scheduling_names=[("set", "kappa")], **names)
    assert_same(model, there_and_back(model, tmp_path / "model.zip"))


def test_what_is_saved_again_is_the_same_file(pipeline, fitted, tmp_path):
    first, second = tmp_path / "first.zip", tmp_path / "second.zip"
    for model in (pipeline, fitted[0]):
        save(model, first)
        save(load(first), second)
        assert first.read_bytes() == second.read_bytes()


def test_several_scheduling_variables_and_no_structure(tmp_path):
    X, y = spring_tables(n_samples=200, kappas=(0.0, 0.7, 1.5))
    X["other"] = 2.0 - X["kappa"] ** 2
    roles = ROLES | {"scheduling": ["kappa", "other"]}
    local = SubspaceLTI(2, horizon=8)
    model = LocalLPVPipeline(local, interpolator=SplineLPV("linear"), **roles)
    model.fit(X, y["position"])
    other = there_and_back(model, tmp_path / "model.zip")
    assert_same(model, other)
    assert_same(model.predict(X), other.predict(X))


def test_memory_is_not_kept(tmp_path):
    pipeline = LocalLPVPipeline(memory=str(tmp_path))
    assert there_and_back(pipeline, tmp_path / "pipeline.zip").memory is None


def test_every_class_has_a_form_of_all_it_needs(pipeline, refined, fitted):
    """A private attribute that is not told of would be lost."""
    models = [pipeline, refined, refined.refiner_, fitted[0], *interpolators()]
    models += pipeline.restructurers_
    for model in models:
        told = {*FORMS[type(model)], "_single_output", *model.get_params(deep=False)}
        private = {name for name in vars(model) if name.startswith("_")}
        assert private - told <= {"_curve"}, type(model)


def test_what_load_would_refuse_is_not_written(tmp_path):
    nodes = np.random.default_rng(0).normal(size=(3001, 2))
    large = SplineLPV("linear").fit(nodes, nodes)
    with pytest.raises(ValueError, match="`model` must be one that `load` can"):
        save(large, tmp_path / "model.zip")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "model, got",
    [
        (LinearRegression(), "LinearRegression"),
        (3.0, "3.0"),
        (None, "None"),
        ([StateSpace(-1, 1, 1)], "StateSpace"),
    ],
)
def test_what_is_no_model_is_refused(model, got, tmp_path):
    with pytest.raises(ValueError, match=f"`model` must be a StateSpace.*{got}"):
        save(model, tmp_path / "model.zip")
    assert list(tmp_path.iterdir()) == []


def test_parts_without_a_form_are_refused_by_name(tmp_path):
    class Mine(PolynomialLPV):
        pass

    strangers = {
        "interpolator": LocalLPVPipeline(interpolator=LinearRegression()),
        "random_state": GrayBoxRestructurer(random_state=np.random.RandomState(0)),
        "interpolator ": LPVStateSpace(
            spring_structure(), Mine(0).fit([[0.0]], [[1.0, 2, 3]]), [[0.0], [1.0]]
        ),
    }
    for name, model in strangers.items():
        with pytest.raises(
            ValueError, match=f"`model.{name.strip()}` must be .*pickle"
        ):
            save(model, tmp_path / "model.zip")


# -- whole or absent -------------------------------------------------------------------


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_the_old_file_stays_whole_where_writing_fails(step, tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    save(StateSpace(-1, 1, 1), path)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, step, full)
        with pytest.raises(OSError, match="No space left"):
            save(stable_model(0), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["model.zip"]


def test_a_link_still_points_to_the_file(tmp_path):
    real, link = tmp_path / "real.zip", tmp_path / "link.zip"
    save(StateSpace(-1, 1, 1), real)
    link.symlink_to(real)
    save(StateSpace(-2, 1, 1), str(link))
    assert link.is_symlink() and load(real).A == -2


def test_a_folder_that_is_not_there_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="`path` .*none.*Make the folder"):
        save(StateSpace(-1, 1, 1), tmp_path / "none" / "model.zip")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.zip")


def test_names_of_other_programs_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must not end in '.mat'.*to_mat\(\)"):
        save(StateSpace(-1, 1, 1), tmp_path / "model.mat")


def test_what_is_no_regular_file_stays_as_it_is(tmp_path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    for place in (pipe, link, tmp_path):
        for use in (partial(save, StateSpace(-1, 1, 1)), load):
            with pytest.raises(ValueError, match="`path` must name a file"):
                use(place)
    assert pipe.is_fifo() and link.is_symlink()
    assert {*os.listdir(tmp_path)} == {"pipe", "link"}


# -- the format ------------------------------------------------------------------------


def read_parts(path):
    """Text and arrays of a file, as a program without this library reads them."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(parts.pop(_TEXT)), parts


def write_parts(path, text, parts, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        archive.writestr(_TEXT, text if isinstance(text, str) else json.dumps(text))
        for name, content in parts.items():
            archive.writestr(name, content)


def test_the_format_is_read_without_this_library(tmp_path):
    path = tmp_path / "model.zip"
    save(stable_model(1, sampling_time=0.1), path)
    text, parts = read_parts(path)
    model = text["model"]
    assert text["format"] == "lpvlearn" and text["schema"] == SCHEMA
    assert text["lpvlearn"] == lpvlearn.__version__
    assert model["class"] == "StateSpace" and model["sampling_time"] == 0.1
    A = np.load(io.BytesIO(parts[model["A"]["array"]]), allow_pickle=False)
    assert_same(A, stable_model(1, sampling_time=0.1).A)


def write_golden(name, model, X):
    """Once for every schema; what is there is never written again."""
    save(model, GOLDEN / f"{name}_schema_{SCHEMA}.zip")
    expected = {"X": X.to_dict("list"), "y": model.predict(X).tolist()}
    (GOLDEN / f"{name}_schema_{SCHEMA}.json").write_text(json.dumps(expected))


def schema_text():
    """The fields of all classes, as the documentation has them."""
    lines = []
    for kind, fields in FORMS.items():
        lines += ["", kind.__name__]
        width = 2 + max(map(len, fields))
        kept = {name.lstrip("_"): text for name, text in fields.items() if text != "-"}
        lines += [f"  {name:{width}}{text}" for name, text in kept.items()]
    return "\n".join(f"    {line}".rstrip() for line in lines[1:])


def test_the_documentation_has_every_field():
    assert schema_text() in DOCUMENTATION.read_text()


def test_the_program_of_the_documentation_reads_a_file(tmp_path, monkeypatch):
    program = re.search(r"Python::\n\n((?:    .*\n|\n)+)", DOCUMENTATION.read_text())[1]
    monkeypatch.chdir(tmp_path)
    save(stable_model(0), "model.zip")
    found = {}
    exec(textwrap.dedent(program), found)
    assert_same(found["A"], np.array(stable_model(0).A))


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.zip")), ids=lambda p: p.stem)
def test_files_of_old_versions_stay_readable(path):
    model = load(path)
    expected = json.loads(path.with_suffix(".json").read_text())
    X = pd.DataFrame(expected["X"])
    np.testing.assert_allclose(model.predict(X), expected["y"], rtol=1e-9, atol=1e-12)


def test_there_is_an_old_file_of_every_schema():
    found = {read_parts(path)[0]["schema"] for path in GOLDEN.glob("*.zip")}
    assert found == set(range(1, SCHEMA + 1))


def test_a_later_schema_asks_for_a_later_version(tmp_path):
    path = tmp_path / "model.zip"
    save(StateSpace(-1, 1, 1), path)
    text, parts = read_parts(path)
    write_parts(path, text | {"schema": SCHEMA + 1, "lpvlearn": "9.9"}, parts)
    with pytest.raises(ValueError, match=r"lpvlearn 9\.9: update"):
        load(path)


# -- harmless whoever wrote it ---------------------------------------------------------


class _Trap:
    def __reduce__(self):
        return os.mkdir, ("trapped",)


def npy_bytes(array, **options):
    file = io.BytesIO()
    npy.write_array(file, np.asarray(array), **options)
    return file.getvalue()


def hostile_files(path):
    """Text and members of files that no `save` wrote, by what is wrong with them."""
    save(StateSpace([[-1.0, 0], [0, -2]], [[1.0], [1]], [[1.0, 1]]), path)
    text, parts = read_parts(path)
    model = text["model"]
    eye = {"array": "A.npy"}

    def with_model(**fields):
        return text | {"model": model | fields}, parts

    def with_A(content):
        return text, parts | {"A.npy": content}

    header = b"\x93NUMPY\x01\x00"
    huge = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999, 99999), }"
    code = b"{'descr': __import__('os').mkdir('trapped'), 'shape': (2, 2), }"
    yield "pickle", *with_A(npy_bytes(np.array([_Trap()], object), allow_pickle=True))
    yield "declared", *with_A(header + len(huge).to_bytes(2, "little") + huge)
    yield "code", *with_A(header + len(code).to_bytes(2, "little") + code)
    yield "record", *with_A(npy_bytes(np.zeros(4, dtype="i4,f8")))
    yield "short", *with_A(parts["A.npy"][:-8])
    yield "nan", *with_A(npy_bytes(np.full((2, 2), np.nan)))
    yield "shape", *with_A(npy_bytes(np.eye(3)))
    yield "class", *with_model(**{"class": "Popen"})
    yield "inner", *with_model(**{"class": "NoiseModel"})
    yield "builtin", *with_model(**{"class": "__import__"})
    yield "missing", *with_model(A={"array": "../../etc/passwd"})
    yield "twice", *with_model(B=eye)
    yield "object", *with_model(A=model)
    yield "function", *with_model(A={"function": "os.system"})
    yield "field", *with_model(simulate=3)
    yield "dunder", *with_model(__class__="x")
    yield "string", *with_model(A="1")
    yield "negative", *with_model(sampling_time=-1)
    yield "whole", *with_model(sampling_time=10**400)
    yield "table", *with_model(sampling_time={"table": [], "index": 10**15})
    yield "nested", json.dumps(text)[:-2] + ', "x": ' + "[" * 10**5, parts
    yield "brackets", "[" * 10**6 + "]" * 10**6, parts
    yield "wide", '{"format": [' + "[]," * (10**6) + "[]]}", parts
    yield "pairs", '{"format": {"dict": [' + "[1,[]]," * 10**6 + "[1]]}}", parts
    yield "digits", '{"format": ' + "9" * 10**6 + "}", parts
    yield "NaN", '{"format": NaN}', parts
    yield "list", [], parts
    yield "null", "null", parts
    yield "utf", "\ud800", parts
    yield "format", {"format": "other"}, parts
    yield "schema", text | {"schema": 0}, parts
    yield "truth", text | {"schema": True}, parts
    yield "unused", text, parts | {"more.npy": parts["A.npy"]}


def test_hostile_files_end_in_a_clear_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "model.zip"
    for name, text, parts in hostile_files(path):
        try:
            write_parts(path, text, parts)
        except UnicodeEncodeError:
            write_parts(path, "{}", parts)
            path.write_bytes(path.read_bytes().replace(b"{}", b"\xff\xfe", 1))
        with pytest.raises(ValueError, match="`path`|`function`"):
            load(path)
        assert peak_of_loading(path) < 4 * path.stat().st_size + 100e6, name
        assert not (tmp_path / "trapped").exists(), name


def test_memory_is_a_few_times_that_of_the_file(tmp_path):
    """Of a large model; of the smallest texts and lists of members by far the most."""
    path = tmp_path / "model.zip"
    save(
        StateSpace(np.zeros((1500, 1500)), np.ones((1500, 1)), np.ones((1, 1500))), path
    )
    big = path.stat().st_size
    assert peak_of_loading(path) < 4 * big + 1e6
    with zipfile.ZipFile(path, "w") as archive:
        for k in range(6000):  # a tenth of what is looked at
            archive.writestr(zipfile.ZipInfo(f"{k:x}"), b"")
    assert peak_of_loading(path) < 4 * path.stat().st_size + 10e6


def peak_of_loading(path):
    """Bytes that a file takes at most until it is loaded or refused."""
    tracemalloc.start()
    try:
        load(path)
    except ValueError:
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_a_bomb_is_refused_unopened(tmp_path):
    path = tmp_path / "model.zip"
    save(StateSpace(-1, 1, 1), path)
    text, parts = read_parts(path)
    bomb = {"A.npy": bytes(10**8)}
    write_parts(path, text, parts | bomb, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match="compressed"):
        load(path)
    assert peak_of_loading(path) < 10e6


def test_members_that_share_their_bytes_are_refused(tmp_path):
    """The bomb without compression: every entry of the list names one large member."""
    path = tmp_path / "model.zip"
    write_parts(
        path, "{}", {f"{k:03d}": bytes(10**6 if not k else 0) for k in range(99)}
    )
    data = bytearray(path.read_bytes())
    entries = [k for k in range(len(data)) if data[k : k + 4] == b"PK\1\2"]
    large = next(k for k in entries if data[k + 46 : k + 49] == b"000")
    for k in entries:
        data[k + 16 : k + 28] = data[large + 16 : large + 28]
        data[k + 42 : k + 46] = data[large + 42 : large + 46]
    path.write_bytes(data)
    with pytest.raises(ValueError, match="larger than the file"):
        load(path)


@pytest.mark.parametrize("content", [b"", b"PK\3\4", b"\x80\x04.", b"a" * 1000])
def test_what_is_no_zip_is_refused(content, tmp_path):
    path = tmp_path / "model.zip"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"`path` must be a whole file .*model\.zip"):
        load(path)


def values_in(node):
    """Places of a text: the list or object, and the key in it."""
    pairs = enumerate(node) if isinstance(node, list) else node.items()
    for key, value in pairs:
        yield node, key
        if isinstance(value, list | dict):
            yield from values_in(value)


def mutated(rng, data, text, parts):
    """Bytes of a file that is damaged or forged at random."""
    kind = rng.integers(4)
    if kind == 0:  # bits turned
        data = bytearray(data)
        for k in rng.integers(len(data), size=rng.integers(1, 5)):
            data[k] ^= 1 << rng.integers(8)
        return bytes(data)
    if kind == 1:
        return data[: rng.integers(len(data))]
    text, parts = json.loads(text), dict(parts)
    if kind == 2:  # another text
        places = list(values_in(text))
        strange = [None, True, -1, 10**18, 1e308, "", "x", [], {}, [[]], {"tuple": []}]
        strange += [{"float": "nan"}, {"labels": ["a"]}, {"dict": [["a", 1]]}]
        strange += [{"table": [], "index": 3}, {"class": rng.choice(list(CLASSES))}]
        strange += [{"function": "os.system"}, {"array": "A.npy"}]
        for _ in range(rng.integers(1, 4)):
            node, key = places[rng.integers(len(places))]
            other, place = places[rng.integers(len(places))]
            try:
                match rng.integers(3):
                    case 0:
                        node[key] = strange[rng.integers(len(strange))]
                    case 1:
                        node[key] = json.loads(json.dumps(other[place]))
                    case 2:
                        del node[key]
            except (KeyError, IndexError):  # it went with what it stood in
                continue
        written = json.dumps(text)
        parts = {name: content for name, content in parts.items() if name in written}
    elif parts:  # another array, with the right checksum
        name = rng.choice(list(parts))
        shape = rng.integers(0, 4, size=rng.integers(4))
        other = rng.normal(size=shape) * 10.0 ** rng.integers(-300, 300)
        content = bytearray(parts[name] if rng.integers(2) else npy_bytes(other))
        content[rng.integers(len(content))] ^= 1 << rng.integers(8)
        parts[name] = bytes(content)
    file = io.BytesIO()
    write_parts(file, text, parts)
    return file.getvalue()


def fuzz(n_cases, models, tmp_path):
    """Load damaged files: how many ended in an error, and in another model."""
    path, rng, counts = tmp_path / "model.zip", np.random.default_rng(0), [0, 0]
    originals = []
    for model in models:
        save(model, path)
        text, parts = read_parts(path)
        originals.append((path.read_bytes(), json.dumps(text), parts))
    for case in range(n_cases):
        path.write_bytes(mutated(rng, *originals[case % len(originals)]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                load(path, function=pendulum if case % 2 else None)
            except ValueError as error:
                assert str(error).startswith(("`path` must be", "`function` must be"))
                counts[0] += 1
            else:
                counts[1] += 1
    return counts


def fuzzed_models(pipeline, fitted):
    lti = stable_model(1, sampling_time=0.1)
    return [lti, *structures(), spring_lpv(), *interpolators(), fitted[0], pipeline]


def test_damaged_files_load_or_tell(pipeline, fitted, tmp_path):
    refused, loaded = fuzz(1000, fuzzed_models(pipeline, fitted), tmp_path)
    assert refused > loaded > 0


@pytest.mark.slow
def test_many_damaged_files_load_or_tell(pipeline, fitted, tmp_path):
    fuzz(10_000, fuzzed_models(pipeline, fitted), tmp_path)


# -- versions --------------------------------------------------------------------------


def test_pickles_of_another_version_warn(fitted, monkeypatch):
    lti, lpv = stable_model(1, sampling_time=0.1), spring_lpv()
    one = np.ones((1, 1))
    noise = NoiseModel(0.9 * one, 0.9 * one, one, one)
    for model in (
        fitted[0],
        PolynomialLPV(),
        GrayBoxRestructurer(),
        LocalLPVPipeline(),
        ExperimentSplit(),
        lti,
        InnovationModel(StateSpace(0.5, 1, 1, sampling_time=1.0), noise),
        lpv,
        lpv.coefficients(),
        lpv.lfr(),
        lpv.structure,
    ):
        content = pickle.dumps(model)
        other = pickle.loads(content)
        assert vars(other).keys() == vars(model).keys()
        assert fingerprint(other) == fingerprint(model)
        with monkeypatch.context() as patch:
            patch.setattr(lpvlearn, "__version__", "99.0")
            with collected() as told:
                pickle.loads(content)
        text = f"A pickled {type(model).__name__} was written by lpvlearn "
        assert any(one.message.startswith(text) for one in told)
        assert {one.category for one in told} == {VersionWarning}
    public = (getattr(lpvlearn, name) for name in lpvlearn.__all__)
    classes = (c for c in public if isinstance(c, type))
    assert all(issubclass(c, VersionedPickle) for c in classes)


def test_options_are_lists_of_complex_numbers_and_labels_of_pandas(tmp_path):
    path = tmp_path / "model.zip"
    save(GrayBoxRestructurer(known_poles=[2j, -2j]), path)
    np.testing.assert_array_equal(load(path).known_poles, [2j, -2j])
    save(SubspaceLTI(inputs=pd.Index(["u", "v"])), path)
    assert load(path).inputs == ["u", "v"]
