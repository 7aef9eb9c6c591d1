"""What is said of outputs that no plant makes so: held, filled in, at limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...data.faulty_signals import (
    drops_out,
    held_for,
    is_code,
    line_length,
    repeated_in_bursts,
    stands_apart,
    stays_put,
    wraps,
)
from ...data.preparation import Pairs, constant_columns
from ..evidence.rounding import Rounding
from ..fits.local_fit import LocalFit
from ..telling import Telling, in_experiment

Array = NDArray[np.float64]

_EXPLAINED = 1e-4  # error, relative to the outputs, that rounded numbers leave

# An output is at a limit where it stays and its model moves on
_MOVES_ON = 0.05  # of the motion of the model, at least
_AT_LIMITS = 0.01  # of the samples, at least, to be told

LINE = "line"  # the kind of what is told of outputs that drift along one
_DRIFTS = 0.1  # to either side, of the motion of the output

_SOME = 3  # values that are listed

# Values of an output that may be a command; times as many of a measured input; and
# errors, relative to the outputs, of models of what an answer is taken for the cause of
_COMMANDS, _MORE, _POOR = 8, 20, 0.3


def tell_of_still_outputs(outputs: Sequence[Array], telling: Telling) -> None:
    """Tell of outputs that never change."""
    if "still" in telling:
        return
    still = constant_columns(outputs)
    if len(still):
        k = int(still[0])
        telling.once(
            "still",
            f"Output {telling.output(k)} is {outputs[0][0, k] + 0.0:.6g} in all "
            "samples: no input acts on it. Check its sensor and its column, or leave "
            "it out of `y`.",
        )


def tell_of_held_outputs(outputs: Sequence[Array], telling: Telling) -> None:
    """Tell of outputs that are sampled more slowly than the table."""
    if "held" in telling:
        return
    held = [held_for([y[:, i] for y in outputs]) for i in range(outputs[0].shape[1])]
    slowest = max(held)
    if slowest > 1:
        telling.once(
            "held",
            f"Output {telling.output(held.index(slowest))} keeps its values for "
            f"{slowest} samples: it was sampled more slowly than the table, and held "
            "in between as the response of no linear system is. Where no input moves "
            f"while it is held, take one row of every {slowest} (the first of each "
            "value), or `resample`; where one does, put NaN in place of values that "
            "are held, and use missing='estimate' with a given `order`.",
        )


def tell_of_codes(pairs: Pairs, telling: Telling) -> None:
    """Tell of values that loggers write where nothing was measured.

    They are far from all others. So is what several channels do in the same samples,
    inputs and outputs alike, whatever the value.
    """
    if "codes" in telling:
        return
    names = (telling.input, telling.output)
    called = ("Input", "Output")
    found = []
    for k, side in enumerate(zip(*pairs, strict=True)):
        signals = np.concatenate(side)
        for i, signal in enumerate(signals.T):
            known = np.isfinite(signal)
            value = stands_apart(signal[known]) if known.any() else None
            if value is not None:
                found.append((k, i, value, signal == value))
    for k, i, value, there in found:
        alike = any(other != k and (at == there).all() for other, _, _, at in found)
        if not (alike or is_code(value)):
            continue
        by_experiment = np.split(there, np.cumsum([len(u) for u, _ in pairs[:-1]]))
        e = next(e for e, own in enumerate(by_experiment) if own.any())
        where = in_experiment(by_experiment[e].argmax(), e, len(pairs))
        telling.once(
            "codes",
            f"{called[k]} {names[k](i)} is {value:.6g} in {np.count_nonzero(there)} "
            "sample(s), far from all its other values"
            f"{', where other channels are, too' * alike}, as loggers write where "
            f"nothing was measured; the first is sample {where}, counted from 0. Put "
            "NaN in place of these samples and use missing='split', or 'estimate' "
            "where they are outputs.",
        )
        return


def tell_of_dropouts(pairs: Pairs, telling: Telling) -> None:
    """Tell of outputs whose sensor reads one value in between."""
    inputs, outputs = zip(*pairs, strict=True)
    if telling.kinds & {"codes", "dropouts"}:
        return
    for k in range(outputs[0].shape[1]):
        found = drops_out([y[:, k] for y in outputs], inputs)
        if found is not None:
            n = sum(stop - start for _, start, stop in found.runs)
            first, start, _ = found.runs[0]
            where = in_experiment(start, first, len(outputs))
            telling.once(
                "dropouts",
                f"Output {telling.output(k)} falls to {found.value:.6g} in {n} "
                f"sample(s), {len(found.runs)} time(s), far from what is before and "
                f"after; the first is sample {where}, counted from 0. Its "
                "sensor, or what logs it, drops out: put NaN in place of these "
                "samples and use missing='estimate'.",
            )


def tell_of_logging(pairs: Pairs, fitted: LocalFit, telling: Telling) -> None:
    """Tell of outputs that a logger has filled in, or turned back.

    None that a linear model explains but for rounding.
    """
    if fitted.residual < _EXPLAINED:
        return
    inputs, outputs = zip(*pairs, strict=True)
    for k in range(outputs[0].shape[1]):
        signals = [y[:, k] for y in outputs]
        length = line_length(signals) if "lines" not in telling else 1
        if length > 1:
            telling.once(
                "lines",
                f"Output {telling.output(k)} runs along straight lines for {length} "
                "samples at a time: it was sampled more slowly than the table, and "
                "interpolated, as the response of no linear system is. Take one row of "
                f"every {length}, those in which its lines end, for all columns; or "
                "put NaN in place of what is between them, and use missing='estimate' "
                "with a given `order`.",
            )
        bursts = repeated_in_bursts(signals) if "bursts" not in telling else []
        if bursts:
            n, (first, start, _) = sum(b - a for _, a, b in bursts), bursts[0]
            where = in_experiment(start, first, len(outputs))
            telling.once(
                "bursts",
                f"Output {telling.output(k)} repeats its last value in {n} samples, "
                f"{len(bursts)} time(s), and then catches up; the first is sample "
                f"{where}, counted from 0. What logs it had nothing new: put NaN in "
                "place of the repeated samples and use missing='estimate'.",
            )
        n_turns = wraps(signals, inputs) if "wraps" not in telling else 0
        if n_turns:
            telling.once(
                "wraps",
                f"Output {telling.output(k)} jumps back by nearly its whole range "
                f"{n_turns} times, and moves by small steps else, as angles do that "
                "are kept within a revolution. Use `numpy.unwrap`, with the `period` "
                "of its unit, for every experiment.",
            )


def tell_of_exchange(pairs: Pairs, fitted: LocalFit, telling: Telling) -> None:
    """Tell of outputs that take few values beside inputs that do not, as commands do.

    None that a linear model explains.
    """
    if "exchanged" in telling or fitted.residual < _POOR:
        return
    u, y = (np.concatenate(signals) for signals in zip(*pairs, strict=True))
    n_outputs = [len(np.unique(column)) for column in y.T]
    n_inputs = [len(np.unique(column)) for column in u.T]
    most, least = max(n_outputs), min(n_inputs)
    if most <= _COMMANDS and least >= _MORE * most:
        names = telling.output(int(np.argmax(n_outputs))), telling.input(0)
        telling.once(
            "exchanged",
            f"Output {names[0]} takes {most} values only, as a command does, and "
            f"input {names[1]} takes {n_inputs[0]}: inputs and outputs seem to be "
            "exchanged. Give what moves the system as `X`, and what answers as `y`. "
            "Where the output is a switch or counts events, a linear model tells its "
            "mean alone.",
        )


def tell_of_limits(
    outputs: Sequence[Array], fitted: LocalFit, telling: Telling
) -> None:
    """Tell of an output that stays where it is though its model moves on."""
    if "limit" in telling:
        return
    model, records = fitted.evidence.model, fitted.scaled.records
    stays = [stays_put([y[:, i] for y in outputs]) for i in range(outputs[0].shape[1])]
    if not any(map(any, stays)) or len(model.initial_states) != len(records):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        moves = [model.outputs(record, k) for k, record in enumerate(records)]
        least = _MOVES_ON * np.std(np.vstack(moves), axis=0)
    # within a step of a rounded output it need not move
    steps = np.sqrt(12.0 * Rounding.of(records).variances)
    least = np.maximum(least, steps)
    for i in np.flatnonzero(np.isfinite(least)):
        passed = [
            (y[start, i], stop - start)
            for y, moved, parts in zip(outputs, moves, stays[i], strict=True)
            for start, stop in parts
            if np.std(moved[start:stop, i]) > least[i]
        ]
        n_passed = sum(n for _, n in passed)
        if n_passed > _AT_LIMITS * sum(map(len, outputs)):
            values = sorted({v for v, _ in passed})
            some = ", ".join(f"{v:.6g}" for v in values[:_SOME])
            some += ", ..." if len(values) > _SOME else ""
            telling.once(
                "limit",
                f"Output {telling.output(i)} stays at {some} for {n_passed} samples in "
                "which its model moves on: it is at a limit, of its sensor or of the "
                "plant, or its sensor hangs, as no linear system does. Record within "
                "the limits, or use NaN for these samples and missing='estimate', and "
                "compare.",
            )


def tell_of_drift(fitted: LocalFit, outputs: Sequence[Array], telling: Telling) -> None:
    """Tell of drifts that matter to a simulation, which stands in their middle."""
    drifts = fitted.offsets.drifts
    if not drifts.any() or len(drifts) != len(outputs):
        return
    lines = [
        np.outer(np.linspace(-0.5, 0.5, len(y)), (len(y) - 1) * drift)
        for y, drift in zip(outputs, drifts, strict=True)
    ]
    left = [y - line for y, line in zip(outputs, lines, strict=True)]
    largest = np.max(np.abs([line[0] for line in lines]), axis=0)
    moves = np.vstack([part - part.mean(axis=0) for part in left]).std(axis=0)
    # what does not move beside a drift, inputs do not move
    known = moves > _EXPLAINED * np.max(
        [np.abs(y).max(axis=0) for y in outputs], axis=0
    )
    share = np.where(known, largest / np.where(known, moves, 1.0), 0.0)
    if share.max() > _DRIFTS:
        i = int(share.argmax())
        telling.once(
            LINE,
            f"Output {telling.output(i)} drifts along a line that inputs do not "
            f"explain, by {2.0 * largest[i]:.3g} within an experiment. That was taken "
            "for a sensor's, or a load's, and `predict` stands in the middle, "
            f"{100.0 * share[i]:.0f} % of the output's motion from either end. Remove "
            "it from `y`, use predict_with_initial_state, or offset='constant' if the "
            "plant itself drifts.",
        )
