"""How sure a local model is, and what follows for the gray-box parameters.

The covariance of a model that minimises the simulation error is known to first order.
It is handed on as pairs of models, a little to either side along independent
directions, which survive any change of the state basis and of the time domain.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .excitation import independent_inputs
from .missing_data import remove_trends
from .numerics.innovations import autoregression
from .numerics.refinement import in_sections
from .numerics.regression import Freedom
from .numerics.signals import Record
from .numerics.simulation import lti_response
from .numerics.simulationfit import Realization, estimate_initial_state
from .numerics.uncertainty import parameter_covariance
from .parameter_statistics import response_gain
from .restructuring_problem import problem_from_models
from .statespace import StateSpace
from .structures import GrayBoxStructure
from .subspace_statistics import shorten

Array = NDArray[np.float64]
ModelPair = tuple[StateSpace, StateSpace]

# Distance of the models of a pair from the estimate, in standard deviations, and
# relative variance below which a direction is rounding.
_STEP = 1e-2
_NEGLIGIBLE = 1e-12


def deviated_models(
    fitted: Any,
    pairs: Sequence[tuple[Array, Array]],
    convert: Callable[[StateSpace], StateSpace],
) -> list[ModelPair]:
    """Models to either side of an estimate, along its directions of uncertainty.

    Parameters
    ----------
    fitted : estimator
        Like a fitted `SubspaceLTI`.
    pairs : sequence of (u, y)
        The experiments it was fitted to, arrays of one row per sample.
    convert : callable
        What becomes of a discrete-time model.

    Returns
    -------
    list of (StateSpace, StateSpace)
        Each pair is 0.02 standard deviations apart; directions are independent. Empty
        where the covariance is not known: the model does not minimise the simulation
        error (``refine=False``, a stability that was enforced, another estimator), it
        has no states, its inputs are collinear, or poles coincide.
    """
    known = getattr(fitted, "refine", False) and not fitted.stability_loss_
    if not known or independent_inputs([u for u, _ in pairs]) is not None:
        return []
    lti = fitted.lti_
    if lti.order == 0:
        return []
    centred = remove_trends(list(pairs), fitted.detrend)[0]
    records, share = shorten([Record(u.T, y.T) for u, y in centred])
    states, errors = [], []
    for u, y in records:
        free = y.T - lti_response(lti.A, lti.B, lti.C, lti.D, u.T)
        x0 = estimate_initial_state(lti.A, lti.C, free)
        states.append(x0)
        errors.append(y.T - lti_response(lti.A, lti.B, lti.C, lti.D, u.T, x0))
    loss = float(sum(np.sum(error**2) for error in errors))
    model = in_sections(Realization(lti.A, lti.B, lti.C, lti.D, np.array(states), loss))
    if model.blocks is None or not loss > 0.0:
        return []
    freedom = Freedom(lti.D != 0.0)
    covariance = share * parameter_covariance(
        model, records, freedom, autoregression(errors)
    )
    steps = _STEP * _square_root(covariance).T
    step = lti.sampling_time
    with warnings.catch_warnings():  # the estimate's own conversion says it once
        warnings.simplefilter("ignore")
        return [
            (
                convert(_moved(model, freedom, direction, step)),
                convert(_moved(model, freedom, -direction, step)),
            )
            for direction in steps
        ]


def covariance_of_parameters(
    structure: GrayBoxStructure,
    theta: Array,
    weight: Any,
    model: StateSpace,
    deviated: Sequence[ModelPair],
) -> Array:
    """Covariance of gray-box parameters from that of the black box.

    The response's deviations are carried to the parameters to first order, as the
    least-squares fit of the response does.

    Parameters
    ----------
    structure : GrayBoxStructure
    theta : ndarray of shape (n_params,)
    weight : StateSpace, (low, high) or None
        As `frequency_weight` of `GrayBoxRestructurer`.
    model : StateSpace
        The black box.
    deviated : sequence of (StateSpace, StateSpace)
        From `deviated_models`.

    Returns
    -------
    ndarray of shape (n_params, n_params)
    """
    problem = problem_from_models(structure, [model], weight)
    omega = problem.omega
    K = response_gain(problem.system, theta, omega).conj()
    changes = []
    for above, below in deviated:
        dG = above.frequency_response(omega) - below.frequency_response(omega)
        changes.append(np.einsum("jkpm,kpm->j", K, dG).real / (2.0 * _STEP))
    T = np.array(changes)
    return T.T @ T


def _square_root(covariance: Array) -> Array:
    """L with ``L L.T`` the covariance, of full column rank."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > _NEGLIGIBLE * values[-1]
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])


def _moved(
    model: Realization, freedom: Freedom, change: Array, sampling_time: float | None
) -> StateSpace:
    """The model after a change of B, D, A and C, as `parameter_covariance` has them."""
    assert model.blocks is not None
    A, B, C, D = (np.array(M) for M in model[:4])
    sizes = [B.size, int(freedom.direct.sum())]
    sizes += [block.size for block in model.blocks]
    dB, dD, *blocks, dC = np.split(change, np.cumsum(sizes))
    B += dB.reshape(B.shape)
    C += dC.reshape(C.shape)
    D[freedom.direct] += dD
    start = 0
    for own, block in zip(blocks, model.blocks, strict=True):
        rows = slice(start, start + len(block))
        A[rows, rows] += own.reshape(block.shape)
        start += len(block)
    return StateSpace(A, B, C, D, sampling_time)
