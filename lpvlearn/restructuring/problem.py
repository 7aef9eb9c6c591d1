"""What the restructuring minimises: the error system of models or of a response."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.statespace import StateSpace
from ..structures.structure import GrayBoxStructure
from ..systems.hinf_norm import hinf_norm
from .error_system import ErrorSystem
from .least_squares import grid_and_margin
from .limits import growth, stability_test
from .measured import MeasuredErrorSystem, read_frequency_data, realize_response
from .transfer import Target, series

Array = NDArray[np.float64]

FrequencyWeight = StateSpace | Sequence[float | None] | None


def weight_target(
    weight: Any, n_outputs: int, sampling_time: float | None
) -> Target | None:
    """The weight as matrices in the time domain of the models.

    Parameters
    ----------
    weight : StateSpace, pair of float or None
        A stable model with one input and output, or with as many as the black box has
        outputs; or a band ``(low, high)`` in rad/s, where None leaves a side open.

    Raises
    ------
    ValueError
        If the weight is unstable, or does not fit the outputs or the time domain.
    """
    if weight is None:
        return None
    if not isinstance(weight, StateSpace):
        weight = band(weight)
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
    shape = (weight.n_outputs, weight.n_inputs)
    if shape not in ((1, 1), (n_outputs, n_outputs)):
        raise ValueError(
            f"`frequency_weight` must be 1 x 1 or {n_outputs} x {n_outputs}, for the "
            f"outputs. Got {shape[0]} x {shape[1]}."
        )
    return Target(weight.A, weight.B, weight.C, weight.D, weight.sampling_time)


def band(edges: Any) -> StateSpace:
    """First-order band-pass ``s / (s + low) * high / (s + high)`` between two edges.

    Parameters
    ----------
    edges : pair of float or None
        Rad/s; None, 0 or infinity leaves that side open.
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
    parts = []
    if low > 0:
        parts.append(([[-low]], [[low]], [[-1.0]], [[1.0]]))
    if np.isfinite(high):
        parts.append(([[-high]], [[high]], [[1.0]], [[0.0]]))
    if not parts:
        return StateSpace([], [], [], [[1.0]])
    if len(parts) == 1:
        return StateSpace(*parts[0])
    (a, b, c, d), (e, f, g, _) = (tuple(np.array(M) for M in part) for part in parts)
    A = np.block([[a, np.zeros((1, 1))], [f @ c, e]])
    return StateSpace(A, np.vstack([b, f @ d]), np.hstack([np.zeros((1, 1)), g]))


Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class RestructuringProblem:
    """A structure beside what it shall match.

    Attributes
    ----------
    structure : GrayBoxStructure
    system : ErrorSystem
    box : Target or None
        One black-box model, from which similarity transformations start.
    omega : ndarray
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

    @property
    def stable(self) -> Callable[[Array], bool]:
        """Whether parameters give a model that keeps the stability margin."""
        return stability_test(self.system, self.margin)

    @property
    def response(self) -> Complex:
        """The black box at the frequencies."""
        return self.system.target_response(self.omega)


class RepeatedOutputs:
    """A structure whose outputs stand once for each of several black boxes."""

    def __init__(self, structure: GrayBoxStructure, copies: int) -> None:
        self.structure, self.copies = structure, copies
        self.order, self.n_params = structure.order, structure.n_params
        self.lower, self.upper = structure.lower, structure.upper

    def system_matrix(self, theta: Array) -> Array:
        """``[[A, B], [C, D], [C, D], ...]``."""
        return self._repeated(self.structure.system_matrix(theta))

    def jacobian(self, theta: Array) -> Array:
        """Derivatives of the system matrix, rows repeated."""
        return self._repeated(self.structure.jacobian(theta))

    def curvature(self, theta: Array) -> Array | None:
        """Second derivatives of the system matrix, rows repeated."""
        H = self.structure.curvature(theta)
        return None if H is None else self._repeated(H)

    def _repeated(self, S: Array) -> Array:
        rows = [S[..., : self.order, :]] + [S[..., self.order :, :]] * self.copies
        return np.concatenate(rows, axis=-2)


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
    own = (structure.n_outputs, structure.n_inputs, first.sampling_time)
    for model in models:
        if (model.n_outputs, model.n_inputs, model.sampling_time) != own:
            raise ValueError(
                f"`structure` has {own[0]} outputs and {own[1]} inputs, `model` has "
                f"{model.n_outputs} and {model.n_inputs} (sampling time "
                f"{model.sampling_time}). They must agree."
            )
    free = structure.free_feedthrough
    fixed = structure.matrices(structure.reference)[3]
    boxes = [
        Target(m.A, m.B, m.C, np.where(free, m.D, fixed), m.sampling_time)
        for m in models
    ]
    filter_ = weight_target(weight, structure.n_outputs, first.sampling_time)
    system = ErrorSystem(structure, boxes[0], filter_)
    if len(boxes) > 1:
        if filter_ is not None and filter_.D.shape != (1, 1):
            filter_ = filter_.repeated(len(boxes))
        copies = RepeatedOutputs(structure, len(boxes))
        system = ErrorSystem(copies, _stacked(boxes), filter_)
    omega, margin = grid_and_margin(system.target)
    bound = 0.0
    if len(models) == 1 and filter_ is None and first.order > structure.order:
        bound = float(first.hankel_singular_values()[structure.order])
    return RestructuringProblem(
        structure,
        system,
        boxes[0],
        omega,
        margin,
        _weighted_norm(system),
        first.D - boxes[0].D,
        bound,
    )


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
    filter_ = weight_target(weight, p, None)
    if filter_ is not None:
        shaped = StateSpace(filter_.A, filter_.B, filter_.C, filter_.D)
        W = W @ shaped.frequency_response(grid)
    if sample_weight is not None:
        scale = np.asarray(sample_weight, dtype=float).reshape(-1)
        if scale.shape != grid.shape or not np.isfinite(scale).all() or scale.min() < 0:
            raise ValueError(
                f"`sample_weight` must hold {len(grid)} finite weights, not negative, "
                f"one for each frequency. Got shape {np.shape(sample_weight)}."
            )
        W = W * scale[:, None, None]
    system = MeasuredErrorSystem(structure, grid, G, W)
    margin = 1e-4 * float(system.omega[system.omega > 0][0])
    box = realize_response(system.omega, system.G, structure.order)
    reference = float(np.linalg.norm(system.W @ system.G, 2, axis=(1, 2)).max())
    nothing = np.zeros(G.shape[1:])
    return RestructuringProblem(
        structure, system, box, system.omega, margin, reference, nothing, 0.0
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


def _stacked(boxes: Sequence[Target]) -> Target:
    """The black boxes with their outputs below each other, inputs in common."""
    total = sum(len(box.A) for box in boxes)
    p = len(boxes[0].C)
    A, C = np.zeros((total, total)), np.zeros((p * len(boxes), total))
    row = 0
    for k, box in enumerate(boxes):
        n = len(box.A)
        A[row : row + n, row : row + n] = box.A
        C[p * k : p * (k + 1), row : row + n] = box.C
        row += n
    B, D = np.vstack([box.B for box in boxes]), np.vstack([box.D for box in boxes])
    return Target(A, B, C, D, boxes[0].dt)


def _weighted_norm(system: ErrorSystem) -> float:
    t = system.target
    parts = (t.A, t.B, t.C, t.D)
    if system.weight is not None:
        parts = series(*parts, system.weight)
    return hinf_norm(*parts, dt=t.dt).norm
