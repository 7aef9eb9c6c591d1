"""The error system of model matching, Eq. (8), and the derivatives of its peaks.

With ``S(theta) = [[A, B], [C, D]]`` and ``Phi = (s I - A)^-1`` the error is
``E = C Phi B + D - G0(s)`` and its derivative, Eq. (24)-(25) in one product,
``dE_j = L S_j R`` with ``L = [C Phi, I]``, ``R = [Phi B; I]``, ``S_j = dS/dtheta_j``.
The largest singular value ``sigma = u^H E v`` is differentiated twice with respect to
the parameters and the frequency together.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..models.system_matrix import blocks
from ..systems.hinf_norm import PeakSet, linf_norm
from ..systems.response import pole_grid, pole_rates, resolvent

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_CONSTANT = 1e-7  # relative change of an error that no parameter changes
_MOVE = 0.1  # of the parameters that tells: far beyond rounding, the same model still

# Parts of the largest parameter: smaller ones move as if they were that. In units that
# fit, zeros may stand for either.
_LEAST_SIZES = (1e-3, 1.0)

_RESPONSE_ROUNDING = 1e-12  # of a response, whose digits the error has lost

# Derivatives of S whose entries are that much fewer than the entries of S, for every
# input, are taken entry by entry: ten times faster for canonical forms of 24 states.
_FEW = 25

# Frequencies between those of the poles, over which responses are smooth; and points
# that are remembered: a search asks for a few, one after another, again and again.
_N_FREQUENCIES, _N_KNOWN = 60, 4

_CACHED = 100_000  # numbers that stay in a cache between two products of matrices

# singular values are told apart down to that fraction of the largest: their gap divides
_GAP = 1e-10


@dataclass(frozen=True)
class Target:
    """A model by its matrices; `dt` None is continuous time."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float | None = None

    @classmethod
    def of(cls, S: Array, order: int, dt: float | None) -> Target:
        """The model of a system matrix."""
        return cls(*blocks(S, order), dt)

    @property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C and D."""
        return self.A, self.B, self.C, self.D

    @property
    def system_matrix(self) -> Array:
        """``[[A, B], [C, D]]``."""
        return np.block([[self.A, self.B], [self.C, self.D]])

    def repeated(self, copies: int) -> Target:
        """The model side by side, once for every channel: block-diagonal."""
        eye = np.eye(copies)
        A, B, C, D = (np.asarray(np.kron(eye, M), float) for M in self.matrices)
        return Target(A, B, C, D, self.dt)


def laplace_variable(
    omega: Array, dt: float | None
) -> tuple[Complex, Complex, Complex]:
    """``s(omega)`` and its two derivatives: ``j omega`` or ``exp(j omega dt)``."""
    if dt is None:
        zero = np.zeros(len(omega), complex)
        s = zero.copy()
        s.imag = omega  # 1j * inf is not a number
        return s, zero + 1j, zero
    z = np.exp(1j * omega * dt)
    return z, 1j * dt * z, -(dt**2) * z


def model_response(model: Target, omega: Array) -> Complex:
    """Frequency response of a model, (k, n_outputs, n_inputs)."""
    s = laplace_variable(omega, model.dt)[0]
    return np.asarray(model.C @ resolvent(model.A, s, model.B) + model.D)


def model_derivatives(model: Target, omega: Array) -> tuple[Complex, Complex, Complex]:
    """Frequency response of a model and its first two derivatives in frequency."""
    s, s1, s2 = laplace_variable(omega, model.dt)
    s1, s2 = s1[:, None, None], s2[:, None, None]
    P = resolvent(model.A, s)
    PB = P @ model.B
    X = P @ PB
    first = -s1 * (model.C @ X)
    second = 2.0 * s1**2 * (model.C @ (P @ X)) - s2 * (model.C @ X)
    return model.C @ PB + model.D, first, second


def series(model: Target, weight: Target) -> Target:
    """Realisation of the weight after a model."""
    n, k = len(model.A), len(weight.A)
    A = np.zeros((n + k, n + k))
    A[:n, :n], A[n:, n:] = model.A, weight.A
    A[n:, :n] = weight.B @ model.C
    B = np.vstack([model.B, weight.B @ model.D])
    C = np.hstack([weight.D @ model.C, weight.C])
    return Target(A, B, C, weight.D @ model.D, model.dt)


def frequency_grid(poles: NDArray, dt: float | None) -> Array:
    """Frequencies (rad/s) that see every pole: logarithmic, and around resonances.

    From `poles` in the time domain of `dt`; ends at the Nyquist frequency.
    """
    rates = pole_rates(poles, dt)
    size = np.abs(rates)
    size = size[size > 0]
    low, high = (size.min(), size.max()) if size.size else (1.0, 1.0)
    if dt is not None:  # poles next to zero are faster than any frequency
        low = min(low, np.pi / dt)
    around = pole_grid(rates, low / 20, high * 10, _N_FREQUENCIES, [-1.0, 0.0, 1.0])
    grid = np.append(around, size)
    if dt is not None:
        grid = grid[grid < np.pi / dt]
    return np.unique(grid[grid > 0])


class Structure(Protocol):
    """What this room needs of a gray-box structure."""

    order: int
    n_params: int

    @property
    def lower(self) -> Array: ...
    @property
    def upper(self) -> Array: ...
    def system_matrix(self, theta: Array) -> Array: ...
    def jacobian(self, theta: Array) -> Array: ...
    def curvature(self, theta: Array) -> Array | None: ...


@dataclass(frozen=True)
class ResponsePoint:
    """The gray-box response at one theta and several frequencies (leading axis k).

    ``dG_j = L S_j R``, and ``Phi = (s I - A)^-1``.
    """

    L: Complex  # (k, n_outputs, n + n_outputs)
    R: Complex  # (k, n + n_inputs, n_inputs)
    G: Complex  # (k, n_outputs, n_inputs), the response
    Phi: Complex  # (k, n, n)


def derivatives(L: Complex, S: Array, R: Complex) -> Complex:
    """``dE_j = L S_j R``, Eq. (24)-(25), shape (k, n_outputs, n_inputs, n_params)."""
    k, p, _ = L.shape
    j, a, b = np.nonzero(S)
    starts = np.searchsorted(j, np.arange(len(S) + 1))
    if _FEW * R.shape[2] * len(j) < S.size and (np.diff(starts) > 0).all():
        entries = (S[j, a, b] * R.swapaxes(1, 2)[:, :, b])[:, None] * L[:, :, None, a]
        one_each = len(j) == len(S)
        return entries if one_each else np.add.reduceat(entries, starts[:-1], axis=3)
    # contract the short axes first, (k, p, a) (a, j, b) -> (k, p, j, b), real and
    # imaginary parts apart: S is real, which halves the work
    m, (q, rows, columns) = R.shape[2], S.shape
    S = S.transpose(1, 0, 2).reshape(rows, q * columns)
    L, R = np.concatenate([L.real, L.imag], 1), np.concatenate([R.real, R.imag], 2)
    changes = np.empty((k, p, m, q), complex)
    some = max(1, _CACHED // (2 * p * S.shape[1]))
    for at in (slice(i, i + some) for i in range(0, k, some)):
        left = (L[at].reshape(-1, rows) @ S).reshape(-1, 2 * p * q, columns)
        parts = (left @ R[at]).reshape(-1, 2, p, q, 2, m).swapaxes(3, 5)
        changes.real[at] = parts[:, 0, :, :, 0] - parts[:, 1, :, :, 1]
        changes.imag[at] = parts[:, 0, :, :, 1] + parts[:, 1, :, :, 0]
    return changes


def remembering(f: Callable[[NDArray], Any]) -> Callable[..., Any]:
    """The function `f` of one array, with its values at the last points remembered.

    Examples
    --------
    >>> import numpy as np
    >>> calls = []
    >>> square = remembering(lambda x: calls.append(x) or x**2)
    >>> square(np.array([2.0])), square(np.array([2.0])), len(calls)
    (array([4.]), array([4.]), 1)
    """
    known: dict[bytes, Any] = {}

    def remembered(x: NDArray) -> Any:
        key = x.tobytes()
        if key not in known:
            value = f(x)
            while len(known) >= _N_KNOWN:
                known.pop(next(iter(known)), None)
            known[key] = value
        return known[key]

    return remembered


class _Remembered:
    """A structure that is not affine, with what it gave at the last parameters."""

    def __init__(self, structure: Structure) -> None:
        self.order, self.n_params = structure.order, structure.n_params
        self.lower, self.upper = structure.lower, structure.upper
        self.system_matrix = remembering(structure.system_matrix)
        self.jacobian = remembering(structure.jacobian)
        self.curvature = remembering(structure.curvature)


def _with_memory(structure: Structure) -> Structure:
    affine = getattr(structure, "is_affine", False)
    return structure if affine else _Remembered(structure)


def response_point(model: Target, omega: Array) -> ResponsePoint:
    """The response of a model, and what its derivatives are made of."""
    Phi = resolvent(model.A, laplace_variable(omega, model.dt)[0])
    n, (p, m), k = len(model.A), model.D.shape, len(omega)
    L = np.empty((k, p, n + p), complex)
    L[:, :, :n], L[:, :, n:] = model.C @ Phi, np.eye(p)
    R = np.empty((k, n + m, m), complex)
    R[:, :n], R[:, n:] = Phi @ model.B, np.eye(m)
    G = np.asarray(model.C @ R[:, :n] + model.D, dtype=complex)
    return ResponsePoint(L, R, G, Phi)


class ErrorSystem:
    """``W (G(theta) - G0)`` for a structure, a black-box model and a weight.

    The weight is a stable model with one output, for all outputs alike, or a square
    one; None is no weight.
    """

    peaks_move = True  # the peaks are local maxima over a continuum of frequencies

    def __init__(
        self, structure: Structure, target: Target, weight: Target | None = None
    ) -> None:
        self.structure = _with_memory(structure)
        self.target, self.dt = target, target.dt
        self.n = structure.order
        self._met: tuple[bytes, float, PeakSet] | None = None
        # steps and trial steps watch the same frequencies
        self.target_response = remembering(self._target_response)
        self.weight_response = remembering(self._weight_response)
        self.n_outputs, self.n_inputs = target.D.shape
        self.fastest = float(np.abs(np.linalg.eigvals(target.A)).max(initial=0.0))
        self.weight = weight
        if weight is not None and weight.D.shape == (1, 1) and self.n_outputs > 1:
            self.weight = weight.repeated(self.n_outputs)

    def model(self, theta: Array) -> Target:
        """The gray-box model."""
        return Target.of(self.structure.system_matrix(theta), self.n, self.dt)

    def poles(self, theta: Array) -> Complex:
        """Poles of the gray-box model; infinite where its matrices are not finite."""
        S = self.structure.system_matrix(theta)
        if not np.isfinite(S).all():
            return np.full(max(self.n, 1), np.inf + 0j)
        return np.linalg.eigvals(S[: self.n, : self.n]).astype(complex)

    def resonances(self, poles: Complex) -> Array:
        """Frequencies (rad/s) at which the error may have a narrow peak."""
        turns = np.imag(poles)
        if self.dt is not None:
            turns = np.angle(poles) / self.dt
        return turns[turns > 0]

    @cached_property
    def grid(self) -> Array:
        """Frequencies at which a search watches the error, rad/s."""
        return frequency_grid(np.linalg.eigvals(self.target.A), self.dt)

    def peaks(self, theta: Array, within: float | None = None) -> PeakSet:
        """H-infinity norm of the error and its local maxima over frequency.

        The gray-box model must be stable: the level-set method measures the
        L-infinity norm, which stays finite (and meaningless) beyond the boundary.
        What the last parameters gave is remembered: searches go on where others end.
        """
        key, depth = theta.tobytes(), -1.0 if within is None else within
        if self._met is None or self._met[0] != key or self._met[1] < depth:
            parts = self.realisation(theta).matrices
            found = linf_norm(*parts, dt=self.dt, within=within)
            self._met = key, depth, found
        found, count = self._met[2], 1
        if within is not None:
            count = int((found.values >= (1.0 - within) * found.norm).sum())
        return PeakSet(found.norm, found.frequencies[:count], found.values[:count])

    def realisation(self, theta: Array) -> Target:
        """The error as a model: states of the gray box, the target, the weight."""
        g, t, n = self.model(theta), self.target, self.n
        N = n + len(t.A)
        Ae = np.zeros((N, N))
        Ae[:n, :n], Ae[n:, n:] = g.A, t.A
        B, C = np.vstack([g.B, t.B]), np.hstack([g.C, -t.C])
        error = Target(Ae, B, C, g.D - t.D, self.dt)
        return error if self.weight is None else series(error, self.weight)

    def restructured(self, structure: Structure) -> ErrorSystem:
        """The error of another structure of that order."""
        other = copy(self)  # with what is remembered of the target and the weight
        other.structure, other._met = _with_memory(structure), None
        return other

    def reweighted(self, weight: Target) -> ErrorSystem:
        """The same error behind one more weight (a scalar one)."""
        if self.weight is not None:
            weight = series(self.weight, weight.repeated(self.n_outputs))
        return ErrorSystem(self.structure, self.target, weight)

    def _weight_response(self, omega: Array) -> tuple[Complex, Complex, Complex]:
        """``W`` and its first two derivatives along the frequency, (k, p, p)."""
        if self.weight is None:
            eye = np.tile(np.eye(self.n_outputs, dtype=complex), (len(omega), 1, 1))
            return eye, np.zeros_like(eye), np.zeros_like(eye)
        return model_derivatives(self.weight, omega)

    def _target_response(self, omega: Array) -> Complex:
        """``G0`` at the frequencies, shape (k, n_outputs, n_inputs)."""
        at = np.searchsorted(self.grid[:-1], omega)  # the last one of all beyond
        known = self.grid[at] == omega
        G = np.empty((len(omega), self.n_outputs, self.n_inputs), complex)
        G[known] = self._target_on_grid[at[known]]
        G[~known] = model_response(self.target, omega[~known])
        return G

    @cached_property
    def _target_on_grid(self) -> Complex:
        return model_response(self.target, self.grid)

    def _target_derivatives(self, omega: Array) -> tuple[Complex, Complex, Complex]:
        return model_derivatives(self.target, omega)

    def response(self, theta: Array, omega: Array) -> Complex:
        """Response of the gray-box model, shape (k, n_outputs, n_inputs)."""
        return model_response(self.model(theta), omega)

    def response_jacobian(self, theta: Array, omega: Array) -> tuple[Complex, Complex]:
        """Response and its derivatives, shapes (k, p, m) and (k, p, m, n_params)."""
        at = self.point(theta, omega)
        return at.G, derivatives(at.L, self.structure.jacobian(theta), at.R)

    def point(self, theta: Array, omega: Array) -> ResponsePoint:
        """The response, and what its derivatives are made of."""
        return response_point(self.model(theta), omega)

    def rounding(self, theta: Array) -> float:
        """The error that a unit in the last place of every entry makes, of both models.

        Its largest root mean square over the grid, with units of random signs: no
        parameters are found more exactly.
        """
        W = self.weight_response(self.grid)[0]
        squares = np.zeros(len(self.grid))
        for model in (self.model(theta), self.target):
            at, S = response_point(model, self.grid), model.system_matrix
            squares += np.sum(np.abs(W @ at.L) ** 2 @ S**2 @ np.abs(at.R) ** 2, (1, 2))
        return float(np.finfo(float).eps * np.sqrt(squares.max()))

    def weighted_error(self, theta: Array, omega: Array) -> Complex:
        """``W (G(theta) - G0)``, shape (k, n_outputs, n_inputs)."""
        E = self.response(theta, omega) - self.target_response(omega)
        return self.weight_response(omega)[0] @ E

    def linearised_error(
        self, theta: Array, omega: Array, unit: float = 1.0
    ) -> tuple[Complex, Callable[[], Complex]]:
        """The weighted error in that unit, and a function that gives its derivatives.

        Shapes (k, n_outputs, n_inputs) and (k, n_outputs, n_inputs, n_params).
        """
        at, W = self.point(theta, omega), self.weight_response(omega)[0] / unit

        def slopes() -> Complex:
            return derivatives(W @ at.L, self.structure.jacobian(theta), at.R)

        return W @ (at.G - self.target_response(omega)), slopes

    def values(self, theta: Array, omega: Array) -> Array:
        """Largest singular values at the frequencies, shape (k,)."""
        E = self.weighted_error(theta, omega)
        return np.asarray(np.linalg.norm(E, 2, axis=(1, 2)))

    def gradients(self, theta: Array, omega: Array) -> tuple[Array, Array]:
        """Largest singular values and their gradients, Eq. (20) for sigma itself.

        Shapes (k,) and (k, n_params).
        """
        at, W = self.point(theta, omega), self.weight_response(omega)[0]
        U, sigma, Vh = np.linalg.svd(W @ (at.G - self.target_response(omega)))
        left = np.einsum("kp,kpq,kqa->ka", U[:, :, 0].conj(), W, at.L)
        right = np.einsum("kbm,km->kb", at.R, Vh[:, 0].conj())
        outer = np.real(left[:, :, None] * right[:, None, :])
        outer = outer.reshape(len(omega), left.shape[1] * right.shape[1])
        S = self.structure.jacobian(theta).reshape(self.structure.n_params, -1)
        return sigma[:, 0], outer @ S.T

    def constant_at(self, theta: Array, omega: Array) -> NDArray[np.bool_]:
        """Whether the error at these frequencies is one that no parameter changes.

        Told from other points, within the bounds: a gradient that vanishes may be that
        of a minimum, or of a square at zero.
        """
        structure = self.structure
        G0, here = self.target_response(omega), self.response(theta, omega)
        noise = _RESPONSE_ROUNDING * np.abs(G0).max((1, 2))
        most = _CONSTANT * np.abs(here - G0).max((1, 2)) + noise
        same = np.ones(len(omega), bool)
        top = float(np.abs(theta).max(initial=0.0)) or 1.0
        for least in _LEAST_SIZES:
            size = np.maximum(np.abs(theta), least * top)
            for turn in (1.0, 2.0):  # two directions that no structure prefers
                step = _MOVE * size * np.cos(turn + np.arange(len(theta)) ** 2)
                end = theta + step
                out = (end < structure.lower) | (end > structure.upper)
                other = np.where(out, theta - step, end)
                other = np.clip(other, structure.lower, structure.upper)
                if np.isfinite(self.poles(other)).all():
                    moved = np.abs(self.response(other, omega) - here).max((1, 2))
                    same &= moved <= most
        return same

    def hessian(
        self, theta: Array, weights: Array, omega: Array, moving: NDArray[np.bool_]
    ) -> Array:
        """Second derivative of the weighted sum of the singular values.

        Where `moving`, the frequency is a local maximum that follows the parameters,
        ``H = sigma_tt - sigma_tw sigma_tw^T / sigma_ww``. The `weights` (k,) are not
        negative.
        """
        q, n = self.structure.n_params, self.n
        S = self.structure.jacobian(theta)
        curvature = self.structure.curvature(theta)
        _, s1, s2 = (s[:, None, None] for s in laplace_variable(omega, self.dt))
        G0, G0_1, G0_2 = self._target_derivatives(omega)
        at = self.point(theta, omega)
        E, Phi, PB = at.G - G0, at.Phi, at.R[:, :n]
        once = at.L[:, :, :n] @ PB  # C Phi^2 B
        first = -s1 * once - G0_1
        second = 2.0 * s1**2 * (at.L[:, :, :n] @ Phi @ PB) - s2 * once - G0_2
        W, W1, W2 = self.weight_response(omega)
        U, sigma, Vh = np.linalg.svd(W @ E)
        u, v = U[:, :, :1].conj().swapaxes(1, 2), Vh[:, :1].conj().swapaxes(1, 2)
        # u^H (d2E) v: pairs of parameters, parameter and frequency, frequency
        left, right = (u @ W @ at.L)[:, 0], (at.R @ v)[:, :, 0]
        before = np.tensordot(left, S[:, :, :n], axes=(1, 1))  # (k, q, n)
        after = np.tensordot(right, S, axes=(1, 2))  # (k, q, n + p)
        pairs = (weights[:, None, None] * before) @ Phi
        H = np.real(np.tensordot(pairs, after[:, :, :n], axes=((0, 2), (0, 2))))
        H = H + H.T
        if curvature is not None:
            both = np.real((weights * left.T) @ right)
            H += np.tensordot(curvature, both, axes=2)
        dleft = (u @ W1 @ at.L)[:, 0]
        dleft[:, :n] -= ((s1 * left[:, None, :n]) @ Phi)[:, 0]
        dright = -s1 * (Phi @ right[:, :n, None])
        cross = (after @ dleft[:, :, None] + before @ dright)[:, :, 0]
        bend = (u @ (W2 @ E + 2.0 * (W1 @ first) + W @ second) @ v)[:, 0, 0]
        # through the other singular values
        dE = derivatives(W @ at.L, S, at.R)
        c = _couplings(dE, U, sigma, Vh)
        along = _couplings((W1 @ E + W @ first)[..., None], U, sigma, Vh)
        flat = (np.sqrt(weights)[:, None, None] * c).reshape(-1, q)
        H += np.real(flat.conj().T @ flat)
        tw = np.real(cross + (along.conj() * c).sum(1))
        ww = np.real(bend) + np.sum(np.abs(along[:, :, 0]) ** 2, axis=1)
        turning = moving & (ww < 0)
        tw, ww = tw[turning], ww[turning]
        return np.asarray(H - (weights[turning] / ww * tw.T) @ tw)


def vanishing_weight(system: ErrorSystem, omega: float) -> Target | None:
    """First-order weight that vanishes at zero or infinite frequency.

    ``s / (s + c)`` with `c` the fastest pole of the black box, or ``c / (s + c)`` with
    the slowest; None for a frequency in between.
    """
    dt = system.dt
    size = np.abs(pole_rates(np.linalg.eigvals(system.target.A), dt))
    size = size[size > 0]
    if size.size == 0 or (0 < omega < np.inf):
        return None
    one = np.ones((1, 1))
    if omega == 0:
        c = float(size.max())
        if dt is None:
            return Target(-c * one, c * one, -one, one)
        a = np.exp(-c * dt)
        return Target(a * one, (a - 1.0) * one, one, one, dt)
    c = float(size.min())
    return Target(-c * one, c * one, one, 0 * one)


def _couplings(dE: Complex, U: Complex, sigma: Array, Vh: Complex) -> Complex:
    """What couples the largest singular value to the other ones, (k, r, q).

    sigma is an eigenvalue of ``[[0, E], [E^H, 0]]``, whose other eigenvalues are
    ``+-sigma_a`` and zeros: changes `dE` (k, p, m, q) add to its second derivative
    ``2 Re sum_a conj(c_a) c_a^T / (sigma - lambda_a)``, of which each row has its root.
    """
    p, m = dE.shape[1:3]
    r = min(p, m)
    Ev = np.einsum("kpmj,km->kpj", dE, Vh[:, 0].conj())
    uE = np.einsum("kpmj,kp->kmj", dE, U[:, :, 0].conj())
    a = U.conj().swapaxes(1, 2) @ Ev  # u_a^H dE v
    b = (Vh.conj() @ uE).conj()  # v_a^H dE^H u
    rest = (a if p > m else b)[:, r:] * np.sqrt(2.0)
    c = np.concatenate([a[:, 1:r] + b[:, 1:r], a[:, :r] - b[:, :r], rest], axis=1)
    others = np.concatenate([sigma[:, 1:], -sigma, np.zeros(rest.shape[:2])], axis=1)
    gap = np.maximum(sigma[:, :1] - others, _GAP * sigma[:, :1])
    return np.asarray(c * np.sqrt(0.5 / gap)[:, :, None])
