"""What the simulation errors of a model tell: prediction and uncertainty."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from ..data.experiments import Experiment
from ..data.preparation import independent_inputs, remove_trends
from ..models.innovation import InnovationModel, NoiseModel
from ..models.statespace import StateSpace
from ..systems.simulation import (
    estimate_initial_state,
    free_responses,
    lti_response,
)
from .refinement import in_sections
from .signals import Record
from .simulation_fit import Freedom, Realization
from .uncertainty import (
    autoregression,
    frequency_response_jacobian,
    parameter_covariance,
    pole_jacobian,
    reduce_noise_model,
)

Array = NDArray[np.float64]

# Samples that averages over the record are taken from.
_MAX_SAMPLES = 30_000


class Evidence(NamedTuple):
    """The scaled model and the samples that its statistics are computed from.

    Attributes
    ----------
    model : Realization
        Of the scaled records.
    records : list of Record
    input_scale, output_scale : ndarray
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


def outputs_of(experiment: Experiment) -> Array:
    """Outputs of an experiment, which must be there."""
    if experiment.outputs is None:
        raise ValueError("`y` must hold the measured outputs. Got None.")
    return experiment.outputs


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


def noise_of(evidence: Evidence) -> NoiseModel:
    """Autoregression of the scaled simulation errors."""
    A, B, C, D = evidence.model[:4]
    states = evidence.model.initial_states
    errors = [
        record.y.T - lti_response(A, B, C, D, record.u.T, x0)
        for record, x0 in zip(evidence.records, states, strict=True)
    ]
    return autoregression(errors)


class SimulationErrorStatistics:
    """Mixin: noise model, prediction, covariance of the estimate.

    All of it is computed when first asked for, from samples that `fit` keeps.
    """

    n_noise_states: int | str
    lti_: StateSpace
    _evidence: Evidence
    _noise: NoiseModel | None
    _parameters_covariance: Array | None
    _single_output: bool
    _step: float
    n_outputs_: int
    input_offset_: Array
    output_offset_: Array

    if TYPE_CHECKING:  # of the estimator

        def _read(
            self, X: Any, y: Any, *, reset: bool, split: bool = True
        ) -> tuple[list[Experiment], int]: ...
        def _initial_state(self, experiment: Experiment) -> Array: ...

    @property
    def predictor_(self) -> InnovationModel:
        """Innovation model: `lti_`, the noise model, K and innovation covariance."""
        check_is_fitted(self, "lti_")
        model = self._scaled_noise()
        if self.n_noise_states != "auto":
            model = reduce_noise_model(model, int(self.n_noise_states))
        sy = self._evidence.output_scale
        noise = NoiseModel(
            model.A,
            sy[:, None] * model.C,
            model.K / sy,
            model.covariance * np.outer(sy, sy),
        )
        return InnovationModel(self.lti_, noise)

    @property
    def poles_std_(self) -> NDArray[np.complex128]:
        """Standard deviations of the poles, in the order of ``lti_.poles()``.

        The real part is that of a pole's real part, the imaginary part that of its
        imaginary part.
        """
        check_is_fitted(self, "lti_")
        try:
            covariance = self._covariance()
        except ValueError as error:
            raise AttributeError(str(error)) from None
        model = in_sections(self._evidence.model)
        poles, J = pole_jacobian(model, len(covariance))
        std = _deviations(J.real, covariance) + 1j * _deviations(J.imag, covariance)
        order = np.lexsort((poles.imag, poles.real, np.abs(poles)))
        return std[order]

    def predict_ahead(
        self, X: Any, y: Any, steps: int = 1, *, initial_state: str = "estimate"
    ) -> Array:
        """Predict every sample from the outputs up to `steps` samples before it.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Measured outputs.
        steps : int, default=1
            Prediction horizon in samples.
        initial_state : {"estimate", "rest"}, default="estimate"
            "estimate" takes the deterministic initial state from the whole experiment,
            as `predict_with_initial_state` does; "rest" uses no later output.

        Returns
        -------
        ndarray of shape (n_samples,) or (n_samples, n_outputs)
            By `predictor_`; for white noise the simulation.
        """
        check_is_fitted(self, "lti_")
        if initial_state not in ("estimate", "rest"):
            raise ValueError(
                f"`initial_state` must be 'estimate' or 'rest'. Got {initial_state!r}."
            )
        experiments, n_samples = self._read(X, y, reset=False)
        predictor = self.predictor_
        out = np.full((n_samples, self.n_outputs_), np.nan)
        for e in experiments:
            x0 = self._initial_state(e) if initial_state == "estimate" else None
            predicted = predictor.predict(
                e.inputs - self.input_offset_,
                outputs_of(e) - self.output_offset_,
                steps=steps,
                initial_state=x0,
            )
            out[e.rows] = predicted + self.output_offset_
        return out[:, 0] if self._single_output else out

    def frequency_response_covariance(self, omega: ArrayLike) -> Array:
        """Covariance of the frequency response at every frequency.

        Asymptotic, from the Gauss-Newton Jacobian of the simulation error; valid for
        coloured noise and outputs of different quality.

        Parameters
        ----------
        omega : array-like of shape (n_freq,)
            Angular frequencies, rad/s.

        Returns
        -------
        ndarray of shape (n_freq, k, k), ``k = 2 n_outputs n_inputs``
            Of the real parts of all entries, output by output, then of the imaginary
            parts: the columns of the frequency-response tables of
            `GrayBoxRestructurer`.

        Raises
        ------
        ValueError
            If the model does not minimise the simulation error (``refine=False``).
        """
        check_is_fitted(self, "lti_")
        covariance = self._covariance()
        J = self._frequency_jacobian(omega)
        flat = J.reshape(len(J), -1, J.shape[-1])
        parts = np.concatenate([flat.real, flat.imag], axis=1)
        return parts @ covariance @ parts.transpose(0, 2, 1)

    def frequency_response_std(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Standard deviation of the frequency response.

        Parameters
        ----------
        omega : array-like of shape (n_freq,)
            Angular frequencies, rad/s.

        Returns
        -------
        ndarray of complex, shape (n_freq, n_outputs, n_inputs)
            The real part is the standard deviation of the real part of the response,
            the imaginary part that of the imaginary part. Its modulus is the root mean
            square of the complex error.

        Raises
        ------
        ValueError
            As `frequency_response_covariance`.

        Notes
        -----
        A 95 % band of a real part is 1.96 standard deviations to both sides.
        """
        check_is_fitted(self, "lti_")
        covariance = self._covariance()
        J = self._frequency_jacobian(omega)
        return _deviations(J.real, covariance) + 1j * _deviations(J.imag, covariance)

    def _keep_evidence(self, evidence: Evidence) -> None:
        self._evidence = evidence
        self._noise = None
        self._parameters_covariance = None

    def _set_model(
        self, model: Realization, singular_values: Array, residual: float
    ) -> None:
        """Fitted attributes of a model of scaled samples."""
        evidence = self._evidence
        su, sy = evidence.input_scale, evidence.output_scale[:, None]
        self.lti_ = StateSpace(
            model.A,
            model.B / su @ evidence.basis.T,
            sy * model.C,
            sy * model.D / su @ evidence.basis.T,
            self._step,
        )
        self.initial_states_ = model.initial_states
        self.singular_values_ = singular_values
        self.residual_ = residual

    def _frequency_jacobian(self, omega: ArrayLike) -> NDArray[np.complex128]:
        evidence = self._evidence
        step = self.lti_.sampling_time or 1.0
        omega = np.atleast_1d(np.asarray(omega, dtype=float)) * step
        J = frequency_response_jacobian(
            in_sections(evidence.model), evidence.free, omega
        )
        to_inputs = evidence.basis / evidence.input_scale
        J = np.einsum("foip,ui->foup", J, to_inputs)
        return J * evidence.output_scale[:, None, None]

    def _scaled_noise(self) -> NoiseModel:
        if self._noise is None:
            self._noise = noise_of(self._evidence)
        return self._noise

    def _covariance(self) -> Array:
        if self._parameters_covariance is None:
            evidence = self._evidence
            if not evidence.refined:
                raise ValueError(
                    "The covariance is that of a model that minimises the simulation "
                    "error: it needs refine=True and an unconstrained minimum."
                )
            model = in_sections(evidence.model)
            if model.blocks is None:
                raise ValueError(
                    "The covariance needs poles of multiplicity two at most. Lower "
                    "`order`."
                )
            covariance = parameter_covariance(
                model, evidence.records, evidence.free, self._scaled_noise()
            )
            self._parameters_covariance = covariance * evidence.share
        return self._parameters_covariance


def _deviations(J: Any, covariance: Array) -> Array:
    variance = np.einsum("...p,pq,...q->...", J, covariance, J)
    return np.sqrt(np.maximum(variance, 0.0))


ModelPair = tuple[StateSpace, StateSpace]

# Distance of the models of a pair from the estimate, in standard deviations, and
# relative variance below which a direction is rounding.
_STEP = 1e-2

_NEGLIGIBLE = 1e-12


def deviated_models(
    fitted: Any,
    pairs: Sequence[tuple[Array, Array]],
    convert: Callable[[StateSpace], StateSpace],
) -> list[ModelPair]:
    """Models to either side of an estimate, along its directions of uncertainty.

    Parameters
    ----------
    fitted : estimator
        Like a fitted `SubspaceLTI`.
    pairs : sequence of (u, y)
        The experiments it was fitted to, arrays of one row per sample.
    convert : callable
        What becomes of a discrete-time model.

    Returns
    -------
    list of (StateSpace, StateSpace)
        Each pair is 0.02 standard deviations apart; directions are independent. Empty
        where the covariance is not known: the model does not minimise the simulation
        error (``refine=False``, a stability that was enforced, another estimator), it
        has no states, its inputs are collinear, or poles coincide.
    """
    known = getattr(fitted, "refine", False) and not fitted.stability_loss_
    if not known or independent_inputs([u for u, _ in pairs]) is not None:
        return []
    lti = fitted.lti_
    if lti.order == 0:
        return []
    centred = remove_trends(list(pairs), fitted.detrend)[0]
    records, share = shorten([Record(u.T, y.T) for u, y in centred])
    states, errors = [], []
    for u, y in records:
        error = y.T - lti_response(lti.A, lti.B, lti.C, lti.D, u.T)
        x0 = estimate_initial_state(free_responses(lti.A, lti.C, len(error)), error)
        states.append(x0)
        errors.append(y.T - lti_response(lti.A, lti.B, lti.C, lti.D, u.T, x0))
    loss = float(sum(np.sum(error**2) for error in errors))
    model = in_sections(Realization(lti.A, lti.B, lti.C, lti.D, np.array(states), loss))
    if model.blocks is None or not loss > 0.0:
        return []
    freedom = Freedom(lti.D != 0.0)
    covariance = share * parameter_covariance(
        model, records, freedom, autoregression(errors)
    )
    steps = _STEP * _square_root(covariance).T
    step = lti.sampling_time
    with warnings.catch_warnings():  # the estimate's own conversion says it once
        warnings.simplefilter("ignore")
        return [
            (
                convert(_moved(model, freedom, direction, step)),
                convert(_moved(model, freedom, -direction, step)),
            )
            for direction in steps
        ]


def _square_root(covariance: Array) -> Array:
    """L with ``L L.T`` the covariance, of full column rank."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > _NEGLIGIBLE * values[-1]
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])


def _moved(
    model: Realization, freedom: Freedom, change: Array, sampling_time: float | None
) -> StateSpace:
    """The model after a change of B, D, A and C, as `parameter_covariance` has them."""
    assert model.blocks is not None
    A, B, C, D = (np.array(M) for M in model[:4])
    sizes = [B.size, int(freedom.direct.sum())]
    sizes += [block.size for block in model.blocks]
    dB, dD, *blocks, dC = np.split(change, np.cumsum(sizes))
    B += dB.reshape(B.shape)
    C += dC.reshape(C.shape)
    D[freedom.direct] += dD
    start = 0
    for own, block in zip(blocks, model.blocks, strict=True):
        rows = slice(start, start + len(block))
        A[rows, rows] += own.reshape(block.shape)
        start += len(block)
    return StateSpace(A, B, C, D, sampling_time)
