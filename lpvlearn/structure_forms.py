"""Forms that structures are written in: canonical, modal and mechanical ones.

The functions return what :class:`GrayBoxStructure` is built from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import matrix, whole_number
from .system_matrices import Blocks, blocks
from .templates import Affine, Cells, affine_arrays, full_cells, parse_cells

Array = NDArray[np.float64]

_OUTPUTS = ("position", "velocity", "acceleration")
_NORMALIZED = ("input", "output")
_SINGULAR = 1e-13  # reciprocal condition number of a singular mass matrix


def dimensions(
    order: int, n_inputs: int, n_outputs: int, feedthrough: bool
) -> tuple[int, int, int]:
    """The numbers of states, inputs and outputs, checked."""
    order = whole_number("order", order, 0)
    if order == 0 and not feedthrough:
        raise ValueError(
            "`feedthrough` must be True for order 0: a pure gain has no other "
            "parameters. Got False."
        )
    n_inputs = whole_number("n_inputs", n_inputs, 1)
    return order, n_inputs, whole_number("n_outputs", n_outputs, 1)


def observable_canonical_cells(order: int, n_outputs: int) -> tuple[Cells, Cells]:
    """A and C of the observable canonical form with generic observability indices."""
    lengths = [order // n_outputs + (i < order % n_outputs) for i in range(n_outputs)]
    A: Cells = [[0.0] * order for _ in range(order)]
    C = full_cells("c", n_outputs, order)  # rows beyond the order stay free
    first = 0
    for i, length in enumerate(lengths[: min(order, n_outputs)]):
        C[i] = [1.0 if j == first else 0.0 for j in range(order)]
        last = first + length - 1
        for k in range(first, last):
            A[k][k + 1] = 1.0
        A[last] = [f"a{last + 1}_{j + 1}" for j in range(order)]
        first += length
    return A, C


def modal_cells(
    n_modes: int, n_real: int, n_inputs: int, n_outputs: int, normalize: str
) -> tuple[Cells, Cells, Cells]:
    """A, B and C of the real modal form, see `GrayBoxStructure.modal`.

    Examples
    --------
    >>> A, B, C = modal_cells(1, 1, 1, 1, "input")
    >>> A
    [[0.0, 1.0, 0.0], ['-w2_1', '-d_1', 0.0], [0.0, 0.0, '-r_1']]
    >>> B, C
    ([[0.0], [1.0], [1.0]], [['c1_1', 'c1_2', 'c1_3']])
    """
    n_modes = whole_number("n_modes", n_modes, 0)
    n_real = whole_number("n_real", n_real, 0)
    order = 2 * n_modes + n_real
    if order == 0:
        raise ValueError("`n_modes` or `n_real` must be at least 1. Got 0 and 0.")
    if normalize not in _NORMALIZED:
        raise ValueError(
            f"`normalize` must be one of {_NORMALIZED}. Got {normalize!r}."
        )
    A: Cells = [[0.0] * order for _ in range(order)]
    B, C = full_cells("b", order, n_inputs), full_cells("c", n_outputs, order)
    for i in range(n_modes):
        k = 2 * i
        A[k][k + 1] = 1.0
        A[k + 1][k : k + 2] = [f"-w2_{i + 1}", f"-d_{i + 1}"]
    for i in range(n_real):
        k = 2 * n_modes + i
        A[k][k] = f"-r_{i + 1}"
    for k in range(order):
        second = k < 2 * n_modes and k % 2 == 1
        if normalize == "input":  # [0, 1] for a mode, 1 for a real pole
            B[k][0] = 1.0 if second or k >= 2 * n_modes else 0.0
        else:
            C[0][k] = 0.0 if second else 1.0
    return A, B, C


@dataclass(frozen=True, eq=False)
class ImplicitSystem:
    """System matrices ``S = offset + W X`` with ``M(theta) X = N(theta)``, M, N affine.

    The form that physics is written in: the equations of motion before they are
    solved for the accelerations ``X [x; u]``.

    Attributes
    ----------
    M : ndarray of shape (1 + n_params, n_dof, n_dof)
        Constant part, then the part of every parameter.
    N : ndarray of shape (1 + n_params, n_dof, order + n_inputs)
    W : ndarray of shape (order + n_outputs, n_dof)
    offset : ndarray of shape (order + n_outputs, order + n_inputs)
    order : int
    """

    M: Array
    N: Array
    W: Array
    offset: Array
    order: int

    def _solved(self, theta: Array) -> tuple[Array, Array]:
        """``M^-1`` and ``X``; NaN where M is singular, for a search to step back."""
        M = self.M[0] + np.tensordot(theta, self.M[1:], 1)
        N = self.N[0] + np.tensordot(theta, self.N[1:], 1)
        try:
            inverse = np.linalg.inv(M)
        except np.linalg.LinAlgError:
            inverse = np.full_like(M, np.nan)
        return inverse, inverse @ N

    def __call__(self, theta: Array) -> Blocks:
        """Matrices A, B, C, D."""
        return blocks(self.offset + self.W @ self._solved(theta)[1], self.order)

    def jacobian(self, theta: Array) -> Blocks:
        """Their derivatives: ``M X_i = N_i - M_i X``."""
        inverse, X = self._solved(theta)
        S = self.W @ inverse @ (self.N[1:] - self.M[1:] @ X)
        return blocks(S, self.order)

    def curvature(self, theta: Array) -> Array:
        """Second derivatives of S: ``M X_ij = -M_i X_j - M_j X_i``."""
        inverse, X = self._solved(theta)
        first = inverse @ (self.N[1:] - self.M[1:] @ X)
        product = self.M[1:][:, None] @ first[None]
        return -self.W @ inverse @ (product + product.swapaxes(0, 1))

    def fix(self, values: Array, free: NDArray[np.bool_]) -> ImplicitSystem:
        """The equations with the parameters that are not free at given values."""
        keep, known = np.r_[True, free], values * ~free
        M, N = (
            np.concatenate([X[:1] + np.tensordot(known, X[1:], 1), X[1:]])[keep]
            for X in (self.M, self.N)
        )
        return ImplicitSystem(M, N, self.W, self.offset, self.order)

    def affine(self) -> tuple[Array, Array]:
        """Offset and basis of S where M holds no parameter."""
        X = np.linalg.solve(self.M[0], self.N)
        S = self.W @ X + 0.0  # no negative zeros
        return self.offset + S[0], S[1:]

    def natural_sizes(self, rate: float, gains: Array) -> Array:
        """Sizes of the parameters, up to a factor, that make all terms alike.

        Parameters
        ----------
        rate : float
            1 / s, at which the states move.
        gains : ndarray of shape (n_outputs,)
            Sizes of the outputs for inputs of size one.

        Returns
        -------
        ndarray of shape (n_params,)
            Positive.
        """
        n, dof = self.order, len(self.M[0])
        # x_i' = a x_j: log s_j - log s_i = log rate - log |a|; the same for X
        columns = np.hstack([self.offset[:, :n], self.W])
        rows, values = [], []
        for i, j in np.argwhere(columns[:n]):
            row = np.zeros(n + dof)
            row[j] += 1.0
            row[i] -= 1.0
            rows.append(row)
            values.append(np.log(rate) - np.log(abs(columns[i, j])))
        s = np.ones(n + dof)
        if rows:
            s = np.exp(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0])
        outputs = (np.abs(columns[n:]) * s).max(1, initial=0.0)
        seen = (outputs > 0) & (gains > 0)
        if seen.any():
            s = s * np.median(gains[seen] / outputs[seen])
        inputs = np.ones(self.N.shape[2] - n)
        terms = np.concatenate(
            [np.abs(self.M) * s[n:], np.abs(self.N) * np.concatenate([s[:n], inputs])],
            axis=2,
        ).max((1, 2))
        level = terms[0] if terms[0] > 0 else 1.0  # that of what holds no parameter
        return np.asarray(level / np.where(terms[1:] > 0, terms[1:], level))

    def regular_point(self) -> Array:
        """Parameters that bring M near the identity, so that S exists there."""
        q, n = len(self.M) - 1, len(self.M[0])
        target = (np.eye(n) - self.M[0]).ravel()
        theta = np.linalg.lstsq(self.M[1:].reshape(q, -1).T, target, rcond=None)[0]
        rng = np.random.default_rng(0)
        for candidate in (theta, np.ones(q), *rng.uniform(0.5, 2.0, (8, q))):
            M = self.M[0] + np.tensordot(candidate, self.M[1:], 1)
            if 1.0 / np.linalg.cond(M) > _SINGULAR:
                return candidate
        raise ValueError(
            "`M` must be regular for some parameters. Got a template that is singular "
            "for all; a coordinate without mass is no state."
        )


def mechanical_system(
    M: Any,
    D: Any,
    K: Any,
    F: Any,
    outputs: str,
    sensors: ArrayLike | None,
    parameter_names: Sequence[str] | None,
) -> tuple[ImplicitSystem, list[str]]:
    """Equations of motion, see `GrayBoxStructure.mechanical`; and parameter names."""
    if outputs not in _OUTPUTS:
        raise ValueError(f"`outputs` must be one of {_OUTPUTS}. Got {outputs!r}.")
    cells = {
        name: parse_cells(name, block)
        for name, block in (("M", M), ("D", D), ("K", K), ("F", F))
    }
    n, m = len(cells["M"]), len(cells["F"][0]) if cells["F"] else 0
    if n == 0 or m == 0:
        raise ValueError(
            "`M` and `F` must describe at least one coordinate and one input. Got "
            f"{n} and {m}."
        )
    for name, block in cells.items():
        expected = (n, m if name == "F" else n)
        shape = (len(block), len(block[0]) if block else 0)
        if shape != expected:
            raise ValueError(
                f"`{name}` must have shape {expected} to fit `M` and `F`. Got {shape}."
            )
    H = np.eye(n) if sensors is None else matrix("sensors", sensors)
    if H.shape[1] != n or len(H) == 0:
        raise ValueError(
            f"`sensors` must have {n} columns, one for each coordinate. Got shape "
            f"{H.shape}."
        )
    rows: list[list[Affine]] = [
        list(mass)
        + [_negative(entry) for entry in (*stiffness, *damping)]
        + list(force)
        for mass, stiffness, damping, force in zip(
            cells["M"], cells["K"], cells["D"], cells["F"], strict=True
        )
    ]
    offset, basis, names = affine_arrays(rows, parameter_names)
    stacked = np.concatenate([offset[None], basis])
    mass, force = stacked[:, :, :n], stacked[:, :, n:]
    if not mass[1:].any() and not 1.0 / np.linalg.cond(mass[0]) > _SINGULAR:
        raise ValueError(
            "`M` must be regular: a coordinate without mass is no state. Got "
            f"{mass[0].tolist()}."
        )
    p = len(H)
    W, fixed = np.zeros((2 * n + p, n)), np.zeros((2 * n + p, 2 * n + m))
    W[n : 2 * n] = np.eye(n)
    fixed[:n, n : 2 * n] = np.eye(n)
    if outputs == "acceleration":
        W[2 * n :] = H
    else:
        first = 0 if outputs == "position" else n
        fixed[2 * n :, first : first + n] = H
    return ImplicitSystem(mass, force, W, fixed, 2 * n), names


def _negative(entry: Affine) -> Affine:
    return {name: -value for name, value in entry.items()}


@dataclass(frozen=True, eq=False)
class FixedParameters:
    """The functions of a structure, of those parameters that are not fixed.

    Attributes
    ----------
    parent : GrayBoxStructure
        Its `system_matrix`, `jacobian` and `curvature` take all parameters.
    values : ndarray of shape (n_params of the parent,)
        All parameters; those that are not fixed are replaced.
    free : ndarray of bool
    """

    parent: Any
    values: Array
    free: NDArray[np.bool_]

    def _all(self, theta: Array) -> Array:
        full = self.values.astype(np.result_type(self.values, theta))
        full[self.free] = theta
        return full

    def __call__(self, theta: Array) -> Blocks:
        """Matrices A, B, C, D."""
        return blocks(self.parent.system_matrix(self._all(theta)), self.parent.order)

    def jacobian(self, theta: Array) -> Blocks:
        """Their derivatives by the free parameters."""
        S = self.parent.jacobian(self._all(theta))[self.free]
        return blocks(S, self.parent.order)

    def curvature(self, theta: Array) -> Array:
        """Second derivatives of ``[[A, B], [C, D]]`` by the free parameters."""
        return self.parent.curvature(self._all(theta))[self.free][:, self.free]
