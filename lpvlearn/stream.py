"""The bookkeeping of `SubspaceLTI.partial_fit`: batches to experiments to summaries."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .experiments import Experiment
from .missing_data import complete_runs, has_gaps
from .numerics.realization import (
    ObservabilitySubspace,
    observability_subspace,
    reflect_unstable,
    shift_invariant_pair,
)
from .numerics.refinement import experiment_regressions, in_sections
from .numerics.signals import Record
from .numerics.simulationfit import Realization
from .numerics.streaming import (
    HankelSum,
    Recursion,
    current_model,
    extend_hankel_sum,
    extend_recursion,
    factor_input_matrices,
    start_hankel_sum,
    start_recursion,
)
from .subspace_fit import LocalFit

Array = NDArray[np.float64]
Pairs = list[tuple[Array, Array]]

# Samples that are kept, and fitted like one table, before only summaries grow.
BUFFER = 131_072
# Samples of an experiment that are linearised together; fewer wait for the next batch.
_STRETCH = 8_192
_MARGIN = 1e-8


class Piece(NamedTuple):
    """Consecutive samples of one experiment.

    Attributes
    ----------
    u, y : ndarray
    starts : bool
        False where they continue the experiment that came last.
    """

    u: Array
    y: Array
    starts: bool


class SampleStream:
    """Samples seen so far: all of them at first, then their summaries.

    Attributes
    ----------
    n_samples : int
        Seen in total.
    pairs : list of (u, y)
        Experiments kept so far, of which the last may continue.
    """

    def __init__(self) -> None:
        self.n_samples = 0
        self.pairs: Pairs = []
        self._label: Hashable = None
        self._open = False
        self._summary: _Summary | None = None

    @property
    def buffered(self) -> bool:
        """Whether all samples are still there."""
        return self._summary is None

    def pieces(self, experiments: Sequence[Experiment], named: bool) -> list[Piece]:
        """Samples of a batch, in the order of time.

        Parameters
        ----------
        experiments : sequence of Experiment
            In the order in which they appear in the batch.
        named : bool
            Whether a column tells experiments apart; without one the stream is a single
            experiment.
        """
        # The experiment whose sample came last may continue in the next batch.
        ordered = sorted(experiments, key=lambda e: int(e.rows[-1]))
        first = [e for e in ordered if not named or e.label == self._label]
        if self._open and first:
            ordered = first[:1] + [e for e in ordered if e is not first[0]]
        out = []
        for i, e in enumerate(ordered):
            continues = self._open and i == 0 and bool(first)
            parts = complete_runs(e) if has_gaps(e) else [e]
            for part in parts:
                assert part.outputs is not None
                joins = continues and part.rows[0] == e.rows[0]
                out.append(Piece(part.inputs, part.outputs, not joins))
            unbroken = bool(parts) and parts[-1].rows[-1] == e.rows[-1]
        self._label, self._open = ordered[-1].label, unbroken
        self.n_samples += sum(len(piece.u) for piece in out)
        return out

    def keep(self, pieces: Sequence[Piece]) -> None:
        """Add to the samples that are kept."""
        for u, y, starts in pieces:
            if starts or not self.pairs:
                self.pairs.append((u, y))
            else:
                before = self.pairs[-1]
                self.pairs[-1] = np.vstack([before[0], u]), np.vstack([before[1], y])

    def summarise(self, fitted: LocalFit, options: dict[str, Any]) -> None:
        """Replace the samples by their summaries around the model fitted to them."""
        self._summary = _Summary(fitted, options)
        self.pairs = []

    def extend(self, pieces: Sequence[Piece]) -> None:
        """Add to the summaries."""
        assert self._summary is not None
        for piece in pieces:
            self._summary.add(piece)

    def model(self) -> tuple[Realization, Array]:
        """Model of everything summarised, in scaled units, and singular values."""
        assert self._summary is not None
        return self._summary.model()

    def relative_error(self) -> float:
        """Simulation error relative to the outputs, NaN where it is not known."""
        assert self._summary is not None
        return self._summary.relative_error()


class _Summary:
    """Both summaries, in the scale of the samples they began with."""

    def __init__(self, fitted: LocalFit, options: dict[str, Any]) -> None:
        evidence, found = fitted.evidence, fitted.found
        free = evidence.free
        self._free, self._options, self._basis = free, options, evidence.basis
        self._su, self._sy = found.input_scale, found.output_scale
        records = fitted.scaled.records
        samples = [np.vstack(record).T for record in records]
        m, past_outputs = len(self._su), options["method"] != "pi-moesp"
        self._sum: HankelSum = start_hankel_sum(
            samples, m, options["horizon"], past_outputs=past_outputs
        )
        self._waiting = np.zeros((0, samples[0].shape[1]))
        self._recursion: Recursion | None = None
        self._state = np.zeros(options["order"])
        # Per channel: the batch fit weighs the outputs by their final size.
        self._energy = sum((z**2).sum(axis=0) for z in samples)
        self._n_samples = sum(len(z) for z in samples)
        if options["refine"]:
            pilot = in_sections(found.scaled_model)
            parts = None
            if pilot.blocks is not None and np.isfinite(pilot.loss):
                parts = experiment_regressions(pilot, records, free)
            if parts is not None:
                self._recursion = start_recursion(pilot, parts, free)
                self._state = pilot.initial_states[-1]

    def _scaled(self, u: Array, y: Array) -> Array:
        return np.hstack([u @ self._basis / self._su, y / self._sy])

    def add(self, piece: Piece) -> None:
        z = self._scaled(piece.u, piece.y)
        self._energy = self._energy + (z**2).sum(axis=0)
        self._n_samples += len(z)
        self._sum = extend_hankel_sum(self._sum, z, starts=piece.starts)
        if self._recursion is None:
            return
        if piece.starts:
            self._linearise(self._waiting)
            self._waiting = z
        else:
            self._waiting = np.vstack([self._waiting, z])
        if len(self._waiting) >= _STRETCH:
            self._linearise(self._waiting)
            self._waiting = np.zeros((0, z.shape[1]))

    def _linearise(self, samples: Array) -> None:
        if len(samples) == 0:
            return
        assert self._recursion is not None
        record = _record(samples, len(self._su))
        self._recursion, self._state = extend_recursion(
            self._recursion, record, self._free
        )

    def relative_error(self) -> float:
        if self._recursion is None:
            return float("nan")
        loss = current_model(self._recursion, self._free).loss
        energy = float(self._energy[len(self._su) :].sum())
        return float(np.sqrt(loss / energy)) if energy > 0.0 else 0.0

    def model(self) -> tuple[Realization, Array]:
        subspace, factor, scale = self._subspace()
        limit = 1.0 - _MARGIN if self._options["enforce_stability"] else None
        if self._recursion is not None:
            found = current_model(self._recursion, self._free)
            found = found._replace(initial_states=self._state[None])
            if limit is not None:
                found = found._replace(A=reflect_unstable(found.A, limit))
            return found, subspace.singular_values
        order, ny = self._options["order"], len(self._sy)
        A, C = shift_invariant_pair(subspace.basis, ny, order)
        A = reflect_unstable(A, 1.0 if limit is None else limit)
        B, D = factor_input_matrices(factor, A, C, self._free, self._sum.horizon)
        su, sy = scale[: len(self._su)], scale[len(self._su) :, None]
        B, C, D = B / su, sy * C, sy * D / su
        states = np.zeros((1, order))
        return Realization(A, B, C, D, states, np.nan), subspace.singular_values

    def _subspace(self) -> tuple[ObservabilitySubspace, Array, Array]:
        """Subspace and factor of channels of unit size, and their size in ours."""
        m, ny = len(self._su), len(self._sy)
        scale = np.sqrt(self._energy / self._n_samples)
        scale[scale == 0.0] = 1.0
        factor = self._sum.triangular() / scale[self._sum.rows % (m + ny)][:, None]
        subspace = observability_subspace(
            factor,
            m,
            ny,
            self._sum.horizon,
            self._options["order"],
            self._options["method"],
        )
        return subspace, factor, scale


def _record(samples: Array, n_inputs: int) -> Record:
    return Record(
        np.ascontiguousarray(samples[:, :n_inputs].T),
        np.ascontiguousarray(samples[:, n_inputs:].T),
    )
