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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.least_squares import column_scale, scaled_lstsq, thin_svd
from ..samples.records import Record, output_energy
from .criterion import PRICE
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
_ROUNDED = 1e-12  # to either side of that circle

# Damping of the steps tried in turn, relative to the largest squared singular value:
# the whole step, then from the hardly determined directions to ever more of them, at
# last down the gradient.
_DAMPINGS = (0.0, 1e-4, 1e-2, 1e-1, 1.0)

# Along a valley the damping is that of the last step, raised by growing factors where
# the step fails (Nielsen), lowered where it gains about what it promised.
_FIRST, _LEAST, _MOST = 1e-14, 1e-17, 1.0
_MORE, _LESS = 4.0, 0.1
_AS_PROMISED, _FAR_LESS = 0.75, 0.25  # shares of a promised gain


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
    Only steps that reduce the error are taken; a stable model stays stable, and one
    that grows by less than noise may tell integrates. A model without section form
    (poles of high multiplicity), of order 0, or whose simulation overflows is
    returned as it is. `patient` goes on along valleys: of orders that are compared,
    too high a one would follow slow noise there.

    The steps end where one more could not gain what a hundredth of the noise on
    each parameter costs. What is left after a step follows from how far the decrease
    was from the predicted one: an exact prediction is the mark of a quadratic
    function, whose minimum one step reaches.
    """
    if model.A.size == 0 or (fitted and not np.isfinite(model.loss)):
        return model
    limit = max_iter or (_MANY if patient else _MAX_ITER)
    shared = None if fitted else signals
    found = _refined(model, records, free, limit, patient, fitted, shared)
    apart = 1.0 / max(record.n_samples for record in records)
    if not 1.0 <= block_radius(found.blocks or ()) < 1.0 + apart:
        return found
    # what grows by next to nothing may integrate
    blocks = tuple(_within(b, _STABLE_RADIUS, 1.0 + apart) for b in found.blocks or ())
    if block_radius(blocks) > _STABLE_RADIUS + _ROUNDED:
        return found
    other = block_fit(blocks, found.C, records, free)
    other = _refined(other, records, free, limit, patient)
    n_values = sum(record.y.size for record in records)
    return other if other.loss < (1.0 + PRICE / n_values) * found.loss else found


def _refined(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    limit: int,
    patient: bool,
    fitted: bool = True,
    signals: SharedSignals | None = None,
) -> Realization:
    """As `refine_simulation`."""
    energy = output_energy(records)
    n_values = sum(record.y.size for record in records)
    damping = 0.0
    for _ in range(limit):
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
        tried = _rising(damping) if patient else _DAMPINGS
        steps = _trial_steps(step, jacobian, residual, predicted, tried)
        improved = _accepted(model, records, free, steps)
        if improved is None:
            return model
        trial, better, clipped = improved
        gain = model.loss - better.loss
        if patient:
            damping = _next_damping(trial.damping, gain / trial.promised)
        miss = predicted - gain
        model = better
        left = _MISS_WEIGHT * miss**2 / predicted + _LEAST_LEFT * predicted
        if left <= negligible or (clipped and gain <= negligible):
            return model
    return model


class _Trial(NamedTuple):
    """A step that is tried, its damping, and the gain that it promises."""

    step: Array
    damping: float
    promised: float


def _accepted(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    trials: Iterable[_Trial],
) -> tuple[_Trial, Realization, bool] | None:
    """The first of ever shorter steps that reduces the error, and its model.

    And whether that was kept from growing, and gains less than was promised.
    """
    # beside a constant alone an integrator is worth that
    apart = bool(free.n_trend) / max(record.n_samples for record in records)
    radius = max(_STABLE_RADIUS, block_radius(model.blocks or ()))
    for trial in trials:
        moved = moved_model(model, trial.step, free)
        blocks = moved.blocks or ()
        clipped = block_radius(blocks) > radius + _ROUNDED
        if clipped:
            blocks = tuple(_within(b, radius, radius + apart) for b in blocks)
            if block_radius(blocks) > radius + _ROUNDED:
                continue
        found = block_fit(blocks, moved.C, records, free)
        if found.loss < model.loss:
            return trial, found, clipped
    return None


def _within(block: Array, radius: float, farthest: float) -> Array:
    """A block of A, a pole that integrates taken back to a radius: others may move on.

    It is as it was where poles oscillate, are beyond the `farthest`, or both integrate:
    at one place they have no section form.
    """
    if block_radius([block]) <= radius:
        return block
    poles, V = np.linalg.eig(block)
    if np.iscomplexobj(poles):
        return block
    both = len(poles) == 2 and poles.min() > 2.0 * radius - farthest
    if both or np.abs(poles).max() > farthest:
        return block
    return np.asarray(V * np.clip(poles, -radius, radius) @ np.linalg.pinv(V))


def _trial_steps(
    step: Array,
    jacobian: Array,
    residual: Array,
    predicted: float,
    dampings: Iterable[float],
) -> Iterator[_Trial]:
    """The whole step, which promises the `predicted` gain, and damped ones.

    With ``J = U diag(s) V^T`` of the Jacobian, its columns scaled, ``d = V diag(s /
    (s^2 + damping max(s)^2)) U^T r``, without the directions that the data do not
    determine.
    """
    parts: tuple[Array, ...] | None = None
    for damping in dampings:
        if damping == 0.0:
            yield _Trial(step, 0.0, predicted)
            continue
        if parts is None:
            scale = column_scale(jacobian)
            U, s, Vt = thin_svd(jacobian / scale)
            known = s > UNDETERMINED * s[0]
            share = (s[known] / s[0]) ** 2
            parts = Vt[known].T / scale[:, None], (U.T @ residual)[known], s[known]
        V, along, s = parts
        kept = share / (share + damping)
        promised = float(np.sum(along**2 * kept * (2.0 - kept)))
        yield _Trial(V @ (kept * along / s), damping, promised)


def _rising(damping: float) -> Iterator[float]:
    """Dampings from one on, up to that of a step down the gradient."""
    more = _MORE
    while damping < _MOST:
        yield damping
        damping, more = max(more * damping, _FIRST), 2.0 * more
    yield _MOST


def _next_damping(damping: float, share: float) -> float:
    """That of the next step, by the share of the promised gain that this one made."""
    if share > _AS_PROMISED:
        damping *= _LESS
    elif share < _FAR_LESS:
        damping = max(_MORE * damping, _FIRST)
    return damping if damping >= _LEAST else 0.0
