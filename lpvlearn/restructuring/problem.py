"""What the restructuring minimises: the distance of a structure to what it shall match.

That is the norm of the weighted error ``W (G(theta) - G0)``, Eq. (6), where ``G0`` is
one black-box model, several ones of an operating point with their outputs below each
other, or a measured frequency response.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..models.statespace import StateSpace
from ..structures.map import RowsMap
from ..structures.structure import GrayBoxStructure
from ..systems.hinf_norm import hinf_norm
from .error_system import ErrorSystem, Target, series
from .least_squares import LeastSquaresResult, fit_frequency_response
from .limits import growth, keeps_margin, natural_margin
from .measured import MeasuredErrorSystem, read_frequency_data, realize_response

Array = NDArray[np.float64]

Complex = NDArray[np.complex128]

FrequencyWeight = StateSpace | Sequence[float | None] | None

# A measured response does not tell how slowly modes may decay: they must be stable, by
# a rate that no response down to the lowest frequency could show.
_LEAST_DECAY = 1e-4


@dataclass(frozen=True, eq=False)
class RestructuringProblem:
    """A structure beside what it shall match.

    Attributes
    ----------
    structure : GrayBoxStructure
    system : ErrorSystem
    box : Target or None
        One black-box model, from which similarity transformations start.
    omega : ndarray of shape (k,)
        Frequencies of the least-squares fit, rad/s.
    margin : float
        Stability margin, 1/s.
    reference : float
        H-infinity norm of the weighted black box.
    dropped_feedthrough : ndarray of shape (n_outputs, n_inputs)
    lower_bound : float
        No parameters have a smaller error.
    """

    structure: GrayBoxStructure
    system: ErrorSystem
    box: Target | None
    omega: Array
    margin: float
    reference: float
    dropped_feedthrough: Array
    lower_bound: float

    @cached_property
    def response(self) -> Complex:
        """The black box at the frequencies."""
        return self.system.target_response(self.omega)

    @cached_property
    def weighted_response(self) -> Complex:
        """The black box behind the weight."""
        return self.system.weight_response(self.omega)[0] @ self.response

    def is_stable(self, theta: Array) -> bool:
        """Whether parameters give a model that keeps the stability margin."""
        return keeps_margin(self.system, theta, self.margin)

    def fit(
        self, theta: Array, scaling: Array | float = 1.0
    ) -> LeastSquaresResult | None:
        """Least-squares fit of the response from given parameters; None if unstable."""
        return fit_frequency_response(
            self.system,
            theta,
            self.omega,
            admissible=self.is_stable,
            scaling=scaling,
        )

    def relative_error(self, fit: LeastSquaresResult) -> float:
        """Root-mean-square error of a fit over frequency, relative to the black box."""
        square = np.mean(np.sum(np.abs(self.weighted_response) ** 2, axis=(1, 2)))
        return float(np.sqrt(fit.cost)) / max(float(np.sqrt(square)), 1e-300)


def problem_from_models(
    structure: GrayBoxStructure | None, models: Sequence[Any], weight: Any
) -> RestructuringProblem:
    """Match state-space models with the exact H-infinity norm.

    The feedthrough of the black boxes is left out where the structure has none,
    as in Eq. (4). Several models are stacked.

    Raises
    ------
    ValueError
        If a model is unstable, or the shapes or time domains do not fit.
    """
    for model in models:
        _check_model(model)
    first = models[0]
    structure = _structure_for(structure, first)
    p, dt = structure.n_outputs, first.sampling_time
    for model in models:
        own = (model.n_outputs, model.n_inputs, model.sampling_time)
        if own != (p, structure.n_inputs, dt):
            raise ValueError(
                f"`structure` has {p} outputs and {structure.n_inputs} inputs, `model` "
                f"has {own[0]} and {own[1]} (sampling time {own[2]}). They must agree."
            )
    free = structure.free_feedthrough
    fixed = structure.matrices(structure.reference)[3]
    boxes = [
        Target(m.A, m.B, m.C, np.where(free, m.D, fixed), m.sampling_time)
        for m in models
    ]
    filter_ = _weight_model(weight, p, dt)
    behind = None
    if filter_ is not None:
        behind = Target(filter_.A, filter_.B, filter_.C, filter_.D, dt)
        if behind.D.shape != (1, 1):  # one for every black box
            behind = behind.repeated(len(boxes))
    target = _stacked(boxes) if len(boxes) > 1 else boxes[0]
    system = ErrorSystem(_repeated_outputs(structure, len(boxes)), target, behind)
    bound = 0.0
    if len(models) == 1 and filter_ is None and first.order > structure.order:
        bound = float(first.hankel_singular_values()[structure.order])
    return RestructuringProblem(
        structure,
        system,
        boxes[0],
        system.grid,
        natural_margin(target),
        _weighted_norm(system),
        first.D - boxes[0].D,
        bound,
    )


def _check_model(model: Any) -> None:
    if not isinstance(model, StateSpace):
        raise ValueError(f"`model` must be a StateSpace. Got {type(model).__name__}.")
    if not model.is_stable:
        worst = model.poles()[np.argmax(growth(model.poles(), model.sampling_time))]
        raise ValueError(
            "`model` must be stable: its distance to a gray-box model is infinite "
            f"otherwise. Got a pole at {worst:.4g}."
        )


def _structure_for(
    structure: GrayBoxStructure | None, model: StateSpace
) -> GrayBoxStructure:
    if structure is None:
        feedthrough = bool(model.D.any()) or model.order == 0
        return GrayBoxStructure.observable_canonical(
            model.order, model.n_inputs, model.n_outputs, feedthrough
        )
    if not isinstance(structure, GrayBoxStructure):
        raise ValueError(
            "`structure` must be a GrayBoxStructure or None. Got "
            f"{type(structure).__name__}."
        )
    return structure


def _repeated_outputs(structure: GrayBoxStructure, copies: int) -> GrayBoxStructure:
    """The structure with its outputs once for each of several black boxes."""
    if copies == 1:
        return structure
    states, outputs = np.split(np.arange(structure.map.shape[0]), [structure.order])
    rows = np.concatenate([states, np.tile(outputs, copies)])
    return GrayBoxStructure(
        structure.order, RowsMap(structure.map, rows), structure.domain
    )


def _stacked(boxes: Sequence[Target]) -> Target:
    """The black boxes with their outputs below each other, inputs in common."""
    A, C = block_diag(*(box.A for box in boxes)), block_diag(*(box.C for box in boxes))
    B, D = np.vstack([box.B for box in boxes]), np.vstack([box.D for box in boxes])
    return Target(A, B, C, D, boxes[0].dt)


def _weighted_norm(system: ErrorSystem) -> float:
    t = system.target
    parts = (t.A, t.B, t.C, t.D)
    if system.weight is not None:
        parts = series(*parts, system.weight)
    return hinf_norm(*parts, dt=t.dt).norm


def problem_from_response(
    structure: GrayBoxStructure | None,
    omega: ArrayLike,
    frf: ArrayLike,
    weight: Any,
    sample_weight: ArrayLike | None,
) -> RestructuringProblem:
    """Match a measured frequency response over its frequencies.

    Raises
    ------
    ValueError
        If there is no structure, or the table does not fit it.
    """
    if not isinstance(structure, GrayBoxStructure):
        raise ValueError(
            "`structure` must be given to fit a frequency response, which does not "
            f"tell the order. Got {structure!r}. Use a GrayBoxStructure, or "
            "fit_model()."
        )
    p = structure.n_outputs
    grid, G = read_frequency_data(omega, frf, p, structure.n_inputs)
    W = np.broadcast_to(np.eye(p), (len(grid), p, p)).astype(complex)
    filter_ = _weight_model(weight, p, None)
    if filter_ is not None:
        own = filter_.frequency_response(grid)
        W = own if own.shape == W.shape else own * W  # one for all outputs
    if sample_weight is not None:
        scale = np.asarray(sample_weight, dtype=float).reshape(-1)
        if scale.shape != grid.shape or not np.isfinite(scale).all() or scale.min() < 0:
            raise ValueError(
                f"`sample_weight` must hold {len(grid)} finite weights, not negative, "
                f"one for each frequency. Got shape {np.shape(sample_weight)}."
            )
        W = W * scale[:, None, None]
    system = MeasuredErrorSystem(structure, grid, G, W)
    return RestructuringProblem(
        structure,
        system,
        realize_response(system.omega, system.G, structure.order),
        system.omega,
        _LEAST_DECAY * float(system.omega[system.omega > 0][0]),
        float(np.linalg.norm(system.W @ system.G, 2, axis=(1, 2)).max()),
        np.zeros(G.shape[1:]),
        0.0,
    )


def _weight_model(
    weight: Any, n_outputs: int, sampling_time: float | None
) -> StateSpace | None:
    """The `frequency_weight`, model or band, in the time domain of the black boxes.

    Raises
    ------
    ValueError
        If the weight is unstable, or does not fit the outputs or the time domain.
    """
    if weight is None:
        return None
    if not isinstance(weight, StateSpace):
        weight = _band(weight)
        if sampling_time is not None:
            weight = weight.to_discrete(sampling_time, "tustin")
    if weight.sampling_time != sampling_time:
        raise ValueError(
            "`frequency_weight` must be in the time domain of the model: sampling time "
            f"{sampling_time}. Got {weight.sampling_time}."
        )
    if not weight.is_stable:
        raise ValueError(
            "`frequency_weight` must be stable. Got a pole at "
            f"{weight.poles()[np.argmax(weight.poles().real)]:.4g}."
        )
    if weight.D.shape not in ((1, 1), (n_outputs, n_outputs)):
        raise ValueError(
            f"`frequency_weight` must be 1 x 1 or {n_outputs} x {n_outputs}, for the "
            f"outputs. Got {weight.n_outputs} x {weight.n_inputs}."
        )
    return weight


def _band(edges: Any) -> StateSpace:
    """First-order band-pass ``s / (s + low) * high / (s + high)``; rad/s.

    None, 0 or infinity leaves that side open.
    """
    try:
        low, high = edges
        low = 0.0 if low is None else float(low)
        high = np.inf if high is None else float(high)
    except (TypeError, ValueError):
        raise ValueError(
            "`frequency_weight` must be a StateSpace or a band (low, high) in rad/s. "
            f"Got {edges!r}."
        ) from None
    if not 0 <= low < high:
        raise ValueError(
            f"`frequency_weight` must be a band with 0 <= low < high. Got {edges!r}."
        )
    one = np.ones((1, 1))
    parts = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), one
    if low > 0:
        parts = series(*parts, Target(-low * one, low * one, -one, one))
    if np.isfinite(high):
        parts = series(*parts, Target(-high * one, high * one, one, 0.0 * one))
    return StateSpace(*parts)
