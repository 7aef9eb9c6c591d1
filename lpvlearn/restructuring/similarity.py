"""Parameters from nothing: the similarity start of the restructuring, Eq. (3), (34).

A similarity T takes the black box to ``(T A T^-1, T B, C T^-1)``. Rows of A and C, and
entries of B, that hold no parameter give equations linear in T. They are solved
exactly, ``T = T_0 + sum_l z_l N_l``; what remains of the distance to the affine
structure is minimised over z by a Levenberg-Marquardt method, from many starts at once.

Where they are more than a noisy black box can meet, as two inputs that reach one state
out of two and should be in proportion, only a singular T solves them. They are solved
by total least squares then, with as many z as a model of the structure leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space
from scipy.optimize import least_squares

from ..minimax.problem import MinimaxResult, Peaks
from ..systems.least_squares import (
    Residuals,
    column_scale,
    levenberg_marquardt,
    scaled_lstsq,
)
from .deadline import time_is_up
from .error_system import Structure, Target, derivatives, response_point

Array = NDArray[Any]

_MAX_ITER = 40  # steps of a start: it need not be an optimum
_EXACT = 4  # starts that reach the structure exactly; no more are needed

# relative singular value of the linear equations that noise of a black box may leave
_NULL_TOLERANCE = 1e-6

# Relative singular value of a T that is singular but for rounding: 1e-16 over the least
# singular value of the equations that is none.
_SINGULAR = 1e-9

# Weight of the distance of z to its start, relative to the size of the start: what the
# structure leaves open (the unit of a state) stays there, and nothing else heeds it.
_STAYING = 1e-6

# A start ends when its squared distance falls by less than _SLOW that often in a row:
# far from the structure progress is slow and then fast again.
_SLOW, _PATIENCE = 1e-4, 4
_FINEST = 3e-16  # tolerances of what units may make small

_ROUNDING = 1e-24  # squared distance, relative to the structure: it is reached exactly


@dataclass(frozen=True)
class AffineProblem:
    """An affine structure beside a black box of the same order, time-scaled."""

    box: Target
    offset: Array  # (n + p, n + m)
    basis: Array  # (q, n + p, n + m)


def mean_rate(rates: Array) -> float:
    """Geometric mean of the positive ones, 1 where there is none."""
    rates = rates[rates > 0]
    return float(np.exp(np.log(rates).mean())) if rates.size else 1.0


def scaled_problem(
    box: Target, offset: Array, basis: Array, rate: float
) -> AffineProblem:
    """The problem with time in units of ``1 / rate`` and states rescaled to fit.

    The state scaling ``x = diag(s) x'`` brings the fixed entries of the structure
    close to one, e.g. the kinematic ones of ``v' = w``: ``s_w = rate s_v``. The
    parameters do not change, only the equations that hold them.
    """
    n = len(box.A)
    fixed = (offset != 0) & ~(basis != 0).any(0)
    rows, values = [], []
    for i, j in np.argwhere(fixed):
        if i >= n and j >= n:
            continue
        row = np.zeros(n)
        if i < n:
            row[i] -= 1.0
        if j < n:
            row[j] += 1.0
        if row.any():
            # log |entry'| = log |entry| - log s_i + log s_j - (log rate, rows of A, B)
            rows.append(row)
            values.append((np.log(rate) if i < n else 0.0) - np.log(abs(offset[i, j])))
    s = np.ones(n)
    if rows:
        s = np.exp(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0])
    p, m = box.D.shape
    left = np.concatenate([1.0 / (s * rate), np.ones(p)])
    right = np.concatenate([s, np.ones(m)])
    return AffineProblem(
        Target(box.A / rate, box.B / rate, box.C, box.D, box.dt),
        left[:, None] * offset * right,
        left[:, None] * basis * right,
    )


def linear_equations(problem: AffineProblem) -> tuple[Array, Array]:
    """Equations ``M vec(T) = b`` (row-major) from what holds no parameter."""
    n, m, p = len(problem.box.A), problem.box.B.shape[1], problem.box.C.shape[0]
    free = (problem.basis != 0).any(0)
    S, eye = problem.offset, np.eye(n)
    M: list[Array] = [np.zeros((0, n * n))]
    b: list[Array] = [np.zeros(0)]
    for i in range(n):
        row = eye[i : i + 1]
        if not free[i, :n].any():  # e_i T A - S_i T = 0
            M.append(np.kron(row, problem.box.A.T) - np.kron(S[i : i + 1, :n], eye))
            b.append(np.zeros(n))
        for j in range(m):
            if not free[i, n + j]:  # e_i T b_j = S_ij
                M.append(np.kron(row, problem.box.B[:, j : j + 1].T))
                b.append(S[i : i + 1, n + j])
    for k in range(p):
        if not free[n + k, :n].any():  # S_k T = c_k
            M.append(np.kron(S[n + k : n + k + 1, :n], eye))
            b.append(problem.box.C[k])
    return np.vstack(M), np.concatenate(b)


def similarity_starts(
    problem: AffineProblem,
    n_starts: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Parameter vectors from random similarities, all starts in one batch.

    Returns them (n_found, n_params) and the distances to the structure that remain,
    ascending.
    """
    n = len(problem.box.A)
    M, b = linear_equations(problem)
    T0 = np.linalg.lstsq(M, b, rcond=None)[0] if len(b) else np.zeros(n * n)
    N = null_space(M, rcond=_NULL_TOLERANCE) if len(b) else np.eye(n * n)
    Z = _draws(T0, N, n_starts, rng)
    flat = problem.basis.reshape(len(problem.basis), -1)
    directions = np.linalg.qr(flat.T)[0]
    distances = _distances(problem, T0, N, directions)
    nearest = False
    if not _any_regular((T0 + Z @ N.T).reshape(-1, n, n)):
        rank = _own_rank(problem)
        nearest = rank < n * n - N.shape[1]
    if nearest:
        T0, N = _nearest_solutions(M, b, rank)
        Z = _draws(T0, N, n_starts, rng)
        # what the equations leave is theirs: z would lessen it by states of no size
        held = np.eye(problem.offset.size)[_in_equations(problem).ravel()]
        others = np.hstack([directions, held.T])
        distances = _staying(_distances(problem, T0, N, others), Z)
    Z, cost = levenberg_marquardt(
        distances,
        Z,
        max_iter=_MAX_ITER,
        tol=_SLOW,
        patience=_PATIENCE,
        exact=_ROUNDING * (1.0 + np.abs(problem.offset).sum()) ** 2,
        enough=_EXACT,
        stop=time_is_up,
    )
    Z, cost = Z[np.isfinite(cost)], cost[np.isfinite(cost)]  # regular ones
    if len(Z) == 0:
        return np.zeros((0, len(flat))), cost
    d = transformed(problem, (T0 + Z @ N.T).reshape(-1, n, n))[0]
    if nearest:
        rest = d - (d @ directions) @ directions.T
        cost = np.einsum("ij,ij->i", rest, rest)
    theta = nearest_parameters(problem, d)
    good = np.isfinite(theta).all(1)
    order = np.argsort(cost[good], kind="stable")
    return theta[good][order], np.sqrt(cost[good][order])


def _draws(T0: Array, N: Array, n_starts: int, rng: np.random.Generator) -> Array:
    """Random z, (n_starts, n_z); one without entries where there is no choice."""
    if N.shape[1] == 0:
        return np.zeros((1, 0))
    size = np.linalg.norm(T0) / np.sqrt(len(T0)) if T0.any() else 1.0
    spread = size * 10 ** rng.uniform(-1, 1, size=(n_starts, 1))
    return np.asarray(rng.normal(size=(n_starts, N.shape[1])) * spread)


def _any_regular(T: Array) -> bool:
    """Whether any of stacked matrices is regular, beyond rounding."""
    s = np.linalg.svd(T[np.isfinite(T).all((1, 2))], compute_uv=False)
    return bool((s[:, -1] > _SINGULAR * s[:, 0]).any())


def _own_rank(problem: AffineProblem) -> int:
    """Rank of the linear equations of the structure's own models, which meet them all.

    Of one with random parameters, as of all but special ones. That of all unknowns
    where no input moves it, or no output shows it: it is similar to no black box.
    """
    n = len(problem.box.A)
    size = np.abs(problem.basis).max((1, 2), initial=0.0)
    rng = np.random.default_rng(0)
    theta = rng.normal(size=len(size)) / np.where(size > 0, size, 1.0)
    S = problem.offset + np.tensordot(theta, problem.basis, axes=1)
    if not (S[:n, n:].any() and S[n:, :n].any()):
        return n * n
    own = replace(problem, box=Target.of(S, n, None))
    M = _of_length_one(*linear_equations(own))[0]
    return int(np.linalg.matrix_rank(M, rtol=_NULL_TOLERANCE))


def _of_length_one(M: Array, b: Array) -> tuple[Array, Array]:
    """Equations that count alike, whatever the units of inputs and outputs are."""
    length = column_scale(M.T)
    return M / length[:, None], b / length


def _nearest_solutions(M: Array, b: Array, rank: int) -> tuple[Array, Array]:
    """T_0 and the N_l of the nearest equations of that rank (a truncated SVD)."""
    M, b = _of_length_one(M, b)
    U, s, Vt = np.linalg.svd(M)
    T0 = Vt[:rank].T @ ((U.T @ b)[:rank] / s[:rank])
    return T0, Vt[rank:].T


def _in_equations(problem: AffineProblem) -> NDArray[np.bool_]:
    """The entries of the system matrix that the linear equations hold."""
    n = len(problem.box.A)
    held = ~(problem.basis != 0).any(0)
    held[:, :n] = held[:, :n].all(1, keepdims=True)
    held[n:, n:] = False
    return held


def nearest_parameters(problem: AffineProblem, d: Array) -> Array:
    """Parameters of the structure nearest to ``offset + d``, for each row of `d`."""
    flat = problem.basis.reshape(len(problem.basis), -1)
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    size = np.where(size > 0, size, 1.0)
    return np.asarray((np.linalg.lstsq((flat / size).T, d.T, rcond=None)[0] / size).T)


def transformed(problem: AffineProblem, T: Array) -> tuple[Array, Array, Array]:
    """Stacked ``[T A T^-1, T B; C T^-1, D] - offset``, the matrices, and T^-1."""
    n = len(problem.box.A)
    inverse = np.linalg.inv(T)
    S = np.empty((len(T), *problem.offset.shape))
    S[:, :n, :n] = T @ problem.box.A @ inverse
    S[:, :n, n:] = T @ problem.box.B
    S[:, n:, :n] = problem.box.C @ inverse
    S[:, n:, n:] = problem.box.D
    return (S - problem.offset).reshape(len(T), -1), S, inverse


def _distances(
    problem: AffineProblem, T0: Array, N: Array, directions: Array
) -> Residuals:
    """Distance to the affine set and its Jacobian in z.

    With ``Delta = N_l T^-1``: ``dA = Delta A - A Delta``, ``dB = Delta B``,
    ``dC = -C Delta`` for the transformed matrices.
    """
    n = len(problem.box.A)

    def rest(d: Array) -> Array:
        return d - (d @ directions) @ directions.T

    def residuals(z: Array, _: Any) -> tuple[Array, Callable[..., Array]]:
        T = (T0 + z @ N.T).reshape(-1, n, n)
        r = np.full((len(T), problem.offset.size), np.nan)
        good = np.asarray(np.isfinite(T).all((1, 2)), dtype=bool)
        good[good] = np.abs(np.linalg.det(T[good])) > 0
        d, S, inverse = transformed(
            problem, np.where(good[:, None, None], T, np.eye(n))
        )
        r[good] = rest(d[good])

        def jacobian(kept: Array) -> Array:
            Delta = N.T.reshape(1, -1, n, n) @ inverse[kept, None]
            J = np.zeros((len(kept), N.shape[1], *problem.offset.shape))
            J[:, :, :n] = Delta @ S[kept, None, :n]
            J[..., :n] -= S[kept, None, :, :n] @ Delta
            return rest(J.reshape(*J.shape[:2], problem.offset.size)).swapaxes(1, 2)

        return r, jacobian

    return residuals


def _staying(distances: Residuals, starts: Array) -> Residuals:
    """Distances, and by how much z leaves its start, faintly."""
    size = np.linalg.norm(starts, axis=1, keepdims=True)
    weight = _STAYING / np.where(size > 0, size, 1.0)

    def residuals(z: Array, rows: Any) -> tuple[Array, Callable[..., Array]]:
        r, jacobian = distances(z, rows)
        own = weight[rows]

        def with_stay(kept: Array) -> Array:
            stay = own[kept, :, None] * np.eye(z.shape[1])
            return np.concatenate([jacobian(kept), stay], axis=1)

        return np.hstack([r, own * (z - starts[rows])]), with_stay

    return residuals


class _BilinearEquations:
    """``S0 diag(T, I) - diag(T, I) S(theta)`` over ``x = [vec T, theta]``, Eq. (7).

    T takes the structured state to that of the black box, of the system matrix S0; the
    last block, ``D - D(theta)``, is for parameters of a feedthrough. Time and the
    states of the structure are scaled.
    """

    def __init__(self, structure: Structure, box: Target | None, theta: Array) -> None:
        """A ValueError where the structure is not affine or of another order."""
        offset = getattr(structure, "offset", None)
        if offset is None or box is None or len(box.A) != structure.order:
            raise ValueError(
                "`norm='similarity'` needs an affine structure of the order of the "
                f"black box, as Eq. (7) does. Got {structure} and order "
                f"{'unknown' if box is None else len(box.A)}."
            )
        poles = np.abs(np.linalg.eigvals(box.A))
        discrete = box.dt is not None
        self.rate = 1.0 if discrete else max(float(poles.max(initial=0.0)), 1e-300)
        basis = structure.jacobian(theta)
        problem = scaled_problem(box, offset, basis, self.rate)
        self.box, self.offset, self.basis = problem.box, problem.offset, problem.basis
        self.S0 = self.box.system_matrix
        self.n, (self.p, self.m) = structure.order, box.D.shape

    def start(self, theta: Array) -> Array:
        """The best T of given parameters, in which the cost is quadratic."""
        in_T = self.n**2
        x = np.concatenate([np.zeros(in_T), theta])
        J, r = self.jacobian(x)[:, :in_T], self.residuals(x)
        x[:in_T] = -np.linalg.lstsq(J, r, rcond=None)[0]
        return x

    def sides(self, x: Array) -> tuple[Array, Array]:
        """``diag(T, I)`` for rows (outputs) and columns (inputs)."""
        T = x[: self.n**2].reshape(self.n, self.n)
        return block_diag(T, np.eye(self.p)), block_diag(T, np.eye(self.m))

    def _system(self, x: Array) -> Array:
        return self.offset + np.tensordot(x[self.n**2 :], self.basis, axes=1)

    def residuals(self, x: Array) -> Array:
        left, right = self.sides(x)
        return (self.S0 @ right - left @ self._system(x)).ravel()

    def jacobian(self, x: Array) -> Array:
        n, S = self.n, self._system(x)
        in_T, k = np.zeros((n, n, *S.shape)), np.arange(n)
        in_T[:, k, :, k] += self.S0[:, :n].T
        in_T[k, :, k] -= S[:n]
        in_theta = -self.sides(x)[0] @ self.basis
        return np.vstack([J.reshape(-1, S.size) for J in (in_T, in_theta)]).T


def minimise_bilinear(
    structure: Structure, box: Target | None, theta: Array, max_iter: int
) -> tuple[Array, MinimaxResult]:
    """Minimise Eq. (7) over parameters and similarity, from given parameters.

    ``|A T - T A(theta)|_F^2 + |B - T B(theta)|_F^2 + |C T - C(theta)|_F^2``, and
    ``|D - D(theta)|_F^2``, for an affine structure of the black box's order. The value
    is the square root.
    """
    equations = _BilinearEquations(structure, box, theta)
    free = np.full(equations.n**2, np.inf)
    limits = np.append(-free, structure.lower), np.append(free, structure.upper)
    found = least_squares(
        equations.residuals,
        np.clip(equations.start(theta), *limits),
        equations.jacobian,
        bounds=limits,
        x_scale="jac",
        ftol=_FINEST,
        xtol=_FINEST,
        gtol=_FINEST,
        max_nfev=max(max_iter, 1),
    )
    theta, active = found.x[equations.n**2 :], found.active_mask[equations.n**2 :]
    theta = np.select(  # the steps end a rounding error inside
        [active < 0, active > 0], [structure.lower, structure.upper], theta
    )
    cost = np.sqrt(2.0 * found.cost)
    peaks = Peaks(
        np.array([cost]), np.zeros(0), np.zeros((1, len(theta))), np.zeros(1) > 0
    )
    done = found.status > 0
    return theta, MinimaxResult(theta, peaks, np.nan, np.nan, done, found.nfev)


def bilinear_changes(
    structure: Structure, box: Target, theta: Array, omega: Array, dG: Array
) -> Array:
    """First-order changes of the minimiser of Eq. (7) with the black box's response.

    `dG` has the shape (r, k, n_outputs, n_inputs). Of the changes of the black box with
    that response, ``dG = L dS0 R``, the least ones are taken: any other turns its state
    basis, which T follows. Parameters that their bounds hold do not change.
    """
    equations = _BilinearEquations(structure, box, theta)
    S0 = equations.S0
    at = response_point(equations.box, omega / equations.rate)
    entries = np.eye(S0.size).reshape(-1, *S0.shape)
    K = derivatives(at.L, entries, at.R).reshape(-1, S0.size)
    parts = dG.reshape(len(dG), -1).T
    dS0 = scaled_lstsq(
        np.vstack([K.real, K.imag]), np.vstack([parts.real, parts.imag])
    )[0]
    x = equations.start(theta)
    moved = dS0.T.reshape(-1, *S0.shape) @ equations.sides(x)[1]
    held = (theta <= structure.lower) | (theta >= structure.upper)
    J = np.where(
        np.append(np.zeros(equations.n**2) > 0, held), 0.0, equations.jacobian(x)
    )
    dx = -scaled_lstsq(J, moved.reshape(len(dG), -1).T)[0]
    return np.asarray(dx[equations.n**2 :].T)
