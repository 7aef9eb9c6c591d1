"""What the errors of an LPV model along experiments tell that it lacks."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ...exceptions import warn
from ...lpv.bands import Levels
from ...lpv.model import LPVStateSpace
from ...lpv.refinement import Own, Prior, Record, refine, squares, weights_of
from ...subspace.evidence.residuals import explained_by_inputs

Array = NDArray[np.float64]

# Errors that are told: constants, of a search of so many steps, leave less than this
# share of their squares, or the inputs explain more than this share of the output.
CONSTANT, _STEPS, _OF_OUTPUT = 0.25, 15, 0.1

# Errors with scheduling variables held, of those with them as measured, that are told
_HELD, _SEEN = 0.7, 0.01  # and of the outputs


def tell_of_errors(
    model: LPVStateSpace,
    records: Sequence[Record],
    errors: Sequence[Array],
    own: Own,
    start: LPVStateSpace,
    prior: Prior | None,
    max_iter: int,
) -> None:
    """Tell of large errors that constants would take, or that follow the inputs.

    First of outputs in other units, or of the other sign, than those of the local
    experiments, of which the `prior` is, by what the `start` simulates. By some steps
    from there, `max_iter` at most, with constants. And by regression on the
    inputs alone, times the scheduling variables, as a gain that varies, and on these,
    as what an offset does to such a gain, over all records and the one of the largest
    errors.
    """
    each = np.array([_shares(*pair) for pair in zip(records, errors, strict=True)])
    worst = int(each.max(axis=1).argmax())
    if not each[worst].max() > _OF_OUTPUT:
        return
    names = model.output_names or range(1, model.n_outputs + 1)
    if prior is not None:
        gain, left = _gains(start, records)
        i = int(np.argmin(np.where(np.abs(gain - 1.0) > _OF_OUTPUT, left, np.inf)))
        if abs(gain[i] - 1.0) > _OF_OUTPUT and left[i] < CONSTANT:
            warn(
                f"output {names[i]!r} is {gain[i]:.3g} times what the model of the "
                "local experiments simulates, but for "
                f"{100.0 * np.sqrt(left[i]):.2g} % of the errors: the sensor has "
                "another sign or unit in the experiments that move. Give all of them "
                "the same."
            )
            return
    if not own.constant:
        with suppress(ValueError):  # it diverges
            other = own._replace(constant=True)
            steps = min(max_iter, _STEPS)
            found = refine(start, records, other, prior, max_iter=steps).model
            weight = weights_of(records)
            squared = squares(found, records, other, weight)
            share = squared / np.sum((np.vstack(errors) * weight) ** 2)
            if share < CONSTANT:
                warn(
                    "with a constant of every experiment and output the errors are "
                    f"at most {max(100.0 * np.sqrt(share), 0.1):.2g} % as large: a "
                    "sensor has an offset, or what is called zero is not the resting "
                    "point. Use offset='constant'."
                )
                return
    bounds = model.scheduling_range
    center, span = bounds.mean(axis=0), np.ptp(bounds, axis=0)
    part = np.zeros(model.n_outputs)
    for some in (range(len(records)), [worst]):
        pairs = [(records[k], errors[k]) for k in some]
        explained = explained_by_inputs(
            [e - e.mean(axis=0) for _, e in pairs],
            [_causes(record, center, span) for record, _ in pairs],
        )
        size = np.sqrt(np.mean([_shares(*pair) ** 2 for pair in pairs], axis=0))
        part = np.maximum(part, np.sqrt(explained) * size)
    i = int(np.argmax(part))
    if part[i] > _OF_OUTPUT:
        warn(
            f"the errors of output {names[i]!r} follow from the inputs and scheduling "
            f"variables, at {100.0 * part[i]:.0f} % of its size and beyond chance: the "
            "model lacks terms (a higher degree of `interpolator`), states, or a delay "
            "of an input (local=SubspaceLTI(input_delay='auto')), an input has an "
            "offset (subtract it), or the search ended in a poor minimum (`report_`): "
            "give a `start` that is nearer."
        )


def _gains(model: LPVStateSpace, records: Sequence[Record]) -> tuple[Array, Array]:
    """Of outputs by what is simulated from rest, and the share of errors left."""
    found = [model.simulate(r.u, r.kappa, r.dt) for r in records]
    y, y_model = (
        np.vstack([one - one.mean(axis=0) for one in some])
        for some in ([record.y for record in records], found)
    )
    size, squared = (np.sum(x**2, axis=0) for x in (y_model, y - y_model))
    gain = np.sum(y_model * y, axis=0) / np.where(size > 0.0, size, np.inf)
    left = np.sum((y - gain * y_model) ** 2, axis=0)
    return gain, left / np.where(squared > 0.0, squared, np.inf)


def _shares(record: Record, errors: Array) -> Array:
    """Size of the errors of every output, relative to its motion."""
    size = record.y.std(axis=0)
    left = np.sqrt(np.mean(errors**2, axis=0))
    return np.asarray(left / np.where(size > 0.0, size, np.inf))


def _causes(record: Record, center: Array, span: Array) -> Array:
    """Inputs, these times scheduling variables that move, and the variables."""
    moves = span > 0.0
    kappa = ((record.kappa - center) / np.where(moves, span, 1.0))[:, moves]
    u = record.u - record.u.mean(axis=0)
    products = [u * column[:, None] for column in kappa.T]
    return np.hstack([u, *products, kappa - kappa.mean(axis=0)])


def tell_of_noisy_scheduling(
    model: LPVStateSpace,
    records: Sequence[Record],
    errors: Levels,
    held: Levels,
    names: Sequence[Hashable],
) -> None:
    """Tell where scheduling variables do harm, as measured in local `records`.

    Where errors are smaller with these `held` at their means. By points of work the
    noise of a sensor moves the outputs at once.
    """
    own = errors.both
    share = held.both / np.where(own > 0.0, own, np.inf)
    worse = (share < _HELD) & (own * weights_of(records) > _SEEN)
    if worse.any():
        k = int(np.argmin(np.where(worse, share, np.inf)))
        shown = list(model.scheduling_names or range(1, model.n_scheduling + 1))
        warn(
            f"the noise of the scheduling variables, {shown}, moves output "
            f"{names[k]!r}: with their means over every local experiment in place of "
            f"them the errors are {100.0 * share[k]:.2g} % as large. Smooth their "
            "columns before `fit` and `predict`, or give their set-points."
        )
