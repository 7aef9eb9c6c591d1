"""A deterministic model with a noise model: prediction from past outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..systems.simulation import (
    estimate_initial_state,
    free_responses,
    state_trajectory,
)
from ..validation import finite_samples, whole_number
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
    noise model, which the inputs do not reach. Without a `gain` the innovations do not
    move the former: the noise model is that of the simulation error.

    Parameters
    ----------
    lti : StateSpace
        Deterministic part, discrete time.
    noise : NoiseModel
        States that only the innovations drive, and the covariance of these. Without a
        `gain` its ``A - K C`` is stable.
    gain : ndarray of shape (order, n_outputs), default=None
        Rows of K of the deterministic states; ``A - K C`` of all states together is
        stable, whatever `lti` is. None: zero.

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
    gain: Array | None = None

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
        gain = self.gain
        if gain is None:
            gain = np.zeros((self.lti.order, self.lti.n_outputs))
        return np.vstack([gain, self.noise.K])

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
        steps : int, default=1
            Prediction horizon in samples.
        initial_state : array-like of shape (order,), default=None
            Of the deterministic part, or, with a `gain`, of all states (order +
            n_noise_states). None is rest.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs)
            Row t uses the inputs up to t and the outputs up to ``t - steps``.
        """
        delay = whole_number("steps", steps, 1) - 1
        if self.gain is not None:
            return self._predict_jointly(u, y, delay, initial_state)
        simulated = self.lti.simulate(u, initial_state=initial_state)
        if self.n_noise_states == 0:
            return simulated
        A, C, K, _ = self.noise
        error = np.asarray(y, dtype=float).reshape(simulated.shape) - simulated
        ahead = state_trajectory(A - K @ C, error @ K.T)
        decay = C @ np.linalg.matrix_power(A, delay)
        simulated[delay:] += ahead[: max(len(error) - delay, 0)] @ decay.T
        return simulated

    def _predict_jointly(
        self, u: ArrayLike, y: ArrayLike, delay: int, initial_state: ArrayLike | None
    ) -> Array:
        """By the predictor of all states, which is stable where the plant is not."""
        u = finite_samples("u", u, self.lti.n_inputs)
        y = finite_samples("y", y, self.lti.n_outputs)
        A, B, C, D, K = self.A, self.B, self.C, self.D, self.K
        x0 = np.zeros(len(A))
        if initial_state is not None:
            given = np.ravel(np.asarray(initial_state, dtype=float))
            x0[: len(given)] = given
        driven = u @ (B - K @ D).T + y @ K.T
        x = state_trajectory(A - K @ C, driven, x0)
        for _ in range(min(delay, len(u))):  # one sample on, without the latest output
            x[1:] = x[:-1] @ A.T + u[:-1] @ B.T
            x[0] = x0
        return x @ C.T + u @ D.T

    def estimate_initial_state(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Initial state for `predict`, by least squares over all samples.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        y : array-like of shape (n_samples, n_outputs)

        Returns
        -------
        ndarray of shape (order,) or (order + n_noise_states,)
            Behind the errors of the simulation; with a `gain` that of all states,
            behind the errors of one-step prediction.
        """
        if self.gain is None:
            return self.lti.estimate_initial_state(u, y)
        error = finite_samples("y", y, self.lti.n_outputs) - self.predict(u, y)
        responses = free_responses(self.A - self.K @ self.C, self.C, len(error))
        return estimate_initial_state(responses, error)
