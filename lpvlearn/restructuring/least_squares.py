"""The least-squares fit of a frequency response, which starts the minimax."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..systems.least_squares import levenberg_marquardt, scaled_lstsq
from .deadline import time_is_up
from .error_system import ErrorSystem

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Powers of singular values in a sum that comes near their maximum, and steps for each
_POWERS, _REWEIGHTED = (2, 4, 8, 16, 32, 64, 128, 256), 6
_NOTHING = 1e-6  # smaller parts of the maximum weigh alike: nothing
_FAR = 10.0  # times the maximum: a power of it is the limit of a float
_LENGTHS = 0.5 ** np.arange(12)[:, None, None, None]  # of a step, till the sum falls
_SLOW = 5e-2  # relative decrease of the sum that the next power may as well have

_DECADES = 1.5  # channels whose sizes differ by less are left as they are


class LeastSquaresResult(NamedTuple):
    """Minimiser and mean square error there."""

    x: Array
    cost: float
    relative_error: float = np.nan  # root mean square, relative to what is fitted


def fit_frequency_response(
    system: ErrorSystem,
    theta0: Array,
    omega: Array,
    *,
    admissible: Callable[[Array], bool],
    scaling: Array | float = 1.0,
    max_iter: int = 100,
    geodesic: bool = False,
) -> LeastSquaresResult | None:
    """Least-squares fit of ``G(theta)`` to the black box at the frequencies `omega`.

    Minimises ``mean_k |W_k (G(j omega_k, theta) - G0_k)|_F^2``; None where the start
    is not admissible (an unstable model). `scaling` (n_outputs, n_inputs) holds factors
    of the residuals' entries, as from `channel_scaling`.
    """
    unit = float(np.sqrt(len(omega)))

    def residuals(x: Array, _: Any) -> tuple[Array, Callable[..., Array]]:
        theta = x[0]
        if not admissible(theta):
            return np.full((1, 1), np.nan), lambda _: np.zeros((1, 1, len(theta)))
        E, slopes = system.linearised_error(theta, omega, unit)

        def jacobian(_: Any) -> Array:
            J = (np.asarray(scaling)[..., None] * slopes()).reshape(-1, len(theta))
            return np.vstack([J.real, J.imag])[None]

        r = (scaling * E).ravel()
        return np.concatenate([r.real, r.imag])[None], jacobian

    structure = system.structure
    x, cost = levenberg_marquardt(
        residuals,
        theta0[None],
        lower=structure.lower,
        upper=structure.upper,
        max_iter=max_iter,
        stop=time_is_up,
        geodesic=geodesic,
    )
    return LeastSquaresResult(x[0], float(cost[0])) if np.isfinite(cost[0]) else None


def channel_scaling(G: Complex) -> Array | None:
    """Factors of rows and columns that bring all channels to one size.

    None where they differ little. Channels in micrometres and in percent then count
    alike in a fit. `G` (k, n_outputs, n_inputs) gives factors (n_outputs, n_inputs).
    """
    size = np.sqrt(np.mean(np.abs(G) ** 2, axis=0))
    rows = np.linalg.norm(size, axis=1)
    rows = np.where(rows > 0, rows, rows.max(initial=0.0))
    if not rows.any():
        return None
    columns = np.linalg.norm(size / rows[:, None], axis=0)
    columns = np.where(columns > 0, columns, columns.max())
    spread = np.ptp(np.log10(rows)), np.ptp(np.log10(columns))
    if max(spread) < _DECADES:
        return None
    return 1.0 / (rows[:, None] * columns)


def least_maximum(E: Complex, J: Complex) -> Array:
    """``d`` with the least maximum over k of the norms of ``E_k + J_k d``, nearly.

    `E` has shape (k, n_outputs, n_inputs), `J` (k, n_outputs, n_inputs, n_params). By
    reweighted least squares for the sum of powers of the singular values, the power
    raised step by step (Kahng, 1972), each step cut until the sum falls.

    Examples
    --------
    The number nearest to -1, 0 and 3 is in the middle of the extremes:

    >>> E = np.array([1.0, 0.0, -3.0])[:, None, None] + 0j
    >>> least_maximum(E, np.ones((3, 1, 1, 1))).round(2)
    array([1.])
    """
    n = J.shape[-1]
    d, now = np.zeros(n), _squares(E)
    for power in _POWERS:
        for _ in range(_REWEIGHTED):
            top = float(now.s.max(initial=0.0))
            if top == 0.0:
                return d
            share = now.s / top
            root = now.function(np.maximum(share, _NOTHING) ** (power / 2 - 1))
            rows = np.einsum("kpq,kqmj->kpmj", root, J).reshape(-1, n)
            rest = (root @ now.E).ravel()
            A = np.vstack([rows.real, rows.imag])
            b = np.concatenate([rest.real, rest.imag])
            step, total = scaled_lstsq(A, b)[0], np.sum(share**power)
            change = J @ step
            product = now.E @ change.conj().swapaxes(1, 2)
            cross = product + product.conj().swapaxes(1, 2)
            M = now.M - _LENGTHS * (cross - _LENGTHS * _square(change))
            sizes = np.minimum(_singular_values(M) / top, _FAR)
            sums = np.sum(sizes**power, axis=(1, 2))
            lower = np.flatnonzero(sums < total)
            if len(lower) == 0:
                break
            length = _LENGTHS[lower[0]].item()
            d, now = d - length * step, _squares(now.E - length * change)
            if sums[lower[0]] > (1.0 - _SLOW) * total:
                break
    return d


class _Squares(NamedTuple):
    """Matrices (k, p, m) and their squares ``M = E E^H``, of eigenvalues ``s**2``."""

    E: Complex
    M: Complex
    s: Array  # (k, p), singular values

    def function(self, values: Array) -> Complex:
        """What has the eigenvectors of M and other eigenvalues, those of each `s`."""
        if self.s.shape[1] != 2:
            U = np.linalg.eigh(self.M)[1]
            return (U * values[:, None]) @ U.conj().swapaxes(1, 2)
        gap = np.diff(self.s**2)
        slope = np.divide(np.diff(values), gap, out=np.zeros_like(gap), where=gap > 0)
        function = slope[:, :, None] * self.M
        function[:, [0, 1], [0, 1]] += values[:, :1] - slope * self.s[:, :1] ** 2
        return function


def _squares(E: Complex) -> _Squares:
    M = _square(E)
    return _Squares(E, M, _singular_values(M))


def _square(E: Complex) -> Complex:
    return E @ E.conj().swapaxes(1, 2)


def _singular_values(M: Complex) -> Array:
    """Those of matrices (..., p, m) by their squares ``M = E E^H``."""
    if M.shape[-1] != 2:
        values = np.linalg.eigvalsh(M)
    else:  # many times as fast as LAPACK, matrix by matrix
        middle = 0.5 * (M[..., 0, 0] + M[..., 1, 1]).real
        half = 0.5 * (M[..., 0, 0] - M[..., 1, 1]).real
        radius = np.hypot(half, np.abs(M[..., 0, 1]))
        values = np.stack([middle - radius, middle + radius], axis=-1)
    return np.sqrt(np.maximum(values, 0.0))
