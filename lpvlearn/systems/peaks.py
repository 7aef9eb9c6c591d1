"""Refine local maxima of the largest singular value between samples."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .response import FrequencyEngine
from .singular_values import sigma_max, square_derivatives, square_jet

_TINY = float(np.finfo(float).tiny)

# Two maxima are one unless the singular value dips by this much between them: above
# the rounding of a modal sum, 1e-13 to 1e-12 of its size.
_DIP = 1e-11

# Closer than this, in units of the width, a dip between two would be smaller: a
# parabola falls by the square.
_SAME = 1e-6

# Offset from a peak, in units of its width, up to which its parabola is trusted to a
# few parts in 1e7.
_COVERED = 1e-3

# Modal values with a smaller bound on their relative error are not solved anew.
_TRUSTED = 1e-9

# Rounds of subdivision, by four each, where samples leave the sign of the slope in
# doubt: a thousandth of the distance of two samples.
_MAX_SPLITS = 5

# Newton's method needs three to six steps; the rest is for bisection of a bracket.
_MAX_NEWTON = 40

# Convergence is quadratic: a step that gains this part of the value is the last.
_LAST_GAIN = 1e-9

# Stands for an infinite frequency, where nothing but the feedthrough is left.
_FAR = 1e200

# Places of the samples in an interval that may hold maxima: ten tell three apart.
TENTHS = (np.arange(10) + 0.5) / 10

# Maxima refined per round, and how far below the best they may be expected: the
# parabola through samples is good to a few per cent, and the level set shows the rest.
_MAX_CANDIDATES = 6
_SAMPLED = 0.02

# How far a search may go from the last sample towards infinity, as a factor.
_REACH = 1e3


class Peak(NamedTuple):
    """A refined local maximum; the width is that of the parabola at its top."""

    frequency: float
    value: float
    width: float

    def covers(self, frequency: float) -> bool:
        """Whether the gain there is that of the peak, up to a few parts in 1e7."""
        return abs(frequency - self.frequency) <= _COVERED * self.width


class _Bracket(NamedTuple):
    """A maximum of the samples, where it is expected, and the samples beside it."""

    at: float
    vertex: float
    lower: float
    upper: float
    sampled: float
    expected: float


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
    >>> [round(peak.frequency, 9) for peak in refiner.every(w, s, floor=1.0)]
    [0.989949494]
    """

    def __init__(self, engine: FrequencyEngine) -> None:
        self.engine = engine
        self.end = np.pi if engine.discrete else np.inf

    def sampled(self, omega: NDArray) -> tuple[NDArray, NDArray]:
        """Sort frequencies, drop repetitions, evaluate by the fast form."""
        w = np.sort(omega)
        rises = w[1:] > w[:-1]
        if not rises.all():
            w = w[np.append(True, rises)]
        return w, sigma_max(self.engine.response(np.minimum(w, _FAR)))

    def highest(
        self, w: NDArray, s: NDArray, floor: float, known: list[Peak] | None = None
    ) -> list[Peak]:
        """Refine the highest local maxima of the samples, one after the other.

        The known ones are left out, and those that their samples put clearly
        below the best: the level set above it shows whether that was wrong.
        """
        padded = np.concatenate(([-1.0], s, [-1.0]))
        tops = (s >= floor) & (s >= padded[:-2]) & (s >= padded[2:])
        index = np.flatnonzero(tops)
        if len(index) > 1:
            index = index[_apart(index, s[index], s)]
        brackets = [self._bracket(w, s, k) for k in index.tolist()]
        brackets = [b for b in brackets if not _is_known(b, known or [])]
        brackets.sort(key=lambda bracket: bracket.expected, reverse=True)
        peaks: list[Peak] = []
        best = floor
        for bracket in brackets[:_MAX_CANDIDATES]:
            if bracket.expected < best * (1.0 - _SAMPLED):
                break
            peaks.append(self._climbed(bracket))
            best = max(best, peaks[-1].value)
        return peaks

    def _bracket(self, w: NDArray, s: NDArray, k: int) -> _Bracket:
        """A maximum of the samples, its neighbours and the vertex between them.

        One mode alone makes 1 / s**2 a parabola, whose vertex is then the peak.
        """
        at, top = float(w[k]), float(s[k])
        if k == 0 or at == self.end:
            return _Bracket(at, at, at, at, top, top)
        lower, upper = float(w[k - 1]), float(w[k + 1])
        if math.isinf(upper):
            return _Bracket(at, at, lower, _REACH * at, top, top)
        least = 1e-6 * top + _TINY  # keeps 1 / s^2 finite beside a zero of G
        back, ahead = at - lower, upper - at
        fall = ((top / max(float(s[k - 1]), least)) ** 2 - 1.0) / back
        rise = ((top / max(float(s[k + 1]), least)) ** 2 - 1.0) / ahead
        slope = (rise * back - fall * ahead) / (back + ahead)
        bend = 2.0 * (fall + rise) / (back + ahead)
        vertex = at - slope / bend if bend > 0.0 else upper
        if not lower < vertex < upper:
            return _Bracket(at, at, lower, upper, top, top)
        dip = 0.5 * slope * slope / bend
        # A parabola that promises more than the root of two has missed a narrow peak.
        expected = top / math.sqrt(max(1.0 - dip, 0.5))
        return _Bracket(at, vertex, lower, upper, top, expected)

    def _climbed(self, bracket: _Bracket) -> Peak:
        """The peak in a bracket, from the vertex or else from the sample."""
        if bracket.lower == bracket.upper:
            return Peak(bracket.at, self.value(bracket.at), 0.0)
        peak = self._climb(*bracket[1:4], quick=self.engine.is_modal)
        if peak.value >= bracket.sampled * (1.0 - _TRUSTED):
            return peak
        # Newton's method has left a peak on another branch, or modes are wrong.
        again = self._climb(bracket.at, *bracket[2:4])
        sample = Peak(bracket.at, self.value(bracket.at), 0.0)
        return max(peak, again, sample, key=lambda found: found.value)

    def value(self, w: float) -> float:
        """Largest singular value at one frequency, accurately."""
        G = self.engine.jet(w)[0] if w < np.inf else self.engine.D
        return float(sigma_max(G[:, :, None])[0])

    def _climb(self, w: float, lower: float, upper: float, quick: bool = False) -> Peak:
        """Safeguarded Newton steps on 1 / sigma**2, a parabola near one mode.

        The values are those of factorisations; if `quick`, only the first step
        is by modes. Rounding may have moved the bracket a little off the peak.
        """
        margin = 3e-3 * (upper - lower)  # rounding is far below, another peak above
        lower, upper = max(lower - margin, 0.0), min(upper + margin, self.end)
        for _ in range(_MAX_NEWTON):
            if quick:
                G, G1, G2 = self.engine.derivatives(np.array([w]))
                value, slope, bend = square_jet(G[:, :, 0], G1[:, :, 0], G2[:, :, 0])
            else:
                value, slope, bend = square_jet(*self.engine.jet(w))
            if value == 0.0:
                break
            if not quick:
                lower, upper = (w, upper) if slope > 0.0 else (lower, w)
            bend = 2.0 * slope * slope / value - bend
            step = slope / bend if bend > 0.0 else math.inf
            good = lower <= w + step <= upper
            # Without a step the slope must be flat over a thousand brackets.
            gain = abs(slope * (step if good else 1e3 * (upper - lower)))
            if gain <= _LAST_GAIN * value and not quick:
                if good:
                    w, value = w + step, value + 0.5 * gain
                break
            if good:
                w += step
            elif upper < 10.0 * lower:
                w = 0.5 * (lower + upper)
            else:
                w = math.sqrt(max(lower, 0.01 * upper) * upper)
            quick = False
        return Peak(w, math.sqrt(value), math.sqrt(value / bend) if bend > 0.0 else 0.0)

    def every(self, w: NDArray, s: NDArray, floor: float) -> list[Peak]:
        """Every local maximum above the floor, by increasing frequency."""
        starts = self._starts(w, s, floor)
        found = self._newton(starts)
        ends = [0] if s[0] >= s[1] else []
        ends += [len(w) - 1] if w[-1] == self.end and s[-1] >= s[-2] else []
        peaks = [Peak(*peak) for peak in found.T.tolist()]
        peaks += [Peak(float(w[k]), float(s[k]), 0.0) for k in ends]
        if not peaks:
            return []
        peaks = _merged(sorted(peaks))
        kept = self._separated(peaks, w, s)
        if len(kept) < len(peaks):  # no sample dips between some of them: look closer
            at = np.array([peak.frequency for peak in peaks])
            at = at[at < np.inf]
            mesh = at[:-1] + np.diff(at) * TENTHS[:, None]
            closer = np.concatenate((w, mesh.ravel(), starts[1:].ravel()))
            kept = self._separated(peaks, *self.sampled(closer))
        return self._certain(kept)

    def _separated(self, peaks: list[Peak], w: NDArray, s: NDArray) -> list[Peak]:
        index = w.searchsorted([peak.frequency for peak in peaks])
        return [peaks[k] for k in _apart(index, [peak.value for peak in peaks], s)]

    def _starts(self, w: NDArray, s: NDArray, floor: float) -> NDArray:
        """Starting points of Newton's method and their brackets, in three rows."""
        high = s >= floor
        high[1:] |= high[:-1].copy()
        high[:-1] |= high[1:].copy()
        if w[-1] == np.inf:
            high[-1] = False
        at = np.flatnonzero(high)
        if len(at) == 0:  # the only high sample is at infinity
            return np.empty((3, 0))
        jets = self._jets(w[at])
        # By symmetry the slope is zero at these ends and the curvature decides.
        if w[at[0]] == 0.0:
            jets[2, 0] = _TINY * jets[3, 0]
        if w[at[-1]] == self.end:
            jets[2, -1] = -_TINY * jets[3, -1]
        # A maximum of the samples may lie between slopes that are only noise.
        inner = np.flatnonzero((at > 0) & (at < len(w) - 1))
        k = at[inner]
        tops = (s[k] >= floor) & (s[k] >= s[k - 1]) & (s[k] >= s[k + 1])
        inner, k = inner[tops], k[tops]
        upper = np.minimum(w[k + 1], _REACH * w[k])
        found = [np.concatenate((jets[:, inner], [w[k - 1], upper]))]
        whole = np.flatnonzero(at[1:] == at[:-1] + 1)
        left, right = jets[:, whole], jets[:, whole + 1]
        for _ in range(_MAX_SPLITS):
            found.append(_aimed(left, right))
            doubt = _may_turn_twice(left, right)
            if not doubt.any():
                break
            left, right = left[:, doubt], right[:, doubt]
            middle = left[0] + (right[0] - left[0]) * np.array([[0.25], [0.5], [0.75]])
            points = self._jets(middle.ravel()).reshape(4, 3, -1)
            points = np.concatenate((left[:, None], points, right[:, None]), axis=1)
            left = points[:, :-1].reshape(4, -1)
            right = points[:, 1:].reshape(4, -1)
        return _stepped(np.concatenate(found, axis=1))

    def _jets(self, w: NDArray) -> NDArray:
        """Frequency, squared singular value, its slope and its curvature."""
        return np.array((w, *square_derivatives(*self.engine.derivatives(w))))

    def _newton(self, starts: NDArray) -> NDArray:
        """As `_climb`, by modes and from many points: frequency, value and width.

        Twice the same steps: scalars make `_climb` three times as fast on one point.
        """
        w, lower, upper = starts
        for _ in range(_MAX_NEWTON):
            value, slope, bend = square_derivatives(*self.engine.derivatives(w))
            rising = slope > 0.0
            lower, upper = np.where(rising, w, lower), np.where(rising, upper, w)
            bend = 2.0 * slope * slope / (value + _TINY) - bend
            concave = bend > 0.0
            bend = np.where(concave, bend, np.inf)
            step = slope / bend
            target = w + step
            good = concave & (target >= lower) & (target <= upper)
            gain = np.abs(slope * np.where(good, step, 1e3 * (upper - lower)))
            if (gain <= _LAST_GAIN * value).all():
                w = np.where(good, target, w)
                value = np.where(good, value + 0.5 * gain, value)
                break
            if good.all():
                w = target
                continue
            middle = np.where(
                upper < 10.0 * lower,
                0.5 * (lower + upper),
                np.sqrt(np.maximum(lower, 0.01 * upper) * upper),
            )
            w = np.where(good, target, middle)
        return np.array((w, np.sqrt(value), np.sqrt(value / bend)))

    def _certain(self, peaks: list[Peak]) -> list[Peak]:
        """Solve anew where modal values may be wrong."""
        w = np.array([peak.frequency for peak in peaks])
        error = self.engine.uncertainty(np.minimum(w, _FAR)).tolist()
        return [
            peak if bound <= _TRUSTED * peak.value else self._solved(peak)
            for peak, bound in zip(peaks, error, strict=True)
        ]

    def _solved(self, peak: Peak) -> Peak:
        w, _, width = peak
        if width > 0.0:
            solved = self._climb(w, max(w - width, 0.0), min(w + width, self.end))
            if abs(solved.frequency - w) < 0.5 * width:
                return solved
        # Noise or an end of the axis: no peak to climb, but still its value.
        return Peak(w, self.value(w), width)


def _is_known(bracket: _Bracket, peaks: list[Peak]) -> bool:
    return any(
        peak.covers(bracket.vertex)
        and bracket.expected <= peak.value * (1.0 + _TRUSTED)
        for peak in peaks
    )


def _merged(peaks: list[Peak]) -> list[Peak]:
    """Keep one of neighbours too close for a dip between them to show."""
    kept = peaks[:1]
    for peak in peaks[1:]:
        last = kept[-1]
        if peak.frequency - last.frequency > _SAME * max(peak.width, last.width):
            kept.append(peak)
        elif peak.value > last.value:
            kept[-1] = peak
    return kept


def _stepped(aimed: NDArray) -> NDArray:
    """First Newton step within the brackets, where it can: point, bracket."""
    w, value, slope, bend, lower, upper = aimed
    bend = 2.0 * slope * slope / (value + _TINY) - bend
    target = w + slope / np.where(bend > 0.0, bend, np.inf)
    inside = (target >= lower) & (target <= upper)
    return np.array((np.where(inside, target, w), lower, upper))


def _aimed(left: NDArray, right: NDArray) -> NDArray:
    """Newton starts (jets) and brackets, for intervals with a maximum inside.

    Both ends start if both aim into the interval: where two branches of the
    singular value cross they find one maximum each.
    """
    turns = (left[2] >= 0) & (right[2] <= 0)
    left, right = left[:, turns], right[:, turns]
    bracket = np.array((left[0], right[0]))
    # Concave, and the Newton step from there ends inside.
    width = bracket[1] - bracket[0]
    use_right = (right[3] < 0) & (right[2] >= width * right[3])
    use_left = (left[3] < 0) & (left[2] <= -width * left[3]) | ~use_right
    from_left = np.concatenate((left, bracket))[:, use_left]
    from_right = np.concatenate((right, bracket))[:, use_right]
    return np.concatenate((from_left, from_right), axis=1)


def _may_turn_twice(left: NDArray, right: NDArray) -> NDArray:
    """Whether a maximum may hide between slopes of equal sign.

    From the slope of the cubic through both ends, and where the slope at one end,
    by its curvature, changes sign before the other.
    """
    h = right[0] - left[0]
    sign = np.sign(left[2])
    steepness = 1.5 * (right[1] - left[1]) / h - 0.25 * (left[2] + right[2])
    least = np.minimum(np.abs(left[2]), np.abs(right[2]))
    ahead = sign * (left[2] + h * left[3])
    behind = sign * (right[2] - h * right[3])
    # A cubic that keeps a tenth of the slope at both ends in its middle does not turn.
    doubtful = (sign * steepness < 0.1 * least) | (ahead < 0) | (behind < 0)
    matters = least * h > _DIP * left[1]
    return (left[2] * right[2] > 0) & doubtful & matters


def _apart(index: NDArray, values: NDArray | list[float], s: NDArray) -> list[int]:
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
