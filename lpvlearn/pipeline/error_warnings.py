"""What the errors of an LPV model along experiments tell that it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ..exceptions import warn
from ..lpv.model import LPVStateSpace
from ..lpv.refinement import Own, Record, refine, squares
from ..subspace.residuals import explained_by_inputs

Array = NDArray[np.float64]

# Errors that are told: constants, of a search of so many steps, leave less than this
# share of their squares, or the inputs explain more than this share of the output.
_CONSTANT, _STEPS, _OF_OUTPUT = 0.25, 15, 0.1


def tell_of_errors(
    model: LPVStateSpace,
    records: Sequence[Record],
    errors: Sequence[Array],
    own: Own,
    start: LPVStateSpace,
    max_iter: int,
) -> None:
    """Tell of large errors that constants would take, or that follow the inputs.

    By some steps from the `start`, `max_iter` at most, with constants; and by
    regression on the inputs alone, times the scheduling variables, as a gain that
    varies, and on these, as what an offset does to such a gain, over all records and
    the one of the largest errors.
    """
    each = np.array([_shares(*pair) for pair in zip(records, errors, strict=True)])
    worst = int(each.max(axis=1).argmax())
    if not each[worst].max() > _OF_OUTPUT:
        return
    if not own.constant:
        with suppress(ValueError):  # it diverges
            other = own._replace(constant=True)
            steps = min(max_iter, _STEPS)
            found = refine(start, records, other, max_iter=steps).model
            weight = np.ones(model.n_outputs)
            squared = sum(squares(found, record, other, weight) for record in records)
            share = squared / np.sum(np.vstack(errors) ** 2)
            if share < _CONSTANT:
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
        names = model.output_names or range(1, model.n_outputs + 1)
        warn(
            f"the errors of output {names[i]!r} follow from the inputs and scheduling "
            f"variables, at {100.0 * part[i]:.0f} % of its size and beyond chance: the "
            "model lacks terms (a higher degree of `interpolator`), states, or a delay "
            "of an input (local=SubspaceLTI(input_delay='auto')), an input has an "
            "offset (subtract it), or the search ended in a poor minimum (`report_`): "
            "give a `start` that is nearer."
        )


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
