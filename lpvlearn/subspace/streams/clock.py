"""Times of the batches of a stream, which go on evenly from one to the next."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
import pandas as pd

from ...data.tables import Column
from ...data.timestamps import (
    TIME_TOL,
    Clock,
    are_local_times,
    read_clock,
    time_in_seconds,
)

# Stamps that are remembered: enough to tell rounding from another step.
_REMEMBERED = 256


class StreamClock:
    """Guard on the times of consecutive batches.

    The tolerance on their jitter is `time_tol`; with `gaps` samples may be missing.
    `step` is the mean step of the first experiment so far, seconds; None before its
    second sample.

    >>> clock = StreamClock()
    >>> clock.check(Column("t", np.array([0.0, 0.1, 0.2])), 0, continues=False)
    True
    >>> clock.check(Column("t", np.array([0.3, 0.4])), 0, continues=True)
    True
    >>> round(clock.step, 9)
    0.1
    """

    def __init__(self, time_tol: float = TIME_TOL, gaps: bool = False) -> None:
        self.step: float | None = None
        self._options: dict[str, Any] = {"time_tol": time_tol, "allow_missing": gaps}
        self._tail: Any = None
        self._elapsed, self._n_steps = 0.0, 0  # of the first experiment, without gaps
        self._in_first = True
        self._reference: Any = None

    def check(self, stamps: Column, label: Hashable, *, continues: bool) -> bool:
        """Refuse a batch that repeats or leaves out time, or has another step.

        `stamps` are those of one experiment, even among themselves; `continues` tells
        whether it was the last one of the batch before. False if samples are missing
        between the two.
        """
        times = pd.Series(stamps.values).reset_index(drop=True)
        joined, n_before, goes_on = times, 0, True
        if continues and self._tail is not None:
            before = pd.Series(self._tail).infer_objects()
            joined = pd.concat([before, times], ignore_index=True)
            n_before = len(self._tail)
            goes_on = self._check_border(joined, stamps.name, label)
        self._check_step(joined, stamps.name, label)
        self._in_first &= continues or self._tail is None
        self._tail = joined.iloc[-_REMEMBERED:].to_numpy()
        if self._in_first and len(joined) > 1:
            seconds = time_in_seconds(joined, stamps.name)
            steps = np.diff(seconds.astype(float))
            new = np.arange(1, len(joined)) >= n_before
            new[self._read(joined, stamps.name, label).breaks - 1] = False
            self._elapsed += float(steps[new].sum())
            self._n_steps += int(new.sum())
            self.step = self._elapsed / self._n_steps if self._n_steps else None
        return goes_on

    def _read(
        self, times: Any, name: Hashable, label: Hashable, **options: Any
    ) -> Clock:
        seconds = time_in_seconds(times, name)
        known = options | self._options | {"local": are_local_times(times)}
        return read_clock(seconds, column=name, experiment=label, **known)

    def _check_border(self, joined: Any, name: Hashable, label: Hashable) -> bool:
        n_before = len(self._tail)
        try:
            return n_before not in self._read(joined, name, label).breaks
        except ValueError as error:
            last, first = joined.iloc[n_before - 1], joined.iloc[n_before]
            if first <= last:
                what, remedy = "repeats samples", "Feed every sample once"
            else:
                what = "does not continue where that ended"
                remedy = "Feed all samples of an experiment, with one step"
            raise ValueError(
                f"Column {name!r} of experiment {label!r} must go on evenly from the "
                f"batch before. Got a batch from {first} on, after {last}: it {what}. "
                f"{remedy} and in the order of time; what is no continuation needs a "
                "new label in the `experiment` column."
            ) from error

    def _check_step(self, joined: Any, name: Hashable, label: Hashable) -> None:
        if len(joined) < 2:
            return
        times = joined.iloc[-_REMEMBERED:].to_numpy()
        if self._reference is None:
            self._reference = times
            return
        # Rounded stamps tell the step the better the more there are.
        short, long = sorted((self._reference, times), key=len)
        longer = self._read(long, name, label)
        try:
            self._read(short, name, label, expected=[(longer, "")])
        except ValueError as error:
            first, other = (
                self._read(t, name, label).step for t in (self._reference, times)
            )
            raise ValueError(
                "All batches must have the same time step. Got "
                f"{first:.9g} s first, and {other:.9g} s in column {name!r} of "
                f"experiment {label!r}. Resample the stream, or fit again from here."
            ) from error
        self._reference = long
