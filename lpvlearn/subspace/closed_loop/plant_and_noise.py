r"""Plant and noise in one innovation form: told apart, and what is known of the plant.

In modal coordinates A is block diagonal. A mode of the noise alone is one that the
inputs do not reach: its rows b of B are zero but for chance, by Wald's statistic
``b^T Sigma_b^{-1} b``, with the covariance Sigma of the parameters p of the predictor.

That no input reaches the noise then tells of the plant too. For the parts of B of the
noise, ``b(p) = 0`` with first-order changes G, and the parameters of the plant,
``theta(p)`` with first-order changes J,

.. math:: \theta - J \Sigma G^T (G \Sigma G^T)^{-1} b, \qquad
    J \Sigma J^T - J \Sigma G^T (G \Sigma G^T)^{-1} G \Sigma J^T

are estimate and covariance given that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models.innovation import NoiseModel, prediction_responses
from ...systems.least_squares import scaled_lstsq
from ...systems.modes import spectral_radius
from ...systems.simulation import input_responses
from ..evidence.statistics import Evidence
from ..orders.identification import REFITS
from ..samples.records import Record, ScaledRecords, share_known
from ..simulation_error.simulation_fit import Freedom, Realization, with_initial_states
from .predictor import (
    Innovation,
    Predictor,
    innovation_root,
    prediction_errors,
    refine_predictor,
)

Array = NDArray[np.float64]

_MAX_CONDITION = 1e8  # of the modes, beyond which they are not told apart


class _Knowledge(NamedTuple):
    """Covariance of B, D, A and C of the plant, given that no input reaches the noise.

    `shift` is what that moves these by.
    """

    plant: Array
    shift: Array


def _knowledge(
    fitted: Predictor,
    joint: Innovation,
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

    joint: Innovation  # block diagonal: the plant, and what no input reaches
    transform: Array  # from the states of the predictor to these
    kept: NDArray[np.bool_]  # which states are the plant's
    fitted: Predictor | None  # None where it does not minimise the prediction error

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
        A, B, C, D, *_ = refine_predictor(self.joint, records, self.free, REFITS)[1]
        states = np.zeros((len(records), len(A)))
        return Realization(A, B, C, D, states, np.inf)

    def start(
        self, scaled: ScaledRecords, free: Freedom
    ) -> tuple[Innovation, NDArray[np.bool_]] | None:
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


class _Split(NamedTuple):
    """Modes of a model, and which of them are the plant's."""

    transform: Array
    kept: NDArray[np.bool_]
    by_inputs: ByInputs | None = None  # in these coordinates, of a given order


class ByInputs(NamedTuple):
    r"""Errors of prediction as B and D make them, given A, C and K.

    Whitened, they are ``e_0 + X [vec B; D]``; of ``[X e_0]`` a triangular factor tells
    all. Unlike Wald's statistic that is exact: of two poles that nearly coincide the
    large rows of B, opposite to each other, are uncertain, though neither may go.
    """

    model: Innovation
    factor: Array
    direct: NDArray[np.bool_]

    @classmethod
    def of(
        cls, model: Innovation, records: Sequence[Record], free: Freedom
    ) -> ByInputs:
        """Those of a model, whatever its own B and D."""
        A, B, C, D, K, covariance = model
        n, outputs = len(A), np.eye(len(C))
        energy = np.mean(np.hstack([record.y for record in records]) ** 2, axis=1)
        weight = np.linalg.inv(innovation_root(covariance, energy))
        none = model._replace(B=np.zeros_like(B), D=np.zeros_like(D))
        factor = np.zeros((0, B.size + int(free.direct.sum()) + 1))
        errors = prediction_errors(none, records, free)[1]
        for record, e in zip(records, errors, strict=True):
            u = record.u.T
            by_B = -input_responses(A - K @ C, C, u)
            by_D = -np.einsum("ac,tj->tacj", outputs, u)
            by_D -= np.einsum("ic,taij->tacj", K, by_B)
            X = by_B.reshape(*e.shape, -1), by_D[:, :, free.direct], e[:, :, None]
            X = (weight @ np.concatenate(X, axis=2)).reshape(e.size, -1)
            own = prediction_responses(A, C, K, len(u), record.trend)
            own = (weight @ own[:, :, n - free.n_states(n) :]).reshape(e.size, -1)
            if own.size:
                X = X - own @ scaled_lstsq(own, X)[0]
            factor = np.asarray(np.linalg.qr(np.vstack([factor, X]), mode="r"))
        return cls(model, factor, free.direct)

    def reaching(self, kept: NDArray[np.bool_]) -> tuple[float, Innovation]:
        """Squared errors and model if the inputs reach these states alone."""
        n_direct = int(self.direct.sum())
        B, D = np.zeros_like(self.model.B), self.model.D.copy()
        free = np.append(np.repeat(kept, B.shape[1]), np.ones(n_direct, bool))
        X, e = self.factor[:, :-1][:, free], self.factor[:, -1]
        found = scaled_lstsq(X, -e)[0]
        by_B, D[self.direct] = np.split(found, [len(found) - n_direct])
        B[kept] = by_B.reshape(-1, B.shape[1])
        return float(np.sum((e + X @ found) ** 2)), self.model._replace(B=B, D=D)


def split_modes(
    joint: Innovation,
    fitted: Predictor | None,
    order: int | None,
    records: Sequence[Record],
    free: Freedom,
    n: int,
) -> _Split | None:
    """Tell the plant's modes from those of the noise, which no input reaches.

    A mode is the plant's where its rows of B speak for themselves, by Schwarz's
    criterion; of a given order those are that the errors can least do without, one
    after another. None where no such modes add up to it, or others speak as well.
    """
    whole = _Split(np.eye(len(joint.A)), np.ones(len(joint.A), dtype=bool))
    if len(joint.A) in (0, order) or (order is None and fitted is None):
        return whole
    T, modes = _modes(joint.A)
    if not np.linalg.cond(T) < _MAX_CONDITION:
        return whole if order is None else None
    modal, limit = joint.transformed(T), joint.B.shape[1] * np.log(n)
    reached = np.zeros(len(modes))
    if fitted is not None:
        reached = _reached(modal, T, modes, fitted)
    if order is None:
        kept = np.zeros(len(T), dtype=bool)
        for k in np.flatnonzero(reached > limit):
            kept |= modes[k]
        return _Split(T, kept)
    kept, by_inputs = whole.kept.copy(), ByInputs.of(modal, records, free)
    while kept.sum() > order:
        fewer = [kept & ~mode for mode in modes if kept[mode].all()]
        kept = min(fewer, key=lambda some: by_inputs.reaching(some)[0])
    speak = [
        r > limit and not kept[m].all() for r, m in zip(reached, modes, strict=True)
    ]
    if any(speak) or kept.sum() < order:
        return None
    return _Split(T, kept, by_inputs)


def without_reached_noise(
    joint: Innovation,
    fitted: Predictor,
    transform: Array,
    kept: NDArray[np.bool_],
    direct: NDArray[np.bool_],
) -> list[Innovation]:
    """Models given that no input reaches the noise: to first order, and as it is.

    The former where it is stable. Where outputs are of unequal quality, or poles nearly
    coincide, the first order may be worse than none.
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
    modal: Innovation,
    transform: Array,
    modes: Sequence[NDArray[np.bool_]],
    fitted: Predictor,
) -> Array:
    """How clearly the inputs reach every mode, for each of its states.

    Wald's statistic of its rows of B.
    """
    covariance = fitted.parameter_covariance(modal.covariance)
    changes = fitted.jacobian(len(covariance)).transformed(transform)
    values = []
    for mode in modes:
        J = changes.of_part(modal, mode).B.reshape(len(covariance), -1)
        b, spread = modal.B[mode].ravel(), J.T @ covariance @ J
        values.append(float(b @ np.linalg.pinv(spread, hermitian=True) @ b))
    sizes = [mode.sum() for mode in modes]
    return np.array(values) / sizes
