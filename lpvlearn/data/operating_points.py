"""Operating points: experiments grouped by where the scheduling variable stood."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import Delaunay, QhullError
from scipy.spatial.distance import cdist

from ..exceptions import warn
from ..validation import listed, shown, squarable
from .experiments import Experiment
from .tables import as_numbers

Array = NDArray[np.float64]

# A single record tells a sweep from noise and from oscillations about a point by the
# means of its parts: those of a sweep differ by that share of the whole spread. (White
# noise: below 0.2 of 600 samples; the flexible arm at one point: 0.54 to 0.66.)
_PARTS, _SWEEP = 10, 0.8

# Largest spread of a scheduling variable within a local experiment, relative to its
# range over the points: what moves further has seen several of the models.
_MAX_SPREAD = 0.25

# Points whose least extent is this part of their largest, in units of their ranges,
# are taken for points of a line or plane.
_JOINT = 0.1

# A variable that is constant but for so many steps, of more than this share of its
# range over the points and with so many samples for each, is at several points.
_FEW_STEPS, _STEP, _STILL = 3, 0.05, 10

# A spike is this many times as far from the median of so many samples about it as this
# share of all steps are, and farther than a step that counts.
_SPIKE, _ABOUT, _MOST = 4.0, 7, 0.95
_NAMED = 3  # experiments that a message lists

# White noise of a sensor widens no spread: means over windows are free of it, as long
# as they take away no more than white noise of the variance that third differences
# have (squares of their binomial coefficients add up to 20), but for chance: three
# standard deviations of such a variance, 2.15 / sqrt(n). Third differences of what
# moves are far smaller than what means take away of it, unless it turns every sample.
_DIFFERENCES, _OF_DIFFERENCES, _BY_CHANCE = 3, 20.0, 6.5
_UNUSUAL = 4.0  # times the median of these variances over the records: no noise
_HIDDEN = 4  # windows of a record in which a motion may hide behind noise
_WINDOWS = tuple(2**k + 1 for k in range(1, 24))  # samples, odd: about one of them

_ROUNDING = 1e-6  # of scheduling values, relative to the range they are compared with
_CLOSE = 0.01  # share of the range within which means are one point, if not more
_MANY_VARIABLES = 4  # beyond, a triangulation has too many edges: the nearest points do
_CHAIN = 3  # a chain of neighbours longer than this many tolerances is no single point


@dataclass(frozen=True)
class OperatingPoints:
    """Local experiments by operating point."""

    kappa: Array  # (n_points, n_scheduling); a column of zeros without scheduling
    experiments: list[list[Experiment]]
    moved: Array  # (n_scheduling,), how far each moved within an experiment, at most

    def __len__(self) -> int:
        return len(self.kappa)

    def keep(self, index: Sequence[int]) -> OperatingPoints:
        """Some of the points."""
        chosen = list(index)
        experiments = [self.experiments[k] for k in chosen]
        return replace(self, kappa=self.kappa[chosen], experiments=experiments)

    @property
    def n_longest(self) -> int:
        """Samples of the longest experiment."""
        return max(len(run.rows) for group in self.experiments for run in group)

    @property
    def span(self) -> Array:
        """Smallest and largest scheduling values of the points, (2, n_scheduling)."""
        return np.array([self.kappa.min(axis=0), self.kappa.max(axis=0)])

    @property
    def identified_range(self) -> Array:
        """The span, widened by how far the variables moved within an experiment."""
        low, high = self.span
        slack = self.moved + _ROUNDING * np.maximum(high - low, np.abs(high))
        return np.array([low - slack, high + slack])


def local_experiments(
    experiments: Sequence[Experiment], tol: ArrayLike | None = None
) -> OperatingPoints:
    """Group experiments by operating point, and check that every one is local.

    Warns when all experiments with a scheduling variable are at one point.
    """
    index, kappa = group_operating_points(experiments, tol)
    groups: list[list[Experiment]] = [[] for _ in kappa]
    for run, k in zip(experiments, index, strict=True):
        groups[k].append(run)
    if kappa.shape[1] == 0:
        if len(kappa) > 1:
            raise ValueError(
                "`scheduling` must name the variables that the operating points differ "
                f"in. Got None, with {len(kappa)} values of `operating_point`."
            )
        return OperatingPoints(np.zeros((1, 1)), groups, np.zeros(1))
    _check_local(experiments, kappa)
    _tell_of_mixed(groups, kappa)
    moved = np.max([np.ptp(run.kappa, axis=0) for run in experiments], axis=0)
    if len(kappa) == 1:
        place = ", ".join(
            f"{value:.4g}, moving by {spread:.2g}"
            for value, spread in zip(kappa[0], moved, strict=True)
        )
        warn(
            f"All experiments are at one operating point (scheduling {place}): the "
            "model is time-invariant. Identify at further points for a model that "
            "follows the scheduling variable, or leave `scheduling` out."
        )
    return OperatingPoints(kappa, groups, moved)


def _tell_of_mixed(groups: Sequence[Sequence[Experiment]], kappa: Array) -> None:
    """Warn of labels of operating points that scheduling variables contradict."""
    if any(run.operating_point is None for group in groups for run in group):
        return
    means = [np.array([mean_values(run.kappa) for run in group]) for group in groups]
    every = np.vstack(means)
    unit = np.ptp(every, axis=0) if len(kappa) > 1 else np.abs(every).max(axis=0)
    unit[unit == 0.0] = 1.0
    for k, (group, own) in enumerate(zip(groups, means, strict=True)):
        extent = (np.ptp(own, axis=0) / unit).max()
        still = max((np.ptp(run.kappa, axis=0) / unit).max() for run in group)
        others = np.abs(np.delete(kappa, k, axis=0) - kappa[k]) / unit
        nearest = others.max(axis=1).min() if len(others) else 2.0 * _CLOSE
        if extent > max(0.5 * nearest, _CHAIN * still):
            ends = zip(own.min(axis=0), own.max(axis=0), strict=True)
            places = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in ends)
            warn(
                f"The experiments of operating point {group[0].operating_point!r} are "
                f"at scheduling {places}, as far apart as points are: one model cannot "
                "be right at all of them. Check the labels of `operating_point`, or "
                "leave them out: `scheduling` tells the points."
            )
            return


def without_spikes(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Experiments with the medians of their neighbours for samples that stand far out.

    Of scheduling variables, of which a sensor that drops out makes others. Told.
    """
    runs = list(experiments)
    signals = [run.scheduling for run in runs if run.scheduling is not None]
    known = (signal.size and np.isfinite(signal).all() for signal in signals)
    if len(signals) < len(runs) or not all(known):
        return runs
    with np.errstate(over="ignore", invalid="ignore"):
        return _without_spikes(runs, signals)


def _without_spikes(
    runs: list[Experiment], signals: Sequence[Array]
) -> list[Experiment]:
    """As `without_spikes`, of scheduling `signals` that are known."""
    moving = [
        k
        for k, signal in enumerate(signals)
        if len(signal) > _ABOUT and np.ptp(signal, axis=0).any()
    ]
    if not moving:
        return runs
    found = {}
    middle = np.array([np.median(signal, axis=0) for signal in signals])
    extent = np.ptp(middle, axis=0)
    scale = np.where(extent > 0, extent, np.abs(middle).max(axis=0))
    for k in moving:
        signal = signals[k]
        steps = np.abs(np.diff(signal, axis=0))
        if (_ABOUT // 2 * steps.max(axis=0) < _STEP * scale).all():
            continue  # within so many steps of the median
        about = median_filter(signal, size=(_ABOUT, 1), mode="nearest")
        usual = np.quantile(steps, _MOST, axis=0)
        far = np.abs(signal - about) > np.maximum(_SPIKE * usual, _STEP * scale)
        if far.any():
            first, j = np.argwhere(far)[0]
            found[k] = f"{runs[k].label!r}: {signal[first, j]:.4g} at sample {first}"
            runs[k] = replace(runs[k], scheduling=np.where(far, about, signal))
    if found:
        warn(
            "the scheduling variables fall to other values for single samples, as of a "
            f"sensor that drops out (experiment {listed([*found.values()], _NAMED)}). "
            "The model takes the median of their neighbours there. Replace them in the "
            "table that you give to `predict`, too."
        )
    return runs


def _check_local(experiments: Sequence[Experiment], kappa: Array) -> None:
    """Refuse experiments within which a scheduling variable moves too far.

    Its spread (maximum minus minimum, white noise aside) is compared with its range
    over the operating points `kappa`. Where that is zero: with its largest magnitude,
    and only if the variable travels; noise and oscillations about one point have no
    scale to compare with. One that stands still but for a few steps is at several
    points.
    """
    extent = np.ptp(kappa, axis=0)
    if not extent.size:
        return
    known = [run for run in experiments if run.scheduling is not None]
    signals = [run.scheduling for run in known if run.scheduling is not None]
    spreads = _spreads(signals, _HIDDEN)
    for run, signal, spread in zip(known, signals, spreads, strict=True):
        reach = np.ptp(signal, axis=0)
        scale = np.where(extent > 0, extent, np.abs(signal).max(axis=0))
        travels = (extent > 0) | (_travel(signal) > _SWEEP * reach)
        excess = np.where(travels, spread - _MAX_SPREAD * scale, 0.0)
        worst = int(np.argmax(excess))
        if excess[worst] > 0:
            compared = "range of the operating points" if extent[worst] else "magnitude"
            several = (
                " Where the table holds several experiments, `experiment` must name "
                "the column that tells them apart."
                if len(experiments) == 1
                else ""
            )
            if _says_nothing(spreads, extent)[worst]:
                several = (
                    f" Variable {worst + 1} hardly differs between the points, compared"
                    " with how it moves within them: leave it out of `scheduling`."
                )
            raise ValueError(
                f"Experiment {run.label!r} must be local. Got a scheduling variable "
                f"{worst + 1} that spreads over {spread[worst]:.4g}, more than "
                f"{_MAX_SPREAD:g} times the {compared} ({scale[worst]:.4g}). Keep such "
                "a record for validation, cut it into local experiments, put the mean "
                "of the variable in its place where it only moves about one point, or "
                "refine the model with it: refiner=OutputErrorLPV(). For an angle that "
                f"turns over, take its cosine and sine.{several}"
            )
        changes = np.count_nonzero(np.diff(signal, axis=0), axis=0)
        steps = (changes > 0) & (changes <= min(_FEW_STEPS, len(run.rows) // _STILL))
        steps &= (extent > 0) & (reach > _STEP * extent)
        if steps.any():
            k = int(steps.argmax())
            first, last = signal[[0, -1], k]
            raise ValueError(
                f"Experiment {run.label!r} must be at one operating point. Got a "
                f"scheduling variable {k + 1} that steps from {first:.4g} to "
                f"{last:.4g} within it: name the column that tells experiments apart "
                "by `experiment`, or cut the record by `split_levels`."
            )


def _says_nothing(spreads: Array, extent: Array) -> NDArray[np.bool_]:
    """Variables that tell no points apart, where another one does.

    Within most experiments they move too far, for the `extent` of the points.
    """
    silent = np.median(spreads, axis=0) > _MAX_SPREAD * extent
    return silent & ((extent > 0) & ~silent).any()


def moving_experiments(
    experiments: Sequence[Experiment],
) -> tuple[list[Experiment], list[Experiment]]:
    """The local experiments of a table, and those that move between their places.

    Moving is a spread beyond that of a local experiment, relative to all that a
    scheduling variable ran through, if it travels or its means differ by more than the
    noise: noise and oscillations about one point are no motion.
    """
    if any(run.scheduling is None for run in experiments):
        return list(experiments), []
    signals = [run.scheduling for run in experiments if run.scheduling is not None]
    spread = _spreads(signals, _HIDDEN)
    reach = np.array([np.ptp(signal, axis=0) for signal in signals])
    between = np.ptp([signal.mean(axis=0) for signal in signals], axis=0)
    travel = np.array([_travel(signal) for signal in signals])
    low, high = _extremes(signals)
    far = spread > _MAX_SPREAD * (high - low)
    apart = between > spread.min(axis=0)
    moves = (far & (apart | (travel > _SWEEP * reach))).any(axis=1)
    local = [run for run, away in zip(experiments, moves, strict=True) if not away]
    return local, [run for run, away in zip(experiments, moves, strict=True) if away]


def _extremes(signals: Sequence[Array]) -> tuple[Array, Array]:
    """Smallest and largest values over all signals, NaN aside; one read at a time."""
    low = np.fmin.reduce([np.fmin.reduce(signal) for signal in signals])
    return low, np.fmax.reduce([np.fmax.reduce(signal) for signal in signals])


def _spreads(signals: Sequence[Array], n_windows: int = _PARTS) -> Array:
    """Maximum minus minimum of the columns of signals, of means that lose noise only.

    (n_signals, n_scheduling). That of the sensor is in all of them: what one has beyond
    a few times the usual is motion.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        noise = np.array([_white_noise(signal) for signal in signals])
        noise = np.minimum(noise, _UNUSUAL * np.median(noise, axis=0))
        pairs = zip(signals, noise, strict=True)
        return np.array([_spread(*pair, n_windows) for pair in pairs])


def _white_noise(scheduling: Array) -> Array:
    """Variance of white noise of each column, if it has no other fast motion."""
    if len(scheduling) <= _DIFFERENCES:
        return np.zeros(scheduling.shape[1])
    differences = np.diff(scheduling, _DIFFERENCES, axis=0)
    return np.asarray((differences**2).mean(axis=0) / _OF_DIFFERENCES)


def _spread(scheduling: Array, noise: Array, n_windows: int) -> Array:
    """Of one signal, whose noise has these variances, if it has.

    So many windows make up the record, at least: with many of them means of experiments
    at one point differ by less, with few of them the motion is known best. A straight
    line has the spread that it had: its means reach less far, by their window.
    """
    spread, n = np.ptp(scheduling, axis=0), len(scheduling)
    if n < n_windows * _WINDOWS[0] or not spread.any():
        return spread
    centred = scheduling - scheduling.mean(axis=0)
    sums = np.cumsum(np.vstack([np.zeros_like(centred[:1]), centred]), axis=0)
    only_noise = noise > (_ROUNDING * spread) ** 2
    for window in _WINDOWS:
        if window > n // n_windows:
            break
        means = (sums[window:] - sums[:-window]) / window
        lost = centred[window // 2 :][: len(means)] - means
        most = (1.0 + _BY_CHANCE / np.sqrt(n)) * (1.0 - 1.0 / window) * noise
        only_noise &= (lost**2).mean(axis=0) <= most
        if not only_noise.any():
            break
        narrower = np.minimum(spread, np.ptp(means, axis=0) * n / len(means))
        spread = np.where(only_noise, narrower, spread)
    return spread


def _travel(scheduling: Array) -> Array:
    """How far the mean of a part of the record is from that of another part."""
    parts = np.array_split(scheduling, min(_PARTS, len(scheduling)))
    return np.ptp([part.mean(axis=0) for part in parts], axis=0)


def mean_values(values: Array) -> Array:
    """Means of columns, NaN left out: of a constant one its value, to the last digit.

    >>> mean_values(np.full((3, 1), 0.1)), np.full(3, 0.1).mean()
    (array([0.1]), np.float64(0.10000000000000002))
    """
    low, high = _extremes([values])
    return np.where(low == high, low, np.nanmean(values, axis=0))


def group_operating_points(
    experiments: Sequence[Experiment], tol: ArrayLike | None = None
) -> tuple[NDArray[np.intp], Array]:
    """The operating point of every experiment, and the points' scheduling values.

    Experiments with an operating-point label are grouped by it; the others by the mean
    of their scheduling variable: means of one point are within `tol` of a neighbour, by
    default the larger of 1 % of their range and the spread of the variable within one
    of the two, white noise aside, or the median spread where that is less. Values that
    stand still within both experiments are within 1 % of their size as well: 1, 10,
    100, 1000 are four points. A ValueError where they form a longer chain.

    The values (n_points, n_scheduling) are the means over a point's experiments, in
    lexicographic order; without scheduling columns `n_scheduling` is 0, and points are
    in the order of first appearance.
    """
    signals = [run.scheduling for run in experiments if run.scheduling is not None]
    means = None
    if len(signals) == len(experiments):
        ends = squarable("scheduling", np.array(_extremes(signals)))
        if np.isinf(ends).any():
            raise ValueError("`scheduling` must be finite. Got inf in its columns.")
        means = np.array([mean_values(signal) for signal in signals])
    if all(run.operating_point is not None for run in experiments):
        group, _ = pd.factorize(
            pd.Series([run.operating_point for run in experiments], dtype=object)
        )
    elif means is None:
        group = np.zeros(len(experiments), dtype=np.intp)
    else:
        group = _cluster(means, *_tolerance(signals, means, tol))
    n_points = int(group.max()) + 1
    if means is None:
        return group, np.empty((n_points, 0))
    kappa = np.array([mean_values(means[group == k]) for k in range(n_points)])
    order = np.lexsort(kappa.T[::-1])
    return np.argsort(order)[group], kappa[order]


def _tolerance(
    signals: Sequence[Array], means: Array, tol: ArrayLike | None
) -> tuple[Callable[[int], Array], Array]:
    """From one experiment to every other (n, n_scheduling), and the largest."""
    if tol is not None:
        largest = tolerances("scheduling_tol", tol, means.shape[1])
        return lambda _: largest, largest
    spreads, span, size = _spreads(signals), np.ptp(means, axis=0), np.abs(means)
    close, usual = _CLOSE * span, np.median(spreads, axis=0)

    def near(k: int) -> Array:
        wider = np.maximum(spreads, spreads[k])
        of_size = np.maximum(_CLOSE * np.maximum(size, size[k]), _ROUNDING * span)
        narrow = np.where(wider > 0.0, close, np.minimum(close, of_size))
        return np.maximum(narrow, np.minimum(wider, usual))

    return near, np.maximum(close, usual)


def _cluster(
    means: Array, near: Callable[[int], Array], tol: Array
) -> NDArray[np.intp]:
    """Group means that are as `near`, `tol` at most, whatever their order."""
    group, n_groups = np.full(len(means), -1), 0
    for first in range(len(means)):
        reached = [first] if group[first] < 0 else []
        n_groups += len(reached)
        while reached:
            k = reached.pop()
            group[k] = n_groups - 1
            joins = (np.abs(means - means[k]) <= near(k)).all(axis=1) & (group < 0)
            group[joins] = n_groups - 1
            reached.extend(np.flatnonzero(joins).tolist())
    for k in range(n_groups):
        extent = np.ptp(means[group == k], axis=0)
        if (extent > _CHAIN * tol).any():
            j = int(np.argmax(extent - _CHAIN * tol))
            raise ValueError(
                "`scheduling_tol` must separate the operating points. With "
                f"{tol[j]:.4g}, {int((group == k).sum())} experiments form one chain "
                f"over {extent[j]:.4g} of scheduling variable {j + 1}. Give a smaller "
                "`scheduling_tol` (0: every experiment is a point), or label the "
                "points with an `operating_point` column."
            )
    return np.asarray(group)


def check_outputs(experiments: Sequence[Experiment], names: Sequence[object]) -> None:
    """Refuse outputs (of these names) that are constant."""
    lowest, highest = _extremes([e.measured for e in experiments])
    constant = lowest == highest
    n_samples = sum(len(e.rows) for e in experiments)
    if n_samples > len(experiments) and constant.any():
        j = int(np.argmax(constant))
        raise ValueError(
            f"Every output must vary. Got {names[j]!r} constant at "
            f"{lowest[j] + 0.0:g}: no dynamics can be identified from it. Leave it out "
            "of `y`, or check the sensor and its column."
        )


def neighbours(kappa: Array) -> NDArray[np.intp]:
    """Pairs of neighbouring points, (n_pairs, 2), every variable in its range.

    Of one variable one point and the next, of several the edges of a Delaunay
    triangulation, or of the shortest tree where there is none.

    >>> neighbours(np.array([[0.0], [5.0], [1.0]]))
    array([[0, 2],
           [1, 2]])
    """
    span = np.ptp(kappa, axis=0)
    varies = span > 0
    scaled = kappa[:, varies] / span[varies]
    n_points, n = scaled.shape
    if 1 < n <= _MANY_VARIABLES and n_points > n:
        try:
            corners = Delaunay(scaled).simplices
        except QhullError:  # all of them on a line or plane
            pass
        else:
            edges = {tuple(sorted(e)) for c in corners for e in combinations(c, 2)}
            return np.array(sorted(edges))
    # of points at one place (a distance of zero) the graph has no edge: none between
    first = np.unique(scaled, axis=0, return_index=True)[1]
    tree = minimum_spanning_tree(cdist(scaled[first], scaled[first])).tocoo()
    return np.sort(np.column_stack([first[tree.row], first[tree.col]]), axis=1)


def tell_of_joint_scheduling(kappa: Array, names: Sequence[Hashable]) -> None:
    """Tell where scheduling variables move together from point to point.

    What each does alone such points do not tell: the range that they span is empty
    but for a line, a plane, or what is near it.
    """
    extent = np.ptp(kappa, axis=0)
    moves = extent > 0
    if moves.sum() < 2:
        return
    centred = (kappa - kappa.mean(axis=0))[:, moves] / extent[moves]
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[-1] > _JOINT * spread[0] and len(spread) == moves.sum():
        return
    which = ", ".join(repr(n) for n, m in zip(names, moves, strict=True) if m)
    warn(
        f"the scheduling variables {which} move together over the {len(kappa)} "
        "operating points, which tell nothing of what each does alone: apart from "
        "these points the LPV model extrapolates, though within the range of each "
        "variable. Measure at other combinations, or use one of them alone."
    )


def tolerances(argument: str, values: Any, n: int) -> Array:
    """One for each of `n` scheduling variables, which may be given as one number."""
    given = as_numbers(argument, values)
    if given.shape not in ((1,), (n,)) or not (given >= 0).all():
        raise ValueError(
            f"`{argument}` must be a non-negative number, or one per scheduling "
            f"variable ({n}). Got {shown(values)}."
        )
    return np.broadcast_to(given, n)
