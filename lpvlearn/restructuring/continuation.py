"""Starts by continuation: from a blurred response to the response itself.

On the frequency axis a lightly damped resonance is a narrow peak, and a fit that
begins with the peak beside it has a wrong minimum to fall into. On the shifted contour
``s = rho + j omega`` all modes look damped by ``rho``: the response is smooth, and a
fit of it begins almost anywhere. The fit is repeated while the shift goes to zero. It
needs no similarity transformation, so the structure may be any smooth function.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..models.system_matrix import blocks
from ..systems.least_squares import levenberg_marquardt
from ..systems.response import pole_grid, pole_rates, resolvent
from .deadline import time_is_up
from .error_system import Structure, Target, derivatives

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Flags = NDArray[np.bool_]

SHIFTS = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015, 0.0)  # relative to the fastest pole
_FLOOR = 1e-2  # errors are relative to the response, where it is not below that
_LONGEST = 1.5  # of a step, in logarithms of the parameters
_SMALL = 1e-3  # relative decrease that ends a stage
_ROUNDING = 1e-20  # squared relative error that is reached exactly
_HOLD = 1e-4  # pull to the start of a stage, times the shift


def continued_fits(
    structure: Structure,
    target: Target,
    thetas: Array,
    signed: Flags,
    *,
    shifts: tuple[float, ...] = SHIFTS,
    n_points: int = 25,
    max_iter: int = 32,
) -> tuple[Array, Array]:
    """Fit the response on contours that approach the frequency axis.

    `thetas` (k, n_params) are the starts, where a size wrong by a factor of ten does no
    harm; the logarithms of parameters that are `signed` are searched: they keep their
    signs. `shifts` are the contours' distances from the axis, relative to the fastest
    pole. Returns parameters by ascending cost, without starts that were lost, and the
    root mean squares of their relative errors on the last contour.

    Examples
    --------
    The frequency is ten times too low at the start:

    >>> from lpvlearn import GrayBoxStructure
    >>> structure = GrayBoxStructure.from_template(
    ...     A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]])
    >>> A, B, C, D = structure.matrices([2.0, 0.1, 100.0])
    >>> start, signed = np.array([[1.0, 0.3, 1.0]]), np.ones(3, bool)
    >>> found, _ = continued_fits(structure, Target(A, B, C, D), start, signed)
    >>> found.round(6)
    array([[  2. ,   0.1, 100. ]])
    """
    thetas = thetas[np.isfinite(thetas).all(1)]
    signed = signed & (thetas != 0).all(0)
    search = _Search(structure, target, thetas, signed)
    X = search.coordinates(thetas)
    cost = np.full(len(X), np.inf)
    for shift in shifts:
        search.move(shift, n_points, X)
        X, cost = levenberg_marquardt(
            search.residuals,
            X,
            longest=_LONGEST,
            max_iter=max_iter,
            tol=_SMALL,
            exact=_ROUNDING,
            stop=time_is_up,
        )
    found = search.thetas(X, np.arange(len(X)))
    good = np.isfinite(cost) & np.isfinite(found).all(1)
    order = np.argsort(cost[good], kind="stable")
    return found[good][order], np.sqrt(cost[good][order])


class _Search:
    """Errors on one contour, in coordinates that keep the signs of parameters."""

    def __init__(
        self, structure: Structure, target: Target, thetas: Array, signed: Flags
    ) -> None:
        self.structure, self.target, self.signed = structure, target, signed
        typical = np.abs(thetas).max(0, initial=0.0)
        size = np.where(thetas == 0, np.where(typical > 0, typical, 1.0), thetas)
        self.size = np.where(signed, np.sign(thetas), np.abs(size))
        self.center, self.hold = thetas, 0.0
        self.rates = pole_rates(np.linalg.eigvals(target.A), target.dt)
        sizes = np.abs(self.rates)
        self.low = float(sizes[sizes > 0].min(initial=sizes.max(initial=1.0)))
        self.high = float(sizes.max(initial=self.low))

    def coordinates(self, thetas: Array) -> Array:
        """Logarithms, or multiples of the starting sizes."""
        safe = np.where(self.signed, np.abs(thetas), 1.0)
        return np.where(self.signed, np.log(safe), thetas / self.size)

    def thetas(self, X: Array, rows: NDArray[np.intp]) -> Array:
        """Parameters of some starts."""
        grown = np.exp(np.where(self.signed, np.minimum(X, 300.0), 0.0))
        return self.size[rows] * np.where(self.signed, grown, X)

    def move(self, shift: float, n_points: int, X: Array) -> None:
        """Take another contour, beginning at `X`.

        Parameters that a blurred response hardly shows are held where they are.
        """
        self.center, self.hold = X, np.sqrt(_HOLD * shift)
        # the resonances are narrow on the axis itself
        narrow = self.rates[:0] if shift else self.rates
        ends = self.low / 3.0, 2.0 * self.high
        omega = pole_grid(narrow, *ends, n_points, [-1.0, 0.0, 1.0])
        omega = omega[omega > 0]
        t = self.target
        s = shift * self.high + 1j * omega
        self.s = np.asarray(s if t.dt is None else np.exp(s * t.dt), dtype=complex)
        self.G0 = t.C @ resolvent(t.A, self.s, t.B) + t.D
        size = np.abs(self.G0)
        top = size.max(0)
        if shift == 0:
            size = np.zeros_like(size) + top
        top = np.where(top > 0, top, max(float(top.max(initial=0.0)), 1e-300))
        count = np.sqrt(self.G0.size)
        self.weight = 1.0 / (count * (size + _FLOOR * top))

    def residuals(
        self, X: Array, rows: NDArray[np.intp]
    ) -> tuple[Array, Callable[..., Array]]:
        """Weighted errors of every start, and their derivatives."""
        theta = self.thetas(X, rows)
        n, q = self.structure.order, theta.shape[1]
        S = self.structure.system_matrix(theta)
        A, B, C, D = blocks(S, n)
        good = np.asarray(np.isfinite(S).all((1, 2)))
        poles, V = np.linalg.eig(np.where(good[:, None, None], A, 0.0).astype(complex))
        try:
            inverse = np.linalg.inv(V)
        except np.linalg.LinAlgError:  # a defective matrix among them
            inverse = np.linalg.pinv(V)
        CV, VB = C @ V, inverse @ B
        modes = 1.0 / (self.s[:, None] - poles[:, None])  # (k, f, n)
        CVm = CV[:, None] * modes[:, :, None]
        E = self.weight * (CVm @ VB[:, None] + D[:, None] - self.G0)
        E[~good] = np.nan
        flat = E.reshape(len(X), -1)
        pull = self.hold * (X - self.center[rows])

        def jacobian(kept: NDArray[np.intp]) -> Array:
            left = CVm[kept] @ inverse[kept, None]  # C (s I - A)^-1, (k, f, p, n)
            right = V[kept, None] @ (modes[kept, ..., None] * VB[kept, None])
            slope = np.where(self.signed, theta[kept], self.size[rows[kept]])
            (k, f, p, _), m = left.shape, B.shape[2]
            J = np.empty((k, f, p, m, q), complex)
            ones = [np.broadcast_to(np.eye(size), (f, size, size)) for size in (p, m)]
            for i in range(k):
                dS = self.structure.jacobian(theta[kept[i]])
                L = np.concatenate([left[i], ones[0]], 2)
                R = np.concatenate([right[i], ones[1]], 1)
                J[i] = derivatives(L, dS, R) * slope[i]
            J = (self.weight[..., None] * J).reshape(k, -1, q)
            held = np.broadcast_to(self.hold * np.eye(q), (k, q, q))
            return np.concatenate([J.real, J.imag, held], 1)

        return np.concatenate([flat.real, flat.imag, pull], 1), jacobian
