"""What a gray-box model must keep: a stability margin, a speed, and its bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .error_system import ErrorSystem, Target

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Poles that much faster than the black box are those of a mass that went to zero:
# they change nothing any more, and take the digits of all others.
_FASTEST = 1e6
_STANDING = 1e-12  # size of a pole, relative to the fastest, that is none
_MARGIN = 0.02  # stability margin, relative to the slowest decay of the black box
_LEEWAY = 0.2  # part of the margin that a step may use


def growth(poles: Complex, dt: float | None) -> Array:
    """Growth rates (1/s) of poles: negative for stable ones."""
    if dt is None:
        return poles.real
    return np.log(np.maximum(np.abs(poles), 1e-300)) / dt


def natural_margin(target: Target) -> float:
    """The stability margin (1/s) that a black box lets expect."""
    poles = np.linalg.eigvals(target.A).astype(complex)
    slowest = np.abs(growth(poles, target.dt)).min(initial=np.inf)
    return _MARGIN * float(slowest) if np.isfinite(slowest) else 0.0


def keeps_margin(system: ErrorSystem, theta: Array, margin: float) -> bool:
    """Whether every mode of the gray-box model decays faster than `margin` (1/s)."""
    poles = system.poles(theta)
    rate = growth(poles, system.dt)
    if not np.isfinite(rate).all() or rate.max(initial=-np.inf) > -margin:
        return False
    return bool(np.abs(poles).max(initial=0.0) <= speed_limit(system))


def speed_limit(system: ErrorSystem) -> float:
    """Size (1/s) that no pole of the gray-box model may exceed; infinite for none."""
    if system.dt is not None or system.fastest == 0:  # sampling limits it, or nothing
        return np.inf
    return _FASTEST * system.fastest


def within_bounds(system: ErrorSystem, theta: Array) -> Array:
    """`theta` without the rounding errors that pass a bound."""
    return np.clip(theta, system.structure.lower, system.structure.upper)


class Limits:
    """The limits as smooth constraints ``c(theta) <= 0``.

    Growth rates stay below ``-margin`` (1/s).
    """

    def __init__(self, system: ErrorSystem, margin: float) -> None:
        self.system, self.margin = system, margin
        self.speed = speed_limit(system)
        lower, upper = system.structure.lower, system.structure.upper
        self._low = np.flatnonzero(np.isfinite(lower))
        self._high = np.flatnonzero(np.isfinite(upper))

    def admissible(self, theta: Array) -> bool:
        """Whether the gray-box model keeps most of the margin."""
        return keeps_margin(self.system, theta, (1.0 - _LEEWAY) * self.margin)

    def strict(self, theta: Array) -> bool:
        """Whether `theta` is off all limits."""
        poles = self.system.poles(theta)
        if not np.isfinite(poles).all():
            return False
        return bool((self.values(theta, poles) < 0).all())

    def rows(self, theta: Array) -> tuple[Array, Array, Array]:
        """Constraints in their own units, gradients (k, n_params), and typical sizes.

        Growth rates plus the margin, the least share of the speed minus that of every
        pole, and the distances to the finite bounds.
        """
        system, structure = self.system, self.system.structure
        n = system.n
        poles, V = np.linalg.eig(system.model(theta).A)
        W = np.linalg.pinv(V)
        dA = structure.jacobian(theta)[:, :n, :n].reshape(len(theta), n * n)
        d = (W[:, :, None] * V.T[:, None]).reshape(n, n * n) @ dA.T  # w_i dA_j v_i
        size = np.abs(poles)
        if system.dt is not None:
            safe = np.where(poles == 0, 1.0, poles)
            d, size = d / safe[:, None] / system.dt, np.abs(np.log(np.abs(safe)))
            size = size / system.dt
        dc, sizes = [np.real(d)], [np.maximum(size, self.margin)]
        if np.isfinite(self.speed):
            unit = self.speed / _FASTEST
            safe = np.maximum(size, _STANDING * unit)
            turn = np.real(poles.conj()[:, None] * d) / safe[:, None]
            dc.append(unit / safe[:, None] ** 2 * turn)
            sizes.append(np.ones(n))
        eye, low, high = np.eye(len(theta)), self._low, self._high
        span = self.sizes(theta)
        dc += [-eye[low], eye[high]]
        sizes += [span[low], span[high]]
        return self.values(theta, poles), np.vstack(dc), np.concatenate(sizes)

    def scaled(self, theta: Array, T: Array) -> tuple[Array, Array]:
        """Constraints relative to their sizes, and gradients in y, ``theta + T y``."""
        c, dc, size = self.rows(theta)
        return c / size, dc @ T / size[:, None]

    def values(self, theta: Array, poles: Complex) -> Array:
        """The constraints alone, at parameters and poles of their gray-box model."""
        structure = self.system.structure
        c = [growth(poles, self.system.dt) + self.margin]
        if np.isfinite(self.speed):
            unit = self.speed / _FASTEST
            size = np.maximum(np.abs(poles), _STANDING * unit)
            c.append(1.0 / _FASTEST - unit / size)
        c.append((structure.lower - theta)[self._low])
        c.append((theta - structure.upper)[self._high])
        return np.concatenate(c)

    def sizes(self, theta: Array) -> Array:
        """Size of every parameter in its own units: its value, or that of a bound."""
        lower, upper = self.system.structure.lower, self.system.structure.upper
        ends = np.where(np.isfinite([lower, upper]), np.abs([lower, upper]), 0.0)
        size = np.maximum(np.abs(theta), 1e-3 * ends.max(0))
        usual = float(size.max(initial=0.0))
        return np.where(size > 0, size, 1e-3 * usual if usual > 0 else 1.0)

    def inside(self, theta: Array) -> Array:
        """`theta` moved a little off its bounds."""
        lower, upper = self.system.structure.lower, self.system.structure.upper
        size = self.sizes(theta)
        gap = np.minimum(1e-3 * size, 0.25 * (upper - lower))
        return np.clip(theta, lower + gap, upper - gap)
