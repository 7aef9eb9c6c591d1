"""Which parameters of a structure may change places, for no response tells them apart.

The modes of a modal form, lags in series, an actuator and a sensor: a permutation pi of
the parameters with ``G(pi theta) = G(theta)`` for all theta. Where all parameters are
equal every such permutation keeps the point, and so it keeps the derivatives of the
response there,

    dG_pi(i) = dG_i,    d2G_pi(i)pi(j) = d2G_ij.

It is an automorphism of the graph whose vertices and edges have these values for
colours. A search with backtracking finds them all; which of them hold elsewhere, too,
random parameters tell.

Where theta follows a scheduling variable they may be told apart. The states of G(theta)
and G(pi theta) are related by a matrix T(theta). If it is the same at all points, the
LPV model is one model, as of modes of which one is called the first. Else a state that
is carried from one point to the next becomes another one: what inputs at a point i do
to the outputs at a point k, the product of the observability operator there and the
controllability operator here, is ``O_k T_k^-1 T_i C_i`` in place of ``O_k C_i``.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_sylvester

if TYPE_CHECKING:
    from .structure import GrayBoxStructure

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Places = NDArray[np.intp]

_EQUALS = (1.0, 0.5, 2.0)  # common values of all parameters, until one gives a model
_STEP = 1e-4  # of the first derivatives' central differences
_COLOUR = 1e-5  # relative difference of equal second derivatives: their truncation
_SAME = 1e-8  # relative difference of equal responses: rounding
_MOST = 720  # permutations that are found at most: those of six parts
_STEPS = 50_000  # of the search, after which the rest is left out
_AWAY = np.array([0.7 + 0.4j, 1.9 - 1.1j, 0.3 + 2.3j])  # where, times a rate of A
_OUTSIDE = 1e3  # weight of what lies outside of a range
_RATES = 1e-12  # those of A relative to its size that are not zero
_SLOWEST = 1e-3  # rate at which what is remembered fades at least, of the fastest one
_WIDE, _GRID = 10.0, 60  # beyond the rates of a model, and frequencies to look at
_PLACES = 12  # operating points that are compared at most

INTERCHANGE = "interchange"  # the kind of warnings of parts that one model leaves alike


def interchanges(structure: GrayBoxStructure) -> Places:
    """Permutations of the parameters that change no response, shape (k, n_params).

    The identity is the first. ``theta[interchanges(structure)]`` are the parameters of
    one model. Where there are more than 720 they are not all found.

    Examples
    --------
    Two lags in series, whose order no response shows:

    >>> from lpvlearn import GrayBoxStructure
    >>> lags = GrayBoxStructure.from_template(
    ...     A=[["-a", 0], [1, "-b"]], B=[["g"], [0]], C=[[0, 1]])
    >>> interchanges(lags)
    array([[0, 1, 2],
           [1, 0, 2]])
    """
    return _interchanges(structure, np.ones((structure.n_params,) * 2, dtype=bool))


def exchangeable(structure: GrayBoxStructure, theta: Array, guess: Array) -> list[str]:
    """Names of parameters whose values could be those of one another.

    No response, bound or `guess` (n_params,; NaN where nothing is known) tells them
    apart. Names that differ in their digits alone are but numbered.
    """
    kinds = np.array([re.sub(r"\d+", "", name) for name in structure.parameter_names])
    places = _interchanges(structure, kinds[:, None] != kinds)
    images = theta[places[as_plausible(structure, theta[None], places, guess)]]
    moved = (images != theta).any(axis=0)
    return [structure.parameter_names[j] for j in np.flatnonzero(moved)]


def as_plausible(
    structure: GrayBoxStructure, family: Array, places: Places, guess: Array
) -> NDArray[np.bool_]:
    """Which of `places` (k, n_params) bounds and `guess` tell from none of the others.

    Of the parameters at all points, `family` (n_points, n_params), as they are.
    """
    images = family[:, places].swapaxes(0, 1)
    far = distance(structure, images, guess)
    return within_bounds(structure, images) & np.isclose(far, far[0])


def within_bounds(structure: GrayBoxStructure, images: Array) -> NDArray[np.bool_]:
    """Which families (k, n_points, n_params) keep to the bounds."""
    inside = (images >= structure.lower) & (images <= structure.upper)
    return np.asarray(inside.all(axis=(1, 2)))


def told_by_motion(structure: GrayBoxStructure, family: Array, places: Places) -> Array:
    """How much interchanges change what one point remembers of another one, (k,).

    The largest over the points of `family` (n_points, n_params): difference of the
    operators from past inputs to outputs after a jump, relative to them, in the
    Hilbert-Schmidt norm. Zero for changes of the states that are the same everywhere.
    """
    n = structure.order
    few = np.linspace(0, len(family) - 1, min(len(family), _PLACES)).round().astype(int)
    family = family[few]
    size = _channel_sizes(structure.system_matrix(family[len(family) // 2]), n)
    own = [_fading(structure.system_matrix(row) / size, n) for row in family]
    before = _energies(own, own)
    change = np.zeros(len(places))
    for i, pi in enumerate(places):
        if (family[:, pi] == family).all():
            continue
        other = [_fading(structure.system_matrix(row[pi]) / size, n) for row in family]
        after, across = _energies(other, other), _energies(own, other)
        most = np.maximum(before, after)
        gap = before + after - 2.0 * across
        gap = np.divide(gap, most, out=np.zeros_like(gap), where=most > 0.0)
        change[i] = np.sqrt(max(float(gap.max()), 0.0))
    return change


def known_before(structure: GrayBoxStructure, init: Any) -> Array:
    """What is known of the parameters before a fit, NaN of the others.

    `init` is that of `GrayBoxRestructurer`: parameters, or how to find some.
    """
    if init is not None and not isinstance(init, str):
        return structure.check_params(init, name="init")
    ranged = ~np.isnan(structure.ranges[0])
    known = ranged | (structure.initial is not None)
    guess = np.where(ranged, structure.ranges.mean(0), structure.reference)
    return np.where(known, guess, np.nan)


def distance(structure: GrayBoxStructure, images: Array, guess: Array) -> Array:
    """How far families (..., n_points, n_params) are from a guess, relative to it.

    What is outside of the ranges of the structure is farther than anything within.
    """
    size = np.where(guess != 0, np.abs(guess), 1.0)
    low, high = structure.ranges
    outside = np.fmax(low - images, images - high)  # NaN where there is no range
    away = np.abs(images - guess) + _OUTSIDE * np.where(outside > 0.0, outside, 0.0)
    return np.asarray(np.nansum(away / size, axis=(-2, -1)))


def _interchanges(
    structure: GrayBoxStructure, of_interest: NDArray[np.bool_]
) -> Places:
    """All, if two parameters `of_interest` (n_params, n_params) look exchangeable."""
    q = structure.n_params
    nothing = np.arange(q)[None]
    found = _automorphisms(structure, of_interest)
    if len(found) < 2:
        return nothing
    rng = np.random.default_rng(0)
    for _ in range(2):
        theta = np.exp(0.5 * rng.normal(size=q))
        here = _response(structure, theta)
        if not np.isfinite(here).all():
            continue
        most = _SAME * np.abs(here).max(axis=(1, 2), keepdims=True)
        found = [
            pi
            for pi in found
            if (np.abs(_response(structure, theta[pi]) - here) <= most).all()
        ]
    return np.array(found) if found else nothing


def slow_first(structure: GrayBoxStructure, family: Array, places: Places) -> Array:
    """How far interchanges (k, n_params) bring slower parts to earlier parameters, (k,)

    Where in frequency (logarithm, a mean over `family`) the response shows a parameter,
    times its number: of two modes the slower one is the first.
    """
    n, q = structure.order, structure.n_params
    center = np.zeros(q)
    for theta in family:
        rates = np.abs(np.linalg.eigvals(structure.system_matrix(theta)[:n, :n]))
        rates = rates[rates > _RATES * rates.max(initial=0.0)]
        if rates.size:
            omega = np.geomspace(rates.min() / _WIDE, rates.max() * _WIDE, _GRID)
            slopes = _slopes(structure, theta, 1j * omega).reshape(q, _GRID, -1)
            power = (np.abs(slopes) ** 2).sum(2)
            total = power.sum(1)
            mean = power @ np.log(omega) / np.where(total > 0.0, total, 1.0)
            center += np.where(np.isfinite(mean), mean, 0.0)
    return np.asarray(center[places] @ np.arange(q))


def _fading(S: Array, n: int) -> tuple[Array, Array, Array]:
    """A, B, C; A shifted so that the Gramians exist, which changes no T."""
    poles = np.linalg.eigvals(S[:n, :n])
    slowest = poles.real.max(initial=-np.inf) + _SLOWEST * np.abs(poles).max(initial=0)
    return S[:n, :n] - max(slowest, 0.0) * np.eye(n), S[:n, n:], S[n:, :n]


def _channel_sizes(S: Array, n: int) -> Array:
    """What brings a system matrix to inputs and outputs of like sizes, by division."""
    A, B, C = _fading(S, n)
    rows, columns = np.ones(S.shape[0]), np.ones(S.shape[1])
    moved = np.einsum("ij,jk,ik->i", C, solve_sylvester(A, A.T, -B @ B.T), C)
    rows[n:] = np.sqrt(np.where(moved > 0.0, moved, 1.0))
    C = C / rows[n:, None]
    moves = np.einsum("ji,jk,ki->i", B, solve_sylvester(A.T, A, -C.T @ C), B)
    columns[n:] = np.sqrt(np.where(moves > 0.0, moves, 1.0))
    return rows[:, None] * columns


def _energies(
    one: list[tuple[Array, Array, Array]], other: list[tuple[Array, Array, Array]]
) -> Array:
    """``<O_k C_i, O'_k C'_i>`` of two families of models for all k, i."""
    pairs = list(zip(one, other, strict=True))
    X = [solve_sylvester(A.T, F, -C.T @ H) for (A, _, C), (F, _, H) in pairs]
    Y = [solve_sylvester(F, A.T, -G @ B.T) for (A, B, _), (F, G, _) in pairs]
    return np.einsum("kab,iba->ki", np.array(X), np.array(Y))


def _frequencies(S: Array, order: int) -> Complex:
    """Complex frequencies about as large as the rates of a model, off its poles."""
    size = np.linalg.norm(S[:order, :order]) / max(np.sqrt(order), 1.0)
    return np.asarray(_AWAY * (size if size > 0 else 1.0))


def _response(structure: GrayBoxStructure, theta: Array) -> Complex:
    """G at complex frequencies that depend on what no permutation changes."""
    n, (rows, columns) = structure.order, structure.map.shape
    S = structure.system_matrix(theta)
    nothing = np.full((1, rows - n, columns - n), np.nan + 0j)
    if not np.isfinite(S).all():
        return nothing
    level = structure.system_matrix(np.full(len(theta), float(np.mean(theta))))
    if not np.isfinite(level).all():
        return nothing
    s = _frequencies(level, n)
    rates = np.abs(np.linalg.eigvals(level[:n, :n]))
    slow = rates[rates > _RATES * np.abs(s).max()]  # where what is slow is seen, too
    s = np.concatenate([s, *np.multiply.outer(slow, _AWAY)])
    M = s[:, None, None] * np.eye(n) - S[:n, :n]
    G = S[n:, :n] @ np.linalg.solve(M, S[:n, n:] + 0j) + S[n:, n:]
    return np.asarray(G)


def _slopes(structure: GrayBoxStructure, theta: Array, s: Complex) -> Complex:
    """Derivatives of the response at complex frequencies, shape (n_params, ...)."""
    n, q = structure.order, structure.n_params
    S, dS = structure.system_matrix(theta), structure.jacobian(theta)
    Phi = np.linalg.inv(s[:, None, None] * np.eye(n) - S[:n, :n])
    rows, columns = (np.tile(np.eye(k - n), (len(s), 1, 1)) for k in S.shape)
    L = np.concatenate([S[n:, :n] @ Phi, rows], 2)
    R = np.concatenate([Phi @ S[:n, n:], columns], 1)
    dG = L[:, None] @ dS @ R[:, None]  # (k, q, n_outputs, n_inputs)
    return np.asarray(dG.swapaxes(0, 1).reshape(q, -1))


def _automorphisms(
    structure: GrayBoxStructure, of_interest: NDArray[np.bool_]
) -> list[Places]:
    """Permutations that keep both derivatives where all parameters are equal.

    The identity is the first; nothing where no such point gives a model, or where no
    two parameters `of_interest` (n_params, n_params) have the same first ones.
    """
    q = structure.n_params
    for value in _EQUALS:
        theta = np.full(q, value)
        S = structure.system_matrix(theta)
        if np.isfinite(S).all():
            break
    else:
        return []
    s = _frequencies(S, structure.order)
    first = _slopes(structure, theta, s)
    alike = _equal(first[:, None], first[None])
    if not (alike & of_interest)[~np.eye(q, dtype=bool)].any():
        return []  # each of them has a colour of its own
    second = np.array(
        [
            _slopes(structure, theta + d, s) - _slopes(structure, theta - d, s)
            for d in _STEP * value * np.eye(q)
        ]
    )
    second = (second + second.swapaxes(0, 1)) / np.abs(second).max(initial=1e-300)
    own = second[np.arange(q), np.arange(q)]
    alike &= np.abs(own[:, None] - own[None]).max(2) <= _COLOUR
    found: list[Places] = []
    left = _STEPS

    def extend(pi: list[int]) -> None:
        nonlocal left
        i = len(pi)
        if i == q:
            found.append(np.array(pi, dtype=np.intp))
            return
        for j in np.flatnonzero(alike[i]).tolist():
            if j in pi:
                continue
            left -= 1
            if left < 0 or len(found) == _MOST:
                return
            gaps = np.abs(second[i, :i] - second[j, pi])
            if gaps.max(initial=0.0) <= _COLOUR:
                extend([*pi, j])

    extend([])  # in ascending order: the identity comes first
    return found


def _equal(a: Complex, b: Complex) -> NDArray[np.bool_]:
    size = max(float(np.abs(a).max()), 1e-300)
    return np.asarray(np.abs(a - b).max(-1) <= _COLOUR * size)
