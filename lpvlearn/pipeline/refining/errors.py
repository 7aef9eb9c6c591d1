"""Simulation errors of an LPV model along experiments, and what these tell of it.

Of a record the error is ``y - y(c) - R p``, the p of its own (initial state, constants)
those that fit best: the responses R are projected out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...data.experiments import Experiment, naming
from ...exceptions import warn
from ...lpv.bands import Levels, levels_of
from ...lpv.model import LPVStateSpace
from ...lpv.refinement import (
    Own,
    Record,
    refine,
    responses_along,
    simulated,
    squares,
    weights_of,
)
from ...lpv.weighting import is_chance
from ..checks.bands import output_errors
from ..checks.error_warnings import tell_of_noisy_scheduling
from ..one_basis.between_samples import are_smooth
from ..one_basis.structured_models import StructuredModels

Array = NDArray[np.float64]

_LOOKED_AT = 4  # experiments of an operating point: more tell the same of the errors

# Errors of a refined model along its own experiments that are told: relative to the
# outputs, and to those of the start along the local ones
_MISSED, _MORE = 0.2, 3.0

# Part of what a beginning at rest misses that one held by the first inputs may miss,
# and of its squares what is rounding
_NEARER, _ROUNDING = 0.5, 1e-12

# Of a hold that is taken for another one: steps after which the two are compared, and
# what it gains in the log-likelihood
_STEPS, _LIKELIER = 15, 10.0


def record_of(e: Experiment, sampling_time: float) -> Record:
    """The experiment for a simulation, of this sampling time where it tells none."""
    return Record(e.inputs, e.measured, e.kappa, e.sampling_time or sampling_time)


def own_of(refiner: Any) -> Own:
    """Unknowns of every experiment of a refiner, as `OutputErrorLPV` has them."""
    return Own(
        getattr(refiner, "initial_state", "estimate") == "estimate",
        getattr(refiner, "offset", None) == "constant",
    )


def own_of_local(found: StructuredModels) -> Own:
    """Unknowns of every local experiment."""
    return Own(True, any(model.n_trend > 0 for model in found.local))


def errors_along(
    model: LPVStateSpace,
    experiments: Sequence[Experiment],
    records: Iterable[Record],
    own: Own,
) -> Iterator[Array]:
    """Simulation errors of runs, each with the unknowns of its own that fit best.

    Realizations that follow each other are simulated once.
    """
    last: Record | None = None
    for e, record in zip(experiments, records, strict=True):
        with naming(e):
            if last is None or not _alike(record, last):
                responses = responses_along(model, record, own)
            error = simulated(model, record, own, responses=responses)[0]
        last = record
        yield error


def _alike(one: Record, other: Record) -> bool:
    """Whether two runs differ in their outputs at most."""
    same = np.array_equal(one.u, other.u) and np.array_equal(one.kappa, other.kappa)
    return same and one.dt == other.dt


def local_output_errors(
    model: LPVStateSpace, found: StructuredModels, sampling_time: float
) -> pd.DataFrame:
    """`output_errors` of an LPV model along some local experiments of each point.

    Tells of scheduling variables whose noise the model takes for motion.
    """
    runs = [e for group in found.points.experiments for e in group[:_LOOKED_AT]]
    records = [record_of(e, sampling_time) for e in runs]
    quiet, own = model.silenced(), own_of_local(found)
    names = model.output_names or range(1, model.n_outputs + 1)

    try:
        levels = levels_of(errors_along(quiet, runs, records, own))
        if any(np.ptp(r.kappa, axis=0).any() for r in records):
            held = map(_held, records)
            still = levels_of(errors_along(quiet, runs, held, own))
            tell_of_noisy_scheduling(model, records, levels, still, names)
    except ValueError:  # it diverges, or has no matrices there
        unknown = np.full(model.n_outputs, np.nan)
        levels = Levels(unknown, unknown)
    return output_errors(names, levels)


def _held(record: Record) -> Record:
    """The record with its scheduling variables held at their means."""
    kappa = record.kappa
    return record._replace(kappa=np.broadcast_to(kappa.mean(axis=0), kappa.shape))


def tell_of_missed(
    refined: Any,
    experiments: Sequence[Experiment],
    start: LPVStateSpace,
    found: StructuredModels,
    sampling_time: float,
) -> None:
    """Tell of a refined model that misses what it was refined on, but not the points.

    By the part of its errors that is no white noise, relative to how far outputs move,
    and by that of the `start` along the local experiments.
    """
    some = [e for group in found.points.experiments for e in group[:_LOOKED_AT]]
    try:
        missed = _missed(refined.lpv_, experiments, own_of(refined), sampling_time)
        there = _missed(start, some, own_of_local(found), sampling_time)
    except ValueError:  # it diverges: told elsewhere
        return
    bad = (missed > _MISSED) & (missed > _MORE * there)
    if bad.any():
        i = int(np.argmax(np.where(bad, missed, 0.0)))
        names = start.output_names or range(1, start.n_outputs + 1)
        warn(
            f"the refined model misses {100.0 * missed[i]:.2g} % of output "
            f"{names[i]!r} in the experiments that move, on which it was refined; of "
            f"the local ones that of the points misses {100.0 * there[i]:.2g} %. "
            "Either parts of the structure stand in each other's place, which no "
            "frozen model shows, or it lacks what moves with the scheduling variables, "
            "or these experiments have another disturbance. Check bounds and guesses "
            "(`init`), what the experiments were, and the fit of each, "
            "`refiner_.report_`; give a `restructurer` of another structure, or "
            "rate=True."
        )


def _missed(
    model: LPVStateSpace, experiments: Sequence[Experiment], own: Own, dt: float
) -> Array:
    """Errors that are no white noise, relative to how far outputs move."""
    records = [record_of(e, dt) for e in experiments]
    errors = errors_along(model.silenced(), experiments, records, own)
    return np.asarray(levels_of(errors).model_error * weights_of(records))


def follow_ramps(model: LPVStateSpace, records: Sequence[Record], own: Own) -> bool:
    """Whether a refined model meets records far better with ramps between samples.

    By the likelihood, after some steps with each hold.
    """
    if not are_smooth([record.u for record in records]):
        return False
    noise = []
    for hold in ("zoh", "foh"):
        start = replace(model, hold=hold, covariance=None)
        try:
            found = refine(start, records, own, max_iter=_STEPS)
        except ValueError:  # it diverges
            return False
        noise.append(found.deviation)
    gain = sum(len(record.u) for record in records) * np.log(noise[0] / noise[1]).sum()
    return bool(gain > _LIKELIER)


def records_begin_held(
    model: LPVStateSpace, records: Sequence[Record], own: Own
) -> bool:
    """Whether records begin where their first inputs hold the model, not at rest.

    By the squared errors of both beginnings, above those of the initial states that
    fit best.
    """
    if not own.initial_state:
        return False
    weight, known = weights_of(records), own._replace(initial_state=False)
    at_rest, held = (
        squares(replace(model.silenced(), steady_start=steady), records, known, weight)
        for steady in (False, True)
    )
    least = squares(model.silenced(), records, own, weight)
    if not held - least < _NEARER * (at_rest - least):
        return False
    variance = max(least, _ROUNDING * at_rest) / sum(r.y.size for r in records)
    return not is_chance((at_rest - least) / variance, model.order * len(records))
