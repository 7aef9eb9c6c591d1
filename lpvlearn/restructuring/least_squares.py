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
_HALVINGS = 12  # of a step that does not lower the sum
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
    n, p = J.shape[-1], J.shape[1]
    d, now = np.zeros(n), E
    U, s, _ = np.linalg.svd(now)
    for power in _POWERS:
        for _ in range(_REWEIGHTED):
            top = float(s.max(initial=0.0))
            if top == 0.0:
                return d
            share = np.zeros((len(s), p))
            share[:, : s.shape[1]] = s / top
            root = np.maximum(share, _NOTHING)[:, None] ** (power / 2 - 1) * U
            root = root @ U.conj().swapaxes(1, 2)
            rows = np.einsum("kpq,kqmj->kpmj", root, J).reshape(-1, n)
            rest = (root @ now).ravel()
            A = np.vstack([rows.real, rows.imag])
            b = np.concatenate([rest.real, rest.imag])
            step, total = scaled_lstsq(A, b)[0], np.sum(share**power)
            for length in 0.5 ** np.arange(_HALVINGS):
                trial = E + J @ (d - length * step)
                U_new, s_new, _ = np.linalg.svd(trial)
                new = np.sum(np.minimum(s_new / top, _FAR) ** power)
                if new < total:
                    break
            else:
                break
            d, now, U, s = d - length * step, trial, U_new, s_new
            if new > (1.0 - _SLOW) * total:
                break
    return d
