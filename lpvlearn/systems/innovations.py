"""Innovations of a linear system, and what drives it as its noise does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]


class KalmanFilter(NamedTuple):
    """What predicts the outputs of a system best."""

    gain: Array  # (n, n_outputs), K: ``A - K C`` is stable
    covariance: Array  # (n_outputs, n_outputs), of the innovations


def kalman_filter(A: Array, C: Array, Q: Array, S: Array, R: Array) -> KalmanFilter:
    """That of ``x[t+1] = A x[t] + w[t]``, ``y[t] = C x[t] + e[t]``.

    The noise has ``E w w.T = Q``, ``E w e.T = S`` and ``E e e.T = R``.

    >>> one = np.ones((1, 1))
    >>> kalman_filter(0.5 * one, one, 0.25 * one, 0.5 * one, one).gain
    array([[0.5]])
    """
    P = linalg.solve_discrete_are(A.T, C.T, Q, R, s=S)
    covariance = C @ P @ C.T + R
    factor = linalg.cho_factor(covariance)  # `solve` tells users how poor it is
    gain = linalg.cho_solve(factor, (A @ P @ C.T + S).T).T
    return KalmanFilter(gain, covariance)


def covariance_root(covariance: Array, negligible: float = 0.0) -> Array:
    """Square L with ``L L.T`` the covariance.

    A column stands for a direction of the channels, these scaled to variance one. It is
    zero where the variance along it is no more than a `negligible` share of the
    largest.

    >>> L = covariance_root(np.array([[4.0, 6.0], [6.0, 9.0]]), 1e-12)
    >>> (L @ L.T).round(3), L.any(axis=0)
    (array([[4., 6.],
           [6., 9.]]), array([False,  True]))
    """
    size = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    kept = values > negligible * values.max(initial=0.0)
    return size[:, None] * vectors * np.sqrt(np.where(kept, values, 0.0))
