"""What simulation errors tell about a model: their spectrum, and its covariance.

The errors v of a model that minimises their sum of squares are described by an
autoregression, in innovation form ``v = H e`` with ``H = C (zI - A)^-1 K + I``, which
predicts them as well.

With J the Jacobian of the simulated outputs, the estimate moves by
``inv(J.T J) J.T v`` to first order. Its covariance is the sandwich ``inv(H) S inv(H)``
with ``H = J.T J`` and ``S = J.T cov(v) J``, so that coloured noise and outputs of
different quality are accounted for (Ljung, *System Identification*, 1999, Section 9.4).
J is a fixed combination of the section signals; S is summed over frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from ..models.innovation import NoiseModel
from ..systems.balancing import balancing_transformation
from ..systems.simulation import lti_response
from .hankel import correlation_sequence
from .parameters import block_parts
from .signals import Record, signal_pieces, state_coefficients
from .simulation_fit import Freedom, Point, Realization, jacobian_regression, n_own

Array = NDArray[np.float64]

# Lags that are allowed for by the number of samples: 10 log10(n), a customary limit.
_LAGS_PER_DECADE = 10.0

# Directions of past errors that are their rounding, relative to the largest.
_RCOND_LAGS = 1e-13

# Eigenvectors of a larger condition number would lose half of the spectrum's digits.
_MAX_CONDITION = 1e8

# The weakest direction of the scaled information that is told from rounding.
_RCOND = 1e-15


def noise_of(model: Realization, records: Sequence[Record]) -> NoiseModel:
    """Autoregression of the simulation errors of a model on its records."""
    A, B, C, D = model[:4]
    return autoregression(
        [
            record.y.T - lti_response(A, B, C, D, record.u.T, x0)
            for record, x0 in zip(records, model.initial_states, strict=True)
        ]
    )


def autoregression(errors: Sequence[Array]) -> NoiseModel:
    """Vector autoregression of simulation errors, in innovation form.

    Parameters
    ----------
    errors : sequence of ndarray of shape (n_samples_i, n_outputs)
        One per experiment.

    Returns
    -------
    NoiseModel
        Of the number of lags with the smallest value of Schwarz's criterion, up to
        ``10 log10(n_samples)``.

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
    # Half as many coefficients of an output as the longest experiment has samples.
    allowed = (longest - 1) // (2 * ny)
    highest = max(0, min(int(_LAGS_PER_DECADE * np.log10(n_samples)), allowed))
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
    for p in range(highest + 1):
        coefficients, covariance = _yule_walker(lags, p)
        sign, logdet = np.linalg.slogdet(covariance)
        if not sign > 0.0:  # errors without noise
            break
        criterion = logdet + p * ny * ny * np.log(n_samples) / n_samples
        if criterion < best:
            best, found = criterion, (coefficients, covariance)
    coefficients, covariance = found
    n = coefficients.shape[1]
    blocks = coefficients.reshape(ny, n // ny, ny) * scale[:, None, None] / scale
    C = blocks.reshape(ny, n)
    A = np.eye(n, k=-ny)  # the state holds the last errors
    A[: min(n, ny)] = C[: min(n, ny)]
    return NoiseModel(A, C, np.eye(n, ny), covariance * np.outer(scale, scale))


def _yule_walker(lags: Array, order: int) -> tuple[Array, Array]:
    """Coefficients ``[Phi_1, ..., Phi_p]`` and innovation covariance.

    ``lags[d] = E v[t] v[t + d].T``, of more lags than the order.
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
    solution = linalg.lstsq(gram, right, cond=_RCOND_LAGS, check_finite=False)[0]
    covariance = lags[0] - right.T @ solution
    return solution.T, 0.5 * (covariance + covariance.T)


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


def _spectrum(model: NoiseModel, omega: Array) -> NDArray[np.complex128]:
    """Spectral density of v, ``H covariance H^*``, at radians per sample."""
    ny, n = model.C.shape
    H = np.broadcast_to(np.eye(ny, dtype=complex), (len(omega), ny, ny))
    if n:
        poles, vectors = np.linalg.eig(model.A)
        left = linalg.lstsq(vectors, model.K + 0j)[0]
        z = np.exp(1j * omega)
        # A nearly defective A would lose accuracy in modal form.
        if np.linalg.cond(vectors) < _MAX_CONDITION:
            weights = 1.0 / (z[:, None] - poles)
            H = H + np.einsum("oi,fi,ij->foj", model.C @ vectors, weights, left)
        else:
            resolvent = z[:, None, None] * np.eye(n) - model.A
            H = H + model.C @ np.linalg.solve(resolvent, model.K + 0j)
    return H @ model.covariance @ H.conj().transpose(0, 2, 1)


def parameter_covariance(
    model: Realization, records: Sequence[Record], free: Freedom, noise: NoiseModel
) -> Array:
    """Covariance of B, D, A and C, initial states allowed for.

    Parameters
    ----------
    model : Realization
        In section form, at the minimum of the simulation error.
    records : sequence of Record
        The data it was estimated on.
    free : Freedom
    noise : NoiseModel
        Of the simulation errors.

    Returns
    -------
    ndarray of shape (n_parameters, n_parameters)
        Parameters: B (state-major), free entries of D, A (blocks, row-major), C. Along
        changes of the state basis, which the data do not determine, it is zero.
    """
    assert model.blocks is not None
    information: Array | float = 0.0
    score: Array | float = 0.0
    for record, x0 in zip(records, model.initial_states, strict=True):
        H, S = _experiment_terms(model, record, x0, free, noise)
        own = n_own(len(model.A), free)
        if own:
            # What the initial state can explain tells nothing about the others.
            explain = np.linalg.pinv(H[:own, :own], hermitian=True) @ H[:own, own:]
            keep = np.vstack([-explain, np.eye(len(H) - own)])
            H, S = keep.T @ H @ keep, keep.T @ S @ keep
        information, score = information + H, score + S
    H, S = np.asarray(information), np.asarray(score)
    # Rounding may leave a vanishing diagonal negative.
    scale = np.sqrt(np.maximum(np.diagonal(H), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale)
    n_gauge = sum(block.size for block in model.blocks)
    kept = np.arange(len(values)) >= n_gauge
    kept &= values > _RCOND * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    inverse = inverse / scale[:, None] / scale
    n_values = sum(record.y.size for record in records)
    n_free = int(kept.sum()) + len(records) * n_own(len(model.A), free)
    return inverse @ S @ inverse * (n_values / max(n_values - n_free, 1))


def _experiment_terms(
    model: Realization, record: Record, x0: Array, free: Freedom, noise: NoiseModel
) -> tuple[Array, Array]:
    """``J.T J`` and ``J.T cov(v) J`` of one experiment, initial state first."""
    assert model.blocks is not None
    driven = np.column_stack([x0, model.B])
    state_map = state_coefficients(model.blocks, driven) if len(model.A) else None
    pieces = signal_pieces(model.blocks, record, state_map)
    X = np.hstack([piece.copy() for piece in pieces])
    k, ny = len(X), len(record.y)
    point = Point(model.C, model.D, driven)
    # Of the unit matrix: the Jacobian's coefficients in the signals, output by output.
    maps = jacobian_regression(np.eye(k), model.blocks, point, free)
    maps = maps[:, :-1].reshape(ny, k, -1)
    gram = X @ X.T
    H = sum(L.T @ gram @ L for L in maps)
    if len(noise.A) == 0:
        return np.asarray(H), sum(
            noise.covariance[i, j] * (maps[i].T @ gram @ maps[j])
            for i in range(ny)
            for j in range(ny)
        )
    size = fft.next_fast_len(2 * X.shape[1], real=True)
    transformed = fft.rfft(X, size, axis=1)
    density = _spectrum(noise, 2.0 * np.pi * np.arange(size // 2 + 1) / size)
    weight = np.full(size // 2 + 1, 2.0 / size)  # for the negative frequencies too
    weight[0 if size % 2 else [0, -1]] = 1.0 / size
    S = np.zeros_like(H)
    for i in range(ny):
        for j in range(ny):
            # Sum over t, s of X[:, t] r_ij(t - s) X[:, s].T
            by_frequency = transformed.conj() * (weight * density[:, i, j])
            S += maps[i].T @ (by_frequency @ transformed.T).real @ maps[j]
    return np.asarray(H), S


def frequency_response_jacobian(
    model: Realization, free: Freedom, omega: Array
) -> NDArray[np.complex128]:
    """Derivatives of the frequency response by the parameters.

    Parameters
    ----------
    model : Realization
        In section form.
    free : Freedom
    omega : ndarray of shape (n_freq,)
        Radians per sample.

    Returns
    -------
    ndarray of shape (n_freq, n_outputs, n_inputs, n_parameters)
        Parameters as in `parameter_covariance`.
    """
    assert model.blocks is not None
    (ny, n), m = model.C.shape, model.B.shape[1]
    z = np.exp(1j * np.asarray(omega))
    resolvent = np.linalg.inv(z[:, None, None] * np.eye(n) - model.A)
    # Axes: frequency, output, input, and two that tell the parameters apart.
    to_output = (model.C @ resolvent)[:, :, None, :, None]
    from_input = (resolvent @ model.B).transpose(0, 2, 1)[:, None, :, None, :]
    by_parameter = [to_output * np.eye(m)[:, None, :]]
    by_direct = np.zeros((len(z), ny, m, 1, int(free.direct.sum())))
    i, j = np.nonzero(free.direct)
    by_direct[:, i, j, 0, np.arange(len(i))] = 1.0
    by_parameter.append(by_direct)
    start = 0
    for block in model.blocks:
        rows = slice(start, start + len(block))
        by_parameter.append(to_output[..., rows, :] * from_input[..., rows])
        start = rows.stop
    by_parameter.append(np.eye(ny)[:, None, :, None] * from_input)
    columns = [
        part.reshape(*part.shape[:3], math.prod(part.shape[3:]))
        for part in by_parameter
    ]
    return np.concatenate(columns, axis=-1)


def pole_jacobian(
    model: Realization, n_parameters: int
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Poles and their derivatives by the parameters.

    Parameters
    ----------
    model : Realization
        In section form.
    n_parameters : int

    Returns
    -------
    poles : ndarray of shape (order,)
    jacobian : ndarray of shape (order, n_parameters)
    """
    assert model.blocks is not None
    poles = np.zeros(len(model.A), dtype=complex)
    jacobian = np.zeros((len(model.A), n_parameters), dtype=complex)
    row = 0
    parts = block_parts(model, n_parameters)
    for block, part in zip(model.blocks, parts, strict=True):
        values, right = np.linalg.eig(block)
        for value, left, vector in zip(
            values, np.linalg.pinv(right), right.T, strict=True
        ):
            poles[row], jacobian[row, part] = value, np.outer(left, vector).ravel()
            row += 1
    return poles, jacobian
