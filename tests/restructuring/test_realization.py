"""Models realised from frequency responses."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from sklearn.exceptions import ConvergenceWarning

from lpvlearn import GrayBoxRestructurer, GrayBoxStructure, StateSpace
from lpvlearn.restructuring.realization import realize_response, stable_realization

from ..conftest import stable_model


def realized(omega, G, order):
    target = realize_response(omega, G, order)
    assert target is not None and target.dt is None
    return StateSpace(target.A, target.B, target.C, target.D)


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 10**6),
    order=st.integers(1, 5),
    n_inputs=st.integers(1, 3),
    n_outputs=st.integers(1, 3),
    scale=st.floats(-4, 4).map(lambda e: 10.0**e),
)
def test_a_response_without_noise_gives_its_model(
    seed, order, n_inputs, n_outputs, scale
):
    model = stable_model(seed, order, n_inputs, n_outputs, feedthrough=True)
    model = StateSpace(scale * model.A, scale * model.B, model.C, model.D)
    omega = scale * np.logspace(-1, 1.3, 25)
    G = model.frequency_response(omega)
    found = realized(omega, G, order)
    # between the data points too; poles only where they show in the response
    between = scale * np.concatenate([[0.0], np.logspace(-1, 1.3, 60)])
    error = np.abs(
        found.frequency_response(between) - model.frequency_response(between)
    )
    assert error.max() <= 1e-4 * np.abs(G).max()
    assert np.abs(found.frequency_response(omega) - G).max() <= 1e-6 * np.abs(G).max()


def test_poles_are_recovered():
    model = StateSpace(
        [[0, 1, 0], [-9, -0.2, 0], [0, 0, -2]], [[0], [1], [1]], [[1, 0, 1]]
    )
    omega = np.linspace(0.0, 8.0, 30)
    found = realized(omega, model.frequency_response(omega), 3)
    assert_allclose(found.poles(), model.poles(), atol=1e-9)
    assert_allclose(found.D, 0, atol=1e-9)


def test_unstable_models_are_realised_too():
    model = StateSpace(np.diag([1.0, -2.0]), [[1], [1]], [[1, 1]])
    omega = np.linspace(0.1, 8.0, 20)
    found = realized(omega, model.frequency_response(omega), 2)
    assert_allclose(found.poles(), [1, -2], atol=1e-9)


def test_few_points_give_no_model():
    model = stable_model(0, 4, 1, 1, feedthrough=True)
    for count, enough in ((2, False), (5, False), (6, True)):
        omega = np.linspace(0.5, 5, count)
        found = realize_response(omega, model.frequency_response(omega), 4)
        assert (found is not None) == enough


def test_order_zero_gives_no_model():
    omega = np.linspace(0.5, 5, 8)
    assert realize_response(omega, np.ones((8, 1, 1), complex), 0) is None


@pytest.mark.parametrize("seed", range(6))
def test_a_noisy_response_is_realised_by_a_stable_model(seed):
    rng = np.random.default_rng(seed)
    model = stable_model(seed, 4, 2, 2)
    omega = np.geomspace(0.05, 20.0, 50)
    G = model.frequency_response(omega)
    noise = 0.2 * np.abs(G).max() * (rng.normal(size=(2, *G.shape)))
    found = stable_realization(omega, G + noise[0] + 1j * noise[1], 8)
    assert found is None or np.linalg.eigvals(found.A).real.max() < 0
    exact, plain = (f(omega, G, 4) for f in (stable_realization, realize_response))
    np.testing.assert_array_equal(exact.A, plain.A)


def test_reflected_poles_meet_the_response_as_well_as_they_can():
    """All-pass: behind a zero of its own, the reflected pole has nothing left to do."""
    omega = np.linspace(0.1, 10.0, 40)
    G = (1 / (1j * omega - 2) + 3 / (1j * omega + 5))[:, None, None]
    found = stable_realization(omega, G, 2)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(found.A).real), [-5, -2])
    X = np.stack([1 / (1j * omega + 2), 1 / (1j * omega + 5), 1 + 0j * omega], 1)
    rows = np.vstack([X.real, X.imag])
    y = np.concatenate([G.real, G.imag])[:, 0, 0]
    least = np.linalg.norm(y - rows @ np.linalg.lstsq(rows, y, rcond=None)[0])
    s = 1j * omega[:, None, None]
    own = found.C @ np.linalg.solve(s * np.eye(2) - found.A, found.B + 0j) + found.D
    assert np.isclose(np.linalg.norm(own - G), least, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the response determines")
@pytest.mark.parametrize("seed", range(5))
def test_orders_beyond_the_systems_and_noise_raise_nothing(seed):
    rng = np.random.default_rng(seed)
    box = stable_model(seed, 2, 1, 1)
    omega = np.geomspace(0.05, 20.0, 40)
    G = box.frequency_response(omega)
    noise = 0.1 * (seed % 2) * np.abs(G).max() * rng.normal(size=(2, *G.shape))
    fitted = GrayBoxRestructurer(GrayBoxStructure.modal(2), n_starts=2, max_iter=60)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted.fit(omega, G + noise[0] + 1j * noise[1])
    assert fitted.lti_.is_stable
