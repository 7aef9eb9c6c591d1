"""The bookkeeping of `SubspaceLTI.partial_fit`: batches to experiments to summaries."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy, deepcopy
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..data.columns import Column, Table, is_table
from ..data.experiments import Experiment
from ..data.preparation import (
    complete_runs,
    constant_inputs,
    has_gaps,
    independent_inputs,
    remove_trends,
)
from ..data.timestamps import check_uniform_time, time_in_seconds
from .fit import LocalFit, TooFewSamples, check_for_all_samples
from .options import (
    Choices,
    check_options,
    warn_about,
    warn_about_drift,
    warn_about_pole,
    warn_about_waiting,
)
from .statistics import SimulationErrorStatistics
from .stream_summary import Piece, StreamedModel, StreamSummary

Array = NDArray[np.float64]

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


class StreamedFit(SimulationErrorStatistics):
    """Mixin: the model of a stream, from samples at first, then from summaries."""

    detrend: str | None
    experiment: Any
    feedthrough: Any
    initial_state: str
    method: str
    time: Any
    missing: str
    order_: int
    horizon_: int
    stability_loss_: float
    _stream: SampleStream | None

    if TYPE_CHECKING:  # of the estimator

        def _fit_pairs(
            self,
            pairs: Pairs,
            choices: Choices,
            detrend: str | None,
            told: set[str] | None = None,
        ) -> LocalFit: ...
        def get_params(self, deep: bool = True) -> dict[str, Any]: ...
        def _fit_options(self) -> dict[str, Any]: ...
        def _set_step(self, experiments: Sequence[Experiment]) -> None: ...

    def partial_fit(self, X: Any, y: Any) -> Self:
        """Go on with the next batch of a stream, in memory independent of its length.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            As in `fit`. Without an `experiment` column all batches are one
            experiment. With one, a batch whose first label is the last one of
            the batch before continues that experiment; every other label starts one.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)

        Returns
        -------
        self
            Without a model (`lti_`) as long as the samples are too few for one. After
            `fit` a new stream begins.

        Raises
        ------
        ValueError
            If an option is unknown or not the one that the stream began with, or
            `detrend` is set: a trend needs the whole experiment. If the `time` column
            repeats or leaves out samples between two batches of an experiment, or
            its step changes. If a batch has other columns than the first one.
            Everything is then as before the batch, and the right one may follow.

        Warns
        -----
        UserWarning, RankWarning
            As `fit`, once per stream. If the first 131,072 samples are too few for a
            model, such as with a constant input, and if the simulation error grows
            far above that of the first samples.

        Notes
        -----
        The model is the one that `fit` finds from all batches as one table, however
        they are cut. The first 131,072 samples are kept (the last ones where the first
        do not make a model). Then order and
        horizon stay, and only summaries grow: the compressed Hankel data, and
        the simulation error linearised around the model of the moment, each sample
        once. Of a longer table `fit` makes the same summaries in the same order. It
        alone can go back to the samples, and does so where the linearisation turns out
        to be poor: the first 131,072 samples hardly excite what comes later, outputs
        drift, or (``refine=False``) the order is higher than the data support.

        Examples
        --------
        >>> import numpy as np
        >>> from lpvlearn import SubspaceLTI
        >>> rng = np.random.default_rng(0)
        >>> model, last = SubspaceLTI(1, horizon=5), 0.0
        >>> for _ in range(3):
        ...     u, y = rng.standard_normal((200, 1)), np.empty(200)
        ...     for k in range(200):
        ...         y[k] = last
        ...         last = 0.9 * y[k] + u[k, 0]
        ...     model = model.partial_fit(u, y)
        >>> model.lti_.poles().round(6)
        array([0.9+0.j])
        """
        choices = check_options(self)
        if self.detrend is not None:
            raise ValueError(
                "`detrend` must be None in partial_fit, which never sees a whole "
                f"experiment. Got {self.detrend!r}."
            )
        with _unchanged_where_refused(self):
            stream, pieces = self._begin_batch(X, y, choices)
            if stream.clock.step is not None:
                self._step = stream.clock.step
            if stream.buffered:
                pieces = self._fit_kept(stream, pieces, choices)
            if pieces and not stream.buffered:
                found = stream.extend(pieces)
                self._take_summaries(stream, found)
                warn_about_pole(self.lti_.A, stream.told)
                # A linearisation may not see itself how far off it is.
                latest = stream.summary.latest_error(found.model)
                error = float(np.fmax(found.residual, latest))
                warn_about_drift(error, stream.first_residual, BUFFER, stream.told)
            self._stream = stream
        return self

    def _begin_batch(
        self, X: Any, y: Any, choices: Choices
    ) -> tuple[SampleStream, list[Piece]]:
        """The stream with the clock of a checked batch, and the batch's samples."""
        before, options = getattr(self, "_stream", None), self.get_params(deep=False)
        if before is not None:
            before.check_options(options)
        experiments, _ = self._read(X, y, reset=before is None, split=False)
        outputs = experiments[0].outputs
        assert outputs is not None
        if before is None:
            n_inputs, n_outputs = experiments[0].inputs.shape[1], outputs.shape[1]
            check_for_all_samples(
                BUFFER, n_inputs, n_outputs, choices, self.feedthrough, self.method
            )
            stream = SampleStream(options, gaps=self.missing == "split")
            self._single_output = np.asarray(y).ndim == 1
            self._set_step(experiments)
        else:
            stream = before.branch()
        stream.check_outputs(outputs.shape[1])
        named = self.experiment is not None
        return stream, stream.pieces(experiments, named, self._times(X))

    def _fit_kept(
        self, stream: SampleStream, pieces: Sequence[Piece], choices: Choices
    ) -> list[Piece]:
        """Fit while all samples are still there; what they leave no room for."""
        left = stream.keep(pieces)
        if not stream.pairs:  # nothing but gaps so far
            return left
        while True:
            full = bool(left) or stream.n_samples >= BUFFER
            try:
                fitted = self._fit_pairs(stream.pairs, choices, None, stream.told)
                break
            except TooFewSamples as error:
                if not full:
                    return left  # more samples may come
                if self.initial_state == "rest":
                    raise  # what is cut off at its start did not start from rest
                warn_about_waiting(BUFFER, error, stream.told)
                left = stream.slide(left)
        warn_about(fitted.found, stream.told, stacklevel=4)
        if full:
            self._summarise(stream, fitted, choices)
        return left

    def _summarise(
        self, stream: SampleStream, fitted: LocalFit, choices: Choices
    ) -> None:
        chosen = {
            "order": self.order_,
            "horizon": self.horizon_,
            "n_noise_states": choices.n_noise_states,
        }
        stream.summarise(fitted, self._fit_options() | chosen)

    def _fit_in_one_pass(self, pairs: Pairs, choices: Choices) -> LocalFit | None:
        """Fit a long table as a stream of its samples.

        None where that would not do: few samples, or first ones that say too little.
        """
        if sum(len(u) for u, _ in pairs) <= BUFFER:
            return None
        pairs, u_offset, y_offset = remove_trends(pairs, self.detrend)
        stream = SampleStream(gaps=self.missing == "split")
        left = stream.keep([Piece(u, y, True) for u, y in pairs])
        first = [Piece(u, y, True) for u, y in stream.pairs]
        if not _as_independent(stream.pairs, pairs):
            return None
        try:
            fitted = self._fit_pairs(stream.pairs, choices, None)
            self._summarise(stream, fitted, choices)
            found = stream.extend(left)
        except ValueError:
            return None
        states = stream.summary.initial_states(found, first, left)
        if states is None:
            return None
        self.input_offset_, self.output_offset_ = u_offset, y_offset
        self._take_summaries(stream, found)
        self.initial_states_ = states
        pilot = fitted.found
        return fitted._replace(
            found=pilot._replace(
                A=self.lti_.A,
                residual=self.residual_,
                stability_loss=self.stability_loss_,
            )
        )

    def _take_summaries(self, stream: SampleStream, found: StreamedModel) -> None:
        self._set_model(found.model, found.singular_values, found.residual)
        self.stability_loss_ = found.stability_loss
        kept = sum(record.u.shape[1] for record in self._evidence.records)
        self._keep_evidence(
            self._evidence._replace(
                share=kept / stream.n_samples,
                refined=self._evidence.refined and found.stability_loss == 0.0,
            )
        )

    def _times(self, X: Any) -> Column | None:
        if self.time is None:
            return None
        found = Table(X if is_table(X) else np.asarray(X)).one(self.time, "time")
        return None if found is None else found[1]


@contextmanager
def _unchanged_where_refused(estimator: Any) -> Iterator[None]:
    """Put the attributes back where a batch ends in an error."""
    before = dict(vars(estimator))
    try:
        yield
    except BaseException:
        vars(estimator).clear()
        vars(estimator).update(before)
        raise


def _as_independent(first: Pairs, pairs: Pairs) -> bool:
    """Whether the inputs of the first samples vary as independently as those of all."""
    inputs = [u for u, _ in first]
    if len(constant_inputs(inputs)):
        return False
    basis = independent_inputs(inputs)
    if basis is None:
        return True
    others = independent_inputs([u for u, _ in pairs])
    return others is not None and others.shape == basis.shape
