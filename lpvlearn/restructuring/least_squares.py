"""Levenberg-Marquardt, and the frequency-response fit that starts the minimax."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..systems.response import pole_grid, pole_rates
from .error_system import ErrorSystem
from .limits import growth
from .transfer import Target

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

_BALANCED_DECADES = 1.5  # channels that differ by less are left as they are

# residuals and Jacobian at a point, None where the point is not admissible
Residuals = Callable[[Array], tuple[Array, Array] | None]


@dataclass(frozen=True)
class LeastSquaresResult:
    """Minimiser, cost ``|r|^2``, and the triangular factor of the Jacobian there."""

    x: Array
    cost: float
    R: Array
    n_iter: int


def levenberg_marquardt(
    residuals: Residuals,
    x0: Array,
    *,
    lower: Array | float = -np.inf,
    upper: Array | float = np.inf,
    max_iter: int = 50,
    tol: float = 1e-6,
) -> LeastSquaresResult | None:
    """Minimise ``|r(x)|^2`` with Marquardt's scaling; None if `x0` is not admissible.

    Steps are projected on the bounds; a variable whose bound the gradient presses
    against is left out of the step.

    Stops when the cost falls by less than `tol` relative, twice in a row, or when the
    predicted decrease is rounding noise.
    """
    x = np.clip(x0, lower, upper)
    state = residuals(x)
    if state is None:
        return None
    r, J = state
    cost = float(r @ r)
    damping, small = 1e-3, 0
    scale = np.zeros(len(x))
    n_iter = 0
    Q, R = np.linalg.qr(J)
    while n_iter < max_iter:
        n_iter += 1
        scale = np.maximum(scale, np.linalg.norm(R, axis=0))
        d = np.where(scale > 0, scale, 1.0)
        g = R.T @ (Q.T @ r)
        held = ((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0))
        free = np.where(held, 0.0, 1.0)
        rhs = np.concatenate([-(Q.T @ r), np.zeros(len(x))])
        accepted: tuple[Array, Array] | None = None
        while damping < 1e12:
            stacked = np.vstack([R * (free / d), np.sqrt(damping) * np.eye(len(x))])
            step = free / d * np.linalg.lstsq(stacked, rhs, rcond=None)[0]
            step = np.clip(x + step, lower, upper) - x
            predicted = (
                cost
                - float(np.sum((Q.T @ r + R @ step) ** 2))
                - (float(r @ r) - float(np.sum((Q.T @ r) ** 2)))
            )
            if predicted <= 1e-14 * cost:
                break
            trial = residuals(x + step)
            if trial is not None:
                new = float(trial[0] @ trial[0])
                if new < cost:
                    accepted = trial
                    gain = (cost - new) / predicted
                    damping = max(damping * (0.1 if gain > 0.75 else 1.0), 1e-12)
                    break
            damping *= 4.0
        if accepted is None:
            break
        small = small + 1 if cost - new <= tol * cost else 0
        x, (r, J), cost = x + step, accepted, new
        Q, R = np.linalg.qr(J)
        if small >= 2 or cost == 0.0:
            break
    return LeastSquaresResult(x, cost, R, n_iter)


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
    balance: Array | float = 1.0,
    max_iter: int = 60,
) -> LeastSquaresResult | None:
    """Least-squares fit of ``G(theta)`` to `G0` over a frequency grid.

    Minimises ``mean_k |W_k (G(j omega_k, theta) - G0_k)|_F^2``. The triangular factor
    of its Jacobian is the Gauss-Newton metric: ``|R d|`` is the root-mean-square
    change of the response that a change `d` of the parameters makes.

    Parameters
    ----------
    system : ErrorSystem
    theta0 : ndarray of shape (n_params,)
    omega : ndarray of shape (k,)
    G0 : ndarray of shape (k, n_outputs, n_inputs)
    admissible : callable
        False where the model may not go (an unstable one).
    balance : ndarray of shape (n_outputs, n_inputs), default=1.0
        Factors of the residuals' entries, as from `channel_balance`.
    """
    W = system.weight_response(omega)[0] / np.sqrt(len(omega))
    target = W @ G0

    def residuals(theta: Array) -> tuple[Array, Array] | None:
        if not admissible(theta):
            return None
        G, J = system.response_jacobian(theta, omega)
        r = (balance * (W @ G - target)).ravel()
        k, p, m, q = J.shape
        J = (W @ J.reshape(k, p, m * q)).reshape(k, p, m, q)
        J = (np.asarray(balance)[..., None] * J).reshape(len(r), -1)
        if not np.isfinite(J).all():
            return None
        return np.concatenate([r.real, r.imag]), np.vstack([J.real, J.imag])

    structure = system.structure
    return levenberg_marquardt(
        residuals,
        theta0,
        lower=structure.lower,
        upper=structure.upper,
        max_iter=max_iter,
    )


def channel_balance(G: Complex) -> Array | None:
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
    if max(spread) < _BALANCED_DECADES:
        return None
    return 1.0 / (rows[:, None] * columns)


_MARGIN = 0.02  # stability margin, relative to the slowest decay of the black box


def grid_and_margin(target: Target) -> tuple[Array, float]:
    """Frequencies of the least-squares fit, and the stability margin (1/s)."""
    poles = np.linalg.eigvals(target.A).astype(complex)
    slowest = np.abs(growth(poles, target.dt)).min(initial=np.inf)
    margin = _MARGIN * float(slowest) if np.isfinite(slowest) else 0.0
    return frequency_grid(poles, target.dt), margin
