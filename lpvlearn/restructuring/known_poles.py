r"""Poles on the axis or beyond that black box and structure share: divided out.

With :math:`G = C (sI - A)^{-1} B + D` and a pole p of it that no parameter moves, the
error :math:`G(\theta) - G_0` is infinite there unless the residues agree. A weight

.. math:: w(s) = \frac{s - p}{s - q}, \qquad
    w(s) = \frac{(s - p)(s - \bar p)}{(s - q)(s - \bar q)}
    \text{ of a pair,}

on every output that shows the pole makes it finite. On the axis q = p - c, with c the
distance to the nearest other pole, and \|p\| at most: s / (s + c) for an integrator,
:math:`(s^2 + \omega_0^2) / ((s + c)^2 + \omega_0^2)` for an undamped oscillator. Beyond
it :math:`q = -\bar p`, of size one at all frequencies. In discrete time this holds for
the logarithms. The realisation of w behind G has states (x, z),

    z' = Q z + b (C x)_shown,   y_shown = (C x)_shown + h z,   P = Q - b h,

P and Q companion matrices of numerator and denominator. Where ``A V = p V`` and
``P e = p e``, ``h e = -1``, the directions

    N = [V; e (C V)_shown],    [A, 0; b C_shown, Q] N = p N,

are seen by no output, for ``(C V)_shown + h N_z = 0``: they are left out, and the pole
with them, exactly; those of a pair by their real and imaginary parts. Where V and the
outputs that it moves are fixed entries, N holds for all parameters, and the divided
system matrix is ``left S(theta) right + constant``. A pole that is left, as the second
one of a double integrator, is divided out likewise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import (
    block_diag,
    companion,
    eig,
    matrix_balance,
    null_space,
    qr,
    schur,
    solve_sylvester,
)

from ..structures.map import framed
from ..structures.structure import GrayBoxStructure
from ..systems.balancing import balancing_transformation
from ..systems.response import pole_rates
from ..validation import complex_array
from .error_system import Target, frequency_grid, laplace_variable

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Flags = NDArray[np.bool_]

_DRAWS = 3  # random parameters at which a pole must be, to be there for all
_TINY = np.finfo(float).tiny

_FIXED = 1e-10  # relative singular value or difference that is rounding of a structure
_ROUNDED = 1e-6  # relative error of the eigenvalues of a chain, which rounding splits
_CLEAN = 1e-12  # entry of a unit eigenvector that is rounding
_SHARED = 1e-6  # the same of a black box, whose pole is one of several rounded numbers
_NEAR = 0.05  # distance of a pole, relative to c, that is an estimate of a known one
_BESIDE = 0.5  # part of that distance at which frequencies tell of an estimate only
_CHAINED = 1e-3  # cosine of left and right eigenvectors: of a chain it is zero
_STEPS = 8  # poles of one value in a chain: more integrators no one has in series


class _Step(NamedTuple):
    """A weight ``(s - pole) / (s - instead)`` on the outputs that are `shown`.

    A pole above the real axis stands for a pair.
    """

    pole: complex
    instead: complex
    shown: Flags
    n_directions: int  # that it hides

    @property
    def near(self) -> float:
        """Distance up to which a pole is an estimate of this one."""
        return _NEAR * abs(self.instead - self.pole)


@dataclass(frozen=True)
class Division:
    """Weights that divide known poles out.

    A pole of a model that is nearer to a known one than a twentieth of c is an estimate
    of it, and moved there: few records tell them apart.
    """

    steps: tuple[_Step, ...]
    dt: float | None

    def weight(self, omega: Array) -> Array | Complex:
        """The weights of the outputs, shape (k, n_outputs, 1)."""
        s = laplace_variable(omega, self.dt)[0][:, None]
        total = np.ones((len(omega), len(self.steps[0].shown)), complex)
        for step in self.steps:
            for p, q in zip(_both(step.pole), _both(step.instead), strict=True):
                total = np.where(step.shown, total * ((s - p) / (s - q)), total)
        return total[:, :, None]

    def apart(self, omega: Array) -> Array:
        """Frequencies that are far from the poles, beside errors of their estimates."""
        s = laplace_variable(omega, self.dt)[0]
        near = [np.abs(s - step.pole) <= _BESIDE * step.near for step in self.steps]
        return omega[~np.any(near, axis=0)]

    def grid(self, model: Target) -> Array:
        """Frequencies that see the other poles of a model, as it is weighted.

        The model may be in discrete time where the structure is not.
        """
        rates = pole_rates(np.linalg.eigvals(model.A), model.dt)
        for step in self.steps:
            p, q = pole_rates(np.array([step.pole, step.instead]), self.dt)
            for known, instead in zip(_both(p), _both(q), strict=True):
                near = np.abs(rates - known) <= _NEAR * abs(p - q)
                rates = np.append(rates[~near], instead)
        return self.apart(frequency_grid(rates, None))

    def lacks(self, model: Target) -> bool:
        """Whether a model has not all of the poles, nor estimates of them."""
        own = np.linalg.eigvals(model.A).astype(complex)
        return any(
            np.sum(_distances(own, chain) <= chain[0].near) < len(chain)
            for chain in self._chains()
        )

    def _chains(self) -> list[list[_Step]]:
        """The steps of every pole."""
        poles = dict.fromkeys(step.pole for step in self.steps)
        return [[step for step in self.steps if step.pole == p] for p in poles]

    def of(self, model: Target) -> Target:
        """The weights behind a model, without those of its poles that they cancel."""
        for chain in self._chains():
            chained = _chained(model, chain)
            model = chained or model
            for step in chain:
                if chained is None:
                    model = _snapped(model, step)
                    V = _directions(model.A, step.pole, _SHARED, step.near)
                else:  # in states of even size
                    own = model.A - step.pole.real * np.eye(len(model.A))
                    V = np.linalg.svd(own)[2][-step.n_directions :].T
                hidden = np.abs(model.C[~step.shown] @ V).max(0, initial=0.0)
                size = np.abs(model.C).max(initial=0.0)
                V = V[:, hidden <= _SHARED * size]
                left, right, constant = _frame(step, model.C @ V, V, model.B.shape[1])
                S = left @ model.system_matrix @ right + constant
                model = Target.of(S, left.shape[0] - len(model.C), model.dt)
        return model


def divide(
    structure: GrayBoxStructure,
    dt: float | None,
    boxes: Sequence[Target],
    known_poles: ArrayLike | None = None,
    slowest: float = np.inf,
) -> tuple[GrayBoxStructure, Division | None]:
    """The structure without its known poles, and what divides them out of a model.

    `dt` is that of the structure; `boxes` may be in discrete time where it is not.
    `known_poles` None are those on the axis or beyond that the structure has for all
    parameters. `slowest` is the most that c may be. Division is None where there are
    none. A ValueError where a pole that is given is not the structure's, or its state
    and its outputs are no fixed entries.
    """
    thetas = _drawn(structure)
    poles = _fixed_poles(structure, thetas, dt)
    if known_poles is not None:
        poles = _read(known_poles, dt)
    if not poles:
        return structure, None
    whole = _blocks(structure, thetas[0])[0]
    steps: list[_Step] = []
    for pole in poles:
        instead = -pole.conjugate() if dt is None else 1.0 / pole.conjugate()
        if _on_axis(np.array(pole), dt):
            rate = complex(pole_rates(np.array(pole), dt))
            count = len(whole) - len(_without(whole, pole))
            c = _nearest(boxes, rate, count, slowest)
            instead = pole - c if dt is None else pole * float(np.exp(-c * dt))
        for number in range(_STEPS):
            matrices = [_blocks(structure, theta) for theta in thetas]
            V = _directions(matrices[0][0], pole, _FIXED)
            if V.shape[1] == 0:
                if number == 0:
                    raise ValueError(
                        f"`known_poles` must be poles of `structure` for all of its "
                        f"parameters. Got {pole:.10g}, which is none: write the state "
                        "of the pole with fixed entries, as an integrator x1' = x2 "
                        "with row [0, 1, ...] of A."
                    )
                break
            CV = matrices[0][1] @ V
            for A, C in matrices[1:]:
                moved = np.abs(A @ V - pole * V).max() > _FIXED * np.abs(A).max()
                if moved or np.abs(C @ V - CV).max() > _FIXED * np.abs(C).max():
                    raise ValueError(
                        f"the pole at {pole:.10g} that `structure` has for all "
                        "parameters must have a state and outputs of fixed entries. "
                        "Got ones that depend on parameters. Scale its state so that "
                        "the entries of C are numbers, and put the gain into B."
                    )
            shown = np.abs(CV).max(1) > _FIXED * np.abs(CV).max()
            step = _Step(pole, instead, np.asarray(shown), V.shape[1])
            frame = _frame(step, CV, V, structure.n_inputs)
            order = frame[0].shape[0] - structure.n_outputs
            structure = structure.with_map(order, framed(structure.map, *frame))
            steps.append(step)
    return structure, Division(tuple(steps), dt)


def integrators(structure: GrayBoxStructure) -> int:
    """How many chains of poles at zero the structure has for all parameters.

    The rates of outputs that integrate have one pole less of each.
    """
    return _directions(_integrating(structure), 0.0, _FIXED).shape[1]


def poles_at_zero(structure: GrayBoxStructure) -> int:
    """How many poles at zero the structure has for all parameters, chains and all."""
    A = _integrating(structure)
    return len(A) - len(_without(A, 0.0))


def _integrating(structure: GrayBoxStructure) -> Array:
    """An A of a structure with a pole at zero for all parameters; empty without one."""
    thetas = _drawn(structure)
    if not thetas or 0.0 not in _fixed_poles(structure, thetas, None):
        return np.zeros((0, 0))
    return _blocks(structure, thetas[0])[0]


def hidden_integrators(structure: GrayBoxStructure) -> int:
    """How many of them no output shows, or no input reaches, for all parameters.

    As positions where rates are measured and no spring pulls: no record has them.
    """
    n, thetas = structure.order, _drawn(structure)

    def lost(theta: Array) -> list[int]:
        S = structure.map.system_matrix(theta)
        S = S / np.maximum(np.linalg.norm(S, axis=1, keepdims=True), _TINY)
        T = S.T / np.maximum(np.linalg.norm(S.T, axis=1, keepdims=True), _TINY)
        return [n - int(np.linalg.matrix_rank(M[:, :n], _FIXED)) for M in (S, T)]

    if not (n and thetas):
        return 0
    return int(np.min([lost(theta) for theta in thetas], axis=0).max())


def _without(A: Array, pole: complex) -> Array | Complex:
    """A matrix without one of its eigenvalues, all of a chain: what acts beside it."""
    while (V := _directions(A, pole, _FIXED)).shape[1]:
        W = null_space(V.conj().T)
        A = W.conj().T @ A @ W
    return A


def _frame(
    step: _Step, CV: Array | Complex, V: Array | Complex, n_inputs: int
) -> tuple[Array, Array, Array]:
    """``left, right, constant`` of the weights behind a model, without directions V."""
    # of the scalar weight, in units of time in which its poles are about one
    unit = abs(step.pole) or 1.0
    zeros, poles = (
        np.poly(np.divide(_both(own), unit)).real for own in (step.pole, step.instead)
    )
    Q, h = unit * companion(poles), unit * (zeros - poles)[None, 1:]
    m = len(Q)
    b, e = np.eye(m)[:, :1], (step.pole / unit) ** np.arange(m - 1, -1, -1)[:, None]
    e = -e / (h @ e)
    n, p = len(V), len(CV)
    E = np.eye(p)[step.shown]
    r = m * len(E)
    series = np.block(
        [
            [np.eye(n), np.zeros((n, p))],
            [np.zeros((r, n)), np.kron(E, b)],
            [np.zeros((p, n)), np.eye(p)],
        ]
    )
    inputs = block_diag(np.eye(n), np.zeros((0, r)), np.eye(n_inputs))
    constant = np.zeros((n + r + p, n + r + n_inputs))
    constant[n : n + r, n : n + r] = np.kron(np.eye(len(E)), Q)
    constant[n + r :, n : n + r] = np.kron(E.T, h)
    # coordinates of the states in which N stands alone, one original state each
    N = np.vstack([V, np.kron(E @ CV, e)])
    if m > 1:
        N = np.hstack([N.real, N.imag])
    own = qr(N[:n].T, mode="r", pivoting=True)[1][: N.shape[1]]
    rest = np.setdiff1d(np.arange(n + r), own)
    out = np.eye(n + r)[rest]
    if own.size:
        out[:, own] -= np.linalg.solve(N[own].T, N[rest].T).T
    back = np.eye(n + r)[:, rest]
    left, right = block_diag(out, np.eye(p)), block_diag(back, np.eye(n_inputs))
    return left @ series, inputs @ right, left @ constant @ right


def _directions(
    A: Array | Complex, pole: complex, tolerance: float, most: float = np.inf
) -> Array | Complex:
    """Eigenvectors of a pole, (n, k); a pole of a chain has one of them."""
    if len(A) == 0:
        return np.zeros((0, 0))
    A, units = matrix_balance(A, permute=False)  # in bad units, slow poles are small
    _, s, Vt = np.linalg.svd(A - pole * np.eye(len(A)))
    size = max(float(np.linalg.norm(A, 2)), abs(pole), 1e-300)
    V = np.asarray(Vt[s <= min(tolerance * size, most)].conj().T)
    if tolerance <= _FIXED:
        V = np.where(np.abs(V) > _CLEAN, V, 0.0)
        terms = np.abs(A) @ np.abs(V) + abs(pole) * np.abs(V)
        rest = np.abs(A @ V - pole * V)
        V = V[:, (rest <= _FIXED * terms).all(0)]
    V = units @ V
    return V / np.linalg.norm(V, axis=0)


def _snapped(model: Target, step: _Step) -> Target:
    """A model with its pole near a known one moved there, where none is there yet.

    Of outputs that do not show the pole its part is left out, where that is little: it
    is of the estimate. Poles of a chain are left as they are.
    """
    A, B, C = model.A, model.B, model.C
    if len(A) == 0:
        return model
    poles, W, V = eig(A, left=True)
    away = _distances(poles, [step])
    i = int(np.argmin(away))
    v, w = V[:, i], W[:, i].conj()
    if not away[i] <= step.near or abs(w @ v) <= _CHAINED:
        return model
    mode = np.outer(v, w) / (w @ v)
    count = len(_both(step.pole))
    if _directions(A, step.pole, _SHARED, step.near).shape[1] == 0:
        A = A + count * ((step.pole - poles[i]) * mode).real
    moved = Target(A, B, C, model.D, model.dt)
    return _without_part(moved, ~step.shown, C @ mode, step)


def _without_part(
    model: Target, hidden: Flags, part: Array | Complex, step: _Step
) -> Target:
    """A model whose `hidden` outputs do not show a part of C, where that is little."""
    if not hidden.any():
        return model
    A, B, C = model.A, model.B, model.C
    c = step.near / _NEAR
    G = np.linalg.solve((step.pole + 1j * c) * np.eye(len(A)) - A, B)
    size = np.linalg.norm(C[hidden] @ G + model.D[hidden])
    if np.linalg.norm(part[hidden] @ B) / c <= _NEAR * size:
        C = np.where(hidden[:, None], C - len(_both(step.pole)) * part.real, C)
    return Target(A, B, C, model.D, model.dt)


def _chained(model: Target, chain: Sequence[_Step]) -> Target | None:
    """A model with its poles near a real one moved there, into chains as the steps'.

    In states that are theirs, balanced for what changes at the rate c, and the others.
    Of outputs that do not show a part of it that is left out, as in `_snapped`. None
    where the poles are no chain, not as many as the steps divide out, or not seen.
    """
    count, pole, near = sum(s.n_directions for s in chain), chain[0].pole, chain[0].near
    if len(chain) == 1 or pole.imag or len(model.A) < count:
        return None
    p, c = pole.real, near / _NEAR
    R, Z, k = schur(model.A, sort=lambda re, im=0.0: np.hypot(re - p, im) <= near)
    if k != count:
        return None
    own, others = R[:k, :k] - p * np.eye(k), R[k:, k:]
    beside = np.zeros((k, len(others)))
    if len(others):
        beside = solve_sylvester(R[:k, :k], -others, -R[:k, k:])
    Bs, Cs = Z.T @ model.B, model.C @ Z
    B, C = Bs[:k] - beside @ Bs[k:], Cs[:, :k]
    if not (B.any() and C.any()):
        return None
    even = B / np.abs(B).max(), C / np.abs(C).max()  # a gain is none of the states
    T = balancing_transformation(own - c * np.eye(k), *even, discrete=False)
    if len(T.left) < k:
        return None
    own = T.left @ own @ T.right
    Q, number = _staircase(own, [step.n_directions for step in chain])
    later = number[:, None] < number
    A = block_diag(p * np.eye(k) + np.where(later, Q.T @ own @ Q, 0.0), others)
    B = np.vstack([Q.T @ T.left @ B, Bs[k:]])
    C = np.hstack([C @ T.right @ Q, Cs[:, :k] @ beside + Cs[:, k:]])
    model = Target(A, B, C, model.D, model.dt)
    shown = np.zeros(len(C), dtype=bool)
    for place, step in enumerate(chain):
        shown |= step.shown
        states = np.zeros(len(A), dtype=bool)
        states[:k] = number == place
        model = _without_part(model, ~shown, np.where(states, C, 0.0), step)
    return model


def _distances(poles: Complex, chain: Sequence[_Step]) -> Array:
    """Of poles that may be estimates of that of the steps.

    Real ones, or upper ones; of several at one place any.
    """
    pole = chain[0].pole
    alike = np.sign(poles.imag) == np.sign(pole.imag)
    if len(chain) > 1 and not pole.imag:
        alike = np.ones(len(poles), dtype=bool)
    return np.where(alike, np.abs(poles - pole), np.inf)


def _staircase(N: Array, counts: Sequence[int]) -> tuple[Array, NDArray[np.intp]]:
    """What a matrix hardly moves, what it hardly moves beyond that, and so on.

    An orthonormal basis, and the number of each direction in `counts`, which says how
    many there are.
    """
    bases, rest = [], np.eye(len(N))
    for count in counts:
        V = np.linalg.svd(rest.T @ N @ rest)[2].T
        first = V.shape[1] - count
        bases.append(rest @ V[:, first:])
        rest = rest @ V[:, :first]
    return np.hstack(bases), np.repeat(np.arange(len(counts)), counts)


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
) -> list[complex]:
    """Poles on the axis or beyond that the structure has at all parameters.

    Of pairs the upper ones.
    """
    border = 0.0 if dt is None else 1.0
    if structure.order == 0 or not thetas:
        return []
    matrices = [_blocks(structure, theta)[0] for theta in thetas]
    own = np.linalg.eigvals(_without(matrices[0], border)).astype(complex)
    # rounding splits the poles of a chain around their mean
    means = [own[np.abs(own - pole) <= _ROUNDED * abs(pole)].mean() for pole in own]
    beyond = _upper(np.array(means), dt)
    return [
        pole
        for pole in dict.fromkeys([border, *beyond])
        if all(_directions(A, pole, _FIXED).shape[1] for A in matrices)
    ]


def _read(known_poles: ArrayLike, dt: float | None) -> list[complex]:
    """The argument, of pairs the upper ones."""
    given = np.unique(complex_array("known_poles", known_poles))
    fine = np.isfinite(given)
    fine[fine] = _outside(given[fine], dt)
    if not fine.all():
        rule = "real part zero or more" if dt is None else "absolute value one or more"
        raise ValueError(
            f"`known_poles` must be of {rule}: stable ones need no care. Got "
            f"{_plain(given[~fine][0]):.10g}."
        )
    for pole in given:
        if not np.isclose(given, pole.conj(), rtol=_ROUNDED, atol=0.0).any():
            raise ValueError(
                "`known_poles` must hold complex poles in pairs. Got "
                f"{pole:.10g} without {pole.conj():.10g}: add it."
            )
    return _upper(given, dt)


def _upper(poles: Complex, dt: float | None) -> list[complex]:
    """Those on the axis or beyond and not below the real line, without rounding."""
    poles = poles[(poles.imag >= 0) & _outside(poles, dt)]
    at = poles / np.abs(poles) if dt is not None else 1j * poles.imag
    poles = np.where(_on_axis(poles, dt), at, poles)
    return [_plain(pole) for pole in poles.tolist()]


def _plain(pole: complex) -> complex:
    """A real pole as a float."""
    return pole if pole.imag else float(pole.real)


def _both(pole: complex) -> list[complex]:
    """A real pole, or a pair."""
    return [pole, pole.conjugate()] if pole.imag else [pole]


def _on_axis(poles: Complex, dt: float | None) -> Flags:
    rates = pole_rates(poles, dt)
    return np.abs(rates.real) <= _ROUNDED * np.abs(rates)


def _outside(poles: Complex, dt: float | None) -> Flags:
    return (pole_rates(poles, dt).real > 0) | _on_axis(poles, dt)


def _nearest(boxes: Sequence[Target], rate: complex, count: int, most: float) -> float:
    """Distance of a pole to the nearest other one of black boxes, in 1/s.

    At most the size of its rate, or `most`; one where there are none. Poles as many as
    the structure has at this one are left out, the nearest ones.
    """
    found = [most, abs(rate)]
    for box in boxes:
        away = np.abs(pole_rates(np.linalg.eigvals(box.A), box.dt) - rate)
        found += np.sort(away)[count:].tolist()
    c = min(value for value in [*found, np.inf] if value > 0)
    return c if np.isfinite(c) else 1.0
