r"""A continuous-time structure as sampled data see it: behind a zero-order hold.

    exp(M dt) = [[Ad, Bd], [0, I]],   M = [[A, B], [0, 0]],

C and D as they are. The derivatives by theta_j are the blocks of

    exp([[M, M_j], [0, M]] dt) = [[exp(M dt), d exp(M dt) / d theta_j], [0, exp(M dt)]]

(Van Loan, 1978). A structure can so be held against a black box in discrete time, where
it was identified: a black box with a pole on the negative real axis, which has no
logarithm, needs none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from .error_system import Structure, remembering

Array = NDArray[np.float64]


class SampledStructure:
    """The discrete-time models of a continuous-time structure, exact for held inputs.

    It takes the place of a structure in an `ErrorSystem` whose black box has the same
    sampling time. Structures that differ by modes beyond the Nyquist frequency have
    the same samples: begin near the parameters that are meant.
    """

    is_affine = False

    def __init__(self, structure: Structure, sampling_time: float) -> None:
        self.structure, self.sampling_time = structure, sampling_time
        self.order, self.n_params = structure.order, structure.n_params
        self.lower, self.upper = structure.lower, structure.upper
        self._sampled = remembering(self._sample)

    def system_matrix(self, theta: Array) -> Array:
        """``[[Ad, Bd], [C, D]]``; not finite where the sampled model overflows."""
        return np.asarray(self._sampled(theta)[0])

    def jacobian(self, theta: Array) -> Array:
        """Its derivatives, shape (n_params, order + n_outputs, order + n_inputs)."""
        return np.asarray(self._sampled(theta)[1])

    def curvature(self, theta: Array) -> Array | None:
        """Not known: the structure serves least squares, not the minimax."""
        raise NotImplementedError("the curvature of a sampled structure")

    def _sample(self, theta: Array) -> tuple[Array, Array]:
        n, dt = self.order, self.sampling_time
        S, dS = self.structure.system_matrix(theta), self.structure.jacobian(theta)
        size = S.shape[1]
        # the units of a parameter must not enter the norm that expm scales by
        unit = np.abs(dS[:, :n]).max((1, 2), initial=0.0, keepdims=True)
        unit = np.where(unit > 0, unit, 1.0) / np.abs(S[:n]).max(initial=1e-300)
        M = np.zeros((self.n_params, 2 * size, 2 * size))
        M[:, :n, :size] = M[:, size : size + n, size:] = S[:n] * dt
        M[:, :n, size:] = dS[:, :n] / unit * dt
        with np.errstate(over="ignore", invalid="ignore"):
            E = expm(M) if np.isfinite(M).all() else np.full_like(M, np.nan)
        return (
            np.vstack([E[0, :n, :size], S[n:]]),
            np.concatenate([E[:, :n, size:] * unit, dS[:, n:]], axis=1),
        )
