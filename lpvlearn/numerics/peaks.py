"""Refine local maxima of the largest singular value between samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lpvlearn.numerics.frequency import FrequencyEngine
from lpvlearn.numerics.singular_values import (
    sigma_max,
    square_derivatives,
    square_slope,
)

__all__ = ["PeakRefiner"]

_TINY = float(np.finfo(float).tiny)
_EPS = float(np.finfo(float).eps)
# Two maxima are one unless the singular value dips by this much between them.
_DIP = 1e-11
# Modal values with a smaller bound on their relative error are not solved anew.
_TRUSTED = 1e-9
# Rounds of subdivision where samples leave the sign of the slope in doubt.
_MAX_SPLITS = 5
_MAX_NEWTON = 40
_MAX_SOLVES = 6
_FRACTIONS = (np.arange(10) + 0.5) / 10


class PeakRefiner:
    """Finds the maxima of the largest singular value near given samples.

    Parameters
    ----------
    engine : FrequencyEngine

    Attributes
    ----------
    end : float
        The end of the frequency axis: infinity, or pi in discrete time.

    Examples
    --------
    >>> import numpy as np
    >>> A, B = np.array([[0.0, 1.0], [-1.0, -0.2]]), np.array([[0.0], [1.0]])
    >>> C, D = np.array([[1.0, 0.0]]), np.zeros((1, 1))
    >>> refiner = PeakRefiner(FrequencyEngine(A, B, C, D))
    >>> w, s = refiner.sampled(np.array([np.inf, 0.0, 0.5, 1.0, 2.0]))
    >>> peaks, values = refiner.every(w, s, floor=1.0)
    >>> peaks.round(9)
    array([0.98994949])
    """

    def __init__(self, engine: FrequencyEngine) -> None:
        self.engine = engine
        self.end = np.pi if engine.discrete else np.inf

    def sampled(self, omega: NDArray) -> tuple[NDArray, NDArray]:
        """Sort frequencies, drop repetitions, evaluate by the fast form."""
        w = np.sort(omega)
        w = w[np.concatenate(([True], w[1:] > w[:-1]))]
        s = np.empty(len(w))
        finite = len(w) - int(w[-1] == np.inf)
        s[:finite] = sigma_max(self.engine.response(w[:finite]))
        s[finite:] = sigma_max(self.engine.D[:, :, None])
        return w, s

    def highest(
        self, w: NDArray, s: NDArray, floor: float
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Highest local maxima of the samples: frequency, value, width."""
        rises = np.concatenate(([True], s[1:] >= s[:-1]))
        falls = np.concatenate((s[:-1] >= s[1:], [True]))
        index = np.flatnonzero(rises & falls & (s >= floor))
        if len(index) > 1:
            index = index[_apart(index, s[index], s)]
        peaks, values = w[index], s[index]
        curvature = np.full(len(index), -np.inf)
        inside = (index > 0) & (peaks < self.end)
        if inside.any():
            start, vertex, bracket = _brackets(w, s, index[inside])
            newton = self._newton(vertex, *bracket)
            if (newton[1] < values[inside] * (1.0 - 1e-9)).any():
                # The vertex has left a peak that stands on another branch.
                newton = self._newton(start, *bracket)
            peaks[inside], values[inside], curvature[inside] = newton
        if len(index) > 1:
            top = values >= values.max() * (1.0 - 1e-3)
            peaks, values, curvature = peaks[top], values[top], curvature[top]
        return self._certain(peaks, values, curvature)

    def every(self, w: NDArray, s: NDArray, floor: float) -> tuple[NDArray, NDArray]:
        """Every local maximum above the floor: frequency and value."""
        starts, lower, upper = self._starts(w, s, floor)
        peaks, values, bend = self._newton(starts, lower, upper)
        ends = [0] if s[0] >= s[1] else []
        ends += [len(w) - 1] if w[-1] == self.end and s[-1] >= s[-2] else []
        peaks, values = np.append(peaks, w[ends]), np.append(values, s[ends])
        bend = np.append(bend, np.full(len(ends), -np.inf))
        order = np.argsort(peaks)
        peaks, values, bend = peaks[order], values[order], bend[order]
        finite = peaks[np.isfinite(peaks)]
        if len(finite) > 1:
            mesh = finite[:-1, None] + np.diff(finite)[:, None] * _FRACTIONS
            w, s = self.sampled(np.concatenate((w, mesh.ravel())))
        keep = _apart(np.searchsorted(w, peaks), values, s)
        peaks, values, _ = self._certain(peaks[keep], values[keep], bend[keep])
        return peaks, values

    def _starts(
        self, w: NDArray, s: NDArray, floor: float
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Starting points of Newton's method and their brackets."""
        # A maximum of the samples may lie between slopes that are only noise.
        rises, falls = s[1:-1] >= s[:-2], s[1:-1] >= s[2:]
        top = 1 + np.flatnonzero(rises & falls & (s[1:-1] >= floor))
        start, _, bracket = _brackets(w, s, top)
        found = [np.array((start, *bracket))]
        high = s >= floor
        high[1:] |= high[:-1].copy()
        high[:-1] |= high[1:].copy()
        at = np.flatnonzero(high & np.isfinite(w))
        if len(at) == 0:  # the only high sample is at infinity
            return tuple(found[0])
        jets = self._jets(w[at])
        # By symmetry the slope is zero at these ends and the curvature decides.
        if w[at[0]] == 0.0:
            jets[2, 0] = _TINY * jets[3, 0]
        if w[at[-1]] == self.end:
            jets[2, -1] = -_TINY * jets[3, -1]
        whole = np.diff(at) == 1
        left, right = jets[:, :-1][:, whole], jets[:, 1:][:, whole]
        for _ in range(_MAX_SPLITS):
            found.append(_aimed(left, right))
            doubt = _may_turn_twice(left, right)
            if not doubt.any():
                break
            left, right = left[:, doubt], right[:, doubt]
            inner = left[0] + (right[0] - left[0]) * np.array([[0.25], [0.5], [0.75]])
            points = self._jets(inner.ravel()).reshape(4, 3, -1)
            points = np.concatenate((left[:, None], points, right[:, None]), axis=1)
            left = points[:, :-1].reshape(4, -1)
            right = points[:, 1:].reshape(4, -1)
        starts, lower, upper = np.concatenate(found, axis=1)
        return starts, lower, upper

    def _jets(self, w: NDArray) -> NDArray:
        """Frequency, squared singular value, its slope and its curvature."""
        return np.array((w, *square_derivatives(*self.engine.derivatives(w))))

    def _newton(
        self, w: NDArray, lower: NDArray, upper: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Safeguarded Newton steps on the square of the singular value."""
        for _ in range(_MAX_NEWTON):
            value, slope, bend = square_derivatives(*self.engine.derivatives(w))
            rising = slope > 0
            lower, upper = np.where(rising, w, lower), np.where(rising, upper, w)
            concave = bend < 0
            step = slope / np.where(concave, -bend, np.inf)
            target = w + step
            good = concave & (target >= lower) & (target <= upper)
            # Convergence is quadratic: a step that gains 1e-9 is the last.
            gain = np.abs(slope * np.where(good, step, 1e3 * (upper - lower)))
            if (gain <= 1e-9 * value).all():
                w = np.where(good, target, w)
                value = np.where(good, value + 0.5 * gain, value)
                break
            middle = np.where(
                upper < 10.0 * lower,
                0.5 * (lower + upper),
                np.sqrt(np.maximum(lower, 0.01 * upper) * upper),
            )
            w = np.where(good, target, middle)
        return w, np.sqrt(value), np.where(concave, bend, -np.inf)

    def _certain(
        self, peaks: NDArray, values: NDArray, curvature: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Solve anew where modal values may be wrong; return widths too."""
        finite = np.isfinite(peaks)
        doubtful = np.zeros(len(peaks), bool)
        error = self.engine.uncertainty(peaks[finite])
        doubtful[finite] = error > _TRUSTED * values[finite]
        if doubtful.any():
            peaks[doubtful], values[doubtful] = self._solved_peaks(
                peaks[doubtful], curvature[doubtful]
            )
        return peaks, values, values / np.sqrt(-curvature)

    def _solved_peaks(self, w: NDArray, curvature: NDArray) -> tuple[NDArray, NDArray]:
        """Evaluate peaks by solves; Newton steps where the slope is not zero."""
        squares, best = np.zeros(len(w)), w
        for _ in range(_MAX_SOLVES):
            square, slope = square_slope(*self.engine.solved(w))
            better = square > squares
            best, squares = np.where(better, w, best), np.maximum(squares, square)
            step = slope / curvature
            if (np.abs(slope * step) <= 1e-11 * squares).all():
                break
            w = np.abs(w - step)
        return best, np.sqrt(squares)


def _brackets(
    w: NDArray, s: NDArray, top: NDArray
) -> tuple[NDArray, NDArray, tuple[NDArray, NDArray]]:
    """Maxima of the samples, the vertices nearby, and the samples beside them.

    One mode alone makes 1 / s**2 a parabola, whose vertex is then the peak.
    """
    after = np.minimum(top + 1, len(w) - 1)
    at, lower, upper = w[top], w[top - 1], w[after]
    bounded = np.isfinite(upper) & (upper > at)
    upper = np.where(bounded, upper, 1e3 * at)
    back, ahead = at - lower, upper - at
    least = 1e-6 * s[top]
    fall = ((s[top] / np.maximum(s[top - 1], least)) ** 2 - 1.0) / back
    rise = ((s[top] / np.maximum(s[after], least)) ** 2 - 1.0) / ahead
    shift = 0.5 * (fall * ahead - rise * back) / (fall + rise + _TINY)
    inside = bounded & (shift > -back) & (shift < ahead)
    return at, np.where(inside, at + shift, at), (lower, upper)


def _aimed(left: NDArray, right: NDArray) -> NDArray:
    """Newton starts with brackets, for intervals with a maximum inside.

    Both ends start if both aim into the interval: where two branches of the
    singular value cross they find one maximum each.
    """
    turns = (left[2] >= 0) & (right[2] <= 0)
    left, right = left[:, turns], right[:, turns]
    lower, upper = left[0], right[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        from_left = lower - left[2] / left[3]
        from_right = upper - right[2] / right[3]
    use_right = (right[3] < 0) & (from_right >= lower)
    use_left = (left[3] < 0) & (from_left <= upper) | ~use_right
    starts = np.concatenate((lower[use_left], upper[use_right]))
    brackets = (
        np.concatenate((bound[use_left], bound[use_right])) for bound in (lower, upper)
    )
    return np.array((starts, *brackets))


def _may_turn_twice(left: NDArray, right: NDArray) -> NDArray:
    """Whether a maximum may hide between slopes of equal sign.

    From the slope of the cubic through both ends, and from the curvatures.
    """
    h = right[0] - left[0]
    sign = np.sign(left[2])
    steepness = 1.5 * (right[1] - left[1]) / h - 0.25 * (left[2] + right[2])
    least = np.minimum(np.abs(left[2]), np.abs(right[2]))
    ahead = sign * (left[2] + 0.5 * h * left[3])
    behind = sign * (right[2] - 0.5 * h * right[3])
    doubtful = (sign * steepness < 0.1 * least) | (ahead < 0) | (behind < 0)
    matters = least * h > _DIP * left[1]
    return (left[2] * right[2] > 0) & doubtful & matters


def _apart(index: NDArray, values: NDArray, s: NDArray) -> list[int]:
    """Choose one of neighbouring maxima unless the samples dip between them.

    The maxima stand at, or just before, the samples `index`, in order.
    """
    kept = [0]
    for k in range(1, len(index)):
        last = kept[-1]
        between = s[index[last] : index[k]]
        dip = between.min() if len(between) else np.inf
        if dip < min(values[k], values[last]) * (1.0 - _DIP):
            kept.append(k)
        elif values[k] > values[last]:
            kept[-1] = k
    return kept
