"""How the frequency response moves, and bends, with the parameters.

The coefficients of a structure are seldom good coordinates: along a straight line in
them the response soon leaves its tangent. Most of that bend lies within the tangent
space and belongs to the coordinates alone. A step along a geodesic of the response,

    theta + d + a / 2,   J a = -(the tangential part of G''[d, d]),

is free of it, and reaches much further along a curved valley (the geodesic
acceleration of Transtrum and Sethna, 2012, for Newton's method).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .matching import ErrorPoint, ErrorSystem

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Directions that the response sees a thousand times less than others are steps of
# that length all the same: further along them its second derivative takes over.
_METRIC_CAP = 1e-3
_FIT_CAP = 1e-5
_REACH = 2.0
_DAMPING = 1e-5  # of the acceleration along directions that the response hardly sees


def metric_coordinates(R: Array, size: float) -> Array:
    """`T` with ``|R T y| = size |y|`` on the directions that `R` sees.

    `R` is the triangular factor of the response Jacobian. Directions that it does not
    see (unidentifiable ones) are capped, in units in which all parameters count alike.
    """
    unit = _units(R)
    _, s, Vt = np.linalg.svd(R / unit)
    s = np.maximum(s, _FIT_CAP * s.max(initial=0.0))
    s = np.where(s > 0, s, 1.0)
    return Vt.T * (size / s) / unit[:, None]


def _units(R: Array) -> Array:
    """Lengths of the columns, not zero."""
    unit = np.linalg.norm(R, axis=0)
    return np.where(unit > 0, unit, max(float(unit.max(initial=0.0)), 1e-300))


class ResponseGeometry:
    """Response at one theta, its derivatives, and coordinates of its metric.

    Parameters
    ----------
    system : ErrorSystem
    theta : ndarray of shape (n_params,)
    omega : ndarray of shape (k,)
        Frequencies, rad/s.
    size : float
        Change of the response (root mean square over frequency) of a unit step.
    G0 : ndarray of shape (k, n_outputs, n_inputs), default=None
        Response that `at` holds the error to; by default zero.
    pull : ndarray of shape (k, n_params), default=None
        Gradients of logarithms that a unit step shall change by less than about
        `_REACH`: those of the distances to bounds.

    Attributes
    ----------
    T, inverse : ndarray of shape (n_params, n_params)
        ``theta + T y``, and back.
    at : ErrorPoint
        Without the weight.
    S : ndarray of shape (n_params, n + n_outputs, n + n_inputs)
        Derivatives of the system matrix.
    L : ndarray of shape (k, n_outputs, n + n_outputs)
        That of `at` behind the weight.
    products : ndarray of shape (k, n_outputs * n_params, n + n_inputs)
        ``L S_j``: the derivatives of the error are ``L S_j R``.
    """

    def __init__(
        self,
        system: ErrorSystem,
        theta: Array,
        omega: Array,
        size: float,
        G0: Complex | None = None,
        pull: Array | None = None,
    ) -> None:
        structure, self.n = system.structure, system.n
        zero = np.zeros((1, system.n_outputs, system.n_inputs), complex)
        self.at: ErrorPoint = system.point(theta, omega, zero if G0 is None else G0)
        self.S = structure.jacobian(theta)
        self._bend = structure.curvature(theta)
        self.L = system.weight_response(omega)[0] @ self.at.L
        k, p, _ = self.L.shape
        q, m = len(self.S), self.at.R.shape[2]
        self._shape = (k, p, m)
        self.products = np.tensordot(self.L, self.S, axes=(2, 1)).reshape(k, p * q, -1)
        J = self.by_parameter(self.products @ self.at.R)
        J = np.concatenate([J.real, J.imag]) / np.sqrt(k)
        metric = J / size
        if pull is not None:
            metric = np.concatenate([metric, pull / _REACH])
        unit = _units(metric)
        metric = metric / unit
        squares, V = np.linalg.eigh(metric.T @ metric)
        s = np.sqrt(np.maximum(squares, _METRIC_CAP**2 * squares.max(initial=0.0)))
        s = np.where(s > 0, s, 1.0)
        self.T = V / s / unit[:, None]
        self.inverse = (V * s).T * unit
        self._J = J @ self.T
        self._gram = self._J.T @ self._J + _DAMPING * size**2 * np.eye(q)

    def by_parameter(self, X: Complex) -> Complex:
        """(k, n_outputs * n_params, m) as (k * n_outputs * m, n_params)."""
        k, p, m = self._shape
        q = len(self.S)
        return X.reshape(k, p, q, m).swapaxes(2, 3).reshape(-1, q)

    def _solve(self, g: Array) -> Array:
        return np.asarray(np.linalg.solve(self._gram, g))

    def acceleration(self, d: Array) -> Array:
        """Second derivative, in y, of the geodesic that leaves in the direction `d`."""
        v, n, at = self.T @ d, self.n, self.at
        S = np.tensordot(v, self.S, axes=1)
        second = 2.0 * (self.L @ S[:, :n]) @ at.Phi @ (S[:n] @ at.R)
        if self._bend is not None:
            bend = np.tensordot(v, np.tensordot(v, self._bend, axes=1), axes=1)
            second = second + self.L @ bend @ at.R
        flat = second.ravel() / np.sqrt(len(second))
        return -self._solve(self._J.T @ np.concatenate([flat.real, flat.imag]))

    def tangential(self, gradient: Array) -> Complex:
        """The covector of the response with that gradient in y and no normal part.

        As ``P = R V^H L``, shape (k, n + n_inputs, n + n_outputs), for the covector V.
        """
        flat = self._J @ self._solve(gradient) / np.sqrt(self._shape[0])
        half = len(flat) // 2
        V = (flat[:half] + 1j * flat[half:]).reshape(self._shape)
        return self.at.R @ V.conj().swapaxes(1, 2) @ self.L

    def second_derivatives(self, P: Complex) -> Array:
        """``Re sum_k tr(V_k^H d2E_ij)`` in y, for a covector as ``P = R V^H L``.

        ``d2E_ij = L S_i Phi S_j R``, its mirror image, and what bends the structure.
        """
        q, n = len(self.S), self.n
        mixed = np.real(np.tensordot(P, self.at.Phi, axes=(0, 0)))  # (b, a, c, d)
        mixed = mixed.transpose(1, 2, 3, 0).reshape(P.shape[2] * n, n * P.shape[1])
        H = self.S[:, :, :n].reshape(q, -1) @ mixed @ self.S[:, :n].reshape(q, -1).T
        H = H + H.T
        if self._bend is not None:
            H = H + np.tensordot(self._bend, np.real(P.sum(0)).T, axes=2)
        return self.T.T @ H @ self.T
