r"""The innovation form of plant and noise, and its predictor.

.. math:: x_{t+1} = A x_t + B u_t + K e_t, \qquad y_t = C x_t + D u_t + e_t

has the predictor ``x[t+1] = A_K x[t] + B_K z[t]``, ``y[t] = C x[t] + D u[t] + e[t]``
with ``A_K = A - K C``, ``B_K = [B - K D, K]`` and ``z = [u; y]``. It is stable even
where A is not, and a model without noise states that z drives: its simulation error is
the prediction error, which the refinement of simulations therefore minimises, and its
errors are white, so that the covariance of its parameters is that of least squares.

Of these parameters the innovation form is a polynomial of second degree,
``A = A_K + K C``, ``B = B_u + K D`` where ``B_K = [B_u, K]``. To first order a part p
of a block-diagonal A changes with them by

.. math:: dA_{pp}, \qquad dB_p - Y B_r, \qquad dC_p + C_r X, \qquad
    A_r X - X A_p = -dA_{rp}, \qquad A_p Y - Y A_r = -dA_{pr},

where r is the rest: both subspaces remain invariant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...models.innovation import NoiseModel, prediction_responses
from ...systems.simulation import estimate_initial_state, state_trajectory
from ..evidence.statistics import parameter_covariance
from ..samples.records import Record, shorten
from ..simulation_error.refinement import refine_simulation
from ..simulation_error.simulation_fit import (
    Freedom,
    Realization,
    moved_model,
    simulation_fit,
)

Array = NDArray[np.float64]

# Part of an output's energy added to the innovation covariance before its inverse root
# weights the outputs, so that data without noise have one.
_WEIGHT_FLOOR = 1e-12


class Innovation(NamedTuple):
    """``x[t+1] = A x[t] + B u[t] + K e[t]``, ``y[t] = C x[t] + D u[t] + e[t]``."""

    A: Array  # may be unstable; ``A - K C`` is stable
    B: Array
    C: Array
    D: Array
    K: Array
    covariance: Array  # of the innovations e

    def transformed(self, T: Array) -> Innovation:
        """In the coordinates x' of ``x = T x'``."""
        A, B, K = (linalg.solve(T, part) for part in (self.A @ T, self.B, self.K))
        return self._replace(A=A, B=B, C=self.C @ T, K=K)

    def rescaled(self, u: Array, y: Array) -> Innovation:
        """Of inputs and outputs divided by these numbers."""
        return Innovation(
            self.A,
            self.B * u,
            self.C / y[:, None],
            self.D * u / y[:, None],
            self.K * y,
            self.covariance / np.outer(y, y),
        )


class Changes(NamedTuple):
    """Stacks of changes of an innovation form."""

    A: Array
    B: Array
    C: Array
    D: Array

    def transformed(self, T: Array) -> Changes:
        """As `Innovation.transformed`."""
        inverse = linalg.inv(T)
        return Changes(inverse @ self.A @ T, inverse @ self.B, self.C @ T, self.D)

    def of_part(self, model: Innovation, part: NDArray[np.bool_]) -> Changes:
        """Changes of a part of a block-diagonal model, for which it stays that.

        The part and the rest remain invariant subspaces: the off-diagonal blocks X of
        the change of basis solve Sylvester equations.
        """
        rest = ~part
        ahead = _sylvester(model.A, rest, part, self.A)
        back = _sylvester(model.A, part, rest, self.A)
        changes = Changes(
            self.A[:, part][:, :, part],
            self.B[:, part] - back @ model.B[rest],
            self.C[:, :, part] + model.C[:, rest] @ ahead,
            self.D,
        )
        return changes._settled(model.A[part][:, part], model.B[part], model.C[:, part])

    def _settled(self, A: Array, B: Array, C: Array) -> Changes:
        """The same changes in a basis of which A and C change the least.

        What the data do not tell of the basis would otherwise blur B.
        """
        (ny, n), k = C.shape, len(self.A)
        eye = np.eye(n)
        system = np.vstack([np.kron(A, eye) - np.kron(eye, A.T), np.kron(C, eye)])
        target = np.hstack([self.A.reshape(k, n * n), self.C.reshape(k, ny * n)])
        X = -(target @ np.linalg.pinv(system).T).reshape(k, n, n)
        return Changes(self.A + A @ X - X @ A, self.B - X @ B, self.C + C @ X, self.D)


def _sylvester(
    A: Array, rows: NDArray[np.bool_], columns: NDArray[np.bool_], change: Array
) -> Array:
    """X of ``A_r X - X A_c = -change_rc`` for a stack of changes."""
    left, right = A[rows][:, rows], A[columns][:, columns]
    system = np.kron(left, np.eye(len(right))) - np.kron(np.eye(len(left)), right.T)
    wanted = -change[:, rows][:, :, columns]
    solution = np.linalg.solve(system, wanted.reshape(len(change), -1).T)
    return np.asarray(solution.T.reshape(wanted.shape))


class Predictor(NamedTuple):
    """The predictor as a model driven by ``[u; y]``, its outputs made white."""

    model: Realization
    records: list[Record]
    free: Freedom
    root: Array  # lower triangular: outputs are ``root`` times those of the model
    share: float  # samples in `records` by all samples that were used

    def innovation(self, model: Realization, covariance: Array) -> Innovation:
        """The innovation form of this predictor, or of one that was moved."""
        m = model.B.shape[1] - len(self.root)
        B, K = np.hsplit(model.B, [m])
        C, D = self.root @ model.C, self.root @ model.D[:, :m]
        return Innovation(model.A + K @ C, B + K @ D, C, D, K, covariance)

    def parameter_covariance(self, covariance: Array) -> Array:
        """Of the parameters of the predictor, whose errors are white."""
        half = linalg.solve_triangular(self.root, covariance, lower=True)
        white = linalg.solve_triangular(self.root, half.T, lower=True)
        noise = NoiseModel.white(white)
        known = parameter_covariance(self.model, self.records, self.free, noise)
        return known * self.share

    def jacobian(self, n_parameters: int) -> Changes:
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
        return Changes(*(np.array(part) for part in zip(*changes, strict=True)))


# A model, and the predictor that it belongs to: None where it was not refined
Found = tuple[Predictor | None, Innovation]


def refine_predictor(
    model: Innovation,
    records: Sequence[Record],
    free: Freedom,
    max_iter: int | None = None,
) -> Found:
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
    root = innovation_root(covariance, energy / n_samples)
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
    fitted = Predictor(found, heads, predictor, root, share)
    joint = fitted.innovation(found, covariance)
    errors = np.vstack(prediction_errors(joint, records, free)[1])
    joint = joint._replace(covariance=errors.T @ errors / n_samples)
    return None if found.blocks is None else fitted, joint


def prediction_errors(
    model: Innovation, records: Sequence[Record], free: Freedom
) -> tuple[Array, list[Array]]:
    """Own unknowns of the experiments, of weighted least squares, and what they leave.

    That are the errors of prediction.
    """
    A, B, C, D, K, covariance = model
    n = len(A)
    energy = np.mean(np.hstack([record.y for record in records]) ** 2, axis=1)
    weight = linalg.inv(innovation_root(covariance, energy))
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


def innovation_root(covariance: Array, energy: Array) -> Array:
    """Lower triangular root of a covariance, outputs without noise allowed for."""
    floor = _WEIGHT_FLOOR * energy
    floor[floor == 0.0] = 1.0
    return linalg.cholesky(covariance + np.diag(floor), lower=True)
