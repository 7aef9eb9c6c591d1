"""B, D and initial states by least squares on the simulation error.

With A and C given, the simulated outputs ``y = C (z I - A)^-1 (x0 + B u) + D u`` are
linear in the rest of the model. The regressors of all samples are combinations of a
few section signals (see `signals`), so that the triangular factor of these signals,
computed once, stands for the samples: the regressions here have as many rows as there
are signals, for each output. The derivative of the simulation error with respect to
all parameters, which `refinement` takes its steps by, is a regression on the same
signals and on second responses. The unknowns of an experiment (its initial state, a
constant and a drift of every output) are projected out before experiments are pooled.

The parameters of a model in section form are one vector: B (state-major), the free
entries of D, the blocks of A (row-major) and C, as in the columns of the Jacobian.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...systems.least_squares import RCOND, column_scale, scaled_lstsq, thin_svd
from ...systems.simulation import (
    estimate_initial_state,
    free_responses,
    input_responses,
    lti_response,
)
from ..samples.hankel import triangularize
from ..samples.records import Record
from .signals import (
    Layout,
    Pairs,
    Places,
    SharedSignals,
    block_sections,
    block_slices,
    section_states,
    signal_factors,
    state_coefficients,
)

Array = NDArray[np.float64]

_TOGETHER = 4096  # rows of regressions that are kept before they are factored

# Places of experiments, and their regressions (n_experiments, n_rows, n_columns).
Regressions = tuple[Places, Array]


class Freedom(NamedTuple):
    """Which parameters are free besides A, B and C."""

    direct: NDArray[np.bool_]  # (n_outputs, n_inputs): entries of D; others are zero
    initial_states: bool = True  # False starts every experiment from rest
    n_trend: int = 0  # 1: a constant of every output and experiment, 2: and a drift

    def n_states(self, order: int) -> int:
        """Number of entries of an initial state that are unknown."""
        return order if self.initial_states else 0

    def n_own(self, order: int) -> int:
        """Number of unknowns of one experiment: initial state, then its trends.

        These are constants of all outputs, then drifts of all of them.
        """
        return self.n_states(order) + self.n_trend * len(self.direct)

    def own_parts(self, own: Array, order: int) -> tuple[Array, Array]:
        """Initial states and trends of (n_experiments, n_own) own unknowns."""
        k, n = len(own), self.n_states(order)
        states = own[:, :n] if n else np.zeros((k, order))
        return states, own[:, n:].reshape(k, self.n_trend, len(self.direct))

    def n_linear(self, order: int) -> int:
        """Number of unknowns that outputs are linear in: the own ones, B and D."""
        n_d, m = np.count_nonzero(self.direct), self.direct.shape[1]
        return self.n_own(order) + order * m + n_d


class Realization(NamedTuple):
    """A discrete-time model with the initial states of its experiments."""

    A: Array
    B: Array
    C: Array
    D: Array
    initial_states: Array  # (n_experiments, order)
    loss: float  # sum of squared simulation errors; infinite where they overflow
    rank_deficit: int = 0  # directions of B and D that the data leave undetermined
    blocks: tuple[Array, ...] | None = None  # of A, where it is in section form
    trends: Array = np.zeros((0, 0, 0))  # (n_experiments, n_trend, n_outputs)

    def of_channels(self, inputs: Array, outputs: Array) -> Realization:
        """The dynamics in other channels: inputs ``inputs @ u``, outputs times these.

        Initial states, trends and the loss stay those of the records as they were.
        """
        return self._replace(
            B=self.B @ inputs,
            C=outputs[:, None] * self.C,
            D=outputs[:, None] * self.D @ inputs,
        )

    def outputs(self, record: Record, experiment: int) -> Array:
        """Simulated outputs (n_samples, n_outputs) of a record, its trends included."""
        x0 = self.initial_states[experiment]
        if self.blocks is None:
            fitted = lti_response(self.A, self.B, self.C, self.D, record.u.T, x0)
        else:
            added = np.column_stack([x0, self.B @ record.u[:, :-1]])
            states = section_states(self.blocks, added)
            fitted = (self.C @ states + self.D @ record.u).T
        if len(record.trend):
            fitted += record.trend.T @ self.trends[experiment]
        return fitted


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    """The state matrix of the blocks.

    `scipy.linalg.block_diag` checks and promotes every block: 37 us instead of 6 for
    three blocks, a twentieth of a fit that tries many orders.
    """
    n = sum(len(block) for block in blocks)
    A = np.zeros((n, n))
    for block, part in zip(blocks, block_slices(blocks), strict=True):
        A[part, part] = block
    return A


def in_sections(model: Realization) -> Realization:
    """The same model in section form, or as it is where there is none."""
    if model.blocks is not None:
        return model
    sections = block_sections(model.A)
    if sections is None:
        return model
    blocks, T = sections
    return model._replace(
        A=_block_diagonal(blocks),
        B=linalg.solve(T, model.B),
        C=model.C @ T,
        initial_states=linalg.solve(T, model.initial_states.T).T,
        blocks=blocks,
    )


def parameter_slices(model: Realization, free: Freedom) -> list[slice]:
    """Where the entries of every block of A stand among the parameters."""
    assert model.blocks is not None
    sizes = [block.size for block in model.blocks]
    first = model.B.size + int(np.count_nonzero(free.direct))
    starts = accumulate(sizes, initial=first)
    return [slice(a, a + size) for a, size in zip(starts, sizes, strict=False)]


def moved_model(model: Realization, change: Array, free: Freedom) -> Realization:
    """The model after a change of its parameters; what else it tells is not updated.

    Own unknowns may stand before the parameters, as in `linearised`: they are ignored.
    """
    assert model.blocks is not None
    n_b, n_d, n_c = model.B.size, np.count_nonzero(free.direct), model.C.size
    n_a = sum(block.size for block in model.blocks)
    change = change[len(change) - (n_b + n_d + n_a + n_c) :]
    D = model.D.copy()
    D[free.direct] += change[n_b : n_b + n_d]
    blocks = tuple(
        block + change[part].reshape(block.shape)
        for block, part in zip(model.blocks, parameter_slices(model, free), strict=True)
    )
    return model._replace(
        A=_block_diagonal(blocks),
        B=model.B + change[:n_b].reshape(model.B.shape),
        C=model.C + change[len(change) - n_c :].reshape(model.C.shape),
        D=D,
        blocks=blocks,
    )


def change_between(start: Realization, end: Realization, free: Freedom) -> Array:
    """The change of the parameters that leads from one model to another."""
    assert start.blocks is not None and end.blocks is not None
    changes = [new - old for new, old in zip(end.blocks, start.blocks, strict=True)]
    return np.concatenate(
        [
            (end.B - start.B).ravel(),
            (end.D - start.D)[free.direct],
            *(change.ravel() for change in changes),
            (end.C - start.C).ravel(),
        ]
    )


def simulation_fit(
    A: Array, C: Array, records: Sequence[Record], free: Freedom
) -> Realization:
    """B, D and initial states that minimise the simulation error.

    In section form where there is one, else in the coordinates given. Verhaegen and
    Verdult, *Filtering and System Identification*, 2007, Section 9.2.4.
    """
    sections = block_sections(A)
    if sections is not None:
        return block_fit(sections.blocks, C @ sections.transform, records, free)
    with np.errstate(over="ignore", invalid="ignore"):
        found = [_general_regression(A, C, r, free) for r in records]
    if not all(np.isfinite(M).all() for M in found):
        return _overflowing(A, C, records)
    regressions = [(np.array([i]), M[None]) for i, M in enumerate(found)]
    return _realization(A, C, regressions, free, None)


def block_fit(
    blocks: tuple[Array, ...], C: Array, records: Sequence[Record], free: Freedom
) -> Realization:
    """As `simulation_fit`, for a state matrix in section form."""
    A = _block_diagonal(blocks)
    regressions = []
    for where, R in signal_factors(blocks, records):
        if R is None:
            return _overflowing(A, C, records)
        regressions.append((where, linear_regression(R, blocks, C, free)))
    return _realization(A, C, regressions, free, blocks)


def simulation_errors(model: Realization, records: Sequence[Record]) -> list[Array]:
    """What is left of the outputs of every experiment, (n_samples, n_outputs) each."""
    with np.errstate(over="ignore", invalid="ignore"):
        return [
            record.y.T - model.outputs(record, k) for k, record in enumerate(records)
        ]


def with_initial_states(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    weight: Array | None = None,
) -> Realization:
    """The model with the own unknowns that fit records best, and its loss on them.

    `weight` (n_outputs, n_outputs) is that of the errors of which the unknowns make the
    least, not of the loss.
    """
    W, n = np.eye(len(model.C)) if weight is None else weight, len(model.A)
    own = np.zeros((len(records), free.n_own(n)))
    states, trends = free.own_parts(own, n)
    model = model._replace(initial_states=states, trends=trends)
    errors = simulation_errors(model, records)
    if not all(np.isfinite(error).all() for error in errors):
        return model._replace(loss=np.inf)
    if own.size:
        for i, (record, error) in enumerate(zip(records, errors, strict=True)):
            responses = free_responses(model.A, W @ model.C, len(error), record.trend)
            responses = responses[:, :, n - free.n_states(n) :]
            own[i] = estimate_initial_state(responses, error @ W.T)
            errors[i] = error - np.linalg.solve(W, (responses @ own[i]).T).T
        states, trends = free.own_parts(own, n)
        trends = trends @ np.linalg.inv(W).T
        model = model._replace(initial_states=states, trends=trends)
    return model._replace(loss=sum(float((error**2).sum()) for error in errors))


def _general_regression(A: Array, C: Array, record: Record, free: Freedom) -> Array:
    """As `linear_regression` for any A: slower, but free of any transformation."""
    u, y, (ny, n) = record.u.T, record.y.T, C.shape
    own = free_responses(A, C, len(u), record.trend)[:, :, n - free.n_states(n) :]
    by_B = input_responses(A, C, u).reshape(len(u), ny, -1)
    by_D = np.einsum("ac,tj->tacj", np.eye(ny), u)[:, :, free.direct]
    M = np.concatenate([own, by_B, by_D, y[:, :, None]], axis=2)
    return np.vstack([triangularize(part.copy()) for part in M.transpose(1, 2, 0)])


def _realization(
    A: Array,
    C: Array,
    regressions: Sequence[Regressions],
    free: Freedom,
    blocks: tuple[Array, ...] | None,
) -> Realization:
    n, m = len(A), free.direct.shape[1]
    common, own, loss, deficit = _solve_regressions(regressions, free.n_own(n))
    states, trends = free.own_parts(own, n)
    D = np.zeros(free.direct.shape)
    D[free.direct] = common[n * m :]
    B = common[: n * m].reshape(n, m)
    return Realization(A, B, C, D, states, loss, deficit, blocks, trends)


def _overflowing(A: Array, C: Array, records: Sequence[Record]) -> Realization:
    m, (ny, n) = len(records[0].u), C.shape
    zero = np.zeros((n, m)), np.zeros((ny, m)), np.zeros((len(records), n))
    trends = np.zeros((len(records), len(records[0].trend), ny))
    return Realization(A, zero[0], C, zero[1], zero[2], np.inf, trends=trends)


def _solve_regressions(
    regressions: Sequence[Regressions], n: int
) -> tuple[Array, Array, float, int]:
    """Common unknowns, own ones (n_experiments, n), loss and rank deficit.

    The first `n` columns of a regression belong to the own unknowns of its experiment,
    the last is the right-hand side. The deficit is that of the common unknowns.
    """
    n_experiments = sum(len(where) for where, _ in regressions)
    if n_experiments == 1:
        M, rhs = regressions[0][1][0, :, :-1], regressions[0][1][0, :, -1]
        solution, rank = scaled_lstsq(M, rhs)
        if rank == M.shape[1]:
            left = M @ solution - rhs
            return solution[n:], solution[None, :n], float(left @ left), 0
    parts: list[Array] = []
    for _, several in regressions:
        _pool(parts, several, n)
    stacked = _joined(parts)
    common, rank = scaled_lstsq(stacked[:, :-1], stacked[:, -1])
    loss = float(np.sum((stacked[:, :-1] @ common - stacked[:, -1]) ** 2))
    own = np.empty((n_experiments, n))
    for where, several in regressions:
        for i, M in zip(where, several, strict=True):
            own[i] = scaled_lstsq(M[:, :n], M[:, -1] - M[:, n:-1] @ common)[0]
    return common, own, loss, len(common) - rank


def _pool(parts: list[Array], several: Array, n: int) -> None:
    """Add regressions to `parts` of one, their first `n` unknowns projected out.

    Of many rows only the triangular factor is kept.
    """
    rest = project_out(several, n)
    parts.append(rest.reshape(-1, rest.shape[-1]))
    if len(parts) > 1 and sum(map(len, parts)) > _TOGETHER:
        parts[:] = [_joined(parts)]


def _joined(parts: Sequence[Array]) -> Array:
    """One regression of all parts."""
    return parts[0] if len(parts) == 1 else triangularize(np.vstack(parts).T)


def project_out(M: Array, n: int) -> Array:
    """The columns after the first `n`, without what the first `n` explain.

    Of one regression, or of several (n_experiments, n_rows, n_columns).
    """
    if n == 0:
        return M
    own, rest = M[..., :n], M[..., n:]
    scaled = own / column_scale(own)[..., None, :]
    left, s, _ = thin_svd(scaled)
    kept = s > RCOND * s.max(axis=-1, initial=0.0, keepdims=True)
    explained = left * kept[..., None, :]
    return rest - explained @ (explained.swapaxes(-1, -2) @ rest)


def linear_regression(
    R: Array, blocks: tuple[Array, ...], C: Array, free: Freedom
) -> Array:
    """Regression of the outputs on own unknowns, B and D, with A and C given.

    `R` (..., k, n_signals) comes from `signal_factors`. Rows: outputs times k; columns:
    own unknowns (`Freedom.n_own`), B (state-major), free entries of D, output.
    """
    (ny, n), m = C.shape, free.direct.shape[1]
    rows = R.reshape(-1, R.shape[-1])
    out = np.zeros((ny, len(rows), free.n_linear(n) + 1))
    _fill_linear(out, rows, Pairs.of(blocks), C, free)
    out[:, :, -1] = rows[:, Layout.of(n, m, ny).outputs].T
    return _by_experiment(out, R.shape[:-1])


def _by_experiment(out: Array, shape: tuple[int, ...]) -> Array:
    """From (n_outputs, n_rows, n_columns), rows those of `shape` (..., k)."""
    ny, _, columns = out.shape
    split = out.reshape(ny, -1, shape[-1], columns).swapaxes(0, 1)
    return split.reshape(*shape[:-1], ny * shape[-1], columns)


def jacobian_regression(
    R: Array, model: Realization, driven: Array, free: Freedom
) -> Array:
    """Regression of the simulation error on changes of all parameters.

    `R` (..., k, n_signals) comes from `signal_factors`, with second responses of the
    model, in section form, with ``driven = [x0, B]``, (..., order, 1 + n_inputs). Rows:
    outputs times k; columns: own unknowns, then the parameters, then the simulation
    error, trends not taken off.
    """
    blocks, C, D = model.blocks, model.C, model.D
    assert blocks is not None
    (ny, n), m, shape = C.shape, D.shape[1], R.shape[:-1]
    column, at = free.n_linear(n), Layout.of(n, m, ny, second=True)
    size_a = sum(block.size for block in blocks)
    R = R.reshape(-1, R.shape[-1])
    k, n_experiments = len(R), int(np.prod(shape[:-1]))
    driven = driven.reshape(n_experiments, n, 1 + m)
    each = n_experiments, shape[-1]
    out = np.zeros((ny, k, column + size_a + ny * n + 1))
    pairs = Pairs.of(blocks)
    _fill_linear(out, R, pairs, C, free)
    second = R[:, at.second]
    # Entry (p, q) of a block drives state p with state q.
    start, N = pairs
    for i in range(start):
        out[:, :, column + i] = C[:, [i]] * second[:, i]
    own = driven[:, start:].reshape(n_experiments, len(N), 2, 1 + m)
    own = own.transpose(1, 0, 3, 2)
    answer = second[:, start:].reshape(k, len(N), 2)
    answer = answer.swapaxes(0, 1)
    signals = R[:, at.sections].reshape(*each, n, 1 + m)
    late = signals[:, :, start + 1 :: 2].transpose(2, 0, 1, 3) @ own
    first = answer @ N.swapaxes(1, 2) + late.reshape(answer.shape)
    seen = C[:, start:].reshape(ny, -1, 2).swapaxes(0, 1)  # (n_pairs, n_outputs, 2)
    effect = seen[:, :, None, :, None] * first[:, None, :, None]
    effect += (seen @ N)[:, :, None, :, None] * answer[:, None, :, None]
    entries = out[:, :, column + start : column + size_a]
    entries[:] = effect.transpose(1, 2, 0, 3, 4).reshape(entries.shape)
    column += size_a
    coefficients = state_coefficients(blocks, driven).swapaxes(1, 2)
    states = (signals.reshape(*each, n * (1 + m)) @ coefficients).reshape(k, n)
    for i in range(ny):
        out[i, :, column + i * n : column + (i + 1) * n] = states
    fitted = states @ C.T + R[:, at.inputs] @ D.T
    out[:, :, -1] = (R[:, at.outputs] - fitted).T
    return _by_experiment(out, shape)


def linearised(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    *,
    keep_one: bool = False,
    signals: SharedSignals | None = None,
) -> Array | None:
    """Simulation error of all experiments, linearised at a model in section form.

    A regression as `jacobian_regression`, but without the own unknowns, which are
    projected out; with `keep_one` the initial state of a single experiment without
    trends stays, where it costs less. None where responses overflow. `signals` are
    those of other records with this model and inputs.
    """
    assert model.blocks is not None
    factors = signal_factors if signals is None else signals.factors
    n, m = model.B.shape
    driven = np.empty((len(records), n, 1 + m))
    driven[:, :, 0], driven[:, :, 1:] = model.initial_states, model.B
    parts: list[Array] = []
    for where, R in factors(model.blocks, records, driven):
        if R is None:
            return None
        several = jacobian_regression(R, model, driven[where], free)
        if keep_one and len(records) == 1 and not free.n_trend:
            return several[0]
        _pool(parts, several, free.n_own(len(model.A)))
    return _joined(parts)


def _fill_linear(out: Array, R: Array, pairs: Pairs, C: Array, free: Freedom) -> None:
    """Fill in the effects of own unknowns, B and the free entries of D."""
    (ny, n), m, k = C.shape, free.direct.shape[1], len(R)
    own, n_states, at = free.n_own(n), free.n_states(n), Layout.of(n, m, ny)
    by_state = R[:, at.sections].reshape(k, n, 1 + m)
    signals = by_state.swapaxes(1, 2).reshape(k * (1 + m), n)
    coefficients = _output_coefficients(pairs, C).reshape(n, ny * n)
    effect = (signals @ coefficients).reshape(k, 1 + m, ny, n).transpose(2, 0, 3, 1)
    out[:, :, :n_states] = effect[:, :, :n_states, 0]
    if free.n_trend:
        trends = R[:, R.shape[1] - free.n_trend :]
        for i in range(ny):
            out[i, :, n_states + i : own : ny] = trends
    out[:, :, own : own + n * m] = effect[..., 1:].reshape(ny, k, n * m)
    where = zip(*free.direct.nonzero(), strict=True)
    for column, (i, j) in enumerate(where, start=own + n * m):
        out[i, :, column] = R[:, at.inputs.start + j]


def _output_coefficients(pairs: Pairs, C: Array) -> Array:
    """Outputs of every section, in terms of its signals: (order, n_outputs, order).

    ``c x = sum_i coefficient[i, j] b[j] signal[i]`` for a state driven through ``b``:
    rows ``c`` for ``d`` and ``c N`` for ``g``; block diagonal.
    """
    ny, n = C.shape
    out = np.zeros((n, ny, n))
    start, N = pairs
    turned = C[:, start:].reshape(ny, -1, 2).swapaxes(0, 1) @ N
    for i in range(start):
        out[i, :, i] = C[:, i]
    for k, i in enumerate(range(start, n, 2)):
        out[i, :, i : i + 2] = C[:, i : i + 2]
        out[i + 1, :, i : i + 2] = turned[k]
    return out
