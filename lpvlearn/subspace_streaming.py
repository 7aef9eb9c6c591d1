"""`SubspaceLTI.partial_fit`: identification from a stream of batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from .experiments import Experiment
from .stream import BUFFER, Pairs, SampleStream
from .subspace_fit import LocalFit
from .subspace_options import Choices, check_options, warn_about, warn_about_pole
from .subspace_statistics import SimulationErrorStatistics


class StreamedFit(SimulationErrorStatistics):
    """Mixin: the model of a stream, from samples at first, then from summaries."""

    detrend: str | None
    experiment: Any
    order_: int
    horizon_: int
    _stream: SampleStream | None

    if TYPE_CHECKING:  # of the estimator

        def _fit_pairs(self, pairs: Pairs, choices: Choices) -> LocalFit: ...
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
            If an option is unknown, or `detrend` is set: a trend needs the whole
            experiment.

        Notes
        -----
        The first 131,072 samples are kept, and the model is that of `fit` on them. Then
        order and horizon stay, and only summaries grow: the compressed Hankel
        data, exact to rounding, and (``refine=True``) the simulation error
        linearised around the model of the moment, each sample once, a recursive
        Gauss-Newton method whose estimate agrees with that of `fit` up to a small part
        of its standard deviation. With ``refine=False``, A and C are those that `fit`
        would find; B and D follow from the compressed data alone, less accurately
        than by the simulation least squares of `fit`, which needs the samples
        again.

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
        stream = getattr(self, "_stream", None)
        experiments, _ = self._read(X, y, reset=stream is None, split=False)
        if stream is None:
            stream = self._stream = SampleStream()
            self._single_output = np.asarray(y).ndim == 1
            self._set_step(experiments)
        pieces = stream.pieces(experiments, named=self.experiment is not None)
        if not stream.buffered:
            stream.extend(pieces)
            self._take_summaries(stream)
            warn_about_pole(self.lti_.A)
            return self
        stream.keep(pieces)
        if not stream.pairs:  # nothing but gaps so far
            return self
        full = stream.n_samples >= BUFFER
        try:
            fitted = self._fit_pairs(stream.pairs, choices)
        except ValueError:
            if full:
                raise
            return self  # more samples may come
        warn_about(fitted.found)
        if full:
            chosen = {"order": self.order_, "horizon": self.horizon_}
            stream.summarise(fitted, self._fit_options() | chosen)
        return self

    def _take_summaries(self, stream: SampleStream) -> None:
        model, singular_values = stream.model()
        self._set_model(model, singular_values, stream.relative_error())
        kept = sum(record.u.shape[1] for record in self._evidence.records)
        self._keep_evidence(self._evidence._replace(share=kept / stream.n_samples))
