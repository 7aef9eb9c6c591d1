"""Gauss-Newton steps on the simulation error, started from a subspace model.

A subspace estimate of A and C is consistent but not efficient; a pole that is slow
compared with the horizon suffers most. A few steps on the sum of squared simulation
errors, with B, D and the initial states solved for again after each (variable
projection), reach the accuracy of maximum likelihood under white output noise and
stay consistent under any noise that is uncorrelated with the input.

The parameters are all entries of A's blocks, B, C, D and the initial states; the
freedom that a change of basis leaves is removed by taking the minimum-norm step
(data-driven local coordinates: McKelvey, Helmersson and Ribarits, Automatica 40, 2004).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ..systems.least_squares import column_scale, scaled_lstsq
from .records import Record, output_energy
from .signals import SharedSignals, block_radius
from .simulation_fit import Freedom, Realization, block_fit, linearised, moved_model

Array = NDArray[np.float64]

# Steps: from a subspace model a handful does, but along the valley of lags that are
# hardly told apart
_MAX_ITER, _MANY = 20, 100

# Directions of the step that the data do not determine: the choice of basis, mostly.
UNDETERMINED = 1e-9

# An excess of this share of the noise that one parameter absorbs is not worth a step.
_NEGLIGIBLE = 1e-2

# What is left after a step is the square of how far its gain was from the predicted
# one, divided by the latter, were there one direction; the misses of several may
# cancel. It is taken to be this many times that, and no less than this share (5 %
# squared) of the prediction.
_MISS_WEIGHT, _LEAST_LEFT = 4.0, 2.5e-3

ROUNDING = 1e-22  # share of the outputs' energy below which the error is rounding
_STABLE_RADIUS = 1.0 - 1e-8  # of the circle that steps keep all poles in, once they are

# Damping of the steps tried in turn, relative to the largest squared singular value:
# the whole step, then from the hardly determined directions to ever more of them, at
# last down the gradient. A valley is followed by steps that leave only the former out.
_DAMPINGS = (0.0, 1e-4, 1e-2, 1e-1, 1.0)
_FINE_DAMPINGS = (0.0, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)


def refine_simulation(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    max_iter: int | None = None,
    *,
    fitted: bool = True,
    patient: bool = False,
    signals: SharedSignals | None = None,
) -> Realization:
    """Minimise the simulation error by Gauss-Newton steps with damping.

    Starts from a model of `simulation_fit` on these records, scaled to comparable size
    channel by channel, or where it is not `fitted` on one that is like this single
    record, `signals` then those of the model and inputs that it shares with others.
    Only steps that reduce the error are taken; a stable model stays stable. A model
    without section form (poles of high multiplicity), of order 0, or whose simulation
    overflows is returned as it is. `patient` goes on along valleys: of orders that are
    compared, too high a one would follow slow noise there.

    The steps end where one more could not gain what a hundredth of the noise on
    each parameter costs. What is left after a step follows from how far the decrease
    was from the predicted one: an exact prediction is the mark of a quadratic
    function, whose minimum one step reaches.
    """
    if model.A.size == 0 or (fitted and not np.isfinite(model.loss)):
        return model
    energy = output_energy(records)
    n_values = sum(record.y.size for record in records)
    dampings = _FINE_DAMPINGS if patient else _DAMPINGS
    level = 0  # of the damping: a valley is not left at the next step
    for _ in range(max_iter or (_MANY if patient else _MAX_ITER)):
        if model.loss <= ROUNDING * energy or model.blocks is None:
            return model
        regression = linearised(
            model, records, free, keep_one=True, signals=None if fitted else signals
        )
        if regression is None:
            return model
        jacobian, residual = regression[:, :-1], regression[:, -1]
        if not fitted:
            model, fitted = model._replace(loss=float(residual @ residual)), True
        step, rank = scaled_lstsq(jacobian, residual, UNDETERMINED)
        left_over = residual - jacobian @ step
        predicted = float(residual @ residual - left_over @ left_over)
        negligible = _NEGLIGIBLE * model.loss * rank / n_values
        if predicted <= negligible:
            return model
        steps = _trial_steps(step, jacobian, residual, dampings[max(level - 1, 0) :])
        improved = _accepted(model, records, free, steps)
        if improved is None:
            return model
        tried, better = improved
        level = max(level - 1, 0) + tried if patient else 0
        miss = predicted - (model.loss - better.loss)
        model = better
        left = _MISS_WEIGHT * miss**2 / predicted + _LEAST_LEFT * predicted
        if left <= negligible:
            return model
    return model


def _accepted(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    steps: Iterable[Array],
) -> tuple[int, Realization] | None:
    """The first of ever shorter steps that reduces the error, and its number."""
    radius = max(_STABLE_RADIUS, block_radius(model.blocks or ()))
    for number, trial_step in enumerate(steps):
        moved = moved_model(model, trial_step, free)
        blocks = moved.blocks or ()
        if block_radius(blocks) > radius:
            continue
        trial = block_fit(blocks, moved.C, records, free)
        if trial.loss < model.loss:
            return number, trial
    return None


def _trial_steps(
    step: Array, jacobian: Array, residual: Array, dampings: Sequence[float]
) -> Iterator[Array]:
    """The whole step, where it is not to be damped, then damped ones.

    These by normal equations, whose condition damping bounds: directions that the data
    do not determine are damped away by the least of it.
    """
    if dampings[0] == 0.0:
        yield step
    scale = column_scale(jacobian)
    jacobian = jacobian / scale
    gram, projected = jacobian.T @ jacobian, jacobian.T @ residual
    largest = np.linalg.eigvalsh(gram)[-1]
    for damping in dampings:
        if damping > 0.0:
            damped = gram + damping * largest * np.eye(len(gram))
            yield lapack.dposv(damped, projected)[1] / scale
