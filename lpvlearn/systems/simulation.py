"""Linear recursions without a Python loop per sample, and initial states.

The state recursion ``x[k+1] = A[k] x[k] + f[k]`` is a lower-triangular banded
system of linear equations in the stacked states, solved by one LAPACK call.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from .least_squares import scaled_lstsq

Array = NDArray[np.float64]

# Entries of the banded matrix that one solve may hold: 16 MB, which a long record
# may not exceed, and still 1,100 samples a solve for 30 states.
_CHUNK_ENTRIES = 2_000_000

# Runs that share a matrix for every sample, from which a product a sample is faster
# than the banded solve, run by run: for 6 states, 16 runs 2 times, 96 runs 15 times.
_MANY_RUNS = 12


def _band(A: Array, n_samples: int) -> Array:
    """Banded storage of the unit lower-triangular matrix of the recursion."""
    n = A.shape[-1]
    band = np.zeros((2 * n, n_samples * n), order="F")
    band[0] = 1.0
    stop = (n_samples - 1) * n
    for i in range(n):
        for j in range(n):
            entries = A[i, j] if A.ndim == 2 else A[: n_samples - 1, i, j]
            band[n + i - j, j:stop:n] = -entries
    return band


def state_trajectory(A: Array, f: Array, x0: Array | None = None) -> Array:
    """States ``x[0], ..., x[n_samples - 1]`` of ``x[k+1] = A[k] x[k] + f[k]``.

    `A` is one matrix (n, n) or one for every sample (n_samples, n, n); the forcing, and
    the result, (n_samples, n) or (n_samples, n, n_runs): several runs share `A`. `x0`
    is (n,) or (n, n_runs); None is the origin.
    """
    n_samples, n = f.shape[:2]
    if n == 0 or n_samples == 0:
        return np.zeros_like(f)
    runs = f.reshape(n_samples, n, -1)
    state = np.zeros(runs.shape[1:])
    if x0 is not None:
        state[:] = np.reshape(x0, (n, -1))
    out = np.empty_like(runs)
    if A.ndim == 3 and runs.shape[2] >= _MANY_RUNS:
        out[0], out[1:] = state, runs[:-1]
        for matrix, x, following in zip(A, out[:-1], out[1:], strict=False):
            following += matrix @ x
        return out.reshape(f.shape)
    size = max(2, min(n_samples, _CHUNK_ENTRIES // (2 * n * n)))
    band = None
    for start in range(0, n_samples, size):
        stop = min(start + size, n_samples)
        length = stop - start
        if A.ndim == 3:
            band = _band(A[start:stop], length)
        elif band is None or band.shape[1] != length * n:
            band = _band(A, length)
        rhs = np.empty((length, n, runs.shape[2]))
        rhs[0] = state
        rhs[1:] = runs[start : stop - 1]
        x, _ = lapack.dtbtrs(band, rhs.reshape(length * n, -1), uplo="L", diag="U")
        out[start:stop] = x.reshape(length, n, -1)
        last = A[stop - 1] if A.ndim == 3 else A
        state = last @ out[stop - 1] + runs[stop - 1]
    return out.reshape(f.shape)


def lti_response(
    A: Array, B: Array, C: Array, D: Array, u: Array, x0: Array | None = None
) -> Array:
    """Outputs ``C x[k] + D u[k]`` of ``x[k+1] = A x[k] + B u[k]``, one row a sample."""
    return state_trajectory(A, u @ B.T, x0) @ C.T + u @ D.T


def delayed(u: Array, delay: NDArray[np.intp], before: Array | None = None) -> Array:
    """Inputs as they arrive, ``u[t - delay[j], j]``; one row a sample, any runs.

    `before` are the inputs in transit at the start, in the order of their arrival, all
    of one input after another; None: none.

    >>> delayed(np.array([[1.0, 5.0], [2.0, 6.0]]), np.array([0, 1]))
    array([[1., 0.],
           [2., 5.]])
    """
    late = u.copy()
    stops = np.cumsum(delay)
    for j, (d, stop) in enumerate(zip(delay, stops, strict=True)):
        if d:
            late[d:, j] = u[: max(len(u) - d, 0), j]
            late[:d, j] = 0.0 if before is None else before[stop - d : stop][: len(u)]
    return late


def beside_transit(
    free: Array, A: Array, B: Array, C: Array, D: Array, delay: NDArray[np.intp]
) -> Array:
    """Free responses, with those to the inputs in transit after those to the states.

    `free` comes from `free_responses`, trends or not; inputs are in the order of
    `delayed`. A and B may be one for every sample.
    """
    n, n_late = C.shape[1], int(delay.sum())
    if not n_late:
        return free
    none = np.zeros((len(free), D.shape[1], n_late))
    late = delayed(none, delay, np.eye(n_late))
    transit = C @ state_trajectory(A, B @ late) + D @ late
    return np.concatenate([free[:, :, :n], transit, free[:, :, n:]], axis=2)


def trend_signals(n_samples: int, n_trend: int) -> Array:
    """A constant one (and a straight line from -1 to 1), (n_trend, n_samples).

    >>> trend_signals(3, 2)
    array([[ 1.,  1.,  1.],
           [-1.,  0.,  1.]])
    """
    t = np.linspace(-1.0, 1.0, n_samples)
    return t ** np.arange(n_trend)[:, None]


def free_responses(
    A: Array, C: Array, n_samples: int, trend: Array | None = None
) -> Array:
    """Outputs ``C A^k`` from every unit initial state, (n_samples, n_outputs, n).

    Those to signals that are free in every output, `trend` (n_trend, n_samples), follow
    along the last axis: signal by signal, output by output.
    """
    # (C A^k)^T = (A^T)^k C^T takes one run per output instead of one per state.
    rest = np.zeros((n_samples, *C.T.shape))
    free = state_trajectory(A.T, rest, C.T).swapaxes(1, 2)
    if trend is None or not len(trend):
        return free
    trends = [np.multiply.outer(t, np.eye(len(C))) for t in trend]
    return np.concatenate([free, *trends], axis=2)


def input_responses(A: Array, C: Array, u: Array) -> Array:
    """Outputs to every entry of B alone, (n_samples, n_outputs, n, n_inputs).

    Of the transposed system the states are the answers to rows of B.
    """
    driven = np.einsum("ai,tj->tiaj", C, u).reshape(len(u), len(A), -1)
    x = state_trajectory(A.T, driven)
    return x.reshape(len(u), len(A), len(C), -1).swapaxes(1, 2)


def state_and_level(own: Array, trend: Array, n_outputs: int) -> tuple[Array, Array]:
    """Own unknowns of a run: its initial state, and what trends add to its outputs.

    In the order of `free_responses`, with inputs in transit after the states where
    there are some; the level is (n_samples, n_outputs).

    >>> x0, level = state_and_level(np.array([7.0, 1.0, 2.0]), trend_signals(3, 2), 1)
    >>> x0, level.ravel()
    (array([7.]), array([-1.,  1.,  3.]))
    """
    x0, multiples = np.split(own, [len(own) - len(trend) * n_outputs])
    return x0, trend.T @ multiples.reshape(len(trend), n_outputs)


def spread_of(outputs: Array) -> Array:
    """How far outputs move (..., n_outputs), by which their errors count alike.

    Their standard deviation over all samples; missing ones (NaN) are left out, and one
    that stands still counts as moving by one.

    >>> spread_of(np.array([[1.0, 5.0], [-1.0, 5.0], [np.nan, 5.0]]))
    array([1., 1.])
    """
    flat = outputs.reshape(-1, outputs.shape[-1])
    known = ~np.isnan(flat)
    count = np.maximum(known.sum(0), 1)
    mean = np.where(known, flat, 0.0).sum(0) / count
    centred = np.where(known, flat - mean, 0.0)
    largest = np.abs(centred).max(axis=0, initial=0.0)
    unit = np.where(largest > 0, largest, 1.0)  # lest squares overflow
    size = unit * np.sqrt(np.sum((centred / unit) ** 2, axis=0) / count)
    return np.where(size > 0, size, 1.0)


def estimate_initial_state(
    responses: Array, error: Array, size: Array | None = None
) -> Array:
    """Least-squares initial state behind what a simulation from rest leaves.

    ``min || error - sum_i responses[:, :, i] x0[i] ||``, of minimum norm where the
    responses (of every unit initial state) do not determine it. The error has shape
    (n_samples, n_outputs), and one more axis for several runs. Entries may be missing
    (NaN). With the `size` of every output, errors count by these.
    """
    if size is not None:
        responses = responses / size[:, None]
        error = (error.swapaxes(1, -1) / size).swapaxes(1, -1)
    n_rows = error.shape[0] * error.shape[1]
    columns = responses.reshape(n_rows, -1)
    if np.isnan(error).any():
        if error.ndim > 2:
            runs = [
                estimate_initial_state(responses, run)
                for run in np.moveaxis(error, 2, 0)
            ]
            return np.stack(runs, axis=1)
        known = ~np.isnan(error.reshape(n_rows))
        return scaled_lstsq(columns[known], error.reshape(n_rows)[known])[0]
    return scaled_lstsq(columns, error.reshape(n_rows, *error.shape[2:]))[0]
