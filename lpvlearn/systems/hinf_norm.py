"""H-infinity and L-infinity norm with every peak of the largest singular value.

Level sets of the Hamiltonian (Boyd and Balakrishnan 1990, Bruinsma and
Steinbuch 1990), started from a lower bound that is already a refined peak.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .level_sets import LevelSets
from .peaks import Peak, PeakRefiner
from .response import FrequencyEngine
from .singular_values import sigma_max

__all__ = ["PeakSet", "hinf_norm", "linf_norm"]

_EPS = float(np.finfo(float).eps)

# A pole this close to the boundary, relative to its modulus, is on it.
_POLE_ON_AXIS = 1e-13

_MAX_LEVELS = 40

# Samples around a pole, in units of its distance from the boundary.
_OFFSETS = np.array([[-8.0, -3.0, -1.0, -0.4, 0.0, 0.4, 1.0, 3.0, 8.0]]).T

_ENDS = np.array([0.0, np.inf])

_FRACTIONS = (np.arange(10) + 0.5) / 10


@dataclass(frozen=True, eq=False)
class PeakSet:
    """Norm of a system and the frequencies where it is attained, or nearly.

    Attributes
    ----------
    norm : float
        Largest value of the largest singular value over frequency.
    frequencies : ndarray of shape (n_peaks,)
        Peak frequencies in rad/s, the highest peak first. May hold 0 and, in
        continuous time, infinity; in discrete time pi/dt.
    values : ndarray of shape (n_peaks,)
        Largest singular value at these frequencies, descending.
    """

    norm: float
    frequencies: NDArray
    values: NDArray


def linf_norm(
    A: NDArray,
    B: NDArray,
    C: NDArray,
    D: NDArray,
    *,
    dt: float | None = None,
    within: float | None = None,
    rtol: float = 1e-10,
) -> PeakSet:
    r"""L-infinity norm and peaks of the frequency response.

    .. math:: \|G\|_\infty = \sup_\omega \sigma_{\max}(G(j\omega))

    Finite also for an unstable system, as long as no pole lies on the boundary
    (imaginary axis or unit circle); infinite otherwise.

    Parameters
    ----------
    A, B, C, D : ndarrays of floats
        Shapes (n, n), (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs).
    dt : float or None, default None
        Sampling time in seconds; None for continuous time.
    within : float or None, default None
        None: one frequency where the norm is attained. A number in [0, 1):
        every local maximum whose value is at least (1 - within) times the norm.
    rtol : float, default 1e-10
        Relative height above the bound found at which the level set must be
        empty.

    Returns
    -------
    peaks : PeakSet

    Raises
    ------
    ValueError
        If `within` is not in [0, 1).

    References
    ----------
    .. [1] N. A. Bruinsma, M. Steinbuch, "A fast algorithm to compute the
       H-infinity norm of a transfer function matrix", Systems & Control
       Letters 14, 1990.

    Examples
    --------
    A second-order lag with damping 0.1 peaks at 1 / (2 z sqrt(1 - z**2)):

    >>> import numpy as np
    >>> A, B = np.array([[0.0, 1.0], [-1.0, -0.2]]), np.array([[0.0], [1.0]])
    >>> C, D = np.array([[1.0, 0.0]]), np.zeros((1, 1))
    >>> peaks = linf_norm(A, B, C, D, within=0.9)
    >>> round(peaks.norm, 9), peaks.frequencies.round(9)
    (5.025189076, array([0.98994949]))
    """
    _check_fraction(within)
    if len(A) == 0:
        return _constant(D)
    return _Search(A, B, C, D, dt, rtol).run(within)


def hinf_norm(
    A: NDArray,
    B: NDArray,
    C: NDArray,
    D: NDArray,
    *,
    dt: float | None = None,
    within: float | None = None,
    rtol: float = 1e-10,
) -> PeakSet:
    """H-infinity norm and peaks: `linf_norm` of a stable system, else infinity.

    Parameters
    ----------
    A, B, C, D, dt, within, rtol
        As in `linf_norm`.

    Returns
    -------
    peaks : PeakSet
        With norm infinity and no frequencies when a pole lies in the closed
        right half plane or not inside the open unit disc.

    Raises
    ------
    ValueError
        If `within` is not in [0, 1).

    Examples
    --------
    >>> import numpy as np
    >>> one = np.ones((1, 1))
    >>> hinf_norm(-one, one, one, 0 * one).norm
    1.0
    >>> hinf_norm(one, one, one, 0 * one).norm
    inf
    """
    _check_fraction(within)
    if len(A) == 0:
        return _constant(D)
    search = _Search(A, B, C, D, dt, rtol)
    if (search.depth >= -search.on_boundary).any():
        return PeakSet(np.inf, np.empty(0), np.empty(0))
    return search.run(within)


def _check_fraction(within: float | None) -> None:
    if within is not None and not 0.0 <= within < 1.0:
        raise ValueError(
            "`within` must be None, for one peak, or a fraction of the norm in "
            f"[0, 1). Got {within}."
        )


def _constant(D: NDArray) -> PeakSet:
    gain = np.array([sigma_max(D[:, :, None])[0]])
    return PeakSet(float(gain[0]), np.zeros(1), gain)


class _Search:
    """The search on one system; frequencies are angles in discrete time."""

    def __init__(
        self,
        A: NDArray,
        B: NDArray,
        C: NDArray,
        D: NDArray,
        dt: float | None,
        rtol: float,
    ) -> None:
        self.engine = FrequencyEngine(A, B, C, D, discrete=dt is not None)
        self.unit = 1.0 if dt is None else dt
        self.rtol = rtol
        self.refiner = PeakRefiner(self.engine)
        p = self.engine.poles
        size = np.abs(p)
        self.angles = p.imag if dt is None else np.angle(p + 1.0)
        # Signed distance from the boundary; in delta form half of |1 + p|^2 - 1.
        self.depth = p.real if dt is None else p.real + 0.5 * size * size
        self.on_boundary = _POLE_ON_AXIS * np.maximum(size, _EPS * size.max())

    def run(self, within: float | None) -> PeakSet:
        """Find the norm, then, if asked, the other peaks."""
        engine = self.engine
        bad = np.abs(self.depth) <= self.on_boundary
        if bad.any():
            if not engine.B.any() or not engine.C.any():
                return _constant(engine.D)
            angle = np.abs(self.angles[bad][:1])
            return PeakSet(np.inf, angle / self.unit, np.array([np.inf]))
        w, s = self.refiner.sampled(self._grid())
        top = int(s.argmax())
        if s[top] == 0.0:
            return PeakSet(0.0, w[[top]] / self.unit, s[[top]])
        levels = LevelSets(engine)
        if within is None:
            peaks = self.refiner.highest(w, s, 0.8 * s[top])
            return self._result(self._raised(peaks, levels)[:1])
        level = self.refiner.value(float(w[top])) * (1.0 - within)
        crossings = levels.crossings(level * (1.0 - 1e-6))
        inner = _between(crossings, self.refiner.end, _FRACTIONS)
        w, s = self.refiner.sampled(np.concatenate((w, inner)))
        peaks = self._every(w, s, level)
        raised = self._raised(peaks, levels)
        if len(raised) > len(peaks):
            known = [peak.frequency for peak in raised]
            w, s = self.refiner.sampled(np.append(w, known))
            level = raised[0].value * (1.0 - within)
            peaks = self._every(w, s, level)
        least = peaks[0].value * (1.0 - within) * (1.0 - 1e-12)
        return self._result([peak for peak in peaks if peak.value >= least])

    def _result(self, peaks: list[Peak]) -> PeakSet:
        frequencies = np.array([peak.frequency for peak in peaks]) / self.unit
        values = np.array([peak.value for peak in peaks])
        return PeakSet(peaks[0].value, frequencies, values)

    def _every(self, w: NDArray, s: NDArray, level: float) -> list[Peak]:
        """Every peak above the level, the highest first."""
        peaks = self.refiner.every(w, s, level * (1.0 - 1e-3))
        if not peaks:  # only slopes of rounding noise: a plateau is one peak
            return [Peak(float(w[s.argmax()]), float(s.max()), 0.0)]
        return sorted(peaks, key=_value, reverse=True)

    def _raised(self, peaks: list[Peak], levels: LevelSets) -> list[Peak]:
        """Raise the bound by refined peaks until the level set above is empty.

        Returns the peaks with those found on the way, the highest first.
        """
        peaks = sorted(peaks, key=_value, reverse=True)
        for _ in range(_MAX_LEVELS):
            best = peaks[0].value
            if best == 0.0:
                break
            crossings = levels.crossings(best * (1.0 + 2.0 * self.rtol))
            # Just above a peak the level set is empty, but nearly tangent.
            if all(any(p.covers(w) for p in peaks) for w in crossings.tolist()):
                break
            w, s = self.refiner.sampled(_between(crossings, self.refiner.end, 0.5))
            new = self.refiner.highest(w, s, best * (1.0 - 1e-6), peaks)
            if not any(peak.value > best * (1.0 + self.rtol) for peak in new):
                break
            peaks = sorted(peaks + new, key=_value, reverse=True)
        return peaks

    def _grid(self) -> NDArray:
        """Frequencies resolved in units of every pole's distance."""
        upper = np.flatnonzero(self.engine.poles.imag >= 0.0)
        depth = np.abs(self.depth[upper])
        centre = np.abs(self.angles[upper])
        if self.engine.discrete:
            depth = np.minimum(depth, 1.0)
        near = np.abs((centre + depth * _OFFSETS).ravel())
        square = centre * centre
        resonance = np.sqrt(np.maximum(square - depth * depth, 0.0))
        size = np.sqrt(square + depth * depth)
        if not self.engine.discrete:
            span = _ladder(0.01 * size.min(), 1e3 * size.max(), 24)
            return np.concatenate((_ENDS, near, size, resonance, span))
        near = np.abs(np.remainder(near + np.pi, 2.0 * np.pi) - np.pi)
        rest = np.hypot(np.pi - centre, depth).min()
        low = _ladder(0.01 * min(size.min(), np.pi), np.pi, 20)
        high = np.pi - _ladder(0.01 * rest, 1.0, 12)
        w = np.concatenate(([0.0], near, resonance, low, high, [np.pi]))
        return np.minimum(w, np.pi)


def _value(peak: Peak) -> float:
    return peak.value


def _ladder(low: float, high: float, count: int) -> NDArray:
    """Geometric sequence; NumPy's own is too slow here."""
    return low * (high / low) ** (np.arange(count) / (count - 1))


def _between(crossings: NDArray, end: float, fractions: NDArray | float) -> NDArray:
    """Crossings and samples in each interval between them."""
    if len(crossings) == 0:
        return np.array([0.0])
    edges = np.concatenate(([0.0], crossings))
    inner = edges[:-1, None] + np.diff(edges)[:, None] * np.atleast_1d(fractions)
    middle = np.sqrt(edges[:-1] * edges[1:])
    last = 10.0 * edges[-1] if np.isinf(end) else 0.5 * (edges[-1] + end)
    return np.concatenate((edges, inner.ravel(), middle, [last, end]))
