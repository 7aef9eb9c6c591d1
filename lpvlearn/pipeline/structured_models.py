"""Step 4 at every operating point: all local models in one structure.

The points help one another: the parameters of a neighbour lead out of a wrong basin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from ..models.statespace import StateSpace
from ..restructuring.minimise_covariance import Estimate
from ..restructuring.problem import GOOD_FIT, problem_from_models
from ..structures.structure import GrayBoxStructure
from ..subspace.statistics import DEVIATION, ModelPair
from .local_models import LocalModel, with_signs_of
from .runner import PointRunner

Array = NDArray[np.float64]


_Task = tuple[StateSpace, list[StateSpace], list[Estimate]]

_SWEEPS = 4  # passes over the points: help travels that far from a good one

_NEIGHBOURS = 2  # points that help one: those to either side along one variable

_BETTER = 0.98  # factor by which a neighbour's start must lower the error: no rounding


@dataclass(frozen=True)
class StructuredModels:
    """Models of one structure at the operating points.

    Attributes
    ----------
    structure : GrayBoxStructure
    theta : ndarray of shape (n_points, n_params)
        Parameters.
    models : list of StateSpace
    restructurers : list
        The fitted restructurers; empty without that step.
    kept : list of int
        The operating points, of those given, that did not fail.
    covariances : list of ndarray or None
        Of the parameters, where they are known.
    """

    structure: GrayBoxStructure
    theta: Array
    models: list[StateSpace]
    restructurers: list[Any]
    kept: list[int]
    covariances: list[Array | None]


def restructure_points(
    restructurer: Any, local: Sequence[LocalModel], kappa: Array, runner: PointRunner
) -> StructuredModels:
    """Bring the local models of all operating points into one structure.

    Parameters
    ----------
    restructurer : estimator or None
        Like `GrayBoxRestructurer`; None takes the entries of balanced models as they
        are.
    local : sequence of LocalModel
    kappa : ndarray of shape (n_points, n_scheduling)
    runner : PointRunner
    """
    if restructurer is None:
        # poles on the negative real axis make the order grow in continuous time
        structure, theta = balanced_entries(
            [model.lti.balance(min(model.order, model.lti.order)) for model in local]
        )
        balanced = [structure.model(row) for row in theta]
        every = list(range(len(theta)))
        return StructuredModels(
            structure, theta, balanced, [], every, [None] * len(theta)
        )
    restructurer = _with_structure(restructurer, local)
    # What a fit is about: the model, and where they are known its realizations and
    # estimates. Another norm or a weight is what the user wants minimised.
    weighed = getattr(restructurer, "norm", None) in ("hinf", "covariance")
    weighed = weighed and restructurer.frequency_weight is None
    tasks: list[_Task] = [
        (
            _plain(model.lti),
            [_plain(other) for other in model.realizations],
            [
                (_plain(one), [(_plain(a), _plain(b)) for a, b in pairs])
                for one, pairs in model.estimates
                if weighed
            ],
        )
        for model in local
    ]
    found = runner.run(
        "restructuring", _restructure_point, tasks, kappa, restructurer=restructurer
    )
    kept = [k for k, result in enumerate(found) if result is not None]
    helped = runner.call(
        _help_neighbours,
        [found[k] for k in kept],
        [tasks[k] for k in kept],
        kappa[kept],
        restructurer,
        ignore=["fitted"],
    )
    covariances: list[Array | None] = []
    for k, fitted in zip(kept, helped, strict=True):
        known = getattr(fitted, "params_covariance_", None)  # where it tells its own
        if known is None and local[k].deviated:
            known = runner.call(
                covariance_of_parameters,
                fitted.structure_,
                fitted.params_,
                getattr(fitted, "frequency_weight", None),
                tasks[k][0],
                local[k].deviated,
            )
        covariances.append(None if known is None else np.asarray(known))
    return StructuredModels(
        helped[0].structure_,
        np.array([fitted.params_ for fitted in helped]),
        [fitted.lti_ for fitted in helped],
        helped,
        kept,
        covariances,
    )


def _with_structure(restructurer: Any, local: Sequence[LocalModel]) -> Any:
    """One canonical form for all points, of the identified order, where none is given.

    Raises
    ------
    ValueError
        If the models differ in order.
    """
    if getattr(restructurer, "structure", "its own") is not None:
        return restructurer
    orders = sorted({model.order for model in local})
    if len(orders) > 1:
        raise ValueError(
            "`structure=None` interpolates the parameters of a canonical form and "
            f"needs local models of one order. Got orders {orders}. Fix the order: "
            "local=SubspaceLTI(order=...)."
        )
    first = local[0].lti
    form = GrayBoxStructure.observable_canonical(
        orders[0],
        first.n_inputs,
        first.n_outputs,
        orders[0] == 0 or any(model.lti.D.any() for model in local),
    )
    return clone(restructurer).set_params(structure=form)


def _restructure_point(
    model: StateSpace,
    realizations: Sequence[StateSpace],
    estimates: Sequence[Estimate],
    *,
    restructurer: Any,
    **options: Any,
) -> Any:
    """A clone of the restructurer, fitted to one local model."""
    restructurer = clone(restructurer)
    if len(realizations) > 1:
        options["realizations"] = realizations
    if estimates:
        restructurer.set_params(norm="covariance")
        options["estimates"] = estimates
    elif getattr(restructurer, "norm", None) == "covariance":  # it is not known
        restructurer.set_params(norm="hinf")
    return restructurer.fit_model(model, **options)


def _help_neighbours(
    fitted: Sequence[Any],
    tasks: Sequence[_Task],
    kappa: Array,
    restructurer: Any,
) -> list[Any]:
    """Try the parameters of neighbouring points as starts, until nothing improves.

    A point in a wrong basin is one that its neighbours' parameters lead out of. Points
    that fit well need no help.

    Parameters
    ----------
    fitted : sequence of estimators
        The restructurer fitted to every model: they follow from the other arguments.
    tasks : sequence of tuple
        Model, realizations and estimates of every point.
    kappa : ndarray of shape (n_points, n_scheduling)
    restructurer : estimator
    """
    fitted = list(fitted)
    span = np.ptp(kappa, axis=0)
    scaled = kappa / np.where(span > 0, span, 1.0)
    distance = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
    tried: set[tuple[int, bytes]] = set()
    for _ in range(_SWEEPS):
        improved = False
        for i, task in enumerate(tasks):
            if fitted[i].fit_error_ <= GOOD_FIT:
                continue
            for j in np.argsort(distance[i], kind="stable")[1 : 1 + _NEIGHBOURS]:
                start = fitted[j].params_
                key = (i, start.tobytes())
                if key in tried:
                    continue
                tried.add(key)
                own = fitted[i].fit_error_
                if fitted[i].start_error(task[0], start) < _BETTER * own:
                    fitted[i] = _restructure_point(
                        *task, restructurer=restructurer, starts=[start]
                    )
                    improved = True
        if not improved:
            break
    return fitted


def covariance_of_parameters(
    structure: GrayBoxStructure,
    theta: Array,
    weight: Any,
    model: StateSpace,
    deviated: Sequence[ModelPair],
) -> Array:
    """Covariance of gray-box parameters from that of the black box.

    The response's deviations are carried to the parameters to first order, as the
    least-squares fit of the response does.

    Parameters
    ----------
    structure : GrayBoxStructure
    theta : ndarray of shape (n_params,)
    weight : StateSpace, (low, high) or None
        As `frequency_weight` of `GrayBoxRestructurer`.
    model : StateSpace
        The black box.
    deviated : sequence of (StateSpace, StateSpace)
        From `deviated_models`.

    Returns
    -------
    ndarray of shape (n_params, n_params)
    """
    problem = problem_from_models(structure, [model], weight)
    omega = problem.omega
    dG = [
        above.frequency_response(omega) - below.frequency_response(omega)
        for above, below in deviated
    ]
    T = problem.parameter_changes(theta, np.array(dG)) / (2.0 * DEVIATION)
    return T.T @ T


def _plain(model: StateSpace) -> StateSpace:
    """The model with matrices laid out as a memory returns them, to be found there."""
    A, B, C, D = (np.array(M, order="C") for M in (model.A, model.B, model.C, model.D))
    return StateSpace(A, B, C, D, model.sampling_time)


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
        previous = with_signs_of(previous, model)
        rows.append(np.concatenate([getattr(previous, M).ravel() for M in "ABCD"]))
    return structure, np.array(rows)
