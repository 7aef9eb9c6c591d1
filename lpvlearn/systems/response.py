"""Frequency response of a state-space system, with derivatives in frequency."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack, schur

_EPS = float(np.finfo(float).eps)

# Eigenvectors worse conditioned than this are not used as coordinates: the modal form
# has nine digits left there, which is what its values are trusted to.
_MODAL_CONDITION = 1e7

# Relative accuracy below which a modal value is solved for, and a solved one refined:
# a tenth of the 1e-8 to which norms agree with extended precision (the stress test).
_ACCURACY = 1e-9

# Each gains as many digits as the factorisation has right, seven or more: three reach
# the extended precision of the residuals.
_REFINEMENTS = 3

# Powers of two of the largest entries of a system beyond which its units are changed:
# far from those whose squares, or fourth powers, leave the floating-point numbers.
_EXTREME = 150

_STACK_ENTRIES = 4_000_000  # of the matrices factored at once: 64 MB
_DELAY = 1e-12  # decay a sample of a sampled model's pole at the origin (a delay)


class ScaledSystem(NamedTuple):
    """A system in units of time and gain that make no number huge or tiny.

    ``G(j omega) = 2^gain G_scaled(j omega / 2^rate)``; all powers of two are exact.
    """

    A: NDArray
    B: NDArray
    C: NDArray
    D: NDArray
    rate: int  # 0 in discrete time
    gain: int


def scaled_system(
    A: NDArray, B: NDArray, C: NDArray, D: NDArray, discrete: bool
) -> ScaledSystem:
    """The system in such units; as it is where squares do not leave the numbers."""
    a, b, c, d = (_exponent(M) for M in (A, B, C, D))
    extreme = max(abs(e) for e in (a, b, c, d, b + c, b + c - a)) > _EXTREME
    if not extreme:
        return ScaledSystem(A, B, C, D, 0, 0)
    rate = 0 if discrete or not A.any() else a
    through = b + c - rate
    ways = [e for e, there in ((through, B.any() and C.any()), (d, D.any())) if there]
    gain = max(ways, default=0)
    shift = min(through - gain, 0)
    B = times_power(B, shift // 2 - b)
    C = times_power(C, shift - shift // 2 - c)
    A, D = times_power(A, -rate), times_power(D, -gain)
    return ScaledSystem(A, B, C, D, rate, gain)


def _exponent(M: NDArray) -> int:
    """Power of two of the largest entry; 0 where there is none."""
    return int(np.frexp(np.abs(M).max(initial=0.0))[1])


def times_power(M: NDArray, exponent: int) -> NDArray:
    """``M 2^exponent``, whose power may be beyond all numbers where M 2^e is not."""
    found = np.array(M)
    # part by part: a complex infinity times a number is none
    parts = (found.real, found.imag) if np.iscomplexobj(found) else (found,)
    with np.errstate(over="ignore", under="ignore"):
        for part in parts:
            np.ldexp(part, exponent, out=part)
    return found


def frequency_response(
    A: NDArray,
    B: NDArray,
    C: NDArray,
    D: NDArray,
    omega: ArrayLike,
    dt: float | None = None,
) -> NDArray:
    r"""Frequency response of a linear time-invariant state-space system.

    .. math:: G(j\omega) = C (j\omega I - A)^{-1} B + D, \qquad
              G(e^{j\omega \Delta t}) \text{ in discrete time.}

    The result has shape (n_frequencies, n_outputs, n_inputs). Infinite frequencies
    give D (a ValueError in discrete time); at a pole on the axis every entry is
    infinite. Modal coordinates of the equilibrated system, checked for cancellation;
    the frequencies where digits would be lost are solved one by one.
    """
    omega = np.atleast_1d(np.asarray(omega, float))
    finite = np.isfinite(omega)
    if dt is not None and not finite.all():
        raise ValueError(
            "`omega` must be finite in discrete time, where the highest frequency "
            f"is pi/dt = {np.pi / dt:.6g} rad/s. Got {omega[~finite][0]}."
        )
    G = np.empty((len(omega), *D.shape), complex)
    G[~finite] = D
    if len(A) == 0:
        G[finite] = D
    elif finite.any():
        scaled = scaled_system(A, B, C, D, dt is not None)
        engine = FrequencyEngine(*scaled[:4], discrete=dt is not None)
        angles = times_power(omega[finite], -scaled.rate) * (1.0 if dt is None else dt)
        found = engine.accurate(angles).transpose(2, 0, 1)
        G[finite] = times_power(found, scaled.gain) if scaled.gain else found
    return G


class FrequencyEngine:
    r"""Evaluates :math:`G = C (xI - F)^{-1} B + D` at many frequencies.

    Continuous time: :math:`x = j\omega` and :math:`F = A`. Discrete time:
    :math:`x = e^{j\omega} - 1` and :math:`F = A - I`, the delta form, which
    keeps its relative accuracy where sampling is fast and all poles crowd at 1.

    `response` and `derivatives` work in modal coordinates (`is_modal`), where the
    eigenvectors are well conditioned, and on the complex Schur form otherwise;
    `solved` factors :math:`xI - F` at each frequency and is the reference.
    Results have shape (n_outputs, n_inputs, n_frequencies). Infinity is not handled
    here. If `discrete`, frequencies are angles on the unit circle (rad per sample).
    `poles` are the eigenvalues of F: those of A, less one in discrete time.
    """

    def __init__(
        self, A: NDArray, B: NDArray, C: NDArray, D: NDArray, discrete: bool = False
    ) -> None:
        F = A - np.eye(len(A)) if discrete else A
        if discrete:
            # What rounding took from the diagonal of A - I (Knuth's two-sum).
            exact, rounded = np.diag(A), np.diag(F)
            back = rounded - exact
            self._shift_error = (exact - (rounded - back)) - (1.0 + back)
        self.discrete = discrete
        self.order = len(A)
        self.F, self.B, self.C = equilibrated(F, B, C)
        self.D = D
        self._size = np.sqrt((self.F * self.F).sum())
        real, imag, _, vectors, info = lapack.dgeev(self.F, compute_vl=0)
        self.poles = real + 1j * imag
        self.is_modal = info == 0 and self._to_modal_form(vectors, imag)
        if not self.is_modal:
            self._to_schur_form()

    def _to_modal_form(self, vectors: NDArray, imag: NDArray) -> bool:
        """Residues from the real form of the eigenvectors, if well conditioned.

        A pair of conjugate eigenvectors v, v* stands as Re v, Im v: of the real
        inverse, the rows of the pair are then twice those of the complex one.
        """
        lu, pivots, info = lapack.dgetrf(vectors)
        if info:
            return False
        inverse, _ = lapack.dgetri(lu, pivots)
        # All eigenvectors have length one; pairs make this too large by at most 2.
        condition = (self.order * float(np.vdot(inverse, inverse))) ** 0.5
        if not condition <= _MODAL_CONDITION:
            return False
        # G = D + sum_k residue_k / (x - pole_k), one column per pole.
        factors = np.concatenate((self.C @ vectors, (inverse @ self.B).T))
        sign, column = np.sign(imag), np.arange(self.order)
        real_part = factors[:, column - (sign < 0.0)]
        factors = real_part + 1j * sign * factors[:, column + (sign > 0.0)]
        n_outputs = len(self.C)
        left, right = factors[:n_outputs], factors[n_outputs:].conj()
        right *= 1.0 / (1.0 + sign * sign)
        self._residues = (left[:, None, :] * right).reshape(-1, self.order)
        self._condition = condition
        return True

    def _to_schur_form(self) -> None:
        T, Q = schur(self.F, output="complex")
        self.poles = np.diag(T).copy()
        self._schur = T, Q.conj().T @ self.B, self.C @ Q

    def points(self, omega: NDArray) -> NDArray:
        """Values of x at the frequencies."""
        if not self.discrete:
            return 1j * omega
        # 1 - cos by the half angle: no cancellation near omega = 0.
        return -2.0 * np.sin(0.5 * omega) ** 2 + 1j * np.sin(omega)

    def response(self, omega: NDArray) -> NDArray:
        """G at finite frequencies."""
        x = self.points(omega)
        shape = (*self.D.shape, len(omega))
        if self.is_modal:
            X = 1.0 / (x - self.poles[:, None])
            G = (self._residues @ X).reshape(shape)
        else:
            G = self._read_out(self._back_substitute(x, None), shape)
        G += self.D[:, :, None]
        return G

    def derivatives(self, omega: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """G and its first and second derivative in frequency."""
        x = self.points(omega)
        shape = (*self.D.shape, len(omega))
        if self.is_modal:
            X = 1.0 / (x - self.poles[:, None])
            X2 = X * X
            powers = np.concatenate((X, X2, X2 * X), axis=1)
            stacked = (self._residues @ powers).reshape(*self.D.shape, 3, -1)
            G, G1, G2 = (stacked[:, :, k] for k in range(3))
        else:
            S1 = self._back_substitute(x, None)
            S2 = self._back_substitute(x, S1)
            S3 = self._back_substitute(x, S2)
            G, G1, G2 = (self._read_out(S, shape) for S in (S1, S2, S3))
        G = G + self.D[:, :, None]
        return G, *self._chain(x, -G1, 2.0 * G2)

    def _chain(self, x: NDArray, Gx: NDArray, Gxx: NDArray) -> tuple[NDArray, NDArray]:
        """Derivatives in frequency from those in x."""
        if not self.discrete:
            return 1j * Gx, -Gxx
        z = x + 1.0
        return 1j * z * Gx, -z * (z * Gxx + Gx)

    def jet(self, omega: float) -> tuple[NDArray, NDArray, NDArray]:
        """G and its two derivatives at one frequency, as accurate as `solved`.

        Without a last axis, whose overhead would cost more than the arithmetic.
        """
        x = self.points(np.asarray(omega))
        M = np.array(-self.F, complex, order="F")
        M.T.reshape(-1)[:: self.order + 1] += x
        lu, pivots, info = lapack.zgetrf(M)
        if info:
            raise np.linalg.LinAlgError("A pole lies on the boundary.")
        right = lapack.zgetrs(lu, pivots, self.B)[0]
        left = lapack.zgetrs(lu, pivots, self.C.T, trans=1)[0].T
        G = self.C @ right + self.D
        square = np.vdot(left, left).real * np.vdot(right, right).real
        noise = _EPS * square**0.5 * (abs(x) + self._size)
        if noise > _ACCURACY * np.vdot(G, G).real ** 0.5:
            stacks = np.array([x]), M[None], right[None], left[None]
            right, left, G = (P[0] for P in self._polished(*stacks))
        again = lapack.zgetrs(lu, pivots, right)[0]
        return G, *self._chain(x, -(left @ right), 2.0 * (left @ again))

    def solved(self, omega: NDArray) -> NDArray:
        """G by one LU factorisation per frequency.

        Where the resolvent is so large that G would lose digits, the solutions are
        refined on residuals in extended precision (if long double has it).
        """
        G = np.empty((*self.D.shape, len(omega)), complex)
        step = max(1, _STACK_ENTRIES // max(1, self.order**2))
        for start in range(0, len(omega), step):
            part = slice(start, start + step)
            G[:, :, part] = self._solved_stack(self.points(omega[part]))
        return G

    def _solved_or_infinite(self, omega: NDArray) -> NDArray:
        try:
            return self.solved(omega)
        except np.linalg.LinAlgError:  # one of them is a pole, to rounding
            if len(omega) == 1:
                return np.full((*self.D.shape, 1), np.inf, complex)
            halves = np.array_split(omega, 2)
            return np.concatenate([*map(self._solved_or_infinite, halves)], axis=2)

    def _solved_stack(self, x: NDArray) -> NDArray:
        M = np.empty((len(x), self.order, self.order), complex)
        M[:] = -self.F
        M.reshape(len(x), -1)[:, :: self.order + 1] += x[:, None]
        right = np.linalg.solve(M, self.B.astype(complex)[None])
        left = np.linalg.solve(M.swapaxes(1, 2), self.C.T.astype(complex)[None])
        left = left.swapaxes(1, 2)
        G = self.C @ right + self.D
        # First-order effect of the backward error of the factorisation on G.
        noise = _norms(left) * _norms(right) * (np.abs(x) + self._size)
        poor = _EPS * noise > _ACCURACY * _norms(G)
        if poor.any():
            stacks = x[poor], M[poor], right[poor], left[poor]
            G[poor] = self._polished(*stacks)[2]
        return G.transpose(1, 2, 0)

    def _polished(
        self, x: NDArray, M: NDArray, right: NDArray, left: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Iterative refinement of both solutions in extended precision."""
        x = x.astype(np.clongdouble)[:, None, None]
        F, B, C = (P.astype(np.clongdouble) for P in (self.F, self.B, self.C))
        if self.discrete:
            F += np.diag(self._shift_error)
        X, Y = right.astype(np.clongdouble), left.astype(np.clongdouble)
        for _ in range(_REFINEMENTS):
            residual = (B - x * X + F @ X).astype(complex)
            X = X + np.linalg.solve(M, residual)
            residual = (C - x * Y + Y @ F).astype(complex).swapaxes(1, 2)
            Y = Y + np.linalg.solve(M.swapaxes(1, 2), residual).swapaxes(1, 2)
        return X.astype(complex), Y.astype(complex), (C @ X + self.D).astype(complex)

    def _back_substitute(self, x: NDArray, rhs: NDArray | None) -> NDArray:
        """Solve (xI - T) S = rhs for all frequencies at once."""
        T, B, _ = self._schur
        n, m, k = self.order, B.shape[1], len(x)
        S = np.empty((n, m, k), complex)
        for i in range(n - 1, -1, -1):
            row = B[i][:, None] if rhs is None else rhs[i]
            if i < n - 1:
                known = S[i + 1 :].reshape(n - i - 1, m * k)
                row = row + (T[i, i + 1 :] @ known).reshape(m, k)
            S[i] = row / (x - T[i, i])
        return S

    def _read_out(self, S: NDArray, shape: tuple[int, ...]) -> NDArray:
        return (self._schur[2] @ S.reshape(self.order, -1)).reshape(shape)

    def uncertainty(self, omega: NDArray) -> NDArray:
        """Bound on the error of `response`: cancellation and moved poles.

        To first order, with the eigenvectors' condition for the size of the
        rounding errors; usually pessimistic by two or three digits.
        """
        if not self.is_modal:
            return np.full(len(omega), np.inf)
        X = 1.0 / np.abs(self.points(omega) - self.poles[:, None])
        amplification = 1.0 + self._size * X.max(0)
        terms = np.sqrt((np.abs(self._residues) ** 2).sum(0))
        return _EPS * self._condition * amplification * (terms @ X)

    def accurate(self, omega: NDArray) -> NDArray:
        """G, solved where modes would lose digits; infinite at poles."""
        G = np.full((*self.D.shape, len(omega)), np.inf, complex)
        regular = (self.points(omega) != self.poles[:, None]).all(0)
        omega = omega[regular]
        found = self.response(omega)
        size = np.sqrt((found.real**2 + found.imag**2).sum((0, 1)))
        lost = self.uncertainty(omega) > _ACCURACY * size
        if lost.any():
            found[:, :, lost] = self._solved_or_infinite(omega[lost])
        G[:, :, regular] = found
        return G


def _norms(M: NDArray) -> NDArray:
    """Frobenius norm of each matrix of a stack."""
    return np.sqrt((M.real**2 + M.imag**2).sum((-2, -1)))


def equilibrated(
    A: NDArray, B: NDArray, C: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Scale the states by powers of two so that rows and columns of A agree.

    The transfer function is unchanged to the last bit, as only exponents move. Where
    nothing is to be scaled the same objects are returned.
    """
    scaled, _, _, scale, _ = lapack.dgebal(A, scale=1, permute=0)
    if (scale == 1.0).all():
        return A, B, C
    return scaled, B / scale[:, None], C * scale


def resolvent(
    A: NDArray, s: NDArray, B: NDArray | None = None
) -> NDArray[np.complex128]:
    """``(s I - A)^-1``, or ``(s I - A)^-1 B``, for every `s`; zero at infinity."""
    finite, n = np.isfinite(s), len(A)
    M = np.empty((len(s), n, n), complex)
    M[:] = -A
    M.reshape(len(s), n * n)[:, :: n + 1] += np.where(finite, s, 0.0)[:, None]
    M[~finite] = np.eye(n)
    X = np.asarray(np.linalg.inv(M) if B is None else np.linalg.solve(M, B), complex)
    X[~finite] = 0.0
    return X


def pole_rates(poles: NDArray, dt: float | None) -> NDArray[np.complex128]:
    """Poles in rad/s: those of a sampled model by the logarithm."""
    poles = np.asarray(poles, dtype=complex)
    if dt is None:
        return poles
    return np.asarray(np.log(np.where(poles == 0, _DELAY, poles)) / dt)


def pole_grid(
    rates: NDArray, low: float, high: float, n_points: int, offsets: ArrayLike
) -> NDArray[np.float64]:
    """Frequencies that show every pole: logarithmic, and more around the poles.

    `n_points` are spread from `low` to `high`; `offsets` are places around the
    frequency of each pole (`rates`, in rad/s), in units of its decay. The points are
    sorted, and may reach beyond the ends around a pole.
    """
    around = np.abs(rates.imag) + np.multiply.outer(offsets, np.abs(rates.real))
    return np.unique(np.append(np.geomspace(low, high, n_points), around))
