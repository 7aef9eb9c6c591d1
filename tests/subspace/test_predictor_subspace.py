"""States of the predictor, and innovation forms: what samples must carry for them."""

import numpy as np
import pytest

from lpvlearn.subspace.closed_loop.predictor_subspace import _riccati_gain

from .conftest import closed_loop, pbsid


@pytest.mark.parametrize(
    "options, message",
    [
        ({"horizon": 30}, "needs more than 62 windows of 30 past samples"),
        ({"order": 6, "horizon": 4}, "`horizon` must be at least 6 for order 6"),
    ],
)
def test_windows_are_refused_with_the_remedy(options, message):
    u, y = closed_loop(np.random.default_rng(0), 60)
    with pytest.raises(ValueError, match=message):
        pbsid(**{"order": 2, **options}).fit(u, y)


def test_states_that_grow_unseen_ask_for_fewer_of_them():
    """Their Riccati equation has no solution, which SciPy says in words of its own."""
    W, E = np.eye(3)[:2], np.eye(3)[2:]
    with pytest.raises(ValueError, match="lower `order` or method='po-moesp'"):
        _riccati_gain(np.diag([2.0, 0.5]), np.array([[0.0, 1.0]]), W, E, 3)
