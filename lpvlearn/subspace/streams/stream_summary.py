"""The summaries of a stream, and the model that they hold.

What remains of a sample once it is not kept any more: its part in the compressed Hankel
data, of which the subspace step is made, and in the simulation error linearised around
the model of the moment, of which the refinement, B and D are made.

Samples are taken up in stretches of fixed length, counted from where an experiment
starts. A stream therefore gives the same model to the last digit however it is cut
into batches, and a long table, which is taken up in the same way, gives it too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evidence.offsets import Offsets, attributed, joined
from ..fits.local_fit import LocalFit
from ..fits.options import Choices
from ..orders.identification import STABLE_LOSS, STABLE_MARGIN
from ..orders.realization import (
    ObservabilitySubspace,
    factor_input_matrices,
    observability_subspace,
    reflect_unstable,
)
from ..samples.hankel import HankelSum, extend_hankel_sum, start_hankel_sum
from ..samples.records import Centres, Record, centred
from ..simulation_error.simulation_fit import Realization, in_sections
from .recursive_refinement import (
    Recursion,
    StretchError,
    current_model,
    extend_recursion,
    input_matrices,
    start_recursion,
    stretch_error,
)

Array = NDArray[np.float64]

# Samples that are taken up together; fewer wait for the next batch. The longer, the
# fewer initial states are estimated on the way; this many stay in the cache.
STRETCH = 16_384

# Latest samples that a model is simulated on: a quarter of a stretch is cheap enough
# for every batch, and tells an error of several times the usual one.
_LATEST = 4_096

# Inputs outside the span of the first ones, relative to their size, beyond rounding.
_OUTSIDE = 1e-8

# Difference of the simulation error from its linearisation that is accepted: in
# variances of the estimate per parameter; of an unrefined model, whose error is larger,
# relative; and relative to the outputs' energy, for data without noise.
_EXCESS, _EXCESS_UNREFINED, _ROUNDING = 0.25, 5e-4, 1e-16


class Piece(NamedTuple):
    """Consecutive samples of one experiment."""

    u: Array
    y: Array
    starts: bool  # False where they continue the experiment that came last


class _Sums(NamedTuple):
    """Sums over the samples taken up."""

    hankel: HankelSum
    recursion: Recursion | None  # None where the first model cannot be linearised at
    initial_state: Array  # of the last stretch
    offsets: Offsets  # mean of all so far, one row
    energy: Array  # per channel: the subspace step weighs outputs by their final size
    n_samples: int
    point: Realization | None = None  # where to linearise if not at the minimum
    next_point: int = 0  # number of samples from which to look for another such point


class _SubspaceStep(NamedTuple):
    """The subspace step on channels of unit size."""

    subspace: ObservabilitySubspace
    factor: Array  # triangular, of the Hankel data
    input_size: Array  # of the channels, in our scale
    output_size: Array


class StreamSummary:
    """Compressed Hankel data and linearised simulation errors of a stream.

    Begins with the model `fitted` to its first `n_samples`.
    """

    def __init__(self, fitted: LocalFit, choices: Choices, n_samples: int) -> None:
        scaled, self._free = fitted.scaled, fitted.evidence.free
        # The samples themselves are not kept, but for those of the evidence.
        self._first = fitted._replace(scaled=scaled._replace(records=[]))
        self._choices, self._n_samples = choices, n_samples
        self._order, self._horizon = fitted.selection.order, fitted.selection.horizon
        self._basis = fitted.evidence.basis
        self._su, self._sy = scaled.input_scale, scaled.output_scale
        samples = [np.vstack((r.u, r.y)).T for r in scaled.records]
        hankel = start_hankel_sum(
            samples,
            len(self._su),
            self._horizon,
            past_outputs=choices.method != "pi-moesp",
            n_trend=self._free.n_trend,
        )
        if self._free.n_trend:  # what follows is about another level
            hankel = hankel._replace(tail=hankel.tail[:0])
        self._waiting = self._latest = np.zeros((0, samples[0].shape[1]))
        self._starts = False
        pilot = in_sections(fitted.model)
        self._sums = _Sums(
            hankel,
            start_recursion(pilot, scaled.records, self._free),
            pilot.initial_states[-1],
            fitted.offsets.pooled(),
            np.sum([(z**2).sum(axis=0) for z in samples], axis=0),
            sum(len(z) for z in samples),
        )

    @property
    def takes_all_inputs(self) -> bool:
        """Whether there are none that `add` refuses, as the first were independent."""
        return self._basis.shape[0] == self._basis.shape[1]

    def add(self, piece: Piece) -> None:
        """Take up what follows."""
        if piece.starts:
            self._sums = self._with_waiting()
            self._waiting, self._starts = self._waiting[:0], True
        start = 0
        while start < len(piece.u):  # in parts that stay in the cache
            stop = start + STRETCH - len(self._waiting)
            part = self._scaled(piece.u[start:stop], piece.y[start:stop])
            self._waiting = np.vstack([self._waiting, part])
            self._latest = self._waiting[-_LATEST:]
            if len(self._waiting) == STRETCH:
                self._sums = self._with(self._sums, self._waiting, self._starts)
                self._waiting, self._starts = np.empty_like(part[:0]), False
            start = stop
        self._n_samples += len(piece.u)

    def fit(self) -> LocalFit:
        """Model of everything seen, in the scale of the first samples.

        The evidence is that of the first samples. The residual is NaN where it is not
        known.
        """
        sums = self._with_waiting()
        step = self._subspace_step(sums)
        enforce = self._choices.enforce_stability
        refine = self._choices.refine is not False
        if refine and sums.recursion is not None:
            best = current_model(sums.recursion)
            best = best._replace(initial_states=sums.initial_state[None])
        else:
            best = self._with_inputs(*self._state_pair(step), sums, step)
        energy = float(sums.energy[len(self._su) :].sum()) or 1.0
        model, lost = best, 0.0
        A = reflect_unstable(best.A, 1.0 - STABLE_MARGIN if enforce else 1.0)
        if A is not best.A:
            stable = self._with_inputs(A, best.C, sums, step)
            if enforce:
                lost = np.sqrt(stable.loss / energy) - np.sqrt(best.loss / energy)
                lost = max(0.0, float(lost))
            if enforce or (not refine and stable.loss <= STABLE_LOSS * best.loss):
                model = stable
        evidence = self._first.evidence
        kept = sum(record.n_samples for record in evidence.records)
        return self._first._replace(
            model=model._replace(rank_deficit=self._first.model.rank_deficit),
            offsets=sums.offsets,
            singular_values=step.subspace.singular_values,
            residual=float(np.sqrt(model.loss / energy)),
            stability_loss=lost,
            evidence=replace(
                evidence,
                model=model,
                share=kept / self._n_samples,
                refined=evidence.refined and lost == 0.0,
            ),
        )

    def latest_error(self, model: Realization) -> float:
        """Simulation error of the latest samples themselves, relative to the outputs.

        That of a model of `fit`, root mean square, relative to that of all outputs or,
        where these are larger, of the latest ones; NaN where it is not known.
        """
        n, m = len(self._latest), len(self._su)
        if model.blocks is None or n == 0:
            return np.nan
        record, _ = self._record(self._latest)
        loss = stretch_error(model, record, self._free, starts=False).loss
        power = self._sums.energy[m:].sum() / self._sums.n_samples
        power = max(power, (record.y**2).sum() / n)
        return float(np.sqrt(loss / n / (power or 1.0)))

    def own_unknowns(
        self, model: Realization, first: Sequence[Piece], others: Sequence[Piece]
    ) -> tuple[Array, Offsets] | None:
        """Initial states and offsets, where the samples themselves are still there.

        For a model of `fit`, the pieces that the summaries began with, and all that
        were added. None where the simulation error of the samples is not what the
        summaries make it: the model of the first ones was too far off to linearise at.
        """
        if self._sums.recursion is None or model.blocks is None:
            return None
        states, loss = [], 0.0
        offsets: list[list[Offsets]] = []
        for samples, starts in chain(
            ((self._scaled(u, y), True) for u, y, _ in first), self._stretches(others)
        ):
            record, centres = self._record(samples)
            found = stretch_error(model, record, self._free, starts=starts)
            loss += found.loss
            if starts:
                states.append(found.initial_state)
                offsets.append([])
            offsets[-1].append(self._offsets(model, found, samples, centres))
        sums = self._with_waiting()
        energy = float(sums.energy[len(self._su) :].sum())
        n_values = sums.n_samples * len(self._sy)
        share = _EXCESS * len(self._sums.recursion.position) / n_values
        if self._choices.refine is False:
            share = max(share, _EXCESS_UNREFINED)
        if not abs(loss - model.loss) <= share * model.loss + _ROUNDING * energy:
            return None
        by_experiment = joined([joined(parts).pooled() for parts in offsets])
        differ = self._first.offsets.differ
        return (
            np.array(states).reshape(len(states), len(model.A)),
            by_experiment._replace(differ=differ),
        )

    def _stretches(self, pieces: Sequence[Piece]) -> Iterator[tuple[Array, bool]]:
        for u, y, starts in pieces:
            for start in range(0, len(u), STRETCH):
                part = slice(start, start + STRETCH)
                yield self._scaled(u[part], y[part]), starts and start == 0

    def _scaled(self, inputs: Array, outputs: Array) -> Array:
        u = inputs @ self._basis
        if self._basis.shape[0] > self._basis.shape[1]:
            back = u @ np.linalg.pinv(self._basis)
            if np.abs(back - inputs).max() > _OUTSIDE * np.abs(inputs).max():
                raise ValueError(
                    "Inputs that are collinear in the first samples of a stream must "
                    "stay so. Got others later: begin with samples in which all inputs "
                    "vary independently."
                )
        return np.hstack([u / self._su, outputs / self._sy])

    def _record(self, samples: Array) -> tuple[Record, Centres]:
        """The record of a stretch, and what was subtracted from it."""
        m, n_trend = len(self._su), self._free.n_trend
        pairs = [(samples[:, :m], samples[:, m:])]
        pairs, centres = centred(pairs, n_trend, self._free.initial_states)
        return Record.of(*pairs[0], n_trend), centres

    def _offsets(
        self, model: Realization, found: StretchError, samples: Array, centres: Centres
    ) -> Offsets:
        """Offsets of a stretch, in the units of the data."""
        m, back = len(self._su), self._su[:, None] * np.linalg.pinv(self._basis)
        # stretches begin where others end, not at rest
        beginnings = np.zeros((0, len(model.A)))
        model = model._replace(trends=found.trends[None], initial_states=beginnings)
        evidence = replace(self._first.evidence, model=model)
        return attributed(
            evidence,
            Centres(centres.inputs @ back, centres.trends * self._sy),
            [(samples[:, :m] @ back, samples[:, m:])],
        )

    def _with_waiting(self) -> _Sums:
        # A single sample tells nothing but its own initial state.
        if len(self._waiting) <= self._starts:
            return self._sums
        return self._with(self._sums, self._waiting, self._starts)

    def _with(self, sums: _Sums, samples: Array, starts: bool) -> _Sums:
        """The sums, continued by a stretch of samples."""
        recursion, (record, centres) = sums.recursion, self._record(samples)
        if recursion is not None:
            if self._choices.refine is False and sums.n_samples >= sums.next_point:
                # The subspace step, not the minimum, is where the model will be.
                sums = sums._replace(
                    point=self._subspace_model(sums), next_point=2 * sums.n_samples
                )
            recursion, found = extend_recursion(
                recursion, record, starts=starts, point=sums.point
            )
            sums = sums._replace(recursion=recursion, initial_state=found.initial_state)
            if self._free.n_trend and np.isfinite(found.loss):
                model = current_model(recursion)
                latest = self._offsets(model, found, samples, centres)
                sums = sums._replace(offsets=joined([sums.offsets, latest]).pooled())
        power = [(signals**2).sum(axis=1) for signals in (record.u, record.y)]
        return sums._replace(
            hankel=extend_hankel_sum(sums.hankel, samples, starts=starts),
            energy=sums.energy + np.concatenate(power),
            n_samples=sums.n_samples + len(samples),
        )

    def _subspace_model(self, sums: _Sums) -> Realization | None:
        """Model of the subspace step so far, in the blocks of the recursion."""
        assert sums.recursion is not None
        A, C = self._state_pair(self._subspace_step(sums))
        found = input_matrices(sums.recursion, reflect_unstable(A), C)
        return sums.point if found is None else found

    def _subspace_step(self, sums: _Sums) -> _SubspaceStep:
        m, ny, hankel = len(self._su), len(self._sy), sums.hankel
        size = np.sqrt(sums.energy / sums.n_samples)
        size[size == 0.0] = 1.0
        factor = hankel.triangular() / size[hankel.rows % (m + ny)][:, None]
        subspace = observability_subspace(
            factor,
            m,
            ny,
            self._horizon,
            self._order + self._choices.n_noise_states,
            self._choices.method,
        )
        return _SubspaceStep(subspace, factor, size[:m], size[m:])

    def _state_pair(self, step: _SubspaceStep) -> tuple[Array, Array]:
        """A and C of the subspace step, in our scale."""

        def with_inputs(
            A: Array, C: Array, _: Sequence[int]
        ) -> tuple[Array, Array, Array]:
            # The samples are gone: B by the factor alone.
            factor, horizon = step.factor, self._horizon
            return A, factor_input_matrices(factor, A, C, self._free, horizon)[0], C

        A, C = step.subspace.state_pair(
            len(self._sy), self._order, self._choices.n_noise_states, with_inputs
        )
        return A, step.output_size[:, None] * C

    def _with_inputs(
        self, A: Array, C: Array, sums: _Sums, step: _SubspaceStep
    ) -> Realization:
        """B and D, in our scale: by the recursion, else from the factor alone."""
        found = None
        if sums.recursion is not None:
            found = input_matrices(sums.recursion, A, C)
        if found is None:
            su, sy = step.input_size, step.output_size[:, None]
            B, D = factor_input_matrices(
                step.factor, A, C / sy, self._free, self._horizon
            )
            found = Realization(A, B / su, C, sy * D / su, np.zeros((1, 0)), np.nan)
        return found._replace(initial_states=np.zeros((1, len(A))))
