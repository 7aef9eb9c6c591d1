"""Innovations of a linear system, and what drives it as its noise does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]


class Innovations(NamedTuple):
    """What a Kalman filter makes of them."""

    gain: Array  # (n, n_outputs): ``A - K C`` is stable
    covariance: Array  # (n_outputs, n_outputs)


def innovations(A: Array, C: Array, Q: Array, S: Array, R: Array) -> Innovations:
    """Gain of the Kalman filter, and covariance of the innovations.

    Of ``x[t+1] = A x[t] + w[t]``, ``y[t] = C x[t] + e[t]`` with ``E w w.T = Q``,
    ``E w e.T = S`` and ``E e e.T = R``.

    >>> one = np.ones((1, 1))
    >>> innovations(0.5 * one, one, 0.25 * one, 0.5 * one, one).gain
    array([[0.5]])
    """
    P = linalg.solve_discrete_are(A.T, C.T, Q, R, s=S)
    covariance = C @ P @ C.T + R
    gain = linalg.solve(covariance, (A @ P @ C.T + S).T, assume_a="pos").T
    return Innovations(gain, covariance)
