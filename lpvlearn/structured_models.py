"""Step 4 over all operating points: the points help one another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from .numerics.balancing import align_signs
from .statespace import StateSpace
from .structures import GrayBoxStructure

Array = NDArray[np.float64]

_SWEEPS = 4
_NEIGHBOURS = 2
_BETTER = 0.98  # a neighbour's start must lower the least-squares error by that


def restructure_point(model: StateSpace, *, restructurer: Any) -> Any:
    """A clone of the restructurer, fitted to one local model."""
    return clone(restructurer).fit_model(model)


def help_neighbours(
    fitted: Sequence[Any], models: Sequence[StateSpace], kappa: Array
) -> list[Any]:
    """Try the parameters of neighbouring points as starts, until nothing improves.

    A point in a wrong basin is one that its neighbours' parameters lead out of.
    """
    fitted = list(fitted)
    span = np.ptp(kappa, axis=0)
    scaled = kappa / np.where(span > 0, span, 1.0)
    distance = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
    tried: set[tuple[int, bytes]] = set()
    for _ in range(_SWEEPS):
        improved = False
        for i, model in enumerate(models):
            for j in np.argsort(distance[i], kind="stable")[1 : 1 + _NEIGHBOURS]:
                start = fitted[j].params_
                key = (i, start.tobytes())
                if key in tried:
                    continue
                tried.add(key)
                own = fitted[i].fit_error_
                if fitted[i].start_error(model, start) < _BETTER * own:
                    fitted[i] = clone(fitted[i]).fit_model(model, starts=[start])
                    improved = True
        if not improved:
            break
    return fitted


def balanced_entries(models: Sequence[StateSpace]) -> tuple[GrayBoxStructure, Array]:
    """The entries of balanced models as parameters, signs aligned along the points.

    The baseline of the paper: no common state basis is guaranteed.

    Raises
    ------
    ValueError
        If the models differ in order.
    """
    orders = sorted({model.order for model in models})
    if len(orders) > 1:
        raise ValueError(
            "`restructurer='passthrough'` interpolates matrices and needs local models "
            f"of one order. Got orders {orders}. Fix the order: "
            "local=SubspaceLTI(order=...)."
        )
    first = models[0]
    structure = GrayBoxStructure.full(orders[0], first.n_inputs, first.n_outputs)
    rows = []
    previous = first
    for model in models:
        s = align_signs(model.B, model.C, previous.B, previous.C)
        previous = StateSpace(
            s[:, None] * model.A * s, s[:, None] * model.B, model.C * s, model.D
        )
        blocks = (previous.A, previous.B, previous.C, previous.D)
        rows.append(np.concatenate([block.ravel() for block in blocks]))
    return structure, np.array(rows)
