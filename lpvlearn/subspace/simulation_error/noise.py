"""The noise in the simulation errors of a model, and how to weigh them by it.

The errors v are described by an autoregression in innovation form, ``v = H e`` with
white e (`autoregression`). Their sum of squares is the likelihood where they are white
and equally large, which `Whitening` makes them: a filter f common to all channels and
a weight W of the outputs,

    ``u_w = f(q) u``, ``y_w = W f(q) y``,

under which the dynamics stay the same, ``G_w = W G``, for a filter of all channels
commutes with them. Colours that differ from output to output are evened out on the
whole only, the correlation of the innovations completely.

Errors of outputs that are missing are unknown: `expected_noise` is where the
innovations are the smallest, and `noise_of` describes the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import log
from operator import mul
from typing import NamedTuple

import numpy as np
import scipy  # which loads its signal package when that is first used: slowly
from numpy.typing import NDArray
from scipy import fft, linalg
from scipy.sparse.linalg import LinearOperator, cg

from ...models.innovation import InnovationModel, NoiseModel
from ...systems.balancing import balancing_transformation
from ...systems.innovations import covariance_root, kalman_filter
from ...systems.least_squares import diagonal_scale
from ...systems.response import resolvent
from ...systems.simulation import lti_response, state_trajectory
from ..samples.hankel import correlation_sequence
from ..samples.records import Record
from .simulation_fit import Freedom, Realization

Array = NDArray[np.float64]

# Lags that are allowed for by the number of samples: 10 log10(n), a customary limit.
_LAGS_PER_DECADE = 10.0

# Part of an experiment over which its errors rise from zero and fall to it: noise of
# long memory that ends abruptly looks like noise with jumps (Dahlhaus, 1988).
_TAPERED = 0.2

_PATIENCE = 12  # lags beyond the best number that are looked at

_MAX_CONDITION = 1e8  # of eigenvectors, which would lose half of the spectrum's digits

# Size of an error, relative to the output or to other errors, that is not noise
_ROUNDING = 1e-9

_FORGOTTEN = 100.0  # samples, after which the amplitude of a wave is another

# Samples of an experiment by those that a filter takes away from it at its start.
_LEAST_LEFT = 8

# Between the noise of two outputs: the weight of a clean one is known no better, for
# its errors come from the dynamics that it shares with the others.
_LARGEST_RATIO = 1e4

# Filters and weights that differ by less cost the square of it in efficiency.
_SAME_FILTER, _SAME_WEIGHT = 0.05, 1.05

_NOTHING = 1e-9  # of a constant: rounding of a filter that takes differences

_LEAST_VARIANCE = 1e-6  # of a combination of outputs of unit variance, for its weight

_DRAWN = 15  # times that missing errors are drawn, for the model of the noise

# Of conjugate gradients: standard deviations of an innovation, and steps
_TOLERANCE, _STEPS = 1e-3, 200


class Whitening(NamedTuple):
    """A filter and a weight after which errors are white and equally large."""

    filter: Array  # (n_lags + 1,), the first is 1
    weight: Array  # (n_outputs, n_outputs), of determinant 1

    @classmethod
    def none(cls, n_outputs: int) -> Whitening:
        """The one that changes nothing."""
        return cls(np.ones(1), np.eye(n_outputs))

    @classmethod
    def of(
        cls, errors: Sequence[Array], free: Freedom, *, filtered: bool = True
    ) -> Whitening:
        """That of the simulation errors of scaled records, a row per sample.

        Without a filter only the outputs are weighted: for a first model, in which the
        errors of a clean output are those of the dynamics, and coloured by them.

        Errors that are rounding are left as they are.

        >>> e = np.random.default_rng(0).standard_normal((5000, 1))
        >>> v = scipy.signal.lfilter([1.0], [1.0, -0.9], e, axis=0)
        >>> Whitening.of([v], Freedom(np.ones((1, 1), bool))).filter.round(2)
        array([ 1. , -0.9])
        """
        size = np.sqrt(np.mean(np.vstack(errors) ** 2, axis=0))
        noisy = np.flatnonzero(size > _ROUNDING)
        if len(noisy) == 0 or not np.isfinite(size).all():
            return cls.none(len(size))
        coefficients = np.ones(1)
        if filtered:
            channels = [e[:, [i]] / size[i] for e in errors for i in noisy]
            middle = int(np.median([len(e) for e in errors]))
            highest = middle // _LEAST_LEFT
            coefficients = whitening_filter(autoregression(channels, highest=highest))
        whitened = cls(coefficients, np.eye(len(size)))._filtered(errors)
        return cls(coefficients, _weight(np.vstack(whitened), free))

    @property
    def is_none(self) -> bool:
        """Whether it changes nothing."""
        return len(self.filter) == 1 and _is_identity(self.weight)

    @property
    def of_differences(self) -> bool:
        """Whether it leaves nothing of a constant: the noise drifts (`drift`)."""
        return bool(abs(self.filter.sum()) < _NOTHING)

    def is_close_to(self, other: Whitening) -> bool:
        """Whether it would give much the same model as another one."""
        if len(self.filter) != len(other.filter):
            return False
        ratio = linalg.svdvals(linalg.solve(other.weight, self.weight))
        close = np.abs(self.filter - other.filter).max() <= _SAME_FILTER
        return bool(close and ratio[0] <= _SAME_WEIGHT * ratio[-1])

    def _filtered(self, samples: Sequence[Array]) -> list[Array]:
        """Samples without those to which the filter would need others before them."""
        lost = len(self.filter) - 1
        return [through_filter(self.filter, z) for z in samples if len(z) > 2 * lost]

    def records(self, records: Sequence[Record], free: Freedom) -> list[Record]:
        """Samples filtered and weighted.

        The first samples, to which the filter would need others before them, are left
        out, and experiments that are too short for it; where all begin at rest
        there is nothing before.
        """
        lost = len(self.filter) - 1
        first = lost if free.initial_states else 0
        out = []
        for u, y, trend, missing, _ in records:
            if u.shape[1] > 2 * lost:
                if lost:
                    u, y, trend = (
                        through_filter(self.filter, z.T, first).T if len(z) else z
                        for z in (u, y, trend)
                    )
                if not _is_identity(self.weight):
                    y = self.weight @ y
                u, y, trend = (np.ascontiguousarray(z) for z in (u, y, trend))
                out.append(Record(u, y, trend, missing[:, first:]))
        return out

    def lengths(self, records: Sequence[Record], free: Freedom) -> list[int]:
        """Samples of every one of the `records` that it leaves."""
        lost = len(self.filter) - 1
        first = lost if free.initial_states else 0
        lengths = [record.n_samples for record in records]
        return [n - first for n in lengths if n > 2 * lost]

    def model(self, model: Realization) -> Realization:
        """The model of whitened samples; states and loss are still those before."""
        return model._replace(C=self.weight @ model.C, D=self.weight @ model.D)

    def undone(self, model: Realization) -> Realization:
        """The model of the samples before, by one of whitened samples."""
        C, D = (linalg.solve(self.weight, M) for M in (model.C, model.D))
        return model._replace(C=C, D=D)


def whitening_filter(noise: NoiseModel) -> Array:
    """Coefficients ``[1, a_1, ..., a_p]`` that whiten an `autoregression` of a channel.

    >>> e = np.random.default_rng(0).standard_normal((5000, 1))
    >>> v = scipy.signal.lfilter([1.0], [1.0, -0.9], e, axis=0)
    >>> whitening_filter(autoregression([v])).round(2)
    array([ 1. , -0.9])
    """
    return np.append(1.0, -noise.C[0])


def through_filter(a: Array, signals: Array, first: int | None = None) -> Array:
    """Signals, a row per sample, through ``a(q)``: from the `first` sample on.

    None leaves out the first ones, to which the filter would need others before them.

    >>> through_filter(np.array([1.0, -1.0]), np.array([1.0, 3.0, 6.0]))
    array([2., 3.])
    """
    through: Array = scipy.signal.lfilter(a, [1.0], signals, axis=0)
    return through[len(a) - 1 if first is None else first :]


def _is_identity(weight: Array) -> bool:
    return np.array_equal(weight, np.eye(len(weight)))


def _weight(errors: Array, free: Freedom) -> Array:
    """Weight of white errors: their covariance to the power of minus one half.

    Equal, unequal or correlated outputs, whichever has the least value of Schwarz's
    criterion. Correlated ones are mixed, which single entries of D that are known to
    be zero do not allow.
    """
    n, ny = errors.shape
    if ny == 1:
        return np.eye(1)
    size = np.sqrt(np.mean(errors**2, axis=0))
    size = np.maximum(size, size.max() / _LARGEST_RATIO)
    unit = errors / size
    correlation = unit.T @ unit / n
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh(correlation)
    values = np.maximum(values, _LEAST_VARIANCE)
    equal = ny * np.log(np.mean(size**2))
    unequal = float(np.sum(np.log(size**2)))
    correlated = unequal + float(np.sum(np.log(values)))
    penalty = np.log(n) / n
    criteria = [equal, unequal + (ny - 1) * penalty]
    if (free.direct == free.direct[0]).all():
        criteria.append(correlated + (ny * (ny + 1) / 2 - 1) * penalty)
    best = int(np.argmin(criteria))
    if best == 0:
        return np.eye(ny)
    root = (vectors / np.sqrt(values)) @ vectors.T if best == 2 else np.eye(ny)
    weight = root / size
    return weight / np.linalg.det(weight) ** (1.0 / ny)


def autoregression(
    errors: Sequence[Array], *, highest: int | None = None
) -> NoiseModel:
    """Vector autoregression of simulation errors, in innovation form.

    One array (n_samples_i, n_outputs) per experiment. The number of lags is that with
    the smallest value of Schwarz's criterion, up to ``10 log10(n_samples)``
    or `highest`.

    >>> from scipy.signal import lfilter
    >>> e = np.random.default_rng(0).standard_normal((5000, 1))
    >>> model = autoregression([lfilter([1.0], [1.0, -0.9], e, axis=0)])
    >>> model.A.round(2)
    array([[0.9]])
    """
    ny, n_samples = errors[0].shape[1], sum(len(v) for v in errors)
    longest = max(len(v) for v in errors)
    # Half as many coefficients of an output as the longest experiment has samples.
    allowed = (longest - 1) // (2 * ny)
    if highest is not None:
        allowed = min(allowed, highest)
    highest = max(0, min(int(_LAGS_PER_DECADE * np.log10(n_samples)), allowed))
    lags = np.zeros((highest + 1, ny, ny))
    weight = 0.0
    for v in errors:
        known = min(len(v), highest + 1)
        weights = taper(len(v))
        lags[:known] += correlation_sequence(weights * v, known)
        weight += float((weights**2).sum())
    lags /= weight
    # Channels of very different size must not spoil the determinants.
    scale = diagonal_scale(lags[0])
    lags = lags / scale[:, None] / scale
    best, best_p, found = np.inf, 0, (np.zeros((ny, 0)), lags[0])
    price = ny * ny * np.log(n_samples) / n_samples
    regressions = _scalar_regressions if ny == 1 else _regressions
    for p, (coefficients, covariance) in enumerate(regressions(lags)):
        sign, logdet = _log_determinant(covariance)
        if not sign > 0.0 or p > best_p + _PATIENCE:  # no noise is left, or no colour
            break
        criterion = logdet + p * price
        if criterion < best:
            best, best_p, found = criterion, p, (coefficients, covariance)
    coefficients, covariance = found
    n = coefficients.shape[1]
    blocks = coefficients.reshape(ny, n // ny, ny) * scale[:, None, None] / scale
    C = blocks.reshape(ny, n)
    A = np.eye(n, k=-ny)  # the state holds the last errors
    A[: min(n, ny)] = C[: min(n, ny)]
    return NoiseModel(A, C, np.eye(n, ny), covariance * np.outer(scale, scale))


@lru_cache(maxsize=8)
def taper(n_samples: int) -> Array:
    """Weights of the samples of an experiment, (n_samples, 1), not to be changed."""
    weights: Array = scipy.signal.windows.tukey(n_samples + 2, _TAPERED)[1:-1, None]
    return weights


def _log_determinant(covariance: Array) -> tuple[float, float]:
    """Sign and logarithm; of numbers at a tenth of the time of `slogdet`."""
    if covariance.size > 1:
        sign, logarithm = np.linalg.slogdet(covariance)
        return float(sign), float(logarithm)
    value = covariance.item()
    return (1.0, log(value)) if value > 0.0 else (0.0, -np.inf)


def _scalar_regressions(lags: Array) -> Iterator[tuple[Array, Array]]:
    """As `_regressions` of one channel, whose predictions back mirror those forth."""
    r = lags[:, 0, 0].tolist()
    forth: list[float] = []
    variance = r[0]
    yield np.array([forth]), np.array([[variance]])
    for p in range(1, len(r)):
        if variance == 0.0:  # nothing is left to explain
            return
        new = r[p] - sum(map(mul, forth, r[p - 1 : 0 : -1]))
        gain = new / variance
        forth = [f - gain * b for f, b in zip(forth, reversed(forth), strict=True)]
        forth.append(gain)
        variance -= gain * new
        yield np.array([forth]), np.array([[variance]])


def _regressions(lags: Array) -> Iterator[tuple[Array, Array]]:
    """Coefficients ``[Phi_1, ..., Phi_p]`` and innovation covariance for every order p.

    ``lags[d] = E v[t] v[t + d].T``. The recursion of Levinson for several channels
    (Whittle, 1963): the errors of predictions forth and back over p samples tell what
    one sample more adds to either.
    """
    n_lags, ny = len(lags) - 1, lags.shape[1]
    # E v[t] v[t - d].T for d = n_lags .. 1, one below the other
    before = lags[:0:-1].transpose(0, 2, 1).reshape(-1, ny)
    forth = back = np.zeros((ny, 0))  # the coefficients of the latter last to first
    ahead = behind = lags[0]  # covariances of the errors
    yield forth, ahead
    for p in range(n_lags):
        known = before[(n_lags - p) * ny :]
        new = before[(n_lags - p - 1) * ny : (n_lags - p) * ny] - forth @ known
        try:
            gain = np.linalg.solve(behind.T, new.T).T
            other = np.linalg.solve(ahead.T, new).T
        except np.linalg.LinAlgError:  # nothing is left to explain
            return
        forth, back = (
            np.hstack([forth - gain @ back, gain]),
            np.hstack([other, back - other @ forth]),
        )
        ahead, behind = ahead - gain @ new.T, behind - other @ new
        ahead, behind = 0.5 * (ahead + ahead.T), 0.5 * (behind + behind.T)
        yield forth, ahead


def noise_of(errors: Sequence[Array]) -> NoiseModel:
    """`autoregression` of errors of which some are missing (NaN).

    Of what is drawn by the model before from all that the missing ones may be: a signal
    by the model, and what is expected of the difference. Expected errors alone have not
    the power that the noise has, and would be more and more of a wave through those
    that are known (stochastic EM: G. Celeux and J. Diebolt, 1985).

    >>> e = np.random.default_rng(0).standard_normal((5000, 1))
    >>> v = lti_response(*np.array([[[0.9]], [[1.0]], [[0.9]], [[1.0]]]), e)
    >>> v[np.random.default_rng(1).random(5000) < 0.4] = np.nan
    >>> noise_of([v]).C.round(2)
    array([[0.9]])
    """
    missing = np.isnan(np.vstack(errors))
    if not missing.any():
        return autoregression(errors)
    rng = np.random.default_rng(0)  # the same draws from round to round
    white = [rng.standard_normal(v.shape) for v in errors]
    n_known = np.maximum(np.count_nonzero(~missing, axis=0), 1)
    power = np.nansum(np.vstack(errors) ** 2, axis=0) / n_known
    noise = NoiseModel.white(np.diag(power))
    for _ in range(_DRAWN):
        root = covariance_root(noise.covariance)
        signals = [
            lti_response(noise.A, noise.K @ root, noise.C, root, z) for z in white
        ]
        drawn = [
            np.where(np.isnan(v), signal + expected_noise(noise, v - signal), v)
            for v, signal in zip(errors, signals, strict=True)
        ]
        noise = autoregression(drawn)
    return noise


def expected_noise(noise: NoiseModel, v: Array) -> Array:
    """What noise is expected to be where it is not known (NaN)."""
    whitener = noise.A - noise.K @ noise.C, noise.K, -noise.C, np.eye(len(noise.C))
    missing = np.isnan(v)
    v = np.where(missing, 0.0, v)
    return v + expected_change(noise, lti_response(*whitener, v), missing)


def expected_change(
    noise: NoiseModel | InnovationModel, innovations: Array, missing: NDArray[np.bool_]
) -> Array:
    """Change of missing outputs after which the innovations are the smallest.

    Both arrays have shape (n_samples, n_outputs); `innovations` are those of some
    values of the missing outputs. What comes after an experiment is not asked about.
    """
    A, C, K, S = noise.A, noise.C, noise.K, noise.covariance
    change = np.zeros(missing.shape)
    if not missing.any():
        return change
    scale = np.sqrt(np.maximum(np.diagonal(S), 0.0))
    scale = np.maximum(scale, _ROUNDING * np.sqrt(np.mean(innovations**2, axis=0)))
    scale[scale == 0.0] = 1.0
    weight = np.linalg.pinv(
        S / scale[:, None] / scale, rcond=_LEAST_VARIANCE, hermitian=True
    )
    # Answers of the innovations, each in its own size, to impulses of the outputs
    forcing = np.zeros((len(missing), *K.shape))
    forcing[0] = K * scale
    answers = -(C / scale[:, None]) @ state_trajectory(A - K @ C, forcing)
    answers[0] += np.eye(len(S))
    n_padded = fft.next_fast_len(2 * len(missing), real=True)
    spectrum = fft.rfft(answers, n_padded, axis=0)

    def convolved(spectrum: NDArray[np.complex128], v: Array) -> Array:
        transformed = spectrum @ fft.rfft(v, n_padded, axis=0)[:, :, None]
        return fft.irfft(transformed[:, :, 0], n_padded, axis=0)[: len(v)]

    transposed = spectrum.conj().transpose(0, 2, 1)

    def normal(x: Array) -> Array:
        values = np.zeros(missing.shape)
        values[missing] = x
        return convolved(transposed, convolved(spectrum, values) @ weight)[missing]

    size = np.count_nonzero(missing)
    equations = LinearOperator((size, size), matvec=normal)
    right = -convolved(transposed, (innovations / scale) @ weight)[missing]
    tolerance = _TOLERANCE * np.sqrt(size)  # standard deviations
    change[missing], _ = cg(equations, right, rtol=0.0, atol=tolerance, maxiter=_STEPS)
    return change * scale


def reduced_noise_model(model: NoiseModel, order: int) -> NoiseModel:
    """Noise model of fewer states by balanced truncation; itself where it has no more.

    The gain is computed anew from the Riccati equation, so that the predictor of
    the truncated model is stable.
    """
    if len(model.A) <= order:
        return model
    if order == 0:
        P = linalg.solve_discrete_lyapunov(
            model.A, model.K @ model.covariance @ model.K.T
        )
        spread = model.C @ P @ model.C.T + model.covariance
        return NoiseModel.white(spread)
    root = linalg.cholesky(model.covariance, lower=True)
    _, left, right = balancing_transformation(
        model.A, model.K @ root, model.C, discrete=True
    )
    left, right = left[:order], right[:, :order]
    A, C, K = left @ model.A @ right, model.C @ right, left @ model.K
    Q, S = K @ model.covariance @ K.T, K @ model.covariance
    gain, covariance = kalman_filter(A, C, Q, S, model.covariance)
    return NoiseModel(A, C, gain, 0.5 * (covariance + covariance.T))


def beside_waves(
    noise: NoiseModel, turns: Array
) -> tuple[Array, Array, Array, NoiseModel]:
    """Sinusoids of every output beside a noise, and the predictor of both.

    ``w[t+1] = R w[t]``, ``y[t] = C w[t] + v[t]``: R, C, the gain of w, and the noise
    with its own. Amplitudes and phases wander a little, so that they are forgotten.
    """
    ny, n = noise.C.shape
    c, s = np.cos(turns), np.sin(turns)
    rotations = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    R = linalg.block_diag(*np.repeat(rotations, ny, axis=0))
    C = np.tile(np.kron(np.eye(ny), [[1.0, 0.0]]), len(turns))
    covariance = noise.covariance + _ROUNDING**2 * np.eye(ny)
    wander = np.tile(np.repeat(np.diagonal(covariance), 2), len(turns)) / _FORGOTTEN**2
    Q = linalg.block_diag(noise.K @ covariance @ noise.K.T, np.diag(wander))
    S = np.vstack([noise.K @ covariance, np.zeros((len(R), ny))])
    A, both = linalg.block_diag(noise.A, R), np.hstack([noise.C, C])
    gain, found = kalman_filter(A, both, Q, S, covariance)
    found = 0.5 * (found + found.T)
    return R, C, gain[n:], NoiseModel(noise.A, noise.C, gain[:n], found)


def spectral_density(model: NoiseModel, omega: Array) -> NDArray[np.complex128]:
    """Spectral density of v, ``H covariance H^*``, at radians per sample."""
    ny, n = model.C.shape
    H = np.broadcast_to(np.eye(ny, dtype=complex), (len(omega), ny, ny))
    if n:
        poles, vectors = np.linalg.eig(model.A)
        left = linalg.lstsq(vectors, model.K + 0j)[0]
        z = np.exp(1j * omega)
        # A nearly defective A would lose accuracy in modal form.
        if np.linalg.cond(vectors) < _MAX_CONDITION:
            weights = 1.0 / (z[:, None] - poles)
            H = H + np.einsum("oi,fi,ij->foj", model.C @ vectors, weights, left)
        else:
            H = H + model.C @ resolvent(model.A, z, model.K)
    return H @ model.covariance @ H.conj().transpose(0, 2, 1)
