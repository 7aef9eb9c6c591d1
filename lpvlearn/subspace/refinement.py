"""Gauss-Newton steps on the simulation error, started from a subspace model.

A subspace estimate of A and C is consistent but not efficient; a pole that is slow
compared with the horizon suffers most. A few steps on the sum of squared simulation
errors, with B, D and the initial states solved for again after each (variable
projection), reach the accuracy of maximum likelihood under white output noise and
stay consistent under any noise that is uncorrelated with the input.

The parameters are all entries of A's blocks, B, C, D and the initial states; the
freedom that a change of basis leaves is removed by taking the minimum-norm step
(data-driven local coordinates, McKelvey, Helmersson and Ribarits, 2004).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ..systems.least_squares import scaled_lstsq
from .signals import (
    Record,
    block_sections,
    output_energy,
    signal_factor,
    state_coefficients,
)
from .simulation_fit import (
    Freedom,
    Point,
    Realization,
    block_fit,
    column_scale,
    freedom,
    jacobian_regression,
    n_own,
    stack_regressions,
)

Array = NDArray[np.float64]

# Directions of the step that the data do not determine: the choice of basis, mostly.
_RCOND = 1e-9

# An excess of this share of the noise that one parameter absorbs is not worth a step.
_NEGLIGIBLE = 1e-2

# What is left after a step is the square of how far its gain was from the predicted
# one, divided by the latter, were there one direction; the misses of several may
# cancel. It is taken to be this many times that, and no less than this share (5 %
# squared) of the prediction.
_MISS_WEIGHT = 4.0

_LEAST_LEFT = 2.5e-3

# Below this share of the outputs' energy the error is rounding.
_ROUNDING = 1e-22

# Steps keep all poles inside this circle, once they are.
_STABLE_RADIUS = 1.0 - 1e-8

# Damping of the steps tried in turn, relative to the largest squared singular value:
# from the hardly determined directions to ever more of them, at last down the gradient.
_DAMPINGS = (1e-4, 1e-2, 1e-1, 1.0)


def refine_simulation(
    model: Realization,
    records: Sequence[Record],
    free: Freedom | None = None,
    *,
    max_iter: int = 20,
) -> tuple[Realization, int]:
    """Minimise the simulation error by Gauss-Newton steps with damping.

    Only steps that reduce the error are taken; a stable model stays stable. A model
    without section form (poles of high multiplicity), of order 0, or whose
    simulation overflows is returned as it is.

    Parameters
    ----------
    model : Realization
        Start, from `simulation_fit`.
    records : sequence of Record
        Scaled to comparable size, channel by channel.
    free : Freedom, default=None
        As in `simulation_fit`.
    max_iter : int, default=20

    Returns
    -------
    model : Realization
    n_iter : int
        Steps taken.

    Notes
    -----
    The steps end where one more could not gain what a hundredth of the noise on
    each parameter costs. What is left after a step follows from how far the decrease
    was from the predicted one: an exact prediction is the mark of a quadratic
    function, whose minimum one step reaches.

    References
    ----------
    T. McKelvey, A. Helmersson and T. Ribarits, "Data driven local coordinates for
    multivariable linear systems and their application to system identification",
    Automatica 40, 2004.
    """
    if model.A.size == 0 or not np.isfinite(model.loss):
        return model, 0
    if free is None:
        free = freedom(*model.D.shape)
    model = in_sections(model)
    energy = output_energy(records)
    n_values = sum(record.y.size for record in records)
    for iteration in range(max_iter):
        if model.loss <= _ROUNDING * energy or model.blocks is None:
            return model, iteration
        parts = experiment_regressions(model, records, free)
        if parts is None:
            return model, iteration
        # With one experiment its initial state costs less among the unknowns.
        own = n_own(len(model.A), free)
        regression = parts[0] if len(parts) == 1 else stack_regressions(parts, own)
        jacobian, residual = regression[:, :-1], regression[:, -1]
        step, rank = scaled_lstsq(jacobian, residual, _RCOND)
        left_over = residual - jacobian @ step
        predicted = float(residual @ residual - left_over @ left_over)
        negligible = _NEGLIGIBLE * model.loss * rank / n_values
        if predicted <= negligible:
            return model, iteration
        improved = _accepted(model, records, free, step, jacobian, residual)
        if improved is None:
            return model, iteration
        miss = predicted - (model.loss - improved.loss)
        model = improved
        left = _MISS_WEIGHT * miss**2 / predicted + _LEAST_LEFT * predicted
        if left <= negligible:
            return model, iteration + 1
    return model, max_iter


def in_sections(model: Realization) -> Realization:
    """The same model in section form, or as it is where there is none."""
    if model.blocks is not None:
        return model
    sections = block_sections(model.A)
    if sections is None:
        return model
    blocks, T = sections
    return model._replace(
        A=linalg.block_diag(*blocks),
        B=linalg.solve(T, model.B),
        C=model.C @ T,
        initial_states=linalg.solve(T, model.initial_states.T).T,
        blocks=blocks,
    )


def experiment_regressions(
    model: Realization, records: Sequence[Record], free: Freedom
) -> list[Array] | None:
    """Linearised simulation error of every experiment.

    Parameters
    ----------
    model : Realization
        In section form.
    records : sequence of Record
    free : Freedom

    Returns
    -------
    list of ndarray of shape (n_rows, n_parameters + 1) or None
        As `jacobian_regression`; None where responses overflow.
    """
    assert model.blocks is not None
    parts = []
    for record, x0 in zip(records, model.initial_states, strict=True):
        point = Point(model.C, model.D, np.column_stack([x0, model.B]))
        state_map = state_coefficients(model.blocks, point.driven)
        R = signal_factor(model.blocks, record, state_map)
        if R is None:
            return None
        parts.append(jacobian_regression(R, model.blocks, point, free))
    return parts


def _accepted(
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    step: Array,
    jacobian: Array,
    residual: Array,
) -> Realization | None:
    """The first of ever shorter steps that reduces the error."""
    radius = max(_STABLE_RADIUS, _spectral_radius(model.blocks or ()))
    for trial_step in _trial_steps(step, jacobian, residual):
        blocks, C = _moved(model, trial_step)
        if _spectral_radius(blocks) > radius:
            continue
        trial = block_fit(blocks, C, records, free)
        if trial.loss < model.loss:
            return trial
    return None


def _trial_steps(step: Array, jacobian: Array, residual: Array) -> Iterator[Array]:
    """The whole step, then damped ones."""
    yield step
    scale = column_scale(jacobian)
    left, s, right = linalg.svd(
        jacobian / scale, full_matrices=False, check_finite=False
    )
    kept = s > _RCOND * s[0]
    left, s, right = left[:, kept], s[kept], right[kept]
    projected = left.T @ residual
    for damping in _DAMPINGS:
        gain = s / (s**2 + damping * s[0] ** 2)
        yield (right.T @ (gain * projected)) / scale


def _moved(model: Realization, step: Array) -> tuple[tuple[Array, ...], Array]:
    """Blocks and C after a step; the other parameters follow by least squares."""
    size_c = model.C.size
    size_a = sum(block.size for block in model.blocks or ())
    start = len(step) - size_c - size_a
    blocks = []
    for block in model.blocks or ():
        blocks.append(block + step[start : start + block.size].reshape(block.shape))
        start += block.size
    return tuple(blocks), model.C + step[start:].reshape(model.C.shape)


def _spectral_radius(blocks: Sequence[Array]) -> float:
    """Largest modulus of the poles of blocks of one or two states."""
    radius = 0.0
    for block in blocks:
        if len(block) == 1:
            radius = max(radius, abs(float(block[0, 0])))
            continue
        centre = 0.5 * float(block[0, 0] + block[1, 1])
        det = float(block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0])
        spread = centre * centre - det
        modulus = det**0.5 if spread < 0.0 else abs(centre) + spread**0.5
        radius = max(radius, modulus)
    return radius
