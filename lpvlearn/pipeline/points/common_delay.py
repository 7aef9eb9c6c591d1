"""One delay of the inputs for all operating points, where each was to find its own.

A short record takes a sample more or less for states, or for noise. Criteria of
independent records add up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import Experiment
from ...exceptions import warn
from ...subspace.estimator import SubspaceLTI
from ...subspace.fits.delay import with_late_inputs
from ...subspace.simulation_error.criterion import PRICE
from ..running.runner import Done, label_of
from .local_models import LocalModel

Array = NDArray[np.float64]
Delay = NDArray[np.intp]  # (n_inputs,), samples
Models = list[Done | None]  # of all points, None of those that were not asked

# Points that together tell one delay of all, and by how much, in twice the logarithm of
# the likelihood, it must be likelier than another; or a delay of a point of its own.
_PROBED, _CLEARER = 5, 6.0
_CHANCE = 2  # samples by which delays that points find for themselves may differ


def with_one_delay(
    local: Any,
    tried: Callable[..., Models],
    groups: Sequence[Sequence[Experiment]],
    sampling_time: float,
) -> tuple[Any, Models]:
    """The estimator with the delay of all points, and its models of some of them.

    Beginning at the median of some points, longer delays of an input are taken where
    these together are likelier so by more than a state, which may stand for a sample,
    and shorter ones where they are as likely. Not where delays of their own are
    likelier beyond doubt, as with transport at another speed. `tried` gives models of
    an estimator at some points, beside those that are known.
    """
    trials = _Trials(local, tried, groups, sampling_time)
    n_points = len(trials.own)
    if n_points < 2 or not np.isfinite(sum(trials.own.values())):
        return local, trials.found
    delays = np.array([trials.delay_of(done) for done in trials.found if done])
    delay = np.sort(delays, axis=0)[(n_points - 1) // 2]
    if (delays == delay).all() and delay.any():
        return trials.having(delay, [])
    inputs, outputs = groups[0][0].inputs.shape[1], groups[0][0].measured.shape[1]
    state = n_points * PRICE * (inputs + outputs)
    far_apart = bool((np.ptp(delays, axis=0) > _CHANCE).any())
    least = trials.cost(delay, delays[0] if far_apart else None)
    if np.isinf(least):
        return local, trials.found
    for sample in np.eye(len(delay), dtype=np.intp):
        for step, worth in ((sample, _CLEARER + state), (-sample, -_CLEARER)):
            delay, least = trials.along(step, worth, (delay, least))
    alike = least < sum(trials.own.values()) + _CLEARER * (n_points - 1)
    return trials.having(delay, []) if alike else (local, trials.found)


class _Trials:
    """Models of some points with delays of their `own`, and with others.

    `own` are the criteria of the first.
    """

    def __init__(
        self,
        local: Any,
        tried: Callable[..., Models],
        groups: Sequence[Sequence[Experiment]],
        sampling_time: float,
    ) -> None:
        self._local, self._tried = local, tried
        self._groups, self._step = groups, sampling_time
        self._known: dict[tuple[int, ...], Models] = {}
        self.found = tried(local, some_of(len(groups), _PROBED))
        self.own = self._costs_of(self.found)

    def _costs_of(self, found: Models) -> dict[int, float]:
        return {
            k: cost_with_delay(self._local, done.result, self._groups[k], self._step)
            for k, done in enumerate(found)
            if done is not None
        }

    def delay_of(self, done: Done) -> Delay:
        return delay_in_samples(done.result, self._step)

    def having(self, delay: Delay, points: Sequence[int]) -> tuple[Any, Models]:
        """The estimator and its models, which of a delay found is that of one given."""
        estimator = clone(self._local).set_params(input_delay=delay.tolist())
        have = [
            done if done is not None and (self.delay_of(done) == delay).all() else None
            for done in self.found
        ]
        have = self._known.get(tuple(delay.tolist()), have)
        new = self._tried(estimator, points, have) if points else have
        models = [a if b is None else b for a, b in zip(have, new, strict=True)]
        self._known[tuple(delay.tolist())] = models
        return estimator, models

    def cost(self, delay: Delay, former: Delay | None = None) -> float:
        """Or infinity, where the first point is far likelier with a former delay.

        One that all points have is far worse for none of them.
        """
        first, limit = min(self.own), np.inf
        if former is not None:
            limit = self._costs_of(self.having(former, [])[1])[first]
            limit += _CLEARER * len(self.own)
        for points in ([first], list(self.own)):
            costs = self._costs_of(self.having(delay, points)[1])
            if any(k not in costs for k in points) or costs[first] > limit:
                return np.inf
        return sum(costs.values())

    def along(
        self, step: Delay, worth: float, start: tuple[Delay, float]
    ) -> tuple[Delay, float]:
        """The delay of least cost some steps from a start, where that is `worth` it.

        Up to where the cost rises beyond doubt.
        """
        delay, least = start
        best, lowest, other = start, least - worth, delay + step
        while (other >= 0).all():
            reached = self.cost(other, other - step)
            if not reached < least + _CLEARER:
                break
            if reached < lowest:
                best, lowest = (other, reached), reached
            least, other = min(least, reached), other + step
        return best


def some_of(n_points: int, most: int) -> list[int]:
    """Some of the points, from the first to the last."""
    return np.unique(np.linspace(0, n_points - 1, most).round().astype(int)).tolist()


def cost_with_delay(
    local: SubspaceLTI,
    model: LocalModel,
    experiments: Sequence[Experiment],
    sampling_time: float,
) -> float:
    """The criterion of as many samples, whatever is unknown of the first ones."""
    rest, gaps = local.initial_state == "rest", local.missing != "raise"
    delay = delay_in_samples(model, sampling_time)
    n_samples, n_known = (
        sum(
            len(e.rows)
            for e in with_late_inputs(experiments, some, rest=rest, gaps=gaps)
        )
        for some in (np.zeros_like(delay), delay)
    )
    return model.criterion * n_samples / n_known


def delay_in_samples(model: LocalModel, sampling_time: float) -> Delay:
    """The delays of the inputs of a local model."""
    return np.round(model.lti.input_delay / sampling_time).astype(np.intp)


def common_delay(
    local: Sequence[LocalModel], kappa: Array, sampling_time: float
) -> Array:
    """Delay of the inputs, seconds, of all operating points: their lower median.

    Warns where they do not agree.
    """
    delays = np.array([model.lti.input_delay for model in local])
    median = np.sort(delays, axis=0)[(len(delays) - 1) // 2]
    samples = np.round(delays / sampling_time).astype(int)
    if (samples != samples[0]).any():
        each = "; ".join(
            f"{label_of(row)}: {', '.join(map(str, own))}"
            for row, own in zip(kappa, samples.tolist(), strict=True)
        )
        taken = ", ".join(map(str, np.round(median / sampling_time).astype(int)))
        warn(
            "the input delay differs between operating points (scheduling: samples of "
            f"each input; {each}). The LPV model takes the median, {taken}; the local "
            "models keep their own. Where the system has one delay, give it: "
            "local=SubspaceLTI(input_delay=...). Where it follows the scheduling "
            "variable, as transport at another speed does, shift the column of the "
            "input by what is known of it, for the fit and for predictions."
        )
    return median
