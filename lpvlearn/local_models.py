"""Step 3 at one operating point: experiments to one continuous-time local model."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from .experiments import Experiment
from .numerics.balancing import align_signs
from .statespace import StateSpace

Array = NDArray[np.float64]

_ROLES = ("inputs", "scheduling", "experiment", "time", "operating_point")


@dataclass(frozen=True)
class LocalModel:
    """The black-box model of one operating point.

    Attributes
    ----------
    lti : StateSpace
        Continuous time, balanced.
    order : int
        As identified, in discrete time.
    horizon : int or None
        Horizon of the subspace step, where the estimator tells it.
    n_models : int
        Models that were averaged; 1 for a pooled fit.
    """

    lti: StateSpace
    order: int
    horizon: int | None
    n_models: int


def identify_point(
    local: Any,
    experiments: Sequence[Experiment],
    *,
    sampling_time: float,
    combine: str,
    discretization: str,
) -> LocalModel:
    """Identify the local model of one operating point.

    Parameters
    ----------
    local : estimator
        Like `SubspaceLTI`: fitted, it has `lti_`, a discrete-time StateSpace. It is
        cloned.
    experiments : sequence of Experiment
        The realisations of this operating point.
    combine : {"pool", "average"}
        One fit of all experiments, or one model each, balanced, signs aligned, and the
        matrices averaged (the paper's Monte Carlo).
    discretization : {"zoh", "tustin"}

    Raises
    ------
    ValueError
        If the identified model is unstable, so that it cannot be balanced.
    """
    if combine == "pool" or len(experiments) == 1:
        fitted = fit_local(local, experiments, sampling_time)
        lti = _continuous(fitted.lti_, discretization)
        return LocalModel(lti, fitted.lti_.order, _horizon(fitted), 1)
    # The first realisation chooses order and horizon, the others follow it.
    fitted = fit_local(local, experiments[:1], sampling_time)
    chosen = clone(local)
    for name in ("order", "horizon"):
        if name in chosen.get_params() and hasattr(fitted, name + "_"):
            chosen.set_params(**{name: getattr(fitted, name + "_")})
    models, failures = [], []
    for experiment in experiments:
        model = fit_local(chosen, [experiment], sampling_time).lti_
        try:
            models.append(_continuous(model, discretization))
        except ValueError as error:
            failures.append((experiment.label, error))
    if not models:
        raise failures[0][1]
    if failures:
        warnings.warn(
            f"{len(failures)} of {len(experiments)} realisations were left out of the "
            f"average; the first, {failures[0][0]!r}: {failures[0][1]}",
            UserWarning,
            stacklevel=2,
        )
    return LocalModel(
        average_models(models), fitted.lti_.order, _horizon(fitted), len(models)
    )


def fit_local(
    local: Any, experiments: Sequence[Experiment], sampling_time: float
) -> Any:
    """A clone of the local estimator, fitted on the experiments as one table."""
    u = np.vstack([e.inputs for e in experiments])
    y = np.vstack([e.outputs for e in experiments if e.outputs is not None])
    label = np.repeat(np.arange(len(experiments)), [len(e.rows) for e in experiments])
    table = np.column_stack([u, label])
    n_inputs = u.shape[1]
    roles = dict.fromkeys(_ROLES)
    own: dict[str, Any] = {
        **roles,
        "inputs": list(range(n_inputs)),
        "experiment": n_inputs,
        "sampling_time": sampling_time,
    }
    estimator = clone(local)
    known = estimator.get_params(deep=False)
    estimator.set_params(**{name: own[name] for name in own if name in known})
    return estimator.fit(table, y)


def average_models(models: Sequence[StateSpace]) -> StateSpace:
    """Average balanced models of one order, state signs aligned to the first."""
    reference = models[0]
    total = [np.zeros_like(M) for M in (reference.A, reference.B, reference.C)]
    D = np.zeros_like(reference.D)
    used = [model for model in models if model.order == reference.order]
    for model in used:
        s = align_signs(model.B, model.C, reference.B, reference.C)
        total[0] += s[:, None] * model.A * s
        total[1] += s[:, None] * model.B
        total[2] += model.C * s
        D += model.D
    n = len(used)
    return StateSpace(total[0] / n, total[1] / n, total[2] / n, D / n)


def _continuous(model: StateSpace, discretization: str) -> StateSpace:
    return model.to_continuous(discretization).balance()


def _horizon(fitted: Any) -> int | None:
    horizon = getattr(fitted, "horizon_", None)
    return None if horizon is None else int(horizon)
