"""From scaled records to a discrete-time state-space model of given order and horizon.

Compression, subspace, shift invariance, simulation least squares and the refinement in
sequence: the function core of `lpvlearn.subspace.SubspaceLTI`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .hankel import data_factors
from .realization import (
    ObservabilitySubspace,
    observability_subspace,
    reflect_unstable,
)
from .refinement import refine_simulation
from .signals import Record, output_energy
from .simulation_fit import Freedom, Realization, simulation_fit

Array = NDArray[np.float64]

# A reflected (stable) start is preferred unless its loss is larger by this factor, one
# per cent, and by more than growing states explain of the last samples' noise: this
# many times what the parameters of a model absorb of it.
STABLE_LOSS, _BY_CHANCE = 1.01, 10.0

# Enforced stability keeps this distance from the unit circle, where rounding could
# bring a pole back.
STABLE_MARGIN = 1e-8


class ScaledRecords(NamedTuple):
    """Records with every channel scaled to unit root mean square."""

    records: list[Record]
    input_scale: Array
    output_scale: Array


class Settings(NamedTuple):
    """How models are made of scaled records; the options of `SubspaceLTI`, checked."""

    free: Freedom
    method: str = "po-moesp"
    refine: bool = True
    enforce_stability: bool = False
    n_noise_states: int = 0  # additional states of the subspace step

    def max_horizon(self, lengths: Sequence[int]) -> int:
        """Largest horizon whose Hankel columns outnumber its rows (at least 1).

        `lengths` are the samples of every experiment.
        """
        rows = 2 * sum(self.free.direct.shape)
        low, high = 1, max(1, max(lengths) // 2)
        while low < high:  # the number of columns falls with the horizon
            middle = (low + high + 1) // 2
            n_columns = sum(max(0, n - 2 * middle + 1) for n in lengths)
            enough = n_columns >= rows * middle
            low, high = (middle, high) if enough else (low, middle - 1)
        return low

    def max_order(self, horizon: int) -> int:
        """Largest order that a horizon can show of these channels.

        Shift invariance needs ``(horizon - 1) n_outputs`` rows; PI-MOESP has no more
        than ``horizon * n_inputs`` instruments.
        """
        n_outputs, n_inputs = self.free.direct.shape
        order = (horizon - 1) * n_outputs
        return min(order, horizon * n_inputs) if self.method == "pi-moesp" else order

    def check_size(
        self, lengths: Sequence[int], order: int | None, horizon: int | None
    ) -> None:
        """Refuse a horizon or an order that the number of samples cannot carry.

        >>> Settings(Freedom(np.ones((1, 1), bool))).check_size([900], 9, 5)
        Traceback (most recent call last):
        ValueError: `order` must be at most 4 for 900 samples and horizon 5. Got 9.
        """
        longest = self.max_horizon(lengths)
        if horizon is not None and horizon > longest:
            n_outputs, n_inputs = self.free.direct.shape
            raise ValueError(
                f"`horizon` must be at most {longest} for {sum(lengths)} samples of "
                f"{n_inputs} input(s) and {n_outputs} output(s). Got {horizon}. Use "
                "horizon='auto' or more samples."
            )
        used = longest if horizon is None else horizon
        highest = self.max_order(used)
        if order is not None and order > highest:
            raise ValueError(
                f"`order` must be at most {highest} for {sum(lengths)} samples and "
                f"horizon {used}. Got {order}."
            )


class Identified(NamedTuple):
    """Result of `identify`."""

    model: Realization  # of the scaled records
    singular_values: Array  # (horizon * n_outputs,): of the subspace
    residual: float  # rms of the simulation errors relative to that of all outputs
    stability_loss: float  # increase of the residual that enforced stability cost


def _root_mean_square(parts: Sequence[Array]) -> Array:
    """RMS of every column over all parts, safe against under- and overflow; 1 for 0."""
    peak = np.max([np.abs(part).max(axis=0) for part in parts], axis=0)
    peak[peak == 0.0] = 1.0
    energy = sum(((part / peak) ** 2).sum(axis=0) for part in parts)
    rms = peak * np.sqrt(energy / sum(len(part) for part in parts))
    rms[rms == 0.0] = 1.0
    return rms


def scale_records(experiments: Sequence[tuple[Array, Array]]) -> ScaledRecords:
    """Scale all experiments (u, y), a row per sample, together."""
    su = _root_mean_square([u for u, _ in experiments])
    sy = _root_mean_square([y for _, y in experiments])
    return ScaledRecords([Record.of(u / su, y / sy) for u, y in experiments], su, sy)


def subspaces_of(
    records: Sequence[Record], widths: Mapping[int, int], method: str
) -> dict[int, ObservabilitySubspace]:
    """Observability subspace of every horizon, of as many directions as given."""
    m, ny = len(records[0].u), len(records[0].y)
    samples = [np.ascontiguousarray(np.vstack(record).T) for record in records]
    past_outputs = method != "pi-moesp"
    factors = data_factors(samples, m, widths, past_outputs=past_outputs)
    return {
        horizon: observability_subspace(factor, m, ny, horizon, width, method)
        for (horizon, width), factor in zip(widths.items(), factors, strict=True)
    }


def realize(
    subspace: ObservabilitySubspace,
    records: Sequence[Record],
    order: int,
    settings: Settings,
) -> Realization:
    """Model of one order from an observability subspace, not yet refined.

    Poles outside the unit circle are reflected into it where that costs next to
    nothing in simulation error, or always with ``enforce_stability``. With
    ``n_noise_states`` the subspace is read at that much a higher order, and only the
    states that the inputs reach are kept.
    """
    enforce, free = settings.enforce_stability, settings.free

    def with_inputs(A: Array, C: Array) -> tuple[Array, Array, Array] | None:
        whole = simulation_fit(A, C, records, free)
        return whole[:3] if np.isfinite(whole.loss) else None

    ny, n_noise = len(records[0].y), settings.n_noise_states
    A, C = subspace.state_pair(ny, order, n_noise, with_inputs)
    stable_A = reflect_unstable(A, 1.0 - STABLE_MARGIN if enforce else 1.0)
    stable = simulation_fit(stable_A, C, records, free)
    if stable_A is A or enforce:
        return stable
    as_found = simulation_fit(A, C, records, free)
    n_values = sum(record.y.size for record in records)
    n_parameters = order * (len(records[0].u) + len(C) + len(records))
    limit = max(STABLE_LOSS, 1.0 + _BY_CHANCE * n_parameters / n_values)
    return as_found if as_found.loss * limit < stable.loss else stable


def estimate(
    subspace: ObservabilitySubspace,
    records: Sequence[Record],
    order: int,
    settings: Settings,
) -> Realization:
    """As `realize`, then refined where the settings say so."""
    start = realize(subspace, records, order, settings)
    if not settings.refine:
        return start
    return refine_simulation(start, records, settings.free)


def identify(
    records: Sequence[Record], order: int, horizon: int, settings: Settings
) -> Identified:
    """Model of scaled records; every experiment has its own initial state."""
    width = order + settings.n_noise_states
    subspace = subspaces_of(records, {horizon: width}, settings.method)[horizon]
    model = estimate(
        subspace, records, order, settings._replace(enforce_stability=False)
    )
    energy = output_energy(records) or 1.0
    stability_loss, free_loss = 0.0, model.loss
    if settings.enforce_stability and not _radius(model.A) < 1.0 - STABLE_MARGIN:
        model = estimate(subspace, records, order, settings)
        if 0.0 < free_loss < model.loss:
            stability_loss = np.sqrt(model.loss / energy) - np.sqrt(free_loss / energy)
    residual = float(np.sqrt(model.loss / energy))
    return Identified(model, subspace.singular_values, residual, float(stability_loss))


def _radius(A: Array) -> float:
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
