"""Oscillations of the outputs that no input moves: hum of the mains, runout of a shaft.

A sinusoid is the free motion of an undamped mode, and explains so much that two states
are spent on it. They are none of the plant: between operating points such a mode is at
the border of stability, what noise tells inputs do to it is a resonance, and where the
order is given the plant lacks two other states.

Sinusoids take the place of such modes where they explain as much of the outputs, and
are subtracted. Where inputs move a mode, what is left still needs it.

To inputs of a few lines, modes that do not decay are as good a plant as any: enough of
them answer at these lines whatever one that is not linear does. From rest they go on
for ever. A model without them stands where it explains nearly as much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import linalg

from ...data.faulty_signals import held_for
from ..evidence.constants import CERTAIN
from ..evidence.statistics import Evidence
from ..fits.local_fit import LocalFit
from ..fits.one_fit import Samples
from ..samples.records import Record, thinned
from ..simulation_error.criterion import PRICE, n_parameters
from ..simulation_error.simulation_fit import Freedom, Realization, simulation_fit
from .trends import with_trends

Array = NDArray[np.float64]

_DECAYS = 1.0  # time constants per record of a mode that stands for one
_SETTLED = 10.0  # of one that clearly does not

# Radians that it turns in a record, at least: less is a drift. And by which it is off a
# half turn with every sample, whose cosine and sine are the same.
_TURNS = 3.0

# Polynomials of time that amplitudes may follow in records of so many radians, and the
# part of what a sinusoid explains that they may add: noise that shakes a mode makes its
# amplitude wander.
_DEGREE, _FOLLOWED, _WANDERS = 3, 11.0, 0.05

_CHANCE = 1e-6  # of as large an oscillation of white noise

_NEAR = 10.0  # per record: distance from a sinusoid of modes that do the same

# Times the energy beside it that a line of the inputs has: so many bins away at most,
# and further than these few, to which it spreads.
_STANDS_OUT, _BESIDE, _WITHIN = 30.0, 8, 2

_SHARP = 0.03  # decay per sample of modes of an autoregression that may stand for one

# Independent values of the inputs for each parameter, below which these are of few
# lines; lower orders tried for a model whose modes decay, before the same one; and the
# part of the outputs, root mean square, that it may leave beyond the likeliest.
_PER_PARAMETER, _FEWER, _LEFT = 1, 3, 0.1

_INDEPENDENT = 1e-6  # singular values of windows of inputs, next to the largest

_ROUNDS = 3  # in each of which further ones may come out


def without_oscillations(
    samples: Samples, whole: LocalFit
) -> tuple[Samples, LocalFit, Array]:
    """Take out oscillations that modes of the model stand for, moved by no input.

    The third value are their radians per sample. Of as many states, as where the order
    is given, the model must be likelier then beyond chance: two of them may have been
    meant for the oscillation.
    """
    choices = samples.choices
    asked = choices.initial_states and choices.refine in ("auto", "prediction")
    if not asked or choices.enforce_stability or whole.method == "pbsid":
        return samples, whole, np.zeros(0)
    calm, fitted, turns = samples, whole, np.zeros(0)
    for _ in range(_ROUNDS):
        found = _turns(fitted.evidence)
        if not len(found) and choices.order is not None:
            found = _turns_of_noise(calm, fitted)
        if not len(found):
            break
        apart = np.abs(turns[:, None] - found).min(axis=1) * whole.evidence.longest
        found = np.append(turns[apart > _NEAR], found)
        rest = _subtracted(samples, calm, fitted, found)
        other = with_trends(rest.aside())
        worse = other.worse_than(fitted)
        worse += (len(found) - len(turns)) * _price_of(fitted.evidence)
        fewer = len(other.model.A) < len(fitted.model.A)
        if not worse < (CERTAIN if fewer else -CERTAIN):
            break
        calm, fitted, turns = rest, other, found
    if len(turns):
        motion = np.vstack(_differences(samples, calm))
        size = np.sqrt(np.mean(motion**2, axis=0))
        largest = int(np.argmax(size / whole.evidence.output_scale))
        listed = ", ".join(f"{turn:.4g}" for turn in np.sort(turns))
        seen = (
            f"Outputs oscillate where no input moves them, at {listed} rad per sample: "
            f"{size[largest]:.3g} (rms) of output {samples.telling.output(largest)}. "
        )
        clock = _clock_of(samples, turns, whole.evidence.longest)
        if clock:
            samples.telling.once(
                "oscillation",
                f"{seen}Inputs step every {clock} samples, and a plant that is not "
                "linear does so at each step; or it is a disturbance of that clock. It "
                "was taken out. Use smaller inputs, and steps that are not all of one "
                "length, or remove the disturbance at its source.",
            )
        else:
            samples.telling.once(
                "oscillation",
                f"{seen}That was taken for a disturbance, as hum or runout is, and not "
                f"for the plant's. Where it is the plant's, use order="
                f"{len(whole.model.A)}; else remove it at its source, or by the same "
                "notch filter on inputs and outputs.",
            )
    return calm, fitted, turns


def _clock_of(samples: Samples, turns: Array, longest: int) -> int:
    """Samples for which an input is held, if sinusoids are of that clock; else 0."""
    inputs = [u for u, _ in samples.pairs]
    for j in range(inputs[0].shape[1]):
        held = held_for([u[:, j] for u in inputs])
        clock = 2.0 * np.pi / held
        off = np.abs(turns - clock * np.round(turns / clock)) * longest
        if held > 1 and (off < _NEAR).all():
            return held
    return 0


def without_modes_of_few_lines(samples: Samples, fitted: LocalFit) -> LocalFit:
    """The model, or one whose modes decay where few lines tell the two apart."""
    evidence, order = fitted.evidence, len(fitted.model.A)
    longest = evidence.longest
    chosen = samples.choices.order is None and fitted.method != "pbsid"
    if not (chosen and len(_lasting_turns(fitted.model, longest))):
        return fitted
    unknown = n_parameters(order, (), evidence.free)
    if not _are_of_few_lines(thinned(evidence.records), _PER_PARAMETER * unknown):
        return fitted
    rows = [r for r in fitted.selection.rows if 0 < r.order <= order]
    rows = [row for row in rows if row.criterion >= 0.0]
    rows.sort(key=lambda row: (row.order == order, row.criterion))
    for row in [*rows[:_FEWER], *rows[_FEWER:][-1:]]:
        other = samples.aside().having(order=row.order).tried(evidence.free.n_trend)
        if other is None or len(_lasting_turns(other.model, longest, _SETTLED)):
            continue
        if not other.residual**2 - fitted.residual**2 < _LEFT**2:
            continue
        samples.telling.once(
            "few lines",
            f"Modes of the likeliest model, of order {order}, do not decay, and the "
            "inputs are of so few lines that such modes may stand for what a plant "
            "that is not linear does there. A model whose modes decay was taken, of "
            f"order {row.order}, which leaves {100.0 * other.residual:.2g} % of the "
            f"outputs where that leaves {100.0 * fitted.residual:.2g} %. Excite at "
            f"more frequencies, or give the `order` of a plant that has such modes.",
        )
        return other._replace(selection=other.selection.among(fitted.selection))
    return fitted


def _are_of_few_lines(records: Sequence[Record], n_values: int) -> bool:
    """Whether windows of so many values of the inputs are not independent."""
    width = -(-n_values // len(records[0].u))
    windows = [
        sliding_window_view(r.u, width, axis=1)
        .swapaxes(0, 1)
        .reshape(-1, len(r.u) * width)
        for r in records
        if r.n_samples >= width
    ]
    if not windows:
        return False
    sizes = np.linalg.svd(np.vstack(windows), compute_uv=False)
    return bool((sizes > _INDEPENDENT * sizes[0]).sum() < n_values)


def _price_of(evidence: Evidence) -> float:
    """What a sinusoid costs of the criterion, as its modes do by their parameters.

    Two amplitudes of every record and output, and a frequency that was looked for.
    """
    unknown = 2 * len(evidence.model.C) * len(evidence.records) + 1
    return PRICE * unknown + 2.0 * float(np.log(evidence.longest))


def _differences(samples: Samples, calm: Samples) -> list[Array]:
    pairs = zip(samples.pairs, calm.pairs, strict=True)
    return [y - rest for (_, y), (_, rest) in pairs]


def _turns(evidence: Evidence) -> Array:
    """Radians per sample of modes whose like steady sinusoids are, beyond chance.

    Of many frequencies one always looks like a sinusoid.
    """
    free = evidence.free
    model = evidence.whitening.model(evidence.model)
    turns = _lasting_turns(model, evidence.longest)
    records = evidence.whitening.records(evidence.records, free)
    n_samples = sum(record.n_samples for record in records)
    n_left = n_samples * len(model.C) - n_parameters(len(model.A), records, free)
    turns = turns[~_are_of_inputs(turns, thinned(evidence.records))]
    if not (len(turns) and evidence.refined and n_left > 0):
        return turns[:0]
    fitted = _beside(turns, model, records, free, _DEGREE)
    # (n_turns, degree + 1): energies, of real and imaginary parts together
    energy = np.sum(fitted.trends[:, free.n_trend :] ** 2, axis=(0, 2))
    energy = energy.reshape(len(turns), _DEGREE + 1, 2).sum(axis=2)
    steady = energy[:, 1:].sum(axis=1) < _WANDERS * energy[:, 0]
    by_chance = 2.0 * np.log(n_samples / _CHANCE) * fitted.loss / n_left
    return turns[steady & (energy[:, 0] > by_chance)]


def _are_of_inputs(turns: Array, records: Sequence[Record]) -> NDArray[np.bool_]:
    """Whether inputs have lines there, as periodic ones do: outputs answer at these.

    Energies far above those of frequencies beside, and above what all have in the mean.
    """
    found = np.zeros(len(turns), dtype=bool)
    for record in records:
        bin_ = 2.0 * np.pi / record.n_samples
        around = np.arange(-_BESIDE, _BESIDE + 1) * bin_
        motion = record.u - record.u.mean(axis=1, keepdims=True)
        turned = (
            -1j * (turns + around[:, None])[..., None] * np.arange(record.n_samples)
        )
        # (n_around, n_turns, n_inputs)
        energy = np.abs(np.exp(turned) @ motion.T) ** 2
        beside = np.abs(around) > _WITHIN * bin_
        line = energy[~beside].max(axis=0)
        stands = line > _STANDS_OUT * energy[beside].mean(axis=0)
        found |= (stands & (line > (motion**2).sum(axis=1))).any(axis=-1)
    return found


def _lasting_turns(model: Realization, longest: int, within: float = _DECAYS) -> Array:
    """Radians per sample of modes that neither decay nor grow over a record.

    By so many time constants.
    """
    poles = np.linalg.eigvals(model.A)
    turns = np.angle(poles)
    lasts = np.abs(1.0 - np.abs(poles)) * longest < within
    return turns[lasts & (np.sin(turns) * longest > _TURNS)]


def _turns_of_noise(samples: Samples, fitted: LocalFit) -> Array:
    """Those that a model of a given order leaves to its noise, as two states show."""
    evidence = fitted.evidence
    poles = np.linalg.eigvals(evidence.noise.A)
    decay = 1.0 - np.abs(poles[poles.imag > 0.0])
    if not (decay < max(_SHARP, _NEAR / evidence.longest)).any():
        return np.zeros(0)
    more = samples.aside().having(order=len(evidence.model.A) + 2)
    found = more.tried(evidence.free.n_trend)
    return np.zeros(0) if found is None else _turns(found.evidence)


def _subtracted(
    samples: Samples, calm: Samples, fitted: LocalFit, turns: Array
) -> Samples:
    """The samples without sinusoids.

    As a model tells them that was fitted to samples without some of them.
    """
    free, scale = fitted.evidence.free, fitted.evidence.output_scale
    records = [
        record._replace(y=record.y + (motion / scale).T)
        for record, motion in zip(
            fitted.scaled.records, _differences(samples, calm), strict=True
        )
    ]
    beside = _beside(turns, fitted.model, records, free, 0)
    left = []
    for (u, y), trends in zip(samples.pairs, beside.trends, strict=True):
        motion = _sinusoids(turns, len(y), 0) @ trends[free.n_trend :]
        left.append((u, y - scale * motion))
    return samples._replace(pairs=left)


def _beside(
    turns: Array,
    model: Realization,
    records: Sequence[Record],
    free: Freedom,
    degree: int,
) -> Realization:
    """A model with sinusoids among its trends, and without modes that do the same."""
    poles, left = linalg.eig(model.A.T)
    distance = np.abs(poles[:, None] - np.exp(1j * turns)).min(axis=1, initial=2.0)
    its = distance * max(record.n_samples for record in records) < _NEAR
    W = left[:, its].T
    Z = linalg.null_space(np.vstack([W.real, W.imag]))
    sinusoids = [_sinusoids(turns, r.n_samples, degree).T for r in records]
    beside = [
        r._replace(trend=np.vstack([r.trend.reshape(-1, r.n_samples), more]))
        for r, more in zip(records, sinusoids, strict=True)
    ]
    free = free._replace(n_trend=free.n_trend + len(sinusoids[0]))
    return simulation_fit(Z.T @ model.A @ Z, model.C @ Z, beside, free)


def _sinusoids(turns: Array, n_samples: int, degree: int) -> Array:
    """Orthonormal where they are apart, (n_samples, 2 n_turns (degree + 1)).

    Turn by turn, times polynomials of time, one degree after the other. In a record of
    few turns, which other motions may look like, only degree 0 is not zero; of as many
    samples as signals or fewer some are.
    """
    time = np.arange(n_samples)
    shapes = np.polynomial.legendre.legvander(2.0 * time / n_samples - 1.0, degree)
    signals = np.zeros((n_samples, len(turns), 2 * (degree + 1)))
    for k, turn in enumerate(turns):
        both = np.column_stack([np.cos(turn * time), np.sin(turn * time)])
        shape = shapes if turn * n_samples > _FOLLOWED else shapes[:, :1]
        Q = np.linalg.qr((shape[:, :, None] * both[:, None]).reshape(n_samples, -1))[0]
        signals[:, k, : Q.shape[1]] = Q
    return signals.reshape(n_samples, -1)
