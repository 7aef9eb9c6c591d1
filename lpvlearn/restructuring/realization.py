"""A model near a measured response: what similarity transformations start from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..systems.response import resolvent
from ..systems.sampling import d2c_tustin
from .error_system import Target, laplace_variable

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Least decay of a realised pole, relative to its size and to the highest frequency
_LEAST_DAMPING, _LEAST_RATE = 1e-4, 1e-9


def realize_response(omega: Array, G: Complex, order: int) -> Target | None:
    """Continuous-time model near a response, or None where the data are too few.

    Exact where `G` (k, n_outputs, n_inputs) is the response of a model of that order at
    the distinct frequencies `omega` (rad/s); not necessarily stable.

    References
    ----------
    .. [1] T. McKelvey, H. Akcay, L. Ljung, "Subspace-based multivariable system
       identification from frequency response data", IEEE Transactions on Automatic
       Control 41, 1996.

    Examples
    --------
    >>> omega = np.linspace(0.5, 10.0, 12)
    >>> model = realize_response(omega, (1 / (1j * omega + 2))[:, None, None], order=1)
    >>> float(model.A[0, 0].round(9))
    -2.0
    """
    k, p, m = G.shape
    rows = order + 1 + order // 2  # of blocks: half as many again as are needed
    if order < 1 or 2 * k * m < rows * m + order or rows * p <= order:
        return None
    # on the unit circle, by the bilinear map whose quarter turn is in the middle
    positive = omega[omega > 0]
    centre = float(np.sqrt(positive.min()) * np.sqrt(positive.max()))
    z = (centre + 1j * omega) / (centre - 1j * omega)
    # what the inputs leave of [G; z G; z^2 G; ...] spans the observability matrix
    powers = z ** np.arange(rows)[:, None]
    outputs = np.einsum("ik,kpm->ipkm", powers, G).reshape(rows * p, k * m)
    inputs = np.einsum("ik,ab->iakb", powers, np.eye(m)).reshape(rows * m, k * m)
    stacked = np.vstack([inputs, outputs])
    data = np.hstack([stacked.real, stacked.imag]).T
    R = np.asarray(np.linalg.qr(data, mode="r"))
    remainder = R[rows * m :, rows * m :].T
    U = np.linalg.svd(remainder)[0]
    observability = U[:, :order]
    C = observability[:p]
    A = np.linalg.lstsq(observability[:-p], observability[p:], rcond=None)[0]
    try:
        model = _with_poles(z, G, A, C)
        return Target(*d2c_tustin(model.A, model.B, C, model.D, 2.0 / centre))
    except ValueError:  # a pole on a data point or at infinity
        return None


def stable_realization(omega: Array, G: Complex, order: int) -> Target | None:
    """Stable model near a response, as `realize_response` finds it where it is one.

    Else with unstable poles reflected, and B and D fitted to the response anew, as in
    vector fitting: noise, or an order that the system does not have, puts poles of a
    realisation to the right. Of a lower order where the data are too few, and lags of
    the middle frequency where there is none; None for order 0 alone.
    """
    s = laplace_variable(omega, None)[0]
    for n in range(order, 0, -1):
        model = realize_response(omega, G, n)
        if model is None:
            continue
        poles, V = np.linalg.eig(model.A)
        least = _LEAST_DAMPING * np.abs(poles) + _LEAST_RATE * float(omega.max())
        if (poles.real <= -least).all():
            return model
        decay = np.maximum(np.abs(poles.real), least)
        try:
            A = np.real((V * (1j * poles.imag - decay)) @ np.linalg.inv(V))
        except np.linalg.LinAlgError:  # poles that coincide
            continue
        if (np.linalg.eigvals(A).real < 0).all():
            return _with_poles(s, G, A, model.C)
    if order == 0:
        return None
    p, positive = G.shape[1], omega[omega > 0]
    rate = float(np.sqrt(positive.min()) * np.sqrt(positive.max()))
    return _with_poles(s, G, -rate * np.eye(p), np.eye(p))


def _with_poles(z: Complex, G: Complex, A: Array, C: Array) -> Target:
    """The model with that A and C, whose B and D meet a response at z best."""
    (k, p, m), n = G.shape, len(A)
    X = resolvent(A, z)
    left = np.concatenate([C @ X, np.broadcast_to(np.eye(p), (k, p, p))], axis=2)
    flat, rhs = left.reshape(k * p, n + p), G.reshape(k * p, m)
    rows, target = np.vstack([flat.real, flat.imag]), np.vstack([rhs.real, rhs.imag])
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > 0, size, 1.0)
    BD = np.linalg.lstsq(rows / size, target, rcond=None)[0] / size[:, None]
    return Target(A, BD[:n], C, BD[n:])
