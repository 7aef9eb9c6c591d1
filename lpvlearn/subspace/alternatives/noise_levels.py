"""Experiments of unequal noise, of which each counts by its own.

A linear system answers ``w u`` by ``w y``, whatever w is, and initial states and
constants of the experiments take it as well. Divided by how large its noise is, every
experiment has errors of one variance, and least squares of all together are those of
the maximum likelihood: a noisy one spoils nothing that others know.

Errors of a system that is not linear are larger where it moves more, and are no noise:
where they are bent nothing is divided, and the model that small motions would have,
which simulates large ones worse, is refused.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...systems.simulation import trend_signals
from ..evidence.constants import CERTAIN
from ..evidence.linearity import find_bend
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples
from ..simulation_error.criterion import criterion_of, n_parameters
from ..simulation_error.noise import through_filter
from ..simulation_error.simulation_fit import simulation_errors, with_initial_states
from .trends import with_trends

Array = NDArray[np.float64]

_UNEQUAL = 2.0  # times the noise of another experiment

# Times that the noise is estimated, of errors that the last model has freed of what a
# noisy experiment did to it; until it differs between experiments by less than that.
_ROUNDS, _SAME = 4, 1.1

_VALUES = 30  # of an experiment, of which the noise is known to an eighth

# Of the criterion, for each parameter: what a model loses by chance in samples that it
# does not fit best. Experiments of unequal noise are fewer than they seem.
_BY_CHANCE = 5.0


def by_own_noise(
    samples: Samples, fitted: LocalFit
) -> tuple[Samples, LocalFit, Array | None]:
    """Experiments of equal noise, their model, and what they were divided by.

    The samples and the fit that were given, and None, where noise is equal or errors
    are none: of a loop, and of what bends.
    """
    choices = samples.choices
    asked = choices.refine in ("auto", "prediction") and not choices.enforce_stability
    asked &= fitted.method != "pbsid" and fitted.evidence.refined
    if not asked or choices.estimated or len(samples.pairs) < 2:
        return samples, fitted, None
    sizes = _noise_sizes(fitted)
    if sizes is None or sizes.max() < _UNEQUAL * sizes.min():
        return samples, fitted, None
    if find_bend(fitted.evidence) is not None:
        return samples, fitted, None
    as_chosen = samples.aside()._replace(choices=fitted.chosen(choices))
    for _ in range(_ROUNDS):
        left = _noise_sizes(with_trends(_divided(as_chosen, sizes)))
        if left is None:
            return samples, fitted, None
        sizes = sizes * left
        if left.max() < _SAME * left.min():
            break
    lengths = [len(u) for u, _ in samples.pairs]
    # Likelihoods are then those of the samples as they were given.
    sizes = sizes / np.exp(np.average(np.log(sizes), weights=lengths))
    weighted = _divided(samples, sizes)
    other = with_trends(weighted.aside())
    residual = _residual_of_given(samples, fitted, other)
    if residual is None:
        return samples, fitted, None
    return weighted, other._replace(residual=residual), sizes


def as_given(fitted: LocalFit, sizes: Array, differ: bool) -> LocalFit:
    """A fit of experiments that were divided by sizes, as one of those given.

    Whether their constants `differ` was told before. The evidence stays as it is.
    """
    size, offsets, states = sizes[:, None], fitted.offsets, fitted.model.initial_states
    offsets = offsets._replace(
        inputs=size * offsets.inputs,
        outputs=size * offsets.outputs,
        drifts=size * offsets.drifts,
        constants=size * offsets.constants,
        differ=differ,
    )
    if len(states) == len(size):
        states = size * states
    model = fitted.model._replace(initial_states=states)
    return fitted._replace(model=model, offsets=offsets)


def _divided(samples: Samples, sizes: Array) -> Samples:
    pairs = zip(sizes, samples.pairs, strict=True)
    return samples._replace(pairs=[(u / size, y / size) for size, (u, y) in pairs])


def _noise_sizes(fitted: LocalFit) -> Array | None:
    """Root mean square of the whitened errors of every experiment.

    The median of others where one is too short to tell; None where all are.
    """
    evidence = fitted.evidence
    records, (filter_, weight) = evidence.records, evidence.whitening
    lost, sizes = len(filter_) - 1, []
    for error in simulation_errors(evidence.begun_in(records), records):
        tells = len(error) > 2 * lost and (len(error) - lost) * len(weight) >= _VALUES
        white = through_filter(filter_, error) if tells else error[:0]
        sizes.append(np.sqrt(np.mean((white @ weight.T) ** 2)) if tells else np.nan)
    found = np.array(sizes)
    if np.isnan(found).all():
        return None
    found[np.isnan(found)] = np.nanmedian(found)
    return found if np.isfinite(found).all() and found.min() > 0.0 else None


def _residual_of_given(
    samples: Samples, fitted: LocalFit, other: LocalFit
) -> float | None:
    """Error of the `other` model in the samples of a fit; None if that is refuted."""
    own, new = fitted.evidence, other.evidence
    if other.method == "pbsid":
        return None
    inputs = np.vstack([u for u, _ in samples.pairs])
    to_new = np.linalg.lstsq(inputs @ own.basis, inputs @ new.basis, rcond=None)[0]
    of_inputs = (own.input_scale[:, None] * to_new / new.input_scale).T
    model = new.model.of_channels(of_inputs, new.output_scale / own.output_scale)
    free, weight = new.free, own.whitening.weight
    records = [
        record._replace(trend=trend_signals(record.n_samples, free.n_trend))
        for record in own.records
    ]
    model = with_initial_states(model, records, free, weight)
    worse = criterion_of(model, records, free)
    worse -= criterion_of(own.model, own.records, own.free)
    unknown = max(n_parameters(len(e.model.A), (), e.free) for e in (own, new))
    if not worse < CERTAIN + _BY_CHANCE * unknown:
        return None
    errors = np.vstack(simulation_errors(model, records))
    outputs = np.vstack([record.y.T for record in records])
    return float(np.sqrt(np.sum(errors**2) / (np.sum(outputs**2) or 1.0)))
