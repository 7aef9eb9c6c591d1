"""Implicit equations as structures: equations of motion, descriptor forms.

Physics writes ``M(theta) X = N(theta)`` with M and N affine in the parameters; the
system matrix ``S = offset + W X`` is affine only where M holds no parameter. Its
derivatives follow from those of the equations: ``M X_i = N_i - M_i X``.

Equations ``E(theta) x' = A x + B u`` are such ones, in the state x. Read as a balance
of fluxes, ``d(E x)/dt = A x + B u``, their state is ``z = E x`` (momenta of a mass
matrix), and S is a quotient from the other side, ``[[A, B], [C, D]] diag(E, I)^-1``.
Without a change of E they are the same model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..validation import matrix, one_of
from .map import AffineMap, Rows, StructureMap, mirrored
from .templates import Affine, affine_arrays, check_shapes, parse_cells, system_cells

Array = NDArray[np.float64]

# Reciprocal condition number below which a mass matrix counts as singular: fewer than
# three digits of the accelerations would be left.
_SINGULAR = 1e-13


@dataclass(frozen=True, eq=False)
class ImplicitMap(StructureMap):
    """``S = offset + W X`` with ``M(theta) X = N(theta)``, M and N affine.

    Of equations of motion, ``X [x; u]`` are the accelerations. M and N hold their
    constant part, then the part of every parameter.
    """

    M: Array  # (1 + n_params, n_dof, n_dof)
    N: Array  # (1 + n_params, n_dof, order + n_inputs)
    W: Array  # (order + n_outputs, n_dof)
    offset: Array  # (order + n_outputs, order + n_inputs)
    order: int
    name: str = "M"  # of M, to the user

    @property
    def shape(self) -> tuple[int, ...]:
        return self.offset.shape

    def _solved(self, theta: Array) -> tuple[Array, Array]:
        """``M^-1`` and ``X``; NaN where M is singular, for a search to step back."""
        M = self.M[0] + np.tensordot(theta, self.M[1:], 1)
        N = self.N[0] + np.tensordot(theta, self.N[1:], 1)
        try:
            inverse = np.linalg.inv(M)
        except np.linalg.LinAlgError:
            inverse = np.full_like(M, np.nan)
        return inverse, inverse @ N

    def system_matrix(self, theta: Array) -> Array:
        with np.errstate(all="ignore"):
            return self.offset + self.W @ self._solved(theta)[1]

    def jacobian(self, theta: Array) -> Array:
        inverse, X = self._solved(theta)
        return self.W @ inverse @ (self.N[1:] - self.M[1:] @ X)

    def curvature(self, theta: Array) -> Array:
        """``M X_ij = -M_i X_j - M_j X_i``."""
        inverse, X = self._solved(theta)
        first = inverse @ (self.N[1:] - self.M[1:] @ X)
        product = self.M[1:][:, None] @ first[None]
        return -self.W @ inverse @ (product + product.swapaxes(0, 1))

    def fix(self, values: Array, free: NDArray[np.bool_]) -> AffineMap | ImplicitMap:
        keep, known = np.r_[True, free], values * ~free
        M, N = (
            np.concatenate([X[:1] + np.tensordot(known, X[1:], 1), X[1:]])[keep]
            for X in (self.M, self.N)
        )
        return replace(self, M=M, N=N).simplest()

    def select(self, rows: Rows) -> ImplicitMap:
        return replace(self, W=self.W[rows], offset=self.offset[rows])

    def simplest(self) -> AffineMap | ImplicitMap:
        """The same map, affine where M holds no parameter; then it must be regular."""
        if self.M[1:].any():
            return self
        if not 1.0 / np.linalg.cond(self.M[0]) > _SINGULAR:
            raise ValueError(
                f"`{self.name}` must be regular: a coordinate without mass is no "
                f"state. Got {self.M[0].tolist()}."
            )
        S = self.W @ np.linalg.solve(self.M[0], self.N) + 0.0  # no negative zeros
        return AffineMap(self.offset + S[0], S[1:])

    def natural_sizes(self, rate: float, gains: Array) -> Array:
        """Positive sizes of the parameters that make all terms of an equation alike.

        States move at `rate` (1 / s); `gains` (n_outputs, n_inputs) are sizes of the
        response. Least squares of logarithms: those of ``|T_k| theta_k z_j`` are to be
        that of the level of their row of ``M X = N [x; u]``, for z of X, x and u, and
        terms of ``offset [x; u] + W X`` those of ``rate x`` and y. What these leave
        open is near one.
        """
        (q, dof, _), n = self.M.shape, self.order
        outputs = gains.max(1, initial=0.0)
        seen = outputs > 0.0
        effects = (gains[seen] / outputs[seen, None]).max(0, initial=0.0)
        inputs = 1.0 / np.where(effects > 0.0, effects, 1.0)  # that outputs show alike
        # logarithms of parameters, X, x and levels of the rows: those that are unknown
        eye = np.eye(q - 1 + 2 * dof + n)
        theta = np.vstack([0.0 * eye[:1], eye[: q - 1]])
        z, level = eye[q - 1 :], eye[q - 1 + dof + n :]
        z = np.vstack([z[: dof + n], np.zeros((len(inputs), len(eye)))])
        T = np.concatenate([self.M, self.N], axis=2)
        k, i, j = np.nonzero(T)
        rows = [theta[k] + z[j] - level[i]]
        of_inputs = np.concatenate([np.zeros(dof + n), np.log(inputs)])
        values = [-np.log(np.abs(T[k, i, j])) - of_inputs[j]]
        moved = np.vstack([z[dof : dof + n], np.zeros((len(outputs), len(eye)))])
        sizes = np.log(np.concatenate([np.full(n, rate), np.where(seen, outputs, 1.0)]))
        T = np.hstack([self.W, self.offset[:, :n]])
        i, j = np.nonzero(T * np.concatenate([np.ones(n), seen])[:, None])
        rows.append(z[j] - moved[i])
        values.append(sizes[i] - np.log(np.abs(T[i, j])))
        # stacked outputs say no more than those of one
        found = np.column_stack([np.vstack(rows), np.concatenate(values)])
        found = np.unique(found, axis=0)
        logs = np.linalg.lstsq(found[:, :-1], found[:, -1], rcond=None)[0]
        return np.asarray(np.exp(logs[: q - 1]))

    def regular_point(self, lower: Array, upper: Array) -> Array:
        """Parameters that bring M near the identity, so that S exists there.

        Mirrored at bounds that they are beyond.
        """
        q, n = len(self.M) - 1, len(self.M[0])
        target = (np.eye(n) - self.M[0]).ravel()
        theta = np.linalg.lstsq(self.M[1:].reshape(q, -1).T, target, rcond=None)[0]
        rng = np.random.default_rng(0)
        # all points are regular but those of a curve; a few tries around one miss it
        for candidate in (theta, np.ones(q), *rng.uniform(0.5, 2.0, (8, q))):
            candidate = mirrored(candidate, lower, upper)
            M = self.M[0] + np.tensordot(candidate, self.M[1:], 1)
            if 1.0 / np.linalg.cond(M) > _SINGULAR:
                return candidate
        raise ValueError(
            f"`{self.name}` must be regular for some parameters within the bounds. Got "
            "a template that is singular for all; a coordinate without mass is no "
            "state."
        )


@dataclass(frozen=True, eq=False)
class FluxMap(StructureMap):
    """S in the state ``z = E x`` of equations ``d(E x)/dt = A x + B u``."""

    equations: ImplicitMap  # in the state x
    transposed: ImplicitMap  # of S^T, which is a quotient from the left

    @property
    def shape(self) -> tuple[int, ...]:
        return self.equations.shape

    def system_matrix(self, theta: Array) -> Array:
        return self.transposed.system_matrix(theta).T

    def jacobian(self, theta: Array) -> Array:
        return self.transposed.jacobian(theta).swapaxes(-1, -2)

    def curvature(self, theta: Array) -> Array:
        return self.transposed.curvature(theta).swapaxes(-1, -2)

    def fix(self, values: Array, free: NDArray[np.bool_]) -> AffineMap | FluxMap:
        return _flux_of(
            self.equations.fix(values, free), self.transposed.fix(values, free)
        )

    def select(self, rows: Rows) -> FluxMap:
        N, offset = self.transposed.N[:, :, rows], self.transposed.offset[:, rows]
        turned = replace(self.transposed, N=N, offset=offset)
        return FluxMap(self.equations.select(rows), turned)


def _flux_of(
    equations: AffineMap | ImplicitMap, transposed: AffineMap | ImplicitMap
) -> AffineMap | FluxMap:
    if isinstance(transposed, AffineMap):  # E holds no parameter
        offset, basis = transposed.offset, transposed.basis
        return AffineMap(offset.T.copy(), basis.swapaxes(1, 2).copy())
    assert isinstance(equations, ImplicitMap)
    return FluxMap(equations, transposed)


def _quotient(E: Array, S: Array) -> ImplicitMap:
    """``diag(E, I)^-1 S``; constant parts, then those of the parameters."""
    order, (q, rows, columns) = E.shape[1], S.shape
    M = np.zeros((q, rows, rows))
    M[0] = np.eye(rows)
    M[:, :order, :order] = E
    return ImplicitMap(M, S, np.eye(rows), np.zeros((rows, columns)), order, "E")


def descriptor_map(
    E: Any,
    A: Any,
    B: Any,
    C: Any,
    D: Any,
    descriptor: str,
    parameter_names: Sequence[str] | None,
) -> tuple[AffineMap | FluxMap | ImplicitMap, list[str]]:
    """Descriptor equations, see `GrayBoxStructure.from_template`; parameter names."""
    one_of("descriptor", descriptor, ("rate", "flux"))
    n, system = system_cells(A, B, C, D)
    given = {"E": parse_cells("E", E)}
    check_shapes(given, {"E": (n, n)}, "`A`")
    none: list[list[Affine]] = [[{"": 0.0}] * n for _ in system[n:]]
    rows = zip([*given["E"], *none], system, strict=True)
    offset, basis, names = affine_arrays([e + s for e, s in rows], parameter_names)
    stacked = np.concatenate([offset[None], basis])
    left, S = stacked[:, :n, :n], stacked[:, :, n:]
    equations = _quotient(left, S)
    if descriptor == "rate":
        return equations.simplest(), names
    transposed = _quotient(left.swapaxes(1, 2), S.swapaxes(1, 2))
    return _flux_of(equations, transposed.simplest()), names


def mechanical_map(
    M: Any,
    D: Any,
    K: Any,
    F: Any,
    outputs: str,
    state: str,
    sensors: ArrayLike | None,
    parameter_names: Sequence[str] | None,
) -> tuple[AffineMap | FluxMap | ImplicitMap, list[str]]:
    """Equations of motion, see `GrayBoxStructure.mechanical`; and parameter names."""
    one_of("outputs", outputs, ("position", "velocity", "acceleration"))
    one_of("state", state, ("rate", "momentum"))
    if state == "momentum" and outputs == "acceleration":
        raise ValueError(
            "`outputs` must be 'position' or 'velocity' with state='momentum': of a "
            "mass that varies, the acceleration is no function of the momenta and the "
            "forces alone. Got 'acceleration'; take state='rate'."
        )
    given = {"M": M, "D": D, "K": K, "F": F}
    cells = {name: parse_cells(name, block) for name, block in given.items()}
    n, m = len(cells["M"]), len(cells["F"][0]) if cells["F"] else 0
    if n == 0 or m == 0:
        raise ValueError(
            "`M` and `F` must describe at least one coordinate and one input. Got "
            f"{n} and {m}."
        )
    square = dict.fromkeys("MDK", (n, n))
    check_shapes(cells, square | {"F": (n, m)}, "`M` and `F`")
    H = np.eye(n) if sensors is None else matrix("sensors", sensors)
    if H.shape[1] != n or len(H) == 0:
        raise ValueError(
            f"`sensors` must have {n} columns, one for each coordinate. Got shape "
            f"{H.shape}."
        )
    # M q'' = -K q - D q' + F u
    blocks = zip(cells["M"], cells["K"], cells["D"], cells["F"], strict=True)
    rows = [[*mass, *k, *d, *force] for mass, k, d, force in blocks]
    offset, basis, names = affine_arrays(rows, parameter_names)
    stacked = np.concatenate([offset[None], basis])
    mass, rest = (part.copy() for part in np.split(stacked, [n], axis=2))
    rest[:, :, : 2 * n] = 0.0 - rest[:, :, : 2 * n]  # no negative zeros
    p = len(H)
    W, fixed = np.zeros((2 * n + p, n)), np.zeros((2 * n + p, 2 * n + m))
    W[n : 2 * n] = np.eye(n)
    fixed[:n, n : 2 * n] = np.eye(n)
    if outputs == "acceleration":
        W[2 * n :] = H
    else:
        first = 0 if outputs == "position" else n
        fixed[2 * n :, first : first + n] = H
    equations = ImplicitMap(mass, rest, W, fixed, 2 * n)
    if state == "rate":
        return equations.simplest(), names
    E, S = np.zeros((len(mass), 2 * n, 2 * n)), np.zeros((len(mass), *fixed.shape))
    E[0], S[0] = np.eye(2 * n), fixed
    E[:, n:, n:], S[:, n : 2 * n] = mass, rest
    transposed = _quotient(E.swapaxes(1, 2), S.swapaxes(1, 2))
    return _flux_of(equations, replace(transposed, name="M").simplest()), names
