"""What the simulation errors of a fitted model tell: prediction and uncertainty."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import independent_inputs, remove_trends
from ..models.innovation import InnovationModel, NoiseModel
from ..models.statespace import StateSpace
from ..systems.simulation import (
    estimate_initial_state,
    free_responses,
    lti_response,
)
from .identification import scale_records
from .parameters import moved_model
from .refinement import in_sections
from .signals import Record
from .simulation_fit import Freedom, Realization
from .uncertainty import (
    frequency_response_jacobian,
    noise_of,
    parameter_covariance,
    pole_jacobian,
    reduce_noise_model,
)

Array = NDArray[np.float64]

# Averages over the record are known to a percent or so from this many samples.
_MAX_SAMPLES = 30_000


@dataclass(frozen=True, eq=False)
class Evidence:
    """A model of scaled samples, and samples that its statistics are computed from.

    All of them are computed when first asked for.

    Parameters
    ----------
    model : Realization
        Of the scaled records.
    records : list of Record
    input_scale, output_scale : ndarray
        Units of the channels in them.
    basis : ndarray of shape (n_inputs, rank)
        Original inputs in terms of the independent ones.
    free : Freedom
    refined : bool
        Whether the model minimises the simulation error.
    share : float
        Samples in `records` by all samples that were used.
    """

    model: Realization
    records: list[Record]
    input_scale: Array
    output_scale: Array
    basis: Array
    free: Freedom
    refined: bool
    share: float

    @cached_property
    def noise(self) -> NoiseModel:
        """Autoregression of the simulation errors, in the scale of the records."""
        return noise_of(self.model, self.records)

    @cached_property
    def covariance(self) -> Array:
        """Of the parameters, as `parameter_covariance` has them.

        Raises
        ------
        ValueError
            Where it is not known.
        """
        if not self.refined:
            raise ValueError(
                "The covariance is that of a model that minimises the simulation "
                "error: it needs refine=True and an unconstrained minimum."
            )
        if self.sections.blocks is None:
            raise ValueError(
                "The covariance needs poles of multiplicity two at most. Lower `order`."
            )
        of_records = parameter_covariance(
            self.sections, self.records, self.free, self.noise
        )
        return of_records * self.share

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
            noise = reduce_noise_model(noise, n_noise_states)
        C, K = sy[:, None] * noise.C, noise.K / sy
        covariance = noise.covariance * np.outer(sy, sy)
        return InnovationModel(lti, NoiseModel(noise.A, C, K, covariance))

    def poles_std(self) -> NDArray[np.complex128]:
        """Standard deviations of the poles, in the order of `StateSpace.poles`."""
        covariance = self.covariance
        poles, J = pole_jacobian(self.sections, len(covariance))
        order = np.lexsort((poles.imag, poles.real, np.abs(poles)))
        return _deviations(J, covariance)[order]

    def frequency_response_covariance(self, omega: Array) -> Array:
        """Covariance of the real parts of all entries, then of their imaginary parts.

        Parameters
        ----------
        omega : ndarray of shape (n_freq,)
            Radians per sample.

        Returns
        -------
        ndarray of shape (n_freq, k, k), ``k = 2 n_outputs n_inputs``
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
        J = frequency_response_jacobian(self.sections, self.free, omega)
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
    parts = []
    for record in records:
        stop = max(2, int(share * record.u.shape[1]))
        parts.append(Record(record.u[:, :stop].copy(), record.y[:, :stop].copy()))
    return parts, sum(record.u.shape[1] for record in parts) / total


ModelPair = tuple[StateSpace, StateSpace]

# Distance of the models of a pair from the estimate, in standard deviations: small
# enough for what follows from them to be linear, and large against rounding.
DEVIATION = 1e-2

# Relative variance below which a direction is rounding.
_NEGLIGIBLE = 1e-12


def deviated_models(
    lti: StateSpace,
    pairs: Sequence[tuple[Array, Array]],
    convert: Callable[[StateSpace], StateSpace],
    *,
    detrend: str | None = None,
    refined: bool = True,
    output_scale: Array | None = None,
) -> list[ModelPair]:
    """Models to either side of an estimate, along its directions of uncertainty.

    Parameters
    ----------
    lti : StateSpace
        Discrete-time model.
    pairs : sequence of (u, y)
        The experiments it was fitted to, arrays of one row per sample.
    convert : callable
        What becomes of a discrete-time model.
    detrend : {None, "constant", "linear"}, default=None
        What was subtracted from the experiments before.
    refined : bool, default=True
        Whether the model minimises the simulation error.
    output_scale : ndarray of shape (n_outputs,), default=None
        Units in which its errors were weighed equally; None is those of `SubspaceLTI`.

    Returns
    -------
    list of (StateSpace, StateSpace)
        The models of a pair are `DEVIATION` standard deviations from the estimate;
        directions are independent. Empty where the covariance is not known: the model
        does not minimise the simulation error, it has no states, its inputs are
        collinear, or poles coincide.
    """
    if not refined or lti.order == 0:
        return []
    if independent_inputs([u for u, _ in pairs]) is not None:  # they are collinear
        return []
    centred = remove_trends(list(pairs), detrend)[0]
    scale = output_scale
    if scale is None:
        scale = scale_records(centred).output_scale
    records, share = shorten([Record(u.T, (y / scale).T) for u, y in centred])
    A, B, C, D = lti.A, lti.B, lti.C / scale[:, None], lti.D / scale[:, None]
    states = [
        estimate_initial_state(
            free_responses(A, C, y.shape[1]), y.T - lti_response(A, B, C, D, u.T)
        )
        for u, y in records
    ]
    evidence = Evidence(
        model=Realization(A, B, C, D, np.array(states), np.nan),
        records=records,
        input_scale=np.ones(lti.n_inputs),
        output_scale=scale,
        basis=np.eye(lti.n_inputs),
        free=Freedom(D != 0.0),
        refined=True,
        share=share,
    )
    noisy = np.trace(evidence.noise.covariance) > 0.0
    if evidence.sections.blocks is None or not noisy:
        return []

    def deviated(change: Array) -> StateSpace:
        model = moved_model(evidence.sections, change, evidence.free)
        return convert(evidence.state_space(model, lti.sampling_time))

    changes = DEVIATION * _square_root(evidence.covariance).T
    with warnings.catch_warnings():  # the estimate's own conversion says it once
        warnings.simplefilter("ignore")
        return [(deviated(change), deviated(-change)) for change in changes]


def _square_root(covariance: Array) -> Array:
    """L with ``L L.T`` the covariance, of full column rank."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > _NEGLIGIBLE * values[-1]
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])
