"""One state more, for what a model leaves of the outputs.

That of a subspace of the errors, or the best of a grid of real poles. Where the inputs
move seldom, as in step tests, subspaces mostly lead to another minimum than that of the
best model of its order. A real pole `p` beside the others adds to the outputs

    ``c b^T (z - p)^-1 u``,

of rank one. Its `c` is the first right singular vector of ``Q^T E``: `Q` is an
orthonormal basis of the inputs through the pole, without what the poles of the model
and a feedthrough may explain, and `E` holds the errors, (n_samples, n_outputs).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray
from scipy import linalg

from ..evidence.regressions import of_size_one, through_modes, without
from ..samples.records import Record
from ..simulation_error.simulation_fit import (
    Realization,
    simulation_errors,
    simulation_fit,
)
from .identification import Settings, realize, subspaces_of

Array = NDArray[np.float64]

# Time constants from one sample to twice the longest experiment
_N_POLES, _LONGEST = 12, 2.0

_KEPT = 2  # poles, of the grid

_SHORT_HORIZON = 10  # of a subspace of errors

_KNOWN = 1e-3  # part of the inputs through a pole that others leave, at least


class FurtherStates:
    """Models of records with a state more than others."""

    def __init__(self, records: Sequence[Record], settings: Settings) -> None:
        self._records, self._settings = records, settings
        longest = max(record.n_samples for record in records)
        self._poles = np.exp(-np.geomspace(1.0 / (_LONGEST * longest), 1.0, _N_POLES))

    @cached_property
    def n_moves(self) -> float:
        """How often inputs move, by steps of like size: ``(sum w)^2 / sum w^2``.

        Of the squared changes w of all inputs together. A step beside small noise is
        one. Infinite for one experiment: the states that explain most of a step alone
        are those of its noise.
        """
        if len(self._records) == 1:
            return np.inf
        changes = [np.diff(record.u, axis=1) for record in self._records]
        w = np.concatenate([np.sum(change**2, axis=0) for change in changes])
        return float(w.sum() ** 2 / max(w @ w, np.finfo(float).tiny))

    def of_errors(self, model: Realization) -> Realization | None:
        """The model and the state of a subspace of its errors, not yet refined."""
        settings, records = self._settings, self._records
        errors = simulation_errors(model, records)
        room = settings.max_horizon([record.n_samples for record in records])
        horizon = min(_SHORT_HORIZON, room)
        if not np.isfinite(model.loss) or settings.max_order(horizon) < 1:
            return None
        left = [Record.of(r.u.T, e) for r, e in zip(records, errors, strict=True)]
        space = subspaces_of(left, {horizon: 1}, settings)[horizon]
        more = realize(space, left, 1, settings._replace(n_noise_states=0))
        A, C = linalg.block_diag(model.A, more.A), np.hstack([model.C, more.C])
        return simulation_fit(A, C, records, settings.free)

    @cached_property
    def _through(self) -> Array:
        """Inputs through the poles, (n_samples, n_poles * n_inputs), of size one."""
        several = [
            [scipy.signal.lfilter([0.0, 1.0], [1.0, -p], r.u) for r in self._records]
            for p in self._poles
        ]
        return of_size_one(np.vstack([np.hstack(answers) for answers in several]).T)

    def beside(self, model: Realization) -> list[Realization]:
        """The model with states that explain most, best first, not yet refined.

        Nothing is beside one that is not finite.
        """
        errors = np.vstack(simulation_errors(model, self._records))
        if not (np.isfinite(model.loss) and np.isfinite(errors).all()):
            return []
        poles, ny = np.linalg.eigvals(model.A).astype(complex), len(model.C)
        known = [np.hstack([through_modes(poles, r.u.T), r.u.T]) for r in self._records]
        columns = np.hstack([self._through, errors])
        left, _ = without(of_size_one(np.vstack(known)), columns)
        new = left[:, :-ny].T.reshape(_N_POLES, -1, len(left)).swapaxes(1, 2)
        Q, R = np.linalg.qr(new)
        # of poles like those of the model rounding is left
        is_new = np.abs(np.diagonal(R, axis1=1, axis2=2)) > _KNOWN
        parts = is_new[:, :, None] * (Q.swapaxes(1, 2) @ left[:, -ny:])
        directions = np.linalg.svd(parts, full_matrices=False)[2][:, 0]
        found = [
            simulation_fit(
                linalg.block_diag(model.A, pole),
                np.column_stack([model.C, direction]),
                self._records,
                self._settings.free,
            )
            for pole, direction in zip(self._poles, directions, strict=True)
        ]
        return sorted(found, key=lambda one: one.loss)[:_KEPT]
