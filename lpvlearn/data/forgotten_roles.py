"""Tables that look as if a role was forgotten, or their rows shuffled.

A column without a role is an input. The time, the number of the experiment or the
scheduling variable makes a poor one: the fit goes on and its numbers mean nothing. So
it does with shuffled rows, which no time column gives away where it is forgotten.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..exceptions import warn
from .timestamps import missing_after

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Steps that differ by no more than that part of them are even: stamps are rounded, and
# no other signal but a ramp comes near. Stamps that jitter stay this part of a step
# about a straight line, which sums of uneven steps leave.
_EVEN, _JITTER = 0.05, 0.5
_FEWEST = 10  # steps below which a few even ones are chance

# Share of the steps that may go back, from experiment to experiment, or leave rows out;
# and of those of an index that must not, for the others to be holes.
_RESTARTS, _WHOLE = 0.05, 0.3

_ALIKE = 100  # samples from which columns that agree to the bit are one

DISORDER = "disorder"  # the kind of warnings of rows: of these comes what else is told

# Types of an index that tells times, an order, and, of even numbers, what is missing
_DATES = ("datetime64", "timedelta64")
_ORDERED = ("integer", *_DATES)
_TELLING = (*_ORDERED, "floating")

_OFF = 0.1  # of a step, by which those of an index may be off whole ones

_NAME_IT = "Name it by `time=` (an index gets a name by rename_axis of pandas)"

_HOLDS = 10.0  # samples that a number of an experiment stands for, at least, on average
_LEVELS = 3  # that make a count; two are a step, the commonest input of all


def warn_of_forgotten_roles(
    inputs: Array,
    names: Sequence[Hashable],
    groups: Sequence[Indices],
    roles: Mapping[str, Any],
) -> None:
    """Warn of inputs (n_samples, n_inputs) that nobody named and that look like none.

    `groups` are the rows of every experiment.
    """
    for k, name in enumerate(names):
        column = inputs[:, k]
        # Times of one experiment after another begin at zero. What falls back beside no
        # input, or from above zero to below, is a sawtooth that the system got.
        anew = inputs.shape[1] > 1 and bool(column.min(initial=0.0) >= 0.0)
        if roles["time"] is None and _is_clock(column, groups, anew):
            warn(
                f"Input column {name!r} rises by the same {_typical_step(column):.6g} "
                "from row to row, as times and row numbers do. If it is the time, name "
                f"it: time={name!r}; if it numbers the rows, drop it; if it is a ramp "
                "that the system got, list the inputs in `inputs`."
            )
        elif roles["time"] is None and _is_clock(-column, groups, anew):
            warn(
                f"Input column {name!r} falls by the same {-_typical_step(column):.6g} "
                "from row to row, as times do where the latest row comes first. If it "
                "is the time, sort the rows by it, in X and y (sort_values of pandas), "
                f"and name it: time={name!r}; if it is a ramp that the system got, "
                "list the inputs in `inputs`."
            )
        elif roles["experiment"] is None and _is_count(column):
            warn(
                f"Input column {name!r} counts from {column[0]:g} to {column[-1]:g} in "
                "blocks of rows, as numbers of experiments do. If it is one, name it: "
                f"experiment={name!r}; if it is a staircase that the system got, list "
                "the inputs in `inputs`."
            )
        elif _is_setting(column, groups) and _others_move(inputs, k, groups):
            warn(
                f"Input column {name!r} does not change within any of the "
                f"{len(groups)} experiments, as scheduling variables and operating "
                f"points do. If it is one, name it: scheduling={name!r} or "
                f"operating_point={name!r}; if the system got it as an input, list the "
                "inputs in `inputs`."
            )


def refuse_outputs_among_inputs(
    inputs: Array,
    names: Sequence[Hashable],
    outputs: Array,
    output_names: Sequence[Hashable],
) -> None:
    """Refuse inputs of a table (n_samples, n_inputs) that are outputs, to the bit."""
    for name in set(names) & set(output_names):
        column = inputs[:, list(names).index(name)]
        if (column == outputs[:, list(output_names).index(name)]).all():
            raise ValueError(
                f"`inputs` must not hold an output. Got column {name!r} in X and in y: "
                "drop it from X, or list the inputs in `inputs`."
            )
    if len(names) < 2 or len(inputs) < _ALIKE:
        return  # who gives one column as both may mean it, and coarse ones may agree
    for k, name in enumerate(names):
        same = (inputs[:, [k]] == outputs).all(axis=0)
        if same.any() and np.ptp(inputs[:, k]) > 0.0:
            raise ValueError(
                f"`inputs` must not hold an output. Got column {name!r} of X with the "
                f"values of output {output_names[int(same.argmax())]!r}: drop it from "
                "X, or list the inputs in `inputs`."
            )


def warn_of_disorder(
    X: Any, groups: Sequence[Indices], sampling_time: float | None = None
) -> None:
    """Warn of rows not in the order of their numbers or dates, the index, or torn.

    An index that begins anew, where nobody named experiments, is that of tables below
    each other. Labels that stand twice else tell nothing. Numbers that mostly
    go on by the same step, and elsewhere by some of them, tell that rows are missing
    there, unless the labels in between are those of other experiments. Dates tell the
    step, too, which the `sampling_time` (seconds) is to be.
    """
    index = getattr(X, "index", None)
    if not isinstance(index, pd.Index) or index.inferred_type not in _TELLING:
        return
    if isinstance(index, pd.RangeIndex) and index.step > 0 and len(groups) == 1:
        return  # the usual case
    numbers, ordered = _as_numbers(index), np.empty(0)
    for rows in groups:
        labels = index[rows]
        if index.inferred_type in _ORDERED and labels.is_unique:
            if not labels.is_monotonic_increasing:
                _tell_of_order(labels)
                return
        steps = np.diff(numbers[rows])
        if len(steps) < _FEWEST or not (steps > 0.0).all():
            if len(groups) == 1 and _begins_anew(numbers):
                _tell_of_several(labels, numbers)
            continue
        step = float(np.median(steps[steps < 1.5 * steps.min()]))
        torn = np.flatnonzero(steps > 1.5 * step)
        off = np.abs(steps / step - np.rint(steps / step))
        if len(torn) > (1.0 - _WHOLE) * len(steps) or not (off < _OFF).all():
            continue  # it goes on in no steps that are alike
        dates = index.inferred_type in _DATES
        if dates and sampling_time and abs(step / sampling_time - 1.0) > _OFF:
            warn(
                f"The index of X goes on by {step:.6g} s, and `sampling_time` is "
                f"{sampling_time:.6g} s: one of them is wrong. {_NAME_IT}; if the "
                "index means nothing, drop it (reset_index).",
                kind=DISORDER,
            )
            return
        if not len(torn):
            continue
        ordered = ordered if len(ordered) else np.sort(numbers)
        beside = _are_among(ordered, numbers[rows][torn] + step, _OFF * step)
        if not beside.sum() > len(torn) // 2:  # no others take turns
            where = int(torn[0])
            warn(
                "Rows of X are missing within an experiment: its index goes from "
                f"{labels[where]} to {labels[where + 1]}. To a model the record goes "
                "on there. Split by experiment (ExperimentSplit) or in time "
                "(BlockedTimeSeriesSplit), not by KFold; of rows that were dropped "
                + (
                    f"the index tells the times: use missing='split'. {_NAME_IT}; if "
                    if dates
                    else "name the `time` and use missing='split'; if "
                )
                + "the index means nothing, drop it (reset_index).",
                kind=DISORDER,
            )
            return


def _tell_of_order(labels: pd.Index) -> None:
    later = int(np.argmin(labels[1:] > labels[:-1])) + 1
    warn(
        "The rows of X are not in the order of its index: "
        f"{labels[later]!s} comes after {labels[later - 1]!s}. A dynamic model "
        "needs the samples in the order of time. If they were shuffled, sort "
        "them (sort_index of pandas) and split by experiment with "
        "ExperimentSplit or in time with BlockedTimeSeriesSplit; if the index "
        "means nothing, drop it (reset_index).",
        kind=DISORDER,
    )


def _begins_anew(numbers: Array) -> bool:
    """Whether an index goes on evenly, and now and then from its beginning."""
    steps = np.diff(numbers)
    back = steps < 0.0
    even = steps[~back]
    if not back.any() or back.sum() > _RESTARTS * len(steps) or not len(even):
        return False
    off = np.concatenate([even - even[0], numbers[1:][back] - numbers[0]])
    return bool(even[0] > 0.0 and (np.abs(off) < _OFF * even[0]).all())


def _tell_of_several(labels: pd.Index, numbers: Array) -> None:
    where = int(np.argmax(np.diff(numbers) < 0.0)) + 1
    warn(
        f"The index of X begins anew at row {where}, at {labels[where]}, as where "
        "tables stand below each other. To a model one record goes on there. Name the "
        "column, or the level of the index, that tells them apart: `experiment` "
        "(pandas.concat with `keys` and `names` makes one); if the index means "
        "nothing, drop it (reset_index).",
        kind=DISORDER,
    )


def _as_numbers(index: pd.Index) -> Array:
    """Labels as numbers: dates as seconds, of which an index has whole nanoseconds."""
    if isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex):
        since = (index - index.min()).to_numpy("timedelta64[ns]")
        return np.asarray(since.astype(np.int64) * 1e-9)
    return np.asarray(index.to_numpy(dtype=np.float64, na_value=np.nan))


def _are_among(ordered: Array, wanted: Array, within: float) -> NDArray[np.bool_]:
    """Which of the `wanted` numbers are among sorted ones, or others so near."""
    place = np.searchsorted(ordered, wanted - within)
    found = ordered[np.minimum(place, len(ordered) - 1)]
    return (place < len(ordered)) & (found <= wanted + within)


def _typical_step(column: Array) -> float:
    return float(np.median(np.diff(column)))


def _is_clock(column: Array, groups: Sequence[Indices], anew: bool) -> bool:
    """Whether a column rises evenly, from anew where another experiment begins.

    Where nobody named the experiments, it may begin `anew` within what is taken for
    one. Evenly but for the jitter of stamps, and for those of rows that are missing.
    """
    parts = [column[rows] for rows in groups]
    steps = np.concatenate([np.diff(part) for part in parts])
    if len(steps) < _FEWEST or not np.isfinite(steps).all():
        return False
    typical = float(np.median(steps))
    n_back, n_over = int((steps < 0).sum()), int(missing_after(steps, typical).sum())
    few = _RESTARTS * len(steps)
    n_anew = few if anew and len(groups) == 1 else 0
    if not typical > 0 or n_over > few or n_back > n_anew:
        return False
    uneven = steps[np.abs(steps - typical) > _EVEN * typical]
    if (uneven < 0).all():
        return True
    return all(
        _is_straight(run, typical) for part in parts for run in _runs(part, typical)
    )


def _runs(column: Array, step: float) -> list[Array]:
    """What is between steps that go back or leave something out."""
    steps = np.diff(column)
    breaks = np.flatnonzero((steps < 0) | missing_after(steps, step))
    return np.split(column, breaks + 1)


def _is_straight(column: Array, step: float) -> bool:
    """Whether it stays about a straight line by less than the jitter of stamps."""
    row = np.arange(len(column))
    if len(row) < 2:
        return True
    line = np.polynomial.Polynomial.fit(row, column, 1)
    return bool(np.abs(column - line(row)).max() < _JITTER * step)


def _is_count(column: Array) -> bool:
    """Whether a column counts up by one, in blocks of many rows."""
    steps = np.diff(column)
    rises = int((steps == 1).sum())
    counts = bool(
        ((steps == 0) | (steps == 1)).all() and column[:1] == np.rint(column[:1])
    )
    return counts and rises >= _LEVELS - 1 and len(column) >= _HOLDS * (rises + 1)


def _is_setting(column: Array, groups: Sequence[Indices]) -> bool:
    """Whether a column has one value in every experiment, and several in all."""
    still = all((column[rows] == column[rows[0]]).all() for rows in groups)
    return still and len(groups) > 1 and bool((column != column[0]).any())


def _others_move(inputs: Array, k: int, groups: Sequence[Indices]) -> bool:
    """Whether another input moves within experiments: else they may be step tests."""
    rest = np.delete(inputs, k, axis=1)
    return any((rest[rows] != rest[rows[0]]).any() for rows in groups)
