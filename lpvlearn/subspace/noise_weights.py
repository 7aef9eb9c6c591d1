"""A model estimated once more with every output in units of its own noise.

A fit of the simulation errors v minimises, in some units s of the outputs,

    sum over t and i of (v_i[t] / s_i)^2.

Under white noise it is efficient where s_i is the standard deviation of the noise of
output i (the diagonal of maximum likelihood). A fit cannot know these before: in units
of the outputs' own size, a poor sensor bends the dynamics that all outputs share, and
with them the response of a good one. The errors of a first fit tell them nearly, and
those of the next better: a clean output that is fitted badly looks noisier than it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.preparation import remove_trends
from ..models.statespace import StateSpace
from ..systems.simulation import estimate_initial_state, free_responses, lti_response
from .identification import scale_records
from .refinement import refine_simulation
from .signals import Record
from .simulation_fit import Freedom, Realization, in_sections
from .statistics import autoregression

Array = NDArray[np.float64]

_SETTLED = 1.05  # a ratio of weights that costs the square of it in efficiency

_LARGEST_RATIO = 1e4  # of noise to signal: sixteen digits carry the square of no better

_ROUNDS = 6  # each brings a clean output's noise nearer by ten: up to that ratio


class NoiseWeighted(NamedTuple):
    """A model, and the units in which it minimises the errors of its outputs."""

    lti: StateSpace
    output_scale: Array


def noise_weighted(
    lti: StateSpace,
    pairs: Sequence[tuple[Array, Array]],
    *,
    detrend: str | None = None,
) -> NoiseWeighted:
    """Refine a discrete-time model with its outputs weighted by their noise.

    It nearly minimises the simulation error over the experiments (u, y) in other units;
    entries of D that are zero stay so. A single output, or noise in proportion to the
    outputs, returns the model as it was; so does a search that ends unstable.
    """
    centred = remove_trends(list(pairs), detrend)[0]
    size = scale_records(centred).output_scale
    plain = NoiseWeighted(lti, size)
    if len(size) == 1 or lti.order == 0:
        return plain
    unit, weighted = size, lti
    for _ in range(_ROUNDS):
        errors = _scaled_errors(weighted, centred, unit)[1]
        innovation = np.diagonal(autoregression(errors).covariance)
        noise = unit / size * np.sqrt(np.maximum(innovation, 0.0))
        if not noise.any():
            break
        new = size * np.maximum(noise, noise.max() / _LARGEST_RATIO) / noise.max()
        change = new / unit
        if change.max() <= _SETTLED * change.min():
            break
        unit, weighted = new, _refined(weighted, centred, new)
    return NoiseWeighted(weighted, unit) if weighted.is_stable else plain


def _scaled_errors(
    lti: StateSpace, pairs: Sequence[tuple[Array, Array]], unit: Array
) -> tuple[list[Array], list[Array]]:
    """Initial states, and what is left of the outputs, in their units."""
    C, D = lti.C / unit[:, None], lti.D / unit[:, None]
    states, errors = [], []
    for u, y in pairs:
        error = y / unit - lti_response(lti.A, lti.B, C, D, u)
        responses = free_responses(lti.A, C, len(error))
        states.append(estimate_initial_state(responses, error))
        errors.append(error - responses @ states[-1])
    return states, errors


def _refined(
    lti: StateSpace, pairs: Sequence[tuple[Array, Array]], unit: Array
) -> StateSpace:
    """The model at the least simulation error in these units of the outputs."""
    su, sy = scale_records(pairs).input_scale, unit[:, None]
    records = [Record((u / su).T.copy(), (y / unit).T.copy()) for u, y in pairs]
    states, errors = _scaled_errors(lti, pairs, unit)
    loss = sum(float(np.sum(error**2)) for error in errors)
    start = Realization(
        lti.A, lti.B * su, lti.C / sy, lti.D * su / sy, np.array(states), loss
    )
    free = Freedom(lti.D != 0.0)
    model = refine_simulation(in_sections(start), records, free)
    return StateSpace(
        model.A, model.B / su, sy * model.C, sy * model.D / su, lti.sampling_time
    )
