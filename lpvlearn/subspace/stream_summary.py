"""The summaries of a stream, and the model that they hold.

Samples are taken up in stretches of fixed length, counted from where an experiment
starts. A stream therefore gives the same model to the last digit however it is cut
into batches, and a long table, which is taken up in the same way, gives it too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .fit import LocalFit
from .hankel import HankelSum, extend_hankel_sum, start_hankel_sum
from .identification import STABLE_LOSS, STABLE_MARGIN
from .realization import (
    ObservabilitySubspace,
    dominant_pair,
    factor_input_matrices,
    observability_subspace,
    reflect_unstable,
    shift_invariant_pair,
)
from .recursive_refinement import (
    Recursion,
    current_model,
    extend_recursion,
    input_matrices,
    start_recursion,
    stretch_error,
)
from .refinement import experiment_regressions, in_sections
from .signals import Record
from .simulation_fit import Freedom, Realization

Array = NDArray[np.float64]

# Samples that are taken up together; fewer wait for the next batch.
STRETCH = 16_384

# Latest samples that a model is simulated on.
_LATEST = 4_096

# Inputs outside the span of the first ones, relative to their size.
_OUTSIDE = 1e-8

# Difference of the simulation error from its linearisation that is accepted: in
# variances of the estimate per parameter; of an unrefined model, whose error is larger,
# relative; and relative to the outputs, for data without noise.
_EXCESS = 0.25

_EXCESS_UNREFINED = 5e-4

_ROUNDING = 1e-16


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


class StreamedModel(NamedTuple):
    """What the summaries tell.

    Attributes
    ----------
    model : Realization
        In the scale of the first samples.
    singular_values : ndarray
    residual : float
        Relative simulation error; NaN where it is not known.
    stability_loss : float
    """

    model: Realization
    singular_values: Array
    residual: float
    stability_loss: float


class _Taken(NamedTuple):
    """Sums over the samples taken up."""

    hankel: HankelSum
    recursion: Recursion | None
    initial_state: Array
    energy: Array
    n_samples: int
    # Where to linearise if not at the minimum, and when to look for another point.
    point: Realization | None
    next_point: int


class StreamSummary:
    """Compressed Hankel data and linearised simulation errors of a stream.

    Parameters
    ----------
    fitted : LocalFit
        Of the first samples.
    options : dict
        `order`, `horizon` and the other options of `identify`.
    """

    def __init__(self, fitted: LocalFit, options: dict[str, Any]) -> None:
        evidence, found = fitted.evidence, fitted.found
        self._free, self._options, self._basis = evidence.free, options, evidence.basis
        self._su, self._sy = found.input_scale, found.output_scale
        records = fitted.scaled.records
        samples = [np.vstack(record).T for record in records]
        hankel = start_hankel_sum(
            samples,
            len(self._su),
            options["horizon"],
            past_outputs=options["method"] != "pi-moesp",
        )
        self._waiting = self._latest = np.zeros((0, samples[0].shape[1]))
        self._starts = False
        pilot = in_sections(found.scaled_model)
        recursion = None
        if pilot.blocks is not None and np.isfinite(pilot.loss):
            parts = experiment_regressions(pilot, records, self._free)
            if parts is not None:
                n_values = sum(record.y.size for record in records)
                recursion = start_recursion(
                    pilot, parts, self._free, pilot.loss / n_values
                )
        # Per channel: the subspace step weighs the outputs by their final size.
        energy = np.sum([(z**2).sum(axis=0) for z in samples], axis=0)
        self._taken = _Taken(
            hankel,
            recursion,
            pilot.initial_states[-1],
            energy,
            sum(len(z) for z in samples),
            None,
            0,
        )

    def add(self, piece: Piece) -> None:
        """Take up what follows."""
        if piece.starts:
            self._taken = self._with_waiting()
            self._waiting, self._starts = self._waiting[:0], True
        start = 0
        while start < len(piece.u):  # in parts that stay in the cache
            stop = start + STRETCH - len(self._waiting)
            part = self._scaled(piece.u[start:stop], piece.y[start:stop])
            self._waiting = np.vstack([self._waiting, part])
            self._latest = self._waiting[-_LATEST:]
            if len(self._waiting) == STRETCH:
                self._taken = self._take(self._taken, self._waiting, self._starts)
                self._waiting, self._starts = np.empty_like(part[:0]), False
            start = stop

    def model(self) -> StreamedModel:
        """Model of everything seen."""
        taken = self._with_waiting()
        subspace, factor, scale = self._subspace(taken)
        enforce, refine = self._options["enforce_stability"], self._options["refine"]
        if refine and taken.recursion is not None:
            free = current_model(taken.recursion, self._free)
            free = free._replace(initial_states=taken.initial_state[None])
        else:
            pair = self._subspace_pair(subspace, factor, scale)
            free = self._with_inputs(*pair, taken, factor, scale)
        energy = float(taken.energy[len(self._su) :].sum()) or 1.0
        found, lost = free, 0.0
        A = reflect_unstable(free.A, 1.0 - STABLE_MARGIN if enforce else 1.0)
        if A is not free.A:
            stable = self._with_inputs(A, free.C, taken, factor, scale)
            if enforce:
                lost = max(
                    0.0, np.sqrt(stable.loss / energy) - np.sqrt(free.loss / energy)
                )
            if enforce or (not refine and stable.loss <= STABLE_LOSS * free.loss):
                found = stable
        residual = float(np.sqrt(found.loss / energy))
        return StreamedModel(found, subspace.singular_values, residual, float(lost))

    def latest_error(self, model: Realization) -> float:
        """Simulation error of the latest samples themselves, relative to the outputs.

        Parameters
        ----------
        model : Realization
            From `model`.

        Returns
        -------
        float
            Root mean square, relative to that of all outputs or, where these are
            larger, of the latest ones; NaN where it is not known.
        """
        n, m = len(self._latest), len(self._su)
        if model.blocks is None or n == 0:
            return np.nan
        loss, _ = stretch_error(model, self._record(self._latest), self._freed(False))
        power = self._taken.energy[m:].sum() / self._taken.n_samples
        power = max(power, (self._latest[:, m:] ** 2).sum() / n)
        return float(np.sqrt(loss / n / (power or 1.0)))

    def initial_states(
        self,
        found: StreamedModel,
        first: Sequence[Piece],
        others: Sequence[Piece],
    ) -> Array | None:
        """Initial states, where the samples themselves are still there.

        Parameters
        ----------
        found : StreamedModel
        first : sequence of Piece
            Those that the summaries began with.
        others : sequence of Piece
            All that were added.

        Returns
        -------
        ndarray of shape (n_experiments, order) or None
            None where the simulation error of the samples is not what the summaries
            make it: the model of the first samples was too far off to linearise at.
        """
        model = found.model
        if self._taken.recursion is None or model.blocks is None:
            return None
        states, loss = [], 0.0
        for samples, starts in chain(
            ((self._scaled(u, y), True) for u, y, _ in first), self._stretches(others)
        ):
            error, x0 = stretch_error(model, self._record(samples), self._freed(starts))
            loss += error
            if starts:
                states.append(x0)
        taken = self._with_waiting()
        energy = float(taken.energy[len(self._su) :].sum())
        n_values = taken.n_samples * len(self._sy)
        share = _EXCESS * len(self._taken.recursion.position) / n_values
        if not self._options["refine"]:
            share = max(share, _EXCESS_UNREFINED)
        if not abs(loss - model.loss) <= share * model.loss + _ROUNDING * energy:
            return None
        return np.array(states).reshape(len(states), len(model.A))

    @property
    def size(self) -> int:
        """Numbers that are kept."""
        taken = self._taken
        parts = [self._waiting, self._latest, taken.hankel.gram, taken.hankel.factor]
        parts.append(taken.hankel.tail)
        if taken.recursion is not None:
            parts += [taken.recursion.information, taken.recursion.directions]
        return sum(part.size for part in parts if part is not None)

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

    def _record(self, samples: Array) -> Record:
        m = len(self._su)
        return Record(
            np.ascontiguousarray(samples[:, :m].T),
            np.ascontiguousarray(samples[:, m:].T),
        )

    def _freed(self, starts: bool) -> Freedom:
        # What continues an experiment does not start from rest.
        return self._free if starts else self._free._replace(initial_states=True)

    def _take(self, taken: _Taken, samples: Array, starts: bool) -> _Taken:
        recursion = taken.recursion
        if recursion is not None:
            if not self._options["refine"] and taken.n_samples >= taken.next_point:
                taken = taken._replace(
                    point=self._subspace_model(taken), next_point=2 * taken.n_samples
                )
            recursion, x0 = extend_recursion(
                recursion, self._record(samples), self._freed(starts), taken.point
            )
            taken = taken._replace(recursion=recursion, initial_state=x0)
        return taken._replace(
            hankel=extend_hankel_sum(taken.hankel, samples, starts=starts),
            energy=taken.energy + (samples**2).sum(axis=0),
            n_samples=taken.n_samples + len(samples),
        )

    def _subspace_model(self, taken: _Taken) -> Realization | None:
        """Model of the subspace step so far, in the blocks of the recursion."""
        assert taken.recursion is not None
        A, C = self._subspace_pair(*self._subspace(taken))
        found = input_matrices(taken.recursion, reflect_unstable(A), C, self._free)
        return taken.point if found is None else found

    def _with_waiting(self) -> _Taken:
        # A single sample tells nothing but its own initial state.
        if len(self._waiting) <= self._starts:
            return self._taken
        return self._take(self._taken, self._waiting, self._starts)

    def _subspace(self, taken: _Taken) -> tuple[ObservabilitySubspace, Array, Array]:
        """Subspace and factor of channels of unit size, and their size in ours."""
        m, ny = len(self._su), len(self._sy)
        scale = np.sqrt(taken.energy / taken.n_samples)
        scale[scale == 0.0] = 1.0
        hankel = taken.hankel
        factor = hankel.triangular() / scale[hankel.rows % (m + ny)][:, None]
        order = self._options["order"] + self._options["n_noise_states"]
        subspace = observability_subspace(
            factor, m, ny, hankel.horizon, order, self._options["method"]
        )
        return subspace, factor, scale

    def _subspace_pair(
        self, subspace: ObservabilitySubspace, factor: Array, scale: Array
    ) -> tuple[Array, Array]:
        """A and C of the subspace step, in our units."""
        order, horizon = self._options["order"], self._options["horizon"]
        ny = len(self._sy)
        most = min(subspace.basis.shape[1], (horizon - 1) * ny)
        extended = min(order + self._options["n_noise_states"], most)
        if order == 0 or extended <= order:
            A, C = shift_invariant_pair(subspace.basis, ny, order)
        else:
            A, C = shift_invariant_pair(subspace.basis, ny, extended)
            A = reflect_unstable(A)
            B, _ = factor_input_matrices(factor, A, C, self._free, horizon)
            A, C = dominant_pair(A, B, C, order, horizon)
        return A, scale[len(self._su) :, None] * C

    def _with_inputs(
        self, A: Array, C: Array, taken: _Taken, factor: Array, scale: Array
    ) -> Realization:
        """B and D, in our units: by the recursion, else from the factor alone."""
        found = None
        if taken.recursion is not None:
            found = input_matrices(taken.recursion, A, C, self._free)
        if found is None:
            su, sy = scale[: len(self._su)], scale[len(self._su) :, None]
            B, D = factor_input_matrices(
                factor, A, C / sy, self._free, self._options["horizon"]
            )
            found = Realization(A, B / su, C, sy * D / su, np.zeros((1, 0)), np.nan)
        return found._replace(initial_states=np.zeros((1, len(A))))
