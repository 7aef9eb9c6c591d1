"""Coefficients of an LPV model that fit records along which kappa moves.

    min_c  sum_k |y_k - y_k(c)|^2_W + (c - c_0)^T L (c - c_0)

with W the inverse variances of what is left of every output, estimated anew, and L what
is known of the coefficients before. The initial state of every record, and a constant
of every output, enter linearly and are projected out (variable projection).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed as later
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..models.scheduling_range import grid_over
from ..systems.least_squares import RCOND, column_scale, levenberg_marquardt
from ..systems.simulation import estimate_initial_state
from .model import LPVStateSpace
from .polynomial import PolynomialLPV
from .sensitivity import coefficients_of, output_slopes, with_coefficients
from .weighting import is_chance

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_ROUNDS = 5  # of variances, each with the fit that they weigh
_SETTLED = 0.02  # relative change of standard deviations that needs no other round

# Relative decrease of the cost, twice in a row, that ends a search: near a minimum the
# steps are Newton's, and leave far less. In a valley of changes of the state basis,
# which a model without a structure has, many steps more would fit the noise alone.
_TOL = 1e-3

# The same of a search whose end is not the last: for variances that are estimated anew
# afterwards, and of terms that pieces of the records choose among, each from the other.
_ROUGH = 0.02

# Standard deviation of an output's errors, relative to the output, below which they
# weigh no more: those of exact data are rounding.
_EXACT = 1e-9

# Marquardt's damping of the first step. Local experiments, or a first fit, have left
# the search near its end, and coefficients that hardly tell from each other need more
# than a thousandth of their lengths: with 1e-3 it takes twice as many steps.
_DAMPING = 1e-6

_PIECES = 8  # of a record, not shorter than _PIECE samples a state
_PIECE = 20

_RATE_DEGREE = 2  # of the rate terms in the scheduling variables

# Information on every rate term, that it is zero but for chance, in that of the records
# on it alone; from strong to weak, and none.
_SHRINKAGE = (0.1, 1e-2, 1e-3, 1e-4, 0.0)

# Share by which rate terms must lower the errors of pieces they were not fitted to:
# what is gained by chance is less.
_WORTH = 0.02


# From calls as `joblib.delayed` writes them down to their results, in their order.
Run = Callable[[Iterable[Any]], Iterable[Any]]


def in_turn(tasks: Iterable[Any]) -> Iterator[Any]:
    """Results of tasks, one after another."""
    return (function(*args, **kwargs) for function, args, kwargs in tasks)


class Record(NamedTuple):
    """Samples of one run."""

    u: Array  # (n_samples, n_inputs)
    y: Array  # (n_samples, n_outputs)
    kappa: Array  # (n_samples, n_scheduling)
    dt: float


class Own(NamedTuple):
    """Unknowns of every record."""

    initial_state: bool  # else at rest
    constant: bool  # of every output

    def columns(self, free: Array) -> Array:
        """Their effects on the outputs, (n_samples, n_outputs, n_own)."""
        parts = [free] if self.initial_state else []
        if self.constant:
            eye = np.eye(free.shape[1])
            parts.append(np.broadcast_to(eye, (len(free), *eye.shape)))
        return np.concatenate([free[:, :, :0], *parts], axis=2)


class Prior(NamedTuple):
    """What is known of the coefficients: their information about a centre."""

    centre: Array
    information: Array

    def widened(self, information: Array) -> Prior:
        """The same, with more coefficients, each known to be about zero."""
        centre = np.pad(self.centre, (0, len(information)))
        return Prior(centre, block_diag(self.information, np.diag(information)))


class Refined(NamedTuple):
    """A model fitted to records."""

    model: LPVStateSpace
    information: Array  # of the free coefficients, records and prior together
    free: Flags  # of the coefficients of interpolator and rate terms
    deviation: Array  # (n_outputs,) standard deviations of what is left
    own: list[Array]  # unknowns of every record: initial state, constants
    prior: Prior | None  # that it was fitted with
    costs: list[tuple[int, float]]  # round, and cost of every step taken
    n_iter: int  # steps tried


def responses_along(
    model: LPVStateSpace, record: Record, own: Own
) -> tuple[Array, Array]:
    """Outputs by themselves (n_samples, n_outputs), and by the own unknowns.

    They do not depend on the measured outputs. Raises a DivergenceError.
    """
    if own.initial_state:
        y, free = model.rest_and_free_responses(record.u, record.kappa, record.dt)
        free = free[:, :, : model.order]
    else:
        y = model.simulate(record.u, record.kappa, record.dt)
        free = np.zeros((*y.shape, 0))
    return y, own.columns(free)


def simulated(
    model: LPVStateSpace,
    record: Record,
    own: Own,
    weight: Array | None = None,
    responses: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Errors (n_samples, n_outputs) of a model, and the own unknowns behind them.

    These make the least of the weighted errors: weighted by how far outputs move, if
    not otherwise. The `responses_along` the record may be known. Raises a
    DivergenceError.
    """
    if weight is None:
        weight = weights_of([record])
    y, columns = responses or responses_along(model, record, own)
    error = record.y - y
    if not columns.shape[2]:
        return -error, np.zeros(0)
    found = estimate_initial_state(columns * weight[:, None], error * weight)
    return columns @ found - error, found


def weights_of(records: Sequence[Record]) -> Array:
    """Of the errors of outputs (n_outputs,), by how far these move in the records."""
    power = np.mean([np.var(record.y, axis=0) for record in records], axis=0)
    return np.asarray(1.0 / np.sqrt(np.where(power > 0.0, power, 1.0)))


def initial_state(
    model: LPVStateSpace, record: Record, own: Own, found: Array
) -> Array:
    """State at the first sample, by the unknowns of the record."""
    x0 = model.beginning(record.u, record.kappa)[0]
    return x0 + found[: model.order] if own.initial_state else x0


def weighted_slopes(
    model: LPVStateSpace,
    record: Record,
    own: Own,
    weight: Array,
    free: Flags,
    errors: Array,
    found: Array,
) -> Iterator[tuple[slice, Array]]:
    """Derivatives by the own unknowns, errors, and derivatives by the coefficients.

    A block of samples at a time, weighted: (n_block, n_outputs, n_own + 1 + n_free).
    """
    n, x0 = model.order, initial_state(model, record, own, found)
    slopes = output_slopes(model, record.u, record.kappa, record.dt, x0, free)
    for rows, J in slopes:
        parts = [own.columns(J[:, :, :n]), errors[rows, :, None], J[:, :, n:]]
        yield rows, np.concatenate(parts, axis=2) * weight[:, None]


def _gram(
    model: LPVStateSpace,
    record: Record,
    own: Own,
    weight: Array,
    free: Flags,
    errors: Array,
    found: Array,
) -> Array:
    """``[r J]^T [r J]`` of weighted errors and slopes, own unknowns projected out."""
    total: Any = 0.0
    for _, Z in weighted_slopes(model, record, own, weight, free, errors, found):
        flat = Z.reshape(-1, Z.shape[2])
        total = total + flat.T @ flat
    G, k = np.asarray(total), len(found)
    if k == 0:
        return G
    size = np.sqrt(np.diag(G)[:k])
    size[size == 0] = 1.0
    inner = np.linalg.pinv(G[:k, :k] / size[:, None] / size, RCOND, hermitian=True)
    across = G[:k, k:] / size[:, None]
    return G[k:, k:] - across.T @ inner @ across


def refine(
    start: LPVStateSpace,
    records: Sequence[Record],
    own: Own,
    prior: Prior | None = None,
    *,
    fixed: Flags | None = None,
    deviation: Array | None = None,
    max_iter: int = 200,
    run: Run = in_turn,
    tell: Callable[[float], None] = lambda cost: None,
) -> Refined:
    """Fit the coefficients of a model, which must not diverge on the records.

    `fixed` coefficients stay; `prior` is one of all of them. With the `deviation` of
    every output known the search is a rough one. `max_iter` counts the steps that are
    tried, of all estimates of the variances. `run` gives the results of tasks, a record
    each; `tell` hears the cost of every step taken.
    """
    bases, start = start.bases, replace(start.silenced(), bases=())
    c0 = coefficients_of(start)
    free = np.ones(len(c0), bool) if fixed is None else ~fixed
    q = int(free.sum())
    centre, information = np.zeros(q), np.zeros((q, q))
    if prior is not None:
        centre, information = prior.centre[free], prior.information[np.ix_(free, free)]
    total = _sizes(records)
    costs: list[tuple[int, float]] = []
    left, told = max_iter, information

    def model_of(c: Array) -> LPVStateSpace:
        full = c0.copy()
        full[free] = c
        return with_coefficients(start, full)

    def all_errors(model: LPVStateSpace, weight: Array) -> list[tuple[Array, Array]]:
        return list(run(later(simulated)(model, r, own, weight) for r in records))

    def gram(c: Array, errors: list[tuple[Array, Array]], weight: Array) -> Array:
        model = model_of(c)
        parts = run(
            later(_gram)(model, r, own, weight, free, *e)
            for r, e in zip(records, errors, strict=True)
        )
        G, d = np.sum(list(parts), axis=0), c - centre
        pulled = information @ d
        G[0, 0] += d @ pulled
        G[0, 1:] += pulled
        G[1:, 0] += pulled
        G[1:, 1:] += information
        return G

    def minimise(c: Array, weight: Array, n_round: int, rough: bool) -> Array:
        def residuals(trial: Array, rows: NDArray[np.intp]) -> tuple[Array, Callable]:
            """In coordinates whose first axis is that of the residuals themselves."""
            nonlocal left
            left -= 1  # a step tried
            r = np.zeros((1, 1 + q))
            try:
                errors = all_errors(model_of(trial[0]), weight)
            except ValueError:  # it diverges, or there is no such model
                return np.full_like(r, np.inf), lambda kept: np.zeros((0, 1 + q, q))
            d = trial[0] - centre
            cost = sum(float(np.sum((e * weight) ** 2)) for e, _ in errors)
            cost += d @ information @ d
            r[0, 0] = np.sqrt(cost)

            def jacobian(kept: NDArray[np.intp]) -> Array:
                nonlocal told
                try:
                    G = gram(trial[0], errors, weight)
                except ValueError:  # states too fast for its samples
                    if not costs:
                        raise
                    return np.full((1, 1 + q, q), np.inf)
                costs.append((n_round, cost))
                tell(cost)
                told = G[1:, 1:]
                return _rotated(G, r[0, 0])[None]

            return r, jacobian

        tol, patience = (_ROUGH, 1) if rough else (_TOL, 2)
        return levenberg_marquardt(
            residuals,
            c[None],
            max_iter=max_iter,
            tol=tol,
            patience=patience,
            first_damping=_DAMPING,
        ).x[0]

    c, known = c0[free], deviation is not None
    if deviation is None:
        deviation = _remaining(all_errors(start, 1.0 / total), total)
    for n_round in range(_ROUNDS):
        first, before, weight = n_round == 0, deviation, 1.0 / deviation
        c = minimise(c, weight, n_round, rough=first)
        errors = all_errors(model_of(c), weight)
        if known:
            break
        deviation = _remaining(errors, total)
        if left < 1:
            break
        if not first and np.abs(deviation / before - 1.0).max() <= _SETTLED:
            break
    return Refined(
        replace(model_of(c), bases=bases),
        told,
        free,
        deviation,
        [found for _, found in errors],
        prior,
        costs,
        n_iter=max_iter - left,
    )


def _sizes(records: Sequence[Record]) -> Array:
    """Root mean squares of the outputs, 1 for none."""
    total = _rms([record.y for record in records])
    return np.where(total > 0, total, 1.0)


def _remaining(found: Sequence[tuple[Array, Array]], sizes: Array) -> Array:
    """Standard deviations of errors, which are rounding at least."""
    return np.maximum(_rms([errors for errors, _ in found]), _EXACT * sizes)


def _rms(signals: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.vstack(signals) ** 2, axis=0)))


def _rotated(G: Array, size: float) -> Array:
    """J of residuals ``(size, 0, ..., 0)`` from the Gram matrix of residuals and J."""
    along = G[0, 1:] / size if size > 0 else np.zeros(len(G) - 1)
    H = G[1:, 1:] - np.outer(along, along)
    scale = column_scale(np.diag(np.sqrt(np.maximum(np.diag(G)[1:], 0.0))))
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale)
    across = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale
    return np.vstack([along, across])


def with_rate_terms(model: LPVStateSpace) -> tuple[LPVStateSpace, Flags]:
    """The model with rate terms that are zero yet, and which of these are to stay so.

    Rows of A that the parameters do not change are kinematics, without such terms.
    """
    grid, n = grid_over(model.scheduling_range, _RATE_DEGREE + 1), model.order
    theta = model.parameters(grid[:1])[0]
    kinematic = (model.structure.jacobian(theta)[:, :n, :n] == 0).all(axis=(0, 2))
    entries = np.tile(np.repeat(kinematic, n), model.n_scheduling)
    terms = PolynomialLPV(_RATE_DEGREE).fit(grid, np.zeros((len(grid), len(entries))))
    n_terms = len(terms.coefficients()) // len(entries)
    return replace(model, rate_terms=terms), np.tile(entries, n_terms)


def refine_with_rates(
    start: LPVStateSpace,
    records: Sequence[Record],
    own: Own,
    prior: Prior | None,
    *,
    rate: bool | str,
    groups: Sequence[int],
    **options: Any,
) -> Refined:
    """`refine` with rate terms: True, False, or "auto", where they prove their worth.

    Every second piece of the records tells of terms that were fitted to the others:
    how strongly these are to be drawn to zero, and whether they lower the errors at
    all. A single experiment (`groups` of the records) cannot tell that: what it says
    of one direction need not be true of the other. Rate terms change A, and a model
    without states has none.
    """
    alone = rate == "auto" and len(set(groups)) < 2
    none = rate is False or alone or start.order == 0
    if none or start.rate_terms is not None:
        return refine(start, records, own, prior, **options)
    c0, (moving, kinematic) = coefficients_of(start), with_rate_terms(start)
    fixed = np.concatenate([np.zeros(len(c0), bool), kinematic])
    known = Prior(c0, np.zeros((len(c0),) * 2)) if prior is None else prior
    pieces = [piece for r in records for piece in _pieces(r, start.order)]
    seen, unseen = pieces[::2], pieces[1::2] or pieces
    there = own._replace(initial_state=True)
    static = refine(start, seen, there, prior, **options)
    rough = options | {"fixed": fixed, "deviation": static.deviation}

    def loss(model: LPVStateSpace) -> float:
        return squares(model, unseen, there, 1.0 / static.deviation)

    def length(records: Sequence[Record]) -> int:
        return sum(len(r.u) for r in records)

    moving = replace(static.model, rate_terms=moving.rate_terms)
    at_zero = refine(moving, seen, there, **rough | {"max_iter": 0})
    told = np.zeros(len(fixed))  # by the pieces, of every coefficient alone
    told[~fixed] = np.diag(at_zero.information)
    tried = []
    for share in _SHRINKAGE:
        drawn = share * told[len(c0) :]
        moving = refine(moving, seen, there, known.widened(drawn), **rough).model
        tried.append((loss(moving), drawn, moving))
        if tried[-1][0] > tried[-2:][0][0]:  # and weaker ones are worse
            break
    least, drawn, moving = min(tried, key=lambda one: one[0])
    if rate == "auto" and not least < (1.0 - _WORTH) * loss(static.model):
        return refine(start, records, own, prior, **options)
    if not np.isfinite(least):  # all of them diverge on other pieces
        moving = with_rate_terms(start)[0]
    drawn = drawn * (length(records) / length(seen))
    return refine(moving, records, own, known.widened(drawn), fixed=fixed, **options)


def _pieces(record: Record, order: int) -> list[Record]:
    """Parts of a record, of which each tells its initial state."""
    n = int(np.clip(len(record.u) // (_PIECE * max(order, 1)), 1, _PIECES))
    parts = (np.array_split(x, n) for x in (record.u, record.y, record.kappa))
    return [Record(u, y, kappa, record.dt) for u, y, kappa in zip(*parts, strict=True)]


def squares(
    model: LPVStateSpace, records: Sequence[Record], own: Own, weight: Array
) -> float:
    """Sum of the weighted squares of the errors; infinite where there are none."""
    try:
        errors = [simulated(model, record, own, weight)[0] for record in records]
    except ValueError:  # it diverges, or has no matrices there
        return np.inf
    with np.errstate(over="ignore"):  # it nearly diverges
        return float(sum(np.sum((error * weight) ** 2) for error in errors))


def local_prior(
    model: LPVStateSpace,
    kappa: Array,
    theta: Array,
    groups: Sequence[Sequence[Record]],
    own: Own,
) -> Prior:
    """What experiments at operating points tell of the coefficients of a model.

    That of the parameters `theta` (n_points, n_params) of the points' own models, from
    the derivatives of their simulations, carried to the coefficients. Where the form
    misses the parameters by more than they are uncertain, divided by the mean square
    of that.
    """
    form, every = model.interpolator, np.ones(theta.shape[1], bool)
    missed, slopes = model.parameters(kappa) - theta, form.sensitivities(kappa)
    rows, errors = [], []
    for k, records in enumerate(groups):
        if not records:  # it tells nothing
            continue
        constant = PolynomialLPV(0).fit(kappa[[k]], theta[[k]])
        quiet = model.silenced()
        local = replace(quiet, interpolator=constant, bases=(), covariance=None)
        found = [simulated(local, record, own) for record in records]
        weight = 1.0 / _remaining(found, _sizes(records))
        H = sum(
            _gram(local, record, own, weight, every, *parts)[1:, 1:]
            for record, parts in zip(records, found, strict=True)
        )
        values, vectors = np.linalg.eigh(H)
        known = values > RCOND * values[-1]  # but for changes of the state basis
        root = np.sqrt(values[known])[:, None] * vectors[:, known].T
        rows.append(root @ slopes[k])
        errors.append(root @ missed[k])
    if not rows:
        n_coefficients = len(form.coefficients())
        return Prior(form.coefficients(), np.zeros((n_coefficients,) * 2))
    R, e = np.vstack(rows), np.concatenate(errors)
    inflation = 1.0 if is_chance(e @ e, len(e)) else e @ e / len(e)
    return Prior(form.coefficients(), R.T @ R / inflation)
