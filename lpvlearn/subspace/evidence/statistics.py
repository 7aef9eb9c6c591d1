"""What the simulation errors of a fitted model tell: prediction and uncertainty.

The errors v of a model that minimises their sum of squares are described by an
autoregression, in innovation form ``v = H e`` with ``H = C (zI - A)^-1 K + I``, which
predicts them as well.

With J the Jacobian of the simulated outputs, the estimate moves by
``inv(J.T J) J.T v`` to first order. Its covariance is the sandwich ``inv(H) S inv(H)``
with ``H = J.T J`` and ``S = J.T cov(v) J``, so that coloured noise and outputs of
different quality are accounted for (Ljung, *System Identification*, 1999, Section 9.4).
J is a fixed combination of the section signals; S is summed over frequencies.

`Evidence` holds what this is computed from; its `deviated_models` carry the covariance
on to what becomes of a model. Where the errors were whitened for the fit, v and J are
those of whitened samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ...models.innovation import InnovationModel, NoiseModel
from ...models.statespace import (
    DEVIATION,
    ModelPair,
    StateSpace,
    with_free_states,
)
from ...systems.innovations import covariance_root
from ...systems.least_squares import diagonal_scale
from ...systems.modes import spectral_radius
from ...systems.response import resolvent
from ..samples.records import Record
from ..simulation_error.criterion import criterion_of
from ..simulation_error.noise import (
    Whitening,
    beside_waves,
    noise_of,
    reduced_noise_model,
    spectral_density,
)
from ..simulation_error.signals import block_slices, signal_pieces
from ..simulation_error.simulation_fit import (
    Freedom,
    Realization,
    in_sections,
    jacobian_regression,
    moved_model,
    parameter_slices,
    simulation_errors,
    with_initial_states,
)

Array = NDArray[np.float64]

_NEGLIGIBLE = 1e-12  # relative variance below which a direction is rounding

_APART = 1e-2  # of the inverse of a record's length, between a pole and 1

_RCOND = 1e-15  # the weakest direction of the information that is told from rounding


# Over which a response is averaged, and its standard deviation
_N_FREQUENCIES, _N_DEVIATIONS = 200, 33

# Standard deviation of a response by its root mean square, all inputs as they move,
# above which what is not known of it matters.
OPEN = 0.3


class StaticGain(NamedTuple):
    """Gain at frequency zero, each of shape (n_outputs, n_inputs)."""

    value: Array
    std: Array
    size: Array  # root mean square of the output's response, per unit of the input

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Where it is known no better than to its own size, nor to what matters."""
        return (self.std > np.abs(self.value)) & (self.std > OPEN * self.size)


class Known(NamedTuple):
    """What is known of a model without the samples: all but tests of residuals."""

    A: Array  # of the model of scaled and whitened records, in section form
    B: Array
    C: Array
    D: Array
    sizes: NDArray[np.intp] | None  # of the sections; None without them
    noise: NoiseModel  # in the scale of the records
    gain: Array | None  # of the deterministic states; None: not moved by innovations
    covariance: Array | None  # of the parameters
    input_scale: Array
    output_scale: Array
    basis: Array
    direct: NDArray[np.bool_]
    initial_states: bool
    n_trend: int
    filter: Array
    weight: Array
    input_delay: NDArray[np.intp]
    turns: Array | None = None  # of sinusoids beside; None: none

    def evidence(self) -> Evidence:
        """What answers as the evidence that it was told by."""
        blocks: list[Array] | None = None
        if self.sizes is not None:
            n_unknowns = self.B.size + int(self.direct.sum()) + self.C.size
            n_unknowns += int((self.sizes**2).sum())
            if self.sizes.sum() != len(self.A) or self.sizes.min(initial=1) < 1:
                raise ValueError(f"sections of {self.sizes} states")
            if self.covariance is not None and len(self.covariance) != n_unknowns:
                raise ValueError(f"a covariance not of {n_unknowns} parameters")
            ends = np.cumsum(self.sizes).tolist()
            rows = [slice(k - n, k) for k, n in zip(ends, self.sizes, strict=True)]
            blocks = [self.A[part, part] for part in rows]
        sections = Realization(
            *(self.A, self.B, self.C, self.D, np.zeros((0, len(self.A))), np.nan),
            blocks=None if blocks is None else tuple(blocks),
        )
        return Evidence(
            sections,
            [],
            self.input_scale,
            self.output_scale,
            self.basis,
            Freedom(self.direct, self.initial_states, self.n_trend),
            Whitening(self.filter, self.weight),
            self.covariance is not None,
            1.0,
            input_delay=self.input_delay,
            told=self,
            turns=self.turns,
        )


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
    whitening: Whitening  # of the errors whose squares the model minimises,
    refined: bool  # if it does
    share: float  # samples in `records` by all samples that were used
    levels: Array | None = None  # (n_experiments, n_outputs): constants less trends
    input_delay: ArrayLike = 0  # samples, which the records' inputs have already
    told: Known | None = None  # in the place of the records
    turns: Array | None = None  # of sinusoids that were subtracted, radians per sample

    def known(self) -> Known:
        """What is left without the records."""
        try:
            covariance = self.covariance
        except ValueError:
            covariance = None
        sections, m = self.sections, len(self.basis)
        blocks, gain = sections.blocks, self._gain()
        return Known(
            *sections[:4],
            None if blocks is None else np.array([len(b) for b in blocks], dtype=int),
            self.noise,
            gain,
            covariance,
            np.asarray(self.input_scale, dtype=float),
            np.asarray(self.output_scale, dtype=float),
            self.basis,
            self.free.direct,
            bool(self.free.initial_states),
            int(self.free.n_trend),
            *self.whitening,
            np.broadcast_to(self.input_delay, (m,)).astype(int),
            self.turns,
        )

    def beside(self, **other: Any) -> Evidence:
        """Of another `input_delay` or `turns`, with what is computed already.

        Nothing of that depends on them.
        """
        evidence = replace(self, **other)
        evidence.__dict__.update(self.__dict__ | evidence.__dict__)
        return evidence

    def _gain(self) -> Array | None:
        """Innovation gain of the deterministic states, in the scale of the records."""
        return None if self.told is None else self.told.gain

    @cached_property
    def noise(self) -> NoiseModel:
        """Autoregression of the simulation errors, in the scale of the records."""
        if self.told is not None:
            return self.told.noise
        return _noise_of(self.begun_in(self.records), self.records)

    def begun_in(self, records: Sequence[Record]) -> Realization:
        """The model with the own unknowns that fit some records best."""
        weight = self.whitening.weight
        return with_initial_states(self.model, records, self.free, weight)

    @cached_property
    def covariance(self) -> Array:
        """Of the parameters, as `parameter_covariance` has them, where it is known."""
        if not self.refined:
            raise ValueError(
                "The covariance is that of a refined model at an unconstrained "
                "minimum, which this one is not: refine='auto' leaves models as they "
                "are that simulate parts held out better so. Use refine='simulation' "
                "or 'prediction', and stability='warn'."
            )
        if self.sections.blocks is None:
            raise ValueError(
                "The covariance needs poles of multiplicity two at most. Lower `order`."
            )
        if self.told is not None and self.told.covariance is not None:
            return self.told.covariance
        records = self.whitening.records(self.records, self.free)
        model = with_initial_states(self.sections, records, self.free)
        noise = _noise_of(model, records)
        covariance = parameter_covariance(model, records, self.free, noise)
        return covariance * self.share

    @cached_property
    def sections(self) -> Realization:
        """The model of the whitened records, in section form where there is one.

        Its initial states are those of the records themselves.
        """
        if self.told is not None:
            return self.model
        return in_sections(self.whitening.model(self.model))

    @cached_property
    def criterion(self) -> float:
        """That of the orders, of outputs in their units; -inf where one is 0."""
        records = self.records
        if not np.logical_or.reduce([r.y.any(axis=1) for r in records]).all():
            return -np.inf  # nothing is left of it, and its scale tells nothing
        n_samples = sum(record.n_samples for record in records)
        units = 2.0 * n_samples * float(np.log(self.output_scale).sum())
        model = self.model  # of a stream: it begins as the last of its experiments
        if len(model.initial_states) != len(records):
            model = self.begun_in(records)
        return units + criterion_of(model, records, self.free)

    @property
    def longest(self) -> int:
        """Samples of the longest experiment, of which the records may be the heads."""
        return max(record.n_samples + record.n_later for record in self.records)

    @property
    def one_step(self) -> Evidence:
        """What tells of constants: itself, or a predictor, where inputs know errors."""
        return self

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
            self.input_delay,
        )

    def predictor(self, lti: StateSpace, n_noise_states: int | None) -> InnovationModel:
        """Innovation model of `lti`; None keeps all states of the noise model.

        With a gain the fit has chosen them. Sinusoids are further states of `lti`.
        """
        noise, sy, gain = self.noise, self.output_scale, self._gain()
        if n_noise_states is not None and gain is None:
            noise = reduced_noise_model(noise, n_noise_states)
        if self.turns is not None:
            n, (R, C, waves, noise) = lti.order, beside_waves(noise, self.turns)
            lti = with_free_states(lti, R, sy[:, None] * C)
            gain = np.vstack([np.zeros((n, len(sy))) if gain is None else gain, waves])
        C, K = sy[:, None] * noise.C, noise.K / sy
        covariance = noise.covariance * np.outer(sy, sy)
        gain = None if gain is None else gain / sy
        return InnovationModel(lti, NoiseModel(noise.A, C, K, covariance), gain)

    def deviated_models(self, lti: StateSpace) -> list[ModelPair]:
        """Models to either side of an estimate, along its directions of uncertainty.

        The models of a pair are `DEVIATION` standard deviations from `lti`, the model
        in the units of the data; directions are independent. Empty where the covariance
        is not known: the model does not minimise the simulation error, it has no
        states, its inputs are collinear, its errors are rounding, or poles coincide.
        """
        collinear = self.basis.shape[1] < self.basis.shape[0]
        known = self.refined and self.sections.blocks is not None and lti.order > 0
        if collinear or not known or not np.trace(self.noise.covariance) > 0.0:
            return []

        def deviated(change: Array) -> StateSpace:
            moved = moved_model(self.sections, change, self.free)
            return self.state_space(self.whitening.undone(moved), lti.sampling_time)

        root = covariance_root(self.covariance, _NEGLIGIBLE)
        changes = DEVIATION * root[:, root.any(axis=0)].T
        return [(deviated(change), deviated(-change)) for change in changes]

    def poles_std(self) -> NDArray[np.complex128]:
        """Standard deviations of the poles, in the order of `StateSpace.poles`."""
        if len(self.model.A) == 0:
            return np.zeros(0, complex)
        covariance = self.covariance
        poles, J = _pole_jacobian(self.sections, self.free, len(covariance))
        order = np.lexsort((poles.imag, poles.real, np.abs(poles)))
        return _deviations(J, covariance)[order]

    def frequency_response_covariance(self, omega: Array) -> Array:
        """Covariance of the real parts of all entries, then of their imaginary parts.

        Shape (n_freq, k, k) with ``k = 2 n_outputs n_inputs``; radians per sample.
        """
        covariance, J = self.covariance, self._frequency_jacobian(omega)
        flat = J.reshape(len(J), math.prod(J.shape[1:3]), J.shape[-1])
        parts = np.concatenate([flat.real, flat.imag], axis=1)
        return parts @ covariance @ parts.transpose(0, 2, 1)

    def frequency_response_std(self, omega: Array) -> NDArray[np.complex128]:
        """Standard deviations, shape (n_freq, n_outputs, n_inputs)."""
        covariance = self.covariance
        return _deviations(self._frequency_jacobian(omega), covariance)

    def static_gain(self) -> StaticGain | None:
        """What is known of the gain at rest; None where there is none, or no saying.

        A mode as slow as the longest record is an integrator to it.
        """
        known = self.refined and self.sections.blocks is not None
        known &= bool(len(self.model.A)) and self.basis.shape[1] > 0
        if not known or spectral_radius(self.model.A) >= 1.0 - 1.0 / self.longest:
            return None
        lti = self.state_space(self.model, 1.0)
        response = lti.frequency_response(np.linspace(0.0, np.pi, _N_FREQUENCIES))
        std = self.frequency_response_std(np.zeros(1))[0].real
        moved = self._input_sizes()
        power = np.mean(np.abs(response * moved) ** 2, axis=0)
        all_inputs = np.sqrt(power.sum(axis=1, keepdims=True))
        never = np.full(power.shape, np.inf)  # of an input that does not move
        size = np.divide(all_inputs, moved, out=never, where=moved > 0.0)
        return StaticGain(response[0].real, std, size)

    def _input_sizes(self) -> Array:
        """How far the inputs move, collinear ones as well."""
        of_independent = np.linalg.pinv(self.basis).T
        return np.asarray(np.sqrt(of_independent**2 @ self.input_scale**2))

    def unknown_share(self, size: Array) -> tuple[float, float]:
        """Standard deviation of the response over all frequencies by its `size`.

        The largest of an input and an output, root mean square, and the frequency
        (radians per sample) where it is largest. `size` as in `StaticGain`.
        """
        omega = np.linspace(0.0, np.pi, _N_DEVIATIONS)
        std = np.abs(self.frequency_response_std(omega))
        share = np.sqrt(np.mean(std**2, axis=0)) / np.where(size > 0.0, size, np.inf)
        output, which = np.unravel_index(np.argmax(share), share.shape)
        return float(share.max()), float(omega[np.argmax(std[:, output, which])])

    def _frequency_jacobian(self, omega: Array) -> NDArray[np.complex128]:
        J = _frequency_response_jacobian(self.sections, self.free, omega)
        J = np.einsum("foip,ui->foup", J, self.basis / self.input_scale)
        delays = np.broadcast_to(self.input_delay, len(self.basis))
        J = J * np.exp(-1j * np.multiply.outer(omega, delays))[:, None, :, None]
        to_outputs = self.output_scale[:, None] * np.linalg.inv(self.whitening.weight)
        return np.einsum("yo,foup->fyup", to_outputs, J)


def _noise_of(model: Realization, records: Sequence[Record]) -> NoiseModel:
    """Autoregression of the simulation errors that are known."""
    errors = simulation_errors(model, records)
    return noise_of(
        [np.where(r.known, e, np.nan) for r, e in zip(records, errors, strict=True)]
    )


def _deviations(J: NDArray[np.complex128], covariance: Array) -> NDArray[np.complex128]:
    """Standard deviations of the real and the imaginary part of what has Jacobian J."""
    variances = [
        np.einsum("...p,pq,...q->...", part, covariance, part)
        for part in (J.real, J.imag)
    ]
    real, imag = (np.sqrt(np.maximum(variance, 0.0)) for variance in variances)
    return real + 1j * imag


def parameter_covariance(
    model: Realization, records: Sequence[Record], free: Freedom, noise: NoiseModel
) -> Array:
    """Covariance of the parameters (B, D, A, C), own unknowns allowed for.

    Of a model in section form, at the minimum of the simulation error on the records.
    Along changes of the state basis, which the data do not determine, it is zero.
    """
    model = _apart_from_one(model, records, free)
    assert model.blocks is not None
    information: Array | float = 0.0
    score: Array | float = 0.0
    own = free.n_own(len(model.A))
    for record, x0 in zip(records, model.initial_states, strict=True):
        H, S = _experiment_terms(model, record, x0, free, noise)
        if own:
            # What the own unknowns can explain tells nothing about the others.
            explain = np.linalg.pinv(H[:own, :own], hermitian=True) @ H[:own, own:]
            keep = np.vstack([-explain, np.eye(len(H) - own)])
            H, S = keep.T @ H @ keep, keep.T @ S @ keep
        information, score = information + H, score + S
    H, S = np.asarray(information), np.asarray(score)
    scale = diagonal_scale(H)
    values, vectors = np.linalg.eigh(H / scale[:, None] / scale)
    n_gauge = sum(block.size for block in model.blocks)
    kept = np.arange(len(values)) >= n_gauge
    kept &= values > _RCOND * values.max(initial=0.0)  # order 0, D = 0: none
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    inverse = inverse / scale[:, None] / scale
    n_values = sum(record.n_values for record in records)
    n_free = int(kept.sum()) + len(records) * own
    return inverse @ S @ inverse * (n_values / max(n_values - n_free, 1))


def _apart_from_one(
    model: Realization, records: Sequence[Record], free: Freedom
) -> Realization:
    """The model, with poles that are 1 to the records a little away from there.

    Beside a constant the free response of such a pole tells a ramp only, by a
    difference of both: the nearer, the larger they are, until nothing but rounding is
    left of what tells the pole. What its covariance is hardly depends on where it is.
    """
    assert model.blocks is not None
    least = _APART / max(record.n_samples for record in records)
    near = [bool((abs(np.linalg.eigvals(b) - 1.0) < least).any()) for b in model.blocks]
    if not (free.n_trend and any(near)):
        return model
    A = model.A.copy()
    for part, is_near in zip(block_slices(model.blocks), near, strict=True):
        A[part, part] -= 2.0 * least * is_near * np.eye(part.stop - part.start)
    blocks = tuple(A[part, part] for part in block_slices(model.blocks))
    return with_initial_states(model._replace(A=A, blocks=blocks), records, free)


def _experiment_terms(
    model: Realization, record: Record, x0: Array, free: Freedom, noise: NoiseModel
) -> tuple[Array, Array]:
    """``J.T J`` and ``J.T cov(v) J`` of one experiment, own unknowns first."""
    assert model.blocks is not None
    driven = np.column_stack([x0, model.B])
    pieces = signal_pieces(model.blocks, record, driven)
    X = np.hstack([piece.copy() for piece in pieces])
    k, ny = len(X), len(record.y)
    # Of the unit matrix: the Jacobian's coefficients in the signals, output by output.
    maps = jacobian_regression(np.eye(k), model, driven, free)
    maps = maps[:, :-1].reshape(ny, k, -1)
    # Of every output where it is known; of complete records once for all.
    seen = [X * ~row for row in record.missing] if record.missing.any() else [X]
    of = np.arange(ny) % len(seen)
    grams = [[left @ right.T for right in seen] for left in seen]
    H = sum(L.T @ grams[i][i] @ L for i, L in zip(of, maps, strict=True))
    if len(noise.A) == 0:
        return np.asarray(H), sum(
            noise.covariance[i, j] * (maps[i].T @ grams[of[i]][of[j]] @ maps[j])
            for i in range(ny)
            for j in range(ny)
        )
    size = fft.next_fast_len(2 * X.shape[1], real=True)
    transformed = [fft.rfft(part, size, axis=1) for part in seen]
    density = spectral_density(noise, 2.0 * np.pi * np.arange(size // 2 + 1) / size)
    weight = np.full(size // 2 + 1, 2.0 / size)  # for the negative frequencies too
    weight[0 if size % 2 else [0, -1]] = 1.0 / size
    S = np.zeros_like(H)
    for i in range(ny):
        for j in range(ny):
            # Sum over t, s of X[:, t] r_ij(t - s) X[:, s].T
            left, right = transformed[of[i]], transformed[of[j]]
            by_frequency = left.conj() * (weight * density[:, i, j])
            S += maps[i].T @ (by_frequency @ right.T).real @ maps[j]
    return np.asarray(H), S


def _frequency_response_jacobian(
    model: Realization, free: Freedom, omega: Array
) -> NDArray[np.complex128]:
    """Derivatives of the frequency response of a model in section form.

    Shape (n_freq, n_outputs, n_inputs, n_parameters); `omega` in radians per sample.
    """
    assert model.blocks is not None
    ny, m = len(model.C), model.B.shape[1]
    z = np.exp(1j * np.asarray(omega))
    inverse = resolvent(model.A, z)
    # Axes: frequency, output, input, and two that tell the parameters apart.
    to_output = (model.C @ inverse)[:, :, None, :, None]
    from_input = (inverse @ model.B).transpose(0, 2, 1)[:, None, :, None, :]
    by_parameter: list[NDArray] = [to_output * np.eye(m)[:, None, :]]
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
