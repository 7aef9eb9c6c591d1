"""Derivatives of array-valued functions of a vector, by complex step or differences."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.exceptions import ComplexWarning
from numpy.typing import NDArray

Array = NDArray[np.float64]

# All steps are relative to the sizes of the parameters.

_COMPLEX_STEP = 1e-30  # nothing is subtracted: its square is below any rounding

_CENTRAL_STEP = 6e-6  # about eps^(1/3): rounding and truncation balance

_CURVATURE_STEP = 1e-5  # the same for derivatives, whose scale of change is longer

# Relative difference of exact and central derivatives of an analytic function: far
# above the truncation of the latter, far below what a missing part would make.
_AGREEMENT = 1e-4

# Relative rounding error of a central difference: eps / _CENTRAL_STEP is 4e-11, and the
# function may lose two digits of its own.
_ROUNDING = 1e-8

_LEAST_SIZE = 1e-3  # of a parameter near zero, relative to its usual size

_FILTERS = threading.RLock()  # the warning filters are those of all threads


def numerical_jacobian(
    f: Callable[[Any], Any], theta: Array, typical: Array | None = None
) -> Array:
    """Derivative of `f` at `theta`, exact to rounding where `f` is analytic.

    Parameters
    ----------
    f : callable
        Maps (n_params,) to an array of any shape; where it cannot take complex
        parameters, or is not analytic, central differences are used.
    theta : ndarray of shape (n_params,)
    typical : ndarray of shape (n_params,), default=None
        Usual sizes of the parameters.

    Returns
    -------
    ndarray of shape (n_params, ...)

    Examples
    --------
    >>> import numpy as np
    >>> numerical_jacobian(lambda t: np.array([t[0] * t[1], np.exp(t[0])]),
    ...                    np.array([0.0, 3.0]))
    array([[3., 1.],
           [0., 0.]])
    """
    scale = _parameter_scale(theta, typical)
    exact = _analytic_jacobian(f, theta, scale)
    return _central(f, theta, _CENTRAL_STEP * scale) if exact is None else exact


def _complex_step(f: Callable[[Any], Any], theta: Array, scale: Array) -> Array:
    columns = [
        np.imag(f(theta + 1j * step)) / step.max()
        for step in np.diag(_COMPLEX_STEP * scale)
    ]
    return np.array(columns, dtype=float)


def _analytic_jacobian(
    f: Callable[[Any], Any], theta: Array, scale: Array
) -> Array | None:
    """The derivative by complex steps; None where `f` is not analytic.

    A function that is not (abs, real, conj) fails the complex step in silence. Its
    change along one direction, in which no two parameters change alike, tells, entry
    by entry.
    """
    try:
        with _FILTERS, warnings.catch_warnings():
            warnings.simplefilter("error", ComplexWarning)
            exact = _complex_step(f, theta, scale)
    except (TypeError, ValueError, NotImplementedError, ComplexWarning):
        return None
    direction = scale * np.cos(1.0 + np.arange(len(theta)) ** 2)
    step = _CENTRAL_STEP * direction
    up, down = np.asarray(f(theta + step)), np.asarray(f(theta - step))
    change = (up - down) / (2.0 * _CENTRAL_STEP)
    size = np.abs(exact * scale.reshape(-1, *[1] * (exact.ndim - 1))).sum(0)
    rounding = _ROUNDING * (np.abs(up) + np.abs(down))
    error = np.abs(np.tensordot(direction, exact, axes=1) - change)
    agrees = error <= _AGREEMENT * np.maximum(np.abs(change), size) + rounding
    return exact if agrees.all() else None


def numerical_curvature(
    f: Callable[[Any], Any], theta: Array, typical: Array | None = None
) -> Array:
    """Second derivatives, by central differences of the first ones, symmetrised.

    The arguments are those of `numerical_jacobian`; shape (n_params, n_params, ...).

    Examples
    --------
    >>> import numpy as np
    >>> H = numerical_curvature(lambda t: t[0] ** 3 * t[1], np.array([2.0, 1.0]))
    >>> H.round(6)
    array([[12., 12.],
           [12.,  0.]])
    """
    scale = _parameter_scale(theta, typical)
    analytic = _analytic_jacobian(f, theta, scale) is not None

    def jacobian(point: Array) -> Array:
        if analytic:  # as around theta: not asked again at every step
            return _complex_step(f, point, scale)
        return numerical_jacobian(f, point, typical)

    return symmetric_differences(jacobian, theta, typical)


def symmetric_differences(
    jacobian: Callable[[Array], Array], theta: Array, typical: Array | None = None
) -> Array:
    """Second derivatives from a Jacobian that maps (n_params,) to (n_params, ...)."""
    H = _central(jacobian, theta, _CURVATURE_STEP * _parameter_scale(theta, typical))
    return 0.5 * (H + H.swapaxes(0, 1))


def _central(f: Callable[[Any], Any], theta: Array, steps: Array) -> Array:
    return np.array(
        [
            (f(theta + step) - f(theta - step)) / (2.0 * step.max())
            for step in np.diag(steps)
        ]
    )


def _parameter_scale(theta: Array, typical: Array | None) -> Array:
    """Size of every parameter; None, or 0, stands for a usual value of 1."""
    usual = np.ones(len(theta)) if typical is None else np.abs(typical)
    return np.maximum(np.abs(theta), _LEAST_SIZE * np.where(usual > 0, usual, 1.0))
