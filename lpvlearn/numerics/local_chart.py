"""Coordinates for structures that hold every model of their order.

A canonical form has all models in it, and coefficients for parameters. These are the
worst of coordinates: poles depend on them as roots do. The set of models itself is
smooth. Near one model it is described by the changes of a balanced realisation that no
change of the state basis could make (data-driven local coordinates, McKelvey,
Helmersson and Ribarits, 2004); the parameters are found again from the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .balancing import balancing_transformation
from .limits import Limits
from .matching import ErrorSystem
from .similarity import linear_equations, nearest_parameters, scaled_problem

Array = NDArray[np.float64]

_EXACT = 1e-7  # relative residual of a realisation in a canonical form
_NUDGE = 1e-2
_MINIMAL = 1e-4  # least share of the faintest state: beyond, models are no manifold
_SAME_NORM = 1e-7  # relative difference that rounding may make


class LocalChart:
    """The models near one, as an affine structure; zero is that model.

    Parameters
    ----------
    S : ndarray of shape (order + n_outputs, order + n_inputs)
        System matrix of a stable, minimal model.
    order : int
    dt : float or None
    feedthrough : bool
        Whether D is free.

    Raises
    ------
    ValueError
        If the model is not minimal: no neighbourhood of it is smooth.
    """

    is_affine = True

    def __init__(self, S: Array, order: int, dt: float | None, feedthrough: bool):
        n = self.order = order
        A, B, C, D = S[:n, :n], S[:n, n:], S[n:, :n], S[n:, n:]
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
    poles = np.abs(np.linalg.eigvals(A))
    poles = poles[poles > 0]
    if dt is not None or poles.size == 0:
        return 1.0
    return float(np.exp(np.log(poles).mean()))


def _without_basis_changes(S: Array, n: int) -> Array:
    """Orthonormal changes of (A, B, C) that are orthogonal to ``(XA - AX, XB, -CX)``.

    Shape (n (n_inputs + n_outputs), n + n_outputs, n + n_inputs).
    """
    A, B, C = S[:n, :n], S[:n, n:], S[n:, :n]
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
    """An affine structure in which every model of its order has its own parameters.

    Parameters
    ----------
    structure : GrayBoxStructure
    dt : float or None
    """

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

    def parameters(self, S: Array) -> Array | None:
        """Those of the model with that system matrix; None where it has none."""
        n, structure = self.structure.order, self.structure
        A, B, C, D = S[:n, :n], S[:n, n:], S[n:, :n], S[n:, n:]
        problem = scaled_problem(
            A, B, C, D, structure.offset, structure.basis, _rate(A, self.dt)
        )
        M, b = linear_equations(problem)
        if len(b) < n * n:
            return None
        T = np.linalg.lstsq(M, b, rcond=None)[0].reshape(n, n)
        try:
            inverse = np.linalg.inv(T)
        except np.linalg.LinAlgError:
            return None
        new = np.block(
            [[T @ problem.A @ inverse, T @ problem.B], [problem.C @ inverse, problem.D]]
        )
        d = new - problem.offset
        theta = nearest_parameters(problem, d.reshape(1, -1))[0]
        rest = d - np.tensordot(theta, problem.basis, axes=1)
        exact = np.linalg.norm(rest) <= _EXACT * np.linalg.norm(d)
        return theta if exact else None


@dataclass(frozen=True)
class View:
    """The problem near one point, in coordinates that suit it.

    Attributes
    ----------
    system : ErrorSystem
    theta : ndarray of shape (n_params,)
        The point.
    limits : Limits
    back : callable
        Coordinates to parameters of the structure, or None where these do not exist.
    """

    system: ErrorSystem
    theta: Array
    limits: Limits
    back: Callable[[Array], Array | None]


def view_at(
    system: ErrorSystem, theta: Array, limits: Limits, form: CanonicalForm | None
) -> View:
    """The structure's own parameters, or a chart around the model of a canonical form.

    Parameters
    ----------
    form : CanonicalForm or None
    """
    plain = View(system, theta, limits, lambda x: x)
    if form is None:
        return plain
    S = form.structure.system_matrix(theta)
    try:
        chart = LocalChart(S, form.structure.order, form.dt, form.feedthrough)
    except (ValueError, np.linalg.LinAlgError):
        return plain
    if chart.n_params != len(theta):  # the basis changes are not independent
        return plain
    inner = system.restructured(chart)

    def back(z: Array) -> Array | None:
        found = form.parameters(chart.system_matrix(z))
        if found is None:
            return None
        there, here = system.peaks(found).norm, inner.peaks(z).norm
        return found if abs(there - here) <= _SAME_NORM * here else None

    return View(inner, np.zeros(chart.n_params), Limits(inner, limits.margin), back)
