"""What displays find in fitted estimators, and in what wraps these."""

import numpy as np
import pytest
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lpvlearn import StateSpace, SubspaceLTI
from lpvlearn.inspection import BodeDisplay, ResidualDisplay, SingularValueDisplay
from lpvlearn.inspection.fitted import models_of

pytest.importorskip("matplotlib")


def test_displays_look_into_chains():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((200, 1))
    plant = StateSpace(0.5, 1.0, 1.0, None, 1.0)
    y = plant.simulate(u)[:, 0] + 0.01 * rng.standard_normal(200)
    chain = make_pipeline(StandardScaler(), SubspaceLTI(1, sampling_time=1.0))
    chain.fit(u, y)
    assert models_of(chain) == {"SubspaceLTI": chain[-1].lti_}
    BodeDisplay.from_estimator(chain)
    SingularValueDisplay.from_estimator(chain)
    scaled = chain[:-1].transform(u)
    one, other = (
        ResidualDisplay.from_estimator(model, table, y)
        for model, table in ((chain, u), (chain[-1], scaled))
    )
    np.testing.assert_array_equal(one.autocorrelations, other.autocorrelations)
