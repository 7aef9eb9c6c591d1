"""How records begin."""

import numpy as np
import pytest

from lpvlearn.systems.beginnings import (
    Beginning,
    begin_held,
    first_inputs,
    held_state,
    standing,
    stands,
)


def test_measured_inputs_stand_still_but_for_their_noise():
    u = np.repeat([[20.0], [40.0]], 10, axis=0)
    noise = 0.1 * np.random.default_rng(0).standard_normal(u.shape)
    assert standing(u + noise) == 10
    np.testing.assert_allclose(first_inputs(u + noise), [20.0], atol=0.1)
    assert standing(u + 10.0 * noise) == 0
    np.testing.assert_array_equal(first_inputs(u[8:] + 0.0), [20.0])


@pytest.mark.parametrize("u", [np.zeros((0, 1)), np.ones((20, 2)), np.eye(20)[:, :1]])
def test_inputs_that_never_move_or_at_once_do_not_stand_still(u):
    assert standing(u) == 0


def test_records_that_begin_at_a_stand():
    u = np.repeat([[20.0], [40.0]], 10, axis=0)
    y = np.repeat([[5.0], [9.0]], 10, axis=0)
    y += 0.1 * np.random.default_rng(0).standard_normal(y.shape)
    found = stands([(u, y), (u[::-1], y[::-1])])
    assert found.seen
    np.testing.assert_array_equal(found.first, [[20.0], [40.0]])
    assert not stands([(u, y), (u[8:], y[8:])]).seen  # two samples show nothing
    assert stands([(u, y), (u, y + np.linspace(0.0, 9.0, 20)[:, None])]) is None
    moving = np.random.default_rng(1).standard_normal(u.shape)
    assert stands([(u, y), (moving, y)]) is None
    unknown = np.where(y > 8.9, np.nan, y)
    assert stands([(u, unknown)]).seen


@pytest.mark.parametrize("discrete", [False, True])
def test_held_states_stay(discrete):
    A = np.array([[0.5, 0.2], [-0.1, 0.3]])
    B, u = np.array([[1.0, 0.0], [0.5, 2.0]]), np.array([3.0, -1.0])
    x = held_state(A, B, u, discrete=discrete)
    np.testing.assert_allclose(A @ x + B @ u, x if discrete else 0.0, atol=1e-12)


def test_integrators_are_held_nowhere():
    assert held_state(np.eye(1), np.ones((1, 1)), np.ones(1), discrete=True) is None


def test_of_two_beginnings_the_nearer_is_taken():
    """By all records together; not where either is as good, or none is known."""
    held, moving = np.array([20.0]), np.linspace(25.0, 20.0, 8)[:, None]
    still, none = np.full((8, 1), 20.0), np.zeros((0, 1))

    def nearer(*outputs, rest=moving, mean=moving, held=held):
        return begin_held(
            Beginning(y, rest[: len(y)], mean[: len(y)], held) for y in outputs
        )

    assert nearer(still, none) and nearer(still, rest=still)
    assert not nearer(moving)
    assert nearer(still, moving)  # of which the latter tells nothing
    assert not nearer(still, rest=still, mean=still)
    assert not nearer(still, held=np.array([np.inf]))
    assert not nearer(np.full_like(still, np.nan))
    assert not nearer()
    noise = 5.0 * np.random.default_rng(0).standard_normal((8, 1))
    assert nearer(*9 * [still + noise])
    assert not nearer(*9 * [moving + noise])
    others = 3 * [Beginning(still, moving, moving, held)]
    poor = Beginning(still, still, moving, held + 2.0)  # by a gain that is poorly known
    assert not begin_held([poor]) and begin_held([*others, poor])


def test_a_gain_that_takes_the_beginning_elsewhere_is_not_trusted():
    """That of a mode which hardly decays: nearer than the mean is not near."""
    still = np.full((8, 1), 3.5)
    far = Beginning(still, still, still - 900.0, np.array([-180.0]))
    assert not begin_held([far])
    assert begin_held([far._replace(held=np.array([3.5 + 1e-6]))])


def test_the_first_of_many_steps_does_not_tell_where_a_record_began():
    """Random steps from mid-motion are near to where they lead by chance."""
    u = np.tile([[1.0], [-1.0]], (15, 1)).repeat(20, axis=0)
    gain, rest = np.eye(1), (np.zeros(1), np.zeros(1))

    def told(u):
        one = Beginning.of((u, u), rest, gain, lambda v: 0.0 * v, about_mean=False)
        return begin_held([one])

    assert not told(u)
    assert told(u[:120])
    assert told(np.vstack([np.ones((200, 1)), u]))
