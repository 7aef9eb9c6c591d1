"""Whether another horizon would have served better than the one that was given."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .hankel import correlation_sequence
from .identification import (
    Identified,
    ScaledRecords,
    max_horizon,
    max_order,
    realize,
    subspace_of,
)
from .refinement import refine_simulation
from .regression import Freedom
from .signals import Record
from .simulation import lti_response

Array = NDArray[np.float64]

# What a model at its minimum under white noise does not show: correlation of the
# simulation error with past inputs (in standard deviations), or with its predecessor.
_SUSPICIOUS = 6.0
_SMOOTH = 0.3
_N_LAGS = 40
_MAX_SAMPLES = 4_096
_MAX_ROWS = 1000
# An error below this share of the present one is that of a clearly better model.
_CLEARLY_BETTER = 0.9
# Relative errors below this are rounding.
_ROUNDING = 1e-6


def error_structure(
    model: tuple[Array, Array, Array, Array], record: Record, x0: Array
) -> tuple[float, float]:
    """How much the simulation error depends on past inputs and on its own past.

    Parameters
    ----------
    model : (A, B, C, D)
    record : Record
    x0 : ndarray of shape (order,)

    Returns
    -------
    by_inputs : float
        Largest correlation with past inputs, in standard deviations of an error that
        does not depend on them (Bartlett's formula for two autocorrelated signals).
    by_itself : float
        Largest correlation of an output's error with that one sample before.
    """
    n = min(record.u.shape[1], _MAX_SAMPLES)
    u, m = record.u[:, :n].T, len(record.u)
    error = record.y[:, :n].T - lti_response(*model, u, x0)
    lags = correlation_sequence(np.hstack([u, error]), min(_N_LAGS, n))
    own = np.einsum("dii->di", lags)
    of_u, of_v = own[:, :m], own[:, m:]
    white = np.outer(of_u[0], of_v[0])
    variance = np.maximum(2.0 * of_u.T @ of_v - white, 0.2 * white) / n
    variance[variance == 0.0] = np.inf
    by_inputs = (np.abs(lags[:, :m, m:]) / np.sqrt(variance)).max()
    size = np.where(of_v[0] > 0.0, of_v[0], np.inf)
    return float(by_inputs), float((of_v[min(1, len(own) - 1)] / size).max())


def better_horizon(
    found: Identified,
    scaled: ScaledRecords,
    horizon: int,
    free: Freedom,
    *,
    method: str,
    refine: bool,
    enforce_stability: bool,
) -> tuple[int, float] | None:
    """Another horizon whose model fits clearly better, where there is one.

    Others are tried only if the simulation error has structure: coloured noise, a model
    of too low an order, or a poor minimum, which can be told apart by trying.

    Parameters
    ----------
    found : Identified
        Model of the given horizon.
    scaled : ScaledRecords
    horizon : int
    free : Freedom
    method, refine, enforce_stability
        As in `identify`.

    Returns
    -------
    horizon : int
    residual : float
        Its relative simulation error.
    """
    records, model = scaled.records, found.scaled_model
    if not _ROUNDING < found.residual < np.inf:
        return None
    states = model.initial_states
    structure = [
        error_structure(model[:4], record, x0)
        for record, x0 in zip(records[:4], states, strict=False)
    ]
    if all(u < _SUSPICIOUS and v < _SMOOTH for u, v in structure):
        return None
    m, ny, order = len(records[0].u), len(records[0].y), len(model.A)
    height = 2 * m + (1 if method == "pi-moesp" else 2) * ny
    lengths = [record.u.shape[1] for record in records]
    highest = min(max_horizon(lengths, m, ny), max(2, _MAX_ROWS // height))
    energy = sum(float((record.y**2).sum()) for record in records)
    for other in (2 * horizon, 4 * horizon, horizon // 2):
        if not 2 <= other <= highest or max_order(other, m, ny, method) < order:
            continue
        space = subspace_of(records, other, order, method=method)
        trial = realize(
            space, records, order, free, enforce_stability=enforce_stability
        )
        if refine:
            trial, _ = refine_simulation(trial, records, free)
        residual = float(np.sqrt(trial.loss / energy))
        if residual < _CLEARLY_BETTER * found.residual:
            return other, residual
    return None
