"""The least-squares fit of a frequency response, which starts the minimax."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..systems.least_squares import levenberg_marquardt
from ..systems.response import pole_grid, pole_rates
from .error_system import ErrorSystem, derivatives
from .limits import growth
from .transfer import Target

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

_MARGIN = 0.02  # stability margin, relative to the slowest decay of the black box

_DECADES = 1.5  # channels whose sizes differ by less are left as they are


class LeastSquaresResult(NamedTuple):
    """Minimiser and mean square error there."""

    x: Array
    cost: float
    relative_error: float = np.nan  # root mean square, relative to what is fitted


def frequency_grid(poles: Complex, dt: float | None, n_points: int = 60) -> Array:
    """Frequencies (rad/s) that see every pole: logarithmic, and around resonances.

    Parameters
    ----------
    poles : ndarray
        Poles of the black-box model, in its own time domain.
    dt : float or None
        Sampling time; the grid of a discrete model ends at the Nyquist frequency.
    """
    rates = pole_rates(poles, dt)
    size = np.abs(rates)
    size = size[size > 0]
    low, high = (size.min(), size.max()) if size.size else (1.0, 1.0)
    around = pole_grid(rates, low / 20, high * 10, n_points, [-1.0, 0.0, 1.0])
    grid = np.append(around, size)
    if dt is not None:
        grid = grid[grid < np.pi / dt]
    return np.unique(grid[grid > 0])


def fit_frequency_response(
    system: ErrorSystem,
    theta0: Array,
    omega: Array,
    G0: Complex,
    *,
    admissible: Callable[[Array], bool],
    scaling: Array | float = 1.0,
    max_iter: int = 100,
) -> LeastSquaresResult | None:
    """Least-squares fit of ``G(theta)`` to `G0` over a frequency grid.

    Minimises ``mean_k |W_k (G(j omega_k, theta) - G0_k)|_F^2``; None where the start
    is not admissible.

    Parameters
    ----------
    system : ErrorSystem
    theta0 : ndarray of shape (n_params,)
    omega : ndarray of shape (k,)
    G0 : ndarray of shape (k, n_outputs, n_inputs)
    admissible : callable
        False where the model may not go (an unstable one).
    scaling : ndarray of shape (n_outputs, n_inputs), default=1.0
        Factors of the residuals' entries, as from `channel_scaling`.
    """
    W = system.weight_response(omega)[0] / np.sqrt(len(omega))

    def residuals(x: Array, _: Any) -> tuple[Array, Callable[..., Array]]:
        theta = x[0]
        if not admissible(theta):
            return np.full((1, 1), np.nan), lambda _: np.zeros((1, 1, len(theta)))
        at = system.point(theta, omega, G0)

        def jacobian(_: Any) -> Array:
            J = derivatives(W @ at.L, system.structure.jacobian(theta), at.R)
            J = (np.asarray(scaling)[..., None] * J).reshape(-1, len(theta))
            return np.vstack([J.real, J.imag])[None]

        r = (scaling * (W @ at.E)).ravel()
        return np.concatenate([r.real, r.imag])[None], jacobian

    structure = system.structure
    x, cost = levenberg_marquardt(
        residuals,
        theta0[None],
        lower=structure.lower,
        upper=structure.upper,
        max_iter=max_iter,
    )
    return LeastSquaresResult(x[0], float(cost[0])) if np.isfinite(cost[0]) else None


def channel_scaling(G: Complex) -> Array | None:
    """Factors of rows and columns that bring all channels to one size.

    None where they differ little. Channels in micrometres and in percent then count
    alike in a fit.

    Parameters
    ----------
    G : ndarray of shape (k, n_outputs, n_inputs)

    Returns
    -------
    ndarray of shape (n_outputs, n_inputs) or None
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


def grid_and_margin(target: Target) -> tuple[Array, float]:
    """Frequencies of the least-squares fit, and the stability margin (1/s)."""
    poles = np.linalg.eigvals(target.A).astype(complex)
    slowest = np.abs(growth(poles, target.dt)).min(initial=np.inf)
    margin = _MARGIN * float(slowest) if np.isfinite(slowest) else 0.0
    return frequency_grid(poles, target.dt), margin
