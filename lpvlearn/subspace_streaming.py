"""`SubspaceLTI.partial_fit`, and `fit` of long tables: one pass over the samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from .columns import Column, Table, is_table
from .excitation import constant_inputs, independent_inputs
from .experiments import Experiment
from .missing_data import remove_trends
from .stream import BUFFER, Pairs, SampleStream
from .stream_summary import Piece, StreamedModel
from .subspace_fit import LocalFit, TooFewSamples, check_for_all_samples
from .subspace_options import (
    Choices,
    check_options,
    warn_about,
    warn_about_drift,
    warn_about_pole,
    warn_about_waiting,
)
from .subspace_statistics import SimulationErrorStatistics


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
