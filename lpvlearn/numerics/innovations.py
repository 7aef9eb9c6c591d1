"""Noise model in innovation form from simulation errors.

The simulation error ``v = y - G u`` of an output-error model holds all that past
outputs can still tell about the future. A vector autoregression describes it,
``v[t] = Phi_1 v[t-1] + ... + e[t]``: by the Yule-Walker equations it is always
stable, and its innovation form is exact, with ``A - K C`` nilpotent. Its order follows
from the information criterion of Schwarz; white noise has order 0 and no predictor
beats the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .balancing import balancing_transformation
from .hankel import correlation_sequence

Array = NDArray[np.float64]


class NoiseModel(NamedTuple):
    """``x[t+1] = A x[t] + K e[t]``, ``v[t] = C x[t] + e[t]``.

    Attributes
    ----------
    A : ndarray of shape (n_states, n_states)
    C : ndarray of shape (n_outputs, n_states)
    K : ndarray of shape (n_states, n_outputs)
        Innovation gain; ``A - K C`` is stable.
    covariance : ndarray of shape (n_outputs, n_outputs)
        Of the innovations e.
    """

    A: Array
    C: Array
    K: Array
    covariance: Array


def autoregression(errors: Sequence[Array], order: int | None = None) -> NoiseModel:
    """Vector autoregression of simulation errors, in innovation form.

    Parameters
    ----------
    errors : sequence of ndarray of shape (n_samples_i, n_outputs)
        One per experiment.
    order : int, default=None
        Number of lags; None takes the smallest value of Schwarz's criterion up to
        ``10 log10(n_samples)``.

    Returns
    -------
    NoiseModel

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> e = np.random.default_rng(0).standard_normal((5000, 1))
    >>> model = autoregression([lfilter([1.0], [1.0, -0.9], e, axis=0)])
    >>> model.A.round(2)
    array([[0.9]])
    """
    ny, n_samples = errors[0].shape[1], sum(len(v) for v in errors)
    longest = max(len(v) for v in errors)
    highest = min(int(10.0 * np.log10(n_samples)), (longest - 1) // (2 * ny))
    highest = max(0, highest if order is None else order)
    lags = np.zeros((highest + 1, ny, ny))
    for v in errors:
        known = min(len(v), highest + 1)
        lags[:known] += correlation_sequence(v, known)
    lags /= n_samples
    # Channels of very different size must not spoil the determinants.
    scale = np.sqrt(np.maximum(np.diagonal(lags[0]), 0.0))
    scale[scale == 0.0] = 1.0
    lags = lags / scale[:, None] / scale
    best, found = np.inf, (np.zeros((ny, 0)), lags[0])
    for p in range(highest + 1) if order is None else [highest]:
        coefficients, covariance = yule_walker(lags, p)
        sign, logdet = np.linalg.slogdet(covariance)
        if not sign > 0.0:  # errors without noise
            break
        criterion = logdet + p * ny * ny * np.log(n_samples) / n_samples
        if criterion < best:
            best, found = criterion, (coefficients, covariance)
    coefficients, covariance = found
    p = coefficients.shape[1] // ny
    blocks = coefficients.reshape(ny, p, ny) * scale[:, None, None] / scale
    return _companion(blocks.reshape(ny, p * ny), covariance * np.outer(scale, scale))


def yule_walker(lags: Array, order: int) -> tuple[Array, Array]:
    """Coefficients ``[Phi_1, ..., Phi_p]`` and innovation covariance.

    Parameters
    ----------
    lags : ndarray of shape (> order, n_outputs, n_outputs)
        ``lags[d] = E v[t] v[t + d].T``.
    order : int

    Returns
    -------
    coefficients : ndarray of shape (n_outputs, order * n_outputs)
    covariance : ndarray of shape (n_outputs, n_outputs)
    """
    ny = lags.shape[1]
    if order == 0:
        return np.zeros((ny, 0)), lags[0]
    gram = np.empty((order * ny, order * ny))
    for i in range(order):
        for j in range(order):
            block = lags[i - j] if i >= j else lags[j - i].T
            gram[i * ny : (i + 1) * ny, j * ny : (j + 1) * ny] = block
    right = lags[1 : order + 1].reshape(order * ny, ny)
    solution = linalg.lstsq(gram, right, cond=1e-13, check_finite=False)[0]
    covariance = lags[0] - right.T @ solution
    return solution.T, 0.5 * (covariance + covariance.T)


def _companion(coefficients: Array, covariance: Array) -> NoiseModel:
    ny, n = coefficients.shape
    A = np.eye(n, k=-ny)
    A[: min(n, ny)] = coefficients[: min(n, ny)]
    return NoiseModel(A, coefficients, np.eye(n, ny), covariance)


def reduce_noise_model(model: NoiseModel, order: int) -> NoiseModel:
    """Noise model of fewer states by balanced truncation.

    The gain is computed anew from the Riccati equation, so that the predictor of
    the truncated model is stable.

    Parameters
    ----------
    model : NoiseModel
    order : int

    Returns
    -------
    NoiseModel
        `model` itself when it has no more than `order` states.
    """
    if len(model.A) <= order:
        return model
    ny = len(model.C)
    if order == 0:
        P = linalg.solve_discrete_lyapunov(
            model.A, model.K @ model.covariance @ model.K.T
        )
        spread = model.C @ P @ model.C.T + model.covariance
        return NoiseModel(
            np.zeros((0, 0)), np.zeros((ny, 0)), np.zeros((0, ny)), spread
        )
    root = linalg.cholesky(model.covariance, lower=True)
    _, left, right = balancing_transformation(
        model.A, model.K @ root, model.C, discrete=True
    )
    left, right = left[:order], right[:, :order]
    A, C, K = left @ model.A @ right, model.C @ right, left @ model.K
    Q, S = K @ model.covariance @ K.T, K @ model.covariance
    P = linalg.solve_discrete_are(A.T, C.T, Q, model.covariance, s=S)
    covariance = C @ P @ C.T + model.covariance
    gain = linalg.solve(covariance, (A @ P @ C.T + S).T, assume_a="pos").T
    return NoiseModel(A, C, gain, 0.5 * (covariance + covariance.T))


def spectrum(model: NoiseModel, omega: Array) -> NDArray[np.complex128]:
    """Spectral density of v, ``H covariance H^*`` with ``H = C (zI - A)^-1 K + I``.

    Parameters
    ----------
    model : NoiseModel
    omega : ndarray of shape (n_freq,)
        Radians per sample.

    Returns
    -------
    ndarray of shape (n_freq, n_outputs, n_outputs)
    """
    ny, n = model.C.shape
    H = np.broadcast_to(np.eye(ny, dtype=complex), (len(omega), ny, ny))
    if n:
        poles, vectors = np.linalg.eig(model.A)
        left = linalg.lstsq(vectors, model.K + 0j)[0]
        z = np.exp(1j * omega)
        # A nearly defective A would lose accuracy in modal form.
        if np.linalg.cond(vectors) < 1e8:
            weights = 1.0 / (z[:, None] - poles)
            H = H + np.einsum("oi,fi,ij->foj", model.C @ vectors, weights, left)
        else:
            resolvent = z[:, None, None] * np.eye(n) - model.A
            H = H + model.C @ np.linalg.solve(resolvent, model.K + 0j)
    return H @ model.covariance @ H.conj().transpose(0, 2, 1)
