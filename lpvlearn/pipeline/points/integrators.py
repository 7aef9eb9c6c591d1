"""Outputs that integrate, as a position does, where nobody said so.

Without a structure the rate of an integrator may jump with the scheduling variable, and
the integrator keeps that. Local models of the rates, integrated, have it where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from sklearn.base import clone

from ...data.operating_points import OperatingPoints
from ...exceptions import Told, collected, warn
from .continuous_time import HARDLY, integrating_places
from .fits import Measured, fit_of
from .local_models import LocalModel

# Of squared errors: those of models that know of integrators; and percents of the
# outputs that are as good as none.
_POORER, _EXACT = 1.1, 0.01


def integrated(
    estimator: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    identify: Callable[[Any], tuple[list[LocalModel], OperatingPoints]],
    sampling_time: float,
    told: list[Told],
    output_names: Sequence[Hashable],
    *,
    growing: bool = False,
) -> tuple[Any, list[LocalModel]]:
    """An estimator that knows which outputs integrate, and its models.

    What was `told` of the `local` ones is taken back where these are others. Poles may
    be further from zero where models are `growing`: they are of no use as they are.
    """
    share = 1.0 if growing else HARDLY
    places = integrating_outputs(local, share / (sampling_time * points.n_longest))
    if not places:
        return estimator, local
    names = [output_names[k] for k in places]
    what = (
        f"outputs {names} integrate at all operating points, as a position does: "
        "their local models have a pole that does not decay over the record. "
    )
    knowing = clone(estimator)
    found: list[LocalModel] = []
    # in pieces of records rates tell less than outputs do
    whole = all(len({e.label for e in g}) == len(g) for g in points.experiments)
    with collected() as later, suppress(ValueError):
        knowing.set_params(integrating=places)
        found = identify(knowing)[0] if whole else []
        if len(found) < len(points) or _are_poorer(found, local, points, sampling_time):
            found = []
    if not found:
        warn(
            f"{what}Without a structure an LPV model drifts off where that is not "
            f"known. Use local=SubspaceLTI(integrating={names})."
        )
        return estimator, local
    told[:] = later
    warn(
        f"{what}They were identified by their rates, and integrated. Use "
        f"local=SubspaceLTI(integrating={names}) to say so."
    )
    return knowing, found


def integrating_outputs(local: Sequence[LocalModel], rate: float) -> list[int]:
    """Places of outputs that integrate at all points, though nobody said so.

    By poles within a `rate` (1/s) about zero.
    """
    found = [integrating_places(model.lti, rate) for model in local]
    if any(model.integrating for model in local) or not all(found):
        return []
    return sorted(set.intersection(*map(set, found)))


def _are_poorer(
    found: Sequence[LocalModel],
    others: Sequence[LocalModel],
    points: OperatingPoints,
    sampling_time: float,
) -> bool:
    """Whether models leave more of the local experiments than other ones.

    As far as that is more than next to nothing.
    """
    measured = [Measured.of(group) for group in points.experiments]

    def error(models: Sequence[LocalModel]) -> float:
        fits = [
            fit_of(m.lti, known, sampling_time, m.n_trend, m.hold)
            for m, known in zip(models, measured, strict=True)
        ]
        return float(np.sum(np.maximum(100.0 - np.array(fits), _EXACT) ** 2))

    return not error(found) < _POORER * error(others)
