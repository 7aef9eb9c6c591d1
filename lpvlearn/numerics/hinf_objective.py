"""The H-infinity norm of the error as a minimax problem, Eq. (14)-(16).

The parameters are written ``theta = theta_0 + T y`` in the Gauss-Newton metric of the
response, where a unit step changes it by about the objective.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .certificates import Flags, MinimaxProblem, Peaks
from .limits import Limits, within_bounds
from .matching import ErrorSystem
from .response_geometry import ResponseGeometry

Array = NDArray[np.float64]

_DEPTH = 0.6  # peaks down to that fraction below the objective enter the local model
_FLAT = 1e-7  # a peak with a smaller relative gradient does not depend on theta
_CAP_TOLERANCE = 1e-7
_MAX_CAPS = 12
_BENT = 1.0  # part of a step that its bend may be at most
_HARD_STEPS = (0.99, 0.9999)


@dataclass
class HinfObjective:
    """Peaks of the error in the coordinates y, with constant peaks set aside.

    Attributes
    ----------
    system : ErrorSystem
    theta0 : ndarray of shape (n_params,)
    T : ndarray of shape (n_params, n_params)
    limits : Limits
        Of stability, speed, and the parameters' bounds.
    grid : ndarray
        Frequencies (rad/s) at which the search watches the error.
    cap : float
        With `capped`: its norm stays below that.
    capped : ErrorSystem or None
        The error whose norm is bounded while that of `system` is minimised.
    floor, floor_frequency : float
        Highest peak met so far whose value does not depend on the parameters.
    """

    system: ErrorSystem
    theta0: Array
    T: Array
    limits: Limits
    grid: Array
    cap: float = np.inf
    capped: ErrorSystem | None = None
    floor: float = 0.0
    floor_frequency: float = 0.0
    _top: float = 0.0
    _cap_frequencies: Array = field(default_factory=lambda: np.zeros(0))

    def theta(self, y: Array) -> Array:
        """Parameters at the coordinates `y`."""
        return self.theta0 + self.T @ y

    def admissible(self, theta: Array) -> bool:
        """Whether the gray-box model keeps (most of) the margin, and the cap."""
        if not np.isfinite(theta).all() or not self.limits.admissible(theta):
            return False
        if self.capped is None:
            return True
        found = self.capped.peaks(theta, 1e-3)
        high = found.frequencies[found.values > self.cap * (1.0 + _CAP_TOLERANCE)]
        if high.size:  # bounded there from now on, by a smooth constraint
            known = np.concatenate([self._cap_frequencies, high])
            self._cap_frequencies = np.unique(known)[-_MAX_CAPS:]
        return high.size == 0

    def peaks(self, y: Array) -> Peaks | None:
        """Peaks that depend on the parameters; None where `y` is not admissible."""
        theta = self.theta(y)
        if not self.admissible(theta):
            return None
        within = _DEPTH
        if self.floor > 0 and self._top > 0:
            within = max(_DEPTH, 1.0 - (1.0 - _DEPTH) * self._top / self.floor)
        for depth in (within, *(h for h in _HARD_STEPS if h > within), 1.0):
            found = self.system.peaks(theta, min(depth, 1.0 - 1e-9))
            _, gradients = self.system.gradients(theta, found.frequencies)
            gradients = gradients @ self.T
            steep = np.linalg.norm(gradients, axis=1) > _FLAT * found.values
            if not steep.all():
                flat = found.frequencies[~steep]
                steep[~steep] = ~self.system.constant_at(theta, flat)
            if found.norm == 0.0 or steep.any():
                break
        if not steep.all():
            high = int(np.argmax(np.where(steep, -np.inf, found.values)))
            if found.values[high] > self.floor:
                self.floor = float(found.values[high])
                self.floor_frequency = float(found.frequencies[high])
        if not steep.any():  # nothing is left that the parameters could lower
            none = np.zeros(1)
            return Peaks(none, none, np.zeros((1, len(y))), np.zeros(1, bool))
        peaks = Peaks(
            found.values[steep],
            found.frequencies[steep],
            gradients[steep],
            np.full(int(steep.sum()), self.system.peaks_move),
        )
        self._top = peaks.top
        return peaks

    def samples(self, y: Array, omega: Array) -> Peaks:
        """Singular values at fixed frequencies, and their gradients."""
        values, gradients = self.system.gradients(self.theta(y), omega)
        return Peaks(values, omega, gradients @ self.T, np.zeros(len(omega), bool))

    def values(self, y: Array, omega: Array) -> Array:
        """Singular values at fixed frequencies, infinite where there is no model."""
        theta = self.theta(y)
        if not np.isfinite(self.system.poles(theta)).all():
            return np.full(len(omega), np.inf)
        return self.system.values(theta, omega)

    def hessians(self, y: Array, omega: Array, moving: Flags) -> Array:
        """Second derivatives of the peaks in the coordinates y."""
        H = self.system.hessians(self.theta(y), omega, moving)
        return self.T.T @ H @ self.T

    def constraints(self, y: Array) -> tuple[Array, Array]:
        """The limits, relative to their sizes, and the cap, with gradients."""
        theta = self.theta(y)
        c, dc, size = self.limits.rows(theta)
        c, dc = c / size, dc @ self.T / size[:, None]
        if self.capped is None or self._cap_frequencies.size == 0:
            return c, dc
        values, slopes = self.capped.gradients(theta, self._cap_frequencies)
        return (
            np.concatenate([c, values / self.cap - 1.0]),
            np.vstack([dc, slopes @ self.T / self.cap]),
        )

    def curve(self, y: Array) -> Geodesics:
        """Geodesics of the response through `y`."""
        return Geodesics(self, self.theta(y))

    def problem(self) -> MinimaxProblem:
        """The callbacks of the minimax solvers."""
        return MinimaxProblem(
            self.peaks,
            self.samples,
            self.values,
            self.hessians,
            self.constraints,
            self.grid,
            self.curve,
        )


class Geodesics:
    """Geodesics of the response through one theta, in the coordinates of a problem."""

    def __init__(self, objective: HinfObjective, theta: Array) -> None:
        self._geometry = ResponseGeometry(objective.system, theta, objective.grid, 1.0)
        self._system, self._theta, self._T = objective.system, theta, objective.T
        self._inverse = np.linalg.inv(objective.T)
        self._local = self._geometry.inverse @ objective.T

    def step(self, d: Array) -> Array:
        """End of the geodesic that leaves along `d`, within the parameters' bounds."""
        local = self._local @ d
        a = self._geometry.acceleration(local)
        most = _BENT * float(np.linalg.norm(local))
        a *= min(1.0, most / max(float(np.linalg.norm(a)), 1e-300))
        end = self._theta + self._T @ d + 0.5 * self._geometry.T @ a
        return self._inverse @ (within_bounds(self._system, end) - self._theta)

    def curvature(self, gradient: Array) -> Array:
        """What the bend of the geodesics adds to a Hessian of that gradient."""
        local = np.asarray(np.linalg.solve(self._local.T, gradient))
        normal = -self._geometry.tangential(local)
        return self._local.T @ self._geometry.second_derivatives(normal) @ self._local
