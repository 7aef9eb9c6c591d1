"""Where a search of the coefficients begins: models of a table, as if it stood still.

Time-invariant ones of all experiments, or of parts, in the form of an LPV model; one
through the operating points at which experiments stay. Of every order those are tried
that simulate best, by the first steps of the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from joblib import Memory
from numpy.typing import NDArray
from sklearn.base import clone

from ...data.experiments import Experiment
from ...data.operating_points import local_experiments, moving_experiments
from ...data.preparation import part_of
from ...exceptions import collected
from ...lpv.auto import AutoLPV
from ...lpv.model import LPVStateSpace
from ...lpv.polynomial import PolynomialLPV
from ...lpv.refinement import Own, Record, refine, squares, weights_of
from ...models.scheduling_range import grid_over
from ...restructuring.estimator import GrayBoxRestructurer
from ...structures.structure import GrayBoxStructure
from ...subspace.estimator import SubspaceLTI
from ...subspace.telling import unheard
from ..checks.error_warnings import CONSTANT
from ..checks.stability import grows
from ..one_basis.black_boxes import balanced_entries
from ..one_basis.mirror_images import mirror_images
from ..one_basis.structured_models import (
    StructuredModels,
    over_points,
    restructure_points,
    without_structure,
)
from ..points.common_choices import identify_points, of_structure
from ..points.common_delay import common_delay
from ..points.fitting import is_left
from ..points.local_models import LocalModel, balanced_by_motion, identify_point
from ..running.runner import PointRunner
from .errors import record_of

Array = NDArray[np.float64]

# Parts of an experiment, each nearer to an operating point than the whole, of which
# time-invariant models are made, too; how many of these are tried, by so many steps.
_PARTS, _N_STARTS, _FIRST_STEPS = 5, 3, 15

# Of starts with several orders: squared errors, in the least ones, and errors relative
# to the outputs, that are alike after steps that do not reach the end of a valley; and
# orders that are tried beyond one that is as good, as a resonance has two states
_ALIKE, _NEGLIGIBLE, _FURTHER = 1.1, 1e-3, 2

_FEWEST_POINTS = 3  # at which experiments stay, of a model through these

_LEVELS = 5  # of every scheduling variable, where a form begins as a constant


class Wanted(NamedTuple):
    """What kind of model is looked for."""

    structure: GrayBoxStructure | None  # None: every entry of the matrices is free
    local: Any  # the estimator of time-invariant models
    interpolator: Any  # None: `AutoLPV` through points, a polynomial elsewhere


def best_start(
    wanted: Wanted,
    experiments: Sequence[Experiment],
    dt: float,
    own: Own,
    *,
    may_be_constant: bool,
    n_jobs: int | None,
) -> tuple[LPVStateSpace, Own]:
    """The model of a table whose first steps come farthest, in the form wanted.

    And the unknowns of every experiment that go with it: `own`, and constants where
    they may be some and the records ask for them.
    """
    names = experiments[0].scheduling_names
    records = [record_of(e, dt) for e in experiments]
    seen = np.vstack([r.kappa for r in records]) if names else np.zeros((1, 1))
    bounds = np.array([seen.min(axis=0), seen.max(axis=0)])
    with unheard(), collected():  # where a search begins, nobody needs to hear of
        local, most = of_structure(wanted.local, wanted.structure)
        whole = _time_invariant(local, experiments, dt, most)
        models = _constant_models(wanted, whole, experiments, bounds)
        plainer = _plainer(local, whole.order_of_rates)
        for part in [part for e in experiments for part in _parts_of(e)]:
            with suppress(ValueError):  # it tells too little
                found = _time_invariant(plainer, [part], dt, most)
                models += _constant_models(wanted, found, [part], bounds)
        with suppress(ValueError):
            models += _through_points(wanted, experiments, dt, bounds, n_jobs)
    if may_be_constant and whole.n_trend:
        with_constants = own._replace(constant=True)
        tried = _promising(models, records, with_constants)
        # slow states of a higher order would stand for constants
        fewest = _of_fewest_states(tried, records, 1.0 / CONSTANT)
        if _asks_for_constants(fewest, records, own):
            return _of_fewest_states(tried, records), with_constants
    return _of_fewest_states(_promising(models, records, own), records), own


def _through_points(
    wanted: Wanted,
    experiments: Sequence[Experiment],
    dt: float,
    bounds: Array,
    n_jobs: int | None,
) -> list[LPVStateSpace]:
    """The model through the operating points at which experiments stay, if any."""
    points = local_experiments(moving_experiments(experiments)[0])
    if len(points) < _FEWEST_POINTS:
        return []
    runner = PointRunner(n_jobs, 0, "raise", Memory(None))
    structure = wanted.structure
    local, points = identify_points(
        wanted.local,
        points,
        runner,
        structure=structure,
        sampling_time=dt,
        combine="pool",
        discretization="zoh",
        efficient=True,
    )
    form = AutoLPV() if wanted.interpolator is None else clone(wanted.interpolator)
    known = local, points, runner, dt
    if structure is None:
        ways = without_structure(*known, form, every=True)
    else:
        known_points = restructure_points(GrayBoxRestructurer(structure), *known)
        ways = mirror_images(known_points)
    found = [through(form, way, dt) for way in ways]
    return [replace(model, scheduling_range=bounds) for model in found]


def _constant_models(
    wanted: Wanted,
    found: LocalModel,
    experiments: Sequence[Experiment],
    bounds: Array,
) -> list[LPVStateSpace]:
    """The time-invariant model of some experiments, in the form of an LPV model.

    And where the order is free what has fewer states: what moves looks like states
    to a time-invariant model, but not along the scheduling variables.
    """
    structure, delay = wanted.structure, found.lti.input_delay
    form = wanted.interpolator
    if form is None:
        form = PolynomialLPV(1 if structure is None else 2)
    if not experiments[0].scheduling_names:
        form = PolynomialLPV(0)
    grid = grid_over(bounds, _LEVELS)
    if structure is None:
        free = is_left(wanted.local, "order") and found.lti.is_stable
        orders = [*range(1, found.lti.order)] if free else []
        entries = [
            balanced_entries([balanced_by_motion(found.lti, experiments, order)])
            for order in [*orders, None]
        ]
    else:
        theta = GrayBoxRestructurer(structure).fit_model(found.lti).params_
        entries = [(structure, theta[None])]
    models = []
    for structure, theta in entries:
        constant = clone(form).fit(grid, np.tile(theta, (len(grid), 1)))
        models.append(LPVStateSpace(structure, constant, bounds, input_delay=delay))
    return models


def _parts_of(e: Experiment) -> list[Experiment]:
    """Parts of an experiment, along which the scheduling variables move less."""
    ends = np.linspace(0, len(e.rows), _PARTS + 1).astype(int)
    return [part_of(e, slice(a, b)) for a, b in pairwise(ends) if b > a + 1]


def _time_invariant(
    local: Any, experiments: Sequence[Experiment], dt: float, most: bool
) -> LocalModel:
    """A model of experiments as if they did not move; options as `identify_point`."""
    return identify_point(
        local,
        experiments,
        sampling_time=dt,
        combine="pool",
        discretization="zoh",
        deviate=False,
        most=most,
    )


def _plainer(local: Any, order: int) -> Any:
    """The estimator for parts of experiments, where these only make more starts.

    What was left to it, it need not weigh there: what each does along all of the
    experiments tells.
    """
    if type(local) is not SubspaceLTI:
        return local
    plain = {"order": order, "method": "po-moesp", "offset": "constant"}
    chosen = {name: v for name, v in plain.items() if is_left(local, name)}
    return clone(local).set_params(refine=False, **chosen)


_Tried = list[tuple[float, LPVStateSpace]]  # errors of first steps, and start


def _promising(
    models: Sequence[LPVStateSpace], records: Sequence[Record], own: Own
) -> _Tried:
    """The start of every order whose first steps come farthest, and how far.

    From few states up, to some more than are as good as any.
    """
    if len(models) == 1:
        return [(0.0, models[0])]
    weight = weights_of(records)

    def loss(model: LPVStateSpace) -> float:
        return squares(model, records, own, weight)

    def soon(model: LPVStateSpace) -> tuple[float, LPVStateSpace]:
        try:
            found = refine(model, records, own, max_iter=_FIRST_STEPS).model
        except ValueError:  # it diverges, or has states too fast for its samples
            return np.inf, model
        return loss(found), found

    longest = max(len(record.u) * record.dt for record in records)
    orders = sorted({model.order for model in models})
    tried: _Tried = []
    for n in orders:
        best = sorted((m for m in models if m.order == n), key=loss)[:_N_STARTS]
        ends = [(*soon(model), model) for model in best]
        least, found, model = min(ends, key=lambda one: one[0])
        if len(orders) > 1:
            least, found = soon(found)
            # free initial states allow that: simulations from elsewhere pay for it
            if grows(found, grid_over(found.scheduling_range, 3), longest):
                least /= CONSTANT
        tried.append((least, model))
        if _of_fewest_states(tried, records).order <= n - _FURTHER:
            break
    return tried


def _of_fewest_states(
    tried: _Tried, records: Sequence[Record], alike: float = _ALIKE
) -> LPVStateSpace:
    """The start of the lowest order that comes about as far as any.

    What more states gain is noise, and part of a way that a longer search goes.
    """
    negligible = _NEGLIGIBLE**2 * sum(record.y.size for record in records)
    enough = alike * min(left for left, _ in tried) + negligible
    return next(model for left, model in tried if left <= enough)


def _asks_for_constants(
    model: LPVStateSpace, records: Sequence[Record], own: Own
) -> bool:
    """Whether constants of the outputs leave little of the errors without them."""
    weight, left = weights_of(records), []
    for constant in (False, True):
        each = own._replace(constant=constant)
        found = model
        with suppress(ValueError):  # it diverges
            found = refine(model, records, each, max_iter=_FIRST_STEPS).model
        left.append(squares(found, records, each, weight))
    return left[1] < CONSTANT * left[0]


def through(form: Any, found: StructuredModels, dt: float) -> LPVStateSpace:
    """The LPV model through operating points, by a clone of a form."""
    delay = common_delay(found.local, found.points.kappa, dt)
    form, hold = over_points(clone(form), found), found.local[0].hold
    return LPVStateSpace(
        found.structure, form, found.points.span, input_delay=delay, hold=hold
    )


def best_along(
    ways: Sequence[StructuredModels],
    form: Any,
    experiments: Sequence[Experiment],
    sampling_time: float,
) -> StructuredModels:
    """The structured models through which a form simulates experiments best.

    Of those that move, whatever their levels: what tells how states should be chosen.
    """
    if len(ways) == 1:
        return ways[0]
    records = [record_of(e, sampling_time) for e in experiments]
    own, weight = Own(initial_state=True, constant=True), weights_of(records)

    def loss(found: StructuredModels) -> float:
        with collected():  # is told of what is taken
            model = through(form, found, sampling_time)
        try:
            return squares(model, records, own, weight)
        except ValueError:  # it diverges: told of the best, if all do
            return np.inf

    return min(ways, key=loss)
