"""Frequencies where a singular value of a frequency response equals a level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from .response import FrequencyEngine

__all__ = ["LevelSets"]

_EPS = float(np.finfo(float).eps)

# Loose test for imaginary eigenvalues: a false crossing only costs a sample.
_CROSSING_AXIS = 1e-4

# Feedthrough gains this far from the level, relatively, are harmless.
_CLEARANCE = 0.05


@dataclass(frozen=True)
class _Mapped:
    """A continuous-time system whose feedthrough is diagonal, with these gains."""

    A: NDArray
    B: NDArray
    C: NDArray
    gains: NDArray
    scale: float


class LevelSets:
    r"""Imaginary eigenvalues of the Hamiltonian of a level.

    A Moebius map with a real pole carries one end x0 of the frequency axis to
    infinity. With :math:`A_0 = F - x_0 I` and k the scale of the map,

    .. math:: G = G(x_0) - k\, C A_0^{-1} (\zeta I - \kappa I - k A_0^{-1})^{-1}
              A_0^{-1} B

    where, in continuous time, :math:`\kappa = 0, \zeta = k / s`, and in
    discrete time :math:`\kappa = 1, k = 2 z_0, \zeta = (z + z_0) / (z - z_0)`.
    The feedthrough becomes :math:`G(x_0)`. Of the two ends, zero and infinity
    (pi), the one is taken at which no gain is near the level: the Hamiltonian
    then stays well conditioned also just above a peak at the other end.

    Parameters
    ----------
    engine : FrequencyEngine
        No pole may lie on the boundary.

    Examples
    --------
    The gain of 1 / (s + 1) is 0.5 at the square root of 3:

    >>> import numpy as np
    >>> one = np.ones((1, 1))
    >>> engine = FrequencyEngine(-one, one, one, 0 * one)
    >>> LevelSets(engine).crossings(0.5).round(12)
    array([1.73205081])
    """

    def __init__(self, engine: FrequencyEngine) -> None:
        self.engine = engine
        self._maps: dict[float, _Mapped] = {}

    def crossings(self, level: float) -> NDArray:
        """Return sorted frequencies, some of them false, none missing.

        The test for the axis is loose on purpose, so every frequency is to be
        evaluated, and the intervals between them too.
        """
        end = self._end(level)
        eta = _imaginary_eigenvalues(_hamiltonian(self._mapped(end), level))
        if end == np.inf:
            omega = eta
        elif self.engine.discrete:
            # zeta = j eta = -j cot((omega - end) / 2), folded to [0, pi].
            omega = 2.0 * np.arctan(eta) if end else 2.0 * np.arctan2(1.0, eta)
        else:
            omega = self._mapped(end).scale / eta[eta > 0.0]
        return np.sort(np.abs(omega))

    def _end(self, level: float) -> float:
        """Choose the end of the frequency axis that goes to infinity."""
        first = np.pi if self.engine.discrete else np.inf
        clearance = {}
        for end in (first, 0.0):
            gains = self._mapped(end).gains.tolist()
            clearance[end] = min(abs(gain - level) for gain in gains) / level
            if clearance[end] > _CLEARANCE:
                return end
        return max(clearance, key=clearance.__getitem__)

    def _mapped(self, end: float) -> _Mapped:
        if end not in self._maps:
            self._maps[end] = self._map(end)
        return self._maps[end]

    def _map(self, end: float) -> _Mapped:
        engine = self.engine
        A, B, C, D = engine.F, engine.B, engine.C, engine.D
        scale = 1.0
        if end < np.inf:
            identity = np.eye(len(A))
            inverse = np.linalg.inv(A + 2.0 * identity if end else A)
            size = np.abs(engine.poles)
            if not engine.discrete:
                scale = size.max() * max(size.min(), _EPS * size.max())
                A = scale * inverse
            else:
                scale = -2.0 if end else 2.0
                A = identity + scale * inverse
            left, B = C @ inverse, inverse @ B
            C, D = -scale * left, D - C @ B
        U, gains, Vt, _ = lapack.dgesdd(D)
        return _Mapped(A, B @ Vt.T, U.T @ C, gains, scale)


def _hamiltonian(system: _Mapped, level: float) -> NDArray:
    """Hamiltonian of a level; the feedthrough is diagonal in these channels."""
    A, B, C, gains = system.A, system.B, system.C, system.gains
    n, k = len(A), len(gains)
    square = level * level
    gap = (level - gains) * (level + gains)
    gap[gap == 0.0] = _EPS * square
    M = A + (B[:, :k] * (gains / gap)) @ C[:k]
    H = np.empty((2 * n, 2 * n), order="F")
    H[:n, :n] = M
    H[:n, n:] = (B * _padded(level / gap, B.shape[1], 1.0 / level)) @ B.T
    H[n:, :n] = (C.T * _padded(-level / gap, C.shape[0], -1.0 / level)) @ C
    H[n:, n:] = -M.T
    return H


def _padded(weights: NDArray, length: int, rest: float) -> NDArray:
    """Weights of all channels: those beyond the gains have no feedthrough."""
    if len(weights) == length:
        return weights
    return np.append(weights, np.full(length - len(weights), rest))


def _imaginary_eigenvalues(H: NDArray) -> NDArray:
    """Imaginary parts, not negative, of the eigenvalues near the axis."""
    real, imag, _, _, info = lapack.dgeev(H, compute_vl=0, compute_vr=0, overwrite_a=1)
    if info:
        raise np.linalg.LinAlgError("The QR iteration did not converge.")
    return imag[np.abs(real) <= _CROSSING_AXIS * imag]
