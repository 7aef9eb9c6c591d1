"""Whether states of black boxes matter where the scheduling variables move.

Experiments at points tell frozen models, of which any states are as good. In states
``z = T(kappa) x`` the LPV model lacks what T changes, ``(dT/dt) T^-1 z``: the more, the
larger z is, as where outputs stand far from zero, at each point elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...data.motion import motions
from ...data.operating_points import OperatingPoints
from ...exceptions import warn
from ...lpv.model import LPVStateSpace

Array = NDArray[np.float64]

_APART = 0.2  # of the outputs' motion: by so much either model may be wrong


def tell_of_other_states(
    model: LPVStateSpace, other: LPVStateSpace, points: OperatingPoints, dt: float
) -> None:
    """Tell of a model that moves unlike another one, of aligned states.

    From the first point to the last one and back, over a record, with the inputs of
    those on the way. ValueError where one of them diverges.
    """
    runs = [group[0] for group in points.experiments]
    n = min(len(e.rows) for e in runs)
    place = (len(runs) - 1) * (1.0 - np.abs(np.linspace(-1.0, 1.0, n)))
    before = np.minimum(place.astype(int), len(runs) - 2)
    share = (place - before)[:, None]

    def along(values: Sequence[Array]) -> Array:
        """From a value of one point to that of the next one, each (n, n_channels)."""
        known, rows = np.array(values), np.arange(n)
        return (1.0 - share) * known[before, rows] + share * known[before + 1, rows]

    kappa = along([np.broadcast_to(row, (n, len(row))) for row in points.kappa])
    u = along([(e.inputs - e.inputs.mean(axis=0))[:n] for e in runs])
    y, z = (
        m.simulate(u + m.input_offset(kappa), kappa, sampling_time=dt)
        for m in (model.silenced(), other.silenced())
    )
    _, (_, size) = motions(runs)
    apart = np.sqrt(np.mean((y - z) ** 2, axis=0)) / size
    k = int(np.argmax(apart))
    if apart[k] > _APART:
        names = model.output_names or range(1, model.n_outputs + 1)
        warn(
            "the operating points do not tell what the states of the model are, and "
            f"that matters where the scheduling variables move: over {n * dt:.3g} s "
            "from the first point to the last one and back, a model of aligned states, "
            "which is as good at the points, has another output "
            f"{list(names)[k]!r}, by {100.0 * apart[k]:.0f} % of how far it moves at "
            "these. Give an experiment that moves so, with refiner=OutputErrorLPV(), "
            "which decides; or a structure; or compare with restructurer='aligned'."
        )
