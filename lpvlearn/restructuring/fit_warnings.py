"""What a fit of step 4 tells: how the search ended, and what its result is worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning

from ..exceptions import RankWarning, warn
from ..minimax.problem import MinimaxResult
from ..models.statespace import DEVIATION
from ..structures.interchanges import INTERCHANGE, exchangeable, known_before
from ..validation import listed
from .deadline import time_is_up
from .equal_optima import are_apart, as_good
from .minimise_covariance import IMPLAUSIBLE, CovarianceFit, Estimate
from .problem import EXACT_FIT, RestructuringProblem
from .starts import DISCRETE_BOX, known_signs
from .uncertainty import ParameterUncertainty

Array = NDArray[np.float64]

_INTEGRATOR = (
    " The structure has poles on the axis or beyond by its fixed entries, and the "
    "black box lacks them: name the outputs that integrate, "
    "SubspaceLTI(integrating=...), or let a parameter damp what oscillates."
)
_AT_BOUND = 1e-6  # relative distance to a bound that holds a parameter

_POOR_FIT = 2e-2  # relative least-squares error that is warned about: it shows in plots
_NOTHING = 0.9  # that of a structure that explains next to nothing
_SEEN = 5.0  # standard deviations of an entry of D that is none by chance

_AGREE = 1e-3  # relative difference of the errors of fits in one basin

_NAMED = 6  # parameters in a message; of more the number is enough


def tell_of_search(
    fitted: Any,
    problem: RestructuringProblem,
    result: MinimaxResult,
    *,
    doubted: bool,
    hurried: bool,
    settled: bool,
) -> None:
    """Tell of a search that did not converge, or ended in an optimum of doubt.

    As of a `doubted` fit, at which one round of starts alone ended, or of a search that
    was `hurried`. Efficient parameters that are `settled`, found and with an error that
    the noise explains, do not hang on where the search for the least norm stopped
    before them; those of a wrong basin noise would not explain.
    """
    errors = fitted.starts_["relative_error"].to_numpy()
    timed_out = hurried and errors[0] > problem.enough
    if timed_out or (time_is_up() and not result.converged):
        warn(
            "the search ended at `max_time`, with a relative error of "
            f"{fitted.relative_error_:.2g} and `stationarity_` "
            f"{fitted.stationarity_:.1g} (0 at an optimum): it did not look at all "
            "starts, or not to the end. The best point is kept. Raise `max_time`, "
            "or give `init`.",
            ConvergenceWarning,
        )
        doubted = False  # no more can be said of the starts
    elif not (result.converged or settled):
        spent = fitted.n_iter_ >= fitted.max_iter
        warn(
            f"the search {'ended at' if spent else 'stalled before'} "
            f"`max_iter`={fitted.max_iter} steps, with `stationarity_` "
            f"{fitted.stationarity_:.1g} (0 at an optimum): a lower norm may be "
            f"near. {f'It ended because {result.cause}. ' if result.cause else ''}"
            "The best point is kept. "
            + ("Raise `max_iter`" if spent else "Try another `random_state`")
            + ", or take a structure of fewer parameters.",
            ConvergenceWarning,
        )
    if doubted and not problem.is_least(fitted.error_):
        together = _together(errors)
        beyond = errors[together:]
        warn(
            f"one round of starts alone ended at the best fit, {together} of "
            f"{len(errors)}, of the relative error {errors[0]:.2g}"
            + (f" (the next one {beyond[0]:.2g})" if len(beyond) else "")
            + ": it may not be the best there is. Raise `n_starts`, or give "
            "`init`, to confirm it.",
            ConvergenceWarning,
        )
    if fitted.convergence_ == "saddle":
        warn(
            "the search ended at a saddle (`second_order_` "
            f"{fitted.second_order_:.2g}): a lower norm is near, and no step found "
            "it. Try another `random_state`, or give `init`.",
            ConvergenceWarning,
        )


def _together(errors: Array) -> int:
    """How many fits end in the basin of the best one."""
    return int((errors <= errors[0] * (1.0 + _AGREE)).sum())


def tell_of_poor_fit(fitted: Any, problem: RestructuringProblem) -> None:
    """Tell of a structure that comes no nearer than shows, and no noise explains."""
    errors = fitted.starts_["relative_error"].to_numpy()
    floor = fitted.structural_floor_ / problem.reference
    if fitted.fit_error_ > _NOTHING:  # so far off none moves it: that is no floor
        floor = 0.0
    explained = getattr(fitted, "p_value_", 0.0) > IMPLAUSIBLE  # by the noise
    error = min(fitted.fit_error_, fitted.relative_error_) - floor
    if error > max(_POOR_FIT, problem.enough) and not explained:
        together = _together(errors)
        warn(
            f"the structure comes no nearer than {100 * fitted.fit_error_:.2g} % "
            f"(root mean square over frequency) to the black box; {together} of "
            f"{len(errors)} fits from different starts end there. "
            + (
                "It probably cannot represent the model any better."
                if together > 1
                else "Either it cannot represent the model, or the search ended in "
                "a wrong basin."
            )
            + _INTEGRATOR * problem.lacks_poles
            + _at_bounds(fitted)
            + " Give `init`, or raise `n_starts`, to search elsewhere."
            + DISCRETE_BOX
            * (fitted.structure is not None and not fitted.lti_.is_continuous),
            ConvergenceWarning,
        )


def tell_of_misfit(
    fitted: Any, found: CovarianceFit, estimates: Sequence[Estimate]
) -> None:
    """Tell of a structure that the noise of the black box does not keep away from it.

    With what is known of the cause.
    """
    warn(
        f"the structure lies {np.sqrt(found.misfit):.3g} times as far from the "
        "black box as its noise explains (`p_value_` "
        f"{found.p_value:.1g}): the standard deviations are too small then, "
        "and the parameters meet the frequencies best that the data tell most "
        "of. Give the structure what it lacks, the local models the delay of "
        "an input that answers late (`input_delay`), or keep the H-infinity "
        "optimum by norm='hinf' (in a pipeline, efficient=False)."
        + _at_bounds(fitted)
        + _without_feedthrough(fitted, estimates)
    )


def _at_bounds(fitted: Any) -> str:
    """Which parameters stand at their bounds, as a sentence; nothing for none."""
    structure = fitted.structure_
    bounds = np.array([structure.lower, structure.upper])
    held = np.isclose(fitted.params_, bounds, rtol=_AT_BOUND, atol=0.0).any(axis=0)
    names = [n for n, k in zip(structure.parameter_names, held, strict=True) if k]
    if not names:
        return ""
    return f" At their bounds stand {', '.join(names)}: leave them more room."


def _without_feedthrough(fitted: Any, estimates: Sequence[Estimate]) -> str:
    """Which entries of D the structure lacks, as a sentence; nothing for none."""
    dropped = fitted.dropped_feedthrough_
    pairs = [pair for _, both in estimates for pair in both]
    if not pairs or not dropped.any():
        return ""
    steps = np.array([above.D - below.D for above, below in pairs])
    std = np.linalg.norm(steps, axis=0) / (2.0 * DEVIATION * len(estimates))
    seen = np.argwhere(np.abs(dropped) > _SEEN * std)
    if not len(seen):
        return ""
    places = listed([f"D[{i}][{j}]" for i, j in seen], _NAMED)
    return (
        f" The black box has {places}, more than by chance, where the structure has "
        "none."
    )


def tell_of_negative_masses(fitted: Any) -> None:
    """Tell of ``M(theta)``, or E, that is not positive, where nobody said so."""
    equations, theta = fitted.structure_.implicit, fitted.params_
    if equations is None:
        return
    M = equations.M[0] + np.tensordot(theta, equations.M[1:], 1)
    free = equations.M[1:].any((1, 2)) & (known_signs(fitted.structure_) == 0.0)
    negative = np.flatnonzero(free & (theta < 0.0))
    symmetric = np.isfinite(M).all() and (M == M.T).all()
    if not symmetric or not len(negative) or np.linalg.eigvalsh(M)[0] >= 0.0:
        return
    names = fitted.structure_.parameter_names
    values = listed([f"{names[j]} = {theta[j]:.3g}" for j in negative], _NAMED)
    warn(
        f"`{equations.name}` is not positive with {values}, as no mass, inertia or "
        "capacity is. Check the signs of the template; or give bounds that say so, "
        "by structure.with_bounds()."
    )


def tell_of_open_parameters(fitted: Any) -> None:
    """Tell of parameters that no response determines, or tells from one another."""
    if fitted.identifiability_.rank < fitted.structure_.n_params:
        warn(str(fitted.identifiability_), RankWarning)
        return
    known = known_before(fitted.structure_, fitted.init)
    names = exchangeable(fitted.structure_, fitted.params_, known)
    if names:
        warn(
            f"the values of {listed([repr(name) for name in names], _NAMED)} may "
            "be those of one another: no response tells these parts of the "
            "structure apart. Say which is which by structure.with_bounds(), "
            "structure.with_ranges(), or a first guess, `init`; or number their "
            "names, as 'lag_1' and 'lag_2', where it does not matter.",
            kind=INTERCHANGE,
        )


def tell_of_others(fitted: Any, problem: RestructuringProblem) -> None:
    """Tell of other parameters with the same response, but of open ones."""
    theta, names = fitted.start_params_, fitted.structure_.parameter_names
    error = fitted.fit_error_
    known = fitted.identifiability_.rank == len(theta)
    if not known or error > _POOR_FIT or not isinstance(fitted.init, str):
        return
    other = as_good(problem, theta, error)
    if other is None:
        return
    apart = np.flatnonzero(are_apart(other, theta))
    gains = [fitted.identifiability_.sensitivities[names[j]] for j in apart]
    moved = np.array(gains) * max(error, EXACT_FIT) * np.abs(theta[apart])
    if not (np.abs(other - theta)[apart] > moved).all():
        return  # errors of the response may lead as far
    values = listed([f"{names[j]} = {other[j]:.4g}" for j in apart], _NAMED)
    warn(
        f"other values of {listed([repr(names[j]) for j in apart], _NAMED)} give "
        f"the same response, {values}: the data do not tell which are right, nor "
        "do `confidence_intervals`, which are about `params_` alone. Say it by "
        "structure.with_bounds(), structure.with_ranges(), or a first guess, "
        "`init`.",
        kind=INTERCHANGE,
    )


def tell_of_nonlinear(fitted: Any, at: ParameterUncertainty) -> None:
    """Where `params_covariance_` is that of a linear model, and it is none."""
    if not hasattr(fitted, "params_covariance_"):
        return
    bent = at.not_linear(fitted.params_covariance_)
    if bent:
        names = listed([repr(name) for name in bent], _NAMED)
        warn(
            f"the intervals of {names} are not to be trusted: "
            "within two standard deviations the response does not change in "
            "proportion to them, as where two parts of the structure are so alike "
            "that the noise hides which is which. Use more data or less noise, or "
            "give what is known of them (a value, or bounds)."
        )
