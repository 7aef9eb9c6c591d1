"""The predictor: least errors of prediction, and how its parts move."""

import numpy as np
from numpy.testing import assert_allclose

from lpvlearn.subspace.closed_loop.predictor import Changes, Innovation
from lpvlearn.systems.simulation import lti_response

from ..conftest import modes
from .conftest import closed_loop, markov, pbsid


def test_the_predictor_has_the_least_prediction_error():
    u, y = closed_loop(np.random.default_rng(5), 800)
    model = pbsid(2, feedthrough=False).fit(u, y)
    raw = pbsid(2, feedthrough=False, refine=False).fit(u, y)
    assert model.residual_ < raw.residual_ < 1.02 * model.residual_


def test_a_record_in_other_words():
    """The innovation form: x[t+1] = A x + B u + K e, from e and u."""
    u, y = closed_loop(np.random.default_rng(0), 500, pole=0.9)
    model = pbsid(feedthrough=False).fit(u, y)
    P = model.predictor_
    x0 = P.estimate_initial_state(u, y)
    e = y - P.predict(u, y, initial_state=x0)
    driven = np.hstack([u, e])
    B, D = np.hstack([P.B, P.K]), np.hstack([P.D, np.eye(1)])
    assert_allclose(lti_response(P.A, B, P.C, D, driven, x0), y, atol=1e-8)


def test_a_part_changes_as_its_response_does():
    """First-order changes of a part against its modes of the changed model."""
    rng = np.random.default_rng(0)
    A = modes(0.9 * np.exp(0.5j), 0.7, -0.4)
    B, C = rng.standard_normal((4, 2)), rng.standard_normal((2, 4))
    D, K = np.zeros((2, 2)), np.zeros((4, 2))
    model, part = Innovation(A, B, C, D, K, np.eye(2)), np.array([1, 1, 0, 1]) > 0

    def response(A, B, C, of):
        """Of the modes whose poles are near those of the part."""
        poles, T = np.linalg.eig(A)
        near = np.abs(poles[:, None] - np.linalg.eigvals(of)).min(axis=1) < 0.05
        assert near.sum() == 3
        left = np.linalg.inv(T)[near] @ B
        return [C @ T[:, near] @ np.diag(poles[near] ** k) @ left for k in range(8)]

    step = [1e-5 * rng.standard_normal((1, *M.shape)) for M in model[:4]]
    change = Changes(*step).of_part(model, part)
    own = A[part][:, part], B[part], C[:, part]
    moved = [M + d[0] for M, d in zip(own, change, strict=False)]
    expected = response(
        *(M + d[0] for M, d in zip((A, B, C), step, strict=False)), own[0]
    )
    found = markov(*moved, D, n=8)[1:]
    assert_allclose(found, np.real(expected), atol=1e-8)
