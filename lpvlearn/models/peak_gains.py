"""Norms of a model with the frequencies and directions that attain them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..exceptions import VersionedPickle
from ..systems.hinf_norm import hinf_norm, linf_norm
from ..validation import one_of, share
from .statespace import StateSpace

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class PeakGains(VersionedPickle):
    """A norm and the local maxima of the largest singular value near it.

    Attributes
    ----------
    norm : float
    frequencies : ndarray of shape (n_peaks,)
        Rad/s, the highest peak first; may hold 0 and, in continuous time, infinity.
    values : ndarray of shape (n_peaks,)
        Largest singular value at these frequencies.
    left : ndarray of shape (n_peaks, n_outputs)
    right : ndarray of shape (n_peaks, n_inputs)
        Singular vectors: ``G right = value left``, the output and input directions.
    """

    norm: float
    frequencies: Array
    values: Array
    left: Complex
    right: Complex


def peak_gains(
    model: StateSpace, *, within: float = 1e-6, norm: str = "hinf"
) -> PeakGains:
    """H-infinity norm with all its active frequencies, Eq. (15)-(17).

    Parameters
    ----------
    model : StateSpace
        Continuous or discrete time.
    within : float, default=1e-6
        Local maxima down to that fraction below the norm are returned; 0.5 returns all
        above half of it.
    norm : {"hinf", "linf"}, default="hinf"
        The H-infinity norm of an unstable model is infinite, with no peaks; the
        L-infinity norm is the maximum over frequency all the same.

    Returns
    -------
    PeakGains

    Raises
    ------
    ValueError
        If `within` is not between 0 and 1, or `norm` is unknown.

    Examples
    --------
    A resonance of damping 0.1 at 2 rad/s; its peak is ``1 / (2 z sqrt(1 - z^2))``:

    >>> from lpvlearn import StateSpace, peak_gains
    >>> peaks = peak_gains(StateSpace([[0, 1], [-4, -0.4]], [[0], [4]], [[1, 0]]))
    >>> round(peaks.norm, 6), peaks.frequencies.round(6)
    (5.025189, array([1.979899]))
    """
    one_of("norm", norm, ("hinf", "linf"))
    if not isinstance(model, StateSpace):
        raise ValueError(f"`model` must be a StateSpace. Got {type(model).__name__}.")
    within = share("within", within)
    compute = hinf_norm if norm == "hinf" else linf_norm
    parts, dt = (model.A, model.B, model.C, model.D), model.sampling_time
    size = compute(*parts, dt=dt).norm
    found = compute(*parts, dt=dt, within=within)
    # the highest peak to the last digit as hinf_norm() has it
    omega, sigma = found.frequencies, np.minimum(found.values, size)
    sigma[:1] = size
    if not np.isfinite(size):  # at a pole on the axis no direction exists
        omega, sigma = omega[:0], sigma[:0]
    U, _, Vh = np.linalg.svd(model.frequency_response(omega))
    return PeakGains(size, omega, sigma, U[:, :, 0], Vh[:, 0].conj())
