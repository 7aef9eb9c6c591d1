"""Where experiments stand: constants of inputs and outputs, and drifts.

Measured signals stand about a point of work, ``y - y0 = G(q) (u - u0)`` but for the
free response, which is ``y = G(q) u + c`` with ``c = y0 - G(1) u0``: the transient of a
constant input is a free response. So an experiment has one unknown for each output, c,
that outputs are linear in, like the initial state; u0 and y0 need not be known. With an
integrator G(1) is infinite: the answer to ``-u0`` is a straight line, which takes the
drift (``offset="linear"``) and tells u0, and c itself is a matter of the initial state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...data.preparation import Pairs
from ...exceptions import DivergenceError
from ...systems.least_squares import column_scale
from ...systems.modes import n_changes
from ...systems.simulation import free_responses, trend_signals
from ..samples.records import Centres
from ..simulation_error.refinement import UNDETERMINED
from .statistics import Evidence

Array = NDArray[np.float64]

# Trends of every output and experiment; "auto" begins without.
N_TRENDS = {"auto": 0, None: 0, "constant": 1, "linear": 2}

ROUNDING = 1e-9  # errors of outputs of unit size that are rounding
_SETTLED = 10.0  # time constants per experiment of a mode that forgets its beginning
_RELUCTANTLY = 1e-4  # taken: initial states where offsets do as well
_UNSEEN = 0.1  # share of the errors that inputs need not explain of a line
_NEARLY = 0.01  # share of the line itself that they need not


class Offsets(NamedTuple):
    """Where the experiments stand: ``y - outputs = G(q) (u - inputs)``, and drift."""

    inputs: Array  # (n_experiments, n_inputs)
    outputs: Array  # (n_experiments, n_outputs)
    drifts: Array  # (n_experiments, n_outputs), per sample, about the middle
    constants: Array  # (n_experiments, n_outputs), outputs at rest at input zero
    n_samples: Array  # (n_experiments,)
    differ: bool = False  # the constants do, by more than their uncertainty

    def shifted(self, inputs: Array, outputs: Array) -> Offsets:
        """Of samples before these were subtracted."""
        inputs, outputs = self.inputs + inputs, self.outputs + outputs
        return self._replace(inputs=inputs, outputs=outputs)

    def begun(self) -> Offsets:
        """With the outputs where the drifts of the experiments begin."""
        gone = self.drifts * (self.n_samples - 1)[:, None] / 2.0
        return self._replace(outputs=self.outputs - gone)

    def pooled(self) -> Offsets:
        """As of one experiment: the means over all samples."""
        total = self.n_samples.sum(keepdims=True)
        share = (self.n_samples / total)[None]
        u, y, drift = share @ self.inputs, share @ self.outputs, share @ self.drifts
        return Offsets(u, y, drift, share @ self.constants, total, self.differ)


def joined(parts: Sequence[Offsets]) -> Offsets:
    """Of the experiments of all parts."""
    u, y, drifts, c, n = (np.concatenate([p[k] for p in parts]) for k in range(5))
    return Offsets(u, y, drifts, c, n, any(part.differ for part in parts))


def attributed(evidence: Evidence, centres: Centres, pairs: Pairs) -> Offsets:
    """Offsets of the experiments `pairs`, from a model of the centred ones.

    The inputs stand at their means, the outputs where the static gain then has them.
    Where a mode is not far faster than the longest experiment, means tell little of
    where it rests, and the static gain may be infinite: both stand where experiments
    begin nearest to rest, if that is near where outputs go, unlike in mid-motion. Where
    these are known to start at rest, inputs stand at zero.
    """
    model, lengths = evidence.model, np.array([len(u) for u, _ in pairs])
    n_trend, ny = centres.trends.shape[1:]
    levels, none = centres.inputs, np.zeros((len(pairs), ny))
    if not n_trend:
        return Offsets(levels, none, none, none, lengths)
    trends = centres.trends + evidence.output_scale * model.trends
    outputs, constants, drifts = trends[:, 0], trends[:, 0], none
    if n_trend > 1:
        drifts = trends[:, 1] * 2.0 / np.maximum(lengths - 1, 1)[:, None]
    if not evidence.free.initial_states:
        return Offsets(levels, outputs, drifts, constants, lengths)
    longest = int(lengths.max())
    slowest = min(n_changes(model.A, longest), longest)
    gain = evidence.state_space(model, 1.0).dc_gain()
    # over the longest experiment; poles far outside overflow
    decays = slowest > 1.0 and bool(np.isfinite(gain).all())
    if decays:
        constants = outputs - levels @ gain.T
    if slowest <= _SETTLED and len(model.initial_states) == len(pairs):
        found = _as_they_begin(evidence, trends, lengths)
        outputs_of = [y for _, y in pairs]
        if found is not None and not (decays and far_off(found[1], outputs_of)):
            return Offsets(levels + found[0], found[1], none, constants, lengths)
    if not decays:
        return Offsets(levels, outputs, drifts, constants, lengths)
    means = np.array([u.mean(axis=0) for u, _ in pairs])
    return Offsets(means, constants + means @ gain.T, drifts, constants, lengths)


def far_off(y0: Array, outputs: Sequence[Array]) -> bool:
    """Whether an output is to rest farther from its range than that is wide."""
    y = np.vstack(outputs)
    least, most = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
    wide = most - least
    return bool(((y0 < least - wide) | (y0 > most + wide)).any())


def of_rates(rates: Offsets, gain: Array, flags: NDArray[np.bool_]) -> Offsets:
    """Offsets of the outputs of which some, by `flags`, integrate those of `rates`.

    A constant rate is the answer of the rates, of that static `gain`, to an offset of
    the inputs; what they cannot make is a drift.
    """
    c, none = rates.constants, np.zeros_like(rates.drifts)
    if not np.isfinite(gain).all() or not c.any():
        return rates
    inputs = -linalg.lstsq(gain[flags], c[:, flags].T)[0].T
    left = c + inputs @ gain.T
    left[np.abs(left) <= ROUNDING * np.abs(c)] = 0.0
    outputs, drifts = np.where(flags, 0.0, left), np.where(flags, left, 0.0)
    return Offsets(inputs, outputs, drifts, none, rates.n_samples, rates.differ)


def _as_they_begin(
    evidence: Evidence, trends: Array, lengths: Array
) -> tuple[Array, Array] | None:
    """Offsets of inputs and outputs by which experiments begin nearest to rest.

    With the answer S to steps of the inputs, ``trends + free x0 = y0 - S u0 + free x``:
    behind an integrator u0 is a straight line. Least squares, with as little as may be
    of x. Shapes (n_experiments, n_inputs) and (n_experiments, n_outputs); None where
    drifts are left, or the model grows beyond all numbers.
    """
    model, n_values = evidence.model, sum(r.n_values for r in evidence.records)
    lti, scale = evidence.state_space(model, 1.0), evidence.output_scale
    noise = np.sqrt(model.loss / n_values)
    m, ny, found = lti.n_inputs, lti.n_outputs, []
    for n, x0, trend in zip(lengths, model.initial_states, trends, strict=True):
        free = free_responses(lti.A, lti.C, n)
        target = (free @ x0 + trend_signals(n, len(trend)).T @ trend) / scale
        try:
            steps = [-lti.simulate(np.tile(row, (n, 1))) for row in np.eye(m)]
        except DivergenceError:
            return None
        constants = np.broadcast_to(np.eye(ny), (n, ny, ny))
        columns = np.concatenate([np.stack(steps, axis=2), constants, free], axis=2)
        columns = (columns / scale[:, None]).reshape(n * ny, -1)
        size = column_scale(columns)
        size[m + ny :] /= _RELUCTANTLY
        x = linalg.lstsq(columns / size, target.ravel(), UNDETERMINED)[0]
        left = target.ravel() - columns / size @ x
        with np.errstate(over="ignore", invalid="ignore"):  # of a model that grows
            most = _UNSEEN * noise + _NEARLY * target.std(axis=0).max()
            explained = np.sqrt(np.mean(left**2)) <= most < np.inf
        if not explained:
            return None
        found.append((x / size)[: m + ny])
    u0, y0 = np.split(np.array(found), [m], axis=1)
    return u0, y0
