"""Spread of the gray-box parameters: under noise, and under restarts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.base import clone

from .numerics.matching import ErrorSystem
from .statespace import StateSpace

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def response_gain(system: ErrorSystem, theta: Array, omega: Array) -> Complex:
    """First-order change of the parameters with the black box's response.

    Minimising the weighted mean square error, ``d theta = Re(K dG)`` with
    ``K = (J^T J)^-1 J^H W`` in real arithmetic.

    Returns
    -------
    ndarray of shape (n_params, k, n_outputs, n_inputs)
        ``d theta_j = Re sum conj(K_j) dG``.
    """
    W = system.weight_response(omega)[0]
    J = system.response_jacobian(theta, omega)[1]
    WJ = np.einsum("kpq,kqmj->kpmj", W, J)
    q = J.shape[-1]
    flat = WJ.reshape(-1, q)
    real = np.vstack([flat.real, flat.imag])
    inverse = np.linalg.pinv(real)
    half = len(flat)
    K = (inverse[:, :half] + 1j * inverse[:, half:]).reshape(q, *WJ.shape[:-1])
    return np.einsum("jkpm,kpq->jkqm", K, W.conj())


def spread_covariance(
    system: ErrorSystem, theta: Array, omega: Array, responses: Sequence[Complex]
) -> Array:
    """Covariance of the parameters of an averaged model from single realizations.

    Every realization's response is carried to the parameters to first order; the
    covariance of their mean is that of one divided by their number.

    Parameters
    ----------
    responses : sequence of ndarray of shape (k, n_outputs, n_inputs)
        Responses of the models from single realizations.

    Returns
    -------
    ndarray of shape (n_params, n_params)

    Raises
    ------
    ValueError
        If there are fewer than two realizations.
    """
    if len(responses) < 2:
        raise ValueError(
            "`realizations` must be at least 2 models to have a spread. Got "
            f"{len(responses)}."
        )
    G = np.array(responses)
    K = response_gain(system, theta, omega)
    if K.shape[2] != G.shape[2]:  # several black boxes were stacked
        K = K.reshape(*K.shape[:2], -1, G.shape[2], G.shape[3]).sum(2)
    changes = np.real(np.einsum("jkpm,rkpm->rj", K.conj(), G - G.mean(0)))
    return np.cov(changes.T, ddof=1).reshape(len(theta), -1) / len(G)


def perturbation_table(
    restructurer: Any, model: StateSpace, n_restarts: int, size: float
) -> pd.DataFrame:
    """Deviation of the parameters after restarts from perturbed ones."""
    theta = restructurer.params_
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(n_restarts):
        start = theta * (1.0 + size * rng.normal(size=theta.shape))
        again = clone(restructurer).set_params(init=start, n_starts=1).fit_model(model)
        rows.append([*(again.params_ / theta - 1.0), again.error_])
    names = [*restructurer.structure_.parameter_names, "error_"]
    return pd.DataFrame(rows, columns=names)
