r"""Predictor-based subspace identification (PBSID_opt): consistent under feedback.

The innovation form ``x[t+1] = A x[t] + B u[t] + K e[t]``,
``y[t] = C x[t] + D u[t] + e[t]`` is written as its predictor, which is stable even
where the plant is not. With ``A_K = A - K C``, ``B_K = [B - K D, K]`` and the samples
``z[t] = [u[t]; y[t]]``,

.. math::

    x_t = \sum_{l=1}^{p} A_K^{l-1} B_K z_{t-l} + A_K^p x_{t-p}, \qquad
    y_t = C x_t + D u_t + e_t .

No future input stands in these equations, so that feedback from y to u does not
correlate the regressors with the innovation. Three least squares follow, all of them
in the triangular factor of the Hankel matrix with rows ``z[t-p], ..., z[t]``:

1. The VARX of `varx` gives the Markov parameters ``M_l = C A_K^(l-1) B_K``.
2. Their shifts give the future window of the predictor,
   ``Gamma K_p = [M_{l+i}]`` for rows ``i < p`` and columns ``l <= p``, where
   ``A_K^p = 0``. Singular values of ``(I x S^{-1/2}) Gamma K_p Z_p`` (S the
   innovation covariance, Z_p the past samples) tell the order and the states.
3. The states of ``t`` and ``t + 1`` give C and D, then A, B and K, for every order
   from the one factor.

A finite past is a bias where modes are slow and the noise is that of the sensors, since
``A - K C`` is then as slow as A. The refinement takes it away: it minimises the
prediction error, which is the simulation error of the predictor, driven by z.

The states are those of plant and noise together. A mode of the noise alone is one that
the inputs do not reach, and is told from the others by the covariance of its part of B.

A constant of the outputs (and a drift) is one of their prediction, but for a free
response of the predictor: it is projected out of the Hankel matrix and is an unknown of
the refinement, as in open loop.

Every step is invariant to other units, and to an invertible mixing, of inputs and of
outputs. Where D is free, ``u[t]`` is a regressor of ``y[t]``. That is right as long as
the controller needs at least one sample to answer: one that answers within the sample
and a feedthrough form an algebraic loop, of which second moments do not tell the parts.

References
----------
A. Chiuso, "The role of vector autoregressive modeling in predictor-based subspace
identification", Automatica 43, 2007.

G. van der Veen, J.-W. van Wingerden, M. Bergamasco, M. Lovera and M. Verhaegen,
"Closed-loop subspace identification methods: an overview", IET Control Theory and
Applications 7, 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...models.innovation import (
    NoiseModel,
    prediction_responses,
)
from ...systems.innovations import kalman_filter
from ...systems.least_squares import scaled_lstsq, thin_svd
from ...systems.modes import spectral_radius
from ...systems.simulation import estimate_initial_state, state_trajectory
from ..evidence.statistics import Evidence, parameter_covariance
from ..orders.identification import REFITS, STABLE_MARGIN, Settings
from ..orders.realization import reflect_unstable
from ..orders.selection import PlantFit, Row, Selection
from ..samples.hankel import hankel_factor
from ..samples.records import Record, ScaledRecords, output_energy, share_known, shorten
from ..simulation_error.criterion import PRICE
from ..simulation_error.noise import Whitening
from ..simulation_error.refinement import refine_simulation
from ..simulation_error.simulation_fit import (
    Freedom,
    Realization,
    moved_model,
    simulation_fit,
    with_initial_states,
)
from .varx import NO_INNOVATION, longest_past, n_windows, past_window, samples_of

Array = NDArray[np.float64]

_MOST_ROWS = 400  # of the longest past window: its Cholesky factor costs some 10 ms

_MAX_ORDER = 20  # of plant and noise together, where it is chosen

# Part of an output's energy added to the innovation covariance before its inverse root
# weights the outputs, so that data without noise have one.
_WEIGHT_FLOOR = 1e-12

# Part of the mean state noise added to each state where the gain must come from the
# Riccati equation, so that no mode on the unit circle is free of noise.
_RICCATI_FLOOR = 1e-9

_MAX_CONDITION = 1e8  # of the modes, beyond which they are not told apart


class _Subspace(NamedTuple):
    """What models of every order need of the data."""

    factor: Array  # (r, r), lower triangular, of ``z[t-past], ..., z[t]``
    states: Array  # rows that turn a past window into states, most important first
    singular_values: Array  # (past * n_outputs,), descending
    direct: NDArray[np.bool_]  # free entries of D
    n_columns: int
    past: int


class _Innovation(NamedTuple):
    """``x[t+1] = A x[t] + B u[t] + K e[t]``, ``y[t] = C x[t] + D u[t] + e[t]``."""

    A: Array  # may be unstable; ``A - K C`` is stable
    B: Array
    C: Array
    D: Array
    K: Array
    covariance: Array  # of the innovations e

    def transformed(self, T: Array) -> _Innovation:
        """In the coordinates x' of ``x = T x'``."""
        A, B, K = (linalg.solve(T, part) for part in (self.A @ T, self.B, self.K))
        return self._replace(A=A, B=B, C=self.C @ T, K=K)

    def rescaled(self, u: Array, y: Array) -> _Innovation:
        """Of inputs and outputs divided by these numbers."""
        return _Innovation(
            self.A,
            self.B * u,
            self.C / y[:, None],
            self.D * u / y[:, None],
            self.K * y,
            self.covariance / np.outer(y, y),
        )


class _Changes(NamedTuple):
    """Stacks of changes of an innovation form."""

    A: Array
    B: Array
    C: Array
    D: Array

    def transformed(self, T: Array) -> _Changes:
        """As `_Innovation.transformed`."""
        inverse = linalg.inv(T)
        return _Changes(inverse @ self.A @ T, inverse @ self.B, self.C @ T, self.D)

    def of_part(self, model: _Innovation, part: NDArray[np.bool_]) -> _Changes:
        """Changes of a part of a block-diagonal model, for which it stays that.

        The part and the rest remain invariant subspaces: the off-diagonal blocks X of
        the change of basis solve Sylvester equations.
        """
        rest = ~part
        ahead = _sylvester(model.A, rest, part, self.A)
        back = _sylvester(model.A, part, rest, self.A)
        changes = _Changes(
            self.A[:, part][:, :, part],
            self.B[:, part] - back @ model.B[rest],
            self.C[:, :, part] + model.C[:, rest] @ ahead,
            self.D,
        )
        return changes._settled(model.A[part][:, part], model.B[part], model.C[:, part])

    def _settled(self, A: Array, B: Array, C: Array) -> _Changes:
        """The same changes in a basis of which A and C change the least.

        What the data do not tell of the basis would otherwise blur B.
        """
        (ny, n), k = C.shape, len(self.A)
        eye = np.eye(n)
        system = np.vstack([np.kron(A, eye) - np.kron(eye, A.T), np.kron(C, eye)])
        target = np.hstack([self.A.reshape(k, n * n), self.C.reshape(k, ny * n)])
        X = -(target @ np.linalg.pinv(system).T).reshape(k, n, n)
        return _Changes(self.A + A @ X - X @ A, self.B - X @ B, self.C + C @ X, self.D)


def _sylvester(
    A: Array, rows: NDArray[np.bool_], columns: NDArray[np.bool_], change: Array
) -> Array:
    """X of ``A_r X - X A_c = -change_rc`` for a stack of changes."""
    left, right = A[rows][:, rows], A[columns][:, columns]
    system = np.kron(left, np.eye(len(right))) - np.kron(np.eye(len(left)), right.T)
    wanted = -change[:, rows][:, :, columns]
    solution = np.linalg.solve(system, wanted.reshape(len(change), -1).T)
    return np.asarray(solution.T.reshape(wanted.shape))


class _Predictor(NamedTuple):
    """The predictor as a model driven by ``[u; y]``, its outputs made white."""

    model: Realization
    records: list[Record]
    free: Freedom
    root: Array  # lower triangular: outputs are ``root`` times those of the model
    share: float  # samples in `records` by all samples that were used

    def innovation(self, model: Realization, covariance: Array) -> _Innovation:
        """The innovation form of this predictor, or of one that was moved."""
        m = model.B.shape[1] - len(self.root)
        B, K = np.hsplit(model.B, [m])
        C, D = self.root @ model.C, self.root @ model.D[:, :m]
        return _Innovation(model.A + K @ C, B + K @ D, C, D, K, covariance)

    def parameter_covariance(self, covariance: Array) -> Array:
        """Of the parameters of the predictor, whose errors are white."""
        half = linalg.solve_triangular(self.root, covariance, lower=True)
        white = linalg.solve_triangular(self.root, half.T, lower=True)
        noise = NoiseModel.white(white)
        known = parameter_covariance(self.model, self.records, self.free, noise)
        return known * self.share

    def jacobian(self, n_parameters: int) -> _Changes:
        """Changes of the innovation form with the parameters.

        Exact: it is of second degree in them, where a central difference of any step
        is the derivative.
        """
        changes = []
        for step in np.eye(n_parameters):
            ahead, back = (
                self.innovation(moved_model(self.model, half, self.free), step)
                for half in (0.5 * step, -0.5 * step)
            )
            changes.append([a - b for a, b in zip(ahead[:4], back[:4], strict=True)])
        return _Changes(*(np.array(part) for part in zip(*changes, strict=True)))


class _Knowledge(NamedTuple):
    """Covariance of B, D, A and C of the plant, given that no input reaches the noise.

    `shift` is what that moves these by.
    """

    plant: Array
    shift: Array


def _knowledge(
    fitted: _Predictor,
    joint: _Innovation,
    transform: Array,
    kept: NDArray[np.bool_],
    direct: NDArray[np.bool_],
) -> _Knowledge:
    """What the data tell of a plant; `joint` is in the coordinates `transform`."""
    covariance = fitted.parameter_covariance(joint.covariance)
    changes = fitted.jacobian(len(covariance)).transformed(transform)
    part = changes.of_part(joint, kept)
    flat = [x.reshape(len(x), -1) for x in (part.B, part.A, part.C)]
    J = np.hstack([flat[0], part.D[:, direct], *flat[1:]])
    unreached = changes.of_part(joint, ~kept).B.reshape(len(J), -1)
    spread = unreached.T @ covariance @ unreached
    gain = np.linalg.pinv(spread, hermitian=True) @ (unreached.T @ covariance @ J)
    J = J - unreached @ gain
    return _Knowledge(J.T @ covariance @ J, -joint.B[~kept].ravel() @ gain)


@dataclass(frozen=True, eq=False, kw_only=True)
class ClosedLoopEvidence(Evidence):
    """A plant with the predictor that it is a part of."""

    joint: _Innovation  # block diagonal: the plant, and what no input reaches
    transform: Array  # from the states of the predictor to these
    kept: NDArray[np.bool_]  # which states are the plant's
    fitted: _Predictor | None  # None where it does not minimise the prediction error

    @cached_property
    def noise(self) -> NoiseModel:
        """What no input reaches, in the scale of the records."""
        other, joint = ~self.kept, self.joint
        A = joint.A[other][:, other]
        return NoiseModel(A, joint.C[:, other], joint.K[other], joint.covariance)

    @cached_property
    def sections(self) -> Realization:
        """The plant as one section, of which derivatives may move every entry."""
        A = self.model.A
        return self.model._replace(blocks=(A,) if len(A) else ())

    @cached_property
    def covariance(self) -> Array:
        """Of B, D, A and C of the plant, where it is known."""
        if self.fitted is None:
            raise ValueError(
                "The covariance is that of a model at a minimum of the prediction "
                "error, which this one is not: its order is not that of the modes "
                "that inputs reach, it was not refined, or poles coincide. Use "
                "refine='auto' and another `order`."
            )
        direct = self.free.direct
        if not (len(self.joint.A) or direct.any()):
            return np.zeros((0, 0))  # no parameters
        known = _knowledge(self.fitted, self.joint, self.transform, self.kept, direct)
        # What is expected of missing outputs adds to what is known, and has no noise.
        return known.plant / share_known(self.records) ** 2

    def of_others(self, records: Sequence[Record]) -> Realization:
        """The model, noise included, that other records would have given.

        By few steps from this one: to be simulated through records held out.
        """
        A, B, C, D, *_ = _refined(self.joint, records, self.free, REFITS)[1]
        states = np.zeros((len(records), len(A)))
        return Realization(A, B, C, D, states, np.inf)

    def start(
        self, scaled: ScaledRecords, free: Freedom
    ) -> tuple[_Innovation, NDArray[np.bool_]] | None:
        """Where models of the same samples may begin, if these have other trends.

        And which of its states are the plant's.
        """
        others = free.n_trend != self.free.n_trend
        if not others or (free.direct != self.free.direct).any():
            return None
        ratios = scaled.input_scale / self.input_scale
        sizes = scaled.output_scale / self.output_scale
        return self.joint.rescaled(ratios, sizes), self.kept

    @cached_property
    def one_step(self) -> Evidence:
        """The predictor as a model driven by inputs and outputs, with its errors."""
        A, B, C, D, K, _ = self.joint
        ny, inner = len(C), A - K @ C
        B, D = np.hstack([B - K @ D, K]), np.hstack([D, np.zeros((ny, ny))])
        direct = np.hstack([self.free.direct, np.zeros((ny, ny), dtype=bool)])
        free = self.free._replace(direct=direct)
        records = [r._replace(u=np.vstack((r.u, r.y))) for r in self.records]
        start = Realization(inner, B, C, D, np.zeros((len(records), len(A))), np.inf)
        levels = self.levels
        if levels is not None:
            # What a constant of the outputs is in their errors of prediction.
            predicted = C @ np.linalg.pinv(np.eye(len(A)) - inner) @ K
            levels = levels - levels @ predicted.T
        return Evidence(
            with_initial_states(start, records, free),
            records,
            np.concatenate([self.input_scale, self.output_scale]),
            self.output_scale,
            np.eye(B.shape[1]),
            free,
            self.whitening,
            False,
            self.share,
            levels,
        )

    def _gain(self) -> Array:
        return self.joint.K[self.kept]


def identify_closed_loop(
    scaled: ScaledRecords,
    basis: Array,
    order: int | None,
    horizon: int | None,
    settings: Settings,
    like: Evidence | None = None,
) -> PlantFit:
    """Identify a plant that may stand in a feedback loop.

    Order and states of plant and noise together follow from one VARX. As many states
    make the prediction error the likelihood, which is maximised; of them those are the
    plant's that the inputs reach. Where these do not add up to a given order, the model
    is that of so many states of the subspace, not refined: the prediction error of so
    few would trade the plant for the noise.

    A model `like` it, of the same samples with other trends, is begun from as well:
    where trends are further parameters, it can only be likelier with them.

    Poles that `enforce_stability` refuses are reflected into the unit circle, and B
    and D minimise the simulation error. `basis` is that of the `Evidence`.
    """
    records, free = scaled.records, settings.free
    wanted = (order or 0) + settings.n_noise_states
    subspace = _predictor_subspace(records, wanted, free.direct, horizon)
    left = _errors_by_order(subspace, max(wanted, _MAX_ORDER))
    criteria = _criteria(left, subspace)
    free_order = order is None or (settings.refine and settings.n_noise_states == 0)
    n_joint = max(wanted, int(np.argmin(criteria))) if free_order else wanted
    start = None
    if isinstance(like, ClosedLoopEvidence):
        start = like.start(scaled, free)
    together = _fit_together(subspace, records, order, n_joint, settings, start)
    fitted, joint, transform, kept = together
    own, errors = _predicted(joint, records, free)
    states, trends = free.own_parts(own, len(joint.A))
    loss = sum(float(np.sum(e**2)) for e in errors)
    A, B, C = joint.A[kept][:, kept], joint.B[kept], joint.C[:, kept]
    plant = Realization(A, B, C, joint.D, states[:, kept], loss, trends=trends)
    energy, stability_loss = output_energy(records) or 1.0, 0.0
    residual = float(np.sqrt(loss / energy))
    heads, share = shorten(records)
    none = Whitening.none(len(free.direct))
    known = heads, scaled.input_scale, scaled.output_scale, basis, free, none
    evidence: Evidence
    limit = 1.0 - STABLE_MARGIN if settings.enforce_stability else np.inf
    stable_A = reflect_unstable(A, limit)
    if stable_A is A:
        evidence = ClosedLoopEvidence(
            plant,
            *known,
            fitted is not None,
            share,
            joint=joint,
            transform=transform,
            kept=kept,
            fitted=fitted,
        )
    else:
        plant = simulation_fit(stable_A, C, records, free)
        stability_loss = float(np.sqrt(plant.loss / energy)) - residual
        residual += stability_loss
        evidence = Evidence(plant, *known, False, share)
    sizes = [float(np.linalg.norm(e)) / np.sqrt(len(e)) for e in left]
    excess = (criteria - criteria.min()).tolist()
    tried = [
        Row(n, subspace.past, size, value, np.nan)
        for n, (size, value) in enumerate(zip(sizes, excess, strict=True))
        if order in (None, n)
    ]
    chosen = Selection(len(A), subspace.past, tried)
    return PlantFit(
        evidence, chosen, subspace.singular_values, residual, stability_loss
    )


# A model, and the predictor that it belongs to: None where it was not refined
_Found = tuple[_Predictor | None, _Innovation]


class _Together(NamedTuple):
    """Plant and noise."""

    fitted: _Predictor | None  # None where it is not at a minimum
    joint: _Innovation  # block diagonal
    transform: Array  # from the states of `fitted` to these
    kept: NDArray[np.bool_]  # which states are the plant's


def _fit_together(
    subspace: _Subspace,
    records: Sequence[Record],
    order: int | None,
    n_joint: int,
    settings: Settings,
    start: tuple[_Innovation, NDArray[np.bool_]] | None,
) -> _Together:
    """Plant and noise of `n_joint` states or more, told apart.

    `order` is that of the plant. States of the noise that the subspace does not show
    would be taken from those of a given one. Where what is refined from a `start` is
    not told apart, that is as it was.
    """
    free = settings.free
    found: list[_Found] = [(None, _innovation_form(subspace, n_joint))]
    if settings.refine:
        first = _refined(found[0][1], records, free)
        found = [first]
        if order is None or not settings.n_noise_states:
            more = _with_more_states(*first, subspace, records, free)
            found = [more] if order is None or more[1] is first[1] else [more, first]
    together = _told_apart(found, records, order, subspace, free)
    if together is None:
        fitted, joint = found[-1]
        if order is not None and order != len(joint.A):
            joint, fitted = _innovation_form(subspace, order), None
        whole = np.ones(len(joint.A), dtype=bool)
        together = _Together(fitted, joint, np.eye(len(whole)), whole)
    if start is None or not settings.refine:
        return together
    joint, kept = start
    near = [_refined(joint, records, free)]
    other = _told_apart(near, records, order, subspace, free)
    if other is None:
        if order not in (None, int(kept.sum())):
            return together
        joint = _likeliest([joint], records, free)
        other = _Together(None, joint, np.eye(len(kept)), kept)
    # at the price by which models with and without trends are compared
    costs = [_cost(m.joint, subspace, records, PRICE) for m in (together, other)]
    return other if costs[1] < costs[0] else together


def _told_apart(
    found: Sequence[_Found],
    records: Sequence[Record],
    order: int | None,
    subspace: _Subspace,
    free: Freedom,
) -> _Together | None:
    """Plant and noise of the first of these models that tells them apart."""
    n = subspace.n_columns
    for fitted, joint in found:
        split = _split(joint, fitted, order, n)
        if split is None:
            continue
        T, kept = split
        apart = joint.transformed(T)
        if fitted is None or kept.all():
            return _Together(fitted, apart, T, kept)
        models = _without_reached_noise(apart, fitted, T, kept, free.direct)
        apart, fewer = _likeliest(models, records, free), int((~kept).sum())
        if order is not None or _as_likely(apart, joint, fewer, records, n):
            return _Together(fitted, apart, T, kept)
    return None


def _with_more_states(
    fitted: _Predictor | None,
    joint: _Innovation,
    subspace: _Subspace,
    records: Sequence[Record],
    free: Freedom,
) -> _Found:
    """The refined model, or one of more states, while these are worth it.

    Of modes that are slow beside the past window the subspace tells little: what it
    leaves of the outputs without them is no more than with them. Schwarz's criterion,
    as the refined models have as many states as they can use.
    """
    highest = min(_MAX_ORDER, len(subspace.states))
    price = float(np.log(subspace.n_columns))

    @cache
    def refined(order: int) -> _Found:
        return _refined(_innovation_form(subspace, order), records, free)

    def criterion(model: _Found) -> float:
        return _cost(model[1], subspace, records, price)

    best = fitted, joint
    while True:
        order = len(best[1].A)  # a mode is one state or two
        further = map(refined, range(order + 1, min(order + 2, highest) + 1))
        others = [model for model in further if model[0] is not None]
        least = min([best, *others], key=criterion)
        if least is best:
            return best
        best = least


def _cost(
    model: _Innovation, subspace: _Subspace, records: Sequence[Record], price: float
) -> float:
    """Criterion per sample of a model, by the price of a parameter."""
    (ny, m), n = subspace.direct.shape, subspace.n_columns
    parameters = len(model.A) * (m + 2 * ny)
    return _volume(model.covariance, records) + price * parameters / n


def _volume(covariance: Array, records: Sequence[Record]) -> float:
    """Logarithm of the determinant of innovations, rounding allowed for."""
    floor = NO_INNOVATION * np.mean(np.hstack([r.y for r in records]) ** 2, axis=1)
    return float(np.linalg.slogdet(covariance + np.diag(floor))[1])


def _likeliest(
    models: Sequence[_Innovation], records: Sequence[Record], free: Freedom
) -> _Innovation:
    """The model of least errors, with the covariance of these."""
    found = []
    for model in models:
        errors = np.vstack(_predicted(model, records, free)[1])
        covariance = errors.T @ errors / len(errors)
        found.append(model._replace(covariance=covariance))
    return min(found, key=lambda model: _volume(model.covariance, records))


def _as_likely(
    model: _Innovation,
    whole: _Innovation,
    n_fewer: int,
    records: Sequence[Record],
    n: int,
) -> bool:
    """Whether a model without B of so many states is worth what it loses.

    By Schwarz's criterion, as Wald's statistic has said of the whole model: which is to
    be trusted where the likelihood is as quadratic as it takes it for.
    """
    loss = _volume(model.covariance, records) - _volume(whole.covariance, records)
    return bool(loss < n_fewer * model.B.shape[1] * np.log(n) / n)


def _predictor_subspace(
    records: Sequence[Record],
    highest_order: int,
    direct: NDArray[np.bool_],
    past: int | None,
) -> _Subspace:
    """VARX and predictor subspace of several experiments, once for all orders.

    A `ValueError` where the samples do not carry the order or the past window.
    """
    ny, m = direct.shape
    c = m + ny
    # Fewer samples of the past than this cannot tell so many states apart.
    shortest = max(1, -(-highest_order // ny))
    if past is None:
        longest = max(shortest, longest_past(records, _MOST_ROWS))
        acting = np.asarray(direct.any(axis=0))
        if n_windows(records, longest) > (longest + 1) * c:
            past = past_window(records, shortest, longest, acting)
        else:
            past = longest
    elif past < shortest:
        raise ValueError(
            f"`horizon` must be at least {shortest} for order {highest_order} and "
            f"{ny} output(s) with method='pbsid'. Got {past}."
        )
    n_columns = n_windows(records, past)
    if n_columns <= (past + 1) * c:
        n_samples = sum(record.n_samples for record in records)
        raise ValueError(
            f"method='pbsid' needs more than {(past + 1) * c} windows of {past} past "
            f"samples ({m} input(s), {ny} output(s)). Got {n_columns} in {n_samples} "
            "samples: lower `order` or `horizon`, or take a longer record."
        )
    rows = np.arange((past + 1) * c)
    n_trend = len(records[0].trend)
    factor = hankel_factor(samples_of(records), past + 1, rows, n_trend=n_trend)
    Z, U, Y = factor[: past * c], factor[past * c : past * c + m], factor[-ny:]
    markov, D = _output_regression(Z, U, Y, direct)
    residual = Y - markov @ Z - D @ U
    root = _root(residual @ residual.T / n_columns, np.sum(Y**2, axis=1) / n_columns)
    weighted = linalg.solve_triangular(root, markov, lower=True)
    shifted = np.zeros((past * ny, past * c))
    for i in range(past):
        shifted[i * ny : (i + 1) * ny, i * c :] = weighted[:, : (past - i) * c]
    left, s, _ = thin_svd(shifted @ Z[:, : past * c])
    values = np.maximum(s, np.finfo(float).eps * s[0]) if s[0] else np.ones_like(s)
    states = (left / np.sqrt(values)).T @ shifted
    return _Subspace(factor, states, s / np.sqrt(n_columns), direct, n_columns, past)


def _root(covariance: Array, energy: Array) -> Array:
    """Lower triangular root of a covariance, outputs without noise allowed for."""
    floor = _WEIGHT_FLOOR * energy
    floor[floor == 0.0] = 1.0
    return linalg.cholesky(covariance + np.diag(floor), lower=True)


def _innovation_form(subspace: _Subspace, order: int) -> _Innovation:
    """Innovation form of one order, of plant and noise together.

    With states ``X`` and ``X+`` one sample later, ``[C D]`` regresses Y on ``[X; U]``,
    and ``[A B K]`` regresses ``X+`` on ``[X; U; E]`` with E what the first left. Where
    that K does not make ``A - K C`` stable (few samples), it is the gain of the
    Riccati equation of the same second moments.
    """
    factor, n = subspace.factor, subspace.n_columns
    ny, m = subspace.direct.shape
    c = m + ny
    T = subspace.states[:order]
    X, ahead = T @ factor[:-c], T @ factor[c:]
    U, Y = factor[-c:-ny], factor[-ny:]
    C, D = _output_regression(X, U, Y, subspace.direct)
    E = Y - C @ X - D @ U
    parts = np.zeros((order, order + c))
    if order:
        parts = scaled_lstsq(np.vstack([X, U, E]).T, ahead.T)[0].T
    A, B, K = np.split(parts, [order, order + m], axis=1)
    if not spectral_radius(A - K @ C) < 1.0:
        K = _riccati_gain(A, C, ahead - A @ X - B @ U, E, n)
    return _Innovation(A, B, C, D, K, E @ E.T / n)


def _errors_by_order(subspace: _Subspace, highest: int) -> list[Array]:
    """What the states of every order leave of the outputs, these scaled to one."""
    ny, m = subspace.direct.shape
    Z, U, Y = np.split(subspace.factor, [-m - ny, -ny])
    size = np.linalg.norm(Y, axis=1, keepdims=True)
    Y = Y / np.where(size > 0.0, size, 1.0)
    errors = []
    for order in range(min(highest, len(subspace.states)) + 1):
        X = subspace.states[:order] @ Z
        C, D = _output_regression(X, U, Y, subspace.direct)
        errors.append(Y - C @ X - D @ U)
    return errors


def _criteria(errors: Sequence[Array], subspace: _Subspace) -> Array:
    """Criterion of Hannan and Quinn of every order of plant and noise, per sample.

    ``log det S + 2 n_parameters log log n / n``, S the moments of what an order leaves,
    and ``order (n_inputs + 2 n_outputs)`` parameters besides D. A state too few spoils
    the plant, one too many costs little, whence no heavier penalty; it finds the order
    in the long run.
    """
    n, (ny, m) = subspace.n_columns, subspace.direct.shape
    floor = NO_INNOVATION * np.eye(ny)
    each = 2.0 * (m + 2 * ny) * np.log(np.log(max(n, 3)))
    volumes = [np.linalg.slogdet(E @ E.T + floor)[1] for E in errors]
    least = ny * np.log(NO_INNOVATION)  # but for rounding
    return np.maximum(volumes, least) + each / n * np.arange(len(errors))


def _refined(
    model: _Innovation,
    records: Sequence[Record],
    free: Freedom,
    max_iter: int | None = None,
) -> _Found:
    r"""Minimise the one-step prediction error, weighted by the innovation covariance.

    The predictor ``x[t+1] = A_K x[t] + B_K z[t]``, ``y[t] = C x[t] + D u[t] + e[t]``
    is a stable model without noise states, driven by ``z = [u; y]``: its simulation
    error is the prediction error. `refine_simulation` therefore minimises
    ``sum_t e[t]^T S^{-1} e[t]`` over A_K, B_K, C, D and the initial states. A trend of
    the outputs is one of their prediction, but for a free response.
    """
    A, B, C, D, K, covariance = model
    ny = len(C)
    if (free.direct != free.direct[0]).any():
        # Mixed outputs would not keep the zeros of D.
        covariance = np.diag(np.diagonal(covariance))
    n_samples = sum(record.n_samples for record in records)
    energy = np.array([np.sum(r.y**2, axis=1) for r in records]).sum(axis=0)
    root = _root(covariance, energy / n_samples)
    driven = [
        r._replace(
            u=np.vstack((r.u, r.y)), y=linalg.solve_triangular(root, r.y, lower=True)
        )
        for r in records
    ]
    allowed = np.hstack([free.direct, np.zeros((ny, ny), dtype=bool)])
    predictor = free._replace(direct=allowed)
    weighted = linalg.solve_triangular(root, C, lower=True)
    start = simulation_fit(A - K @ C, weighted, driven, predictor)
    found = refine_simulation(start, driven, predictor, max_iter)
    heads, share = shorten(driven)
    fitted = _Predictor(found, heads, predictor, root, share)
    joint = fitted.innovation(found, covariance)
    errors = np.vstack(_predicted(joint, records, free)[1])
    joint = joint._replace(covariance=errors.T @ errors / n_samples)
    return None if found.blocks is None else fitted, joint


def _predicted(
    model: _Innovation, records: Sequence[Record], free: Freedom
) -> tuple[Array, list[Array]]:
    """Own unknowns of the experiments, of weighted least squares, and what they leave.

    That are the errors of prediction.
    """
    A, B, C, D, K, covariance = model
    n = len(A)
    energy = np.mean(np.hstack([record.y for record in records]) ** 2, axis=1)
    weight = linalg.inv(_root(covariance, energy))
    own, errors = np.zeros((len(records), free.n_own(n))), []
    for unknowns, record in zip(own, records, strict=True):
        u, y = record.u.T, record.y.T
        driven = u @ (B - K @ D).T + y @ K.T
        with np.errstate(over="ignore", invalid="ignore"):  # of models on the way
            error = y - state_trajectory(A - K @ C, driven) @ C.T - u @ D.T
        if own.size:
            with np.errstate(over="ignore", invalid="ignore"):
                responses = prediction_responses(A, C, K, len(y), record.trend)
            responses = responses[:, :, n - free.n_states(n) :]
            weighted = weight @ responses, error @ weight.T
            unknowns[:] = estimate_initial_state(*weighted)
            error = error - responses @ unknowns
        errors.append(error)
    return own, errors


class _Split(NamedTuple):
    """Modes of a model, and which of them are the plant's."""

    transform: Array
    kept: NDArray[np.bool_]


def _split(
    joint: _Innovation, fitted: _Predictor | None, order: int | None, n: int
) -> _Split | None:
    """Tell the plant's modes from those of the noise, which no input reaches.

    A mode is the plant's where its rows of B speak for themselves, by Schwarz's
    criterion. None where no such modes add up to a given order.
    """
    whole = _Split(np.eye(len(joint.A)), np.ones(len(joint.A), dtype=bool))
    if len(joint.A) in (0, order) or (order is None and fitted is None):
        return whole
    T, modes = _modes(joint.A)
    if not np.linalg.cond(T) < _MAX_CONDITION:
        return whole if order is None else None
    modal = joint.transformed(T)
    reached = _reached(modal, T, modes, fitted)
    kept = np.zeros(len(T), dtype=bool)
    limit = joint.B.shape[1] * np.log(n)
    for k in np.argsort(reached)[::-1]:
        if order is None:
            fits = reached[k] > limit
        else:
            fits = kept.sum() + modes[k].sum() <= order
        if fits:
            kept |= modes[k]
        elif reached[k] > limit:
            return None  # the inputs reach more modes than wanted
    return _Split(T, kept) if order in (None, kept.sum()) else None


def _without_reached_noise(
    joint: _Innovation,
    fitted: _Predictor,
    transform: Array,
    kept: NDArray[np.bool_],
    direct: NDArray[np.bool_],
) -> list[_Innovation]:
    """Models given that no input reaches the noise: to first order, and as it is.

    The former where it is stable. Where outputs are of unequal quality, the first order
    may be worse than none.
    """
    shift = _knowledge(fitted, joint, transform, kept, direct).shift
    n, (ny, m) = int(kept.sum()), direct.shape
    A, B, C, D = (M.copy() for M in joint[:4])
    B[~kept] = 0.0
    as_it_is = joint._replace(B=B.copy())
    ends = np.cumsum([n * m, direct.sum(), n * n])
    by_B, by_D, by_A, by_C = np.split(shift, ends)
    B[kept] += by_B.reshape(n, m)
    D[direct] += by_D
    A[np.ix_(kept, kept)] += by_A.reshape(n, n)
    C[:, kept] += by_C.reshape(ny, n)
    moved = joint._replace(A=A, B=B, C=C, D=D)
    stable = spectral_radius(A - joint.K @ C) < 1.0
    return [moved, as_it_is] if stable else [as_it_is]


def _modes(A: Array) -> tuple[Array, list[NDArray[np.bool_]]]:
    """Real modal coordinates, and the states of every real pole or complex pair."""
    poles, vectors = np.linalg.eig(A)
    columns: list[Array] = []
    modes = []
    for pole, vector in zip(poles, vectors.T, strict=True):
        if pole.imag >= 0.0:
            new = [vector.real, vector.imag] if pole.imag else [vector.real]
            at = np.arange(len(A))
            modes.append((at >= len(columns)) & (at < len(columns) + len(new)))
            columns += new
    return np.reshape(columns, A.shape).T, modes


def _reached(
    modal: _Innovation,
    transform: Array,
    modes: Sequence[NDArray[np.bool_]],
    fitted: _Predictor | None,
) -> list[float]:
    """How clearly the inputs reach every mode, for each of its states.

    Wald's statistic of its rows of B; without a covariance, what they move the outputs
    by.
    """
    if fitted is None:
        return [
            float(np.linalg.norm(modal.C[:, mode] @ modal.B[mode])) for mode in modes
        ]
    covariance = fitted.parameter_covariance(modal.covariance)
    changes = fitted.jacobian(len(covariance)).transformed(transform)
    values = []
    for mode in modes:
        J = changes.of_part(modal, mode).B.reshape(len(covariance), -1)
        b, spread = modal.B[mode].ravel(), J.T @ covariance @ J
        values.append(float(b @ np.linalg.pinv(spread, hermitian=True) @ b))
    return [value / mode.sum() for value, mode in zip(values, modes, strict=True)]


def _output_regression(
    X: Array, U: Array, Y: Array, direct: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Coefficients of Y in X, and in those inputs that D lets act at once."""
    C, D = np.zeros((len(Y), len(X))), np.zeros(direct.shape)
    # Outputs with the same free entries share their regressors.
    for mask in np.unique(direct, axis=0):
        outputs = np.flatnonzero((direct == mask).all(axis=1))
        solution = scaled_lstsq(np.vstack([X, U[mask]]).T, Y[outputs].T)[0].T
        C[outputs] = solution[:, : len(X)]
        D[np.ix_(outputs, np.flatnonzero(mask))] = solution[:, len(X) :]
    return C, D


def _riccati_gain(A: Array, C: Array, W: Array, E: Array, n_columns: int) -> Array:
    """Kalman gain from the residuals of the state and of the output equation."""
    Q, S, R = (M / n_columns for M in (W @ W.T, W @ E.T, E @ E.T))
    Q = Q + _RICCATI_FLOOR * np.trace(Q) / len(Q) * np.eye(len(Q))
    try:
        return kalman_filter(A, C, Q, S, R).gain
    except ValueError:  # of SciPy, in its own words
        raise ValueError(
            f"No predictor of {len(A)} states, of plant and noise together, is found "
            "for these samples: their outputs grow beyond what numbers resolve, or "
            "follow from fewer states. Use a lower `order` or method='po-moesp', or "
            "give samples before the outputs have grown."
        ) from None
