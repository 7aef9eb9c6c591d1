"""How the frequency response moves, and bends, with the parameters.

The coefficients of a structure are seldom good coordinates: along a straight line in
them the response soon leaves its tangent. Most of that bend lies within the tangent
space and belongs to the coordinates alone. A step along a geodesic of the response,

    theta + d + a / 2,   J a = -(the tangential part of G''[d, d]),

is free of it, and reaches much further along a curved valley (the geodesic
acceleration of Transtrum and Sethna, 2012, for Newton's method).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..models.system_matrix import blocks
from ..systems.balancing import balancing_transformation
from ..systems.least_squares import column_scale
from .error_system import ErrorSystem, Target, derivatives
from .least_squares import fit_frequency_response
from .limits import Limits, within_bounds
from .similarity import (
    linear_equations,
    mean_rate,
    nearest_parameters,
    scaled_problem,
    transformed,
)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Directions that the response sees a thousand times less than others are steps of
# that length all the same: further along them its second derivative takes over.
_METRIC_CAP = 1e-3
_FIT_CAP = 1e-5  # the same for the H2 norm, whose steps are straight
# A unit step is no longer than that, relative to a parameter (or one): at a flat point,
# as q = 0 of q^2, its derivative would ask for one without end.
_FARTHEST = 1e8
_REACH = 2.0  # change of the logarithm of a distance to a bound in a unit step
_DAMPING = 1e-5  # of the acceleration along directions that the response hardly sees
_BENT = 1.0  # part of a step that its bend may be at most
_EXACT = 1e-7  # relative residual of a realisation in a canonical form
_REFINEMENTS = 10  # steps that give such parameters their digits: three will mostly do
_SEARCHED = 100  # the same where they are those of a model nearby
_NUDGE = 1e-2  # relative change of all entries that makes a model a generic one
_MINIMAL = 1e-4  # least share of the faintest state: beyond, models are no manifold
_SAME_NORM = 1e-5  # relative difference that rounding may make: 3e-7 for 24 states


def metric_coordinates(J: Complex, size: float) -> Array:
    """`T` with which a step y changes the response by ``size |y|`` (root mean square).

    `J` holds the derivatives of the response, (k, n_outputs, n_inputs, n_params).
    Directions that it does not see (unidentifiable ones) are capped, in units in which
    all parameters count alike.
    """
    flat = J.reshape(-1, J.shape[3]) / np.sqrt(len(J))
    R = np.asarray(np.linalg.qr(np.vstack([flat.real, flat.imag]), mode="r"))
    unit = _units(np.linalg.norm(R, axis=0))
    _, s, Vt = np.linalg.svd(R / unit)
    s = np.maximum(s, _FIT_CAP * s.max(initial=0.0))
    s = np.where(s > 0, s, 1.0)
    return Vt.T * (size / s) / unit[:, None]


def _units(lengths: Array) -> Array:
    """Lengths of columns, those that are zero as the longest."""
    longest = max(float(lengths.max(initial=0.0)), 1e-300)
    return np.where(lengths > 0, lengths, longest)


def real_form(E: Complex) -> Array:
    """Real parts of the entries of matrices, and their imaginary parts after these.

    Shape (k, 2 n_outputs n_inputs, ...) of errors (k, n_outputs, n_inputs, ...).
    """
    k, p, m = E.shape[:3]
    flat = E.reshape(k, p * m, *E.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)


class ResponseGeometry:
    """Response at one theta, its derivatives, and coordinates of its metric.

    A unit step in y, ``theta + T y``, changes the response at the frequencies `omega`
    by `size` (root mean square), and the logarithms whose gradients are the rows of
    `pull` (those of distances to bounds) by less than about `_REACH`. `S` holds the
    derivatives of the system matrix, `L` that of the point `at` behind the weight, and
    `changes` those of the error, ``L S_j R``, as `real_form` has them: (k, 2 n_outputs
    n_inputs, n_params).
    """

    def __init__(
        self,
        system: ErrorSystem,
        theta: Array,
        omega: Array,
        size: float,
        pull: Array | None = None,
    ) -> None:
        structure, self.n = system.structure, system.n
        self.at = system.point(theta, omega)
        self.S = structure.jacobian(theta)
        self._bend = structure.curvature(theta)
        self.L = system.weight_response(omega)[0] @ self.at.L
        k, p, _ = self.L.shape
        q, m = len(self.S), self.at.R.shape[2]
        self._shape = (k, p, m)
        self._scale = size * np.sqrt(k)
        self.changes = real_form(derivatives(self.L, self.S, self.at.R))
        J = self.changes.reshape(-1, q)
        metric = gram = J.T @ J / self._scale**2
        if pull is not None:
            metric = metric + pull.T @ pull / _REACH**2
        unit = _units(np.sqrt(np.diag(metric)))
        unit = np.maximum(unit, 1.0 / (_FARTHEST * np.maximum(np.abs(theta), 1.0)))
        squares, V = np.linalg.eigh(metric / unit / unit[:, None])
        s = np.sqrt(np.maximum(squares, _METRIC_CAP**2 * squares.max(initial=1.0)))
        self.T = V / s / unit[:, None]
        self.inverse = (V * s).T * unit
        self._gram = self.T.T @ gram @ self.T + _DAMPING * np.eye(q)

    def _solve(self, g: Array) -> Array:
        return np.asarray(np.linalg.solve(self._gram, g))

    def change(self, d: Array) -> Complex:
        """Change of the error along a step `d`, (k, n_outputs, n_inputs)."""
        return self._complex(self.changes @ (self.T @ d))

    def pulled(self, V: Complex) -> Array:
        """``Re sum_k tr(V_k^H dE_j)`` in y, for a covector V of the response."""
        J = self.changes.reshape(-1, self.changes.shape[2])
        return np.asarray(self.T.T @ (real_form(V).ravel() @ J))

    def acceleration(self, d: Array) -> Array:
        """Second derivative, in y, of the geodesic that leaves in the direction `d`."""
        v, n, at = self.T @ d, self.n, self.at
        S = np.tensordot(v, self.S, axes=1)
        second = 2.0 * (self.L @ S[:, :n]) @ at.Phi @ (S[:n] @ at.R)
        if self._bend is not None:
            bend = np.tensordot(v, np.tensordot(v, self._bend, axes=1), axes=1)
            second = second + self.L @ bend @ at.R
        return -self._solve(self.pulled(second) / self._scale**2)

    def tangential(self, gradient: Array) -> Complex:
        """The covector of the response with that gradient in y and no normal part.

        As ``P = R V^H L``, shape (k, n + n_inputs, n + n_outputs), for the covector V.
        """
        step = self.T @ self._solve(gradient) / self._scale**2
        V = self._complex(self.changes @ step)
        return self.at.R @ V.conj().swapaxes(1, 2) @ self.L

    def _complex(self, V: Array) -> Complex:
        real, imag = np.split(V, 2, axis=1)
        return np.asarray(real + 1j * imag).reshape(self._shape)

    def second_derivatives(self, P: Complex) -> Array:
        """``Re sum_k tr(V_k^H d2E_ij)`` in y, for a covector as ``P = R V^H L``.

        ``d2E_ij = L S_i Phi S_j R``, its mirror image, and what bends the structure.
        """
        q, n = len(self.S), self.n
        k, b, a = P.shape
        flat = np.concatenate([P.real, P.imag]).reshape(2 * k, b * a)
        Phi = np.concatenate([self.at.Phi.real, -self.at.Phi.imag])
        Phi = Phi.reshape(2 * k, n * n)
        span = row_space(Phi, n)
        mixed = flat.T @ Phi if span is None else (flat.T @ (Phi @ span)) @ span.T
        mixed = mixed.reshape(b, a, n, n).transpose(1, 2, 3, 0).reshape(a * n, n * b)
        H = self.S[:, :, :n].reshape(q, -1) @ mixed @ self.S[:, :n].reshape(q, -1).T
        H = H + H.T
        if self._bend is not None:
            H = H + np.tensordot(self._bend, np.real(P.sum(0)).T, axes=2)
        return self.T.T @ H @ self.T


def row_space(Phi: Array, n: int) -> Array | None:
    """Orthonormal columns that span the rows of `Phi`, where that saves work.

    The real and imaginary parts of resolvents of one matrix A of order n are
    polynomials of A, of which n are independent.
    """
    k, rank = len(Phi), n + 8
    if 4 * rank > min(Phi.shape):
        return None
    mixture = np.cos(np.outer(np.arange(1, rank + 1), np.arange(k)) ** 2)
    return np.linalg.qr((mixture @ Phi).T)[0]


class Geodesics:
    """Geodesics of the response through one theta, in coordinates ``theta + T d``."""

    def __init__(self, system: ErrorSystem, theta: Array, T: Array) -> None:
        self._geometry = ResponseGeometry(system, theta, system.grid, 1.0)
        self._system, self._theta, self._T = system, theta, T
        self._inverse = np.linalg.inv(T)
        self._local = self._geometry.inverse @ T

    def step(self, d: Array) -> Array:
        """End of the geodesic that leaves along `d`, within the parameters' bounds."""
        local = self._local @ d
        a = self._geometry.acceleration(local)
        most = _BENT * float(np.linalg.norm(local))
        a *= min(1.0, most / max(float(np.linalg.norm(a)), 1e-300))
        end = self._theta + self._T @ d + 0.5 * self._geometry.T @ a
        return self._inverse @ (within_bounds(self._system, end) - self._theta)

    def curvature(self, gradient: Array) -> Array:
        """What the bend of the geodesics adds to a Hessian of that gradient."""
        local = self._geometry.T.T @ (self._inverse.T @ gradient)
        normal = -self._geometry.tangential(local)
        return self._local.T @ self._geometry.second_derivatives(normal) @ self._local


class LocalChart:
    """The models near one, as an affine structure; zero is that model.

    From the system matrix `S` of a stable model; where it is not minimal, no
    neighbourhood of it is smooth: ValueError. `feedthrough`: whether D is free.
    """

    is_affine = True

    def __init__(self, S: Array, order: int, dt: float | None, feedthrough: bool):
        n = self.order = order
        A, B, C, D = blocks(S, n)
        hankel, left, right = balancing_transformation(A, B, C, discrete=dt is not None)
        if len(left) < n or hankel[-1] <= _MINIMAL * hankel[0]:
            raise ValueError("the model is not minimal, or nearly so.")
        A, B, C = left @ A @ right, left @ B, C @ right
        self.offset = np.block([[A, B], [C, D]])
        # in units of time and gain in which all entries are about one
        rate, size = _rate(A, dt), np.sqrt(np.linalg.norm(B) * np.linalg.norm(C))
        unit = np.ones_like(self.offset)
        unit[:n, :n], unit[:n, n:], unit[n:, :n] = rate, size, size
        changes = unit * _without_basis_changes(self.offset / unit, n)
        if feedthrough:
            direct = np.zeros((D.size, *S.shape))
            direct[:, n:, n:] = np.eye(D.size).reshape(-1, *D.shape)
            changes = np.concatenate([changes, direct])
        self.basis = changes
        self.n_params = len(changes)
        self.lower = np.full(self.n_params, -np.inf)
        self.upper = np.full(self.n_params, np.inf)

    def system_matrix(self, theta: Array) -> Array:
        """``[[A, B], [C, D]]``."""
        return np.asarray(self.offset + np.tensordot(theta, self.basis, axes=1))

    def jacobian(self, theta: Array) -> Array:
        """Its derivatives, the same everywhere."""
        return self.basis

    def curvature(self, theta: Array) -> Array | None:
        """None: the chart is affine."""
        return None


def _rate(A: Array, dt: float | None) -> float:
    return 1.0 if dt is not None else mean_rate(np.abs(np.linalg.eigvals(A)))


def _without_basis_changes(S: Array, n: int) -> Array:
    """Orthonormal changes of (A, B, C) that are orthogonal to ``(XA - AX, XB, -CX)``.

    Shape (n (n_inputs + n_outputs), n + n_outputs, n + n_inputs).
    """
    A, B, C, _ = blocks(S, n)
    orbit = np.zeros((n, n, *S.shape))
    for i in range(n):
        for j in range(n):
            change = orbit[i, j]
            change[i, :n] += A[j]
            change[:n, j] -= A[:, i]
            change[i, n:] = B[j]
            change[n:, j] = -C[:, i]
    entries = np.ones(S.shape, bool)
    entries[n:, n:] = False
    orbit = orbit.reshape(n * n, *S.shape)[:, entries]
    Q = np.linalg.qr(orbit.T, mode="complete")[0][:, n * n :]
    changes = np.zeros((Q.shape[1], *S.shape))
    changes[:, entries] = Q.T
    return changes


class CanonicalForm:
    """An affine structure in which every model of its order has its own parameters."""

    def __init__(self, structure: Any, dt: float | None) -> None:
        self.structure, self.dt = structure, dt
        n, shape = structure.order, structure.offset.shape
        n_outputs, n_inputs = shape[0] - n, shape[1] - n
        self.feedthrough = structure.n_params > n * (n_inputs + n_outputs)

    @classmethod
    def of(cls, system: ErrorSystem, theta: Array) -> CanonicalForm | None:
        """The form, where the structure is one: told by models near that of `theta`."""
        structure: Any = system.structure
        if not getattr(structure, "is_affine", False) or structure.order == 0:
            return None
        n, p, m = structure.order, system.n_outputs, system.n_inputs
        free_D = int((structure.basis[:, n:, n:] != 0).any(0).sum())
        size = n * (m + p) + free_D
        bounded = np.isfinite([structure.lower, structure.upper]).any()
        if bounded or structure.n_params != size or free_D not in (0, m * p):
            return None
        form = cls(structure, system.dt)
        S = structure.system_matrix(theta)
        inside = np.ones(S.shape, bool)
        inside[n:, n:] = False
        nudge = _NUDGE * np.cos(np.arange(S.size).reshape(S.shape) ** 2)
        near = S * np.where(inside, 1.0 + nudge, 1.0)
        return None if form.parameters(near) is None else form

    def parameters(self, S: Array, exact: float = _EXACT) -> Array | None:
        """Those of the model with that system matrix; None where it has none.

        Of a form that many models are nearly not in, those of one at a relative
        distance of `exact`.
        """
        n, structure = self.structure.order, self.structure
        # Outputs of like size: what is left of a solution is rounded by the largest.
        unit = np.ones((len(S), 1))
        unit[n:, 0] = column_scale(S[n:, :n].T)
        model = Target.of(S / unit, n, self.dt)
        rate = _rate(model.A, self.dt)
        offset, basis = structure.offset / unit, structure.basis / unit
        problem = scaled_problem(model, offset, basis, rate)
        M, b = linear_equations(problem)
        if len(b) < n * n:
            return None
        T = np.linalg.lstsq(M, b, rcond=None)[0].reshape(n, n)
        try:
            d = transformed(problem, T[None])[0]
        except np.linalg.LinAlgError:
            return None
        flat = problem.basis.reshape(structure.n_params, -1)
        if (np.count_nonzero(flat, axis=0) <= 1).all():
            # of their own entries, however much larger others are
            theta = flat @ d[0] / np.sum(flat**2, axis=1)
        else:
            theta = nearest_parameters(problem, d)[0]
        rest = d[0] - theta @ flat
        near = np.linalg.norm(rest) <= exact * np.linalg.norm(d)
        return theta if near else None

    def refined(
        self,
        S: Array,
        omega: Array,
        exact: float = _EXACT,
        max_iter: int = _REFINEMENTS,
    ) -> Array | None:
        """The same, fitted to the model's response once more.

        A realisation of 24 states has lost all but three of the digits, of which the
        form holds seven.
        """
        theta = self.parameters(S, exact)
        if theta is None:
            return None
        fit = fit_frequency_response(
            ErrorSystem(self.structure, Target.of(S, self.structure.order, self.dt)),
            theta,
            omega,
            admissible=lambda x: bool(np.isfinite(x).all()),
            max_iter=max_iter,
        )
        return theta if fit is None else fit.x


@dataclass(frozen=True)
class View:
    """A point of the problem, in coordinates that suit it.

    Those are the parameters themselves, or, of a canonical form, a chart of the models
    around one.
    """

    outer: ErrorSystem  # of the structure
    form: CanonicalForm | None
    system: ErrorSystem  # of the coordinates
    theta: Array  # the point, in these
    limits: Limits

    @classmethod
    def of(
        cls,
        system: ErrorSystem,
        theta: Array,
        limits: Limits,
        form: CanonicalForm | None = None,
    ) -> View:
        """The parameters of the structure, around which a chart may be laid."""
        return cls(system, form, system, theta, limits)

    def at(self, theta: Array) -> View:
        """Another point, in the same coordinates."""
        return replace(self, theta=theta)

    def centred(self) -> View:
        """The same point, at zero of the chart around it where there is one."""
        if self.form is None:
            return self
        order, dt = self.form.structure.order, self.form.dt
        try:
            chart = LocalChart(self._matrix(), order, dt, self.form.feedthrough)
        except (ValueError, np.linalg.LinAlgError):
            return self
        if chart.n_params != len(self.theta):  # the basis changes are not independent
            return self
        inner = self.outer.restructured(chart)
        limits = Limits(inner, self.limits.margin)
        zero = np.zeros(chart.n_params)
        return replace(self, system=inner, theta=zero, limits=limits)

    def back(self) -> View | None:
        """The same point by its parameters; None where the form has none for it."""
        if self.form is None or self.system is self.outer:
            return self
        found = self.form.refined(self._matrix(), self.outer.grid)
        if found is None:
            return None
        there = self.outer.peaks(found).norm
        here = self.system.peaks(self.theta).norm
        near = abs(there - here) <= _SAME_NORM * here
        return self._outside(found, self.form) if near else None

    def beside(self, known: Array) -> View:
        """Of a point in a chart that has no way `back`: parameters, and no more charts.

        Those of the nearest model that has some, or the `known` ones, by the norm.
        """
        assert self.form is not None
        near = self.form.refined(self._matrix(), self.outer.grid, np.inf, _SEARCHED)
        there = self._outside(known, None)
        if near is None or not there.limits.strict(near):
            return there
        return there.at(min(known, near, key=lambda x: self.outer.peaks(x).norm))

    def _matrix(self) -> Array:
        return self.system.structure.system_matrix(self.theta)

    def _outside(self, theta: Array, form: CanonicalForm | None) -> View:
        limits = Limits(self.outer, self.limits.margin)
        return View.of(self.outer, theta, limits, form)
