"""A deterministic model with a noise model: prediction from past outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..systems.least_squares import scaled_lstsq
from ..systems.simulation import state_trajectory
from ..validation import whole_number
from .statespace import StateSpace

Array = NDArray[np.float64]


class NoiseModel(NamedTuple):
    """``x[t+1] = A x[t] + K e[t]``, ``v[t] = C x[t] + e[t]``."""

    A: Array  # (n_states, n_states)
    C: Array  # (n_outputs, n_states)
    K: Array  # (n_states, n_outputs), innovation gain; A - K C is stable
    covariance: Array  # (n_outputs, n_outputs), of the innovations e


@dataclass(frozen=True, eq=False, repr=False)
class InnovationModel:
    """Innovation form of an identified model.

    ``x[t+1] = A x[t] + B u[t] + K e[t]``, ``y[t] = C x[t] + D u[t] + e[t]`` with white
    innovations e. The states are those of the deterministic model, then those of the
    noise model, which the inputs do not reach.

    Parameters
    ----------
    lti : StateSpace
        Deterministic part, discrete time.
    noise : NoiseModel
        Of the simulation error; ``A - K C`` stable.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import StateSpace
    >>> from lpvlearn.models.innovation import NoiseModel
    >>> one = np.ones((1, 1))
    >>> lti = StateSpace([[0.5]], [[1.0]], [[1.0]], sampling_time=1.0)
    >>> model = InnovationModel(lti, NoiseModel(0.9 * one, 0.9 * one, one, one))
    >>> model.K
    array([[0.],
           [1.]])
    >>> y = 0.9 ** np.arange(4.0)[:, None]
    >>> model.predict(np.zeros((4, 1)), y).round(3).ravel()
    array([0.   , 0.9  , 0.81 , 0.729])
    """

    lti: StateSpace
    noise: NoiseModel

    def __repr__(self) -> str:
        return (
            f"InnovationModel(order={self.lti.order}, "
            f"n_noise_states={self.n_noise_states}, n_inputs={self.lti.n_inputs}, "
            f"n_outputs={self.lti.n_outputs})"
        )

    @property
    def n_noise_states(self) -> int:
        """Number of states of the noise model; 0 is white noise."""
        return len(self.noise.A)

    @property
    def A(self) -> Array:
        """State matrix of both parts."""
        return block_diag(self.lti.A, self.noise.A)

    @property
    def B(self) -> Array:
        """Input matrix."""
        zero = np.zeros((self.n_noise_states, self.lti.n_inputs))
        return np.vstack([self.lti.B, zero])

    @property
    def C(self) -> Array:
        """Output matrix."""
        return np.hstack([self.lti.C, self.noise.C])

    @property
    def D(self) -> Array:
        """Feedthrough."""
        return self.lti.D

    @property
    def K(self) -> Array:
        """Innovation (Kalman) gain, shape (order + n_noise_states, n_outputs)."""
        zero = np.zeros((self.lti.order, self.lti.n_outputs))
        return np.vstack([zero, self.noise.K])

    @property
    def covariance(self) -> Array:
        """Covariance of the innovations, shape (n_outputs, n_outputs)."""
        return self.noise.covariance

    def predict(
        self,
        u: ArrayLike,
        y: ArrayLike,
        *,
        steps: int = 1,
        initial_state: ArrayLike | None = None,
    ) -> Array:
        """Predict every sample from the outputs up to `steps` samples before it.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        y : array-like of shape (n_samples, n_outputs)
            Missing values (NaN) are predicted from those beside them, and correct
            nothing.
        steps : int, default=1
            Prediction horizon in samples.
        initial_state : array-like of shape (order,), default=None
            Of the deterministic part; None is rest.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs)
            Row t uses the inputs up to t and the outputs up to ``t - steps``.
        """
        delay = whole_number("steps", steps, 1) - 1
        simulated = self.lti.simulate(u, initial_state=initial_state)
        if self.n_noise_states == 0:
            return simulated
        A, C, K, _ = self.noise
        error = np.asarray(y, dtype=float).reshape(simulated.shape) - simulated
        known = ~np.isnan(error)
        if known.all():
            ahead = state_trajectory(A - K @ C, error @ K.T)
        else:
            gains = self._gains(known)
            forcing = np.einsum("tij,tj->ti", gains, np.where(known, error, 0.0))
            ahead = state_trajectory(A - gains @ C, forcing)
        decay = C @ np.linalg.matrix_power(A, delay)
        simulated[delay:] += ahead[: max(len(error) - delay, 0)] @ decay.T
        return simulated

    def _gains(self, known: NDArray[np.bool_]) -> Array:
        """K for the outputs that are known: of the others the expected innovation."""
        K, covariance = self.noise.K, self.noise.covariance
        gains = np.zeros((len(known), *K.shape))
        for pattern in np.unique(known, axis=0):
            own = np.flatnonzero(pattern)
            others, _ = scaled_lstsq(covariance[np.ix_(own, own)], covariance[own])
            rows = np.flatnonzero((known == pattern).all(axis=1))
            gains[np.ix_(rows, np.arange(len(K)), own)] = K @ others.T
        return gains
