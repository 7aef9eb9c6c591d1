"""A stream of batches, and a long table, which is fitted as one.

A batch goes through five hands. The `StreamClock` checks that its times go on where the
batch before ended. `SampleStream` cuts it into pieces, stretches without gaps of one
experiment each, and knows which of them continue the experiment that came last. The
`SampleBuffer` keeps them as long as there is room: what is kept is fitted like one
table. From then on a `StreamSummary` takes them up, each sample once, and holds the
model. Small batches of plain numbers, in which nothing can be wrong, wait until there
are enough of them to go that way together.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from copy import copy, deepcopy
from itertools import pairwise
from math import hypot
from numbers import Integral
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...data.experiments import ROLES, Experiment
from ...data.preparation import (
    Pairs,
    complete_runs,
    constant_columns,
    has_gaps,
    independent_inputs,
    remove_trends,
    unbroken_runs,
)
from ...data.tables import Column
from ...systems.threads import one_blas_thread
from ...validation import SQUARED, input_delays
from ..diagnosis.fit_warnings import warn_about, warn_about_drift, warn_about_pole
from ..fit import fit_samples
from ..fits.delay import late_inputs
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples, TooFewSamples
from ..fits.options import Choices
from ..telling import Telling
from .clock import StreamClock
from .stream_summary import Piece, StreamSummary

Array = NDArray[np.float64]

# Samples that are kept, and fitted like one table, before only summaries grow: enough
# for a model that the rest can be linearised around, and a second or two of work.
BUFFER = 131_072

# Samples after which another model is due when summaries grow. Fewer may wait.
_DUE = 4_096

_FLOAT = np.dtype(float)

# Share of the buffer that is given up at once where no model can be made of it: so that
# not every batch is worth another attempt.
_SLIDE = 8


class SampleBuffer:
    """The samples of a stream that are kept, at most `BUFFER` of them.

    With `gaps` experiments end at missing samples; single ones between two gaps are
    then left out, and do not count in `n_samples`.
    """

    def __init__(self, gaps: bool) -> None:
        self.n_samples = 0
        self._gaps = gaps
        self._chunks: list[Piece] = []  # of which branches share what is before both
        self._n_chunks, self._n_last = 0, 0  # samples since the last experiment began

    @property
    def pairs(self) -> Pairs:
        """Experiments that are kept."""
        return [(u, y) for u, y, _ in self._pieces() if len(u) > self._gaps]

    def _pieces(self) -> list[Piece]:
        """The experiments, each in one piece; they are kept so, too."""
        chunks = self._chunks[: self._n_chunks]
        starts = [k for k, chunk in enumerate(chunks) if chunk.starts]
        if len(starts) < len(chunks):
            parts = pairwise([*starts, len(chunks)])
            chunks = [_in_one(chunks[i:j]) for i, j in parts]
            self._chunks, self._n_chunks = chunks, len(chunks)
        return chunks

    def branch(self) -> SampleBuffer:
        """A buffer that goes on from here and leaves this one as it is."""
        return copy(self)

    def add(self, pieces: Sequence[Piece]) -> list[Piece]:
        """Keep as many samples as there is room for; what is left over."""
        left: list[Piece] = []
        for u, y, starts in pieces:
            starts = starts or not self._n_chunks
            if starts and self._gaps and self._n_last == 1:
                self.n_samples -= 1
                self._n_last = 0
            n = min(len(u), BUFFER - self.n_samples)
            if left or (starts and self.n_samples == BUFFER - 1):
                # A first sample that is cut off from what follows tells nothing.
                n = 0
            if n > 0:
                self._keep(Piece(u[:n], y[:n], starts))
                self._n_last = n + (0 if starts else self._n_last)
            if n < len(u):
                left.append(Piece(u[n:], y[n:], starts and n == 0))
            self.n_samples += n
        return left

    def _keep(self, chunk: Piece) -> None:
        if len(self._chunks) > self._n_chunks:  # another branch went on from here
            self._chunks = self._chunks[: self._n_chunks]
        self._chunks.append(chunk)
        self._n_chunks += 1

    def slide(self, left: Sequence[Piece]) -> list[Piece]:
        """Make room for what is left over by leaving out the oldest samples.

        Always as many, so that it does not matter how the stream is cut.
        """
        surplus = BUFFER // _SLIDE
        self.n_samples -= surplus
        *before, last = self._pieces()
        pieces = [p for p in before if len(p.u) > self._gaps] + [last]
        while surplus:
            u, y, _ = pieces[0]
            n = min(surplus, len(u))
            pieces[:1] = [Piece(u[n:], y[n:], True)] if n < len(u) else []
            surplus -= n
        self._chunks, self._n_chunks = pieces, len(pieces)
        return self.add(left)


def _in_one(chunks: Sequence[Piece]) -> Piece:
    if len(chunks) == 1:
        return chunks[0]
    u, y, _ = zip(*chunks, strict=True)
    return Piece(np.vstack(u), np.vstack(y), True)


class SampleStream:
    """The batches of `SubspaceLTI.partial_fit`.

    Begins with the experiments of the first batch. `options` are the parameters of the
    estimator, which must not change in mid-stream; `step` the seconds between samples
    where no `time` column tells it. A ValueError where no table of these channels can
    carry the options.
    """

    def __init__(
        self,
        choices: Choices,
        options: Mapping[str, Any],
        first: Sequence[Experiment],
        step: float,
        names: tuple[Any, Any],
        telling: Telling,
    ) -> None:
        self._choices, self._options = choices, deepcopy(options)
        self._given_step, self._names = step, first[0].input_names
        self.names = names  # of inputs and outputs, or None
        n_inputs, self._n_outputs = first[0].inputs.shape[1], first[0].measured.shape[1]
        settings = choices.settings(self._n_outputs, n_inputs, np.eye(n_inputs))
        settings.check_size([BUFFER], choices.order, choices.horizon)
        self._telling = telling
        gaps = options["missing"] == "split"
        self._clock = StreamClock(options["time_tol"], gaps)
        self._label: Hashable = None  # of the sample that came last
        self._open = False  # whether nothing of that experiment is missing since
        self.delay = input_delays(options["input_delay"], n_inputs, samples=True)
        if (self.delay >= BUFFER).any():
            raise ValueError(
                f"`input_delay` must be below {BUFFER} samples in partial_fit, which "
                f"keeps no more of a stream. Got {self.delay.max()}."
            )
        self._rest = not choices.initial_states
        self._in_transit: Array | None = None  # inputs of that experiment
        unknown = bool(self.delay.any()) and not self._rest
        self._buffer = SampleBuffer(gaps or unknown)
        self._summary: StreamSummary | None = None
        self._first_residual = np.nan
        self._n_new, self._n_fitted = 0, 0  # samples since, and of, the last attempt
        self._has_model = False  # whether that found one
        # Whether tables are read as they are: all columns are inputs.
        self._plain = all(options[role] is None for role in ROLES)
        self._named = not any(isinstance(name, Integral) for name in self._names)
        # Numbers of inputs and outputs in turn, as bytes: of these the collector of
        # garbage makes nothing. For how many samples more there is room.
        self._waiting: list[bytes] = []
        self._left = 0
        self._values, self._began = itemgetter(*options), (*self._options.values(),)

    @property
    def step(self) -> float:
        """Seconds between samples."""
        found = self._clock.step
        return self._given_step if found is None else found

    def branch(self) -> SampleStream:
        """A stream that goes on from here and leaves this one as it is.

        What waits is taken up.
        """
        other = copy(self)
        other._telling, other._clock = self._telling.aside(), copy(self._clock)
        other._buffer, other._summary = self._buffer.branch(), copy(self._summary)
        other._waiting = []
        if self._waiting:
            inputs, outputs = (b"".join(self._waiting[k::2]) for k in (0, 1))
            u = np.frombuffer(inputs).reshape(-1, len(self._names))
            y = np.frombuffer(outputs).reshape(-1, self._n_outputs)
            other._take_up([Experiment(0, np.arange(len(u)), u, y)], None)
        return other

    def takes(self, X: Any, y: Any, options: Mapping[str, Any]) -> bool:
        """Whether a batch may wait for others to be taken up; from now on it does.

        Not where there is something to read, to refuse or to do: the batch is not
        simply inputs and outputs, arrays or tables as the first ones were, `options`
        are not those that the stream began with, or enough samples wait.
        """
        if self._named:
            X, y = _without_labels(X, y, self._names, self.names[1])
        if not (type(X) is type(y) is np.ndarray and X.dtype is y.dtype is _FLOAT):
            return False
        n, ny = len(y) if y.ndim else 0, self._n_outputs
        if X.shape != (n, len(self._names)):
            return False
        if y.shape != (n, ny) and (ny > 1 or y.ndim > 1):
            return False
        left = (self._left if self._waiting else self._room) - n
        if not (n and left > 0):
            return False
        now, began = self._values(options), self._began
        try:
            as_it_began = now == began
        except ValueError:  # arrays among them
            as_it_began = all(map(_same, now, began))
        if not as_it_began:
            return False
        if not hypot(*X.flat, *y.flat) < SQUARED:  # or some are missing
            return False
        self._waiting += X.tobytes(), y.tobytes()  # at once, whoever interrupts
        self._left = left
        return True

    @property
    def _room(self) -> int:
        """How many samples may wait before something is to be done with them."""
        room = min(_DUE, self._due - self._n_new)
        if not self._plain:
            return 0
        if self._summary is None:
            return min(room, BUFFER - self._buffer.n_samples)
        return room if self._summary.takes_all_inputs else 0

    @property
    def _due(self) -> int:
        """Samples since the last attempt at a model with which another one is due.

        As many as that was made of until one succeeds: all attempts together cost twice
        the last one. Then none before the buffer is full, where summaries begin.
        """
        if self._summary is not None:
            return _DUE
        return BUFFER if self._has_model else self._n_fitted

    def check_options(self, options: Mapping[str, Any]) -> None:
        """Refuse options other than those the stream began with."""
        for name, began in self._options.items():
            if not _same(options[name], began):
                raise ValueError(
                    f"`{name}` must stay as it was when the stream began: "
                    f"{began!r}. Got {options[name]!r}. Begin anew with `fit`, or go "
                    "on with a `clone` of the estimator, which knows no samples yet."
                )

    def add(
        self, experiments: Sequence[Experiment], times: Column | None
    ) -> LocalFit | None:
        """Take up a batch: its experiments by appearance, and the times of its rows.

        The model of all samples, where another one is due. Else None, and `fit` tells
        it when it is asked for: so that batches cost no more for being small. After a
        ValueError (other outputs than in the first batch, an experiment that does not
        go on evenly in time) this stream must be left: go on from the one that it
        branched off.
        """
        n_outputs = experiments[0].measured.shape[1]
        if n_outputs != self._n_outputs:
            raise ValueError(
                "`y` must have the same columns in all batches of a stream. Got "
                f"{n_outputs} output(s), after {self._n_outputs}. Feed all outputs in "
                "every batch, or begin anew with `fit`."
            )
        fitted = self._take_up(experiments, times)
        return self.fit() if self._n_new >= self._due else fitted

    def _take_up(
        self, experiments: Sequence[Experiment], times: Column | None
    ) -> LocalFit | None:
        """Keep or sum up samples; the model where they fill the buffer."""
        pieces, fitted = self._cut(experiments, times), None
        self._n_new += sum(len(piece.u) for piece in pieces)
        if self._summary is None:
            pieces = self._buffer.add(pieces)
            if pieces or self._buffer.n_samples >= BUFFER:
                fitted, pieces = self._fit_kept(pieces)
                self._n_new = sum(len(piece.u) for piece in pieces)
        if self._summary is not None:
            for piece in pieces:
                self._summary.add(piece)
        return fitted

    @property
    def _n_waiting(self) -> int:
        return sum(map(len, self._waiting[1::2])) // (8 * self._n_outputs)

    @property
    def n_samples(self) -> int:
        """How many came, without those that gaps left alone."""
        return self._n_fitted + self._n_new + self._n_waiting

    @property
    def waits(self) -> bool:
        """Whether samples came that the last attempt at a model does not know."""
        return bool(self._waiting) or self._n_new > 0

    def fit(self) -> LocalFit | None:
        """The model of all samples taken up; None where they are still too few."""
        self._n_fitted, self._n_new = self._n_fitted + self._n_new, 0
        if self._summary is not None:
            return self._fit_summaries(self._summary)
        fitted, _ = self._fit_kept([])
        self._has_model = fitted is not None
        return fitted

    def _cut(
        self, experiments: Sequence[Experiment], times: Column | None
    ) -> list[Piece]:
        """Pieces of a batch in the order of time, its times checked."""
        # The experiment whose sample came last may continue in the next batch.
        ordered = sorted(experiments, key=lambda e: int(e.rows[-1]))
        named = self._options["experiment"] is not None
        first = [e for e in ordered if not named or e.label == self._label]
        begun = self._label is not None and bool(first)
        if begun:
            ordered = first[:1] + [e for e in ordered if e is not first[0]]
        out, unbroken = [], self._open
        for i, e in enumerate(ordered):
            continues = begun and i == 0
            sent = self._in_transit if continues else None
            if times is not None:
                stamps = Column(times.name, pd.Series(times.values).iloc[e.rows])
                goes_on = self._clock.check(stamps, e.label, continues=continues)
                unbroken &= goes_on
                sent = sent if goes_on else None
            parts: list[Experiment] = []
            for run in unbroken_runs(e):
                late, sent = late_inputs(run, self.delay, rest=self._rest, before=sent)
                parts += complete_runs(late, shortest=1) if has_gaps(late) else [late]
                transit, sent = sent, None
            for part in parts:
                joins = continues and unbroken and part.rows[0] == e.rows[0]
                last = part.rows[-1] == e.rows[-1]
                if len(part.rows) > 1 or joins or last:
                    out.append(Piece(part.inputs, part.measured, not joins))
            unbroken = bool(parts) and parts[-1].rows[-1] == e.rows[-1]
        self._label, self._open, self._in_transit = ordered[-1].label, unbroken, transit
        return out

    @one_blas_thread
    def _fit_kept(self, left: Sequence[Piece]) -> tuple[LocalFit | None, list[Piece]]:
        """Fit while all samples are still there; what they leave no room for."""
        buffer, choices, left = self._buffer, self._choices, list(left)
        if not buffer.pairs:  # nothing but gaps so far
            return None, left
        while True:
            full = bool(left) or buffer.n_samples >= BUFFER
            try:
                fitted, _ = fit_samples(Samples(buffer.pairs, choices, self._telling))
                break
            except TooFewSamples as error:
                if not full:
                    return None, left  # more samples may come
                if not choices.initial_states:
                    raise  # what is cut off at its start did not start from rest
                self._telling.once(
                    "waiting",
                    f"The first {BUFFER:,} samples of the stream leave it without a "
                    "model, and its oldest samples are left out until it has one. "
                    f"{error}",
                )
                left = buffer.slide(left)
        warn_about(fitted, self._telling)
        if full:
            self._summary = StreamSummary(fitted, choices, buffer.n_samples)
            self._first_residual = fitted.residual
            self._buffer = SampleBuffer(gaps=False)
        return fitted, left

    @one_blas_thread
    def _fit_summaries(self, summary: StreamSummary) -> LocalFit:
        fitted = summary.fit()
        warn_about_pole(fitted.model.A, self._telling)
        # A linearisation may not see itself how far off it is.
        error = np.fmax(fitted.residual, summary.latest_error(fitted.model))
        warn_about_drift(float(error), self._first_residual, BUFFER, self._telling)
        return fitted


def _without_labels(
    X: Any, y: Any, inputs: Sequence[Hashable], outputs: Sequence[Hashable] | None
) -> tuple[Any, Any]:
    """Tables of these columns as arrays, where their labels tell nothing; else None."""
    if type(X) is not pd.DataFrame or tuple(X.columns) != inputs:
        return None, None
    if outputs is not None and list(getattr(y, "columns", outputs)) != [*outputs]:
        return None, None
    ordered = isinstance(X.index, pd.RangeIndex) and X.index.step > 0
    if type(y) in (pd.DataFrame, pd.Series) and X.index.equals(y.index):
        y = y.to_numpy()
    return (X.to_numpy(), y) if ordered or len(X) == 1 else (None, None)


def _same(first: Any, other: Any) -> bool:
    if hasattr(first, "__array__") or hasattr(other, "__array__"):
        return np.array_equal(first, other)
    return bool(first == other)


def fit_as_stream(
    samples: Samples, *, detrend: str | None, gaps: bool
) -> LocalFit | None:
    """Fit a long table as a stream of its samples; `gaps` as in `SampleBuffer`.

    None where that would not do: few samples, first ones that say too little, or a
    closed loop.
    """
    pairs, choices, _ = samples
    if sum(len(u) for u, _ in pairs) <= BUFFER or choices.method == "pbsid":
        return None
    pairs, u_mean, y_mean = remove_trends(pairs, detrend)
    buffer = SampleBuffer(gaps)
    left = buffer.add([Piece(u, y, True) for u, y in pairs])
    first = buffer.pairs
    if not _as_independent(first, pairs):
        return None
    try:
        begun, _ = fit_samples(samples._replace(pairs=first))
        if begun.method == "pbsid":
            return None
        choices = choices._replace(method=begun.method)
        summary = StreamSummary(begun, choices, buffer.n_samples)
        for piece in left:
            summary.add(piece)
        fitted = summary.fit()
    except ValueError:
        return None
    kept = [Piece(u, y, True) for u, y in first]
    own = summary.own_unknowns(fitted.model, kept, left)
    if own is None:
        return None
    states, offsets = own
    return fitted._replace(
        model=fitted.model._replace(initial_states=states),
        offsets=offsets.shifted(u_mean, y_mean),
    )


def _as_independent(first: Pairs, pairs: Pairs) -> bool:
    """Whether the inputs of the first samples vary as independently as those of all."""
    inputs = [u for u, _ in first]
    if len(constant_columns(inputs)):
        return False
    basis = independent_inputs(inputs)
    if basis is None:
        return True
    others = independent_inputs([u for u, _ in pairs])
    return others is not None and others.shape == basis.shape
