"""What the simulation errors of a fitted model tell: prediction and uncertainty.

The errors v of a model that minimises their sum of squares are described by an
autoregression, in innovation form ``v = H e`` with ``H = C (zI - A)^-1 K + I``, which
predicts them as well.

With J the Jacobian of the simulated outputs, the estimate moves by
``inv(J.T J) J.T v`` to first order. Its covariance is the sandwich ``inv(H) S inv(H)``
with ``H = J.T J`` and ``S = J.T cov(v) J``, so that coloured noise and outputs of
different quality are accounted for (Ljung, *System Identification*, 1999, Section 9.4).
J is a fixed combination of the section signals; S is summed over frequencies.

`Evidence` holds what this is computed from; `deviated_models` carries the covariance
on to what becomes of a model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from ..data.preparation import independent_inputs, remove_trends
from ..models.innovation import InnovationModel, NoiseModel
from ..models.statespace import DEVIATION, ModelPair, StateSpace
from ..systems.balancing import balancing_transformation
from ..systems.simulation import (
    estimate_initial_state,
    free_responses,
    lti_response,
)
from .hankel import correlation_sequence
from .identification import scale_records
from .refinement import refine_simulation
from .signals import Record, block_slices, signal_pieces
from .simulation_fit import (
    Freedom,
    Realization,
    in_sections,
    jacobian_regression,
    moved_model,
    parameter_slices,
)

Array = NDArray[np.float64]

# Averages over the record are known to a percent or so from this many samples.
_MAX_SAMPLES = 30_000

_NEGLIGIBLE = 1e-12  # relative variance below which a direction is rounding

# Lags that are allowed for by the number of samples: 10 log10(n), a customary limit.
_LAGS_PER_DECADE = 10.0

_RCOND_LAGS = 1e-13  # directions of past errors that are their rounding
_MAX_CONDITION = 1e8  # of eigenvectors, which would lose half of the spectrum's digits
_RCOND = 1e-15  # the weakest direction of the information that is told from rounding


@dataclass(frozen=True, eq=False)
class Evidence:
    """A model of scaled samples, and samples that its statistics are computed from.

    All of them are computed when first asked for.
    """

    model: Realization  # of the scaled records
    records: list[Record]
    input_scale: Array  # units of the channels in them
    output_scale: Array
    basis: Array  # (n_inputs, rank): original inputs in terms of the independent ones
    free: Freedom
    refined: bool  # whether the model minimises the simulation error
    share: float  # samples in `records` by all samples that were used

    @cached_property
    def noise(self) -> NoiseModel:
        """Autoregression of the simulation errors, in the scale of the records."""
        return _noise_of(self.model, self.records)

    @cached_property
    def covariance(self) -> Array:
        """Of the parameters, as `_parameter_covariance` has them, where it is known."""
        if not self.refined:
            raise ValueError(
                "The covariance is that of a model that minimises the simulation "
                "error: it needs refine=True and an unconstrained minimum."
            )
        if self.sections.blocks is None:
            raise ValueError(
                "The covariance needs poles of multiplicity two at most. Lower `order`."
            )
        data = self.records, self.free, self.noise
        return _parameter_covariance(self.sections, *data) * self.share

    @cached_property
    def sections(self) -> Realization:
        """The model in section form, where there is one."""
        return in_sections(self.model)

    def state_space(
        self, model: Realization, sampling_time: float | None
    ) -> StateSpace:
        """A model of scaled samples in the units of the data."""
        su, sy = self.input_scale, self.output_scale[:, None]
        return StateSpace(
            model.A,
            model.B / su @ self.basis.T,
            sy * model.C,
            sy * model.D / su @ self.basis.T,
            sampling_time,
        )

    def predictor(self, lti: StateSpace, n_noise_states: int | None) -> InnovationModel:
        """Innovation model of `lti`; None keeps all states of the noise model."""
        noise, sy = self.noise, self.output_scale
        if n_noise_states is not None:
            noise = _reduce_noise_model(noise, n_noise_states)
        C, K = sy[:, None] * noise.C, noise.K / sy
        covariance = noise.covariance * np.outer(sy, sy)
        return InnovationModel(lti, NoiseModel(noise.A, C, K, covariance))

    def poles_std(self) -> NDArray[np.complex128]:
        """Standard deviations of the poles, in the order of `StateSpace.poles`."""
        covariance = self.covariance
        poles, J = _pole_jacobian(self.sections, self.free, len(covariance))
        order = np.lexsort((poles.imag, poles.real, np.abs(poles)))
        return _deviations(J, covariance)[order]

    def frequency_response_covariance(self, omega: Array) -> Array:
        """Covariance of the real parts of all entries, then of their imaginary parts.

        Shape (n_freq, k, k) with ``k = 2 n_outputs n_inputs``; radians per sample.
        """
        covariance, J = self.covariance, self._frequency_jacobian(omega)
        flat = J.reshape(len(J), -1, J.shape[-1])
        parts = np.concatenate([flat.real, flat.imag], axis=1)
        return parts @ covariance @ parts.transpose(0, 2, 1)

    def frequency_response_std(self, omega: Array) -> NDArray[np.complex128]:
        """Standard deviations, shape (n_freq, n_outputs, n_inputs)."""
        covariance = self.covariance
        return _deviations(self._frequency_jacobian(omega), covariance)

    def _frequency_jacobian(self, omega: Array) -> NDArray[np.complex128]:
        J = _frequency_response_jacobian(self.sections, self.free, omega)
        J = np.einsum("foip,ui->foup", J, self.basis / self.input_scale)
        return J * self.output_scale[:, None, None]


def _deviations(J: NDArray[np.complex128], covariance: Array) -> NDArray[np.complex128]:
    """Standard deviations of the real and the imaginary part of what has Jacobian J."""
    variances = [
        np.einsum("...p,pq,...q->...", part, covariance, part)
        for part in (J.real, J.imag)
    ]
    real, imag = (np.sqrt(np.maximum(variance, 0.0)) for variance in variances)
    return real + 1j * imag


def shorten(records: list[Record]) -> tuple[list[Record], float]:
    """Heads of the records, some 30,000 samples in total, and their share."""
    total = sum(record.u.shape[1] for record in records)
    share = _MAX_SAMPLES / total
    if share >= 1.0:
        return records, 1.0
    parts = [r.head(max(2, int(share * r.u.shape[1]))) for r in records]
    return parts, sum(record.u.shape[1] for record in parts) / total


def deviated_models(
    lti: StateSpace,
    pairs: Sequence[tuple[Array, Array]],
    *,
    detrend: str | None = None,
    refined: bool = True,
    output_scale: Array | None = None,
) -> list[ModelPair]:
    """Models to either side of an estimate, along its directions of uncertainty.

    `lti` is a discrete-time model, fitted to the experiments `pairs` (u, y) after
    `detrend`; so are the others. The models of a pair are `DEVIATION` standard
    deviations from the estimate; directions are independent. Empty where the covariance
    is not known: the model does not minimise the simulation error (`refined`), it has
    no states, its inputs are collinear, or poles coincide. It weighed errors equally in
    units of `output_scale`, by default those of the fit.
    """
    A, B, C, D = lti.A, lti.B, lti.C, lti.D
    n, m = B.shape
    if not refined or n == 0:
        return []
    if independent_inputs([u for u, _ in pairs]) is not None:  # they are collinear
        return []
    centred = remove_trends(list(pairs), detrend)[0]
    scale = output_scale
    if scale is None:
        scale = scale_records(centred).output_scale
    records, share = shorten([Record(u.T, (y / scale).T) for u, y in centred])
    C, D = C / scale[:, None], D / scale[:, None]
    states, _ = _scaled_errors(lti, [(u.T, scale * y.T) for u, y in records], scale)
    evidence = Evidence(
        model=Realization(A, B, C, D, np.array(states), np.nan),
        records=records,
        input_scale=np.ones(m),
        output_scale=scale,
        basis=np.eye(m),
        free=Freedom(D != 0.0),
        refined=True,
        share=share,
    )
    noisy = np.trace(evidence.noise.covariance) > 0.0
    if evidence.sections.blocks is None or not noisy:
        return []

    def deviated(change: Array) -> StateSpace:
        model = moved_model(evidence.sections, change, evidence.free)
        return evidence.state_space(model, lti.sampling_time)

    changes = DEVIATION * _square_root(evidence.covariance).T
    return [(deviated(change), deviated(-change)) for change in changes]


def _square_root(covariance: Array) -> Array:
    """L with ``L L.T`` the covariance, of full column rank."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > _NEGLIGIBLE * values[-1]
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])


def _noise_of(model: Realization, records: Sequence[Record]) -> NoiseModel:
    """Autoregression of the simulation errors of a model on its records."""
    return autoregression(
        [
            record.y.T - lti_response(*model[:4], record.u.T, x0)
            for record, x0 in zip(records, model.initial_states, strict=True)
        ]
    )


def autoregression(errors: Sequence[Array]) -> NoiseModel:
    """Vector autoregression of simulation errors, in innovation form.

    One array (n_samples_i, n_outputs) per experiment. The number of lags is that with
    the smallest value of Schwarz's criterion, up to ``10 log10(n_samples)``.

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
    highest = max(0, min(int(_LAGS_PER_DECADE * np.log10(n_samples)), allowed))
    lags = np.zeros((highest + 1, ny, ny))
    for v in errors:
        known = min(len(v), highest + 1)
        lags[:known] += correlation_sequence(v, known)
    lags /= n_samples
    # Channels of very different size must not spoil the determinants.
    scale = np.sqrt(np.maximum(np.diagonal(lags[0]), 0.0))
    scale[scale == 0.0] = 1.0
    lags = lags / scale[:, None] / scale
    best, found = np.inf, (np.zeros((ny, 0)), lags[0])
    for p in range(highest + 1):
        coefficients, covariance = _yule_walker(lags, p)
        sign, logdet = np.linalg.slogdet(covariance)
        if not sign > 0.0:  # errors without noise
            break
        criterion = logdet + p * ny * ny * np.log(n_samples) / n_samples
        if criterion < best:
            best, found = criterion, (coefficients, covariance)
    coefficients, covariance = found
    n = coefficients.shape[1]
    blocks = coefficients.reshape(ny, n // ny, ny) * scale[:, None, None] / scale
    C = blocks.reshape(ny, n)
    A = np.eye(n, k=-ny)  # the state holds the last errors
    A[: min(n, ny)] = C[: min(n, ny)]
    return NoiseModel(A, C, np.eye(n, ny), covariance * np.outer(scale, scale))


def _yule_walker(lags: Array, order: int) -> tuple[Array, Array]:
    """Coefficients ``[Phi_1, ..., Phi_p]`` and innovation covariance.

    ``lags[d] = E v[t] v[t + d].T``, of more lags than the order.
    """
    ny = lags.shape[1]
    if order == 0:
        return np.zeros((ny, 0)), lags[0]
    gram = np.empty((order * ny, order * ny))
    for i in range(order):
        for j in range(order):
            block = lags[i - j] if i >= j else lags[j - i].T
            gram[i * ny : (i + 1) * ny, j * ny : (j + 1) * ny] = block
    right = lags[1 : order + 1].reshape(order * ny, ny)
    solution = linalg.lstsq(gram, right, cond=_RCOND_LAGS, check_finite=False)[0]
    covariance = lags[0] - right.T @ solution
    return solution.T, 0.5 * (covariance + covariance.T)


def _reduce_noise_model(model: NoiseModel, order: int) -> NoiseModel:
    """Noise model of fewer states by balanced truncation; itself where it has no more.

    The gain is computed anew from the Riccati equation, so that the predictor of
    the truncated model is stable.
    """
    if len(model.A) <= order:
        return model
    ny = len(model.C)
    if order == 0:
        P = linalg.solve_discrete_lyapunov(
            model.A, model.K @ model.covariance @ model.K.T
        )
        spread = model.C @ P @ model.C.T + model.covariance
        return NoiseModel(
            np.zeros((0, 0)), np.zeros((ny, 0)), np.zeros((0, ny)), spread
        )
    root = linalg.cholesky(model.covariance, lower=True)
    _, left, right = balancing_transformation(
        model.A, model.K @ root, model.C, discrete=True
    )
    left, right = left[:order], right[:, :order]
    A, C, K = left @ model.A @ right, model.C @ right, left @ model.K
    Q, S = K @ model.covariance @ K.T, K @ model.covariance
    P = linalg.solve_discrete_are(A.T, C.T, Q, model.covariance, s=S)
    covariance = C @ P @ C.T + model.covariance
    gain = linalg.solve(covariance, (A @ P @ C.T + S).T, assume_a="pos").T
    return NoiseModel(A, C, gain, 0.5 * (covariance + covariance.T))


def _spectrum(model: NoiseModel, omega: Array) -> NDArray[np.complex128]:
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
            resolvent = z[:, None, None] * np.eye(n) - model.A
            H = H + model.C @ np.linalg.solve(resolvent, model.K + 0j)
    return H @ model.covariance @ H.conj().transpose(0, 2, 1)


def _parameter_covariance(
    model: Realization, records: Sequence[Record], free: Freedom, noise: NoiseModel
) -> Array:
    """Covariance of the parameters (B, D, A, C), initial states allowed for.

    Of a model in section form, at the minimum of the simulation error on the records.
    Along changes of the state basis, which the data do not determine, it is zero.
    """
    assert model.blocks is not None
    information: Array | float = 0.0
    score: Array | float = 0.0
    own = free.n_own(len(model.A))
    for record, x0 in zip(records, model.initial_states, strict=True):
        H, S = _experiment_terms(model, record, x0, free, noise)
        if own:
            # What the initial state can explain tells nothing about the others.
            explain = np.linalg.pinv(H[:own, :own], hermitian=True) @ H[:own, own:]
            keep = np.vstack([-explain, np.eye(len(H) - own)])
            H, S = keep.T @ H @ keep, keep.T @ S @ keep
        information, score = information + H, score + S
    H, S = np.asarray(information), np.asarray(score)
    # Rounding may leave a vanishing diagonal negative.
    scale = np.sqrt(np.maximum(np.diagonal(H), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale)
    n_gauge = sum(block.size for block in model.blocks)
    kept = np.arange(len(values)) >= n_gauge
    kept &= values > _RCOND * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    inverse = inverse / scale[:, None] / scale
    n_values = sum(record.y.size for record in records)
    n_free = int(kept.sum()) + len(records) * own
    return inverse @ S @ inverse * (n_values / max(n_values - n_free, 1))


def _experiment_terms(
    model: Realization, record: Record, x0: Array, free: Freedom, noise: NoiseModel
) -> tuple[Array, Array]:
    """``J.T J`` and ``J.T cov(v) J`` of one experiment, initial state first."""
    assert model.blocks is not None
    driven = np.column_stack([x0, model.B])
    pieces = signal_pieces(model.blocks, record, driven)
    X = np.hstack([piece.copy() for piece in pieces])
    k, ny = len(X), len(record.y)
    # Of the unit matrix: the Jacobian's coefficients in the signals, output by output.
    maps = jacobian_regression(np.eye(k), model, driven, free)
    maps = maps[:, :-1].reshape(ny, k, -1)
    gram = X @ X.T
    H = sum(L.T @ gram @ L for L in maps)
    if len(noise.A) == 0:
        return np.asarray(H), sum(
            noise.covariance[i, j] * (maps[i].T @ gram @ maps[j])
            for i in range(ny)
            for j in range(ny)
        )
    size = fft.next_fast_len(2 * X.shape[1], real=True)
    transformed = fft.rfft(X, size, axis=1)
    density = _spectrum(noise, 2.0 * np.pi * np.arange(size // 2 + 1) / size)
    weight = np.full(size // 2 + 1, 2.0 / size)  # for the negative frequencies too
    weight[0 if size % 2 else [0, -1]] = 1.0 / size
    S = np.zeros_like(H)
    for i in range(ny):
        for j in range(ny):
            # Sum over t, s of X[:, t] r_ij(t - s) X[:, s].T
            by_frequency = transformed.conj() * (weight * density[:, i, j])
            S += maps[i].T @ (by_frequency @ transformed.T).real @ maps[j]
    return np.asarray(H), S


def _frequency_response_jacobian(
    model: Realization, free: Freedom, omega: Array
) -> NDArray[np.complex128]:
    """Derivatives of the frequency response of a model in section form.

    Shape (n_freq, n_outputs, n_inputs, n_parameters); `omega` in radians per sample.
    """
    assert model.blocks is not None
    (ny, n), m = model.C.shape, model.B.shape[1]
    z = np.exp(1j * np.asarray(omega))
    resolvent = np.linalg.inv(z[:, None, None] * np.eye(n) - model.A)
    # Axes: frequency, output, input, and two that tell the parameters apart.
    to_output = (model.C @ resolvent)[:, :, None, :, None]
    from_input = (resolvent @ model.B).transpose(0, 2, 1)[:, None, :, None, :]
    by_parameter = [to_output * np.eye(m)[:, None, :]]
    by_direct = np.zeros((len(z), ny, m, 1, int(free.direct.sum())))
    i, j = np.nonzero(free.direct)
    by_direct[:, i, j, 0, np.arange(len(i))] = 1.0
    by_parameter.append(by_direct)
    for rows in block_slices(model.blocks):
        by_parameter.append(to_output[..., rows, :] * from_input[..., rows])
    by_parameter.append(np.eye(ny)[:, None, :, None] * from_input)
    columns = [
        part.reshape(*part.shape[:3], math.prod(part.shape[3:]))
        for part in by_parameter
    ]
    return np.concatenate(columns, axis=-1)


def _pole_jacobian(
    model: Realization, free: Freedom, n_parameters: int
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Poles of a model in section form, and their derivatives by the parameters."""
    assert model.blocks is not None
    poles = np.zeros(len(model.A), dtype=complex)
    jacobian = np.zeros((len(model.A), n_parameters), dtype=complex)
    row = 0
    parts = parameter_slices(model, free)
    for block, part in zip(model.blocks, parts, strict=True):
        values, right = np.linalg.eig(block)
        for value, left, vector in zip(
            values, np.linalg.pinv(right), right.T, strict=True
        ):
            poles[row], jacobian[row, part] = value, np.outer(left, vector).ravel()
            row += 1
    return poles, jacobian


_SETTLED = 1.05  # a ratio of weights that costs the square of it in efficiency

_LARGEST_RATIO = 1e4  # of noise to signal: sixteen digits carry the square of no better

_ROUNDS = 6  # each brings a clean output's noise nearer by ten: up to that ratio


class NoiseWeighted(NamedTuple):
    """A model, and the units in which it minimises the errors of its outputs."""

    lti: StateSpace
    output_scale: Array


def noise_weighted(
    lti: StateSpace,
    pairs: Sequence[tuple[Array, Array]],
    *,
    detrend: str | None = None,
) -> NoiseWeighted:
    """Refine a discrete-time model with its outputs weighted by their noise.

    A fit minimises the sum over t and i of ``(v_i[t] / s_i)^2`` in some units s of the
    outputs. Under white noise it is efficient where s_i is the standard deviation of
    the noise of output i (the diagonal of maximum likelihood), which a fit cannot know
    before: in units of the outputs' own size, a poor sensor bends the dynamics that all
    outputs share. The errors of a first fit tell them nearly, and those of the next
    better: a clean output that is fitted badly looks noisier than it is.

    It nearly minimises the simulation error over the experiments (u, y) in other units;
    entries of D that are zero stay so. A single output, or noise in proportion to the
    outputs, returns the model as it was; so does a search that ends unstable.
    """
    centred = remove_trends(list(pairs), detrend)[0]
    size = scale_records(centred).output_scale
    plain = NoiseWeighted(lti, size)
    if len(size) == 1 or lti.order == 0:
        return plain
    unit, weighted = size, lti
    for _ in range(_ROUNDS):
        errors = _scaled_errors(weighted, centred, unit)[1]
        innovation = np.diagonal(autoregression(errors).covariance)
        noise = unit / size * np.sqrt(np.maximum(innovation, 0.0))
        if not noise.any():
            break
        new = size * np.maximum(noise, noise.max() / _LARGEST_RATIO) / noise.max()
        change = new / unit
        if change.max() <= _SETTLED * change.min():
            break
        unit, weighted = new, _refined(weighted, centred, new)
    return NoiseWeighted(weighted, unit) if weighted.is_stable else plain


def _scaled_errors(
    lti: StateSpace, pairs: Sequence[tuple[Array, Array]], unit: Array
) -> tuple[list[Array], list[Array]]:
    """Initial states, and what is left of the outputs, in their units."""
    C, D = lti.C / unit[:, None], lti.D / unit[:, None]
    states, errors = [], []
    for u, y in pairs:
        error = y / unit - lti_response(lti.A, lti.B, C, D, u)
        responses = free_responses(lti.A, C, len(error))
        states.append(estimate_initial_state(responses, error))
        errors.append(error - responses @ states[-1])
    return states, errors


def _refined(
    lti: StateSpace, pairs: Sequence[tuple[Array, Array]], unit: Array
) -> StateSpace:
    """The model at the least simulation error in these units of the outputs."""
    su, sy = scale_records(pairs).input_scale, unit[:, None]
    records = [Record((u / su).T.copy(), (y / unit).T.copy()) for u, y in pairs]
    states, errors = _scaled_errors(lti, pairs, unit)
    loss = sum(float(np.sum(error**2)) for error in errors)
    start = Realization(
        lti.A, lti.B * su, lti.C / sy, lti.D * su / sy, np.array(states), loss
    )
    free = Freedom(lti.D != 0.0)
    model = refine_simulation(in_sections(start), records, free)
    return StateSpace(
        model.A, model.B / su, sy * model.C, sy * model.D / su, lti.sampling_time
    )
