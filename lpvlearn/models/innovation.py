"""A deterministic model with a noise model: prediction from past outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..exceptions import VersionedPickle
from ..systems.least_squares import scaled_lstsq
from ..systems.simulation import (
    beside_transit,
    delayed,
    estimate_initial_state,
    free_responses,
    spread_of,
    state_trajectory,
)
from ..validation import (
    finite_samples,
    matrix,
    measured_samples,
    shown,
    squarable,
    state_vector,
    whole_number,
)
from .statespace import StateSpace, unknown_responses

Array = NDArray[np.float64]

# Of an output, the least that its errors count for
_CLEAN = 1e-9


class NoiseModel(NamedTuple):
    """``x[t+1] = A x[t] + K e[t]``, ``v[t] = C x[t] + e[t]``."""

    A: Array  # (n_states, n_states)
    C: Array  # (n_outputs, n_states)
    K: Array  # (n_states, n_outputs), innovation gain; A - K C is stable
    covariance: Array  # (n_outputs, n_outputs), of the innovations e

    @classmethod
    def white(cls, covariance: Array) -> NoiseModel:
        """The one without states.

        >>> NoiseModel.white(np.eye(2)).C.shape
        (2, 0)
        """
        ny = len(covariance)
        return cls(np.zeros((0, 0)), np.zeros((ny, 0)), np.zeros((0, ny)), covariance)


@dataclass(frozen=True, eq=False, repr=False)
class InnovationModel(VersionedPickle):
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

    def __post_init__(self) -> None:
        if not isinstance(self.lti, StateSpace) or self.lti.is_continuous:
            raise ValueError(
                "`lti` must be a StateSpace in discrete time. Got "
                f"{shown(self.lti)}. Sample it with to_discrete(sampling_time)."
            )
        if not isinstance(self.noise, tuple) or len(self.noise) != 4:
            raise ValueError(
                "`noise` must be a NoiseModel(A, C, K, covariance). Got "
                f"{shown(self.noise)}."
            )
        ny = self.lti.n_outputs
        A, C, K, covariance = map(matrix, NoiseModel._fields, self.noise)
        n = len(A)
        if n == 0 and C.size == K.size == 0:  # `[]`
            C, K = C.reshape(ny, 0), K.reshape(0, ny)
        shapes = [M.shape for M in (A, C, K, covariance)]
        if shapes != [(n, n), (ny, n), (n, ny), (ny, ny)]:
            raise ValueError(
                f"`noise` must have A ({n}, {n}), C ({ny}, {n}), K ({n}, {ny}) and "
                f"covariance ({ny}, {ny}). Got {shapes}."
            )
        object.__setattr__(self, "noise", NoiseModel(A, C, K, covariance))
        if self.gain is not None:
            gain = matrix("gain", self.gain)
            if gain.size == self.lti.order * ny == 0:
                gain = gain.reshape(self.lti.order, ny)
            if gain.shape != (self.lti.order, ny):
                raise ValueError(
                    f"`gain` must have shape ({self.lti.order}, {ny}). Got "
                    f"{gain.shape}."
                )
            object.__setattr__(self, "gain", gain)

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
            Missing values (NaN) are predicted from those beside them, and correct
            nothing.
        steps : int, default=1
            Prediction horizon in samples.
        initial_state : array-like of shape (order,), default=None
            Of the deterministic part, or, with a `gain`, of all states (order +
            n_noise_states). Inputs in transit may follow. None is rest.

        Returns
        -------
        ndarray of shape (n_samples, n_outputs)
            Row t uses the inputs up to t and the outputs up to ``t - steps``.
        """
        delay = whole_number("steps", steps, 1) - 1
        if self.gain is not None:
            return self._predict_jointly(u, y, delay, initial_state)
        simulated = self.lti.simulate(u, initial_state=initial_state)
        y = measured_samples(y, *simulated.shape)
        if self.n_noise_states == 0:
            return simulated
        A, C, K, _ = self.noise
        error = y - simulated
        known = ~np.isnan(error)
        if known.all():
            ahead = state_trajectory(A - K @ C, error @ K.T)
        else:
            gains = self._gains(K, known)
            forcing = np.einsum("tij,tj->ti", gains, np.where(known, error, 0.0))
            ahead = state_trajectory(A - gains @ C, forcing)
        decay = C @ np.linalg.matrix_power(A, delay)
        simulated[delay:] += ahead[: max(len(error) - delay, 0)] @ decay.T
        return simulated

    def _predict_jointly(
        self, u: ArrayLike, y: ArrayLike, delay: int, initial_state: ArrayLike | None
    ) -> Array:
        """By the predictor of all states, which is stable where the plant is not."""
        u = finite_samples("u", u, self.lti.n_inputs)
        y = measured_samples(y, len(u), self.lti.n_outputs)
        A, B, C, D = self.A, self.B, self.C, self.D
        gains, known = self._filter_gains(y)
        late = self.lti.input_delay
        n_late, n = int(late.sum()), self.lti.order
        x0 = np.zeros(len(A)) if initial_state is None else initial_state
        if np.size(x0) == n:  # the noise begins at rest
            x0 = np.append(state_vector(x0, n), np.zeros(self.n_noise_states))
        x0, before = np.split(state_vector(x0, len(A), n_late), [len(A)])
        u = delayed(u, late, before)
        corrected = np.where(known, y - u @ D.T, 0.0)
        driven = u @ B.T + (gains @ corrected[:, :, None])[:, :, 0]
        x = state_trajectory(A - gains @ C, driven, x0)
        for _ in range(min(delay, len(u))):  # one sample on, without the latest output
            x[1:] = x[:-1] @ A.T + u[:-1] @ B.T
            x[0] = x0
        return x @ C.T + u @ D.T

    def estimate_initial_state(
        self, u: ArrayLike, y: ArrayLike, trend: Array | None = None
    ) -> Array:
        """Initial state for `predict`, by least squares over all samples.

        Parameters
        ----------
        u : array-like of shape (n_samples, n_inputs)
        y : array-like of shape (n_samples, n_outputs)
            Missing values (NaN) are left out.
        trend : ndarray of shape (n_trend, n_samples), default=None
            Signals that any multiple of may be in every output, beside the model's.

        Returns
        -------
        ndarray of shape (order,) or (order + n_noise_states,)
            Behind the errors of the simulation; with a `gain` that of all states,
            behind the errors of one-step prediction. The inputs in transit follow, and
            the multiples of the trends: signal by signal, output by output.
        """
        u = squarable("u", finite_samples("u", u, self.lti.n_inputs))
        y = measured_samples(y, len(u), self.lti.n_outputs)
        if trend is not None:
            trend = matrix("trend", trend)
            if trend.shape[1] != len(u):
                raise ValueError(
                    f"`trend` must have shape (n_trend, {len(u)}), a value for each "
                    f"sample. Got {trend.shape}."
                )
        if self.gain is None:
            lti, error = self.lti, y - self.lti.simulate(u)
            responses = unknown_responses(lti, len(y), trend)
        else:
            error, (gains, _) = y - self.predict(u, y), self._filter_gains(y)
            responses = prediction_responses(self.A, self.C, gains, len(y), trend)
            A, B = self.A - gains @ self.C, self.B - gains @ self.D
            known = A, B, self.C, self.D, self.lti.input_delay
            responses = beside_transit(responses, *known)
        return estimate_initial_state(responses, error, self.error_sizes(y))

    def error_sizes(self, y: Array) -> Array:
        """How far the errors of outputs move: by which they count beside each other.

        The standard deviations of the innovations (n_outputs,), and of an output `y`
        (n_samples, n_outputs) that has next to none a part of its own: what a state
        leaves of an output that is clean the noise model would carry, many times over,
        to one that is not. Of predictions that are simulations, `spread_of`.
        """
        if not self.K.any():
            return spread_of(y)
        own = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return np.maximum(own, _CLEAN * spread_of(y))

    def _filter_gains(self, y: Array) -> tuple[Array, NDArray[np.bool_]]:
        """K, one for every sample where outputs are missing, and which are known."""
        known = ~np.isnan(y)
        gains = self.K if known.all() else self._gains(self.K, known)
        return gains, known

    def _gains(self, K: Array, known: NDArray[np.bool_]) -> Array:
        """K for the outputs that are known: of the others the expected innovation."""
        covariance = self.noise.covariance
        gains = np.zeros((len(known), *K.shape))
        for pattern in np.unique(known, axis=0):
            own = np.flatnonzero(pattern)
            others, _ = scaled_lstsq(covariance[np.ix_(own, own)], covariance[own])
            rows = np.flatnonzero((known == pattern).all(axis=1))
            gains[np.ix_(rows, np.arange(len(K)), own)] = K @ others.T
        return gains


def prediction_responses(
    A: Array, C: Array, K: Array, n_samples: int, trend: Array | None
) -> Array:
    """As `free_responses`, of the errors of one-step prediction.

    `K` is one gain or one for every sample. A trend of an output passes the predictor
    like the output, and what that predicts of it is no error.
    """
    (ny, n), signals = C.shape, np.zeros((0, n_samples)) if trend is None else trend
    trends = free_responses(A, C, n_samples, signals)[:, :, n:]
    forcing = np.zeros((n_samples, n, n + len(signals) * ny))
    forcing[:, :, n:] = K @ trends
    x = state_trajectory(A - K @ C, forcing, np.eye(*forcing.shape[1:]))
    responses = C @ x
    responses[:, :, n:] = trends - responses[:, :, n:]
    return responses
