"""Does a system stay the same over its record? Models of parts of it tell.

A test of structural change (Chow, *Econometrica* 28, 1960) by what models of each part
leave of the errors of the one for all. Slow noise, and all that goes on at a time in
one part only, is followed by initial states and trends of a part as by its model: so
the errors must be smaller once they are whitened, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.threads import one_blas_thread
from ..samples.records import Record
from ..simulation_error.refinement import refine_simulation
from ..simulation_error.simulation_fit import (
    Freedom,
    Realization,
    simulation_errors,
    simulation_fit,
    with_initial_states,
)
from .regressions import filtered, whitening_filters
from .statistics import Evidence

Array = NDArray[np.float64]

# Parts of a record: at most so many, each of so many values for every parameter.
_PARTS, _VALUES_EACH = 8, 20

# Share of an output's size from which what the model leaves is looked into, and of the
# squared errors, and of the whitened ones, that models of parts leave where the system
# was not the same in them.
_ROUGH, _CHANGED, _CHANGED_WHITE = 0.1, 0.25, 0.5


class Change(NamedTuple):
    """An output of which models of parts leave far less than the one for all."""

    output: int
    n_parts: int
    together: float  # left by the one for all, relative to the output
    apart: float


@one_blas_thread
def change_over(evidence: Evidence) -> Change | None:
    """The output that changes most over a record, beyond chance; None if none does."""
    model, free = evidence.model, evidence.free
    if len(evidence.records) != 1 or not np.isfinite(model.loss) or not len(model.A):
        return None
    record = evidence.records[0]
    each = free._replace(initial_states=True)  # of parts: they begin in mid-motion
    parts = _parts(record, _VALUES_EACH * (model.C.size + model.B.size + len(model.A)))
    size = record.y.std(axis=1)
    if len(parts) < 2 or not size.all():
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        if not (_rms(_together(model, parts, each)) > _ROUGH * size).any():
            return None
        model = _refined(model, record, free)  # as the parts are, whatever it was
        models = [_refined(model, part, each) for part in parts]
        apart = [
            simulation_errors(of_part, [part])[0]
            for of_part, part in zip(models, parts, strict=True)
        ]
        change = _change(_together(model, parts, each), apart, size)
        # What is left by a poor minimum says nothing of the system: parts found others.
        if change is not None:
            fits = [simulation_fit(m.A, m.C, [record], free) for m in models]
            best = min(fits, key=lambda fit: fit.loss)
            if np.isfinite(best.loss):
                best = refine_simulation(best, [record], free)
                return _change(_together(best, parts, each), apart, size)
        return change


def _change(
    together: Sequence[Array], apart: Sequence[Array], size: Array
) -> Change | None:
    """What the errors of one model and of models of parts tell, if they do."""
    if not all(np.isfinite(e).all() for e in (*together, *apart)):
        return None
    left, left_apart = _rms(together) / size, _rms(apart) / size
    filters = whitening_filters(apart)
    white, white_apart = (_rms(filtered(e, filters)) for e in (together, apart))
    changed = (left > _ROUGH) & (white_apart**2 < _CHANGED_WHITE * white**2)
    shares = np.where(changed, left_apart / np.maximum(left, _ROUGH), np.inf) ** 2
    k = int(shares.argmin())
    if not shares[k] < _CHANGED:
        return None
    return Change(k, len(apart), float(left[k]), float(left_apart[k]))


def _together(model: Realization, parts: list[Record], free: Freedom) -> list[Array]:
    """Errors of one model for all parts, of initial states and trends of each."""
    return simulation_errors(with_initial_states(model, parts, free), parts)


def _refined(model: Realization, record: Record, free: Freedom) -> Realization:
    """The nearest minimum of the simulation error of a record."""
    start = simulation_fit(model.A, model.C, [record], free)
    return refine_simulation(start, [record], free)


def _parts(record: Record, least: int) -> list[Record]:
    """Parts of a record of at least so many values, those in which all inputs move."""
    n_samples = record.n_samples
    n_parts = min(_PARTS, record.y.size // least)
    ends = np.linspace(0, n_samples, n_parts + 1 if n_parts > 1 else 1).astype(int)
    parts = [record.part(slice(a, b)) for a, b in zip(ends, ends[1:], strict=False)]
    return [part for part in parts if np.ptp(part.u, axis=1).all()]


def _rms(errors: Sequence[Array]) -> Array:
    """Root mean squares of the errors of every output."""
    return np.sqrt(np.mean(np.vstack(errors) ** 2, axis=0))
