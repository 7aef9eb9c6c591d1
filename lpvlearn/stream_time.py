"""The time column of a stream: every batch goes on where the one before ended."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
import pandas as pd

from .columns import Column
from .timegrid import check_uniform_time, time_in_seconds

# Stamps that are remembered: enough to tell rounding from another step.
_REMEMBERED = 256


class StreamClock:
    """Guard on the times of consecutive batches.

    Attributes
    ----------
    step : float or None
        Mean step of the first experiment so far, seconds; None before its second
        sample.

    Examples
    --------
    >>> import numpy as np
    >>> clock = StreamClock()
    >>> clock.check(Column("t", np.array([0.0, 0.1, 0.2])), 0, continues=False)
    >>> clock.check(Column("t", np.array([0.3, 0.4])), 0, continues=True)
    >>> round(clock.step, 9)
    0.1
    """

    def __init__(self) -> None:
        self.step: float | None = None
        self._tail: Any = None
        self._first: Any = None
        self._n_first = 0
        self._in_first = True
        self._reference: Any = None

    def check(self, stamps: Column, label: Hashable, *, continues: bool) -> None:
        """Refuse a batch that repeats or leaves out time, or has another step.

        Parameters
        ----------
        stamps : Column
            Times of the batch's samples of one experiment, even among themselves.
        label : hashable
            Of the experiment, for the message.
        continues : bool
            Whether the experiment was the last one of the batch before.

        Raises
        ------
        ValueError
        """
        times = pd.Series(stamps.values).reset_index(drop=True)
        joined = times
        if continues and self._tail is not None:
            joined = pd.concat([self._tail, times], ignore_index=True)
            self._check_border(joined, stamps.name, label)
        self._check_step(joined, stamps.name, label)
        self._tail = joined.iloc[-_REMEMBERED:]
        if self._first is None:
            self._first = times.iloc[:1]
        self._in_first &= continues or self._n_first == 0
        if self._in_first:
            self._n_first += len(times)
            ends = pd.concat([self._first, times.iloc[-1:]], ignore_index=True)
            if self._n_first > 1:
                first, last = time_in_seconds(ends, stamps.name)
                self.step = float(last - first) / (self._n_first - 1)

    def _check_border(self, joined: Any, name: Hashable, label: Hashable) -> None:
        n_before = len(self._tail)
        seconds = time_in_seconds(joined, name)
        try:
            check_uniform_time(seconds, column=name, experiment=label)
        except ValueError as error:
            last, first = joined.iloc[n_before - 1], joined.iloc[n_before]
            if seconds[n_before] <= seconds[n_before - 1]:
                what, remedy = "repeats samples", "Feed every sample once"
            else:
                what, remedy = (
                    "does not continue where that ended",
                    ("Feed all samples of an experiment, with one step"),
                )
            raise ValueError(
                f"Column {name!r} of experiment {label!r} must go on evenly from the "
                f"batch before. Got a batch from {first} on, after {last}: it {what}. "
                f"{remedy} and in the order of time; what is no continuation needs a "
                "new label in the `experiment` column."
            ) from error

    def _check_step(self, joined: Any, name: Hashable, label: Hashable) -> None:
        if len(joined) < 2:
            return
        times = joined.iloc[-_REMEMBERED:]
        if self._reference is None:
            self._reference = times
            return
        # Rounded stamps tell the step the better the more there are.
        short, long = sorted((self._reference, times), key=len)
        step = check_uniform_time(
            time_in_seconds(long, name), column=name, experiment=label
        )
        try:
            check_uniform_time(
                time_in_seconds(short, name),
                column=name,
                experiment=label,
                other_step=step,
            )
        except ValueError as error:
            steps = [
                np.diff(time_in_seconds(t.iloc[[0, -1]], name))[0] / (len(t) - 1)
                for t in (self._reference, times)
            ]
            raise ValueError(
                "All batches must have the same time step. Got "
                f"{steps[0]:.9g} s first, and {steps[1]:.9g} s in column {name!r} of "
                f"experiment {label!r}. Resample the stream, or fit again from here."
            ) from error
        self._reference = long
