"""A fitted model in the experiments that it meets: where they begin, and stand.

What it answers to inputs about its resting point adds to a level, from a state that
the experiment begins in. Both are those of the fit, or what the measured outputs of an
experiment tell of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress, starmap
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from ...data.experiments import Experiment, are_beginnings
from ...exceptions import DivergenceError
from ...models.innovation import InnovationModel
from ...models.statespace import StateSpace, unknown_responses
from ...systems.beginnings import (
    Beginning,
    begin_held,
    first_inputs,
    held_state,
    standing,
    waiting,
)
from ...systems.modes import lasting
from ...systems.simulation import (
    estimate_initial_state,
    spread_of,
    state_and_level,
    trend_signals,
)
from ..evidence.constants import level_matters
from ..evidence.offsets import Offsets, far_off
from ..evidence.statistics import Evidence
from .integrating import RateEvidence

Array = NDArray[np.float64]

_FAINT = 1e-3  # weight of an estimate beside an output that is known

_AWAY = 0.5  # of the range of an input, from where it begins to that

_GROWS = np.log(1e8)  # over an experiment: no simulation tells levels then


class Simulator(NamedTuple):
    """A model with the constants of its fit.

    `offset` is whether experiments may have constants at all, `begins_held` whether
    those begin where their inputs hold the model whose inputs stand still at first;
    `begun` is the state that all of them begin in, if not at rest.
    """

    lti: StateSpace
    evidence: Evidence | RateEvidence
    offsets: Offsets
    offset: bool
    begins_held: bool = False
    begun: Array | None = None

    def resting_point(self, *, begun: bool = False) -> tuple[Array, Array]:
        """Inputs and outputs at rest, the mean over all experiments of the fit.

        Where drifts are in the middle of the experiments, or where they have `begun`.
        """
        pooled = (self.offsets.begun() if begun else self.offsets).pooled()
        return pooled.inputs[0], pooled.outputs[0]

    def predictor(self) -> InnovationModel:
        """The innovation model, with all states of the noise."""
        return self.evidence.predictor(self.lti, None)

    def begins_held_in(self, experiments: Sequence[Experiment]) -> bool:
        """Whether experiments of the fit begin where their first inputs hold the model.

        And not at rest about zero, or, where there are levels, about their means.
        """
        lti = self.lti
        begin = are_beginnings(experiments)
        wait = [
            begins and waiting(e.inputs) > 0
            for begins, e in zip(begin, experiments, strict=True)
        ]
        # Of many short ones in motion some stand still by chance.
        if not (lti.is_stable and 2 * sum(wait) >= sum(begin)):
            return False
        gain = lti.dc_gain()
        known = self.offsets.inputs, self.offsets.outputs, self.offsets.drifts
        k = len(experiments)  # fewer than levels, where a record is cut at shifts
        levels = (
            np.broadcast_to(v if len(v) == k else v[:1], (k, v.shape[1])) for v in known
        )

        def beginning(e: Experiment, u0: Array, y0: Array, drift: Array) -> Beginning:
            n = len(e.inputs)
            y = e.measured - np.outer(np.arange(n) - (n - 1) / 2.0, drift)
            return Beginning.of(
                (e.inputs, y),
                (u0, y0),
                gain,
                lti.simulate,
                about_mean=self.evidence.free.n_trend > 0,
            )

        return begin_held(
            starmap(beginning, compress(zip(experiments, *levels, strict=True), wait))
        )

    def begun_state(self, experiments: Sequence[Experiment]) -> Array | None:
        """Where experiments of the fit begin, if that is far from rest.

        A mode that does not decay rests nearly anywhere, and may stand for a part of
        the level, together with others: simulations from rest are off by that. None
        where these begin no farther from all outputs than those are wide; where outputs
        are known to integrate, no farther than the errors are.
        """
        if not self.evidence.free.initial_states:
            return None
        if isinstance(self.evidence, RateEvidence):
            return self._place(experiments, self.evidence.flags)
        longest = max(len(e.inputs) for e in experiments)
        if not lasting(self.lti.poles(), longest).any():
            return None
        (u0, y0), outputs = self.resting_point(), [e.measured for e in experiments]
        starts = [
            y0 + self.lti.simulate(e.inputs[:1] - u0, initial_state=self.beginning(e))
            for e in experiments
        ]
        if not far_off(np.mean(starts, axis=0)[0], outputs):
            return None
        try:
            states = [self.own_part(e, of_fit=True)[0] for e in experiments]
        except (np.linalg.LinAlgError, DivergenceError):
            return None
        state = np.mean(states, axis=0)
        if not np.isfinite(state).all() or far_off(y0 + self.lti.C @ state, outputs):
            return None
        return state

    def _place(
        self, experiments: Sequence[Experiment], flags: NDArray[np.bool_]
    ) -> Array | None:
        """State at rest where outputs that integrate begin, in the mean.

        None where that is less than the errors.
        """
        lti, begun, errors = self.lti, [], []
        for e in compress(experiments, are_beginnings(experiments)):
            try:
                x0, level = self.own_part(e, of_fit=True)
                simulated = level + self._answers(x0, e)
            except (np.linalg.LinAlgError, DivergenceError):
                return None
            begun.append(lti.C @ x0)
            errors.append(e.measured - simulated)
        size = np.sqrt(np.nanmean(np.vstack(errors) ** 2, axis=0))
        place = np.where(flags, np.mean(begun, axis=0), 0.0)
        if not (np.isfinite(place).all() and (np.abs(place) > size).any()):
            return None
        still = null_space(lti.A - np.eye(lti.order))
        return np.asarray(still @ np.linalg.lstsq(lti.C @ still, place, rcond=None)[0])

    def simulated(self, experiment: Experiment) -> Array:
        """Outputs from the beginning that the experiments of the fit let expect."""
        return self._from(self.beginning(experiment), experiment)

    def from_own_beginning(self, experiment: Experiment) -> Array:
        """Outputs from the initial state, and about the level, of its measured ones."""
        x0, level = self.own_part(experiment)
        return level + self._answers(x0, experiment)

    def beginning(self, experiment: Experiment) -> Array | None:
        """State and inputs in transit where the first inputs hold it; None for rest."""
        u, lti = experiment.inputs, self.lti
        if self.begun is not None:
            return np.append(self.begun, np.zeros(np.sum(lti.input_delay)))
        if not (self.begins_held and standing(u)):
            return None
        first = first_inputs(u) - self.resting_point()[0]
        x0 = held_state(lti.A, lti.B, first, discrete=True)
        return None if x0 is None else np.append(x0, np.repeat(first, lti.input_delay))

    def begins_away_from(self, experiment: Experiment) -> bool:
        """Whether inputs move about a level that they begin at rest far from."""
        if not self.evidence.free.n_trend:
            return False
        u = experiment.inputs
        u0, low, high = self.resting_point()[0], u.min(axis=0), u.max(axis=0)
        gap = np.maximum(low - u0, u0 - high)
        away = ((low < high) & (gap > _AWAY * (high - low))).any()
        return bool(away) and self.beginning(experiment) is None

    def own_part(
        self,
        experiment: Experiment,
        predictor: InnovationModel | None = None,
        *,
        of_fit: bool = False,
    ) -> tuple[Array, Array]:
        """Initial state, inputs in transit; and the outputs their answers add to.

        Behind the errors of simulation, or of a predictor that has a gain, for which
        inputs in transit are those at rest: what they miss dies out. A level that did
        not show in the samples `of_fit` may show in others.
        """
        (u0, y0), y = self.resting_point(), experiment.measured
        n_trend, own = self.evidence.free.n_trend, None
        size = spread_of(y) if predictor is None else predictor.error_sizes(y)
        if not n_trend and self.offset and not of_fit:
            n_trend, own = self._as_it_stands(experiment, size)
        trend = trend_signals(len(y), n_trend)
        if predictor is not None and predictor.gain is not None:
            u = experiment.inputs - u0
            own = predictor.estimate_initial_state(u, y - y0, trend)
        elif own is None:
            responses, error = self._unexplained(experiment, trend)
            own = estimate_initial_state(responses, error, size)
        x0, level = state_and_level(own, trend, len(y0))
        return x0, y0 + level

    def _from(self, x0: Array | None, experiment: Experiment) -> Array:
        """Outputs about the mean offsets from a state there; None is rest."""
        return self.resting_point()[1] + self._answers(x0, experiment)

    def _answers(self, x0: Array | None, experiment: Experiment) -> Array:
        """What the model answers from a state to inputs, about those at rest."""
        u0, _ = self.resting_point()
        return self.lti.simulate(experiment.inputs - u0, initial_state=x0)

    def _unexplained(self, experiment: Experiment, trend: Array) -> tuple[Array, Array]:
        """Responses to own unknowns, and the errors of simulation they are to explain.

        Shapes (n_samples, n_outputs, n_unknowns), those of trends last, and (n_samples,
        n_outputs).
        """
        lti, y = self.lti, experiment.measured
        responses = unknown_responses(lti, len(y), trend)
        error = y - self._from(None, experiment)
        if experiment.estimated is not None:  # lest known ones leave states open
            faint = np.where(experiment.estimated, _FAINT, 1.0)
            responses, error = responses * faint[:, :, None], error * faint
        return responses, error

    def _as_it_stands(
        self, experiment: Experiment, size: Array
    ) -> tuple[int, Array | None]:
        """1 where an experiment has a level that those of the fit did not have, or 0.

        And its own unknowns, by simulation, whose errors count by `size`; None where
        that diverges, or grows so far that rounding decides.
        """
        y = experiment.measured
        largest = np.abs(self.lti.poles()).max(initial=0.0)
        if len(y) * np.log(max(largest, 1.0)) > _GROWS:
            return 0, None
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                responses, error = self._unexplained(
                    experiment, trend_signals(len(y), 1)
                )
        except DivergenceError:
            return 0, None
        unknown = np.isnan(y)
        if experiment.estimated is not None:
            unknown |= experiment.estimated
        if not (np.isfinite(responses).all() and np.isfinite(error[~unknown]).all()):
            return 0, None
        found, left = [], []
        for free in (responses[:, :, : -len(size)], responses):
            own = estimate_initial_state(free, error, size)
            found.append(own)
            left.append(np.where(unknown, np.nan, (error - free @ own) / size))
        level = int(level_matters(left[0], left[1], len(found[1])))
        return level, found[level]
