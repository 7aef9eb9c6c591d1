"""The bookkeeping of `SubspaceLTI.partial_fit`: batches to experiments to summaries."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from copy import copy, deepcopy
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .columns import Column
from .experiments import Experiment
from .missing_data import complete_runs, has_gaps
from .stream_summary import Piece, StreamedModel, StreamSummary
from .stream_time import StreamClock
from .subspace_fit import LocalFit

Array = NDArray[np.float64]
Pairs = list[tuple[Array, Array]]

# Samples that are kept, and fitted like one table, before only summaries grow.
BUFFER = 131_072


class SampleStream:
    """Samples seen so far: all of them at first, then their summaries.

    Parameters
    ----------
    options : dict, default=None
        Of the estimator, which must not change in mid-stream.
    gaps : bool, default=False
        Whether experiments end at missing samples; single ones between two gaps are
        then left out.

    Attributes
    ----------
    n_samples : int
        Taken in total, but for those left out.
    clock : StreamClock
    told : set of str
        Kinds of warnings that were given.
    first_residual : float
        Relative simulation error of the model that the summaries began with.
    """

    def __init__(
        self, options: dict[str, Any] | None = None, *, gaps: bool = False
    ) -> None:
        self.n_samples = 0
        self.told: set[str] = set()
        self.first_residual = np.nan
        self._options = deepcopy(options)
        self._n_outputs: int | None = None
        self._gaps = gaps
        self.clock = StreamClock()
        self._kept: list[Piece] = []
        self._label: Hashable = None
        self._open = False
        self._summary: StreamSummary | None = None

    @property
    def buffered(self) -> bool:
        """Whether all samples are still there."""
        return self._summary is None

    @property
    def summary(self) -> StreamSummary:
        """What remains of the samples once they are not kept any more."""
        assert self._summary is not None
        return self._summary

    @property
    def pairs(self) -> Pairs:
        """Experiments that are kept."""
        return [(u, y) for u, y, _ in self._kept if len(u) > self._gaps]

    def branch(self) -> SampleStream:
        """A stream that goes on from here and leaves this one as it is."""
        # Arrays are replaced, never changed in place: both may hold them.
        other = copy(self)
        other.told, other.clock = set(self.told), copy(self.clock)
        other._kept, other._summary = list(self._kept), copy(self._summary)
        return other

    def check_options(self, options: dict[str, Any]) -> None:
        """Refuse options other than those the stream began with.

        Raises
        ------
        ValueError
        """
        began = self._options or options
        for name, value in options.items():
            if not _same(value, began[name]):
                raise ValueError(
                    f"`{name}` must stay as it was when the stream began: "
                    f"{began[name]!r}. Got {value!r}. Begin anew with `fit`, or go on "
                    "with a `clone` of the estimator, which knows no samples yet."
                )

    def check_outputs(self, n_outputs: int) -> None:
        """Refuse a batch with another number of outputs than the first one.

        Raises
        ------
        ValueError
        """
        if self._n_outputs is None:
            self._n_outputs = n_outputs
        if n_outputs != self._n_outputs:
            raise ValueError(
                "`y` must have the same columns in all batches of a stream. Got "
                f"{n_outputs} output(s), after {self._n_outputs}. Feed all outputs in "
                "every batch, or begin anew with `fit`."
            )

    def pieces(
        self, experiments: Sequence[Experiment], named: bool, time: Column | None
    ) -> list[Piece]:
        """Samples of a batch, in the order of time.

        Parameters
        ----------
        experiments : sequence of Experiment
            In the order in which they appear in the batch.
        named : bool
            Whether a column tells experiments apart; without one the stream is a single
            experiment.
        time : Column or None
            Times of the batch's rows, checked against those of the batch before.

        Raises
        ------
        ValueError
            If an experiment that continues does not do so evenly in time.
        """
        # The experiment whose sample came last may continue in the next batch.
        ordered = sorted(experiments, key=lambda e: int(e.rows[-1]))
        first = [e for e in ordered if not named or e.label == self._label]
        begun = self._label is not None and bool(first)
        if begun:
            ordered = first[:1] + [e for e in ordered if e is not first[0]]
        clock, out, unbroken = copy(self.clock), [], False
        for i, e in enumerate(ordered):
            continues = begun and i == 0
            if time is not None:
                stamps = Column(time.name, pd.Series(time.values).iloc[e.rows])
                clock.check(stamps, e.label, continues=continues)
            parts = complete_runs(e, shortest=1) if has_gaps(e) else [e]
            for part in parts:
                assert part.outputs is not None
                joins = continues and self._open and part.rows[0] == e.rows[0]
                goes_on = part.rows[-1] == e.rows[-1]
                if len(part.rows) > 1 or joins or goes_on:
                    out.append(Piece(part.inputs, part.outputs, not joins))
            unbroken = bool(parts) and parts[-1].rows[-1] == e.rows[-1]
        self.clock, self._label, self._open = clock, ordered[-1].label, unbroken
        return out

    def keep(self, pieces: Sequence[Piece]) -> list[Piece]:
        """Add to the samples that are kept, as many as there is room for.

        Parameters
        ----------
        pieces : sequence of Piece

        Returns
        -------
        list of Piece
            What is left over.
        """
        left: list[Piece] = []
        for u, y, starts in pieces:
            if starts and self._gaps and self._kept and len(self._kept[-1].u) == 1:
                self._kept.pop()
                self.n_samples -= 1
            n = min(len(u), BUFFER - self.n_samples)
            if left or (starts and self.n_samples == BUFFER - 1):
                # A first sample that is cut off from what follows tells nothing.
                n = 0
            if n > 0 and (starts or not self._kept):
                self._kept.append(Piece(u[:n], y[:n], True))
            elif n > 0:
                before = self._kept[-1]
                self._kept[-1] = Piece(
                    np.vstack([before.u, u[:n]]), np.vstack([before.y, y[:n]]), True
                )
            if n < len(u):
                left.append(Piece(u[n:], y[n:], starts and n == 0))
            self.n_samples += n
        return left

    def slide(self, left: Sequence[Piece]) -> list[Piece]:
        """Make room for what is left over by leaving out the oldest samples.

        Always as many, so that it does not matter how the stream is cut.
        """
        surplus = BUFFER // 8
        self.n_samples -= surplus
        while surplus:
            u, y, _ = self._kept[0]
            n = min(surplus, len(u))
            self._kept[:1] = [Piece(u[n:], y[n:], True)] if n < len(u) else []
            surplus -= n
        return self.keep(left)

    def summarise(self, fitted: LocalFit, options: dict[str, Any]) -> None:
        """Replace the samples by their summaries around the model fitted to them."""
        self._summary = StreamSummary(fitted, options)
        self.first_residual = fitted.found.residual
        self._kept = []

    def extend(self, pieces: Sequence[Piece]) -> StreamedModel:
        """Add to the summaries, and read the model from them."""
        for piece in pieces:
            self.summary.add(piece)
            self.n_samples += len(piece.u)
        return self.summary.model()


def _same(first: Any, other: Any) -> bool:
    if hasattr(first, "__array__") or hasattr(other, "__array__"):
        return np.array_equal(first, other)
    return bool(first == other)
