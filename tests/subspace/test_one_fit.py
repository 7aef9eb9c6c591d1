"""One fit: what is looked at before all orders are tried again."""

import numpy as np
from scipy.signal import lfilter

from lpvlearn import SubspaceLTI
from lpvlearn.subspace.fits.one_fit import Samples
from lpvlearn.subspace.fits.options import check_options
from lpvlearn.subspace.telling import Telling


def test_a_state_less_is_looked_at_beside_constants_before_all_orders_are():
    """It may be that a slow pair stands for a constant and for more."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal((30, 1)), 10, axis=0)
    y = 1.0 + lfilter([0.0, 0.2], [1.0, -1.6, 0.68], u, axis=0)
    y += 0.01 * rng.standard_normal(y.shape)
    samples = Samples([(u, y)], check_options(SubspaceLTI().get_params()), Telling())
    fitted, seen = samples.fit(0), []

    def looked_at(near):
        seen.append((len(near.model.A), near.evidence.free.n_trend))
        return False

    assert not samples.is_worth_a_choice(looked_at, fitted, 1)
    order = len(fitted.model.A)
    assert seen[0] == (order, 1) and seen[-1] == (order - 1, 1)
