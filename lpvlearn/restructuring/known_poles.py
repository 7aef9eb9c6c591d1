r"""Integrators and other poles that black box and structure share: divided out.

With :math:`G = C (sI - A)^{-1} B + D` and a pole p of it that no parameter moves, the
error :math:`G(\theta) - G_0` is infinite there unless the residues agree. A weight

.. math:: w(s) = \frac{s - p}{s - q} = 1 + \frac{q - p}{s - q}

on every output that shows the pole makes it finite: s / (s + c) for an integrator, with
c the slowest rate of the rest, and of size one at all frequencies for p > 0, where
q = -p. The realisation of w behind G has states (x, z), ``z' = q z + (C x)_shown``.
Where ``A V = p V``, the directions

    N = [V; (C V)_shown / (p - q)],    [A, 0; C_shown, q] N = p N,

are seen by no output, for ``C V + (q - p) N_z = 0``: they are left out, and the pole
with them, exactly. Where V and the outputs that it moves are fixed entries, N holds for
all parameters, and the divided system matrix is ``left S(theta) right + constant``. A
pole that is left, as the second one of a double integrator, is divided out likewise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, eig, qr

from ..structures.map import framed
from ..structures.structure import GrayBoxStructure
from ..validation import real_array
from .error_system import Target, laplace_variable

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Flags = NDArray[np.bool_]

_DRAWS = 3  # random parameters at which a pole must be, to be there for all
_FIXED = 1e-10  # relative singular value or difference that is rounding of a structure
_CLEAN = 1e-12  # entry of a unit eigenvector that is rounding
_SHARED = 1e-6  # the same of a black box, whose pole is one of several rounded numbers
_NEAR = 0.05  # distance of a pole, relative to c, that is an estimate of a known one
_CHAINED = 1e-3  # cosine of left and right eigenvectors: of a chain it is zero
_STEPS = 8  # poles of one value in a chain: more integrators no one has in series


class _Step(NamedTuple):
    """A weight ``(s - pole) / (s - instead)`` on the outputs that are `shown`."""

    pole: float
    instead: float
    shown: Flags


@dataclass(frozen=True)
class Division:
    """Weights that divide known poles out.

    A real pole of a model that is nearer to a known one than a twentieth of c is an
    estimate of it, and moved there: no record tells them apart.
    """

    steps: tuple[_Step, ...]
    dt: float | None

    def weight(self, omega: Array) -> Array | Complex:
        """The weights of the outputs, shape (k, n_outputs, 1)."""
        s = laplace_variable(omega, self.dt)[0][:, None]
        total = np.ones((len(omega), len(self.steps[0].shown)), complex)
        for step in self.steps:
            own = (s - step.pole) / (s - step.instead)
            total = np.where(step.shown, total * own, total)
        return total[:, :, None]

    def lacks(self, model: Target) -> bool:
        """Whether a model has not all of the poles, nor estimates of them."""
        own = np.linalg.eigvals(model.A)
        for step in self.steps:
            c = abs(step.instead - step.pole)
            near = np.sum((own.imag == 0) & (np.abs(own - step.pole) <= _NEAR * c))
            if near < sum(other.pole == step.pole for other in self.steps):
                return True
        return False

    def of(self, model: Target) -> Target:
        """The weights behind a model, without those of its poles that they cancel."""
        for step in self.steps:
            model = _snapped(model, step)
            A = model.A
            V = _directions(A, step.pole, _SHARED)
            hidden = np.abs(model.C[~step.shown] @ V).max(0, initial=0.0)
            size = np.abs(model.C).max(initial=0.0)
            V = V[:, hidden <= _SHARED * size]
            S = np.block([[model.A, model.B], [model.C, model.D]])
            left, right, constant = _frame(step, model.C @ V, V, model.B.shape[1])
            S, n = left @ S @ right + constant, left.shape[0] - len(model.C)
            model = Target(S[:n, :n], S[:n, n:], S[n:, :n], S[n:, n:], model.dt)
        return model


def divide(
    structure: GrayBoxStructure,
    boxes: Sequence[Target],
    known_poles: ArrayLike | None,
    slowest: float | None = None,
) -> tuple[GrayBoxStructure, Division | None]:
    """The structure without its known poles, and what divides them out of a model.

    `known_poles` None are those on the axis or beyond that the structure has for all
    parameters. `slowest` is the rate c; None is that of the boxes. Division is None
    where there are none. A ValueError where a pole that is given is not the
    structure's, or its state and its outputs are no fixed entries.
    """
    dt = boxes[0].dt
    thetas = _drawn(structure)
    poles = _fixed_poles(structure, thetas, dt)
    if known_poles is not None:
        given = np.unique(real_array("known_poles", known_poles))
        poles = [float(pole) for pole in given]
        _check(poles, dt)
    if not poles:
        return structure, None
    c = _slowest(boxes, poles, _blocks(structure, thetas[0])[0], slowest)
    steps: list[_Step] = []
    for pole in poles:
        rate = pole if dt is None else float(np.log(pole)) / dt
        back = -rate if rate > _FIXED * c else -c
        instead = back if dt is None else float(np.exp(back * dt))
        for number in range(_STEPS):
            matrices = [_blocks(structure, theta) for theta in thetas]
            V = _directions(matrices[0][0], pole, _FIXED)
            if V.shape[1] == 0:
                if number == 0:
                    raise ValueError(
                        f"`known_poles` must be poles of `structure` for all of its "
                        f"parameters. Got {pole:g}, which is none: write the state of "
                        "the pole with fixed entries, as an integrator x1' = x2 with "
                        "row [0, 1, ...] of A."
                    )
                break
            CV = matrices[0][1] @ V
            for A, C in matrices[1:]:
                moved = np.abs(A @ V - pole * V).max() > _FIXED * np.abs(A).max()
                if moved or np.abs(C @ V - CV).max() > _FIXED * np.abs(C).max():
                    raise ValueError(
                        f"the pole at {pole:g} that `structure` has for all parameters "
                        "must have a state and outputs of fixed entries. Got ones that "
                        "depend on parameters. Scale its state so that the entries of "
                        "C are numbers, and put the gain into B."
                    )
            shown = np.abs(CV).max(1) > _FIXED * np.abs(CV).max()
            step = _Step(pole, instead, np.asarray(shown))
            frame = _frame(step, CV, V, structure.n_inputs)
            order = frame[0].shape[0] - structure.n_outputs
            structure = structure.with_map(order, framed(structure.map, *frame))
            steps.append(step)
    return structure, Division(tuple(steps), dt)


def integrators(structure: GrayBoxStructure) -> int:
    """How many chains of poles at zero the structure has for all parameters.

    The rates of outputs that integrate have one pole less of each.
    """
    thetas = _drawn(structure)
    if not thetas or 0.0 not in _fixed_poles(structure, thetas, None):
        return 0
    return _directions(_blocks(structure, thetas[0])[0], 0.0, _FIXED).shape[1]


def _multiplicity(A: Array, pole: float) -> int:
    """How often a matrix has an eigenvalue, one of a chain as it splits."""
    own = np.linalg.eigvals(A)
    near = np.sqrt(_FIXED) * max(float(np.abs(own).max()), 1e-300)
    return int((np.abs(own - pole) <= near).sum())


def _frame(
    step: _Step, CV: Array, V: Array, n_inputs: int
) -> tuple[Array, Array, Array]:
    """``left, right, constant`` of the weights behind a model, without directions V."""
    n, p, gain = len(V), len(CV), step.instead - step.pole
    E = np.eye(p)[step.shown]
    r = len(E)
    series = np.block(
        [
            [np.eye(n), np.zeros((n, p))],
            [np.zeros((r, n)), E],
            [np.zeros((p, n)), np.eye(p)],
        ]
    )
    inputs = block_diag(np.eye(n), np.zeros((0, r)), np.eye(n_inputs))
    constant = np.zeros((n + r + p, n + r + n_inputs))
    constant[n : n + r, n : n + r] = step.instead * np.eye(r)
    constant[n + r :, n : n + r] = gain * E.T
    # coordinates of the states in which N stands alone, one original state each
    N = np.vstack([V, E @ CV / -gain])
    own = qr(V.T, mode="r", pivoting=True)[1][: V.shape[1]]
    rest = np.setdiff1d(np.arange(n + r), own)
    out = np.eye(n + r)[rest]
    if own.size:
        out[:, own] -= np.linalg.solve(N[own].T, N[rest].T).T
    back = np.eye(n + r)[:, rest]
    left, right = block_diag(out, np.eye(p)), block_diag(back, np.eye(n_inputs))
    return left @ series, inputs @ right, left @ constant @ right


def _directions(A: Array, pole: float, tolerance: float) -> Array:
    """Eigenvectors of a real pole, (n, k); a pole of a chain has one of them."""
    if len(A) == 0:
        return np.zeros((0, 0))
    _, s, Vt = np.linalg.svd(A - pole * np.eye(len(A)))
    size = max(float(np.linalg.norm(A, 2)), abs(pole), 1e-300)
    V = np.asarray(Vt[s <= tolerance * size].T)
    if tolerance > _FIXED:
        return V
    # in bad units a pole may be small beside others: row by row it is none
    V = np.where(np.abs(V) > _CLEAN, V, 0.0)
    terms = np.abs(A) @ np.abs(V) + abs(pole) * np.abs(V)
    rest = np.abs(A @ V - pole * V)
    return V[:, (rest <= _FIXED * terms).all(0)]


def _snapped(model: Target, step: _Step) -> Target:
    """A model with its pole near a known one moved there, where none is there yet.

    Of outputs that do not show the pole its part is left out, where that is little: it
    is of the estimate. Poles of a chain are left as they are.
    """
    A, B, C = model.A, model.B, model.C
    if len(A) == 0:
        return model
    poles, W, V = eig(A, left=True)
    away = np.where(poles.imag == 0, np.abs(poles - step.pole), np.inf)
    i = int(np.argmin(away))
    v, w = V[:, i].real, W[:, i].real
    c = abs(step.instead - step.pole)
    if not away[i] <= _NEAR * c or abs(w @ v) <= _CHAINED:
        return model
    mode = np.outer(v, w) / (w @ v)
    if _directions(A, step.pole, _SHARED).shape[1] == 0:
        A = A + (step.pole - poles[i].real) * mode
    hidden = ~step.shown
    G = np.linalg.solve((step.pole + 1j * c) * np.eye(len(A)) - A, B)
    part = np.linalg.norm(C[hidden] @ mode @ B) / c
    if part <= _NEAR * np.linalg.norm(C[hidden] @ G + model.D[hidden]):
        C = np.where(hidden[:, None], C - C @ mode, C)
    return Target(A, B, C, model.D, model.dt)


def _blocks(structure: GrayBoxStructure, theta: Array) -> tuple[Array, Array]:
    """A and C."""
    S, n = structure.map.system_matrix(theta), structure.order
    return S[:n, :n], S[n:, :n]


def _drawn(structure: GrayBoxStructure) -> list[Array]:
    """Random parameters within the bounds: none is zero, nor the same twice."""
    rng = np.random.default_rng(0)
    lower, upper = structure.lower, structure.upper
    guess = np.ones(structure.n_params)
    if structure.initial is not None:
        guess = np.where(structure.initial == 0, 1.0, structure.initial)
    width = np.minimum(0.2 * (upper - lower), 1.0)
    found: list[Array] = []
    for _ in range(10 * _DRAWS):
        factor = np.exp(0.3 * rng.normal(size=len(guess)))
        theta = guess * factor
        theta = np.where(theta <= lower, lower + width * factor, theta)
        theta = np.where(theta >= upper, upper - width * factor, theta)
        theta = np.clip(theta, lower, upper)
        if np.isfinite(structure.map.system_matrix(theta)).all():
            found.append(theta)
        if len(found) == _DRAWS:
            break
    return found


def _fixed_poles(
    structure: GrayBoxStructure, thetas: list[Array], dt: float | None
) -> list[float]:
    """Real poles on the axis or beyond that the structure has at all parameters."""
    border = 0.0 if dt is None else 1.0
    if structure.order == 0 or not thetas:
        return []
    matrices = [_blocks(structure, theta)[0] for theta in thetas]
    poles = np.linalg.eigvals(matrices[0])
    beyond = poles.real[(poles.imag == 0) & (poles.real > border)]
    return [
        pole
        for pole in dict.fromkeys([border, *map(float, beyond)])
        if all(_directions(A, pole, _FIXED).shape[1] for A in matrices)
    ]


def _check(poles: list[float], dt: float | None) -> None:
    border, name = (0.0, "zero") if dt is None else (1.0, "one")
    for pole in poles:
        if not (np.isfinite(pole) and pole >= border):
            raise ValueError(
                f"`known_poles` must be real, and {name} or more: stable ones need no "
                f"care. Got {pole:g}."
            )


def _slowest(
    boxes: Sequence[Target], known: list[float], A: Array, given: float | None
) -> float:
    """Least rate of the other poles of black boxes; one where there are none.

    As many as the A of a structure has at a known pole are left out, the nearest ones.
    """
    if given is not None:
        return given
    dt, found = boxes[0].dt, []
    for box in boxes:
        poles = np.linalg.eigvals(box.A).astype(complex)
        for pole in known:
            near = np.argsort(np.abs(poles - pole), kind="stable")
            poles = poles[near[_multiplicity(A, pole) :]]
        found.append(poles if dt is None else np.log(poles[poles != 0]) / dt)
    size = np.abs(np.concatenate(found))
    size = size[size > 0]
    return float(size.min()) if size.size else 1.0
