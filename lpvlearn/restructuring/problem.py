"""What the restructuring minimises: the distance of a structure to what it shall match.

That is the norm of the weighted error ``W (G(theta) - G0)``, Eq. (6), where ``G0`` is
one black-box model, several ones of an operating point with their outputs below each
other, or a measured frequency response. What a response tells of the parameters follows
from its derivative J: which ones, by its rank; and to first order how exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, qr

from ..models.statespace import DEVIATION, StateSpace
from ..structures.structure import GrayBoxStructure
from ..systems.hinf_norm import hinf_norm
from ..systems.least_squares import column_scale
from ..validation import weights
from .deadline import time_is_up
from .error_system import ErrorSystem, Target, remembering, series
from .known_poles import Division, divide
from .least_squares import (
    LeastSquaresResult,
    channel_scaling,
    fit_frequency_response,
    least_maximum,
)
from .limits import growth, keeps_margin, natural_margin
from .measured import (
    MeasuredErrorSystem,
    read_frequency_data,
    read_noise,
    stable_realization,
)
from .similarity import bilinear_changes
from .singular_points import Bend, bend_of, squared_combinations

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FrequencyWeight = StateSpace | Sequence[float | None] | None

GOOD_FIT = 3e-3  # relative least-squares error that a wrong basin seldom comes down to
EXACT_FIT = 1e-8  # and one that is rounding: nothing is better
AGREEING = 2  # starts that end at the best fit: it is taken for the best there is
_LONGER = 3  # times as many fits where the best one is good, but no other ends there
_SAME_COST = 1e-4  # relative difference of the costs of fits in one basin: it is 1e-6

# A measured response does not tell how slowly modes may decay: they must be stable, by
# a rate that no response down to the lowest frequency could show.
_LEAST_DECAY = 1e-4

# Singular values smaller than that part of the largest are rounding: responses and
# their derivatives are exact to about 1e-13, behind resolvents less so.
_RANK_TOLERANCE = 1e-9
_DIGITS = 1e-12  # of a response, that are lost where its terms cancel
_ROUNDING = 1e-10  # relative change of a response that is none: a step's end

# Parameters whose own size changes the response by a smaller part are next to zero; and
# the part of a promised change that tells a linear response.
_ZERO, _LINEAR = 1e-3, 0.5

# Relative step that tells how the response bends, and one of which rounding would tell
_LOCAL, _TOO_SHORT = 0.1, 1e-3
_KNOWN = 1e-2  # relative standard deviation of a parameter that is known well enough

_SAME = 1e-6  # relative difference of delays that is rounding

_NAMED = 0.1  # smaller parts of an undetermined combination would only clutter its name


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

    @cached_property
    def response(self) -> Complex:
        """The black box at the frequencies."""
        return self.system.target_response(self.omega)

    @cached_property
    def _derivatives(self) -> Callable[[Array], tuple[Complex, Complex]]:
        """Response at parameters and its derivatives, the last ones remembered."""
        return remembering(
            lambda theta: self.system.response_jacobian(theta, self.omega), points=1
        )

    @cached_property
    def _weighted(self) -> tuple[Complex, Complex, float]:
        """The weight, the black box behind it, and its root mean square."""
        W = self.system.weight_response(self.omega)[0]
        G = W @ self.response
        square = np.mean(np.sum(np.abs(G) ** 2, axis=(1, 2)))
        return W, G, max(float(np.sqrt(square)), 1e-300)

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
        if fit is None or not EXACT_FIT < fit.relative_error <= GOOD_FIT:
            return fit
        # it may have stopped on the way along a curved valley
        return self._fit(fit.x, scaling, True)

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
        error = float(np.sqrt(fit.cost)) / self._weighted[2]
        return fit._replace(relative_error=error)

    def best_fits(
        self,
        candidates: Array,
        n_fits: int,
        enough: float = EXACT_FIT,
        known: Sequence[LeastSquaresResult] = (),
    ) -> list[LeastSquaresResult]:
        """Least-squares fits from the best candidates, until one is certain.

        That is one of a relative error of at most `enough`, or a good one at which
        several end, `known` ones among them, which as many more may look for. They are
        ranked by the error of their response, not of their parameters.
        """
        system = self.system
        usable = [theta for theta in candidates if self.is_stable(theta)]
        if not usable:
            return []
        W, weighted, _ = self._weighted
        scaling = channel_scaling(weighted)
        scale = 1.0 if scaling is None else scaling
        differences = [system.response(x, self.omega) - self.response for x in usable]
        errors = [np.linalg.norm(scale * (W @ dG)) for dG in differences]
        thetas = np.array(usable)[np.argsort(errors, kind="stable")]
        fits: list[LeastSquaresResult] = []
        for number, theta in enumerate(thetas[: _LONGER * n_fits]):
            best = min((f.relative_error for f in fits), default=np.inf)
            together = agreeing([*known, *fits])
            if best <= enough or best <= GOOD_FIT and together >= AGREEING:
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

    def identifiability(self, theta: Array) -> Identifiability:
        """Which parameters the response determines, and how well."""
        J, level, _ = self._relative_changes(theta)
        return Identifiability.from_jacobian(J, self.structure.parameter_names, level)

    def open_variances(self, theta: Array) -> Array:
        """Infinite on the diagonal for parameters that the response leaves open.

        That is where a combination of those that no bound holds does not change it.
        """
        J, level, _ = self._relative_changes(theta)
        free = self._free_jacobian(theta).any(axis=(0, 1, 2))
        names = np.array(self.structure.parameter_names)
        found = Identifiability.from_jacobian(J[..., free], names[free].tolist(), level)
        left_open = {name for direction in found.directions for name in direction}
        return np.diag(np.where(np.isin(names, list(left_open)), np.inf, 0.0))

    def bent(self, theta: Array, covariance: Array) -> list[str]:
        """Parameters whose intervals are not those of a linear model.

        A parameter is moved by two standard deviations to either side, and the others
        as they go with it: the response there, taken for a linear one, moves it by as
        much to both, and not by half of it more or less. That of two parts that are
        nearly alike does not: it is even in their difference. Parameters known to a
        hundredth are known, whatever the others do to them.
        """
        lower, upper = self.structure.lower, self.structure.upper
        sizes = self._relative_changes(theta)[2]
        # Part of a step that tells how it bends: a long one may saturate.
        room = np.minimum(np.minimum(theta - lower, upper - theta), _LOCAL * sizes)
        with np.errstate(all="ignore"):
            std = np.sqrt(np.diag(covariance))
            steps = 2.0 * covariance / std
            ratios = np.where(steps.T, room, np.inf) / np.abs(steps.T)
            parts = np.minimum(1.0, np.min(ratios, axis=1))
            lengths = parts * np.max(np.abs(steps.T) / sizes, axis=1)
        known = np.isfinite(std) & (std > _KNOWN * sizes)
        some = np.flatnonzero(known & (lengths > _TOO_SHORT))
        bend = self._bend_of(theta)
        bends = {j: bend(parts[j] * steps[:, j]) for j in some}
        even = {j: 0.5 * found for j, found in bends.items() if found is not None}
        if not even:
            return []
        moved = self.parameter_changes(theta, np.array(list(even.values())), "hinf")
        names = self.structure.parameter_names
        return [
            names[j]
            for j, row in zip(even, moved, strict=True)
            if abs(row[j]) > _LINEAR * parts[j] ** 2 * 2.0 * std[j]
        ]

    def _bend_of(self, theta: Array) -> Bend:
        lower, upper = self.structure.lower, self.structure.upper
        return bend_of(
            lambda there: self.system.response(there, self.omega), theta, lower, upper
        )

    def _relative_changes(self, theta: Array) -> tuple[Complex, Array, Array]:
        """Of the response by relative steps, its sizes, and those of the parameters."""
        G, J = self._derivatives(theta)
        scaling = channel_scaling(self.response)
        if scaling is not None:  # a faint channel tells parameters, too
            G, J = G * scaling, J * scaling[..., None]
        level = np.linalg.norm(G, axis=(1, 2))
        usual = float(np.sqrt(np.mean(level**2)))
        effect = np.sqrt(np.sum(np.abs(J) ** 2, axis=(0, 1, 2)) / len(J))
        sizes = np.where(theta == 0, 1.0, np.abs(theta))
        # Next to zero, where the response is linear in a parameter, its errors count
        # against what would matter: most zeros are meant to be zeros.
        for j in np.flatnonzero(
            (effect > 0) & (effect * np.abs(theta) < _ZERO * usual)
        ):
            step = np.zeros(len(theta))
            step[j] = (-1.0 if theta[j] < 0 else 1.0) * usual / effect[j]
            with np.errstate(all="ignore"):  # there need not be a model
                moved = self.system.response(theta + step, self.omega)
                moved = moved if scaling is None else moved * scaling
                change = np.sqrt(np.sum(np.abs(moved - G) ** 2) / len(G))
            if change > _LINEAR * usual:
                sizes[j] = abs(step[j])
        return J * sizes, level, sizes

    def parameter_changes(self, theta: Array, dG: Complex, norm: str) -> Array:
        """First-order changes, (r, n_params), with the black box's response.

        Of the parameters that minimise Eq. (7) for the norm "similarity", else the
        weighted mean square error, ``d theta = Re(K dG)`` with
        ``K = (J^T J)^-1 J^H W`` in real arithmetic, over the grid or, for "h2", over
        frequencies as its integral counts them. `dG` (r, k, n_outputs, n_inputs) are
        changes of the response; several black boxes change alike.
        """
        if norm == "similarity":
            assert self.box is not None  # it was minimised
            return bilinear_changes(self.structure, self.box, theta, self.omega, dG)
        counts = np.gradient(self.omega) if norm == "h2" else None
        W = self._weighted[0]
        if counts is not None:
            W = np.sqrt(counts)[:, None, None] * W
        WJ = np.einsum("kpq,kqmj->kpmj", W, self._changes(theta))
        flat = WJ.reshape(-1, WJ.shape[-1])
        columns = np.vstack([flat.real, flat.imag])
        unit = column_scale(columns)
        inverse = np.linalg.pinv(columns / unit) / unit[:, None]
        real, imaginary = np.split(inverse, 2, axis=1)
        K = (real + 1j * imaginary).reshape(-1, *WJ.shape[:-1])
        K = np.einsum("jkpm,kpq->jkqm", K, W.conj())
        if K.shape[2] != dG.shape[2]:  # several black boxes were stacked
            K = K.reshape(*K.shape[:2], -1, *dG.shape[2:]).sum(2)
        K = K[: len(theta)]
        return np.asarray(np.einsum("jkpm,rkpm->rj", K.conj(), dG).real)

    def _changes(self, theta: Array) -> Complex:
        """Derivatives of the response, and columns of `squared_combinations`."""
        J = self._free_jacobian(theta)
        relative, level, sizes = self._relative_changes(theta)
        free = J.any(axis=(0, 1, 2))
        rows = _sparse_rows(_undetermined(relative[..., free], level))
        if not len(rows):
            return J
        steps = np.zeros((len(rows), len(theta)))
        steps[:, free] = rows * sizes[free]
        flat, bend = J.reshape(-1, len(theta)), self._bend_of(theta)
        size = float(np.linalg.norm(self.response))
        found = squared_combinations(flat, steps, sizes, bend, size)
        return np.concatenate([J, found.reshape(*J.shape[:3], -1)], axis=3)

    def _free_jacobian(self, theta: Array) -> Complex:
        """Derivative of the response; zero by parameters that their bounds hold.

        That is where the way to the bound changes the response by rounding.
        """
        G, J = self._derivatives(theta)
        lower, upper = self.structure.lower, self.structure.upper
        way = np.minimum(theta - lower, upper - theta)
        effect = np.linalg.norm(J.reshape(-1, len(theta)), axis=0)
        with np.errstate(invalid="ignore"):  # no bound, and no effect
            held = way * effect <= _ROUNDING * np.linalg.norm(G)
        return np.where(held, 0.0, J)

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

    def uncertainty(
        self, realizations: Sequence[StateSpace], estimates: Sequence[Any]
    ) -> float:
        """Standard deviation of the response, relative, as errors of `fit` are.

        From the noise of a response, the spread of realizations that the black box is
        the mean of, or models at either side of independent estimates; else zero.
        """
        squares = 0.0
        if self.noise is not None:
            squares = float(np.sum(np.abs(self._weighted[0]) ** 2 @ self.noise**2))
        elif estimates:
            count = len(estimates)
            pairs = [pair for _, both in estimates for pair in both]
            steps = [self._weighted_response(a) - self._weighted_response(b)
                     for a, b in pairs]  # fmt: skip
            scale = 2.0 * DEVIATION * count
            squares = sum(float(np.sum(np.abs(d / scale) ** 2)) for d in steps)
        elif len(realizations) > 1:
            G = np.array([self._weighted_response(model) for model in realizations])
            variance = np.sum(np.abs(G - G.mean(0)) ** 2) / (len(G) - 1)
            squares = float(variance) / len(G)
        return float(np.sqrt(squares / len(self.omega))) / self._weighted[2]

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
        W = self._weighted[0]
        return W @ np.tile(G, (1, W.shape[2] // G.shape[1], 1))

    def spread_covariance(
        self, theta: Array, models: Sequence[StateSpace], norm: str
    ) -> Array:
        """Covariance of the parameters of an averaged model from single realizations.

        That of their mean is that of one divided by their number.
        """
        G = np.array([self.response_of(model) for model in models])
        return self.carried_covariance(theta, (G - G.mean(0)) / np.sqrt(len(G)), norm)

    def noise_covariance(self, theta: Array, draws: int, seed: int) -> Array:
        """Covariance of the parameters of a response with noise, from so many draws."""
        rng = np.random.default_rng(seed)
        real, imaginary = rng.normal(size=(2, draws, *self.response.shape))
        noise = self.noise * np.sqrt(0.5) * (real + 1j * imaginary)
        return self.carried_covariance(theta, noise, "hinf")

    def carried_covariance(self, theta: Array, noise: Complex, norm: str) -> Array:
        """Covariance of the parameters that minimise `norm`, from draws of the noise.

        In the linearised structure: the least maximum for "hinf", which is not linear
        in the noise, else as `parameter_changes`; with `open_variances`.
        """
        if norm != "hinf":
            changes = self.parameter_changes(theta, noise, norm)
        else:
            W = self._weighted[0]
            WJ = np.einsum("kpq,kqmj->kpmj", W, self._changes(theta))
            copies = W.shape[2] // noise.shape[2]  # of several black boxes
            dE = W @ np.tile(noise, (1, 1, copies, 1))
            # what the noise does not explain of the error is there with any noise
            E = self.system.weighted_error(theta, self.omega)
            variance = np.sum(np.abs(dE) ** 2) / (len(dE) - 1)
            explained = variance / max(float(np.sum(np.abs(E) ** 2)), 1e-300)
            E = E * np.sqrt(max(1.0 - explained, 0.0))
            changes = np.array([least_maximum(E - part, WJ) for part in dE])
            changes = changes[:, : len(theta)]
        covariance = np.cov(changes.T, ddof=1).reshape(len(theta), -1)
        return covariance + self.open_variances(theta)


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
    boxes = [
        Target(m.A, m.B, m.C, structure.feedthrough_of(m.D), m.sampling_time)
        for m in models
    ]
    whole = structure
    structure, division = divide(structure, boxes, known_poles)
    if division is not None:
        boxes = [division.of(box) for box in boxes]
    for box in boxes:
        _check_stable(box)
    filter_ = _weight_model(weight, p, dt)
    behind = None
    if filter_ is not None:
        behind = Target(filter_.A, filter_.B, filter_.C, filter_.D, dt)
        if behind.D.shape != (1, 1):  # one for every black box
            behind = behind.repeated(len(boxes))
    target, matched = boxes[0], structure
    if len(boxes) > 1:
        target, matched = _stacked(boxes), structure.with_stacked_outputs(len(boxes))
    system = ErrorSystem(matched, target, behind)
    parts = (target.A, target.B, target.C, target.D)
    if system.weight is not None:
        parts = series(*parts, system.weight)
    bound = 0.0
    plain = division is None and filter_ is None
    if len(models) == 1 and plain and len(first.A) > structure.order:
        bound = float(first.hankel_singular_values()[structure.order])
    return RestructuringProblem(
        structure,
        system,
        boxes[0],
        system.grid,
        natural_margin(target),
        hinf_norm(*parts, dt=dt).norm,
        first.D - boxes[0].D,
        bound,
        first.input_delay,
        whole,
        division,
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
            "with fixed entries, and both are divided by it; or, if only a "
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
    noise: ArrayLike | None = None,
    coherence: ArrayLike | None = None,
    n_averages: int | None = None,
    known_poles: ArrayLike | None = None,
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
    filter_ = _weight_model(weight, p, None)
    if filter_ is not None:
        own = filter_.frequency_response(grid)
        W = own if own.shape == W.shape else own * W  # one for all outputs
    if sample_weight is not None:
        W = W * weights(sample_weight, len(grid), "frequency")[:, None, None]
    std = read_noise(noise, coherence, n_averages, G)
    whole, nothing = structure, Target(*(np.zeros((0, 0)),) * 4)
    low, high = grid[grid > 0].min(), grid.max()
    structure, division = divide(
        structure, [nothing], known_poles, slowest=float(np.sqrt(low * high))
    )
    if division is not None:
        _check_positive(grid, division)
        divided = division.weight(grid)
        G, std = divided * G, None if std is None else np.abs(divided) * std
    if std is not None:
        W = W / np.sqrt(np.mean(std**2, axis=2))[:, None, :]
        std = std[np.argsort(grid)]
    system = MeasuredErrorSystem(structure, grid, G, W)
    return RestructuringProblem(
        structure,
        system,
        stable_realization(system.omega, system.G, structure.order),
        system.omega,
        _LEAST_DECAY * float(system.omega[system.omega > 0][0]),
        float(np.linalg.norm(system.W @ system.G, 2, axis=(1, 2)).max()),
        np.zeros(G.shape[1:]),
        0.0,
        np.zeros(structure.n_inputs),
        whole,
        division,
        std,
    )


def _check_positive(grid: Array, division: Division) -> None:
    if grid.min() == 0 and any(step.pole == 0 for step in division.steps):
        raise ValueError(
            "`omega` must be positive where `structure` has an integrator, whose "
            "response is infinite at zero. Got 0."
        )


def _weight_model(
    weight: Any, n_outputs: int, sampling_time: float | None
) -> StateSpace | None:
    """The `frequency_weight`, model or band, in the time domain of the black boxes."""
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
    if weight.input_delay.any():
        raise ValueError(
            f"`frequency_weight` must be without delay. Got {weight}. A delay changes "
            "no gain: leave it out by with_input_delay(0)."
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


@dataclass(frozen=True)
class Identifiability:
    """Rank analysis of the derivative of the response to the parameters.

    Attributes
    ----------
    rank : int
        Number of parameter combinations that the response determines.
    n_params : int
    condition : float
        The most by which a relative error of the response (root mean square over
        frequency) may grow into relative errors of the parameters. Below 1 over the
        black box's own relative error all parameters are known. Infinite if the rank is
        deficient.
    directions : tuple of dict
        One for every undetermined combination: relative change by parameter name, the
        largest 1; below 0.1 it is left out.
    sensitivities : dict
        The same as the condition by parameter name.
    """

    rank: int
    n_params: int
    condition: float
    directions: tuple[dict[str, float], ...]
    sensitivities: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.directions:
            by_name = sorted(self.sensitivities, key=self.sensitivities.__getitem__)
            worst = f", most that of {by_name[-1]}" if by_name else ""
            return (
                f"all {self.n_params} parameters are identifiable "
                f"(condition {self.condition:.2g}{worst})."
            )
        parts = [
            " ".join(f"{value:+.2g} {name}" for name, value in direction.items())
            for direction in self.directions
        ]
        return (
            f"the response determines {self.rank} of the {self.n_params} parameters. "
            f"It does not change along: {'; '.join(parts)} (in relative steps). "
            "Fix a parameter of each combination in the template."
        )

    @classmethod
    def from_jacobian(
        cls, J: Complex, names: Sequence[str], level: Array | float = 1.0
    ) -> Identifiability:
        """Analysis of the response Jacobian, (n_freq, n_outputs, n_inputs, n_params).

        `J` holds changes with the steps that errors and directions are relative to,
        `level` (n_freq,) the sizes of the response. The rank is that of columns divided
        by their norms, of rows divided by the size of what they hold: it does not
        depend on units, on parameters that happen to be zero, nor on how far the
        response falls over frequency.

        Examples
        --------
        The gain ``b c`` of a response does not tell ``b`` from ``c``:

        >>> J = np.array([[[[2.0 + 0j, 3.0]]]])  # at b = 3, c = 2
        >>> found = Identifiability.from_jacobian(J * [3.0, 2.0], ["b", "c"], [6.0])
        >>> found.rank, found.directions
        (1, ({'b': 1.0, 'c': -1.0},))
        """
        n = J.shape[-1]
        undetermined = _undetermined(J, level)
        rank = n - len(undetermined)
        directions = tuple(
            {
                name: float(value)
                for name, value in zip(names, row, strict=True)
                if abs(value) > _NAMED
            }
            for row in _sparse_rows(undetermined)
        )
        # errors of the response are alike at all frequencies
        usual = float(max(np.linalg.norm(level), _DIGITS * np.linalg.norm(J))) or 1.0
        unit, s, Vt = _scaled_svd(J / usual)
        inverse = (Vt / np.maximum(s, 1e-150)[:, None]).T / unit[:, None]
        gains = np.linalg.norm(inverse, axis=1)
        for direction in directions:
            gains[[names.index(name) for name in direction]] = np.inf
        condition = float(np.linalg.norm(inverse, 2)) if rank == n else np.inf
        sensitivities = dict(zip(names, gains.tolist(), strict=True))
        return cls(rank, n, condition, directions, sensitivities)


def _undetermined(J: Complex, level: Array | float) -> Array:
    """Relative steps along which a response of that size does not change, by rows."""
    k = len(J)
    level = np.broadcast_to(level, (k,))
    size = np.maximum(level, _DIGITS * np.linalg.norm(J.reshape(k, -1), axis=1))
    unit, s, Vt = _scaled_svd(J / np.where(size > 0, size, 1.0)[:, None, None, None])
    rank = int((s > _RANK_TOLERANCE * s.max(initial=0.0)).sum())
    return np.asarray(Vt[rank:] / unit)


def _scaled_svd(J: Complex) -> tuple[Array, Array, Array]:
    """Lengths of the columns (1 for none), singular values and rows of unit ones."""
    n = J.shape[-1]
    flat = J.reshape(int(np.prod(J.shape[:-1])), n)
    # rows of zeros: few frequencies must not hide undetermined combinations
    columns = np.vstack([flat.real, flat.imag, np.zeros((n, n))])
    unit = column_scale(columns)
    _, s, Vt = np.linalg.svd(columns / unit, full_matrices=False)
    return unit, s, Vt


def _sparse_rows(null: Array) -> Array:
    """Basis of the row space, each row with one entry of its own, largest entry 1.

    Combinations that have nothing to do with one another come apart; an orthonormal
    basis would mix them.
    """
    if len(null) == 0:
        return null
    own = qr(null, mode="r", pivoting=True)[1][: len(null)]
    rows = np.linalg.solve(null[:, own], null)
    largest = np.take_along_axis(rows, np.abs(rows).argmax(1)[:, None], 1)
    return (rows / largest).round(12) + 0.0
