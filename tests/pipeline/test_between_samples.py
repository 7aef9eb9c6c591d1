"""Inputs that are held between samples, and inputs that are smooth."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

from lpvlearn import (
    GrayBoxRestructurer,
    GrayBoxStructure,
    LocalLPVPipeline,
    StateSpace,
    SubspaceLTI,
    from_trajectories,
    load,
    save,
)
from lpvlearn.pipeline.one_basis.between_samples import _meets_more
from lpvlearn.pipeline.points.local_models import LocalModel, as_ramps

DT = 0.05

SPRING = GrayBoxStructure.from_template(
    A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]]
)
TRUE = np.array([[3.0, 1.5, 40.0 + 20.0 * kappa] for kappa in (0.0, 0.5, 1.0)])


def waves(rng, t):
    """Of random phases, up to 12 samples a period; t counts samples."""
    f = np.linspace(0.02, 1 / 12, 25)
    return np.cos(2 * np.pi * f * t[:, None] + rng.uniform(0, 6.3, 25)).sum(1)[:, None]


def filtered(rng, t):
    """Noise through a filter at 0.15 of the Nyquist frequency."""
    b, a = signal.butter(2, 0.15)
    return 3 * signal.lfilter(b, a, rng.standard_normal(len(t) + 200))[200:, None]


def table(
    hold,
    structure=SPRING,
    theta=TRUE,
    *,
    noise=0.02,
    runs=1,
    n_samples=300,
    delay=0,
    inputs=waves,
):
    """Three points, with inputs that are held, ramps, or smooth between samples."""
    rng, found = np.random.default_rng(0), []
    for kappa, row in zip((0.0, 0.5, 1.0), theta, strict=True):
        model, fine = structure.model(row), 1 if hold in ("zoh", "foh") else 20
        u = inputs(rng, np.arange(n_samples * fine) / fine)
        sampled = model.to_discrete(DT / fine, hold if fine == 1 else "foh")
        late = sampled.with_input_delay(delay * fine)
        u, y = u[::fine], late.simulate(u)[::fine]
        for _ in range(runs):
            error = noise * y.std(0) * rng.standard_normal(y.shape)
            found.append((u, kappa, y + error))
    return from_trajectories(found, sampling_time=DT)


def pipeline(structure=SPRING, **options):
    return LocalLPVPipeline(
        restructurer=GrayBoxRestructurer(structure),
        scheduling="kappa",
        experiment="experiment",
        time="time",
        **options,
    )


def off(model):
    """Largest error of the parameters, relative."""
    return np.abs(model.parameters_.to_numpy() / TRUE - 1).max()


def test_ramps_are_found_and_make_no_delay(tmp_path):
    X, y = table("foh")
    model = pipeline().fit(X, y)
    assert model.lpv_.hold == "foh" and off(model) < 0.01
    assert 100 * model.score(X, y) > 97.5
    assert (model.report_["lpv_BFT"] > 97.5).all()
    assert (model.report_["p_value"] > 1e-3).all()
    assert "at 0.05 s, inputs linear between them, " in model.summary()
    save(model, tmp_path / "model.zip")
    again = load(tmp_path / "model.zip")
    assert again.lpv_.hold == "foh"
    np.testing.assert_array_equal(again.predict(X), model.predict(X))


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1, 3])
def test_ramps_after_a_delay_are_found(delay):
    """Held inputs that are as late have their first answer a sample later."""
    X, y = table("foh", delay=delay, inputs=filtered, n_samples=500)
    local = SubspaceLTI(input_delay="auto")
    model = pipeline(local=local).fit(X, y)
    assert model.lpv_.hold == "foh" and off(model) < 0.01
    np.testing.assert_array_equal(model.input_delay_, [delay])


def test_ramps_end_a_delay_that_held_inputs_seem_to_have():
    """Sampled, both models are the same: of inputs with delays and without."""
    model = StateSpace(
        -np.eye(2), np.eye(2), [[1.0, 2.0], [3.0, 1.0]], [[0, 1], [0, 0]]
    )
    held = LocalModel(model.with_input_delay([2 * DT, 0.0]), 2, None)
    found = as_ramps(held, [], DT).lti
    np.testing.assert_allclose(found.input_delay, [3 * DT, 0.0])
    omega = np.linspace(0.1, 3.0, 20) / DT
    np.testing.assert_allclose(
        found.to_discrete(DT, "foh").frequency_response(omega),
        held.lti.to_discrete(DT).frequency_response(omega),
        rtol=1e-10,
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the structure")
def test_smooth_inputs_are_nearly_ramps():
    """As held ones they make parameters wrong by three times as much and more."""
    X, y = table("smooth")
    model = pipeline().fit(X, y)
    held = pipeline(discretization="zoh").fit(X, y)
    assert model.lpv_.hold == "foh" and off(model) < 0.01
    assert held.lpv_.hold == "zoh" and off(held) > 0.03


@pytest.mark.slow
@pytest.mark.parametrize("combine", ["pool", "average"])
def test_several_realizations_tell_it_too(combine):
    X, y = table("foh", runs=3, noise=0.05)
    model = pipeline(combine=combine).fit(X, y)
    assert model.lpv_.hold == "foh" and off(model) < 0.015
    given = pipeline(combine=combine, discretization="foh").fit(X, y)
    np.testing.assert_allclose(given.parameters_, model.parameters_, rtol=1e-5)


@pytest.mark.slow
def test_ramps_without_noise_are_found():
    X, y = table("foh", noise=0.0)
    model = pipeline().fit(X, y)
    assert model.lpv_.hold == "foh" and off(model) < 1e-4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The response is hardly known")
@pytest.mark.parametrize("discretization", ["auto", "foh"])
def test_states_that_noise_has_do_not_lead_astray_beyond_the_nyquist_frequency(
    discretization,
):
    X, y = table("foh")
    local = SubspaceLTI(order=4)
    model = pipeline(local=local, discretization=discretization).fit(X, y)
    assert model.lpv_.hold == "foh" and off(model) < 0.02


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_lead_is_no_ramp_where_inputs_are_seen_to_stay():
    """Outputs that are read half a sample after the inputs look like that."""
    rng, found = np.random.default_rng(0), []
    for kappa, row in zip((0.0, 0.5, 1.0), TRUE, strict=True):
        u = rng.choice([-1.0, 1.0], 100).repeat(3)[:, None]
        A, B = (SPRING.matrices(row)[k] for k in (0, 1))
        y = StateSpace(A, B, [[1.0, DT / 2]]).simulate(u, sampling_time=DT)
        found.append((u, kappa, y + 0.02 * y.std() * rng.standard_normal(y.shape)))
    X, y = from_trajectories(found, sampling_time=DT)
    model = pipeline().fit(X, y)
    assert model.lpv_.hold == "zoh"
    assert (model.report_["chi2"] > 30).all()


def test_most_points_decide():
    """One whose structure lacks something does not speak for the others."""
    fits = [SimpleNamespace(chi2_=c, degrees_of_freedom_=2) for c in (1, 2, 1, 5e4)]
    other = [SimpleNamespace(chi2_=900.0, degrees_of_freedom_=2)] * 4
    held, ramps = (SimpleNamespace(restructurers=own) for own in (fits, other))
    assert not _meets_more(ramps, held)
    better = SimpleNamespace(restructurers=[*fits[:3], other[0]])
    worse = SimpleNamespace(restructurers=[*other[:3], fits[3]])
    assert _meets_more(better, worse) and not _meets_more(worse, better)


@pytest.mark.slow
def test_held_inputs_stay_held():
    X, y = table("zoh")
    model = pipeline().fit(X, y)
    assert model.lpv_.hold == "zoh" and off(model) < 0.01
    assert off(pipeline(discretization="zoh").fit(X, y)) == off(model)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.slow
@pytest.mark.parametrize("lag", [3.0, 30.0])
def test_what_a_structure_lacks_is_no_ramp(lag):
    """A lag before the spring, of which the structure knows nothing."""
    plant = GrayBoxStructure.from_template(
        A=[[0, 1, 0], ["-k", "-c", "b"], [0, 0, -lag]],
        B=[[0], [0], [lag]],
        C=[[1, 0, 0]],
    )
    X, y = table("zoh", plant)
    assert pipeline().fit(X, y).lpv_.hold == "zoh"
