"""Minimisation of the H-infinity norm of the error over the parameters, Eq. (14)-(16).

From the least-squares fit along the central path (none where the fit is near), and to
the end by one of the minimax solvers; what a constant peak leaves free is chosen by the
remaining error.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..minimax.bundle import proximal_bundle
from ..minimax.problem import Flags, MinimaxProblem, MinimaxResult, Peaks
from ..minimax.sqp import minimax_sqp
from .central_path import PathPoint, central_path
from .coordinates import CanonicalForm, Geodesics, ResponseGeometry, View
from .deadline import time_is_up
from .error_system import ErrorSystem, vanishing_weight
from .least_squares import LeastSquaresResult, fit_frequency_response
from .limits import Limits, within_bounds

Array = NDArray[np.float64]

_DEPTH = 0.6  # peaks down to that fraction below the objective enter the local model
_FLAT = 1e-7  # a peak with a smaller relative gradient does not depend on theta
_CAP_TOLERANCE = 1e-7  # relative excess over the cap that rounding may make
_RIPPLE = 1e-6  # relative height above the floor that a peak beside it may have
_DIP = 1e-2  # part of a peak by which it stands out from the floor's shoulder
_MAX_CAPS = 12  # frequencies at which the cap is a constraint: the last ones met

# depths at which peaks that move are looked for below high constant ones
_HARD_STEPS = (0.99, 0.9999)
_STATIONARY = 1e-5  # shortest subgradient of an optimum, relative to the objective
NEARLY = 1e-3  # stationarity up to which no more is said
SADDLE = -1e-4  # second-order measure below which a stationary point is a saddle
_ESCAPES = 4  # from one saddle to the next
_LEAPS = 10.0 ** np.arange(0.0, -4.5, -0.5)  # steps along the valley of a saddle
_LOWER = 1e-9  # relative decrease that leaves a saddle

# mu at the end of a round on the central path, and iterations of the solver from there;
# the next round if these do not converge
_ROUNDS = ((1e-4, 8), (1e-5, 12), (1e-6, 15), (1e-8, 60))
# Of so many parameters an end too early costs more than the path to a better one, and
# a further one brings no digit of the norm that the parameters hold. A solver that is
# not there after ten iterations may need forty, of twice the time of the path's steps.
_MANY, _MANY_ROUNDS = 100, ((3e-8, 10), (1e-9, 60))
_NO_DIGIT = 1e-6  # relative decrease promised of the norm, of many parameters
_CLOSELY, _ROUGHLY = 0.1, 1.0  # what a stage of the path may leave; of many parameters
# Near the black box the solver needs no path: its iterations from a fit that is alone
# promising, of at most that relative error. Where it converges, its end is the path's.
_AT_ONCE, _NEAR = 8, 0.03
_BUNDLE_PACE = 10  # as many iterations of a first-order method
_PATH_SHARE = 0.6  # of the steps that are left, for the path of a round
_PROGRESS = 1e-9  # a round that converged and brings less is the last one
_AHEAD = 0.98  # the path is left for a point that much below it

# mu to which the path is followed from several fits, how many are kept there, and the
# most steps of each: its norm soon tells more of a basin than the least-squares error
_EXPLORED = ((1e-2, 2, 40), (1e-3, 1, 60))
_SAME_BASIN = 0.1  # difference of errors, relative to the norm, of paths that meet
_HOPELESS = 2.0  # norm, relative to the least, of a path that is not followed further
_FITS = 6  # basins that are followed at most
_APART = 1e-4  # relative difference of the costs of different basins
_ALIKE = 2.0  # fits of an error up to that multiple of the least are followed
_RADIUS = 0.1  # first trust-region radius of the solver

# The choice among optimal points, behind a weight and as it is: relative decrease that
# ends it, and most steps
_WEIGHTED_CHOICE, _CHOICE = (1e-3, 20), (1e-6, 60)


@dataclass
class HinfObjective:
    """Peaks of the error in the coordinates y, with constant peaks set aside.

    With `capped`, the norm of that error stays below `cap` while that of `system` is
    minimised.
    """

    system: ErrorSystem
    theta0: Array
    T: Array
    limits: Limits  # of stability, speed, and the parameters' bounds
    cap: float = np.inf
    capped: ErrorSystem | None = None
    floor: float = 0.0  # highest peak met whose value does not depend on parameters
    floor_frequency: float = 0.0
    _top: float = 0.0
    _cap_frequencies: Array = field(default_factory=lambda: np.zeros(0))

    def theta(self, y: Array) -> Array:
        """Parameters at the coordinates `y`."""
        return self.theta0 + self.T @ y

    def admissible(self, theta: Array) -> bool:
        """Whether the gray-box model keeps (most of) the margin, and the cap."""
        if not np.isfinite(theta).all() or not self.limits.admissible(theta):
            return False
        if self.capped is None:
            return True
        found = self.capped.peaks(theta, 1e-3)
        high = found.frequencies[found.values > self.cap * (1.0 + _CAP_TOLERANCE)]
        if high.size:  # bounded there from now on, by a smooth constraint
            known = np.concatenate([self._cap_frequencies, high])
            self._cap_frequencies = np.unique(known)[-_MAX_CAPS:]
        return high.size == 0

    def peaks(self, y: Array) -> Peaks | None:
        """Peaks that depend on the parameters; None where `y` is not admissible."""
        theta = self.theta(y)
        if not self.admissible(theta):
            return None
        within = _DEPTH
        if self.floor > 0 and self._top > 0:
            within = max(_DEPTH, 1.0 - (1.0 - _DEPTH) * self._top / self.floor)
        for depth in (within, *(h for h in _HARD_STEPS if h > within), 1.0):
            found = self.system.peaks(theta, min(depth, 1.0 - 1e-9))
            _, gradients = self.system.gradients(theta, found.frequencies)
            gradients = gradients @ self.T
            steep = np.linalg.norm(gradients, axis=1) > _FLAT * found.values
            if not steep.all():
                flat = found.frequencies[~steep]
                steep[~steep] = ~self.system.constant_at(theta, flat)
            if not steep.all():
                high = int(np.argmax(np.where(steep, -np.inf, found.values)))
                if found.values[high] > self.floor:
                    self.floor = float(found.values[high])
                    self.floor_frequency = float(found.frequencies[high])
            if self.floor > 0:
                steep &= self._apart(theta, found.frequencies, found.values)
            if found.norm == 0.0 or steep.any():
                break
        if not steep.any():  # nothing is left that the parameters could lower
            still, at = np.zeros((1, len(y))), np.full(1, self.floor_frequency)
            return Peaks(np.zeros(1), at, still, np.zeros(1, bool))
        peaks = Peaks(
            found.values[steep],
            found.frequencies[steep],
            gradients[steep],
            np.full(int(steep.sum()), self.system.peaks_move),
        )
        self._top = peaks.top
        return peaks

    def _apart(self, theta: Array, omega: Array, values: Array) -> Flags:
        """Whether peaks are above the floor, or the error dips between it and them."""
        apart, grid = values > self.floor * (1.0 + _RIPPLE), self.system.grid
        low, high = np.sort([omega, np.full(len(omega), self.floor_frequency)], axis=0)
        for k in np.flatnonzero(~apart):
            between = grid[(grid > low[k]) & (grid < high[k])]
            if between.size:
                dip = float(self.system.values(theta, between).min())
                apart[k] = dip < (1.0 - _DIP) * values[k]
        return apart

    def samples(self, y: Array, omega: Array) -> Peaks:
        """Singular values at fixed frequencies, and their gradients."""
        values, gradients = self.system.gradients(self.theta(y), omega)
        return Peaks(values, omega, gradients @ self.T, np.zeros(len(omega), bool))

    def values(self, y: Array, omega: Array) -> Array:
        """Singular values at fixed frequencies, infinite where there is no model."""
        theta = self.theta(y)
        if np.isfinite(self.system.poles(theta)).all():
            with suppress(np.linalg.LinAlgError):  # a pole at one of the frequencies
                return self.system.values(theta, omega)
        return np.full(len(omega), np.inf)

    def hessian(self, y: Array, weights: Array, omega: Array, moving: Flags) -> Array:
        """Second derivative of the weighted sum of the peaks in the coordinates y."""
        H = self.system.hessian(self.theta(y), weights, omega, moving)
        return self.T.T @ H @ self.T

    def constraints(self, y: Array) -> tuple[Array, Array]:
        """The limits, relative to their sizes, and the cap, with gradients."""
        theta = self.theta(y)
        c, dc = self.limits.scaled(theta, self.T)
        if self.capped is None or self._cap_frequencies.size == 0:
            return c, dc
        values, slopes = self.capped.gradients(theta, self._cap_frequencies)
        return (
            np.concatenate([c, values / self.cap - 1.0]),
            np.vstack([dc, slopes @ self.T / self.cap]),
        )

    def curve(self, y: Array) -> Geodesics:
        """Geodesics of the response through `y`."""
        return Geodesics(self.system, self.theta(y), self.T)

    def problem(self) -> MinimaxProblem:
        """The callbacks of the minimax solvers."""
        return MinimaxProblem(
            self.peaks,
            self.samples,
            self.values,
            self.hessian,
            self.constraints,
            self.system.grid,
            self.curve,
            time_is_up,
        )


Solver = Callable[..., MinimaxResult]

SOLVERS: dict[str, Solver] = {"sqp": minimax_sqp, "bundle": proximal_bundle}


def minimise_hinf(
    system: ErrorSystem,
    fits: list[LeastSquaresResult],
    margin: float,
    solver: Solver,
    *,
    max_iter: int,
    tol: float,
    negligible: float,
) -> tuple[Array, MinimaxResult, float]:
    """Minimise the H-infinity norm of the error from least-squares fits.

    `fits` are stable starts by ascending cost, of which the first gives the metric of
    the steps; errors not above `negligible` are rounding noise; `max_iter` counts
    Newton steps on the central path and iterations of the solver, in all. Returns the
    parameters, the result for the peaks that depend on them, and the highest constant
    peak (0 for none).

    Where that floor is above all other peaks, the start is already optimal, and so is
    every theta that keeps the others below it. Then a weight that vanishes at the
    floor's frequency sets it aside, and the norm of what remains is minimised among
    these points; and so it is where the search comes down to the floor, and stalls.
    """
    theta0 = fits[0].x
    start = system.peaks(theta0)
    if start.norm <= negligible:  # exact already
        flat = np.zeros((len(start.values), len(theta0)))
        still = np.zeros(len(start.values), bool)
        peaks = Peaks(start.values, start.frequencies, flat, still)
        return theta0, MinimaxResult(theta0, peaks, 0.0, np.inf, True, 0), 0.0
    origin = np.zeros(len(theta0))
    limits = Limits(system, margin)
    T = ResponseGeometry(system, theta0, system.grid, start.norm).T
    objective = HinfObjective(system, theta0, T, limits)
    first = objective.peaks(origin)
    options: dict[str, Any] = {"tol": tol, "negligible": negligible}
    if first is None or objective.floor < first.top:
        theta, result, floor = _from_least_squares(
            system, fits, limits, solver, max_iter, options
        )
        if floor <= negligible:
            return theta, result, 0.0
        if floor < result.peaks.top:
            return theta, result, floor
        # the search came down to the floor, below which no norm is: an optimum, that
        # the peaks beside it do not certify
        if not result.converged:
            theta, result = _gone_on(system, theta, result, limits, max_iter, options)
        return theta, _certified(result), floor
    floor, options["max_iter"] = objective.floor, max_iter
    theta, result = _minimise_remainder(system, objective, theta0, limits, options)
    return theta, _certified(result), floor


def _certified(result: MinimaxResult) -> MinimaxResult:
    """The result at a constant peak, whose zero gradient certifies the optimum.

    Though not a strict one.
    """
    return replace(result, stationarity=0.0, second_order=0.0, converged=True)


def _gone_on(
    system: ErrorSystem,
    theta: Array,
    result: MinimaxResult,
    limits: Limits,
    max_iter: int,
    options: dict[str, Any],
) -> tuple[Array, MinimaxResult]:
    """From where a search came down to the floor, what remains is minimised.

    In the steps that are left. The start where nothing lower is found.
    """
    T = ResponseGeometry(system, theta, system.grid, system.peaks(theta).norm).T
    above = HinfObjective(system, theta, T, limits)
    if above.peaks(np.zeros(len(theta))) is None or above.floor == 0.0:
        return theta, result  # the floor is no peak here
    options = options | {"max_iter": max(max_iter - result.n_iter, 0)}
    end, found = _minimise_remainder(system, above, theta, limits, options)
    if found.peaks.top >= result.peaks.top:
        return theta, result
    n_iter, history = result.n_iter + found.n_iter, result.history + found.history
    return end, replace(found, n_iter=n_iter, history=history)


def _from_least_squares(
    system: ErrorSystem,
    fits: list[LeastSquaresResult],
    limits: Limits,
    solver: Solver,
    max_iter: int,
    options: dict[str, Any],
) -> tuple[Array, MinimaxResult, float]:
    """Rounds of the central path and a solver; parameters, result and floor.

    The solver alone where it ends at once.
    """
    form = CanonicalForm.of(system, fits[0].x)
    starts = [View.of(system, fit.x, limits, form) for fit in promising(fits)]
    many = len(fits[0].x) >= _MANY
    near = len(starts) == 1 and fits[0].relative_error <= _NEAR and not many
    used, history = 0, []
    if near and solver is minimax_sqp and max_iter > _AT_ONCE:
        end, result, floor = _ended(starts[0], solver, max_iter=_AT_ONCE, **options)
        used, history = result.n_iter, result.history
        if result.converged and result.stationarity <= _STATIONARY:
            there = _ended(end, solver, max_iter=0, **options)[1]  # in its own metric
            there = replace(there, n_iter=used, history=history, converged=True)
            return end.theta, there, floor
    path, steps = _best_path(starts, max_iter - used)
    used, history, floor = used + steps, history + list(path.history), 0.0
    pace = 1 if solver is minimax_sqp else _BUNDLE_PACE
    best: tuple[View, MinimaxResult] | None = None
    rounds, proof = (_MANY_ROUNDS, NEARLY) if many else (_ROUNDS, _STATIONARY)
    for mu_end, solver_iter in rounds:
        steps = int(_PATH_SHARE * (max_iter - used))
        path = _followed(path, mu_end=mu_end, max_iter=steps)
        used, history = used + path.n_iter, history + path.history
        steps = min(pace * solver_iter, max_iter - used)
        end, result, high = _ended(path.view, solver, max_iter=steps, **options)
        used, history = used + result.n_iter, history + result.history
        floor = max(floor, high)
        top = np.inf if best is None else best[1].peaks.top
        if best is None or result.peaks.top < top:
            best = end, result
        done = result.converged or many and _last_digits(result)
        settled = done and result.stationarity <= proof
        settled |= best[1].peaks.top <= options["negligible"]
        idle = result.converged and best[1].peaks.top >= (1.0 - _PROGRESS) * top
        if settled or idle or used >= max_iter or time_is_up():
            break
        ahead = best[1].peaks.top < _AHEAD * path.norm
        ahead &= best[0].limits.strict(best[0].theta)
        path = replace(path, view=best[0] if ahead else path.view, mu=mu_end)
    assert best is not None
    exact = best[1].peaks.top <= options["negligible"]
    # the end of a solver that failed needs the better proof
    enough = _STATIONARY if best[1].cause else NEARLY
    converged = exact or best[1].stationarity <= enough
    result = replace(best[1], n_iter=used, history=history, converged=converged)
    return best[0].theta, result, floor


def _last_digits(result: MinimaxResult) -> bool:
    """Whether the last step of a solver promised no digit of the norm that tells."""
    return bool(result.history) and result.history[-1]["predicted"] <= _NO_DIGIT


def promising(fits: list[LeastSquaresResult]) -> list[LeastSquaresResult]:
    """Fits in different basins (by ascending cost), not much worse than the best one.

    Where the structure is far from the black box, the best fit in least squares need
    not lie in the basin of the least norm.
    """
    chosen = [fits[0]]
    for fit in fits[1:]:
        apart = fit.cost > chosen[-1].cost * (1.0 + _APART)
        if apart and fit.cost <= _ALIKE**2 * fits[0].cost and len(chosen) < _FITS:
            chosen.append(fit)
    return chosen


def _best_path(starts: list[View], max_iter: int) -> tuple[PathPoint, int]:
    """The best point at a moderate mu, from several fits, and the steps of all."""
    paths, used = [PathPoint(start) for start in starts], 0
    for mu_end, kept, steps in _EXPLORED:
        if len(paths) == 1:
            break
        most = min(steps, max_iter // 10)
        paths = [_followed(path, mu_end=mu_end, max_iter=most) for path in paths]
        used += sum(path.n_iter for path in paths)
        paths = _of_different_basins(paths)[:kept]
    return paths[0], used


def _of_different_basins(paths: list[PathPoint]) -> list[PathPoint]:
    """Points by ascending norm, without hopeless ones and those that have met."""
    kept: list[PathPoint] = []
    errors: list[NDArray] = []
    norms = np.array([path.norm for path in paths])
    for i in np.argsort(norms, kind="stable"):
        if norms[i] > _HOPELESS * norms.min():
            break
        view, same = paths[i].view, _SAME_BASIN * norms[i]
        E = view.system.weighted_error(view.theta, view.system.grid)
        if all(np.linalg.norm(E - e, 2, axis=(1, 2)).max() > same for e in errors):
            kept, errors = [*kept, paths[i]], [*errors, E]
    return kept


def _followed(path: PathPoint, **options: Any) -> PathPoint:
    """The central path from where it was left, in fresh coordinates."""
    many = len(path.view.theta) >= _MANY
    start = replace(path, view=path.view.centred())
    end = central_path(start, decrement=_ROUGHLY if many else _CLOSELY, **options)
    view = end.view.back()
    if view is None:  # the form has no parameters for that model
        beside = end.view.beside(path.view.theta)
        return _followed(replace(path, view=beside), **options)
    return replace(end, view=view)


def _ended(
    view: View, solver: Solver, **options: Any
) -> tuple[View, MinimaxResult, float]:
    """End of a solver that starts at a point, its result, and the highest floor met."""
    known, view = view.theta, view.centred()
    system, size = view.system, max(view.system.peaks(view.theta).norm, 1e-300)
    T = ResponseGeometry(system, view.theta, system.grid, size).T
    objective = HinfObjective(system, view.theta, T, view.limits)
    result = solver(
        objective.problem(), np.zeros(len(view.theta)), radius=_RADIUS, **options
    )
    for _ in range(_ESCAPES):
        lower = _left_saddle(objective, result, solver, **options)
        if lower is None:
            break
        result = lower
    end = view.at(within_bounds(system, objective.theta(result.y)))
    found = end.back()
    if found is None:
        return _ended(end.beside(known), solver, **options)
    return found, result, objective.floor


def is_saddle(result: MinimaxResult) -> bool:
    """Whether a lower norm lies along the negative curvature of a stationary point."""
    return result.stationarity <= NEARLY and result.second_order < SADDLE


def _left_saddle(
    objective: HinfObjective, result: MinimaxResult, solver: Solver, **options: Any
) -> MinimaxResult | None:
    """The end of the solver on the lower side of a saddle; None where there is none.

    The gradient does not lead out of a saddle; one step along the most negative
    curvature, to either side, does.
    """
    if not is_saddle(result) or result.valley is None:
        return None
    problem, best, start = objective.problem(), np.inf, None
    for leap in _LEAPS:
        for side in (leap, -leap):
            y = result.y + side * result.valley
            found = problem.peaks(y)
            if found is not None and found.top < best:
                best, start = found.top, y
    if start is None:
        return None
    again = solver(problem, start, radius=_RADIUS, **options)
    if not again.peaks.top < (1.0 - _LOWER) * result.peaks.top:
        return None
    return replace(
        again,
        n_iter=result.n_iter + again.n_iter,
        history=result.history + again.history,
    )


def _minimise_remainder(
    system: ErrorSystem,
    above: HinfObjective,
    theta0: Array,
    limits: Limits,
    options: dict[str, Any],
) -> tuple[Array, MinimaxResult]:
    """Minimise the peaks below a constant one, which certifies the optimum already.

    First all of the error behind a weight that vanishes where that peak is, while its
    norm stays on the floor: this finds the shoulder of the constant peak on which the
    other ones are low. Then these peaks as they are.
    """

    def choice(tol: float, steps: int) -> dict[str, Any]:
        most = min(options["max_iter"], steps)
        return options | {"tol": max(options["tol"], tol), "max_iter": most}

    grid, origin, history = system.grid, np.zeros(len(theta0)), []
    weight = vanishing_weight(system, above.floor_frequency)
    if weight is not None:
        remainder, floor = system.reweighted(weight), above.floor
        bound = HinfObjective(remainder, theta0, above.T, limits, floor, system)
        fit = fit_frequency_response(
            remainder, theta0, grid, admissible=bound.admissible
        )
        assert fit is not None  # theta0 is admissible
        size = max(remainder.peaks(fit.x).norm, 1e-300)
        T = ResponseGeometry(remainder, fit.x, grid, size).T
        objective = HinfObjective(remainder, fit.x, T, limits, floor, system)
        first = minimax_sqp(objective.problem(), origin, **choice(*_WEIGHTED_CHOICE))
        theta0 = within_bounds(system, objective.theta(first.y))
        history = first.history
        above = replace(above, theta0=theta0, T=T)
    result = minimax_sqp(above.problem(), origin, **choice(*_CHOICE))
    theta = within_bounds(system, above.theta(result.y))
    n_iter, history = len(history) + result.n_iter, history + result.history
    return theta, replace(result, n_iter=n_iter, history=history)
