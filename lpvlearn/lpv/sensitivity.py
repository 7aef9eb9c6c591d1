"""Derivatives of the outputs of an LPV model by its coefficients.

Coefficients c of the interpolators make parameters ``theta(kappa, c)``, these matrices,
and these the recursion ``x[k+1] = Ad(kappa_k) x[k] + Bd(kappa_k) u[k]``. Its derivative
is the same recursion, for all coefficients at once,

    X[k+1] = Ad(kappa_k) X[k] + F[k] dtheta/dc(kappa_k),

where F[k] holds, for every parameter, the derivative of one step from x[k]. With the
direction E of a parameter and ``v = [x; u]`` that is the one of ``exp(M h) v``,

    sum_j A^j E sum_k h^(j+k+1) / (j+k+1)! M^k v,    M = [A, B; 0, 0],

a series on vectors, summed by Horner's rule; steps h are as short as it needs. Where
inputs go on linearly between samples, with the slope s, ``M v`` is ``[A x + B u; s]``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import factorial

from ..models.statespace import split_delay
from ..models.system_matrix import blocks
from ..systems.balancing import in_even_units
from ..systems.sampling import sample_foh, sample_zoh
from ..systems.simulation import delayed, state_trajectory
from ..systems.tabulation import tabulate
from .model import LPVStateSpace, rates_of_change

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_LONGEST = 2.0  # norm of A h in one step of the series: 22 terms, no digit cancels
_MOST_STEPS = 1000  # of the series in a sample: half a minute for 10,000 samples
_TRUNCATION = 1e-14  # of the series, relative to its first term

_ENTRIES = 1_000_000  # of the largest array of a block of samples: 8 MB
_FEWEST = 16  # samples of a block, however many coefficients there are

_LOOKED_AT = 200  # samples whose matrices choose the units of the states


def coefficients_of(model: LPVStateSpace) -> Array:
    """Coefficients of the interpolator, then of the rate terms."""
    parts = [p for p in (model.interpolator, model.rate_terms) if p is not None]
    return np.concatenate([part.coefficients() for part in parts])


def with_coefficients(model: LPVStateSpace, c: Array) -> LPVStateSpace:
    """The model with others, in the order of `coefficients_of`.

    Raises a ValueError where there is no such model.
    """
    size = len(model.interpolator.coefficients())
    rates = model.rate_terms
    return replace(
        model,
        interpolator=model.interpolator.with_coefficients(c[:size]),
        rate_terms=None if rates is None else rates.with_coefficients(c[size:]),
    )


def output_slopes(
    model: LPVStateSpace,
    u: Array,
    kappa: Array,
    dt: float,
    x0: Array,
    free: Flags,
) -> Iterator[tuple[slice, Array]]:
    """Derivatives of simulated outputs, a block of samples at a time.

    Parameters
    ----------
    model : LPVStateSpace
        In the state of its structure, silenced.
    u, kappa : ndarray of shape (n_samples, n_inputs) and (n_samples, n_scheduling)
    dt : float
        Seconds.
    x0 : ndarray of shape (order,)
        Initial state: where runs begin by themselves, and what is added to that, which
        the coefficients do not change.
    free : ndarray of bool, shape (n_coefficients,)
        Coefficients to differentiate by.

    Yields
    ------
    slice, ndarray of shape (n_block, n_outputs, order + n_free)
        Samples, and derivatives by the initial state and the free coefficients.
    """
    n, delay = model.order, split_delay(model.input_delay, dt)[0]
    u0, before = model.input_offset(kappa), model.beginning(u, kappa)[1]
    late = delayed(u, delay, np.repeat(before, delay))
    change = np.zeros_like(late)
    if model.hold == "foh":
        change[:-1] = np.diff(late, axis=0)
    late -= u0
    rates = rates_of_change(kappa, dt)
    unit = _units(model, kappa, rates)
    moved_by = _moving_entries(model, free)
    x, own = x0 / unit, np.diag(1.0 / unit)
    X = _slopes_of_beginning(model, before - u0[0], kappa[:1], unit, free, moved_by)
    size = max(_FEWEST, _ENTRIES // ((n + model.n_outputs) * (n + len(free))))
    for start in range(0, len(u), size):
        rows = slice(start, min(start + size, len(u)))
        A, B, C, E = _linearised(model, kappa[rows], rates[rows], unit, moved_by)
        offset = model.state_offset(kappa[rows]) / unit
        w, dw = late[rows], change[rows]
        n_steps = _steps_of(_norm(A) * dt)
        h = dt / n_steps
        in_step = _sampled(model.hold, A, B, h)
        Ad, *inputs = in_step if n_steps == 1 else _sampled(model.hold, A, B, dt)
        moved = _summed(inputs, (w, dw)) + offset - _times(Ad, offset)
        states = state_trajectory(Ad, moved, x)
        xi = states - offset
        direct = _directed(E[..., n:, :], np.concatenate([xi, w], axis=1))
        F = np.zeros((len(w), n, direct.shape[2]))
        dw = dw / n_steps
        for _ in range(n_steps):
            F = in_step[0] @ F + _step_slopes(A, B, E[..., :n, :], xi, (w, dw / h), h)
            xi = _summed(in_step, (xi, w, dw))
            w = w + dw
        F = np.concatenate([F, direct], axis=1)
        F = _by_coefficients(model, kappa[rows], rates[rows], F, free, moved_by)
        free_states = state_trajectory(Ad, np.zeros((len(w), n, n)), own)
        slopes = state_trajectory(Ad, F[:, :n], X)
        yield rows, np.concatenate([C @ free_states, C @ slopes + F[:, n:]], axis=2)
        x = Ad[-1] @ states[-1] + moved[-1]
        own = Ad[-1] @ free_states[-1]
        X = Ad[-1] @ slopes[-1] + F[-1, :n]


def _sampled(hold: str, A: Array, B: Array, dt: float) -> tuple[Array, ...]:
    """What the state, inputs and (with "foh") their changes make of the next state."""
    return sample_zoh(A, B, dt) if hold == "zoh" else sample_foh(A, B, dt)


def _summed(matrices: Sequence[Array], vectors: Sequence[Array]) -> Array:
    """The sum of their products; vectors that no matrix stands for are zero."""
    return np.asarray(sum(map(_times, matrices, vectors)))


def _times(M: Array, v: Array) -> Array:
    """Products of matrices (n_samples, n, k) with a vector (n_samples, k) each."""
    return np.asarray((M @ v[:, :, None])[:, :, 0])


def _slopes_of_beginning(
    model: LPVStateSpace,
    w: Array,
    kappa: Array,
    unit: Array,
    free: Flags,
    moved_by: NDArray[np.intp],
) -> Array:
    """Derivatives (order, n_free) of the state in which inputs `w` hold the model.

    ``A x + B w = 0``, ``A dx + dA x + dB w = 0``; in units of the states.
    """
    n, rates = model.order, np.zeros_like(kappa)
    if not w.any():
        return np.zeros((n, int(free.sum())))
    A, B, _, E = _linearised(model, kappa, rates, unit, moved_by)
    x = -np.linalg.solve(A[0], B[0] @ w)
    moved = _directed(E[..., :n, :], np.concatenate([x, w])[None])
    slopes = np.asarray(-np.linalg.solve(A, moved), dtype=float)
    return _by_coefficients(model, kappa, rates, slopes, free, moved_by)[0]


def _linearised(
    model: LPVStateSpace,
    kappa: Array,
    rates: Array,
    unit: Array,
    moved_by: NDArray[np.intp],
) -> tuple[Array, Array, Array, Array]:
    """A, B and C in units of the states, and the directions of S.

    Directions (..., n_directions, n + n_outputs, n + n_inputs): those of the
    parameters, and the entries of A that rate terms change.
    """
    structure, n, n_rates = model.structure, model.order, model.n_scheduling
    S = np.array(structure.system_matrix(model.parameters(kappa)))
    E = structure.basis
    if E is None:

        def jacobians(points: Array) -> Array:
            values = model.parameters(points.reshape(-1, n_rates))
            return np.array([structure.jacobian(row) for row in values])

        E = tabulate(jacobians, kappa[:, 0]) if n_rates == 1 else jacobians(kappa)
    if model.rate_terms is not None:
        S[:, :n, :n] += model.rate_part(kappa, rates)
        entries = np.zeros((len(moved_by), *S.shape[1:]))
        entries[np.arange(len(moved_by)), *np.divmod(moved_by, n)] = 1.0
        entries = np.broadcast_to(entries, (*E.shape[:-3], *entries.shape))
        E = np.concatenate([E, entries], axis=-3)
    rows = np.concatenate([unit, np.ones(structure.n_outputs)])[:, None]
    columns = np.concatenate([unit, np.ones(structure.n_inputs)])
    return *blocks(S / rows * columns, n)[:3], E / rows * columns


def _moving_entries(model: LPVStateSpace, free: Flags) -> NDArray[np.intp]:
    """Entries of A, row by row, of which a rate term is free.

    Only polynomials, whose coefficients are term by term, have some that are not.
    """
    if model.rate_terms is None:
        return np.arange(0)
    of_rates = free[len(model.interpolator.coefficients()) :]
    if of_rates.all():
        return np.arange(model.order**2)
    return np.flatnonzero(of_rates.reshape(-1, model.order**2).any(axis=0))


def _by_coefficients(
    model: LPVStateSpace,
    kappa: Array,
    rates: Array,
    slopes: Array,
    free: Flags,
    moved_by: NDArray[np.intp],
) -> Array:
    """Derivatives along the directions (last axis), carried to free coefficients."""
    n_params = model.structure.n_params
    parts = [model.interpolator.sensitivities(kappa, slopes[:, :, :n_params])]
    flags = [free[: parts[0].shape[2]]]
    if model.rate_terms is not None:
        moving = rates[:, None, :, None] * slopes[:, :, None, n_params:]
        moving = moving.reshape(*slopes.shape[:2], -1)
        parts.append(model.rate_terms.sensitivities(kappa, moving))
        own = free[len(flags[0]) :]
        if not own.all():
            own = own.reshape(-1, model.order**2)[:, moved_by].ravel()
        flags.append(own)
    kept = [
        part if some.all() else part[:, :, some]
        for part, some in zip(parts, flags, strict=True)
    ]
    return kept[0] if len(kept) == 1 else np.concatenate(kept, axis=2)


def _units(model: LPVStateSpace, kappa: Array, rates: Array) -> Array:
    """Units of the states in which rows and columns of A are alike."""
    some = slice(None, None, max(1, len(kappa) // _LOOKED_AT))
    A = model.structure.matrices(model.parameters(kappa[some]))[0]
    A = np.abs(A + model.rate_part(kappa[some], rates[some])).mean(axis=0)
    return in_even_units(A)[1]


def _norm(A: Array) -> float:
    return float(np.abs(A).sum(axis=-2).max(initial=0.0))


def _steps_of(norm: float) -> int:
    """Number of steps of the series in a sample, over which A has this norm."""
    if norm > _LONGEST * _MOST_STEPS:
        raise ValueError(
            f"`sampling_time` must be at most {_LONGEST * _MOST_STEPS:.0f} times as "
            "long as the fastest states of the model take: its derivatives would not "
            f"come to an end. Got {norm:.4g} times. Leave what is that fast out of the "
            "structure, as a feedthrough, or sample faster."
        )
    return max(1, int(np.ceil(norm / _LONGEST)))


def _directed(E: Array, v: Array) -> Array:
    """``E_p v`` for every direction p and sample, (n_samples, n_rows, n_directions)."""
    if E.ndim == 4:
        return np.einsum("kpij,kj->kip", E, v)
    n_directions, n_rows, width = E.shape
    flat = E.transpose(2, 1, 0).reshape(width, n_rows * n_directions)
    return (v @ flat).reshape(len(v), n_rows, n_directions)


def _step_slopes(
    A: Array, B: Array, E: Array, x: Array, inputs: tuple[Array, Array], h: float
) -> Array:
    """Derivatives of the state after h by the directions E, (n_samples, n, n_dir).

    `inputs` are their values and slopes at the beginning.
    """
    norm, order = _norm(A) * h, 2
    while norm**order / factorial(order) > _TRUNCATION:
        order += 1
    z, still = x, np.zeros_like(inputs[0])
    powers = []
    for u in (*inputs, *[still] * order)[:order]:  # M^k v
        powers.append(np.concatenate([z, u], axis=1))
        z = _times(A, z) + _times(B, u)
    stacked = np.array(powers)
    k = np.arange(1, order + 1)
    weight = h**k / factorial(k)
    F = _directed(E, weight[-1] * stacked[0])
    for j in range(order - 2, -1, -1):
        inner = np.tensordot(weight[j:], stacked[: order - j], 1)
        F = A @ F + _directed(E, inner)
    return F
