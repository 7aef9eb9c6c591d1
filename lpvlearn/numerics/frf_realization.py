"""A state-space model from a measured frequency response.

The bilinear map ``z = (c + s) / (c - s)`` sends the imaginary axis to the unit circle,
where the response satisfies ``[G; z G; ...] = O X + Gamma [I; z I; ...]``: projecting
out the inputs leaves the range of the extended observability matrix O.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .sampling import d2c_tustin
from .transfer import Target

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def realize_response(omega: Array, G: Complex, order: int) -> Target | None:
    """Model of the given order near a response, or None where the data are too few.

    Parameters
    ----------
    omega : ndarray of shape (k,)
        Distinct angular frequencies, rad/s, not negative and not only zero.
    G : ndarray of shape (k, n_outputs, n_inputs)
    order : int

    Returns
    -------
    Target or None
        A continuous-time model: exact where `G` is the response of a model of that
        order. Not necessarily stable.

    References
    ----------
    .. [1] T. McKelvey, H. Akcay, L. Ljung, "Subspace-based multivariable system
       identification from frequency response data", IEEE Transactions on Automatic
       Control 41, 1996.

    Examples
    --------
    >>> import numpy as np
    >>> omega = np.linspace(0.5, 10.0, 12)
    >>> model = realize_response(omega, (1 / (1j * omega + 2))[:, None, None], order=1)
    >>> float(model.A[0, 0].round(9))
    -2.0
    """
    k, p, m = G.shape
    rows = order + 1 + order // 2
    if order < 1 or 2 * k * m < rows * m + order or rows * p <= order:
        return None
    positive = omega[omega > 0]
    centre = float(np.exp(0.5 * np.log(positive.min() * positive.max())))
    z = (centre + 1j * omega) / (centre - 1j * omega)
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
    # B and D enter the response linearly
    try:
        X = np.linalg.inv(z[:, None, None] * np.eye(order) - A)
        left = np.concatenate([C @ X, np.broadcast_to(np.eye(p), (k, p, p))], axis=2)
        flat = left.reshape(k * p, order + p)
        rhs = G.reshape(k * p, m)
        regressors = np.vstack([flat.real, flat.imag])
        responses = np.vstack([rhs.real, rhs.imag])
        BD = np.linalg.lstsq(regressors, responses, rcond=None)[0]
        return Target(*d2c_tustin(A, BD[:order], C, BD[order:], 2.0 / centre))
    except ValueError:  # a pole on a data point or at infinity
        return None
