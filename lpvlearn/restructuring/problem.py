"""What the restructuring minimises: the distance of a structure to what it shall match.

That is the norm of the weighted error ``W (G(theta) - G0)``, Eq. (6), where ``G0`` is
one black-box model, several ones of an operating point with their outputs below each
other, or a measured frequency response.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from ..models.statespace import DEVIATION, StateSpace
from ..structures.structure import GrayBoxStructure
from ..systems.hinf_norm import hinf_norm
from ..validation import weights
from .coordinates import CanonicalForm, View
from .deadline import time_is_up
from .error_system import ErrorSystem, Target, series
from .frequency_weight import weight_model
from .known_poles import Division, divide
from .least_squares import (
    LeastSquaresResult,
    channel_scaling,
    fit_frequency_response,
)
from .limits import Limits, growth, keeps_margin, natural_margin
from .measured import (
    LARGEST,
    SMALLEST,
    MeasuredErrorSystem,
    read_frequency_data,
    read_noise,
)
from .realization import stable_realization

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

GOOD_FIT = 3e-3  # relative least-squares error that a wrong basin seldom comes down to
EXACT_FIT = 1e-8  # and one that is rounding: nothing is better
CLEAN_FIT = 1e-10  # responses are known to 1e-13: no certificate stands on less

# An error is rounding, too, of so many units in the last place of all entries, at most
# of that size: forms of many states hold no more digits.
_UNITS, _MOST_ROUNDING = 3.0, 1e-6
_STALLED = 1e-4  # error at which a canonical form may stop for its coordinates alone
AGREEING = 2  # starts that end at the best fit: it is taken for the best there is
_LONGER = 3  # times as many fits where the best one is good, but no other ends there
_SAME_COST = 1e-4  # relative difference of the costs of fits in one basin: it is 1e-6

# A measured response does not tell how slowly modes may decay: they must be stable, by
# a rate that no response down to the lowest frequency could show.
_LEAST_DECAY = 1e-4

# A fit of an error up to that multiple of the black box's standard deviation is as good
# as the true parameters' own.
_NOISY = 1.5

_PROVEN = 1e-8  # an error that much above its lower bound, its rounding, is optimal

_SAME = 1e-6  # relative difference of delays that is rounding

_MOST_WEIGHTED = 1e60  # size of a weighted response: fourth powers of it are numbers


@dataclass(frozen=True, eq=False)
class RestructuringProblem:
    """A structure beside what it shall match."""

    structure: GrayBoxStructure
    system: ErrorSystem
    box: Target | None  # one black box, from which similarity transformations start
    omega: Array  # (k,) frequencies of the least-squares fit, rad/s
    margin: float  # stability margin, 1/s
    reference: float  # H-infinity norm of the weighted black box
    dropped_feedthrough: Array  # (n_outputs, n_inputs)
    lower_bound: float  # no parameters have a smaller error
    input_delay: Array  # (n_inputs,) of the black box, which no structure has
    # the structure as it was given, where known poles are divided out of this one
    whole: GrayBoxStructure
    division: Division | None = None
    noise: Array | None = None  # standard deviations of the entries of a response
    lacks_poles: bool = False  # whether a black box has not the poles of the structure
    # of every output of the black box, relative to the root mean square of all
    deviations: Array | float = 0.0

    @cached_property
    def response(self) -> Complex:
        """The black box at the frequencies."""
        return self.system.target_response(self.omega)

    @cached_property
    def weight(self) -> Complex:
        """The weight at the frequencies."""
        return self.system.weight_response(self.omega)[0]

    @cached_property
    def _weighted(self) -> tuple[Complex, float]:
        """The black box behind the weight, and its root mean square."""
        G = self.weight @ self.response
        square = np.mean(np.sum(np.abs(G) ** 2, axis=(1, 2)))
        return G, max(float(np.sqrt(square)), 1e-300)

    def model(self, theta: Array) -> StateSpace:
        """The gray-box model of parameters, with the delay of the black box."""
        model = self.whole.model(theta, self.system.dt)
        return model.with_input_delay(self.input_delay)

    def is_stable(self, theta: Array) -> bool:
        """Whether parameters give a model that keeps the stability margin."""
        return keeps_margin(self.system, theta, self.margin)

    def fit(
        self, theta: Array, scaling: Array | float = 1.0
    ) -> LeastSquaresResult | None:
        """Least-squares fit of the response from given parameters; None if unstable."""
        fit = self._fit(theta, scaling, False)
        if fit is not None and EXACT_FIT < fit.relative_error <= GOOD_FIT:
            # it may have stopped on the way along a curved valley
            fit = self._fit(fit.x, scaling, True)
        if fit is None or fit.relative_error > _STALLED or np.ndim(scaling):
            return fit
        return self._locally(fit)

    def rounding(self, theta: Array) -> float:
        """The relative error that rounding makes of both models."""
        units = _UNITS * self.system.rounding(theta) / self.reference
        return min(units, _MOST_ROUNDING)

    def is_least(self, error: float) -> bool:
        """Whether no parameters have a smaller error than this one, to rounding."""
        return error <= self.lower_bound * (1.0 + _PROVEN)

    @property
    def enough(self) -> float:
        """Relative error of a fit as good as the true parameters' own."""
        return max(EXACT_FIT, _NOISY * float(np.linalg.norm(self.deviations)))

    def is_exact(self, fit: LeastSquaresResult) -> bool:
        """Whether nothing is better: an error of the black box itself, or of rounding.

        Of every output: beside one of large numbers another's error may be all of it.
        """
        error = fit.relative_error
        if error <= EXACT_FIT:
            return True
        if error <= self.enough:
            left = self.system.response(fit.x, self.omega) - self.response
            squares = np.sum(np.abs(self.weight @ left) ** 2, axis=(0, 2))
            errors = np.sqrt(squares / len(self.omega)) / self._weighted[1]
            return bool((errors <= _NOISY * self.deviations + EXACT_FIT).all())
        return error <= _MOST_ROUNDING and error <= self.rounding(fit.x)

    def _locally(self, fit: LeastSquaresResult) -> LeastSquaresResult:
        """A fit of a canonical form, ended in coordinates of the models near it.

        The coefficients of many states are so badly conditioned that the fit stops
        short of what they can hold.
        """
        rounding = max(CLEAN_FIT, self.rounding(fit.x)) * self.reference
        if self.system.values(fit.x, self.omega).max() <= rounding:
            return fit
        form = CanonicalForm.of(self.system, fit.x)
        limits = Limits(self.system, self.margin)
        view = View.of(self.system, fit.x, limits, form).centred()
        if form is None or view.system is self.system:
            return fit
        near = fit_frequency_response(
            view.system, view.theta, self.omega, admissible=view.limits.admissible
        )
        if near is None:
            return fit
        S = view.system.structure.system_matrix(near.x)
        theta = form.refined(S, self.omega)
        found = None if theta is None else self._fit(theta, 1.0, False)
        return found if found is not None and found.cost < fit.cost else fit

    def _fit(
        self, theta: Array, scaling: Array | float, geodesic: bool
    ) -> LeastSquaresResult | None:
        fit = fit_frequency_response(
            self.system,
            theta,
            self.omega,
            admissible=self.is_stable,
            scaling=scaling,
            geodesic=geodesic,
        )
        if fit is None:
            return None
        error = float(np.sqrt(fit.cost)) / self._weighted[1]
        return fit._replace(relative_error=error)

    def best_fits(
        self,
        candidates: Array,
        n_fits: int,
        known: Sequence[LeastSquaresResult] = (),
    ) -> list[LeastSquaresResult]:
        """Least-squares fits from the best candidates, until one is certain.

        That is one that is exact (`is_exact`), or a good one at which several end,
        `known` ones among them, which as many more may look for. They are ranked by the
        error of their response, not of their parameters.
        """
        system = self.system
        usable = [theta for theta in candidates if self.is_stable(theta)]
        if not usable:
            return []
        weighted = self._weighted[0]
        scaling = channel_scaling(weighted)
        scale = 1.0 if scaling is None else scaling
        differences = [system.response(x, self.omega) - self.response for x in usable]
        errors = [np.linalg.norm(scale * (self.weight @ dG)) for dG in differences]
        thetas = np.array(usable)[np.argsort(errors, kind="stable")]
        fits: list[LeastSquaresResult] = []
        for number, theta in enumerate(thetas[: _LONGER * n_fits]):
            best = min((f.relative_error for f in fits), default=np.inf)
            together = agreeing([*known, *fits])
            if best <= GOOD_FIT and together >= AGREEING:
                break
            if any(map(self.is_exact, fits)):
                break
            if best > GOOD_FIT and number >= n_fits:
                break
            if fits and time_is_up():
                break
            if scaling is not None:  # all channels alike first, then as they are
                first = self.fit(theta, scaling)
                theta = theta if first is None else first.x
            fit = self.fit(theta)
            if fit is not None:
                fits.append(fit)
        return fits

    def check_realizations(self, models: Sequence[Any]) -> None:
        """Refuse what cannot be the realizations that the black box is the mean of."""
        if len(models) < 2 or not all(isinstance(m, StateSpace) for m in models):
            raise ValueError(
                "`realizations` must be at least 2 models, each a StateSpace, to have "
                f"a spread. Got {len(models)} of "
                f"{', '.join(sorted({type(m).__name__ for m in models}))}."
            )
        shape = self.structure.n_outputs, self.structure.n_inputs
        for number, model in enumerate(models):
            if model.D.shape != shape or model.sampling_time != self.system.dt:
                raise ValueError(
                    f"`realizations` must have {shape[0]} outputs, {shape[1]} inputs "
                    f"and sampling time {self.system.dt}, as `model` has. Got "
                    f"{model} at place {number}."
                )

    def with_deviations(
        self, realizations: Sequence[StateSpace], estimates: Sequence[Any]
    ) -> RestructuringProblem:
        """The same whose `deviations` of the response are known.

        From the noise of a response, the spread of realizations that the black box is
        the mean of, or models at either side of independent estimates; else zero.
        """
        squares: Array | float = 0.0
        if self.noise is not None:
            squares = np.sum(np.abs(self.weight) ** 2 @ self.noise**2, axis=(0, 2))
        elif estimates:
            count = len(estimates)
            pairs = [pair for _, both in estimates for pair in both]
            steps = [self._weighted_response(a) - self._weighted_response(b)
                     for a, b in pairs]  # fmt: skip
            scale = 2.0 * DEVIATION * count
            squares = sum(np.sum(np.abs(d / scale) ** 2, axis=(0, 2)) for d in steps)
        elif len(realizations) > 1:
            G = np.array([self._weighted_response(model) for model in realizations])
            variance = np.sum(np.abs(G - G.mean(0)) ** 2, axis=(0, 1, 3)) / (len(G) - 1)
            squares = variance / len(G)
        deviations = np.sqrt(squares / len(self.omega)) / self._weighted[1]
        return replace(self, deviations=deviations)

    def response_of(self, model: StateSpace) -> Complex:
        """Response of a model at the frequencies, as the black box is compared.

        Without delay, known poles, and feedthrough where the structure has none.
        """
        D = self.whole.feedthrough_of(model.D)
        compared = StateSpace(model.A, model.B, model.C, D, model.sampling_time)
        G = compared.frequency_response(self.omega)
        return G if self.division is None else self.division.weight(self.omega) * G

    def _weighted_response(self, model: StateSpace) -> Complex:
        G = self.response_of(model)
        W = self.weight
        return W @ np.tile(G, (1, W.shape[2] // G.shape[1], 1))


def agreeing(fits: Sequence[LeastSquaresResult]) -> int:
    """How many of the fits end at the best one, told by their costs."""
    least = min((fit.cost for fit in fits), default=0.0)
    return sum(fit.cost <= least * (1.0 + _SAME_COST) for fit in fits)


def problem_from_models(
    structure: GrayBoxStructure | None,
    models: Sequence[Any],
    weight: Any,
    known_poles: ArrayLike | None = None,
) -> RestructuringProblem:
    """Match state-space models with the exact H-infinity norm.

    The feedthrough of the black boxes is left out where the structure has none,
    as in Eq. (4), and so is their delay: it turns all errors alike and leaves norms as
    they are. Several models are stacked.
    """
    for model in models:
        if not isinstance(model, StateSpace):
            raise ValueError(
                f"`model` must be a StateSpace. Got {type(model).__name__}."
            )
    first = models[0]
    if structure is not None:
        _check_time(structure, first.sampling_time)
    structure = _structure_for(structure, first)
    p, dt = structure.n_outputs, first.sampling_time
    _check_alike(models, structure)
    boxes = [
        Target(m.A, m.B, m.C, structure.feedthrough_of(m.D), m.sampling_time)
        for m in models
    ]
    whole = structure
    structure, division = divide(structure, dt, boxes, known_poles)
    lacks_poles = False
    if division is not None:
        lacks_poles = any(map(division.lacks, boxes))
        boxes = [division.of(box) for box in boxes]
    for box in boxes:
        _check_stable(box)
    filter_ = weight_model(weight, p, dt)
    behind = None
    if filter_ is not None:
        behind = Target(filter_.A, filter_.B, filter_.C, filter_.D, dt)
        if behind.D.shape != (1, 1):  # one for every black box
            behind = behind.repeated(len(boxes))
    target, matched = boxes[0], structure
    if len(boxes) > 1:
        target, matched = _stacked(boxes), structure.with_stacked_outputs(len(boxes))
    system = ErrorSystem(matched, target, behind)
    weighted = target if system.weight is None else series(target, system.weight)
    reference = hinf_norm(*weighted.matrices, dt=dt).norm
    _check_size(reference)
    omega = system.grid if division is None else division.apart(system.grid)
    bound = 0.0
    plain = division is None and filter_ is None
    if len(models) == 1 and plain and len(first.A) > structure.order:
        bound = float(first.hankel_singular_values()[structure.order])
    return RestructuringProblem(
        structure,
        system,
        boxes[0],
        omega,
        natural_margin(target),
        reference,
        first.D - boxes[0].D,
        bound,
        first.input_delay,
        whole,
        division,
        lacks_poles=lacks_poles,
    )


def _check_alike(models: Sequence[StateSpace], structure: GrayBoxStructure) -> None:
    """Refuse models that cannot be matched by one structure together."""
    first = models[0]
    p, dt = structure.n_outputs, first.sampling_time
    for model in models:
        if model.D.shape != (p, structure.n_inputs):
            raise ValueError(
                f"`structure` has {p} outputs and {structure.n_inputs} inputs, `model` "
                f"has {model.n_outputs} and {model.n_inputs}. They must agree; an "
                "input too many is often a column whose role was forgotten (`time=`, "
                "`scheduling=`, `experiment=`)."
            )
        if model.sampling_time != dt:
            raise ValueError(
                "models to be matched together must have one sampling time. Got "
                f"{dt} and {model.sampling_time}."
            )
        if not np.allclose(model.input_delay, first.input_delay, rtol=_SAME, atol=0.0):
            raise ValueError(
                "`model` must be models of one `input_delay` to be matched together. "
                f"Got {first} and {model}. Give them the same by with_input_delay()."
            )


def _check_size(norm: float) -> None:
    if not norm > SMALLEST:
        raise ValueError(
            "`model` must have a response that is not zero where it is compared: "
            f"nothing tells the parameters then. Got one of the norm {norm:.3g}. Name "
            "inputs that move the outputs, give the structure a feedthrough if the "
            "model is a gain, or choose other units if it is only small."
        )
    if not norm < LARGEST:
        raise ValueError(
            f"`model` must have a gain (behind a weight) below {LARGEST:g}. Got "
            f"{norm:.3g}: units are out of range. Take others for inputs or outputs."
        )


def _check_stable(box: Target) -> None:
    poles = np.linalg.eigvals(box.A).astype(complex)
    rates = growth(poles, box.dt)
    if not rates.max(initial=-np.inf) < 0:
        worst = poles[np.argmax(rates)]
        raise ValueError(
            "`model` must be stable: its distance to a gray-box model is infinite "
            f"otherwise. Got a pole at {worst:.4g}. Identify it with "
            "stability='enforce'; if it is an integrator, write it into the structure "
            "with fixed entries (so, too, an oscillator of known frequency without "
            "damping), and both are divided by it; or, if only a "
            "controller holds the system, identify the closed loop, with the "
            "controller's reference as input and the controller in the structure."
        )


def _check_time(structure: Any, sampling_time: float | None) -> None:
    """Refuse a discrete-time model where the structure is not, or cannot be told."""
    if sampling_time is True:
        raise ValueError(
            "`model` must have a known sampling time beside a `structure`. Got one "
            "that counts time in samples. Identify it with `time=` or `sampling_time=` "
            "in seconds, and convert it by to_continuous() for a structure in "
            "continuous time; sampling_time=1 stands for samples."
        )
    if sampling_time is not None and getattr(structure, "is_mechanical", False):
        raise ValueError(
            "`model` must be in continuous time for equations of motion. Got sampling "
            f"time {sampling_time} s. Convert it by to_continuous()."
        )


def _check_structure(structure: GrayBoxStructure) -> None:
    if structure.n_params == 0:
        raise ValueError(
            "`structure` must have a parameter to be found. Got one without, which is "
            "a model: structure.model([])."
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
    _check_structure(structure)
    return structure


def _stacked(boxes: Sequence[Target]) -> Target:
    """The black boxes with their outputs below each other, inputs in common."""
    A, C = block_diag(*(box.A for box in boxes)), block_diag(*(box.C for box in boxes))
    B, D = np.vstack([box.B for box in boxes]), np.vstack([box.D for box in boxes])
    return Target(A, B, C, D, boxes[0].dt)


def problem_from_response(
    structure: GrayBoxStructure | None,
    omega: ArrayLike,
    frf: ArrayLike,
    weight: Any,
    sample_weight: ArrayLike | None,
    noise: ArrayLike | None,
    coherence: ArrayLike | None,
    n_averages: int | None,
    known_poles: ArrayLike | None,
) -> RestructuringProblem:
    """Match a measured frequency response over its frequencies.

    Errors count in standard deviations of the noise, of all inputs together, where they
    are told.
    """
    if not isinstance(structure, GrayBoxStructure):
        raise ValueError(
            "`structure` must be given to fit a frequency response, which does not "
            f"tell the order. Got {structure!r}. Use a GrayBoxStructure, or "
            "fit_model()."
        )
    _check_structure(structure)
    p = structure.n_outputs
    grid, G = read_frequency_data(omega, frf, p, structure.n_inputs)
    W = np.broadcast_to(np.eye(p), (len(grid), p, p)).astype(complex)
    filter_ = weight_model(weight, p, None)
    if filter_ is not None:
        own = filter_.frequency_response(grid)
        W = own if own.shape == W.shape else own * W  # one for all outputs
    if sample_weight is not None:
        W = W * weights(sample_weight, len(grid), "frequency")[:, None, None]
    std = read_noise(noise, coherence, n_averages, G)
    whole, low, high = structure, grid[grid > 0].min(), grid.max()
    structure, division = divide(
        structure, None, [], known_poles, slowest=float(np.sqrt(low * high))
    )
    if division is not None:
        _check_finite(grid, division)
        divided = division.weight(grid)
        G, std = divided * G, None if std is None else np.abs(divided) * std
    if std is not None:
        W = W / np.sqrt(np.mean(std**2, axis=2))[:, None, :]
        std = std[np.argsort(grid)]
    system = MeasuredErrorSystem(structure, grid, G, W)
    reference = float(np.linalg.norm(system.W @ system.G, 2, axis=(1, 2)).max())
    if not 1.0 / _MOST_WEIGHTED < reference < _MOST_WEIGHTED:
        raise ValueError(
            f"`frf` must be of a size from {1.0 / _MOST_WEIGHTED:g} to "
            f"{_MOST_WEIGHTED:g} behind its weights, or in deviations of its noise. "
            f"Got {reference:.3g}; take weights nearer to 1."
        )
    return RestructuringProblem(
        structure,
        system,
        stable_realization(system.omega, system.G, structure.order),
        system.omega,
        _LEAST_DECAY * float(system.omega[system.omega > 0][0]),
        reference,
        np.zeros(G.shape[1:]),
        0.0,
        np.zeros(structure.n_inputs),
        whole,
        division,
        std,
    )


def _check_finite(grid: Array, division: Division) -> None:
    for step in division.steps:
        if (grid == step.pole / 1j).any():
            raise ValueError(
                "`omega` must be positive where `structure` has an integrator, and "
                "must differ from the frequencies of oscillators without damping: the "
                f"response is infinite there. Got {step.pole.imag:g}."
            )
