import pickle
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lpvlearn import StateSpace, SubspaceLTI, load, save
from lpvlearn.subspace.alternatives.oscillations import _are_of_inputs
from lpvlearn.subspace.samples.records import Record

_TURN = 1.2341  # radians per sample


def _turning(modulus, angle):
    c, s = modulus * np.cos(angle), modulus * np.sin(angle)
    return np.array([[c, s], [-s, c]])


def _plant():
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = _turning(0.97, 0.1), _turning(0.95, 0.5)
    B, C = [[0.0], [1.0], [0.0], [0.6]], [[0.1, 0.0, 0.3, 0.0]]
    return StateSpace(A, B, C, None, 1.0)


def _wave(rng, n_samples, turn=_TURN):
    return np.sin(turn * np.arange(n_samples) + rng.uniform(0.0, 6.0))[:, None]


def _records(seed, size, lengths=(800,), turns=(_TURN,)):
    """Records of white inputs with noise of 2 %, and waves of a size by the outputs."""
    rng, inputs, outputs = np.random.default_rng(seed), [], []
    for n in lengths:
        u, plant = rng.standard_normal((n, 1)), _plant()
        y, noise = plant.simulate(u), 0.02 * rng.standard_normal((n, 1))
        wave = sum(_wave(rng, n, turn) for turn in turns)
        inputs.append(u)
        outputs.append(y + y.std() * (size * wave + noise))
    return inputs, outputs


def _fit(u, y, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI(**options).fit(u, y)
    told = [str(w.message) for w in caught]
    return model, [text for text in told if "oscillate" in text]


def _error(model, plant=None):
    omega = np.linspace(0.01, 3.1, 100)
    truth = (plant or _plant()).frequency_response(omega)
    left = model.lti_.frequency_response(omega) - truth
    return np.linalg.norm(left) / np.linalg.norm(truth)


@pytest.mark.broad
@pytest.mark.parametrize("size", [0.05, 0.3, 3.0])
def test_the_plant_is_that_of_records_without_the_oscillation(size):
    (u,), (y,) = _records(0, size)
    (_,), (calm,) = _records(0, 0.0)
    model, told = _fit(u, y)
    assert model.lti_.order == 4
    assert len(told) == 1
    assert f"{_TURN:.4g}" in told[0]
    assert _error(model) < 1.1 * _error(_fit(u, calm)[0]) + 2e-4
    # of a given order two states were spent on it, or its errors were for it
    of_given = _fit(u, y, order=4)[0]
    assert _error(of_given) < 1.1 * _error(model) + 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("kind, seed", [("shifts", 0), ("shifts", 1), ("hum", 3)])
def test_what_is_taken_out_is_no_delay(kind, seed):
    """Beside it inputs seemed to arrive late."""
    rng = np.random.default_rng(seed)
    A, B = [[0, 1.0, 0], [-9, -1.2, 0], [22.5, 0, -2.5]], [[0], [1], [0]]
    u = np.repeat(rng.choice([-1.0, 1.0], (125, 1)), 8, axis=0)
    y = StateSpace(A, B, [[0, 0, 2]]).to_discrete(0.05).simulate(u)
    y += 0.03 * rng.standard_normal(y.shape)
    if kind == "shifts":
        y += np.repeat(rng.standard_normal((4, 1)), 250, axis=0)
    else:
        y += 0.5 * np.sin(2.9 * np.arange(1000))[:, None]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = SubspaceLTI().fit(u, y)
    assert model.order_ == 3
    assert len(caught) == 1  # of the shifts, or of the hum


def test_a_model_that_is_to_oscillate_does():
    (u,), (y,) = _records(0, 0.3)
    model, told = _fit(u, y, order=6)
    assert not told
    assert np.abs(np.angle(model.lti_.poles()) - _TURN).min() < 1e-3


@pytest.mark.slow
def test_experiments_have_phases_of_their_own_and_harmonics():
    inputs, outputs = _records(2, 0.3, (300, 500, 400), (0.31, 0.62, 0.93))
    rows = np.cumsum([0, 300, 500, 400])
    group = np.repeat([0.0, 1.0, 2.0], np.diff(rows))[:, None]
    u = np.hstack([np.vstack(inputs), group])
    model, told = _fit(u, np.vstack(outputs), experiment=1)
    assert model.lti_.order == 4
    assert len(told) == 1
    assert all(turn in told[0] for turn in ("0.31", "0.62", "0.93"))
    assert _error(model) < 0.01


def test_predictions_foretell_it():
    (u, v), (y, z) = _records(3, 0.3, (800, 600))
    model, _ = _fit(u, y)
    size = z.std()
    for steps in (1, 20):
        ahead = z - model.predict_ahead(v, z, steps)
        assert ahead.std() < 0.022 * size  # noise: 2 %, the wave: 20 %
    from_rest = z - model.predict_ahead(v, z, 1, initial_state="rest")
    assert from_rest[500:].std() < 0.03 * size  # found meanwhile
    assert (z - model.predict(v)).std() > 0.15 * size
    tests = model.residual_tests(v, z, errors="prediction")
    assert tests["p_value"].min() > 1e-3


def test_models_of_it_are_written_and_read(tmp_path):
    (u,), (y,) = _records(3, 0.3)
    model, _ = _fit(u, y)
    save(model, tmp_path / "model.zip")
    for other in (load(tmp_path / "model.zip"), pickle.loads(pickle.dumps(model))):
        ahead = other.predict_ahead(u, y, 3)
        assert_array_equal(ahead, model.predict_ahead(u, y, 3))


def test_a_mode_that_inputs_move_is_the_plants():
    rng = np.random.default_rng(4)
    u, noise = rng.standard_normal((600, 1)), rng.standard_normal((600, 1))
    plant = StateSpace(_turning(1.0, 0.3), [[0.02], [0.0]], [[1.0, 0.0]], None, 1.0)
    y = plant.simulate(u, initial_state=[1.0, 0.0]) + 0.002 * noise
    model, told = _fit(u, y)
    assert not told
    assert model.lti_.order == 2
    assert _error(model, plant) < 0.01


def test_a_periodic_input_makes_no_resonance_of_it():
    rng, k = np.random.default_rng(2), np.arange(999)
    lines = 2.0 * np.pi * np.arange(1, 80, 2) / 333.0
    u = np.cos(np.outer(k, lines) + rng.uniform(0.0, 6.0, len(lines))).sum(axis=1)
    y = _plant().simulate(u[:, None])
    y += y.std() * (0.2 * _wave(rng, 999, 2.7) + 0.02 * rng.standard_normal((999, 1)))
    model, _ = _fit(u[:, None], y)
    assert model.lti_.order == 4
    assert _error(model) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 7])
def test_the_clock_of_inputs_is_no_hum(seed):
    """Drag of a vehicle answers every step of the thrust with a pulse of its own."""
    rng, speeds, (speed, force) = np.random.default_rng(seed), [], (1.4, 0.0)
    thrust = 2.0 + 1.5 * np.repeat(rng.choice([-1.0, 1.0], 151), 10)[:1500]
    for u in thrust:
        speeds.append(speed + 1e-3 * rng.standard_normal())
        for _ in range(10):
            speed += 0.01 * (force - speed * abs(speed))
            force += 0.06 * (u * abs(u) / 2.0 - force)
    _, (told,) = _fit(thrust[:, None], speeds)
    assert "1.257" in told and "Inputs step every 10 samples" in told


@pytest.mark.parametrize("gain", [0.0, 2.0])
def test_it_may_be_all_that_moves(gain):
    rng = np.random.default_rng(5)
    u = rng.standard_normal((500, 1))
    noise = 0.02 * rng.standard_normal((500, 1))
    model, told = _fit(u, gain * u + _wave(rng, 500) + noise)
    assert told
    assert model.lti_.order == 0
    assert_allclose(model.lti_.D, gain, atol=0.01)


@pytest.mark.slow
def test_pieces_between_lost_rows_are_short():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (600, 1)), 5, axis=0)
    y, k = _plant().simulate(u), np.arange(3000)
    y += y.std() * (0.3 * _wave(rng, 3000, 0.3) + 0.02 * rng.standard_normal(y.shape))
    kept = rng.random(3000) > 0.01
    X = np.hstack([u, k[:, None].astype(float)])[kept]
    model, told = _fit(X, y[kept], time=1, missing="split")
    assert told
    assert model.lti_.order == 4
    assert _error(model) < 0.01


def test_long_records_keep_the_heads_of_it():
    (u,), (y,) = _records(6, 0.3, (31_000,))
    model, told = _fit(u, y, order=4)
    assert told
    ahead = y[:500] - model.predict_ahead(u[:500], y[:500], 1)
    assert ahead.std() < 0.022 * y.std()


@pytest.mark.slow
@pytest.mark.parametrize("order", ["auto", 2])
def test_ring_downs_are_the_plants(order):
    """Many short ones, in which a weak input hardly moves the mode."""
    rng, inputs, outputs = np.random.default_rng(1), [], []
    plant = StateSpace(_turning(0.99, 0.8), [[0.0], [1.0]], [[1.0, 0.0]], None, 1.0)
    for k in range(20):
        u, x0 = 0.025 * rng.choice([-1.0, 1.0], (60, 1)), 2.0 * rng.standard_normal(2)
        y = plant.simulate(u, initial_state=x0) + 0.2 * rng.standard_normal((60, 1))
        inputs.append(np.hstack([u, np.full((60, 1), k)]))
        outputs.append(y)
    model, told = _fit(np.vstack(inputs), np.vstack(outputs), experiment=1, order=order)
    assert not told
    assert _error(model, plant) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("lines, seed", [((5, 60), 0), ((5, 60), 1), ((3, 7, 31), 0)])
def test_modes_of_few_lines_give_way_to_those_that_decay(lines, seed):
    """A plant with play at its output, moved at a few frequencies, on other phases."""

    def simulated(rng):
        time, phases = np.arange(1000), rng.uniform(0.0, 6.0, (len(lines), 1))
        angles = 2e-3 * np.pi * np.outer(lines, time) + phases
        u = np.cos(angles).sum(axis=0)[:, None]
        A, B = [[1.6, -0.8], [1.0, 0.0]], [[1.0], [0.0]]
        y = StateSpace(A, B, [[0.1, 0.1]], None, 1.0).simulate(u)[:, 0]
        place, places = y[0], []
        for value in y:
            place = min(max(place, value - 0.2), value + 0.2)
            places.append(place)
        return u, np.array(places)[:, None]

    rng = np.random.default_rng(seed)
    u, y = simulated(rng)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = SubspaceLTI().fit(u, y)
    u, y = simulated(rng)
    error = (y - model.lti_.simulate(u))[200:]
    assert np.linalg.norm(error) < 0.15 * np.linalg.norm(y)


def test_outputs_answer_at_lines_of_a_periodic_input():
    """The fundamental of a pulse train was taken for a disturbance."""
    rng, time = np.random.default_rng(0), np.arange(750)
    pulses = (time % 31 == 0).astype(float)
    fundamental, hum = 2.0 * np.pi / 31.0, 0.9
    turns = np.array([fundamental, 3.0 * fundamental, hum])
    for u, are in ((pulses, [True, True, False]), (rng.normal(size=750), [False] * 3)):
        found = _are_of_inputs(turns, [Record.of(u[:, None], np.zeros((750, 1)))])
        assert found.tolist() == are
