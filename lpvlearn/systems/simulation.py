"""Linear recursions and matrix exponentials without a Python loop per sample.

The state recursion ``x[k+1] = A[k] x[k] + f[k]`` is a lower-triangular banded
system of linear equations in the stacked states, solved by one LAPACK call.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.special import factorial

from .least_squares import scaled_lstsq

Array = NDArray[np.float64]

_CHUNK_ENTRIES = 2_000_000  # size of the banded matrix that one solve may hold

_TABLE_SIZES = (9, 17, 33, 65, 129)

_TABLE_TOLERANCE = 1e-13

_PROBES = 128

_PROBE_TOLERANCE = 1e-11


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
    """Solve ``x[k+1] = A[k] x[k] + f[k]`` from ``x[0] = x0``.

    Parameters
    ----------
    A : ndarray of shape (n, n) or (n_samples, n, n)
        One matrix, or one for every sample.
    f : ndarray of shape (n_samples, n) or (n_samples, n, n_runs)
        Forcing; several runs share the matrices.
    x0 : ndarray of shape (n,) or (n, n_runs), default=None
        Initial state; None is the origin.

    Returns
    -------
    ndarray, shape of `f`
        The states ``x[0], ..., x[n_samples - 1]``.
    """
    n_samples, n = f.shape[:2]
    if n == 0 or n_samples == 0:
        return np.zeros_like(f)
    runs = f.reshape(n_samples, n, -1)
    state = np.zeros(runs.shape[1:])
    if x0 is not None:
        state[:] = np.reshape(x0, (n, -1))
    out = np.empty_like(runs)
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
    """Output of a discrete-time LTI model.

    ``x[k+1] = A x[k] + B u[k]``, ``y[k] = C x[k] + D u[k]``.

    Parameters
    ----------
    A, B, C, D : ndarray
        Shapes (n, n), (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs).
    u : ndarray of shape (n_samples, n_inputs)
    x0 : ndarray of shape (n,), default=None
        Initial state; None is rest.

    Returns
    -------
    ndarray of shape (n_samples, n_outputs)
    """
    return state_trajectory(A, u @ B.T, x0) @ C.T + u @ D.T


def expm_batch(M: Array) -> Array:
    """Exponentials of a stack of matrices.

    Scaling and squaring of a Taylor polynomial, all matrices at once. The degree
    leaves a relative truncation error below the rounding unit.

    Parameters
    ----------
    M : ndarray of shape (..., n, n)

    Returns
    -------
    ndarray of shape (..., n, n)

    Examples
    --------
    >>> import numpy as np
    >>> expm_batch(np.array([[[0.0, 1.0], [0.0, 0.0]]]))
    array([[[1., 1.],
            [0., 1.]]])
    """
    norm = float(np.abs(M).sum(-2).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(norm / 0.25)))) if norm > 0 else 0
    X = M / 2.0**squarings
    # Paterson-Stockmeyer: degree 11 with four products; 0.25^12 / 12! < 1e-16
    eye = np.eye(M.shape[-1])
    c = 1.0 / factorial(np.arange(12))
    X2 = X @ X
    X3 = X2 @ X
    P = [c[k] * eye + c[k + 1] * X + c[k + 2] * X2 for k in (3, 6, 9)]
    # F = exp(X) - I is squared in place of exp(X): slow modes and small blocks of a
    # matrix with large ones would otherwise drown in the identity.
    F = ((P[2] @ X3 + P[1]) @ X3 + P[0]) @ X3 + X + 0.5 * X2
    for _ in range(squarings):
        F = 2.0 * F + F @ F
    return F + eye


def sample_zoh(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """Zero-order-hold equivalents of stacked continuous ``(A, B)``.

    ``exp([A B; 0 0] dt) = [Ad Bd; 0 I]``: exact for inputs held over `dt`.

    Parameters
    ----------
    A : ndarray of shape (..., n, n)
    B : ndarray of shape (..., n, n_inputs)
    dt : float
        Sampling time, seconds.

    Returns
    -------
    Ad, Bd : ndarray
        Shapes as A and B.

    Raises
    ------
    ValueError
        If the exponential overflows (an unstable pole, far too fast for `dt`).

    Examples
    --------
    A double integrator:

    >>> import numpy as np
    >>> Ad, Bd = sample_zoh(np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), 0.5)
    >>> Ad
    array([[1. , 0.5],
           [0. , 1. ]])
    >>> Bd
    array([[0.125],
           [0.5  ]])
    """
    n, m = B.shape[-2:]
    M = np.zeros(A.shape[:-2] + (n + m, n + m))
    M[..., :n, :n] = A * dt
    M[..., :n, n:] = B * dt
    with np.errstate(over="ignore", invalid="ignore"):
        E = expm_batch(M)
    if not np.isfinite(E).all():
        fastest = np.linalg.eigvals(A).real.max()
        raise ValueError(
            f"`sampling_time` of {dt:g} s is too long for an unstable pole with real "
            f"part {fastest:.3g} rad/s: the sampled model overflows. Shorten it."
        )
    return E[..., :n, :n], E[..., :n, n:]


def _as_matrices(values: Array) -> Array:
    """Function values of any shape as a stack of matrices."""
    return values.reshape(len(values), *(values.shape[1:] or (1,))[:1], -1)


def _chebyshev_table(
    f: Callable[[Array], Array], low: float, high: float
) -> Array | None:
    """Chebyshev coefficients of a smooth array-valued function, or None.

    The table doubles until its last coefficients vanish to 1e-13 of the largest value
    of their entry. Its nodes include the ends, where a clipped function has its kinks.
    """
    values = np.empty(0)
    for size in _TABLE_SIZES:
        angle = np.pi * np.arange(size) / (size - 1)
        nodes = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(angle)
        if len(values):  # every second node is known
            merged = np.empty((size, *values.shape[1:]))
            merged[::2], merged[1::2] = values, _as_matrices(f(nodes[1::2]))
            values = merged
        else:
            values = _as_matrices(f(nodes))
        weight = np.full(size, 2.0 / (size - 1))
        weight[[0, -1]] *= 0.5
        cosines = np.cos(np.outer(np.arange(size), angle)) * weight
        cosines[[0, -1]] *= 0.5
        coef = np.tensordot(cosines, values, 1)
        scale = np.abs(values).max(0)
        tail = np.abs(coef[-3:]).max(0)
        if (tail <= _TABLE_TOLERANCE * scale).all():
            return coef
        # Entries that are rounding noise of the whole must not forbid the table.
        if size >= 33 and (tail <= _TABLE_TOLERANCE * _rounding_scale(scale)).all():
            return coef
    return None


def _rounding_scale(size: Array) -> Array:
    """Size that rounding errors of the entries of a matrix are relative to.

    The largest of the row times the largest of the column: it follows a change of
    units of the states, inputs and outputs, as the errors do.
    """
    rows, columns = size.max(-1, keepdims=True), size.max(-2, keepdims=True)
    return rows * (columns / max(float(size.max(initial=0.0)), 1e-300))


def tabulate(f: Callable[[Array], Array], x: Array) -> Array:
    """Evaluate a smooth array-valued function of a scalar at many points.

    Parameters
    ----------
    f : callable
        Maps (k,) points to (k, ...) values.
    x : ndarray of shape (n_points,)

    Returns
    -------
    ndarray of shape (n_points, ...)
        Equal to ``f(x)`` to about 1e-12: by a Chebyshev table and one matrix
        product where `f` is smooth, else by `f` itself.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(0.0, 3.0, 1000)
    >>> bool(np.abs(tabulate(np.sin, x) - np.sin(x)).max() < 1e-12)
    True
    """
    if len(x) <= 2 * _TABLE_SIZES[1]:
        return f(x)
    low, high = float(x.min()), float(x.max())
    if high <= low:
        value = f(x[:1])
        return np.broadcast_to(value[0], (len(x), *value.shape[1:]))
    coef = _chebyshev_table(f, low, high)
    if coef is None:
        return f(x)

    def table(points: Array) -> Array:
        angle = np.arccos(np.clip((2 * points - low - high) / (high - low), -1, 1))
        cosines = np.cos(np.outer(angle, np.arange(len(coef))))
        return np.tensordot(cosines, coef, 1)

    # A step or a narrow feature may fall between the nodes: look at the data itself.
    probe = x[:: max(1, len(x) // _PROBES)]
    exact = f(probe)
    matrices = _as_matrices(exact)
    allowed = _PROBE_TOLERANCE * _rounding_scale(np.abs(matrices).max(0))
    if (np.abs(table(probe) - matrices) > allowed).any():
        return f(x)
    return table(x).reshape(len(x), *exact.shape[1:])


def free_responses(A: Array, C: Array, n_samples: int) -> Array:
    """Outputs ``C A^k`` of a discrete-time model from every unit initial state.

    Parameters
    ----------
    A : ndarray of shape (order, order)
    C : ndarray of shape (n_outputs, order)
    n_samples : int

    Returns
    -------
    ndarray of shape (n_samples, n_outputs, order)
    """
    # (C A^k)^T = (A^T)^k C^T takes one run per output instead of one per state.
    rest = np.zeros((n_samples, *C.T.shape))
    return state_trajectory(A.T, rest, C.T).swapaxes(1, 2)


def estimate_initial_state(responses: Array, error: Array) -> Array:
    """Least-squares initial state behind what a simulation from rest leaves.

    ``min || error - sum_i responses[:, :, i] x0[i] ||``, of minimum norm where the
    responses do not determine it.

    Parameters
    ----------
    responses : ndarray of shape (n_samples, n_outputs, order)
        Outputs from every unit initial state.
    error : ndarray of shape (n_samples, n_outputs) or (n_samples, n_outputs, n_runs)
        Outputs minus the simulation from rest; several runs share the responses.

    Returns
    -------
    ndarray of shape (order,) or (order, n_runs)

    Examples
    --------
    >>> import numpy as np
    >>> A, C = np.array([[0.5]]), np.array([[2.0]])
    >>> responses = free_responses(A, C, 3)
    >>> estimate_initial_state(responses, np.array([[6.0], [3.0], [1.5]]))
    array([3.])
    """
    n_rows = error.shape[0] * error.shape[1]
    columns = responses.reshape(n_rows, -1)
    return scaled_lstsq(columns, error.reshape(n_rows, *error.shape[2:]))[0]
