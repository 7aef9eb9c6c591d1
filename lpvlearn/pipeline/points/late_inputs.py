"""Inputs that arrive late, where nobody said so.

Each sample of a delay takes a state of the local models, which between operating points
stand for no delay, or bends the parameters of a structure.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from sklearn.base import clone

from ...data.operating_points import OperatingPoints
from ...exceptions import Told, collected, warn
from ...subspace.estimator import SubspaceLTI
from .common_delay import cost_with_delay, delay_in_samples
from .continuous_time import ALTERNATES
from .fitting import integrates
from .local_models import LocalModel

# What is told of models that a delay is missing in: that, what else a model of a given
# order may lack, and poles that alternate from sample to sample.
_SHOWN = {"delay", "lack", ALTERNATES}


def with_delays(
    estimator: Any,
    local: list[LocalModel],
    points: OperatingPoints,
    identify: Callable[[Any], tuple[list[LocalModel], OperatingPoints]],
    sampling_time: float,
    told: list[Told],
    input_names: Sequence[Hashable],
) -> tuple[Any, list[LocalModel]]:
    """An estimator that finds delays, and its models, if these are likelier.

    Where something was `told` of delays at a point, and none is given: what was told is
    taken back then. Or of what one sample may be told as: then with delays nothing of
    the kind is told any more. All points must have the same.
    """
    said = {one.kind for one in told}
    kinds, own = said & _SHOWN, sum(model.criterion for model in local)
    if not kinds or "useless" in said or not _is_to_have_none(estimator):
        return estimator, local
    if not np.isfinite(own):  # of averages
        return estimator, local
    finding, found = clone(estimator).set_params(input_delay="auto"), list[LocalModel]()
    with collected() as later, suppress(ValueError):
        found = identify(finding)[0]
    still = {one.kind for one in later} & kinds
    if len(found) < len(points) or ("delay" not in kinds and still):
        return estimator, local
    pairs = zip(found, points.experiments, strict=True)
    cost = sum(cost_with_delay(finding, *pair, sampling_time) for pair in pairs)
    if not cost < own:
        return estimator, local
    delays = np.array([delay_in_samples(model, sampling_time) for model in found])
    if not delays[0].any() or (delays != delays[0]).any():
        return estimator, local  # an LPV model has one
    delay = delays[0].tolist()
    told[:] = later
    before, after = (
        ", ".join(map(str, sorted({model.order for model in models})))
        for models in (local, found)
    )
    warn(
        f"inputs {list(input_names)} arrive after {delay} samples, by models that are "
        f"likelier so: of order(s) {after}, without delays of {before}."
        f" Use local=SubspaceLTI(input_delay={delay}) to say so, or "
        f"input_delay={[0] * len(delay)} to have none."
    )
    return finding, found


def _is_to_have_none(estimator: Any) -> bool:
    """Whether an estimator has no delay by default, which a list would ask for."""
    if type(estimator) is not SubspaceLTI or integrates(estimator):
        return False
    return isinstance(estimator.input_delay, int) and estimator.input_delay == 0
