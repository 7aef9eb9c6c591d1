"""How uncertain simulated outputs are: by the coefficients, and by the model itself.

Coefficients with the covariance ``P = F F^T`` make outputs of the variance
``diag(J P J^T)``, to first order, with the derivatives J of the outputs. No precision
of coefficients helps where the model is not true: what it leaves of outputs that were
measured is noise, and its own error. The noise is taken to be white; the error of a
model, a system that answers to inputs, is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import periodogram

from .model import LPVStateSpace
from .sensitivity import output_slopes

Array = NDArray[np.float64]

_BANDS = 8  # of frequencies, the quietest of which tells the level of white noise

# Standard deviations of the power of a band, within which others are as quiet; that of
# one ordinate is its mean, neighbours under a Hann window are correlated.
_ALIKE, _ORDINATE = 4.0, 2.0**0.5


class Levels(NamedTuple):
    """Standard deviations (n_outputs,) of what a model leaves of measured outputs."""

    model_error: Array
    noise: Array


def simulation_std(model: LPVStateSpace, u: Array, kappa: Array, dt: float) -> Array:
    """Standard deviations (n_samples, n_outputs) of outputs simulated from rest.

    By the covariance of the coefficients, which must be known.
    """
    root = model.covariance_root()
    own = replace(model.silenced(), bases=())
    x0 = own.state_offset(kappa[:1])[0]
    std = np.empty((len(u), model.n_outputs))
    every = np.ones(len(root), bool)
    for rows, J in output_slopes(own, u, kappa, dt, x0, every):
        std[rows] = np.linalg.norm(J[:, :, model.order :] @ root, axis=2)
    return std


def levels_of(errors: Sequence[Array]) -> Levels:
    """Noise and model error behind simulation errors (n_samples, n_outputs) of records.

    The level of the quietest of eight bands of frequencies, and of those that are as
    quiet by chance, is that of white noise; the rest of the mean square is the model's
    own error. Errors of records too short to tell are taken for that.
    """
    total = np.mean(np.vstack(errors) ** 2, axis=0)
    powers: list[list[Array]] = [[] for _ in range(_BANDS)]
    for e in errors:
        ordinates = periodogram(e, window="hann", detrend=False, axis=0)[1][1:-1] / 2
        if len(ordinates) >= _BANDS:
            for band, part in zip(
                powers, np.array_split(ordinates, _BANDS), strict=True
            ):
                band.append(part)
    noise = np.zeros_like(total)
    if powers[0]:
        level = np.array([np.vstack(band).mean(axis=0) for band in powers])
        spread = _ALIKE * _ORDINATE / np.sqrt(len(np.vstack(powers[0])))
        quiet = level <= level.min(axis=0) * (1.0 + spread)
        noise = np.minimum(np.mean(level, axis=0, where=quiet), total)
    return Levels(np.sqrt(total - noise), np.sqrt(noise))
